"""The mixture of priors: experts weighted by how well they have predicted the plan so far."""

from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor, nn

from neuroprior._checks import check_alike_named, check_share
from neuroprior._random import generator_on
from neuroprior.plans import Plans
from neuroprior.priors.construction import as_prior, described
from neuroprior.priors.ensembles.stacked import context_for
from neuroprior.priors.learning import (
    counted_plans,
    known_plans,
    plans_for,
    pop_validation,
    split_validation,
    training_plans,
)
from neuroprior.priors.prior import Prior, taken_of
from neuroprior.sampling.states import State
from neuroprior.sampling.stepping import check_outputs

SHARES = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Candidates for the share; `fit` takes the best."""

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
        num_contexts, context_size: see `Prior`; None: as the experts with a context take it.

    Raises:
        ValueError: no experts, or experts that differ in their actions or contexts.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2, 0, 1, 2]]).repeat(40, 1), 3)
        >>> prior = MixturePrior(3, [UniformPrior(3), MarkovPrior(3, 1)]).fit(
        ...     plans, generator=torch.Generator().manual_seed(0)
        ... )
        >>> prior.log_prob(plans[:1]).item() > UniformPrior(3).log_prob(plans[:1]).item()
        True
    """

    first: Tensor
    """`[E]`: the logarithms of the initial weights."""

    log_tables: tuple[str, ...] = ("first",)

    def __init__(
        self,
        num_actions: int,
        experts: Sequence[Prior | Mapping[str, Any]],
        share: float = 0.0,
        num_contexts: int | None = None,
        context_size: int | None = None,
    ) -> None:
        if not experts:
            raise ValueError("`experts` must have at least one prior")
        check_share("share", share)
        priors = [as_prior(e) for e in experts]
        for number, expert in enumerate(priors):
            if expert in priors[:number]:
                raise ValueError(f"experts[{number}]: the same prior is given twice; give another, or a copy")
            if expert.num_actions != num_actions:
                raise ValueError(f"experts[{number}]: has {expert.num_actions} actions, the mixture {num_actions}")
        for what in ("action_names", "context_names"):
            names = {f"experts[{number}]": getattr(e, what) for number, e in enumerate(priors)}
            check_alike_named(names, "fit them to plans that are numbered alike", what)
        sizes = {(num_contexts, context_size)} - {(None, None)}
        contexts = sizes | {(e.num_contexts, e.context_size) for e in priors if e.takes_context} or {(None, None)}
        if len(contexts) > 1:
            raise ValueError(f"experts: those with a context must have the same, not {sorted(map(str, contexts))}")
        super().__init__(num_actions, *contexts.pop())
        self._take_over([e for e in priors if e.has_learned])
        self.experts = nn.ModuleList(priors)
        self.share = float(share)
        self.register_buffer("first", torch.full((len(priors),), 1 / len(priors)).log())

    def _take_over(self, learned: Sequence[Prior]) -> None:
        """Know what experts know that have learned: the names, the end, and the kind of context."""
        takers = [e for e in learned if e.takes_context]
        for e in reversed(takers):
            self.context_per, self.context_names = e.context_per, e.context_names or self.context_names
        for e in reversed(learned):
            self.action_names, self.end = e.action_names or self.action_names, e.end
        # What counts without a context says nothing of that of the plans.
        self.has_learned = bool(takers if self.takes_context else learned)

    @property
    def num_weights(self) -> int:
        return sum(e.num_weights for e in self._experts())

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"experts": [described(e) for e in self._experts()]}

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"share": self.share, "experts": [e.learned for e in self._experts()]}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        if not isinstance(learned["share"], float) or not 0 <= learned["share"] <= 1:
            raise ValueError(f"`share` must be a number between 0 and 1, got {learned['share']!r}")
        self.share = learned["share"]
        for expert, expert_learned in zip(self._experts(), learned["experts"], strict=True):
            expert.restore(expert_learned)

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_start(batch_size, context)
        outputs = start_experts(self._experts(), batch_size, context)
        weights = self.first.expand(batch_size, -1)
        return self._mix(weights, outputs)

    def step(self, action: Tensor, state: Any, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_step(action, context)
        weights, forecasts, *states = state
        outputs = step_experts(self._experts(), action, states, context)
        return self._mix(after(weights, taken_of(forecasts, action), self.first, self.share), outputs)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        if plans.shape[1] == 0:
            return torch.zeros(*plans.shape, self.num_actions, device=self.device)
        forecasts = self._forecasts(plans, context)
        weights = weights_before(taken_of(forecasts, plans), self.first, self.share)
        return mixed(weights, forecasts)

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(["validation", *(name for e in self._experts() for name in e.fit_settings)]))

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Fit the experts, then learn the initial weights and the share on plans held out from them; returns self.

        Experts that count learn from all plans in the end.

        Args:
            plans: `Plans`, or integers `[N, L]` for plans without context.
            generator: draws the held-out plans, and is passed on to the experts.
            settings: `validation`, the `Plans` that are held out, or their share of the plans; it and all others, see
                `neuroprior.training.Settings`, are passed on to the experts that have them.

        Raises:
            ValueError: plans that the experts cannot learn from, too few of them, or a setting that no expert has.
        """
        self.check_settings(settings)
        plans = training_plans(self, plans)
        generator = generator_on(generator, "cpu")
        learned, held_out = split_validation(plans, pop_validation(self, settings), generator)
        self.fit_experts(learned, held_out, generator, settings)
        self.learn_weights(held_out)
        return self.recount(plans)

    def fit_experts(
        self, learned: Plans, held_out: Plans, generator: torch.Generator, settings: Mapping[str, Any]
    ) -> None:
        """Fit each expert to `learned`; networks are stopped early by `held_out`."""
        for expert in self._experts():
            expert_settings = {"validation": held_out, **settings}
            expert_settings = {name: value for name, value in expert_settings.items() if name in expert.fit_settings}
            expert.fit(plans_for(expert, learned), generator=generator, **expert_settings)

    def recount(self, plans: Plans) -> Self:
        plans = counted_plans(self, plans)
        for expert in self._experts():
            expert.recount(plans_for(expert, plans))
        return self

    @torch.no_grad()
    def learn_weights(self, plans: Plans) -> None:
        """Learn the initial weights, and which of `SHARES` is best, from plans that the experts did not learn from.

        Raises:
            ValueError: plans of other actions or contexts than this prior's, or without any action.
        """
        plans = known_plans(self, plans)
        taken = taken_of(self._forecasts(plans.actions, plans.context), plans.actions)
        self.first, self.share = learned_weights(taken, plans.mask())

    @property
    def alternatives(self) -> tuple[Prior, ...]:
        """The priors that may propose better plans alone than mixed, see `neuroprior.planners.proposers`."""
        return tuple(self._experts())

    def _experts(self) -> list[Prior]:
        return priors_in(self.experts)

    def _forecasts(self, plans: Tensor, context: Tensor | None) -> Tensor:
        """`[N, L, E, A]`: the log-probabilities of each expert."""
        return torch.stack([e(plans, context_for(e, context)).log_softmax(-1) for e in self._experts()], 2)

    def _mix(self, weights: Tensor, outputs: list[tuple[Tensor, State]]) -> tuple[Tensor, State]:
        forecasts = torch.stack([logits.log_softmax(-1) for logits, _ in outputs], 1)
        return mixed(weights, forecasts), (weights, forecasts, *(state for _, state in outputs))


def start_experts(experts: Sequence[Prior], batch_size: int, context: Tensor | None) -> list[tuple[Tensor, State]]:
    """Logits `[N, A]` and the state of each expert, before the first action."""
    return [
        check_outputs(e.start(batch_size, context_for(e, context)), batch_size, e.num_actions, "start") for e in experts
    ]


def step_experts(
    experts: Sequence[Prior], action: Tensor, states: Sequence[State], context: Tensor | None
) -> list[tuple[Tensor, State]]:
    """Logits `[N, A]` and the next state of each expert, after `action [N]` in its state."""
    return [
        check_outputs(e.step(action, state, context_for(e, context)), len(action), e.num_actions, "step")
        for e, state in zip(experts, states, strict=True)
    ]


def priors_in(modules: nn.ModuleList) -> list[Prior]:
    """The modules of a list, all of which are priors."""
    return [one for one in modules if isinstance(one, Prior)]


def after(weights: Tensor, taken: Tensor, first: Tensor, share: float) -> Tensor:
    """The logarithms of the weights after an action whose log-probabilities were `taken`; all `[..., E]`.

    Args:
        weights: before the action, normalised.
        taken: of the action, by each expert.
        first: `[E]`, the initial weights.
        share: of all weight that is redistributed as these.
    """
    new = (weights + taken).log_softmax(-1)
    return new if share == 0 else (new.exp() * (1 - share) + first.exp() * share).log()


def weights_before(taken: Tensor, first: Tensor, share: float) -> Tensor:
    """The logarithms of the weights before each action, from those of its probabilities: both `[N, L, E]`."""
    if share == 0:
        before = nn.functional.pad(taken, (0, 0, 1, 0))[:, :-1].cumsum(1)
        return (first + before).log_softmax(-1)
    weights = [first.expand(len(taken), -1)]
    for t in range(taken.shape[1] - 1):
        weights.append(after(weights[-1], taken[:, t], first, share))
    return torch.stack(weights, 1)


def learned_weights(taken: Tensor, mask: Tensor, steps: int = STEPS) -> tuple[Tensor, float]:
    """The initial weights and the share, one of `SHARES`, under which plans are likeliest: by expectation maximisation.

    Args:
        taken: `[N, L, E]`, the log-probability of each action under each expert.
        mask: `[N, L]` bool: the actions that count.
        steps: of expectation maximisation, for each share.

    Returns:
        The logarithms of the weights `[E]`, and the share.
    """
    even = torch.full_like(taken[0, 0], 1 / taken.shape[-1]).log()
    best = (float("-inf"), even, 0.0)
    for share in SHARES:
        first = even
        for _ in range(steps):
            joint = weights_before(taken, first, share) + taken
            total = float(joint.logsumexp(-1)[mask].sum())
            if total > best[0]:
                best = (total, first, share)
            # The posterior of the expert: of each action, or without a share of the whole plan.
            whole = first + taken.masked_fill(~mask[..., None], 0).sum(1)
            posterior = joint.softmax(-1)[mask] if share else whole.softmax(-1)
            first = posterior.mean(0).clamp(min=1e-6).log().log_softmax(-1)
    return best[1], best[2]


def mixed(weights: Tensor, forecasts: Tensor) -> Tensor:
    """The log-probabilities `[..., A]` of a mixture of `forecasts [..., K, A]` with the weights' logarithms."""
    return (weights[..., None] + forecasts).logsumexp(-2)
