"""What a comparison found: scores with intervals, differences from uniform plans with tests, sentences, a figure."""

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import isnan, nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroprior._files import quote_frame, versions, write_json, written_whole
from neuroprior._folders import claim
from neuroprior._statistics import ENOUGH_UNITS, Difference, holm, ratio_difference
from neuroprior.comparison.contestants import BASELINE
from neuroprior.comparison.trial import TOLERANCE, Array, Outcome

SIGNIFICANT = 0.05
"""Corrected p-values below this are significant."""

NEARLY_ALL = 0.95
"""A planner needs no prior where uniform plans reach so much."""


class Row(NamedTuple):
    """A planner with a prior and a budget.

    Attributes:
        planner, prior, budget: which; the budget in candidate plans.
        score, low, high: the normalised score with its 95 % interval: 0 is the mean of random plans, 1 the optimum, or
            the best score that any decision reached from the same start.
        difference, difference_low, difference_high: how much higher it is than with uniform plans; NaN for these.
        p, p_holm: two-sided p-value of no difference, and corrected for all rows that have one.
        mean_score: in the world's own units.
        model_steps: simulator steps of a decision for each start.
    """

    planner: str
    prior: str
    budget: int
    score: float
    low: float
    high: float
    difference: float
    difference_low: float
    difference_high: float
    p: float
    p_holm: float
    mean_score: float
    model_steps: int


@dataclass(frozen=True, repr=False, eq=False)
class Comparison:
    """Priors and planners compared in a world; see `compare`.

    Attributes:
        outcomes: of each seed, in order.
        planners, priors, budgets: what was compared; the first prior is uniform.
        length: actions in a plan.
        notes: what a reader of the scores should know.
    """

    outcomes: tuple[Outcome, ...]
    planners: tuple[str, ...]
    priors: tuple[str, ...]
    budgets: tuple[int, ...]
    length: int
    notes: tuple[str, ...]

    @property
    def scale(self) -> str:
        """Says what a score of 1 stands for, "the optimum" or "the best score found"."""
        return "the best score found" if self.outcomes[0].best is None else "the optimum"

    @property
    def unit(self) -> str:
        """Says what intervals are over, "seeds" or the "starts" of a single seed."""
        return "seeds" if len(self.outcomes) > 1 else "starts"

    @cached_property
    def gains(self) -> tuple[Array, Array]:
        """What scores gain over random plans, and the most that can be gained, of each of G seeds (or starts of one).

        Returns:
            `[planners, priors, budgets, G]` and `[G]`, which is at least 0.
        """
        gains, most = [], []
        for outcome in self.outcomes:
            best = outcome.scores.max((0, 1, 2)) if outcome.best is None else outcome.best
            gains.append(outcome.scores - outcome.random)
            most.append(np.maximum(best - outcome.random, 0.0))
        if self.unit == "starts":
            return gains[0], most[0]
        return np.stack([gain.mean(-1) for gain in gains], -1), np.array([one.mean() for one in most])

    @property
    def num_units(self) -> int:
        """How many seeds, or starts of a single seed, there are."""
        return len(self.gains[1])

    @property
    def has_gain(self) -> bool:
        """Whether some plan scores more than random plans do in the mean."""
        largest = max(float(np.abs(outcome.random).max()) for outcome in self.outcomes)
        return float(self.gains[1].mean()) > TOLERANCE * max(1.0, largest)

    @cached_property
    def rows(self) -> tuple[Row, ...]:
        """A row for each planner, prior and budget, in this order."""
        shape = map(range, self.outcomes[0].model_steps.shape)
        rows = [self._row(*place) for place in product(*shape)]
        tested = [index for index, row in enumerate(rows) if not isnan(row.p)]
        for index, p_holm in zip(tested, holm([rows[index].p for index in tested]).tolist(), strict=True):
            rows[index] = rows[index]._replace(p_holm=p_holm)
        return tuple(rows)

    def _row(self, planner: int, prior: int, budget: int) -> Row:
        """The row of a planner, a prior and a budget by their numbers, with an uncorrected p-value."""
        gains, uniform = self.gains[0][planner, prior, budget], self.gains[0][planner, 0, budget]
        score, difference = self._normalise(gains), self._normalise(gains - uniform)
        means = [outcome.scores[planner, prior, budget].mean() for outcome in self.outcomes]
        steps = max(int(outcome.model_steps[planner, prior, budget]) for outcome in self.outcomes)
        return Row(
            *(self.planners[planner], self.priors[prior], self.budgets[budget]),
            *score[:3],
            *(difference if prior else (nan, nan, nan, nan)),
            *(nan, float(np.mean(means)), steps),
        )

    def _normalise(self, gains: Array) -> Difference:
        """The ratio of gains `[G]` to the most that can be gained, with its interval over seeds (or starts)."""
        most = self.gains[1]
        if not self.has_gain:
            return Difference(nan, nan, nan, nan)
        if self.num_units == 1:
            return Difference(float(gains[0] / most[0]), nan, nan, nan)
        return ratio_difference(gains, most)

    def frame(self) -> Any:
        """Return the rows as a table of pandas, with the columns of `Row`.

        Raises:
            ImportError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise ImportError("a frame needs pandas: pip install 'neuroprior[report]'") from error
        return pd.DataFrame(self.rows, columns=list(Row._fields))

    def figure(self) -> Any:
        """Draw normalised scores against budgets, a panel for each planner; bands are 95 % intervals.

        Returns:
            A figure of matplotlib.

        Raises:
            ImportError: matplotlib is not installed.
        """
        try:
            from matplotlib.figure import Figure
        except ImportError as error:
            raise ImportError("a figure needs matplotlib: pip install 'neuroprior[report]'") from error
        figure = Figure(figsize=(3.2 * len(self.planners) + 1, 3.2), layout="constrained")
        panels = figure.subplots(1, len(self.planners), sharey=True, squeeze=False)[0]
        for planner, panel in zip(self.planners, panels, strict=True):
            for prior in self.priors:
                rows = [row for row in self.rows if (row.planner, row.prior) == (planner, prior)]
                (line,) = panel.plot(self.budgets, [row.score for row in rows], marker="o", markersize=4, label=prior)
                low, high = [row.low for row in rows], [row.high for row in rows]
                panel.fill_between(self.budgets, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
            panel.set_xscale("log", base=2)
            panel.set_xticks(self.budgets, [f"{budget:,}" for budget in self.budgets])
            panel.set_xlabel("budget in plans")
            panel.set_title(planner)
        panels[0].set_ylabel(f"score (1: {self.scale})")
        panels[-1].legend(frameon=False)
        return figure

    def save(self, folder: str | Path) -> None:
        """Write `comparison.csv`, `comparison.png` and `comparison.json`, with the scores from all starts, to a folder.

        Raises:
            ImportError: pandas or matplotlib is not installed.
            OSError: a file cannot be written.
        """
        frame, figure, folder = self.frame(), self.figure(), Path(folder)
        seeds = [
            {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in one._asdict().items()}
            for one in self.outcomes
        ]
        content = {
            "summary": self.summary(),
            "notes": list(self.notes),
            "scale": self.scale,
            "unit": self.unit,
            "planners": list(self.planners),
            "priors": list(self.priors),
            "budgets": list(self.budgets),
            "length": self.length,
            "rows": [row._asdict() for row in self.rows],
            "seeds": seeds,
            "versions": versions(),
        }
        with claim(folder, replaces=True) as place:
            place.add([f"comparison.{ending}" for ending in ("csv", "png", "json")])
            with written_whole(folder / "comparison.csv") as file:
                quote_frame(frame).to_csv(file, index=False)
            with written_whole(folder / "comparison.png", "wb") as file:
                figure.savefig(file, format="png", dpi=150)
            write_json(folder / "comparison.json", content)

    def summary(self) -> str:
        """Say in a sentence for each planner whether a prior helps it.

        A prior is said to help or to harm only where the corrected p-value is below .05. Of several such differences
        the largest is named, which a new comparison would on average find smaller.
        """
        if not self.has_gain:
            return f"Nothing to compare: no plan of {self.length} actions scores more than random ones do in the mean."
        if len(self.priors) == 1:
            return " ".join(self._uniform_sentence(planner) for planner in self.planners)
        return " ".join(self._sentence(planner) for planner in self.planners)

    def _sentence(self, planner: str) -> str:
        rows = [row for row in self.rows if row.planner == planner and row.prior != BASELINE]
        uniform = {row.budget: row for row in self.rows if row.planner == planner and row.prior == BASELINE}
        certain = [row for row in rows if self._is_significant(row)]
        most = max(rows, key=lambda row: row.difference)
        helpful = max((row for row in certain if row.difference > 0), key=lambda row: row.difference, default=None)
        harmful = min((row for row in certain if row.difference < 0), key=lambda row: row.difference, default=None)
        if helpful is not None:
            return (
                f"With a budget of {helpful.budget:,} plans, the {planner} planner reaches {_share(helpful.score)} of"
                f" {self.scale} with the {helpful.prior} prior and {_share(uniform[helpful.budget].score)} with uniform"
                f" plans (difference {_difference(helpful)})."
            )
        if harmful is not None:
            return (
                f"No prior helps the {planner} planner, and {harmful.prior} harms it: with a budget of"
                f" {harmful.budget:,} plans it reaches {_share(harmful.score)} of {self.scale}, and"
                f" {_share(uniform[harmful.budget].score)} with uniform plans (difference {_difference(harmful)})."
            )
        if min(row.score for row in uniform.values()) >= NEARLY_ALL:
            return self._uniform_sentence(planner, "needs no prior here: it")
        return (
            f"No prior clearly helps the {planner} planner: the largest difference is {_difference(most)}"
            f" ({most.prior}, a budget of {most.budget:,} plans)."
        )

    def _uniform_sentence(self, planner: str, verb: str = "") -> str:
        """What a planner reaches with uniform plans and the smallest budget."""
        row = next(row for row in self.rows if (row.planner, row.prior) == (planner, BASELINE))
        return (
            f"The {planner} planner {verb}{' ' * bool(verb)}reaches {_share(row.score)} of {self.scale} with"
            f" {row.budget:,} uniform plans."
        )

    def _is_significant(self, row: Row) -> bool:
        return row.p_holm < SIGNIFICANT and self.num_units >= ENOUGH_UNITS

    def __str__(self) -> str:
        """The summary, a table of scores, what they mean, and the notes."""
        shown = {row[:3]: self._cell(row) for row in self.rows}
        heads = ["planner", "prior", *(f"{budget:,}" for budget in self.budgets)]
        lines = [
            [planner, prior, *(shown[planner, prior, budget] for budget in self.budgets)]
            for planner in self.planners
            for prior in self.priors
        ]
        wide = [max(map(len, column)) for column in zip(heads, *lines, strict=True)]
        table = [
            "  ".join(cell.ljust(width) for cell, width in zip(line, wide, strict=True)).rstrip()
            for line in [heads, *lines]
        ]
        return "\n".join([self.summary(), "", *table, "", self._legend(), *self.notes])

    __repr__ = __str__

    def _cell(self, row: Row) -> str:
        if isnan(row.score):
            return "-"
        half = "" if isnan(row.low) else f" ±{_share(row.high - row.score)}"
        return f"{_share(row.score)}{half}{'*' * self._is_significant(row)}"

    def _legend(self) -> str:
        """What the scores, intervals and stars mean."""
        units, tests = self.num_units, sum(not isnan(row.p) for row in self.rows)
        scale = f"Scores by budget in plans: 1 is {self.scale} from the same start, 0 the mean of random plans"
        if units < 2:
            return f"{scale}; no intervals, which need two {self.unit}."
        one = "; how much a prior varies from one training to another is not in them" if self.unit == "starts" else ""
        star = f" *: differs from uniform, p < .05, Holm's correction for {tests} tests." if tests else ""
        few = f" Fewer than {ENOUGH_UNITS} {self.unit}: no difference is called clear." if units < ENOUGH_UNITS else ""
        return f"{scale}; ±: 95 % intervals over {units} {self.unit}{one}.{few or star}"


def _share(value: float) -> str:
    """A number with two digits behind the point, and no 0 before it."""
    text = f"{value:.2f}"
    if float(text) == 0:
        return "0"
    return text.replace("0.", ".", 1) if abs(float(text)) < 1 else text


def _difference(row: Row) -> str:
    """A difference with its interval, if it has one."""
    if isnan(row.difference_low):
        return _share(row.difference)
    return f"{_share(row.difference)}, {_share(row.difference_low)} to {_share(row.difference_high)}"
