"""Recordings: events in real time, and the plans that priors learn from."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

if TYPE_CHECKING:  # torch is imported only where plans are wanted
    from neuroprior.behaviour.recorded_plans import RecordedPlans

KEYS = ["recording", "subject"]
"""What tells timelines apart: the session and who was watched in it."""

MIN_NAME, MAX_NAMES = 4, 300
"""Letters of the shortest names that are compared for slips of the pen, and the most names."""


@dataclass(frozen=True)
class Source:
    """Where recordings were read from.

    Attributes:
        name: of the file.
        program: that wrote it, "" where it is not known.
        layout: of its rows.
        columns: names of columns by use.
        found: uses that no user named.
    """

    name: str
    program: str
    layout: str
    columns: Mapping[str, tuple[str, ...]]
    found: frozenset[str]


@dataclass(frozen=True, eq=False)
class Recordings:
    """Events in real time.

    Attributes:
        events: a pandas frame with the columns `recording, subject, behaviour` (texts), `start, stop` (float64, NaN
            where unknown), `observer` where more than one scored, and one for each factor and context (texts); the
            events of a recording and subject stand together, in the order of time.
        fragment: int `[events]`, from 0: between two fragments nobody watched, or nothing is known.
        unit: of the times: "s", "ms", "frames", "steps", or "" where it is not known.
        notes: what was noticed, a line each, the weighty ones first.
        factors, context: names of their columns.
        sources: what was read.
        empty: recordings without any event.
        spans: when each recording was watched, where files say it (see `watched`); None: from the events.

    Example:
        >>> import pandas as pd
        >>> table = {"animal": ["m1"] * 3, "behaviour": ["rest", "walk", "rest"], "start": [0, 5, 7], "stop": [5, 7, 9]}
        >>> recordings = read(pd.DataFrame(table))
        >>> recordings.time_budget().loc["m1", "walk"].round(2)
        np.float64(0.22)
    """

    events: pd.DataFrame
    fragment: NDArray[np.int64]
    unit: str = ""
    notes: Sequence[str] = ()
    factors: Sequence[str] = ()
    context: Sequence[str] = ()
    sources: Sequence[Source] = ()
    empty: Sequence[str] = ()
    spans: pd.DataFrame | None = None

    def __repr__(self) -> str:
        """The numbers of what there is."""
        return (
            f"Recordings({len(self.events):,} events, {self.num_recordings:,} recordings,"
            f" {self.events['subject'].nunique():,}"
            f" subjects, {self.events['behaviour'].nunique():,} behaviours)"
        )

    @property
    def num_recordings(self) -> int:
        """The number of recordings: session 1 of two subjects is two."""
        return len(self.events[KEYS].drop_duplicates()) + len(self.empty)

    @property
    def watched(self) -> pd.DataFrame:
        """When each recording was watched: a frame with the columns `recording, subject, start, stop`, a row a
        fragment.

        A fragment is from the first frame to the last where rows are frames; else from the start of its first event to
        the last stop in it (or the last start, where no stop is known).
        """
        if self.spans is not None:
            return self.spans
        ends = self.events["stop"].fillna(self.events["start"])
        frame = self.events[KEYS].assign(fragment=self.fragment, start=self.events["start"], stop=ends)
        whole = frame.groupby("fragment", sort=False).agg(
            recording=("recording", "first"), subject=("subject", "first"), start=("start", "min"), stop=("stop", "max")
        )
        return whole.reset_index(drop=True)

    def _with(self, events: pd.DataFrame, fragment: NDArray[Any], *notes: str) -> "Recordings":
        numbers = np.unique(fragment, return_inverse=True)[1].astype(np.int64)
        return replace(self, events=events.reset_index(drop=True), fragment=numbers, notes=(*self.notes, *notes))

    def drop(self, behaviours: Sequence[str]) -> "Recordings":
        """Return the recordings without some behaviours; the time in which they were done stays watched.

        Raises:
            ValueError: a behaviour that does not occur.
        """
        wanted = [behaviours] if isinstance(behaviours, str) else list(behaviours)
        known = set(self.events["behaviour"])
        if wrong := [name for name in wanted if name not in known]:
            raise ValueError(f"`drop` must be behaviours that occur ({_listed(sorted(known))}), got {wrong[0]!r}")
        left = self.events["behaviour"].isin(wanted).to_numpy()
        if left.all():
            raise ValueError("`drop` must leave a behaviour, got all")
        note = f"{left.sum():,} events of {_listed(wanted)} are left out"
        return replace(self._with(self.events[~left], self.fragment[~left], note), spans=self.watched)

    def window(self, start: float | None = None, stop: float | None = None) -> "Recordings":
        """Return what lies between two times of each recording; events that reach over an end are cut there.

        Args:
            start, stop: in the unit of the recordings; None: without this end.

        Raises:
            ValueError: nothing lies between them.
        """
        low, high = -np.inf if start is None else start, np.inf if stop is None else stop
        begin, end = self.events["start"], self.events["stop"].fillna(self.events["start"])
        inside = ((begin < high) & ((end > low) | ((end == begin) & (begin >= low)))).to_numpy()
        if not inside.any():
            raise ValueError(f"`from_` and `to` must enclose events, got {start} and {stop}")
        events = self.events[inside]
        events = events.assign(start=events["start"].clip(low, high), stop=events["stop"].clip(low, high))
        watched = self.watched
        watched = watched[(watched["start"] < high) & (watched["stop"] > low)].reset_index(drop=True)
        spans = watched.assign(start=watched["start"].clip(low, high), stop=watched["stop"].clip(low, high))
        note = f"{(~inside).sum():,} events outside of the window are left out"
        return replace(self._with(events, self.fragment[inside], note), spans=spans)

    def merge_repeats(self) -> "Recordings":
        """Return the recordings with successive bouts of one behaviour, within a fragment, made one."""
        behaviour = pd.factorize(self.events["behaviour"])[0]
        new = (np.diff(behaviour, prepend=-1) != 0) | (np.diff(self.fragment, prepend=-1) != 0)
        run = np.cumsum(new)
        last = self.events["stop"].groupby(run).max().to_numpy()
        events = self.events[new].assign(stop=last)
        unknown = self.events["stop"].isna().groupby(run).last().to_numpy()
        events["stop"] = np.where(unknown, np.nan, events["stop"])
        return self._with(
            events, self.fragment[new], f"{(~new).sum():,} events repeat the one before, and are one with it"
        )

    def until_next(self) -> "Recordings":
        """Return the recordings with each stop that is not known at the start of the next event of the fragment."""
        start = self.events["start"].to_numpy()
        following = np.append(start[1:], np.nan)
        following[np.append(np.diff(self.fragment) != 0, True)] = np.nan
        stop = self.events["stop"].fillna(pd.Series(following, index=self.events.index))
        return self._with(self.events.assign(stop=stop), self.fragment)

    def behaviours(self) -> pd.DataFrame:
        """Return a row a behaviour: how many events, in how many subjects, for how long, and what is odd about it."""
        events = self.events.assign(seconds=self.events["stop"] - self.events["start"])
        table = events.groupby("behaviour").agg(
            events=("behaviour", "size"), subjects=("subject", "nunique"), duration=("seconds", "sum")
        )
        table = table.sort_values("events", ascending=False, kind="stable")
        many, total = self.events["subject"].nunique(), len(self.events)
        close = near_names(list(table.index))
        odd = []
        for name, row in table.iterrows():
            marks = [f"like {', '.join(map(repr, close[str(name)]))}"] if str(name) in close else []
            marks += ["rare"] if row["events"] < max(2, 0.001 * total) else []
            marks += ["one subject only"] if many > 2 and row["subjects"] == 1 else []
            odd.append(", ".join(marks))
        return table.assign(note=odd).reset_index()

    def by_level(self, factor: str | None) -> Iterator[tuple[str, "Recordings"]]:
        """Return the recordings of each level of a factor, with its name; without a factor all, named ""."""
        if factor is None:
            yield "", self
            return
        for level in sorted(pd.unique(self.events[factor])):
            inside = (self.events[factor] == level).to_numpy()
            pairs = self.events[inside][KEYS].drop_duplicates()
            part = self._with(self.events[inside], self.fragment[inside])
            yield str(level), replace(part, spans=self.watched.merge(pairs, on=KEYS))

    def time_budget(self) -> pd.DataFrame:
        """Return the share of the watched time that each behaviour takes: rows are subjects, columns behaviours."""
        watched = self.watched
        time = (watched["stop"] - watched["start"]).groupby(watched["subject"]).sum()
        seconds = self.events.assign(seconds=self.events["stop"] - self.events["start"])
        table = seconds.pivot_table(
            index="subject", columns="behaviour", values="seconds", aggfunc="sum", fill_value=0.0
        )
        return table.div(time.where(time > 0), axis=0)

    def agreement(self) -> pd.DataFrame:
        """Return how well observers agree: Cohen's kappa over time of each behaviour, for each two observers.

        Each moment that both watched is a case; a behaviour is done in it or not.

        Returns:
            A frame with the columns `first, second, behaviour, kappa, agreement, time`: the share of the time in
            which both say the same, and the time that both watched.

        Raises:
            ValueError: fewer than two observers, or unknown stops.
        """
        if "observer" not in self.events:
            raise ValueError("`columns.observer` must be given for agreement, got recordings of one observer")
        rows = []
        for _, one in self.events.groupby(KEYS, sort=False):
            names = list(pd.unique(one["observer"]))
            for i, first in enumerate(names):
                for second in names[i + 1 :]:
                    pair = one[one["observer"].isin([first, second])].dropna(subset=["start", "stop"])
                    if pair["observer"].nunique() == 2:
                        rows += _both_done(pair, first, second)
        if not rows:
            raise ValueError(
                "`columns.observer` must name observers who scored the same recordings, got none in common"
            )
        times = pd.DataFrame(rows, columns=["first", "second", "behaviour", "both", "one", "other", "time"])
        total = times.groupby(["first", "second", "behaviour"], sort=False)[["both", "one", "other", "time"]].sum()
        same = (total["both"] + total["time"] - total["one"] - total["other"] + total["both"]) / total["time"]
        share_one, share_other = total["one"] / total["time"], total["other"] / total["time"]
        chance = share_one * share_other + (1 - share_one) * (1 - share_other)
        kappa = (same - chance) / (1 - chance).where(chance < 1)
        return total.assign(kappa=kappa, agreement=same)[["kappa", "agreement", "time"]].reset_index()

    def of_one_observer(self) -> "Recordings":
        """Return the recordings with one observer for each recording and subject: who scored most events of"
        " the study."""
        if "observer" not in self.events:
            return self
        rank = self.events["observer"].value_counts()
        score = self.events["observer"].map(rank)
        best = score.groupby([self.events[key] for key in KEYS]).transform("max")
        first = (
            self.events["observer"].where(score == best).groupby([self.events[key] for key in KEYS]).transform("min")
        )
        kept = (self.events["observer"] == first).to_numpy()
        if kept.all():
            return self
        note = f"{(~kept).sum():,} events of second observers are not among the plans"
        return self._with(self.events[kept], self.fragment[kept], note)

    def plans(
        self,
        *,
        max_gap: float | None = None,
        condition: str | None = None,
        reference: str | None = None,
        num_actions: int | None = None,
        action_names: Sequence[str] | None = None,
        unknown: str = "error",
    ) -> "RecordedPlans":
        """Return the plans that priors learn from: one a fragment, with the subject as group.

        Args:
            max_gap: a longer pause ends a plan, too; in the unit of the recordings.
            condition: the factor that is compared; None: the only one, if there is one.
            reference: its level that others are compared with, such as "saline"; None: the first by name.
            num_actions: A, where behaviours are numbers; None: the largest + 1.
            action_names: A names in the order of their numbers; None: the behaviours that occur, sorted.
            unknown: what behaviours do that are none of `action_names`: "error", or "gap": a plan ends there.

        Raises:
            ValueError: an argument is out of range, or a behaviour that is none of the names.
        """
        from neuroprior.behaviour.recorded_plans import plans_of_events

        if condition is not None and condition not in self.factors:
            some = ", ".join(self.factors) or "none; name its column (--columns.factors)"
            raise ValueError(f"`condition` must be a factor of the recordings, {some}, got {condition!r}")
        kept = self.of_one_observer()
        return plans_of_events(
            kept.events,
            kept.fragment,
            factor=condition or (self.factors[0] if len(self.factors) == 1 else None),
            reference=reference,
            context=kept.context,
            notes=list(kept.notes),
            max_gap=max_gap,
            num_actions=num_actions,
            action_names=action_names,
            unknown=unknown,
        )


def _both_done(pair: pd.DataFrame, first: str, second: str) -> list[tuple[str, str, str, float, float, float, float]]:
    """Return for each behaviour how long both observers, the one and the other say that it is done."""
    mine, yours = (pair[pair["observer"] == name] for name in (first, second))
    low = max(mine["start"].min(), yours["start"].min())
    high = min(mine["stop"].max(), yours["stop"].max())
    if not high > low:
        return []
    edges = np.unique(np.clip(np.concatenate([pair["start"], pair["stop"], [low, high]]), low, high))
    middle, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    rows: list[tuple[str, str, str, float, float, float, float]] = []
    for behaviour in pd.unique(pair["behaviour"]):
        done = [_is_done(one[one["behaviour"] == behaviour], middle) for one in (mine, yours)]
        both, one, other = (float(width[some].sum()) for some in (done[0] & done[1], done[0], done[1]))
        rows.append((first, second, str(behaviour), both, one, other, float(high - low)))
    return rows


def _is_done(bouts: pd.DataFrame, moments: NDArray[np.float64]) -> NDArray[np.bool_]:
    start, stop = np.sort(bouts["start"].to_numpy()), np.sort(bouts["stop"].to_numpy())
    done: NDArray[np.bool_] = np.searchsorted(start, moments, "right") > np.searchsorted(stop, moments, "right")
    return done


def near_names(names: Sequence[str]) -> dict[str, list[str]]:
    """Return names that are nearly equal to others: but for case, spaces and dashes, or one letter of four or more.

    Example:
        >>> near_names(["Grooming", "Groming", "rear", "Rear", "walk"])
        {'Grooming': ['Groming'], 'Groming': ['Grooming'], 'rear': ['Rear'], 'Rear': ['rear']}
    """
    close: dict[str, list[str]] = {}
    if len(names) > MAX_NAMES:
        return close
    short = ["".join(letter for letter in name.casefold() if letter.isalnum()) for name in names]
    for i, one in enumerate(short):
        for j in range(i):
            if (one == short[j] and one) or (
                _one_letter_apart(one, short[j]) and not any(map(str.isdigit, one + short[j]))
            ):
                close.setdefault(names[j], []).append(names[i])
                close.setdefault(names[i], []).append(names[j])
    return {name: close[name] for name in names if name in close}


def _one_letter_apart(one: str, other: str) -> bool:
    """Whether one letter is missing, added, changed or exchanged with its neighbour."""
    if min(len(one), len(other)) < MIN_NAME or abs(len(one) - len(other)) > 1:
        return False
    start = next((i for i, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))
    a, b = one[start:], other[start:]
    return a[1:] == b[1:] or a[1:] == b or a == b[1:] or (a[:2] == b[:2][::-1] and a[2:] == b[2:])


def _listed(names: Sequence[str], shown: int = 8) -> str:
    return ", ".join(names[:shown]) + (f" and {len(names) - shown} more" if len(names) > shown else "")
