"""Reading and writing plans of vectors: `.npz`, Minari datasets with a Box of actions, trajectories in memory."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuroprior._checks import kind_of
from neuroprior._files import written_whole
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.plans.columns import padded, warn_of_unused
from neuroprior.plans.io.minari import local_dataset, one_line
from neuroprior.plans.io.npz import arrays_of, as_array, names_of, native
from neuroprior.plans.io.trajectories import array_of, check_are_several, joined, observations_of, parts_of

MINARI = "minari:"
NUMBERS = ("actions", "action_low", "action_high", "lengths", "context", "group")


def read_vector_plans(path: str | os.PathLike[str]) -> VectorPlans:
    """Plans of vectors from a `.npz` file, or from a local Minari dataset: `minari:` and its name.

    A `.npz` file has arrays named like the attributes of `VectorPlans`; `actions [N, L, D]`, `action_low` and
    `action_high [D]` are required, and nothing is unpickled. Each episode of a Minari dataset is a plan, and its
    observations are features per step; nothing is downloaded.

    Args:
        path: the file or dataset.

    Warns:
        UserWarning: the file has arrays of other names, which are not used.

    Raises:
        FileNotFoundError: there is no such file or dataset.
        ValueError: it is damaged or holds no such plans; the message names it and what is wrong.
        ImportError: Minari is not installed.

    Example:
        >>> write_vector_plans(VectorPlans(torch.zeros(4, 10, 2), [-1.0, -1.0], [1.0, 1.0]), "reaching.npz")
        >>> read_vector_plans("reaching.npz").actions.shape
        torch.Size([4, 10, 2])
    """
    if isinstance(path, str) and path.startswith(MINARI):
        return _read_minari(path.removeprefix(MINARI))
    place = _npz(path)
    arrays, unused = arrays_of(place, (*NUMBERS, "action_names"))
    for key in ("actions", "action_low", "action_high"):
        if key not in arrays:
            raise ValueError(f"{place}: `{key}` is missing, got {', '.join(sorted([*arrays, *unused])) or 'no arrays'}")
    for key, array in arrays.items():
        if key in NUMBERS and array.dtype.kind not in "iuf":
            raise ValueError(f"{place}: `{key}` must be numbers, got {array.dtype}")
    names = names_of(place, "action_names", arrays["action_names"]) if "action_names" in arrays else None
    numbers: dict[str, Any] = {key: torch.from_numpy(native(arrays[key])) for key in NUMBERS if key in arrays}
    if numbers["actions"].dim() == 2:
        raise ValueError(
            f"{place}: `actions` must have shape [N, L, D], got {list(numbers['actions'].shape)} (cut a flat recording"
            " into episodes for vector_plans_from_trajectories; read_plans reads discrete actions)"
        )
    warn_of_unused(place, "arrays", unused)
    try:
        return VectorPlans(**numbers, action_names=names)
    except (ValueError, RuntimeError, IndexError) as error:
        raise ValueError(f"{place}: {str(error).splitlines()[0]}") from error


def write_vector_plans(plans: VectorPlans, path: str | os.PathLike[str]) -> None:
    """Write plans to a `.npz` file, which `read_vector_plans` reads. An old file is replaced once it is whole.

    Args:
        plans: of vectors.
        path: the file, which ends in `.npz`.

    Raises:
        ValueError: these are no plans of vectors, or the file is of another kind.
        OSError: the file cannot be written.

    Example:
        >>> write_vector_plans(VectorPlans(torch.zeros(4, 10, 2), [-1.0, -1.0], [1.0, 1.0]), "reaching.npz")
    """
    if not isinstance(plans, VectorPlans):
        raise ValueError(f"`plans` must be VectorPlans, got {kind_of(plans)}")
    place = _npz(path)
    arrays = {key: as_array(getattr(plans, key)) for key in NUMBERS if getattr(plans, key) is not None}
    if plans.action_names is not None:
        arrays["action_names"] = np.array(plans.action_names, str)
    with written_whole(place, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def vector_plans_from_trajectories(
    trajectories: Iterable[Any],
    action_low: Sequence[float] | Tensor,
    action_high: Sequence[float] | Tensor,
    *,
    observations: str | None = "context",
) -> VectorPlans:
    """Plans of vectors of trajectories (episodes), one each.

    Args:
        trajectories: of the kinds that `from_trajectories` takes, with an array of D numbers for each action.
        action_low, action_high: `[D]`, the bounds.
        observations: "context" to make arrays of observations features per step (flattened); None to leave them out.

    Raises:
        ValueError: actions or observations are wrong, or beyond the bounds; the message names the trajectory, where it
            is of one, counted from 0.

    Example:
        >>> steps = {"actions": torch.zeros(3, 1), "observations": torch.ones(3, 2)}
        >>> vector_plans_from_trajectories([steps], [-1.0], [1.0]).context.shape
        torch.Size([1, 3, 2])
    """
    if observations not in ("context", None):
        raise ValueError(f"`observations` must be 'context' or None, got {observations!r}")
    low, high = (array_of(bound, name) for bound, name in ((action_low, "action_low"), (action_high, "action_high")))
    if low.ndim != 1 or low.shape != high.shape:
        raise ValueError(
            f"`action_low` and `action_high` must have shape [D], got {list(low.shape)} and {list(high.shape)}"
        )
    check_are_several(trajectories)
    taken, observed = [], []
    for number, trajectory in enumerate(trajectories):
        place = f"trajectory {number}"
        actions, seen = parts_of(trajectory, place)
        vectors = array_of(actions, f"{place}: actions")
        if not vectors.size:
            vectors = np.zeros((0, low.size), np.float32)
        if vectors.dtype.kind not in "iuf" or vectors.ndim != 2 or vectors.shape[1] != low.size:
            raise ValueError(
                f"{place}: `actions` must be numbers [T, {low.size}], got {vectors.dtype} {list(vectors.shape)} (of"
                " discrete actions see from_trajectories)"
            )
        taken.append(vectors.astype(np.float32))
        if observations is not None:
            features = None if seen is None else observations_of(seen, len(vectors), place)
            if features is not None and features.ndim == 1:
                raise ValueError(f"{place}: `observations` must be arrays of features, got integers")
            observed.append(features)
    if not taken:
        raise ValueError("`trajectories` must have at least one, got an empty list")
    lengths = np.array([len(vectors) for vectors in taken])
    context = joined(observed)
    try:
        return VectorPlans(
            torch.from_numpy(padded(np.concatenate(taken), lengths, "trajectories")),
            torch.from_numpy(low),
            torch.from_numpy(high),
            None if (lengths == lengths[0]).all() else torch.from_numpy(lengths),
            None if context is None else torch.from_numpy(padded(context, lengths, "trajectories")),
        )
    except (ValueError, TypeError) as error:
        raise ValueError(f"trajectories: {error}") from error


def _read_minari(dataset_id: str) -> VectorPlans:
    dataset = local_dataset(dataset_id)
    with one_line(dataset_id):
        space = dataset.action_space
        if not hasattr(space, "low") or len(space.shape) != 1:
            raise ValueError(f"actions must be of a Box of one dimension, got {space} (else see read_minari)")
        if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
            raise ValueError(
                f"actions must have finite bounds, got {space}; where you know them, give them to"
                f" vector_plans_from_trajectories(minari.load_dataset({dataset_id!r}).iterate_episodes(), low, high)"
            )
        return vector_plans_from_trajectories(dataset.iterate_episodes(), space.low, space.high)


def _npz(path: str | os.PathLike[str]) -> Path:
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"`path` must be the name of a file, got {kind_of(path)}")
    if Path(path).suffix.lower() != ".npz":
        raise ValueError(f"`path` must end in .npz, or be minari: and a dataset's name, got {path}")
    return Path(path)
