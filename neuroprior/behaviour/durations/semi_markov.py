"""The semi-Markov prior: any prior of the actions, and how long each action takes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor

from neuroprior._checks import check_same_names
from neuroprior._random import generator_on
from neuroprior.behaviour.durations.duration_model import DurationModel
from neuroprior.behaviour.durations.laws import LAW_NAMES, LawName
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.plans import Plans
from neuroprior.priors.construction import as_prior, construct, described
from neuroprior.priors.counts import MarkovPrior
from neuroprior.priors.fitting import PRIORS
from neuroprior.priors.learning import counted_plans, plans_for, training_plans
from neuroprior.priors.prior import Prior


class SemiMarkovPrior(Prior):
    """A prior whose plans have durations: an action prior chooses the actions, a `DurationModel` how long they take.

    With a Markov chain as its action prior it is a semi-Markov process (Howard 1971, Dynamic probabilistic systems,
    volume 2, chapter 10): the time spent in an action depends on this action and the next one. The next action does not
    depend on the times; for a neural prior that knows the last ones see `PastDurations`.

    It is an action prior to all that samples or scores actions: `start`, `step`, `forward`, `log_prob` and `sample` are
    those of `actions`. `sample_plans` gives plans with durations; the log-density of plans with their durations is
    `log_prob` + `duration_log_prob`.

    Args:
        num_actions: A.
        actions: the action prior; its class, or a function that makes it, called with the number of actions and, where
            it takes it, `num_contexts` or `context_size`; or, as in a saved `config`, an object with `prior`, the name
            of a class, and its `config`.
        num_contexts, context_size: of the action prior, where it is to be made.
        laws, transitions: see `DurationModel`.

    Raises:
        ValueError: an argument is out of range, or the action prior has other actions.

    Example:
        >>> durations = torch.tensor([[1.0, 4.0, 1.2, 3.5]]).repeat(20, 1) * torch.linspace(0.5, 2, 20)[:, None]
        >>> plans = RecordedPlans(torch.tensor([[0, 1, 0, 1]]).repeat(20, 1), 2, durations=durations)
        >>> prior = SemiMarkovPrior(2).fit(plans)
        >>> prior.sample(3, 4, generator=torch.Generator().manual_seed(0)).shape
        torch.Size([3, 4])
    """

    def __init__(
        self,
        num_actions: int,
        actions: Callable[..., Prior] | Prior | Mapping[str, Any] = MarkovPrior,
        num_contexts: int | None = None,
        context_size: int | None = None,
        laws: Sequence[LawName] = LAW_NAMES,
        transitions: bool = True,
    ) -> None:
        if isinstance(actions, Mapping | Prior):
            actions = as_prior(actions)
        else:
            contexts = {"num_contexts": num_contexts, "context_size": context_size}
            actions = construct(actions, num_actions, {name: c for name, c in contexts.items() if c is not None})
        if actions.num_actions != num_actions:
            raise ValueError(f"`actions` must be a prior of {num_actions} actions, got {actions.num_actions}.")
        super().__init__(num_actions, actions.num_contexts, actions.context_size)
        self.actions = actions
        self.durations = DurationModel(num_actions, laws, transitions)

    @property
    def config(self) -> dict[str, Any]:
        duration_config = {"laws": list(self.durations.laws), "transitions": self.durations.transitions}
        return {"num_actions": self.num_actions, "actions": described(self.actions)} | duration_config

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"actions": self.actions.learned}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        self.actions.restore(learned["actions"])

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return self.actions.start(batch_size, context)

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return self.actions.step(action, state, context)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        logits: Tensor = self.actions(plans, context)
        return logits

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return self.actions.fit_settings

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Fit the action prior and the laws of durations; returns self.

        Args:
            plans: with durations.
            generator: passed on to the action prior; the laws need none.
            settings: of the action prior.

        Raises:
            ValueError: plans that the action prior cannot learn from, without durations or of which none is known, or a
                setting that the action prior does not have.
        """
        self.check_settings(settings)
        plans = training_plans(self, plans)
        self.durations.fit(RecordedPlans.of(plans))
        self.actions.fit(plans_for(self.actions, plans), generator=generator, **settings)
        return self

    def recount(self, plans: Plans) -> Self:
        plans = counted_plans(self, plans)
        self.durations.fit(RecordedPlans.of(plans))
        self.actions.recount(plans)
        return self

    def duration_log_prob(self, plans: RecordedPlans) -> Tensor:
        """The log-density of the known durations of plans, given their actions; see `DurationModel.log_prob`.

        Args:
            plans: with durations.

        Returns:
            `[N]`, float64, nats, of durations in their unit.

        Raises:
            ValueError: plans of other actions, or without durations.
        """
        check_same_names("action_names", self.action_names, plans.action_names, "the plans", "this prior")
        return self.durations.log_prob(plans).sum(-1)

    def sample_plans(
        self,
        num_plans: int,
        length: int,
        context: Tensor | None = None,
        *,
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> RecordedPlans:
        """Independent plans with durations, the names of the actions, and the context.

        Args:
            num_plans: N.
            length: L; a plan of a prior with an end symbol may be shorter.
            context, temperature: see `sample`; the temperature is that of the actions.
            generator: source of randomness, of the actions and then of the durations.

        Raises:
            ValueError: an argument is out of range, or the context does not fit.
        """
        generator = generator_on(generator, self.device)
        actions = self.sample(num_plans, length, context, temperature=temperature, generator=generator)
        plans = RecordedPlans(
            actions,
            self.num_actions,
            action_names=self.action_names,
            context=context,
            context_names=None if context is None else self.context_names,
            end=self.end,
        )
        return replace(plans, durations=self.durations.sample(plans, generator=generator))


PRIORS.add("semi-markov", SemiMarkovPrior)
