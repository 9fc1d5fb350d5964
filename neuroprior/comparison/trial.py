"""One repeat of a comparison: draws starts, collects plans, fits priors, plans with them, scores what was chosen."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neuroprior._random import draw_seed
from neuroprior.comparison.contestants import MakePlanner, PriorSource, fit_prior, make_planner
from neuroprior.planners import (
    Decision,
    SamplingPlanner,
    collect,
    expected_score,
    mean_scores,
    oracle,
)
from neuroprior.plans import Plans
from neuroprior.priors import UniformPrior
from neuroprior.sampling import sample_in_world
from neuroprior.worlds import Categories, SimulatorWorld, TabularWorld, World

RANDOM_PLANS = 64
"""Random plans from each held-out start, whose mean score counts as 0."""

TRAINING_RANDOM_PLANS = 16
"""Random plans from each training start; only plans that score more than their mean are learned from."""

SCORE_ROLLOUTS = 64
"""Fresh rollouts that score a plan in a stochastic world that is no table."""

MAX_SAME = 64
"""Starts of simulators that are compared; where all hold the same, so do the others."""

MIN_LEARNED = 20
"""Fewer plans than this are not learned from."""

MAX_ORACLE_STEPS = 10**9
"""Steps of dynamic programming up to which the optimum is computed."""

TOLERANCE = 1e-9
"""Scores that differ by less than this share of their size are equal."""

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Design:
    """All that decides the outcome of a seed.

    Attributes:
        world: where plans are collected.
        held_out: another world, where priors are compared; None: in `world`, from other starts.
        priors, planners: by name.
        budgets: candidate plans for each start.
        length: actions in a plan.
        starts: from which planners are compared.
        training_starts: from which plans are collected.
        training_budget: plans that are tried from each of them.
    """

    world: World
    held_out: World | None
    priors: dict[str, PriorSource]
    planners: dict[str, str | MakePlanner]
    budgets: tuple[int, ...]
    length: int
    starts: int
    training_starts: int
    training_budget: int

    @property
    def model_steps(self) -> tuple[int, int]:
        """Simulator steps of a seed: for each training start, and for each held-out start."""
        decisions = len(self.priors) * len(self.planners) * sum(self.budgets)
        training = self.training_budget + TRAINING_RANDOM_PLANS
        return training * self.length, (decisions + RANDOM_PLANS) * self.length


class Outcome(NamedTuple):
    """The result of a seed, with S held-out starts.

    Attributes:
        scores: `[planners, priors, budgets, S]`: what the chosen plans really get, in the world's own units.
        random: `[S]`: the mean score of random plans.
        best: `[S]`: the optimum, or None where it cannot be computed.
        model_steps: `[planners, priors, budgets]`: simulator steps of a decision for each start.
        num_learned: how many plans were learned from; 0: they were too few, or none beat random plans.
        same_starts: whether the held-out starts are training starts, too, since there is but one.
        seconds: how long it took.
    """

    scores: Array
    random: Array
    best: Array | None
    model_steps: NDArray[np.int64]
    num_learned: int
    same_starts: bool
    seconds: float


def run_seed(
    seed: int, design: Design, report: Callable[[str], None] | None = None, start_by: float = inf
) -> Outcome | None:
    """Run one repeat.

    Args:
        seed: of everything random.
        design: what is compared.
        report: a function of what is done at present.
        start_by: do nothing after this time, in seconds since the epoch.

    Returns:
        The outcome; None after `start_by`.

    Raises:
        ValueError: a prior cannot learn from the plans, a planner cannot plan in the world or exceeds its budget.
    """
    begin = time.time()
    if begin > start_by:
        return None
    tell = report or (lambda _: None)
    root = torch.Generator().manual_seed(seed)
    start_seed, training_seed, fit_seed, plan_seed, score_seed = (draw_seed(root) for _ in range(5))
    # Every prior and planner gets the same random numbers, so that differences between them are less noisy.
    fresh = torch.Generator().manual_seed
    held_out = design.held_out or design.world
    generator = fresh(start_seed)
    training, state, same_starts = draw_starts(design, generator)
    tell("collecting plans")
    plans = training_plans(design, training, fresh(training_seed))
    random = random_scores(held_out, state, design.length, RANDOM_PLANS, generator, score_seed)
    scores = np.empty((len(design.planners), len(design.priors), len(design.budgets), len(state)))
    steps = np.empty(scores.shape[:-1], dtype=np.int64)
    for p, (name, source) in enumerate(design.priors.items()):
        tell(f"fitting {name}")
        try:
            prior = fit_prior(source, plans, held_out.num_actions, fresh(fit_seed))
        except ValueError as error:
            raise ValueError(f"priors: {name}: {error}") from error
        for k, (planner_name, make) in enumerate(design.planners.items()):
            tell(f"planning with {name} and {planner_name}")
            for b, budget in enumerate(design.budgets):
                planner = make_planner(make, prior, design.length, budget)
                decision = planner.plan(held_out, state, fresh(plan_seed))
                check_decision(decision, planner_name, design.length, budget)
                actual = true_scores(held_out, state, decision.plan[:, None], score_seed)
                scores[k, p, b], steps[k, p, b] = actual[:, 0].cpu().numpy(), decision.model_steps
    best = optimum(held_out, state, design.length)
    return Outcome(
        scores,
        random.cpu().numpy(),
        None if best is None else best.double().cpu().numpy(),
        steps,
        0 if plans is None else len(plans),
        same_starts,
        time.time() - begin,
    )


def draw_starts(design: Design, generator: torch.Generator) -> tuple[Tensor, Tensor, bool]:
    """The training starts, the held-out starts, and whether these are the same.

    Where priors are compared in the world that they learned in, up to a quarter of all distinct starts is held out:
    no training plan begins there.
    """
    wanted, kept = design.training_starts, design.starts
    if design.held_out is not None:
        return design.world.reset(wanted, generator), design.held_out.reset(kept, generator), False
    pool = design.world.reset(2 * (wanted + kept), generator)
    which = pool.cpu().unique(dim=0, return_inverse=True)[1]
    distinct = int(which.max()) + 1
    if distinct == 1 or (isinstance(design.world, SimulatorWorld) and design.world.are_same(pool[:MAX_SAME])):
        return pool[:wanted], pool[:kept], True
    chosen = torch.zeros(distinct, dtype=torch.bool)
    chosen[torch.randperm(distinct, generator=generator)[: min(kept, -(-distinct // 4))]] = True
    held_out = chosen[which].to(pool.device)
    return _cycle(pool[~held_out], wanted), _cycle(pool[held_out], kept), False


def training_plans(design: Design, state: Tensor, generator: torch.Generator) -> Plans | None:
    """Plans from `state [N, ...]` that a planner without a prior chose, if they beat random plans from the same start.

    None: fewer than `MIN_LEARNED` do.
    """
    world, uniform = design.world, UniformPrior(design.world.num_actions)
    planner = make_planner(collector_name(world), uniform, design.length, design.training_budget)
    context: Literal["step"] | None = None if world.observation is None else "step"
    plans = collect(planner, world, state=state, context=context, generator=generator)
    if isinstance(world.observation, Categories):
        # A prior has as many contexts as there are names, and from other starts more may occur.
        plans = replace(plans, context_names=tuple(map(str, range(world.observation.number))))
    seed = draw_seed(generator)
    random = random_scores(world, state, design.length, TRAINING_RANDOM_PLANS, generator, seed)
    actual = true_scores(world, state, plans.actions[:, None], seed)[:, 0]
    better = actual > random + TOLERANCE * random.abs().clamp(min=1)
    return plans[better] if int(better.sum()) >= MIN_LEARNED else None


def collector_name(world: World) -> str:
    """The planner that collects training plans in a world."""
    return "sampling" if world.stochastic else "frontier"


def random_scores(
    world: World, state: Tensor, length: int, num_plans: int, generator: torch.Generator, score_seed: int
) -> Tensor:
    """The mean score `[B]`, float64, of random plans of legal actions from each of `state [B, ...]`.

    Raises:
        ValueError: it is infinite.
    """
    uniform = UniformPrior(world.num_actions)
    if world.all_legal:  # nothing of the world is needed to draw them
        plans = uniform.sample(len(state) * num_plans, length, generator=generator)
        plans = plans.view(len(state), num_plans, length).to(state.device)
    else:
        plans, _ = sample_in_world(uniform, world, state, num_plans, length, generator=generator)
    scores = true_scores(world, state, plans, score_seed).mean(1)
    if not scores.isfinite().all():
        raise ValueError(
            f"world: its rewards must be finite, since scores are compared with the mean of random plans, got"
            f" {float(scores[~scores.isfinite()][0])} in the mean; leave out what is forbidden by `legal_actions`"
        )
    return scores


def true_scores(world: World, state: Tensor, plans: Tensor, seed: int) -> Tensor:
    """What plans really get, float64 `[B, P]`: exact in a deterministic world and in tables, else by fresh rollouts.

    Args:
        world: the world.
        state: `[B, ...]`.
        plans: `[B, P, L]`.
        seed: of the rollouts, which no planner has seen.
    """
    if world.stochastic and isinstance(world, TabularWorld):
        return expected_score(world, state, plans).double()
    judge = SamplingPlanner(UniformPrior(world.num_actions), plans.shape[2], 1)
    return mean_scores(judge, world, state, plans, SCORE_ROLLOUTS, torch.Generator().manual_seed(seed))[0].double()


def optimum(world: World, state: Tensor, length: int) -> Tensor | None:
    """The highest score `[B]` of any plan, in a stochastic table of any policy; None where that is too costly."""
    if not isinstance(world, TabularWorld):
        return None
    if length * world.num_maps * world.num_states * world.num_actions > MAX_ORACLE_STEPS:
        return None
    return oracle(world, state, length)


def check_decision(decision: Decision, name: str, length: int, budget: int) -> None:
    """Raise ValueError for plans that are not executed whole, or that took more simulator steps than the budget."""
    if decision.lengths is not None or decision.plan.shape[1] != length:
        raise ValueError(
            f"`planners` must choose plans of {length} actions that are executed whole, got others of {name}"
        )
    if decision.model_steps > budget * length:
        raise ValueError(
            f"`planners` must take at most {budget * length} simulator steps for {budget} plans of {length} actions,"
            f" got {decision.model_steps} of {name}"
        )


def _cycle(state: Tensor, number: int) -> Tensor:
    """The first `number` rows, from the first again where there are fewer."""
    return state[torch.arange(number, device=state.device) % len(state)]
