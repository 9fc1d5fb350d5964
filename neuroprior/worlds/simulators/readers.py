"""Finds what a simulator's observations can be read from, where no step has told the last one."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from neuroprior.worlds.simulators.attributes import Path, read, walk
from neuroprior.worlds.simulators.copies import Copier
from neuroprior.worlds.simulators.driver import Driver
from neuroprior.worlds.simulators.trials import NUM_WALKS, WALK_LENGTH, Start, load_seeded, random_walk

METHODS = ("_get_obs", "_get_ob", "_get_observation", "_observe", "get_obs", "get_observation", "gen_obs")
"""Methods by which simulators often give their observation."""

Reader = Callable[[Any], Any]


def find_reader(driver: Driver, copier: Copier, start: Start) -> Reader | None:
    """A function from a simulator to its observation: a method or an attribute that agrees with `step` on random walks.

    Returns:
        None where there is none.
    """
    draw = np.random.default_rng(0)
    readers: list[Reader] | None = None
    for seed in range(NUM_WALKS):
        simulator, view = load_seeded(copier, start.saved, seed), start.view
        for _ in range(WALK_LENGTH):
            moments, view = random_walk(driver, simulator, view, 1, draw)
            readers = _candidates(simulator) if readers is None else readers
            readers = [reader for reader in readers if _agrees(reader, simulator, driver, view.observation)]
            if not moments or moments[0].ended:
                break
    return readers[0] if readers else None


def _candidates(simulator: Any) -> list[Reader]:
    """Methods and attributes that may hold the observation."""
    methods: list[Reader] = [partial(_call, name) for name in METHODS]
    return methods + [partial(_read, path) for path, _ in walk(simulator) if path]


def _call(name: str, simulator: Any) -> Any:
    return getattr(getattr(simulator, "unwrapped", simulator), name)()


def _read(path: Path, simulator: Any) -> Any:
    return read(simulator, path)


def _agrees(reader: Reader, simulator: Any, driver: Driver, observation: Any) -> bool:
    """Whether a reader gives this observation."""
    try:
        return np.array_equal(driver.as_declared(reader(simulator)), observation, equal_nan=True)
    except Exception:  # what is read may be anything
        return False
