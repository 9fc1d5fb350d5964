"""Plans in NumPy's `.npz`: the fields of `Plans`, or of a subclass, by their names; nothing is pickled."""

import zipfile
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from neuroprior._checks import check_memory, check_single_precision
from neuroprior._files import grows_too_much, written_whole
from neuroprior.plans.columns import Names, check_file, count_up_to, warn_of_unused
from neuroprior.plans.io.assembly import renamed
from neuroprior.plans.plans import AnyPlans, Plans
from neuroprior.plans.sequences import constant_context


def read_npz(path: Path, num_actions: int | None, action_names: Names | None, kind: type[AnyPlans]) -> AnyPlans:
    """Plans of a `.npz` file, of the class `kind`: see `read_plans`."""
    numbered, counts, texts = _fields(kind)
    arrays, unused = arrays_of(path, (*numbered, *counts, *texts))
    for key in kind.PER_PLAN:
        if f"{key}_names" in texts and f"{key}_names" not in arrays and _holds_texts(arrays.get(key)):
            names_of_plans = np.char.strip(arrays[key])
            if (names_of_plans == "").any():
                raise ValueError(f"{path}: {key}: an empty text; a name for every plan is expected")
            arrays[f"{key}_names"], arrays[key] = np.unique(names_of_plans, return_inverse=True)
    for key in numbered:
        if key in arrays and arrays[key].dtype.kind not in "biuf":
            what = "numbers, or of texts without names," if f"{key}_names" in texts else "numbers"
            raise ValueError(f"{path}: {key}: an array of {what} is expected, not of {arrays[key].dtype}")
    if "actions" not in arrays:
        raise ValueError(f"{path}: no array 'actions'; it has {', '.join(sorted([*arrays, *unused])) or 'none'}")
    if arrays["actions"].ndim == 3:
        raise ValueError(
            f"{path}: actions {list(arrays['actions'].shape)} are vectors: in Python"
            " neuroprior.control.read_vector_plans reads them; programs take numbered actions"
        )
    numbers: dict[str, Any] = {key: torch.from_numpy(native(arrays[key])) for key in numbered if key in arrays}
    names: dict[str, Any] = {key: names_of(path, key, arrays[key]) for key in texts if key in arrays}
    whole: dict[str, Any] = {key: _whole(path, key, arrays[key]) for key in counts if key in arrays}
    count = num_actions or whole.get("num_actions")
    if count is None and "action_names" in names:
        count = len(names["action_names"])
    try:
        if count is None:
            count = count_up_to(_largest(numbers)) if action_names is None else len(action_names)
        plans = kind(**whole | {"num_actions": count}, **numbers, **names)
        if plans.context is not None and plans.context.is_floating_point():
            check_single_precision("context", plans.context[plans.mask()])
        plans = renamed(plans, action_names, str(path))
    except (ValueError, TypeError, RuntimeError) as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise ValueError(f"{path}: {reason.splitlines()[0]}") from error
    warn_of_unused(path, "arrays", unused)
    return plans


def write_npz(plans: Plans, path: Path) -> None:
    """Write a `.npz` file, not compressed, with all fields of the class of the plans."""
    once = constant_context(plans)  # a context that never changes is written once a plan
    values = vars(plans) | {"context": plans.context if once is None else once}
    arrays = {}
    for key, value in values.items():
        if isinstance(value, torch.Tensor):
            arrays[key] = as_array(value)
        elif isinstance(value, int):
            arrays[key] = np.array(value)
        elif value:
            arrays[key] = np.array(value, str)
    with written_whole(path, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _fields(kind: type[Plans]) -> tuple[list[str], list[str], list[str]]:
    """The names of the fields that are tensors, integers and texts."""
    names_by_type: dict[Any, list[str]] = {torch.Tensor: [], int: [], str: []}
    for field in fields(kind):
        holds = (field.type, *get_args(field.type))
        names_by_type[next((one for one in (torch.Tensor, int) if one in holds), str)].append(field.name)
    return names_by_type[torch.Tensor], names_by_type[int], names_by_type[str]


def _holds_texts(array: NDArray[Any] | None) -> bool:
    return array is not None and array.dtype.kind == "U"


def arrays_of(path: Path, keys: Sequence[str]) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Those arrays of a `.npz` file that have one of these names, and the names of the others."""
    check_file(path)
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: not a .npz file (a zip archive of arrays), or cut off; np.savez writes one")
    key = None
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {}
            for key in [key for key in file.files if key in keys]:
                _check_growth(next(one for one in file.zip.infolist() if one.filename in (key, f"{key}.npy")))
                arrays[key] = np.asarray(file[key])
            return arrays, [key for key in file.files if key not in keys]
    except Exception as error:  # numpy, zipfile and zlib raise a dozen unrelated kinds over damaged bytes
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        if "allow_pickle" in reason:
            reason = "an array of Python objects; numbers, or texts of a fixed size, are expected"
        raise ValueError(f"{path}: {key or 'the archive'}: {reason}") from error


def _check_growth(array: zipfile.ZipInfo) -> None:
    """Raise ValueError for an array that takes far more memory than its part of the file: zip says both before."""
    if grows_too_much(array.file_size, array.compress_size):
        raise ValueError(
            f"{array.compress_size:,} bytes of the file would unpack to {array.file_size:,}; if they are meant, write"
            " them with np.savez, not compressed"
        )
    check_memory(array.file_size, array=array.filename)


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


def _whole(path: Path, key: str, array: NDArray[Any]) -> int:
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
