"""What the page of `python -m eval compare` draws of a cell: plans in the world, and what follows what in a prior."""

from typing import Any

import torch

from eval.compare.curves import Starts
from neuroprior import Prior, World
from neuroprior.sampling import sample_in_world
from neuroprior.worlds import GridWorld

SAMPLED, DRAWN = 2000, 12
"""Plans that transitions are counted in, and plans that are drawn."""

SHOWN = ("uniform", "markov-2", "gru")
"""Priors whose plans are drawn."""


def transitions(prior: Prior, world: World, generator: torch.Generator) -> list[list[float]]:
    """`A x A`: how often each action follows each in plans that are sampled from a prior."""
    state = world.reset(SAMPLED, generator)
    plans = sample_in_world(prior, world, state, 1, 16, generator=generator)[0][:, 0].long()
    pair = plans[:, :-1] * world.num_actions + plans[:, 1:]
    counts = pair.flatten().bincount(minlength=world.num_actions**2).view(world.num_actions, -1).double()
    shares: list[list[float]] = (counts / counts.sum(1, keepdim=True).clamp(min=1)).tolist()
    return shares


def drawn_plans(priors: dict[str, Prior], starts: Starts, generator: torch.Generator) -> dict[str, Any] | None:
    """The walls and rewards of a held-out grid, and plans of some priors from one start; None for other worlds."""
    world = starts.world
    if not isinstance(world, GridWorld) or world.edges == "torus":
        return None
    start = starts.state[:1]
    layout, squares = int(world.layout(start)), world.height * world.width
    rewards = world.reward[int(world.reward_map(start)), :: 4 if world.egocentric else 1]
    found: dict[str, Any] = {"height": world.height, "width": world.width, "walls": world.walls[layout].tolist()}
    found["reward"] = rewards[layout * squares : (layout + 1) * squares].view(world.height, world.width).tolist()
    found["start"] = world.coordinates(start)[0].tolist()
    found["paths"] = {}
    for label in SHOWN:
        if label in priors:
            how: dict[str, Any] = {"generator": generator, "keep_states": True}
            _, rollout = sample_in_world(priors[label], world, start, DRAWN, starts.length, **how)
            assert rollout.states is not None
            course = torch.cat([start.expand(DRAWN)[:, None], rollout.states[0]], 1)
            found["paths"][label] = world.coordinates(course).tolist()
    return found
