"""Commands that are killed just before a file takes its place, or goes, and what goes on then.

`python -m tests.support.killing FOLDER PARTS` does so at PARTS of these moments, each time in a process of its own. For
each command FOLDER then holds the folders `before`, as it is found, `whole`, of a run that was not killed, and for each
moment NUMBER `NUMBER-killed`, as it was left, `NUMBER`, after what goes on, and `NUMBER.code`, how this ended.
"""

import os
import shutil
import signal
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import torch

import eval.paper.command
from eval.__main__ import main as evaluate
from neuroprior import MarkovPrior, Plans, UniformPrior, save
from neuroprior.__main__ import main
from neuroprior.behaviour.reporting import report as make_report
from neuroprior.behaviour.reporting.document import write_frames
from neuroprior.plans import write_plans


class Killed(NamedTuple):
    """What is killed, each a function of the folder.

    Attributes:
        run: is killed.
        before: makes the folder as it is found; None: it is empty.
        goes_on: after it was killed; None: the same again.
    """

    run: Callable[[Path], Any]
    before: Callable[[Path], Any] | None = None
    goes_on: Callable[[Path], Any] | None = None


def commands(root: Path) -> dict[str, Killed]:
    """The commands by name; with plans, and a prior, in `root`."""
    generator = torch.Generator().manual_seed(0)
    plans = Plans(torch.randint(3, (90, 6), generator=generator), 3, group=torch.arange(90) % 9)
    write_plans(plans, root / "plans.npz")
    other = plans[:60].steps(0, 5)
    write_plans(other, root / "other.npz")
    first, second = MarkovPrior(3, 1).fit(plans), UniformPrior(3)
    save(first, root / "prior")

    def fit(folder: Path, *more: str) -> int:
        given = [str(root / "plans.npz"), "--config", "markov", "--folds", "1", "--out", str(folder)]
        return main(["fit", *(more or given)])

    def fit_again(folder: Path) -> int:
        """Whichever of the two goes on; a refusal of one says that it is the other."""
        return fit(folder) and fit(folder, "--resume", str(folder))

    def report(folder: Path, file: str = "plans.npz") -> int:
        make_report(root / file, priors=[str(root / "prior")], sections=["scores", "transitions"], out=folder)
        return 0

    def score(folder: Path, file: str = "plans.npz") -> int:
        return main(["score", str(root / "prior"), str(root / file), "--out", str(folder)])

    def paper(folder: Path, seed: int = 1) -> int:
        return evaluate(["paper", "--seed", str(seed), "--out", str(folder)])

    return {
        "fit": Killed(fit, goes_on=fit_again),
        "fit resumed": Killed(lambda folder: fit(folder, "--resume", str(folder)), before=fit),
        "report": Killed(report, before=lambda folder: report(folder, "other.npz")),
        "score": Killed(score, before=lambda folder: score(folder, "other.npz")),
        "paper": Killed(paper, before=lambda folder: paper(folder, 0)),
        "save": Killed(lambda folder: save(first, folder) and 0, before=lambda folder: save(second, folder) and 0),
    }


def _part(number: int) -> Callable[..., dict[str, Any]]:
    """A simulation of the paper that takes no time: its table holds the seed alone."""

    def simulate(settings: Any, console: Any, folder: Path) -> dict[str, Any]:
        write_frames(folder, {f"table_{number}": pd.DataFrame({"seed": [settings.seed]})})
        return {f"simulation_{number}": settings.seed}

    return simulate


def in_child(work: Callable[[], Any]) -> int:
    """The exit code of a process that does `work`; negative, the signal that killed it."""
    if not (child := os.fork()):
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 1)
            os.dup2(nowhere.fileno(), 2)
        code = 99
        try:
            code = int(work() or 0)
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def kill_at(moment: int, count: Path | None = None) -> None:
    """Let this process kill itself before file number `moment` takes its place or goes; `count` keeps the number."""
    met = [0]

    def before(inner: Callable[..., Any]) -> Callable[..., Any]:
        def outer(path: Any, *more: Any, **named: Any) -> Any:
            if met[0] == moment:
                os.kill(os.getpid(), signal.SIGKILL)
            met[0] += 1
            if count is not None:
                count.write_text(str(met[0]))
            return inner(path, *more, **named)

        return outer

    os.replace, os.unlink = before(os.replace), before(os.unlink)


def kill_each(root: Path, parts: int) -> None:
    """Kill all commands at `parts` moments each, or at as many as there are."""
    for module in ("neuroprior.cli.fit", "neuroprior.cli.score", "lightning"):
        import_module(module)  # once, not in each process
    eval.paper.command._first, eval.paper.command._second = _part(1), _part(2)  # type: ignore[assignment]
    for name, command in commands(root).items():
        place, count = root / name, root / f"{name}.count"
        before = place / "before"
        before.mkdir(parents=True)
        if command.before is not None:
            assert in_child(partial(command.before, before)) == 0, name
        shutil.copytree(before, place / "whole")
        assert in_child(lambda: (kill_at(-1, count), command.run(place / "whole"))[1]) == 0, name  # noqa: B023
        number = int(count.read_text())
        for moment in range(number // parts // 2, number, max(number // parts, 1)):
            folder = Path(shutil.copytree(before, place / str(moment)))
            assert in_child(lambda: (kill_at(moment), command.run(folder))) == -signal.SIGKILL, (name, moment)  # noqa: B023
            shutil.copytree(folder, place / f"{moment}-killed")
            code = in_child(partial(command.goes_on or command.run, folder))
            (place / f"{moment}.code").write_text(str(code))


if __name__ == "__main__":
    kill_each(Path(sys.argv[1]), int(sys.argv[2]))
