"""The horizon planner: it spends what it may, chooses what promises most, and `eval depth` compares it."""

import json
import re
import warnings
from statistics import NormalDist

import pytest
import torch

from eval.__main__ import main
from eval.compare.horizon import HorizonPlanner, _Outcome
from neuroprior import MarkovPrior, SamplingPlanner, TabularWorld, UniformPrior, gridworld
from neuroprior.testing import check_planner
from tests.support.reports import FROM_ELSEWHERE
from tests.support.sources import FALSE_ALARM, p_value, refuses, seeded, stochastic_world


@pytest.mark.parametrize("settings", [{"pilot": 0.1}, {"pilot": 1.0}, {"rounds": 8, "temperature": 2.0}])
def test_it_is_a_planner(settings):
    check_planner(lambda prior, length, number: HorizonPlanner(prior, length, number, objective="return", **settings))


@pytest.mark.parametrize("num_plans", [1, 2, 3, 10, 64])
@pytest.mark.parametrize("prior", [UniformPrior(4), MarkovPrior(4, 1, num_contexts=64)])
def test_it_spends_hardly_less_than_it_may(num_plans, prior):
    world = gridworld(8, 8, num_worlds=3)
    planner = HorizonPlanner(prior, 12, num_plans)
    decision = planner.plan(world, world.reset(40, seeded(0)), seeded(1))
    assert num_plans * 12 - planner.rounds * 11 <= decision.model_steps <= num_plans * 12
    assert decision.plan.shape == (40, 12)
    beyond = torch.arange(12) >= decision.lengths[:, None]
    assert (decision.plan.masked_select(beyond) == 0).all()


def gathered(scores):
    """What a planner of the longest horizon 3 knows after plans whose prefixes scored so much, `[B, P, 3]`."""
    scores = torch.tensor(scores, dtype=torch.float64)
    so_far = scores.cummax(2).values
    moments = torch.stack([torch.ones_like(so_far), so_far, so_far**2], -1).sum(1)
    best = SamplingPlanner(UniformPrior(4), 3, 1).plan(gridworld(3, 3), torch.zeros(len(scores), dtype=torch.long))
    best = best._replace(score=so_far.amax((1, 2)))
    return _Outcome(best, torch.ones(len(scores)), moments, torch.zeros(len(scores)))


def test_deep_horizons_count():
    """Only the last of 64 actions matters; so many plans of four actions there are that their number overflows."""
    scores = torch.zeros(1, 8, 64, dtype=torch.float64)
    scores[0, :, -1] = torch.arange(8) / 8
    found = gathered(scores.tolist())
    found = found._replace(decision=found.decision._replace(score=torch.tensor([0.5])))
    for actions in (2, 4, 300):
        planner = HorizonPlanner(UniformPrior(actions), 64, 16)
        assert planner._best_horizon(found, 640).tolist() == [64]
    scores[0, :, 40:] = scores[0, :, -1:]
    found = gathered(scores.tolist())
    assert HorizonPlanner(UniformPrior(4), 64, 16)._best_horizon(found, 640).tolist() == [42]  # 15 plans, as of 41


class Turns:
    """A prior that takes action 0 throughout its first plans, action 1 throughout the next ones, and so on."""

    num_actions, device = 5, "cpu"

    def __init__(self):
        self.turn = -1

    def start(self, batch_size):
        self.turn += 1
        return self.step(None, torch.zeros(batch_size, 1))

    def step(self, action, state):
        logits = torch.full((len(state), 5), -torch.inf)
        logits[:, self.turn] = 0
        return logits, state


def test_each_of_equal_candidates_wins_as_often_whenever_it_was_tried():
    """Four plans at first, and one in each of four rounds: chi-square over 8,000 decisions."""
    world, state = TabularWorld(torch.zeros(1, 5, dtype=torch.long), torch.ones(1)), torch.zeros(8000, dtype=torch.long)
    decision = HorizonPlanner(Turns(), 1, 8, rounds=4).plan(world, state, seeded(0))
    assert p_value(decision.plan[:, 0].long(), torch.tensor([4.0, 1, 1, 1, 1])) > FALSE_ALARM


def test_in_stochastic_worlds():
    world = stochastic_world(0)
    planner = HorizonPlanner(UniformPrior(3), 4, 10, objective="return", num_rollouts=5)
    decision = planner.plan(world, world.reset(20, seeded(0)), seeded(1))
    assert decision.model_steps <= 10 * 4 * 5


@pytest.mark.parametrize(
    ("given", "word"), [({"pilot": 0.0}, "pilot"), ({"pilot": 1.1}, "pilot"), ({"rounds": 0}, "rounds")]
)
def test_bad_settings(given, word):
    with refuses(word):
        HorizonPlanner(UniformPrior(2), 3, 4, **given)


SMALL = ["depth", "--worlds", "frozen_lake", "--seeds", "2", "--starts", "4", "--training-starts", "60"]
SMALL += ["--length", "8", "--num-plans", "4", "16", "--processes", "1"]


def test_a_small_comparison(tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*SMALL, "--out", str(out)]) == 0
    assert "frozen_lake, 16 plans:" in " ".join(capsys.readouterr().out.split())
    rows = json.loads((out / "results.json").read_text())["rows"]
    assert {row["planner"] for row in rows} == {"2 actions", "4 actions", "8 actions", "chosen"}
    for row in rows:
        assert 0 <= row["oracle_share"] <= 1 + 1e-6
        most = 8 * row["num_plans"]
        assert row["model_steps"] == most or (row["planner"] == "chosen" and most - 21 <= row["model_steps"] <= most)
    page = (out / "report.html").read_text()
    assert "<title>How deep to plan" in page
    assert not re.search(FROM_ELSEWHERE, page)


def corridor(reward):
    """Five cells in a row; the last is the goal, and ends the episode. `reward [5]`: on arrival."""
    right = torch.tensor([1, 2, 3, 4, 4])
    left = torch.tensor([0, 0, 1, 2, 4])
    return TabularWorld(torch.stack([left, right], 1), torch.tensor([reward]))


def test_where_actions_only_cost_it_warns():
    """Of a return of costs the best prefix is the shortest; with the cost still to come as value it is the goal."""
    world, start = corridor([-1.0, -1.0, -1.0, -1.0, 0.0]), torch.zeros(3, dtype=torch.long)
    with pytest.warns(UserWarning, match="only costs.*give a value"):
        stopped = HorizonPlanner(UniformPrior(2), 6, 400, objective="return").plan(world, start, seeded(0))
    assert stopped.lengths.tolist() == [1] * 3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        to_go = torch.tensor([-4.0, -3.0, -2.0, -1.0, 0.0])
        planner = HorizonPlanner(UniformPrior(2), 6, 400, objective="return", value=lambda state: to_go[state])
        assert (planner.plan(world, start, seeded(0)).final_state == 4).all()
        for reward in ([0.0] * 5, [0.0, 0.0, 0.0, 0.0, 1.0], [-1.0, 3.0, -1.0, -1.0, -1.0]):
            HorizonPlanner(UniformPrior(2), 6, 400, objective="return").plan(corridor(reward), start, seeded(0))
        HorizonPlanner(UniformPrior(2), 6, 400).plan(world, start, seeded(0))


def oracle(scores, best, left, actions):
    """The horizon `[B]` by its definition, one start after the other, with Python's own normal distribution.

    Args:
        scores: `[B, P, L]`: of the best prefix so far.
        best: `[B]`: the best score so far.
    """
    horizons = []
    starts, number, length = len(scores), len(scores[0]), len(scores[0][0])
    for start in range(starts):
        gains = []
        for d in range(length):
            own = [plan[d] for plan in scores[start]]
            everyone = [plan[d] for one in scores for plan in one]
            # Four of the average score, and of the average square, are added to a start's own.
            first, second = (
                (sum(x**k for x in own) + 4 * sum(x**k for x in everyone) / (starts * number)) / (number + 4)
                for k in (1, 2)
            )
            spread, tries = max(second - first**2, 0) ** 0.5, min(left // (d + 1), actions ** (d + 1))
            quantiles = (((q + 0.5) / 16) ** (1 / tries) for q in range(16))
            best_of = [first + spread * NormalDist().inv_cdf(q) for q in quantiles]
            gains.append(sum(max(x - best[start], 0) for x in best_of) / 16)
        horizons.append(max(range(length), key=lambda d: (gains[d], d)) + 1)
    return horizons


@pytest.mark.parametrize(("actions", "left"), [(100, 60), (3, 60), (100, 9)])
def test_the_horizon_is_that_with_the_greatest_expected_improvement(actions, left):
    """Of 40 starts with scores of other means and variances at each horizon."""
    generator = seeded(1)
    spread = torch.rand(40, 1, 3, generator=generator, dtype=torch.float64)
    mean = torch.rand(40, 1, 3, generator=generator, dtype=torch.float64).mul(0.5).cumsum(2)
    scores = (mean + spread * torch.randn(40, 5, 3, generator=generator, dtype=torch.float64)).cummax(2).values
    found = gathered(scores.tolist())
    best = scores.amax((1, 2))
    found = found._replace(decision=found.decision._replace(score=best))
    chosen = HorizonPlanner(UniformPrior(actions), 3, 60)._best_horizon(found, left).tolist()
    assert chosen == oracle(scores.tolist(), best.tolist(), left, actions)
    assert {2, 3} <= set(chosen)


class Watched(HorizonPlanner):
    """Tries plans of a given horizon, and keeps what it would have chosen by."""

    def _best_horizon(self, found, left):
        self.seen = [*getattr(self, "seen", []), (found.moments, left)]
        return torch.full((len(found.steps),), self.horizon)


@pytest.mark.parametrize("horizon", [2, 3])
def test_what_is_known_of_each_horizon(horizon):
    """A single action: returns of 1, -1 and 2 after one, two and three steps; of the best prefix so far 1, 1 and 2.

    Of eight plans' 24 steps, twelve are for three rounds of four: two more plans of two steps, or one of three.
    """
    world = TabularWorld(torch.tensor([[1], [2], [3], [3]]), torch.tensor([0.0, 1.0, -2.0, 3.0]))
    planner = Watched(UniformPrior(1), 3, 8, objective="return")
    planner.horizon = horizon
    planner.plan(world, torch.zeros(2, dtype=torch.long), seeded(0))
    assert [left for _, left in planner.seen] == [12, 8, 4]
    for turn, (moments, _) in enumerate(planner.seen):
        more = turn * (4 // horizon)
        number = [4 + more, 4 + more, 4 + more * (horizon == 3)]
        due = [[n, n * score, n * score**2] for n, score in zip(number, (1, 1, 2), strict=True)]
        assert moments.tolist() == [due] * 2


def test_equals_of_the_best_are_counted_anew_after_a_better_one():
    """Four plans of a score of 0 at first, then four of 1, each in a round: chi-square over 8,000 decisions."""
    table = torch.arange(6)[:, None].repeat(1, 5)
    table[0] = torch.arange(1, 6)
    world = TabularWorld(table, torch.tensor([0.0, 0, 1, 1, 1, 1]))
    decision = HorizonPlanner(Turns(), 1, 8, rounds=4).plan(world, torch.zeros(8000, dtype=torch.long), seeded(0))
    assert (decision.score == 1).all()
    assert p_value(decision.plan[:, 0].long() - 1, torch.ones(4)) > FALSE_ALARM
