"""Test plates: the radii of a workshop's list."""

import csv
import dataclasses
import math
import os
from pathlib import Path

from raytrace.files import read_bytes
from raytrace.io.source import Place, decode
from raytrace.words import RaytraceError, did_you_mean

_LARGEST = 16 * 2**20  # bytes of a list
_COLUMNS = ("radius", "shape", "diameter", "tolerance", "name")
_SHAPES = {
    **dict.fromkeys(("convex", "cx"), ("convex",)),
    **dict.fromkeys(("concave", "cc"), ("concave",)),
    **dict.fromkeys(("", "both", "-"), ("convex", "concave")),
}


class BadPlates(RaytraceError, ValueError):
    """A list of test plates that cannot be read; the message has file, line and column."""


@dataclasses.dataclass(frozen=True)
class TestPlate:
    """A radius that a workshop tests.

    radius: mm, inf of a flat; shapes: of the glass surfaces that it tests; diameter: mm, inf where the list has none;
    tolerance: of the radius, as the list states it; name: of the plate.
    """

    __test__ = False  # no class of tests

    radius: float
    shapes: tuple[str, ...] = ("convex", "concave")
    diameter: float = math.inf
    tolerance: str = ""
    name: str = ""


def read_plates(path: str | os.PathLike) -> tuple[TestPlate, ...]:
    """The test plates of a table (.csv) with a column radius (mm; inf or 0 of a flat), and any of these:

    shape: of the glass surface that the plate tests, convex or CX, concave or CC, both by default; diameter: mm, the
    largest clear diameter that it tests; tolerance: of the radius, with its unit; name. Raises BadPlates.
    """
    try:
        text = decode(read_bytes(path, _LARGEST), Place(str(path)))
    except FileNotFoundError:
        raise BadPlates(f"{path}: no such file; expected a table of test plates with a column radius") from None
    reader = csv.reader(text.splitlines(), skipinitialspace=True)
    rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(cell.strip() for cell in row)]
    rows = [(line, row) for line, row in rows if not row[0].startswith("#")]
    if not rows:
        raise BadPlates(f"{path}: no lines; expected a heading such as radius,shape,diameter,tolerance")
    heading = [name.lower() for name in rows[0][1]]
    for name in heading:
        if name not in _COLUMNS:
            meant = did_you_mean(name, _COLUMNS)
            raise BadPlates(f"{path}:{rows[0][0]}: no column {name!r}; expected some of {', '.join(_COLUMNS)}{meant}")
    if "radius" not in heading:
        raise BadPlates(f"{path}:{rows[0][0]}: no column radius; expected some of {', '.join(_COLUMNS)}")
    plates = tuple(_plate(f"{Path(path).name}:{line}", dict(zip(heading, row, strict=False))) for line, row in rows[1:])
    if not plates:
        raise BadPlates(f"{path}: no plates below the heading")
    return plates


def _plate(where: str, row: dict[str, str]) -> TestPlate:
    def number(name: str, default: float) -> float:
        text = row.get(name, "")
        try:
            value = float(text.removesuffix("mm")) if text else default
        except ValueError:
            value = math.nan
        if not value >= 0:
            raise BadPlates(f"{where}, {name}: {text!r}; expected a length in mm, of a radius without its sign")
        return value

    shape = row.get("shape", "").lower()
    if shape not in _SHAPES:
        raise BadPlates(f"{where}, shape: {row['shape']!r}; expected convex (CX), concave (CC) or both")
    if not row.get("radius"):
        raise BadPlates(f"{where}, radius: empty; expected a length in mm, inf of a flat")
    radius = number("radius", math.nan) or math.inf
    return TestPlate(
        radius, _SHAPES[shape], number("diameter", math.inf) or math.inf, row.get("tolerance", ""), row.get("name", "")
    )
