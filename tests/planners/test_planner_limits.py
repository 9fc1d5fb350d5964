"""Planners at their limits: states without legal actions, plans that end early, rewards that are not numbers."""

import pytest
import torch

from neuroprior import (
    ExhaustivePlanner,
    MarkovPrior,
    Planner,
    SamplingPlanner,
    UniformPrior,
    World,
)
from neuroprior.agents import Agent
from neuroprior.planners import FrontierPlanner, MCTSPlanner, execute
from neuroprior.puzzles import LevinPlanner, sliding_tiles

MAKERS = {
    "exhaustive": lambda **goal: ExhaustivePlanner(3, **goal),
    "sampling": lambda **goal: SamplingPlanner(UniformPrior(3), 3, 64, **goal),
    "frontier": lambda **goal: FrontierPlanner(UniformPrior(3), 3, 27, **goal),
    "mcts": lambda **goal: MCTSPlanner(UniformPrior(3), 3, 40, **goal),
}
PLANNERS = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)


class Walk(World):
    """A walk in the plane, by vectors that differ, with rewards of a dtype, for being on one side."""

    num_actions = 3

    def __init__(self, dtype: torch.dtype) -> None:
        self.dtype = dtype

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> torch.Tensor:
        return torch.randn(batch_size, 2, generator=generator)

    def step(self, state, action, generator=None):
        after = state + torch.tensor([[1.0, 0.3], [-0.4, 0.9], [-0.7, -1.1]])[action]
        return after, (after[:, 0] > 0).to(self.dtype)


@PLANNERS
@pytest.mark.parametrize("dtype", [torch.long, torch.bool])
@pytest.mark.parametrize(
    "goal",
    [
        {},
        {"value": lambda state: torch.cos(state.sum(1))},
        {"objective": "return", "discount": 0.5, "value": lambda state: torch.cos(state.sum(1)), "any_prefix": True},
    ],
    ids=["terminal", "value", "return"],
)
def test_rewards_of_another_dtype_are_the_same_numbers(make, dtype, goal):
    state = Walk(torch.float).reset(20, torch.Generator().manual_seed(0))
    one, other = (
        make(**goal).plan(Walk(kind), state, torch.Generator().manual_seed(1)) for kind in (torch.float, dtype)
    )
    assert one.plan.equal(other.plan)
    assert one.score.equal(other.score)


class DeadEnd(Walk):
    all_legal = False

    def legal_actions(self, state: torch.Tensor) -> torch.Tensor:
        return (state[:, :1] < 2).expand(-1, 3)


@PLANNERS
def test_a_state_without_any_legal_action_is_an_end(make):
    """The reward is 1 in each step that ends right of 0; from (3, 0) there is none to take, and nothing to gain."""
    world, start = DeadEnd(torch.float), torch.tensor([[0.0, 0.0], [3.0, 0.0], [1.5, 1.0]])
    decision = make(objective="return").plan(world, start, torch.Generator().manual_seed(0))
    states, total = start, torch.zeros(3)
    for action in decision.plan.T:
        alive = states[:, 0] < 2
        after, reward = world.step(states, action.long())
        states, total = torch.where(alive[:, None], after, states), total + reward * alive
    assert decision.score.equal(total)
    assert decision.final_state.equal(states)
    assert decision.score[1] == 0
    assert decision.final_state[1].equal(start[1])
    assert decision.score[2] > 0


def test_a_plan_may_be_shorter_where_the_episode_ends_with_it():
    """Puzzles some of which are solved already, and others sooner than the actions that are to be executed."""
    world, prior = sliding_tiles(shape=(2, 2), scramble=4), MarkovPrior(4, 1).fit(torch.tensor([[0, 1, 2, 3]]))
    state = world.reset(40, torch.Generator().manual_seed(0))
    planner = LevinPlanner(None, 200)
    lengths = planner.plan(world, state).lengths
    assert lengths is not None
    assert {0, 2, 4} <= set(lengths.tolist())
    for every in (1, 2, 3):
        assert world.solved(execute(planner, world, state, 6, replan_every=every).states[:, -1]).all()
        agent = Agent(world, planner, prior, state, replan_every=every, plan_length=6, learn_every=None)
        solved = world.solved(agent.run(6).states.flatten(0, 1)).view(40, 6)
        assert solved.any(1)[lengths > 0].all()


@pytest.mark.parametrize("planner", [ExhaustivePlanner(2), SamplingPlanner(UniformPrior(2), 2, 8)])
def test_rewards_that_are_not_numbers_are_said(planner: Planner) -> None:
    class Broken(World):
        num_actions = 2

        def reset(self, batch_size: int, generator: torch.Generator | None = None) -> torch.Tensor:
            return torch.zeros(batch_size, 1)

        def step(self, state, action, generator=None):
            return state, torch.where(action == 0, torch.nan, 1.0)

    with pytest.raises(ValueError, match="NaN"):
        planner.plan(Broken(), torch.zeros(50, 1))


def test_scores_of_prefixes_are_those_of_plans_as_long() -> None:
    """Rewards 1, 2, 4 and values 1, 3, 9 at a discount of one half, by hand."""
    rewards, states = torch.tensor([[1.0, 2.0, 4.0]]), torch.tensor([[1, 3, 9]])
    how = {"value": lambda state: state.double()}
    due = {"terminal": [1 + 1, 2 + 3, 4 + 9], "return": [1 + 1 / 2, 1 + 1 + 3 / 4, 1 + 1 + 1 + 9 / 8]}
    for objective, scores in due.items():
        discount = 0.5 if objective == "return" else 1.0
        planner = ExhaustivePlanner(3, objective=objective, discount=discount, **how)
        assert planner.prefix_scores(rewards, states).tolist() == [scores]
        assert [float(planner.score(rewards[:, :k], states[:, k - 1])) for k in (1, 2, 3)] == scores
