"""The transformer prior: attention over the actions so far, with a key-value cache for stepping."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuroprior.priors.neural import Embedding, NeuralPrior
from neuroprior.priors.prior import check_sizes


class TransformerPrior(NeuralPrior):
    """A pre-norm transformer (Vaswani et al. 2017) with rotary positions (Su et al. 2021) as a prior.

    The memory of its state is the key-value cache: `num_layers * 2 * width` numbers for each input so far.

    Args:
        num_actions: A.
        width: width of the vectors; a multiple of 2 * `num_heads`.
        num_layers: number of blocks.
        num_heads: attention heads.
        window: how many past actions are read; None: set by `fit`; see `NeuralPrior`.
        num_contexts, context_size: what it sees; see `Prior`.
        seed: draws the initial weights.

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(
        self,
        num_actions: int,
        width: int = 64,
        num_layers: int = 2,
        num_heads: int = 4,
        window: int | None = None,
        num_contexts: int | None = None,
        context_size: int | None = None,
        seed: int = 0,
    ) -> None:
        check_sizes(width=width, num_layers=num_layers, num_heads=num_heads)
        if width % (2 * num_heads):
            raise ValueError(f"width: a multiple of 2 * num_heads = {2 * num_heads} is expected, not {width}")
        self.width, self.num_layers, self.num_heads = width, num_layers, num_heads
        super().__init__(num_actions, window, num_contexts, context_size, seed)

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"width": self.width, "num_layers": self.num_layers, "num_heads": self.num_heads}

    def build(self) -> None:
        self.embedding = Embedding(self.num_actions, self.width, self.num_contexts, self.context_size)
        self.blocks = nn.ModuleList(_Block(self.width, self.num_heads) for _ in range(self.num_layers))
        self.norm = nn.LayerNorm(self.width)
        self.head = nn.Linear(self.width, self.num_actions)

    def encode(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        x = self.embedding(inputs)
        caches = []
        for block in self.blocks:
            x, cache = block(x, None)
            caches.append(cache)
        return self.head(self.norm(x)), torch.stack(caches, 2).flatten(1)

    def advance(self, inputs: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        past = memory.view(len(memory), -1, self.num_layers, 2 * self.width)
        x = self.embedding(inputs)[:, None]
        caches = []
        for layer, block in enumerate(self.blocks):
            x, cache = block(x, past[:, :, layer])
            caches.append(cache)
        memory = torch.cat([past, torch.stack(caches, 2)], 1)
        return self.head(self.norm(x[:, 0])), memory.flatten(1)

    def memory_size(self, state_size: int) -> int:
        cache = self.num_layers * 2 * self.width
        if self.window is None:
            return state_size - self.input_size
        return state_size // (cache + self.input_size) * cache


class _Block(nn.Module):
    """Attention and a two-layer network, each behind a layer norm and added to its input."""

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.attention_norm = nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.mlp = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width)
        )

    def forward(self, x: Tensor, past: Tensor | None) -> tuple[Tensor, Tensor]:
        """`x [N, T, width]` after `past [N, S, 2 * width]`: the new `x`, and its keys and values `[N, T, 2 * width]`.

        Without a past the T inputs attend to those before them; with one, T is 1.
        """
        query, key, value = self.query_key_value(self.attention_norm(x)).chunk(3, -1)
        offset = 0 if past is None else past.shape[1]
        query, key = self._rotate(query, offset), self._rotate(key, offset)
        own = torch.cat([key, value], -1)
        if past is not None:
            key, value = torch.cat([past, own], 1).chunk(2, -1)
        query, key, value = (v.unflatten(-1, (self.num_heads, -1)).transpose(1, 2) for v in (query, key, value))
        mixed = functional.scaled_dot_product_attention(query, key, value, is_causal=past is None)
        x = x + self.out(mixed.transpose(1, 2).flatten(2))
        return x + self.mlp(x), own

    def _rotate(self, x: Tensor, offset: int) -> Tensor:
        """Turn each pair of numbers of each head by an angle proportional to the position (from `offset`)."""
        pairs = x.unflatten(-1, (self.num_heads, 2, -1))
        half = pairs.shape[-1]
        rate = 10_000 ** -(torch.arange(half, device=x.device) / half)
        angle = (torch.arange(x.shape[1], device=x.device)[:, None] + offset) * rate
        cos, sin = angle.cos()[:, None], angle.sin()[:, None]
        first, second = pairs[..., 0, :], pairs[..., 1, :]
        return torch.stack([first * cos - second * sin, first * sin + second * cos], -2).flatten(-3)
