"""The loop that `compiled` runs; to import it loads numba."""

from typing import Any

import numpy as np
from numba import njit

Array = np.ndarray[Any, Any]


@njit(nogil=True, cache=True)
def follow(
    table: Array,
    reward: Array,
    cell: Array,
    offset: Array,
    plans: Array,
    num_plans: int,
    actions: int,
    on_arrival: bool,
    begin: int,
    end: int,
    last: Array,
    gained: Array,
    states: Array,
) -> None:
    """Follow the plans of the starts from `begin` to `end`, of which each has `num_plans`; see `compiled.rollout`.

    Writes to `last [N]`, `gained [N, L]` and, unless it is empty, `states [N, L]`.
    """
    keep = states.shape[1] > 0
    each = np.uintp(actions)
    for start in range(begin, end):
        # Numbers without a sign are quicker to index with.
        first, more = np.uintp(cell[start]), np.uintp(offset[start])
        for row in range(start * num_plans, (start + 1) * num_plans):
            now = first
            for t in range(plans.shape[1]):
                taken = now * each + np.uintp(plans[row, t])
                now = np.uintp(table[taken])
                gained[row, t] = reward[now + more] if on_arrival else reward[taken + more * each]
                if keep:
                    states[row, t] = now + more
            last[row] = now + more
