"""The command that reports on a file of plans: `neuroprior report FILE`, and `python -m eval plans FILE`."""

import shlex
import sys
from pathlib import Path

from rich.console import Console

from neuroprior.behaviour.report.document import show
from neuroprior.behaviour.report.plan_report import INPUTS, InputName, ModelName, report
from neuroprior.plans.columns import Columns, Missing
from neuroprior.priors.ensembles.candidates import Effort


def plans(
    plans: str,
    priors: list[str] | None = None,
    test: str | None = None,
    folds: int | None = None,
    models: list[ModelName] | None = None,
    inputs: list[InputName] = list(INPUTS[:2]),  # noqa: B006
    modes: list[int] | None = None,
    skip: int = 0,
    effort: Effort = "standard",
    max_steps: int | None = None,
    num_actions: int | None = None,
    action_names: list[str] | None = None,
    columns: Columns | None = None,
    missing: Missing = "gap",
    merge_repeats: bool = False,
    max_gap: float | None = None,
    seed: int = 0,
    processes: int | None = None,
    dask: str | None = None,
    out: str = "runs/plans",
) -> None:
    """Print the report on a file of plans, and write it; the options are those of `report`."""
    options = dict(locals())
    program, typed = Path(sys.argv[0]).name, sys.argv[1:]
    if typed[:1] not in (["plans"], ["report"]):  # called from Python
        program, typed = "__main__.py", ["plans", plans]
    command = f"{program.replace('__main__.py', 'python -m eval')} {shlex.join(typed)}"
    console = Console()
    show(report(**options, command=command), console)
    console.print(f"report: {Path(out) / 'report.html'}", highlight=False, markup=False, soft_wrap=True)


plans.__doc__ = report.__doc__
