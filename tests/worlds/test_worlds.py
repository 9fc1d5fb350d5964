"""Worlds: transitions by hand, fast rollouts against stepping, reward maps, legal actions, and what is refused."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import TabularWorld, World, gridworld
from neuroprior.control import ContinuousWorld
from neuroprior.worlds import Rollout
from tests.support.sources import FALSE_ALARM, p_value, random_world, refuses, seeded

KINDS = ("S", "SA", "WS", "WSA")


class Ring(World):
    """A user's world: two actions, left (0) and right (1), on a ring; computes with its actions as numbers."""

    num_actions = 2

    def reset(self, batch_size, generator=None):
        return torch.zeros(batch_size, dtype=torch.long)

    def step(self, state, action, generator=None):
        move = 2 * action - 1
        after = (state + move) % 10
        return after, after.float()


def test_grid_rewards_are_uniform_independent_of_edges_and_raised_to_the_power():
    worlds = [gridworld(30, 40, edges=edges, num_worlds=20, seed=3) for edges in ("wall", "torus")]
    assert torch.equal(worlds[0].reward, worlds[1].reward)
    assert p_value((worlds[0].reward.flatten() * 50).long(), torch.ones(50)) > FALSE_ALARM
    powered = gridworld(30, 40, num_worlds=20, seed=3, reward_power=7)
    torch.testing.assert_close(powered.reward, worlds[0].reward ** 7)
    assert not torch.equal(gridworld(30, 40, num_worlds=20, seed=4).reward, worlds[0].reward)


@pytest.mark.parametrize("num_worlds", [1, 3, 4, 5])
def test_four_cells_four_moves(num_worlds):
    """Where S = A = 4 shapes could be mistaken; an arrival's reward still belongs to the cell and the map."""
    world = gridworld(2, 2, "torus", num_worlds=num_worlds, seed=1)
    for number in range(num_worlds):
        arrivals = {}
        for cell in range(4):
            start = world.state(torch.tensor([cell] * 4), number)
            after, reward = world.step(start, torch.arange(4))
            assert world.reward_map(after).tolist() == [number] * 4
            for to, value in zip(world.cell(after).tolist(), reward.tolist(), strict=True):
                assert arrivals.setdefault(to, value) == value
        assert len(set(arrivals.values())) == 4


@pytest.mark.parametrize("kind", KINDS)
def test_step_by_hand(kind):
    world = random_world(5, kind)
    table, maps = world.next_state.tolist(), 2 if kind[0] == "W" else 1
    assert world.num_maps == maps
    given_reward = torch.rand([{"W": 2, "S": 6, "A": 3}[k] for k in kind], generator=seeded(5))
    for number in range(maps):
        reward = given_reward[number] if kind[0] == "W" else given_reward
        for cell in range(6):
            for action in range(3):
                state, got = world.step(world.state(torch.tensor([cell]), number), torch.tensor([action]))
                after = table[cell][action]
                assert state.tolist() == [number * 6 + after]
                assert float(got) == float(reward[cell, action] if kind[-1] == "A" else reward[after])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("layout", ["uint8", "int32", "int64", "strided", "permuted", "broadcast"])
@pytest.mark.parametrize("size", [(4, 5, 6), (1, 1, 1), (4, 5, 0), (4, 0, 3), (0, 3, 2)])
@pytest.mark.parametrize("by", ["tensors", "loop"])
def test_rollout_is_stepping(kind, layout, size, by):
    world = random_world(1, kind)
    world.compile_from = 0 if by == "loop" else 2**60
    batch, num_plans, length = size
    state = world.reset(batch, seeded(0))
    plans = torch.randint(3, size, generator=seeded(1))
    if layout == "strided":
        plans = torch.randint(3, (batch, num_plans, 2 * length), generator=seeded(1))[:, :, ::2]
    elif layout == "permuted":
        plans = plans.permute(2, 1, 0).contiguous().permute(2, 1, 0)
    elif layout == "broadcast":
        plans = plans[:, :, :1].expand(size) if length else plans
    else:
        plans = plans.to(getattr(torch, layout))
    for keep_states in (False, True):
        want = World.rollout(world, state, plans.long(), keep_states=keep_states)
        got = world.rollout(state, plans, keep_states=keep_states)
        assert isinstance(got, Rollout)
        assert got.rewards.shape == size
        for one, other in zip(got, want, strict=True):
            assert (one is None) == (other is None)
            if one is not None:
                assert one.dtype == other.dtype
                assert torch.equal(one, other)


@pytest.mark.parametrize("threads", [1, 2, 3, 7])  # seven share the seven plans of each start
def test_each_thread_follows_plans_of_its_own(monkeypatch, threads):
    world = random_world(1, "WS")
    state, plans = world.reset(3, seeded(0)), torch.randint(3, (3, 7, 4), generator=seeded(1))
    want = world.rollout(state, plans)
    world.compile_from = 0
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    got = world.rollout(state, plans)
    assert torch.equal(got.final_state, want.final_state)
    assert torch.equal(got.rewards, want.rewards)


def test_the_loop_is_for_what_it_can_do(monkeypatch):
    from neuroprior.worlds import compiled

    compiled_sizes, rollout = [], compiled.rollout
    monkeypatch.setattr(compiled, "rollout", lambda *given: compiled_sizes.append(given[4].numel()) or rollout(*given))
    table, state = torch.zeros(1, 1, dtype=torch.long), torch.zeros(1, dtype=torch.long)
    few = torch.zeros(1, 1, 1, dtype=torch.uint8)
    world = TabularWorld(table, torch.zeros(1))
    world.rollout(state, few)
    assert compiled_sizes == []
    world.rollout(state, few.expand(1, world.compile_from, 1))
    assert compiled_sizes == [world.compile_from]
    for reward, times in ((torch.ones(1).double(), 2), (torch.ones(1).half(), 2)):
        world = TabularWorld(table, reward)
        world.compile_from = 0
        assert world.rollout(state, few).rewards.dtype == reward.dtype
        assert len(compiled_sizes) == times


def test_rollout_takes_stored_actions():
    """`Plans` and samplers store uint8; a world that computes with its actions must not overflow on them."""
    state, plans = torch.tensor([5]), torch.tensor([[[0, 0, 1], [0, 0, 0]]])
    want = Rollout(torch.tensor([[4, 2]]), torch.tensor([[[4.0, 3, 4], [4, 3, 2]]]))
    for dtype in (torch.int64, torch.uint8):
        got = Ring().rollout(state, plans.to(dtype))
        assert torch.equal(got.final_state, want.final_state)
        assert torch.equal(got.rewards, want.rewards)


def test_state_and_its_parts():
    world = random_world(0, maps=3)
    cell, number = torch.tensor([0, 5, 2]), torch.tensor([2, 0, 1])
    state = world.state(cell, number)
    assert state.tolist() == [12, 5, 8]
    assert torch.equal(world.cell(state), cell)
    assert torch.equal(world.reward_map(state), number)
    assert torch.equal(world.observe(state), cell)


def test_reset_is_uniform_and_reproducible():
    world = random_world(0, maps=3)
    state = world.reset(20_000, seeded(1))
    assert torch.equal(state, world.reset(20_000, seeded(1)))
    assert p_value(state, torch.ones(18)) > FALSE_ALARM


def test_legal():
    legal = torch.tensor([[True, False], [False, True], [True, True]])
    world = TabularWorld(torch.zeros(3, 2, dtype=torch.long), torch.zeros(2, 3), legal)
    assert not world.all_legal
    state = torch.tensor([4, 0, 5, 3])  # cells 1, 0, 2, 0 of two maps
    assert torch.equal(world.legal_actions(state), legal[[1, 0, 2, 0]])
    assert random_world(0).all_legal
    assert random_world(0).legal_actions(torch.tensor([1, 2])).tolist() == [[True] * 3] * 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"num_worlds": 0}, ["num_worlds"]),
        ({"height": 0}, ["height", "0"]),
        ({"width": -1}, ["width", "-1"]),
        ({"edges": "klein"}, ["edges", "klein"]),
    ],
)
def test_gridworld_refuses(arguments, words):
    with refuses(*words):
        gridworld(**arguments)


TABLE = torch.tensor([[0, 1, 2], [2, 1, 0], [1, 1, 1], [3, 0, 0]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"next_state": TABLE[0]}, ["next_state", "[3]"]),
        ({"next_state": TABLE.float()}, ["next_state", "float32"]),
        ({"next_state": TABLE + 1}, ["next_state", "4"]),
        ({"next_state": TABLE - 1}, ["next_state", "-1"]),
        ({"next_state": TABLE[:0]}, ["next_state"]),
        ({"reward": torch.rand(5)}, ["reward", "[5]"]),
        ({"reward": torch.rand(3, 4, 2)}, ["reward", "[3, 4, 2]"]),
        ({"reward": torch.rand(0, 4)}, ["reward", "[0, 4]"]),
        ({"reward": torch.tensor(1.0)}, ["reward"]),
        ({"reward": torch.tensor([0, 1, float("nan"), 0])}, ["reward", "2", "NaN"]),
        ({"reward": torch.ones(4, dtype=torch.complex64)}, ["reward", "complex64"]),
        ({"legal_actions": torch.ones(4, 2, dtype=torch.bool)}, ["legal", "[4, 2]"]),
        ({"legal_actions": torch.ones(4, 3)}, ["legal", "float32"]),
        ({"legal_actions": torch.arange(4)[:, None] != torch.tensor([2, 2, 2])}, ["legal", "2"]),
        ({"action_names": ["a", "b"]}, ["action_names", "3", "2"]),
    ],
)
def test_table_refuses(change, words):
    with refuses(*words):
        TabularWorld(**({"next_state": TABLE, "reward": torch.rand(4)} | change))


def test_a_square_reward_is_ambiguous():
    square = TABLE[:3]
    with refuses("reward", "[3, 3]", "[1, S, A]"):
        TabularWorld(square, torch.rand(3, 3))
    reward = torch.rand(3, 3)
    world = TabularWorld(square, reward[None])
    assert float(world.step(torch.tensor([1]), torch.tensor([0]))[1]) == float(reward[1, 0])


@settings(max_examples=60, deadline=None)
@given(
    where=st.tuples(st.integers(0, 2), st.integers(0, 3), st.integers(0, 4)),
    action=st.one_of(st.integers(-(2**40), -1), st.integers(3, 2**40)),
    default=st.booleans(),
)
def test_rollout_names_the_action_that_is_out_of_range(where, action, default):
    world = random_world(0)
    plans = torch.zeros(3, 4, 5, dtype=torch.long)
    plans[where] = action
    rollout = World.rollout if default else TabularWorld.rollout
    with refuses("plans", str(list(where)), str(action)):
        rollout(world, torch.tensor([0, 1, 2]), plans)


@settings(max_examples=40, deadline=None)
@given(where=st.integers(0, 2), state=st.one_of(st.integers(-(2**40), -1), st.integers(12, 2**40)))
def test_rollout_names_the_state_that_is_out_of_range(where, state):
    states = torch.zeros(3, dtype=torch.long)
    states[where] = state
    with refuses("state", str(where), str(state)):
        random_world(0).rollout(states, torch.zeros(3, 1, 1, dtype=torch.long))


def test_states_of_another_shape_are_named():
    with refuses("state", "[3, 1]"):
        random_world(0).rollout(torch.zeros(3, 1).long(), torch.zeros(3, 1, 1).long())


@pytest.mark.parametrize(("cell", "number", "word"), [(6, 0, "cell"), (-1, 0, "cell"), (0, 2, "reward_map")])
def test_state_refuses(cell, number, word):
    with refuses(word):
        random_world(0).state(torch.tensor([cell]), number)


def test_all_tensors_of_a_world_are_moved():
    """Those of its class, too, for it alone."""

    class Mine(ContinuousWorld):
        action_low, action_high = -torch.ones(2), torch.ones(2)

        def __init__(self):
            self.weights, self.inner, self.name, self.device = torch.ones(3), gridworld(3, 3), "x", "mine"

        def reset(self, batch_size, generator=None):
            return torch.zeros(batch_size, 2)

        def step(self, state, action, generator=None):
            return state + action, state[:, 0]

    world = Mine()
    assert world.to("meta") is world
    moved = (world.action_low, world.action_high, world.weights, world.inner.next_state)
    assert [value.device.type for value in moved] == ["meta"] * 4
    assert Mine.action_low.device.type == Mine().action_high.device.type == "cpu"
    assert world.device == "mine"
