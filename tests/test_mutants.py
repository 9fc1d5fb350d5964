"""Faults are planted where they change what the code does, one at a time, and nowhere else."""

import ast

from tests.support.mutants import Fault, Reach, find_faults

SOURCE = '''
LIMIT = 3


def first(values: list[int], most: int = 2, wide: bool = False) -> int:
    """Never 4 < 5."""
    if not values or len(values) <= most:
        raise ValueError(f"{len(values) + 1} values")
    total = sum(values[1:])
    log(total, scale=1, device="cpu")
    return min(total, most) if wide else scaled(total, most)


@njit(cache=True)
def scaled(total: int, most: int) -> int:
    return total * most
'''


def test_faults_change_one_thing_and_no_message():
    faults = find_faults("a.py", SOURCE)
    changes = {(fault.line, SOURCE[fault.start : fault.end], fault.after) for fault in faults}
    assert changes == {
        (7, "not values or len(values) <= most", "(not values and len(values) <= most)"),
        (7, "not values", "(values)"),
        (7, "len(values) <= most", "(len(values) < most)"),
        (9, "sum(values[1:])", "(mean(values[1:]))"),
        (9, "1", "(2)"),
        (10, 'log(total, scale=1, device="cpu")', "pass"),
        (10, 'log(total, scale=1, device="cpu")', "(log(total, device='cpu'))"),
        (10, "1", "(2)"),
        (
            11,
            "min(total, most) if wide else scaled(total, most)",
            "(scaled(total, most) if wide else min(total, most))",
        ),
        (11, "min(total, most)", "(max(total, most))"),
        (11, "min(total, most)", "(min(most, total))"),
        (11, "scaled(total, most)", "(scaled(most, total))"),
        (16, "total * most", "(total / most)"),
    }
    for fault in faults:
        ast.parse(fault.plant(SOURCE))


def test_compiled_code_is_reached_by_the_tests_of_its_callers_quickest_first():
    tests = {"a.py": {11: ["slow", "quick"], 9: ["other"]}}
    reach = Reach(tests, {"slow": 3.0, "quick": 0.1, "other": 0.1}, {"a.py": SOURCE}, {"a.py": [(15, 16, "scaled")]})
    assert reach.of(Fault("a.py", 16, 0, 1, "")) == ["quick", "slow"]
    assert reach.of(Fault("a.py", 9, 0, 1, "")) == ["other"]
    assert reach.of(Fault("a.py", 7, 0, 1, "")) == []
