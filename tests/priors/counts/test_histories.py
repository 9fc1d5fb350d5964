"""Counts of histories: read in one part or in many, by n-grams or not; and their limits."""

import pytest
import torch

from neuroprior import ContextTreePrior, MarkovPrior, Plans
from neuroprior.priors.counts import histories
from neuroprior.priors.counts.histories import count_histories
from tests.support.sources import refuses, seeded


@pytest.mark.parametrize(
    "make", [lambda: MarkovPrior(3, 4, num_contexts=2), lambda: ContextTreePrior(3, 6, num_contexts=2)]
)
def test_read_in_parts(make, monkeypatch):
    """Parts of any size give the same prior, but for the numbering of its histories."""
    generator = seeded(0)
    lengths = torch.randint(10, (300,), generator=generator)
    plans = Plans(torch.randint(3, (300, 9), generator=generator), 3, lengths, context=torch.arange(300) % 2)
    test, current = torch.randint(3, (50, 12), generator=generator), torch.randint(2, (50, 12), generator=generator)
    want, prior = make().fit(plans)(test, current), make()
    depth = getattr(prior, "depth", 4)
    monkeypatch.setattr(histories, "ACTIONS_AT_ONCE", 50)
    prior.learn(*count_histories(plans, depth, 2, True, prior.device))
    torch.testing.assert_close(prior(test, current), want)


@pytest.mark.parametrize("prior", [MarkovPrior(300, 3), ContextTreePrior(300, 3)])
def test_tables_over_the_limit_are_refused(prior):
    prior.max_table_bytes = 10**6
    plans = torch.randint(300, (50, 20), generator=seeded(0))
    with refuses("fewer than 3 actions"):
        prior.fit(plans)
    with refuses("x 300 actions"):
        prior.fit(plans)


def test_rows_of_contexts_over_the_limit_are_refused(monkeypatch):
    plans = Plans(torch.zeros(1_000, 2).long(), 10, context=torch.arange(1_000))
    monkeypatch.setattr(MarkovPrior, "max_table_bytes", 10**5)
    MarkovPrior(10, 1).fit(plans)
    with refuses("histories"):
        MarkovPrior(10, 1, num_contexts=1_000).fit(plans)


@pytest.mark.parametrize("initial", ["joint", "lower"])
@pytest.mark.parametrize(
    ("num_actions", "depth", "length"), [(1, 1, 3), (2, 1, 2), (2, 3, 4), (3, 2, 9), (4, 2, 30), (5, 1, 3)]
)
def test_counted_by_ngrams_or_not_the_prior_is_the_same(num_actions, depth, length, initial, monkeypatch):
    actions = torch.randint(num_actions, (2000, length), generator=seeded(0)).square() % num_actions
    plans = Plans(actions.to(torch.uint8), num_actions)
    test = torch.randint(num_actions, (50, length + 3), generator=seeded(1))
    want = MarkovPrior(num_actions, depth, initial=initial).fit(plans)(test)
    monkeypatch.setattr(histories, "MOST_NGRAMS", 0)
    prior = MarkovPrior(num_actions, depth, initial=initial)
    prior.learn(*count_histories(plans, depth, None, prior.openings, prior.device))
    torch.testing.assert_close(prior(test), want)
    assert torch.equal(plans.actions, actions.to(torch.uint8))
