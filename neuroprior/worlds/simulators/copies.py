"""Ways to copy a simulator: by a method of its own, by pickle, by `copy.deepcopy`."""

import copy
import copyreg
import io
import pickle
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import ModuleType
from typing import Any

from neuroprior.worlds.simulators.attributes import Path, name_path, read, walk
from neuroprior.worlds.simulators.generators import (
    GENERATORS,
    create_lazy_generators,
    find_generators,
    seed_generators,
)


class Copier(ABC):
    """Copies simulators of one kind.

    The random generators that copies hold are known, so that they can be seeded before a copy is stepped.
    """

    @abstractmethod
    def enter(self, simulator: Any, seed: int) -> Any:
        """What `load` restores, of a simulator that stays as it is and may be stepped afterwards.

        Args:
            simulator: any of its kind.
            seed: that it was made by, if it was.
        """

    @abstractmethod
    def save(self, simulator: Any, origin: tuple[Any, list[int], int]) -> Any:
        """The same of a simulator that `load` returned, and that is not stepped any more.

        Args:
            simulator: what `load` returned.
            origin: what it was loaded from, the actions taken since, and the seed of their noise.
        """

    @abstractmethod
    def load(self, saved: Any) -> Any:
        """A simulator in the state that was saved. Only that of the last call is used."""

    @abstractmethod
    def generators(self, simulator: Any) -> list[Any]:
        """The generators of a simulator that `load` returned."""

    def shared_generators(self) -> list[Any]:
        """The generators that all copies share."""
        return []

    def separate_generators(self, simulator: Any) -> list[Any]:
        """The generators of a simulator that `load` returned which no other copy shares."""
        return self.generators(simulator)

    def text(self, saved: Any) -> bytes:
        """Bytes that are the same only where all that was saved is the same; empty where there are none."""
        return b""

    def to_process(self, saved: Any) -> tuple["Copier", Any]:
        """A copier for another process, and the simulator that was saved, as that process can load it."""
        return self, saved


class _Frozen:
    """A simulator that is not stepped any more, or its pickle, once there was need of it."""

    def __init__(self, simulator: Any) -> None:
        self.simulator, self.pickle = simulator, b""


class _SharingCopier(Copier):
    """All copies share their generators, which are seeded before a copy is stepped: copies are cheaper without."""

    def __init__(self) -> None:
        self._shared: dict[Path, Any] = {}

    def generators(self, simulator: Any) -> list[Any]:
        return self.shared_generators()

    def shared_generators(self) -> list[Any]:
        return [value for value in self._shared.values() if isinstance(value, GENERATORS)]

    def separate_generators(self, simulator: Any) -> list[Any]:
        return []

    def _share(self, simulator: Any) -> dict[int, Path]:
        """The paths of what copies share by the addresses of the same in a new simulator: generators, and modules."""
        shared = {path: value for path, value in walk(simulator) if isinstance(value, (*GENERATORS, ModuleType))}
        for path in shared.keys() - self._shared.keys():
            value = shared[path]
            self._shared[path] = value if isinstance(value, ModuleType) else copy.deepcopy(value)
        return {id(value): path for path, value in shared.items()}

    def enter(self, simulator: Any, seed: int) -> Any:
        places = self._share(simulator)
        entered = self._copy(simulator, places)
        _require_own_generators(entered, simulator)
        create_lazy_generators(entered)
        places = self._share(entered)
        return self._freeze(self._copy(entered, places))

    def save(self, simulator: Any, origin: tuple[Any, list[int], int]) -> Any:
        return self._freeze(simulator)

    @abstractmethod
    def _freeze(self, simulator: Any) -> Any:
        """What `load` restores, of a simulator that is not stepped any more."""

    @abstractmethod
    def _copy(self, simulator: Any, places: dict[int, Path]) -> Any:
        """A copy in which the shared generators stand in place of those at these addresses."""


class PickleCopier(_SharingCopier):
    """Copies by pickle: a simulator is read once, and written for each copy."""

    def _freeze(self, simulator: Any) -> Any:
        return _Frozen(simulator)

    def load(self, saved: Any) -> Any:
        return self._loads(self.text(saved))

    def text(self, saved: Any) -> bytes:
        if not saved.pickle:
            places = {id(value): path for path, value in self._shared.items()}
            saved.pickle, saved.simulator = _dumps(saved.simulator, places, self._kinds()), None
        text: bytes = saved.pickle
        return text

    def to_process(self, saved: Any) -> tuple[Copier, Any]:
        """By deepcopy: a pickle names classes, which need not be known by these names in another process."""
        copier = DeepCopier()
        copier._shared = self._shared
        return copier, self.load(saved)

    def _copy(self, simulator: Any, places: dict[int, Path]) -> Any:
        return self._loads(_dumps(simulator, places, self._kinds()))

    def _kinds(self) -> set[type]:
        return {type(value) for value in self._shared.values()}

    def _loads(self, text: bytes) -> Any:
        _reading.shared = self._shared
        return pickle.loads(text)


_reading = threading.local()
"""What is shared by the copies that a thread makes."""


def _shared_at(path: Path) -> Any:
    """What stands in place of a generator or module when a pickle is read."""
    return _reading.shared[path]


def _dumps(simulator: Any, places: dict[int, Path], kinds: set[type]) -> bytes:
    """A pickle in which what stands at these addresses is named by its path; it is of these kinds."""

    def reduce(value: Any) -> Any:
        return (
            (_shared_at, (places[id(value)],)) if id(value) in places else value.__reduce_ex__(pickle.HIGHEST_PROTOCOL)
        )

    file = io.BytesIO()
    pickler = pickle.Pickler(file, pickle.HIGHEST_PROTOCOL)
    pickler.dispatch_table = copyreg.dispatch_table | dict.fromkeys(kinds, reduce)
    pickler.dump(simulator)
    return file.getvalue()


class DeepCopier(_SharingCopier):
    """Copies by `copy.deepcopy`."""

    def _freeze(self, simulator: Any) -> Any:
        return simulator

    def load(self, saved: Any) -> Any:
        return copy.deepcopy(saved, {id(value): value for value in self._shared.values()})

    def _copy(self, simulator: Any, places: dict[int, Path]) -> Any:
        return copy.deepcopy(simulator, {address: self._shared[path] for address, path in places.items()})


class CloneCopier(Copier):
    """Copies by a function; each copy has generators of its own.

    Args:
        clone: a function from a simulator to a copy of it.
    """

    def __init__(self, clone: Callable[[Any], Any]) -> None:
        self._clone, self._paths = clone, list[Path]()

    def enter(self, simulator: Any, seed: int) -> Any:
        entered = self._clone(simulator)
        _require_own_generators(entered, simulator)
        create_lazy_generators(entered)
        self._paths = list(dict.fromkeys([*self._paths, *find_generators(entered)]))
        return entered

    def save(self, simulator: Any, origin: tuple[Any, list[int], int]) -> Any:
        return simulator

    def load(self, saved: Any) -> Any:
        return self._clone(saved)

    def generators(self, simulator: Any) -> list[Any]:
        return _at_paths(simulator, self._paths)


class StateCopier(Copier):
    """Copies by the methods `get_state` and `set_state`: of each start one simulator is set to all states.

    Args:
        host: the simulator that is set, where one that is entered cannot be copied.
        deep: also copy the states, for those that go on to change with the simulator.
    """

    def __init__(self, host: Any, deep: bool) -> None:
        self._host, self._deep, self._paths = host, deep, list[Path]()
        create_lazy_generators(host)

    def enter(self, simulator: Any, seed: int) -> Any:
        try:  # what is not part of the state may differ from one simulator to another
            host = copy.deepcopy(simulator)
            create_lazy_generators(host)
        except Exception:
            host = self._host
        saved = copy.deepcopy(simulator.get_state()), host
        self._paths = list(find_generators(self.load(saved)))
        return saved

    def save(self, simulator: Any, origin: tuple[Any, list[int], int]) -> Any:
        state = simulator.get_state()
        return copy.deepcopy(state) if self._deep else state, origin[0][1]

    def load(self, saved: Any) -> Any:
        state, host = saved
        host.set_state(copy.deepcopy(state) if self._deep else state)
        return host

    def generators(self, simulator: Any) -> list[Any]:
        return _at_paths(simulator, self._paths)


class ReplayCopier(Copier):
    """Makes simulators anew and repeats what was done in them, where they cannot be copied.

    Args:
        make: a function from a seed to a new simulator.
        first_action: the number of the first action in the simulator.
    """

    def __init__(self, make: Callable[[int], Any], first_action: int) -> None:
        self._make, self._first_action = make, first_action

    def enter(self, simulator: Any, seed: int) -> Any:
        return seed, ()

    def save(self, simulator: Any, origin: tuple[Any, list[int], int]) -> Any:
        (seed, segments), actions, noise_seed = origin
        return seed, (*segments, (actions, noise_seed))

    def load(self, saved: Any) -> Any:
        seed, segments = saved
        simulator = self._make(seed)
        for actions, noise_seed in segments:
            seed_generators(self.generators(simulator), noise_seed)
            for action in actions:
                simulator.step(action + self._first_action)
        return simulator

    def generators(self, simulator: Any) -> list[Any]:
        return list(find_generators(simulator).values())


def _require_own_generators(entered: Any, simulator: Any) -> None:
    """Raise ValueError where a copy draws from a generator of the original."""
    originals = {id(generator) for generator in find_generators(simulator).values()}
    for path, generator in find_generators(entered).items():
        if id(generator) in originals:
            raise ValueError(f"`simulator` must have copies that share nothing with it; they share {name_path(path)}")


def _at_paths(simulator: Any, paths: list[Path]) -> list[Any]:
    """The generators at these paths; all that there are, where a path leads nowhere."""
    try:
        return [read(simulator, path) for path in paths]
    except (LookupError, AttributeError, TypeError):
        return list(find_generators(simulator).values())
