"""The sequences of n actions that a Markov chain of order n - 2 can be tested with, and the counts of their parts."""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior.analysis.windows import Line, ranks

FEWEST = 5
"""A sequence is tested where both its parts occurred so often; an absent one is listed where so many were expected."""

PAIRS_AT_ONCE = 2**20
"""Pairs of parts that are looked at together; memory is bounded by it."""


def middles(line: Line, lengths: list[int]) -> Iterator[tuple[int, Tensor]]:
    """For each n the rank of the n - 2 actions that begin at each place of the line, for places that have so many."""
    rank = torch.zeros_like(line.actions)
    for size in range(lengths[-1] - 1):
        if size:
            rest = line.actions[size - 1 :]
            rank = ranks(rank[: len(rest)] * line.num_actions + rest)
        if size + 2 in lengths:
            yield size + 2, rank


class Windows(NamedTuple):
    """The W windows of n actions of one plan whose middle occurred often enough for a test."""

    kept: Tensor  # int64 [W]: which of all windows of n actions these are
    start: Tensor  # int64 [W]: on the line
    middle: Tensor  # int64 [W]: a rank
    head: Tensor  # int64 [W]: the rank of the first n - 1 actions among those of all windows
    tail: Tensor  # int64 [W]: of the last n - 1
    head_code: Tensor  # int64, ascending: middle * A + first action of each head
    tail_code: Tensor  # int64, ascending: middle * A + last action of each tail

    @staticmethod
    def of(line: Line, length: int, start: Tensor, middle: Tensor) -> "Windows":
        """Those that begin at `start`; `middle [M]` is the rank of the n - 2 actions from each place of the line."""
        rank = middle[start + 1]
        kept = (rank.bincount()[rank] > FEWEST).nonzero()[:, 0] if len(rank) else rank
        start, rank = start[kept], ranks(rank[kept])
        head_code, head = (rank * line.num_actions + line.actions[start]).unique(return_inverse=True)
        tail_code, tail = (rank * line.num_actions + line.actions[start + length - 1]).unique(return_inverse=True)
        return Windows(kept, start, rank, head, tail, head_code, tail_code)


class Words(NamedTuple):
    """The K sequences of n actions that are listed; `tests` were tested."""

    middle: Tensor  # int64 [K]; this and the next three are numbers in `Windows`
    head: Tensor
    tail: Tensor
    of_window: Tensor  # int64 [W]: the sequence of each window; K where it was not tested
    counts: Tensor  # int64 [K]
    total: Tensor  # int64 [K]: of the middle
    heads: Tensor  # int64 [K]: of the first n - 1 actions
    tails: Tensor  # int64 [K]: of the last n - 1
    tests: int


def candidates(windows: Windows, num_actions: int) -> Words:
    """The sequences that are tested: every head with every tail of the same middle, some heads at a time."""
    total, heads, tails = (rank.bincount() for rank in (windows.middle, windows.head, windows.tail))
    codes, rank, counts = (windows.head * len(tails) + windows.tail).unique(return_inverse=True, return_counts=True)
    parts, tests = [], 0
    for head, tail in _pairs(windows, heads, tails, total, num_actions):
        tests += len(head)
        at = torch.searchsorted(codes, head * len(tails) + tail).clamp(max=max(len(codes) - 1, 0))
        count = torch.where(codes[at] == head * len(tails) + tail, counts[at], 0)
        middle = windows.head_code[head].div(num_actions, rounding_mode="floor")
        listed = (count > 0) | (heads[head].double() * tails[tail] >= FEWEST * total[middle])
        at = torch.where(count > 0, at, len(codes))
        parts.append([values[listed] for values in (middle, head, tail, count, at)])
    none = windows.middle[:0]
    middle, head, tail, count, at = (torch.cat(values) for values in zip([none] * 5, *parts, strict=True))
    number = codes.new_full((len(codes) + 1,), len(head))
    number[at[count > 0]] = torch.arange(len(head), device=head.device)[count > 0]
    return Words(middle, head, tail, number[rank], count, total[middle], heads[head], tails[tail], tests)


def _pairs(
    windows: Windows, heads: Tensor, tails: Tensor, total: Tensor, num_actions: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """The heads and tails that share a middle and are often enough, but not always there; heads ascending."""
    of_head = windows.head_code.div(num_actions, rounding_mode="floor")
    of_tail = windows.tail_code.div(num_actions, rounding_mode="floor")
    head = ((heads >= FEWEST) & (heads < total[of_head])).nonzero()[:, 0]
    tail = ((tails >= FEWEST) & (tails < total[of_tail])).nonzero()[:, 0]
    partners = of_tail[tail].bincount(minlength=len(total))
    first = (partners.cumsum(0) - partners)[of_head[head]]
    partners = partners[of_head[head]]
    block = partners.cumsum(0).div(PAIRS_AT_ONCE, rounding_mode="floor")
    sizes = block.unique_consecutive(return_counts=True)[1].tolist()
    for some, number, at in zip(*(values.split(sizes) for values in (head, partners, first)), strict=True):
        which = torch.arange(len(some), device=some.device).repeat_interleave(number)
        place = torch.arange(len(which), device=some.device) - (number.cumsum(0) - number)[which]
        yield some[which], tail[at[which] + place]
