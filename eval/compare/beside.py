"""Finished runs of other comparisons beside those of this one: other priors, from the same starts."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from eval.compare.results import PRIOR
from eval.compare.run import Settings
from eval.worlds.runs import Run, read_run
from neuroprior._files import read_json

FREE = ("kinds", "priors", "digests", "context")
"""What may differ between comparisons: it says which priors they have, not where these plan."""

Result = Mapping[str, Any]


def finished_runs(folder: str, settings: Settings, runs: Sequence[Run]) -> list[Result]:
    """The results of `runs` in the folder of another comparison, which was made with the same settings.

    Args:
        folder: its `--out`, or, where this has several comparisons, the folder below it that holds the runs of one.
        settings: of this comparison.
        runs: those of this comparison.

    Raises:
        ValueError: the folder does not have them all, or has them several times (other priors, or another version of
            the code); or one is damaged.
    """
    asked = _fixed_settings({"command": "compare"} | settings.asked)
    places = [path.parent for at in ("asked.json", "runs/*/asked.json") for path in sorted(Path(folder).glob(at))]
    matching = [place for place in places if _fixed_settings(read_json(place / "asked.json")) == asked]
    if not matching:
        raise ValueError(f"beside: {folder} has no comparison of the same settings (but for kinds, priors and context)")
    missing = {place: [run for run in runs if not (place / f"{run.name}.json").exists()] for place in matching}
    whole = [place for place in matching if not missing[place]]
    if len(whole) > 1:
        several = " or ".join(map(str, whole))
        raise ValueError(f"beside: {folder} has {len(whole)} comparisons of these settings; give {several}")
    if not whole:
        fewest = min(missing.values(), key=len)
        raise ValueError(
            f"beside: {len(fewest)} of {len(runs)} runs are not finished in {folder}, such as {fewest[0].name}"
        )
    return [read_run(whole[0] / f"{run.name}.json") for run in runs]


def _fixed_settings(asked: Any) -> Any:
    """What was asked, as JSON has it, but for what may differ."""
    if not isinstance(asked, Mapping):
        return None
    return json.loads(json.dumps({name: value for name, value in asked.items() if name not in FREE}))


def put_beside(results: Sequence[Result], others: Sequence[Result]) -> list[dict[str, Any]]:
    """Results with the entries that others have of the same worlds and seeds, and they lack.

    Raises:
        ValueError: random plans reach something else in the others: these did not plan from the same starts.
    """
    return [_merge(mine, other) for mine, other in zip(results, others, strict=True)]


def _merge(mine: Result, other: Result) -> dict[str, Any]:
    if _starts(mine) != _starts(other):
        where = f"{mine['world']}, seed {mine['seed']}"
        raise ValueError(f"beside: {where}: random plans do not reach the same; the worlds or starts were others")
    return dict(mine) | {
        "entries": _join_rows(mine["entries"], other["entries"], ("planner", *PRIOR)),
        "curriculum": _join_rows(mine["curriculum"], other["curriculum"], PRIOR[:2]),
        "transitions": other.get("transitions", {}) | mine.get("transitions", {}),
    }


def _join_rows(mine: Sequence[Result], others: Sequence[Result], by: Sequence[str]) -> list[Result]:
    """Rows, and those of others that differ from all of them in `by`."""
    my_keys = {tuple(row[name] for name in by) for row in mine}
    return [*mine, *(row for row in others if tuple(row[name] for name in by) not in my_keys)]


def _starts(result: Result) -> Any:
    """What is the same from the same starts, whatever the priors: what plans without a prior reach."""
    random = [entry["share"] for entry in result["entries"] if entry["prior"] in (None, "uniform")]
    return [result["length"], result["num_starts"], result["budgets"], random]
