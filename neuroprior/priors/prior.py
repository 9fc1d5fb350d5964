"""The interface of a prior: a distribution over action sequences that is also a small state machine."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor

from neuroprior._checks import check_memory, check_range, check_same_names, check_sizes, describe, is_integer, kind_of
from neuroprior.plans import Plans, check_context, check_patterns, has_patterns
from neuroprior.plans.sequences import expand_context, is_per_plan
from neuroprior.priors.saved import SavedModule
from neuroprior.sampling import ancestral as sampling
from neuroprior.sampling.draws import after_end, check_possible
from neuroprior.sampling.stepping import check_logits, check_outputs


class Prior(SavedModule):
    """A distribution over sequences of A actions, numbered from 0.

    A subclass writes `start`, `step` and `fit`. Samplers and planners use `num_actions`, `start` and `step` alone.
    `state` is a tensor, or a tuple of tensors (nested where priors hold priors), each with the batch as its first
    dimension; `neuroprior.sampling.select_rows(state, index)` reorders and branches. The rows of one state have the
    same number of actions behind them.

    `context` is the observation that actions depend on: indices below `num_contexts`, features of size `context_size`,
    or `num_patterns` active patterns; one of the three. There is one before each action: `[N, L]`, `[N, L, C]` or
    `[N, L, F]`.

    Args:
        num_actions: A.
        num_contexts: number of context indices, for a prior that takes an index.
        context_size: C, for a prior that takes features.
        num_patterns: F, for a prior that takes the active patterns of each state: integers from 0 to 2**31 - 1.

    Attributes:
        context_per: "plan" where the context never changed within the plans that the prior learned from, so that in a
            world it is shown the observation of the start alone; "step" where it did, and before it learned; None for a
            prior without context.
        end: the action that ends a plan, as it was in the plans that the prior learned from (see `Plans.with_end`), or
            None. After it, it has probability 1 in `log_prob` and in samples.
        action_names, context_names: names of the actions and contexts, as they were in these plans, or None.
        has_learned: whether the prior has learned from plans, so that these attributes are theirs.

    Raises:
        ValueError: an argument is out of range.
    """

    actions_at_once: ClassVar[int] = 2**21
    """Actions that `log_prob` scores together; bounds the memory that it takes."""

    def __init__(
        self,
        num_actions: int,
        num_contexts: int | None = None,
        context_size: int | None = None,
        num_patterns: int | None = None,
    ) -> None:
        super().__init__()
        contexts = {"num_contexts": num_contexts, "context_size": context_size, "num_patterns": num_patterns}
        sizes = {"num_actions": num_actions} | contexts
        required = {name: size for name, size in sizes.items() if size is not None or name == "num_actions"}
        check_sizes(**required)
        for name, size in required.items():
            check_memory(4 * (size or 0), **{name: size})  # one row of logits, of features, or a number each
        if num_contexts is not None and context_size is not None:
            raise ValueError("num_contexts and context_size: a prior takes an index or features, not both")
        if num_patterns is not None and (num_contexts is not None or context_size is not None):
            raise ValueError("num_patterns: a prior takes patterns, an index or features, one of them")
        self.num_actions, self.num_contexts, self.context_size = int(num_actions), num_contexts, context_size
        self.num_patterns = num_patterns
        self.context_per: Literal["plan", "step"] | None = "step" if self.takes_context else None
        self.end: int | None = None
        self.has_learned = False
        self.action_names: tuple[str, ...] | None = None
        self.context_names: tuple[str, ...] | None = None
        self.register_buffer("_anchor", torch.zeros(()), persistent=False)

    @property
    def takes_context(self) -> bool:
        """True for a prior whose predictions depend on a context."""
        return not (self.num_contexts is None and self.context_size is None and self.num_patterns is None)

    @property
    def num_weights(self) -> int:
        """How many trained numbers its predictions are computed from; 0 for priors that count."""
        return sum(weights.numel() for weights in self.parameters())

    @property
    def device(self) -> torch.device:
        """Where the prior computes."""
        anchor = self._anchor
        assert isinstance(anchor, Tensor)
        return anchor.device

    @property
    def config(self) -> dict[str, Any]:
        """The constructor's arguments that make a prior like this one (JSON values); subclasses add their own."""
        contexts = {
            "num_contexts": self.num_contexts,
            "context_size": self.context_size,
            "num_patterns": self.num_patterns,
        }
        return {"num_actions": self.num_actions} | {name: size for name, size in contexts.items() if size is not None}

    @property
    def learned(self) -> dict[str, Any]:
        """What `fit` found that is neither weights nor an argument (JSON values); saved with the prior."""
        names = {"action_names": self.action_names, "context_names": self.context_names}
        return {"context_per": self.context_per, "end": self.end} | names

    @property
    def fit_settings(self) -> tuple[str, ...]:
        """The names of the settings that `fit` takes: none for a prior that counts, those of a training otherwise."""
        return ()

    def restore(self, learned: dict[str, Any]) -> None:
        """Take over what `learned` gave when the prior was saved.

        Raises:
            ValueError: a value is not one that this prior could have learned.
        """
        context_per = learned["context_per"]
        if context_per not in (("plan", "step") if self.takes_context else (None,)):
            raise ValueError(f"context_per: {context_per!r} does not fit this prior")
        self.context_per, self.has_learned = context_per, True
        end = learned["end"]
        if end is not None and (not isinstance(end, int) or not 0 <= end < self.num_actions):
            raise ValueError(f"`end` must be one of the {self.num_actions} actions, got {end!r}")
        self.end = end
        self.action_names = _names("action_names", learned, self.num_actions)
        self.context_names = _names("context_names", learned, self.num_contexts or 0)

    @abstractmethod
    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Any]:
        """Before the first action.

        Args:
            batch_size: N.
            context: `[N]`, `[N, C]` or `[N, F]`: that of the first action; None for a prior without context.

        Returns:
            Logits `[N, A]` of the first action, and the state of N plans.

        Raises:
            ValueError: a context that the prior does not know, or none where it takes one.
        """

    @abstractmethod
    def step(self, action: Tensor, state: Any, context: Tensor | None = None) -> tuple[Tensor, Any]:
        """After one more action.

        Args:
            action: integers `[N]`.
            state: as `start` or `step` returned it.
            context: `[N]`, `[N, C]` or `[N, F]`: that of the next action; None: the last one goes on.

        Returns:
            Logits `[N, A]` of the next action, and the next state.

        Raises:
            ValueError: an action or a context that the prior does not know.
        """

    @abstractmethod
    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Learn from executed plans.

        Args:
            plans: `Plans`, or integers `[N, L]` for plans without context.
            generator: source of randomness, where learning needs one; priors that count need none.
            settings: those of `fit_settings`. Implementations call `check_settings`.

        Returns:
            The prior itself.

        Raises:
            ValueError: plans that this prior cannot learn from, or a setting that it does not have.
        """

    def recount(self, plans: Plans) -> Self:
        """Count anew in `plans` what this prior counts, and keep what it was trained to; returns self.

        A prior that learned from some plans can so take others into account that were held out in the meantime.

        Raises:
            ValueError: plans that this prior cannot learn from.
        """
        return self if self.fit_settings else self.fit(plans)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        """The logits of each action given those before it.

        Args:
            plans: integers `[N, L]`.
            context: None, or `[N, L]`, `[N, L, C]` or `[N, L, F]`.

        Returns:
            Logits `[N, L, A]`, equal to those that stepping gives. This default steps. Plans are checked where the
            prior is called, `prior(plans, context)`.
        """
        num, length = plans.shape
        if length == 0:
            return torch.zeros(num, 0, self.num_actions, device=self.device)
        out = []
        outputs = self.start(num, None if context is None else context[:, 0])
        for t in range(length):
            logits, state = check_outputs(outputs, num, self.num_actions, "step" if t else "start")
            out.append(logits)
            if t + 1 < length:
                now = None if context is None else context[:, t + 1]
                outputs = self.step(plans[:, t].long(), state, now)
        return torch.stack(out, 1)

    def __call__(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        """As `forward`, which it calls; a context given once a plan, `[N]` or `[N, C]`, is that of all of its steps.

        Raises:
            ValueError: other actions or another context than this prior's, or `forward` returns other logits.
        """
        plans = as_actions(plans)
        if plans.dim() != 2:
            raise ValueError(f"`plans` must be integers [N, L], got {describe(plans)}")
        if plans.device.type == "cpu":  # as in `check_step`
            check_range("plans", plans, self.num_actions, "actions")
            self.check_context_of(context, *plans.shape)
        if context is not None:
            context = expand_context(context, plans.shape[1])
            if context.shape[:2] != plans.shape:
                raise ValueError(f"`context` must be one a step, {list(plans.shape)}, got {list(context.shape)}")
        return check_logits(super().__call__(plans, context), [*plans.shape, self.num_actions], "forward")

    def log_prob(self, plans: Plans | Tensor) -> Tensor:
        """The log-probability of plans.

        Args:
            plans: `Plans`, or integers `[N, L]` for plans without context.

        Returns:
            `[N]`, nats.

        Raises:
            ValueError: other actions or another context than this prior's.
        """
        return self.action_log_probs(plans).sum(-1)

    def action_log_probs(self, plans: Plans | Tensor) -> Tensor:
        """The log-probability of each action given those before it.

        Args:
            plans: `Plans`, or integers `[N, L]` for plans without context.

        Returns:
            `[N, L]`, nats; 0 beyond a plan's end.

        Raises:
            ValueError: other actions or another context than this prior's; or NaN for its logits, or -inf for all, at a
                step that is reached.
        """
        plans = self.as_plans(plans)
        if plans.actions.numel() == 0:
            self.check_plans(plans)
            return torch.zeros(plans.actions.shape, device=self.device)
        parts = []
        for chunk, log_probs in self.forecasts(plans):
            taken = log_probs.gather(-1, chunk.actions.long()[..., None])[..., 0].masked_fill(~chunk.mask(), 0)
            unknown = taken.isnan()
            if unknown.any():  # which a prior may give after an impossible action
                possible = (taken == -torch.inf).cumsum(1) == 0
                check_possible(not (unknown & possible).any())
            parts.append(taken.masked_fill(unknown, 0))
        return torch.cat(parts)

    def forecasts(self, plans: Plans) -> Iterator[tuple[Plans, Tensor]]:
        """The log-probabilities of every action at each step, given the actions before it, some plans at a time.

        Yields:
            Some of the plans, in order, and the log-probabilities `[n, L, A]` (nats) of all actions at each of their
            steps; beyond a plan's end they have no meaning.

        Raises:
            ValueError: other actions or another context than this prior's.
        """
        self.check_plans(plans)
        plans = plans.to(self.device)
        size = max(self.actions_at_once // max(plans.max_length, 1), 1)
        for at in range(0, len(plans), size):
            chunk = plans[at : at + size]
            logits = self(chunk.actions, chunk.context)
            if self.end is not None:
                logits = torch.cat([logits[:, :1], after_end(logits[:, 1:], chunk.actions[:, :-1].long(), self.end)], 1)
            yield chunk, torch.log_softmax(logits, -1)

    def as_plans(self, plans: Plans | Tensor) -> Plans:
        """`plans` as `Plans`, on this prior's device."""
        return (plans if isinstance(plans, Plans) else Plans(as_actions(plans), self.num_actions)).to(self.device)

    def check_plans(self, plans: Plans) -> None:
        """Raise ValueError unless the plans have this prior's actions and context, numbered alike."""
        check_actions(self, plans)
        for what in ("action_names", "context_names"):
            remedy = "number them alike (neuroprior.priors.match_plans)"
            check_same_names(what, getattr(self, what), getattr(plans, what), "the plans", "this prior", remedy)
        self.check_context_of(plans)

    def sample(
        self,
        num_plans: int,
        length: int,
        context: Tensor | None = None,
        *,
        past: Tensor | None = None,
        state: tuple[Tensor, Any] | None = None,
        mask: Tensor | sampling.Mask | None = None,
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
        method: Literal["auto", "ancestral", "tree"] = "auto",
    ) -> Tensor:
        """Independent plans `[num_plans, length]`; see `neuroprior.sampling.ancestral.sample`.

        After a `past` of executed actions, `[T]` or `[num_plans, T]`, plans go on from these, as a planner that replans
        needs them; with a `state`, what `start` or the last `step` returned, without reading the past again. A `mask`
        says which actions may be drawn.

        `neuroprior.priors.decode(plans, prior)` gives their names.

        Raises:
            ValueError: an argument is out of range, or the context does not fit.
        """
        return sampling.sample(
            self,
            num_plans,
            length,
            context,
            past=past,
            state=state,
            mask=mask,
            temperature=temperature,
            generator=generator,
            method=method,
        )

    def check_context_of(self, plans: Plans | Tensor | None, num_plans: int = 0, length: int = 0) -> None:
        """Raise ValueError unless the context of `plans` (or one given alone) is of the kind that this prior takes."""
        context = plans.context if isinstance(plans, Plans) else plans
        if context is None:
            if self.takes_context:
                raise ValueError("context: this prior takes a context, and none was given")
            return
        if not self.takes_context:
            raise ValueError("context: this prior takes none (make it with num_contexts= or context_size=)")
        if self.num_patterns is not None:
            if isinstance(plans, Plans):
                num_plans, length = plans.actions.shape
            _check_patterns_of(context, self.num_patterns, num_plans, length, isinstance(plans, Plans) or length > 0)
            return
        if has_patterns(context):
            raise ValueError(f"context: patterns {list(context.shape)}, which this prior does not take")
        if not isinstance(plans, Plans):
            check_context(context, num_plans, length if is_per_plan(context) else context.shape[1])
        if self.num_contexts is not None:
            if not is_integer(context):
                kind = str(context.dtype).removeprefix("torch.")
                raise ValueError(f"`context` must be indices below {self.num_contexts}, got features ({kind})")
            check_range("context", context, self.num_contexts, "contexts")
        elif is_integer(context) or context.shape[-1] != self.context_size:
            raise ValueError(
                f"`context` must be floating point features of size {self.context_size},"
                f" got {str(context.dtype).removeprefix('torch.')} of shape {list(context.shape)}"
            )

    def check_start(self, batch_size: int, context: Tensor | None) -> None:
        """Raise ValueError unless `start` can be given this context; implementations of `start` begin with it."""
        self.check_context_of(context, batch_size)

    def check_step(self, action: Tensor, context: Tensor | None) -> None:
        """Raise ValueError unless `step` can be given these; implementations of `step` begin with it.

        Not on a GPU, where each look at a value waits for the device.
        """
        if action.device.type != "cpu":
            return
        if action.dim() != 1:
            raise ValueError(f"`action` must be integers [N], got {describe(action)}")
        check_range("action", action, self.num_actions, "actions")
        if context is not None:
            self.check_context_of(context, len(action))

    def check_settings(self, settings: Mapping[str, Any]) -> None:
        """Raise ValueError unless `fit` takes all of these settings."""
        accepted = self.fit_settings
        for name in settings:
            if name not in accepted:
                raise ValueError(
                    f"{name}: not a setting of {type(self).__name__}.fit, which takes {', '.join(accepted) or 'none'}"
                )


def check_actions(prior: Prior, plans: Plans) -> None:
    """Raise ValueError unless the plans have as many actions as the prior."""
    if plans.num_actions != prior.num_actions:
        raise ValueError(f"`plans` must have {prior.num_actions} actions, as this prior, got {plans.num_actions}")


def check_is_prior(prior: object) -> None:
    """Raise ValueError unless it is a `Prior`."""
    if not isinstance(prior, Prior):
        raise ValueError(f"`prior` must be a Prior, got {kind_of(prior)}")


def _check_patterns_of(context: Tensor, num_patterns: int, num_plans: int, length: int, plans: bool) -> None:
    """Raise ValueError unless `context` is the patterns of plans, `[N, L, F]`, or else of one state each, `[N, F]`."""
    shape = list(context.shape)
    steps = max(shape[1], length) if context.dim() == 3 else length  # those of more steps may be known
    fitting = [num_plans, steps, num_patterns] if plans or context.dim() == 3 else [num_plans, num_patterns]
    if not is_integer(context) or shape != fitting:
        raise ValueError(
            f"`context` must be {num_patterns} patterns (integers) of each state, {fitting}, got"
            f" {str(context.dtype).removeprefix('torch.')} of shape {shape}"
        )
    check_patterns(context)


def as_actions(plans: Any) -> Tensor:
    """Plans that are not `Plans` as a tensor; ValueError for what is none."""
    try:
        return torch.as_tensor(plans)
    except (RuntimeError, TypeError, ValueError):
        raise ValueError(f"`plans` must be Plans or a tensor, got {type(plans).__name__}") from None


def _names(what: str, learned: dict[str, Any], most: int) -> tuple[str, ...] | None:
    """The saved names, at most `most` of them."""
    names = learned[what]
    if names is None:
        return None
    if not isinstance(names, list | tuple) or len(names) > most or not all(isinstance(name, str) for name in names):
        raise ValueError(f"`{what}` must be at most {most} texts")
    return tuple(names)


def taken_of(forecasts: Tensor, actions: Tensor) -> Tensor:
    """`[..., E]`: of log-probabilities `[..., E, A]`, those of `actions [...]`."""
    index = actions.long()[..., None, None].expand(*forecasts.shape[:-1], 1)
    return forecasts.gather(-1, index)[..., 0]
