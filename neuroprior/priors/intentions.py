"""Which of several known intentions an observed agent follows, one prior each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, log
from typing import Any

import torch
from torch import Tensor

from neuroprior._checks import check_alike_named, check_share, is_number
from neuroprior.plans import Plans
from neuroprior.priors.matching import learned_names, match_plans
from neuroprior.priors.prior import Prior
from neuroprior.priors.scoring import plan_frame


@dataclass(frozen=True, eq=False)
class Posterior:
    """How probable each of K intentions is after each number of observed actions.

    Attributes:
        names: K names.
        log_probs: float64 `[B, L + 1, K]`, nats, on the CPU: at t the intention of action t, given the actions up to
            it; at 0 the weights given in advance. Beyond a plan's length the last values go on.
        plans: the B plans of up to L actions that were observed.
    """

    names: tuple[str, ...]
    log_probs: Tensor
    plans: Plans

    def to_frame(self) -> Any:
        """A pandas frame: `plan`, `group` and whatever else a plan has one of, `step` (0 up to the plan's length),
        `intention`, `probability`."""
        plans = self.plans
        lengths = plans.mask().sum(1).cpu()
        there = torch.arange(self.log_probs.shape[1]) <= lengths[:, None]
        plan, step, which = there[:, :, None].expand_as(self.log_probs).nonzero(as_tuple=True)
        return (
            plan_frame(plans)
            .iloc[plan.numpy()]
            .assign(
                step=step.tolist(),
                intention=[self.names[k] for k in which.tolist()],
                probability=self.log_probs[plan, step, which].exp().tolist(),
            )
            .reset_index(drop=True)
        )


@torch.no_grad()
def infer(
    priors: Mapping[str, Prior] | Sequence[Prior],
    plans: Plans | Tensor,
    *,
    context: Tensor | None = None,
    weights: Tensor | Sequence[float] | None = None,
    switch: float = 0.0,
    power: float = 1.0,
) -> Posterior:
    """The posterior over known intentions, exactly, by Bayes' rule (Baker, Saxe and Tenenbaum 2009).

    Before each action the intention is drawn anew from `weights` with probability `switch`; otherwise it stays. With
    `switch` the posterior is that of the forward filter of a hidden Markov model (Rabiner 1989, section III A); each
    prior knows all the actions before, also those of other intentions.

    Args:
        priors: one fitted prior for each intention, by name or in order; a prior without context ignores that of plans.
        plans: B plans without an end symbol, or integers `[B, L]`. An end is not observed: plans may go on.
        context: of integers `[B, L]`, see `Plans`; `Plans` have their own.
        weights: how probable each intention is in advance, `[K]` or `[B, K]`, in any unit; None: all the same.
        switch: from 0 to 1.
        power: of the likelihoods, at least 0. Priors that learned from few plans multiply their mistakes action by
            action, and are too sure of an intention; a power below 1, chosen on plans of known intentions, mends that.

    Raises:
        ValueError: an argument is out of range, a prior cannot score the plans, or an action is impossible under every
            intention.

    Example:
        >>> left = MarkovPrior(2, 0).fit(torch.tensor([[0, 0, 0, 1]]))
        >>> right = MarkovPrior(2, 0).fit(torch.tensor([[1, 1, 1, 0]]))
        >>> posterior = infer({"left": left, "right": right}, torch.tensor([[0, 0, 0]]))
        >>> posterior.names[posterior.log_probs[0, -1].argmax()]
        'left'
    """
    named = _name_priors(priors)
    observed = _observed_plans(plans, context, named)
    check_share("switch", switch)
    if not is_number(power) or not 0 <= power < inf:
        raise ValueError(f"`power` must be a finite number of at least 0, got {power!r}")
    batch, length = len(observed), observed.max_length
    prior_log = _log_weights(weights, batch, len(named))
    scores = [
        prior.action_log_probs(match_plans(observed, prior, name))[:, :length].double().cpu()
        for name, prior in named.items()
    ]
    mask = observed.mask().cpu()
    log_likelihood = torch.stack(scores, -1)
    now, posteriors = prior_log, [prior_log]
    for t in range(length):
        before = now
        if switch:
            stay = now + (log(1 - switch) if switch < 1 else -torch.inf)
            before = torch.logaddexp(stay, prior_log + log(switch))
        likely = log_likelihood[:, t]
        joint = before + torch.where(likely > -torch.inf, power * likely, likely)  # what is impossible remains so
        total = joint.logsumexp(-1, keepdim=True)
        impossible = mask[:, t] & ~(total[:, 0] > -torch.inf)
        if impossible.any():
            plan = int(impossible.nonzero()[0, 0])
            raise ValueError(
                f"actions[{plan}, {t}]: action {int(observed.actions[plan, t])} has probability 0 under every intention"
                " that is still possible; priors that smooth their counts give every action some"
            )
        now = torch.where(mask[:, t, None], joint - total, now)
        posteriors.append(now)
    return Posterior(tuple(named), torch.stack(posteriors, 1), observed)


def _name_priors(priors: Mapping[str, Prior] | Sequence[Prior]) -> dict[str, Prior]:
    """The priors by name; those of a list have their numbers."""
    if not isinstance(priors, Mapping | Sequence) or not priors:
        raise ValueError("`priors` must have at least one prior for each intention, by name or in a list")
    named = dict(priors) if isinstance(priors, Mapping) else {str(k): prior for k, prior in enumerate(priors)}
    for name, prior in named.items():
        if not isinstance(prior, Prior):
            raise ValueError(f"`priors[{name!r}]` must be a fitted prior, got {type(prior).__name__}")
    counts = {name: prior.num_actions - (prior.end is not None) for name, prior in named.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"priors: all must know the same number of actions, not {counts}")
    return named


def _observed_plans(plans: Plans | Tensor, context: Tensor | None, priors: dict[str, Prior]) -> Plans:
    """The plans that were observed, without an end symbol."""
    if not isinstance(plans, Plans):
        prior = next(iter(priors.values()))
        # The same numbers are given to all.
        names = {name: learned_names(one) for name, one in priors.items()}
        check_alike_named(names, "give the actions as Plans with names")
        num_actions = prior.num_actions - (prior.end is not None)
        return Plans(torch.as_tensor(plans), num_actions, context=context)
    if context is not None:
        raise ValueError("context: Plans have their own; give it with actions [B, L] alone")
    return plans if plans.end is None else plans.without_end()


def _log_weights(weights: Tensor | Sequence[float] | None, batch: int, number: int) -> Tensor:
    """The logarithms `[B, K]` of the probabilities in advance."""
    values = torch.ones(number) if weights is None else torch.as_tensor(weights)
    values = values.double().cpu()
    if values.shape not in ((number,), (batch, number)):
        raise ValueError(f"`weights` must have shape [{number}] or [{batch}, {number}], got {list(values.shape)}")
    if not bool(values.isfinite().all()) or bool((values < 0).any()) or bool((values.sum(-1) <= 0).any()):
        raise ValueError("`weights` must be finite numbers from 0, with one above 0 in each row")
    return (values / values.sum(-1, keepdim=True)).log().expand(batch, number)
