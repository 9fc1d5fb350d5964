"""The log-linear prior: closed forms, its optimum, unknown patterns, and patterns in plans, files, worlds, planners."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuroprior import MarkovPrior, MCTSPlanner, Plans, SamplingPlanner, World, collect, read_plans, write_plans
from neuroprior.priors import load, save
from neuroprior.puzzles import LogLinearPrior, Steps
from neuroprior.puzzles.priors.compiled_fit import frequent, number_patterns
from neuroprior.sampling.ancestral import sample_in_world
from neuroprior.testing import check_world
from neuroprior.worlds import Patterns
from tests.support.sources import seeded


def random_plans(num: int = 200, length: int = 4, actions: int = 3, patterns: int = 2, codes: int = 6) -> Plans:
    """Actions that depend on the patterns, and those on nothing."""
    context = torch.randint(codes, (num, length, patterns), generator=seeded(1), dtype=torch.int32)
    noise = torch.randint(2, (num, length), generator=seeded(2))
    return Plans((context.sum(-1) + noise) % actions, actions, context=context)


def test_at_the_optimum_expected_and_observed_counts_of_patterns_are_equal() -> None:
    plans = random_plans()
    prior = LogLinearPrior(3, 2).fit(plans, generator=seeded(0), epochs=300, l2=0.0)
    assert plans.context is not None
    residual = prior(plans.actions, plans.context).softmax(-1) - torch.eye(3)[plans.actions.long()]
    for code in range(6):
        active = (plans.context == code).sum(-1)[..., None]
        assert float((active * residual).mean((0, 1)).abs().max()) < 1e-2
    assert float(residual[:, 0].mean(0).abs().max()) < 1e-2  # no action yet
    for last in range(3):
        after = (plans.actions[:, :-1] == last)[..., None]
        assert float((after * residual[:, 1:]).mean((0, 1)).abs().max()) < 1e-2


def test_without_known_patterns_actions_follow_the_last_one_as_often_as_they_did() -> None:
    plans = Plans(torch.tensor([[0, 0, 1, 2]] * 30 + [[1, 0, 2, 2]] * 10), 3, context=random_plans(40).context)
    prior = LogLinearPrior(3, 2, min_count=10**6).fit(plans, generator=seeded(0), epochs=300)
    followers = torch.tensor([[30.0, 30, 10], [10, 0, 30], [0, 0, 10], [30, 10, 0]])  # the last: first actions
    want = followers / followers.sum(1, keepdim=True)
    for last in range(4):
        probs = (prior.scores(torch.tensor([[0, 0]]))[0] + prior.after[last]).softmax(-1)
        assert torch.allclose(probs, want[last], atol=3e-2)


def test_patterns_that_are_rare_or_unknown_weigh_nothing() -> None:
    context = torch.tensor([[[5], [5], [9]]]).repeat(3, 1, 1)
    context[0, 0] = 7
    plans = Plans(torch.tensor([[0, 0, 1]] * 3), 2, context=context)
    prior = LogLinearPrior(2, 1).fit(plans)
    assert prior.patterns.tolist() == [5, 9]
    assert prior.weights.shape == (3, 2)
    assert not prior.weights[-1].any()
    assert prior.start(2, torch.tensor([[7], [2**31 - 1]]))[0].equal(prior.after[-1:].expand(2, -1))
    assert LogLinearPrior(2, 1, min_count=1).fit(plans).patterns.tolist() == [5, 7, 9]


@pytest.mark.parametrize("min_count", [255, 256, 400, 401])
def test_patterns_may_have_to_be_common(min_count: int) -> None:
    context = torch.stack([torch.full((400, 1), 5), torch.arange(400)[:, None]])  # pattern 5 occurs 400 times
    context[1, 5] = 6
    plans = Plans(torch.arange(800).view(2, 400) % 3, 3, context=context)
    prior = LogLinearPrior(3, 1, min_count=min_count).fit(plans, generator=seeded(0), epochs=1)
    assert prior.patterns.tolist() == ([5] if min_count <= 400 else [])


def test_a_second_fit_goes_on_from_the_first() -> None:
    plans = random_plans()
    slow = {"epochs": 1, "learning_rate": 0.02}
    once = LogLinearPrior(3, 2).fit(plans, generator=seeded(0), **slow)
    again = LogLinearPrior(3, 2).fit(plans, generator=seeded(0), **slow).fit(plans, generator=seeded(0), **slow)
    assert float(again.log_prob(plans).mean()) > float(once.log_prob(plans).mean())
    assert plans.context is not None
    weights = once.weights[:-1].clone()
    once.fit(Plans(plans.actions, 3, context=plans.context + 4), epochs=1, learning_rate=1e-12)
    assert once.patterns.tolist() == [4, 5, 6, 7, 8, 9]
    assert torch.allclose(once.weights[:2], weights[4:], atol=1e-6)
    assert float(once.weights[2:].abs().max()) < 1e-6


def test_levin_loss_decreases_its_objective() -> None:
    plans = random_plans(40)
    prior = LogLinearPrior(3, 2).fit(plans, generator=seeded(0), epochs=100)

    def levin() -> float:
        return float((torch.tensor(4.0).log() - prior.log_prob(plans)).logsumexp(0))

    before = levin()
    prior.fit(plans, generator=seeded(0), loss="levin", epochs=20)
    assert levin() < before - 1e-3


def test_flat_steps_and_a_file_give_what_plans_give(tmp_path: Path) -> None:
    plans = random_plans()
    assert plans.context is not None
    one = LogLinearPrior(3, 2).fit(plans, generator=seeded(0))
    last = torch.cat([torch.full((200, 1), 3), plans.actions[:, :-1].long()], 1)
    plan = torch.arange(200).repeat_interleave(4)
    steps = Steps(plans.context.flatten(0, 1), last.flatten(), plans.actions.flatten().long(), plan)
    other = LogLinearPrior(3, 2).fit_steps(steps, generator=seeded(0))
    copy = load(save(one, tmp_path))
    assert copy.config == {"num_actions": 3, "num_patterns": 2, "min_count": 2}
    for same in (other, copy):
        assert isinstance(same, LogLinearPrior)
        assert same.patterns.dtype == torch.int32
        assert same.weights.equal(one.weights)
        assert same.after.equal(one.after)


def test_actions_are_remembered_without_a_new_context() -> None:
    prior = LogLinearPrior(2, 1)
    prior.after[:, 0] = torch.arange(3.0)
    logits, state = prior.start(1, torch.tensor([[0]]))
    assert float(logits[0, 0]) == 2  # no action yet
    for action in (1, 0, 1):
        logits, state = prior.step(torch.tensor([action]), state)
        assert float(logits[0, 0]) == action


class Line(World):
    """Cells 0 to 9 of a line, on which the agent steps left or right; the patterns are its cell and its half."""

    num_actions, observation = 2, Patterns(2)

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        return torch.randint(10, (batch_size,), generator=generator)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        reached = (state + 2 * action - 1).clamp(0, 9)
        return reached, (reached == 9).float()

    def observe(self, state: Tensor) -> Tensor:
        return torch.stack([state, 100 + state // 5], 1).to(torch.int32)


def to_the_middle() -> Plans:
    """Plans that go right from the left half, and left from the right half."""
    world, state, actions, seen = Line(), torch.arange(10).repeat(20), [], []
    for _ in range(6):
        seen.append(world.observe(state))
        actions.append((state < 5).long())
        state = world.step(state, actions[-1])[0]
    return Plans(torch.stack(actions, 1), 2, context=torch.stack(seen, 1))


def test_it_acts_in_a_world_of_patterns() -> None:
    world, start = Line(), torch.tensor([0, 9])
    check_world(world)
    prior = LogLinearPrior(2, 2).fit(to_the_middle(), generator=seeded(0))
    plans, _ = sample_in_world(prior, world, start, 200, 3, generator=seeded(1))
    # At least 0.95 of the steps go towards the middle, as all steps of the plans that were learned from.
    assert float(plans[0].float().mean()) > 0.95
    assert float(plans[1].float().mean()) < 0.05
    for planner in (SamplingPlanner(prior, 4, 8), MCTSPlanner(prior, 4, 16)):
        assert planner.plan(world, start, seeded(2)).plan.shape == (2, 4)
    collected = collect(SamplingPlanner(MarkovPrior(2, 0), 4, 8), world, state=start, context="step")
    assert collected.context is not None
    assert collected.context[:, 0].equal(world.observe(start))


def test_plans_keep_patterns(tmp_path: Path) -> None:
    plans = to_the_middle()
    assert plans.context is not None
    write_plans(plans, tmp_path / "plans.npz")
    cut, ended, again = plans[3:5].steps(1, 4), plans.with_end(), read_plans(tmp_path / "plans.npz")
    wide = Plans(plans.actions, 2, context=plans.context.long())
    for kept, due in (
        (again, plans.context),
        (wide, plans.context),
        (cut, plans.context[3:5, 1:4]),
        (ended.steps(6, 7), plans.context[:, -1:]),
    ):
        assert kept.context is not None
        assert kept.context.dtype == torch.int32
        assert kept.context.equal(due)
    for suffix in ("csv", "jsonl"):
        with pytest.raises(ValueError, match="npz"):
            write_plans(plans, tmp_path / f"plans.{suffix}")
    assert LogLinearPrior(3, 2).fit(ended).end == 2


PLANS = random_plans()


@pytest.mark.parametrize("context", [torch.rand(200, 4, 2), PLANS.context[..., :1], None, PLANS.actions.long()])  # type: ignore[index]
def test_plans_without_its_patterns_are_refused(context: Any) -> None:
    with pytest.raises(ValueError, match="context"):
        LogLinearPrior(3, 2).fit(Plans(PLANS.actions, 3, context=context))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"loss": "square"}, '`loss` must be "log" or "levin"'),
        ({"epochs": 0}, "epochs"),
        ({"l2": -1.0}, "`l2` must be at least 0, got -1.0"),
        ({"learning_rate": 0.0}, "`learning_rate` must be above 0"),
        ({"steps": 3}, "steps"),
        ({"learning_rate": math.inf}, "weights stay finite"),
        ({"l2": math.inf}, "weights stay finite"),
    ],
)
def test_settings_out_of_range_are_refused_and_change_nothing(settings: dict[str, Any], message: str) -> None:
    prior = LogLinearPrior(3, 2)
    with pytest.raises(ValueError, match=message):
        prior.fit(PLANS, **settings)
    assert not prior.after.any()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: LogLinearPrior(2, 0), "num_patterns"),
        (lambda: LogLinearPrior(3, 2).start(1, torch.zeros(1, 2)), "`context` must be 2 patterns"),
        (lambda: LogLinearPrior(3, 2).start(1, torch.zeros(1, 3, dtype=torch.int32)), "`context` must be 2 patterns"),
        (lambda: LogLinearPrior(3, 2).start(1), "takes a context, and none was given"),
        (
            lambda: LogLinearPrior(3, 1).fit_steps(
                Steps(torch.zeros(2, 1, dtype=torch.int32), torch.tensor([0, 4]), torch.arange(2), torch.arange(2))
            ),
            "last",
        ),
        (lambda: MarkovPrior(2, 1, num_contexts=200).fit(to_the_middle()), "patterns"),
        (lambda: sample_in_world(LogLinearPrior(2, 3), Line(), torch.tensor([1]), 1, 2), "3 patterns"),
        (lambda: LogLinearPrior(3, 2).sample(3, 2, PLANS.context[:3, 0]), r"`context` must"),  # type: ignore[index]
    ],
)
def test_bad_input_is_refused(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(("number", "kinds"), [(300, 40), (70_000, 100_000)])
def test_frequent_patterns_are_those_of_numpy(number, kinds):
    """Also where there are more kinds than the first table has room for."""
    patterns = np.random.default_rng(0).integers(0, kinds, (number, 3)) ** 2 % (2**31 - 1)
    codes, counts = np.unique(patterns, return_counts=True)
    found = frequent(patterns.astype(np.int32), 3)
    assert found.tolist() == codes[counts >= 3].tolist()
    rows = number_patterns(found, patterns[:50].astype(np.int32))
    known = {code: row for row, code in enumerate(found.tolist())}
    assert rows.tolist() == [[known.get(code, len(found)) for code in row] for row in patterns[:50].tolist()]
