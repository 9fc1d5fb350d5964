"""Solve and learn: a prior learns from the problems that were solved with it, and solves the next ones faster."""

import time
from collections.abc import Iterator, Sequence
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
from neuroprior._random import generator_on
from neuroprior.plans import Plans, action_dtype
from neuroprior.plans.sequences import Sequences, plans_digest
from neuroprior.priors import Prior, load, save
from neuroprior.priors.prior import check_is_prior
from neuroprior.priors.serialization import written_state
from neuroprior.puzzles.best_first import BestFirstPlanner, Heuristic, LevinPlanner, Search
from neuroprior.puzzles.priors.pattern_prior import PatternPrior, Steps
from neuroprior.puzzles.worlds.puzzle import PuzzleWorld
from neuroprior.sampling.stepping import Stepper
from neuroprior.worlds.world import World, check_is_world

ENOUGH = 0.75
"""Where this share of the problems tried is solved, more are tried in the next sweep."""

MORE = 4
"""Factor by which the number of problems rises then."""

WALKS, WALK = 64, 32
"""Problems and random actions by which the world of a folder is recognised."""

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
        raise ValueError(f"teacher: a BestFirstPlanner, such as AStarPlanner(), is expected, not {kind_of(teacher)}")
    world.check_state(problems)
    if len(problems) == 0:
        raise ValueError("problems: at least one is expected")
    if guided and not hasattr(world, "lower_bound"):
        raise ValueError(f"guided: a world with a lower_bound is expected, not {type(world).__name__}")
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
    }
    if folder is not None:
        walked = _walked(world, problems[:WALKS])
        asked["teacher"] = teacher and _described(teacher, world, walked, prior)
        heuristic = world.lower_bound if guided else None  # type: ignore[attr-defined]
        asked["world"] = [type(world).__name__, _digest(world, walked, heuristic)]
    asked["settings"] = {
        name: plans_digest(value) if isinstance(value, Sequences) else repr(value)
        for name, value in sorted(settings.items())
        if name != "progress"
    }
    run = _Bootstrap(world, prior, problems, asked, None if folder is None else Path(folder), generator, sweeps)
    yield from run.done
    while len(run.done) < sweeps:
        tried, budget = run.next()
        with_teacher = teacher is not None and not run.done
        heuristic = world.lower_bound if guided else None  # type: ignore[attr-defined]
        planner = teacher if with_teacher else LevinPlanner(prior, budget, heuristic=heuristic)
        assert planner is not None
        begin = time.perf_counter()
        found = planner.search(world, problems[:tried])
        run.take(found)
        searched = time.perf_counter()
        actions = run.learn(max_actions, settings) if run.plans else 0
        seconds = searched - begin, time.perf_counter() - searched
        share, mean = float(found.solved.double().mean()), float(found.expansions.double().mean())
        run.end(Sweep(len(run.done) + 1, tried, planner.max_nodes, share, len(run.plans), mean, actions, *seconds))
        yield run.done[-1]
    if not run.plans:
        last = run.done[-1]
        raise ValueError(
            f"problems: none of {last.problems} was solved within {last.max_nodes} expansions; give a larger max_nodes,"
            " more sweeps, a teacher or easier problems"
        )


def _walked(world: World, state: Tensor) -> list[Tensor]:
    """The states of `state [N, ...]`, and after each of `WALK` random legal actions, always the same ones.

    A walk stays where the episode ends, or no action is legal.
    """
    generator, found = torch.Generator().manual_seed(0), [state]
    for _ in range(WALK):
        now = found[-1].clone()
        legal = world.legal_actions(now) & ~world.terminated(now)[:, None]
        going = legal.any(1)
        weights = (legal | ~going[:, None]).cpu().double()
        action = weights.multinomial(1, generator=generator)[:, 0].to(state.device)
        if going.any():
            now[going] = world.step(now[going], action[going])[0]
        found.append(now)
    return found


def _digest(world: World, walked: list[Tensor], heuristic: Heuristic | None) -> str:
    """Of the states on walks, of where goals are among them, and of a heuristic there."""
    given, hashed = torch.cat(walked), sha256()
    shown = [given, world.solved(given), world.terminated(given)]
    for values in shown if heuristic is None else [*shown, heuristic(given)]:
        rounded = (values.double() * 1e4).round().long() if values.is_floating_point() else values.long()
        hashed.update(rounded.cpu().contiguous().numpy().tobytes())
    return hashed.hexdigest()


def _described(teacher: BestFirstPlanner, world: World, walked: list[Tensor], prior: Prior) -> dict[str, Any]:
    """What distinguishes a teacher: its class and settings, its prior, and its heuristic in some states."""
    own = [type(teacher.prior).__name__]
    if teacher.prior is not prior and isinstance(teacher.prior, Prior):
        own.append(sha256(repr(teacher.prior.config).encode() + written_state(teacher.prior)).hexdigest())
    plain = {name: one for name, one in vars(teacher).items() if isinstance(one, bool | int | float | str)}
    kind, heuristic = type(teacher).__name__, teacher.heuristic
    about = {"class": kind, "prior": own}
    return plain | about | {"heuristic": heuristic and _digest(world, walked, heuristic)}


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
        known = 0
        for sweep in self.done:
            gained, known = sweep.solutions - known, sweep.solutions
            more = sweep.solved >= ENOUGH and tried < len(self.problems)
            if more:
                tried = min(MORE * tried, len(self.problems))
            if more or gained < NEW * sweep.solutions or sweep.solutions == 0:
                budget *= 2
        return tried, budget

    def take(self, found: Search) -> None:
        """Keep the solutions of a search."""
        for number in found.solved.nonzero()[:, 0].tolist():
            self.plans[number] = found.plan[number, : int(found.lengths[number])].cpu()

    def learn(self, max_actions: int, settings: dict[str, Any]) -> int:
        """Fit the prior to the solutions; returns the number of their actions."""
        numbers = sorted(self.plans)
        state, plans = self.problems[torch.tensor(numbers)], [self.plans[number] for number in numbers]
        how: dict[str, Any] = {"max_actions": max_actions, "generator": self.generator} | settings
        return fit_solutions(self.prior, self.world, state, plans, **how)

    def end(self, sweep: Sweep) -> None:
        """Keep a finished sweep."""
        self.done.append(sweep)
        if self.folder is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
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
            raise ValueError(f"{folder}: holds sweeps of another call, with {kept['asked']}; give another folder")
        self.done = kept["sweeps"][:sweeps]
        last = self.done[-1].number
        saved = load(folder / f"prior-{last}")
        if type(saved) is type(self.prior):
            # First: it may choose sizes, and make the modules that hold the state.
            self.prior.restore(saved.learned)
        if type(saved) is not type(self.prior) or saved.config != self.prior.config:
            raise ValueError(f"{folder}: its prior is {saved}, not {self.prior}; give another folder")
        self.prior.load_state_dict(saved.state_dict())
        self.plans = read_solutions(folder, last)
        self.generator.set_state(torch.tensor(kept["generator"], dtype=torch.uint8))


def _read_sweeps(folder: Path) -> dict[str, Any]:
    """What `sweeps.json` holds; ValueError for a damaged file."""
    path = folder / "sweeps.json"
    kept = read_json(path)
    try:
        found = {"asked": kept["asked"], "generator": kept["generator"], "sweeps": [Sweep(**s) for s in kept["sweeps"]]}
    except (KeyError, TypeError):
        found = {"sweeps": []}
    if not found["sweeps"]:
        raise ValueError(f"{path}: damaged; give another folder")
    return found


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
        raise ValueError(f"{path}: damaged ({error}); give another folder") from error
    return {int(name): plan for name, plan in sorted(tensors.items())}


def fit_solutions(
    prior: Prior,
    world: World,
    state: Tensor,
    plans: Sequence[Tensor],
    *,
    max_actions: int = 2_000_000,
    generator: torch.Generator,
    **settings: Any,
) -> int:
    """Fit a prior to solutions and, in puzzles, to their reflections and rotations; see `bootstrap`.

    Args:
        prior: fitted in place.
        world: where the problems are.
        state: `[N, ...]`: the problems.
        plans: the N solutions, actions `[l]` each; empty ones are left out.
        max_actions, generator, settings: see `bootstrap`.

    Returns:
        The number of actions that it learned from; with none it stays as it is.
    """
    some = [k for k, plan in enumerate(plans) if len(plan)]
    if not some:
        return 0
    state, plans = state[torch.tensor(some, dtype=torch.long)], [plans[k] for k in some]
    own = sum(map(len, plans))
    if isinstance(world, PuzzleWorld):
        state, plans = with_symmetries(world, state, plans, max_actions // max(own, 1), generator)
    order = torch.randperm(len(plans), generator=generator)
    state, plans = state[order], [plans[k] for k in order.tolist()]
    if isinstance(prior, PatternPrior):
        prior.fit_steps(solution_steps(world, state, plans), generator=generator, **settings)
    else:
        prior.fit(solution_plans(world, state, plans, prior.context_per), generator=generator, **settings)
    return sum(map(len, plans))


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
    if isinstance(world, PuzzleWorld) and world.device.type == "cpu":
        from neuroprior.puzzles.compiled_search import patterns_along  # priors of patterns learn with numba alone

        patterns = patterns_along(world, state, plans)
    else:
        one = [solution_plans(world, state[k : k + 1], [plan], "step").context for k, plan in enumerate(plans)]
        patterns = torch.cat([context[0] for context in one if context is not None])
    action = torch.cat(list(plans)).long()
    begin = torch.tensor([0, *map(len, plans)]).cumsum(0)[:-1]
    last = torch.nn.functional.pad(action, (1, -1))
    last[begin] = world.num_actions
    plan = torch.arange(len(plans)).repeat_interleave(torch.tensor([len(one) for one in plans]))
    return Steps(patterns, last, action, plan)


def solution_plans(world: World, state: Tensor, plans: Sequence[Tensor], context: str | None) -> Plans:
    """Plans from `state [N, ...]` as `Plans`, with what the world observes on the way, as a prior takes it."""
    lengths = torch.tensor([len(plan) for plan in plans])
    actions = torch.nn.utils.rnn.pad_sequence(list(plans), batch_first=True).to(action_dtype(world.num_actions))
    seen, now = [], state
    for t in range(actions.shape[1]):
        seen.append(world.observe(now))
        now, _ = world.step(now, actions[:, t].long())
    observed = None if context is None else torch.stack(seen, 1) if context == "step" else seen[0]
    return Plans(actions, world.num_actions, lengths, world.action_names, observed, world.group(state))
