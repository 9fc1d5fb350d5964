"""Nothing that users read off the library changes unnoticed: pinned results, beside the tests of what is right."""

import pytest

from tests.support import pinned as _cases  # noqa: F401
from tests.support.unchanged import ACCEPT, CASES, differences, found_of, pinned, simple


@pytest.fixture(scope="module")
def results():
    return pinned()


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if case.slow else name for name, case in CASES.items()]
)
def test_nothing_has_changed(name, results):
    lines = differences(results.get(name), found_of(name), CASES[name].relative)
    few = "\n".join(lines[:40])
    assert not lines, f"{len(lines)} values differ:\n{few}\nIf they are meant to: {ACCEPT} {name}"


def test_no_result_is_pinned_in_vain(results):
    assert set(results) == set(CASES)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ([1, 2.0], [1, 2.01]),
        ([1, 2.0], [1, 2.0, 3.0]),
        ({"a": 1}, {"b": 1}),
        (1, True),
        (2, 3),
        ("3 plans", "4 plans"),
        ("0.50 bits", "0.52 bits"),
        ("at 0.50", "by 0.50"),
        (None, 0.0),
        ("nan", 0.0),
        (list(range(100)), [1, 0, *range(2, 100)]),
    ],
)
def test_a_change_is_found_and_named(one, other):
    one, other = simple({"one": one}), simple({"one": other})
    assert not differences(one, one)
    assert all(line.startswith("/one") and "pinned" in line for line in differences(one, other))
    assert differences(one, other)


def test_the_last_digit_may_differ():
    assert not differences("0.50 bits", "0.51 bits")
    assert not differences([1.0, 2], [1.00001, 2.0])
