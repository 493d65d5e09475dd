"""PARM, XDAT and SCBD of a surface of a .zmx file: the numbers of its type, and the poses of its axes."""

from raytrace.formats.report import Draft
from raytrace.formats.source import LensFileError, UnsupportedSurface, shown
from raytrace.formats.spelling import double
from raytrace.formats.zemax_keywords import Block, Record
from raytrace.formats.zemax_numbers import INVERSE, Numbers, SurfaceType, inverse, order_is_known, pose_of
from raytrace.system.pose import Pose

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
