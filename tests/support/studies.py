"""Simulated studies: animals with habits of their own, in several sessions, under conditions."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from neuroprior import Plans
from neuroprior.behaviour.recorded_plans import RecordedPlans
from tests.support.sources import seeded


def study(
    seed: int,
    conditions: Sequence[Sequence[int]],
    length: int = 60,
    num_actions: int = 5,
    habit: float = 0.7,
    change: Callable[[Tensor, Tensor], None] | None = None,
    slower: dict[int, float] | None = None,
) -> Plans:
    """Sessions of first-order chains and log-normal dwell times, both of which differ from animal to animal.

    Args:
        seed: of everything.
        conditions: the condition of each session of each animal.
        length: actions in each session.
        num_actions: A.
        habit: standard deviation over animals of the logits of transitions, and of the log dwell times.
        change: changes the probabilities `[sessions, A, A]` in place, given the conditions `[sessions]`.
        slower: by action, how many times as long it takes in condition 1.
    """
    generator = seeded(seed)
    animal = torch.tensor([number for number, own in enumerate(conditions) for _ in own])
    condition = torch.tensor([label for own in conditions for label in own])
    common = torch.randn(num_actions, num_actions, generator=generator)
    own = habit * torch.randn(len(conditions), num_actions, num_actions, generator=generator)
    probs = (common + own).softmax(-1)[animal]
    if change is not None:
        change(probs, condition)
    edges = probs.cumsum(-1)[..., :-1]
    actions = torch.randint(num_actions, (len(animal), length), generator=generator)
    draws = torch.rand(length, len(animal), 1, generator=generator)
    for t in range(1, length):
        actions[:, t] = (edges[torch.arange(len(animal)), actions[:, t - 1]] < draws[t]).sum(1)
    pace = habit * torch.randn(len(conditions), num_actions, generator=generator)
    logs = pace[animal[:, None], actions] + 0.5 * torch.randn(actions.shape, generator=generator)
    for action, times in (slower or {}).items():
        logs += torch.tensor(times).log() * ((actions == action) & (condition == 1)[:, None])
    names = [f"drug {label}" for label in range(int(condition.max()) + 1)]
    return RecordedPlans(
        actions, num_actions, group=animal, condition=condition, condition_names=names, durations=logs.exp()
    )


def between(animals: int, sessions: int = 4, num: int = 2) -> list[list[int]]:
    """Each animal under one condition."""
    return [[animal % num] * sessions for animal in range(animals)]


def within(animals: int, sessions: int = 4, num: int = 2) -> list[list[int]]:
    """Each animal under all conditions."""
    return [[session % num for session in range(sessions)] for _ in range(animals)]
