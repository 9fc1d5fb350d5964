"""Checkpoints of agents: folders from which an interrupted run continues as if it had not been interrupted."""

import hashlib
import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as read_tensors
from safetensors.torch import save as write_tensors
from torch import Tensor

from neuroprior._files import read_json, write_whole
from neuroprior._folders import claim
from neuroprior.agents.agent import Agent, Steps
from neuroprior.planners import Decision
from neuroprior.plans import Plans
from neuroprior.priors import Prior, serialization

FORMAT, VERSION = "neuroprior agent", 2


def save_agent(agent: Agent, folder: str | os.PathLike[str]) -> Path:
    """Save an agent to a folder, made if need be: its state, replay, prior and random generator.

    Files are named by a hash of their content, and `agent.json`, which lists them, is written last: the folder holds
    the last complete checkpoint at all times. The files of checkpoints before are then removed, and nothing else.
    World and planner are not saved.

    Args:
        agent: whose generator is its own.
        folder: where.

    Returns:
        The folder.

    Raises:
        OSError: the folder cannot be written.
        ValueError: the folder's `agent.json` is not of an agent.

    Example:
        >>> world, prior = gridworld(5, 5, seed=0), MarkovPrior(4, 1)
        >>> start = world.reset(8, torch.Generator().manual_seed(0))
        >>> agent = Agent(world, SamplingPlanner(prior, length=4, num_plans=16), prior, start)
        >>> folder = save_agent(agent, "runs/agent")
    """
    folder = Path(folder)
    of_prior = serialization.model_bytes(agent.prior)
    data = write_tensors({name: value.detach().cpu().contiguous().clone() for name, value in _tensors(agent).items()})
    digests = [hashlib.sha256(content).hexdigest() for content in (of_prior, data)]
    prior, weights = f"prior-{digests[0][:16]}", f"agent-{digests[1][:16]}.safetensors"
    document = {"format": FORMAT, "version": VERSION, "time": agent.time, "agent": _settings(agent)}
    document |= {"prior": prior, "prior_sha256": digests[0], "weights": weights, "sha256": digests[1]}
    document |= {"recent": len(agent.recent)}
    with claim(folder, name="folder", seconds=serialization.SECONDS):
        if (folder / "agent.json").exists():
            _read(folder / "agent.json")
        serialization.write_model(of_prior, folder / prior)
        write_whole(folder / weights, data)
        write_whole(folder / "agent.json", (json.dumps(document, indent=2) + "\n").encode())
        for path in folder.iterdir():  # also what a process that was killed left there
            if re.fullmatch(r"agent-[0-9a-f]{16}\.safetensors", path.name) and path.name != weights:
                path.unlink()
            elif re.fullmatch(r"prior-[0-9a-f]{16}", path.name) and path.name != prior:
                shutil.rmtree(path, ignore_errors=True)
    return folder


def restore_agent(agent: Agent, folder: str | os.PathLike[str]) -> Agent:
    """Let an agent continue where another one with the same arguments was saved; returns it.

    Args:
        agent: a new one with the same world, planner, kind of prior and arguments; its prior is restored in place.
            World and planner are not saved, so that only the planner's class and the shape of the states are checked.
        folder: where `save_agent` saved.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: a file is damaged, or the agent has other arguments. The agent is then unchanged.

    Example:
        >>> world, prior = gridworld(5, 5, seed=0), MarkovPrior(4, 1)
        >>> start = world.reset(8, torch.Generator().manual_seed(0))
        >>> agent = Agent(world, SamplingPlanner(prior, length=4, num_plans=16), prior, start)
        >>> folder = save_agent(agent, "runs/agent")
        >>> again = restore_agent(agent, folder)
    """
    folder = Path(folder)
    document, data, prior = _read_files(folder, agent.prior.device)
    settings, saved = _settings(agent), document["agent"]
    saved = saved | {"training": saved.get("training") or {}}  # was None for some priors
    saved = saved | {"config": _as_described_now(saved["config"], settings["config"])}
    if saved != settings:
        other = [name for name, value in settings.items() if saved.get(name) != value]
        raise ValueError(f"{folder}: of an agent with other {', '.join(other)}; give this one the same")
    path = folder / document["weights"]
    try:
        tensors = read_tensors(data)
    except SafetensorError as error:
        raise ValueError(f"{path}: not a file of tensors ({error})") from error
    if sum(name.startswith("recent.") for name in tensors) != len(Steps._fields) * document["recent"]:
        raise ValueError(f"{folder / 'agent.json'}: 'recent' does not fit {path.name}")
    agent.world.check_state(tensors["state"].to(agent.state.device))
    agent.prior.restore(prior.learned)
    agent.prior.load_state_dict(prior.state_dict())
    agent.time = document["time"]
    _take(agent, tensors, document["recent"])
    return agent


def _read_files(folder: Path, device: torch.device) -> tuple[dict[str, Any], bytes, Prior]:
    """What `agent.json` holds, the file of the agent's tensors, and its prior; of one checkpoint.

    A checkpoint that is saved meanwhile takes the files of the one before away; then it is read.
    """
    document = _read(folder / "agent.json")
    try:
        data, prior = (folder / document["weights"]).read_bytes(), folder / document["prior"]
        digests = [hashlib.sha256(one).hexdigest() for one in (data, (prior / serialization.MODEL).read_bytes())]
        if digests != [document["sha256"], document["prior_sha256"]]:
            raise ValueError(
                f"{folder}: {document['weights']} or {prior.name} is truncated, changed, or of another checkpoint"
            )
        return document, data, serialization.load(prior, device)
    except FileNotFoundError:
        if _read(folder / "agent.json") == document:
            raise
        return _read_files(folder, device)


def _as_described_now(saved: Any, current: Any) -> Any:
    """The config of a prior that had not learned, as `current` has it: networks had sizes, which `fit` would change."""
    if isinstance(saved, list) and isinstance(current, list) and len(saved) == len(current):
        return [_as_described_now(*both) for both in zip(saved, current, strict=True)]
    if not isinstance(saved, dict) or not isinstance(current, dict):
        return saved
    chosen = {name: value for name, value in current.items() if name == "seed" or value is None}
    same = {
        name: _as_described_now(value, current[name]) if name in current else value for name, value in saved.items()
    }
    return same | chosen if "seed" in current and "seed" not in saved else same


def _settings(agent: Agent) -> dict[str, Any]:
    """What determines an agent's run, besides world and planner; as read back from JSON."""
    names = ("replan_every", "warm_start", "num_rollouts", "learn_every", "plan_length", "min_score", "training")
    values = {name: getattr(agent, name) for name in names} | {"retention": agent.replay.retention}
    values |= {"agents": list(agent.state.shape), "planner": type(agent.planner).__name__}
    values |= {"prior": type(agent.prior).__name__, "config": agent.made}
    settings = json.loads(json.dumps(values, default=str))
    assert isinstance(settings, dict)
    return settings


def _tensors(agent: Agent) -> dict[str, Tensor]:
    """All tensors except the prior's."""
    tensors = {"state": agent.state, "generator": agent.generator.get_state()}
    if agent.last is not None:
        tensors |= {"last.plan": agent.last.plan}
        tensors |= {} if agent.last.lengths is None else {"last.lengths": agent.last.lengths}
    for k, steps in enumerate(agent.recent):
        tensors |= {f"recent.{k}.{name}": values for name, values in steps._asdict().items()}
    return tensors | {f"replay.{name}": value for name, value in agent.replay.tensors().items()}


def _take(agent: Agent, tensors: dict[str, Tensor], num_recent: int) -> None:
    """Restore what `_tensors` gave."""
    on = {name: value.to(agent.state.device) for name, value in tensors.items() if name != "generator"}
    agent.generator.set_state(tensors["generator"])
    agent.state = on["state"]
    agent.last = None
    if "last.plan" in on:
        # Only the actions of the rest of a plan are used.
        nothing = torch.empty(0, device=agent.state.device)
        agent.last = Decision(on["last.plan"], nothing, nothing, 0, on.get("last.lengths"))
    agent.recent = [Steps(*(on[f"recent.{k}.{name}"] for name in Steps._fields)) for k in range(num_recent)]
    if "replay.actions" in on:
        actions, lengths, context = (on.get(f"replay.{name}") for name in ("actions", "lengths", "context"))
        assert actions is not None
        world = agent.world
        agent.replay.plans = Plans(actions, world.num_actions, lengths, world.action_names, context)


def _read(path: Path) -> dict[str, Any]:
    document = read_json(path)
    if not isinstance(document, dict) or document.get("format") != FORMAT or document.get("version") != VERSION:
        raise ValueError(f'{path}: not a checkpoint of an agent ("format": "{FORMAT}", "version": {VERSION})')
    kinds = {
        "time": int,
        "agent": dict,
        "prior": str,
        "prior_sha256": str,
        "weights": str,
        "sha256": str,
        "recent": int,
    }
    for key, kind in kinds.items():
        if not isinstance(document.get(key), kind):
            raise ValueError(f"{path}: {key!r} is missing or of a wrong type")
    if document["time"] < 0:
        raise ValueError(f"{path}: 'time' must be at least 0, got {document['time']}")
    return document
