"""What the neural priors share: how they see actions and contexts, the window past the training length, and fitting."""

from abc import abstractmethod
from typing import Any, Self

import torch
from torch import Tensor, nn

from neuroprior.plans import Plans, sees_each_step
from neuroprior.priors.prior import Prior
from neuroprior.randomness import draw_seed, generator_on


class NeuralPrior(Prior):
    """A network over (last action, context) inputs; the first input is a start symbol.

    Past the training length a network meets positions and memories that it has never seen. So each action is predicted
    from at most the last `window` actions, read as if they opened the plan: with plans of length T in training,
    `window = T - 1`, the most that was ever seen before an action. Up to length T nothing changes. Measured on a chain
    of order 2 (1.288 bits an action) at actions 20 to 32, after training on plans of length 8: the transformer takes
    1.291 bits with this window and 2.171 without one, the GRU 1.291 with and without; windows of 5 and 3 are no worse
    there, since they still hold the order (`python -m pytest -m slow -k past_the_training_length -s` prints this).

    The state holds, beside the network's memory, the inputs that the window may still need: `[N, memory + (t + 1) * D]`
    for t actions so far, D = 1 + (1 for a context index, C for features); past the window those inputs alone,
    `[N, window + 1, D]`.

    Args:
        num_actions: A.
        window: see above; None: set by `fit`, and without limit before that.
        num_contexts, context_size: see `Prior`.
        seed: draws the initial weights; torch's global generator is left alone.
    """

    def __init__(
        self, num_actions: int, window: int | None, num_contexts: int | None, context_size: int | None, seed: int
    ) -> None:
        super().__init__(num_actions, num_contexts, context_size)
        if window is not None and (not isinstance(window, int) or isinstance(window, bool) or window < 0):
            raise ValueError(f"window: an integer of at least 0 is expected, not {window!r}")
        self._given_window = self.window = window
        self.input_size = 1 + (1 if num_contexts is not None else context_size or 0)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.build()

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"window": self._given_window}

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"window": self.window}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        window = learned["window"]
        if window is not None and (not isinstance(window, int) or isinstance(window, bool) or window < 0):
            raise ValueError(f"window: an integer of at least 0 is expected, not {window!r}")
        self.window = window

    @abstractmethod
    def build(self) -> None:
        """Make the layers."""

    @abstractmethod
    def encode(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Read a sequence from its start.

        Args:
            inputs: `[N, T, D]`: the action before (A for none) and the context, as floating point numbers.

        Returns:
            Logits `[N, T, A]`, and the memory `[N, M]` after the last input.
        """

    @abstractmethod
    def advance(self, inputs: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Read one more input `[N, D]`: logits `[N, A]` and the new memory `[N, M]`."""

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        before = torch.full((batch_size,), self.num_actions, device=self.device)
        inputs = self._inputs(before, context, None)
        logits, memory = self.encode(inputs[:, None])
        return logits[:, 0], torch.cat([memory, inputs], 1)

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        memory, history = self._open(state)
        new = self._inputs(action, context, history[:, -1])
        kept = history if self.window is not None else history[:, :0]
        history = torch.cat([kept, new[:, None]], 1)
        if self.window is not None and history.shape[1] > self.window + 1:
            history = history[:, 1:]
            return self._read_window(history), history
        logits, memory = self.advance(new, memory)
        return logits, torch.cat([memory, history.flatten(1)], 1)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        num, length = plans.shape
        if length == 0:
            return torch.zeros(num, 0, self.num_actions, device=self.device)
        before = torch.nn.functional.pad(plans.long(), (1, 0), value=self.num_actions)[:, :-1]
        if context is not None and not sees_each_step(context):
            context = context[:, None].expand(num, length, *context.shape[1:])
        inputs = self._inputs(before, context, None)
        if self.window is None or length <= self.window + 1:
            return self.encode(inputs)[0]
        first = self.encode(inputs[:, : self.window + 1])[0]
        late = inputs[:, 1:].unfold(1, self.window + 1, 1).transpose(2, 3)
        logits = self._read_window(late.flatten(0, 1))
        return torch.cat([first, logits.view(num, length - self.window - 1, self.num_actions)], 1)

    def fit(self, plans: Plans | Tensor, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Train with Lightning until held-out plans stop being told better; returns self.

        A prior that has learned before goes on from the weights that it has.

        Args:
            plans: what to learn from; a tensor `[N, L]` is taken as plans without context.
            generator: draws the held-out plans, the order of training and dropout.
            settings: fields of `neuroprior.training.Settings`, such as `max_steps=500` or `progress=False`.

        Raises:
            ValueError: plans that this prior cannot learn from, fewer than two with an action, a setting out of range,
                or a training that diverged.
        """
        from neuroprior.training import Settings, train  # lightning takes seconds to import: only where it is needed

        plans = self.training_plans(plans)
        plans = plans[plans.mask().any(1)]
        if len(plans) < 2:
            raise ValueError("plans: at least two plans with an action are needed to train a neural prior")
        if self._given_window is None:
            self.window = int(plans.mask().sum(1).max()) - 1
        train(self, plans, Settings(**settings), draw_seed(generator_on(generator, "cpu")))
        return self

    def _inputs(self, before: Tensor, context: Tensor | None, last: Tensor | None) -> Tensor:
        """The action before `[...]` and the context as one input `[..., D]`; None: the context of the `last` input."""
        action = before[..., None].float()
        if not self.takes_context:
            return action
        if context is None:
            if last is None:
                raise ValueError("context: this prior sees a context, and none was given")
            return torch.cat([action, last[..., 1:]], -1)
        seen = context[..., None] if self.num_contexts is not None else context
        return torch.cat([action, seen.to(action)], -1)

    def _open(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """The memory `[N, M]` and the inputs `[N, T, D]` in a state; past the window it is the inputs alone."""
        if state.dim() == 3:
            return state[:, 0, :0], state
        size = self.memory_size(state.shape[1])
        return state[:, :size], state[:, size:].unflatten(1, (-1, self.input_size))

    def _read_window(self, inputs: Tensor) -> Tensor:
        """The logits `[N, A]` after `inputs [N, window + 1, D]`, read as if they opened a plan.

        The same few windows come again and again in samples and trees; without context each is read once.
        """
        start = torch.full_like(inputs[:, :1, :1], self.num_actions)
        inputs = torch.cat([torch.cat([start, inputs[:, :1, 1:]], -1), inputs[:, 1:]], 1)
        if self.takes_context or self.num_actions ** (inputs.shape[1] - 1) > 2**62:
            return self.encode(inputs)[0][:, -1]
        base = self.num_actions ** torch.arange(inputs.shape[1] - 1, device=inputs.device)
        distinct, which = (inputs[:, 1:, 0].long() * base).sum(1).unique(return_inverse=True)
        last = torch.empty_like(distinct).scatter_(0, which, torch.arange(len(which), device=inputs.device))
        return self.encode(inputs[last])[0][:, -1][which]

    @abstractmethod
    def memory_size(self, state_size: int) -> int:
        """The size of the memory in a state of `state_size` numbers."""


class Embedding(nn.Module):
    """Inputs `[..., D]` (action before, context) to vectors `[..., width]`."""

    def __init__(self, num_actions: int, width: int, num_contexts: int | None, context_size: int | None) -> None:
        super().__init__()
        self.action = nn.Embedding(num_actions + 1, width)
        self.index = None if num_contexts is None else nn.Embedding(num_contexts, width)
        self.features = None if context_size is None else nn.Linear(context_size, width)

    def forward(self, inputs: Tensor) -> Tensor:
        vectors: Tensor = self.action(inputs[..., 0].long())
        if self.index is not None:
            vectors = vectors + self.index(inputs[..., 1].long())
        if self.features is not None:
            vectors = vectors + self.features(inputs[..., 1:])
        return vectors
