"""Cross-validation: every model fitted in every fold, in several processes; each result is kept in a file."""

import hashlib
import json
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuroprior._files import write_json, written_whole
from neuroprior._threads import one_thread
from neuroprior._version import __version__
from neuroprior.analysis.comparison import units
from neuroprior.plans import Plans, read_plans, write_plans
from neuroprior.plans.folds import folds
from neuroprior.report import fits
from neuroprior.report.processes import do_each

Array = np.ndarray[Any, Any]

ACTIONS, CONTEXT = "actions", "actions and context"
"""What a model sees."""


@dataclass(frozen=True)
class Design:
    """All that decides the results of a cross-validation, beside the plans.

    Attributes:
        folds: how many; 1: learn from one file and score on another.
        seed: draws the folds, and everything in training.
        skip: actions at the beginning of each plan that are left out of the score.
        max_steps: gradient steps of neural priors.
        patience: share of them without improvement after which training stops.
        reach: the most past actions whose information is measured.
        cut: whether the plans are consecutive parts of a single one.
        version: of the library.
    """

    folds: int
    seed: int = 0
    skip: int = 0
    max_steps: int = 1000
    patience: float = 0.25
    reach: int = 16
    cut: bool = False
    version: str = __version__


@dataclass(frozen=True)
class Job:
    """What one process does at a time.

    Attributes:
        fold: number of the fold.
        kind: one of `fits.KINDS`.
        sees: `ACTIONS` or `CONTEXT`.
    """

    fold: int
    kind: str
    sees: str

    @property
    def name(self) -> str:
        """Of its file."""
        return f"fold{self.fold}-{self.kind}{'-context' * (self.sees == CONTEXT)}.npz"


@dataclass(frozen=True)
class Study:
    """Plans to learn from and plans to score, in a folder that the processes share.

    Attributes:
        folder: where the plans are, and where results are kept.
        design: what is done with them.
    """

    folder: Path
    design: Design

    @classmethod
    def prepare(cls, out: Path, plans: Plans, test: Plans | None, design: Design) -> "Study":
        """Write the plans, unless a study of the very same plans and design is there already."""
        partial = out / "folds"
        partial.mkdir(parents=True, exist_ok=True)
        names = ["plans.npz"] + ["test.npz"] * (test is not None)
        # With the recipes: after a change of these, fits that were finished before do not count.
        digest = hashlib.sha256((json.dumps(asdict(design), sort_keys=True) + fits.recipes()).encode())
        for name, some in zip(names, (plans, test), strict=False):
            assert some is not None
            write_plans(some, partial / f"{os.getpid()}-{name}")
            digest.update((partial / f"{os.getpid()}-{name}").read_bytes())
        folder = partial / digest.hexdigest()[:12]
        folder.mkdir(exist_ok=True)
        for name in names:
            (partial / f"{os.getpid()}-{name}").replace(folder / name)
        write_json(folder / "design.json", asdict(design))
        return cls(folder, design)

    @property
    def plans(self) -> Plans:
        """Those that are learned from."""
        return _read(self.folder / "plans.npz")

    @property
    def scored(self) -> Plans:
        """Those that are scored: all of them in turn, or those of the test file."""
        test = self.folder / "test.npz"
        return _read(test) if test.exists() else self.plans

    def mask(self) -> Tensor:
        """`[N, L]` bool: the actions that count in the score."""
        return counted(self.scored, self.design.skip, self.design.cut)

    def split(self, fold: int) -> tuple[Plans, Tensor]:
        """The plans to learn from in a fold, and the numbers of those that are scored."""
        if self.design.folds == 1:
            return self.plans, torch.arange(len(self.scored))
        learned, held_out = folds(self.plans, self.design.folds, self.design.seed)[fold]
        return self.plans[learned], held_out

    def models(self, job: Job) -> dict[str, str]:
        """The models that a finished job fitted, and their settings."""
        with np.load(self.folder / job.name, allow_pickle=False) as file:
            return {key.rsplit("/", 1)[0]: str(file[key]) for key in file.files if key.endswith("/how")}

    def array(self, job: Job, model: str, what: str) -> Array | None:
        """What a finished job kept of a model, see `fits.Outcome`; None for nothing."""
        with np.load(self.folder / job.name, allow_pickle=False) as file:
            return file[f"{model}/{what}"] if f"{model}/{what}" in file.files else None

    def finished(self, job: Job) -> bool:
        """Whether its results are there."""
        return (self.folder / job.name).exists()


def counted(plans: Plans, skip: int, cut: bool = False) -> Tensor:
    """`[N, L]` bool: all actions but the first `skip` of each plan; of parts of a single plan, but its first."""
    mask = plans.mask()
    if cut:
        place = mask.flatten().cumsum(0).view(mask.shape)
        return mask & (place > skip)
    mask[:, :skip] = False
    return mask


def jobs(design: Design, kinds: Iterable[str], sees: Iterable[str]) -> list[Job]:
    """What there is to do: the slowest first, so that no process is left alone with one at the end."""
    kinds, sees = list(kinds), list(sees)
    return [
        Job(fold, kind, seen)
        for kind in fits.KINDS
        if kind in kinds
        for fold in range(1 if kind in fits.ONCE else design.folds)
        for seen in reversed(sees)
    ]


def run(study: Study, todo: list[Job], processes: int, done: Callable[[Job], None]) -> None:
    """Do the jobs that have no result yet, each in one thread.

    Args:
        study: on what.
        todo: the jobs.
        processes: at the same time.
        done: called after each job; of those that are finished already at once.

    Raises:
        ValueError: plans that a model cannot learn from.
        MemoryError: a process was killed, as happens where memory runs out.
    """
    missing = [job for job in todo if not study.finished(job)]
    for job in todo:
        if job not in missing:
            done(job)
    do_each(partial(do, study), missing, processes, done)


def do(study: Study, job: Job) -> None:
    """Fit what a job names and keep how it scores; in one thread, as the number of threads changes the last digits."""
    learned, index = study.split(job.fold)
    scored = study.scored[index]
    mask = study.mask()
    unit = units(study.scored, mask)[index]
    if job.sees == ACTIONS:
        learned, scored = (replace(plans, context=None, context_names=None) for plans in (learned, scored))
    with one_thread():
        found = fits.outcomes(job.kind, learned, scored, mask[index], unit, study.design, job.fold)
    with written_whole(study.folder / job.name, "wb") as file:
        np.savez_compressed(file, **fits.packed(found))


@lru_cache(maxsize=2)
def _read(path: Path) -> Plans:
    return read_plans(path)
