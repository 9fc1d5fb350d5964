"""Back-off: discounts and formulas on paper, and how the rules compare on plans held out."""

import pytest
import torch

from neuroprior import MarkovPrior, Plans
from neuroprior.priors.counts import BACKOFFS_TRIED, Chains
from neuroprior.priors.counts.markov import kneser_ney_discounts


def doubles(*values):
    return torch.tensor(values, dtype=torch.double)


def test_discounts_by_hand():
    """Five counts of 1, three of 2, two of 3, one of 4: Y = 5 / 11."""
    counts = torch.tensor([1] * 5 + [2] * 3 + [3] * 2 + [4, 9])
    y = 5 / 11
    want = [1 - 2 * y * 3 / 5, 2 - 3 * y * 2 / 3, 3 - 4 * y * 1 / 2]
    torch.testing.assert_close(kneser_ney_discounts(counts), doubles(*want))


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
