"""`python -m eval plans`: how much structure a file of plans has, how far back it reaches, and which model tells it."""

import os
import shlex
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from eval import crossval, held_out, saved_priors
from eval.crossval import ACTIONS, CONTEXT, Design, Study
from eval.fits import KINDS
from eval.held_out import Model
from eval.plan_report import Report, write_report
from neuroprior import load
from neuroprior.comparison import Score, unit_name
from neuroprior.plans import Plans, read_plans
from neuroprior.plans.folds import BLOCKS, in_parts

MODELS = ("counts", "gru", "transformer", "stacked", "gru-large")
LISTS: dict[str, dict[str, Any]] = {
    "priors": {"help": "score these model folders only; the first is compared with"},
    "models": {"default": list(MODELS[:4]), "choices": MODELS, "help": "which to fit"},
    "action_names": {"help": "names of the actions in the order of their numbers, where the file does not tell"},
}
"""Options that take several words."""

FOLDS = 5
"""Where they are not given; fewer where there are fewer groups."""


def plans(
    file: str,
    priors: list[str] | None = None,
    test: str | None = None,
    folds: int | None = None,
    models: list[str] = list(MODELS[:4]),  # noqa: B006
    skip: int = 0,
    max_steps: int = 1000,
    num_actions: int | None = None,
    action_names: list[str] | None = None,
    seed: int = 0,
    processes: int | None = None,
    out: str = "runs/plans",
) -> None:
    """Report on a file of plans: which models tell them best, how far back they reach, what is typical of them.

    Args:
        file: plans: `.npz`, `.jsonl` or `.csv`, or `minari:` and the name of a Minari dataset.
        priors: score these model folders only, such as `python -m train` writes; the first is compared with.
        test: learn from the file and score on this one, in place of cross-validation.
        folds: of the cross-validation over groups (over plans, where there are no two groups); 5 by default.
        models: which to fit: counts (uniform, Markov chains, context trees), gru, transformer, stacked (a GRU that
            weighs the forecasts of counts), gru-large (256 wide, with dropout; slow, and left out by default).
        skip: actions at the beginning of each plan that do not count in scores.
        max_steps: gradient steps of a neural prior.
        num_actions: number of actions, where the file does not tell.
        action_names: names of the actions in the order of their numbers, where the file does not tell.
        seed: draws the folds and everything in training.
        processes: how many models are fitted at a time; all cores by default.
        out: folder for `report.html`, `results.json`, tables as CSV, and what an interrupted run goes on from.
    """
    if skip < 0 or max_steps < 1:
        raise ValueError(f"skip and max_steps: at least 0 and 1 are expected, not {skip} and {max_steps}")
    folder, console = Path(out), Console()
    if priors is not None:
        report = _of_saved(file, priors, skip, num_actions, action_names)
    else:
        read = _read(file, num_actions, action_names)
        other = None if test is None else _same_names(read, _read(test, num_actions, action_names), test)
        design = Design(1 if test is not None else _folds(read, folds), seed, skip, max_steps)
        report = _of_fitted(folder, read, other, design, [*models, "lags"], processes)
    command = (
        "python -m eval " + shlex.join(sys.argv[1:]) if sys.argv[1:2] == ["plans"] else f"python -m eval plans {file}"
    )
    settings = report.settings | ({} if test is None else {"test": test})
    write_report(replace(report, command=command, source=file, settings=settings), folder, console)


def _read(file: str, num_actions: int | None, action_names: list[str] | None) -> Plans:
    read = read_plans(file, num_actions=num_actions, action_names=action_names)
    read = read if read.end is None else read.without_end()
    return in_parts(read, min(BLOCKS, max(int(read.mask().sum()) // 2, 1))) if len(read) == 1 else read


def _folds(read: Plans, folds: int | None) -> int:
    """How many; by default no more than there are units."""
    if folds is not None:
        return folds
    grouped = read.group is not None and len(read.group.unique()) > 1
    return min(FOLDS, len(read.group.unique()) if grouped and read.group is not None else len(read))


def _same_names(read: Plans, other: Plans, test: str) -> Plans:
    """The test plans with actions and contexts numbered as in those that are learned from."""
    if (read.context is None) != (other.context is None):
        raise ValueError(f"{test}: {'no' if other.context is None else 'a'} context, unlike the plans to learn from")
    if read.action_names is not None and other.action_names is not None:
        number = _numbers("action", read.action_names, other.action_names, test)
        other = replace(other, actions=number[other.actions.long()], num_actions=read.num_actions, action_names=None)
    if other.num_actions > read.num_actions:
        raise ValueError(f"{test}: {other.num_actions} actions, but {read.num_actions} in the plans to learn from")
    other = replace(other, num_actions=read.num_actions, action_names=read.action_names)
    if read.context_names is not None and other.context_names is not None and other.context is not None:
        number = _numbers("context", read.context_names, other.context_names, test)
        other = replace(other, context=number[other.context.long()], context_names=read.context_names)
    return other


def _numbers(what: str, known: Any, names: Any, file: str) -> Tensor:
    """The number under which each name is known."""
    known = list(known)
    if unknown := [name for name in names if name not in known]:
        raise ValueError(
            f"{file}: the {what} {unknown[0]!r} is not in the plans to learn from; they have {', '.join(known)}"
        )
    return torch.tensor([known.index(name) for name in names])


def _of_fitted(
    folder: Path, read: Plans, test: Plans | None, design: Design, kinds: list[str], processes: int | None
) -> Report:
    """Fit all models and score them on held-out plans."""
    study = Study.prepare(folder, read, test, design)
    sees = [ACTIONS] + [CONTEXT] * (read.context is not None)
    todo = crossval.jobs(design, [kind for kind in KINDS if kind in kinds], sees)
    bar = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*bar, TimeRemainingColumn(), transient=True) as progress:
        task = progress.add_task("fitting models", total=len(todo))
        try:
            crossval.run(study, todo, processes or os.cpu_count() or 1, lambda job: progress.advance(task))
        except KeyboardInterrupt as interrupted:
            kept = f"interrupted; fits that were finished are kept in {study.folder}, and the same command goes on"
            raise KeyboardInterrupt(kept) from interrupted
    models = held_out.models_of(study, todo)
    scored, mask = study.scored, study.mask()
    scores = held_out.scores_of(models, scored, mask)
    rows = held_out.score_rows(scores, models)
    reference = min(scores, key=lambda one: one.bits_per_action().mean)
    settings = {"models": ", ".join(kinds)} | asdict(design)
    return Report(
        read,
        scored,
        mask,
        models,
        scores,
        rows,
        f"{reference.model} ({reference.sees})",
        held_out.step_rows(study, todo),
        settings,
    )


def _of_saved(
    file: str, folders: list[str], skip: int, num_actions: int | None, action_names: list[str] | None
) -> Report:
    """Score saved priors alone."""
    if not folders:
        raise ValueError("priors: at least one model folder is expected")
    loaded = {folder: load(folder) for folder in folders}
    read = saved_priors.read_for(file, loaded, num_actions, action_names)
    found = [saved_priors.score_saved(folder, prior, read, skip) for folder, prior in loaded.items()]
    models: list[Model] = [model for model, _ in found]
    scores: list[Score] = [score for _, score in found]
    rows = [held_out.score_row(one, scores[0]) | {"how": model.how} for model, one in found]
    mask = read.mask()
    mask[:, :skip] = False
    settings = {"priors": ", ".join(folders), "skip": skip, "unit": unit_name(read, mask)}
    return Report(read, read, mask, models, scores, rows, folders[0], [], settings)
