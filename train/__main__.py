"""Entry point: `python -m train fit`."""

import sys
from collections.abc import Sequence

from neuroprior._interrupts import ending_at_interrupts

with ending_at_interrupts():
    from neuroprior.__main__ import COMMANDS
    from neuroprior.cli.program import run_program


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; see `run_program`."""
    return run_program(_run, arguments)


def _run(arguments: Sequence[str]) -> None:
    COMMANDS["fit"].load()(list(arguments), "python -m train")


if __name__ == "__main__":
    sys.exit(main())
