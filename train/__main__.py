"""Entry point: `python -m train fit`."""

import sys
from collections.abc import Sequence

from neuroprior._interrupts import ending_at_interrupts

with ending_at_interrupts():
    from neuroprior.cli.program import run_program


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; see `run_program`."""
    return run_program(_run, arguments)


def _run(arguments: Sequence[str]) -> None:
    # Imported here, so that Ctrl-C is answered while the libraries load too.
    with ending_at_interrupts():
        from neuroprior.cli.fit import run

    run(list(arguments), "python -m train")


if __name__ == "__main__":
    sys.exit(main())
