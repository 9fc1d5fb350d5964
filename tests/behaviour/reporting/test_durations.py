"""The report's section on durations: tables, figure, and whether durations predict the next action."""

from dataclasses import replace
from math import log, nan
from pathlib import Path

import pandas as pd
import pytest
import torch

from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.reporting.document import Document
from neuroprior.behaviour.reporting.durations import chain_bits
from neuroprior.behaviour.reporting.figures import MOST_PANELS, dwell_figure
from neuroprior.behaviour.reporting.part import Part
from neuroprior.behaviour.reporting.plan_report import report
from neuroprior.behaviour.reporting.scores import evaluate_saved
from neuroprior.behaviour.reporting.sections import SECTIONS
from neuroprior.plans import BLOCKS, Plans, write_plans
from neuroprior.priors import UniformPrior
from tests.support.reports import QUICK_IN_TWO
from tests.support.sources import refuses, seeded

ONLY = {"fits": QUICK_IN_TWO, "sections": ["durations"]}


def timed(telling: bool, num_plans: int = 24, length: int = 60, seed: int = 0, num_actions: int = 3) -> Plans:
    """Actions at random; where `telling`, action 0 follows each that took longer than the median."""
    durations = torch.empty(num_plans, length).exponential_(generator=seeded(seed)) * 2
    actions = torch.randint(num_actions, (num_plans, length), generator=seeded(seed + 1))
    for t in range(1, length):
        long = durations[:, t - 1] > 2 * 0.6931
        actions[:, t] = torch.where(long & telling, 0, actions[:, t])
    names = tuple("abcdefghijklmnop")[:num_actions]
    return RecordedPlans(
        actions, num_actions, durations=durations, group=torch.arange(num_plans) % 8, action_names=names
    )


def tables(plans: Plans) -> dict[str, pd.DataFrame]:
    """Those of the section alone."""
    return section(plans).frames


def section(plans: Plans) -> Part | None:
    return SECTIONS["durations"](evaluate_saved({"uniform": UniformPrior(plans.num_actions)}, plans, 0))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Document, Path]:
    folder = tmp_path_factory.mktemp("made")
    plans = timed(True)
    durations = plans.durations.clone()
    durations[:, ::10] = nan
    durations[plans.actions == 2] = 0
    write_plans(replace(plans, durations=durations), folder / "plans.npz")
    return report(folder / "plans.npz", out=folder, **ONLY), folder


def test_the_section_of_a_file(made):
    document, folder = made
    names = ["durations", "duration_laws", "next_by_duration", "dwell", "survival", "survival_tests"]
    assert list(document.tables) == names
    assert all((folder / f"{name}.csv").exists() for name in names)
    frame = document.tables["durations"].set_index("behaviour")
    assert frame["law"].to_dict() == {"a": "exponential", "b": "exponential", "c": "of all"}
    assert frame["zero"].to_dict() == {"a": 0, "b": 0, "c": 1}
    assert (frame["known"] + frame["unknown"]).sum() == 24 * 60
    assert frame["unknown"].sum() > 0
    assert frame.loc["a", "median"] == pytest.approx(2 * 0.6931, rel=0.2)
    assert "dwell" in document.figures
    assert len(document.figures["dwell"].axes) == 2  # c takes no time


def test_the_law_is_that_of_durations_above_0():
    """Where a quarter take no time, the law and the histogram of the others are still whole."""
    plans = timed(False)
    durations = plans.durations.where(torch.arange(60) % 4 > 0, 0.0)
    dwell = tables(replace(plans, durations=durations))["dwell"]
    width = (dwell["high"] / dwell["low"]).map(log)
    for what in ("density", "fitted"):
        assert (dwell[what] * width).groupby(dwell["behaviour"]).sum().between(0.97, 1 + 1e-9).all()
    for name, own in dwell.groupby("behaviour"):
        mine = durations[plans.actions == "abc".index(name)]
        assert own["zero"].unique().tolist() == [pytest.approx(float((mine == 0).double().mean()))]
        assert own["number"].unique().tolist() == [int((mine > 0).sum())]
        inside = (mine[:, None] > torch.tensor(own["low"].values)) & (mine[:, None] <= torch.tensor(own["high"].values))
        assert (own["density"] * width[own.index] * (mine > 0).sum().item()).tolist() == pytest.approx(
            inside.sum(0).tolist()
        )


def test_gains_of_laws_are_held_out():
    """Of a Weibull law over an exponential one: what the densities say of many durations; of the latter itself, 0."""
    plans = timed(False)
    times = plans.durations.clone()
    times[plans.actions == 1] = times[plans.actions == 1].sqrt()  # Weibull with shape 2
    frame = tables(replace(plans, durations=times))["durations"].set_index("behaviour")
    assert frame["law"].to_dict() == {"a": "exponential", "b": "weibull", "c": "exponential"}
    assert frame.loc["a", "gain"] == pytest.approx(0, abs=0.01)
    # log 2 + E log x - E x^2 + (log mean + 1) of a Weibull variable with shape 2 and scale 1, whatever its scale
    expected = 0.6931 - 0.5772 / 2 - 1 + (1 + torch.tensor(torch.pi).sqrt().div(2).log().item())
    assert frame.loc["b", "low"] < expected < frame.loc["b", "high"]
    assert frame.loc["b", "units"] == 8


def test_the_gains_of_laws_and_of_transitions_add_up():
    """Before action 0 the mean is 1, before others 8: log(17 / 3) - (2 / 3) log 8 over one exponential law, in all."""
    plans = timed(False)
    means = torch.where(torch.cat([plans.actions[:, 1:], plans.actions[:, :1]], 1) == 0, 1.0, 8.0)
    laws = tables(replace(plans, durations=plans.durations / 2 * means))["duration_laws"]
    assert laws["gain"].sum() == pytest.approx(log(17 / 3) - 2 / 3 * log(8), abs=0.04)
    assert (laws["gain"] > 0.06).all()


def test_durations_that_predict_the_next_action():
    """Half of the actions are followed by action 0, the others by any: the bits are known."""
    gained = tables(timed(True))["next_by_duration"].iloc[0]
    assert gained["low"] > 0.2
    # the classes are terciles, and what predicts is the median: the middle class is uncertain
    share = torch.tensor([[1, 1, 1], [2, 0.5, 0.5], [3, 0, 0]]).double() / 3
    expected = float(-torch.special.xlogy(share, share).sum(1).mean() / torch.tensor(2.0).log())
    assert gained["with"] == pytest.approx(expected, abs=0.04)
    assert gained["p_value"] < 1e-4


def test_classes_are_learned_on_training_plans():
    """Where all durations of held-out plans are short, they are of the class that the short ones were in before."""
    plans = replace(timed(True), group=torch.arange(24) % 2)
    (_, bits), _ = chain_bits(plans, plans.mask())
    for group in (0, 1):
        held_out = plans.group == group
        short = plans.durations.masked_fill(held_out[:, None], 1e-9)
        (_, found), _ = chain_bits(replace(plans, durations=short), plans.mask())
        pair = plans.actions[:, :-1].long() * 3 + plans.actions[:, 1:]
        for each in range(9):
            mine = (pair == each) & held_out[:, None]
            shortest = torch.where(mine, plans.durations[:, :-1], torch.inf).flatten().argmin()
            assert found[:, 1:][mine].unique().tolist() == [bits[:, 1:].flatten()[shortest]]


def test_durations_are_long_or_short_for_their_own_action():
    """In whatever unit the durations of an action are, the classes are the same."""
    plans = timed(True)
    unit = torch.tensor([1.0, 256.0, 1 / 1024])[plans.actions.long()]
    (without, knowing), mask = chain_bits(plans, plans.mask())
    (same, again), _ = chain_bits(replace(plans, durations=plans.durations * unit), plans.mask())
    assert same.equal(without)
    torch.testing.assert_close(again, knowing)
    assert float((without - knowing)[mask].mean()) > 0.2


def test_laws_are_scored_on_other_animals():
    """Durations are all but constant within each of two animals: the law of one is of no use to the other."""
    plans = replace(timed(False), group=torch.arange(24) % 2)
    times = (1 + 30 * plans.group[:, None]) * (1 + 0.1 * plans.durations.tanh())
    frame = tables(replace(plans, durations=times))["durations"]
    assert (frame["gain"] < -1).all()


def test_no_duration_of_the_action_itself_or_later_is_used():
    """The bits of an action do not change with how long it takes; nor has the first action of a plan any."""
    plans = replace(timed(True), group=torch.arange(24) % 2)
    (_, before), mask = chain_bits(plans, plans.mask())
    assert (mask.sum(1) == 59).all()
    assert not bool(mask[:, 0].any())
    unknown = plans.durations.masked_fill(torch.rand(24, 60, generator=seeded(0)) < 0.2, nan)
    (_, _), after_known = chain_bits(replace(plans, durations=unknown), ~unknown.isnan())
    assert after_known.equal(torch.nn.functional.pad(~unknown[:, :-1].isnan(), (1, 0)))
    mine = plans.group == 0  # learned from the other group, which stays as it is
    for step in (1, 30, 59):
        durations = plans.durations.clone()
        durations[:, step:] = durations[:, step:].flip(0).where(mine[:, None], durations[:, step:])
        (_, after), _ = chain_bits(replace(plans, durations=durations), plans.mask())
        assert after[mine, : step + 1].equal(before[mine, : step + 1])
        assert step == 59 or not after[mine].equal(before[mine])


def test_stars_are_findings():
    """Of the tables of gains only what durations say of the next action is starred; a single animal has no gain."""
    for telling in (True, False):
        part = section(timed(telling))
        (finding,) = (one for one in part.findings if one.family == "next behaviour by duration")
        row = part.frames["next_by_duration"].iloc[0]
        assert (finding.effect, finding.low, finding.high, finding.p_value) == tuple(
            row[["gain", "low", "high", "p_value"]]
        )
        assert finding.p_corrected == (row["p_value"] if row["gain"] > 5e-4 else 1)
        assert finding.significant == telling
        for one in part.section.tables[:3]:
            starred = [cell for row in one.rows for cell in row if "*" in cell]
            assert bool(starred) == (telling and one.title == "Whether durations predict the next behaviour")
    alone = replace(timed(True), group=torch.zeros(24, dtype=torch.long))
    assert tables(alone)["next_by_duration"]["units"].tolist() == [24]


def test_few_units_give_no_verdict():
    plans = replace(timed(True), group=torch.arange(24) % 3)
    made = section(plans).section
    assert "3 subjects are too few for a verdict" in " ".join(made.text)
    assert "*" not in "".join(cell for table in made.tables for row in table.rows for cell in row)


def test_without_durations_there_is_no_section():
    plans = timed(False)
    for durations in (None, torch.full_like(plans.durations, nan), torch.zeros_like(plans.durations)):
        assert section(replace(plans, durations=durations)) is None


@pytest.mark.slow
def test_networks_with_durations():
    """They know more than those without, and the table says so."""
    plans = timed(True, 64, 12)
    fits = replace(QUICK_IN_TWO, models=["gru"], inputs=["actions", "durations"], max_steps=60)
    made = report(plans, fits=fits, sections=["scores", "durations"])
    bits = made.tables["scores"].set_index("input")["bits_per_behaviour"]
    assert bits["behaviours and durations"] < bits["behaviours"] - 0.1
    row = made.tables["next_by_duration"].set_index("model").loc["gru"]
    assert row["gain"] == pytest.approx(bits["behaviours"] - bits["behaviours and durations"])
    with refuses("`inputs` must not hold durations"):
        report(replace(plans, durations=None), fits=replace(QUICK_IN_TWO, inputs=["durations"]))
    with refuses("`models` must hold one of combined, transformer, gru"):
        report(plans, fits=replace(QUICK_IN_TWO, inputs=["durations"]), sections=["durations"])


def test_at_most_some_panels_are_drawn():
    plans = timed(False, num_actions=16)
    dwell = tables(plans)["dwell"]
    figure = dwell_figure(dwell)
    assert len(figure.axes) == MOST_PANELS
    assert figure.get_suptitle() == f"the {MOST_PANELS} commonest of 16 behaviours"
    assert len(dwell_figure(dwell[dwell["behaviour"] == "a"]).axes) == 1
    with refuses("dwell"):
        dwell_figure(dwell[:0])


def test_rounded_durations_have_no_empty_bins():
    """Edges lie between the values that durations are rounded to."""
    plans = timed(False)
    frames = (plans.durations * 5).ceil() / 5
    dwell = tables(replace(plans, durations=frames))["dwell"]
    assert (dwell["density"].groupby(dwell["behaviour"]).apply(lambda own: (own[:8] > 0).all())).all()


def test_the_parts_of_a_single_plan_are_its_units():
    frames = tables(replace(timed(True, 1, 600), group=None))
    for name in ("duration_laws", "next_by_duration"):
        assert frames[name]["units"].tolist() == [BLOCKS] * len(frames[name])
    assert frames["next_by_duration"].iloc[0]["low"] > 0


def test_gains_are_those_of_durations_above_0():
    """Where a third take no time, gains are as if these were not known."""
    plans = timed(False)
    times = plans.durations.clone()
    times[plans.actions == 1] = times[plans.actions == 1].sqrt()
    found = [tables(replace(plans, durations=times.masked_fill(times < 0.7, none))) for none in (0.0, nan)]
    for name in ("durations", "duration_laws"):
        zero, unknown = (frames[name] for frames in found)
        assert zero["gain"].tolist() == pytest.approx(unknown["gain"].tolist(), abs=1e-9)
    assert found[0]["durations"]["gain"].abs().max() > 0.05


def test_how_many_actions_have_laws_of_transitions():
    """Those of which the next action says how long they take: one of three."""
    plans = timed(False)
    follows = torch.cat([plans.actions[:, 1:], plans.actions[:, :1]], 1) == 0
    slow = torch.where(follows & (plans.actions == 2), 9.0, 1.0)
    laws = tables(replace(plans, durations=plans.durations * slow))["duration_laws"]
    assert laws["what"].tolist() == ["the law of each behaviour", "and of each transition (in 1 of 3 behaviours)"]
