"""Plans scored under a prior, as a table; plans that the prior has learned from are known again."""

from dataclasses import replace
from math import log

import pytest
import torch

from neuroprior import MarkovPrior, Plans, UniformPrior, save
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.priors import AdaptivePrior, adapt, match_plans
from neuroprior.priors.scoring import keep_learned, learned_from, score
from tests.support.sources import refuses, seeded

NAMES = ("groom", "rear", "walk")
TRAINING = Plans(torch.randint(3, (40, 8), generator=seeded(0)), 3, action_names=NAMES)
PRIOR = MarkovPrior(3, 1).fit(TRAINING)
NEW = RecordedPlans(
    torch.tensor([[0, 1, 1], [1, 0, 0], [0, 0, 1]]),
    2,
    torch.tensor([3, 2, 0]),
    action_names=("rear", "walk"),
    group=torch.tensor([0, 1, 0]),
    group_names=("m1", "m2"),
    condition=torch.tensor([1, 1, 0]),
    condition_names=("drug", "saline"),
)
"""Plans in which one action does not occur, so that the others have other numbers."""


def by_hand() -> list[float]:
    actions = [[1, 2, 2], [2, 1]]
    return [float(PRIOR.log_prob(torch.tensor([plan]))) for plan in actions] + [0.0]


def test_actions_are_matched_by_name():
    frame = score(PRIOR, NEW)
    assert frame["log_likelihood"].tolist() == pytest.approx(by_hand())
    assert frame["group"].tolist() == ["m1", "m2", "m1"]
    assert frame["condition"].tolist() == ["saline", "saline", "drug"]
    assert frame["bits_per_action"].tolist()[:2] == pytest.approx(
        [-by_hand()[0] / log(2) / 3, -by_hand()[1] / log(2) / 2]
    )
    assert frame["bits_per_action"].isna().tolist() == [False, False, True]


@pytest.mark.parametrize("by", ["group", "condition", "action"])
def test_sums_are_those_of_the_plans(by):
    frame = score(PRIOR, NEW, by)
    assert frame["log_likelihood"].sum() == pytest.approx(sum(by_hand()))
    assert frame["actions"].sum() == 5
    rows = {
        "group": [["m1", 2, 3], ["m2", 1, 2]],
        "condition": [["saline", 2, 5], ["drug", 1, 0]],  # in the order of the plans
        "action": [["rear", 2, 2], ["walk", 2, 3]],
    }[by]
    assert list(frame.columns) == [by, "plans", "actions", "log_likelihood", "bits_per_action"]
    assert frame[[by, "plans", "actions"]].to_numpy().tolist() == rows
    each = PRIOR.action_log_probs(match_plans(NEW, PRIOR))
    sums = {
        "group": by_hand()[:2],
        "condition": [sum(by_hand()), 0.0],
        "action": [float(each[NEW.mask() & (NEW.actions == action)].sum()) for action in (0, 1)],
    }[by]
    assert frame["log_likelihood"].tolist() == pytest.approx(sums)
    bits = [-total / log(2) / row[2] if row[2] else float("nan") for total, row in zip(sums, rows, strict=True)]
    assert frame["bits_per_action"].tolist() == pytest.approx(bits, nan_ok=True)


def test_groups_go_on_from_their_earlier_plans():
    """Each by name from its own, whatever their numbers; one without earlier plans is scored alone."""
    prior = AdaptivePrior(PRIOR, [3.0, 1.5])
    plans = replace(NEW, lengths=torch.tensor([3, 2, 2]), group=torch.tensor([0, 2, 1]), group_names=("m1", "m2", "m3"))
    actions = torch.tensor([[0, 0, 2, 1], [1, 1, 2, 0], [2, 2, 2, 2]])
    past = Plans(
        actions, 3, torch.tensor([4, 3, 1]), action_names=NAMES, group=torch.tensor([1, 0, 1]), group_names=("m3", "m1")
    )
    with torch.no_grad():
        due = [
            float(own.log_prob(torch.tensor([plan])))
            for own, plan in (
                (adapt(prior, past[torch.tensor([0, 2])]), [1, 2, 2]),
                (adapt(prior, past[1:2]), [2, 1]),
                (prior, [1, 1]),
            )
        ]
    assert score(prior, plans, past=past)["log_likelihood"].tolist() == pytest.approx(due, abs=1e-5)
    assert score(prior, plans)["log_likelihood"].tolist() != pytest.approx(due, abs=1e-2)


@pytest.mark.parametrize(
    ("prior", "past", "words"),
    [
        (AdaptivePrior(PRIOR), replace(NEW, group=None, group_names=None), "`past` must have groups"),
        (AdaptivePrior(PRIOR), replace(NEW, group_names=("m8", "m9")), "such as m1, m2; got m8, m9"),
        (PRIOR, NEW, "`prior` must learn along a sequence"),
    ],
)
def test_a_past_of_others_is_refused(prior, past, words):
    with refuses(words):
        score(prior, NEW, past=past)


def test_other_numbers_are_never_taken_for_the_same():
    wider = Plans(NEW.actions, 3, NEW.lengths, action_names=("rear", "walk", "groom"))
    with refuses("action_names", "rear, walk, groom in the plans", "groom, rear, walk in this prior", "match_plans"):
        PRIOR.log_prob(wider)
    assert PRIOR.log_prob(match_plans(wider, PRIOR)).tolist() == pytest.approx(by_hand())


def test_bad_input():
    with refuses("by", "'animal'"):
        score(PRIOR, NEW, "animal")
    with refuses("by", "no group"):
        score(PRIOR, TRAINING, "group")
    with refuses("by", "no condition"):
        score(PRIOR, RecordedPlans.of(TRAINING), "condition")
    with refuses("`by` must be one of plan, action, group, got 'condition'"):
        score(PRIOR, TRAINING, "condition")


def test_plans_that_were_learned_from_are_known_again(tmp_path):
    assert learned_from(tmp_path, TRAINING) == [False] * 40
    save(PRIOR, tmp_path)
    keep_learned(tmp_path, TRAINING[:10].with_end(), TRAINING[20:25])
    known = learned_from(tmp_path, TRAINING)
    assert all(known[:10])
    assert all(known[20:25])
    # By names, whatever their numbers are.
    other = Plans(2 - TRAINING.actions.long(), 3, action_names=NAMES[::-1])
    assert learned_from(tmp_path, other) == known
    # Whatever stands beyond their end.
    longer = Plans(torch.nn.functional.pad(TRAINING.actions, (0, 2)), 3, torch.full((40,), 8), action_names=NAMES)
    assert learned_from(tmp_path, longer) == known
    assert sum(learned_from(tmp_path, Plans(TRAINING.actions, 3))) == 0
    # Plans without any action say nothing of where they are from.
    nothing = Plans(TRAINING.actions[:2], 3, torch.tensor([0, 6]), action_names=NAMES)
    keep_learned(tmp_path, nothing)
    assert learned_from(tmp_path, nothing) == [False, True]
    save(UniformPrior(3), tmp_path)  # which has not learned from them
    assert learned_from(tmp_path, nothing) == [False, False]


def test_scores_of_a_saved_prior_say_what_it_has_learned_from(tmp_path):
    save(PRIOR, tmp_path)
    keep_learned(tmp_path, TRAINING[3:10])
    plans = Plans(TRAINING.actions, 3, action_names=NAMES, group=torch.arange(40) % 7 % 3)
    by_plan, by_group, by_action = (score(tmp_path, plans, by) for by in ("plan", "group", "action"))
    known = learned_from(tmp_path, plans)
    assert by_plan["training_data"].tolist() == known
    assert 7 <= sum(known) < 40
    counted = by_plan.groupby("group", sort=False)["training_data"].sum()
    assert by_group["training_data"].tolist() == counted.tolist()
    for one, by in ((by_plan, "plan"), (by_group, "group"), (by_action, "action")):
        assert one.drop(columns="training_data", errors="ignore").equals(score(PRIOR, plans, by))


@pytest.mark.parametrize("content", ["[]", '{"plans": 5}', '{"plans": [5]}', "{}", "{"])
def test_a_damaged_list_of_plans_is_named(content, tmp_path):
    (tmp_path / "learned.json").write_text(content)
    with refuses(f"{tmp_path / 'learned.json'}: "):
        learned_from(tmp_path, TRAINING)


def test_plans_with_an_end_symbol_are_scored_by_priors_that_learned_one():
    """As they are: to plans that were cut off before their end, such as samples, none is added."""
    ended = Plans(torch.randint(3, (50, 6), generator=seeded(0)), 3).with_end()
    prior = MarkovPrior(4, 1).fit(ended)
    assert score(prior, ended)["log_likelihood"].tolist() == pytest.approx(prior.log_prob(ended).tolist())
    assert score(prior, ended).equals(score(prior, ended.without_end()))
    samples = Plans(prior.sample(40, 4, generator=seeded(1)), 4, end=3)
    assert 0 < (samples.actions[:, -1] == 3).sum() < 40
    found = score(prior, samples)
    assert found["log_likelihood"].tolist() == pytest.approx(prior.log_prob(samples).tolist())
    assert found["actions"].tolist() == (samples.actions != 3).logical_and(samples.mask()).sum(1).tolist()
    with refuses("its end symbol is 3 of 4 actions", "3 of 5", "plans.without_end()"):
        score(prior, Plans(ended.actions, 5, ended.lengths, end=3))
    assert score(UniformPrior(4), ended)["log_likelihood"].tolist() == pytest.approx([-7 * log(4)] * 50)
