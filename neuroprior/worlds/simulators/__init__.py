"""Simulators of any kind as worlds: copied, stepped, tried out."""

from neuroprior.worlds.simulators.building import from_simulator
from neuroprior.worlds.simulators.world import SimulatorWorld

__all__ = ["SimulatorWorld", "from_simulator"]
