"""A planar arm that reaches for a goal among obstacles."""

from collections.abc import Sequence

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._random import generator_on
from neuroprior.control.worlds.continuous_world import ContinuousWorld, check_positive, finite_vector

START_STD = 0.1
"""Standard deviation of the first angles about the stretched arm, in radians."""

STEP_SECONDS, MAX_TORQUE = 0.05, 2.0
"""The duration of a step, and the bound of the first joint's torque, in N m."""


class PlanarArm(ContinuousWorld):
    """An arm of n links in a horizontal plane, each a thin uniform rod; the action is the torque of each joint.

    The base is at the origin and the stretched arm 1 m long. A state is `[N, 2 * n]` float32: the angle of each joint
    (rad; that of the first against the x axis, of the others against the link before; 0: straight), then their speeds
    (rad/s). The dynamics are those of the coupled links (inertia and centrifugal terms; no gravity) with damped joints,
    by semi-implicit Euler steps of .05 s / `num_substeps` in which damping is implicit: of first order, and
    stable. Joint j, counted from 0, is weaker and less damped than the first by the factor (1 - j / n)².

    Obstacles do not block the arm, they cost: the reward of a step is minus the distance of the hand to the goal, minus
    `control_cost` times the mean square of the torques as shares of their bounds, minus `obstacle_cost` times how deep
    each link is inside each obstacle (m, summed), at the end of the step. With the default obstacle the stretched arm
    cannot swing to the goal: it must fold, pass, and stretch again.

    Args:
        num_links: n.
        masses: a factor of the mass, and so the inertia, of all links, which weigh 1 kg together at 1.
        goal: `[2]`, where the hand should be, in m.
        obstacles: circles `[M, 3]`: x, y and radius, in m; M may be 0.
        num_substeps: steps of the integrator in a step.
        damping: of the first joint, in N m s.
        control_cost, obstacle_cost: see above.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = PlanarArm(num_links=2)
        >>> world.reset(3, torch.Generator().manual_seed(0)).shape, world.action_high.tolist()
        (torch.Size([3, 4]), [2.0, 0.5])
    """

    def __init__(
        self,
        num_links: int = 3,
        *,
        masses: float = 1.0,
        goal: Sequence[float] | Tensor = (0.0, 0.9),
        obstacles: Sequence[Sequence[float]] | Tensor = ((0.6, 0.5, 0.25),),
        num_substeps: int = 2,
        damping: float = 0.5,
        control_cost: float = 0.01,
        obstacle_cost: float = 20.0,
    ) -> None:
        check_sizes(num_links=num_links, num_substeps=num_substeps)
        check_positive(masses=masses)
        check_positive(zero=True, damping=damping, control_cost=control_cost, obstacle_cost=obstacle_cost)
        self.goal = finite_vector("goal", goal, 2)
        self.obstacles = torch.stack(
            [finite_vector(f"obstacles[{i}]", circle, 3) for i, circle in enumerate(obstacles)] or [torch.zeros(3)]
        )[: len(obstacles)]
        if not bool((self.obstacles[:, 2] > 0).all()):
            raise ValueError("`obstacles` must have radii above 0")
        self.num_substeps = num_substeps
        self.control_cost, self.obstacle_cost = float(control_cost), float(obstacle_cost)
        strength = (1 - torch.arange(num_links) / num_links).square()
        self.action_high = MAX_TORQUE * strength
        self.action_low = -self.action_high
        self.state_shape = (2 * num_links,)
        # In absolute angles the kinetic energy is half the sum of coupling[i, j] cos(angle_i - angle_j) v_i v_j.
        link = torch.arange(num_links)
        beyond = num_links - 1 - torch.maximum(link[:, None], link)
        rods = masses / num_links**3
        self._coupling = rods * (beyond + torch.where(link[:, None] == link, 1 / 3, 1 / 2))
        # Row j: the speed of joint j is the difference between the absolute speeds of the links j and j - 1.
        self._joints = torch.eye(num_links) - torch.diag(torch.ones(num_links - 1), -1)
        self._damping = self._joints.T @ torch.diag(damping * strength) @ self._joints

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """The arm at rest, nearly stretched along the x axis: each angle normal with standard deviation 0.1."""
        device = self.action_low.device
        draws = generator_on(generator, device)
        angles = START_STD * torch.randn(batch_size, self.action_size, generator=draws, device=device)
        return torch.cat([angles, torch.zeros_like(angles)], -1)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        action, joints = action.to(state), self._joints.to(state)
        coupling, damping = self._coupling.to(state), self._damping.to(state)
        seconds = STEP_SECONDS / self.num_substeps
        angle, speed = state.view(len(state), 2, -1).cumsum(-1).unbind(1)  # absolute, of the links
        torque = action @ joints
        for _ in range(self.num_substeps):
            difference = angle[:, :, None] - angle[:, None]
            centrifugal = (coupling * difference.sin() * speed.square()[:, None]).sum(-1)
            force = torque - centrifugal - speed @ damping
            inertia = coupling * difference.cos() + seconds * damping
            change = torch.cholesky_solve(seconds * force[:, :, None], torch.linalg.cholesky_ex(inertia).L)
            speed = speed + change[:, :, 0]
            angle = angle + seconds * speed
        after = torch.cat([angle @ joints.T, speed @ joints.T], -1)
        return after, self._reward(angle, action)

    def _reward(self, angle: Tensor, action: Tensor) -> Tensor:
        """Of absolute angles `[N, n]` at the end of a step, and its torques: `[N]`."""
        ends = self._ends(angle)
        reward = -(ends[:, -1] - self.goal.to(ends)).square().sum(-1).sqrt()
        reward = reward - self.control_cost * (action / self.action_high.to(action)).square().mean(-1)
        circles = self.obstacles.to(ends)
        length = 1 / self.action_size
        along = (ends[:, 1:] - ends[:, :-1])[:, :, None] / length
        offset = circles[:, :2] - ends[:, :-1, None]  # [N, n, M, 2]
        nearest = (offset * along).sum(-1, keepdim=True).clamp(0, length) * along
        depth = (circles[:, 2] - (offset - nearest).square().sum(-1).sqrt()).clamp(min=0)
        return reward - self.obstacle_cost * depth.sum((1, 2))

    def joints(self, state: Tensor) -> Tensor:
        """Where the joints and the hand are: `[N, n + 1, 2]`, from the base to the hand, in m."""
        return self._ends(state[:, : self.action_size].cumsum(-1))

    def _ends(self, angle: Tensor) -> Tensor:
        ends = torch.stack([angle.cos(), angle.sin()], -1).cumsum(1) / self.action_size
        return torch.cat([torch.zeros_like(ends[:, :1]), ends], 1)

    def observe(self, state: Tensor) -> Tensor:
        """Cosine and sine of each angle, speeds, and the goal relative to the hand: `[N, 3 * n + 2]`."""
        angle, speed = state.chunk(2, -1)
        to_goal = self.goal.to(state) - self.joints(state)[:, -1]
        return torch.cat([angle.cos(), angle.sin(), speed, to_goal], -1).float()
