"""Normalised scores against the number of candidate plans: what a planner reaches that samples from a prior."""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import torch
from torch import Tensor

from eval.worlds.suite import Task, best_score
from neuroprior import Prior, SamplingPlanner, TabularWorld, World
from neuroprior.planners import expected_score

ROLLOUTS = 16
"""Simulations of each candidate in a stochastic world."""

ROWS = 2**15
"""Candidates drawn together; with more the caches of a transformer are slower to move than to compute."""

TEMPERATURES = (1.0, 1.5, 2.0)
"""At which priors may be sampled: an overconfident prior tries the same plans again and again."""

DRAWN, AGAIN = 20, 9
"""For each start that is wanted so many are drawn, and, if too few of them are of use, so many times again."""

CLOSE = 1e-6
"""A score this near to the optimum is optimal."""


@dataclass(frozen=True, eq=False)
class Starts:
    """B starts of a world, with the best score that can be reached from each.

    Attributes:
        task: what is optimised.
        world: the held-out world, or the validation world.
        state: `[B, ...]`.
        length: number of actions in a plan.
        best: `[B]`: the optimal scores.
        reference: the score that counts as 0: 0 if rewards are never negative, else the mean score of a single plan of
            random moves.
    """

    task: Task
    world: World
    state: Tensor
    length: int
    best: Tensor
    reference: float

    def normalised(self, score: Tensor) -> float:
        """The normalised score of scores `[B]`: 0 for the reference, 1 for the optimum."""
        gained, most = (values.double() - self.reference for values in (score, self.best))
        return float(gained.mean() / most.mean())

    def reached(self, score: Tensor) -> dict[str, float]:
        """Of scores of decisions, `[B, D]` or `[B]`: the normalised score, the share of optimal ones, and the mean."""
        score = score.double().view(len(self.best), -1)
        optimal = (score >= self.best[:, None] - CLOSE).double().mean()
        return {"share": self.normalised(score.mean(1)), "at_oracle": float(optimal), "score": float(score.mean())}


def starts_of(task: Task, world: World, number: int, length: int, generator: torch.Generator) -> Starts:
    """Random starts; if rewards are never negative, only those with an optimum above 0.

    Raises:
        ValueError: there are hardly any.
    """
    costs = isinstance(world, TabularWorld) and float(world.reward.min()) < 0
    states, bests = [], []
    for _ in range(1 + AGAIN):
        drawn = world.reset(DRAWN * number, generator)
        gain = best_score(task, world, drawn, length)
        useful = (gain > 0) | costs
        states.append(drawn[useful])
        bests.append(gain[useful])
        if sum(map(len, states)) >= number:
            break
    state, best = torch.cat(states), torch.cat(bests)
    if len(state) < number:
        tried = (1 + AGAIN) * DRAWN * number
        raise ValueError(f"only {len(state)} of {tried} starts are such that a plan of {length} actions gains")
    reference = 0.0
    if costs:
        plans = torch.randint(world.num_actions, (len(state), 1, length), generator=generator)
        reference = float(worth(task, world, state, plans).mean())
    return Starts(task, world, state[:number], length, best[:number], reference)


def planner_of(starts: Starts, prior: Prior, num_plans: int, temperature: float) -> SamplingPlanner:
    """A planner that samples its candidates from a prior."""
    how = starts.task.scoring | {"num_rollouts": ROLLOUTS, "temperature": temperature}
    return SamplingPlanner(prior, starts.length, num_plans, **how)


def best_temperature(starts: Starts, prior: Prior, num_plans: int, generator: torch.Generator) -> float:
    """The one of `TEMPERATURES` at which a prior's plans reach the most from these starts."""
    shares = {t: curve(starts, prior, generator, t, [num_plans])["share"][0] for t in TEMPERATURES}
    return max(shares, key=lambda t: shares[t])


def curve(
    starts: Starts, prior: Prior, generator: torch.Generator, temperature: float, budgets: Sequence[int]
) -> dict[str, list[float]]:
    """What a sampling planner reaches with each number of candidates.

    The largest number is drawn once from each start. Smaller numbers are blocks of it, each block a decision. The
    planner chooses by its own estimates; what counts are exact scores, which differ in stochastic worlds.

    Returns:
        See `Starts.reached`, a list for all numbers.
    """
    planner, estimates, scores = planner_of(starts, prior, max(budgets), temperature), [], []
    for state in starts.state.split(max(ROWS // planner.num_plans, 1)):
        plans, score, _ = planner.candidates(starts.world, state, generator)
        if score.dim() == 3:  # any prefix may win
            score = score.amax(-1)
        estimates.append(score)
        scores.append(worth(starts.task, starts.world, state, plans) if starts.world.stochastic else score)
    estimated, exact = torch.cat(estimates), torch.cat(scores)
    found = []
    for budget in budgets:
        blocks = estimated.shape[1] // budget
        shape = (len(estimated), blocks, budget)
        chosen = estimated[:, : blocks * budget].view(shape).argmax(-1, keepdim=True)
        found.append(starts.reached(exact[:, : blocks * budget].view(shape).gather(-1, chosen)[..., 0]))
    return {name: [one[name] for one in found] for name in found[0]}


def seconds_per_decision(
    starts: Starts, prior: Prior, generator: torch.Generator, temperature: float, budgets: Sequence[int], number: int
) -> dict[int, tuple[float, int]]:
    """By number of candidates the seconds and model steps that a decision takes, at `number` starts together."""
    state, taken = starts.state[:number], {}
    planners = [planner_of(starts, prior, budget, temperature) for budget in budgets]
    # The first call is slower than those that follow, and the largest makes room for all.
    largest = max(planners, key=lambda planner: planner.num_plans)
    largest.plan(starts.world, state, torch.Generator(generator.device).manual_seed(0))
    for planner in planners:
        begin = perf_counter()
        decision = planner.plan(starts.world, state, generator)
        taken[planner.num_plans] = (perf_counter() - begin) / len(state), decision.model_steps
    return taken


def worth(task: Task, world: World, state: Tensor, plans: Tensor) -> Tensor:
    """The exact mean scores `[B, P]` of plans in a table."""
    assert isinstance(world, TabularWorld)
    return expected_score(world, state, plans, objective=task.objective, discount=task.discount)
