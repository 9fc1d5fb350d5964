"""What the tests share: enumerations, closed forms, chi-square tests, random worlds and a prior written as a table."""

import itertools
import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import pytest
import torch
from scipy import stats
from torch import Tensor

from neuroprior import Prior, TabularWorld
from neuroprior.plans import expand_context

# On tensors this small several threads only wait for each other, for seconds on a busy machine.
torch.set_num_threads(1)

FALSE_ALARM = 1e-6
"""The probability with which one chi-square test of right code fails; seeds are fixed, so it does always or never."""


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def every_plan(num_actions: int, length: int) -> Tensor:
    """All A**L plans; row i is i written in base A."""
    return torch.tensor(list(itertools.product(range(num_actions), repeat=length)), dtype=torch.long)


def plan_number(plans: Tensor, num_actions: int) -> Tensor:
    """The row of each plan `[..., L]` in `every_plan`."""
    return (plans.long() * num_actions ** torch.arange(plans.shape[-1] - 1, -1, -1)).sum(-1)


def p_value(numbers: Tensor, probs: Tensor) -> float:
    """Chi-square test that `numbers` were drawn from `probs [M]`; 0 where an impossible one was drawn.

    Numbers expected fewer than 5 times are pooled.
    """
    observed = numbers.flatten().bincount(minlength=len(probs)).double()
    probs = probs.double() / probs.double().sum()
    if len(observed) > len(probs) or observed[probs == 0].any():
        return 0.0
    expected = probs * observed.sum()
    rare = expected < 5
    counts, due = (torch.cat([v[~rare], v[rare].sum()[None]]) for v in (observed, expected))
    counts, due = counts[due > 0], due[due > 0]
    if len(due) < 2:
        raise AssertionError("too few draws for a test")
    return float(stats.chi2.sf(float(((counts - due) ** 2 / due).sum()), len(due) - 1))


def fits(plans: Tensor, probs: Tensor, num_actions: int) -> bool:
    """Whether `plans [N, L]` may be drawn from `probs [A**L]`."""
    return p_value(plan_number(plans, num_actions), probs) > FALSE_ALARM


def best_plan_distribution() -> Tensor:
    """`[256]`: the best plan of 4 moves on a large torus with independent rewards.

    Each cell that can be reached is equally often the best, and all plans that end there are equally good and likely.
    """
    row_column = torch.tensor([[-1, 0], [0, 1], [1, 0], [0, -1]])  # up, right, down, left
    end = row_column[every_plan(4, 4)].sum(1)
    _, cell, ways = end.unique(dim=0, return_inverse=True, return_counts=True)
    return 1 / (len(ways) * ways[cell].double())


def best_plans(num_plans: int, seed: int) -> Tensor:
    """Draws from `best_plan_distribution`."""
    row = torch.multinomial(best_plan_distribution(), num_plans, replacement=True, generator=seeded(seed))
    return every_plan(4, 4)[row]


def bits_per_action(probs: Tensor, log_probs: Tensor, length: int) -> float:
    """The KL divergence from `probs` of what has `log_probs` (nats), in bits per action."""
    return float((probs * (probs.log() - log_probs.double())).sum()) / length / math.log(2)


def random_world(
    seed: int, rewards: str = "WSA", legal: bool = False, states: int = 6, actions: int = 3, maps: int = 2
) -> TabularWorld:
    """A table of random transitions with rewards of the kind `rewards` ("S", "SA", "WS" or "WSA")."""
    generator = seeded(seed)
    size = {"W": maps, "S": states, "A": actions}
    reward = torch.rand([size[letter] for letter in rewards], generator=generator)
    table = torch.randint(states, (states, actions), generator=generator)
    exists = None
    if legal:
        exists = torch.rand(states, actions, generator=generator) < 0.5
        exists[torch.arange(states), torch.randint(actions, (states,), generator=generator)] = True
    return TabularWorld(table, reward, exists)


def stochastic_world(
    seed: int, rewards: str = "WSAK", states: int = 5, actions: int = 3, outcomes: int = 4, maps: int = 2
) -> TabularWorld:
    """A random stochastic table; the outcomes of an action are different cells, about a third of which cannot occur.

    `rewards`: "S", "SA", "SAK", or one of these after a "W".
    """
    generator = seeded(seed)
    size = {"W": maps, "S": states, "A": actions, "K": outcomes}
    reward = torch.rand([size[letter] for letter in rewards], generator=generator)
    table = torch.rand(states, actions, states, generator=generator).argsort(-1)[..., :outcomes]
    probability = torch.rand(table.shape, generator=generator, dtype=torch.float64)
    probability[torch.rand(table.shape, generator=generator) < 0.33] = 0
    probability[..., 1] += 0.1
    return TabularWorld(table, reward, probability=probability / probability.sum(-1, keepdim=True))


def trajectories(
    world: TabularWorld, state: int, plan: list[int]
) -> list[tuple[float, tuple[int, ...], tuple[float, ...]]]:
    """All trajectories of `plan` from `state`: (probability, states after each step, rewards), by recursion."""
    if not plan:
        return [(1.0, (), ())]
    cell, number = state % world.num_states, state // world.num_states
    found = []
    for k, to in enumerate(world.next_state[cell, plan[0]].tolist()):
        p = float(world.probability[cell, plan[0], k])
        if p > 0:
            where = {2: (number, to), 3: (number, cell, plan[0]), 4: (number, cell, plan[0], k)}[world.reward.dim()]
            after, reward = number * world.num_states + to, float(world.reward[where])
            for q, states, rewards in trajectories(world, after, plan[1:]):
                found.append((p * q, (after, *states), (reward, *rewards)))
    return found


class TablePrior(Prior):
    """A prior written down: `logits[t]` of shape `[contexts, A**t, A]` are those of action t after each prefix.

    The state is the number of the prefix, the number of actions in it, and the first context.
    """

    def __init__(self, logits: list[Tensor], num_contexts: int | None = None) -> None:
        super().__init__(logits[0].shape[-1], num_contexts)
        self.logits = logits
        self.context_per = None if num_contexts is None else "plan"

    @classmethod
    def random(cls, num_actions: int, length: int, num_contexts: int | None = None, seed: int = 0) -> "TablePrior":
        generator = seeded(seed)
        shapes = [(num_contexts or 1, num_actions**t, num_actions) for t in range(length)]
        return cls([2 * torch.randn(shape, generator=generator) for shape in shapes], num_contexts)

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        state = torch.zeros(batch_size, 3, dtype=torch.long)
        if context is not None:
            state[:, 2] = context
        return self.logits[0][state[:, 2], 0], state

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        assert len(state[:, 1].unique()) <= 1
        state = torch.stack([state[:, 0] * self.num_actions + action, state[:, 1] + 1, state[:, 2]], 1)
        depth = int(state[0, 1]) if len(state) else 0
        return self.logits[depth][state[:, 2], state[:, 0]], state

    def fit(self, plans: Any, *, generator: torch.Generator | None = None, **settings: Any) -> "TablePrior":
        raise NotImplementedError


def distribution(prior: Prior, length: int, context: Tensor | None = None, temperature: float = 1.0) -> Tensor:
    """`[A**L]`: the probability of every plan, from `forward`; `context` is that of one plan, without a batch."""
    plans = every_plan(prior.num_actions, length)
    if context is not None:
        context = expand_context(context.expand(len(plans), *context.shape), length)
    with torch.no_grad():
        log_probs = (prior(plans, context).double() / temperature).log_softmax(-1)
    return log_probs.gather(-1, plans[..., None])[..., 0].sum(-1).exp()


def in_world_distribution(
    prior: Prior, world: TabularWorld, start: int, length: int, temperature: float = 1.0
) -> Tensor:
    """`[A**L]`, plan by plan: walk, mask what is not legal, multiply."""
    plans, probs = every_plan(world.num_actions, length), []
    for plan in plans:
        state, cells = torch.tensor([start]), []
        for action in plan:
            cells.append(world.cell(state))
            state, _ = world.step(state, action[None])
        if prior.context_per is None:
            context = None
        else:
            context = torch.stack(cells, 1) if prior.context_per == "step" else cells[0]
        with torch.no_grad():
            logits = prior(plan[None], context)[0].double() / temperature
        p = 1.0
        for t, action in enumerate(plan):
            legal = world.legal_actions(cells[t])[0]
            weight = logits[t].softmax(-1) * legal
            p *= float(weight[action] / weight.sum())
        probs.append(p)
    return torch.tensor(probs, dtype=torch.double)


def says(error: Exception, *words: str) -> bool:
    """Whether the message is one line of a sensible length that has all `words` in it."""
    text = str(error)
    assert "\n" not in text, text
    assert len(text) < 400, text
    assert all(word in text for word in words), text
    return True


def refuses(*words: str, error: type[Exception] = ValueError) -> AbstractContextManager[None]:
    """What is done within must raise `error` with a message that `says` the words."""
    assert all(isinstance(word, str) for word in words), "with refuses(...): nothing else is done by it"
    return _refusing(words, error)


@contextmanager
def _refusing(words: tuple[str, ...], error: type[Exception]) -> Iterator[None]:
    with pytest.raises(error) as caught:
        yield
    assert says(caught.value, *words)


CORRIDOR = torch.tensor([[0, 1], [0, 2], [1, 3], [2, 3]])  # four cells in a row; actions left, right; walls at the ends


def corridor(reward=(0.0, 0.0, 0.0, 0.0), legal=None):
    return TabularWorld(CORRIDOR.clone(), torch.as_tensor(reward), legal)


def distances(height, width, goal, torus):
    """Steps to the goal from each cell `[height * width]`, from the coordinates alone."""
    cell = torch.arange(height * width)
    rows, columns = (cell // width - goal // width).abs(), (cell % width - goal % width).abs()
    if torus:
        rows, columns = torch.minimum(rows, height - rows), torch.minimum(columns, width - columns)
    return rows + columns
