"""What ensembles pass on to their experts and networks, what they choose, and weights worked out by hand."""

from typing import Any

import pytest
import torch

from neuroprior import CombinedPrior, MarkovPrior, Plans, Prior, UniformPrior
from neuroprior.priors import MixturePrior, StackedPrior
from neuroprior.priors.counts import BACKOFFS_TRIED, Chains, HistoryPrior
from neuroprior.priors.ensembles import stacked
from neuroprior.priors.ensembles.candidates import NETWORKS, ORDERS, best_chain, counting_parts, fitted_experts
from neuroprior.priors.ensembles.mixture import SHARES
from neuroprior.priors.ensembles.pooling import HeldOut
from tests.support.sources import seeded

A = 3


class Recorder(UniformPrior):
    """A prior that keeps what its `fit` was given."""

    fit_settings = ("validation", "max_steps")

    def __init__(self, num_actions: int, seed: int = 0) -> None:
        super().__init__(num_actions)
        self.seed, self.seen = seed, dict[str, Any]()

    def fit(self, plans: Any, *, generator: Any = None, **settings: Any) -> "Recorder":
        self.seen = {"plans": plans, "generator": generator} | settings
        return self


def some_plans(num: int = 40, length: int = 6, **more: Any) -> Plans:
    return Plans(torch.randint(A, (num, length), generator=seeded(0)), A, **more)


def independent(probs: list[float]) -> MarkovPrior:
    """A prior whose actions are independent, with these probabilities."""
    counts = (torch.tensor(probs) * 10_000).round().long()
    return MarkovPrior(len(probs), 0, 1e-9).fit(torch.arange(len(probs)).repeat_interleave(counts)[:, None])


def drawn(probs: list[float], num: int, length: int, seed: int = 0) -> torch.Tensor:
    return torch.multinomial(torch.tensor(probs), num * length, True, generator=seeded(seed)).view(num, length)


@pytest.mark.parametrize("kind", [MixturePrior, CombinedPrior])
@pytest.mark.parametrize("given", [True, False])
def test_experts_get_the_plans_and_settings_that_are_theirs(kind, given):
    """Those to learn from, and those held out to stop on; a setting goes to those that have it."""
    plans, held_out, generator = some_plans(), some_plans(8), seeded(3)
    expert = Recorder(A)
    validation = held_out if given else 0.25
    kind(A, [expert, MarkovPrior(A, 1)]).fit(plans, generator=generator, validation=validation, max_steps=7)
    learned, chosen_on = (plans, held_out) if given else plans.split(0.25, seeded(3))
    assert expert.seen["plans"].actions.equal(learned.actions)
    assert expert.seen["validation"].actions.equal(chosen_on.actions)
    assert expert.seen["max_steps"] == 7
    assert expert.seen["generator"] is generator


def test_networks_of_a_combined_prior_have_seeds_of_their_own_and_are_stopped_on_held_out_plans(monkeypatch):
    for name in ("gru", "stacked"):
        monkeypatch.setitem(NETWORKS, name, Recorder)
    learned, held_out, generator = some_plans(), some_plans(8), seeded(1)
    made = [
        e
        for e in fitted_experts(learned, held_out, {}, "full", generator, {"max_steps": 7}, ["gru", "stacked"]).fitted
        if type(e) is Recorder
    ]
    assert len({expert.seed for expert in made}) == len(made) == 2
    for expert in made:
        assert expert.seen == {"plans": learned, "validation": held_out, "max_steps": 7, "generator": generator}


def test_of_chains_whose_tables_fit_the_best_is_found(monkeypatch):
    """Where those of order 2 are too large, it is that of order 1, not none."""
    steps = torch.multinomial(torch.tensor([0.1, 0.7, 0.2]), 2000, True, generator=seeded(0)).view(100, 20)
    plans = Plans(steps.cumsum(1) % A, A)
    monkeypatch.setattr(HistoryPrior, "max_table_bytes", 200)
    found = best_chain([(plans[:80], plans[80:])], None)
    assert found is not None
    assert found.order == 1


def test_a_chain_is_the_best_of_all_parts_together():
    """One part speaks for an order of 2 or more, another for order 0: the larger one decides."""
    runs, noise = torch.arange(24).view(4, 6) // 2 % 2, torch.randint(2, (400, 6), generator=seeded(0))
    orders = []
    for num in (1, 390):
        parts = [(Plans(runs, 2), Plans(runs, 2)), (Plans(noise[:10], 2), Plans(noise[10 : 10 + num], 2))]
        numbers = range(len(BACKOFFS_TRIED))
        tried = [[Chains(counted, order).chain(n) for order in ORDERS for n in numbers] for counted, _ in parts]
        losses = [
            [-float(chain.log_prob(part[1]).sum()) for chain in made] for made, part in zip(tried, parts, strict=True)
        ]
        best = min(range(len(losses[0])), key=lambda n: losses[0][n] + losses[1][n])
        found = best_chain(parts, None)
        assert found is not None
        assert found.log_probs.equal(tried[0][best].log_probs)  # it has counted in the first
        orders.append(found.order)
    assert orders[0] >= 2
    assert orders[1] == 0


@pytest.mark.parametrize("shape", [(40, 6), (1, 240)])
def test_where_few_are_held_out_all_others_are_forecast_part_by_part(shape):
    grouped = {"group": torch.arange(40) % 8} if shape[0] > 1 else {}
    learned = Plans(torch.randint(A, shape, generator=seeded(0)), A, **grouped)
    few, many = some_plans(10, 6), some_plans(200, 6)
    assert [tuple(map(len, part)) for part in counting_parts(learned, many)] == [(shape[0], 200)]
    first, *parts = counting_parts(learned, few)
    assert first == (learned, few)
    assert len(parts) == 5
    assert sum(int(left_out.mask().sum()) for _, left_out in parts) == 240
    for rest, left_out in parts:
        assert int(rest.mask().sum()) + int(left_out.mask().sum()) == 240
        if grouped:
            assert not set(rest.group.tolist()) & set(left_out.group.tolist())
    assert len(counting_parts(learned[:0], few)) == 1
    assert len(counting_parts(Plans(torch.zeros(1, 1, dtype=torch.long), A), few)) == 1


@pytest.mark.parametrize(
    ("lengths", "groups", "parts"),
    [
        ([200, 4], None, 6),  # without the long plan next to nothing would be left to count in: it is cut
        ([200, 4, 4, 4], None, 6),
        ([10] * 30, [0] * 28 + [1, 2], 6),  # the groups are taken apart
        ([10] * 30, [0] * 10 + [1] * 10 + [2] * 10, 4),
        ([10] * 3000, None, 1),  # enough are held out of so many, or too few by intent
    ],
)
def test_no_part_is_forecast_from_next_to_nothing(lengths, groups, parts):
    shape = (len(lengths), max(lengths))
    group = None if groups is None else torch.tensor(groups)
    plans = Plans(torch.zeros(shape, dtype=torch.long), A, torch.tensor(lengths), group=group)
    found = counting_parts(plans, some_plans(10))
    assert len(found) == parts
    for rest, left_out in found[1:]:
        assert int(rest.mask().sum()) >= 0.4 * sum(lengths)
        if groups is not None and len(set(groups[:28])) > 1:
            assert not set(rest.group.tolist()) & set(left_out.group.tolist())


class Trained(MarkovPrior):
    """Independent actions; it counts as trained, and has learned elsewhere."""

    fit_settings = ("validation",)


@pytest.mark.parametrize(("num", "kept"), [(2, False), (40, True)])
def test_of_few_plans_a_network_has_to_be_clearly_better(num, kept):
    """It gains about .3 nats an action: on ten actions by chance, on two hundred not."""
    actions = drawn([0.7, 0.2, 0.1], 200, 5)
    learned, held_out = Plans(actions[100:], A), Plans(actions[:num], A)
    counted = MarkovPrior(A, 0, 1e6).fit(learned)  # of much smoothing: nearly uniform
    trained = Trained(A, 0, 1e-9).fit(actions)
    prior = CombinedPrior(A, [counted, trained])
    prior.learn_weights(held_out, learned=learned)
    assert (trained in prior.experts) == kept
    assert counted in prior.experts
    alone = CombinedPrior(A, [counted, trained])
    alone.learn_weights(held_out)  # without the plans that were learned from it is taken whenever it seems better
    assert trained in alone.experts


def test_of_many_plans_a_network_has_to_be_clearly_better_too():
    """It gains between .6 nats, which is enough for experts that are given, and 4 on 1,200 actions."""
    actions = torch.tensor([0] * 864 + [1] * 216 + [2] * 120)[torch.randperm(1200, generator=seeded(0))].view(240, 5)
    held_out = Plans(actions, A)
    counted = MarkovPrior(A, 0, 1e-9).fit(torch.tensor([[0] * 70 + [1] * 20 + [2] * 10]))
    trained = Trained(A, 0, 1e-9).fit(actions)
    trained.register_parameter("weight", torch.nn.Parameter(torch.zeros(1)))  # networks cost something
    for learned, kept in ((held_out, [counted]), (None, [trained])):
        prior = CombinedPrior(A, [counted, trained])
        prior.learn_weights(held_out, learned=learned)
        assert list(prior.experts) == kept


def test_powers_of_experts_that_say_the_same_are_even():
    """Nothing speaks for any: the price alone decides, which is that of being away from the geometric mean."""
    actions = drawn([0.3, 0.3, 0.4], 4, 5)
    forecasts = torch.full((4, 5, 3, A), 1 / A).log()
    held_out = HeldOut(forecasts, actions, torch.ones(4, 5, dtype=torch.bool), 5)
    assert held_out.powers(held_out.sample).tolist() == pytest.approx([1 / 3] * 3, abs=1e-6)


def test_a_fixed_share_that_gains_nothing_is_left_out():
    """Actions at random from the even mixture of two experts: with a share it is predicted as well by their pool."""
    experts = [independent([0.6, 0.2, 0.2]), independent([0.2, 0.6, 0.2])]
    plans = Plans(drawn([0.4, 0.4, 0.2], 60, 20), A)
    mixture = MixturePrior(A, experts)
    mixture.learn_weights(plans)
    assert mixture.share > 0
    prior = CombinedPrior(A, experts)
    prior.learn_weights(plans)
    assert prior.share == 0


@pytest.mark.parametrize("seed", range(4))
def test_no_other_share_is_likelier(seed):
    """With so few plans several are nearly as likely."""
    experts = [independent([0.5, 0.3, 0.2]), independent([0.2, 0.3, 0.5])]
    plans = Plans(torch.cat([drawn([0.5, 0.3, 0.2], 3, 8, seed), drawn([0.2, 0.3, 0.5], 3, 8, seed + 9)]), A)
    mixture = MixturePrior(A, experts)
    mixture.learn_weights(plans)
    best = float(mixture.log_prob(plans).sum())
    for share in SHARES:
        mixture.share = share
        assert float(mixture.log_prob(plans).sum()) <= best + 1e-4


def alternating(num: int = 30, length: int = 5) -> tuple[list[Prior], Plans]:
    """Two experts, and plans of which a third are the one's and two thirds the other's."""
    one, two = [0.7, 0.2, 0.1], [0.1, 0.2, 0.7]
    actions = torch.cat([drawn(one, num, length, 1), drawn(two, 2 * num, length, 2)])
    return [independent(one), independent(two)], Plans(actions, A)


def test_weights_of_whole_plans_do_not_depend_on_what_is_beyond_their_ends():
    """Where each plan is one expert's: what pads the plans is the other's."""
    experts, plans = alternating(8, 16)
    lengths, found = torch.arange(24) % 4 + 13, []
    for padding in range(A):
        beyond = torch.arange(40) >= lengths[:, None]
        actions = torch.nn.functional.pad(plans.actions, (0, 24)).masked_fill(beyond, padding)
        mixture = MixturePrior(A, experts)
        mixture.learn_weights(Plans(actions, A, lengths))
        found.append((mixture.share, mixture.first.tolist()))
    for share, first in found:
        assert share == 0
        assert first == pytest.approx(found[0][1], abs=1e-5)


@pytest.mark.parametrize("given", [{}, {"batch_size": 16}, {"learning_rate": 1e-3, "max_steps": 5}])
def test_the_network_of_a_stacked_prior_is_trained_as_asked_else_by_its_own_defaults(given, monkeypatch):
    prior, seen = StackedPrior(A, 8, orders=(1,), depth=2), {}
    monkeypatch.setattr(type(prior.mixer), "fit", lambda self, plans, **how: seen.update(how))
    generator = seeded(0)
    prior.fit(some_plans(), generator=generator, **given)
    assert seen == {"batch_size": 64, "learning_rate": 4e-3, "generator": generator} | given
    assert prior.mixer.window is None


def test_a_stacked_prior_reads_many_plans_in_parts(monkeypatch):
    plans = some_plans(context=torch.randint(4, (40, 6), generator=seeded(1)))
    prior = StackedPrior(A, 8, orders=(1,), depth=2, num_contexts=4)
    prior.fit(plans, generator=seeded(0), max_steps=2, progress=False)
    with torch.no_grad():
        whole = prior(plans.actions, plans.context)
        monkeypatch.setattr(stacked, "MOST_NUMBERS", 7 * 4 * A)
        assert prior(plans.actions, plans.context).equal(whole)


def test_a_stacked_prior_carries_its_state_on_without_limit():
    """Behind the plans that it learned from, too: what was long ago still matters, and steps are as whole plans."""
    prior = StackedPrior(A, 8, orders=(1,), depth=2)
    prior.fit(some_plans(length=5), generator=seeded(0), max_steps=30, progress=False)
    long = some_plans(2, 30).actions
    other = long.clone()
    other[:, 0] = (long[:, 0] + 1) % A
    with torch.no_grad():
        assert not prior(long)[:, -1].equal(prior(other)[:, -1])


def test_in_training_outputs_of_a_stacked_prior_are_dropped_too():
    """With weights that do not depend on the input, only dropout of the output makes a difference."""
    prior = StackedPrior(A, 8, dropout=0.5, orders=(1,), depth=2)
    with torch.no_grad():
        for name, weight in prior.mixer.gru.named_parameters():
            weight.fill_(1.0 if "bias" in name else 0.0)
        prior.mixer.head.weight.fill_(1.0)
        prior.mixer.head.weight[0] = 0
        previous = torch.zeros(1, 20, dtype=torch.int64)
        forecasts = torch.zeros(1, 20, prior.mixer.num_experts * A)
        for training in (True, False):
            prior.mixer.train(training)
            first, second = (prior.mixer.encode(previous, forecasts)[0] for _ in range(2))
            assert first.equal(second) != training
