"""Plans drawn from Markov chains of a known order, for tests of the statistics of plans."""

from collections.abc import Iterator

import torch
from torch import Tensor

from neuroprior import Plans
from tests.support.sources import seeded


def markov_probs(num_actions: int, order: int, seed: int, spread: float = 1.0) -> Tensor:
    """`[A**order, A]`: random probabilities of each action after each history, oldest action first."""
    return (spread * torch.randn(num_actions**order, num_actions, generator=seeded(seed)).double()).softmax(-1)


def markov_plans(probs: Tensor, num_plans: int, length: int, seed: int, **more: object) -> Plans:
    """`num_plans` plans of a chain with `probs [A**k, A]`; their first k actions are uniform."""
    histories, num_actions = probs.shape
    generator, order = seeded(seed), round(torch.tensor(histories).log().div(torch.tensor(num_actions).log()).item())
    actions = torch.randint(num_actions, (num_plans, length), generator=generator)
    draws = torch.rand(length, num_plans, 1, generator=generator, dtype=torch.double)
    edges = (probs / probs.sum(1, keepdim=True)).double().cumsum(1)[:, :-1]
    base = num_actions ** torch.arange(order - 1, -1, -1)
    for t in range(order, length):
        history = (actions[:, t - order : t] * base).sum(1)
        actions[:, t] = (edges[history] < draws[t]).sum(1)
    return Plans(actions, num_actions, **more)


def null_sets(
    num_actions: int, order: int, num_sets: int, num_plans: int, length: int, spread: float = 1.0
) -> Iterator[Plans]:
    """Independent sets of plans of random chains, five sets to a chain."""
    for seed in range(num_sets // 5):
        plans = markov_plans(markov_probs(num_actions, order, seed, spread), 5 * num_plans, length, 1000 + seed)
        for i in range(5):
            yield plans[i * num_plans : (i + 1) * num_plans]
