"""Gymnasium environments as tables: read from their attribute `P`, or enumerated breadth first by copies."""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np
import torch

from neuroprior.worlds.episodes import EpisodicWorld
from neuroprior.worlds.gymnasium.environment import RUNNING, TRUNCATED, Episode, Transition, action_names, stacked
from neuroprior.worlds.gymnasium.states import (
    Copier,
    Counters,
    digest,
    exact_copier,
    first_difference,
    nondeterminism,
    reseed,
    walks,
)

CHECKED_FIRST, CHECKED_EVERY = 100, 10
"""Transitions are repeated, as a check, from so many states at first, and from every so many after them."""


def has_table(env: Any) -> bool:
    """Whether it can be read by `read_table`."""
    base = env.unwrapped
    return isinstance(getattr(base, "P", None), dict) and hasattr(base, "initial_state_distrib") and env is base


def read_table(env: Any) -> EpisodicWorld:
    """The table of a toy text; see `from_gymnasium`.

    Raises:
        ValueError: it has no table, or an incomplete one.
    """
    if not has_table(env):
        raise ValueError(
            'method="table": it takes an environment without wrappers whose transitions are in an attribute P;'
            ' "enumerate" and "step" do with any'
        )
    base = env.unwrapped
    if getattr(base, "fickle_passenger", False):
        raise ValueError("fickle_passenger: the passenger's changes of mind are not in the environment's table P")
    next_state, reward, probability, ends = _outcomes(base.P, int(env.action_space.n))
    next_state, ended = _absorbing(next_state, probability, ends)
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
        return EpisodicWorld(next_state[..., 0], reward[None, ..., 0], names, starts, ended)
    return EpisodicWorld(next_state, reward[None], names, starts, ended, probability=probability)


def _outcomes(table: Any, actions: int) -> tuple[torch.Tensor, ...]:
    """Next states, rewards, probabilities and whether the episode ends, each `[S, A, K]`."""
    rows = [[[o for o in table[s][a] if o[0] > 0] for a in range(actions)] for s in range(len(table))]
    most = max(len(outcomes) for row in rows for outcomes in row)
    filled = [[row[a] + [(0.0, 0, 0.0, False)] * (most - len(row[a])) for a in range(actions)] for row in rows]
    values = [[[[float(v) for v in outcome] for outcome in outcomes] for outcomes in row] for row in filled]
    probability, next_state, reward, ends = torch.tensor(values, dtype=torch.float64).unbind(-1)
    return next_state.long(), reward.float(), probability.contiguous(), ends.bool()


def _absorbing(next_state: torch.Tensor, probability: torch.Tensor, ends: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Transitions in which ended episodes stay where they ended, `[S or S + 1, A, K]`, and where that is.

    A state into which only transitions lead that end the episode becomes absorbing itself. Where others lead there,
    too, from states of running episodes, the episode ends in one more state instead.
    """
    states = len(ends)
    possible = probability > 0
    final = torch.zeros(states, dtype=torch.bool)
    final[next_state[ends & possible]] = True
    here = torch.arange(states)[:, None, None].expand_as(next_state)
    ended, before = final, None
    while before is None or not ended.equal(before):
        before = ended
        running = possible & ~ends & ~ended[here]
        ended = ended.index_fill(0, next_state[running], False)
    shared = final & ~ended
    next_state = torch.where(ends & possible & shared[next_state], states, next_state)
    if shared.any():
        ended = torch.cat([ended, torch.tensor([True])])
        next_state = torch.cat([next_state, torch.zeros_like(next_state[:1])])
    next_state[ended] = ended.nonzero()[:, 0, None, None]
    return next_state, ended


def enumerate_states(env: Any, seeds: list[int], max_states: int, progress: bool, observations: bool) -> EpisodicWorld:
    """The table of all states that can be reached from `env.reset(seed=seed)` for each seed; see `from_gymnasium`.

    Raises:
        ValueError: it is stochastic, cannot be copied, or has more than `max_states` states.
    """
    episode = Episode(env)
    difference = nondeterminism(episode, seeds[0])
    if difference is not None:
        raise ValueError(f"env: {difference} differs between two trajectories of the same actions from seed {seeds[0]}")
    copier = exact_copier(episode, seeds[0])
    if copier is None:
        raise ValueError('env: copies of it do not behave as it does; use method="step"')
    search = _Search(episode, copier, Counters(episode, seeds[0]), max_states)
    with _bar(progress) as show:
        for layout, seed in enumerate(seeds):
            search.add_layout(layout, seed, show)
    world = search.world(observations)
    for layout, seed in enumerate(seeds):
        search.check_walks(layout, seed)
    return world


class _Search:
    """Breadth-first search through the states of an environment.

    Attributes:
        next_state, rewards: rows of the table so far.
        layouts, ended, features: of each state so far.
    """

    def __init__(self, episode: Episode, copier: Copier, counters: Counters, max_states: int) -> None:
        self.episode, self.copier, self.counters, self.max_states = episode, copier, counters, max_states
        self.next_state: list[list[int]] = []
        self.rewards: list[list[float]] = []
        self.layouts: list[int] = []
        self.ended: list[bool] = []
        self.features: list[np.ndarray[Any, Any]] = []
        self.starts: list[int] = []
        self._numbers: dict[tuple[int, bytes, bool], int] = {}
        self._raw: dict[tuple[int, bytes, bool], int] = {}
        self._waiting: dict[int, Any] = {}
        self._env = episode.env

    def add_layout(self, layout: int, seed: int, show: Callable[[int, int], None]) -> None:
        """All states that can be reached from `seed`."""
        self.episode.env = self._env
        step = self.episode.reset(seed)
        self.counters.remember(self._env)
        self.episode.env = self.copier.restore(self.copier.save(self._env))  # a copy, like all others
        self.starts.append(self._number(layout, Transition(step, 0.0, RUNNING)))
        for state in iter(lambda: len(self.next_state), None):
            if state == len(self.layouts):
                break
            saved = self._waiting.pop(state, None)
            if self.ended[state]:
                self.next_state.append([state] * self.episode.num_actions)
                self.rewards.append([0.0] * self.episode.num_actions)
            else:
                self._expand(layout, state, saved)
            show(len(self.next_state), len(self.layouts))

    def _expand(self, layout: int, state: int, saved: Any) -> None:
        """The row of one state."""
        row, rewards = [], []
        for action in range(self.episode.num_actions):
            found = self._try(layout, saved, action)
            if state < CHECKED_FIRST or state % CHECKED_EVERY == 0:
                again = self._try(layout, saved, action, other_seed=state * self.episode.num_actions + action)
                if again != found:
                    raise ValueError(
                        f"env: action {action} led to two different states from the same one;"
                        ' use method="step" where the seed may fix what is random'
                    )
            row.append(found[0])
            rewards.append(found[1])
        self.next_state.append(row)
        self.rewards.append(rewards)

    def _try(self, layout: int, saved: Any, action: int, other_seed: int | None = None) -> tuple[int, float]:
        """Where an action leads from a saved state, and its reward; with `other_seed` under other random numbers."""
        self.episode.env = self.copier.restore(saved)
        if other_seed is not None:
            reseed(self.episode.env, other_seed)
        step = self.episode.step(action)
        return self._number(layout, step), step.reward

    def _number(self, layout: int, step: Transition) -> int:
        """The number of the state in which the environment is; a new one is saved."""
        env, end = self.episode.env, step.end != RUNNING
        self.counters.set_back(env)
        saved = self.copier.save(env)
        raw = None
        if isinstance(saved, bytes):  # most states are recognised by their pickles, which are fast to compare
            raw = (layout, hashlib.blake2b(saved, digest_size=16).digest(), end)
            if raw in self._raw:
                return self._raw[raw]
        key = (layout, digest(env), end)
        number = self._numbers.setdefault(key, len(self._numbers))
        if raw is not None:
            self._raw[raw] = number
        if number == len(self.layouts):
            if number == self.max_states:
                raise ValueError(
                    f"max_states: there are more than {self.max_states} states ({len(self.next_state)} expanded);"
                    ' allow more, or use method="step"'
                )
            self.layouts.append(layout)
            self.ended.append(end)
            self.features.append(step.features)
            if not end:
                self._waiting[number] = saved
        return number

    def world(self, observations: bool) -> EpisodicWorld:
        """The table."""
        starts = torch.zeros(len(self.layouts), dtype=torch.float64)
        starts[self.starts] = 1 / len(self.starts)
        return EpisodicWorld(
            torch.tensor(self.next_state),
            torch.tensor(self.rewards)[None],
            action_names(self._env),
            starts,
            torch.tensor(self.ended),
            layouts=torch.tensor(self.layouts),
            features=stacked(self.features) if observations else None,
        )

    def check_walks(self, layout: int, seed: int) -> None:
        """Compare random walks in the environment itself with the table.

        Raises:
            ValueError: they differ.
        """
        self.episode.env = self._env
        for actions in walks(self.episode.num_actions):
            self.episode.reset(seed)
            state, real, table = self.starts[layout], [], []
            for action in actions:
                step = self.episode.step(action)
                reward = self.rewards[state][action]
                state = self.next_state[state][action]
                if step.end == TRUNCATED and not self.ended[state]:
                    break  # a time limit, which the table does not have
                known = not self.counters.names  # else rewards may depend on them
                real.append(Transition(step.features, step.reward if known else 0.0, int(step.end != RUNNING)))
                table.append(Transition(self.features[state], reward if known else 0.0, int(self.ended[state])))
                if step.end:
                    break
            difference = first_difference(real, table)
            if difference is not None:
                raise ValueError(
                    f"env: {difference} differs between the environment and its table: it is stochastic, or its"
                    ' state is not in its attributes; use method="step"'
                )


@contextmanager
def _bar(progress: bool) -> Iterator[Callable[[int, int], None]]:
    """A progress bar where rich is installed and standard error is a terminal."""
    try:
        rich = import_module("rich.progress") if progress else None
        console = import_module("rich.console").Console(stderr=True) if progress else None
    except ImportError:
        rich = None
    if rich is None or console is None or not console.is_terminal:
        yield lambda done, found: None
        return
    columns = (rich.TextColumn("{task.completed:,.0f} of {task.total:,.0f} states found so far"), rich.BarColumn())
    with rich.Progress(*columns, rich.TimeElapsedColumn(), console=console, transient=True) as bar:
        task = bar.add_task("states", total=1)
        yield lambda done, found: bar.update(task, completed=done, total=found)
