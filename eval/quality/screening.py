"""`python -m eval screening`: whether networks that would pay are trained, and what is lost on those that do not."""

import time
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd
import torch
from jsonargparse.typing import NonNegativeInt, PositiveInt

from eval.quality.command import sources
from eval.quality.sequences import sequences
from eval.worlds.labyrinth import DATA
from eval.worlds.runs import Seed
from neuroprior import Plans, read_plans
from neuroprior._folders import claim_out
from neuroprior._jobs import JobRun
from neuroprior.behaviour import read
from neuroprior.behaviour.reporting.document import Column, Document, publish, table
from neuroprior.behaviour.reporting.page import Section
from neuroprior.behaviour.study import large_study, simulated_study
from neuroprior.plans.folds import folds
from neuroprior.priors.construction import context_arguments
from neuroprior.priors.ensembles.candidates import counted, networks
from neuroprior.priors.ensembles.pooling import HeldOut, stack_forecasts
from neuroprior.priors.ensembles.screening import screen
from neuroprior.priors.learning import plans_for, split_validation

WORTH = 0.005
"""Nats per action on other plans: a network that brings more should be trained."""

TEST_PLANS = 3000
"""Plans of each source on which gains are measured."""

STUDIES = {"example study": simulated_study, "large study": lambda seed: large_study(seed).query("observer == 'A'")}

LABYRINTH = {"labyrinth": False, "labyrinth with node": True}
"""The mice's moves, without and with the node as context."""


@dataclass(frozen=True)
class Job:
    """A data set, and the seed of what is drawn."""

    data: str
    seed: int

    def __str__(self) -> str:
        return f"{self.data.replace(' / ', '-x').replace(' ', '-').replace(',', '')}-{self.seed}"


@claim_out
def screening(
    sizes: list[PositiveInt] = [300, 3000, 30_000],  # noqa: B006
    num_sequences: NonNegativeInt = 40,
    seed: Seed = 0,
    processes: PositiveInt = 1,
    out: str = "runs/screening",
) -> None:
    """Compare what networks promised before they were trained with what they brought on other plans.

    Interrupted, the same command goes on with the data sets that are left.

    Args:
        sizes: plans of 32 actions to learn from, of each of six sources.
        num_sequences: long sequences of 1,000 actions to learn from; 0 for none.
        seed: draws sources and plans.
        processes: data sets at a time; seconds are longer, and less reliable, with more than one.
        out: folder for `screening.csv`, `results.json` and finished data sets.
    """
    names = [source.name for source in sources(torch.Generator().manual_seed(seed))]
    data = [f"{name} / {size}" for size in sizes for name in names]
    long = sequences(num_sequences, torch.Generator().manual_seed(seed))
    data += [one.name for one in long] + [*STUDIES, *LABYRINTH]
    asked = {"command": "screening", "num_sequences": num_sequences}
    run = JobRun(partial(rows_of, num_sequences=num_sequences), Path(out) / "runs", asked)
    rows = run.do([Job(name, seed) for name in data], processes=processes, title="screening")
    frame = pd.DataFrame(row for job_rows in rows for row in job_rows)
    publish(_document(frame, {"sizes": sizes, "num_sequences": num_sequences, "seed": seed}), Path(out))


def rows_of(job: Job, num_sequences: int) -> list[dict[str, Any]]:
    """A row for each network of one data set: what it promised, what it brought, and the seconds of both."""
    plans, test = _data(job, num_sequences)
    learned, held_out = split_validation(plans, None, torch.Generator().manual_seed(job.seed))
    contexts, settings = context_arguments(plans), {"progress": False}
    experts = list(counted(learned, held_out, contexts))
    counts, of_test = stack_forecasts(experts, held_out), stack_forecasts(experts, test)
    forecasts, rows = counts, list[dict[str, Any]]()
    for network in networks(plans.num_actions, contexts, "standard", job.seed + 1).values():
        begun = time.perf_counter()
        promise = screen(network, counts, learned, held_out, settings)
        assert promise is not None  # a training of a thousand steps is long enough
        screened, trained = time.perf_counter(), deepcopy(network)
        generator = torch.Generator().manual_seed(job.seed)
        trained.fit(plans_for(trained, learned), generator=generator, validation=held_out, **settings)
        seconds = time.perf_counter() - screened
        joined, joined_test = (
            torch.cat([forecast, stack_forecasts([trained], scored_plans)], 2)
            for forecast, scored_plans in ((forecasts, held_out), (of_test, test))
        )
        row = {"data": job.data, "actions": int(plans.mask().sum()), "network": type(network).__name__}
        tried = all(earlier["trained"] for earlier in rows)  # up to the first that does not pay
        pays = promise.pays and tried
        row |= promise._asdict() | {"promised": promise.gain, "trained": pays}
        row |= {"held_out": _loss(forecasts, held_out) - _loss(joined, held_out)}
        row |= {"gain": _loss(of_test, test) - _loss(joined_test, test)}
        rows.append(row | {"screening_seconds": (screened - begun) * tried, "training_seconds": seconds})
        if pays:
            forecasts, of_test = joined, joined_test
    return rows


def _data(job: Job, num_sequences: int) -> tuple[Plans, Plans]:
    """Plans to learn from, and others on which gains are measured."""
    generator = torch.Generator().manual_seed(job.seed)
    if job.data in STUDIES:
        with TemporaryDirectory() as folder:
            STUDIES[job.data](job.seed).to_csv(file := Path(folder) / "study.csv", index=False)
            plans: Plans = read(file).plans()
    elif job.data in LABYRINTH:
        plans = read_plans(DATA) if LABYRINTH[job.data] else read_plans(DATA).without_context()
    elif " / " in job.data:
        name, size = job.data.split(" / ")
        (source,) = (one for one in sources(generator) if one.name == name)
        return source.draw(int(size), generator)[0], source.draw(TEST_PLANS, generator)[0]
    else:
        (long,) = (one for one in sequences(num_sequences, generator) if one.name == job.data)
        return long.training, long.test
    learned, test = folds(plans, 5, job.seed)[0]
    return plans[learned], plans[test]


def _loss(forecasts: torch.Tensor, plans: Plans) -> float:
    """Nats per action of all experts together."""
    return HeldOut(forecasts, plans.actions, plans.mask(), forecasts.shape[2] + 2).combined()[1]


def _document(frame: pd.DataFrame, settings: dict[str, Any]) -> Document:
    missed = frame[~frame["trained"] & (frame["gain"] > WORTH)]
    vain = frame[frame["trained"] & (frame["gain"] <= 0)]
    total = frame["training_seconds"].sum()
    needed = frame["training_seconds"].where(frame["trained"], 0.0).sum() + frame["screening_seconds"].sum()
    lead = (
        f"{len(missed)} of {len(frame)} networks would have brought more than {WORTH} nats per action and were not"
        f" trained. {vain['training_seconds'].sum():.0f} of {total:.0f} seconds of training went to networks that"
        f" brought nothing; with the screening, {needed:.0f} seconds were needed in all."
    )
    columns: dict[str, Column] = {
        "data": "data",
        "actions": "actions:,",
        "network": "network",
        "promised": "promised:.4f",
        "needed": "needed:.4f",
        "trained": lambda row: "yes" if row.trained else "no",
        "gain": "gain:.4f",
        "screening, s": "screening_seconds:.0f",
        "training, s": "training_seconds:.0f",
    }
    caption = (
        "Nats per action. promised: beyond counts on held-out plans, after a tenth of the training. needed: to be kept"
        " there. gain: of the trained network, on other plans, beyond counts and the networks trained before it."
    )
    tables = [table(frame, columns, caption)]
    return Document("Screening of networks", lead, [Section("Networks", tables=tables)], {"screening": frame}, settings)
