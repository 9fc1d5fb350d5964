"""Names of sampled actions."""

import torch

from neuroprior import MarkovPrior, Plans, UniformPrior
from neuroprior.priors import decode
from tests.support.sources import refuses, seeded

WORDS = Plans(torch.tensor([[0, 1, 2], [2, 2, 0]]), 3, torch.tensor([3, 2]), ("rest", "walk", "eat"))


def test_names_of_plans():
    assert decode(WORDS) == [["rest", "walk", "eat"], ["eat", "eat"]]
    assert decode(WORDS.with_end()) == decode(WORDS)
    assert decode(Plans(WORDS.actions, 3)) == [["0", "1", "2"], ["2", "2", "0"]]
    assert decode(WORDS[:0]) == []


def test_names_of_samples_end_before_the_end_symbol():
    prior = MarkovPrior(4, 1).fit(WORDS.with_end())
    assert decode(torch.tensor([[0, 3, 3, 3], [3, 3, 3, 3], [1, 2, 0, 1]]), prior) == [
        ["rest"],
        [],
        ["walk", "eat", "rest", "walk"],
    ]
    samples = prior.sample(50, 6, generator=seeded(0))
    assert [len(plan) for plan in decode(samples, prior)] == (samples != 3).sum(1).tolist()
    assert decode(UniformPrior(2).sample(3, 2, generator=seeded(0)), UniformPrior(2))[0][0] in "01"


def test_what_cannot_be_named():
    prior = UniformPrior(2)
    with refuses("decode", "the prior"):
        decode(torch.tensor([[0, 1]]))
    with refuses("decode"):
        decode(WORDS, prior)
    with refuses("actions", "2 actions"):
        decode(torch.tensor([[0, 2]]), prior)
