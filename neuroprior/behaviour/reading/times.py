"""Times in texts: numbers, times of day, dates and durations, in the unit of the column or in seconds."""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neuroprior.behaviour.reading.names import TIME_UNITS
from neuroprior.behaviour.reading.problems import Place, Problems

Floats = NDArray[np.float64]

CLOCK = r"(-?)(?:(\d+):)?(\d+):(\d+(?:[.,]\d*)?)(?: ?([AaPp])[Mm])?"
DAYS = r"(-?\d+) days?,? ?(?:\+?(\d+):(\d+):(\d+(?:\.\d*)?))?"
YEAR_FIRST = r"\d{4}([-/.])\d{1,2}\1\d{1,2}(?:[T ]\S.*)?"
YEAR_LAST = r"(\d{1,2})[-/. ](\d{1,2})[-/. ](\d{4}|\d{2})(?:[T, ]+(\S.*))?"
HOUR = r"^(\S+[T ])(\d{1,2})((?::\d+)+(?:\.\d*)?)(?: ?([AaPp])\.?[Mm]\.?)?$"
"""A date, an hour, what follows, and the half of the day."""

MISSING_TIMES = ("", "na", "nan", "n/a", "null", "none", "nat", "-", "<na>", "?", "n.a.")
THOUSANDS = r"-?\d{1,3}(,\d{3})+(\.\d*)?"

NUMBERS, CLOCKS, DATES = "numbers", "times of day", "dates"

DAY = 86400.0
"""Seconds."""

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0}
"""Seconds of the units of time that can be converted."""

MAX_SAMPLE = 2_000
"""Texts at most by which a column is judged to hold times."""


class Times(NamedTuple):
    """The times of a column.

    Attributes:
        values: float64 `[rows]`, NaN where there is none.
        kind: NUMBERS (in the unit of the column), CLOCKS or DATES (both in seconds).
    """

    values: Floats
    kind: str


class _Texts(NamedTuple):
    """The different texts of a column, and where complaints about them go."""

    codes: NDArray[np.int64]
    unique: NDArray[Any]
    use: str
    place: Place
    problems: Problems

    def complain(self, wrong: Any, right: str) -> None:
        """Add a problem for the rows whose text is `wrong`, bool `[unique]`; `right` says what it must be."""
        rows = np.flatnonzero(np.asarray(wrong, bool)[self.codes])
        if rows.size:
            text = self.unique[self.codes[rows[0]]]
            self.problems.add(f"`{self.use}` must be {right}, got {text!r}", rows.tolist(), self.place)


def read_times(
    texts: Sequence[str] | NDArray[Any],
    use: str,
    place: Place,
    problems: Problems,
    *,
    separator: str = "",
    day_first: bool | None = None,
) -> Times:
    """Return the times of a column of texts; texts that are no time are added to the problems.

    Args:
        texts: `[rows]`, without space at their ends.
        use: what they are, for messages.
        place: where a row stands.
        problems: receives a line for each kind of text that is no time.
        separator: between the cells of the file; where it is a comma, no decimal mark is one.
        day_first: whether 1/2/2024 is the first of February; None: as the other dates of the column tell.
    """
    codes, unique = pd.factorize(np.asarray(texts, dtype=object))
    column = _Texts(codes, unique, use, place, problems)
    words = pd.Series(unique, dtype=object)
    missing = words.str.lower().isin(MISSING_TIMES)
    numbers = pd.to_numeric(words.where(~missing), errors="coerce")
    words, numbers = _drop_thousands(words, numbers, missing, separator)
    commas = words[numbers.isna() & ~missing]
    if len(commas) and commas.str.fullmatch(r"-?\d*,\d+").all():
        if separator == "," and commas.str.fullmatch(THOUSANDS).all():
            column.complain(~missing & numbers.isna(), "a number without thousands' commas")
            return Times(numbers.to_numpy(np.float64)[codes], NUMBERS)
        numbers = pd.to_numeric(words.where(~missing).str.replace(",", ".", regex=False), errors="coerce")
    good = numbers.notna() & np.isfinite(numbers.to_numpy(np.float64))
    wrong = ~good & ~missing
    if not wrong.any() or good.sum() > wrong.sum():
        column.complain(wrong, "a number")
        return Times(numbers.where(good).to_numpy(np.float64)[codes], NUMBERS)
    texts_or_empty = words.where(~missing, "")
    seconds = _clock_seconds(texts_or_empty, column)
    if seconds is not None:
        return Times(seconds[codes], CLOCKS)
    return Times(_date_seconds(texts_or_empty, column, day_first)[codes], DATES)


def _drop_thousands(words: Any, numbers: Any, missing: Any, separator: str) -> tuple[Any, Any]:
    """Return texts and numbers without the marks between thousands, where these cannot be decimal marks."""
    rest = words[numbers.isna() & ~missing]
    if len(rest) and rest.str.fullmatch(r"-?\d{1,3}(,\d{3})+\.\d+").any() and rest.str.fullmatch(THOUSANDS).all():
        words = words.str.replace(",", "", regex=False)
    elif len(rest) and separator != "," and rest.str.fullmatch(r"-?\d{1,3}(\.\d{3})+,\d+").any():
        if not rest.str.fullmatch(r"-?(\d{1,3}(\.\d{3})+|\d+)(,\d+)?").all():
            return words, numbers
        words = words.str.replace(".", "", regex=False).str.replace(",", ".", regex=False)
    else:
        return words, numbers
    return words, pd.to_numeric(words.where(~missing), errors="coerce")


def count_times(texts: NDArray[Any]) -> tuple[int, int, int]:
    """Return how many texts are times of any kind, how many have a digit, and how many are not empty.

    Looks at the first `MAX_SAMPLE` different texts.
    """
    words = pd.Series(pd.unique(np.asarray(texts, dtype=object))[:MAX_SAMPLE], dtype=object)
    words = words[~words.str.lower().isin(MISSING_TIMES)]
    number = pd.to_numeric(words.str.replace(",", ".", regex=False), errors="coerce").notna()
    other = words.str.fullmatch(f"{CLOCK}|{DAYS}|{YEAR_LAST}") | words.str.fullmatch(YEAR_FIRST)
    return int((number | other).sum()), int(words.str.contains(r"\d").sum()), len(words)


def _clock_seconds(texts: Any, column: _Texts) -> Floats | None:
    """Return the seconds of h:m:s, m:s and "1 days 00:00:01"; None where most texts are something else.

    Two numbers are minutes and seconds where one of the column has a fraction, or is beyond the hours of a day.
    """
    filled = texts != ""
    days = texts.str.extract(f"^{DAYS}$")
    parts = texts.str.extract(f"^{CLOCK}$")
    with_days, clock = days[0].notna(), parts[2].notna()
    if (with_days | clock).sum() * 2 <= filled.sum():
        return None
    sign = np.where(parts[0] == "-", -1.0, 1.0)
    hours, minutes, seconds = (parts[i].str.replace(",", ".").astype(float) for i in (1, 2, 3))
    half = parts[4].str.lower()
    to_the_minute = hours.isna() & half.notna()  # such as 8:30 pm
    hours, minutes = hours.where(~to_the_minute, minutes), minutes.where(~to_the_minute, seconds)
    seconds = seconds.where(~to_the_minute, 0.0)
    two = hours.isna() & clock
    if two.any() and not (parts[3][two].str.contains("[.,]") | (minutes[two] > 23)).any():
        right = "a time as h:m:s; two numbers may be hours and minutes, or minutes and seconds"
        column.complain(two, right)
    hours = hours.where(half.isna(), hours % 12 + 12 * (half == "p"))
    values = sign * (3600 * hours.fillna(0) + 60 * minutes + seconds)
    values = values.where((seconds < 60) & (hours.isna() | (minutes < 60)))
    whole = days.astype(float).fillna(0)
    values = values.where(~with_days, DAY * whole[0] + 3600 * whole[1] + 60 * whole[2] + whole[3])
    column.complain(filled & values.isna(), "a time as h:m:s with minutes and seconds below 60")
    return np.asarray(values, np.float64)


def _date_seconds(texts: Any, column: _Texts, day_first: bool | None) -> Floats:
    """Return seconds since 1970; all dates without a time zone are taken to be in one zone."""
    filled = texts != ""
    parts = texts.str.extract(f"^{YEAR_LAST}$")
    last = parts[0].notna()
    if last.any():
        first, second = parts[0][last].astype(float), parts[1][last].astype(float)
        if day_first is None:
            if first.max() <= 12 and second.max() <= 12 and bool((first != second).any()):
                right = "a date whose day can be told from its month; say --day_first true or false"
                column.complain(last, right)
            day_first = bool(first.max() > 12 or second.max() <= 12)
        day, month = (parts[0], parts[1]) if day_first else (parts[1], parts[0])
        year = parts[2].where(parts[2].str.len() == 4, "20" + parts[2])
        iso = year + "-" + month.str.zfill(2) + "-" + day.str.zfill(2) + " " + parts[3].fillna("00:00")
        texts = texts.where(~last, iso)
    normal = texts.str.replace(
        r"^(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})", lambda m: f"{m[1]}-{m[2]:0>2}-{m[3]:0>2}", regex=True
    )
    normal = normal.str.replace(r"(:\d+),(\d+)", r"\1.\2", regex=True)
    normal = normal.str.replace(HOUR, lambda m: f"{m[1]}{_hour(int(m[2]), m[4]):02}{m[3]}", regex=True)
    dates = pd.to_datetime(normal.where(filled), format="ISO8601", utc=True, errors="coerce")
    column.complain(filled & dates.isna(), "a time: a number, h:m:s or a date as year-month-day")
    return np.asarray((dates - pd.Timestamp(0, tz="UTC")).dt.total_seconds(), np.float64)


def _hour(hour: int, half: str | None) -> int:
    """Return the hour of a day in which halves of it may be counted: 12 pm is noon."""
    return hour if half is None else hour % 12 + 12 * (half.lower() == "p")


def over_midnight(values: Floats, unit: NDArray[np.int64]) -> tuple[Floats, int]:
    """Return times of day counted on over midnight, and the number of midnights.

    Where a time is more than half a day before the one above it of the same recording, a new day has begun.

    Args:
        values: float64 `[rows]`, seconds; NaN for none.
        unit: int `[rows]`, which recording each is of; the rows of one need not stand together.
    """
    series = pd.Series(values)
    before = series.groupby(unit).transform(lambda one: one.ffill().shift())
    new = (series - before < -DAY / 2).to_numpy()
    days = pd.Series(new).groupby(unit).cumsum().to_numpy(np.float64)
    return values + DAY * days, int(new.sum())


def smallest_unit(texts: NDArray[Any]) -> float:
    """Return the unit in which numbers are written: 0.01 where some have two decimals, 1 where all are whole."""
    words = pd.Series(pd.unique(np.asarray(texts, dtype=object)), dtype=object)
    decimals = words.str.extract(r"[.,](\d+)$")[0].dropna().str.rstrip("0").str.len()
    return float(10.0 ** -(int(decimals.max()) if len(decimals) else 0))


def unit_of_name(name: str) -> str:
    """Return the unit of time that the name of a column says; "" for none."""
    low = name.lower()
    if "frame" in low or "image" in low:
        return "frames"
    words = low.replace("_", " ")
    return next((unit for unit, names in TIME_UNITS.items() if re.search(rf"\b({names})\b", words)), "")
