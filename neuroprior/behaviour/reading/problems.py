"""Problems of files: all of one run, each with its first rows and their number; lists of names for messages."""

from collections.abc import Callable, Sequence

SHOWN_ROWS = 3
"""Rows at most that a problem names; the others are counted."""

Place = Callable[[int], str]
"""Where a row stands, by its position: "study.csv, line 7"."""


class ReadingError(ValueError):
    """Files that cannot be read as recordings.

    Attributes:
        problems: a line each; the message joins them.

    Example:
        >>> ReadingError(["a.csv: the file must hold a table", "b.csv: the file must hold a table"]).problems[1]
        'b.csv: the file must hold a table'
    """

    def __init__(self, problems: str | Sequence[str]) -> None:
        self.problems = (problems,) if isinstance(problems, str) else tuple(problems)
        super().__init__("; ".join(self.problems))


class Problems:
    """Collects problems, so that a user sees all of them at once.

    Example:
        >>> problems = Problems()
        >>> problems.add("start 'soon' is no time", [3, 8], "study.csv, line {}".format)
        >>> problems.lines
        ["study.csv, line 3: start 'soon' is no time (2 rows: 3, 8)"]
    """

    def __init__(self) -> None:
        self.lines: list[str] = []

    def add(self, what: str, rows: Sequence[int], place: Place) -> None:
        """Add a problem that some rows have.

        Args:
            what: what is wrong in the first row, what it holds and what to do.
            rows: positions of all such rows, in order; at least one.
            place: where a row stands.
        """
        others = ""
        if len(rows) > 1:
            numbers = ", ".join(place(int(row)).rpartition(" ")[2] for row in rows[:SHOWN_ROWS])
            others = f" ({len(rows):,} rows: {numbers}{', ...' if len(rows) > SHOWN_ROWS else ''})"
        self.lines.append(f"{place(int(rows[0]))}: {what}{others}")

    def stop(self) -> None:
        """Raise ReadingError if there are problems."""
        if self.lines:
            raise ReadingError(self.lines)
