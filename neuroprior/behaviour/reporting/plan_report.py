"""The report on plans: which models predict them best, how far back they reach, what is typical of them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any, NamedTuple

import torch

from neuroprior._checks import check_choices, check_count
from neuroprior._folders import claim, claim_out
from neuroprior._jobs import Progress, in_words, saying
from neuroprior._threads import one_thread
from neuroprior.behaviour.analysis.comparison import ACTIONS, CONTEXT, DURATIONS
from neuroprior.behaviour.durations.past_durations import PastDurations
from neuroprior.behaviour.reading.read import read_recordings
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.recordings import Recordings
from neuroprior.behaviour.reporting.document import (
    PAGE,
    RESULTS,
    Document,
    FigureKind,
    write_document,
    write_figures,
)
from neuroprior.behaviour.reporting.findings import headline
from neuroprior.behaviour.reporting.fits import (
    COMBINED,
    COSTS,
    COUNTS,
    LAGS,
    OF_FEATURES,
    Design,
    Job,
    counted,
    split,
    trained_networks,
)
from neuroprior.behaviour.reporting.options import (
    Files,
    FitOptions,
    ReadOptions,
    is_recording,
    name_files,
)
from neuroprior.behaviour.reporting.part import Part
from neuroprior.behaviour.reporting.scores import Evaluation, cross_validation, evaluate, evaluate_saved, jobs
from neuroprior.behaviour.reporting.sections import OF_MODELS, SECTIONS, describe
from neuroprior.plans import Plans
from neuroprior.plans.columns import listed
from neuroprior.plans.folds import BLOCKS, FEWEST_UNITS, FOLDS, in_parts
from neuroprior.plans.plans import AnyPlans
from neuroprior.priors import Prior, load
from neuroprior.priors.matching import learned_names, renumbered
from neuroprior.priors.scoring import LONG_ENOUGH, are_among, learned_from, plan_digests

MOST_ACTIONS = 10_000
"""Kinds of actions beyond which they are thought to be names that look like numbers."""

SECONDS_A_STATUS = 60
"""How often the page says anew how long networks take."""


@claim_out
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
    figures: FigureKind | None = None,
    command: str = "",
    each: Callable[[Document], None] = lambda document: None,
) -> Document:
    """Report on plans: what differs between conditions, which models predict them best, what is typical of them.

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
        sections: which to make, of `neuroprior.behaviour.reporting.sections.SECTIONS`; all by default.
        figures: also write each figure to `figures` below `out`, for papers: pdf, svg or png.
        command: the command line that makes the report again, for the page.
        each: is called with what needs no network as soon as this is written, and again as more is there.

    Returns:
        All that is printed and written; its `tables`, of which that of models is "scores", and its `figures`, such as
        "scores", "lags" and "transitions".

    Raises:
        ValueError: an argument is out of range, or the plans cannot be learned from or scored.
        OSError: a file cannot be read or written.

    Example:
        >>> plans = Plans(torch.randint(3, (20, 30), generator=torch.Generator().manual_seed(0)).sort(1).values, 3)
        >>> fits = FitOptions(models=["counts"], folds=2, processes=1)
        >>> document = report(plans, fits=fits, sections=["transitions"])
        >>> list(document.figures)
        ['transitions', 'transition_graph']
    """
    check_choices("sections", sections, tuple(SECTIONS))
    check_count("skip", skip, 0)
    if reading is not None and isinstance(plans, Plans) and (test is None or isinstance(test, Plans)):
        raise ValueError("`reading` must be left out for plans in memory.")
    reading = reading or ReadOptions()
    file = "" if isinstance(plans, Plans | Recordings) else name_files(plans)
    if out is not None:
        with claim(Path(out)) as claimed:
            claimed.check([RESULTS, PAGE, *(["plans.csv"] if "scores" in sections else [])])  # before hours of work
    files = plans
    if not isinstance(plans, Plans | Recordings) and is_recording(plans):
        with saying(f"reading {file}"):
            plans = read_recordings(plans, reading)
    if priors is None:
        _check_other_files(files, test)
        stages = _cross_validate(plans, test, skip, fits, reading, out, "lags" in sections)
    else:
        if changed := fits.changed() + ["test"] * (test is not None):
            names = ", ".join(f"`{name}`" for name in changed)
            raise ValueError(f"{names} must be left out where `priors` are given, which are not fitted.")
        stages = iter([_Stage(_score_saved(plans, priors, skip, reading), tuple(SECTIONS), "")])
    recordings = plans if isinstance(plans, Recordings) else None
    results, document, written = dict[str, Part | None](), None, monotonic()
    try:
        for stage in stages:
            evaluation = replace(stage.evaluation, recordings=recordings)
            if document is None or stage.sections:
                results |= _fill_sections(
                    evaluation, [name for name in SECTIONS if name in sections and name in stage.sections]
                )
                document = _document(evaluation, results, file, command, figures)
            elif monotonic() - written < SECONDS_A_STATUS:
                continue
            document, written = replace(document, status=stage.status), monotonic()
            if out is not None:
                _write(document, Path(out), figures)
            each(document)
    except BaseException as error:
        if document is not None and out is not None:
            interrupted = isinstance(error, KeyboardInterrupt)
            why = "Interrupted" if interrupted else f"Stopped by an error ({error})"
            stopped = f"{why}: models or modes are missing." + " The same command goes on." * interrupted
            _write(replace(document, status=stopped), Path(out), figures)
        raise
    assert document is not None
    return document


def _write(document: Document, folder: Path, figures: FigureKind | None) -> None:
    with claim(folder) as place:
        write_document(document, folder)
        if figures is not None and not document.status:
            place.add(f"figures/{name}.{figures}" for name in document.figures)
            write_figures(folder / "figures", document.figures, figures)


class _Stage(NamedTuple):
    """What was found so far, the sections that can be made of it, and what is still to come."""

    evaluation: Evaluation
    sections: Sequence[str]
    status: str


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
    evaluation = evaluate_saved(loaded, _read(plans, reading), skip, table, past)
    learned = {folder: sum(learned_from(Path(folder), evaluation.plans)) for folder in folders}
    if not any(learned.values()):
        return evaluation
    return replace(
        evaluation, settings=evaluation.settings | {"training data": {name: n for name, n in learned.items() if n}}
    )


def _cross_validate(
    plans: Plans | Recordings | Files,
    test: Plans | Recordings | Files | None,
    skip: int,
    fits: FitOptions,
    reading: ReadOptions,
    out: str | Path | None,
    with_lags: bool,
) -> Iterator[_Stage]:
    """Fit models to plans, and score them on those held out, or on `test`; finished fits are kept in `out`.

    Counts come first; then what needs no more than these can be shown.
    """
    if test is not None and fits.folds is not None:
        raise ValueError("`folds` must be left out where there are `test` plans, for which nothing is held out.")
    whole, empty = _drop_empty_plans(plans, reading)
    other, cut = None, False
    if test is not None:
        other, empty = _drop_empty_plans(test, reading)
        other = _number_alike(whole, other, "test" if isinstance(test, Plans) else str(test))
    whole, other = _contexts_from_0(whole, other)
    learned, cut = _cut_single_plan(whole)
    if other is not None:
        other, cut = _cut_single_plan(other)
    scored = learned if other is None else other
    number = 1 if other is not None else _folds(_name(plans), learned, fits)
    screened = fits.models is None and fits.effort != "full" and "durations" not in fits.inputs
    design = Design(number, fits.seed, skip, fits.max_steps, fits.effort, cut=cut, screened=screened)
    kinds: list[str] = [*fits.kinds]
    if with_lags:
        kinds += LAGS if set(kinds) != {"counts"} else LAGS[:1]
    inputs = _inputs(fits, kinds, learned, scored)
    scorable = int(counted(scored, skip, cut).sum())
    if scorable < FEWEST_UNITS:
        raise ValueError(
            f"`skip` must leave at least {FEWEST_UNITS} actions to score, got {skip}, which leaves {scorable}."
        )
    fewest = min(int(split(learned, other, design, fold)[0].mask().sum()) for fold in range(number))
    if fewest < 2 * FEWEST_UNITS:
        raise ValueError(
            f"{_name(plans)}: at least {2 * FEWEST_UNITS} actions to learn from are needed in each fold, got {fewest}"
        )
    settings: dict[str, Any] = {"models": ", ".join(kinds)}
    # Short plans may be equal by chance.
    again = 0 if other is None else sum(are_among(other, set(plan_digests(whole)), LONG_ENOUGH))
    todo = jobs(design, kinds, inputs)
    counts, networks = ([job for job in todo if (job.kind in COUNTS) == first] for first in (True, False))

    def evaluated(done: list[Job]) -> Evaluation:
        evaluation = evaluate(learned, other, design, done, run.results(done))
        more: dict[str, Any] = {} if fits.modes is None else {"modes": sorted(set(fits.modes))}
        more |= {"sequences without behaviours, left out": empty} if empty else {}
        more |= {} if test is None else {"test": _name(test)}
        more |= {"training data": {"each model": again}} if again else {}
        return replace(evaluation, plans=whole, settings=settings | evaluation.settings | more)

    def fitting(batch: list[Job]) -> Iterator[_Stage]:
        counting = batch and all(job.networks == () for job in batch)  # takes less time than starting processes
        how: dict[str, Any] = {"processes": 1 if counting else fits.processes, "dask": fits.dask, "title": "networks"}
        for seconds in run.each(batch, cost=lambda job: COSTS[job.kind], **how):
            yield _Stage(evaluation, (), _status(f"networks (about {in_words(seconds)} more)", *later[1:]))

    with TemporaryDirectory() as temporary:
        run = cross_validation(Path(out or temporary), learned, other, design)
        evaluation, modes = evaluated([]), "" if fits.modes is None else "hidden modes"
        at_once = [name for name in SECTIONS if name not in (*OF_MODELS, "modes")]
        later = ["networks"] * bool(networks) + [modes] * bool(modes)
        yield _Stage(evaluation, at_once, _status("counts", *later))
        for _ in run.each(counts, processes=1, dask=fits.dask, title="counts"):
            pass
        evaluation = evaluated(counts)
        yield _Stage(evaluation, OF_MODELS, _status(*later))
        if networks:
            # Screened, the first fold decides which networks are trained in the others.
            first = [job for job in networks if not screened or (job.kind == COMBINED and job.fold == 0)]
            yield from fitting(first)
            trained = {job.inputs: trained_networks(run.read(job)) for job in first}
            others = [
                replace(job, networks=trained[job.inputs] if job.kind == COMBINED else None)
                for job in networks
                if job not in first and (job.kind == COMBINED or trained[job.inputs])
            ]
            yield from fitting(others)
            evaluation = evaluated([*counts, *first, *others])
            yield _Stage(evaluation, (*OF_MODELS, *["durations"] * (DURATIONS in inputs)), _status(*later[1:]))
        if modes:
            yield _Stage(evaluation, ("modes",), "")


def _status(*later: str) -> str:
    """What is still to come, as a sentence."""
    return f"Still running: {listed(later)}." if later else ""


def _inputs(fits: FitOptions, kinds: Sequence[str], learned: RecordedPlans, scored: RecordedPlans) -> list[str]:
    """The inputs that plans have of those that are asked for."""
    inputs = [ACTIONS] * ("actions" in fits.inputs)
    inputs += [CONTEXT] * ("context" in fits.inputs and learned.context is not None)
    if "durations" in fits.inputs:
        if learned.durations is None or scored.durations is None:
            raise ValueError("`inputs` must not hold durations where plans have none.")
        if not set(kinds) & set(OF_FEATURES):
            raise ValueError(f"`models` must hold one of {', '.join(OF_FEATURES)}, of which durations are an input.")
        inputs.append(DURATIONS)
    if not inputs:
        raise ValueError("`inputs` must hold more than the context where plans have none.")
    return inputs


def _fill_sections(evaluation: Evaluation, names: Sequence[str]) -> dict[str, Part | None]:
    """These sections."""
    results = {}
    # Its steps are small: on a busy machine several threads would wait for one another.
    with Progress("report", len(names), len(names)) as progress, one_thread():
        for name in names:
            results[name] = SECTIONS[name](evaluation)
            progress.advance(name)
    return results


def _document(
    evaluation: Evaluation, results: Mapping[str, Part | None], file: str, command: str, figures: FigureKind | None
) -> Document:
    """The sections that were made, in the order of the page, below what they found."""
    shown = [result for name in SECTIONS if (result := results.get(name)) is not None]
    findings = [finding for result in shown for finding in result.findings]
    verdicts = [verdict for result in shown for verdict in result.verdicts]
    return Document(
        title=f"Report on {file}" if file else "Report",
        lead="",
        sections=[replace(result.section, files=_files(result, figures)) for result in shown],
        frames={name: frame for result in shown for name, frame in result.frames.items()},
        settings=evaluation.settings,
        command=command,
        results={
            "reference": None if evaluation.reference is None else evaluation.reference[1],
            "unit": evaluation.unit,
            "not_trained": dict(evaluation.promises),
            "file": {"name": file, **describe(evaluation.plans)},
            "findings": [finding.row() for finding in findings],
        },
        graphs={name: graph for result in shown for name, graph in result.graphs.items()},
        headline=headline([*verdicts, *_best_verdict(evaluation)], [result.findings for result in shown]),
    )


def _files(result: Part, figures: FigureKind | None) -> list[str]:
    """The files of a section's tables and figures."""
    tables = [f"{name}.csv" for name, frame in result.frames.items() if len(frame)]
    tables += [f"{name}.{ending}" for name in result.graphs for ending in ("graphml", "gv")]
    return tables + [f"figures/{box.name}.{figures}" for box in result.section.figures if figures is not None]


def _best_verdict(evaluation: Evaluation) -> list[str]:
    """The model that takes the fewest bits, which is called the best where there are enough units."""
    if not evaluation.models:
        return []
    learned = evaluation.settings.get("training data", {})
    same = "; ".join(
        f"{name} has learned from {number:,} of the {len(evaluation.scored):,} sequences"
        for name, number in learned.items()
    )
    return [f"{_best(evaluation)} These are training data: {same}." if learned else _best(evaluation)]


def _best(evaluation: Evaluation) -> str:
    bits, low, high, _ = evaluation.best.score.bits_per_action()
    interval = f"(95 % interval {low:.3f} to {high:.3f} over {evaluation.unit})"
    if not evaluation.too_few:
        return f"The best model, {evaluation.best.label}, takes {bits:.3f} bits per behaviour {interval}."
    fewest = "the fewest bits per behaviour of all models, " if len(evaluation.models) > 1 else "bits per behaviour: "
    return f"{evaluation.best.label} takes {fewest}{bits:.3f} {interval}; {evaluation.too_few}."


def _check_other_files(files: Plans | Recordings | Files, test: Plans | Recordings | Files | None) -> None:
    """Raise ValueError where the plans to score are those to learn from."""
    paths = [
        Path(one).resolve()
        for source in (files, test)
        for one in ([source] if isinstance(source, str | Path) else source if isinstance(source, list | tuple) else [])
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


def _drop_empty_plans(plans: Plans | Recordings | Files, reading: ReadOptions) -> tuple[RecordedPlans, int]:
    """The plans that have actions, and how many have none: these are of no use to models."""
    read, file = _read(plans, reading), _name(plans)
    if read.num_actions > MOST_ACTIONS:
        raise ValueError(
            f"{file}: action numbers go up to {read.num_actions - 1}; number the actions from 0, or write names"
        )
    acted = read.mask().any(1)
    if not bool(acted.any()):
        raise ValueError(f"{file}: no plan has an action")
    return read[acted], int((~acted).sum())


def _cut_single_plan(plans: AnyPlans) -> tuple[AnyPlans, bool]:
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
    contexts = [one.context for one in (plans, test) if one is not None and one.context is not None]
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


def _number_alike(plans: Plans, test: AnyPlans, name: str) -> AnyPlans:
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
