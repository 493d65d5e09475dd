"""Settings as options: a row for each field that a command takes, with its help text. Imports no torch.

A command passes its rows, {field: option(...)}, with the dataclass of settings: defaults are those of the fields.
"""

import argparse
import dataclasses
from collections.abc import Mapping

from raytrace.cli.options import with_default
from raytrace.cli.types import count, file_name, folder_name, positive_finite, seed_number


def option(
    help: str, metavar: str | None = None, *, name: str = "", unit: float = 1.0, between: str = " ", **spelling
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


def add_options(group, defaults: Mapping, rows: Mapping[str, Mapping], *names: str) -> None:
    """Add the options of these fields, of all rows if none are given. The parser stores None for a missing option."""
    for name in names or rows:
        row, default = dict(rows[name]), defaults[name]
        flag = f"--{_spelled(name, row)}"
        del row["name"], row["unit"], row["between"]
        settings = _KINDS.get(type(default), {}) | row
        if "action" not in settings:
            settings["help"] = with_default(row["help"], default)
        group.add_argument(flag, dest=name, **{key: value for key, value in settings.items() if value is not None})


def words(settings, rows: Mapping[str, Mapping]) -> list[str]:
    """The settings that differ from their defaults, as options of the command."""
    defaults, found = defaults_of(type(settings)), []
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if field.name not in rows or value == defaults[field.name]:
            continue
        name, unit = _spelled(field.name, rows[field.name]), rows[field.name]["unit"]
        if value is True:
            found.append(f"--{name}")
            continue
        between = rows[field.name]["between"]
        found.append(f"--{name} {_text(value, between) if unit == 1 else f'{value / unit:.12g}'}")
    return found


def defaults_of(kind: type) -> dict:
    """Default of every field of a dataclass."""
    return {field.name: field.default for field in dataclasses.fields(kind)}


def _spelled(name: str, row: Mapping) -> str:
    return (row["name"] or name).replace("_", "-")


def _text(value, between: str) -> str:
    if isinstance(value, tuple | list):
        return between.join(entry if isinstance(entry, str) else f"{entry:.12g}" for entry in value)
    return str(value)


def picture_options(parser, content: str, *, limit: int | None = None):
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


def documents(group, content: str) -> None:
    """--docs."""
    group.add_argument("--docs", metavar="DOCS", type=folder_name, help=f"folder of {content}")
