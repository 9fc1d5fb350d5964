"""The prior that learns the individual: closed forms, its base, its concentrations, and what is handed on."""

from itertools import pairwise, product
from math import inf, lgamma, log

import pytest
import torch

from neuroprior import ContextTreePrior, GRUPrior, MarkovPrior, Plans, UniformPrior, fit, load, save
from neuroprior.priors import AdaptivePrior, MixturePrior, adapt
from neuroprior.priors.adaptive import likeliest_concentrations
from neuroprior.testing import check_prior
from tests.support.sources import refuses, seeded

SKEWED = Plans(torch.tensor([[0, 0, 1], [0, 2, 0], [1, 0, 0], [0, 0, 2]]), 3, torch.tensor([3, 2, 3, 1]))


def test_level_0_is_polyas_urn():
    """The probability of a sequence is a ratio of Gamma functions of its counts: it is exchangeable."""
    base, c = MarkovPrior(3, 0).fit(SKEWED), 1.7
    share = base.start(1)[0].softmax(-1)[0]
    urn = AdaptivePrior(base, [c])
    plans = torch.tensor([[2, 0, 0, 1, 0, 2, 0], [0, 0, 0, 0, 1, 2, 2], [1, 1, 1, 1, 1, 1, 1]])
    due = []
    for plan in plans:
        counts = plan.bincount(minlength=3)
        due.append(lgamma(c) - lgamma(c + len(plan)))
        due[-1] += sum(lgamma(c * float(p) + int(n)) - lgamma(c * float(p)) for p, n in zip(share, counts, strict=True))
    assert urn.log_prob(plans).tolist() == pytest.approx(due, abs=1e-5)
    assert due[0] == pytest.approx(due[1], abs=1e-9)


def by_hand(base, plan, concentrations, decay=1.0):
    """The log-probability of a plan, action by action, from lists of what followed each history."""
    total = 0.0
    for t, action in enumerate(plan):
        probs = base(torch.tensor([plan]))[0, t].softmax(-1).double().tolist()
        for level, c in enumerate(concentrations):
            followed = [plan[i] for i in range(level, t) if plan[i - level : i] == plan[t - level : t] and t >= level]
            weights = [decay ** (len(followed) - 1 - k) for k in range(len(followed))]
            if c < inf:
                counts = [sum(w for w, a in zip(weights, followed, strict=True) if a == b) for b in range(len(probs))]
                probs = [(n + c * p) / (sum(weights) + c) for n, p in zip(counts, probs, strict=True)]
        total += log(probs[action])
    return total


@pytest.mark.parametrize(
    ("concentrations", "decay"), [((2.0, 0.7, 3.0), 1.0), ((inf, 1.3), 0.6), ((0.4, inf, 1.0), 0.0)]
)
def test_levels_by_hand(concentrations, decay):
    base = MarkovPrior(3, 1).fit(SKEWED)
    prior = AdaptivePrior(base, concentrations, decay)
    plan = [0, 1, 0, 2, 0, 1, 0, 1, 1, 0, 1, 2]
    assert float(prior.log_prob(torch.tensor([plan]))) == pytest.approx(
        by_hand(base, plan, concentrations, decay), abs=1e-5
    )
    every = torch.tensor(list(product(range(3), repeat=5)))
    assert float(prior.log_prob(every).exp().sum()) == pytest.approx(1, abs=1e-5)
    check_prior(prior)


def test_with_infinite_concentrations_it_is_its_base():
    base = GRUPrior(3, 8, num_contexts=4)
    plans = Plans(
        torch.randint(3, (9, 6), generator=seeded(0)), 3, context=torch.randint(4, (9, 6), generator=seeded(1))
    )
    assert AdaptivePrior(base, [inf, inf]).log_prob(plans).equal(base.log_prob(plans))
    assert not AdaptivePrior(base, [inf, 5.0]).log_prob(plans).allclose(base.log_prob(plans))


def test_long_plans_are_counted_in_parts(monkeypatch):
    prior, plans = AdaptivePrior(UniformPrior(3), [1.0, 2.0, 0.5], 0.9), torch.randint(3, (5, 40), generator=seeded(2))
    whole = prior.log_prob(plans)
    monkeypatch.setattr("neuroprior.priors.adaptive.PAIRS_AT_ONCE", 130)
    assert prior.log_prob(plans).allclose(whole, atol=1e-5)


def individuals(number, length, concentration, seed):
    """Chains of order 1, each with rows from a Dirichlet around common ones; 4 actions, unequal lengths."""
    rows = torch.tensor([[0.1, 0.6, 0.2, 0.1], [0.4, 0.1, 0.1, 0.4], [0.25, 0.25, 0.45, 0.05], [0.7, 0.1, 0.1, 0.1]])
    generator = seeded(seed)
    gammas = torch._standard_gamma(concentration * rows.expand(number, 4, 4), generator=generator)
    probs = gammas / gammas.sum(-1, keepdim=True)
    actions = torch.zeros(number, length, dtype=torch.long)
    for t in range(1, length):
        actions[:, t] = probs[torch.arange(number), actions[:, t - 1]].multinomial(1, generator=generator)[:, 0]
    lengths = torch.randint(length // 2, length + 1, (number,), generator=generator)
    return Plans(actions, 4, lengths, group=torch.arange(number)), rows


def exact(plans, rows, concentration):
    """Nats per action of the Bayesian predictor that knows the rows and the concentration; the first action is free."""
    total = 0.0
    for plan, length in zip(plans.actions.long().tolist(), plans.lengths.tolist(), strict=True):
        counts = torch.zeros(4, 4)
        for last, action in pairwise(plan[:length]):
            share = (counts[last, action] + concentration * rows[last, action]) / (counts[last].sum() + concentration)
            total -= log(float(share))
            counts[last, action] += 1
    return total / float((plans.lengths - 1).sum())


def test_it_predicts_individuals_as_well_as_bayes():
    """The concentration is learned within a factor of 1.5, and the loss is within .003 nats of the best possible."""
    (learned, rows), (new, _) = individuals(60, 400, 15.0, 0), individuals(40, 400, 15.0, 1)
    prior = AdaptivePrior(MarkovPrior(4, 1), [10.0, 10.0]).fit(learned)
    assert prior.concentrations[0] == inf
    assert 10 < prior.concentrations[1] < 22.5
    log_probs = prior.action_log_probs(new)[:, 1:]
    loss = -float(log_probs.sum()) / float((new.lengths - 1).sum())
    assert exact(new, rows, 15.0) - 1e-3 < loss < exact(new, rows, 15.0) + 0.003
    base = -float(prior.base.action_log_probs(new)[:, 1:].sum()) / float((new.lengths - 1).sum())
    assert base > loss + 0.03


def test_the_combined_prior_follows_individuals_where_plans_are_long():
    """Its expert that follows them is what it keeps; short plans say nothing of an individual."""
    (learned, rows), (new, _) = individuals(40, 400, 10.0, 6), individuals(20, 400, 10.0, 7)
    settings = {"effort": "fast", "max_steps": 5, "progress": False}
    prior = fit(learned, generator=seeded(0), **settings)
    assert any(isinstance(expert, AdaptivePrior) for expert in prior.experts)
    loss = -float(prior.action_log_probs(new)[:, 1:].sum()) / float((new.lengths - 1).sum())
    assert loss < exact(new, rows, 10.0) + 0.005
    short = fit(individuals(40, 90, 10.0, 6)[0], generator=seeded(0), **settings)
    assert not any(isinstance(expert, AdaptivePrior) for expert in (*short.experts, *short.spare))


def test_where_individuals_are_alike_it_is_its_base():
    probs = torch.tensor([[0.1, 0.7, 0.2], [0.5, 0.2, 0.3], [0.3, 0.3, 0.4]]).log()
    actions = torch.zeros(50, 200, dtype=torch.long)
    generator = seeded(3)
    for t in range(1, 200):
        actions[:, t] = probs[actions[:, t - 1]].softmax(-1).multinomial(1, generator=generator)[:, 0]
    for base in (MarkovPrior(3, 1), ContextTreePrior(3, 3)):
        prior = AdaptivePrior(base).fit(Plans(actions, 3, group=torch.arange(50) // 2))
        assert prior.concentrations == (inf, inf)
    alone = AdaptivePrior(MarkovPrior(3, 1)).fit(actions[:1])
    assert alone.concentrations == (inf, inf)


def test_concentrations_by_hand():
    """Of two levels the second saves nothing; the first is a Beta-binomial, whose likelihood a grid maximises."""
    counts = torch.tensor([[5.0, 0, 9, 3, 0, 6, 20, 8]]).double()
    totals, probs = torch.tensor([[6.0, 2, 12, 9, 1, 7, 30, 10]]).double(), torch.full((8,), 0.2).double()
    probs, counts, totals = probs.repeat(40), counts.repeat(1, 40), totals.repeat(1, 40)
    grid = torch.logspace(-2, 5, 20_001, dtype=torch.double)[:, None]
    best = float(grid[((counts + grid * probs) / (totals + grid)).log().sum(1).argmax()])
    found = likeliest_concentrations(
        probs, torch.cat([counts, torch.zeros_like(counts)]), torch.cat([totals, 0 * totals])
    )
    assert found[0] == pytest.approx(best, rel=1e-2)
    assert found[1] == inf


def test_a_network_learns_first_and_the_rest_on_held_out_plans():
    learned, _ = individuals(30, 60, 3.0, 4)
    network = AdaptivePrior(GRUPrior(4, 8, seed=1), [10.0, 10.0])
    network.fit(learned, generator=seeded(0), max_steps=30, progress=False, validation=0.3)
    assert min(network.concentrations) < inf
    assert network.base.has_learned
    with refuses("orders: not a setting of AdaptivePrior.fit"):
        network.fit(learned, orders=3)


def test_earlier_sequences_are_handed_on(tmp_path):
    """At level 0 as if they were one sequence; their counts add up, and are saved with the prior."""
    urn = AdaptivePrior(UniformPrior(3), [2.0])
    first, second = torch.tensor([[0, 1, 1, 0, 0]]), torch.tensor([[1, 0, 2]])
    together = urn.log_prob(torch.cat([first, second], 1)) - urn.log_prob(first)
    assert adapt(urn, first).log_prob(second).allclose(together)
    # What was handed on fades as the sequence goes on.
    fading = adapt(AdaptivePrior(UniformPrior(3), [2.0], 0.5), first)
    due = [(3 + 2 / 3) / 7, (3 / 2 + 1 + 2 / 3) / (5 / 2 + 1 + 2), (2 / 4 + 2 / 3) / (5 / 4 + 3 / 2 + 2)]
    assert fading.action_log_probs(torch.tensor([[0, 0, 1]])).exp()[0].tolist() == pytest.approx(due)
    # Nothing is known of what followed two actions before there are two.
    late = adapt(AdaptivePrior(UniformPrior(3), [inf, inf, 0.1]), torch.tensor([[0, 0, 2]]))
    probs = late.action_log_probs(torch.tensor([[2, 0, 0, 2]])).exp()[0].tolist()
    assert probs == pytest.approx([1 / 3, 1 / 3, 1 / 3, (1 + 0.1 / 3) / 1.1])
    # Histories of two actions, in plans of unequal lengths; padding says nothing.
    prior = AdaptivePrior(MarkovPrior(3, 1).fit(SKEWED), [inf, 2.0, 0.5], 0.5)
    some = Plans(torch.tensor([[0, 1, 2, 1], [1, 2, 2, 2], [0, 0, 0, 0]]), 3, torch.tensor([4, 3, 1]))
    adapted = adapt(adapt(prior, some[:1]), some[1:])
    assert adapted.earlier_1.tolist() == [[0, 1, 0], [0, 0, 2], [0, 1, 1]]
    assert adapted.earlier_2[1 * 3 + 2].tolist() == [0, 1, 1]
    assert adapted.earlier_2.sum() == 3
    check_prior(adapted)
    for name in ("earlier_0", "earlier_1", "earlier_2"):
        assert getattr(adapted, name).equal(getattr(adapt(prior, some), name))
        assert len(getattr(prior, name)) == 0
    again = load(save(adapted, tmp_path))
    new = torch.tensor([[1, 2, 1, 2, 0]])
    assert again.log_prob(new).equal(adapted.log_prob(new))
    assert not adapted.log_prob(new).allclose(prior.log_prob(new))


def test_experts_of_an_ensemble_begin_with_what_was_counted():
    """Each follows the individual, and the mixture with them; what counts nothing stays as it was."""
    chain, urn = MarkovPrior(3, 1).fit(SKEWED), AdaptivePrior(UniformPrior(3), [2.0])
    mixture = MixturePrior(3, [chain, urn])
    some, new = Plans(torch.tensor([[0, 2, 2, 1], [2, 0, 1, 1]]), 3, torch.tensor([4, 1])), torch.tensor([[2, 2, 1]])
    due = MixturePrior(3, [chain, adapt(urn, some)])
    assert adapt(mixture, some).log_prob(new).allclose(due.log_prob(new))
    assert not due.log_prob(new).allclose(mixture.log_prob(new))
    with refuses("`prior` must learn along a sequence", "MarkovPrior does not"):
        adapt(chain, some)
    with refuses("`prior` must be a fitted prior, got NoneType."):
        adapt(None, some)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (([],), ("`concentrations` must have at least one number",)),
        (([1.0, 0.0],), ("`concentrations[1]` must be above 0, got 0.0",)),
        (([1.0], 1.5), ("`decay` must be between 0 and 1, got 1.5",)),
    ],
)
def test_wrong_arguments_are_refused(arguments, words):
    with refuses(*words):
        AdaptivePrior(UniformPrior(3), *arguments)
    with refuses("`plans` must have 3 actions", "got 4"):
        adapt(AdaptivePrior(UniformPrior(3)), Plans(torch.zeros(1, 2, dtype=torch.long), 4))


@pytest.mark.parametrize("decay", [1.0, 0.7])
def test_counts_of_an_individual_go_on_from_plan_to_plan(decay):
    """As if each plan were scored by a prior adapted to those before it, where nothing fades; groups are mixed up."""
    actions = torch.randint(3, (7, 9), generator=seeded(8))
    plans = Plans(actions, 3, torch.tensor([9, 4, 0, 7, 1, 8, 5]), group=torch.tensor([2, 0, 2, 2, 5, 0, 2]))
    prior = AdaptivePrior(MarkovPrior(3, 2).fit(SKEWED), [4.0, 2.0, 0.5], decay)
    found = prior.individual_log_probs(plans)
    assert found[~plans.mask()].abs().max() == 0
    alone = plans.group == 5
    assert found[alone].allclose(prior.action_log_probs(plans[alone]))
    if decay < 1:
        first = torch.tensor([0, 1])
        assert found[first].allclose(prior.action_log_probs(plans[first]), atol=1e-6)
        return
    for number in range(7):
        earlier = [
            other for other in range(number) if plans.group[other] == plans.group[number] and plans.lengths[other]
        ]
        now = adapt(prior, plans[torch.tensor(earlier)]) if earlier else prior
        assert found[number].allclose(now.action_log_probs(plans[number : number + 1])[0], atol=1e-5)
