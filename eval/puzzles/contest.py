"""What is compared: a prior bootstrapped on training problems, and searches without any."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch.nn.functional import pad

from neuroprior.planners import FrontierPlanner, MCTSPlanner, Planner
from neuroprior.priors import UniformPrior, load
from neuroprior.puzzles import (
    AStarPlanner,
    BestFirstPlanner,
    LevinPlanner,
    LogLinearPrior,
    PuzzleWorld,
    Search,
    bootstrap,
    sliding_tiles,
    sokoban,
)
from neuroprior.puzzles.worlds.rules import WALL

BOOTSTRAP = "bootstrap"
"""The prior that found the solutions."""

REROOTED = "rerooted"
"""The bootstrapped prior in a search with rerooting."""

SEARCHES: dict[str, Callable[[PuzzleWorld, int], BestFirstPlanner]] = {
    "uniform": lambda world, budget: LevinPlanner(UniformPrior(4), budget),
    "a-star": lambda world, budget: AStarPlanner(world.lower_bound, 1, budget),
    "weighted-a-star": lambda world, budget: AStarPlanner(world.lower_bound, 5, budget),
    "greedy": lambda world, budget: AStarPlanner(world.lower_bound, inf, budget),
    "breadth-first": lambda world, budget: AStarPlanner(None, 1, budget),
}
"""Searches that learn nothing."""

PLANNERS: dict[str, Callable[..., Planner]] = {"frontier": FrontierPlanner, "mcts": MCTSPlanner}
"""Planners that maximise the reward, which is 1 for the move that solves a problem, with the bootstrapped prior."""

PLAN_LENGTH = {"sokoban": 100, "tiles": 300}
"""Moves of their plans: more than nearly all solutions need. As many plans are tried as the budget allows."""

SLOW_PROBLEMS, SLOW_BUDGET = 50, 2000
"""Problems and expansions at most for these planners."""

TEACHER = 100_000, 5.0
"""Budget and weight of the weighted A* that solves the first sliding tiles."""

FIRST_NODES = {"sokoban": 2_000, "tiles": 10_000}
"""Expansions for each problem in the first sweep."""

LETTERS = "udlr"
"""Moves in files."""

WorldName = Literal["sokoban", "tiles"]


@dataclass(frozen=True)
class Settings:
    """All that decides the results of a seed; see `eval.puzzles.command.puzzles`."""

    world: str
    train: str
    num_train: int
    test: str
    num_test: int | None
    budget: int
    sweeps: int
    guided: bool
    seed: int


class Job(NamedTuple):
    """A prior, by its name, of a seed."""

    seed: int
    prior: str

    @property
    def name(self) -> str:
        """Its name in messages and files."""
        return f"{self.prior}-{self.seed}"


class Problems(NamedTuple):
    """A puzzle and uint8 boards `[n, H, W]`."""

    world: PuzzleWorld
    boards: torch.Tensor


def problems_of(settings: Settings) -> tuple[Problems, Problems]:
    """The training and the test problems; where Sokoban levels are of two sizes, walls make the smaller ones larger.

    Raises:
        ValueError: a file holds none, or sliding tiles of another size; the message names it.
        OSError: a file cannot be read.
    """
    make: Callable[..., PuzzleWorld] = sokoban if settings.world == "sokoban" else sliding_tiles
    worlds = [make(file) for file in (settings.train, settings.test)]
    expected, test_shape = (list(world.shape) for world in worlds)
    if expected != test_shape and settings.world == "sokoban":
        high, wide = map(max, zip(expected, test_shape, strict=True))
        boards = [world.boards for world in worlds if world.boards is not None]
        padded = [pad(layout, (0, wide - layout.shape[2], 0, high - layout.shape[1]), value=WALL) for layout in boards]
        worlds = [sokoban(layout) for layout in padded]
    elif expected != test_shape:
        raise ValueError(f"{settings.test}: boards must be {expected}, as in {settings.train}, got {test_shape}.")
    numbers = settings.num_train, settings.num_test
    train, test = (
        Problems(world, world.boards[:number])
        for world, number in zip(worlds, numbers, strict=True)
        if world.boards is not None
    )
    return train, test


def bootstrapped(settings: Settings, folder: Path, seed: int) -> list[dict[str, Any]]:
    """Bootstrap a prior on the training problems; its sweeps, also those before an interruption."""
    train, _ = problems_of(settings)
    how: dict[str, Any] = {"max_nodes": FIRST_NODES[settings.world], "guided": settings.guided}
    if settings.world == "tiles":
        nodes, weight = TEACHER
        how["teacher"] = AStarPlanner(train.world.lower_bound, weight, nodes)
    prior = LogLinearPrior(4, len(train.world.windows.windows))
    how |= {"folder": folder / f"seed-{seed}", "generator": torch.Generator().manual_seed(seed)}
    sweeps = bootstrap(train.world, prior, _shuffle(train.boards, settings, seed), sweeps=settings.sweeps, **how)
    return [{"seed": seed} | sweep._asdict() for sweep in sweeps]


def _shuffle(boards: torch.Tensor, settings: Settings, seed: int) -> torch.Tensor:
    """The training problems in the order of a seed."""
    generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + seed)
    return boards[torch.randperm(len(boards), generator=generator)]


def contest(settings: Settings, folder: Path, job: Job) -> dict[str, Any]:
    """Search each test problem with the prior of a seed, and replay what was found.

    Raises:
        RuntimeError: a solution does not solve its problem, or took more expansions than the bound allows.
    """
    _, (test, problems) = problems_of(settings)
    budget = settings.budget
    planner: Planner
    if job.prior in SEARCHES:
        planner = SEARCHES[job.prior](test, budget)
    else:
        prior = load(folder / f"seed-{job.seed}" / f"prior-{settings.sweeps}")
        if job.prior in PLANNERS:
            problems, budget = problems[:SLOW_PROBLEMS], min(budget, SLOW_BUDGET)
        heuristic = test.lower_bound if settings.guided else None
        planner = LevinPlanner(prior, budget, heuristic=heuristic, reroot=job.prior == REROOTED)
        if job.prior in PLANNERS:
            value = None if heuristic is None else lambda state: -test.lower_bound(state).double()
            length = min(PLAN_LENGTH[settings.world], budget)
            planner = PLANNERS[job.prior](prior, length, budget // length, objective="return", value=value)
    generator = torch.Generator().manual_seed(job.seed)
    _search(planner, test, problems[:1], generator)  # compiled loops are loaded
    begin = time.perf_counter()
    outcome = _search(planner, test, problems, generator)
    seconds = time.perf_counter() - begin
    if not bool((test.solved(outcome.final_state) == outcome.solved).all()):
        raise RuntimeError(f"{job.name}: a plan does not do what the search says")
    bounded = isinstance(planner, LevinPlanner) and planner.heuristic is None
    if bounded and bool((outcome.expansions.double().log() > outcome.log_bound + 1e-9).any()):
        raise RuntimeError(f"{job.name}: more expansions than the bound allows")
    moves = [
        "".join(LETTERS[action] for action in plan[:length]) if solved else None
        for plan, length, solved in zip(
            outcome.plan.tolist(), outcome.lengths.tolist(), outcome.solved.tolist(), strict=True
        )
    ]
    return job._asdict() | {
        "budget": budget,
        "seconds": seconds,
        "expansions": outcome.expansions.tolist(),
        "log_bound": [bound if np.isfinite(bound) else None for bound in outcome.log_bound.tolist()],
        "moves": moves,
    }


def _search(planner: Planner, world: PuzzleWorld, state: torch.Tensor, generator: torch.Generator) -> Search:
    """What a planner finds; of one that searches for no goal, its plan up to the move that solves the problem.

    Its expansions are simulator steps: the prior is asked for the actions after each.
    """
    if isinstance(planner, BestFirstPlanner):
        return planner.search(world, state)
    decision = planner.plan(world, state, generator)
    states = world.rollout(state, decision.plan[:, None], keep_states=True).states
    assert states is not None
    reached = world.solved(states.flatten(0, 2)).view(len(state), -1)
    solved, steps = reached.any(1), torch.full((len(state),), decision.model_steps)
    lengths = torch.where(solved, reached.int().argmax(1) + 1, reached.shape[1])
    unbounded = torch.full((len(state),), inf, dtype=torch.float64)
    return Search(solved, decision.plan, lengths, decision.score, decision.final_state, steps, unbounded, steps)
