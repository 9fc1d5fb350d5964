"""The report of a comparison: its page, files and figures, of made-up cells."""

import csv
import json
import re
import warnings
from io import StringIO

import numpy as np
import pytest
from matplotlib.colors import to_hex
from rich.console import Console

from eval.compare import figures
from eval.compare.report import compared, write_report
from eval.compare.rows import growth_rows, rows
from neuroprior.report.drawing import FEWER, MORE
from tests.support.browser import check_in_browser
from tests.support.compare_cells import BUDGETS, TIMES, cell, curve, drawing, entry, worlds
from tests.support.reports import FROM_ELSEWHERE

ASKED = (16, 256, 4096)
SETTINGS = {"seeds": 4, "worlds": ["maze", "a_world_with_a_long_name"]}
NAMES = ("rows", "paired", "efficiency", "bits", "words", "growth")
STYLE = figures.styles(["uniform", "markov-0", "markov-1", "markov-2", "gru", "transformer"])


def reported(cells, folder, asked=ASKED) -> tuple[dict, str, str]:
    """What `results.json` holds, the page, and what was printed; warnings are errors."""
    console = Console(width=80, file=StringIO())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_report(cells, asked, SETTINGS, "python -m eval compare", folder, console)
    results = json.loads((folder / "results.json").read_text())
    return results, (folder / "report.html").read_text(), console.file.getvalue()


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    """The report on two worlds with all there can be, its folder, and the cells."""
    cells = worlds(SETTINGS["worlds"], 4, {**TIMES, "runs/mine": 3.0}, sees=("nothing", "start"), rounds=1)
    folder = tmp_path_factory.mktemp("compare")
    return *reported(cells, folder), folder, cells


def test_files(everything):
    results, _, _, folder, cells = everything
    assert set(results) == {*NAMES, "reasons", "settings", "versions"}
    assert results["settings"] == SETTINGS
    made = compared(cells, ASKED)
    for name in NAMES:
        own = getattr(made, name)
        assert own
        assert results[name] == own
        with open(folder / f"{name}.csv", newline="") as file:
            read = list(csv.DictReader(file))
        assert read == [{key: "" if value is None else str(value) for key, value in row.items()} for row in own]
    wanted = {"world", "planner", "prior", "num_plans", "model_steps", "oracle_share", "low", "high"}
    assert wanted | {"seconds_per_decision"} <= set(results["rows"][0])


def test_page(everything):
    results, page, _, _, _ = everything
    assert not re.search(FROM_ELSEWHERE, page)
    titles = re.findall(r"<h2 .*?>(.*?)</h2>", page)
    assert titles == [
        "In plain words",
        "Share of the oracle against the number of plans",
        "Search efficiency",
        "What seeing adds",
        "What growing the horizon adds",
        "Share of the oracle after growth",
        "Growing the horizon",
        "Bits per action of held-out plans",
        "Plans drawn in the worlds",
        "What follows what",
        "The worlds",
        "Tables, world by world",
    ]
    for row in results["words"]:
        assert f"<p>{row['words']}</p>" in page.replace("&#39;", "'")
    assert "python -m eval compare" in page
    assert "With 256 candidate plans the best neural prior is better than the best Markov chain in " in page
    assert "The same of priors that see the start: " in page
    assert page.count('<div class="beside">') == 6


def test_printed(everything):
    results, _, printed, _, _ = everything
    assert max(map(len, printed.splitlines()[:-1])) <= 80
    flat = " ".join(printed.split())
    for row in results["words"]:
        if (row["sees"], row["rounds"]) == ("nothing", 0):
            assert row["words"] in flat
    (row,) = (
        row for row in results["rows"] if (row["world"], row["prior"], row["num_plans"]) == ("maze", "uniform", 256)
    )
    assert "The best prior of each kind: % of the oracle with 256 plans" in flat
    half = max(row["high"] - row["oracle_share"], row["oracle_share"] - row["low"])
    line = next(line for line in printed.splitlines() if line.strip().startswith("uniform"))
    assert line.split()[3:5] == [f"{100 * row['oracle_share']:.1f}", f"±{100 * half:.1f}"]


def test_the_same_cells_give_the_same_bytes(tmp_path):
    cells = worlds(["maze"], 3, {"uniform": 1.0, "markov-1": 2.0, "gru": 4.0})
    for name, own in (("a", cells), ("b", cells[::-1])):
        reported(own, tmp_path / name, (16,))
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert files == sorted(path.name for path in (tmp_path / "b").iterdir())
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_one_seed_and_hostile_names(tmp_path):
    names = ["<script>alert(1)</script>", "http://evil.org/$x$"]
    cells = [cell(name, 0, [entry("uniform", curve(1)), entry(name, curve(2), bits=1.0)]) for name in names]
    results, page, _ = reported(cells, tmp_path)
    assert all(row["low"] is row["high"] is None for row in results["rows"])
    assert not re.search("<script|<img", page)
    assert "One seed: nothing is told of chance." in page
    assert "a single seed does not tell" in page


def test_nothing_but_random_plans(tmp_path):
    results, page, _ = reported([cell("maze", 0, [entry("uniform", curve(1))])], tmp_path)
    assert results["words"] == results["paired"] == results["bits"] == []
    assert "There are no priors to be compared." in page
    assert not (tmp_path / "paired.csv").exists()


def test_no_cells_are_refused(tmp_path):
    with pytest.raises(ValueError, match="cells: at least one is expected"):
        reported([], tmp_path)


def test_a_browser_shows_the_page_on_a_phone_and_a_desktop(everything, tmp_path):
    check_in_browser(everything[1], tmp_path)


def test_curves_stand_where_they_are():
    cells = worlds(["maze"], 4, noise=0.02)
    figure = figures.share_figure(rows(cells, BUDGETS), ["uniform", "markov-2", "gru"], STYLE)
    axes = figure.axes[0]
    named = {line.get_label(): line for line in axes.lines if not line.get_label().startswith("_")}
    assert list(named) == ["uniform", "markov-2", "gru", "exhaustive"]
    assert named["exhaustive"].get_ydata()[0] == pytest.approx(60)
    means = np.mean([c["entries"][4]["share"] for c in cells], 0)
    assert np.allclose(named["gru"].get_xydata(), np.stack([BUDGETS, 100 * means], 1))
    assert len(axes.collections) == 3
    assert axes.get_title(loc="left") == "maze"
    grown = figures.growth_figure(growth_rows(worlds(["maze"], 2, rounds=2)), ["gru"], STYLE).axes[0]
    assert [label.get_text() for label in grown.get_xticklabels()] == ["0\n4", "1\n6", "2\n8"]


def test_gaps_are_hollow_where_they_may_be_chance():
    row = {"difference": 0.02, "low": 0.01, "high": 0.03}
    some = [
        {"world": "a", "better": "gru"} | row,
        {"world": "b", "better": None} | row,
        {"world": "c", "better": "markov-1", "difference": -0.01, "low": None, "high": None},
    ]
    axes = figures.gap_figure(some, ("left", "right")).axes[0]
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    filled = [dot.get_mfc() == dot.get_color() for dot in dots]
    told = {
        dot.get_ydata()[0]: (dot.get_xdata()[0], full, dot.get_color()) for dot, full in zip(dots, filled, strict=True)
    }
    assert told == {2: (2.0, True, MORE), 1: (2.0, False, MORE), 0: (-1.0, True, FEWER)}
    assert [label.get_text() for label in axes.get_yticklabels()] == ["c", "b", "a"]


def test_plans_needed_beyond_the_most_are_arrows():
    estimates = {"a": {"gru": (64.0, 32.0, 128.0), "markov-1": (np.inf, None, None)}, "b": {"gru": (4.0, None, None)}}
    axes = figures.dots_figure(estimates, STYLE, "plans", 4096).axes[0]
    marks = {(line.get_marker(), float(line.get_xdata()[0])) for line in axes.lines if line.get_marker() in ("o", ">")}
    assert marks == {("o", 64.0), (">", 4096.0), ("o", 4.0)}
    assert axes.get_xscale() == "log"


def test_plans_are_drawn_in_their_world():
    plans = drawing(np.random.default_rng(0), ["uniform", "gru"])
    (axes,) = figures.plans_figure(plans, "gru", STYLE["gru"][0], "maze: gru").axes
    assert axes.get_title(loc="left") == "maze: gru"
    (courses,) = axes.collections
    assert to_hex(courses.get_colors()[0]) == STYLE["gru"][0]
    ends = np.array([segment[-1] for segment in courses.get_segments()])
    assert np.abs(ends[:, ::-1] - np.array(plans["paths"]["gru"])[:, -1]).max() <= figures.JITTER
    shades, walls = axes.images[0].get_array(), np.array(plans["walls"])
    assert np.allclose(shades[walls], [*figures.WALL, 0.45])
    assert np.corrcoef(shades[~walls][:, 3], np.array(plans["reward"])[~walls])[0, 1] > 0.999
    bare = figures.plans_figure(plans | {"reward": None}, "gru", "#000000", "").axes[0].images[0].get_array()
    assert np.array_equal(bare[..., 3] > 0, walls)


def test_the_oracle_is_drawn_where_it_is_near():
    high = [entry("gru", [share] * 13) for share in (0.999, 0.5)]
    tops = [
        figures.share_figure(rows([cell("maze", 0, [one])], BUDGETS), ["gru"], STYLE).axes[0].get_ylim() for one in high
    ]
    assert tops[0][1] > 100 > 99.9 > tops[0][0] > 90
    assert tops[1][1] < 60


@pytest.mark.parametrize(
    "make",
    [
        lambda: figures.share_figure([], [], {}),
        lambda: figures.growth_figure([], [], {}),
        lambda: figures.gap_figure([], ("a", "b")),
        lambda: figures.dots_figure({}, {}, "x"),
        lambda: figures.bits_figure([], {}),
    ],
)
def test_nothing_to_draw_is_an_error(make):
    with pytest.raises(ValueError, match="at least one is expected"):
        make()
