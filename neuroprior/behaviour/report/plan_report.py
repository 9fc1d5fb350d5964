"""The report on plans: which models predict them best, how far back they reach, what is typical of them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from neuroprior._checks import check_count
from neuroprior._jobs import Progress
from neuroprior._threads import one_thread
from neuroprior.behaviour.durations.past_durations import PastDurations
from neuroprior.behaviour.reading.read import read_recordings
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.recordings import Recordings
from neuroprior.behaviour.report.document import Document, check_place, write_document
from neuroprior.behaviour.report.fits import ACTIONS, CONTEXT, DURATIONS, LAGS, OF_FEATURES, Design, counted
from neuroprior.behaviour.report.options import Files, FitOptions, ReadOptions, check_choices, is_recording, name_files
from neuroprior.behaviour.report.scores import Evaluation, cross_validation, evaluate, evaluate_saved, jobs
from neuroprior.behaviour.report.sections import SECTIONS, describe
from neuroprior.plans import Plans
from neuroprior.plans.folds import BLOCKS, FEWEST_UNITS, in_parts
from neuroprior.plans.plans import AnyPlans
from neuroprior.priors import Prior, load
from neuroprior.priors.matching import learned_names, renumbered
from neuroprior.priors.scoring import learned_from

MOST_ACTIONS = 10_000
"""Kinds of actions beyond which they are thought to be names that look like numbers."""

KEYS = {"plans": "rows"}
"""The keys of tables in `results.json`, where they are others than the names of the CSV files."""

FOLDS = 5
"""Folds where their number is not given; fewer where there are fewer groups."""


def report(
    plans: Plans | Recordings | Files,
    *,
    out: str | Path | None = None,
    priors: Mapping[str, Prior] | Sequence[str] | None = None,
    test: Plans | Recordings | Files | None = None,
    skip: int = 0,
    fits: FitOptions = FitOptions(),  # noqa: B008
    reading: ReadOptions | None = None,
    sections: Sequence[str] = tuple(SECTIONS),
    command: str = "",
) -> Document:
    """Report on plans: which models predict them best, how far back they reach, what is typical of them.

    Args:
        plans: recordings, their files (see `neuroprior.behaviour.read`), or executed plans; a file of plans, `.npz`,
            `.jsonl`, or `minari:` and the name of a Minari dataset.
        out: folder for `report.html`, `results.json`, tables as CSV, and the finished fits of a cross-validation, with
            which an interrupted one goes on; None: nothing is written.
        priors: score these fitted priors only, given by name or by their folders; the first is the reference.
        test: learn from the plans and score on these, or on those of this file, in place of cross-validation.
        skip: actions at the beginning of each plan that do not count in scores.
        fits: which models are fitted, and how.
        reading: how files are read; None for plans in memory.
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
        >>> fits = FitOptions(models=["counts"], folds=2, processes=1)
        >>> found = report(plans, fits=fits, sections=["transitions"])
        >>> list(found.figures)
        ['transitions']
    """
    check_choices("sections", sections, tuple(SECTIONS))
    check_count("skip", skip, 0)
    if reading is not None and isinstance(plans, Plans) and (test is None or isinstance(test, Plans)):
        raise ValueError("`reading` must be left out for plans in memory.")
    reading = reading or ReadOptions()
    file = "" if isinstance(plans, Plans | Recordings) else name_files(plans)
    if out is not None:
        check_place(Path(out), ["plans"] if "scores" in sections else [], KEYS)  # before hours of work
    files = plans
    if not isinstance(plans, Plans | Recordings) and is_recording(plans):
        plans = read_recordings(plans, reading)
    if priors is None:
        _check_other_files(files, test)
        found = _cross_validate(plans, test, skip, fits, reading, out, "lags" in sections)
    else:
        if given := fits.changed() + ["test"] * (test is not None):
            names = ", ".join(f"`{name}`" for name in given)
            raise ValueError(f"{names} must be left out where `priors` are given, which are not fitted.")
        found = _score_saved(plans, priors, skip, reading)
    found = replace(found, recordings=plans if isinstance(plans, Recordings) else None)
    document = _document(found, sections, file, command)
    if out is not None:
        write_document(document, Path(out))
    return document


def _score_saved(
    plans: Plans | Recordings | Files, priors: Mapping[str, Prior] | Sequence[str], skip: int, reading: ReadOptions
) -> Evaluation:
    """Score fitted priors on plans, and note which of these they have learned from."""
    if isinstance(priors, Prior | str) or not priors or any(isinstance(one, Prior) for one in priors):
        raise ValueError("`priors` must be a dict of fitted priors by name, or a list of folders, with one at least.")
    loaded = dict(priors) if isinstance(priors, Mapping) else {folder: load(folder) for folder in priors}
    folders = [] if isinstance(priors, Mapping) else [*priors]
    past = {folder: one for folder in folders if (one := PastDurations.load(Path(folder))) is not None}
    table = isinstance(plans, Recordings) or (not isinstance(plans, Plans) and is_recording(plans))
    if table and reading.action_names is None:
        reading = replace(reading, action_names=learned_names(next(iter(loaded.values()))))
    found = evaluate_saved(loaded, _read(plans, reading), skip, table, past)
    known = {folder: sum(learned_from(Path(folder), found.plans)) for folder in folders}
    if not any(known.values()):
        return found
    return replace(found, settings=found.settings | {"training data": {name: n for name, n in known.items() if n}})


def _cross_validate(
    plans: Plans | Recordings | Files,
    test: Plans | Recordings | Files | None,
    skip: int,
    fits: FitOptions,
    reading: ReadOptions,
    out: str | Path | None,
    with_lags: bool,
) -> Evaluation:
    """Fit models to plans, and score them on those held out, or on `test`; finished fits are kept in `out`."""
    if test is not None and fits.folds is not None:
        raise ValueError("`folds` must be left out where there are `test` plans, for which nothing is held out.")
    whole, empty = _with_actions(plans, reading)
    other, cut = None, False
    if test is not None:
        other, empty = _with_actions(test, reading)
        other = _numbered_alike(whole, other, "test" if isinstance(test, Plans) else str(test))
    whole, other = _contexts_from_0(whole, other)
    learned, cut = _in_parts(whole)
    if other is not None:
        other, cut = _in_parts(other)
    scored = learned if other is None else other
    number = 1 if other is not None else _folds(_name(plans), learned, fits)
    design = Design(number, fits.seed, skip, fits.max_steps, fits.effort, cut=cut)
    kinds: list[str] = [*fits.kinds]
    if with_lags:
        kinds += LAGS if set(kinds) != {"counts"} else LAGS[:1]
    inputs = _inputs(fits, kinds, learned, scored)
    left = int(counted(scored, skip, cut).sum())
    if left < FEWEST_UNITS:
        raise ValueError(
            f"`skip` must leave at least {FEWEST_UNITS} actions to score, got {skip}, which leaves {left}."
        )
    if out is not None:
        Path(out).mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as temporary:
        run = cross_validation(Path(out or temporary), learned, other, design)
        todo = jobs(design, kinds, inputs)
        results = run.do(todo, processes=fits.processes, dask=fits.dask, title="fits")
    found = evaluate(learned, other, design, todo, results)
    settings: dict[str, Any] = {"models": ", ".join(kinds)} | found.settings
    settings |= {} if fits.modes is None else {"modes": sorted(set(fits.modes))}
    settings |= {"plans without actions, left out": empty} if empty else {}
    settings |= {} if test is None else {"test": _name(test)}
    return replace(found, plans=whole, settings=settings)


def _inputs(fits: FitOptions, kinds: Sequence[str], learned: RecordedPlans, scored: RecordedPlans) -> list[str]:
    """The inputs that plans have of those that are asked for."""
    found = [ACTIONS] * ("actions" in fits.inputs)
    found += [CONTEXT] * ("context" in fits.inputs and learned.context is not None)
    if "durations" in fits.inputs:
        if learned.durations is None or scored.durations is None:
            raise ValueError("`inputs` must not hold durations where plans have none.")
        if not set(kinds) & set(OF_FEATURES):
            raise ValueError(f"`models` must hold one of {', '.join(OF_FEATURES)}, of which durations are an input.")
        found.append(DURATIONS)
    if not found:
        raise ValueError("`inputs` must hold more than the context where plans have none.")
    return found


def _document(found: Evaluation, sections: Sequence[str], file: str, command: str) -> Document:
    made = []
    # Its steps are small: on a busy machine several threads would wait for one another.
    with Progress("report", len(sections), len(sections)) as progress, one_thread():
        for name in [name for name in SECTIONS if name in sections]:
            part = SECTIONS[name](found)
            made += [] if part is None else [part]
            progress.advance(name)
    return Document(
        title=f"Plans in {file}" if file else "Plans",
        lead=" ".join([_lead(found), *(part.section.text[0] for part in made if part.section.title == "Conditions")]),
        sections=[part.section for part in made],
        frames={name: frame for part in made for name, frame in part.frames.items()},
        settings=found.settings,
        command=command,
        results={
            "reference": found.reference[1],
            "unit": found.unit,
            "file": {"name": file, **describe(found.plans)},
        },
        keys=KEYS,
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


def _check_other_files(files: Plans | Recordings | Files, test: Plans | Recordings | Files | None) -> None:
    """Raise ValueError where the plans to score are those to learn from."""
    paths = [
        Path(one).resolve()
        for some in (files, test)
        for one in ([some] if isinstance(some, str | Path) else some if isinstance(some, list | tuple) else [])
    ]
    if len(set(paths)) < len(paths):
        raise ValueError(f"`test` must be other plans than those that are learned from, got {test}.")


def _name(plans: Plans | Recordings | Files) -> str:
    """What messages call the plans: by their files, where they have any."""
    if isinstance(plans, Recordings):
        return name_files([source.name for source in plans.sources] or ["recordings"])
    return "plans" if isinstance(plans, Plans) else name_files(plans)


def _read(plans: Plans | Recordings | Files, reading: ReadOptions) -> RecordedPlans:
    """The plans, without an end symbol."""
    if isinstance(plans, Recordings):
        plans = reading.plans(plans)
    plans = RecordedPlans.of(plans) if isinstance(plans, Plans) else reading.read(plans)
    return plans if plans.end is None else plans.without_end()


def _with_actions(plans: Plans | Recordings | Files, reading: ReadOptions) -> tuple[RecordedPlans, int]:
    """The plans that have actions, and how many have none: these are of no use to models."""
    read, file = _read(plans, reading), _name(plans)
    if read.num_actions > MOST_ACTIONS:
        raise ValueError(
            f"{file}: action numbers go up to {read.num_actions - 1}; number the actions from 0, or write names"
        )
    some = read.mask().any(1)
    if not bool(some.any()):
        raise ValueError(f"{file}: no plan has an action")
    return read[some], int((~some).sum())


def _in_parts(plans: AnyPlans) -> tuple[AnyPlans, bool]:
    """The plans, a single one cut into consecutive parts; and whether it was."""
    if len(plans) > 1:
        return plans, False
    return in_parts(plans, min(BLOCKS, max(int(plans.mask().sum()) // 2, 1))), True


def _folds(name: str, plans: Plans, fits: FitOptions) -> int:
    """How many; by default no more than there are units."""
    groups = 0 if plans.group is None else len(plans.group.unique())
    units = groups if groups > 1 else len(plans)
    if units < 2:
        raise ValueError(f"{name}: at least two plans, or a single long one, are needed for cross-validation")
    number = min(FOLDS, units) if fits.folds is None else fits.folds
    if not 2 <= number <= units:  # a `Design` takes 1 for test plans
        raise ValueError(f"`folds` must be from 2 to {units}, the number of groups or plans, got {number}.")
    return number


def _contexts_from_0(plans: AnyPlans, test: AnyPlans | None) -> tuple[AnyPlans, AnyPlans | None]:
    """The plans with the contexts that occur numbered from 0, where they have no names: gaps make no model larger."""
    contexts = [some.context for some in (plans, test) if some is not None and some.context is not None]
    named = plans.context_names is not None or (test is not None and test.context_names is not None)
    if contexts and contexts[0].is_floating_point() and not contexts[0].shape[-1]:
        raise ValueError("`context` must have one feature at least, or be left out.")
    if not contexts or named or contexts[0].is_floating_point():
        return plans, test
    present = torch.cat([context.flatten().long() for context in contexts]).unique()
    if int(present[0]) < 0:
        raise ValueError(f"`context` must be numbers from 0, got {int(present[0])}.")
    new = [torch.searchsorted(present, context.long().contiguous()) for context in contexts]
    return replace(plans, context=new[0]), None if test is None else replace(test, context=new[-1])


def _numbered_alike(plans: Plans, test: AnyPlans, name: str) -> AnyPlans:
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
