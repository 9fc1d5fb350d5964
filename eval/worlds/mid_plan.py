"""Replanning in the middle of a plan, in `python -m eval compare`: the context is the rest of the last plan."""

import torch
from torch import Tensor, nn

from neuroprior.planners import ExhaustivePlanner
from neuroprior.worlds import Features, TabularWorld, World


class MidPlanWorld(World):
    """A world in which plans start in the middle of earlier plans, and the rest of those is observed.

    A state is the inner world's state and the actions that were left of the earlier plan at the start. These do not
    change from step to step, so that they are the context of a whole plan.

    Args:
        world: the inner world.
        planner: chooses the earlier plans, of R + `taken` actions.
        taken: how many of their actions are executed.
    """

    def __init__(self, world: TabularWorld, planner: ExhaustivePlanner, taken: int) -> None:
        self.world, self.planner, self.taken = world, planner, taken
        self.num_actions, self.all_legal, self.stochastic = world.num_actions, world.all_legal, world.stochastic
        self.action_names, self.has_goal, self.objective = world.action_names, world.has_goal, world.objective
        self.observation = Features((planner.depth - taken) * world.num_actions)

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """States `[batch_size, 1 + R]`, int64: the inner world's after `taken` actions, and the R actions left."""
        state = self.world.reset(batch_size, generator)
        plan = self.planner.plan(self.world, state, generator).plan.long()
        for t in range(self.taken):
            state, _ = self.world.step(state, plan[:, t], generator)
        return torch.cat([state[:, None], plan[:, self.taken :]], 1)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        inner, reward = self.world.step(state[:, 0], action, generator)
        return torch.cat([inner[:, None], state[:, 1:]], 1), reward

    def observe(self, state: Tensor) -> Tensor:
        """The actions that are left, one-hot: float32 `[N, R * A]`."""
        return nn.functional.one_hot(state[:, 1:], self.num_actions).flatten(1).float()

    def legal_actions(self, state: Tensor) -> Tensor:
        return self.world.legal_actions(state[:, 0])

    def solved(self, state: Tensor) -> Tensor:
        return self.world.solved(state[:, 0])

    def group(self, state: Tensor) -> Tensor | None:
        return self.world.group(state[:, 0])

    def terminated(self, state: Tensor) -> Tensor:
        return self.world.terminated(state[:, 0])
