"""A point mass that is pushed to a goal: the double integrator of control theory."""

from collections.abc import Sequence

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._random import generator_on
from neuroprior.control.worlds.continuous_world import ContinuousWorld, check_positive, finite_vector


class DoubleIntegrator(ContinuousWorld):
    """A point mass in D dimensions, without friction; the action is the force on it.

    A state is `[N, 2 * D]` float32: position (m), then velocity (m/s). The force (N) is constant during a step, so that
    the step is exact: with the acceleration a = force / mass, velocity grows by a t and position by v t + a t² / 2.
    The reward of a step is minus `step_seconds` times (`|position - goal|²` + `velocity_cost` `|velocity|²` +
    `force_cost` `|force|²`), of the position and velocity at its end. Without bounds the best control is the linear
    quadratic regulator (Anderson and Moore, Optimal Control, chapter 2).

    Args:
        num_dimensions: D.
        mass: in kg.
        goal: `[D]` in m; None for the origin.
        step_seconds: the duration of a step.
        max_force: the bound of the force in each dimension, in N.
        velocity_cost, force_cost: see above.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = DoubleIntegrator(num_dimensions=1)
        >>> state, reward = world.step(torch.tensor([[1.0, 0.0]]), torch.tensor([[-1.0]]))
        >>> state.double().round(decimals=3).tolist()
        [[0.995, -0.1]]
    """

    def __init__(
        self,
        num_dimensions: int = 2,
        *,
        mass: float = 1.0,
        goal: Sequence[float] | Tensor | None = None,
        step_seconds: float = 0.1,
        max_force: float = 1.0,
        velocity_cost: float = 0.1,
        force_cost: float = 0.01,
    ) -> None:
        check_sizes(num_dimensions=num_dimensions)
        check_positive(mass=mass, step_seconds=step_seconds, max_force=max_force)
        check_positive(zero=True, velocity_cost=velocity_cost, force_cost=force_cost)
        self.goal = finite_vector("goal", [0.0] * num_dimensions if goal is None else goal, num_dimensions)
        self.mass, self.step_seconds = float(mass), float(step_seconds)
        self.velocity_cost, self.force_cost = float(velocity_cost), float(force_cost)
        self.action_low = torch.full((num_dimensions,), -float(max_force))
        self.action_high = -self.action_low
        self.state_shape = (2 * num_dimensions,)

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """Positions (m) and velocities (m/s), float32 `[batch_size, 2 * D]`, each uniform between -1 and 1."""
        device = self.action_low.device
        draws = generator_on(generator, device)
        return 2 * torch.rand(batch_size, 2 * self.action_size, generator=draws, device=device) - 1

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        position, velocity = state.chunk(2, -1)
        seconds, acceleration = self.step_seconds, action.to(state) / self.mass
        position = position + velocity * seconds + acceleration * (seconds**2 / 2)
        velocity = velocity + acceleration * seconds
        cost = (
            (position - self.goal.to(state)).square().sum(-1)
            + self.velocity_cost * velocity.square().sum(-1)
            + self.force_cost * action.to(state).square().sum(-1)
        )
        return torch.cat([position, velocity], -1), -seconds * cost

    def observe(self, state: Tensor) -> Tensor:
        """Position relative to the goal, then velocity: `[N, 2 * D]`."""
        position, velocity = state.chunk(2, -1)
        return torch.cat([position - self.goal.to(state), velocity], -1).float()
