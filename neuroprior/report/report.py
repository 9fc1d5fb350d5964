"""`python -m eval plans`: how much structure a file of plans has, how far back it reaches, and which model tells it."""

import os
import shlex
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from neuroprior import load
from neuroprior.analysis.comparison import Score, unit_name
from neuroprior.plans import Plans, read_plans
from neuroprior.plans.folds import BLOCKS, FEWEST_UNITS, in_parts
from neuroprior.report import crossval, saved_priors
from neuroprior.report import scores as held_out
from neuroprior.report.crossval import ACTIONS, CONTEXT, Design, Study
from neuroprior.report.fits import KINDS
from neuroprior.report.processes import progress_bar
from neuroprior.report.saved_priors import numbers
from neuroprior.report.scores import Model
from neuroprior.report.study import Report, write_report

MODELS = ("counts", "gru", "transformer", "stacked", "gru-large", "mixture")
LISTS: dict[str, dict[str, Any]] = {
    "priors": {"help": "score these model folders only; the first is compared with"},
    "models": {"default": list(MODELS[:4]), "choices": MODELS, "help": "which to fit"},
    "sees": {
        "default": ["actions", "context"],
        "choices": ["actions", "context"],
        "help": "what models see: past actions alone, or the context too, where the file has one",
    },
    "action_names": {"help": "names of the actions in the order of their numbers, where the file does not tell"},
}
"""Options that take several words."""

MOST_ACTIONS = 10_000
"""Kinds of actions beyond which they are thought to be names that look like numbers."""

FOLDS = 5
"""Where they are not given; fewer where there are fewer groups."""


def plans(
    file: str,
    priors: list[str] | None = None,
    test: str | None = None,
    folds: int | None = None,
    models: list[str] = list(MODELS[:4]),  # noqa: B006
    sees: list[str] = ["actions", "context"],  # noqa: B006
    skip: int = 0,
    max_steps: int = 1000,
    patience: float = 0.25,
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
            weighs the forecasts of counts), gru-large (256 wide, with dropout), mixture (of stacked and gru-large);
            the last two are slow, and left out by default.
        sees: what models see: past actions alone, the context as well where the file has one, or each in turn.
        skip: actions at the beginning of each plan that do not count in scores.
        max_steps: gradient steps of a neural prior.
        patience: share of these steps without improvement after which training stops; 1 trains to the end.
        num_actions: number of actions, where the file does not tell.
        action_names: names of the actions in the order of their numbers, where the file does not tell.
        seed: draws the folds and everything in training.
        processes: how many models are fitted at a time; all cores by default.
        out: folder for `report.html`, `results.json`, tables as CSV, and what an interrupted run goes on from.
    """
    _check(skip, max_steps, patience, seed, processes)
    folder, console = Path(out), Console()
    if priors is not None:
        if test is not None or folds is not None:
            raise ValueError("priors: saved priors are scored on the file as they are; leave --test and --folds out")
        report = _of_saved(file, priors, skip, num_actions, action_names)
    else:
        read, empty = _read(file, num_actions, action_names)
        if test is not None and Path(test).resolve() == Path(file).resolve():
            raise ValueError("test: the very plans that are learned from; give others, or leave --test out")
        if test is not None and folds is not None:
            raise ValueError("folds: with --test nothing is left out of the file; leave --folds out")
        other = None
        if test is not None:
            other, empty = _read(test, num_actions, action_names)
            other = _same_names(read, other, test)
        read, other = _renumbered(read, other)
        whole = read
        scored, cut = _in_parts(read if other is None else other)
        read, other = (scored, None) if other is None else (_in_parts(read)[0], scored)
        design = Design(1 if test is not None else _folds(file, read, folds), seed, skip, max_steps, patience, cut=cut)
        report = replace(_of_fitted(folder, read, other, design, [*models, "lags"], sees, processes), plans=whole)
        if empty:
            report = replace(report, settings=report.settings | {"plans without actions, left out": empty})
    command = (
        "python -m eval " + shlex.join(sys.argv[1:]) if sys.argv[1:2] == ["plans"] else f"python -m eval plans {file}"
    )
    settings = report.settings | ({} if test is None else {"test": test})
    write_report(replace(report, command=command, source=file, settings=settings), folder, console)


def _check(skip: int, max_steps: int, patience: float, seed: int, processes: int | None) -> None:
    """Raise ValueError, naming the option, unless these numbers can be."""
    if skip < 0 or max_steps < 1:
        raise ValueError(f"skip and max_steps: at least 0 and 1 are expected, not {skip} and {max_steps}")
    if not 0 < patience <= 1:
        raise ValueError(f"patience: a share of the steps, above 0 and at most 1, is expected, not {patience}")
    if not 0 <= seed < 2**50:
        raise ValueError(f"seed: an integer from 0 to 2**50 - 1 is expected, not {seed}")
    if processes is not None and processes < 1:
        raise ValueError(f"processes: at least 1 is expected, not {processes}")


def _read(file: str, num_actions: int | None, action_names: list[str] | None) -> tuple[Plans, int]:
    """The plans that have actions, and how many have none: these neither teach nor test anything."""
    read = read_plans(file, num_actions=num_actions, action_names=action_names)
    read = read if read.end is None else read.without_end()
    if read.num_actions > MOST_ACTIONS:
        raise ValueError(
            f"{file}: action numbers go up to {read.num_actions - 1}; number the actions from 0, or write names"
        )
    some = read.mask().any(1)
    if not bool(some.any()):
        raise ValueError(f"{file}: no plan has an action")
    return read[some], int((~some).sum())


def _in_parts(read: Plans) -> tuple[Plans, bool]:
    """The plans, a single one cut into consecutive parts; and whether it was."""
    if len(read) > 1:
        return read, False
    return in_parts(read, min(BLOCKS, max(int(read.mask().sum()) // 2, 1))), True


def _folds(file: str, read: Plans, folds: int | None) -> int:
    """How many; by default no more than there are units."""
    grouped = read.group is not None and len(read.group.unique()) > 1
    units = len(read.group.unique()) if grouped and read.group is not None else len(read)
    if units < 2:
        raise ValueError(f"{file}: at least two plans, or a single long one, are needed for cross-validation")
    number = min(FOLDS, units) if folds is None else folds
    if number < 2:  # which a `Design` takes for a test file
        raise ValueError(f"folds: at least 2 are expected, not {number}")
    return number


def _renumbered(read: Plans, test: Plans | None) -> tuple[Plans, Plans | None]:
    """The plans with the contexts that occur numbered from 0, where they have no names: no model grows with a gap."""
    contexts = [some.context for some in (read, test) if some is not None and some.context is not None]
    named = read.context_names is not None or (test is not None and test.context_names is not None)
    if not contexts or named or contexts[0].is_floating_point():
        return read, test
    seen = torch.cat([context.flatten().long() for context in contexts]).unique()
    if int(seen[0]) < 0:
        raise ValueError(f"context: numbers from 0 are expected, not {int(seen[0])}")
    new = [torch.searchsorted(seen, context.long().contiguous()) for context in contexts]
    return replace(read, context=new[0]), None if test is None else replace(test, context=new[-1])


def _same_names(read: Plans, other: Plans, test: str) -> Plans:
    """The test plans with actions and contexts numbered as in those that are learned from."""
    if _sees(read) != _sees(other):
        raise ValueError(f"{test}: {_sees(other)}, but {_sees(read)} in the plans to learn from")
    elsewhere = " is not in the plans to learn from; they have"
    if read.action_names is not None and other.action_names is not None:
        number = numbers(read.action_names, other.action_names, f"{test}: the action", elsewhere)
        other = replace(other, actions=number[other.actions.long()], num_actions=read.num_actions, action_names=None)
    if other.num_actions > read.num_actions:
        raise ValueError(f"{test}: {other.num_actions} actions, but {read.num_actions} in the plans to learn from")
    other = replace(other, num_actions=read.num_actions, action_names=read.action_names)
    if read.context_names is not None and other.context_names is not None and other.context is not None:
        number = numbers(read.context_names, other.context_names, f"{test}: the context", elsewhere)
        other = replace(other, context=number[other.context.long()], context_names=read.context_names)
    return other


def _sees(plans: Plans) -> str:
    """What kind of context plans have."""
    if plans.context is None:
        return "no context"
    return f"{plans.context.shape[-1]} features" if plans.context.is_floating_point() else "context indices"


def _of_fitted(
    folder: Path,
    read: Plans,
    test: Plans | None,
    design: Design,
    kinds: list[str],
    sees: list[str],
    processes: int | None,
) -> Report:
    """Fit all models and score them on held-out plans."""
    study = Study.prepare(folder, read, test, design)
    seen = [ACTIONS] * ("actions" in sees) + [CONTEXT] * ("context" in sees and read.context is not None)
    if not seen:
        raise ValueError("sees: the file has no context; leave --sees context out")
    if (counted := int(study.mask().sum())) < FEWEST_UNITS:
        raise ValueError(f"skip: {counted} actions are left to score after the first {design.skip} of each plan")
    todo = crossval.jobs(design, [kind for kind in KINDS if kind in kinds], seen)
    with progress_bar() as progress:
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
        f"{reference.model} ({reference.inputs})",
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
    mask = crossval.counted(read, skip)
    settings = {"priors": ", ".join(folders), "skip": skip, "unit": unit_name(read, mask)}
    return Report(read, read, mask, models, scores, rows, folders[0], [], settings)
