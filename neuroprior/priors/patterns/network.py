"""A network on patterns: the sum of the active patterns' vectors, then layers, beside a log-linear prior."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuroprior._checks import check_memory, check_sizes
from neuroprior._random import generator_on
from neuroprior.priors.patterns.log_linear import LogLinearPrior
from neuroprior.priors.patterns.minibatches import train
from neuroprior.priors.patterns.pattern_prior import Loss
from neuroprior.priors.patterns.steps import Steps, numbered

CHUNK = 2**14
"""Steps whose loss is computed together."""


class PatternNetwork(LogLinearPrior):
    """The log-linear prior, and a network of the sum of the active patterns' vectors; their logits are added.

    The log-linear part is fitted first and then kept; the network begins at 0, and so is never worse on what it is
    stopped by. Its parameters, which the compiled search reads beside the tables of `LogLinearPrior`:

    - `embeddings`, float32 `[V + 1, E]`: the patterns' vectors; the last, 0, is that of all others.
    - `hidden_weights[0] [H, E]`, `hidden_weights[i] [H, H]`, `hidden_biases[i] [H]`: ReLU layers on the sum.
    - `out [A, H]`: from the last layer to the logits, without a bias.

    Args:
        num_actions: A.
        num_patterns: F, the number of patterns that are active in each state.
        embedding: E.
        hidden: H.
        depth: >= 1, layers.
        min_count: patterns that occur less often in the plans of one `fit` are not made known by it.
        order: >= 0, the last actions that count, in the log-linear part.

    Raises:
        ValueError: an argument is out of range.
    """

    tables = ("patterns", "weights", "embeddings")

    def __init__(
        self,
        num_actions: int,
        num_patterns: int,
        *,
        embedding: int = 16,
        hidden: int = 32,
        depth: int = 1,
        min_count: int = 2,
        order: int = 1,
    ) -> None:
        super().__init__(num_actions, num_patterns, order=order, min_count=min_count)
        check_sizes(embedding=embedding, hidden=hidden, depth=depth)
        check_memory(4 * hidden * (embedding + hidden * (depth - 1)), embedding=embedding, hidden=hidden, depth=depth)
        self.embedding, self.hidden, self.depth = embedding, hidden, depth
        sizes = [embedding] + [hidden] * (depth - 1)
        self.embeddings = nn.Parameter(torch.zeros(1, embedding))
        self.hidden_weights = nn.ParameterList([torch.zeros(hidden, size) for size in sizes])
        self.hidden_biases = nn.ParameterList([torch.zeros(hidden) for _ in sizes])
        self.out = nn.Parameter(torch.zeros(num_actions, hidden))

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"embedding": self.embedding, "hidden": self.hidden, "depth": self.depth}

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return (*super().fit_settings, "network_epochs", "batch_size", "learning_rate")

    def step_logits(self, patterns: Tensor, last: Tensor) -> Tensor:
        return super().step_logits(patterns, last) + self.network_logits(numbered(patterns, self.patterns))

    def network_logits(self, number: Tensor, sparse: bool = False) -> Tensor:
        """What the network adds to the logits, `[M, A]`, for patterns of these numbers, int32 `[M, F]`."""
        unknown = len(self.patterns)
        values = functional.embedding_bag(number, self.embeddings, mode="sum", sparse=sparse, padding_idx=unknown)
        for weight, bias in zip(self.hidden_weights, self.hidden_biases, strict=True):
            values = functional.linear(values, weight, bias).relu()
        return functional.linear(values, self.out)

    def learn(
        self,
        steps: Steps,
        held_out: Steps | None,
        generator: torch.Generator | None,
        *,
        epochs: int = 30,
        l2: float = 1e-6,
        loss: Loss = "log",
        network_epochs: int = 10,
        batch_size: int = 1024,
        learning_rate: float = 2e-3,
    ) -> None:
        """Fit the log-linear part (see `LogLinearPrior.learn`), then the network by log-loss, with Adam.

        Args:
            steps, held_out, epochs, l2, loss: see `LogLinearPrior.learn`.
            generator: draws the first weights, and the order of the steps.
            network_epochs: at most so many times the network sees all steps.
            batch_size: steps of a batch.
            learning_rate: of Adam.

        Raises:
            ValueError: a setting is out of range.
        """
        check_sizes(network_epochs=network_epochs, batch_size=batch_size)
        if not learning_rate > 0:
            raise ValueError(f"learning_rate: a number above 0 is expected, not {learning_rate}")
        super().learn(steps, held_out, generator, epochs=epochs, l2=l2, loss=loss)
        generator = generator_on(generator, "cpu")
        self._begin(generator)
        number, base = self._inputs(steps)
        weight = steps.weights() / steps.weights().mean()

        def loss_at(index: Tensor) -> Tensor:
            logits = base[index] + self.network_logits(number[index], sparse=True)
            return (weight[index] * functional.cross_entropy(logits, steps.action[index], reduction="none")).mean()

        others = [*self.hidden_weights, *self.hidden_biases, self.out]
        optimisers = [
            torch.optim.SparseAdam([self.embeddings], learning_rate),
            torch.optim.Adam(others, learning_rate),
        ]
        train(
            [self.embeddings, *others],
            optimisers,
            loss_at,
            None if held_out is None else _HeldOut(self, held_out),
            len(steps.action),
            epochs=network_epochs,
            batch_size=batch_size,
            generator=generator,
        )

    @torch.no_grad()
    def _begin(self, generator: torch.Generator) -> None:
        """Draw the weights of a network that has not learned yet, and the vectors of patterns that are new.

        `out` stays 0 at first, so that the network changes nothing before it has learned.
        """
        if not any(bool(weight.any()) for weight in self.hidden_weights):
            for weight in self.hidden_weights:
                weight.copy_(torch.randn(weight.shape, generator=generator) * (2 / weight.shape[1]) ** 0.5)
        new = ~self.embeddings.any(1)
        drawn = torch.randn(self.embeddings.shape, generator=generator) * (self.num_patterns or 1) ** -0.5
        drawn[-1] = 0
        self.embeddings.copy_(torch.where(new[:, None], drawn, self.embeddings))

    @torch.no_grad()
    def _inputs(self, steps: Steps) -> tuple[Tensor, Tensor]:
        """The numbers of the patterns, int32 `[M, F]`, and the logits of the log-linear part, `[M, A]`."""
        number = torch.empty_like(steps.patterns)
        base = torch.empty(len(number), self.num_actions)
        for at in range(0, len(number), CHUNK):
            here = slice(at, at + CHUNK)
            number[here] = numbered(steps.patterns[here], self.patterns)
            base[here] = LogLinearPrior.step_logits(self, steps.patterns[here], steps.last[here])
        return number, base


class _HeldOut:
    """The log-loss of a network on steps that are held out."""

    def __init__(self, prior: PatternNetwork, steps: Steps) -> None:
        self.prior, self.steps = prior, steps
        self.number, self.base = prior._inputs(steps)
        self.weight = steps.weights() / steps.weights().sum()

    @torch.no_grad()
    def __call__(self) -> float:
        total = 0.0
        for at in range(0, len(self.number), CHUNK):
            here = slice(at, at + CHUNK)
            logits = self.base[here] + self.prior.network_logits(self.number[here])
            total += float(
                self.weight[here] @ functional.cross_entropy(logits, self.steps.action[here], reduction="none")
            )
        return total
