"""Extra gym: worlds from Gymnasium and MiniGrid; plans through a Minari dataset."""

import os

os.environ["MINARI_DATASETS_PATH"] = os.path.abspath("minari")

import torch

from neuroprior import Plans, SamplingPlanner, UniformPrior, from_gymnasium, read_plans
from neuroprior.plans import write_minari
from neuroprior.testing import check_world

for name in ("Taxi-v4", "MiniGrid-FourRooms-v0"):
    world = from_gymnasium(name)
    check_world(world)
    SamplingPlanner(UniformPrior(world.num_actions), length=4, num_plans=8).plan(world, world.reset(3))
plans = Plans(torch.tensor([[0, 1, 1], [2, 0, 1]]), 3)
write_minari(plans, "smoke/plans-v0")
assert torch.equal(read_plans("minari:smoke/plans-v0").actions.long(), plans.actions.long())
