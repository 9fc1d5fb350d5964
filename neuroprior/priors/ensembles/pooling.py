"""Held-out plans as experts forecast them, and how the experts are best combined there."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuroprior.plans import Plans
from neuroprior.priors.learning import plans_for
from neuroprior.priors.prior import Prior, taken_of

MIN_LOG_PROB = -30.0
"""Log-probabilities of experts are at least this in the pool."""

MIN_GAIN_PER_ACTION, MIN_GAIN_NATS = 5e-4, 0.1
"""An expert is left out where the held-out loss rises by less than so many nats per action, or so many in all."""

MAX_FORECASTS = 2**22
"""The most numbers of forecasts from which the powers of the pool are learned."""

RIDGE = 1.0
"""Nats that it costs when a power of the pool is 1 away from that of the experts' geometric mean."""

RIDGE_OF_FEW = 5.0
"""The same where few plans are held out, for the distance from the powers that experts which count have without
networks, on all plans.
"""

NETWORK_GAIN_NATS = 4.0
"""Nats in all (or `MIN_GAIN_PER_ACTION` per action, if that is more) by which held-out plans have to be likelier for a
network to be kept: more than for counts, since its training was stopped where these plans were likeliest.
"""

EM_STEPS = 100
"""Of expectation maximisation, which learns the initial weights."""


class HeldOut:
    """What experts forecast for held-out plans, and how they are best combined there.

    Args:
        forecasts: `[N, L, E, A]`, log-probabilities.
        actions: `[N, L]`.
        mask: `[N, L]` bool: the actions that count.
        tried: how many forecasts, of experts, the pool and the fixed share, there were to choose from.
        anchor: `[E]`, float64: the powers of the pool that are chosen where these plans say nothing; None: those of the
            geometric mean.
    """

    def __init__(
        self, forecasts: Tensor, actions: Tensor, mask: Tensor, tried: int, anchor: Tensor | None = None
    ) -> None:
        self.forecasts, self.actions, self.mask, self.tried, self.anchor = forecasts, actions, mask, tried, anchor
        self.taken = taken_of(forecasts, actions).masked_fill(~mask[..., None], 0)
        self.count = max(int(mask.sum()), 1)
        # Some actions, evenly spread, are enough for a few powers.
        self.every = -(-self.count * forecasts[0, 0].numel() // MAX_FORECASTS)

    @cached_property
    def sample(self) -> Tensor:
        """`[M, E, A]`, float64: the log-probabilities at some of the actions that count."""
        return self.forecasts[self.mask][:: self.every].double().clamp(min=MIN_LOG_PROB)

    @cached_property
    def sample_actions(self) -> Tensor:
        """`[M]`: these actions."""
        return self.actions[self.mask][:: self.every].long()

    def of(self, kept: list[int], anchor: Tensor | None = None) -> "HeldOut":
        """The same of some experts, whose anchor is this one's, or `anchor`."""
        if anchor is None and self.anchor is not None:
            anchor = self.anchor[kept]
        return HeldOut(self.forecasts[:, :, kept], self.actions, self.mask, self.tried, anchor)

    def tolerance(self, gain: float = MIN_GAIN_NATS) -> float:
        """Nats per action that do not count, where `gain` nats in all do not."""
        return max(MIN_GAIN_PER_ACTION, gain / self.count)

    def choose(
        self, costs: Sequence[int], gains: Sequence[float] | None = None, fixed: int = 0
    ) -> tuple[list[int], Tensor]:
        """The experts that are kept, and their powers `[K]`, float64, in the pool.

        One expert after the other is left out: the dearest of those without which no more is lost than it has to add.

        Args:
            costs: of each expert, such as its number of weights. (Seconds differ from run to run, and so would what is
                chosen.)
            gains: nats in all by which these plans have to be likelier with each, see `tolerance`; None:
                `MIN_GAIN_NATS`.
            fixed: the first so many are kept.
        """
        kept, gains = list(range(len(costs))), gains or [MIN_GAIN_NATS] * len(costs)
        powers, best = self.combined(kept)
        since = best  # the least loss since an expert went that had to add more: what the others add is judged by it
        while len(kept) > 1:
            removals = []
            for out in kept[fixed:]:
                rest = [number for number in kept if number != out]
                rest_powers, loss = self.combined(rest)
                best, since = min(best, loss), min(since, loss)
                removals.append((out, loss, rest, rest_powers))
            least = {out: best if gains[out] > MIN_GAIN_NATS else since for out, *_ in removals}
            spared = [entry for entry in removals if entry[1] <= least[entry[0]] + self.tolerance(gains[entry[0]])]
            if not spared:
                break
            # The dearest; among those that count, which cost the same, the one that is missed least.
            gone, loss, kept, powers = max(spared, key=lambda entry: (costs[entry[0]], -entry[1]))
            since = loss if gains[gone] > MIN_GAIN_NATS else since
        return kept, powers

    def combined(self, kept: list[int] | None = None) -> tuple[Tensor, float]:
        """The powers of some experts (None: all) in their pool, and the loss of the mixture of these and the pool."""
        kept = list(range(self.forecasts.shape[2])) if kept is None else kept
        powers = self.powers(self.sample[:, kept], None if self.anchor is None else self.anchor[kept])
        pooled = with_pool(self.forecasts[:, :, kept], powers)[:, :, -1:]
        taken = taken_of(pooled, self.actions).masked_fill(~self.mask[..., None], 0)
        return powers, self.loss(torch.cat([self.taken[:, :, kept], taken], 2))

    def powers(self, forecasts: Tensor, anchor: Tensor | None = None) -> Tensor:
        """The powers `[K]` of the pool under which some actions are likeliest, of `forecasts [M, K, A]`.

        With a price for their distance from the `anchor [K]`; None: from those of the geometric mean.
        """
        from scipy.optimize import minimize  # takes a second to import: only where it is needed

        size, ridge = forecasts.shape[1], RIDGE if anchor is None else RIDGE_OF_FEW
        first = torch.full((size,), 1 / size, dtype=torch.double) if anchor is None else anchor.cpu()

        def loss(values: np.ndarray[Any, Any]) -> tuple[float, np.ndarray[Any, Any]]:
            now = torch.tensor(values, device=forecasts.device)
            log_probs = torch.einsum("mka,k->ma", forecasts, now).log_softmax(-1)
            taken = log_probs.gather(1, self.sample_actions[:, None]).sum()
            # The gradient: what was forecast of the action taken, less what the pool expects.
            chosen = forecasts.gather(2, self.sample_actions[:, None, None].expand(-1, size, 1))[..., 0].sum(0)
            slope = torch.einsum("mka,ma->k", forecasts, log_probs.exp()) - chosen
            away = now - first.to(now)
            return float(ridge * (away**2).sum() - taken), (slope + 2 * ridge * away).cpu().numpy()

        solution = minimize(loss, first.numpy(), jac=True, method="L-BFGS-B", bounds=[(0, None)] * size)
        return torch.tensor(solution.x, device=forecasts.device)

    def loss(self, taken: Tensor) -> float:
        """Nats per action of the Bayesian mixture of forecasts, from those of the actions taken, `[N, L, K]`."""
        totals = taken.sum(1)
        return -float((self.initial_weights(totals) + totals.double()).logsumexp(-1).sum()) / self.count

    def initial_weights(self, totals: Tensor) -> Tensor:
        """The logarithms `[K]` of the weights, of 1 / `tried` at least, under which plans are likeliest.

        Args:
            totals: `[N, K]`, the log-probability of each plan under each forecast.
        """
        totals, size = totals.double(), totals.shape[1]
        least, free = 1 / self.tried, 1 - size / self.tried
        share = totals.new_full((size,), 1 / size)
        for _ in range(EM_STEPS):
            weights = least + free * share
            earned = (weights.log() + totals).softmax(-1) * (free * share / weights)
            share = earned.sum(0) / earned.sum().clamp(min=1e-300)
        return (least + free * share).log().log_softmax(-1)


def with_pool(forecasts: Tensor, powers: Tensor) -> Tensor:
    """Log-probabilities `[..., E, A]`, and behind them their pool's, `[..., E + 1, A]`."""
    pooled = torch.einsum("...ea,e->...a", forecasts.clamp(min=MIN_LOG_PROB), powers.to(forecasts)).log_softmax(-1)
    return torch.cat([forecasts, pooled[..., None, :]], -2)


@torch.no_grad()
def stack_forecasts(experts: Sequence[Prior], plans: Plans) -> Tensor:
    """Returns `[N, L, E, A]`, the log-probabilities of all experts."""
    each = [e.forecasts(plans_for(e, plans)) for e in experts]
    return torch.stack([torch.cat([log_probs for _, log_probs in parts]) for parts in each], 2)
