"""The section on conditions: its tables say what the comparison found, and its figure shows it."""

from dataclasses import replace

import pytest
import torch

from neuroprior import Plans
from neuroprior.behaviour import compare_conditions
from neuroprior.behaviour.reporting.conditions import DRAWN, condition_section
from neuroprior.behaviour.reporting.document import results_of
from neuroprior.behaviour.reporting.part import LISTED, Part
from neuroprior.behaviour.reporting.plan_report import report
from neuroprior.behaviour.reporting.scores import evaluate_saved
from neuroprior.priors import UniformPrior
from tests.support.reports import QUICK_IN_TWO
from tests.support.sources import seeded
from tests.support.studies import between, study, within

NAMES = ["eat", "groom", "rear"]


def section_of(plans: Plans) -> Part | None:
    return condition_section(evaluate_saved({"uniform": UniformPrior(plans.num_actions)}, plans, 0))


def changed(conditions, length: int = 80, **more: object) -> Plans:
    """Action 0 takes four times as long in condition 1, and is rarely followed by itself."""

    def change(probs: torch.Tensor, condition: torch.Tensor) -> None:
        probs[condition == 1, 0] = torch.tensor([0.05, 0.65, 0.3])

    plans = study(0, conditions, length, 3, habit=0.2, change=change, slower={0: 4.0})
    return replace(plans, action_names=NAMES, **more)


@pytest.mark.parametrize(
    "conditions",
    [between(12), within(8), between(12, 4, 3), within(6, 6, 3)],
    ids=["between", "within", "three", "three within"],
)
def test_the_tables_hold_what_was_found(conditions):
    plans = changed(conditions)
    section, frames, *_ = section_of(plans)
    found = compare_conditions(plans, generator=seeded(0))
    assert section.text[0] == found.verdict
    tests = frames["condition_tests"].set_index("test")
    assert tests["p_value"]["all"] == found.p_value
    assert {name: tuple(tests.loc[name, ["p_value", "p_corrected"]]) for name in found.tests} == found.tests
    features = frames["conditions"]
    assert len(features) == sum(len(family.features) for family in found.families)
    assert features["significant"].sum() == sum(int(found.significant(family).sum()) for family in found.families)
    assert features["significant"].is_monotonic_decreasing
    family = next(family for family in found.families if family.name == "durations")
    row = features.set_index("feature").loc["duration of eat"]
    assert row["significant"]
    assert row["mean, drug 1"] == pytest.approx(float(family.means[1, 0].exp()))
    if len(found.condition_names) == 2:
        assert row["difference"] == pytest.approx(row["mean, drug 1"] / row["mean, drug 0"], rel=0.05)
        assert row["low"] < 4 < row["high"]
    chosen = features.set_index("feature").loc["eat → eat"]
    assert chosen["mean, drug 1"] == pytest.approx(0.05, abs=0.02)
    blocks = frames["condition_blocks"]
    right = (blocks["condition"] == blocks["classified"]).groupby(blocks["condition"]).mean().mean()
    assert right == pytest.approx(found.prediction.accuracy)


def test_stars_and_limits_of_the_printed_tables():
    section, frames, *_ = section_of(changed(between(12)))
    tests, features, predicted = section.tables
    assert tests.rows[0][0] == "all tests together"
    assert all(row[-1].endswith("*") == (float(row[-1].strip("*")) < 0.05) for row in tests.rows[1:])
    assert "Smallest possible p: 0.0022. *: p < 0.05, corrected for the 6 tests" in tests.caption
    assert len(features.rows) == LISTED < len(frames["conditions"])
    starred = [row[0] for row in features.rows if row[-1].endswith("*")]
    assert starred == frames["conditions"]["feature"][frames["conditions"]["significant"]].tolist()[:LISTED]
    assert [row[0] for row in predicted.rows] == ["drug 0", "drug 1"]
    assert [sum(map(int, row[1:])) for row in predicted.rows] == [6, 6]


def test_units_are_counted_by_their_condition_and_by_the_one_predicted():
    """Short plans without an effect, so that not as many of one condition are taken for the other as the reverse."""
    section, frames, *_ = section_of(study(0, between(9, 1), 12, 3, habit=0.2))
    blocks = frames["condition_blocks"]
    pairs = [*zip(blocks["condition"], blocks["classified"], strict=True)]
    printed = section.tables[2]
    names = ["drug 0", "drug 1"]
    assert printed.headings == ["condition", *(f"predicted\n{name}" for name in names)]
    assert printed.rows == [[own, *(str(pairs.count((own, other))) for other in names)] for own in names]
    assert pairs.count(("drug 0", "drug 1")) != pairs.count(("drug 1", "drug 0"))


@pytest.mark.parametrize("change", [0, 0.2, 1])
def test_the_headline_says_exactly_what_is_starred(change):
    """Each starred finding is said or named at the top, and nothing else; the verdict agrees."""
    some = torch.rand(48, generator=seeded(2)) < change
    plans = changed(between(12))
    alike = plans.actions[torch.randperm(48, generator=seeded(3))]
    plans = replace(plans, actions=torch.where(some[:, None], plans.actions, alike))
    results = results_of(report(plans, fits=QUICK_IN_TWO, sections=["conditions"]))
    starred = [one for one in results["findings"] if one["significant"]]
    said = [one["finding"] for one in results["headline"] if one["finding"]]
    assert all(one["significant"] == (one["p_corrected"] < 0.05) for one in results["findings"])
    assert {*said} <= {one["id"] for one in starred}
    rest = [one["feature"] for one in starred if one["id"] not in said]
    last = results["headline"][-1]["sentence"]
    assert all(feature in last for feature in rest)
    assert bool(rest) == last.startswith("Starred, too")
    assert results["headline"][0]["sentence"].startswith("Behaviour differs" if starred else "No difference")
    assert len(results["headline"]) <= 8


def test_without_conditions_there_is_no_section_and_with_one_it_says_why():
    plans = changed(between(6))
    assert section_of(replace(plans, condition=None, condition_names=None)) is None
    part = section_of(replace(plans, condition=torch.zeros(len(plans), dtype=torch.long)))
    assert part.section.text == ["Not tested: all sequences are under one condition."]
    assert all(frame.empty for frame in part.frames.values())


def test_plans_without_groups_or_names_that_are_those_of_columns():
    names = ["p", "condition: feature"]
    plans = replace(changed(between(12, 1), condition_names=names), group=None)
    section, frames, *_ = section_of(plans)
    assert frames["condition_blocks"]["sequence"].tolist() == [f"sequence {number}" for number in range(12)]
    assert section.tables[1].headings == [
        "feature",
        *(f"mean,\n{name}" for name in names),
        *("condition: feature\nagainst p", "95 % interval", "p"),
    ]
    assert [row[0] for row in section.tables[2].rows] == names


def test_the_figure_shows_the_features_that_differ_most():
    """With the values of units, those of durations as geometric means, and the means of the table."""
    plans = changed(within(8))
    section, frames, *_ = section_of(plans)
    cells, features = section.figures[0].figure.axes, frames["conditions"][:DRAWN]
    assert [axes.get_title(loc="left").rstrip("*") for axes in cells] == features["feature"].tolist()
    found = compare_conditions(plans, generator=seeded(0))
    families = {family.name: family for family in found.families}
    spelled = {"durations": "duration of {}", "behaviours": "share of {} (by count)"}
    for axes, (_, row) in zip(cells, features.iterrows(), strict=True):
        family, joint = families[row["family"]], " → " if row["family"] == "transitions" else " "
        names = [spelled.get(family.name, "{}").format(joint.join(NAMES[a] for a in own)) for own in family.features]
        values = family.values[:, names.index(row["feature"])]
        values = values.exp() if family.name == "durations" else values
        dots = [line.get_xdata() for line in axes.lines if line.get_marker() == "o"]
        bars = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "|"]
        for k, name in enumerate(found.condition_names):
            assert sorted(dots[k]) == pytest.approx(sorted(values[found.design.label == k].tolist()))
            assert bars[k] == row[f"mean, {name}"]
    assert "durations" in set(features["family"])


@pytest.mark.parametrize("conditions", [between(12), within(8)], ids=["between", "within"])
def test_features_that_differ_most_come_first(conditions):
    """Significant ones by family, then all by their p-values, and among equals by how unlike they are."""
    features = section_of(changed(conditions, 40))[1]["conditions"]
    families = ["transitions", "durations", "behaviours", "sequences"]
    rank = [families.index(row.family) if row.significant else len(families) for row in features.itertuples()]
    keys = [*zip(rank, features["p_corrected"], features["p_value"], -features["statistic"], strict=True)]
    assert keys == sorted(keys)
    assert len({key[:3] for key in keys}) < len(keys)


def test_each_two_of_three_conditions_have_a_table():
    plans = changed(between(18, 2, 3))
    section, frames, *_ = section_of(plans)
    found = compare_conditions(plans, generator=seeded(0))
    pairs = frames["condition_pairs"]
    numbers = [sum(len(family.features) for family in pair.families) for pair in found.contrasts]
    assert pairs.groupby(["first", "second"], sort=False).size().tolist() == numbers
    by_name = {tuple(pair.condition_names): pair for pair in found.contrasts}
    for (first, second), own in pairs.groupby(["first", "second"]):
        pair = by_name[first, second]
        row = own.set_index("feature").loc["duration of eat"]
        family = next(family for family in pair.families if family.name == "durations")
        assert row["p_corrected"] == max(float(family.corrected[0]), pair.tests["durations"][1])
        assert [row["difference"], row["low"], row["high"]] == pytest.approx(family.difference[:, 0].exp().tolist())
        assert row["significant"] == ("drug 1" in (first, second))
    shown = next(table for table in section.tables if table.title == "Each two conditions")
    assert [row[0] for row in shown.rows[:: len(shown.rows) // 3]] == [
        *("drug 1\nagainst drug 0", "drug 2\nagainst drug 0", "drug 2\nagainst drug 1"),
    ]
    assert "condition_pairs" not in section_of(changed(between(12)))[1]


@pytest.mark.parametrize("conditions", [[[n // 2 % 2] * 4 for n in range(16)], within(12)], ids=["between", "within"])
def test_strata_have_a_sentence_and_their_interaction_a_table(conditions):
    plans = changed(conditions)
    plans = replace(plans, stratum=plans.group % 2, stratum_names=["female", "male"])
    section, frames, *_ = section_of(plans)
    found = compare_conditions(plans, generator=seeded(0)).interaction
    frame = frames["condition_interaction"]
    printed = section.tables[-1]
    assert printed.headings == ["feature", "difference,\nfemale", "difference,\nmale", "p"]
    assert printed.caption.startswith(found.verdict)
    family = next(family for family in found.families if family.name == "durations")
    row = frame.set_index("feature").loc["duration of eat"]
    assert [row["difference, female"], row["difference, male"]] == pytest.approx(
        family.differences[:, 0].exp().tolist()
    )
    assert row["p_corrected"] == family.corrected[0]
    assert frame["p_corrected"].is_monotonic_increasing
    permuted = "permuted within 2 strata" in " ".join(section.text)
    assert permuted == (compare_conditions(plans, 9).design.kind == "between")


def test_a_rare_condition_is_noted():
    text = " ".join(section_of(changed([*between(12), [2]]))[0].text)
    assert "Left out, with fewer than 2 subjects: drug 2." in text
