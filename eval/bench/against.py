"""Regressions: the results of two runs of `python -m eval bench`, such as of two commits, compared."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from neuroprior._files import read_json
from neuroprior.behaviour.reporting.document import table
from neuroprior.behaviour.reporting.page import Table

KEYS = {
    "rows": ("job", "peer"),
    "imports": (),
    "sizes": ("growing", "size"),
    "limits": ("work",),
    "gpu": ("job", "device"),
}
"""By part of the results: what names a row."""

LEAST = 1.1
"""A smaller factor is no verdict, whatever the spread of the repetitions."""


def read_results(path: str) -> dict[str, Any]:
    """What the bench wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is none of the bench's.
    """
    results = read_json(Path(path))
    if (
        not isinstance(results, dict)
        or "settings" not in results
        or not any(isinstance(results.get(k), list) for k in KEYS)
    ):
        raise ValueError(f"{path}: no results of the bench; its results.json is expected")
    return results


def compared(before: Mapping[str, Any], now: Mapping[str, Any]) -> pd.DataFrame:
    """A row for each measurement that both results have: its `name`, seconds `before` and `now`, `factor`, `verdict`.

    `factor` is how many times as long the library takes now. Where it was timed in turn with a peer (or torch's
    import), both times are in units of the peer's, so that another machine or a busier one matters less; only there,
    where the repetitions of one run all lie above those of the other and the factor is at least `LEAST`, is there a
    verdict.

    Raises:
        ValueError: the two were not measured with the same scale and threads, or have nothing in common.
    """
    for name in ("scale", "threads"):
        if before["settings"].get(name) != now["settings"].get(name):
            raise ValueError(
                f"`against` must be measured with {name} {now['settings'].get(name)}, as these results,"
                f" got {before['settings'].get(name)}"
            )
    rows = []
    for kind, names in KEYS.items():
        earlier = {tuple(row[name] for name in names): row for row in before.get(kind, [])}
        for row in now.get(kind, []):
            key = tuple(row[name] for name in names)
            if key in earlier:
                rows.append(_row(": ".join(map(str, key)) or "from neuroprior import *", kind, earlier[key], row))
    if not rows:
        raise ValueError("`against` must have measurements in common with these results, got none")
    return pd.DataFrame(rows)


def _row(name: str, kind: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    factor, verdict = new["seconds"] / old["seconds"], ""
    if "ratio" in new:
        # of peers: the peer's time in units of ours; of the import: ours in units of torch's
        (old_low, old_high), (new_low, new_high) = (_spread(kind, one) for one in (old, new))
        factor = _relative_time(kind, new["ratio"]) / _relative_time(kind, old["ratio"])
        slower, faster = new_low > old_high and factor >= LEAST, new_high < old_low and factor <= 1 / LEAST
        verdict = "slower" if slower else "faster" if faster else "no difference"
    return {"name": name, "before": old["seconds"], "now": new["seconds"], "factor": factor, "verdict": verdict}


def _relative_time(kind: str, ratio: float) -> float:
    """Our time in units of the peer's."""
    return ratio if kind == "imports" else 1 / ratio


def _spread(kind: str, row: Mapping[str, Any]) -> tuple[float, float]:
    ends = sorted(_relative_time(kind, row[end]) for end in ("low", "high"))
    return ends[0], ends[1]


def regression_table(rows: pd.DataFrame, path: str) -> Table:
    """The table of these rows."""
    columns = {"measurement": "name", "before, s": "before:.3g", "now, s": "now:.3g"}
    columns |= {"factor": "factor:.2f", "verdict": "verdict"}
    caption = (
        "factor: how many times as long it takes now; with a peer, in units of the peer's time. A verdict where all"
        f" repetitions of one run lie beyond those of the other, by a factor of at least {LEAST:g}."
    )
    return table(rows, columns, caption, f"Against {path}")
