"""Environments that are tables already: Gymnasium's toy texts have all transitions in an attribute `P`."""

from typing import Any

import torch

from neuroprior.worlds.episodes import EpisodicWorld
from neuroprior.worlds.gymnasium.opening import action_names


def has_table(env: Any) -> bool:
    """Whether it can be read by `read_table`."""
    base = env.unwrapped
    return isinstance(getattr(base, "P", None), dict) and hasattr(base, "initial_state_distrib") and env is base


def read_table(env: Any) -> EpisodicWorld:
    """The table of a toy text; see `from_gymnasium`.

    Raises:
        ValueError: it has no table, or one that does not say all.
    """
    if not has_table(env):
        raise ValueError(
            'method="table": it takes an environment without wrappers whose transitions are in an attribute P;'
            ' "enumerate" and "step" do with any'
        )
    base = env.unwrapped
    if getattr(base, "fickle_passenger", False):
        raise ValueError("fickle_passenger: the passenger's changes of mind are not in the environment's table P")
    next_state, reward, probability, ends = _outcomes(base.P, int(env.action_space.n))
    next_state, ended = _absorbing(next_state, probability, ends)
    states = len(ends)
    extra = len(ended) - states
    reward = torch.cat([reward, reward.new_zeros(extra, *reward.shape[1:])])
    probability = torch.cat([probability, torch.zeros_like(probability[:1]).expand(extra, -1, -1)])
    reward[ended], probability[ended] = 0, 0
    probability[ended, :, 0] = 1
    starts = torch.zeros(len(ended), dtype=torch.float64)
    starts[:states] = torch.as_tensor(base.initial_state_distrib, dtype=torch.float64)
    names = action_names(env)
    if probability.shape[-1] == 1:
        return EpisodicWorld(next_state[..., 0], reward[None, ..., 0], names, starts, ended)
    return EpisodicWorld(next_state, reward[None], names, starts, ended, probability=probability)


def _outcomes(table: Any, actions: int) -> tuple[torch.Tensor, ...]:
    """Next states, rewards, probabilities and whether the episode ends, each `[S, A, K]`."""
    rows = [[[o for o in table[s][a] if o[0] > 0] for a in range(actions)] for s in range(len(table))]
    most = max(len(outcomes) for row in rows for outcomes in row)
    filled = [[row[a] + [(0.0, 0, 0.0, False)] * (most - len(row[a])) for a in range(actions)] for row in rows]
    values = [[[[float(v) for v in outcome] for outcome in outcomes] for outcomes in row] for row in filled]
    probability, next_state, reward, ends = torch.tensor(values, dtype=torch.float64).unbind(-1)
    return next_state.long(), reward.float(), probability.contiguous(), ends.bool()


def _absorbing(next_state: torch.Tensor, probability: torch.Tensor, ends: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Transitions in which ended episodes stay where they ended, `[S or S + 1, A, K]`, and where that is.

    A state into which only transitions lead that end the episode becomes absorbing itself. Where others lead there,
    too, from states in which the episode goes on, the episode ends in one more state instead.
    """
    states = len(ends)
    possible = probability > 0
    final = torch.zeros(states, dtype=torch.bool)
    final[next_state[ends & possible]] = True
    here = torch.arange(states)[:, None, None].expand_as(next_state)
    ended, before = final, None
    while before is None or not ended.equal(before):
        before = ended
        goes_on = possible & ~ends & ~ended[here]
        ended = ended.index_fill(0, next_state[goes_on], False)
    shared = final & ~ended
    next_state = torch.where(ends & possible & shared[next_state], states, next_state)
    if shared.any():
        ended = torch.cat([ended, torch.tensor([True])])
        next_state = torch.cat([next_state, torch.zeros_like(next_state[:1])])
    next_state[ended] = ended.nonzero()[:, 0, None, None]
    return next_state, ended
