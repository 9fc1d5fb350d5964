"""Read recordings from files of laboratories."""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations, islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neuroprior._files import MISSING_LABELS
from neuroprior.behaviour.reading.columns import NOT_USED, Columns, find_roles
from neuroprior.behaviour.reading.frames import melt_subjects
from neuroprior.behaviour.reading.layouts import LAYOUTS
from neuroprior.behaviour.reading.names import NAMES, plain
from neuroprior.behaviour.reading.options import Options
from neuroprior.behaviour.reading.problems import Problems, ReadingError
from neuroprior.behaviour.reading.sheets import Sheet, find_files, read_sheets, sheet_of_frame
from neuroprior.behaviour.reading.table import JOIN, MAX_OVERLAP, Part, Table, overlapping
from neuroprior.behaviour.reading.times import SECONDS
from neuroprior.behaviour.recordings import KEYS, Recordings, Source, near_names

MIN_EVENTS, MAX_SHARE_OF_LABELS = 20, 0.5
"""Events at least, of which this share at most may have a label of their own: what never recurs is no behaviour."""

MIN_SHARE_OF_SHEET = 0.2
"""Of the events of the largest sheet of a workbook, at least, which the sheet has that is read."""

MIN_TWIN_EVENTS, MIN_TWIN_SHARE = 4, 0.6
"""Events of two recordings, and the share of them at the same time, at least which two observers may have scored."""

MAX_TWIN_PAIRS, MAX_TWIN_NOTES = 300, 5
"""Pairs of recordings that are compared, and notes on them, at most."""


def read(paths: Any, columns: Columns | Mapping[str, Any] | None = None, **options: Any) -> Recordings:
    """Read recordings: events in real time, of one study.

    Columns, layout, separators and encodings are recognised, and the notes say as what. Exports of BORIS, Observer,
    EthoVision, SimBA, DeepEthogram, Solomon Coder, keypoint-MoSeq, Audacity, Raven, crowsetta, TraMineR and XES need no
    options.

    Args:
        paths: a file, a folder, a glob, a pandas frame, or a list of these. Text (any separator, UTF-8, UTF-16,
            Windows-1252), JSON and .npy, also in .gz and .zip; .xlsx, .xls, .ods, .parquet and .feather need
            `pip install 'neuroprior[tables]'`.
        columns: what columns hold: `Columns`, or a dict of some of its attributes.
        options: how files are read, see `neuroprior.behaviour.reading.Options`.

    Returns:
        The recordings; the command `neuroprior check` shows them.

    Raises:
        ReadingError: a ValueError; its `problems` are all that is wrong, a line each with file, row and what to do.
        FileNotFoundError: there is no such file.

    Example:
        >>> import pandas as pd
        >>> table = pd.DataFrame(
        ...     {"animal": ["m1", "m1"], "behaviour": ["rest", "walk"], "start": [0, 5], "stop": [5, 7]}
        ... )
        >>> read(table).events["stop"].tolist()
        [5.0, 7.0]
    """
    return read_recordings(paths, Options(columns=columns, **options))


def read_recordings(paths: Any, options: Options) -> Recordings:
    """Read recordings with options; see `read`."""
    assert isinstance(options.columns, Columns)
    wanted = _words_of_columns(options.columns)
    if isinstance(paths, pd.Series):
        raise ValueError("`paths` must be files, folders or pandas frames, got a Series; give series.to_frame()")
    is_one = isinstance(paths, str | pd.DataFrame) or not hasattr(paths, "__iter__")
    groups: list[list[Sheet]] = []
    files: list[Path] = []
    groups_of_files: list[list[Sheet]] = []
    for number, item in enumerate([paths] if is_one else paths):
        if isinstance(item, pd.DataFrame):
            name = "table" if is_one else f"table {number + 1}"
            groups.append([sheet_of_frame(item, name, name)])
        elif hasattr(item, "__fspath__") or isinstance(item, str):
            new = [file for file in find_files(item) if file not in files]
            files += new
            groups_of_files += [read_sheets(file, wanted) for file in new]
            groups += groups_of_files[-len(new) :] if new else []
        else:
            raise ValueError(f"`paths` must be files, folders or pandas frames, got {type(item).__name__}")
    if not groups:
        raise ValueError("`paths` must be at least one file, got none")
    _tell_stems_apart(groups_of_files, files)
    results = [_read_file(sheets, options) for sheets in groups]
    if problems := [problem for _, _, problems in results for problem in problems]:
        raise ReadingError(problems)
    readings = [reading for readings, _, _ in results for reading in readings]
    return _combine(readings, [note for _, notes, _ in results for note in notes], options)


def _tell_stems_apart(groups: list[list[Sheet]], files: list[Path]) -> None:
    """Put folders before the stems of files that are the same elsewhere, and the workbook before those of sheets."""
    if len(files) < 2:
        return
    count = Counter(stem for sheets in groups for stem in {sheet.stem for sheet in sheets})
    folder = Path(os.path.commonpath([file.absolute().parent for file in files]))
    places = [file.absolute().relative_to(folder) for file in files]
    stems = [str(place.with_suffix("")) for place in places]
    for sheets, place, stem in zip(groups, places, stems, strict=True):
        before = stem if stems.count(stem) == 1 else str(place)
        for sheet in sheets:
            if count[sheet.stem] > 1:
                sheet.stem = before if len(sheets) == 1 else f"{before}/{sheet.stem}"


def _words_of_columns(columns: Columns) -> list[str]:
    """Return all names of columns, those in ranges and lists one by one as well."""
    words: list[str] = []
    for names in columns.named().values():
        for name in names:
            words += [name, *name.split(","), *name.split(":")] if name != NOT_USED else []
    return words


def _read_file(sheets: list[Sheet], options: Options) -> tuple[list[Part], list[str], list[str]]:
    """Return the parts, notes and problems of a file; of a workbook, those of the sheets with the columns of one.

    It is the first that has not far fewer events than another, as a legend before the events has.
    """
    parts: list[tuple[set[str], Part]] = []
    failed: list[tuple[set[str], str, Sequence[str]]] = []
    for sheet in sheets:
        columns = set(sheet.frame.columns)
        try:
            parts.append((columns, _read_sheet(sheet, options)))
        except ReadingError as error:
            failed.append((columns, sheet.name, error.problems))
    if not parts or not sheets[0].of_workbook:
        return [part for _, part in parts], [], [problem for _, _, problems in failed for problem in problems]
    most = max(len(part.events) for _, part in parts)
    chosen = next(columns for columns, part in parts if len(part.events) >= MIN_SHARE_OF_SHEET * most)
    unread = [part.sheet.name for columns, part in parts if columns != chosen]
    unread += [name for columns, name, _ in failed if columns != chosen]
    problems = [problem for columns, _, of_sheet in failed if columns == chosen for problem in of_sheet]
    kept = [part for columns, part in parts if columns == chosen]
    return kept, [f"{', '.join(unread)}: not read, since the columns are others"] if unread else [], problems


def _read_sheet(sheet: Sheet, options: Options) -> Part:
    assert isinstance(options.columns, Columns)
    roles = find_roles(sheet, options.columns, options.words)
    if roles.layout == "columns of subjects":
        sheet, roles = melt_subjects(sheet, roles)
    problems = Problems()
    table = Table(sheet, roles, options, problems)
    if not table.size:
        events = pd.DataFrame({name: [] for name in ("recording", "subject", "behaviour")}, dtype=object)
        events = events.assign(start=np.array([], float), stop=np.array([], float))
        nothing, note = np.array([], np.int64), f"{sheet.name} has no rows"
        return Part(sheet, roles, events, nothing, nothing, first_notes=[note], empty=[sheet.stem])
    if options.overlaps == "join" and roles.layout != "columns of behaviours":
        problems.add(f"`overlaps` must be error or keep in {roles.layout}, got 'join'", [0], table.place)
    reading = LAYOUTS[roles.layout](table)
    _check_observers(table, reading, problems)
    _check_factors(reading, problems)
    problems.stop()
    if roles.layout != "columns of behaviours":  # which has said so of its rows
        _note_overlaps(table, reading)
    return reading


def _note_overlaps(table: Table, reading: Part) -> None:
    """Note that bouts begin before those of other behaviours have ended."""
    labelled = np.flatnonzero(reading.events["behaviour"] != "")
    late, number = _overlapping_rows(reading.events.iloc[labelled], (*KEYS, "observer"))
    if late.size:
        where = table.place(int(reading.rows[labelled[late.min()]]))
        what = f"{late.size:,} of {number:,} bouts begin before another one has ended (first in {where})"
        reading.first_notes.append(f"{what}: shares of time add up to more than 100 %")


def _check_observers(table: Table, reading: Part, problems: Problems) -> None:
    """Refuse events that two people scored, and overlapping bouts of one behaviour of one subject."""
    if "observer" in table.roles.at and "observer" in table.roles.inferred:
        pairs = pd.DataFrame({"recording": table.recording, "subject": table.subject, "observer": table.observer})
        several = pairs.groupby(KEYS, sort=False)["observer"].nunique()
        name = table.roles.at["observer"][0]
        del table.roles.at["observer"]
        reading.events = reading.events.drop(columns="observer")
        if (several > 1).any():
            recording, subject = several.index[int(several.to_numpy().argmax())]
            row = int(np.flatnonzero((pairs["recording"] == recording) & (pairs["subject"] == subject))[0])
            what = f"recording {recording!r} was scored by {several.max()} observers"
            way = f"say --columns.observer {name!r} to keep them apart, or read the file of one"
            problems.add(f"{what}; {way}", [row], table.place)
            return
    share, row = _overlap_share(reading.events)
    if share <= MAX_OVERLAP or table.options.overlaps == "keep":
        return
    way = "if two people scored, read the file of one; --overlaps keep reads them as they are"
    if separating := _separating_column(table, reading):
        use = f"--columns.observer {separating!r}, or --columns.subject {separating!r}"
        if plain(separating).startswith("modifier"):
            use = f"--columns.behaviour '{','.join([*reading.roles.at['behaviour'], separating])}'"
        elif plain(separating) in (*NAMES["recording"], *NAMES["factors"], *NAMES["date"]):
            use = f"--columns.recording '{','.join([*reading.roles.at.get('recording', []), separating])}'"
        way = f"the column {separating!r} keeps them apart ({use})"
    event = reading.events.iloc[row]
    what = f"{share:.0%} of the bouts overlap another of the same subject and behaviour, such as {event['behaviour']!r}"
    problems.add(f"{what}; {way}", [int(reading.rows[row])], table.place)


def _overlap_share(events: pd.DataFrame) -> tuple[float, int]:
    """Return the share of bouts that begin before one of the same behaviour ended, and the row of the first."""
    late, number = _overlapping_rows(events, (*KEYS, "observer", "behaviour"))
    return (late.size / number, int(late[0])) if late.size else (0.0, 0)


def _overlapping_rows(events: pd.DataFrame, columns: Sequence[str]) -> tuple[NDArray[np.int64], int]:
    """Return the rows of bouts that begin before one alike in `columns` ended, and how many bouts take time."""
    timed = np.flatnonzero(events["stop"] > events["start"])
    bouts = events.iloc[timed]
    unit = np.asarray(bouts.groupby([name for name in columns if name in bouts], sort=False).ngroup(), np.int64)
    return timed[overlapping(unit, *(bouts[end].to_numpy(float) for end in ("start", "stop")))], timed.size


def _separating_column(table: Table, reading: Part) -> str | None:
    """Return an unused column whose values tell overlapping bouts apart; None for none."""
    used = table.roles.used()
    free = [name for name in table.frame if name not in used and 1 < table.frame[name].nunique() <= 20]
    likely = [name for name in free if plain(name) in NAMES["observer"]]
    for name in dict.fromkeys([*likely, *free]):
        subject = reading.events["subject"] + JOIN + table.frame[name].to_numpy(object)[reading.rows]
        events = reading.events.assign(subject=subject)
        if _overlap_share(events)[0] <= MAX_OVERLAP / 5:
            return str(name)
    return None


def _check_factors(reading: Part, problems: Problems) -> None:
    """Leave out factors that vary within a recording; refuse them where a user named them."""
    for name in list(reading.roles.at.get("factors", [])):
        first = reading.events.groupby(KEYS, sort=False)[name].transform("first")
        varying = np.flatnonzero((reading.events[name] != first).to_numpy())
        if not varying.size:
            continue
        values = f"{reading.events[name].iloc[varying[0]]!r} beside {first.iloc[varying[0]]!r}"
        if "factors" in reading.roles.inferred:
            reading.events = reading.events.drop(columns=name)
            reading.roles.at["factors"].remove(name)
            where = reading.sheet.place(int(reading.rows[varying[0]]))
            what = f"the column {name!r} varies within recordings, and is not used as a factor"
            reading.first_notes.append(f"{what} (first in {where}: {values})")
        else:
            what = f"the factor {name!r} must not vary within a recording, got {values}"
            problems.add(what, reading.rows[varying].tolist(), reading.sheet.place)


def _combine(readings: list[Part], notes: list[str], options: Options) -> Recordings:
    """Return the recordings of all sheets, as the options say."""
    filled = [reading for reading in readings if len(reading.events)]
    if not filled:
        raise ReadingError([f"{reading.sheet.name}: a row must have a behaviour, got none" for reading in readings])
    if unknown := sorted(set(options.rename).difference(*(reading.renamed for reading in readings))):
        raise ReadingError(f"`rename` must hold behaviours that occur, got {unknown[0]!r}")
    first = [note for reading in readings for note in reading.first_notes]
    unit = _convert_to_one_unit(filled, first)
    _keep_files_apart(filled, first)
    events = pd.concat([reading.events for reading in filled], ignore_index=True)
    labels = pd.unique(events["behaviour"])
    if len(events) >= MIN_EVENTS and len(labels) > MAX_SHARE_OF_LABELS * len(events):
        raise ReadingError(
            f"{filled[0].sheet.name}: behaviours must recur, got {len(labels):,} different ones in {len(events):,}"
            f" events, such as {labels[0]!r} and {labels[-1]!r}; say which column holds them (--columns.behaviour NAME)"
        )
    offsets = np.cumsum([0, *[int(reading.fragment.max()) + 1 for reading in filled]])
    fragment = np.concatenate([reading.fragment + offset for reading, offset in zip(filled, offsets, strict=False)])
    factors = list(dict.fromkeys(name for reading in filled for name in reading.roles.at.get("factors", [])))
    context = list(dict.fromkeys(name for reading in filled for name in reading.roles.at.get("context", [])))
    for name in [*factors, *context]:
        events[name] = events[name].fillna("")
    first += _read_levels(events, factors)
    unowned = events["subject"].eq("").to_numpy()
    if unowned.any():
        events["subject"] = np.where(unowned, events["recording"], events["subject"])
        what = "no subject is known" if unowned.all() else f"{unowned.sum():,} events are of no subject"
        first.append(f"{what}: each recording is taken as one subject (--columns.subject)")
    first += _notes_on_twins(events)
    share, row = _overlap_share(events)
    if share > MAX_OVERLAP and options.overlaps == "error":
        event = events.iloc[row]
        raise ReadingError(
            f"{share:.0%} of the bouts overlap another of the same subject and behaviour across files, such as"
            f" {event['behaviour']!r} of {event['subject']!r}; name the files of one observer, or say --overlaps keep"
        )
    all_notes = dict.fromkeys([*first, *notes, *(note for reading in readings for note in reading.notes)])
    empty = [name for reading in readings for name in reading.empty]
    sources = tuple(
        Source(
            reading.sheet.name,
            reading.roles.program.name if reading.roles.program else "",
            reading.roles.layout,
            {use: tuple(names) for use, names in reading.roles.at.items()},
            frozenset(reading.roles.inferred),
        )
        for reading in readings
    )
    spans = None
    if any(reading.spans is not None for reading in filled):
        watched = [
            Recordings(reading.events, reading.fragment).watched if reading.spans is None else reading.spans
            for reading in filled
        ]
        spans = pd.concat(watched, ignore_index=True)
        spans["subject"] = spans["subject"].where(spans["subject"] != "", spans["recording"])
    recordings = Recordings(
        events, fragment, unit, tuple(all_notes), tuple(factors), tuple(context), sources, tuple(empty), spans
    )
    if options.drop:
        recordings = recordings.drop(options.drop)
    if options.merge_repeats:
        recordings = recordings.merge_repeats()
    if options.ends == "next":
        recordings = recordings.until_next()
    if options.from_ is not None or options.to is not None:
        recordings = recordings.window(options.from_, options.to)
    return recordings


def _read_levels(events: pd.DataFrame, factors: list[str]) -> list[str]:
    """Empty the cells of factors that hold a word for missing; note those not known, and levels nearly alike."""
    for name in factors:
        missing = events[name].str.lower().isin(MISSING_LABELS)
        if events[name][~missing].nunique() > 1:  # else "+" and "-", or "wt" and "null", are the two levels
            events[name] = events[name].where(~missing, "")
    recordings, notes = events.drop_duplicates(["recording", "subject"]), []
    for name in factors:
        for level, others in near_names(sorted(pd.unique(recordings[name]))).items():
            notes += [
                f"the levels {level!r} and {other!r} of {name!r} are nearly alike" for other in others if level < other
            ]
        unknown = recordings.loc[recordings[name] == "", "subject"]
        if len(unknown):
            where = f"{len(unknown):,} of {len(recordings):,} recordings (first of {unknown.iloc[0]!r})"
            notes.append(f"the factor {name!r} is empty in {where}: nothing is compared by it before these are filled")
    return notes


def _notes_on_twins(events: pd.DataFrame) -> list[str]:
    """Return a note where two recordings of a subject hold nearly the same events, as those of two observers do."""
    several = events.groupby("subject")["recording"].transform("nunique") > 1
    pairs = (
        pair
        for _, subject_events in events[several].groupby("subject", sort=False)
        for pair in combinations([one for _, one in subject_events.groupby("recording", sort=False)], 2)
    )
    notes = []
    for one, other in islice(pairs, MAX_TWIN_PAIRS):
        if min(len(one), len(other)) < max(MIN_TWIN_EVENTS, 0.5 * max(len(one), len(other))):
            continue
        if min(_share_matched(one, other), _share_matched(other, one)) >= MIN_TWIN_SHARE:
            names = " and ".join(repr(timeline["recording"].iloc[0]) for timeline in (one, other))
            notes.append(
                f"the recordings {names} of {one['subject'].iloc[0]!r} hold nearly the same events: if two people"
                " scored one session, read the files of one of them"
            )
    return notes[:MAX_TWIN_NOTES]


def _share_matched(one: pd.DataFrame, other: pd.DataFrame) -> float:
    """Return the share of events for which the other recording has the same behaviour at nearly the same time."""
    steps = np.diff(np.sort(one["start"].to_numpy(np.float64)))
    if not np.isfinite(steps).all() or not (steps > 0).any():
        return 0.0
    tolerance = 0.15 * float(np.median(steps[steps > 0]))
    matched = 0
    for behaviour, events in one.groupby("behaviour"):
        start = events["start"].to_numpy(np.float64)
        candidates = np.sort(other.loc[other["behaviour"] == behaviour, "start"].to_numpy(np.float64))
        if len(candidates):
            after = np.searchsorted(candidates, start).clip(max=len(candidates) - 1)
            before = (after - 1).clip(min=0)
            gap = np.minimum(np.abs(candidates[after] - start), np.abs(candidates[before] - start))
            matched += int((gap <= tolerance).sum())
    return matched / len(one)


def _convert_to_one_unit(readings: list[Part], notes: list[str]) -> str:
    """Convert the times of several files to the unit of the first, and return it; "" where none says its unit.

    Raises:
        ReadingError: units cannot be compared.
    """
    units = list(dict.fromkeys(reading.unit for reading in readings if reading.unit))
    if len(units) > 1 and not set(units) <= set(SECONDS):
        raise ReadingError(f"times must have one unit in all files, got {', '.join(units)} ({readings[-1].sheet.name})")
    if not units:
        return ""
    for reading in readings:
        if reading.unit and reading.unit != units[0]:
            factor = SECONDS[reading.unit] / SECONDS[units[0]]
            reading.events[["start", "stop"]] *= factor
            if reading.spans is not None:
                reading.spans[["start", "stop"]] *= factor
            notes.append(f"the times of {reading.sheet.name} are converted to {units[0]}, as in the other files")
    if not all(reading.unit for reading in readings):
        notes.append(f"some files do not say their unit of time, and are taken to be in {units[0]}")
    return units[0]


def _keep_files_apart(readings: list[Part], notes: list[str]) -> None:
    """Put the names of files before those of recordings, where several files share one and no subject is known."""
    names: dict[str, set[int]] = {}
    for number, reading in enumerate(readings):
        for name in pd.unique(reading.events["recording"][reading.events["subject"] == ""]):
            names.setdefault(name, set()).add(number)
    twice = {name for name, files in names.items() if len(files) > 1}
    if not twice:
        return
    for reading in readings:
        for frame in (reading.events, reading.spans):
            if frame is not None:
                shared = frame["recording"].isin(twice) & (frame["subject"] == "")
                name = reading.sheet.stem + " " + frame["recording"].astype(str)
                frame["recording"] = frame["recording"].where(~shared, name)
    notes.append(f"{len(twice):,} names of recordings occur in several files, and the files' names are put before them")
