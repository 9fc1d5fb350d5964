"""Drawing actions: from logits one by one, or by splitting the plans that share a prefix over its next actions."""

from typing import Any

import torch
from torch import Tensor

from neuroprior.plans import action_dtype
from neuroprior.sampling.rows import rows_of

FEW = {"cuda": 2**15}
"""On devices of a kind, the number of plans up to which those that begin alike are not looked for."""


LEAST_TEMPERATURE = 1e-30
"""What is divided by less than this may be infinite in single precision; it draws the likeliest actions alone."""


def check_temperature(temperature: Any) -> None:
    """Raise ValueError unless logits can be divided by it."""
    if isinstance(temperature, str | bool | None) or not 0 < temperature < float("inf"):
        raise ValueError(f"`temperature` must be a positive finite number, got {temperature!r}")
    if temperature < LEAST_TEMPERATURE:
        raise ValueError(f"temperature: {temperature!r} is too small to divide by; {LEAST_TEMPERATURE} is enough")


def after_end(logits: Tensor, before: Tensor, end: int | None) -> Tensor:
    """`logits [..., A]`, but nothing else than the end symbol where the action `before [...]` was that symbol."""
    if end is None:
        return logits
    ended = torch.full_like(logits[..., :1], -torch.inf).repeat_interleave(logits.shape[-1], -1)
    ended[..., end] = 0
    return torch.where((before == end)[..., None], ended, logits)


class Draw:
    """Draws actions from logits, which are divided by a temperature."""

    def __init__(self, num_actions: int, temperature: float, generator: torch.Generator) -> None:
        self.num_actions, self.temperature, self.generator = num_actions, temperature, generator
        self.dtype = action_dtype(num_actions)

    def uniform(self, shape: tuple[int, ...], logits: Tensor) -> Tensor:
        """Uniform numbers in [0, 1) to draw actions with, of the dtype of their `logits`."""
        return torch.rand(shape, generator=self.generator, device=logits.device, dtype=logits.dtype)

    def actions(self, logits: Tensor, uniform: Tensor | None = None, row: Tensor | None = None) -> Tensor:
        """One action for each plan: int64 `[N]`; never one of probability 0.

        Args:
            logits: `[K, A]`.
            uniform: `[N]`: what to draw with; None: new uniform numbers.
            row: integers `[N]`: which of the K logits each plan has; None: plan i has those of row i.

        Raises:
            ValueError: logits from which nothing can be drawn.
        """
        if uniform is None:
            uniform = self.uniform((len(logits if row is None else row),), logits)
        actions, total = self.drawn(logits, uniform, row)
        check_possible((total > 0).all())
        return actions

    def drawn(self, logits: Tensor, uniform: Tensor, row: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """As `actions`, without its check; and the sums `[K]` of the weights of all actions, see `check_possible`."""
        # Actions first: with few actions and many rows each operation is several times as fast this way round.
        cumulative = self._weights(logits.T.contiguous(), 0).cumsum(0)
        total = cumulative[-1]
        # Rounding can carry uniform * total up to total itself, past the last action that has any probability.
        most = (cumulative < cumulative[-1]).sum(0)
        if row is not None:
            cumulative, most = cumulative.index_select(1, row), most.index_select(0, row)
        return torch.minimum((cumulative <= uniform * cumulative[-1]).sum(0), most), total

    def _weights(self, logits: Tensor, dim: int) -> Tensor:
        """Unnormalised probabilities along `dim`."""
        # The largest logit is subtracted first, so that no temperature makes it infinite.
        return ((logits - logits.amax(dim, keepdim=True)) / self.temperature).exp_()

    def split(self, counts: Tensor, logits: Tensor) -> Tensor:
        """Split `counts [M]` multinomially by the rows of `logits [M, A]`: `[M, A]`, one binomial draw per action."""
        probs = self._weights(logits.double(), -1)
        # The share of an action among the remaining ones; summing from the end keeps shares of exactly 0 and 1.
        rest = probs.flip(-1).cumsum(-1).flip(-1)
        check_possible((rest[:, 0] > 0).all())
        share = torch.where(rest > 0, probs / rest, 0).clamp_(0, 1)
        share[:, -1] = 1
        left = counts.double()
        parts = []
        for action in range(self.num_actions):
            count = torch.binomial(left, share[:, action].contiguous(), generator=self.generator)
            parts.append(count)
            left = left - count
        return torch.stack(parts, -1).long()


def check_possible(possible: Tensor | bool) -> None:
    """Raise ValueError unless it is `possible`, a bool (`[]`), to draw actions.

    That is where the sums of the weights of all actions are positive; they are NaN where a logit is, and so are the
    log-probabilities of all actions.
    """
    if not possible:
        raise ValueError("prior: its logits are NaN or infinite, or -inf for all legal actions of a state")


def are_few(total: int, device: torch.device) -> bool:
    """Whether so many plans are so few for a device that to find those that begin alike takes longer than it saves.

    A GPU steps all of them in the time of one, and to find any it has to wait for the processor.
    """
    return total <= FEW.get(device.type, 0)


def worth_splitting(children: int, total: int) -> bool:
    """Whether splitting `total` plans is cheaper than drawing them one by one.

    A split costs one evaluation of the prior per child; drawing one by one costs at most one per plan, and no
    shuffling.
    """
    return 8 * children <= total


def shuffled_rows(counts: Tensor, root: Tensor, generator: torch.Generator) -> Tensor:
    """The prefix of each plan, prefix m `counts[m]` times: ordered by root, in random order within a root.

    Args:
        counts: `[M]`: plans of each prefix.
        root: `[M]`, ascending: the root that each prefix belongs to.
        generator: shuffles.

    Returns:
        Indices `[sum of counts]`, int32 where that is enough.
    """
    # Narrow integers: shuffling and sorting cost as much as the memory that they move.
    row = torch.repeat_interleave(counts.to(_narrow(int(counts.sum()))), output_size=int(counts.sum()))
    if len(row) == 0 or len(counts) == int(root[-1]) + 1:
        return row  # one prefix for each root
    order = torch.randperm(len(row), generator=generator, device=row.device, dtype=_narrow(len(row)))
    row = rows_of(row, order)
    last = int(root[-1])
    if last == 0:
        return row
    root = root.to(torch.int16 if last < 2**15 else _narrow(last))
    return rows_of(row, rows_of(root, row).argsort(stable=True))


def _narrow(number: int) -> torch.dtype:
    """The narrowest integers that can index so many things."""
    return torch.int32 if number < 2**31 else torch.int64
