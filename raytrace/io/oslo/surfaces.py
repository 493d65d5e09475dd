"""A surface of an OSLO lens file: poses, pickups, solves, shape, medium and aperture.

Poses: the axes of a surface are decentred by DCX, DCY, DCZ, then tilted by TLA, TLB, TLC about x, y and z in turn (DT
1), or tilted about z, y and x and then decentred (DT -1). TLA and TLB are left-handed, TLC right-handed. The following
surfaces are in these axes; behind a mirror with BEN, in axes that are tilted again by the same angle, so that the axis
of the light continues along z; behind RCO, in the axes before the surface.

Sources: Lambda Research, export of OSLO's tilts to another program (the sequence and the signs); Sinclair Optics, the
pentaprism of the user guide; the tests of Optiland, which were written from the program's reference.

Pickups: PK GLA -k is the medium of the k-th surface before. CV and TH are its curvature and its thickness, to which a
number may be added, CVM and THM those of opposite sign; with a curvature come conic and terms.

Solves: curvatures and thicknesses that follow from the paraxial axial ray, by the y-nu trace.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch

from raytrace.io.materials import listed_glass
from raytrace.io.oslo.keywords import POSE_NUMBERS, Commands
from raytrace.io.report import Draft
from raytrace.io.source import LensFileError, Place, Record, UnsupportedSurface, double, is_number, shown
from raytrace.materials.glass import AIR, MIRROR, Glass, constant, from_table, refractive_index
from raytrace.system.apertures import Aperture
from raytrace.system.poses import Pose, undone
from raytrace.system.surface import Surface

#: The field of a pose by its command, and the sign that it takes there.
_FIELDS = {
    **{"DCX": ("x", 1), "DCY": ("y", 1), "DCZ": ("z", 1)},
    **{"TLA": ("tilt_x", -1), "TLB": ("tilt_y", -1), "TLC": ("tilt_z", 1)},
}


def poses(commands: Commands, unit: float) -> dict[str, Pose]:
    """The poses `before` and `after` of a surface, if any. Raises LensFileError, UnsupportedSurface."""
    records = {word: record for word in POSE_NUMBERS if (record := commands.last(word))}
    moved = {word: number for word, record in records.items() if (number := record.number(0, "tilt or decentre"))}
    bend, back = commands.last("BEN"), commands.last("RCO")
    for record in filter(None, (bend, back)):
        if record.words:
            raise UnsupportedSurface(f"{record.keyword} {record.words[0]} is not modelled, but alone", record.place)
    if not moved:
        return {}
    if commands.place.surface == 0:
        word = next(iter(moved))
        raise UnsupportedSurface(f"{word} (a tilted or decentred object) is not modelled", records[word].place)
    record = commands.last("DT")
    order = record.integer(0, "order of tilts and decentres") if record else 1
    if order not in (1, -1):
        raise LensFileError(f"DT is {record.words[0]}, expected 1 (decentre, then tilt) or -1", record.place)
    fields = {}
    for word, number in moved.items():
        name, sign = _FIELDS[word]
        fields[name] = double(sign * number * (1.0 if name.startswith("tilt") else unit))
    before = Pose(**fields, tilts_first=order == -1)
    if bend:
        mirror = commands.last("RFL", "RFH")
        if back or mirror is None or len(moved) != 1 or next(iter(moved)) not in ("TLA", "TLB"):
            message = "BEN is modelled on a mirror that is tilted by TLA or by TLB alone, and without RCO"
            raise UnsupportedSurface(message, bend.place)
        return {"before": before, "after": Pose(tilt_x=before.tilt_x, tilt_y=before.tilt_y)}
    return {"before": before, "after": undone(before)} if back else {"before": before}


class Built(NamedTuple):
    """A surface and its commands."""

    surface: Surface
    commands: Commands


def curved(number: float) -> torch.Tensor | None:
    """A number of a shape, None where it is 0 and the surface has none of it."""
    return double(number) if number else None


def picked_up(commands: Commands, before: Sequence[Built], unit: float, report: Draft) -> dict:
    """The fields of a surface that are picked up from an earlier one. Raises LensFileError and UnsupportedSurface."""
    fields = {}
    for record in commands.all("PK"):
        kind = record.words[0].upper() if record.words else ""
        pickup = _PICKUPS.get(kind)
        if pickup is None or len(record.words) not in (2, 2 + pickup.adds):
            message = f"PK {shown(' '.join(record.words))} (a pickup) is not modelled, but of {', '.join(_PICKUPS)}"
            raise UnsupportedSurface(message, record.place)
        back = -record.integer(1, "surface to pick up from")
        if not 0 < back <= len(before):
            message = f"PK {kind} {record.words[1]}: expected how many surfaces before this one, as -2"
            raise UnsupportedSurface(message, record.place)
        _refuse_other_sources(record, pickup.instead, commands, before[-back].commands)
        added = record.number(2, "number to add", 0.0)
        fields |= pickup.fields(before[-back].surface, added, unit)
        if kind == "GLA":
            if fields["glass"].formula == "mirror":
                message = f"PK GLA {record.words[1]} picks up a mirror, which is not modelled"
                raise UnsupportedSurface(message, record.place)
            report.glass(record.place.surface, fields["glass"].name, f"that of surface {len(before) - back}")
    return fields


def _refuse_other_sources(record: Record, instead: Sequence[str], commands: Commands, source: Commands) -> None:
    """Raise where a picked-up number is also given, or is itself solved for."""
    pickup = " ".join(record.words[:2])
    for word in instead:
        if other := commands.last(word):
            message = (
                f"{word} in line {other.place.line} and PK {pickup} give the same number twice; delete one of them"
            )
            raise LensFileError(message, record.place)
        if word in _SOLVES and source.last(_SOLVES[word]):
            raise UnsupportedSurface(f"PK {pickup} of a number that is solved for there is not modelled", record.place)


#: The solve for the number of a command.
_SOLVES = {"RD": "PU", "TH": "PY"}


def _profile(surface: Surface, added: float, unit: float, sign: float) -> dict:
    """The curvature, to which a number is added, with the conic and the terms that belong to it."""
    curvature = sign * (float(surface.curvature) if surface.curvature is not None else 0.0) + added / unit
    terms = None if surface.coefficients is None else sign * surface.coefficients
    return {"curvature": curved(curvature), "conic": surface.conic, "coefficients": terms}


def _length(surface: Surface, added: float, unit: float, sign: float) -> dict:
    return {"thickness": double(sign * float(surface.thickness) + added * unit)}


class Pickup(NamedTuple):
    """Fields of a surface from an earlier one, whether a number may be added, and the commands of the same quantity."""

    fields: Callable[[Surface, float, float], dict]
    adds: bool
    instead: tuple[str, ...]


_PICKUPS = {
    "GLA": Pickup(lambda surface, _, __: {"glass": surface.glass}, False, ("AIR", "GLA", "RFL", "RFH")),
    "CV": Pickup(partial(_profile, sign=1.0), True, ("RD", "CV", "CC", "AD", "AE", "AF", "AG")),
    "CVM": Pickup(partial(_profile, sign=-1.0), True, ("RD", "CV", "CC", "AD", "AE", "AF", "AG")),
    "TH": Pickup(partial(_length, sign=1.0), True, ("TH",)),
    "THM": Pickup(partial(_length, sign=-1.0), True, ("TH",)),
}


@dataclass
class Step:
    """A surface as the axial ray meets it: curvature 1/mm and thickness mm, or the solves for them.

    index: of the medium behind, at the primary wavelength; of a mirror that before it. slope, height: the solves PU
    and PY, for the slope of the axial ray behind the surface and its height on the next, in mm.
    """

    place: Place
    curvature: float
    thickness: float
    index: float
    is_mirror: bool = False
    slope: Record | None = None
    height: Record | None = None


def solve(steps: Sequence[Step], beam: float | None, unit: float) -> None:
    """Solve curvatures and thicknesses, from the object on.

    beam: mm, height of the axial ray on surface 1 where the file gives it and the object is at infinity; None where
    only its direction is known, which suffices for a height of 0. Raises LensFileError and UnsupportedSurface.
    """
    distance = steps[0].thickness
    infinite = distance == float("inf")
    height, slope = (beam or 1.0, 0.0) if infinite else (distance, 1.0)
    n = steps[0].index
    for step in steps[1:-1]:
        behind = -n if step.is_mirror else step.index * (-1 if n < 0 else 1)
        if step.slope:
            step.curvature = _solved_curvature(step, n, behind, height, slope, beam)
        slope = (n * slope - height * (behind - n) * step.curvature) / behind
        if step.height:
            step.thickness = _solved_thickness(step, height, slope, beam, unit)
        height, n = height + slope * step.thickness, behind


def _solved_curvature(step: Step, n: float, behind: float, height: float, slope: float, beam: float | None) -> float:
    wanted, place = step.slope.number(0, "slope of the axial ray"), step.slope.place
    if beam is None:
        raise UnsupportedSurface("PU (a solve for the slope of the axial ray) is solved for a beam by EBR only", place)
    if not height * (behind - n):
        raise LensFileError(f"PU {wanted:g}: no curvature here refracts the axial ray", place)
    return (n * slope - behind * wanted) / (height * (behind - n))


def _solved_thickness(step: Step, height: float, slope: float, beam: float | None, unit: float) -> float:
    wanted, place = step.height.number(0, "height of the axial ray") * unit, step.height.place
    if beam is None and wanted:
        raise UnsupportedSurface(f"PY {wanted / unit:g} is solved for a beam by EBR only; PY 0 for any", place)
    distance = (wanted - height) / slope if slope else float("inf")
    if abs(distance) > 1e12:
        raise LensFileError(f"PY {wanted / unit:g}: the axial ray never reaches that height", place)
    return distance


def focal_length(steps: Sequence[Step]) -> float | None:
    """mm, of the steps solved; None for an afocal lens. Its sign is that of a lens without a mirror before it."""
    height, slope, n = 1.0, 0.0, steps[0].index
    for step in steps[1:-1]:
        behind = -n if step.is_mirror else step.index * (-1 if n < 0 else 1)
        slope = (n * slope - height * (behind - n) * step.curvature) / behind
        height, n = height + slope * step.thickness, behind
    return -steps[0].index / (n * slope) if abs(slope) > 1e-12 else None


#: Lens units: an object at this distance or beyond is at infinity.
INFINITE = 1e8

#: Aspheric terms by their power of r.
_TERMS = {"AD": 4, "AE": 6, "AF": 8, "AG": 10}

#: No medium has an index beyond these.
_SMALLEST, _LARGEST = 0.1, 6.0


def build(commands: Commands, before: Sequence[Built], unit: float, user: Sequence[Path], report: Draft) -> Built:
    """The surface of its commands, lengths in units of `unit` mm; solved quantities are 0 until `solve`.

    before: the surfaces from which it may pick up. user: glass catalogs (.agf).
    Raises LensFileError, UnsupportedSurface and UnknownGlass.
    """
    note = commands.last("NOT")
    radius, aperture = _aperture(commands, unit)
    picked = picked_up(commands, before, unit, report)
    shape = {
        "thickness": double(_thickness(commands, unit)),
        "curvature": curved(_curvature(commands) / unit),
        "conic": curved(_last_number(commands, "CC", "conic constant")),
        "coefficients": _coefficients(commands, unit),
        "glass": picked["glass"] if "glass" in picked else _medium(commands, user, report),
    }
    surface = Surface(
        semi_diameter=radius,
        apertures=aperture,
        comment=" ".join(note.words) if note else "",
        **(shape | picked),
        **poses(commands, unit),
    )
    return Built(surface, commands)


def _last_number(commands: Commands, word: str, quantity: str) -> float:
    record = commands.last(word)
    return record.number(0, quantity) if record else 0.0


def step_of(built: Built, primary: float, before: Step | None) -> Step:
    """The surface as the axial ray meets it, at the primary wavelength in µm."""
    surface, commands = built
    index = before.index if surface.is_mirror else float(refractive_index(surface.glass, double(primary)))
    if not index:
        raise LensFileError(f"{surface.glass.name or 'the medium'} has no index at {primary:g} µm", commands.place)
    curvature = float(surface.curvature) if surface.curvature is not None else 0.0
    return Step(commands.place, curvature, float(surface.thickness), index, surface.is_mirror, *_solves(commands))


def _solves(commands: Commands) -> tuple[Record | None, Record | None]:
    """PU and PY. Raises LensFileError where the number that they solve for is also given."""
    solves = commands.last("PU"), commands.last("PY")
    pickups = {record.words[0].upper(): record for record in commands.all("PK") if record.words}
    stated = (
        (commands.last("RD", "CV") or pickups.get("CV") or pickups.get("CVM")),
        (commands.last("TH") or pickups.get("TH") or pickups.get("THM")),
    )
    for given, solved in zip(stated, solves, strict=True):
        if given and solved:
            message = f"{given.keyword} in line {given.place.line} and {solved.keyword} give the same number twice"
            raise LensFileError(f"{message}; delete one of them", solved.place)
    return solves


def solved(surface: Surface, step: Step) -> Surface:
    """The surface with the results of its solves."""
    if step.slope:
        surface = dataclasses.replace(surface, curvature=double(step.curvature))
    return dataclasses.replace(surface, thickness=double(step.thickness)) if step.height else surface


def _curvature(commands: Commands) -> float:
    """In 1/units: of RD, where 0 is a plane, or CV."""
    radius, curvature = commands.last("RD"), commands.last("CV")
    if radius and curvature:
        raise LensFileError(f"CV, but RD in line {radius.place.line} gives the radius", curvature.place)
    if curvature:
        return curvature.number(0, "curvature")
    length = radius.number(0, "radius of curvature") if radius else 0.0
    return 1 / length if length else 0.0


def _thickness(commands: Commands, unit: float) -> float:
    record = commands.last("TH")
    distance = record.number(0, "thickness") if record else 0.0
    if commands.place.surface == 0 and distance >= INFINITE:
        return float("inf")
    if abs(distance) >= INFINITE:
        raise LensFileError(f"TH is {shown(record.words[0])}; only the object may be at infinity", record.place)
    return distance * unit


def _coefficients(commands: Commands, unit: float) -> torch.Tensor | None:
    """Of r², r⁴, … r¹⁰: OSLO's asphere begins with r⁴."""
    records = {power: commands.last(word) for word, power in _TERMS.items()}
    terms = [0.0, *(r.number(0, f"coefficient of r^{p}") / unit ** (p - 1) if r else 0.0 for p, r in records.items())]
    return double(terms) if any(terms) else None


def _aperture(commands: Commands, unit: float) -> tuple[float | None, tuple[Aperture, ...]]:
    """AP r is a semi-diameter, AP CHK r also clips rays; 0 is left to the program. That of the object is its field."""
    record = commands.last("AP")
    if record is None or commands.place.surface == 0:
        return None, ()
    checked = [word.upper() for word in record.words[:1]] == ["CHK"]
    radius = record.number(int(checked), "radius of the aperture")
    if radius < 0:
        raise LensFileError(f"AP is {radius:g}, expected a radius of 0 or more", record.place)
    if len(record.words) > 1 + checked:
        raise UnsupportedSurface(f"AP {shown(' '.join(record.words))}: expected AP r or AP CHK r", record.place)
    radius *= unit
    return radius or None, (Aperture("circular", (0.0, radius), False, (0.0, 0.0)),) if checked and radius else ()


def _medium(commands: Commands, user: Sequence[Path], report: Draft) -> Glass:
    """AIR, RFL and RFH (a mirror) or GLA: the last of them; air where there is none."""
    records = commands.all("AIR", "RFL", "RFH", "GLA")
    if not records:
        return AIR
    record = records[-1]
    if record.keyword in ("RFL", "RFH"):
        return MIRROR
    return AIR if record.keyword == "AIR" else _glass(record, commands, user, report)


def _glass(record: Record, commands: Commands, user: Sequence[Path], report: Draft) -> Glass:
    """A glass by its name, or by its indices at the wavelengths in force: GLA n…, GLA name n…, GLA MOD name n…"""
    words, place = list(record.words), record.place
    modelled = len(words) > 1 and words[0].upper() == "MOD"
    words = words[modelled:]
    name = words.pop(0) if words and not is_number(words[0]) else ""
    if not words:
        if not name or modelled:
            raise LensFileError(f"GLA {' '.join(record.words)} without a name or an index".replace("  ", " "), place)
        return listed_glass(name, catalogs=(), user=user, place=place, report=report)
    indices = [record.number(len(record.words) - len(words) + k, "index") for k in range(len(words))]
    for index in indices:
        if not _SMALLEST <= index <= _LARGEST:
            message = f"GLA {shown(' '.join(record.words))}: {index:g} is no index; a glass by index and Abbe number"
            raise UnsupportedSurface(f"{message}, or by a code, is not modelled", place)
    return _by_indices(name, indices, commands.wavelengths, record, report)


def _by_indices(name: str, indices: list[float], at: tuple[float, ...], record: Record, report: Draft) -> Glass:
    listed = ", ".join(map(repr, indices))
    if len(set(indices)) == 1:
        report.glass(record.place.surface, name, f"constant index {indices[0]!r}")
        return constant(indices[0], name)
    if len(indices) > len(at):
        raise LensFileError(f"{len(indices)} indices for {len(at)} wavelengths", record.place)
    report.glass(record.place.surface, name, f"indices {listed} at {', '.join(map(repr, at[: len(indices)]))} µm")
    try:
        return from_table(at[: len(indices)], indices, name=name)
    except ValueError as error:
        raise LensFileError(f"GLA: {error}", record.place) from error
