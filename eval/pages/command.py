"""`python -m eval pages`: the commands of the pages of results, run one after the other."""

import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from neuroprior._files import written_whole
from neuroprior._folders import claim_out

DOCS = Path(__file__).parents[2] / "docs"

HOURS = {
    "paper": "0.3+",
    "mice": "0.7",
    "compare": "10.5",
    "planners": "0.7",
    "which-planner": "0.3",
    "puzzles": "1+",
    "modes": "0.2+",
    "options": "0.2",
    "intentions": "0.1",
    "control": "7.5+",
    "macro-actions": "2",
    "agents": "0.5",
    "quality": "2.1",
    "calibration": "1.2",
    "speed": "0.8+",
}
"""By page: the hours that it states, on one or two cores; + where it states them for some of its commands only."""


@claim_out
def pages(stages: Sequence[str] = tuple(HOURS), listing: bool = False, out: str = "runs/results") -> None:
    """Run what the pages of results show, page by page; what each command prints is kept in a file.

    Interrupted, the same command goes on: a command whose output is complete is not run again, and the others take up
    their own finished jobs. To run a command again, delete its file. Needs the packages of all extras.

    Args:
        stages: the pages, in this order.
        listing: list the commands, the hours that the pages state, and what is done already; run nothing.
        out: folder for `PAGE-NUMBER.txt`, what a command printed, and the folder `PAGE-NUMBER` of its files.
    """
    for name in set(stages) - set(HOURS):
        raise ValueError(f"`stages` must be some of {', '.join(HOURS)}, got {name}")
    folder = Path(out)
    steps = {name: commands(DOCS / f"{name}.md") for name in stages}
    for name, page_commands in steps.items():
        print(f"{name}: {HOURS[name]} hours, docs/{name}.md")
        if listing:
            for step, command in numbered(name, page_commands, folder).items():
                print(f"  {step}: {shlex.join(command)}{' (done)' if is_done(folder / f'{step}.txt', command) else ''}")
        else:
            perform(numbered(name, page_commands, folder), folder)


def commands(page: Path) -> list[list[str]]:
    """The words of the commands of this project in a page's console blocks."""
    text = page.read_text(encoding="utf-8")
    lines = "".join(re.findall(r"```console\n(.*?)```", text, re.DOTALL)).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True) for line in lines if re.match(r"neuroprior \w|python -m eval \w", line)]


def numbered(page: str, page_commands: Sequence[Sequence[str]], folder: Path) -> dict[str, list[str]]:
    """The commands of a page as `PAGE-NUMBER`, each with a folder of its own for its files."""
    steps = {}
    for number, words in enumerate(page_commands, 1):
        step, kept = f"{page}-{number}", list(words)
        if "--out" in kept:
            at = kept.index("--out")
            del kept[at : at + 2]
        steps[step] = [*kept, "--out", str(folder / step)]
    return steps


def perform(steps: Mapping[str, Sequence[str]], folder: Path) -> None:
    """Run commands that are not done, show what they print, and keep it.

    Args:
        steps: the words of each, by its name; `python` and `neuroprior` are those of this environment.
        folder: for a file for each.

    Raises:
        ValueError: a command failed.
    """
    programs = {"python": [sys.executable], "neuroprior": [sys.executable, "-m", "neuroprior"]}
    for name, words in steps.items():
        file = folder / f"{name}.txt"
        if is_done(file, words):
            print(f"{name}: done, {file}", flush=True)
            continue
        print(f"{name}: {shlex.join(words)}", flush=True)
        command, begin = [*programs[words[0]], *words[1:]], time.monotonic()
        environment = os.environ | {"COLUMNS": "160"}
        with (
            written_whole(file) as kept,
            subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process,
        ):
            kept.write(f"{shlex.join(words)}\n")
            assert process.stdout is not None
            for line in process.stdout:
                kept.write(line)
                print(line, end="", flush=True)
            if process.wait():
                raise ValueError(f"{name}: ended with {process.returncode}: {shlex.join(words)}")
            kept.write(f"took {time.monotonic() - begin:.0f} s\n")


def is_done(file: Path, words: Sequence[str]) -> bool:
    """Whether a file holds all that this very command printed."""
    return file.exists() and file.read_text(encoding="utf-8").partition("\n")[0] == shlex.join(words)
