"""Individuals: distances in closed form, places that keep them, and types that are there or are not."""

import numpy as np
import pytest
import torch
from scipy.spatial.distance import pdist, squareform

from neuroprior.behaviour import RecordedPlans, individual_types, individuals
from neuroprior.behaviour.analysis.individuals import _distance, _scale
from tests.support.chains import markov_plans, markov_probs
from tests.support.sources import refuses, seeded


def animals(kinds: list[int], sessions: int = 3, length: int = 60, strength: float = 3.0) -> RecordedPlans:
    """Animals of several kinds, each a chain of its own; the number of sessions differs."""
    probs = [markov_probs(4, 1, seed, strength) for seed in range(max(kinds) + 1)]
    parts = [markov_plans(probs[kind], sessions + k % 3, length, 100 + k) for k, kind in enumerate(kinds)]
    group = torch.cat([torch.full((len(part),), k) for k, part in enumerate(parts)])
    names = [f"m{k:02}" for k in range(len(kinds))]
    return RecordedPlans(torch.cat([part.actions for part in parts]), 4, group=group, group_names=names)


def test_the_distance_is_that_of_jensen_and_shannon():
    """Of two coins of .5 and 1: H(.75) - H(.5) / 2 bits after the action with all the weight."""
    some, others = np.array([[0.5, 0.5], [0.3, 0.7]]), np.array([[1 - 1e-15, 1e-15], [0.3, 0.7]])
    entropy = -0.75 * np.log2(0.75) - 0.25 * np.log2(0.25)
    assert _distance(some, others, np.array([0.4, 0.6])) == pytest.approx(np.sqrt(0.4 * (entropy - 0.5)), abs=1e-6)
    assert _distance(some, some, np.array([0.4, 0.6])) == 0


def test_places_keep_the_distances_of_points_in_a_plane():
    points = np.random.default_rng(0).normal(size=(7, 2))
    distances = squareform(pdist(points))
    assert squareform(pdist(_scale(distances))) == pytest.approx(distances)


def test_the_odd_one_out_is_farthest_and_beyond_chance():
    found = individuals(animals([0, 0, 0, 1, 0, 0, 0, 0]), seeded(0))
    frame = found.frame()
    assert found.from_others[:, 0].argmax() == 3
    assert frame.low[3] > frame.by_chance[3]
    assert frame.distance[3] > 1.5 * frame.drop(3).distance.max()
    assert found.distances == pytest.approx(found.distances.T)
    assert np.diag(found.distances) == pytest.approx(0)
    assert found.distances[3].sum() == found.distances.sum(1).max()
    assert "m03" in repr(found)
    gaps = [float(one.rsplit(" ", 2)[1]) for one in frame.differs_in[3].split(", ")]
    assert [abs(gap) for gap in gaps] == sorted(map(abs, gaps), reverse=True)


def test_of_individuals_that_are_alike_one_in_twenty_is_beyond_chance():
    """40 studies of 8: of 320 at most 29 (binomial, a false alarm in 1,000 tests)."""
    beyond = 0
    for study in range(40):
        plans = markov_plans(markov_probs(4, 1, study, 1.5), 24, 50, study, group=torch.arange(24) % 8)
        found = individuals(RecordedPlans.of(plans), seeded(study))
        beyond += int((found.from_others[:, 0] > found.by_chance).sum())
    assert 3 <= beyond <= 29


@pytest.mark.parametrize(("kinds", "number"), [([0] * 9, 1), ([0, 0, 0, 0, 1, 1, 1, 1, 1, 1], 2), ([0, 1, 2] * 5, 3)])
def test_types_are_found_where_they_are(kinds, number):
    found = individual_types(animals(kinds), seeded(1))
    assert found.number == number
    assert found.frame()["chosen"].tolist().index(True) + 1 == number
    own = found.shares.argmax(1)
    assert all(len({int(own[k]) for k, kind in enumerate(kinds) if kind == one}) == 1 for one in set(kinds))
    assert found.sentence.startswith("One type" if number == 1 else f"{number} types")


def test_too_few_individuals_are_refused():
    with refuses("`plans` must have at least two groups"):
        individuals(animals([0]))
    with refuses("`plans` must have at least 6 individuals"):
        individual_types(animals([0, 0, 1]))
