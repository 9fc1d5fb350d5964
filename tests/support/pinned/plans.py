"""Plans: files of every layout read and written, tables, folds, windows, batches, past durations, trajectories."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from neuroprior.plans import (
    PastDurations,
    VectorPlans,
    all_plans,
    divisible,
    folds,
    from_trajectories,
    in_parts,
    read_plans,
    read_vector_plans,
    to_trajectories,
    vector_plans_from_trajectories,
    write_plans,
    write_vector_plans,
)
from neuroprior.training import PlansModule, Settings
from tests.plans.test_tables import BORIS, COLUMNS, LAB, MOSEQ, OF_TABULAR, TABULAR
from tests.support.pinned.data import behaviour, timed
from tests.support.sources import seeded
from tests.support.unchanged import case


def of_plans(plans: Any) -> dict[str, Any]:
    """The fields that are there."""
    given = {field.name: getattr(plans, field.name) for field in fields(plans)}
    if given.get("durations") is not None:
        given["durations"] = given["durations"].nan_to_num(-1)
    return {name: value for name, value in given.items() if value is not None and value != ()}


TABLES: dict[str, tuple[str, Mapping[str, Any]]] = {
    "plain": ("plan,action,context,group\n1,2,0,5\n1,0,1,5\n2,1,2,6\n", {}),
    "names": ("plan;action;group;condition\na;rest;m1;drug\na;eat;m1;drug\nb;rest;m2;\n", {}),
    "features": ("plan,action,context_1,context_2\n1,x,0.5,1\n1,y,1.5,2\n2,x,0,0\n", {}),
    "steps in columns": ("1,2,0\n0,1\n2\n", {}),
    "gaps": ("plan,action\n1,a\n1,?\n1,b\n2,A \n2,NA\n2,a\n", {}),
    "labels": ("plan,action\n1,a\n1,?\n1,b\n2,A \n2,NA\n2,a\n", {"missing": "label"}),
    "pauses": ("action,start,stop\na,0,5\nb,1,2\nc,6,7\nd,9,10\n", {"max_gap": 1.5}),
    "repeats": ("plan,action,start,stop\n1,a,0,1\n1,a,1,2\n2,c,0,1\n2,c,1.5,2\n", {"merge_repeats": True}),
    "clocks": ("action,start\nwalk,00:00:01.5\nrest,00:01:00\nwalk,00:02:00\n", {}),
    "names in order": ("plan,action\n1,a\n1,b\n", {"action_names": ["z", "b", "a"]}),
    "more actions": ("plan,action\n1,0\n1,3\n", {"num_actions": 6}),
    "laboratory": (LAB, {"columns": COLUMNS | {"start": "t", "duration": "seconds"}}),
    "boris": (BORIS, {"columns": {"plan": "Observation id", "group": "Subject", "action": "Behavior",
                                  "start": "Start (s)", "stop": "Stop (s)"}}),
    "boris, events": (TABULAR, {"columns": OF_TABULAR}),
    "moseq": (MOSEQ, {"columns": {"plan": "name", "action": "syllable", "condition": "group"}, "merge_repeats": True}),
}  # fmt: skip


@case
def tables_of_laboratories():
    found: dict[str, Any] = {}
    with TemporaryDirectory() as folder:
        for name, (text, options) in TABLES.items():
            place = Path(folder) / "plans.csv"
            place.write_text(text)
            try:
                found[name] = of_plans(read_plans(place, **options))
            except ValueError as error:
                found[name] = str(error).replace(folder, "")
    return found


@case
def files_written():
    """The text of each kind of file, and what is read of it."""
    found: dict[str, Any] = {}
    sources = {"timed": timed(5, 4), "plan": behaviour(4, 4, context="plan"), "step": behaviour(4, 4, context="step")}
    sources |= {"features": behaviour(3, 4, context="features"), "end": behaviour(3, 4).with_end()}
    with TemporaryDirectory() as folder:
        for name, plans in sources.items():
            for suffix in ("npz", "jsonl", "csv", "tsv"):
                place = Path(folder) / f"plans.{suffix}"
                if plans.end is not None and suffix in ("csv", "tsv"):
                    continue
                write_plans(plans, place)
                found[f"{name}, {suffix}"] = of_plans(read_plans(place))
                if suffix == "npz":
                    with np.load(place) as arrays:
                        found[f"{name}, {suffix}, text"] = {
                            key: [str(arrays[key].dtype), arrays[key].shape] for key in arrays
                        }
                else:
                    found[f"{name}, {suffix}, text"] = place.read_text().splitlines()
        vectors = VectorPlans(
            torch.rand(3, 4, 2, generator=seeded(0)), [-1.0, 0.0], [1.0, 2.0], torch.tensor([4, 1, 3])
        )
        write_vector_plans(vectors, Path(folder) / "vectors.npz")
        found["vectors"] = of_plans(read_vector_plans(Path(folder) / "vectors.npz"))
    return found


@case
def parts_of_plans():
    found: dict[str, Any] = {}
    plans, alone = timed(14, 6), behaviour(7, 5, context="step")
    found["folds"] = [folds(plans, 3, seed=2), folds(alone[:4], 2)]
    found["without one group"] = of_plans(divisible(alone[:1]))
    found["parts"] = of_plans(in_parts(timed(1, 30), 4))
    found["ended"] = of_plans(plans[:4].with_end())
    found["cut"] = [of_plans(plans.steps(1, 4)), of_plans(alone.steps(2)), of_plans(alone.without_context()[2:4])]
    found["split"] = [of_plans(part) for part in plans.split(0.3, seeded(0))]
    found["split in time"] = [of_plans(part) for part in timed(1, 12).split(0.25)]
    past = PastDurations.of(plans, 2)
    found["past"] = [
        past,
        past.added_to(plans).context,
        past.added_to(behaviour(14, 6, context="features", durations=plans.durations)).context,
    ]
    found["every plan"] = all_plans(3, 2)
    trajectories = to_trajectories(alone)
    found["trajectories"] = [trajectories[:2], of_plans(from_trajectories(trajectories, 3))]
    arrays = [{"actions": np.linspace(-1, 1, 6).reshape(3, 2), "observations": np.ones((4, 3))}]
    vectors = vector_plans_from_trajectories(arrays, [-1.0, -1.0], [1.0, 1.0])
    found["vectors"] = [of_plans(vectors), vectors.windows(2), vectors.at_bounds(), of_plans(vectors.steps(1))]
    return found


@case
def batches():
    """What each step of a training reads, and the settings that follow from the plans."""
    found: dict[str, Any] = {}
    for name, plans, how in (
        ("distinct", behaviour(60, 4), {}),
        ("whole", behaviour(30, 9, context="step"), {"batch_size": 8}),
        ("windows", behaviour(12, 30), {"window": 4, "batch_size": 5}),
        ("context", behaviour(12, 30, context="plan"), {"window": 7, "batch_size": 4}),
    ):
        data = PlansModule(
            plans,
            behaviour(5, 9, context=None if plans.context is None else "step" if name == "whole" else "plan", seed=3),
            Settings(max_steps=6, check_every=3, **how),
            1,
        )
        loader = data.train_dataloader()
        found[name] = {"batches": list(loader), "validation": list(data.val_dataloader())}
        loader.sampler.set_epoch(1)
        found[name] |= {"second": [batch.actions for batch in loader], "epochs": [data.epochs, data.steps]}
        found[name]["settings"] = {
            key: getattr(data.settings, key) for key in ("max_steps", "batch_size", "patience", "check_every")
        }
    found["defaults"] = [
        [
            Settings().batches_of(longest),
            Settings().for_passes(steps, longest),
            Settings().for_passes(steps, longest).epochs(steps),
        ]
        for steps, longest in ((1, 4), (5, 33), (40, 200), (500, 5000))
    ]
    return found
