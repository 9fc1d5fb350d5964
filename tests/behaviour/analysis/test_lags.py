"""Information by lag against chains whose information is known, brute force and enumeration; pieces against slices."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

from neuroprior import Plans
from neuroprior.behaviour.analysis.lags import mutual_information, pieces
from neuroprior.plans.folds import BLOCKS
from tests.support.sources import FALSE_ALARM, refuses, seeded


def two_state(num: int, length: int, stay: float, generator: torch.Generator) -> Plans:
    """Chains over two actions, each repeated with probability `stay`, begun at random: eigenvalue 2 `stay` - 1."""
    moved = (torch.rand(num, length, generator=generator) >= stay).long()
    moved[:, 0] = torch.randint(2, (num,), generator=generator)
    return Plans(moved.cumsum(1) % 2, 2)


def known(stay: float, lag: int) -> float:
    """1 - H(p) for the probability p of the same action again `lag` steps later."""
    p = (1 + (2 * stay - 1) ** lag) / 2
    return 1 + p * math.log2(p) + (1 - p) * math.log2(1 - p)


def plug_in(pairs: torch.Tensor, num_actions: int) -> float:
    """The information of pairs `[M, 2]` in nats, from its definition."""
    joint = np.zeros((num_actions, num_actions))
    np.add.at(joint, (pairs[:, 0].numpy(), pairs[:, 1].numpy()), 1 / len(pairs))
    apart = joint.sum(1, keepdims=True) * joint.sum(0, keepdims=True)
    return float((joint[joint > 0] * np.log(joint[joint > 0] / apart[joint > 0])).sum())


def test_two_states():
    for found in mutual_information(two_state(2000, 100, 0.8, seeded(0)), 12, generator=seeded(1)):
        truth = known(0.8, found.lag)
        assert found.bits == pytest.approx(truth, abs=0.003), found.lag
        assert found.bits > found.critical_value or truth < 1e-4, found.lag
        assert found.pairs == 2000 * (100 - found.lag)


@pytest.mark.parametrize("num_actions", [3, 700])
def test_bias_and_error_by_hand(num_actions):
    """Against leaving out each plan and counting again; in a full table of 405 cells, or a sparse one of 22 million."""
    generator = seeded(1)
    lengths = torch.randint(2, 6, (45,), generator=generator)
    plans = Plans(torch.randint(3, (45, 5), generator=generator), num_actions, lengths)
    pairs = [torch.stack([a[: n - 1], a[1:n]], 1).long() for a, n in zip(plans.actions, lengths, strict=True)]
    whole, m = plug_in(torch.cat(pairs), 3), np.array([len(p) for p in pairs])
    without = np.array([plug_in(torch.cat(pairs[:i] + pairs[i + 1 :]), 3) for i in range(45)])
    h = m.sum() / m
    estimate = 45 * whole - ((1 - 1 / h) * without).sum()
    pseudo = h * whole - (h - 1) * without
    error = math.sqrt(((pseudo - estimate) ** 2 / (h - 1)).mean())
    found = mutual_information(plans, 1, generator=seeded(1))[0]
    assert found.bits == pytest.approx(estimate / math.log(2))
    half = (found.high - found.low) / 2
    assert half == pytest.approx(max(stats.t.ppf(0.975, 44) * error / math.log(2), found.critical_value))
    assert found.pairs == m.sum()


@pytest.mark.parametrize("phase", [torch.arange(30) % 3, torch.zeros(1).long()])
def test_period_three(phase):
    """Known from any one action: log2 3 bits at every lag, of many plans or of one."""
    found = mutual_information(Plans((phase[:, None] + torch.arange(301)) % 3, 3), 20, generator=seeded(1))
    assert [one.lag for one in found] == list(range(1, 21))
    for one in found:
        assert one.bits == pytest.approx(math.log2(3), abs=1e-3)
        assert one.low <= math.log2(3) + 1e-3
        assert one.high - one.low < 0.01


@pytest.mark.parametrize(("actions", "num", "length"), [(2, 1, 400), (5, 40, 20), (40, 10, 60)])
def test_independent_actions(actions, num, length):
    """About one set of twenty exceeds the critical value (also with 1,600 cells for 590 pairs); intervals hold 0."""
    generator, above, covered = seeded(actions), 0, 0
    sets = 200 if actions < 40 else 40
    for _ in range(sets):
        plans = Plans(torch.randint(actions, (num, length), generator=generator), actions)
        found = mutual_information(plans, 1, generator=generator)[0]
        above += found.bits > found.critical_value
        covered += found.low <= 0 <= found.high
    # The level is approximate: between 2 and 9 % is allowed.
    assert stats.binom.ppf(FALSE_ALARM, sets, 0.02) <= above <= stats.binom.isf(FALSE_ALARM, sets, 0.09)
    assert covered >= stats.binom.ppf(FALSE_ALARM, sets, 0.95)


def test_critical_value_of_a_chain():
    """At lag 12 a chain of eigenvalue e = 0.6 has no information, but (1 + e**2) / (1 - e**2) times the usual bias."""
    generator, above, critical = seeded(3), 0, []
    for _ in range(60):
        found = mutual_information(two_state(50, 72, 0.8, generator), 12, 12, generator)[11]
        above += found.bits > found.critical_value
        critical.append(found.critical_value * 2 * found.pairs * math.log(2) / (stats.chi2.ppf(0.95, 1) - 1))
    assert np.mean(critical) == pytest.approx(1.36 / 0.64, rel=0.15)
    assert above <= stats.binom.isf(FALSE_ALARM, 60, 0.09)


@pytest.mark.parametrize(("num", "length"), [(60, 30), (1, 1500)])
def test_intervals_cover_at_about_their_level(num, length):
    generator, hits = seeded(4), np.zeros(3)
    for _ in range(200):
        found = mutual_information(two_state(num, length, 0.75, generator), 3, generator=generator)
        hits += [one.low <= known(0.75, one.lag) <= one.high for one in found]
    assert (hits >= stats.binom.ppf(FALSE_ALARM, 200, 0.9)).all()


@pytest.mark.parametrize(("pairs", "few"), [(319, True), (320, False)])
def test_few_pairs_are_shuffled(pairs, few):
    """Fewer than 20 for each of the 4 x 4 degrees of freedom of five actions."""
    actions = torch.randint(5, (1, pairs + 1), generator=seeded(0))
    generator = seeded(1)
    found = mutual_information(Plans(actions, 5), 1, generator=generator)[0]
    assert found.pairs == pairs
    assert (not generator.get_state().equal(seeded(1).get_state())) == few


def test_lags_end_where_pairs_end():
    plans = Plans(torch.randint(2, (3, 6), generator=seeded(0)), 2, torch.tensor([6, 4, 1]))
    assert [one.pairs for one in mutual_information(plans)] == [8, 6, 4, 2]
    assert [one.pairs for one in mutual_information(plans, 3, skip=3)] == [4, 4, 4]
    # Numbers of groups without pairs leave no empty block.
    group = torch.arange(402) * 200
    many = Plans(torch.randint(2, (402, 3), generator=seeded(0)), 2, torch.where(group % 40200 == 0, 3, 1), group=group)
    assert [one.pairs for one in mutual_information(many)] == [4, 2]
    for wrong in (plans[2:], plans[:0], Plans(torch.zeros(1, 2).long(), 2)):
        with refuses("plans", "two pairs"):
            mutual_information(wrong)
    with refuses("skip"):
        mutual_information(plans, skip=-1)
    with refuses("max_lag"):
        mutual_information(plans, 0)


def test_groups_are_the_units():
    """Four groups of which each acts in its own way: wide intervals, and the same estimate."""
    plans = [two_state(30, 20, stay, seeded(5)).actions for stay in (0.6, 0.7, 0.9, 0.95)]
    alone = Plans(torch.cat(plans), 2)
    grouped = Plans(torch.cat(plans), 2, group=torch.arange(120) // 30)
    one, other = (mutual_information(some, 1, generator=seeded(1))[0] for some in (alone, grouped))
    assert one.bits == other.bits
    assert other.high - other.low > 2 * (one.high - one.low)


def numbered(**more) -> Plans:
    """Plans whose actions are 10 times the plan plus the step."""
    lengths = torch.tensor([5, 2, 7, 0, 3])
    return Plans(10 * torch.arange(5)[:, None] + torch.arange(7), 50, lengths, **more)


@pytest.mark.parametrize("length", [1, 3, 6, 7])
def test_all_pieces(length):
    plans = numbered()
    want = [
        plans.actions[n, t : t + length].tolist() for n in range(5) for t in range(int(plans.lengths[n]) - length + 1)
    ]
    found = pieces(plans, length, 100)
    assert found.actions.tolist() == want
    if len({row[0] // 10 for row in want}) > 1:
        _, rank = torch.tensor([row[0] // 10 for row in want]).unique(return_inverse=True)
        assert found.group.tolist() == rank.tolist()
    else:
        assert found.group.tolist() == list(range(len(want)))  # parts of the only plan


def test_pieces_keep_contexts_and_groups():
    step, features = numbered().actions.long(), torch.randn(5, 7, 2, generator=seeded(0))
    group, names = torch.tensor([1, 0, 0, 2, 1]), ["a", "b", "c"]
    found = pieces(numbered(context=step, group=group, group_names=names), 3, 100)
    assert found.context.equal(found.actions.long())
    assert found.group.equal(group[found.actions[:, 0].long() // 10])
    assert found.group_names == names
    found = pieces(numbered(context=features), 3, 100)
    plan, at = found.actions.long() // 10, found.actions.long() % 10
    assert found.context.equal(features[plan, at])
    found = pieces(numbered(context=torch.arange(5), group=torch.zeros(5).long(), group_names=["a"]), 3, 100)
    assert found.context.equal(found.actions.long() // 10)
    assert found.group.tolist() == [0] * 3 + [1] * 5 + [2]  # the plan: one group is none
    assert found.group_names is None


def test_pieces_of_a_single_plan_are_grouped_by_parts():
    found = pieces(Plans(torch.arange(100)[None] % 7, 7), 5, 1000)
    assert len(found) == 96
    assert found.group.equal(torch.arange(96) * BLOCKS // 96)


def test_pieces_may_end():
    closed = Plans(torch.randint(2, (20, 4), generator=seeded(0)), 2).with_end()
    found = pieces(closed, 3, 1000)
    assert found.lengths.tolist() == [3] * 60
    assert (found.actions[:, -1] == 2).sum() == 20


def test_pieces_are_drawn_uniformly_and_without_replacement():
    """9 of 17 starts, 3,000 times: each as often, pieces differ and are in order, and a seed determines them."""
    plans = numbered()
    generator, times = seeded(2), torch.zeros(50)
    for _ in range(3000):
        found = pieces(plans, 1, 9, generator).actions[:, 0].long()
        assert found.unique().tolist() == found.tolist()  # in the order of the plans
        times[found] += 1
    taken = times[plans.actions[plans.mask()].long()]
    assert taken.sum() == 27000
    n, p = 3000, 9 / 17
    low, high = stats.binom.ppf(FALSE_ALARM / 34, n, p), stats.binom.isf(FALSE_ALARM / 34, n, p)
    assert (low <= taken).all()
    assert (taken <= high).all()
    again = [pieces(plans, 2, 5, seeded(7)).actions for _ in range(2)]
    assert again[0].equal(again[1])


def test_pieces_bad_input():
    with refuses("length: no plan has 8 actions", "7"):
        pieces(numbered(), 8, 10)
    with refuses("length"):
        pieces(numbered()[:0], 1, 10)
    for length, most in ((0, 1), (1, 0)):
        with refuses("most" if length else "length"):
            pieces(numbered(), length, most)


def test_of_few_pairs_that_depend_the_information_is_above_what_shuffled_ones_give():
    """Twenty actions in a fixed cycle, 140 pairs: all is known of the next, and no shuffle comes near."""
    actions = (torch.arange(20)[:, None] + torch.arange(8)) % 20
    found = mutual_information(Plans(actions, 20), 2, generator=seeded(0))
    for one in found:
        assert one.bits > 2
        assert 0 < one.critical_value < one.bits
        assert one.low > 0
