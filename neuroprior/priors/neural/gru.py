"""The GRU prior: a recurrent network over the actions so far."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuroprior._checks import check_memory, check_sizes
from neuroprior._threads import one_thread, share
from neuroprior.priors.neural.neural import Embedding, NeuralPrior
from neuroprior.sampling.states import State

DRAW_FROM = 4096
"""Numbers in the hidden states of plans from which they are drawn to their ends by one compiled loop."""

ROWS, WORTH_THREADS = 2048, 8
"""Rows of hidden states whose products stay in a processor's cache, and so many times these from which threads share
them."""

LARGEST = 2**22
"""The most numbers in the tables of what the last actions add to the gates."""


class GRUPrior(NeuralPrior):
    """A gated recurrent network (Cho et al. 2014) as a prior.

    Args:
        num_actions: A.
        hidden_size: width of the hidden state and of the input vectors.
        num_layers: number of layers.
        window, lags, dropout, num_contexts, context_size, seed: see `NeuralPrior`. Dropout is applied to the input
            vectors and to the output of each layer. What is None of `hidden_size`, `num_layers`, `lags` and `dropout`
            is chosen by `fit` for its first plans, see `neuroprior.priors.neural.Sizes`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> prior = GRUPrior(3, hidden_size=8)  # prior.fit(plans) trains it
        >>> prior.sample(2, 4).shape
        torch.Size([2, 4])
    """

    def __init__(
        self,
        num_actions: int,
        hidden_size: int | None = None,
        num_layers: int | None = None,
        window: int | None = None,
        lags: int | None = None,
        dropout: float | None = None,
        num_contexts: int | None = None,
        context_size: int | None = None,
        seed: int = 0,
    ) -> None:
        sizes = {"num_layers": num_layers, "hidden_size": hidden_size}
        chosen = {name: size for name, size in sizes.items() if size is not None}
        check_sizes(**chosen)
        check_memory(24 * chosen.get("hidden_size", 1) ** 2, **chosen)
        super().__init__(num_actions, hidden_size, window, lags, dropout, num_contexts, context_size, seed, num_layers)

    @property
    def hidden_size(self) -> int:
        """The width of the hidden state."""
        return self.width

    @property
    def config(self) -> dict[str, Any]:
        arguments = self.arguments()
        return super().config | {"hidden_size": arguments.pop("width")} | arguments

    def build(self) -> None:
        width = self.hidden_size
        self.embedding = Embedding(self.num_actions, width, self.lags, self.num_contexts, self.context_size)
        self.gru = nn.GRU(width, width, self.num_layers, batch_first=True, dropout=self.dropout * (self.num_layers > 1))
        self.drop = nn.Dropout(self.dropout)
        self.head = nn.Linear(width, self.num_actions)

    def encode(self, previous: Tensor, context: Tensor | None, hidden: State | None = None) -> tuple[Tensor, State]:
        """See `NeuralPrior.encode`.

        `hidden` is the layers' hidden states `[N, layers, H]`, and the last `lags` - 1 actions.
        """
        layers, recent = (None, None) if hidden is None else hidden
        layers = None if layers is None else layers.transpose(0, 1)
        if layers is not None and self._looks_up(previous, context):
            row = previous[:, 0].int()
            out, layers = gru_step(self.gru, self.embedding.action.weight, layers, rows=row)
            out = out[:, None]
        else:
            vectors, recent = self.embedding(previous, context, recent, self.window)
            out, layers = gru_sequence(self.gru, self.drop(vectors), layers)
        return self.head(self.drop(out)), (layers.transpose(0, 1), recent)

    def _looks_up(self, previous: Tensor, context: Tensor | None) -> bool:
        """Whether the gates of each action are computed once: where these depend on it alone, and plans are more."""
        alone = context is None and self.lags == 1 and len(previous) > self.num_actions
        return alone and self._may_step(previous)

    def step_shared(self, action: Tensor, state: State, context: Tensor, row: Tensor) -> tuple[Tensor, State]:
        """As `step`, where many plans get the same input; its vectors and gates are computed once.

        Args:
            action: integers `[K]`, the distinct ones.
            state: see `step`.
            context: `[K]` or `[K, C]`: that of the next action, with each.
            row: integers `[N]`: which of the K each plan gets.
        """
        unchanged = type(self).encode is GRUPrior.encode and type(self).step is NeuralPrior.step
        if not unchanged or self.lags > 1 or self.window == 0 or not self._may_step(action[:, None]):
            return self.step(action[row], state, context[row])
        vectors, _ = self.embedding(action.long()[:, None], context[:, None], None, self.window)
        layers, recent = state[1]
        out, layers = gru_step(self.gru, vectors[:, 0], layers.transpose(0, 1), row.int())
        return self.head(out), (context.index_select(0, row), (layers.transpose(0, 1), recent))

    def draw_rest(self, action: Tensor, state: State, uniform: Tensor, temperature: float) -> Tensor | None:
        """The rest of many plans, drawn on a CPU by one compiled loop; see `neuroprior.sampling.Steppable`.

        If they have a context, it goes on.

        Args:
            action: integers `[N]`, the last ones.
            state: before these.
            uniform: `[T, N]`: what the next T actions are drawn with.
            temperature: divides the logits.

        Returns:
            int64 `[N, T]`; None where the loop does not pay, or does not know this prior.
        """
        context, (layers, recent) = state if self.takes_context else (None, state)
        if layers.device.type != "cpu":
            return None
        size, (steps, number), kinds = self.hidden_size, uniform.shape, self.num_actions
        # Tables of what each of the last actions adds have to be worth their making.
        worth = 4 * self.lags * kinds <= number * steps and 3 * size * self.lags * kinds <= LARGEST
        able = (
            worth
            and number * size >= DRAW_FROM
            and layers.dtype == uniform.dtype == torch.float32
            and self._may_step(action[:, None])
        )
        if not (able and self.is_plain):
            return None
        from neuroprior.priors.neural import compiled_gru

        if not compiled_gru.on_one_thread(size, kinds):
            return None
        context_gates = layers.new_empty(0, 3 * size) if context is None else self.context_gates(context)
        line = torch.cat([recent, action.long()[:, None], recent.new_empty(number, steps)], 1)
        # The loop overwrites the hidden states.
        arrays: Any = (x.detach().contiguous().numpy() for x in (context_gates, layers.clone(), line, uniform))
        draw: Any = compiled_gru.draw_to_the_end
        draw(compiled_gru.Network(*self.arrays()), *arrays, float(temperature))
        return line[:, self.lags :]

    @property
    def is_plain(self) -> bool:
        parts = (type(self), type(self.embedding), type(self.gru), type(self.head))
        return parts == (GRUPrior, Embedding, nn.GRU, nn.Linear) and super().is_plain

    def context_gates(self, context: Tensor) -> Tensor:
        """What contexts `[N]` or `[N, C]` add to the gates of the first layer: `[N, 3 * hidden_size]`."""
        return self.embedding.of_context(context[:, None])[:, 0] @ self.gru.all_weights[0][0].T

    def arrays(self) -> tuple[Any, ...]:
        """The parts of `neuroprior.priors.neural.compiled_gru.Network`: weights, and what actions add to the gates."""
        size, embedding = self.hidden_size, self.embedding
        inputs, recurrent, biases, recurrent_biases = (
            torch.stack(weights) for weights in zip(*self.gru.all_weights, strict=True)
        )
        # The last part of a layer's own biases is left: the reset gate lets a share of it into the new state.
        biases = biases + torch.cat(
            [recurrent_biases[:, : 2 * size], torch.zeros_like(recurrent_biases[:, 2 * size :])], 1
        )
        past, beyond = embedding.of_past(self.window)
        first, above = inputs[0].T, inputs[1:].mT
        parts = (
            embedding.action.weight @ first + biases[0], past @ first, beyond @ first,
            recurrent.mT, recurrent_biases[:, 2 * size :], above, biases[1:], self.head.weight.T, self.head.bias,
        )  # fmt: skip
        return tuple(x.detach().float().contiguous().numpy() for x in parts)

    def _may_step(self, previous: Tensor) -> bool:
        """Whether `gru_step` gives the same as `nn.GRU` for actions `[N, T]`, and faster."""
        plain = not (self.training or torch.is_grad_enabled() or torch.is_autocast_enabled(previous.device.type))
        return plain and previous.shape[1] == 1


def gru_sequence(gru: nn.GRU, inputs: Tensor, layers: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Returns the output of `nn.GRU`; of float32 on a CPU by compiled loops, which are faster.

    Args:
        gru: the network, `batch_first`, with weights of one width.
        inputs: `[N, T, width]`.
        layers: `[layers, N, width]`, the hidden states before; None: zeros.

    Returns:
        The output `[N, T, width]`, and the new `layers`.
    """
    rough = torch.is_autocast_enabled(inputs.device.type)
    if layers is not None and inputs.shape[1] == 1 and not (rough or gru.training or torch.is_grad_enabled()):
        out, layers = gru_step(gru, inputs[:, 0], layers)
        return out[:, None], layers
    if rough or inputs.dtype != torch.float32 or inputs.device.type != "cpu" or inputs.numel() == 0:
        out, layers = gru(inputs, None if layers is None else layers.contiguous())
        return out, layers
    from neuroprior.priors.neural.compiled_gru import Sequence

    after, below = [], inputs.transpose(0, 1)
    for layer, (w_in, w_hidden, b_in, b_hidden) in enumerate(gru.all_weights):
        if layer > 0:
            below = functional.dropout(below, gru.dropout, gru.training)
        first = below.new_zeros(below.shape[1], w_hidden.shape[1]) if layers is None else layers[layer]
        below = Sequence.apply(functional.linear(below, w_in, b_in), first, w_hidden, b_hidden)
        after.append(below[-1])
    return below.transpose(0, 1), torch.stack(after)


def gru_step(gru: nn.GRU, below: Tensor, layers: Tensor, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Returns the output of `nn.GRU`, which is made for long sequences, for a single input; without gradients.

    Args:
        gru: the network, with weights of one width.
        below: `[N, width]`, the inputs; with `rows`, the distinct ones.
        layers: `[layers, N, width]`, the hidden states.
        rows: integers `[N]`: which of the distinct inputs each row reads; None: `below` has a row for each.

    Returns:
        The output `[N, width]`, and the new `layers`.
    """
    after = []
    if layers.device.type != "cpu" or layers.dtype != torch.float32:
        below = below if rows is None else below.index_select(0, rows)
        for before, weights in zip(layers, gru.all_weights, strict=True):
            below = torch.gru_cell(below, before.contiguous(), *weights)
            after.append(below)
        return below, torch.stack(after)
    for layer, before in enumerate(layers):
        w_in, w_hidden, b_in, b_hidden = gru.all_weights[layer]
        if layer > 0 or rows is None:
            rows = torch.arange(len(before), dtype=torch.int32)
        below = _step_in_parts(functional.linear(below, w_in, b_in), rows, before, w_hidden, b_hidden)
        after.append(below)
    return below, after[0][None] if len(after) == 1 else torch.stack(after)


def _step_in_parts(inputs: Tensor, rows: Tensor, before: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """The new hidden states of one layer, where products of `ROWS` rows stay in the cache; threads share many."""
    from neuroprior.priors.neural.compiled_gru import step

    before = before if before.stride(1) == 1 else before.contiguous()
    if len(before) <= ROWS:
        return step(inputs, rows, before @ weight.T, before, bias)
    after = before.new_empty(before.shape)

    def step_chunk(begin: int) -> None:
        chunk = slice(begin, begin + ROWS)
        step(inputs, rows[chunk], before[chunk] @ weight.T, before[chunk], bias, after[chunk])

    begins = range(0, len(before), ROWS)
    with one_thread(len(begins) < WORTH_THREADS):
        share(step_chunk, begins)
    return after
