"""Patterns as contexts of plans, in files, in worlds and in planners."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from neuroprior import MarkovPrior, MCTSPlanner, Plans, SamplingPlanner, World, collect, read_plans, write_plans
from neuroprior.puzzles import LogLinearPrior, PatternCounts, PatternNetwork, PatternPrior
from neuroprior.sampling.ancestral import sample_in_world
from neuroprior.testing import check_world


class Line(World):
    """Cells 0 to 9 of a line, on which the agent steps left or right; the patterns are its cell and its half."""

    num_actions = 2

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        return torch.randint(10, (batch_size,), generator=generator)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        reached = (state + 2 * action - 1).clamp(0, 9)
        return reached, (reached == 9).float()

    def observe(self, state: Tensor) -> Tensor:
        return torch.stack([state, 100 + state // 5], 1).to(torch.int32)


def to_the_right() -> Plans:
    """Plans that go right from the left half, and left from the right half."""
    world, state, actions, seen = Line(), torch.arange(10).repeat(20), [], []
    for _ in range(6):
        seen.append(world.observe(state))
        actions.append((state < 5).long())
        state = world.step(state, actions[-1])[0]
    return Plans(torch.stack(actions, 1), 2, context=torch.stack(seen, 1))


PRIORS = {
    "log-linear": lambda: LogLinearPrior(2, 2),
    "product": lambda: PatternCounts(2, 2),
    "back-off": lambda: PatternCounts(2, 2, combine="backoff", smoothing=0.1),
    "network": lambda: PatternNetwork(2, 2),
}


@pytest.mark.parametrize("name", PRIORS)
def test_priors_act_in_a_world_of_patterns(name: str) -> None:
    world = Line()
    prior = PRIORS[name]().fit(to_the_right(), generator=torch.Generator().manual_seed(0))
    assert isinstance(prior, PatternPrior)
    start = torch.tensor([0, 9])
    plans, _ = sample_in_world(prior, world, start, 200, 3, generator=torch.Generator().manual_seed(1))
    # At least 0.95 of the steps go towards the middle, as all steps of the plans that were learned from.
    assert float(plans[0].float().mean()) > 0.95
    assert float(plans[1].float().mean()) < 0.05
    for planner in (SamplingPlanner(prior, 4, 8), MCTSPlanner(prior, 4, 16)):
        decision = planner.plan(world, start, torch.Generator().manual_seed(2))
        assert decision.plan.shape == (2, 4)


def test_a_world_may_show_patterns() -> None:
    check_world(Line())


def test_plans_keep_patterns(tmp_path: Path) -> None:
    plans = to_the_right()
    assert plans.context is not None
    assert plans.context.dtype == torch.int32
    assert Plans(plans.actions, 2, context=plans.context.long()).context.dtype == torch.int32  # type: ignore[union-attr]
    write_plans(plans, tmp_path / "plans.npz")
    again = read_plans(tmp_path / "plans.npz")
    assert again.context is not None
    assert again.context.dtype == torch.int32
    assert again.context.equal(plans.context)
    for suffix in ("csv", "jsonl"):
        with pytest.raises(ValueError, match="npz"):
            write_plans(plans, tmp_path / f"plans.{suffix}")
    cut = plans[3:5].steps(1, 4)
    assert cut.context is not None
    assert cut.context.equal(plans.context[3:5, 1:4])
    ended = plans.with_end()
    assert ended.context is not None
    assert ended.context[:, -1].equal(plans.context[:, -1])
    assert LogLinearPrior(3, 2).fit(ended).end == 2


def test_collected_plans_have_patterns() -> None:
    planner, start = SamplingPlanner(MarkovPrior(2, 0), 4, 8), torch.tensor([3, 7, 8])
    plans = collect(planner, Line(), state=start, context="step", generator=torch.Generator().manual_seed(0))
    assert plans.context is not None
    assert plans.context.shape == (3, 4, 2)
    assert plans.context[:, 0].equal(Line().observe(start))
    with pytest.raises(ValueError, match="step"):
        collect(planner, Line(), state=start, context="plan")


def test_patterns_that_do_not_fit_are_refused() -> None:
    plans, prior = to_the_right(), LogLinearPrior(2, 2)
    assert plans.context is not None
    with pytest.raises(ValueError, match="patterns"):
        MarkovPrior(2, 1, num_contexts=200).fit(plans)
    with pytest.raises(ValueError, match="3 patterns"):
        sample_in_world(LogLinearPrior(2, 3), Line(), torch.tensor([1]), 1, 2)
    with pytest.raises(ValueError, match=r"context: .*\[3, 2\]"):
        prior.sample(3, 2, plans.context[:3, 0])
    assert prior.sample(3, 4, plans.context[:3]).shape == (3, 4)
    with pytest.raises(ValueError, match="num_patterns"):
        LogLinearPrior(2, 0)
