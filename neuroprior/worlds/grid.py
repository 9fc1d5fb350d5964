"""Grid worlds: squares in rectangles, with walls or without; four moves, or turning and going forward."""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from neuroprior._checks import check_count, check_memory, check_seed, check_sizes, is_number, is_whole
from neuroprior._random import generator_on
from neuroprior.worlds.observations import Features
from neuroprior.worlds.tabular import TabularWorld

MOVES = ("up", "right", "down", "left")
"""The four moves in the order of their numbers; the reversal of move a is (a + 2) % 4."""

TURNS = ("left", "right", "forward")
"""The three actions of an agent with a heading (0 up, 1 right, 2 down, 3 left), in the order of their numbers."""

_ROW_COLUMN = torch.tensor([[-1, 0], [0, 1], [1, 0], [0, -1]])


class GridWorld(TabularWorld):
    """A `TabularWorld` whose cells are the squares of M rectangles; see `gridworld`, `maze` and `four_rooms`.

    A cell is `layout * height * width + row * width + column`; where the agent has a heading (`egocentric`), it is four
    times that plus the heading. A move into a wall, or off a grid that is no torus, stays where it is; wall squares are
    cells that no move enters.

    Args:
        height, width, edges: see `gridworld`.
        reward: floating point `[W, M * H * W]`: the rewards of arriving in each square, for W reward maps. With a
            heading, a turn counts as arriving in the agent's square.
        walls: bool `[M, H, W]`: which squares are walls; None: one layout without any.
        egocentric: the actions are turning left, turning right and going forward, instead of the four moves.
        view: `observe` gives which squares up to so many rows and columns away are free, instead of the cell.

    Attributes:
        height, width: size of a layout in squares.
        edges: "wall" or "torus".
        walls: bool `[M, H, W]`.
        num_layouts: M.
        egocentric, view: as given.

    Raises:
        ValueError: a shape, dtype or value is wrong.

    Example:
        >>> world = GridWorld(2, 3, "torus", torch.tensor([[0.0, 0, 1, 0, 0, 0]]))
        >>> world.next_state[0].tolist()
        [3, 1, 3, 2]
    """

    def __init__(
        self,
        height: int,
        width: int,
        edges: Literal["wall", "torus"],
        reward: Tensor,
        *,
        walls: Tensor | None = None,
        egocentric: bool = False,
        view: int | None = None,
    ) -> None:
        _check_view(view)
        if walls is None:
            walls = torch.zeros(1, height, width, dtype=torch.bool, device=reward.device)
        _check_walls(walls, height, width)
        self.height, self.width, self.edges = height, width, edges
        self.walls, self.num_layouts, self.egocentric, self.view = walls, len(walls), egocentric, view
        table = _moves(walls, edges)
        if egocentric:
            table, reward = _turns_and_moves(table), reward.repeat_interleave(4, -1)
        # Only one map: several could be mistaken for rewards of actions (four maps of four cells).
        super().__init__(table, reward[:1], action_names=TURNS if egocentric else MOVES)
        self._set_maps(reward)
        self._views = None if view is None else _view_table(walls, edges, view, egocentric)
        if self._views is not None:
            self.observation = Features(self._views.shape[1])
        # The cells in which planning may start; None where that is all of them.
        self._free = (
            (~walls.view(-1)).repeat_interleave(4 if egocentric else 1).nonzero()[:, 0] if walls.any() else None
        )

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """States `[batch_size]`, uniform over the squares that are no walls, headings and reward maps."""
        if self._free is None:
            return super().reset(batch_size, generator)
        check_count("batch_size", batch_size)
        generator, free = generator_on(generator, self.device), len(self._free)
        draw = torch.randint(self.num_maps * free, (batch_size,), generator=generator, device=self.device)
        return self._free[draw % free] + draw.div(free, rounding_mode="floor") * self.num_states

    def observe(self, state: Tensor) -> Tensor:
        """The cell of each state; with a `view` the free squares around it, see `local_view`."""
        if self._views is None:
            return super().observe(state)
        return self._views.index_select(0, self.cell(state)).float()

    def square(self, state: Tensor) -> Tensor:
        """The square of each state among all layouts' squares, `layout * height * width + row * width + column`."""
        return self.cell(state).div(4, rounding_mode="floor") if self.egocentric else self.cell(state)

    def layout(self, state: Tensor) -> Tensor:
        """The layout of each state, between 0 and M - 1."""
        return self.square(state).div(self.height * self.width, rounding_mode="floor")

    def coordinates(self, state: Tensor) -> Tensor:
        """Row and column of each state in its layout: `[..., 2]`."""
        square = self.square(state) % (self.height * self.width)
        return torch.stack([square.div(self.width, rounding_mode="floor"), square % self.width], -1)

    def heading(self, state: Tensor) -> Tensor:
        """The heading of each state: 0 up, 1 right, 2 down, 3 left; ValueError where agents have none."""
        if not self.egocentric:
            raise ValueError("heading: agents have one only in an egocentric grid; see egocentric()")
        return self.cell(state) % 4


def gridworld(
    height: int = 20,
    width: int = 20,
    edges: Literal["wall", "torus"] = "wall",
    *,
    reward_power: float = 1.0,
    num_worlds: int = 1,
    seed: int = 0,
) -> GridWorld:
    """A grid with independent random rewards, as in the paper's first simulation.

    Args:
        height, width: size in cells.
        edges: "wall": a move off the grid stays where it is. "torus": it comes back on the other side.
        reward_power: rewards are uniform numbers between 0 and 1 raised to this power; large powers leave few good
            cells. The power does not change which plan is best where rewards are compared, not added.
        num_worlds: number of reward maps, W.
        seed: gives the same rewards again.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = gridworld(20, 20, edges="torus", num_worlds=3, seed=0)
        >>> world.num_actions, world.reward.shape
        (4, torch.Size([3, 400]))
    """
    if not is_number(reward_power) or not 0 < reward_power < float("inf"):
        raise ValueError(f"`reward_power` must be a positive finite number, got {reward_power!r}")
    check_sizes(height=height, width=width, num_worlds=num_worlds)
    check_seed(seed)
    check_memory(8 * height * width * num_worlds, height=height, width=width, num_worlds=num_worlds)
    if edges not in ("wall", "torus"):
        raise ValueError(f'`edges` must be "wall" or "torus", got {edges!r}')
    uniform = torch.rand(num_worlds, height * width, generator=torch.Generator().manual_seed(seed))
    return GridWorld(height, width, edges, uniform.pow(reward_power))


def egocentric(world: GridWorld) -> GridWorld:
    """The same grid for an agent with a heading, whose actions are turning left, turning right and going forward.

    A turn stays in the square and is rewarded as an arrival there. A `view` turns with the agent.

    Raises:
        ValueError: the agents of `world` have headings already.

    Example:
        >>> egocentric(gridworld(5, 5, seed=0)).action_names
        ('left', 'right', 'forward')
    """
    if world.egocentric:
        raise ValueError("`world` must be a grid with four moves, got one whose agents have headings")
    return GridWorld(
        world.height, world.width, world.edges, world.reward, walls=world.walls, egocentric=True, view=world.view
    )


def local_view(world: GridWorld, radius: int = 2) -> Callable[[Tensor], Tensor]:
    """The squares around an agent, as features for a prior: which of them are free.

    Args:
        world: a grid.
        radius: how many rows and columns the view reaches, through walls too.

    Returns:
        A function from states `[N]` to float32 `[N, C]`, C = (2 * radius + 1) ** 2 - 1: 1 for a free square, 0 for a
        wall or what is beyond the edge; row by row from the top left, without the agent's own square. In an egocentric
        grid the first row is the farthest before the agent. `GridWorld(view=radius)` observes the same.

    Raises:
        ValueError: the radius is not at least 1.

    Example:
        >>> local_view(gridworld(5, 5, seed=0), radius=1)(torch.tensor([0, 12])).shape
        torch.Size([2, 8])
    """
    _check_view(radius)
    table = _view_table(world.walls, world.edges, radius, world.egocentric)
    return lambda state: table.index_select(0, world.cell(state)).float()


def goal_direction(world: GridWorld) -> Callable[[Tensor], Tensor]:
    """Where the goal is, as features for a prior: how many squares ahead and to the right.

    Args:
        world: a grid whose edges are walls; the goal of a layout is its square of highest reward, in each reward map
            (`maze(reward="goal")` has one).

    Returns:
        A function from states `[N]` to float32 `[N, 2]`: rows up and columns to the right from the agent to the goal;
        in an egocentric grid squares ahead and to the right of its heading.

    Raises:
        ValueError: the grid is a torus, where there are several ways to count.

    Example:
        >>> world = four_rooms(7, 7, reward="goal", seed=0)
        >>> goal_direction(world)(world.reset(5, torch.Generator().manual_seed(0))).shape
        torch.Size([5, 2])
    """
    if world.edges == "torus":
        raise ValueError(
            "`world` must be a grid whose edges are walls, got a torus, where there are several ways to count"
        )
    area = world.height * world.width
    reward = world.reward[:, ::4] if world.egocentric else world.reward
    goal = reward.view(world.num_maps, world.num_layouts, area).argmax(-1)

    def direction(state: Tensor) -> Tensor:
        square = goal[world.reward_map(state), world.layout(state)]
        where = torch.stack([square.div(world.width, rounding_mode="floor"), square % world.width], -1)
        away = where - world.coordinates(state)
        heading = world.heading(state) if world.egocentric else torch.zeros_like(state)
        compass = _ROW_COLUMN.to(state.device)
        return torch.stack([(away * compass[(heading + turn) % 4]).sum(-1) for turn in (0, 1)], -1).float()

    return direction


def _check_view(view: int | None) -> None:
    """Raise ValueError unless `view` is a radius of at least 1, or None."""
    if view is not None and (not is_whole(view) or view < 1):
        raise ValueError(f"`view` must be a radius of at least 1 square, got {view!r}")


def _view_table(walls: Tensor, edges: Literal["wall", "torus"], radius: int, egocentric: bool) -> Tensor:
    """Which squares around each cell are free.

    Args:
        walls: bool `[M, H, W]`.
        edges: what is beyond the edge: "wall": walls. "torus": the other side.
        radius: how many squares the view reaches in each direction.
        egocentric: the agent has one of four headings in each square, and what is ahead comes first.

    Returns:
        Bool `[M * H * W, C]`, with headings `[M * H * W * 4, C]`: C = (2 * radius + 1) ** 2 - 1 squares, row by row
        from the top left (with the heading up), without the agent's own.
    """
    _, height, width = walls.shape
    size = 2 * radius + 1
    if edges == "torus":
        rows, columns = (torch.arange(-radius, n + radius, device=walls.device) % n for n in (height, width))
        free = ~walls[:, rows[:, None], columns]
    else:
        free = torch.nn.functional.pad(~walls, [radius] * 4)
    around = free.unfold(1, size, 1).unfold(2, size, 1).reshape(-1, size, size)
    if egocentric:
        around = torch.stack([around.rot90(heading, (1, 2)) for heading in range(4)], 1)
    around = around.reshape(-1, size * size)
    return torch.cat([around[:, : size * size // 2], around[:, size * size // 2 + 1 :]], 1)


def _moves(walls: Tensor, edges: str) -> Tensor:
    """The transition table `[M * H * W, 4]`."""
    layouts, height, width = walls.shape
    device = walls.device
    rows, columns = torch.meshgrid(
        torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij"
    )
    to = torch.stack([rows, columns], -1).view(-1, 1, 2) + _ROW_COLUMN.to(device)
    size = torch.tensor([height, width], device=device)
    to = to % size if edges == "torus" else to.clamp(min=torch.zeros_like(size), max=size - 1)
    square = torch.arange(height * width, device=device)[:, None]
    to = to[..., 0] * width + to[..., 1]
    blocked = walls.view(layouts, -1)
    after = torch.where(blocked[:, to] | blocked[:, :, None], square, to)
    return (after + torch.arange(layouts, device=device)[:, None, None] * height * width).view(-1, 4)


def _turns_and_moves(moves: Tensor) -> Tensor:
    """The transition table `[4 * S, 3]` of (square, heading), from that of the four moves, `[S, 4]`."""
    square, heading = torch.arange(len(moves), device=moves.device)[:, None], torch.arange(4, device=moves.device)
    turns = [4 * square + (heading + turn) % 4 for turn in (-1, 1)]
    return torch.stack([*turns, 4 * moves + heading], -1).view(-1, 3)


def _check_walls(walls: Tensor, height: int, width: int) -> None:
    if walls.dtype != torch.bool or walls.dim() != 3 or walls.shape[1:] != (height, width) or len(walls) == 0:
        raise ValueError(
            f"`walls` must be bool of shape [M, {height}, {width}],"
            f" got {str(walls.dtype).removeprefix('torch.')} of shape {list(walls.shape)}"
        )
    full = walls.flatten(1).all(1).nonzero()
    if len(full):
        raise ValueError(f"walls[{int(full[0])}]: this layout has no free square; every layout needs one")
