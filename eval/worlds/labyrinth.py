"""What experiments in the mice's labyrinth share: the moves, cut into plans, and how often the water is found."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import torch
from torch import Tensor

from neuroprior import Plans, Prior, SamplingPlanner, TabularWorld
from neuroprior.worlds import labyrinth
from neuroprior.worlds.labyrinth import WATER

DATA = Path(__file__).parents[1] / "data" / "labyrinth" / "plans.jsonl"
NODES, LONGEST = 126, 500
"""Nodes without water, and moves in a sequence of the mice."""

ROWS = 2048
"""Candidates drawn together; with more the caches of a transformer are slower to move than to compute."""


def data_digest() -> str:
    """A digest of the moves: what was computed from others is not used again."""
    return sha256(DATA.read_bytes()).hexdigest()


def check_fits(starts: int, lengths: Sequence[int]) -> None:
    """Raise ValueError unless there are so many nodes to start from, and sequences of such lengths."""
    for name, most_asked, most in (("starts", starts, NODES), ("lengths", max(lengths), LONGEST)):
        if most_asked > most:
            raise ValueError(f"`{name}` must be integers from 1 to {most}, got {most_asked}")


def dry_nodes(world: TabularWorld) -> Tensor:
    """The nodes without water."""
    return torch.tensor([node for node in range(world.num_states) if node != WATER])


def cut_plans(plans: Plans, length: int) -> Plans:
    """Plans in pieces of `length` moves; what is left over at the end is dropped. A plan's pieces are a group."""
    assert plans.context is not None
    pieces = plans.max_length // length

    def cut(values: Tensor) -> Tensor:
        return values[:, : pieces * length].reshape(-1, length)

    group = torch.arange(len(plans)).repeat_interleave(pieces)
    return replace(plans, actions=cut(plans.actions), context=cut(plans.context), group=group)


def arrivals(plans: Plans) -> Tensor:
    """`[N, L]` bool: the moves that arrive at the water."""
    assert plans.context is not None
    after = labyrinth().next_state[plans.context, plans.actions.long()]
    return (after == WATER) & (plans.context != WATER)


def arrives_within(arrives: Tensor, number: int) -> Tensor:
    """`[N, L - number + 1]`: whether one of the next `number` moves of `arrives [N, L]` arrives."""
    return arrives.unfold(1, number, 1).any(-1)


def reaching_planner(
    prior: Prior, length: int, num_plans: int, make: Callable[..., SamplingPlanner] = SamplingPlanner
) -> SamplingPlanner:
    """A planner for `shares_reached` that samples its candidates from a prior; `make`: its class, or what makes it."""
    return make(prior, length, num_plans, objective="return", any_prefix=True)


def shares_reached(
    planner: SamplingPlanner,
    world: TabularWorld,
    start: Tensor,
    lengths: Sequence[int],
    num_plans: Sequence[int],
    generator: torch.Generator,
) -> Tensor:
    """The share of starts at which a sampling planner reaches the water.

    Candidates are drawn once, as many and as long as the most asked for. Fewer are blocks of them, each block a
    planner's decision; shorter ones are their beginnings.

    Args:
        planner: of as many candidates and moves as the most asked for; it scores all prefixes by their return.
        world: the labyrinth; it ends at the water.
        start: `[B]`: the nodes to plan from.
        lengths, num_plans: T numbers of moves and P numbers of candidates.
        generator: draws the candidates.

    Returns:
        `[T, P]`, float64.
    """
    most, ends = planner.num_plans, torch.tensor(lengths) - 1
    reached = torch.empty(len(start), most, len(lengths), dtype=torch.bool)
    size = max(ROWS // most, 1)
    for at in range(0, len(start), size):
        _, score, _ = planner.candidates(world, start[at : at + size], generator)
        reached[at : at + size] = score[..., ends] > 0
    shares = []
    for number in num_plans:
        blocks = most // number
        block = reached[:, : blocks * number].view(len(start), blocks, number, len(lengths))
        shares.append(block.any(2).double().mean((0, 1)))
    return torch.stack(shares, 1)
