"""`python -m eval bench`: peers do the same work, and the program on a small share of it."""

import json

import numpy as np
import pytest
import torch

from eval import bench, bench_packages, bench_peers
from eval.__main__ import main
from eval.bench_jobs import JOBS, chain, chain_plans
from eval.bench_training import TrainingRace
from neuroprior import MarkovPrior, UniformPrior, gridworld
from neuroprior.plans import all_plans
from tests.sources import FALSE_ALARM, p_value, seeded

SMALL = 1e-3


def evaluated() -> tuple:
    world = gridworld(5, 6, "wall", num_worlds=3)
    state = world.reset(20, seeded(0))
    plans = UniformPrior(4).sample(20 * 7, 5, generator=seeded(1)).view(20, 7, 5)
    return world, state, plans


@pytest.mark.parametrize("package", [None, "numba"])
def test_peers_that_evaluate(package):
    world, state, plans = evaluated()
    given = world.next_state, world.reward, state, plans
    if package is None:
        final, rewards = bench_peers.torch_rollout(*given)
    else:
        pytest.importorskip(package)
        final, rewards = map(torch.from_numpy, bench_packages.numba_rollout(*given)())
    want = world.rollout(state, plans)
    assert torch.equal(final, world.cell(want.final_state))
    assert torch.equal(rewards, want.rewards)


def test_peers_that_count():
    plans = chain_plans(50, 9)
    counts = torch.zeros(4, 4, 4, dtype=torch.long)
    for plan in plans.tolist():
        for a, b, c in zip(plan, plan[1:], plan[2:], strict=False):
            counts[a, b, c] += 1
    for count in (bench_peers.numpy_counts, bench_peers.numpy_add_at):
        assert torch.equal(torch.from_numpy(count(plans.numpy(), 4, 2)), counts.view(16, 4))
    pytest.importorskip("pomegranate")
    fitted = bench_packages.pomegranate_fit(plans, 2)().distributions[-1].probs[0]
    seen = counts.sum(-1) > 0
    assert torch.allclose(fitted[seen], (counts / counts.sum(-1, keepdim=True)).float()[seen], atol=1e-6)


def test_peers_that_sample_a_chain():
    """Chi-square against the probabilities of all plans; one false alarm in a million."""
    prior = MarkovPrior(2, 2).fit(torch.tensor([[0, 0, 1, 1], [1, 0, 1, 0], [1, 1, 1, 1]]))
    every = all_plans(2, 4)
    want = prior.log_prob(every).double().exp()
    tables = prior.log_probs.exp().double().numpy(), prior.next_node.numpy(), int(prior.start_node)
    drawn = bench_peers.numpy_sample(*tables, 20_000, 4)
    assert p_value(torch.from_numpy(drawn @ np.array([8, 4, 2, 1])), want) > FALSE_ALARM
    pytest.importorskip("pomegranate")
    plans = bench_packages.pomegranate_sample(torch.from_numpy(drawn), 2, 30, 6)()
    assert plans.shape == (30, 6)


def test_the_numpy_script_finds_what_the_library_finds():
    """Mean rewards of 400 starts each; with standard deviations below .1 they differ by at most .05."""
    run = JOBS["table_1"](0.04)
    theirs = run.peers[0].make()()
    outcome = run.make()()
    for name, scores in zip(outcome.names, outcome.scores, strict=True):
        assert theirs[name] == pytest.approx(float(scores.mean()), abs=0.05)


def test_the_plain_gru():
    torch.manual_seed(0)
    model = bench_peers.PlainGRU(3, 8).eval()
    every = all_plans(3, 3)
    want = model(every).log_softmax(-1).gather(-1, every[..., None].long())[..., 0].sum(1).double().exp()
    drawn = model.sample(20_000, 3).long() @ torch.tensor([9, 3, 1])
    assert p_value(drawn, want.detach()) > FALSE_ALARM


def test_the_race_is_timed_where_it_is_won(monkeypatch):
    race = TrainingRace(chain(), chain_plans(200, 8))
    assert race.excess(race.source) == pytest.approx(1.0, abs=1e-6)
    tried = []

    def train(batch_size, learning_rate, steps):
        tried.append((batch_size, learning_rate, steps))
        return race.source if steps >= 100 and batch_size == 64 else UniformPrior(4)

    chosen = race._quickest(train)
    assert chosen.args in tried
    assert chosen.args[0] == 64
    assert chosen.args[2] >= 100
    with pytest.raises(ValueError, match="no training of 800 steps came within 1%"):
        race._quickest(lambda *how: UniformPrior(4))


@pytest.mark.parametrize(
    ("package", "make"),
    [
        ("transformers", lambda: bench_packages.transformers_generate(4, 5, 6)),
        ("vlmc", lambda: bench_packages.vlmc_fit([0, 1] * 50, 2, 3)),
        ("minigrid", lambda: bench_packages.deep_copies("MiniGrid-FourRooms-v0", torch.zeros(2, 3, dtype=torch.long))),
        ("minigrid", lambda: bench_packages.vector_env("MiniGrid-FourRooms-v0", torch.zeros(2, 3, dtype=torch.long))),
    ],
)
def test_other_packages_run(package, make):
    pytest.importorskip(package)
    found = make()()
    if package == "transformers":
        assert found.shape == (6, 5)
    if package == "minigrid":
        assert list(found) == [0.0, 0.0]


@pytest.mark.parametrize("gumbel", [False, True])
def test_mctx_searches(gumbel):
    pytest.importorskip("mctx")
    world, state, _ = evaluated()
    action = bench_packages.mctx_search(world.next_state, world.reward, state, 16, 4, gumbel)()
    assert action.shape == (20,)
    assert set(np.asarray(action).tolist()) <= set(range(4))


def test_the_program(tmp_path, capsys):
    jobs = ["evaluate", "sample_gru", "sample_markov", "fit_markov"]
    assert main(["bench", "--jobs", *jobs, "--repetitions", "2", "--scale", str(SMALL), "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert {row["job"] for row in results["rows"]} == set(jobs)
    for row in results["rows"]:
        assert 0 < row["low"] <= row["ratio"] <= row["high"]
        assert row["goal"] > 0
    assert (tmp_path / "bench.csv").read_text().count("\n") == len(results["rows"]) + 1
    shown = capsys.readouterr().out
    assert "…" not in shown
    assert "numpy bincount" in shown


def test_what_is_not_installed_is_left_out(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench, "missing", lambda package: package is not None)
    jobs = ["evaluate", "shoot"]
    assert main(["bench", "--jobs", *jobs, "--repetitions", "1", "--scale", str(SMALL), "--out", str(tmp_path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "numba, parallel left out, numba is not installed" in said
    assert "shoot: left out, minigrid is not installed" in said
    assert [row["peer"] for row in json.loads((tmp_path / "results.json").read_text())["rows"]] == [
        "plain torch indexing"
    ]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--scale", "0"], "scale"), (["--jobs", "sing"], "jobs"), (["--repetitions", "0"], "repetitions")],
)
def test_bad_input_is_one_line(arguments, words, capsys):
    assert main(["bench", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error
