"""The conformance suite of planners of vectors."""

from collections.abc import Callable
from functools import partial
from typing import Any, Self

import torch
from torch import Tensor

from neuroprior.control.planners.vector_planner import Memory, VectorDecision, VectorPlanner
from neuroprior.control.priors.vector_prior import GaussianForecast, VectorPrior
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.control.worlds.continuous_world import ContinuousWorld
from neuroprior.testing.rules import raises, require


def check_vector_planner(make: Callable[..., VectorPlanner], seed: int = 0) -> None:
    """Raise AssertionError, with a message that says how, unless a planner of vectors does what it must.

    From several starts and over several decisions: shapes are right; the plan is
    between the bounds, even where noise of the prior goes beyond them, and has the score that it says when it is
    executed (unless the planner `averages`), with many candidates a higher one than random plans have; its model steps
    are those that it takes, `num_plans * length`; the same seed gives the same decision, and torch's global generator
    is not used; equal starts get different random numbers, and no start's decision depends on the others; at
    `prior_share` 0 the prior changes nothing; it plans for no starts at all; rewards that are NaN, and a prior with
    other bounds than the world's, raise ValueError.

    Args:
        make: `make(length, num_plans, prior=, prior_share=)` returns the planner, as the classes themselves do.
        seed: draws worlds, starts and decisions.

    Raises:
        AssertionError: the planner breaks a rule.

    Example:
        >>> check_vector_planner(ShootingPlanner)
    """

    def make_planner(prior: VectorPrior, share: float, length: int, num_plans: int) -> VectorPlanner:
        planner = make(length, num_plans, prior=prior, prior_share=share)
        require(isinstance(planner, VectorPlanner), f"`make` must be a VectorPlanner, got {type(planner).__name__}")
        return planner

    world = _Mass()
    prior = _Normal(world.action_low, world.action_high)
    state = world.reset(12, torch.Generator().manual_seed(seed))
    for length, num_plans, share in ((1, 1, 0.0), (3, 2, 0.5), (4, 8, 0.0), (4, 8, 0.5), (5, 33, 1.0)):
        planner = make_planner(prior, share, length, num_plans)
        memory: Memory | None = None
        for _ in range(3):
            first = _check_decision(planner, world, state, memory, seed)
            memory = first.memory.moved_on(first.plan[:, :1], world.observe(state)[:, None], planner.keep)
            _check_rows(memory, state, length)
    wide = _Normal(world.action_low, world.action_high, 3.0)
    noisy = make_planner(wide, 1.0, 3, 64)
    noisy.prior_as = "noise"  # which goes beyond the bounds, and worlds refuse that
    try:
        noisy.plan(world, state)
    except ValueError as error:
        raise AssertionError(f"plan: with the prior's candidates as noise: {error}") from error
    for planner in (make_planner(prior, 0.0, 3, 64), make_planner(prior, 1.0, 3, 64), noisy):
        _check_choice(planner, _check_decision(planner, world, state, None, seed), world, state, seed)
    none = make_planner(prior, 0.5, 3, 4).plan(world, state[:0], torch.Generator().manual_seed(seed))
    require(none.plan.shape == (0, 3, 2), f"plan of no starts: plan {list(none.plan.shape)}, not [0, 3, 2]")
    _check_starts(make_planner(prior, 0.5, 3, 8), world, state, seed)
    plain = make_planner(_Normal(world.action_low, world.action_high, 0.1), 0.0, 4, 8)
    other = make_planner(prior, 0.0, 4, 8)
    pair = [each.plan(world, state, torch.Generator().manual_seed(seed)) for each in (plain, other)]
    require(pair[0].plan.equal(pair[1].plan), "prior_share: at 0 the plan depends on the prior")
    wrong = _Normal(world.action_low, world.action_high + 1)
    require(
        raises(partial(make_planner(wrong, 0.5, 3, 8).plan, world, state)),
        "plan must raise ValueError for a prior with other bounds than the world's",
    )
    broken = _Mass(torch.nan)
    require(raises(partial(plain.plan, broken, state)), "plan must raise ValueError for rewards that are NaN")


def _check_decision(
    planner: VectorPlanner, world: "_Mass", state: Tensor, memory: Memory | None, seed: int
) -> VectorDecision:
    """Its shapes, bounds, score, steps and random numbers."""
    batch, length = len(state), planner.length
    world.steps = 0
    before = torch.get_rng_state()
    decision = planner.plan(world, state, torch.Generator().manual_seed(seed), memory)
    steps = world.steps
    again = planner.plan(world, state, torch.Generator().manual_seed(seed), memory)
    planner.plan(world, state, None, memory)
    require(torch.get_rng_state().equal(before), "plan: torch's global generator was used")
    same = again.plan.equal(decision.plan) and again.score.equal(decision.score)
    require(same and again.model_steps == decision.model_steps, "plan: the same seed gave another decision")
    shapes = (decision.plan.shape, decision.score.shape)
    require(
        shapes == ((batch, length, 2), (batch,)),
        f"plan from {batch} starts: plan and score of shapes {[list(shape) for shape in shapes]}",
    )
    inside = (decision.plan >= world.action_low) & (decision.plan <= world.action_high)
    require(bool(inside.all()), "plan: a vector is not between the bounds")
    taken = decision.model_steps
    require(
        steps == taken * batch and taken == planner.num_plans * length,
        f"model_steps: {taken}, of {planner.num_plans} candidates of {length} vectors; {steps / batch:g} were taken",
    )
    reached = world.rollout(state, decision.plan[:, None])
    weights = planner.discount ** torch.arange(length, dtype=torch.float64)
    score = (reached.rewards[:, 0].double() * weights).sum(-1)
    if planner.value is not None:
        score = score + planner.discount**length * planner.value(reached.final_state[:, 0]).view(-1).double()
    near = torch.isclose(decision.score.double(), score, rtol=1e-4, atol=1e-5)
    require(planner.averages or bool(near.all()), "score: not that of the plan when it is executed")
    return decision


def _check_choice(planner: VectorPlanner, decision: VectorDecision, world: "_Mass", state: Tensor, seed: int) -> None:
    """What is chosen of many candidates has a higher score than random plans have in the mean."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(len(state), 64, *decision.plan.shape[1:], generator=generator)
    plans = torch.lerp(world.action_low, world.action_high, drawn)
    reached, chance = (
        planner.scores(world, state, candidates, generator).mean() for candidates in (decision.plan[:, None], plans)
    )
    require(bool(reached > chance), f"plan: its score is {reached:.3g} in the mean, that of random plans {chance:.3g}")


def _check_rows(memory: Memory, state: Tensor, length: int) -> None:
    for name, values in (("mean", memory.mean), ("elites", memory.elites)):
        if values is not None:
            shape = (len(values), *values.shape[-2:])
            require(
                shape == (len(state), length - 1, 2), f"memory: {name} of shape {list(values.shape)}, moved on once"
            )


def _check_starts(planner: VectorPlanner, world: "_Mass", state: Tensor, seed: int) -> None:
    """Equal starts get independent decisions, and a start's does not depend on what the others are, or have met.

    The planner draws the same numbers for as many starts, so a start's own decision is the same beside any others.
    """
    equal = state[:1].expand(12, -1)
    decision = planner.plan(world, equal, torch.Generator().manual_seed(seed))
    different = decision.plan.flatten(1).unique(dim=0).shape[0]
    require(different == 12, f"plan: of 12 equal starts only {different} have plans of their own")
    beside = torch.cat([state[:1], state[1:] + 5])
    memories: list[Memory | None] = [None, None]
    for _ in range(3):
        pair = [
            planner.plan(world, starts, torch.Generator().manual_seed(seed), memory)
            for starts, memory in zip((state, beside), memories, strict=True)
        ]
        require(
            torch.allclose(pair[0].plan[0], pair[1].plan[0], atol=1e-6),
            "plan: what is decided for a start depends on the other starts",
        )
        memories = [
            each.memory.moved_on(each.plan[:, :1], world.observe(starts)[:, None], planner.keep)
            for each, starts in zip(pair, (state, beside), strict=True)
        ]


class _Mass(ContinuousWorld):
    """A point in the plane that vectors push towards a place near the origin; it counts the steps taken in it."""

    def __init__(self, extra: float = 0.0) -> None:
        self.action_low, self.action_high = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 3.0])
        self.extra, self.steps = extra, 0

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        return torch.randn(batch_size, 2, generator=generator)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        self.steps += len(state)
        state = state + 0.5 * (action - torch.tensor([0.0, 1.0]))
        return state, self.extra - (state - 0.1).square().sum(1)


class _Normal(VectorPrior):
    """Independent vectors around the middle of the range."""

    memory = 0

    def __init__(self, action_low: Any, action_high: Any, std: float = 0.3) -> None:
        super().__init__(action_low, action_high)
        self.std = std

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        mean = ((self.action_low + self.action_high) / 2).expand(batch_size, 1, -1)
        return GaussianForecast(mean, torch.full_like(mean, self.std), self.action_low, self.action_high), mean[:, 0]

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        return self.start(len(action))

    def fit(self, plans: VectorPlans, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        return self
