"""The page of results: escaped, self-contained, the same bytes each time, and legible figures of the right numbers."""

import html
import re
from html.parser import HTMLParser
from typing import Any
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure

from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.reporting.drawing import FEWER, KINDS, MARKOV, MORE, SPARE, STRIPS, drawn, short
from neuroprior.behaviour.reporting.figures import (
    MOST_BINS,
    drift_figure,
    dwell_figure,
    ethogram_figure,
    group_transition_figure,
    lag_figure,
    motif_figure,
    score_figure,
    transition_figure,
)
from neuroprior.behaviour.reporting.page import INK, PAPER, FigureBox, Section, Table, clean, svg, write_page
from neuroprior.plans import Plans
from tests.support.browser import check_in_browser
from tests.support.sources import refuses

HOSTILE = ["<b>\"&'", "</svg><script>alert(1)</script>", "$x$ $\\frac{$", "\x00\x1b", "http://evil.org", "_x"]
MANY = [f"groom left forepaw while rearing {n}" for n in range(57)]
MODELS = ["uniform", "markov-0", "markov-3", "context tree", "gru", "gru, context", "combined"]
SVG = "{http://www.w3.org/2000/svg}"


class Reader(HTMLParser):
    """The tags of a page with their attributes, and the text between them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_data(self, data):
        self.text.append(data)

    def values(self, name: str) -> list[str]:
        return [attributes[name] for _, attributes in self.tags if name in attributes]


def page_of(name: str, boxes: list[FigureBox] = ()) -> dict[str, Any]:
    """The arguments of a page in which `name` stands wherever a text can."""
    table = Table([name, "bits"], [[name, "1.5"], ["other", name]], name)
    section = Section(name, [name, name], [table], [FigureBox(box.figure, name, name) for box in boxes])
    settings = {name: name, "names": [name]}
    return {
        "title": name,
        "lead": [name, name],
        "sections": [section, Section("last", files=["scores.csv"])],
        "settings": settings,
        "command": name,
        "status": name,
    }


def written(folder, page: dict[str, Any]) -> str:
    write_page(folder / "page.html", **page)
    return (folder / "page.html").read_text(encoding="utf-8")


def estimate(mean: float, half: float = 0.05) -> tuple[float, float, float]:
    return mean, mean - half, mean + half


def scores(models: list[str], context: bool) -> pd.DataFrame:
    rows = [
        (model, inputs, 1 + n / 10, 0.9 + n / 10, 1.1 + n / 10)
        for n, model in enumerate(models)
        for inputs in ("behaviours", "behaviours and context")[: 1 + context]
    ]
    return pd.DataFrame(rows, columns=["model", "input", "bits_per_behaviour", "low", "high"])


def lags(curves: dict[str, list[tuple]]) -> pd.DataFrame:
    rows = [(model, "behaviours", *row) for model, rows in curves.items() for row in rows]
    return pd.DataFrame(rows, columns=["model", "input", "lag", "bits", "low", "high"])


def matrix(names: list[str], seed: int = 0) -> np.ndarray:
    probs = np.random.default_rng(seed).dirichlet(np.ones(len(names)), len(names))
    probs[-1] = np.nan
    return probs


def dwell(names: list[str]) -> pd.DataFrame:
    """Two bins an action, of times from a thousandth to days."""
    rows = [(name, n, n / 99, "gamma", 10.0**k, 10.0 ** (k + n % 5 + 1), 1 / (n + 1), None if n == 2 else 0.5)
            for n, name in enumerate(names) for k in (-3, n % 5 - 2)]  # fmt: skip
    columns = ["behaviour", "number", "zero", "law", "low", "high", "density", "fitted"]
    return pd.DataFrame(rows, columns=columns)


def figures(names: list[str], models: list[str], groups: list[str], context: bool) -> dict[str, Figure]:
    """Every figure, with values missing here and there."""
    by_group = np.stack([matrix(names, seed) for seed in range(len(groups))])
    ranked = scores(models, context)
    if len(models) > 1:
        ranked.loc[len(ranked)] = {"model": "not scored", "input": "behaviours"}
    motifs = pd.DataFrame({"ratio": (8.0, 0.5, 0.0, None, float("inf")), "low": (None, None, 0, None, None), "high": 4})
    plans = [(n, None if n == 3 else 1 + n / 100) for _ in groups for n in range(20)]
    steps = [*((lag, *estimate(0.5**lag, 0.01)) for lag in range(1, 9)), (9, None, None, None)]
    drift = [("place", "", *estimate(1)), ("place", "", None, None, None), ("subject", "x", None, None, None)]
    drift += [("subject", group, *estimate(1)) for group in groups]
    return {
        "score": score_figure(ranked),
        "lag": lag_figure(lags(dict.fromkeys(models, steps))),
        "one lag": lag_figure(lags({models[0]: [(1, 0.0, -0.1, 0.1)]})),
        "motif": motif_figure(motifs.assign(sequence=" > ".join(names[:6]), count=1200)),
        "drift": drift_figure(
            pd.DataFrame(drift, columns=["what", "name", "bits", "low", "high"]),
            pd.DataFrame(plans, columns=["index", "bits"]),
        ),
        "transition": transition_figure(matrix(names), names, names[0]),
        "group": group_transition_figure(by_group, matrix(names), names, groups, by_group > 0.9),
        "dwell": dwell_figure(dwell(names)),
        "ethogram": ethogram_figure(sessions(names)),
    }


CASES = {
    "one": (["L", "R"], ["markov-1"], ["only"], False),
    "many": (MANY[:30], MODELS, [f"session of animal {n}" for n in range(6)], False),
    "hostile": (HOSTILE, HOSTILE[:3], HOSTILE[:3], True),
}


@pytest.fixture(scope="module")
def boxes() -> dict[str, FigureBox]:
    """Every figure in every case."""
    made = {f"{case} {name}": figure for case, given in CASES.items() for name, figure in figures(*given).items()}
    return {name: FigureBox(figure, "caption", "alt") for name, figure in made.items()}


@pytest.fixture(scope="module")
def page(boxes, tmp_path_factory) -> str:
    """A page with all of them, the first of them twice."""
    name = f"http://evil.org <img src=x> {'averylongnamewithoutanyspaces' * 4}"
    return written(tmp_path_factory.mktemp("page"), page_of(name, [*boxes.values(), *[*boxes.values()][:1]]))


@settings(max_examples=30, deadline=None)
@given(name=st.one_of(st.text(max_size=30), st.sampled_from([*HOSTILE, "\ud800"])))
def test_no_text_changes_what_the_page_is_made_of(name, tmp_path_factory):
    """The same tags with the same names of attributes as with a harmless name, and the text to be read as it was."""
    folder, name = tmp_path_factory.mktemp("page"), f"{name}~x~"
    hostile, harmless = (Reader(written(folder, page_of(text))) for text in (name, "harmless"))
    shape = [[(tag, list(attributes)) for tag, attributes in reader.tags] for reader in (hostile, harmless)]
    assert shape[0] == shape[1]
    assert [text.replace(clean(name), "harmless") for text in hostile.text] == harmless.text


@settings(max_examples=30, deadline=None)
@given(name=st.one_of(st.text(min_size=1, max_size=25), st.sampled_from([*HOSTILE, "\ud800"])))
def test_names_stand_in_figures_as_they_are(name):
    @drawn
    def figure() -> Figure:
        made = Figure(figsize=(2, 1))
        made.text(0, 0, short(f"{name}.", 60))
        return made

    root = ElementTree.fromstring(svg(figure()))
    assert [" ".join(text.text.split()) for text in root.iter(f"{SVG}text")] == [clean(f"{name}.")]


def test_figures_are_valid_and_follow_the_page(boxes, page):
    """Valid XML; no black and no white, one of which would be lost on one of the pages; no text left out of letters."""
    drawings = re.findall("<svg.*?</svg>", page, re.DOTALL)
    for name, text in zip([*boxes, "again"], drawings, strict=True):
        root = ElementTree.fromstring(text)
        # What is black has no colour in the file at all.
        shown = [one for group in root.iter(f"{SVG}g") for one in group if one.tag in (f"{SVG}path", f"{SVG}use")]
        assert all(re.search("fill: |fill-opacity: 0;", one.get("style")) for one in shown), name
        assert all("fill: currentColor" in one.get("style") for one in root.iter(f"{SVG}text")), name
        tags = " ".join(re.findall(r"<[^>]*>", text))
        assert "currentColor" in tags, name
        assert not re.search(rf"{INK}|{PAPER}|#000000|#ffffff|: black|: white", tags), name
        assert not re.search(r"<style|<metadata|<!--", text), name


def test_pages_need_nothing_from_outside(boxes, page):
    reader = Reader(page)
    links = [link for name in ("src", "href", "xlink:href", "action", "data") for link in reader.values(name)]
    assert len(links) > len(boxes)
    assert all(link.startswith(("#", "data:")) or link == "scores.csv" for link in links)
    opened = [value for _, tag in reader.tags for name, value in tag.items() if not name.startswith(("xmlns", "aria-"))]
    assert not [value for value in opened if re.search(r"https?:|^//", value or "")]
    assert all(place.startswith("#") for place in re.findall(r"url\(([^)]*)\)", page))
    assert not {"script", "link", "img", "iframe"} & {tag for tag, of in reader.tags if of.get("rel") != "icon"}
    assert "@import" not in page
    ids = reader.values("id")
    assert len(ids) == len(set(ids))
    inside = [link[1:] for link in links if link[0] == "#"] + re.findall(r"url\(#([^)]*)\)", page)
    assert set(inside) <= set(ids)


def test_the_same_results_give_the_same_bytes(tmp_path):
    first, second = (
        written(
            tmp_path, page_of("x", [FigureBox(figure, "", "") for figure in [*figures(*CASES["one"]).values()][::4]])
        )
        for _ in range(2)
    )
    assert first == second
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(("size", "share"), [(10, 9.5 / (10 * 4 / 3)), (6, 1.0)])
def test_a_figure_shrinks_until_its_smallest_text_is_hard_to_read(size, share):
    @drawn
    def figure() -> Figure:
        made = Figure(figsize=(4, 2))
        made.subplots().set_title("large", fontsize=20)
        for axes in made.axes:
            axes.tick_params(labelsize=size)
        return made

    least, most = (float(re.search(rf"{end}-width:(\d+)px", svg(figure()))[1]) for end in ("min", "max"))
    assert least / most == pytest.approx(share, abs=0.005)


def test_a_page_leaves_the_settings_of_other_figures_alone():
    before = dict(mpl.rcParams)
    svg(score_figure(scores(["gru"], False)))
    assert dict(mpl.rcParams) == before


def test_tables():
    assert Table(["a", "b", "c"], [["1", "2", "3"]]).align == "lrr"
    with pytest.raises(ValueError, match=r"`rows\[1\]` must have 2 cells, one a heading, got 3"):
        Table(["a", "b"], [["1", "2"], ["1", "2", "3"]])
    with pytest.raises(ValueError, match="`align` must be 2 letters l or r, got 'lx'"):
        Table(["a", "b"], [], align="lx")


def test_contents_settings_and_places(tmp_path):
    sections = [Section("one"), Section("two", tables=[Table(["a"], [["1"]])])]
    page = {"title": "t", "lead": "lead", "sections": sections, "settings": {"seed": 3}, "command": "eval x --y"}
    text = written(tmp_path, page)
    assert re.findall(r'<a href="#(.*?)">(.*?)</a>', text) == [("section-1", "one"), ("section-2", "two")]
    assert re.findall(r'<h2 id="(.*?)">', text) == ["section-1", "section-2"]
    assert re.search(r"<details.*eval x --y.*<dt>seed</dt><dd>3</dd>.*</details>", text, re.DOTALL)
    with pytest.raises(ValueError, match="a directory; the name of a file is expected"):
        write_page(tmp_path, **page)


def luminance(color: str) -> float:
    """Relative luminance (WCAG 2.2, definitions)."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(color)]
    return float(np.dot([0.2126, 0.7152, 0.0722], linear))


@pytest.mark.parametrize("paper", ["#ffffff", "#16181d"])
def test_lines_are_seen_on_light_and_dark_pages(paper):
    """At least 3 to 1, as graphics need (WCAG 2.2, 1.4.11)."""
    for color in [*KINDS.values(), *MARKOV, *SPARE, MORE, FEWER]:
        low, high = sorted([luminance(color) + 0.05, luminance(paper) + 0.05])
        assert high / low >= 3, color


def test_names_are_cut_in_the_middle():
    assert short("groom left forepaw while rearing", 15) == "groom lef…aring"
    assert short("a\n b\x00") == "a b\N{REPLACEMENT CHARACTER}"


def test_scores_stand_where_they_are():
    rows = scores(["gru", "markov-1", "markov-2", "transformer"], True)
    rows.loc[len(rows)] = ["uniform", "behaviours", 9.0, 9.0, 9.0]
    axes = score_figure(rows).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()][::-1] == list(rows["model"][::2])
    at = {(line.get_xdata()[0], line.get_marker()) for line in axes.lines if line.get_marker() in ("o", ">")}
    edge = 1 + 5 * (1.2 - 1)
    assert at == {(1.0, "o"), (1.1, "o"), (1.2, "o"), (1.3, "o"), (edge, ">")}
    spans = sorted(tuple(line.get_xdata()) for line in axes.lines if len(line.get_xdata()) == 2)
    assert spans == sorted(rows[:-1][["low", "high"]].itertuples(index=False, name=None))
    assert [text.get_text() for text in axes.texts][-1] == "1.000, 1.000"
    unknown = score_figure(scores(["this", "that"], False)).axes[0]
    assert [line.get_color() for line in unknown.lines if line.get_marker() == "o"] == SPARE[1::-1]


def test_lags_are_on_a_linear_axis_unless_they_span_decades():
    narrow = lag_figure(lags({"counts": [(1, 0.5, 0.4, 0.6), (2, 0.4, 0.3, 0.5)]}))
    wide = lag_figure(lags({"counts": [(1, 0.5, 0.4, 0.6), (2, -0.0001, -0.001, 0.001)]}))
    assert [figure.axes[0].get_yscale() for figure in (narrow, wide)] == ["linear", "symlog"]
    assert wide.axes[0].lines[0].get_xydata().tolist() == [[1, 0.5], [2, -0.0001]]
    low, high = wide.axes[0].get_ylim()
    assert low <= -0.001 < 0.6 <= high


def test_cells_hold_their_probabilities():
    probs = np.array([[0.25, 0.75], [np.nan, np.nan]])
    axes = transition_figure(probs, ["a", "b"], "t").axes[0]
    assert {(text.get_position(), text.get_text()) for text in axes.texts} == {((0, 0), "0.25"), ((1, 0), "0.75")}
    assert [patch.get_xy() for patch in axes.patches if patch.get_hatch()] == [(-0.5, 0.5)]
    opacity = axes.images[0].get_array()[..., 3]
    assert opacity[0, 1] > opacity[0, 0] > opacity[1, 0] == 0
    assert not transition_figure(matrix(MANY), MANY).axes[0].texts


def test_the_groups_that_differ_most_are_drawn():
    pooled = np.full((2, 2), 0.5)
    by_group = pooled + np.arange(30)[:, None, None] * np.array([[1, -1], [-1, 1]]) / 100
    significant = np.zeros_like(by_group, dtype=bool)
    significant[3, 0, 1] = True
    names = [f"g{n}" for n in range(30)]
    figure = group_transition_figure(by_group, pooled, ["a", "b"], names, significant)
    panels = [axes for axes in figure.axes if axes.get_title(loc="left")]
    assert [axes.get_title(loc="left") for axes in panels] == ["g3", *names[19:]]
    assert [axes.lines[0].get_xydata().tolist() for axes in panels] == [[[1, 0]]] + [[]] * 11
    assert "12 of 30 that differ most" in figure.get_suptitle()
    shown = panels[-1].images[0].get_array()
    assert [to_hex(shown[0, b, :3]) for b in (0, 1)] == [MORE, FEWER]
    with pytest.raises(ValueError, match="`group_names` must not be empty"):
        group_transition_figure(np.empty((0, 2, 2)), pooled, ["a", "b"], [], np.empty((0, 2, 2)))


@pytest.mark.parametrize("make", [score_figure, lag_figure, motif_figure])
def test_nothing_to_draw_is_an_error(make):
    with pytest.raises(ValueError, match="must not be empty"):
        make(pd.DataFrame())


def test_a_browser_shows_the_page_on_a_phone_and_a_desktop(page, tmp_path):
    check_in_browser(page, tmp_path)


def sessions(names: list[str], num: int = 6, length: int = 20, **more) -> Plans:
    """Two sessions each of animals in two conditions, which have these names, too."""
    generator = torch.Generator().manual_seed(0)
    actions = torch.randint(len(names), (num, length), generator=generator)
    group, called = torch.arange(num) // 2, [f"{names[0]} {i}" for i in range(num // 2)]
    own = {"group": group, "group_names": called, "condition": group % 2, "condition_names": ["x", names[-1]]}
    return RecordedPlans(actions, len(names), torch.arange(num) % 3 + length - 2, names, **own | more)


def strips(figure: Figure) -> tuple[np.ndarray, list[int]]:
    """The colours of the rows of an ethogram, one line of each, and how many blank lines are before each."""
    image = np.asarray(figure.axes[0].images[0].get_array())
    lines = np.flatnonzero(image[:, :, 3].any(1))
    tops = lines[np.diff(lines, prepend=-9) > 1]
    return image[tops], np.diff(np.append(-5, tops)).tolist()


def test_an_ethogram_has_the_actions_in_their_colours_by_condition_and_group():
    plans = sessions(["rest", "walk", "eat"])
    figure = ethogram_figure(plans)
    rows, before = strips(figure)
    order = [0, 1, 4, 5, 2, 3]  # animals 0 and 2 are in the first condition, animal 1 in the second
    assert len(rows) == 6
    for row, plan in zip(rows, order, strict=True):
        length = int(plans.lengths[plan])
        want = [to_hex(STRIPS[action]) for action in plans.actions[plan, :length]]
        assert [to_hex(color) for color in row[:length]] == want
        assert not row[length:, 3].any()
    assert before == [18, 5, 8, 5, 18, 5]
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["rest 0", "rest 2", "rest 1"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["x", "eat"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["rest", "walk", "eat"]


def test_parts_of_a_plan_are_in_one_row_of_an_ethogram():
    """In their order, not that of names, with a blank between them; plans of one name in two groups are two."""
    actions, group = torch.tensor([[0, 1], [1, 0], [0, 0], [1, 1]]), torch.tensor([0, 1, 0, 0])
    plans = RecordedPlans(actions, 2, torch.tensor([2, 2, 1, 2]), group=group, recording=["y", "y", "y", "x"])
    rows, _ = strips(ethogram_figure(plans))
    due = [[0, 1, None, 0], [1, 1, None, None], [1, 0, None, None]]
    shown = [[to_hex(color[:3]) if color[3] else None for color in row] for row in rows]
    assert shown == [[None if action is None else STRIPS[action] for action in row] for row in due]
    timed = RecordedPlans(actions, 2, plans.lengths, group=group, recording=plans.recording, durations=2.0 + actions)
    (first, *_), _ = strips(ethogram_figure(timed))  # 2, 3, a blank of 3 (the median), 2
    at = (np.arange(MOST_BINS) + 0.5) * 10 / MOST_BINS
    for low, high, action in ((0, 2, 0), (2, 5, 1), (5, 8, None), (8, 10, 0)):
        here = first[(at > low) & (at < high)]
        assert (here[:, 3] == (action is not None)).all()
        assert action is None or {to_hex(color) for color in here} == {STRIPS[action]}


def test_an_ethogram_of_durations_is_in_time():
    """Of durations 1, 3, unknown and 4, the third is blank for the median of the known ones, 3."""
    times = torch.tensor([[1.0, 3.0, float("nan"), 4.0]])
    plans = RecordedPlans(torch.tensor([[0, 1, 0, 2]]), 3, action_names=("a", "b", "c"), durations=times)
    (row,), _ = strips(ethogram_figure(plans))
    assert len(row) == MOST_BINS
    at = (np.arange(MOST_BINS) + 0.5) * 11 / MOST_BINS
    for low, high, action in ((0, 1, 0), (1, 4, 1), (4, 7, None), (7, 11, 2)):
        here = row[(at > low) & (at < high)]
        assert {to_hex(color) for color in here} == {"#000000" if action is None else STRIPS[action]}
        assert (here[:, 3] == (action is not None)).all()


def test_ethograms_of_much_and_of_little():
    many = ethogram_figure(sessions(MANY, 200, 3000))
    assert len(strips(many)[0]) == 60
    assert "60 of 200 sequences" in many.axes[0].get_xlabel()
    assert many.axes[0].images[0].get_array().shape[1] == MOST_BINS
    assert many.legends[0].get_texts()[-1].get_text() == f"{len(MANY) - len(STRIPS) + 1} other behaviours"
    assert many.get_figheight() < 30
    ends = Plans(torch.tensor([[0, 1], [1, 1]]), 2, torch.tensor([0, 2])).with_end()
    assert len(strips(ethogram_figure(ends))[0]) == 1
    with refuses("plans", "no figure"):
        ethogram_figure(Plans(torch.zeros(2, 0, dtype=torch.long), 2))


@pytest.mark.parametrize(
    ("text", "isolated"),
    [
        ("plain <b> 12", "plain &lt;b&gt; 12"),
        ("שלום 12 (3, אב גד)", "<bdi>שלום</bdi> 12 (3, <bdi>אב גד</bdi>)"),
        ("\u202e<i>x 7", "<bdi>\u202e&lt;i&gt;x</bdi> 7"),
    ],
)
def test_names_from_right_to_left_do_not_move_the_numbers_beside_them(text, isolated, tmp_path):
    section = Section(text, [text], [Table(["a", text], [[text, "1"]], text, title=text)], files=[f"{text}.csv"])
    write_page(tmp_path / "a.html", text, [text, text], [section], {"names": [text]}, text)
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    plain = html.escape(text).replace("&quot;", "&#34;")
    assert page.count(isolated) == 13 + 2 * (isolated == plain)  # neither in the title nor in an address
    assert f"<title>{plain}</title>" in page
    assert f'href="{plain}.csv"' in page
