"""The transformer prior: attention over the actions so far, with a key-value cache for stepping."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuroprior._checks import check_memory, check_sizes
from neuroprior.plans import Plans
from neuroprior.priors.neural.neural import FEW, Embedding, NeuralPrior, Sizes
from neuroprior.sampling.rows import extended, states_with_room

ALIGNED = 8
"""Numbers that lie together at an address that vector loads can read from."""

ROOM = 16
"""A state of a fixed size has room for a multiple of so many inputs, so that few sizes occur."""

MANY_QUERIES = 1024
"""Plans whose single next query is answered faster by matrix products than by the fused kernels of a CUDA device, which
are made for many queries: three times as fast on an H100, from 16,384 plans with 32 keys each."""

FEWEST_AT_ONCE = 32
"""Inputs of a sequence that are read at once, at least, past the training length."""


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

    def encode(self, inputs: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
        most = self.most_kept
        if most is not None and inputs.shape[1] > max(most, FEWEST_AT_ONCE):
            return self._encode_in_parts(inputs, hidden, max(most, FEWEST_AT_ONCE))
        recent, past = (None, None) if hidden is None else self._unpacked(hidden)
        x, recent = self.embedding(inputs, recent, self.window)
        x = self.drop(x)
        caches = []
        for layer, block in enumerate(self.blocks):
            x, cache = block(x, None if past is None else past[:, :, layer], self.span, self.window)
            caches.append(cache)
        cache = torch.stack(caches, 2)
        number = recent.new_full((len(cache), self.header - self.input_size - recent.shape[1]), cache.shape[1])
        return self.head(self.norm(x)), torch.cat([recent, number, cache.flatten(1)], 1)

    def _encode_in_parts(self, inputs: Tensor, hidden: Tensor | None, size: int) -> tuple[Tensor, Tensor]:
        """As `encode`, part by part, since the cost of attention grows with the square of what is read at once."""
        logits = []
        for part in inputs.split(size, 1):
            out, hidden = self.encode(part, hidden)
            logits.append(out)
        assert hidden is not None
        return torch.cat(logits, 1), hidden

    def _unpacked(self, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """The actions before, and the key-value cache `[N, S, num_layers, 2 * width]` from the oldest input on.

        Its keys are at the positions 0 to S - 1, as those that are read at once.
        """
        cache = hidden[:, self.header - self.input_size :].unflatten(1, (-1, self.num_layers, 2 * self.width))
        kept, number = cache.shape[1], self._number(hidden)
        if number > kept:
            first = 0 if self.window is None else 1  # the start symbol stays where it is
            turned = torch.roll(cache[:, first:], -((number - first) % (kept - first)), 1)
            key, value = torch.cat([cache[:, :first], turned], 1).chunk(2, -1)
            back = rotation(torch.tensor([kept - number], device=cache.device), self.width // self.num_heads)
            cache = torch.cat([rotate(key.flatten(1, 2), *back).view(key.shape), value], -1)
        return hidden[:, : self.lags - 1], cache

    def _number(self, hidden: Tensor) -> int:
        """How many inputs were read before; the position of the next one."""
        kept = (hidden.shape[1] + self.input_size - self.header) // self.cache_size
        full = kept == self.most_kept and len(hidden) > 0
        return int(hidden[0, self.lags - 1]) if full else kept

    @property
    def most_kept(self) -> int | None:
        """At most so many inputs are kept in the key-value cache; if None, no limit."""
        return self.window + 1 if self.window is not None else None if self.span is None else self.span + 1

    @property
    def header(self) -> int:
        """How many numbers of a state lie before the key-value cache.

        They are the last input, the actions before it, and how many inputs there were; this fills up the rest, so that
        keys and values lie where kernels of a CUDA device can read them.
        """
        return -(-(self.input_size + self.lags) // ALIGNED) * ALIGNED

    @property
    def cache_size(self) -> int:
        """Numbers of the key-value cache for each input."""
        return self.num_layers * 2 * self.width

    @torch.no_grad()
    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if not self.writes_in_place(state):
            return super().step(action, state, context)
        self.check_step(action, context)
        return self._step_in_place(action, state, context)

    @torch.no_grad()
    def advance(
        self, action: Tensor, state: Tensor, context: Tensor | None = None, room: int = 0
    ) -> tuple[Tensor, Tensor]:
        if not self.writes_in_place(state) or type(self).step is not TransformerPrior.step:
            return self.step(action, state, context)
        return self._step_in_place(action, state, context, room)

    def _step_in_place(
        self, action: Tensor, state: Tensor, context: Tensor | None, room: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """A step in which new keys and values are written behind the cache, which is the largest part of the state.

        Where the cache is full they are written over the oldest.

        Args:
            action, state, context: see `step`.
            room: None: the cache is copied once, and `state` stays as it is. Otherwise a state that has room is
                overwritten, and any other is copied to a tensor with room for so many further steps.
        """
        given, recent, header, most = self.input_size, self.input_size + self.lags - 1, self.header, self.most_kept
        number, kept = self._number(state[:, given:]), (state.shape[1] - header) // self.cache_size
        new = self._inputs(action, context, state[:, :given])
        x, line = self.embedding(new[:, None], state[:, given:recent], self.window)
        grown = kept if kept == most else kept + 1
        size = header + grown * self.cache_size
        after = None if room is None else extended(state, size)
        if after is None:
            more = 0 if room is None else room if most is None else min(room, most - grown)
            after = states_with_room(state, size, more * self.cache_size)
            after[:, header : state.shape[1]] = state[:, header:]
        after[:, :given], after[:, given:recent], after[:, recent:header] = new, line, number + 1
        cache = after[:, header:].unflatten(1, (grown, self.num_layers, -1))
        first = 0 if self.window is None else 1
        place = number if number < grown else first + (number - first) % (grown - first)
        if self.window is not None and number > self.window:
            self._keep_distance(cache, torch.tensor([1], device=state.device))
        here = torch.tensor([number], device=state.device)
        return self._read(x, cache, here, slice(place, place + 1), None), after

    def fixed_state(self, state: Tensor, steps: int) -> Tensor:
        kept, most = (state.shape[1] - self.header) // self.cache_size, self.most_kept
        slots = -(-(kept + steps) // ROOM) * ROOM
        slots = slots if most is None else min(slots, most)
        return functional.pad(state, (0, (slots - kept) * self.cache_size))

    def fixed_step(self, action: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        given, recent, header = self.input_size, self.input_size + self.lags - 1, self.header
        cache = state[:, header:].unflatten(1, (-1, self.num_layers, 2 * self.width))
        number, slots = state[0, recent : recent + 1].long(), cache.shape[1]
        new = self._inputs(action, None, state[:, :given])
        x, line = self.embedding(new[:, None], state[:, given:recent], self.window)
        state[:, :given], state[:, given:recent], state[:, recent:header] = new, line, number + 1
        first = 0 if self.window is None else 1
        place = torch.where(number < slots, number, first + (number - first) % max(slots - first, 1))
        if self.window is not None:
            self._keep_distance(cache, (number > self.window).long())
        filled = torch.arange(slots, device=state.device) <= number
        return self._read(x, cache, number, place, filled[None]), state

    def _keep_distance(self, cache: Tensor, steps: Tensor) -> None:
        """Turn the start symbol's keys in `cache [N, S, num_layers, 2 * width]` by so many `steps [1]`."""
        key = cache[:, 0, :, : self.width]
        key.copy_(rotate(key, *rotation(steps, self.width // self.num_heads)))

    def _read(self, x: Tensor, cache: Tensor, number: Tensor, place: slice | Tensor, filled: Tensor | None) -> Tensor:
        """The logits `[N, A]` after one more input.

        Args:
            x: `[N, 1, width]`, its vectors.
            cache: `[N, S, num_layers, 2 * width]`, in which its keys and values are written to this `place`.
            number: `[1]`, its position.
            filled: bool `[1, S]`: the places that are attended to; None: all.
        """
        turns = rotation(number, self.width // self.num_heads)
        for layer, block in enumerate(self.blocks):
            assert isinstance(block, Block)
            x = block.step(x, cache[:, :, layer], place, turns, filled)
        logits: Tensor = self.head(self.norm(x))
        return logits[:, 0]

    def writes_in_place(self, state: Tensor) -> bool:
        """Whether the next step may be written in place.

        In training, under autocast, and in subclasses with an `encode` of their own it is not.
        """
        plain = type(self).encode is TransformerPrior.encode and not (self.training or torch.is_grad_enabled())
        return plain and self.window != 0 and not torch.is_autocast_enabled(state.device.type)


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
        self, x: Tensor, past: Tensor | None, span: int | None, window: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """`x [N, T, width]` after `past [N, S, 2 * width]`: the new `x`, and the keys and values to be kept.

        Each input attends to itself and those before it, at most `span` back. Positions count from the first input of
        the past; where the oldest ones are dropped, the keys that are kept are rotated back by as many positions.

        With a `window`, each input attends to the first one and to the last `window`, itself among them; the first is
        never further away than `window`, and is kept.
        """
        start, size = 0 if past is None else past.shape[1], x.shape[-1] // self.num_heads
        place = torch.arange(start, start + x.shape[1], device=x.device)
        turns = rotation(place, size)
        unturned, key, value = self._project(x)
        query, key = rotate(unturned, *turns), rotate(key, *turns)
        if past is not None:
            # under autocast new keys and values may be of another dtype than kept ones
            key, value = torch.cat([past.to(key.dtype), torch.cat([key, value], -1)], 1).chunk(2, -1)
        if window is None or key.shape[1] <= window + 1:
            mixed = self._attend(query, key, value, span)
        else:
            near = rotate(unturned, *rotation(place.clamp(max=window), size))
            mixed = self._attend_to_first(query, near, key, value, window)
        x = self._add(x, mixed)
        most = span if window is None else window + 1
        excess = 0 if most is None else max(key.shape[1] - most, 0)
        if excess:
            first, back = (0 if window is None else 1), rotation(place.new_tensor([-excess]), size)
            key = torch.cat([key[:, :first], rotate(key[:, first + excess :], *back)], 1)
            value = torch.cat([value[:, :first], value[:, first + excess :]], 1)
        return x, torch.cat([key, value], -1)

    def step(
        self, x: Tensor, cache: Tensor, place: slice | Tensor, turns: tuple[Tensor, Tensor], filled: Tensor | None
    ) -> Tensor:
        """The new `x [N, 1, width]`; keys and values are written to this place of `cache [N, S, 2 * width]`.

        `turns`: the rotation of the input's position; `filled`: see `TransformerPrior`.
        """
        query, key, value = self._project(x)
        cache[:, place] = torch.cat([rotate(key, *turns), value], -1)
        key, value = cache.chunk(2, -1)
        return self._add(x, self._attend(rotate(query, *turns), key, value, None, filled))

    def _project(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values of `x [N, T, width]`."""
        query, key, value = self.query_key_value(self.attention_norm(x)).chunk(3, -1)
        return query, key, value

    def _add(self, x: Tensor, mixed: Tensor) -> Tensor:
        """`x` plus the output of attention, `mixed`, and then plus that of the two-layer network."""
        x = x + self.drop(self.out(mixed.to(x.dtype)))  # keys and values are kept in single precision
        added: Tensor = self.drop(self.mlp(x))
        return x + added

    def _attend(
        self, query: Tensor, key: Tensor, value: Tensor, span: int | None, filled: Tensor | None = None
    ) -> Tensor:
        """`[N, T, width]`: attention of each query over keys and values `[N, S + T, width]`, or those `filled`."""
        num, total = query.shape[1], key.shape[1]
        span = total if span is None else span
        every = total <= span + 1
        plain = num == total and every
        mask = filled if plain or (num == 1 and every) else reached(num, total, span, query.device)
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


def rotation(place: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Cosine and sine `[T, size / 2]` of the angles by which heads of this size are rotated at `place [T]`."""
    half = size // 2
    angle = place[:, None] * 10_000 ** -(torch.arange(half, device=place.device) / half)
    return angle.cos(), angle.sin()


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Each pair of numbers of each head of `x [N, T, width]` rotated by the angles of its position, see `rotation`."""
    first, second = x.unflatten(-1, (-1, 2, cos.shape[-1])).unbind(-2)
    cos, sin = cos[:, None], sin[:, None]
    return torch.stack([first * cos - second * sin, first * sin + second * cos], -2).flatten(-3)
