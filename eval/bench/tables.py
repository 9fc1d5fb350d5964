"""The tables of `python -m eval bench`."""

from typing import Any

from rich.table import Table

from eval.bench.sizes import slope
from eval.paper.tables import columns, titled

Rows = list[dict[str, Any]]

MEBI = 2**20


def peers_table(rows: Rows, settings: dict[str, Any]) -> Table:
    """How many times as long peers take."""
    table = titled(
        f"Speed with {settings['threads']} threads of torch (medians; ratio: peer's time / ours, min to max)", 1
    )
    for heading in ("job", "seconds", "peer", "ratio", "min", "max", "goal", "met"):
        table.add_column(heading, justify="left" if heading in ("job", "peer") else "right", overflow="fold")
    for row in rows:
        figures = (_short(row[key]) for key in ("ratio", "low", "high", "goal"))
        met = "" if settings["scale"] < 1 else "yes" if row["ratio"] >= row["goal"] else "no"
        table.add_row(row["job"], f"{row['seconds']:.3g}", row["peer"], *figures, met)
    return table


def sizes_table(rows: Rows) -> Table:
    """Seconds and memory at the largest size of each kind, and how they grow."""
    table = titled("Cost against size: time grows as size to the power of `slope` over the last decades", 1)
    columns(table, ("growing", "from", "to", "seconds", "to", "slope", "peak MiB", "result"), 1)
    for growing in dict.fromkeys(row["growing"] for row in rows):
        own = [row for row in rows if row["growing"] == growing]
        first, last, power = own[0], own[-1], slope(own)
        peak = "" if last["peak_bytes"] is None else f"{last['peak_bytes'] / MEBI:,.0f}"
        table.add_row(
            growing,
            *(f"{row['size']:,}" for row in (first, last)),
            *(f"{row['seconds']:.2g}" for row in (first, last)),
            "" if power is None else f"{power:.2f}",
            peak,
            f"{last['result_bytes'] / MEBI:,.0f}",
        )
    abouts = dict.fromkeys(f"{row['growing']}: {row['about']}." for row in rows)
    table.caption = " ".join(abouts) + " peak: of the process at the largest size, beyond what it held before."
    return table


def limits_table(rows: Rows) -> Table:
    """The share of the machine's limit that is reached."""
    table = titled("Share of the machine's limit", 1)
    columns(table, ("work", "seconds", "GB/s", "Gop/s", "share", "limit"), 1)
    for row in rows:
        moved, done = (row[key] / row["seconds"] / 1e9 for key in ("moved", "operations"))
        rates = (f"{rate:.2g}" if rate < 10 else f"{rate:.0f}" for rate in (moved, done))
        table.add_row(row["work"], f"{row['seconds']:.3g}", *rates, f"{100 * row['share']:.1f} %", row["bound"])
    table.columns[0].no_wrap = False
    table.caption = (
        "GB/s: bytes that have to be moved to or from memory at the least; Gop/s: operations of matrix products."
        " copy and product: what the machine does at its best, and so the limit."
    )
    return table


def gpu_table(rows: Rows) -> Table:
    """Seconds on an accelerator."""
    table = titled(f"On {rows[0]['device']}", 1)
    columns(table, ("job", "seconds", "peak MiB"), 1)
    for row in rows:
        peak = "" if row["peak_bytes"] is None else f"{row['peak_bytes'] / MEBI:,.0f}"
        table.add_row(row["about"], f"{row['seconds']:.3g}", peak)
    table.columns[0].no_wrap = False
    return table


def _short(number: float) -> str:
    return f"{number:,.0f}" if number >= 100 else f"{number:.3g}"
