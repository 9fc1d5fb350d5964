"""Cost against size in `python -m eval bench`: seconds and memory as one size increases, all others fixed."""

import ctypes
import gc
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from eval.bench.timing import Run, seconds
from neuroprior import GRUPrior, MarkovPrior, SamplingPlanner, UniformPrior, gridworld

REPETITIONS = 3
"""Of each size; the median counts."""

LAST = 2
"""Decades over which the slope is taken, the largest ones: below, what every call costs hides it."""


@dataclass(frozen=True)
class Sweep:
    """A piece of work whose cost is measured as one size increases."""

    about: str  # what is done, and what is fixed
    sizes: tuple[int, ...]  # how large, at most
    make: Callable[[int], Run]  # prepares the work of a size; what it returns is timed


def decades(first: int, last: int) -> tuple[int, ...]:
    """Powers of ten."""
    return tuple(10**k for k in range(first, last + 1))


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def _chain(actions: int) -> MarkovPrior:
    return MarkovPrior(actions, 2).fit(torch.randint(actions, (1000, 16), generator=_generator()))


def _decide(starts: int) -> Run:
    world = gridworld(20, 20, "torus")
    state = world.reset(starts, _generator())
    return partial(SamplingPlanner(UniformPrior(4), 4, 4).plan, world, state, _generator())


def _sample(number: int) -> Run:
    return partial(_chain(4).sample, number, 8, generator=_generator())


def _sample_long(length: int) -> Run:
    return partial(_chain(4).sample, 100, length, generator=_generator())


def _fit_long(length: int) -> Run:
    plan = torch.randint(4, (1, length), dtype=torch.uint8, generator=_generator())
    return lambda: MarkovPrior(4, 2).fit(plan)


def _fit_and_sample(actions: int) -> Run:
    plans = torch.randint(actions, (10_000, 8), generator=_generator())
    return lambda: MarkovPrior(actions, 1).fit(plans).sample(10_000, 8, generator=_generator())


def _train(steps: int) -> Run:
    plans = torch.randint(4, (1000, 4), generator=_generator())
    return lambda: GRUPrior(4).fit(plans, max_steps=steps, patience=steps, progress=False, generator=_generator())


def _rollouts(height: int, width: int, worlds: int) -> Run:
    world = gridworld(height, width, "torus", num_worlds=worlds)
    state = world.reset(10_000, _generator())
    plans = UniformPrior(4).sample(640_000, 8, generator=_generator()).view(10_000, 64, 8)
    return partial(world.rollout, state, plans)


def _one_grid(states: int) -> Run:
    side = round(states**0.5)
    return _rollouts(side, math.ceil(states / side), 1)


SWEEPS = {
    "starts": Sweep("decide: 4 uniform plans of 4 steps from each start, 20 x 20 grid", decades(2, 7), _decide),
    "plans": Sweep("sample plans of length 8, Markov-2", decades(2, 7), _sample),
    "length": Sweep("fit Markov-2 on one plan", decades(2, 7), _fit_long),
    "length sampled": Sweep("sample 100 plans, Markov-2", decades(2, 4), _sample_long),
    "actions": Sweep("fit Markov-1 on 10,000 plans of length 8, and sample as many", decades(1, 4), _fit_and_sample),
    "steps": Sweep("train a GRU on 1,000 plans of length 4", decades(0, 3), _train),
    "states": Sweep("roll out 64 plans of 8 steps from 10,000 starts, one grid", decades(2, 7), _one_grid),
    "worlds": Sweep("the same in 10 x 10 grids", decades(2, 6), partial(_rollouts, 10, 10)),
}
"""By the size that increases."""


def measured(name: str, sweep: Sweep, most: float) -> Iterator[dict[str, Any]]:
    """A row for each size up to `most`: seconds, bytes of the result, and of all that the first call took at its peak.

    The bytes at the peak are those of the whole process beyond what it had before; None where the system has no count.
    """
    for size in sweep.sizes:
        if size > most:
            return
        run = sweep.make(size)
        _release()
        before = _memory("VmRSS", set_back=True)
        held = _bytes(run())
        most_held = _memory("VmHWM")
        row = {"growing": name, "about": sweep.about, "size": size}
        row |= {"seconds": median(seconds(run) for _ in range(REPETITIONS)), "result_bytes": held}
        yield row | {"peak_bytes": None if before is None or most_held is None else max(most_held - before, 0)}


def slope(rows: pd.DataFrame) -> float | None:
    """By what power of the size the time increases, over the largest sizes; None for fewer than two of them."""
    last = rows[rows["size"] >= rows["size"].iloc[-1] / 10**LAST][["size", "seconds"]].map(math.log)
    if len(last) < 2:
        return None
    size, seconds = last.iloc[-1] - last.iloc[0]
    return float(seconds / size)


def _bytes(result: Any) -> int:
    """Of all tensors in a result."""
    if isinstance(result, Tensor):
        return result.nbytes
    if isinstance(result, torch.nn.Module):
        return sum(buffer.nbytes for buffer in result.buffers())
    return sum(_bytes(value) for value in result) if isinstance(result, tuple) else 0


def _release() -> None:
    """Give the system back what is free, so that work that takes it again is counted."""
    gc.collect()
    with suppress(OSError, AttributeError):  # where there is no such library
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def _memory(what: str, set_back: bool = False) -> int | None:
    """A line of Linux's status of this process, in bytes; None on other systems.

    VmRSS is what it has, VmHWM the most that it had, which is set back to what it has if `set_back`.
    """
    try:
        if set_back:
            Path("/proc/self/clear_refs").write_text("5")
        status = Path("/proc/self/status").read_text()
        line = next(line for line in status.splitlines() if line.startswith(what))
    except (OSError, StopIteration):
        return None
    return int(line.split()[1]) * 1024
