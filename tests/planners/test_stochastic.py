"""Planners in stochastic worlds: exact means against enumerated trajectories, means over rollouts, ties."""

import pytest
import torch

from neuroprior import (
    ExhaustivePlanner,
    MarkovPrior,
    SamplingPlanner,
    TabularWorld,
    UniformPrior,
    World,
    oracle,
)
from neuroprior.planners import exact, expected_score
from neuroprior.planners.rollouts import mean_scores
from neuroprior.sampling import sample_in_world
from tests.support.sources import (
    FALSE_ALARM,
    TablePrior,
    every_plan,
    p_value,
    random_world,
    seeded,
    stochastic_world,
    trajectories,
)

VALUES = torch.rand(10, generator=seeded(99)) * 2 - 1


def value_of(state):
    return VALUES[state]


OBJECTIVES = [
    {},
    {"value": value_of},
    {"objective": "return"},
    {"objective": "return", "discount": 0.7, "value": value_of},
]
KINDS = ("S", "SA", "SAK", "WS", "WSA", "WSAK")
PLANS = every_plan(3, 3)


def brute_force(world, state, plan, goal):
    """The exact mean score of one plan, trajectory by trajectory."""
    total = 0.0
    discount = goal.get("discount", 1.0)
    for p, states, rewards in trajectories(world, state, plan):
        score = rewards[-1]
        if goal.get("objective") == "return":
            score = sum(reward * discount**t for t, reward in enumerate(rewards))
        if "value" in goal:
            score += discount ** len(rewards) * float(VALUES[states[-1]])
        total += p * score
    return total


@pytest.mark.parametrize("goal", OBJECTIVES)
@pytest.mark.parametrize("kind", KINDS)
def test_expected_scores_are_those_of_all_trajectories(kind, goal):
    world = stochastic_world(1, kind)
    states = torch.arange(world.num_maps * 5)
    plans = torch.randint(3, (len(states), 4, 3), generator=seeded(2))
    lengths = torch.randint(1, 4, (len(states), 4), generator=seeded(3))
    whole, cut = (
        expected_score(world, states, plans, **goal),
        expected_score(world, states, plans.to(torch.uint8), lengths=lengths, **goal),
    )
    assert whole.shape == cut.shape == (len(states), 4)
    assert whole.dtype == torch.float32
    for b in range(len(states)):
        for p in range(4):
            plan = plans[b, p].tolist()
            assert float(whole[b, p]) == pytest.approx(brute_force(world, b, plan, goal), abs=1e-5)
            assert float(cut[b, p]) == pytest.approx(brute_force(world, b, plan[: int(lengths[b, p])], goal), abs=1e-5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exact, "OUTCOMES_AT_ONCE", 60)
        assert torch.equal(expected_score(world, states, plans, **goal), whole)


def test_a_cell_that_cannot_be_has_no_part_in_the_mean():
    world = TabularWorld(torch.tensor([[0], [0]]), torch.tensor([[[1.0], [-torch.inf]]]))
    assert expected_score(world, torch.tensor([0]), torch.zeros(1, 1, 2, dtype=torch.long)).tolist() == [[1.0]]


@pytest.mark.parametrize("kind", ["SAK", "WS"])
def test_means_over_rollouts_come_to_the_expected_score(kind):
    """Rewards are in [0, 1]: by Hoeffding a mean of 4000 misses by 0.055 with probability 2 exp(-24), 1e-8 for all."""
    world = stochastic_world(4, kind)
    states = torch.arange(world.num_maps * 5)
    plans = PLANS.expand(len(states), -1, -1)
    planner = ExhaustivePlanner(3)
    score, ends = mean_scores(planner, world, states, plans, 4000, seeded(0))
    want = expected_score(world, states, plans)
    assert score.shape == ends.shape == (len(states), 27)
    assert float((score - want).abs().max()) < 0.055
    decision = ExhaustivePlanner(3, num_rollouts=4000).plan(world, states, seeded(1))
    assert decision.model_steps == 4000 * 28 * 3
    chosen = expected_score(world, states, decision.plan[:, None])[:, 0]
    assert (chosen > want.amax(1) - 0.11).all()
    assert (decision.score - chosen).abs().max() < 0.055


@pytest.mark.parametrize("prefix", [False, True])
@pytest.mark.parametrize("rollouts", [1, 6])
def test_all_plans_have_common_random_numbers_in_whatever_chunks(prefix, rollouts, monkeypatch):
    world = stochastic_world(5, "WSAK")
    states, planner = torch.arange(10), ExhaustivePlanner(3, any_prefix=prefix)
    plans = torch.cat([PLANS, PLANS]).expand(10, -1, -1)
    together = mean_scores(planner, world, states, plans, rollouts, seeded(0))
    planner.steps_at_once = 1000
    sizes, rollout = [], world.rollout
    monkeypatch.setattr(world, "rollout", lambda s, p, *rest: sizes.append(p.numel()) or rollout(s, p, *rest))
    apart = mean_scores(planner, world, states, plans, rollouts, seeded(0))
    assert max(sizes) <= 1000
    assert len(sizes) > 1
    for first, second in zip(together, apart, strict=True):
        assert torch.equal(first, second)
        assert torch.equal(first[:, :27], first[:, 27:])


@pytest.mark.parametrize("prefix", [False, True])
@pytest.mark.parametrize(
    "make",
    [
        lambda **rest: ExhaustivePlanner(3, **rest),
        lambda **rest: SamplingPlanner(UniformPrior(3), 3, 9, **rest),
        lambda **rest: SamplingPlanner(MarkovPrior(3, num_contexts=5), 3, 9, **rest),
        lambda **rest: SamplingPlanner(MarkovPrior(3, num_contexts=5), 3, 9, uniform_share=1 / 3, **rest),
    ],
)
def test_a_decision_is_what_the_first_rollout_says(make, prefix, monkeypatch):
    """With one rollout and rewards on arrival the score is the reward where the plan, or its executed part, ends."""
    world = stochastic_world(6, "WS")
    planner = make(any_prefix=prefix, num_rollouts=1)
    decision = planner.plan(world, torch.arange(10).repeat(20), seeded(0))
    assert torch.equal(decision.score, world.reward.view(-1)[decision.final_state])
    assert (decision.lengths is not None) == prefix
    tried, rollout = [], world.rollout
    monkeypatch.setattr(world, "rollout", lambda *rest: tried.append(rollout(*rest)) or tried[-1])
    many = make(any_prefix=prefix, num_rollouts=50).plan(world, torch.arange(10).repeat(20), seeded(0))
    final, _, states = tried[-1]  # of the chosen plan alone
    first = (final if states is None else states)[::50].flatten(1)
    assert (first == many.final_state[:, None]).any(1).all()
    drawn_in_world = 0
    if isinstance(planner, SamplingPlanner) and planner.prior.takes_context:
        drawn_in_world = 6 if planner.uniform_share else 9
    assert many.model_steps == 3 * (50 * (28 if isinstance(planner, ExhaustivePlanner) else 10) + drawn_in_world)
    if many.lengths is not None:
        assert not many.plan[torch.arange(3) >= many.lengths[:, None]].any()
        exact = expected_score(world, torch.arange(10).repeat(20), many.plan[:, None], lengths=many.lengths[:, None])
    else:
        exact = expected_score(world, torch.arange(10).repeat(20), many.plan[:, None])
    # Rewards are in [0, 1]: by Hoeffding the mean of 200 rollouts of 200 starts is .22 too high with probability 1e-8.
    one = planner.plan(world, torch.arange(10).repeat(20), seeded(3))
    lengths = None if one.lengths is None else one.lengths[:, None]
    true = expected_score(world, torch.arange(10).repeat(20), one.plan[:, None], lengths=lengths)[:, 0]
    for score, due in ((one.score, true), (many.score, exact[:, 0])):
        assert abs(float((score - due).mean())) < 0.22


def test_prefixes_win_ties_as_often_as_each_other():
    """All is equally good: each of the 3 + 9 + 27 distinct prefixes is a uniform draw, as in a deterministic world."""
    table = torch.randint(3, (3, 3, 2), generator=seeded(0))
    world = TabularWorld(table, torch.ones(3), probability=torch.full((3, 3, 2), 0.5))
    for rollouts in (1, 3):
        planner = ExhaustivePlanner(3, any_prefix=True, num_rollouts=rollouts)
        decision = planner.plan(world, torch.zeros(10_000, dtype=torch.long), seeded(1))
        number = (decision.plan.long() * torch.tensor([9, 3, 1])).sum(1)
        code = (decision.lengths - 1) * 27 + number
        weight = torch.zeros(3, 27)
        weight[0, ::9] = weight[1, ::3] = weight[2] = 1
        assert p_value(code, weight.flatten()) > FALSE_ALARM


def test_plans_drawn_along_with_the_world_are_scored_by_new_rollouts():
    """A coin leads to cell 1 or 2; a prior with context is always right, but a plan cannot be: it wins half."""
    table = torch.tensor([[[1, 2]] * 2, [[3, 3], [4, 4]], [[4, 4], [3, 3]], [[3, 3]] * 2, [[4, 4]] * 2])
    world = TabularWorld(table, torch.tensor([0.0, 0, 0, 1, 0]), probability=torch.full((5, 2, 2), 0.5))
    prior = TablePrior([torch.zeros(1, 1, 2), torch.zeros(1, 2, 2)])
    prior.num_contexts, prior.context_per = 5, "step"
    answers = torch.tensor([[0.0, 0], [100, 0], [0, 100], [0, 0], [0, 0]])
    prior.start = lambda n, context=None: (answers[context], context[:, None])
    prior.step = lambda action, state, context=None: (answers[context], state)
    planner = SamplingPlanner(prior, 2, 1)
    state = torch.zeros(5000, dtype=torch.long)
    _, rollout = sample_in_world(prior, world, state, 1, 2, generator=seeded(0))
    assert bool((rollout.rewards[..., -1] == 1).all())
    decision = planner.plan(world, state, seeded(0))
    assert p_value(decision.score.long(), torch.ones(2)) > FALSE_ALARM


@pytest.mark.parametrize("goal", OBJECTIVES)
@pytest.mark.parametrize("prefix", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_oracle_is_the_best_policy_and_no_plan_is_better(kind, prefix, goal):
    world = stochastic_world(7, kind)
    states = torch.arange(world.num_maps * 5)
    discount = goal.get("discount", 1.0)

    def best(state, left):
        """The best of all policies, by recursion over what may happen."""
        if left == 0:
            return float(VALUES[state]) if "value" in goal else 0.0
        found = []
        for action in range(3):
            counts = goal.get("objective") == "return" or left == 1
            found.append(
                sum(
                    p * (counts * rewards[0] + discount * best(after[0], left - 1))
                    for p, after, rewards in trajectories(world, state, [action])
                )
            )
        return max(found)

    depths = (1, 2) if prefix else (2,)
    got = oracle(world, states, 2, any_prefix=prefix, **goal)
    want = [max(best(state, depth) for depth in depths) for state in states.tolist()]
    torch.testing.assert_close(got, torch.tensor(want), atol=1e-5, rtol=0)
    for depth in depths:
        plans = every_plan(3, depth).expand(len(states), -1, -1)
        assert (expected_score(world, states, plans, **goal).amax(1) <= got + 1e-5).all()


@pytest.mark.parametrize(
    "make",
    [
        lambda **rest: ExhaustivePlanner(3, **rest),
        lambda **rest: SamplingPlanner(UniformPrior(3), 3, 9, **rest),
        lambda **rest: SamplingPlanner(MarkovPrior(3, num_contexts=6), 3, 9, any_prefix=True, **rest),
    ],
)
def test_in_a_deterministic_world_one_rollout_is_taken(make):
    world, states = random_world(1), torch.arange(12)
    one, five = (make(num_rollouts=n).plan(world, states, seeded(0)) for n in (1, 5))
    for first, second in zip(one, five, strict=True):
        assert first == second if not isinstance(first, torch.Tensor) else torch.equal(first, second)


class Gusty(World):
    """A world of one's own, stochastic, with states of two numbers: a gust may add a half to the right move."""

    num_actions = 2
    stochastic = True

    def reset(self, batch_size, generator=None):
        return torch.zeros(batch_size, 2)

    def step(self, state, action, generator=None):
        gust = (torch.rand(len(state), generator=generator) < 0.5) * 0.5
        after = state + torch.stack([action * (1 + gust), torch.ones(len(state))], 1)
        return after, after[:, 0] - state[:, 0]


def test_worlds_of_ones_own():
    for planner in (ExhaustivePlanner(3, num_rollouts=200), SamplingPlanner(UniformPrior(2), 3, 60, num_rollouts=200)):
        planner.objective = "return"
        decision = planner.plan(Gusty(), torch.zeros(4, 2), seeded(0))
        assert decision.plan.tolist() == [[1, 1, 1]] * 4
        assert decision.final_state.shape == (4, 2)
        assert ((decision.score - 3.75).abs() < 0.4).all()  # 200 x 3 gusts, each 0 or a half: 13 standard deviations


@pytest.mark.parametrize("prior", [UniformPrior(3), MarkovPrior(3, num_contexts=5)])
@pytest.mark.parametrize("num_plans", [1, 2, 5, 16, 100, 257])
def test_a_budget_of_rollouts_is_divided_where_nothing_else_is_said(prior, num_plans):
    """About its root of plans, each as often; all steps are counted, and are no more than the budget."""
    world = stochastic_world(6, "WS")
    planner, taken, rollout, step = SamplingPlanner(prior, 3, num_plans), [], world.rollout, world.step
    planner.keep_candidates = True
    world.rollout = lambda state, plans, *rest: taken.append(plans.numel()) or rollout(state, plans, *rest)
    world.step = lambda state, *rest: taken.append(len(state)) or step(state, *rest)
    decision = planner.plan(world, torch.tensor([2]), seeded(0))
    tried = decision.candidates.plans.shape[1]
    assert decision.model_steps == sum(taken)
    assert decision.model_steps <= 3 * max(num_plans, 1 + prior.takes_context)
    assert tried == {1: 1, 2: 1, 5: 1 + prior.takes_context, 16: 3, 100: 9, 257: 15}[num_plans]
