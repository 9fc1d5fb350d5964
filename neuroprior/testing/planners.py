"""The conformance suite of planners."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from neuroprior._checks import is_integer
from neuroprior.planners import Decision, Planner, oracle
from neuroprior.priors import Prior, UniformPrior
from neuroprior.testing.chi_square import chi_square
from neuroprior.testing.rules import FALSE_ALARM, raises, require
from neuroprior.worlds import TabularWorld, World

Make = Callable[[Prior, int, int], Planner]


def check_planner(make: Make, enough: int = 512, seed: int = 0) -> None:
    """Raise AssertionError, with a message that says how, unless a planner does what a planner must.

    In small random tables, where all or only some actions are legal: a decision has the right shapes, its plan is legal
    and has the score and the final state that it says; it never beats the oracle, and equals it with a large budget;
    its model steps are exactly the simulator steps that it takes per start; the same seed gives the same decision, and
    torch's global generator is not used; it plans for no starts at all; ties are broken uniformly at random (a
    chi-square test with a false-alarm probability of 1e-6); states that are not the world's raise ValueError.

    Args:
        make: `make(prior, length, num_plans)` returns the planner; one that takes no prior, or no number of plans,
            ignores it. All must have the same objective.
        enough: a number of plans with which it must find the best of 16.
        seed: draws worlds, starts and decisions.

    Raises:
        AssertionError: the planner breaks a rule.

    Example:
        >>> check_planner(SamplingPlanner)
    """
    for legal in (False, True):
        world = _random_table(2, legal, seed)
        state = world.reset(20, torch.Generator().manual_seed(seed))
        for length, num_plans in ((1, 1), (3, 2), (4, enough)):
            planner = make(UniformPrior(2), length, num_plans)
            require(isinstance(planner, Planner), f"`make` must be a Planner, got {type(planner).__name__}")
            decision = planner.plan(world, state, torch.Generator().manual_seed(seed))
            require(isinstance(decision, Decision), f"`plan` must be a Decision, got {type(decision).__name__}")
            _check_decision(planner, world, state, decision, length)
            _check_against_oracle(planner, world, state, decision, length, num_plans >= enough)
            _check_seed(planner, world, state, decision, seed)
            if not legal:
                _check_steps(planner, world, state if num_plans < enough else state[:1], seed)
        none = make(UniformPrior(2), 3, 4).plan(world, state[:0], torch.Generator().manual_seed(seed))
        require(none.plan.shape == (0, 3), f"plan of no starts: plan {list(none.plan.shape)}, not [0, 3]")
    _check_ties(make(UniformPrior(3), 2, 9), seed)
    planner = make(UniformPrior(2), 3, 4)
    for wrong, what in ((state + 10**6, "states that do not exist"), (state.double(), "states that are no integers")):
        require(raises(partial(planner.plan, world, wrong)), f"plan must raise ValueError for {what}")


def _random_table(actions: int, legal: bool, seed: int) -> TabularWorld:
    """Twelve states, all with different rewards."""
    generator = torch.Generator().manual_seed(seed)
    table = torch.randint(12, (12, actions), generator=generator)
    allowed = torch.rand(12, actions, generator=generator) < 0.6
    allowed[torch.arange(12), torch.randint(actions, (12,), generator=generator)] = True
    return TabularWorld(table, torch.rand(12, generator=generator), allowed if legal else None)


def _check_decision(planner: Planner, world: TabularWorld, state: Tensor, decision: Decision, length: int) -> None:
    """Its shapes, and its plan when it is executed step by step."""
    shapes = (decision.plan.shape, decision.score.shape, decision.final_state.shape)
    batch = len(state)
    require(
        shapes == ((batch, length), (batch,), state.shape),
        f"plan from {batch} starts: plan, score and final_state of shapes {[list(shape) for shape in shapes]}",
    )
    require(decision.score.is_floating_point(), f"`score` must be floating point, got {decision.score.dtype}")
    require(is_integer(decision.plan), f"`plan` must be integers, got {decision.plan.dtype}")
    last = torch.full((batch,), length) if decision.lengths is None else decision.lengths
    require(bool(((last >= 1) & (last <= length)).all()), f"`lengths` must be from 1 to {length}, got {last}")
    now, rewards, states = state, [], []
    for t in range(length):
        action = decision.plan[:, t].long()
        legal = world.legal_actions(now).gather(1, action[:, None])[:, 0] | (last <= t)
        require(bool(legal.all()), f"plan: its action {t} is not legal where it is taken")
        now, reward = world.step(now, action)
        rewards.append(reward)
        states.append(now)
    row, trajectory = torch.arange(batch), torch.stack(states, 1)
    prefixes = planner.for_world(world).prefix_scores(torch.stack(rewards, 1), trajectory)
    # The planner's own sums may be in another order.
    near = torch.isclose(decision.score.double(), prefixes[row, last - 1].double(), rtol=1e-4, atol=1e-5)
    require(bool(near.all()), "score: not that of the plan when it is executed")
    require(trajectory[row, last - 1].equal(decision.final_state), "final_state: not where the plan ends")


def _check_against_oracle(
    planner: Planner, world: TabularWorld, state: Tensor, decision: Decision, length: int, must: bool
) -> None:
    best = oracle(world, state, length, **planner.goal)
    gap = best.double() - decision.score.double()
    require(bool((gap >= -1e-5).all()), f"score: {float(-gap.min())} above the optimum")
    require(not must or bool((gap <= 1e-5).all()), f"score: {float(gap.max())} below the best, with enough plans")


def _check_seed(planner: Planner, world: TabularWorld, state: Tensor, decision: Decision, seed: int) -> None:
    before = torch.get_rng_state()
    again = planner.plan(world, state, torch.Generator().manual_seed(seed))
    same = again.plan.equal(decision.plan) and again.score.equal(decision.score)
    require(same and again.model_steps == decision.model_steps, "plan: the same seed gave another decision")
    planner.plan(world, state)
    require(torch.get_rng_state().equal(before), "plan: torch's global generator was used")


def _check_steps(planner: Planner, world: TabularWorld, state: Tensor, seed: int) -> None:
    """The model steps are the simulator steps taken for a single start; from several, they are not those of all."""
    most = 0
    for one in state[:8, None]:
        counting = _Counting(world)
        decision = planner.plan(counting, one, torch.Generator().manual_seed(seed))
        reported, taken = decision.model_steps, counting.steps
        require(reported == taken, f"model_steps: {reported} are given, but {taken} simulator steps were taken")
        most = max(most, taken)
    reported = planner.plan(world, state[:8], torch.Generator().manual_seed(seed)).model_steps
    require(
        reported < 2 * most or not reported,
        f"`model_steps` must be those of one start, at most {most}, got {reported} of 8 starts",
    )


def _check_ties(planner: Planner, seed: int) -> None:
    """Nine equally good plans of two actions, each to a cell of its own."""
    if planner.value is not None:
        return
    world = TabularWorld(torch.arange(39).view(13, 3).add(1).clamp(max=12), torch.ones(13))
    state = torch.zeros(9000, dtype=torch.long)
    decision = planner.plan(world, state, torch.Generator().manual_seed(seed))
    number, kinds = decision.plan[:, 0].long(), 3
    if decision.lengths is None:
        number, kinds = number * 3 + decision.plan[:, 1].long(), 9
    counts = number.bincount(minlength=kinds)
    p = chi_square(counts, torch.full((kinds,), len(state) / kinds))
    require(p > FALSE_ALARM, f"plan: equally good plans were chosen {counts.tolist()} times (p = {p:.1g})")


class _Counting(World):
    """A table that counts the steps taken in it."""

    def __init__(self, world: TabularWorld) -> None:
        self.world, self.num_actions, self.steps = world, world.num_actions, 0

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        return self.world.reset(batch_size, generator)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        self.steps += action.numel()
        return self.world.step(state, action, generator)

    def check_state(self, state: Tensor) -> None:
        self.world.check_state(state)
