"""The cross-entropy planner: it refits as its docstring says, to the best plans, in every kind of world."""

import pytest
import torch

from neuroprior import GRUPrior, MarkovPrior, SamplingPlanner, TabularWorld, UniformPrior
from neuroprior.planners import CrossEntropyPlanner
from neuroprior.planners.cross_entropy import RefittedPrior, _places
from neuroprior.sampling.draws import LEAST_TEMPERATURE
from neuroprior.worlds import cube
from tests.support.sources import every_plan, fits, random_world, refuses, seeded, stochastic_world

WALK = every_plan(3, 4)


def refitted(order, counts, strength=2.0, temperature=1.0):
    prior = MarkovPrior(3, 2).fit(torch.randint(3, (200, 6), generator=seeded(0)))
    return prior, RefittedPrior(prior, counts, order, strength, temperature)


@pytest.mark.parametrize("order", [None, 1, 2])
@pytest.mark.parametrize("temperature", [1.0, 0.5])
def test_it_draws_from_counts_and_prior_together(order, temperature):
    """Against (n(a) + s p(a)) / (n + s), worked out for every plan of four actions, for two starts."""
    histories = 4 if order is None else 4**order
    counts = torch.randint(6, (2, histories, 3), generator=seeded(1)).float()
    prior, proposer = refitted(order, counts, temperature=temperature)
    probs = (prior(WALK) / temperature).softmax(-1).gather(2, WALK[..., None])[..., 0].double()
    where = _places(WALK, 3, order)
    if order is None:
        assert where.tolist() == [[0, 1, 2, 3]] * len(WALK)
    for start in range(2):
        n = counts[start][where, WALK].double()
        total = counts[start][where].double().sum(-1)
        expected = ((n + 2 * probs) / (total + 2)).prod(1)
        assert torch.isclose(expected.sum(), torch.tensor(1.0).double(), atol=1e-5)
        plans = proposer.sample(50_000, 4, seeded(start))
        assert fits(plans[start], expected, 3)


def test_places_tell_last_actions_apart():
    places = _places(WALK, 3, 2)
    before = torch.nn.functional.pad(WALK + 1, (2, 0))[:, :-1].unfold(1, 2, 1)
    assert torch.equal(places, before[..., 0] * 4 + before[..., 1])


def test_elites_are_the_best_plans_so_far():
    planner = CrossEntropyPlanner(UniformPrior(3), 4, 10, elites=0.2)
    plans = torch.stack([WALK[:10], WALK[30:40]]).to(torch.uint8)
    score = torch.tensor([[0, 1, 2, 9, 4, 5, 6, 7, 8, 3], [5, 5, 0, 0, 0, 0, 0, 0, 0, 0]]).float()
    counts = planner._elite_counts(plans, score, torch.zeros(2, 4, 3), seeded(0))
    for start, best in ((0, (3, 8)), (1, (0, 1))):
        expected = sum(torch.nn.functional.one_hot(plans[start, k].long(), 3) for k in best)
        assert torch.equal(counts[start], expected.float())


class Turns:
    """A prior that takes action 0 in the first round, action 1 in the second, and so on."""

    num_actions, device = 5, "cpu"

    def __init__(self):
        self.turn = -1

    def start(self, batch_size):
        self.turn += 1
        return self.step(None, torch.zeros(batch_size, 1))

    def step(self, action, state):
        logits = torch.full((len(state), 5), -torch.inf)
        logits[:, self.turn] = 0
        return logits, state


def test_elites_are_those_of_all_rounds():
    """Action 0 is the best; action 1, of every other candidate of the second round, is forgotten in the third."""
    world, tried = TabularWorld(torch.zeros(1, 5, dtype=torch.long), torch.tensor([[[9.0, 0, 0, 0, 0]]])), []
    rollout = world.rollout
    world.rollout = lambda state, plans, *rest: tried.append(plans) or rollout(state, plans, *rest)
    planner = CrossEntropyPlanner(Turns(), 1, 3, rounds=3, strength=1.0)
    planner.plan(world, torch.zeros(200, dtype=torch.long), seeded(0))
    assert [plans.unique().tolist() for plans in tried] == [[0], [0, 1], [0, 2]]


def test_elites_are_a_share_of_the_candidates_so_far():
    """Two candidates, of which the better is the only elite; with next to no prior it alone is tried again."""
    world, tried = TabularWorld(torch.zeros(1, 2, dtype=torch.long), torch.tensor([[[1.0, 0.0]]])), []
    rollout = world.rollout
    world.rollout = lambda state, plans, *rest: tried.append(plans) or rollout(state, plans, *rest)
    planner = CrossEntropyPlanner(UniformPrior(2), 1, 4, rounds=2, elites=0.5, strength=1e-9)
    planner.plan(world, torch.zeros(300, dtype=torch.long), seeded(0))
    assert torch.equal(tried[1], tried[0].amin(1, keepdim=True).expand(-1, 2, -1))


def test_all_candidates_are_tried_in_rounds_of_nearly_as_many(monkeypatch):
    tried, rollout = [], TabularWorld.rollout

    def count(self, state, plans, *args):
        tried.append(plans.shape[1])
        return rollout(self, state, plans, *args)

    monkeypatch.setattr(TabularWorld, "rollout", count)
    world = random_world(0)
    decision = CrossEntropyPlanner(UniformPrior(3), 2, 11, rounds=4).plan(world, world.reset(3, seeded(0)), seeded(0))
    assert tried == [2, 3, 3, 3]
    assert decision.model_steps == 11 * 2


def test_the_least_temperature_draws_the_likeliest():
    prior = MarkovPrior(3, 1).fit(torch.tensor([[0, 1, 2, 0, 1, 2]] * 5))
    planner = CrossEntropyPlanner(prior, 4, 8, rounds=2, temperature=LEAST_TEMPERATURE)
    assert planner.plan(random_world(0), torch.tensor([0]), seeded(0)).plan.shape == (1, 4)
    with refuses("temperature", "too small to divide by"):
        CrossEntropyPlanner(prior, 4, 8, temperature=LEAST_TEMPERATURE / 2)


def test_candidates_are_drawn_at_the_temperature():
    """In the only round there are no elites: chi-square against the prior at temperature 2."""
    prior, world = MarkovPrior(3, 0).fit(torch.tensor([[0] * 9, [1] * 9, [0] * 9, [2] * 9, [0] * 9])), random_world(0)
    planner, tried = CrossEntropyPlanner(prior, 1, 5000, rounds=1, temperature=2.0), []
    rollout = world.rollout
    world.rollout = lambda state, plans, *rest: tried.append(plans) or rollout(state, plans, *rest)
    planner.plan(world, torch.zeros(1, dtype=torch.long), seeded(0))
    assert fits(tried[0][0], (prior.start(1)[0][0] / 2).softmax(0), 3)


def test_it_comes_nearer_step_by_step():
    """The more of eight digits are right the better, and a sample has two of them: refitting finds nearly all."""
    table = torch.arange(9)[:, None].expand(9, 4).clone()
    right = torch.randint(4, (8,), generator=seeded(0))
    table[:8] = torch.arange(1, 9)[:, None]
    world = TabularWorld(table, torch.cat([torch.nn.functional.one_hot(right, 4), torch.zeros(1, 4)]).float())
    state = torch.zeros(200, dtype=torch.long)
    how = {"objective": "return"}
    found = CrossEntropyPlanner(UniformPrior(4), 8, 400, rounds=8, strength=1.0, **how).plan(world, state, seeded(1))
    sampled = SamplingPlanner(UniformPrior(4), 8, 400, **how).plan(world, state, seeded(1))
    assert found.score.mean() > sampled.score.mean() + 1
    assert found.model_steps == sampled.model_steps == 3200


def test_in_stochastic_worlds_and_where_not_all_is_legal():
    world, state = stochastic_world(0), torch.zeros(7, dtype=torch.long)
    planner = CrossEntropyPlanner(UniformPrior(world.num_actions), 3, 12, num_rollouts=5)
    assert planner.plan(world, state, seeded(0)).model_steps == 12 * 3 * 5
    world = random_world(0, "WSA", legal=True)
    state = world.reset(50, seeded(0))
    decision = CrossEntropyPlanner(UniformPrior(3), 4, 20, objective="return").plan(world, state, seeded(0))
    assert (decision.score > -torch.inf).all()


def test_counts_of_many_starts_are_kept_a_few_at_a_time():
    world = random_world(0)
    planner = CrossEntropyPlanner(UniformPrior(3), 4, 8, order=8)
    decision = planner.plan(world, world.reset(40, seeded(0)), seeded(0))  # 65,536 x 3 counts a start
    assert decision.plan.shape == (40, 4)
    assert CrossEntropyPlanner(UniformPrior(3), 4, 2).rounds == 2


def test_priors_with_context():
    world = cube(scramble=2)
    state = world.reset(5, seeded(0))
    prior = GRUPrior(world.num_actions, hidden_size=8, context_size=world.observe(state).shape[-1])
    decision = CrossEntropyPlanner(prior, 2, 200, any_prefix=True).plan(world, state, seeded(0))
    assert decision.score.mean() > 0.5


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ({"rounds": 0}, "rounds"),
        ({"elites": 0.0}, "elites"),
        ({"elites": 1.5}, "elites"),
        ({"order": 0}, "order"),
        ({"strength": 0.0}, "strength"),
        ({"strength": float("inf")}, "strength"),
    ],
)
def test_refuses(given, word):
    with refuses(word):
        CrossEntropyPlanner(UniformPrior(3), 4, 20, **given)


def test_refuses_orders_that_cannot_be_counted():
    world = random_world(0)
    with refuses("order"):
        CrossEntropyPlanner(UniformPrior(3), 4, 20, order=14).plan(world, world.reset(3, seeded(0)), seeded(0))
