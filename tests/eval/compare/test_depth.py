"""`eval depth`: plans that may end after any of their actions, in a small world."""

import torch

from eval.compare import depth
from eval.compare.depth import CHOSEN, DepthSettings, depth_run
from eval.worlds.runs import Run
from eval.worlds.splits import Worlds
from eval.worlds.suite import Task
from neuroprior import TabularWorld

NUM_PLANS, LENGTH = (64, 128), 4


def test_plans_may_end_after_any_of_their_actions(monkeypatch):
    """The reward is a step away, and lost with the next: no plan of four actions ends where it is.

    With 64 uniform plans the right first action is missed with a probability of 2 ** -64.
    """
    table, reward = torch.tensor([[2, 1], [2, 2], [2, 2]]), torch.tensor([0.0, 1.0, 0.0])
    world = TabularWorld(table, reward)
    task = Task(("left", "right"), "a trap", lambda seed: Worlds(world, world, world), 2, (LENGTH,))
    monkeypatch.setitem(depth.TASKS, "trap", task)
    settings = DepthSettings(NUM_PLANS, ("markov",), (), 1, 1, 8, 40, 0, length=LENGTH)
    entries = depth_run(Run("trap", 0), settings)["entries"]
    assert {(one["prior"], one["planner"], one["num_plans"]) for one in entries} == {
        (prior, planner, number)
        for prior in ("uniform", "markov-3")
        for planner in ("2 actions", "4 actions", CHOSEN)
        for number in NUM_PLANS
    }
    for one in entries:
        assert one["share"] == 1
        if one["planner"] != CHOSEN:  # as many steps, whatever the horizon
            assert one["model_steps"] == one["num_plans"] * LENGTH
