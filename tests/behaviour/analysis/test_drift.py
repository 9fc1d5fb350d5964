"""Drift by hand, where it was planted with a known size, and where there is none; short plans and a single long one."""

import math
from itertools import pairwise, permutations

import numpy as np
import pytest
import torch
from scipy import stats

from neuroprior import Plans
from neuroprior._statistics import mean_interval, ratio_difference
from neuroprior.behaviour.analysis.drift import by_group, by_plan, by_position
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.plans.folds import BLOCKS
from tests.support.sources import refuses, seeded


def plans_of(num: int, length: int, **more) -> Plans:
    return Plans(torch.zeros(num, length).long(), 2, **more)


def noise(num: int, length: int, seed: int) -> torch.Tensor:
    return torch.randn(num, length, generator=seeded(seed), dtype=torch.double)


def test_a_line_is_found():
    """Bits that rise by 3 over a plan, exactly: the slope is 3, and each tenth has the mean of its place."""
    place = (torch.arange(40) + 0.5) / 40
    plans = plans_of(12, 40)
    found = by_position(plans, (3 * place + 1).expand(12, 40), plans.mask())
    assert found.trend.mean == pytest.approx(3)
    assert found.trend.p_value == 2.0**-11  # by signs: there is no spread
    assert [part.mean for part in found.parts] == pytest.approx([1.15 + 0.3 * k for k in range(10)])
    assert found.actions.tolist() == [48] * 10


def test_slopes_of_plans_of_equal_lengths_are_students():
    plans, bits = plans_of(9, 20), noise(9, 20, 0)
    place = ((torch.arange(20) + 0.5) / 20).numpy()
    slopes = [stats.linregress(place, row).slope for row in bits.numpy()]
    found = by_position(plans, bits, plans.mask(), 4)
    assert found.trend[:3] == pytest.approx(tuple(mean_interval(slopes)))
    assert found.trend.p_value == pytest.approx(float(stats.ttest_1samp(slopes, 0).pvalue))
    for k, part in enumerate(found.parts):
        assert part == pytest.approx(tuple(mean_interval(bits[:, 5 * k : 5 * k + 5].mean(1))))


def test_parts_of_plans_of_unlike_length():
    """Places are those of the actions in their own plan; groups are the units; what is masked does not count."""
    lengths = torch.tensor([4, 2, 1, 4])
    plans = plans_of(4, 4, lengths=lengths, group=torch.tensor([0, 0, 1, 1]))
    mask = plans.mask()
    mask[0, 3] = False
    bits = torch.arange(16.0).view(4, 4)
    found = by_position(plans, bits, mask, 2)
    # Second halves: action 2 of plan 0, 1 of plan 1; the only one of plan 2; 2 and 3 of plan 3.
    assert found.actions.tolist() == [2 + 1 + 2, 2 + 1 + 2]
    assert found.parts[0] == pytest.approx(ratio_difference([0 + 1 + 4, 12 + 13], [3, 2])[:3])
    assert found.parts[1] == pytest.approx(ratio_difference([2 + 5, 8 + 14 + 15], [2, 3])[:3])
    slopes, sizes = [], []
    for places in ([[0.125, 0.375, 0.625], [0.25, 0.75]], [[0.5], [0.125, 0.375, 0.625, 0.875]]):
        off = [np.array(row) - np.mean(row) for row in places]
        slopes.append(sum(float(row @ np.arange(len(row))) for row in off))
        sizes.append(sum(float(row @ row) for row in off))
    assert found.trend == pytest.approx(ratio_difference(slopes, sizes))


def test_short_plans_are_in_some_parts():
    plans = plans_of(3, 2)
    found = by_position(plans, torch.ones(3, 2), plans.mask(), 5)
    assert found.actions.tolist() == [0, 3, 0, 3, 0]
    assert math.isnan(found.parts[0].mean)
    assert found.parts[1] == (1, 1, 1)
    assert found.trend == (0, 0, 0, 1)
    plans = plans_of(2, 4, lengths=torch.tensor([4, 1]))
    found = by_position(plans, torch.ones(2, 4), plans.mask(), 4)
    assert found.parts[0].mean == 1
    assert math.isnan(found.parts[0].low)


def test_trends_of_a_single_plan():
    """In the plan, and over its parts."""
    plans = plans_of(1, 2000)
    bits = noise(1, 2000, 0) + torch.linspace(0, 1, 2000)
    within = by_position(plans, bits, plans.mask())
    assert within.trend.low <= 1 <= within.trend.high
    assert within.trend.p_value < 1e-6
    over = by_plan(plans, bits, plans.mask())
    assert over.item == "parts"
    assert over.bits.tolist() == pytest.approx(bits.view(BLOCKS, 50).mean(1).tolist())
    want = stats.spearmanr(np.arange(BLOCKS), over.bits.numpy())
    assert over.trend.mean == pytest.approx(float(want.statistic))
    assert over.trend.p_value == pytest.approx(float(want.pvalue))
    assert list(over.correlations) == [0]
    whole = by_group(plans, bits, plans.mask())
    assert whole.p_value is None
    assert whole.groups[0] == pytest.approx(tuple(mean_interval(over.bits)))


def test_plans_in_order_within_their_groups():
    group = torch.tensor([7, 2, 7, 2, 2, 7, 5, 7])
    plans = plans_of(8, 3, group=group, lengths=torch.tensor([3, 3, 1, 2, 3, 3, 3, 0]))
    bits = torch.tensor([5.0, 1, 4, 2, 3, 1, 9, 0])[:, None].expand(8, 3)
    found = by_plan(plans, bits, plans.mask())
    assert found.item == "sequences"
    assert found.index.tolist() == [0, 2, 5, 1, 3, 4, 6]
    assert found.group.tolist() == [7, 7, 7, 2, 2, 2, 5]
    assert found.bits.tolist() == [5, 4, 1, 1, 2, 3, 9]
    assert found.actions.tolist() == [3, 1, 3, 3, 2, 3, 3]
    assert list(found.correlations) == [7, 2]
    # Two of the six orders of three plans are as extreme.
    assert found.correlations[7] == pytest.approx((-1, -1, 1, 1 / 3))
    assert found.correlations[2] == pytest.approx((1, -1, 1, 1 / 3))
    assert found.trend.mean == pytest.approx(0)


@pytest.mark.parametrize(
    "values", [[1.0, 3, 2, 5], [1.0, 2, 2, 0, 7], [3.0, 3, 3, 3], [1.0] * 8, [1.0, 2, 2, 3, 5, 4, 7]]
)
def test_rank_correlation_of_few_plans_is_exact(values):
    plans = plans_of(len(values), 1)
    found = by_plan(plans, torch.tensor(values).double()[:, None], plans.mask()).trend
    if len(set(values)) == 1:
        assert found == (0, -1, 1, 1)
        return
    rho = float(stats.spearmanr(range(len(values)), values).statistic)
    orders, ranks = np.array(list(permutations(range(len(values))))), stats.rankdata(values)
    every = (orders - orders.mean()) @ (ranks - ranks.mean())
    every /= len(values) * orders[0].std() * ranks.std()
    assert found.mean == pytest.approx(rho)
    assert found.p_value == pytest.approx(np.mean(np.abs(every) >= abs(rho) - 1e-9))
    half = stats.norm.ppf(0.975) * np.sqrt(1.06 / (len(values) - 3))  # Fieller, Hartley and Pearson 1957
    assert (found.low, found.high) == pytest.approx(tuple(np.tanh(np.arctanh(rho) + np.array([-half, half]))))


def test_groups_of_which_all_go_the_same_way():
    """Three groups of three plans, all in order: three equal signs, which occur at random one time in four."""
    plans = plans_of(9, 1, group=torch.arange(9) // 3)
    found = by_plan(plans, torch.arange(9.0)[:, None], plans.mask()).trend
    assert found == (1, -1, 1, 0.25)


def test_groups_by_hand():
    """Costs 1, 2, 3 against 4, 5, 6: Kruskal and Wallis's H is 27 / 7."""
    costs, lengths = torch.tensor([1.0, 4, 2, 5, 3, 6, 9]), torch.tensor([2, 1, 2, 2, 1, 2, 2])
    plans = plans_of(7, 2, group=torch.tensor([3, 1, 3, 1, 3, 1, 2]), lengths=lengths)
    found = by_group(plans, costs[:, None].expand(7, 2), plans.mask())
    assert list(found.groups) == [1, 2, 3]
    assert found.groups[3] == pytest.approx(ratio_difference([2, 4, 3], [2, 2, 1])[:3])
    assert found.groups[2].mean == 9
    assert math.isnan(found.groups[2].low)
    assert found.p_value == pytest.approx(float(stats.chi2.sf(27 / 7, 1)))


def test_groups_that_do_not_differ():
    plans, same = plans_of(6, 2, group=torch.arange(6) // 2), torch.ones(6, 2)
    assert by_group(plans, same, plans.mask()).p_value == 1
    alone = plans_of(6, 2, group=torch.arange(6))
    assert by_group(alone, same, alone.mask()).p_value is None
    none = by_group(plans_of(6, 2), noise(6, 2, 0), torch.ones(6, 2).bool())
    assert none.p_value is None
    assert none.groups[0] == pytest.approx(tuple(mean_interval(noise(6, 2, 0).mean(1))))
    plans = plans_of(60, 3, group=torch.arange(60) % 2)
    assert by_group(plans, noise(60, 3, 0) + 2 * plans.group[:, None], plans.mask()).p_value < 1e-6


BITS, MASK = torch.ones(3, 4), torch.arange(4) < torch.tensor([4, 2, 3])[:, None]


@pytest.mark.parametrize("call", [by_position, by_plan, by_group])
@pytest.mark.parametrize(
    ("bits", "mask", "words"),
    [
        (BITS[:2], MASK, "`bits` must have the shape [3, 4]"),
        (BITS, MASK[0], "`mask` must be bool of shape [3, 4]"),
        (BITS, MASK.long(), "`mask` must be bool of shape [3, 4]"),
        (BITS, torch.ones(3, 4).bool(), "`mask[1, 2]` must be False, where the plan has ended"),
        (BITS.masked_fill(torch.eye(3, 4).bool(), math.nan), MASK, "`bits[0, 0]` must be finite, got nan"),
        (BITS, MASK & (torch.arange(12).view(3, 4) == 1), "`mask` must have at least two actions"),
    ],
)
def test_bits_and_masks_that_cannot_be(call, bits, mask, words):
    with refuses(words):
        call(plans_of(3, 4, lengths=torch.tensor([4, 2, 3])), bits, mask)


def test_too_few_actions():
    with refuses("`mask` must have two actions of one plan"):
        by_position(plans_of(3, 4), BITS, MASK & (torch.arange(4) == 0))
    with refuses("parts"):
        by_position(plans_of(3, 4), BITS, MASK, 0)


def test_plans_that_are_equal_but_for_rounding_do_not_differ():
    """All actions have log2(3) bits: their means over plans differ in the last digit, by the length of the plan."""
    lengths = torch.arange(5, 29)
    plans = Plans(torch.zeros(24, 28, dtype=torch.long), 3, lengths=lengths, group=torch.arange(24) // 8)
    bits = torch.full((24, 28), math.log2(3), dtype=torch.double)
    means = (bits * plans.mask()).sum(1) / lengths
    assert len(means.unique()) > 1
    assert by_group(plans, bits, plans.mask()).p_value == 1
    found = by_plan(plans, bits, plans.mask())
    assert [one[0::3] for one in found.correlations.values()] == [(0, 1)] * 3


def test_small_bits_are_ranked_too():
    """A thousandth of them as well as all: what is compared are digits of the largest."""
    bits = torch.arange(1.0, 9).double()[:, None].expand(-1, 4)
    plans = Plans(torch.zeros(8, 4, dtype=torch.long), 2)
    found = [by_plan(plans, bits * scale, plans.mask()).correlations[0] for scale in (1, 1e-3, 1e-12)]
    assert [one.mean for one in found] == [1, 1, 1]


def test_fragments_of_a_recording_drift_as_one():
    """A session with gaps is no other than the same one without: position is measured over all of it, in time."""
    whole = seeded_plans(12, 40, began=True)
    bits = torch.rand(12, 40, generator=torch.Generator().manual_seed(4)).double() + whole.began / 300
    pieces, parts = [], []
    for r in range(12):
        edges = [0, 7 + r, 19 + r, 40]
        pieces += [(r, low, high) for low, high in pairwise(edges)]
    longest = max(high - low for _, low, high in pieces)
    fields: dict[str, list[torch.Tensor]] = {"actions": [], "began": [], "bits": []}
    for r, low, high in pieces:
        pad = (0, longest - (high - low))
        for name, values in (("actions", whole.actions.long()), ("began", whole.began), ("bits", bits)):
            fields[name].append(torch.nn.functional.pad(values[r, low:high], pad))
        parts.append(high - low)
    cut = RecordedPlans(
        torch.stack(fields["actions"]), 3, torch.tensor(parts), group=whole.group[[r for r, *_ in pieces]],
        recording=[whole.recording[r] for r, *_ in pieces], began=torch.stack(fields["began"]),
    )  # fmt: skip
    cut_bits = torch.stack(fields["bits"])
    same = [(plans, some, plans.mask()) for plans, some in ((whole, bits), (cut, cut_bits))]
    positions = [by_position(*one) for one in same]
    assert positions[0].trend == pytest.approx(positions[1].trend)
    assert positions[0].actions.tolist() == positions[1].actions.tolist()
    assert by_plan(*same[0]).bits.tolist() == pytest.approx(by_plan(*same[1]).bits.tolist())
    assert by_group(*same[0]).p_value == pytest.approx(by_group(*same[1]).p_value)


def seeded_plans(num, length, began=False):
    generator = torch.Generator().manual_seed(3)
    steps = torch.rand(num, length, generator=generator, dtype=torch.float64) * torch.arange(1, num + 1)[:, None]
    return RecordedPlans(
        torch.randint(3, (num, length), generator=generator), 3, group=torch.arange(num) // 2,
        recording=[f"day {r % 2}" for r in range(num)], began=steps.cumsum(1) if began else None,
    )  # fmt: skip


def test_positions_are_measured_in_time():
    """Bits that grow with time do not grow in the same way with the number of actions, where pauses grow."""
    plans = seeded_plans(8, 30, began=True)
    low, span = plans.began[:, :1], plans.began[:, -1:] - plans.began[:, :1]
    found = by_position(plans, 2 + 3 * (plans.began - low) / span, plans.mask())
    assert found.trend.mean == pytest.approx(3)
