"""How a comparison keeps to its time: how many starts fit, and progress that is printed as it goes."""

import sys
import threading
import time
from dataclasses import replace
from math import sqrt
from types import TracebackType
from typing import Self

import torch

from neuroprior.comparison.contestants import make_planner
from neuroprior.comparison.trial import Design
from neuroprior.priors import UniformPrior
from neuroprior.worlds import World

MIN_SEEDS = 5
"""Seeds for which there should be time."""

PLANNING_SHARE = 0.5
"""Share of the time that may go into simulator steps; the rest is for priors and planners."""

MIN_STARTS, MIN_TRAINING_STARTS, MIN_TRAINING_BUDGET = 4, 64, 64
"""What is left of each however slow the world is."""

TIMED_SECONDS, MAX_TIMED_STARTS = 0.1, 256
"""Simulator steps are timed for so long, or from so many starts."""

TIMED_PLANS = 16
"""Plans from each of these starts: few, since worlds may step prefixes that plans share only once."""

SILENT_SECONDS = 8.0
"""Seconds after which progress is printed again."""


def seconds_per_step(world: World, length: int, planner: str) -> float:
    """Seconds that a simulator step takes a planner without a prior, of many at once."""
    generator, batch = torch.Generator().manual_seed(0), 1
    timed = make_planner(planner, UniformPrior(world.num_actions), length, TIMED_PLANS)
    while True:
        state = world.reset(batch, generator)
        begin = time.perf_counter()
        steps = timed.plan(world, state, generator).model_steps
        seconds = time.perf_counter() - begin
        if seconds > TIMED_SECONDS or batch >= MAX_TIMED_STARTS:
            return seconds / (batch * steps)
        batch *= 4


def fit_starts(design: Design, step_seconds: float, training_seconds: float, seconds: float) -> Design:
    """The design with as many starts, and as many plans tried in training, as there is time for.

    Args:
        design: with the starts that are wanted.
        step_seconds: of a simulator step where planners are compared.
        training_seconds: of one where training plans are collected.
        seconds: that a seed may spend on simulator steps.
    """
    training, held_out = design.model_steps
    needed = training_seconds * training * design.training_starts + step_seconds * held_out * design.starts
    if needed <= seconds:
        return design
    share, root = seconds / needed, sqrt(seconds / needed)
    return replace(
        design,
        starts=min(design.starts, max(int(share * design.starts), MIN_STARTS)),
        training_starts=min(design.training_starts, max(int(root * design.training_starts), MIN_TRAINING_STARTS)),
        training_budget=min(design.training_budget, max(int(root * design.training_budget), MIN_TRAINING_BUDGET)),
    )


class Progress:
    """Prints to standard error what is done at present, every few seconds.

    Args:
        shown: False: print nothing.
    """

    def __init__(self, shown: bool) -> None:
        self.shown = shown
        self._status, self._begin, self._printed = "", time.monotonic(), 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._repeat, daemon=True)

    def __enter__(self) -> Self:
        if self.shown:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()

    def tell(self, status: str) -> None:
        """Set what is done at present, to be printed when nothing was for a while."""
        self._status = status

    def print(self, status: str) -> None:
        """Set what is done at present, and print it."""
        self._status = status
        if self.shown:
            self._printed = time.monotonic()
            gone = round(self._printed - self._begin)
            print(f"compare: {status} ({gone // 60}:{gone % 60:02})", file=sys.stderr, flush=True)

    def _repeat(self) -> None:
        while not self._ended.wait(1.0):
            if time.monotonic() - self._printed >= SILENT_SECONDS:
                self.print(self._status)
