"""How many hidden modes there are, whether they come back, and what they do: on sources whose modes are known."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from neuroprior import Plans
from neuroprior.behaviour import (
    choose_modes,
    mode_frame,
    mode_plans,
    mode_table,
)
from neuroprior.behaviour.analysis.modes import agreements, mode_transitions
from neuroprior.priors import SwitchingPrior
from tests.support.sources import refuses, seeded


def source(num, length, seed, modes=2, stay=0.95):
    """Plans of modes that each take an action of their own in 8 of 10 steps; and their modes."""
    rng = np.random.default_rng(seed)
    mode, found, actions = rng.integers(modes, size=num), [], []
    for _ in range(length):
        found.append(mode)
        actions.append(np.where(rng.random(num) < 0.8, mode, rng.integers(4, size=num)))
        mode = np.where(rng.random(num) < stay, mode, rng.integers(modes, size=num))
    return Plans(torch.from_numpy(np.stack(actions, 1)), 4), torch.from_numpy(np.stack(found, 1))


@pytest.mark.parametrize("modes", [pytest.param(1, marks=pytest.mark.slow), 2, pytest.param(3, marks=pytest.mark.slow)])
def test_the_number_of_modes_is_found(modes):
    plans, _ = source(30, 80, seed=modes, modes=modes)
    numbers = [*range(1, modes + 2)]
    choice = choose_modes(plans, numbers, order=0, restarts=1, max_iterations=25, generator=seeded(0))
    assert choice.chosen == modes
    assert bool(choice.stable().all())
    frame = choice.frame()
    assert frame["modes"].tolist() == numbers
    assert frame.loc[frame["chosen"], "modes"].tolist() == [modes]
    assert frame["more"].min() == 0
    assert (frame["low"] < frame["bits"]).all()
    assert choice.prior is choice.priors[modes]


def chosen_by_hand(bits):
    """The rule on bits `[K, G]` of one action each: the fewest modes within an error of the best, paired."""
    best = bits.mean(1).argmin()
    more = bits - bits[best]
    error = more.std(1, ddof=1) / bits.shape[1] ** 0.5
    return int(np.argmax(more.mean(1) <= error)) + 1


def test_the_rule_is_that_of_one_standard_error_paired():
    plans, _ = source(12, 60, seed=8, stay=0.8)
    how = {"order": 0, "restarts": 1, "max_iterations": 20}
    choice = choose_modes(plans, [1, 2, 3], number_of_folds=2, **how, generator=seeded(0))
    bits = np.stack([(score.bits / score.actions).numpy() for score in choice.scores.values()])
    assert choice.chosen == chosen_by_hand(bits)
    best = bits.mean(1).argmin()
    error = (bits - bits[best]).std(1, ddof=1) / 12**0.5
    np.testing.assert_allclose(choice.frame()["error"], error, atol=1e-9)


def test_bits_are_of_held_out_groups_and_begin_after_those_left_out():
    plans, _ = source(20, 30, seed=4)
    grouped = replace(plans, group=torch.arange(20) // 4)
    choice = choose_modes(grouped, [1], order=0, mask=plans.mask() & (torch.arange(30) >= 3), generator=seeded(0))
    score = choice.scores[1]
    assert score.actions.tolist() == [4 * 27] * 5
    # each group under what the other four did
    for number in range(5):
        prior = SwitchingPrior(4, 1, 0).fit(plans[(grouped.group != number).nonzero()[:, 0]])
        bits = -prior.action_log_probs(plans[(grouped.group == number).nonzero()[:, 0]])[:, 3:].sum() / np.log(2)
        assert float(score.bits[number]) == pytest.approx(float(bits), rel=1e-5)


def test_all_actions_count_where_nothing_else_is_asked():
    plans, _ = source(6, 9, seed=4)
    plans = replace(plans, lengths=torch.tensor([9, 9, 1, 4, 9, 2]))
    choice = choose_modes(plans, [1], order=0, generator=seeded(0))
    assert choice.scores[1].actions.tolist() == plans.lengths.tolist()


def test_modes_are_matched_whatever_their_order():
    plans, _ = source(10, 40, seed=1, modes=3)
    smoothed = SwitchingPrior(4, 3, 0).fit(plans, generator=seeded(0)).posterior(plans).smoothed
    order = torch.tensor([2, 0, 1])
    torch.testing.assert_close(
        agreements(smoothed, smoothed[..., order], plans.mask()), torch.ones(3, dtype=torch.double)
    )
    noise = torch.rand(smoothed.shape, generator=seeded(0), dtype=torch.double)
    assert float(agreements(smoothed, noise / noise.sum(-1, keepdim=True), plans.mask()).max()) < 0.5
    still = torch.full_like(smoothed, 1 / 3)  # a mode that says nothing is like no other
    assert agreements(smoothed, still, plans.mask()).tolist() == [0, 0, 0]


def test_modes_that_are_an_accident_are_not_stable():
    """Actions that are independent have no modes: those that are found differ from fold to fold."""
    plans = Plans(torch.randint(4, (20, 50), generator=seeded(3)), 4)
    choice = choose_modes(plans, [1, 2], order=1, restarts=1, generator=seeded(0))
    assert choice.chosen == 1
    assert not bool(choice.stable(2).any())


def test_the_frame_has_a_row_an_action():
    plans, _ = source(6, 10, seed=2)
    plans = replace(
        plans,
        lengths=torch.tensor([10, 3, 10, 1, 0, 10]),
        group=torch.tensor([0, 0, 1, 1, 0, 1]),
        group_names=("anna", "ben"),
        context=torch.randint(3, (6, 10), generator=seeded(0)),
        action_names=("a", "b", "c", "d"),
    )
    prior = SwitchingPrior(4, 2, num_contexts=3).fit(plans, generator=seeded(0))
    frame = mode_frame(prior, plans)
    assert len(frame) == 34
    assert frame["group"].value_counts().to_dict() == {"ben": 21, "anna": 13}
    found, second = prior.posterior(plans), frame[frame["plan"] == 1]
    assert second["step"].tolist() == [0, 1, 2]
    assert second["action"].tolist() == ["abcd"[a] for a in plans.actions[1, :3].tolist()]
    assert second["context"].tolist() == plans.context[1, :3].tolist()
    assert second["mode"].tolist() == (found.path[1, :3] + 1).tolist()
    np.testing.assert_allclose(second["filtered_2"], found.filtered[1, :3, 1])
    np.testing.assert_allclose(second["smoothed_1"], found.smoothed[1, :3, 0])
    without = mode_frame(SwitchingPrior(4, 2).fit(plans.without_context(), generator=seeded(0)), plans)
    assert len(without) == 34  # a prior without context ignores it


def test_modes_as_plans_are_the_most_probable_paths():
    plans, modes = source(20, 60, seed=5)
    prior = SwitchingPrior(4, 2, 0).fit(plans, generator=seeded(0))
    found = mode_plans(prior, plans)
    assert found.num_actions == 2
    assert found.action_names == ("mode 1", "mode 2")
    assert found.actions.long().equal(prior.posterior(plans).path)
    agree = float((found.actions.long() == modes).double().mean())
    assert max(agree, 1 - agree) > 0.9


def test_the_table_says_what_each_mode_does():
    actions = torch.tensor([[0] * 6 + [1] * 4 + [0] * 5 + [1] * 5] * 10)
    context = torch.zeros(10, 20, dtype=torch.long)
    context[:, 6], context[:, 10], context[:, 15] = 2, 1, 2
    plans = Plans(actions, 2, context=context, action_names=("walk", "rest"), context_names=("field", "hill", "nest"))
    prior = SwitchingPrior(2, 2, 0, num_contexts=3, smoothing=0.1).fit(plans, generator=seeded(1))
    table = mode_table(prior, plans).set_index(pd.Index(["walk", "rest"]))
    assert table["share"].tolist() == pytest.approx([0.55, 0.45], abs=0.01)
    # In 11 actions walking ends twice; in 8 with a next one resting ends once.
    assert table["dwell"].tolist() == pytest.approx([5.5, 8.0], abs=0.02)
    assert table["visits"].tolist() == pytest.approx([2, 2], abs=0.01)
    # Only what a mode does oftener than both together.
    assert table["behaviours"].str.split(", ").map(len).tolist() == [1, 1]
    assert table["behaviours"].str.split(" ").str[0].tolist() == ["walk", "rest"]
    one = SwitchingPrior(2, 1, 0).fit(plans, generator=seeded(1))
    assert mode_table(one, plans.without_context())["behaviours"].tolist() == ["walk 0.55, rest 0.45"]
    assert table.loc["rest", "enters"] == "nest 1.00"
    assert table.loc["walk", "enters"] == "hill 1.00"


def test_a_mode_without_end_has_an_infinite_dwell():
    plans, _ = source(5, 12, seed=3)
    assert mode_table(SwitchingPrior(4, 1, 0).fit(plans, generator=seeded(0)), plans)["dwell"].tolist() == [np.inf]


@pytest.mark.parametrize(
    ("numbers", "options", "words"),
    [
        ([], {}, "`num_modes` must not be empty"),
        ([0, 1], {}, "num_modes"),
        ([1], {"number_of_folds": 7}, "folds"),
        ([1], {"mask": torch.ones(2, dtype=torch.bool)}, "`mask` must be bool of shape [6, 10]"),
        ([1], {"mask": torch.ones(6, 10, dtype=torch.long)}, "`mask` must be bool of shape [6, 10]"),
    ],
)
def test_wrong_arguments_are_named(numbers, options, words):
    with refuses(words):
        choose_modes(source(6, 10, seed=1)[0], numbers, **options)


def test_transitions_of_modes_are_expected_counts():
    plans, _ = source(5, 12, seed=3)
    plans = replace(plans, lengths=torch.tensor([12, 3, 1, 7, 12]))
    prior = SwitchingPrior(4, 2, 1).fit(plans, generator=seeded(0))
    smoothed, expected = prior.posterior(plans).smoothed, torch.zeros(2, 4, 4, dtype=torch.double)
    for n, length in enumerate(plans.lengths.tolist()):
        for t in range(1, length):
            expected[:, int(plans.actions[n, t - 1]), int(plans.actions[n, t])] += smoothed[n, t]
    torch.testing.assert_close(mode_transitions(prior, plans), expected)
    assert float(expected.sum()) == pytest.approx(11 + 2 + 0 + 6 + 11)


def test_as_many_folds_as_groups_where_these_are_few():
    plans, _ = source(9, 20, seed=1)
    how = {"order": 0, "restarts": 1, "max_iterations": 2}
    for group, expected in ((torch.arange(9) // 3, 3), (torch.zeros(9, dtype=torch.long), 5)):
        choice = choose_modes(replace(plans, group=group), [2], generator=seeded(0), **how)
        assert len(choice.stability[2]) == expected
