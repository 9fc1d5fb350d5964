"""`python -m eval curriculum`: gains that are known, views of rounds and lengths, figures."""

import warnings

import pandas as pd
import pytest

from eval.compare.curriculum import curriculum_document


def result(seed: int, share, context="none", world="maze") -> dict:
    """A run with one prior, whose normalised score after each round at each length is `share(seed, round, length)`."""
    curriculum = [
        {"prior": "gru", "context": context, "round": turn, "length": n, "num_plans": 64, "share": share(seed, turn, n)}
        for turn in (0, 1, 2)
        for n in (4, 8)
    ]
    return {"world": world, "seed": seed, "curriculum": curriculum}


def document(results):
    return curriculum_document(results, {}, "")


def gains(results) -> list[dict]:
    return document(results).frames["gains"].to_dict("records")


def tables(results):
    return document(results).sections[1].tables


def test_gains_are_paired_differences_at_the_longest_plans():
    """Seeds that differ much, and gain the same: no doubt is left."""
    made = [result(seed, lambda seed, turn, n: seed / 10 + turn * n / 100) for seed in range(10)]
    (row,) = gains(made)
    assert (row["world"], row["prior"], row["context"]) == ("maze", "gru", "none")
    assert (row["length"], row["rounds"], row["seeds"]) == (8, 2, 10)
    assert [row["gain"], row["low"], row["high"]] == pytest.approx([0.16] * 3)
    assert row["p_value"] < 0.05
    assert tables(made)[2].rows == [["gru", "none", "+16.0", "+16.0 to +16.0", "0.002"]]
    assert "1 of 1 differences are significant" in document(made).lead
    for one in made:  # whatever the order of the rounds
        one["curriculum"].reverse()
    assert gains(made)[0]["gain"] == pytest.approx(0.16)


def test_the_lead_counts_what_is_significant():
    shares = [lambda s, turn, n: 0.5 + turn / 10, lambda s, turn, n: 0.5 - turn / 10, lambda s, turn, n: 0.5 + turn * s]
    contexts = ("none", "initial", "per-step")
    cases = list(zip(shares, contexts, strict=True))
    made = [result(s - 5, share, context=context) for share, context in cases for s in range(10)]
    lead = document(made).lead
    assert "2 of 3 differences are significant" in lead
    assert lead.endswith("1 positive, 1 negative.")


def test_one_seed_has_no_interval():
    made = [result(0, lambda seed, turn, n: turn / 10)]
    (row,) = gains(made)
    assert row["gain"] == pytest.approx(0.2)
    assert pd.isna(row["low"])
    assert pd.isna(row["high"])
    assert "need at least two seeds" in document(made).lead
    assert [table.rows for table in tables(made)] == [
        [["gru", "none", "0.0", "10.0", "20.0"]],
        [["gru", "none", "20.0", "20.0"]],
    ]


def test_rounds_at_the_longest_plans_and_lengths_after_the_last_round():
    made = [result(seed, lambda seed, turn, n: turn / 10 + n / 100) for seed in range(3)]
    first, second, _ = tables(made)
    assert list(first.headings) == ["prior", "context", "0", "1", "2"]
    assert first.title == "maze, plans of 8 actions"
    assert first.rows == [["gru", "none", "8.0 ±0.0", "18.0 ±0.0", "28.0 ±0.0"]]
    assert list(second.headings) == ["prior", "context", "4", "8"]
    assert second.title == "maze, after 2 rounds"
    assert second.rows == [["gru", "none", "24.0 ±0.0", "28.0 ±0.0"]]


def test_aggregates_over_worlds():
    shares = {"maze": lambda s, turn, n: 0.5 + turn / 10, "grid": lambda s, turn, n: 0.7 - turn / 10}
    made = [result(seed, share, world=world) for world, share in shares.items() for seed in range(3)]
    (row,) = document(made).frames["across"].to_dict("records")
    assert (row["worlds"], row["seeds"]) == (2, 3)
    assert [row["first"], row["second"], row["improvement"]] == pytest.approx([0.6, 0.6, 0.5])


@pytest.mark.parametrize("seeds", [1, 3])
def test_figures_are_drawn_without_warnings(seeds):
    made = [result(seed, lambda seed, turn, n: turn / 10 + seed / 100, "per-step") for seed in range(seeds)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = document(made).sections[0].figures[0].figure
        figure.canvas.draw()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["gru, per-step"]
