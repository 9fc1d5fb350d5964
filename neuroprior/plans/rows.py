"""Rows of a table of plans, as they are written to CSV and to pandas frames."""

from collections.abc import Iterator, Sequence
from typing import Any

from neuroprior.plans.columns import is_missing, named, number_in
from neuroprior.plans.sequences import constant_context


def check_readable(plans: Any, place: str, kind: str) -> None:
    """Raise ValueError unless rows of these `Plans` would be read as the same plans again.

    Args:
        plans: `Plans`.
        place: with which the message begins.
        kind: what is to hold them, such as "CSV".
    """
    if plans.end is not None:
        raise ValueError(
            f"{place}: {kind} cannot say that an action is the end symbol; write plans.without_end(), or JSONL"
        )
    if not plans.mask().any():
        raise ValueError(f"{place}: {kind} cannot hold plans of which none has an action")
    for what in ("action", "context", "group", "condition", "plan"):
        for name in getattr(plans, f"{what}_names") or ():
            if not name.strip() or name != name.strip() or "\n" in name or "\r" in name:
                raise ValueError(
                    f"{place}: {what}_names: {kind} cannot hold {name!r}; names without line breaks and without space"
                    " at either end are expected"
                )
            if is_missing(name):
                raise ValueError(f"{place}: {what}_names: {kind} cannot hold {name!r}, which would be read as missing")
            if what in ("action", "context") and number_in(name) is not None:
                raise ValueError(f"{place}: {what}_names: {kind} cannot hold {name!r}, which would be read as a number")


def rows_of(plans: Any, by_step: bool) -> Iterator[list[Any]]:
    """The rows of a table, the header first; with one step a row, plans without names are numbered from 0.

    Between two parts of one plan there is a row without an action, a gap.

    Args:
        plans: `Plans` that `check_readable` lets pass.
        by_step: one step a row; else one plan, whose context never changes.
    """
    width = plans.max_length
    plan_names, parted = _plan_column(plans) if by_step else (plans.plan_names, frozenset())
    header = ["plan", "action"] if by_step else [f"action_{i + 1}" for i in range(width)]
    header = ["plan", *header] if not by_step and plan_names is not None else header
    if plans.context is not None:
        features = plans.context.shape[-1] if plans.context.is_floating_point() else 0
        header += [f"context_{i + 1}" for i in range(features)] or ["context"]
    header += [what for what in ("group", "condition") if getattr(plans, what) is not None]
    yield header + ["duration"] * (plans.durations is not None)
    for start in range(0, len(plans), 2**14):
        some = plans[start : start + 2**14]
        none: list[list[Any]] = [[]] * len(some)
        given = some.context if by_step else constant_context(some)
        contexts = none if given is None else named(given.tolist(), plans.context_names)
        own = [
            named(values.tolist(), names)
            for values, names in ((some.group, plans.group_names), (some.condition, plans.condition_names))
            if values is not None
        ]
        groups = [list(entry) for entry in zip(*own, strict=True)] if own else none
        times = None if some.durations is None else some.durations.tolist()
        actions, lengths = named(some.actions.tolist(), plans.action_names), some.mask().sum(1).tolist()
        for i, (taken, length, context, group) in enumerate(
            zip(actions, lengths, contexts, groups, strict=True), start
        ):
            called = i if plan_names is None else plan_names[i]
            if by_step:
                if i in parted:
                    blank = [""] * (len(_as_list(context[0])) if context else 0)
                    yield [called, "", *blank, *group, *([] if times is None else [""])]
                yield from (
                    [
                        called,
                        taken[t],
                        *_as_list(context[t] if context else []),
                        *group,
                        *_time(times, i - start, t),
                    ]
                    for t in range(length)
                )
            else:
                name = [] if plan_names is None else [called]
                yield [*name, *taken[:length], *[""] * (width - length), *_as_list(context), *group]


def _plan_column(plans: Any) -> tuple[Sequence[str] | None, frozenset[int]]:
    """The names of plans in a file with one step a row, and which plans are further parts of the one before.

    None where rows of one name would not be read as the same plans again: parts that do not follow one another, or
    that no group holds together.
    """
    names = plans.plan_names
    if names is None:
        return None, frozenset()
    group = [None] * len(plans) if plans.group is None else plans.group.tolist()
    whole = list(zip(names, group, strict=True))
    again = frozenset(i for i in range(1, len(whole)) if whole[i] == whole[i - 1])
    apart = len(whole) - len(again) != len(set(whole))
    return (None, frozenset()) if apart or (again and plans.group is None) else (names, again)


def _time(times: list[list[float]] | None, plan: int, step: int) -> list[float | str]:
    """The duration of an action, in a list; empty where it is not known, none where there are no durations."""
    return [] if times is None else [times[plan][step] if times[plan][step] == times[plan][step] else ""]


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]
