"""iCEM and MPPI against their papers' formulae, written out with numpy for one start, on the same random numbers."""

import numpy as np
import pytest
import torch

from neuroprior.control import ICEMPlanner, MPPIPlanner, coloured_noise
from tests.support.sources import seeded
from tests.support.vectors import Cart

LENGTH = 7


def score(world, state, plans):
    """The returns of `plans [P, L, D]` from one state."""
    found = world.rollout(state[None], torch.tensor(plans, dtype=torch.float32)[None])
    return found.rewards[0].sum(-1).numpy().astype(float)


def bounds(world):
    low, high = world.action_low.numpy().astype(float), world.action_high.numpy().astype(float)
    return low, high, (low + high) / 2, (high - low) / 2


@pytest.mark.parametrize("cost", [False, True])
@pytest.mark.parametrize(("temperature", "normalise"), [(0.5, False), (20.0, False), (0.3, True)])
def test_mppi_is_the_algorithm_over_several_decisions(cost, temperature, normalise):
    """Algorithm 2 of Williams et al. (2017): weights exp(-(S - min S) / lambda), S with lambda u' Sigma^-1 e."""
    world = Cart()
    low, high, middle, half = bounds(world)
    planner = MPPIPlanner(LENGTH, 12, std=0.6, temperature=temperature, normalise=normalise, control_cost=cost)
    sigma, mean = 0.6 * half, np.tile(middle, (LENGTH, 1))
    state, memory, ours, theirs = world.reset(1, seeded(5)), None, seeded(6), seeded(6)
    for number in range(3):
        decision = planner.plan(world, state, ours, memory)
        plans = np.clip(mean + sigma * torch.randn(12, LENGTH, 2, generator=theirs).numpy(), low, high)
        values = score(world, state[0], plans)
        loss = -values / (values.std() if normalise else 1)
        if cost:
            loss = loss + temperature * ((mean - middle) / sigma**2 * (plans - mean)).sum((1, 2))
        weights = np.exp(-(loss - loss.min()) / temperature)
        mean = mean + np.einsum("k,ktd->td", weights / weights.sum(), plans - mean)
        # The rounding of float32 is carried on from average to average.
        np.testing.assert_allclose(decision.plan[0], mean, atol=1e-5 if number else 1e-6)
        np.testing.assert_allclose(decision.score[0], values.max(), rtol=1e-5)
        action = decision.plan[:, :1]
        memory = decision.memory.moved_on(action, world.observe(state)[:, None], planner.keep)
        state, _ = world.step(state, action[:, 0])
        mean = np.concatenate([mean[1:], middle[None]])


@pytest.mark.parametrize(("first", "elites", "kept"), [(40, 10, 3), (16, 4, 1)])
def test_icem_decides_as_its_authors_program(first, elites, kept, monkeypatch):
    """The bookkeeping of martius-lab/iCEM, re-stated: shifted elites are more candidates than the first population,
    the mean takes the place of a candidate, and the decision is the best of the last iteration."""
    world, alpha = Cart(), 0.1
    low, high, middle, half = bounds(world)
    sizes = [first]
    while len(sizes) < 3:
        sizes.append(max(2 * elites, int(sizes[-1] / 1.25)))
    planner = ICEMPlanner(LENGTH, sum(sizes), elites=elites)
    drawn = []

    def recorded(shape, beta, generator):
        noise = coloured_noise(shape, beta, generator)
        drawn.append(noise[0].numpy().astype(float))
        return noise

    monkeypatch.setattr("neuroprior.control.planners.icem.coloured_noise", recorded)
    state, memory, generator = world.reset(1, seeded(7)), None, seeded(8)
    mean, pool, values = np.tile(middle, (LENGTH, 1)), None, None
    for number in range(4):
        drawn.clear()
        planner.populations = [sizes[0] + (planner.num_kept if number else 0), *sizes[1:]]
        decision = planner.plan(world, state, generator, memory)
        of_shifted = drawn.pop(0) if number else None
        std = np.tile(0.5 * half, (LENGTH, 1))
        for i in range(3):
            last = i == 2
            plans = np.clip(mean + std * drawn[i], low, high)
            if last:
                plans = np.concatenate([mean[None], plans])
            if i == 0 and pool is not None:
                ends = np.clip(mean + std * of_shifted, low, high)[:, -1:]
                plans = np.concatenate([plans, np.concatenate([pool[:kept, 1:], ends], 1)])
            costs = -score(world, state[0], plans)
            if i:
                plans = np.concatenate([plans, pool[:kept]])
                costs = np.concatenate([costs, values[:kept]])
            order = costs.argsort()[:elites]
            pool, values = plans[order], costs[order]
            mean = (1 - alpha) * pool.mean(0) + alpha * mean
            std = (1 - alpha) * pool.std(0) + alpha * std
        np.testing.assert_allclose(decision.plan[0], pool[0], atol=1e-6)
        np.testing.assert_allclose(decision.memory.mean[0], mean, atol=1e-6)
        mean = np.concatenate([mean[1:], mean[-1:]])
        memory = decision.memory.moved_on(decision.plan[:, :1], world.observe(state)[:, None], planner.keep)
        state, _ = world.step(state, decision.plan[:, 0])
