"""The tasks of `python -m eval control`, each in three conditions: the same world, new masses, a new goal."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any, Literal, TypeAlias

from neuroprior.control import ContinuousWorld, DoubleIntegrator, PlanarArm

Condition = Literal["same", "masses", "goal", "validation"]
CONDITIONS: tuple[Condition, ...] = ("same", "masses", "goal")

MASSES: dict[Condition, float] = {"same": 1.0, "masses": 1.4, "goal": 1.0, "validation": 1.2}
"""The factor on all masses in each condition. In "validation" the goal is another one, too, and not that of "goal"."""


@dataclass(frozen=True)
class ControlTask:
    """A simulator with a reward, and how far a planner looks ahead in it.

    Attributes:
        about: one line for people.
        make: makes the world of a condition.
        horizon: L, vectors in a plan.
        needs: the package that it needs, beside the core; "" for none.
    """

    about: str
    make: Callable[[Condition], ContinuousWorld]
    horizon: int
    needs: str = ""


Goals = dict[Condition, Any]
"""What a goal is in "goal" and in "validation"; elsewhere the simulator's own."""


def _arm(condition: Condition) -> ContinuousWorld:
    goals: Goals = {"goal": (-0.5, 0.6), "validation": (0.5, 0.6)}
    goal = {"goal": goals[condition]} if condition in goals else {}
    return PlanarArm(masses=MASSES[condition], **goal)


def _mujoco(name: str, goal: Any, validation: Any, condition: Condition) -> ContinuousWorld:
    from neuroprior.control import from_mujoco  # needs an extra, and takes time to import

    goals: Goals = {"goal": goal, "validation": validation}
    world: ContinuousWorld = from_mujoco(name, masses=MASSES[condition], goal=goals.get(condition))
    return world


def _masses(condition: Condition) -> ContinuousWorld:
    goals: Goals = {"goal": (1.0, -1.0), "validation": (-1.0, 0.5)}
    return DoubleIntegrator(mass=MASSES[condition], goal=goals.get(condition))


TASKS = {
    "half_cheetah": ControlTask(
        "HalfCheetah-v5: run; new goal: at 1.5 m/s", partial(_mujoco, "HalfCheetah-v5", 1.5, 3.0), 20, "mujoco"
    ),
    "reacher": ControlTask(
        "Reacher-v5: a hand to a random target; new goal: a target farther out than any before",
        partial(_mujoco, "Reacher-v5", (0.15, -0.15), (-0.14, 0.16)),
        20,
        "mujoco",
    ),
    "swimmer": ControlTask(
        "Swimmer-v5: swim; new goal: backwards at 0.1 m/s", partial(_mujoco, "Swimmer-v5", -0.1, 0.05), 25, "mujoco"
    ),
    "pusher": ControlTask(
        "Pusher-v5: push a cylinder to a target; new goal: another target",
        partial(_mujoco, "Pusher-v5", (0.25, 0.1), (0.35, -0.2)),
        25,
        "mujoco",
    ),
    "arm": ControlTask("a planar arm of three links past an obstacle; new goal: behind the base", _arm, 25),
    "double_integrator": ControlTask("a mass in a plane, to its goal; new goal: another place", _masses, 20),
    "hopper": ControlTask(
        "Hopper-v5: hop without falling; new goal: at 0.5 m/s", partial(_mujoco, "Hopper-v5", 0.5, 1.0), 25, "mujoco"
    ),
}

TaskName: TypeAlias = Literal[tuple(TASKS)]  # type: ignore[valid-type]


def check_there(name: str) -> None:
    """Raise ImportError where a task needs a package that is not installed."""
    needs = TASKS[name].needs
    if needs and not find_spec(needs):
        raise ImportError(f'{name} needs {needs}: pip install "neuroprior[{needs}]"')
