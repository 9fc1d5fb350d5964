"""The report on plans: which models predict them best, how far back they reach, what is typical of them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import torch

from neuroprior._checks import check_count, check_sizes
from neuroprior._jobs import Progress
from neuroprior._threads import one_thread
from neuroprior.behaviour.report.document import Document, check_place, write_document
from neuroprior.behaviour.report.fits import ACTIONS, CONTEXT, DURATIONS, LAGS, OF_FEATURES, Design, counted
from neuroprior.behaviour.report.scores import Evaluation, cross_validation, evaluate, evaluate_saved, jobs
from neuroprior.behaviour.report.sections import SECTIONS, describe
from neuroprior.plans import Plans, read_plans
from neuroprior.plans.columns import Columns, Missing
from neuroprior.plans.folds import BLOCKS, FEWEST_UNITS, in_parts
from neuroprior.plans.io import is_table
from neuroprior.priors import Prior, load
from neuroprior.priors.ensembles.candidates import Effort, check_effort
from neuroprior.priors.matching import learned_names, renumbered
from neuroprior.priors.scoring import learned_from

ModelName = Literal["counts", "gru", "transformer", "stacked", "combined"]
InputName = Literal["actions", "context", "durations"]

MODELS: tuple[ModelName, ...] = ("counts", "gru", "transformer", "stacked", "combined")
QUICK: tuple[ModelName, ...] = ("counts", "gru", "combined")
INPUTS: tuple[InputName, ...] = ("actions", "context", "durations")

MOST_ACTIONS = 10_000
"""Kinds of actions beyond which they are thought to be names that look like numbers."""

FOLDS = 5
"""Folds where their number is not given; fewer where there are fewer groups."""


def report(
    plans: Plans | str | Path,
    *,
    out: str | Path | None = None,
    priors: Mapping[str, Prior] | Sequence[str] | None = None,
    test: Plans | str | Path | None = None,
    folds: int | None = None,
    models: Sequence[ModelName] | None = None,
    inputs: Sequence[InputName] = INPUTS[:2],
    modes: Sequence[int] | None = None,
    skip: int = 0,
    effort: Effort = "standard",
    max_steps: int | None = None,
    num_actions: int | None = None,
    action_names: Sequence[str] | None = None,
    columns: Columns | Mapping[str, Any] | None = None,
    missing: Missing = "gap",
    merge_repeats: bool = False,
    max_gap: float | None = None,
    seed: int = 0,
    processes: int | None = None,
    dask: str | None = None,
    sections: Sequence[str] = tuple(SECTIONS),
    command: str = "",
) -> Document:
    """Report on plans: which models predict them best, how far back they reach, what is typical of them.

    Args:
        plans: executed plans, or their file: `.npz`, `.jsonl` or `.csv`, or `minari:` and the name of a Minari dataset.
        out: folder for `report.html`, `results.json`, tables as CSV, and the finished fits of a cross-validation, with
            which an interrupted one goes on; None: nothing is written.
        priors: score these fitted priors only, given by name or by their folders; the first is the reference.
        test: learn from the plans and score on these, or on those of this file, in place of cross-validation.
        folds: of the cross-validation over groups (over plans, where there are no two groups); 5 by default.
        models: which to fit: counts (uniform, Markov chains, context trees), gru, transformer, stacked (a GRU that
            weighs the forecasts of counts), combined (of what `effort` says, which is fitted for it). By default all;
            with effort fast counts, gru and combined.
        inputs: of the models: past actions alone; the context as well, where the plans have one; of gru, transformer
            and combined, durations: how long the last action took, beside the actions. Each in turn; durations, with
            which these take as long again, are left out by default.
        modes: numbers of hidden modes that are tried, such as `[1, 2, 3]`; None: no section on modes, which takes about
            as long for each number as the counts.
        skip: actions at the beginning of each plan that do not count in scores.
        effort: how much the combined prior spends on networks: fast (a GRU), standard (and a stacked prior) or full
            (and a transformer and a switching network).
        max_steps: gradient steps of a neural prior; None: by the plans, see `neuroprior.training.Settings`.
        num_actions: number of actions, where a file does not say.
        action_names: names of the actions in the order of their numbers, where a file does not say.
        columns: which columns of a CSV file hold what: action, plan, context, group, condition, start, stop, duration,
            event_type.
        missing: what rows without a label do: a gap ends the plan; as label they count as an action; or error.
        merge_repeats: take the same label in successive rows for one action, as in files with a row a frame.
        max_gap: a longer pause between two actions ends the plan, too; in the unit of the starts.
        seed: draws the folds and everything in training.
        processes: how many models are fitted at a time; all cores by default.
        dask: address of a Dask scheduler whose workers fit the models; None: this machine.
        sections: which to make, of `neuroprior.behaviour.report.sections.SECTIONS`; all by default.
        command: the command line that makes the report again, for the page.

    Returns:
        All that is printed and written; its `tables`, of which that of models is "plans", and its `figures`, such as
        "scores", "lags" and "transitions".

    Raises:
        ValueError: an argument is out of range, or the plans cannot be learned from or scored.
        OSError: a file cannot be read or written.

    Example:
        >>> plans = Plans(torch.randint(3, (20, 30), generator=torch.Generator().manual_seed(0)).sort(1).values, 3)
        >>> found = report(plans, models=["counts"], sections=["transitions"], folds=2, processes=1)
        >>> list(found.figures)
        ['transitions']
    """
    check_effort(effort)
    given_models = models
    models = (QUICK if effort == "fast" else MODELS) if models is None else models
    for name, given, known in (
        ("models", models, MODELS),
        ("inputs", inputs, INPUTS),
        ("sections", sections, SECTIONS),
    ):
        if isinstance(given, str):
            raise ValueError(f"{name}: a list is expected, such as [{given!r}], not a text")
        if not given or set(given) - set(known):
            raise ValueError(f"{name}: some of {', '.join(known)} are expected, not {', '.join(given) or 'none'}")
    if effort != "standard" and "combined" not in models:
        raise ValueError("effort: for the combined prior alone; add combined to models, or leave effort out")
    _check(skip, max_steps, seed, processes)
    for number in modes or ():
        check_sizes(modes=number)
    file = "" if isinstance(plans, Plans) else str(plans)
    if out is not None:
        check_place(Path(out), ["plans"] if "scores" in sections else [])  # before hours of work
    reading: dict[str, Any] = {"num_actions": num_actions, "action_names": action_names, "columns": columns}
    reading |= {"missing": missing, "merge_repeats": merge_repeats, "max_gap": max_gap}
    if priors is not None:
        of_fits: dict[str, Any] = {
            "test": test,
            "folds": folds,
            "models": given_models,
            "modes": modes,
            "max_steps": max_steps,
            "inputs": None if tuple(inputs) == INPUTS[:2] else inputs,
            "effort": None if effort == "standard" else effort,
        }
        if without := [name for name, value in of_fits.items() if value is not None]:
            raise ValueError(f"priors: they are scored on the plans as they are; leave {', '.join(without)} out")
        if isinstance(priors, Prior | str) or any(isinstance(one, Prior) for one in priors):
            raise ValueError("priors: a dict of fitted priors by name, or a list of folders, is expected")
        if not priors:
            raise ValueError("priors: at least one is expected")
        loaded = dict(priors) if isinstance(priors, Mapping) else {folder: load(folder) for folder in priors}
        table = is_table(file)
        names = action_names or (learned_names(next(iter(loaded.values()))) if table else None)
        found = evaluate_saved(loaded, _read(plans, reading | {"action_names": names}), skip, table)
        same = {} if isinstance(priors, Mapping) else {one: sum(learned_from(Path(one), found.plans)) for one in priors}
        if any(same.values()):
            found = replace(found, settings=found.settings | {"training data": {k: n for k, n in same.items() if n}})
    else:
        whole, empty = _with_actions(plans, reading)
        other, cut = None, False
        if test is not None:
            if not isinstance(test, Plans) and file and Path(test).resolve() == Path(file).resolve():
                raise ValueError("test: the very plans that are learned from; give others, or leave it out")
            if folds is not None:
                raise ValueError("folds: with test plans nothing is held out of the others; leave folds out")
            other, empty = _with_actions(test, reading)
            other = _numbered_alike(whole, other, "test" if isinstance(test, Plans) else str(test))
        whole, other = _contexts_from_0(whole, other)
        learned, cut = _in_parts(whole)
        if other is not None:
            other, cut = _in_parts(other)
        number = 1 if other is not None else _folds(file or "plans", learned, folds)
        design = Design(number, seed, skip, max_steps, effort, cut=cut)
        kinds: list[str] = [*models]
        if "lags" in sections:
            kinds += LAGS if set(models) != {"counts"} else LAGS[:1]
        given = [ACTIONS] * ("actions" in inputs) + [CONTEXT] * ("context" in inputs and learned.context is not None)
        if "durations" in inputs:
            if any(some.durations is None for some in (learned, other) if some is not None):
                raise ValueError("inputs: the plans have no durations; leave durations out")
            if not set(kinds) & set(OF_FEATURES):
                raise ValueError(f"inputs: durations are an input of {', '.join(OF_FEATURES)}; add one to models")
            given.append(DURATIONS)
        if not given:
            raise ValueError("inputs: the plans have no context; leave context out")
        left = int(counted(learned if other is None else other, skip, cut).sum())
        if left < FEWEST_UNITS:
            raise ValueError(f"skip: {left} actions are left to score after the first {skip} of each plan")
        if out is not None:
            Path(out).mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory() as temporary:
            run = cross_validation(Path(out or temporary), learned, other, design)
            todo = jobs(design, kinds, given)
            results = run.do(todo, processes=processes, dask=dask, title="fits")
        found = evaluate(learned, other, design, todo, results)
        settings: dict[str, Any] = {"models": ", ".join(kinds)} | found.settings
        settings |= {} if modes is None else {"modes": sorted(set(modes))}
        settings |= {"plans without actions, left out": empty} if empty else {}
        settings |= {} if test is None else {"test": str(test) if not isinstance(test, Plans) else "plans"}
        found = replace(found, plans=whole, settings=settings)
    document = _document(found, sections, file, command)
    if out is not None:
        write_document(document, Path(out))
    return document


def _document(found: Evaluation, sections: Sequence[str], file: str, command: str) -> Document:
    made = []
    # Its steps are small: on a busy machine several threads would wait for one another.
    with Progress("report", len(sections), len(sections)) as progress, one_thread():
        for name in [name for name in SECTIONS if name in sections]:
            part = SECTIONS[name](found)
            made += [] if part is None else [part]
            progress.advance(name)
    facts = describe(found.plans)
    return Document(
        title=f"Plans in {Path(file).name}" if file else "Plans",
        lead=" ".join([_lead(found), *(part.section.text[0] for part in made if part.section.title == "Conditions")]),
        sections=[part.section for part in made],
        frames={name: frame for part in made for name, frame in part.frames.items()},
        settings=found.settings,
        command=command,
        results={
            "reference": found.reference[1],
            "unit": found.unit,
            "file": {"name": file, **facts, "sees": facts["context"]},
        },
        keys={"plans": "rows"},
        former_names={"context": "sees"},
    )


def _lead(found: Evaluation) -> str:
    """The finding: the model that takes the fewest bits, which is called the best where there are enough units."""
    learned = found.settings.get("training data", {})
    same = "; ".join(
        f"{name} has learned from {number:,} of the {len(found.plans):,} plans" for name, number in learned.items()
    )
    return f"{_finding(found)} These are training data: {same}." if learned else _finding(found)


def _finding(found: Evaluation) -> str:
    bits, low, high, _ = found.best.score.bits_per_action()
    interval = f"(95 % interval {low:.3f} to {high:.3f} over {found.unit})"
    if not found.too_few:
        return f"The best model, {found.best.label}, takes {bits:.3f} bits per action {interval}."
    fewest = "the fewest bits per action of all models, " if len(found.models) > 1 else "bits per action: "
    return f"{found.best.label} takes {fewest}{bits:.3f} {interval}; {found.too_few}."


def _check(skip: int, max_steps: int | None, seed: int, processes: int | None) -> None:
    """Raise ValueError, naming the argument, unless these can be."""
    for name, value, right, expected in (
        ("skip", skip, skip >= 0, "at least 0 is"),
        ("max_steps", max_steps, max_steps is None or max_steps >= 1, "at least 1 is"),
        ("seed", seed, 0 <= seed < 2**50, "an integer from 0 to 2**50 - 1 is"),
        ("processes", processes, processes is None or processes >= 1, "at least 1 is"),
    ):
        if not right:
            raise ValueError(f"{name}: {expected} expected, not {value}")


def _read(plans: Plans | str | Path, reading: Mapping[str, Any]) -> Plans:
    """The plans, without an end symbol; `reading`: further arguments of `read_plans`."""
    if not isinstance(plans, Plans):
        plans = read_plans(plans, **reading)
    elif given := [name for name, value in reading.items() if not (value is None or value is False or value == "gap")]:
        raise ValueError(f"{', '.join(given)}: for files only; plans have their own")
    return plans if plans.end is None else plans.without_end()


def _with_actions(plans: Plans | str | Path, reading: Mapping[str, Any]) -> tuple[Plans, int]:
    """The plans that have actions, and how many have none: these are of no use to models."""
    read, file = _read(plans, reading), "plans" if isinstance(plans, Plans) else plans
    if read.num_actions > MOST_ACTIONS:
        raise ValueError(
            f"{file}: action numbers go up to {read.num_actions - 1}; number the actions from 0, or write names"
        )
    some = read.mask().any(1)
    if not bool(some.any()):
        raise ValueError(f"{file}: no plan has an action")
    return read[some], int((~some).sum())


def _in_parts(plans: Plans) -> tuple[Plans, bool]:
    """The plans, a single one cut into consecutive parts; and whether it was."""
    if len(plans) > 1:
        return plans, False
    return in_parts(plans, min(BLOCKS, max(int(plans.mask().sum()) // 2, 1))), True


def _folds(name: str, plans: Plans, folds: int | None) -> int:
    """How many; by default no more than there are units."""
    groups = 0 if plans.group is None else len(plans.group.unique())
    units = groups if groups > 1 else len(plans)
    if units < 2:
        raise ValueError(f"{name}: at least two plans, or a single long one, are needed for cross-validation")
    number = min(FOLDS, units) if folds is None else folds
    check_count("folds", number, 0)
    if number > units:
        raise ValueError(f"folds: at most {units}, as many as there are groups or plans, are expected, not {number}")
    if number < 2:  # which a `Design` takes for test plans
        raise ValueError(f"folds: at least 2 are expected, not {number}")
    return number


def _contexts_from_0(plans: Plans, test: Plans | None) -> tuple[Plans, Plans | None]:
    """The plans with the contexts that occur numbered from 0, where they have no names: gaps make no model larger."""
    contexts = [some.context for some in (plans, test) if some is not None and some.context is not None]
    named = plans.context_names is not None or (test is not None and test.context_names is not None)
    if contexts and contexts[0].is_floating_point() and not contexts[0].shape[-1]:
        raise ValueError("context: it has no features; leave it out of the plans")
    if not contexts or named or contexts[0].is_floating_point():
        return plans, test
    present = torch.cat([context.flatten().long() for context in contexts]).unique()
    if int(present[0]) < 0:
        raise ValueError(f"context: numbers from 0 are expected, not {int(present[0])}")
    new = [torch.searchsorted(present, context.long().contiguous()) for context in contexts]
    return replace(plans, context=new[0]), None if test is None else replace(test, context=new[-1])


def _numbered_alike(plans: Plans, test: Plans, name: str) -> Plans:
    """The test plans with actions and contexts numbered as in those that are learned from."""
    of_plans, of_test = _kind_of_context(plans), _kind_of_context(test)
    if of_plans != of_test:
        raise ValueError(f"{name}: {of_test}, but {of_plans} in the plans to learn from")
    if test.num_actions > plans.num_actions and (test.action_names is None or plans.action_names is None):
        raise ValueError(f"{name}: {test.num_actions} actions, but {plans.num_actions} in the plans to learn from")
    return renumbered(test, plans.num_actions, plans.action_names, plans.context_names, name)


def _kind_of_context(plans: Plans) -> str:
    if plans.context is None:
        return "no context"
    return f"{plans.context.shape[-1]} features" if plans.context.is_floating_point() else "context indices"
