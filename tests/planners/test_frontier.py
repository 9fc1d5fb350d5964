"""The frontier planner: never beats the oracle, reaches it with enough steps, counts them, and wastes none."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import (
    GRUPrior,
    MarkovPrior,
    Plans,
    SamplingPlanner,
    TabularWorld,
    UniformPrior,
    oracle,
)
from neuroprior.planners import FrontierPlanner, frontier
from neuroprior.worlds import cube
from tests.support.sources import random_world, seeded

HOW = (
    {},
    {"objective": "return"},
    {"objective": "return", "discount": 0.7, "any_prefix": True},
    {"any_prefix": True},
    {"value": lambda state: (state % 7).double()},
)


class Counted(TabularWorld):
    """Counts the steps that are taken."""

    def __init__(self, world: TabularWorld) -> None:
        super().__init__(world.next_state, world.reward, world.legal_table)
        self.steps = 0

    def step(self, state, action, generator=None):
        self.steps += len(state)
        return super().step(state, action, generator)


def score_of(planner, world, state, decision):
    """What the plans of a decision score when they are tried, prefix by prefix."""
    rollout = world.rollout(state, decision.plan[:, None].long(), keep_states=True)
    scores = planner.for_world(world).prefix_scores(rollout.rewards, rollout.states)[:, 0]
    last = scores.shape[1] - 1 if decision.lengths is None else decision.lengths - 1
    row = torch.arange(len(scores))
    if not planner.any_prefix:
        return planner.for_world(world).score(rollout.rewards, rollout.final_state)[:, 0], rollout.final_state[:, 0]
    return scores[row, last], rollout.states[row, 0, last]


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 999),
    how=st.sampled_from(HOW),
    kind=st.sampled_from(["WS", "WSA"]),
    legal=st.booleans(),
    noise=st.booleans(),
    num_plans=st.integers(1, 20),
    length=st.integers(1, 6),
)
def test_it_finds_what_the_oracle_does_when_it_may_try_all(seed, how, kind, legal, noise, num_plans, length):
    """Of 6 states and 3 actions: with 18 plans nothing is left out."""
    world = Counted(random_world(seed, kind, legal))
    state = world.reset(5, seeded(seed))
    planner = FrontierPlanner(UniformPrior(3), length, num_plans, noise=noise, **how)
    decision = planner.plan(world, state, seeded(seed))
    assert decision.model_steps * len(state) == world.steps <= num_plans * length * len(state)
    best = oracle(world, state, length, **how).double()
    assert (decision.score <= best + 1e-5).all()
    score, ends = score_of(planner, world, state, decision)
    assert torch.allclose(score.double(), decision.score.double(), atol=1e-6)
    assert torch.equal(ends, decision.final_state)
    if num_plans >= 18:
        assert torch.allclose(decision.score.double(), best, atol=1e-5)
    again = planner.plan(world, state, seeded(seed))
    assert torch.equal(again.plan, decision.plan)


@pytest.mark.parametrize("temperature", [1.0, 0.1, 0.01, 1e-4])
@pytest.mark.parametrize("noise", [False, True])
def test_nor_does_an_overconfident_wrong_prior_stop_it(temperature, noise):
    """A line of 9 cells with a reward at its end, and a prior that goes the other way."""
    cell = torch.arange(9)
    world = TabularWorld(torch.stack([(cell - 1).clamp(min=0), (cell + 1).clamp(max=8)], 1), (cell == 8).float())
    prior = MarkovPrior(2, 0).fit(torch.zeros(200, 8).long())
    planner = FrontierPlanner(prior, 8, 50, temperature=temperature, noise=noise)
    assert planner.plan(world, torch.zeros(3, dtype=torch.long), seeded(0)).score.tolist() == [1.0] * 3


def test_plans_are_legal_even_where_nothing_is_worth_anything():
    world = random_world(0, "WSA", legal=True)
    world = TabularWorld(world.next_state, torch.full_like(world.reward, -torch.inf), world.legal_table)
    state = world.reset(200, seeded(0))
    for how in ({}, {"any_prefix": True}):
        decision = FrontierPlanner(UniformPrior(3), 4, 100, **how).plan(world, state, seeded(1))
        now = state
        for t in range(4):
            taken = torch.ones(200, dtype=torch.bool) if decision.lengths is None else decision.lengths > t
            action = decision.plan[:, t].long()
            assert world.legal_actions(now).gather(1, action[:, None])[taken].all()
            now = world.step(now, action)[0]


def test_steps_that_are_not_needed_at_first_are_for_later():
    planner = FrontierPlanner(UniformPrior(3), 4, 20)
    assert planner._widths(3) == [3, 9, 27, 41]
    assert FrontierPlanner(UniformPrior(3), 3, 1)._widths(3) == [1, 1, 1]


def test_plans_that_meet_add_up_and_the_best_goes_on():
    front = frontier._Front(
        torch.zeros(2, 3, 1),
        torch.tensor([[0.2, 0.5, 0.3], [0.2, 0.0, 0.3]], dtype=torch.double).log(),
        torch.zeros(2, 3, 1),
        torch.tensor([7, 8, 7, 9, 9, 9]),
    )
    blind = front.merge(None).log_prob.exp()
    assert torch.allclose(blind, torch.tensor([[0.0, 0.5, 0.5], [0.0, 0.0, 0.5]], dtype=torch.double))
    gained = front.merge(torch.tensor([[2.0, 1.0, 1.0], [1.0, 9.0, 1.0]]).double()).log_prob.exp()
    assert torch.allclose(gained, torch.tensor([[0.5, 0.5, 0.0], [0.0, 0.0, 0.5]], dtype=torch.double))


def test_the_context_is_the_observation_of_each_plans_state():
    """It knows the way: in each cell of a table one action is right, and one plan alone is tried."""
    table, right = torch.randint(30, (30, 4), generator=seeded(1)), torch.randint(4, (30,), generator=seeded(2))
    world = TabularWorld(table, torch.nn.functional.one_hot(right, 4).double())
    plans = []
    state = world.reset(400, seeded(3))
    for _ in range(6):
        plans.append((right[state], state))
        state = world.step(state, right[state])[0]
    actions, observed = (torch.stack(part, 1) for part in zip(*plans, strict=True))
    prior = MarkovPrior(4, 0, num_contexts=30).fit(Plans(actions, 4, context=observed))
    decision = FrontierPlanner(prior, 6, 1, objective="return", noise=False).plan(world, world.reset(20, seeded(4)))
    assert (decision.score == 6).all()


def test_other_states_than_numbers():
    """Scrambles of three moves are all solved within the steps of 300 plans; as many samples leave some unsolved."""
    world = cube(scramble=3)
    state = world.reset(40, seeded(0))
    how = {"any_prefix": True}
    prior = GRUPrior(world.num_actions, hidden_size=8, context_size=world.observe(state).shape[-1])
    found = FrontierPlanner(prior, 3, 300, **how).plan(world, state, seeded(1)).score
    sampled = SamplingPlanner(prior, 3, 300, **how).plan(world, state, seeded(1)).score
    assert (found == 1).all()
    assert sampled.mean() < 0.9


def test_of_plans_that_meet_the_one_with_the_higher_discounted_return_goes_on():
    """Two ways to cell 3: 0 and then 1.2, or 1 and then 0; at a discount of one half the second is better."""
    table = torch.tensor([[1, 2], [3, 3], [3, 3], [3, 3]])
    reward = torch.tensor([[[0.0, 1.0], [1.2, 1.2], [0.0, 0.0], [0.0, 0.0]]])
    for discount, best, first in ((0.5, 1.0, 1), (1.0, 1.2, 0)):
        planner = FrontierPlanner(UniformPrior(2), 3, 20, objective="return", discount=discount)
        decision = planner.plan(TabularWorld(table, reward), torch.zeros(5, dtype=torch.long), seeded(0))
        assert decision.score.tolist() == pytest.approx([best] * 5)
        assert decision.plan[:, 0].tolist() == [first] * 5
