"""The paper's second simulation: planning on values that are only approximately right."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from eval.paper.first_simulation import Report, groups, learn_priors, make_planners, over_groups
from neuroprior import ExhaustivePlanner, GridWorld, Planner, Plans, Prior
from neuroprior.analysis.statistics import Interval, paired_difference
from neuroprior.values import can_reach, q_learning, value_iteration

PAPER_REACHED = {"deterministic": 0.2422, "random": 0.3952, "markov-1": 0.4961, "markov-2": 0.4733}
"""Hyvärinen, Table 2: the share of 10,000 starts from which the goal was reached."""

ANY_PREFIX = " (any prefix)"
"""What is added to the name of a planner that may end a plan after any of its actions."""


@dataclass(frozen=True)
class Task:
    """What is planned, and how much of it."""

    edges: Literal["wall", "torus"]
    value_functions: int
    starts: int
    size: int
    q_steps: int
    initial_scale: float
    max_plans: int
    training_plans: int
    depth: int
    length: int
    num_plans: int
    seed: int

    @property
    def goal(self) -> int:
        """The goal's cell, in the middle."""
        return self.size // 2 * self.size + self.size // 2


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


class Outcome(NamedTuple):
    """What came of a task: K planners, V value functions, n starts.

    Attributes:
        names: of the planners.
        reached: `[K, V, n]` bool.
        final_state: `[K, V, n]`.
        ceiling: `[V, n]` bool: starts that can end on the goal at all.
        prefix_ceiling: the same for planners that may end a plan after any action.
        values: `[V, S]`: the value functions, without the goal's infinity.
        exact: `[S]`: the true values.
        world: with a map of rewards, all 0, for each value function.
        model_steps: single simulator steps for each plan, by planner.
    """

    names: list[str]
    reached: Tensor
    final_state: Tensor
    ceiling: Tensor
    prefix_ceiling: Tensor
    values: Tensor
    exact: Tensor
    world: GridWorld
    model_steps: list[int]


def pursue(
    planner: Planner,
    world: GridWorld,
    state: Tensor,
    goal: int,
    max_plans: int,
    generator: torch.Generator,
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


def empty_world(task: Task, num_maps: int) -> GridWorld:
    """The grid, without rewards, once for each value function."""
    return GridWorld(task.size, task.size, task.edges, torch.zeros(num_maps, task.size**2))


def objective(values: Tensor, goal: int) -> Callable[[Tensor], Tensor]:
    """The value of states under value functions `[V, S]`, that of the goal infinite."""
    table = values.clone()
    table[:, goal] = torch.inf
    flat = table.flatten()
    return lambda state: flat[state]


def random_starts(task: Task, num_maps: int, number: int, generator: torch.Generator) -> Tensor:
    """`number` states for each of `num_maps` value functions, uniform over all cells but the goal: `[V, n]`."""
    cell = torch.randint(task.size**2 - 1, (num_maps, number), generator=generator)
    cell = cell + (cell >= task.goal)
    return cell + torch.arange(num_maps)[:, None] * task.size**2


def planners_for(
    priors: dict[str, Prior], task: Task, value: Callable[[Tensor], Tensor], any_prefix: bool = False
) -> dict[str, Planner]:
    """The planners of the table by name."""
    planners = make_planners(priors, task.depth, task.length, task.num_plans, value, any_prefix)
    return {name + (ANY_PREFIX if any_prefix else ""): planner for name, planner in planners.items()}


def learn(task: Task, values: Tensor, neural: bool, generator: torch.Generator, report: Report) -> dict[str, Prior]:
    """The priors that learn from the whole plans that the deterministic planner executes under `values [V, S]`."""
    world = empty_world(task, len(values))
    number = -(-task.training_plans // len(values))
    states = random_starts(task, len(values), number, generator).flatten()
    planner = ExhaustivePlanner(task.depth, value=objective(values, task.goal))
    report("second simulation: collecting plans")
    done = pursue(planner, world, states, task.goal, task.max_plans, generator)
    if len(done.plans) < 2:
        raise ValueError("training_plans: too few plans that lead anywhere; give more")
    kept = torch.randperm(len(done.plans), generator=generator)[: task.training_plans]
    group = groups(world, states[done.start[kept]])
    plans = Plans(done.plans[kept], 4, action_names=world.action_names, group=group)
    return learn_priors(plans, task.seed, neural, generator, lambda what: report(f"second simulation: {what}"))


def simulate(task: Task, full: bool, report: Report) -> tuple[Outcome, dict[str, Prior]]:
    """Learn value functions, collect plans under some of them, and pursue the goal under the others.

    Args:
        task: what, and how much of it.
        full: with neural priors too, and with planners that may end a plan after any action.
        report: is told what begins.

    Returns:
        The outcome, and the priors.
    """
    generator = torch.Generator().manual_seed(task.seed)
    number = task.value_functions
    report("second simulation: Q-learning")
    learned = q_learning(
        empty_world(task, 1),
        task.goal,
        num_agents=2 * number,
        steps=task.q_steps,
        initial_scale=task.initial_scale,
        generator=generator,
    ).amax(-1)
    values, others = learned[:number], learned[number:]
    priors = learn(task, others, full, generator, report)
    world = empty_world(task, number)
    states = random_starts(task, number, task.starts, generator)
    value = objective(values, task.goal)
    planners = planners_for(priors, task, value)
    if full:
        planners |= planners_for(priors, task, value, any_prefix=True)
    reached, final_state, model_steps = [], [], []
    for name, planner in planners.items():
        report(f"second simulation: {name}")
        done = pursue(planner, world, states.flatten(), task.goal, task.max_plans, generator)
        reached.append(done.reached.view(states.shape))
        final_state.append(done.final_state.view(states.shape))
        model_steps.append(done.model_steps)
    exact = value_iteration(world, goal=task.goal)[0]
    return Outcome(
        list(planners),
        torch.stack(reached),
        torch.stack(final_state),
        ceiling(world, states, task),
        ceiling(world, states, task, any_prefix=True),
        values,
        exact,
        world,
        model_steps,
    ), priors


def ceiling(world: GridWorld, states: Tensor, task: Task, any_prefix: bool = False) -> Tensor:
    """Which starts can end on the goal at all, with plans of either length: bool, in the shape of `states`.

    With whole plans, that is after some number of them; with any prefix of plans, after at most all their moves.
    """
    flat = states.flatten()
    lengths = {task.depth, task.length}
    if any_prefix:
        most = task.max_plans * max(lengths)
        return can_reach(world, flat, task.goal, most, within=True).view(states.shape)
    whole = [can_reach(world, flat, task.goal, n * moves) for n in range(1, task.max_plans + 1) for moves in lengths]
    return torch.stack(whole).any(0).view(states.shape)


def rows_of(outcome: Outcome) -> list[dict[str, Any]]:
    """A row a planner: the share of starts from which it reached the goal, and its simulator steps a plan."""
    rows: list[dict[str, Any]] = []
    for name, reached, steps in zip(outcome.names, outcome.reached, outcome.model_steps, strict=True):
        share = over_groups(reached)
        row = {"planner": name, "reached": share.mean, "low": share.low, "high": share.high}
        rows.append(row | {"paper": PAPER_REACHED.get(name), "model_steps": steps})
    return rows


def ceilings_of(outcome: Outcome) -> dict[str, float]:
    """The shares of starts that can reach the goal at all, with whole plans and with any prefix of them."""
    return {
        "ceiling": float(outcome.ceiling.double().mean()),
        "ceiling_any_prefix": float(outcome.prefix_ceiling.double().mean()),
    }


def distance_interval(outcome: Outcome, resamples: int = 2000) -> Interval:
    """The root mean square difference from the paper's Table 2, with a bootstrap interval over value functions."""
    shares = torch.stack([outcome.reached[outcome.names.index(name)].double().mean(1) for name in PAPER_REACHED])
    paper = torch.tensor(list(PAPER_REACHED.values()), dtype=torch.double)[:, None]
    functions = shares.shape[1]
    again = torch.randint(functions, (resamples, functions), generator=torch.Generator().manual_seed(0))
    distances = (shares[:, again].mean(2) - paper).square().mean(0).sqrt()
    low, high = distances.quantile(torch.tensor([0.025, 0.975], dtype=torch.double)).tolist()
    return Interval(float((shares.mean(1, keepdim=True) - paper).square().mean().sqrt()), low, high)


def findings(outcome: Outcome) -> list[dict[str, Any]]:
    """Paired comparisons over value functions: priors with none, neural ones with the best Markov prior."""
    share = dict(zip(outcome.names, outcome.reached.double().mean(2), strict=True))
    found = []
    for suffix in ("", ANY_PREFIX):
        markov = max((f"markov-{k}{suffix}" for k in (1, 2, 3)), key=lambda name: float(share[name].mean()))
        pairs = [("random", "deterministic"), ("markov-1", "random"), ("markov-2", "random")]
        named = [(first + suffix, second + suffix) for first, second in pairs]
        for first, second in [*named, ("gru" + suffix, markov), ("transformer" + suffix, markov)]:
            found.append({"first": first, "second": second, **paired_difference(share[first], share[second])._asdict()})
    return found
