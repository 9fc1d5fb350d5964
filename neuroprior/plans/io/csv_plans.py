"""CSV with one plan a row: columns `action_1` ... `action_L`, or no header and nothing but actions."""

from bisect import bisect_right
from collections.abc import Iterator
from typing import Any

import numpy as np

from neuroprior.plans.io.columns import Column, Gathered, Integers, Names
from neuroprior.plans.io.csv_rows import Beside, Row, Sheet, cells
from neuroprior.plans.plans import Plans, is_per_step


def read_plan_rows(sheet: Sheet, num_actions: int | None, action_names: Names | None) -> Plans:
    """Plans of a CSV file with one plan a row: see `read_plans`."""
    columns = list(range(sheet.width)) if sheet.header is None else sheet.numbered("action")
    if not columns:
        raise ValueError(f"{sheet.path}, line 1: a header without 'action_1', and without both 'plan' and 'action'")
    actions = Column("action", action_names, num_actions, untyped=True)
    actions.blank = -1
    beside = Beside(sheet)
    all_sizes, all_lines = [], []
    for block_lines, rows in sheet.blocks():
        flat, sizes = sheet.parse(lambda rows: _actions(actions, columns, rows), block_lines, rows)
        actions.add(flat)
        beside.add(sheet.parse(beside.parse, block_lines, rows))
        all_sizes.append(sizes)
        all_lines.append(block_lines)
    lengths, lines = np.concatenate(all_sizes), np.concatenate(all_lines)
    if not len(lengths):
        raise ValueError(f"{sheet.path}: a header and no plan below it")
    ends = np.cumsum(lengths)

    def plan(i: int) -> str:
        return f"{sheet.path}, line {lines[i]}"

    numbers, names = actions.finish(lambda i: plan(bisect_right(ends, i)))
    context, context_names, group, group_names = beside.finish(plan)
    return Gathered(
        name=str(sheet.path),
        lengths=lengths,
        actions=numbers,
        num_actions=num_actions,
        action_names=names,
        context=context,
        context_names=context_names,
        group=group,
        group_names=group_names,
    ).plans()


def _actions(actions: Column, columns: list[int], rows: list[Row]) -> tuple[Integers, Integers]:
    """The actions of some rows end to end, and how many each row has."""
    numbers = actions.look_up(cells(rows, columns)).reshape(len(rows), len(columns))
    there = numbers >= 0
    sizes = there.sum(1)
    gaps = there != (np.arange(len(columns)) < sizes[:, None])
    if gaps.any():
        first = int(there[int(gaps.any(1).argmax())].argmin()) + 1
        raise ValueError(f"action {first} is empty, but not those after it; only the end of a plan may be empty")
    return numbers[there], sizes


def plan_rows(plans: Plans, texts: dict[str, Any]) -> Iterator[list[Any]]:
    """The rows of a CSV file with one plan a row, the header first.

    Args:
        plans: without a context a step.
        texts: the names of actions, contexts and groups, or None for numbers, by "action", "context", "group".

    Raises:
        ValueError: the context is one a step.
    """
    if is_per_step(plans.context):
        raise ValueError("a context a step cannot be written with one plan a row; use layout='step'")
    width = plans.max_length
    context = plans.context
    features = 0 if context is None or context.dim() == 1 else context.shape[1]
    header = [f"action_{i + 1}" for i in range(width)]
    header += ["context"] * (context is not None and not features) + [f"context_{i + 1}" for i in range(features)]
    yield header + ["group"] * (plans.group is not None)
    for start in range(0, len(plans), 2**14):
        some = plans[start : start + 2**14]
        lengths = some.mask().sum(1).tolist()
        beside = beside_rows(some, texts)
        for actions, length, rest in zip(some.actions.tolist(), lengths, beside, strict=True):
            taken = actions[:length] if texts["action"] is None else [texts["action"][a] for a in actions[:length]]
            yield taken + [""] * (width - length) + rest


def beside_rows(plans: Plans, texts: dict[str, Any]) -> list[list[Any]]:
    """What stands beside the actions of each plan: its context, if it is one a plan, and its group."""
    rows: list[list[Any]] = [[] for _ in range(len(plans))]
    for what, values in (("context", plans.context), ("group", plans.group)):
        if values is None or (what == "context" and is_per_step(values)):
            continue
        for row, value in zip(rows, values.tolist(), strict=True):
            row.extend(value if isinstance(value, list) else [value if texts[what] is None else texts[what][value]])
    return rows
