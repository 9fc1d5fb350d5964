"""What both simulations of the paper share: settings, the priors that learn, planners, and tables."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Literal

import pandas as pd
import torch
from torch import Tensor

from neuroprior import (
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    Planner,
    Plans,
    Prior,
    SamplingPlanner,
    TransformerPrior,
    UniformPrior,
)
from neuroprior._statistics import Interval, mean_interval, paired_difference, share_interval
from neuroprior.worlds import GridWorld

ANY_PREFIX = " (any prefix)"
"""Added to the name of a planner that may end a plan after any of its actions."""

Finished = Callable[[str], object]
"""Is called with the name of each part of a simulation that is finished."""


@dataclass(frozen=True)
class PaperSettings:
    """The options of `paper`, which explains them."""

    worlds: int
    starts: int
    training_plans: int
    size: int
    edges: Literal["torus", "wall"]
    ties: Literal["uniform", "first"]
    learn_from: Literal["all", "shortest"]
    reward_power: float
    value_functions: int
    q_steps: int
    initial_scale: float
    max_plans: int
    depth: int
    length: int
    num_plans: int
    steps: int
    seed: int

    @property
    def protocol(self) -> str:
        """What the paper leaves open of its first simulation."""
        return f"{self.edges}, {self.ties} ties, learn from {self.learn_from}"

    @property
    def goal(self) -> int:
        """The goal's cell of the second simulation, at the centre."""
        return self.size // 2 * self.size + self.size // 2


def fit_priors(
    plans: Plans, settings: PaperSettings, neural: bool, generator: torch.Generator, finished: Finished
) -> dict[str, Prior]:
    """The priors of the tables by name, with the neural ones or without.

    Order 3, which the paper does not have, is the highest that plans of four moves can teach: a baseline for neural
    priors.
    """
    priors: dict[str, Prior] = {"random": UniformPrior(4)}
    for order in (1, 2, 3):
        priors[f"markov-{order}"] = MarkovPrior(4, order).fit(plans)
    if neural:
        for name, make in (("gru", GRUPrior), ("transformer", TransformerPrior)):
            prior = make(4, seed=settings.seed)
            priors[name] = prior.fit(plans, generator=generator, progress=False, max_steps=settings.steps)
            finished(f"training: {name}")
    return priors


def make_planners(
    priors: dict[str, Prior],
    settings: PaperSettings,
    value: Callable[[Tensor], Tensor] | None = None,
    any_prefix: bool = False,
) -> dict[str, Planner]:
    """The planners of the tables by name: the deterministic one, and one for each prior."""
    how: dict[str, Any] = {"value": value, "any_prefix": any_prefix}
    planners: dict[str, Planner] = {"deterministic": ExhaustivePlanner(settings.depth, **how)}
    for name, prior in priors.items():
        planners[name] = SamplingPlanner(prior, settings.length, settings.num_plans, **how)
    return {name + ANY_PREFIX * any_prefix: planner for name, planner in planners.items()}


def groups(world: GridWorld, states: Tensor) -> Tensor | None:
    """The reward map of each state as its plan's group; None for one map: a single group cannot be split in two."""
    maps = world.reward_map(states)
    return maps if len(maps.unique()) > 1 else None


def over_groups(hits: Tensor) -> Interval:
    """The share of True in `hits [G, n]` with an interval over the G worlds or value functions.

    Where there is only one, the interval is over its starts.
    """
    if len(hits) == 1:
        return share_interval(int(hits.sum()), hits.numel())
    share, low, high = mean_interval(hits.double().mean(1))
    return Interval(share, max(low, 0.0), min(high, 1.0))


def share_table(what: str, hits: Mapping[str, Tensor], paper: Mapping[str, float]) -> pd.DataFrame:
    """A row a planner: the share of True in its `hits [G, n]`, with an interval, and the paper's."""
    shares = pd.DataFrame([over_groups(hit) for hit in hits.values()]).set_axis([what, "low", "high"], axis=1)
    shares.insert(0, "planner", list(hits))
    return shares.assign(paper=shares.planner.map(paper))


def paired_table(shares: Mapping[str, Tensor], pairs: Iterable[tuple[str, str]]) -> pd.DataFrame:
    """The first of each pair of planners minus the second: means of `shares [G]`, paired over worlds or values."""
    return pd.DataFrame(
        {"first": one, "second": other, **paired_difference(shares[one], shares[other])._asdict()}
        for one, other in pairs
    )


def best_markov(shares: Mapping[str, Tensor], suffix: str = "") -> str:
    """The Markov prior with the highest mean share."""
    return max((f"markov-{order}{suffix}" for order in (1, 2, 3)), key=lambda name: float(shares[name].mean()))


def under_each(
    choices: Mapping[str, Sequence[Any]],
    settings: PaperSettings,
    summary: Callable[[PaperSettings], dict[str, Any]],
    finished: Finished,
) -> pd.DataFrame:
    """A row with the summary of a simulation for each combination of `choices`, which replace settings."""
    rows = []
    for values in product(*choices.values()):
        chosen: dict[str, Any] = dict(zip(choices, values, strict=True))
        rows.append(chosen | summary(replace(settings, **chosen)))
        finished(", ".join(map(str, values)))
    return pd.DataFrame(rows)
