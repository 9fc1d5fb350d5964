"""`python -m eval bench`: peers do the same work, and the program on a small share of it."""

import json

import numpy as np
import pandas as pd
import pytest
import torch

from eval.__main__ import main
from eval.bench import limits, peers, sizes
from eval.bench.against import compared
from eval.bench.command import tables
from eval.bench.jobs import (
    JOBS,
    ON_DEVICES,
    against_peers,
    chain_plans,
    excess,
    on_device,
    our_table_1,
    quickest,
    simulations,
    source,
)
from neuroprior import GRUPrior, MarkovPrior, MCTSPlanner, TabularWorld, UniformPrior, gridworld
from neuroprior.control import DoubleIntegrator
from neuroprior.plans import all_plans
from neuroprior.puzzles import AStarPlanner, sliding_tiles
from neuroprior.worlds import maze
from tests.support.sources import FALSE_ALARM, p_value, refuses, seeded

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
        final, rewards = peers.torch_rollout(*given)
    else:
        pytest.importorskip(package)
        final, rewards = map(torch.from_numpy, peers.numba_rollout(*given)())
    want = world.rollout(state, plans)
    assert torch.equal(final, world.cell(want.final_state))
    assert torch.equal(rewards, want.rewards)


@pytest.mark.slow
def test_peers_that_count():
    plans = chain_plans(50, 9)
    counts = torch.zeros(4, 4, 4, dtype=torch.long)
    for plan in plans.tolist():
        for a, b, c in zip(plan, plan[1:], plan[2:], strict=False):
            counts[a, b, c] += 1
    for count in (peers.numpy_counts, peers.numpy_add_at):
        assert torch.equal(torch.from_numpy(count(plans.numpy(), 4, 2)), counts.view(16, 4))
    pytest.importorskip("pomegranate")
    fitted = peers.pomegranate_fit(plans, 2)().distributions[-1].probs[0]
    some = counts.sum(-1) > 0
    assert torch.allclose(fitted[some], (counts / counts.sum(-1, keepdim=True)).float()[some], atol=1e-6)


def test_peers_that_sample_a_chain():
    """Chi-square against the probabilities of all plans; one false alarm in a million."""
    prior = MarkovPrior(2, 2).fit(torch.tensor([[0, 0, 1, 1], [1, 0, 1, 0], [1, 1, 1, 1]]))
    every = all_plans(2, 4)
    want = prior.log_prob(every).double().exp()
    tables = prior.log_probs.exp().double().numpy(), prior.next_node.numpy(), int(prior.start_node)
    drawn = peers.numpy_sample(*tables, 20_000, 4, np.random.default_rng(0))
    assert p_value(torch.from_numpy(drawn @ np.array([8, 4, 2, 1])), want) > FALSE_ALARM
    pytest.importorskip("pomegranate")
    plans = peers.pomegranate_sample(torch.from_numpy(drawn), 2, 30, 6)()
    assert plans.shape == (30, 6)


def test_the_numpy_script_finds_what_the_library_finds():
    """From the same starts: the deterministic planner the same, others in the mean, within six errors of it."""
    world = gridworld(20, 20, "torus", reward_power=8.0)
    start, size = world.reset(600, seeded(0)), (64, 8, 4, (1, 2, 3))
    ours = {name: scores.double().numpy() for name, scores in our_table_1(world, start, *size).items()}
    theirs = peers.numpy_table_1(world.reward[0].numpy(), start.numpy(), *size)
    assert list(theirs) == list(ours)
    assert np.allclose(theirs["deterministic"], ours["deterministic"])
    for name in list(ours)[1:]:
        gap = theirs[name] - ours[name]
        assert abs(gap.mean()) < 6 * gap.std() / 600**0.5
    assert theirs["markov-3"].mean() > theirs["random"].mean() + 0.05


def test_the_plain_gru():
    torch.manual_seed(0)
    model = peers.PlainGRU(3, 8).eval()
    every = all_plans(3, 3)
    want = model(every).log_softmax(-1).gather(-1, every[..., None].long())[..., 0].sum(1).double().exp()
    drawn = model.sample(20_000, 3).long() @ torch.tensor([9, 3, 1])
    assert p_value(drawn, want.detach()) > FALSE_ALARM


def test_the_plain_gru_beside_a_world():
    world = maze(5, 5, egocentric=True, view=1)
    state = world.reset(4, seeded(0))
    plans, final = peers.ObservingGRU(3, 8).eval().sample_in_world(world, state, 3, 6)
    assert final.equal(world.rollout(state, plans.view(4, 3, 6)).final_state.flatten())


def test_the_plain_training_is_one_as_it_is_called():
    """With the batch size, the learning rate and the number of steps in the order in which settings are tried."""
    plans = torch.zeros(50, 4, dtype=torch.uint8)
    model = peers.plain_training(plans, 4, 16, 0.05, 20)
    assert excess(model, source(), plans) < 0.5 * excess(peers.PlainGRU(4), source(), plans)


def test_a_star_in_python_solves_what_ours_does():
    world = sliding_tiles(shape=(3, 3), scramble=12)
    boards = world.reset(5, seeded(0))
    want = AStarPlanner(world.lower_bound, max_nodes=5000).search(world, boards)
    assert [steps for _, steps in peers.python_a_star(boards.flatten(1), 3, 5000)()] == want.lengths.tolist()
    assert [expanded for expanded, _ in peers.python_a_star(boards.flatten(1), 3, 1)()] == (want.lengths > 0).tolist()


def test_a_plain_controller_moves_to_the_goal():
    world = DoubleIntegrator()
    plans = peers.plain_mppi(world, torch.tensor([[0.9, -0.9, 0, 0]]), 10, 500, 0.5)
    assert plans.shape == (1, 10, 2)
    assert float(plans[0, :, 0].mean()) < 0 < float(plans[0, :, 1].mean())


def test_what_is_left_beside_busy_processes_is_a_table():
    own = {"job": "j", "about": "a", "peer": "p", "seconds": 1.0, "low": 1.0, "high": 9.0, "goal": 1.0}
    rows = [own | {"busy": number, "ratio": ratio} for number, ratio in ((0, 8.0), (2, 3.0))]
    first, busy = tables({"peers": rows}, {"threads": 2, "scale": 1.0})
    assert len(first.rows) == len(busy.rows) == 1
    assert busy.rows[0][1:] == ["8", "3", "0.38", "no"]
    assert len(tables({"peers": rows[:1]}, {"threads": 2, "scale": 1.0})) == 1


def test_the_quickest_training_that_is_close_enough_is_timed():
    chain, uniform, clock = source(), UniformPrior(4), [0.0]
    assert excess(chain, chain, chain_plans(200, 8)) == pytest.approx(1.0, abs=1e-6)

    def train(batch_size, learning_rate, steps):
        """Batches of 64 never come close, those of 256 after 200 steps, those of 1024 after 25, which is quickest."""
        clock[0] += steps * batch_size
        return chain if steps >= {64: 900, 256: 200, 1024: 25}[batch_size] else uniform

    found = quickest(train, lambda model: model is chain, clock=lambda: clock[0])
    assert found.args == (1024, 1e-3, 25)
    with pytest.raises(ValueError, match="no training of 800 steps came close enough"):
        quickest(train, lambda model: False)


def test_transformers_draws_plans():
    pytest.importorskip("transformers")
    plans = peers.transformers_generate(3, 5, 200)()
    assert plans.shape == (200, 5)
    assert plans.unique().tolist() == [0, 1, 2]


def test_vlmc_finds_the_tree():
    pytest.importorskip("vlmc")
    found = peers.vlmc_fit([0, 1] * 50, 2, 3)()
    assert sorted(map(list, found.get_contexts())) == [[0], [1]]


@pytest.mark.parametrize("make", [peers.deep_copies, peers.vector_env])
def test_gymnasium_takes_the_plans(make):
    """To the goal of an empty room of three by three squares, and nowhere."""
    pytest.importorskip("minigrid")
    plans = torch.tensor([[2, 2, 1, 2, 2], [0, 0, 0, 0, 0]])
    run = make("MiniGrid-Empty-5x5-v0", plans)
    for _ in range(2):
        found = list(run())
        assert found[0] > 0.9
        assert found[1] == 0


@pytest.mark.parametrize("prior", [UniformPrior(4), source(), GRUPrior(4, 8, lags=1)], ids=lambda p: type(p).__name__)
def test_mctx_is_given_the_same_policy(prior):
    jax = pytest.importorskip("jax")
    start, follow = peers.jax_policy(prior)
    plans = UniformPrior(4).sample(7, 5, generator=seeded(0)).long()
    with jax.default_matmul_precision("highest"):  # a GPU rounds the factors to ten bits otherwise
        logits, memory = start(7)
        found = [logits]
        for t in range(4):
            logits, memory = follow(plans[:, t].numpy(), memory)
            found.append(logits)
    want = prior(plans).detach()
    assert np.allclose(np.stack([np.asarray(x) for x in found], 1), want, atol=1e-5)


def test_a_simulation_adds_a_node_and_follows_the_plan_to_its_end():
    """A single action: 3 + 2 + 1 steps, and then all has been tried."""
    world = TabularWorld(torch.tensor([[1], [0]]), torch.tensor([0.0, 1.0]))
    assert simulations(MCTSPlanner(UniformPrior(1), 3, 9), world, torch.zeros(2, dtype=torch.long)) == 3


def results(ours: float, peer: float, spread: float = 0.01, **settings) -> dict:
    """Of a run in which a job takes us so many seconds, and the peer so many."""
    ratio = peer / ours
    row = {"job": "sample", "peer": "numpy", "seconds": ours, "ratio": ratio}
    rows = [row | {"low": ratio * (1 - spread), "high": ratio * (1 + spread)}]
    work = {"work": "copy", "seconds": ours}
    imports = [{"seconds": ours, "ratio": ours / peer, "low": 0.99 * ours / peer, "high": 1.01 * ours / peer}]
    return {"settings": {"scale": 1.0, "threads": 2} | settings, "rows": rows, "limits": [work], "imports": imports}


def test_regressions_are_relative_to_the_peer():
    """A machine half as fast makes no difference where a peer was timed."""
    rows = compared(results(1, 10), results(2, 20)).set_index("name")
    assert rows.factor.to_dict() == {"sample: numpy": 1, "copy": 2, "from neuroprior import *": 1}
    assert rows.verdict.to_dict() == {
        "sample: numpy": "no difference",
        "copy": "",
        "from neuroprior import *": "no difference",
    }
    rows = compared(results(1, 10), results(2, 10)).set_index("name")
    assert rows.factor.to_dict() == pytest.approx({"sample: numpy": 2, "copy": 2, "from neuroprior import *": 2})
    assert list(rows.verdict) == ["slower", "slower", ""]
    assert list(compared(results(2, 10), results(1, 10)).verdict) == ["faster", "faster", ""]
    assert compared(results(1, 10, 0.5), results(1.3, 10)).verdict[0] == "no difference"
    assert compared(results(1, 10), results(1.05, 10)).verdict[0] == "no difference"


def test_what_cannot_be_compared():
    with refuses("scale", "0.5"):
        compared(results(1, 10), results(1, 10, scale=0.5))
    with refuses("in common"):
        compared(results(1, 10), {"settings": {"scale": 1.0, "threads": 2}, "sizes": []})


def test_two_results_are_compared(tmp_path, capsys):
    for name, seconds in (("old", 1), ("new", 2)):
        (tmp_path / f"{name}.json").write_text(json.dumps(results(seconds, 10)))
    files = ["--against", str(tmp_path / "old.json"), "--measured", str(tmp_path / "new.json")]
    assert main(["bench", *files]) == 0
    assert "slower" in capsys.readouterr().out
    assert main(["bench", "--measured", "x"]) == 2
    (tmp_path / "old.json").write_text("{}")
    assert main(["bench", *files]) == 2
    assert "results.json is expected" in capsys.readouterr().err


@pytest.mark.slow
def test_the_program(tmp_path, capsys):
    jobs = ["evaluate", "sample_gru", "sample_markov", "fit_markov"]
    assert main(["bench", "--jobs", *jobs, "--repetitions", "1", "--scale", str(SMALL), "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert {row["job"] for row in results["rows"]} == set(jobs)
    for row in [*results["rows"], *results["imports"]]:
        assert 0 < row["low"] <= row["ratio"] <= row["high"]
        assert row["goal"] > 0
    assert {row["growing"] for row in results["sizes"]} == set(sizes.SWEEPS) - {"length sampled"}
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
    assert "from neuroprior import *:" in shown


@pytest.mark.slow
def test_jobs_of_an_accelerator(tmp_path, capsys):
    """On a CPU in place of one."""
    rows = [row for name in ON_DEVICES for row in on_device(name, torch.device("cpu"), SMALL, 1)]
    assert [(row["job"], row["about"]) for row in rows] == [(name, JOBS[name](SMALL).about) for name in ON_DEVICES]
    assert all(row["seconds"] > 0 for row in rows)
    (shown,) = tables({"gpu": rows}, {})
    assert [row[0] for row in shown.rows] == [row["about"] for row in rows]
    options = ["--parts", "gpu", "--scale", str(SMALL), "--repetitions", "1", "--out", str(tmp_path)]
    assert main(["bench", *options]) == 0
    if torch.cuda.is_available():
        results = json.loads((tmp_path / "results.json").read_text())
        assert len(results["gpu"]) == len(rows)
        assert "rows" not in results
    else:
        assert "there is no CUDA device" in capsys.readouterr().out


def test_sizes_increase_and_memory_is_measured():
    """A sweep whose result takes eight bytes for each of its size, and four times as many on the way."""

    def make(size):
        return lambda: torch.ones(4 * size, dtype=torch.float64)[:size].clone()

    rows = list(sizes.measured("x", sizes.Sweep("", (10**3, 10**7, 10**8), make), 10**7))
    assert [(row["size"], row["result_bytes"]) for row in rows] == [(10**3, 8 * 10**3), (10**7, 8 * 10**7)]
    if rows[-1]["peak_bytes"] is not None:
        assert 4.5 * 8 * 10**7 < rows[-1]["peak_bytes"] < 6 * 8 * 10**7


def test_the_slope_is_that_of_the_last_decades():
    rows = [{"size": 10**k, "seconds": 1.0 if k < 3 else 10.0 ** (1.5 * (k - 3))} for k in range(6)]
    assert sizes.slope(pd.DataFrame(rows)) == pytest.approx(1.5)
    assert sizes.slope(pd.DataFrame(rows[:1])) is None


@pytest.mark.parametrize(
    ("seconds", "operations", "bound", "share"),
    [((1.0, 2.0, 4.0), limits.SIDE**3, "arithmetic", 0.25), ((1.0, 1e-9, 2.0), limits.SIDE**3, "memory", 0.25)],
)
def test_the_share_of_the_limit(seconds, operations, bound, share):
    """Work of half the bytes of a copy, and half the operations of a product."""
    work = limits.Work("half", lambda: None, limits.COPIED, operations)
    taken = iter(seconds)
    *_, row = limits.measured([work], 1, timed=lambda run, repetitions: next(taken))
    assert row["bound"] == bound
    assert row["share"] == pytest.approx(share)


def test_what_is_not_installed_is_left_out():
    said = []
    assert not list(against_peers("fit_tree", SMALL, 1, said.append, missing=lambda package: package is not None))
    assert not list(against_peers("shoot", SMALL, 1, said.append, missing=lambda package: package is not None))
    assert "fit_tree: vlmc (Rust) left out, vlmc is not installed" in said
    assert "shoot: left out, minigrid is not installed" in said
