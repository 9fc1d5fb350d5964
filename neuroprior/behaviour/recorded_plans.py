"""Plans that are parts of recordings of behaviour: with times, conditions and the names of the recordings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from neuroprior._checks import is_number
from neuroprior.plans.columns import as_single, check_names, count_up_to, listed, padded
from neuroprior.plans.plans import Plans, as_integers, as_numbers, check_numbered, check_shape, check_texts

CONTROLS = frozenset(
    (
        *("control", "controls", "ctrl", "ctl", "vehicle", "veh", "saline", "placebo", "sham", "untreated", "naive"),
        *("baseline", "wt", "wildtype", "wild type", "wild-type", "+/+"),
    )
)
"""Names of the level of a factor that others are compared with, in lower case."""


@dataclass(frozen=True, eq=False, repr=False)
class RecordedPlans(Plans):
    """N sequences of up to L actions that are parts of recordings, such as those between gaps.

    Attributes:
        actions, num_actions, lengths, action_names, context, group, context_names, group_names, end: see `Plans`.
        recording: N names of the recordings that the plans are parts of, or None. Recordings of different groups may
            have the same name.
        began: when each action began, in the time of the recording, floating point `[N, L]`, stored as float64: NaN
            where it is not known; None for plans without times. The unit is the user's, as of durations.
        durations: how long each action took, floating point `[N, L]`, stored as float32: at least 0, NaN where it is
            not known; None for plans without times. An end symbol takes no time.
        cut_off: bool `[N, L]`: the action lasted to the end of what was watched, so that it took `durations` at least;
            None: none did.
        condition: integers `[N]`: what plans are compared by, such as the treatment of the subject; None for none.
        condition_names: names of the conditions, numbered from 0, or None.
        stratum: integers `[N]`: within what conditions are compared, such as the sex of the subject; None for none.
        stratum_names: names of the strata, numbered from 0, or None.
        notes: what the reader of a file has to say of them, a line each.

    Raises:
        ValueError: a shape, dtype or value is wrong; the message says which and where.

    Example:
        >>> plans = RecordedPlans(torch.tensor([[0, 1], [1, 0]]), 2, durations=torch.tensor([[1.5, 0.5], [2.0, 1.0]]))
        >>> plans[1:].durations.tolist()
        [[2.0, 1.0]]
    """

    PER_PLAN: ClassVar[tuple[str, ...]] = (*Plans.PER_PLAN, "recording", "condition", "stratum")
    PER_ACTION: ClassVar[tuple[str, ...]] = (*Plans.PER_ACTION, "began", "durations", "cut_off")

    recording: Sequence[str] | None = None
    began: Tensor | None = None
    durations: Tensor | None = None
    cut_off: Tensor | None = None
    condition: Tensor | None = None
    condition_names: Sequence[str] | None = None
    stratum: Tensor | None = None
    stratum_names: Sequence[str] | None = None
    notes: Sequence[str] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        num = len(self)
        if check_texts("recording", self.recording):
            if len(self.recording or ()) != num:
                raise ValueError(f"`recording` must be {num} names, one a plan, got {len(self.recording or ())}")
            object.__setattr__(self, "recording", tuple(self.recording or ()))
        taken, acted = self.mask(), self.mask(end=False)
        if self.began is not None:
            began = self._times("began", self.began, torch.float64, -torch.inf)
            object.__setattr__(self, "began", began.masked_fill(~acted, torch.nan).masked_fill(~taken, 0))
        if self.durations is not None:
            durations = self._times("durations", self.durations, torch.float32, 0)
            object.__setattr__(self, "durations", durations.masked_fill(~acted, 0))
        if self.cut_off is not None:
            if self.durations is None or self.cut_off.dtype != torch.bool:
                raise ValueError("`cut_off` must be bool, of plans with durations")
            check_shape("cut_off", self.cut_off, tuple(self.actions.shape))
            object.__setattr__(self, "cut_off", self.cut_off & acted)
        for name in ("condition", "stratum"):
            if (numbers := getattr(self, name)) is not None:
                object.__setattr__(self, name, as_integers(name, numbers, num))
            check_numbered(name, getattr(self, name), getattr(self, f"{name}_names"))
        if check_texts("notes", self.notes):
            object.__setattr__(self, "notes", tuple(self.notes))

    def _times(self, name: str, values: Tensor, dtype: torch.dtype, lowest: float) -> Tensor:
        """Numbers `[N, L]`, where there are actions finite and at least `lowest`, or NaN."""
        times = as_numbers(name, values).to(dtype)
        check_shape(name, times, tuple(self.actions.shape))
        wrong = ((times < lowest) | times.isinf()) & self.mask(end=False)
        if wrong.any():
            where = wrong.nonzero()[0].tolist()
            bound = " from 0" if lowest == 0 else ""
            raise ValueError(f"`{name}{where}` must be finite times{bound}, got {float(times[tuple(where)])}")
        return times

    @classmethod
    def of(cls, plans: Plans) -> "RecordedPlans":
        """The same plans as `RecordedPlans`: without times and conditions, if they are not of this class already.

        Example:
            >>> RecordedPlans.of(Plans(torch.tensor([[0, 1]]), 2)).durations is None
            True
        """
        return plans if isinstance(plans, cls) else cls(**vars(plans))


def action_names(plans: Plans) -> list[str]:
    """Names of the actions; their numbers where they have none."""
    return list(plans.action_names or map(str, range(plans.num_actions)))


def group_names(plans: Plans, groups: Tensor) -> list[str]:
    """Names of these groups; their numbers where they have none."""
    return numbered_names(plans.group_names, groups, "group")


def numbered_names(names: Sequence[str] | None, numbers: Tensor, what: str) -> list[str]:
    """Names of these `numbers [n]`; "condition 3" and the like where there are none."""
    return [names[number] if names else f"{what} {number}" for number in numbers.tolist()]


def durations_of(plans: Plans) -> Tensor:
    """The durations `[N, L]` of plans; ValueError where they have none."""
    durations = plans.durations if isinstance(plans, RecordedPlans) else None
    if durations is None:
        raise ValueError(
            "durations: these plans have none; give RecordedPlans(durations=), or a file with start and stop times"
        )
    return durations


def join_fragments(plans: Plans, *values: Tensor) -> tuple[Any, ...]:
    """Return plans whose fragments are joined to one plan a recording, and values of their actions joined alike.

    What changes within a recording is then measured over all of it, not within the stretches between its gaps.

    Args:
        plans: N plans; those without names of recordings stay as they are.
        values: `[N, L]` each, one for each action.

    Returns:
        The plans, and as many values `[recordings, longest]`, zero after the end of a plan.

    Example:
        >>> plans = RecordedPlans(torch.tensor([[0, 1], [1, 0]]), 2, recording=("a", "a"))
        >>> join_fragments(plans)[0].actions.tolist()
        [[0, 1, 1, 0]]
    """
    if not isinstance(plans, RecordedPlans) or plans.recording is None:
        return plans, *values
    group = [0] * len(plans) if plans.group is None else plans.group.tolist()
    codes, recordings = pd.factorize(pd.MultiIndex.from_arrays([list(plans.recording), group]))
    if len(recordings) == len(plans):
        return plans, *values
    row, first = torch.from_numpy(codes.astype(np.int64)), torch.from_numpy(np.unique(codes, return_index=True)[1])
    mask = plans.mask().cpu()
    order = row.argsort(stable=True)
    size = mask.sum(1)[order]
    before = size.cumsum(0) - size
    offset = torch.empty_like(size)
    new = torch.ones_like(row, dtype=torch.bool)
    new[1:] = row[order][1:] != row[order][:-1]
    offset[order] = before - before[new][new.cumsum(0) - 1]
    plan, step = mask.nonzero().unbind(1)
    lengths = torch.zeros(len(recordings), dtype=torch.long).index_add_(0, row, mask.sum(1))
    at = row[plan], offset[plan] + step

    def join(value: Tensor) -> Tensor:
        joined = torch.zeros((len(recordings), int(lengths.max()), *value.shape[2:]), dtype=value.dtype)
        joined[at] = value.cpu()[mask]
        return joined.to(value.device)

    per_action: dict[str, Any] = {
        name: join(value) for name in plans.PER_ACTION if (value := getattr(plans, name)) is not None
    }
    return replace(plans[first], lengths=lengths, **per_action), *map(join, values)


def plans_of_events(
    events: pd.DataFrame,
    fragment: NDArray[np.int64],
    cut_off: NDArray[np.bool_],
    *,
    factors: Sequence[str],
    compare: str | None,
    reference: str | None,
    strata: Sequence[str] | None,
    context: Sequence[str],
    notes: list[str],
    max_gap: float | None,
    num_actions: int | None,
    action_names: Sequence[str] | None,
    unknown: str,
) -> RecordedPlans:
    """Return the plans of the events of recordings; see `Recordings.plans`.

    Args:
        events, fragment, cut_off: of `Recordings`, of one observer.
        factors: columns of what recordings can be compared by.
        compare, reference, strata: as of `Recordings.plans`.
        context: columns of what is observed before each action.
        notes: of the recordings; further ones are added.
        max_gap, num_actions, action_names, unknown: as of `Recordings.plans`.

    Raises:
        ValueError: as of `Recordings.plans`.
    """
    if unknown not in ("error", "gap"):
        raise ValueError(f"`unknown` must be error or gap, got {unknown!r}")
    if max_gap is not None and not (is_number(max_gap) and 0 <= max_gap < np.inf):
        raise ValueError(f"`max_gap` must be at least 0, got {max_gap!r}")
    cut = np.diff(fragment, prepend=-1) != 0
    if max_gap is not None:
        cut |= _pauses(events, cut, max_gap, notes)
    names = check_names(num_actions, action_names)
    behaviour = events["behaviour"].to_numpy(object)
    labels = [str(label) for label in pd.unique(behaviour)]
    if all(label.isdecimal() for label in labels) and not (names is not None and set(labels) <= set(names)):
        actions = pd.to_numeric(events["behaviour"]).to_numpy(np.int64)
        count = num_actions or (count_up_to(int(actions.max())) if names is None else len(names))
        if names is not None:
            order = listed([f"{number} = {name}" for number, name in enumerate(names)])
            notes.append(f"the behaviours are numbers, and are taken for those of the names: {order}")
        elif missing := sorted(set(range(min(count, 10_000))) - set(actions.tolist())):
            verb = "occurs" if len(missing) == 1 else "occur"
            notes.append(f"behaviours are numbers from 0 to {count - 1}, of which {listed(missing)} never {verb}")
        outside, expected = actions >= count, f"0 to {count - 1}"
    else:
        names = tuple(sorted(labels)) if names is None else names
        count, expected = len(names), ", ".join(names)
        actions = pd.Index(list(names)).get_indexer(pd.Index(behaviour)).astype(np.int64)
        outside = actions < 0
    if outside.any() and unknown == "error":
        row, number = events.iloc[int(outside.argmax())], int(outside.sum())
        raise ValueError(
            f"recording {row['recording']!r}: behaviour {row['behaviour']!r} is none of {expected} ({number:,} events);"
            " --rename it, --drop it, or --unknown gap ends plans there"
        )
    if outside.any():
        notes.append(f"{int(outside.sum()):,} events are of none of the behaviours; plans end there")
        cut[1:] |= outside[:-1]
        whole = np.cumsum(cut | outside)[~outside]
        cut_off = cut_off[~outside]
        events, actions, cut = events[~outside], actions[~outside], np.diff(whole, prepend=-1) != 0
    if not len(actions):
        raise ValueError("`action_names` must hold a behaviour of the recordings, got none")
    starts = np.flatnonzero(cut)
    lengths = np.diff(np.append(starts, len(actions)))
    first = events.iloc[starts]

    def pad(values: Any) -> Tensor:
        return torch.from_numpy(padded(np.array(values), lengths, "recordings"))

    group, subjects = pd.factorize(first["subject"], sort=True)
    is_independent = len(subjects) == len(first) and bool((events["subject"] == events["recording"]).all())
    began = events["start"].to_numpy(np.float64)
    durations = (events["stop"] - events["start"]).to_numpy(np.float32)
    if reference is not None and not factors:
        raise ValueError(f"`reference` must be a level of a factor, got {reference!r}; name its column")
    fields: dict[str, Any] = _context_fields(context, events, pad, notes)
    if factors:
        unit = np.arange(len(first)) if is_independent else group
        fields |= _design_fields(first, unit, factors, compare, reference, strata, notes)
    return RecordedPlans(
        pad(actions),
        count,
        None if (lengths == lengths.max()).all() else torch.from_numpy(lengths),
        names,
        # Without subjects and gaps, each recording is one plan, and independent of the others.
        group=None if is_independent else torch.from_numpy(group.astype(np.int64)),
        group_names=None if is_independent else tuple(map(str, subjects)),
        recording=tuple(first["recording"]),
        began=None if np.isnan(began).all() else pad(began),
        durations=None if np.isnan(durations).all() else pad(durations),
        cut_off=pad(cut_off) if cut_off.any() else None,
        notes=tuple(notes),
        **fields,
    )


def _design_fields(
    first: pd.DataFrame,
    unit: NDArray[np.int64],
    factors: Sequence[str],
    compare: str | None,
    reference: str | None,
    strata: Sequence[str] | None,
    notes: list[str],
) -> dict[str, Any]:
    """Return the fields `condition` and `stratum` of plans, with their names.

    Args:
        first: the first event of each plan.
        unit: int `[plans]`: the subject of each.
        factors, compare, reference, strata, notes: as of `plans_of_events`.
    """
    several = [name for name in factors if first[name].nunique() > 1]
    factor = compare or (several or list(factors))[0]
    levels = sorted(pd.unique(first[factor]), key=str)
    if "" in levels:
        subject = first["subject"][first[factor] == ""].iloc[0]
        raise ValueError(
            f"{factor!r}, which is compared, must be known for each recording, got an empty cell of {subject}; fill it,"
            " or name another factor with `compare`."
        )
    if reference is not None and reference not in levels:
        raise ValueError(f"`reference` must be one of {', '.join(levels)}, got {reference!r}")
    controls = [level for level in levels if str(level).casefold() in CONTROLS]
    if reference is None and len(controls) == 1:
        reference = controls[0]
    levels.sort(key=lambda level: level != reference)
    codes = pd.Index(levels).get_indexer(pd.Index(first[factor])).astype(np.int64)
    fields: dict[str, Any] = {"condition": torch.from_numpy(codes), "condition_names": tuple(map(str, levels))}
    if factor in (strata or ()):
        raise ValueError(f"`strata` must be other factors than the one that is compared, got {factor!r}")
    paired = bool((pd.Series(codes).groupby(unit).nunique() > 1).any())
    chosen: list[str] = []
    for name in [name for name in several if name != factor] if strata is None else strata:
        problem = ""
        if (first[name].groupby(unit).nunique() > 1).any():
            problem = "varies within a subject"
        elif (first[name] == "").any():
            problem = "is not known for each recording"
        elif not paired and strata is None:
            text = first[[*chosen, name]].agg(", ".join, axis=1).to_numpy()
            if (pd.Series(codes).groupby(text).nunique() < 2).any():
                problem = f"has a level with one level of {factor!r} alone"
        if problem and strata is not None:
            raise ValueError(f"`strata` must be known and constant for each subject, got {name!r}, which {problem}")
        notes += [f"{name!r} {problem}: {factor!r} is not compared within its levels"] if problem else []
        chosen += [] if problem else [name]
    if len(several) > 1 and compare is None:
        within = f" within the levels of {listed(chosen)}" if chosen else ""
        notes.append(f"of the factors {listed(several)}, {factor!r} is compared{within}; --compare chooses another")
    if chosen:
        number, names = pd.factorize(first[chosen].agg(", ".join, axis=1), sort=True)
        fields |= {"stratum": torch.from_numpy(number.astype(np.int64)), "stratum_names": tuple(map(str, names))}
    return fields


def _pauses(events: pd.DataFrame, cut: NDArray[np.bool_], max_gap: float, notes: list[str]) -> NDArray[np.bool_]:
    """Return which events, bool `[events]`, begin more than `max_gap` after all events before them ended."""
    start = events["start"].to_numpy(np.float64)
    if np.isnan(start).all():
        raise ValueError(f"`max_gap` must be None where no times are known, got {max_gap}")
    ends = events["stop"].fillna(events["start"])
    if unknown := int(events["stop"].isna().sum()):
        notes.append(f"{unknown:,} events have no stop; for max_gap they end when they begin")
    latest = ends.groupby(np.cumsum(cut)).cummax().to_numpy(np.float64)
    pause = np.zeros(len(start), bool)
    error = 4 * np.spacing(np.maximum(np.abs(start[1:]), np.abs(latest[:-1])))
    pause[1:] = start[1:] - latest[:-1] > max_gap + error
    return pause


def _context_fields(
    columns: Sequence[str], events: pd.DataFrame, pad: Callable[[Any], Tensor], notes: list[str]
) -> dict[str, Any]:
    """Return the fields `context` and `context_names` of plans: labels of one column, or features.

    One column of numbers is a feature where some are negative or not whole, or most are different.
    """
    if not columns:
        return {}
    numbers = [
        pd.to_numeric(events[name].str.replace(",", "."), errors="coerce").to_numpy(np.float64) for name in columns
    ]
    texts = events[columns[0]]
    if len(columns) == 1 and not np.isfinite(numbers[0]).all():
        if (empty := texts.eq("")).any():
            raise ValueError(f"`columns.context` must be known for each event, got {int(empty.sum()):,} empty cells")
        codes, labels = pd.factorize(texts, sort=True)
        return {"context": pad(codes.astype(np.int64)), "context_names": tuple(map(str, labels))}
    values = numbers[0]
    is_measured = (values < 0).any() or (values % 1 != 0).any() or len(np.unique(values)) > max(20, 0.5 * len(values))
    if len(columns) == 1 and not is_measured:
        return {"context": pad(values.astype(np.int64))}
    for name, column in zip(columns, numbers, strict=True):
        if not np.isfinite(column).all():
            row = events.iloc[int((~np.isfinite(column)).argmax())]
            raise ValueError(f"`columns.context` must be numbers in {name!r}, got {row[name]!r}")
    if len(columns) == 1:
        notes.append(f"the context {columns[0]!r} is read as a measurement, not as a label")
    features = np.stack(numbers, 1)
    return {"context": pad(as_single("context", features))}
