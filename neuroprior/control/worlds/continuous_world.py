"""The interface of a world whose actions are vectors: a batched simulator in which a planner tries its plans."""

import math
from abc import ABC, abstractmethod
from typing import Self

import torch
from torch import Tensor

from neuroprior._checks import is_number, kind_of
from neuroprior.control.vector_plans import as_floats, check_bounds, check_finite, check_vectors
from neuroprior.worlds.world import Rollout, join_states, moved


class ContinuousWorld(ABC):
    """A batched simulator whose actions are vectors of D numbers between bounds.

    A state is one tensor whose first dimension is the batch; what its other dimensions mean is up to the world.
    A subclass sets the bounds and writes `reset` and `step`; the rest has defaults.

    Attributes:
        action_low, action_high: `[D]` float32, finite: the bounds of each dimension. Actions beyond them are refused.
        action_names: names of the D dimensions (joints, muscles), where there are any.
        stochastic: True where the outcome of an action is random.
        state_shape: the dimensions of a state behind the batch, where the world says so: `check_state` holds states to
            it, and to floating point numbers.
    """

    action_low: Tensor
    action_high: Tensor
    action_names: tuple[str, ...] | None = None
    stochastic: bool = False
    state_shape: tuple[int, ...] | None = None

    @property
    def action_size(self) -> int:
        """The number of dimensions of an action, D."""
        return len(self.action_low)

    def to(self, device: torch.device | str) -> Self:
        """Move the tensors of this world, and of worlds that it holds, to `device`; returns self."""
        return moved(self, device)

    @abstractmethod
    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """Random states to plan from, `[batch_size, ...]`."""

    @abstractmethod
    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """One step.

        Args:
            state: `[N, ...]`.
            action: floating point `[N, D]` between the bounds.
            generator: draws what is random.

        Returns:
            The next state `[N, ...]` and the reward of the step, `[N]` floating point: 0 from terminated states on.
        """

    def rollout(
        self, state: Tensor, plans: Tensor, generator: torch.Generator | None = None, keep_states: bool = False
    ) -> Rollout:
        """Try P plans from each of B starts. Shapes, dtypes and bounds are checked once, here, not at every step.

        Args:
            state: `[B, ...]`.
            plans: floating point `[B, P, L, D]` between the bounds.
            generator: draws what is random.
            keep_states: also return the state after each step.

        Returns:
            Final states `[B, P, ...]`, rewards `[B, P, L]`, and states `[B, P, L, ...]` or None.

        Raises:
            ValueError: a shape, dtype or value is wrong, or what `step` returns; the message says which.
        """
        self.check_state(state)
        self.check_plans(plans, len(state))
        batch, num_plans, length, _ = plans.shape
        now = state.repeat_interleave(num_plans, 0)
        rewards, states = [torch.zeros(batch, num_plans, 0, device=state.device)], []
        for t in range(length):
            now, reward = check_outcome(now, self.step(now, plans[:, :, t].flatten(0, 1), generator))
            rewards.append(reward.view(batch, num_plans, 1))
            if keep_states:
                states.append(now)
        shape = (batch, num_plans, *state.shape[1:])
        kept = join_states(states, state, shape) if keep_states else None
        return Rollout(now.view(shape), torch.cat(rewards, -1), kept)

    def observe(self, state: Tensor) -> Tensor:
        """The observation in `state [N, ...]`: floating point features `[N, C]`. Default: the state, flattened."""
        return state[:, None].flatten(1).float()

    def terminated(self, state: Tensor) -> Tensor:
        """Which of `state [N, ...]` are final: `[N]` bool. Default: none."""
        return torch.zeros(state.shape[0], dtype=torch.bool, device=state.device)

    def check_bounds(self) -> None:
        """Raise ValueError unless the bounds are float32 tensors `[D]` of ranges that float32 resolves."""
        for name in ("action_low", "action_high"):
            bound = getattr(self, name)
            if not isinstance(bound, Tensor) or bound.dtype != torch.float32:
                raise ValueError(f"`{name}` must be a float32 tensor, got {bound!r}")
        check_bounds(self.action_low, self.action_high)

    def check_state(self, state: Tensor) -> None:
        """Raise ValueError where `state` cannot be a batch of this world's states, or is not finite."""
        if not isinstance(state, Tensor) or state.dim() == 0:
            raise ValueError(f"`state` must be a tensor of shape [B, ...], got {kind_of(state)}")
        if self.state_shape is not None and not (
            state.is_floating_point() and tuple(state.shape[1:]) == self.state_shape
        ):
            shape = ", ".join(map(str, ("B", *self.state_shape)))
            raise ValueError(f"`state` must be floating point numbers [{shape}], got {state.dtype} {list(state.shape)}")
        check_finite("state", state)

    def check_plans(self, plans: Tensor, batch_size: int) -> None:
        """Raise ValueError unless `plans` are vectors `[batch_size, P, L, D]` between the bounds."""
        if not isinstance(plans, Tensor) or plans.dim() != 4 or len(plans) != batch_size:
            got = list(plans.shape) if isinstance(plans, Tensor) else kind_of(plans)
            raise ValueError(f"`plans` must have shape [B, P, L, D] with B = {batch_size} starts, got {got}")
        check_vectors("plans", plans, self.action_low, self.action_high)


def check_is_continuous(world: object) -> None:
    """Raise ValueError unless it is a `ContinuousWorld` whose bounds are right."""
    if not isinstance(world, ContinuousWorld):
        raise ValueError(f"`world` must be a ContinuousWorld, whose actions are vectors, got {kind_of(world)}")
    world.check_bounds()


def check_outcome(state: Tensor, outcome: object) -> tuple[Tensor, Tensor]:
    """Returns the next state and the reward of a step from `state [N, ...]`.

    Raises:
        ValueError: `outcome` is not a state of the same shape and dtype, and a floating point reward `[N]`.
    """
    if not isinstance(outcome, tuple) or [isinstance(value, Tensor) for value in outcome] != [True, True]:
        kinds = [kind_of(value) for value in outcome] if isinstance(outcome, tuple) else kind_of(outcome)
        raise ValueError(f"`step` must return two tensors, the next state and the reward, got {kinds}")
    after, reward = outcome
    if after.shape != state.shape or after.dtype != state.dtype:
        raise ValueError(
            f"`step` must return a next state of {state.dtype} {list(state.shape)}, as the state, got {after.dtype}"
            f" {list(after.shape)}"
        )
    if reward.shape != state.shape[:1] or not reward.is_floating_point():
        raise ValueError(
            f"`step` must return a floating point reward [{len(state)}], got {reward.dtype} {list(reward.shape)}"
        )
    return after, reward


def check_positive(zero: bool = False, **numbers: object) -> None:
    """Raise ValueError, naming the argument, unless all are finite numbers above 0, or 0 where `zero`."""
    for name, number in numbers.items():
        if not is_number(number) or not math.isfinite(number) or not (number > 0 or (zero and number == 0)):
            raise ValueError(f"`{name}` must be finite and {'at least' if zero else 'above'} 0, got {number!r}")


def finite_vector(name: str, values: object, size: int) -> Tensor:
    """`values` as float32 `[size]`; ValueError, naming the argument, unless they are `size` finite numbers."""
    vector = as_floats(name, values)
    if vector.shape != (size,) or not vector.isfinite().all():
        raise ValueError(f"`{name}` must be {size} finite numbers, got {values!r}")
    return vector
