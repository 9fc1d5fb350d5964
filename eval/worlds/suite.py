"""The worlds of `python -m eval compare`, `depth` and `curriculum`: what is optimised and observed in each.

To add a world, add a `Task` to `TASKS` below. Its `worlds` makes three worlds for a seed, mostly with a function of
`eval.worlds.splits`. A world that is no `TabularWorld` also needs its optimum in `best_score`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeAlias

import torch
from torch import Tensor

from eval.worlds import minigrid, splits
from eval.worlds.mid_plan import MidPlanWorld
from neuroprior.planners import oracle
from neuroprior.worlds import PocketCube, TabularWorld, World, four_rooms, gridworld, maze
from neuroprior.worlds.cube import FACES
from neuroprior.worlds.grid import MOVES, TURNS

Context = Literal["none", "initial", "per-step"]
"""The context that a prior is given: none, what is observed at the start, or what is observed before each action."""


@dataclass(frozen=True)
class Task:
    """A world of the comparison.

    Attributes:
        action_names: of its actions, in the order of their numbers.
        about: what it is, what is optimised, and what differs between the worlds of a seed.
        worlds: makes the worlds of a seed.
        depth: of the exhaustive planner whose plans are learned from first.
        lengths: numbers of actions in the plans of the horizon curriculum, round by round; the last is that of the
            comparison.
        objective, discount, any_prefix: what planners optimise, see `neuroprior.planners.Planner`.
        min_score: plans that scored no more than this are not learned from; None: all are.
        observation: what `World.observe` of these worlds returns, for priors with context; None: nothing of use.
        state_number: the observation is the number of a state, which is of no use as initial context, since other
            starts are held out.
        feature_sets: sets of the observed features; Markov priors may be given one of them alone, since they have to
            meet a context in training to know it.
        contexts: those that priors are compared with where no others are asked for.
        start_factor: plans are collected from so many times as many starts, where most starts lead nowhere.
    """

    action_names: tuple[str, ...]
    about: str
    worlds: Callable[[int], splits.Worlds]
    depth: int
    lengths: tuple[int, ...]
    objective: Literal["terminal", "return"] = "terminal"
    discount: float = 1.0
    any_prefix: bool = False
    min_score: float | None = None
    observation: str | None = None
    state_number: bool = False
    feature_sets: tuple[tuple[int, ...], ...] = ()
    contexts: tuple[Context, ...] = ("none",)
    start_factor: int = 1

    @property
    def num_actions(self) -> int:
        """Number of actions."""
        return len(self.action_names)

    @property
    def length(self) -> int:
        """Actions in the plans that are compared."""
        return self.lengths[-1]

    @property
    def scoring(self) -> dict[str, Any]:
        """What planners optimise, as their arguments."""
        return {"objective": self.objective, "discount": self.discount, "any_prefix": self.any_prefix}

    def offers(self, context: Context) -> bool:
        """Whether this context is of use here; none always is."""
        if context == "none":
            return True
        return self.observation is not None and not (self.state_number and context == "initial")


_ENDS = "the reward where a plan ends; new walls and rewards held out"
_SQUARES = "which of the 24 squares around it are free"
# Of the squares around, five rows of five without the middle, the eight nearest.
_EIGHT = (6, 7, 8, 11, 12, 15, 16, 17)

_moving: dict[str, Any] = {
    "action_names": MOVES,
    "depth": 5,
    "lengths": (10, 16),
    "observation": _SQUARES,
    "feature_sets": (_EIGHT, (7, 11, 12, 16)),
    "contexts": ("none", "initial"),
    "start_factor": 2,
}
_turning: dict[str, Any] = {"action_names": TURNS, "depth": 7, "lengths": (11, 16), "start_factor": 2}
# Later is worth less, so that the best plans go straight there.
_goal: dict[str, Any] = {"objective": "return", "discount": 0.95, "min_score": 0.0}
_states: dict[str, Any] = {"state_number": True, "contexts": ("none", "per-step")}
_lake: dict[str, Any] = {"action_names": ("left", "down", "right", "up"), "depth": 5, "lengths": (9, 14)}


def _minigrid(about: str, environment: str) -> Task:
    return Task(
        minigrid.MOVES,
        f"MiniGrid {about}; reaching it; new layouts held out",
        partial(splits.minigrid_layouts, environment=environment),
        5,
        (9, 16),
        observation="the seven by seven squares before it",
        feature_sets=minigrid.NEAR,
        contexts=("none", "per-step"),
        start_factor=3,
        **_goal,
    )


TASKS = {
    "grid": Task(
        MOVES,
        "the paper's grid: 20 x 20, a torus, independent rewards; the reward where a plan ends; new rewards held out",
        partial(splits.from_seeds, make=gridworld, edges="torus", num_worlds=splits.MAPS),
        4,
        (6, 8),
    ),
    "four_rooms": Task(
        about=f"four rooms, 13 x 13, doors at random places, four moves; {_ENDS}",
        worlds=partial(splits.grid_layouts, make=four_rooms),
        **_moving,
    ),
    "maze": Task(
        about=f"mazes with some loops, 15 x 15, four moves; {_ENDS}",
        worlds=partial(splits.grid_layouts, make=maze),
        **_moving,
    ),
    "egocentric": Task(
        about=f"the same mazes for an agent that turns left, turns right or goes forward; {_ENDS}",
        worlds=partial(splits.grid_layouts, make=maze, egocentric=True),
        observation=f"{_SQUARES}, as it is turned",
        feature_sets=(_EIGHT, (7, 11, 12)),
        contexts=("none", "initial", "per-step"),
        **_turning,
    ),
    "goal_maze": Task(
        about="the same mazes with a goal whose direction is observed; reaching it; new walls and goals held out",
        worlds=splits.goal_mazes,
        observation=f"{_SQUARES}, and how far ahead and aside the goal is",
        # With the side on which the goal is, and no more, Markov priors meet the same contexts again.
        feature_sets=((*_EIGHT, 26, 27), (7, 11, 12, 26, 27)),
        contexts=("none", "per-step"),
        **_turning | _goal | {"start_factor": 8},
    ),
    "mid_plan": Task(
        about=f"the egocentric mazes, planning anew after the first {splits.TAKEN} of {splits.LAST} moves; {_ENDS}",
        worlds=splits.mid_plan,
        observation="what is left of the last plan",
        feature_sets=tuple(tuple(range(len(TURNS) * left)) for left in (1, 2)),
        contexts=("none", "initial"),
        **_turning,
    ),
    "taxi": Task(
        ("south", "north", "east", "west", "pickup", "dropoff"),
        "Taxi: fetch a passenger and bring it; the sum of rewards; a quarter of all states to start from held out",
        partial(splits.split_starts, name="Taxi-v4"),
        5,
        (10, 16),
        "return",
        observation="the whole state",
        **_states,
    ),
    "cliff": Task(
        MOVES,
        "CliffWalking: go around a cliff; the sum of rewards; a quarter of all squares to start from held out",
        partial(splits.split_starts, name="CliffWalking-v1"),
        5,
        (10, 16),
        "return",
        observation="the square",
        **_states,
    ),
    "frozen_lake": Task(
        about="FrozenLake, 8 x 8, not slippery: to the goal, between holes; reaching it; new lakes held out",
        worlds=partial(splits.frozen_lakes, slippery=False),
        **_lake | _goal,
    ),
    "slippery": Task(
        about="FrozenLake, 8 x 8, slippery: a third of the moves go where they should; how likely a plan reaches the"
        " goal; new lakes held out",
        worlds=partial(splits.frozen_lakes, slippery=True),
        objective="return",
        **_lake,
    ),
    "minigrid_four_rooms": _minigrid("FourRooms: to a goal square, seven actions", "MiniGrid-FourRooms-v0"),
    "minigrid_multi_room": _minigrid(
        "MultiRoom: through the doors of four rooms to a goal square",
        "MiniGrid-MultiRoom-N4-S5-v1",
    ),
    "minigrid_door_key": _minigrid(
        "DoorKey, 6 x 6: fetch a key, open a door, go to a goal square", "MiniGrid-DoorKey-6x6-v0"
    ),
    "cube": Task(
        tuple(face + turn for face in FACES for turn in ("", "2", "'")),
        "the 2 x 2 x 2 cube after nine random moves, half turns too; passing the solved state; a quarter held out",
        splits.scrambled_cubes,
        4,
        (6, 7, 8),
        observation="the whole cube",
        contexts=("none", "per-step"),
        start_factor=8,
        **_goal,
    ),
}
"""By name."""

WorldName: TypeAlias = Literal[tuple(TASKS)]  # type: ignore[valid-type]
"""A name of `TASKS`, as the type of an option."""


def check_contexts(worlds: Sequence[str], contexts: Sequence[Context]) -> None:
    """Raise ValueError where contexts are asked for, and none of them is of use in one of the worlds."""
    useless = [world for world in worlds if contexts and not any(map(TASKS[world].offers, contexts))]
    if useless:
        raise ValueError(f"context: {useless[0]} offers no context of use; leave it out, or add none to --context")


def best_score(task: Task, world: World, state: Tensor, length: int) -> Tensor:
    """The optimum from each of `state [B]`: `[B]`, what the best plan of `length` actions scores.

    In stochastic worlds: what the best policy scores in the mean.
    """
    if isinstance(world, PocketCube):
        distance = world.distance(state)
        there = (distance > 0) & (distance <= length)
        return torch.where(there, task.discount ** (distance.float() - 1), 0.0)
    if isinstance(world, MidPlanWorld):
        return best_score(task, world.world, state[:, 0], length)
    assert isinstance(world, TabularWorld)
    return oracle(world, state, length, **task.scoring)
