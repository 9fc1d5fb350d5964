"""Gymnasium's MuJoCo tasks as worlds: simulated in batches by `mujoco.rollout`, their rewards computed from states."""

import warnings
from abc import abstractmethod
from importlib import import_module
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior.control.worlds.continuous_world import ContinuousWorld, check_positive
from neuroprior.worlds.world import Rollout, on_cpu


class MujocoWorld(ContinuousWorld):
    """A task of Gymnasium, stepped and rolled out in batches in C; `from_mujoco` makes them.

    A state is `[N, S]` float64: MuJoCo's full physics state, that is the time (s), positions `qpos` and velocities
    `qvel`. Rewards are float64. Each start begins without a solver warm start, so that no row depends on another;
    within a rollout the solver starts from the step before, as in `env.step`. States equal those of `env.step` to
    rounding.

    Args:
        file: the task's model, among Gymnasium's assets.
        frame_skip: MuJoCo's steps in a step.
        masses: by which all masses and inertias are multiplied.
        num_threads: how many threads simulate; None: as many as torch uses.
        sensors: positions of bodies that are asked for beside the state.

    Attributes:
        model: the `mujoco.MjModel`.
        frame_skip: MuJoCo's steps in a step.
        num_threads: how many threads simulate.
    """

    def __init__(
        self, file: str, frame_skip: int, masses: float, num_threads: int | None, sensors: tuple[str, ...] = ()
    ) -> None:
        check_positive(masses=masses)
        threads = torch.get_num_threads() if num_threads is None else num_threads
        check_sizes(num_threads=threads)
        mujoco = _import("mujoco")
        rollout = _import("mujoco.rollout")
        self.frame_skip, self.num_threads = frame_skip, threads
        self.model = _model(mujoco, file, sensors)
        if masses != 1:
            self.model.body_mass *= masses
            self.model.body_inertia *= masses
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
        self._state_size = int(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        self._control = int(mujoco.mjtState.mjSTATE_CTRL)
        self._data = [mujoco.MjData(self.model) for _ in range(threads)]
        self._pool = rollout.Rollout(nthread=threads if threads > 1 else 0)
        self.num_positions, self.num_velocities = int(self.model.nq), int(self.model.nv)
        self.state_shape = (1 + self.num_positions + self.num_velocities,)
        if self._state_size != self.state_shape[0]:
            raise ValueError(f"{file} must have no activations, plugins or histories")
        self.seconds = float(self.model.opt.timestep) * frame_skip
        bounds = torch.from_numpy(self.model.actuator_ctrlrange.copy()).float()
        self.action_low, self.action_high = bounds.unbind(1)
        self.action_names = tuple(self.model.joint(j).name for j in self.model.actuator_trnid[:, 0])
        self._start = torch.from_numpy(self.model.qpos0.copy())

    def to(self, device: torch.device | str) -> Self:
        """Raise ValueError for any other device than the CPU."""
        return on_cpu(self, device)

    @abstractmethod
    def _rewards(self, before: Tensor, after: Tensor, action: Tensor, sensors: Tensor) -> Tensor:
        """Of steps from `before` to `after` `[N, L, S]` by `action [N, L, D]`, with what sensors gave in the last of
        MuJoCo's steps `[N, L, K]`: `[N, L]`, as `env.step` gives them."""

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        states, rewards = self._run(state, action[:, None])
        return states[:, 0], rewards[:, 0]

    def rollout(
        self, state: Tensor, plans: Tensor, generator: torch.Generator | None = None, keep_states: bool = False
    ) -> Rollout:
        self.check_state(state)
        self.check_plans(plans, len(state))
        shape = plans.shape[:3]
        start = state.repeat_interleave(shape[1], 0)
        if not shape.numel():
            return Rollout(
                start.view(shape[0], shape[1], -1),
                start.new_zeros(shape).double(),
                start.new_zeros((*shape, start.shape[1])) if keep_states else None,
            )
        states, rewards = self._run(start, plans.flatten(0, 1))
        kept = states.unflatten(0, shape[:2])
        return Rollout(kept[:, :, -1], rewards.view(shape), kept if keep_states else None)

    def _run(self, start: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """States `[N, L, S]` and rewards `[N, L]` of `actions [N, L, D]` from `start [N, S]`; final ones stay."""
        start, actions = start.double(), actions.double()
        states, sensors = self._simulate(start, actions.repeat_interleave(self.frame_skip, 1))
        states = states[:, self.frame_skip - 1 :: self.frame_skip]
        path = torch.cat([start[:, None], states], 1)
        rewards = self._rewards(path[:, :-1], states, actions, sensors[:, self.frame_skip - 1 :: self.frame_skip])
        ended = self.terminated(path[:, :-1].flatten(0, 1)).view(rewards.shape)
        if ended.any():
            ended = ended.int().cummax(1).values.bool()
            steps = torch.arange(1, states.shape[1] + 1).minimum((~ended).sum(1, keepdim=True))
            states = path.gather(1, steps[:, :, None].expand_as(states))
            rewards = rewards.masked_fill(ended, 0)
        return states, rewards

    def _simulate(self, start: Tensor, controls: Tensor) -> tuple[Tensor, Tensor]:
        """States `[N, T, S]` and sensors `[N, T, K]` of T of MuJoCo's steps; those are of the state before the step."""
        num, length = controls.shape[:2]
        states = torch.empty(num, length, self._state_size, dtype=torch.float64)
        sensors = torch.empty(num, length, self.model.nsensordata, dtype=torch.float64)
        # The arrays are of the right shapes and types already: its checks would take longer than a short rollout.
        self._pool.rollout(
            [self.model] * num,
            self._data,
            start.contiguous().numpy(),
            controls.contiguous().numpy(),
            control_spec=self._control,
            skip_checks=True,
            nstep=length,
            state=states.numpy(),
            sensordata=sensors.numpy(),
        )
        return states, sensors

    def _positions(self, state: Tensor) -> Tensor:
        return state[..., 1 : 1 + self.num_positions]

    def _velocities(self, state: Tensor) -> Tensor:
        return state[..., 1 + self.num_positions :]

    def _state(self, positions: Tensor, velocities: Tensor) -> Tensor:
        return torch.cat([positions.new_zeros(len(positions), 1), positions, velocities], 1)

    def render(self, states: Tensor, width: int = 320, height: int = 240) -> Tensor:
        """Pictures of `states [T, S]`: uint8 `[T, height, width, 3]`, seen by the model's first camera if it has one.

        Without a screen set the environment variable MUJOCO_GL to `egl` or `osmesa` before Python starts.

        Raises:
            ValueError: these are no states, or there is no OpenGL to draw with.
        """
        self.check_state(states)
        check_sizes(width=width, height=height)
        mujoco = _import("mujoco")
        screen = self.model.vis.global_
        screen.offwidth, screen.offheight = max(screen.offwidth, width), max(screen.offheight, height)
        try:
            renderer = mujoco.Renderer(self.model, height, width)
        except Exception as error:  # each of GLFW, EGL and OSMesa raises its own kinds
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise ValueError(f"render: no OpenGL ({reason}); set MUJOCO_GL=egl or MUJOCO_GL=osmesa") from error
        data, frames = mujoco.MjData(self.model), []
        try:
            for state in states.double().numpy():
                mujoco.mj_setState(self.model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
                mujoco.mj_forward(self.model, data)
                renderer.update_scene(data, camera=0 if self.model.ncam else -1)
                frames.append(torch.from_numpy(renderer.render().copy()))
        finally:
            renderer.close()
        return torch.stack(frames) if frames else torch.zeros(0, height, width, 3, dtype=torch.uint8)


def _model(mujoco: Any, file: str, sensors: tuple[str, ...]) -> Any:
    """The model of a file that comes with Gymnasium, with sensors of the positions of these bodies."""
    folder = Path(_import("gymnasium").__file__).parent / "envs" / "mujoco" / "assets"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # settotalmass, deprecated, in that of the cheetah
        spec = mujoco.MjSpec.from_file(str(folder / file))
        for body in sensors:
            spec.add_sensor(
                type=mujoco.mjtSensor.mjSENS_FRAMEPOS, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=body, name=body
            )
        return spec.compile()


def _import(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(f"{name} cannot be used ({error}); pip install neuroprior[mujoco]") from error
