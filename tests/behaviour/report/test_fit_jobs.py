"""One job of a cross-validation: what belongs to which plan, unit, context and lag, by hand-made plans."""

import math
from dataclasses import replace

import pytest
import torch

from neuroprior.behaviour.report import fits
from neuroprior.behaviour.report.fits import ACTIONS, COMBINED, CONTEXT, Design, Job, counted, fit_and_score
from neuroprior.behaviour.report.scores import jobs
from neuroprior.plans import Plans
from neuroprior.plans.folds import folds
from neuroprior.priors import StackedPrior
from tests.support.sources import seeded


def drawn(num: int, length: int, actions: int = 3, seed: int = 0, **more) -> Plans:
    return Plans(torch.randint(actions, (num, length), generator=seeded(seed)), actions, **more)


@pytest.mark.parametrize("fold", [0, 1, 2])
def test_forecasts_are_counted_for_the_unit_of_their_plan(fold):
    """Six animals with 1 to 6 plans; those of a fold alone are counted, each under its own number."""
    group = torch.arange(6).repeat_interleave(torch.arange(1, 7))
    plans, design = drawn(21, 4, group=group), Design(3, skip=1)
    held_out = folds(plans, 3, 0)[fold][1]
    sums = fit_and_score(plans, None, design, Job(fold, "counts", ACTIONS))["uniform/calibration"]
    number = torch.bincount(group[held_out], minlength=6) * 3  # actions of each plan that count
    assert sums[:6, :, 2].sum(1).tolist() == (number * 3).tolist()
    assert sums[6:].sum() == 0


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


def test_samples_have_the_contexts_of_the_plans_whose_place_they_take():
    """A context that is the plan's only action: of 200 sampled actions hardly any is another one's."""
    context = torch.randint(4, (60,), generator=seeded(0))
    plans = Plans(context[:, None].repeat(1, 5), 4, context=context)
    steps = replace(plans, context=plans.actions)
    for some in (plans, steps):
        made = fit_and_score(some[:40], some[40:], Design(1), Job(0, "counts", CONTEXT))["markov-1/generated"]
        assert (made == plans.actions[40:].numpy()).mean() > 0.95


def test_samples_take_only_actions_that_were_seen_in_their_context():
    """Two contexts in turn, with actions 0 and 1 in the one and 2 and 3 in the other.

    Of 16 plans a chain without smoothing of its own gives the others a few per cent, in 8,000 draws hundreds.
    """
    context = torch.arange(8).repeat(1016, 1) % 2
    actions = 2 * context + torch.randint(2, context.shape, generator=seeded(0))
    plans = Plans(actions, 4, context=context)
    arrays = fit_and_score(plans[:16], plans[16:], Design(1), Job(0, "counts", CONTEXT))
    for model in ("markov-1", "markov-3"):
        assert (torch.from_numpy(arrays[f"{model}/generated"]) // 2).equal(plans.context[16:])


def test_samples_are_drawn_by_the_seed():
    plans, job = drawn(20, 6), Job(0, "counts", ACTIONS)
    first, again, other = (
        fit_and_score(plans, plans, Design(1, seed=seed), job)["uniform/generated"] for seed in (1, 1, 2)
    )
    assert (first == again).all()
    assert (first != other).any()


def test_parts_of_a_plan_skip_the_first_actions_of_the_plan_alone():
    plans = Plans(torch.zeros(2, 4, dtype=torch.long), 2, torch.tensor([4, 2]))
    assert counted(plans, 3).int().tolist() == [[0, 0, 0, 1], [0, 0, 0, 0]]
    assert counted(plans, 3, cut=True).int().tolist() == [[0, 0, 0, 1], [1, 1, 0, 0]]
