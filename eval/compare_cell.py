"""Everything of one world and one seed."""

from dataclasses import dataclass
from typing import Any

from eval.suite import Task


@dataclass(frozen=True)
class Settings:
    """All that decides the results of a cell, beside its world and seed.

    Attributes:
        num_plans: numbers of candidate plans.
        kinds: of fitted priors: "markov", "gru", "transformer".
        sees: what priors see: "nothing", "start", "each step".
        rounds: of horizon growth.
        steps: of training of each neural prior, at most.
        starts: held-out starts to plan from.
        training_starts: from so many starts plans are collected to learn from.
        seed: of everything random.
        priors: folders of saved priors.
        lengths: actions in a plan, round by round of horizon growth; none: those of the world.
    """

    num_plans: tuple[int, ...]
    kinds: tuple[str, ...]
    sees: tuple[str, ...]
    rounds: int
    steps: int
    starts: int
    training_starts: int
    seed: int
    priors: tuple[str, ...] = ()
    lengths: tuple[int, ...] = ()


def recipe() -> str:
    """All that decides a cell beside its settings; after a change of it, finished cells do not count."""
    return "made up"


def run_cell(task: Task, seed: int, settings: Settings) -> dict[str, Any]:
    """Fit all priors and plan with each."""
    raise NotImplementedError


def run_growth(task: Task, seed: int, settings: Settings) -> dict[str, Any]:
    """Grow all priors and plan with each after every round."""
    raise NotImplementedError
