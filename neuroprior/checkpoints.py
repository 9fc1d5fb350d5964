"""Checkpoints of agents: folders from which an interrupted life goes on as if it had not been interrupted."""

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as read_tensors
from safetensors.torch import save as write_tensors
from torch import Tensor

from neuroprior.agent import Agent
from neuroprior.output import write_whole
from neuroprior.planners import Decision, Execution
from neuroprior.plans import Plans
from neuroprior.priors import folders

FORMAT, VERSION = "neuroprior agent", 1

PARTS = ("actions", "rewards", "states")
"""Of what was done since a plan was remembered last."""


def save_agent(agent: Agent, folder: str | os.PathLike[str]) -> Path:
    """Save an agent to a folder, made if need be: where it is, what it remembers, its prior and its random numbers.

    `agent.json` names the files that belong to it and is written last, so that the folder holds the last whole
    checkpoint at all times; files of earlier ones are then removed. World and planner are not saved.

    Raises:
        OSError: the folder cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    prior, weights = f"prior-{agent.time}", f"agent-{agent.time}.safetensors"
    folders.save(agent.prior, folder / prior)
    data = write_tensors({name: value.detach().cpu().contiguous().clone() for name, value in _tensors(agent).items()})
    write_whole(folder / weights, data)
    told = {"format": FORMAT, "version": VERSION, "time": agent.time, "agent": _settings(agent), "prior": prior}
    told |= {"weights": weights, "sha256": hashlib.sha256(data).hexdigest()}
    told |= {"recent": [done.model_steps for done in agent.recent]}
    write_whole(folder / "agent.json", (json.dumps(told, indent=2) + "\n").encode())
    for path in folder.glob("agent-*.safetensors"):
        if path.name != weights:
            path.unlink()
    for path in folder.glob("prior-*"):
        if path.name != prior:
            shutil.rmtree(path)
    return folder


def restore_agent(agent: Agent, folder: str | os.PathLike[str]) -> Agent:
    """Let an agent go on where another one, made in the same way, was saved; returns it.

    Args:
        agent: made anew with the same world, planner, kind of prior and arguments; its prior takes over what was
            learned, in place.
        folder: where `save_agent` saved.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: a file is damaged, or the agent was made in another way.
    """
    folder = Path(folder)
    told = _read(folder / "agent.json")
    if told["agent"] != _settings(agent):
        other = [name for name, value in _settings(agent).items() if told["agent"].get(name) != value]
        raise ValueError(f"{folder}: of an agent with other {', '.join(other)}; make this one in the same way")
    path = folder / told["weights"]
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != told["sha256"]:
        raise ValueError(f"{path}: truncated, changed, or of another checkpoint than agent.json")
    try:
        tensors = read_tensors(data)
    except SafetensorError as error:
        raise ValueError(f"{path}: not a file of tensors ({error})") from error
    prior = folders.load(folder / told["prior"], agent.prior.device)
    agent.prior.restore(prior.learned)
    agent.prior.load_state_dict(prior.state_dict())
    agent.time = told["time"]
    _take(agent, tensors, told["recent"])
    return agent


def _settings(agent: Agent) -> dict[str, Any]:
    """What decides how an agent lives, beside its world and planner; as JSON gives it back."""
    told = {name: getattr(agent, name) for name in ("every", "warm_start", "num_rollouts", "learn_every")}
    told |= {name: getattr(agent, name) for name in ("plan_length", "above", "training")}
    told |= {"keep": agent.replay.keep, "agents": list(agent.state.shape), "planner": type(agent.planner).__name__}
    told |= {"prior": type(agent.prior).__name__, "config": agent.prior.config}
    settings = json.loads(json.dumps(told))
    assert isinstance(settings, dict)
    return settings


def _tensors(agent: Agent) -> dict[str, Tensor]:
    """All that is not the prior's."""
    found = {"state": agent.state, "before": agent.before, "generator": agent.generator.get_state()}
    if agent.last is not None:
        found |= {"last.plan": agent.last.plan}
        found |= {} if agent.last.lengths is None else {"last.lengths": agent.last.lengths}
    for k, done in enumerate(agent.recent):
        found |= {f"recent.{k}.{name}": getattr(done, name) for name in PARTS}
    return found | {f"replay.{name}": value for name, value in agent.replay.tensors().items()}


def _take(agent: Agent, tensors: dict[str, Tensor], steps: Sequence[int]) -> None:
    """Take over what `_tensors` gave."""
    on = {name: value.to(agent.state.device) for name, value in tensors.items() if name != "generator"}
    agent.generator.set_state(tensors["generator"])
    agent.state, agent.before = on["state"], on["before"]
    agent.last = None
    if "last.plan" in on:
        # Of what is left of a plan only its actions are looked at.
        nothing = torch.empty(0, device=agent.state.device)
        agent.last = Decision(on["last.plan"], nothing, nothing, 0, on.get("last.lengths"))
    agent.recent = []
    for k, number in enumerate(steps):
        done, rewards, states = (on[f"recent.{k}.{name}"] for name in PARTS)
        agent.recent.append(Execution(done, rewards, states, number))
    if "replay.actions" in on:
        actions, lengths, context = (on.get(f"replay.{name}") for name in ("actions", "lengths", "context"))
        assert actions is not None
        world = agent.world
        agent.replay.plans = Plans(actions, world.num_actions, lengths, world.action_names, context)


def _read(path: Path) -> dict[str, Any]:
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not JSON ({error})") from error
    if not isinstance(told, dict) or told.get("format") != FORMAT or told.get("version") != VERSION:
        raise ValueError(f'{path}: not a checkpoint of an agent ("format": "{FORMAT}", "version": {VERSION})')
    if missing := [key for key in ("time", "agent", "prior", "weights", "sha256", "recent") if key not in told]:
        raise ValueError(f"{path}: {missing[0]!r} is missing")
    return told
