"""Smoothed counts of patterns: their product (naive Bayes), or back-off from the rarest known pattern."""

from typing import Any, Literal, get_args

import torch
from torch import Tensor
from torch.nn import functional

from neuroprior.priors.patterns.pattern_prior import PatternPrior
from neuroprior.priors.patterns.steps import Steps, numbered, vocabulary

Combine = Literal["product", "backoff"]

POWERS = tuple(2 ** (exponent / 4) for exponent in range(-32, 5))
"""What the power is chosen among."""

CHUNK = 2**14
"""Steps that are counted or predicted together."""


class PatternCounts(PatternPrior):
    """Probabilities of actions from how often each was taken where a pattern was active.

    With p(a) the smoothed share of action a, p(a | v) = (n(v, a) + k p(a)) / (n(v) + k) for each pattern or history v,
    where k = `smoothing`:

    - "product": p(a) times the product of p(a | v) / p(a) over the active patterns and the history of the last actions
      (naive Bayes), to the power `power`. The tables are those of `PatternPrior`, so what reads a `LogLinearPrior`'s
      reads these.
    - "backoff": from p(a), and then the history, on, each active pattern v from the one seen most often to the rarest
      moves the distribution to its own frequencies with weight n(v) / (n(v) + k). `weights` holds these frequencies,
      `seen`, float32 `[V + 1]`, n(v), and `action_weights` log p(a | history): no sum of rows gives the logits.

    Args:
        num_actions: A.
        num_patterns: F, the number of patterns that are active in each state.
        combine: "product" or "backoff".
        order: >= 0, the last actions that count.
        smoothing: k > 0, pseudo-counts.
        power: of the probabilities, above 0; None: the best on plans that are held out, 1 where none are.

    Raises:
        ValueError: an argument is out of range.
    """

    seen: Tensor
    tempering: Tensor

    tables = ("patterns", "weights", "seen")

    def __init__(
        self,
        num_actions: int,
        num_patterns: int,
        *,
        combine: Combine = "product",
        order: int = 1,
        smoothing: float = 1.0,
        power: float | None = None,
    ) -> None:
        super().__init__(num_actions, num_patterns, order=order)
        if combine not in get_args(Combine):
            raise ValueError(f'combine: "product" or "backoff" is expected, not {combine!r}')
        for name, value in (("smoothing", smoothing), ("power", power)):
            if value is not None and not 0 < value < float("inf"):
                raise ValueError(f"{name}: a number above 0 is expected, not {value!r}")
        self.combine, self.smoothing, self.power = combine, smoothing, power
        self.register_buffer("seen", torch.zeros(1))
        self.register_buffer("tempering", torch.ones(()))

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"combine": self.combine, "smoothing": self.smoothing, "power": self.power}

    def step_logits(self, patterns: Tensor, last: Tensor) -> Tensor:
        if self.combine == "product":
            return super().step_logits(patterns, last)
        number = numbered(patterns, self.patterns).long()
        seen, order = self.seen[number].sort(stable=True, dim=1, descending=True)
        number = number.gather(1, order)
        share = seen / (seen + self.smoothing)
        probability = self.action_weights[last].softmax(-1)
        for rank in range(patterns.shape[1]):
            own = self.weights[number[:, rank]]
            probability = torch.lerp(probability, own, share[:, rank, None])
        return self.tempering * probability.log()

    def learn(self, steps: Steps, held_out: Steps | None, generator: torch.Generator | None) -> None:
        """Count anew. What is held out decides the power, and is then counted, too."""
        if held_out is None:
            self._count(steps, self.power or 1.0)
            return
        power = self.power
        if power is None:
            self._count(steps, 1.0)
            power = self._best_power(held_out)
        weight = torch.cat([steps.weights(), held_out.weights()])
        patterns, last, action, plan = (torch.cat(pair) for pair in zip(steps[:4], held_out[:4], strict=True))
        self._count(Steps(patterns, last, action, plan, weight), power)

    def _count(self, steps: Steps, power: float) -> None:
        known = vocabulary(steps.patterns, 1)
        weight, actions, k = steps.weights().double(), self.num_actions, self.smoothing
        counts = torch.zeros((len(known) + 1) * actions, dtype=torch.double)
        for at in range(0, len(weight), CHUNK):
            here = slice(at, at + CHUNK)
            cell = numbered(steps.patterns[here], known).long() * actions + steps.action[here, None]
            counts.index_add_(0, cell.flatten(), weight[here, None].expand_as(cell).flatten())
        counts = counts.view(-1, actions)
        cell = steps.last * actions + steps.action
        after = torch.bincount(cell, weight, len(self._following) * actions).view(-1, actions)
        total = torch.bincount(steps.action, weight, actions)
        marginal = (total + k / actions) / (total.sum() + k)
        seen = counts.sum(1, keepdim=True)
        history = (after + k * marginal) / (after.sum(1, keepdim=True) + k)
        if self.combine == "product":
            weights = ((counts + k * marginal) / (seen + k)).log() - marginal.log()
            weights[-1] = 0
            tables = (power * weights, power * (history.log() - marginal.log()), power * marginal.log())
        else:
            tables = (counts / seen.clamp(min=1e-30), history.log(), marginal.log())
        self._replace("patterns", known)
        self._replace("seen", seen[:, 0].float())
        for name, table in zip(("weights", "action_weights", "bias"), tables, strict=True):
            self._replace(name, table.float())
        self._replace("tempering", torch.tensor(power))

    def _best_power(self, steps: Steps) -> float:
        """The power of the present probabilities that gives these steps the least log-loss."""
        parts = range(0, len(steps.action), CHUNK)
        logits = torch.cat([self.step_logits(*(v[at : at + CHUNK] for v in steps[:2])) for at in parts])
        weight = steps.weights()

        def loss(power: float) -> float:
            return float(weight @ functional.cross_entropy(power * logits, steps.action, reduction="none"))

        return min(POWERS, key=loss)
