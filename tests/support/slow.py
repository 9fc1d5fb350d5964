"""Which tests take long: `python -m tests.support.slow LOG` chooses them anew, from what pytest prints with
`--durations=0 -vv`.

They are kept in `slow_cases.txt` beside this, and run in the slow lane. Of each test the quickest case is run with each
change, unless it takes longer than `LONG` itself.
"""

import re
import sys
from collections import defaultdict
from pathlib import Path

CASES = Path(__file__).with_name("slow_cases.txt")

BUDGET, LONG, SHORT = 560.0, 5.0, 0.5
"""Seconds of all tests in the quick lane, on one core; of a test that has no place there; and of one that stays."""


def slow_cases() -> frozenset[str]:
    """The names of the tests that take long, as pytest writes them."""
    return frozenset(CASES.read_text(encoding="utf-8").splitlines())


def choose(log: str) -> list[str]:
    """The names of the tests that go to the slow lane, from pytest's list of durations: the longest first.

    What a module sets up for its tests does not count: another test would have to.
    """
    seconds, cases = defaultdict[str, float](float), defaultdict[str, list[str]](list)
    for duration, name in re.findall(r"^([\d.]+)s call +(\S.*)$", log, re.MULTILINE):
        seconds[name] += float(duration)
    for name in seconds:
        cases[name.partition("[")[0]].append(name)
    quickest = {min(names, key=lambda name: seconds[name]) for names in cases.values()}
    chosen, left = list[str](), sum(seconds.values())
    for name in sorted(seconds, key=lambda name: -seconds[name]):
        if left > BUDGET and seconds[name] > SHORT and (name not in quickest or seconds[name] > LONG):
            chosen.append(name)
            left -= seconds[name]
    return sorted(chosen)


if __name__ == "__main__":
    CASES.write_text("".join(f"{name}\n" for name in choose(Path(sys.argv[1]).read_text(encoding="utf-8"))), "utf-8")
