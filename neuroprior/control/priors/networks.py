"""A neural prior over vectors: a GRU that predicts the next vector as a mixture of Gaussians."""

import warnings
from dataclasses import replace
from math import log, log1p
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuroprior._checks import check_memory, check_seed, check_sizes, is_number
from neuroprior._random import draw_seed, generator_on
from neuroprior.control.priors.autoregressive import AutoregressivePrior
from neuroprior.control.priors.compiled_sampling import draw_recurrent
from neuroprior.control.priors.linear_gaussian import LinearTables, held_out_split
from neuroprior.control.priors.vector_prior import GaussianForecast, VectorPrior
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.plans.folds import check_alike
from neuroprior.plans.sequences import Sequences
from neuroprior.priors.neural.features import Standardise
from neuroprior.priors.neural.gru import gru_step
from neuroprior.priors.neural.neural import check_layers

MIN_STD = 1e-3
"""The least standard deviation of a component, as a share of the range between the bounds."""

FIRST_STD = 0.15
"""Standard deviation of each component before training, as a share of the range."""

FIRST_SPREAD = 0.5
"""Standard deviation of the components' means before training, so that they differ, as a share of the mixture's."""

MIN_DIVISOR = 1e-9
"""Instead of 0, where a number is divided by."""

MIN_SPREAD = 0.02
"""Standard deviations of less than this, in units of half the range, are lost in a network."""

PRIOR_VECTORS, EM_STEPS = 1, 100
"""Held-out vectors that equal shares of the network and the autoregression count for when these are estimated, and the
steps of EM for that."""

DEFAULTS = {"window": 64, "learning_rate": 3e-3}
"""Settings of a training, where they are not given."""

MIN_STEPS, MAX_STEPS, VECTORS_PER_STEP = 300, 4000, 40
"""Steps of a training, where these are not given: one for so many vectors, within these bounds. More steps overfit some
thousand vectors before the learning rate has fallen."""


class Autoregression(nn.Module):
    """An `AutoregressivePrior` as a network reads it: linear in the last `order` vectors, of which some may be missing.

    Row h of each table is for h known vectors, in units of half the range from its middle.

    Args:
        order: vectors that predictions depend on, at most.
        size: D.
    """

    weights: Tensor
    """`[order + 1, D, order * (D + 1)]`, of inputs as `VectorGRU` makes them."""

    offset: Tensor
    """`[order + 1, D]`."""

    std: Tensor
    """`[order + 1, D]`."""

    coupling: Tensor
    """`[order + 1, D, D]`, strictly lower triangular."""

    def __init__(self, order: int, size: int) -> None:
        super().__init__()
        shapes = ((size, order * (size + 1)), (size,), (size,), (size, size))
        for name, shape in zip(LinearTables._fields, shapes, strict=True):
            self.register_buffer(name, torch.full((order + 1, *shape), float(name == "std")))

    def learn_from(self, chain: AutoregressivePrior) -> None:
        """Take over an autoregression of at most `order` vectors."""
        size, order = self.offset.shape[1], len(chain.offset) - 1
        rows = torch.arange(len(self.offset), device=self.offset.device).clamp(max=order)
        for name in ("offset", "std", "coupling"):
            getattr(self, name).copy_(getattr(chain, name)[rows])
        weights = chain.weights[rows].unflatten(1, (order, size)).permute(0, 3, 1, 2)
        self.weights.zero_()
        if order:
            self.weights.unflatten(2, (-1, size + 1))[:, :, -order:, :size] = weights

    def forward(self, recent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean and std `[M, D]` and coupling `[M, D, D]` after inputs `[M, order * (D + 1)]`."""
        order, size = len(self.offset) - 1, self.offset.shape[1]
        num_past = recent.unflatten(1, (order, size + 1))[..., -1].sum(1).long()
        means = (recent @ self.weights.flatten(0, 1).T).unflatten(1, (order + 1, size)) + self.offset
        mean = means.take_along_dim(num_past[:, None, None], 1)[:, 0]
        return mean, self.std[num_past], self.coupling[num_past]


class VectorGRU(VectorPrior):
    """A gated recurrent network (Cho et al. 2014) that predicts a mixture of K censored Gaussians (Bishop 1994).

    At each step the network reads the last vector, scaled by the bounds to -1..1, and the features of the state where
    it takes them, standardised (`neuroprior.priors.neural.features.Standardise`). The means of all components have a
    common part that is linear in the last `order` vectors and the features; the rest of the means, the weights and the
    standard deviations are the network's; those of a plan's first vector have factors of their own. Training begins
    with the linear part and the standard deviations of an `AutoregressivePrior` of at most `order` vectors.

    From few vectors a network learns little that is better, and is sometimes far too sure. After training the
    autoregression is therefore one more component of the mixture, with a constant weight that held-out vectors choose.
    The autoregression has learned from these, too, which favours it: with few vectors its weight is about one half, and
    next to nothing where the network predicts many vectors better.

    Plans longer than `Settings.window` (64 where it is not given) are read window by window in training, the hidden
    state carried over, and in use it runs on without limit. To read a past, see `read`, the network begins at most
    `memory` vectors before its end: the training window, which bounds the time that a decision takes.

    `state` is `[N, H + E]`: the H numbers that the network carries along, and the E of its next input.

    Args:
        action_low, action_high, context_size: see `VectorPrior`.
        width: of the network's vectors.
        num_layers: number of layers.
        num_components: K.
        dropout: share of the network's activations that is set to 0 at random in training.
        seed: draws the initial weights; torch's global generator is left alone.
        order: last vectors that the autoregression reads, at most (and at most `memory`), and the linear part.

    Attributes:
        memory: vectors read at once in training; None before `fit`.
        autoregressive_share: weight of the autoregression in the mixture; 0 before `fit`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> prior = VectorGRU([-1.0], [1.0], width=4)  # prior.fit(plans) trains it
        >>> prior.sample(3, 5).shape
        torch.Size([1, 3, 5, 1])
    """

    def __init__(
        self,
        action_low: Any,
        action_high: Any,
        context_size: int | None = None,
        width: int = 64,
        num_layers: int = 1,
        num_components: int = 5,
        dropout: float = 0.1,
        seed: int = 0,
        order: int = 8,
    ) -> None:
        super().__init__(action_low, action_high, context_size)
        check_sizes(width=width, num_layers=num_layers, num_components=num_components, order=order)
        check_memory(24 * width**2, width=width)
        check_layers(num_layers, 24 * width**2)
        if not is_number(dropout) or not 0 <= dropout < 1:
            raise ValueError(f"`dropout` must be at least 0 and below 1, got {dropout!r}")
        check_seed(seed)
        self.width, self.num_layers, self.num_components = width, num_layers, num_components
        self.order, self.dropout = order, dropout
        size, features = self.action_size, context_size or 0
        self.entry_size = size + 1
        self.recent_size = order * self.entry_size
        self.input_size = self.recent_size + features
        check_memory(4 * self.input_size * (width + order * size), width=width, order=order)
        self.features = Standardise(features)
        self.autoregression, self.autoregressive_share = Autoregression(order, size), 0.0
        self.first_log_std = nn.Parameter(torch.zeros(size))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.inputs = nn.Linear(self.entry_size + features, width)
            self.drop = nn.Dropout(dropout)
            self.gru = nn.GRU(width, width, num_layers, batch_first=True)
            self.head = nn.Linear(width, num_components * (1 + 2 * size))
            with torch.no_grad():
                self.head.weight.mul_(0.3)
                _, means, stds = self._parts(self.head.bias)
                means.normal_(0, 2 * FIRST_STD * FIRST_SPREAD)
                stds.fill_(log(2 * FIRST_STD))
            self.linear = nn.Linear(self.input_size, size, bias=False)
            nn.init.zeros_(self.linear.weight)
        self.to(self.device).eval()

    @property
    def config(self) -> dict[str, Any]:
        names = ("width", "num_layers", "num_components", "order", "dropout")
        return super().config | {name: getattr(self, name) for name in names}

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"memory": self.memory, "autoregressive_share": self.autoregressive_share}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        memory, share = learned["memory"], learned["autoregressive_share"]
        if memory is not None:
            check_sizes(memory=memory)
        if not is_number(share) or not 0 <= share < 1:
            raise ValueError(f"`autoregressive_share` must be at least 0 and below 1, got {share!r}")
        self.memory, self.autoregressive_share = memory, float(share)

    @property
    def learns_anew(self) -> bool:
        return self.memory is None

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        none = torch.zeros(batch_size, 1, self.entry_size, device=self.device)
        return self._forecast_after(self._inputs(none, None, None if context is None else context[:, None]))

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        hidden, last = state.split([state.shape[1] - self.input_size, self.input_size], 1)
        features = last[:, self.recent_size :] if context is None else self.features(context)
        kept = last[:, self.entry_size : self.recent_size]
        return self._forecast_after(torch.cat([kept, self._entries(action), features], 1)[:, None], hidden)

    def read(self, past: Tensor, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        return self._forecast_after(self._inputs_of_past(past, context))

    def _inputs_of_past(self, past: Tensor, context: Tensor | None) -> Tensor:
        """The inputs `[N, T, E]` that `past` and `context` are read as."""
        # A past as long as `memory` may be the end of a longer one, and is read as such.
        if self.memory is None or past.shape[1] < self.memory:
            entries = functional.pad(self._entries(past), (0, 0, 1, 0))
        else:
            entries = self._entries(past[:, past.shape[1] - self.memory :])
        if context is not None:
            context = context[:, context.shape[1] - entries.shape[1] :]
        return self._inputs(entries, None, context)

    def continuations(
        self, num_plans: int, length: int, past: Tensor, context: Tensor | None, generator: torch.Generator
    ) -> Tensor:
        inputs, number = self._inputs_of_past(past, context), len(past) * num_plans
        uniform = torch.rand(number, length, generator=generator, device=self.device)
        noise = torch.randn(number, length, self.action_size, generator=generator, device=self.device)
        return self.draw(inputs, uniform, noise).view(len(past), num_plans, length, self.action_size)

    def draw(self, inputs: Tensor, uniform: Tensor, noise: Tensor) -> Tensor:
        """The vectors `[N, L, D]` that random numbers make, after a past; see `GaussianForecast.drawn`.

        Args:
            inputs: `[B, T, E]`, what the past is read as, T > 0, each row for N / B successive plans.
            uniform: `[N, L]`, uniform from 0 to 1.
            noise: `[N, L, D]`, standard normal.
        """
        if inputs.device.type == "cpu":
            return draw_recurrent(self, 2 * MIN_STD, inputs, uniform, noise)
        return self.draw_in_steps(inputs, uniform, noise)

    def draw_in_steps(self, inputs: Tensor, uniform: Tensor, noise: Tensor) -> Tensor:
        """As `draw`, by the operations of torch, which a GPU runs."""
        forecast, state = self._forecast_after(inputs)
        each = len(noise) // max(len(inputs), 1)
        last = forecast.repeat_interleave(each).drawn(uniform[:, 0], noise[:, 0])
        state = state.repeat_interleave(each, 0)
        numbers = uniform[:, 1:].transpose(0, 1), noise[:, 1:].transpose(0, 1)
        vectors = [last]
        for each_uniform, each_noise in zip(*numbers, strict=True):
            forecast, state = self.step(last, state)
            last = forecast.drawn(each_uniform, each_noise)
            vectors.append(last)
        return torch.stack(vectors, 1)

    def _forecast_after(self, inputs: Tensor, hidden: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        """The distribution after the last of `inputs [N, T, E]`, and the state."""
        out, hidden = self._encode(inputs, hidden)
        return self._forecast(out[:, -1], inputs[:, -1]), torch.cat([hidden, inputs[:, -1]], 1)

    def _encode(self, inputs: Tensor, hidden: Tensor | None) -> tuple[Tensor, Tensor]:
        """The network's output `[N, T, width]` for `inputs [N, T, E]`, and its hidden state `[N, H]` after them.

        `hidden`: after the inputs before these; None: there are none.
        """
        # It reads the last vector and the features; the vectors before it are for the linear part.
        vectors = self.drop(self.inputs(inputs[..., self.recent_size - self.entry_size :]))
        if hidden is None:
            hidden = vectors.new_zeros(len(vectors), self.num_layers * self.width)
        layers = hidden.unflatten(1, (self.num_layers, self.width)).transpose(0, 1)
        if vectors.shape[1] == 1 and not (self.training or torch.is_grad_enabled()):
            out, layers = gru_step(self.gru, vectors[:, 0], layers)
            out = out[:, None]
        else:
            out, layers = self.gru(vectors, layers.contiguous())
        return out, layers.transpose(0, 1).flatten(1)

    def log_probs_from(
        self, actions: Tensor, context: Tensor | None, previous: Tensor | None, state: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Nats `[N, T]` of vectors that continue a sequence, and the state after it; training calls this.

        Args:
            actions: `[N, T, D]`, T > 0.
            context: None, `[N, C]` or `[N, T, C]`.
            previous: `[N, D]`, the vector before the first, NaN for none; None: there is none.
            state: as the last call returned it; None: nothing was read before.
        """
        first = torch.zeros_like(actions[:, :1, :1]).expand(-1, -1, self.entry_size)
        if previous is not None:
            first = torch.where(previous[:, :1].isnan(), 0, self._entries(previous))[:, None]
        entries = torch.cat([first, self._entries(actions[:, :-1])], 1)
        inputs = self._inputs(entries, state, context)
        out, hidden = self._encode(inputs, None if state is None else state[:, : state.shape[1] - self.input_size])
        nats = self._forecast(out.flatten(0, 1), inputs.flatten(0, 1)).log_prob(actions.flatten(0, 1))
        return nats.view(actions.shape[:2]), torch.cat([hidden, inputs[:, -1]], 1)

    def action_log_probs(self, plans: VectorPlans) -> Tensor:
        self.check_plans(plans)
        plans = plans.to(self.device)
        actions, context = plans.actions, plans.context
        if not plans.max_length or not len(plans):
            return torch.zeros(actions.shape[:2], device=self.device)
        parts, at_once, state = [], self.memory or plans.max_length, None
        for first in range(0, plans.max_length, at_once):
            now = slice(first, first + at_once)
            previous = actions[:, first - 1] if first else None
            context_chunk = None if context is None else context[:, now]
            nats, state = self.log_probs_from(actions[:, now], context_chunk, previous, state)
            parts.append(nats)
        return torch.cat(parts, 1).masked_fill(~plans.mask(), 0)

    def _entries(self, actions: Tensor) -> Tensor:
        """`[..., D + 1]`: vectors scaled to -1..1, and a 1; only zeros stand for no vector."""
        return functional.pad((actions - self.middle) / self.half_range, (0, 1), value=1.0)

    def _inputs(self, entries: Tensor, state: Tensor | None, context: Tensor | None) -> Tensor:
        """The inputs `[N, T, E]`: the last of `entries [N, T, D + 1]` and the features before each vector."""
        before = entries.new_zeros(len(entries), self.recent_size - self.entry_size)
        if state is not None:
            first = state.shape[1] - self.input_size
            before = state[:, first + self.entry_size : first + self.recent_size]
        line = torch.cat([before.reshape(len(entries), self.order - 1, self.entry_size), entries], 1)
        inputs = line.unfold(1, self.order, 1).transpose(2, 3).flatten(2)
        return inputs if context is None else torch.cat([inputs, self.features(context)], -1)

    def _parts(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log-weights `[..., K]`, means and log-stds `[..., K, D]` of the head's output (or bias)."""
        size, num = self.action_size, self.num_components
        weights = numbers[..., :num]
        means = numbers[..., num : num * (1 + size)].unflatten(-1, (num, size))
        return weights, means, numbers[..., num * (1 + size) :].unflatten(-1, (num, size))

    def _forecast(self, out: Tensor, inputs: Tensor) -> GaussianForecast:
        """The mixture for rows of the network's output `[M, width]` and input `[M, E]`."""
        weights, means, stds = self._parts(self.head(self.drop(out)))
        half = self.half_range
        mean = self.middle + half * (means + self.linear(inputs)[:, None])
        no_last = 1 - inputs[:, self.recent_size - 1, None, None]
        stds = stds + no_last * self.first_log_std
        std = half * (stds.clamp(-9, 3).exp() + 2 * MIN_STD)
        if not self.autoregressive_share:
            return GaussianForecast(mean, std, self.action_low, self.action_high, weights)
        linear_mean, linear_std, coupling = self.autoregression(inputs[:, : self.recent_size])
        mean = torch.cat([mean, (self.middle + half * linear_mean)[:, None]], 1)
        std = torch.cat([std, (half * linear_std)[:, None]], 1)
        weights = weights.log_softmax(-1) + log1p(-self.autoregressive_share)
        weights = functional.pad(weights, (0, 1), value=log(self.autoregressive_share))
        coupling = coupling * (half[:, None] / half)  # it is of dimensions in units of half the range
        return GaussianForecast(mean, std, self.action_low, self.action_high, weights, coupling)

    def fit(self, plans: VectorPlans, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Train with Lightning until the likelihood of held-out plans no longer rises; returns self.

        A prior that has learned before is trained further from its present weights. The autoregression is fitted anew,
        to all plans. Give the same held-out plans as `validation` each time: a share is drawn anew, so that the network
        would be judged on plans that it has learned from, and its weight would be too large.

        Args:
            plans: see `VectorPrior.fit`; at least two vectors.
            generator: draws the held-out plans, the order of training and dropout. Of very unequal plans the end of the
                longest is held out.
            settings: fields of `neuroprior.training.Settings`; what is not given is as in `DEFAULTS`, or as there.
                `max_steps` None is one step for `VECTORS_PER_STEP` vectors, from `MIN_STEPS` to `MAX_STEPS`.

        Raises:
            ValueError: plans that this prior cannot learn from, too few of them, a setting that is out of range,
                or a training that diverged.
        """
        from neuroprior.training import Settings, train  # lightning takes seconds to import: only where it is needed

        how, first = Settings(**(DEFAULTS | settings)), self.learns_anew
        action_names, memory = self.action_names, self.memory
        plans = self.training_plans(plans)
        if first:
            self._warn_of_wide_bounds(plans)
        if how.max_steps is None:
            how = replace(how, max_steps=min(max(int(plans.mask().sum()) // VECTORS_PER_STEP, MIN_STEPS), MAX_STEPS))
        seed = draw_seed(generator_on(generator, "cpu"))
        learning, validation = plans, how.validation
        self.memory = min(how.window, int(plans.mask().sum(1).max()))
        try:
            if not isinstance(validation, Sequences):
                learning, validation = held_out_split(plans, torch.Generator().manual_seed(seed), validation)
                if learning is validation:
                    raise ValueError("`plans` must have at least two vectors, one to be held out")
            elif isinstance(validation, VectorPlans):
                try:
                    validation = self.training_plans(validation)
                except ValueError as error:
                    raise ValueError(f"validation: {error}") from error
            check_alike(learning, validation)
        except ValueError:
            self.action_names, self.memory = action_names, memory  # what is refused is not learned from
            raise
        assert isinstance(validation, VectorPlans)  # as the plans that are learned from
        if first:
            self.features.learn_from(plans)
        chain = AutoregressivePrior(self.action_low, self.action_high)
        chain.orders = tuple(each for each in chain.orders if each <= min(self.order, self.memory))
        chain.fit(plans.without_context(), generator=torch.Generator().manual_seed(seed))
        self.autoregression.learn_from(chain)
        if first:
            self._begin()
        share, self.autoregressive_share = self.autoregressive_share, 0.0  # the network alone is trained
        try:
            train(self, learning, replace(how, validation=validation), seed)
        except BaseException:
            self.autoregressive_share = share
            raise
        self._mix(chain, validation)
        return self

    @torch.no_grad()
    def _mix(self, chain: AutoregressivePrior, held_out: VectorPlans) -> None:
        """Estimate the share of the autoregression from vectors that the network has not learned from."""
        mask = held_out.mask()
        both = self.action_log_probs(held_out), chain.action_log_probs(held_out.without_context())
        nats = torch.stack([each[mask].double() for each in both])
        log_shares = torch.full((2, 1), 0.5, dtype=torch.double).log().to(nats)
        for _ in range(EM_STEPS):
            taken = (nats + log_shares).softmax(0).nan_to_num().sum(1, keepdim=True) + PRIOR_VECTORS / 2
            log_shares = (taken / taken.sum()).log()
        self.autoregressive_share = float(log_shares[1].exp())

    def _warn_of_wide_bounds(self, plans: VectorPlans) -> None:
        """Warn where the bounds of a dimension are so wide that what vectors do in it is lost."""
        std = self.scaled(plans.actions)[plans.mask()].std(0, correction=0)
        lost = ((std > 0) & (std < MIN_SPREAD)).nonzero()[:, 0].tolist()
        if lost:
            d = lost[0]
            warnings.warn(
                f"dimension {d} has a standard deviation of {float(std[d] * self.half_range[d]):.2g} between bounds"
                f" {float(self.action_low[d]):.4g} and {float(self.action_high[d]):.4g}, of which a network learns"
                " little; give plans and prior narrower bounds",
                stacklevel=3,
            )

    @torch.no_grad()
    def _begin(self) -> None:
        """Take over the linear part and the standard deviations of the autoregression, before the first training."""
        chain = self.autoregression
        _, means, stds = self._parts(self.head.bias)
        share = FIRST_SPREAD if self.num_components > 1 else 0.0
        eye = torch.eye(self.action_size, device=chain.std.device)
        # Each dimension's spread, of the first vector and of those whose past is known.
        first, later = ((torch.linalg.inv(eye - chain.coupling[h]) * chain.std[h]).norm(dim=1) for h in (0, -1))
        self.first_log_std.copy_((first / later).log())
        spread = means.std(0, correction=0).clamp(min=MIN_DIVISOR)
        means.copy_((means - means.mean(0)) / spread * share * later + chain.offset[0])
        std = later * (1 - share**2) ** 0.5 - 2 * MIN_STD
        stds.copy_(std.clamp(min=MIN_STD).log().expand_as(stds))
        self._parts(self.head.weight.T)[1].mul_(later / (2 * FIRST_STD))
        linear = chain.weights[-1].unflatten(1, (-1, self.entry_size)).clone()
        linear[..., -1] = -(linear[..., :-1] @ chain.offset[0])  # vectors that are missing count as the mean
        linear[:, -1, -1] += chain.offset[-1] - chain.offset[0] - linear[..., -1].sum(1)
        self.linear.weight[:, : self.recent_size] += linear.flatten(1)
