"""Durations: laws fitted and chosen, likelihoods in closed form, samples, and priors whose plans have them."""

from dataclasses import replace
from math import inf, log, nan

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from neuroprior.behaviour import DurationModel, SemiMarkovPrior
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.plans import Plans, folds
from neuroprior.priors import MarkovPrior, fit, load, save
from neuroprior.testing import check_prior
from tests.support.sources import FALSE_ALARM, refuses, seeded

TRUE = {
    "exponential": stats.expon(scale=2.0),
    "gamma": stats.gamma(2.5, scale=1.3),
    "lognormal": stats.lognorm(0.8, scale=1.6),
    "weibull": stats.weibull_min(2.0, scale=3.0),
}


def draw(law: str, number: int, seed: int = 0) -> Tensor:
    random = np.random.default_rng(seed)
    if law != "two-lognormal":
        return torch.from_numpy(TRUE[law].rvs(number, random_state=random))
    first = random.random(number) < 0.3
    return torch.from_numpy(np.where(first, random.lognormal(0, 0.3, number), random.lognormal(2, 0.8, number)))


def of_one_action(times: Tensor | list[float], num_plans: int = 10, **more: object) -> Plans:
    times = torch.as_tensor(times, dtype=torch.double).view(num_plans, -1)
    return RecordedPlans(torch.zeros(times.shape, dtype=torch.long), 1, durations=times, **more)


def transitions(num_plans: int = 40, times: float = 2.0, seed: int = 0, num_actions: int = 3) -> Plans:
    """Actions at random; action 0 takes `times` as long where action 1 follows it."""
    actions = torch.randint(3, (num_plans, 60), generator=seeded(seed))
    durations = draw("gamma", num_plans * 60, seed).view(num_plans, 60)
    durations[:, :-1] *= 1 + (times - 1) * ((actions[:, :-1] == 0) & (actions[:, 1:] == 1))
    return RecordedPlans(actions, num_actions, durations=durations)


def test_the_likelihood_of_an_exponential_in_closed_form():
    times = torch.tensor([[1.0, 2.0, 3.0], [4.0, 0.5, 1.5]])
    model = DurationModel(1, ["exponential"]).fit(of_one_action(times, 2))
    assert model.table()[0].parameters["scale"] == pytest.approx(2)
    assert torch.allclose(model.log_prob(of_one_action(times, 2)), -times.double() / 2 - log(2), atol=1e-7)
    assert model.cdf(0, torch.tensor([0.0, 2.0])).tolist() == pytest.approx([0, 1 - np.exp(-1)])


@pytest.mark.parametrize("law", TRUE)
def test_fits_and_densities_are_those_of_scipy(law):
    times = draw(law, 2000)
    model = DurationModel(1, [law]).fit(of_one_action(times))
    family = {"gamma": stats.gamma, "lognormal": stats.lognorm, "weibull": stats.weibull_min}.get(law, stats.expon)
    own = family(*family.fit(times.float().numpy(), floc=0))
    log_density = model.log_prob(of_one_action(times)).flatten().numpy()
    assert log_density == pytest.approx(own.logpdf(times.float().numpy()), abs=2e-3)
    assert model.cdf(0, times).numpy() == pytest.approx(own.cdf(times.numpy()), abs=1e-3)


@pytest.mark.parametrize("law", [*TRUE, "two-lognormal"])
def test_the_true_law_is_chosen_and_sampled(law):
    """Of 5,000 draws. The samples are tested against the fitted law, Kolmogorov and Smirnov's test."""
    model = DurationModel(1).fit(of_one_action(draw(law, 5000)))
    (chosen,) = model.table()
    assert (chosen.law, chosen.number) == (law, 5000)
    if law == "gamma":
        assert chosen.parameters == pytest.approx({"shape": 2.5, "scale": 1.3}, rel=0.06)  # 3 standard errors
    if law == "two-lognormal":
        expected = {"share": 0.3, "log_mean": 0, "log_sd": 0.3, "log_mean_2": 2, "log_sd_2": 0.8}
        assert chosen.parameters == pytest.approx(expected, abs=0.06)
    samples = model.sample(torch.zeros(200, 100, dtype=torch.long), generator=seeded(1)).flatten()
    assert stats.kstest(samples, lambda times: model.cdf(0, torch.from_numpy(times)).numpy()).pvalue > FALSE_ALARM


def test_durations_that_depend_on_the_next_action():
    plans = transitions()
    model = DurationModel(3).fit(plans)
    rows = model.table()
    assert [(row.action, row.next_action) for row in rows] == [(a, None) for a in range(3)] + [(0, b) for b in range(3)]
    mean = {row.next_action: row.parameters["shape"] * row.parameters["scale"] for row in rows[3:]}
    assert mean[1] / mean[0] == pytest.approx(2, rel=0.15)
    assert len(DurationModel(3, transitions=False).fit(plans).table()) == 3
    assert len(DurationModel(3).fit(transitions(times=1.0)).table()) == 3


def test_the_last_action_of_a_plan_has_no_next_one():
    """Its law is that of the action; and the law of a transition is taken at the right step."""
    model = DurationModel(3, ["gamma"]).fit(transitions())
    plans = RecordedPlans(torch.tensor([[2, 0, 1, 0]] * 2), 3, torch.tensor([4, 2]), durations=torch.full((2, 4), 5.0))
    found = model.log_prob(plans)
    rows = {(row.action, row.next_action): stats.gamma(row.parameters["shape"], scale=row.parameters["scale"])
            for row in model.table()}  # fmt: skip
    assert found[0].tolist() == pytest.approx(
        [rows[key].logpdf(5) for key in [(2, None), (0, 1), (1, None), (0, None)]], abs=1e-6
    )
    assert found[1].tolist() == pytest.approx([rows[2, None].logpdf(5), rows[0, None].logpdf(5), 0, 0], abs=1e-6)
    actions = torch.tensor([[0, 1, 0]]).repeat(5000, 1)
    samples = model.sample(actions, generator=seeded(0)).double()
    for step, key in ((0, (0, 1)), (2, (0, None))):
        assert stats.kstest(samples[:, step], rows[key].cdf).pvalue > FALSE_ALARM


def test_a_model_is_loaded_as_what_it_is(tmp_path):
    model = DurationModel(3, ["gamma", "weibull"]).fit(transitions())
    assert repr(load(save(model, tmp_path), kind=DurationModel)) == repr(model)
    with refuses("DurationModel", "must hold a Prior", "kind=DurationModel"):
        load(tmp_path)
    save(MarkovPrior(3), tmp_path)
    with refuses("MarkovPrior", "must hold a DurationModel", "kind=MarkovPrior"):
        load(tmp_path, kind=DurationModel)


def test_unknown_durations_are_left_out():
    times = draw("gamma", 1000).view(10, 100)
    missing = torch.rand(10, 100, generator=seeded(0)) < 0.3
    actions = torch.zeros(10, 100, dtype=torch.long)
    some = DurationModel(1).fit(RecordedPlans(actions, 1, durations=times.masked_fill(missing, nan)))
    alone = RecordedPlans(actions, 1, (~missing).sum(1), durations=torch.nn.utils.rnn.pad_sequence(
        [row[~gone] for row, gone in zip(times, missing, strict=True)], batch_first=True
    ).new_zeros(10, 100).masked_scatter(torch.arange(100) < (~missing).sum(1)[:, None], times[~missing]))  # fmt: skip
    assert some.table() == DurationModel(1).fit(alone).table()
    assert (some.log_prob(RecordedPlans(actions, 1, durations=times.masked_fill(missing, nan))) == 0).equal(missing)


def test_point_events():
    """Durations of 0 have a probability; an action that takes no time never does, and the others always do."""
    actions = torch.tensor([[0, 1, 2] * 20] * 10)
    durations = draw("gamma", 600).view(10, 60).masked_fill(actions == 0, 0)
    durations[(actions == 1) & (torch.arange(60) % 4 == 0)] = 0
    plans = RecordedPlans(actions, 3, durations=durations)
    model = DurationModel(3).fit(plans)
    assert [row.zero for row in model.table()] == [1, 0.25, 0]
    found = model.log_prob(plans)
    assert found[actions == 0].tolist() == [0] * 200
    assert torch.allclose(found[(actions == 1) & (durations == 0)], torch.tensor(log(0.25)).double())
    assert bool(found.isfinite().all())
    assert model.cdf(1, torch.tensor([0.0])).item() == 0.25
    never = RecordedPlans(actions, 3, durations=torch.where(actions == 2, 0.0, 1.0))
    assert model.log_prob(never)[actions != 1].tolist() == [-inf] * 400
    samples = model.sample(torch.arange(3).repeat(20000, 1), generator=seeded(0))
    zeros = (samples == 0).sum(0).tolist()
    assert (zeros[0], zeros[2]) == (20000, 0)
    assert stats.binomtest(zeros[1], 20000, 0.25).pvalue > FALSE_ALARM


def test_constant_durations_vary_by_a_hundredth():
    model = DurationModel(1).fit(of_one_action([0.5] * 100))
    samples = model.sample(torch.zeros(1000, 1, dtype=torch.long), generator=seeded(0))
    assert bool(model.log_prob(of_one_action([0.5] * 100)).isfinite().all())
    assert float(samples.mean()) == pytest.approx(0.5, rel=0.01)
    assert float(samples.std()) < 0.01


def test_no_law_is_narrower_than_the_rounding():
    """Counts of frames hold each value many times, on which a narrow law would be infinitely likely."""
    frames = draw("gamma", 5000).mul(2).ceil() / 25
    frames[torch.rand(5000, generator=seeded(0)) < 0.5] = 1 / 25
    (row,) = DurationModel(1, ["two-lognormal"]).fit(of_one_action(frames)).table()
    assert row.parameters["log_mean"] == pytest.approx(log(1 / 25), abs=0.1)
    for mean, spread in (("log_mean", "log_sd"), ("log_mean_2", "log_sd_2")):
        assert row.parameters[spread] >= 0.95 * 12**-0.5 / 25 / np.exp(row.parameters[mean])


def test_actions_with_few_durations_have_the_law_of_all():
    actions = torch.tensor([[0, 0, 1, 1, 1, 1]] * 10)
    actions[0, 0] = 2
    durations = draw("weibull", 60).view(10, 6)
    durations[:, 1] = nan
    model = DurationModel(4).fit(RecordedPlans(actions, 4, durations=durations))
    rows = model.table()
    assert [row.number for row in rows] == [0, 40, 0, 0]
    assert rows[0][2:] == rows[2][2:] == rows[3][2:]
    assert rows[0].law == "weibull"
    one = DurationModel(1).fit(of_one_action([3.0], 1))
    assert one.table()[0].parameters == pytest.approx({"scale": 3})


def test_few_durations_of_an_action_say_little_of_how_many_are_0():
    """Fewer than ten: their share is that of all actions together."""
    actions = torch.tensor([0] * 20 + [1] * 9 + [2] * 10).view(3, 13)
    durations = draw("gamma", 39).view(3, 13)
    durations[(torch.arange(39).view(3, 13) % 4 == 0) & (actions != 2)] = 0
    zeros = int((durations == 0).sum())
    rows = DurationModel(4).fit(RecordedPlans(actions, 4, durations=durations)).table()
    assert [row.zero for row in rows] == pytest.approx([0.25, zeros / 39, 0, zeros / 39])


KNOWN = {"exponential": 1, "gamma": 2, "lognormal": 2, "weibull": 2}
"""Laws and their parameters; mixtures take long to fit."""


def held_out(law: str, plans: Plans) -> Tensor:
    """`[N, L]`: the log-densities of durations under a law of each action, fitted without their part of the plans."""
    found = torch.zeros(plans.actions.shape, dtype=torch.double)
    for training, out in folds(plans, 5):
        model = DurationModel(plans.num_actions, [law], transitions=False).fit(plans[training])
        found[out] = model.log_prob(plans[out])
    return found


def test_a_law_is_worth_its_parameters():
    """Of 30 actions, the law with the greatest held-out likelihood less 2 nats a parameter is that of each."""
    actions = torch.arange(30).repeat(10, 5)
    shape = 0.8 + actions.double() / 50
    gamma = torch.distributions.Gamma(shape, torch.ones_like(shape))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        plans = RecordedPlans(actions, 30, durations=gamma.sample())
    scores = torch.stack([held_out(law, plans) for law in KNOWN]).flatten(1)
    sums = torch.zeros(len(KNOWN), 30, dtype=torch.double).index_add_(1, actions.flatten(), scores)
    best = (sums - 2 * torch.tensor([*KNOWN.values()])[:, None]).argmax(0)
    assert not best.equal(sums.argmax(0))
    assert 5 < (best == 0).sum() < 30
    rows = DurationModel(30, [*KNOWN], transitions=False).fit(plans).table()
    assert [row.law for row in rows] == [[*KNOWN][k] for k in best.tolist()]


def test_transitions_are_worth_their_parameters():
    """An action has laws of its transitions where these gain more than 2 nats for each parameter of each of them."""
    decided = []
    for seed, times in enumerate((1.0, 1.1, 1.2, 1.25, 1.3, 1.35, 1.4, 1.5)):
        plans = transitions(20, times, seed)
        plans = replace(plans, actions=plans.actions[:, :21], durations=plans.durations[:, :21])
        pair = plans.actions[:, :-1] * 3 + plans.actions[:, 1:]
        each = held_out("gamma", RecordedPlans(pair, 9, durations=plans.durations[:, :-1]))
        gain = each - held_out("gamma", plans)[:, :-1]
        price = 2 * 2 * 3
        own = [float(gain[plans.actions[:, :-1] == action].sum()) for action in range(3)]
        rows = DurationModel(3, ["gamma"]).fit(plans).table()[3:]
        assert {row.action for row in rows} == {action for action in range(3) if own[action] > price}
        decided += own
    assert min(abs(value - price) for value in decided) > 0.01
    assert any(price / 3 < value < price for value in decided)


def test_one_plan_is_held_out_by_time():
    plans = of_one_action(draw("lognormal", 1000), 1)
    assert DurationModel(1).fit(plans).table()[0].law == "lognormal"


def test_laws_are_held_out_by_group():
    """Within an animal durations are all but constant: narrow laws predict its sessions, but no other animal."""
    level = torch.tensor([1.0, 3.0])[:, None].repeat(1, 10)
    times = (level.flatten()[:, None] * torch.exp(0.01 * torch.randn(20, 30, generator=seeded(0)))).double()
    gain = {}
    for group in (None, torch.arange(2).repeat_interleave(10)):
        (row,) = DurationModel(1, ["exponential", "two-lognormal"]).fit(of_one_action(times, 20, group=group)).table()
        gain[group is None] = row.law
    assert gain == {True: "two-lognormal", False: "exponential"}


def test_the_end_symbol_takes_no_time():
    """Whatever stands in its place; and it is no point event that others would be taken to be like."""
    plans = transitions(num_actions=4).with_end()
    for there in (0.0, 5.0, nan):
        durations = plans.durations.clone()
        durations[:, -1] = there
        same = replace(plans, durations=durations)
        prior = SemiMarkovPrior(5).fit(same)
        rows = prior.durations.table()
        assert [(row.number > 0, row.zero) for row in rows[:5]] == [(True, 0)] * 3 + [(False, 0)] * 2
        assert bool((prior.durations.log_prob(same)[:, -1] == 0).all())
        sampled = prior.sample_plans(50, 20, generator=seeded(0))
        assert sampled.end == 4
        assert bool(((sampled.durations == 0) == ~(sampled.mask() & (sampled.actions != 4))).all())


def test_a_semi_markov_prior_is_its_action_prior_with_durations():
    plans = transitions()
    prior = fit(plans, "semi-markov")
    chain = MarkovPrior(3).fit(plans)
    assert prior.log_prob(plans).equal(chain.log_prob(plans))
    assert prior.duration_log_prob(plans).tolist() == DurationModel(3).fit(plans).log_prob(plans).sum(1).tolist()
    check_prior(prior, num_plans=2000)


FEW = transitions(4)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: SemiMarkovPrior(3).fit(Plans(FEW.actions, 3)), "durations: these plans have none"),
        (
            lambda: DurationModel(3).fit(replace(FEW, durations=torch.full((4, 60), nan))),
            "`durations` must have one at least",
        ),
        (lambda: DurationModel(2).fit(FEW), "`plans` must have 2 actions, as this model, got 3"),
        (lambda: SemiMarkovPrior(3).fit(FEW, max_steps=3), "max_steps: not a setting"),
        (lambda: DurationModel(3, ["normal"]), "`laws` must be some of exponential"),
        (lambda: DurationModel(3, []), "`laws` must be some of exponential"),
        (lambda: SemiMarkovPrior(3, MarkovPrior(4)), "`actions` must be a prior of 3 actions, got 4"),
        (lambda: DurationModel(3).cdf(3, torch.ones(1)), "out of range"),
    ],
)
def test_what_is_refused(call, words):
    with refuses(words):
        call()
