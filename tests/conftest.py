"""What all tests share: the same drawn examples in every run, and figures that need not be drawn."""

import gc
import os
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import settings
from matplotlib.figure import Figure

from tests.support.slow import slow_cases

# So that a test finds an error always or never.
settings.register_profile("same", derandomize=True, database=None)
settings.load_profile("same")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that take long go to the slow lane."""
    long = slow_cases()
    for item in items:
        if item.nodeid in long:
            item.add_marker(pytest.mark.slow)


def pytest_collection_finish() -> None:
    """What is loaded stays: to look through it for garbage again and again takes a tenth of the time.

    So does what tests load later; hence garbage is looked for less often than usual.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 10, 10)


def _blank(figure: Figure, file: Any, *, format: str | None = None, **how: Any) -> None:
    if isinstance(file, str | os.PathLike):
        with open(file, "wb") as opened:
            opened.write(b"\x89PNG")
    elif format == "svg":
        file.write('<svg width="1pt"></svg>')
    else:
        file.write(b"\x89PNG")


@pytest.fixture(scope="module")
def undrawn() -> Iterator[Any]:
    """For a module of tests of whole commands: figures are made, and files hold empty ones.

    To draw them takes longer than all else. `tests/behaviour/reporting/test_page.py` draws all of a report's, and
    `tests/integration/test_wheel.py` and `test_docs.py` those of whole commands. Gives what draws them.
    """
    draws = Figure.savefig
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", _blank)
        yield draws
