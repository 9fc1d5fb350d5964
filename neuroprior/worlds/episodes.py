"""Tables of episodic environments: start states, absorbing terminal states, layouts."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from neuroprior._checks import check_count
from neuroprior._random import generator_on
from neuroprior.worlds.observations import Features
from neuroprior.worlds.tabular import TabularWorld


class EpisodicWorld(TabularWorld):
    """A `TabularWorld` with start states, absorbing terminal states, and any number of disjoint layouts.

    Its objective is "return", as that of the environments it is made from.

    Args:
        next_state, reward, action_names, probability, legal_actions: see `TabularWorld`.
        starts: floating point `[S]`: the probability that an episode starts there.
        ended: `[S]` bool: terminal states, in which every action stays, without reward.
        layouts: integers `[S]`: the layout that each state belongs to; None: there is one.
        features: floating point `[S, C]`: the observations; None: `observe` gives the number of the cell.
        locate: a function from a running environment to its cell, for `state_of`. It is not pickled with the world.

    Attributes:
        starts, ended, features: as given.
        num_layouts: number of layouts.
        has_goal: whether a terminal state can be entered with a positive reward.

    Raises:
        ValueError: a shape or value is wrong, see `TabularWorld`, or an action leaves a terminal state.

    Example:
        >>> table = torch.tensor([[1, 0], [1, 1]])  # action 0 leads to cell 1, where the episode is over
        >>> starts, ended = torch.tensor([1.0, 0.0]), torch.tensor([False, True])
        >>> world = EpisodicWorld(table, torch.tensor([[[1.0, 0], [0, 0]]]), None, starts=starts, ended=ended)
        >>> world.terminated(torch.tensor([0, 1])).tolist()
        [False, True]
    """

    objective = "return"

    def __init__(
        self,
        next_state: Tensor,
        reward: Tensor,
        action_names: Sequence[str] | None,
        starts: Tensor,
        ended: Tensor,
        *,
        probability: Tensor | None = None,
        legal_actions: Tensor | None = None,
        layouts: Tensor | None = None,
        features: Tensor | None = None,
        locate: Callable[[Any], int] | None = None,
    ) -> None:
        super().__init__(next_state, reward, legal_actions, action_names, probability=probability)
        for name, table in (("starts", starts), ("ended", ended), ("layouts", layouts), ("features", features)):
            if table is not None and len(table) != self.num_states:
                raise ValueError(f"`{name}` must be one entry for each of {self.num_states} states, got {len(table)}")
        if not (starts >= 0).all() or not starts.sum() > 0:
            raise ValueError("`starts` must be probabilities, got all of them 0")
        ended_states = ended.nonzero()[:, 0]
        if not (self.next_state[ended_states].flatten(1) == ended_states[:, None]).all():
            raise ValueError("ended: every action must stay where an episode has ended")
        self.starts, self.ended, self.features = starts, ended, features
        self._locate = locate
        if features is not None:
            self.observation = Features(features.shape[1])
        self._layouts = torch.zeros_like(ended, dtype=torch.long) if layouts is None else layouts.long()
        self.num_layouts = int(self._layouts.max()) + 1
        self._goals = self._entered_with_reward()
        self.has_goal = bool(self._goals.any())

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """States `[batch_size]`, drawn as episodes start; uniform over reward maps."""
        check_count("batch_size", batch_size)
        generator = generator_on(generator, self.device)
        where = self.starts.nonzero()[:, 0]
        upper = self.starts[where].double().cumsum(0)
        uniform = torch.rand(batch_size, generator=generator, device=self.device, dtype=torch.float64)
        drawn = torch.searchsorted(upper, uniform * upper[-1], right=True)
        cell = where[drawn.clamp(max=len(where) - 1)]
        if self.num_maps == 1:
            return cell
        return cell + self.num_states * torch.randint(
            self.num_maps, (batch_size,), generator=generator, device=self.device
        )

    def state_of(self, env: Any) -> Tensor:
        """The states `[B]` that stand for the present states of running environments: one, or a list of them.

        Raises:
            ValueError: this table was not made of an environment, or does not have the state.
        """
        if self._locate is None:
            raise ValueError("state_of: this table was made of no environment, or of one in another process")
        environments = env if isinstance(env, list | tuple) else [env]
        return torch.tensor([self._locate(one) for one in environments], dtype=torch.long, device=self.device)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_locate": None}

    def layout(self, state: Tensor) -> Tensor:
        """The layout of each state: int64 of the shape of `state`."""
        return self._layouts[self.cell(state)]

    def observe(self, state: Tensor) -> Tensor:
        """The features `[N, C]` of each state, or its number `[N]` where there are none."""
        return super().observe(state) if self.features is None else self.features[self.cell(state)]

    def solved(self, state: Tensor) -> Tensor:
        """Where an episode has ended in a state that can be entered with a positive reward."""
        return self._goals[self.reward_map(state), self.cell(state)]

    def _entered_with_reward(self) -> Tensor:
        """`[W, S]` bool: terminal states that some possible transition enters with a positive reward."""
        if self.reward.dim() == 2:
            return (self.reward > 0) & self.ended
        gains = self.reward.view(*self.reward.shape[:3], -1) > 0
        if self.probability is not None:
            gains = gains & (self.probability > 0)
        else:
            gains = gains.view(self.num_maps, *self.next_state.shape)
        entered = torch.zeros(self.num_maps, self.num_states, device=self.device)
        into = self.next_state.expand_as(gains).flatten(1)
        return (entered.scatter_add_(1, into, gains.flatten(1).float()) > 0) & self.ended

    def start_anywhere(self) -> "EpisodicWorld":
        """Let episodes start, with equal probability, in any reachable state that is not terminal; returns self."""
        reached = self.starts > 0
        possible = None if self.probability is None else self.probability > 0
        while True:
            after = self.next_state[reached]
            after = after.flatten() if possible is None else after[possible[reached]]
            extended = reached.index_fill(0, after, True)
            if extended.equal(reached):
                break
            reached = extended
        anywhere = (reached & ~self.ended).double()
        self.starts = anywhere / anywhere.sum()
        return self
