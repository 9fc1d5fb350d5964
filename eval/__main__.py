"""Entry point: `python -m eval paper` and the other commands."""

import sys
from collections.abc import Sequence

from jsonargparse import ArgumentParser, Namespace

from eval.bench import bench
from eval.paper import paper

COMMANDS = {"paper": paper, "bench": bench}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; bad input gives one line on stderr and exit code 2.

    Args:
        arguments: of the command line; None: those of the process. Dashes and underscores in option names are the same.

    Returns:
        The exit code.
    """
    given = [_with_underscores(argument) for argument in (sys.argv[1:] if arguments is None else arguments)]
    parser = ArgumentParser(prog="python -m eval", description="Compare behavioural priors.", exit_on_error=False)
    commands = parser.add_subcommands()
    for name, command in COMMANDS.items():
        sub = ArgumentParser(description=(command.__doc__ or "").split("\n")[0], exit_on_error=False)
        sub.add_function_arguments(command, as_group=False)
        commands.add_subcommand(name, sub)
    try:
        settings = parser.parse_args(given)
        name = settings.subcommand
        if name is None:
            parser.print_help()
            return 2
        chosen: Namespace = settings[name]
        COMMANDS[name](**chosen.as_dict())
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except (ValueError, OSError) as error:
        return _fail(error)
    except Exception as error:
        if type(error).__name__ != "ArgumentError":
            raise
        return _fail(error)
    return 0


def _with_underscores(argument: str) -> str:
    if not argument.startswith("--"):
        return argument
    name, equals, value = argument.partition("=")
    return "--" + name[2:].replace("-", "_") + equals + value


def _fail(error: Exception) -> int:
    print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
