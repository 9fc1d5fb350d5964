"""What the programs share: commands from functions, one line for bad input (exit code 2), one for Ctrl-C (130)."""

import inspect
import signal
import sys
import threading
from argparse import ArgumentError
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext
from importlib import import_module
from textwrap import shorten
from types import NoneType, UnionType
from typing import Any, NamedTuple, Union, get_args, get_origin, get_type_hints

from neuroprior._interrupts import ending_at_interrupts
from neuroprior._jobs import saying
from neuroprior._version import __version__
from neuroprior.behaviour.reading import Options
from neuroprior.cli.reading import add_reading_arguments, pop_reading

LONGEST_MESSAGE = 1000
"""Characters of an error at most: parsers may quote a whole file."""


class Command(NamedTuple):
    """A command of a program.

    Attributes:
        target: `module:function`, imported only when the command is given.
        about: one line for the list of commands.
        raw: the function parses its arguments itself: it is called with the list of them.
        slow: it works for minutes, so that it says something where importing it takes long, too.
    """

    target: str
    about: str
    raw: bool = False
    slow: bool = False

    def load(self) -> Callable[..., Any]:
        """Import the function."""
        module, _, name = self.target.partition(":")
        with ending_at_interrupts():
            function: Callable[..., Any] = getattr(import_module(module), name)
        return function


def run_commands(
    program: str, about: str, commands: Mapping[str, Command], arguments: Sequence[str] | None = None
) -> int:
    """Run one of several commands, each a function whose parameters are its options; see `run_program`.

    Args:
        program: its name, as a user types it.
        about: what it is for.
        commands: by name.
        arguments: of the command line; None: those of the process.

    Returns:
        The exit code.
    """

    def run(words: Sequence[str]) -> None:
        if not words or words[0] in ("-h", "--help"):
            wide = max(map(len, commands))
            lines = [f"  {name:{wide}}  {command.about}" for name, command in commands.items()]
            print(f"usage: {program} COMMAND ...\n\n{about}\n\ncommands:")
            print("\n".join(lines) + f"\n\n{program} COMMAND --help lists the options of a command.")
            return
        if words[0] == "--version":
            print(f"neuroprior {__version__}")
            return
        name, *options = words
        if name not in commands:
            raise ValueError(f"{name!r} is no command; there are {', '.join(commands)}")
        command = commands[name]
        with saying(f"{program} {name}: starting") if command.slow else nullcontext():
            function = command.load()
        if command.raw:
            function(options)
        else:
            call(function, f"{program} {name}", options)

    return run_program(run, arguments)


def call(function: Callable[..., Any], program: str, arguments: Sequence[str]) -> Any:
    """Call a function with the arguments of a command line.

    Args:
        function: with type hints and a docstring in Google style.
        program: what a user types before the options.
        arguments: what was typed behind it.

    Returns:
        What the function returns.

    Raises:
        argparse.ArgumentError: an argument is not known or not of its type.
    """
    parser, reading = make_parser(function, program), _reading_of(function)
    if reading is not None:
        add_reading_arguments(parser, reading[1])
    settings = parser.parse_args(list(arguments)).as_dict()
    options = {} if reading is None else {reading[0]: pop_reading(settings, reading[1])}
    return function(**{name: _plain(value) for name, value in settings.items()}, **options)


def _reading_of(function: Callable[..., Any]) -> tuple[str, type[Options]] | None:
    """Return the parameter that says how recordings are read, and its class; each of its fields is an option."""
    hints = get_type_hints(function).items()
    return next(((name, hint) for name, hint in hints if isinstance(hint, type) and issubclass(hint, Options)), None)


def make_parser(function: Callable[..., Any], program: str, skip: Collection[str] = ()) -> Any:
    """Return the parser (jsonargparse's) of the parameters of a function.

    Each parameter is an option, and one without a default a positional argument. Its type hint says what may be given,
    and the docstring what it means. A parameter that is a list takes several words: `--worlds grid maze`.

    Args:
        function: with type hints and a docstring in Google style.
        program: what a user types before the options.
        skip: parameters that are no options.
    """
    from docstring_parser import parse
    from jsonargparse import ArgumentParser

    described = parse(inspect.getdoc(function) or "")
    texts = {entry.arg_name: " ".join((entry.description or "").split()) for entry in described.params}
    about = f"{described.short_description or ''} Options may be written with hyphens for underscores."
    parser = ArgumentParser(prog=program, description=about, exit_on_error=False, allow_abbrev=True)
    items = {name: item for name, hint in get_type_hints(function).items() if (item := _item_of(hint)) is not None}
    reading = _reading_of(function)
    skipped = {*items, *skip, *(reading[:1] if reading else ())}
    parser.add_function_arguments(function, as_group=False, as_positional=True, skip=skipped)
    for name, item in items.items():
        if name in skip:
            continue
        default = inspect.signature(function).parameters[name].default
        if default is inspect.Parameter.empty:
            parser.add_argument(name, type=item, nargs="+", help=texts.get(name, "").capitalize())
            continue
        default = list(default) if isinstance(default, list | tuple) else default
        parser.add_argument(f"--{name}", type=item, nargs="+", default=default, help=texts.get(name, "").capitalize())
    return parser


def _plain(value: Any) -> Any:
    """A value without the parser's own types, which other processes could not read."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return next((kind(value) for kind in (int, float) if isinstance(value, kind) and type(value) is not bool), value)


def _item_of(hint: Any) -> Any:
    """The type of the items of a list, or of a list that may be None; None for other types."""
    options = [option for option in get_args(hint) if option is not NoneType]
    if get_origin(hint) in (Union, UnionType) and len(options) == 1:
        hint = options[0]
    return get_args(hint)[0] if get_origin(hint) in (list, Sequence) else None


def run_program(run: Callable[[Sequence[str]], None], arguments: Sequence[str] | None = None) -> int:
    """Run a program with arguments.

    Args:
        run: does the work; raises ValueError or OSError on bad input.
        arguments: of the command line; None: those of the process. Dashes and underscores in option names are the same.

    Returns:
        The exit code.
    """
    words = sys.argv[1:] if arguments is None else arguments
    main, before = threading.current_thread() is threading.main_thread(), signal.getsignal(signal.SIGTERM)
    if main and before == signal.SIG_DFL:
        # Where time is up, a cluster ends a program by this signal: it says what is saved, as after Ctrl-C.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        run([_with_underscores(argument) for argument in words])
    except KeyboardInterrupt as interrupted:
        # An impatient second Ctrl-C should not spoil the message.
        if main:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        return _fail(str(interrupted) or "interrupted; what was not yet written is lost", 130)
    except BrokenPipeError:
        # The reader of our output, such as `head`, has enough.
        sys.stderr.close()
        return 0
    except OSError as error:
        if error.filename is None or error.strerror is None:
            return _fail(f"error: {error}", 2)
        return _fail(f"error: {error.filename}: {error.strerror.lower()}", 2)
    except (ValueError, MemoryError, OverflowError, ImportError, ArgumentError) as error:
        return _fail(f"error: {error}", 2)
    except RuntimeError as error:
        # torch has no exception of its own for memory that it could not get.
        if "memory" not in str(error):
            raise
        return _fail(f"error: out of memory; a smaller run may fit ({str(error).splitlines()[0]})", 2)
    finally:
        if main and before == signal.SIG_DFL:
            signal.signal(signal.SIGTERM, before)
    return 0


def _with_underscores(argument: str) -> str:
    if not argument.startswith("--"):
        return argument
    name, equals, value = argument.partition("=")
    return "--" + name[2:].replace("-", "_") + equals + value


def _fail(message: str, code: int) -> int:
    print(shorten(message, LONGEST_MESSAGE, placeholder=" ..."), file=sys.stderr)
    return code
