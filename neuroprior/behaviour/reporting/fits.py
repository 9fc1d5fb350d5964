"""One job of a cross-validation: models are fitted without a fold and scored on it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuroprior._version import __version__
from neuroprior.behaviour.analysis.comparison import (
    ACTIONS,
    CONTEXT,
    DURATIONS,
    Score,
    action_bits,
    baselines,
    score_bits,
)
from neuroprior.behaviour.analysis.lags import pieces
from neuroprior.behaviour.durations.past_durations import PastDurations
from neuroprior.plans import Plans
from neuroprior.plans.folds import FEWEST_UNITS, divisible, fair_split, folds, num_units
from neuroprior.plans.plans import AnyPlans
from neuroprior.priors import CombinedPrior, GRUPrior, MarkovPrior, Prior
from neuroprior.priors.construction import construct, context_arguments
from neuroprior.priors.counts import TooLargeError
from neuroprior.priors.ensembles.candidates import NETWORKS, OF_EFFORT, Effort, fitted_experts, number_tried
from neuroprior.priors.ensembles.screening import Screening
from neuroprior.priors.learning import plans_for, split_validation

Arrays = dict[str, np.ndarray[Any, Any]]

WITH = {ACTIONS: "", CONTEXT: ", with context", DURATIONS: ", with durations"}
"""The inputs in the order of tables, and what names of models say of them."""

COMBINED = "combined"
"""The combined prior."""

OF_FEATURES = (COMBINED, "transformer", "gru")
"""Jobs whose models can take features, such as past durations."""

KINDS = (COMBINED, "stacked", "transformer", "gru", "gru-lags", "lags", "counts")
"""What one job fits; the slowest first."""

LAGS = ("lags", "gru-lags")
"""Jobs of the information by lag, by counts and by a GRU; of one fold only."""

COUNTS = ("counts", "lags")
"""Jobs that need no network, and take seconds."""

COSTS = {COMBINED: 6.0, "stacked": 3.0, "transformer": 5.0, "gru": 2.0, "gru-lags": 3.0}
"""About how long jobs with networks take, compared with one another."""

COUNTED = "markov"
"""The count-based model of the information by lag; the other is the GRU."""

VALIDATION = 0.1
"""Share of the training plans on which the settings of count-based models are chosen."""

MOST_PIECES, PIECES_A_STEP = 20_000, 128
"""Bounds of what is cut into pieces, and of what is read in a step of training."""


@dataclass(frozen=True)
class Design:
    """All that decides the results of a cross-validation, beside the plans."""

    folds: int  # how many; 1: learn from some plans and score on others
    seed: int = 0  # draws the folds, and everything in training
    skip: int = 0  # actions at the beginning of each plan that are left out of the score
    max_steps: int | None = None  # gradient steps of neural priors; None: by the plans
    effort: Effort = "standard"  # of the combined prior
    reach: int = 16  # the most past actions whose information is measured
    cut: bool = False  # whether the plans are consecutive parts of a single one
    screened: bool = False  # whether networks are trained only where they promise to bring something in the first fold
    version: str = __version__  # of the library

    @property
    def training(self) -> dict[str, Any]:
        """How neural priors are trained."""
        return {"max_steps": self.max_steps, "progress": False}

    @property
    def experts(self) -> set[str]:
        """The models among the experts of the combined prior, which its job scores as well."""
        return set(OF_EFFORT[self.effort])


@dataclass(frozen=True)
class Job:
    """A fold, one of `KINDS`, and the input of its models: `ACTIONS`, `CONTEXT` or `DURATIONS`."""

    fold: int
    kind: str
    inputs: str
    networks: tuple[str, ...] | None = None  # that the combined prior trains; None: as the design says

    def __str__(self) -> str:
        return f"fold{self.fold}-{self.kind}{WITH[self.inputs].replace(', with ', '-')}"


def trained_networks(arrays: Arrays) -> tuple[str, ...]:
    """Return the names of the networks that a job trained."""
    return tuple(name for name in NETWORKS if f"{name}/how" in arrays)


def counted(plans: Plans, skip: int, cut: bool = False) -> Tensor:
    """`[N, L]` bool: all actions but the first `skip` of each plan; of parts of a single plan, but its first."""
    mask = plans.mask()
    if cut:
        place = mask.flatten().cumsum(0).view(mask.shape)
        return mask & (place > skip)
    mask[:, :skip] = False
    return mask


def split(plans: AnyPlans, test: Plans | None, design: Design, fold: int) -> tuple[AnyPlans, Tensor]:
    """The training plans of a fold, and the numbers of the plans that are scored."""
    if test is not None:
        return plans, torch.arange(len(test))
    training, held_out = folds(plans, design.folds, design.seed)[fold]
    return plans[training], held_out


def fit_and_score(plans: Plans, test: Plans | None, design: Design, job: Job) -> Arrays:
    """Fit the models of a job and score them on held-out plans, or on `test`.

    Returns:
        Arrays by the name of the model and what they are, such as "gru/bits". "how": its settings. "bits" `[n, L]`,
        float32: those of each held-out action. "promise": of a network that was not trained for it, the most nats per
        action that it might bring. Or, of `LAGS`, "bits" and "actions" `[J, U]`: those of the same actions with 0, 1,
        ... J - 1 past ones known, by independent unit.
    """
    learned, index = split(plans, test, design, job.fold)
    whole = plans if test is None else test
    scored = whole[index]
    if job.inputs != CONTEXT:
        learned, scored = (one.without_context() for one in (learned, scored))
    if job.inputs == DURATIONS:
        past = PastDurations.of(learned)
        learned, scored = past.added_to(learned), past.added_to(scored)
    seed = design.seed * 1000 + job.fold
    if job.kind in LAGS:
        return _score_lags(job.kind, learned, scored, design, seed)
    arrays: Arrays = {}
    for name, how, prior in _fit_models(job, learned, scored, design, seed):
        if isinstance(prior, Screening):
            arrays[f"{name}/promise"] = np.array(prior.gain)
            continue
        arrays |= {f"{name}/how": np.array(how), f"{name}/bits": action_bits(prior, scored).float().numpy()}
    return arrays


def _fit_models(
    job: Job, learned: Plans, scored: Plans, design: Design, seed: int
) -> Iterator[tuple[str, str, Prior | Screening]]:
    """The name, the settings and the prior of each model of a job, or what it promised in place of the prior."""
    sizes = context_arguments(learned, scored)
    learned, kind = divisible(learned), job.kind
    if "context_size" in sizes and kind in ("counts", "stacked"):
        return  # features cannot be counted
    generator = torch.Generator().manual_seed(seed)
    if kind == "counts":
        training, validation = fair_split(learned, VALIDATION, generator)
        if int(validation.mask().sum()) < FEWEST_UNITS:
            training, validation = learned.split(0.5, generator.manual_seed(seed))
        for baseline in baselines(training, validation, sizes.get("num_contexts"), always_context=True):
            if baseline.prior is not None:
                # Chosen on the validation plans; then these are learned from as well.
                yield baseline.model, baseline.how, baseline.prior.fit(plans_for(baseline.prior, learned))
    elif kind == COMBINED:
        training, validation = split_validation(learned, None, generator)
        networks = OF_EFFORT[design.effort] if job.networks is None and not design.screened else job.networks
        how = (design.effort, generator, design.training, networks)
        experts = fitted_experts(training, validation, sizes, *how)
        combined = construct(partial(CombinedPrior, experts=experts.fitted), learned.num_actions, sizes)
        assert isinstance(combined, CombinedPrior)
        combined.learn_weights(validation, number_tried(experts.fitted), training)
        for expert in experts.fitted:
            expert.recount(learned)
        for name, model in (experts.networks | experts.left_out).items():
            yield name, "", model
        yield COMBINED, combined.summary(), combined
    else:
        prior: Any = construct(NETWORKS[kind], learned.num_actions, sizes | {"seed": seed})
        yield kind, "", prior.fit(plans_for(prior, learned), generator=generator, **design.training)


def _score_lags(kind: str, learned: Plans, scored: Plans, design: Design, seed: int) -> Arrays:
    """The bits of the last actions of short pieces, with 0, 1, 2 and more of the actions before them known."""
    # At most half of what the median plan has, so that pieces stand anywhere in plans.
    halves = (int(plans.mask().sum(1).double().median()) // 2 for plans in (learned, scored))
    reach = min(design.reach, *halves)
    if reach < 1:
        return {}
    sizes = context_arguments(learned, scored)
    generator = torch.Generator().manual_seed(seed)
    late = scored.steps(0 if design.cut else max(design.skip - reach, 0))
    if int(late.mask().sum(1).max()) <= reach:
        return {}
    held_out = pieces(late, reach + 1, MOST_PIECES, generator)
    short = pieces(learned, reach + 1, MOST_PIECES * 5, generator)
    if held_out.group is None or num_units(held_out) < FEWEST_UNITS:
        return {}
    if kind == "gru-lags":
        name, neural = "gru", GRUPrior(learned.num_actions, seed=seed, **sizes)
        neural.fit(divisible(short), generator=generator, batch_size=PIECES_A_STEP, **design.training)
        scores = [_score_last(neural, held_out, num_past) for num_past in range(reach + 1)]
    elif "context_size" in sizes:
        return {}  # features cannot be counted
    else:
        name, scores = COUNTED, _chains(learned, held_out, reach, sizes.get("num_contexts"))
    return {f"{name}/{what}": np.stack([getattr(score, what) for score in scores]) for what in ("bits", "actions")}


def _chains(learned: Plans, held_out: Plans, reach: int, num_contexts: int | None) -> list[Score]:
    """The bits of the last action of pieces under a chain of order j, for each j.

    Each order is a prior of its own: in one of a high order the shorter histories only serve to back off to.
    """
    scores = []
    for order in range(reach + 1):
        chain = MarkovPrior(learned.num_actions, order, initial="lower", num_contexts=num_contexts)
        try:
            chain.fit(learned)
        except TooLargeError:
            break
        scores.append(_score_last(chain, held_out, order))
    return scores


def _score_last(prior: Prior, held_out: Plans, num_past: int) -> Score:
    """The bits of the last action of each piece, with so many before it known: the same actions whatever is known."""
    length = held_out.max_length
    bits = action_bits(prior, replace(held_out.steps(length - num_past - 1), lengths=None))
    return score_bits("", "", bits[:, -1:], replace(held_out.steps(length - 1), lengths=None))
