"""The command that reports on a file of plans: `neuroprior report FILE`, and `python -m eval plans FILE`."""

import shlex
import sys
from pathlib import Path

from rich.console import Console

from neuroprior.report.document import show
from neuroprior.report.plan_report import INPUTS, MODELS, InputName, ModelName, report


def plans(
    file: str,
    priors: list[str] | None = None,
    test: str | None = None,
    folds: int | None = None,
    models: list[ModelName] = list(MODELS[:4]),  # noqa: B006
    inputs: list[InputName] = list(INPUTS),  # noqa: B006
    skip: int = 0,
    max_steps: int = 1000,
    patience: float = 0.25,
    num_actions: int | None = None,
    action_names: list[str] | None = None,
    seed: int = 0,
    processes: int | None = None,
    dask: str | None = None,
    out: str = "runs/plans",
) -> None:
    """Report on a file of plans: which models predict them best, how far back they reach, what is typical of them.

    Args:
        file: plans: `.npz`, `.jsonl` or `.csv`, or `minari:` and the name of a Minari dataset.
        priors: score these model folders only, such as `neuroprior fit` writes; the first is the reference.
        test: learn from the file and score on this one, in place of cross-validation.
        folds: of the cross-validation over groups (over plans, where there are no two groups); 5 by default.
        models: which to fit: counts (uniform, Markov chains, context trees), gru, transformer, stacked (a GRU that
            weighs the forecasts of counts), gru-large (256 wide, with dropout), mixture (of stacked and gru-large);
            the last two are slow, and left out by default.
        inputs: of the models: past actions alone, the context as well where the file has one, or each in turn.
        skip: actions at the beginning of each plan that do not count in scores.
        max_steps: gradient steps of a neural prior.
        patience: share of these steps without improvement after which training stops; 1 trains to the end.
        num_actions: number of actions, where the file does not say.
        action_names: names of the actions in the order of their numbers, where the file does not say.
        seed: draws the folds and everything in training.
        processes: how many models are fitted at a time; all cores by default.
        dask: address of a Dask scheduler, `tcp://host:port`, whose workers fit the models; None: this machine.
        out: folder for `report.html`, `results.json`, tables as CSV, and what an interrupted run goes on from.
    """
    program = Path(sys.argv[0]).name
    program = "python -m eval" if program == "__main__.py" else program
    given = sys.argv[1:] if sys.argv[1:2] in (["plans"], ["report"]) else None
    options = {key: value for key, value in locals().items() if key not in ("file", "program", "given")}
    command = f"python -m eval plans {file}" if given is None else f"{program} {shlex.join(given)}"
    console = Console()
    show(report(file, **options, command=command).document, console)
    console.print(f"report: {Path(out) / 'report.html'}", highlight=False, markup=False, soft_wrap=True)
