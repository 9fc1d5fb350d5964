"""Other packages at the jobs of `python -m eval bench`, each imported only where it is timed."""

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from torch import Tensor

Run = Callable[[], Any]


def transformers_generate(num_actions: int, length: int, batch_size: int, width: int = 64, layers: int = 2) -> Run:
    """GPT-2, as wide and deep, samples `batch_size` plans with its key-value cache.

    It begins with action 0, as it needs something to read.
    """
    from transformers import GPT2Config, GPT2LMHeadModel

    torch.manual_seed(0)
    config = GPT2Config(
        vocab_size=num_actions,
        n_positions=length + 1,
        n_embd=width,
        n_layer=layers,
        n_head=4,
        bos_token_id=0,
        eos_token_id=None,
        pad_token_id=0,
    )
    model = GPT2LMHeadModel(config).eval()
    begin = torch.zeros(batch_size, 1, dtype=torch.long)
    how = {"do_sample": True, "top_k": 0, "min_new_tokens": length, "max_new_tokens": length, "use_cache": True}

    def run() -> Tensor:
        with torch.no_grad():
            plans: Tensor = model.generate(begin, attention_mask=torch.ones_like(begin), **how)
        return plans[:, 1:]

    return run


def pomegranate_sample(plans: Tensor, order: int, num_plans: int, length: int) -> Run:
    """pomegranate's chain, fitted to `plans`, goes on from what its `sample` gives to the whole length."""
    chain = _pomegranate(order, int(plans.max()) + 1)
    chain.fit(plans.long()[:, :, None])

    def run() -> Tensor:
        drawn = chain.sample(num_plans)
        while drawn.shape[1] < length:
            drawn = torch.cat([drawn, chain.distributions[-1].sample(num_plans, drawn[:, -order:])[:, None]], 1)
        return drawn[:, :, 0]

    return run


def pomegranate_fit(plans: Tensor, order: int) -> Run:
    """pomegranate's chain counts `plans`."""
    columns, actions = plans.long()[:, :, None], int(plans.max()) + 1
    return lambda: _pomegranate(order, actions).fit(columns)


def _pomegranate(order: int, num_actions: int) -> Any:
    from pomegranate.markov_chain import MarkovChain

    return MarkovChain(k=order, n_categories=[num_actions])


def numba_rollout(next_state: Tensor, reward: Tensor, state: Tensor, plans: Tensor) -> Run:
    """A compiled loop over starts, in parallel; gives the last cells `[B, P]` and the rewards `[B, P, L]`."""
    import numba

    @numba.njit(parallel=True)
    def loop(table: Any, reward: Any, state: Any, plans: Any) -> Any:
        starts, number, length = plans.shape
        final = np.empty((starts, number), np.int64)
        rewards = np.empty((starts, number, length), np.float32)
        for start in numba.prange(starts):
            first = np.uint32(state[start] % len(table))
            gain = reward[state[start] // len(table)]
            for plan in range(number):
                cell = first
                for t in range(length):
                    cell = table[cell, plans[start, plan, t]]
                    rewards[start, plan, t] = gain[cell]
                final[start, plan] = cell
        return final, rewards

    # Numbers without a sign are quicker to index with.
    arrays = next_state.numpy().astype(np.uint32), reward.numpy(), state.numpy(), plans.numpy()
    numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
    return lambda: loop(*arrays)


def vlmc_fit(actions: list[int], num_actions: int, depth: int) -> Run:
    """The best tree of Bayesian context trees, in Rust."""
    import vlmc

    def run() -> Any:
        tree = vlmc.VLMC(num_actions, depth, "bct")
        tree.fit([actions])
        return tree

    return run


def deep_copies(name: str, plans: Tensor) -> Run:
    """A Gymnasium environment is copied for each of `plans [P, L]`, which the copy then takes; gives their returns."""
    import gymnasium
    import minigrid  # noqa: F401, its environments register themselves

    env = gymnasium.make(name)
    env.reset(seed=0)

    def run() -> list[float]:
        return [_return(deepcopy(env), plan) for plan in plans.tolist()]

    return run


def _return(env: Any, plan: list[int]) -> float:
    total = 0.0
    for action in plan:
        _, reward, terminated, truncated, _ = env.step(action)
        total += float(reward)
        if terminated or truncated:
            break
    return total


def vector_env(name: str, plans: Tensor) -> Run:
    """As many Gymnasium environments side by side as there are `plans [P, L]`; gives their returns."""
    import gymnasium
    import minigrid  # noqa: F401

    envs = gymnasium.make_vec(name, num_envs=len(plans), vectorization_mode="sync")
    actions = plans.long().numpy()

    def run() -> Any:
        envs.reset(seed=[0] * len(actions))
        total = np.zeros(len(actions))
        for t in range(actions.shape[1]):
            total += envs.step(actions[:, t])[1]
        return total

    return run


def mctx_search(next_state: Tensor, reward: Tensor, state: Tensor, simulations: int, depth: int, gumbel: bool) -> Run:
    """mctx searches from `state [B]`, a model step a simulation, with a uniform policy and no values."""
    import jax
    import mctx

    table, gained = jax.numpy.asarray(next_state.numpy()), jax.numpy.asarray(reward.numpy())
    cells, actions = table.shape
    begin = jax.numpy.asarray(state.numpy())
    nothing = jax.numpy.zeros((len(begin), actions)), jax.numpy.zeros(len(begin))

    def step(parameters: Any, key: Any, action: Any, embedding: Any) -> Any:
        after = table[embedding % cells, action]
        got = gained[embedding // cells, after]
        logits, value = nothing
        out = {"reward": got, "discount": jax.numpy.ones_like(got), "prior_logits": logits, "value": value}
        return mctx.RecurrentFnOutput(**out), embedding // cells * cells + after

    policy = mctx.gumbel_muzero_policy if gumbel else mctx.muzero_policy

    @jax.jit
    def search(key: Any) -> Any:
        root = mctx.RootFnOutput(prior_logits=nothing[0], value=nothing[1], embedding=begin)
        return policy((), key, root, step, simulations, max_depth=depth).action

    key = jax.random.PRNGKey(0)
    return lambda: search(key).block_until_ready()
