"""CSV with one step a row: columns `plan` and `action`, and what the agent saw at that step."""

from collections.abc import Iterator
from operator import ne
from pathlib import Path
from typing import Any

import numpy as np

from neuroprior.plans.io.columns import Column, Gathered, Integers, Names, Place
from neuroprior.plans.io.csv_plans import beside_rows
from neuroprior.plans.io.csv_rows import Beside, Sheet
from neuroprior.plans.plans import Plans, is_per_step


def read_step_rows(sheet: Sheet, num_actions: int | None, action_names: Names | None) -> Plans:
    """Plans of a CSV file with one step a row: see `read_plans`."""
    plan_at, action_at = sheet.column("plan"), sheet.column("action")
    if plan_at is None or action_at is None:
        raise ValueError(f"{sheet.path}, line 1: both columns 'plan' and 'action', or 'action_1', are expected")
    actions, beside = Column("action", action_names, num_actions, untyped=True), Beside(sheet)
    ids = _PlanIds()
    all_lines, all_starts, count = [], [], 0
    for block_lines, rows in sheet.blocks():
        starts = ids.starts([row[plan_at].strip() for row in rows], sheet.path, block_lines)
        all_starts.append(starts + count)
        actions.add(sheet.parse(lambda rows: actions.look_up([row[action_at] for row in rows]), block_lines, rows))
        beside.add(sheet.parse(beside.parse, block_lines, rows))
        all_lines.append(block_lines.astype(np.uint32))
        count += len(rows)
    if not count:
        raise ValueError(f"{sheet.path}: a header and no step below it")
    starts, lines = np.concatenate(all_starts), np.concatenate(all_lines)
    lengths = np.diff(np.append(starts, count))

    def step(i: int) -> str:
        return f"{sheet.path}, line {lines[i]}"

    numbers, names = actions.finish(step)
    context, context_names, group, group_names = beside.finish(step)
    return Gathered(
        name=str(sheet.path),
        lengths=lengths,
        actions=numbers,
        num_actions=num_actions,
        action_names=names,
        context=context,
        per_step=True,
        context_names=context_names,
        group=None if group is None else _group_of_plans(group, starts, lengths, step),
        group_names=group_names,
    ).plans()


class _PlanIds:
    """The values of the column `plan` so far."""

    def __init__(self) -> None:
        self.seen: set[str] = set()
        self.last: str | None = None

    def starts(self, texts: list[str], path: Path, lines: Integers) -> Integers:
        """The rows of a block on which a plan begins; ValueError for a plan without a name, or one in two pieces."""
        before = [self.last, *texts[:-1]]
        starts = np.flatnonzero(np.fromiter(map(ne, texts, before), bool, len(texts)))
        for i in starts.tolist():
            if not texts[i]:
                raise ValueError(
                    f"{path}, line {lines[i]}: plan: an empty cell; the name or number of the plan is expected"
                )
            if texts[i] in self.seen:
                # Two pieces may be one plan in a file sorted by time, or two plans of subjects who are each counted
                # from 1: only the user can tell.
                raise ValueError(
                    f"{path}, line {lines[i]}: plan {texts[i]!r} goes on after another plan; sort the "
                    "rows by plan, or give each plan a name of its own"
                )
            self.seen.add(texts[i])
        self.last = texts[-1] if texts else self.last
        return starts


def _group_of_plans(group: Integers, starts: Integers, lengths: Integers, place: Place) -> Integers:
    """The group `[N]` of each plan, of those of the steps `[S]`."""
    first = group[starts]
    other = np.flatnonzero(group != np.repeat(first, lengths))
    if other.size:
        raise ValueError(f"{place(int(other[0]))}: another group than on the plan's first row; a plan has one group")
    return first


def step_rows(plans: Plans, texts: dict[str, Any]) -> Iterator[list[Any]]:
    """The rows of a CSV file with one step a row, the header first; plans are numbered from 0.

    Args:
        plans: each with an action at least. A context a plan is repeated on each of its rows.
        texts: the names of actions, contexts and groups, or None for numbers, by "action", "context", "group".

    Raises:
        ValueError: a plan has no actions.
    """
    empty = (plans.mask().sum(1) == 0).nonzero()
    if len(empty):
        raise ValueError(f"plan {int(empty[0])} has no actions, and no row with layout='step'")
    context = plans.context
    features = 0 if context is None or not context.is_floating_point() else context.shape[-1]
    header = ["plan", "action"]
    header += ["context"] * (context is not None and not features) + [f"context_{i + 1}" for i in range(features)]
    yield header + ["group"] * (plans.group is not None)
    per_step = is_per_step(context)
    for start in range(0, len(plans), 2**14):
        some = plans[start : start + 2**14]
        actions, lengths, beside = some.actions.tolist(), some.mask().sum(1).tolist(), beside_rows(some, texts)
        seen = some.context.tolist() if per_step and some.context is not None else None
        for i, length in enumerate(lengths):
            for t in range(length):
                now: list[Any] = [] if seen is None else [seen[i][t]]
                now = now[0] if features and now else _texts(now, texts["context"])
                yield [start + i, *_texts([actions[i][t]], texts["action"]), *now, *beside[i]]


def _texts(numbers: list[int], names: Any) -> list[Any]:
    return numbers if names is None else [names[number] for number in numbers]
