"""Grids with walls: four rooms and mazes, many random layouts in one world."""

from typing import Literal

import torch
from torch import Tensor

from neuroprior._checks import check_seed, check_share, check_sizes, is_number
from neuroprior.worlds.grid import GridWorld


def four_rooms(
    height: int = 13,
    width: int = 13,
    *,
    num_layouts: int = 1,
    num_worlds: int = 1,
    reward: Literal["random", "goal"] = "random",
    reward_power: float = 1.0,
    seed: int = 0,
    egocentric: bool = False,
    view: int | None = None,
) -> GridWorld:
    """Four rooms connected by four doors.

    After Sutton, Precup and Singh, "Between MDPs and semi-MDPs" (Artificial Intelligence 112, 181-211, 1999), except
    that the inner walls cross in the middle, and the door in each of their four arms is at a random place.

    Args:
        height, width: size in squares, the outer walls among them; at least 5.
        num_layouts: number of layouts, M, which differ in their doors; see `GridWorld`.
        num_worlds: number of reward maps over them, W.
        reward: "random": of arriving in each free square, as in `gridworld`. "goal": 1 for arriving in one free square
            of each layout, drawn for each reward map, and 0 elsewhere; being in the goal and staying there arrives.
        reward_power: see `gridworld`; only for random rewards.
        seed: gives the same layouts and rewards again.
        egocentric, view: see `GridWorld`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = four_rooms(7, 7, seed=0)
        >>> world.num_actions, len(world.next_state)
        (4, 49)
    """
    check_sizes(height=height, width=width)
    if height < 5 or width < 5:
        raise ValueError(f"`height, width` must be at least 5 squares, got {height} x {width}")
    _check(num_layouts, num_worlds, reward, reward_power)
    check_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    walls = torch.zeros(num_layouts, height, width, dtype=torch.bool)
    row, column = height // 2, width // 2
    walls[:, [0, row, height - 1]] = True
    walls[:, :, [0, column, width - 1]] = True
    layout = torch.arange(num_layouts)
    for first, stop in ((1, row), (row + 1, height - 1)):
        walls[layout, torch.randint(first, stop, (num_layouts,), generator=generator), column] = False
    for first, stop in ((1, column), (column + 1, width - 1)):
        walls[layout, row, torch.randint(first, stop, (num_layouts,), generator=generator)] = False
    rewards = _rewards(walls, num_worlds, reward, reward_power, generator)
    return GridWorld(height, width, "wall", rewards, walls=walls, egocentric=egocentric, view=view)


def maze(
    height: int = 15,
    width: int = 15,
    *,
    loops: float = 0.1,
    num_layouts: int = 1,
    num_worlds: int = 1,
    reward: Literal["random", "goal"] = "random",
    reward_power: float = 1.0,
    seed: int = 0,
    egocentric: bool = False,
    view: int | None = None,
) -> GridWorld:
    """Random mazes with corridors one square wide.

    A depth-first walk through the squares of odd row and column carves each maze: on to a random unvisited neighbour,
    and back where there is none, so that exactly one path connects any two squares. Then some of the remaining walls
    between neighbours are opened.

    Args:
        height, width: size in squares, the outer walls among them; odd, at least 3.
        loops: the share of the remaining inner walls that is opened, from 0 (a single path) to 1 (no wall is left).
        num_layouts, num_worlds, reward, reward_power, seed: see `four_rooms`.
        egocentric, view: see `GridWorld`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = maze(9, 9, num_layouts=2, reward="goal", seed=0)
        >>> world.num_layouts
        2
    """
    check_sizes(height=height, width=width)
    if min(height, width) < 3 or height % 2 == 0 or width % 2 == 0:
        raise ValueError(f"`height, width` must be odd numbers of at least 3, got {height} x {width}")
    check_share("loops", loops)
    _check(num_layouts, num_worlds, reward, reward_power)
    check_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    walls = _dig(height, width, num_layouts, generator)
    _open_some(walls, loops, generator)
    rewards = _rewards(walls, num_worlds, reward, reward_power, generator)
    return GridWorld(height, width, "wall", rewards, walls=walls, egocentric=egocentric, view=view)


def _dig(height: int, width: int, num_layouts: int, generator: torch.Generator) -> Tensor:
    """Walls `[M, H, W]` of mazes without loops: a depth-first walk in all of them at once."""
    walls = torch.ones(num_layouts, height * width, dtype=torch.bool)
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    # Up, right, down, left: where a neighbour is two squares away, and the step that leads half the way.
    inside = torch.stack([row > 1, column < width - 2, row < height - 2, column > 1], -1).view(-1, 4)
    step = torch.tensor([-width, 1, width, -1])
    num_rooms = (height // 2) * (width // 2)
    layout = torch.arange(num_layouts)
    path = torch.empty(num_layouts, num_rooms, dtype=torch.long)
    depth = torch.zeros(num_layouts, dtype=torch.long)
    start = torch.randint(num_rooms, (num_layouts,), generator=generator)
    path[:, 0] = (2 * start.div(width // 2, rounding_mode="floor") + 1) * width + 2 * (start % (width // 2)) + 1
    walls[layout, path[:, 0]] = False
    # Each square is entered once, and left backwards at most once.
    for _ in range(2 * (num_rooms - 1)):
        square = path[layout, depth]
        new = inside[square]
        new &= walls.gather(1, torch.where(new, square[:, None] + 2 * step, 0))
        way = torch.where(new, torch.rand(new.shape, generator=generator), -1.0).argmax(1)
        on = new.any(1)
        # A walk that cannot go on carves its own square again.
        by = torch.where(on, step[way], 0)
        walls[layout, square + by] = False
        walls[layout, square + 2 * by] = False
        depth = torch.where(on, depth + 1, (depth - 1).clamp(min=0))
        path[layout[on], depth[on]] = (square + 2 * by)[on]
    return walls.view(num_layouts, height, width)


def _open_some(walls: Tensor, loops: float, generator: torch.Generator) -> None:
    """Open a share `loops` of the walls between two neighbours in each of `walls [M, H, W]`, in place."""
    between = torch.zeros_like(walls[0])
    between[1:-1:2, 2:-1:2] = between[2:-1:2, 1:-1:2] = True
    closed = (walls & between).flatten(1)
    number = round(loops * int(closed[0].sum()))  # the same number in every maze without loops
    draws = torch.where(closed, torch.rand(closed.shape, generator=generator), -1.0)
    walls.view(len(walls), -1).scatter_(1, draws.topk(number, 1).indices, False)


def _rewards(walls: Tensor, num_worlds: int, kind: str, power: float, generator: torch.Generator) -> Tensor:
    """Rewards `[W, M * H * W]` of arriving in each square; 0 for walls."""
    free = ~walls.flatten(1)
    uniform = torch.rand(num_worlds, *free.shape, generator=generator).where(free, 0.0)
    if kind == "random":
        return uniform.pow(power).flatten(1)
    # The largest of independent draws is uniform over the free squares; where all draws are 0 it must be no wall.
    goal = torch.where(free, uniform, -1.0).argmax(-1, keepdim=True)
    return torch.zeros_like(uniform).scatter_(-1, goal, 1.0).flatten(1)


def _check(num_layouts: int, num_worlds: int, reward: str, reward_power: float) -> None:
    check_sizes(num_layouts=num_layouts, num_worlds=num_worlds)
    if reward not in ("random", "goal"):
        raise ValueError(f'`reward` must be "random" or "goal", got {reward!r}')
    if not is_number(reward_power) or not 0 < reward_power < float("inf"):
        raise ValueError(f"`reward_power` must be a positive finite number, got {reward_power!r}")
    if reward == "goal" and reward_power != 1:
        raise ValueError('reward_power: it has no effect with reward="goal"; use reward="random"')
