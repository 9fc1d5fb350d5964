"""Stochastic tables: draws against probabilities, rollouts against enumerated trajectories, and what is refused."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from eval.paper.values import can_reach, q_learning
from neuroprior import TabularWorld
from neuroprior.planners import value_iteration
from neuroprior.worlds.outcomes import Outcomes
from tests.support.sources import FALSE_ALARM, p_value, random_world, refuses, seeded, stochastic_world, trajectories

KINDS = ("S", "SA", "SAK", "WS", "WSA", "WSAK")


@pytest.mark.parametrize("outcomes", [1, 2, 3, 4, 5, 8, 11])
def test_draws_are_quantiles(outcomes):
    """The exact inverse of the distribution function, at and beside each of its steps, and none that is impossible."""
    weight = torch.randint(4, (6, outcomes), generator=seeded(outcomes)).double()
    weight[:, torch.randint(outcomes, (), generator=seeded(0))] += 1
    upper = weight.cumsum(-1) / weight.sum(-1, keepdim=True)
    outcomes_of = Outcomes((weight / weight.sum(-1, keepdim=True)).view(3, 2, outcomes), torch.device("cpu"))
    edges = upper.float().flatten()
    uniform = torch.cat([edges, edges - 2**-24, torch.arange(64) / 64, torch.tensor([1 - 2**-24])])
    uniform = uniform[(uniform >= 0) & (uniform < 1)]
    for row in range(6):
        for dtype in (torch.int32, torch.int64):
            drawn = outcomes_of.draw(torch.full((len(uniform),), row, dtype=dtype), uniform)
            assert drawn.dtype == dtype
            want = (upper[row].float() <= uniform[:, None]).sum(-1)
            assert (drawn - row * outcomes).tolist() == want.tolist()
            assert (weight[row][want] > 0).all()


def test_rounding_cannot_draw_past_the_last_outcome():
    """n times 1 / n need not sum to 1 in floating point; the last one, of probability 0, must not be drawn."""
    for n in (3, 10, 49, 1000):
        probability = torch.tensor([1 / n] * n + [0.0] * 3).view(1, 1, n + 3)
        outcomes_of = Outcomes(probability, torch.device("cpu"))
        assert outcomes_of.draw(torch.tensor([0]), torch.tensor([1 - 2**-24])).tolist() == [n - 1]
    outcomes_of = Outcomes(torch.tensor([[[0.5, 0.5 - 9e-7, 0.0]]], dtype=torch.float64), torch.device("cpu"))
    assert outcomes_of.draw(torch.tensor([0]), torch.tensor([1 - 2**-24])).tolist() == [1]


@pytest.mark.parametrize("kind", KINDS)
def test_step_has_the_given_probabilities_and_rewards(kind):
    world = stochastic_world(1, kind)
    assert world.stochastic
    cell, action = torch.meshgrid(torch.arange(5), torch.arange(3), indexing="ij")
    start = world.state(cell.flatten(), world.num_maps - 1).repeat(2000)
    action = action.flatten().repeat(2000)
    after, reward = world.step(start, action, seeded(0))
    assert (world.reward_map(after) == world.num_maps - 1).all()
    outcome = (world.next_state[world.cell(start), action] == world.cell(after)[:, None]).long().argmax(1)
    at = world.cell(start) * 3 + action
    assert p_value(at * 4 + outcome, world.probability.flatten()) > FALSE_ALARM
    given = world.reward[-1]
    where = {"S": (world.cell(after),), "A": (world.cell(start), action), "K": (world.cell(start), action, outcome)}
    assert torch.equal(reward, given[where[kind[-1]]])


@pytest.mark.parametrize("kind", ["WS", "WSA", "WSAK"])
def test_rollout_has_the_distribution_of_its_trajectories(kind):
    world = stochastic_world(2, kind)
    start, plan = 7, [2, 0, 1]
    all_courses = trajectories(world, start, plan)
    assert sum(p for p, _, _ in all_courses) == pytest.approx(1)
    rollout = world.rollout(torch.full((20_000,), start), torch.tensor([[plan]]).expand(20_000, 1, 3), seeded(0), True)
    number = {states: n for n, (_, states, _) in enumerate(all_courses)}
    drawn = torch.tensor([number[tuple(states)] for states in rollout.states[:, 0].tolist()])
    assert p_value(drawn, torch.tensor([p for p, _, _ in all_courses])) > FALSE_ALARM
    assert torch.equal(rollout.rewards[:, 0], torch.tensor([rewards for _, _, rewards in all_courses])[drawn])
    assert torch.equal(rollout.final_state, rollout.states[:, :, -1])


def test_plans_of_a_start_have_common_random_numbers_and_starts_do_not():
    world = stochastic_world(3)
    state = torch.full((4000,), 3)
    plans = torch.randint(3, (1, 5, 4), generator=seeded(1)).repeat(4000, 1, 1)
    plans[:, 3] = plans[:, 0]
    plans[:, 4, :2] = plans[:, 0, :2]
    rollout = world.rollout(state, plans, seeded(2), True)
    assert torch.equal(rollout.rewards[:, 3], rollout.rewards[:, 0])
    assert torch.equal(rollout.states[:, 3], rollout.states[:, 0])
    assert torch.equal(rollout.states[:, 4, :2], rollout.states[:, 0, :2])
    # Two starts, and two steps, have nothing to do with one another.
    first = rollout.states[:, 0, 0]
    share = first.bincount(minlength=10).double() / 4000
    assert p_value(first[::2] * 10 + first[1::2], (share[:, None] * share).flatten()) > FALSE_ALARM


@pytest.mark.parametrize("num_plans", [0, 1, 50])
def test_as_many_numbers_are_drawn_however_many_plans(num_plans):
    world, generator = stochastic_world(4), seeded(5)
    world.rollout(torch.arange(6), torch.zeros(6, num_plans, 7, dtype=torch.long), generator)
    other = seeded(5)
    torch.rand(6 * 7, generator=other)
    assert torch.equal(generator.get_state(), other.get_state())
    plain = seeded(5)
    random_world(0).rollout(torch.arange(6), torch.zeros(6, 3, 7, dtype=torch.long), plain)
    assert torch.equal(plain.get_state(), seeded(5).get_state())


@pytest.mark.parametrize("kind", ["S", "SA", "WS", "WSA"])
def test_a_certain_outcome_is_deterministic(kind):
    plain = random_world(6, kind)
    table = torch.stack([plain.next_state * 0, plain.next_state, plain.next_state, plain.next_state * 0 + 5], -1)
    probability = torch.tensor([0.0, 0.25, 0.75, 0.0]).expand(6, 3, 4)
    world = TabularWorld(table, plain.reward, probability=probability)
    state = plain.reset(40, seeded(0))
    plans = torch.randint(3, (40, 7, 5), generator=seeded(1))
    for got, want in zip(world.rollout(state, plans, None, True), plain.rollout(state, plans, None, True), strict=True):
        assert torch.equal(got, want)
    for got, want in zip(world.step(state, plans[:, 0, 0]), plain.step(state, plans[:, 0, 0]), strict=True):
        assert torch.equal(got, want)


@pytest.mark.parametrize("kind", KINDS)
def test_means(kind):
    world = stochastic_world(7, kind)
    values = torch.rand(world.num_maps, 5, generator=seeded(1))
    reward, after = world.mean_reward(), world.mean_after(values)
    assert reward.shape == after.shape == (world.num_maps, 5, 3)
    for number, cell, action in itertools.product(range(world.num_maps), range(5), range(3)):
        found = trajectories(world, number * 5 + cell, [action])
        assert float(reward[number, cell, action]) == pytest.approx(sum(p * r[0] for p, _, r in found))
        want = sum(p * float(values.view(-1)[s[0]]) for p, s, _ in found)
        assert float(after[number, cell, action]) == pytest.approx(want)


def test_what_cannot_occur_has_no_part_in_a_mean():
    world = TabularWorld(
        torch.tensor([[[0, 1]], [[1, 0]]]), torch.tensor([1.0, -torch.inf]), probability=torch.tensor([[[1.0, 0]]] * 2)
    )
    assert world.mean_reward().tolist() == [[[1.0], [-torch.inf]]]
    stays = torch.tensor([[[0, 0]], [[1, 1]]])
    reward = torch.tensor([[[[0.0, 5.0]], [[5.0, 0.0]]]])
    world = TabularWorld(stays, reward, probability=torch.tensor([[[1.0, 0.0]]] * 2))
    assert world.terminated(torch.arange(2)).tolist() == [True, False]


def test_values_are_those_of_the_mean():
    """One action: values solve a linear equation. Then a goal that each step reaches with probability 1/4."""
    world = stochastic_world(8, "WSAK", actions=1)
    moves = torch.zeros(5, 5).double().scatter_add(1, world.next_state[:, 0], world.probability[:, 0])
    rewards = world.mean_reward()[..., 0].double()
    want = torch.linalg.solve(torch.eye(5) - 0.8 * moves, rewards.T).T
    torch.testing.assert_close(value_iteration(world, discount=0.8), want, atol=1e-6, rtol=0)
    lazy = TabularWorld(
        torch.tensor([[[0, 1]], [[1, 1]]]), torch.zeros(2), probability=torch.tensor([[[0.75, 0.25]]] * 2)
    )
    # v = 0.9 (0.75 v + 0.25 / 0.9)
    want = 0.25 / (1 - 0.9 * 0.75)
    assert float(value_iteration(lazy, goal=1)[0, 0]) == pytest.approx(want, abs=1e-6)
    learned, again = (
        q_learning(lazy, 1, num_agents=400, steps=400, step_size=0.1, generator=seeded(0)) for _ in range(2)
    )
    assert torch.equal(learned, again)
    assert float(learned[:, 0, 0].mean()) == pytest.approx(want, abs=0.05)


TABLE = torch.tensor([[[0, 1], [1, 2]], [[2, 2], [0, 0]], [[1, 0], [2, 1]]])
EVEN = torch.full((3, 2, 2), 0.5)


def changed(*where_value):
    *where, value = where_value
    values = EVEN.clone()
    values[tuple(where)] = value
    return values


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"probability": None}, ["next_state", "[3, 2, 2]", "probability"]),
        ({"next_state": TABLE[..., 0]}, ["next_state", "[S, A, K]", "[3, 2]"]),
        ({"next_state": TABLE[..., :0], "probability": EVEN[..., :0]}, ["next_state", "[3, 2, 0]"]),
        ({"next_state": TABLE + 1}, ["next_state", "3"]),
        ({"probability": EVEN[:2]}, ["probability", "[3, 2, 2]", "[2, 2, 2]"]),
        ({"probability": TABLE}, ["probability", "int64"]),
        ({"probability": changed(1, 0, 0, 0.6)}, ["probability[1, 0]", "sum to 1", "1.1"]),
        ({"probability": changed(2, 1, 1, torch.nan)}, ["probability[2, 1, 1]", "nan"]),
        ({"legal_actions": torch.ones(3, 2, dtype=torch.bool)}, ["legal", "probability"]),
        ({"reward": torch.rand(3, 2, 3)}, ["reward", "[W, S, A, K]", "K = 2", "[3, 2, 3]"]),
    ],
)
def test_refuses(change, words):
    with refuses(*words):
        TabularWorld(**({"next_state": TABLE, "reward": torch.rand(3), "probability": EVEN} | change))


@settings(max_examples=60, deadline=None)
@given(
    where=st.tuples(st.integers(0, 2), st.integers(0, 1), st.integers(0, 1)),
    bad=st.floats(allow_nan=True, allow_infinity=True, width=32).filter(lambda p: not abs(p - 0.5) <= 1e-6),
)
def test_a_bad_probability_is_named(where, bad):
    with refuses("probability", str(list(where))[:5]):
        TabularWorld(TABLE, torch.rand(3), probability=changed(*where, bad))


def test_a_cube_of_rewards_is_ambiguous():
    table = torch.zeros(3, 3, 3, dtype=torch.long)
    probability = torch.full((3, 3, 3), 1 / 3)
    with refuses("reward", "[3, 3, 3]", "[1, S, A, K]"):
        TabularWorld(table, torch.rand(3, 3, 3), probability=probability)
    reward = torch.rand(3, 3, 3, 3)
    assert TabularWorld(table, reward, probability=probability).num_maps == 3
    assert TabularWorld(table, reward[:1], probability=probability).num_maps == 1


def test_reaching_a_goal_needs_a_deterministic_world():
    with refuses("deterministic"):
        can_reach(stochastic_world(0), torch.tensor([0]), 1, 3)
