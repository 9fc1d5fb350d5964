"""Writing results: CSV and JSON, each to a temporary name first and renamed when whole."""

import csv
import json
import math
import os
import platform
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import lightning
import numpy
import torch

import neuroprior


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write an object as JSON; numbers that are not finite, which JSON does not have, become null."""
    write_whole(path, json.dumps(_finite(content), indent=2, allow_nan=False).encode() + b"\n")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows with the same keys as CSV with a heading."""
    text = StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(path, text.getvalue().encode())


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all."""
    partial = path.with_name(f".{path.name}.partial")
    partial.write_bytes(content)
    os.replace(partial, path)


def versions() -> dict[str, str]:
    """The versions that results depend on."""
    return {
        "neuroprior": neuroprior.__version__,
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "numpy": numpy.__version__,
        "lightning": str(lightning.__version__),
    }
