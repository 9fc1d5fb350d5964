"""From runs to tables of results: normalised scores, differences between priors, plans needed, bits, curriculum.

Intervals and tests are over the seeds of a world, since these are what is independent. Intervals are Student's, 95 %;
those of medians (of numbers of plans, some of which are infinite) are those of the sign test.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, get_args

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import optimize, stats

from eval.compare.priors import COMBINED, NEURAL
from eval.worlds.runs import across_worlds, frame_of, seed_means
from eval.worlds.suite import Context
from neuroprior._statistics import Difference, holm

Array = NDArray[np.float64]

BEST = "best neural minus best Markov"
AGAINST = ("combined minus best single", "combined minus best Markov", "combined minus best neural")
"""What the combined prior is compared with."""

LEARNED = ("neural", "markov", "other")
"""Kinds of priors that have learned something."""

PRIOR = ["prior", "context", "rounds"]
"""Columns that name a prior: its label, its context, and its rounds of the horizon curriculum."""

SAMPLING = ["temperature", "uniform_share", "alone"]
"""How candidates were drawn, `alone`: by one expert of a combined prior; in tables, the means over seeds."""

MORE_CONTEXT = {context: number for number, context in enumerate(get_args(Context))}
"""The contexts of priors, from the least to the most."""

CLOSE = 1e-9
"""Normalised scores that differ by less are the same."""


class Key(NamedTuple):
    """The columns `PRIOR` of a row."""

    prior: str
    context: str
    rounds: int

    @property
    def kind(self) -> str:
        """See `kind_of`."""
        return kind_of(self.prior)


UNIFORM = Key("uniform", "none", 0)
"""Random plans."""


def kind_of(prior: str) -> str:
    """The kind of a prior by its label: uniform, markov, neural, or other (macro, or the folder of a saved prior)."""
    if prior == "uniform":
        return prior
    if prior in NEURAL:
        return "neural"
    return "markov" if prior.removeprefix("markov-").isdecimal() else "other"


Pair = tuple[str, Sequence[Key], Sequence[Key]]
"""What is compared, in words, and two sets of priors; of a set of several, the best."""


@dataclass(frozen=True)
class Results:
    """The tables of a comparison, each computed when it is first asked for.

    Attributes:
        runs: as `eval.compare.run.compare_run` returns them.
        num_plans: numbers of candidate plans that were asked for.

    Raises:
        ValueError: there are no runs, or (from the tables) they do not belong together.
    """

    runs: Sequence[Mapping[str, Any]]
    num_plans: Sequence[int]

    def __post_init__(self) -> None:
        if not self.runs:
            raise ValueError("`runs` must have at least one run to compare")
        runs = sorted(self.runs, key=lambda run: (self.worlds.index(run["world"]), int(run["seed"])))
        object.__setattr__(self, "runs", runs)
        object.__setattr__(self, "num_plans", sorted(self.num_plans))

    @cached_property
    def worlds(self) -> list[str]:
        """The worlds, in the order in which they come first."""
        return list(dict.fromkeys(run["world"] for run in self.runs))

    @property
    def shown(self) -> int:
        """The number of plans of `words`: the median of those that were asked for, not one chosen by its result."""
        return self.num_plans[len(self.num_plans) // 2]

    @cached_property
    def scores(self) -> pd.DataFrame:
        """A row a world, seed, planner, prior and number of plans: `share` (normalised score), `at_oracle` and so on.

        A planner without candidate plans has one row, in which `num_plans` is missing.

        Raises:
            ValueError: a world has an entry twice, or runs with different numbers of plans.
        """
        budgets: dict[str, list[int]] = {}
        for run in self.runs:
            world, numbers = run["world"], list(run["budgets"])
            if budgets.setdefault(world, numbers) != numbers:
                raise ValueError(
                    f"{world}, seed {run['seed']}: the numbers of plans are {numbers}, not {budgets[world]}"
                )
        frame, place = frame_of(self.runs), ["world", "seed", "planner", *PRIOR]
        for _, twice in frame[frame.duplicated(place)].iterrows():
            name = twice["planner"] if pd.isna(twice["prior"]) else twice["prior"]
            raise ValueError(f"{twice['world']}, seed {twice['seed']}: {name} is there twice")
        frame["num_plans"] = [
            [None] if pd.isna(prior) else budgets[world]
            for world, prior in zip(frame["world"], frame["prior"], strict=True)
        ]
        lists = ["num_plans", "share", "at_oracle", "model_steps", "seconds"]
        frame = frame.reindex(columns=[*place, *SAMPLING, *lists]).explode(lists, ignore_index=True)
        return frame.astype(dict.fromkeys(lists, "float64") | {"num_plans": "Int64"})

    @cached_property
    def _by_prior(self) -> dict[str, dict[Key, pd.DataFrame]]:
        """In each world the normalised scores `[seed, num_plans]` of each prior."""
        return {
            world: {
                Key(*key): one.pivot(index="seed", columns="num_plans", values="share")
                for key, one in grouped(world_scores, PRIOR)
            }
            for (world,), world_scores in grouped(self.scores[self.scores["prior"].notna()], ["world"])
        }

    @cached_property
    def curves(self) -> pd.DataFrame:
        """The normalised score: a row a world, planner, prior and number of plans, with its interval over seeds."""
        by = ["world", "planner", *PRIOR, "num_plans"]
        curves = seed_means(self.scores, by, "share", ["model_steps", "at_oracle", "seconds", *SAMPLING])
        curves["model_steps"] = curves["model_steps"].convert_dtypes()
        return curves.rename(columns={"share": "oracle_share", "seconds": "seconds_per_decision"})

    @cached_property
    def rows(self) -> pd.DataFrame:
        """`curves` at the numbers of plans that were asked for.

        Raises:
            ValueError: runs do not have one of these.
        """
        for world, tables in self._by_prior.items():
            budgets = next(iter(tables.values())).columns.tolist()
            if missing := sorted(set(self.num_plans) - set(budgets)):
                raise ValueError(f"num_plans: {world} has {budgets}, not {missing[0]}")
        number = self.curves["num_plans"]
        return self.curves.loc[number.isna() | number.isin(self.num_plans)].reset_index(drop=True)

    @cached_property
    def paired(self) -> pd.DataFrame:
        """Differences in the normalised score between priors with as many plans, over the seeds that have both.

        What is compared: the best neural with the best Markov prior (see `best_difference`); each neural with each
        Markov prior; each saved or macro prior with every other; after with before the horizon curriculum; with and
        without context. All else is equal.

        A row a world, pair and number of plans: the scores of the two (`first_share`, `second_share`), their
        `difference` with Student's interval (`low`, `high`), `p_value` of the two-sided paired t-test, and `p_holm`,
        corrected for all rows of the world. Of a single seed scores and difference alone; the best are not chosen then.
        """
        gaps = [
            {"world": world} | gap
            for world, tables in self._by_prior.items()
            for pair in _pairs(tables)
            for number in self.num_plans
            if (gap := difference(tables, pair, number))
        ]
        return corrected(pd.DataFrame(gaps, columns=["world", *GAP]), ["world"])

    @cached_property
    def words(self) -> pd.DataFrame:
        """The answer in each world: the best neural against the best Markov prior of equal context and curriculum.

        Where a world lacks one of the kinds, its two learned priors, or the best of them against random plans. A row a
        world, context and number of rounds: that of the difference, with `p_holm` corrected for the number of
        worlds in which the same was asked, and `better`, the name of the better prior where `p_holm` is below 0.05.
        """
        rows = []
        for world, tables in self._by_prior.items():
            for like in dict.fromkeys(key[1:] for key in tables if key.kind in LEARNED):
                gaps = (difference(tables, pair, self.shown) for pair in _headlines(tables, like))
                if gap := next(filter(None, gaps), None):  # the first pair that can be compared
                    rows.append({"world": world} | gap | {"context": like[0], "rounds": like[1]})
        answers = pd.DataFrame(rows, columns=["world", *GAP])
        answers = corrected(answers.assign(after=answers["rounds"] > 0), ["context", "after"]).drop(columns="after")
        better = answers["first"].where(answers["difference"] > 0, answers["second"])
        return answers.assign(better=better.where(answers["p_holm"] < 0.05))

    @cached_property
    def efficiency(self) -> pd.DataFrame:
        """How many plans each prior needs for what random plans reach at the largest number: medians over seeds.

        `factor` is how many times fewer that are than random plans need: these are as many as there are, unless fewer
        reach the same already. Intervals are those of the sign test, 95 % at least, which hold for any distribution and
        for seeds in which a prior does not get there; missing for fewer than 6 seeds. A missing number of plans, with
        `reached` in less than all seeds, is more than `most`.
        """
        names = [f"{name}{end}" for name in ("needed", "factor") for end in ("", "_low", "_high")]
        rows = []
        for world, tables in self._by_prior.items():
            random = tables.get(UNIFORM, pd.DataFrame())
            for key, scores in tables.items():
                seeds, budgets = scores.index.intersection(random.index), [int(number) for number in scores.columns]
                if seeds.empty:
                    continue
                climbs = [optimize.isotonic_regression(random.loc[seed]).x for seed in seeds]
                plans, others = (
                    np.log2([needed(curve, budgets, climb[-1]) for curve, climb in zip(curves, climbs, strict=True)])
                    for curves in (scores.loc[seeds].to_numpy(), climbs)
                )
                row = (world, "sampling", *key, *_median(plans), *_median(others - plans))
                rows.append((*row, int(np.isfinite(plans).sum()), len(seeds), budgets[-1]))
        columns = ["world", "planner", *PRIOR, *names, "reached", "seeds", "most"]
        return pd.DataFrame(rows, columns=columns)

    @cached_property
    def bits(self) -> pd.DataFrame:
        """Held-out bits per action of each prior, and how many `more` than the best Markov chain takes.

        The best chain of equal context, before the horizon curriculum: see `best_difference` for `more`, its interval
        and its p-value, which is not corrected for the number of priors.
        """
        frame, by = frame_of(self.runs).astype({"bits": "float64"}), ["world", *PRIOR]
        frame = frame[frame["bits"].notna()]
        means = seed_means(frame, by, "bits").rename(columns={"bits": "bits_per_action"})
        bits = {place: rows.set_index("seed")["bits"] for place, rows in grouped(frame, by)}
        more = []
        for place, mine in bits.items():
            like = (place[0], place[2], 0)
            chains = [bits[one] for one in bits if (one[0], *one[2:]) == like and kind_of(one[1]) == "markov"]
            values = -pd.concat([mine, *chains], axis=1, join="inner").to_numpy().T  # the fewer bits, the better
            gap = best_difference(values[:1], values[1:]) if chains and values.shape[1] > 1 else [np.nan] * 4
            more.append((-gap[0], -gap[2], -gap[1], gap[3]))
        return means.join(pd.DataFrame(more, columns=["more", "more_low", "more_high", "p_value"]))

    @cached_property
    def curriculum(self) -> pd.DataFrame:
        """The normalised score after each round of the horizon curriculum: a row a world, prior, round and length."""
        names = ["world", "prior", "context", "round", "length", "num_plans"]
        entries = frame_of(self.runs, "curriculum").reindex(columns=[*names, "share"])
        return seed_means(entries, names, "share").rename(columns={"share": "oracle_share"})

    @cached_property
    def reasons(self) -> pd.DataFrame:
        """What may explain why the best neural prior is not better, wherever it is not.

        A row a world, context and number of rounds: the best chain's normalised score (`markov_share`), the fewest
        bits per action of a network and of a chain before the curriculum, when they learned from plans like the
        held-out ones (`neural_bits`, `markov_bits`), and by how much networks are significantly ahead with the fewest
        plans (`early`).
        """
        at = ["world", "context", "rounds"]
        best = self.words[(self.words["what"] == BEST) & (self.words["better"] != self.words["first"])]
        reasons = best[[*at, "second_share"]].rename(columns={"second_share": "markov_share"})
        for kind in ("neural", "markov"):
            kind_bits = self.bits[(self.bits["rounds"] == 0) & (self.bits["prior"].map(kind_of) == kind)]
            fewest = kind_bits.groupby(["world", "context"])["bits_per_action"].min().rename(f"{kind}_bits")
            reasons = reasons.merge(fewest.reset_index(), "left", on=["world", "context"])
        early = self.paired[(self.paired["what"] == BEST) & (self.paired["num_plans"] == self.num_plans[0])]
        early = early[(early["difference"] > 0) & (early["p_holm"] < 0.05) & (self.num_plans[0] < self.shown)]
        early = early.astype({"rounds": "int64"}).rename(columns={"difference": "early"})
        return reasons.merge(early[[*at, "early"]], "left", on=at)

    @cached_property
    def across(self) -> pd.DataFrame:
        """Pairs of priors over all worlds that have both, at `shown` plans; see `across_worlds`.

        Each learned prior with random plans, and each that is no chain with each chain of equal context and curriculum.
        Worlds have different numbers of rounds: `rounds` is 1 after the curriculum.
        """
        rows = self.scores[(self.scores["num_plans"] == self.shown) & self.scores["prior"].notna()]
        rows = rows.assign(rounds=(rows["rounds"] > 0).astype("int64"), kind=rows["prior"].map(kind_of))
        rows = rows[["world", "seed", *PRIOR, "kind", "share"]]
        chains = rows[rows["kind"] == "markov"]
        random = rows[rows["kind"] == "uniform"].drop(columns=["context", "rounds"])
        others = rows[rows["kind"].isin(["neural", "other"])].merge(chains, on=["world", "seed", "context", "rounds"])
        pairs = pd.concat([others, rows[rows["kind"] != "uniform"].merge(random, on=["world", "seed"])])
        names = {"prior_x": "prior", "prior_y": "baseline", "share_x": "first", "share_y": "second"}
        return across_worlds(pairs.rename(columns=names), ["prior", "context", "rounds", "baseline"])

    @cached_property
    def combined(self) -> pd.DataFrame:
        """The combined prior (`first`) against each other one (`second`) over the worlds, see `across_worlds`.

        A row a prior, context (`none`; `most`: the last that each world offers), `rounds` (1 after the curriculum) and
        number of plans.
        """
        scores = self.scores[self.scores["num_plans"].isin(self.num_plans) & self.scores["prior"].notna()]
        scores = scores[scores["prior"] != "uniform"].assign(rounds=(scores["rounds"] > 0).astype("int64"))
        most = scores["context"].map(MORE_CONTEXT)
        last = most == most.groupby(scores["world"]).transform("max")
        plain = scores["context"] == "none"
        parts = [scores[plain], scores[last].assign(context="most")] if (plain != last).any() else [scores[plain]]
        scores = pd.concat(parts)[["world", "seed", *PRIOR, "num_plans", "share"]]
        like = [name for name in scores.columns if name not in ("prior", "share")]
        pairs = scores[scores["prior"] != COMBINED].merge(scores[scores["prior"] == COMBINED], on=like)
        names = {"prior_x": "prior", "share_y": "first", "share_x": "second"}
        return across_worlds(pairs.rename(columns=names), [*PRIOR, "num_plans"])


def grouped(frame: pd.DataFrame, by: Sequence[str]) -> Iterator[tuple[Any, pd.DataFrame]]:
    """The groups of a frame in order of appearance, each with its values of the columns `by`."""
    yield from frame.groupby(list(by), sort=False)


def _pairs(tables: Mapping[Key, pd.DataFrame]) -> Iterator[Pair]:
    """All pairs of priors with something to compare, see `Results.paired`."""
    keys = [key for key in tables if key.kind in LEARNED]
    for like in dict.fromkeys(key[1:] for key in keys):
        neural, markov = ([k for k in keys if (k.kind, k[1:]) == (kind, like)] for kind in ("neural", "markov"))
        if neural and markov:
            yield BEST, neural, markov
        yield from (("neural minus Markov", [one], [other]) for one in neural for other in markov)
        combined = [k for k in keys if k.prior == COMBINED and k[1:] == like]
        for what, others in zip(AGAINST, ([*neural, *markov], markov, neural), strict=True):
            if combined and others:
                yield what, combined, others
    for place, key in enumerate(keys):
        for later, other in enumerate(keys):
            alike = other != key and other[1:] == key[1:]
            if key.kind == "other" and alike and (other.kind != "other" or place < later):
                yield "other minus any", [key], [other]
    for key in keys:
        if key.rounds and (before := key._replace(rounds=0)) in keys:
            yield "after minus before the curriculum", [key], [before]
    for key in keys:
        if key.context != "none" and (without := key._replace(context="none")) in keys:
            yield "with minus without context", [key], [without]


def _headlines(tables: Mapping[Key, pd.DataFrame], like: tuple[str, int]) -> Iterator[Pair]:
    """The pairs that answer the question, the best first, among priors of equal context and curriculum."""
    keys = [key for key in tables if key.kind in LEARNED and key[1:] == like]
    neural, markov = ([key for key in keys if key.kind == kind] for kind in ("neural", "markov"))
    if neural and markov:
        yield BEST, neural, markov
        yield "neural minus Markov", neural[:1], markov[-1:]
    elif len(keys) == 2:
        yield "learned minus other", keys[:1], keys[1:]
    if UNIFORM in tables:
        yield "best learned minus random", keys, [UNIFORM]
        yield "learned minus random", keys[:1], [UNIFORM]


GAP = ["what", "first", "second", "first_share", "second_share", "context", "rounds", "num_plans"]
GAP += ["difference", "low", "high", "p_value", "seeds"]


def difference(tables: Mapping[Key, pd.DataFrame], pair: Pair, num_plans: int) -> dict[str, Any] | None:
    """The columns `GAP` of a pair; None where the best would have to be chosen from a single seed."""
    what, *sides = pair
    values = pd.concat([tables[key][num_plans] for side in sides for key in side], axis=1, join="inner").to_numpy().T
    first, second = np.split(values, [len(sides[0])])
    seeds = np.arange(values.shape[1])
    if len(seeds) < 1 + (max(map(len, sides)) > 1):
        return None
    best = [chosen(scores) for scores in (first, second)]
    names = [
        " / ".join(dict.fromkeys(side[place].prior for place in places))
        for side, places in zip(sides, best, strict=True)
    ]
    means = [float(scores[which, seeds].mean()) for scores, which in zip((first, second), best, strict=True)]
    about = [" - ".join(dict.fromkeys(map(str, ends))) for ends in zip(sides[0][0][1:], sides[1][0][1:], strict=True)]
    gap = best_difference(first, second) if len(seeds) > 1 else (float((first - second).mean()), *[np.nan] * 3)
    return dict(zip(GAP, (what, *names, *means, *about, num_plans, *gap, len(seeds)), strict=True))


def corrected(rows: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Rows with `p_holm`: their p-values corrected for the number of rows that agree in `by`; missing ones stay so."""
    tested = rows[rows["p_value"].notna()].astype({"p_value": "float64"})
    return rows.assign(p_holm=tested.groupby(list(by))["p_value"].transform(holm).astype("float64"))


def best_difference(first: Array, second: Array, level: float = 0.95) -> Difference:
    """The best of K alternatives against the best of M others, values of the same G >= 2 seeds; more is better.

    The difference is between those chosen by `chosen`. Its interval and p-value are those of the difference between
    the truly best ones, whichever they are: the first has the better one where one of them is better than every one of
    the second by one-sided paired t-tests at (1 - level) / 2K (intersection-union: Berger 1982; Bonferroni over the
    K), and the second likewise with M. Differences of tests over the chosen ones alone would be called significant too
    often: the choices depend on each other. With K = M = 1 this is Student's paired test.

    Args:
        first: `[K, G]`.
        second: `[M, G]`.
        level: of confidence.
    """
    seeds = np.arange(first.shape[1])
    # Rounded, so that differences that are all the same have no spread.
    mean = float(np.round(first[chosen(first), seeds] - second[chosen(second), seeds], 9).mean())
    gaps = np.round(first[:, None] - second[None], 9)
    means, errors, numbers = gaps.mean(-1), gaps.std(-1, ddof=1) / np.sqrt(len(seeds)), gaps.shape
    ways = np.array(numbers[:2])
    reach = stats.t.ppf(1 - (1 - level) / 2 / ways, len(seeds) - 1)
    low = (means - reach[0] * errors).min(1).max()
    high = (means + reach[1] * errors).max(0).min()
    above, below = (_one_sided(sign * means, errors, len(seeds)) for sign in (1, -1))
    # An estimate from two choices may, once in hundreds of times, lie beside what holds for the best.
    mean = min(max(mean, float(low)), float(high))
    p_value = 2 * min(ways[0] * above.max(1).min(), ways[1] * below.max(0).min())
    return Difference(mean, float(low), float(high), float(min(p_value, 1)))


def _one_sided(means: Array, errors: Array, number: int) -> Array:
    """P-values of means above 0; of values without any spread, those of a sign test: few may agree by accident."""
    t = np.divide(means, errors, out=np.zeros_like(means), where=errors > 0)
    p_values: Array = np.where(errors > 0, stats.t.sf(t, number - 1), np.where(means > 0, 2.0**-number, 1))
    return p_values


def chosen(values: Array) -> NDArray[np.int64]:
    """Of K alternatives `[K, G]` the best for each seed, by the mean over the half that the seed is not in: `[G]`.

    The halves are the even and the odd seeds. A choice among noisy means favours what it chooses; on the other half its
    worth is estimated without bias (cross-fitting: Chernozhukov et al. 2018, definition 3.1). One alternative needs no
    choice; else G is at least 2.
    """
    seeds = np.arange(values.shape[1])
    if len(values) == 1:
        return np.zeros_like(seeds)
    best = np.array([values[:, seeds % 2 == half].mean(1).argmax() for half in (1, 0)])
    mine: NDArray[np.int64] = best[seeds % 2]
    return mine


def needed(curve: Array, budgets: Sequence[int], target: float) -> float:
    """The number of plans at which a curve `[budgets]` of normalised scores reaches a target; infinite if it does not.

    Interpolated between budgets on a logarithmic axis. More plans are never worse, so that the curve is made to climb
    first (isotonic regression): else noise would cross the target too early.
    """
    climbing = optimize.isotonic_regression(curve).x
    reached = np.flatnonzero(climbing >= target - CLOSE)
    if not len(reached):
        return float("inf")
    place = int(reached[0])
    if place == 0:
        return float(budgets[0])
    low, high = climbing[place - 1], climbing[place]
    way = min(max((target - low) / (high - low), 0.0), 1.0)
    return float(2 ** (np.log2(budgets[place - 1]) * (1 - way) + np.log2(budgets[place]) * way))


def _median(logs: Array) -> tuple[float, ...]:
    """The median of what has these base-2 logarithms, and the order statistics that hold the true one between them."""
    ordered = np.sort(logs)
    out = int(stats.binom.ppf(0.025, len(logs), 0.5)) - 1
    # Of two of which one is infinite, the median is on the safe side.
    two = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    median = sum(two) / 2 if np.isfinite(two).all() else two[int(np.isfinite(two[0]))]
    ends = (ordered[out], ordered[-1 - out]) if out >= 0 else (np.nan, np.nan)
    return tuple(2.0**value if np.isfinite(value) else np.nan for value in (median, *ends))
