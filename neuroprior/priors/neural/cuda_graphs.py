"""Plans that are drawn on a CUDA device by a step that is recorded once and replayed.

A step of a small network is dozens of short operations, and giving the device its orders takes longer than they do. A
CUDA graph gives them all at once.
"""

import math
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from threading import Lock
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

Take = Callable[..., tuple[Tensor, Tensor]]
"""A step of N plans: their last actions, their states and random numbers to the next actions and states, all of the
same shapes. It waits for nothing on the device."""

DEVICES = ("cuda",)
"""Kinds of devices on which steps are recorded."""

WORTH, LARGEST, KEPT = 16, 2**26, 4
"""Steps of as many plans after which one is recorded; the most numbers in their states; and recordings of a prior that
are kept, which hold the memory of a step."""

WARM_UP = 3
"""Steps before the one that is recorded, in which libraries choose their kernels and take their memory."""


class Recording:
    """A step of N plans.

    Args:
        take: the step.
        last: `[N, ...]`, `state [N, ...]` and `numbers`, each `[N, ...]`: such as it will be given.

    Attributes:
        agrees: whether it led from these to the state to which the step leads.
    """

    def __init__(self, take: Take, last: Tensor, state: Tensor, numbers: Sequence[Tensor]) -> None:
        self._last, self._state, self._numbers = last.clone(), state.clone(), [each.clone() for each in numbers]

        def step() -> None:
            now, after = take(self._last, self._state, *self._numbers)
            self._state.copy_(after)
            self._last.copy_(now)

        aside, here = torch.cuda.Stream(state.device), torch.cuda.current_stream(state.device)
        aside.wait_stream(here)
        with torch.cuda.stream(aside):
            for _ in range(WARM_UP):
                step()
        here.wait_stream(aside)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            step()
        self.run(last, state, [each[None] for each in numbers])
        due = take(last, state.clone(), *numbers)[1]
        self.agrees = torch.allclose(self._state, due, rtol=1e-3, atol=1e-3, equal_nan=True)

    def run(self, last: Tensor, state: Tensor, numbers: Sequence[Tensor]) -> Tensor:
        """The actions `[T, N, ...]` of T steps with random `numbers`, each `[T, N, ...]`."""
        self._last.copy_(last)
        self._state.copy_(state)
        taken = last.new_empty(len(numbers[0]), *last.shape)
        for t, actions in enumerate(taken):
            for room, each in zip(self._numbers, numbers, strict=True):
                room.copy_(each[t])
            self._graph.replay()
            actions.copy_(self._last)
        return taken


def is_hooked(module: nn.Module) -> bool:
    """Whether other code is to run when it, or a part of it, is called."""
    return any(part._forward_hooks or part._forward_pre_hooks for part in module.modules())


class _Known:
    """Of a prior: its recordings, or how many steps there were without one; -inf where there can be none."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.made: OrderedDict[Hashable, Recording | float] = OrderedDict()


_KNOWN: WeakKeyDictionary[nn.Module, _Known] = WeakKeyDictionary()
_LOCK = Lock()


def run_recorded(
    prior: nn.Module, take: Take, last: Tensor, state: Tensor, numbers: Sequence[Tensor], key: Hashable = None
) -> Tensor | None:
    """The actions `[T, N, ...]` of T steps of a prior, by a recording; None where one does not pay, or does not work.

    Args:
        prior: whose step it is. It must predict as its class does, and not be in training.
        take: the step.
        last: `[N, ...]`, the last actions.
        state: `[N, ...]`, before these.
        numbers: each `[T, N, ...]`, random ones.
        key: what else the step depends on.
    """
    steady = not (prior.training or torch.is_grad_enabled() or torch.is_autocast_enabled(state.device.type))
    fits, steps = 0 < state.numel() <= LARGEST, len(numbers[0])
    if state.device.type not in DEVICES or not steady or is_hooked(prior) or not fits or not steps:
        return None
    weights = tuple(tensor.data_ptr() for tensor in (*prior.parameters(), *prior.buffers()))
    # Each stream has recordings of its own, which no other one overwrites while they run.
    stream = torch.cuda.current_stream(state.device).cuda_stream if state.is_cuda else 0
    key = weights, state.shape, stream, torch.is_inference_mode_enabled(), key
    with _LOCK:
        known = _KNOWN.setdefault(prior, _Known())
    with known.lock:
        made = known.made.pop(key, 0)
        if not isinstance(made, Recording):
            made += steps
            if made >= WORTH:
                made = Recording(take, last, state, [each[0] for each in numbers])
                if not made.agrees:
                    warnings.warn(f"a recorded step of {type(prior).__name__} differs, and is not used", stacklevel=2)
                    made = -math.inf
        known.made[key] = made
        while len(known.made) > KEPT:
            known.made.popitem(last=False)
        return made.run(last, state, numbers) if isinstance(made, Recording) else None
