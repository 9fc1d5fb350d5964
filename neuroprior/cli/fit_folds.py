"""Cross-validation of `fit`: of few groups each is held out once, in place of one or two of them for good."""

from collections.abc import Mapping
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuroprior._jobs import JobRun
from neuroprior.behaviour.analysis.comparison import ACTIONS, CONTEXT, Score, action_bits, baselines, score_bits
from neuroprior.behaviour.reporting.fits import Arrays
from neuroprior.behaviour.reporting.scores import load_arrays, save_arrays
from neuroprior.cli.fit_data import Parts
from neuroprior.plans import Plans
from neuroprior.plans.folds import divisible, fair_split, folds
from neuroprior.plans.sequences import plans_digest
from neuroprior.priors import CombinedPrior, Prior
from neuroprior.priors.learning import plans_for

TRAINED = "trained"
"""The recipe's prior among the models of a fold."""


def cross_validated(
    folder: Path, prior: Prior, settings: Mapping[str, Any], data: Parts, num_contexts: int | None
) -> dict[str, Score]:
    """Score a prior and the baselines on all plans, each fold under a fit without it.

    Args:
        folder: of the run; finished folds are kept below it.
        prior: the recipe's, before training.
        settings: of its `fit`.
        data: the plans, and the number of folds.
        num_contexts: of the baselines; None: they take no context.

    Returns:
        The score of each model that could be fitted in all folds; of the prior under `TRAINED`.

    Raises:
        ValueError: plans of a fold that cannot be learned from.
        KeyboardInterrupt: finished folds are kept.
    """
    fit = partial(_fit_and_score, prior, dict(settings), data, num_contexts)
    asked = {"plans": plans_digest(data.plans), "prior": repr(prior), "settings": dict(settings), "seed": data.seed}
    asked |= {"folds": data.folds, "validation": data.validation, "num_contexts": num_contexts}
    run = JobRun(fit, folder / "folds", asked, name="fold{}".format, save=save_arrays, load=load_arrays, suffix=".npz")
    # Counting takes less time than starting processes; and these cannot share a GPU's memory.
    counts = not prior.fit_settings or (isinstance(prior, CombinedPrior) and prior.networks == ())
    alone = counts or prior.device.type != "cpu"
    fold_arrays = run.do(range(data.folds), processes=1 if alone else None, title="folds")
    held_out = [index for _, index in folds(data.plans, data.folds, data.seed)]
    scores = {}
    for name in [key.removesuffix("/bits") for key in fold_arrays[0] if key.endswith("/bits")]:
        if all(f"{name}/bits" in arrays for arrays in fold_arrays):  # one may be too large for its tables in some folds
            bits = torch.zeros(data.plans.actions.shape, dtype=torch.double)
            for index, arrays in zip(held_out, fold_arrays, strict=True):
                bits[index] = torch.from_numpy(arrays[f"{name}/bits"])
            takes = any(bool(arrays[f"{name}/context"]) for arrays in fold_arrays)
            scores[name] = score_bits(name, CONTEXT if takes else ACTIONS, bits, data.plans)
    return scores


def _fit_and_score(fresh: Prior, settings: dict[str, Any], data: Parts, num_contexts: int | None, fold: int) -> Arrays:
    """The bits of the held-out actions under each model, and whether it takes the context, by its name."""
    training, index = folds(data.plans, data.folds, data.seed)[fold]
    learned, held_out = divisible(data.plans[training]), data.plans[index]
    generator = torch.Generator().manual_seed(data.seed * 1000 + fold)
    prior = deepcopy(fresh).fit(plans_for(fresh, learned), generator=generator, **settings)
    arrays = _arrays(TRAINED, prior, held_out)
    for baseline in baselines(*fair_split(learned, data.validation, generator), num_contexts):
        if baseline.prior is not None:
            # Its settings were chosen on the validation plans; then these are learned from as well.
            arrays |= _arrays(baseline.model, baseline.prior.fit(plans_for(baseline.prior, learned)), held_out)
    return arrays


def _arrays(name: str, prior: Prior, held_out: Plans) -> Arrays:
    return {f"{name}/bits": action_bits(prior, held_out).numpy(), f"{name}/context": np.array(prior.takes_context)}
