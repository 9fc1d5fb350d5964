"""Tables of events, one action a row, for tests of commands that read them."""

import csv
from pathlib import Path

from neuroprior import Plans


def write_events(plans: Plans, path: Path) -> None:
    """Write plans as a table with a row an action: `plan`, `action` and, where there are any, `context` and `group`."""
    columns = {
        what: (getattr(plans, what), getattr(plans, f"{what}_names"))
        for what in ("context", "group")
        if getattr(plans, what) is not None
    }
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["plan", "action", *columns])
        for plan, step in plans.mask().nonzero().tolist():
            row = [plan, called(int(plans.actions[plan, step]), plans.action_names)]
            for values, names in columns.values():
                number = values[plan, step] if values.dim() == 2 else values[plan]
                row.append(called(int(number), names))
            rows.writerow(row)


def called(number: int, names: tuple[str, ...] | None) -> str | int:
    return number if names is None else names[number]
