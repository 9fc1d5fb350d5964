"""The interface of a world whose actions are vectors: a batched simulator in which a planner tries its plans."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor

from neuroprior._checks import kind_of
from neuroprior.control.vector_plans import check_widths
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
            now, reward = outcome_of(now, self.step(now, plans[:, :, t].flatten(0, 1), generator))
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
        """Raise ValueError unless the bounds are tensors `[D]` of finite float32 numbers, the lower below the upper."""
        for name in ("action_low", "action_high"):
            bound = getattr(self, name)
            known = isinstance(bound, Tensor) and bound.dtype == torch.float32 and bound.dim() == 1 and len(bound)
            if not known or not bound.isfinite().all():
                raise ValueError(f"{name}: a tensor [D] of finite float32 numbers is expected, not {bound!r}")
        low, high = self.action_low, self.action_high
        if low.shape != high.shape or not (low < high).all():
            raise ValueError(
                f"action_low, action_high: each lower bound below its upper bound is expected, not {low.tolist()} and"
                f" {high.tolist()}"
            )
        check_widths(low, high)

    def check_state(self, state: Tensor) -> None:
        """Raise ValueError where `state` cannot be a batch of this world's states, or is not finite."""
        if not isinstance(state, Tensor) or state.dim() == 0:
            raise ValueError("state: a tensor of shape [B, ...] is expected, not a single number or another type")
        if self.state_shape is not None and not (
            state.is_floating_point() and tuple(state.shape[1:]) == self.state_shape
        ):
            shape = ", ".join(map(str, ("B", *self.state_shape)))
            raise ValueError(
                f"state: floating point numbers [{shape}] are expected, not {state.dtype} {list(state.shape)}"
            )
        if not state.isfinite().all():
            where = (~state.isfinite()).nonzero()[0].tolist()
            raise ValueError(f"state{where}: {float(state[tuple(where)])} is not a finite number")

    def check_plans(self, plans: Tensor, batch_size: int) -> None:
        """Raise ValueError unless `plans` are vectors `[batch_size, P, L, D]` between the bounds."""
        if not isinstance(plans, Tensor) or plans.dim() != 4 or len(plans) != batch_size:
            given = list(plans.shape) if isinstance(plans, Tensor) else type(plans).__name__
            raise ValueError(f"plans: shape [B, P, L, D] with B = {batch_size} starts is expected, not {given}")
        check_vectors("plans", plans, self.action_low, self.action_high)


def check_is_continuous(world: object) -> None:
    """Raise ValueError unless it is a `ContinuousWorld` whose bounds are right."""
    if not isinstance(world, ContinuousWorld):
        raise ValueError(f"world: a ContinuousWorld, whose actions are vectors, is expected, not {kind_of(world)}")
    world.check_bounds()


def outcome_of(state: Tensor, outcome: object) -> tuple[Tensor, Tensor]:
    """`outcome` of a step from `state [N, ...]`: the next state and the reward.

    Raises:
        ValueError: it is not a state of the same shape and dtype, and a floating point reward `[N]`.
    """
    if not isinstance(outcome, tuple) or [isinstance(part, Tensor) for part in outcome] != [True, True]:
        kinds = [type(part).__name__ for part in outcome] if isinstance(outcome, tuple) else type(outcome).__name__
        raise ValueError(f"step: a tuple of two tensors, the next state and the reward, is expected, not {kinds}")
    after, reward = outcome
    if after.shape != state.shape or after.dtype != state.dtype:
        raise ValueError(
            f"step: a next state of {state.dtype} {list(state.shape)}, as the state, is expected, not {after.dtype}"
            f" {list(after.shape)}"
        )
    if reward.shape != state.shape[:1] or not reward.is_floating_point():
        raise ValueError(
            f"step: a floating point reward [{len(state)}] is expected, not {reward.dtype} {list(reward.shape)}"
        )
    return after, reward


def check_vectors(name: str, vectors: Tensor, low: Tensor, high: Tensor) -> None:
    """Raise ValueError unless `vectors [..., D]` are floating point numbers between `low [D]` and `high [D]`.

    A millionth of the range beyond the bounds is taken for rounding.

    Args:
        name: what messages call them.
        vectors, low, high: the vectors and their bounds.

    Example:
        >>> check_vectors("actions", torch.zeros(3, 2), torch.tensor([-1.0, -1.0]), torch.tensor([1.0, 1.0]))
    """
    if not vectors.is_floating_point():
        raise ValueError(
            f"{name}: floating point numbers are expected, not {str(vectors.dtype).removeprefix('torch.')}"
        )
    if not vectors.dim() or vectors.shape[-1] != len(low):
        raise ValueError(f"{name}: vectors of {len(low)} numbers are expected, not {list(vectors.shape)}")
    slack = 1e-6 * (high - low)
    inside = (vectors >= low - slack) & (vectors <= high + slack)
    if not inside.all():
        where = (~inside).nonzero()[0].tolist()
        d = where[-1]
        raise ValueError(
            f"{name}{where}: {float(vectors[tuple(where)]):g} is not between the bounds of dimension {d},"
            f" {float(low[d]):g} and {float(high[d]):g}"
        )


def check_positive(zero: bool = False, **numbers: object) -> None:
    """Raise ValueError, naming the argument, unless all are finite numbers above 0, or 0 where `zero`."""
    for name, number in numbers.items():
        real = isinstance(number, int | float) and not isinstance(number, bool) and math.isfinite(number)
        if not real or not (number > 0 or (zero and number == 0)):  # type: ignore[operator]
            raise ValueError(
                f"{name}: a finite number {'of at least' if zero else 'above'} 0 is expected, not {number!r}"
            )


def finite_vector(name: str, values: Sequence[float] | Tensor | object, size: int) -> Tensor:
    """`values` as float32 `[size]`; ValueError, naming the argument, unless they are `size` finite numbers."""
    try:
        vector = torch.as_tensor(values, dtype=torch.float32)
    except (RuntimeError, TypeError, ValueError):
        vector = torch.empty(0)
    if vector.shape != (size,) or not vector.isfinite().all():
        raise ValueError(f"{name}: {size} finite numbers are expected, not {values!r}")
    return vector
