"""The door of every command: open the lens, set the conditions asked for, refuse what cannot be traced."""

import argparse
import json
import sys
from pathlib import Path

from raytrace.files import shipped
from raytrace.io import FORMATS, read_lens, shipped_lens
from raytrace.materials.catalogs import shipped_file
from raytrace.system.lens import Lens, check_media
from raytrace.words import did_you_mean

#: Options that set the lens, by the keywords of `Lens.at`.
CONDITIONS = (
    *("sensor_distance", "f_number", "entrance_pupil_diameter", "wavelengths", "ray_aiming", "temperature", "pressure"),
)


class CommandError(ValueError):
    """Arguments that are well formed but cannot be carried out together."""


def find_lens(name: str) -> Path:
    """The file of that name, else the shipped lens of that name (with or without lenses/ and .zmx)."""
    path = Path(name)
    if path.is_dir():
        raise CommandError(f"{name}: is a directory; expected a lens file")
    if path.exists():
        return path
    if found := shipped_lens(path):
        return found
    names = sorted({lens.stem for lens in shipped("lenses").rglob("*.zmx")})
    beside = [str(file) for file in path.parent.glob("*") if file.suffix.lower() in FORMATS]
    meant = did_you_mean(name, [*names, *beside])
    raise CommandError(f"{name}: no such lens file{meant or ';'} the shipped lenses are {', '.join(names)}")


def open_lens(arguments: argparse.Namespace) -> Lens:
    """Read the lens and set the conditions that the arguments name; one object distance at a time."""
    path = find_lens(arguments.lens)
    number = getattr(arguments, "configuration", None)
    how = {"catalogs": catalogs(arguments), "substitute": getattr(arguments, "substitute", None)}
    lens = read_lens(path, **how, configuration=number if isinstance(number, int) else None)
    given = {name: getattr(arguments, name, None) for name in CONDITIONS}
    distance = getattr(arguments, "object_distances", None)
    try:
        lens = lens.at(**given, object_distance=distance if isinstance(distance, float) else None)
        check_media(lens, lens.wavelengths)
    except ValueError as error:
        raise CommandError(f"{path}: {error}") from error
    return lens


def catalogs(arguments: argparse.Namespace) -> tuple[Path, ...]:
    """The glass catalogs of --catalog, files or names of shipped ones; a missing one is refused here."""
    paths = tuple(_catalog(name) for name in arguments.catalog)
    for path in paths:
        if not path.is_file():
            raise CommandError(f"{path}: no such glass catalog; expected an .agf file after --catalog")
    return paths


def _catalog(name: str) -> Path:
    path = Path(name)
    return path if path.suffix or path.exists() else shipped_file(name) or path


def refuse_suffix(option: str, path: str | None, known: tuple[str, ...]) -> None:
    """Raise CommandError for the name of a file, if one is given, with another suffix than the known ones."""
    if path and Path(path).suffix.lower() not in known:
        raise CommandError(f"{option} {path}: expected a name that ends in {', '.join(filter(None, known))}")


def print_json(document: dict) -> None:
    """Write one JSON document to standard output."""
    print(json.dumps(document, indent=2, allow_nan=False))


def say(message: str) -> None:
    """One line for people, beside the results: to standard error."""
    print(f"raytrace: {message}", file=sys.stderr)
