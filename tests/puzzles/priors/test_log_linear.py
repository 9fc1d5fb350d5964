"""The log-linear prior: closed forms, its optimum, and what it does with patterns that it does not know."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from neuroprior import Plans
from neuroprior.priors import load, save
from neuroprior.puzzles import LogLinearPrior, PatternNetwork, Steps


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_plans(num: int = 200, length: int = 4, actions: int = 3, patterns: int = 2, codes: int = 6) -> Plans:
    """Actions that depend on the patterns, and those on nothing."""
    context = torch.randint(codes, (num, length, patterns), generator=seeded(1), dtype=torch.int32)
    noise = torch.randint(2, (num, length), generator=seeded(2))
    return Plans((context.sum(-1) + noise) % actions, actions, context=context)


def objective(prior: LogLinearPrior, plans: Plans) -> Tensor:
    return -prior.log_prob(plans).mean() / plans.max_length


def test_one_pattern_at_a_time_gives_the_frequencies() -> None:
    plans = random_plans(patterns=1)
    prior = LogLinearPrior(3, 1, use_last=False).fit(plans, generator=seeded(), epochs=400, l2=0.0)
    assert plans.context is not None
    for code in range(6):
        there = plans.context[..., 0] == code
        want = plans.actions[there].long().bincount(minlength=3) / there.sum()
        got = prior.start(1, torch.tensor([[code]]))[0].softmax(-1)[0]
        assert torch.allclose(got, want, atol=2e-2)


def test_at_the_optimum_expected_and_observed_counts_of_patterns_are_equal() -> None:
    plans = random_plans()
    prior = LogLinearPrior(3, 2).fit(plans, generator=seeded(), epochs=300, l2=0.0)
    assert plans.context is not None
    residual = prior(plans.actions, plans.context).softmax(-1) - torch.eye(3)[plans.actions.long()]
    for code in range(6):
        active = (plans.context == code).sum(-1)[..., None]
        assert float((active * residual).mean((0, 1)).abs().max()) < 1e-2
    assert float(residual[:, 0].mean(0).abs().max()) < 1e-2  # no action yet
    for last in range(3):
        after = (plans.actions[:, :-1] == last)[..., None]
        assert float((after * residual[:, 1:]).mean((0, 1)).abs().max()) < 1e-2


def test_patterns_that_are_rare_or_unknown_weigh_nothing() -> None:
    context = torch.tensor([[[5], [5], [9]]]).repeat(3, 1, 1)
    context[0, 0] = 7
    plans = Plans(torch.tensor([[0, 0, 1]] * 3), 2, context=context)
    prior = LogLinearPrior(2, 1, use_last=False).fit(plans)
    assert prior.patterns.tolist() == [5, 9]
    assert prior.weights.shape == (3, 2)
    assert not prior.weights[-1].any()
    assert prior.start(2, torch.tensor([[7], [2**31 - 1]]))[0].equal(prior.after[:2])
    assert LogLinearPrior(2, 1, min_count=1).fit(plans).patterns.tolist() == [5, 7, 9]


@pytest.mark.parametrize("make", [LogLinearPrior, PatternNetwork])
def test_without_last_actions_the_frequencies_of_actions_count(make: type[LogLinearPrior]) -> None:
    plans = Plans(torch.tensor([[0, 0, 1, 2]] * 40), 3, context=random_plans(40).context)
    prior = make(3, 2, use_last=False, min_count=10**6)  # no pattern is known
    prior.fit(plans, generator=seeded(), epochs=200, l2=0.0)
    assert plans.context is not None
    for probs in prior(plans.actions, plans.context).softmax(-1).flatten(0, 1).unique(dim=0):
        assert torch.allclose(probs, torch.tensor([0.5, 0.25, 0.25]), atol=2e-2)
    # With patterns, too, the expected and the observed counts of actions are equal at the optimum.
    prior = make(3, 2, use_last=False).fit(plans, generator=seeded(), epochs=200, l2=0.0)
    means = prior(plans.actions, plans.context).softmax(-1).mean((0, 1))
    assert torch.allclose(means, torch.tensor([0.5, 0.25, 0.25]), atol=1e-2)


@pytest.mark.parametrize("min_count", [255, 256, 400, 401])
def test_patterns_may_have_to_be_common(min_count: int) -> None:
    context = torch.stack([torch.full((400, 1), 5), torch.arange(400)[:, None]])  # pattern 5 occurs 400 times
    context[1, 5] = 6
    plans = Plans(torch.arange(800).view(2, 400) % 3, 3, context=context)
    prior = LogLinearPrior(3, 1, min_count=min_count).fit(plans, generator=seeded(), epochs=1)
    assert prior.patterns.tolist() == ([5] if min_count <= 400 else [])


def test_a_second_fit_goes_on_from_the_first() -> None:
    plans = random_plans()
    slow = {"epochs": 1, "learning_rate": 0.02}
    once = LogLinearPrior(3, 2).fit(plans, generator=seeded(), **slow)
    before = float(objective(once, plans))
    again = LogLinearPrior(3, 2).fit(plans, generator=seeded(), **slow).fit(plans, generator=seeded(), **slow)
    assert float(objective(again, plans)) < before
    assert plans.context is not None
    weights = once.weights[:-1].clone()
    other = Plans(plans.actions, 3, context=plans.context + 4)
    once.fit(other, epochs=1, learning_rate=1e-12)
    assert once.patterns.tolist() == [4, 5, 6, 7, 8, 9]
    assert torch.allclose(once.weights[:2], weights[4:], atol=1e-6)
    assert float(once.weights[2:].abs().max()) < 1e-6


def test_levin_loss_decreases_its_objective() -> None:
    plans = random_plans(40)
    prior = LogLinearPrior(3, 2).fit(plans, generator=seeded(), epochs=100)

    def levin() -> float:
        return float((torch.tensor(4.0).log() - prior.log_prob(plans)).logsumexp(0))

    before = levin()
    prior.fit(plans, generator=seeded(), loss="levin", epochs=20)
    assert levin() < before - 1e-3


def test_flat_steps_give_what_plans_give() -> None:
    plans = random_plans()
    assert plans.context is not None
    last = torch.cat([torch.full((200, 1), 3), plans.actions[:, :-1].long()], 1)
    one = LogLinearPrior(3, 2).fit(plans, generator=seeded())
    plan = torch.arange(200).repeat_interleave(4)
    steps = Steps(plans.context.flatten(0, 1), last.flatten(), plans.actions.flatten().long(), plan)
    other = LogLinearPrior(3, 2).fit_steps(steps, generator=seeded())
    assert one.weights.equal(other.weights)
    assert one.after.equal(other.after)


def test_the_same_seed_gives_the_same_prior() -> None:
    plans = random_plans()
    first, second = (LogLinearPrior(3, 2).fit(plans, generator=seeded(5)) for _ in range(2))
    assert first.weights.equal(second.weights)


@pytest.mark.parametrize("use_last", [False, True])
def test_saved_and_loaded(use_last: bool, tmp_path: Path) -> None:
    plans = random_plans()
    prior = LogLinearPrior(3, 2, use_last=use_last).fit(plans, generator=seeded())
    copy = load(save(prior, tmp_path))
    assert isinstance(copy, LogLinearPrior)
    assert copy.config == {"num_actions": 3, "num_patterns": 2, "use_last": use_last, "min_count": 2}
    assert copy.patterns.dtype == torch.int32
    assert copy.log_prob(plans).equal(prior.log_prob(plans))


def test_bad_input_is_refused() -> None:
    prior = LogLinearPrior(3, 2)
    plans = random_plans()
    for context in (torch.rand(200, 4, 2), plans.context[..., :1], None, plans.actions.long()):  # type: ignore[index]
        with pytest.raises(ValueError, match="context"):
            prior.fit(Plans(plans.actions, 3, context=context))
    with pytest.raises(ValueError, match=r"context\[0, 1, 1\]: -1 is out of range"):
        Plans(torch.zeros(1, 2, dtype=torch.long), 3, context=torch.tensor([[[0, 1], [3, -1]]]))
    for settings in ({"loss": "square"}, {"epochs": 0}, {"l2": -1.0}, {"learning_rate": 0.0}, {"steps": 3}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            prior.fit(plans, **settings)
    for settings in ({"learning_rate": math.inf}, {"learning_rate": 1e30}, {"l2": math.inf}):
        with pytest.raises(ValueError, match="become infinite"):
            prior.fit(plans, **settings)
    assert prior.log_prob(plans).isfinite().all()
    for wrong in (torch.zeros(1, 2), torch.zeros(1, 3, dtype=torch.int32), torch.zeros(1, 1, 2, dtype=torch.int32)):
        with pytest.raises(ValueError, match="context: 2 patterns"):
            prior.start(1, wrong)
    steps = Steps(
        torch.zeros(2, 2, dtype=torch.int32), torch.tensor([0, 4]), torch.tensor([0, 1]), torch.tensor([0, 0])
    )
    with pytest.raises(ValueError, match="last"):
        prior.fit_steps(steps)


def test_actions_are_remembered_without_a_new_context() -> None:
    prior, patterns = LogLinearPrior(2, 1), torch.tensor([[0]])
    prior.after[:, 0] = torch.arange(3.0)
    logits, state = prior.start(1, patterns)
    assert float(logits[0, 0]) == 2  # no action yet
    for action in (1, 0, 1):
        logits, state = prior.step(torch.tensor([action]), state)
        assert float(logits[0, 0]) == action
