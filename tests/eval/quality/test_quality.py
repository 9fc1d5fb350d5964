"""`python -m eval quality`: sources of known entropy, text, and long sequences."""

import itertools
import json
import math

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats

from eval.__main__ import main
from eval.quality.command import LAG, LENGTH, REPEAT, _fit, _price, sources
from eval.quality.sequences import CHARACTERS, KINDS, SWITCH, draw, sequences, switching_chain, text
from neuroprior import ContextTreePrior, MarkovPrior, Plans
from tests.support.sources import FALSE_ALARM, p_value, refuses, seeded

pytestmark = pytest.mark.usefixtures("undrawn")

SOURCES = sources(seeded(0))


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.name)
def test_plans_have_the_probabilities_that_the_source_says(source):
    """Actions that are drawn with probability p, of each of 20 bands of p, come as often as p says."""
    plans, log_prob = source.draw(4000, seeded(1))
    assert plans.actions.shape == (4000, LENGTH)
    total = torch.zeros(4000, LENGTH, dtype=torch.double)
    history = torch.zeros(4000, dtype=torch.long)
    actions = plans.actions.long()
    for t in range(LENGTH):
        if t < max(source.order, source.lag):
            total[:, t] = -math.log(source.num_actions)
        elif source.lag:
            even = (1 - REPEAT) / source.num_actions
            total[:, t] = torch.where(actions[:, t] == actions[:, t - LAG], REPEAT + even, even).log()
        else:
            probs = source.table[context_at(source, plans, t), history]
            total[:, t] = probs.gather(1, actions[:, t, None])[:, 0].log()
            if t == LENGTH - 1:
                likeliest = probs.argmax(1)
                hits, p = (actions[:, t] == likeliest).double(), probs.amax(1)
                z = float((hits - p).sum() / (p * (1 - p)).sum().sqrt())
                assert abs(z) < 4.9  # false alarm 1e-6
        history = (history * source.num_actions + actions[:, t]) % source.num_actions**source.order
    assert torch.allclose(total, log_prob)


def test_repeats_come_as_often_as_they_should():
    plans, _ = SOURCES[3].draw(4000, seeded(2))
    again = (plans.actions[:, LAG:] == plans.actions[:, :-LAG]).long()
    share = REPEAT + (1 - REPEAT) / 4
    assert p_value(again, torch.tensor([1 - share, share])) > FALSE_ALARM


@pytest.mark.parametrize("source", [SOURCES[0], SOURCES[1], SOURCES[4], SOURCES[5]], ids=lambda source: source.name)
def test_markov_of_the_right_order_costs_what_estimation_costs(source):
    """Twice the actions times the divergence from the source is chi-square, one degree a free probability."""
    training, _ = source.draw(20_000, seeded(3))
    context = None if source.context is None else training.context
    prior = MarkovPrior(source.num_actions, source.order, backoff="dirichlet", num_contexts=source.contexts)
    learned = prior.fit(training)(training.actions, context).double().log_softmax(-1)
    actions, divergence = training.actions.long(), torch.zeros(20_000, dtype=torch.double)
    for t in range(source.order, LENGTH):
        probs = source.table[context_at(source, training, t), history_at(source, actions, t)]
        divergence += (probs * (probs.log() - learned[:, t])).sum(-1)
    free = source.table[..., 0].numel() * (source.num_actions - 1)
    low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], free)
    assert low < 2 * float(divergence.sum()) < high


@pytest.mark.parametrize("number", [1, 3, 4])
def test_excess_is_of_actions_that_depend_on_the_past(number):
    source = SOURCES[number]
    (training, _), (test, true) = (source.draw(num, seeded(num)) for num in (500, 200))
    row = _fit(source, "markov", training, test, true, 0)
    prior = MarkovPrior(4, source.order, num_contexts=source.contexts).fit(training)
    first = max(source.order, source.lag)
    rate = -float(true[:, first:].mean()) / math.log(2)
    bits = -float(prior.action_log_probs(test)[:, first:].double().mean()) / math.log(2)
    assert (row["source"], row["model"]) == (source.name, "markov")
    assert (row["entropy_rate"], row["bits_per_action"]) == pytest.approx((rate, bits))
    assert row["excess_percent"] == pytest.approx(100 * (bits / rate - 1))
    free = {1: 64 * 3, 4: 8 * 4 * 3}.get(number)
    cost = free and 100 * free / (2 * math.log(2) * 500 * (LENGTH - first)) / rate
    assert row["expected_percent"] == (cost and pytest.approx(cost))


def test_hidden_conditions_are_weighed_by_all_ways_to_draw_them():
    """The log-probability of four actions is that of a sum over all sequences of conditions."""
    table = switching_chain(seeded(0))[:2, :3, :3]
    table = table / table.sum(-1, keepdim=True)
    plans, log_probs = draw(table, 20, seeded(1))
    same = 1 - SWITCH / 2
    for actions, found in zip(plans.actions[:, :4].tolist(), log_probs[:, :4].sum(1).tolist(), strict=True):
        total = 0.0
        for hidden in itertools.product(range(2), repeat=4):
            p = 1 / 2 / 3
            for t in range(1, 4):
                p *= same if hidden[t] == hidden[t - 1] else 1 - same
                p *= float(table[hidden[t], actions[t - 1], actions[t]])
            total += p
        assert found == pytest.approx(math.log(total))


def test_sequences_are_drawn_from_their_source():
    """If they are, the surprisal of an action less its expectation has mean 0; and in one condition a chain is left."""
    table = switching_chain(seeded(0))
    assert torch.allclose(table.sum(-1), torch.ones(6, KINDS, dtype=torch.double))
    plans, log_probs = draw(table[:1], 20, seeded(2))
    actions = plans.actions.long()
    probs = table[0, actions[:, :-1]]
    assert torch.allclose(log_probs[:, 1:], probs.gather(2, actions[:, 1:, None])[..., 0].log())
    mean = (probs * probs.log()).sum(-1)
    spread = ((probs * probs.log() ** 2).sum(-1) - mean**2).sum().sqrt()
    assert abs(float((log_probs[:, 1:] - mean).sum() / spread)) < 4.9  # false alarm 1e-6


def test_text_is_cut_into_parts_that_are_divided():
    parts = text(seeded(0))
    line = "".join(CHARACTERS[number] for number in parts.actions[:10].flatten().tolist())
    assert sum(line.count(word) for word in (" the ", " of ", " is ")) > 100  # among 10,000 characters of English
    second = sequences(20, seeded(0))[1]
    learned, other = second.training, second.test
    assert (len(learned), len(other)) == (20, 10)
    assert len(torch.cat([learned.actions, other.actions]).unique(dim=0)) == 30
    assert sequences(0, seeded(0)) == []
    with refuses("num_sequences", "got 100000"):
        sequences(100_000, seeded(0))


def test_long_sequences_have_a_table_of_their_own(tmp_path, capsys, monkeypatch):
    fitted = []

    def quickly(plans, name, **_):
        fitted.append(name)
        return (ContextTreePrior if name == "context-tree" else MarkovPrior)(plans.num_actions).fit(plans)

    def untrained(prior, *_, **__):
        fitted.append(getattr(prior, "effort", type(prior).__name__))
        return prior

    monkeypatch.setattr("eval.quality.command.fit", quickly)
    monkeypatch.setattr("eval.quality.command.sources", lambda generator: SOURCES[:1])
    for kind in ("GRUPrior", "TransformerPrior", "CombinedPrior"):
        monkeypatch.setattr(f"eval.quality.command.{kind}.fit", untrained)
    few = ["--num-sequences", "4", "--processes", "1"]
    assert main(["quality", "--num-plans", "100", "--held-out", "100", *few, "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "results.json").read_text())
    assert [row["model"] for row in found["rows"]] == ["markov", "gru", "transformer", "combined", "combined, full"]
    assert fitted[-4:] == ["GRUPrior", "TransformerPrior", "standard", "full"]
    rows = found["sequences"]
    names = ["markov", "context-tree", "gru", "stacked", "transformer", "combined"]
    assert [row["model"] for row in rows] == names * 2
    assert fitted[:-4] == names[1:] * 2
    for row in rows:
        assert row["seconds"] > 0
        kinds = KINDS if row["entropy"] else len(CHARACTERS)
        assert (row["entropy"] or 1) < row["bits_per_action"] < math.log2(kinds)
    chain, tree, combined = rows[0], rows[1], rows[5]
    assert combined["more"] == 0
    assert chain["more"] == pytest.approx(chain["bits_per_action"] - combined["bits_per_action"])
    assert tree["more"] == pytest.approx(tree["bits_per_action"] - combined["bits_per_action"])
    assert tree["more_low"] < tree["more"] < tree["more_high"]
    assert "times as long as markov, context-tree, gru, stacked together" in " ".join(capsys.readouterr().out.split())
    alone = tmp_path / "alone"
    assert main(["quality", "--num-plans", "0", *few, "--seeds", "3", "--out", str(alone)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    again = json.loads((alone / "results.json").read_text())
    assert "rows" not in again
    assert [row["seed"] for row in again["sequences"]] == [0] * 12 + [1] * 12 + [2] * 12
    for row, before in zip(again["sequences"], rows, strict=False):
        assert row["bits_per_action"] == before["bits_per_action"]
    every = pd.DataFrame(again["sequences"])
    bits = every[every["source"] == rows[0]["source"]].pivot(index="seed", columns="model", values="bits_per_action")
    gap = stats.ttest_rel(bits["context-tree"], bits["combined"])
    mean, half = (bits["context-tree"] - bits["combined"]).mean(), np.ptp(gap.confidence_interval()) / 2
    assert f"{bits['context-tree'].mean():.4f} {mean:+.4f} ±{half:.4f}" in said
    before = len(fitted)
    assert main(["quality", "--num-plans", "0", *few, "--seeds", "2", "--out", str(alone)]) == 0
    assert len(fitted) == before  # these were learned


def test_the_price_of_the_combined_prior_is_that_of_its_parts():
    """It takes 30 s; its parts, a chain, a tree, a GRU and a stacked prior, 1, 2, 8 and 9 s; a transformer is none."""
    seconds = {"markov": 1, "context-tree": 2, "gru": 8, "stacked": 9, "transformer": 80, "combined": 30}
    rows = pd.DataFrame([{"source": "text", "model": name, "seconds": value} for name, value in seconds.items()])
    assert _price(rows) == 1.5
    slower = rows.assign(seconds=[2, 2, 10, 11, 0, 50])  # a second seed: 40 s in the mean, of 22.5
    assert _price(pd.concat([rows, slower])) == pytest.approx(40 / 22.5)


def context_at(source, plans: Plans, t: int) -> torch.Tensor | int:
    """The context of `plans` at action t."""
    if plans.context is None:
        return 0
    return plans.context[:, t]


def history_at(source, actions: torch.Tensor, t: int) -> torch.Tensor:
    """The number of the last `order` actions before action t."""
    code = torch.zeros(len(actions), dtype=torch.long)
    for back in range(source.order, 0, -1):
        code = code * source.num_actions + actions[:, t - back]
    return code
