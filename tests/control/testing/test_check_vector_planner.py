"""Every planner of vectors passes `check_planner`, and planners that break a rule do not."""

from functools import partial

import pytest
import torch

from neuroprior.control import (
    ICEMPlanner,
    MPPIPlanner,
    ShootingPlanner,
    VectorDecision,
    VectorPlanner,
    check_vector_planner,
)
from tests.support.sources import refuses

PLANNERS = {
    "shooting": ShootingPlanner,
    "coloured": partial(ShootingPlanner, noise_beta=2.0),
    "icem": ICEMPlanner,
    "all": partial(ICEMPlanner, prior_iterations=None, iterations=2),
    "mppi": MPPIPlanner,
    "plain": partial(MPPIPlanner, normalise=False, control_cost=True),
    "value": partial(ICEMPlanner, discount=0.8, value=lambda state: state[:, 0]),
    "far": partial(ShootingPlanner, value=lambda state: 50 * state.norm(dim=-1)),
}


@pytest.mark.parametrize("make", PLANNERS.values(), ids=PLANNERS)
def test_planners_of_vectors_conform(make):
    check_vector_planner(make)


def spoilt(spoil):
    class Spoilt(ShootingPlanner):
        def plan(self, world, state, generator=None, memory=None):
            return spoil(super().plan(world, state, generator, memory), world)

    return Spoilt


def remembering(mean, elites=None):
    """Keeps another mean, or elites that are made of it."""

    def spoil(decision, world):
        changed = {"mean": mean} if mean else {"elites": elites}
        changed = {name: change(decision.memory.mean) for name, change in changed.items()}
        return decision._replace(memory=decision.memory._replace(**changed))

    return spoilt(spoil)


class Careless(ShootingPlanner):
    """Reads the global generator."""

    def plan(self, world, state, generator=None, memory=None):
        torch.rand(1)
        return super().plan(world, state, generator, memory)


class Unchecked(ShootingPlanner):
    """Never looks at the prior's bounds."""

    def begin(self, world, state, generator, memory):
        prior, self.prior = self.prior, None
        try:
            return super().begin(world, state, generator, memory)
        finally:
            self.prior = prior


class Together(ShootingPlanner):
    """Decides for all starts as for the first."""

    def plan(self, world, state, generator=None, memory=None):
        decision = super().plan(world, state, generator, memory)
        if not len(state):
            return decision
        plan = decision.plan[:1].expand_as(decision.plan)
        score = self.scores(world, state, plan[:, None], generator)[:, 0]
        return decision._replace(plan=plan, score=score)


class Eager(ShootingPlanner):
    """Draws from the prior whatever its share."""

    def proposals(self, shares, world, state, memory, generator):
        self.prior.sample(1, self.length, past=memory.past, generator=generator)
        spread = float(self.prior.std)
        torch.rand(int(10 * spread), generator=generator)
        return super().proposals(shares, world, state, memory, generator)


class Mingling(ShootingPlanner):
    """Searches around the mean of what all runs planned."""

    def plan(self, world, state, generator=None, memory=None):
        if memory is not None and len(state):
            memory = memory._replace(mean=memory.mean.mean(0, keepdim=True).expand_as(memory.mean))
        return super().plan(world, state, generator, memory)


class OfSamples(VectorPlanner):
    """Chooses one of some plans: the best, or the worst; between the bounds, or not."""

    def __init__(self, *given, worst=False, clamped=True, **how):
        super().__init__(*given, **how)
        self.worst, self.clamped = worst, clamped

    def plan(self, world, state, generator=None, memory=None):
        generator, memory = self.begin(world, state, generator, memory)
        low, high = world.action_low, world.action_high
        shares = self.shares([self.num_plans], memory, generator)
        (proposed,) = self.proposals(shares, world, state, memory, generator)
        own = torch.rand(len(state), shares.most[0][0], self.length, world.action_size, generator=generator)
        middle = ((low + high) / 2).expand(len(state), self.length, -1)
        plans = shares.mixed(0, torch.lerp(low, high, own), self.around(middle, proposed))
        plans = plans.clamp(low, high) if self.clamped else plans
        score = self.scores(world, state, plans, generator)
        shares.observe(score)
        best, row = score.argmin(1) if self.worst else score.argmax(1), torch.arange(len(state))
        kept = memory._replace(mean=plans[row, best], wins=shares.wins)
        return VectorDecision(plans[row, best], score[row, best], self.num_plans * self.length, kept)


def test_a_planner_of_ones_own_conforms():
    check_vector_planner(OfSamples)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (partial(OfSamples, worst=True), "random plans"),
        (partial(OfSamples, clamped=False), "must be between the bounds"),
        (spoilt(lambda decision, world: decision._replace(score=decision.score + 1)), "score"),
        (spoilt(lambda decision, world: decision._replace(plan=decision.plan + 5)), "bounds"),
        (spoilt(lambda decision, world: decision._replace(plan=decision.plan[:, :, :1])), "shapes"),
        (spoilt(lambda decision, world: decision._replace(model_steps=decision.model_steps + 1)), "model_steps"),
        (remembering(lambda mean: mean[:1]), "memory: mean of shape [1, "),
        (remembering(lambda mean: mean[:, 1:]), "memory: mean"),
        (remembering(lambda mean: mean[..., :1]), "memory: mean"),
        (remembering(None, lambda mean: mean[:1, None]), "memory: elites of shape [1, "),
        (Careless, "global generator"),
        (Unchecked, "bounds"),
        (Together, "model_steps"),
        (Eager, "prior_share"),
        (Mingling, "depends on the other starts"),
    ],
)
def test_planners_that_break_a_rule_are_found(make, word):
    with refuses(word, error=AssertionError):
        check_vector_planner(make)
