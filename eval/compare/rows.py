"""From the cells of a comparison to its tables: shares of the oracle, bits, growth; all with intervals.

A cell is all of one world and one seed: worlds to learn in, worlds held out, and priors of its own. Cells are what is
independent, so that all intervals go over the seeds of a world.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple
from warnings import catch_warnings, simplefilter

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from eval.compare.best import best_difference
from eval.compare.recipes import NEURAL
from neuroprior.analysis.statistics import holm

Array = NDArray[np.float64]
Cells = Sequence[Mapping[str, Any]]
Rows = list[dict[str, Any]]

RESAMPLES = 9_999
"""Of the bootstrap."""


class Key(NamedTuple):
    """A planner with its prior, by which the entries of cells belong together."""

    planner: str
    prior: str | None
    sees: str
    rounds: int

    @property
    def kind(self) -> str:
        """One of uniform, markov, neural, and other: macro, or a folder of any name. Empty without a prior."""
        if self.prior is None or self.prior == "uniform":
            return self.prior or ""
        if self.prior in NEURAL:
            return "neural"
        return "markov" if self.prior.removeprefix("markov-").isdecimal() else "other"

    @property
    def label(self) -> str:
        """Its name in tables and figures."""
        seeing = "" if self.sees == "nothing" else f", sees {self.sees}"
        return (self.prior or self.planner) + seeing + (", grown" if self.rounds else "")


UNIFORM = Key("sampling", "uniform", "nothing", 0)
"""Random plans."""


class Results(NamedTuple):
    """The cells of a world.

    Attributes:
        budgets: numbers of candidate plans.
        entries: by key and seed, in the order of the seeds.
    """

    budgets: list[int]
    entries: dict[Key, dict[int, Mapping[str, Any]]]

    def values(self, what: str, key: Key, num_plans: int | None = None) -> Array:
        """`[G]`: an entry's list `what` at a number of plans, seed by seed; a planner that has but one: this one."""
        own = [entry[what] for entry in self.entries[key].values()]
        place = 0 if num_plans is None else self.budgets.index(num_plans)
        return np.array([one[place] for one in own], dtype=np.float64)

    def curves(self, key: Key) -> Array:
        """`[G, budgets]`: the shares of the oracle."""
        return np.array([entry["share"] for entry in self.entries[key].values()], dtype=np.float64)

    def priors(self, *kinds: str) -> list[Key]:
        """The keys whose planner draws candidates from a prior of one of the kinds."""
        return [key for key in self.entries if key.planner == UNIFORM.planner and key.kind in kinds]


def by_world(cells: Cells) -> dict[str, Results]:
    """The cells of each world, in the order in which worlds come first.

    Raises:
        ValueError: a world has a seed twice, or cells with unlike numbers of plans.
    """
    found: dict[str, Results] = {}
    seen = set()
    for world in dict.fromkeys(cell["world"] for cell in cells):
        for cell in sorted((cell for cell in cells if cell["world"] == world), key=lambda cell: int(cell["seed"])):
            results = found.setdefault(world, Results(list(cell["budgets"]), {}))
            if results.budgets != list(cell["budgets"]):
                raise ValueError(
                    f"{world}, seed {cell['seed']}: the numbers of plans are {cell['budgets']}, not {results.budgets}"
                )
            for entry in cell["entries"]:
                key = Key(entry["planner"], entry["prior"], entry["sees"], entry["rounds"])
                if (world, cell["seed"], key) in seen:
                    raise ValueError(f"{world}, seed {cell['seed']}: {key.label} is there twice")
                seen.add((world, cell["seed"], key))
                results.entries.setdefault(key, {})[cell["seed"]] = entry
    return found


def intervals(values: Array) -> Array:
    """95 % bootstrap intervals of means `[K, G]` over the last dimension: `[K, 2]`; NaN for fewer than two values.

    The bias-corrected and accelerated bootstrap (Efron 1987); percentiles where that is undefined, as it is of values
    without spread. The same values give the same intervals.
    """
    if values.shape[1] < 2 or not len(values):
        return np.full((len(values), 2), np.nan)
    found = _bootstrap(values, "BCa")
    undefined = np.isnan(found).any(1)
    if undefined.any():
        found[undefined] = _bootstrap(values[undefined], "percentile")
    return found


def _bootstrap(values: Array, method: str) -> Array:
    with catch_warnings():
        # Of values without spread scipy warns, and divides 0 by 0.
        simplefilter("ignore")
        interval = stats.bootstrap(
            (values,), np.mean, axis=-1, n_resamples=RESAMPLES, batch=1000, method=method, random_state=0
        ).confidence_interval
    return np.stack([interval.low, interval.high], -1)


def estimated(values: Iterable[Array]) -> list[dict[str, Any]]:
    """The mean, low and high of each of some values over seeds, and how many seeds; those of one number together."""
    given = list(values)
    found: list[dict[str, Any]] = [{} for _ in given]
    for number in {len(one) for one in given}:
        places = [place for place, one in enumerate(given) if len(one) == number]
        for place, (low, high) in zip(places, intervals(np.stack([given[place] for place in places])), strict=True):
            mean = float(given[place].mean())
            found[place] = {"mean": mean, "low": number_or_none(low), "high": number_or_none(high), "seeds": number}
    return found


def corrected(rows: Rows) -> Rows:
    """The same rows with `p_holm`: their `p_value`, corrected for all rows of the same world."""
    for world in dict.fromkeys(row["world"] for row in rows):
        tested = [row for row in rows if row["world"] == world]
        for row, p_value in zip(tested, holm([row["p_value"] for row in tested]), strict=True):
            row["p_holm"] = float(p_value)
    return rows


def number_or_none(value: float) -> float | None:
    """A finite number; None for any other."""
    return float(value) if np.isfinite(value) else None


def rows(cells: Cells, num_plans: Sequence[int]) -> Rows:
    """The share of the oracle: a row a world, planner, prior and number of plans, with its interval over seeds.

    Raises:
        ValueError: cells do not have one of these numbers of plans; see also `by_world`.
    """
    found: Rows = []
    for world, results in by_world(cells).items():
        missing = sorted(set(num_plans) - set(results.budgets))
        if missing:
            raise ValueError(f"num_plans: {world} has {results.budgets}, not {missing[0]}")
        single = {key for key, own in results.entries.items() if len(next(iter(own.values()))["share"]) == 1}
        places = [(key, number) for key in results.entries for number in ([None] if key in single else list(num_plans))]
        shares = estimated(results.values("share", *place) for place in places)
        for (key, number), share in zip(places, shares, strict=True):
            found.append({"world": world} | key._asdict() | _row(results, key, number, share))
    return found


def _row(results: Results, key: Key, num_plans: int | None, share: Mapping[str, Any]) -> dict[str, Any]:
    steps, seconds = (results.values(what, key, num_plans) for what in ("model_steps", "seconds"))
    timed = seconds[np.isfinite(seconds)]
    return {
        "num_plans": num_plans,
        "model_steps": None if np.isnan(steps).any() else int(steps[0]) if np.ptp(steps) == 0 else float(steps.mean()),
        "oracle_share": share["mean"],
        "low": share["low"],
        "high": share["high"],
        "at_oracle": float(results.values("at_oracle", key, num_plans).mean()),
        "seconds_per_decision": float(timed.mean()) if len(timed) else None,
        "seeds": share["seeds"],
    }


def bits_rows(cells: Cells) -> Rows:
    """Held-out bits per action of each prior, and how many more than the best Markov chain takes.

    The best chain of those that see as much and have not grown: see `best_difference` for `more`, its interval and its
    p-value, which is not corrected for the number of priors.
    """
    found: Rows = []
    for world, results in by_world(cells).items():
        scored = {key: _bits(results, key) for key in results.entries}
        scored = {key: own for key, own in scored.items() if own}
        for key, bits in zip(scored, estimated(np.array([*own.values()]) for own in scored.values()), strict=True):
            chains = [scored[other] for other in scored if other.kind == "markov" and other[2:] == (key.sees, 0)]
            row = {"world": world, "prior": key.prior, "sees": key.sees, "rounds": key.rounds}
            row |= {"bits_per_action": bits["mean"]} | {name: bits[name] for name in ("low", "high", "seeds")}
            found.append(row | _more(scored[key], chains))
    return found


def _bits(results: Results, key: Key) -> dict[int, float]:
    own = results.entries[key].items()
    return {seed: entry["bits"] for seed, entry in own if entry.get("bits") is not None}


def _more(bits: Mapping[int, float], chains: Sequence[Mapping[int, float]]) -> dict[str, Any]:
    common = [seed for seed in bits if all(seed in chain for chain in chains)]
    if not chains or len(common) < 2:
        return dict.fromkeys(("more", "more_low", "more_high", "p_value"))
    own, *taken = (np.array([one[seed] for seed in common]) for one in (bits, *chains))
    # The fewer bits, the better.
    gap = best_difference(-own[None], -np.stack(taken))
    return {"more": -gap.mean, "more_low": -gap.high, "more_high": -gap.low, "p_value": gap.p_value}


def growth_rows(cells: Cells) -> Rows:
    """The share of the oracle after each round of growth, a row a world, prior, round, length and number of plans."""
    names = ("world", "prior", "sees", "round", "length", "num_plans")
    shares: dict[tuple[Any, ...], dict[int, float]] = {}
    for cell in cells:
        for one in cell["growth"]:
            place = tuple(({"world": cell["world"]} | one)[name] for name in names)
            shares.setdefault(place, {})[cell["seed"]] = one["share"]
    means = estimated(np.array([own[seed] for seed in sorted(own)]) for own in shares.values())
    return [
        dict(zip(names, place, strict=True))
        | {"oracle_share": share["mean"]}
        | {name: share[name] for name in ("low", "high", "seeds")}
        for place, share in zip(shares, means, strict=True)
    ]
