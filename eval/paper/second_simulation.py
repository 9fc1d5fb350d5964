"""The paper's second simulation: planning on values that are only approximately right."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import pandas as pd
import torch
from torch import Tensor

from eval.paper.planners import ANY_PREFIX, Finished, PaperSettings, fit_priors, groups, make_planners, over_groups
from neuroprior import ExhaustivePlanner, Planner, Plans, Prior
from neuroprior.analysis.statistics import Interval, paired_difference
from neuroprior.values import can_reach, q_learning, value_iteration
from neuroprior.worlds import GridWorld

PAPER_REACHED = {"deterministic": 0.2422, "random": 0.3952, "markov-1": 0.4961, "markov-2": 0.4733}
"""Hyvärinen, Table 2: the share of 10,000 starts from which the goal was reached."""

SCALES = (1e-4, 0.01, 0.1, 1.0)
"""Scales of Q-learning's initial values that are compared."""


class Pursuit(NamedTuple):
    """What came of planning again and again from N starts.

    Attributes:
        reached: `[N]` bool: whether a plan ended on the goal.
        final_state: `[N]`: where the last plan ended.
        plans: the plans that led somewhere else than where they began: `[M, L]`.
        lengths: `[M]`, or None where all have L actions.
        start: `[M]`: the index of the start that each plan belongs to.
        model_steps: single simulator steps for each plan.
    """

    reached: Tensor
    final_state: Tensor
    plans: Tensor
    lengths: Tensor | None
    start: Tensor
    model_steps: int


class SecondResult(NamedTuple):
    """The second simulation: V value functions with n starts for each.

    Attributes:
        world: with a map of rewards, all 0, for each value function.
        states: `[V, n]`: the starts.
        pursuits: of each planner, from the starts flattened.
        ceiling: `[V, n]` bool: starts that can end on the goal at all.
        prefix_ceiling: the same for planners that may end a plan after any action.
        values: `[V, S]`: the value functions, without the goal's infinity.
        exact: `[S]`: the true values.
    """

    world: GridWorld
    states: Tensor
    pursuits: dict[str, Pursuit]
    ceiling: Tensor
    prefix_ceiling: Tensor
    values: Tensor
    exact: Tensor

    def reached(self) -> dict[str, Tensor]:
        """From which starts each planner reached the goal: `[V, n]` bool."""
        return {name: done.reached.view(self.states.shape) for name, done in self.pursuits.items()}

    def table(self) -> pd.DataFrame:
        """Table 2: the share of starts from which each planner reached the goal, and its simulator steps a plan."""
        rows = []
        for name, reached in self.reached().items():
            share = over_groups(reached)
            row = {"planner": name, "reached": share.mean, "low": share.low, "high": share.high}
            rows.append(row | {"paper": PAPER_REACHED.get(name), "model_steps": self.pursuits[name].model_steps})
        return pd.DataFrame(rows)

    def ceilings(self) -> dict[str, float]:
        """The shares of starts that can reach the goal at all, with whole plans and with any prefix of them."""
        shares = {"ceiling": self.ceiling, "ceiling_any_prefix": self.prefix_ceiling}
        return {name: float(able.double().mean()) for name, able in shares.items()}

    def distance(self, resamples: int = 2000) -> Interval:
        """The root mean square difference from the paper's Table 2.

        The interval is a bootstrap's, over value functions: the distance is no mean of independent values.
        """
        reached = self.reached()
        shares = torch.stack([reached[name].double().mean(1) for name in PAPER_REACHED])
        paper = torch.tensor(list(PAPER_REACHED.values()), dtype=torch.double)[:, None]
        functions = shares.shape[1]
        again = torch.randint(functions, (resamples, functions), generator=torch.Generator().manual_seed(0))
        distances = (shares[:, again].mean(2) - paper).square().mean(0).sqrt()
        low, high = distances.quantile(torch.tensor([0.025, 0.975], dtype=torch.double)).tolist()
        return Interval(float((shares.mean(1, keepdim=True) - paper).square().mean().sqrt()), low, high)

    def paired(self) -> pd.DataFrame:
        """Priors compared with none, and neural ones with the best Markov prior, paired over value functions."""
        share = {name: reached.double().mean(1) for name, reached in self.reached().items()}
        rows = []
        for suffix in ("", ANY_PREFIX):
            best = max((f"markov-{k}" for k in (1, 2, 3)), key=lambda name: float(share[name + suffix].mean()))
            pairs = [("random", "deterministic"), ("markov-1", "random"), ("markov-2", "random")]
            for pair in [*pairs, ("gru", best), ("transformer", best)]:
                first, second = (name + suffix for name in pair)
                gap = paired_difference(share[first], share[second])
                rows.append({"first": first, "second": second, **gap._asdict()})
        return pd.DataFrame(rows)


def pursue(
    planner: Planner, world: GridWorld, state: Tensor, goal: int, max_plans: int, generator: torch.Generator
) -> Pursuit:
    """Plan, go where the plan ends, and plan again from there, up to `max_plans` times or until on the goal."""
    state = state.clone()
    plans, lengths, start, model_steps = [], [], [], 0
    for _ in range(max_plans):
        active = (world.cell(state) != goal).nonzero()[:, 0]
        if len(active) == 0:
            break
        decision = planner.plan(world, state[active], generator)
        moved, model_steps = decision.final_state != state[active], decision.model_steps
        plans.append(decision.plan[moved])
        start.append(active[moved])
        if decision.lengths is not None:
            lengths.append(decision.lengths[moved])
        state[active] = decision.final_state
    return Pursuit(
        world.cell(state) == goal,
        state,
        torch.cat(plans) if plans else torch.empty(0, 0, dtype=torch.uint8),
        torch.cat(lengths) if lengths else None,
        torch.cat(start) if start else torch.empty(0, dtype=torch.long),
        model_steps,
    )


def empty_world(settings: PaperSettings, num_maps: int) -> GridWorld:
    """The grid, without rewards, once for each value function."""
    return GridWorld(settings.size, settings.size, settings.edges, torch.zeros(num_maps, settings.size**2))


def objective(values: Tensor, goal: int) -> Callable[[Tensor], Tensor]:
    """The value of states under value functions `[V, S]`, that of the goal infinite."""
    table = values.clone()
    table[:, goal] = torch.inf
    flat = table.flatten()
    return lambda state: flat[state]


def random_starts(settings: PaperSettings, num_maps: int, number: int, generator: torch.Generator) -> Tensor:
    """`number` states for each of `num_maps` value functions, uniform over all cells but the goal: `[V, n]`."""
    cell = torch.randint(settings.size**2 - 1, (num_maps, number), generator=generator)
    cell = cell + (cell >= settings.goal)
    return cell + torch.arange(num_maps)[:, None] * settings.size**2


def learn(
    settings: PaperSettings, values: Tensor, neural: bool, generator: torch.Generator, finished: Finished
) -> dict[str, Prior]:
    """The priors that learn from the whole plans that the deterministic planner executes under `values [V, S]`."""
    world = empty_world(settings, len(values))
    number = -(-settings.training_plans // len(values))
    states = random_starts(settings, len(values), number, generator).flatten()
    planner = ExhaustivePlanner(settings.depth, value=objective(values, settings.goal))
    done = pursue(planner, world, states, settings.goal, settings.max_plans, generator)
    if len(done.plans) < 2:
        raise ValueError("training_plans: too few plans that lead anywhere; give more")
    kept = torch.randperm(len(done.plans), generator=generator)[: settings.training_plans]
    group = groups(world, states[done.start[kept]])
    finished("collecting plans")
    plans = Plans(done.plans[kept], 4, action_names=world.action_names, group=group)
    return fit_priors(plans, settings, neural, generator, finished)


def simulate(settings: PaperSettings, full: bool, finished: Finished) -> tuple[SecondResult, dict[str, Prior]]:
    """Learn value functions, collect plans under some of them, and pursue the goal under the others.

    Args:
        settings: what, and how much of it.
        full: with neural priors too, and with planners that may end a plan after any action.
        finished: is called 18 times; 7 times where not `full`.

    Returns:
        The result, and the priors.
    """
    generator = torch.Generator().manual_seed(settings.seed)
    number = settings.value_functions
    learned = q_learning(
        empty_world(settings, 1),
        settings.goal,
        num_agents=2 * number,
        steps=settings.q_steps,
        initial_scale=settings.initial_scale,
        generator=generator,
    ).amax(-1)
    finished("Q-learning")
    values, others = learned[:number], learned[number:]
    priors = learn(settings, others, full, generator, finished)
    world = empty_world(settings, number)
    states = random_starts(settings, number, settings.starts, generator)
    value = objective(values, settings.goal)
    planners = make_planners(priors, settings, value)
    if full:
        planners |= make_planners(priors, settings, value, any_prefix=True)
    pursuits = {}
    for name, planner in planners.items():
        pursuits[name] = pursue(planner, world, states.flatten(), settings.goal, settings.max_plans, generator)
        finished(f"planning: {name}")
    ceilings = ceiling(world, states, settings), ceiling(world, states, settings, any_prefix=True)
    exact = value_iteration(world, goal=settings.goal)[0]
    return SecondResult(world, states, pursuits, *ceilings, values, exact), priors


def all_scales(settings: PaperSettings, finished: Finished) -> pd.DataFrame:
    """Table 2 with both edges and all `SCALES`, with the Markov priors alone; `finished` is called 8 times."""
    rows: list[dict[str, Any]] = []
    edges: Literal["torus", "wall"]
    for edges in ("torus", "wall"):
        for scale in SCALES:
            changed = replace(settings, edges=edges, initial_scale=scale)
            result, _ = simulate(changed, full=False, finished=lambda _: None)
            table = result.table()
            distance, low, high = result.distance()
            row = {"edges": edges, "initial_scale": scale, **dict(zip(table.planner, table.reached, strict=True))}
            rows.append(row | result.ceilings() | {"table_distance": distance, "low": low, "high": high})
            finished(f"{edges}, values up to {scale:g}")
    return pd.DataFrame(rows)


def ceiling(world: GridWorld, states: Tensor, settings: PaperSettings, any_prefix: bool = False) -> Tensor:
    """Which starts can end on the goal at all, with plans of either length: bool, in the shape of `states`.

    With whole plans, that is after some number of them; with any prefix of plans, after at most all their moves.
    """
    flat = states.flatten()
    lengths = {settings.depth, settings.length}
    if any_prefix:
        most = settings.max_plans * max(lengths)
        return can_reach(world, flat, settings.goal, most, within=True).view(states.shape)
    whole = [
        can_reach(world, flat, settings.goal, n * moves) for n in range(1, settings.max_plans + 1) for moves in lengths
    ]
    return torch.stack(whole).any(0).view(states.shape)
