"""MiniGrid in `python -m eval compare`: many layouts in one table, and the features that are observed in them."""

from typing import Any

import torch
from torch import Tensor

from neuroprior.worlds import EpisodicWorld, Features, from_gymnasium

MOVES = ("left", "right", "forward", "pickup", "drop", "toggle", "done")
"""MiniGrid's actions in the order of their numbers."""

SIDE = 7
"""An agent observes SIDE by SIDE squares: up to six before it and three to each side."""

KINDS = 4
"""Features of a square: free to enter, a closed door, a thing to carry, the goal."""

OPEN = {1, 3, 8}
"""MiniGrid's numbers of what may be entered: nothing, floor, the goal; also a door (`DOOR`) that is open."""

DOOR, THINGS, GOAL = 4, (5, 7), 8
"""MiniGrid's numbers of doors, of things (from, to) and of the goal."""


def _squares(*columns_and_rows: tuple[int, int]) -> tuple[int, ...]:
    """The features of some squares; the agent is in column 3 of row 6, where what it carries is observed."""
    return tuple(KINDS * (SIDE * column + row) + kind for column, row in columns_and_rows for kind in range(KINDS))


NEAR = (
    _squares((3, 5), (2, 6), (4, 6), (3, 6)),
    _squares(*((column, row) for column in (2, 3, 4) for row in (4, 5, 6))),
)
"""Sets of features: the squares before, left and right, with what is carried; and three by three squares."""


def layouts(environment: str, seeds: range) -> EpisodicWorld:
    """All states of an environment's layouts, each a possible start, with the features of `square_features`.

    Raises:
        ImportError: MiniGrid is not installed.
    """
    how: dict[str, Any] = {"starts": "any", "observations": True, "progress": False}
    world = from_gymnasium(environment, seeds=seeds, **how)
    assert isinstance(world, EpisodicWorld)
    assert world.features is not None
    world.features = square_features(world.features)
    world.observation = Features(world.features.shape[1])
    return world


def square_features(features: Tensor) -> Tensor:
    """MiniGrid's observations, as one binary feature for each kind of thing that a square may hold.

    Args:
        features: `[N, C]`: the agent's heading (four features), then of each square its object, colour and state.

    Returns:
        float32 `[N, SIDE * SIDE * KINDS]`. The heading is left out: the squares turn with the agent.
    """
    kind, _, state = features[:, -SIDE * SIDE * 3 :].view(-1, SIDE * SIDE, 3).round().long().unbind(-1)
    door, shut = kind == DOOR, state > 0
    free = torch.isin(kind, torch.tensor(sorted(OPEN))) | door & ~shut
    thing = (kind >= THINGS[0]) & (kind <= THINGS[1])
    return torch.stack([free, door & shut, thing, kind == GOAL], -1).float().flatten(1)
