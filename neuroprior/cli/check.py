"""`neuroprior check`: shows what files of behaviour are read as, before anything is computed."""

import shlex

from rich.console import Console

from neuroprior.behaviour.reading import Options, ReadingError
from neuroprior.behaviour.reading.read import read_recordings
from neuroprior.behaviour.summary import describe
from neuroprior.cli.reading import reading_words


def check(files: list[str], reading: Options = Options()) -> None:  # noqa: B008
    """Show what files of behaviour are read as: columns, behaviours, subjects, gaps, and everything that is wrong.

    Args:
        files: tables of events, frames or sequences, folders or globs, of one study.
        reading: how they are read.

    Raises:
        ValueError: the files cannot be read; each problem is printed before.
    """
    console = Console(soft_wrap=True, highlight=False, markup=False, emoji=False)
    try:
        recordings = read_recordings(files, reading)
    except ReadingError as error:
        for problem in error.problems:
            console.print(f"problem: {problem}")
        raise ValueError(f"nothing is read, because of {len(error.problems)} problems") from None
    for line in describe(recordings):
        console.print(line)
    words = [*files, *reading_words(reading)]
    console.print(f"\nnext: neuroprior report {shlex.join(words)}")
