"""`neuroprior example`: a file of behaviour to try the other commands on."""

from pathlib import Path
from typing import Literal

from neuroprior._files import written_whole
from neuroprior.behaviour.study import large_study, simulated_study

STUDIES = {"small": simulated_study, "large": large_study}


def example(file: str, study: Literal["small", "large"] = "small") -> None:
    """Write an example file: a simulated study of twelve animals with two sessions each, six of them treated.

    A row is an event, with the columns animal, session, behaviour, start, stop, treatment and observer. What is done
    next depends on the last behaviour; grooming follows "eat, drink" more often than drinking alone suggests; treated
    animals groom more often after they reared, where the others walk, and rest longer.

    Args:
        file: where to write it (CSV); a file that is there already is left alone.
        study: that one, or a large one: 24 mice of both sexes, two hidden modes, a behaviour that fades within
            sessions, a second observer of some mice, and a misspelt name.
    """
    place = Path(file)
    if place.suffix.lower() != ".csv":
        raise ValueError(f"{place}: a name that ends in .csv is expected")
    if place.exists():
        raise ValueError(f"{place}: is there already; give another name")
    with written_whole(place) as stream:
        STUDIES[study](seed=0).to_csv(stream, index=False, lineterminator="\n")
    more = " --columns.observer observer" if study == "large" else ""
    print(f"wrote {place}; next: neuroprior check {place}{more}")
