"""Entry point: `python -m eval paper` and the other commands."""

import sys
from collections.abc import Sequence
from typing import Any

from neuroprior.cli.program import run_program


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; see `run_program`."""
    return run_program(_run, arguments)


def _run(arguments: Sequence[str]) -> None:
    # Imported here, so that Ctrl-C is answered while the libraries load too.
    from jsonargparse import ArgumentError, ArgumentParser

    from eval.bench.command import LISTS as BENCH_LISTS
    from eval.bench.command import bench
    from eval.compare.command import LISTS as COMPARE_LISTS
    from eval.compare.command import compare
    from eval.compare.depth import LISTS as DEPTH_LISTS
    from eval.compare.depth import depth
    from eval.compare.growth import LISTS as GROW_LISTS
    from eval.compare.growth import grow
    from eval.live.command import LISTS as LIVE_LISTS
    from eval.live.command import live
    from eval.mice.command import LISTS as MICE_LISTS
    from eval.mice.command import mice
    from eval.paper.command import paper
    from eval.quality.command import quality
    from neuroprior.report.command import plans
    from neuroprior.report.plan_report import INPUTS, MODELS

    about = "Compare behavioural priors. Dashes and underscores in option names are the same."
    parser = ArgumentParser(prog="python -m eval", description=about, exit_on_error=False, allow_abbrev=True)
    commands = parser.add_subcommands()
    by_name = {"paper": paper, "bench": bench, "plans": plans, "quality": quality, "mice": mice}
    by_name |= {"compare": compare, "grow": grow, "live": live, "depth": depth}
    # Lists are given as words, `--priors a b`, which functions cannot say.
    numbers = {key: {"type": int, "default": [*some], "help": what} for key, (some, what) in MICE_LISTS.items()}
    of_plans: dict[str, dict[str, Any]] = {
        "priors": {},
        "models": {"default": [*MODELS[:4]], "choices": MODELS},
        "inputs": {"default": [*INPUTS], "choices": INPUTS},
        "action_names": {},
    }
    lists: dict[str, dict[str, dict[str, Any]]] = {"mice": numbers, "plans": of_plans}
    lists |= {
        "compare": COMPARE_LISTS,
        "grow": GROW_LISTS,
        "bench": BENCH_LISTS,
        "live": LIVE_LISTS,
        "depth": DEPTH_LISTS,
    }
    for name, command in by_name.items():
        sub = ArgumentParser(description=(command.__doc__ or "").split("\n")[0], exit_on_error=False, allow_abbrev=True)
        own = lists.get(name, {})
        sub.add_function_arguments(command, as_group=False, as_positional=True, skip=set(own))
        for option, how in own.items():
            sub.add_argument(f"--{option}", nargs="+", **how)
        commands.add_subcommand(name, sub)
    try:
        settings = parser.parse_args(list(arguments))
    except ArgumentError as error:
        raise ValueError(str(error)) from error
    by_name[settings.subcommand](**settings[settings.subcommand].as_dict())


if __name__ == "__main__":
    sys.exit(main())
