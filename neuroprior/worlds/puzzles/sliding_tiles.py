"""Sliding tiles: the 8-, 15- and 24-puzzle, and boards of any other size."""

from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from neuroprior._checks import check_count, is_integer
from neuroprior._random import generator_on
from neuroprior.worlds.puzzles.reading import read_tiles
from neuroprior.worlds.world import World


class SlidingTilesWorld(World):
    """Sliding tiles; see `sliding_tiles`.

    A state is the board, uint8 `[H, W]`: the numbers of the tiles, 0 the blank. A solved board stays as it is.

    Attributes:
        boards: uint8 `[n, H, W]`: the starts; None: `reset` scrambles the goal.
        goal: uint8 `[H, W]`.
        scramble: number of random moves from the goal, where there are no boards.
        observation: "patterns" or "board".
        num_codes: the codes of the patterns are below it.
    """

    num_actions = 4
    action_names = ("up", "down", "left", "right")
    all_legal = False
    has_goal = True

    def __init__(
        self, boards: Tensor | None, goal: Tensor, observation: Literal["patterns", "board"], scramble: int
    ) -> None:
        if observation not in ("patterns", "board"):
            raise ValueError(f'sliding_tiles: observation must be "patterns" or "board", not {observation!r}')
        self.goal, self.boards, self.observation, self.scramble = goal, boards, observation, scramble
        self.num_codes = goal.numel() ** 3
        if boards is not None:
            wrong = (~_solvable(boards, goal)).nonzero()
            if len(wrong):
                raise ValueError(f"boards[{int(wrong[0])}]: the goal cannot be reached from this board")

    @property
    def device(self) -> torch.device:
        """Where the boards are."""
        return self.goal.device

    def to(self, device: torch.device | str) -> "SlidingTilesWorld":
        """Move the boards to `device`; returns self."""
        self.goal = self.goal.to(device)
        self.boards = None if self.boards is None else self.boards.to(device)
        return self

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """Random boards of those given, or the goal after random legal moves: uint8 `[batch_size, H, W]`."""
        check_count("batch_size", batch_size, self.goal.numel())
        generator = generator_on(generator, self.device)
        if self.boards is not None:
            drawn = torch.randint(len(self.boards), (batch_size,), generator=generator, device=self.device)
            return self.boards[drawn]
        state = self.goal.expand(batch_size, *self.goal.shape).contiguous()
        for _ in range(self.scramble if batch_size else 0):
            action = torch.multinomial(self.legal_actions(state).float(), 1, generator=generator)[:, 0]
            state = self._after(state, action)
        return state

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """The blank moves; an illegal action, and any action where the goal is reached, leaves the state as it is.

        The reward is 1 for the step that reaches the goal, else 0.
        """
        ended = self.solved(state)
        after = torch.where(ended[:, None, None], state, self._after(state, action))
        return after, (self.solved(after) & ~ended).float()

    def _after(self, state: Tensor, action: Tensor) -> Tensor:
        """Boards after a move of the blank, if it is legal."""
        flat = state.flatten(1)
        blank = _blank(flat)
        width = state.shape[2]
        legal = self.legal_actions(state).gather(1, action[:, None])[:, 0]
        move = torch.tensor([-width, width, -1, 1], device=state.device)[action]
        to = torch.where(legal, blank + move, blank)
        tile = flat.gather(1, to[:, None])
        return flat.scatter(1, blank[:, None], tile).scatter(1, to[:, None], 0).view_as(state)

    def legal_actions(self, state: Tensor) -> Tensor:
        """Moves of the blank that stay on the board: `[N, 4]` bool."""
        height, width = state.shape[1:]
        blank = _blank(state.flatten(1))
        row, column = blank // width, blank % width
        return torch.stack([row > 0, row < height - 1, column > 0, column < width - 1], 1)

    def solved(self, state: Tensor) -> Tensor:
        """Where the board is the goal."""
        return (state == self.goal).flatten(1).all(1)

    def terminated(self, state: Tensor) -> Tensor:
        """Where the board is the goal."""
        return self.solved(state)

    def observe(self, state: Tensor) -> Tensor:
        """What `observation` says, of a board with C = H * W cells.

        "board": float32 `[N, C * C]`: the tile of each cell, one-hot.

        "patterns": int32 `[N, C - 1]`: for each cell but the blank's, row by row, its tile together with where the
        cell and the blank are: `(blank * C + cell) * C + tile`.
        """
        flat, cells = state.flatten(1).long(), self.goal.numel()
        if self.observation == "board":
            return torch.nn.functional.one_hot(flat, cells).flatten(1).float()
        blank = _blank(state.flatten(1))[:, None]
        cell = torch.arange(cells - 1, device=state.device)
        cell = cell + (cell >= blank)
        return ((blank * cells + cell) * cells + flat.gather(1, cell)).int()

    def lower_bound(self, state: Tensor) -> Tensor:
        """The sum of the tiles' Manhattan distances from their places in the goal, int64 `[N]`: admissible."""
        flat, width = state.flatten(1).long(), state.shape[2]
        place = self.goal.flatten().long().argsort()[flat]
        cell = torch.arange(flat.shape[1], device=state.device)
        distance = (place // width - cell // width).abs() + (place % width - cell % width).abs()
        return distance.masked_fill(flat == 0, 0).sum(1)

    def check_state(self, state: Tensor) -> None:
        height, width = self.goal.shape
        if not isinstance(state, Tensor) or state.dtype != torch.uint8 or state.shape[1:] != self.goal.shape:
            raise ValueError(f"state: uint8 of shape [B, {height}, {width}] is expected: boards")
        _check_permutations("state", state)


def sliding_tiles(
    boards: Any = None,
    *,
    shape: tuple[int, int] | None = None,
    goal: Any = None,
    observation: Literal["patterns", "board"] = "patterns",
    scramble: int = 100,
) -> SlidingTilesWorld:
    """Sliding tiles: the blank moves, and changes places with the tile that is there.

    Args:
        boards: a file of puzzles (see `read_tiles`), or integers `[n, H, W]`, or `[n, H * W]` with `shape`: the numbers
            of the tiles, 0 the blank; None: the goal is scrambled, and `shape` or `goal` is needed.
        shape: height and width.
        goal: integers `[H, W]`; None: 0, 1, 2, ... row by row.
        observation: "patterns": codes of where each tile and the blank are; "board": the board one-hot. See
            `SlidingTilesWorld.observe`.
        scramble: number of random moves from the goal, where there are no boards.

    Raises:
        ValueError: a board is none, or cannot be solved (the message names the first one), or an argument is out of
            range.
    """
    check_count("scramble", scramble)
    if shape is not None and (len(shape) != 2 or min(shape) < 1):
        raise ValueError(f"shape: height and width, at least 1, are expected, not {shape}")
    given = None
    if boards is not None:
        is_file = isinstance(boards, str | Path)
        given = torch.as_tensor(read_tiles(boards, shape) if is_file else boards)
        if shape is not None and given.dim() == 2 and given.shape[1] == shape[0] * shape[1]:
            given = given.view(-1, *shape)
        if given.dim() != 3 or 0 in given.shape or (shape is not None and given.shape[1:] != shape):
            wanted = "[n, H, W], or [n, H * W] with shape=(H, W)," if shape is None else f"[n, {shape[0]}, {shape[1]}]"
            raise ValueError(f"boards: shape {wanted} is expected, not {list(given.shape)}")
        shape = (given.shape[1], given.shape[2])
    if goal is None:
        if shape is None:
            raise ValueError("sliding_tiles: give boards, shape or goal")
        goal = torch.arange(shape[0] * shape[1]).view(shape)
    goal = torch.as_tensor(goal)
    if goal.dim() != 2 or (shape is not None and goal.shape != shape):
        raise ValueError(
            f"goal: shape {'[H, W]' if shape is None else list(shape)} is expected, not {list(goal.shape)}"
        )
    if not 2 <= goal.numel() <= 256:
        raise ValueError(f"goal: a board of 2 to 256 cells is expected, not {goal.numel()}")
    _check_permutations("goal", goal[None])
    if given is not None:
        _check_permutations("boards", given)
        given, goal = given.to(torch.uint8), goal.to(given.device)
    return SlidingTilesWorld(given, goal.to(torch.uint8), observation, scramble)


def _check_permutations(name: str, boards: Tensor) -> None:
    """Raise ValueError unless each of `boards [n, H, W]` holds each tile once."""
    cells = boards[0].numel() if len(boards) else 0
    if not is_integer(boards):
        raise ValueError(f"{name}: integers are expected, not {str(boards.dtype).removeprefix('torch.')}")
    wrong = (boards.flatten(1).long().sort(1).values != torch.arange(cells, device=boards.device)).any(1).nonzero()
    if len(wrong):
        which = name if name == "goal" else f"{name}[{int(wrong[0])}]"
        raise ValueError(f"{which}: each of 0 to {cells - 1} once is expected")


def _solvable(boards: Tensor, goal: Tensor) -> Tensor:
    """Whether `goal [H, W]` can be reached from `boards [n, H, W]`: `[n]` bool."""
    order = goal.flatten().long().argsort()
    place = order[boards.flatten(1).long()]  # where the tile of each cell belongs
    if min(goal.shape) == 1:  # tiles in one row cannot pass one another
        tiles = place[place != order[0]].view(len(boards), -1)
        return (tiles.diff(dim=1) > 0).all(1)
    # A move exchanges two tiles, which changes the parity of the permutation, and that of the blank's distance.
    inversions = sum((place[:, i, None] > place[:, i + 1 :]).sum(1) for i in range(place.shape[1]))
    width = goal.shape[1]
    blank = _blank(boards.flatten(1))
    away = (blank // width - order[0] // width).abs() + (blank % width - order[0] % width).abs()
    return (inversions + away) % 2 == 0


def _blank(flat: Tensor) -> Tensor:
    """int64 `[N]`: the cell of the blank in `flat [N, H * W]`."""
    return (flat == 0).to(torch.uint8).argmax(1)
