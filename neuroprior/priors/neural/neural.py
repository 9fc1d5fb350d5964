"""The base of the neural priors: inputs, the window beyond the training length, and fitting."""

from abc import abstractmethod
from dataclasses import fields, replace
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor, nn

from neuroprior._checks import check_count, check_memory, check_seed, check_sizes, is_number
from neuroprior._random import draw_seed, generator_on
from neuroprior.plans import Plans
from neuroprior.plans.folds import check_alike
from neuroprior.plans.plans import as_single
from neuroprior.priors.learning import training_plans, validation_plans
from neuroprior.priors.neural.features import Standardise
from neuroprior.priors.prior import Prior
from neuroprior.sampling.states import State

CONTEXT_SPREAD = 0.03
"""Standard deviation of contexts' initial vectors. With 1, as for other embeddings, small data sets are overfitted."""

LAG_WIDTH = 16
"""Size of the embedding of each of the last actions."""

SHORT = 32
"""Plans of at most so many actions are short: each input shows a network the last actions directly."""

FEW = 20_000
"""Plans of fewer actions than this, in all, are learned by a small network."""

KINDS = 16
"""With more different actions than this, a large network predicts better."""


MAX_LAYERS = 1000
"""More take long to make, whatever their width."""


class Sizes(NamedTuple):
    """What a network is made with, where it is not given.

    Attributes:
        width: of its hidden state and vectors.
        lags: past actions that each input shows directly.
        dropout: share of activations that is set to 0 in training.
        num_layers: of a recurrent network.
    """

    width: int = 64
    lags: int = 16
    dropout: float = 0.0
    num_layers: int = 1

    @classmethod
    def of(cls, plans: Plans) -> "Sizes":
        """Those with which networks predict plans like these best; see `python -m eval quality`.

        Short plans are learned exactly: a small network, without dropout unless they are few. In long sequences a wider
        and deeper network with dropout finds more, and is overfitted less by what it has to carry itself than by the
        last actions shown to it directly.
        """
        few = int(plans.mask().sum()) < FEW
        if plans.max_length <= SHORT:
            return cls(dropout=0.2 if few else 0.0)
        if few or plans.num_actions <= KINDS:
            return cls(64 if few else 128, 1, 0.3, 2)
        return cls(256, 1, 0.4, 2)


def check_layers(num_layers: int, size: int) -> None:
    """Raise ValueError unless a network can have so many layers, of `size` bytes each."""
    if num_layers > MAX_LAYERS:
        raise ValueError(f"`num_layers` must be at most {MAX_LAYERS}, got {num_layers}")
    check_memory(size * num_layers, num_layers=num_layers)


class NeuralPrior(Prior):
    """A network over (last action, context) inputs; the first input is a start symbol.

    Beyond the training length a network meets positions and hidden states that it was not trained on. What it reads of
    the past is therefore bounded by `window`: with plans of length T in training, `window = T - 1`, the most actions
    that preceded any other there. A recurrent network carries its hidden state on, and is shown no lag beyond `window`;
    a transformer attends to the last `window` inputs and the start symbol, at the distances that it was trained on. Up
    to length T this changes nothing, and a step past it costs no more than one before. (`python -m pytest -m slow -k
    past_the_training_length -s` compares its predictions with those from reading the last `window` actions anew.) After
    training on plans of one action, each action is predicted as the first.

    Plans longer than the training window (`Settings.window`) are read in consecutive windows in training, the hidden
    state carried from each to the next (truncated backpropagation through time). A prior trained in this way carries
    its hidden state on in use as well, without limit.

    In this class "hidden" is what the network carries along a sequence, a tensor or a tuple of tensors, each with N
    rows: the hidden state of a recurrent network, the key-value cache of a transformer. It is the prior's `state`; that
    of a prior with a context is the last context, which may go on, and it.

    A subclass writes `build` and `encode`.

    Args:
        num_actions: A.
        width: of the network's vectors, and of its hidden state.
        window: past actions up to which it is trained; None: set by `fit`, and no limit before that.
        lags: past actions that each input shows to the network directly; see `Embedding`.
        dropout: share of the network's activations that is set to 0 at random in training.
        num_contexts, context_size: see `Prior`.
        seed: draws the initial weights; torch's global generator is left alone.
        num_layers: number of layers; None: chosen by `fit`.

    Raises:
        ValueError: an argument is out of range.
    """

    actions_at_once = 2**18
    shares_steps = True

    def __init__(
        self,
        num_actions: int,
        width: int | None,
        window: int | None,
        lags: int | None,
        dropout: float | None,
        num_contexts: int | None,
        context_size: int | None,
        seed: int,
        num_layers: int | None = 1,
    ) -> None:
        super().__init__(num_actions, num_contexts, context_size)
        if window is not None:
            check_count("window", window, 0)
        if dropout is not None and (not is_number(dropout) or not 0 <= dropout < 1):
            raise ValueError(f"`dropout` must be a share from 0 to below 1, got {dropout!r}")
        check_seed(seed)
        self._given_window = self.window = window
        check_sizes(lags=1 if lags is None else lags)
        self._fixed_sizes = (width, lags, dropout, num_layers)
        self._seed, self.sized = seed, False
        self._make(Sizes())

    def _make(self, sizes: Sizes) -> None:
        """Make the layers, with the sizes that were given and these where none were."""
        pairs = zip(self._fixed_sizes, sizes, strict=True)
        width, lags, dropout, num_layers = (size if fixed is None else fixed for fixed, size in pairs)
        self.width, self.lags, self.dropout, self.num_layers = int(width), int(lags), float(dropout), int(num_layers)
        check_layers(self.num_layers, 24 * self.width**2)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self._seed)
            self.build()
        self.to(self.device).eval()

    @property
    def config(self) -> dict[str, Any]:
        sizes = self.arguments()
        return super().config | {"window": self._given_window, "lags": sizes["lags"], "dropout": sizes["dropout"]}

    def arguments(self) -> dict[str, Any]:
        """The sizes, by name; before it learns, which chooses what was not given, as they were given, and the seed."""
        if self.sized:
            return {name: getattr(self, name) for name in Sizes._fields}
        return dict(zip(Sizes._fields, self._fixed_sizes, strict=True)) | {"seed": self._seed}

    @property
    def learned(self) -> dict[str, Any]:
        sizes = [self.width, self.lags, self.dropout, self.num_layers] if self.sized else None
        return super().learned | {"window": self.window, "sizes": sizes}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        window = learned["window"]
        if window is not None:
            check_count("window", window, 0)
        self.window = window
        sizes = learned.get("sizes")
        if sizes is not None:
            self.sized = True  # to `fit` again goes on from the weights that are loaded next
            if None in self._fixed_sizes:
                self._make(Sizes(*sizes))

    def sizes_for(self, plans: Plans) -> Sizes:
        """What is chosen for plans to learn from, where it was not given."""
        return Sizes.of(plans)

    @abstractmethod
    def build(self) -> None:
        """Make the layers."""

    @abstractmethod
    def encode(self, previous: Tensor, context: Tensor | None, hidden: State | None = None) -> tuple[Tensor, State]:
        """Read a sequence.

        Args:
            previous: int64 `[N, T]`: the action before each step, A for none.
            context: `[N, T]` or `[N, T, C]`; None for a prior without context.
            hidden: after the steps before these; None: there are none.

        Returns:
            Logits `[N, T, A]`, and `hidden` after the last step.
        """

    def set_training_window(self, window: int | None) -> None:
        """Prepare for training in windows of so many actions, after which the hidden state is carried on without limit.

        Args:
            window: in actions; None: plans are trained on whole, which changes nothing.

        Raises:
            ValueError: this prior was made with a window of its own.
        """
        if window is None:
            return
        if self._given_window is not None:
            raise ValueError(
                f"window: this prior reads {self._given_window} past actions, but plans of more than {window} are"
                " trained on with the hidden state carried over; train with a window as long as the plans, or make the"
                " prior without one"
            )
        self.window = None

    @torch.no_grad()
    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_start(batch_size, context)
        return self._read(torch.full((batch_size,), self.num_actions, device=self.device), context, None)

    @torch.no_grad()
    def step(self, action: Tensor, state: State, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_step(action, context)
        last, hidden = state if self.takes_context else (None, state)
        return self._read(action.long(), last if context is None else context, None if self.window == 0 else hidden)

    def _read(self, previous: Tensor, context: Tensor | None, hidden: State | None) -> tuple[Tensor, State]:
        """Logits `[N, A]` after actions `previous [N]`, and the prior's state."""
        context = None if context is None else as_single(context.detach())
        step_context = None if context is None else context[:, None]
        logits, hidden = self.encode(self._visible_actions(previous)[:, None], step_context, hidden)
        return logits[:, 0], (context, hidden) if self.takes_context else hidden

    def _visible_actions(self, previous: Tensor) -> Tensor:
        """The actions before steps `[...]` as the network is shown them: with a window of 0, none."""
        return torch.full_like(previous, self.num_actions) if self.window == 0 else previous

    @property
    def is_plain(self) -> bool:
        """Whether it is of a class of this library, reads past actions, and has no hooks."""
        from_library = type(self).__module__.startswith(f"{__package__}.")
        hooks = (module._forward_hooks or module._forward_pre_hooks for module in self.modules())
        return from_library and self.window != 0 and not any(hooks)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        if plans.shape[1] == 0:
            return torch.zeros(*plans.shape, self.num_actions, device=self.device)
        previous = self._previous(plans, None)
        if self.window == 0:  # each action is the first of a plan
            flat_context = None if context is None else context.flatten(0, 1)[:, None]
            return self.encode(previous.flatten()[:, None], flat_context)[0].view(*plans.shape, self.num_actions)
        return self.encode(previous, context)[0]

    def forward_from(
        self,
        plans: Tensor,
        context: Tensor | None = None,
        previous: Tensor | None = None,
        hidden: State | None = None,
    ) -> tuple[Tensor, State]:
        """The logits of actions that continue a sequence; training in windows calls this.

        Args:
            plans: integers `[N, L]`, L > 0.
            context: None, or one a step.
            previous: integers `[N]`: the action before the first (A for none); None: there is none.
            hidden: as the last call returned it; None: nothing was read before.

        Returns:
            Logits `[N, L, A]`, and `hidden` after these plans.
        """
        return self.encode(self._previous(plans, previous), context, hidden)

    def _previous(self, plans: Tensor, first: Tensor | None) -> Tensor:
        """The action before each of `plans [N, L]`, int64; before the first, `first [N]` or none."""
        shifted = nn.functional.pad(plans.long(), (1, 0), value=self.num_actions)[:, :-1]
        if first is not None:
            shifted = torch.cat([first[:, None].long(), shifted[:, 1:]], 1)
        return self._visible_actions(shifted)

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return training_settings()

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Train with Lightning until the loss on held-out plans no longer falls; returns self.

        A prior that has learned before is trained further from its present weights.

        Args:
            plans: `Plans`, or integers `[N, L]` for plans without context.
            generator: draws the held-out plans, the order of training and dropout.
            settings: fields of `neuroprior.training.Settings`, such as `max_steps=500` or `progress=False`.

        Raises:
            ValueError: plans that this prior cannot learn from, too few of them, a setting that is unknown or out of
                range, or a training that diverged.
        """
        self.check_settings(settings)
        from neuroprior.training import Settings, train  # lightning takes seconds to import: only where it is needed

        how = Settings(**settings)
        if isinstance(how.validation, Plans):  # refused before anything is kept of the plans
            validation = validation_plans(self, how.validation)
            check_alike(validation_plans(self, plans), validation)
            how = replace(how, validation=validation)
        plans = self.prepare(plans, how.window)
        train(self, plans, how, draw_seed(generator_on(generator, "cpu")))
        return self

    def prepare(self, plans: Plans | Tensor, window: int) -> Plans:
        """The plans to train on, in windows of so many actions; sets the window in which the prior will read.

        What was not given of the network's sizes is chosen when it first learns; see `Sizes`.

        Raises:
            ValueError: plans that this prior cannot learn from, or too few of them.
        """
        plans = training_plans(self, plans, further=self.sized)
        plans = plans[plans.mask().any(1)]
        if None in self._fixed_sizes and not self.sized:
            self._make(self.sizes_for(plans))
        for module in () if self.sized else self.modules():
            if isinstance(module, Standardise):
                module.learn_from(plans)
        lengths = plans.mask().sum(1)
        if len(plans) < 2 and int(lengths.sum()) < 2:
            raise ValueError("plans: a neural prior needs at least two actions to learn from, beside those held out")
        self.sized = True
        longest = int(lengths.max())
        self.set_training_window(window if longest > window else None)
        if longest <= window and self._given_window is None:
            self.window = longest - 1
        return plans


def training_settings() -> tuple[str, ...]:
    """The names of the settings that `fit` of every network takes."""
    from neuroprior.training.settings import Settings  # see `NeuralPrior.fit`

    return tuple(field.name for field in fields(Settings))


def context_embedding(num_contexts: int, width: int) -> nn.Embedding:
    """An embedding of contexts that is initialised close to 0, so that contexts differ only where plans show it."""
    embedding = nn.Embedding(num_contexts, width)
    nn.init.normal_(embedding.weight, std=CONTEXT_SPREAD)
    return embedding


class Embedding(nn.Module):
    """Actions `[N, T]` and contexts `[N, T]` or `[N, T, C]` to vectors `[N, T, width]`.

    Each vector is the sum of an embedding of the previous action, of the context, and of a causal convolution over the
    last `lags` actions, each embedded in `LAG_WIDTH` numbers: what depends on the k-th last action can be read off
    directly, without recurrence or attention. Features are standardised first; see `Standardise`.
    """

    def __init__(
        self, num_actions: int, width: int, lags: int, num_contexts: int | None, context_size: int | None
    ) -> None:
        super().__init__()
        check_memory(4 * (num_actions + 1) * width, num_actions=num_actions, width=width)
        check_memory(4 * LAG_WIDTH * width * lags, lags=lags, width=width)
        for name, number in (("num_contexts", num_contexts), ("context_size", context_size)):
            check_memory(4 * width * (number or 0), **{name: number, "width": width})
        self.lags, self.nothing = lags, num_actions + 1
        self.action = nn.Embedding(num_actions + 1, width)
        self.past = nn.Embedding(num_actions + 2, LAG_WIDTH, padding_idx=self.nothing) if lags > 1 else None
        self.mix = nn.Conv1d(LAG_WIDTH, width, lags, bias=False) if lags > 1 else None
        self.index = None if num_contexts is None else context_embedding(num_contexts, width)
        self.features = None if context_size is None else nn.Linear(context_size, width)
        self.scale = None if context_size is None else Standardise(context_size)

    def forward(
        self, previous: Tensor, context: Tensor | None, recent: Tensor | None, window: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """The vectors, and the last `lags` - 1 actions.

        Args:
            previous, context: see `NeuralPrior.encode`.
            recent: int64 `[N, lags - 1]`: the actions before these; None: there were none.
            window: past actions that were shown in training, at most. Lags further back have no weight: there the last
                input of a plan's window is the start symbol, as it was in training.
        """
        vectors: Tensor = self.action(previous)
        if recent is None:
            recent = previous.new_full((len(previous), self.lags - 1), self.nothing)
        line = torch.cat([recent, previous], 1)
        if self.past is not None and self.mix is not None:
            taps = self.lags if window is None else min(window, self.lags)
            weight, beyond = self.mix.weight[..., self.lags - taps :], self.lags - taps
            past = self.past(line[:, beyond:]).transpose(1, 2)
            if previous.shape[1] == 1:  # one output of a convolution is a product, which is quicker
                vectors = vectors + nn.functional.linear(past.flatten(1), weight.flatten(1))[:, None]
            elif taps:
                vectors = vectors + nn.functional.conv1d(past, weight).transpose(1, 2)
            if beyond:
                start = self.mix.weight[..., beyond - 1] @ self.past.weight[self.nothing - 1]
                begun = line[:, beyond - 1 : beyond - 1 + previous.shape[1]] != self.nothing
                vectors = vectors + begun[..., None] * start
        if context is not None:
            vectors = vectors + self.of_context(context)
        return vectors, line[:, line.shape[1] - self.lags + 1 :]

    def of_context(self, context: Tensor) -> Tensor:
        """What contexts `[N, T]` or `[N, T, C]` add to the vectors: `[N, T, width]`."""
        if self.index is not None:
            vectors: Tensor = self.index(context.long())
        else:
            assert self.features is not None
            assert self.scale is not None
            vectors = self.features(self.scale(context.to(self.features.weight.dtype)))
        return vectors

    def of_past(self, window: int | None) -> tuple[Tensor, Tensor]:
        """What the last actions add to the vectors; see `forward`.

        Returns:
            `[taps, A + 2, width]`, from the last one back; and `[1, width]`, where there is an action before these, or
            `[0, width]`, if it adds nothing.
        """
        if self.past is None or self.mix is None:
            return torch.empty(0, 1, self.action.embedding_dim), torch.empty(0, self.action.embedding_dim)
        taps = self.lags if window is None else min(window, self.lags)
        weight = self.mix.weight.flip(2)  # the last tap of a convolution is that of the last input
        past = torch.einsum("av,hvk->kah", self.past.weight, weight)
        return past[:taps], past[taps : taps + 1, self.nothing - 1]
