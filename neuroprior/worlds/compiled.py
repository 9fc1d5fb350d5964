"""Rollouts in deterministic tables by a compiled loop, for `TabularWorld.rollout`; importing this loads numba."""

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from neuroprior._memory import new_empty
from neuroprior._threads import share

Array = np.ndarray[Any, Any]

PARTS, LEAST_STEPS = 8, 2**15
"""Parts that each thread follows, one after the other, so that none waits long for another that a busy machine holds
up; and the fewest steps of each part.
"""


def rollout(
    table: Tensor, reward: Tensor, cell: Tensor, offset: Tensor, plans: Tensor, keep_states: bool
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Follow plans through a deterministic table.

    Args:
        table: int32 `[S * A]`: the cell that each action leads to.
        reward: `[W, S]` on arrival, or `[W, S, A]` on acting.
        cell: `[B]`: where plans start.
        offset: `[B]`: the reward map times S.
        plans: integers `[B, P, L]`.
        keep_states: also give the state after each step.

    Returns:
        The final states `[B, P]`, int64, the rewards `[B, P, L]`, and the states `[B, P, L]` or None.
    """
    (batch, num_plans, length), rows = plans.shape, plans.shape[:2].numel()
    actions_of = (plans if plans.dtype == torch.uint8 else plans.long()).reshape(rows, length)
    threads = torch.get_num_threads()
    if batch < threads and num_plans % threads == 0:  # the threads share the plans of each start
        cell, offset = cell.repeat_interleave(threads), offset.repeat_interleave(threads)
        batch, num_plans = batch * threads, num_plans // threads
    inputs = [x.contiguous().numpy() for x in (table, reward.flatten(), cell, offset, actions_of)]
    last, gained = new_empty((rows,), plans, torch.int64), new_empty((rows, length), reward)
    states = new_empty((rows, length if keep_states else 0), plans, torch.int64)
    written = [x.numpy() for x in (last, gained, states)]
    sizes = num_plans, len(table) // reward.shape[1], reward.dim() == 2

    def follow_between(edges: tuple[int, int]) -> None:
        _follow(*inputs, *sizes, *edges, *written)

    number = max(min(PARTS * threads, batch, plans.numel() // LEAST_STEPS), 1)
    share(follow_between, list(pairwise(batch * k // number for k in range(number + 1))))
    shaped = [x.view(*plans.shape[:2], *x.shape[1:]) for x in (last, gained, states)]
    return shaped[0], shaped[1], shaped[2] if keep_states else None


def _loop(
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
    """Follow the plans of the starts from `begin` to `end`, of which each has `num_plans`; see `rollout`.

    Writes to `last [N]`, `gained [N, L]` and, unless it is empty, `states [N, L]`.
    """
    keep = states.shape[1] > 0
    each = np.uintp(actions)
    for start in range(begin, end):
        # Unsigned integers are faster to index with.
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


_follow: Any = njit(nogil=True, cache=True)(_loop)
