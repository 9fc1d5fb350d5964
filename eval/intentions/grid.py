"""Agents that walk to one of K goals in a grid, and what observers make of their moves."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import product
from math import log
from typing import Any, NamedTuple

import torch
from torch import Tensor

from eval.intentions.calibration import count_forecasts
from eval.intentions.forecast import forecast
from eval.worlds.labyrinth import data_digest
from neuroprior import MarkovPrior, Plans, Prior, TabularWorld
from neuroprior._random import draw_seed
from neuroprior.planners import value_iteration
from neuroprior.priors import infer
from neuroprior.priors.counts import Chains
from neuroprior.worlds import four_rooms, maze
from neuroprior.worlds.grid import GridWorld

WORLDS = {"four_rooms": four_rooms, "maze": maze}
"""Grids whose layout a seed draws."""

MOVES, STAY, ACTIONS = 4, 4, 5
"""Moves, the action that is taken at the goal alone, and both."""

DISCOUNT = 0.9
"""Of the values from which distances are read."""

LONGEST = 128
"""Actions after which a walk is cut off."""

SHARES = (0.25, 0.5, 0.75)
"""Shares of the way to the goal, in moves."""

SWITCH_AT, SWITCH = 8, 0.05
"""Moves after which other agents turn to another goal, and the probability per move that observers assume for it."""

FORECAST_AFTER, FORECASTED, SAMPLES, FLOOR = 4, 50, 200, 0.05
"""Moves that are observed before a forecast, agents, samples of each prior, and the share of all cells alike in it."""

VALIDATION = 0.2
"""Share of the plans toward a goal on which the order and back-off of its chain are chosen, and the power."""

ORDERS = {"cell": range(2), "blind": range(4)}
"""Orders of the chains that are tried: with the cell as context, and of past moves alone."""

SCALES: list[float] = [2.0 ** (k / 2) for k in range(-10, 7)]
"""Weights of a step of progress, and powers of likelihoods, from which the best is chosen."""


@dataclass(frozen=True)
class IntentionSettings:
    """How much is done; see `eval.intentions.command.intentions`."""

    goals: int
    num_plans: tuple[int, ...]
    agents: int
    observed: tuple[int, ...]
    ahead: tuple[int, ...]
    temperature: float
    seed: int

    @property
    def asked(self) -> dict[str, Any]:
        """The settings, and the mice's moves: what distinguishes finished runs."""
        return asdict(self) | {"data": data_digest()}


class Scene(NamedTuple):
    """A grid with K goals.

    Attributes:
        world: the grid, with the action that stays.
        policies: `[K, S, A]`, float64: how agents act that are after each goal.
        path, straight: `[K, S]`: moves from each cell to each goal, through the grid and were there no walls.
        free: the cells that are no walls.
    """

    world: TabularWorld
    policies: Tensor
    path: Tensor
    straight: Tensor
    free: Tensor


class Key(NamedTuple):
    """An observer: its kind, and the number of plans toward each goal that it learned from; 0: it learned nothing."""

    kind: str
    plans: int


class Agents(NamedTuple):
    """Agents that were observed: their goals and numbers of moves, `[B]` each."""

    goal: Tensor
    length: Tensor

    def scores(self, logits: Tensor, times: tuple[int, ...], scale: float = 1.0) -> list[dict[str, Any]]:
        """What an observer, by its `logits [B, L + 1, K]`, thinks of goals after so many moves, where there were."""
        there = [(self.length >= time, time) for time in times]
        return [{"at": t, **scores(scale * logits[rows, t], self.goal[rows])} for rows, t in there if rows.any()]

    def best_scale(self, logits: Tensor, times: tuple[int, ...]) -> float:
        """The factor of the logits with the least log-loss of the goals, in which all times count the same."""
        losses = [sum(row["loss"] for row in self.scores(logits, times, scale)) for scale in SCALES]
        return SCALES[losses.index(min(losses))]


def scores(logits: Tensor, goal: Tensor) -> dict[str, float]:
    """Log-loss (nats), accuracy (of equally probable goals one is drawn) and probability of goals `[B]`."""
    now = logits.log_softmax(-1)
    true = now.gather(1, goal[:, None])[:, 0]
    first = now >= now.amax(1, keepdim=True) - 1e-9
    right = (true >= now.amax(1) - 1e-9) / first.sum(1)
    means = {"loss": -true, "accuracy": right, "probability": true.exp()}
    return {"agents": len(goal)} | {name: float(values.mean()) for name, values in means.items()}


def make_scene(grid: GridWorld, settings: IntentionSettings, generator: torch.Generator) -> Scene:
    """Goals at random, and agents that take moves by a softmax of their optimal values.

    Each move costs 1; who is at the goal stays, at no cost.
    """
    cells, free = torch.arange(grid.num_states), (~grid.walls).flatten().nonzero()[:, 0]
    goals = free[torch.randperm(len(free), generator=generator)[: settings.goals]]
    values = torch.cat([value_iteration(grid, discount=DISCOUNT, goal=goal) for goal in goals.tolist()])
    # A cell at distance d has the value DISCOUNT ** (d - 1); a wall has none.
    path = (values.clamp(min=1e-100).log() / log(DISCOUNT) + 1).round()
    policies = torch.zeros(len(goals), grid.num_states, ACTIONS, dtype=torch.double)
    policies[..., :MOVES] = (-path[:, grid.next_state] / settings.temperature).softmax(-1)
    policies[torch.arange(len(goals)), goals] = torch.eye(ACTIONS, dtype=torch.double)[STAY]
    place = grid.coordinates(cells)
    straight = (place[goals][:, None] - place).abs().sum(-1).double()
    world = TabularWorld(torch.cat([grid.next_state, cells[:, None]], 1), torch.zeros(grid.num_states))
    return Scene(world, policies, path, straight, free)


def policy_prior(policy: Tensor) -> MarkovPrior:
    """A policy `[S, A]` as a prior: a chain of order 0 whose context is the cell."""
    cells = torch.arange(len(policy))[:, None]
    plans = Plans(torch.zeros_like(cells), policy.shape[1], context=cells)
    prior = MarkovPrior(policy.shape[1], 0, initial="lower", num_contexts=len(policy)).fit(plans)
    prior.log_probs[:-1] = policy.log()
    return prior


def walk(scene: Scene, goals: Tensor, generator: torch.Generator) -> tuple[Plans, Tensor]:
    """Walks of agents that are after `goals [B, L]` at each step, from cells that are not the first goal.

    Returns:
        Their moves up to the first stay, with the cell as context, and the cells `[B, L + 1]`, also after arrival.
    """
    start = torch.rand(len(goals), len(scene.free), generator=generator)
    start = start.masked_fill(scene.path[goals[:, 0]][:, scene.free] == 0, -1.0).argmax(1)
    cells, actions = [scene.free[start]], []
    for goal in goals.T:
        actions.append(scene.policies[goal, cells[-1]].multinomial(1, generator=generator)[:, 0])
        cells.append(scene.world.next_state[cells[-1], actions[-1]])
    taken, at = torch.stack(actions, 1), torch.stack(cells, 1)
    moves = ((taken == STAY).cumsum(1) == 0).sum(1)
    return Plans(taken, ACTIONS, lengths=moves, context=at[:, :-1]), at


def learned(
    scene: Scene, taught: Agents, plans: Plans, settings: IntentionSettings
) -> Iterator[tuple[Key, list[Prior], float]]:
    """Observers that learned from walks, as many toward each goal; from fewer: the first of them.

    Each has a prior for each goal, a Markov chain whose order and back-off predict held-out walks best, and the power
    of the likelihoods under which the goals of these are likeliest.
    """
    place = torch.arange(len(plans) // settings.goals).repeat(settings.goals)
    # What an agent does at the goal is learned, too.
    actions = plans.actions.masked_fill(~plans.mask(), STAY)
    closed = replace(plans, actions=actions, lengths=(taught.length + 1).clamp(max=LONGEST))
    closed = closed.steps(stop=int(taught.length.max()) + 1)
    for number, kind in product(settings.num_plans, ORDERS):
        taken, contexts = place < number, scene.world.num_states if kind == "cell" else None
        held_out = taken & (place >= number - max(round(VALIDATION * number), 1))
        walks, best = closed if contexts else closed.without_context(), []
        for k in range(settings.goals):
            counted, others = (walks[(taught.goal == k) & mask] for mask in (taken & ~held_out, held_out))
            tried = [Chains(counted, order, contexts) for order in ORDERS[kind]]
            likelihoods = torch.stack([chains.log_likelihood(others) for chains in tried])
            order, back_off = divmod(int(likelihoods.argmax()), likelihoods.shape[1])
            best.append(tried[order].chain(back_off))
        posterior = infer(best, closed[held_out]).log_probs
        power = Agents(taught.goal[held_out], taught.length[held_out]).best_scale(posterior, settings.observed)
        yield Key(kind, number), [prior.fit(walks[(taught.goal == k) & taken]) for k, prior in enumerate(best)], power


def progress(distance: Tensor, cells: Tensor) -> Tensor:
    """How much nearer walks through `cells [B, L + 1]` have come to each goal after each number of moves."""
    along = distance[:, cells].permute(1, 2, 0)
    return along[:, :1] - along


def grid_entries(world: str, settings: IntentionSettings, generator: torch.Generator) -> Iterator[dict[str, Any]]:
    """What each observer makes of the same agents in one layout; see `eval.intentions.run.intentions_run`."""
    scene = make_scene(WORLDS[world](seed=draw_seed(generator)), settings, generator)

    def walks(goal: Tensor) -> tuple[Plans, Tensor, Agents]:
        plans, cells = walk(scene, goal[:, None].expand(-1, LONGEST), generator)
        return plans, cells, Agents(goal, plans.mask().sum(1))

    training, trained, taught = walks(torch.arange(settings.goals).repeat_interleave(max(settings.num_plans)))
    plans, cells, seen = walks(torch.randint(settings.goals, (settings.agents,), generator=generator))
    priors: dict[Key, list[Prior]] = {Key("exact", 0): [*map(policy_prior, scene.policies)]}
    all_logits = {Key("uniform", 0): torch.zeros(settings.agents, LONGEST + 1, settings.goals).double()}
    for name, table in (("path", scene.path), ("straight", scene.straight)):
        scale = taught.best_scale(progress(table, trained), settings.observed)
        all_logits[Key(name, 0)] = scale * progress(table, cells)
    all_logits[Key("exact", 0)] = infer(priors[Key("exact", 0)], plans).log_probs
    for key, goal_priors, power in learned(scene, taught, training, settings):
        priors[key], all_logits[key] = goal_priors, infer(goal_priors, plans).log_probs
        all_logits[Key(f"{key.kind}, tempered", key.plans)] = power * all_logits[key]
    for key, logits in all_logits.items():
        named = key._asdict()
        for row in seen.scores(logits, settings.observed):
            yield named | {"measure": "moves"} | row
        for share in SHARES:
            now = logits[torch.arange(len(plans)), (share * seen.length).long()]
            yield named | {"measure": "way", "at": share} | scores(now, seen.goal)
        there, time = (seen.length[:, None] >= torch.tensor(settings.observed)).nonzero().T
        if len(there):
            now = logits[there, torch.tensor(settings.observed)[time]].log_softmax(-1)
            yield named | {"measure": "calibration", "sums": count_forecasts(now, seen.goal[there]).tolist()}
    yield from _switch_entries(scene, priors, settings, generator)
    mid_plan = (seen.length >= FORECAST_AFTER).nonzero()[:FORECASTED, 0]
    if len(mid_plan):
        posteriors = {key: all_logits[key][mid_plan, FORECAST_AFTER].exp() for key in priors}
        yield from _forecasts(scene, priors, posteriors, cells[mid_plan, FORECAST_AFTER:], settings.ahead, generator)


def _switch_entries(
    scene: Scene, priors: Mapping[Key, list[Prior]], settings: IntentionSettings, generator: torch.Generator
) -> Iterator[dict[str, Any]]:
    """The same of agents that turn to another goal after `SWITCH_AT` moves, and have not reached the first by then."""
    first = torch.randint(settings.goals, (settings.agents,), generator=generator)
    second = (first + torch.randint(1, settings.goals, first.shape, generator=generator)) % settings.goals
    plans, _ = walk(scene, torch.where(torch.arange(LONGEST) < SWITCH_AT, first[:, None], second[:, None]), generator)
    length = plans.mask().sum(1)
    kept = length >= SWITCH_AT
    for key, goal_priors in priors.items():
        for switch in (0.0, SWITCH):
            logits = infer(goal_priors, plans, switch=switch).log_probs[kept]
            # After the last move before, the goal is still the first.
            rows = Agents(first[kept], length[kept]).scores(logits, (SWITCH_AT,))
            rows += Agents(second[kept], length[kept]).scores(logits, tuple(SWITCH_AT + t for t in settings.observed))
            for row in rows:
                row = row | {"at": row["at"] - SWITCH_AT, "loss": None}  # infinite where switches are excluded
                yield key._asdict() | {"measure": "switched", "switch": switch} | row


def _forecasts(
    scene: Scene,
    priors: Mapping[Key, list[Prior]],
    posteriors: Mapping[Key, Tensor],
    cells: Tensor,
    times: tuple[int, ...],
    generator: torch.Generator,
) -> Iterator[dict[str, Any]]:
    """The log-loss of the cell in which agents are some moves later: `cells [B, 1 + moves]`."""
    states, now, size = scene.world.num_states, cells[:, 0], len(scene.free)
    steps = torch.zeros(len(scene.policies), states, states, dtype=torch.double)
    steps.scatter_add_(2, scene.world.next_state.expand(scene.policies.shape), scene.policies)
    for ahead in times:
        exact = (steps.matrix_power(ahead)[:, now] * posteriors[Key("exact", 0)].T[..., None]).sum(0)
        forecasts = {Key("exact", 0): exact, Key("uniform", 0): torch.full_like(exact, 1 / size)}
        for key, goal_priors in priors.items():
            share, seen = torch.zeros_like(exact), posteriors[key]
            share[:, scene.free] = forecast(goal_priors, scene.world, now, seen, ahead, SAMPLES, scene.free, generator)
            name = key._replace(kind="exact, sampled") if key.kind == "exact" else key
            forecasts[name] = (1 - FLOOR) * share + FLOOR / size
        for key, probs in forecasts.items():
            loss = float(-probs.gather(1, cells[:, ahead, None]).log().mean())
            yield key._asdict() | {"measure": "cell", "at": ahead, "agents": len(now), "loss": loss}
