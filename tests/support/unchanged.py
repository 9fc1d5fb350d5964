"""Pinned results: what small seeded pieces of the library gave when they were last looked at.

They find a change that nobody meant; they do not know what is right. Closed forms and exact enumeration say that, in
the other tests, and a pinned result stands for none of these. Each case is a function in `tests/support/pinned/`;
`python -m tests.support.unchanged` writes what they give now to `unchanged.json`, which accepts all changes, and
`python -m tests.support.unchanged NAME ...` those of some cases. Numbers are pinned to six digits, and long arrays by
their shape, first numbers and two weighted means.
"""

import dataclasses
import json
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from torch import Tensor

PINNED = Path(__file__).with_suffix(".json")

ACCEPT = "python -m tests.support.unchanged"

LONGEST = 8
"""Numbers of an array that are all written out."""

RELATIVE, ABSOLUTE = 2e-4, 2e-6
"""How far apart numbers may be, on other machines: of sums in another order, and of networks that learned from them."""

SINGLE = 2.0**-22
"""Relative distance of numbers in texts that are the same in single precision but for the last digits."""

DECIMAL = re.compile(r"[-+]?\d+\.\d+(?:e[-+]?\d+)?|[-+]?\d+e[-+]?\d+")
"""Numbers in texts that may differ in their last digit."""


class Case(NamedTuple):
    """A pinned piece of the library.

    Attributes:
        run: makes the results.
        relative: how far apart numbers may be.
        slow: whether the case takes seconds, so that it is not run each time.
    """

    run: Callable[[], Any]
    relative: float
    slow: bool


CASES: dict[str, Case] = {}


def case(function: Callable[[], Any] | None = None, *, relative: float = RELATIVE, slow: bool = False) -> Any:
    """Enter a function among the `CASES`, under its name.

    Args:
        function: returns nested dicts and lists of what `simple` knows.
        relative: how far apart numbers may be.
        slow: see `Case`.
    """
    if function is None:
        return lambda function: case(function, relative=relative, slow=slow)
    assert function.__name__ not in CASES, function.__name__
    CASES[function.__name__] = Case(function, relative, slow)
    return function


def simple(value: Any) -> Any:
    """Nested dicts and lists of JSON's values, of what a case returns."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else str(value)
    if isinstance(value, Tensor):
        return simple(value.detach().cpu().numpy())
    if isinstance(value, np.generic):
        return simple(value.item())
    if isinstance(value, np.ndarray):
        return simple(value.tolist()) if value.size <= LONGEST else _summary(value)
    if isinstance(value, pd.DataFrame):
        return {str(name): simple(list(value[name])) for name in value} | {"columns": [str(name) for name in value]}
    if isinstance(value, Figure):
        return simple(figure_data(value))
    if isinstance(value, Mapping):
        return {str(key): simple(one) for key, one in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: simple(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if hasattr(value, "_asdict"):
        return simple(value._asdict())
    if isinstance(value, Sequence | Iterator | set):
        values = sorted(value) if isinstance(value, set) else list(value)
        if len(values) > LONGEST and all(isinstance(one, int | float | np.number) for one in values):
            return _summary(np.array(values))
        if len(values) > LONGEST and all(isinstance(one, str | None) for one in values):
            return {"number": len(values), "first": values[:8], "sum": crc32("\n".join(map(str, values)).encode())}
        return [simple(one) for one in values]
    return value.__qualname__ if callable(value) else type(value).__name__


def _summary(values: np.ndarray) -> dict[str, Any]:
    """A long array by its shape, first numbers and two weighted means, which know the order."""
    if values.dtype == object:
        return {"shape": list(values.shape), "values": [str(one) for one in values.flat]}
    place, flat = np.arange(values.size), values.astype(float).ravel()
    there = np.isfinite(flat)
    means = [simple(float(np.where(there, flat * weight, 0).mean())) for weight in (1 + place % 7, 1 + place % 101)]
    first = simple(values.ravel()[:4].tolist())
    return {"shape": list(values.shape), "first": first, "means": means, "finite": int(there.sum())}


def figure_data(figure: Figure) -> list[dict[str, Any]]:
    """What each axes of a figure show: the data behind their lines, dots, patches and pictures, and all texts."""
    found: list[dict[str, Any]] = [{"size": [*map(float, figure.get_size_inches())]}]
    for axes in figure.axes:
        own: dict[str, Any] = {
            "titles": [axes.get_title(loc=where) for where in ("left", "center", "right")],
            "labels": [axes.get_xlabel(), axes.get_ylabel()],
            "scales": [axes.get_xscale(), axes.get_yscale()],
            "limits": [*map(float, axes.get_xlim()), *map(float, axes.get_ylim())],
            "ticks": [[tick.get_text() for tick in axis.get_ticklabels()] for axis in (axes.xaxis, axes.yaxis)],
            "texts": [text.get_text() for text in axes.texts],
            "lines": [
                {"label": _label(one), "data": np.asarray(one.get_xydata(), float), "style": _style(one)}
                for one in axes.lines
            ],
            "patches": [
                {"data": one.get_path().transformed(one.get_patch_transform()).vertices, "color": one.get_facecolor()}
                for one in axes.patches
            ],
            "collections": [
                {
                    "label": _label(one),
                    "offsets": np.asarray(one.get_offsets(), float),
                    "paths": np.concatenate([np.zeros((0, 2)), *(path.vertices for path in one.get_paths())]),
                    "colors": np.asarray(one.get_facecolor()),
                    "values": None if one.get_array() is None else np.ma.filled(one.get_array().astype(float), np.nan),
                }
                for one in axes.collections
            ],
            "images": [np.ma.filled(one.get_array().astype(float), np.nan) for one in axes.images],
        }
        found.append({name: some for name, some in own.items() if some})
    legends = [*figure.legends, *(legend for axes in figure.axes if (legend := axes.get_legend()))]
    return [*found, {"legends": [[text.get_text() for text in one.get_texts()] for one in legends]}]


def _label(artist: Any) -> str:
    """The label that somebody gave."""
    label = str(artist.get_label())
    return "" if label.startswith("_") else label


def _style(line: Any) -> list[str]:
    sizes = f"{line.get_linewidth():g} {line.get_markersize():g} {line.get_alpha()}"
    return [str(line.get_color()), str(line.get_linestyle()), str(line.get_marker()), sizes]


def differences(pinned: Any, found: Any, relative: float = RELATIVE, path: str = "") -> list[str]:
    """A line for each value that differs: its path, what was pinned, what was found."""
    if isinstance(pinned, dict) and isinstance(found, dict):
        lines = []
        for key in sorted({*pinned, *found}):
            there = f"{path}/{key}"
            if key not in found:
                lines.append(f"{there}: pinned {_short(pinned[key])}, found nothing")
            elif key not in pinned:
                lines.append(f"{there}: pinned nothing, found {_short(found[key])}")
            else:
                lines += differences(pinned[key], found[key], relative, there)
        return lines
    if isinstance(pinned, list) and isinstance(found, list) and len(pinned) == len(found):
        pairs = enumerate(zip(pinned, found, strict=True))
        return [line for number, pair in pairs for line in differences(*pair, relative, f"{path}/{number}")]
    return [] if _same(pinned, found, relative) else [f"{path}: pinned {_short(pinned)}, found {_short(found)}"]


def _same(pinned: Any, found: Any, relative: float) -> bool:
    if (isinstance(pinned, float) and isinstance(found, int | float)) or (
        isinstance(found, float) and type(pinned) is int
    ):
        return math.isclose(pinned, found, rel_tol=relative, abs_tol=ABSOLUTE)
    if isinstance(pinned, str) and isinstance(found, str) and pinned != found:
        ends = [DECIMAL.findall(text) for text in (pinned, found)]
        if DECIMAL.split(pinned) != DECIMAL.split(found) or len(ends[0]) != len(ends[1]):
            return False
        pairs = [(one, float(one), float(other)) for one, other in zip(*ends, strict=True)]
        return all(abs(a - b) <= max(1.01 * _last_digit(one), SINGLE * abs(a)) for one, a, b in pairs)
    return type(pinned) is type(found) and pinned == found


def _last_digit(number: str) -> float:
    """What the last digit of a written number counts."""
    mantissa, _, exponent = number.partition("e")
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 200 else f"{text[:200]}..."


def found_of(name: str) -> Any:
    """What a case gives now."""
    return simple(CASES[name].run())


def pinned() -> dict[str, Any]:
    """What all cases gave when they were last looked at."""
    read: dict[str, Any] = json.loads(PINNED.read_text())
    return read


def written(value: Any, margin: str = "") -> str:
    """JSON that is good to compare line by line: sorted keys, and what is short on one line."""
    inner, line = margin + " ", json.dumps(value, sort_keys=True)
    if len(line) <= 100:
        return line
    if isinstance(value, dict) and value:
        rows = [f"{inner}{json.dumps(key)}: {written(value[key], inner)}" for key in sorted(value)]
        return "{\n" + ",\n".join(rows) + f"\n{margin}}}"
    if isinstance(value, list) and any(isinstance(one, dict | list | str) for one in value):
        return "[\n" + ",\n".join(f"{inner}{written(one, inner)}" for one in value) + f"\n{margin}]"
    return line


def main(names: Sequence[str]) -> int:
    """Write what the cases give now; those of some names only, where there are any."""
    known = pinned() if PINNED.exists() else {}
    if wrong := [name for name in names if name not in CASES]:
        print(f"error: {wrong[0]}: no such case; there are {', '.join(CASES)}", file=sys.stderr)
        return 2
    new = {name: found_of(name) for name in names or CASES}
    for name, found in new.items():
        lines = differences(known.get(name), found, CASES[name].relative) if name in known else ["new"]
        print(f"{name}: {len(lines)} changed" if lines else f"{name}: unchanged")
        # What has not changed stays as it is written, to the last digit.
        new[name] = found if lines else known[name]
    kept = {name: known[name] for name in known if name in CASES}
    PINNED.write_text(written(kept | new) + "\n")
    return 0


if __name__ == "__main__":
    # The cases register with this module by its name, of which the program is another copy.
    from tests.support import pinned as _  # noqa: F401
    from tests.support.unchanged import main as accept

    torch.set_num_threads(1)
    sys.exit(accept(sys.argv[1:]))
