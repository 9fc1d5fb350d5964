"""Gymnasium environments as tables: read from their attribute `P`, or enumerated breadth first by copies."""

import copy
import hashlib
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from itertools import product
from typing import Any

import numpy as np
import torch

from neuroprior.worlds.episodes import EpisodicWorld
from neuroprior.worlds.gymnasium.counters import NUM_WALKS, WALK_LENGTH, Counters
from neuroprior.worlds.gymnasium.environment import action_names, without_limits
from neuroprior.worlds.simulators.copies import ReplayCopier
from neuroprior.worlds.simulators.driver import MASK_METHODS, TRUNCATED, View
from neuroprior.worlds.simulators.fingerprints import digest
from neuroprior.worlds.simulators.generators import keep_global_generators, seed_generators, state_of_generators
from neuroprior.worlds.simulators.trials import Start
from neuroprior.worlds.simulators.world import SimulatorWorld

CHECKED_FIRST, CHECKED_EVERY = 100, 10
"""Transitions are repeated, as a check, from so many states at first, and from every so many after them."""

REPEATS_OF_NOISE = 8
"""How often a transition is repeated that draws random numbers."""


def has_table(env: Any) -> bool:
    """Whether it can be read by `read_table`."""
    base = env.unwrapped
    return isinstance(getattr(base, "P", None), dict) and hasattr(base, "initial_state_distrib") and env is base


def find_change(env: Any) -> str | None:
    """What an environment does otherwise than its table says: a method of the user's, or a step of a random walk.

    A user may change a toy text of Gymnasium, whose table stays, or give one of his own that does not say all.
    """
    kinds = type(env).__mro__
    inherits = any(kind.__module__.startswith("gymnasium.envs") for kind in kinds)
    for name in ("step", "reset", *MASK_METHODS):
        definer = next((kind for kind in kinds if name in vars(kind)), None)
        by_user = name in vars(env) or (definer is not None and not definer.__module__.startswith("gymnasium."))
        if by_user and (inherits or name in MASK_METHODS):
            return f"its `{name}` is the user's, of which its table knows nothing"
    walker = copy.deepcopy(env)
    draw = np.random.default_rng(0)
    for walk in range(NUM_WALKS):
        walker.reset(seed=walk)
        if not walker.initial_state_distrib[int(walker.s)] > 0:
            return f"it starts in state {walker.s}, which its table says it does not"
        for _ in range(WALK_LENGTH):
            state, action = int(walker.s), int(draw.integers(walker.action_space.n))
            _, reward, ended, truncated, _ = walker.step(action)
            possible = [(int(to), float(gain), bool(end)) for p, to, gain, end in walker.P[state][action] if p > 0]
            if (int(walker.s), float(reward), bool(ended)) not in possible:
                return f"action {action} in state {state} led to another state, reward or end than its table says"
            if ended or truncated:
                break
    return None


def find_table(env: Any) -> EpisodicWorld | None:
    """The table of an environment, where it has one that says what it does; None else."""
    if not has_table(env):
        return None
    try:
        return read_table(env)
    except ValueError:
        return None


def read_table(env: Any) -> EpisodicWorld:
    """The table of a toy text; see `from_gymnasium`.

    Raises:
        ValueError: it has no table, an incomplete one, or one of another environment.
    """
    if not has_table(env):
        raise ValueError(
            'method="table": it takes an environment without wrappers whose transitions are in an attribute P;'
            ' "enumerate" and "step" do with any'
        )
    base = env.unwrapped
    if getattr(base, "fickle_passenger", False):
        raise ValueError("fickle_passenger: the passenger's changes of mind are not in the environment's table P")
    try:
        next_state, reward, probability, ends = _outcomes(base.P, int(env.action_space.n))
        sums = probability.sum(-1)
        wrong = ((sums - 1).abs() > 1e-6).nonzero().tolist()
        change = None if wrong else find_change(env)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            'method="table": P must give (probability, next state, reward, ended) for each state and action, got'
            f' another form ({type(error).__name__}: {error}); "enumerate" and "step" do without'
        ) from error
    if wrong:
        state, action = wrong[0]
        raise ValueError(
            f'method="table": the probabilities of P[{state}][{action}] must sum to 1, got {float(sums[state, action])}'
        )
    if change:
        raise ValueError(f'method="table": {change}; "enumerate" and "step" take the environment as it is')
    next_state, ended = _make_absorbing(next_state, probability, ends)
    states = len(ends)
    extra = len(ended) - states
    reward = torch.cat([reward, reward.new_zeros(extra, *reward.shape[1:])])
    probability = torch.cat([probability, torch.zeros_like(probability[:1]).expand(extra, -1, -1)])
    reward[ended], probability[ended] = 0, 0
    probability[ended, :, 0] = 1
    starts = torch.zeros(len(ended), dtype=torch.float64)
    starts[:states] = torch.as_tensor(base.initial_state_distrib, dtype=torch.float64)
    names = action_names(env)
    if probability.shape[-1] == 1:
        return EpisodicWorld(next_state[..., 0], reward[None, ..., 0], names, starts, ended, locate=_present)
    return EpisodicWorld(next_state, reward[None], names, starts, ended, probability=probability, locate=_present)


def _present(env: Any) -> int:
    """The state in which a toy text is."""
    return int(env.unwrapped.s)


def _outcomes(table: Any, actions: int) -> tuple[torch.Tensor, ...]:
    """Next states, rewards, probabilities and whether the episode ends, each `[S, A, K]`."""
    rows = [[[o for o in table[s][a] if o[0] > 0] for a in range(actions)] for s in range(len(table))]
    most = max(len(outcomes) for row in rows for outcomes in row)
    filled = [[row[a] + [(0.0, 0, 0.0, False)] * (most - len(row[a])) for a in range(actions)] for row in rows]
    values = [[[[float(v) for v in outcome] for outcome in outcomes] for outcomes in row] for row in filled]
    probability, next_state, reward, ends = torch.tensor(values, dtype=torch.float64).unbind(-1)
    return next_state.long(), reward.float(), probability.contiguous(), ends.bool()


def _make_absorbing(
    next_state: torch.Tensor, probability: torch.Tensor, ends: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """Transitions in which ended episodes stay where they ended, `[S or S + 1, A, K]`, and where that is.

    A state into which only transitions lead that end the episode becomes absorbing itself. Where others lead there,
    too, from states of running episodes, the episode ends in one more state instead.
    """
    states = len(ends)
    possible = probability > 0
    final = torch.zeros(states, dtype=torch.bool)
    final[next_state[ends & possible]] = True
    state = torch.arange(states)[:, None, None].expand_as(next_state)
    ended, before = final, None
    while before is None or not ended.equal(before):
        before = ended
        running = possible & ~ends & ~ended[state]
        ended = ended.index_fill(0, next_state[running], False)
    shared = final & ~ended
    next_state = torch.where(ends & possible & shared[next_state], states, next_state)
    if shared.any():
        ended = torch.cat([ended, torch.tensor([True])])
        next_state = torch.cat([next_state, torch.zeros_like(next_state[:1])])
    next_state[ended] = ended.nonzero()[:, 0, None, None]
    return next_state, ended


def enumerate_states(
    world: SimulatorWorld, max_states: int, observations: bool, progress: bool, seed: int
) -> EpisodicWorld:
    """The table of all states that can be reached from the starts of a world; see `from_gymnasium`.

    Args:
        world: steps copies of an environment.
        max_states, observations, progress: see `from_gymnasium`.
        seed: of the walks by which the table is checked.

    Raises:
        ValueError: it is stochastic, cannot be copied, or has more than `max_states` states.
    """
    if world.stochastic:
        raise ValueError('env: it is stochastic, so that its states cannot be enumerated; use method="step"')
    if isinstance(world.copier, ReplayCopier):
        raise ValueError('env: copies of it do not behave as it does; use method="step"')
    with keep_global_generators():
        counters = Counters(world.driver, world.copier, world.starts[0], seed)
        search = _Search(world, counters, max_states)
        with _bar(progress) as show:
            for layout, start in enumerate(world.starts):
                search.add_layout(layout, start, show)
        for layout, start in enumerate(world.starts):
            search.check_walks(layout, start, np.random.default_rng(seed))
        if search.rewards_differ and not _is_minigrid(world.copier.load(world.starts[0].saved)):
            warnings.warn(
                f"env: rewards depend on `{', '.join(counters.names)}`, which each step changes; in this table they are"
                ' those of a first step (method="step" gives them as they are)',
                stacklevel=3,
            )
        return search.table(world.action_names, observations)


def _is_minigrid(env: Any) -> bool:
    """Whether it is one of MiniGrid's environments, whose rewards are known to fall with the number of steps."""
    return type(env.unwrapped).__module__.startswith("minigrid")


class _Search:
    """Breadth-first search through the states of an environment.

    Attributes:
        next_state, rewards: rows of the table so far.
        layouts, ended, observations, masks: of each state so far.
        rewards_differ: whether walks found other rewards than those of a first step.
    """

    def __init__(self, world: SimulatorWorld, counters: Counters, max_states: int) -> None:
        self.driver, self.copier, self.counters, self.max_states = world.driver, world.copier, counters, max_states
        self.next_state: list[list[int]] = []
        self.rewards: list[list[float]] = []
        self.layouts: list[int] = []
        self.rewards_differ = False
        self.ended: list[bool] = []
        self.observations: list[Any] = []
        self.masks: list[np.ndarray[Any, Any]] = []
        self.starts: list[int] = []
        self._numbers: dict[tuple[int, bytes, bool], int] = {}
        self._raw: dict[tuple[int, bytes, bool], int] = {}
        self._waiting: dict[int, Any] = {}

    def add_layout(self, layout: int, start: Start, show: Callable[[int, int], None]) -> None:
        """All states that can be reached from a start."""
        simulator = self.copier.load(start.saved)
        self.counters.remember(simulator)
        self.starts.append(self._number(layout, simulator, start.view, False))
        while len(self.next_state) < len(self.layouts):
            state = len(self.next_state)
            row, rewards = [state] * self.driver.num_actions, [0.0] * self.driver.num_actions
            saved = self._waiting.pop(state, None)
            for action in [] if self.ended[state] else np.flatnonzero(self.masks[state]).tolist():
                seed = (REPEATS_OF_NOISE + 1) * (state * self.driver.num_actions + action)
                row[action], rewards[action], draws = self._try(layout, saved, action, seed)
                is_checked = state < CHECKED_FIRST or state % CHECKED_EVERY == 0
                for repeat in range(REPEATS_OF_NOISE if draws else int(is_checked)):
                    again = self._try(layout, saved, action, seed + 1 + repeat)[:2]
                    if again != (row[action], rewards[action]):
                        raise ValueError(
                            f"env: action {action} led to two different states from the same one;"
                            ' use method="step", which tries plans under several random numbers'
                        )
            self.next_state.append(row)
            self.rewards.append(rewards)
            show(len(self.next_state), len(self.layouts))

    def _try(self, layout: int, saved: Any, action: int, seed: int) -> tuple[int, float, bool]:
        """Where an action leads from a saved state under the random numbers of a seed, its reward, whether it draws."""
        simulator = self.copier.load(saved)
        generators = list(self.copier.generators(simulator))
        seed_generators(generators, seed)
        before = state_of_generators(generators)
        observation, reward, ended, info = self.driver.take(simulator, action)
        draws = before != state_of_generators(generators)
        view = self.driver.view(simulator, observation, info)
        return self._number(layout, simulator, view, bool(ended or self.driver.end(view))), reward, draws

    def _number(self, layout: int, simulator: Any, view: View, ended: bool) -> int:
        """The number of the state in which a simulator is; a new one is saved."""
        self.counters.set_back(simulator)
        saved = self.copier.save(simulator, (None, [], 0))
        text = self.copier.text(saved)  # most states are recognised by their pickles, which are fast to compare
        raw = (layout, hashlib.blake2b(text, digest_size=16).digest(), ended)
        if text and raw in self._raw:
            return self._raw[raw]
        key = (layout, self._digest(simulator), ended)
        number = self._numbers.setdefault(key, len(self._numbers))
        if text:
            self._raw[raw] = number
        if number == len(self.layouts):
            if number == self.max_states:
                raise ValueError(
                    f"max_states: there are more than {self.max_states} states ({len(self.next_state)} expanded);"
                    ' allow more, or use method="step"'
                )
            self.layouts.append(layout)
            self.ended.append(ended)
            self.observations.append(view.observation)
            legal = np.ones(self.driver.num_actions, bool)
            self.masks.append(legal if view.mask is None or ended else view.mask)
            if not ended:
                self._waiting[number] = saved
        return number

    def _digest(self, simulator: Any) -> bytes:
        try:
            return digest(simulator)
        except ValueError as error:
            raise ValueError(f'env: {error}; use method="step"') from error

    def locate(self, env: Any) -> int:
        """The number of the state in which an environment is, which stays as it is.

        Raises:
            ValueError: the table has no such state.
        """
        with keep_global_generators():
            simulator = self.copier.load(self.copier.enter(without_limits(env), 0))
            self.counters.set_back(simulator)
            state = self._digest(simulator)
        for layout, ended in product(range(len(self.starts)), (False, True)):
            if (layout, state, ended) in self._numbers:
                return self._numbers[layout, state, ended]
        raise ValueError("`env` must be in a state of the table, got another one: of a start by another seed, perhaps")

    def table(self, names: tuple[str, ...] | None, observations: bool) -> EpisodicWorld:
        """The table."""
        starts = torch.zeros(len(self.layouts), dtype=torch.float64)
        starts[self.starts] = 1 / len(self.starts)
        legal = torch.from_numpy(np.stack(self.masks))
        return EpisodicWorld(
            torch.tensor(self.next_state),
            torch.tensor(self.rewards)[None],
            names,
            starts,
            torch.tensor(self.ended),
            legal_actions=None if legal.all() else legal,
            layouts=torch.tensor(self.layouts),
            features=torch.from_numpy(np.stack(self.observations)) if observations else None,
            locate=self.locate,
        )

    def check_walks(self, layout: int, start: Start, draw: np.random.Generator) -> None:
        """Compare random walks of copies with the table.

        Raises:
            ValueError: they differ.
        """
        for _ in range(NUM_WALKS):
            simulator, state = self.copier.load(start.saved), self.starts[layout]
            for t in range(1, WALK_LENGTH + 1):
                action = int(draw.choice(np.flatnonzero(self.masks[state])))
                observation, reward, ended, info = self.driver.take(simulator, action)
                expected, state = self.rewards[state][action], self.next_state[state][action]
                if ended == TRUNCATED and not self.ended[state]:
                    break  # a time limit, which the table does not have
                view = self.driver.view(simulator, observation, info)
                same = np.array_equal(view.observation, self.observations[state], equal_nan=True)
                same = same and bool(ended or self.driver.end(view)) == self.ended[state]
                if not same or (reward != expected and not self.counters.names):
                    raise ValueError(
                        f"env: action {t} of a walk led to something else than in its table: it is stochastic, or its"
                        ' state is not in its attributes; use method="step"'
                    )
                self.rewards_differ = self.rewards_differ or reward != expected
                if ended:
                    break


@contextmanager
def _bar(progress: bool) -> Iterator[Callable[[int, int], None]]:
    """A progress bar where rich is installed and standard error is a terminal."""
    try:
        rich = import_module("rich.progress") if progress else None
        console = import_module("rich.console").Console(stderr=True) if progress else None
    except ImportError:
        rich = None
    if rich is None or console is None or not console.is_terminal:
        yield lambda done, total: None
        return
    columns = (rich.TextColumn("{task.completed:,.0f} of {task.total:,.0f} states found so far"), rich.BarColumn())
    with rich.Progress(*columns, rich.TimeElapsedColumn(), console=console, transient=True) as bar:
        task = bar.add_task("states", total=1)
        yield lambda done, total: bar.update(task, completed=done, total=total)
