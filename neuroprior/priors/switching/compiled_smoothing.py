"""Forward and backward passes by a compiled loop, for `neuroprior.priors.switching`; importing this loads numba."""

from typing import Any

import numpy as np
from numba import njit

Array = np.ndarray[Any, Any]


@njit(cache=True, nogil=True)
def smooth(
    initial: Array, steps: Array, likelihood: Array, tiny: float, totals: Array, after: Array, smoothed: Array,
    moved: Array,
) -> None:  # fmt: skip
    """What `neuroprior.priors.switching.forward_backward.smooth` returns, written into arrays.

    Args:
        initial: `[K]`.
        steps: `[N, L, K, K]`.
        likelihood: `[N, L, K]`.
        tiny: the least of what is divided by.
        totals: `[N, L]`: gets the likelihoods of actions.
        after, smoothed: `[N, L, K]`: get the filtered and the smoothed modes.
        moved: `[N, L - 1, K, K]`: gets the modes of successive actions.
    """
    num, length, modes = likelihood.shape
    # Single numbers are divided, not rows: compiling an operation on rows takes seconds.
    behind, weighted = np.empty(modes), np.empty(modes)
    for n in range(num):
        for t in range(length):
            total = 0.0
            for k in range(modes):
                predicted = 0.0
                for j in range(modes):
                    predicted += (initial[j] if t == 0 else after[n, t - 1, j]) * steps[n, t, j, k]
                after[n, t, k] = predicted * likelihood[n, t, k]
                total += after[n, t, k]
            totals[n, t] = max(total, tiny)
            for k in range(modes):
                after[n, t, k] /= totals[n, t]
        behind[:] = 1.0
        for t in range(length - 1, -1, -1):
            total = 0.0
            for k in range(modes):
                smoothed[n, t, k] = after[n, t, k] * behind[k]
                total += smoothed[n, t, k]
                weighted[k] = likelihood[n, t, k] * behind[k]
            for k in range(modes):
                smoothed[n, t, k] /= max(total, tiny)
            if t > 0:
                total = 0.0
                for j in range(modes):
                    for k in range(modes):
                        moved[n, t - 1, j, k] = after[n, t - 1, j] * steps[n, t, j, k] * weighted[k]
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
