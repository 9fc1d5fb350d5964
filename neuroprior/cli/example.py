"""`neuroprior example`: a file of plans to try the other commands on."""

from importlib.resources import files
from pathlib import Path

from neuroprior._files import write_whole


def example(file: str) -> None:
    """Write an example file of plans: simulated behaviour of eight animals, three sessions each.

    What is done next depends on the last action; grooming follows "sniff, rear" more often than either alone suggests;
    and the four treated animals go on walking more often than the control animals.

    Args:
        file: where to write it; a file that is there already is left alone.
    """
    place = Path(file)
    if place.exists():
        raise ValueError(f"{place}: is there already; give another name")
    write_whole(place, files("neuroprior.cli").joinpath("example.csv").read_bytes())
    print(f"wrote {place}; next: neuroprior report {place}")
