"""A surface of a .zmx file as a `Surface`: shape, medium and aperture.

PARM, XDAT and SCBD of a surface of a .zmx file: the numbers of its type, and the poses of its axes.
"""

from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from raytrace.io.materials import by_figures, is_code, listed_glass
from raytrace.io.report import Draft
from raytrace.io.source import LensFileError, UnsupportedSurface, shown
from raytrace.io.spelling import double, is_infinite
from raytrace.io.zemax.keywords import TYPE_NAMES, Block, Record, aperture_keywords, glass_source, is_blank
from raytrace.io.zemax.numbers import INVERSE, Numbers, SurfaceType, inverse, order_is_known, pose_of
from raytrace.io.zemax.surface_types import types
from raytrace.materials.catalogs import Catalog
from raytrace.materials.glass import AIR, MIRROR, Glass, mil_glass
from raytrace.system.apertures import SHAPES, Aperture
from raytrace.system.poses import Pose
from raytrace.system.surface import Surface

#: XDAT 1 and 2 are the number of terms and their radius.
_FIRST_TERM = 3

#: In place of 1 and 2, before and after the surface, SCBD tells with this of a coordinate return, whose solved values
#: stand in PARM and DISZ.
_RETURN = 3


def numbers(block: Block, row: SurfaceType, millimetres: float) -> Numbers:
    """What the type of a surface is told by, in mm; nothing of it is reported."""
    parameters = {}
    for record in block.all("PARM"):
        j = record.integer(0, "number of the parameter")
        value = record.number(1, "value")
        if j in row.parameters:
            parameters[j] = _in_mm(record, value, row.parameters[j], millimetres)
    if row.terms is None:
        return Numbers(parameters)
    count, told = _count(block, row), _extra(block)
    radius = _radius(block) * millimetres if count else 1.0
    terms = [_scaled(told.get(j, 0.0), row.terms, millimetres) for j in range(_FIRST_TERM, _FIRST_TERM + count)]
    return Numbers(parameters, double(terms), radius)


def _in_mm(record: Record, value: float, power: int | None, millimetres: float) -> float:
    if power is not INVERSE:
        return _scaled(value, power, millimetres)
    try:
        return inverse(record.words[1], millimetres) if value else 0.0
    except OverflowError as error:
        message = f"PARM {record.words[0]} is {shown(record.words[1])}, too small a length"
        raise LensFileError(message, record.place) from error


def _scaled(number: float, power: int, millimetres: float) -> float:
    """Of a negative power by one division, as curvatures are."""
    return number * millimetres**power if power >= 0 else number / millimetres**-power


def _extra(block: Block) -> dict[int, float]:
    return {record.integer(0, "number of the datum"): record.number(1, "value") for record in block.all("XDAT")}


def _datum(block: Block, j: int) -> Record | None:
    found = [record for record in block.all("XDAT") if record.integer(0, "number of the datum") == j]
    return found[-1] if found else None


def _count(block: Block, row: SurfaceType) -> int:
    record = _datum(block, 1)
    count = record.integer(1, "number of terms") if record else 0
    if not 0 <= count <= row.most:
        message = f"XDAT 1 is {shown(record.words[1])}: the number of terms of a surface that is {row.name}"
        raise LensFileError(f"{message}, expected 0 to {row.most}", record.place)
    return count


def _radius(block: Block) -> float:
    record = _datum(block, 2)
    if record is None:
        raise LensFileError("no XDAT 2, the radius that the terms are normalised by; lines lost?", block.place)
    radius = record.number(1, "radius of normalisation")
    if radius <= 0:
        message = f"XDAT 2 is {shown(record.words[1])}: the radius of normalisation, expected a positive length"
        raise LensFileError(message, record.place)
    return radius


def report_unused(block: Block, kind: str, row: SurfaceType, report: Draft) -> None:
    """Say which numbers that are not 0 a surface of this type does not use, and why where that is known."""
    for record in block.all("PARM"):
        j = record.integer(0, "number of the parameter")
        if j in row.parameters or not record.number(1, "value"):
            continue
        if j in row.unused:
            report.note(f"{record.place}: PARM {j} of a {kind} surface is not used: {row.unused[j]}")
        elif row.parameters or row.unused:
            first, *_, last = sorted(row.parameters or row.unused) * 2
            article = "an" if kind[0] in "AEIOU" else "a"
            message = f"PARM {j}: {article} {kind} has parameters {first} to {last}{row.powers}; left out"
            report.warn(message, record.place)
        else:
            report.note(f"{record.place}: PARM {j} is not used by a {kind} surface")
    end = _FIRST_TERM + _count(block, row) if row.terms is not None else 0
    for record in block.all("XDAT"):
        j = record.integer(0, "number of the datum")
        if row.terms is None and record.number(1, "value"):
            report.note(f"{record.place}: XDAT {j} is not used by a {kind} surface")
        elif row.terms is not None and j >= end and j > 2 and record.number(1, "value"):
            report.warn(f"XDAT {j}: XDAT 1 says {end - _FIRST_TERM} terms, to XDAT {end - 1}; left out", record.place)
    for keyword, name in (("CURV", "curvature"), ("CONI", "conic")):
        record = block.last(keyword)
        if record and name not in row.holds and record.number(0, name):
            report.note(f"{record.place}: {keyword} is not used by a {kind} surface")
    for record in block.all("SCBD"):
        if record.words[:1] == ("3",) and record.integer(1, "kind of coordinate return", 0) > 0:
            report.note(f"{record.place}: coordinate return; its solved values, which the file stores, are read")


def poses(block: Block, millimetres: float) -> dict[str, Pose]:
    """The fields "before" and "after" by SCBD, those of them that are not 0.

    SCBD w o p dx dy tx ty tz: w 1 before, 2 after the surface; o the order, as of a coordinate break; p how the numbers
    were found, which are always written out. SCBD 3 marks a coordinate return. Raises UnsupportedSurface for others.
    """
    found = {}
    for record in block.all("SCBD"):
        where = record.integer(0, "where the tilt stands", 0)
        if where == _RETURN:
            continue
        told = [record.number(k, "tilt or decentre", 0.0) for k in range(3, 8)]
        if not any(told):
            continue
        order = record.number(1, "order")
        if where not in (1, 2) or not order_is_known(order):
            message = f"tilt or decentre of the surface (SCBD {where:g} of order {order:g}) is not modelled"
            raise UnsupportedSurface(f"{message}; known are SCBD 1 and 2 of order 0 and 1", record.place)
        x, y, *tilts = told
        found["before" if where == 1 else "after"] = pose_of([x * millimetres, y * millimetres, *tilts], int(order))
    return found


def refuse_unsupported(blocks: Sequence[Block]) -> None:
    """Raise UnsupportedSurface for the first surface that is not modelled, and name the others."""
    last = len(blocks) - 1
    found = [(block, reason) for k, block in enumerate(blocks) if (reason := _unsupported(block, k in (0, last)))]
    if not found:
        return
    block, reason = found[0]
    record = block.last("TYPE", "SURF")
    place = record.place if record else block.place
    others = [f"{other.place.surface} ({why.split()[1]})" for other, why in found[1:7]]
    more = " …" if len(found) > 7 else ""
    also = f"; neither are surfaces {', '.join(others)}{more}" if others else ""
    raise UnsupportedSurface(f"{reason} is not modelled{also}; modelled are {_modelled()}", place)


def _unsupported(block: Block, at_end: bool) -> str:
    """Why a surface is not modelled; at_end: whether it is the object or the image."""
    kind = _type(block)
    row = types().get(kind)
    if row is None:
        name = TYPE_NAMES.get(kind)
        return f"type {kind[:40]}" + (f" ({name})" if name else "")
    ignored = block.last("IGNR")
    if ignored and ignored.words[:1] not in ((), ("0",)):
        return f"type {kind} marked as to be ignored (IGNR)"
    if at_end and (kind == "COORDBRK" or "phase" in row.holds):
        return f"type {kind} ({row.name}) of the object or the image"
    if block.place.surface == 0 and any(poses(block, 1.0).values()):
        return f"type {kind} of the object with a tilt or decentre of the surface (SCBD)"
    if kind == "COORDBRK" and any(poses(block, 1.0).values()):
        return f"type {kind} ({row.name}) with a tilt or decentre of the surface (SCBD)"
    if row.flat and any(_nonzero(block, keyword, keyword, 1.0) is not None for keyword in ("CURV", "CONI")):
        return f"type {kind} ({row.name}) on a curved surface (CURV)"
    told = numbers(block, row, 1.0)
    if kind == "IRREGULA" and any(told.at(j) for j in range(1, 5)) and any(poses(block, 1.0).values()):
        return f"type {kind} ({row.name}) with tilts of its own (PARM 1 to 4) and of the surface (SCBD)"
    beyond = row.beyond(told)
    return f"type {kind} ({row.name}) {beyond}" if beyond else ""


def _type(block: Block) -> str:
    record = block.last("TYPE")
    if record is None:
        return "STANDARD"
    if not record.words:
        raise LensFileError(f"TYPE without a name; expected {_modelled()}", record.place)
    return record.words[0].upper()


def _modelled() -> str:
    *first, last = types()
    return f"{', '.join(first)} and {last}"


def build(
    block: Block,
    millimetres: float,
    blocks: Sequence[Block],
    *,
    catalogs: Sequence[str | Catalog],
    user: Sequence[Path],
    report: Draft,
) -> Surface:
    """The surface of a block, its lengths in units of `millimetres`.

    blocks: all surfaces of the file, of which a glass may be picked up.
    GLAS names are looked up in `catalogs`, then `user` files; raises UnknownGlass as `find_glass` does.
    """
    thickness = block.last("DISZ")
    if thickness is None:
        message = "has no DISZ (thickness): file cut off? A plane image has DISZ 0"
        raise LensFileError(f"surface {message}", block.place)
    comment = block.last("COMM")
    kind = _type(block)
    row = types()[kind]
    shape = {}
    if "curvature" in row.holds:
        shape["curvature"] = _nonzero(block, "CURV", "curvature", millimetres)
        shape["conic"] = _nonzero(block, "CONI", "conic constant", 1.0)
    if kind == "COORDBRK":
        _report_bare(block, report)
    else:
        shape["glass"] = _medium(block, blocks, catalogs, user, report)
        shape["apertures"] = _apertures(block, millimetres, report)
    shape |= poses(block, millimetres) | _fields(block, row, millimetres)
    report_unused(block, kind, row, report)
    return Surface(
        thickness=_thickness(thickness, millimetres),
        semi_diameter=semi_diameter(block, millimetres),
        comment=comment.text.strip() if comment else "",
        **shape,
    )


def _report_bare(block: Block, report: Draft) -> None:
    """Say what a coordinate break carries that meets no ray: a medium, an aperture."""
    for keyword in ("GLAS", *aperture_keywords()):
        record = block.last(keyword)
        if record and (keyword != "GLAS" or record.words[:1] != ("AIR",)):
            message = f"{keyword} on a coordinate break is not used: the medium goes on, and nothing clips"
            report.warn(message, record.place)


def _fields(block: Block, row: SurfaceType, millimetres: float) -> dict:
    """The fields of a surface that its type tells. Raises LensFileError for numbers that are out of range."""
    told = numbers(block, row, millimetres)._replace(size=semi_diameter(block, millimetres))
    try:
        return row.fields(told)
    except ValueError as error:
        record = block.last("TYPE", "SURF")
        raise LensFileError(str(error), record.place if record else block.place) from error


def _thickness(record: Record, millimetres: float) -> Tensor:
    word = record.words[0] if record.words else ""
    if is_infinite(word):
        if record.place.surface != 0 or word.startswith("-"):
            raise LensFileError(f"DISZ is {shown(word)}; only the object may be at infinity", record.place)
        return double(float("inf"))
    return double(record.number(0, "thickness") * millimetres)


def _nonzero(block: Block, keyword: str, what: str, divisor: float) -> Tensor | None:
    record = block.last(keyword)
    found = record.number(0, what) / divisor if record else 0.0
    return double(found) if found else None


def semi_diameter(block: Block, millimetres: float) -> float | None:
    """DIAM, which is a semi-diameter, in mm; None if absent or 0 (left to be computed)."""
    record = block.last("DIAM")
    found = record.number(0, "semi-diameter") * millimetres if record and record.words else 0.0
    if found < 0:
        raise LensFileError(f"DIAM is {shown(record.words[0])}, expected a semi-diameter of 0 or more", record.place)
    return found or None


def _picked_up(block: Block, blocks: Sequence[Block], report: Draft) -> Record | None:
    """The GLAS record that holds the medium of a surface: its own, or that of the surface it is picked up from.

    A file stores the name of a glass that is picked up, but of air or of a model glass no figures: those in the line
    are left from before. None is air.
    """
    record, source = block.last("GLAS"), glass_source(block)
    if source is None:
        return record
    held = _picked_up(blocks[source], blocks, report)
    name = record.words[0].upper()
    if held is not None and held.words[:1] and held.words[0].upper() == name:
        return held._replace(place=record.place)
    if is_blank(record):
        medium = held.words[0] if held is not None and held.words else "air"
        report.note(f"surface {block.place.surface}: the medium, {medium}, is picked up from surface {source}")
        return held and held._replace(place=record.place)
    message = f"GLAS {name[:40]} is a pickup from surface {source}, which has {held.words[0] if held else 'air'}"
    report.warn(f"{message}; {name[:40]} is taken", record.place)
    return record


def _medium(
    block: Block, blocks: Sequence[Block], catalogs: Sequence[str | Catalog], user: Sequence[Path], report: Draft
) -> Glass:
    """The medium of a GLAS record: name, flag (0 catalog, 1 model, 2 pickup, 3 substitute), -, nd, Vd, ΔPgF.

    The columns after the name are placeholders unless the flag says model glass or the name is ___BLANK.
    """
    record = _picked_up(block, blocks, report)
    if record is None:
        return AIR
    if not record.words:
        raise LensFileError("GLAS without a name; delete the line for air", record.place)
    name, surface = record.words[0], record.place.surface
    if name.upper() == "AIR":
        return AIR
    if name.upper() == "MIRROR":
        return MIRROR
    blank = is_blank(record)
    if blank or record.integer(1, "flag", 0) == 1:
        return _model(record, "" if blank else name, report)
    if is_code(name):
        report.glass(surface, name, "six-digit code: nd and Vd by its digits")
        return mil_glass(name)
    how = {"catalogs": catalogs, "user": user, "place": record.place, "report": report}
    return listed_glass(name, **how, figures=_figures(record))


def _figures(record: Record) -> tuple[float, float] | None:
    """n_d and V_d that a GLAS line has for its glass; None for those that mean nothing, 1.5 and 40."""
    nd, vd = (record.number(k, "figure of the glass", 0.0) for k in (3, 4))
    return (nd, vd) if nd > 1 and vd > 0 and (nd, vd) != (1.5, 40.0) else None


def _model(record: Record, name: str, report: Draft) -> Glass:
    nd, vd = record.number(3, "index nd"), record.number(4, "Abbe number Vd", 0.0)
    dpgf = record.number(5, "ΔPgF", 0.0)
    if nd <= 0 or vd < 0:
        raise LensFileError(f"model glass of nd {nd:g}, Vd {vd:g}; expected nd > 0 and Vd ≥ 0", record.place)
    report.glass(record.place.surface, name, f"model glass nd {nd!r}, Vd {vd!r}, ΔPgF {dpgf!r}")
    return by_figures(nd, vd, dpgf, name)


def _apertures(block: Block, millimetres: float, report: Draft) -> tuple[Aperture, ...]:
    """The aperture of a surface; OpticStudio keeps one per surface.

    A floating aperture (FLAP) follows the semi-diameter of its surface: it clips at DIAM as it now is.
    """
    keywords = aperture_keywords()
    found = block.all(*keywords)
    if not found:
        return ()
    record = found[-1]
    if len({other.keyword for other in found}) > 1:
        names = ", ".join(other.keyword for other in found)
        report.warn(f"several apertures on one surface ({names}); the last is used", record.place)
    shape, obscures = keywords[record.keyword]
    count = SHAPES[shape].sizes
    if count is None:
        sizes = _corners(block.all("UDAD"), millimetres)
        if not sizes:
            message = f"user-defined aperture ({record.keyword}) is not of polygons (UDAD): it blocks no ray"
            report.warn(message, record.place)
            return ()
    else:
        sizes = tuple(record.number(k, "size of the aperture") * millimetres for k in range(count))
    if record.keyword == "FLAP":
        sizes = 0.0, semi_diameter(block, millimetres) or sizes[1]
    if SHAPES[shape].objection(sizes):
        raise LensFileError(f"{record.keyword} {SHAPES[shape].objection(sizes)}", record.place)
    centre = block.last("OBDC")
    x, y = (centre.number(axis, "decentre") * millimetres for axis in (0, 1)) if centre else (0.0, 0.0)
    return (Aperture(shape, sizes, obscures, (x, y)),)


def _corners(records: Sequence[Record], millimetres: float) -> tuple[float, ...]:
    """x and y of the corners of polygons, each closed by its first one; none if anything else is told, as arcs.

    UDAD k x y 0: line 0 names a file, and 0 0 0 ends a polygon.
    """
    corners: list[float] = []
    polygon: list[float] = []
    for record in (*(one for one in records if one.integer(0, "number of the point") > 0), None):
        x, y, other = (record.number(k, "point of the aperture", 0.0) for k in (1, 2, 3)) if record else (0, 0, 0)
        if other:
            return ()
        if (x, y) != (0, 0):
            polygon += [x * millimetres, y * millimetres]
        elif polygon:
            corners += [*polygon, *polygon[:2]]
            polygon = []
    return tuple(corners)
