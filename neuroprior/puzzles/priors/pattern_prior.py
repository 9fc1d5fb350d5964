"""The base of priors over actions whose context is a set of patterns: tables of weights, one row for each pattern."""

from abc import abstractmethod
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from neuroprior._checks import check_range, check_sizes, is_integer
from neuroprior.plans import Plans, check_patterns
from neuroprior.priors.prior import Prior

AT_ONCE = 2**22
"""Patterns that are looked up together; bounds memory."""


class Steps(NamedTuple):
    """M steps of plans, as priors of patterns learn from them.

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
        if tuple(self.patterns.shape) != (steps, num_patterns):
            raise ValueError(f"patterns: shape {[steps, num_patterns]} is expected, not {list(self.patterns.shape)}")
        check_patterns(self.patterns)
        for name, values, most in (("last", self.last, num_actions + 1), ("action", self.action, num_actions)):
            if tuple(values.shape) != (steps,):
                raise ValueError(f"{name}: shape [{steps}] is expected, not {list(values.shape)}")
            check_range(name, values, most, "actions")
        if steps == 0:
            raise ValueError("plans: they have no actions to learn from")


class PatternPrior(Prior):
    """A prior whose context is a set of F active patterns, such as what lies in small windows around an agent.

    Each pattern is a number from 0 to 2**31 - 1; those that occurred often enough in training are its vocabulary, and
    others add nothing. A subclass writes `fit_steps`.

    Args:
        num_actions: A.
        num_patterns: F.
        use_last: the last action counts too; otherwise only how common each action is.
        min_count: a pattern is learned where it occurs so often in training.

    Attributes:
        patterns: int32 `[V]`: the vocabulary, sorted.
        weights: float32 `[V + 1, A]`: what each pattern adds to the logits; the last row, of unknown patterns, is 0.
        after: float32 `[A + 1, A]`: what each last action adds, and, in the last row, the beginning of a plan; without
            `use_last` all rows are alike.

    Raises:
        ValueError: an argument is out of range.
    """

    tables: tuple[str, ...] = ("patterns", "weights")

    patterns: Tensor
    weights: Tensor
    after: Tensor

    def __init__(self, num_actions: int, num_patterns: int, *, use_last: bool = True, min_count: int = 2) -> None:
        super().__init__(num_actions, num_patterns=num_patterns)
        check_sizes(min_count=min_count)
        self.use_last, self.min_count = use_last, min_count
        self.register_buffer("patterns", torch.zeros(0, dtype=torch.int32))
        self.register_buffer("weights", torch.zeros(1, num_actions))
        self.register_buffer("after", torch.zeros(num_actions + 1, num_actions))

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"use_last": self.use_last, "min_count": self.min_count}

    @abstractmethod
    def fit_steps(self, steps: Steps, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Learn from steps; see `fit`."""

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Learn from plans with a context of patterns `[N, L, F]`; returns self.

        Args:
            plans: `Plans`.
            generator: draws what is random in learning.
            settings: those of `fit_settings`.

        Raises:
            ValueError: plans without such a context, or without any action, or an unknown setting.
        """
        self.check_settings(settings)
        plans = self.training_plans(plans)
        return self.fit_steps(Steps.of(plans), generator=generator, **settings)

    def rows(self, patterns: Tensor) -> Tensor:
        """The row of each of `patterns [...]` in the tables, int64; V for those that are not in the vocabulary."""
        size = len(self.patterns)
        if size == 0:
            return torch.zeros_like(patterns, dtype=torch.long)
        at = torch.searchsorted(self.patterns, patterns.to(torch.int32).contiguous()).clamp_(max=size - 1)
        return torch.where(self.patterns[at] == patterns, at, size)

    def scores(self, patterns: Tensor) -> Tensor:
        """What the active `patterns [M, F]` add to the logits, `[M, A]`; ValueError for other shapes, and fractions."""
        if patterns.dim() != 2 or patterns.shape[1] != self.num_patterns or not is_integer(patterns):
            raise ValueError(
                f"context: {self.num_patterns} patterns (integers) of each state are expected, not"
                f" {str(patterns.dtype).removeprefix('torch.')} of shape {list(patterns.shape)}"
            )
        return torch.cat(
            [self._scores(self.rows(some)) for some in patterns.split(max(AT_ONCE // patterns.shape[1], 1))]
        )

    def _scores(self, rows: Tensor) -> Tensor:
        return self.weights[rows].sum(1)

    def _logits(self, scores: Tensor, last: Tensor) -> Tensor:
        return scores + self.after[last]

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if context is None:
            raise ValueError("context: this prior takes a context, and none was given")
        scores = self.scores(context)
        last = torch.full((batch_size,), self.num_actions, device=scores.device)
        return self._logits(scores, last), torch.cat([scores, last[:, None].to(scores.dtype)], 1)

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        scores = state[:, :-1] if context is None else self.scores(context)
        return self._logits(scores, action.long()), torch.cat([scores, action[:, None].to(scores.dtype)], 1)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        num, length = plans.shape
        if context is None or context.dim() != 3:
            raise ValueError("context: this prior takes patterns [N, L, F]")
        scores = self.scores(context[:, :length].reshape(num * length, -1)) if num * length else self.weights[:0]
        last = torch.nn.functional.pad(plans.long(), (1, 0), value=self.num_actions)[:, :length]
        return self._logits(scores, last.reshape(-1)).view(num, length, self.num_actions)

    def set_tables(self, **tables: Any) -> None:
        """Take over tables, by name, numpy arrays or tensors."""
        for name, values in tables.items():
            self.register_buffer(name, torch.as_tensor(values).to(self.device))

    def tables_fit(self) -> bool:
        """Whether the tables are those of a prior of this kind; checks what was read from a file."""
        known, actions = len(self.patterns), self.num_actions
        return (
            self.patterns.shape == (known,)
            and self.patterns.dtype == torch.int32
            and self.weights.shape == (known + 1, actions)
            and self.after.shape == (actions + 1, actions)
            and bool((self.patterns.diff() > 0).all())
            and not bool(self.weights.isnan().any() | self.after.isnan().any())
            and (self.use_last or bool((self.after == self.after[-1]).all()))
        )


def compiled_fit() -> Any:
    """The module of compiled loops; ValueError where numba is not installed."""
    try:
        from neuroprior.puzzles.priors import compiled_fit as module
    except ImportError:
        raise ValueError("priors of patterns learn by compiled loops: pip install 'neuroprior[fast]'") from None
    return module
