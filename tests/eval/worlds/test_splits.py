"""The worlds of a seed: no two of them, and none of two seeds, are the same."""

from eval.worlds.splits import from_seeds
from neuroprior import gridworld


def test_no_world_is_made_twice():
    made: list[int] = []

    def make(seed: int, **how: int):
        made.append(seed)
        return gridworld(3, 3, seed=seed, **how)

    worlds = [world for seed in range(4) for world in from_seeds(seed, make, num_worlds=2)]
    assert len(set(made)) == len(made) == 12
    assert len({tuple(world.reward.flatten().tolist()) for world in worlds}) == 12
    assert {world.num_maps for world in worlds} == {2}
