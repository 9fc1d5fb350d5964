"""The transformer prior: attention over the actions so far, with a key-value cache for stepping."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuroprior._checks import check_memory, check_sizes
from neuroprior.plans import Plans
from neuroprior.priors.neural.neural import FEW, Embedding, NeuralPrior, Sizes
from neuroprior.sampling.states import State

MANY_QUERIES = 1024
"""Plans whose single next query is answered faster by matrix products than by the fused kernels of a CUDA device, which
are made for many queries: three times as fast on an H100, from 16,384 plans with 32 keys each."""

FEWEST_AT_ONCE = 32
"""Inputs of a sequence that are read at once, at least, past the training length."""


Rotation = tuple[Tensor, Tensor]
"""Cosine and sine, see `rotation`."""


class TransformerPrior(NeuralPrior):
    """A pre-norm transformer (Vaswani et al. 2017) with rotary positions (Su et al. 2021) as a prior.

    Its state holds the key-value cache: `num_layers * 2 * width` numbers for each input that is attended to. Past the
    training length each layer attends to the start symbol and the last `window` inputs, its own among them, at the
    distances of the last action of a plan in training (as the attention sink of Xiao et al. 2023). Trained in windows
    (see `NeuralPrior`), it attends to its own input and at most `span` before it, `span` being the training window.
    The cache keeps no more: new keys and values replace the oldest. Several layers together still reach further back.

    Args:
        num_actions: A.
        width: width of the vectors; a multiple of 2 * `num_heads`.
        num_layers: number of blocks.
        num_heads: attention heads.
        window, lags, dropout, num_contexts, context_size, seed: see `NeuralPrior`. Dropout is applied to the input
            vectors and to what each block adds. What is None of `lags` and `dropout` is chosen by `fit` for its
            first plans, see `neuroprior.priors.neural.Sizes`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> prior = TransformerPrior(3, width=8)  # prior.fit(plans) trains it
        >>> prior.sample(2, 4).shape
        torch.Size([2, 4])
    """

    def __init__(
        self,
        num_actions: int,
        width: int = 64,
        num_layers: int = 2,
        num_heads: int = 4,
        window: int | None = None,
        lags: int | None = None,
        dropout: float | None = None,
        num_contexts: int | None = None,
        context_size: int | None = None,
        seed: int = 0,
    ) -> None:
        check_sizes(width=width, num_layers=num_layers, num_heads=num_heads)
        if width % (2 * num_heads):
            raise ValueError(f"`width` must be a multiple of 2 * num_heads = {2 * num_heads}, got {width}")
        check_memory(48 * num_layers * width**2, num_layers=num_layers, width=width)
        self.num_heads = num_heads
        self.span: int | None = None
        super().__init__(num_actions, width, window, lags, dropout, num_contexts, context_size, seed, num_layers)

    @property
    def config(self) -> dict[str, Any]:
        return super().config | self.arguments() | {"num_heads": self.num_heads}

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"span": self.span}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        if learned["span"] is not None:
            check_sizes(span=learned["span"])
        self.span = learned["span"]

    def set_training_window(self, window: int | None) -> None:
        super().set_training_window(window)
        self.span = window

    def sizes_for(self, plans: Plans) -> Sizes:
        """As for other networks; but attention needs to be shown the last actions in long sequences, too."""
        sizes = super().sizes_for(plans)
        return sizes._replace(lags=Sizes().lags) if int(plans.mask().sum()) >= FEW else sizes

    def build(self) -> None:
        self.embedding = Embedding(self.num_actions, self.width, self.lags, self.num_contexts, self.context_size)
        self.drop = nn.Dropout(self.dropout)
        self.blocks = nn.ModuleList(Block(self.width, self.num_heads, self.dropout) for _ in range(self.num_layers))
        self.norm = nn.LayerNorm(self.width)
        self.head = nn.Linear(self.width, self.num_actions)

    def encode(self, previous: Tensor, context: Tensor | None, hidden: State | None = None) -> tuple[Tensor, State]:
        """See `NeuralPrior.encode`.

        `hidden` is `(caches, number, recent)`: each layer's keys and values `[N, S, 2 * width]`, from the oldest step
        on; how many steps were read, int64 `[N]`; and the last `lags` - 1 actions.
        """
        most = self.most_kept
        if most is not None and previous.shape[1] > max(most, FEWEST_AT_ONCE):
            return self._encode_in_parts(previous, context, hidden, max(most, FEWEST_AT_ONCE))
        if hidden is None:
            hidden = ([None] * self.num_layers, previous.new_zeros(len(previous)), None)
        pasts, number, recent = hidden
        x, recent = self.embedding(previous, context, recent, self.window)
        x = self.drop(x)
        place = number[:, None] + torch.arange(previous.shape[1], device=previous.device)
        turns = rotation(place, self.width // self.num_heads)
        near = None if self.window is None else rotation(place.clamp(max=self.window), self.width // self.num_heads)
        caches = []
        for past, block in zip(pasts, self.blocks, strict=True):
            x, cache = block(x, past, turns, near, self.span, self.window)
            caches.append(cache)
        return self.head(self.norm(x)), (tuple(caches), place[:, -1] + 1, recent)

    def _encode_in_parts(
        self, previous: Tensor, context: Tensor | None, hidden: State | None, size: int
    ) -> tuple[Tensor, State]:
        """As `encode`, part by part, since the cost of attention grows with the square of what is read at once."""
        logits = []
        for first in range(0, previous.shape[1], size):
            now = slice(first, first + size)
            out, hidden = self.encode(previous[:, now], None if context is None else context[:, now], hidden)
            logits.append(out)
        return torch.cat(logits, 1), hidden

    @property
    def most_kept(self) -> int | None:
        """At most so many steps are kept in the key-value cache; if None, no limit."""
        return self.span if self.window is None else self.window + 1


class Block(nn.Module):
    """Attention and a two-layer network, each after a layer norm and added to its input."""

    def __init__(self, width: int, num_heads: int, dropout: float) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.drop = nn.Dropout(dropout)
        self.attention_norm = nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.mlp = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width)
        )

    def forward(
        self,
        x: Tensor,
        past: Tensor | None,
        turns: Rotation,
        near: Rotation | None = None,
        span: int | None = None,
        window: int | None = None,
    ) -> tuple[Tensor, Tensor]:
        """`x [N, T, width]` after `past [N, S, 2 * width]`: the new `x`, and what is kept.

        Each step, rotated by `turns`, attends to itself and those before it, at most `span` back. With a `window`, each
        attends to the first one, rotated by `near`, and to the last `window`, itself among them; the first is never
        further away than `window`, and is kept.
        """
        width = x.shape[-1]
        unturned, value = self.query_key_value(self.attention_norm(x)).split([2 * width, width], -1)
        query, key = rotate(unturned, *turns).chunk(2, -1)
        kept = torch.cat([key, value], -1)
        if past is not None:
            kept = torch.cat([past.to(kept.dtype), kept], 1)  # under autocast the new ones may be of another dtype
        key, value = kept.chunk(2, -1)
        if window is None or near is None or key.shape[1] <= window + 1:
            mixed = self._attend(query, key, value, span)
        else:
            mixed = self._attend_to_first(query, rotate(unturned[..., :width], *near), key, value, window)
        most = span if window is None else window + 1
        if most is not None and kept.shape[1] > most:
            first = 0 if window is None else 1
            kept = torch.cat([kept[:, :first], kept[:, first - most :]], 1)
        return self._add(x, mixed), kept

    def _add(self, x: Tensor, mixed: Tensor) -> Tensor:
        """`x` plus the output of attention, `mixed`, and then plus that of the two-layer network."""
        x = x + self.drop(self.out(mixed.to(x.dtype)))  # keys and values are kept in single precision
        added: Tensor = self.drop(self.mlp(x))
        return x + added

    def _attend(self, query: Tensor, key: Tensor, value: Tensor, span: int | None) -> Tensor:
        """`[N, T, width]`: attention of each query over keys and values `[N, S + T, width]`."""
        num, total = query.shape[1], key.shape[1]
        span = total if span is None else span
        every = total <= span + 1
        plain = num == total and every
        mask = None if plain or (num == 1 and every) else reached(num, total, span, query.device)
        query, key, value = (self._heads(one).to(value.dtype) for one in (query, key, value))
        if num == 1 and query.is_cuda and len(query) >= MANY_QUERIES:
            scores = query @ key.mT / query.shape[-1] ** 0.5
            scores = scores if mask is None else scores.masked_fill(~mask, -torch.inf)
            mixed: Tensor = scores.softmax(-1) @ value
        else:
            causal = plain and mask is None
            mixed = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask, is_causal=causal)
        return mixed.transpose(1, 2).flatten(2)

    def _attend_to_first(self, query: Tensor, near: Tensor, key: Tensor, value: Tensor, window: int) -> Tensor:
        """As `_attend`, over the last `window` inputs and the first one, which queries `near` it attend to."""
        mask = reached(query.shape[1], key.shape[1], window - 1, query.device)
        mask[:, 0] = True
        query, near, key, value = map(self._heads, (query, near, key, value))
        scores = torch.cat([near @ key[:, :, :1].mT, query @ key[:, :, 1:].mT], -1) / query.shape[-1] ** 0.5
        mixed: Tensor = scores.masked_fill(~mask, -torch.inf).softmax(-1) @ value
        return mixed.transpose(1, 2).flatten(2)

    def _heads(self, x: Tensor) -> Tensor:
        """`[N, heads, T, size]`."""
        heads: Tensor = x.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)
        return heads


def reached(num: int, total: int, span: int, device: torch.device) -> Tensor:
    """`[num, total]`: the inputs that each of the last `num` attends to, itself and those at most `span` back."""
    back = torch.arange(total - num, total, device=device)[:, None] - torch.arange(total, device=device)
    return (back >= 0) & (back <= span)


def rotation(place: Tensor, size: int) -> Rotation:
    """Cosine and sine `[N, T, size / 2]` of the angles by which heads of this size are rotated at `place [N, T]`."""
    half = size // 2
    angle = place[..., None] * 10_000 ** -(torch.arange(half, device=place.device) / half)
    return angle.cos(), angle.sin()


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Each pair of numbers of each head of `x [N, T, width]` rotated by the angles of its position, see `rotation`."""
    first, second = x.unflatten(-1, (-1, 2, cos.shape[-1])).unbind(-2)
    cos, sin = cos[..., None, :], sin[..., None, :]
    return torch.stack([first * cos - second * sin, first * sin + second * cos], -2).flatten(-3)
