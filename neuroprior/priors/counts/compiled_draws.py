"""Plans of a chain over few states, drawn several actions at a time from alias tables; importing this loads numba."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit, uint64

Array = np.ndarray[Any, Any]

PLANS = 4096
"""Plans that have random numbers of their own, however many threads draw them."""

_ODD, _FIRST, _SECOND = uint64(0x9E3779B97F4A7C15), uint64(0xBF58476D1CE4E5B9), uint64(0x94D049BB133111EB)


class Tables(NamedTuple):
    """What the next m actions, a *run*, are drawn with, in each of S states; there are K runs.

    Attributes:
        cut: uint64 `[S, K]`: of each column, in the higher half the share that is its own run's, times 2**32; in the
            lower half the run that has the rest.
        after: int32 `[S, K]`: the state after a run.
        actions: integers `[K]`: the actions of a run, one after the other in memory.
    """

    cut: Array
    after: Array
    actions: Array


def tables(probs: Array, after: Array, runs: Array) -> Tables:
    """Those of `probs [S, K]`, float64, whose rows sum to one (Walker 1977; Vose 1991).

    `runs [K, m]` are the actions; m times the bytes of an action is a power of two, at most 8.
    """
    whole = np.dtype(f"u{runs.shape[1] * runs.itemsize}")
    return Tables(_cuts(probs), after.astype(np.int32), np.ascontiguousarray(runs).view(whole)[:, 0])


@njit(cache=True)
def _cuts(probs: Array) -> Array:
    states, runs = probs.shape
    cut = np.empty((states, runs), np.uint64)
    share, small, large = np.empty(runs), np.empty(runs, np.int64), np.empty(runs, np.int64)
    for state in range(states):
        few, many = 0, 0
        for run in range(runs):
            share[run] = probs[state, run] * runs
            if share[run] < 1:
                small[few], few = run, few + 1
            else:
                large[many], many = run, many + 1
        while few > 0 and many > 0:
            low, high = small[few - 1], large[many - 1]
            few -= 1
            cut[state, low] = (uint64(share[low] * 2.0**32) << uint64(32)) | uint64(high)
            share[high] -= 1 - share[low]
            if share[high] < 1:
                many -= 1
                small[few], few = high, few + 1
        # But for rounding what is left fills its columns. A run of probability 0 has nothing of its own, though.
        for run in large[:many]:
            cut[state, run] = (uint64(2**32 - 1) << uint64(32)) | uint64(run)
        for run in small[:few]:
            best = np.argmax(probs[state])
            alias = run if probs[state, run] > 0 else best
            cut[state, run] = uint64(alias)
    return cut


@njit(nogil=True, cache=True, error_model="numpy")
def draw(table: Tables, start: Array, ends: Array, seed: int, first: int, plans: Array) -> None:
    """Draw plans `[n, R]` of R runs.

    Args:
        table: see there.
        start: `[M]`: states before the first runs.
        ends: int64 `[M]`, ascending: which plans begin in each, all before this number.
        seed: with `first` it says which random numbers are taken.
        first: the number of the first of these plans.
        plans: gets the actions of their runs.
    """
    cut, after, actions = table
    runs, low, random = uint64(cut.shape[1]), uint64(0xFFFFFFFF), uint64(seed) + uint64(first) * _SECOND
    root = np.searchsorted(ends, first, "right")
    for i in range(len(plans)):
        while first + i >= ends[root]:
            root += 1
        state = start[root]
        for r in range(plans.shape[1]):
            # splitmix64 (Steele, Lea and Flood 2014)
            random += _ODD
            mixed = (random ^ (random >> uint64(30))) * _FIRST
            mixed = (mixed ^ (mixed >> uint64(27))) * _SECOND
            mixed ^= mixed >> uint64(31)
            column = ((mixed >> uint64(32)) * runs) >> uint64(32)
            entry = cut[state, column]
            run = column if (mixed & low) < (entry >> uint64(32)) else entry & low
            plans[i, r] = actions[run]
            state = after[state, run]
