"""The site: it builds without a warning, links lead somewhere, pages are well formed, and search finds words."""

import json
import re
import subprocess
import sys
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

import neuroprior

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site, its notebooks executed."""
    pytest.importorskip("myst_nb")
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "sphinx", "-b", "html", "-q", "-n", "-W", "--keep-going"]
    done = subprocess.run([*build, "docs", str(folder)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@dataclass
class Page(HTMLParser):
    """What a page holds: the targets of links, files that it loads, pictures, levels of headings, and anchors."""

    text: str
    links: list[str] = field(default_factory=list)
    loaded: list[str] = field(default_factory=list)
    pictures: list[dict[str, str | None]] = field(default_factory=list)
    headings: list[int] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        super().__init__()
        self.feed(self.text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if values.get("id"):
            self.anchors.add(str(values["id"]))
        if tag == "a" and values.get("href"):
            self.links.append(str(values["href"]))
        if tag == "script" and values.get("src"):
            self.loaded.append(str(values["src"]))
        if tag == "link" and values.get("rel") == "stylesheet":
            self.loaded.append(str(values["href"]))
        if tag == "img":
            self.pictures.append(values)
            self.loaded.append(str(values["src"]))
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    found = {path: Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}
    return {path: page for path, page in found.items() if "_static" not in path.parts}


def at(page: Path, link: str) -> Path:
    return (page.parent / unquote(re.split("[?#]", link)[0])).resolve() if re.split("[?#]", link)[0] else page


def test_links_lead_somewhere(pages: dict[Path, Page]) -> None:
    lost = []
    for path, page in pages.items():
        for link in page.links:
            if re.match(r"https?:|mailto:", link):
                continue
            target, anchor = at(path, link), unquote(link.partition("#")[2])
            known = target in pages and (not anchor or anchor in pages[target].anchors)
            if not known and (target in pages or not target.exists()):
                lost.append(f"{path.name}: {link}")
    assert not lost


def test_nothing_is_fetched(pages: dict[Path, Page]) -> None:
    loaded = {(path, link) for path, page in pages.items() for link in page.loaded}
    assert not [f"{path.name}: {link}" for path, link in loaded if not at(path, link).exists()]


def test_pictures_are_described(pages: dict[Path, Page]) -> None:
    bare = [f"{path.name}: {one['src']}" for path, page in pages.items() for one in page.pictures if not one.get("alt")]
    assert not bare


def test_headings_are_in_order(pages: dict[Path, Page]) -> None:
    """One first heading, and no level left out on the way down."""
    for path, page in pages.items():
        assert page.headings.count(1) == 1, path.name
        steps = zip(page.headings, page.headings[1:], strict=False)
        assert not [step for step in steps if step[1] > step[0] + 1], path.name


def test_every_public_name_has_a_page(pages: dict[Path, Page]) -> None:
    anchors = set().union(*(page.anchors for page in pages.values()))
    described = {anchor.rpartition(".")[2] for anchor in anchors if anchor.startswith("neuroprior.")}
    assert set(neuroprior.__all__) - {"__version__"} <= described


def test_notebooks_show_results(site: Path) -> None:
    for name in ("own-behaviour", "prior-in-your-planner", "sokoban", "hidden-intentions"):
        text = (site / f"tutorials/{name}.html").read_text(encoding="utf-8")
        assert "cell_output" in text
        assert re.search(r"<img [^>]*_images/", text), name


@pytest.mark.parametrize(
    ("word", "page"),
    [
        ("reroot", "puzzles"),
        ("sokoban", "tutorials/sokoban"),
        ("levinplann", "api/names/neuroprior.puzzles.LevinPlanner"),
    ],
)
def test_search_finds_words(site: Path, word: str, page: str) -> None:
    """In the index that the search of the site reads, whose words are stems."""
    text = (site / "searchindex.js").read_text(encoding="utf-8")
    index = json.loads(text.removeprefix("Search.setIndex(").removesuffix(")"))
    found = [index[where].get(word, []) for where in ("terms", "titleterms")]
    numbers = [number for one in found for number in (one if isinstance(one, list) else [one])]
    assert page in [index["docnames"][number] for number in numbers]
