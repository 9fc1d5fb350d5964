"""Replay: what is remembered is forgotten with the probability that it should."""

import torch
from scipy import stats

from neuroprior.agents.replay import Replay
from neuroprior.plans import Plans
from tests.support.sources import FALSE_ALARM, refuses, seeded


def numbered(first, number, context=False):
    """Plans that differ."""
    which = torch.arange(first, first + number)
    return Plans(which[:, None].repeat(1, 2), 100_000, context=which if context else None)


def test_older_plans_are_fewer():
    """Survivors of 10,000 plans at each age, each a binomial draw of probability keep ** age."""
    replay, generator = Replay(0.8), seeded(0)
    for turn in range(6):
        replay.forget(generator)
        replay.add(numbered(10_000 * turn, 10_000))
    kept = (replay.plans.actions[:, 0] // 10_000).bincount(minlength=6)
    for turn, number in enumerate(kept.tolist()):
        p = stats.binomtest(number, 10_000, 0.8 ** (5 - turn)).pvalue if turn < 5 else float(number == 10_000)
        assert p > FALSE_ALARM / 6


def test_nothing_is_forgotten_where_all_is_kept():
    replay = Replay(1.0)
    assert len(replay) == 0
    replay.forget(seeded(0))
    for turn in range(3):
        replay.add(numbered(4 * turn, 4, context=True))
        replay.forget(seeded(0))
    assert replay.plans.actions[:, 0].tolist() == replay.plans.context[:, 0].tolist() == list(range(12))
    assert set(replay.tensors()) == {"actions", "context"}


def test_what_does_not_fit_is_refused():
    replay = Replay(1.0)
    replay.add(numbered(0, 3, context=True))
    for wrong in (
        numbered(0, 3),
        Plans(torch.zeros(1, 3, dtype=torch.long), 100_000),
        Plans(torch.zeros(1, 2, dtype=torch.long), 5),
    ):
        with refuses("plans"):
            replay.add(wrong)
    assert len(replay) == 3


def test_lengths_are_kept():
    replay = Replay(1.0)
    replay.add(numbered(0, 2))
    replay.add(Plans(torch.zeros(1, 2, dtype=torch.long), 100_000, torch.tensor([1])))
    assert replay.plans.lengths.tolist() == [2, 2, 1]
