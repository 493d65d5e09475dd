"""Settings as options: a row for each field that a command takes, with its help text. Imports no torch.

A command passes its rows, {field: option(...)}, with the dataclass of settings: defaults are those of the fields.
"""

import argparse
import dataclasses
import json
import textwrap
import tomllib
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from raytrace.cli.options import with_default
from raytrace.cli.types import count, file_name, folder_name, positive_finite, seed_number
from raytrace.settings import Settings
from raytrace.words import RaytraceError, did_you_mean


def option(
    help: str, metavar: str | None = None, *, name: str = "", unit: float = 1.0, between: str = " ", **spelling: Any
) -> dict:
    """A row: help text and the arguments of argparse; name: if it is not that of the field; unit: of the option, in
    units of the field; between: numbers of a field of several. Without `type`, whole numbers are positive, other
    numbers positive and finite."""
    return (
        {"help": help, "name": name, "unit": unit, "between": between}
        | ({"metavar": metavar} if metavar else {})
        | spelling
    )


#: Arguments of `add_argument` by the type of a field.
_KINDS: dict[type, dict] = {
    bool: {"action": "store_true"},
    int: {"type": count, "metavar": "N"},
    float: {"type": positive_finite},
    tuple: {"type": positive_finite, "nargs": "+"},
}
SEED = option("of random numbers", type=seed_number)


def add_options(
    group: argparse._ActionsContainer, defaults: Mapping, rows: Mapping[str, Mapping], *names: str, hidden: bool = False
) -> None:
    """Add the options of these fields, of all rows if none are given. The parser stores None for a missing option.

    hidden: without a help text, for settings that a file gives.
    """
    for name in names or rows:
        row, default = dict(rows[name]), defaults[name]
        flag = f"--{_spelled(name, row)}"
        del row["name"], row["unit"], row["between"]
        settings = _KINDS.get(type(default), {}) | row
        if "action" not in settings:
            settings["help"] = with_default(row["help"], default)
        if hidden:
            settings["help"] = argparse.SUPPRESS
        group.add_argument(flag, dest=name, **{key: value for key, value in settings.items() if value is not None})


# -- settings from a file ----------------------------------------------------------------------------------------------

#: Entries of a run's settings.json that are no settings: what else decides its result.
_OF_RUNS = ("lens", "pictures", "part", "world")


class BadSettings(RaytraceError, ValueError):
    """A file of settings that cannot be read, or an entry that is no setting."""


def settings_options(group: argparse._ActionsContainer, kind: type) -> None:
    """--settings and --set."""
    group.add_argument(
        "--settings",
        metavar="FILE",
        type=file_name,
        help="settings of a TOML file, or of the settings.json of a run; other options override them",
    )
    example = next(field.name for field in dataclasses.fields(kind) if isinstance(field.default, float))
    group.add_argument(
        "--set",
        metavar="NAME=VALUE",
        nargs="+",
        default=[],
        help=f"single settings, {example}={defaults_of(kind)[example]:g}: every name of the list below",
    )


def listed(kind: type, rows: Mapping[str, Mapping]) -> str:
    """The settings with their defaults and texts, for the end of a help page."""
    lines = []
    for name, default in defaults_of(kind).items():
        about = rows[name]["help"].replace("%%", "%") if name in rows else ""
        text = f"{name} = {_text(default, ' ') or '-'}" + (f": {about}" if about else "")
        lines.append(textwrap.fill(text, 100, initial_indent="  ", subsequent_indent="      "))
    return "\n".join(["settings, of --settings and --set:", *lines])


def given_settings(arguments: argparse.Namespace, kind: type[Settings]) -> dict:
    """The settings of --settings and --set, by their names. Raises BadSettings."""
    given = {} if arguments.settings is None else _of_file(arguments.settings, kind)
    for words in arguments.set:
        name, is_given, text = words.partition("=")
        if not is_given:
            raise BadSettings(f"--set {words}: expected NAME=VALUE")
        try:
            entry = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            entry = text
        given[name] = _checked(kind, name, entry, "--set")
    return given


def _of_file(path: str, kind: type[Settings]) -> dict:
    """Settings of a TOML file, whose tables only group them, or of a run's settings.json."""
    is_of_run = Path(path).suffix.lower() == ".json"
    try:
        text = Path(path).read_text(encoding="utf-8")
        document = json.loads(text) if is_of_run else tomllib.loads(text)
    except OSError as error:
        raise BadSettings(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise BadSettings(f"{path}: no TOML, and no JSON of a run ({error})") from error
    if not isinstance(document, dict):
        raise BadSettings(f"{path}: expected settings by their names")
    entries: dict[str, object] = {**kind.UNRECORDED} if is_of_run else {}
    for name, entry in document.items():
        if name not in _OF_RUNS:
            entries |= entry if isinstance(entry, dict) else {name: entry}
    return {name: _checked(kind, name, entry, path) for name, entry in entries.items()}


def _checked(kind: type, name: str, entry: object, where: str) -> object:
    """A setting in the type of its field; whole numbers are numbers, lists of numbers tuples. Raises BadSettings."""
    hints = typing.get_type_hints(kind)
    if name not in hints:
        raise BadSettings(f"{where}: {name!r} is no setting{did_you_mean(name, hints)}")
    hint = hints[name]
    kinds = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    for wanted in kinds:
        origin = typing.get_origin(wanted) or wanted
        if origin is typing.Literal:
            if entry in typing.get_args(wanted):
                return entry
        elif origin is tuple and isinstance(entry, Sequence) and not isinstance(entry, str):
            if all(isinstance(number, int | float) for number in entry):
                return tuple(map(float, entry))
        elif origin is float and isinstance(entry, int) and not isinstance(entry, bool):
            return float(entry)
        elif isinstance(entry, origin) and not (origin is int and isinstance(entry, bool)):
            return entry
    choices = typing.get_args(hint) if typing.get_origin(hint) is typing.Literal else ()
    expected = " or ".join(map(repr, choices) if choices else (getattr(kind, "__name__", str(kind)) for kind in kinds))
    raise BadSettings(f"{where}: {name} = {entry!r}: expected {expected}")


def words(settings: Settings, rows: Mapping[str, Mapping]) -> list[str]:
    """The settings that differ from their defaults, as options of the command."""
    defaults, options = defaults_of(type(settings)), []
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if field.name not in rows or value == defaults[field.name]:
            continue
        name, unit = _spelled(field.name, rows[field.name]), rows[field.name]["unit"]
        if value is True:
            options.append(f"--{name}")
            continue
        between = rows[field.name]["between"]
        options.append(f"--{name} {_text(value, between) if unit == 1 else f'{value / unit:.12g}'}")
    return options


def defaults_of(kind: type) -> dict:
    """Default of every field of a dataclass."""
    return {field.name: field.default for field in dataclasses.fields(kind)}


def _spelled(name: str, row: Mapping) -> str:
    return (row["name"] or name).replace("_", "-")


def _text(value: object, between: str) -> str:
    if isinstance(value, tuple | list):
        return between.join(entry if isinstance(entry, str) else f"{entry:.12g}" for entry in value)
    return str(value)


def picture_options(
    parser: argparse.ArgumentParser, content: str, *, limit: int | None = None
) -> argparse._ActionsContainer:
    """Add a group with --data and --limit, and return it; content: of the folder."""
    group = parser.add_argument_group("pictures")
    group.add_argument("--data", metavar="DIR", type=file_name, help=f"{content} (default: dead-leaves images)")
    usual = f" (default {limit})" if limit else ""
    group.add_argument("--limit", metavar="N", type=count, default=limit, help=f"use N of them, evenly spaced{usual}")
    return group


def picture_words(arguments: argparse.Namespace, limit: int) -> list[str]:
    """--data and --limit as options, the folder not named; limit: the default."""
    limited = [f"--limit {arguments.limit}"] if arguments.limit != limit else []
    return [*(["--data DIR"] if arguments.data else []), *limited]


def documents(group: argparse._ActionsContainer, content: str) -> None:
    """--docs."""
    group.add_argument("--docs", metavar="DOCS", type=folder_name, help=f"folder of {content}")
