"""Options of commands for how recordings are read."""

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from neuroprior.behaviour.reading import Columns, Options

T = TypeVar("T", bound=Options)

SPELLED = {"from_": "from"}
"""Options whose names would be keywords of Python, as a command line spells them."""


def add_reading_arguments(parser: Any, kind: type[Options]) -> None:
    """Add an option to a parser of jsonargparse for each field of `kind` and, as `--columns.NAME`, of `Columns`."""
    texts = _describe_attributes(Columns)
    for field in fields(Columns):
        parser.add_argument(f"--columns.{field.name}", nargs="+", type=str, default=None, help=texts[field.name])
    texts, hints = _describe_attributes(kind) | _describe_attributes(Options), get_type_hints(kind)
    for field in fields(kind):
        if field.name == "columns":
            continue
        hint, text = hints[field.name], texts[field.name]
        flag = f"--{SPELLED.get(field.name, field.name)}"
        if get_origin(hint) is Mapping:
            parser.add_argument(flag, nargs="+", type=str, default=None, help=f"{text} As OLD=NEW.")
        elif Sequence in {get_origin(one) for one in (hint, *get_args(hint))}:
            parser.add_argument(flag, nargs="*", type=str, default=None, help=text)
        else:
            parser.add_argument(flag, type=hint, default=field.default, help=text)


def _describe_attributes(kind: type) -> dict[str, str]:
    """Return what the docstring of a class says of each attribute."""
    from docstring_parser import parse

    entries = parse(inspect.getdoc(kind) or "").params
    entry_of = {name.strip(): entry for entry in entries for name in entry.arg_name.split(",")}
    return {name: " ".join((entry.description or "").split()).capitalize() for name, entry in entry_of.items()}


def pop_reading(settings: dict[str, Any], kind: type[T]) -> T:
    """Take what `add_reading_arguments` added out of the settings of a command, and return the options.

    Raises:
        ValueError: an option is out of range.
    """
    columns = {use: names[0] if len(names) == 1 else names for use, names in settings.pop("columns").items() if names}
    options: dict[str, Any] = {"columns": columns}
    for field in fields(kind):
        value = settings.pop(SPELLED.get(field.name, field.name), None)
        if value is not None:
            options[field.name] = _parse_pairs(field.name, value) if field.name in ("words", "rename") else value
    return kind(**options)


def _parse_pairs(name: str, texts: Sequence[str]) -> dict[str, str]:
    if wrong := [text for text in texts if "=" not in text]:
        raise ValueError(f"`{name}` must be OLD=NEW, got {wrong[0]!r}")
    return {old: new for old, _, new in (text.partition("=") for text in texts)}


def reading_words(options: Options) -> list[str]:
    """Return options as words of a command line, without those at their defaults."""
    words: list[str] = []
    assert isinstance(options.columns, Columns)
    for use, names in options.columns.named().items():
        words += [f"--columns.{use}", *names]
    defaults = Options()
    for field in fields(Options):
        value = getattr(options, field.name)
        if field.name == "columns" or value == getattr(defaults, field.name):
            continue
        flag = f"--{SPELLED.get(field.name, field.name)}"
        if isinstance(value, Mapping):
            words += [flag, *(f"{old}={new}" for old, new in value.items())]
        elif isinstance(value, Sequence) and not isinstance(value, str):
            words += [flag, *value]
        else:
            words += [flag, str(value).lower() if isinstance(value, bool) else str(value)]
    return words
