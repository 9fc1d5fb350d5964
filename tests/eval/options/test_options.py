"""`python -m eval options`: a small run from end to end, what planners are given, and what is compared."""

import csv
import json

import pandas as pd
import pytest
import torch

from eval.__main__ import main
from eval.options import run as run_module
from eval.options.planner import OptionPlanner
from eval.options.priors import entrants, pairs
from eval.options.report import compared_pairs
from eval.options.run import OptionSettings, index_of, numbered, observed, scores_reached
from eval.worlds.runs import Run
from eval.worlds.starts import Starts
from eval.worlds.suite import Task
from neuroprior import ExhaustivePlanner, Plans, SamplingPlanner, TabularWorld, UniformPrior, collect
from neuroprior.behaviour.analysis.comparison import score
from neuroprior.priors import SwitchingPrior
from neuroprior.worlds import four_rooms
from tests.support.sources import seeded

pytestmark = pytest.mark.usefixtures("undrawn")

SMALL = ["options", "--worlds", "goal_maze", "--seeds", "2", "--starts", "8", "--num-plans", "2", "8", "--modes", "2"]
SMALL += ["--training-starts", "20", "--processes", "1"]


def test_a_small_run(tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*SMALL, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    for number in (2, 8):
        assert f"goal_maze: differences with {number} candidates" in " ".join(printed.split())
    results = json.loads((out / "results.json").read_text())
    own = ["flat", "switching-2", "flat-2", "options-2", "kept-2"]
    expected = {("none", label) for label in [*own, "uniform", "macro"]}
    expected |= {("per-step", label) for label in [*own, "constant-2"]}
    assert {(row["context"], row["prior"]) for row in results["rows"]} == expected
    assert len(results["rows"]) == 2 * len(expected)
    assert all(row["low"] <= row["share"] <= row["high"] and row["seeds"] == 2 for row in results["rows"])
    at = {(row["context"], row["prior"], row["num_plans"]): row for row in results["rows"]}
    for row in results["paired"]:
        ends = [at[row["context"], row[side], row["num_plans"]]["share"] for side in ("first_prior", "second_prior")]
        assert row["difference"] == pytest.approx(ends[0] - ends[1], abs=1e-9)
    assert {row["bits"] for row in results["rows"] if row["prior"] in ("switching-2", "options-2", "kept-2")} == {
        row["bits"] for row in results["rows"] if row["prior"] == "switching-2"
    }
    with open(out / "rows.csv") as file:
        assert [float(row["share"]) for row in csv.DictReader(file)] == [row["share"] for row in results["rows"]]
    assert (out / "goal_maze.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "report.html").exists()
    kept = {path: path.stat().st_mtime_ns for path in (out / "runs").rglob("goal_maze*.json")}
    assert len(kept) == 2
    assert main([*SMALL, "--out", str(out)]) == 0  # finished runs are not done again
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
    assert capsys.readouterr().out == printed


def test_priors_learn_from_the_larger_part_of_the_mices_plans(monkeypatch):
    parts = []
    monkeypatch.setattr(run_module, "entrants", lambda training, held_out, *_: parts.append((training, held_out)) or ())
    run_module.options_run(Run("labyrinth", 0), OptionSettings((2,), (8,), (2,), 4, 4, 0))
    assert len(parts) == 2  # without context and with it
    for training, held_out in parts:
        assert len(held_out) / (len(training) + len(held_out)) == pytest.approx(run_module.HELD_OUT, abs=0.05)


@pytest.mark.slow
def test_in_the_labyrinth(tmp_path):
    how = ["--worlds", "labyrinth", "--seeds", "2", "--starts", "6", "--num-plans", "1", "4", "--lengths", "4", "8"]
    assert main(["options", *how, "--modes", "2", "--processes", "1", "--out", str(tmp_path)]) == 0
    rows = pd.DataFrame(json.loads((tmp_path / "results.json").read_text())["rows"])
    assert sorted(rows["length"].unique()) == [4, 8]
    wide = rows.pivot(index=["context", "prior", "length"], columns="num_plans", values="share")
    assert (wide[4] >= wide[1]).all()  # one of more candidates reaches it
    longer = rows.pivot(index=["context", "prior", "num_plans"], columns="length", values="share")
    assert (longer[8] >= longer[4]).all()  # short plans are the beginnings of long ones


def source(num, seed=0, length=12):
    """Plans of two modes that walk to and fro, and their context, the parity of the step."""
    generator = seeded(seed)
    mode = torch.randint(2, (num, 1), generator=generator)
    wild = torch.rand(num, length, generator=generator) < 0.2
    actions = torch.where(wild, torch.randint(3, (num, length), generator=generator), 2 * mode)
    return Plans(actions, 3, context=(torch.arange(length) % 2).expand(num, -1))


@pytest.mark.parametrize("contexts", [None, 2])
def test_chains_of_equal_likelihood_and_who_takes_part(contexts):
    plans = [source(80, 0), source(40, 1)]
    training, held_out = plans if contexts else [some.without_context() for some in plans]
    found = {one.label: one for one in entrants(training, held_out, contexts, (2, 3), 0, seeded(0))}
    assert ("constant-2" in found) == (contexts is not None)
    assert ("macro" in found) == ("uniform" in found) == (contexts is None)
    for number in (2, 3):
        one, near = found[f"switching-{number}"], found[f"flat-{number}"]
        assert isinstance(one.prior, SwitchingPrior)
        assert one.prior.num_modes == number
        assert one.bits == score("", one.prior, held_out).bits_per_action().mean
        # As near as any other chain, of which "flat" is one.
        assert abs(near.bits - one.bits) <= abs(found["flat"].bits - one.bits)
        for label, ends in ((f"options-{number}", True), (f"kept-{number}", False)):
            planner = found[label].planner(found[label].prior, 4, 6)
            assert isinstance(planner, OptionPlanner)
            assert planner.prior is one.prior
            assert planner.terminations == ends
        assert one.planner is SamplingPlanner
    if contexts:
        assert found["constant-2"].prior.switching == "constant"
        assert len(found["switching-2"].prior.transitions) == 2


def test_numbers_of_contexts_are_observed_where_features_were():
    """The prior is given, before each action, the number that its training plans had in such a state."""
    world = four_rooms(num_layouts=2, view=1, seed=0)
    plans = collect(ExhaustivePlanner(3), world, 50, context="step", generator=seeded(0))
    index = index_of(plans, ((0, 1, 2, 3, 4), (1, 3)))
    assert index.size <= 5  # two binary features, and one number for what is new
    made = observed(world, index)
    state = world.reset(200, seeded(1))
    assert made.observe(state).equal(index(world.observe(state)))
    assert made.observe(state).dtype == torch.long
    assert world.observe(state).is_floating_point()  # the world itself is as it was
    numbers = numbered(plans, index).context
    assert numbers[plans.mask()].max() < index.size - 1  # none is new
    given = []

    class Asked(SwitchingPrior):
        def start(self, batch_size, context=None):
            given.append(context)
            return super().start(batch_size, context)

    prior = Asked(4, 2, 0, index.size, max_iterations=1, restarts=1).fit(numbered(plans, index), generator=seeded(0))
    SamplingPlanner(prior, 3, 4).plan(made, state, seeded(2))
    assert given[-1].equal(made.observe(state))


def test_scores_are_the_best_of_blocks():
    """From state 0 of a chain, one of two actions pays 1: P candidates of one action miss it with probability 2^-P."""
    world = TabularWorld(torch.tensor([[0, 1], [1, 1]]), torch.tensor([0.0, 1.0]))
    task = Task(("stay", "go"), "", lambda seed: None, 1, (1,))
    starts = Starts(task, world, torch.zeros(4000, dtype=torch.long), 1, torch.ones(4000), 0.0)
    planner = SamplingPlanner(UniformPrior(2), 1, 4)
    shares = scores_reached(planner, starts, (1, 2, 4), seeded(0))
    # By Hoeffding 4,000 starts miss their mean by 0.05 with probability 2 exp(-20).
    assert shares == pytest.approx([0.5, 0.75, 0.9375], abs=0.05)


def test_only_priors_with_the_same_context_are_paired():
    rows = [
        {"world": "w", "seed": seed, "prior": prior, "context": context, "length": 8, "num_plans": 4, "share": share}
        for seed in (0, 1)
        for context, share in (("none", 0.1), ("per-step", 0.5))
        for prior in ("flat-2", "switching-2", "flat")
    ]
    rows += [rows[0] | {"prior": "macro", "share": 0.3}, rows[3 * 2] | {"prior": "macro", "share": 0.4}]
    found = compared_pairs(pd.DataFrame(rows), (2,))
    assert len(found) == 2 * 2 * 2 + 2
    macro = found[found["second_prior"] == "macro"].sort_values("seed")
    assert macro["context"].tolist() == ["none"] * 2
    assert macro[["first", "second"]].to_numpy().tolist() == [[0.1, 0.3], [0.1, 0.4]]
    assert ("switching-2", "flat-2") in pairs((2,))
