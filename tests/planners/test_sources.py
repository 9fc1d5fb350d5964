"""Several priors that share a planner's candidates."""

import pytest
import torch
from torch import Tensor

from neuroprior import MarkovPrior, SamplingPlanner, TabularWorld, UniformPrior, World
from neuroprior.planners import Sources
from neuroprior.planners.sampling import wins_of
from neuroprior.planners.sources import LAST_CALL_WEIGHT, MIN_SHARE
from neuroprior.worlds import Categories
from tests.support.sources import FALSE_ALARM, p_value, refuses, seeded


def always(*actions: int) -> MarkovPrior:
    """A chain of order 0 of three actions that takes nearly always one of these."""
    prior = MarkovPrior(3, 0, smoothing=1e-6)
    return prior.fit(torch.tensor([actions * 50]))


class Coin(World):
    """The reward of each step is 1 for one action, and 0 for the others; which one may be changed."""

    num_actions, observation = 3, Categories(1)

    def __init__(self, good: int) -> None:
        self.good = good

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        return torch.zeros(batch_size, dtype=torch.long)

    def observe(self, state: Tensor) -> Tensor:
        return state

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        return state, (action == self.good).float()


def test_shares_move_towards_who_had_the_best_candidate():
    """By hand: three sources, of which the first wins 6 and the second 2 of 8 decisions."""
    sources, world = Sources([always(0), always(1)]), Coin(0)
    assert sources.shares(world).tolist() == [1 / 3] * 3
    sources.learn(world, torch.tensor([6.0, 2.0, 0.0]))
    moved = [(1 - LAST_CALL_WEIGHT) / 3 + LAST_CALL_WEIGHT * share for share in (0.75, 0.25, 0.0)]
    assert sources.shares(world).tolist() == pytest.approx(moved)
    for _ in range(60):
        sources.learn(world, torch.tensor([8.0, 0.0, 0.0]))
    assert sources.shares(world).tolist() == pytest.approx([1 - 2 * MIN_SHARE, MIN_SHARE, MIN_SHARE], abs=1e-6)
    assert sources.shares(Coin(0)).tolist() == [1 / 3] * 3  # another world has shares of its own
    before = sources.shares(world)
    sources.learn(world, torch.zeros(3))
    assert sources.shares(world).equal(before)


@pytest.mark.parametrize(("number", "counts"), [(3, [1, 1, 1]), (4, [2, 1, 1]), (11, [5, 3, 3]), (100, [51, 30, 19])])
def test_every_source_draws_at_least_one_candidate(number, counts):
    """Shares of .52, .3 and .18, rounded by the largest remainders."""
    sources, world = Sources([always(0), always(1)]), Coin(0)
    sources._shares[world] = torch.tensor([0.52, 0.3, 0.18], dtype=torch.float64)
    assert sources.counts(world, number) == counts


def test_equally_good_candidates_share_a_win():
    score = torch.tensor([[1.0, 4.0, 4.0, 0.0, 4.0], [2.0, 1.0, 0.0, 3.0, 1.0], [5.0, 5.0, 5.0, 5.0, 5.0]])
    assert wins_of(score, [2, 2, 1]).tolist() == pytest.approx([1 / 3 + 1 / 3, 1 / 3 + 1 + 1 / 3, 1 / 3 + 1 / 3])
    prefixes = torch.stack([score, score - 1], 2)
    assert wins_of(prefixes, [2, 2, 1]).equal(wins_of(score, [2, 2, 1]))


def test_candidates_come_from_each_source_by_its_share():
    world = TabularWorld(torch.zeros(1, 3, dtype=torch.long), torch.zeros(1, 1))
    planner = SamplingPlanner([always(0), always(1)], 2, 40)
    planner.keep_candidates = True
    planner.sources._shares[world] = torch.tensor([0.5, 0.2, 0.3], dtype=torch.float64)
    due = planner.sources.counts(world, 40)
    plans = planner.plan(world, torch.zeros(300, dtype=torch.long), seeded(0)).candidates.plans
    first, second, uniform = plans.split(due, 1)
    assert (first == 0).all()
    assert (second == 1).all()
    code = (3 * uniform[..., 0] + uniform[..., 1]).flatten()
    assert p_value(code, torch.ones(9)) > FALSE_ALARM
    moved = [(1 - LAST_CALL_WEIGHT) * share + LAST_CALL_WEIGHT / 3 for share in (0.5, 0.2, 0.3)]  # all are equally good
    assert planner.sources.shares(world).tolist() == pytest.approx(moved)


def test_a_uniform_prior_is_always_among_them():
    assert [type(one).__name__ for one in Sources([always(0)]).priors] == ["MarkovPrior", "UniformPrior"]
    assert len(Sources([always(0), UniformPrior(3)]).priors) == 2
    for arguments, words in (
        (([], 2, 4), ["got none"]),
        (([always(0), UniformPrior(4)], 2, 4), ["same number of actions, got [3, 4]"]),
        (([always(0), 3], 2, 4), ["got int"]),
    ):
        with refuses(*words):
            SamplingPlanner(*arguments)
    with refuses("`halving` and `uniform_share`"):
        SamplingPlanner([always(0)], 2, 4, uniform_share=0.2)
    with refuses("`num_plans` must be at least 3"):
        SamplingPlanner([always(0), always(1)], 2, 2).plan(Coin(0), torch.zeros(1, dtype=torch.long))
