"""Tree search: nothing is tried twice, everything in the end; the prior and the scores steer it."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import (
    GRUPrior,
    MarkovPrior,
    MCTSPlanner,
    TabularWorld,
    UniformPrior,
    gridworld,
    oracle,
)
from neuroprior.worlds import cube
from tests.support.sources import random_world, seeded


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 999),
    legal=st.booleans(),
    kind=st.sampled_from(["WS", "WSA"]),
    num_plans=st.integers(1, 40),
    length=st.integers(1, 4),
    exploration=st.sampled_from([0.0, 1.25, 100.0]),
)
def test_it_finds_what_the_oracle_does_in_the_end(seed, legal, kind, num_plans, length, exploration):
    """A tree of at most 3 + 9 + 27 + 81 nodes takes at most 120 x 4 steps."""
    world = random_world(seed, kind, legal)
    state = world.reset(4, seeded(seed))
    planner = MCTSPlanner(UniformPrior(3), length, num_plans, objective="return", exploration=exploration)
    decision = planner.plan(world, state, seeded(seed))
    assert decision.model_steps <= num_plans * length
    best = oracle(world, state, length, objective="return").double()
    assert (decision.score <= best + 1e-5).all()
    if num_plans >= sum(3**k for k in range(1, length + 1)):
        assert torch.allclose(decision.score.double(), best, atol=1e-5)


@pytest.mark.parametrize("temperature", [1.0, 0.1])
def test_nor_does_an_overconfident_wrong_prior_stop_it(temperature):
    """A line of five cells with a reward at its end, and a prior that goes the other way."""
    cell = torch.arange(5)
    world = TabularWorld(torch.stack([(cell - 1).clamp(min=0), (cell + 1).clamp(max=4)], 1), (cell == 4).float())
    prior = MarkovPrior(2, 0).fit(torch.zeros(200, 4).long())
    planner = MCTSPlanner(prior, 4, 30, temperature=temperature)
    assert planner.plan(world, torch.zeros(3, dtype=torch.long), seeded(0)).score.tolist() == [1.0] * 3


def test_scores_are_scaled_to_their_range():
    """Multiplied by 64 and raised by 16 (exact in binary), rewards guide the search in the same way."""
    world = gridworld(9, 9, "torus", num_worlds=3)
    reward = (world.reward * 64).floor() / 64
    state, planner, found = world.reset(40, seeded(0)), MCTSPlanner(UniformPrior(4), 6, 12), []
    for scale, rise in ((1, 0), (64, 0), (1, 16)):
        changed = TabularWorld(world.next_state, reward * scale + rise)
        found.append(planner.plan(changed, state, seeded(1)))
        assert torch.equal(found[-1].plan, found[0].plan)
        assert torch.equal(found[-1].score, found[0].score * scale + rise)


class Logged(TabularWorld):
    """A table that writes down from where steps are taken."""

    def step(self, state, action, generator=None):
        self.log += state.tolist()
        return super().step(state, action, generator)


class Fixed:
    """A prior that gives each action the same probability throughout."""

    device = "cpu"

    def __init__(self, probs):
        self.num_actions, self.probs = len(probs), torch.tensor(probs)

    def start(self, batch_size):
        return self.step(None, torch.zeros(batch_size, 1))

    def step(self, action, state):
        return self.probs.log().expand(len(state), -1), state


def by_hand(scores: list[float], probs: list[float], exploration: float, num_plans: int) -> list[int]:
    """The first actions of all simulations of PUCT, where the score of a plan of two depends on the first alone."""
    number, total, taken, left = [0] * len(probs), [0.0] * len(probs), [], 2 * num_plans
    low, high = math.inf, -math.inf
    while True:
        tries, merit = max(sum(number), 1), []
        for own, n, prob in zip(total, number, probs, strict=True):
            value = ((own / n if n else sum(total) / tries) - low) / (high - low) if high > low else 0.5
            # The first plan adds a node; after it each of its actions is tried once.
            merit.append(value + exploration * prob * math.sqrt(tries) / (1 + n) if n <= len(probs) else -math.inf)
        best = merit.index(max(merit)) if max(merit) > -math.inf else None
        cost = 2 if best is None or not number[best] else 1
        if best is None or left < cost:
            return taken
        left -= cost
        score = scores[best]
        if math.isfinite(score):
            low, high = min(low, score), max(high, score)
        else:  # counts as the lowest, or highest, so far
            score = (high if score > 0 else low) if math.isfinite(low) else 0.0
        number[best] += 1
        total[best] += score
        taken.append(best)


@pytest.mark.parametrize("exploration", [0.001, 0.5, 1.25, 4.0])
@pytest.mark.parametrize(
    "scores",
    [[0, 10, 100, 5, 3], [3, -math.inf, 7, 1, -math.inf], [2, math.inf, 1, 3, -math.inf], [-math.inf, 4, 4, 5, 4.5]],
    ids=str,
)
def test_the_tree_grows_as_puct_says(scores, exploration):
    """Each simulation takes the action that PUCT does, worked out here; infinite scores count as finite extremes."""
    probs = [0.31, 0.27, 0.21, 0.13, 0.08]
    table = torch.cat([torch.arange(1, 6)[None], *(torch.full((1, 5), 6 + a) for a in (0, 1, 2, 3, 4))])
    table = torch.cat([table, torch.arange(6, 11)[:, None].expand(5, 5)])
    world = Logged(table, torch.tensor([0.0] * 6 + scores))
    for num_plans in (1, 3, 6, 12):
        world.log = []
        planner = MCTSPlanner(Fixed(probs), 2, num_plans, exploration=exploration)
        decision = planner.plan(world, torch.tensor([0]), seeded(0))
        taken = by_hand(scores, probs, exploration, num_plans)
        assert [state - 1 for state in world.log if 1 <= state <= 5] == taken
        assert float(decision.score[0]) == max(scores[a] for a in taken)
        assert decision.model_steps == len(world.log) == len(taken) + len(set(taken))


@pytest.mark.parametrize("any_prefix", [False, True])
def test_with_prefixes_a_plan_is_worth_its_best_one(any_prefix):
    """Action 0 first gives 1 and then nothing, action 1 always .5: where plans may stop, most tries are of action 0."""
    world = TabularWorld(torch.tensor([[1, 3], [2, 2], [2, 2], [3, 3]]), torch.tensor([[0.0, 1.0, 0.0, 0.5]]))
    taken = []
    step = world.step
    world.step = lambda state, action, *draws: taken.extend(state.tolist()) or step(state, action, *draws)
    decision = MCTSPlanner(UniformPrior(2), 8, 20, any_prefix=any_prefix).plan(world, torch.tensor([0]), seeded(0))
    assert decision.score.tolist() == [1.0 if any_prefix else 0.5]
    shares = {first: sum(state in below for state in taken) for first, below in ((0, (1, 2)), (1, (3,)))}
    assert shares[1 - any_prefix] > 2 * shares[int(any_prefix)]


def test_other_states_than_numbers_and_priors_that_see():
    world = cube(scramble=2)
    state = world.reset(10, seeded(0))
    prior = GRUPrior(world.num_actions, hidden_size=8, context_size=world.observe(state).shape[-1])
    decision = MCTSPlanner(prior, 2, 80, any_prefix=True).plan(world, state, seeded(1))
    assert decision.score.mean() > 0.8


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_impossible_rewards_are_no_trouble(share):
    """Where some, or all, scores are infinite, plans are legal, end where is said, and the best is found."""
    world = random_world(0, "WS", legal=True)
    reward = world.reward.masked_fill(torch.rand(world.reward.shape, generator=seeded(1)) < share, -torch.inf)
    world = TabularWorld(world.next_state, reward, world.legal_table)
    state = world.reset(60, seeded(0))
    decision = MCTSPlanner(UniformPrior(3), 3, 60).plan(world, state, seeded(0))
    assert torch.equal(decision.score, oracle(world, state, 3))
    now = state
    for t in range(3):
        action = decision.plan[:, t].long()
        assert world.legal_actions(now).gather(1, action[:, None]).all()
        now = world.step(now, action)[0]
    assert torch.equal(now, decision.final_state)


@pytest.mark.slow
def test_rewards_are_as_precise_as_the_worlds():
    world = random_world(0)
    world = TabularWorld(world.next_state, world.reward.double() + 2**25)
    state = world.reset(20, seeded(0))
    decision = MCTSPlanner(UniformPrior(3), 3, 60, objective="return").plan(world, state, seeded(0))
    assert torch.allclose(decision.score, oracle(world, state, 3, objective="return"), rtol=0, atol=1e-6)


def test_the_start_that_took_most_steps_tells_how_many():
    """Before and after another one a start where little can be tried, in chunks of one."""
    table = torch.tensor([[0, 0], [2, 3], [4, 5], [6, 1], [1, 2], [3, 4], [5, 6]])
    legal = torch.ones(7, 2, dtype=torch.bool)
    legal[0, 1] = False
    world = TabularWorld(table, torch.arange(7.0), legal)
    state = torch.tensor([0, 1, 0])
    planner = MCTSPlanner(UniformPrior(2), 4, 6)
    together = planner.plan(world, state, seeded(0)).model_steps
    assert planner.plan(world, state[:1], seeded(0)).model_steps == 4 + 3 + 2 + 1
    planner.steps_at_once = 1
    assert planner.plan(world, state, seeded(0)).model_steps == together == 24


@pytest.mark.parametrize(("length", "num_plans"), [(3, 8), (5, 6)])
def test_all_of_the_budget_is_spent(length, num_plans):
    """Only steps of the world count, not those that the tree knows: of 4 ** length plans hardly any are known."""

    class Counted(TabularWorld):
        steps = 0

        def step(self, state, action, generator=None):
            self.steps += len(state)
            return super().step(state, action, generator)

    cells = torch.arange(4**length * 2)
    world = Counted(
        (cells[:, None] * 4 + torch.arange(1, 5)) % len(cells), torch.rand(1, len(cells), generator=seeded(0))
    )
    planner = MCTSPlanner(UniformPrior(4), length, num_plans, exploration=0.3, objective="return")
    decision = planner.plan(world, torch.arange(40), seeded(0))
    # What is left in the end is less than a plan of as many actions.
    assert 40 * (num_plans - 1) * length < world.steps <= 40 * decision.model_steps
    assert decision.model_steps <= num_plans * length
