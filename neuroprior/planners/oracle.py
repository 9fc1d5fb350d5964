"""The oracle: the best that any plan of a length can reach in a table, by dynamic programming."""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from neuroprior.planners.planner import check_objective, value_of
from neuroprior.worlds.tabular import TabularWorld


def oracle(
    world: TabularWorld,
    state: Tensor,
    length: int,
    *,
    objective: Literal["terminal", "return"] = "terminal",
    discount: float = 1.0,
    value: Callable[[Tensor], Tensor] | None = None,
    any_prefix: bool = False,
) -> Tensor:
    """The exact highest score of all legal plans of `length` actions: finite-horizon dynamic programming.

    In a world with chance it is the highest mean score of all closed-loop policies, which choose each action knowing
    where the earlier ones led: an upper bound of what any plan, whose actions are fixed in advance, has on average.

    Args:
        world: a table.
        state: starts `[B]`.
        length: number of actions, at least 1.
        objective, discount, value, any_prefix: what is optimised; see `Planner`.

    Returns:
        `[B]` floating point. Takes `length * W * S * A` operations whatever B is.

    Raises:
        ValueError: an argument is out of range.
    """
    if length < 1:
        raise ValueError(f"length: at least 1 is expected, not {length}")
    check_objective(objective, discount)
    world.check_state(state)
    maps, states, actions = world.num_maps, world.num_states, world.num_actions
    reward = world.mean_reward()
    every = torch.arange(maps * states, device=world.device)
    best = torch.zeros(maps, states, device=world.device, dtype=reward.dtype)
    if value is not None:
        best = value_of(value, every).view(maps, states).to(reward.dtype)
    prefix = torch.full_like(best, -torch.inf)
    for left in range(length):
        after = world.mean_after(best)
        if objective == "return":
            after = reward + discount * after
        elif left == 0:
            after = reward + after
        if world.legal_table is not None:
            after = after.masked_fill(~world.legal_table, -torch.inf)
        best = after.view(maps, states, actions).amax(-1)
        prefix = torch.maximum(prefix, best)
    return (prefix if any_prefix else best).view(-1)[state]
