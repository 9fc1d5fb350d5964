"""Mixtures: Bayes' rule against enumeration, fixed share against its recursion, learned weights, packed states."""

import math
from functools import cache

import pytest
import torch

from neuroprior import ContextTreePrior, GRUPrior, MarkovPrior, Plans, TransformerPrior, UniformPrior
from neuroprior.priors import MixturePrior, StackedPrior
from neuroprior.priors.learning import split_validation
from neuroprior.testing import check_prior
from tests.support.sources import every_plan, seeded

A = 3


def some_plans(num: int = 40, seed: int = 0, contexts: int | None = None) -> Plans:
    actions = torch.randint(A, (num, 6), generator=seeded(seed)).cumsum(1) % A
    context = None if contexts is None else torch.randint(contexts, (num, 6), generator=seeded(seed + 1))
    return Plans(actions, A, context=context)


def experts() -> list:
    plans = some_plans()
    return [UniformPrior(A), MarkovPrior(A, 2).fit(plans), GRUPrior(A, 8, seed=1), MarkovPrior(A, 0).fit(plans)]


def weighted(mixture: MixturePrior, weights: list[float], share: float = 0.0) -> MixturePrior:
    mixture.first, mixture.share = torch.tensor(weights).log(), share
    return mixture


@torch.no_grad()
def test_a_plan_has_its_probability_in_the_mixture():
    """Without a share the mixture of whole plans, over all plans of four actions."""
    weights = [0.1, 0.4, 0.3, 0.2]
    mixture = weighted(MixturePrior(A, experts()), weights)
    plans = every_plan(A, 4)
    parts = [w * e.log_prob(plans).exp() for w, e in zip(weights, mixture.experts, strict=True)]
    assert mixture.log_prob(plans).exp().allclose(torch.stack(parts).sum(0), atol=1e-6)
    assert float(mixture.log_prob(plans).exp().sum()) == pytest.approx(1, abs=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_weights_follow_the_recursion_of_fixed_share(share):
    weights = [0.1, 0.4, 0.3, 0.2]
    mixture = weighted(MixturePrior(A, experts()), weights, share)
    plan = torch.tensor([[0, 2, 2, 1, 0]])
    forecasts = [e(plan).softmax(-1)[0] for e in mixture.experts]
    now, total = list(weights), 0.0
    for t, action in enumerate(plan[0].tolist()):
        predicted = [w * float(f[t, action]) for w, f in zip(now, forecasts, strict=True)]
        total += math.log(sum(predicted))
        now = [(1 - share) * w / sum(predicted) + share * first for w, first in zip(predicted, weights, strict=True)]
    assert float(mixture.log_prob(plan)) == pytest.approx(total, abs=1e-5)


@cache
def conformance() -> list[MixturePrior]:
    plans, current = some_plans(), some_plans(contexts=4)
    small = {"max_steps": 5, "progress": False}
    made = [weighted(MixturePrior(A, experts()), [0.1, 0.4, 0.3, 0.2], 0.1)]
    some = [MarkovPrior(A, 1, num_contexts=4), ContextTreePrior(A, 2), GRUPrior(A, 8, num_contexts=4)]
    made.append(MixturePrior(A, some).fit(current, generator=seeded(0), **small))
    made.append(MixturePrior(A, [TransformerPrior(A, 16, window=2), GRUPrior(A, 8, window=1)]))
    nested = MixturePrior(A, [StackedPrior(A, 8, orders=(1,), depth=2), UniformPrior(A)])
    return [*made, MixturePrior(A, [nested, MarkovPrior(A, 1)]).fit(plans, generator=seeded(0), **small)]


@pytest.mark.parametrize("number", range(4), ids=["no context", "contexts", "windows", "nested"])
def test_it_is_a_prior(number):
    check_prior(conformance()[number], 3, 2000)


def test_weights_are_learned():
    """Plans of a chain: all weight goes to the chain; half of the plans each of two experts: half the weight."""
    plans = MarkovPrior(A, 1).fit(some_plans()).sample(400, 30, generator=seeded(3))
    right, wrong = MarkovPrior(A, 1).fit(some_plans()), MarkovPrior(A, 1).fit(torch.arange(60).view(2, 30) % A)
    mixture = MixturePrior(A, [right, wrong])
    mixture.learn_weights(Plans(plans, A))
    assert mixture.first.exp()[0] > 0.99
    both = torch.cat([plans[:200], wrong.sample(200, 30, generator=seeded(4))])
    mixture.learn_weights(Plans(both, A))
    assert mixture.share == 0
    assert float(mixture.first.exp()[0]) == pytest.approx(0.5, abs=0.02)


def test_weights_are_learned_on_plans_that_the_experts_did_not_see():
    """A chain of order 5 knows each training plan by heart; in the end both chains count all plans."""
    plans = Plans(torch.randint(A, (60, 8), generator=seeded(0)), A)
    mixture = MixturePrior(A, [MarkovPrior(A, 0), MarkovPrior(A, 5)]).fit(plans, generator=seeded(1), validation=0.25)
    learned, held_out = plans.split(0.25, seeded(1))
    by_hand = MixturePrior(A, [MarkovPrior(A, k).fit(learned) for k in (0, 5)])
    by_hand.learn_weights(held_out)
    assert mixture.first.equal(by_hand.first)
    assert mixture.share == by_hand.share
    for expert, k in zip(mixture.experts, (0, 5), strict=True):
        assert expert.log_prob(plans).equal(MarkovPrior(A, k).fit(plans).log_prob(plans))


def test_what_is_beyond_the_ends_of_plans_has_no_weight():
    one, two = (MarkovPrior(A, 0).fit(torch.full((4, 20), action)) for action in (0, 1))
    switching = ((torch.arange(80).view(5, 16) // 4) % 3 == 2).long()  # more often 0 than 1
    lengths = torch.arange(5) * 2 + 7
    mixture, learned = MixturePrior(A, [one, two]), []
    for more in (0, 9):
        mixture.learn_weights(Plans(torch.nn.functional.pad(switching, (0, more)), A, lengths))
        learned.append((mixture.share, mixture.first.tolist()))
    assert learned[0][0] == learned[1][0]
    assert learned[0][1] == pytest.approx(learned[1][1], abs=1e-5)
    assert learned[0][0] > 0


@pytest.mark.parametrize(
    ("made", "more", "word"),
    [
        ([], {}, "at least one"),
        ([UniformPrior(2)], {}, "experts\\[0\\]: has 2 actions"),
        ([UniformPrior(A)], {"share": 1.5}, "share"),
        ([MarkovPrior(A, 1, num_contexts=2), MarkovPrior(A, 1, num_contexts=3)], {}, "the same"),
    ],
)
def test_experts_that_do_not_fit(made, more, word):
    with pytest.raises(ValueError, match=word):
        MixturePrior(A, made, **more)


@pytest.mark.parametrize(("length", "held_out"), [(1, 100), (10, 100), (80, 62), (200, 25), (500, 20)])
def test_the_share_held_out_is_a_tenth_of_few_plans_and_a_fiftieth_of_many(length, held_out):
    """5,000 actions between these; of 1,000 plans of so many actions."""
    plans = Plans(torch.zeros(1000, length, dtype=torch.uint8), 2)
    learned, chosen_on = split_validation(plans, None, seeded(0))
    assert (len(learned), len(chosen_on)) == (1000 - held_out, held_out)


def test_plans_without_actions_are_not_held_out():
    """Of 40 plans 10 have actions: of these, half are held out, and none is left for another 30."""
    lengths = torch.where(torch.arange(40) % 4 == 0, 3, 0)
    parts = split_validation(Plans(torch.randint(A, (40, 3), generator=seeded(0)), A, lengths), 0.5, seeded(0))
    assert [part.mask().sum(1).tolist() for part in parts] == [[3] * 5] * 2
