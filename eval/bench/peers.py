"""The peers of `python -m eval bench`: what a user would take in place of the library.

First plain numpy and PyTorch; then other packages, each imported only where it is timed, by functions that prepare a
job and return what is timed.
"""

import heapq
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.utils.data import DataLoader, TensorDataset

from eval.bench.timing import Run
from neuroprior import GRUPrior, MarkovPrior, Prior, TabularWorld, World
from neuroprior.control import ContinuousWorld

Array = NDArray[Any]


def numpy_sample(
    probs: Array, follow: Array, start: int | Array, num_plans: int, length: int, generator: np.random.Generator
) -> Array:
    """Plans `[N, L]` of a Markov chain, vectorised over plans, by inverse CDF a step.

    `probs [H, A]` are those of each action after each history, `follow [H, A]` the history after an action; `start` is
    the history of no action, or one for each plan.
    """
    edges = probs.cumsum(1)[:, :-1]
    node = np.broadcast_to(start, num_plans)
    plans = np.empty((num_plans, length), np.uint8)
    for t in range(length):
        action = (generator.random((num_plans, 1)) > edges[node]).sum(1)
        plans[:, t] = action
        node = follow[node, action]
    return plans


def numpy_counts(plans: Array, num_actions: int, order: int) -> Array:
    """How often each action followed each `order` actions, `[A**order, A]`, by `np.bincount`."""
    code = np.zeros((len(plans), plans.shape[1] - order), np.int64)
    for t in range(order + 1):
        code = code * num_actions + plans[:, t : plans.shape[1] - order + t]
    return np.bincount(code.ravel(), minlength=num_actions ** (order + 1)).reshape(-1, num_actions)


def numpy_add_at(plans: Array, num_actions: int, order: int) -> Array:
    """The same by `np.add.at`."""
    counts = np.zeros((num_actions,) * (order + 1), np.int64)
    np.add.at(counts, tuple(plans[:, t : plans.shape[1] - order + t] for t in range(order + 1)), 1)
    return counts.reshape(-1, num_actions)


def torch_rollout(next_state: Tensor, reward: Tensor, state: Tensor, plans: Tensor) -> tuple[Tensor, Tensor]:
    """What one writes first: index two tables at every step; the last cells `[B, P]`, the rewards `[B, P, L]`."""
    cell, world = state % len(next_state), state // len(next_state)
    cell = cell[:, None].expand(plans.shape[:2])
    world = world[:, None].expand(plans.shape[:2])
    rewards = []
    for t in range(plans.shape[2]):
        cell = next_state[cell, plans[:, :, t].long()]
        rewards.append(reward[world, cell])
    return cell, torch.stack(rewards, -1)


class PlainGRU(nn.Module):
    """Actions embedded, `nn.GRU`, a linear head: the prior that one writes first."""

    def __init__(self, num_actions: int, hidden_size: int = 64, num_layers: int = 1) -> None:
        super().__init__()
        self.num_actions = num_actions
        self.embedding = nn.Embedding(num_actions + 1, hidden_size)
        self.gru = nn.GRU(hidden_size, hidden_size, num_layers, batch_first=True)
        self.head = nn.Linear(hidden_size, num_actions)

    def forward(self, plans: Tensor) -> Tensor:
        """Logits `[N, L, A]` of each action of `plans [N, L]`."""
        before = nn.functional.pad(plans[:, :-1].long(), (1, 0), value=self.num_actions)
        logits: Tensor = self.head(self.gru(self.embedding(before))[0])
        return logits

    @torch.no_grad()
    def sample(self, num_plans: int, length: int) -> Tensor:
        """Plans `[N, L]`, by `torch.multinomial` a step."""
        action, hidden = torch.full((num_plans, 1), self.num_actions), None
        plans = torch.empty(num_plans, length, dtype=torch.uint8)
        for t in range(length):
            out, hidden = self.gru(self.embedding(action), hidden)
            action = torch.multinomial(self.head(out[:, 0]).softmax(-1), 1)
            plans[:, t] = action[:, 0]
        return plans


class ObservingGRU(PlainGRU):
    """The same with features of an observation before each action."""

    def __init__(self, num_actions: int, context_size: int, hidden_size: int = 64) -> None:
        super().__init__(num_actions, hidden_size)
        self.features = nn.Linear(context_size, hidden_size)

    @torch.no_grad()
    def sample_in_world(self, world: World, state: Tensor, num_plans: int, length: int) -> tuple[Tensor, Tensor]:
        """Plans `[B * P, L]` and the states after them; each step is given the observation before it."""
        state, hidden = state.repeat_interleave(num_plans, 0), None
        action = torch.full((len(state), 1), self.num_actions)
        plans = torch.empty(len(state), length, dtype=torch.uint8)
        for t in range(length):
            vectors = self.embedding(action) + self.features(world.observe(state))[:, None]
            out, hidden = self.gru(vectors, hidden)
            action = torch.multinomial(self.head(out[:, 0]).softmax(-1), 1)
            plans[:, t] = action[:, 0]
            state, _ = world.step(state, action[:, 0])
        return plans, state


def plain_training(plans: Tensor, num_actions: int, batch_size: int, learning_rate: float, steps: int) -> PlainGRU:
    """A GRU trained on `plans [N, L]` by the loop of every tutorial: DataLoader, Adam, cross entropy."""
    torch.manual_seed(0)
    model = PlainGRU(num_actions)
    optimizer = torch.optim.Adam(model.parameters(), learning_rate)
    loader = DataLoader(TensorDataset(plans), batch_size, shuffle=True)
    step = 0
    while step < steps:
        for (batch,) in loader:
            loss = nn.functional.cross_entropy(model(batch).flatten(0, 1), batch.flatten().long())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            step += 1
            if step == steps:
                break
    return model.eval()


def numpy_table_1(
    reward: Array, start: Array, num_plans: int, length: int, depth: int, orders: tuple[int, ...]
) -> dict[str, Array]:
    """Hyvärinen's first simulation in numpy, on a square torus: each planner's scores `[n]` from cells `start [n]`.

    The deterministic planner tries all plans of `depth` moves, chains of some `orders` learn from what it chose at as
    many other starts, and planners choose the best of plans drawn from them. `reward [S]` is of the cells.
    """
    generator, size = np.random.default_rng(0), round(len(reward) ** 0.5)
    row, column = np.divmod(np.arange(len(reward)), size)
    moves = ((-1, 0), (0, 1), (1, 0), (0, -1))
    next_state = np.stack([(row + down) % size * size + (column + right) % size for down, right in moves], 1)
    every = np.stack(np.meshgrid(*[np.arange(4)] * depth, indexing="ij"), -1).reshape(-1, depth)

    def best(plans: Array, start: Array) -> tuple[Array, Array]:
        cell = np.broadcast_to(start[:, None], plans.shape[:2])
        for t in range(plans.shape[2]):
            cell = next_state[cell, plans[:, :, t]]
        score = reward[cell]
        highest = score.max(1)
        chosen = np.where(score == highest[:, None], generator.random(score.shape), -1.0).argmax(1)
        return plans[np.arange(len(start)), chosen], highest

    def deterministic(start: Array) -> tuple[Array, Array]:
        return best(np.broadcast_to(every, (len(start), *every.shape)), start)

    learned = deterministic(generator.integers(len(reward), size=len(start)))[0]
    random = generator.integers(4, size=(len(start), num_plans, length), dtype=np.uint8)
    scores = {"deterministic": deterministic(start)[1], "random": best(random, start)[1]}
    for order in orders:
        plans = _chain(learned, order, len(start) * num_plans, length).reshape(random.shape)
        scores[f"markov-{order}"] = best(plans, start)[1]
    return scores


def _chain(learned: Array, order: int, number: int, length: int) -> Array:
    """`[number, L]`: plans of a chain that counted `learned`, which open as those did."""
    counts = numpy_counts(learned, 4, order) + 1e-3
    probs = counts / counts.sum(1, keepdims=True)
    follow = (np.arange(4**order)[:, None] * 4 + np.arange(4)) % 4**order
    generator = np.random.default_rng(order)
    opening = learned[generator.integers(len(learned), size=number), :order]
    start = opening @ 4 ** np.arange(order)[::-1]
    return np.hstack([opening, numpy_sample(probs, follow, start, number, length - order, generator)])


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
        plans: Tensor = drawn[:, :, 0]
        return plans

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
    numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
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

    return bare_loop(env, plans)


def bare_loop(simulator: Any, plans: Tensor) -> Run:
    """A simulator is copied for each of `plans [P, L]`, which the copy then takes; gives their returns."""

    def run() -> list[float]:
        return [_return(deepcopy(simulator), plan) for plan in plans.tolist()]

    return run


def _return(simulator: Any, plan: list[int]) -> float:
    total = 0.0
    for action in plan:
        _, reward, *ends = simulator.step(action)
        total += float(reward)
        if any(ends[:2]):
            break
    return total


class Slider:
    """A simulator whose steps take about two microseconds: a place and a speed on a ring."""

    def __init__(self) -> None:
        self.place = self.speed = 0

    def step(self, action: int) -> tuple[int, float, bool]:
        """Brake, go on or accelerate."""
        self.speed = max(-3, min(3, self.speed + action - 1))
        self.place = (self.place + self.speed) % 1000
        for _ in range(40):
            pass
        return self.place, float(self.place == 500), False


def vector_env(name: str, plans: Tensor) -> Run:
    """As many Gymnasium environments side by side as there are `plans [P, L]`; gives their returns."""
    import gymnasium
    import minigrid  # noqa: F401

    envs = gymnasium.make_vec(name, num_envs=len(plans), vectorization_mode="sync")
    actions = plans.long().numpy()

    def run() -> Any:
        envs.reset(seed=[0] * len(actions))  # type: ignore[arg-type]
        total = np.zeros(len(actions))
        for t in range(actions.shape[1]):
            total += envs.step(actions[:, t])[1]
        return total

    return run


def jax_policy(prior: Prior) -> tuple[Callable[[int], Any], Callable[[Any, Any], Any]]:
    """A prior without context in jax: uniform, a Markov chain, or a GRU of one layer that is shown one action (`lags`).

    Returns:
        Functions that give logits `[N, A]` and a memory `[N, ...]`: of N plans before the first action, and after
        actions `[N]` and the memory before them.
    """
    from jax import nn, numpy

    def array(values: Tensor) -> Any:
        return numpy.asarray(values.detach().numpy())

    if isinstance(prior, MarkovPrior):
        after, logits, first = array(prior.next_node), array(prior.log_probs), int(prior.start_node)
        return (
            lambda number: (logits[numpy.full(number, first)], numpy.full(number, first)),
            lambda action, node: (logits[after[node, action]], after[node, action]),
        )
    if not isinstance(prior, GRUPrior):
        zeros = numpy.zeros((1, prior.num_actions))
        return (
            lambda number: (zeros.repeat(number, 0), numpy.zeros(number)),
            lambda action, nothing: (zeros.repeat(len(action), 0), nothing),
        )
    vectors, head, head_bias = map(array, (prior.embedding.action.weight, prior.head.weight.T, prior.head.bias))
    w_in, w_hidden, b_in, b_hidden = map(array, prior.gru.all_weights[0])

    def step(action: Any, hidden: Any) -> Any:
        from_input, from_hidden = vectors[action] @ w_in.T + b_in, hidden @ w_hidden.T + b_hidden
        (r, z, n), (own_r, own_z, own_n) = (numpy.split(gates, 3, -1) for gates in (from_input, from_hidden))
        new, share = numpy.tanh(n + nn.sigmoid(r + own_r) * own_n), nn.sigmoid(z + own_z)
        hidden = new + share * (hidden - new)
        return hidden @ head + head_bias, hidden

    size, start = prior.hidden_size, prior.num_actions
    return lambda number: step(numpy.full(number, start), numpy.zeros((number, size))), step


def mctx_search(world: TabularWorld, state: Tensor, prior: Prior, simulations: int, length: int) -> Run:
    """mctx searches from `state [B]` for plans of `length` actions, with a prior's policy.

    As in `MCTSPlanner`, the value of a new node is the sum of the rewards of the rest of the plan, drawn from the
    prior, and there is no noise at the root. Gives the first actions.
    """
    import jax
    import mctx
    from jax import numpy

    table, gained = numpy.asarray(world.next_state.int().numpy()), numpy.asarray(world.reward.numpy())
    cells, batch = len(table), len(state)
    begin, (start, follow) = numpy.asarray(state.int().numpy()), jax_policy(prior)

    def move(now: Any, action: Any) -> Any:
        after = table[now % cells, action]
        return now // cells * cells + after, gained[now // cells, after]

    def step(parameters: Any, key: Any, action: Any, embedding: Any) -> Any:
        now, depth, memory = embedding
        (now, reward), depth = move(now, action), depth + 1
        logits, memory = follow(action, memory)

        def further(t: Any, rollout: Any) -> Any:
            now, value, key, logits, memory = rollout
            key, draw_key = jax.random.split(key)
            action = jax.random.categorical(draw_key, logits)
            after, reward = move(now, action)
            return after, value + numpy.where(depth + t < length, reward, 0), key, *follow(action, memory)

        rollout = now, numpy.zeros(batch), key, logits, memory
        value = jax.lax.fori_loop(0, length - depth.min(), further, rollout)[1]
        ones = numpy.ones(batch)
        out = mctx.RecurrentFnOutput(reward=reward, discount=ones, prior_logits=logits, value=value)
        return out, (now, depth, memory)

    @jax.jit  # type: ignore[untyped-decorator]
    def search(key: Any) -> Any:
        logits, memory = start(batch)
        embedding = begin, numpy.zeros(batch, int), memory
        root = mctx.RootFnOutput(prior_logits=logits, value=numpy.zeros(batch), embedding=embedding)
        how = {"max_depth": length, "dirichlet_fraction": 0.0}
        return mctx.muzero_policy((), key, root, step, simulations, **how).action

    key = jax.random.PRNGKey(0)
    return lambda: search(key).block_until_ready()


def python_a_star(boards: Tensor, width: int, most: int) -> Run:
    """A* in plain Python, as in textbooks, on sliding tiles `boards [B, H * W]`; gives the expansions and the steps.

    The goal is 0, 1, 2, ...; at most `most` nodes are expanded for each board; steps None: it was not solved.
    """

    def distance(board: tuple[int, ...]) -> int:
        return sum(abs(k // width - t // width) + abs(k % width - t % width) for k, t in enumerate(board) if t)

    def solve(start: tuple[int, ...]) -> tuple[int, int | None]:
        goal, size, number, expanded = tuple(range(len(start))), len(start), 0, 0
        heap, steps = [(distance(start), 0, start)], {start: 0}
        done: set[tuple[int, ...]] = set()
        while heap and expanded < most:
            _, _, board = heapq.heappop(heap)
            if board in done:
                continue
            if board == goal:
                return expanded, steps[board]
            done.add(board)
            expanded += 1
            blank = board.index(0)
            for move, able in (
                (-width, blank >= width),
                (width, blank < size - width),
                (-1, blank % width > 0),
                (1, blank % width < width - 1),
            ):
                if able:
                    after = list(board)
                    after[blank], after[blank + move] = after[blank + move], 0
                    child, taken = tuple(after), steps[board] + 1
                    if taken < steps.get(child, taken + 1):
                        steps[child], number = taken, number + 1
                        heapq.heappush(heap, (taken + distance(child), -number, child))
        return expanded, None

    lines = [tuple(board) for board in boards.tolist()]
    return lambda: [solve(line) for line in lines]


@torch.no_grad()
def plain_mppi(world: ContinuousWorld, state: Tensor, length: int, num_plans: int, std: float) -> Tensor:
    """Plans `[B, L, D]` by model predictive path integral control, one start after the other, as controllers do it."""
    low, high, plans = world.action_low, world.action_high, []
    for start in state:
        tried = (std * (high - low) / 2 * torch.randn(num_plans, length, len(low)) + (high + low) / 2).clamp(low, high)
        now, score = start.expand(num_plans, -1), torch.zeros(num_plans)
        for t in range(length):
            now, reward = world.step(now, tried[:, t])
            score += reward
        weight = ((score - score.max()) / score.std() / 0.1).softmax(0)
        plans.append((weight[:, None, None] * tried).sum(0))
    return torch.stack(plans)
