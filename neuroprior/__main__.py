"""Entry point of the command `neuroprior`."""

import sys
from collections.abc import Sequence

from neuroprior._interrupts import ending_at_interrupts

with ending_at_interrupts():
    from neuroprior.cli.program import Command, run_commands

COMMANDS = {
    "check": Command(
        "neuroprior.cli.check:check", "show what files of behaviour are read as, and what is wrong in them"
    ),
    "fit": Command("neuroprior.cli.fit:run", "train a prior on executed plans and save it", raw=True),
    "report": Command(
        "neuroprior.behaviour.reporting.command:plans",
        "report on a file of plans: structure, models, figures",
        slow=True,
    ),
    "score": Command("neuroprior.cli.score:score", "log-likelihood and bits per action of plans under a saved prior"),
    "sample": Command("neuroprior.cli.sample:sample", "new plans from a saved prior"),
    "example": Command("neuroprior.cli.example:example", "write a small file of plans to try the other commands on"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; see `run_commands`."""
    try:
        import jsonargparse  # noqa: F401
    except ImportError:
        print("error: the command needs more packages: pip install 'neuroprior[cli]'", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    return run_commands("neuroprior", "Behavioural priors: statistical models of plans.", COMMANDS, arguments)


if __name__ == "__main__":
    sys.exit(main())
