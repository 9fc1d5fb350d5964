"""The command that reports on a file of plans: `neuroprior report FILE`, and `python -m eval plans FILE`."""

import inspect
import shlex
import sys
from pathlib import Path
from typing import Any

from docstring_parser import parse
from rich.console import Console

from neuroprior.behaviour.reporting.document import PAGE, Document, FigureKind, show, show_headline
from neuroprior.behaviour.reporting.options import INPUTS, FitOptions, InputName, ModelName, ReadOptions
from neuroprior.behaviour.reporting.plan_report import report
from neuroprior.priors.ensembles.candidates import Effort


def plans(
    plans: list[str],
    priors: list[str] | None = None,
    test: str | None = None,
    folds: int | None = None,
    models: list[ModelName] | None = None,
    inputs: list[InputName] = list(INPUTS[:2]),  # noqa: B006
    modes: list[int] | None = None,
    skip: int = 0,
    effort: Effort = "standard",
    max_steps: int | None = None,
    seed: int = 0,
    processes: int | None = None,
    dask: str | None = None,
    figures: FigureKind | None = None,
    out: str = "runs/plans",
    reading: ReadOptions = ReadOptions(),  # noqa: B008
) -> None:
    fits = FitOptions(models, tuple(inputs), modes, effort, folds, max_steps, seed, processes, dask)
    program, typed = Path(sys.argv[0]).name, sys.argv[1:]
    if typed[:1] not in (["plans"], ["report"]):  # called from Python
        program, typed = "__main__.py", ["plans", *plans]
    command = f"{program.replace('__main__.py', 'python -m eval')} {shlex.join(typed)}"
    console, page = Console(markup=False, emoji=False), Path(out) / PAGE
    shown = False

    def show_first(document: Document) -> None:
        nonlocal shown
        if document.status and not shown:
            show_headline(document, console)
            console.print(f"report: {page}. {document.status}", highlight=False, soft_wrap=True)
            shown = True

    settings: dict[str, Any] = {"priors": priors, "test": test, "skip": skip, "fits": fits, "reading": reading}
    document = report(plans, out=out, figures=figures, command=command, each=show_first, **settings)
    show(document, console)
    console.print(f"report: {page}", highlight=False, soft_wrap=True)


def _describe_options() -> str:
    """What the options are for, from the docstrings of the function and the classes that take them."""
    entries = [entry for one in (report, FitOptions) for entry in parse(inspect.getdoc(one) or "").params]
    lines = [f"    {entry.arg_name}: {' '.join((entry.description or '').split())}" for entry in entries]
    return "\n".join(["Print the report on a file of plans, and write it.", "", "Args:", *lines])


plans.__doc__ = _describe_options()
