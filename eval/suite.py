"""The worlds of the comparison."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Task:
    """A world of the comparison.

    Attributes:
        name: of the world.
        num_actions: of the world.
        action_names: of its actions, or None.
    """

    name: str
    num_actions: int = 4
    action_names: tuple[str, ...] | None = None


MOVES = ("up", "right", "down", "left")
TASKS: dict[str, Task] = {
    "grid": Task("grid", 4, MOVES),
    "four_rooms": Task("four_rooms", 4, MOVES),
    "maze": Task("maze", 4, MOVES),
    "egocentric": Task("egocentric", 3, ("left", "forward", "right")),
    "taxi": Task("taxi", 6),
    "cliff": Task("cliff"),
    "frozen_lake": Task("frozen_lake"),
    "slippery": Task("slippery"),
    "minigrid_four_rooms": Task("minigrid_four_rooms", 7),
    "minigrid_multi_room": Task("minigrid_multi_room", 7),
    "minigrid_door_key": Task("minigrid_door_key", 7),
    "cube": Task("cube", 9),
}
