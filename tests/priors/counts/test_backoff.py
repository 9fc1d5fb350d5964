"""Back-off: discounts and formulas on paper, and how the rules compare on plans held out."""

import pytest
import torch

from neuroprior import MarkovPrior, Plans
from neuroprior.priors.counts import BACKOFFS_TRIED, Chains
from neuroprior.priors.counts.markov import BACKOFFS, FALLBACK_DISCOUNTS, blend, kneser_ney_discounts
from tests.support.sources import distribution, seeded


def doubles(*values):
    return torch.tensor(values, dtype=torch.double)


def test_discounts_by_hand():
    """Five counts of 1, three of 2, two of 3, one of 4: Y = 5 / 11."""
    counts = torch.tensor([1] * 5 + [2] * 3 + [3] * 2 + [4, 9])
    y = 5 / 11
    want = [1 - 2 * y * 3 / 5, 2 - 3 * y * 2 / 3, 3 - 4 * y * 1 / 2]
    torch.testing.assert_close(kneser_ney_discounts(counts), doubles(*want))


@pytest.mark.parametrize(
    "counts",
    [
        [],
        [1, 1, 2, 5],  # no 3
        [2, 3, 4],  # no 1
        [1, 2] + [3] * 50,  # the second would be negative
        [1, 2, 3, 3],  # the second would be 0, and an action might be impossible
    ],
)
def test_discounts_fall_back(counts):
    found = kneser_ney_discounts(torch.tensor(counts, dtype=torch.long))
    torch.testing.assert_close(found, doubles(*FALLBACK_DISCOUNTS))


def test_blends_by_hand():
    n, lower = doubles(4, 2, 1, 0), doubles(0.1, 0.2, 0.3, 0.4)
    none = torch.zeros(3)
    torch.testing.assert_close(blend(n, lower, "dirichlet", 2.0, none), (n + 2 * lower) / 9)
    torch.testing.assert_close(blend(n, lower, "witten-bell", 1.0, none), (n + 3 * lower) / 10)
    torch.testing.assert_close(blend(n, lower, "witten-bell", 2.0, none), (n + 6 * lower) / 13)
    got = blend(n, lower, "kneser-ney", 1.0, doubles(0.5, 1, 1.5))
    torch.testing.assert_close(got, (doubles(2.5, 1, 0.5, 0) + 3 * lower) / 7)
    # A discount never takes more than there is.
    got = blend(n, lower, "kneser-ney", 2.5, doubles(0.5, 1, 1.5))
    torch.testing.assert_close(got, (doubles(0.25, 0, 0, 0) + 6.75 * lower) / 7)


@pytest.mark.parametrize("rule", BACKOFFS)
def test_without_counts_the_shorter_history_remains(rule):
    lower = doubles(0.1, 0.9)
    torch.testing.assert_close(blend(torch.zeros(2).double(), lower, rule, 1.0, doubles(0.5, 1, 1.5)), lower)


def test_kneser_ney_by_hand():
    """Order 1, plans 0 0 1 and 0 1, the discounts of the fall-back (no count is 3)."""
    plans = Plans(torch.tensor([[0, 0, 1], [0, 1, 0]]), 2, torch.tensor([3, 2]))
    # Action 0 came after 0 and at a beginning, 1 after 0 alone: counts 2 and 1, discounts 1 and 1/2.
    empty = [(1 + 1.5 / 2) / 3, (0.5 + 1.5 / 2) / 3]
    # After 0: once 0, twice 1.
    after_0 = [(0.5 + 1.5 * empty[0]) / 3, (1 + 1.5 * empty[1]) / 3]
    # At the beginning: twice 0.
    opening = [(1 + 1 * empty[0]) / 2, (0 + 1 * empty[1]) / 2]
    for initial, first in (("joint", opening), ("lower", empty)):
        prior = MarkovPrior(2, 1, initial=initial, backoff="kneser-ney").fit(plans)
        got = prior(torch.tensor([[0, 1, 0]])).softmax(-1)[0]
        torch.testing.assert_close(got, torch.tensor([first, after_0, empty]))


@pytest.mark.parametrize("rule", BACKOFFS)
@pytest.mark.parametrize("contexts", [None, 2])
def test_probabilities_of_all_plans_sum_to_one(rule, contexts):
    actions = (torch.rand(200, 5, generator=seeded(0)) ** 3 * 3).long()
    current = None if contexts is None else torch.arange(200) % 2
    prior = MarkovPrior(3, 3, num_contexts=contexts, backoff=rule).fit(Plans(actions, 3, context=current))
    for length in (1, 3, 5):
        probs = distribution(prior, length, None if contexts is None else torch.tensor(1))
        assert float(probs.sum()) == pytest.approx(1, abs=1e-5)
        assert (probs > 0).all()


def test_on_plans_held_out():
    """An order far higher than the plans can fill: Kneser-Ney predicts better than Witten-Bell, and it than Dirichlet.

    4,000 plans of 12 actions are held out, and the gaps are many times what chance could give on them.
    """
    chain = torch.rand(4, 4, generator=seeded(0)) ** 2
    actions = torch.randint(4, (4_200, 1), generator=seeded(1))
    for _ in range(11):
        after = torch.multinomial(chain[actions[:, -1]], 1, generator=seeded(int(actions.sum())))
        actions = torch.cat([actions, after], 1)
    nats = {}
    for rule in BACKOFFS:
        prior = MarkovPrior(4, 5, backoff=rule).fit(actions[:200])
        nats[rule] = -float(prior.log_prob(actions[200:]).mean()) / 12
    assert nats["kneser-ney"] < nats["witten-bell"] - 0.02 < nats["dirichlet"] - 0.04


def test_saved_with_the_rule():
    assert MarkovPrior(2, backoff="witten-bell").config["backoff"] == "witten-bell"
    assert MarkovPrior(2).config["backoff"] == "kneser-ney"


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("num_contexts", [None, 3])
@pytest.mark.parametrize("order", [0, 1, 3])
def test_chains_of_an_order_are_those_fitted_one_by_one(order, num_contexts, ends):
    generator = torch.Generator().manual_seed(order)
    actions = torch.randint(4, (30, 8), generator=generator)
    context = torch.randint(3, actions.shape, generator=generator)
    lengths = torch.randint(1, 9, (30,), generator=generator)
    plans = Plans(actions, 4, lengths=lengths, context=context)
    plans = plans.with_end() if ends else plans
    learned, held_out = plans[:20], plans[20:]
    family, given = Chains(learned, order, num_contexts), held_out if num_contexts else held_out.without_context()
    found = family.log_likelihood(held_out)
    for number, (backoff, smoothing) in enumerate(BACKOFFS_TRIED):
        prior = MarkovPrior(plans.num_actions, order, smoothing, num_contexts=num_contexts, backoff=backoff)
        prior.fit(learned if num_contexts else learned.without_context())
        assert float(found[number]) == pytest.approx(float(prior.log_prob(given).sum()), rel=1e-5)
        chain = family.chain(number)
        assert chain.config == prior.config
        assert chain.log_prob(given).equal(prior.log_prob(given))
    with pytest.raises(ValueError, match="actions"):
        family.log_likelihood(Plans(torch.zeros(1, 2, dtype=torch.long), 2, context=torch.zeros(1, dtype=torch.long)))
