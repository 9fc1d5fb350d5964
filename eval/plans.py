"""`python -m eval plans`: saved priors scored on a file of plans."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from eval.tables import columns, titled
from neuroprior import Prior, load
from neuroprior.comparison import Score, score, unit_name
from neuroprior.output import versions, write_csv, write_json
from neuroprior.plans import Plans, read_plans


def plans(
    file: str,
    priors: list[str],
    num_actions: int | None = None,
    action_names: list[str] | None = None,
    out: str = "runs/plans",
) -> None:
    """Score saved priors on a file of plans that they have not learned from.

    Args:
        file: plans: `.npz`, `.jsonl` or `.csv`.
        priors: model folders, such as `python -m train` writes; the first is what the others are compared with.
        num_actions: number of actions, where the file does not tell.
        action_names: names of the actions in the order of their numbers, where the file does not tell.
        out: folder for `plans.csv` and `results.json`.
    """
    if not priors:
        raise ValueError("priors: at least one model folder is expected")
    loaded = {folder: load(folder) for folder in priors}
    names = action_names or _names(next(iter(loaded.values())))
    read = _read(file, num_actions, names, bool(action_names))
    scores = [_score(folder, prior, read) for folder, prior in loaded.items()]
    rows = [_row(one, scores[0]) for one in scores]
    Console().print(_table(rows, read))
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "plans.csv", rows)
    write_json(folder / "results.json", {"rows": rows, "unit": unit_name(read), "versions": versions()})


def _names(prior: Prior) -> list[str] | None:
    """The names of the actions that a prior has learned, without that of its end symbol."""
    return None if prior.action_names is None else [n for a, n in enumerate(prior.action_names) if a != prior.end]


def _read(file: str, num_actions: int | None, names: list[str] | None, given: bool) -> Plans:
    # Other files tell their names themselves, and perhaps that of an end symbol, or number fewer actions.
    names = names if given or Path(file).suffix.lower() in (".csv", ".tsv") else None
    read = read_plans(file, num_actions=num_actions, action_names=names)
    return read if read.end is None else read.without_end()


def _score(folder: str, prior: Prior, read: Plans) -> Score:
    known = prior.num_actions - (prior.end is not None)
    if read.num_actions > known:
        raise ValueError(f"{folder}: knows {known} actions, the file has {read.num_actions}")
    read = _with_actions_of(prior, read, folder)
    seen = _with_contexts_of(prior, replace(read, num_actions=known, action_names=None), folder)
    try:
        return score(folder, prior, seen if prior.end is None else seen.with_end())
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error


def _with_actions_of(prior: Prior, read: Plans, folder: str) -> Plans:
    """The plans with their actions numbered as the prior has learned them, by name."""
    names = _names(prior)
    if names is None or read.action_names is None:
        return read
    unknown = [name for name in read.action_names if name not in names]
    if unknown:
        raise ValueError(f"{folder}: does not know the action {unknown[0]!r}; it knows {', '.join(names)}")
    number = torch.tensor([names.index(name) for name in read.action_names])
    return replace(read, actions=number[read.actions.long()], num_actions=len(names), action_names=None)


def _with_contexts_of(prior: Prior, read: Plans, folder: str) -> Plans:
    """The plans with their contexts numbered as the prior has learned them, by name."""
    if prior.context_names is None or read.context_names is None or read.context is None:
        return read
    unknown = [name for name in read.context_names if name not in prior.context_names]
    if unknown:
        raise ValueError(
            f"{folder}: has not seen the context {unknown[0]!r}; it knows {', '.join(prior.context_names)}"
        )
    number = torch.tensor([prior.context_names.index(name) for name in read.context_names])
    return replace(read, context=number[read.context.long()], context_names=None)


def _row(one: Score, first: Score) -> dict[str, Any]:
    taken = one.bits_per_action()
    row = {"model": one.model, "sees": one.sees, "bits_per_action": taken.mean, "low": taken.low, "high": taken.high}
    if len(one.bits) != len(first.bits) or not one.actions.equal(first.actions):
        # one tells the ends of plans too, the other does not
        return row | {"more_than_first": None, "more_low": None, "more_high": None}
    gap = one.minus(first)
    return row | {"more_than_first": gap.mean, "more_low": gap.low, "more_high": gap.high}


def _table(rows: list[dict[str, Any]], read: Plans) -> Any:
    table = titled(f"Bits per action on {len(read):,} plans ({int(read.mask().sum()):,} actions)")
    columns(table, ("prior", "sees", "bits", "95 % interval", "more", "95 % interval"), 2)
    table.columns[0].no_wrap, table.columns[0].overflow = False, "fold"
    for row in rows:
        more = ("", "")
        if row is not rows[0] and row["more_than_first"] is not None:
            more = (f"{row['more_than_first']:+.4f}", f"{row['more_low']:+.4f} to {row['more_high']:+.4f}")
        sees = "context" if "context" in row["sees"] else "actions"
        table.add_row(row["model"], sees, f"{row['bits_per_action']:.4f}", f"{row['low']:.4f}-{row['high']:.4f}", *more)
    table.caption = f"95 % intervals over {unit_name(read)}; more: bits more than the first takes, paired."
    return table
