"""Simulators of any kind as worlds: copied, stepped, tried out."""

from neuroprior.worlds.simulators.world import SimulatorWorld, from_simulator

__all__ = ["SimulatorWorld", "from_simulator"]
