"""Counts of patterns: naive Bayes and back-off, computed by hand."""

from pathlib import Path

import pytest
import torch

from neuroprior import Plans
from neuroprior.priors import PatternCounts, load, save

CONTEXT = torch.tensor([[[1, 5], [2, 5]], [[1, 6], [1, 5]], [[2, 6], [1, 6]]], dtype=torch.int32)
PLANS = Plans(torch.tensor([[0, 1], [0, 0], [1, 1]]), 2, context=CONTEXT)
MARGINAL = (3 + 1) / (6 + 2)  # of action 0, and of action 1: with smoothing 2


def smoothed(taken: int, seen: int) -> torch.Tensor:
    """p(a | pattern) of both actions, of which the first was taken `taken` times out of `seen`."""
    share = (taken + 2 * MARGINAL) / (seen + 2)
    return torch.tensor([share, 1 - share])


def test_the_product_is_naive_bayes() -> None:
    prior = PatternCounts(2, 2, order=0, smoothing=2.0, power=0.5).fit(PLANS)
    # Pattern 1 is there at actions 0, 0, 0 and 1, pattern 5 at 0, 1 and 0.
    want = (smoothed(3, 4) * smoothed(2, 3) / MARGINAL).sqrt()
    logits = prior.start(1, torch.tensor([[1, 5]]))[0]
    assert torch.allclose(logits.softmax(-1)[0], want / want.sum(), atol=1e-6)
    assert torch.allclose(prior.start(1, torch.tensor([[9, 8]]))[0].softmax(-1), torch.tensor([[0.5, 0.5]]))
    assert prior.patterns.tolist() == [1, 2, 5, 6]
    assert not prior.weights[-1].any()


def test_the_last_action_is_one_more_expert() -> None:
    prior = PatternCounts(2, 2, order=1, smoothing=2.0, power=1.0).fit(PLANS)
    want = smoothed(1, 2)  # after action 0: 1 and 0
    _, state = prior.start(1, torch.tensor([[9, 8]]))
    assert torch.allclose(prior.step(torch.tensor([0]), state)[0].softmax(-1)[0], want / want.sum(), atol=1e-6)
    none = smoothed(2, 3)  # at the beginning: 0, 0 and 1
    assert torch.allclose(prior.start(1, torch.tensor([[9, 8]]))[0].softmax(-1)[0], none, atol=1e-6)


def test_back_off_goes_from_the_commonest_pattern_to_the_rarest() -> None:
    prior = PatternCounts(2, 2, combine="backoff", order=0, smoothing=2.0, power=1.0).fit(PLANS)
    # Pattern 1 was seen 4 times (action 0 in 3), pattern 5 in 3 (action 0 in 2): first 1, then 5.
    first = 4 / 6 * 3 / 4 + 2 / 6 * MARGINAL
    want = 3 / 5 * 2 / 3 + 2 / 5 * first
    for patterns in ([1, 5], [5, 1]):
        got = prior.start(1, torch.tensor([patterns]))[0].softmax(-1)[0, 0]
        assert float(got) == pytest.approx(want, abs=1e-6)
    unknown = prior.start(1, torch.tensor([[1, 7]]))[0].softmax(-1)[0, 0]
    assert float(unknown) == pytest.approx(first, abs=1e-6)


def copied_plans() -> Plans:
    """The action is the first pattern in 3 of 4 steps; the other nine repeat it, so that naive Bayes is too sure."""
    generator = torch.Generator().manual_seed(0)
    pattern = torch.randint(2, (100, 10, 1), generator=generator, dtype=torch.int32)
    flipped = torch.rand(100, 10, generator=generator) < 0.25
    context = pattern + 2 * torch.arange(10, dtype=torch.int32)
    return Plans(pattern[..., 0].long() ^ flipped.long(), 2, context=context)


def test_the_power_undoes_repeated_evidence() -> None:
    plans = copied_plans()
    prior = PatternCounts(2, 10, order=0).fit(plans, generator=torch.Generator().manual_seed(1))
    plain = PatternCounts(2, 10, order=0, power=1.0).fit(plans)
    assert float(prior.tempering) == pytest.approx(0.1, rel=0.3)
    assert float(prior.log_prob(plans).mean()) > float(plain.log_prob(plans).mean()) + 1


@pytest.mark.parametrize("combine", ["product", "backoff"])
def test_saved_and_loaded(combine: str, tmp_path: Path) -> None:
    plans = copied_plans()
    prior = PatternCounts(2, 10, combine=combine).fit(plans, generator=torch.Generator().manual_seed(1))  # type: ignore[arg-type]
    copy = load(save(prior, tmp_path))
    assert copy.config == prior.config
    assert copy.log_prob(plans).equal(prior.log_prob(plans))


def test_bad_input_is_refused() -> None:
    for settings in ({"combine": "sum"}, {"smoothing": 0.0}, {"power": -1.0}, {"order": -1}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            PatternCounts(2, 2, **settings)
