"""Models scored on held-out plans: by cross-validation, or saved priors on plans that they have not learned from."""

import errno
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from math import log
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from neuroprior._files import written_whole
from neuroprior._jobs import JobRun
from neuroprior.behaviour.analysis.comparison import (
    ACTIONS,
    CONTEXT,
    DURATIONS,
    Score,
    action_bits,
    score_bits,
    too_few,
    unit_name,
)
from neuroprior.behaviour.analysis.transitions import Transitions, transitions
from neuroprior.behaviour.durations.past_durations import PastDurations
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.recordings import Recordings
from neuroprior.behaviour.reporting import fits
from neuroprior.behaviour.reporting.fits import (
    COMBINED,
    COUNTED,
    KINDS,
    LAGS,
    OF_FEATURES,
    WITH,
    Arrays,
    Design,
    Job,
    counted,
    split,
)
from neuroprior.plans.sequences import plans_digest
from neuroprior.priors import Prior
from neuroprior.priors.ensembles.candidates import ORDERS
from neuroprior.priors.matching import match_plans, numbered_note, with_contexts_of

ORDERED = ["uniform", *(f"markov-{order}" for order in ORDERS)]
ORDERED += ["context tree", "gru", "transformer", "stacked", COMBINED]
"""The models of a cross-validation in the order of the main table."""


@dataclass(frozen=True, eq=False)
class Model:
    """A model that was scored on held-out plans."""

    name: str  # such as "markov-3"
    inputs: str  # `ACTIONS`, `CONTEXT` or `DURATIONS`
    how: str  # its settings in each fold, the distinct ones
    bits: Tensor  # [N, L]: those of each held-out action (and of the ends, where it predicts these too)
    score: Score  # their sums by independent unit

    @property
    def label(self) -> str:
        """Its name with its input, in figures and sentences."""
        return self.name + WITH[self.inputs]

    @property
    def cost(self) -> float:
        """Bits per action."""
        return self.score.bits_per_action().mean


@dataclass(frozen=True, eq=False)
class Evaluation:
    """All that a report is made of."""

    plans: RecordedPlans  # those that are described
    scored: RecordedPlans  # those on which models were scored, N of them
    mask: Tensor  # [N, L] bool: their actions that count
    models: Sequence[Model]  # in the order of the main table
    reference: tuple[Model, str] | None  # the model that the others are compared with, and its name; None: no models
    first_fold: RecordedPlans  # the plans that are held out in the first fold
    gains: pd.DataFrame  # the information by lag that models give
    settings: dict[str, Any]  # how it was made
    promises: Mapping[str, float] = field(default_factory=dict)  # bits per action, of networks that were not trained
    recordings: Recordings | None = None  # that the plans are fragments of

    @cached_property
    def transitions(self) -> Transitions:
        """The transitions of the groups, with their test; the same file gives the same."""
        return transitions(self.plans, generator=torch.Generator().manual_seed(0))

    @property
    def unit(self) -> str:
        """What intervals go over."""
        return "parts of the sequence" if self.settings.get("cut") else unit_name(self.scored, self.mask)

    @property
    def too_few(self) -> str:
        """Why no model is called better than another; "" where there are enough independent units."""
        return too_few(self.scored, self.mask, bool(self.settings.get("cut")))

    @property
    def best(self) -> Model:
        """The model that takes the fewest bits."""
        return min(self.models, key=lambda model: model.cost)

    def table(self) -> pd.DataFrame:
        """A row a model: bits, nats and perplexity with intervals, and the paired difference from the reference."""
        assert self.reference is not None
        rows = []
        for model in self.models:
            bits, low, high, _ = model.score.bits_per_action()
            row = {"model": model.name, "input": model.inputs, "bits_per_behaviour": bits, "low": low, "high": high}
            for end, value in (("_per_behaviour", bits), ("_low", low), ("_high", high)):
                row["nats" + end] = value * log(2)
            for end, value in (("", bits), ("_low", low), ("_high", high)):
                row["perplexity" + end] = 2**value
            reference = self.reference[0].score
            # Where one predicts the ends of plans too and the other does not, there is no difference.
            same = len(model.score.bits) == len(reference.bits) and model.score.actions.equal(reference.actions)
            gap = model.score.minus(reference) if same else (None,) * 4
            rows.append(row | dict(zip(("more", "more_low", "more_high", "p_value"), gap, strict=True)))
        return pd.DataFrame(rows).assign(how=[model.how for model in self.models])


def cross_validation(
    folder: Path, plans: RecordedPlans, test: RecordedPlans | None, design: Design
) -> JobRun[Job, Arrays]:
    """The jobs of a cross-validation, whose results are kept below `folder` by the plans and the design."""
    asked = {"plans": plans_digest(plans), "test": None if test is None else plans_digest(test), **asdict(design)}
    run = partial(fits.fit_and_score, plans, test, design)
    return JobRun(run, folder / "folds", asked, save=save_arrays, load=load_arrays, suffix=".npz")


def jobs(design: Design, kinds: Iterable[str], inputs: Iterable[str]) -> list[Job]:
    """What there is to do: the slowest first, so that no process is left alone with one at the end."""
    kinds, inputs = set(kinds), list(inputs)
    kinds -= design.experts if COMBINED in kinds else set()
    return [
        Job(fold, kind, each)
        for kind in KINDS
        if kind in kinds
        for fold in range(1 if kind in LAGS else design.folds)
        for each in reversed(inputs)
        if each != DURATIONS or kind in OF_FEATURES
    ]


def evaluate(
    plans: RecordedPlans, test: RecordedPlans | None, design: Design, todo: Sequence[Job], job_arrays: list[Arrays]
) -> Evaluation:
    """The results of finished jobs, put together."""
    scored = plans if test is None else test
    mask = counted(scored, design.skip, design.cut)
    held_out = [split(plans, test, design, fold)[1] for fold in range(design.folds)]
    models, gains, promises = [], [], dict[str, float]()
    results: dict[tuple[str, str], list[Arrays]] = {}
    for job, arrays in zip(todo, job_arrays, strict=True):
        results.setdefault((job.kind, job.inputs), []).append(arrays)
    for (kind, inputs), by_fold in results.items():
        if kind in LAGS:
            gains += _gains(by_fold[0], inputs)
            continue
        for key, value in (item for arrays in by_fold for item in arrays.items() if item[0].endswith("/promise")):
            name = key.removesuffix("/promise") + WITH[inputs]
            promises[name] = max(float(value) / log(2), promises.get(name, 0.0))
        for name in [key.removesuffix("/how") for key in by_fold[0] if key.endswith("/how")]:
            parts = [{key.removeprefix(f"{name}/"): array for key, array in arrays.items()} for arrays in by_fold]
            # A chain may be too large for its tables in some folds.
            if all("how" in fold_arrays for fold_arrays in parts):
                how = ", ".join(filter(None, dict.fromkeys(str(fold_arrays["how"]) for fold_arrays in parts)))
                bits = torch.zeros(scored.actions.shape)
                for index, fold_arrays in zip(held_out, parts, strict=True):
                    bits[index] = torch.from_numpy(fold_arrays["bits"])
                models.append(Model(name, inputs, how, bits, score_bits(name, inputs, bits, scored, mask)))
    models.sort(key=lambda model: ([*WITH].index(model.inputs), ORDERED.index(model.name)))
    best = min(models, key=lambda model: model.cost, default=None)
    gains.sort(key=lambda row: (row["input"] == CONTEXT, row["model"] != COUNTED))
    table = pd.DataFrame(gains)
    reference = None if best is None else (best, best.label)
    return Evaluation(plans, scored, mask, models, reference, scored[held_out[0]], table, asdict(design), promises)


def _gains(arrays: Arrays, inputs: str) -> list[dict[str, Any]]:
    """What the action k steps back adds to the nearer ones: by counts and by a neural prior."""
    rows = []
    for name in (COUNTED, "gru"):
        if f"{name}/bits" not in arrays:
            continue
        pairs = zip(*(torch.from_numpy(arrays[f"{name}/{what}"]) for what in ("bits", "actions")), strict=True)
        scores = [Score(name, inputs, bits, actions) for bits, actions in pairs]
        for lag in range(1, len(scores)):
            bits, low, high, _ = scores[lag - 1].minus(scores[lag])
            row = {"what": "gain", "model": name, "input": inputs, "lag": lag, "bits": bits, "low": low, "high": high}
            rows.append(row | {"units": len(scores[lag].actions)})
    return rows


def evaluate_saved(
    priors: Mapping[str, Prior],
    plans: RecordedPlans,
    skip: int,
    is_table: bool = False,
    past_durations: Mapping[str, PastDurations] | None = None,
) -> Evaluation:
    """Fitted priors, scored on plans whose actions and contexts they know by name, else by number, which is noted.

    Args:
        priors: by name.
        plans: to score.
        skip: actions at the beginning of each plan that do not count.
        is_table: whether the plans were read from a table (CSV), in which names of contexts may be numbers.
        past_durations: of those priors that were trained with durations as features, by their names.

    Raises:
        ValueError: a prior does not know these actions or contexts; the message has its name.
    """
    models, notes = [], list(plans.notes)
    for name, prior in priors.items():
        with_contexts, said = with_contexts_of(prior, plans, is_table)
        if plans.action_names and prior.action_names is None:
            said.append(numbered_note("actions", plans.action_names))
        notes += [f"{name}: {one}" for one in said]
        matched = match_plans(with_contexts, prior, name)
        inputs = CONTEXT if prior.takes_context else ACTIONS
        if past_durations is not None and name in past_durations:
            matched, inputs = past_durations[name].added_to(matched), DURATIONS
        mask = counted(matched, skip)
        try:
            bits = action_bits(prior, matched)
            models.append(
                Model(name, inputs, type(prior).__name__, bits, score_bits(name, inputs, bits, matched, mask))
            )
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    plans, mask = replace(plans, notes=notes), counted(plans, skip)
    settings = {"priors": ", ".join(priors), "skip": skip, "unit": unit_name(plans, mask)}
    return Evaluation(plans, plans, mask, models, (models[0], models[0].name), plans, pd.DataFrame(), settings)


def save_arrays(path: Path, arrays: Arrays) -> None:
    """Write the result of a job."""
    with written_whole(path, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def load_arrays(path: Path) -> Arrays:
    """Read the result of a job; ValueError for a damaged file."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    except MemoryError:
        raise
    except OSError as error:
        if error.errno != errno.EINVAL:  # else a place in the file that is not there
            raise
        raise ValueError(str(error)) from error
    except Exception as error:  # from wherever in the archive it is damaged: zlib's, the tokenizer's, ...
        raise ValueError(str(error)) from error
