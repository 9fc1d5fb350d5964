"""What grows with each step of a simulator: set back, so that states do not differ by it, or named."""

import copy
import itertools
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from neuroprior.worlds.simulators.attributes import Path, name_path, read, walk, write
from neuroprior.worlds.simulators.copies import Copier
from neuroprior.worlds.simulators.driver import TRUNCATED, Driver
from neuroprior.worlds.simulators.trials import Moment, Start, follow_on, random_walk

NUM_WALKS, WALK_LENGTH = 8, 40
"""Random walks on which something must grow with each step, and actions in each."""

ENDLESS_STEPS = 1000
"""Steps after which a walk that avoids the ends of episodes counts as endless."""

CONTAINERS = (list, dict, set, deque, str, bytes, np.ndarray)

NOT_STATE = "lastaction"
"""Gymnasium's toy texts remember the last action under this name, only to draw it."""


class Counters:
    """What grows with each step of a simulator, but changes nothing; it is set back to what it was at the start.

    Numbers, however deep, may change rewards: they are then those of a first step. Collections must not.

    Args:
        driver: steps simulators.
        copier: copies them.
        start: where walks begin.
        seed: of the walks.

    Attributes:
        names: what is set back.

    Raises:
        ValueError: something grows with each step without end, and changes what happens; the message names it.
    """

    def __init__(self, driver: Driver, copier: Copier, start: Start, seed: int) -> None:
        self._driver, self._copier, self._start = driver, copier, start
        self._draw = np.random.default_rng(seed)
        held = list(walk(copier.load(start.saved)))
        candidates = self._find_growing([path for path, value in held if path and _size(value) is not None])
        candidates += [path for path, _ in held if path and path[-1] == (True, NOT_STATE)]
        self._values = {path: copy.deepcopy(read(copier.load(start.saved), path)) for path in candidates}
        idle = [path for path in candidates if self._is_idle([path])]
        self._paths = idle if self._is_idle(idle) else []
        self.names = [name_path(path) for path in self._paths]
        endless = self._find_endless()
        if endless is not None:
            raise ValueError(
                f"env: `{name_path(endless)}` changes with each step, and matters or cannot be set back,"
                ' so that there is no end of states; use method="step"'
            )

    def set_back(self, simulator: Any) -> None:
        """Set what grows to what it was at the start of the episode."""
        self._set_back(simulator, self._paths)

    def remember(self, simulator: Any) -> None:
        """Take what a simulator holds at the start of an episode as that to set back to."""
        self._values = {path: copy.deepcopy(read(simulator, path)) for path in self._paths}

    def _set_back(self, simulator: Any, paths: list[Path]) -> None:
        for path in paths:
            write(simulator, path, copy.deepcopy(self._values[path]))

    def _find_growing(self, paths: list[Path]) -> list[Path]:
        """Those of the paths to what grows or shrinks with each step, by as much whatever the actions."""
        longest: dict[Path, tuple[float, ...]] = {}
        for _ in range(NUM_WALKS):
            simulator, view = self._copier.load(self._start.saved), self._start.view
            sizes, ended = [_sizes(simulator, paths)], False
            while len(sizes) <= WALK_LENGTH and not ended:
                moments, view = random_walk(self._driver, simulator, view, 1, self._draw)
                sizes.append(_sizes(simulator, paths))
                ended = bool(moments[0].ended)
            columns = dict(zip(paths, zip(*sizes, strict=True), strict=True))
            paths = [
                path
                for path, column in columns.items()
                if _is_monotone(column) and all(a == b for a, b in zip(column, longest.get(path, column), strict=False))
            ]
            longest = {path: max(columns[path], longest.get(path, ()), key=len) for path in paths}
        return [path for path in paths if len(longest[path]) > 2]

    def _is_idle(self, paths: list[Path]) -> bool:
        """Whether walks stay the same where these are set back after each step."""
        strict = all(isinstance(self._values[path], CONTAINERS) for path in paths)
        for _ in range(NUM_WALKS):
            simulator = self._copier.load(self._start.saved)
            counted, _ = random_walk(self._driver, simulator, self._start.view, WALK_LENGTH, self._draw)
            simulator, view, uncounted = self._copier.load(self._start.saved), self._start.view, list[Moment]()
            try:
                for moment in counted:
                    moments, view = follow_on(self._driver, simulator, view, [moment.action])
                    uncounted += moments
                    self._set_back(simulator, paths)
            except Exception:  # a simulator may need in any way what was set back
                return False
            if counted and counted[-1].ended == TRUNCATED:  # presumably a time limit, which need not be the same
                counted.pop()
                uncounted = uncounted[: len(counted)]
            if not strict:
                counted, uncounted = ([m._replace(reward="") for m in ms] for ms in (counted, uncounted))
            if counted != uncounted:
                return False
        return True

    def _find_endless(self) -> Path | None:
        """What still grows or shrinks with each step of a long walk that avoids the ends of episodes; None: nothing."""
        saved, view, sizes = self._start.saved, self._start.view, list[dict[Path, float]]()
        for step in range(ENDLESS_STEPS):
            for action in self._draw.permutation(self._driver.legal_numbers(view)).tolist():
                simulator = self._copier.load(saved)
                moments, after = follow_on(self._driver, simulator, view, [action])
                if not moments[0].ended:
                    break
            else:
                return None
            self.set_back(simulator)
            if step >= ENDLESS_STEPS - WALK_LENGTH:
                sizes.append({path: size for path, one in walk(simulator) if (size := _size(one)) is not None})
            view, saved = after, self._copier.save(simulator, (saved, [action], 0))
        columns = ((path, [held.get(path, np.nan) for held in sizes]) for path in sizes[0])
        return next((path for path, column in columns if _is_monotone(column)), None)


def _is_monotone(sizes: Sequence[float]) -> bool:
    """Whether each size is above the one before, or each below."""
    pairs = list(itertools.pairwise(sizes))
    return all(a < b for a, b in pairs) or all(a > b for a, b in pairs)


def _size(value: Any) -> float | None:
    """A number, or how much a collection holds; None for anything else."""
    if isinstance(value, CONTAINERS):
        return len(value) if not isinstance(value, np.ndarray) or value.ndim else None
    if isinstance(value, (int, float, np.number, Tensor)) and not isinstance(value, bool):
        return float(value) if not isinstance(value, Tensor) or not value.ndim else None
    return None


def _sizes(simulator: Any, paths: list[Path]) -> list[float]:
    """The sizes of what is at these paths; NaN where there is nothing of the kind."""
    sizes = []
    for path in paths:
        try:
            size = _size(read(simulator, path))
        except (LookupError, AttributeError, TypeError):
            size = None
        sizes.append(np.nan if size is None else size)
    return sizes
