"""The layouts of tables, and what reads each."""

from collections.abc import Callable

from neuroprior.behaviour.reading.bouts import rows_of_events
from neuroprior.behaviour.reading.frames import columns_of_behaviours, rows_of_frames
from neuroprior.behaviour.reading.sequences import rows_of_sequences
from neuroprior.behaviour.reading.starts_and_stops import rows_of_starts_and_stops
from neuroprior.behaviour.reading.table import Part, Table

LAYOUTS: dict[str, Callable[[Table], Part]] = {
    "events": rows_of_events,
    "rows of starts and stops": rows_of_starts_and_stops,
    "rows of frames": rows_of_frames,
    "columns of behaviours": columns_of_behaviours,
    "rows of sequences": rows_of_sequences,
}
