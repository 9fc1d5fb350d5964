"""One job of a cross-validation: what belongs to which plan, unit, context and lag, by hand-made plans."""

import math

import pytest
import torch

from neuroprior.behaviour.report import fits
from neuroprior.behaviour.report.fits import ACTIONS, COMBINED, CONTEXT, Design, Job, counted, fit_and_score
from neuroprior.behaviour.report.scores import jobs
from neuroprior.plans import Plans
from neuroprior.priors import StackedPrior
from tests.support.sources import seeded


def drawn(num: int, length: int, actions: int = 3, seed: int = 0, **more) -> Plans:
    return Plans(torch.randint(actions, (num, length), generator=seeded(seed)), actions, **more)


def test_the_networks_among_experts_are_counted_again_on_all_that_is_learned(monkeypatch):
    """The stacked prior learned its weights beside validation plans; its counts are then those of all plans."""
    made = []

    def experts(learned: Plans, *others: object) -> list[StackedPrior]:
        stacked = StackedPrior(3).fit(learned, max_steps=1, progress=False, generator=seeded(0))
        made.append((stacked, stacked.action_log_probs(test)))
        return [stacked]

    plans, test = drawn(20, 6), drawn(4, 6, seed=1)
    monkeypatch.setattr(fits, "fitted_experts", experts)
    found = fit_and_score(plans, test, Design(1), Job(0, COMBINED, ACTIONS))["stacked/bits"]
    ((stacked, before),) = made
    after = -stacked.recount(plans).action_log_probs(test).detach() / math.log(2)
    assert found == pytest.approx(after.numpy(), abs=1e-6)
    assert abs(found + before.detach().numpy() / math.log(2)).max() > 1e-3


@pytest.mark.parametrize(
    ("effort", "apart"),
    [("fast", {"stacked", "transformer"}), ("standard", {"transformer"}), ("full", set())],
)
def test_the_networks_among_experts_are_fitted_once(effort, apart, monkeypatch):
    """The job of the combined prior trains what its effort says, and scores it as models of their own."""
    trained = []
    plans, design = drawn(20, 6), Design(2, max_steps=1, effort=effort)
    monkeypatch.setattr("neuroprior.training.train", lambda prior, *_: trained.append(type(prior)))
    networks = {"gru", "stacked", "transformer"}
    todo = jobs(design, [*networks, COMBINED, "counts"], [ACTIONS])
    assert {job.kind for job in todo} == {COMBINED, "counts"} | apart
    found = fit_and_score(plans, None, design, Job(0, COMBINED, ACTIONS))
    assert {name.removesuffix("/bits") for name in found if name.endswith("/bits")} == {COMBINED} | networks - apart
    assert len(trained) == {"fast": 1, "standard": 2, "full": 3}[effort]


def test_the_reach_of_lags_is_half_of_the_shorter_plans():
    """Learned from plans of 12 actions and scored on plans of 6, or the other way round: 0 to 3 known ones."""
    long, short = drawn(20, 12), drawn(6, 6, seed=1)
    for plans, test in ((long, short), (short, long[:6])):
        arrays = fit_and_score(plans, test, Design(1, reach=5), Job(0, "lags", ACTIONS))
        assert arrays["markov/bits"].shape == (4, 6)
    assert fit_and_score(drawn(20, 1), short, Design(1), Job(0, "lags", ACTIONS)) == {}


def test_all_pieces_and_all_lags_are_scored():
    plans, design = drawn(40, 12), Design(2, reach=3, max_steps=1)
    for kind, name in (("lags", "markov"), ("gru-lags", "gru")):
        arrays = fit_and_score(plans, None, design, Job(0, kind, ACTIONS))
        assert arrays[f"{name}/actions"].sum(1).tolist() == [20 * 9] * 4


def test_a_context_that_tells_the_action_leaves_nothing_to_the_past():
    """Nothing known but the context: hardly a bit; without it all of the bits of three equally frequent actions."""
    context = torch.randint(3, (60, 6), generator=seeded(0))
    plans = Plans(context, 3, context=context)
    for inputs, low, high in ((CONTEXT, 0, 0.1), (ACTIONS, 1.5, 1.7)):
        arrays = fit_and_score(plans, None, Design(2, reach=2), Job(0, "lags", inputs))
        assert low < arrays["markov/bits"][0].sum() / arrays["markov/actions"][0].sum() < high


def test_parts_of_a_plan_skip_the_first_actions_of_the_plan_alone():
    plans = Plans(torch.zeros(2, 4, dtype=torch.long), 2, torch.tensor([4, 2]))
    assert counted(plans, 3).int().tolist() == [[0, 0, 0, 1], [0, 0, 0, 0]]
    assert counted(plans, 3, cut=True).int().tolist() == [[0, 0, 0, 1], [1, 1, 0, 0]]
