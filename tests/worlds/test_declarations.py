"""What a world declares: what counts, and what is observed."""

import warnings

import numpy as np
import pytest
import torch
from torch import Tensor

from neuroprior import (
    CombinedPrior,
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    MCTSPlanner,
    Plans,
    SamplingPlanner,
    UniformPrior,
    World,
    collect,
    oracle,
)
from neuroprior.planners import FrontierPlanner, execute
from neuroprior.testing import check_world
from neuroprior.worlds import Categories, Features, TabularWorld
from tests.support.sources import seeded


def three_ways() -> TabularWorld:
    """From 0 to 1 (reward 3), 2 (5) or 3 (4); on from these, whatever is done, to 4 with 4, 1 and 2.5.

    The last reward is greatest by way of 1; the return by way of 1 (7); with a discount of 1/4 by way of 2 (5.25).
    """
    table = torch.tensor([[1, 2, 3], [4, 4, 4], [4, 4, 4], [4, 4, 4], [4, 4, 4]])
    reward = torch.tensor([[3.0, 5.0, 4.0], [4.0] * 3, [1.0] * 3, [2.5] * 3, [0.0] * 3])
    return TabularWorld(table, reward[None])


PLANNERS = [
    lambda **how: ExhaustivePlanner(2, **how),
    lambda **how: SamplingPlanner(UniformPrior(3), 2, 64, **how),
    lambda **how: FrontierPlanner(UniformPrior(3), 2, 64, **how),
    lambda **how: MCTSPlanner(UniformPrior(3), 2, 64, **how),
]


@pytest.mark.parametrize("make", PLANNERS, ids=["exhaustive", "sampling", "frontier", "mcts"])
@pytest.mark.parametrize(
    ("world_says", "planner_says", "score"),
    [
        (("terminal", 1.0), {}, 4.0),
        (("return", 1.0), {}, 7.0),
        (("return", 0.25), {}, 5.25),
        (("return", 0.25), {"objective": "terminal"}, 4.0),
        (("return", 0.25), {"discount": 0.5}, 5.5),
        (("terminal", 1.0), {"objective": "return"}, 7.0),
        (("terminal", 1.0), {"objective": "return", "discount": 0.25}, 5.25),
    ],
)
def test_planners_follow_the_world_unless_told_otherwise(make, world_says, planner_says, score):
    world, start = three_ways(), torch.zeros(7, dtype=torch.long)
    world.objective, world.discount = world_says
    planner = make(**planner_says)
    decision = planner.plan(world, start, seeded(0))
    assert decision.score.tolist() == [score] * 7
    assert oracle(world, start, 2, **planner.goal).tolist() == [score] * 7
    assert planner.goal["objective"] == planner_says.get("objective")  # the planner itself is as it was


class Field(World):
    """Two coordinates from 0 to 39, as integers; an action moves one of them by 1."""

    num_actions = 4

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        return torch.randint(40, (batch_size, 2), generator=generator)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        moves = torch.tensor([[1, 0], [-1, 0], [0, 1], [0, -1]])
        after = (state + moves[action.long()]).clamp(0, 39)
        return after, -after.sum(1).float()


class Seen(Field):
    observation = Features(2)

    def observe(self, state: Tensor) -> Tensor:
        return state


class Numbered(Field):
    observation = Categories(1600)

    def observe(self, state: Tensor) -> Tensor:
        return state[:, 0] * 40 + state[:, 1]


def test_nothing_is_observed_unless_it_is_declared():
    planner, prior = SamplingPlanner(UniformPrior(4), 3, 8), GRUPrior(4, hidden_size=8, context_size=2)
    assert collect(planner, Field(), 5).context is None
    for context in ("plan", "step"):
        with pytest.raises(ValueError, match=r"^observe: Field observes nothing; write `observe`"):
            collect(planner, Field(), 5, context=context)
    with pytest.raises(ValueError, match="Field observes nothing"):
        SamplingPlanner(prior, 3, 8).plan(Field(), Field().reset(2))
    silent = type("Silent", (Seen,), {"observation": None})()
    with pytest.raises(ValueError, match=r"Silent must declare what `observe` gives, such as Categories"):
        collect(planner, silent, 5, context="step")


def test_integers_that_are_features_become_floating_point():
    plans = collect(SamplingPlanner(UniformPrior(4), 3, 8), Seen(), 30, context="step", generator=seeded(1))
    assert plans.context.dtype == torch.float32
    assert plans.context.shape == (30, 3, 2)
    moved = plans.context[:, 1:] - plans.context[:, :-1]
    steps = torch.tensor([[1.0, 0], [-1, 0], [0, 1], [0, -1]])[plans.actions[:, :-1].long()]
    inside = (plans.context[:, :-1] + steps).clamp(0, 39) - plans.context[:, :-1]
    assert moved.equal(inside)
    prior = GRUPrior(4, hidden_size=8, context_size=2)
    assert SamplingPlanner(prior, 3, 8).plan(Seen(), Seen().reset(2, seeded(0)), seeded(0)).plan.shape == (2, 3)


@pytest.mark.parametrize(
    ("observation", "observe", "message"),
    [
        (Features(3), lambda self, state: state, r"must give \[10, 3\], as the world declares Features\(size=3\)"),
        (Features(2), lambda self, state: state[:, 0], r"got torch.int64 \[10\]"),
        (Categories(9), lambda self, state: state[:, 0].float(), r"must give integers of shape \[10\]"),
        (Categories(9), lambda self, state: state[:, 0] + 9, r"out of range: there are 9 categories"),
        (Categories(9), lambda self, state: None, r"got NoneType"),
    ],
)
def test_what_is_not_as_declared_is_refused(observation, observe, message):
    world = type("Wrong", (Field,), {"observation": observation, "observe": observe})()
    with pytest.raises(ValueError, match=message):
        collect(SamplingPlanner(UniformPrior(4), 2, 4), world, 5, context="step")


def test_a_fit_says_what_it_cannot_use():
    """A context that is ignored, and one that seldom repeats; not one that repeats, and not in priors within priors."""
    planner = SamplingPlanner(UniformPrior(4), 3, 8)
    new = collect(planner, Numbered(), 60, context="plan", generator=seeded(0))
    with pytest.warns(UserWarning, match=r"MarkovPrior: it ignores the context") as caught:
        MarkovPrior(4, 1).fit(new)
    assert caught[0].filename == __file__
    with pytest.warns(UserWarning, match=r"MarkovPrior: nearly every context occurs in one plan alone"):
        MarkovPrior(4, 1, num_contexts=1600).fit(new)
    kinds = torch.randint(5, (60,), generator=seeded(1))
    known = Plans(new.actions, 4, context=kinds)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        MarkovPrior(4, 1, num_contexts=5).fit(known)
        MarkovPrior(4, 1).fit(known.without_context())
        CombinedPrior(4, num_contexts=5, effort="fast").fit(known, generator=seeded(2), max_steps=5, progress=False)


class OnlyForward:
    """Legal actions that a world takes from elsewhere than a `World`: none backwards."""

    def legal_actions(self, state: Tensor) -> Tensor:
        return torch.tensor([True, False, True, False]).expand(len(state), -1)


class Forward(OnlyForward, Field):
    pass


class Free(Forward):
    all_legal = True


def test_legal_actions_of_another_base_count():
    assert (Field().all_legal, Forward().all_legal, Free().all_legal) == (True, False, True)
    state = torch.tensor([[3, 3]])
    for make in (SamplingPlanner, FrontierPlanner, MCTSPlanner):
        assert make(UniformPrior(4), 3, 64).plan(Forward(), state, seeded(0)).score.item() == -7 - 8 - 9
        assert make(UniformPrior(4), 3, 64).plan(Field(), state, seeded(0)).score.item() == -5 - 4 - 3


@pytest.mark.parametrize("own", [False, True])
def test_the_number_of_actions_may_be_numpys(own):
    if own:
        world = Field()
        world.num_actions = np.int64(4)
    else:
        world = type("Counted", (Field,), {"num_actions": np.int64(4)})()
    assert type(world.num_actions) is int
    for make in (SamplingPlanner, FrontierPlanner, MCTSPlanner):
        assert make(UniformPrior(4), 2, 16).plan(world, torch.tensor([[3, 3]]), seeded(0)).score.item() == -5 - 4


class InPlace(Field):
    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        state[:, 0] += action
        return state, state[:, 0].float()


def test_a_step_that_changes_its_states_is_refused():
    state = torch.tensor([[3, 3], [7, 1]])
    for make in (SamplingPlanner, FrontierPlanner, MCTSPlanner):
        with pytest.raises(ValueError, match=r"^step: InPlace must not change the states"):
            make(UniformPrior(4), 3, 64).plan(InPlace(), state.clone(), seeded(0))
    with pytest.raises(ValueError, match=r"^step: InPlace must not change the states"):
        execute(SamplingPlanner(UniformPrior(4), 1, 4), InPlace(), state, num_steps=2)


def test_a_table_keeps_copies():
    table, reward, legal = torch.tensor([[0, 1], [1, 0]]), torch.tensor([0.0, 5.0]), torch.tensor([[True, True]] * 2)
    world = TabularWorld(table, reward, legal)
    table.fill_(7)
    reward.fill_(9.0)
    legal.fill_(False)
    assert world.next_state.tolist() == [[0, 1], [1, 0]]
    assert world.reward.tolist() == [[0, 5]]
    assert world.legal_table is not None
    assert bool(world.legal_table.all())


class DeadEnd(Field):
    """Beyond a sum of 50 nothing is legal; `step`, which is asked all the same, goes on."""

    def legal_actions(self, state: Tensor) -> Tensor:
        return (state.sum(1) < 50)[:, None].expand(-1, 4)


def test_what_a_step_from_a_dead_end_returns_does_not_count():
    check_world(DeadEnd())
    world = DeadEnd()
    world.objective = "sum"
    with pytest.raises(AssertionError, match="`objective` must be"):
        check_world(world)
