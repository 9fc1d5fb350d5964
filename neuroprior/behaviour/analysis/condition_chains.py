"""Chains that know the condition, scored on units that they were not fitted to: in closed form, from counts."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from scipy import sparse
from torch import Tensor

from neuroprior.behaviour.analysis.flat import FlatPlans

SMOOTHING = 20.0
"""Observations that count as if they were distributed as those of all units (of all actions, of every action alike)."""

CELLS_AT_ONCE = 2**20
"""Probabilities that are in memory at a time."""


class _Counts(NamedTuple):
    """How often each of K columns occurred in each of B blocks, where it did: a sparse matrix by blocks."""

    block: Tensor  # int64 [Z], ascending
    column: Tensor  # int64 [Z]
    times: Tensor  # float64 [Z]
    unit_times: Tensor  # float64 [Z, S]: of the same column in the S blocks of the same unit
    matrix: sparse.csr_array  # [K, B]

    @staticmethod
    def of(block: Tensor, column: Tensor, blocks: Tensor) -> "_Counts":
        """From the block and the column of each observation; `blocks [B, S]`: those of the unit of each block."""
        width = int(column.max()) + 1
        codes, times = (block * width + column).unique(return_counts=True)
        row, column = codes.div(width, rounding_mode="floor"), codes % width
        wanted = blocks[row] * width + column[:, None]
        at = torch.searchsorted(codes, wanted).clamp(max=len(codes) - 1)
        unit_times = torch.where(codes[at] == wanted, times[at], 0).double()
        times = times.double()
        matrix = sparse.csr_array((times, (column, row)), (width, len(blocks)))
        return _Counts(row, column, times, unit_times, matrix)

    def without_unit(self, taken: Tensor, blocks: Tensor) -> Tensor:
        """`[Z, P]`: how often the column occurred in the blocks `taken [B, P]` (0 or 1) of all other units."""
        totals = torch.from_numpy(self.matrix @ taken.numpy())[self.column]
        for block_times, sibling in zip(self.unit_times.T, blocks.T, strict=True):
            totals.addcmul_(block_times[:, None], taken[sibling][self.block], value=-1)
        return totals

    def place(self, block: Tensor, column: Tensor) -> Tensor:
        """Where the counts of these columns in these blocks are; all of them occurred."""
        width = int(self.column.max()) + 1
        places: Tensor = torch.searchsorted(self.block * width + self.column, block * width + column)
        return places


@dataclass(frozen=True, eq=False)
class ConditionChains:
    """The counts of first-order chains with back-off, of which one knows the condition and one does not.

    A plan's first action follows the beginning, which counts as an action of its own. Without the unit that is held
    out, n(a b) being how often b followed a in all blocks and n_k(a b) in those of condition k, with s = `SMOOTHING`::

        p(b)       = (n(b) + s / A) / (n + s)
        p(b | a)   = (n(a b) + s p(b)) / (n(a) + s)            the chain that does not know the condition
        p_k(b | a) = (n_k(a b) + s p(b | a)) / (n_k(a) + s)    the chain that does

    With strata, a and b are counted after a in the stratum of the block, and b alone in all.

    Attributes:
        unknown: float64 `[B]`: the log2-likelihood of each block under the chain that does not know the condition.
    """

    unknown: Tensor
    _cells: _Counts
    _rows: _Counts
    _blocks: Tensor  # int64 [B, S]: those of the unit of each block
    _prior: Tensor  # float64 [Z, 1]: p(b | a) without the unit

    @staticmethod
    def of(flat: FlatPlans, block: Tensor, unit: Tensor, stratum: Tensor) -> "ConditionChains":
        """From the actions of plans; `block [M]` of each; `unit [B]`, ascending, and `stratum [B]` of each block."""
        size, last = flat.num_actions, flat.actions.roll(1)
        last[torch.diff(flat.plan, prepend=flat.plan.new_full((1,), -1)) > 0] = size
        last += stratum[block] * (size + 1)
        codes, cell = (last * size + flat.actions).unique(return_inverse=True)
        starts, row = last.unique(return_inverse=True)
        actions, single = flat.actions.unique(return_inverse=True)
        sequences = torch.stack([codes.div(size, rounding_mode="floor"), codes % size], 1)
        # Blocks of a unit stand together, and each unit has as many.
        each = len(unit) // int(unit[-1] + 1)
        blocks = unit[:, None] * each + torch.arange(each)
        cells, rows, singles, whole = (_Counts.of(block, what, blocks) for what in (cell, row, single, 0 * block))
        first = rows.place(cells.block, torch.searchsorted(starts, sequences[:, 0].contiguous())[cells.column])
        second = singles.place(cells.block, torch.searchsorted(actions, sequences[:, 1].contiguous())[cells.column])
        every = torch.ones(len(unit), 1, dtype=torch.double)
        in_cells, in_rows, alone, total = (
            counts.without_unit(every, blocks) for counts in (cells, rows, singles, whole)
        )
        prior = (alone[second] + SMOOTHING / size) / (total[cells.block] + SMOOTHING)
        prior = (in_cells + SMOOTHING * prior) / (in_rows[first] + SMOOTHING)
        unknown = prior.new_zeros(len(unit)).index_add_(0, cells.block, cells.times * prior[:, 0].log2())
        return ConditionChains(unknown, cells, rows, blocks, prior)

    @property
    def cost(self) -> int:
        """Numbers that are computed for each labelling and condition."""
        return len(self._cells.times) + len(self._rows.times)

    def gains(self, labellings: Tensor, num: int) -> Tensor:
        """The log2-likelihood of each block under each condition's chain, less that under the one without.

        Args:
            labellings: integers `[B, P]`: the condition of each block.
            num: of conditions, C.

        Returns:
            float64 `[C, B, P]`, in bits.
        """
        gains = torch.empty(num, *labellings.shape, dtype=torch.double)
        size = max(CELLS_AT_ONCE // self.cost, 1)
        for at in range(0, labellings.shape[1], size):
            for condition in range(num):
                taken = (labellings[:, at : at + size] == condition).double()
                sums = torch.zeros_like(taken) - self.unknown[:, None]
                for counts, added, sign in ((self._cells, self._prior, 1), (self._rows, 1, -1)):
                    logs = counts.without_unit(taken, self._blocks).add_(SMOOTHING * added).log2_()
                    sums.index_add_(0, counts.block, logs.mul_(counts.times[:, None]), alpha=sign)
                gains[condition, :, at : at + size] = sums
        return gains
