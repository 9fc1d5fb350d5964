"""Extra fast: numba compiles, and sliding tiles are solved."""

import torch

from neuroprior._compiled import compiled
from neuroprior.puzzles import LevinPlanner, LogLinearPrior, bootstrap, sliding_tiles

assert compiled("neuroprior.puzzles.compiled_search") is not None
generator = torch.Generator().manual_seed(0)
world = sliding_tiles(shape=(3, 3), scramble=8)
prior = LogLinearPrior(world.num_actions, num_patterns=len(world.windows.windows))
for _ in bootstrap(world, prior, world.reset(50, generator), max_nodes=200, sweeps=2, generator=generator):
    pass
assert LevinPlanner(prior, max_nodes=500).search(world, world.reset(20, generator)).solved.any()
