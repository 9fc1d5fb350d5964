"""What sampling needs of a prior (`Steppable`), and one way to step any prior, whatever else it offers (`Stepper`)."""

from contextlib import AbstractContextManager
from functools import cached_property
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from torch import Tensor

from neuroprior._checks import check_same_names, describe, is_integer
from neuroprior._threads import one_thread
from neuroprior.plans.plans import as_single
from neuroprior.sampling.draws import Draw, after_end, are_few
from neuroprior.sampling.states import State, has_rows
from neuroprior.worlds.world import World, allowed_actions, check_is_world

FEWEST_TO_SHARE = 256
"""The number of states from which the distinct ones are found, so that each is observed once."""

WORTH_THREADS = 2**27
"""Plans times parameters of their prior from which threads share a step. With less, or with a table, they gain next to
nothing, and on a busy machine wait for one another for milliseconds at each operation.
"""


@runtime_checkable
class Steppable(Protocol):
    """What samplers and planners need of a prior: any class with these three will do.

    The state is a tensor or a tuple of tensors, each with the batch as its first dimension; see `select_rows`.

    What a prior may offer besides, and is then used (every `neuroprior.priors.Prior` offers all of it):

    - `context_per`: "step" or "plan": `start`, and with "step" also `step`, get a context as last argument; without
      this attribute, or None, they never get one. `check_context_of(context, num_plans, length)` raises ValueError for
      a context that does not fit.
    - `end`: the action that ends a plan.
    - `step_shared(action, state, context, row)`: as `step`, where plans get the same input: `action [K]` and
      `context [K, ...]` are the distinct ones, `row [N]` says which of them each plan gets.
    - `draw_rest(action, state, uniform, temperature)`: the actions `[N, T]` that follow `action [N]`, drawn with the
      numbers `uniform [T, N]`; None: not now, so that the prior is stepped.
    - `draw_plans(state, counts, length, temperature, generator)`: `counts[r]` plans `[N, length]` from each row of
      `state [R, ...]` before their first actions, row by row; None: not now.
    - `device`: where the prior computes; a prior that takes a context computes on the CPU without it.
    - `shares_steps`: true where steps of different plans may be taken on several threads at once.

    Attributes:
        num_actions: A.
    """

    @property
    def num_actions(self) -> int: ...

    def start(self, batch_size: int, /) -> tuple[Tensor, Any]:
        """Logits `[N, A]` of the first action, and the state, for N = `batch_size` plans."""

    def step(self, action: Tensor, state: Any, /) -> tuple[Tensor, Any]:
        """Logits `[N, A]` of the next action and the next state, after `action [N]` (int64) in `state`."""


class Stepper:
    """A prior as samplers and planners step it: with what it leaves out filled in.

    Args:
        prior: any prior.

    Attributes:
        num_actions: A.
        context_per: "plan" or "step"; None for a prior without context.
        end: the end symbol; None for a prior without one.
        shares: whether several threads may step at once.
    """

    def __init__(self, prior: Steppable) -> None:
        self._prior: Any = prior
        self.num_actions = prior.num_actions
        self.context_per: Literal["plan", "step"] | None = getattr(prior, "context_per", None)
        self.end: int | None = getattr(prior, "end", None)
        self.shares: bool = getattr(prior, "shares_steps", False)
        self._draw_rest = getattr(prior, "draw_rest", None) if self.end is None else None
        self._draw_plans = getattr(prior, "draw_plans", None)
        self._step_shared = getattr(prior, "step_shared", None)

    @property
    def device(self) -> torch.device:
        """Where the prior computes."""
        device = getattr(self._prior, "device", None)
        if device is None:  # no context is known yet that could be given to `start`
            device = "cpu" if self.context_per is not None else getattr(self._prior.start(1)[0], "device", "cpu")
        return torch.device(device)

    @cached_property
    def _alone(self) -> float:
        """The most plans that are stepped on one thread."""
        if not isinstance(self._prior, torch.nn.Module):
            return 0.0
        numbers = getattr(self._prior, "num_weights", None)
        if numbers is None:
            numbers = sum(weights.numel() for weights in self._prior.parameters())
        return WORTH_THREADS / numbers if numbers else float("inf")

    def threads_for(self, num_plans: int) -> AbstractContextManager[None]:
        """torch on one thread, until the block ends, where more do not pay for so many plans."""
        return one_thread(num_plans <= self._alone)

    def check_context(self, context: Tensor | None, num_plans: int = 0, length: int = 0) -> None:
        """Raise ValueError unless the prior takes such a context for so many plans of this length."""
        check = getattr(self._prior, "check_context_of", None)
        if check is not None:
            check(context, num_plans, length)
        elif (context is None) != (self.context_per is None):
            raise ValueError(
                f"context: this prior {'takes none' if context is not None else 'takes one, and none was given'}"
            )

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, State]:
        """Logits `[N, A]` of the first action, and the state.

        Raises:
            ValueError: the prior gives other logits.
        """
        with self.threads_for(batch_size):
            outputs = self._prior.start(batch_size) if context is None else self._prior.start(batch_size, context)
        return check_outputs(outputs, batch_size, self.num_actions, "start")

    def step(self, action: Tensor, state: State, context: Tensor | None = None) -> tuple[Tensor, State]:
        """Logits `[N, A]` of the next action, and the next state.

        After the end symbol nothing else has a probability above 0.

        Raises:
            ValueError: the prior gives other logits.
        """
        with self.threads_for(len(action)):
            outputs = self._prior.step(action, state, *(() if context is None else (context,)))
        logits, state = check_outputs(outputs, len(action), self.num_actions, "step")
        return after_end(logits, action, self.end), state

    def draw_rest(self, action: Tensor, state: State, uniform: Tensor, temperature: float) -> Tensor | None:
        """The rest of N plans, `[N, T]`, where the prior draws it at once; see `Steppable`."""
        rest: Tensor | None = None if self._draw_rest is None else self._draw_rest(action, state, uniform, temperature)
        return rest

    def draw_plans(self, state: State, counts: Tensor, length: int, draw: Draw) -> Tensor | None:
        """Plans from few states, where the prior draws them at once; see `Steppable`."""
        if self._draw_plans is None:
            return None
        plans: Tensor | None = self._draw_plans(state, counts, length, draw.temperature, draw.generator)
        return plans

    def start_in(self, world: World, state: Tensor) -> tuple[Tensor, State]:
        """As `start`, with the observation of `state [B, ...]` as context.

        Raises:
            ValueError: the prior cannot act in the world, or its context is not what the world observes.
        """
        check_in_world(self._prior, world, state)
        context = None if self.context_per is None else world.context(state)
        self.check_context(context, len(state))
        return self.start(len(state), context)

    def step_in(self, world: World, action: Tensor, state: State, reached: Tensor) -> tuple[Tensor, State]:
        """As `step`, after `action` led to the world's states `reached [N, ...]`; each is observed once."""
        if self.context_per == "step" and self._step_shared is not None and _are_numbers(reached):
            pair, row = (reached * self.num_actions + action).unique(return_inverse=True)
            context, action = world.context(pair // self.num_actions), pair % self.num_actions
            with self.threads_for(len(row)):
                outputs = self._step_shared(action, state, context, row)
            return check_outputs(outputs, len(row), self.num_actions, "step_shared")
        return self.step(action, state, world.context(reached) if self.context_per == "step" else None)


def check_outputs(outputs: Any, num_plans: int, num_actions: int, method: str) -> tuple[Tensor, State]:
    """Logits `[N, A]` and the state that a prior's `method` returned; logits in half precision as float32.

    Raises:
        ValueError: they are none, or of another number of plans or actions.
    """
    if not isinstance(outputs, tuple) or len(outputs) != 2:
        raise ValueError(f"prior: `{method}` must return logits and a state, got {describe(outputs)}")
    logits, state = outputs
    if not has_rows(state, num_plans):
        raise ValueError(
            f"prior: `{method}` must return a state of {num_plans} rows, a tensor or a tuple of such tensors, got"
            f" {describe(state)}"
        )
    return check_logits(logits, [num_plans, num_actions], method), state


def check_logits(logits: Any, shape: list[int], method: str) -> Tensor:
    """The logits that a prior's `method` returned; those in half precision as float32, in which they are summed.

    Raises:
        ValueError: they are no floating point tensor of this shape.
    """
    if not isinstance(logits, Tensor) or not logits.is_floating_point() or list(logits.shape) != shape:
        raise ValueError(f"prior: `{method}` must return floating point logits {shape}, got {describe(logits)}")
    return as_single(logits)


def _are_numbers(reached: Tensor) -> bool:
    """Whether states are numbers, and enough of them that finding the distinct ones pays."""
    enough = len(reached) >= FEWEST_TO_SHARE and not are_few(len(reached), reached.device)
    return reached.dim() == 1 and is_integer(reached) and enough


def check_in_world(prior: Steppable, world: World, state: Tensor) -> None:
    """Raise ValueError unless a prior can act in a world from `state [B, ...]`."""
    check_is_world(world)
    world.check_state(state)
    device = getattr(prior, "device", None)
    if device is not None and torch.device(device).type != state.device.type:
        raise ValueError(
            f"prior: it is on {device}, and the states on {state.device}; move one of them, as prior.to(state.device)"
        )
    if getattr(prior, "end", None) is not None:
        raise ValueError(
            "prior: it samples an end symbol, which is no action of the world; fit it to plans without one"
        )
    check_actions(prior, world)


def check_actions(prior: Steppable, world: World) -> None:
    """Raise ValueError unless a prior has as many actions as a world, and no other names for them."""
    if prior.num_actions != world.num_actions:
        raise ValueError(f"`prior` must have {world.num_actions} actions, as the world, got {prior.num_actions}")
    check_same_names(
        "action_names", getattr(prior, "action_names", None), world.action_names, "the world", "the prior",
        "number them alike, or learn from plans without names",
    )  # fmt: skip


def legal_logits(world: World, state: Tensor, logits: Tensor) -> Tensor:
    """`logits [N, A]` with -inf for the actions that no plan may take in `state [N, ...]`, see `allowed_actions`."""
    return logits if world.all_legal else logits.masked_fill(~allowed_actions(world, state), -torch.inf)
