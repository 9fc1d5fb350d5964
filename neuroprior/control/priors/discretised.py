"""Discretised vectors: each dimension is a token, and a prior over actions predicts the tokens one after another."""

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior.control.priors.vector_prior import VectorPrior
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.plans import Plans
from neuroprior.priors.counts import MarkovPrior
from neuroprior.priors.prior import Prior, described
from neuroprior.priors.saved import SavedModule

UNIFORM = 0.02
"""Share of uniform edges in those of the bins, so that none has no width."""


class DiscretisedPrior(VectorPrior):
    """A prior over tokens, D for each vector (as the actions of the trajectory transformer, Janner et al. 2021).

    Token 0 is the lower bound and the last token the upper one, so that both have a probability; between them lie
    `num_bins` bins a dimension, of about equal counts in the first plans that it learned from. Within a bin the density
    is uniform. The prior over tokens may take the number of the dimension as a context index.

    Args:
        action_low, action_high: see `VectorPrior`.
        num_bins: bins between the bounds.
        tokens: a prior of `num_bins` + 2 actions, without context or with `num_contexts` = D; or, as in a saved
            `config`, an object with `prior`, the name of a class, and its `config`. None: a Markov chain of order D.

    Raises:
        ValueError: an argument is out of range, or the prior over tokens does not fit.

    Example:
        >>> plans = VectorPlans(torch.linspace(-1, 1, 20).expand(8, 20)[..., None], [-1.0], [1.0])
        >>> prior = DiscretisedPrior([-1.0], [1.0], num_bins=5, tokens=MarkovPrior(7, 1)).fit(
        ...     plans
        ... )  # and a token for each bound
        >>> prior.sample(3, 4, generator=torch.Generator().manual_seed(0)).shape
        torch.Size([1, 3, 4, 1])
    """

    _edges: Tensor
    tokens: Prior

    def __init__(
        self, action_low: Any, action_high: Any, num_bins: int = 15, tokens: Prior | Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(action_low, action_high)
        check_sizes(num_bins=num_bins)
        size, self.num_bins = self.action_size, num_bins
        if tokens is None:
            tokens = MarkovPrior(num_bins + 2, size, num_contexts=size)
        made: object = tokens
        if isinstance(tokens, Mapping):
            kind = SavedModule.known.find(str(tokens.get("prior")))
            if kind is None or not isinstance(tokens.get("config"), Mapping):
                raise ValueError(f"tokens: the name of a known prior and its config are expected, not {dict(tokens)!r}")
            made = kind(**tokens["config"])
        if not isinstance(made, Prior) or made.num_actions != num_bins + 2:
            raise ValueError(f"tokens: a prior of num_bins + 2 = {num_bins + 2} actions is expected, not {made!r}")
        if made.takes_context and made.num_contexts != size:
            raise ValueError(
                f"tokens: a prior without context or with {size} context indices is expected, not {made!r}"
            )
        self.tokens, self._learned = made, False
        self.register_buffer("_edges", self._uniform())

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"num_bins": self.num_bins, "tokens": described(self.tokens)}

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"edges": self._learned, "tokens": self.tokens.learned}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        self._learned = bool(learned["edges"])
        self.tokens.restore(learned["tokens"])

    @property
    def learns_anew(self) -> bool:
        return not self._learned

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return self.tokens.fit_settings

    def fit(self, plans: VectorPlans, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Learn the bins, unless they are learned, and the prior over tokens; see `VectorPrior.fit` and its `fit`."""
        self.check_settings(settings)
        plans = self.training_plans(plans)
        if not self._learned:
            self.warn_if_coarse(plans)
            self._edges.copy_(self._quantiles(plans.actions[plans.mask()]))
            self._learned = True
        if isinstance(settings.get("validation"), VectorPlans):
            settings = settings | {"validation": self._plans(self.training_plans(settings["validation"]))}
        self.tokens.fit(self._plans(plans), generator=generator, **settings)
        return self

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple["DiscretisedForecast", Tensor]:
        logits, state = self.tokens.start(batch_size, self._context(0, batch_size))
        return DiscretisedForecast(self, logits, state), state

    def step(
        self, action: Tensor, state: Tensor, context: Tensor | None = None
    ) -> tuple["DiscretisedForecast", Tensor]:
        logits = state
        for d, token in enumerate(self.tokens_of(action).unbind(1)):
            logits, state = self.after(token, state, d)
        return DiscretisedForecast(self, logits, state), state

    def after(self, token: Tensor, state: Tensor, d: int) -> tuple[Tensor, Tensor]:
        """Logits `[N, A]` of the token after that of dimension `d`, and the state of the prior over tokens."""
        return self.tokens.step(token, state, self._context((d + 1) % self.action_size, len(token)))

    def continuations(
        self, num_plans: int, length: int, past: Tensor, context: Tensor | None, generator: torch.Generator
    ) -> Tensor:
        forecast, state = self.read(past, context)
        assert isinstance(forecast, DiscretisedForecast)
        logits, state = (values.repeat_interleave(num_plans, 0) for values in (forecast.logits, state))
        drawn = []
        for t in range(length * self.action_size):
            drawn.append(torch.multinomial(logits.softmax(-1), 1, generator=generator)[:, 0])
            if t + 1 < length * self.action_size:
                logits, state = self.after(drawn[-1], state, t % self.action_size)
        tokens = torch.stack(drawn, 1).view(-1, self.action_size)
        return self.vectors_of(tokens, generator).view(len(past), num_plans, length, self.action_size)

    def action_log_probs(self, plans: VectorPlans) -> Tensor:
        self.check_plans(plans)
        plans = plans.to(self.device)
        if not plans.max_length or not len(plans):
            return torch.zeros(plans.actions.shape[:2], device=self.device)
        tokens = self._plans(plans)
        nats = self.tokens.action_log_probs(tokens).view(plans.actions.shape).sum(-1)
        widths = self.log_widths(tokens.actions.long().view(plans.actions.shape)).sum(-1)
        return (nats - widths).masked_fill(~plans.mask(), 0)

    def tokens_of(self, vectors: Tensor) -> Tensor:
        """Tokens of vectors `[..., D]`."""
        within = 1 + (vectors[..., None] >= self._edges[:, 1:-1]).sum(-1)
        highest = torch.where(vectors >= self.action_high, self.num_bins + 1, within)
        return torch.where(vectors <= self.action_low, 0, highest)

    def vectors_of(self, tokens: Tensor, generator: torch.Generator) -> Tensor:
        """Vectors `[N, D]` drawn uniformly within the bins of their tokens."""
        share = torch.rand(tokens.shape, generator=generator, device=tokens.device)
        first = self._limits(tokens - 1)
        return torch.lerp(first, self._limits(tokens), share).clamp(self.action_low, self.action_high)

    def log_widths(self, tokens: Tensor) -> Tensor:
        """Logarithms of the widths of bins; 0 for the bounds, which have none."""
        widths = self._limits(tokens) - self._limits(tokens - 1)
        return torch.where(widths > 0, widths, 1).log()

    def _limits(self, place: Tensor) -> Tensor:
        """The edges `[..., D]` at places `[..., D]`, the outermost beyond these."""
        place = place.clamp(0, self.num_bins)
        return self._edges[torch.arange(self.action_size, device=place.device), place]

    def _plans(self, plans: VectorPlans) -> Plans:
        """The tokens of plans, `[N, L * D]`."""
        num, length = plans.actions.shape[:2]
        tokens = self.tokens_of(plans.actions).masked_fill(~plans.mask()[..., None], 0).flatten(1)
        context = self._context(0, num)
        if context is not None:
            context = torch.arange(self.action_size, device=tokens.device).repeat(num, length)
        lengths = None if plans.lengths is None else plans.lengths * self.action_size
        return Plans(tokens, self.num_bins + 2, lengths=lengths, context=context, group=plans.group)

    def _context(self, d: int, num: int) -> Tensor | None:
        """The context of `num` tokens of dimension `d`."""
        return torch.full((num,), d, device=self.device) if self.tokens.takes_context else None

    def _uniform(self) -> Tensor:
        """Edges `[D, num_bins + 1]` of bins of equal width."""
        share = torch.linspace(0, 1, self.num_bins + 1, device=self.device)
        return torch.lerp(self.action_low[:, None], self.action_high[:, None], share)

    def _quantiles(self, vectors: Tensor) -> Tensor:
        """Edges `[D, num_bins + 1]` of bins of about equal counts of the `vectors [M, D]` inside the bounds."""
        edges = self._uniform()
        inside = (vectors > self.action_low) & (vectors < self.action_high)
        for d in range(self.action_size):
            values = vectors[inside[:, d], d].sort().values
            if len(values):  # torch.quantile takes at most 2**24 numbers
                place = torch.linspace(0, len(values) - 1, self.num_bins + 1, device=values.device).round().long()
                edges[d, 1:-1] = torch.lerp(values[place], edges[d], UNIFORM)[1:-1]
        return edges


class DiscretisedForecast(NamedTuple):
    """The distribution of the next vector, token by token.

    Attributes:
        prior: whose it is.
        logits: `[N, A]` of the first token.
        state: `[N, ...]` of the prior over tokens, before the first token.
    """

    prior: DiscretisedPrior
    logits: Tensor
    state: Tensor

    def log_prob(self, vector: Tensor) -> Tensor:
        tokens = self.prior.tokens_of(vector)
        logits, state, nats = self.logits, self.state, -self.prior.log_widths(tokens).sum(-1)
        for d, token in enumerate(tokens.unbind(1)):
            nats = nats + logits.log_softmax(-1).gather(1, token[:, None])[:, 0]
            if d + 1 < tokens.shape[1]:
                logits, state = self.prior.after(token, state, d)
        return nats

    def sample(self, generator: torch.Generator) -> Tensor:
        logits, state, drawn = self.logits, self.state, []
        for d in range(self.prior.action_size):
            drawn.append(torch.multinomial(logits.softmax(-1), 1, generator=generator)[:, 0])
            if d + 1 < self.prior.action_size:
                logits, state = self.prior.after(drawn[-1], state, d)
        return self.prior.vectors_of(torch.stack(drawn, 1), generator)

    def repeat_interleave(self, times: int) -> "DiscretisedForecast":
        logits, state = (values.repeat_interleave(times, 0) for values in (self.logits, self.state))
        return DiscretisedForecast(self.prior, logits, state)
