"""Cross-validation of models: scores against fits made by hand, and what makes finished fits count."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neuroprior.behaviour.analysis.comparison import DEPTH, score_bits, units
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.reporting import fits
from neuroprior.behaviour.reporting.fits import (
    ACTIONS,
    COMBINED,
    CONTEXT,
    DURATIONS,
    KINDS,
    Design,
    Job,
    counted,
    fit_and_score,
    split,
)
from neuroprior.behaviour.reporting.scores import Evaluation, cross_validation, evaluate, jobs
from neuroprior.plans import Plans
from neuroprior.plans.folds import folds, in_parts
from neuroprior.priors import ContextTreePrior, GRUPrior, MarkovPrior, StackedPrior
from neuroprior.priors.counts import BACKOFFS_TRIED
from neuroprior.priors.ensembles.candidates import Experts
from tests.support.chains import markov_plans, markov_probs
from tests.support.sources import refuses, seeded

STEPS = 3  # of neural priors, where they do not matter


def chain(num: int = 24, length: int = 7, seed: int = 0, **more) -> RecordedPlans:
    plans = RecordedPlans.of(markov_plans(markov_probs(3, 1, 0, 1.5), num, length, seed))
    lengths = torch.randint(2, length + 1, (num,), generator=seeded(seed + 1))
    return replace(plans, lengths=lengths, **more)


def context_of(kind: str, num: int = 24, length: int = 7) -> torch.Tensor | None:
    if kind == "nothing":
        return None
    shape = (num, length) if "step" in kind else (num,)
    if "features" in kind:
        return torch.randn(*shape, 2, generator=seeded(5))
    return torch.randint(3, shape, generator=seeded(5))


def evaluated(plans: Plans, folder: Path, kinds=("counts",), inputs=(ACTIONS,), **design) -> Evaluation:
    """Models fitted and scored in two folds, or as `design` says."""
    made = Design(**({"folds": 2, "max_steps": STEPS} | design))
    todo = jobs(made, kinds, inputs)
    return evaluate(plans, None, made, todo, cross_validation(folder, plans, None, made).do(todo, processes=1))


def test_which_plans_are_scored():
    plans = chain(group=torch.arange(24) % 4)
    mask = plans.mask()
    mask[:, :2] = False
    assert counted(plans, 2).equal(mask)
    parts = in_parts(Plans(torch.zeros(1, 10, dtype=torch.long), 3), 4)  # of 3, 3, 3 and 1 actions
    assert counted(parts, 4, cut=True).int().tolist() == [[0, 0, 0], [0, 1, 1], [1, 1, 1], [1, 0, 0]]
    for fold, (training, held_out) in enumerate(folds(plans, 3, 0)):
        own, index = split(plans, None, Design(3), fold)
        assert own.actions.equal(plans[training].actions)
        assert index.equal(held_out)
    own, index = split(plans, chain(10, 5, seed=8), Design(1), 0)
    assert len(own) == 24
    assert index.tolist() == list(range(10))


def test_whatever_changes_results_makes_another_run(tmp_path):
    plans, design = chain(), Design(3, max_steps=STEPS)
    base = cross_validation(tmp_path, plans, None, design).folder
    assert cross_validation(tmp_path, plans, None, design).folder == base
    other = replace(plans, actions=(plans.actions + 1) % 3)
    changes = ({"skip": 1}, {"folds": 4}, {"seed": 1}, {"max_steps": 4}, {"version": "0"})
    made = [base, *(cross_validation(tmp_path, plans, None, replace(design, **change)).folder for change in changes)]
    alike = (other, replace(plans, action_names=("a", "b", "c")), plans[:23])
    made += [cross_validation(tmp_path, some, None, design).folder for some in alike]
    made += [cross_validation(tmp_path, plans, test, design).folder for test in (plans, other)]
    made += [cross_validation(tmp_path, other, plans, design).folder]
    assert len(set(made)) == len(made)


def test_jobs():
    made = jobs(Design(3), ["counts", "lags", "gru-lags", "gru"], [ACTIONS, CONTEXT])
    assert len(made) == len(set(made)) == 3 * 2 * 2 + 4
    assert len({str(job) for job in made}) == len(made)
    kinds = [job.kind for job in made]
    assert kinds == sorted(kinds, key=KINDS.index)  # the slowest first
    assert {job.fold for job in made if "lags" in job.kind} == {0}
    for inputs in (ACTIONS, CONTEXT):
        assert {job.fold for job in made if (job.kind, job.inputs) == ("gru", inputs)} == {0, 1, 2}


def by_hand(model: str, learned: Plans, held: Plans, seed: int, contexts: int | None) -> torch.Tensor:
    """Bits `[n, L]` of a count-based model: settings chosen on a tenth, then fitted to all; without the program."""
    training, validation = learned.split(0.1, seeded(seed))
    if model == "context tree":
        tried = [ContextTreePrior(3, DEPTH, num_contexts=contexts)]
    else:
        order = int(model.removeprefix("markov-"))
        tried = [MarkovPrior(3, order, s, num_contexts=contexts, backoff=b) for b, s in BACKOFFS_TRIED]
    cost = [-float(p.fit(training).log_prob(validation).sum()) for p in tried]
    best = tried[cost.index(min(cost))].fit(learned)
    return -best.action_log_probs(held).double() / math.log(2)


@pytest.mark.parametrize(
    ("kind", "grouped", "skip"),
    [
        ("nothing", False, 0),
        ("index a sequence", True, 0),
        pytest.param("index a step", False, 0, marks=pytest.mark.slow),
        ("index a step", True, 2),
    ],
)
def test_scores_are_those_of_fits_by_hand(kind, grouped, skip, tmp_path):
    group = torch.arange(24) % 5 * 10 - 10 if grouped else None
    plans = chain(context=context_of(kind), group=group)
    inputs = [ACTIONS] + [CONTEXT] * (kind != "nothing")
    found = evaluated(plans, tmp_path, inputs=inputs, skip=skip)
    assert len(found.models) == 9 + 8 * (kind != "nothing")  # the uniform prior takes no context
    mask = plans.mask()
    mask[:, :skip] = False
    compared = 0
    for model in found.models:
        assert (model.name, model.inputs) == (model.score.model, model.score.inputs)
        if model.name not in ("markov-0", "markov-1", "markov-3", "context tree"):
            continue
        blind = model.inputs == ACTIONS
        own = replace(plans, context=None) if blind else plans
        want = torch.zeros(plans.actions.shape, dtype=torch.double)
        for fold, (training, held_out) in enumerate(folds(plans, 2, 0)):
            want[held_out] = by_hand(model.name, own[training], own[held_out], fold, None if blind else 3)
        torch.testing.assert_close(model.bits.double(), want, rtol=1e-5, atol=1e-5)
        total = want[mask].sum() / mask.sum()
        assert model.cost == pytest.approx(float(total), abs=1e-5)
        assert float(model.score.actions.sum()) == int(mask.sum())
        assert len(model.score.bits) == (5 if grouped else int(mask.any(1).sum()))
        compared += 1
    assert compared == 4 * len(inputs)


@pytest.mark.parametrize("kind", [pytest.param("features a sequence", marks=pytest.mark.slow), "features a step"])
def test_features_are_for_neural_models_alone(kind, tmp_path):
    plans = chain(context=context_of(kind))
    found = evaluated(plans, tmp_path, ("counts", "gru"), (ACTIONS, CONTEXT), seed=3)
    assert [model.name for model in found.models if model.inputs == CONTEXT] == ["gru"]
    want = torch.zeros(plans.actions.shape)
    for fold, (training, held_out) in enumerate(folds(plans, 2, 3)):
        seed = 3000 + fold
        prior = GRUPrior(3, context_size=2, seed=seed)
        prior.fit(plans[training], generator=seeded(seed), max_steps=STEPS, progress=False)
        with torch.no_grad():
            want[held_out] = -prior.action_log_probs(plans[held_out]) / math.log(2)
    torch.testing.assert_close(found.models[-1].bits, want)


def test_the_combined_prior_learns_its_weights_on_plans_that_its_experts_did_not_see(monkeypatch):
    """Actions are independent; a chain of order 6 knows by heart the plans that it counted, and no others."""

    def experts(learned: Plans, *others: object) -> Experts:
        large = MarkovPrior(3, 6, 0.01, backoff="dirichlet")
        return Experts([ContextTreePrior(3, 0).fit(learned), large.fit(learned)], {}, {})

    monkeypatch.setattr(fits, "fitted_experts", experts)
    drawn = torch.multinomial(torch.tensor([0.7, 0.2, 0.1]), 480, True, generator=seeded(0)).view(60, 8)
    found = fit_and_score(Plans(drawn, 3), Plans(drawn[:5], 3), Design(1), Job(0, COMBINED, ACTIONS))
    assert str(found["combined/how"]).split()[1:] == ["contexttree"]


def test_durations_of_other_held_out_plans_do_not_matter():
    """Nor are their logarithms standardised by them: by those of the training plans alone."""
    times = torch.rand(32, 7, generator=seeded(3)) + 0.5
    plans = chain(durations=times[:24])
    design, job = Design(1, max_steps=1), Job(0, "gru", DURATIONS)
    test = RecordedPlans(plans.actions[:8], 3, plans.lengths[:8], durations=times[24:])
    other = replace(test, durations=times[24:] * torch.tensor([1.0] * 3 + [100.0] * 5)[:, None])
    bits, again = (fit_and_score(plans, some, design, job)["gru/bits"] for some in (test, other))
    assert again[:3] == pytest.approx(bits[:3], abs=1e-6)
    assert abs(again[3:] - bits[3:]).max() > 1e-4


@pytest.mark.parametrize("skip", [0, 2])
def test_units_of_folds_are_those_of_the_whole(skip):
    """What is scored fold by fold has the interval of all plans together: a score of bits all 1 has no spread."""
    plans = chain(group=torch.arange(24) % 6)
    mask = counted(plans, skip)
    one = score_bits("it", ACTIONS, mask.double(), plans, mask)
    assert one.bits_per_action()[:3] == (1, 1, 1)
    together = units(plans, mask)
    for fold in range(3):
        index = split(plans, None, Design(3), fold)[1]
        assert set(together[index][mask[index]].tolist()) == set((plans.group[index]).tolist())


@pytest.mark.parametrize("plans", [chain(2, 7), chain(4, 2), chain(5, 2, group=torch.tensor([0, 0, 0, 1, 1]))])
def test_few_plans_have_scores_and_short_lags(plans, tmp_path):
    """Down to a single held-out plan, of which a piece as long as itself would be the only one."""
    plans = replace(plans, lengths=None)
    found = evaluated(plans, tmp_path, ("lags", "gru-lags", "counts"))
    assert len(found.models) == 9
    longest = 0
    if len(found.gains):
        assert found.gains["bits"].map(math.isfinite).all()
        longest = found.gains["lag"].max()
    assert longest == (3 if len(plans) == 2 else 1)  # half of a plan


@pytest.mark.parametrize("skip", [0, 2, 5])
@pytest.mark.parametrize(("kind", "name"), [("lags", "markov"), ("gru-lags", "gru")])
def test_information_by_lag_is_of_the_actions_that_count(kind, name, skip):
    """Of plans of 12 actions: those after the first `skip` that have three before them."""
    plans, design = replace(chain(10, 12), lengths=None), Design(2, skip=skip, reach=3, max_steps=1)
    arrays = fit_and_score(plans, None, design, Job(0, kind, ACTIONS))
    assert arrays[f"{name}/actions"].sum(1).tolist() == [5 * (12 - max(skip, 3))] * 4


def test_empty_and_short_plans_to_choose_on_are_no_obstacle(tmp_path):
    """Of ten plans of one action a tenth is one action, on which nothing can be chosen."""
    assert len(evaluated(Plans(torch.arange(10)[:, None] % 3, 3), tmp_path, folds=5).models) == 9


def test_each_job_takes_one_thread(tmp_path, monkeypatch):
    """The number of threads changes sums in their last digits: results must not depend on who does a job."""
    threads, counts = torch.get_num_threads(), []
    monkeypatch.setattr(fits, "_fit_models", lambda *_: counts.append(torch.get_num_threads()) or ())
    torch.set_num_threads(2)
    try:
        cross_validation(tmp_path, chain(), None, Design(2)).do([Job(0, "counts", ACTIONS)], processes=1)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert counts == [1]


def test_a_job_that_fails_leaves_nothing(tmp_path, monkeypatch):
    plans, design = chain(), Design(3, max_steps=STEPS)
    run, todo, right = (
        cross_validation(tmp_path, plans, None, design),
        jobs(design, ["counts"], [ACTIONS]),
        fits._fit_models,
    )

    def fails_later(kind, learned, scored, design, seed):
        if seed == 1:
            raise ValueError("no such plans")
        return right(kind, learned, scored, design, seed)

    monkeypatch.setattr(fits, "_fit_models", fails_later)
    with refuses("no such plans"):
        run.do(todo, processes=1)
    assert [run.finished(job) for job in todo] == [True, False, False]
    assert sorted(path.name for path in run.folder.iterdir()) == ["asked.json", "fold0-counts.npz"]


def test_finished_folds_are_not_fitted_again(tmp_path):
    plans, design = chain(), Design(3, max_steps=STEPS)
    run, todo = cross_validation(tmp_path, plans, None, design), jobs(design, ["counts", "lags", "gru-lags"], [ACTIONS])
    run.do(todo, processes=1)
    whole = {job: run.path(job).read_bytes() for job in todo}
    times = {job: run.path(job).stat().st_mtime_ns for job in todo}
    gone = todo[2]
    run.path(gone).unlink()
    (run.folder / f".{run.path(todo[1]).name}.partial").write_bytes(b"cut off")  # as after kill -9
    run.do(todo, processes=1)
    assert {job: run.path(job).read_bytes() for job in todo} == whole
    assert [job for job in todo if run.path(job).stat().st_mtime_ns != times[job]] == [gone]


def test_a_damaged_result_is_named(tmp_path):
    plans, design = chain(), Design(3)
    run, job = cross_validation(tmp_path, plans, None, design), Job(0, "counts", ACTIONS)
    run.folder.mkdir(parents=True)
    for content in (b"", b"PK\x03\x04cut off", b"no arrays"):
        run.path(job).write_bytes(content)
        with refuses("fold0-counts.npz", "damaged"):
            run.do([job], processes=1)


def drawn(num: int, length: int, actions: int = 3, seed: int = 0, **more) -> Plans:
    return Plans(torch.randint(actions, (num, length), generator=seeded(seed)), actions, **more)


def test_the_networks_among_experts_are_counted_again_on_all_that_is_learned(monkeypatch):
    """The stacked prior learned its weights beside validation plans; its counts are then those of all plans."""
    made = []

    def experts(learned: Plans, *others: object) -> Experts:
        stacked = StackedPrior(3).fit(learned, max_steps=1, progress=False, generator=seeded(0))
        made.append((stacked, stacked.action_log_probs(test)))
        return Experts([], {"stacked": stacked}, {})

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


def test_a_context_that_tells_the_action_leaves_nothing_to_the_past():
    """Nothing known but the context: hardly a bit; without it all of the bits of three equally frequent actions."""
    context = torch.randint(3, (60, 6), generator=seeded(0))
    plans = Plans(context, 3, context=context)
    for inputs, low, high in ((CONTEXT, 0, 0.1), (ACTIONS, 1.5, 1.7)):
        arrays = fit_and_score(plans, None, Design(2, reach=2), Job(0, "lags", inputs))
        assert low < arrays["markov/bits"][0].sum() / arrays["markov/actions"][0].sum() < high
