"""Rollouts in tables without chance by a compiled loop: `TabularWorld` takes it where numba is installed."""

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

MANY = 2**20
"""Steps of a rollout that are worth loading numba, and compiling the loop where it was not kept from before."""


def worth_compiling(plans: Tensor, reward: Tensor) -> bool:
    """Whether the loop is there for plans `[B, P, L]`, and quicker even when it has to be loaded first."""
    plain = reward.dtype in (torch.float32, torch.float64) and not reward.requires_grad
    return plans.numel() >= MANY and plain and plans.device.type == "cpu" and _loop() is not None


def rollout(
    table: Tensor, reward: Tensor, cell: Tensor, offset: Tensor, plans: Tensor, keep_states: bool
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Follow plans through a table, each by itself.

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
    loop = _loop()
    assert loop is not None
    (batch, num_plans, length), rows = plans.shape, plans.shape[:2].numel()
    actions_of = (plans if plans.dtype == torch.uint8 else plans.long()).reshape(rows, length)
    threads = torch.get_num_threads()
    if batch < threads and num_plans % threads == 0:  # the threads share the plans of each start
        cell, offset = cell.repeat_interleave(threads), offset.repeat_interleave(threads)
        batch, num_plans = batch * threads, num_plans // threads
    given = [x.contiguous().numpy() for x in (table, reward.flatten(), cell, offset, actions_of)]
    last, gained = torch.empty(rows, dtype=torch.int64), torch.empty(rows, length, dtype=reward.dtype)
    states = torch.empty(rows, length if keep_states else 0, dtype=torch.int64)
    written = [x.numpy() for x in (last, gained, states)]
    sizes = num_plans, len(table) // reward.shape[1], reward.dim() == 2

    def part(begin: int, end: int) -> None:
        loop(*given, *sizes, begin, end, *written)

    edges = [batch * k // threads for k in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:  # the loop lets go of Python's lock
        list(pool.map(part, edges[:-1], edges[1:]))
    shaped = [x.view(*plans.shape[:2], *x.shape[1:]) for x in (last, gained, states)]
    return shaped[0], shaped[1], shaped[2] if keep_states else None


@cache
def _loop() -> Any:
    """The loop; None where numba is not installed, or does not work here."""
    if find_spec("numba") is None:
        return None
    try:
        return import_module("neuroprior.worlds.compiled_loop").follow
    except Exception:  # one that does not go with this numpy, or finds no place for what it compiles
        return None
