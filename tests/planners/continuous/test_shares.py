"""How many candidates a prior proposes: a fixed share, and one that follows from what its candidates have added."""

from math import log

import pytest
import torch

from neuroprior.planners.continuous import ICEMPlanner, Memory, MPPIPlanner, ShootingPlanner, control
from neuroprior.planners.continuous.shares import EVEN, KEPT, LEAST, Shares
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


def added(prior, own):
    """As `Shares.added` of one start: amounts and numbers."""
    return torch.tensor([[prior, own]], dtype=torch.float)


@pytest.mark.parametrize(
    ("scores", "others", "amounts"),
    [
        # Of six candidates the last two are the prior's.
        ([0.0, 1.0, 2.0, 3.0, 9.0, 4.0], None, (5.0, 0.0)),
        ([0.0, 1.0, 2.0, 9.0, 3.0, 4.0], None, (0.0, 5.0)),
        ([0.0, 1.0, 2.0, 3.0, 9.0, 4.0], [7.0], (2.0, 0.0)),
        ([0.0, 1.0, 2.0, 3.0, 9.0, 4.0], [10.0], (0.0, 0.0)),
        ([0.0, 9.0, 2.0, 3.0, 9.0, 4.0], None, (0.0, 0.0)),
        ([-torch.inf, 9.0, -torch.inf, -torch.inf, -torch.inf, -torch.inf], None, (0.0, 0.0)),
        ([-torch.inf, 9.0, -torch.inf, -torch.inf, 8.0, -torch.inf], None, (0.0, 1.0)),
    ],
)
def test_a_candidate_adds_what_the_best_score_would_lack_without_it(scores, others, amounts):
    shares = Shares([6], 1 / 3, 1, seeded(0), adapt=True)
    shares.observe(0, torch.tensor([scores]), None if others is None else torch.tensor([others]))
    assert shares.added.tolist() == [[[amounts[0], 2.0], [amounts[1], 4.0]]]


def test_later_iterations_add_to_the_best_of_those_before():
    shares = Shares([4, 2], 0.5, 1, seeded(0), adapt=True)
    assert shares.counts.tolist() == [[2, 1]]
    shares.observe(0, torch.tensor([[0.0, 1.0, 2.0, 5.0]]))
    shares.observe(1, torch.tensor([[6.5, 4.0]]))
    assert shares.added.tolist() == [[[3.0, 3.0], [1.5, 3.0]]]
    later = Shares([4, 2], 0.5, 1, seeded(0), adapt=True, added=shares.added)
    assert torch.allclose(later.added, KEPT * shares.added)


def test_iterations_with_one_kind_of_candidates_say_nothing():
    """Else a kind that is hardly tried would be judged by other iterations than the other kind."""
    shares = Shares([3, 3], 0.5, 1, seeded(0), adapt=True, iterations=1)
    assert shares.counts.tolist() == [[2, 0]]
    shares.observe(0, torch.tensor([[0.0, 1.0, 2.0]]))
    shares.observe(1, torch.tensor([[0.0, 1.0, 9.0]]))
    assert shares.added.tolist() == [[[1.0, 2.0], [0.0, 1.0]]]


@pytest.mark.parametrize(
    ("prior", "own", "ratio"),
    [
        ((0.0, 0.0), (0.0, 0.0), 1.0),
        ((0.0, 30.0), (0.0, 3.0), 1.0),  # nothing has added anything: it says nothing that one kind was tried more
        ((6.0, 8.0), (6.0, 8.0), 1.0),
        ((0.0, 12.0), (12.0, 8.0), (EVEN * 0.6 / (12 + EVEN)) / ((12 + EVEN * 0.6) / (8 + EVEN))),
        ((0.0, 1000.0), (1000.0, 1000.0), LEAST),
        ((12.0, 8.0), (0.0, 12.0), 1.0),
        ((1e30, 1000.0), (0.0, 1000.0), 1.0),
    ],
)
@pytest.mark.parametrize("share", [0.25, 0.5])
def test_the_odds_fall_by_the_ratio_of_what_candidates_add(prior, own, ratio, share):
    """The mean number is exact; false alarms below 1e-6 (five standard errors of at most one half each)."""
    starts, drawn = 40_000, [7, 4]
    shares = Shares(drawn, share, starts, seeded(0), adapt=True, added=added(prior, own).expand(starts, 2, 2))
    odds = share / (1 - share) * ratio
    wanted = odds / (1 + odds) * torch.tensor(drawn)
    assert torch.allclose(shares.counts.double().mean(0), wanted.double(), atol=5 / starts**0.5)
    assert (shares.counts >= 0).all()
    assert (shares.counts <= torch.tensor(drawn)).all()
    own_most, prior_most = torch.tensor(shares.most).unbind(1)
    assert prior_most.tolist() == shares.counts.amax(0).tolist()
    assert own_most.tolist() == (torch.tensor(drawn) - shares.counts).amax(0).tolist()


def test_each_start_gets_as_many_candidates_of_each_kind_as_it_should():
    shares = Shares([5], 0.5, 64, seeded(0), adapt=True, added=torch.zeros(64, 2, 2))
    (own, proposed), counts = shares.most[0], shares.counts[:, 0]
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
    assert (pair[0].memory.added is None) == (share != 0.3)
    assert pair[1].memory.added is None


def test_what_was_added_goes_with_the_run_and_must_fit_it():
    world = Cart(last=4)
    state = world.reset(6, seeded(0))
    state[::2, 2] = 2  # these end earlier
    planner = ShootingPlanner(3, 8, prior=drift(world))
    memory = planner.plan(world, state, seeded(0)).memory
    moved = memory.moved_on(torch.zeros(6, 1, 2), torch.zeros(6, 1, 3), 0)
    assert moved.added.equal(memory.added)
    assert moved.rows(torch.tensor([4, 1])).added.equal(memory.added[[4, 1]])
    assert control(planner, world, state, 4, seeded(1)).plans.lengths.tolist() == [2, 4] * 3
    with refuses("memory: added of shape [6, 2, 2] is expected, not [3, 2, 2]"):
        planner.plan(world, state, seeded(0), memory._replace(added=memory.added[:3]))


@pytest.mark.parametrize("make", PLANNERS)
def test_rewards_that_are_all_equal_leave_the_share_as_it_is(make):
    world = Preferring()
    world.step = lambda state, action, generator=None: (state, torch.zeros(len(state)))
    planner = make(2, 20, prior=drift(world, std=1e-9), prior_share=0.5)
    memory, state = None, world.reset(1000, seeded(0))
    for _ in range(4):
        decision = planner.plan(world, state, seeded(1), memory)
        memory = decision.memory._replace(mean=None, elites=None)
    assert not memory.added[..., 0].any()
    ratio = memory.added[:, 0, 1].sum() / memory.added[..., 1].sum()
    assert log(ratio / (1 - ratio)) == pytest.approx(0, abs=0.35)


def test_no_runs_and_a_single_candidate():
    world = Cart()
    planner = ShootingPlanner(3, 1, prior=drift(world))
    memory = Memory(torch.zeros(0, 1, 2), torch.zeros(0, 1, 3), added=torch.zeros(0, 2, 2))
    assert planner.plan(world, world.reset(0), seeded(0), memory).plan.shape == (0, 3, 2)
    counts = Shares([1], 0.5, 10_000, seeded(0), adapt=True, added=torch.zeros(10_000, 2, 2)).counts
    assert counts.double().mean() == pytest.approx(0.5, abs=0.025)
