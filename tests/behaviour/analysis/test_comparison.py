"""Scores with their intervals against closed forms, enumeration and simulated units; the count-based baselines."""

import math
from dataclasses import replace

import pytest
import torch

from neuroprior import ContextTreePrior, GRUPrior, MarkovPrior, Plans, UniformPrior
from neuroprior._statistics import paired_difference, ratio_difference
from neuroprior.behaviour.analysis.comparison import (
    DEPTH,
    ORDERS,
    action_bits,
    baselines,
    score,
    score_bits,
    too_few,
    unit_name,
)
from neuroprior.plans.folds import BLOCKS
from neuroprior.priors.counts import BACKOFFS_TRIED, HistoryPrior
from tests.support.sources import refuses, seeded


def test_a_ratio_by_hand():
    """Totals 2, 3, 7 over sizes 1, 2, 3: ratio 2, residuals 0, -1, 1, so an error of sqrt(3 / 2 * 2) / 6."""
    error, t = math.sqrt(3) / 6, 4.302653  # t(0.975, 2)
    found = ratio_difference(torch.tensor([2.0, 3.0, 7.0]), [1, 2, 3])
    assert found[:3] == pytest.approx((2, 2 - t * error, 2 + t * error), abs=1e-6)
    # With 2 degrees of freedom P(|T| > t) = 1 - t / sqrt(2 + t**2).
    assert found.p_value == pytest.approx(1 - (2 / error) / math.sqrt(2 + (2 / error) ** 2))


def test_a_ratio_without_spread():
    assert ratio_difference([2, 4], [1, 2]) == (2, 2, 2, 0.5)
    assert ratio_difference([0, 0], [1, 2]) == (0, 0, 0, 1)
    # A unit of size 0 is one more, and shifts nothing.
    assert ratio_difference([2, 4, 0], [1, 2, 0]).mean == 2


def test_a_ratio_of_differences_is_paired_and_antisymmetric():
    first, second, sizes = (torch.rand(9, generator=seeded(s)).double() for s in range(3))
    there, back = ratio_difference(first - second, sizes), ratio_difference(second - first, sizes)
    assert there == pytest.approx((-back.mean, -back.high, -back.low, back.p_value))
    equal = ratio_difference(first - second, torch.ones(9))
    assert equal == pytest.approx(tuple(paired_difference(first, second)))


@pytest.mark.parametrize(
    ("totals", "sizes", "word"),
    [
        ([1], [1], "totals"),
        ([1, 2], [1], "sizes"),
        ([1, 2], [1, 2, 3], "`sizes` must have 2 values"),
        ([1, 2], [0, 0], "sizes"),
        ([1, 2], [-1, 2], "sizes"),
        ([[1, 2]], [1, 2], "totals"),
        ([], [], "totals"),
    ],
)
def test_a_ratio_refuses(totals, sizes, word):
    with refuses(word):
        ratio_difference(totals, sizes)


def held_out(**more) -> Plans:
    """12 plans of up to 7 actions, of 3 actions; the third and fourth have none."""
    lengths = torch.tensor([7, 3, 0, 0, 5, 1, 2, 6, 4, 7, 3, 2])
    return Plans(torch.randint(3, (12, 7), generator=seeded(0)), 3, lengths, **more)


@pytest.mark.parametrize("per", [None, "plan", "step"])
@pytest.mark.parametrize("kind", ["markov", "gru", "tree"])
def test_score_is_what_log_prob_says(kind, per):
    context = {None: None, "plan": torch.arange(12) % 2, "step": torch.randint(2, (12, 7), generator=seeded(1))}[per]
    plans, contexts = held_out(context=context), None if per is None else 2
    if kind == "gru":
        prior = GRUPrior(3, 8, num_contexts=contexts)
    else:
        make = MarkovPrior if kind == "markov" else ContextTreePrior
        prior = make(3, 2, num_contexts=contexts).fit(plans)
    found = score("it", prior, plans)
    keep = plans.lengths > 0
    bits = -prior.log_prob(plans).detach().double()[keep] / math.log(2)
    assert found.model == "it"
    assert found.inputs == ("behaviours" if per is None else "behaviours and context")
    torch.testing.assert_close(found.bits, bits, rtol=1e-5, atol=1e-6)
    assert found.actions.tolist() == plans.lengths[keep].tolist()
    assert found.bits.dtype == found.actions.dtype == torch.float64
    total = found.bits_per_action()
    assert total.mean == pytest.approx(float(bits.sum() / 40), rel=1e-5)
    assert total == ratio_difference(found.bits, found.actions)


def units(plans: Plans) -> list[int]:
    return score("uniform", UniformPrior(plans.num_actions), plans).actions.int().tolist()


def test_units():
    assert unit_name(held_out()) == "sequences"
    assert units(held_out()) == [7, 3, 5, 1, 2, 6, 4, 7, 3, 2]
    group = torch.tensor([5, 5, 9, 9, 5, -2, -2, 5, 7, 7, 7, -2])
    assert unit_name(held_out(group=group)) == "subjects"
    # Ascending by number: -2, 5, 7; group 9 has no actions and does not count.
    assert units(held_out(group=group)) == [1 + 2 + 2, 7 + 3 + 5 + 6, 4 + 7 + 3]


@pytest.mark.parametrize("group", [None, torch.tensor([3, 3, 4])])
@pytest.mark.parametrize("length", [2, 39, 40, 41, 100, 1003])
def test_a_single_plan_is_cut_in_parts(length, group):
    """Also where the others have no actions: consecutive parts, whose sizes differ by one action at most."""
    plans = Plans(torch.arange(3 * length).view(3, length) % 3, 3, torch.tensor([0, length, 0]), group=group)
    assert unit_name(plans) == "parts of the sequence"
    found = units(plans)
    assert sum(found) == length
    assert len(found) == min(BLOCKS, length)
    assert max(found) - min(found) <= 1
    prior = MarkovPrior(3, 1).fit(plans)
    bits = -prior.action_log_probs(plans[1:2])[0].double() / math.log(2)
    want = torch.stack([part.sum() for part in bits.split(found)])
    torch.testing.assert_close(score("it", prior, plans).bits, want)


@pytest.mark.parametrize("group", [None, torch.arange(12) // 3 * 5])
def test_score_of_bits_with_a_mask(group):
    """Only what counts is summed, by unit; a unit of which nothing counts is none."""
    plans = held_out(group=group)
    surprisal = torch.rand(12, 7, generator=seeded(4))
    mask = plans.mask()
    mask[:, :2] = False
    found = score_bits("it", "actions", surprisal, plans, mask)
    unit = torch.arange(12) if group is None else group
    of = [unit == number for number in unit.unique()]
    want = [(float(surprisal[rows][mask[rows]].double().sum()), int(mask[rows].sum())) for rows in of]
    want = [(total, number) for total, number in want if number]
    assert found.bits.tolist() == pytest.approx([total for total, _ in want])
    assert found.actions.tolist() == [number for _, number in want]
    whole = score_bits("it", "actions", surprisal, plans)
    assert float(whole.actions.sum()) == 40
    assert float(whole.bits.sum()) == pytest.approx(float(surprisal[plans.mask()].sum()))
    prior = MarkovPrior(3, 1).fit(plans)
    again = score_bits("it", "actions", action_bits(prior, plans), plans)
    torch.testing.assert_close(again.bits, score("it", prior, plans).bits)
    mask[:, :] = False
    mask[0, 3] = True
    with refuses("two held-out actions", "got 1"):
        score_bits("it", "actions", surprisal, plans, mask)
    for wrong in (~plans.mask(), plans.mask().long(), plans.mask()[:1]):
        with refuses("`mask` must be bool", "behind the end of a plan"):
            score_bits("it", "actions", surprisal, plans, wrong)


def test_minus_is_paired():
    plans = held_out()
    markov, uniform = (score(p.__class__.__name__, p, plans) for p in (MarkovPrior(3, 1).fit(plans), UniformPrior(3)))
    gap = markov.minus(uniform)
    assert gap == ratio_difference(markov.bits - uniform.bits, uniform.actions)
    assert gap.mean == pytest.approx(markov.bits_per_action().mean - uniform.bits_per_action().mean)
    assert markov.minus(markov) == (0, 0, 0, 1)
    others = replace(plans, actions=(plans.actions + 1) % 3)  # of equal lengths
    for other in (held_out()[:9], held_out(group=torch.arange(12) // 4), held_out().with_end(), others):
        one = score("other", UniformPrior(other.num_actions), other)
        with refuses("MarkovPrior and UniformPrior must be scored on the same plans"):
            markov.minus(replace(one, model="UniformPrior"))


def sources(matters: bool, num: int = 400, seed: int = 0) -> Plans:
    """Plans whose context predicts (or does not predict) whether an action is mostly repeated or mostly changed."""
    context = torch.arange(num) % 2
    again = torch.rand(num, 8, generator=seeded(seed)) < torch.where(context == 1, 0.9, 0.1)[:, None]
    if not matters:
        again = torch.rand(num, 8, generator=seeded(seed)) < 0.7
    actions = torch.where(again, 0, torch.randint(1, 3, (num, 8), generator=seeded(seed + 1))).cumsum(1) % 3
    lengths = torch.randint(1, 9, (num,), generator=seeded(seed + 2))
    return Plans(actions, 3, lengths, context=context)


def bits(prior, plans: Plans) -> float:
    plans = plans if prior.takes_context else replace(plans, context=None)
    return float(-prior.log_prob(plans).double().sum() / plans.lengths.sum() / math.log(2))


@pytest.mark.parametrize("num_contexts", [None, 2])
def test_each_baseline_is_the_best_of_what_was_tried(num_contexts):
    training, validation = sources(True, 150), sources(True, 60, seed=5)
    fitted: list[str] = []
    found = list(baselines(training, validation, num_contexts, fitted.append))
    assert [baseline.model for baseline in found] == ["uniform", *(f"markov-{k}" for k in ORDERS), "context tree"]
    assert fitted == [baseline.model for baseline in found[1:]]
    assert found[0].validation_bits == pytest.approx(math.log2(3))
    assert isinstance(found[0].prior, UniformPrior)
    for order, baseline in zip(ORDERS, found[1:-1], strict=True):
        tried = {}
        for contexts in [None, num_contexts] if num_contexts else [None]:
            for backoff, smoothing in BACKOFFS_TRIED:
                prior = MarkovPrior(3, order, smoothing, num_contexts=contexts, backoff=backoff).fit(training)
                tried[contexts, backoff, smoothing] = prior
        tried_bits = {key: bits(prior, validation) for key, prior in tried.items()}
        assert baseline.validation_bits == pytest.approx(min(tried_bits.values()), abs=1e-6)
        chosen = baseline.prior.num_contexts, baseline.prior.backoff, baseline.prior.smoothing
        assert tried_bits[chosen] == pytest.approx(min(tried_bits.values()), abs=1e-6)
        assert baseline.how == f"{chosen[1]} {chosen[2]:g}"
        assert baseline.prior.order == order
        # Counted once for all, and yet what `fit` alone makes.
        alone = tried[chosen]
        assert baseline.prior.config == alone.config
        assert baseline.prior.learned == alone.learned
        for name, value in alone.state_dict().items():
            assert torch.equal(baseline.prior.state_dict()[name], value)
    tree = found[-1].prior
    trees = [
        ContextTreePrior(3, DEPTH, num_contexts=c).fit(training) for c in {None: [None], 2: [None, 2]}[num_contexts]
    ]
    assert found[-1].validation_bits == pytest.approx(min(bits(t, validation) for t in trees), abs=1e-6)
    assert isinstance(tree, ContextTreePrior)
    assert found[-1].how == f"depth {DEPTH}"


def test_baselines_that_always_take_the_context():
    """Also if the context does not help; the uniform prior, which cannot take it, is left out."""
    both = sources(False), sources(False, 50, 7)
    training, validation = (replace(plans, context=torch.arange(len(plans)) % 20) for plans in both)
    found = list(baselines(training, validation, 20, always_context=True))
    assert [baseline.model for baseline in found] == [*(f"markov-{k}" for k in ORDERS), "context tree"]
    without = {baseline.model: baseline for baseline in baselines(training, validation)}
    for baseline in found:
        assert baseline.prior.num_contexts == 20
        if baseline.model in ("markov-1", "markov-2"):
            assert baseline.validation_bits > without[baseline.model].validation_bits
    chosen = {baseline.model: baseline.validation_bits for baseline in baselines(training, validation, 20)}
    assert all(chosen[r.model] == min(r.validation_bits, without[r.model].validation_bits) for r in found)
    # Without a context nothing changes.
    same = {
        baseline.model: baseline.validation_bits for baseline in baselines(training, validation, always_context=True)
    }
    assert same == {model: baseline.validation_bits for model, baseline in without.items()}


def test_baselines_that_are_too_large(monkeypatch):
    """They have no prior, and those that are small enough go on; so do those that take no context."""
    training, validation = sources(True), sources(True, 100, seed=3)
    monkeypatch.setattr(HistoryPrior, "max_table_bytes", 4 * 3 * 2 * 60)
    found = {baseline.model: baseline for baseline in baselines(training, validation)}
    assert len(found) == len(ORDERS) + 2
    for name in ("uniform", "markov-0", "markov-1", "markov-2"):
        assert found[name].prior is not None, name
    for name in ("markov-4", "markov-5", "markov-6", "context tree"):
        assert (found[name].how, found[name].prior, found[name].validation_bits) == ("too large", None, math.inf), name
    # 1 + 3 histories and 1 opening fit, but not as often as there are contexts.
    monkeypatch.setattr(HistoryPrior, "max_table_bytes", 4 * 3 * (5 + 6))
    alone = {baseline.model: baseline for baseline in baselines(training, validation, 2)}
    assert alone["markov-1"].prior is not None
    assert alone["markov-1"].prior.num_contexts is None
    assert alone["markov-2"].prior is None


def test_baselines_of_closed_plans_know_the_end():
    training, validation = sources(False).with_end(), sources(False, 50, seed=3).with_end()
    for baseline in baselines(training, validation):
        assert baseline.prior.end == 3
        assert baseline.prior.log_prob(torch.tensor([[0, 3, 0]])).isneginf().all()


@pytest.mark.parametrize(
    ("number", "group", "cut", "says"),
    [
        (5, None, False, ""),
        (4, None, False, "4 sequences are too few for a verdict"),
        (20, torch.arange(20) % 4, False, "4 subjects are too few for a verdict"),
        (20, torch.arange(20) % 5 * 7, False, ""),
        (20, torch.zeros(20, dtype=torch.long), False, "1 subject is too few for a verdict"),
        (40, None, True, "1 sequence is too few for a verdict"),
    ],
)
def test_how_many_are_too_few(number, group, cut, says):
    plans = Plans(torch.zeros(number, 3, dtype=torch.long), 2, group=group)
    assert too_few(plans, cut=cut) == says


def test_only_units_that_count_are_counted():
    plans = Plans(torch.zeros(20, 3, dtype=torch.long), 2, group=torch.arange(20) // 4)
    mask = plans.mask()
    mask[:4] = False
    assert too_few(plans, mask) == "4 subjects are too few for a verdict"
