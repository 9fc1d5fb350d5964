"""The combined prior: experts of every kind, weighted so that it is hardly ever behind the best of them."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, Self

import torch
from torch import Tensor, nn

from neuroprior._checks import check_choices
from neuroprior._random import generator_on
from neuroprior.plans import Plans
from neuroprior.priors.construction import as_prior, described
from neuroprior.priors.counts import TooLargeError
from neuroprior.priors.ensembles.candidates import (
    OF_EFFORT,
    Effort,
    check_effort,
    counting_parts,
    fitted_experts,
    number_tried,
)
from neuroprior.priors.ensembles.mixture import (
    MixturePrior,
    after,
    learned_weights,
    mixed,
    priors_in,
    start_experts,
    step_experts,
    weights_before,
)
from neuroprior.priors.ensembles.pooling import (
    MIN_GAIN_NATS,
    NETWORK_GAIN_NATS,
    HeldOut,
    stack_forecasts,
    with_pool,
)
from neuroprior.priors.learning import (
    counted_plans,
    known_plans,
    plans_for,
    pop_validation,
    split_validation,
    training_plans,
)
from neuroprior.priors.neural.neural import training_settings
from neuroprior.priors.prior import Prior, taken_of
from neuroprior.priors.uniform import UniformPrior
from neuroprior.sampling.states import State

LARGEST_SPARE = 2**22
"""The most numbers in the tables of an expert that was left out and is kept aside."""

MOST_NUMBERS = 2**25
"""The most numbers of forecasts of plans that are not held out."""

TRACKING_STEPS = 5
"""Steps of expectation maximisation of the fixed share, for each share tried."""

MOST_STEPS = 500
"""Actions of each plan from which the fixed share is learned."""


class CombinedPrior(MixturePrior):
    """Experts of every kind as one prior, which is hardly ever behind the best of them.

    The experts are priors that count (uniform, Markov chains and context trees, with and without the context; where
    plans are long, also such that follow the individual, see `AdaptivePrior`) and networks. Of their forecasts p_e,
    three kinds of forecast are mixed:

    - each expert's own;
    - the pool, proportional to the product of all p_e ** power_e (the logarithmic opinion pool: Genest and Zidek 1986;
      products of experts: Hinton 2002), whose powers are learned on held-out plans;
    - where it predicts held-out plans better, a mixture of these with fixed share (Herbster and Warmuth 1998), in
      which another expert may be best later on.

    Their weights follow Bayes' rule, from initial weights that are learned on held-out plans. None of these is below
    1 / K, where K forecasts were tried: on every sequence whatever, the negative log-likelihood is at most log K above
    that of the best of those that are kept (Cesa-Bianchi and Lugosi 2006, section 9.2). An expert is left out where
    held-out plans are predicted as well without it. Where no experts are given, a network is kept only where the
    held-out plans are clearly likelier with it; and if fewer than a thousand actions are held out, chains and trees are
    chosen and combined on all plans, most of them forecast part by part from the others. In other worlds than those of
    the plans an expert that was left out may be the better one: so chains and context trees whose tables are small are
    kept aside, in `spare`, for planners that try (`neuroprior.planners.best_sampling`). All given experts are saved,
    since the next `fit` begins with them; those that are neither kept nor spare are in `left_out`.

    Args:
        num_actions: A.
        experts: priors that `fit` then fits and combines; None: those that suit the plans.
        share: of the fixed share; set by `fit`.
        effort: which networks there are where no experts are given: "fast", a GRU; "standard", a stacked prior as well;
            "full", a transformer as well, and all are trained.
        networks: where no experts are given, the names of those that `fit` trains; None: those that promise to bring
            something after a tenth of their training (`neuroprior.priors.ensembles.screening.screen`). `fit` keeps
            their names in `trained`.
        num_contexts, context_size: see `Prior`.

    Raises:
        ValueError: an argument is out of range, or experts that differ in their actions or contexts.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2, 0, 1, 2]]).repeat(40, 1), 3)
        >>> prior = CombinedPrior(3, experts=[UniformPrior(3), MarkovPrior(3, 1)])
        >>> prior = prior.fit(plans, generator=torch.Generator().manual_seed(0))
        >>> prior.log_prob(plans[:1]).item() > UniformPrior(3).log_prob(plans[:1]).item()
        True
    """

    powers: Tensor
    """`[E]`: those of the experts in the pool."""

    tracking: Tensor
    """`[E + 1]`: the logarithms of the initial weights of experts and pool in the fixed share; empty without it."""

    log_tables = ("first", "tracking")

    actions_at_once = 2**16

    def __init__(
        self,
        num_actions: int,
        experts: Sequence[Prior | Mapping[str, Any]] | None = None,
        share: float = 0.0,
        effort: Effort = "standard",
        num_contexts: int | None = None,
        context_size: int | None = None,
        networks: Sequence[str] | None = None,
    ) -> None:
        check_effort(effort)
        if networks is not None:
            check_choices("networks", networks, OF_EFFORT[effort], 0)
        first_experts = [UniformPrior(num_actions)] if experts is None else experts
        super().__init__(num_actions, first_experts, share, num_contexts, context_size)
        self.effort: Effort = effort
        self.networks: tuple[str, ...] | None = None if networks is None else tuple(networks)
        self.trained: tuple[str, ...] = ()
        # `fit` begins with these each time; in a list, since each is also a submodule: kept, spare or left out.
        self.given = None if experts is None else [self._experts()]
        self.spare = nn.ModuleList()
        self.left_out = nn.ModuleList()
        self.tried = 0
        self._allocate()

    def _allocate(self) -> None:
        """Allocate the tables for the present experts, with even weights."""
        size, anchor = len(self.experts), self._anchor
        assert isinstance(anchor, Tensor)
        self.register_buffer("powers", anchor.new_full((size,), 1 / size))
        self.register_buffer("tracking", anchor.new_zeros(size + 1 if self.share else 0).log_softmax(-1))
        self.register_buffer("first", anchor.new_zeros(size + 1 + (self.share > 0)).log_softmax(-1))

    @property
    def config(self) -> dict[str, Any]:
        chosen = {} if self.networks is None else {"networks": list(self.networks)}
        return super().config | {"effort": self.effort} | chosen

    @property
    def learned(self) -> dict[str, Any]:
        every = [*self.alternatives, *self.left_out]
        numbers = None if self.given is None else [every.index(e) for e in self.given[0]]
        fields = {"tried": self.tried, "given": numbers, "kept": self.config["experts"], "trained": list(self.trained)}
        for name, modules in (("spare", self.spare), ("left_out", self.left_out)):
            fields[name] = [described(e) | {"learned": e.learned} for e in priors_in(modules)]
        return super().learned | fields

    def restore(self, learned: dict[str, Any]) -> None:
        # Experts that were given stay the objects that they are: a planner may sample from one of them.
        numbers, mine = learned.get("given"), [] if self.given is None else self.given[0]
        by_number = (
            dict(zip(numbers, mine, strict=True)) if isinstance(numbers, list) and len(numbers) == len(mine) else {}
        )
        place = len(learned.get("kept", self.experts))
        if "kept" in learned:
            kept = [_restore_expert(by_number.get(number), e) for number, e in enumerate(learned["kept"])]
            self.experts = nn.ModuleList(kept).to(self.device)
        super().restore(learned)
        if not isinstance(learned["tried"], int) or learned["tried"] < 0:
            raise ValueError(f"`tried` must be an integer of at least 0, got {learned['tried']!r}")
        self.tried, self.trained = learned["tried"], tuple(learned.get("trained", ()))
        for name in ("spare", "left_out"):
            described_ones = learned.get(name, [])
            aside = [_restore_expert(by_number.get(place + number), e) for number, e in enumerate(described_ones)]
            place += len(aside)
            for e, one in zip(aside, described_ones, strict=True):
                e.restore(one["learned"])
            setattr(self, name, nn.ModuleList(aside).to(self.device))
        every, order = [*self.alternatives, *priors_in(self.left_out)], learned["given"]
        if order is not None and sorted(order) != list(range(len(every))):
            raise ValueError(f"`given` must be the numbers of {len(every)} experts, got {order!r}")
        self.given = None if order is None else [[every[number] for number in order]]
        self._allocate()

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_start(batch_size, context)
        outputs = start_experts(self._experts(), batch_size, context)
        return self._mix_tracking(self.first.expand(batch_size, -1), self.tracking.expand(batch_size, -1), outputs)

    def step(self, action: Tensor, state: Any, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_step(action, context)
        weights, tracking, forecasts, *states = state
        outputs = step_experts(self._experts(), action, states, context)
        taken = taken_of(forecasts, action)
        weights = after(weights, taken, self.first, 0)
        if self.share:
            tracking = after(tracking, taken[:, :-1], self.tracking, self.share)
        return self._mix_tracking(weights, tracking, outputs)

    def _mix_tracking(
        self, weights: Tensor, tracking: Tensor, outputs: list[tuple[Tensor, State]]
    ) -> tuple[Tensor, State]:
        """The logits `[N, A]` and the state, from all weights and from what the experts returned."""
        forecasts = with_pool(torch.stack([logits.log_softmax(-1) for logits, _ in outputs], 1), self.powers)
        if self.share:
            forecasts = torch.cat([forecasts, mixed(tracking, forecasts)[:, None]], 1)
        return mixed(weights, forecasts), (weights, tracking, forecasts, *(state for _, state in outputs))

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        if plans.shape[1] == 0:
            return torch.zeros(*plans.shape, self.num_actions, device=self.device)
        forecasts = with_pool(self._forecasts(plans, context), self.powers)
        if self.share:
            tracking = weights_before(taken_of(forecasts, plans), self.tracking, self.share)
            forecasts = torch.cat([forecasts, mixed(tracking, forecasts)[:, :, None]], 2)
        return mixed(weights_before(taken_of(forecasts, plans), self.first, 0), forecasts)

    @property
    def fit_settings(self) -> tuple[str, ...]:
        if not self.given:
            return training_settings()
        return tuple(dict.fromkeys(["validation", *(name for e in self.given[0] for name in e.fit_settings)]))

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Fit the experts; learn on plans held out from them which are kept, and how they are combined; returns self.

        In the end the experts that count learn from all plans.

        Args:
            plans: `Plans`, or integers `[N, L]` for plans without context.
            generator: draws the held-out plans and the seeds of networks, and is passed on to the experts.
            settings: `validation`: `Plans` that are held out, or their share; groups stay together, unless there are
                few or very unequal ones. It and all others, see `neuroprior.training.Settings`, are passed on to the
                experts that have them.

        Raises:
            ValueError: plans that the experts cannot learn from, too few of them, or an unknown setting.
        """
        self.check_settings(settings)
        plans = training_plans(self, plans)
        generator = generator_on(generator, "cpu")
        learned, held_out = split_validation(plans, pop_validation(self, settings), generator)
        self.spare, self.left_out = nn.ModuleList(), nn.ModuleList()
        if self.given:
            self.experts = nn.ModuleList(*self.given).to(self.device)
            self.fit_experts(learned, held_out, generator, settings)
        else:
            sizes = {"num_contexts": self.num_contexts, "context_size": self.context_size}
            contexts = {name: size for name, size in sizes.items() if size is not None}
            experts = fitted_experts(learned, held_out, contexts, self.effort, generator, settings, self.networks)
            self.experts = nn.ModuleList(experts.fitted).to(self.device)
            self.trained = tuple(experts.networks)
        if self.given:
            self.learn_weights(held_out)
        else:
            self.learn_weights(held_out, number_tried(self._experts()), learned)
        return self.recount(plans)

    @torch.no_grad()
    def learn_weights(self, plans: Plans, tried: int | None = None, learned: Plans | None = None) -> None:
        """Learn from plans that the experts did not learn from which of them are kept, and how they are combined.

        Those that were kept aside before, in `spare`, are tried again.

        Args:
            plans: held-out plans.
            tried: how many experts there were, where these are the best of more; None: these.
            learned: the plans that the experts learned from. Those that are trained are kept only if they are clearly
                better then; and where few plans are held out, experts that count are combined on these as well, part by
                part, fitted anew to the others. None: all are chosen on the held-out plans alone.

        Raises:
            ValueError: plans of other actions or contexts than this prior's, or without any action.
        """
        plans, learned = known_plans(self, plans), None if learned is None else known_plans(self, learned)
        experts = list(self.alternatives)
        held_out, kept, powers = chosen_on(plans, learned, experts, (tried or len(experts)) + 2)
        actions, mask = held_out.actions, held_out.mask
        members = with_pool(held_out.forecasts, powers)
        taken = taken_of(members, actions).masked_fill(~mask[..., None], 0)
        early = slice(0, MOST_STEPS)
        tracking, share = learned_weights(taken[:, early], mask[:, early], TRACKING_STEPS)
        if share:
            tracked = taken_of(mixed(weights_before(taken, tracking, share), members)[:, :, None], actions)
            tracked = torch.cat([taken, tracked.masked_fill(~mask[..., None], 0)], 2)
            if held_out.loss(tracked) > held_out.loss(taken) - held_out.tolerance():
                share = 0.0
        self.experts = nn.ModuleList([experts[number] for number in kept])
        left = [e for number, e in enumerate(experts) if number not in kept]
        self.spare = nn.ModuleList([e for e in left if _can_be_spare(e)])
        self._leave_out()
        self.share, self.tried = share, held_out.tried
        self._allocate()
        self.powers = powers.float()
        if share:
            self.tracking, taken = tracking, tracked
        self.first = held_out.initial_weights(taken.sum(1)).float()

    def recount(self, plans: Plans) -> Self:
        plans, counted = counted_plans(self, plans), []
        for e in priors_in(self.spare):
            try:
                counted.append(e.recount(plans_for(e, plans)))
            except TooLargeError:  # it fitted before only just
                continue
        self.spare = nn.ModuleList(counted)
        self._leave_out()
        return super().recount(plans)

    def _leave_out(self) -> None:
        """Keep those of the given experts that are neither combined nor spare, for the next `fit`."""
        there = self.alternatives
        self.left_out = nn.ModuleList([e for e in (self.given or [[]])[0] if e not in there])

    @property
    def alternatives(self) -> tuple[Prior, ...]:
        return (*super().alternatives, *priors_in(self.spare))

    def summary(self) -> str:
        """What is combined, such as "0.3 markov + 0.8 gru": the powers of the experts in the pool."""
        terms = zip(self.powers.tolist(), self._experts(), strict=True)
        return " + ".join(f"{power:.2f} {type(e).__name__.removesuffix('Prior').lower()}" for power, e in terms)

    @property
    def bound(self) -> float:
        """The most nats by which the negative log-likelihood of any sequence can exceed that of the best expert
        kept.
        """
        return -float(self.first.min())


def _can_be_spare(expert: Prior) -> bool:
    """Whether an expert that was left out may still propose: it counts, in a small table; uniform plans are shared."""
    numbers = sum(values.numel() for values in expert.buffers())
    return _counts(expert) and numbers <= LARGEST_SPARE and not isinstance(expert, UniformPrior)


def _counts(expert: Prior) -> bool:
    """Whether an expert is not trained: it takes little time to count anew."""
    return not expert.fit_settings and not expert.num_weights


def chosen_on(
    plans: Plans, learned: Plans | None, experts: Sequence[Prior], tried: int
) -> tuple[HeldOut, list[int], Tensor]:
    """Which experts are kept, see `CombinedPrior.learn_weights`.

    Returns:
        What the K experts kept forecast for the plans on which they were chosen; their numbers; their powers `[K]`.
    """
    costs = [e.num_weights for e in experts]
    counting = [number for number, e in enumerate(experts) if _counts(e)]
    gains = [
        MIN_GAIN_NATS if learned is None or number in counting else NETWORK_GAIN_NATS for number in range(len(experts))
    ]
    forecasts = stack_forecasts(experts, plans)
    held_out = HeldOut(forecasts, plans.actions, plans.mask(), tried)
    parts = [] if learned is None or not counting else counting_parts(learned, plans)
    if len(parts) < 2 or sum(scored.actions.numel() for _, scored in parts) * forecasts[0, 0].numel() > MOST_NUMBERS:
        kept, powers = held_out.choose(costs, gains)
        return held_out.of(kept), kept, powers
    triples = [(forecasts[:, :, counting], plans.actions, held_out.mask)]
    for rest, left_out in parts[1:]:
        counted = [deepcopy(experts[number]).fit(plans_for(experts[number], rest)) for number in counting]
        triples.append((stack_forecasts(counted, left_out), left_out.actions, left_out.mask()))
    every, actions, mask = map(_pad_and_join, zip(*triples, strict=True))
    counting_held_out = HeldOut(every, actions, mask, tried)
    best, powers = counting_held_out.choose([costs[number] for number in counting])
    chosen = [counting[number] for number in best]
    both = chosen + [number for number in range(len(experts)) if number not in counting]
    few = held_out.of(both, torch.cat([powers, powers.new_zeros(len(both) - len(chosen))]))
    kept, new_powers = few.choose([costs[number] for number in both], [gains[number] for number in both], len(chosen))
    if len(kept) == len(chosen):
        return counting_held_out.of(best), chosen, powers
    return few.of(kept), [both[number] for number in kept], new_powers


def _pad_and_join(values: Sequence[Tensor]) -> Tensor:
    """Tensors `[N_i, L_i, ...]` as one, `[sum of N_i, max of L_i, ...]`, filled up with zeros."""
    longest = max(each.shape[1] for each in values)
    return torch.cat([torch.cat([v, v.new_zeros(len(v), longest - v.shape[1], *v.shape[2:])], 1) for v in values])


def _restore_expert(expert: Prior | None, description: Mapping[str, Any]) -> Prior:
    """The expert that is described: `expert`, if this is alike but for what `fit` chose, or a new one."""
    if expert is not None and type(expert).__name__ == description["prior"]:
        settings = {name: value for name, value in expert.config.items() if value is not None and name != "seed"}
        if all(description["config"].get(name) == value for name, value in settings.items()):
            return expert
    return as_prior(description)
