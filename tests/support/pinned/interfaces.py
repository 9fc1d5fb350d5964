"""What is called and how: names, arguments and their defaults, options of commands, recipes, messages for bad input."""

import contextlib
import importlib
import inspect
import io
import os
import pkgutil
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from types import GenericAlias
from typing import Any
from unittest import mock

import numpy as np
import torch
import yaml

import eval.__main__ as eval_program
import neuroprior
from neuroprior import Plans
from neuroprior import __main__ as program
from neuroprior.planners import LevinPlanner, MCTSPlanner, SamplingPlanner, oracle
from neuroprior.planners.continuous import ICEMPlanner
from neuroprior.plans import folds, read_plans
from neuroprior.priors import CombinedPrior, ContextTreePrior, GRUPrior, MarkovPrior, UniformPrior, fit, load
from neuroprior.report import report
from neuroprior.worlds import cube, gridworld, maze
from tests.support.pinned.data import behaviour
from tests.support.unchanged import case


def arguments(function: Any) -> list[str]:
    """Each argument with its default; those by keyword alone come after a star."""
    if isinstance(function, GenericAlias):  # which some versions of Python call a function of anything
        return []
    try:
        given = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return []
    found: list[str] = []
    for one in given:
        if one.kind is one.KEYWORD_ONLY and "*" not in found:
            found.append("*")
        star = {one.VAR_POSITIONAL: "*", one.VAR_KEYWORD: "**"}.get(one.kind, "")
        default = "" if one.default is one.empty else f" = {_text(one.default)}"
        found.append(f"{star}{one.name}{default}")
    return found


def _text(value: Any) -> str:
    if callable(value):
        return value.__qualname__
    text = repr(value)
    return f"{type(value).__name__}" if " at 0x" in text else text if len(text) < 200 else f"{text[:200]} ..."


def public() -> dict[str, Any]:
    """What the modules of the library export, by the name of the module that is nearest to the top."""
    found: dict[str, Any] = {}
    seen: set[int] = set()
    names = [name for _, name, _ in pkgutil.walk_packages(neuroprior.__path__, "neuroprior.")]
    for name in ["neuroprior", *sorted(names, key=lambda name: (name.count("."), name))]:
        if any(part.startswith("_") for part in name.split(".")):
            continue
        module = importlib.import_module(name)
        for export in getattr(module, "__all__", ()):
            value = getattr(module, export)
            if not callable(value) or id(value) not in seen:
                seen.add(id(value))
                found[f"{name}.{export}"] = value
    return found


@case
def signatures():
    found: dict[str, Any] = {}
    for name, value in public().items():
        if not callable(value):
            found[name] = value if isinstance(value, int | float | str | tuple | list) else type(value).__name__
            continue
        found[name] = {"arguments": arguments(value)}
        if inspect.isclass(value):
            own = {key: one for key, one in vars(value).items() if not key.startswith("_")}
            found[name]["methods"] = {key: arguments(one) for key, one in own.items() if inspect.isroutine(one)}
    return found


@case
def exports():
    """What each module exports."""
    names = ["neuroprior", *(name for _, name, _ in pkgutil.walk_packages(neuroprior.__path__, "neuroprior."))]
    modules = [
        importlib.import_module(name) for name in names if not any(part.startswith("_") for part in name.split("."))
    ]
    return {module.__name__: sorted(module.__all__) for module in modules if hasattr(module, "__all__")}


@case
def constants():
    """Numbers that modules of the library name: what is tried, bounds, tolerances."""
    found: dict[str, Any] = {}
    for _, name, _ in pkgutil.walk_packages(neuroprior.__path__, "neuroprior."):
        if name.endswith("__main__"):
            continue
        own = {key: value for key, value in vars(importlib.import_module(name)).items() if key.lstrip("_").isupper()}
        kept = {key: value for key, value in own.items() if isinstance(value, int | float | tuple | range)}
        if kept:
            found[name] = {key: list(value) if isinstance(value, range) else value for key, value in kept.items()}
    return found


@case
def commands():
    """The options of each command with their defaults, and the recipes."""
    found: dict[str, Any] = {}
    for part, known in {"neuroprior": program.COMMANDS, "eval": eval_program.COMMANDS}.items():
        for name, command in known.items():
            found[f"{part} {name}"] = [command.about, arguments(command.load())]
    for recipe in sorted(Path("train").glob("*.yaml")):
        found[recipe.name] = yaml.safe_load(recipe.read_text())
    return found


@case
def helps():
    """What the commands of `neuroprior` print of themselves."""
    found: dict[str, Any] = {}
    with mock.patch.dict(os.environ, {"COLUMNS": "100", "NO_COLOR": "1"}):
        for options in (
            ["--help"],
            ["score", "--help"],
            ["sample", "--help"],
            ["report", "--help"],
            ["example", "--help"],
        ):
            with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
                program.main(options)
            found[" ".join(options)] = out.getvalue().splitlines()
    return found


PLANS = Plans(torch.tensor([[0, 1, 1], [1, 0, 1]]), 2)

BAD: dict[str, Callable[[], object]] = {
    "action out of range": lambda: Plans(torch.tensor([[0, 3]]), 3),
    "no actions": lambda: Plans(torch.zeros(0), 3),
    "lengths": lambda: Plans(torch.tensor([[0, 1]]), 2, torch.tensor([3])),
    "names": lambda: Plans(torch.tensor([[0, 1]]), 2, action_names=("a",)),
    "group": lambda: Plans(torch.tensor([[0, 1]]), 2, group=torch.tensor([0.5])),
    "durations": lambda: Plans(torch.tensor([[0, 1]]), 2, durations=torch.tensor([[1.0, -1.0]])),
    "context": lambda: Plans(torch.tensor([[0, 1]]), 2, context=torch.zeros(3)),
    "order": lambda: MarkovPrior(2, -1),
    "back-off": lambda: MarkovPrior(2, backoff="none"),
    "beta": lambda: ContextTreePrior(2, beta=1.5),
    "window": lambda: GRUPrior(2, window=-1),
    "unknown setting": lambda: MarkovPrior(2).fit(PLANS, epochs=3),
    "unknown prior": lambda: fit(PLANS, "hmm"),
    "effort": lambda: fit(PLANS, "gru", effort="fast"),
    "no experts": lambda: CombinedPrior(2, []),
    "other actions": lambda: MarkovPrior(3).fit(PLANS).log_prob(torch.tensor([[5]])),
    "no context": lambda: MarkovPrior(2, num_contexts=3).fit(PLANS),
    "too large": lambda: MarkovPrior(1000, 8).fit(Plans(torch.zeros(2, 9, dtype=torch.long), 1000)),
    "temperature": lambda: UniformPrior(2).sample(1, 1, temperature=0),
    "method": lambda: UniformPrior(2).sample(1, 1, method="beam"),
    "objective": lambda: SamplingPlanner(UniformPrior(4), 2, 2, objective="best"),
    "discount": lambda: SamplingPlanner(UniformPrior(4), 2, 2, discount=2.0),
    "exploration": lambda: MCTSPlanner(UniformPrior(4), 2, 2, exploration=-1),
    "actions of a world": lambda: SamplingPlanner(UniformPrior(3), 2, 2).plan(gridworld(3, 3), torch.tensor([0])),
    "state": lambda: SamplingPlanner(UniformPrior(4), 2, 2).plan(gridworld(3, 3), torch.tensor([99])),
    "goal": lambda: LevinPlanner(UniformPrior(4), 5).search(gridworld(3, 3), torch.tensor([0])),
    "table": lambda: oracle(cube(), cube().reset(1), 2),
    "elites": lambda: ICEMPlanner(3, 4, elites=9),
    "maze": lambda: maze(2, 2),
    "grid": lambda: gridworld(3, 3, "sphere"),
    "folds": lambda: folds(PLANS, 5),
    "file": lambda: read_plans("no-such-file.csv"),
    "kind of file": lambda: read_plans("plans.doc"),
    "folder": lambda: load("no-such-folder"),
    "models": lambda: report(PLANS, models=["lstm"]),
    "sections": lambda: report(PLANS, sections=["end"]),
    "skip": lambda: report(PLANS, models=["counts"], skip=9),
    "split": lambda: behaviour(4).split(1.5),
}


@case
def messages():
    found: dict[str, Any] = {}
    for name, call in BAD.items():
        try:
            call()
            found[name] = "accepted"
        except (ValueError, OSError) as error:
            found[name] = f"{type(error).__name__}: {error}"
    with TemporaryDirectory() as folder:
        for number, text in enumerate(
            ("plan,action\n1,a\n1,0.5\n", "plan,action\n", "a\x00b\n", "plan,plan\n1,2\n", "1,2\nx,y\n")
        ):
            place = Path(folder) / f"bad-{number}.csv"
            place.write_text(text)
            try:
                found[place.name] = [read_plans(place).num_actions]
            except ValueError as error:
                found[place.name] = str(error).replace(folder, "")
        np.savez(Path(folder) / "bad.npz", plans=np.zeros((2, 2)))
        for options in (
            ["score"],
            ["fly"],
            ["score", "x", "y", "--by", "z"],
            ["sample", folder],
            ["report", f"{folder}/bad.npz"],
        ):
            with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.redirect_stdout(io.StringIO()):
                code = program.main(options)
            found[" ".join(options).replace(folder, "FOLDER")] = [code, said.getvalue().replace(folder, "")]
    return found
