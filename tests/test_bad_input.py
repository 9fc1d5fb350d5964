"""What no part of the library takes: one clear line each, where it is given."""

import numpy as np
import pandas as pd
import pytest
import torch

import neuroprior.behaviour as analysis
from neuroprior import (
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    MCTSPlanner,
    Plans,
    SamplingPlanner,
    UniformPrior,
    fit,
    load,
    oracle,
    save,
    write_plans,
)
from neuroprior.__main__ import main
from neuroprior.behaviour import read
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.reporting import FitOptions, ReadOptions
from neuroprior.behaviour.reporting.figures import ethogram_figure
from neuroprior.behaviour.reporting.plan_report import report
from neuroprior.control import ICEMPlanner, PlanarArm, control
from neuroprior.planners import FrontierPlanner, expected_score
from neuroprior.plans import folds
from neuroprior.priors import CombinedPrior, MixturePrior
from neuroprior.priors.scoring import score
from neuroprior.worlds import cube
from tests.support.sources import refuses, seeded

ACTIONS = torch.tensor([[0, 1]])
ARM = PlanarArm()


@pytest.mark.parametrize("what", ["action", "context", "group", "condition"])
@pytest.mark.parametrize(("names", "says"), [(("a", "a"), "twice"), ("ab", "texts"), ((1, 2), "texts")])
def test_names_are_texts_and_distinct(what, names, says):
    numbers = {} if what == "action" else {what: torch.tensor([0])}
    with refuses(f"{what}_names", says):
        RecordedPlans(ACTIONS, 2, **numbers, **{f"{what}_names": names})


def test_numbers_of_actions():
    with refuses("num_actions", "True"):
        Plans(ACTIONS, True)
    with refuses("number the actions from 0"):
        Plans(ACTIONS, 2**32)


def test_weights_that_are_no_numbers(tmp_path):
    prior = GRUPrior(2, hidden_size=4)
    with torch.no_grad():
        next(prior.parameters())[0] = torch.nan
    with refuses("`prior` must be one that can be loaded again", "NaN or infinite"):
        save(prior, tmp_path)


@pytest.mark.parametrize("planner", [SamplingPlanner, MCTSPlanner, FrontierPlanner])
@pytest.mark.parametrize("prior", [None, "gru"])
def test_planners_need_a_prior(planner, prior):
    with refuses("prior", "start and step"):
        planner(prior, 4, 4)


@pytest.mark.parametrize("given", [None, "plans.csv", [[0, 1], [0]], {"actions": 1}])
def test_plans_are_plans_or_tensors(given):
    for learn in (fit, MarkovPrior(2, 1).fit, GRUPrior(2).fit, MarkovPrior(2, 1).log_prob):
        with refuses("plans", "tensor"):
            learn(given)


def test_exact_solutions_need_a_table():
    world = cube()
    with refuses("world", "TabularWorld", "PocketCube"):
        oracle(world, world.reset(2, seeded(0)), 3)
    with refuses("world", "TabularWorld", "PocketCube"):
        expected_score(world, world.reset(2, seeded(0)), torch.zeros(2, 1, 3, dtype=torch.long))


def test_options_of_files_are_not_for_plans_in_memory():
    with refuses("`reading` must be left out"):
        report(Plans(ACTIONS, 2), reading=ReadOptions())


@pytest.mark.parametrize("number", [2.5, float("nan"), None, "3"])
def test_numbers_of_samples_are_integers(number):
    with refuses("num_plans", "integer"):
        UniformPrior(3).sample(number, 4)
    with refuses("length", "integer"):
        UniformPrior(3).sample(4, number)


PLANS = Plans(torch.tensor([[0, 1, 1], [1, 0, 1]]), 2)
FITTED = {"a": UniformPrior(2)}


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Plans([[0, 1], [1]], 2), ["actions", "one length"]),
        (lambda: Plans([["a", "b"]], 2), ["actions", "action_names"]),
        (lambda: Plans(ACTIONS, 2, group=["m1"]), ["group", "group_names"]),
        (lambda: fit(PLANS, MarkovPrior(2, 1)), ["prior", "MarkovPrior", "fit(plans)"]),
        (lambda: UniformPrior(2).sample(2, 3, generator=0), ["generator", "manual_seed"]),
        (lambda: UniformPrior(2).sample(2, 3, temperature="hot"), ["temperature", "'hot'"]),
        (lambda: score(UniformPrior(2), PLANS.actions), ["plans", "Tensor"]),
        (lambda: write_plans(PLANS.actions, "a.npz"), ["plans", "Tensor"]),
        (lambda: ethogram_figure(PLANS.actions), ["plans", "Tensor"]),
        (lambda: load(None), ["folder", "NoneType"]),
        (lambda: save(3, "prior"), ["prior", "int"]),
        (lambda: write_plans(PLANS, None), ["path", "NoneType"]),
        (lambda: Plans(ACTIONS, 2, end=True), ["end", "True"]),
        (lambda: Plans(ACTIONS, 2, action_names=iter("ab")), ["action_names", "list of texts"]),
        (lambda: RecordedPlans(ACTIONS, 2, notes=3), ["notes", "list of texts"]),
        (lambda: read(pd.DataFrame({"x": [0.5]})), ["--columns.behaviour", "x"]),
        (lambda: read(pd.DataFrame({"action": ["a"]}), {"action": "action"}), ["columns", "behaviour", "'action'"]),
        (lambda: read(3), ["paths", "int"]),
        (lambda: read(pd.DataFrame({"action": ["a"]}), missing="drop"), ["missing", "gap", "'drop'"]),
        (lambda: fit(PLANS, 3), ["prior", "a class", "3"]),
        (lambda: fit(PLANS, None), ["prior", "a class", "None"]),
        (lambda: CombinedPrior(2, ["gru"]), ["must be a prior", "'gru'"]),
        (lambda: MixturePrior(2, [MarkovPrior]), ["must be a prior", "MarkovPrior"]),
        (lambda: folds(None, 2), ["plans", "NoneType"]),
        (lambda: analysis.transitions(ACTIONS), ["plans", "Tensor"]),
        (lambda: analysis.motifs([[0, 1]]), ["plans", "list"]),
        (lambda: analysis.score("x", None, PLANS), ["prior", "NoneType"]),
        (lambda: analysis.score_bits("x", "actions", torch.zeros(2, 2), PLANS), ["bits", "[2, 3]", "[2, 2]"]),
        (lambda: analysis.score_bits("x", "actions", torch.full((2, 3), torch.nan), PLANS), ["bits", "NaN"]),
        (lambda: analysis.mode_table(MarkovPrior(2), PLANS), ["prior", "SwitchingPrior"]),
        (lambda: FitOptions(models="counts"), ["`models` must be a list", "'counts'"]),
        (lambda: report(PLANS, priors=UniformPrior(2)), ["`priors` must be a dict"]),
        (lambda: report(PLANS, priors=[UniformPrior(2)]), ["`priors` must be a dict"]),
        (lambda: report(PLANS, priors=FITTED, fits=FitOptions(max_steps=3)), ["`max_steps` must be left out"]),
        (lambda: report(PLANS, priors=FITTED, fits=FitOptions(inputs=["actions"])), ["`inputs` must be left out"]),
        (lambda: SamplingPlanner(UniformPrior(2), 2, 4).plan(ARM, torch.zeros(1, 4)), ["numbered", "got PlanarArm"]),
        (lambda: ExhaustivePlanner(2).plan(PlanarArm, torch.zeros(1, 4)), ["a World", "got the class PlanarArm"]),
        (lambda: ICEMPlanner(2, 4).plan(cube(), torch.zeros(1, 4)), ["a ContinuousWorld", "vectors", "got PocketCube"]),
        (lambda: control(ICEMPlanner(2, 4), None, torch.zeros(1, 4), 2), ["a ContinuousWorld", "got NoneType"]),
        (lambda: report(PLANS, fits=FitOptions(["counts"], folds=3)), ["`folds` must be from 2 to 2", "got 3"]),
    ],
)
def test_arguments_of_other_kinds(call, words):
    with refuses(*words):
        call()


def test_numbers_of_numpy_are_numbers():
    assert UniformPrior(2).sample(2, 3, temperature=np.float32(1)).shape == (2, 3)
    assert len(PLANS.split(np.float32(0.5))[0]) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["report", "FILE", "--columns.acton", "x"], ["columns.acton"]),
        (["fit", "FILE", "--config", "markov", "--prior.hidden", "8"], ["prior", "'hidden'"]),
        (["fit", "FILE", "--prior=markof"], ["`prior` must be one of combined, uniform, markov", "got markof"]),
        (["fit", "FILE", "--prior=markov", "--effort", "fast"], ["`effort` must be left out", "got fast"]),
        (["fit", "FILE", "--prior", "mixture", "--effort=full"], ["`effort` must be left out", "got full"]),
        (["sample", "PRIOR", "--seed", str(2**70)], ["seed", "2**63"]),
        (["score", "PRIOR", "FILE", "--out", "OUT"], ["at least two held-out actions"]),
        (["example", "."], ["ends in .csv"]),
    ],
)
def test_options_that_cannot_be(arguments, words, tmp_path, capsys):
    (tmp_path / "a.csv").write_text("plan,action\n1,0\n")
    save(MarkovPrior(2, 1).fit(PLANS), tmp_path / "prior")
    places = {"FILE": str(tmp_path / "a.csv"), "PRIOR": str(tmp_path / "prior"), "OUT": str(tmp_path / "out")}
    assert main([places.get(argument, argument) for argument in arguments]) == 2
    out, said = capsys.readouterr()
    assert not out
    assert said.startswith("error: ")
    assert len(said) < 500
    assert all(word in said for word in words), said
