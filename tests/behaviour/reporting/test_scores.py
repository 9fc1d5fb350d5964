"""From the results of jobs to the tables of a report: made-up results, and numbers by hand."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from neuroprior.behaviour import PastDurations, RecordedPlans
from neuroprior.behaviour.analysis.comparison import action_bits, score_bits
from neuroprior.behaviour.reporting.fits import ACTIONS, CONTEXT, DURATIONS, Design, Job
from neuroprior.behaviour.reporting.scores import (
    Evaluation,
    Model,
    evaluate,
    evaluate_saved,
    load_arrays,
    save_arrays,
)
from neuroprior.plans import Plans
from neuroprior.plans.folds import folds
from neuroprior.plans.sequences import plans_digest
from neuroprior.priors import GRUPrior, MarkovPrior, UniformPrior
from tests.support.sources import refuses, seeded

PLANS = RecordedPlans(torch.randint(3, (6, 4), generator=seeded(0)), 3)
MASK = PLANS.mask()


def model(name: str, bits: list[float], inputs: str = ACTIONS, mask: torch.Tensor = MASK) -> Model:
    """A model that takes so many bits for each action of each of the six plans."""
    each = torch.tensor(bits, dtype=torch.float64)[:, None] * mask
    return Model(name, inputs, "", each, score_bits(name, inputs, each, PLANS, mask))


def evaluation(*models: Model, reference: int = 0) -> Evaluation:
    return Evaluation(PLANS, PLANS, MASK, models, (models[reference], "it"), PLANS, pd.DataFrame(), {})


def test_a_model_is_named_with_its_input():
    labels = [model("gru", [1.0] * 6, inputs).label for inputs in (ACTIONS, CONTEXT, DURATIONS)]
    assert labels == ["gru", "gru, with context", "gru, with durations"]


def test_bits_nats_perplexity_and_differences():
    """Plans of 1 to 6 bits per action against plans of 2: Student's interval over the six."""
    table = evaluation(model("a", [2.0] * 6), model("b", [1.0, 2, 3, 4, 5, 6])).table()
    same, other = table.to_dict("records")
    half = 2.5705818356 * (3.5 / 6) ** 0.5  # the 97.5 % quantile of t with 5 degrees of freedom, times the error
    for row, ends in ((same, (2, 2, 2)), (other, (3.5, 3.5 - half, 3.5 + half))):
        assert [row[name] for name in ("bits_per_behaviour", "low", "high")] == pytest.approx(ends)
        nats = [row[name] for name in ("nats_per_behaviour", "nats_low", "nats_high")]
        assert nats == pytest.approx([0.6931471806 * end for end in ends])
        powers = [row[name] for name in ("perplexity", "perplexity_low", "perplexity_high")]
        assert powers == pytest.approx([2**end for end in ends])
    assert [other[name] for name in ("more", "more_low", "more_high")] == pytest.approx([1.5, 1.5 - half, 1.5 + half])
    assert 0.05 < other["p_value"] < 0.2
    assert same["more"] == 0


def test_there_is_no_difference_between_scores_of_other_actions():
    """A model that predicts the ends of plans too has as many plans, but more actions."""
    fewer = MASK.clone()
    fewer[:, -1] = False
    first, second = evaluation(model("a", [2.0] * 6), model("b", [1.0] * 6, mask=fewer)).table().to_dict("records")
    assert first["more"] == 0
    assert pd.isna(second["more"])
    assert second["bits_per_behaviour"] == pytest.approx(1)


def results(*named: tuple[str, str], number: int, bits: float) -> dict[str, np.ndarray]:
    """Made-up arrays of models, given by name and settings: so many bits for each action of each plan."""
    found = {}
    for place, (name, how) in enumerate(named):
        found[f"{name}/how"] = np.array(how)
        found[f"{name}/bits"] = np.full((number, 4), bits + 10 * place, dtype=np.float32)
    return found


def test_the_results_of_folds_are_put_together():
    """Each fold's where its plans stand; what a model lacks in a fold leaves it out."""
    design = Design(3, skip=1)
    held_out = [index for _, index in folds(PLANS, 3, 0)]
    assert torch.cat(held_out).tolist() != [*range(6)]
    names = [("context tree", "deep"), ("markov-1", "a"), ("uniform", "")], [("context tree", "deep"), ("uniform", "")]
    todo = [Job(fold, "counts", inputs) for inputs in (CONTEXT, ACTIONS) for fold in range(3)]
    found = [
        results(*names[job.fold == 1], number=len(held_out[job.fold]), bits=job.fold + (job.inputs == CONTEXT))
        for job in todo
    ]
    made = evaluate(PLANS, None, design, todo, found)
    labels = ["uniform", "context tree", "uniform, with context", "context tree, with context"]
    assert [one.label for one in made.models] == labels
    tree = made.models[1]
    for fold, index in enumerate(held_out):
        assert (tree.bits[index] == fold).all()
    assert tree.how == "deep"
    assert made.first_fold.actions.equal(PLANS.actions[held_out[0]])
    assert made.mask.equal(torch.arange(4).expand(6, 4) >= 1)
    assert tree.cost == pytest.approx(1)  # as many plans in each fold: the mean of 0, 1 and 2
    assert made.reference == (tree, "context tree")
    assert made.settings["folds"] == 3


def test_the_settings_of_all_folds_are_named_once():
    design, todo = Design(3), [Job(fold, "counts", ACTIONS) for fold in range(3)]
    found = [results(("markov-1", how), number=2, bits=1.0) for how in ("b", "a", "b")]
    (one,) = evaluate(PLANS, None, design, todo, found).models
    assert one.how == "b, a"


def test_gains_are_those_of_the_next_lag():
    """Of two units with two and four actions; 3, 2 and 1.5 bits per action with no, one and two past ones known."""
    actions = np.array([[2.0, 4.0]] * 3)
    bits = actions * np.array([[3.0], [2.0], [1.5]])
    counts = results(("markov-1", ""), number=6, bits=1.0)
    todo = [Job(0, "gru-lags", CONTEXT), Job(0, "lags", CONTEXT), Job(0, "gru-lags", ACTIONS), Job(0, "lags", ACTIONS)]
    found = [{f"{name}/bits": bits, f"{name}/actions": actions} for name in ("gru", "markov") * 2]
    made = evaluate(PLANS, PLANS, Design(1), [*todo, Job(0, "counts", ACTIONS)], [*found, counts]).gains
    order = [("markov", ACTIONS), ("gru", ACTIONS), ("gru", CONTEXT), ("markov", CONTEXT)]
    assert list(zip(made["model"], made["input"], strict=True))[::2][:2] == order[:2]
    assert set(zip(made["model"][4:], made["input"][4:], strict=True)) == set(order[2:])
    assert made["lag"].tolist() == [1, 2] * 4
    assert made["bits"].tolist() == pytest.approx([1.0, 0.5] * 4)
    assert (made["units"] == 2).all()


def test_saved_priors_are_compared_with_the_first():
    """The first `skip` actions do not count; units are the groups; the input is what a prior takes."""
    plans = replace(PLANS, group=torch.tensor([0, 0, 0, 1, 1, 1]), context=torch.arange(6) % 2)
    priors = {"b": UniformPrior(3), "a": MarkovPrior(3, 1, num_contexts=2).fit(plans)}
    made = evaluate_saved(priors, plans, 1)
    assert [one.label for one in made.models] == ["b", "a, with context"]
    assert made.reference == (made.models[0], "b")
    assert made.models[0].cost == pytest.approx(math.log2(3))
    for one in made.models:
        assert one.score.actions.tolist() == [9, 9]
    assert made.models[1].bits.equal(action_bits(priors["a"], plans))


def test_a_saved_prior_of_durations_says_so():
    plans = replace(PLANS, durations=torch.rand(6, 4, generator=seeded(1)) + 0.5)
    prior = GRUPrior(3, context_size=2, hidden_size=4)
    past = PastDurations.of(plans)
    (one,) = evaluate_saved({"it": prior}, plans, 0, past_durations={"it": past}).models
    assert one.label == "it, with durations"
    assert one.bits.equal(action_bits(prior, past.added_to(plans)))


def test_a_digest_is_of_all_that_plans_hold():
    ones = torch.ones(6, dtype=torch.long)
    changed = [PLANS, replace(PLANS, action_names=("a", "b", "c")), replace(PLANS, group=ones)]
    changed += [replace(PLANS, condition=ones), replace(PLANS, context=ones), PLANS[:5]]
    # The same bytes in another shape.
    changed.append(Plans(PLANS.actions.view(4, 6), 3))
    digests = [plans_digest(plans) for plans in changed]
    assert len(set(digests)) == len(digests)
    assert plans_digest(replace(PLANS)) == digests[0]


def test_results_are_written_and_read(tmp_path):
    path, arrays = tmp_path / "a.npz", {"gru/bits": np.arange(3.0), "gru/how": np.array("x")}
    save_arrays(path, arrays)
    again = load_arrays(path)
    assert again.keys() == arrays.keys()
    assert all((again[name] == array).all() for name, array in arrays.items())
    whole = path.read_bytes()
    path.write_bytes(b"")
    with refuses(""):
        load_arrays(path)
    refused = 0
    for at in range(0, len(whole), 3):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        try:
            load_arrays(path)
        except ValueError:
            refused += 1
    assert refused > 50
