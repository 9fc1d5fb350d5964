"""Chains of modes from expected counts, interpolated with shorter histories and with all modes together."""

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior.priors.counts.histories import Counts, Tree, level_bounds, parent_rows, row_blocks


class ModeChains:
    """What K modes do after each of the histories that occurred, from how often each mode is expected there.

    Expected counts are numbers `[P, K]`, one for each of the P entries (a row and an action) of `counts`.

    Args:
        tree, counts: of `count_histories`.
        num_contexts: number of contexts that are counted apart, or None.
        num_actions: A.
        smoothing, sharing: see `SwitchingPrior`.
    """

    def __init__(
        self, tree: Tree, counts: Counts, num_contexts: int | None, num_actions: int, smoothing: float, sharing: float
    ) -> None:
        self.tree, self.counts, self.num_actions = tree, counts, num_actions
        self.smoothing, self.sharing, self.contexts = smoothing, sharing, num_contexts or 1
        self.pooled = num_contexts is not None
        self.parent = parent_rows(tree, counts, self.contexts)
        self.kinds = torch.bincount(counts.row, minlength=len(counts.row_code)).double()
        self.code = counts.row * num_actions + counts.action
        self._cached_blocks: dict[int, list[_Block]] = {}
        ends = torch.tensor(level_bounds(tree, counts, self.contexts), device=counts.row.device)
        levels = torch.searchsorted(counts.row, ends).tolist()
        # Of the entries of each level but the first, the longest histories first, those of their shorter histories.
        self.above = [
            (first, until, self.entries(self.parent[counts.row[first:until]], counts.action[first:until]))
            for first, until in list(pairwise(levels))[:0:-1]
        ]

    def entries(self, row: Tensor, action: Tensor) -> Tensor:
        """The entries of actions after these rows; any entry for what has not occurred, as beyond a plan's end."""
        return torch.searchsorted(self.code, row * self.num_actions + action).clamp_(max=len(self.code) - 1)

    def totals(self, longest: Tensor) -> Tensor:
        """Expected counts `[P, K]` after all histories, from those after the longest alone."""
        total = longest.clone()
        for first, until, above in self.above:
            total.index_add_(0, above, total[first:until].clone())
        return total

    def log_probs(self, expected: Tensor) -> Tensor:
        """The log-probabilities `[R + 1, K, A]`, float64, after each row; last: in contexts without counts.

        Args:
            expected: `[P, K]`, counts after all histories, as `totals` returns them.
        """
        modes, number = expected.shape[1], len(self.counts.row_code)
        probs = expected.new_empty(number + 1, modes, self.num_actions)
        whole = probs[:, 0].clone()  # of all modes together
        probs[-1], whole[-1] = self._everywhere(expected)
        for block in self._blocks(modes):
            rows, above = block.rows, block.above
            n = _dense(expected, block.entries, block.row, block.action, block.size)
            whole[rows] = self._blend(n.sum(1), whole[above], block.kinds)
            base = (1 - block.share) * probs[above] + block.share * whole[rows, None]
            probs[rows] = self._blend(n, base, block.kinds[:, None])
        return probs.clamp(min=1e-300).log()

    def entry_log_probs(self, expected: Tensor) -> Tensor:
        """Of `log_probs` the P entries alone, `[P, K]`: those of the actions that occurred after each history.

        Where actions are many, most of the table is of those that never did.
        """
        row, action, n = self.counts.row, self.counts.action, expected.clamp(min=0)
        total = n.new_zeros(len(self.kinds), n.shape[1]).index_add_(0, row, n)[row]
        kinds = self.kinds[row, None]
        probs, whole = self._everywhere(expected)
        probs, whole = probs[:, action].T.contiguous(), whole[action][:, None]
        for first, until, above in [(0, self.above[-1][0] if self.above else len(n), None), *reversed(self.above)]:
            span = slice(first, until)
            over, share = (span, 1.0) if above is None else (above, self.sharing)
            every = n[span].sum(1, keepdim=True), total[span].sum(1, keepdim=True)
            whole[span] = self._interpolate(*every, whole[over], kinds[span])
            base = (1 - share) * probs[over] + share * whole[span]
            probs[span] = self._interpolate(n[span], total[span], base, kinds[span])
        return probs.clamp(min=1e-300).log()

    def _everywhere(self, expected: Tensor) -> tuple[Tensor, Tensor]:
        """The probabilities `[K, A]` in contexts without counts, and those of all modes together, `[A]`."""
        counts, modes = self.counts, expected.shape[1]
        probs = expected.new_full((modes, self.num_actions), 1 / self.num_actions)
        whole = probs[0]
        if self.pooled:
            until = int(torch.searchsorted(counts.row_code, self.contexts))
            first = _dense(expected, *self._entries(0, until), (until, self.num_actions)).sum(0)
            kinds = (first.sum(0) > 0).sum()[None]
            whole = self._blend(first.sum(0), whole, kinds)
            probs = self._blend(first, whole.expand(modes, -1), kinds)
        return probs, whole

    def _blocks(self, modes: int) -> list["_Block"]:
        """The blocks of rows for a number of modes; found once, as EM goes through them in each iteration."""
        if modes not in self._cached_blocks:
            number, blocks = len(self.counts.row_code), []
            for _, first, until in row_blocks(self.tree, self.counts, self.contexts, self.num_actions * modes):
                above = self.parent[first:until]
                # With nothing but the place to go by, what all modes do there says more than what the mode does
                # elsewhere.
                share = torch.where(above == number, 1.0, self.sharing)[:, None, None].double()
                entries, row, action = self._entries(first, until)
                kinds = self.kinds[first:until, None]
                size = until - first, self.num_actions
                blocks.append(_Block(slice(first, until), entries, row, action, size, above, share, kinds))
            self._cached_blocks[modes] = blocks
        return self._cached_blocks[modes]

    def _blend(self, n: Tensor, base: Tensor, kinds: Tensor) -> Tensor:
        """Probabilities `[..., A]` from counts and what they are interpolated with; `kinds [..., 1]` of actions."""
        return self._interpolate(n, n.sum(-1, keepdim=True), base, kinds)

    def _interpolate(self, n: Tensor, total: Tensor, base: Tensor, kinds: Tensor) -> Tensor:
        """As `_blend`, of some of the actions, whose counts after the same history are `total` in all."""
        weight = self.smoothing * kinds
        total = total + weight
        # Where a fold is left out, rounding leaves counts that are hardly 0.
        return torch.where(total > 1e-9, (n + weight * base) / total.clamp(min=1e-9), base)

    def _entries(self, first: int, until: int) -> tuple[slice, Tensor, Tensor]:
        """The entries of some rows, with their rows, counted from `first`, and actions."""
        ends = torch.tensor([first, until], device=self.counts.row.device)
        at, end = torch.searchsorted(self.counts.row, ends).tolist()
        return slice(at, end), self.counts.row[at:end] - first, self.counts.action[at:end]


class _Block(NamedTuple):
    """R rows that are computed together, with what does not depend on the expected counts."""

    rows: slice
    entries: slice
    row: Tensor
    action: Tensor
    size: tuple[int, int]
    above: Tensor  # [R]: the rows of the shorter histories
    share: Tensor  # [R, 1, 1]: how much of what all modes do counts for each
    kinds: Tensor  # [R, 1]


def _dense(expected: Tensor, entries: slice, row: Tensor, action: Tensor, size: tuple[int, int]) -> Tensor:
    """The expected counts `[R, K, A]` of the rows and actions of some entries; `size` is R and A."""
    table = expected.new_zeros(size[0], expected.shape[1], size[1])
    table[row, :, action] = expected[entries].clamp(min=0)
    return table
