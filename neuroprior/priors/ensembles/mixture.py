"""The mixture of priors: experts that are weighed by how well they have told the plan so far."""

from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor, nn

from neuroprior._random import generator_on
from neuroprior.plans import Plans
from neuroprior.plans.folds import divisible
from neuroprior.priors.ensembles.packing import pack, unpack
from neuroprior.priors.ensembles.stacked import StackedPrior, seen_by
from neuroprior.priors.neural.neural import NeuralPrior
from neuroprior.priors.prior import Prior

SHARES = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Of which `fit` takes the best."""

VALIDATION = 0.1
"""Share of the plans on which the weights are learned, unless the settings have another."""

STEPS = 50
"""Of expectation maximisation, in which weights are learned."""


class MixturePrior(Prior):
    """A mixture of experts, each a prior, whose weights depend on the history.

    Expert e has the weight w_e before the first action; after each action the weights follow Bayes' rule: they are
    multiplied by the probability that the expert had given to that action. So a plan has the probability that it has in
    the mixture, the sum of w_e P_e(plan). With a `share` s above 0, before each action after the first a share s of all
    weight goes back to the first weights (fixed share: Herbster and Warmuth 1998, "Tracking the best expert"): another
    expert may be best later on. With s = 1 the weights are the same before every action.

    Experts that do not see the context leave it aside.

    Args:
        num_actions: A.
        experts: E of them; or, as in a saved `config`, objects with `prior`, the name of a class, and its `config`.
        share: s, between 0 and 1; set by `fit`.

    Raises:
        ValueError: no experts, or such as do not fit together.
    """

    first: Tensor
    """`[E]`: the logarithms of the first weights."""

    def __init__(self, num_actions: int, experts: Sequence[Prior | Mapping[str, Any]], share: float = 0.0) -> None:
        if not experts:
            raise ValueError("experts: at least one is expected")
        if not 0 <= share <= 1:
            raise ValueError(f"share: a number between 0 and 1 is expected, not {share!r}")
        made = [e if isinstance(e, Prior) else Prior.known[e["prior"]](**e["config"]) for e in experts]
        for number, expert in enumerate(made):
            if expert.num_actions != num_actions:
                raise ValueError(f"experts[{number}]: has {expert.num_actions} actions, the mixture {num_actions}")
        sees = {(e.num_contexts, e.context_size) for e in made if e.takes_context} or {(None, None)}
        if len(sees) > 1:
            raise ValueError(f"experts: those that see a context must see the same, not {sorted(map(str, sees))}")
        super().__init__(num_actions, *sees.pop())
        self.experts = nn.ModuleList(made)
        self.share = float(share)
        self.register_buffer("first", torch.full((len(made),), 1 / len(made)).log())

    @property
    def config(self) -> dict[str, Any]:
        experts = [{"prior": type(e).__name__, "config": e.config} for e in self._experts()]
        return {"num_actions": self.num_actions, "experts": experts}

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"share": self.share, "experts": [e.learned for e in self._experts()]}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        if not isinstance(learned["share"], float) or not 0 <= learned["share"] <= 1:
            raise ValueError(f"share: a number between 0 and 1 is expected, not {learned['share']!r}")
        self.share = learned["share"]
        for expert, own in zip(self._experts(), learned["experts"], strict=True):
            expert.restore(own)

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        found = [e.start(batch_size, seen_by(e, context)) for e in self._experts()]
        weights = self.first.expand(batch_size, -1)
        return self._mixed(weights, found)

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if len(state) == 0:
            return torch.zeros(0, self.num_actions, device=self.device), state
        weights, forecasts, *states = unpack(state, 2 + len(self.experts))
        taken = forecasts.gather(2, action.long()[:, None, None].expand(-1, forecasts.shape[1], 1))[..., 0]
        found = [e.step(action, s, seen_by(e, context)) for e, s in zip(self._experts(), states, strict=True)]
        return self._mixed(self._after(weights, taken), found)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        if plans.shape[1] == 0:
            return torch.zeros(*plans.shape, self.num_actions, device=self.device)
        forecasts = torch.stack([e(plans, seen_by(e, context)).log_softmax(-1) for e in self._experts()], 2)
        weights = self._weights(forecasts, plans)
        return (weights[..., None] + forecasts).logsumexp(2)

    def fit(self, plans: Plans | Tensor, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Fit the experts, then learn the first weights and the share on plans that they have not seen; returns self.

        Count-based experts learn from all plans in the end.

        Args:
            plans: what to learn from.
            generator: draws the held-out plans, and is passed on to neural experts.
            settings: passed on to neural experts, see `neuroprior.training.Settings`; `validation` is also the share of
                the plans on which the weights are learned.

        Raises:
            ValueError: plans that the experts cannot learn from, or too few of them.
        """
        plans = self.training_plans(plans)
        generator = generator_on(generator, "cpu")
        plans = divisible(plans)
        learned, held_out = plans.split(settings.get("validation", VALIDATION), generator)
        for expert in self._experts():
            _fit(expert, learned, generator, settings)
        self.learn_weights(held_out)
        self._count(plans)
        return self

    def _count(self, plans: Plans) -> None:
        """Fit the count-based experts anew, those of mixtures among the experts as well."""
        for expert in self._experts():
            if isinstance(expert, MixturePrior):
                expert._count(plans)
            elif not isinstance(expert, NeuralPrior | StackedPrior):
                expert.fit(plans)

    @torch.no_grad()
    def learn_weights(self, plans: Plans) -> None:
        """Learn the first weights, and which of `SHARES` is best, from plans that the experts have not learned from."""
        mask = plans.mask()
        forecasts = torch.stack(
            [e(plans.actions, seen_by(e, plans.context)).log_softmax(-1) for e in self._experts()], 2
        )
        index = plans.actions.long()[:, :, None, None].expand(-1, -1, forecasts.shape[2], 1)
        taken = forecasts.gather(3, index)[..., 0]
        best = (float("-inf"), self.first, self.share)
        for share in SHARES:
            self.share, self.first = share, torch.full_like(self.first, 1 / len(self.first)).log()
            for _ in range(STEPS):
                told = self._weights(forecasts, plans.actions) + taken
                total = told.logsumexp(-1)[mask].sum()
                if float(total) > best[0]:
                    best = (float(total), self.first, share)
                # The weight that each expert had after the fact; with no share only the first action tells of it.
                after = (told.softmax(-1) if share else self._last(taken, mask).unsqueeze(1))[mask if share else ...]
                self.first = after.reshape(-1, len(self.first)).mean(0).clamp(min=1e-6).log().log_softmax(-1)
        _, self.first, self.share = best

    def _last(self, taken: Tensor, mask: Tensor) -> Tensor:
        """`[N, E]`: the weights at the end of each plan, under no share."""
        return (self.first + taken.masked_fill(~mask[..., None], 0).sum(1)).softmax(-1)

    def _experts(self) -> list[Prior]:
        return [e for e in self.experts if isinstance(e, Prior)]

    def _weights(self, forecasts: Tensor, plans: Tensor) -> Tensor:
        """`[N, L, E]`: the logarithms of the weights before each action, of forecasts `[N, L, E, A]`."""
        index = plans.long()[:, :, None, None].expand(-1, -1, forecasts.shape[2], 1)
        taken = forecasts.gather(3, index)[..., 0]
        weights = [self.first.expand(len(plans), -1)]
        for t in range(plans.shape[1] - 1):
            weights.append(self._after(weights[-1], taken[:, t]))
        return torch.stack(weights, 1)

    def _after(self, weights: Tensor, taken: Tensor) -> Tensor:
        """The weights `[N, E]` after an action whose log-probabilities were `taken [N, E]`."""
        after = (weights + taken).log_softmax(-1)
        if self.share == 0:
            return after
        return (after.exp() * (1 - self.share) + self.first.exp() * self.share).log()

    def _mixed(self, weights: Tensor, found: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
        forecasts = torch.stack([logits.log_softmax(-1) for logits, _ in found], 1)
        logits = (weights[..., None] + forecasts).logsumexp(1)
        return logits, pack([weights, forecasts, *(state for _, state in found)])


def _fit(expert: Prior, plans: Plans, generator: torch.Generator, settings: dict[str, Any]) -> None:
    if isinstance(expert, NeuralPrior | StackedPrior | MixturePrior):
        expert.fit(plans, generator, **settings)
    else:
        expert.fit(plans)
