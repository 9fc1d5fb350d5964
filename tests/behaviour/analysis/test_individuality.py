"""Individuality: what following an individual saves."""

from dataclasses import replace
from math import inf, log

import pytest
import torch

from neuroprior import MarkovPrior
from neuroprior.behaviour import RecordedPlans, individuality
from neuroprior.plans.folds import folds
from neuroprior.priors import AdaptivePrior, adapt
from tests.support.sources import refuses, seeded

NAMES = ("eat", "groom", "rest")


def study(concentration, seed, subjects=12):
    """Two plans of unequal lengths of each subject, whose transitions are drawn around common ones."""
    rows = torch.tensor([[0.2, 0.5, 0.3], [0.6, 0.1, 0.3], [0.3, 0.3, 0.4]])
    generator = seeded(seed)
    probs = rows.expand(subjects, 3, 3)
    if concentration < inf:
        gammas = torch._standard_gamma(concentration * probs, generator=generator)
        probs = gammas / gammas.sum(-1, keepdim=True)
    group = torch.arange(2 * subjects) % subjects
    actions = torch.zeros(2 * subjects, 150, dtype=torch.long)
    for t in range(1, 150):
        actions[:, t] = probs[group, actions[:, t - 1]].multinomial(1, generator=generator)[:, 0]
    lengths = torch.randint(60, 151, (2 * subjects,), generator=generator)
    names = tuple(f"m{number}" for number in range(subjects))
    return RecordedPlans(actions, 3, lengths, action_names=NAMES, group=group, group_names=names)


def test_what_is_saved_is_that_of_priors_that_have_not_met_the_subject():
    plans = study(8.0, 0)
    result = individuality(plans)
    due = dict.fromkeys(range(12), 0.0)
    for rest, held_out in folds(plans, 5):
        prior = AdaptivePrior(MarkovPrior(3, 1), [10.0, 10.0]).fit(plans[rest])
        for group in plans.group[held_out].unique().tolist():
            first, second = (plans[[number]] for number in (plans.group == group).nonzero()[:, 0].tolist())
            adapted = prior.log_prob(first) + adapt(prior, first).log_prob(second)
            due[group] += float(adapted - prior.base.log_prob(first) - prior.base.log_prob(second)) / log(2)
    frame = result.frame()
    assert (frame["saved"] * frame["bouts"]).to_numpy() == pytest.approx(list(due.values()), abs=1e-3)
    assert frame["bouts"].tolist() == [int(plans.lengths[plans.group == g].sum()) for g in range(12)]
    by_behaviour = result.behaviours()
    assert by_behaviour["behaviour"].tolist() == list(NAMES)
    total = float((by_behaviour["saved"] * by_behaviour["bouts"]).sum())
    assert result.total.mean == pytest.approx(total / by_behaviour["bouts"].sum())
    predicted = log(3) / log(2) - float((frame["bits"] * frame["bouts"]).sum()) / frame["bouts"].sum()
    assert result.share == pytest.approx(result.total.mean / (predicted + result.total.mean))
    assert result.total.low > 0
    assert 4 < result.concentrations[1] < 16
    assert result.concentrations[0] == inf
    renamed = individuality(replace(plans, group_names=plans.group_names[::-1]))
    assert renamed.names == list(plans.group_names[::-1])


def test_where_individuals_are_alike_nothing_is_saved():
    result = individuality(study(inf, 2))
    assert abs(result.total.mean) < 2e-3
    assert result.concentrations == (inf, inf)
    assert result.total.p_value > 0.05


def test_two_subjects_are_too_few():
    with refuses("`source` must have at least 3 subjects, got 2"):
        individuality(study(8.0, 3, subjects=2))
