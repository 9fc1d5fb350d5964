"""The combined prior: its bound, the pool's powers, initial weights against a search, which experts are kept."""

import math
from functools import cache, partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

import neuroprior
from neuroprior import (
    CombinedPrior,
    ContextTreePrior,
    GRUPrior,
    MarkovPrior,
    Plans,
    Prior,
    TransformerPrior,
    UniformPrior,
    load,
    save,
)
from neuroprior.priors import MixturePrior, StackedPrior
from neuroprior.priors.counts import BACKOFFS_TRIED, Chains, TooLargeError
from neuroprior.priors.ensembles.candidates import OF_EFFORT, ORDERS, best_chain
from neuroprior.priors.ensembles.pooling import HeldOut
from neuroprior.testing import check_prior
from tests.support.saved import content_of, rewrite
from tests.support.sources import every_plan, refuses, seeded

A, C = 3, 4
QUICK = {"max_steps": 3, "progress": False}


def some_plans(num: int = 60, length: int = 8, contexts: bool = False, seed: int = 0) -> Plans:
    """Plans of a chain of order 1 that mostly goes on to the next action."""
    steps = torch.multinomial(torch.tensor([0.1, 0.7, 0.2]), num * length, True, generator=seeded(seed))
    context = torch.randint(C, (num, length), generator=seeded(seed + 1)) if contexts else None
    return Plans(steps.view(num, length).cumsum(1) % A, A, context=context)


def independent(probs: list[float]) -> MarkovPrior:
    """A prior whose actions are independent, with these probabilities."""
    prior = MarkovPrior(len(probs), 0, 1e-9)
    prior.fit(torch.arange(len(probs)).repeat_interleave((torch.tensor(probs) * 10_000).round().long())[:, None])
    return prior


def drawn(probs: list[float], num: int = 400, length: int = 50, seed: int = 0) -> Plans:
    actions = torch.multinomial(torch.tensor(probs), num * length, True, generator=seeded(seed))
    return Plans(actions.view(num, length), len(probs))


@pytest.fixture
def few_orders(monkeypatch) -> tuple[int, ...]:
    """Chains of the first orders alone are tried: most of the time is that of counting for all of them."""
    few = tuple(ORDERS[:4])
    monkeypatch.setattr("neuroprior.priors.ensembles.candidates.ORDERS", few)
    return few


@cache
def fitted() -> CombinedPrior:
    experts = [UniformPrior(A), MarkovPrior(A, 1), ContextTreePrior(A, 3), GRUPrior(A, 8)]
    prior = CombinedPrior(A, experts).fit(some_plans(200), generator=seeded(0), **QUICK)
    assert isinstance(prior, CombinedPrior)
    return prior


def switching(num: int = 10) -> tuple[list[Prior], Plans]:
    """Two experts, each sure of its own action, and plans in which now the one is right and now the other."""
    experts: list[Prior] = [independent([0.9, 0.05, 0.05]), independent([0.05, 0.9, 0.05])]
    turn = (torch.arange(40 * num).view(num, 40) // 10) % 2
    noise = torch.multinomial(torch.tensor([0.9, 0.05, 0.05]), 40 * num, True, generator=seeded(2)).view(num, 40)
    return experts, Plans(torch.where(noise > 0, noise + turn, turn) % A, A)


@cache
def tracking() -> CombinedPrior:
    """One whose best expert changes."""
    experts, plans = switching()
    prior = CombinedPrior(A, experts)
    prior.learn_weights(plans)
    return prior


@pytest.mark.parametrize("kind", ["contexts", "features", "tracking"])
def test_it_is_a_prior(kind):
    if kind == "contexts":
        experts = [MarkovPrior(A, 1, num_contexts=C), ContextTreePrior(A, 2), GRUPrior(A, 8, num_contexts=C)]
        prior = CombinedPrior(A, experts).fit(some_plans(contexts=True), generator=seeded(0), **QUICK)
    elif kind == "features":
        plans = Plans(some_plans().actions, A, context=torch.randn(60, 8, 2, generator=seeded(1)))
        prior = CombinedPrior(A, effort="fast", context_size=2).fit(plans, generator=seeded(0), **QUICK)
    else:
        prior = tracking()
        assert prior.share > 0
    check_prior(prior, 3, 2000)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.lists(st.integers(0, A - 1), min_size=1, max_size=60), st.booleans())
@torch.no_grad()
def test_no_sequence_is_predicted_worse_than_by_the_best_expert_and_the_bound(sequence, tracks):
    prior = tracking() if tracks else fitted()
    plan = torch.tensor([sequence])
    best = max(float(expert.log_prob(plan)) for expert in prior.experts)
    assert prior.bound <= math.log(prior.tried) + 1e-5
    assert float(prior.log_prob(plan)) >= best - prior.bound - 1e-3


@torch.no_grad()
def test_a_plan_has_its_probability_in_the_mixture_of_experts_and_pool():
    prior, plans = fitted(), every_plan(A, 4)
    experts = torch.stack([e(plans).log_softmax(-1) for e in prior.experts])
    pool = (prior.powers[:, None, None, None] * experts).sum(0).log_softmax(-1)
    taken = torch.cat([experts, pool[None]]).gather(-1, plans.expand(len(prior.experts) + 1, -1, -1)[..., None])
    by_hand = (prior.first.exp()[:, None] * taken[..., 0].sum(-1).exp()).sum(0)
    assert prior.share == 0
    assert prior.log_prob(plans).exp().allclose(by_hand, atol=1e-6)
    assert float(by_hand.sum()) == pytest.approx(1, abs=1e-5)


class Sure(Prior):
    """Knows nothing but action 0: all others have no probability."""

    def start(self, batch_size, context=None):
        return torch.tensor([0.0, -torch.inf, -torch.inf]).repeat(batch_size, 1), torch.zeros(batch_size, 0)

    def step(self, action, state, context=None):
        return self.start(len(action))

    def fit(self, plans, *, generator=None, **settings):
        return self


@torch.no_grad()
@pytest.mark.parametrize("powers", [[0.5, 0.5], [0.0, 1.0]])
def test_what_an_expert_thinks_impossible_is_unlikely_in_the_pool(powers):
    """The pool takes its probability for exp(-30), also of an expert whose power is 0."""
    prior, plans = CombinedPrior(A, [Sure(A), independent([0.2, 0.3, 0.5])]), every_plan(A, 3)
    prior.powers = torch.tensor(powers)
    taken = torch.tensor([[0.0, -30.0, -30.0], torch.tensor([0.2, 0.3, 0.5]).log().tolist()])
    pool = (prior.powers[:, None] * taken).sum(0).log_softmax(-1)
    own = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.2, 0.3, 0.5]), pool.exp()
    due = sum(probs[plans].prod(1) for probs in own) / 3
    assert prior.log_prob(plans).exp().allclose(due, rtol=1e-4, atol=0)
    assert float(due.sum()) == pytest.approx(1, abs=1e-5)


def test_powers_are_found_where_the_source_is_a_pool():
    """Of 20,000 actions; the standard error of a power is below .02, and .1 a false alarm of 1e-6."""
    one, two = [0.6, 0.3, 0.1], [0.1, 0.3, 0.6]
    product = torch.tensor(one) * torch.tensor(two)
    for probs, experts, expected in (
        (product / product.sum(), [one, two], [1.0, 1.0]),
        (torch.tensor(one).sqrt() / torch.tensor(one).sqrt().sum(), [one], [0.5]),
    ):
        prior = CombinedPrior(A, [independent(p) for p in experts])
        prior.learn_weights(drawn(probs.tolist()))
        assert prior.powers.tolist() == pytest.approx(expected, abs=0.1)


def test_initial_weights_are_the_likeliest_that_are_at_least_even_over_what_was_tried():
    """Against a search over weights, for plans of which most are of one expert."""
    experts: list[Prior] = [independent([0.8, 0.1, 0.1]), independent([0.1, 0.8, 0.1])]
    plans = Plans(torch.cat([drawn([0.8, 0.1, 0.1], 300, 6).actions, drawn([0.1, 0.8, 0.1], 60, 6, 1).actions]), A)
    prior = CombinedPrior(A, experts)
    prior.learn_weights(plans)
    assert len(prior.experts) == 2
    pool = torch.stack([e(plans.actions).log_softmax(-1) for e in prior.experts])
    pool = torch.cat([pool, (prior.powers[:, None, None, None] * pool).sum(0, keepdim=True).log_softmax(-1)])
    totals = pool.gather(-1, plans.actions.expand(3, -1, -1)[..., None].long())[..., 0].sum(-1).T.double().numpy()

    def loss(weights: np.ndarray) -> float:
        return -float(np.log(np.exp(totals) @ weights).sum())

    least = 1 / prior.tried
    total = {"type": "eq", "fun": lambda weights: weights.sum() - 1}
    found = minimize(loss, np.full(3, 1 / 3), bounds=[(least, 1)] * 3, constraints=total)
    assert prior.first.exp().tolist() == pytest.approx(found.x.tolist(), abs=5e-3)


class Dear(MarkovPrior):
    """A chain that costs as much as a network."""

    def __init__(self, *args):
        super().__init__(*args)
        self.spare = torch.nn.Parameter(torch.zeros(1000))


@pytest.mark.parametrize(("share", "kept"), [(0.51, [UniformPrior]), (0.54, [Dear])])
def test_what_is_lost_without_an_expert_is_counted_by_action(share, kept):
    """Without the dear expert the loss is 2 (share - 1/2)**2 nats an action higher, to the third order: .0002, .0032.

    Of each 100 actions, the first 70 are a plan and the others another.
    """
    hundred = (torch.arange(100) < round(100 * share)).long()[torch.randperm(100, generator=seeded(0))]
    actions = torch.stack([hundred[:70], torch.cat([hundred[70:], torch.zeros(40).long()])])
    plans = Plans(actions.repeat(40, 1), 2, torch.tensor([70, 30]).repeat(40))
    prior = CombinedPrior(2, [UniformPrior(2), Dear(2, 0, 1e-9).fit(hundred[:, None])])
    prior.learn_weights(plans)
    assert [type(expert) for expert in prior.experts] == kept


@pytest.mark.parametrize(("number", "kept"), [(1, [UniformPrior]), (20, [Dear])])
def test_on_few_actions_more_may_be_lost(number, kept):
    """The loss is .0008 nats an action higher without the dear expert: of 50 actions .04 in all, of 1,000 .8."""
    half = (torch.arange(50) < 26).long()[torch.randperm(50, generator=seeded(0))]
    prior = CombinedPrior(2, [UniformPrior(2), Dear(2, 0, 1e-9).fit(half[:, None])])
    prior.learn_weights(Plans(half.repeat(number, 1), 2))
    assert [type(expert) for expert in prior.experts] == kept


def test_experts_that_add_nothing_are_left_out():
    plans = some_plans(400)
    quick, dear = MarkovPrior(A, 1).fit(plans), Dear(A, 1).fit(plans)
    even, lower = UniformPrior(A), MarkovPrior(A, 0).fit(plans)
    prior = CombinedPrior(A, [even, dear, quick, lower])
    prior.learn_weights(some_plans(400, seed=5))
    assert list(prior.experts) == [quick]
    assert prior.tried == 6
    # A chain may still propose; neither what was trained nor a uniform prior, of which plans are drawn anyway.
    assert list(prior.spare) == [lower]
    assert prior.alternatives == (quick, lower)


def test_experts_that_were_left_out_are_tried_again():
    """By plans of a source of order 1 a chain of order 0 is left out; by plans without structure the other one."""
    plans = some_plans(400)
    lower, higher = MarkovPrior(A, 0).fit(plans), MarkovPrior(A, 1).fit(plans)
    prior = CombinedPrior(A, [lower, higher])
    prior.learn_weights(some_plans(400, seed=5))
    assert (list(prior.experts), list(prior.spare)) == ([higher], [lower])
    actions = torch.multinomial(lower.start(1)[0].softmax(-1)[0], 4000, replacement=True, generator=seeded(1))
    prior.learn_weights(Plans(actions.view(400, 10), A))
    assert (list(prior.experts), list(prior.spare)) == ([lower], [higher])
    assert prior.tried == 4


def test_experts_that_were_left_out_are_saved_and_count_all_plans(tmp_path):
    """Of chains of order 0 and 1, in a source of order 1, the first is left out; it counts the held-out plans, too."""
    plans, other = some_plans(200), some_plans(200, seed=7)
    chains = [MarkovPrior(A, 0), MarkovPrior(A, 1)]
    prior = CombinedPrior(A, chains).fit(plans, generator=seeded(0))
    (left,) = prior.spare
    assert left is chains[0]
    assert left.log_prob(other).equal(MarkovPrior(A, 0).fit(plans).log_prob(other))
    again = load(save(prior, tmp_path / "combined"))
    assert isinstance(again, CombinedPrior)
    assert [type(e) for e in again.alternatives] == [MarkovPrior, MarkovPrior]
    for one, same in zip(again.alternatives, prior.alternatives, strict=True):
        assert one.log_prob(other).equal(same.log_prob(other))
    # It tries them again when it is fitted again.
    assert [type(e) for e in again.fit(plans, generator=seeded(0)).spare] == [MarkovPrior]


def test_all_given_experts_are_saved_for_the_next_fit(tmp_path):
    """Also those that are neither kept nor spare, a network with its weights among them, and in their order."""
    ordered = Plans(torch.tensor([[0, 1] * 5, [1, 0] * 5]).repeat(20, 1), 2)
    random = Plans(torch.randint(2, (40, 10), generator=seeded(0)), 2)
    prior = CombinedPrior(2, [UniformPrior(2), GRUPrior(2, 4), MarkovPrior(2, 2), MarkovPrior(2, 1)])
    prior.fit(ordered, generator=seeded(0), **QUICK)
    assert {UniformPrior, GRUPrior} == {type(e) for e in prior.left_out}
    assert prior.num_weights == 0  # sampling does not count those that forecast nothing
    folder = save(prior, tmp_path / "combined")
    again, whole = load(folder), prior.log_prob(ordered)
    assert again.log_prob(ordered).equal(whole)
    for one in (prior, again):
        one.fit(random, generator=seeded(0), **QUICK)
    assert prior.learned == again.learned
    assert [UniformPrior] == [type(e) for e in prior.experts]
    assert prior.log_prob(random).equal(again.log_prob(random))
    saved = content_of(folder)
    saved["learned"]["given"][0] = 9
    rewrite(folder, saved)
    with refuses("model.safetensors", "`given` must be the numbers of 4 experts"):
        load(folder)


@pytest.mark.parametrize("kind", [CombinedPrior, MixturePrior])
def test_a_prior_is_given_once(kind):
    twice = MarkovPrior(A, 1)
    with refuses("experts[2]", "the same prior is given twice"):
        kind(A, [twice, UniformPrior(A), twice])


@pytest.mark.parametrize("most", [10, 1000])
def test_large_tables_are_not_kept_aside(most, monkeypatch):
    monkeypatch.setattr("neuroprior.priors.ensembles.combined.LARGEST_SPARE", most)
    prior = CombinedPrior(A, [MarkovPrior(A, 0), MarkovPrior(A, 1)]).fit(some_plans(200), generator=seeded(0))
    assert len(prior.spare) == (most > 10)


def test_an_expert_that_was_left_out_and_grows_too_large_does_not_spoil_the_fit(monkeypatch):
    left = MarkovPrior(A, 0)

    def too_large(plans):
        raise TooLargeError("too large")

    monkeypatch.setattr(left, "recount", too_large)
    prior = CombinedPrior(A, [left, MarkovPrior(A, 1)]).fit(some_plans(200), generator=seeded(0))
    assert (len(prior.experts), len(prior.spare)) == (1, 0)


class ByHand(HeldOut):
    """Losses by hand of what is kept: in nats over all of `num` plans, or in tolerances; without the others it is 9."""

    def __init__(self, losses: dict[tuple[int, ...], float], num: int, length: int, experts: int, nats: bool) -> None:
        none = torch.zeros(num, length, experts, 1)
        super().__init__(none, none[..., 0, 0].long(), torch.ones(num, length).bool(), experts)
        self.losses, self.unit = losses, 1 / self.count if nats else self.tolerance()

    def combined(self, kept: list[int]) -> tuple[torch.Tensor, float]:
        return torch.tensor([float(k) for k in kept]), 1 + self.unit * self.losses.get(tuple(kept), 9.0)


@pytest.mark.parametrize(
    ("costs", "kept"), [([5, 5, 5], [0, 2]), ([9, 5, 5], [1, 2]), ([5, 5, 9], [0, 2]), ([0, 0, 0], [0, 2])]
)
def test_of_the_dearest_that_may_go_the_one_that_is_missed_least_goes(costs, kept):
    """Without the last expert too much is lost, whatever it costs."""
    losses = {(0, 1, 2): 0.0, (1, 2): 0.5, (0, 2): 0.1, (0, 1): 2.0}
    found, powers = ByHand(losses, 1, 2, 3, nats=False).choose(costs)
    assert (found, powers.tolist()) == (kept, [float(k) for k in kept])


def test_what_is_lost_is_counted_from_the_least_loss_so_far():
    """Without the first expert the loss falls by 1; without the second as well it is as at first."""
    losses = {(0, 1, 2): 0.0, (1, 2): -1.0, (2,): 0.1, (1,): 5.0}
    assert ByHand(losses, 1, 2, 3, nats=False).choose([1, 1, 1])[0] == [1, 2]


@pytest.mark.parametrize(("due", "kept"), [(4.0, [0]), (1.0, [0, 2])])
def test_what_counts_is_judged_without_the_network_that_went(due, kept):
    """The third expert, a network, adds 2 nats; of the others one is of no use."""
    nats = {(0, 1, 2): 0.0, (0, 1): 2.0, (0, 2): 0.0, (1, 2): 5.0, (0,): 1.9}
    assert ByHand(nats, 500, 4, 3, nats=True).choose([0, 0, 9], [0.1, 0.1, due])[0] == kept


@pytest.mark.parametrize(("gain", "kept"), [(0.9, [0, 1]), (1.1, [0])])
def test_an_expert_has_to_add_its_gain(gain, kept):
    """Without the second expert ten plans of two actions are a nat less likely in all."""
    assert ByHand({(0, 1): 0.0, (0,): 1.0}, 10, 2, 2, nats=True).choose([1, 1], [0.1, gain])[0] == kept


def test_weights_are_learned_on_held_out_plans_and_counts_from_all():
    """A chain of order 5 knows each training plan by heart; in the end it counts the held-out plans, too."""
    plans = Plans(torch.randint(A, (60, 8), generator=seeded(0)), A)
    training, held_out = plans[:45], plans[45:]
    prior = CombinedPrior(A, [MarkovPrior(A, 5, backoff="dirichlet", smoothing=0.01), MarkovPrior(A, 0)])
    prior.fit(training, validation=held_out)
    assert [e.order for e in prior.experts if isinstance(e, MarkovPrior)] == [0]
    again = CombinedPrior(A, [MarkovPrior(A, 0)]).fit(plans, generator=seeded(0))
    assert again.experts[0].log_prob(plans).equal(MarkovPrior(A, 0).fit(plans).log_prob(plans))


@pytest.mark.parametrize("num_contexts", [None, C])
def test_chains_are_chosen_on_the_plans_that_are_held_out(num_contexts):
    """In noise the longest chain is the likeliest only where it was learned: here twelve plans, in contexts or none."""
    plans = Plans(
        torch.randint(A, (60, 8), generator=seeded(0)), A, context=torch.randint(C, (60, 8), generator=seeded(1))
    )
    learned, held_out = plans[:12], plans[12:]

    def bits(prior: Prior, some: Plans) -> float:
        return -float(prior.log_prob(some if prior.takes_context else some.without_context()).sum())

    found = best_chain([(learned, held_out)], num_contexts)
    families = [Chains(learned, order, num_contexts) for order in ORDERS]
    tried = [family.chain(number) for family in families for number in range(len(BACKOFFS_TRIED))]
    best = min(tried, key=lambda chain: bits(chain, held_out))
    assert (found.order, found.backoff, found.smoothing) == (best.order, best.backoff, best.smoothing)
    assert bits(found, held_out) < bits(min(tried, key=lambda chain: bits(chain, learned)), held_out) - 10


@pytest.mark.parametrize(("short", "length", "seed"), [(39, 2, 0), (39, 2, 2), (10, 12, 1)])
def test_of_one_long_plan_and_short_ones_it_is_hardly_behind_the_best_of_its_experts(short, length, seed):
    """Each action comes three times in a row; whether the long plan is held out or not, enough of it is chosen on."""

    def bouts(first: int) -> Plans:
        phase = torch.randint(9, (short + 1, 1), generator=seeded(first))
        actions = (torch.arange(300) + phase) // 3 % 3
        return Plans(actions, 3, torch.tensor([300] + [length] * short))

    plans, test = bouts(0), bouts(1)
    prior = neuroprior.fit(plans, effort="fast", generator=seeded(seed), **QUICK)
    others = [MarkovPrior(3, 3).fit(plans), ContextTreePrior(3, 10).fit(plans)]
    found, *alone = (-float(one.log_prob(test).sum()) / int(test.mask().sum()) for one in (prior, *others))
    assert found < min(alone) + 0.01


@pytest.mark.parametrize(
    ("effort", "kinds"),
    [
        ("fast", {GRUPrior}),
        ("standard", {GRUPrior, StackedPrior}),
        ("full", {GRUPrior, StackedPrior, TransformerPrior}),
    ],
)
def test_effort_says_which_networks_are_trained(effort, kinds, few_orders, monkeypatch):
    trained = []

    def record(kind: type[Prior]) -> None:
        fit = kind.fit

        def recorded(self, plans, **how):
            trained.append(type(self))
            return fit(self, plans, **how)

        monkeypatch.setattr(kind, "fit", recorded)

    for kind in (GRUPrior, StackedPrior, TransformerPrior):
        record(kind)
    made = partial(CombinedPrior, effort=effort, networks=OF_EFFORT[effort])
    prior = neuroprior.fit(some_plans(contexts=True), made, generator=seeded(0), **QUICK)
    assert isinstance(prior, CombinedPrior)
    assert prior.num_contexts == C
    assert set(trained) == kinds
    # The bound counts every chain that was tried, though the best alone is an expert: without the context, and with it.
    counting = len(few_orders) * len(BACKOFFS_TRIED) + 1
    networks = {"fast": 1, "standard": 2, "full": 3}[effort]
    assert prior.tried == 1 + 2 * counting + networks + 2  # uniform first; the pool and the fixed share last


@pytest.mark.parametrize(
    ("plans", "how", "word"),
    [
        (some_plans(), {"effort": "most"}, "`effort` must be one of fast, standard, full, got 'most'"),
        (some_plans(), {"efort": "fast"}, "efort: not a setting"),
        (some_plans(), {"effort": "fast", "prior": "gru"}, "effort: for the combined prior alone"),
        (some_plans(1, 1), {}, "cannot be split"),
        (some_plans()[:0], {"prior": "markov"}, "these 0 have none"),
        (some_plans().steps(0, 0), {"prior": "markov"}, "have none"),
        (some_plans(), {"validation": 1.5}, "`validation` must be a share between 0 and 1"),
        (some_plans(), {"validation": "a tenth"}, "`validation` must be a share between 0 and 1"),
        (some_plans(), {"validation": [0.1], "prior": "gru"}, "`validation` must be a share between 0 and 1"),
        (some_plans(), {"validation": Plans(torch.zeros(3, 3, dtype=torch.long), 7)}, "got 7"),
    ],
)
def test_what_cannot_be_fitted(plans, how, word):
    with pytest.raises(ValueError, match=word):
        neuroprior.fit(plans, **how)


def test_a_prior_that_was_read_back_is_fitted_anew_as_the_one_that_was_saved(few_orders, tmp_path):
    """It tries experts of every kind again, not those alone that it kept before."""
    plans = some_plans(30)
    prior = neuroprior.fit(plans, generator=seeded(0), effort="fast", **QUICK)
    again = load(save(prior, tmp_path / "combined"))
    first, second = (p.fit(some_plans(40), generator=seeded(1), **QUICK) for p in (prior, again))
    assert (second.config, second.learned) == (first.config, first.learned)
    assert second.log_prob(plans).equal(first.log_prob(plans))


def test_the_experts_that_were_kept_are_restored(few_orders):
    """As where an agent is restored: into a prior that was made as the saved one was."""
    plans = some_plans(30)
    prior, again = CombinedPrior(A, effort="fast").fit(plans, generator=seeded(0), **QUICK), CombinedPrior(A)
    again.restore(prior.learned)
    again.load_state_dict(prior.state_dict())
    assert again.log_prob(plans).equal(prior.log_prob(plans))
