"""Cross-validation of models: scores against fits made by hand, runs that were interrupted."""

import math
import multiprocessing
import os
import signal
from dataclasses import replace

import pytest
import torch

from neuroprior import ContextTreePrior, GRUPrior, MarkovPrior, Plans
from neuroprior.analysis.comparison import BACKOFFS_TRIED, DEPTH, score_bits, units
from neuroprior.plans.folds import folds
from neuroprior.report import crossval, fits
from neuroprior.report import scores as held_out
from neuroprior.report.crossval import ACTIONS, CONTEXT, Design, Job, Study
from tests.support.chains import markov_plans, markov_probs
from tests.support.sources import refuses, seeded

STEPS = 3  # of neural priors, where they do not matter


def chain(num: int = 24, length: int = 7, seed: int = 0, **more) -> Plans:
    plans = markov_plans(markov_probs(3, 1, 0, 1.5), num, length, seed)
    lengths = torch.randint(2, length + 1, (num,), generator=seeded(seed + 1))
    return replace(plans, lengths=lengths, **more)


def seen(kind: str, num: int = 24, length: int = 7) -> torch.Tensor | None:
    if kind == "nothing":
        return None
    shape = (num, length) if "step" in kind else (num,)
    if "features" in kind:
        return torch.randn(*shape, 2, generator=seeded(5))
    return torch.randint(3, shape, generator=seeded(5))


def study_of(plans: Plans, folder, test: Plans | None = None, **design) -> Study:
    number = 1 if test is not None else design.pop("folds", 3)
    return Study.prepare(folder, plans, test, Design(number, max_steps=STEPS, **design))


def finish(study: Study, kinds=("counts",), sees=(ACTIONS,), processes: int = 1) -> list[Job]:
    todo = crossval.jobs(study.design, kinds, sees)
    crossval.run(study, todo, processes, lambda job: None)
    return todo


def test_a_study_gives_its_plans_back(tmp_path):
    group = torch.arange(24) % 4
    names = {"action_names": ("<b>", "ü", "[x]"), "group_names": tuple("wxyz"), "context_names": tuple("abc")}
    plans = chain(group=group, context=seen("index a step"), **names)
    study = study_of(plans, tmp_path, skip=2)
    for read in (study.plans, study.scored):
        assert read.actions.equal(plans.actions)
        assert read.lengths.equal(plans.lengths)
        assert read.context.equal(plans.context)
        assert read.group.equal(group)
        assert {key: getattr(read, key) for key in names} == names
    mask = plans.mask()
    mask[:, :2] = False
    assert study.mask().equal(mask)
    for fold, (learned, held) in enumerate(folds(plans, 3, 0)):
        own, index = study.split(fold)
        assert own.actions.equal(plans[learned].actions)
        assert index.equal(held)
    test = chain(10, 5, seed=8)
    study = study_of(replace(plans, context=None, context_names=None), tmp_path, test)
    own, index = study.split(0)
    assert len(own) == 24
    assert index.tolist() == list(range(10))
    assert study.scored.actions.equal(test.actions)


def test_whatever_changes_results_makes_another_study(tmp_path):
    plans = chain()
    base = study_of(plans, tmp_path)
    assert study_of(plans, tmp_path) == base
    other = replace(plans, actions=(plans.actions + 1) % 3)
    named = replace(plans, action_names=("a", "b", "c"))
    made = [base.folder]
    made += [study_of(plans, tmp_path, **design).folder for design in ({"skip": 1}, {"folds": 4}, {"seed": 1})]
    made += [Study.prepare(tmp_path, plans, None, Design(3, max_steps=4)).folder]
    made += [Study.prepare(tmp_path, plans, None, Design(3, max_steps=STEPS, version="0")).folder]
    made += [study_of(some, tmp_path).folder for some in (other, named, plans[:23])]
    made += [study_of(plans, tmp_path, test).folder for test in (plans, other)]
    made += [study_of(other, tmp_path, plans).folder]
    assert len(set(made)) == len(made)
    assert base.plans.actions.equal(plans.actions)


def test_jobs():
    made = crossval.jobs(Design(3), ["counts", "lags", "gru"], [ACTIONS, CONTEXT])
    assert len(made) == len(set(made)) == 3 * 2 * 2 + 2
    assert len({job.name for job in made}) == len(made)
    kinds = [job.kind for job in made]
    assert kinds == sorted(kinds, key=fits.KINDS.index)  # the slowest first
    assert {job.fold for job in made if job.kind == "lags"} == {0}
    assert all({j.fold for j in made if (j.kind, j.sees) == ("gru", sees)} == {0, 1, 2} for sees in (ACTIONS, CONTEXT))


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
        ("nothing", True, 2),
        ("index a plan", False, 2),
        ("index a plan", True, 0),
        ("index a step", False, 0),
        ("index a step", True, 2),
    ],
)
def test_scores_are_those_of_fits_by_hand(kind, grouped, skip, tmp_path):
    group = torch.arange(24) % 5 * 10 - 10 if grouped else None
    plans = chain(context=seen(kind), group=group)
    study = study_of(plans, tmp_path, skip=skip)
    sees = [ACTIONS] + [CONTEXT] * (kind != "nothing")
    models = held_out.models_of(study, finish(study, sees=sees))
    scores = held_out.scores_of(models, study.scored, study.mask())
    assert len(models) == 9 + 8 * (kind != "nothing")  # the uniform prior sees nothing
    mask = plans.mask()
    mask[:, :skip] = False
    compared = 0
    for model, score in zip(models, scores, strict=True):
        assert (model.name, model.sees) == (score.model, score.sees)
        if model.name not in ("markov-0", "markov-1", "markov-3", "context tree"):
            continue
        blind = model.sees == ACTIONS
        own = replace(plans, context=None) if blind else plans
        want = torch.zeros(plans.actions.shape, dtype=torch.double)
        for fold, (learned, held) in enumerate(folds(plans, 3, 0)):
            want[held] = by_hand(model.name, own[learned], own[held], fold, None if blind else 3)
        torch.testing.assert_close(model.bits().double(), want, rtol=1e-5, atol=1e-5)
        total = want[mask].sum() / mask.sum()
        assert score.bits_per_action().mean == pytest.approx(float(total), abs=1e-5)
        assert float(score.actions.sum()) == int(mask.sum())
        assert len(score.bits) == (5 if grouped else int(mask.any(1).sum()))
        compared += 1
    assert compared == 4 * len(sees)


@pytest.mark.parametrize("kind", ["features a plan", "features a step"])
def test_features_are_for_neural_models_alone(kind, tmp_path):
    plans = chain(context=seen(kind))
    study = study_of(plans, tmp_path, folds=2, seed=3)
    models = held_out.models_of(study, finish(study, ("counts", "gru"), (ACTIONS, CONTEXT)))
    assert [model.name for model in models if model.sees == CONTEXT] == ["gru"]
    gru = models[-1]
    want = torch.zeros(plans.actions.shape)
    for fold, (learned, held) in enumerate(folds(plans, 2, 3)):
        seed = 3000 + fold
        prior = GRUPrior(3, context_size=2, seed=seed).fit(
            plans[learned], generator=seeded(seed), max_steps=STEPS, progress=False
        )
        with torch.no_grad():
            want[held] = -prior.action_log_probs(plans[held]) / math.log(2)
    torch.testing.assert_close(gru.bits(), want)


def test_calibration_and_samples_are_of_the_held_out_plans(tmp_path):
    """The forecasts of all folds are counted once, and samples stand in the place of the first fold's plans."""
    plans = chain()
    study = study_of(plans, tmp_path, skip=1)
    for model in held_out.models_of(study, finish(study)):
        sums = model.calibration().sums.sum((0, 1))
        counted = int(study.mask().sum())
        assert sums.tolist() == pytest.approx([counted, counted, 3 * counted], rel=1e-5)
        first = study.split(0)[1]
        assert model.load("generated").shape == (len(first), 7)
        assert model.load("generated").max() < 3
    uniform = held_out.models_of(study, crossval.jobs(study.design, ["counts"], [ACTIONS]))[0]
    (one,) = uniform.calibration().bins
    assert one.forecast == pytest.approx(1 / 3, abs=1e-6)
    assert one.taken.mean == pytest.approx(1 / 3)


@pytest.mark.parametrize("skip", [0, 2])
def test_units_of_folds_are_those_of_the_whole(skip, tmp_path):
    """What is scored fold by fold has the interval of all plans together: a score of bits all 1 has no spread."""
    plans = chain(group=torch.arange(24) % 6)
    study = study_of(plans, tmp_path, skip=skip)
    mask = study.mask()
    one = score_bits("it", ACTIONS, mask.double(), plans, mask)
    assert one.bits_per_action()[:3] == (1, 1, 1)
    together = units(plans, mask)
    for fold in range(3):
        index = study.split(fold)[1]
        assert set(together[index][mask[index]].tolist()) == set((plans.group[index]).tolist())


@pytest.mark.parametrize("plans", [chain(2, 7), chain(4, 2), chain(5, 2, group=torch.tensor([0, 0, 0, 1, 1]))])
def test_few_plans_have_scores_and_short_lags(plans, tmp_path):
    """Down to a single held-out plan, of which a piece as long as itself would be the only one."""
    plans = replace(plans, lengths=None)
    study = study_of(plans, tmp_path, folds=2)
    todo = finish(study, ("lags", "counts"))
    assert len(held_out.models_of(study, todo)) == 9
    rows = held_out.step_rows(study, todo)
    assert all(math.isfinite(row["bits"]) for row in rows)
    longest = max((row["lag"] for row in rows), default=0)
    assert longest == (3 if len(plans) == 2 else 1)  # half of a plan


def test_empty_and_short_plans_to_choose_on_are_no_obstacle(tmp_path):
    """Of ten plans of one action a tenth is one action, on which nothing can be chosen."""
    plans = Plans(torch.arange(10)[:, None] % 3, 3)
    study = study_of(plans, tmp_path, folds=5)
    assert len(held_out.models_of(study, finish(study))) == 9


def test_each_job_takes_one_thread(tmp_path, monkeypatch):
    """The number of threads changes sums in their last digits: results must not depend on who does a job."""
    threads = torch.get_num_threads()
    counted = []
    monkeypatch.setattr(fits, "outcomes", lambda *_: counted.append(torch.get_num_threads()) or {})
    study = study_of(chain(), tmp_path)
    torch.set_num_threads(2)
    try:
        crossval.do(study, Job(0, "counts", ACTIONS))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert counted == [1]


def test_a_job_that_fails_leaves_nothing(tmp_path, monkeypatch):
    study = study_of(chain(), tmp_path)
    todo = crossval.jobs(study.design, ["counts"], [ACTIONS])
    done: list[Job] = []
    right = fits.outcomes

    def fails_later(kind, learned, scored, mask, unit, design, fold):
        if fold == 1:
            raise ValueError("no such plans")
        return right(kind, learned, scored, mask, unit, design, fold)

    monkeypatch.setattr(fits, "outcomes", fails_later)
    with refuses("no such plans"):
        crossval.run(study, todo, 1, done.append)
    assert done == todo[:1]
    assert [study.finished(job) for job in todo] == [True, False, False]
    assert sorted(path.name for path in study.folder.iterdir()) == ["design.json", "fold0-counts.npz", "plans.npz"]


def test_finished_folds_are_not_fitted_again(tmp_path):
    study = study_of(chain(), tmp_path)
    todo = finish(study, ("counts", "lags"))
    whole = {job: (study.folder / job.name).read_bytes() for job in todo}
    times = {job: (study.folder / job.name).stat().st_mtime_ns for job in todo}
    gone = todo[2]
    (study.folder / gone.name).unlink()
    (study.folder / f".{todo[1].name}.partial").write_bytes(b"cut off")  # as after kill -9
    done: list[Job] = []
    crossval.run(study, todo, 1, done.append)
    assert sorted(done, key=todo.index) == todo
    assert {job: (study.folder / job.name).read_bytes() for job in todo} == whole
    changed = [job for job in todo if (study.folder / job.name).stat().st_mtime_ns != times[job]]
    assert changed == [gone]


def test_a_killed_process_is_told_and_what_is_finished_is_kept(tmp_path):
    """As where memory runs out."""
    study = study_of(chain(), tmp_path, folds=12)
    todo = crossval.jobs(study.design, ["counts"], [ACTIONS])

    def kill(job: Job) -> None:
        for process in multiprocessing.active_children():
            os.kill(process.pid, signal.SIGKILL)

    with refuses("killed", "--processes 1", error=MemoryError):
        crossval.run(study, todo, 2, kill)
    finished = [job for job in todo if study.finished(job)]
    assert 0 < len(finished) < len(todo)
    assert not multiprocessing.active_children()
    crossval.run(study, todo, 1, lambda job: None)
    assert all(study.finished(job) for job in todo)
