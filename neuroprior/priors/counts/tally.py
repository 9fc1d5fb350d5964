"""Counts of codes, of which most that could be never occur."""

import torch
from torch import Tensor


class Tally:
    """How often each code was met."""

    def __init__(self, device: torch.device) -> None:
        none = torch.zeros(0, dtype=torch.long, device=device)
        self.parts = [(none, none)]
        self.size = self.merged = 0

    def add(self, codes: Tensor, below: int, times: Tensor | None = None) -> None:
        """Count `codes [n]`, all of them under `below` and each `times [n]`; None: once."""
        if times is not None:
            distinct, counts, _ = merge([(codes, times)])
        elif below <= 4 * len(codes) + 2**16:
            table = codes.bincount()
            distinct = table.nonzero()[:, 0]
            counts = table[distinct]
        else:
            distinct, counts = torch.unique(codes, return_counts=True)
        self.parts.append((distinct, counts))
        self.size += len(distinct)
        if self.size > 2 * self.merged + 2**20:
            distinct, counts, _ = merge(self.parts)
            self.parts, self.size, self.merged = [(distinct, counts)], len(distinct), len(distinct)


def number(codes: Tensor, below: int) -> tuple[Tensor, Tensor]:
    """The distinct codes, all under `below`, in ascending order, and the rank among them of each code."""
    if below > 4 * len(codes) + 2**16:
        distinct, rank = torch.unique(codes, return_inverse=True)
        return distinct, rank
    present = torch.zeros(below, dtype=torch.bool, device=codes.device)
    present[codes] = True
    return present.nonzero()[:, 0], (present.cumsum(0) - 1)[codes]


def merge(parts: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """The distinct codes of the parts in ascending order, the sum of their counts, and in how many places each was."""
    codes, counts = (torch.cat(values) for values in zip(*parts, strict=True))
    distinct, rank, places = torch.unique(codes, return_inverse=True, return_counts=True)
    return distinct, torch.zeros_like(distinct).index_add_(0, rank, counts), places
