"""Any deterministic Gymnasium environment as a table: all its states, found breadth first by copies of it."""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np
import torch

from neuroprior.worlds.episodes import EpisodicWorld
from neuroprior.worlds.gymnasium.opening import GOES_ON, TRUNCATED, Episode, Seen, action_names, stacked
from neuroprior.worlds.gymnasium.snapshots import (
    Copier,
    Counters,
    exact_copier,
    first_difference,
    unlike_itself,
    walks,
)
from neuroprior.worlds.gymnasium.states import digest, reseed

CHECKED_FIRST, CHECKED_EVERY = 100, 10


def enumerate_states(env: Any, seeds: list[int], max_states: int, progress: bool, observations: bool) -> EpisodicWorld:
    """The table of all states that can be reached from `env.reset(seed=seed)` for each seed; see `from_gymnasium`.

    Raises:
        ValueError: it has chance, cannot be copied, or has more than `max_states` states.
    """
    episode = Episode(env)
    difference = unlike_itself(episode, seeds[0])
    if difference is not None:
        raise ValueError(f"env: {difference} differs between two courses of the same actions from seed {seeds[0]}")
    copier = exact_copier(episode, seeds[0])
    if copier is None:
        raise ValueError('env: copies of it do not go on as it does itself; use method="step"')
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
        seen = self.episode.reset(seed)
        self.counters.remember(self._env)
        self.episode.env = self.copier.restore(self.copier.save(self._env))  # like all others, a copy
        self.starts.append(self._number(layout, Seen(seen, 0.0, GOES_ON)))
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
                        ' use method="step" where chance may be fixed by the seed'
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
        seen = self.episode.step(action)
        return self._number(layout, seen), seen.reward

    def _number(self, layout: int, seen: Seen) -> int:
        """The number of the state in which the environment is; a new one is saved."""
        env, end = self.episode.env, seen.end != GOES_ON
        self.counters.set_back(env)
        saved = self.copier.save(env)
        raw = None
        if isinstance(saved, bytes):  # most states are told by their pickles, which are quick to compare
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
                    f"max_states: there are more than {self.max_states} states ({len(self.next_state)} looked at);"
                    ' allow more, or use method="step"'
                )
            self.layouts.append(layout)
            self.ended.append(end)
            self.features.append(seen.features)
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
                seen = self.episode.step(action)
                reward = self.rewards[state][action]
                state = self.next_state[state][action]
                if seen.end == TRUNCATED and not self.ended[state]:
                    break  # out of time, which the table does not know
                known = not self.counters.names  # else rewards may depend on them
                real.append(Seen(seen.features, seen.reward if known else 0.0, int(seen.end != GOES_ON)))
                table.append(Seen(self.features[state], reward if known else 0.0, int(self.ended[state])))
                if seen.end:
                    break
            difference = first_difference(real, table)
            if difference is not None:
                raise ValueError(
                    f"env: {difference} differs between the environment and its table: it has chance, or its state is"
                    ' not in its attributes; use method="step"'
                )


@contextmanager
def _bar(progress: bool) -> Iterator[Callable[[int, int], None]]:
    """A progress bar where rich is installed and a terminal is there to see it."""
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
