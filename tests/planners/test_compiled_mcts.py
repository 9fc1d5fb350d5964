"""Tree search in one compiled loop, step by step, and by a search that evaluates the prior anew: the same decisions."""

import math

import pytest
import torch

from neuroprior import GRUPrior, MarkovPrior, MCTSPlanner, TabularWorld, TransformerPrior, UniformPrior
from neuroprior.planners import compiled_mcts
from tests.support.sources import random_world, seeded

LENGTH, ACTIONS = 4, 3


def exact_world(seed: int, kind: str = "WS", legal: bool = False) -> TabularWorld:
    """Rewards whose sums are exact, in whatever order: searches then agree bit by bit."""
    world = random_world(seed, kind, legal)
    return TabularWorld(world.next_state, (world.reward * 64).floor() / 64, world.legal_table)


def wide(prior):
    """Weights far from those of a uniform policy."""
    with torch.no_grad():
        for weights in prior.parameters():
            weights.mul_(3)
    return prior


def seeing(per: str) -> GRUPrior:
    prior = wide(GRUPrior(ACTIONS, 8, lags=2, num_contexts=random_world(0).num_states))
    prior.context_per = per
    return prior


def markov(**context) -> MarkovPrior:
    return MarkovPrior(ACTIONS, 2, **context).fit(torch.randint(ACTIONS, (50, 6), generator=seeded(0)))


PRIORS = {
    "uniform": lambda: UniformPrior(ACTIONS),
    "markov": markov,
    "gru": lambda: wide(GRUPrior(ACTIONS, 8, lags=1)),
    "gru shown the last actions": lambda: wide(GRUPrior(ACTIONS, 8, lags=16)),
    "gru past its window": lambda: wide(GRUPrior(ACTIONS, 8, lags=2, window=2)),
    "gru shown more actions than its window": lambda: wide(GRUPrior(ACTIONS, 8, lags=3, window=2)),
    "gru with contexts": lambda: seeing("step"),
    "gru with the start's context": lambda: seeing("plan"),
    "gru of two layers, in windows": lambda: wide(GRUPrior(ACTIONS, 8, num_layers=2, window=2)),
    "transformer": lambda: wide(TransformerPrior(ACTIONS, 8, num_heads=2, lags=2)),
}


def search_by(whole: bool, monkeypatch) -> None:
    """Search step by step, unless `whole`: then in one loop where it knows the world, the prior and the goal."""
    if not whole:
        monkeypatch.setattr(compiled_mcts, "can_search", lambda *given: False)


def reference(prior, world: TabularWorld, start: int, steps: int, generator, exploration: float = 1.25) -> float:
    """The best return that PUCT finds from one start: dictionaries by path, the prior evaluated anew at each node."""

    def logits(path: list[int]):
        states, context = [torch.tensor([start])], None
        for action in path:
            states.append(world.step(states[-1], torch.tensor([action]))[0])
        if prior.context_per is not None:
            seen = torch.stack([world.observe(state) for state in states], 1)
            context = seen if prior.context_per == "step" else seen[:, :1].expand_as(seen)
        return prior(torch.tensor([[*path, 0]]), context)[0, -1]

    tries, totals, closed, best, scores, left = {}, {}, set(), -math.inf, [], steps
    while left and not all((a,) in closed for a in range(ACTIONS)):
        path, state, score, fresh, mine = [], torch.tensor([start]), 0.0, None, []
        for t in range(LENGTH):
            uniform = torch.rand((1,), generator=generator)
            if fresh is None:
                draws = torch.rand((1, ACTIONS), generator=generator)[0]
                probs, merit = logits(path).double().softmax(0), {}
                children = {a: (*path, a) for a in range(ACTIONS) if (*path, a) not in closed}
                every = [(*path, a) for a in range(ACTIONS)]
                number = sum(tries.get(child, 0) for child in every)
                mean = sum(totals.get(child, 0.0) for child in every) / max(number, 1)
                for a, child in children.items():
                    own = totals[child] / tries[child] if child in tries else mean
                    span = max(scores) - min(scores) if scores else 0
                    value = (own - min(scores)) / span if span > 0 and number else 0.5
                    bonus = exploration * float(probs[a]) * math.sqrt(max(number, 1)) / (1 + tries.get(child, 0))
                    merit[a] = (value + bonus, float(draws[a]))
                action = max(merit, key=lambda a: merit[a])
                mine.append((*path, action))
                if mine[-1] not in tries:
                    fresh = t
                    if left < LENGTH - t:
                        return best
            else:
                weights = (logits(path) - logits(path).max()).exp().cumsum(0)
                action = int((weights <= uniform * weights[-1]).sum())
            path.append(action)
            state, reward = world.step(state, torch.tensor([action]))
            score += float(reward)
            left -= fresh is not None
        scores.append(score)
        best = max(best, score)
        for child in reversed(mine):
            tries[child], totals[child] = tries.get(child, 0) + 1, totals.get(child, 0.0) + score
            if len(child) == LENGTH or all((*child, a) in closed for a in range(ACTIONS)):
                closed.add(child)
    return best


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("name", PRIORS)
def test_it_finds_what_a_plain_search_does_that_evaluates_the_prior_anew(name, whole, monkeypatch):
    """From one start, with the same draws: the same score, and as many draws are left."""
    search_by(whole, monkeypatch)
    prior, world = PRIORS[name]().eval(), exact_world(1)
    planner = MCTSPlanner(prior, LENGTH, 5, objective="return")
    for seed in range(3):
        with torch.no_grad():
            want = reference(prior, world, seed, 5 * LENGTH, seeded(seed))
        found = planner.plan(world, torch.tensor([seed]), seeded(seed))
        assert float(found.score) == want


@pytest.mark.parametrize("legal", [False, True])
@pytest.mark.parametrize("name", PRIORS)
def test_both_searches_decide_alike(name, legal, monkeypatch):
    """Also where the one loop does not know the world or the goal: with values, or actions that are not legal."""
    prior, world = PRIORS[name](), exact_world(2, "WSA", legal)
    state = world.reset(9, seeded(0))
    goals = [
        {},
        {"objective": "return", "discount": 0.5, "any_prefix": True},
        {"objective": "return", "value": lambda state: (state % 5).float() / 4},
    ]
    for seed, goal in enumerate(goals):
        found, drawn = [], []
        for whole in (True, False):
            if not whole:
                search_by(whole, monkeypatch)
            generator = seeded(seed)
            planner = MCTSPlanner(prior, LENGTH, 6, temperature=0.5, **goal)
            found.append(planner.plan(world, state, generator))
            drawn.append(float(torch.rand(1, generator=generator)))
        for plain, compiled in zip(*found, strict=True):
            assert plain == compiled if not isinstance(plain, torch.Tensor) else torch.equal(plain, compiled)
        monkeypatch.undo()
        assert drawn[0] == drawn[1]


@pytest.mark.parametrize("takes", [{}, {"num_contexts": random_world(0).num_states}], ids=["blind", "seeing"])
def test_threads_that_share_many_starts_decide_as_one_thread_does(takes):
    """Some starts are finished before others: what the others draw depends on how many are left."""
    prior, world = wide(GRUPrior(ACTIONS, 64, lags=2, **takes)), exact_world(5)
    state = world.reset(1000, seeded(0))
    planner = MCTSPlanner(prior, LENGTH, 6, objective="return")
    threads, found = torch.get_num_threads(), []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            generator = seeded(1)
            found.append((*planner.plan(world, state, generator)[:4], float(torch.rand(1, generator=generator))))
    finally:
        torch.set_num_threads(threads)
    for other in found[1:]:
        for one, same in zip(found[0], other, strict=True):
            assert torch.equal(torch.as_tensor(one), torch.as_tensor(same))


def test_scores_that_are_infinite_count_as_the_extremes(monkeypatch):
    world = exact_world(3)
    reward = world.reward.masked_fill(torch.rand(world.reward.shape, generator=seeded(1)) < 0.4, -torch.inf)
    world = TabularWorld(world.next_state, reward)
    state = world.reset(20, seeded(0))
    found = MCTSPlanner(UniformPrior(ACTIONS), 3, 8).plan(world, state, seeded(0))
    search_by(False, monkeypatch)
    assert torch.equal(MCTSPlanner(UniformPrior(ACTIONS), 3, 8).plan(world, state, seeded(0)).plan, found.plan)


class Counted(MarkovPrior):
    """Writes down for how many plans it is stepped."""

    def step(self, action, state, context=None):
        self.log.append(len(action))
        return super().step(action, state, context)


def test_the_prior_is_evaluated_once_for_each_step_of_the_world():
    """Never again on the way through the tree: after each simulator step but the last of a plan."""
    world = exact_world(4)
    prior = Counted(ACTIONS, 1).fit(torch.randint(ACTIONS, (50, 6), generator=seeded(0)))
    prior.log = []
    planner = MCTSPlanner(prior, LENGTH, 10)
    decision = planner.plan(world, torch.tensor([0]), seeded(0))
    sizing = 1  # how large its states are is asked once
    assert sum(prior.log) - sizing < decision.model_steps


@pytest.mark.parametrize("whole", [False, True])
def test_refuses_a_prior_of_nans(whole, monkeypatch):
    search_by(whole, monkeypatch)
    prior = GRUPrior(ACTIONS, 8, lags=1)
    with torch.no_grad():
        prior.head.bias[1] = torch.nan
    with pytest.raises(ValueError, match="prior"):
        MCTSPlanner(prior, LENGTH, 5).plan(exact_world(0), torch.tensor([0]), seeded(0))
