"""The paper's first simulation: planners on a grid of random rewards, with and without behavioural priors."""

from typing import NamedTuple

import pandas as pd
import torch
from torch import Tensor

from eval.paper.planners import (
    Finished,
    PaperSettings,
    best_markov,
    fit_priors,
    groups,
    make_planners,
    paired_table,
    share_table,
)
from neuroprior import ExhaustivePlanner, MarkovPrior, Plans, gridworld, oracle
from neuroprior.planners import Decision
from neuroprior.plans import all_plans
from neuroprior.worlds import GridWorld

PAPER_BEST = {"deterministic": 0.321, "random": 0.537, "markov-1": 0.841, "markov-2": 0.844}
"""Hyvärinen, Table 1: in what share of the starts each planner was best, of these four."""

PAPER_MATRIX = torch.tensor([[(0.60, 0.20, 0.0, 0.20)[(b - a) % 4] for b in range(4)] for a in range(4)])
"""Hyvärinen's transition matrix, about: repeat the last move, turn, reverse it, turn the other way."""

PROTOCOLS = {"edges": ("torus", "wall"), "ties": ("uniform", "first"), "learn_from": ("all", "shortest")}
"""What the paper leaves open."""


def best_of(scores: Tensor, baselines: Tensor) -> Tensor:
    """`[K, ...]`: where each of K planners was at least as good as every baseline `[B, ...]`: ties count for each."""
    return scores >= baselines.amax(0)


class FirstResult(NamedTuple):
    """The first simulation under one protocol, in W worlds with n starts in each."""

    world: GridWorld
    states: Tensor  # [W, n]: the starts
    decisions: dict[str, Decision]  # of each planner, for the starts flattened
    oracle: Tensor  # [W, n]: the best of any plan
    transition_matrix: Tensor  # [A, A], of the Markov prior of order 1

    def scores(self) -> dict[str, Tensor]:
        """Of each planner: `[W, n]`."""
        return {name: decision.score.view(self.states.shape) for name, decision in self.decisions.items()}

    def table(self) -> pd.DataFrame:
        """Table 1: in what share of the starts each planner was best of the paper's four, and its rewards."""
        scores = self.scores() | {"oracle": self.oracle}
        best = best_of(torch.stack([*scores.values()]), torch.stack([scores[name] for name in PAPER_BEST]))
        steps = [decision.model_steps for decision in self.decisions.values()]
        return share_table("best", dict(zip(scores, best, strict=True)), PAPER_BEST).assign(
            mean_reward=[float(score.double().mean()) for score in scores.values()],
            oracle_share=[float(score.double().sum() / self.oracle.double().sum()) for score in scores.values()],
            at_oracle=[float((score >= self.oracle).double().mean()) for score in scores.values()],
            model_steps=pd.array([*steps, None], dtype="Int64"),
        )

    def paired(self) -> pd.DataFrame:
        """Neural priors minus the best Markov prior: in how many more starts they found the best plan of all.

        Paired over worlds; empty for a single world.
        """
        if len(self.oracle) < 2:
            return pd.DataFrame()
        optimal = {name: (score >= self.oracle).double().mean(1) for name, score in self.scores().items()}
        return paired_table(optimal, [(name, best_markov(optimal)) for name in ("gru", "transformer")])

    def matrix(self) -> pd.DataFrame:
        """The transition matrix of the Markov prior of order 1, a row for each pair of moves."""
        names = self.world.action_names or ()
        return pd.DataFrame(
            {"after": a, "next": b, "learned": float(self.transition_matrix[i, j]), "paper": float(PAPER_MATRIX[i, j])}
            for i, a in enumerate(names)
            for j, b in enumerate(names)
        )

    def summary(self) -> dict[str, float]:
        """The paper's four shares, the structure of the matrix, and how far both are from the paper's.

        Distances are root mean squares.
        """
        best = self.table().set_index("planner").best
        shares = {name: float(best[name]) for name in PAPER_BEST}
        gaps = torch.tensor([shares[name] - PAPER_BEST[name] for name in PAPER_BEST])
        return {
            **shares,
            **structure(self.transition_matrix),
            "table_distance": float(gaps.square().mean().sqrt()),
            "matrix_distance": float((self.transition_matrix - PAPER_MATRIX).square().mean().sqrt()),
        }


def structure(matrix: Tensor) -> dict[str, float]:
    """How often the last move is repeated, turned from (to either side), and reversed."""
    repeat, left, reverse, right = (torch.stack([matrix[a, (a + d) % 4] for a in range(4)]).mean() for d in range(4))
    return {"repeat": float(repeat), "turn": (float(left) + float(right)) / 2, "reverse": float(reverse)}


def simulate(settings: PaperSettings, neural: bool, finished: Finished = lambda _: None) -> FirstResult:
    """Collect plans, fit the priors (neural ones too, or not), and let all planners plan from the same starts.

    With one world the priors learn in the world where they are used; with more, in as many other ones. `finished` is
    called 11 times, without neural priors 7 times.
    """
    worlds, starts = settings.worlds, settings.starts
    generator = torch.Generator().manual_seed(settings.seed)
    more = worlds if worlds > 1 else 0
    side, power = settings.size, settings.reward_power
    world = gridworld(side, side, settings.edges, reward_power=power, num_worlds=worlds + more, seed=settings.seed)
    cells = world.num_states
    learn_in = more * cells + torch.randint(worlds * cells, (settings.training_plans,), generator=generator)
    plans = training_plans(world, learn_in, settings, generator)
    finished("collecting plans")
    planners = make_planners(fit_priors(plans, settings, neural, generator, finished), settings)
    start = torch.randint(cells, (worlds, starts), generator=generator)
    states = start + torch.arange(worlds)[:, None] * cells
    decisions = {}
    for name, planner in planners.items():
        decisions[name] = planner.plan(world, states.flatten(), generator)
        finished(f"planning: {name}")
    best = oracle(world, states.flatten(), settings.length).view(states.shape)
    finished("planning: oracle")
    return FirstResult(world, states, decisions, best, MarkovPrior(4, 1).fit(plans).transition_matrix())


def training_plans(world: GridWorld, states: Tensor, settings: PaperSettings, generator: torch.Generator) -> Plans:
    """The executed plans of the deterministic planner that the priors learn from."""
    depth = settings.depth
    decision = ExhaustivePlanner(depth).plan(world, states, generator)
    actions = decision.plan.long()
    if settings.ties == "first":
        actions = _first_of_equals(world, states, decision.score, depth)
    kept = torch.ones(len(states), dtype=torch.bool)
    if settings.learn_from == "shortest":
        gap = (world.coordinates(states) - world.coordinates(decision.final_state)).abs()
        if world.edges == "torus":
            gap = torch.minimum(gap, torch.tensor([world.height, world.width]) - gap)
        kept = gap.sum(-1) == depth
    if int(kept.sum()) < 2:
        raise ValueError("training_plans: too few plans to learn from; give more, or a larger grid")
    return Plans(actions[kept], 4, action_names=world.action_names, group=groups(world, states[kept]))


def _first_of_equals(world: GridWorld, states: Tensor, score: Tensor, depth: int) -> Tensor:
    """For each start the first, in the order of their numbers, of the plans with `score`: `[N, depth]`."""
    every = all_plans(4, depth)
    chosen = []
    for batch, best in zip(states.split(4096), score.split(4096), strict=True):
        rewards = world.rollout(batch, every.expand(len(batch), *every.shape)).rewards[..., -1]
        chosen.append(every[(rewards == best[:, None]).int().argmax(1)])
    return torch.cat(chosen)
