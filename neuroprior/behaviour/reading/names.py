"""Usual names of columns, and the columns of programs' exports."""

import re
import unicodedata
from typing import NamedTuple

TIME_UNITS = {
    "s": "s|secs?|seconds?|sf", "ms": "ms|msecs?|milliseconds?", "us": "usec|µs|μs|microseconds?",
    "min": "min|mins|minutes?", "h": "h|hrs?|hours?",
}  # fmt: skip
"""Units of time, and how names of columns write them."""

ANY_UNIT = "|".join(TIME_UNITS.values())
UNIT_IN_BRACKETS = re.compile(rf"\s*[(\[]({ANY_UNIT}|hh:mm:ss(.ms)?|frames?|hz|mg|mg/kg)[)\]]\s*$", re.I)
UNIT_AT_END = re.compile(rf",?\s[/,]?\s*({ANY_UNIT}|hh mm ss ms|hh mm ss|ss msec|seconds since start)$")

KINDS_OF_SUBJECTS = (
    "subject", "animal", "mouse", "rat", "bird", "individual", "participant", "person", "patient", "child", "user",
    "player", "tier", "proband", "vp", "respondent", "student", "customer", "visitor", "worker",
)  # fmt: skip
ANIMALS = ("monkey", "dog", "cat", "fish", "fly", "pig", "cow", "sheep", "goat", "horse", "hen", "larva", "worm", "bee")
HOUSINGS = ("cage", "tank", "box", "chamber")
"""Columns that tell subjects apart where no other does, and rows of one stand together; housings where no column tells
recordings apart either."""

OF_NO_SUBJECT = (
    "zone", "camera", "site", "bout", "channel", "stimulus", "location", "place", "arena", "trial", "video",
)  # fmt: skip
"""What has numbers, but is no subject, nor are behaviours."""

KEYS_OF_SUBJECTS = ("id", "no", "nr", "name", "#", "tag", "rfid")

PERIODS = ("date", "datum", "day", "week", "visit")
"""Columns within which sessions may be numbered anew."""

NAMES: dict[str, tuple[str, ...]] = {
    "behaviour": (
        "behavior", "behaviour", "behaviors", "behaviours", "action", "actions", "activity", "syllable", "concept name",
        "syllables reindexed",
        "event", "event name", "label", "labels", "state", "states", "annotation", "behavior code", "behaviour code",
        "behavior name", "element", "species", "call type", "classifier", "motif", "cluster", "prediction", "code",
        "b soid labels", "sequence", "seq", "verhalten", "comportement", "comportamiento", "act", "status", "choice",
        "response", "decision", "move", "aoi", "page", "name",
    ),
    "subject": (
        "subject", "subject id", "subjects", "animal", "animal id", "mouse", "mouse id", "rat", "rat id", "bird",
        "bird id", "individual", "individual id", "focal", "focal animal", "focal subject", "participant",
        "participant id", "person", "person id", "id", "pid", "ind", "individu", "tier", "case concept name", "case id",
        "case", "idhous",
        "subj", "subj id", "sub", "actor", "initiator", "sujet", "sujeto", *KINDS_OF_SUBJECTS,
        *(f"{kind} {key}" for kind in (*KINDS_OF_SUBJECTS, *ANIMALS) for key in KEYS_OF_SUBJECTS),
        *(f"id {kind}" for kind in (*KINDS_OF_SUBJECTS, *ANIMALS)), "rfid", "id no",
    ),
    "recording": (
        "recording", "recording id", "session", "session id", "observation", "observation id", "video", "video name",
        "video id", "filename", "file name", "file", "trial", "trial id", "trial name", "notated path", "begin file",
        "source file", "plan", "plan id", "sequence id", "run", "obs",
        "versuch", "sitzung", "seance", "sesion", "case concept name", "case id", "case",
    ),
    "start": (
        "start", "start time", "onset", "onset time", "begin", "begin time", "start timestamp", "from", "time relative",
        "time", "timestamp", "time timestamp", "times", "t", "ts", "t start",
        "trial time", "recording time", "second", "frame",
        "frame index", "frame number", "frame id", "frames", "bin", "time bin", "scan",
        "beginn", "anfang", "von", "zeit", "debut", "start frame",
        "begin frame", "onset frame", "time relative hmsf", "time absolute hms", "date time", "datetime",
        "startzeit", "uhrzeit", "inicio", "event start",
        "start of event", "scan time", "epoch", "heure", "hora", "temps", "tiempo", "datum", "date",
    ),
    "stop": (
        "stop", "stop time", "end", "end time", "t stop", "t end", "offset", "offset time", "finish",
        "to", "ende", "bis", "fin",
        "end timestamp", "stop timestamp", "endzeit", "stopp", "event end", "end of event",
        "complete timestamp", "end frame", "stop frame", "offset frame",
    ),
    "duration": ("duration", "bout time", "dur", "bout duration", "bout length", "dauer", "duree", "duracion",
                 "length"),
    "event_type": (
        "event type", "behavior type", "behaviour type", "lifecycle transition", "transition", "type", "status",
        "marker", "state event", "start stop", "on off", "onoff",
    ),
    "observer": (
        "observer", "observer id", "observer name", "coder", "coder id", "rater", "scorer", "annotator", "annotator id",
    ),
    "context": ("context",),
    "date": ("date", "datum", "observation date", "date dmy", "fecha", "jour"),
    "factors": (
        "treatment", "condition", "genotype", "sex", "gender", "group", "drug", "dose", "strain", "age", "phase",
        "cohort", "line", "diet", "season", "day", "experimental group", "treatment group",
    ),
}  # fmt: skip
"""Names of the columns for each use, the surest first, as `plain` writes them."""


def plain(name: str) -> str:
    """Return a column's name in lower case, without accents, punctuation between words, and unit.

    Example:
        >>> plain("Start (s)"), plain("case:concept:name"), plain("onset_min"), plain("AnimalID")
        ('start', 'case concept name', 'onset', 'animal id')
    """
    words = re.sub(r"(?<=[a-z])(?=(?:I[Dd]|N[or]|Name|Number|Code|Tag)\b)", " ", str(name).strip())
    letters = unicodedata.normalize("NFKD", words.lower())
    short = UNIT_IN_BRACKETS.sub("", "".join(letter for letter in letters if not unicodedata.combining(letter)))
    short = re.sub(r"[\s_.:\-]+", " ", short).strip()
    return UNIT_AT_END.sub("", short)


KNOWN_NAMES = frozenset(name for names in NAMES.values() for name in names)


class Program(NamedTuple):
    """A kind of export that its columns identify.

    Attributes:
        name: of the program and its kind of file.
        needs: columns that identify it, as `plain` writes them.
        columns: for each use the names of its column, in the order of preference.
        layout: of its rows; "" where it follows from the columns.
        unit: of its times; "" where the columns say it.
    """

    name: str
    needs: frozenset[str]
    columns: dict[str, tuple[str, ...]]
    layout: str = ""
    unit: str = ""


def _program(name: str, needs: str, layout: str = "", unit: str = "", **columns: str) -> Program:
    split = {use: tuple(filter(None, names.split("|"))) for use, names in columns.items()}
    return Program(name, frozenset(needs.split("|")), split, layout, unit)


_BORIS = {"recording": "observation id", "subject": "subject", "behaviour": "behavior"}
_CASE = {"recording": "case concept name", "subject": "case concept name", "behaviour": "concept name"}

PROGRAMS: tuple[Program, ...] = (
    _program("BORIS, aggregated events", "observation id|behavior|start|stop", start="start", stop="stop",
             duration="", event_type="", **_BORIS),
    _program("BORIS, tabular events", "observation id|behavior|behavior type|time", "rows of starts and stops",
             start="time", event_type="behavior type", duration="", **_BORIS),
    _program("BORIS, tabular events (before version 8)", "time|subject|behavior|status", "rows of starts and stops",
             start="time", event_type="status", duration="", **_BORIS),
    _program("Noldus Observer, event log", "observation|behavior|event type", "rows of starts and stops",
             recording="observation", subject="subject", behaviour="behavior", event_type="event type",
             start="time relative|time relative hmsf|time relative hms|time absolute hms", duration="duration"),
    _program("keypoint-MoSeq, moseq_df", "name|syllable|frame index", "rows of frames", "frames",
             recording="name", subject="name", behaviour="syllable", start="frame index", factors="group"),
    _program("keypoint-MoSeq, results", "syllable|centroid x|centroid y", "rows of frames", "frames",
             recording="name|recording|session|session name", behaviour="syllable",
             start="frame index|frame|time", factors="group"),
    _program("MoSeq2, moseq_df", "labels (usage sort)|frame index", "rows of frames", "frames",
             recording="sessionname|session name|uuid", subject="subjectname|subject name", factors="group",
             behaviour="labels (usage sort)", start="frame index"),
    _program("SimBA, bouts", "video|event|start time|end time", recording="video", behaviour="event",
             start="start time", stop="end time", duration="bout time", event_type=""),
    _program("EthoVision, raw data", "trial time|recording time", "columns of behaviours",
             start="recording time|trial time", behaviour=""),
    _program("XES, intervals", "case concept name|concept name|time timestamp|start timestamp",
             start="start timestamp", stop="time timestamp", **_CASE),
    _program("XES, event log", "case concept name|concept name|time timestamp", start="time timestamp",
             event_type="lifecycle transition", factors="", **_CASE),
    _program("crowsetta, generic-seq", "label|onset|offset|annot path", recording="notated path|annot path",
             behaviour="label", start="onset", stop="offset"),
    _program("Raven, selection table", "selection|view|begin time|end time", recording="begin file", start="begin time",
             stop="end time", behaviour="annotation|species|call type|label|call|type|code|notes"),
)  # fmt: skip
"""The first counts of which a file has all columns."""

SIMBA = _program("SimBA, machine results", "", "columns of behaviours", "frames")
DEEPETHOGRAM = _program("DeepEthogram, labels", "background", "columns of behaviours", "frames")
"""Programs that the names of their columns of zeros and ones identify."""

WORDS = {
    "start": ("start", "state start", "begin", "began", "onset", "on", "started", "state begin", "beginn", "an"),
    "stop": ("stop", "state stop", "end", "ended", "offset", "off", "stopped", "aus", "state end", "complete", "finish",
             "finished", "completed", "ende"),
    "point": ("point", "instant", "point event", "state point"),
}  # fmt: skip
"""Words for the kinds of rows where starts and stops have rows of their own, in lower case."""

ORDERS = (
    "order", "event order", "step", "seq no", "sequence number", "event number", "event no", "trial number", "trial no",
    "trial", "rank", "position",
)  # fmt: skip
"""Columns that number the events of a recording, where no times do."""

STEM_NUMBER = re.compile(r"(.*?[^\d.])?[._\- ]?(\d+)")
"""A name that ends in a number: its stem, if any, and the number."""

COUNTED = "device|trial|event|session|block|row|line|frame|sample|serial|index"
SUMMARY = re.compile(
    rf"\b(?:total|mean|median|average|std|sd|frequency|occurr?ences)\b|^(?!(?:{COUNTED}) number$).*\bnumber\b"
)
"""Occurs in names of columns that sum events up."""

SURE_SEPARATORS = (" > ", "->", "|")
"""Separators of behaviours in a sequence in one cell that stand in few behaviours' names."""

TOTALS = ("total", "totals", "sum", "gesamt", "summe")
"""What stands for a behaviour in a row that sums up those above it, in lower case."""

SEQUENCE_MISSING = ("*", "%")
"""States of TraMineR's sequences that stand for no state."""

NO_SUBJECT = ("no focal subject",)
"""Words of programs for no subject, in lower case."""
