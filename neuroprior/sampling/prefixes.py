"""Plans that are drawn one by one, and of which those that begin alike are stepped once."""

import torch
from torch import Tensor

from neuroprior.sampling.rows import rows_of


class Prefixes:
    """Which of the distinct prefixes each of N plans has, as the plans grow action by action.

    As soon as more than half of the plans have a prefix of their own, each gets one, for the rest of its length.

    Args:
        row: integers `[N]`: which of the prefixes each plan has.
        num_prefixes: K.
        num_actions: A.
        shared: False: each plan gets a prefix of its own at the first action.

    Attributes:
        row: `[N]`, which of the present prefixes each plan has; None: plan i has prefix i.
    """

    def __init__(self, row: Tensor, num_prefixes: int, num_actions: int, shared: bool = True) -> None:
        self.row: Tensor | None = row
        self._number, self._num_actions, self._shared = num_prefixes, num_actions, shared

    def of_each(self, values: Tensor) -> Tensor:
        """What belongs to each plan, `[N, ...]`, of what belongs to each prefix, `[K, ...]`."""
        return values if self.row is None else rows_of(values, self.row)

    def extend(self, action: Tensor) -> tuple[Tensor | None, Tensor]:
        """Let every plan go on with its `action [N]`.

        Returns:
            `parent [K']`, the prefix that each of the new ones continues, or None where prefix i continues prefix i;
            and the actions `[K']` that the new prefixes end with.
        """
        row = self.row
        if row is None:
            return None, action
        if self._shared and 2 * self._number <= len(row):
            pair = row.long() * self._num_actions + action
            begun = torch.zeros(self._number * self._num_actions, dtype=torch.bool, device=row.device)
            begun[pair] = True
            pairs = begun.nonzero()[:, 0]
            if 2 * len(pairs) <= len(row):
                number = torch.empty(len(begun), dtype=row.dtype, device=row.device)
                number[pairs] = torch.arange(len(pairs), dtype=row.dtype, device=row.device)
                self.row, self._number = number.index_select(0, pair), len(pairs)
                return pairs // self._num_actions, pairs % self._num_actions
        self.row = None
        return row, action
