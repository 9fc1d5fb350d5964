"""The mixture of priors: experts weighted by how well they have predicted the plan so far."""

from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor, nn

from neuroprior._random import generator_on
from neuroprior.plans import Plans
from neuroprior.plans.folds import divisible
from neuroprior.priors.ensembles.packing import pack, unpack
from neuroprior.priors.ensembles.stacked import context_for
from neuroprior.priors.prior import Prior

SHARES = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Candidates for the share; `fit` takes the best."""

VALIDATION = 0.1
"""Share of the plans on which the weights are learned, where the settings have none."""

STEPS = 50
"""Steps of expectation maximisation, which learns the weights."""


class MixturePrior(Prior):
    """A mixture of experts, each a prior, whose weights depend on the history.

    Expert e has the initial weight w_e; after each action the weights follow Bayes' rule: they are multiplied by the
    probability that the expert gave to that action. So a plan has its probability in the mixture, the sum of
    w_e P_e(plan). With a `share` s above 0, before each action after the first a share s of all weight is redistributed
    as the initial weights (fixed share: Herbster and Warmuth 1998, "Tracking the best expert"), so that another expert
    may be best later on. With s = 1 the weights are the same before every action.

    Experts without context ignore it.

    Args:
        num_actions: A.
        experts: E priors; or, as in a saved `config`, objects with `prior`, the name of a class, and its `config`.
        share: s, between 0 and 1; set by `fit`.

    Raises:
        ValueError: no experts, or experts that differ in their actions or contexts.
    """

    first: Tensor
    """`[E]`: the logarithms of the initial weights."""

    def __init__(self, num_actions: int, experts: Sequence[Prior | Mapping[str, Any]], share: float = 0.0) -> None:
        if not experts:
            raise ValueError("experts: at least one is expected")
        if not 0 <= share <= 1:
            raise ValueError(f"share: a number between 0 and 1 is expected, not {share!r}")
        made = [e if isinstance(e, Prior) else Prior.known[e["prior"]](**e["config"]) for e in experts]
        for number, expert in enumerate(made):
            if expert.num_actions != num_actions:
                raise ValueError(f"experts[{number}]: has {expert.num_actions} actions, the mixture {num_actions}")
        contexts = {(e.num_contexts, e.context_size) for e in made if e.takes_context} or {(None, None)}
        if len(contexts) > 1:
            raise ValueError(f"experts: those with a context must have the same, not {sorted(map(str, contexts))}")
        super().__init__(num_actions, *contexts.pop())
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
        found = [e.start(batch_size, context_for(e, context)) for e in self._experts()]
        weights = self.first.expand(batch_size, -1)
        return self._mixed(weights, found)

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if len(state) == 0:
            return torch.zeros(0, self.num_actions, device=self.device), state
        weights, forecasts, *states = unpack(state, 2 + len(self.experts))
        taken = forecasts.gather(2, action.long()[:, None, None].expand(-1, forecasts.shape[1], 1))[..., 0]
        found = [e.step(action, s, context_for(e, context)) for e, s in zip(self._experts(), states, strict=True)]
        return self._mixed(self._after(weights, taken), found)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        if plans.shape[1] == 0:
            return torch.zeros(*plans.shape, self.num_actions, device=self.device)
        forecasts = self._forecasts(plans, context)
        weights = self._weights(_taken(forecasts, plans))
        return (weights[..., None] + forecasts).logsumexp(2)

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(["validation", *(name for e in self._experts() for name in e.fit_settings)]))

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Fit the experts, then learn the initial weights and the share on plans held out from them; returns self.

        Experts that count learn from all plans in the end.

        Args:
            plans: `Plans`, or integers `[N, L]` for plans without context.
            generator: draws the held-out plans, and is passed on to the experts.
            settings: `validation`, the share of the plans on which the weights are learned; it and all others, see
                `neuroprior.training.Settings`, are passed on to the experts that have them.

        Raises:
            ValueError: plans that the experts cannot learn from, too few of them, or a setting that no expert has.
        """
        self.check_settings(settings)
        plans = self.training_plans(plans)
        generator = generator_on(generator, "cpu")
        plans = divisible(plans)
        learned, held_out = plans.split(settings.get("validation", VALIDATION), generator)
        for expert in self._experts():
            known = {name: value for name, value in settings.items() if name in expert.fit_settings}
            expert.fit(learned, generator=generator, **known)
        self.learn_weights(held_out)
        self._count(plans)
        return self

    def _count(self, plans: Plans) -> None:
        """Fit the experts that count anew, those of mixtures among the experts as well."""
        for expert in self._experts():
            if isinstance(expert, MixturePrior):
                expert._count(plans)
            elif not expert.fit_settings:
                expert.fit(plans)

    @torch.no_grad()
    def learn_weights(self, plans: Plans) -> None:
        """Learn the initial weights, and which of `SHARES` is best, from plans that the experts did not learn from."""
        mask = plans.mask()
        taken = _taken(self._forecasts(plans.actions, plans.context), plans.actions)
        best = (float("-inf"), self.first, self.share)
        for share in SHARES:
            self.share, self.first = share, torch.full_like(self.first, 1 / len(self.first)).log()
            for _ in range(STEPS):
                joint = self._weights(taken) + taken
                total = joint.logsumexp(-1)[mask].sum()
                if float(total) > best[0]:
                    best = (float(total), self.first, share)
                # The posterior of the expert: of each action, or without a share of the whole plan.
                after = (joint.softmax(-1) if share else self._last(taken, mask).unsqueeze(1))[mask if share else ...]
                self.first = after.reshape(-1, len(self.first)).mean(0).clamp(min=1e-6).log().log_softmax(-1)
        _, self.first, self.share = best

    def _last(self, taken: Tensor, mask: Tensor) -> Tensor:
        """`[N, E]`: the weights at the end of each plan, without a share."""
        return (self.first + taken.masked_fill(~mask[..., None], 0).sum(1)).softmax(-1)

    def _experts(self) -> list[Prior]:
        return [e for e in self.experts if isinstance(e, Prior)]

    def _forecasts(self, plans: Tensor, context: Tensor | None) -> Tensor:
        """`[N, L, E, A]`: the log-probabilities of each expert."""
        return torch.stack([e(plans, context_for(e, context)).log_softmax(-1) for e in self._experts()], 2)

    def _weights(self, taken: Tensor) -> Tensor:
        """The logarithms of the weights before each action, from those of its probabilities: both `[N, L, E]`."""
        weights = [self.first.expand(len(taken), -1)]
        for t in range(taken.shape[1] - 1):
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


def _taken(forecasts: Tensor, plans: Tensor) -> Tensor:
    """`[N, L, E]`: of log-probabilities `[N, L, E, A]`, those of the actions of `plans [N, L]`."""
    index = plans.long()[:, :, None, None].expand(-1, -1, forecasts.shape[2], 1)
    return forecasts.gather(3, index)[..., 0]
