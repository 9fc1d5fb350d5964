"""Short sequences of actions, counted in a table of all there could be."""

import torch
from torch import Tensor

from neuroprior.plans import Plans

MOST_GRAMS = 2**16
"""Sequences of actions that are counted in a table of all there could be."""


def few_grams(plans: Plans, depth: int) -> bool:
    """Whether there are so few sequences of `depth` + 1 actions that each may be counted first, and looked at once."""
    number = plans.num_actions ** (depth + 1)
    return 0 < depth < plans.max_length and number <= min(MOST_GRAMS, plans.actions.numel() // 4)


def grams(actions: Tensor, length: int, num_actions: int, size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """The sequences of `length` actions that occur in `actions [N, L]`, `size` rows at a time: `[n, length]`, `[n]`."""
    times = torch.zeros(num_actions**length, dtype=torch.long, device=device)
    last = actions.shape[1] - length + 1
    for part in actions.split(size):
        part = part.to(device)
        code = part[:, :last].to(torch.int32, copy=True)
        for place in range(1, length):
            code = code.mul_(num_actions).add_(part[:, place : place + last])
        times += code.flatten().bincount(minlength=len(times))
    codes = times.nonzero()[:, 0]
    base = num_actions ** torch.arange(length - 1, -1, -1, device=device)
    return codes[:, None] // base % num_actions, times[codes]
