"""Read recordings from files of laboratories."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuroprior.behaviour.reading.columns import Columns, find_roles
from neuroprior.behaviour.reading.layouts import LAYOUTS
from neuroprior.behaviour.reading.names import NAMES, plain
from neuroprior.behaviour.reading.options import Options
from neuroprior.behaviour.reading.problems import Problems, ReadingError
from neuroprior.behaviour.reading.sheets import Sheet, find_files, read_sheets, sheet_of_frame
from neuroprior.behaviour.reading.table import JOIN, MAX_OVERLAP, SECONDS, Part, Table
from neuroprior.behaviour.recordings import Recordings, Source

KEYS = ("recording", "subject", "observer")


def read(paths: Any, columns: Columns | Mapping[str, Any] | None = None, **options: Any) -> Recordings:
    """Read recordings: events in real time, of one study.

    Columns, layout, separators and encodings are found; what was found stands in the notes. Exports of BORIS, Observer,
    EthoVision, SimBA, DeepEthogram, Solomon Coder, keypoint-MoSeq, Audacity, Raven, crowsetta, TraMineR and XES need no
    options.

    Args:
        paths: a file, a folder, a glob, a pandas frame, or a list of these. Text (any separator, UTF-8, UTF-16,
            Windows-1252), also in .gz and .zip; .xlsx, .xls, .ods, .parquet and .feather need `pip install
            'neuroprior[tables]'`.
        columns: which columns hold what: `Columns`, or a dict of some of its names.
        options: how they are read, see `neuroprior.behaviour.reading.Options`.

    Returns:
        The recordings; `check` in the command line shows them.

    Raises:
        ReadingError: a ValueError whose `problems` are all that is wrong, a line each, with file, row and what to do.
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
    one = isinstance(paths, str | pd.DataFrame) or not hasattr(paths, "__iter__")
    groups: list[list[Sheet]] = []
    for number, item in enumerate([paths] if one else list(paths)):
        if isinstance(item, pd.DataFrame):
            name = "table" if one else f"table {number + 1}"
            groups.append([sheet_of_frame(item, name, name)])
        elif hasattr(item, "__fspath__") or isinstance(item, str):
            groups += [read_sheets(file, wanted) for file in find_files(item)]
        else:
            raise ValueError(f"`paths` must be files, folders or pandas frames, got {type(item).__name__}")
    if not groups:
        raise ValueError("`paths` must have one file at least, got none")
    _tell_stems_apart(groups)
    parts: list[Part] = []
    notes: list[str] = []
    wrong: list[str] = []
    for sheets in groups:
        found, said, failed = _read_file(sheets, options)
        parts, notes, wrong = parts + found, notes + said, wrong + failed
    if wrong:
        raise ReadingError(wrong)
    return _combine(parts, notes, options)


def _tell_stems_apart(groups: list[list[Sheet]]) -> None:
    """Put the folder before the names of files that are the same in several folders."""
    count = Counter(stem for sheets in groups for stem in {sheet.stem for sheet in sheets})
    for sheets in groups:
        for sheet in sheets:
            if count[sheet.stem] > 1 and sheet.is_file:
                file = Path(sheet.name.split(", ")[0])
                sheet.stem = f"{file.stem if len(sheets) > 1 else file.parent.name}/{sheet.stem}"


def _words_of_columns(columns: Columns) -> list[str]:
    """Return all names that a user gave, those of ranges and lists one by one as well."""
    words: list[str] = []
    for names in columns.named().values():
        for name in names:
            words += [name, *name.split(","), *name.split(":")] if name != "none" else []
    return words


def _read_file(sheets: list[Sheet], options: Options) -> tuple[list[Part], list[str], list[str]]:
    """Return the parts of a file, notes and problems; of a workbook the sheets like the first that can be read."""
    parts: list[Part] = []
    unread: list[str] = []
    problems: list[str] = []
    for sheet in sheets:
        if parts and len(sheets) > 1 and set(sheet.frame.columns) != set(parts[0].sheet.frame.columns):
            unread.append(sheet.name)
            continue
        try:
            parts.append(_read_sheet(sheet, options))
        except ReadingError as error:
            problems += error.problems
            unread.append(sheet.name)
    if parts and len(sheets) > 1:
        return parts, [f"{', '.join(unread)}: not read, since the columns are others"] if unread else [], []
    return parts, [], problems


def _read_sheet(sheet: Sheet, options: Options) -> Part:
    assert isinstance(options.columns, Columns)
    roles = find_roles(sheet, options.columns, options.words)
    problems = Problems()
    table = Table(sheet, roles, options, problems)
    if not table.size:
        events = pd.DataFrame({name: [] for name in ("recording", "subject", "behaviour")}, dtype=object)
        events = events.assign(start=np.array([], float), stop=np.array([], float))
        nothing = np.array([], np.int64)
        return Part(
            sheet, roles, events, nothing, nothing, first_notes=[f"{sheet.name} has no rows"], empty=[sheet.stem]
        )
    part = LAYOUTS[roles.layout](table)
    _check_observers(table, part, problems)
    _check_factors(part, problems)
    problems.stop()
    return part


def _check_observers(table: Table, part: Part, problems: Problems) -> None:
    """Refuse events that two people scored, and of one subject bouts of one behaviour that overlap."""
    if "observer" in table.roles.at and "observer" in table.roles.found:
        pairs = pd.DataFrame({"recording": table.recording, "subject": table.subject, "observer": table.observer})
        several = pairs.groupby(["recording", "subject"], sort=False)["observer"].nunique()
        name = table.roles.at["observer"][0]
        del table.roles.at["observer"]
        part.events = part.events.drop(columns="observer")
        if (several > 1).any():
            recording, subject = several.index[int(several.to_numpy().argmax())]
            row = int(np.flatnonzero((pairs["recording"] == recording) & (pairs["subject"] == subject))[0])
            what = f"recording {recording!r} was scored by {several.max()} observers"
            way = f"say --columns.observer {name!r} to keep them apart, or read the file of one"
            problems.add(f"{what}; {way}", [row], table.place)
            return
    share, row = same_overlap(part.events)
    if share <= MAX_OVERLAP or table.options.overlaps == "keep":
        return
    separating = _separating_column(table, part)
    way = "if two people scored, read the file of one; --overlaps keep reads them as they are"
    if separating:
        own = ",".join(part.roles.at["behaviour"])
        use = f"--columns.observer {separating!r}, or --columns.subject {separating!r}"
        if plain(separating).startswith("modifier"):
            use = f"--columns.behaviour '{own},{separating}'"
        elif plain(separating) in (*NAMES["recording"], *NAMES["factors"], *NAMES["date"]):
            use = f"--columns.recording '{','.join([*part.roles.at.get('recording', []), separating])}'"
        way = f"the column {separating!r} keeps them apart ({use})"
    event = part.events.iloc[row]
    what = f"{share:.0%} of the bouts overlap another of the same subject and behaviour, such as {event['behaviour']!r}"
    problems.add(f"{what}; {way}", [int(part.rows[row])], table.place)


def same_overlap(events: pd.DataFrame) -> tuple[float, int]:
    """Return the share of bouts that begin before one of the same behaviour ended, and the first of them."""
    known = events["stop"].notna().to_numpy() & (events["stop"] > events["start"]).to_numpy()
    if not known.any():
        return 0.0, 0
    some = events[known]
    keys = [key for key in (*KEYS, "behaviour") if key in some]
    unit = some.groupby(keys, sort=False).ngroup().to_numpy()
    start, stop = some["start"].to_numpy(float), some["stop"].to_numpy(float)
    order = np.lexsort((start, unit))
    latest = pd.Series(stop[order]).groupby(unit[order]).cummax().to_numpy()
    before, same = np.append(np.nan, latest[:-1]), np.diff(unit[order], prepend=-1) == 0
    late = same & (start[order] < before - 1e-9 * np.abs(before) - 1e-9)
    return float(late.mean()), int(np.flatnonzero(known)[order[late.argmax()]]) if late.any() else 0


def _separating_column(table: Table, part: Part) -> str | None:
    """Return a column that is not used, and by which bouts of one behaviour do not overlap."""
    used = table.roles.used()
    free = [name for name in table.frame if name not in used and 1 < table.frame[name].nunique() <= 20]
    likely = [name for name in free if plain(name) in NAMES["observer"]]
    for name in [*likely, *[one for one in free if one not in likely]]:
        events = part.events.assign(
            subject=part.events["subject"] + JOIN + table.frame[name].to_numpy(object)[part.rows]
        )
        if same_overlap(events)[0] <= MAX_OVERLAP / 5:
            return str(name)
    return None


def _check_factors(part: Part, problems: Problems) -> None:
    """Leave out factors that were found and vary within a recording; refuse those that were named."""
    for name in list(part.roles.at.get("factors", [])):
        own = part.events.groupby(["recording", "subject"], sort=False)[name].transform("first")
        other = np.flatnonzero((part.events[name] != own).to_numpy())
        if not other.size:
            continue
        if "factors" in part.roles.found:
            part.events = part.events.drop(columns=name)
            part.roles.at["factors"].remove(name)
            part.notes.append(f"the column {name!r} varies within recordings, and is not used as a factor")
        else:
            value = part.events[name].iloc[other[0]]
            what = f"the factor {name!r} must not vary within a recording, got {value!r} beside {own.iloc[other[0]]!r}"
            problems.add(what, part.rows[other].tolist(), part.sheet.place)


def _combine(parts: list[Part], notes: list[str], options: Options) -> Recordings:
    filled = [part for part in parts if len(part.events)]
    if not filled:
        raise ReadingError([f"{part.sheet.name}: no row has a behaviour" for part in parts])
    if unknown := sorted(set(options.rename).difference(*(part.renamed for part in parts))):
        raise ReadingError(f"`rename` must hold behaviours that occur, got {unknown[0]!r}")
    first = [note for part in parts for note in part.first_notes]
    units = _one_unit(filled, first)
    _keep_files_apart(filled, first)
    events = pd.concat([part.events for part in filled], ignore_index=True)
    offsets = np.cumsum([0, *[int(part.fragment.max()) + 1 for part in filled]])
    fragment = np.concatenate([part.fragment + offset for part, offset in zip(filled, offsets, strict=False)])
    factors = list(dict.fromkeys(name for part in filled for name in part.roles.at.get("factors", [])))
    context = list(dict.fromkeys(name for part in filled for name in part.roles.at.get("context", [])))
    for name in [*factors, *context]:
        events[name] = events[name].fillna("")
    unowned = events["subject"].eq("").to_numpy()
    if unowned.any():
        events["subject"] = np.where(unowned, events["recording"], events["subject"])
        whose = (
            "each recording is taken as one subject"
            if unowned.all()
            else f"{unowned.sum():,} events are taken as of one"
        )
        first.append(f"no subject is known: {whose} (--columns.subject)")
    share, row = same_overlap(events)
    if share > MAX_OVERLAP and options.overlaps == "error":
        event = events.iloc[row]
        raise ReadingError(
            [
                f"{share:.0%} of the bouts overlap another of the same subject and behaviour across files, such as"
                f" {event['behaviour']!r} of {event['subject']!r}; name the files of one observer, or say"
                " --overlaps keep"
            ]
        )
    said = list(dict.fromkeys([*first, *notes, *[note for part in parts for note in part.notes if note]]))
    empty = [name for part in parts for name in part.empty]
    sources = tuple(
        Source(
            part.sheet.name,
            part.roles.program.name if part.roles.program else "",
            part.roles.layout,
            {use: tuple(names) for use, names in part.roles.at.items()},
            frozenset(part.roles.found),
        )
        for part in parts
    )
    spans = None
    if any(part.spans is not None for part in filled):
        every = [
            Recordings(part.events, part.fragment).watched if part.spans is None else part.spans for part in filled
        ]
        spans = pd.concat(every, ignore_index=True)
        spans["subject"] = spans["subject"].where(spans["subject"] != "", spans["recording"])
    recordings = Recordings(
        events, fragment, units[0], tuple(said), tuple(factors), tuple(context), sources, tuple(empty), spans
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


def _one_unit(parts: list[Part], notes: list[str]) -> list[str]:
    """Bring the times of several files to one unit, that of the first; a note where some do not say theirs.

    Raises:
        ReadingError: units that cannot be compared.
    """
    units = list(dict.fromkeys(part.unit for part in parts))
    known = [unit for unit in units if unit]
    if len(known) > 1 and not set(known) <= set(SECONDS):
        raise ReadingError(f"times must have one unit in all files, got {', '.join(known)} ({parts[-1].sheet.name})")
    for part in parts:
        if len(known) > 1 and part.unit and part.unit != known[0]:
            factor = SECONDS[part.unit] / SECONDS[known[0]]
            part.events[["start", "stop"]] *= factor
            if part.spans is not None:
                part.spans[["start", "stop"]] *= factor
            notes.append(f"the times of {part.sheet.name} are read in {known[0]}, as those of the other files")
    if len(units) > 1 and "" in units:
        notes.append(f"some files do not say their unit of time, and are taken to be in {known[0]}")
    return known or units


def _keep_files_apart(parts: list[Part], notes: list[str]) -> None:
    """Give recordings of one name in several files the files' names, where no subject tells them apart."""
    names: dict[str, set[int]] = {}
    for number, part in enumerate(parts):
        for name in pd.unique(part.events["recording"][part.events["subject"] == ""]):
            names.setdefault(name, set()).add(number)
    twice = {name for name, files in names.items() if len(files) > 1}
    if not twice:
        return
    for part in parts:
        again = part.events["recording"].isin(twice) & (part.events["subject"] == "")
        called = part.sheet.stem + " " + part.events["recording"].astype(str)
        part.events["recording"] = part.events["recording"].where(~again, called)
        if part.spans is not None:
            again = part.spans["recording"].isin(twice) & (part.spans["subject"] == "")
            called = part.sheet.stem + " " + part.spans["recording"].astype(str)
            part.spans["recording"] = part.spans["recording"].where(~again, called)
    notes.append(
        f"{len(twice):,} names of recordings occur in several files, which are kept apart by the names of the files"
    )
