"""Plans in JSON lines: one plan a line, `{"actions": [0, 2, 1], "context": 4, "group": "mouse 7"}`."""

import json
from array import array
from bisect import bisect_right
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from neuroprior._files import written_whole
from neuroprior.plans.columns import (
    LARGEST_FLOAT,
    LARGEST_INTEGER,
    Column,
    Floats,
    Integers,
    Names,
    Place,
    check_distinct,
    check_names,
    named,
    open_text,
    warn_of_unused,
)
from neuroprior.plans.io.assembly import assembled, renamed
from neuroprior.plans.plans import Plans
from neuroprior.plans.sequences import constant_context

HEADER = ("num_actions", "action_names", "context_names", "group_names", "end")

KEYS = {"actions", "context", "group", "plan"}
"""What a line may hold; `plan`, its name in another source, is not kept."""

KINDS = {
    "none": "no context",
    "index": "an integer",
    "name": "a name",
    "numbers": "a list of numbers",
    "names": "a list of names",
    "rows": "a list of lists of numbers",
    "empty": "an empty list",
}
"""Kinds of context of a plan, as messages call them."""

LISTS = ("numbers", "names", "rows", "empty")


def read_jsonl(path: Path, num_actions: int | None, action_names: Names | None) -> Plans:
    """Plans of a JSONL file: see `read_plans`."""
    rows: _Rows | None = None
    with open_text(path) as file:
        for line, row in _objects(file, path):
            try:
                if rows is None:
                    is_header = "actions" not in row and any(key in row for key in HEADER)
                    rows = _Rows(path, row if is_header else {}, num_actions, action_names)
                    if is_header:
                        continue
                rows.add(line, row)
            except ValueError as error:
                raise ValueError(f"{path}, line {line}: {error}") from None
    if rows is None or not rows.lines:
        raise ValueError(f'{path}: no plan; a line for each, with "actions", is expected')
    return rows.plans()


def write_jsonl(plans: Plans, path: Path) -> None:
    """Write a JSONL file; its first line holds what the others do not: `num_actions`, names, `end`."""
    header = {key: getattr(plans, key) for key in HEADER if getattr(plans, key) is not None}
    once = constant_context(plans)  # a context that never changes is written once a plan
    with written_whole(path) as file:
        file.write(json.dumps(header, ensure_ascii=False) + "\n")
        for start in range(0, len(plans), 2**14):
            chunk = plans[start : start + 2**14]
            columns = {"actions": named(chunk.actions.tolist(), plans.action_names)}
            if chunk.context is not None:
                context = chunk.context if once is None else once[start : start + 2**14]
                columns["context"] = named(context.tolist(), plans.context_names)
            if chunk.group is not None:
                columns["group"] = named(chunk.group.tolist(), plans.group_names)
            for length, *values in zip(chunk.mask().sum(1).tolist(), *columns.values(), strict=True):
                row = dict(zip(columns, values, strict=True))
                row["actions"] = row["actions"][:length]
                if once is None and "context" in row:
                    row["context"] = row["context"][:length]
                file.write(json.dumps(row, ensure_ascii=False) + "\n")


def _objects(file: Any, path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """The JSON objects of a file with the numbers of their lines; blank lines are skipped."""
    decode = json.JSONDecoder(parse_constant=_refuse_constant, object_pairs_hook=_once_each).raw_decode
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
            raise ValueError(f'{path}, line {number}: {_short(row)} is no plan; {{"actions": [...]}} is expected')
        yield number, row


def _once_each(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object; raises ValueError where a key is given twice, of which one would be lost."""
    entries = dict(pairs)
    if len(entries) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in keys if keys.count(key) > 1)!r} is given twice")
    return entries


def _refuse_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a finite number")


class _Rows:
    """The plans read so far, as columns."""

    def __init__(self, path: Path, header: dict[str, Any], num_actions: int | None, names: Names | None) -> None:
        self.path = path
        self.given_names = names
        header_names = _header_names(header, "action_names")
        self.num_actions = num_actions if num_actions is not None or names is not None else header.get("num_actions")
        # Actions are read by the names of the file, and numbered as the caller wants at the end: so is `end`.
        self.action_names = header_names if header_names is not None else names
        check_names(self.num_actions, header_names if names is None else None)
        self.end = header.get("end")
        if self.end is not None and type(self.end) is not int:
            raise ValueError(f"`end` must be an action's number, got {_short(self.end)}")
        self.actions = Column("action", self.action_names, None if header_names is not None else self.num_actions)
        self.group = Column("group", _header_names(header, "group_names"))
        self.contexts = _Contexts(_header_names(header, "context_names"))
        self.action_kind: type | None = None
        self.group_kind: type = type(None)
        self.lengths, self.lines = array("q"), array("q")
        self.unused = dict.fromkeys(header.keys() - {*HEADER})

    def add(self, line: int, row: dict[str, Any]) -> None:
        """Append one plan; ValueError says what is wrong with it."""
        self.unused |= dict.fromkeys(row.keys() - KEYS)
        actions = row.get("actions")
        if type(actions) is not list:
            raise ValueError(f'"actions": a list is expected, not {_short(actions) if "actions" in row else "nothing"}')
        kinds = set(map(type, actions))
        if self.action_kind is None and kinds:
            self.action_kind = type(actions[0])
        if kinds and (kinds != {self.action_kind} or not kinds <= {int, str}):
            wrong = next(a for a in actions if type(a) is not self.action_kind or type(a) not in (int, str))
            mixed = "numbers and names of actions are mixed in the file"
            raise ValueError(
                f"action {_short(wrong)}: {mixed if type(wrong) in (int, str) else 'an integer or a name is expected'}"
            )
        if actions and self.action_kind is int and not 0 <= min(actions) <= max(actions) < LARGEST_INTEGER:
            wrong = next(action for action in actions if not 0 <= action < LARGEST_INTEGER)
            raise ValueError(f"action {_short(wrong)} is out of range; 0 or more is expected")
        self._check_group(row.get("group"))
        self.contexts.add(row.get("context"))
        self.actions.add(actions)
        if isinstance(row.get("group"), int | str):
            self.group.add((row["group"],))
        self.lengths.append(len(actions))
        self.lines.append(line)

    def _check_group(self, group: Any) -> None:
        """Check the group of a plan."""
        if not self.lines:
            self.group_kind = type(group)
        if type(group) is not self.group_kind or self.group_kind not in (int, str, type(None)):
            raise ValueError(f"`group` must be an integer or a name in every plan, or in none, got {_short(group)}")
        if type(group) is int and not -LARGEST_INTEGER < group < LARGEST_INTEGER:
            raise ValueError(f"group: {_short(group)} is too large")

    def plans(self) -> Plans:
        """All plans; ValueError names the line of what is wrong with one."""
        lengths = np.array(self.lengths)
        ends = np.cumsum(lengths)

        def plan(i: int) -> str:
            return f"{self.path}, line {self.lines[i]}"

        def step(i: int) -> str:
            return plan(bisect_right(ends, i))

        actions, names = self.actions.finish(step)
        group, group_names = self.group.finish(plan)
        context, context_names, per_step = self.contexts.finish(lengths, plan, step)
        plans = assembled(
            str(self.path),
            lengths,
            actions,
            self.num_actions,
            names,
            context,
            per_step,
            context_names,
            group if len(group) else None,
            group_names,
            self.end,
        )
        warn_of_unused(self.path, "keys", sorted(self.unused))
        return renamed(plans, self.given_names, str(self.path))


def _header_names(header: dict[str, Any], key: str) -> Names | None:
    names = header.get(key)
    if names is None:
        return None
    if type(names) is not list or not names or not all(type(name) is str for name in names):
        raise ValueError(f"`{key}` must be a list of names, got {_short(names)}")
    check_distinct(key, names)
    return tuple(names)


class _Contexts:
    """The contexts of the plans read so far; those of a file are all of one kind.

    Args:
        names: of the contexts, from the file's header.
    """

    def __init__(self, names: Names | None) -> None:
        self.kind: str | None = None  # None until a plan shows it: an empty list does not
        self.column = Column("context", names)
        self.features: array[float] | None = None  # None while there is neither a decimal point nor a row
        self.width: int = -1
        self.sizes = array("q")

    def add(self, value: Any) -> None:
        """Append the context of one plan, None where it has none; ValueError if it is wrong or of another kind."""
        kind = _kind(value)
        before = self.kind or ("empty" if self.sizes else None)
        fits = kind == before or ("empty" in (kind, before) and kind in LISTS and before in LISTS)
        if before is not None and not fits:
            raise ValueError(f"context: {KINDS[kind]}, where the plans before have {KINDS[before]}")
        values = list(chain.from_iterable(value)) if kind == "rows" else value if kind in LISTS else [value]
        if kind == "rows":
            self.width = len(value[0]) if self.width < 0 else self.width
            for row in value:
                if not row:
                    raise ValueError("context: an empty list of features")
                if len(row) != self.width:
                    raise ValueError(f"context: {len(row)} features of a step, where those before have {self.width}")
        is_float = kind == "rows" or (kind == "numbers" and float in map(type, values))
        if kind in ("index", "numbers", "rows"):
            _check_numbers(values, LARGEST_FLOAT if is_float else LARGEST_INTEGER)
        if is_float and self.features is None:
            # Whole numbers so far are features too.
            self.features = array("d", () if kind == "rows" else self.column.numbers().tolist())
        if self.features is not None:
            self.features.extend(values)
        elif kind != "none":
            self.column.add(values)
        self.kind = self.kind if kind == "empty" else kind
        self.sizes.append(len(value) if kind in LISTS else 1)

    def finish(
        self, lengths: Integers, plan: Place, step: Place
    ) -> tuple[Integers | Floats | None, Names | None, bool]:
        """The contexts `[N]`, `[N, C]`, `[S]` or `[S, C]`, their names, and whether they are per step.

        Args:
            lengths: `[N]`.
            plan: the place of a plan.
            step: the place of a step.
        """
        if self.kind == "none":
            return None, None, False
        if self.kind in ("index", "name"):
            return *self.column.finish(plan), False
        sizes = np.array(self.sizes)
        of_plans = self.kind == "numbers" and self.features is not None
        wrong = np.flatnonzero(sizes != (sizes[0] if of_plans else lengths))
        if wrong.size and of_plans:
            i = int(wrong[0])
            raise ValueError(f"{plan(i)}: context: {sizes[i]} features, where the first plan has {sizes[0]}")
        if wrong.size:
            i = int(wrong[0])
            hint = "; features of a plan need a decimal point, as in 1.0" if self.kind == "numbers" else ""
            raise ValueError(f"{plan(i)}: context: {sizes[i]} entries for {lengths[i]} actions{hint}")
        if self.features is None:
            return *self.column.finish(step), True
        return np.array(self.features).reshape(-1, int(sizes[0]) if of_plans else self.width), None, not of_plans


def _kind(value: Any) -> str:
    """One of `KINDS`; numbers in lists are not checked."""
    if value is None:
        return "none"
    if type(value) in (str, int):
        return "name" if type(value) is str else "index"
    if type(value) is not list:
        raise ValueError(f"context: {_short(value)} is neither an integer, a name nor a list")
    kinds = set(map(type, value))
    return "empty" if not kinds else "names" if kinds == {str} else "rows" if kinds == {list} else "numbers"


def _check_numbers(values: list[Any], largest: float) -> None:
    if not set(map(type, values)) <= {int, float}:
        wrong = next(value for value in values if type(value) not in (int, float))
        raise ValueError(f"`context` must be numbers here, got {_short(wrong)}")
    if not -largest <= min(values) <= max(values) <= largest:
        raise ValueError(f"context: {_short(max(values, key=abs))} is too large")


def _short(value: Any) -> str:
    """A value for a message, not longer than a part of a line."""
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:36]} ..."
