"""What planners, searches, agents and what is made with them refuse: each in one line that names the argument."""

import pytest
import torch

from neuroprior import (
    ExhaustivePlanner,
    MarkovPrior,
    MCTSPlanner,
    Planner,
    Plans,
    SamplingPlanner,
    UniformPrior,
    collect,
    gridworld,
    oracle,
)
from neuroprior.agents import Agent
from neuroprior.planners import (
    FrontierPlanner,
    best_sampling,
    execute,
    expected_score,
    extend_horizon,
    search_weights,
)
from neuroprior.puzzles import AStarPlanner, bootstrap, sliding_tiles
from tests.planners.test_stochastic import Gusty
from tests.support.sources import random_world, refuses, seeded, stochastic_world

GRID, PUZZLE = gridworld(5, 5, seed=0), sliding_tiles(shape=(2, 2), scramble=6)
CHAIN, STARTS, ZERO = MarkovPrior(4, 1), torch.tensor([0, 12]), torch.tensor([0])
SHORT = Plans(torch.zeros(4, 3, dtype=torch.long), 4)
TABLE, NOISY = random_world(0), stochastic_world(0)
EVEN = UniformPrior(3)
ONE = torch.zeros(1, 1, 2, dtype=torch.long)


class HalfLegal(Gusty):
    all_legal = False


def agent(world=GRID, planner=None, **settings):
    return Agent(world, planner or SamplingPlanner(CHAIN, 4, 4), CHAIN, STARTS, **settings).run(2)


def learn(world=PUZZLE, prior=CHAIN, **settings):
    return list(bootstrap(world, prior, PUZZLE.reset(3, seeded(0)), sweeps=1, **settings))


def extended(lengths, prior=CHAIN, plans=SHORT, **how):
    return list(extend_horizon(prior, plans, GRID, lengths, **({"num_starts": 4, "num_plans": 4} | how)))


def expected(plans=ONE, state=ZERO, **how):
    return expected_score(NOISY, state, plans, **how)


def tuned(prior=CHAIN, state=STARTS, **how):
    return best_sampling(prior, GRID, state, 3, 4, **how)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: ExhaustivePlanner(0), ["depth"]),
        (lambda: ExhaustivePlanner(16).plan(TABLE, ZERO), ["depth"]),
        (lambda: ExhaustivePlanner(2, objective="mean"), ["objective"]),
        (lambda: ExhaustivePlanner(2, objective="terminal", discount=0.9), ["discount"]),
        (lambda: ExhaustivePlanner(2, discount=0.9).plan(TABLE, ZERO), ["discount"]),
        (lambda: ExhaustivePlanner(2, any_prefix="no"), ["`any_prefix` must be True or False, got 'no'"]),
        (lambda: ExhaustivePlanner(2, num_rollouts=0), ["num_rollouts", "0"]),
        (lambda: ExhaustivePlanner(1, value=3).plan(TABLE, ZERO), ["`value` must"]),
        (lambda: ExhaustivePlanner(1, value=lambda state: 3.0).plan(TABLE, ZERO), ["a tensor", "got float"]),
        (lambda: ExhaustivePlanner(1, value=lambda state: state[:2]).plan(TABLE, ZERO), ["a number", "got 2"]),
        (lambda: ExhaustivePlanner(2).plan(HalfLegal(), torch.zeros(1, 2)), ["legal"]),
        (lambda: ExhaustivePlanner(2).plan(GRID, [0, 12]), ["`state` must be a tensor of shape"]),
        (lambda: ExhaustivePlanner(2).plan(gridworld(20, 20), torch.tensor([250]).to(torch.uint8)), ["state"]),
        (lambda: SamplingPlanner(EVEN, 0, 2), ["length"]),
        (lambda: SamplingPlanner(EVEN, 2, 0), ["num_plans"]),
        (lambda: SamplingPlanner(CHAIN, 3, 4, halving="no"), ["`halving` must be True or False"]),
        (lambda: SamplingPlanner(UniformPrior(2), 2, 2).plan(HalfLegal(), torch.zeros(1, 2)), ["legal"]),
        (lambda: SamplingPlanner(CHAIN, 2, 2).plan(TABLE, ZERO), ["must have 3 actions, as the world, got 4"]),
        (lambda: FrontierPlanner(CHAIN, 3, 4, noise="no"), ["`noise` must be True or False"]),
        (lambda: FrontierPlanner(EVEN, 2, 2).plan(NOISY, ZERO), ["deterministic"]),
        (lambda: FrontierPlanner(CHAIN, 2, 2).plan(TABLE, ZERO), ["must have 3 actions", "got 4"]),
        (lambda: MCTSPlanner(EVEN, 2, 2).plan(NOISY, ZERO), ["deterministic"]),
        (lambda: AStarPlanner(lambda state: None).search(PUZZLE, PUZZLE.reset(2)), ["`heuristic` must"]),
        (lambda: oracle(TABLE, ZERO, 0), ["length"]),
        (lambda: oracle(TABLE, ZERO, 2, objective="x"), ["objective"]),
        (lambda: oracle(TABLE, ZERO, 2, discount=0.5), ["discount"]),
        (lambda: oracle(gridworld(20, 20), torch.tensor([250.0]), 3), ["state"]),
        (lambda: expected(ONE[0]), ["plans", "[1, 2]"]),
        (lambda: expected(ONE[:, :, :0]), ["plans", "action"]),
        (lambda: expected(ONE + 3), ["plans", "3"]),
        (lambda: expected(state=torch.tensor([10])), ["state", "10"]),
        (lambda: expected(objective="x"), ["objective"]),
        (lambda: expected(discount=0.5), ["discount"]),
        (lambda: expected(lengths=torch.tensor([[3]])), ["lengths[0, 0]", "3"]),
        (lambda: expected(lengths=torch.tensor([[0]])), ["lengths", "0"]),
        (lambda: expected(lengths=torch.tensor([1])), ["[B, P]", "[1]"]),
        (lambda: expected(lengths=torch.ones(1, 1)), ["lengths"]),
        (lambda: collect(ExhaustivePlanner(1), TABLE), ["num_plans"]),
        (lambda: collect(ExhaustivePlanner(1), TABLE, 2, state=ZERO), ["num_plans"]),
        (lambda: collect(ExhaustivePlanner(1), TABLE, 2, context="both"), ["context"]),
        (lambda: collect(ExhaustivePlanner(2), GRID, state=[0, 12]), ["`state` must be a tensor of shape"]),
        (lambda: collect(ExhaustivePlanner(2), GRID, 10, min_score=99), ["none of 10 plans scored more than 99"]),
        (lambda: collect(ExhaustivePlanner(2), GRID, state=STARTS[:0], min_score=0.0), ["none of 0 plans"]),
        (lambda: collect(None, GRID, 3), ["`planner` must be a Planner"]),
        (lambda: collect(ExhaustivePlanner(2), None, 3), ["`world` must be a World"]),
        (lambda: execute(ExhaustivePlanner(3), GRID, STARTS, 5, replan_every=0), ["replan_every"]),
        (lambda: execute(ExhaustivePlanner(3), GRID, STARTS, 5, replan_every=4), ["fewer"]),
        (lambda: execute(ExhaustivePlanner(2), GRID, [0, 12], 3), ["`state` must be a tensor of shape"]),
        (lambda: execute("x", GRID, STARTS, 3), ["`planner` must be a Planner, got str"]),
        (lambda: execute(ExhaustivePlanner(2), None, STARTS, 3), ["`world` must be a World"]),
        (lambda: execute(ExhaustivePlanner(2), GRID, STARTS, 3, change=3), ["`change` must be a function of states"]),
        (lambda: agent(planner=CHAIN), ["`planner` must be a Planner, got MarkovPrior"]),
        (lambda: agent(world=Planner), ["`world` must"]),
        (lambda: agent(warm_start="no"), ["`warm_start` must be True or False"]),
        (lambda: agent(change=3), ["`change` must be a function of states and a generator"]),
        (lambda: agent(change=lambda state, generator: None), ["`change` must"]),
        (lambda: agent(change=lambda state, generator: state[:1]), ["got torch.int64 [1]"]),
        (lambda: agent(training=[1]), ["`training` must be a dictionary of settings"]),
        (lambda: tuned(UniformPrior(3)), ["`prior` must have 4 actions, as the world, got 3"]),
        (lambda: tuned(temperatures=1.5), ["`temperatures` must be a list of numbers"]),
        (lambda: tuned(temperatures=()), ["`temperatures` must have at least one"]),
        (lambda: tuned(temperatures=(0,)), ["`temperature` must be a positive"]),
        (lambda: tuned(state=STARTS[:0]), ["`state` must have at least one start"]),
        (lambda: search_weights(torch.tensor([0.1]), 4), ["at most 0"]),
        (lambda: search_weights(torch.tensor([float("nan")]), 4), ["at most 0"]),
        (lambda: extended(["3"]), ["`lengths` must"]),
        (lambda: extended([3.5]), ["`lengths` must be integers of at least 1"]),
        (lambda: extended([0]), ["`lengths` must be integers of at least 1"]),
        (lambda: extended([3], plans=SHORT.actions), ["`plans` must be Plans"]),
        (lambda: extended([3], prior=None), ["`prior` must be a Prior"]),
        (lambda: extended([3], num_plans=0), ["num_plans"]),
        (lambda: learn(generator=0), ["`generator` must be a torch.Generator"]),
        (lambda: learn(teacher=SamplingPlanner(CHAIN, 3, 4)), ["`teacher` must be a BestFirstPlanner"]),
        (lambda: learn(prior=None), ["`prior` must be a Prior"]),
        (lambda: learn(world=None), ["`world` must be a World"]),
        (lambda: learn(guided=1), ["`guided` must be True or False"]),
    ],
)
def test_bad_arguments_are_named(call, words):
    with refuses(*words):
        call()
