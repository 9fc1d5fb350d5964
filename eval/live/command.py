"""`python -m eval live`: agents that plan, execute and learn while food is eaten and grows elsewhere."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from eval.compare.command import check_known, check_once, command
from eval.compare.jobs import Study, cells_of, run_cells
from eval.compare.settings import LiveSettings
from eval.live.report import write_report
from eval.live.run import EVERY, LEARN_EVERY, PARTS, recipe, run_live
from eval.worlds.foraging import HOMES

LEAST = {
    "seeds": 1,
    "period": 1,
    "seasons": 1,
    "agents": 1,
    "items": 1,
    "num_plans": 1,
    "length": 1,
    "processes": 1,
    "seed": 0,
}

MOST = {"items": 8, "seed": 2**40 - 1}
"""More food would take the oracle too long."""

LISTS: dict[str, dict[str, Any]] = {
    "worlds": {"default": list(HOMES), "choices": tuple(HOMES), "help": "worlds to live in"},
    "kinds": {"default": list(LEARN_EVERY), "choices": tuple(LEARN_EVERY), "help": "kinds of priors that learn"},
}
"""Options that take several words."""


def live(
    worlds: list[str] = list(HOMES),  # noqa: B006
    kinds: list[str] = list(LEARN_EVERY),  # noqa: B006
    seeds: int = 10,
    seasons: int = 4,
    period: int = 512,
    agents: int = 16,
    items: int = 4,
    num_plans: int = 32,
    length: int = 16,
    seed: int = 0,
    processes: int | None = None,
    out: str = "runs/live",
) -> None:
    """Does it pay to learn a prior while one lives, as food is eaten and grows elsewhere?

    Agents look for food, which grows again in a patch; the patch moves with every season. They differ in the prior that
    proposes their plans: none, one learned in a season before, one that learns from what they execute; and in whether
    the rest of their last plan is a candidate. Prints rewards a step, and writes tables (CSV), results.json and
    report.html, with rewards against time, to a folder. Interrupted, the same command goes on.

    Args:
        worlds: to live in.
        kinds: of priors that learn: markov, gru.
        seeds: repeats in each world, each with a world, food and priors of its own; intervals are over them.
        seasons: to live through; in each the food is in another patch.
        period: steps in a season, a multiple of 64.
        agents: that live in each world and share a prior; what one of them did, all learn from.
        items: of food.
        num_plans: candidates of each decision.
        length: actions in a plan: 4, 8 or 16.
        seed: of everything random.
        processes: how many cells, a world and a seed each, are done at a time; all cores by default, and a single one
            in each process that torchrun started.
        out: folder for the report, and for finished cells, from which an interrupted run goes on.
    """
    settings = LiveSettings(tuple(kinds), period, seasons, agents, items, num_plans, length, seed)
    check(worlds, seeds, processes, settings)
    folder = Path(out)
    study = Study.prepare(folder, settings, run_live, recipe())
    cells = run_cells(study, cells_of(worlds, seeds), processes)
    if cells is not None:
        told = {"worlds": list(worlds), "seeds": seeds} | asdict(settings)
        write_report(cells, told, folder, Console(), command("live"))


def check(worlds: list[str], seeds: int, processes: int | None, settings: LiveSettings) -> None:
    """Raise ValueError, naming the option, where one is out of range, not known or given twice."""
    for name, given, known in (("worlds", worlds, HOMES), ("kinds", settings.kinds, LEARN_EVERY)):
        check_known(name, given, known)
        check_once(name, given)
    if not worlds:
        raise ValueError("worlds: at least one is expected")
    numbers = {"seeds": seeds} | {name: getattr(settings, name) for name in LEAST if hasattr(settings, name)}
    if processes is not None:
        numbers["processes"] = processes
    for name, number in numbers.items():
        if not LEAST[name] <= number <= MOST.get(name, number):
            most = f" and at most {MOST[name]}" if name in MOST else ""
            raise ValueError(f"{name}: at least {LEAST[name]}{most} is expected, not {number}")
    often = min(LEARN_EVERY.values())
    if settings.length % EVERY or often % settings.length:
        raise ValueError(f"length: a multiple of {EVERY} that divides {often} is expected, not {settings.length}")
    whole = max(*LEARN_EVERY.values(), PARTS * EVERY)
    if settings.period % whole:
        raise ValueError(f"period: a multiple of {whole} is expected, not {settings.period}")
