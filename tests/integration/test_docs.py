"""The README and the pages of docs: examples run, commands have the options they are given, links lead somewhere."""

import csv
import importlib
import io
import json
import pkgutil
import re
import runpy
import shlex
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout, suppress
from functools import lru_cache
from pathlib import Path

import pytest

from neuroprior.behaviour import study
from neuroprior.cli.example import example

ROOT = Path(__file__).parents[2]
SITE = sorted(page for page in (ROOT / "docs").rglob("*.md") if "_build" not in page.parts)
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "train/README.md", *SITE]
OWN_DATA = ROOT / "docs/your-own-data.md"
OTHERS = ROOT / "docs/how-to/other-libraries.md"
PACKAGES = {"huggingface_hub", "imitation", "jax", "mctx", "pytorch_mppi", "sklearn", "tensordict", "torchrl"}
"""What examples of `OTHERS` need, and no extra installs for tests."""

PROGRAMS = {"neuroprior": "neuroprior.__main__", "eval": "eval.__main__"}


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def run(code: str, folder: Path) -> None:
    """Run a program in a folder; in this process, as libraries load for seconds."""
    (folder / "example.py").write_text(code, encoding="utf-8")
    with chdir(folder):
        runpy.run_path("example.py", run_name="__main__")


EXAMPLES = [
    pytest.param(page, number, id=f"{name(page)}-{number}", marks=[pytest.mark.slow] if "mctx" in block else [])
    for page in PAGES
    if page != OWN_DATA
    for number, block in enumerate(blocks(page, "python"))
]
"""Compiling mctx's search takes longer than all else."""


@pytest.mark.parametrize(("page", "number"), EXAMPLES)
def test_example(page: Path, number: int, tmp_path: Path) -> None:
    try:
        run(blocks(page, "python")[number], tmp_path)
    except ModuleNotFoundError as error:
        if page != OTHERS or error.name.partition(".")[0] not in PACKAGES:
            raise
        pytest.skip(f"needs {error.name}, which is not installed")


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report that the page on one's own data makes on the example study."""
    folder = tmp_path_factory.mktemp("docs")
    example(str(folder / "study.csv"))
    run("".join(blocks(OWN_DATA, "python")), folder)
    return folder / "runs/counts"


def rows(folder: Path, name: str) -> list[dict[str, str]]:
    with open(folder / f"{name}.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_order_that_was_put_in(report: Path) -> None:
    scores = json.loads((report / "results.json").read_text())["scores"]
    bits = {row["model"]: row["bits_per_behaviour"] for row in scores}
    assert min(bits, key=bits.__getitem__) == "context tree"
    assert min((name for name in bits if name.startswith("markov")), key=bits.__getitem__) == "markov-1"


def test_the_sequence_that_was_put_in(report: Path) -> None:
    first = rows(report, "motifs")[0]
    assert first["sequence"] == " ".join(study.RITUAL)
    assert float(first["low"]) > 1


def test_the_effects_that_were_put_in(report: Path) -> None:
    """Exactly the two transitions and the duration that the treatment changes are significant."""
    found = [row for row in rows(report, "conditions") if row["significant"] == "True"]
    before, loser, winner, _ = study.MOVED
    planted = {f"{before} → {loser}", f"{before} → {winner}", f"duration of {study.LONGER[0]}"}
    assert {row["feature"] for row in found if row["family"] in ("transitions", "durations")} == planted


def test_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 110


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", SITE, ids=name)
def test_what_a_page_includes_is_there(page: Path) -> None:
    for include in re.findall(r"^```\{include\} (.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        file, *options = include.splitlines()
        text = (page.parent / file).read_text(encoding="utf-8")
        for marker in (
            option.split(": ", 1)[1].strip('"') for option in options if "start-" in option or "end-" in option
        ):
            assert marker in text, marker


def test_every_picture_is_shown() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert not [path.name for path in (ROOT / "docs").glob("*.png") if f"{path.name})" not in text]


def test_every_page_is_listed() -> None:
    """In a table of contents of the site."""
    listed = {ROOT / "docs/index.md"}
    for page in SITE:
        for block in blocks(page, "{toctree}"):
            listed |= {
                (page.parent / f"{line}.md").resolve()
                for line in block.splitlines()
                if line[:1].isalnum() or line[:1] == "."
            }
    assert set(SITE) <= listed


def exists(dotted: str) -> bool:
    """Whether a name can be imported, or is a method of something that can."""
    try:
        return pkgutil.resolve_name(dotted) is not None
    except (AttributeError, ImportError):
        return False


def test_names_exist() -> None:
    """Those that are written as `neuroprior.module.name`."""
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert not [dotted for dotted in sorted(set(re.findall(r"`(neuroprior[.\w]+)[(`]", text))) if not exists(dotted)]


def commands() -> Iterator[tuple[str, str]]:
    """The commands of all pages, each with its page."""
    for page in PAGES:
        for block in blocks(page, "console") + blocks(page, ""):
            for line in block.replace("\\\n", " ").splitlines():
                yield name(page), line.removeprefix("$ ").removeprefix(".venv/bin/")


def given() -> Iterator[tuple[str, str, str, list[str]]]:
    """Page, program, command and arguments of each command of this project."""
    for page, line in commands():
        if not re.match(r"neuroprior \w|python -m (eval|train) \w", line):
            continue
        words = shlex.split(line, comments=True)
        if words[0] == "python":
            words = ["neuroprior" if words[2] == "train" else words[2], *words[3:]]
        yield page, words[0], words[1], words[2:]


@lru_cache
def known(program: str, command: str) -> set[str]:
    """The options of a command, by what it says itself."""
    printed = io.StringIO()
    with redirect_stdout(printed), suppress(SystemExit):
        importlib.import_module(PROGRAMS[program]).main([command, "--help"])
    return {option.replace("-", "_") for option in re.findall(r"(?<!\w)--([\w.\-]+)", printed.getvalue())}


def test_commands_have_these_options() -> None:
    asked = list(given())
    assert len(asked) > 20
    for page, program, command, arguments in asked:
        options = known(program, command)
        for word in arguments:
            if not word.startswith("--"):
                continue
            option = word[2:].partition("=")[0].replace("-", "_")
            # what a class in a recipe takes, such as --prior.dropout, is listed under the class alone
            parents = {option, option.rpartition(".")[0]} - {""}
            assert parents & options, f"{page}: {program} {command} has no option --{option}"


def test_make_has_these_targets() -> None:
    targets = set(re.findall(r"^([\w.%/\-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    asked = {line.split()[1] for _, line in commands() if line.startswith("make ")}
    assert asked
    assert not [target for target in asked if target not in targets and re.sub("/.*", "/%", target) not in targets]
