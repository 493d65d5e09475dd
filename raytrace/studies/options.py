"""Settings of studies as rows: a field is the option of a command, and part of what a run is known by. No torch."""

import argparse
import dataclasses
from collections.abc import Callable, Mapping
from typing import Self

from raytrace.cli.options import count, file_name, folder_name, positive_finite, seed_number

_READ = {int: {"type": count, "metavar": "N"}, float: {"type": positive_finite}}


def option(default, help: str, metavar: str | None = None, *, name: str = "", unit: float = 1.0, **spelling):
    """A field of settings that is an option of the command, by default --FIELD; unit: of the option, in that of the
    field; spelling: what else argparse takes.

    Whole numbers are above 0, others finite too, and a tuple takes one or more, where `type` does not say otherwise.
    The parser leaves None where the option is not given: the help ends with the default, unless it says it itself.
    """
    is_tuple = isinstance(default, tuple)
    read = {} if "choices" in spelling and not is_tuple else _READ.get(type(default[0] if is_tuple else default), {})
    usual = f"{default:g}" if isinstance(default, float) else default
    if usual not in (None, "") and "default" not in help:
        help = f"{help} (default {usual})"
    given = {"metavar": metavar} if metavar else {}
    several = {"nargs": "+"} if is_tuple else {}
    about = {"name": name, "help": help, "unit": unit}
    return dataclasses.field(default=default, metadata=about | read | several | given | spelling)


@dataclasses.dataclass(frozen=True)
class Settings:
    """All that decides the result of a run: other settings are another run."""

    seed: int = option(0, "of random numbers", type=seed_number)

    @classmethod
    def of(cls, given: Mapping, **more) -> Self:
        """Settings by options, where they were given; `more` goes before them."""
        found = {field.name: given.get(field.name) for field in dataclasses.fields(cls)}
        return read(cls, {name: value for name, value in found.items() if value is not None} | more)

    def words(self) -> list[str]:
        """What is not as by default, as options of the command."""
        given = [(field, getattr(self, field.name)) for field in dataclasses.fields(self) if field.metadata]
        return [word for field, value in given if value != field.default for word in _words(field, value)]


def _words(field: dataclasses.Field, value) -> list[str]:
    """An option as it is given."""
    name, unit = _spelled(field.name, field.metadata), field.metadata["unit"]
    if isinstance(value, bool):
        return [f"--{name}" if value else f"--no-{name}"]
    if field.metadata.get("action") == "append":
        return [f"--{name} {_text(one)}" for one in value]
    return [f"--{name} {_text(value) if unit == 1 else f'{value / unit:.12g}'}"]


def _text(value) -> str:
    if isinstance(value, tuple | list):
        return " ".join(one if isinstance(one, str) else f"{one:.12g}" for one in value)
    return str(value)


def _spelled(name: str, about: Mapping) -> str:
    return (about["name"] or name).replace("_", "-")


def read(kind: type, document: Mapping):
    """A value of plain fields as JSON has it, lists for tuples. Raises TypeError where it is not of this kind."""
    return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in document.items()})


def add_options(group, settings: type[Settings], *names: str) -> None:
    """The options of the fields of these names, of all that this kind of settings adds if none are given."""
    fields = {field.name: dict(field.metadata) for field in dataclasses.fields(settings) if field.metadata}
    for name in names or [name for name in settings.__annotations__ if name in fields]:
        spelled = _spelled(name, fields[name])
        taken = {key: value for key, value in fields[name].items() if key not in ("name", "unit")}
        group.add_argument(f"--{spelled}", dest=name, **taken)


def whole(least: int) -> Callable[[str], int]:
    """What reads whole numbers from `least` on."""

    def reader(text: str) -> int:
        found = 0 if text == "0" else count(text)
        if found < least:
            raise argparse.ArgumentTypeError(f"{text!r}: expected {least} at least")
        return found

    return reader


def pictures(parser, what: str, *names: str, settings: type[Settings] = Settings, limit: int | None = None):
    """A group of --data, --limit and the options of these names."""
    group = parser.add_argument_group("pictures")
    group.add_argument(
        "--data", metavar="DIR", type=file_name, help=f"{what} (default: dead leaves, discs that hide one another)"
    )
    usual = f" (default {limit})" if limit else ""
    group.add_argument("--limit", metavar="N", type=count, default=limit, help=f"take N of them, evenly{usual}")
    add_options(group, settings, *names)


def picture_words(arguments: argparse.Namespace, limit: int) -> list[str]:
    """--data and --limit as they were given, the folder not named; limit: the default."""
    limited = [f"--limit {arguments.limit}"] if arguments.limit != limit else []
    return [*(["--data DIR"] if arguments.data else []), *limited]


def documents(group, what: str) -> None:
    """--docs."""
    group.add_argument("--docs", metavar="DOCS", type=folder_name, help=f"folder of {what}")
