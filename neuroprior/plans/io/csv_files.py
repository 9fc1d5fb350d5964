"""Plans in CSV: which of the two layouts a file has, and which one is written."""

import csv
from pathlib import Path

from neuroprior._files import written_whole
from neuroprior.plans.io.columns import Names, number_in
from neuroprior.plans.io.csv_plans import plan_rows, read_plan_rows
from neuroprior.plans.io.csv_rows import Sheet
from neuroprior.plans.io.csv_steps import read_step_rows, step_rows
from neuroprior.plans.io.jsonl import check_distinct
from neuroprior.plans.plans import Plans, is_per_step


def read_csv(path: Path, num_actions: int | None, action_names: Names | None) -> Plans:
    """Plans of a CSV file: see `read_plans`."""
    sheet = Sheet(path)
    by_step = sheet.header is not None and not sheet.numbered("action")
    return (read_step_rows if by_step else read_plan_rows)(sheet, num_actions, action_names)


def write_csv(plans: Plans, path: Path, layout: str | None) -> None:
    """Write a CSV file; `.tsv` has tabs."""
    if layout not in (None, "plan", "step"):
        raise ValueError(f"layout: 'plan', 'step' or None is expected, not {layout!r}")
    if plans.end is not None:
        raise ValueError(
            f"{path}: CSV cannot tell that an action is the end symbol; write plans.without_end(), or JSONL"
        )
    if not plans.mask().any():
        raise ValueError(f"{path}: CSV cannot hold plans of which none has an action")
    for what in ("action", "context", "group"):
        _check_texts(plans, what, path)
    texts = {what: getattr(plans, f"{what}_names") for what in ("action", "context", "group")}
    layout = layout or ("step" if is_per_step(plans.context) else "plan")
    rows = (step_rows if layout == "step" else plan_rows)(plans, texts)
    with written_whole(path) as file:
        writer = csv.writer(file, delimiter="\t" if path.suffix.lower() == ".tsv" else ",", lineterminator="\n")
        try:
            writer.writerows(rows)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def _check_texts(plans: Plans, what: str, path: Path) -> None:
    """Raise ValueError for names that would not be read back as they are."""
    check_distinct(plans, what)
    for name in getattr(plans, f"{what}_names") or ():
        if not name.strip() or name != name.strip() or "\n" in name or "\r" in name:
            raise ValueError(
                f"{path}: {what}_names: CSV cannot hold {name!r}; names without space around them or line breaks can be"
            )
        if what == "context" and number_in(name) is not None:
            raise ValueError(f"{path}: {what}_names: CSV cannot hold {name!r}, which would be read as a number")
