"""Q-learning: it comes to the true values where it explores, follows its rule, and is reproducible."""

import pytest
import torch

from eval.paper.values import q_learning
from neuroprior.planners import value_iteration
from neuroprior.worlds import TabularWorld, gridworld
from tests.support.sources import corridor, seeded

GRID = gridworld(3, 3)


@pytest.mark.parametrize("edges", ["wall", "torus"])
def test_q_learning_with_exploration_comes_to_the_true_values(edges):
    world = gridworld(4, 4, edges)
    learned = q_learning(world, 5, num_agents=4, steps=2500, epsilon=1.0, step_size=1.0, generator=seeded(0))
    true = value_iteration(world, goal=5)
    torch.testing.assert_close(learned.amax(-1), true.expand(4, -1), atol=1e-9, rtol=0)
    after = torch.where(torch.arange(16)[:, None] == 5, 1 / 0.9, 0.9 * true[0][world.next_state])
    torch.testing.assert_close(learned, after.expand(4, -1, -1), atol=1e-9, rtol=0)


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
    """Whatever the rewards of the world, and torch's global generator."""
    made = []
    for reward_seed, seed in ((0, 0), (1, 0), (0, 1)):
        torch.manual_seed(len(made))
        before = torch.get_rng_state()
        made.append(q_learning(gridworld(4, 4, seed=reward_seed), 5, num_agents=3, steps=300, generator=seeded(seed)))
        assert torch.equal(before, torch.get_rng_state())
    first, again, other = made
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first[1], first[2])


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


def test_progress_is_reported():
    observed = []
    q_learning(gridworld(3, 3), 4, steps=7, progress=lambda done, steps: observed.append((done, steps)))
    assert observed == [(n, 7) for n in range(1, 8)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"goal": 9}, "`goal` must be a cell from 0 to 8, got 9"),
        ({"goal": -1}, "`goal` must be a cell"),
        ({"goal": 1.5}, "`goal` must be a cell from 0 to 8, got 1.5"),
        ({"num_agents": 0}, "`num_agents` must be an integer of at least 1, got 0"),
        ({"steps": -1}, "`steps` must be"),
        ({"step_size": 0}, "`step_size` must be"),
        ({"step_size": 1.5}, "`step_size` must be a number above 0 and at most 1, got 1.5"),
        ({"discount": 0}, "`discount` must be"),
        ({"discount": 1}, "`discount` must be a number above 0 and below 1, got 1"),
        ({"initial_scale": -0.1}, "`initial_scale` must be"),
        ({"initial_scale": float("nan")}, "`initial_scale` must be"),
        ({"epsilon": 1.1}, "`epsilon` must be a share between 0 and 1, got 1.1"),
    ],
)
def test_bad_learning_is_refused(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        q_learning(GRID, **{"goal": 4, **arguments})


def test_a_goal_alone_is_refused():
    with pytest.raises(ValueError, match=r"^`world` must be a cell that is not the goal"):
        q_learning(TabularWorld(torch.tensor([[0, 0]]), torch.zeros(1)), 0)
