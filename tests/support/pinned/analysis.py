"""Statistics of plans, comparisons of priors on held-out plans, intervals and tests."""

from dataclasses import replace
from typing import Any

import torch

from neuroprior.behaviour import (
    action_bits,
    baselines,
    by_group,
    by_plan,
    by_position,
    choose_modes,
    mode_frame,
    mode_plans,
    mode_table,
    rate_drift,
    score,
    score_bits,
)
from neuroprior.behaviour.analysis.lags import pieces
from neuroprior.behaviour.analysis.modes import mode_transitions
from neuroprior.priors import ContextTreePrior, MarkovPrior, SwitchingPrior, infer
from neuroprior.priors.scoring import score as score_table
from tests.support.pinned.data import behaviour, timed
from tests.support.sources import seeded
from tests.support.unchanged import case


@case
def comparisons():
    """Priors on held-out plans: bits, differences, drift."""
    learned, held_out = behaviour(40), behaviour(24, seed=7)
    chain, tree = MarkovPrior(3, 1).fit(learned), ContextTreePrior(3, 4).fit(learned)
    scores = [score(name, prior, held_out) for name, prior in {"chain": chain, "tree": tree}.items()]
    bits, mask = action_bits(chain, held_out), held_out.mask()
    found: dict[str, Any] = {
        "scores": scores,
        "bits": [one.bits_per_action() for one in scores],
        "difference": scores[0].minus(scores[1]),
        "of some": score_bits("some", "actions", bits, held_out, mask & (torch.arange(14) > 1)).bits_per_action(),
        "pieces": pieces(held_out, 4, 40, seeded(0)).actions,
        "baselines": [[one.model, one.how, one.validation_bits] for one in baselines(learned, held_out)],
        "drift by group": by_group(held_out, bits, mask),
        "drift by plan": by_plan(held_out, bits, mask),
        "drift by position": by_position(held_out, bits, mask, 4),
        "drift of rates": rate_drift(held_out).frame(),
    }
    many = replace(behaviour(40, 8, seed=3), group=torch.arange(40) % 3)
    rising = torch.arange(40.0)[:, None].double() + torch.rand(40, 8, generator=seeded(0))
    found["rising drift"] = [by_plan(many, rising, many.mask()), by_plan(many, -rising, many.mask())]
    found["drift of one group"] = by_plan(replace(many, group=None), rising.sin(), many.mask())
    few = by_plan(many[:9], rising[:9].cos(), many[:9].mask())
    found["drift of few"] = [few, by_group(many[:9], rising[:9], many[:9].mask())]
    context = behaviour(40, context="step")
    found["baselines with context"] = [
        [one.model, one.how, one.validation_bits] for one in baselines(context, behaviour(9, context="step", seed=2), 3)
    ]
    for by in ("plan", "group", "condition", "action"):
        found[f"by {by}"] = score_table(MarkovPrior(3, 1).fit(timed()), timed(9, seed=4), by)
    return found


@case(relative=2e-3)
def modes():
    plans = behaviour(30, 20)
    choice = choose_modes(plans, (1, 2), generator=seeded(0), max_iterations=5, restarts=2)
    prior = choice.priors[2]
    context = behaviour(30, context="plan", context_names=("a", "b", "c"), action_names=("x", "y", "z"))
    known = SwitchingPrior(3, 2, num_contexts=3, max_iterations=4, restarts=1).fit(context, generator=seeded(0))
    return {
        "choice": [choice.chosen, choice.stability, choice.frame()],
        "stable": choice.stable(2),
        "table": mode_table(prior, plans),
        "frame": mode_frame(prior, plans[:5]),
        "plans": mode_plans(prior, plans).actions,
        "transitions": mode_transitions(prior, plans),
        "with contexts": mode_frame(known, context[:6]),
        "table with contexts": mode_table(known, context),
    }


@case
def intentions():
    priors = {name: MarkovPrior(4, 1).fit(behaviour(30, num_actions=4, seed=seed)) for seed, name in enumerate("abc")}
    actions = behaviour(5, 6, 4, seed=9).actions
    posteriors = {
        "even": infer(priors, actions),
        "switching": infer(priors, actions, switch=0.2, weights=[0.5, 0.2, 0.3]),
        "tempered": infer(priors, behaviour(5, 6, 4, seed=9), power=0.5),
    }
    found: dict[str, Any] = {name: one.log_probs for name, one in posteriors.items()}
    found["frame"] = posteriors["even"].to_frame()
    closed = {name: MarkovPrior(3, 1).fit(behaviour(20, 6, 2, seed=seed).with_end()) for seed, name in enumerate("ab")}
    found["with an end"] = [infer(closed, behaviour(4, 5, 2, seed=3).with_end()), infer(closed, actions[:3] % 2)]
    return found
