"""Weights of patterns learned by a compiled loop, for the priors of `neuroprior.puzzles.priors`; this loads numba."""

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


def frequent(parts: list[Array], min_count: int) -> Array:
    """The codes that occur at least `min_count` times in `parts` (integers `[M, F]` each), sorted, int32."""
    size = 2**16
    codes, counts = np.full(size, -1, dtype=np.int64), np.zeros(size, dtype=np.int32)
    used = 0
    for part in parts:
        for at in range(0, len(part), 4096):
            while (used + part[at : at + 4096].size) * 4 > len(codes) * 3:  # room for all that could be new
                codes, counts = _larger(codes, counts)
            used += _count(codes, counts, part[at : at + 4096])
    return np.sort(codes[counts >= min_count]).astype(np.int32)


def numbered(vocabulary: Array, patterns: Array) -> Array:
    """The row of each of `patterns [M, F]` in a sorted vocabulary `[V]`, V for those that are not in it; int32."""
    codes, rows = hash_table(vocabulary, np.arange(len(vocabulary), dtype=np.int32))
    out = np.empty(patterns.shape, dtype=np.int32)
    _look_up(codes, rows, len(vocabulary), patterns, out)
    return out


@njit(cache=True, nogil=True)
def _count(codes: Array, counts: Array, part: Array) -> int:
    new = 0
    for i in range(part.shape[0]):
        for j in range(part.shape[1]):
            at = place(codes, part[i, j])
            if codes[at] == -1:
                codes[at] = part[i, j]
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
    embeddings: Array,
    layers: Array,
    biases: Array,
    out: Array,
    squares: tuple[Array, Array, Array, Array, Array, Array],
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
        embeddings: float32 `[V + 1, E]`: E = 0: no network.
        layers, biases, out: float32 `[D, E, E]`, `[D, E]`, `[A, E]`: the network on the sum of the embeddings.
        squares: sums of squared gradients of these six; of embeddings `[V + 1]`, one number a row.
        rate, l2: learning rate, and the penalty of weights and embeddings.
        learn: False: nothing is changed.
        losses: float64 `[M]`: gets the log-loss of each of these steps, nats, before it was learned from.
    """
    unknown, actions, size, depth = len(weights) - 1, weights.shape[1], embeddings.shape[1], len(layers)
    logits, errors = np.empty(actions), np.empty(actions, dtype=np.float32)
    hidden = np.empty((depth + 1, size), dtype=np.float32)
    back, further = np.empty(size, dtype=np.float32), np.empty(size, dtype=np.float32)
    w2, a2, e2, l_2, b2, o2 = squares
    step, decay = np.float32(rate), np.float32(l2)
    for i in order:
        for a in range(actions):
            logits[a] = after[last[i], a]
        hidden[0] = 0
        for row in rows[i]:
            if row != unknown:
                for a in range(actions):
                    logits[a] += weights[row, a]
                for e in range(size):
                    hidden[0, e] += embeddings[row, e]
        for k in range(depth):
            for e in range(size):
                total = biases[k, e]
                for f in range(size):
                    total += layers[k, e, f] * max(hidden[k, f], np.float32(0))
                hidden[k + 1, e] = total
        for a in range(actions):
            for e in range(size):
                logits[a] += out[a, e] * max(hidden[depth, e], np.float32(0))
        top = logits.max()
        total = 0.0
        for a in range(actions):
            total += np.exp(logits[a] - top)
        chosen = action[i]
        losses[i] = top + np.log(total) - logits[chosen]
        if not learn:
            continue
        for a in range(actions):
            errors[a] = counts[i] * (np.exp(logits[a] - top) / total - (1.0 if a == chosen else 0.0))
        back[:] = 0
        for a in range(actions):
            g = errors[a]
            a2[last[i], a] += g * g
            after[last[i], a] -= step * g / np.sqrt(a2[last[i], a])
            for e in range(size):
                lit = max(hidden[depth, e], np.float32(0))
                if lit > 0:
                    back[e] += g * out[a, e]
                    o2[a, e] += g * g * lit * lit
                    out[a, e] -= step * g * lit / np.sqrt(o2[a, e])
        for k in range(depth - 1, -1, -1):
            further[:] = 0
            for e in range(size):
                g = back[e]
                if g == 0:
                    continue
                b2[k, e] += g * g
                biases[k, e] -= step * g / np.sqrt(b2[k, e])
                for f in range(size):
                    lit = max(hidden[k, f], np.float32(0))
                    if lit > 0:
                        further[f] += g * layers[k, e, f]
                        l_2[k, e, f] += g * g * lit * lit
                        layers[k, e, f] -= step * g * lit / np.sqrt(l_2[k, e, f])
            back[:] = further
        norm = np.float32(0)
        for e in range(size):
            norm += back[e] * back[e]
        for row in rows[i]:
            if row != unknown:
                for a in range(actions):
                    g = errors[a] + decay * weights[row, a]
                    w2[row, a] += g * g
                    weights[row, a] -= step * g / np.sqrt(w2[row, a])
                if size > 0:
                    e2[row] += norm / size
                    scale = step / np.sqrt(e2[row])
                    for e in range(size):
                        embeddings[row, e] -= scale * (back[e] + decay * embeddings[row, e])
