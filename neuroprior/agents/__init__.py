"""Agents: online learning from what is planned and executed, with replay and checkpoints."""

from neuroprior.agents.agent import Agent
from neuroprior.agents.checkpoints import restore_agent, save_agent
from neuroprior.agents.replay import Replay

__all__ = ["Agent", "Replay", "restore_agent", "save_agent"]
