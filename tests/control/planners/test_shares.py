"""How many candidates a prior proposes: a fixed share, and one that follows from what its candidates have added."""

import itertools

import pytest
import torch

from neuroprior.control import ICEMPlanner, Memory, MPPIPlanner, ShootingPlanner, control
from neuroprior.control.planners.shares import KEPT_PER_DECISION, Shares
from tests.support.sources import refuses, seeded
from tests.support.vectors import Cart, drift

PLANNERS = [ShootingPlanner, ICEMPlanner, MPPIPlanner]


class Preferring(Cart):
    """Rewards vectors that are near the middle (where the prior is) if x > 0, and those far from it otherwise.

    It keeps, for each decision and run, how many of the candidates are next to the middle.
    """

    def __init__(self):
        super().__init__()
        self.middle = (self.action_low + self.action_high) / 2
        self.of_prior = []

    def reset(self, batch_size, generator=None):
        state = torch.zeros(batch_size, 3)
        state[:, 0] = torch.where(torch.arange(batch_size) % 2 == 0, 1.0, -1.0)
        return state

    def step(self, state, action, generator=None):
        far = (action - self.middle).abs().sum(-1)
        return state, torch.where(state[..., 0] > 0, -far, far)

    def rollout(self, state, plans, generator=None, keep_states=False):
        self.of_prior.append(((plans - self.middle).abs() < 0.01).flatten(2).all(2).sum(1))
        return super().rollout(state, plans, generator, keep_states)


def wins(prior, own):
    """As `Shares.wins` of one start: how often a candidate was the best, and how many there were."""
    return torch.tensor([[prior, own]], dtype=torch.float)


@pytest.mark.parametrize(
    ("scores", "others", "won"),
    [
        # Of six candidates the last two are the prior's.
        ([0.0, 1.0, 2.0, 3.0, 9.0, 4.0], None, (1.0, 0.0)),
        ([0.0, 1.0, 2.0, 9.0, 3.0, 4.0], None, (0.0, 1.0)),
        ([0.0, 1.0, 2.0, 3.0, 9.0, 4.0], [7.0], (1.0, 0.0)),
        ([0.0, 1.0, 2.0, 3.0, 9.0, 4.0], [1.0, 10.0], (0.0, 0.0)),
        ([0.0, 1.0, 2.0, 3.0, 9.0, 4.0], [9.0], (0.0, 0.0)),
        ([0.0, 9.0, 2.0, 3.0, 9.0, 4.0], None, (0.0, 0.0)),
        ([0.0, 9.0, 9.0, 3.0, 8.0, 8.0], None, (0.0, 1.0)),
        ([-torch.inf, 9.0, -torch.inf, -torch.inf, -torch.inf, -torch.inf], None, (0.0, 1.0)),
        ([-torch.inf] * 6, None, (0.0, 0.0)),
        ([0.0, 1.0, 2.0, 3.0, torch.inf, 4.0], [-torch.inf], (1.0, 0.0)),
        ([-3e38, 1.0, 2.0, 3.0, 4.0, 3e38], None, (1.0, 0.0)),
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_kind_wins_where_one_of_its_candidates_is_the_best_of_all(scores, others, won, dtype):
    shares = Shares([6], 1 / 3, 1, seeded(0), adapt=True)
    given = torch.tensor([scores], dtype=dtype, requires_grad=True)
    shares.observe(given, None if others is None else torch.tensor([others], dtype=dtype))
    assert shares.wins.tolist() == [[[won[0], 2.0], [won[1], 4.0]]]
    assert not shares.wins.requires_grad
    later = Shares([6], 1 / 3, 1, seeded(0), adapt=True, wins=shares.wins)
    assert torch.allclose(later.wins, KEPT_PER_DECISION * shares.wins)


def test_decisions_with_one_kind_of_candidates_say_nothing():
    """Else a kind that is hardly tried would be judged by other decisions than the other kind."""
    shares = Shares([1], 0.5, 64, seeded(0), adapt=True, wins=torch.zeros(64, 2, 2))
    shares.observe(torch.ones(64, 1), torch.zeros(64, 2))
    assert not shares.wins.any()


@pytest.mark.parametrize(
    ("prior", "own", "ratio"),
    [
        ((0.0, 0.0), (0.0, 0.0), 1.0),
        ((0.0, 30.0), (0.0, 3.0), 1.0),  # nobody has won: it says nothing that one kind was tried more
        ((6.0, 8.0), (6.0, 8.0), 1.0),
        ((3.0, 40.0), (1.0, 40.0), 1.0),
        ((10.0, 4000.0), (30.0, 4000.0), 1 / 3),
        ((0.0, 1000.0), (1000.0, 1000.0), 1 / 20),
    ],
)
@pytest.mark.parametrize("share", [0.25, 0.5])
def test_the_odds_fall_by_the_ratio_of_how_often_candidates_were_the_best(prior, own, ratio, share):
    """But for the half decision that is counted besides: less than a tenth. The mean of the counts is exact; false
    alarms below 1e-6 (five standard errors of at most one half).
    """
    starts, drawn = 40_000, [80, 40]
    shares = Shares(drawn, share, starts, seeded(0), adapt=True, wins=wins(prior, own).expand(starts, 2, 2))
    fixed = torch.tensor([share * number for number in drawn]).round()
    found = shares.counts.double().mean(0)
    if ratio == 1:
        assert found.equal(fixed.double())
        return
    odds = share / (1 - share) * ratio
    least, most = odds / (1 + odds), 1.1 * odds / (1 + 1.1 * odds)
    assert (found > least / share * fixed - 5 / 2 / starts**0.5).all()
    assert (found < most / share * fixed + 5 / 2 / starts**0.5).all()
    assert shares.counts.amin() >= 0


def test_each_start_gets_as_many_candidates_of_each_kind_as_it_should():
    shares = Shares([5], 0.6, 64, seeded(0), adapt=True, wins=wins((1.0, 300.0), (2.0, 300.0)).expand(64, 2, 2))
    (own, proposed), counts = shares.most[0], shares.counts[:, 0]
    assert (own, proposed) == (5, 3)
    assert counts.min() == 2
    assert counts.max() == 3
    number = torch.arange(64)[:, None] * 100
    plans = shares.mixed(
        0, (number + torch.arange(own))[..., None, None], (number + 50 + torch.arange(proposed))[..., None, None]
    )
    for start, count in enumerate(counts.tolist()):
        wanted = [*range(5 - count), *range(50, 50 + count)]
        assert plans[start, :, 0, 0].tolist() == [100 * start + place for place in wanted]
        assert shares.is_prior(0)[start].tolist() == [place >= 50 for place in wanted]


@pytest.mark.parametrize("make", PLANNERS)
def test_each_run_learns_by_itself_whether_the_prior_helps(make):
    """In runs of even number its candidates are the best, in the others the worst: only there the share falls."""
    world = Preferring()
    how = {"prior": drift(world, std=1e-3), "prior_share": 0.5, "length": 2, "num_plans": 20, "std": 1.0}
    how |= {"iterations": 1} if make is ICEMPlanner else {}

    def of_prior(**more):
        planner, memory = make(**how, **more), None
        state = world.reset(40, seeded(0))
        world.of_prior.clear()
        for _ in range(12):
            decision = planner.plan(world, state, seeded(1), memory)
            # What was planned is forgotten: it would be as good as the best of the new candidates.
            memory = decision.memory._replace(mean=None, elites=None)
        number = torch.stack(world.of_prior).double()
        return number[:, ::2].mean(1), number[:, 1::2].mean(1)

    good, bad = of_prior()
    half = 10 + (make is ICEMPlanner)  # with the mean, which is in the middle, too
    assert good[0] == bad[0] == half
    assert good[-1] >= half - 1
    assert bad[-1] < half - 6
    good, bad = of_prior(adapt_share=False)
    assert good.tolist() == bad.tolist() == [half] * 12


@pytest.mark.parametrize("make", PLANNERS)
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_first_decision_is_that_of_a_fixed_share(make, share):
    world = Cart()
    state = world.reset(4, seeded(0))
    pair = [
        make(4, 12, prior=drift(world), prior_share=share, adapt_share=adapt).plan(world, state, seeded(1))
        for adapt in (True, False)
    ]
    assert pair[0].plan.equal(pair[1].plan)
    assert (pair[0].memory.wins is None) == (share != 0.3)
    assert pair[1].memory.wins is None


def test_wins_go_with_the_run_and_must_fit_it():
    world = Cart(last=4)
    state = world.reset(6, seeded(0))
    state[::2, 2] = 2  # these end earlier
    planner = ShootingPlanner(3, 8, prior=drift(world))
    memory = planner.plan(world, state, seeded(0)).memory
    moved = memory.moved_on(torch.zeros(6, 1, 2), torch.zeros(6, 1, 3), 0)
    assert moved.wins.equal(memory.wins)
    assert moved.rows(torch.tensor([4, 1])).wins.equal(memory.wins[[4, 1]])
    assert control(planner, world, state, 4, seeded(1)).plans.lengths.tolist() == [2, 4] * 3
    with refuses("`memory.wins` must have shape [6, ..., 2], got [3, 2, 2]"):
        planner.plan(world, state, seeded(0), memory._replace(wins=memory.wins[:3]))


@pytest.mark.parametrize("make", [ShootingPlanner, ICEMPlanner])
def test_nobody_wins_where_what_was_planned_before_is_the_best(make):
    """Vectors far from the middle are good; what is left of the last plan, or the elites, are at the bounds."""
    world = Preferring()
    state = world.reset(6, seeded(0))
    state[:, 0] = -1
    memory = Memory(torch.zeros(6, 1, 2), torch.zeros(6, 1, 3), wins=torch.zeros(6, 2, 2))
    best = world.action_high.expand(6, 2, 2)
    with_best = memory._replace(mean=best, elites=best[:, None])
    for given, won in ((memory, 6), (with_best, 0)):
        planner = make(2, 12, prior=drift(world, std=1e-3), std=0.05)
        assert int(planner.plan(world, state, seeded(1), given).memory.wins[..., 0].sum()) == won


def test_the_control_cost_is_that_of_own_candidates_where_shares_differ():
    """With the wins of the others, a run has as many candidates of the prior as alone, and the same average."""
    world = Cart()
    state = world.reset(2, seeded(0))
    how = {"prior": drift(world, std=0.3), "control_cost": True, "normalise": False, "temperature": 1.0}
    memory = Memory(torch.zeros(2, 1, 2), torch.zeros(2, 1, 3), mean=0.3 * torch.ones(2, 4, 2))
    counted = memory._replace(wins=torch.cat([wins((0.0, 90.0), (90.0, 90.0)), wins((9.0, 9.0), (1.0, 9.0))]))
    planner = MPPIPlanner(4, 10, **how)
    tried_plans = []
    world.rollout = lambda *args, **more: (tried_plans.append(args[1]), Cart.rollout(world, *args, **more))[1]
    plan = planner.plan(world, state, seeded(1), counted).plan
    counts = Shares([10], 0.5, 2, seeded(1), adapt=True, wins=counted.wins).counts[:, 0].tolist()
    middle, half = (world.action_low + world.action_high) / 2, (world.action_high - world.action_low) / 2
    for run, count in enumerate(counts):
        tried, mean = tried_plans[0][run], counted.mean[run]
        cost = ((mean - middle) / (0.5 * half).square() * (tried - mean)).sum((1, 2))
        cost[10 - count :] = 0
        score = Cart().rollout(state[run : run + 1], tried[None])[1][0].sum(-1)
        weights = (score - cost).double().softmax(0)
        wanted = (weights[:, None, None] * tried).sum(0).float().clamp(world.action_low, world.action_high)
        assert torch.allclose(plan[run], wanted, atol=1e-5)
    assert counts[0] < counts[1]


@pytest.mark.parametrize("share", [0.01, 0.25, 0.5, 0.75, 0.9, 0.99])
def test_the_first_iteration_has_candidates_of_both_kinds(share):
    """Also where the whole number of the prior's candidates would fill it, so that a share can fall."""
    for drawn in itertools.product(range(2, 9), range(9), range(9)):
        counts = Shares(drawn, share, 1, seeded(0)).counts[0].tolist()
        assert 1 <= counts[0] < drawn[0]
        assert all(0 <= count <= size for count, size in zip(counts, drawn, strict=True))
        total = sum(drawn)
        assert sum(counts) == min(max(round(share * total), 1), total - 1)
