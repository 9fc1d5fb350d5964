"""Priors: what they learn from a small source, say of plans, carry from step to step, draw, and save."""

from dataclasses import replace
from typing import Any

import torch

from neuroprior.behaviour import LAW_NAMES, DurationModel, SemiMarkovPrior
from neuroprior.control import (
    AutoregressivePrior,
    NoisePrior,
    StoredWindows,
    VectorGRU,
    VectorPlans,
)
from neuroprior.plans import Plans
from neuroprior.priors import (
    CombinedPrior,
    GRUPrior,
    MarkovPrior,
    MixturePrior,
    Prior,
    StackedPrior,
    SwitchingPrior,
    TransformerPrior,
    decode,
    fit,
)
from neuroprior.priors.fitting import PRIORS
from neuroprior.puzzles import LogLinearPrior, Steps
from neuroprior.sampling.states import tensors_in
from tests.support.pinned.data import behaviour, timed
from tests.support.sources import seeded
from tests.support.unchanged import case

QUICK: dict[str, Any] = {"max_steps": 8, "batch_size": 8, "window": 16, "progress": False}


def of_prior(prior: Prior, plans: Plans, draws: bool = True) -> dict[str, Any]:
    """What a prior says of plans, whole and step by step, and of what it draws."""
    few = plans[:5]
    context = few.context if prior.takes_context else None
    per_step = context is not None and prior.context_per == "step"
    contexts = [context[:, t if per_step else 0] for t in range(3)] if context is not None else [None] * 3
    with torch.no_grad():
        logits, state = prior.start(5, contexts[0])
        for t in range(2):
            logits, state = prior.step(few.actions[:, t].long(), state, contexts[t + 1])
        found = {
            "log_prob": prior.log_prob(plans),
            "actions": prior.action_log_probs(few[:2]),
            "after two": logits,
            "state": [values.double() for values in tensors_in(state)],
            "config": prior.config,
            "names": [prior.action_names, prior.context_names, prior.end, prior.context_per],
        }
        if draws:
            for name, how in {"tree": {"method": "tree"}, "hot": {"temperature": 2.0, "method": "ancestral"}}.items():
                found[name] = prior.sample(
                    5,
                    6,
                    None if context is None else few.context[:, :6] if per_step else context[:, 0],
                    generator=seeded(1),
                    **how,
                )
    return found


@case(relative=2e-3, slow=True)
def combined():
    found = {}
    for context in (None, "step", "features"):
        plans = behaviour(48, context=context)
        generator = seeded(2)
        prior = fit(plans, effort="fast", generator=generator, **QUICK)
        found[str(context)] = of_prior(prior, plans) | {"summary": prior.summary()}
        found[f"{context}, held out"] = prior.log_prob(behaviour(8, context=context, seed=3))
    return found


@case(relative=2e-3, slow=True)
def experts_of_every_kind():
    """All networks and what counts, with a context; and plans of so few groups that these are split."""
    plans, found = behaviour(24, 10, context="plan"), {}
    quick = {**QUICK, "max_steps": 2}
    prior = CombinedPrior(3, effort="full", num_contexts=3).fit(plans, generator=seeded(0), **quick)
    found["full"] = of_prior(prior, plans) | {"experts": [expert.config for expert in prior.experts]}
    for groups in (2, 12):
        grouped = replace(behaviour(36), group=torch.arange(36) % groups)
        chains = [MarkovPrior(3, 1), MarkovPrior(3, 3)]
        found[f"{groups} groups"] = MixturePrior(3, chains).fit(grouped, generator=seeded(0)).log_prob(plans.actions)
    return found


@case(relative=2e-3)
def mixture_with_a_network():
    plans = behaviour(40)
    prior = MixturePrior(3, [MarkovPrior(3, 1), GRUPrior(3, 8, window=4)]).fit(plans, generator=seeded(1), **QUICK)
    held = MixturePrior(3, [MarkovPrior(3, 1), MarkovPrior(3, 2)]).fit(
        plans, generator=seeded(1), validation=behaviour(6, seed=8)
    )
    return {"mixture": of_prior(prior, plans), "validation": of_prior(held, plans)}


@case(relative=2e-3)
def stacked():
    found = {}
    for context in (None, "step"):
        plans = behaviour(context=context)
        prior = StackedPrior(3, 12, 0.2, (1, 2), 3, num_contexts=context and 3, seed=1)
        prior.fit(plans, generator=seeded(0), **QUICK)
        found[str(context)] = of_prior(prior, plans)
        found[f"{context}, recounted"] = prior.recount(behaviour(context=context, seed=5)).log_prob(plans)
    return found


@case(relative=2e-3)
def switching():
    plans, found = behaviour(30, context="step"), {}
    for name, how in {
        "context": {"num_contexts": 3},
        "constant": {"num_contexts": 3, "switching": "constant", "phases": 2},
        "three": {"num_modes": 3, "order": 2, "smoothing": 2.0, "sharing": 0.5, "stay": 1.0},
    }.items():
        prior = SwitchingPrior(3, **{"max_iterations": 6, "restarts": 2, "folds": 2} | how)
        prior.fit(plans if "num_contexts" in how else plans.without_context(), generator=seeded(0))
        known = plans if "num_contexts" in how else plans.without_context()
        found[name] = of_prior(prior, known) | prior.posterior(known[:3])._asdict()
        found[name] |= {"first": prior.first, "transitions": prior.transitions}
        found[name]["begins"] = prior.beginning_in(1, keep=True).log_prob(known[:4])
        found[name]["recounted"] = prior.recount(known[:9]).log_prob(known[:4])
    return found


@case
def durations():
    plans, found = timed(), {}
    prior = SemiMarkovPrior(3).fit(plans)
    found["semi-markov"] = of_prior(prior, plans) | {"durations": prior.duration_log_prob(plans).nan_to_num(9)}
    drawn = prior.sample_plans(4, 5, generator=seeded(0))
    found["drawn"] = [drawn.actions, drawn.durations]
    for law in LAW_NAMES:
        model = DurationModel(3, [law], transitions=law != "gamma").fit(plans)
        found[law] = {
            "table": model.table(),
            "log_prob": model.log_prob(plans[:4]),
            "cdf": model.cdf(1, torch.tensor([0.0, 0.3, 1.0, 4.0])),
            "drawn": model.sample(plans[:3], generator=seeded(1)),
        }
    found["chosen"] = DurationModel(3).fit(timed(80, 30)).table()
    return found


@case(relative=2e-3)
def networks():
    found = {}
    kinds = {
        "gru": lambda **how: GRUPrior(3, 12, window=5, lags=2, dropout=0.1, seed=1, **how),
        "two layers": lambda **how: GRUPrior(3, 8, 2, lags=1, dropout=0.0, **how),
        "transformer": lambda **how: TransformerPrior(3, 16, 1, 2, window=4, lags=2, dropout=0.1, seed=1, **how),
    }
    for context in (None, "plan", "step", "features"):
        plans = behaviour(context=context)
        how = {"context_size": 2} if context == "features" else {"num_contexts": context and 3}
        for name, make in kinds.items():
            # Of a network without a window of its own, the hidden state is carried over.
            prior = make(**how).fit(plans, generator=seeded(3), **QUICK | {"window": 6 if name == "two layers" else 16})
            found[f"{name}, {context}"] = of_prior(prior, plans)
    return found


@case(relative=2e-3)
def sizes_of_networks():
    """What is not given follows from the plans; the best of several validations is kept."""
    plans, found = behaviour(60), {}
    for kind in (GRUPrior, TransformerPrior):
        prior = kind(3).fit(plans, generator=seeded(0), max_steps=4, check_every=1, progress=False)
        found[kind.__name__] = {"config": prior.config, "log_prob": prior.log_prob(plans)}
    prior = GRUPrior(3, 8, window=3, seed=1).fit(
        plans, generator=seeded(0), max_steps=40, check_every=5, patience=10, learning_rate=0.1, progress=False
    )
    found["best"] = prior.log_prob(plans).mean()
    prior = GRUPrior(3, 8, window=3, seed=1).fit(
        plans, max_steps=4, validation=behaviour(6, seed=2), progress=False, generator=seeded(0)
    )
    found["validation"] = prior.log_prob(plans).mean()
    return found


@case(relative=2e-3)
def patterns():
    plans, found = behaviour(30, context="step"), {}
    place, last = plans.context, plans.actions.long().roll(1, 1)
    plans = replace(plans, context=torch.stack([place, 3 + last, 6 + (place + last) % 4], -1))
    for name, prior, how in (
        ("log-linear", LogLinearPrior(3, 3), {}),
        ("log-linear, levin", LogLinearPrior(3, 3, min_count=5), {"loss": "levin", "epochs": 2}),
    ):
        found[name] = of_prior(prior.fit(plans, generator=seeded(0), **how), plans)
    steps = Steps(plans.context[:6, 1], plans.actions[:6, 0].long(), plans.actions[:6, 1].long(), torch.arange(6) // 2)
    found["steps"] = LogLinearPrior(3, 3).fit_steps(steps, generator=seeded(0)).scores(plans.context[:4, 0].long())
    return found


@case(relative=2e-3)
def fitted_by_name():
    plans, found = timed(16, 8), {}
    for name in PRIORS:
        quick = {} if name in ("uniform", "markov", "context-tree", "semi-markov", "switching") else QUICK
        if name not in ("adaptive", "combined", "mixture", "stacked"):
            prior = fit(plans, name, generator=seeded(0), **quick)
            found[name] = [
                prior.config,
                prior.log_prob(plans).sum(),
                decode(prior.sample(2, 3, generator=seeded(0)), prior),
            ]
    return found


def motion(num: int = 10, length: int = 12, context: bool = False) -> VectorPlans:
    """A damped rotation driven by noise, of unequal lengths, between unlike bounds; the context is its phase."""
    generator = seeded(0)
    noise, now, rows = 0.3 * torch.randn(num, length, 2, generator=generator), torch.zeros(num, 2), []
    turn = 0.9 * torch.tensor([[0.9, -0.43], [0.43, 0.9]])
    for t in range(length):
        now = (now @ turn.T + noise[:, t]).clamp(-1, 1)
        rows.append(now)
    low, high = torch.tensor([-1.0, -2.0]), torch.tensor([1.0, 3.0])
    actions = low + (torch.stack(rows, 1) + 1) / 2 * (high - low)
    lengths = torch.randint(6, length + 1, (num,), generator=generator)
    features = torch.sin(torch.arange(length) / 3).expand(num, -1)[..., None]
    return VectorPlans(actions, low, high, lengths, context=features if context else None)


@case(relative=2e-3)
def priors_of_vectors():
    plans, found = motion(), {}
    ends = (plans.action_low, plans.action_high)
    few: dict[str, Any] = {"max_steps": 5, "batch_size": 4, "progress": False}
    for name, prior, how in (
        ("white", NoisePrior(*ends), {}),
        ("coloured", NoisePrior(*ends, None, memory=5), {}),
        ("autoregressive", AutoregressivePrior(*ends), {}),
        ("stored", StoredWindows(*ends, match=2, horizon=4, max_windows=20), {}),
        ("gru", VectorGRU(*ends, width=8, num_components=2), few),
        ("gru, context", VectorGRU(*ends, 1, width=8, num_layers=2), few),
    ):
        known = motion(context=prior.context_size is not None)
        prior.fit(known, generator=seeded(0), **how)
        context = None if known.context is None else known.context[:4]
        with torch.no_grad():
            found[name] = {
                "log_prob": prior.log_prob(known),
                "actions": prior.action_log_probs(known[:2]),
                "drawn": prior.sample(4, 5, None if context is None else context[:, :1], generator=seeded(1)),
                "goes on": prior.sample(
                    4, 3, None if context is None else context[:, :5], past=known.actions[:4, :4], generator=seeded(2)
                ),
                "config": prior.config,
            }
    return found
