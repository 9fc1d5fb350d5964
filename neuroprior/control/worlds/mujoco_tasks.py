"""The MuJoCo tasks of Gymnasium: their rewards, observations, ends and starts."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import is_number
from neuroprior._random import generator_on
from neuroprior.control.worlds.continuous_world import finite_vector
from neuroprior.control.worlds.mujoco import MujocoWorld


def from_mujoco(
    task: str,
    *,
    masses: float = 1.0,
    goal: float | Sequence[float] | Tensor | None = None,
    num_threads: int | None = None,
) -> MujocoWorld:
    """A MuJoCo task of Gymnasium as a world; needs the extra `mujoco`.

    States and rewards are those of `env.step`, with one exception: in Reacher-v5 the reward is of the hand in the state
    that is reached, while `env.step` takes its position from an intermediate stage of the last integration step, mostly
    some 1e-6 m beside it. There is no time limit. Observations are those of the task, float32.

    Args:
        task: HalfCheetah-v5, Swimmer-v5, Hopper-v5, Walker2d-v5, Reacher-v5 or Pusher-v5.
        masses: a factor of the mass and inertia of each body; armatures of motors stay.
        goal: of the first four a speed `v*` in m/s: the reward for speed is `-|v - v*|` in place of v, so that a
            negative goal is backwards. Of Reacher-v5 and Pusher-v5 the position `[2]` (x, y) of the target in m, with
            which `reset` makes states; it is part of the state, and a state that was made otherwise keeps its own.
            None: the task's.
        num_threads: how many threads simulate; None for as many as torch has.

    Raises:
        ValueError: an argument is wrong.
        ImportError: MuJoCo or Gymnasium is not installed.
    """
    if task in RUNNERS:
        if goal is not None and not (is_number(goal) and math.isfinite(goal)):
            raise ValueError(f"`goal` of {task} must be a finite speed in m/s, got {goal!r}")
        return _Runner(RUNNERS[task], masses, goal, num_threads)
    if task not in REACHERS:
        raise ValueError(f"`task` must be one of {', '.join((*RUNNERS, *REACHERS))}, got {task!r}")
    target = None if goal is None else finite_vector("goal", goal, 2).double()
    return REACHERS[task](masses, target, num_threads)


class _Running(NamedTuple):
    """A task of moving forwards, along x.

    Attributes:
        control_cost: of the sum of squared actions.
        noise: of the positions and velocities at the start.
        normal: whether that of velocities is normal, not uniform.
        hidden: how many positions are not observed.
        healthy: heights and angles of the trunk between which the task goes on, and what a step there is worth (1);
            other positions and velocities stay between -100 and 100 where `bounded`. None: it never ends.
    """

    file: str
    frame_skip: int
    control_cost: float
    noise: float
    normal: bool = False
    hidden: int = 1
    healthy: tuple[tuple[float, float], tuple[float, float]] | None = None
    bounded: bool = False


RUNNERS = {
    "HalfCheetah-v5": _Running("half_cheetah.xml", 5, 0.1, 0.1, normal=True),
    "Swimmer-v5": _Running("swimmer.xml", 4, 1e-4, 0.1, hidden=2),
    "Hopper-v5": _Running("hopper.xml", 4, 1e-3, 5e-3, healthy=((0.7, math.inf), (-0.2, 0.2)), bounded=True),
    "Walker2d-v5": _Running("walker2d_v5.xml", 4, 1e-3, 5e-3, healthy=((0.8, 2.0), (-1.0, 1.0))),
}


class _Runner(MujocoWorld):
    def __init__(self, task: _Running, masses: float, goal: float | None, num_threads: int | None) -> None:
        super().__init__(task.file, task.frame_skip, masses, num_threads)
        self.task, self.goal = task, goal

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        draws = generator_on(generator, "cpu")
        noise = self.task.noise
        positions = self._start + _uniform((batch_size, self.num_positions), noise, draws)
        size = (batch_size, self.num_velocities)
        normal = noise * torch.randn(size, generator=draws, dtype=torch.float64) if self.task.normal else None
        return self._state(positions, _uniform(size, noise, draws) if normal is None else normal)

    def observe(self, state: Tensor) -> Tensor:
        speeds = self._velocities(state)
        speeds = speeds if self.task.healthy is None else speeds.clamp(-10, 10)
        return torch.cat([self._positions(state)[:, self.task.hidden :], speeds], 1).float()

    def terminated(self, state: Tensor) -> Tensor:
        return ~self._healthy(state)

    def _healthy(self, state: Tensor) -> Tensor:
        healthy = torch.ones(state.shape[:-1], dtype=torch.bool)
        if self.task.healthy is not None:
            for values, (low, high) in zip(state[..., 2:4].unbind(-1), self.task.healthy, strict=True):
                healthy = healthy & (low < values) & (values < high)
        if self.task.bounded:
            healthy = healthy & (state[..., 3:].abs() < 100).all(-1)
        return healthy

    def _rewards(self, before: Tensor, after: Tensor, action: Tensor, sensors: Tensor) -> Tensor:
        speed = (after[..., 1] - before[..., 1]) / self.seconds
        reward = speed if self.goal is None else -(speed - self.goal).abs()
        reward = reward - self.task.control_cost * action.square().sum(-1)
        return reward if self.task.healthy is None else reward + self._healthy(after)


class _Reacher(MujocoWorld):
    """Two links, 0.1 m each, whose fingertip is 0.01 m beyond the second."""

    def __init__(self, masses: float, goal: Tensor | None, num_threads: int | None) -> None:
        super().__init__("reacher.xml", 2, masses, num_threads)
        if goal is not None and not bool((goal.abs() <= 0.27).all()):
            raise ValueError(f"`goal` must be from -0.27 to 0.27 m, got {goal.tolist()}")
        self.goal = goal

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        draws = generator_on(generator, "cpu")
        positions = self._start + _uniform((batch_size, 4), 0.1, draws)
        radius, angle = torch.rand(2, batch_size, generator=draws, dtype=torch.float64)
        radius, angle = 0.2 * radius.sqrt(), 2 * math.pi * angle  # uniform in a disc
        drawn = torch.stack([radius * angle.cos(), radius * angle.sin()], 1)
        positions[:, 2:] = drawn if self.goal is None else self.goal
        velocities = _uniform((batch_size, 4), 0.005, draws)
        velocities[:, 2:] = 0
        return self._state(positions, velocities)

    def observe(self, state: Tensor) -> Tensor:
        angles, target = self._positions(state).split(2, -1)
        speeds = self._velocities(state)[:, :2]
        return torch.cat([angles.cos(), angles.sin(), target, speeds, self._to_hand(state)], 1).float()

    def _to_hand(self, state: Tensor) -> Tensor:
        """From the target to the fingertip: `[..., 2]`."""
        first, second, x, y = self._positions(state).unbind(-1)
        both = first + second
        return torch.stack([0.1 * first.cos() + 0.11 * both.cos() - x, 0.1 * first.sin() + 0.11 * both.sin() - y], -1)

    def _rewards(self, before: Tensor, after: Tensor, action: Tensor, sensors: Tensor) -> Tensor:
        return -self._to_hand(after).square().sum(-1).sqrt() - action.square().sum(-1)


class _Pusher(MujocoWorld):
    """The positions in a reward are those at the beginning of the last of MuJoCo's steps, as in `env.step`."""

    def __init__(self, masses: float, goal: Tensor | None, num_threads: int | None) -> None:
        super().__init__("pusher_v5.xml", 5, masses, num_threads, ("tips_arm", "object", "goal"))
        # the joints of the goal move it from where the model has it: first along y, then along x
        place = torch.from_numpy(self.model.body("goal").pos.copy())[:2]
        self.goal = torch.zeros(2, dtype=torch.float64) if goal is None else (goal - place).flip(0)

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        draws = generator_on(generator, "cpu")
        place = torch.zeros(batch_size, 2, dtype=torch.float64)
        near = torch.ones(batch_size, dtype=torch.bool)
        while near.any():
            shares = torch.rand(int(near.sum()), 2, generator=draws, dtype=torch.float64)
            place[near] = shares * torch.tensor([0.3, 0.4], dtype=torch.float64) - torch.tensor([0.3, 0.2]).double()
            near = place.norm(dim=1) <= 0.17
        positions = self._start.repeat(batch_size, 1)
        positions[:, 7:9], positions[:, 9:] = place, self.goal
        velocities = _uniform((batch_size, self.num_velocities), 0.005, draws)
        velocities[:, -4:] = 0
        return self._state(positions, velocities)

    def observe(self, state: Tensor) -> Tensor:
        _, bodies = self._simulate(state.double(), torch.zeros(len(state), 1, self.action_size, dtype=torch.float64))
        return torch.cat([self._positions(state)[:, :7], self._velocities(state)[:, :7], bodies[:, 0]], 1).float()

    def _rewards(self, before: Tensor, after: Tensor, action: Tensor, sensors: Tensor) -> Tensor:
        hand, thing, goal = sensors.unflatten(-1, (3, 3)).unbind(-2)
        near, far = (thing - hand).square().sum(-1).sqrt(), (thing - goal).square().sum(-1).sqrt()
        reward: Tensor = -0.5 * near - far - 0.1 * action.square().sum(-1)
        return reward


REACHERS = {"Reacher-v5": _Reacher, "Pusher-v5": _Pusher}


def _uniform(shape: tuple[int, ...], bound: float, generator: torch.Generator) -> Tensor:
    return bound * (2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1)
