"""The 2 x 2 x 2 cube: 3,674,160 states, six or nine moves, and the exact distance of each state from the solved one."""

import itertools
from functools import cache
from typing import Literal

import torch
from torch import Tensor

from neuroprior._checks import check_count, check_range
from neuroprior._random import generator_on
from neuroprior.worlds.observations import Features
from neuroprior.worlds.world import World, check_action

FACES = ("U", "R", "F")
_PERMUTATIONS, _ORIENTATIONS = 5040, 729
NUM_STATES = _PERMUTATIONS * _ORIENTATIONS
"""The states of the cube, counted without turns of the whole cube: 7! * 3**6."""

# Seven of the corners: up-right-front, up-front-left, up-left-back, up-back-right, down-front-right, down-left-front,
# down-right-back. The eighth, down-back-left, never moves. For each face and a quarter turn clockwise (Kociemba's
# conventions): the place from which each place's new cubie comes, and the twist that it is given.
_FROM = torch.tensor([[3, 0, 1, 2, 4, 5, 6], [4, 1, 2, 0, 6, 5, 3], [1, 5, 2, 3, 0, 4, 6]])
_TWIST = torch.tensor([[0, 0, 0, 0, 0, 0, 0], [2, 0, 0, 1, 1, 0, 2], [1, 2, 0, 0, 2, 1, 0]])


class PocketCube(World):
    """The 2 x 2 x 2 cube with one corner held fast; see `cube`.

    A state is one integer, `permutation * 729 + orientation`, below 3,674,160; 0 is the solved cube. The permutation is
    the lexicographic number of the cubies in the seven places, the orientation the twists of the first six in base 3.

    Args:
        turns, scramble, reward, absorbing: see `cube`.

    Attributes:
        reward_kind: "solved" or "distance".
        action_names: such as ("U", "U2", "U'", ...).

    Raises:
        ValueError: an argument is out of range.
    """

    has_goal = True
    objective = "terminal"
    observation = Features(70)

    def __init__(
        self,
        turns: Literal["half", "quarter"],
        scramble: int,
        reward: Literal["solved", "distance"] = "solved",
        absorbing: bool = False,
    ) -> None:
        if turns not in ("half", "quarter"):
            raise ValueError(f'`turns` must be "half" or "quarter", got {turns!r}')
        if reward not in ("solved", "distance"):
            raise ValueError(f'`reward` must be "solved" or "distance", got {reward!r}')
        check_count("scramble", scramble, 0)
        self.turns, self.scramble, self.reward_kind, self.absorbing = turns, scramble, reward, absorbing
        permutations, orientations = _all_permutations(), _all_orientations()
        names, permutation_moves, orientation_moves = [], [], []
        for face, name in enumerate(FACES):
            moved, twisted = permutations, orientations
            for suffix in ("", "2", "'"):
                moved = moved[:, _FROM[face]]
                twisted = (twisted[:, _FROM[face]] + _TWIST[face]) % 3
                if turns == "half" or suffix != "2":
                    names.append(name + suffix)
                    permutation_moves.append(_permutation_number(moved))
                    orientation_moves.append(_orientation_number(twisted))
        self.action_names, self.num_actions = tuple(names), len(names)
        self._permutation_moves = torch.stack(permutation_moves, 1)
        self._orientation_moves = torch.stack(orientation_moves, 1)
        self._permutation_features = torch.nn.functional.one_hot(permutations, 7).flatten(1).float()
        self._orientation_features = torch.nn.functional.one_hot(orientations, 3).flatten(1).float()

    @property
    def device(self) -> torch.device:
        """Where the tables are."""
        return self._permutation_moves.device

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """States `[batch_size]`: the solved cube after `scramble` independent random moves."""
        check_count("batch_size", batch_size)
        generator = generator_on(generator, self.device)
        state = torch.zeros(batch_size, dtype=torch.long, device=self.device)
        for _ in range(self.scramble):
            move = torch.randint(self.num_actions, (batch_size,), generator=generator, device=self.device)
            state = self._turn(state, move)
        return state

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        if state.device.type == "cpu":
            self.check_state(state)
        after = self._turn(state, check_action(action, len(state), self.num_actions))
        if self.absorbing:
            ended = state == 0
            after = after.masked_fill(ended, 0)
            if self.reward_kind == "solved":
                return after, ((after == 0) & ~ended).float()
        elif self.reward_kind == "solved":
            return after, (after == 0).float()
        return after, -self._distances[after].float()

    def _turn(self, state: Tensor, action: Tensor) -> Tensor:
        permutation = state.div(_ORIENTATIONS, rounding_mode="floor")
        orientation = state - permutation * _ORIENTATIONS
        moved = self._permutation_moves.view(-1)[permutation * self.num_actions + action]
        return moved * _ORIENTATIONS + self._orientation_moves.view(-1)[orientation * self.num_actions + action]

    def distance(self, state: Tensor) -> Tensor:
        """The exact number of moves from each state `[...]` to the solved one: int64 `[...]`.

        At most 11 with half turns, 14 without. A plan of L moves can pass the solved state if and only if this is at
        most L (at least 1 where it is solved already). The first call searches all states, which takes seconds.

        Raises:
            ValueError: a state is out of range.
        """
        check_range("state", state, NUM_STATES, "states of the cube")
        return self._distances[state].long()

    @property
    def _distances(self) -> Tensor:
        return _all_distances(self.turns, self.device)

    def observe(self, state: Tensor) -> Tensor:
        """float32 `[N, 70]`: which cubie is in each of the seven places (one-hot, 49), and its twist (one-hot, 21)."""
        permutation = state.div(_ORIENTATIONS, rounding_mode="floor")
        orientation = state - permutation * _ORIENTATIONS
        return torch.cat([self._permutation_features[permutation], self._orientation_features[orientation]], -1)

    def solved(self, state: Tensor) -> Tensor:
        """Where the cube is solved."""
        return state == 0

    def terminated(self, state: Tensor) -> Tensor:
        """Where the cube is solved, if `absorbing`."""
        return (state == 0) & self.absorbing

    def check_state(self, state: Tensor) -> None:
        if not isinstance(state, Tensor) or state.dim() != 1 or state.dtype != torch.int64:
            raise ValueError("`state` must be int64 of shape [B], numbers of states of the cube")
        check_range("state", state, NUM_STATES, "states of the cube")


def cube(
    turns: Literal["half", "quarter"] = "half",
    *,
    scramble: int = 14,
    reward: Literal["solved", "distance"] = "solved",
    absorbing: bool = False,
) -> PocketCube:
    """The 2 x 2 x 2 cube, solved from scrambled states.

    One corner is held fast, so that turns of the whole cube do not count: the moves are those of the up, the right and
    the front face.

    Args:
        turns: "half": 9 moves, a quarter turn either way or a half turn; every state is at most 11 moves from the
            solved one. "quarter": 6 moves, quarter turns alone; at most 14.
        scramble: `reset` makes so many random moves from the solved state.
        reward: "solved": 1 for a move that arrives at the solved state, else 0. "distance": minus the exact number of
            moves that are left after the move.
        absorbing: the solved state is terminal: all moves stay there, without reward.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = cube(scramble=4)
        >>> world.num_actions, world.solved(world.reset(100, torch.Generator().manual_seed(0))).any().item()
        (9, True)
    """
    return PocketCube(turns, scramble, reward, absorbing)


def _all_permutations() -> Tensor:
    """`[5040, 7]`, in lexicographic order."""
    return torch.tensor(list(itertools.permutations(range(7))))


def _permutation_number(permutation: Tensor) -> Tensor:
    """The row `[N]` of each permutation `[N, 7]` among all of them, by its Lehmer code."""
    later = torch.ones(7, 7, dtype=torch.bool).triu(1)
    smaller_later = ((permutation[:, None, :] < permutation[:, :, None]) & later).sum(-1)
    return (smaller_later * torch.tensor([720, 120, 24, 6, 2, 1, 0])).sum(-1)


def _all_orientations() -> Tensor:
    """`[729, 7]`: the twists of all seven cubies; those of a cube that can be solved sum to a multiple of 3."""
    six = torch.cartesian_prod(*[torch.arange(3)] * 6)
    return torch.cat([six, (-six.sum(1, keepdim=True)) % 3], 1)


def _orientation_number(twists: Tensor) -> Tensor:
    """The row `[N]` of `twists [N, 7]` among all orientations."""
    return (twists[:, :6] * torch.tensor([243, 81, 27, 9, 3, 1])).sum(-1)


@cache
def _all_distances(turns: Literal["half", "quarter"], device: torch.device) -> Tensor:
    """uint8 `[3674160]`: breadth-first search from the solved state, all states of a depth at a time.

    Once for all cubes of a process: the search takes seconds.
    """
    world, unknown = PocketCube(turns, 0).to(device), 255
    distances = torch.full((NUM_STATES,), unknown, dtype=torch.uint8, device=device)
    distances[0] = 0
    frontier, depth = torch.zeros(1, dtype=torch.long, device=device), 0
    while len(frontier):
        depth += 1
        for action in range(world.num_actions):  # one at a time: the largest frontier has 1,887,748 states
            after = world._turn(frontier, torch.full_like(frontier, action))
            distances[after[distances[after] == unknown]] = depth
        frontier = (distances == depth).nonzero()[:, 0]
    return distances
