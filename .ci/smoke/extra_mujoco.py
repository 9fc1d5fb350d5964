"""Extra mujoco: a planner of vectors in one of MuJoCo's worlds."""

import torch

from neuroprior.control import ICEMPlanner, from_mujoco

generator = torch.Generator().manual_seed(0)
world = from_mujoco("Reacher-v5")
decision = ICEMPlanner(length=4, num_plans=8, iterations=2).plan(world, world.reset(2, generator), generator)
assert decision.plan.isfinite().all()
