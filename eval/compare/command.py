"""`python -m eval compare`: do neural priors help a planner more than Markov chains, in many worlds at equal budget?"""

import shlex
import sys
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from eval.compare import planner_report
from eval.compare import run as compare_cell
from eval.compare import settings as compare_settings
from eval.compare.jobs import Cell, Study, cells_of, run_cells
from eval.compare.planners import PLANNERS, PlannerSettings, check_planners, run_planners
from eval.compare.recipes import NEURAL
from eval.compare.report import write_report
from eval.compare.saved import load_for
from eval.compare.settings import Settings
from eval.worlds.suite import TASKS

KINDS = ("markov", "macro", *NEURAL)
SEES = tuple(compare_settings.SEES)
MOST_PLANS = 2**20
LISTS: dict[str, dict[str, Any]] = {
    "worlds": {"default": list(TASKS), "choices": tuple(TASKS), "help": "worlds to compare priors in"},
    "num_plans": {"type": int, "default": [16, 64, 256, 1024, 4096], "help": "candidate plans, powers of two"},
    "priors": {"help": "model folders to compare, such as `python -m train` writes; nothing is fitted without --kinds"},
    "kinds": {"choices": KINDS, "help": "kinds of priors that are fitted; all of them by default"},
    "planners": {"help": f"compare planners with the same priors instead: {', '.join(PLANNERS)}"},
    "sees": {"choices": SEES, "help": "what priors see: nothing but the plan so far, or more; as suits each world"},
}
"""Options that take several words."""


def compare(
    worlds: list[str] = list(TASKS),  # noqa: B006
    seeds: int = 20,
    num_plans: Sequence[int] = (16, 64, 256, 1024, 4096),
    priors: list[str] | None = None,
    kinds: list[str] | None = None,
    planners: list[str] | None = None,
    sees: list[str] | None = None,
    rounds: int = 4,
    steps: int = 600,
    starts: int = 32,
    training_starts: int = 1000,
    seed: int = 0,
    processes: int | None = None,
    out: str = "runs/compare",
) -> None:
    """Do neural priors help a planner more than Markov chains, in many worlds at equal budget?

    In each world, for each seed: a planner without a prior plans in training worlds, priors learn from its plans, and
    planners draw candidate plans from each prior in held-out worlds. Prints tables; writes them (CSV), results.json and
    report.html to a folder. Interrupted, the same command goes on; `torchrun -m eval compare` shares the work out.

    Args:
        worlds: to compare priors in.
        seeds: repeats in each world, each with worlds (training, validation, held-out) and priors of its own; intervals
            are over them.
        num_plans: numbers of candidate plans, powers of two.
        priors: model folders to compare, such as `python -m train` writes.
        kinds: of priors that are fitted: markov, macro (a chain of order 2 over actions and 16 macro-actions, which
            sees nothing), gru, transformer; all by default, but none where there are saved ones.
        planners: some of sampling, distinct, frontier, mcts, cross-entropy, halving and replanning (these two in worlds
            with chance): they are compared, not priors, at as many model steps, with uniform plans, a chain of order 3
            and the networks of --kinds, after growth.
        sees: what priors see: nothing but the plan so far, the start as well, or each step; by default nothing and, in
            worlds where it could help, one or both of the others (with --planners the last of them alone).
        rounds: of horizon growth, at most (worlds have two or three): a prior learns from plans found with it,
            each time longer ones; 0: none.
        steps: of training of each neural prior, at most.
        starts: held-out starts to plan from.
        training_starts: from so many starts plans are collected to learn from; from several times as many in worlds
            where most starts lead nowhere.
        seed: of everything random.
        processes: how many cells, a world and a seed each, are done at a time; all cores by default, and a single one
            in each process that torchrun started.
        out: folder for the report, and for finished cells, from which an interrupted run goes on.
    """
    saved = tuple(priors or ())
    if kinds is None:
        kinds = [] if saved else list(KINDS)
    if not kinds and not saved:
        raise ValueError("kinds: at least one kind of prior, or --priors, is expected")
    settings = Settings(
        tuple(num_plans), tuple(kinds), tuple(sees or ()), rounds, steps, starts, training_starts, seed, saved
    )
    if planners is not None:
        settings = PlannerSettings(**vars(settings), planners=tuple(planners))
    check(worlds, seeds, processes, settings)
    check_saved(saved, worlds)
    folder = Path(out)
    if isinstance(settings, PlannerSettings):
        compare_planners(settings, cells_of(worlds, seeds), processes, folder)
        return
    study = Study.prepare(folder, settings, compare_cell.run_cell)
    cells = run_cells(study, cells_of(worlds, seeds), processes)
    if cells is not None:
        told = {"worlds": list(worlds), "seeds": seeds} | asdict(settings)
        write_report(cells, num_plans, settings=told, command=command("compare"), folder=folder, console=Console())


def compare_planners(settings: PlannerSettings, cells: Sequence[Cell], processes: int | None, folder: Path) -> None:
    """The comparison of planners; see `compare`."""
    worlds = list(dict.fromkeys(cell.world for cell in cells))
    check_planners(settings.planners, worlds)
    study = Study.prepare(folder, settings, run_planners)
    done = run_cells(study, cells, processes)
    if done is not None:
        told = {"worlds": worlds, "seeds": len(cells) // len(worlds)} | asdict(settings)
        planner_report.write_report(done, told, folder, Console(), command("compare"))


def check(worlds: Sequence[str], seeds: int, processes: int | None, settings: Settings) -> None:
    """Raise ValueError, naming the option, where one is out of range, not known or given twice."""
    planners = settings.planners if isinstance(settings, PlannerSettings) else ()
    words = {"worlds": (worlds, TASKS), "kinds": (settings.kinds, KINDS), "sees": (settings.sees, SEES)}
    words["planners"] = planners, PLANNERS
    for name, (given, known) in words.items():
        check_known(name, given, known)
    lists = {"worlds": worlds, "num_plans": settings.num_plans}
    for name, some in lists.items():
        if not some:
            raise ValueError(f"{name}: at least one is expected")
    more = {name: getattr(settings, name) for name in ("sees", "kinds", "priors", "lengths")} | {"planners": planners}
    for name, some in (lists | more).items():
        check_once(name, some)
    for number in settings.num_plans:
        if not 1 <= number <= MOST_PLANS or number & (number - 1):
            raise ValueError(f"num_plans: powers of two from 1 to {MOST_PLANS:,} are expected, not {number}")
    least = {"rounds": 0, "steps": 1, "starts": 1, "training_starts": 8}
    numbers = {name: getattr(settings, name) for name in least} | {"seeds": seeds}
    if processes is not None:
        numbers["processes"] = processes
    for name, number in numbers.items():
        if number < least.get(name, 1):
            raise ValueError(f"{name}: at least {least.get(name, 1)} is expected, not {number}")
    if not 0 <= settings.seed < 2**40:
        raise ValueError(f"seed: an integer from 0 to 2**40 - 1 is expected, not {settings.seed}")
    blind = [world for world in worlds if settings.sees and not any(map(TASKS[world].shows, settings.sees))]
    if blind:
        raise ValueError(f"sees: {blind[0]} shows nothing that would be of use; leave it out, or add nothing to --sees")


def check_known(name: str, given: Sequence[str], known: Collection[str]) -> None:
    """Raise ValueError where a word that was given for an option is not known."""
    if unknown := [word for word in given if word not in known]:
        raise ValueError(f"{name}: {unknown[0]!r} is not known; there are {', '.join(known)}")


def check_once(name: str, given: Sequence[Any]) -> None:
    """Raise ValueError where something was given twice for an option."""
    if len(set(given)) < len(given):
        raise ValueError(f"{name}: each may be given once, not {' '.join(map(str, given))}")


def check_saved(folders: Sequence[str], worlds: Sequence[str]) -> None:
    """Raise ValueError unless saved priors know the actions and sights of all worlds; before hours of work."""
    shown: dict[str, torch.Tensor] = {}  # by world: some take long to make
    for folder in folders:
        if folder == "uniform" or folder in KINDS or folder.startswith("markov-"):
            raise ValueError(f"priors: {folder} is also the name of a fitted prior; give the folder as ./{folder}")
        for world in worlds:
            task = TASKS[world]
            prior = load_for(folder, world, task.num_actions, task.action_names)
            if prior.takes_context:
                if world not in shown:
                    held_out = task.worlds(0).held_out
                    shown[world] = held_out.observe(held_out.reset(1, torch.Generator().manual_seed(0)))
                try:
                    prior.check_context_of(shown[world], 1)
                except ValueError as error:
                    raise ValueError(f"{folder}: does not see what the world {world} shows ({error})") from error


def command(name: str) -> str:
    """The command line that this program was started with, or that of its defaults."""
    given = sys.argv[1:] if sys.argv[1:2] == [name] else [name]
    return "python -m eval " + shlex.join(given)
