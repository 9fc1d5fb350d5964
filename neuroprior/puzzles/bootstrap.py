"""Solve and learn: a prior learns from the problems that were solved with it, and solves the next ones faster."""

import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from hashlib import sha256
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError
from safetensors.torch import load as read_tensors
from safetensors.torch import save as write_tensors
from torch import Tensor

from neuroprior._checks import check_flags, check_sizes, kind_of
from neuroprior._files import read_json, write_json, written_whole
from neuroprior._folders import claim
from neuroprior._random import generator_on
from neuroprior.plans import Plans
from neuroprior.plans.sequences import Sequences, plans_digest
from neuroprior.priors import Prior, load, save
from neuroprior.priors.prior import check_is_prior
from neuroprior.puzzles.best_first import BestFirstPlanner, LevinPlanner, Search, follow_plans, pad_plans
from neuroprior.puzzles.priors.log_linear import LogLinearPrior, Steps
from neuroprior.puzzles.worlds.puzzle import PuzzleWorld
from neuroprior.sampling.stepping import Stepper
from neuroprior.worlds.world import World, check_is_world

ENOUGH = 0.75
"""Where this share of the problems tried is solved, more are tried in the next sweep."""

MORE = 4
"""Factor by which the number of problems rises then."""

NEW = 0.25
"""Where less than this share of the solutions is new, the budget doubles."""


class Sweep(NamedTuple):
    """A sweep of `bootstrap`.

    Attributes:
        number: from 1.
        problems: how many were tried.
        max_nodes: the budget of each.
        solved: the share of them that this sweep solved.
        solutions: problems with a solution so far.
        mean_expansions: over the problems tried; an unsolved one counts with what was spent on it.
        actions: of the solutions that the prior then learned from, with their reflections and rotations.
        search_seconds, fit_seconds: of this sweep.
    """

    number: int
    problems: int
    max_nodes: int
    solved: float
    solutions: int
    mean_expansions: float
    actions: int
    search_seconds: float
    fit_seconds: float


def bootstrap(
    world: World,
    prior: Prior,
    problems: Tensor,
    *,
    max_nodes: int = 2000,
    sweeps: int = 10,
    first: int = 1000,
    max_actions: int = 2_000_000,
    teacher: BestFirstPlanner | None = None,
    guided: bool = False,
    folder: str | PathLike[str] | None = None,
    generator: torch.Generator | None = None,
    **settings: Any,
) -> Iterator[Sweep]:
    """Solve problems with a prior, fit it to the solutions, and again.

    The idea is that of Arfaee, Zilles and Holte (*Learning heuristic functions for large state spaces*, Artificial
    Intelligence, 2011); with a prior, that of Orseau and Lelis (AAAI 2021).

    The first `first` problems are tried first. When three quarters of them are solved, four times as many are tried.
    The budget doubles then, and when fewer than a quarter of the solutions, or none, are new. Each problem's latest
    solution counts. In puzzles the prior learns from reflections and rotations of the solutions, too.

    Args:
        world: with goals; see `LevinPlanner`.
        prior: fitted in place; count-based priors anew, others from their present weights.
        problems: `[N, ...]` starts.
        max_nodes: expansions for each problem in the first sweep.
        sweeps: number of sweeps.
        first: problems in the first sweep.
        max_actions: reflections and rotations are added up to about so many actions of all solutions together; bounds
            memory and time.
        teacher: searches in the first sweep, such as an `AStarPlanner`; None: the prior as it is.
        guided: search with the world's `lower_bound` as heuristic (PHS*).
        folder: the prior, the solutions and the sweeps are kept there after each sweep, and an interrupted call goes on
            from them (or takes the first `sweeps` of them); None: nothing is kept.
        generator: draws symmetries, and what the prior's `fit` draws.
        **settings: of the prior's `fit`.

    Yields:
        Each sweep, when the prior has learned from it; finished ones of `folder` at once.

    Raises:
        ValueError: an argument is out of range, the prior cannot act in the world, nothing is solved in any sweep, or
            the folder is damaged or of another call.

    Example:
        >>> world, generator = sliding_tiles(shape=(2, 2), scramble=6), torch.Generator().manual_seed(0)
        >>> prior = LogLinearPrior(4, num_patterns=len(world.windows.windows))
        >>> [
        ...     sweep.solved
        ...     for sweep in bootstrap(world, prior, world.reset(20, generator), sweeps=1, generator=generator)
        ... ]
        [1.0]
    """
    check_sizes(max_nodes=max_nodes, sweeps=sweeps, first=first, max_actions=max_actions)
    check_flags(guided=guided)
    check_is_world(world)
    check_is_prior(prior)
    if not isinstance(teacher, BestFirstPlanner | None):
        raise ValueError(f"`teacher` must be a BestFirstPlanner, such as AStarPlanner(), got {kind_of(teacher)}.")
    world.check_state(problems)
    if len(problems) == 0:
        raise ValueError("`problems` must hold at least one problem, got none.")
    if guided and not hasattr(world, "lower_bound"):
        raise ValueError(f"`guided` must be False where the world has no lower_bound, got {type(world).__name__}.")
    prior.check_settings(settings)
    Stepper(prior).start_in(world, problems[:1])  # a teacher would ask it for nothing before it has searched
    generator = generator_on(generator, "cpu")
    digest = sha256(problems.cpu().contiguous().view(torch.uint8).numpy().tobytes()).hexdigest()
    asked: dict[str, Any] = {
        "problems": len(problems),
        "max_nodes": max_nodes,
        "first": first,
        "guided": guided,
        "digest": digest,
        "max_actions": max_actions,
        "world": type(world).__name__,
        "teacher": None if teacher is None else _describe(teacher),
        "settings": {
            name: plans_digest(value) if isinstance(value, Sequences) else repr(value)
            for name, value in sorted(settings.items())
            if name != "progress"
        },
    }
    with nullcontext() if folder is None else claim(Path(folder), name="folder"):
        run = _Bootstrap(world, prior, problems, asked, None if folder is None else Path(folder), generator, sweeps)
        yield from run.done
        while len(run.done) < sweeps:
            tried, budget = run.next()
            with_teacher = teacher is not None and not run.done
            heuristic = world.lower_bound if guided else None  # type: ignore[attr-defined]
            planner = teacher if with_teacher else LevinPlanner(prior, budget, heuristic=heuristic)
            assert planner is not None
            begin = time.perf_counter()
            result = planner.search(world, problems[:tried])
            run.take(result)
            searched = time.perf_counter()
            actions = run.learn(max_actions, settings)
            seconds = searched - begin, time.perf_counter() - searched
            share, mean = float(result.solved.double().mean()), float(result.expansions.double().mean())
            run.end(Sweep(len(run.done) + 1, tried, planner.max_nodes, share, len(run.plans), mean, actions, *seconds))
            yield run.done[-1]
        if not run.plans:
            last = run.done[-1]
            raise ValueError(
                f"`max_nodes` must be enough to solve some of {last.problems} problems, got none that {last.max_nodes}"
                " expansions solve. Give a larger max_nodes, more sweeps, a teacher or easier problems."
            )


def _describe(teacher: BestFirstPlanner) -> dict[str, Any]:
    """The class of a teacher, the class of its prior, whether it has a heuristic, and its numbers."""
    about = {"class": type(teacher).__name__, "prior": type(teacher.prior).__name__}
    numbers = {name: value for name, value in vars(teacher).items() if isinstance(value, bool | int | float)}
    return about | {"informed": teacher.heuristic is not None} | numbers


class _Bootstrap:
    """The solutions and sweeps of a call of `bootstrap`, and the folder where they are kept."""

    def __init__(
        self,
        world: World,
        prior: Prior,
        problems: Tensor,
        asked: dict[str, Any],
        folder: Path | None,
        generator: torch.Generator,
        sweeps: int,
    ) -> None:
        self.world, self.prior, self.problems, self.asked, self.folder = world, prior, problems, asked, folder
        self.generator, self.plans, self.done = generator, dict[int, Tensor](), list[Sweep]()
        if folder is not None and (folder / "sweeps.json").exists():
            self._restore(folder, sweeps)

    def next(self) -> tuple[int, int]:
        """How many problems the next sweep tries, and its budget."""
        tried, budget = min(self.asked["first"], len(self.problems)), self.asked["max_nodes"]
        before = 0
        for sweep in self.done:
            gained, before = sweep.solutions - before, sweep.solutions
            more = sweep.solved >= ENOUGH and tried < len(self.problems)
            if more:
                tried = min(MORE * tried, len(self.problems))
            if more or gained < NEW * sweep.solutions or sweep.solutions == 0:
                budget *= 2
        return tried, budget

    def take(self, result: Search) -> None:
        """Keep the solutions of a search."""
        for number in result.solved.nonzero()[:, 0].tolist():
            self.plans[number] = result.plan[number, : int(result.lengths[number])].cpu()

    def learn(self, max_actions: int, settings: dict[str, Any]) -> int:
        """Fit the prior to the solutions and, in puzzles, to their reflections and rotations.

        Returns:
            The number of actions that it learned from; with none it stays as it is.
        """
        numbers = [number for number in sorted(self.plans) if len(self.plans[number])]
        if not numbers:
            return 0
        state, plans = self.problems[torch.tensor(numbers)], [self.plans[number] for number in numbers]
        if isinstance(self.world, PuzzleWorld):
            times = max_actions // sum(map(len, plans))
            state, plans = with_symmetries(self.world, state, plans, times, self.generator)
        order = torch.randperm(len(plans), generator=self.generator)
        state, plans = state[order], [plans[k] for k in order.tolist()]
        if isinstance(self.prior, LogLinearPrior):
            self.prior.fit_steps(solution_steps(self.world, state, plans), generator=self.generator, **settings)
        else:
            seen = solution_plans(self.world, state, plans, self.prior.context_per)
            self.prior.fit(seen, generator=self.generator, **settings)
        return sum(map(len, plans))

    def end(self, sweep: Sweep) -> None:
        """Keep a finished sweep."""
        self.done.append(sweep)
        if self.folder is None:
            return
        save(self.prior, self.folder / f"prior-{sweep.number}")
        plans = {str(number): plan for number, plan in self.plans.items()}
        with written_whole(self.folder / f"solutions-{sweep.number}.safetensors", "wb") as file:
            file.write(write_tensors(plans))
        rows = [one._asdict() for one in self.done]
        kept = {"asked": self.asked, "sweeps": rows, "generator": self.generator.get_state().tolist()}
        write_json(self.folder / "sweeps.json", kept)

    def _restore(self, folder: Path, sweeps: int) -> None:
        kept = _read_sweeps(folder)
        if kept["asked"] != self.asked:
            raise ValueError(f"`folder` must hold sweeps of the same call, got {folder}, of {kept['asked']}.")
        self.done = kept["sweeps"][:sweeps]
        last = self.done[-1].number
        saved = load(folder / f"prior-{last}")
        if type(saved) is type(self.prior):
            # First: it may choose sizes, and make the modules that hold the state.
            self.prior.restore(saved.learned)
        if type(saved) is not type(self.prior) or saved.config != self.prior.config:
            raise ValueError(f"`folder` must hold {self.prior}, got {folder}, which holds {saved}.")
        self.prior.load_state_dict(saved.state_dict())
        self.plans = read_solutions(folder, last)
        plans, state = list(self.plans.values()), self.problems[torch.tensor(list(self.plans), dtype=torch.long)]
        lengths = torch.tensor([len(plan) for plan in plans], dtype=torch.long)
        final, _ = follow_plans(self.world, state, pad_plans(plans, self.world.num_actions), lengths)
        if not bool(self.world.solved(final).all()):
            raise ValueError(f"`folder` must hold solutions in this world, got {folder}, of another.")
        self.generator.set_state(torch.tensor(kept["generator"], dtype=torch.uint8))


def _read_sweeps(folder: Path) -> dict[str, Any]:
    """What `sweeps.json` holds; ValueError for a damaged file."""
    path = folder / "sweeps.json"
    kept = read_json(path)
    try:
        content = {
            "asked": kept["asked"],
            "generator": kept["generator"],
            "sweeps": [Sweep(**s) for s in kept["sweeps"]],
        }
    except (KeyError, TypeError):
        content = {"sweeps": []}
    if not content["sweeps"]:
        raise ValueError(f"{path}: it must hold sweeps, got a damaged file. Give another folder.")
    return content


def read_solutions(folder: str | PathLike[str], sweep: int | None = None) -> dict[int, Tensor]:
    """The actions of each problem that was solved so far, by its number, from the folder of a call of `bootstrap`.

    Args:
        folder: of the call.
        sweep: up to this one; None: the last.

    Raises:
        OSError: there is none.
        ValueError: a file is damaged.
    """
    number = _read_sweeps(Path(folder))["sweeps"][-1].number if sweep is None else sweep
    path = Path(folder) / f"solutions-{number}.safetensors"
    try:
        tensors = read_tensors(path.read_bytes())
    except SafetensorError as error:
        raise ValueError(f"{path}: it must hold solutions, got a damaged file ({error}).") from error
    return {int(name): plan for name, plan in sorted(tensors.items())}


def with_symmetries(
    world: PuzzleWorld, state: Tensor, plans: Sequence[Tensor], times: int, generator: torch.Generator
) -> tuple[Tensor, list[Tensor]]:
    """Each solution under `times` symmetries, or as many as there are: itself, and others that are drawn for each."""
    number = world.symmetries()
    drawn = torch.rand(len(plans), number, generator=generator)
    drawn[:, 0] = -1  # itself
    chosen = drawn.argsort(1)[:, : min(max(times, 1), number)]
    states, more = [], list[Tensor]()
    for symmetry in range(number):
        rows = (chosen == symmetry).any(1).nonzero()[:, 0]
        states.append(world.transformed(state[rows], symmetry))
        renamed = world.transformed_actions(symmetry).to(torch.uint8)
        more += [renamed[plans[row].long()] for row in rows.tolist()]
    return torch.cat(states), more


def solution_steps(world: World, state: Tensor, plans: Sequence[Tensor]) -> Steps:
    """The steps of plans from `state [N, ...]`, in a world whose observations are patterns, plan after plan."""
    action, lengths = torch.cat(list(plans)).long(), torch.tensor([len(plan) for plan in plans])
    begin = lengths.cumsum(0) - lengths
    last = torch.nn.functional.pad(action, (1, -1))
    last[begin] = world.num_actions
    patterns = torch.zeros(len(action), world.observe(state[:1]).shape[1], dtype=torch.int32)
    now = state.clone()
    for t in range(int(lengths.max())):
        on = (lengths > t).nonzero()[:, 0]
        patterns[begin[on] + t] = world.observe(now[on]).cpu()
        now[on], _ = world.step(now[on], action[begin[on] + t].to(now.device))
    return Steps(patterns, last, action, torch.arange(len(plans)).repeat_interleave(lengths))


def solution_plans(world: World, state: Tensor, plans: Sequence[Tensor], context: str | None) -> Plans:
    """Plans from `state [N, ...]` as `Plans`, with what the world observes on the way, as a prior takes it."""
    lengths = torch.tensor([len(plan) for plan in plans])
    actions = pad_plans(plans, world.num_actions)
    seen, now = [], state
    for t in range(actions.shape[1]):
        seen.append(world.observe(now))
        now, _ = world.step(now, actions[:, t].long())
    observed = None if context is None else torch.stack(seen, 1) if context == "step" else seen[0]
    return Plans(actions, world.num_actions, lengths, world.action_names, observed, world.group(state))
