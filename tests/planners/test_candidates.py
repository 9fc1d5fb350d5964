"""What planners try, and how many steps they say that it took: by hand, and against the prior."""

import pytest
import torch

from neuroprior import MarkovPrior, MCTSPlanner, TabularWorld, UniformPrior
from neuroprior.planners import FrontierPlanner, SamplingPlanner
from tests.support.sources import FALSE_ALARM, p_value, seeded

SHARES = torch.tensor([0.6, 0.4])


class Recorded(TabularWorld):
    """Two ways from cell 0, to 1 and 2, and on to 3; keeps which actions were taken in cell 0, and all steps."""

    def __init__(self):
        super().__init__(torch.tensor([[1, 2], [3, 3], [3, 3], [3, 3]]), torch.zeros(1, 4))
        self.first, self.steps = [], 0

    def step(self, state, action, generator=None):
        self.first += action[state == 0].tolist()
        self.steps += len(state)
        return super().step(state, action, generator)

    def rollout(self, state, plans, generator=None, keep_states=False):
        self.first += plans[:, :, 0].flatten().tolist()
        return super().rollout(state, plans, generator, keep_states)


def chain() -> MarkovPrior:
    """Takes actions 0 and 1 with the probabilities `SHARES`, but for a thousandth."""
    return MarkovPrior(2, 0, backoff="dirichlet").fit(torch.tensor([[0]] * 600 + [[1]] * 400))


def tried(planner, starts: int) -> torch.Tensor:
    world = Recorded()
    planner.plan(world, torch.zeros(starts, dtype=torch.long), seeded(0))
    return torch.tensor(world.first)


def test_without_noise_the_frontier_planner_takes_the_most_probable():
    assert tried(FrontierPlanner(chain(), 1, 1, noise=False), 100).unique().tolist() == [0]
    assert p_value(tried(FrontierPlanner(chain(), 1, 1), 4000), SHARES) > FALSE_ALARM


@pytest.mark.parametrize(("temperature", "actions"), [(1.0, [0, 1]), (0.5, [0])])
def test_tree_search_weighs_the_prior_at_its_temperature(temperature, actions):
    """After one try of action 0 nothing is known of scores: next is the greater of p(0) / 2 and p(1)."""
    assert tried(MCTSPlanner(chain(), 2, 2, temperature=temperature), 50).unique().tolist() == actions


def test_without_exploration_tree_search_does_not_heed_the_prior():
    assert tried(MCTSPlanner(chain(), 1, 1), 50).unique().tolist() == [0]
    assert p_value(tried(MCTSPlanner(chain(), 1, 1, exploration=0.0), 4000), torch.ones(2)) > FALSE_ALARM


@pytest.mark.parametrize("temperature", [0.25, 1.0, 4.0])
@pytest.mark.parametrize("kind", [SamplingPlanner, FrontierPlanner])
def test_candidates_are_drawn_at_the_planners_temperature(kind, temperature):
    """Of two actions, and of the plans of two that begin with them."""
    sharp = SHARES ** (1 / temperature) / (SHARES ** (1 / temperature)).sum()
    for length in (1, 2):
        assert p_value(tried(kind(chain(), length, 1, temperature=temperature), 3000), sharp) > FALSE_ALARM


def test_of_plans_into_one_state_the_likelier_goes_on_where_only_the_last_reward_counts():
    """Both actions of cell 0 lead to cell 1: the rarer one pays, which is lost on the way to the last step."""

    class Paying(TabularWorld):
        def step(self, state, action, generator=None):
            after, _ = super().step(state, action, generator)
            return after, torch.where(state == 0, 5.0 * action, action.float())

    world, start = Paying(torch.tensor([[1, 1], [2, 2], [2, 2]]), torch.zeros(1, 3)), torch.zeros(20, dtype=torch.long)
    for objective, first in (("terminal", 0), ("return", 1)):
        planner = FrontierPlanner(chain(), 2, 2, noise=False, objective=objective)
        decision = planner.plan(world, start, seeded(0))
        assert decision.plan.tolist() == [[first, 1]] * 20


@pytest.mark.parametrize(("share", "number", "uniform"), [(0.3, 9, 3), (0.1, 4, 0), (0.1, 6, 1), (0.9, 4, 4)])
def test_the_share_of_uniform_plans_is_rounded_to_the_nearest_number(share, number, uniform):
    """A prior that never takes action 1 of cell 0, but for those."""
    sure = MarkovPrior(2, 0, 1e-9, backoff="dirichlet").fit(torch.zeros(9, 1, dtype=torch.long))
    found = tried(SamplingPlanner(sure, 1, number, uniform_share=share), 2000)
    assert len(found) == 2000 * number
    expected = 1000 * uniform
    assert abs(int(found.sum()) - expected) <= 5 * (expected / 2) ** 0.5


def chain_world():
    """Three actions on nine cells in a ring, with rewards that all differ."""
    step = torch.tensor([1, 2, 5])
    reward = torch.tensor([0.0, 1.0, -2.0, 4.0, 0.5, 7.0, -1.0, 3.0, 2.5])
    return TabularWorld((torch.arange(9)[:, None] + step) % 9, reward[None])


@pytest.mark.parametrize("objective", ["terminal", "return"])
@pytest.mark.parametrize("any_prefix", [False, True])
@pytest.mark.parametrize("kind", [SamplingPlanner, MCTSPlanner, FrontierPlanner])
def test_all_candidates_are_kept_on_demand(kind, any_prefix, objective):
    """Each with its own score, the best of which the decision has; and the same decision as without them."""
    world, state = chain_world(), torch.tensor([0, 3, 7, 3])
    planner = kind(UniformPrior(3), 3, 6, objective=objective, any_prefix=any_prefix)
    assert planner.plan(world, state, seeded(0)).candidates is None
    planner.steps_at_once = 40  # in chunks of a few starts
    plain = planner.plan(world, state, seeded(0))
    if any_prefix:
        own = world.rollout(state, plain.plan[:, None], keep_states=True)
        scores = planner.prefix_scores(own.rewards, own.states)[:, 0]
        torch.testing.assert_close(scores.gather(1, plain.lengths[:, None] - 1)[:, 0], plain.score)
    planner.keep_candidates = True
    decision = planner.plan(world, state, seeded(0))
    assert decision.plan.equal(plain.plan)
    assert decision.score.equal(plain.score)
    plans, scores = decision.candidates
    rollout = world.rollout(state, plans, keep_states=True)
    due = planner.prefix_scores(rollout.rewards, rollout.states)
    due = due.amax(2) if any_prefix and kind is not FrontierPlanner else due[..., -1]
    there = scores > -torch.inf
    assert there.any(1).all()
    torch.testing.assert_close(scores[there], due[there])
    best = scores.amax(1)
    assert (
        (best <= decision.score + 1e-6).all() if any_prefix and kind is FrontierPlanner else best.equal(decision.score)
    )
    visits, values = decision.candidates.visits(3), decision.candidates.values(3)
    for b in range(4):
        for action in range(3):
            mine = scores[b][there[b] & (plans[b, :, 0] == action)]
            assert int(visits[b, action]) == len(mine)
            assert mine.mean().isclose(values[b, action], equal_nan=True)


def test_a_decision_says_what_it_is_in_a_line():
    decision = SamplingPlanner(UniformPrior(3), 4, 16).plan(chain_world(), torch.tensor([1, 2]), seeded(0))
    mean = float(decision.score.mean())
    assert repr(decision) == f"Decision(2 plans of 4 actions, mean score {mean:.4g}, 64 model steps each)"
