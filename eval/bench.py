"""`python -m eval bench`: speed against what a user would take in place of the library, in the same run."""

import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from eval.bench_jobs import JOBS, Job
from eval.bench_packages import Run
from neuroprior.output import versions, write_csv, write_json

LISTS: dict[str, dict[str, Any]] = {
    "jobs": {"default": list(JOBS), "choices": tuple(JOBS), "help": "what to measure; all jobs by default"}
}
"""Options that take several words."""


def bench(
    jobs: list[str] = list(JOBS),  # noqa: B006
    repetitions: int = 5,
    scale: float = 1.0,
    out: str = "runs/bench",
) -> None:
    """Measure the library against its peers; prints a table, writes CSV and results.json.

    Args:
        jobs: what to measure.
        repetitions: how often each job is timed, in turn with its peers.
        scale: share of each job that is done; the goals are for 1.
        out: folder to write to.
    """
    if repetitions < 1:
        raise ValueError(f"repetitions: at least 1 is expected, not {repetitions}")
    if not 0 < scale <= 1:
        raise ValueError(f"scale: a number above 0 and at most 1 is expected, not {scale}")
    console, folder, rows = Console(), Path(out), []
    folder.mkdir(parents=True, exist_ok=True)
    settings = {"repetitions": repetitions, "scale": scale, "threads": torch.get_num_threads()}
    for name in jobs:
        with console.status(name):
            try:
                rows += list(measured(name, JOBS[name](scale), repetitions, console))
            except ValueError as error:
                console.print(f"{name}: left out, {error}")
        if rows:  # after each job: nothing that was measured is lost
            write_csv(folder / "bench.csv", rows)
        write_json(folder / "results.json", {"versions": versions(), "settings": settings, "rows": rows})
    console.print(_table(rows, settings))
    console.print(f"written to {folder}")


def measured(name: str, job: Job, repetitions: int, console: Console) -> Iterator[dict[str, Any]]:
    """A row for each peer of a job that is there: how many times as long it takes."""
    if missing(job.needs):
        console.print(f"{name}: left out, {job.needs} is not installed")
        return
    threads, begin = torch.get_num_threads(), time.perf_counter()
    ours = job.make()
    setup = time.perf_counter() - begin
    for peer in job.peers:
        if missing(peer.needs):
            console.print(f"{name}: {peer.name} left out, {peer.needs} is not installed")
            continue
        theirs = peer.make()
        ours(), theirs()  # what is first is slow
        torch.set_num_threads(threads)  # packages change it when they are loaded
        times = [(seconds(ours), seconds(theirs) / peer.share) for _ in range(repetitions)]
        ratios = sorted(theirs / ours for ours, theirs in times)
        yield {
            "job": name,
            "about": job.about,
            "setup_seconds": setup,
            "seconds": median(ours for ours, _ in times),
            "peer": peer.name,
            "peer_seconds": median(theirs for _, theirs in times),
            "share": peer.share,
            "ratio": median(ratios),
            "low": ratios[0],
            "high": ratios[-1],
            "goal": peer.goal,
        }


def missing(package: str | None) -> bool:
    """Whether a package is not installed."""
    return package is not None and find_spec(package) is None


def seconds(run: Run) -> float:
    """How long it takes."""
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def _table(rows: list[dict[str, Any]], settings: dict[str, Any]) -> Table:
    table = Table(
        box=SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
        title=f"Speed with {settings['threads']} threads of torch (medians; ratio: peer's time / ours, min to max)",
    )
    for heading in ("job", "seconds", "peer", "ratio", "min", "max", "goal", "met"):
        table.add_column(heading, justify="left" if heading in ("job", "peer") else "right", overflow="fold")
    for row in rows:
        figures = (_short(row[key]) for key in ("ratio", "low", "high", "goal"))
        met = "" if settings["scale"] < 1 else "yes" if row["ratio"] >= row["goal"] else "no"
        table.add_row(row["job"], f"{row['seconds']:.3g}", row["peer"], *figures, met)
    return table


def _short(number: float) -> str:
    return f"{number:,.0f}" if number >= 100 else f"{number:.3g}"
