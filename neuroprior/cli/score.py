"""`neuroprior score`: how probable plans are under a saved prior."""

from math import log
from pathlib import Path

import pandas as pd
from rich.console import Console

from neuroprior.analysis.comparison import score_bits, unit_name
from neuroprior.plans import Plans
from neuroprior.priors import load
from neuroprior.report.document import printed, table, write_frames
from neuroprior.report.saved_priors import action_bits_of, read_for

MOST_ROWS = 20
"""Groups that are printed; the CSV file has all."""


def score(
    folder: str,
    file: str,
    num_actions: int | None = None,
    action_names: list[str] | None = None,
    out: str = "runs/score",
) -> None:
    """Score plans under a saved prior: log-likelihood and bits per action, of each plan and each group.

    Plans that the prior has learned from score better than new ones: score plans that it has not met.

    Args:
        folder: a saved prior, as `neuroprior fit` writes it.
        file: plans: `.npz`, `.jsonl` or `.csv`, or `minari:` and the name of a Minari dataset.
        num_actions: number of actions, where the file does not say.
        action_names: names of the actions in the order of their numbers, where the file does not say.
        out: folder for `plans.csv` and `groups.csv`.
    """
    prior = load(folder)
    plans = read_for(file, {folder: prior}, num_actions, action_names)
    scored, bits = action_bits_of(folder, prior, plans)
    lengths = scored.mask().sum(1)
    groups = [""] * len(plans) if plans.group is None else _names(plans)
    frame = pd.DataFrame({"plan": range(len(plans)), "group": groups, "actions": lengths.tolist()})
    frame["log_likelihood"] = (-log(2) * bits.sum(1)).tolist()
    by_group = frame.groupby("group", sort=False, as_index=False)
    groups_frame = by_group.agg(plans=("plan", "size"), actions=("actions", "sum"), log_likelihood=("log_likelihood", "sum"))
    for rows in (frame, groups_frame):
        rows["bits_per_action"] = -rows["log_likelihood"] / log(2) / rows["actions"].where(rows["actions"] > 0)
    whole = score_bits(folder, "", bits, scored).bits_per_action()
    console = Console()
    columns = {"group": "group", "plans": "plans:,", "actions": "actions:,", "log-likelihood, nats": "log_likelihood:.2f"}
    columns["bits per action"] = "bits_per_action:.4f"
    shown = groups_frame.head(MOST_ROWS)
    caption = f"the first {MOST_ROWS} of {len(groups_frame)} groups" if len(groups_frame) > MOST_ROWS else ""
    if plans.group is None:
        shown, caption, columns = frame.head(MOST_ROWS), f"the first {MOST_ROWS} of {len(frame)} plans", {"plan": "plan"} | {
            name: column for name, column in columns.items() if name not in ("group", "plans")
        }
    console.print(printed(f"{file} under {folder}", table(shown, columns, caption if len(shown) < len(frame) else "")))
    line = f"{whole.mean:.4f} bits per action, 95 % interval {whole.low:.4f} to {whole.high:.4f} over {unit_name(scored)}"
    console.print(line, highlight=False)
    place = Path(out)
    place.mkdir(parents=True, exist_ok=True)
    write_frames(place, {"plans": frame, "groups": groups_frame})
    console.print(f"tables: {place / 'plans.csv'}, {place / 'groups.csv'}", highlight=False, soft_wrap=True)


def _names(plans: Plans) -> list[str]:
    """The name of each plan's group."""
    assert plans.group is not None
    names = plans.group_names
    return [str(group) if names is None else names[group] for group in plans.group.tolist()]
