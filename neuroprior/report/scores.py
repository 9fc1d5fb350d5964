"""Models and what held-out actions cost them: the rows of the main table, calibration, and the choice of the best."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import log
from typing import Any

import torch
from torch import Tensor

from neuroprior.analysis import Reliability
from neuroprior.analysis.comparison import ORDERS, Score, score_bits
from neuroprior.plans import Plans
from neuroprior.report.crossval import ACTIONS, CONTEXT, Array, Job, Study
from neuroprior.report.fits import COUNTED


@dataclass(frozen=True)
class Model:
    """A model that was scored on held-out plans.

    Attributes:
        name: such as "markov-3".
        sees: `ACTIONS` or `CONTEXT`.
        how: its settings in each fold, the distinct ones.
        load: what was kept of it, see `neuroprior.report.fits.Outcome`: of all held-out plans, in the order of the file; None for
            nothing.
    """

    name: str
    sees: str
    how: str
    load: Callable[[str], Array | None]

    @property
    def label(self) -> str:
        """Of figures."""
        return self.name + ", sees context" * (self.sees == CONTEXT)

    def bits(self) -> Tensor:
        """`[N, L]`, float32: what each held-out action cost."""
        found = self.load("bits")
        assert found is not None
        return torch.from_numpy(found)

    def calibration(self) -> Reliability | None:
        """Its forecasts against what happened."""
        sums = self.load("calibration")
        return None if sums is None else Reliability(torch.from_numpy(sums))


def models_of(study: Study, jobs: Sequence[Job]) -> list[Model]:
    """The models of a finished cross-validation, in the order of the main table."""
    by_kind: dict[tuple[str, str], list[Job]] = {}
    for job in jobs:
        if job.kind != "lags":
            by_kind.setdefault((job.kind, job.sees), []).append(job)
    found = []
    for (_, sees), some in by_kind.items():
        some.sort(key=lambda job: job.fold)
        how = [study.models(job) for job in some]
        for name in how[0]:
            # A chain may be too large for its tables in some folds.
            if all(name in models for models in how):
                settings = ", ".join(dict.fromkeys(models[name] for models in how if models[name]))
                found.append(Model(name, sees, settings, _loader(study, some, name)))
    chains = [f"markov-{order}" for order in ORDERS]
    place = ["uniform", *chains, "context tree", "gru", "transformer", "gru-large", "stacked", "mixture"]
    return sorted(found, key=lambda model: (model.sees == CONTEXT, place.index(model.name)))


def _loader(study: Study, jobs: Sequence[Job], name: str) -> Callable[[str], Array | None]:
    def load(what: str) -> Array | None:
        found = [study.array(job, name, what) for job in jobs]
        if what == "generated":
            return found[0]
        whole = [array for array in found if array is not None]
        if not whole:
            return None
        if what == "calibration":
            return sum(whole[1:], start=whole[0])
        bits = torch.zeros(study.scored.actions.shape)
        for job, array in zip(jobs, whole, strict=True):
            bits[study.split(job.fold)[1]] = torch.from_numpy(array)
        return bits.numpy()

    return load


def score_rows(scores: Sequence[Score], models: Sequence[Model]) -> list[dict[str, Any]]:
    """The rows of the main table: what each model takes, and how much more than the best of them."""
    best = min(scores, key=lambda one: one.bits_per_action().mean)
    return [score_row(one, best) | {"how": model.how} for one, model in zip(scores, models, strict=True)]


def score_row(one: Score, reference: Score) -> dict[str, Any]:
    """One row: bits, nats and perplexity with intervals, and the paired difference from the reference."""
    taken = one.bits_per_action()
    row = {
        "model": one.model,
        "sees": one.inputs,
        "bits_per_action": taken.mean,
        "low": taken.low,
        "high": taken.high,
        "nats_per_action": taken.mean * log(2),
        "nats_low": taken.low * log(2),
        "nats_high": taken.high * log(2),
        "perplexity": 2**taken.mean,
        "perplexity_low": 2**taken.low,
        "perplexity_high": 2**taken.high,
    }
    if len(one.bits) != len(reference.bits) or not one.actions.equal(reference.actions):
        # One tells the ends of plans too, the other does not.
        return row | dict.fromkeys(("more", "more_low", "more_high", "p_value"))
    gap = one.minus(reference)
    return row | {"more": gap.mean, "more_low": gap.low, "more_high": gap.high, "p_value": gap.p_value}


def scores_of(models: Sequence[Model], scored: Plans, mask: Tensor) -> list[Score]:
    """What each model paid for the held-out actions that count."""
    return [score_bits(model.name, model.sees, model.bits(), scored, mask) for model in models]


def leading(models: Sequence[Model], scores: Sequence[Score], sees: str) -> list[Model]:
    """The models of figures, of those that see this: the best chain, and all that are no chains."""
    cost = {id(model): one.bits_per_action().mean for model, one in zip(models, scores, strict=True)}
    same = [model for model in models if model.sees == sees]
    chains = [model for model in same if model.name.removeprefix("markov-").isdecimal()]
    chosen = [min(chains, key=lambda model: cost[id(model)])] if chains else []
    return chosen + [model for model in same if model not in chains and model.name != "uniform"]


def step_rows(study: Study, jobs: Sequence[Job]) -> list[dict[str, Any]]:
    """What the action k steps back still tells beyond the nearer ones: by counts and by a neural prior."""
    rows = []
    for job in jobs:
        if job.kind != "lags":
            continue
        for name in sorted(study.models(job), key=lambda name: name != COUNTED):
            bits, actions = (torch.from_numpy(study.array(job, name, what)) for what in ("bits", "actions"))
            scores = [Score(name, job.sees, b, a) for b, a in zip(bits, actions, strict=True)]
            for lag in range(1, len(scores)):
                gain = scores[lag - 1].minus(scores[lag])
                rows.append(
                    {
                        "what": "gain",
                        "model": name,
                        "sees": job.sees,
                        "lag": lag,
                        "bits": gain.mean,
                        "low": gain.low,
                        "high": gain.high,
                        "chance": None,
                        "units": len(scores[lag].actions),
                    }
                )
    return sorted(rows, key=lambda row: row["sees"] != ACTIONS)
