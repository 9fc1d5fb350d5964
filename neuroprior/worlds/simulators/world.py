"""Simulators as worlds: a planner tries plans in copies of them."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Literal, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from neuroprior._checks import check_count, check_range, check_sizes, kind_of
from neuroprior._random import generator_on
from neuroprior.worlds.observations import Categories
from neuroprior.worlds.simulators.copies import Copier, ReplayCopier
from neuroprior.worlds.simulators.driver import Driver, Path, View, follow_plans
from neuroprior.worlds.simulators.fingerprints import fingerprint
from neuroprior.worlds.simulators.generators import (
    keep_global_generators,
    seed_generators,
    state_of_generators,
    state_of_held,
)
from neuroprior.worlds.simulators.readers import Reader, find_reader
from neuroprior.worlds.simulators.store import Recent, Store
from neuroprior.worlds.simulators.trials import Noise, Start, changes_by_noise
from neuroprior.worlds.world import Rollout, World, check_action, check_plans, on_cpu

Result = TypeVar("Result", bound=tuple[Any, ...])

MAX_SNAPSHOTS, MAX_VIEWS = 2048, 2**15
"""Copies of simulators that are kept, and views (observations and legal actions) of states."""

MIN_COMPARED, COMPARED_EVERY = 64, 32
"""Comparisons under other random numbers, at least, where plans draw some for the first time; later of so many, one."""


class SimulatorWorld(World):
    """Simulators that are copied and stepped; see `from_simulator`.

    A state is the number of a simulator's state, int64: it says how that state is reached, by which actions under
    which noise. Copies of simulators are kept for the states that were used last; others are reached again by the same
    steps. So states take little memory, and stay valid as long as the world.

    Args:
        driver: steps the simulators.
        copier: copies them.
        noise: whether they are stochastic, and draw random numbers at all. Unless that is declared, plans that show
            noise in a deterministic world are a ValueError.
        make: a function from a seed to a simulator at the start of an episode; None: there are only `starts`.
        starts: where episodes begin; none: `make` makes new ones.
        workers: processes that share the plans of a rollout.

    Attributes:
        observation: what `observe` returns: `Categories`, `Features`, or None.
        objective, discount: what counts in this world.
        driver, copier, starts: as given.
        prepare: a function from a simulator that `state_of` is given to one of the same kind as the others, or None.
        kinds: classes of simulators that `state_of` takes, without wrappers; none: any.
        max_snapshots: the most copies that are kept.
    """

    objective: Literal["terminal", "return"]
    prepare: Callable[[Any], Any] | None
    kinds: tuple[type, ...] = ()

    def __init__(
        self,
        driver: Driver,
        copier: Copier,
        noise: Noise,
        make: Callable[[int], tuple[Any, Any, Any]] | None,
        starts: Sequence[Start],
        workers: int | None = None,
    ) -> None:
        self.num_actions, self.observation = driver.num_actions, driver.observation
        self.stochastic, self.all_legal = noise.stochastic, not driver.has_masks
        self.objective, self.discount = "return", 1.0
        self.driver, self.copier, self._draws, self._make = driver, copier, noise.draws, make
        self._watched, self._drew = not (noise.stochastic or noise.declared), False
        self._other_seeds = itertools.count(1)
        self._workers, self.prepare = workers, None
        self._store = Store(self.num_actions, not self.stochastic)
        self._reader: Reader | None = None
        self._pinned: dict[int, Any] = {}
        self._pinned_views: dict[int, View] = {}
        self._snapshots, self._views = Recent[Any](MAX_SNAPSHOTS), Recent[View](MAX_VIEWS)
        self.starts = list(starts)
        self._start_states = [self._pin(start) for start in starts]

    @property
    def max_snapshots(self) -> int:
        """The most copies that are kept."""
        return self._snapshots.size

    @max_snapshots.setter
    def max_snapshots(self, size: int) -> None:
        check_sizes(max_snapshots=size)
        self._snapshots = Recent(size)

    def to(self, device: torch.device | str) -> Self:
        """Raise ValueError for any other device than the CPU, on which simulators are stepped."""
        return on_cpu(self, device)

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """States `[batch_size]`: the present states of the simulators, with equal probability.

        Of a function that makes simulators: new ones, whose noise is drawn by `generator`.
        """
        check_count("batch_size", batch_size)
        generator = generator_on(generator, "cpu")
        if self.starts:
            return torch.tensor(self._start_states)[torch.randint(len(self.starts), (batch_size,), generator=generator)]
        seeds = torch.randint(2**62, (batch_size,), generator=generator).tolist()
        return torch.tensor([self._store.add_start(seed) for seed in seeds], dtype=torch.long)

    def state_of(self, simulator: Any, observation: Any = None, info: Any = None) -> Tensor:
        """The states `[B]` that stand for the present states of simulators of the same kind.

        Args:
            simulator: one simulator, or a list of them; they stay as they are.
            observation: what its last `step` returned (a list for a list); only where that is observed.
            info: likewise; only where its `action_mask` says which actions are legal.

        Raises:
            ValueError: a simulator is of another class.
        """
        several = isinstance(simulator, list | tuple)
        each = list(simulator) if several else [simulator]
        for one in each:
            if self.kinds and type(getattr(one, "unwrapped", one)) not in self.kinds:
                names = " or ".join(kind.__name__ for kind in self.kinds)
                raise ValueError(f"`simulator` must be of the world's class {names}, got {kind_of(one)}")
        observations, infos = (list(x) if several and x is not None else [x] * len(each) for x in (observation, info))
        with keep_global_generators():
            states = [
                self._pin(enter(self.driver, self.copier, one if self.prepare is None else self.prepare(one), *seen))
                for one, *seen in zip(each, observations, infos, strict=True)
            ]
        return torch.tensor(states, dtype=torch.long)

    def are_same(self, state: Tensor) -> bool:
        """Whether simulators in `state [N]` hold the same, as far as that can be read, beside random generators."""
        with keep_global_generators():
            held = {handle: fingerprint(self._load(handle)) or str(handle) for handle in set(state.tolist())}
        return len(set(held.values())) == 1

    def forget(self) -> None:
        """Free the memory of all simulators but those that `reset` returns, after a long run.

        States that `state_of` returned before, and those reached from them, raise a ValueError from now on.
        """
        for handle in self._pinned.keys() - set(self._start_states):
            del self._pinned[handle], self._pinned_views[handle]
        self._snapshots.clear()
        self._views.clear()

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """See `World.step`. An action that is not legal changes nothing, with a reward of 0."""
        self.check_state(state)
        action = check_action(action, len(state), self.num_actions)
        generator = generator_on(generator, "cpu")
        return self._run(lambda: self._step(state, action, generator), state, action[:, None, None])

    def _step(self, state: Tensor, action: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        seeds = self._draw_seeds((len(state),), generator).tolist()
        after, rewards = state.tolist(), [0.0] * len(state)
        shared = None if self._draws else state_of_generators(self.copier.shared_generators())
        for row, (start, one, seed) in enumerate(zip(state.tolist(), action.tolist(), seeds, strict=True)):
            if not self._is_over(start):
                after[row], rewards[row] = self._take(start, one, seed)
        self._drew |= not self._draws and shared != state_of_generators(self.copier.shared_generators())
        return torch.tensor(after, dtype=torch.long), torch.tensor(rewards, dtype=torch.float64)

    def rollout(
        self, state: Tensor, plans: Tensor, generator: torch.Generator | None = None, keep_states: bool = False
    ) -> Rollout:
        """See `World.rollout`. A simulator is copied once a plan; each plan meets noise of its own.

        In a deterministic world the same plans of a start are tried once.
        """
        self.check_state(state)
        check_plans(plans, len(state), self.num_actions)
        generator = generator_on(generator, "cpu")
        return self._run(lambda: self._rollout(state, plans, generator, keep_states), state, plans)

    def _rollout(self, state: Tensor, plans: Tensor, generator: torch.Generator, keep_states: bool) -> Rollout:
        batch, num_plans, length = plans.shape
        seeds = self._draw_seeds((batch, num_plans), generator)
        rewards = np.zeros((batch, num_plans, length))
        final = state[:, None].repeat(1, num_plans).numpy()
        states = state[:, None, None].repeat(1, num_plans, length).numpy() if keep_states else None
        for row, start in enumerate(state.tolist()):  # a simulator runs one plan at a time
            if self._is_over(start) or not length:
                continue
            keys = [(*plan, seed) for plan, seed in zip(plans[row].tolist(), seeds[row].tolist(), strict=True)]
            distinct = list(dict.fromkeys(keys))
            tried: dict[tuple[int, ...], tuple[Path, int]] = {}
            for key, path in zip(distinct, self._follow(start, distinct, keep_states), strict=True):
                tried[key] = path, self._store.add(start, path.taken, key[-1], path.last_reward(), path.ended)
                if path.views:
                    self._views.put(tried[key][1], path.views[-1])
            for column, key in enumerate(keys):
                path, final[row, column] = tried[key]
                rewards[row, column, : len(path.rewards)] = path.rewards
                if states is not None:
                    states[row, column] = self._number_path(start, path, key[-1], length)
        kept = None if states is None else torch.from_numpy(states)
        return Rollout(torch.from_numpy(final), torch.from_numpy(rewards), kept)

    def observe(self, state: Tensor) -> Tensor:
        """The observation in each state: int64 `[N]` of `Categories`, float32 `[N, C]` of `Features`.

        Raises:
            ValueError: the world has no observation, or that of a start is not known.
        """
        if self.observation is None:
            raise ValueError("`observe` must be given to from_simulator for a world in which something is observed")
        with keep_global_generators():
            seen = [self._observation(handle) for handle in state.tolist()]
        if isinstance(self.observation, Categories):
            return torch.tensor(seen, dtype=torch.long)
        return torch.from_numpy(np.array(seen, dtype=np.float32).reshape(len(seen), self.observation[0]))

    def legal_actions(self, state: Tensor) -> Tensor:
        """Which actions are legal in each state, bool `[N, A]`; where an episode has ended, all."""
        legal = torch.ones(len(state), self.num_actions, dtype=torch.bool)
        if self.all_legal:
            return legal
        with keep_global_generators():
            for row, handle in enumerate(state.tolist()):
                mask = self._view(handle).mask
                if mask is not None and mask.any():
                    legal[row] = torch.from_numpy(mask)
        return legal

    def terminated(self, state: Tensor) -> Tensor:
        """Where the episode has ended, or no action is legal."""
        with keep_global_generators():
            return torch.tensor([self._is_over(handle) for handle in state.tolist()], dtype=torch.bool)

    def check_state(self, state: Tensor) -> None:
        if not isinstance(state, Tensor) or state.dim() != 1 or state.dtype != torch.long:
            raise ValueError("`state` must be int64 of shape [B], such as reset and state_of return")
        check_range("state", state, len(self._store), "states so far")

    def _run(self, work: Callable[[], Result], state: Tensor, plans: Tensor) -> Result:
        """What `work` returns, which follows `plans [B, P, L]`; refuses noise in a deterministic world."""
        with keep_global_generators():
            self._drew = False
            result = work()
            if self._watched and (self._draws or self._drew):
                self._require_no_noise(state, plans, result[1])
                self._draws = True
            return result

    def _require_no_noise(self, state: Tensor, plans: Tensor, rewards: Tensor) -> None:
        """Raise ValueError where plans that draw random numbers lead elsewhere by others.

        Args:
            state: `[B]`.
            plans: `[B, P, L]`. All are compared if they are the first to draw, else the best and some others.
            rewards: of their steps, `[B, P, L]` or, of single steps, `[B]`.
        """
        if not plans.numel():
            return
        starts, each = state.repeat_interleave(plans.shape[1]).tolist(), plans.flatten(0, 1).tolist()
        tried = [(start, *plan) for start, plan in zip(starts, each, strict=True)]
        if self._draws:
            gains = rewards.reshape(len(tried), -1)
            best = int((gains[:, -1] if self.objective == "terminal" else gains.sum(1)).argmax())
            tried = [tried[best], *tried[next(self._other_seeds) % COMPARED_EVERY :: COMPARED_EVERY]]
        tried = [(start, *plan) for start, *plan in dict.fromkeys(tried) if not self._is_over(start)]
        for _ in range(1 if self._draws else -(-MIN_COMPARED // max(len(tried), 1))):
            seed = next(self._other_seeds)
            for start, *plan in tried:
                where = Start(self._snapshot(start), View(None, None) if self.all_legal else self._view(start))
                if changes_by_noise(self.driver, self.copier, where, plan, seed):
                    raise ValueError(
                        "`stochastic` must be True for this simulator: plans met noise that no trial walk had met;"
                        " give `stochastic=True`"
                    )

    def _draw_seeds(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        """A seed for each plan; all 0 in a deterministic world."""
        if not self.stochastic:
            return torch.zeros(shape, dtype=torch.long)
        return torch.randint(2**62, shape, generator=generator)

    def _pin(self, start: Start) -> int:
        """The number of a state that cannot be reached again, so that its copy is kept."""
        handle = self._store.add_start(-1 - len(self._store))
        self._pinned[handle], self._pinned_views[handle] = start
        return handle

    def _take(self, start: int, action: int, seed: int) -> tuple[int, float]:
        """The state after one action, and its reward."""
        handle = self._store.find(start, [action], seed)
        if handle is None:
            view = None if self.all_legal else self._view(start)
            if view is not None and view.mask is not None and not view.mask[action]:
                return start, 0.0
            simulator = self._load(start)
            self._seed(simulator, seed)
            held = None if self._draws else state_of_held(self.copier.separate_generators(simulator))
            path = self.driver.follow(simulator, [action], View(None, None))
            self._drew |= held is not None and held != state_of_held(self.copier.separate_generators(simulator))
            handle = self._store.add(start, [action], seed, path.rewards[0], path.ended)
            self._views.put(handle, path.views[0])
            self._keep(handle, simulator, (start, [action], seed))
        return handle, self._store.reward(handle)

    def _follow(self, start: int, keys: list[tuple[int, ...]], keep_states: bool) -> list[Path]:
        """The paths of plans, each of which is followed by its seed."""
        plans, seeds = [list(key[:-1]) for key in keys], [key[-1] if self._draws else None for key in keys]
        wanted = not self.all_legal or (keep_states and self.observation is not None)
        view = self._view(start) if wanted else None
        snapshot = self._snapshot(start)
        if self._workers is None or isinstance(self.copier, ReplayCopier):
            paths, draws = follow_plans(self.driver, self.copier, snapshot, view, plans, seeds)
            self._drew |= draws
            return paths
        from joblib import Parallel, delayed

        parts = [slice(n, None, self._workers) for n in range(self._workers)]
        copier, sent = self.copier.to_process(snapshot)
        shared = Parallel(self._workers)(
            delayed(follow_plans)(self.driver, copier, sent, view, plans[index], seeds[index]) for index in parts
        )
        paths = [None] * len(keys)  # type: ignore[list-item]
        for index, (worker_paths, draws) in zip(parts, shared, strict=True):
            paths[index] = worker_paths
            self._drew |= draws
        return paths

    def _number_path(self, start: int, path: Path, seed: int, length: int) -> list[int]:
        """The state after each of the actions of a plan."""
        counts = path.counts or range(1, len(path.rewards) + 1)
        handles = []
        for t, count in enumerate(counts):
            ended = path.ended and t == len(path.rewards) - 1
            handles.append(self._store.add(start, path.taken[:count], seed, path.rewards[t], ended))
            if path.views:
                self._views.put(handles[-1], path.views[t])
        return handles + handles[-1:] * (length - len(handles))

    def _is_over(self, handle: int) -> bool:
        """Whether an episode has ended in a state, or nothing is legal there."""
        if self._store.ended(handle):
            return True
        if self.all_legal or self._store.start_seed(handle) is None:
            return False
        mask = self._view(handle).mask
        return mask is not None and not mask.any()

    def _observation(self, handle: int) -> Any:
        """The observation in a state; of a running simulator as far as it can be read from it."""
        observation = self._view(handle).observation
        if observation is None:
            if self._reader is None:
                start = Start(self._snapshot(handle), self._view(handle))
                self._reader = find_reader(self.driver, self.copier, start)
            if self._reader is None:
                raise ValueError("`state_of` must be given what a running simulator's last step observed; got nothing")
            observation = self.driver.as_declared(self._reader(self._load(handle)))
            self._pinned_views[handle] = self._view(handle)._replace(observation=observation)
        return observation

    def _view(self, handle: int) -> View:
        """What can be seen and done in a state."""
        view = self._pinned_views.get(handle)
        view = self._views.use(handle) if view is None else view
        if view is None:
            self._reach(handle)
            view = self._views[handle]
        return view

    def _snapshot(self, handle: int) -> Any:
        """A copy of the simulator in a state."""
        snapshot = self._pinned.get(handle)
        snapshot = self._snapshots.use(handle) if snapshot is None else snapshot
        if snapshot is None:
            self._reach(handle)
            snapshot = self._snapshots[handle]
        return snapshot

    def _load(self, handle: int) -> Any:
        """A simulator in a state, to be stepped."""
        return self.copier.load(self._snapshot(handle))

    def _keep(self, handle: int, simulator: Any, origin: tuple[int, list[int], int]) -> None:
        """Keep the copy of a simulator that is not stepped any more."""
        start, actions, seed = origin
        saved = self.copier.save(simulator, (self._snapshot(start), actions, seed))
        self._snapshots.put(handle, saved)

    def _reach(self, handle: int) -> None:
        """Reach a state again, and keep its copy and its view."""
        chain = [handle]
        while self._store.start_seed(chain[-1]) is None:
            before = self._store.before(chain[-1], self._snapshots)[0]
            if before in self._pinned or before in self._snapshots:
                break
            chain.append(before)
        for at in reversed(chain):
            seed = self._store.start_seed(at)
            if seed is not None:
                if seed < 0 or self._make is None:
                    raise ValueError("`state` must be one that is kept, got one from before `forget` was called")
                with keep_global_generators():  # what a start draws is no noise of the steps
                    start = make_start(self.driver, self.copier, self._make, seed)
                self._snapshots.put(at, start.saved)
                self._views.put(at, start.view)
                continue
            earlier, actions, noise_seed = self._store.before(at, self._snapshots)
            simulator = self._load(earlier)
            self._seed(simulator, noise_seed)
            for action in actions[:-1]:
                simulator.step(action + self.driver.first_action)
            observation, _, _, info = self.driver.take(simulator, actions[-1])
            self._views.put(at, self.driver.view(simulator, observation, info))
            self._keep(at, simulator, (earlier, actions, noise_seed))

    def _seed(self, simulator: Any, seed: int) -> None:
        if self._draws:
            seed_generators(self.copier.generators(simulator), seed)


def enter(driver: Driver, copier: Copier, simulator: Any, observation: Any, info: Any, seed: int = 0) -> Start:
    """The present state of a simulator, which stays as it is, as a start.

    Raises:
        ValueError: it has no method `step`.
    """
    if not callable(getattr(simulator, "step", None)):
        raise ValueError(f"`simulator` must have a method `step`, got {kind_of(simulator)}")
    saved = copier.enter(simulator, seed)
    simulator = copier.load(saved)
    driver.find_masks(simulator, observation, info)
    return Start(saved, driver.view(simulator, observation, info))


def make_start(driver: Driver, copier: Copier, make: Callable[[int], tuple[Any, Any, Any]], seed: int) -> Start:
    """A start that a seed makes."""
    return enter(driver, copier, *make(seed), seed)
