"""The door of every command: open the lens, set the conditions asked for, refuse what cannot be traced."""

import argparse
import dataclasses
import json
import sys
from pathlib import Path

import torch
from torch import Tensor

from raytrace.files import shipped
from raytrace.formats import FORMATS, read_lens, shipped_lens
from raytrace.system.lens import (
    Lens,
    SystemAperture,
    check,
    check_media,
    with_object_distance,
    with_sensor_distance,
    with_wavelengths,
)
from raytrace.words import did_you_mean


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
    names = sorted({lens.stem for lens in shipped("lenses").glob("*.zmx")})
    beside = [str(file) for file in path.parent.glob("*") if file.suffix.lower() in FORMATS]
    meant = did_you_mean(name, [*names, *beside])
    raise CommandError(f"{name}: no such lens file{meant or ';'} the shipped lenses are {', '.join(names)}")


def open_lens(arguments: argparse.Namespace) -> Lens:
    """Read the lens and set the conditions that the arguments name."""
    path = find_lens(arguments.lens)
    lens = read_lens(path, catalogs=catalogs(arguments))
    wavelengths = getattr(arguments, "wavelengths", None)
    if wavelengths:
        lens = with_wavelengths(lens, wavelengths, where=str(path))
    if getattr(arguments, "f_number", None):
        lens = _with_aperture(lens, "image_f_number", arguments.f_number)
    if getattr(arguments, "entrance_pupil_diameter", None):
        lens = _with_aperture(lens, "entrance_pupil_diameter", arguments.entrance_pupil_diameter)
    distance = getattr(arguments, "object_distances", None)
    if isinstance(distance, float):
        lens = with_object_distance(lens, distance)
    if getattr(arguments, "sensor_distance", None) is not None:
        lens = with_sensor_distance(lens, arguments.sensor_distance)
    refuse_untraceable(lens, str(path))
    check_media(lens, lens.wavelengths, where=str(path))
    return lens


def refuse_untraceable(lens: Lens, path: str) -> None:
    """Raise for a lens that makes no sense as a whole."""
    try:
        check(lens)
    except ValueError as error:
        raise CommandError(f"{path}: {error}") from error


def catalogs(arguments: argparse.Namespace) -> tuple[Path, ...]:
    """The glass catalogs of --catalog; a missing one is refused here."""
    paths = tuple(Path(name) for name in arguments.catalog)
    for path in paths:
        if not path.is_file():
            raise CommandError(f"{path}: no such glass catalog; expected an .agf file after --catalog")
    return paths


def field_points(lens: Lens, arguments: argparse.Namespace, *, on_axis: bool = False) -> Tensor:
    """(2, F) field points: those of --field, else the axis alone or the lens's own."""
    given = getattr(arguments, "fields", None)
    if given:
        for angle in (angle for point in given for angle in point):
            if lens.fields.kind == "angle" and abs(angle) >= 90:
                raise CommandError(
                    f"--field {angle:g}: a field angle is below 90 degrees, for rays start from the plane "
                    "of the entrance pupil"
                )
        return lens.fields.y.new_tensor(given).T
    if on_axis:
        return lens.fields.y.new_zeros(2, 1)
    return torch.stack([lens.fields.x, lens.fields.y])


def ray_aiming(arguments: argparse.Namespace) -> str | None:
    """--ray-aiming as the library takes it: None leaves it to the file."""
    return None if arguments.ray_aiming == "file" else arguments.ray_aiming


def primary(lens: Lens) -> Tensor:
    """The primary wavelength, µm."""
    return lens.wavelengths[lens.primary_wavelength]


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


def _with_aperture(lens: Lens, kind: str, value: float) -> Lens:
    number = torch.as_tensor(value, dtype=lens.aperture.value.dtype)
    return dataclasses.replace(lens, aperture=SystemAperture(kind, number))
