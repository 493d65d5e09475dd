"""Read a sequential lens file of OSLO (.len).

Conventions, each settled against figures of files that others wrote, most of them by OSLO itself (`test_oslo`):

- Numbers are in units of UNI mm. Radii, conics and thicknesses mean what they mean in a .zmx file, behind mirrors too.
- AD, AE, AF, AG are the terms of r⁴, r⁶, r⁸, r¹⁰. A surface without a medium has air behind it.
- The first wavelength is the primary one. Indices of a glass stand at the wavelengths in force where it stands.
- EBR is the radius of the beam on surface 1, FNO the F-number, both of an object at infinity; NAO is n sin θ of a near
  one. ANG is the largest field angle; OBH the largest object height, which of an object at infinity tells the angle:
  light from below the axis, of negative height, goes up.
- AP sizes a surface, AP CHK also clips. AST marks the stop; without it surface 1 is the stop.
- Solves are not stored with what they came to: PU, PY 0 of the axial ray are solved again. Others are refused.

- How surfaces are tilted, decentred and bent is told in `oslo_poses`. Pickups are of a surface so many before: GLA; CV
  and TH, to which a number is added, and CVM and THM, which change the sign; with a curvature go conic and terms.

Other pickups, special surfaces and apertures, and further configurations are refused by name.
"""

import math
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from raytrace.io.oslo import surfaces as oslo_surface
from raytrace.io.oslo.keywords import DEFAULT_WAVELENGTHS, Sections, sections
from raytrace.io.oslo.surfaces import Built, Step, focal_length, solve
from raytrace.io.report import Draft, ImportReport
from raytrace.io.source import LensFileError, UnsupportedSurface, shown
from raytrace.io.spelling import double, is_number, number, refuse_overflow
from raytrace.io.substitutes import NONE, Substitutes
from raytrace.io.zemax.keywords import Record
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.surface import Surface, is_posed

#: Field points, as fractions of the largest height or tangent: OSLO's own three.
FRACTIONS = (0.0, 0.7, 1.0)

#: Millimetres in a lens unit, beyond which UNI is damaged.
_SMALLEST_UNIT, _LARGEST_UNIT = 1e-6, 1e6


def read(
    text: str,
    file: str,
    *,
    catalogs: Sequence[Path] = (),
    strict: bool = False,
    substitutes: Substitutes = NONE,
) -> tuple[Lens, ImportReport]:
    """The lens of a .len text and the report of its import.

    file: its name, for messages. catalogs: glass catalogs (.agf) that go before the shipped ones; the file names none.
    strict: every warning is an error. Raises LensFileError, UnsupportedSurface and UnknownGlass.
    """
    report = Draft(file, "len", substitutes)
    found = sections(text, file, report)
    _refuse_incomplete(found)
    unit = _unit(found)
    built: list[oslo_surface.Built] = []
    for commands in found.surfaces:
        built.append(oslo_surface.build(commands, built, unit, catalogs, report))
    wavelengths, weights = _wavelengths(found, report)
    aperture = _aperture(found, built[0].surface, unit, report)
    surfaces = _solved(found, built, float(wavelengths[0]), aperture, unit, report)
    title, notes = _texts(found)
    lens = Lens(
        surfaces=tuple(surfaces),
        stop=_stop(found, report),
        aperture=aperture,
        fields=_fields(found, surfaces[0], unit, report),
        wavelengths=wavelengths,
        wavelength_weights=weights,
        primary_wavelength=1,
        name=title,
        notes=notes,
    )
    refuse_overflow(lens, file)
    return lens, report.finished(strict=strict)


def _refuse_incomplete(found: Sections) -> None:
    surfaces, last = found.surfaces, len(found.surfaces) - 1
    if last < 2:
        message = f"{last + 1} surfaces, expected at least object, one surface and image; file cut off?"
        raise LensFileError(message, surfaces[-1].place)
    stated = [("LEN NEW", number(word, "surfaces", found.head.place)) for word in _stated(found)[1:]]
    end = found.system.last("END")
    stated += [("END", end.number(0, "number of the image"))] if end.words else []
    for keyword, count in stated:
        if count != last and not (keyword == "LEN NEW" and count > last):  # room for more surfaces
            place = end.place if keyword == "END" else found.head.place
            raise LensFileError(f"{keyword} tells that the image is surface {count:g}, but it is {last}", place)
    shift = surfaces[-1].last("TH")
    if shift and shift.number(0, "focus shift"):
        message = f"TH {shift.words[0]} of the image (a focus shift) is not modelled; add it to the thickness before"
        raise UnsupportedSurface(message, shift.place)
    for word in ("PU", "PY", "RFL", "RFH"):
        for at in (0, last):
            record = surfaces[at].last(word)
            if record and (at == 0 or word[0] == "P"):
                what = "a solve" if word[0] == "P" else "a mirror"
                raise UnsupportedSurface(f"{word} ({what}) of the object or the image is not modelled", record.place)


def _stated(found: Sections) -> list[str]:
    """The numbers that LEN NEW states at most: focal length and number of the image."""
    words = found.head.words[1:]
    numbers = words[1:] if words and not is_number(words[0]) else words
    return [word for word in numbers[:2] if is_number(word)]


def _unit(found: Sections) -> float:
    record = found.system.last("UNI")
    unit = record.number(0, "mm in a lens unit") if record else 1.0
    if not _SMALLEST_UNIT <= unit <= _LARGEST_UNIT:
        raise LensFileError(f"UNI is {shown(record.words[0])}, expected the millimetres in a lens unit", record.place)
    return unit


def _texts(found: Sections) -> tuple[str, tuple[str, ...]]:
    words = found.head.words[1:2]
    title = words[0] if words and not is_number(words[0]) else ""
    notes = (" ".join(record.words).strip() for record in found.system.all("SNO"))
    return title.strip(), tuple(note for note in notes if note)


def _wavelengths(found: Sections, report: Draft) -> tuple[Tensor, Tensor]:
    """Wavelengths, µm, the first of which is the primary one, and their weights."""
    values, place = found.wavelengths, found.head.place
    if not values:
        values = list(DEFAULT_WAVELENGTHS)
        report.warn(f"no WV: the program's own wavelengths are taken, {', '.join(map(str, values))} µm", place)
    if any(value <= 0 for value in values):
        raise LensFileError(f"wavelength {min(values):g} µm, expected a positive number", place)
    weights = dict.fromkeys(range(1, len(values) + 1), 1.0)
    for record in found.system.all("WW"):
        start = int(record.keyword[2:] or 1)
        given = {start + k: record.number(k, "weight") for k in range(len(record.words))}
        if not given or not given.keys() <= weights.keys():
            message = f"{record.keyword} has {len(given)} values for {len(values)} wavelengths"
            raise LensFileError(message, record.place)
        if min(given.values()) < 0:
            raise LensFileError(f"weight {min(given.values()):g} of a wavelength, expected 0 or more", record.place)
        weights |= given
    return double(values), double(list(weights.values()))


#: What a command of the aperture means, and whether it is one of an object at infinity.
_APERTURES = {
    "EBR": ("entrance_pupil_diameter", True),
    "FNO": ("image_f_number", True),
    "NAO": ("object_na", False),
}


def _aperture(found: Sections, first: Surface, unit: float, report: Draft) -> SystemAperture:
    records = found.system.all(*_APERTURES)
    if not records:
        raise LensFileError(f"no system aperture; expected one of {', '.join(_APERTURES)}", found.head.place)
    record = records[-1]
    if len(records) > 1:
        names = " and ".join(f"{other.keyword} in line {other.place.line}" for other in records)
        report.warn(f"several system apertures ({names}); the last is used", record.place)
    size = record.number(0, "size of the aperture")
    if size <= 0:
        raise LensFileError(f"{record.keyword} is {shown(record.words[0])}, expected a positive number", record.place)
    kind, far = _APERTURES[record.keyword]
    if far != _is_far(first):
        where = "a near object" if far else "an object at infinity"
        raise UnsupportedSurface(f"{record.keyword} of {where} is not modelled", record.place)
    return SystemAperture(kind, double(2 * size * unit if record.keyword == "EBR" else size))


def _is_far(surface: Surface) -> bool:
    return float(surface.thickness) == math.inf


def _fields(found: Sections, first: Surface, unit: float, report: Draft) -> Fields:
    """Points on the y axis, at FRACTIONS of the largest field, which is all that the file tells."""
    records = found.system.all("ANG", "OBH")
    if not records:
        report.note("neither ANG nor OBH: the field is the axis")
        return _points("angle", [0.0])
    record = records[-1]
    if len(records) > 1:
        names = " and ".join(f"{other.keyword} in line {other.place.line}" for other in records)
        report.warn(f"several fields ({names}); the last is used", record.place)
    most, far = record.number(0, "field"), _is_far(first)
    if record.keyword == "ANG" and not far:
        raise UnsupportedSurface("ANG (a field angle) of a near object is not modelled", record.place)
    if most:
        told = ", ".join(f"{fraction:g}" for fraction in FRACTIONS)
        report.note(f"fields: {told} of the largest one, which is all that {record.keyword} tells")
    if not far:
        return _points("object_height", [fraction * most * unit for fraction in FRACTIONS] if most else [0.0])
    return _points("angle", _angles(record, found, most))


def _angles(record: Record, found: Sections, most: float) -> list[float]:
    """Degrees, at FRACTIONS of the tangent."""
    if record.keyword == "ANG":
        if abs(most) >= 90:
            raise LensFileError(f"ANG is {shown(record.words[0])}, expected less than 90 degrees", record.place)
        tangent = math.tan(math.radians(most))
    else:
        tangent = -most / found.surfaces[0].last("TH").number(0, "thickness")
    angles = [math.degrees(math.atan(fraction * tangent)) for fraction in FRACTIONS]
    angles[-1] = most if record.keyword == "ANG" else angles[-1]
    return angles if tangent else [0.0]


def _points(kind: str, y: list[float]) -> Fields:
    return Fields(kind=kind, x=double([0.0] * len(y)), y=double(y), weight=double([1.0] * len(y)))


def _stop(found: Sections, report: Draft) -> int:
    marked = [surface.last("AST") for surface in found.surfaces if surface.last("AST")]
    if not marked:
        report.note("no AST: surface 1 is the stop")
        return 1
    if len(marked) > 1:
        message = f"a second AST; surface {marked[0].place.surface} is the stop already"
        raise LensFileError(message, marked[1].place)
    stop = marked[0].place
    if not 0 < stop.surface < len(found.surfaces) - 1:
        raise LensFileError("AST on the object or the image; expected a surface between them", stop)
    return stop.surface


def _solved(
    found: Sections, built: Sequence[Built], primary: float, aperture: SystemAperture, unit: float, report: Draft
) -> list[Surface]:
    """The surfaces with what is solved for, and a note where the lens has not the focal length that the file states."""
    steps: list[Step] = []
    for one in built:
        steps.append(oslo_surface.step(one, primary, steps[-1] if steps else None))
    _refuse_tilted_solves(built)
    beam = 0.5 * float(aperture.value) if aperture.kind == "entrance_pupil_diameter" else None
    solve(steps, beam, unit)
    for step in steps:
        for record in filter(None, (step.slope, step.height)):
            value = f"curvature {step.curvature:.9g}" if record is step.slope else f"thickness {step.thickness:.9g}"
            words = f"{record.keyword} {record.words[0]}"
            report.note(f"surface {record.place.surface}: {words} solved again, {value} in mm")
    _compare(found, focal_length(steps), unit, report)
    return [oslo_surface.solved(one.surface, step) for one, step in zip(built, steps, strict=True)]


def _refuse_tilted_solves(built: Sequence[Built]) -> None:
    solves = [record for one in built for record in one.commands.all("PU", "PY")]
    if solves and any(is_posed(one.surface) for one in built):
        message = f"{solves[0].keyword} (a solve) in a lens with tilted or decentred surfaces is not modelled"
        raise UnsupportedSurface(message, solves[0].place)


def _compare(found: Sections, focal: float | None, unit: float, report: Draft) -> None:
    stated = _stated(found)[:1]
    if not stated or focal is None:
        return
    length = number(stated[0], "focal length", found.head.place) * unit
    if abs(abs(length) - abs(focal)) > 1e-4 * abs(focal):
        message = f"LEN NEW states a focal length of {length:.6g} mm, the lens as read has {focal:.6g}"
        report.note(f"{message}: by glasses of another edition, or the number was typed in")
