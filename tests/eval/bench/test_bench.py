"""`python -m eval bench`: peers do the same work, and the program on a small share of it."""

import json

import numpy as np
import pytest
import torch

from eval.__main__ import main
from eval.bench import command as bench
from eval.bench import gpu as bench_gpu
from eval.bench import limits as bench_limits
from eval.bench import packages as bench_packages
from eval.bench import peers as bench_peers
from eval.bench import sizes as bench_sizes
from eval.bench import training as bench_training
from eval.bench.jobs import JOBS, ON_DEVICES, chain_plans, source
from eval.bench.training import TrainingRace
from eval.paper.first_simulation import Protocol, Size, simulate
from neuroprior import MarkovPrior, UniformPrior, gridworld
from neuroprior.plans import all_plans
from tests.support.sources import FALSE_ALARM, p_value, seeded

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
    """From the same starts: the deterministic planner the same, others in the mean, within six errors of it."""
    size = Size(1, 600, 600, 20, 8.0, 4, 8, 64, 0)
    ours = simulate(Protocol("torus", "uniform", "all"), size, False, lambda what: None)
    reward, start = ours.world.reward[0].numpy(), ours.states[0].numpy()
    theirs = bench_peers.numpy_table_1(reward, start, 64, 8, 4, (1, 2, 3))
    scores = dict(zip(ours.names, ours.scores[:, 0].double().numpy(), strict=True))
    assert list(theirs) == list(scores)
    assert np.allclose(theirs["deterministic"], scores["deterministic"])
    for name in list(scores)[1:]:
        gap = theirs[name] - scores[name]
        assert abs(gap.mean()) < 6 * gap.std() / 600**0.5
    assert theirs["markov-3"].mean() > theirs["random"].mean() + 0.05


def test_the_plain_gru():
    torch.manual_seed(0)
    model = bench_peers.PlainGRU(3, 8).eval()
    every = all_plans(3, 3)
    want = model(every).log_softmax(-1).gather(-1, every[..., None].long())[..., 0].sum(1).double().exp()
    drawn = model.sample(20_000, 3).long() @ torch.tensor([9, 3, 1])
    assert p_value(drawn, want.detach()) > FALSE_ALARM


def test_the_quickest_training_that_is_close_enough_is_timed(monkeypatch):
    race = TrainingRace(source(), chain_plans(200, 8))
    assert race.excess(race.source) == pytest.approx(1.0, abs=1e-6)
    clock = [0.0]
    monkeypatch.setattr(bench_training, "perf_counter", lambda: clock[0])

    def train(batch_size, learning_rate, steps):
        """Batches of 64 never come close, those of 256 after 200 steps, those of 1024 after 25, which is quickest."""
        clock[0] += steps * batch_size
        return race.source if steps >= {64: 900, 256: 200, 1024: 25}[batch_size] else UniformPrior(4)

    assert race._quickest(train).args == (1024, 1e-3, 25)
    with pytest.raises(ValueError, match="no training of 800 steps came within 1%"):
        race._quickest(lambda *how: UniformPrior(4))


def test_transformers_draws_plans():
    pytest.importorskip("transformers")
    plans = bench_packages.transformers_generate(3, 5, 200)()
    assert plans.shape == (200, 5)
    assert plans.unique().tolist() == [0, 1, 2]


def test_vlmc_finds_the_tree():
    pytest.importorskip("vlmc")
    found = bench_packages.vlmc_fit([0, 1] * 50, 2, 3)()
    assert sorted(map(list, found.get_contexts())) == [[0], [1]]


@pytest.mark.parametrize("make", [bench_packages.deep_copies, bench_packages.vector_env])
def test_gymnasium_takes_the_plans(make):
    """To the goal of an empty room of three by three squares, and nowhere."""
    pytest.importorskip("minigrid")
    plans = torch.tensor([[2, 2, 1, 2, 2], [0, 0, 0, 0, 0]])
    run = make("MiniGrid-Empty-5x5-v0", plans)
    for _ in range(2):
        found = list(run())
        assert found[0] > 0.9
        assert found[1] == 0


@pytest.mark.parametrize("gumbel", [False, True])
def test_mctx_finds_the_action_that_pays(gumbel):
    pytest.importorskip("mctx")
    next_state, reward = torch.tensor([[0, 0, 1, 0], [1, 1, 1, 1]]), torch.tensor([[0.0, 1.0]])
    state = torch.zeros(20, dtype=torch.long)
    action = bench_packages.mctx_search(next_state, reward, state, 64, 4, gumbel)()
    assert np.asarray(action).tolist().count(2) >= 15


def test_the_program(tmp_path, capsys):
    jobs = ["evaluate", "sample_gru", "sample_markov", "fit_markov"]
    assert main(["bench", "--jobs", *jobs, "--repetitions", "1", "--scale", str(SMALL), "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert {row["job"] for row in results["rows"]} == set(jobs)
    for row in [*results["rows"], *results["imports"]]:
        assert 0 < row["low"] <= row["ratio"] <= row["high"]
        assert row["goal"] > 0
    assert {row["growing"] for row in results["sizes"]} == set(bench_sizes.SWEEPS) - {"length sampled"}
    assert [row["work"] for row in results["limits"]][:2] == ["copy", "product"]
    assert len(results["limits"]) == 6
    for part in ("peers", "sizes", "limits", "imports"):
        rows = results["rows" if part == "peers" else part]
        assert (tmp_path / f"{part}.csv").read_text().count("\n") == len(rows) + 1
    for name in ("peers", "sizes"):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    shown = capsys.readouterr().out
    assert "…" not in shown
    assert "numpy bincount" in shown
    assert "import neuroprior:" in shown


def test_jobs_of_an_accelerator(tmp_path, capsys, monkeypatch):
    """On a CPU in place of one."""
    rows = list(bench_gpu.measured(torch.device("cpu"), SMALL, 1))
    assert [(row["job"], row["about"]) for row in rows] == [(name, JOBS[name](SMALL).about) for name in ON_DEVICES]
    assert all(row["seconds"] > 0 for row in rows)
    options = ["--parts", "gpu", "--scale", str(SMALL), "--repetitions", "1", "--out", str(tmp_path)]
    if not torch.cuda.is_available():
        assert main(["bench", *options]) == 0
        assert "there is no CUDA device" in capsys.readouterr().out
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        monkeypatch.setattr(bench_gpu, "measured", lambda *how: iter(rows))
    assert main(["bench", *options]) == 0
    assert rows[0]["about"] in " ".join(capsys.readouterr().out.split())
    results = json.loads((tmp_path / "results.json").read_text())
    assert len(results["gpu"]) == len(rows)
    assert "rows" not in results


def test_sizes_grow_and_memory_is_seen():
    """A sweep whose result takes eight bytes for each of its size, and four times as many on the way."""

    def make(size):
        return lambda: torch.ones(4 * size, dtype=torch.float64)[:size].clone()

    rows = list(bench_sizes.measured("x", bench_sizes.Sweep("", (10**3, 10**7, 10**8), make), 10**7))
    assert [(row["size"], row["result_bytes"]) for row in rows] == [(10**3, 8 * 10**3), (10**7, 8 * 10**7)]
    if rows[-1]["peak_bytes"] is not None:
        assert 4.5 * 8 * 10**7 < rows[-1]["peak_bytes"] < 6 * 8 * 10**7


def test_the_slope_is_that_of_the_last_decades():
    rows = [{"size": 10**k, "seconds": 1.0 if k < 3 else 10.0 ** (1.5 * (k - 3))} for k in range(6)]
    assert bench_sizes.slope(rows) == pytest.approx(1.5)
    assert bench_sizes.slope(rows[:1]) is None


def test_the_share_of_the_limit(monkeypatch):
    """On a machine that copies in a second, and multiplies in two, work of half the bytes in four seconds."""
    work = bench_limits.Work("half", lambda: None, bench_limits.COPIED, bench_limits.SIDE**3)
    seconds = iter([1.0, 2.0, 4.0])
    monkeypatch.setattr(bench_limits, "works", lambda scale: [work])
    monkeypatch.setattr(bench_limits, "seconds_again", lambda run, repetitions: next(seconds))
    *_, row = bench_limits.measured(1.0, 1)
    assert row["bound"] == "arithmetic"
    assert row["share"] == pytest.approx(0.25)
    rates = {"memory": 1.0, "arithmetic": 1e30}
    assert bench_limits._row(work, 2.0 * bench_limits.COPIED, rates)["share"] == pytest.approx(0.5)


def test_what_is_not_installed_is_left_out(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench, "missing", lambda package: package is not None)
    options = ["--jobs", "evaluate", "shoot", "--parts", "peers", "--repetitions", "1", "--scale", str(SMALL)]
    assert main(["bench", *options, "--out", str(tmp_path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "numba, parallel left out, numba is not installed" in said
    assert "shoot: left out, minigrid is not installed" in said
    assert [row["peer"] for row in json.loads((tmp_path / "results.json").read_text())["rows"]] == [
        "plain torch indexing"
    ]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--scale", "0"], "scale"), (["--jobs", "sing"], "jobs")],
)
def test_bad_input_is_one_line(arguments, words, capsys):
    assert main(["bench", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error
