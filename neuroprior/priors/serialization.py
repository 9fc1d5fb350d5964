"""Model folders: a prior saved as `model.safetensors` and `config.json`, and read back; never pickle."""

import hashlib
import json
import operator
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, overload

import torch
from safetensors import SafetensorError
from safetensors.torch import load as read_tensors
from safetensors.torch import save as write_tensors

from neuroprior._files import read_json
from neuroprior.priors.prior import Prior
from neuroprior.priors.saved import SavedModule

FILES = ("model.safetensors", "config.json")

FORMAT = "neuroprior model"
VERSION = 1

SPARE = 2**26
"""Numbers that a prior may hold beyond those of its file before these are read."""


T = TypeVar("T", bound=SavedModule)


def save(prior: SavedModule, folder: str | os.PathLike[str]) -> Path:
    """Save a prior to a folder, made if need be.

    Its files are `model.safetensors` (weights or counts) and `config.json`. Both are written under temporary names and
    renamed when they are whole.

    Args:
        prior: any prior, of actions or of vectors, whose `config` gives its constructor's arguments; or a
            `DurationModel`.
        folder: where.

    Returns:
        The folder.

    Raises:
        OSError: the folder cannot be written.
        ValueError: it is no prior, or the folder has no name.

    Example:
        >>> sorted(path.name for path in save(MarkovPrior(3, order=2), "runs/markov").iterdir())
        ['config.json', 'model.safetensors']
    """
    if not isinstance(prior, SavedModule):
        raise ValueError(f"`prior` must be a Prior, got {type(prior).__name__}")
    folder = _folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    data = written_state(prior)
    config = {
        "format": FORMAT,
        "version": VERSION,
        "prior": type(prior).__name__,
        "config": prior.config,
        "learned": prior.learned,
        "sha256": hashlib.sha256(data).hexdigest(),
    }
    text = json.dumps(config, indent=2, default=operator.index) + "\n"
    contents = {"model.safetensors": data, "config.json": text.encode()}
    for name, content in contents.items():
        (folder / f".{name}.partial").write_bytes(content)
    for name in contents:
        os.replace(folder / f".{name}.partial", folder / name)
    return folder


def written_state(prior: SavedModule) -> bytes:
    """The tensors of its state, as a file of safetensors holds them."""
    return write_tensors({name: value.detach().cpu().clone() for name, value in prior.state_dict().items()})


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
        FileNotFoundError: the folder or one of its two files is not there.
        ValueError: a file is damaged or not of this kind, the prior's class is not known (import it first), it is of
            another kind, or there is no such device.

    Example:
        >>> folder = save(MarkovPrior(3, order=2), "runs/markov")
        >>> load(folder).order
        2
    """
    folder = _folder(folder)
    config = _read_config(folder / "config.json")
    if not isinstance(kind, type):
        raise ValueError(f"`kind` must be a class such as Prior, got {kind!r}")
    if not issubclass(_class_of(config), kind):
        name = config["prior"]
        raise ValueError(f"{folder} must hold a {kind.__name__}, got {name}; load(folder, kind={name}) reads it")
    data = (folder / "model.safetensors").read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    unfinished = folder / ".config.json.partial"
    if digest != config["sha256"] and unfinished.exists():
        # A save was cut off between its two renames: the new weights are in place, their configuration is not yet.
        config = _read_config(unfinished)
    if digest != config["sha256"]:
        raise ValueError(f"{folder / 'model.safetensors'}: truncated, changed or of another model than config.json")
    misfit = f"{folder / 'model.safetensors'}: does not fit the prior that config.json describes"
    try:
        tensors = read_tensors(data)
    except SafetensorError as error:
        raise ValueError(misfit) from error
    # Tables of counts take their sizes from the file, so that less may be wanted than there is.
    most = SPARE + sum(value.numel() for value in tensors.values())
    try:
        prior = _made(config) if _size(config) <= most else None
    except (RuntimeError, TypeError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{folder / 'config.json'}: no configuration of a {config['prior']} ({reason})") from error
    if prior is None:
        raise ValueError(misfit)
    try:
        prior.load_state_dict(tensors)
    except RuntimeError as error:
        raise ValueError(misfit) from error
    if broken := [name for name, value in tensors.items() if value.is_floating_point() and bool(value.isnan().any())]:
        raise ValueError(f"{folder / 'model.safetensors'}: {broken[0]} has numbers that are NaN")
    try:
        return prior.to(device).eval()
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device: {str(device)!r} cannot be used here ({str(error).splitlines()[0][:200]})") from error


def _class_of(config: dict[str, Any]) -> type[SavedModule]:
    """The class that a configuration names, which `_read_config` has found to be known."""
    kind = SavedModule.known.find(config["prior"])
    assert kind is not None
    return kind


def _made(config: dict[str, Any]) -> SavedModule:
    """The prior that a configuration describes, before its tensors are loaded."""
    prior = _class_of(config)(**config["config"])
    prior.restore(config["learned"])
    return prior


def _size(config: dict[str, Any]) -> int:
    """How many numbers a prior holds, without the memory for them: a damaged configuration may ask for any size."""
    try:
        with torch.device("meta"):
            return sum(value.numel() for value in _made(config).state_dict().values())
    except RuntimeError:
        # It computes with its numbers, which are not there; it holds one at least for each action.
        actions = config["config"].get("num_actions")
        return actions if isinstance(actions, int) else 0


def _folder(folder: object) -> Path:
    """The path of a folder; ValueError for an empty name, which would be that of the present folder."""
    if not isinstance(folder, str | os.PathLike) or not os.fspath(folder).strip():
        got = repr(folder) if isinstance(folder, str) else type(folder).__name__
        raise ValueError(f"`folder` must be the name of a folder, got {got}")
    return Path(folder)


def _read_config(path: Path) -> dict[str, Any]:
    config = read_json(path)
    if not isinstance(config, dict) or config.get("format") != FORMAT:
        raise ValueError(f'{path}: not the configuration of a saved prior ("format": "{FORMAT}" is missing)')
    if config.get("version") != VERSION:
        raise ValueError(f"{path}: version {config.get('version')} of the format; this library reads {VERSION}")
    missing = [key for key in ("prior", "config", "learned", "sha256") if key not in config]
    if missing:
        raise ValueError(f"{path}: {missing[0]!r} is missing")
    if not isinstance(config["prior"], str) or SavedModule.known.find(config["prior"]) is None:
        raise ValueError(f"{path}: the prior {config['prior']!r} is not known; import the module that defines it first")
    for key in ("config", "learned"):
        if not isinstance(config[key], dict):
            raise ValueError(f"{path}: {key!r} must be an object")
    return config
