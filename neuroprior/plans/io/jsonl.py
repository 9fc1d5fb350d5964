"""Plans in JSON lines: one plan a line, `{"actions": [0, 2, 1], "context": 4, "group": "mouse 7"}`."""

import json
from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from neuroprior._files import written_whole
from neuroprior.plans.io.columns import LARGEST_INTEGER, Column, Gathered, Integers, Names, check_names, renamed
from neuroprior.plans.io.json_context import Contexts, shown
from neuroprior.plans.io.opening import open_text
from neuroprior.plans.plans import Plans, is_per_step

HEADER = ("num_actions", "action_names", "context_names", "group_names", "end")
BLOCK = 2**20
"""Actions that wait as Python's integers before they become an array."""


def read_jsonl(path: Path, num_actions: int | None, action_names: Names | None) -> Plans:
    """Plans of a JSONL file: see `read_plans`."""
    rows: _Rows | None = None
    with open_text(path) as file:
        for line, row in _objects(file, path):
            place = f"{path}, line {line}"
            try:
                if rows is None:
                    is_header = "actions" not in row and any(key in row for key in HEADER)
                    rows = _Rows(path, row if is_header else {}, num_actions, action_names)
                    if is_header:
                        continue
                rows.add(line, row)
            except ValueError as error:
                raise ValueError(f"{place}: {error}") from None
    if rows is None or not rows.count:
        raise ValueError(f'{path}: no plan; a line for each, with "actions", is expected')
    return rows.plans()


def write_jsonl(plans: Plans, path: Path) -> None:
    """Write a JSONL file, with a first line that tells what the others do not: `num_actions`, names, `end`."""
    for what in ("action", "context", "group"):
        check_distinct(plans, what)
    header = {key: getattr(plans, key) for key in HEADER if getattr(plans, key) is not None}
    per_step = is_per_step(plans.context)
    with written_whole(path) as file:
        file.write(json.dumps(header, ensure_ascii=False) + "\n")
        for start in range(0, len(plans), 2**14):
            some = plans[start : start + 2**14]
            lengths = some.mask().sum(1).tolist()
            columns = [_named(some.actions.tolist(), plans.action_names)]
            keys = ["actions"]
            if some.context is not None:
                keys.append("context")
                columns.append(_named(some.context.tolist(), plans.context_names))
            if some.group is not None:
                keys.append("group")
                columns.append(_named(some.group.tolist(), plans.group_names))
            for length, values in zip(lengths, zip(*columns, strict=True), strict=True):
                row = dict(zip(keys, values, strict=True))
                row["actions"] = row["actions"][:length]
                if per_step:
                    row["context"] = row["context"][:length]
                file.write(json.dumps(row, ensure_ascii=False) + "\n")


def check_distinct(plans: Plans, what: str) -> None:
    """Raise ValueError where a name is there twice, so that a text could not tell which one is meant."""
    names = getattr(plans, f"{what}_names")
    if names is not None and len(set(names)) < len(names):
        raise ValueError(f"{what}_names: {next(n for n in names if list(names).count(n) > 1)!r} is there twice")


def _named(values: Any, names: Any) -> Any:
    if names is None:
        return values
    return [_named(value, names) if isinstance(value, list) else names[value] for value in values]


def _objects(file: Any, path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """The JSON objects of a file with the numbers of their lines; blank lines are skipped."""
    decode = json.JSONDecoder(parse_constant=_refuse_constant).raw_decode
    for number, line in enumerate(file, 1):
        text = line.strip()
        if not text:
            continue
        try:
            row, end = decode(text)
        except json.JSONDecodeError as error:
            raise ValueError(f"{path}, line {number}: not JSON ({error.msg}, column {error.colno})") from None
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path}, line {number}: {str(error).splitlines()[0][:200]}") from None
        if end != len(text):
            raise ValueError(
                f"{path}, line {number}: not JSON (more after column {end}); one object a line is expected"
            )
        if type(row) is not dict:
            raise ValueError(f'{path}, line {number}: {shown(row)} is no plan; {{"actions": [...]}} is expected')
        yield number, row


def _refuse_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a finite number")


class _Rows:
    """The plans read so far, in arrays but for the last block."""

    def __init__(self, path: Path, header: dict[str, Any], num_actions: int | None, names: Names | None) -> None:
        self.path = path
        self.given_names = names
        own = _header_names(header, "action_names")
        self.num_actions = num_actions if num_actions is not None or names is not None else header.get("num_actions")
        # Actions are read by the names of the file, and numbered as the caller wants at the end: so is `end`.
        self.action_names = own if own is not None else names
        check_names(self.num_actions, own if names is None else None)
        self.end = header.get("end")
        if self.end is not None and type(self.end) is not int:
            raise ValueError(f"end: an action's number is expected, not {shown(self.end)}")
        count = None if own is not None else self.num_actions
        self.actions = Column("action", self.action_names, count)
        self.group = Column("group", _header_names(header, "group_names"))
        self.contexts = Contexts(_header_names(header, "context_names"))
        self.action_kind: type | None = None
        self.group_kind: type | None = None
        self.count = 0
        self.waiting: list[Any] = []
        self.waiting_groups: list[Any] = []
        self.lengths: list[Integers] = []
        self.lines: list[Integers] = []
        self.waiting_rows: list[tuple[int, int]] = []

    def add(self, line: int, row: dict[str, Any]) -> None:
        """Take up one plan; ValueError tells what is wrong with it."""
        actions = row.get("actions")
        if type(actions) is not list:
            raise ValueError(f'"actions": a list is expected, not {shown(actions) if "actions" in row else "nothing"}')
        kinds = set(map(type, actions))
        if self.action_kind is None and kinds:
            self.action_kind = type(actions[0])
        if (kinds and kinds != {self.action_kind}) or self.action_kind not in (int, str, None):
            self._refuse_action(actions)
        if actions and self.action_kind is int and not 0 <= min(actions) <= max(actions) < LARGEST_INTEGER:
            wrong = next(action for action in actions if not 0 <= action < LARGEST_INTEGER)
            raise ValueError(f"action {shown(wrong)} is out of range; 0 or more is expected")
        group = row.get("group")
        if not self.count:
            self.group_kind = type(group)
        if type(group) is not self.group_kind or self.group_kind not in (int, str, type(None)):
            raise ValueError(f"group: {shown(group)}; an integer or a name in every plan, or in none, is expected")
        if self.group_kind is int and not -LARGEST_INTEGER < group < LARGEST_INTEGER:  # type: ignore[operator]
            raise ValueError(f"group: {shown(group)} is too large")
        self.contexts.add(row.get("context"))
        self.waiting.extend(actions)
        self.waiting_groups.append(group)
        self.waiting_rows.append((line, len(actions)))
        self.count += 1
        if len(self.waiting) + len(self.contexts.waiting) + 8 * len(self.waiting_rows) >= BLOCK:
            self.flush()

    def _refuse_action(self, actions: list[Any]) -> NoReturn:
        wrong = next(
            action for action in actions if type(action) is not self.action_kind or type(action) not in (int, str)
        )
        if type(wrong) in (int, str):
            raise ValueError(f"action {shown(wrong)}: numbers and names of actions are mixed in the file")
        raise ValueError(f"action {shown(wrong)}: an integer or a name is expected")

    def flush(self) -> None:
        """Turn the block that waits into arrays."""
        is_text = self.action_kind is str
        self.actions.add(self.actions.look_up(self.waiting) if is_text else self.waiting)
        if self.group_kind is not type(None):
            self.group.add(self.group.look_up(self.waiting_groups) if self.group_kind is str else self.waiting_groups)
        rows = np.array(self.waiting_rows, np.int64).reshape(-1, 2)
        self.lines.append(rows[:, 0].copy())
        self.lengths.append(rows[:, 1].copy())
        self.contexts.flush()
        self.waiting, self.waiting_groups, self.waiting_rows = [], [], []

    def plans(self) -> Plans:
        """All plans; ValueError names the line of what is wrong with one."""
        self.flush()
        lengths, lines = np.concatenate(self.lengths), np.concatenate(self.lines)
        ends = np.cumsum(lengths)

        def plan(i: int) -> str:
            return f"{self.path}, line {lines[i]}"

        def step(i: int) -> str:
            return plan(bisect_right(ends, i))

        actions, names = self.actions.finish(step)
        group, group_names = self.group.finish(plan)
        context, context_names, per_step = self.contexts.finish(lengths, plan, step)
        gathered = Gathered(
            name=str(self.path),
            lengths=lengths,
            actions=actions,
            num_actions=self.num_actions,
            action_names=names,
            context=context,
            per_step=per_step,
            context_names=context_names,
            group=None if self.group_kind is type(None) else group,
            group_names=group_names,
            end=self.end,
        )
        return renamed(gathered.plans(), self.given_names, str(self.path))


def _header_names(header: dict[str, Any], key: str) -> Names | None:
    names = header.get(key)
    if names is None:
        return None
    if type(names) is not list or not names or not all(type(name) is str for name in names):
        raise ValueError(f"{key}: a list of names is expected, not {shown(names)}")
    if len(set(names)) < len(names):
        raise ValueError(f"{key}: {next(name for name in names if names.count(name) > 1)!r} is there twice")
    return tuple(names)
