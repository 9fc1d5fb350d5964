"""The labyrinth of Rosenberg et al.'s mice: a binary tree of corridors with one water port."""

import torch
from torch import Tensor

from neuroprior.worlds.tabular import TabularWorld

DEPTH = 6
WATER = 116
MOVES = ("in_left", "in_right", "out_left", "out_right")
"""The moves: further in, to the left or right branch; back out of a left or of a right branch."""


def labyrinth(absorbing: bool = False) -> TabularWorld:
    """The binary maze of Rosenberg, Zhang, Perona and Meister, "Mice in a labyrinth" (eLife 10, e66175, 2021).

    Its nodes are the states: 0 is the first junction, node n leads further in to 2n + 1 and 2n + 2 (which of them is
    the left one alternates), and 63 to 126 are dead ends. A move that a node does not have leads back to it and is not
    legal; at node 0 both moves out lead to the home cage and back. The reward is 1 for arriving at the water, node 116.

    Args:
        absorbing: the water is terminal: there all moves are legal, stay, and give no reward.

    Returns:
        A world of 127 states, 4 moves and one reward map.

    Example:
        >>> world = labyrinth()
        >>> world.action_names, len(world.next_state)
        (('in_left', 'in_right', 'out_left', 'out_right'), 127)
    """
    node = torch.arange(2 ** (DEPTH + 1) - 1)
    depth = (node + 1).double().log2().floor().long()
    inner, first_is_left = depth < DEPTH, (depth + node) % 2 == 0
    is_left = torch.zeros_like(inner)
    is_left[_child(node[inner], first_is_left[inner])] = True
    parent = (node - 1).div(2, rounding_mode="floor").clamp(min=0)
    next_node = torch.stack(
        [
            torch.where(inner, _child(node, first_is_left), node),
            torch.where(inner, _child(node, ~first_is_left), node),
            torch.where(is_left, parent, node),
            torch.where(is_left, node, parent),
        ],
        1,
    )
    legal = (next_node != node[:, None]) | (node == 0)[:, None]
    reward = (next_node == WATER).float()
    if absorbing:
        next_node[WATER], legal[WATER], reward[WATER] = WATER, True, 0.0
    else:
        reward[WATER] = 0.0  # an illegal move does not arrive
    return TabularWorld(next_node, reward[None], legal, MOVES)


def _child(node: Tensor, first: Tensor) -> Tensor:
    """The first or the second branch of each node."""
    return 2 * node + torch.where(first, 1, 2)
