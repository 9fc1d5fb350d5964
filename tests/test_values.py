"""Values: against hand-computed cases, brute force over all plans, and each other."""

import pytest
import torch

from neuroprior.values import can_reach, network_approximation, q_learning, tile_approximation, value_iteration
from neuroprior.worlds import TabularWorld, gridworld
from tests.sources import every_plan, seeded

CORRIDOR = torch.tensor([[0, 1], [0, 2], [1, 3], [2, 3]])  # four cells in a row; actions left, right; walls at the ends


def corridor(reward=(0.0, 0.0, 0.0, 0.0), legal=None):
    return TabularWorld(CORRIDOR, torch.as_tensor(reward), legal)


def distances(height, width, goal, torus):
    """Steps to the goal from each cell `[height * width]`, from the coordinates alone."""
    cell = torch.arange(height * width)
    rows, columns = (cell // width - goal // width).abs(), (cell % width - goal % width).abs()
    if torus:
        rows, columns = torch.minimum(rows, height - rows), torch.minimum(columns, width - columns)
    return rows + columns


# Value iteration


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


def test_rewards_on_arrival_by_hand():
    # Reward 1 in the last cell, for ever: 1 / (1 - 1/2) = 2 beside it and in it, and half as much a step further.
    values = value_iteration(corridor([0.0, 0.0, 0.0, 1.0]), discount=0.5)
    torch.testing.assert_close(values, torch.tensor([[0.5, 1.0, 2.0, 2.0]]).double(), atol=1e-8, rtol=0)


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


def test_discount_zero_sees_one_reward():
    assert value_iteration(corridor([5.0, 0.0, 1.0, 2.0]), discount=0).tolist() == [[5.0, 5.0, 2.0, 2.0]]


def test_values_too_large_for_the_tolerance_come_to_an_end():
    # Here the last bits of the values change for ever, by 3e-5.
    draw = seeded(7)
    next_state = torch.randint(6, (6, 2), generator=draw)
    reward = (torch.rand(6, 2, generator=draw).double() - 0.5) * 1e12
    values = value_iteration(TabularWorld(next_state, reward), discount=0.5)
    torch.testing.assert_close(values[0], (reward + 0.5 * values[0, next_state]).amax(-1))


def test_values_after_the_goal_moved_lead_to_the_old_one():
    world = gridworld(4, 4)
    old, new = value_iteration(world, goal=0), value_iteration(world, goal=15)
    assert int(old.argmax()) == 0
    assert int(new.argmax()) == 15
    assert old[0, 15] == old.min()


# Q-learning


@pytest.mark.parametrize("edges", ["wall", "torus"])
def test_q_learning_with_exploration_comes_to_the_true_values(edges):
    world = gridworld(4, 4, edges)
    learned = q_learning(world, 5, num_agents=4, steps=4000, epsilon=1.0, step_size=1.0, generator=seeded(0))
    true = value_iteration(world, goal=5)
    torch.testing.assert_close(learned.amax(-1), true.expand(4, -1), atol=1e-9, rtol=0)
    after = torch.where(torch.arange(16)[:, None] == 5, 1 / 0.9, 0.9 * true[0][world.next_state])
    torch.testing.assert_close(learned, after.expand(4, -1, -1), atol=1e-9, rtol=0)


def test_some_exploration_and_half_steps_come_there_too():
    world = gridworld(3, 4, "wall")
    learned = q_learning(world, 5, num_agents=3, steps=6000, epsilon=0.5, discount=0.8, generator=seeded(1))
    true = value_iteration(world, goal=5, discount=0.8)
    torch.testing.assert_close(learned.amax(-1), true.expand(3, -1), atol=1e-3, rtol=0)


def test_greedy_learning_is_cut_short():
    world = gridworld(10, 10)
    true = value_iteration(world, goal=55)
    error = [
        float((q_learning(world, 55, num_agents=20, steps=n, generator=seeded(0)).amax(-1) - true).abs().mean())
        for n in (0, 500, 4000)
    ]
    assert error[0] > error[1] > error[2] > 0.01


def test_one_step_changes_one_action_of_each_agent_by_the_rule():
    world = gridworld(3, 3, "torus")
    before = q_learning(world, 4, num_agents=50, steps=0, generator=seeded(0))
    after = q_learning(world, 4, num_agents=50, steps=1, generator=seeded(0))
    agent, cell, action = (before != after).nonzero().T
    assert agent.tolist() == list(range(50))
    assert (before[agent, cell].argmax(1) == action).all()
    target = 0.9 * before[agent, world.next_state[cell, action]].amax(1)
    torch.testing.assert_close(after[agent, cell, action], (before[agent, cell, action] + target) / 2)
    assert (target > 0.99).any()
    assert (target < 0.99).any()


def test_initial_values_and_the_goal():
    settings = {"num_agents": 300, "steps": 0, "discount": 0.5, "initial_scale": 0.2}
    values = q_learning(gridworld(3, 3), 4, generator=seeded(0), **settings)
    assert values.shape == (300, 9, 4)
    assert values.dtype == torch.float64
    assert (values[:, 4] == 2).all()
    others = values[:, torch.arange(9) != 4]
    assert others.min() >= 0
    assert 0.199 < others.max() < 0.2
    assert abs(others.mean() - 0.1) < 0.005


def test_same_seed_same_values_and_agents_differ():
    world = gridworld(4, 4)
    first, again, other = (q_learning(world, 5, num_agents=3, steps=300, generator=seeded(s)) for s in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first[1], first[2])


def test_global_random_state_is_neither_read_nor_changed():
    values = torch.rand(2, 16, generator=seeded(0))
    world = gridworld(4, 4)
    before = torch.get_rng_state()
    for _ in range(2):
        q_learning(world, 5, steps=5, epsilon=0.5, generator=seeded(0))
        q_learning(world, 5, steps=5)
        network_approximation(values, world.coordinates(torch.arange(16)), steps=2, generator=seeded(0))
    assert torch.equal(before, torch.get_rng_state())


def test_ties_are_broken_at_random():
    world = gridworld(5, 5, "torus")
    values = q_learning(world, 12, num_agents=4000, initial_scale=0.0, steps=1, step_size=1.0, generator=seeded(0))
    learned = values[:, [7, 11, 13, 17]].reshape(4000, 4, 4).sum(0)  # beside the goal only one action of four is paid
    taken = learned[torch.arange(4), torch.tensor([2, 1, 3, 0])]
    assert learned.sum() == taken.sum()
    # Of 4000 agents one in 24 starts in each of these cells, and one in four of those steps into the goal: 42 each.
    assert (taken - 4000 / 96).abs().max() < 4 * (4000 / 96) ** 0.5


@pytest.mark.parametrize("epsilon", [0.0, 1.0])
def test_q_learning_takes_legal_actions_only(epsilon):
    legal = torch.tensor([[False, True], [True, True], [True, True], [True, False]])
    world, settings = corridor(legal=legal), {"num_agents": 5, "steps": 1500, "step_size": 0.25}
    values = q_learning(world, 3, epsilon=epsilon, generator=seeded(0), **settings)  # an illegal step would leave NaN
    assert torch.equal(values.isinf(), (~legal).expand(5, -1, -1))
    assert (values[:, ~legal] == -torch.inf).all()
    state_values = values.amax(-1)
    assert state_values.isfinite().all()
    if epsilon:
        expected = value_iteration(world, goal=3).expand(5, -1)
        torch.testing.assert_close(state_values, expected, atol=1e-6, rtol=0)


def test_the_worlds_own_rewards_do_not_matter():
    first, second = (q_learning(gridworld(4, 4, seed=s), 5, steps=200, generator=seeded(0)) for s in (0, 1))
    assert torch.equal(first, second)


def test_progress_is_reported():
    seen = []
    q_learning(gridworld(3, 3), 4, steps=7, progress=lambda done, steps: seen.append((done, steps)))
    assert seen == [(n, 7) for n in range(1, 8)]


# Reach


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


def test_even_plans_on_a_torus_keep_the_parity():
    world = gridworld(20, 20, "torus")
    states = torch.arange(400)
    even = distances(20, 20, 210, torus=True) % 2 == 0
    assert torch.equal(can_reach(world, states, 210, 40), even)
    assert torch.equal(can_reach(world, states, 210, 41), ~even)
    assert can_reach(world, states, 210, 20, within=True).all()
    assert can_reach(gridworld(20, 20, "wall"), states, 210, 40).all()


def test_can_reach_sees_legal_actions_and_the_cell_of_a_state():
    legal = torch.tensor([[True, True], [True, False], [True, True], [True, True]])
    world = corridor(torch.zeros(2, 4), legal)
    states = torch.tensor([7, 6, 1, 0, 2])
    assert can_reach(world, states, 3, 3, within=True).tolist() == [True, True, False, False, True]


# Approximations


@pytest.fixture(scope="module")
def peak():
    """The true values of a goal in a grid, and the coordinates of its cells."""
    world = gridworld(10, 12)
    return value_iteration(world, goal=66), world.coordinates(torch.arange(120))


def rms(approximation, values):
    return float((approximation - values).square().mean().sqrt())


def test_tiles_of_one_cell_are_exact(peak):
    values, coordinates = peak
    for num_tilings in (1, 3):
        torch.testing.assert_close(tile_approximation(values, coordinates, 1, num_tilings), values)


def test_one_tiling_takes_the_mean_of_each_tile(peak):
    values, coordinates = peak
    blocks = values.view(5, 2, 6, 2)
    means = blocks.mean((1, 3), keepdim=True).expand_as(blocks).reshape(1, 120)
    torch.testing.assert_close(tile_approximation(values, coordinates, 2), means)
    torch.testing.assert_close(tile_approximation(values, coordinates + 7.5, 2), means)
    torch.testing.assert_close(tile_approximation(values, coordinates, 100), values.mean().expand(1, 120))


def test_more_tilings_and_smaller_tiles_come_closer(peak):
    values, coordinates = peak
    by_tilings = [rms(tile_approximation(values, coordinates, 4, n), values) for n in (1, 2, 4)]
    assert by_tilings[0] > by_tilings[1] > by_tilings[2] > 0
    by_size = [rms(tile_approximation(values, coordinates, size), values) for size in (8, 4, 2)]
    assert by_size[0] > by_size[1] > by_size[2] > 0
    # Tilings that no cell can tell from those before, and are linearly dependent on them, change nothing.
    dependent = tile_approximation(values, coordinates, 4, 8)
    torch.testing.assert_close(dependent, tile_approximation(values, coordinates, 4, 4))


def test_functions_are_fitted_each_by_itself(peak):
    values, coordinates = peak
    several = torch.cat([values, -3 * values, torch.rand(1, 120, generator=seeded(0)).double()])
    together = tile_approximation(several, coordinates, 3, 3)
    for one, approximation in zip(several, together, strict=True):
        torch.testing.assert_close(tile_approximation(one[None], coordinates, 3, 3)[0], approximation)


def test_networks_come_closer_with_more_steps(peak):
    values, coordinates = peak
    errors = [
        rms(network_approximation(values, coordinates, steps=steps, generator=seeded(0)), values)
        for steps in (1, 30, 300)
    ]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.02 < rms(values.mean(), values)


def test_networks_learn_independently_and_again(peak):
    values, coordinates = peak
    twice, other_units = values.expand(2, -1), torch.cat([values, 100 * values + 7])
    with torch.no_grad():
        first = network_approximation(twice, coordinates, steps=20, generator=seeded(0))
        again = network_approximation(twice, coordinates, steps=20, generator=seeded(0))
        scaled = network_approximation(other_units, coordinates, steps=20, generator=seeded(0))
    assert torch.equal(first, again)
    assert not first.requires_grad
    assert not torch.allclose(first[0], first[1], atol=1e-4)
    torch.testing.assert_close(scaled[0], first[0])
    torch.testing.assert_close(scaled[1], 100 * first[1] + 7, rtol=1e-4, atol=1e-4)


def test_approximations_keep_shape_and_dtype(peak):
    values, coordinates = peak
    for dtype in (torch.float32, torch.float64):
        for approximation in (
            tile_approximation(values.to(dtype), coordinates, 4),
            network_approximation(values.to(dtype), coordinates, steps=1, generator=seeded(0)),
        ):
            assert approximation.shape == (1, 120)
            assert approximation.dtype == dtype


def test_constant_values_and_coordinates_are_fitted():
    coordinates = torch.tensor([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    for approximation in (
        tile_approximation(torch.full((1, 3), 4.0), coordinates, 1.5),
        network_approximation(torch.full((1, 3), 4.0), coordinates, steps=3),
    ):
        torch.testing.assert_close(approximation, torch.full((1, 3), 4.0))


# Bad input

GRID = gridworld(3, 3)
PLACES = GRID.coordinates(torch.arange(9))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"goal": 9}, "goal: a cell from 0 to 8 is expected, not 9"),
        ({"goal": -1}, "goal: a cell"),
        ({"goal": 1.5}, "goal: a cell from 0 to 8 is expected, not 1.5"),
        ({"num_agents": 0}, "num_agents: at least 1 is expected, not 0"),
        ({"steps": -1}, "steps: "),
        ({"step_size": 0}, "step_size: "),
        ({"step_size": 1.5}, "step_size: a number above 0 and at most 1 is expected, not 1.5"),
        ({"discount": 0}, "discount: "),
        ({"discount": 1}, "discount: a number above 0 and below 1 is expected, not 1"),
        ({"initial_scale": -0.1}, "initial_scale: "),
        ({"initial_scale": float("nan")}, "initial_scale: "),
        ({"epsilon": 1.1}, "epsilon: a share between 0 and 1 is expected, not 1.1"),
    ],
)
def test_bad_learning_is_refused(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        q_learning(GRID, **{"goal": 4, **arguments})


def test_a_goal_alone_is_refused():
    with pytest.raises(ValueError, match=r"^world: a cell that is not the goal is expected"):
        q_learning(TabularWorld(torch.tensor([[0, 0]]), torch.zeros(1)), 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"discount": 1.0}, "discount: "),
        ({"discount": -0.1}, "discount: "),
        ({"discount": float("nan")}, "discount: "),
        ({"discount": 0.0, "goal": 1}, "discount: with a goal, a number above 0 is expected, not 0.0"),
        ({"goal": 9}, "goal: "),
        ({"sweeps": -1}, "sweeps: "),
        ({"tolerance": 0.0}, "tolerance: "),
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
        (torch.tensor([9]), 4, 2, "state"),
        (torch.tensor([0.5]), 4, 2, "state"),
        (torch.tensor(3), 4, 2, "state"),
        (torch.tensor([1]), 9, 2, "goal"),
        (torch.tensor([1]), 4, -1, "length"),
    ],
)
def test_bad_reach_is_refused(state, goal, length, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        can_reach(GRID, state, goal, length)


@pytest.mark.parametrize(
    ("values", "coordinates", "message"),
    [
        (torch.zeros(9), PLACES, r"values: shape \[K, S\] is expected, not \[9\]"),
        (torch.zeros(0, 9), PLACES, "values: shape"),
        (torch.zeros(1, 9, dtype=torch.long), PLACES, "values: floating point is expected, not torch.int64"),
        (torch.zeros(1, 8), PLACES, r"coordinates: shape \[S, D\] with S = 8 is expected, not \[9, 2\]"),
        (torch.zeros(1, 9), PLACES[:, 0], "coordinates: shape"),
        (torch.zeros(1, 9), PLACES[:, :0], "coordinates: shape"),
        (torch.zeros(1, 9).fill_(float("nan")), PLACES, r"values\[0, 0\]: a finite number is expected, not nan"),
        (torch.zeros(1, 9), torch.inf * (PLACES + 1.0), r"coordinates\[0, 0\]: a finite number is expected, not inf"),
    ],
)
def test_bad_values_and_coordinates_are_refused(values, coordinates, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        tile_approximation(values, coordinates, 1)
    with pytest.raises(ValueError, match=f"^{message}"):
        network_approximation(values, coordinates)


@pytest.mark.parametrize(("tile_size", "num_tilings"), [(0, 1), (float("inf"), 1), (1, 0)])
def test_bad_tiles_are_refused(tile_size, num_tilings):
    with pytest.raises(ValueError, match=r"^(tile_size|num_tilings): "):
        tile_approximation(torch.zeros(1, 9), PLACES, tile_size, num_tilings)


@pytest.mark.parametrize("name", ["hidden_size", "steps", "learning_rate"])
def test_bad_networks_are_refused(name):
    with pytest.raises(ValueError, match=f"^{name}: a positive, finite number is expected, not 0"):
        network_approximation(torch.zeros(1, 9), PLACES, **{name: 0})
