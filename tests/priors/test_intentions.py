"""The posterior over intentions by hand and over all paths of intentions."""

from itertools import product

import pytest
import torch

from neuroprior.plans import Plans
from neuroprior.priors import MarkovPrior, UniformPrior, infer
from tests.support.sources import refuses


def chain(*rows):
    """A Markov prior that has learned from these plans."""
    return MarkovPrior(2).fit(torch.tensor(rows))


PRIORS = {"left": chain([0, 0, 0, 1], [0, 0, 0, 0]), "any": UniformPrior(2), "right": chain([1, 1, 0, 1], [1, 1, 1, 1])}
ACTIONS = torch.tensor([[0, 1, 1, 0], [1, 1, 0, 0]])


def likelihoods(actions):
    """p_k(a_t | past) [B, L, K], a step at a time."""
    columns = []
    for prior in PRIORS.values():
        logits, state = prior.start(len(actions))
        steps = []
        for t in range(actions.shape[1]):
            steps.append(logits.double().softmax(-1).gather(1, actions[:, t : t + 1])[:, 0])
            logits, state = prior.step(actions[:, t], state)
        columns.append(torch.stack(steps, 1))
    return torch.stack(columns, -1)


@pytest.mark.parametrize("switch", [0.0, 0.4])
def test_weights_of_each_plan_in_any_unit(switch):
    """Each row for itself: as the posterior of its plan alone, from probabilities."""
    rows = [[5.0, 2.0, 3.0], [0.1, 0.3, 0.6]]
    found = infer(PRIORS, ACTIONS, weights=torch.tensor(rows), switch=switch).log_probs
    for number, row in enumerate(rows):
        alone = infer(PRIORS, ACTIONS[number][None], weights=[w / sum(row) for w in row], switch=switch).log_probs
        torch.testing.assert_close(found[number], alone[0])
    assert found.exp().sum(-1).allclose(torch.ones(2, 5).double())


@pytest.mark.parametrize("switch", [0.0, 0.3, 1.0])
def test_all_paths_of_intentions(switch):
    """The filter is the sum over all K^t paths."""
    weights = torch.tensor([0.5, 0.2, 0.3]).double()
    found = infer(PRIORS, ACTIONS, weights=weights, switch=switch).log_probs.exp()
    likelihood = likelihoods(ACTIONS)
    torch.testing.assert_close(found[:, 0], weights.expand(2, 3))
    for t in range(1, 5):
        expected = torch.zeros(2, 3).double()
        for path in product(range(3), repeat=t):
            weight = weights[path[0]] * likelihood[:, 0, path[0]]
            for s in range(1, t):
                move = (1 - switch) * (path[s] == path[s - 1]) + switch * weights[path[s]]
                weight = weight * move * likelihood[:, s, path[s]]
            expected[:, path[-1]] += weight
        torch.testing.assert_close(found[:, t], expected / expected.sum(-1, keepdim=True), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("power", [0.0, 0.5, 2.0])
def test_tempered_likelihoods(power):
    found = infer(PRIORS, ACTIONS, weights=[0.5, 0.2, 0.3], power=power).log_probs.exp()
    joint = torch.tensor([0.5, 0.2, 0.3]).double() * likelihoods(ACTIONS).prod(1) ** power
    torch.testing.assert_close(found[:, -1], joint / joint.sum(-1, keepdim=True), atol=1e-6, rtol=1e-5)


def test_padding_says_nothing():
    """Beyond its length a plan keeps its posterior; the frame ends there."""
    plans = Plans(ACTIONS, 2, lengths=torch.tensor([2, 4]), group=torch.tensor([0, 1]))
    found = infer(PRIORS, plans, switch=0.1)
    alone = infer(PRIORS, ACTIONS[:1, :2], switch=0.1).log_probs
    torch.testing.assert_close(found.log_probs[:1, :3], alone)
    torch.testing.assert_close(found.log_probs[0, 3:], alone[0, 2].expand(2, 3))
    frame = found.to_frame()
    assert list(frame) == ["plan", "group", "step", "intention", "probability"]
    assert len(frame) == 3 * (3 + 5)
    assert frame.groupby(["plan", "step"]).probability.sum().to_list() == pytest.approx([1] * 8)


def test_each_prior_takes_its_own_context():
    """A prior with context beside one without: the context decides."""
    rows, cells = torch.tensor([[0, 1, 0, 1]]), torch.tensor([[0, 1, 0, 1]])
    priors = {
        "cells": MarkovPrior(2, order=0, num_contexts=2).fit(Plans(rows, 2, context=cells)),
        "any": UniformPrior(2),
    }
    fits = infer(priors, rows, context=cells).log_probs[0, -1].exp()
    differs = infer(priors, rows, context=1 - cells).log_probs[0, -1].exp()
    assert fits[0] > 0.5 > differs[0]


@pytest.mark.parametrize(
    ("priors", "actions", "how", "words"),
    [
        (PRIORS, ACTIONS, {"switch": 1.5}, "switch"),
        (PRIORS, ACTIONS, {"power": -1.0}, "power"),
        (PRIORS, ACTIONS, {"weights": [1.0, 2.0]}, "`weights` must have shape"),
        (PRIORS, ACTIONS, {"weights": [1.0, -2.0, 3.0]}, "`weights` must be finite"),
        (PRIORS, ACTIONS, {"weights": [0.0, 0.0, 0.0]}, "weights"),
        ([UniformPrior(2), UniformPrior(3)], ACTIONS, {}, "same number"),
        ([], ACTIONS, {}, "at least one"),
        (PRIORS, Plans(ACTIONS, 2), {"context": ACTIONS}, "their own"),
    ],
)
def test_refusals(priors, actions, how, words):
    with refuses(words):
        infer(priors, actions, **how)


def test_an_intention_without_weight_never_gets_any():
    sure = infer(PRIORS, ACTIONS, weights=[0.0, 1.0, 0.0], switch=0.5).log_probs.exp()
    assert torch.equal(sure, torch.tensor([0.0, 1.0, 0.0]).double().expand_as(sure))
