"""`python -m eval bench`: speed against what a user would take in place of the library, in the same run."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import pandas as pd
import torch
from jsonargparse.typing import NonNegativeInt, PositiveInt
from rich.console import Console

from eval.bench import limits, sizes
from eval.bench.against import compared, read_results, regression_table
from eval.bench.figures import peers_figure, sizes_figure
from eval.bench.jobs import JOBS, ON_DEVICES, against_peers, on_device
from eval.bench.timing import Rows, import_times
from neuroprior._files import versions
from neuroprior._folders import claim_out
from neuroprior._jobs import Progress
from neuroprior.behaviour.reporting.document import Column, printed, table, write_figures, write_frames, write_results
from neuroprior.behaviour.reporting.page import Table

LEFT = 0.5
"""Share of a ratio that should be left beside busy processes."""

Part = Literal["peers", "sizes", "limits", "imports", "gpu"]


@claim_out
def bench(
    parts: Sequence[Part] = ("peers", "sizes", "limits", "imports", "gpu"),
    jobs: Sequence[str] = tuple(JOBS),
    repetitions: PositiveInt = 5,
    scale: float = 1.0,
    busy: Sequence[NonNegativeInt] = (0,),
    against: str | None = None,
    measured: str | None = None,
    out: str = "runs/bench",
) -> None:
    """Measure the library's speed; prints tables, draws figures, writes CSV and results.json.

    Args:
        parts: peers: against what a user would take in place of it; sizes: seconds and memory against size; limits: how
            near it comes to what the machine can do; imports: the time to import it; gpu: seconds of jobs on a CUDA
            GPU, where one is there, and on the CPU beside it.
        jobs: what to measure against peers.
        repetitions: how often each job is timed, in turn with its peers.
        scale: share of each job that is done, and of the largest size; the goals are for 1.
        busy: beside how many other processes, which compute without end, jobs are measured against peers: 0 1 2 for a
            table of how much of the lead is left on a machine with other work.
        against: results.json of another run, such as of another commit: how many times as long everything takes now.
        measured: results.json of a run that is compared with it; nothing is measured then.
        out: folder to write to.
    """
    earlier = None if against is None else read_results(against)
    if measured is not None and against is None:
        raise ValueError("measured: with --against alone, the results that these are compared with")
    if against is not None and earlier is not None and measured is not None:
        Console().print(_regressions(earlier, read_results(measured), against))
        return
    for name in set(jobs) - set(JOBS):
        raise ValueError(f"`jobs` must be some of {', '.join(JOBS)}, got {name}")
    if not 0 < scale <= 1:
        raise ValueError(f"`scale` must be a number above 0 and at most 1, got {scale}")
    console, folder = Console(), Path(out)
    settings = {"repetitions": repetitions, "scale": scale, "threads": torch.get_num_threads()}
    works: list[tuple[str, str, Callable[[], Iterable[dict[str, Any]]]]] = []
    if "peers" in parts:
        works += [
            ("peers", name, partial(against_peers, name, scale, repetitions, console.print, busy=busy)) for name in jobs
        ]
    if "sizes" in parts:
        works += [
            ("sizes", f"by {name}", partial(sizes.measured, name, sweep, scale * sweep.sizes[-1]))
            for name, sweep in sizes.SWEEPS.items()
        ]
    if "limits" in parts:
        works.append(("limits", "limits", lambda: limits.measured(limits.works(scale), repetitions)))
    if "imports" in parts:
        works.append(("imports", "imports", partial(import_times, repetitions)))
    if "gpu" in parts and torch.cuda.is_available():
        measure = partial(on_device, device=torch.device("cuda"), scale=scale, repetitions=repetitions)
        works += [("gpu", f"{name} on the GPU", partial(measure, name)) for name in ON_DEVICES]
    elif "gpu" in parts:
        console.print("gpu: left out, there is no CUDA device")
    by_kind: dict[str, Rows] = {}
    with Progress("bench", len(works), len(works)) as progress:
        for kind, name, work in works:
            try:
                for row in work():
                    by_kind.setdefault(kind, []).append(row)
                    # After each, so that nothing that was measured is lost.
                    write_frames(folder, {kind: pd.DataFrame(by_kind[kind])})
                    keyed = {"rows" if kind == "peers" else kind: rows for kind, rows in by_kind.items()}
                    write_results(folder, {"versions": versions(), "settings": settings, **keyed})
            except ValueError as error:
                console.print(f"{name}: left out, {error}")
            progress.advance(name)
    for each in tables(by_kind, settings):
        console.print(printed(each.title, each))
    figures = {"peers": peers_figure, "sizes": sizes_figure}
    write_figures(
        folder, {kind: draw(pd.DataFrame(by_kind[kind])) for kind, draw in figures.items() if kind in by_kind}
    )
    if against is not None and earlier is not None:
        console.print(_regressions(earlier, read_results(str(folder / "results.json")), against))
    console.print(f"written to {folder}")


def _regressions(earlier: dict[str, Any], later: dict[str, Any], path: str) -> Any:
    shown = regression_table(compared(earlier, later), path)
    return printed(shown.title, shown)


def tables(by_kind: dict[str, Rows], settings: dict[str, Any]) -> list[Table]:
    """The tables of what was measured: rows by part."""
    shown: dict[str, Callable[[pd.DataFrame], Table]]
    if "peers" in by_kind:
        rows = pd.DataFrame(by_kind["peers"])
        several = {"busy": by_kind["peers"]} if rows.busy.nunique() > 1 else {}
        by_kind = by_kind | {"peers": [row for row in by_kind["peers"] if row["busy"] == rows.busy.min()]} | several
    shown = {"peers": partial(_peers, settings), "busy": _busy, "sizes": _sizes}
    shown |= {"limits": _limits, "gpu": _gpu, "imports": _imports}
    return [make(pd.DataFrame(by_kind[kind])) for kind, make in shown.items() if kind in by_kind]


def _peers(settings: dict[str, Any], rows: pd.DataFrame) -> Table:
    met = "" if settings["scale"] < 1 else (rows.ratio >= rows.goal).map({True: "yes", False: "no"})
    columns: dict[str, Column] = {"job: peer": "name", "seconds": "seconds:.3g", "ratio": _short("ratio")}
    columns |= {"min": _short("low"), "max": _short("high"), "goal": _short("goal"), "met": "met"}
    title = f"Speed with {settings['threads']} threads of torch (ratio: peer's time / ours)"
    return table(rows.assign(name=rows.job + ": " + rows.peer, met=met), columns, "Medians; least and most.", title)


def _busy(rows: pd.DataFrame) -> Table:
    """The ratios beside each number of busy processes."""
    ratios = rows.assign(name=rows.job + ": " + rows.peer).pivot_table("ratio", "name", "busy", sort=False)
    first, last = ratios.columns.min(), ratios.columns.max()
    shown = ratios.rename(columns=str).assign(left=ratios[last] / ratios[first]).reset_index()
    columns: dict[str, Column] = {"job: peer": "name"}
    for number in ratios.columns:
        columns[str(number)] = _short(str(number))
    columns |= {"left": "left:.2f", "met": lambda row: "yes" if row["left"] >= LEFT else "no"}
    caption = f"left: the last as a share of the first; the goal is {LEFT}."
    return table(shown, columns, caption, "Ratios beside busy processes, by their number")


def _imports(rows: pd.DataFrame) -> Table:
    columns = {"": "what", "seconds": "seconds:.2f", "torch, s": "torch_seconds:.2f", "ratio": "ratio:.3f"}
    columns |= {"min": "low:.3f", "max": "high:.3f", "goal": "goal"}
    return table(
        rows.assign(what="from neuroprior import *:"), columns, title="Time to import (ratio: to that of torch)"
    )


def _sizes(rows: pd.DataFrame) -> Table:
    """The smallest and the largest of each kind."""
    kinds = rows.groupby("growing", sort=False)
    ends = kinds.first().add_suffix("_first").join(kinds.last().add_suffix("_last")).reset_index()
    ends["slope"] = [sizes.slope(rows_of_kind) for _, rows_of_kind in kinds]
    columns: dict[str, Column] = {
        "size": "growing",
        "from": "size_first:,",
        "to": "size_last:,",
        "seconds\nfrom": "seconds_first:.2g",
        "\nto": "seconds_last:.2g",
        "slope": "slope:.2f",
        "peak\nMiB": _mebi("peak_bytes_last"),
        "result\nMiB": _mebi("result_bytes_last"),
    }
    caption = " ".join(ends.growing + ": " + ends.about_first + ".")
    caption += " peak: of the process at the largest size, beyond what it held before."
    title = "Cost against size: time increases as size to the power of `slope` over the last decades"
    return table(ends, columns, caption, title)


def _limits(rows: pd.DataFrame) -> Table:
    rates = {name: (rows[name] / rows.seconds / 1e9).map(_two_digits) for name in ("moved", "operations")}
    columns = {"work": "work", "seconds": "seconds:.3g", "GB/s": "moved", "Gop/s": "operations"}
    caption = (
        "GB/s: bytes that have to be moved to or from memory at the least; Gop/s: operations of matrix products."
        " copy and product: what the machine does at its best, and so the limit."
    )
    columns |= {"share": "share:.1%", "limit": "bound"}
    return table(rows.assign(**rates), columns, caption, "Share of the machine's limit")


def _gpu(rows: pd.DataFrame) -> Table:
    columns: dict[str, Column] = {"job": "about", "CPU, seconds": "cpu_seconds:.3g", "GPU, seconds": "seconds:.3g"}
    columns |= {"ratio": _short("ratio"), "peak MiB": _mebi("peak_bytes")}
    shown = rows.assign(ratio=rows.cpu_seconds / rows.seconds)
    return table(shown, columns, "ratio: CPU / GPU.", f"On {rows.device.iloc[0]}, and on the CPU of the same machine")


def _mebi(name: str) -> Column:
    return lambda row: "" if pd.isna(row[name]) else f"{row[name] / 2**20:,.0f}"


def _two_digits(rate: float) -> str:
    return f"{rate:.2g}" if rate < 10 else f"{rate:.0f}"


def _short(name: str) -> Column:
    return lambda row: f"{row[name]:,.0f}" if row[name] >= 100 else f"{row[name]:.3g}"
