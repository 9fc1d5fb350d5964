"""`python -m eval bench`: speed against what a user would take in place of the library, in the same run."""

import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import torch
from rich.console import Console

from eval.bench import gpu as bench_gpu
from eval.bench import limits as bench_limits
from eval.bench import sizes as bench_sizes
from eval.bench.figures import peers_figure, sizes_figure
from eval.bench.jobs import JOBS, Job
from eval.bench.tables import gpu_table, limits_table, peers_table, sizes_table
from eval.bench.timing import import_seconds, seconds
from eval.paper.figures import save
from neuroprior._files import versions, write_csv, write_json

PARTS = ("peers", "sizes", "limits", "imports", "gpu")

LISTS: dict[str, dict[str, Any]] = {
    "parts": {
        "default": list(PARTS),
        "choices": PARTS,
        "help": "against peers; cost against size; share of the machine's limit; time to import; a GPU; default: all",
    },
    "jobs": {"default": list(JOBS), "choices": tuple(JOBS), "help": "what to measure against peers; all by default"},
}
"""Options that take several words."""

GOAL = 1.1
"""`import neuroprior` should take no more than so many times as long as `import torch`."""

Rows = list[dict[str, Any]]


def bench(
    parts: list[str] = list(PARTS),  # noqa: B006
    jobs: list[str] = list(JOBS),  # noqa: B006
    repetitions: int = 5,
    scale: float = 1.0,
    out: str = "runs/bench",
) -> None:
    """Measure the library's speed; prints tables, draws figures, writes CSV and results.json.

    Args:
        parts: peers: against what a user would take in place of it; sizes: seconds and memory against size; limits: how
            near it comes to what the machine can do; imports: the time to import it; gpu: seconds of the same jobs on a
            CUDA GPU, where one is there.
        jobs: what to measure against peers.
        repetitions: how often each job is timed, in turn with its peers.
        scale: share of each job that is done, and of the largest size; the goals are for 1.
        out: folder to write to.
    """
    if repetitions < 1:
        raise ValueError(f"repetitions: at least 1 is expected, not {repetitions}")
    if not 0 < scale <= 1:
        raise ValueError(f"scale: a number above 0 and at most 1 is expected, not {scale}")
    console, folder = Console(), Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    settings = {"repetitions": repetitions, "scale": scale, "threads": torch.get_num_threads()}
    found: dict[str, Rows] = {}
    with console.status("") as status:
        for what, row in _all_rows(parts, jobs, settings, console, status.update):
            found.setdefault(what, []).append(row)
            # After each: nothing that was measured is lost.
            write_csv(folder / f"{what}.csv", found[what])
            parts_found = {"rows" if part == "peers" else part: rows for part, rows in found.items()}
            write_json(folder / "results.json", {"versions": versions(), "settings": settings, **parts_found})
    _show(found, settings, console, folder)
    console.print(f"written to {folder}")


def _all_rows(
    parts: list[str], jobs: list[str], settings: dict[str, Any], console: Console, says: Any
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Each row with the part that it belongs to."""
    repetitions, scale = settings["repetitions"], settings["scale"]
    for name in jobs if "peers" in parts else ():
        says(name)
        try:
            yield from (("peers", row) for row in measured(name, JOBS[name](scale), repetitions, console))
        except ValueError as error:
            console.print(f"{name}: left out, {error}")
    for name, sweep in bench_sizes.SWEEPS.items() if "sizes" in parts else ():
        says(f"by {name}")
        yield from (("sizes", row) for row in bench_sizes.measured(name, sweep, scale * sweep.sizes[-1]))
    if "limits" in parts:
        says("limits")
        yield from (("limits", row) for row in bench_limits.measured(scale, repetitions))
    if "imports" in parts:
        says("imports")
        yield "imports", _imports(repetitions)
    if "gpu" in parts and torch.cuda.is_available():
        says("gpu")
        yield from (("gpu", row) for row in bench_gpu.measured(torch.device("cuda"), scale, repetitions))
    elif "gpu" in parts:
        console.print("gpu: left out, there is no CUDA device")


def measured(name: str, job: Job, repetitions: int, console: Console) -> Iterator[dict[str, Any]]:
    """A row for each peer of a job that is there: how many times as long it takes."""
    if missing(job.needs):
        console.print(f"{name}: left out, {job.needs} is not installed")
        return
    threads, begin = torch.get_num_threads(), time.perf_counter()
    ours = job.make(torch.device("cpu"))
    setup = time.perf_counter() - begin
    for peer in job.peers:
        if missing(peer.needs):
            console.print(f"{name}: {peer.name} left out, {peer.needs} is not installed")
            continue
        theirs = peer.make()
        ours(), theirs()  # what is first is slow
        torch.set_num_threads(threads)  # packages change it when they are loaded
        times = [(seconds(ours), seconds(theirs) / peer.share) for _ in range(repetitions)]
        yield {
            "job": name,
            "about": job.about,
            "setup_seconds": setup,
            "seconds": median(ours for ours, _ in times),
            "peer": peer.name,
            "peer_seconds": median(theirs for _, theirs in times),
            "share": peer.share,
            **_ratios([theirs / ours for ours, theirs in times]),
            "goal": peer.goal,
        }


def missing(package: str | None) -> bool:
    """Whether a package is not installed."""
    return package is not None and find_spec(package) is None


def _imports(repetitions: int) -> dict[str, Any]:
    """The row of the time to import the library, as a ratio to that of torch."""
    pair = ("torch", "neuroprior")
    times = [[import_seconds(package) for package in pair] for _ in range(repetitions + 1)]
    del times[0]  # which read files from the disk
    ratios = _ratios([ours / torchs for torchs, ours in times])
    return {"seconds": median(ours for _, ours in times), "torch_seconds": median(t for t, _ in times), **ratios} | {
        "goal": GOAL
    }


def _ratios(ratios: list[float]) -> dict[str, float]:
    return {"ratio": median(ratios), "low": min(ratios), "high": max(ratios)}


def _show(found: dict[str, Rows], settings: dict[str, Any], console: Console, folder: Path) -> None:
    """Print the tables and draw the figures of all that was measured."""
    if "peers" in found:
        console.print(peers_table(found["peers"], settings))
        save(peers_figure(found["peers"]), folder / "peers.png")
    if "sizes" in found:
        console.print(sizes_table(found["sizes"]))
        save(sizes_figure(found["sizes"]), folder / "sizes.png")
    if "limits" in found:
        console.print(limits_table(found["limits"]))
    if "gpu" in found:
        console.print(gpu_table(found["gpu"]))
    for row in found.get("imports", ()):
        told = f"{row['ratio']:.3f} times as long as torch ({row['low']:.3f} to {row['high']:.3f}; goal: {row['goal']})"
        console.print(f"import neuroprior: {row['seconds']:.2f} s, {told}")
