"""Any Gymnasium environment as a world: stepped by copies, or replayed from its seed where copies cannot be trusted."""

from collections import OrderedDict
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from neuroprior._checks import check_count, check_range, is_integer
from neuroprior._random import generator_on
from neuroprior.worlds.gymnasium.environment import RUNNING, Episode, Transition, action_names, stacked
from neuroprior.worlds.gymnasium.states import exact_copier, nondeterminism
from neuroprior.worlds.observations import Features
from neuroprior.worlds.world import Rollout, World, check_plans, on_cpu

_SEED, _LENGTH, _ENDED, _ACTIONS = 0, 1, 2, 3


class _Kept(NamedTuple):
    """The last transition of a history, and a copy of the environment there."""

    last: Transition
    saved: Any


class SteppedWorld(World):
    """A Gymnasium environment that is stepped, not tabulated; see `from_gymnasium`.

    A state is a history, int64 `[3 + horizon]`: the number of its seed, how many actions were taken, whether the
    episode has ended (0 or 1), and the actions, filled up with zeros. So states are plain data: they can be stored,
    compared and moved. Recent histories are cached with copies of the environment there, and not stepped again.

    Args:
        env: a Gymnasium environment with discrete actions.
        seeds: episodes start from one of these.
        horizon: the most actions that a state may hold.

    Attributes:
        copies: whether copies of the environment behave as it does, and are used; else histories are replayed.
        seeds, horizon: as given.
        num_layouts: number of seeds.
        action_names: the names of the actions, or None.
        max_kept: the most histories that are cached.

    Raises:
        ValueError: the environment does not repeat itself from a seed; the message says what differed.
    """

    max_kept: int = 4096

    def __init__(self, env: Any, seeds: list[int], horizon: int) -> None:
        self._episode = Episode(env)
        for seed in seeds:
            difference = nondeterminism(self._episode, seed)
            if difference is not None:
                raise ValueError(
                    f"env: {difference} differs between two trajectories of the same actions from seed"
                    f" {seed}: it cannot be replayed, so no plan can be tried in it"
                )
        self.seeds, self.num_layouts, self.horizon = tuple(seeds), len(seeds), horizon
        self.num_actions, self.action_names = self._episode.num_actions, action_names(env)
        self._copier = exact_copier(self._episode, seeds[0])
        self.copies = self._copier is not None
        self._env = env
        self.observation = Features(len(self._episode.reset(seeds[0])))
        self._at: tuple[int, ...] = ()  # the history at whose end the environment is; () where that is not known
        self._kept: OrderedDict[tuple[int, ...], _Kept] = OrderedDict()

    def to(self, device: torch.device | str) -> Self:
        """Raise ValueError for any other device than the CPU, on which environments are stepped."""
        return on_cpu(self, device)

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """States `[batch_size, 3 + horizon]` before the first action, with equal probability for each seed.

        Those of one seed are all the same: give `from_gymnasium` as many `seeds` as starts are wanted.
        """
        check_count("batch_size", batch_size, 8 * (_ACTIONS + self.horizon))
        generator = generator_on(generator, "cpu")
        state = torch.zeros(batch_size, _ACTIONS + self.horizon, dtype=torch.long)
        state[:, _SEED] = torch.randint(len(self.seeds), (batch_size,), generator=generator)
        return state

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """See `World.step`. `generator` draws nothing: what is random is determined by the seed.

        Raises:
            ValueError: a state holds `horizon` actions already.
        """
        after, rewards = self._try(state, action[:, None])
        return after[:, 0], rewards[:, 0]

    def rollout(
        self, state: Tensor, plans: Tensor, generator: torch.Generator | None = None, keep_states: bool = False
    ) -> Rollout:
        """See `World.rollout`. Prefixes that plans share are stepped once."""
        self.check_state(state)
        check_plans(plans, len(state), self.num_actions)
        batch, num_plans, length = plans.shape
        each = state.repeat_interleave(num_plans, 0)
        after, rewards = self._try(each, plans.reshape(batch * num_plans, length).long())
        final = after[:, -1] if length else each
        return Rollout(
            final.reshape(batch, num_plans, state.shape[1]),
            rewards.view(batch, num_plans, length),
            after.view(batch, num_plans, length, state.shape[1]) if keep_states else None,
        )

    def observe(self, state: Tensor) -> Tensor:
        """The environment's observation after each history: float32 `[N, C]`, texts left out."""
        if len(state) == 0:
            return self.observe(self.reset(1).to(state.device))[:0]
        distinct, which = state.cpu().unique(dim=0, return_inverse=True)
        found = [self._last(history).features for history in self._histories(distinct)]
        return stacked(found).to(state.device)[which.to(state.device)]

    def layout(self, state: Tensor) -> Tensor:
        """The number of the seed from which each state `[..., 3 + horizon]` comes, between 0 and num_layouts - 1."""
        return state[..., _SEED]

    def terminated(self, state: Tensor) -> Tensor:
        """Where the episode has ended."""
        return state[:, _ENDED] == 1

    def check_state(self, state: Tensor) -> None:
        width = _ACTIONS + self.horizon
        if not isinstance(state, Tensor) or state.dim() != 2 or state.shape[1] != width or not is_integer(state):
            raise ValueError(f"`state` must be integers of shape [B, {width}], such as reset returns")
        check_range("state (seed)", state[:, _SEED], len(self.seeds), "seeds")
        check_range("state (length)", state[:, _LENGTH], self.horizon + 1, "lengths")
        check_range("state (ended)", state[:, _ENDED], 2, "values")
        check_range("state (actions)", state[:, _ACTIONS:], self.num_actions, "actions")

    def _try(self, state: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """States `[N, L, 3 + horizon]` and rewards `[N, L]` after each of `actions [N, L]`."""
        together = torch.cat([state, actions.to(state)], 1).cpu()
        # Sorted, so that plans with the same beginning follow one another.
        distinct, which = together.unique(dim=0, return_inverse=True)
        start, plans = distinct[:, : state.shape[1]], distinct[:, state.shape[1] :]
        rewards, ended = self._follow(start, plans)
        states = []
        for t in range(plans.shape[1]):
            start = _append(start, plans[:, t], ended[:, t])
            states.append(start)
        after = torch.stack(states, 1) if states else start[:, None][:, :0]
        return after[which].to(state.device), rewards[which].to(state.device)

    def _follow(self, start: Tensor, plans: Tensor) -> tuple[Tensor, Tensor]:
        """The rewards of `plans [N, L]`, and whether the episode has ended after each action: `[N, L]`."""
        rewards, ended = np.zeros(plans.shape, np.float32), np.ones(plans.shape, bool)
        already = start[:, _ENDED].tolist()
        # An environment runs one episode at a time.
        for row, (history, plan) in enumerate(zip(self._histories(start), plans.tolist(), strict=True)):
            for t, action in enumerate([] if already[row] else plan):
                if len(history) > self.horizon:
                    raise ValueError(
                        f"state: it holds {self.horizon} actions, which is all that it can;"
                        " give from_gymnasium a longer horizon"
                    )
                history = (*history, action)
                last = self._last(history)
                rewards[row, t], ended[row, t] = last.reward, last.end != RUNNING
                if ended[row, t]:
                    break
        return torch.from_numpy(rewards), torch.from_numpy(ended)

    def _histories(self, state: Tensor) -> list[tuple[int, ...]]:
        """The number of the seed and the actions since, of each state."""
        return [(row[_SEED], *row[_ACTIONS : _ACTIONS + row[_LENGTH]]) for row in state.tolist()]

    def _last(self, history: tuple[int, ...]) -> Transition:
        """The last transition of a history."""
        kept = self._kept.get(history)
        if kept is None:
            last, saved = self._reach(history), None
            if self._copier is not None and last.end == RUNNING:
                saved = self._copier.save(self._episode.env)
            kept = self._kept[history] = _Kept(last, saved)
            if len(self._kept) > self.max_kept:
                self._kept.popitem(last=False)
        self._kept.move_to_end(history)
        return kept.last

    def _reach(self, history: tuple[int, ...]) -> Transition:
        """Bring the environment to the end of a history, from the nearest cached state; the last transition."""
        last, done = None, 0
        if self._copier is not None:
            for length in range(len(history) - 1, 0, -1):
                kept = self._kept.get(history[:length])
                if kept is not None and kept.saved is not None:
                    self._episode.env, done = self._copier.restore(kept.saved), length
                    break
        elif 0 < len(self._at) < len(history) and history[: len(self._at)] == self._at:
            done = len(self._at)
        if not done:
            self._episode.env, done = self._env, 1
            last = Transition(self._episode.reset(self.seeds[history[0]]), 0.0, RUNNING)
        for action in history[done:]:
            last = self._episode.step(action)
        self._at = history
        assert last is not None
        return last


def _append(state: Tensor, action: Tensor, ended: Tensor) -> Tensor:
    """`state [N, ...]` after one more `action [N]`, by which an episode may have `ended [N]`; ended ones stay."""
    state = state.clone()
    going = (state[:, _ENDED] == 0).nonzero()[:, 0]
    state[going, _ACTIONS + state[going, _LENGTH]] = action[going]
    state[going, _LENGTH] += 1
    state[going, _ENDED] = ended[going].long()
    return state
