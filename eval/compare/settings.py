"""The settings of `eval compare`, `grow` and `live`: all that decides what is found, beside world and seed."""

from dataclasses import dataclass
from typing import Literal

SEES: dict[str, Literal["plan", "step"] | None] = {"nothing": None, "start": "plan", "each step": "step"}
"""How a prior's context is called in tables, and by `collect`."""


@dataclass(frozen=True)
class Settings:
    """All that decides the results of a cell, beside its world and seed.

    Attributes:
        num_plans: numbers of candidate plans, powers of two.
        kinds: of fitted priors: "markov", "gru", "transformer".
        sees: what priors see: "nothing", "start", "each step"; none of them: `Task.sights` in each world.
        rounds: of horizon growth, at most; a world has as many as it has lengths.
        steps: of training of each neural prior in a round, at most.
        starts: held-out starts to plan from.
        training_starts: from so many starts, times `Task.times`, plans are collected to learn from.
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

    @property
    def budgets(self) -> list[int]:
        """All powers of two up to the most candidates."""
        return [2**k for k in range(max(self.num_plans).bit_length())]


@dataclass(frozen=True)
class LiveSettings:
    """All that decides the results of a cell, beside its world and seed.

    Attributes:
        kinds: of priors that learn: "markov", "gru".
        period: steps in a season.
        seasons: that the agents live through.
        agents: that live in each world, and share one prior.
        items: of food.
        num_plans: candidates of each decision.
        length: actions in a plan.
        seed: of everything random.
    """

    kinds: tuple[str, ...]
    period: int
    seasons: int
    agents: int
    items: int
    num_plans: int
    length: int
    seed: int
