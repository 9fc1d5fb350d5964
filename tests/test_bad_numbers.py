"""Numbers that no argument takes: NaN, infinite, out of range, texts, True; each a line that names the argument."""

from functools import partial
from math import inf, nan

import numpy as np
import pytest
import torch

from neuroprior import (
    ContextTreePrior,
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    MCTSPlanner,
    Plans,
    SamplingPlanner,
    TransformerPrior,
    UniformPrior,
    collect,
    gridworld,
    oracle,
)
from neuroprior.agents import Replay
from neuroprior.behaviour import (
    SemiMarkovPrior,
    choose_modes,
    how_far_back,
    motifs,
)
from neuroprior.behaviour.reporting import FitOptions, report
from neuroprior.control import ICEMPlanner, MPPIPlanner, NoisePrior, ShootingPlanner, VectorGRU, VectorPlans
from neuroprior.planners import execute, expected_score, value_iteration
from neuroprior.plans import all_plans, folds, in_parts
from neuroprior.priors import CombinedPrior, MixturePrior, StackedPrior, SwitchingPrior
from neuroprior.puzzles import AStarPlanner
from neuroprior.training import Settings
from neuroprior.worlds import four_rooms, maze
from tests.support.sources import refuses, seeded

PLANS = Plans(torch.randint(3, (8, 6), generator=seeded(0)), 3)
UNIFORM, WORLD, STATE = UniformPrior(4), gridworld(4, 4), torch.tensor([0, 5])
ENDS = [-1.0], [1.0]
VECTORS = VectorPlans(torch.zeros(2, 5, 1), *ENDS)
NONE_OF_THEM = [nan, True, "1"]
"""What is no number in any range."""

POSITIVE = {
    "smoothing": [partial(MarkovPrior, 3, 1)],
    "alpha": [partial(ContextTreePrior, 3)],
    "temperature": [
        partial(UNIFORM.sample, 2, 2),
        partial(SamplingPlanner, UNIFORM, 2, 2),
        partial(MPPIPlanner, 2, 2),
    ],
    "std": [partial(ICEMPlanner, 3, 20), partial(ShootingPlanner, 3, 20)],
    "reward_power": [partial(gridworld, 3, 3), maze, four_rooms],
    "learning_rate": [Settings],
}
FROM_0 = {
    "smoothing": [partial(SwitchingPrior, 3)],
    "stay": [partial(SwitchingPrior, 3)],
    "weight_decay": [Settings],
    "exploration": [partial(MCTSPlanner, UNIFORM, 2, 2)],
    "noise_beta": [partial(ICEMPlanner, 3, 20)],
    "weight": [partial(AStarPlanner, None)],
}
SHARES = {
    "dropout": [
        partial(GRUPrior, 3),
        partial(TransformerPrior, 3),
        partial(StackedPrior, 3),
        partial(VectorGRU, *ENDS),
    ],
    "uniform_share": [partial(SamplingPlanner, UNIFORM, 3, 4)],
    "prior_share": [partial(ShootingPlanner, 3, 4, prior=NoisePrior(*ENDS))],
    "share": [partial(CombinedPrior, 3), partial(MixturePrior, 3, [MarkovPrior(3)])],
    "sharing": [partial(SwitchingPrior, 3)],
    "beta": [partial(ContextTreePrior, 3)],
    "retention": [Replay],
    "validation": [Settings, PLANS.split],
    "loops": [maze],
    "discount": [
        partial(SamplingPlanner, UNIFORM, 3, 4, objective="return"),
        partial(ShootingPlanner, 3, 4),
        partial(oracle, WORLD, STATE, 3, objective="return"),
        partial(expected_score, WORLD, STATE, torch.zeros(2, 1, 2).long(), objective="return"),
        partial(value_iteration, WORLD),
    ],
}
ORDERS = {
    "order": [partial(MarkovPrior, 3), partial(SwitchingPrior, 3, 2)],
    "depth": [partial(ContextTreePrior, 3)],
    "skip": [partial(how_far_back, PLANS, 2)],
    "first": [PLANS.steps, VECTORS.steps],
    "stop": [partial(VECTORS.steps, 1)],
    "length": [partial(all_plans, 2)],
    "sweeps": [partial(value_iteration, WORLD)],
}
SIZES = {
    "num_contexts": [
        partial(MarkovPrior, 3, 1),
        partial(ContextTreePrior, 3),
        partial(CombinedPrior, 3),
        partial(StackedPrior, 3),
        partial(SwitchingPrior, 3),
        partial(GRUPrior, 3),
    ],
    "num_plans": [
        lambda num_plans: UNIFORM.sample(num_plans, 2),
        lambda num_plans: SemiMarkovPrior(3).sample_plans(num_plans, 2),
        lambda num_plans: NoisePrior(*ENDS).sample(num_plans, 2),
        lambda num_plans: collect(ExhaustivePlanner(2), WORLD, num_plans),
    ],
    "length": [partial(UNIFORM.sample, 2), lambda length: NoisePrior(*ENDS).sample(2, length)],
    "num_steps": [partial(execute, ExhaustivePlanner(2), WORLD, STATE)],
}


def every(arguments, wrong):
    """Each function with each wrong value of its argument."""
    return [
        pytest.param(call, name, value, id=f"{name}-{number}-{value}")
        for name, calls in arguments.items()
        for number, call in enumerate(calls)
        for value in wrong
    ]


@pytest.mark.parametrize(
    ("call", "name", "value"),
    [
        *every(POSITIVE, [*NONE_OF_THEM, 0, -1, inf]),
        *every(FROM_0, [*NONE_OF_THEM, -1]),
        *every(SHARES, [*NONE_OF_THEM, -0.1, 1.5, inf]),
        *every(ORDERS, [*NONE_OF_THEM, 1.0, -1]),
        *every(SIZES, [*NONE_OF_THEM, 1.5, -1, 2**62, 2**70]),
        *every(
            {"seed": [partial(GRUPrior, 3), gridworld, maze, partial(folds, PLANS, 2)]}, [*NONE_OF_THEM, 1.0, 2**70]
        ),
    ],
)
def test_numbers_out_of_range(call, name, value):
    with refuses(name):
        call(**{name: value})


@pytest.mark.parametrize("number", [*NONE_OF_THEM, 0, 1, 9, 2.0, 2.5])
def test_numbers_of_folds(number):
    with refuses("folds"):
        folds(PLANS, number)
    with refuses("folds"):
        choose_modes(PLANS, (1,), number_of_folds=number, max_iterations=1)
    with refuses("folds"):
        report(PLANS, fits=FitOptions(["counts"], folds=number))
    if number != 1:
        with refuses("number" if number != 9 else "at least 9 actions"):
            in_parts(PLANS[:1], number)


@pytest.mark.parametrize("length", [*NONE_OF_THEM, 1, 3.0, 1e300])
def test_lengths_of_motifs(length):
    with refuses("lengths"):
        motifs(PLANS, (length,))
    with refuses("top"):
        motifs(PLANS, (2,), top=0 if length == 1 else length)


def test_what_is_in_range_is_taken():
    """Among it numbers of numpy, and the ends of ranges that belong to them."""
    assert MarkovPrior(3, 1, smoothing=np.float32(0.5)).smoothing == 0.5
    assert VECTORS.steps(1, 9).max_length == 4
    assert SamplingPlanner(UNIFORM, 2, 2, uniform_share=1).uniform_share == 1
    assert GRUPrior(3, hidden_size=4, dropout=0).dropout == 0
    assert SamplingPlanner(UNIFORM, 2, 2, objective="return", discount=1).discount == 1
    assert all_plans(2, 0).shape == (1, 0)
    assert all_plans(1, 200).shape == (1, 200)
