"""Planners at their limits: chunks of starts, rewards that are not numbers, states of a wrong dtype."""

import pytest
import torch

from neuroprior import (
    ExhaustivePlanner,
    MarkovPrior,
    Planner,
    Plans,
    SamplingPlanner,
    UniformPrior,
    World,
    collect,
    gridworld,
    oracle,
)
from neuroprior.agents import Agent
from neuroprior.planners import FrontierPlanner, MCTSPlanner, best_sampling, execute, extend_horizon
from neuroprior.puzzles import AStarPlanner, LevinPlanner, bootstrap, sliding_tiles

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


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (3, "^`value` must"),
        (lambda state: 3.0, "a tensor .* got float"),
        (lambda state: state, "got 6$"),
    ],
)
def test_values_that_are_none(value, message):
    with pytest.raises(ValueError, match=message):
        ExhaustivePlanner(1, value=value).plan(Walk(torch.float), torch.zeros(1, 2))


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


@pytest.mark.parametrize(
    ("world", "planner", "message"),
    [
        (gridworld(5, 5), MarkovPrior(4, 1), "`planner` must be a Planner, got MarkovPrior"),
        (Planner, ExhaustivePlanner(2), "`world` must"),
    ],
)
def test_what_an_agent_is_made_of(world, planner, message):
    with pytest.raises(ValueError, match=message):
        Agent(world, planner, MarkovPrior(4, 1))


def test_chunks_are_put_together_with_lengths() -> None:
    world = gridworld(5, 5, num_worlds=2, seed=1)
    state = torch.arange(50)
    planner = ExhaustivePlanner(3, any_prefix=True)
    whole = planner.plan(world, state, torch.Generator().manual_seed(0))
    planner.steps_at_once = 400
    parts = planner.plan(world, state, torch.Generator().manual_seed(0))
    assert parts.score.equal(whole.score)
    assert parts.lengths is not None
    for b in range(50):
        rollout = world.rollout(state[b : b + 1], parts.plan[b, : parts.lengths[b]][None, None])
        assert int(rollout.final_state) == int(parts.final_state[b])
        assert float(rollout.rewards[0, 0, -1]) == float(parts.score[b])


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


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int32, torch.float32])
def test_states_of_another_dtype_are_refused(dtype: torch.dtype) -> None:
    world = gridworld(20, 20)
    for call in (ExhaustivePlanner(2).plan, lambda w, s: oracle(w, s, 3)):
        with pytest.raises(ValueError, match="state"):
            call(world, torch.tensor([250]).to(dtype))


GRID, PUZZLE = gridworld(5, 5, seed=0), sliding_tiles(shape=(2, 2), scramble=6)
CHAIN, STARTS = MarkovPrior(4, 1), torch.tensor([0, 12])
SHORT = Plans(torch.zeros(4, 3, dtype=torch.long), 4)


def agent(**settings):
    return Agent(GRID, SamplingPlanner(CHAIN, 4, 4), CHAIN, STARTS, **settings).run(2)


def learn(world=PUZZLE, prior=CHAIN, **settings):
    return list(bootstrap(world, prior, PUZZLE.reset(3, torch.Generator().manual_seed(0)), sweeps=1, **settings))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ExhaustivePlanner(2, any_prefix="no"), "`any_prefix` must be True or False, got 'no'"),
        (lambda: SamplingPlanner(CHAIN, 3, 4, halving="no"), "`halving` must be True or False"),
        (lambda: FrontierPlanner(CHAIN, 3, 4, noise="no"), "`noise` must be True or False"),
        (lambda: agent(warm_start="no"), "`warm_start` must be True or False"),
        (lambda: agent(change=3), "`change` must be a function of states and a generator"),
        (lambda: agent(change=lambda state, generator: None), r"`change` must"),
        (lambda: agent(change=lambda state, generator: state[:1]), r"got torch\.int64 \[1\]"),
        (lambda: agent(training=[1]), "`training` must be a dictionary of settings"),
        (lambda: ExhaustivePlanner(2).plan(GRID, [0, 12]), "`state` must be a tensor of shape"),
        (lambda: collect(ExhaustivePlanner(2), GRID, state=[0, 12]), "`state` must be a tensor of shape"),
        (lambda: execute(ExhaustivePlanner(2), GRID, [0, 12], 3), "`state` must be a tensor of shape"),
        (lambda: execute("x", GRID, STARTS, 3), "`planner` must be a Planner, got str"),
        (lambda: execute(ExhaustivePlanner(2), None, STARTS, 3), "`world` must be a World"),
        (lambda: collect(None, GRID, 3), "`planner` must be a Planner"),
        (lambda: collect(ExhaustivePlanner(2), None, 3), "`world` must be a World"),
        (
            lambda: best_sampling(CHAIN, GRID, STARTS, 3, 4, temperatures=1.5),
            "`temperatures` must be a list of numbers",
        ),
        (
            lambda: list(extend_horizon(CHAIN, SHORT, GRID, ["3"], num_starts=4, num_plans=4)),
            "`lengths` must",
        ),
        (
            lambda: list(extend_horizon(CHAIN, SHORT, GRID, [3.5], num_starts=4, num_plans=4)),
            "`lengths` must be integers of at least 1",
        ),
        (
            lambda: list(extend_horizon(CHAIN, SHORT.actions, GRID, [3], num_starts=4, num_plans=4)),
            "`plans` must be Plans",
        ),
        (lambda: list(extend_horizon(None, SHORT, GRID, [3], num_starts=4)), "`prior` must be a Prior"),
        (lambda: execute(ExhaustivePlanner(2), GRID, STARTS, 3, change=3), "`change` must be a function of states"),
        (lambda: learn(generator=0), r"`generator` must be a torch\.Generator"),
        (lambda: learn(teacher=SamplingPlanner(CHAIN, 3, 4)), "`teacher` must be a BestFirstPlanner"),
        (lambda: learn(prior=None), "`prior` must be a Prior"),
        (lambda: learn(world=None), "`world` must be a World"),
        (lambda: learn(guided=1), "`guided` must be True or False"),
        (
            lambda: AStarPlanner(lambda state: None).search(PUZZLE, PUZZLE.reset(2)),
            "`heuristic` must",
        ),
    ],
)
def test_bad_arguments_are_named(call, message) -> None:
    with pytest.raises(ValueError, match=message) as error:
        call()
    assert "\n" not in str(error.value)
