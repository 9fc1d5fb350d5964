"""Gymnasium environments as worlds: read or enumerated into tables, or stepped (needs the extra `gym`)."""

from neuroprior.worlds.gymnasium.worlds import from_gymnasium

__all__ = ["from_gymnasium"]
