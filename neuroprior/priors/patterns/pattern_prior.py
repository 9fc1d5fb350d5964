"""The base of priors that see patterns: tables of weights, one row a pattern, summed over those that are active."""

from abc import abstractmethod
from typing import Any, Literal, Self

import torch
from torch import Tensor
from torch.nn import functional

from neuroprior._checks import check_count, check_memory
from neuroprior.plans import Plans
from neuroprior.priors.patterns.steps import (
    Steps,
    checked_steps,
    flat_steps,
    histories,
    next_history,
    numbered,
    split_steps,
)
from neuroprior.priors.prior import Prior

VALIDATION = 0.1
"""The share of plans (or groups) that decide when a training stops."""


class PatternPrior(Prior):
    """A prior whose logits are sums of rows: of each active pattern, of the last actions, and one that is always there.

    Buffers, which the compiled search reads:

    - `patterns`, int32 `[V]`, ascending: the patterns that are known.
    - `weights`, float32 `[V + 1, A]`: their rows; the last, 0, is that of all others.
    - `action_weights`, float32 `[H, A]`: a row for each history of the last `order` actions, numbered as in
      `neuroprior.priors.patterns.steps.next_history`: of order 1 the last action, or A where there is none yet.
    - `bias`, float32 `[A]`.

    The state is int32 `[N, F + 1]`: the patterns, and the number of the history. A subclass writes `learn`.

    Args:
        num_actions: A.
        num_patterns: F, the number of patterns that are active in each state.
        order: >= 0, the last actions that count.

    Raises:
        ValueError: an argument is out of range.
    """

    patterns: Tensor
    weights: Tensor
    action_weights: Tensor
    bias: Tensor
    _following: Tensor

    tables: tuple[str, ...] = ("patterns", "weights")
    """The names of the buffers and parameters whose sizes depend on what was learned."""

    def __init__(self, num_actions: int, num_patterns: int, *, order: int = 1) -> None:
        super().__init__(num_actions, num_patterns=num_patterns)
        check_count("order", order)
        check_memory(8 * num_actions ** min(order + 1, 64), num_actions=num_actions, order=order)
        self.order = order
        following = next_history(num_actions, order)
        self.register_buffer("_following", following, persistent=False)
        self.register_buffer("patterns", torch.zeros(0, dtype=torch.int32))
        self.register_buffer("weights", torch.zeros(1, num_actions))
        self.register_buffer("action_weights", torch.zeros(len(following), num_actions))
        self.register_buffer("bias", torch.zeros(num_actions))

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"order": self.order}

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return ("validation",)

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if context is None:
            raise ValueError("context: this prior takes a context, and none was given")
        history = context.new_full((batch_size,), len(self._following) - 1, dtype=torch.long)
        return self._at(context, history)

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        history = self._following[state[:, -1].long(), action.long()]
        return self._at(state[:, :-1] if context is None else context, history)

    def _at(self, patterns: Tensor, history: Tensor) -> tuple[Tensor, Tensor]:
        """The logits and the state where `patterns [N, F]` are active after `history [N]`."""
        state = torch.cat([patterns.to(torch.int32), history[:, None].to(torch.int32)], 1)
        return self.step_logits(patterns, history), state

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        if context is None or context.dim() != 3:
            raise ValueError("context: this prior takes patterns [N, L, F]")
        history = histories(plans, self._following)
        logits = self.step_logits(context[:, : plans.shape[1]].flatten(0, 1), history.flatten())
        return logits.view(*plans.shape, self.num_actions)

    def step_logits(self, patterns: Tensor, last: Tensor) -> Tensor:
        """Logits `[M, A]` of flat steps: `patterns [M, F]` after the histories `last [M]`."""
        number = numbered(patterns, self.patterns)
        return functional.embedding_bag(number, self.weights, mode="sum") + self.action_weights[last] + self.bias

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Learn from executed plans with patterns; see `fit_steps` for the settings.

        Plans that are held out by group (`Plans.split`) decide when learning stops.

        Args:
            plans: `Plans` with a context `[N, L, F]`.
            generator: draws which plans are held out, and what else is random.
            settings: those of `fit_settings`.

        Raises:
            ValueError: plans that this prior cannot learn from, or a setting that it does not have.
        """
        self.check_settings(settings)
        plans = self.training_plans(plans)
        share = settings.pop("validation", VALIDATION)
        units = len(plans) if plans.group is None else len(plans.group.unique())
        following = self._following
        if share is None or units < 2:
            steps, held_out = flat_steps(plans, following), None
        else:
            training, validation = plans.split(share, generator)
            steps, held_out = flat_steps(training, following), flat_steps(validation, following)
        return self._learn_checked(steps, held_out, generator, settings)

    def fit_steps(
        self,
        patterns: Tensor,
        last: Tensor,
        action: Tensor,
        weight: Tensor | None = None,
        *,
        plan: Tensor | None = None,
        validation: float | None = VALIDATION,
        generator: torch.Generator | None = None,
        **settings: Any,
    ) -> Self:
        """As `fit`, from M flat steps, of plans of any lengths.

        Args:
            patterns: integers `[M, F]`.
            last: integers `[M]`, the history before each step: of order 1 the action before, or A where there is none;
                in general see `neuroprior.priors.patterns.steps.next_history`.
            action: integers `[M]`.
            weight: `[M]`, how much each step counts; None: all the same.
            plan: integers `[M]`, the plan (or group of plans) of each step: those of one are held out together, and
                a loss of whole plans sums over them; None: each step is by itself.
            validation: the share of plans that is held out, and decides when learning stops; None: none is.
            generator: draws which.
            settings: those of `fit_settings`.

        Raises:
            ValueError: an argument is wrong; the message says which.
        """
        self.check_settings(settings)
        plan = torch.arange(len(action)) if plan is None else plan
        steps, held_out = Steps(patterns, last, action, plan, weight), None
        steps = checked_steps(steps, self.num_patterns or 0, self.num_actions, len(self._following))
        if validation is not None:
            if not 0 < validation < 1:
                raise ValueError(f"validation: a share between 0 and 1 is expected, not {validation}")
            steps, held_out = split_steps(steps, validation, generator)
        return self._learn_checked(steps, held_out, generator, settings)

    def _learn_checked(
        self, steps: Steps, held_out: Steps | None, generator: torch.Generator | None, settings: dict[str, Any]
    ) -> Self:
        if not len(steps.action):
            raise ValueError("plans: they have no actions to learn from")
        if held_out is not None and not len(held_out.action):
            held_out = None
        device = self.device
        self.cpu()  # sums over large tables by index are those of one thread
        self.learn(_on_cpu(steps), None if held_out is None else _on_cpu(held_out), generator, **settings)
        return self.to(device)

    @abstractmethod
    def learn(self, *args: Any, **settings: Any) -> None:
        """Learn from flat steps on the CPU: `steps`, `held_out` (or None; they decide when to stop), `generator`."""

    def know(self, patterns: Tensor) -> None:
        """Make `patterns` (ascending) known beside those that are; new ones weigh 0."""
        merged = torch.cat([self.patterns, patterns]).unique()
        place = numbered(self.patterns, merged).long()
        for name in self.tables[1:]:
            old = getattr(self, name)
            new = old.new_zeros(len(merged) + 1, *old.shape[1:])
            new[place] = old[:-1].detach()
            self._replace(name, new)
        self._replace("patterns", merged)

    def _replace(self, name: str, value: Tensor) -> None:
        """Give a buffer or parameter another size."""
        if name in self._parameters:
            self._parameters[name] = torch.nn.Parameter(value)
        else:
            self.register_buffer(name, value)

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *args: Any) -> None:
        # The tables' sizes depend on what was learned, so they are taken from the file.
        for name in self.tables:
            if prefix + name in state_dict:
                self._replace(name, torch.empty_like(state_dict[prefix + name], device=self.device))
        super()._load_from_state_dict(state_dict, prefix, *args)
        if not self.tables_fit():
            raise RuntimeError(f"the tables of a {type(self).__name__} do not fit one another")

    def tables_fit(self) -> bool:
        """Whether the tables fit one another; checks what was read from a file."""
        known = self.patterns
        return (
            known.dtype == torch.int32
            and known.dim() == 1
            and bool((known[1:] > known[:-1]).all())
            and (not len(known) or int(known[0]) >= 0)
            and all(len(getattr(self, name)) == len(known) + 1 for name in self.tables[1:])
            and self.weights.shape == (len(known) + 1, self.num_actions)
            and self.weights.dtype == torch.float32
            and not bool(self.weights[-1].any())
        )


Loss = Literal["log", "levin"]


def _on_cpu(steps: Steps) -> Steps:
    return Steps(*(None if values is None else values.cpu() for values in steps))  # type: ignore[arg-type]
