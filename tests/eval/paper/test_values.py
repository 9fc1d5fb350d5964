"""Value iteration and exact reach, against hand-computed cases and brute force over all plans."""

import pytest
import torch

from eval.paper.values import can_reach
from neuroprior.planners import value_iteration
from neuroprior.worlds import TabularWorld, gridworld
from tests.support.sources import CORRIDOR, corridor, distances, every_plan, seeded

GRID = gridworld(3, 3)


@pytest.mark.parametrize("edges", ["wall", "torus"])
@pytest.mark.parametrize("discount", [0.9, 0.5])
def test_goal_values_fall_by_the_discount_with_each_step(edges, discount):
    world = gridworld(5, 6, edges)
    values = value_iteration(world, goal=9, discount=discount)
    assert values.shape == (1, 30)
    assert values.dtype == torch.float64
    expected = discount ** (distances(5, 6, 9, edges == "torus").double() - 1)
    torch.testing.assert_close(values[0], expected)


def test_goal_values_are_exact_however_far_the_goal():
    cell = torch.arange(400)
    world = TabularWorld(torch.stack([(cell - 1).clamp(min=0), (cell + 1).clamp(max=399)], 1), torch.zeros(400))
    torch.testing.assert_close(value_iteration(world, goal=0)[0], 0.9 ** (cell.double() - 1), atol=0, rtol=1e-9)


def test_goal_values_cut_short_reach_as_far_as_the_sweeps():
    exact = value_iteration(gridworld(5, 5), goal=12)
    far = distances(5, 5, 12, torus=False)
    for sweeps in range(6):
        values = value_iteration(gridworld(5, 5), goal=12, sweeps=sweeps)
        torch.testing.assert_close(values, torch.where(far <= sweeps, exact, 0.0))


def test_a_goal_that_cannot_be_reached_is_worth_nothing():
    world = TabularWorld(torch.tensor([[0, 1], [1, 1], [2, 2]]), torch.zeros(3))
    assert value_iteration(world, goal=1, discount=0.5).tolist() == [[1.0, 2.0, 0.0]]


def test_rewards_of_actions_by_hand():
    reward = torch.zeros(4, 2)
    reward[0, 0] = 1.0  # bumping into the left wall
    reward[3, 0] = 8.0  # leaving the right end
    values = value_iteration(corridor(reward), discount=0.5)
    # Between cells 3 and 2 and back: 8 + 0 / 2 + 8 / 4 ... = 32/3; from cell 2 half of it, from 1 a quarter, from 0 an
    # eighth = 4/3, where bumping for ever brings 2.
    expected = torch.tensor([[2.0, 8 / 3, 16 / 3, 32 / 3]], dtype=torch.float64)
    torch.testing.assert_close(values, expected, atol=1e-8, rtol=0)


def test_reward_maps_are_independent():
    maps = torch.rand(3, 4, generator=seeded(0)).double()
    together = value_iteration(corridor(maps))
    assert together.shape == (3, 4)
    for reward, values in zip(maps, together, strict=True):
        torch.testing.assert_close(value_iteration(corridor(reward))[0], values, atol=1e-7, rtol=0)
    per_action = value_iteration(TabularWorld(CORRIDOR, maps[:, CORRIDOR]))
    torch.testing.assert_close(per_action, together, atol=0, rtol=0)


def test_own_rewards_cut_short_are_the_best_return_of_so_many_steps():
    world = gridworld(3, 3, num_worlds=2, seed=3)
    states = world.reset(5, seeded(0))
    plans = every_plan(4, 3)
    rewards = world.rollout(states, plans.expand(5, -1, -1)).rewards.double()
    best = (rewards * 0.9 ** torch.arange(3)).sum(-1).amax(1)
    torch.testing.assert_close(value_iteration(world, sweeps=3).view(-1)[states], best)
    assert value_iteration(world, sweeps=0).tolist() == [[0.0] * 9] * 2


def test_illegal_actions_are_not_taken():
    legal = torch.tensor([[True, True], [True, False], [True, True], [True, True]])  # no way right from cell 1
    values = value_iteration(corridor(legal=legal), goal=3, discount=0.5)
    assert values.tolist() == [[0.0, 0.0, 1.0, 2.0]]
    reward = torch.ones(4, 2)
    reward[1, 1] = torch.inf  # of an action that does not exist
    torch.testing.assert_close(value_iteration(corridor(reward, legal)), torch.full((1, 4), 10.0).double())


def test_discount_zero_counts_one_reward():
    assert value_iteration(corridor([5.0, 0.0, 1.0, 2.0]), discount=0).tolist() == [[5.0, 5.0, 2.0, 2.0]]


def test_values_too_large_for_the_tolerance_come_to_an_end():
    # Here the last bits of the values change for ever, by 3e-5.
    draw = seeded(7)
    next_state = torch.randint(6, (6, 2), generator=draw)
    reward = (torch.rand(6, 2, generator=draw).double() - 0.5) * 1e12
    values = value_iteration(TabularWorld(next_state, reward), discount=0.5)
    torch.testing.assert_close(values[0], (reward + 0.5 * values[0, next_state]).amax(-1))


@pytest.mark.parametrize("edges", ["wall", "torus"])
@pytest.mark.parametrize("size", [(3, 4), (4, 4)])
def test_can_reach_agrees_with_all_plans(edges, size):
    world = gridworld(*size, edges)
    states = torch.arange(world.num_states)
    for length in range(5):
        plans = every_plan(4, length)
        now = states[:, None].expand(-1, len(plans))
        passed = now == 5
        for action in plans.T:
            now = world.next_state[now, action]
            passed = passed | (now == 5)
        assert torch.equal(can_reach(world, states, 5, length), (now == 5).any(1))
        assert torch.equal(can_reach(world, states, 5, length, within=True), passed.any(1))


def test_can_reach_depends_on_legal_actions_and_the_cell_of_a_state():
    legal = torch.tensor([[True, True], [True, False], [True, True], [True, True]])
    world = corridor(torch.zeros(2, 4), legal)
    states = torch.tensor([7, 6, 1, 0, 2])
    assert can_reach(world, states, 3, 3, within=True).tolist() == [True, True, False, False, True]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"discount": 1.0}, "`discount` must be"),
        ({"discount": 0.0, "goal": 1}, "`discount` must be at least 0"),
        ({"goal": 9}, "`goal` must be"),
        ({"tolerance": 0.0}, "`tolerance` must be"),
    ],
)
def test_bad_iteration_is_refused(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        value_iteration(GRID, **arguments)


def test_infinite_rewards_are_refused_where_they_count():
    world = corridor([0.0, 0.0, 0.0, -torch.inf])
    with pytest.raises(ValueError, match=r"^world: the reward of \[map, cell, action\] \[0, 2, 1\] is infinite"):
        value_iteration(world)
    assert value_iteration(world, goal=3, sweeps=1)[0, 2] == 1


@pytest.mark.parametrize(
    ("state", "goal", "length", "message"),
    [
        (torch.tensor([9]), 4, 2, r"state\[0\]: 9 is out of range"),
        (torch.tensor([0.5]), 4, 2, "`state` must be"),
        (torch.tensor(3), 4, 2, "`state` must be"),
        (torch.tensor([1]), 9, 2, "`goal`"),
        (torch.tensor([1]), 4, -1, "`length` must be"),
    ],
)
def test_bad_reach_is_refused(state, goal, length, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        can_reach(GRID, state, goal, length)
