"""How many candidates a prior proposes: a fixed share, or one that falls where its candidates are seldom the best."""

from collections.abc import Sequence
from itertools import pairwise
from math import ceil, log

import torch
from torch import Tensor

KEPT_PER_DECISION = 0.95
"""From one decision to the next, the numbers of the decisions before are multiplied by this."""

EVEN_DECISIONS = 0.5
"""So many decisions are counted besides, in which candidates of both kinds were equally often the best."""

MIN_ODDS_RATIO = 0.05
"""The odds fall to no less than this part of those of the share: the prior is still tried."""


class Shares:
    """Which of a decision's candidates a prior proposes, for B starts, and whether one of them was the best.

    Where `adapt`, and where a candidate of the prior was less often the best than an own one in the decisions before,
    the odds of a candidate to be the prior's are those of `share` times the ratio of the two frequencies. Where it was
    so more often the share stays: without own candidates plans would not be improved. Frequencies in few decisions vary
    by chance, so that the share of a prior that is as good as the planner is somewhat smaller on average, too.

    Only the first iteration of a decision counts, if there are candidates of both kinds; in later ones own candidates
    may search around what the prior proposed. Nobody wins where the best is a candidate that neither drew, such as the
    last plan, or where the best of both kinds are equal.

    Args:
        drawn: the number of candidates that each of I iterations draws.
        share: of the prior's candidates in all iterations in which it proposes together, rounded to a whole number;
            between 0 and 1 at least one candidate of the first iteration is the prior's and one the planner's own, if
            two are drawn there.
        batch_size: B.
        generator: where the share has fallen, numbers of candidates are rounded at random, and may be 0; its device is
            that of all tensors.
        iterations: the prior proposes in so many first iterations; None: in all.
        adapt: the share may fall, if it is neither 0 nor 1.
        wins: `[B, 2, 2]`: those after the decision before; None: this is the first, and `share` holds.

    Attributes:
        counts: int64 `[B, I]`: the candidates of each iteration that are the prior's.
        most: for each iteration the numbers of own candidates and of the prior's that have to be drawn for each start.
        wins: `[B, 2, 2]`: for the prior's candidates and the own ones, how often one was the best, and their number.
            Earlier decisions count less, by the factor `KEPT_PER_DECISION` for each since. None where nothing adapts.

    Example:
        >>> shares = Shares([6, 4], 0.5, 1, torch.Generator().manual_seed(0), adapt=True)
        >>> shares.counts
        tensor([[3, 2]])
        >>> shares.observe(torch.tensor([[1.0, 9.0, 2.0, 3.0, 5.0, 4.0]]))
        >>> shares.wins  # of the prior's three candidates, and of the three own ones
        tensor([[[0., 3.],
                 [1., 3.]]])
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
        wins: Tensor | None = None,
    ) -> None:
        self.drawn, device = list(drawn), generator.device
        fixed = _fixed_counts(share, [sum(drawn[:iterations][: i + 1]) for i in range(len(drawn))])
        self.counts = torch.tensor(fixed, device=device).expand(batch_size, -1)
        adapt = adapt and 0 < share < 1
        self.wins = torch.zeros(batch_size, 2, 2, device=device) if adapt else None
        self._may_differ = adapt and wins is not None
        if adapt and wins is not None:
            self.wins = KEPT_PER_DECISION * wins
            left = _adapted_share(share, EVEN_DECISIONS * drawn[0], wins) / share
            up_to = left[:, None] * self.counts.cumsum(1)
            whole = (up_to + torch.rand(batch_size, 1, generator=generator, device=device)).long()
            self.counts = whole.diff(dim=1, prepend=torch.zeros_like(whole[:, :1]))
        self.most = [
            (size if self._may_differ else size - from_prior, from_prior)
            for size, from_prior in zip(drawn, fixed, strict=True)
        ]

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
        if not self._may_differ:
            return both
        place, from_own = torch.arange(size, device=both.device), size - self.counts[:, i : i + 1]
        index = torch.where(place < from_own, place, own.shape[1] + place - from_own)
        return both[torch.arange(len(both), device=both.device)[:, None], index]

    def observe(self, score: Tensor, others: Tensor | None = None) -> None:
        """Take note of which kind of candidates had the best one in the first iteration.

        Args:
            score: `[B, P]`: of the candidates, in the order of `mixed`.
            others: `[B, E]`: of further candidates of this iteration, which neither kind drew.
        """
        if self.wins is None:
            return
        prior = self.is_prior(0)
        kinds = torch.stack([prior, ~prior], 1)
        best = torch.where(kinds, score.detach()[:, None], -torch.inf).amax(-1)
        best_other = best.flip(1)
        if others is not None and others.shape[1]:
            best_other = best_other.maximum(others.detach().amax(1, keepdim=True))
        number = kinds.sum(-1) * kinds.any(-1).all(1, keepdim=True)
        self.wins = self.wins + torch.stack([(best > best_other) & (number > 0), number], -1)


def _adapted_share(share: float, even: float, wins: Tensor) -> Tensor:
    """The share `[B]` after `wins`; so many candidates of each kind that win as often as all do are counted besides."""
    won, number = wins.unbind(-1)
    mean = won.sum(1, keepdim=True) / number.sum(1, keepdim=True)
    prior_rate, own_rate = ((won + even * mean) / (number + even)).log().unbind(1)
    # Where nobody won, nothing is known.
    ratio = torch.where(mean[:, 0] > 0, prior_rate - own_rate, 0).clamp(log(MIN_ODDS_RATIO), 0)
    return torch.where(ratio < 0, (torch.tensor(share, device=wins.device).logit() + ratio).sigmoid(), share)


def _fixed_counts(share: float, ends: Sequence[int]) -> list[int]:
    """How many candidates of each iteration are the prior's, of so many that are drawn up to its end."""
    total = ends[-1] if ends else 0
    wanted = round(share * total)
    least = int(0 < share < 1 and total > 1)
    wanted = min(max(wanted, least), total - least)
    left = least if ends and ends[0] > 1 else 0
    up_to = [min(ceil(wanted * end / max(total, 1)), end - left) for end in ends]
    return [after - before for before, after in pairwise([0, *up_to])]
