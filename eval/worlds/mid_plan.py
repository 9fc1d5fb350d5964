"""Planning anew in the middle of a plan, in `python -m eval compare`: the rest of the last plan is what is seen."""

import torch
from torch import Tensor, nn

from neuroprior import TabularWorld, World
from neuroprior.planners import Planner


class UnderWay(World):
    """A world in which plans start where others are under way, and the rest of those is what is seen.

    A state is the inner world's, and the actions that are left of the plan that was under way at the start: these stay
    as they are from step to step, so that they are the context of a whole plan.

    Args:
        world: the inner world.
        planner: chooses the plans that are under way, of R + `taken` actions.
        taken: so many of their actions are executed.

    Attributes:
        world: the inner world.
    """

    def __init__(self, world: TabularWorld, planner: Planner, taken: int) -> None:
        self.world, self.planner, self.taken = world, planner, taken
        self.num_actions, self.all_legal, self.stochastic = world.num_actions, world.all_legal, world.stochastic
        self.action_names = world.action_names

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """States `[batch_size, 1 + R]`: of the inner world, some steps after a start, and the actions that are left."""
        state = self.world.reset(batch_size, generator)
        plan = self.planner.plan(self.world, state, generator).plan.long()
        for t in range(self.taken):
            state, _ = self.world.step(state, plan[:, t], generator)
        return torch.cat([state[:, None], plan[:, self.taken :]], 1)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        inner, reward = self.world.step(state[:, 0], action, generator)
        return torch.cat([inner[:, None], state[:, 1:]], 1), reward

    def observe(self, state: Tensor) -> Tensor:
        """The actions that are left, one by one: float32 `[N, R * A]`."""
        return nn.functional.one_hot(state[:, 1:], self.num_actions).flatten(1).float()

    def legal_actions(self, state: Tensor) -> Tensor:
        return self.world.legal_actions(state[:, 0])

    def group(self, state: Tensor) -> Tensor | None:
        return self.world.group(state[:, 0])

    def terminated(self, state: Tensor) -> Tensor:
        return self.world.terminated(state[:, 0])
