"""The report on growth: gains that are known, views of rounds and lengths, figures and words."""

import warnings

import pytest

from eval.compare.growth_report import gain_rows, growth_figure, lead, tables, views, words
from eval.compare.rows import growth_rows
from tests.support.sources import refuses


def cell(seed: int, share, rounds=(0, 1, 2), lengths=(4, 8), sees="nothing") -> dict:
    """A cell of one prior whose share of the oracle after each round at each length is `share(seed, round, length)`."""
    growth = [
        {"prior": "gru", "sees": sees, "round": turn, "length": n, "num_plans": 64, "share": share(seed, turn, n)}
        for turn in rounds
        for n in lengths
    ]
    return {"world": "maze", "seed": seed, "growth": growth}


def diagonal(seed: int) -> dict:
    """A cell in which each round was looked at with its own length alone."""
    whole = cell(seed, lambda seed, turn, n: turn / 10 + seed / 100)
    kept = [one for one in whole["growth"] if (one["round"], one["length"]) in ((0, 4), (1, 8))]
    return whole | {"growth": kept}


def test_gains_are_paired_differences_at_the_longest_plans():
    """Seeds that differ much, and gain the same: no doubt is left."""
    cells = [cell(seed, lambda seed, turn, n: seed / 10 + turn * n / 100) for seed in range(5)]
    (row,) = gain_rows(cells)
    assert (row["world"], row["prior"], row["sees"]) == ("maze", "gru", "nothing")
    assert (row["length"], row["rounds"], row["seeds"]) == (8, 2, 5)
    assert [row["gain"], row["low"], row["high"]] == pytest.approx([0.16] * 3)
    assert "changes gru by +16.0 (+16.0 to +16.0)" in words(growth_rows(cells), [row])
    assert "5 seeds" in words(growth_rows(cells), [row])


def test_no_gain_cannot_be_told():
    cells = [cell(seed, lambda seed, turn, n: 0.5 + turn * (seed - 2) / 100) for seed in range(5)]
    (row,) = gain_rows(cells)
    assert row["gain"] == pytest.approx(0)
    assert row["low"] < 0 < row["high"]
    assert "cannot be told to change gru" in words(growth_rows(cells), [row])


def test_the_lead_counts_what_can_be_told():
    shares = [lambda s, turn, n: 0.5 + turn / 10, lambda s, turn, n: 0.5 - turn / 10, lambda s, turn, n: 0.5 + turn * s]
    sees = ("nothing", "start", "each step")
    cells = [cell(s - 2, share, sees=seen) for share, seen in zip(shares, sees, strict=True) for s in range(5)]
    said = lead(gain_rows(cells))
    assert "Of 3 cases, a prior in one of 1 world, it helped in 1 and harmed in 1" in said
    assert "Of" not in lead(gain_rows([diagonal(0)]))


def test_one_seed_has_no_interval():
    cells = [cell(0, lambda seed, turn, n: turn / 10)]
    (row,) = gain_rows(cells)
    assert (row["gain"], row["low"], row["high"]) == (pytest.approx(0.2), None, None)
    assert "changes gru by +20.0" in words(growth_rows(cells), [row])
    assert [table.rows for table in tables(growth_rows(cells))] == [
        [["gru", "0.0", "10.0", "20.0"]],
        [["gru", "20.0", "20.0"]],
    ]


def test_rounds_at_the_longest_plans_and_lengths_after_the_last_round():
    rows = growth_rows([cell(seed, lambda seed, turn, n: turn / 10 + n / 100) for seed in range(3)])
    by_round, by_length = views(rows)
    assert by_round.places == {0: "0", 1: "1", 2: "2"}
    assert {row["length"] for row in by_round.rows} == {8}
    assert by_length.places == {4: "4", 8: "8"}
    assert {row["round"] for row in by_length.rows} == {2}
    first, second = tables(rows)
    assert first.rows == [["gru", "8.0 ± 0.0", "18.0 ± 0.0", "28.0 ± 0.0"]]
    assert second.rows == [["gru", "24.0 ± 0.0", "28.0 ± 0.0"]]


def test_a_round_may_have_its_own_length_alone():
    cells = [diagonal(seed) for seed in range(3)]
    rows = growth_rows(cells)
    (view,) = views(rows)
    assert view.places == {0: "0 (4)", 1: "1 (8)"}
    assert gain_rows(cells) == []
    assert "not told" in words(rows, [])


@pytest.mark.parametrize("cells", [[diagonal(0)], [diagonal(s) for s in range(3)], [cell(0, lambda *_: 0.5)]])
def test_figures_are_drawn_without_warnings(cells):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = growth_figure(growth_rows(cells))
        figure.canvas.draw()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["gru"]


def test_what_priors_see_is_in_their_names():
    cells = [cell(0, lambda *_: 0.5, sees=sees) for sees in ("start", "each step")]
    names = [table.rows[0][0] for one in cells for table in tables(growth_rows([one]))]
    assert names == ["gru, sees the start"] * 2 + ["gru, sees each step"] * 2


def test_nothing_to_draw():
    with refuses("rows: at least one"):
        growth_figure([])
