"""Forward and backward passes over sequences of hidden modes; importing this loads numba."""

from typing import Any

import numpy as np
from numba import njit

Array = np.ndarray[Any, Any]


@njit(cache=True, nogil=True)
def filter_modes(
    initial: Array, steps: Array, likelihood: Array, tiny: float, predicted: Array, filtered: Array, totals: Array
) -> None:
    """Write the modes given the actions before each step, and given this action, too.

    Args:
        initial: `[K]`.
        steps: `[N, L, K, K]`.
        likelihood: `[N, L, K]`.
        tiny: the least of what is divided by.
        predicted, filtered: `[N, L, K]`: get the modes before and after each action.
        totals: `[N, L]`: gets the likelihood of each action given those before it.
    """
    num, length, modes = likelihood.shape
    # Single numbers are divided, not rows: compiling an operation on rows takes seconds.
    for n in range(num):
        for t in range(length):
            total = 0.0
            for k in range(modes):
                before = 0.0
                for j in range(modes):
                    before += (initial[j] if t == 0 else filtered[n, t - 1, j]) * steps[n, t, j, k]
                predicted[n, t, k] = before
                filtered[n, t, k] = before * likelihood[n, t, k]
                total += filtered[n, t, k]
            totals[n, t] = max(total, tiny)
            for k in range(modes):
                filtered[n, t, k] /= totals[n, t]


@njit(cache=True, nogil=True)
def smooth_modes(steps: Array, likelihood: Array, tiny: float, filtered: Array, smoothed: Array, moved: Array) -> None:
    """Write the modes given whole sequences, from those that `filter_modes` found.

    Args:
        steps, likelihood, tiny, filtered: see there.
        smoothed: `[N, L, K]`: gets the modes.
        moved: `[N, L - 1, K, K]`: gets the modes of successive actions.
    """
    num, length, modes = likelihood.shape
    behind, weighted = np.empty(modes), np.empty(modes)
    for n in range(num):
        behind[:] = 1.0
        for t in range(length - 1, -1, -1):
            total = 0.0
            for k in range(modes):
                smoothed[n, t, k] = filtered[n, t, k] * behind[k]
                total += smoothed[n, t, k]
                weighted[k] = likelihood[n, t, k] * behind[k]
            for k in range(modes):
                smoothed[n, t, k] /= max(total, tiny)
            if t > 0:
                total = 0.0
                for j in range(modes):
                    for k in range(modes):
                        moved[n, t - 1, j, k] = filtered[n, t - 1, j] * steps[n, t, j, k] * weighted[k]
                        total += moved[n, t - 1, j, k]
                for j in range(modes):
                    for k in range(modes):
                        moved[n, t - 1, j, k] /= max(total, tiny)
            total = 0.0
            for j in range(modes):
                behind[j] = 0.0
                for k in range(modes):
                    behind[j] += steps[n, t, j, k] * weighted[k]
                total += behind[j]
            for j in range(modes):
                behind[j] /= max(total, tiny)
