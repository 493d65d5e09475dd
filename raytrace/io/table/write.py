"""Write a lens as a prescription table, every number with the digits that bring it back exactly."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from raytrace.io.assembly import is_code, is_left_out, is_listed, listed_name
from raytrace.io.source import LensFileError, Place, exact, exact_list, quoted, refuse_sag_terms, thickness
from raytrace.io.table.columns import order
from raytrace.io.table.system import ENVIRONMENT, written, written_environment
from raytrace.materials.glass import Glass, mil_glass
from raytrace.system.apertures import Aperture
from raytrace.system.lens import Lens
from raytrace.system.shapes import KINDS
from raytrace.system.surface import SIZES, Surface


def write(lens: Lens, file: str, *, catalogs: Sequence[Path] = (), separator: str = ",") -> bytes:
    """The content of a table: header lines '# key: value', headings, one row per surface; UTF-8.

    file: its name, for messages. catalogs: the user's glass catalogs that the lens was read with.
    Raises LensFileError for data that a table cannot hold: a batch of lenses, nan, a glass whose coefficients are not
    those of its catalog. All texts come back (`source.quoted`).
    """
    text = io.StringIO()
    for key, value in written(lens, Place(file), catalogs):
        text.write(f"# {key}: {value}\n")
    writer = csv.writer(text, delimiter=separator, lineterminator="\n")
    columns = rows(lens, file)
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue().encode("utf-8")


def rows(lens: Lens, file: str) -> dict[str, list[str]]:
    """The columns of the table by heading; columns that would be empty are left out."""
    listed = [_row(lens, k, surface, Place(file, None, k)) for k, surface in enumerate(lens.surfaces)]
    powers = sorted({n for row in listed for name in row if (n := order(name)) is not None})
    names = [
        "conic",
        "semi_diameter",
        *(f"a{n}" for n in powers),
        "apertures",
        *SIZES[1:],
        *ENVIRONMENT,
        "expansion",
        "comment",
    ]
    used = [name for name in names if any(name in row for row in listed)]
    always = ["surface", "type", "curvature", "thickness", "glass"]
    return {name: [row.get(name, "") for row in listed] for name in always + used}


def _row(lens: Lens, number: int, surface: Surface, place: Place) -> dict[str, str]:
    refuse_sag_terms(surface, place)
    last = len(lens.surfaces) - 1
    kind = None if surface.coefficients is None else KINDS[surface.kind]
    roles = [name for k, name in ((0, "object"), (lens.stop, "stop"), (last, "image")) if k == number]
    row = {
        "surface": str(number),
        "type": ", ".join([*roles, *([kind.name] if kind else [])]) or "standard",
        "curvature": exact(surface.curvature, "curvature", place),
        "thickness": thickness(surface.thickness, "inf", place),
        "glass": _glass(surface.glass, place),
    }
    if surface.conic is not None:
        row["conic"] = exact(surface.conic, "conic constant", place)
    sizes = {name: size for name in SIZES if (size := getattr(surface, name)) is not None}
    row |= {name: exact(size, name.replace("_", " "), place) for name, size in sizes.items()}
    if kind is not None and surface.coefficients is not None:
        terms = exact_list(surface.coefficients, "aspheric terms", place)
        row |= {f"a{kind.step * j}": term for j, term in enumerate(terms, 1)}
    if surface.apertures:
        row["apertures"] = " + ".join(_aperture(aperture, place) for aperture in surface.apertures)
    row |= written_environment(surface.environment, place)
    if surface.expansion is not None:
        row["expansion"] = exact(surface.expansion, "thermal expansion", place)
    return row | {"comment": quoted(surface.comment)} if surface.comment else row


def _glass(glass: Glass, place: Place) -> str:
    if is_left_out(glass):
        return ""
    if glass.formula == "mirror":
        return "MIRROR"
    name = listed_name(glass, place) if glass.name else ""
    if is_listed(glass):
        return name
    figures = exact_list(glass.coefficients, "glass", place)
    if is_code(name) and figures == exact_list(mil_glass(name).coefficients, "glass", place):
        return name
    if "=" in name:
        raise LensFileError(f"the name {name!r} of a glass holds '=', which a table cannot hold", place)
    return f"{name}={'/'.join(figures)}" if name else "/".join(figures)


def _aperture(aperture: Aperture, place: Place) -> str:
    words = ["obscuration"] if aperture.obscures else []
    words += [aperture.shape, *(exact(size, "size of the aperture", place) for size in aperture.extent)]
    if any(aperture.centre):
        words += ["at", *(exact(part, "centre of the aperture", place) for part in aperture.centre)]
    return " ".join(words)
