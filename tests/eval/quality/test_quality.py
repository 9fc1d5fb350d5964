"""`python -m eval quality` and `python -m eval plans`: sources of known entropy, and saved priors on a file."""

import json
import math

import pytest
import torch
from scipy import stats

from eval.__main__ import main
from eval.quality.command import LAG, LENGTH, REPEAT, _fit, sources
from neuroprior import MarkovPrior, Plans, UniformPrior, save
from neuroprior.plans import write_plans
from tests.support.sources import FALSE_ALARM, p_value, seeded

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
    row = _fit(source, MarkovPrior, training, test, true, 0)
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


def context_at(source, plans: Plans, t: int) -> torch.Tensor | int:
    """The context of `plans` at action t."""
    if plans.context is None:
        return 0
    return plans.context[:, t] if source.context == "step" else plans.context


def history_at(source, actions: torch.Tensor, t: int) -> torch.Tensor:
    """The number of the last `order` actions before action t."""
    code = torch.zeros(len(actions), dtype=torch.long)
    for back in range(source.order, 0, -1):
        code = code * source.num_actions + actions[:, t - back]
    return code


def test_saved_priors_on_a_file(tmp_path, capsys):
    actions = torch.arange(400).view(40, 10) % 3
    write_plans(Plans(actions, 3, group=torch.arange(40) // 4), tmp_path / "plans.jsonl")
    save(MarkovPrior(3, 1).fit(actions[:8]), tmp_path / "markov")
    save(UniformPrior(3), tmp_path / "uniform")
    folders = [str(tmp_path / "markov"), str(tmp_path / "uniform")]
    out = tmp_path / "out"
    assert main(["plans", str(tmp_path / "plans.jsonl"), "--priors", *folders, "--out", str(out)]) == 0
    rows = json.loads((out / "results.json").read_text())["rows"]
    assert [row["model"] for row in rows] == folders
    assert rows[1]["bits_per_action"] == pytest.approx(math.log2(3))
    assert rows[1]["more"] == pytest.approx(rows[1]["bits_per_action"] - rows[0]["bits_per_action"])
    assert f"{rows[0]['bits_per_action']:.4f}" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["missing"], []])
def test_saved_priors_that_are_not_there(arguments, tmp_path, capsys):
    write_plans(Plans(torch.zeros(5, 3).long(), 2), tmp_path / "plans.npz")
    more = ["--priors", *arguments]
    assert main(["plans", str(tmp_path / "plans.npz"), "--out", str(tmp_path / "out"), *more]) == 2
    said = capsys.readouterr().err
    assert (arguments or ["priors"])[0] in said
    assert said.count("\n") == 1


def test_a_prior_for_other_actions_is_said(tmp_path, capsys):
    write_plans(Plans(torch.full((5, 3), 7), 8), tmp_path / "plans.npz")
    save(UniformPrior(3), tmp_path / "uniform")
    assert main(["plans", str(tmp_path / "plans.npz"), "--priors", str(tmp_path / "uniform")]) == 2
    assert "3" in capsys.readouterr().err
