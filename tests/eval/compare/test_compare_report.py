"""The report of a comparison: its page, files and figures, of made-up runs."""

import csv
import json
import re
import warnings
from contextlib import redirect_stdout
from io import StringIO

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from eval.compare import figures
from eval.compare.report import FRAMES, document
from eval.compare.results import Results
from neuroprior.behaviour.reporting.document import publish, records
from neuroprior.behaviour.reporting.drawing import FEWER, MORE
from tests.support.browser import check_in_browser
from tests.support.compare_runs import BUDGETS, TIMES, curve, drawing, entry, run, worlds
from tests.support.reports import FROM_ELSEWHERE

ASKED = (16, 256, 4096)
SETTINGS = {"seeds": 4, "worlds": ["maze", "a_world_with_a_long_name"]}
KEYS = {"rows", "paired", "efficiency", "bits", "words", "growth", "reasons", "settings", "versions"}
STYLE = figures.styles(["uniform", "markov-0", "markov-1", "markov-2", "gru", "transformer"])


def reported(runs, folder, asked=ASKED) -> tuple[dict, str, str]:
    """What `results.json` holds, the page, and what was printed; warnings are errors."""
    printed = StringIO()
    with warnings.catch_warnings(), redirect_stdout(printed):
        warnings.simplefilter("error")
        publish(document(Results(runs, asked), SETTINGS, "python -m eval compare"), folder)
    results = json.loads((folder / "results.json").read_text())
    return results, (folder / "report.html").read_text(), printed.getvalue()


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    """The report on two worlds with all there can be, its folder, and the runs."""
    runs = worlds(
        SETTINGS["worlds"], 4, {**TIMES, "runs/mine": 3.0, "combined": 32.0}, context=("none", "initial"), rounds=1
    )
    folder = tmp_path_factory.mktemp("compare")
    return *reported(runs, folder), folder, runs


def test_files(everything):
    results, _, _, folder, runs = everything
    assert set(results) == KEYS | set(FRAMES)
    assert results["settings"] == SETTINGS
    made = Results(runs, ASKED)
    for name in FRAMES:
        frame = getattr(made, FRAMES[name])
        own = records(frame)
        assert results[name] == own
        if name == "reasons":
            continue  # of made-up networks that are better everywhere there may be none
        assert own
        with open(folder / f"{name}.csv", newline="") as file:
            read = list(csv.DictReader(file))
        assert read == [{key: "" if value is None else str(value) for key, value in row.items()} for row in own]
    wanted = {"world", "planner", "prior", "num_plans", "model_steps", "oracle_share", "low", "high"}
    assert wanted | {"seconds_per_decision"} <= set(results["rows"][0])


def test_page(everything):
    _, page, _, _, _ = everything
    assert not re.search(FROM_ELSEWHERE, page)
    titles = re.findall(r"<h2 .*?>(.*?)</h2>", page)
    assert len({*titles} - {"Where networks are not better"}) == 12
    assert "With 256 candidate plans the best neural prior is significantly better" in page
    assert page.count("Best neural minus best Markov prior with 256 plans, ") == 4  # contexts and curriculum
    assert "initial context, after the horizon curriculum" in page


def test_one_seed_and_hostile_names(tmp_path):
    names = ["<script>alert(1)</script>", "http://evil.org/$x$"]
    runs = [run(name, 0, [entry("uniform", curve(1)), entry(name, curve(2), bits=1.0)]) for name in names]
    results, page, _ = reported(runs, tmp_path)
    assert all(row["low"] is row["high"] is None for row in results["rows"])
    assert not re.search("<script|<img", page)
    assert "Seeds: 1." in page
    assert all(row["better"] is row["p_holm"] is None for row in results["words"])


def test_nothing_but_random_plans(tmp_path):
    results, page, _ = reported([run("maze", 0, [entry("uniform", curve(1))])], tmp_path)
    assert results["words"] == results["paired"] == results["bits"] == []
    assert "Neural priors and Markov chains were not compared." in page
    assert not (tmp_path / "paired.csv").exists()


def test_a_browser_shows_the_page_on_a_phone_and_a_desktop(everything, tmp_path):
    check_in_browser(everything[1], tmp_path)


def test_curves_stand_where_they_are():
    runs = worlds(["maze"], 4, noise=0.02)
    figure = figures.score_figure(Results(runs, BUDGETS).rows, ["uniform", "markov-2", "gru"], STYLE)
    axes = figure.axes[0]
    named = {line.get_label(): line for line in axes.lines if not line.get_label().startswith("_")}
    assert list(named) == ["uniform", "markov-2", "gru", "exhaustive"]
    assert named["exhaustive"].get_ydata()[0] == pytest.approx(60)
    means = np.mean([one["entries"][4]["share"] for one in runs], 0)
    assert np.allclose(named["gru"].get_xydata(), np.stack([BUDGETS, 100 * means], 1))
    assert len(axes.collections) == 3
    assert axes.get_title(loc="left") == "maze"
    rounds = Results(worlds(["maze"], 2, rounds=2), ASKED).curriculum
    axes = figures.curriculum_figure(rounds, ["gru"], STYLE).axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0\n4", "1\n6", "2\n8"]


def test_gaps_are_hollow_where_they_are_not_significant():
    row = {"difference": 0.02, "low": 0.01, "high": 0.03}
    some = [
        {"world": "a", "better": "gru"} | row,
        {"world": "b", "better": None} | row,
        {"world": "c", "better": "markov-1", "difference": -0.01, "low": None, "high": None},
    ]
    axes = figures.gap_figure(pd.DataFrame(some), ("left", "right")).axes[0]
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    filled = [dot.get_mfc() == dot.get_color() for dot in dots]
    drawn = {
        dot.get_ydata()[0]: (dot.get_xdata()[0], full, dot.get_color()) for dot, full in zip(dots, filled, strict=True)
    }
    assert drawn == {2: (2.0, True, MORE), 1: (2.0, False, MORE), 0: (-1.0, True, FEWER)}
    assert [label.get_text() for label in axes.get_yticklabels()] == ["c", "b", "a"]


def test_plans_needed_beyond_the_most_are_arrows():
    estimates = [("a", "gru", 64.0, 32.0, 128.0), ("a", "markov-1", np.inf, None, None), ("b", "gru", 4.0, None, None)]
    rows = pd.DataFrame(estimates, columns=["world", "prior", "mean", "low", "high"])
    axes = figures.dots_figure(rows, STYLE, "plans", 4096).axes[0]
    marks = {(line.get_marker(), float(line.get_xdata()[0])) for line in axes.lines if line.get_marker() in ("o", ">")}
    assert marks == {("o", 64.0), (">", 4096.0), ("o", 4.0)}
    assert axes.get_xscale() == "log"


def test_plans_are_drawn_in_their_world():
    plans = drawing(np.random.default_rng(0), ["uniform", "gru"])
    (axes,) = figures.plans_figure(plans, "gru", STYLE["gru"][0], "maze: gru").axes
    assert axes.get_title(loc="left") == "maze: gru"
    (paths,) = axes.collections
    assert to_hex(paths.get_colors()[0]) == STYLE["gru"][0]
    ends = np.array([segment[-1] for segment in paths.get_segments()])
    assert np.abs(ends[:, ::-1] - np.array(plans["paths"]["gru"])[:, -1]).max() <= figures.JITTER
    shades, walls = axes.images[0].get_array(), np.array(plans["walls"])
    assert np.allclose(shades[walls], [*figures.WALL, 0.45])
    assert np.corrcoef(shades[~walls][:, 3], np.array(plans["reward"])[~walls])[0, 1] > 0.999
    bare = figures.plans_figure(plans | {"reward": None}, "gru", "#000000", "").axes[0].images[0].get_array()
    assert np.array_equal(bare[..., 3] > 0, walls)


@pytest.mark.parametrize(
    "make",
    [
        lambda: figures.score_figure(pd.DataFrame(), [], {}),
        lambda: figures.score_panels([]),
        lambda: figures.curriculum_figure(pd.DataFrame(), [], {}),
        lambda: figures.gap_figure(pd.DataFrame(), ("a", "b")),
        lambda: figures.dots_figure(pd.DataFrame(), {}, "x"),
        lambda: figures.bits_figure(pd.DataFrame(), {}),
    ],
)
def test_nothing_to_draw_is_an_error(make):
    with pytest.raises(ValueError, match="must not be empty"):
        make()


def test_two_saved_priors_are_compared_in_pairs(tmp_path):
    """Nothing is said of the best of a kind, or of chains, where none is known to be there."""
    times = {"uniform": 1.0, "runs/mine": 3.0, "runs/other": 8.0}
    results, page, shown = reported(worlds(["maze"], 4, times), tmp_path)
    assert [row["what"] for row in results["words"]] == ["learned minus other"]
    assert "Priors in pairs" in page
    for text in (page, shown):
        assert "the tables compare the priors in pairs. Seeds: 4." in " ".join(text.split())
        for wrong in ("Neural priors against", "The best prior of each kind", "than the best Markov chain"):
            assert wrong not in " ".join(text.split())
