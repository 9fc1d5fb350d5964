"""How recordings are read: options of `read`, and of the commands."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from neuroprior._files import MISSING_LABELS
from neuroprior.behaviour.reading.columns import Columns, make_columns

Missing = Literal["gap", "nothing", "label", "error"]
Unpaired = Literal["error", "drop", "open"]
Overlaps = Literal["error", "keep", "join"]
Ends = Literal["auto", "inclusive", "exclusive", "next"]

UNLABELLED = "missing"
"""The behaviour of rows without a label, where `missing` is "label"."""


@dataclass(frozen=True)
class Options:
    """How recordings are read.

    Attributes:
        columns: which columns hold what; those that are not named are found by their names.
        missing: what a row without a label says: nobody knows ("gap": a fragment ends), nothing was done ("nothing"),
            it is a behaviour ("label"), or the file is wrong ("error"). None: a gap, but for empty cells of frames, in
            which nothing was done.
        missing_words: labels that stand for none, beside the empty cell.
        unpaired: starts without a stop, and stops without a start: an "error", "drop" both, or keep "open" starts.
        overlaps: overlapping bouts of one behaviour of one subject: an "error", or "keep"; "join", for columns of zeros
            and ones alone, reads behaviours done at once as one ("groom+rear").
        ends: whether a stop is the last unit of a bout ("inclusive") or the first after it ("exclusive"); "auto": as
            the file shows; "next": a stop that is not known is the next start.
        day_first: whether 1/2/2024 is the first of February; None: as the file shows.
        words: what words say that a row is: start, stop or point, such as `{"in": "start", "out": "stop"}`.
        merge_repeats: make successive bouts of one behaviour one.
        from_, to: read only what lies between these times of each recording, in its unit.
        drop: behaviours to leave out.
        rename: behaviours and their new names; several may get the same.

    Raises:
        ValueError: an option is out of range.

    Example:
        >>> Options(rename={"walk": "move"}).label("walk")
        'move'
    """

    columns: Columns | Mapping[str, Any] | None = None
    missing: Missing | None = None
    missing_words: Sequence[str] = MISSING_LABELS
    unpaired: Unpaired = "error"
    overlaps: Overlaps = "error"
    ends: Ends = "auto"
    day_first: bool | None = None
    words: Mapping[str, str] = field(default_factory=dict)
    merge_repeats: bool = False
    from_: float | None = None
    to: float | None = None
    drop: Sequence[str] = ()
    rename: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", make_columns(self.columns))
        for name, kinds in (("missing", Missing), ("unpaired", Unpaired), ("overlaps", Overlaps), ("ends", Ends)):
            value = getattr(self, name)
            if value not in get_args(kinds) and not (name == "missing" and value is None):
                raise ValueError(f"`{name}` must be one of {', '.join(get_args(kinds))}, got {value!r}")
        for name in ("missing_words", "drop"):
            if isinstance(value := getattr(self, name), str):
                object.__setattr__(self, name, (value,))
        if wrong := set(self.words.values()) - {"start", "stop", "point"}:
            raise ValueError(f"`words` must map to start, stop or point, got {sorted(wrong)[0]!r}")
        if self.from_ is not None and self.to is not None and not self.from_ < self.to:
            raise ValueError(f"`from_` must be below `to`, got {self.from_} and {self.to}")

    def label(self, text: str) -> str:
        """Return the label that a text stands for; "" for none."""
        if text.lower() in {"", *map(str.lower, self.missing_words)} and text not in self.rename:
            return UNLABELLED if self.missing == "label" else ""
        return self.rename.get(text, text)
