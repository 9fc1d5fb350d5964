"""The paper's simulations: where plans are learned from, and summaries and figures of results made by hand."""

from dataclasses import replace

import pandas as pd
import pytest
import torch

from eval.paper import first_simulation
from eval.paper.figures import best_bars
from eval.paper.second_simulation import PAPER_REACHED, Pursuit, SecondResult, empty_world
from tests.eval.paper.test_second_simulation import settings


class LearnedError(Exception):
    """Raised where plans would be collected."""


@pytest.mark.parametrize("worlds", [1, 3])
def test_with_several_worlds_priors_learn_in_others(worlds, monkeypatch):
    """Worlds 0 to W - 1 are planned in, W to 2 W - 1 are learned from; of one world there is no other."""

    def collected(world, states, *_):
        maps = world.reward_map(states).unique().tolist()
        assert maps == (list(range(worlds, 2 * worlds)) if worlds > 1 else [0])
        raise LearnedError

    monkeypatch.setattr(first_simulation, "training_plans", collected)
    with pytest.raises(LearnedError):
        first_simulation.simulate(replace(settings(), worlds=worlds), neural=False)


def test_ties_count_for_each():
    scores = torch.tensor([[1.0, 2.0, 3.0], [1.0, 1.0, 5.0], [0.0, 2.0, 9.0]])
    best = first_simulation.best_of(scores, scores[:2])
    assert best.tolist() == [[True, True, False], [True, False, True], [False, True, True]]


def test_the_distance_from_the_papers_table():
    """The root mean square; of a single value function its interval is the distance itself."""
    t = settings()
    shares = {"deterministic": 0.25, "random": 0.75, "markov-1": 0.5, "markov-2": 0.0, "markov-3": 1.0}
    pursuits = {
        name: Pursuit(torch.arange(4) < 4 * share, torch.zeros(4), torch.zeros(0, 0), None, torch.zeros(0), 7)
        for name, share in shares.items()
    }
    able = torch.tensor([[True, True, False, True]])
    world, values = empty_world(t, 1), torch.zeros(1, 36)
    result = SecondResult(world, torch.zeros(1, 4), pursuits, able, able | True, values, values[0])
    found = result.summary()
    gaps = [shares[name] - share for name, share in PAPER_REACHED.items()]
    distance = (sum(gap**2 for gap in gaps) / 4) ** 0.5
    assert found == pytest.approx(
        shares
        | {"ceiling": 0.75, "ceiling_any_prefix": 1.0}
        | dict.fromkeys(("table_distance", "low", "high"), distance)
    )


def test_bars_have_their_intervals_and_the_papers_shares():
    rows = [
        ("deterministic", 0.3, 0.25, 0.5, 0.321),
        ("markov-3", 0.6, 0.3, 0.7, None),
        ("oracle", 1.0, 1.0, 1.0, None),
    ]
    frame = pd.DataFrame(rows, columns=["planner", "best", "low", "high", "paper"])
    axes = best_bars(frame).axes[0]
    assert [bar.get_height() for bar in axes.patches] == pytest.approx([30, 60])
    spans = [segment[:, 1].tolist() for segment in axes.collections[0].get_segments()]
    assert [end for span in spans for end in span] == pytest.approx([25, 50, 30, 70])
    (paper,) = [line for line in axes.lines if line.get_label() == "paper"]
    assert paper.get_xydata().tolist() == [[0, pytest.approx(32.1)]]
    assert [text.get_text() for text in axes.texts] == ["30.0", "60.0"]
