"""How a comparison keeps to its time: how many starts fit, and progress that is printed as it goes."""

import sys
import threading
import time
from dataclasses import replace
from types import TracebackType
from typing import Self

import torch

from neuroprior.comparison.trial import Design
from neuroprior.worlds import World

MIN_SEEDS = 5
"""Seeds for which there should be time."""

PLANNING_SHARE = 0.5
"""Share of the time that may go into simulator steps; the rest is for priors and planners."""

MIN_STARTS, MIN_TRAINING_STARTS = 8, 64
"""Starts that are left however slow the world is."""

TIMED_SECONDS, MAX_TIMED_PLANS = 0.1, 4096
"""Simulator steps are timed for so long, or until so many plans were tried at once."""

SILENT_SECONDS = 8.0
"""Seconds after which progress is printed again."""


def seconds_per_step(world: World, length: int) -> float:
    """Seconds that a simulator step takes, of many at once."""
    generator, number = torch.Generator().manual_seed(0), 1
    state = world.reset(1, generator)
    while True:
        plans = torch.randint(world.num_actions, (1, number, length), generator=generator).to(state.device)
        begin = time.perf_counter()
        world.rollout(state, plans, generator)
        seconds = time.perf_counter() - begin
        if seconds > TIMED_SECONDS or number >= MAX_TIMED_PLANS:
            return seconds / (number * length)
        number *= 4


def fit_starts(design: Design, step_seconds: float, seconds: float) -> Design:
    """The design with as many starts as there is time for.

    Args:
        design: with the starts that are wanted.
        step_seconds: of a simulator step.
        seconds: that a seed may spend on simulator steps.
    """
    training, held_out = design.model_steps
    needed = step_seconds * (training * design.training_starts + held_out * design.starts)
    if needed <= seconds:
        return design
    share = seconds / needed
    return replace(
        design,
        starts=min(design.starts, max(int(share * design.starts), MIN_STARTS)),
        training_starts=min(design.training_starts, max(int(share * design.training_starts), MIN_TRAINING_STARTS)),
    )


class Progress:
    """Prints to standard error what is done at present: at once when seeds are finished, else every few seconds.

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
        """Set what is done at present, which is printed if nothing was for a while."""
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
