"""The transformer prior: attention over the actions so far, with a key-value cache for stepping."""

import sys
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuroprior._checks import check_memory, check_sizes
from neuroprior.plans import Plans
from neuroprior.priors.neural.neural import FEW, Embedding, NeuralPrior, Sizes
from neuroprior.sampling.rows import extended, states_with_room


class TransformerPrior(NeuralPrior):
    """A pre-norm transformer (Vaswani et al. 2017) with rotary positions (Su et al. 2021) as a prior.

    Its state holds the key-value cache: `num_layers * 2 * width` numbers for each input so far. Trained in windows (see
    `NeuralPrior`), each layer attends to at most `span` inputs before its own, `span` being the training window, and
    the cache keeps no more; several layers together still reach further back.

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
            raise ValueError(f"width: a multiple of 2 * num_heads = {2 * num_heads} is expected, not {width}")
        check_memory(48 * num_layers * width**2, num_layers=num_layers, width=width)
        self.num_layers, self.num_heads = num_layers, num_heads
        self.span: int | None = None
        super().__init__(num_actions, width, window, lags, dropout, num_contexts, context_size, seed)

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"width": self.width, "num_layers": self.num_layers, "num_heads": self.num_heads}

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

    def encode(self, inputs: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if self.span is not None and inputs.shape[1] > 2 * self.span:
            return self._encode_in_parts(inputs, hidden)
        past, recent, kept = None, None, self.lags - 1
        if hidden is not None:
            past = hidden[:, kept:].view(len(hidden), -1, self.num_layers, 2 * self.width)
            recent = hidden[:, :kept]
        x, recent = self.embedding(inputs, recent)
        x = self.drop(x)
        caches = []
        for layer, block in enumerate(self.blocks):
            x, cache = block(x, None if past is None else past[:, :, layer], self.span)
            caches.append(cache)
        return self.head(self.norm(x)), torch.cat([recent, torch.stack(caches, 2).flatten(1)], 1)

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if self.steps_in_place(state) is None:
            return super().step(action, state, context)
        return self._step_in_place(action, state, context)

    def advance(
        self, action: Tensor, state: Tensor, context: Tensor | None = None, room: int = 0
    ) -> tuple[Tensor, Tensor]:
        most = self.steps_in_place(state)
        if most is None or type(self).step is not TransformerPrior.step:
            return self.step(action, state, context)
        return self._step_in_place(action, state, context, min(room, most))

    def _step_in_place(
        self, action: Tensor, state: Tensor, context: Tensor | None, room: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """A step in which new keys and values are written behind the cache, which is the largest part of the state.

        Args:
            action, state, context: see `step`.
            room: None: the cache is copied once, and `state` stays as it is. Otherwise a state that has room is
                overwritten, and any other is copied to a tensor with room for so many further steps.
        """
        hidden, history = self._split(state)
        new = self._inputs(action, context, history[:, -1])
        kept = 0 if self.window is None else history.shape[1] * self.input_size
        recent, past, cached = self.lags - 1, hidden.shape[1], hidden.shape[1] + self.cache_size
        before = state[:, past : past + kept].clone()  # the cache will be written there
        size = cached + kept + self.input_size
        x, line = self.embedding(new[:, None], hidden[:, :recent])
        after = None if room is None else extended(state, size)
        if after is None:
            free = (room or 0) * (self.cache_size + self.input_size)
            after = state.new_empty(len(state), size) if room is None else states_with_room(state, size, free)
            after[:, recent:past] = hidden[:, recent:]
        after[:, :recent] = line
        places = after[:, recent:cached].unflatten(1, ((cached - recent) // self.cache_size, self.num_layers, -1))
        for layer, block in enumerate(self.blocks):
            assert isinstance(block, Block)
            x = block.step(x, places[:, :, layer])
        after[:, cached : cached + kept] = before
        after[:, cached + kept :] = new
        return self.head(self.norm(x))[:, 0], after

    def steps_in_place(self, state: Tensor) -> int | None:
        """How many steps after the next can be written in place as well; None: not even the next one.

        In training, under autocast, where inputs leave the window or span, and in subclasses with an `encode` of their
        own, steps are not written in place.
        """
        plain = type(self).encode is TransformerPrior.encode and not (self.training or torch.is_grad_enabled())
        if not plain or state.dim() == 3 or torch.is_autocast_enabled(state.device.type):
            return None
        hidden, history = self._split(state)
        read = (hidden.shape[1] - self.lags + 1) // self.cache_size
        limits = [
            *([] if self.window is None else [self.window - history.shape[1]]),
            *([] if self.span is None else [self.span - read - 1]),
        ]
        most = min(limits, default=sys.maxsize)
        return None if most < 0 else most

    @property
    def cache_size(self) -> int:
        """Numbers of the key-value cache for each input."""
        return self.num_layers * 2 * self.width

    def _encode_in_parts(self, inputs: Tensor, hidden: Tensor | None) -> tuple[Tensor, Tensor]:
        """As `encode`, part by part, since the cost of attention grows with the square of what is read at once."""
        logits = []
        for part in inputs.split(self.span or inputs.shape[1], 1):
            out, hidden = self.encode(part, hidden)
            logits.append(out)
        assert hidden is not None
        return torch.cat(logits, 1), hidden

    def hidden_size_of(self, state_size: int) -> int:
        if self.window is None:
            return state_size - self.input_size
        return (state_size - self.lags + 1) // (self.cache_size + self.input_size) * self.cache_size + self.lags - 1


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

    def forward(self, x: Tensor, past: Tensor | None, span: int | None) -> tuple[Tensor, Tensor]:
        """`x [N, T, width]` after `past [N, S, 2 * width]`: the new `x`, and the keys and values to be kept.

        Each input attends to itself and those before it, at most `span` back. Positions count from the first input of
        the past; where the oldest ones are dropped, the keys that are kept are rotated back by as many positions.
        """
        start = 0 if past is None else past.shape[1]
        place = torch.arange(start, start + x.shape[1], device=x.device)
        query, key, value = self._project(x, place)
        if past is not None:
            # under autocast new keys and values may be of another dtype than kept ones
            key, value = torch.cat([past.to(key.dtype), torch.cat([key, value], -1)], 1).chunk(2, -1)
        x = self._add(x, self._attend(query, key, value, span))
        excess = 0 if span is None else max(key.shape[1] - span, 0)
        if excess:
            key, value = self._rotate(key[:, excess:], torch.full_like(place[:1], -excess)), value[:, excess:]
        return x, torch.cat([key, value], -1)

    def step(self, x: Tensor, cache: Tensor) -> Tensor:
        """The new `x [N, 1, width]`; keys and values are written to the last place of `cache [N, S, 2 * width]`."""
        last = cache.shape[1] - 1
        query, key, value = self._project(x, torch.arange(last, last + 1, device=x.device))
        cache[:, last:] = torch.cat([key, value], -1)
        key, value = cache.chunk(2, -1)
        return self._add(x, self._attend(query, key, value, None))

    def _project(self, x: Tensor, place: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values of `x [N, T, width]`, rotated to their positions `place [T]`."""
        query, key, value = self.query_key_value(self.attention_norm(x)).chunk(3, -1)
        return self._rotate(query, place), self._rotate(key, place), value

    def _add(self, x: Tensor, mixed: Tensor) -> Tensor:
        """`x` plus the output of attention, `mixed`, and then plus that of the two-layer network."""
        x = x + self.drop(self.out(mixed))
        added: Tensor = self.drop(self.mlp(x))
        return x + added

    def _attend(self, query: Tensor, key: Tensor, value: Tensor, span: int | None) -> Tensor:
        """`[N, T, width]`: attention of each query over keys and values `[N, S + T, width]`."""
        num, total = query.shape[1], key.shape[1]
        query, key, value = (v.unflatten(-1, (self.num_heads, -1)).transpose(1, 2) for v in (query, key, value))
        plain = num == total and (span is None or num <= span + 1)
        mask = None
        if not plain and num > 1:
            back = torch.arange(total - num, total, device=query.device)[:, None] - torch.arange(
                total, device=query.device
            )
            mask = (back >= 0) & (back <= (total if span is None else span))
        mixed = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask, is_causal=plain)
        return mixed.transpose(1, 2).flatten(2)

    def _rotate(self, x: Tensor, place: Tensor) -> Tensor:
        """Rotate each pair of numbers of each head of `x [N, T, width]` by an angle proportional to `place [T]`."""
        pairs = x.unflatten(-1, (self.num_heads, 2, -1))
        half = pairs.shape[-1]
        rate = 10_000 ** -(torch.arange(half, device=x.device) / half)
        angle = place[:, None] * rate
        cos, sin = angle.cos()[:, None], angle.sin()[:, None]
        first, second = pairs[..., 0, :], pairs[..., 1, :]
        return torch.stack([first * cos - second * sin, first * sin + second * cos], -2).flatten(-3)
