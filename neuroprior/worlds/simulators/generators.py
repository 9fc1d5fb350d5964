"""The random generators of simulators: found, seeded, and those of modules left as they were."""

import hashlib
import random
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from neuroprior.worlds.simulators.attributes import Path, walk

GENERATORS = (np.random.Generator, np.random.RandomState, random.Random, torch.Generator)


def find_generators(simulator: Any) -> dict[Path, Any]:
    """The random generators that a simulator holds, however deep, by their paths."""
    return {path: value for path, value in walk(simulator) if isinstance(value, GENERATORS)}


def create_lazy_generators(simulator: Any) -> None:
    """Create Gymnasium's generators, which otherwise appear unseeded when they are first used."""
    for _, value in list(walk(simulator)):
        if hasattr(type(value), "np_random") and getattr(value, "_np_random", value) is None:
            _ = value.np_random


def seed_generators(generators: Iterable[Any], seed: int) -> None:
    """Seed generators, each otherwise, and those of the modules `random`, `numpy.random` and torch."""
    for place, generator in enumerate(generators, start=3):
        _seed(generator, _mix(seed, place))
    random.seed(_mix(seed, 0))
    np.random.seed(_mix(seed, 1) % 2**32)  # noqa: NPY002
    torch.default_generator.manual_seed(_mix(seed, 2) % 2**63)


def state_of_generators(generators: Iterable[Any]) -> list[Any]:
    """The states of generators, and of those of the modules, to be compared."""
    numpy_state = np.random.get_state(legacy=False)  # noqa: NPY002
    states = [random.getstate(), _comparable(numpy_state), torch.get_rng_state().numpy().tobytes()]
    return states + state_of_held(generators)


def state_of_held(generators: Iterable[Any]) -> list[Any]:
    """The states of generators alone, to be compared."""
    states: list[Any] = []
    for generator in generators:
        if isinstance(generator, np.random.Generator):
            states.append(_comparable(generator.bit_generator.state))
        elif isinstance(generator, torch.Generator):
            states.append(generator.get_state().numpy().tobytes())
        elif isinstance(generator, random.Random):
            states.append(generator.getstate())
        else:
            states.append(_comparable(generator.get_state(legacy=False)))
    return states


def _comparable(state: Any) -> Any:
    """The state of a bit generator of numpy with bytes in place of arrays."""
    if isinstance(state, dict):
        return {key: _comparable(value) for key, value in state.items()}
    return state.tobytes() if isinstance(state, np.ndarray) else state


@contextmanager
def keep_global_generators() -> Iterator[None]:
    """Leave the generators of the modules `random`, `numpy.random` and torch as they were."""
    states = random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        torch.set_rng_state(states[2])


def _seed(generator: Any, seed: int) -> None:
    if isinstance(generator, torch.Generator):
        generator.manual_seed(seed % 2**63)
    elif isinstance(generator, np.random.RandomState):
        generator.seed(seed % 2**32)
    elif isinstance(generator, random.Random):
        generator.seed(seed)
    elif type(generator.bit_generator) is np.random.PCG64:  # five times as fast as by its constructor
        state: Any = {"state": seed, "inc": (seed >> 64) | 1}
        generator.bit_generator.state = {"bit_generator": "PCG64", "state": state, "has_uint32": 0, "uinteger": 0}
    else:
        generator.bit_generator.state = type(generator.bit_generator)(seed).state


def _mix(seed: int, place: int) -> int:
    """A number of 128 bits for each seed and place."""
    return int.from_bytes(hashlib.blake2b(b"%d,%d" % (seed, place), digest_size=16).digest(), "little")
