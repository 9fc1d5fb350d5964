"""Weights of patterns learned by a compiled loop, for `LogLinearPrior`."""

from typing import Any

import numpy as np
from numba import njit

Array = np.ndarray[Any, Any]

MIXER = 0x9E3779B97F4A7C15
"""An odd number near 2**64 over the golden ratio: multiplied by it, near numbers fall far apart."""


@njit(cache=True, nogil=True)
def place(codes: Array, code: Any) -> Any:
    """Where `code` stands in a hash table of `codes` (as many as a power of 2; -1: free), or the free place for it."""
    mask = np.uint64(len(codes) - 1)
    at = ((np.uint64(code) * np.uint64(MIXER)) >> np.uint64(32)) & mask
    while codes[at] != code and codes[at] != -1:
        at = (at + np.uint64(1)) & mask
    return np.int64(at)


def hash_table(codes: Array, values: Array) -> tuple[Array, Array]:
    """The codes `[V]` in a hash table of at least 2V places, and their `values [V, C]` in the same places."""
    size = 2 ** int(2 * len(codes) + 1).bit_length()
    places, placed = np.full(size, -1, dtype=np.int64), np.zeros((size, *values.shape[1:]), dtype=values.dtype)
    _enter(places, placed, codes, values)
    return places, placed


def frequent(patterns: Array, min_count: int) -> Array:
    """The codes that occur at least `min_count` times in `patterns`, integers `[M, F]`; sorted, int32."""
    size = 2**16
    codes, counts = np.full(size, -1, dtype=np.int64), np.zeros(size, dtype=np.int32)
    used = 0
    for at in range(0, len(patterns), 4096):
        chunk = patterns[at : at + 4096]
        while (used + chunk.size) * 4 > len(codes) * 3:  # room for all that could be new
            codes, counts = _larger(codes, counts)
        used += _count(codes, counts, chunk)
    return np.sort(codes[counts >= min_count]).astype(np.int32)


def number_patterns(vocabulary: Array, patterns: Array) -> Array:
    """The row of each of `patterns [M, F]` in a sorted vocabulary `[V]`, V for those that are not in it; int32."""
    codes, rows = hash_table(vocabulary, np.arange(len(vocabulary), dtype=np.int32))
    out = np.empty(patterns.shape, dtype=np.int32)
    _look_up(codes, rows, len(vocabulary), patterns, out)
    return out


@njit(cache=True, nogil=True)
def _count(codes: Array, counts: Array, patterns: Array) -> int:
    new = 0
    for i in range(patterns.shape[0]):
        for j in range(patterns.shape[1]):
            at = place(codes, patterns[i, j])
            if codes[at] == -1:
                codes[at] = patterns[i, j]
                new += 1
            counts[at] += 1
    return new


@njit(cache=True, nogil=True)
def _larger(codes: Array, counts: Array) -> tuple[Array, Array]:
    more, kept = np.full(2 * len(codes), -1, dtype=np.int64), np.zeros(2 * len(codes), dtype=np.int32)
    for i in range(len(codes)):
        if codes[i] != -1:
            at = place(more, codes[i])
            more[at], kept[at] = codes[i], counts[i]
    return more, kept


@njit(cache=True, nogil=True)
def _enter(places: Array, placed: Array, codes: Array, values: Array) -> None:
    for i in range(len(codes)):
        at = place(places, codes[i])
        places[at], placed[at] = codes[i], values[i]


@njit(cache=True, nogil=True)
def _look_up(codes: Array, rows: Array, unknown: int, patterns: Array, out: Array) -> None:
    for i in range(patterns.shape[0]):
        for j in range(patterns.shape[1]):
            at = place(codes, patterns[i, j])
            out[i, j] = rows[at] if codes[at] != -1 else unknown


@njit(cache=True, nogil=True)
def epoch(
    order: Array,
    rows: Array,
    last: Array,
    action: Array,
    counts: Array,
    weights: Array,
    after: Array,
    weight_squares: Array,
    after_squares: Array,
    rate: float,
    l2: float,
    learn: bool,
    losses: Array,
) -> None:
    """One pass over steps by Adagrad, one step after the other; all parameters are changed in place.

    Args:
        order: int64 `[m]`: the steps, in this order.
        rows: int32 `[M, F]`: the rows of the active patterns; the last row of the tables is for unknown ones.
        last: int `[M]`: the row of `after` for the actions before.
        action: int `[M]`: the action that was chosen.
        counts: float32 `[M]`: how much each step counts.
        weights: float32 `[V + 1, A]`: what each pattern adds to the logits; its last row stays 0.
        after: float32 `[., A]`: what the last actions add.
        weight_squares, after_squares: sums of squared gradients of these.
        rate, l2: learning rate, and the penalty of weights.
        learn: False: nothing is changed.
        losses: float64 `[M]`: gets the log-loss of each of these steps, nats, before it was learned from.
    """
    unknown, actions = len(weights) - 1, weights.shape[1]
    logits, errors = np.empty(actions), np.empty(actions, dtype=np.float32)
    step, decay = np.float32(rate), np.float32(l2)
    for i in order:
        for a in range(actions):
            logits[a] = after[last[i], a]
        for row in rows[i]:
            if row != unknown:
                for a in range(actions):
                    logits[a] += weights[row, a]
        top = logits.max()
        total = 0.0
        for a in range(actions):
            total += np.exp(logits[a] - top)
        chosen = action[i]
        losses[i] = top + np.log(total) - logits[chosen]
        if not learn:
            continue
        for a in range(actions):
            g = np.float32(counts[i] * (np.exp(logits[a] - top) / total - (1.0 if a == chosen else 0.0)))
            errors[a] = g
            after_squares[last[i], a] += g * g
            after[last[i], a] -= step * g / np.sqrt(after_squares[last[i], a])
        for row in rows[i]:
            if row != unknown:
                for a in range(actions):
                    g = errors[a] + decay * weights[row, a]
                    weight_squares[row, a] += g * g
                    weights[row, a] -= step * g / np.sqrt(weight_squares[row, a])
