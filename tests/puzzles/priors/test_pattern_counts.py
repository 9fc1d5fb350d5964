"""Counts of patterns: naive Bayes and back-off, computed by hand."""

import math
from pathlib import Path

import pytest
import torch

from neuroprior import Plans
from neuroprior.priors import load, save
from neuroprior.puzzles import PatternCounts, Steps

CONTEXT = torch.tensor([[[1, 5], [2, 5]], [[1, 6], [1, 5]], [[2, 6], [1, 6]]], dtype=torch.int32)
PLANS = Plans(torch.tensor([[0, 1], [0, 0], [1, 1]]), 2, context=CONTEXT)


def smoothed(taken: int, seen: int) -> torch.Tensor:
    """p(a | pattern) of both actions, of which the first was taken `taken` times out of `seen`; both are as common."""
    share = (taken + 2 * 0.5) / (seen + 2)
    return torch.tensor([share, 1 - share])


def test_the_product_is_naive_bayes() -> None:
    # Of six steps none is held out, so the power is 1. Pattern 1 is there at actions 0, 0, 0 and 1, pattern 5 at 0, 1
    # and 0; plans begin with 0, 0 and 1, and after action 0 come 1 and 0.
    prior = PatternCounts(2, 2, smoothing=2.0).fit(PLANS)
    begin, after = smoothed(2, 3) / 0.5, smoothed(1, 2) / 0.5
    both = smoothed(3, 4) * smoothed(2, 3) / 0.5**2
    logits, state = prior.start(1, torch.tensor([[1, 5]]))
    want = 0.5 * both * begin
    assert torch.allclose(logits.softmax(-1)[0], want / want.sum(), atol=1e-6)
    logits, _ = prior.step(torch.tensor([0]), state, torch.tensor([[9, 8]]))
    assert torch.allclose(logits.softmax(-1)[0], 0.5 * after / (0.5 * after).sum(), atol=1e-6)
    assert prior.patterns.tolist() == [1, 2, 5, 6]
    assert not prior.weights[-1].any()


def test_back_off_goes_from_the_commonest_pattern_to_the_rarest() -> None:
    prior = PatternCounts(2, 2, combine="backoff", smoothing=2.0).fit(PLANS)
    # Pattern 1 was there 4 times (action 0 in 3), pattern 5 in 3 (action 0 in 2): first 1, then 5.
    first = 4 / 6 * 3 / 4 + 2 / 6 * 0.5
    want = 3 / 5 * 2 / 3 + 2 / 5 * first
    for patterns in ([1, 5], [5, 1]):
        assert float(prior.start(1, torch.tensor([patterns]))[0].softmax(-1)[0, 0]) == pytest.approx(want, abs=1e-6)
    assert float(prior.start(1, torch.tensor([[1, 7]]))[0].softmax(-1)[0, 0]) == pytest.approx(first, abs=1e-6)


def test_without_known_patterns_actions_are_as_common_as_they_were() -> None:
    # Actions 0, 1, 0, 0, 1, 1, 0, 0, 0: with a third of an action each, 6 + 1/3, 3 + 1/3 and 1/3 of 10.
    plans = Plans(torch.tensor([[0, 1, 0], [0, 1, 1], [0, 0, 0]]), 3, context=torch.arange(9).view(3, 3, 1))
    marginal = torch.tensor([19.0, 10.0, 1.0]) / 30
    backoff = PatternCounts(3, 1, combine="backoff").fit(plans)
    assert plans.context is not None
    for probs in backoff(plans.actions, plans.context).softmax(-1).flatten(0, 1):
        assert torch.allclose(probs, marginal, atol=1e-6)
    # Nine steps hold nothing out. First came 0 three times; after 0 came 1, 0, 1, 0; after 1 came 0 and 1.
    product = PatternCounts(3, 1).fit(plans)
    counts = torch.tensor([[2.0, 2.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    logits, state = product.start(1, torch.tensor([[99]]))
    for last, due in ((3, logits), (0, None), (1, None), (2, None)):
        got = product.step(torch.tensor([last]), state)[0] if due is None else due
        want = (counts[last] + marginal) / (counts[last].sum() + 1)
        assert torch.allclose(got.softmax(-1)[0], want, atol=1e-6)


def copied_plans() -> Plans:
    """The action is the first pattern in 3 of 4 steps; the other nine repeat it, so that naive Bayes is too sure."""
    generator = torch.Generator().manual_seed(0)
    pattern = torch.randint(2, (1000, 10, 1), generator=generator, dtype=torch.int32)
    flipped = torch.rand(1000, 10, generator=generator) < 0.25
    context = pattern + 2 * torch.arange(10, dtype=torch.int32)
    return Plans(pattern[..., 0].long() ^ flipped.long(), 2, context=context)


def test_the_power_undoes_repeated_evidence() -> None:
    plans = copied_plans()
    prior = PatternCounts(2, 10).fit(plans)
    # Ten copies of one pattern are to count as one: the log-odds of all together are about log 3 either way.
    logits = prior.start(2, 2 * torch.arange(10) + torch.tensor([[0], [1]]))[0]
    odds = logits[:, 0] - logits[:, 1]
    # 1,000 held-out steps choose the power: four standard errors of the log-odds are 0.3.
    assert float(odds[0] - odds[1]) / 2 == pytest.approx(1.1, abs=0.3)


@pytest.mark.parametrize("combine", ["product", "backoff"])
def test_saved_and_loaded(combine: str, tmp_path: Path) -> None:
    plans = copied_plans()
    prior = PatternCounts(2, 10, combine=combine).fit(plans)  # type: ignore[arg-type]
    copy = load(save(prior, tmp_path))
    assert copy.config == prior.config
    assert copy.log_prob(plans).equal(prior.log_prob(plans))


def test_bad_input_is_refused() -> None:
    for settings in ({"combine": "sum"}, {"smoothing": 0.0}, {"smoothing": math.inf}, {"min_count": 0}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            PatternCounts(2, 2, **settings)
    with pytest.raises(ValueError, match="epochs"):
        PatternCounts(2, 2).fit(PLANS, epochs=3)
    with pytest.raises(ValueError, match="no actions"):
        PatternCounts(2, 2).fit_steps(Steps.of(PLANS[:0]))
