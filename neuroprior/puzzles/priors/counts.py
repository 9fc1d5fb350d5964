"""Smoothed counts of patterns: their product, or back-off from the rarest pattern to the most common."""

from math import inf
from typing import Any, Literal, Self

import numpy as np
import torch
from torch import Tensor

from neuroprior._checks import is_number
from neuroprior.puzzles.priors.pattern_prior import PatternPrior, Steps, compiled_fit

HELD_OUT = 10
"""The steps are cut into `HELD_OUT` ** 2 blocks, of which every `HELD_OUT`-th is held out to choose the power on."""

LARGEST_POWER = 2.0


class PatternCounts(PatternPrior):
    """Counts of actions after each pattern, smoothed and combined.

    "product": the odds that patterns give multiply, as if they were independent given the action (naive Bayes), raised
    to a power that held-out steps choose; the weights are those of a log-linear model. "backoff": from the most
    common active pattern to the rarest, each estimate is (n p + k q) / (n + k), p the shares after the pattern, n how
    often it occurred, and q the estimate before.

    Args:
        num_actions, num_patterns, min_count: see `PatternPrior`.
        combine: see above.
        smoothing: above 0: k, and how many counts the marginal probabilities weigh in a product.

    Attributes:
        weights: of a product, see `PatternPrior`; for back-off the counts, float32 `[V + 1, A]`; the last row is 0.
        marginal: float32 `[A]`: how common each action is; what back-off begins with.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> patterns = torch.randint(5, (40, 3, 2), generator=torch.Generator().manual_seed(0), dtype=torch.int32)
        >>> prior = PatternCounts(2, num_patterns=2).fit(Plans(patterns[..., 0] % 2, 2, context=patterns))
        >>> prior.start(1, torch.tensor([[3, 0]]))[0].argmax(-1).tolist()
        [0]
    """

    marginal: Tensor

    def __init__(
        self,
        num_actions: int,
        num_patterns: int,
        *,
        combine: Literal["product", "backoff"] = "product",
        smoothing: float = 1.0,
        min_count: int = 2,
    ) -> None:
        super().__init__(num_actions, num_patterns, use_last=combine == "product", min_count=min_count)
        if combine not in ("product", "backoff"):
            raise ValueError(f'combine: "product" or "backoff" is expected, not {combine!r}')
        if not is_number(smoothing) or not 0 < smoothing < inf:
            raise ValueError(f"smoothing: a finite number above 0 is expected, not {smoothing!r}")
        self.combine, self.smoothing = combine, float(smoothing)
        self.register_buffer("marginal", torch.full((num_actions,), 1 / num_actions))

    @property
    def config(self) -> dict[str, Any]:
        own = {key: value for key, value in super().config.items() if key != "use_last"}
        return own | {"combine": self.combine, "smoothing": self.smoothing}

    def fit_steps(self, steps: Steps, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Count anew; returns self. Nothing is drawn, and there are no settings."""
        self.check_settings(settings)
        steps.check(self.num_actions, self.num_patterns or 0)
        if self.combine == "backoff":
            return self._count(steps, 1.0)
        every = torch.arange(len(steps.action))
        held_out = (every * HELD_OUT**2 // len(every)) % HELD_OUT == HELD_OUT - 1
        if not bool(held_out.any()):
            return self._count(steps, 1.0)
        self._count(Steps(*(x[~held_out] for x in steps)), 1.0)
        some = Steps(*(x[held_out] for x in steps))
        from scipy.optimize import minimize_scalar  # slow to import

        prior = self.marginal.log()
        gains = self._logits(self.scores(some.patterns), some.last) - prior

        def loss(power: float) -> float:
            logits = prior + power * gains
            return float(torch.nn.functional.cross_entropy(logits, some.action))

        power = minimize_scalar(loss, bounds=(0, LARGEST_POWER), method="bounded").x
        return self._count(steps, float(power))

    def _count(self, steps: Steps, power: float) -> Self:
        loops, actions = compiled_fit(), self.num_actions
        patterns, action = steps.patterns.cpu().numpy(), steps.action.cpu().numpy()
        vocabulary = loops.frequent([patterns], self.min_count)
        rows = loops.numbered(vocabulary, patterns)
        counts = np.zeros((len(vocabulary) + 1, actions))
        for column in rows.T:
            np.add.at(counts, (column, action), 1)
        counts[-1] = 0
        marginal = np.bincount(action, minlength=actions) + 1.0 / actions
        marginal /= marginal.sum()
        self.set_tables(patterns=vocabulary, marginal=marginal.astype(np.float32))
        if self.combine == "backoff":
            self.set_tables(weights=counts.astype(np.float32))
            return self
        after = np.zeros((actions + 1, actions))
        np.add.at(after, (steps.last.cpu().numpy(), action), 1)
        weights = power * self._log_odds(counts, marginal)
        weights[-1] = 0
        bias = np.log(marginal)
        self.set_tables(
            weights=weights.astype(np.float32),
            after=(bias + power * self._log_odds(after, marginal)).astype(np.float32),
        )
        return self

    def _log_odds(self, counts: Any, marginal: Any) -> Any:
        shares = (counts + self.smoothing * marginal) / (counts.sum(1, keepdims=True) + self.smoothing)
        return np.log(shares / marginal)

    def _scores(self, rows: Tensor) -> Tensor:
        if self.combine == "product":
            return super()._scores(rows)
        counts = self.weights[rows]
        total, order = counts.sum(-1).sort(dim=1, descending=True, stable=True)
        estimate = self.marginal.expand(len(rows), -1)
        for k in range(rows.shape[1]):
            own = counts[torch.arange(len(rows), device=rows.device), order[:, k]]
            estimate = (own + self.smoothing * estimate) / (total[:, k, None] + self.smoothing)
        return estimate.log()
