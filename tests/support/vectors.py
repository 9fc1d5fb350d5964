"""A small world, a small prior and plans of vectors."""

import torch

from neuroprior.control import ContinuousWorld, GaussianForecast, VectorPlans, VectorPrior
from tests.support.sources import seeded


class Cart(ContinuousWorld):
    """A cart at position x with velocity v, which forces push towards 0: two of them, as different as their bounds.

    A state is `[x, v, t]`; with `last`, runs end after so many steps, or beyond |x| = `edge`.
    """

    def __init__(self, last=None, edge=float("inf")):
        self.action_low, self.action_high = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 0.5])
        self.last, self.edge = last, edge

    def reset(self, batch_size, generator=None):
        state = torch.randn(batch_size, 3, generator=generator)
        state[:, 2] = 0
        return state

    def step(self, state, action, generator=None):
        x, v, t = state.unbind(1)
        over = self.terminated(state)
        v = v + 0.3 * (action[:, 0] - action[:, 1] + 0.25)
        x = x + 0.3 * v
        reward = -(x.square() + 0.1 * v.square() + 0.01 * action.square().sum(1))
        after = torch.stack([x, v, t + 1], 1)
        return torch.where(over[:, None], state, after), reward.masked_fill(over, 0)

    def terminated(self, state):
        over = state[:, 0].abs() > self.edge
        return over if self.last is None else over | (state[:, 2] >= self.last)


class Drift(VectorPrior):
    """The next vector is near the last one, at first near the middle; with a context, near what its first number is."""

    memory = 1

    def __init__(self, action_low, action_high, context_size=None, std=0.1):
        super().__init__(action_low, action_high, context_size)
        self.std = std

    def start(self, batch_size, context=None):
        middle = ((self.action_low + self.action_high) / 2).expand(batch_size, -1)
        return self._forecast(middle if context is None else middle + context[:, :1])

    def step(self, action, state, context=None):
        return self._forecast(action)

    def _forecast(self, mean):
        std = torch.tensor(self.std).expand_as(mean)[:, None]
        return GaussianForecast(mean[:, None], std, self.action_low, self.action_high), mean

    def fit(self, plans, *, generator=None):
        self.training_plans(plans)
        return self


def drift(world, **how):
    return Drift(world.action_low, world.action_high, **how)


def walks(num, length, size, seed):
    """Stationary autoregressions of order 1, of standard deviation .15."""
    values = [torch.zeros(num, size)]
    for noise in torch.randn(length + 50, num, size, generator=seeded(seed)):
        values.append(0.95 * values[-1] + (1 - 0.95**2) ** 0.5 * noise)
    return VectorPlans((0.15 * torch.stack(values[-length:], 1)).clamp(-1, 1), [-1.0] * size, [1.0] * size)
