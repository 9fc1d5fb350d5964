"""Log-linear weights of patterns, and a small network on the same patterns."""

from typing import Any, Literal, Self

import numpy as np
import torch
from torch import Tensor

from neuroprior._checks import check_count, check_memory, check_sizes
from neuroprior._random import draw_seed, generator_on
from neuroprior.puzzles.priors.pattern_prior import PatternPrior, Steps, compiled_fit

ADAGRAD = 1.0
"""The initial value of the sums of squared gradients."""


class LogLinearPrior(PatternPrior):
    """The probability of an action is proportional to exp of a sum of weights, one of each active pattern.

    It is a product of experts, one a pattern (Orseau, Hutter and Lelis, *Levin tree search with context models*, IJCAI
    2023, have such a policy). The log-loss is convex in the weights; they are learned by Adagrad, one step of a plan
    after the other. A fit that follows another continues from its weights.

    Args:
        num_actions, num_patterns, use_last, min_count: see `PatternPrior`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> patterns = torch.randint(5, (40, 3, 2), generator=torch.Generator().manual_seed(0), dtype=torch.int32)
        >>> plans = Plans(patterns[..., 0] % 2, 2, context=patterns)
        >>> prior = LogLinearPrior(2, num_patterns=2).fit(plans)
        >>> prior.start(1, torch.tensor([[3, 0]]))[0].argmax(-1).tolist()
        [0]
    """

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return ("epochs", "learning_rate", "l2", "loss")

    def fit_steps(  # type: ignore[override]
        self,
        steps: Steps,
        *,
        generator: torch.Generator | None = None,
        epochs: int = 4,
        learning_rate: float = 0.2,
        l2: float = 1e-4,
        loss: Literal["log", "levin"] = "log",
    ) -> Self:
        """Learn from steps; returns self.

        Args:
            steps: see `Steps`.
            generator: draws the order of the steps, and the first weights of a network.
            epochs: passes over the steps.
            learning_rate: of Adagrad.
            l2: penalty of the weights, in each step of learning.
            loss: "log": the log-loss. "levin": the logarithm of the sum of d / pi over plans, d the actions of a plan
                and 1, pi their probability, which bounds the expansions of Levin tree search: in each pass plans count
                in proportion to their d / pi before it. Learn by log-loss first.

        Raises:
            ValueError: a setting is out of range, the weights grow beyond all bounds, or numba is not installed.
        """
        check_sizes(epochs=epochs)
        if not learning_rate > 0 or not l2 >= 0:
            raise ValueError(f"learning_rate, l2: above 0 and at least 0 are expected, not {learning_rate} and {l2}")
        if loss not in ("log", "levin"):
            raise ValueError(f'loss: "log" or "levin" is expected, not {loss!r}')
        steps.check(self.num_actions, self.num_patterns or 0)
        loops = compiled_fit()
        random = np.random.default_rng(draw_seed(generator_on(generator, torch.device("cpu"))))
        patterns = steps.patterns.cpu().numpy()
        vocabulary = loops.frequent([patterns], self.min_count)
        tables = self._grown(torch.from_numpy(vocabulary), random)
        rows = loops.numbered(vocabulary, patterns)
        last = steps.last.cpu().numpy() if self.use_last else np.full(len(patterns), self.num_actions)
        squares = tuple(np.full(t.shape[:1] if k == 2 else t.shape, ADAGRAD, np.float32) for k, t in enumerate(tables))
        action, plan = steps.action.cpu().numpy(), steps.plan.cpu().numpy()
        counts, losses = np.ones(len(action), np.float32), np.zeros(len(action))
        for _ in range(epochs):
            if loss == "levin":
                every = np.arange(len(action))
                loops.epoch(every, rows, last, action, counts, *tables, squares, learning_rate, l2, False, losses)
                counts = _levin_weights(losses, plan)
            order = random.permutation(len(action))
            loops.epoch(order, rows, last, action, counts, *tables, squares, learning_rate, l2, True, losses)
        if not all(np.isfinite(table).all() for table in tables):
            raise ValueError(
                f"learning_rate, l2: with {learning_rate} and {l2} weights become infinite; give lower ones"
            )
        if not self.use_last:
            tables[1][:] = tables[1][-1]
        self._take(vocabulary, tables)
        return self

    def _grown(self, vocabulary: Tensor, random: np.random.Generator) -> list[Any]:
        """The tables for a new vocabulary, with the present values of patterns that were known."""
        known = self.rows(vocabulary.to(self.device))
        weights = self.weights[torch.cat([known, known.new_full((1,), len(self.patterns))])]
        actions = self.num_actions
        empty = np.zeros((len(weights), 0), np.float32), np.zeros((0, 0, 0), np.float32), np.zeros((0, 0), np.float32)
        return [_array(weights), _array(self.after), *empty, np.zeros((actions, 0), np.float32)]

    def _take(self, vocabulary: Any, tables: list[Any]) -> None:
        self.set_tables(patterns=vocabulary, weights=tables[0], after=tables[1])


class PatternNetwork(LogLinearPrior):
    """Log-linear weights of patterns, and a network on the sum of their embeddings: cheap enough for a search.

    The logits are those of `LogLinearPrior` plus those of the network: the embeddings of the active patterns are
    summed, pass through a rectifier, through `depth` layers of the same size with one, and to the actions.

    Args:
        num_actions, num_patterns, use_last, min_count: see `PatternPrior`.
        size: E, numbers in an embedding.
        depth: layers behind the sum, D; 0: the sum, rectified, goes to the actions.

    Attributes:
        embeddings: float32 `[V + 1, E]`; the last row, of unknown patterns, is 0.
        layers, biases, out: float32 `[D, E, E]`, `[D, E]`, `[A, E]`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> prior = PatternNetwork(4, num_patterns=2)  # prior.fit(plans) trains it
        >>> prior.num_patterns
        2
    """

    tables = (*PatternPrior.tables, "embeddings")

    embeddings: Tensor
    layers: Tensor
    biases: Tensor
    out: Tensor

    def __init__(
        self,
        num_actions: int,
        num_patterns: int,
        *,
        size: int = 16,
        depth: int = 1,
        use_last: bool = True,
        min_count: int = 2,
    ) -> None:
        super().__init__(num_actions, num_patterns, use_last=use_last, min_count=min_count)
        check_sizes(size=size)
        check_memory(4 * size * num_actions, size=size)
        check_count("depth", depth, 4 * size * size)
        self.size, self.depth = size, depth
        self.register_buffer("embeddings", torch.zeros(1, size))
        self.register_buffer("layers", torch.zeros(depth, size, size))
        self.register_buffer("biases", torch.zeros(depth, size))
        self.register_buffer("out", torch.zeros(num_actions, size))

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"size": self.size, "depth": self.depth}

    def _scores(self, rows: Tensor) -> Tensor:
        hidden = self.embeddings[rows].sum(1).relu()
        for layer, bias in zip(self.layers, self.biases, strict=True):
            hidden = (hidden @ layer.T + bias).relu()
        return super()._scores(rows) + hidden @ self.out.T

    def _grown(self, vocabulary: Tensor, random: np.random.Generator) -> list[Any]:
        tables = super()._grown(vocabulary, random)
        size, depth, before = self.size, self.depth, len(self.patterns)
        first = before == 0 and not bool(self.out.any())
        known = self.rows(vocabulary.to(self.device))
        drawn = random.normal(0, 0.1, (len(vocabulary) + 1, size)).astype(np.float32)
        drawn[-1] = 0
        old = (known < before).cpu().numpy()
        drawn[:-1][old] = _array(self.embeddings[known[known < before]])
        tables[2] = drawn
        if first:
            tables[3] = random.normal(0, (2 / size) ** 0.5, (depth, size, size)).astype(np.float32)
            tables[4] = np.zeros((depth, size), np.float32)
            tables[5] = random.normal(0, 0.1, (self.num_actions, size)).astype(np.float32)
        else:
            tables[3:] = [_array(self.layers), _array(self.biases), _array(self.out)]
        return tables

    def _take(self, vocabulary: Any, tables: list[Any]) -> None:
        super()._take(vocabulary, tables)
        self.set_tables(embeddings=tables[2], layers=tables[3], biases=tables[4], out=tables[5])

    def tables_fit(self) -> bool:
        return super().tables_fit() and self.embeddings.shape == (len(self.patterns) + 1, self.size)


def _levin_weights(losses: Any, plan: Any) -> Any:
    """How much the steps `[M]` count: d / pi of their plan, over its mean; float32."""
    _, number, sizes = np.unique(plan, return_inverse=True, return_counts=True)
    cost = np.log(sizes + 1.0) + np.bincount(number, losses)
    share = np.exp(cost - cost.max())
    return (share / share.mean())[number].astype(np.float32)


def _array(values: Tensor) -> Any:
    """A contiguous copy, float32."""
    return values.detach().cpu().float().numpy().copy()
