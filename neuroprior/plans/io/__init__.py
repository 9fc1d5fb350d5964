"""Reading and writing plans: one function each for all kinds of files; datasets of Minari; trajectories in memory."""

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from neuroprior.plans.columns import check_names
from neuroprior.plans.io.csv import read_csv, write_csv
from neuroprior.plans.io.jsonl import read_jsonl, write_jsonl
from neuroprior.plans.io.minari import read_minari, write_minari
from neuroprior.plans.io.npz import read_npz, write_npz
from neuroprior.plans.io.trajectories import from_trajectories, to_trajectories
from neuroprior.plans.plans import Plans, check_are_plans, check_plain_plans, has_patterns

__all__ = ["from_trajectories", "read_minari", "read_plans", "to_trajectories", "write_minari", "write_plans"]

MINARI = "minari:"
"""Before the name of a Minari dataset, where a file may be given."""


class FileKind(NamedTuple):
    """How one kind of file is read and written."""

    read: Callable[..., Plans]
    write: Callable[..., None]


FILES = {
    ".csv": FileKind(read_csv, write_csv),
    ".tsv": FileKind(read_csv, write_csv),
    ".jsonl": FileKind(read_jsonl, write_jsonl),
    ".npz": FileKind(partial(read_npz, kind=Plans), write_npz),
}
"""The kinds of files, by suffix."""


def read_plans(
    path: str | os.PathLike[str],
    *,
    num_actions: int | None = None,
    action_names: Sequence[str] | None = None,
) -> Plans:
    """Plans of a file, by its suffix, or of a Minari dataset: `minari:` and its name, see `read_minari`.

    - `.npz`: arrays named like the attributes of `Plans`; only `actions [N, L]` is required. Nothing is unpickled.
    - `.jsonl`: one plan a line, an object with `actions`, a list of integers or of names, and optionally `context`,
      `group`; `plan`, its name, is not kept. A context is an integer or a name; a list of these, one for each action;
      features of the plan, a list of numbers (at least one in the file with a decimal point, else all are taken for
      integers); or features of each step, a list of lists; all plans of a file have the same kind. The first line may
      have, in place of `actions`, any of `num_actions`, `action_names`, `context_names`, `group_names` and `end`.
    - `.csv`, `.tsv` (commas, semicolons or tabs), one plan a row: columns `action_1`, `action_2`, ..., empty after a
      plan's end, and perhaps `context` (or `context_1`, `context_2`, ..., features) and `group`; other columns are
      ignored. Or no header, and all cells are actions.

    Tables of events, one action a row, as laboratories record behaviour, are read by `neuroprior.behaviour.read`.

    Whole numbers are indices; names are numbered in sorted order. In CSV, groups are names if any of them is not a
    number.

    Args:
        path: the file or dataset.
        num_actions: A; None for what the file says, else the number of names, else the largest action + 1, at most
            65,536: larger numbers are seldom actions.
        action_names: A names in the order of their numbers; without them the names are sorted.

    Returns:
        N plans, padded to the longest: context and group are int64, features float32 (`.npz`: as they are).

    Warns:
        UserWarning: the file has arrays or keys of other names, which are not used.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: an argument or the file is wrong; the message names the file and the line or the array. So are data
            that would take over 256 MiB and 100 times what they hold: plans padded to one that is far longer than the
            others, arrays that are compressed so much (`np.savez` writes them otherwise).

    Example:
        >>> write_plans(
        ...     Plans(torch.tensor([[0, 1, 1], [2, 0, 0]]), 3, action_names=("eat", "rest", "walk")), "plans.csv"
        ... )
        >>> read_plans("plans.csv").action_names
        ('eat', 'rest', 'walk')
    """
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"`path` must be the name of a file, got {type(path).__name__}")
    if isinstance(path, str) and path.startswith(MINARI):
        return read_minari(path.removeprefix(MINARI))
    place = Path(path)
    names = check_names(num_actions, action_names)
    return FILES[_suffix(place)].read(place, num_actions, names)


def write_plans(plans: Plans, path: str | os.PathLike[str]) -> None:
    """Write plans to a file, by its suffix: those that `read_plans` reads. An old file is replaced once it is whole.

    `.npz` keeps everything, also what a subclass of `Plans` adds; `.jsonl` all that `Plans` have. CSV, with one plan a
    row, holds no context that changes within plans. It keeps names where there are any, else numbers, but not how many
    actions are possible: give `num_actions` or `action_names` when reading it. Names of contexts and groups are
    numbered in sorted order then. Before a name that a spreadsheet would take for a formula, as one that begins with =,
    stands an apostrophe, which `read_plans` leaves out.

    Args:
        plans: at least one.
        path: the file.

    Raises:
        ValueError: the file cannot hold these plans; the message says why.
        OSError: the file cannot be written.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 1], [2, 0, 0]]), 3)
        >>> write_plans(plans, "plans.jsonl")
        >>> torch.equal(read_plans("plans.jsonl").actions, plans.actions)
        True
    """
    check_are_plans(plans)
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"`path` must be a file, got {type(path).__name__}")
    place = Path(path)
    suffix = _suffix(place)
    if not len(plans):
        raise ValueError(f"{place}: no plans to write")
    if suffix != ".npz":
        check_plain_plans(plans, place)
    context = plans.context
    if suffix != ".npz" and context is not None and has_patterns(context):
        raise ValueError(f"{place}: patterns {list(context.shape)} are written to .npz files only")
    if suffix != ".npz" and context is not None and context.is_floating_point():
        if not context.shape[-1]:
            raise ValueError(f"{place}: a context of no features; use None")
        if not context.float().isfinite().all():
            raise ValueError(f"{place}: features too large for the 32 bits in which they are read")
    FILES[suffix].write(plans, place)


def is_table(path: str | os.PathLike[str]) -> bool:
    """Whether a file is read as a table, in which names may be numbers; by its suffix."""
    kind = FILES.get(Path(path).suffix.lower())
    return kind is not None and kind.read is read_csv


def _suffix(path: Path) -> str:
    if path.suffix.lower() not in FILES:
        raise ValueError(
            f"{path}: a file of the kind {', '.join(FILES)} is expected, not {path.suffix or 'no suffix'!r}"
        )
    return path.suffix.lower()
