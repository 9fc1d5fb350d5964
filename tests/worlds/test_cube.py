"""The 2 x 2 x 2 cube against a cube of stickers and the known numbers of states at each distance."""

import itertools

import pytest
import torch

from neuroprior.testing import check_world
from neuroprior.worlds import cube
from tests.support.sources import FALSE_ALARM, p_value, refuses, seeded

HALF_TURNS = [1, 9, 54, 321, 1847, 9992, 50136, 227536, 870072, 1887748, 623800, 2644]
QUARTER_TURNS = [1, 6, 27, 120, 534, 2256, 8969, 33058, 114149, 360508, 930588, 1350852, 782536, 90280, 276]
NUM_STATES = 3_674_160

# The independent model: 24 stickers, each at a corner (x, y, z) and facing one way. A turn carries those of its face
# round: u (+z) clockwise looked at from above, r (+x) from the right, f (-y) from the front.
STICKERS = [
    (corner, way)
    for corner in itertools.product((-1, 1), repeat=3)
    for way in [tuple(corner[i] * (i == axis) for i in range(3)) for axis in range(3)]
]
TURNS = {
    "U": (lambda p: p[2] == 1, lambda p: (p[1], -p[0], p[2])),
    "R": (lambda p: p[0] == 1, lambda p: (p[0], p[2], -p[1])),
    "F": (lambda p: p[1] == -1, lambda p: (p[2], p[1], -p[0])),
}


def sticker_turn(face):
    """For each place of a sticker, the place to which the turn carries it."""
    chosen, turn = TURNS[face]
    return torch.tensor(
        [STICKERS.index((turn(c), turn(w))) if chosen(c) else i for i, (c, w) in enumerate(STICKERS)], dtype=torch.long
    )


def sticker_moves(names):
    turns = {}
    for face in TURNS:
        once = sticker_turn(face)
        turns |= {face: once, face + "2": once[once], face + "'": once[once[once]]}
    return torch.stack([turns[name] for name in names])


@pytest.mark.parametrize("turns", ["half", "quarter"])
def test_states_are_those_of_a_cube_of_stickers(turns):
    """After random moves, two cubes are equal as states if and only if their stickers are."""
    world, num, length = cube(turns), 4000, 6
    moves = torch.randint(world.num_actions, (num, length), generator=seeded(0))
    states = world.rollout(torch.zeros(1, dtype=torch.long), moves[None]).final_state[0]
    where = torch.arange(24).repeat(num, 1)
    for t in range(length):
        where = sticker_moves(world.action_names)[moves[:, t, None], where]
    _, by_state = states.unique(return_inverse=True)
    _, by_stickers = where.unique(dim=0, return_inverse=True)
    pairs = torch.stack([by_state, by_stickers]).unique(dim=1).shape[1]
    assert pairs == len(by_state.unique()) == len(by_stickers.unique())
    assert 500 < pairs < num


def test_every_move_is_a_permutation_of_the_states():
    world, states = cube("quarter"), torch.arange(NUM_STATES)
    for move in range(0, 6, 2):
        there, _ = world.step(states, torch.full_like(states, move))
        back, _ = world.step(there, torch.full_like(states, move + 1))
        assert back.equal(states)


@pytest.mark.parametrize(("turns", "known"), [("half", HALF_TURNS), ("quarter", QUARTER_TURNS)])
def test_distances(turns, known):
    world = cube(turns, reward="distance")
    distance = world.distance(torch.arange(NUM_STATES))
    assert distance.bincount().tolist() == known
    state = world.reset(2000, seeded(1))
    every = torch.arange(world.num_actions).repeat(len(state))
    there, reward = world.step(state.repeat_interleave(world.num_actions), every)
    assert reward.equal(-world.distance(there).float())
    left = world.distance(there).view(len(state), -1)
    here = world.distance(state)
    assert left.amin(1)[here > 0].equal(here[here > 0] - 1)  # some move comes nearer by one
    assert ((left - here[:, None]).abs() <= 1).all()
    assert world.distance(state.view(2, -1)).shape == (2, 1000)
    absorbing = cube(turns, reward="distance", absorbing=True)
    after, lost = absorbing.step(torch.cat([state[:5], torch.tensor([0])]), torch.arange(6))
    assert after[-1] == 0
    assert lost.tolist() == [*(-world.distance(after[:5])).tolist(), 0]


def test_the_solved_cube_may_be_the_end():
    world, free = cube(absorbing=True), cube()
    state = torch.arange(2000).repeat_interleave(9)
    action = torch.arange(9).repeat(2000)
    after, reward = world.step(state, action)
    want, gained = free.step(state, action)
    assert torch.equal(world.terminated(state), state == 0)
    assert not free.terminated(state).any()
    assert torch.equal(after, torch.where(state == 0, 0, want))
    assert torch.equal(reward, torch.where(state == 0, 0.0, gained))
    check_world(world)


def test_the_cube_is_solved_in_one_state():
    world = cube()
    assert world.has_goal
    assert world.solved(torch.arange(5)).tolist() == [True, False, False, False, False]


def test_reset():
    assert cube(scramble=0).reset(5).tolist() == [0] * 5
    one = cube("quarter", scramble=1).reset(6000, seeded(2))
    first, _ = cube("quarter").step(torch.zeros(6, dtype=torch.long), torch.arange(6))
    number = (one[:, None] == first).long().argmax(1)
    assert (first[number] == one).all()
    assert p_value(number, torch.ones(6)) > FALSE_ALARM
    assert (cube(scramble=3).reset(100, seeded(3)) == cube(scramble=3).reset(100, seeded(3))).all()


def test_observations():
    world = cube()
    assert world.observe(torch.tensor([0]))[0].view(10, 7)[:7].equal(torch.eye(7))
    state = world.reset(3000, seeded(4)).unique()
    observed = world.observe(state)
    assert observed.shape == (len(state), 70)
    assert observed.dtype == torch.float32
    assert (observed.sum(1) == 14).all()
    assert len(observed.unique(dim=0)) == len(state)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: cube("whole"), '`turns` must be "half" or "quarter", got \'whole\''),
        (lambda: cube(reward="time"), '`reward` must be "solved" or "distance"'),
        (lambda: cube(scramble=-1), "`scramble` must be an integer of at least 0, got -1"),
        (lambda: cube().distance(torch.tensor([NUM_STATES])), "state[0]: 3674160 is out of range"),
        (lambda: cube().check_state(torch.zeros(3)), "`state` must be int64 of shape [B]"),
        (lambda: cube().rollout(torch.tensor([-1]), torch.zeros(1, 1, 1, dtype=torch.long)), "-1 is out of range"),
    ],
)
def test_refusals(call, message):
    with refuses(message):
        call()
