"""The `data` section of a recipe: plans from a file, or collected in a world, split in three."""

from collections.abc import Sequence
from typing import Literal

import torch

from neuroprior import Planner, Plans, World, collect
from neuroprior.plans import read_minari, read_plans
from neuroprior.training import PlansModule

MINARI = "minari:"


class PlansData(PlansModule):
    """Plans to learn from, for early stopping and choices (validation), and for the table at the end (held out).

    Args:
        file: plans to learn from: `.npz`, `.jsonl` or `.csv`, or `minari:` and the name of a Minari dataset.
        num_actions: number of actions, where the file does not tell.
        action_names: names of the actions in the order of their numbers, where the file does not tell.
        world: where plans are collected if no file is given, such as `neuroprior.gridworld`.
        planner: who makes them, such as `ExhaustivePlanner`.
        num_plans: how many are collected.
        context: what is recorded of the world: nothing, what is seen at the start, or before each action.
        end: close each plan with a symbol for its end, so that the prior tells how long plans are.
        validation: share of plans (of groups, where there are any) for early stopping and the rivals' choices.
        held_out: share of plans (or groups) for the table at the end; nothing is learned or chosen on them.
        batch_size: plans a step (pieces of plans, where they are longer than a window).
        window: actions that a step reads of a plan; longer plans are read in windows, with memory carried over.
        steps_per_epoch: steps between two looks at the validation plans.
        seed: draws the collected plans, the split and the order of training.
    """

    def __init__(
        self,
        file: str | None = None,
        num_actions: int | None = None,
        action_names: list[str] | None = None,
        world: World | None = None,
        planner: Planner | None = None,
        num_plans: int = 10_000,
        context: Literal["plan", "step"] | None = None,
        end: bool = False,
        validation: float = 0.1,
        held_out: float = 0.1,
        batch_size: int = 128,
        window: int = 128,
        steps_per_epoch: int = 100,
        seed: int = 0,
    ) -> None:
        for name, size in (("batch_size", batch_size), ("window", window), ("steps_per_epoch", steps_per_epoch)):
            if size < 1:
                raise ValueError(f"data.{name}: at least 1 is expected, not {size}")
        if file is not None:
            plans = _read(file, num_actions, action_names)
        elif world is not None and planner is not None:
            plans = collect(planner, world, num_plans, context=context, generator=torch.Generator().manual_seed(seed))
        else:
            raise ValueError("data: give either --data.file, or both --data.world and --data.planner")
        self.source = plans
        if end:
            plans = plans.with_end()
        self.plans = plans
        if not 0 < validation + held_out < 1:
            raise ValueError(f"data: validation and held_out must leave plans to learn from: {validation} + {held_out}")
        # Drawn anew, so that collected plans are split in the same way when they come from the run's own copy.
        generator = torch.Generator().manual_seed(seed)
        rest, self.held_out = plans.split(held_out, generator)
        training, self.chosen_on = rest.split(validation / (1 - held_out), generator)
        super().__init__(training, self.chosen_on, batch_size, window, steps_per_epoch, seed)
        self.learned_from, self.window = training, window


def _read(file: str, num_actions: int | None, action_names: Sequence[str] | None) -> Plans:
    if file.startswith(MINARI):
        return read_minari(file.removeprefix(MINARI))
    return read_plans(file, num_actions=num_actions, action_names=action_names)
