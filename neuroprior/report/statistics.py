"""The statistics of a report on plans, as rows for tables, files and figures."""

from collections.abc import Sequence
from dataclasses import asdict
from math import log
from typing import Any

import torch
from torch import Tensor

from neuroprior.analysis import (
    motifs,
    mutual_information,
    order_selection,
    transitions,
    two_sample_tests,
)
from neuroprior.plans import Plans, is_per_step
from neuroprior.plans.folds import folds
from neuroprior.report.scores import Model

MOST_ORDER = 6
MOST_LAG = 20
TOP = 12
"""Sequences that are listed."""

SIGNIFICANT = 0.05
MANY_REPEATS = 0.2
"""Share of actions that repeat the last one beyond which over-represented sequences are also sought without them."""


def _shuffles() -> torch.Generator:
    """What permutation tests draw from: the same file gives the same report."""
    return torch.Generator().manual_seed(0)


def action_names(plans: Plans) -> list[str]:
    """Names of the actions; their numbers where they have none."""
    return list(plans.action_names or map(str, range(plans.num_actions)))


def group_names(plans: Plans, groups: Tensor) -> list[str]:
    """Names of these groups; their numbers where they have none."""
    return [plans.group_names[g] if plans.group_names else f"group {g}" for g in groups.tolist()]


def information_rows(plans: Plans, skip: int) -> list[dict[str, Any]]:
    """The mutual information of actions k steps apart; none where there are no two pairs of them."""
    if int(plans.mask()[:, max(skip, 1) :].sum()) < 2:
        return []
    return [
        {"what": "mutual information", "model": "counts", "sees": "actions"}
        | {"lag": one.lag, "bits": one.bits, "low": one.low, "high": one.high, "chance": one.critical_value}
        | {"units": None}
        for one in mutual_information(plans, MOST_LAG, skip, _shuffles())
    ]


def order_rows(plans: Plans, num_contexts: int | None) -> list[dict[str, Any]]:
    """Information criteria of Markov chains; in bits per action half of each stands on the scale of the others."""
    # All orders are fitted on the same actions: those with as many before them as the highest order takes.
    usual = int(plans.mask().sum(1).double().median())
    most = min(MOST_ORDER, max(usual // 2, 1), int(plans.mask().sum(1).max()) - 1)
    rows = []
    for contexts in [None] if num_contexts is None else [None, num_contexts]:
        for fit in order_selection(plans, most, contexts):
            scale = 2 * log(2) * max(fit.num_actions_scored, 1)
            per_action = {"bic_bits": fit.bic / scale, "aic_bits": fit.aic / scale}
            rows.append({"sees": "actions" + " and context" * (contexts is not None)} | asdict(fit) | per_action)
    return rows


def transition_rows(plans: Plans) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Each transition, overall and in each group; and the test of whether groups differ, with the matrices."""
    found = transitions(plans, generator=_shuffles())
    names, groups = action_names(plans), group_names(plans, found.groups) if plans.group is not None else []
    probs, each = found.probs(), found.group_probs()
    rows = [
        {
            "group": group,
            "from": names[a],
            "to": names[b],
            "count": int(counts[a, b]),
            "probability": float(matrix[a, b]),
            "p_value": None if p_values is None or found.test != "permutation" else float(p_values[a, b]),
        }
        for group, counts, matrix, p_values in [
            ("all", found.counts, probs, None),
            *zip(groups, found.group_counts, each, found.cell_p_values, strict=False),
        ]
        for a, b in counts.nonzero().tolist()
    ]
    test = {
        "test": found.test,
        "statistic": found.statistic,
        "p_value": found.p_value,
        "permutations": found.permutations,
        "groups": groups,
    }
    tensors = {"probs": probs, "group_probs": each, "significant": found.cell_p_values < SIGNIFICANT}
    return rows, test | tensors


def motif_rows(plans: Plans) -> list[dict[str, Any]]:
    """The sequences that stand out the most, with repeats of an action and, where these are many, without."""
    names, rows = action_names(plans), []
    goes_on = plans.mask()[:, 1:]
    again = (plans.actions[:, 1:] == plans.actions[:, :-1])[goes_on].double().mean()
    for collapsed in (False, True) if float(again) > MANY_REPEATS else (False,):
        for motif in motifs(plans, top=TOP, collapse_repeats=collapsed):
            sequence = " ".join(names[a] for a in motif.actions)
            numbers = {key: value for key, value in asdict(motif).items() if key != "actions"}
            rows.append({"repeats": "merged" if collapsed else "kept", "sequence": sequence} | numbers)
    return rows


def likeness_rows(real: Plans, model: Model, tested: bool) -> tuple[list[dict[str, Any]], list[Any]]:
    """Sequences sampled from a model against the real ones in whose place they stand.

    Where the plans come in groups they are not `tested`: plans of one subject are more alike than those of a model of
    all subjects, however good, and the first fold holds too few groups to shuffle these.
    """
    generated = model.load("generated")
    if generated is None:
        return [], []
    like = real[: len(generated)]
    sampled = Plans(torch.from_numpy(generated), real.num_actions, like.lengths)
    plain = Plans(like.actions, real.num_actions, like.lengths)
    found = two_sample_tests(plain, sampled, generator=_shuffles())
    rows = [
        {
            "model": model.name,
            "sees": model.sees,
            "statistic": one.statistic,
            "distance": one.distance,
            "chance": one.null_distance,
            "p_value": one.p_value if tested else None,
            "corrected": one.corrected if tested else None,
        }
        for one in found
    ]
    return rows, found


def num_contexts(plans: Sequence[Plans]) -> int | None:
    """The number of context indices; None without."""
    contexts = [some.context for some in plans if some.context is not None]
    if not contexts or contexts[0].is_floating_point():
        return None
    return max(int(context.max()) + 1 for context in contexts if context.numel())


def describe(plans: Plans) -> dict[str, Any]:
    """What is in the file."""
    lengths = plans.mask().sum(1)
    seen = "nothing"
    if plans.context is not None:
        kind = "features" if plans.context.is_floating_point() else f"{num_contexts([plans])} contexts"
        seen = f"{kind}, {'at each step' if is_per_step(plans.context) else 'once a plan'}"
    return {
        "plans": len(plans),
        "actions": int(lengths.sum()),
        "shortest": int(lengths.min()),
        "longest": int(lengths.max()),
        "kinds of actions": plans.num_actions,
        "groups": 0 if plans.group is None else len(plans.group.unique()),
        "sees": seen,
    }


def first_fold(scored: Plans, settings: dict[str, Any]) -> Plans:
    """The held-out plans of the first fold, in whose place plans were sampled."""
    if settings.get("folds", 1) == 1:
        return scored
    return scored[folds(scored, settings["folds"], settings["seed"])[0][1]]
