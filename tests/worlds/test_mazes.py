"""Grids with walls: the mazes' shape, moves and views against plain loops, rewards, and what is refused."""

import pytest
import torch

from neuroprior import gridworld
from neuroprior.worlds import GridWorld, egocentric, four_rooms, goal_direction, local_view, maze
from tests.support.sources import FALSE_ALARM, p_value, refuses, seeded

OFFSETS = ((-1, 0), (0, 1), (1, 0), (0, -1))  # up, right, down, left
WALLS = torch.rand(3, 4, 5, generator=seeded(1)) < 0.4


def squares(walls):
    """The free squares of one layout, as a set of rows and columns."""
    return {tuple(square) for square in (~walls).nonzero().tolist()}


def reached(free):
    """The squares that can be reached from some square of `free`."""
    found, edge = set(), [min(free)]
    while edge:
        row, column = edge.pop()
        if (row, column) in free and (row, column) not in found:
            found.add((row, column))
            edge += [(row + r, column + c) for r, c in OFFSETS]
    return found


def num_edges(free):
    return sum((row + 1, column) in free for row, column in free) + sum((r, c + 1) in free for r, c in free)


@pytest.mark.parametrize(("height", "width"), [(3, 3), (3, 9), (9, 3), (15, 15), (7, 21)])
@pytest.mark.parametrize("loops", [0.0, 0.3, 1.0])
def test_mazes_are_trees_and_loops(height, width, loops):
    world = maze(height, width, loops=loops, num_layouts=20)
    rows, columns = height // 2, width // 2
    left_over = rows * (columns - 1) + (rows - 1) * columns - (rows * columns - 1)
    for walls in world.walls:
        free = squares(walls)
        assert reached(free) == free
        assert num_edges(free) - len(free) + 1 == round(loops * left_over)
        assert walls[::2, ::2].all()
        assert not walls[1::2, 1::2].any()
        assert walls[[0, -1]].all()
        assert walls[:, [0, -1]].all()


def test_mazes_are_random_and_made_again_from_their_seed():
    first, again, other = (maze(num_layouts=40, num_worlds=2, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(first.walls, again.walls)
    assert torch.equal(first.reward, again.reward)
    assert not torch.equal(first.walls, other.walls)
    assert len(first.walls.unique(dim=0)) == 40
    # Of 2 x 2 rooms there are four trees, each of which lacks one of the four passages, all equally likely.
    small = maze(5, 5, loops=0, num_layouts=4000)
    missing = torch.stack([small.walls[:, r, c] for r, c in ((1, 2), (2, 1), (2, 3), (3, 2))], 1)
    assert (missing.sum(1) == 1).all()
    assert p_value(missing.long().argmax(1), torch.ones(4)) > FALSE_ALARM
    opened = maze(5, 7, loops=0.5, num_layouts=2000)  # of 2 walls that are left between 6 rooms one is opened
    assert {int(walls.sum()) for walls in opened.walls} == {35 - 6 - 6}


def test_four_rooms():
    world = four_rooms(num_layouts=3000)
    assert (~world.walls).flatten(1).sum(1).tolist() == [104] * 3000
    for walls in world.walls[:20]:
        assert reached(squares(walls)) == squares(walls)
    for arm in (world.walls[:, 1:6, 6], world.walls[:, 7:12, 6], world.walls[:, 6, 1:6], world.walls[:, 6, 7:12]):
        assert ((~arm).sum(1) == 1).all()
        assert p_value((~arm).long().argmax(1), torch.ones(5)) > FALSE_ALARM
    assert world.walls[:, 6, 6].all()
    odd = four_rooms(5, 8, num_layouts=50)
    assert ((~odd.walls).flatten(1).sum(1) == 2 * (2 + 3) + 4).all()
    arms = odd.walls[:, 1:2, 4], odd.walls[:, 3:4, 4], odd.walls[:, 2, 1:4], odd.walls[:, 2, 5:7]
    assert all(((~arm).sum(1) == 1).all() for arm in arms)
    for walls in odd.walls:
        assert reached(squares(walls)) == squares(walls)


def walk(walls, edges, row, column, direction):
    """One move, by hand."""
    height, width = walls.shape
    to = [row + OFFSETS[direction][0], column + OFFSETS[direction][1]]
    if edges == "torus":
        to = [to[0] % height, to[1] % width]
    inside = 0 <= to[0] < height and 0 <= to[1] < width
    return [row, column] if walls[row, column] or not inside or walls[tuple(to)] else to


@pytest.mark.parametrize("edges", ["wall", "torus"])
def test_moves_in_layouts_with_walls(edges):
    reward = torch.rand(2, 60, generator=seeded(0))
    world = GridWorld(4, 5, edges, reward, walls=WALLS)
    turning = egocentric(world)
    assert (world.num_states, turning.num_states, world.num_layouts) == (60, 240, 3)
    assert turning.action_names == ("left", "right", "forward")
    for number, layout, row, column, direction in torch.cartesian_prod(
        torch.arange(2), torch.arange(3), torch.arange(4), torch.arange(5), torch.arange(4)
    ).tolist():
        square = layout * 20 + row * 5 + column
        to = walk(WALLS[layout], edges, row, column, direction)
        arrives = float(reward[number, layout * 20 + to[0] * 5 + to[1]])
        state, got = world.step(world.state(torch.tensor([square]), number), torch.tensor([direction]))
        assert world.coordinates(state).tolist() == [to]
        assert (int(world.layout(state)), int(world.reward_map(state)), float(got)) == (layout, number, arrives)
        start = turning.state(torch.tensor([square * 4 + direction] * 3), number)
        assert turning.coordinates(start).tolist() == [[row, column]] * 3
        state, got = turning.step(start, torch.arange(3))
        assert turning.coordinates(state).tolist() == [[row, column], [row, column], to]
        assert turning.heading(state).tolist() == [(direction - 1) % 4, (direction + 1) % 4, direction]
        assert turning.layout(state).tolist() == [layout] * 3
        assert turning.reward_map(state).tolist() == [number] * 3
        stays = float(reward[number, square])
        assert got.tolist() == [stays, stays, arrives]


@pytest.mark.parametrize("edges", ["wall", "torus"])
@pytest.mark.parametrize("radius", [1, 3])
def test_views_square_by_square(edges, radius):
    plain = GridWorld(4, 5, edges, torch.zeros(2, 60), walls=WALLS, view=radius)
    for world in (plain, egocentric(plain)):
        state = torch.arange(2 * world.num_states)
        observed = world.observe(state)
        assert observed.dtype == torch.float32
        assert torch.equal(observed, local_view(world, radius)(state))
        for s in range(0, len(state), 7):
            (row, column), layout = world.coordinates(state[s]).tolist(), int(world.layout(state[s]))
            heading = int(world.heading(state[s])) if world.egocentric else 0
            forward, right = OFFSETS[heading], OFFSETS[(heading + 1) % 4]
            want = []
            for ahead in range(radius, -radius - 1, -1):
                for aside in range(-radius, radius + 1):
                    if ahead == aside == 0:
                        continue
                    there = [(row, column)[i] + ahead * forward[i] + aside * right[i] for i in range(2)]
                    if edges == "torus":
                        there = [there[0] % 4, there[1] % 5]
                    inside = 0 <= there[0] < 4 and 0 <= there[1] < 5
                    want.append(float(inside and not WALLS[layout, there[0], there[1]]))
            assert observed[s].tolist() == want


@pytest.mark.parametrize("egocentric", [False, True])
def test_who_follows_the_direction_is_at_the_goal(egocentric):
    world = maze(9, 7, reward="goal", num_layouts=4, num_worlds=3, egocentric=egocentric, seed=2)
    state = world.reset(300, seeded(0))
    away = goal_direction(world)(state)
    assert away.dtype == torch.float32
    offsets = torch.tensor(OFFSETS)
    heading = world.heading(state) if egocentric else torch.zeros_like(state)
    way = away[:, :1] * offsets[heading] + away[:, 1:] * offsets[(heading + 1) % 4]
    row, column = (world.coordinates(state) + way).long().unbind(-1)
    square = (world.layout(state) * 9 + row) * 7 + column
    reward = world.reward[world.reward_map(state), square * (4 if egocentric else 1)]
    assert reward.tolist() == [1.0] * 300
    with refuses("got a torus"):
        goal_direction(gridworld(4, 4, edges="torus"))


@pytest.mark.parametrize("turns", [False, True])
def test_reset_is_uniform_over_the_squares_that_are_free(turns):
    world = GridWorld(4, 5, "wall", torch.zeros(2, 60), walls=WALLS, egocentric=turns)
    state = world.reset(30_000, seeded(0))
    assert torch.equal(state, world.reset(30_000, seeded(0)))
    weight = (~WALLS).flatten().float().repeat_interleave(4 if turns else 1).repeat(2)
    assert p_value(state, weight) > FALSE_ALARM


@pytest.mark.parametrize("build", [four_rooms, maze])
@pytest.mark.parametrize("turns", [False, True])
def test_rewards(build, turns):
    world = build(num_layouts=50, num_worlds=30, egocentric=turns, seed=4)
    every = world.state(torch.arange(world.num_states).repeat(30), torch.arange(30).repeat_interleave(world.num_states))
    free = ~world.walls.flatten()[world.square(every)]
    reward = world.reward.flatten()
    assert not reward[~free].any()
    each = reward[free & (world.heading(every) == 0)] if turns else reward[free]
    assert p_value((each * 50).long(), torch.ones(50)) > FALSE_ALARM
    powered = build(num_layouts=50, num_worlds=30, egocentric=turns, seed=4, reward_power=5)
    torch.testing.assert_close(powered.reward, world.reward**5)
    goals = build(num_layouts=3, num_worlds=2000, reward="goal", egocentric=turns)
    found = goals.reward.view(2000, 3, -1)
    assert ((found == 0) | (found == 1)).all()
    assert (found.sum(-1) == (4 if turns else 1)).all()
    for layout in range(3):
        goal = found[:, layout].argmax(-1)
        square = goal.div(4, rounding_mode="floor") if turns else goal
        assert p_value(square, (~goals.walls[layout]).flatten().float()) > FALSE_ALARM


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: four_rooms(4, 13), ["height, width", "at least 5", "4 x 13"]),
        (lambda: maze(14, 15), ["height, width", "odd", "14 x 15"]),
        (lambda: maze(15, 1), ["height, width", "15 x 1"]),
        (lambda: maze(num_layouts=0), ["num_layouts", "0"]),
        (lambda: four_rooms(num_worlds=0), ["num_worlds", "0"]),
        (lambda: four_rooms(reward="gaol"), ["reward", "gaol"]),
        (lambda: maze(reward="goal", reward_power=2), ["reward_power", "goal"]),
        (lambda: maze(view=0), ["view", "0"]),
        (lambda: maze(view=True), ["view", "True"]),
        (lambda: local_view(maze(), 0), ["view", "0"]),
        (lambda: egocentric(maze(egocentric=True)), ["world", "agents have headings"]),
        (lambda: maze().heading(torch.tensor([0])), ["heading", "egocentric"]),
        (lambda: GridWorld(4, 5, "wall", torch.zeros(1, 20), walls=WALLS), ["reward", "[1, 20]"]),
        (lambda: GridWorld(4, 4, "wall", torch.zeros(1, 48), walls=WALLS), ["walls", "[M, 4, 4]", "[3, 4, 5]"]),
        (lambda: GridWorld(4, 5, "wall", torch.zeros(1, 60), walls=WALLS.float()), ["walls", "float32"]),
        (lambda: GridWorld(4, 5, "wall", torch.zeros(1, 20), walls=WALLS[:1] | True), ["walls[0]", "free"]),
    ],
)
def test_refuses(call, words):
    with refuses(*words):
        call()
