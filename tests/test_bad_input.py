"""What no part of the library takes: one clear line each, where it is given."""

import numpy as np
import pytest
import torch

from neuroprior import (
    FrontierPlanner,
    GRUPrior,
    MarkovPrior,
    MCTSPlanner,
    Plans,
    SamplingPlanner,
    UniformPrior,
    fit,
    load,
    oracle,
    read_plans,
    save,
)
from neuroprior.planners import expected_score
from neuroprior.report import report
from neuroprior.values import q_learning
from neuroprior.worlds import cube
from tests.support.sources import refuses, seeded

ACTIONS = torch.tensor([[0, 1]])


@pytest.mark.parametrize("what", ["action", "context", "group", "condition"])
@pytest.mark.parametrize(("names", "says"), [(("a", "a"), "twice"), ("ab", "texts"), ((1, 2), "texts")])
def test_names_are_texts_and_distinct(what, names, says):
    numbers = {} if what == "action" else {what: torch.tensor([0])}
    with refuses(f"{what}_names", says):
        Plans(ACTIONS, 2, **numbers, **{f"{what}_names": names})


def test_numbers_of_actions(tmp_path):
    with refuses("num_actions", "True"):
        Plans(ACTIONS, True)
    np.savez(tmp_path / "a.npz", actions=np.array([[0, 2**62]]))
    with refuses("a.npz", "number the actions from 0"):
        read_plans(tmp_path / "a.npz")


def test_weights_that_are_no_numbers(tmp_path):
    prior = GRUPrior(2, hidden_size=4)
    with torch.no_grad():
        next(prior.parameters())[0] = torch.nan
    with refuses("model.safetensors", "NaN"):
        load(save(prior, tmp_path))


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
        q_learning(world, 0)
    with refuses("world", "TabularWorld", "PocketCube"):
        expected_score(world, world.reset(2, seeded(0)), torch.zeros(2, 1, 3, dtype=torch.long))


@pytest.mark.parametrize("option", [{"max_gap": 0}, {"max_gap": 0.0}, {"num_actions": 0}, {"merge_repeats": True}])
def test_options_of_files_are_not_for_plans_in_memory(option):
    with refuses(next(iter(option)), "for files only"):
        report(Plans(ACTIONS, 2), models=["counts"], **option)


@pytest.mark.parametrize("number", [2.5, float("nan"), None, "3"])
def test_numbers_of_samples_are_integers(number):
    with refuses("num_plans", "integer"):
        UniformPrior(3).sample(number, 4)
    with refuses("length", "integer"):
        UniformPrior(3).sample(4, number)
