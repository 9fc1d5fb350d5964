"""How many starts fit into a time."""

import time

import torch

from neuroprior import gridworld
from neuroprior.comparison.pacing import (
    MIN_STARTS,
    MIN_TRAINING_BUDGET,
    MIN_TRAINING_STARTS,
    fit_starts,
    seconds_per_step,
)
from neuroprior.comparison.trial import Design
from neuroprior.worlds import World
from neuroprior.worlds.world import Rollout

DESIGN = Design(
    gridworld(4, 4, seed=0), None, {"uniform": "uniform"}, {"sampling": "sampling"}, (16, 64), 10, 48, 400, 256
)


def sizes(design):
    return design.starts, design.training_starts, design.training_budget


def test_starts_are_as_many_as_there_is_time_for():
    """400 (256 + 16) 10 + 48 (80 + 64) 10 = 1,157,120 steps; a quarter of that time halves both factors of training."""
    steps = 1_157_120
    assert sizes(fit_starts(DESIGN, 1.0, 1.0, steps)) == (48, 400, 256)
    assert sizes(fit_starts(DESIGN, 2.0, 2.0, 0.5 * steps)) == (12, 200, 128)
    assert sizes(fit_starts(DESIGN, 1.0, 4.0, (4 * 1_088_000 + 69_120) / 4)) == (12, 200, 128)
    assert sizes(fit_starts(DESIGN, 1.0, 1.0, 1e-6)) == (MIN_STARTS, MIN_TRAINING_STARTS, MIN_TRAINING_BUDGET)


def test_a_small_design_does_not_grow():
    small = Design(DESIGN.world, None, {}, {}, (1,), 10, 2, 30, 32)
    assert sizes(fit_starts(small, 1.0, 1.0, 1e-6)) == (2, 30, 32)


class Counting(World):
    """Counts the steps that are taken of it."""

    num_actions = 2
    steps = 0

    def reset(self, batch_size, generator=None):
        return torch.zeros(batch_size)

    def step(self, state, action, generator=None):
        self.steps += len(state)
        return state, state


def test_fast_worlds_are_timed_for_a_bounded_number_of_steps():
    """16 plans of 10 steps from 1, 4, 16, 64 and 256 starts, or fewer on a slow machine."""
    world = Counting()
    assert 0 < seconds_per_step(world, 10, "sampling") < 1e-3
    assert world.steps <= 16 * 10 * (1 + 4 + 16 + 64 + 256)


class SlowSteps(Counting):
    """Takes a millisecond for a step, but none for a rollout."""

    def step(self, state, action, generator=None):
        time.sleep(1e-3 * len(state))
        return state, state

    def rollout(self, state, plans, generator=None, keep_states=False):
        return Rollout(state[:, None].expand(plans.shape[:2]), plans.double())


def test_steps_are_timed_as_the_planner_takes_them():
    assert seconds_per_step(SlowSteps(), 4, "sampling") < 5e-4
    assert seconds_per_step(SlowSteps(), 4, "frontier") >= 1e-3
