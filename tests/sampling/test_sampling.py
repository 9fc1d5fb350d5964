"""Sampling: every method has the prior's exact distribution, with contexts, temperatures and worlds."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import GRUPrior, MarkovPrior, Plans, TabularWorld, TransformerPrior, UniformPrior, World, sample
from neuroprior.control import NoisePrior
from neuroprior.sampling import ancestral, draws, sample_in_world, stepping
from neuroprior.sampling.draws import Draw
from neuroprior.sampling.states import numbers_in
from neuroprior.worlds import Features
from tests.support.sources import (
    FALSE_ALARM,
    TablePrior,
    distribution,
    every_plan,
    fits,
    in_world_distribution,
    p_value,
    plan_number,
    random_world,
    refuses,
    seeded,
    stochastic_world,
)

A = 3
METHODS = ("ancestral", "tree", "auto")
RANDOM_PLANS = torch.randint(A, (50, 3), generator=seeded(0)) * torch.randint(2, (50, 3), generator=seeded(1))
PRIORS = {
    "table": TablePrior.random(A, 4),
    "uniform": UniformPrior(A),
    "markov": MarkovPrior(A, 2).fit(RANDOM_PLANS),
    "gru": GRUPrior(A, hidden_size=8, window=2).eval(),
    "transformer": TransformerPrior(A, width=8, num_heads=2, window=2).eval(),
}


def few_everywhere(monkeypatch):
    """The CPU is a device on which plans that begin alike are not looked for."""
    monkeypatch.setitem(draws.FEW, "cpu", 2**62)


@pytest.mark.parametrize("method", [*METHODS, "few for a device"])
@pytest.mark.parametrize("kind", PRIORS)
def test_samples_fit_log_prob(method, kind, monkeypatch):
    if method not in METHODS:
        few_everywhere(monkeypatch)
    plans = PRIORS[kind].sample(60_000, 4, generator=seeded(0), method=method if method in METHODS else "auto")
    assert plans.shape == (60_000, 4)
    assert plans.dtype == torch.uint8
    assert fits(plans, distribution(PRIORS[kind], 4), A)
    assert fits(plans[:20_000], distribution(PRIORS[kind], 4), A)


@pytest.mark.parametrize(("method", "num"), [("auto", 700), ("ancestral", 40), ("tree", 40)])
def test_small_samples_fit_too(method, num):
    """700 plans: "auto" shares the first actions and draws the rest plan by plan."""
    prior, generator = TablePrior.random(A, 5, seed=1), seeded(0)
    plans = torch.cat([sample(prior, num, 5, generator=generator, method=method) for _ in range(16_000 // num)])
    assert fits(plans, distribution(prior, 5), A)


@pytest.mark.parametrize("method", METHODS)
def test_order_is_random(method):
    """Halves have the distribution of the whole, and neighbours are independent."""
    prior = TablePrior.random(A, 4)
    probs = distribution(prior, 4)
    plans = sample(prior, 80_000, 4, generator=seeded(1), method=method)
    assert fits(plans[:40_000], probs, A)
    assert fits(plans[40_000:], probs, A)
    number = plan_number(plans[:, :2], A).view(-1, 2)
    first = probs.view(9, 9).sum(1)
    assert p_value(number[:, 0] * 9 + number[:, 1], torch.outer(first, first).flatten()) > FALSE_ALARM


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("temperature", [0.3, 2.5])
def test_temperature(method, temperature):
    prior = PRIORS["table"]
    plans = sample(prior, 60_000, 4, temperature=temperature, generator=seeded(2), method=method)
    assert fits(plans, distribution(prior, 4, temperature=temperature), A)
    assert not fits(plans, distribution(prior, 4), A)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("temperature", [1e-3, draws.LEAST_TEMPERATURE])
def test_a_low_temperature_takes_the_most_probable(method, temperature):
    prior = TablePrior([torch.tensor([[[-300.0, -1.0, -2.0]]])])
    plans = sample(prior, 1000, 1, temperature=temperature, generator=seeded(0), method=method)
    assert plans.unique().tolist() == [1]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("never", [[0], [1], [2], [0, 1], [0, 2], [1, 2]])
def test_impossible_actions_are_never_drawn(method, never):
    prior = TablePrior.random(A, 3, seed=4)
    for logits in prior.logits:
        logits[..., never] = -torch.inf
    plans = sample(prior, 100_000, 3, generator=seeded(5), method=method)
    assert not set(plans.unique().tolist()) & set(never)
    if len(never) == 1:
        assert fits(plans, distribution(prior, 3).nan_to_num(0), A)


@pytest.mark.parametrize("never", [[0], [2], [0, 1], [1, 2]])
@pytest.mark.parametrize("uniform", [0.0, 1 - 2**-24])
def test_nor_at_the_ends_of_the_uniform_distribution(never, uniform, monkeypatch):
    """Where `torch.rand` gives its smallest or largest number."""
    prior = TablePrior.random(A, 3, seed=4)
    for logits in prior.logits:
        logits[..., never] = -torch.inf
    monkeypatch.setattr(torch, "rand", lambda size, dtype=None, **_: torch.full(size, uniform, dtype=dtype))
    plans = sample(prior, 100, 3, generator=seeded(5), method="ancestral")
    assert not set(plans.unique().tolist()) & set(never)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("num", [60_000, 90])
def test_each_plan_has_the_distribution_of_its_context(method, num):
    """In any order of the contexts, one of them rare, one absent."""
    prior, generator = TablePrior.random(A, 3, num_contexts=4, seed=2), seeded(3)
    context = torch.tensor([0, 2, 2, 0, 2, 3] * (num // 6))
    context = context[torch.randperm(num, generator=generator)]
    rounds = 60_000 // num
    plans = torch.stack([sample(prior, num, 3, context, generator=generator, method=method) for _ in range(rounds)])
    for c in (0, 2, 3):
        here, probs = plans[:, context == c].flatten(0, 1), distribution(prior, 3, torch.tensor(c))
        assert fits(here, probs, A)
        assert fits(here[: len(here) // 2], probs, A)


def after(prior, past, length, context=None):
    """`[A**length]`: the probability of each plan, given that the actions `past` came before."""
    probs = distribution(prior, len(past) + length, context).view(A ** len(past), -1)[plan_number(past[None], A)[0]]
    return probs / probs.sum()


@pytest.mark.parametrize("per", ["plan", "step"])
def test_each_plan_goes_on_from_its_own_past_under_its_own_context(per):
    """A context per step begins with those of the past."""
    generator = seeded(0)
    pasts = torch.tensor([[0, 1], [2, 2]])
    contexts = torch.tensor([0, 2] if per == "plan" else [[0, 1, 2, 0], [2, 0, 0, 1]])
    known = torch.randint(3, (90,) if per == "plan" else (90, 4), generator=generator)
    learned = Plans(torch.randint(A, (90, 4), generator=generator), A, context=known)
    prior = MarkovPrior(A, 2, num_contexts=3).fit(learned)
    which = torch.randint(2, (40_000,), generator=generator)
    plans = prior.sample(40_000, 2, contexts[which], past=pasts[which].to(torch.uint8), generator=generator)
    for row in range(2):
        assert fits(plans[which == row], after(prior, pasts[row], 2, contexts[row]), A)
        assert not fits(plans[which == row], after(prior, pasts[1 - row], 2, contexts[row]), A)


@pytest.mark.parametrize(
    ("past", "words"),
    [
        (torch.tensor([0, 3]), "past[1]: 3"),
        (torch.tensor([0.5]), "`past` must be integers"),
        (torch.zeros(4, 2, dtype=torch.long), "`past` must be actions [T] or [5, T], got [4, 2]"),
        (torch.tensor(1), "`past` must be actions [T] or [5, T], got []"),
    ],
)
def test_a_past_that_cannot_be(past, words):
    with refuses(words):
        sample(PRIORS["markov"], 5, 2, past=past)
    per_step = MarkovPrior(A, 1, num_contexts=2)
    with refuses("context: 4 steps are in the past and to be sampled, but it has only 3"):
        sample(per_step, 5, 2, torch.zeros(5, 3, dtype=torch.long), past=torch.tensor([0, 1]))


class Echo:
    """A prior of three actions that does what its context says: an action or features, once or for each step."""

    num_actions = 3

    def __init__(self, per):
        self.context_per = per

    def start(self, number, context):
        action = context.argmax(-1) if context.is_floating_point() else context
        return torch.nn.functional.one_hot(action, 3).log(), action[:, None]

    def step(self, action, state, context=None):
        return self.start(len(action), state[:, 0] if self.context_per == "plan" else context)


@pytest.mark.parametrize("batch_size", [7, 900, 65_536])
@pytest.mark.parametrize("features", [False, True])
@pytest.mark.parametrize("per", ["plan", "step"])
@pytest.mark.parametrize("method", METHODS)
def test_each_plan_follows_its_own_context(per, features, method, batch_size):
    """In whatever batches plans are drawn, and however those of one context are drawn together."""
    due = torch.randint(3, (2000, 4) if per == "step" else (2000,), generator=seeded(0))
    context = torch.nn.functional.one_hot(due, 3).float() if features else due
    plans = sample(Echo(per), 2000, 4, context, generator=seeded(1), method=method, batch_size=batch_size)
    assert torch.equal(plans.long(), due if per == "step" else due[:, None].expand(-1, 4))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", [(0, 4), (5, 0), (0, 0), (1, 1), (1, 4)])
@pytest.mark.parametrize("contexts", [None, 2])
def test_sizes(method, size, contexts):
    context = None if contexts is None else torch.arange(size[0]) % 2
    plans = sample(TablePrior.random(A, 4, contexts), *size, context, generator=seeded(0), method=method)
    assert plans.shape == size
    assert plans.dtype == torch.uint8


@pytest.mark.parametrize("method", ["ancestral", "auto"])
def test_batches_bound_memory_and_change_nothing_else(method):
    prior, largest = TablePrior.random(A, 6), []
    step = prior.step

    def watched(action, state, context=None):
        largest.append(len(action))
        return step(action, state, context)

    prior.step = watched
    plans = sample(prior, 20_000, 6, generator=seeded(0), method=method, batch_size=999)
    assert max(largest) <= (999 if method == "ancestral" else 20_000 // 8)
    assert fits(plans, distribution(TablePrior.random(A, 6), 6), A)


@pytest.mark.parametrize("prior", [GRUPrior(3, 600), TransformerPrior(3, 256)], ids=["gru", "transformer"])
def test_parts_that_fit_a_cache_draw_the_same_plans(prior):
    """States so large that 2,500 plans are drawn in three parts, against stepping all plans together."""
    plans = sample(prior, 2500, 4, generator=seeded(0), method="ancestral")
    draw = Draw(3, 1.0, seeded(0))
    with torch.no_grad():
        logits, state = prior.start(2500)
        assert 2**19 // (numbers_in(state) // 2500) < 1024
        uniform = draw.uniform((4, 2500), logits)
        for t in range(4):
            action = draw.actions(logits, uniform[t])
            assert torch.equal(plans[:, t].long(), action)
            logits, state = prior.step(action, state)


def test_a_tree_evaluates_each_prefix_once():
    prior, sizes = UniformPrior(A), []
    step = prior.step
    prior.step = lambda action, state, context=None: sizes.append(len(action)) or step(action, state, context)
    sample(prior, 1_000_000, 4, generator=seeded(0))
    assert sizes == [3, 9, 27]


@settings(max_examples=60, deadline=None)
@given(
    num=st.integers(-3, 4),
    length=st.integers(-3, 4),
    temperature=st.sampled_from([1.0, 0.0, -1.0, 1e-300, float("nan"), float("inf")]),
    method=st.sampled_from([*METHODS, "beam", None]),
    context=st.sampled_from([None, torch.zeros(5).long(), torch.zeros(4, 1).long()]),
)
def test_refuses(num, length, temperature, method, context):
    prior = TablePrior.random(A, 4, None if context is None else 2)
    bad = num < 0 or length < 0 or temperature != 1 or method not in METHODS or context is not None
    if context is not None and num == 4 and context.dim() == 2 and length in (0, 1):
        return
    if bad:
        with refuses():
            sample(prior, num, length, context, temperature=temperature, method=method)
    else:
        assert sample(prior, num, length, method=method).shape == (num, length)


def world_prior(per):
    if per is None:
        return PRIORS["markov"]
    generator = seeded(11)
    contexts = torch.randint(6, (80, 4) if per == "step" else (80,), generator=generator)
    return MarkovPrior(A, 1, num_contexts=6, smoothing=0.5).fit(
        Plans(torch.randint(A, (80, 4), generator=generator), A, context=contexts)
    )


@pytest.mark.parametrize("few", [False, True])
@pytest.mark.parametrize("per", [None, "plan", "step"])
@pytest.mark.parametrize("legal", [False, True])
def test_in_world(per, legal, few, monkeypatch):
    if few:
        few_everywhere(monkeypatch)
    world, prior, starts = random_world(3, "WSA", legal=legal), world_prior(per), torch.tensor([4, 9])
    how = {"temperature": 0.8, "generator": seeded(0)}
    plans, rollout = sample_in_world(prior, world, starts, 30_000, 3, **how, keep_states=few)
    assert plans.shape == (2, 30_000, 3)
    assert plans.dtype == torch.uint8
    want = world.rollout(starts, plans, keep_states=True)
    assert torch.equal(rollout.final_state, want.final_state)
    assert torch.equal(rollout.rewards, want.rewards)
    assert torch.equal(rollout.states, want.states) if few else rollout.states is None
    for i in range(2):
        probs = in_world_distribution(prior, world, int(starts[i]), 3, temperature=0.8)
        assert (probs == 0).any() == legal
        assert fits(plans[i], probs, A)
        assert fits(plans[i, :10_000], probs, A)  # in random order, though they grew on one tree


def test_in_world_few_plans_from_each_of_many_starts_fit_the_distribution():
    """So few that they are drawn one by one, and begin alike often."""
    world, generator = random_world(3), seeded(1)
    weights = torch.tensor([8.0, 1.0, 0.5])[:A]
    prior = MarkovPrior(A, 1).fit(Plans(torch.multinomial(weights, 4_000, True, generator=generator).view(1_000, 4), A))
    starts = torch.full((3_000,), 4)
    plans, rollout = sample_in_world(prior, world, starts, 16, 3, generator=generator)
    want = world.rollout(starts, plans)
    assert torch.equal(rollout.final_state, want.final_state)
    assert torch.equal(rollout.rewards, want.rewards)
    assert fits(plans.flatten(0, 1), in_world_distribution(prior, world, 4, 3), A)


class CountingSteps(TabularWorld):
    """Counts the steps that are taken in it."""

    taken = 0

    def step(self, state, action, generator=None):
        self.taken += len(state)
        return super().step(state, action, generator)


@pytest.mark.parametrize("stochastic", [False, True])
@pytest.mark.parametrize("num_plans", [20_000, 17])
def test_in_world_plans_that_share_a_prefix_are_stepped_once(stochastic, num_plans):
    """As long as at most half as many prefixes as plans are distinct; in a stochastic world, each plan by itself."""
    known = random_world(3)
    world = CountingSteps(known.next_state, known.reward)
    world.stochastic = stochastic
    states = torch.tensor([4, 9])
    plans, rollout = sample_in_world(
        UniformPrior(A), world, states, num_plans, 3, generator=seeded(0), keep_states=True
    )
    distinct = [sum(len(own.unique(dim=0)) for own in plans[:, :, :length]) for length in (1, 2, 3)]
    shared = sum(number if number <= num_plans else 2 * num_plans for number in distinct)
    assert num_plans < 20_000 or shared == 2 * (3 + 9 + 27)
    assert world.taken == (2 * num_plans * 3 if stochastic else shared)
    want = known.rollout(states, plans, keep_states=True)
    for found, wanted in zip(rollout, want, strict=True):
        assert torch.equal(found, wanted)


def test_in_world_sizes():
    world, prior = random_world(3, legal=True), world_prior("step")
    for batch, num_plans, length in ((0, 3, 2), (2, 0, 2), (2, 3, 0)):
        plans, rollout = sample_in_world(prior, world, torch.zeros(batch).long(), num_plans, length)
        assert plans.shape == rollout.rewards.shape == (batch, num_plans, length)
        assert rollout.final_state.shape == (batch, num_plans)
        assert plans.dtype == torch.uint8


class WatchedGRU(GRUPrior):
    """Notes the distinct inputs, and the plans that they are for, of the steps in which inputs are shared."""

    def step_shared(self, action, state, context, row):
        self.shared.append((torch.stack([action, context], 1), row))
        return super().step_shared(action, state, context, row)


@pytest.mark.parametrize(("lags", "window"), [(1, None), (1, 2), (3, None), (1, 0)])
@pytest.mark.parametrize("legal", [False, True])
def test_in_world_plans_are_those_of_the_plain_path(lags, window, legal, monkeypatch):
    """In parts, on a thread each, with each observation made and read once; against all plans together, one by one."""
    world = random_world(3, "WSA", legal=legal)
    prior = WatchedGRU(A, 8, lags=lags, window=window, num_contexts=world.num_states, seed=2).eval()
    prior.shared = []
    starts, how = torch.tensor([4, 2, 1]), {"keep_states": True}
    monkeypatch.setattr(stepping, "FEWEST_TO_SHARE", 10**9)
    plain = sample_in_world(prior, world, starts, 12, 6, generator=seeded(0), **how)
    assert not prior.shared
    monkeypatch.setattr(stepping, "FEWEST_TO_SHARE", 2)
    monkeypatch.setattr(ancestral, "CACHED", 1)
    monkeypatch.setattr(ancestral, "FEWEST", 8)
    found = sample_in_world(prior, world, starts, 12, 6, generator=seeded(0), **how)
    assert found[0].equal(plain[0])
    for one, other in zip(found[1], plain[1], strict=True):
        assert one.equal(other)
    assert len(prior.shared) > 5  # as many parts, and more steps
    for inputs, row in prior.shared:
        assert len(inputs.unique(dim=0)) == len(inputs) == len(row.unique())
    assert sum(len(inputs) for inputs, _ in prior.shared) < 0.9 * sum(len(row) for _, row in prior.shared)


def test_steps_of_a_stochastic_world_are_drawn_by_the_generator():
    world, found = stochastic_world(0), []
    for seed in (1, 1, 2):
        torch.manual_seed(len(found))
        _, rollout = sample_in_world(UniformPrior(3), world, torch.zeros(50).long(), 4, 5, generator=seeded(seed))
        found.append(rollout.rewards)
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])


class Line(World):
    """States are points on a line, `[N, 1]` floating point, observed as features."""

    num_actions, observation = 2, Features(1)

    def observe(self, state):
        return state

    def reset(self, batch_size, generator=None):
        return torch.zeros(batch_size, 1)

    def step(self, state, action, generator=None):
        after = state + 2.0 * action[:, None] - 1
        return after, after[:, 0]


def test_in_a_world_of_features():
    prior = GRUPrior(2, hidden_size=8, context_size=1).eval()
    start = torch.tensor([[0.0], [3.0]])
    plans, rollout = sample_in_world(prior, Line(), start, 20_000, 3, generator=seeded(0))
    want = Line().rollout(start, plans)
    assert torch.equal(rollout.final_state, want.final_state)
    assert rollout.final_state.shape == (2, 20_000, 1)
    assert torch.equal(rollout.rewards, want.rewards)
    every = every_plan(2, 3)
    for i in range(2):
        before = torch.cat([torch.zeros(8, 1), (2.0 * every[:, :2] - 1).cumsum(1)], 1) + start[i]
        with torch.no_grad():
            probs = prior.log_prob(Plans(every, 2, context=before[..., None])).exp()
        assert fits(plans[i], probs, 2)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"prior": UniformPrior(4)}, "must have 3 actions, as the world, got 4"),
        ({"num_plans": -1}, "-1"),
        ({"length": -1}, "-1"),
        ({"temperature": 0.0}, "temperature"),
        ({"state": torch.tensor([12])}, "12"),
        ({"state": torch.tensor([0.0])}, "float32"),
    ],
)
def test_in_world_refuses(change, word):
    arguments = {"prior": UniformPrior(3), "state": torch.tensor([0]), "num_plans": 2, "length": 2}
    with refuses(word):
        sample_in_world(world=random_world(0), **(arguments | change))


def test_a_prior_over_vectors_is_refused():
    with refuses("prior", "numbered actions", "NoisePrior", "method sample"):
        sample(NoisePrior([-1.0], [1.0]), 2, 3)


def test_plans_that_are_few_for_a_device_take_each_step_at_once(monkeypatch):
    """From the first action on, each plan has a row of its own, so that no step waits for what the last one found."""
    few_everywhere(monkeypatch)
    known = random_world(3)
    world = CountingSteps(known.next_state, known.reward)
    sample_in_world(UniformPrior(A), world, torch.tensor([4, 9]), 20_000, 3, generator=seeded(0))
    assert world.taken == 2 * 20_000 * 3
    prior, rows = TablePrior.random(A, 4), []
    step = prior.step
    prior.step = lambda action, *given: rows.append(len(action)) or step(action, *given)
    sample(prior, 5_000, 4, generator=seeded(0))
    assert rows == [5_000] * 3
