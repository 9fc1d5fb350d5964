"""Planners against brute force over all plans, chunks, the oracle, and what is collected."""

import pytest
import torch

from neuroprior import (
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    Plans,
    SamplingPlanner,
    TabularWorld,
    UniformPrior,
    World,
    collect,
    gridworld,
    oracle,
)
from neuroprior.worlds import Features
from tests.support.sources import (
    FALSE_ALARM,
    best_plan_distribution,
    every_plan,
    fits,
    p_value,
    plan_number,
    random_world,
    seeded,
    stochastic_world,
)

VALUES = torch.rand(12, generator=seeded(99)) * 2 - 1


def value_of(state):
    return VALUES[state]


OBJECTIVES = [
    {},
    {"value": value_of},
    {"objective": "return"},
    {"objective": "return", "discount": 0.7},
    {"objective": "return", "discount": 0.7, "value": value_of},
]
KINDS = ("S", "SA", "WS", "WSA")
WORLDS = pytest.mark.parametrize("world", [random_world(s, k, legal) for s, k in enumerate(KINDS) for legal in (0, 1)])
GOALS = pytest.mark.parametrize("goal", OBJECTIVES)


def brute_force(world, start, plan, goal):
    """The score of one plan, step by step, or None where it is not legal; and where it ends."""
    state, rewards = torch.tensor([start]), []
    for action in plan.tolist():
        if not world.legal_actions(state)[0, action]:
            return None, None
        state, reward = world.step(state, torch.tensor([action]))
        rewards.append(float(reward))
    discount = goal.get("discount", 1.0)
    if goal.get("objective") == "return":
        score, weight = sum(r * discount**t for t, r in enumerate(rewards)), discount ** len(rewards)
    else:
        score, weight = rewards[-1], 1.0
    return score + (weight * float(VALUES[state]) if "value" in goal else 0.0), int(state)


@WORLDS
@GOALS
@pytest.mark.parametrize("depth", [1, 3])
def test_exhaustive_is_brute_force_and_so_is_the_oracle(world, goal, depth):
    states = torch.arange(world.num_maps * 6)
    decision = ExhaustivePlanner(depth, **goal).plan(world, states, seeded(0))
    assert decision.model_steps == sum(3**d for d in range(1, depth + 1))
    assert decision.plan.shape == (len(states), depth)
    for state in states.tolist():
        scores = {}
        for plan in every_plan(3, depth):
            score, end = brute_force(world, state, plan, goal)
            if score is not None:
                scores[tuple(plan.tolist())] = (score, end)
        best = max(score for score, _ in scores.values())
        assert float(decision.score[state]) == pytest.approx(best, abs=1e-5)
        score, end = scores[tuple(decision.plan[state].tolist())]  # a legal plan
        assert score == pytest.approx(best, abs=1e-5)
        assert int(decision.final_state[state]) == end
    torch.testing.assert_close(oracle(world, states, depth, **goal), decision.score, rtol=1e-5, atol=1e-5)


@WORLDS
@GOALS
@pytest.mark.parametrize("prior", [UniformPrior(3), MarkovPrior(3, 1), GRUPrior(3, 8, num_contexts=6)])
def test_sampling_decides_for_the_best_of_its_candidates(world, goal, prior):
    class Watched(SamplingPlanner):
        def candidates(self, *arguments):
            self.found = super().candidates(*arguments)
            return self.found

    states, planner = torch.arange(world.num_maps * 6), Watched(prior, 4, 5, **goal)
    decision = planner.plan(world, states, seeded(1))
    plans, score, ends = planner.found
    assert decision.model_steps == 20
    assert plans.shape == (len(states), 5, 4)
    again = world.rollout(states, plans)
    assert torch.equal(planner.for_world(world).score(again.rewards, again.final_state), score)
    assert torch.equal(again.final_state, ends)
    for i in range(len(states)):
        found = [brute_force(world, i, plan, goal) for plan in plans[i]]
        assert None not in found[0]
        best = max(score for score, _ in found)
        assert float(decision.score[i]) == pytest.approx(best, abs=1e-5)
        score, end = brute_force(world, i, decision.plan[i], goal)
        assert score == pytest.approx(best, abs=1e-5)
        assert decision.plan[i].tolist() in plans[i].tolist()
        assert int(decision.final_state[i]) == end
    assert (decision.score <= oracle(world, states, 4, **goal) + 1e-5).all()
    many = SamplingPlanner(prior, 2, 400, **goal).plan(world, states, seeded(2))
    torch.testing.assert_close(many.score, oracle(world, states, 2, **goal), rtol=1e-5, atol=1e-5)


def test_candidates_of_a_start_are_independent_of_its_place():
    """Plans are drawn for all starts together: each start's candidates must still have the prior's distribution."""
    world = random_world(0)
    planner = SamplingPlanner(UniformPrior(3), 2, 4)
    plans, _, _ = planner.candidates(world, torch.zeros(20_000, dtype=torch.long), seeded(0))
    number = plan_number(plans, 3)
    for part in (number[:10_000], number[10_000:], number[:, 0]):
        assert p_value(part, torch.ones(9)) > FALSE_ALARM
    assert p_value(number[:, 0] * 9 + number[:, 3], torch.ones(81)) > FALSE_ALARM


@pytest.mark.parametrize("steps", [1, 100, 2**22])
@pytest.mark.parametrize("make", [lambda: ExhaustivePlanner(3), lambda: SamplingPlanner(UniformPrior(3), 2, 500)])
def test_chunks(make, steps, monkeypatch):
    world = random_world(4, "WSA", legal=True)
    states = torch.randint(12, (50,), generator=seeded(0))
    planner = make()
    planner.steps_at_once = steps
    sizes, reference = [], world.step
    monkeypatch.setattr(world, "step", lambda s, a, g=None: sizes.append(len(s)) or reference(s, a, g))
    decision = planner.plan(world, states, seeded(1))
    length = decision.plan.shape[1]
    assert max(sizes) <= max(steps, 500)  # at least one start at a time
    torch.testing.assert_close(decision.score, oracle(world, states, length))
    got = world.rollout(states, decision.plan[:, None])
    assert torch.equal(got.rewards[:, 0, -1], decision.score)
    assert torch.equal(got.final_state[:, 0], decision.final_state)
    assert decision.model_steps == (39 if isinstance(planner, ExhaustivePlanner) else 1000)


@pytest.mark.parametrize("world", [random_world(1), stochastic_world(8)], ids=["sure", "stochastic"])
def test_what_is_collected_depends_on_the_generator_alone(world):
    planner, drawn = SamplingPlanner(MarkovPrior(3), 3, 20), []
    for seed in (3, 3, 4):
        torch.manual_seed(len(drawn))
        before = torch.get_rng_state()
        drawn.append(collect(planner, world, 200, generator=seeded(seed), context="step"))
        assert torch.equal(before, torch.get_rng_state())
    assert torch.equal(drawn[0].actions, drawn[1].actions)
    assert torch.equal(drawn[0].context, drawn[1].context)
    assert not torch.equal(drawn[0].context, drawn[2].context)


@pytest.mark.parametrize("bad", [-torch.inf, -1e30])
def test_a_legal_plan_wins_however_bad(bad):
    """From cell 0 only action 0 exists; it is as bad as can be, and action 1, which does not exist, would be good."""
    world = TabularWorld(
        torch.tensor([[0, 1], [0, 1]]), torch.tensor([bad, 5.0]), torch.tensor([[True, False], [True, True]])
    )
    starts = torch.zeros(50, dtype=torch.long)
    for planner in (ExhaustivePlanner(2), SamplingPlanner(UniformPrior(2), 2, 3)):
        decision = planner.plan(world, starts, seeded(0))
        assert not decision.plan.any()
        assert not decision.final_state.any()


@pytest.mark.parametrize("context", [None, "plan", "step"])
@pytest.mark.parametrize("maps", [1, 3])
def test_collect(context, maps):
    world = gridworld(4, 5, "torus", num_worlds=maps, seed=2)
    state = torch.randint(20 * maps, (30,), generator=seeded(0))
    plans = collect(ExhaustivePlanner(3), world, state=state, context=context, generator=seeded(1))
    assert isinstance(plans, Plans)
    assert (len(plans), plans.max_length, plans.num_actions) == (30, 3, 4)
    assert plans.action_names == ("up", "right", "down", "left")
    rollout = world.rollout(state, plans.actions[:, None])
    torch.testing.assert_close(rollout.rewards[:, 0, -1], oracle(world, state, 3))
    assert (plans.group is None) if maps == 1 else torch.equal(plans.group, state // 20)
    if context is None:
        assert plans.context is None
    elif context == "plan":
        assert torch.equal(plans.context, (state % 20)[:, None].expand(30, 3))
    else:
        now, observed = state, []
        for t in range(3):
            observed.append(world.observe(now))
            now, _ = world.step(now, plans.actions[:, t].long())
        assert torch.equal(plans.context, torch.stack(observed, 1))


def test_collect_from_random_starts_has_the_closed_form_on_a_torus():
    """A reward map for each start, so that plans are independent; 9 x 9 cells are enough not to meet oneself."""
    world = gridworld(9, 9, "torus", num_worlds=30_000, seed=5)
    plans = collect(ExhaustivePlanner(4), world, state=40 + 81 * torch.arange(30_000), generator=seeded(0))
    assert fits(plans.actions, best_plan_distribution(), 4)
    drawn = collect(ExhaustivePlanner(1), world, 5000, context="plan", generator=seeded(1))
    assert p_value(drawn.context, torch.ones(81)) > FALSE_ALARM
    assert p_value(drawn.group // 300, torch.ones(100)) > FALSE_ALARM


class Walk(World):
    """A world with states of two numbers, without a table; the reward is minus the distance from (2, 0)."""

    num_actions, objective, observation = 4, "terminal", Features(2)

    def observe(self, state):
        return state

    def reset(self, batch_size, generator=None):
        return torch.zeros(batch_size, 2)

    def step(self, state, action, generator=None):
        after = state + torch.tensor([[0.0, 1], [1, 0], [0, -1], [-1, 0]])[action.long()]
        return after, -(after - torch.tensor([2.0, 0])).norm(dim=-1)


@pytest.mark.parametrize("planner", [ExhaustivePlanner(2), SamplingPlanner(UniformPrior(4), 2, 300)])
def test_states_of_more_than_one_number(planner):
    decision = planner.plan(Walk(), Walk().reset(3), seeded(0))
    assert decision.plan.tolist() == [[1, 1]] * 3
    assert decision.final_state.tolist() == [[2.0, 0]] * 3
    assert decision.score.tolist() == [0.0] * 3
    plans = collect(planner, Walk(), 3, context="step", generator=seeded(0))
    assert plans.context.tolist() == [[[0.0, 0], [1, 0]]] * 3
    assert plans.group is None
    planner.value = lambda state: 10 * state[:, 1]
    assert planner.plan(Walk(), Walk().reset(3), seeded(0)).final_state.tolist() == [[0.0, 2]] * 3
