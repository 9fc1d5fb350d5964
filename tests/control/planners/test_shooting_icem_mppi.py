"""Shooting, iCEM and MPPI: what a prior adds, how budgets are divided, and what they find."""

import pytest
import torch

from neuroprior.control import ContinuousWorld, ICEMPlanner, Memory, MPPIPlanner, ShootingPlanner, coloured_noise
from tests.support.sources import refuses, seeded
from tests.support.vectors import Cart, drift

PLANNERS = [ShootingPlanner, ICEMPlanner, MPPIPlanner]


class Seen(Cart):
    """Keeps the candidates that are tried in it."""

    def __init__(self):
        super().__init__()
        self.tried = []

    def rollout(self, state, plans, generator=None, keep_states=False):
        self.tried.append(plans)
        return super().rollout(state, plans, generator, keep_states)


class Constant(ContinuousWorld):
    """All plans are equally good."""

    def __init__(self, reward=0.0):
        self.action_low, self.action_high, self.reward = -torch.ones(1), torch.ones(1), reward

    def reset(self, batch_size, generator=None):
        return torch.zeros(batch_size, 1)

    def step(self, state, action, generator=None):
        return state, torch.full((len(state),), self.reward)


@pytest.mark.parametrize("make", PLANNERS)
@pytest.mark.parametrize(("share", "number"), [(0.0, 0), (0.01, 1), (0.25, 10), (0.5, 20), (0.99, 39), (1.0, 40)])
def test_the_share_is_that_of_all_candidates_that_are_drawn(make, share, number):
    """The prior's candidates are all alike here, and at a vector that noise never meets."""
    world = Seen()
    prior = drift(world, std=1e-9)
    everywhere = {"prior_iterations": None} if make is ICEMPlanner else {}
    planner = make(5, 41 if make is ICEMPlanner else 40, prior=prior, prior_share=share, **everywhere)
    planner.plan(world, world.reset(3, seeded(0)), seeded(1))
    tried = torch.cat(world.tried, 1)[:, :40]  # after these iCEM tries the mean
    middle = (world.action_low + world.action_high) / 2
    alike = ((tried - middle).abs() < 1e-6).flatten(2).all(2).sum(1)
    assert alike.tolist() == [number] * 3


@pytest.mark.parametrize("make", PLANNERS)
def test_a_prior_goes_on_from_the_past_and_the_context(make):
    """With hardly any noise all candidates of a share of 1 are known."""
    world = Seen()
    state = world.reset(2, seeded(0))
    past = torch.tensor([[[0.3, 0.2]], [[-0.4, 0.1]]])
    memory = Memory(past, world.observe(state)[:, None])
    make(4, 6, prior=drift(world, std=1e-9), prior_share=1.0).plan(world, state, seeded(1), memory)
    tried = world.tried[0]
    assert torch.allclose(tried[:, 0], past.expand(2, 4, 2), atol=1e-6)
    world.tried.clear()
    state[:, 0] = torch.tensor([0.1, -0.2])
    make(4, 6, prior=drift(world, std=1e-9, context_size=3), prior_share=1.0).plan(world, state, seeded(1))
    middle = (world.action_low + world.action_high) / 2
    wanted = (middle + state[:, :1]).clamp(world.action_low, world.action_high)
    assert torch.allclose(world.tried[0][:, 0], wanted[:, None].expand(2, 4, 2), atol=1e-6)


@pytest.mark.parametrize("make", PLANNERS)
def test_noise_of_a_prior_is_around_the_mean(make):
    """Whatever the prior goes on with; its variance is that of a random walk, .1 * t, with false alarms below 1e-6."""
    world = Seen()
    state = world.reset(1, seeded(0))
    mean = torch.tensor([[[0.1, 0.2], [0.0, 0.3], [-0.2, 0.25]]])
    memory = Memory(torch.full((1, 1, 2), 0.4), world.observe(state)[:, None], mean)
    prior = drift(world, std=1e-9)
    make(3, 9, prior=prior, prior_share=1.0, prior_as="noise").plan(world, state, seeded(1), memory)
    assert torch.allclose(world.tried[0], mean[:, None].expand(1, world.tried[0].shape[1], 3, 2), atol=1e-6)
    world.tried.clear()
    free = drift(world, std=0.01)
    planner = make(3, 4000, prior=free, prior_share=1.0, prior_as="noise")
    planner.plan(world, state, seeded(1), memory._replace(past=torch.full((1, 1, 2), 0.25)))
    tried = world.tried[0][0] - mean[0]
    variance, count = tried.square().mean((0, 2)), 2 * len(tried)
    assert torch.allclose(variance / variance[0], torch.tensor([1.0, 2.0, 3.0]), rtol=5 * 2 * (2 / count) ** 0.5)
    assert variance[0].sqrt() == pytest.approx(0.01, rel=5 * (0.5 / count) ** 0.5)


def test_icem_scales_noise_of_a_prior_as_its_own():
    """The second round is the mean and the spread of the elites of the first, times the same proposals."""
    world = Seen()
    state = world.reset(1, seeded(0))
    how = {"prior": drift(world, std=0.1), "prior_share": 1.0, "prior_as": "noise", "prior_iterations": None}
    planner = ICEMPlanner(3, 60, iterations=2, std=0.7, **how)
    planner.plan(world, state, seeded(1))
    first, second = (tried[0] for tried in world.tried)
    elites = first[world.rollout(state, first[None])[1][0].sum(-1).topk(planner.num_elites).indices]
    half = (world.action_high - world.action_low) / 2
    middle = (world.action_low + world.action_high) / 2
    mean = 0.9 * elites.mean(0) + 0.1 * middle
    std = 0.9 * elites.std(0, correction=0) + 0.1 * 0.7 * half
    drawn = drift(world, std=0.1).sample(2 * 59, 3, past=torch.zeros(1, 0, 2), generator=seeded(1))[0]
    noise = ((drawn[:59] - drawn[59:]) / 2**0.5)[len(first) :]
    wanted = (mean + std / (0.7 * half) * noise).clamp(world.action_low, world.action_high)
    assert torch.allclose(second[:-1], wanted, atol=1e-5)
    assert torch.allclose(second[-1], mean, atol=1e-6)


@pytest.mark.parametrize(
    ("number", "sizes", "elites"),
    [
        (97, [40, 32, 25], 10),
        (128, [52, 42, 34], 10),
        (16, [7, 5, 4], 2),
        (8, [4, 4], 2),
        (5, [5], 2),
        (3, [3], 2),
        (1, [1], 2),
    ],
)
def test_a_budget_is_divided_exactly(number, sizes, elites):
    world = Seen()
    planner = ICEMPlanner(3, number)
    decision = planner.plan(world, world.reset(2, seeded(0)), seeded(1))
    assert planner.populations == sizes
    assert planner.num_elites == elites
    assert [plans.shape[1] for plans in world.tried] == sizes
    assert decision.model_steps == number * 3
    world.tried.clear()
    planner.plan(world, world.reset(2, seeded(0)), seeded(1), decision.memory)
    assert [plans.shape[1] for plans in world.tried] == sizes


def test_warm_started_shooting_is_never_worse_than_the_last_plan():
    world = Cart()
    state = world.reset(50, seeded(0))
    planner = ShootingPlanner(6, 4)
    memory, last = None, torch.full((50,), -torch.inf)
    for seed in range(5):
        decision = planner.plan(world, state, seeded(seed), memory)
        assert (decision.score >= last).all()
        memory, last = decision.memory, decision.score


@pytest.mark.parametrize("make", [ShootingPlanner, ICEMPlanner])
def test_ties_are_broken_at_random(make):
    """Of equally good candidates each wins equally often, the last one as the first; 1,000 starts that differ in
    nothing, and a binomial bound at a false-alarm probability of 1e-6."""
    world = Constant()
    decision = make(3, 8).plan(world, world.reset(1000), seeded(0))
    positive = int((decision.plan[:, 0, 0] > 0).sum())
    assert abs(positive - int((decision.plan[:, 0, 0] < 0).sum())) < 4.9 * 1000**0.5
    assert decision.plan.flatten(1).unique(dim=0).shape[0] > 800


@pytest.mark.parametrize("make", PLANNERS)
def test_a_reward_that_is_no_number_is_named(make):
    with refuses("`score` must be a number, got NaN"):
        make(3, 4).plan(Constant(float("nan")), torch.zeros(2, 1), seeded(0))
    if make is MPPIPlanner:
        with refuses("infinite"):
            make(3, 4).plan(Constant(-float("inf")), torch.zeros(2, 1), seeded(0))


@pytest.mark.parametrize("make", PLANNERS)
def test_the_objective_has_a_discount_and_a_value(make):
    world = Seen()
    state = world.reset(3, seeded(0))
    planner = make(4, 1, discount=0.5, value=lambda final: 3 * final[:, 0])
    decision = planner.plan(world, state, seeded(1))
    done = world.rollout(state, world.tried[0])
    weights = torch.tensor([1, 0.5, 0.25, 0.125])
    wanted = (done.rewards[:, 0] * weights).sum(1) + 3 * done.final_state[:, 0, 0] / 16
    assert torch.allclose(decision.score, wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("make", "how", "word"),
    [
        (ICEMPlanner, {"elites": 0}, "elites"),
        (ICEMPlanner, {"iterations": 0}, "iterations"),
        (ICEMPlanner, {"prior_iterations": 0}, "prior_iterations"),
        (MPPIPlanner, {"control_cost": True, "noise_beta": 1.0}, "`noise_beta` must be 0"),
        (MPPIPlanner, {"prior_share": 0.5}, "prior_share"),
        (MPPIPlanner, {"prior": 3}, "`prior` must be a VectorPrior, got int"),
        (MPPIPlanner, {"prior_as": "changes"}, "`prior_as`"),
        (ShootingPlanner, {"adapt_share": "no"}, "adapt_share"),
    ],
)
def test_bad_settings_are_named(make, how, word):
    with refuses(word):
        make(3, 8, **how)


@pytest.mark.parametrize("make", PLANNERS)
def test_a_prior_with_other_bounds_and_a_memory_of_other_runs_are_refused(make):
    world = Cart()
    state = world.reset(2, seeded(0))
    with refuses("prior", "action_low"):
        make(3, 8, prior=drift(Constant())).plan(world, state, seeded(0))
    with refuses("memory"):
        make(3, 8).plan(world, state, seeded(0), Memory(torch.zeros(3, 0, 2), torch.zeros(3, 0, 3)))
    decision = make(3, 8).plan(world, state, seeded(0))
    with refuses("decision.memory"):
        make(3, 8).plan(world, state, seeded(0), decision)
    with refuses("`memory.elites` must have shape [2, ..., 2], got [3, 1, 2, 2]"):
        make(3, 8).plan(world, state, seeded(0), decision.memory._replace(elites=torch.zeros(3, 1, 2, 2)))


@pytest.mark.parametrize("length", [2, 7, 20])
@pytest.mark.parametrize("beta", [0.0, 0.5, 2.0, 4.0])
def test_the_noise_has_its_spectrum(length, beta):
    """40,000 plans: the power of each frequency within 6 standard errors of the power law."""
    noise = coloured_noise((40_000, length, 1), beta, seeded(0))[..., 0].double()
    power = torch.fft.rfft(noise).abs().square()
    mean, error = power.mean(0), power.std(0) / 200
    frequency = torch.fft.rfftfreq(length).clamp(min=1 / length).double()
    wanted = frequency**-beta
    wanted = wanted * mean[1] / wanted[1]
    assert ((mean - wanted).abs() < 6 * (error + error[1] * wanted / wanted[1])).all()
    if beta:
        assert noise.var(1, correction=0).mean() == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("scale", [1e-25, 1e-12, 1e20, 1e30])
def test_mppi_weighs_candidates_by_rewards_of_any_size(scale):
    class Scaled(Cart):
        def step(self, state, action, generator=None):
            state, reward = super().step(state, action, generator)
            return state, reward * self.scale

    decisions = []
    for size in (1.0, scale):
        world = Scaled()
        world.scale = size
        decisions.append(MPPIPlanner(3, 8).plan(world, world.reset(4, seeded(1)), seeded(0)).plan)
    assert torch.allclose(*decisions, atol=1e-4)


@pytest.mark.parametrize("make", [ICEMPlanner, MPPIPlanner, ShootingPlanner])
def test_a_prior_that_takes_other_features_is_refused(make):
    world = Cart()  # shows three numbers
    planner = make(3, 8, prior=drift(world, context_size=2), prior_share=0.5)
    with refuses("`prior` must take the features of the world, [3], got one that takes 2"):
        planner.plan(world, world.reset(2))
