"""Neural priors over vectors: a GRU and a transformer that predict the next vector as a mixture of Gaussians."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from math import log, log1p
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuroprior._checks import check_memory, check_seed, check_sizes, is_number
from neuroprior._compiled import compiled
from neuroprior._random import draw_seed, generator_on
from neuroprior.control.priors.autoregressive import AutoregressivePrior
from neuroprior.control.priors.linear_gaussian import LinearTables, held_out_split
from neuroprior.control.priors.vector_prior import GaussianForecast, VectorPrior
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.plans.folds import check_alike
from neuroprior.plans.sequences import Sequences
from neuroprior.priors.neural.cuda_graphs import run_recorded
from neuroprior.priors.neural.features import Standardise
from neuroprior.priors.neural.gru import gru_step
from neuroprior.priors.neural.neural import training_settings
from neuroprior.priors.neural.transformer import Block

LEAST_STD = 1e-3
"""The least standard deviation of a component, as a share of the range between the bounds."""

FIRST_STD = 0.15
"""Standard deviation of each component before training, as a share of the range."""

FIRST_SPREAD = 0.5
"""Standard deviation of the components' means before training, so that they differ, as a share of the mixture's."""

TINY = 1e-9
"""Instead of 0, where a number is divided by."""

EVEN, ROUNDS = 1, 100
"""Held-out vectors that equal shares of the network and the autoregression count for when these are estimated, and the
steps of EM for that."""

DEFAULTS = {"window": 64, "learning_rate": 3e-3}
"""Settings of a training, where they are not given."""

FEWEST, MOST, VECTORS_A_STEP = 300, 4000, 40
"""Steps of a training, where these are not given: one for so many vectors, within these bounds. More steps overfit some
thousand vectors before the learning rate has fallen."""


class Autoregression(nn.Module):
    """An `AutoregressivePrior` as a network reads it: linear in the last `lags` vectors, of which some may be missing.

    Row h of each table is for h known vectors, in units of half the range from its middle.

    Args:
        lags: vectors that predictions depend on, at most.
        size: D.
    """

    weights: Tensor
    """`[lags + 1, D, lags * (D + 1)]`, of inputs as `VectorNetwork` makes them."""

    offset: Tensor
    """`[lags + 1, D]`."""

    std: Tensor
    """`[lags + 1, D]`."""

    coupling: Tensor
    """`[lags + 1, D, D]`, strictly lower triangular."""

    def __init__(self, lags: int, size: int) -> None:
        super().__init__()
        shapes = ((size, lags * (size + 1)), (size,), (size,), (size, size))
        for name, shape in zip(LinearTables._fields, shapes, strict=True):
            self.register_buffer(name, torch.full((lags + 1, *shape), float(name == "std")))

    def learn_from(self, chain: AutoregressivePrior) -> None:
        """Take over an autoregression of at most `lags` vectors."""
        size, order = self.offset.shape[1], len(chain.offset) - 1
        rows = torch.arange(len(self.offset), device=self.offset.device).clamp(max=order)
        for name in ("offset", "std", "coupling"):
            getattr(self, name).copy_(getattr(chain, name)[rows])
        weights = chain.weights[rows].unflatten(1, (order, size)).permute(0, 3, 1, 2)
        self.weights.zero_()
        if order:
            self.weights.unflatten(2, (-1, size + 1))[:, :, -order:, :size] = weights

    def forward(self, recent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean and std `[M, D]` and coupling `[M, D, D]` after inputs `[M, lags * (D + 1)]`."""
        lags, size = len(self.offset) - 1, self.offset.shape[1]
        known = recent.unflatten(1, (lags, size + 1))[..., -1].sum(1).long()
        means = (recent @ self.weights.flatten(0, 1).T).unflatten(1, (lags + 1, size)) + self.offset
        mean = means.take_along_dim(known[:, None, None], 1)[:, 0]
        return mean, self.std[known], self.coupling[known]


class VectorNetwork(VectorPrior):
    """A network that predicts the next vector as a mixture of K censored Gaussians (Bishop 1994).

    At each step the network reads the last `lags` vectors, scaled by the bounds to -1..1, and the features of the state
    where it takes them, standardised (`neuroprior.priors.neural.features.Standardise`). The
    means of all components have a common part that is linear in these inputs; the rest of the means, the weights and
    the standard deviations are the network's; those of a plan's first vector have factors of their own. Training begins
    with the linear part and the standard deviations of an `AutoregressivePrior` of at most `order` vectors.

    From few vectors a network learns little that is better, and is sometimes far too sure. After training the
    autoregression is therefore one more component of the mixture, with a constant weight that held-out vectors choose.
    The autoregression has learned from these, too, which favours it: with few vectors its weight is about one half, and
    next to nothing where the network predicts many vectors better.

    Plans longer than `Settings.window` (64 where it is not given) are read window by window in training, the hidden
    state carried over, and in use it runs on without limit. To read a past, see `read`, the network begins at most
    `memory` vectors before its end: the training window, which bounds the time that a decision takes.

    `state` is `[N, H + E]`: the H numbers that the network carries along, and the E of its next input.

    A subclass writes `build` and `encode`.

    Args:
        action_low, action_high, context_size: see `VectorPrior`.
        width: of the network's vectors.
        num_layers: number of layers.
        num_components: K.
        lags: last vectors that each input shows the network directly.
        coupled: within a component, each dimension depends on those before it, in the same way at all times; otherwise
            they are independent. (With some thousand vectors, couplings that the network itself predicts are
            overfitted.)
        dropout: share of the network's activations that is set to 0 at random in training.
        seed: draws the initial weights; torch's global generator is left alone.
        order: last vectors that the autoregression reads, at most (and at most `memory`), and the linear part.

    Attributes:
        memory: vectors read at once in training; None before `fit`.
        autoregressive_share: weight of the autoregression in the mixture; 0 before `fit`.

    Raises:
        ValueError: an argument is out of range.
    """

    later: ClassVar[Mapping[str, float]] = {
        "first_log_std": 0.0,
        "features.most": torch.inf,
        **{f"autoregression.{name}": float(name == "std") for name in LinearTables._fields},
    }
    renamed: ClassVar[Mapping[str, str]] = {"_mean": "features.mean", "_std": "features.std"}

    def __init__(
        self,
        action_low: Any,
        action_high: Any,
        context_size: int | None = None,
        width: int = 64,
        num_layers: int = 1,
        num_components: int = 5,
        lags: int = 1,
        coupled: bool = False,
        dropout: float = 0.1,
        seed: int = 0,
        order: int = 8,
    ) -> None:
        super().__init__(action_low, action_high, context_size)
        check_sizes(width=width, num_layers=num_layers, num_components=num_components, lags=lags, order=order)
        check_memory(48 * num_layers * width**2, num_layers=num_layers, width=width)
        if not is_number(dropout) or not 0 <= dropout < 1:
            raise ValueError(f"dropout: a share from 0 to below 1 is expected, not {dropout!r}")
        check_seed(seed)
        self.width, self.num_layers, self.num_components = width, num_layers, num_components
        self.lags, self.order, reach = lags, order, max(lags, order)
        self.coupled, self.dropout = coupled, dropout
        size, features = self.action_size, context_size or 0
        self.entry_size = size + 1
        self.recent_size = reach * self.entry_size
        self.input_size = self.recent_size + features
        check_memory(4 * self.input_size * (width + reach * size), width=width, lags=lags, order=order)
        self.features = Standardise(features)
        self.coupling = nn.Parameter(torch.zeros(size, size)) if coupled else None
        self.autoregression, self.autoregressive_share = Autoregression(reach, size), 0.0
        self.first_log_std = nn.Parameter(torch.zeros(size))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.inputs = nn.Linear(lags * self.entry_size + features, width)
            self.drop = nn.Dropout(dropout)
            self.build()
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
        names = ("width", "num_layers", "num_components", "lags", "order", "coupled", "dropout")
        return super().config | {name: getattr(self, name) for name in names}

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"memory": self.memory, "autoregressive_share": self.autoregressive_share}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        memory = learned["memory"]
        if memory is not None:
            check_sizes(memory=memory)
        self.memory = memory
        share = learned.get("autoregressive_share", 0.0)  # which older files do not have
        if not is_number(share) or not 0 <= share < 1:
            raise ValueError(f"autoregressive_share: a share from 0 to below 1 is expected, not {share!r}")
        self.autoregressive_share = float(share)

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *args: Any) -> None:
        name = f"{prefix}linear.weight"
        if name in state_dict and f"{prefix}autoregression.weights" not in state_dict:
            # That of older files reads no more than `lags` vectors.
            missing = max(self.input_size - state_dict[name].shape[-1], 0)
            state_dict[name] = functional.pad(state_dict[name], (missing, 0))
        super()._load_from_state_dict(state_dict, prefix, *args)

    @property
    def learns_anew(self) -> bool:
        return self.memory is None

    @abstractmethod
    def build(self) -> None:
        """Make the layers."""

    @abstractmethod
    def encode(self, vectors: Tensor, hidden: Tensor | None) -> tuple[Tensor, Tensor]:
        """Read a sequence.

        Args:
            vectors: `[N, T, width]`.
            hidden: `[N, H]`, after the vectors before these; None: there are none.

        Returns:
            What the forecasts are made of, `[N, T, width]`, and `hidden` `[N, H']` after the last vector.
        """

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        none = torch.zeros(batch_size, 1, self.recent_size, device=self.device)
        features = self._features(context)
        return self._after(none if features is None else torch.cat([none, features[:, None]], -1))

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        size, last = self.recent_size, state.shape[1] - self.input_size
        kept, features = state[:, last + self.entry_size : last + size], self._features(context)
        if features is None:
            features = state[:, last + size :]
        return self._after(torch.cat([kept, self._entries(action), features], 1)[:, None], state[:, :last])

    def read(self, past: Tensor, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        return self._after(self._inputs(past, context))

    def _inputs(self, past: Tensor, context: Tensor | None) -> Tensor:
        """The inputs `[N, T, E]` that `past` and `context` are read as."""
        # A past as long as `memory` may be the end of a longer one, and is read as such.
        whole = self.memory is None or past.shape[1] < self.memory
        entries = self._entries(past if whole else past[:, past.shape[1] - (self.memory or 0) :])
        if whole:
            entries = functional.pad(entries, (0, 0, 1, 0))
        if context is not None and context.dim() == 3:
            context = context[:, context.shape[1] - entries.shape[1] :]
        return self._lagged(entries, None, context)

    def continuations(
        self, num_plans: int, length: int, past: Tensor, context: Tensor | None, generator: torch.Generator
    ) -> Tensor:
        inputs, number = self._inputs(past, context), len(past) * num_plans
        # All random numbers at once, so that compiled loops draw the same.
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
        forecast, state = self._after(inputs)
        each = len(noise) // max(len(inputs), 1)
        first = forecast.repeat_interleave(each).drawn(uniform[:, 0], noise[:, 0])
        rest = self._rest(first, state.repeat_interleave(each, 0), uniform[:, 1:], noise[:, 1:])
        return torch.cat([first[:, None], rest], 1)

    def _rest(self, last: Tensor, state: Tensor, uniform: Tensor, noise: Tensor) -> Tensor:
        """The vectors `[N, T, D]` after `last [N, D]`."""
        vectors = noise.clone()
        for t in range(noise.shape[1]):
            last, state = self._drawn(last, state, uniform[:, t], noise[:, t])
            vectors[:, t] = last
        return vectors

    def _drawn(self, last: Tensor, state: Tensor, uniform: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """The next vectors `[N, D]`, and the state before them."""
        forecast, state = self.step(last, state)
        return forecast.drawn(uniform, noise), state

    def _after(self, inputs: Tensor, hidden: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        """The distribution after the last of `inputs [N, T, E]`, and the state."""
        out, hidden = self.encode(self._taken_in(inputs), hidden)
        return self._forecast(out[:, -1], inputs[:, -1]), torch.cat([hidden, inputs[:, -1]], 1)

    def _taken_in(self, inputs: Tensor) -> Tensor:
        """What the network reads, `[N, T, width]`, of `inputs [N, T, E]`: the last `lags` vectors and the features."""
        taken_in: Tensor = self.drop(self.inputs(inputs[..., self.recent_size - self.lags * self.entry_size :]))
        return taken_in

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
        inputs = self._lagged(entries, state, context)
        out, hidden = self.encode(
            self._taken_in(inputs), None if state is None else state[:, : state.shape[1] - self.input_size]
        )
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
            part = context[:, now] if context is not None and context.dim() == 3 else context
            nats, state = self.log_probs_from(actions[:, now], part, actions[:, first - 1] if first else None, state)
            parts.append(nats)
        return torch.cat(parts, 1).masked_fill(~plans.mask(), 0)

    def _features(self, context: Tensor | None) -> Tensor | None:
        """Standardised features."""
        return None if context is None else self.features(context)

    def _entries(self, actions: Tensor) -> Tensor:
        """`[..., D + 1]`: vectors scaled to -1..1, and a 1; only zeros stand for no vector."""
        return functional.pad((actions - self.middle) / self.half_range, (0, 1), value=1.0)

    def _lagged(self, entries: Tensor, state: Tensor | None, context: Tensor | None) -> Tensor:
        """The inputs `[N, T, E]`: the last of `entries [N, T, D + 1]` and the features before each vector."""
        inputs, features = entries, self._features(context)
        reach = self.recent_size // self.entry_size
        if reach > 1:
            before = entries.new_zeros(len(entries), reach - 1, self.entry_size)
            if state is not None:
                last = state.shape[1] - self.input_size
                before = state[:, last + self.entry_size : last + self.recent_size].reshape(before.shape)
            inputs = torch.cat([before, entries], 1).unfold(1, reach, 1).transpose(2, 3).flatten(2)
        if features is None:
            return inputs
        if features.dim() == 2:
            features = features[:, None].expand(-1, inputs.shape[1], -1)
        return torch.cat([inputs, features], -1)

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
        relative = half[:, None] / half  # couplings are of dimensions in units of half the range
        mean = self.middle + half * (means + self.linear(inputs)[:, None])
        no_last = 1 - inputs[:, self.recent_size - 1, None, None]
        stds = stds + no_last * self.first_log_std
        std = half * (stds.clamp(-9, 3).exp() + 2 * LEAST_STD)
        coupling = None if self.coupling is None else self.coupling.tril(-1) * relative
        if self.autoregressive_share:
            linear_mean, linear_std, linear_coupling = self.autoregression(inputs[:, : self.recent_size])
            mean = torch.cat([mean, (self.middle + half * linear_mean)[:, None]], 1)
            std = torch.cat([std, (half * linear_std)[:, None]], 1)
            weights = weights.log_softmax(-1) + log1p(-self.autoregressive_share)
            weights = functional.pad(weights, (0, 1), value=log(self.autoregressive_share))
            linear_coupling = (linear_coupling * relative)[:, None]
            if coupling is None:
                coupling = linear_coupling
            else:
                own = coupling.expand(len(mean), self.num_components, *coupling.shape)
                coupling = torch.cat([own, linear_coupling], 1)
        return GaussianForecast(mean, std, self.action_low, self.action_high, weights, coupling)

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return training_settings()

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
                `max_steps` None is one step for `VECTORS_A_STEP` vectors, from `FEWEST` to `MOST`.

        Raises:
            ValueError: plans that this prior cannot learn from, too few of them, a setting that is unknown or out of
                range, or a training that diverged.
        """
        self.check_settings(settings)
        from neuroprior.training import Settings, train  # lightning takes seconds to import: only where it is needed

        how, first = Settings(**(DEFAULTS | settings)), self.learns_anew
        known, memory = self.action_names, self.memory
        plans = self.training_plans(plans)
        if first:
            self.warn_if_coarse(plans)
        if how.max_steps is None:
            how = replace(how, max_steps=min(max(int(plans.mask().sum()) // VECTORS_A_STEP, FEWEST), MOST))
        seed = draw_seed(generator_on(generator, "cpu"))
        learning, validation = plans, how.validation
        self.memory = min(how.window, int(plans.mask().sum(1).max()))
        try:
            if not isinstance(validation, Sequences):
                learning, validation = held_out_split(plans, torch.Generator().manual_seed(seed), validation)
                if learning is validation:
                    raise ValueError("plans: at least two vectors are expected, one to be held out")
            elif isinstance(validation, VectorPlans):
                try:
                    validation = self.training_plans(validation)
                except ValueError as error:
                    raise ValueError(f"validation: {error}") from error
            check_alike(learning, validation)
        except ValueError:
            self.action_names, self.memory = known, memory  # what is refused is not learned from
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
        for _ in range(ROUNDS):
            taken = (nats + log_shares).softmax(0).nan_to_num().sum(1, keepdim=True) + EVEN / 2
            log_shares = (taken / taken.sum()).log()
        self.autoregressive_share = float(log_shares[1].exp())

    @torch.no_grad()
    def _begin(self) -> None:
        """Take over the linear part and the standard deviations of the autoregression, before the first training."""
        chain, recent = self.autoregression, self.recent_size
        _, means, stds = self._parts(self.head.bias)
        share = FIRST_SPREAD if self.num_components > 1 else 0.0
        eye = torch.eye(self.action_size, device=chain.std.device)
        # Roots of the covariances of the first vector, and of those whose past is known.
        first, root = (torch.linalg.inv(eye - chain.coupling[h]) * chain.std[h] for h in (0, -1))
        if self.coupling is None:
            root = root.norm(dim=1).diag()  # each dimension's own spread, not what the others leave of it
        else:
            first = (eye - chain.coupling[-1]) @ first  # what the same coupling leaves of the first vector's
        self.first_log_std.copy_((first.norm(dim=1) / root.diagonal()).log())
        means.copy_((means - means.mean(0)) / means.std(0, correction=0).clamp(min=TINY) @ (share * root.T))
        own = root.diagonal() * (1 - share**2) ** 0.5 - 2 * LEAST_STD
        stds.copy_(own.clamp(min=LEAST_STD).log().expand_as(stds))
        weights = self._parts(self.head.weight.T)[1]
        weights.copy_(weights @ (root.T / (2 * FIRST_STD)))
        linear = chain.weights[-1].unflatten(1, (-1, self.entry_size)).clone()
        linear[..., -1] = -(linear[..., :-1] @ chain.offset[0])  # vectors that are missing count as the mean
        linear[:, -1, -1] += chain.offset[-1] - chain.offset[0] - linear[..., -1].sum(1)
        self.linear.weight[:, :recent] += linear.flatten(1)
        means += chain.offset[0]
        if self.coupling is not None:
            self.coupling.add_(chain.coupling[-1])


class VectorGRU(VectorNetwork):
    """A gated recurrent network (Cho et al. 2014) over vectors.

    Args:
        action_low, action_high, context_size: see `VectorPrior`.
        width, num_layers, num_components, lags, coupled, dropout, seed, order: see `VectorNetwork`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> prior = VectorGRU([-1.0], [1.0], width=4)  # prior.fit(plans) trains it
        >>> prior.sample(3, 5).shape
        torch.Size([1, 3, 5, 1])
    """

    def build(self) -> None:
        self.gru = nn.GRU(self.width, self.width, self.num_layers, batch_first=True)

    def encode(self, vectors: Tensor, hidden: Tensor | None) -> tuple[Tensor, Tensor]:
        if hidden is None:
            hidden = vectors.new_zeros(len(vectors), self.num_layers * self.width)
        layers = hidden.unflatten(1, (self.num_layers, self.width)).transpose(0, 1)
        if vectors.shape[1] == 1 and not (self.training or torch.is_grad_enabled()):
            out, layers = gru_step(self.gru, vectors[:, 0], layers)
            out = out[:, None]
        else:
            out, layers = self.gru(vectors, layers.contiguous())
        return out, layers.transpose(0, 1).flatten(1)

    def draw(self, inputs: Tensor, uniform: Tensor, noise: Tensor) -> Tensor:
        able = not self.training and inputs.device.type == "cpu" and inputs.dtype == torch.float32
        fast = compiled("neuroprior.control.priors.compiled_sampling") if able else None
        if fast is None:
            return super().draw(inputs, uniform, noise)
        plans: Tensor = fast.draw_recurrent(self, 2 * LEAST_STD, inputs, uniform, noise)
        return plans

    def _rest(self, last: Tensor, state: Tensor, uniform: Tensor, noise: Tensor) -> Tensor:
        numbers, key = (uniform.transpose(0, 1), noise.transpose(0, 1)), self.autoregressive_share
        recorded = run_recorded(self, self._drawn, last, state, numbers, key) if type(self) is VectorGRU else None
        return super()._rest(last, state, uniform, noise) if recorded is None else recorded.transpose(0, 1)


class VectorTransformer(VectorNetwork):
    """A transformer with rotary positions over vectors; each layer attends at most `memory` inputs back.

    `state` holds the keys and values of the last `memory` inputs, `2 * num_layers * width` numbers each.

    Args:
        action_low, action_high, context_size: see `VectorPrior`.
        width: a multiple of 2 * `num_heads`.
        num_heads: attention heads.
        num_layers, num_components, lags, coupled, dropout, seed, order: see `VectorNetwork`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> prior = VectorTransformer([-1.0], [1.0], width=8)  # prior.fit(plans) trains it
        >>> prior.sample(3, 5).shape
        torch.Size([1, 3, 5, 1])
    """

    def __init__(
        self,
        action_low: Any,
        action_high: Any,
        context_size: int | None = None,
        width: int = 64,
        num_layers: int = 2,
        num_heads: int = 4,
        num_components: int = 5,
        lags: int = 1,
        coupled: bool = False,
        dropout: float = 0.1,
        seed: int = 0,
        order: int = 8,
    ) -> None:
        check_sizes(num_heads=num_heads, width=width)
        if width % (2 * num_heads):
            raise ValueError(f"width: a multiple of 2 * num_heads = {2 * num_heads} is expected, not {width}")
        self.num_heads = num_heads
        super().__init__(
            action_low,
            action_high,
            context_size,
            width,
            num_layers,
            num_components,
            lags,
            coupled,
            dropout,
            seed,
            order,
        )

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"num_heads": self.num_heads}

    def build(self) -> None:
        self.blocks = nn.ModuleList(Block(self.width, self.num_heads, self.dropout) for _ in range(self.num_layers))
        self.norm = nn.LayerNorm(self.width)

    def encode(self, vectors: Tensor, hidden: Tensor | None) -> tuple[Tensor, Tensor]:
        past = None
        if hidden is not None:
            numbers = self.num_layers * 2 * self.width
            past = hidden.view(len(hidden), hidden.shape[1] // numbers, self.num_layers, 2 * self.width)
        caches = []
        for layer, block in enumerate(self.blocks):
            vectors, cache = block(vectors, None if past is None else past[:, :, layer], self.memory)
            caches.append(cache)
        return self.norm(vectors), torch.stack(caches, 2).flatten(1)
