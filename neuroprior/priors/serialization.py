"""Model folders: a prior saved as `model.safetensors` and `config.json`, and read back; never pickle.

The first file is the whole model: its metadata hold the configuration, and it is replaced at once, so that whoever
reads beside a writer has the old model or the new one. The second is a copy of the configuration, for people.
"""

import hashlib
import json
import operator
import os
from collections.abc import Callable, Iterator, Mapping
from math import inf, isfinite
from pathlib import Path
from typing import Any, TypeVar, overload

import torch
from safetensors import SafetensorError
from safetensors.torch import load as read_tensors
from safetensors.torch import save as write_tensors
from torch import Tensor

from neuroprior._checks import memory_within
from neuroprior._files import read_json, write_whole
from neuroprior._folders import as_folder, claim
from neuroprior.priors.prior import Prior
from neuroprior.priors.saved import SavedModule

MODEL, CONFIG = "model.safetensors", "config.json"

KEY, FORMAT, VERSION = "neuroprior", "neuroprior model", 2

ENTRIES = {"format": str, "version": int, "prior": str, "config": dict, "learned": dict, "weights": str}
"""What a configuration holds, beside `sha256`, the checksum of all this; `weights` is the checksum of the tensors."""

MAX_DEPTH, MAX_PRIORS, MAX_INTEGER = 100, 1000, 2**63 - 1
"""Of a configuration: how deep it is nested, how many priors it describes, and the size of its integers."""

SPARE, TIMES = 2**24, 16
"""A prior may take so many bytes, and so many times the size of its tensors: phases take more than tables."""

SECONDS = 30.0
"""For which a writer waits for others that write to the same folder."""

T = TypeVar("T", bound=SavedModule)
Read = TypeVar("Read")


def save(prior: SavedModule, folder: str | os.PathLike[str]) -> Path:
    """Save a prior to a folder, made if need be.

    Its files are `model.safetensors` (weights or counts, and the configuration in its metadata) and `config.json`, a
    copy of the configuration. Both are written under temporary names and renamed when they are whole. `load` may run at
    the same time: it reads the old model or the new one.

    Args:
        prior: any prior, of actions or of vectors, whose `config` gives its constructor's arguments; or a
            `DurationModel`.
        folder: where.

    Returns:
        The folder.

    Raises:
        OSError: the folder cannot be written.
        ValueError: it is no prior, `load` could not make it again (its weights are infinite, say), the folder has no
            name, or a run of `neuroprior fit` uses it.

    Example:
        >>> sorted(path.name for path in save(MarkovPrior(3, order=2), "runs/markov").iterdir())
        ['config.json', 'model.safetensors']
    """
    if not isinstance(prior, SavedModule):
        raise ValueError(f"`prior` must be a Prior, got {type(prior).__name__}")
    return write_model(model_bytes(prior), folder)


def model_bytes(prior: SavedModule) -> bytes:
    """The file `model.safetensors` of a prior; see `save`."""
    tensors = {name: value.detach().cpu().contiguous().clone() for name, value in prior.state_dict().items()}
    described = {"prior": type(prior).__name__, "config": prior.config, "learned": prior.learned}
    content = {"format": FORMAT, "version": VERSION, **described, "weights": _checksum_of(tensors)}
    try:
        content = json.loads(json.dumps(content, default=operator.index))
        content["sha256"] = _checksum(content)
        _make(_verify(content), tensors)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"`prior` must be one that can be loaded again, got {type(prior).__name__}: {error}"
        ) from error
    return write_tensors(tensors, {KEY: json.dumps(content)})


def write_model(data: bytes, folder: str | os.PathLike[str]) -> Path:
    """Write what `model_bytes` returned to a folder."""
    folder = as_folder("folder", folder)
    with claim(folder, name="folder", seconds=SECONDS):
        if (folder / CONFIG).exists() and not (folder / MODEL).exists():
            raise ValueError(f"`folder` must be one without the {CONFIG} of something else, got {folder}.")
        write_whole(folder / MODEL, data)
        write_whole(folder / CONFIG, (json.dumps(_content_of(data), indent=2) + "\n").encode())
    return folder


def digest(model: bytes) -> str:
    """The checksum of a file `model.safetensors`, in which everything is of a model."""
    return hashlib.sha256(model).hexdigest()


@overload
def load(folder: str | os.PathLike[str], device: torch.device | str = "cpu") -> Prior: ...
@overload
def load(folder: str | os.PathLike[str], device: torch.device | str = "cpu", *, kind: Callable[..., T]) -> T: ...
def load(folder: str | os.PathLike[str], device: torch.device | str = "cpu", *, kind: Any = Prior) -> SavedModule:
    """What `save` wrote to a folder.

    Args:
        folder: where.
        device: where the prior computes then.
        kind: the class that is expected, such as `VectorPrior` or `DurationModel`; a subclass of it will do.

    Raises:
        FileNotFoundError: the folder or its `model.safetensors` is not there.
        ValueError: a file is damaged, changed or not of this kind, the prior's class is not known (import it first), it
            is of another kind, or there is no such device.

    Example:
        >>> folder = save(MarkovPrior(3, order=2), "runs/markov")
        >>> load(folder).order
        2
    """
    folder = as_folder("folder", folder)
    if not isinstance(kind, type):
        raise ValueError(f"`kind` must be a class such as Prior, got {kind!r}")
    data = (folder / MODEL).read_bytes()
    content, tensors = _in_file(folder / MODEL, lambda: _read(data))
    if (folder / CONFIG).exists():  # not yet there, or that of the model before, while or where a save was cut off
        _in_file(folder / CONFIG, lambda: _verify(read_json(folder / CONFIG)))
    if not issubclass(_class_of(content), kind):
        name = content["prior"]
        raise ValueError(f"{folder} must hold a {kind.__name__}, got {name}; load(folder, kind={name}) reads it")
    prior = _in_file(folder / MODEL, lambda: _make(content, tensors))
    try:
        return prior.to(device).eval()
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device: {str(device)!r} cannot be used here ({str(error).splitlines()[0][:200]})") from error


def _in_file(path: Path, read: Callable[[], Read]) -> Read:
    """What `read` returns; an error names the file."""
    try:
        return read()
    except ValueError as error:
        reason = " ".join(str(error).split())[:300].removeprefix(f"{path}: ")
        raise ValueError(f"{path}: {reason}") from error


def _read(data: bytes) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The configuration and the tensors in a file, both as they were saved."""
    try:
        tensors = read_tensors(data)
        content = _content_of(data)
    except (SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"truncated, changed or not the file of a saved prior ({error})") from error
    if _verify(content)["weights"] != _checksum_of(tensors):
        raise ValueError("its tensors were changed since it was saved")
    return content, tensors


def _content_of(data: bytes) -> Any:
    """The configuration in the metadata of a file of safetensors, which begins with the size of its header."""
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    return json.loads(header["__metadata__"][KEY])


def _checksum_of(tensors: Mapping[str, Tensor]) -> str:
    checksum = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        checksum.update(f"{name} {value.dtype} {list(value.shape)}\n".encode())
        checksum.update(value.numpy().tobytes())
    return checksum.hexdigest()


def _checksum(content: Mapping[str, Any]) -> str:
    """The checksum of the entries of a configuration, whatever their order."""
    entries = {name: content[name] for name in ENTRIES}
    return hashlib.sha256(json.dumps(entries, sort_keys=True).encode()).hexdigest()


def _verify(content: Any) -> dict[str, Any]:
    """The configuration of a saved prior, if it is one, and as it was saved; else ValueError."""
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f'not the configuration of a saved prior ("format": "{FORMAT}" is missing)')
    if content.get("version") != VERSION:
        raise ValueError(f"version {content.get('version')} of the format; this library reads {VERSION}")
    for name, kind in ENTRIES.items():
        if not isinstance(content.get(name), kind):
            raise ValueError(f"{name!r} is missing, or not of type {kind.__name__}")
    priors = sum(isinstance(value, dict) and "prior" in value for value in _values(content))
    if priors > MAX_PRIORS:
        raise ValueError(f"it must describe at most {MAX_PRIORS} priors, got {priors}")
    if content.get("sha256") != _checksum(content):
        raise ValueError("changed since it was saved: its checksum is another")
    if SavedModule.known.find(content["prior"]) is None:
        raise ValueError(f"the prior {content['prior']!r} is not known; import the module that defines it first")
    return content


def _values(value: Any, depth: int = 0) -> Iterator[Any]:
    """A JSON value and all values in it; ValueError where one is not such as a prior could have."""
    if depth > MAX_DEPTH:
        raise ValueError(f"its values must be nested at most {MAX_DEPTH} deep")
    if isinstance(value, int) and abs(value) > MAX_INTEGER:
        raise ValueError(f"its integers must be at most {MAX_INTEGER}, got one of {value.bit_length()} bits")
    if isinstance(value, float) and not isfinite(value):
        raise ValueError(f"its numbers must be finite, got {value}")
    yield value
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    for one in inner:
        yield from _values(one, depth + 1)


def _class_of(content: Mapping[str, Any]) -> type[SavedModule]:
    """The class that a configuration names, which `_verify` has found to be known."""
    kind = SavedModule.known.find(content["prior"])
    assert kind is not None
    return kind


def _make(content: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> SavedModule:
    """The prior that a configuration describes, with these tensors; ValueError unless they are those of such a one."""
    name = content["prior"]
    try:
        with memory_within(SPARE + TIMES * sum(value.nbytes for value in tensors.values())):
            prior = _class_of(content)(**content["config"])
            prior.restore(content["learned"])
        same = {"config": prior.config, "learned": prior.learned}
        same = json.loads(json.dumps(same, default=operator.index))
    except Exception as error:  # whatever a constructor, also of a class of the user's, raises over its arguments
        raise ValueError(f"no configuration of a {name} ({error})") from error
    for entry, value in same.items():
        if value != content[entry]:
            raise ValueError(f"{entry!r} is not what a {name} of this configuration has")
    state, tables, logs = prior.state_dict(), _names(prior, "tables"), _names(prior, "log_tables")
    if unknown := sorted(state.keys() ^ tensors.keys()):
        raise ValueError(
            f"the tensor {unknown[0]!r} is {'missing' if unknown[0] in state else 'not that of a ' + name}"
        )
    for key, value in tensors.items():
        expected = state[key]
        fits = value.dim() == expected.dim() if key in tables else value.shape == expected.shape
        if value.dtype != expected.dtype or not fits:
            raise ValueError(
                f"{key} must be {list(expected.shape)} of {expected.dtype}, got {list(value.shape)} of {value.dtype}"
            )
        if not _is_sound(value, key in logs):
            raise ValueError(f"{key} has numbers that are NaN or infinite")
    try:
        prior.load_state_dict(tensors)
    except RuntimeError as error:
        raise ValueError(str(error)) from error
    return prior


def _is_sound(value: Tensor, logs: bool) -> bool:
    """Whether a tensor is finite, but for logarithms of probabilities that are 0, of which not all in a row are."""
    if not value.is_floating_point() or bool(value.isfinite().all()):
        return True
    return logs and not bool((value.isnan() | (value == inf)).any() | (value == -inf).all(-1).any())


def _names(prior: SavedModule, attribute: str) -> set[str]:
    """The names, in the state of a prior, of what it and the priors in it have in an attribute."""
    return {
        f"{prefix}.{name}".lstrip(".")
        for prefix, module in prior.named_modules()
        if isinstance(module, SavedModule)
        for name in getattr(module, attribute)
    }
