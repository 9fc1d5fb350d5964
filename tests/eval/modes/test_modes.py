"""`python -m eval modes`: what happens at moves by hand, which modes are described, and small runs."""

import json
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
import torch

from eval.__main__ import main
from eval.modes.experiment import (
    FOLDS,
    WITHIN,
    Job,
    ModeSettings,
    described,
    events,
    fitted,
    likelihoods,
    node_shares,
    since_water,
)
from eval.worlds.labyrinth import DATA
from neuroprior import Plans, read_plans
from neuroprior.behaviour import mode_plans
from neuroprior.plans import folds
from neuroprior.priors import SwitchingPrior
from neuroprior.worlds import labyrinth
from neuroprior.worlds.labyrinth import WATER
from tests.support.sources import seeded

pytestmark = pytest.mark.usefixtures("undrawn")


def walked(nodes: list[int]) -> Plans:
    """The moves along nodes; a node twice is home and back."""
    table = labyrinth().next_state
    moves = [int((table[a] == b).nonzero()[-1]) for a, b in pairwise(nodes)]
    return Plans(torch.tensor([moves]), 4, context=torch.tensor([nodes[:-1]]))


def test_events_of_a_walk_to_the_water_and_home():
    parent = (WATER - 1) // 2
    inward = [parent]
    while inward[0]:
        inward.insert(0, (inward[0] - 1) // 2)
    nodes = [*inward, WATER, *reversed(inward), *inward, WATER, parent]
    found = events(walked(nodes))
    arrivals = [t for t in range(len(nodes) - 1) if nodes[t + 1] == WATER]
    homes = [t for t in range(len(nodes) - 1) if nodes[t] == nodes[t + 1]]
    times = range(len(nodes) - 1)
    assert found.water[0].tolist() == [any(t <= a < t + WITHIN for a in arrivals) for t in times]
    assert found.home[0].tolist() == [any(t <= a < t + WITHIN for a in homes) for t in times]
    # Out after in at the water, in after out at home, and out again after the second arrival.
    assert found.turns[0].nonzero()[:, 0].tolist() == [arrivals[0] + 1, homes[0] + 1, arrivals[1] + 1]
    assert found.complete[0].tolist() == [t <= len(nodes) - 1 - WITHIN for t in times]


@pytest.fixture(scope="module")
def plans() -> Plans:
    return read_plans(DATA)[:12]


@pytest.fixture(scope="module")
def prior(plans: Plans) -> SwitchingPrior:
    prior = SwitchingPrior(4, 2, 0, 127, restarts=1, max_iterations=5)
    return prior.fit(plans, generator=seeded(0))


def test_shares_of_nodes_are_those_of_the_most_probable_path(plans, prior):
    path, found, shares = mode_plans(prior, plans).actions, events(plans), node_shares(prior, plans)
    for node in (0, 5, 57, 116):
        here = plans.context == node
        assert float(shares["moves"][:, node].sum()) == pytest.approx(1)
        for k in range(2):
            own = here & (path == k)
            assert float(shares["moves"][k, node]) == pytest.approx(int(own.sum()) / int(here.sum()))
            assert float(shares["turns"][k, node]) == pytest.approx(
                float(found.turns[own].double().mean()), nan_ok=True
            )
            own &= found.complete
            assert float(shares["water"][k, node]) == pytest.approx(
                float(found.water[own].double().mean()), nan_ok=True
            )


def test_moves_since_the_water_are_counted_from_it(plans, prior):
    frame = since_water(prior, plans)
    assert frame.groupby("from")["share"].sum().tolist() == pytest.approx([1.0] * frame["from"].nunique())
    path = mode_plans(prior, plans).actions
    at = frame[(frame["mode"] == 1) & (frame["from"] == 0)]["share"].item()
    assert at == pytest.approx(float((path[plans.context == WATER] == 0).double().mean()))
    after = torch.zeros_like(path, dtype=torch.bool)
    after[:, 1:] = (plans.context == WATER)[:, :-1]
    at = frame[(frame["mode"] == 2) & (frame["from"] == 1)]["share"].item()
    assert at == pytest.approx(float((path[after] == 1).double().mean()))


def test_nats_are_those_of_the_fold_in_which_sequences_are_held_out(plans):
    """Priors whose nats are their folds' numbers; one mode agrees with that of all plans, the other does not."""
    modes = torch.rand(12, 500, 3, generator=seeded(0), dtype=torch.double).numpy()
    results = {}
    for fold in range(FOLDS + 1):
        own = modes.copy()
        if fold == 2:
            own[..., 1] = np.random.default_rng(0).random((12, 500))
        results[Job(3, 1, fold)] = {"nats": np.full((12, 500), fold, dtype=np.float32), "modes": own}
    row = likelihoods(results, plans, seed=0).iloc[0]
    sizes = [len(held_out) for _, held_out in folds(plans, FOLDS, 0)]
    assert row["nats"] == pytest.approx(sum(fold * size for fold, size in enumerate(sizes)) / 12)
    assert row["stable"] == 2
    assert row["correlation"][1] < 0.1


def test_what_is_described_is_the_likeliest_of_those_that_come_back():
    rows = [(1, 1, 0.7, 1), (2, 1, 0.66, 2), (2, 2, 0.65, 2), (3, 2, 0.6, 2)]
    frame = pd.DataFrame(rows, columns=["modes", "order", "nats", "stable"])
    assert described(frame) == (2, 2)
    assert described(frame[frame["modes"] == 3]) is None
    assert described(frame[frame["modes"] == 1]) is None


def test_what_is_held_out_is_not_learned_from(plans):
    held_out = folds(plans, FOLDS, 0)[1][1]
    changed = read_plans(DATA)[:12]
    changed.actions[held_out] = 0
    settings = ModeSettings(1, 0)
    first, second = (fitted(Job(1, 0, 1), settings, some).log_probs for some in (plans, changed))
    assert torch.equal(first, second)
    assert not torch.equal(*(fitted(Job(1, 0, FOLDS), settings, some).log_probs for some in (plans, changed)))


def test_a_small_run(tmp_path, capsys):
    arguments = ["modes", "--modes", "1", "--orders", "0", "--restarts", "1", "--processes", "1", "--out"]
    assert main([*arguments, str(tmp_path)]) == 0
    assert "Nats per held-out move" in " ".join(capsys.readouterr().out.split())
    row = json.loads((tmp_path / "results.json").read_text())["rows"][0]
    assert (row["order"], row["modes"], row["stable"]) == (0, 1, 1)
    assert 0.85 < row["nats"] < 0.9
    assert len(list((tmp_path / "fits").rglob("*.npz"))) == FOLDS + 1
