"""The interface of a prior: a distribution over action sequences that is also a small state machine."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor, nn

from neuroprior._checks import check_range, check_sizes, is_integer
from neuroprior.plans import Plans, check_context, is_per_step
from neuroprior.sampling import ancestral as sampling
from neuroprior.sampling.draws import after_end


class Prior(nn.Module, ABC):
    """A distribution over sequences of A actions, numbered from 0.

    Samplers, beams and trees need `start` and `step` alone. Their `state` is ONE tensor whose first dimension is the
    batch, so reordering or branching is `state[index]`; its other dimensions are the prior's own affair. Rows of one
    state have seen the same number of actions.

    `context` is what the agent sees: indices below `num_contexts` or features of size `context_size`, never both. It is
    given once (`[N]`, `[N, C]`: seen at the start and remembered) or anew before each action (`[N, L]`, `[N, L, C]`).

    Args:
        num_actions: A.
        num_contexts: number of context indices, for a prior that sees an index.
        context_size: C, for a prior that sees features.

    Attributes:
        context_per: "plan" or "step", as it was in the plans that the prior learned from ("step" before that); None
            for a prior without context.
        end: the action that ends a plan, as it was in the plans that the prior learned from (see `Plans.with_end`), or
            None. After it `log_prob` and samples have nothing but it.
        action_names, context_names: names of the actions and contexts, as they were in these plans, or None.

    Raises:
        ValueError: an argument is out of range.
    """

    known: ClassVar[dict[str, type["Prior"]]] = {}
    """Every subclass by name; `load` finds a folder's class here."""

    actions_at_once: ClassVar[int] = 2**21
    """Actions that `log_prob` scores together; bounds memory."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        Prior.known[cls.__name__] = cls

    def __init__(self, num_actions: int, num_contexts: int | None = None, context_size: int | None = None) -> None:
        super().__init__()
        sizes = {"num_actions": num_actions, "num_contexts": num_contexts, "context_size": context_size}
        required = {name: size for name, size in sizes.items() if size is not None or name == "num_actions"}
        check_sizes(**required)
        if num_contexts is not None and context_size is not None:
            raise ValueError("num_contexts and context_size: a prior sees an index or features, not both")
        self.num_actions, self.num_contexts, self.context_size = num_actions, num_contexts, context_size
        self.context_per: Literal["plan", "step"] | None = "step" if self.takes_context else None
        self.end: int | None = None
        self.action_names: tuple[str, ...] | None = None
        self.context_names: tuple[str, ...] | None = None
        self.register_buffer("_anchor", torch.zeros(()), persistent=False)

    @property
    def takes_context(self) -> bool:
        """True for a prior that sees something."""
        return self.num_contexts is not None or self.context_size is not None

    @property
    def device(self) -> torch.device:
        """Where the prior computes."""
        anchor = self._anchor
        assert isinstance(anchor, Tensor)
        return anchor.device

    @property
    def config(self) -> dict[str, Any]:
        """The constructor's arguments that make this prior again (JSON values); subclasses add their own."""
        contexts = {"num_contexts": self.num_contexts, "context_size": self.context_size}
        return {"num_actions": self.num_actions} | {name: size for name, size in contexts.items() if size is not None}

    @property
    def learned(self) -> dict[str, Any]:
        """What `fit` found that is neither weights nor an argument (JSON values); saved with the prior."""
        names = {"action_names": self.action_names, "context_names": self.context_names}
        return {"context_per": self.context_per, "end": self.end} | names

    def restore(self, learned: dict[str, Any]) -> None:
        """Take over what `learned` gave when the prior was saved.

        Raises:
            ValueError: a value that cannot be.
        """
        context_per = learned["context_per"]
        if context_per not in (("plan", "step") if self.takes_context else (None,)):
            raise ValueError(f"context_per: {context_per!r} does not fit this prior")
        self.context_per = context_per
        end = learned["end"]
        if end is not None and (not isinstance(end, int) or not 0 <= end < self.num_actions):
            raise ValueError(f"end: one of the {self.num_actions} actions is expected, not {end!r}")
        self.end = end
        self.action_names = _names("action_names", learned, self.num_actions)
        self.context_names = _names("context_names", learned, self.num_contexts or 0)

    @abstractmethod
    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Before the first action.

        Args:
            batch_size: N.
            context: `[N]` or `[N, C]`: what is seen there; None for nothing.

        Returns:
            Logits `[N, A]` of the first action, and the state `[N, ...]`.
        """

    @abstractmethod
    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """After one more action.

        Args:
            action: integers `[N]`.
            state: as `start` or `step` returned it.
            context: `[N]` or `[N, C]`: what is seen now; None: what was seen last.

        Returns:
            Logits `[N, A]` of the next action, and the next state.
        """

    def advance(
        self, action: Tensor, state: Tensor, context: Tensor | None = None, room: int = 0
    ) -> tuple[Tensor, Tensor]:
        """As `step`, for callers that need the old state no more: it may be written over.

        Args:
            action, state, context: see `step`.
            room: so many further steps are to come, for which memory may be taken at once.
        """
        return self.step(action, state, context)

    @abstractmethod
    def fit(self, plans: Plans | Tensor) -> Self:
        """Learn from executed plans; returns self. A tensor `[N, L]` is taken as plans without context."""

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        """The logits of each action given those before it.

        Args:
            plans: integers `[N, L]`.
            context: None, one a plan or one a step.

        Returns:
            Logits `[N, L, A]`, equal to those that stepping gives. This default steps.
        """
        num, length = plans.shape
        per_step = is_per_step(context)
        if length == 0:
            return torch.zeros(num, 0, self.num_actions, device=self.device)
        out = []
        logits, state = self.start(num, context[:, 0] if context is not None and per_step else context)
        for t in range(length):
            out.append(logits)
            if t + 1 < length:
                seen = context[:, t + 1] if context is not None and per_step else None
                logits, state = self.step(plans[:, t].long(), state, seen)
        return torch.stack(out, 1)

    def log_prob(self, plans: Tensor, context: Tensor | None = None, lengths: Tensor | None = None) -> Tensor:
        """The log-probability of plans.

        Args:
            plans: integers `[N, L]`.
            context: None, one a plan or one a step.
            lengths: `[N]`, where plans end before L; None where all have L actions.

        Returns:
            `[N]`, nats.

        Raises:
            ValueError: a shape, dtype or value is wrong.
        """
        data = Plans(plans, self.num_actions, lengths, context=context)
        return self.action_log_probs(data).sum(-1)

    def action_log_probs(self, plans: Plans) -> Tensor:
        """The log-probability of each action given those before it.

        Returns:
            `[N, L]`, nats; 0 beyond a plan's end.

        Raises:
            ValueError: other actions or another context than this prior's.
        """
        if plans.actions.numel() == 0:
            self._check_scored(plans)
            return torch.zeros(plans.actions.shape, device=self.device)
        parts = []
        for part, log_probs in self.forecasts(plans):
            taken = log_probs.gather(-1, part.actions.long()[..., None])[..., 0]
            parts.append(taken.masked_fill(~part.mask(), 0))
        return torch.cat(parts)

    def forecasts(self, plans: Plans) -> Iterator[tuple[Plans, Tensor]]:
        """What the prior expects before each action, given those before it, some plans at a time.

        Yields:
            Some of the plans, in order, and the log-probabilities `[n, L, A]` (nats) of every action at each of their
            steps; beyond a plan's end they mean nothing.

        Raises:
            ValueError: other actions or another context than this prior's.
        """
        self._check_scored(plans)
        size = max(self.actions_at_once // max(plans.max_length, 1), 1)
        for at in range(0, len(plans), size):
            part = plans[at : at + size]
            logits = self(part.actions, part.context)
            if self.end is not None:
                logits = torch.cat([logits[:, :1], after_end(logits[:, 1:], part.actions[:, :-1].long(), self.end)], 1)
            yield part, torch.log_softmax(logits, -1)

    def _check_scored(self, plans: Plans) -> None:
        if plans.num_actions != self.num_actions:
            raise ValueError(f"plans have {plans.num_actions} actions, this prior {self.num_actions}")
        self.check_context_of(plans)

    def sample(
        self,
        num_plans: int,
        length: int,
        context: Tensor | None = None,
        *,
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
        method: Literal["auto", "ancestral", "tree"] = "auto",
    ) -> Tensor:
        """Independent plans `[num_plans, length]`; see `neuroprior.sampling.ancestral.sample`.

        Raises:
            ValueError: an argument is out of range, or the context does not fit.
        """
        return sampling.sample(
            self, num_plans, length, context, temperature=temperature, generator=generator, method=method
        )

    def check_context_of(self, plans: Plans | Tensor | None, num_plans: int = 0, length: int = 0) -> None:
        """Raise ValueError unless the context of `plans` (or one given alone) is of the kind that this prior sees."""
        context = plans.context if isinstance(plans, Plans) else plans
        if context is None:
            if self.takes_context:
                raise ValueError("context: this prior sees a context, and none was given")
            return
        if not self.takes_context:
            raise ValueError("context: this prior sees none (make it with num_contexts= or context_size=)")
        if not isinstance(plans, Plans):
            steps = context.shape[1] if is_per_step(context) else length
            check_context(context, num_plans, steps)
        if self.num_contexts is not None:
            if not is_integer(context):
                raise ValueError(f"context: indices below {self.num_contexts} are expected, not {context.dtype}")
            check_range("context", context, self.num_contexts, "contexts")
        elif is_integer(context) or context.shape[-1] != self.context_size:
            raise ValueError(
                f"context: floating point features of size {self.context_size} are expected,"
                f" not {str(context.dtype).removeprefix('torch.')} of shape {list(context.shape)}"
            )

    def training_plans(self, plans: Plans | Tensor) -> Plans:
        """`plans` as `Plans` that this prior can learn from; notes whether their context is a plan's or a step's.

        A prior without context leaves that of the plans aside.

        Raises:
            ValueError: another number of actions, or a context of another kind than this prior sees.
        """
        if not isinstance(plans, Plans):
            plans = Plans(torch.as_tensor(plans), self.num_actions)
        if plans.num_actions != self.num_actions:
            raise ValueError(f"plans have {plans.num_actions} actions, this prior {self.num_actions}")
        self.end = plans.end
        self.action_names = None if plans.action_names is None else tuple(plans.action_names)
        self.context_names = None
        if not self.takes_context:
            return replace(plans, context=None, context_names=None)
        self.check_context_of(plans)
        self.context_per = "step" if is_per_step(plans.context) else "plan"
        if plans.context_names is not None and len(plans.context_names) <= (self.num_contexts or 0):
            self.context_names = tuple(plans.context_names)
        return plans


def _names(what: str, learned: dict[str, Any], most: int) -> tuple[str, ...] | None:
    """The names that were saved, at most so many of them."""
    names = learned[what]
    if names is None:
        return None
    if not isinstance(names, list | tuple) or len(names) > most or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{what}: at most {most} texts are expected")
    return tuple(names)
