"""How many candidates a prior proposes: a fixed share, or one that follows from how much its candidates have added."""

from collections.abc import Sequence
from itertools import pairwise
from math import ceil, log

import torch
from torch import Tensor

KEPT = 0.95
"""What decisions before have added counts by this factor less from one decision to the next."""

EVEN = 4
"""So many candidates of each kind that add as much as the mean are counted besides: a few tried ones say little."""

LEAST = 0.05
"""The odds of a candidate to be the prior's are at least so much of those of the share: the prior is still tried."""


class Shares:
    """Which of a decision's candidates a prior proposes, for B starts, and how much these have added.

    What a candidate adds is the amount by which the best score would be lower without it: the difference from the
    second best candidate for the best, 0 for all others. Where `adapt`, and where a candidate of the prior added less
    on average than an own one in the decisions before, the odds of a candidate to be the prior's are those of `share`
    times the ratio of the two. So a prior that does not help is soon asked for few candidates. Where its candidates
    add more than own ones the share stays: without own candidates plans would no longer be improved.

    Args:
        drawn: the number of candidates that each of I iterations draws.
        share: of the prior's candidates in all iterations in which it proposes together, rounded to a whole number;
            between 0 and 1 at least one candidate is the prior's and one the planner's own, if two are drawn there.
        batch_size: B.
        iterations: the prior proposes in so many first iterations; None: in all.
        generator: rounds numbers that adapt, at random, so that they may be 0; its device is that of all tensors.
        adapt: the share adapts, if it is neither 0 nor 1.
        added: `[B, 2, 2]`: what the decisions before added, see `added`; None: this is the first, and `share` holds.

    Attributes:
        counts: int64 `[B, I]`: the candidates of each iteration that are the prior's.
        most: for each iteration the largest number, over all starts, of own candidates, and of the prior's.

    Example:
        >>> shares = Shares([6, 4], 0.5, 1, torch.Generator().manual_seed(0), adapt=True)
        >>> shares.counts
        tensor([[3, 2]])
        >>> shares.observe(0, torch.tensor([[1.0, 9.0, 2.0, 3.0, 5.0, 4.0]]))
        >>> shares.added  # what the prior's three candidates added, and the three own ones
        tensor([[[0., 3.],
                 [4., 3.]]])
    """

    def __init__(
        self,
        drawn: Sequence[int],
        share: float,
        batch_size: int,
        generator: torch.Generator,
        *,
        iterations: int | None = None,
        adapt: bool = False,
        added: Tensor | None = None,
    ) -> None:
        self.drawn, self.adapt = list(drawn), adapt and 0 < share < 1
        ends = [sum(drawn[:iterations][: i + 1]) for i in range(len(drawn))]
        device = generator.device
        if self.adapt and added is not None and batch_size:
            per_start = _odds(share, added).sigmoid()[:, None] * torch.tensor(ends, device=device)
            whole = (per_start + torch.rand(batch_size, 1, generator=generator, device=device)).long()
            up_to = whole.minimum(torch.tensor(ends, device=device))
            self.counts = up_to.diff(dim=1, prepend=torch.zeros_like(up_to[:, :1]))
            fewest, largest = self.counts.amin(0).tolist(), self.counts.amax(0).tolist()
        else:
            fewest = largest = _fixed(share, ends)
            self.counts = torch.tensor(fewest, device=device).expand(batch_size, -1)
        self.most = [(size - low, high) for size, low, high in zip(drawn, fewest, largest, strict=True)]
        before = torch.zeros(batch_size, 2, 2, device=device) if added is None else KEPT * added
        self._added, self._best = before, torch.full((batch_size, 1), -torch.inf, device=device)

    def is_prior(self, i: int) -> Tensor:
        """Bool `[B, P]`: which candidates of iteration `i` are the prior's: the last ones of each start."""
        size = self.drawn[i]
        return torch.arange(size, device=self.counts.device) >= size - self.counts[:, i : i + 1]

    def mixed(self, i: int, own: Tensor, proposed: Tensor) -> Tensor:
        """The candidates `[B, P, L, D]` of iteration `i`: of each kind the first ones, as many as `counts` says.

        Args:
            i: the iteration.
            own, proposed: own candidates and those of the prior, for each start as many as `most`.
        """
        both, size = torch.cat([own, proposed], 1), self.drawn[i]
        if both.shape[1] == size:
            return both
        place, from_own = torch.arange(size, device=both.device), size - self.counts[:, i : i + 1]
        index = torch.where(place < from_own, place, own.shape[1] + place - from_own)
        return both[torch.arange(len(both), device=both.device)[:, None], index]

    def observe(self, i: int, score: Tensor, others: Tensor | None = None) -> None:
        """Take note of what the candidates of iteration `i` added.

        Args:
            i: the iterations come in their order.
            score: `[B, P]`: of the candidates, in the order of `mixed`.
            others: `[B, E]`: the scores of further candidates of this iteration, which neither kind drew.
        """
        if not self.adapt or not score.shape[1]:
            return
        all_scores = torch.cat([score, *([] if others is None else [others]), self._best.to(score.dtype)], 1)
        best, second = all_scores.topk(2, 1).values.split(1, 1)
        gap = best - second
        add = torch.where(gap.isfinite(), gap, 0) * (score == best)
        prior = self.is_prior(i)
        kinds = torch.stack([prior, ~prior], 1) & (prior.any(1) & ~prior.all(1))[:, None, None]
        self._added = self._added + torch.stack([(kinds * add[:, None]).sum(-1), kinds.sum(-1)], -1)
        self._best = best

    @property
    def added(self) -> Tensor | None:
        """`[B, 2, 2]`: for the prior's candidates and the own ones, what they added, and how many there were.

        Only those of iterations with both kinds count. None where nothing adapts.
        """
        return self._added if self.adapt else None


def _odds(share: float, added: Tensor) -> Tensor:
    """The logarithms `[B]` of the odds of a candidate to be the prior's."""
    amount, number = added.unbind(-1)
    mean = amount.sum(1, keepdim=True) / number.sum(1, keepdim=True)
    prior, own = ((amount + EVEN * mean) / (number + EVEN)).log().unbind(1)
    lead = torch.where(mean[:, 0] > 0, prior - own, 0)  # nothing was tried, or nothing added anything
    return torch.tensor(share, device=added.device).logit() + lead.clamp(log(LEAST), 0)


def _fixed(share: float, ends: Sequence[int]) -> list[int]:
    """How many candidates of each iteration are the prior's, of so many that are drawn up to its end."""
    total = ends[-1] if ends else 0
    wanted = round(share * total)
    if 0 < share < 1 and total > 1:
        wanted = min(max(wanted, 1), total - 1)
    return [after - before for before, after in pairwise([0, *(ceil(wanted * end / max(total, 1)) for end in ends)])]
