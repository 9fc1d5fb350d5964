"""A prior with scikit-learn's methods; with scikit-learn itself where it is installed."""

import math
from functools import partial

import pytest
import torch

from neuroprior import GRUPrior, MarkovPrior, Plans, UniformPrior, fit
from neuroprior.priors import PriorEstimator
from tests.support.sources import refuses, seeded


def sorted_plans(number: int = 40) -> Plans:
    """Actions that never decrease: a chain of order 1 or 2 predicts them, one of order 0 does not."""
    actions = torch.randint(3, (number, 8), generator=seeded(0)).sort(1).values
    return Plans(actions, 3, group=torch.arange(number) // 4, plan_names=[f"plan {i}" for i in range(number)])


def test_fit_and_score_are_those_of_the_prior() -> None:
    plans = sorted_plans()
    estimator = PriorEstimator("markov", order=1).fit(plans)
    prior = MarkovPrior(3, order=1).fit(plans)
    assert torch.equal(estimator.prior_.log_prob(plans), prior.log_prob(plans))
    bits = -prior.log_prob(plans).double().sum().item() / math.log(2) / 320
    assert estimator.score(plans) == pytest.approx(-bits)
    assert PriorEstimator("uniform").fit(plans).score(plans) == pytest.approx(-math.log2(3))


def test_settings_reach_the_prior_or_its_fit() -> None:
    estimator = PriorEstimator(GRUPrior, hidden_size=4, max_steps=1, seed=1).fit(sorted_plans())
    assert estimator.prior_.config["hidden_size"] == 4
    again = PriorEstimator(GRUPrior, hidden_size=4, max_steps=1, seed=1).fit(sorted_plans())
    assert estimator.score(sorted_plans()) == again.score(sorted_plans())
    with refuses("max_steps"):
        PriorEstimator("markov", max_steps=3).fit(sorted_plans())
    with refuses("gru"):
        PriorEstimator("gruu").fit(sorted_plans())


def test_params_are_got_and_set() -> None:
    estimator = PriorEstimator("markov", order=1)
    assert estimator.get_params() == {"prior": "markov", "num_actions": None, "seed": 0, "order": 1}
    assert estimator.set_params(order=2, seed=3) is estimator
    assert PriorEstimator(**estimator.get_params()).get_params() == estimator.get_params()
    assert repr(estimator) == "PriorEstimator(prior='markov', num_actions=None, seed=3, order=2)"


def test_a_list_of_plans_is_these_plans() -> None:
    plans = sorted_plans()
    durations = torch.rand(40, 8, generator=seeded(1))
    plans = Plans(plans.actions, 3, context=plans.actions.long().roll(1, 1), group=plans.group, durations=durations)
    parts = list(plans)
    assert [len(part) for part in parts] == [1] * 40
    both = [PriorEstimator("markov", order=1).fit(given) for given in (plans, parts)]
    assert both[0].score(plans) == both[1].score(parts) == both[1].score(plans)
    assert both[1].prior_.takes_context
    with refuses("list(plans)"):
        PriorEstimator("markov").fit([plans[:1], plans[:1].steps(1)])


def test_there_may_be_more_contexts_than_occur() -> None:
    plans = Plans(torch.zeros(20, 3, dtype=torch.long), 2, context=torch.arange(60).view(20, 3) % 4)
    for prior in (PriorEstimator("markov", num_contexts=9), PriorEstimator("gru", num_contexts=9, max_steps=1)):
        assert prior.fit(plans).prior_.num_contexts == 9
        new = Plans(plans.actions, 2, context=plans.context + 5)
        assert math.isfinite(prior.score(new))
    assert PriorEstimator("markov").fit(plans).prior_.num_contexts == 4
    assert fit(plans, partial(MarkovPrior, num_contexts=6)).num_contexts == 6
    assert fit(plans, partial(MarkovPrior, num_contexts=None)).num_contexts == 4
    with refuses("3 is out of range: there are 3 contexts"):
        fit(plans, partial(MarkovPrior, num_contexts=3))


def test_integers_have_as_many_actions_as_is_said() -> None:
    actions = sorted_plans().actions
    assert PriorEstimator("uniform").fit(actions.numpy()).prior_.num_actions == 3
    assert PriorEstimator(UniformPrior, num_actions=5).fit(actions).prior_.num_actions == 5
    with refuses("fit the estimator first"):
        PriorEstimator("uniform").score(actions)


def test_in_scikit_learn() -> None:
    selection = pytest.importorskip("sklearn.model_selection", reason="scikit-learn is not installed")
    plans = sorted_plans()
    search = selection.GridSearchCV(PriorEstimator("markov"), {"order": [0, 1]}, cv=selection.GroupKFold(3))
    search.fit(list(plans), groups=plans.group)
    assert search.best_params_ == {"order": 1}
    parts = list(selection.GroupKFold(3).split(plans.actions, groups=plans.group))
    by_hand = [MarkovPrior(3, 1).fit(plans[torch.from_numpy(train)]) for train, _ in parts]
    scores = [
        prior.log_prob(plans[torch.from_numpy(test)]).double().mean().item() / 8 / math.log(2)
        for prior, (_, test) in zip(by_hand, parts, strict=True)
    ]
    assert search.cv_results_["mean_test_score"][1] == pytest.approx(sum(scores) / 3)
