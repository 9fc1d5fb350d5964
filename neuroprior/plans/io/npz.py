"""Plans in NumPy's `.npz`: the arrays of `Plans` by their names; nothing is pickled."""

import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neuroprior._checks import check_single_precision
from neuroprior._files import written_whole
from neuroprior.plans.columns import Names, check_file, feature_notes, listed, never_notes
from neuroprior.plans.io.assembly import renamed
from neuroprior.plans.plans import Plans
from neuroprior.plans.sequences import constant_context

NUMBERS = ("actions", "lengths", "context", "group", "durations", "condition")
NAMES = ("action_names", "context_names", "group_names", "condition_names", "plan_names")


def read_npz(path: Path, num_actions: int | None, action_names: Names | None) -> Plans:
    """Plans of a `.npz` file: see `read_plans`."""
    arrays, unused = arrays_of(path, (*NUMBERS, *NAMES, "num_actions", "end"))
    for key in ("group", "condition"):
        if key in arrays and arrays[key].dtype.kind == "U" and f"{key}_names" not in arrays:
            texts = np.char.strip(arrays[key])
            if (texts == "").any():
                raise ValueError(f"{path}: {key}: an empty text; a name for every plan is expected")
            arrays[f"{key}_names"], arrays[key] = np.unique(texts, return_inverse=True)
    for key in NUMBERS:
        if key in arrays and arrays[key].dtype.kind not in "iuf":
            what = "numbers, or of texts without names," if key in ("group", "condition") else "numbers"
            raise ValueError(f"{path}: {key}: an array of {what} is expected, not of {arrays[key].dtype}")
    if "actions" not in arrays:
        raise ValueError(f"{path}: no array 'actions'; it has {', '.join(sorted([*arrays, *unused])) or 'none'}")
    if arrays["actions"].ndim == 3:
        raise ValueError(
            f"{path}: actions {list(arrays['actions'].shape)} are vectors: in Python"
            " neuroprior.control.read_vector_plans reads them; programs take numbered actions"
        )
    numbers: dict[str, Any] = {key: torch.from_numpy(native(arrays[key])) for key in NUMBERS if key in arrays}
    names: dict[str, Any] = {key: names_of(path, key, arrays[key]) for key in NAMES if key in arrays}
    end = _whole(path, "end", arrays)
    known = num_actions or _whole(path, "num_actions", arrays)
    if known is None and "action_names" in names:
        known = len(names["action_names"])
    try:
        guessed = known is None and action_names is None
        if known is None:
            known = _largest(numbers) + 1 if action_names is None else len(action_names)
        plans = Plans(num_actions=known, end=end, **numbers, **names)
        if plans.context is not None and plans.context.is_floating_point():
            check_single_precision("context", plans.context[plans.mask()])
        notes = list(never_notes(plans.actions[plans.mask()].numpy(), known) if guessed else [])
        notes += feature_notes(numbers.get("context"), plans.max_length)
        if unused:
            notes.append(f"arrays that are not used: {listed(unused)}")
        plans = replace(plans, notes=tuple(notes))
        return renamed(plans, action_names, str(path))
    except (ValueError, TypeError, RuntimeError) as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise ValueError(f"{path}: {reason.splitlines()[0]}") from error


def write_npz(plans: Plans, path: Path) -> None:
    """Write a `.npz` file, not compressed."""
    tensors = {key: getattr(plans, key) for key in NUMBERS}
    once = constant_context(plans)  # a context that never changes is written once a plan
    tensors["context"] = plans.context if once is None else once
    arrays = {key: as_array(value) for key, value in tensors.items() if value is not None}
    for key in NAMES:
        if getattr(plans, key) is not None:
            arrays[key] = np.array(getattr(plans, key), str)
    for key in ("num_actions", "end"):
        if getattr(plans, key) is not None:
            arrays[key] = np.array(getattr(plans, key))
    with written_whole(path, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def arrays_of(path: Path, keys: Sequence[str]) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Those arrays of a `.npz` file that have one of these names, and the names of the others."""
    check_file(path)
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: not a .npz file (a zip archive of arrays), or cut off; np.savez writes one")
    key = None
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {}
            for key in [key for key in file.files if key in keys]:
                found[key] = np.asarray(file[key])
            return found, [key for key in file.files if key not in keys]
    except Exception as error:  # numpy, zipfile and zlib raise a dozen unrelated kinds over damaged bytes
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        if "allow_pickle" in reason:
            reason = "an array of Python objects; numbers, or texts of a fixed size, are expected"
        raise ValueError(f"{path}: {key or 'the archive'}: {reason}") from error


def native(array: NDArray[Any]) -> NDArray[Any]:
    """The same numbers in an order of bytes and a type that torch knows."""
    if array.dtype.kind == "f" and array.dtype.itemsize > 8:
        return array.astype(np.float64)
    if array.dtype.kind == "u" and array.dtype.itemsize > 1:
        # what is too large for int64 turns negative, and is refused as such
        return np.ascontiguousarray(array.astype(np.int64)).reshape(array.shape)
    return np.ascontiguousarray(array.astype(array.dtype.newbyteorder("="))).reshape(array.shape)


def names_of(path: Path, key: str, array: NDArray[Any]) -> Names:
    if array.ndim != 1 or array.dtype.kind != "U":
        raise ValueError(f"{path}: {key}: one row of texts is expected, not {array.dtype} of shape {list(array.shape)}")
    return tuple(str(name) for name in array)


def _whole(path: Path, key: str, arrays: dict[str, NDArray[Any]]) -> int | None:
    if key not in arrays:
        return None
    array = arrays[key]
    if array.size != 1 or array.dtype.kind not in "iu":
        raise ValueError(f"{path}: {key}: one integer is expected, not {array.dtype} of shape {list(array.shape)}")
    return int(array.item())


def _largest(numbers: dict[str, torch.Tensor]) -> int:
    """The largest action, of those that count."""
    actions, lengths = numbers["actions"], numbers.get("lengths")
    if actions.dim() == 2 and lengths is not None and lengths.shape == actions.shape[:1] and bool((lengths >= 0).all()):
        actions = actions.long()[torch.arange(actions.shape[1]) < lengths[:, None]]
    if not actions.numel():
        raise ValueError("no plan has an action, so num_actions must be given")
    return int(actions.long().max())


def as_array(values: torch.Tensor) -> NDArray[Any]:
    values = values.detach().cpu()
    return (values.float() if values.dtype == torch.bfloat16 else values).numpy()
