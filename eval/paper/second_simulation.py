"""The paper's second simulation: planning on values that are only approximately right."""

from collections.abc import Callable
from typing import NamedTuple

import pandas as pd
import torch
from torch import Tensor

from eval.paper.planners import (
    ANY_PREFIX,
    Finished,
    PaperSettings,
    best_markov,
    fit_priors,
    groups,
    make_planners,
    paired_table,
    share_table,
)
from eval.paper.values import can_reach, q_learning
from neuroprior import ExhaustivePlanner, Planner, Plans, Prior
from neuroprior.planners import value_iteration
from neuroprior.worlds import GridWorld

PAPER_REACHED = {"deterministic": 0.2422, "random": 0.3952, "markov-1": 0.4961, "markov-2": 0.4733}
"""Hyvärinen, Table 2: the share of 10,000 starts from which the goal was reached."""

SCALES = {"edges": ("torus", "wall"), "initial_scale": (1e-4, 0.01, 0.1, 1.0)}
"""What is varied: edges, and the scale of Q-learning's initial values."""


class Pursuit(NamedTuple):
    """What came of planning again and again from N starts."""

    reached: Tensor  # [N] bool: whether a plan ended on the goal
    final_state: Tensor  # [N]: where the last plan ended
    plans: Tensor  # [M, L]: the plans that led somewhere else than where they began
    lengths: Tensor | None  # [M]; None where all have L actions
    start: Tensor  # [M]: the index of the start that each plan belongs to
    model_steps: int  # single simulator steps for each plan


class SecondResult(NamedTuple):
    """The second simulation: V value functions with n starts for each."""

    world: GridWorld  # with a map of rewards, all 0, for each value function
    states: Tensor  # [V, n]: the starts
    pursuits: dict[str, Pursuit]  # of each planner, from the starts flattened
    ceiling: Tensor  # [V, n] bool: starts that can end on the goal at all
    prefix_ceiling: Tensor  # the same for planners that may end a plan after any action
    values: Tensor  # [V, S]: the value functions, without the goal's infinity
    exact: Tensor  # [S]: the true values

    def reached(self) -> dict[str, Tensor]:
        """From which starts each planner reached the goal: `[V, n]` bool."""
        return {name: done.reached.view(self.states.shape) for name, done in self.pursuits.items()}

    def table(self) -> pd.DataFrame:
        """Table 2: the share of starts from which each planner reached the goal, and its simulator steps a plan."""
        steps = [done.model_steps for done in self.pursuits.values()]
        return share_table("reached", self.reached(), PAPER_REACHED).assign(model_steps=steps)

    def ceilings(self) -> dict[str, float]:
        """The shares of starts that can reach the goal at all, with whole plans and with any prefix of them."""
        shares = {"ceiling": self.ceiling, "ceiling_any_prefix": self.prefix_ceiling}
        return {name: float(able.double().mean()) for name, able in shares.items()}

    def paired(self) -> pd.DataFrame:
        """Priors compared with none, and neural ones with the best Markov prior, paired over value functions."""
        share = {name: reached.double().mean(1) for name, reached in self.reached().items()}
        pairs = []
        for end in ("", ANY_PREFIX):
            simple = [("random", "deterministic"), ("markov-1", "random"), ("markov-2", "random")]
            simple = [(first + end, second + end) for first, second in simple]
            pairs += [*simple, *((name + end, best_markov(share, end)) for name in ("gru", "transformer"))]
        return paired_table(share, pairs)

    def summary(self) -> dict[str, float]:
        """The share of starts from which each planner reached the goal, and how far that is from the paper's Table 2.

        The distance is a root mean square, with a bootstrap's interval over value functions: it is no mean of
        independent values.
        """
        reached = {name: hits.double().mean(1) for name, hits in self.reached().items()}
        shares = torch.stack([reached[name] for name in PAPER_REACHED])
        paper = torch.tensor(list(PAPER_REACHED.values()), dtype=torch.double)[:, None]
        again = torch.randint(shares.shape[1], (2000, shares.shape[1]), generator=torch.Generator().manual_seed(0))
        distances = (shares[:, again].mean(2) - paper).square().mean(0).sqrt()
        low, high = distances.quantile(torch.tensor([0.025, 0.975], dtype=torch.double)).tolist()
        distance = float((shares.mean(1, keepdim=True) - paper).square().mean().sqrt())
        means = {name: float(share.mean()) for name, share in reached.items()}
        return means | self.ceilings() | {"table_distance": distance, "low": low, "high": high}


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


def learned_values(settings: PaperSettings, number: int, generator: torch.Generator) -> Tensor:
    """The values of independent Q-learners: `[number, S]`."""
    world, steps, scale = empty_world(settings, 1), settings.q_steps, settings.initial_scale
    learned = q_learning(world, settings.goal, num_agents=number, steps=steps, initial_scale=scale, generator=generator)
    return learned.amax(-1)


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


def simulate(
    settings: PaperSettings, full: bool, finished: Finished = lambda _: None
) -> tuple[SecondResult, dict[str, Prior]]:
    """Learn value functions, collect plans under some of them, and pursue the goal under the others.

    `full`: with neural priors too, and with planners that may end a plan after any action. `finished` is called 18
    times; 7 times where not `full`. Returns the priors, too.
    """
    generator = torch.Generator().manual_seed(settings.seed)
    number = settings.value_functions
    learned = learned_values(settings, 2 * number, generator)
    finished("Q-learning")
    values, others = learned[:number], learned[number:]
    priors = learn(settings, others, full, generator, finished)
    world = empty_world(settings, number)
    states = random_starts(settings, number, settings.starts, generator)
    value = objective(values, settings.goal)
    pursuits = {}
    for any_prefix in (False, True) if full else (False,):
        for name, planner in make_planners(priors, settings, value, any_prefix).items():
            pursuits[name] = pursue(planner, world, states.flatten(), settings.goal, settings.max_plans, generator)
            finished(f"planning: {name}")
    ceilings = ceiling(world, states, settings), ceiling(world, states, settings, any_prefix=True)
    exact = value_iteration(world, goal=settings.goal)[0]
    return SecondResult(world, states, pursuits, *ceilings, values, exact), priors


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
