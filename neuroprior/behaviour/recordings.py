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
"""Columns that tell timelines apart: the session, and who was watched in it."""

MIN_NAME, MAX_NAMES = 4, 300
"""Fewest letters of names that are compared for slips of the pen, and most names."""


@dataclass(frozen=True)
class Source:
    """A file or sheet that recordings were read from.

    Attributes:
        name: of the file.
        program: that wrote it, "" where it is not known.
        layout: of its rows.
        columns: names of columns by use.
        inferred: uses that no user named.
    """

    name: str
    program: str
    layout: str
    columns: Mapping[str, tuple[str, ...]]
    inferred: frozenset[str]


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
        """Return the numbers of events, recordings, subjects and behaviours."""
        subjects, behaviours = self.events["subject"].nunique(), self.events["behaviour"].nunique()
        return (
            f"Recordings({len(self.events):,} events, {self.num_recordings:,} recordings, {subjects:,} subjects,"
            f" {behaviours:,} behaviours)"
        )

    @property
    def num_recordings(self) -> int:
        """Return how many recordings there are; session 1 of two subjects is two."""
        return len(self.events[KEYS].drop_duplicates()) + len(self.empty)

    @property
    def watched(self) -> pd.DataFrame:
        """Return when each recording was watched, as a frame with `recording, subject, start, stop`, a fragment a row.

        Where rows are frames, a fragment lasts from the first to the last. Else it lasts from the start of its first
        event to its last stop, or to its last start where no stop is known.
        """
        if self.spans is not None:
            return self.spans
        ends = self.events["stop"].fillna(self.events["start"])
        frame = self.events[KEYS].assign(fragment=self.fragment, start=self.events["start"], stop=ends)
        whole = frame.groupby("fragment", sort=False).agg(
            recording=("recording", "first"), subject=("subject", "first"), start=("start", "min"), stop=("stop", "max")
        )
        return whole.reset_index(drop=True)

    @property
    def cut_off(self) -> NDArray[np.bool_]:
        """Return which bouts, bool `[events]`, last to the end of what was watched: they may have gone on."""
        start, stop = self.events["start"], self.events["stop"]
        if self.spans is None:
            end = stop.groupby(self.fragment).transform("max")
        else:
            timed = start.notna()
            spans = self.spans.rename(columns={"stop": "end"}).sort_values("start")
            bouts = self.events.loc[timed, [*KEYS, "start"]].reset_index(names="row").sort_values("start")
            merged = pd.merge_asof(bouts, spans[[*KEYS, "start", "end"]], on="start", by=KEYS)
            end = pd.Series(merged["end"].to_numpy(), index=merged["row"]).reindex(self.events.index)
        return ((stop >= end) & (stop > start)).to_numpy(bool)

    def _replace_events(self, events: pd.DataFrame, fragment: NDArray[Any], *notes: str) -> "Recordings":
        """Return recordings of other events, with their fragments numbered anew and further notes."""
        numbers = np.unique(fragment, return_inverse=True)[1].astype(np.int64)
        return replace(self, events=events.reset_index(drop=True), fragment=numbers, notes=(*self.notes, *notes))

    def drop(self, behaviours: Sequence[str]) -> "Recordings":
        """Return the recordings without some behaviours; the time that these took stays watched.

        Raises:
            ValueError: a behaviour that does not occur.
        """
        names = [behaviours] if isinstance(behaviours, str) else list(behaviours)
        labels = set(self.events["behaviour"])
        if wrong := [name for name in names if name not in labels]:
            raise ValueError(f"`drop` must be behaviours that occur ({_join_names(sorted(labels))}), got {wrong[0]!r}")
        dropped = self.events["behaviour"].isin(names).to_numpy()
        if dropped.all():
            raise ValueError("`drop` must leave a behaviour, got all")
        note = f"{dropped.sum():,} events of {_join_names(names)} are left out"
        return replace(self._replace_events(self.events[~dropped], self.fragment[~dropped], note), spans=self.watched)

    def window(self, start: float | None = None, stop: float | None = None) -> "Recordings":
        """Return what lies between two times of each recording; events that reach over an end are cut there.

        Args:
            start, stop: in the unit of the recordings; None: without this end.

        Raises:
            ValueError: no event lies between them.
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
        return replace(self._replace_events(events, self.fragment[inside], note), spans=spans)

    def merge_repeats(self) -> "Recordings":
        """Return the recordings with successive bouts of one behaviour made one, within each fragment."""
        behaviour = pd.factorize(self.events["behaviour"])[0]
        new = (np.diff(behaviour, prepend=-1) != 0) | (np.diff(self.fragment, prepend=-1) != 0)
        run = np.cumsum(new)
        last = self.events["stop"].groupby(run).max().to_numpy()
        events = self.events[new].assign(stop=last)
        unknown = self.events["stop"].isna().groupby(run).last().to_numpy()
        events["stop"] = np.where(unknown, np.nan, events["stop"])
        return self._replace_events(
            events, self.fragment[new], f"{(~new).sum():,} events repeat the one before, and are one with it"
        )

    def until_next(self) -> "Recordings":
        """Return the recordings with each unknown stop at the start of the next event of its fragment."""
        start = self.events["start"].to_numpy()
        following = np.append(start[1:], np.nan)
        following[np.append(np.diff(self.fragment) != 0, True)] = np.nan
        stop = self.events["stop"].fillna(pd.Series(following, index=self.events.index))
        return self._replace_events(self.events.assign(stop=stop), self.fragment)

    def summary(self) -> str:
        """Return what `neuroprior check` shows: columns, counts, notes, behaviours, factors and the first events."""
        from neuroprior.behaviour.summary import render_summary

        return render_summary(self)

    def behaviours(self) -> pd.DataFrame:
        """Return a frame with a row a behaviour: its events, subjects, whole duration, and what is odd about it."""
        events = self.events.assign(duration=self.events["stop"] - self.events["start"])
        table = events.groupby("behaviour").agg(
            events=("behaviour", "size"), subjects=("subject", "nunique"), duration=("duration", "sum")
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
        watched, levels = self.watched, self.watched_levels(factor)
        for level in sorted(pd.unique(self.events[factor])):
            inside = (self.events[factor] == level).to_numpy()
            level_recordings = self._replace_events(self.events[inside], self.fragment[inside])
            yield str(level), replace(level_recordings, spans=watched[levels == level].reset_index(drop=True))

    def watched_levels(self, factor: str) -> NDArray[Any]:
        """Return the level of a factor in each row of `watched`, `[rows]`: that of the recording's events.

        Where a recording has no events, it is the subject's only level; NaN where this has several or none.
        """
        levels = self.events.groupby(KEYS)[factor].first().rename("level")
        of_subject = self.events.groupby("subject")[factor].agg(["first", "nunique"])
        only = of_subject["first"].where(of_subject["nunique"] == 1)
        spans = self.watched.join(levels, on=KEYS)
        return spans["level"].fillna(spans["subject"].map(only)).to_numpy(object)

    def time_budget(self) -> pd.DataFrame:
        """Return the share of the watched time that each behaviour takes: rows are subjects, columns behaviours.

        A subject that was watched and did nothing has shares of 0.
        """
        watched = self.watched
        time = (watched["stop"] - watched["start"]).groupby(watched["subject"]).sum()
        events = self.events.assign(duration=self.events["stop"] - self.events["start"])
        table = events.pivot_table(
            index="subject", columns="behaviour", values="duration", aggfunc="sum", fill_value=0.0
        )
        return table.reindex(table.index.union(time.index), fill_value=0.0).div(time.where(time > 0), axis=0)

    def agreement(self) -> pd.DataFrame:
        """Return how well observers agree: Cohen's kappa over time, for each behaviour and two observers.

        Each moment that both watched is a case; a behaviour is done in it or not.

        Returns:
            A frame with the columns `first, second, behaviour, kappa, agreement, time`. Agreement is the share of the
            time in which both say the same; time is what both watched.

        Raises:
            ValueError: fewer than two observers, or unknown stops.
        """
        if "observer" not in self.events:
            raise ValueError("`columns.observer` must be given for agreement, got recordings of one observer")
        rows, behaviours = [], sorted(pd.unique(self.events["behaviour"]))
        for _, one in self.events.groupby(KEYS, sort=False):
            names = sorted(pd.unique(one["observer"]))
            for i, first in enumerate(names):
                for second in names[i + 1 :]:
                    pair = one[one["observer"].isin([first, second])].dropna(subset=["start", "stop"])
                    if pair["observer"].nunique() == 2:
                        rows += _both_done(pair, first, second, behaviours)
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
        """Return the recordings with one observer for each timeline: the one with most events in the study."""
        if "observer" not in self.events:
            return self
        observer, keys = self.events["observer"], [self.events[key] for key in KEYS]
        num_events = observer.map(observer.value_counts())
        most = num_events.groupby(keys).transform("max")
        first = observer.where(num_events == most).groupby(keys).transform("min")
        kept = (observer == first).to_numpy()
        if kept.all():
            return self
        note = f"{(~kept).sum():,} events of second observers are not among the plans"
        return self._replace_events(self.events[kept], self.fragment[kept], note)

    def plans(
        self,
        *,
        max_gap: float | None = None,
        compare: str | None = None,
        reference: str | None = None,
        strata: Sequence[str] | None = None,
        num_actions: int | None = None,
        action_names: Sequence[str] | None = None,
        unknown: str = "error",
    ) -> "RecordedPlans":
        """Return the plans that priors learn from: one a fragment, with the subject as group.

        Args:
            max_gap: a longer pause ends a plan as well; in the unit of the recordings.
            compare: the factor that is compared; None: the first that has two levels.
            reference: its level that others are compared with; None: the only one with a control's name, such as
                "saline" or "wild type", else the first by name.
            strata: factors, such as sex, within whose levels it is compared; None: the others, but for those that vary
                within a subject, and those with a level in which nothing can be compared.
            num_actions: A, where behaviours are numbers; None: the largest + 1.
            action_names: A names in the order of their numbers; None: the behaviours that occur, sorted.
            unknown: what a behaviour is that is none of `action_names`: an "error", or a "gap" where a plan ends.

        Raises:
            ValueError: an argument is out of range, or a behaviour is none of the names.
        """
        from neuroprior.behaviour.recorded_plans import plans_of_events

        strata = [strata] if isinstance(strata, str) else strata
        for name, factor in [("compare", compare)] * (compare is not None) + [("strata", one) for one in strata or ()]:
            if factor not in self.factors:
                factors = ", ".join(self.factors) or "of which there is none; name its column (--columns.factors)"
                raise ValueError(f"`{name}` must be a factor of the recordings, {factors}, got {factor!r}")
        recordings = self.of_one_observer()
        return plans_of_events(
            recordings.events,
            recordings.fragment,
            recordings.cut_off,
            factors=self.factors,
            compare=compare,
            reference=reference,
            strata=strata,
            context=recordings.context,
            notes=list(recordings.notes),
            max_gap=max_gap,
            num_actions=num_actions,
            action_names=action_names,
            unknown=unknown,
        )


def _both_done(
    pair: pd.DataFrame, first: str, second: str, behaviours: Sequence[str]
) -> list[tuple[str, str, str, float, float, float, float]]:
    """Return for each behaviour how long both observers, the first and the second say that it is done."""
    of_first, of_second = (pair[pair["observer"] == name] for name in (first, second))
    low = max(of_first["start"].min(), of_second["start"].min())
    high = min(of_first["stop"].max(), of_second["stop"].max())
    if not high > low:
        return []
    edges = np.unique(np.clip(np.concatenate([pair["start"], pair["stop"], [low, high]]), low, high))
    middle, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    rows: list[tuple[str, str, str, float, float, float, float]] = []
    for behaviour in behaviours:
        done, also = (_is_done(bouts[bouts["behaviour"] == behaviour], middle) for bouts in (of_first, of_second))
        both, one, other = (float(width[moments].sum()) for moments in (done & also, done, also))
        rows.append((first, second, str(behaviour), both, one, other, float(high - low)))
    return rows


def _is_done(bouts: pd.DataFrame, moments: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return at which moments a bout goes on, bool `[moments]`."""
    start, stop = np.sort(bouts["start"].to_numpy()), np.sort(bouts["stop"].to_numpy())
    done: NDArray[np.bool_] = np.searchsorted(start, moments, "right") > np.searchsorted(stop, moments, "right")
    return done


def near_names(names: Sequence[str]) -> dict[str, list[str]]:
    """Return names that nearly equal others: but for case, spaces and dashes, or for one letter of four or more.

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
            other = short[j]
            is_typo = _one_letter_apart(one, other) and not any(map(str.isdigit, one + other))
            if is_typo or (one and one == other):
                close.setdefault(names[j], []).append(names[i])
                close.setdefault(names[i], []).append(names[j])
    return {name: close[name] for name in names if name in close}


def _one_letter_apart(one: str, other: str) -> bool:
    """Return whether one letter is missing, added, changed or exchanged with its neighbour."""
    if min(len(one), len(other)) < MIN_NAME or abs(len(one) - len(other)) > 1:
        return False
    start = next((i for i, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))
    a, b = one[start:], other[start:]
    return a[1:] == b[1:] or a[1:] == b or a == b[1:] or (a[:2] == b[:2][::-1] and a[2:] == b[2:])


def _join_names(names: Sequence[str], shown: int = 8) -> str:
    return ", ".join(names[:shown]) + (f" and {len(names) - shown} more" if len(names) > shown else "")
