"""A prior whose context is a set of patterns: log-linear weights, one row for each pattern."""

from typing import Any, Literal, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from neuroprior._checks import check_range, check_sizes, is_integer
from neuroprior._random import draw_seed, generator_on
from neuroprior.plans import Plans, check_patterns
from neuroprior.priors.learning import training_plans
from neuroprior.priors.prior import Prior
from neuroprior.puzzles.priors.compiled_fit import epoch, frequent, number_patterns

AT_ONCE = 2**22
"""Patterns that are looked up together; bounds memory."""

ADAGRAD = 1.0
"""The initial value of the sums of squared gradients."""


class Steps(NamedTuple):
    """M steps of plans, as a prior of patterns learns from them.

    Attributes:
        patterns: int32 `[M, F]`: what was active before each action.
        last: int64 `[M]`: the action before, or A for the first of a plan.
        action: int64 `[M]`: the action that was chosen.
        plan: int64 `[M]`: the number of each step's plan; the steps of a plan follow one another.
    """

    patterns: Tensor
    last: Tensor
    action: Tensor
    plan: Tensor

    @classmethod
    def of(cls, plans: Plans) -> "Steps":
        """The steps of plans with a context of patterns, plan after plan."""
        assert plans.context is not None
        mask, actions = plans.mask(), plans.actions.long()
        last = torch.nn.functional.pad(actions, (1, 0), value=plans.num_actions)[:, :-1]
        plan = torch.arange(len(plans), device=mask.device)[:, None].expand_as(mask)
        return cls(plans.context[mask].to(torch.int32), last[mask], actions[mask], plan[mask])

    def check(self, num_actions: int, num_patterns: int) -> None:
        """Raise ValueError unless these are steps of a prior with so many actions and patterns."""
        steps = len(self.action)
        shapes = {"patterns": [steps, num_patterns], "last": [steps], "action": [steps], "plan": [steps]}
        for name, values in self._asdict().items():
            if list(values.shape) != shapes[name]:
                raise ValueError(f"`{name}` must have the shape {shapes[name]}, got {list(values.shape)}.")
        check_patterns(self.patterns)
        check_range("last", self.last, num_actions + 1, "actions")
        check_range("action", self.action, num_actions, "actions")
        if steps == 0:
            raise ValueError("`plans` must have actions to learn from, got none.")


class LogLinearPrior(Prior):
    """The probability of an action is proportional to exp of a sum of weights, one of each active pattern.

    The context is a set of F active patterns, such as what lies in small windows around an agent. Each pattern is a
    number from 0 to 2**31 - 1. Those that occurred often enough in training are the vocabulary; others add nothing.
    The last action has weights, too.

    It is a product of experts, one a pattern (Orseau, Hutter and Lelis, *Levin tree search with context models*, IJCAI
    2023, have such a policy). The log-loss is convex in the weights; they are learned by Adagrad, one step of a plan
    after the other, in a compiled loop on the CPU. A fit that follows another continues from its weights.

    Args:
        num_actions: A.
        num_patterns: F.
        min_count: a pattern is learned where it occurs so often in training.

    Attributes:
        patterns: int32 `[V]`: the vocabulary, sorted.
        weights: float32 `[V + 1, A]`: what each pattern adds to the logits; the last row, of unknown patterns, is 0.
        after: float32 `[A + 1, A]`: what each last action adds, and, in the last row, the beginning of a plan.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> patterns = torch.randint(5, (40, 3, 2), generator=torch.Generator().manual_seed(0), dtype=torch.int32)
        >>> plans = Plans(patterns[..., 0] % 2, 2, context=patterns)
        >>> prior = LogLinearPrior(2, num_patterns=2).fit(plans)
        >>> prior.start(1, torch.tensor([[3, 0]]))[0].argmax(-1).tolist()
        [0]
    """

    tables: tuple[str, ...] = ("patterns", "weights")

    patterns: Tensor
    weights: Tensor
    after: Tensor

    def __init__(self, num_actions: int, num_patterns: int, *, min_count: int = 2) -> None:
        super().__init__(num_actions, num_patterns=num_patterns)
        check_sizes(min_count=min_count)
        self.min_count = min_count
        self.register_buffer("patterns", torch.zeros(0, dtype=torch.int32))
        self.register_buffer("weights", torch.zeros(1, num_actions))
        self.register_buffer("after", torch.zeros(num_actions + 1, num_actions))

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"min_count": self.min_count}

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return ("epochs", "learning_rate", "l2", "loss")

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Learn from plans with a context of patterns `[N, L, F]`; returns self.

        Args:
            plans: `Plans`.
            generator: draws the order of the steps.
            settings: see `fit_steps`.

        Raises:
            ValueError: plans without such a context, or without any action, or an unknown setting.
        """
        self.check_settings(settings)
        return self.fit_steps(Steps.of(training_plans(self, plans)), generator=generator, **settings)

    def fit_steps(
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
            generator: draws the order of the steps.
            epochs: passes over the steps.
            learning_rate: of Adagrad.
            l2: penalty of the weights, in each step of learning.
            loss: "log": the log-loss. "levin": the logarithm of the sum of d / pi over plans, d the actions of a plan
                and 1, pi their probability, which bounds the expansions of Levin tree search: in each pass plans count
                in proportion to their d / pi before it. Learn by log-loss first.

        Raises:
            ValueError: a setting is out of range, or the weights grow beyond all bounds.
        """
        check_sizes(epochs=epochs)
        if not learning_rate > 0:
            raise ValueError(f"`learning_rate` must be above 0, got {learning_rate}.")
        if not l2 >= 0:
            raise ValueError(f"`l2` must be at least 0, got {l2}.")
        if loss not in ("log", "levin"):
            raise ValueError(f'`loss` must be "log" or "levin", got {loss!r}.')
        steps.check(self.num_actions, self.num_patterns or 0)
        random = np.random.default_rng(draw_seed(generator_on(generator, torch.device("cpu"))))
        patterns, last, action, plan = (values.cpu().numpy() for values in steps)
        vocabulary = frequent(patterns, self.min_count)
        rows = number_patterns(vocabulary, patterns)
        old_rows = self.rows(torch.from_numpy(vocabulary).to(self.device))
        weights = torch.cat([self.weights[old_rows], torch.zeros_like(self.weights[:1])]).cpu().numpy()
        after = self.after.cpu().numpy().copy()
        squares = np.full_like(weights, ADAGRAD), np.full_like(after, ADAGRAD)
        counts, losses = np.ones(len(action), np.float32), np.zeros(len(action))

        def go_through(order: Any, learn: bool) -> None:
            tables = counts, weights, after, *squares
            epoch(order, rows, last, action, *tables, learning_rate, l2, learn, losses)

        for _ in range(epochs):
            if loss == "levin":
                go_through(np.arange(len(action)), False)
                counts = _levin_weights(losses, plan)
            go_through(random.permutation(len(action)), True)
        if not (np.isfinite(weights).all() and np.isfinite(after).all()):
            raise ValueError(
                f"`learning_rate` and `l2` must be so low that weights stay finite, got {learning_rate} and {l2}."
            )
        for name, values in (("patterns", vocabulary), ("weights", weights), ("after", after)):
            self.register_buffer(name, torch.from_numpy(values).to(self.device))
        return self

    def rows(self, patterns: Tensor) -> Tensor:
        """The row of each of `patterns [...]` in the tables, int64; V for those that are not in the vocabulary."""
        size = len(self.patterns)
        if size == 0:
            return torch.zeros_like(patterns, dtype=torch.long)
        at = torch.searchsorted(self.patterns, patterns.to(torch.int32).contiguous()).clamp_(max=size - 1)
        return torch.where(self.patterns[at] == patterns, at, size)

    def scores(self, patterns: Tensor | None) -> Tensor:
        """What the active `patterns [M, F]` add to the logits, `[M, A]`; ValueError for anything else."""
        if patterns is None or patterns.shape[1:] != (self.num_patterns,) or not is_integer(patterns):
            got = "none" if patterns is None else f"{patterns.dtype} {list(patterns.shape)}"
            raise ValueError(f"`context` must be {self.num_patterns} patterns of each state, integers, got {got}.")
        parts = patterns.split(max(AT_ONCE // patterns.shape[1], 1))
        return torch.cat([self.weights[self.rows(chunk.to(torch.int32))].sum(1) for chunk in parts])

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        self.check_start(batch_size, context)
        last = torch.full((batch_size,), self.num_actions, device=self.device)
        return self._logits_and_state(self.scores(context), last)

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        self.check_step(action, context)
        return self._logits_and_state(state[:, :-1] if context is None else self.scores(context), action.long())

    def _logits_and_state(self, scores: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
        return scores + self.after[last], torch.cat([scores, last[:, None].to(scores.dtype)], 1)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        num, length = plans.shape
        scores = self.scores(None if context is None else context[:, :length].flatten(0, 1))
        last = torch.nn.functional.pad(plans.long(), (1, 0), value=self.num_actions)[:, :length]
        return scores.view(num, length, self.num_actions) + self.after[last]

    def tables_fit(self) -> bool:
        """Whether the tables are those of a prior of this kind; checks what was read from a file."""
        vocabulary_size, actions = len(self.patterns), self.num_actions
        return (
            self.patterns.shape == (vocabulary_size,)
            and self.weights.shape == (vocabulary_size + 1, actions)
            and self.after.shape == (actions + 1, actions)
            and bool((self.patterns.diff() > 0).all())
        )


def _levin_weights(losses: Any, plan: Any) -> Any:
    """How much the steps `[M]` count: d / pi of their plan, over its mean; float32."""
    _, number, sizes = np.unique(plan, return_inverse=True, return_counts=True)
    cost = np.log(sizes + 1.0) + np.bincount(number, losses)
    share = np.exp(cost - cost.max())
    return (share / share.mean())[number].astype(np.float32)
