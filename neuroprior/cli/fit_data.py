"""The `data` section of a recipe: plans from a file, or collected in a world, split in three."""

from dataclasses import replace
from typing import Literal

import torch

from neuroprior import Planner, Plans, World, collect
from neuroprior.plans import read_plans
from neuroprior.training import PlansModule, Settings

PARTS, LEAST_ACTIONS = 3, 2
"""Parts that plans are split in, and actions without which a part tells nothing."""

MOST_INDICES = 2**20
"""Actions or contexts beyond which they are thought to be names that look like numbers."""


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
        check_every: steps between two looks at the validation plans; null for two passes through the plans, but at
            least 10 and at most 100.
        max_steps: steps of training.
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
        batch_size: int = 64,
        window: int = 128,
        check_every: int | None = None,
        max_steps: int = 1000,
        seed: int = 0,
    ) -> None:
        for name, share in (("validation", validation), ("held_out", held_out)):
            if not 0 < share < 1:
                raise ValueError(f"data.{name}: a share between 0 and 1 is expected, not {share}")
        if validation + held_out >= 1:
            raise ValueError(f"data: validation and held_out leave nothing to learn from: {validation} + {held_out}")
        settings = Settings(max_steps, batch_size, window, check_every=check_every)
        if file is not None:
            self.source = read_plans(file, num_actions=num_actions, action_names=action_names)
        elif world is not None and planner is not None:
            generator = torch.Generator().manual_seed(seed)
            self.source = collect(planner, world, num_plans, context=context, generator=generator)
        else:
            raise ValueError("data: give either --data.file, or both --data.world and --data.planner")
        _check_indices("action", self.source.num_actions)
        self.plans = _in_parts(self.source.with_end() if end and self.source.end is None else self.source)
        self.num_contexts = _num_contexts(self.plans)
        # Drawn anew, so that collected plans are split in the same way when they come from the run's own copy.
        generator = torch.Generator().manual_seed(seed)
        rest, self.held_out = self.plans.split(held_out, generator)
        self.learned_from, self.chosen_on = rest.split(validation / (1 - held_out), generator)
        for name, part in (("validation", self.chosen_on), ("held_out", self.held_out)):
            if int(part.mask().sum()) < LEAST_ACTIONS:
                raise ValueError(
                    f"data.{name}: too few actions are left for it, {int(part.mask().sum())}; more plans are needed"
                )
        super().__init__(self.learned_from, self.chosen_on, settings, seed)
        self.window = window


def _in_parts(plans: Plans) -> Plans:
    """Plans that can be split in three: a single group tells nothing, and is left out."""
    if plans.group is None:
        units, what = len(plans), "plans"
        if units == 1:
            units, what = int(plans.mask().sum()), "actions"
    else:
        units, what = len(plans.group.unique()), "groups"
        if units == 1:
            return _in_parts(replace(plans, group=None, group_names=None))
    if units < PARTS:
        raise ValueError(
            f"data: {units} {what} cannot be split in three, to learn from, for validation and held out;"
            f" at least {PARTS} {what} are needed"
        )
    return plans


def _num_contexts(plans: Plans) -> int | None:
    """The number of context indices, of all plans together; None for none, and for features."""
    if plans.context is None or plans.context.is_floating_point():
        return None
    contexts = max(int(plans.context.max()) + 1 if plans.context.numel() else 1, len(plans.context_names or ()))
    _check_indices("context", contexts)
    return contexts


def _check_indices(what: str, number: int) -> None:
    if number > MOST_INDICES:
        raise ValueError(f"data: {what} indices go up to {number - 1}; number them from 0, or write them as names")
