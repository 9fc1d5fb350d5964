"""Plans as flat steps: the patterns, the last actions and the action of each; and how histories are numbered."""

from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import check_range, is_integer
from neuroprior._random import generator_on
from neuroprior.plans import Plans, check_patterns


class Steps(NamedTuple):
    """M steps, of any number of plans.

    Attributes:
        patterns: int32 `[M, F]`.
        last: int64 `[M]`, the number of the history of the last actions before each step, see `next_history`.
        action: int64 `[M]`.
        plan: int64 `[M]`, from 0: the plan that each step belongs to.
        weight: float32 `[M]`, how much each step counts; None: all 1.
    """

    patterns: Tensor
    last: Tensor
    action: Tensor
    plan: Tensor
    weight: Tensor | None = None

    def at(self, index: Tensor) -> "Steps":
        """The steps at `index [m]`."""
        return Steps(*(None if values is None else values[index] for values in self))  # type: ignore[arg-type]

    def weights(self) -> Tensor:
        """The weight of each step, float32 `[M]`."""
        return torch.ones(len(self.action)) if self.weight is None else self.weight


def next_history(num_actions: int, order: int) -> Tensor:
    """The history after each history and action, int64 `[H, A]`, with H = A**order + ... + A + 1.

    Full histories come first, with `order` actions as digits in base A, the last action being the least significant;
    then those of one action less, and so on. The empty one is the last, H - 1. Of order 1: an action's own number,
    or A where there is none yet.
    """
    sizes = [num_actions**length for length in range(order, -1, -1)]
    if order == 0:
        return torch.zeros(1, num_actions, dtype=torch.long)
    action = torch.arange(num_actions)
    full = torch.arange(sizes[0]) % sizes[1] * num_actions
    rows = [full[:, None] + action]
    offset = 0
    for size in sizes[1:]:
        rows.append(offset + (torch.arange(size) * num_actions)[:, None] + action)
        offset += size * num_actions
    return torch.cat(rows)


def histories(actions: Tensor, following: Tensor) -> Tensor:
    """The history before each of `actions [N, L]`, int64 `[N, L]`; `following`: see `next_history`."""
    number, found = actions.new_full((len(actions),), len(following) - 1, dtype=torch.long), []
    for t in range(actions.shape[1]):
        found.append(number)
        number = following[number, actions[:, t].long()]
    return torch.stack(found, 1) if found else torch.zeros(actions.shape, dtype=torch.long, device=actions.device)


def flat_steps(plans: Plans, following: Tensor) -> Steps:
    """All steps of plans with patterns, plan by plan; an end symbol is a step like any other."""
    assert plans.context is not None
    mask = plans.mask()
    last = histories(plans.actions, following)[mask]
    plan = torch.arange(len(plans), device=mask.device)[:, None].expand_as(mask)[mask]
    return Steps(plans.context[mask], last, plans.actions[mask].long(), plan)


def checked_steps(steps: Steps, num_patterns: int, num_actions: int, num_histories: int) -> Steps:
    """The same steps with the dtypes of `Steps`.

    Raises:
        ValueError: a shape, dtype or value is wrong.
    """
    patterns, last, action, plan, weight = steps
    if not is_integer(patterns) or patterns.dim() != 2 or patterns.shape[1] != num_patterns:
        raise ValueError(
            f"patterns: integers [M, {num_patterns}] are expected, not {patterns.dtype} {list(patterns.shape)}"
        )
    num = len(patterns)
    for name, values in (("last", last), ("action", action), ("plan", plan), ("weight", weight)):
        if values is not None and values.shape != (num,):
            raise ValueError(f"{name}: shape [{num}] is expected, not {list(values.shape)}")
    if num == 0:
        raise ValueError("steps: there are none to learn from")
    check_patterns(patterns)
    check_range("last", last, num_histories, "histories")
    check_range("action", action, num_actions, "actions")
    if weight is not None and not bool((weight.isfinite() & (weight >= 0)).all() and weight.sum() > 0):
        raise ValueError("weight: finite numbers from 0, not all 0, are expected")
    weight = None if weight is None else weight.float()
    return Steps(patterns.to(torch.int32), last.long(), action.long(), plan.long(), weight)


def split_steps(steps: Steps, validation: float, generator: torch.Generator | None) -> tuple[Steps, Steps | None]:
    """Steps of some plans to learn from, and those of the others; None where one plan is all there is."""
    units, unit = steps.plan.unique(return_inverse=True)
    if len(units) < 2:
        return steps, None
    number = min(max(round(len(units) * validation), 1), len(units) - 1)
    held_out = torch.zeros(len(units), dtype=torch.bool)
    held_out[torch.randperm(len(units), generator=generator_on(generator, "cpu"))[:number]] = True
    there = held_out[unit]
    return steps.at(~there), steps.at(there)


def vocabulary(patterns: Tensor, min_count: int) -> Tensor:
    """The patterns int32 `[V]`, ascending, that occur at least `min_count` times in `patterns [M, F]`.

    The columns are counted some at a time, so that beside the result it takes the memory of one part.
    """
    found = torch.zeros(0, dtype=torch.int32)
    number = torch.zeros(0, dtype=torch.long)
    columns = max(2**24 // max(len(patterns), 1), 1)
    for at in range(0, patterns.shape[1], columns):
        codes, times = patterns[:, at : at + columns].reshape(-1).unique(return_counts=True)
        merged, place = torch.cat([found, codes]).unique(return_inverse=True)
        number = torch.zeros(len(merged), dtype=torch.long).index_add_(0, place, torch.cat([number, times]))
        found = merged
    return found[number >= min_count]


def numbered(patterns: Tensor, known: Tensor) -> Tensor:
    """The place of each pattern among `known [V]` (ascending), int32 of the same shape; V where it is not there."""
    if not len(known):
        return torch.zeros_like(patterns, dtype=torch.int32)
    codes = patterns.to(torch.int32).contiguous()
    place = torch.searchsorted(known, codes, out_int32=True)
    there = known[place.clamp(max=len(known) - 1)] == codes
    return torch.where(there, place, len(known)).to(torch.int32)
