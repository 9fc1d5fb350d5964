"""Beams of plans that grow step by step from any prior, the most probable ones or by chance, blind or in a world."""

import torch
from torch import Tensor

from neuroprior._random import gumbel
from neuroprior.plans import action_dtype
from neuroprior.sampling.ancestral import Steppable, advance
from neuroprior.sampling.draws import after_end
from neuroprior.worlds.world import Rollout, World, join_states


class Beams:
    """Beams of B distributions, K of each, which grow step by step.

    Args:
        prior: any prior.
        logits, memory: as its `start` returned them, for B rows.
        temperature: divides the logits.
        generator: draws Gumbel noise; None: the most probable beams are kept.
        world, state: where plans are tried on the way, and from where; None: nowhere.
    """

    def __init__(
        self,
        prior: Steppable,
        logits: Tensor,
        memory: Tensor,
        temperature: float,
        generator: torch.Generator | None,
        world: World | None = None,
        state: Tensor | None = None,
    ) -> None:
        self.prior, self.logits, self.memory, self.temperature = prior, logits, memory, temperature
        self.generator, self.world, self.now = generator, world, state
        self.batch, self.plans = len(logits), no_actions(prior, len(logits))
        self.tried: list[list[Tensor]] = [[], []]  # rewards and states of each step
        self.log_prob = torch.zeros(self.batch, 1, dtype=torch.float64, device=logits.device)
        self.height = self.log_prob if generator is None else gumbel(self.log_prob, generator)

    def grow(self, most: int, length: int) -> None:
        """Grow at most so many beams of `length` actions."""
        for t in range(length):
            self._grow(most, last=t + 1 == length)

    def rollout(self, start: Tensor, keep_states: bool) -> Rollout:
        """What came of the plans."""
        assert self.now is not None
        shape = self.log_prob.shape
        rewards = torch.stack(self.tried[0], 1).view(*shape, len(self.tried[0]))
        states = join_states(self.tried[1], start, (*shape, *start.shape[1:])) if keep_states else None
        return Rollout(self.now.view(*shape, *start.shape[1:]), rewards, states)

    def _grow(self, most: int, last: bool) -> None:
        """One more action: of all beams' children those with the greatest heights are the new beams."""
        logits, actions = self.logits, self.prior.num_actions
        if self.world is not None and not self.world.all_legal:
            assert self.now is not None
            logits = logits.masked_fill(~self.world.legal_actions(self.now), -torch.inf)
        child = children(self.log_prob.view(-1, 1), logits, self.temperature)
        height = child if self.generator is None else self._heights(child, self.generator)
        beams = self.log_prob.shape[1]
        self.height, index = height.view(self.batch, beams * actions).topk(min(most, beams * actions))
        self.log_prob = child.view(self.batch, beams * actions).gather(1, index)
        row, action = origins(index, beams, actions)
        self.keep(row)
        self.plans = torch.cat([self.plans, action[:, None].to(self.plans.dtype)], 1)
        seen = None
        if self.world is not None:
            assert self.now is not None
            self.now, reward = self.world.step(self.now, action, None)
            self.tried[0].append(reward)
            self.tried[1].append(self.now)
            seen = self.world.observe(self.now) if self.prior.context_per == "step" and not last else None
        if not last:
            self.logits, self.memory = advance(self.prior, action, self.memory, seen)
            self.logits = after_end(self.logits, action, self.prior.end)

    def keep(self, row: Tensor) -> None:
        """Go on with these beams."""
        self.plans, self.memory = self.plans.index_select(0, row), self.memory.index_select(0, row)
        if self.now is not None:
            self.now = self.now.index_select(0, row)
        self.tried = [[step.index_select(0, row) for step in column] for column in self.tried]

    def _heights(self, child: Tensor, generator: torch.Generator) -> Tensor:
        """Gumbel variables located at `child [M, A]`, given that the greatest of each row is its parent's height.

        Kool, van Hoof and Welling 2019, appendix B.3.
        """
        free = gumbel(child, generator)
        parent = self.height.view(-1, 1)
        below = parent - free + torch.log1p(-torch.exp(free - free.amax(-1, keepdim=True)))
        height = parent - below.clamp(min=0) - torch.log1p(torch.exp(-below.abs()))
        # What is impossible stays so; where a whole beam is, nothing above is a number.
        return torch.where(child > -torch.inf, height, -torch.inf)


def children(log_prob: Tensor, logits: Tensor, temperature: float) -> Tensor:
    """The log-probabilities `[M, A]` of plans of `log_prob [M, 1]` with one more action, by its `logits [M, A]`."""
    child = log_prob + (logits.double() / temperature).log_softmax(-1)
    # What a prior says after what cannot be may be no number.
    return torch.where(log_prob > -torch.inf, child, -torch.inf)


def origins(index: Tensor, beams: int, actions: int) -> tuple[Tensor, Tensor]:
    """Where children come from, by number: `index [B, K]` of the children of each of B times `beams`, A of each beam.

    Returns:
        The rows `[B * K]` of their beams among all, and their actions.
    """
    first = torch.arange(len(index), device=index.device)[:, None] * beams
    return (first + index.div(actions, rounding_mode="floor")).flatten(), (index % actions).flatten()


def no_actions(prior: Steppable, number: int) -> Tensor:
    """Plans `[number, 0]`."""
    return torch.empty(number, 0, dtype=action_dtype(prior.num_actions), device=prior.device)
