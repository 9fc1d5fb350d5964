"""Entry point: `python -m eval paper` and the other commands."""

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; bad input gives one line on stderr and exit code 2, Ctrl-C one line and 130.

    Args:
        arguments: of the command line; None: those of the process. Dashes and underscores in option names are the same.

    Returns:
        The exit code.
    """
    try:
        return _run(sys.argv[1:] if arguments is None else arguments)
    except KeyboardInterrupt:
        return _fail("interrupted; what was not yet written is lost", 130)
    except (ValueError, OSError, MemoryError, OverflowError) as error:
        return _fail(f"error: {error}", 2)
    except RuntimeError as error:
        # torch has no exception of its own for memory that it could not get.
        if "memory" not in str(error):
            raise
        return _fail(f"error: out of memory; a smaller run may fit ({str(error).splitlines()[0]})", 2)


def _run(arguments: Sequence[str]) -> int:
    # Imported here, so that Ctrl-C is answered while the libraries load too.
    from jsonargparse import ArgumentError, ArgumentParser

    from eval.bench import bench
    from eval.paper import paper

    about = "Compare behavioural priors. Dashes and underscores in option names are the same."
    parser = ArgumentParser(prog="python -m eval", description=about, exit_on_error=False)
    commands = parser.add_subcommands()
    by_name = {"paper": paper, "bench": bench}
    for name, command in by_name.items():
        sub = ArgumentParser(description=(command.__doc__ or "").split("\n")[0], exit_on_error=False)
        sub.add_function_arguments(command, as_group=False)
        commands.add_subcommand(name, sub)
    try:
        settings = parser.parse_args([_with_underscores(argument) for argument in arguments])
    except ArgumentError as error:
        raise ValueError(str(error)) from error
    by_name[settings.subcommand](**settings[settings.subcommand].as_dict())
    return 0


def _with_underscores(argument: str) -> str:
    if not argument.startswith("--"):
        return argument
    name, equals, value = argument.partition("=")
    return "--" + name[2:].replace("-", "_") + equals + value


def _fail(message: str, code: int) -> int:
    print(" ".join(message.split()), file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
