"""Tables of episodic environments: start states, absorbing terminal states, layouts."""

from collections.abc import Sequence
from functools import cached_property

import torch
from torch import Tensor

from neuroprior._checks import check_count
from neuroprior._random import generator_on
from neuroprior.worlds.tabular import TabularWorld


class EpisodicWorld(TabularWorld):
    """A `TabularWorld` with start states, absorbing terminal states, and any number of disjoint layouts.

    Args:
        next_state, reward, action_names, probability: see `TabularWorld`.
        starts: floating point `[S]`: the probability that an episode starts there.
        ended: `[S]` bool: terminal states, in which every action stays, without reward.
        layouts: integers `[S]`: the layout that each state belongs to; None: there is one.
        features: floating point `[S, C]`: the observations; None: `observe` gives the number of the cell.

    Attributes:
        starts, ended, features: as given.
        num_layouts: number of layouts.

    Raises:
        ValueError: a shape or value is wrong, see `TabularWorld`, or an action leaves a terminal state.
    """

    def __init__(
        self,
        next_state: Tensor,
        reward: Tensor,
        action_names: Sequence[str] | None,
        starts: Tensor,
        ended: Tensor,
        *,
        probability: Tensor | None = None,
        layouts: Tensor | None = None,
        features: Tensor | None = None,
    ) -> None:
        super().__init__(next_state, reward, None, action_names, probability=probability)
        for name, table in (("starts", starts), ("ended", ended), ("layouts", layouts), ("features", features)):
            if table is not None and len(table) != self.num_states:
                raise ValueError(
                    f"{name}: one entry for each of {self.num_states} states is expected, not {len(table)}"
                )
        if not (starts >= 0).all() or not starts.sum() > 0:
            raise ValueError("starts: probabilities are expected, not all of them 0")
        here = ended.nonzero()[:, 0]
        if not (self.next_state[here].flatten(1) == here[:, None]).all():
            raise ValueError("ended: every action must stay where an episode has ended")
        self.starts, self.ended, self.features = starts, ended, features
        self._layouts = torch.zeros_like(ended, dtype=torch.long) if layouts is None else layouts.long()
        self.num_layouts = int(self._layouts.max()) + 1

    def to(self, device: torch.device | str) -> "EpisodicWorld":
        super().to(device)
        self.starts, self.ended, self._layouts = (t.to(device) for t in (self.starts, self.ended, self._layouts))
        self.features = None if self.features is None else self.features.to(device)
        return self

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

    def layout(self, state: Tensor) -> Tensor:
        """The layout of each state: int64 of the shape of `state`."""
        return self._layouts[self.cell(state)]

    def observe(self, state: Tensor) -> Tensor:
        """The features `[N, C]` of each state, or its number `[N]` where there are none."""
        return super().observe(state) if self.features is None else self.features[self.cell(state)]

    @property
    def has_goal(self) -> bool:  # type: ignore[override]
        """Whether a step into a terminal state can be rewarded."""
        return bool(self._goals.any())

    def solved(self, state: Tensor) -> Tensor:
        """In the terminal states that can be entered with a reward above 0."""
        return self._goals[state]

    @cached_property
    def _goals(self) -> Tensor:
        """bool `[W * S]`: terminal states that an action leads to with a reward above 0."""
        goals = torch.zeros(self.num_maps, self.num_states, dtype=torch.bool, device=self.device)
        possible = torch.ones_like(self.next_state, dtype=torch.bool) if self.probability is None else self.probability > 0
        for reward, found in zip(self.reward, goals, strict=True):
            gained = reward[self.next_state] if reward.dim() == 1 else reward
            if gained.dim() < self.next_state.dim():
                gained = gained[..., None]
            rewarded = (gained > 0).expand_as(self.next_state) & possible & ~self.ended.view(-1, *[1] * (self.next_state.dim() - 1))
            found[self.next_state[rewarded]] = True
        return (goals & self.ended).flatten()

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
