"""Rollouts of a table two steps a look-up, for many more plans than the table has states."""

import torch
from torch import Tensor

MOST = 2**18
"""Entries of the table of pairs: more are slower to look up than single steps, as they leave the processor's cache."""

STEPS_AN_ENTRY = 4
"""So many steps have to be taken for each entry, to be worth the making of the table."""

ROWS = 2**14
"""Plans that are looked up together on a CPU; what they need stays in its cache."""


def pairs_pay(next_state: Tensor, reward: Tensor, plans: Tensor) -> bool:
    """Whether a table can be looked up by pairs of the actions `plans [B, P, L]`, and is quicker so."""
    (states, actions), (batch, num_plans, length) = next_state.shape, plans.shape
    entries = len(reward) * states * actions**2
    if plans.dtype != torch.uint8 or reward.dtype != torch.float32 or length % 2 or actions > 2**7:
        return False
    return entries <= MOST and entries * STEPS_AN_ENTRY <= batch * num_plans * length


def rollout_in_pairs(next_state: Tensor, reward: Tensor, state: Tensor, plans: Tensor) -> tuple[Tensor, Tensor]:
    """What comes of plans of an even length in a table without chance.

    Args:
        next_state: integers `[S, A]`.
        reward: float32 `[W, S]` (on arrival) or `[W, S, A]` (on acting).
        state: `[B]`, between 0 and W * S - 1.
        plans: uint8 `[B, P, L]`, each below A.

    Returns:
        Final states `[B, P]` int64 and rewards `[B, P, L]`.
    """
    (states, actions), maps, pairs = next_state.shape, len(reward), next_state.shape[1] ** 2
    offset = torch.arange(maps, device=state.device) * states
    after = (next_state + offset[:, None, None]).flatten()  # of each state and action
    gained = (reward[:, next_state] if reward.dim() == 2 else reward).reshape(-1, actions)
    # Of each state and pair of actions: where it leads, as its first entry here; and both rewards as one number.
    table = (after.view(-1, actions)[after].view(-1) * pairs).int()
    first = gained[:, :, None].expand(-1, -1, actions)
    both = torch.stack([first, gained[after].view_as(first)], -1).view(torch.float64).view(-1)
    batch, num_plans, length = plans.shape
    codes = plans.reshape(-1, length).view(torch.int16)
    here = (state * pairs).int()[:, None].expand(batch, num_plans).reshape(-1)
    final = torch.empty(batch * num_plans, dtype=torch.long, device=state.device)
    rewards = torch.empty(batch * num_plans, length, device=state.device)
    gains = rewards.view(torch.float64)
    rows = ROWS if state.device.type == "cpu" else len(final)
    for at in range(0, len(final), rows):
        some = slice(at, at + rows)
        code, now = codes[some].t().contiguous(), here[some]
        # The first action of a pair is in the lower byte.
        code = ((code & 255) * actions + (code >> 8)).int()
        for pair in range(length // 2):
            entry = code[pair].add_(now)
            torch.index_select(both, 0, entry, out=gains[some, pair])
            now = table.index_select(0, entry)
        torch.div(now, pairs, rounding_mode="floor", out=final[some])
    return final.view(batch, num_plans), rewards.view(batch, num_plans, length)
