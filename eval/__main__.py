"""Entry point: `python -m eval paper` and the other experiments."""

import sys
from collections.abc import Sequence

from neuroprior._interrupts import ending_at_interrupts

with ending_at_interrupts():
    from neuroprior.cli.program import Command, run_commands

COMMANDS = {
    "paper": Command("eval.paper.command:paper", "the paper's two simulations"),
    "plans": Command(
        "neuroprior.behaviour.reporting.command:plans", "a report on a file of plans (also: neuroprior report)"
    ),
    "mice": Command("eval.mice.command:mice", "whether priors learned from mice in a labyrinth help a planner"),
    "compare": Command("eval.compare.command:compare", "priors, or planners, compared in many worlds at equal budget"),
    "curriculum": Command("eval.compare.curriculum:curriculum", "what priors gain from the horizon curriculum"),
    "depth": Command("eval.compare.depth:depth", "how deep to plan"),
    "search": Command("eval.compare.search:search", "what helps a planner that samples"),
    "live": Command("eval.live.command:live", "priors that learn online while the world changes"),
    "quality": Command("eval.quality.command:quality", "how near priors come to sources of known entropy"),
    "screening": Command("eval.quality.screening:screening", "whether networks that would pay are trained"),
    "puzzles": Command("eval.puzzles.command:puzzles", "Sokoban and sliding tiles solved by policy-guided search"),
    "control": Command(
        "eval.control.command:control_experiment", "priors that propose continuous actions to iCEM, MPPI and shooting"
    ),
    "options": Command("eval.options.command:options", "modes that persist as options of a planner that samples"),
    "sources": Command("eval.sources.command:sources", "several priors that share a planner's candidates"),
    "intentions": Command(
        "eval.intentions.command:intentions", "what an observed agent is after, by priors toward known goals"
    ),
    "modes": Command("eval.modes.command:modes", "hidden modes of mice in a labyrinth, and where they lead"),
    "study": Command("eval.study.command:study", "the tests of conditions in simulated studies: false alarms, power"),
    "calibration": Command(
        "eval.study.calibration:calibration", "whether tests hold 5 % and intervals cover 95 %, in many designs"
    ),
    "pages": Command("eval.pages.command:pages", "all that the pages of results show, in stages"),
    "bench": Command("eval.bench.command:bench", "speed against plain code and other packages"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run an experiment; see `run_commands`."""
    return run_commands("python -m eval", "Experiments with behavioural priors.", COMMANDS, arguments)


if __name__ == "__main__":
    sys.exit(main())
