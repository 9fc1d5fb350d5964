"""Figures of the report against tables made by hand: everything that is drawn stands where the table says."""

import pandas as pd
import pytest
from matplotlib.axes import Axes

from neuroprior.behaviour.reporting.drawing import FEWER, KINDS, MARKOV, MORE, SPARE, colors, lines
from neuroprior.behaviour.reporting.figures import (
    condition_figure,
    drift_figure,
    dwell_figure,
    motif_figure,
)


def title(axes: Axes) -> str:
    return axes.get_title(loc="left")


def test_dwell_times():
    """The commonest action first; bars between the edges of their bins, the law at their middles."""
    bins = [(1.0, 4.0, 0.5, 0.4), (4.0, 9.0, 0.2, 0.3)]
    actions = [("rare", 3, 0.0, "gamma"), ("usual", 50, 0.25, "weibull"), ("some", 10, 0.0, "exponential")]
    columns = ["behaviour", "number", "zero", "law", "low", "high", "density", "fitted"]
    figure = dwell_figure(pd.DataFrame([(*one, *each) for one in actions for each in bins], columns=columns))
    assert [title(axes) for axes in figure.axes] == ["usual\nweibull, 25 % at 0", "some\nexponential", "rare\ngamma"]
    for axes in figure.axes:
        bars = [(bar.get_x(), bar.get_width(), bar.get_height()) for bar in axes.patches]
        assert bars == [(1.0, 3.0, 0.5), (4.0, 5.0, 0.2)]
        (law,) = axes.lines
        assert law.get_xydata().tolist() == [[2.0, 0.4], [6.0, 0.3]]
        assert (axes.get_xscale(), axes.get_xlim()) == ("log", (1.0, 9.0))


@pytest.mark.parametrize("paired", [False, True])
def test_conditions_in_an_order_of_their_own(paired):
    """From the top down as in the means, not by name; dots, bars of means and lines between dots of one unit."""
    conditions, units = ["z", "a", "m"], ["u", "v"]
    means = [("f", one, k + 0.5, k + 0.25, k + 0.75) for k, one in enumerate(conditions)]
    values = [("f", unit, one, 10.0 * k + u) for u, unit in enumerate(units) for k, one in enumerate(conditions)]
    (axes,) = condition_figure(
        pd.DataFrame(means, columns=["feature", "condition", "mean", "low", "high"]),
        pd.DataFrame(values, columns=["feature", "unit", "condition", "value"]),
        paired,
    ).axes
    assert [(label.get_text(), label.get_position()[1]) for label in axes.get_yticklabels()] == [
        ("z", 0),
        ("a", -1),
        ("m", -2),
    ]
    joined, rest = axes.lines[: 2 * paired], axes.lines[2 * paired :]
    assert [line.get_xydata().tolist() for line in joined] == [
        [[u, 0], [10 + u, -1], [20 + u, -2]] for u in range(2 * paired)
    ]
    assert len(rest) == 9
    for k in range(3):
        dots, bar, mean = rest[3 * k : 3 * k + 3]
        assert dots.get_xydata().tolist() == [[10 * k, -k], [10 * k + 1, -k]]
        assert bar.get_xydata().tolist() == [[k + 0.25, -k - 0.32], [k + 0.75, -k - 0.32]]
        assert mean.get_xydata().tolist() == [[k + 0.5, -k - 0.32]]
        assert {line.get_color() for line in (dots, bar, mean)} == {dots.get_color()}


def test_drift_stands_at_the_middles_of_parts_and_at_the_numbers_of_plans():
    places = [("place", f"part {n}", bits, bits - 0.1, bits + 0.1) for n, bits in enumerate((2.0, 1.5, 1.2, 1.0), 1)]
    groups = [
        ("subject", name, bits, bits - 0.2, bits + 0.3) for name, bits in (("low", 1.0), ("high", 2.0), ("mid", 1.5))
    ]
    drift = pd.DataFrame(places + groups, columns=["what", "name", "bits", "low", "high"])
    many = pd.DataFrame({"index": range(1, 2502), "bits": [2.0 - n / 2500 for n in range(2501)]})
    within, between, below = drift_figure(drift, many).axes
    assert within.lines[0].get_xydata().tolist() == [[12.5, 2.0], [37.5, 1.5], [62.5, 1.2], [87.5, 1.0]]
    dots, means = between.lines
    assert len(dots.get_xdata()) == 1000
    assert (dots.get_xdata()[0], dots.get_xdata()[-1]) == (1, 2501)  # from the first to the last
    assert (dots.get_ydata() == 2.0 - (dots.get_xdata() - 1) / 2500).all()
    assert title(between) == "from sequence to sequence (1,000 of 2,501 drawn)"
    assert len(means.get_xdata()) == 20
    assert means.get_ydata().tolist() == pytest.approx((2.0 - (means.get_xdata() - 1) / 2500).tolist())
    assert [label.get_text() for label in below.get_yticklabels()] == ["low", "mid", "high"]  # from below
    bars = [line.get_xdata().tolist() for line in below.lines if len(line.get_xdata()) == 2]
    assert bars == [pytest.approx([bits - 0.2, bits + 0.3]) for bits in (1.0, 1.5, 2.0)]


def test_motifs_stand_where_they_are():
    """From the top down name, ratio, interval and count; what is beyond the ratios is cut, or an arrow at the edge."""
    rows = [("a b", 4.0, 0.01, 5.0, 1234), ("b a", 0.5, 0.3, 0.8, 7), ("c c", 0.0, 0.0, 0.4, 0)]
    axes = motif_figure(pd.DataFrame(rows, columns=["sequence", "ratio", "low", "high", "count"])).axes[0]
    heights = dict(zip((label.get_text() for label in axes.get_yticklabels()), axes.get_yticks(), strict=True))
    assert list(heights) == ["c c", "b a", "a b"]
    assert sorted(heights.values()) == list(heights.values())
    marks = {line.get_ydata()[0]: line for line in axes.lines if line.get_marker() in ("o", "<")}
    spans = {line.get_ydata()[0]: list(line.get_xdata()) for line in axes.lines[1:] if line.get_marker() == "None"}
    counts = {text.get_position()[1]: text.get_text() for text in axes.texts if text.get_text() != "count"}
    edge = 2**-2.5
    for (name, ratio, _, _, count), color in zip(rows, (MORE, FEWER, FEWER), strict=True):
        mark = marks[heights[name]]
        assert (mark.get_xdata()[0], mark.get_color()) == (pytest.approx(max(ratio, edge)), color)
        assert counts[heights[name]] == f"{count:,}"
    assert spans == {heights["a b"]: [pytest.approx(edge), 5.0], heights["b a"]: [0.3, 0.8]}
    assert marks[heights["c c"]].get_marker() == "<"


def test_colors_and_lines_are_those_of_the_kind_of_model():
    known = {"uniform": KINDS["uniform"], "markov-0": MARKOV[0], "markov-2, context": MARKOV[2], "markov": MARKOV[1]}
    known |= {"Markov-12": MARKOV[-1], "Context tree": KINDS["tree"], "GRU": KINDS["gru"], "this": SPARE[0]}
    known |= {"transformer": KINDS["transformer"], "combined": KINDS["combined"], "that": SPARE[1]}
    assert list(colors([*known])) == [*known.values()]
    assert list(lines(["gru", "gru, context"])) == [(KINDS["gru"], "-"), (KINDS["gru"], "--")]
