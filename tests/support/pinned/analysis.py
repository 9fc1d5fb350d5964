"""Statistics of plans, comparisons of priors on held-out plans, intervals and tests."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import torch

from neuroprior import score as score_table
from neuroprior.analysis import (
    action_bits,
    action_drift,
    baselines,
    best_of,
    bits_by_position,
    by_group,
    by_plan,
    by_position,
    choose_modes,
    compare_conditions,
    forecast,
    holm,
    infer,
    interquartile_mean,
    mean_interval,
    mean_intervals,
    mode_frame,
    mode_plans,
    mode_table,
    mode_transitions,
    motifs,
    mutual_information,
    order_selection,
    paired_difference,
    pieces,
    probability_of_improvement,
    ratio_difference,
    reliability,
    score,
    score_bits,
    share_interval,
    transitions,
    two_sample_tests,
    unit_name,
    units,
)
from neuroprior.priors import ContextTreePrior, MarkovPrior, SwitchingPrior, UniformPrior
from neuroprior.worlds import cube, gridworld
from tests.support.pinned.data import behaviour, timed
from tests.support.sources import seeded
from tests.support.studies import between, study, within
from tests.support.unchanged import case

VALUES = [0.31, 0.52, 0.48, 0.9, 0.12, 0.77, 0.5]
OTHERS = [0.2, 0.55, 0.31, 0.7, 0.15, 0.6, 0.51]


@case
def intervals():
    numbers = torch.rand(4, 7, generator=seeded(0)).numpy()
    frame = pd.DataFrame({"world": list("aabbbbc"), "seed": range(7), "value": VALUES})
    found: dict[str, Any] = {}
    for level in (0.95, 0.8):
        found[str(level)] = {
            "mean": mean_interval(VALUES, level),
            "alike": mean_interval([0.5, 0.5, 0.5], level),
            "paired": paired_difference(VALUES, OTHERS, level),
            "paired, alike": paired_difference([1.0, 2.0, 3.0], [0.5, 1.5, 2.5], level),
            "ratio": ratio_difference(VALUES, [3, 9, 4, 10, 2, 7, 5], level),
            "iqm": interquartile_mean(numbers, level),
            "improvement": probability_of_improvement(numbers, numbers[::-1] + 0.1, level),
            "share": [share_interval(3, 17, level), share_interval(0, 5, level), share_interval(5, 5, level)],
            "by world": mean_intervals(frame, "world", "value", level),
        }
    found["holm"] = holm([0.01, 0.2, 0.03, 0.5, 0.009])
    scores = torch.tensor([[0.2, 0.5, 0.3], [0.1, 0.6, 0.6]])
    found["best"] = [best_of(scores), best_of(scores, [1]), best_of(scores.T, [0, 2])]
    return found


@case
def sequences():
    """Lags, orders, motifs and transitions."""
    found: dict[str, Any] = {}
    for name, plans in {
        "plain": behaviour(30),
        "context": behaviour(30, context="step"),
        "with an end": behaviour(20).with_end(),
        "alone": behaviour(1, 200),
    }.items():
        found[name] = {
            "lags": mutual_information(plans, 4, generator=seeded(0)),
            "lags after some": mutual_information(plans, 3, skip=2, generator=seeded(0)),
            "motifs": motifs(plans, (2, 3), top=8),
            "motifs without repeats": motifs(plans, (3,), top=5, collapse_repeats=True),
            "orders": order_selection(plans, 3),
            "transitions": transitions(plans, 99, seeded(0)),
            "unit": [unit_name(plans), units(plans, plans.mask())],
        }
    for name, some in {
        "ungrouped": replace(behaviour(9), group=None),
        "of one group": replace(behaviour(9), group=torch.full((9,), 3)),
        "alone": behaviour(1, 90),
    }.items():
        mask = some.mask() & (torch.arange(some.max_length) > 2)
        found[f"units, {name}"] = [unit_name(some, mask), units(some, mask)]
        found[f"transitions, {name}"] = transitions(some, 49, seeded(0)).p_value
        found[f"lags, {name}"] = mutual_information(some, 2, generator=seeded(0))
    few = replace(behaviour(4, 60), group=torch.tensor([0, 1, 1, 2]))
    found["few plans of a group"] = transitions(few, 99, seeded(0))
    found["orders of contexts"] = order_selection(behaviour(30, context="step"), 2, 3)
    found["chi-square"] = transitions(behaviour(300, 30), 99, seeded(0), max_work=10)
    found["pieces"] = pieces(behaviour(9, 30), 5, 12, seeded(0)).actions
    return found


@case
def comparisons():
    """Priors on held-out plans: bits, differences, calibration, drift, what is generated."""
    learned, held_out = behaviour(40), behaviour(24, seed=7)
    chain, tree, nothing = MarkovPrior(3, 1).fit(learned), ContextTreePrior(3, 4).fit(learned), UniformPrior(3)
    scores = [score(name, prior, held_out) for name, prior in {"chain": chain, "tree": tree}.items()]
    bits, mask = action_bits(chain, held_out), held_out.mask()
    found: dict[str, Any] = {
        "scores": scores,
        "bits": [one.bits_per_action() for one in scores],
        "difference": scores[0].minus(scores[1]),
        "of some": score_bits("some", "actions", bits, held_out, mask & (torch.arange(14) > 1)).bits_per_action(),
        "positions": [one.bits_per_action() for one in bits_by_position(tree, pieces(held_out, 4, 40, seeded(0)))],
        "baselines": [[one.model, one.how, one.validation_bits] for one in baselines(learned, held_out)],
        "drift by group": by_group(held_out, bits, mask),
        "drift by plan": by_plan(held_out, bits, mask),
        "drift by position": by_position(held_out, bits, mask, 4),
        "drift of actions": action_drift(held_out),
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
    forecasts = torch.cat([chain(part.actions).log_softmax(-1)[part.mask()] for part in [held_out]])
    unit = units(held_out, mask)[mask]
    curve = reliability(forecasts, held_out.actions[mask].long(), unit, 4)
    found["reliability"] = [curve.bins, curve.expected_calibration_error]
    generated = chain.sample(24, 14, generator=seeded(3))
    plans = type(held_out)(generated, 3, held_out.lengths)
    found["likeness"] = two_sample_tests(held_out, plans, 99, seeded(0))
    found["likeness without groups"] = two_sample_tests(
        plans, type(plans)(nothing.sample(30, 9, generator=seeded(1)), 3), 99, seeded(0)
    )
    for by in ("plan", "group", "condition", "action"):
        found[f"by {by}"] = score_table(MarkovPrior(3, 1).fit(timed()), timed(9, seed=4), by)
    return found


@case
def conditions():
    def change(probs, condition):
        probs[condition == 1] = probs[condition == 1].roll(1, -1) * 0.4 + probs[condition == 1] * 0.6

    found: dict[str, Any] = {}
    for name, plans in {
        "between": study(1, between(8, 2), 40, change=change, slower={2: 1.6}),
        "within": study(2, within(5, 4), 40, change=change),
        "three": study(3, between(9, 2, 3), 30),
        "few": study(4, between(3, 2), 30),
    }.items():
        result = compare_conditions(plans, 199, seeded(0))
        design = result.design
        found[name] = dict(vars(result)) | {
            "design": vars(design),
            "smallest": design.smallest_p(199),
            "labellings": design.labellings(5, seeded(1)),
            "differs": {test: result.differs(test) for test in result.tests},
            "significant": [result.significant(family) for family in result.families],
        }
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
    world = gridworld(4, 4)
    state, targets = world.reset(5, seeded(0)), torch.tensor([0, 5, 9])
    found: dict[str, Any] = {name: one.log_probs for name, one in posteriors.items()}
    found["frame"] = posteriors["even"].to_frame()
    for within_ in (False, True):
        found[f"forecast {within_}"] = forecast(
            priors, world, state, posteriors["even"], 4, 50, targets=targets, within=within_, generator=seeded(1)
        )
    cube_ = cube(scramble=2)
    state = cube_.reset(3, seeded(0))
    found["forecast of cubes"] = forecast(
        [UniformPrior(cube_.num_actions)], cube_, state, torch.ones(3, 1), 2, 200, targets=state, generator=seeded(1)
    )
    closed = {name: MarkovPrior(3, 1).fit(behaviour(20, 6, 2, seed=seed).with_end()) for seed, name in enumerate("ab")}
    found["with an end"] = [infer(closed, behaviour(4, 5, 2, seed=3).with_end()), infer(closed, actions[:3] % 2)]
    return found


@case
def null_features():
    """Arrays of numpy are taken as tensors are."""
    return [
        holm(np.array([0.5])),
        mean_interval(np.array(VALUES)),
        paired_difference(np.array(VALUES), torch.tensor(OTHERS)),
    ]
