"""`python -m eval mice`: the maze as it is drawn, what random candidates reach, and the program end to end."""

import csv
import itertools
import json
from pathlib import Path

import pandas as pd
import pytest
import torch
from scipy import stats

from eval.__main__ import main
from eval.mice import experiment
from eval.mice.experiment import NEURAL, MiceSettings, PriorName, _fit_counts, collected, simulate
from eval.mice.figures import far_from_water, left_turns, passages
from eval.worlds.labyrinth import DATA, reaching_planner, shares_reached
from eval.worlds.labyrinth_drawing import ENTRANCE, coordinates
from neuroprior import MarkovPrior, Plans, SamplingPlanner, UniformPrior, oracle, read_plans
from neuroprior.worlds import labyrinth
from neuroprior.worlds.labyrinth import WATER
from tests.support.chains import markov_plans, markov_probs
from tests.support.sources import FALSE_ALARM, seeded

INNER = range(63)
TINY = MiceSettings(2, 6, (2, 8), (4, 8), 200, 5, 0)
DRY = torch.tensor([node for node in range(127) if node != WATER])


def parent(node: int) -> int:
    return (node - 1) // 2


def heading(place: torch.Tensor, node: int) -> torch.Tensor:
    """The way one walks on entering a node from outside."""
    return place[node] - (place[parent(node)] if node else torch.tensor(ENTRANCE))


def test_left_is_drawn_on_the_left():
    world, place = labyrinth(), coordinates(labyrinth())
    for node in INNER:
        ahead = heading(place, node)
        for move, side in ((0, 1), (1, -1)):
            child = int(world.next_state[node, move])
            way = place[child] - place[node]
            assert child in (2 * node + 1, 2 * node + 2)
            assert float(ahead @ way) == 0
            assert side * float(ahead[0] * way[1] - ahead[1] * way[0]) > 0  # the cross product
            # Out of a branch that is on the left the move back is out_left, and it leads where one came from.
            assert int(world.next_state[child, 2 + move]) == node


def test_ends_fill_a_square_of_eight_by_eight():
    ends = {tuple(end) for end in coordinates(labyrinth())[63:].tolist()}
    assert ends == set(itertools.product(range(-7, 8, 2), repeat=2))


def test_passages_and_turns_of_one_walk():
    """Home and back, left, out again, right, right: counted by hand."""
    actions, world = torch.tensor([2, 0, 2, 1, 1]), labyrinth()
    nodes = [0]
    for action in actions:
        nodes.append(int(world.next_state[nodes[-1], action]))
    walk = Plans(actions[None], 4, context=torch.tensor(nodes[:-1])[None])
    expected = torch.zeros(127)
    expected[[0, nodes[2], nodes[4], nodes[5]]] = torch.tensor([2.0, 2, 1, 1])
    assert torch.equal(passages(walk), expected.to(passages(walk)))
    share, number = left_turns(walk)
    assert number.nonzero()[:, 0].tolist() == sorted({0, nodes[4]})
    assert (float(share[0]), float(share[nodes[4]])) == (0.5, 0.0)


def test_the_far_node_is_as_far_as_can_be():
    start = far_from_water(labyrinth(absorbing=True))
    needed = [float(oracle(labyrinth(), start, moves, objective="return")) for moves in (11, 12)]
    assert needed == [0, 1]


def reaching(length: int) -> torch.Tensor:
    """`[127]`: the probability that so many uniform legal moves pass the water, by dynamic programming."""
    world = labyrinth(absorbing=True)
    legal = world.legal_actions(torch.arange(127)).double()
    reached = (torch.arange(127) == WATER).double()
    for _ in range(length):
        reached = (legal * reached[world.next_state]).sum(1) / legal.sum(1)
    return reached


@pytest.mark.parametrize("node", [57, 115, 13, 0])
def test_uniform_candidates_reach_what_they_must(node):
    """P independent candidates reach it with probability 1 - (1 - q) ** P; as a planner decides, and as is counted."""
    world, times, lengths, numbers = labyrinth(absorbing=True), 500, (6, 10), (1, 5, 16)
    start = torch.full((times,), node)
    shares = shares_reached(reaching_planner(UniformPrior(4), 10, 16), world, start, lengths, numbers, seeded(node))
    for t, length in enumerate(lengths):
        for p, number in enumerate(numbers):
            expected = 1 - (1 - float(reaching(length)[node])) ** number
            trials = times * (16 // number)
            hits = round(float(shares[t, p]) * trials)
            assert stats.binomtest(hits, trials, expected).pvalue > FALSE_ALARM
            planner = SamplingPlanner(UniformPrior(4), length, number, objective="return")
            decided = int((planner.plan(world, start, seeded(node + number)).score > 0).sum())
            assert stats.binomtest(decided, times, expected).pvalue > FALSE_ALARM


def test_what_is_learned_from():
    world, plans = labyrinth(absorbing=True), read_plans(DATA)
    sources = collected(TINY, world, plans, DRY, seeded(0))
    pieces = sources["mice"]
    assert pieces.actions.shape == (190 * 62, 8)
    assert torch.equal(pieces.actions[62:124].flatten(), plans.actions[1, :496])
    assert torch.equal(pieces.group.bincount(), torch.full((190,), 62))
    for name in ("planner", "reached"):
        some = sources[name]
        after, mask = world.next_state[some.context, some.actions.long()], some.mask()
        assert world.legal_actions(some.context[mask]).gather(1, some.actions[mask].long()[:, None]).all()
        assert torch.equal(after[:, :-1][mask[:, 1:]], some.context[:, 1:][mask[:, 1:]])
        arrives = (after == WATER) & mask
        last = torch.arange(some.max_length) == some.lengths[:, None] - 1
        assert (arrives <= last).all()
        assert (name == "planner") == (arrives.any(1) < 1).any()
        assert int(mask.sum()) <= plans.actions.numel()
    assert len(sources["planner"]) == TINY.training_plans
    # The exhaustive planner misses nothing: what it leaves out is further away than six moves.
    far = oracle(world, sources["planner"].context[:, 0], 6, objective="return") == 0
    ends = world.next_state[sources["planner"].context[:, -1], sources["planner"].actions[:, -1].long()]
    assert torch.equal((sources["planner"].lengths == 6) & (ends != WATER), far)


def test_orders_are_chosen_on_some_plans_and_then_all_are_counted():
    actions = markov_plans(markov_probs(4, 2, 0, 3.0), 300, 12, 1).actions
    plans = Plans(actions, 4, context=torch.randint(127, (300, 12), generator=seeded(2)))
    priors, learned = _fit_counts({"mice": plans}, seeded(0))
    training, validation = (Plans(part.actions, 4) for part in plans.split(0.1, seeded(0)))
    costs = [-float(MarkovPrior(4, order).fit(training).log_prob(validation).sum()) for order in range(9)]
    best = costs.index(min(costs))
    assert learned["markov_order_moves"].tolist() == [best]
    moves, chosen = Plans(actions, 4), priors[PriorName("markov", "mice", "moves")]
    assert torch.equal(chosen.log_prob(moves), MarkovPrior(4, best).fit(moves).log_prob(moves))


def test_networks_learn_from_the_source_and_context_that_they_are_called_after(monkeypatch):
    """And the oracle and every planner start where no water is, at most at as many nodes as asked for."""
    fitted = []

    class Recorder(UniformPrior):
        def __init__(self, num_actions, num_contexts=None, seed=0):
            super().__init__(num_actions)
            self.made = (num_contexts, seed)

        def fit(self, plans, *, generator=None, progress=True, max_steps=None):
            fitted.append((type(self).__name__, *self.made, plans, max_steps))
            return self

    class Other(Recorder):
        pass

    monkeypatch.setattr(experiment, "GRUPrior", Recorder)
    monkeypatch.setattr(experiment, "TransformerPrior", Other)
    world, plans = labyrinth(absorbing=True), read_plans(DATA)[:4]
    settings = MiceSettings(2, 6, (2, 8), (4,), 200, 5, 0)
    rows, priors, learned = simulate(settings, world, plans, lambda _: None)
    sources = collected(settings, world, plans, DRY, seeded(0))
    assert learned["source"].tolist() == list(sources)
    assert learned["plans"].tolist() == [len(some) for some in sources.values()]
    assert len({seed for _, _, seed, *_ in fitted}) == len(fitted) == 2 * len(NEURAL)
    for name, (kind, contexts, _, some, steps) in zip(NEURAL * 2, fitted, strict=True):
        assert kind == {"gru": "Recorder", "transformer": "Other"}[name.prior]
        assert contexts == {"moves": None, "node": 127}[name.context]
        assert some.actions.equal(sources[name.learned_from].actions)
        assert steps == 5
    assert set(NEURAL) <= set(priors)
    # By the optimum, no prior reaches the water more often: within 8 moves 6 starts may all reach it.
    best = rows[rows["prior"] == "oracle"].set_index(["seed", "length"])["reached"]
    assert (
        (rows["reached"] - best.reindex(pd.MultiIndex.from_frame(rows[["seed", "length"]])).to_numpy()) < 1e-9
    ).all()


OPTIONS = ["--seeds=2", "--starts=6", "--training-plans=200", "--steps=5"]


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mice")
    arguments = [*OPTIONS, "--num-plans", "2", "8", "--lengths", "4", "8", "--out", str(folder)]
    assert main(["mice", *arguments]) == 0
    return folder


def test_results(tiny_run):
    results = json.loads((tiny_run / "results.json").read_text())
    rows = results["rows"]
    names = {(row["prior"], row["learned_from"], row["context"]) for row in rows}
    contexts = ("moves", "node")
    learned = [(prior, "mice", context) for prior in ("markov", "gru", "transformer") for context in contexts]
    learned += [
        (prior, own, context) for prior in ("markov", "gru") for own in ("planner", "reached") for context in contexts
    ]
    assert names == {*learned, ("uniform", "", ""), ("oracle", "", "")}
    assert len(rows) == 2 * (2 * (len(names) - 1) + 1)
    best = {row["length"]: row["reached"] for row in rows if row["prior"] == "oracle"}
    for row in rows:
        assert 0 <= row["low"] <= row["reached"] <= row["high"] <= 1
        assert row["reached"] <= best[row["length"]] + 1e-9
        if row["num_plans"] is not None:
            assert row["model_steps"] == row["length"] * row["num_plans"]
        assert best[row["length"]] == 0 or row["oracle_share"] == pytest.approx(row["reached"] / best[row["length"]])
    with open(tiny_run / "mice.csv") as file:
        assert [float(row["reached"]) for row in csv.DictReader(file)] == [row["reached"] for row in rows]
    assert {row["source"]: row["plans"] for row in results["learned"]}["planner"] == 200


def test_differences_are_those_of_the_rows(tiny_run):
    results = json.loads((tiny_run / "results.json").read_text())
    columns = ("prior", "learned_from", "context", "length", "num_plans")
    at = {tuple(row[name] for name in columns): row for row in results["rows"]}
    assert len(results["paired"]) == (8 + 8 + 7) * 4
    for row in results["paired"]:
        ends = [[row[name].split(" - ")[end] for name in columns[:3]] for end in (0, -1)]
        first, second = (at[(*end, row["length"], row["num_plans"])]["reached"] for end in ends)
        assert ends[0] != ends[1]
        assert row["difference"] == pytest.approx(first - second, abs=1e-6)
        assert row["low"] <= row["difference"] <= row["high"]


def test_figures_are_written(tiny_run):
    for name in ("mice_planner.png", "maze.png", "maze_plans.png"):
        assert (tiny_run / name).read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tiny_run.glob(".*")] == [".neuroprior.json"]
