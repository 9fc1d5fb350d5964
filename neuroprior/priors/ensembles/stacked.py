"""The stacked prior: a recurrent network that combines the forecasts of count-based priors."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor, nn

from neuroprior._checks import check_memory, check_sizes
from neuroprior._random import draw_seed, generator_on
from neuroprior.plans import Plans
from neuroprior.plans.folds import FEWEST_UNITS, divisible, folds, in_parts, num_units
from neuroprior.priors.counts import ContextTreePrior, HistoryPrior, MarkovPrior
from neuroprior.priors.learning import counted_plans, plans_for, training_plans, validation_plans
from neuroprior.priors.neural.gru import gru_sequence
from neuroprior.priors.neural.neural import NeuralPrior, Sizes, context_embedding
from neuroprior.priors.prior import Prior
from neuroprior.sampling.states import State

LEAST = -6.0
"""Log-probabilities of experts are at least this in the network's inputs."""

LONG_AGO = 500.0
"""Steps beyond which it makes no difference how long ago an action was taken."""

MOST_NUMBERS = 2**24
"""Largest size of the table of when each action was last taken in each context."""

TRAINING = {"batch_size": 64, "learning_rate": 4e-3}
"""Settings of the network's training where none are given; it gains nothing from the smaller batches of others."""

PARTS = 8
"""Parts of the plans: experts forecast each part after learning from the others."""


class StackedPrior(Prior):
    """Count-based experts, combined by a gated recurrent network over the whole plan so far.

    With p_e the forecast of expert e, h the network's hidden state, and logits b(h) and weights w_e(h) linear in it,
    actions are drawn with log-odds b(h) + sum of w_e(h) log p_e: a mixture of experts (Jacobs et al. 1991) in log-odds,
    as in products of experts, in which the weights depend on the history and the network can add what no expert
    predicts. The network learns from forecasts that experts made for plans they did not learn from (stacking: Wolpert
    1992), as it would rely on them too much otherwise; the experts learn from all plans in the end.

    With a context index the network's input also has how long ago each action was last taken in this context: what an
    animal did here the last time, however many actions ago that was.

    It needs far fewer plans than a GRU alone: the counts predict what is common, and are not overfitted.

    The state holds, in float32, the network's hidden state, each expert's state, and for a context index when each
    action was last taken in each context: `num_contexts * A` numbers.

    Args:
        num_actions: A.
        hidden_size: of the network.
        dropout: in training, of the network's input vectors and of the output of each layer.
        orders: of the Markov priors among the experts.
        depth: of the context trees among them; with contexts, one of two trees takes the context.
        num_contexts: number of context indices, for a prior that takes an index.
        seed: draws the initial weights.
        num_layers: of the network; None: chosen by `fit` for its first plans (or parts of a single one): one with
            contexts, else see `neuroprior.priors.neural.Sizes`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> prior = StackedPrior(
        ...     3, hidden_size=4
        ... )  # prior.fit(plans) counts, and trains the network that weighs the counts
        >>> prior.num_actions
        3
    """

    actions_at_once = 2**18

    def __init__(
        self,
        num_actions: int,
        hidden_size: int = 128,
        dropout: float = 0.5,
        orders: tuple[int, ...] | list[int] = (2, 3, 4),
        depth: int = 10,
        num_contexts: int | None = None,
        seed: int = 0,
        num_layers: int | None = None,
    ) -> None:
        super().__init__(num_actions, num_contexts)
        self.hidden_size, self.dropout, self.orders, self.depth = hidden_size, dropout, tuple(orders), depth
        chains = [
            MarkovPrior(num_actions, k, 4.0, num_contexts=num_contexts, backoff="witten-bell") for k in self.orders
        ]
        trees = [
            ContextTreePrior(num_actions, depth, num_contexts=contexts)
            for contexts in ([None] if num_contexts is None else [num_contexts, None])
        ]
        self.experts = nn.ModuleList([*chains, *trees])
        self.mixer = Mixer(num_actions, len(self.experts), hidden_size, num_layers, dropout, num_contexts, seed)

    @property
    def config(self) -> dict[str, Any]:
        settings: dict[str, Any] = {"hidden_size": self.hidden_size, "dropout": self.dropout}
        arguments = self.mixer.arguments()
        if arguments["num_layers"] is not None:
            settings["num_layers"] = arguments["num_layers"]
        settings |= {"seed": arguments["seed"]} if arguments.get("seed") else {}
        return super().config | settings | {"orders": list(self.orders), "depth": self.depth}

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"network": self.mixer.learned}

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_start(batch_size, context)
        forecasts, states = zip(*(e.start(batch_size, context_for(e, context)) for e in self._experts()), strict=True)
        ago = torch.full((batch_size, (self.num_contexts or 0) * self.num_actions), LONG_AGO, device=self.device)
        logits, hidden = self.mixer.start(batch_size, self._features(torch.stack(forecasts, 1), ago, context))
        return logits, self._state(hidden, states, ago, context)

    def step(self, action: Tensor, state: Any, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_step(action, context)
        hidden, before, ago, *last_context = state
        if self.num_contexts is not None:
            (last,) = last_context
            ago = ago.add(1).clamp_(max=LONG_AGO)
            ago = ago.scatter(1, (last * self.num_actions + action.long())[:, None], 1.0)
            context = last if context is None else context.long()
        outputs = [
            e.step(action, s, context_for(e, context)) for e, s in zip(self._experts(), before.unbind(1), strict=True)
        ]
        forecasts, states = zip(*outputs, strict=True)
        logits, hidden = self.mixer.step(action, hidden, self._features(torch.stack(forecasts, 1), ago, context))
        return logits, self._state(hidden, states, ago, context)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        if plans.shape[1] == 0:
            return torch.zeros(*plans.shape, self.num_actions, device=self.device)
        with torch.no_grad():
            forecasts = torch.stack([e(plans, context_for(e, context)) for e in self._experts()], 2)
        logits: Tensor = self.mixer(plans, self._all_features(forecasts, plans, context))
        return logits

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return self.mixer.fit_settings

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Fit the experts by counting and the network with Lightning; returns self.

        Args:
            plans: at least two (two groups, where there are any), or one long one; integers `[N, L]` for plans without
                context.
            generator: draws the parts, the held-out plans and the order of training.
            settings: fields of `neuroprior.training.Settings`, for the network; by default `TRAINING`.

        Raises:
            ValueError: plans that this prior cannot learn from, too few of them, a setting that is unknown or out of
                range, or a training that diverged.
        """
        self.check_settings(settings)
        held_out = settings.get("validation")
        held_out = validation_plans(self, held_out) if isinstance(held_out, Plans) else None
        plans = training_plans(self, plans, further=self.mixer.sized)
        generator = generator_on(generator, "cpu")
        learned = plans[plans.mask().any(1)]
        if len(learned) == 1:
            learned = in_parts(learned, min(PARTS, int(learned.mask().sum())))
        if len(learned) < FEWEST_UNITS:
            raise ValueError("plans: a stacked prior needs at least two actions to learn from, beside those held out")
        learned = divisible(learned)
        stacked = self._stack(learned, self._forecasts(learned, generator))
        self.recount(plans)
        if held_out is not None:
            with torch.no_grad():
                forecasts = [e(held_out.actions, context_for(e, held_out.context)) for e in self._experts()]
            settings = settings | {"validation": self._stack(held_out, torch.stack(forecasts, 2))}
        self.mixer.fit(stacked, generator=generator, **TRAINING | settings)
        self.mixer.window = None  # its hidden state is carried on without limit
        return self

    def _stack(self, plans: Plans, forecasts: Tensor) -> Plans:
        """The plans as the network reads them, from forecasts `[N, L, E, A]` of their actions."""
        features = self._all_features(forecasts, plans.actions, plans.context)
        return replace(plans, context=features, context_names=None)

    def recount(self, plans: Plans) -> Self:
        plans = counted_plans(self, plans)
        for expert in self._experts():
            expert.fit(plans_for(expert, plans))
        return self

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        self.mixer.restore(learned["network"])

    def _forecasts(self, plans: Plans, generator: torch.Generator) -> Tensor:
        """`[N, L, E, A]`: log-probabilities of experts that did not learn from the plan they predict."""
        units = num_units(plans)
        shape = (*plans.actions.shape, len(self.experts), self.num_actions)
        out = torch.zeros(shape, device=plans.actions.device)
        with torch.no_grad():
            for learned, left_out in folds(plans, min(PARTS, units), draw_seed(generator)):
                fold = plans[left_out]
                for number, expert in enumerate(self._experts()):
                    expert.fit(plans_for(expert, plans[learned]))
                    out[left_out, :, number] = expert(fold.actions, context_for(expert, fold.context))
        return out

    def _experts(self) -> Iterator[HistoryPrior]:
        for expert in self.experts:
            assert isinstance(expert, HistoryPrior)
            yield expert

    def _features(self, forecasts: Tensor, ago: Tensor, context: Tensor | None) -> Tensor:
        """The network's features `[N, D]`, from forecasts `[N, E, A]`."""
        if self.num_contexts is None:
            return self._join_features(forecasts, None, None)
        if context is None:
            raise ValueError("context: this prior takes a context, and none was given")
        entries = context.long()[:, None] * self.num_actions + torch.arange(self.num_actions, device=ago.device)
        return self._join_features(forecasts, ago.gather(1, entries), context)

    def _all_features(self, forecasts: Tensor, plans: Tensor, context: Tensor | None) -> Tensor:
        """The same for whole plans, `[N, L, D]`, of forecasts `[N, L, E, A]`."""
        if context is None or self.num_contexts is None:
            return self._join_features(forecasts, None, None)
        size = max(MOST_NUMBERS // (self.num_contexts * self.num_actions), 1)
        parts = zip(plans.split(size), context.split(size), strict=True)
        ago = torch.cat([self._ago(chunk.long(), theirs.long()) for chunk, theirs in parts])
        return self._join_features(forecasts, ago, context)

    def _join_features(self, forecasts: Tensor, ago: Tensor | None, context: Tensor | None) -> Tensor:
        """`[..., D]`: the context, the forecasts `[..., E, A]`, and how long ago each action was taken `[..., A]`."""
        parts = [forecasts.clamp(min=LEAST).flatten(-2)]
        if ago is not None and context is not None:
            parts = [context[..., None].float(), *parts, _log(ago)]
        return torch.cat(parts, -1)

    def _ago(self, plans: Tensor, context: Tensor) -> Tensor:
        """`[N, L, A]`: how long ago each action was last taken in the context of each step `[N, L]`."""
        entries = context[..., None] * self.num_actions + torch.arange(self.num_actions, device=plans.device)
        code = context * self.num_actions + plans
        last = torch.full((len(plans), (self.num_contexts or 0) * self.num_actions), -LONG_AGO, device=plans.device)
        ago = torch.empty(*plans.shape, self.num_actions, device=plans.device)
        for t in range(plans.shape[1]):
            ago[:, t] = t - last.gather(1, entries[:, t])
            last.scatter_(1, code[:, t, None], float(t))
        return ago.clamp_(max=LONG_AGO)

    def _state(self, hidden: State, states: tuple[Tensor, ...], ago: Tensor, context: Tensor | None) -> State:
        """The network's state, those of the experts `[N, E]`, how long ago each action was taken, and the context."""
        return (hidden, torch.stack(states, 1), ago, *([] if context is None else [context.long()]))


class Mixer(NeuralPrior):
    """The network of a `StackedPrior`: reads forecasts as features, weights them, and adds logits of its own."""

    def __init__(
        self,
        num_actions: int,
        num_experts: int,
        hidden_size: int,
        num_layers: int | None,
        dropout: float,
        contexts: int | None,
        seed: int,
    ) -> None:
        layers = {} if num_layers is None else {"num_layers": num_layers}
        check_sizes(hidden_size=hidden_size, num_experts=num_experts, **layers)
        check_memory(24 * hidden_size**2, hidden_size=hidden_size)
        self.num_experts, self.contexts = num_experts, contexts
        size = num_experts * num_actions + (0 if contexts is None else 1 + num_actions)
        super().__init__(num_actions, hidden_size, None, 1, dropout, None, size, seed, num_layers)

    @property
    def config(self) -> dict[str, Any]:
        arguments = {"num_experts": self.num_experts, "hidden_size": self.width, "contexts": self.contexts}
        arguments |= {"num_layers": self.num_layers}
        return arguments | {"num_actions": self.num_actions, "dropout": self.dropout, "seed": 0}

    def sizes_for(self, plans: Plans) -> Sizes:
        """As for other networks, but of one layer where the context is known: a second one gains nothing there."""
        sizes = super().sizes_for(plans)
        return sizes if self.contexts is None else sizes._replace(num_layers=1)

    def build(self) -> None:
        width, forecasts = self.width, self.num_experts * self.num_actions
        self.action = nn.Embedding(self.num_actions + 1, width)
        self.index = None if self.contexts is None else context_embedding(self.contexts, width)
        self.features = nn.Linear(forecasts + (0 if self.contexts is None else self.num_actions), width)
        self.gru = nn.GRU(width, width, self.num_layers, batch_first=True, dropout=self.dropout * (self.num_layers > 1))
        self.drop = nn.Dropout(self.dropout)
        self.head = nn.Linear(width, self.num_actions)
        self.weights = nn.Linear(width, self.num_experts)
        # Untrained, it gives the experts' geometric mean.
        for layer, first in ((self.head, 0.0), (self.weights, 1 / self.num_experts)):
            nn.init.zeros_(layer.weight)
            nn.init.constant_(layer.bias, first)

    def encode(self, previous: Tensor, context: Tensor | None, hidden: State | None = None) -> tuple[Tensor, State]:
        """See `NeuralPrior.encode`; `hidden` is the layers' hidden states `[N, layers, H]`."""
        assert context is not None
        vectors, rest = self.action(previous), context
        if self.index is not None:
            vectors, rest = vectors + self.index(rest[..., 0].long()), rest[..., 1:]
        rest = rest.to(self.features.weight.dtype)
        forecasts = rest[..., : self.num_experts * self.num_actions]
        vectors = vectors + self.features(rest / 2)
        layers = None if hidden is None else hidden.transpose(0, 1)
        out, layers = gru_sequence(self.gru, self.drop(vectors), layers)
        out = self.drop(out)
        mixed = (self.weights(out)[..., None] * forecasts.unflatten(-1, (self.num_experts, -1))).sum(-2)
        return self.head(out) + mixed, layers.transpose(0, 1)


def context_for(expert: Prior, context: Tensor | None) -> Tensor | None:
    """The context, for an expert that takes one; else None."""
    return context if expert.takes_context else None


def _log(ago: Tensor) -> Tensor:
    """How long ago, on a logarithmic scale."""
    return (ago + 1).log() * (2 / 3)
