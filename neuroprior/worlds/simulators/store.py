"""The states of simulators: how each was reached, and copies of those that were used last."""

from array import array
from collections import OrderedDict
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

Value = TypeVar("Value")


class Recent(OrderedDict[int, Value], Generic[Value]):
    """What was used last, at most `size` of it."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.size = size

    def use(self, handle: int) -> Value | None:
        """What belongs to a handle, if it is there."""
        value = self.get(handle)
        if value is not None:
            self.move_to_end(handle)
        return value

    def put(self, handle: int, value: Value) -> None:
        """Keep a value, in place of the one that was not used for longest."""
        self[handle] = value
        self.move_to_end(handle)
        if len(self) > self.size:
            self.popitem(last=False)


class Segment(NamedTuple):
    """Actions from the state `start`, under the noise of a seed."""

    start: int
    actions: bytes
    seed: int


class Store:
    """Numbers states, and knows how each was reached: by which actions from which other state, under which noise.

    The same actions from the same state under the same noise always have the same number. In a deterministic world all
    actions count from the first state of an episode, so that a state is the same by whatever steps it is reached.

    Args:
        num_actions: A.
        deterministic: whether there is no noise; may become False.
    """

    def __init__(self, num_actions: int, deterministic: bool) -> None:
        self._kind = np.dtype(np.uint8 if num_actions <= 2**8 else np.int32)
        self.deterministic = deterministic
        self._numbers: dict[Segment, int] = {}
        self._segments: list[Segment] = []
        self._rewards, self._ended = array("d"), array("b")

    def __len__(self) -> int:
        return len(self._segments)

    def add_start(self, seed: int) -> int:
        """The number of the first state of an episode that a seed makes."""
        return self._add(Segment(-1, b"", seed), 0.0, False)

    def add(self, start: int, actions: list[int], seed: int, reward: float, ended: bool) -> int:
        """The number of the state that actions lead to, by the last of which there was a reward and perhaps an end."""
        return self._add(self._segment(start, actions, seed), reward, ended) if actions else start

    def find(self, start: int, actions: list[int], seed: int) -> int | None:
        """The number of the state that actions lead to, where it has one."""
        return self._numbers.get(self._segment(start, actions, seed))

    def reward(self, handle: int) -> float:
        """The reward of the last action before a state."""
        return self._rewards[handle]

    def ended(self, handle: int) -> bool:
        """Whether an episode ended in a state."""
        return bool(self._ended[handle])

    def start_seed(self, handle: int) -> int | None:
        """The seed that makes this first state of an episode; None: it is no first state."""
        segment = self._segments[handle]
        return segment.seed if segment.start < 0 else None

    def before(self, handle: int, kept: Recent[Any]) -> tuple[int, list[int], int]:
        """An earlier state, in a deterministic world the last that is `kept`, the actions since, and their seed."""
        start, actions, seed = self._segments[handle]
        width = self._kind.itemsize
        if self.deterministic:
            for end in range(len(actions) - width, 0, -width):
                earlier = self._numbers.get(Segment(start, actions[:end], seed), -1)
                if earlier in kept:
                    return earlier, self._read(actions[end:]), seed
        return start, self._read(actions), seed

    def _segment(self, start: int, actions: list[int], seed: int) -> Segment:
        written = bytes(actions) if self._kind.itemsize == 1 else np.array(actions, self._kind).tobytes()
        if self.deterministic:
            first = self._segments[start]
            if first.start >= 0:
                return Segment(first.start, first.actions + written, first.seed)
        return Segment(start, written, seed)

    def _add(self, segment: Segment, reward: float, ended: bool) -> int:
        number = self._numbers.setdefault(segment, len(self._segments))
        if number == len(self._segments):
            self._segments.append(segment)
            self._rewards.append(reward)
            self._ended.append(ended)
        return number

    def _read(self, actions: bytes) -> list[int]:
        read: list[int] = np.frombuffer(actions, self._kind).tolist()
        return read
