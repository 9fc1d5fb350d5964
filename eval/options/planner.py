"""The option planner: its candidates begin in each mode of a switching prior by turns."""

from typing import Any

import torch
from torch import Tensor

from neuroprior.planners.sampling import SamplingPlanner
from neuroprior.priors.switching.switching_prior import SwitchingPrior
from neuroprior.sampling.stepping import Steppable
from neuroprior.worlds.world import Rollout, World


class OptionPlanner(SamplingPlanner):
    """A sampling planner that spreads its candidates evenly over the modes in which they begin.

    The modes of a switching prior are options (Sutton, Precup and Singh 1999): each is a way of acting that ends by
    itself, in each context with a probability of its own. A plan that is sampled from the prior begins in a mode drawn
    from `SwitchingPrior.first`. Here candidate i begins in mode i mod K, so that of P candidates P / K begin in each
    of the K modes, and of the remainder one each in the first, most frequent ones. After its beginning a candidate is
    drawn as the prior says, its mode switching unless `terminations` is False.

    Args:
        prior: the switching prior.
        length, num_plans: see `SamplingPlanner`.
        terminations: False: a candidate keeps its first mode to its end.
        **how: see `SamplingPlanner`.

    Raises:
        ValueError: an argument is out of range, or this is no switching prior.

    Example:
        >>> from neuroprior.priors import SwitchingPrior
        >>> plans = Plans(torch.tensor([[0] * 10 + [1] * 10]).repeat(12, 1), 4)
        >>> prior = SwitchingPrior(4, num_modes=2, folds=2, restarts=1).fit(
        ...     plans, generator=torch.Generator().manual_seed(0)
        ... )
        >>> OptionPlanner(prior, length=4, num_plans=8).plan(gridworld(5, 5, seed=0), torch.tensor([0, 12])).plan.shape
        torch.Size([2, 4])
    """

    def __init__(
        self, prior: SwitchingPrior, length: int, num_plans: int, *, terminations: bool = True, **how: Any
    ) -> None:
        if not isinstance(prior, SwitchingPrior):
            raise ValueError(f"`prior` must be a SwitchingPrior, got {type(prior).__name__}")
        super().__init__(prior, length, num_plans, **how)
        self.options, self.terminations = prior, terminations

    def _draw(
        self, prior: Steppable, number: int, temperature: float, world: World, state: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Rollout | None]:
        how = temperature, world, state, generator
        if prior is not self.options:
            return super()._draw(prior, number, *how)
        modes = range(min(self.options.num_modes, number))
        counts = [len(range(mode, number, self.options.num_modes)) for mode in modes]
        begun = [self.options.beginning_in(mode, keep=not self.terminations) for mode in modes]
        drawn = [super(OptionPlanner, self)._draw(one, n, *how) for one, n in zip(begun, counts, strict=True)]
        # By turns: the first candidate of each mode, then the second of each.
        order = torch.cat([torch.arange(n) for n in counts]).argsort(stable=True).to(state.device)

        def joined(parts: list[Tensor]) -> Tensor:
            return torch.cat(parts, 1)[:, order]

        plans = joined([plans for plans, _ in drawn])
        rollouts = [rollout for _, rollout in drawn if rollout is not None]
        if not rollouts:
            return plans, None
        states = [rollout.states for rollout in rollouts if rollout.states is not None]
        ends, rewards = (
            joined([getattr(rollout, name) for rollout in rollouts]) for name in ("final_state", "rewards")
        )
        return plans, Rollout(ends, rewards, joined(states) if states else None)
