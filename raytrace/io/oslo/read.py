"""Read a sequential lens file of OSLO (.len).

Conventions, each verified against numbers of files that others wrote, most of them by OSLO itself (`test_oslo`):

- Numbers are in units of UNI mm. Radii, conics and thicknesses have the meaning of a .zmx file, behind mirrors too.
- AD, AE, AF, AG are the terms of r⁴, r⁶, r⁸, r¹⁰. A surface without a medium has air behind it.
- The first wavelength is the primary one. Indices of a glass are at the wavelengths in force where it is defined.
- EBR is the radius of the beam on surface 1, FNO the F-number, both of an object at infinity; NAO is n sin θ of a near
  object. ANG is the largest field angle; OBH the largest object height, which of an object at infinity gives the angle:
  light from below the axis, of negative height, goes up.
- AP sizes a surface, AP CHK also clips. AST marks the stop; without it surface 1 is the stop.
- Results of solves are not stored: PU, PY 0 of the axial ray are solved again. Others are refused.

Tilts, decentres and bends are described in `oslo.surfaces`. Pickups refer to an earlier surface: GLA; CV and TH, to
which a number is added, and CVM and THM, which change the sign; with a curvature come conic and terms.

Other pickups, special surfaces and apertures, and further configurations are refused by name.
"""

import math
from collections.abc import Sequence
from pathlib import Path

from raytrace.io.assembly import LensDraft, assemble
from raytrace.io.oslo.keywords import DEFAULT_WAVELENGTHS, Sections, sections
from raytrace.io.oslo.surfaces import Built, Step, build, focal_length, solve, solved, step_of
from raytrace.io.report import Draft
from raytrace.io.source import LensFileError, Place, UnsupportedSurface, is_number, number, shown
from raytrace.system.lens import Lens
from raytrace.system.surface import Surface, is_posed

#: Field points, as fractions of the largest height or tangent: OSLO's own three.
FRACTIONS = (0.0, 0.7, 1.0)

#: Millimetres in a lens unit, beyond which UNI is damaged.
_SMALLEST_UNIT, _LARGEST_UNIT = 1e-6, 1e6

#: System apertures by their commands, and whether they refer to an object at infinity.
_APERTURES = {
    "EBR": ("entrance_pupil_diameter", True),
    "FNO": ("image_f_number", True),
    "NAO": ("object_na", False),
}


def read(text: str, file: str, report: Draft, catalogs: Sequence[Path] = ()) -> Lens:
    """The lens of a .len text; report: filled. catalogs: precede the shipped ones; the file names none.

    Raises LensFileError, UnsupportedSurface and UnknownGlass.
    """
    parts = sections(text, file, report)
    _refuse_incomplete(parts)
    record = parts.system.last("UNI")
    unit = record.number(0, "mm in a lens unit") if record else 1.0
    if not _SMALLEST_UNIT <= unit <= _LARGEST_UNIT:
        raise LensFileError(f"UNI is {shown(record.words[0])}, expected the millimetres in a lens unit", record.place)
    built: list[Built] = []
    for commands in parts.surfaces:
        built.append(build(commands, built, unit, catalogs, report))
    far = float(built[0].surface.thickness) == math.inf
    waves = list(parts.wavelengths)
    if not waves:
        waves = list(DEFAULT_WAVELENGTHS)
        message = f"no WV: the program's own wavelengths are taken, {', '.join(map(str, waves))} µm"
        report.warn(message, parts.head.place)
    if min(waves) <= 0:  # before they are used for indices
        raise LensFileError(f"wavelength {min(waves):g} µm, expected a positive number", parts.head.place)
    kind, aperture, source = _aperture(parts, far, unit, report)
    field_kind, y = _fields(parts, far, unit, report)
    words = parts.head.words[1:2]
    notes = (" ".join(record.words).strip() for record in parts.system.all("SNO"))
    stop = _stop(parts, report)
    draft = LensDraft(
        surfaces=_solved(parts, built, waves[0], aperture if kind == "entrance_pupil_diameter" else None, unit, report),
        stop=stop.surface,
        aperture_kind=kind,
        aperture=aperture,
        field_kind=field_kind,
        x=[0.0] * len(y),
        y=y,
        wavelengths=waves,
        wavelength_weights=_weights(parts, len(waves)),
        name=words[0].strip() if words and not is_number(words[0]) else "",
        notes=tuple(note for note in notes if note),
        sources={"stop": ("AST", stop), "aperture": source},
    )
    if weights := parts.system.all("WW"):
        draft.sources["wavelength_weights"] = (weights[-1].keyword, weights[-1].place)
    return assemble(draft, file)


def _refuse_incomplete(parts: Sections) -> None:
    surfaces, last = parts.surfaces, len(parts.surfaces) - 1
    if last < 2:
        message = f"{last + 1} surfaces, expected at least object, one surface and image; file cut off?"
        raise LensFileError(message, surfaces[-1].place)
    counts = [("LEN NEW", number(word, "surfaces", parts.head.place)) for word in _stated(parts)[1:]]
    end = parts.system.last("END")
    counts += [("END", end.number(0, "number of the image"))] if end.words else []
    for keyword, count in counts:
        if count != last and not (keyword == "LEN NEW" and count > last):  # room for more surfaces
            place = end.place if keyword == "END" else parts.head.place
            raise LensFileError(f"{keyword} says that the image is surface {count:g}, but it is {last}", place)
    shift = surfaces[-1].last("TH")
    if shift and shift.number(0, "focus shift"):
        message = f"TH {shift.words[0]} of the image (a focus shift) is not modelled; add it to the thickness before"
        raise UnsupportedSurface(message, shift.place)
    for word in ("PU", "PY", "RFL", "RFH"):
        for at in (0, last):
            record = surfaces[at].last(word)
            if record and (at == 0 or word[0] == "P"):
                kind = "a solve" if word[0] == "P" else "a mirror"
                raise UnsupportedSurface(f"{word} ({kind}) of the object or the image is not modelled", record.place)


def _stated(parts: Sections) -> list[str]:
    """The numbers that LEN NEW states at most: focal length and number of the image."""
    words = parts.head.words[1:]
    numbers = words[1:] if words and not is_number(words[0]) else words
    return [word for word in numbers[:2] if is_number(word)]


def _weights(parts: Sections, count: int) -> list[float]:
    """The weights of the wavelengths: WW lists them from the first on, WW2 from the second."""
    weights = dict.fromkeys(range(1, count + 1), 1.0)
    for record in parts.system.all("WW"):
        start = int(record.keyword[2:] or 1)
        listed = {start + k: record.number(k, "weight") for k in range(len(record.words))}
        if not listed or not listed.keys() <= weights.keys():
            message = f"{record.keyword} has {len(listed)} values for {count} wavelengths"
            raise LensFileError(message, record.place)
        weights |= listed
    return list(weights.values())


def _aperture(parts: Sections, far: bool, unit: float, report: Draft) -> tuple[str, float, tuple[str, Place]]:
    """Kind and size of the system aperture, and its source; far: whether the object is at infinity."""
    records = parts.system.all(*_APERTURES)
    if not records:
        raise LensFileError(f"no system aperture; expected one of {', '.join(_APERTURES)}", parts.head.place)
    record = records[-1]
    if len(records) > 1:
        names = " and ".join(f"{other.keyword} in line {other.place.line}" for other in records)
        report.warn(f"several system apertures ({names}); the last is used", record.place)
    size = record.number(0, "size of the aperture")
    kind, is_of_far = _APERTURES[record.keyword]
    if is_of_far != far:
        where = "a near object" if is_of_far else "an object at infinity"
        raise UnsupportedSurface(f"{record.keyword} of {where} is not modelled", record.place)
    return (
        kind,
        2 * size * unit if record.keyword == "EBR" else size,
        (f"{record.keyword} is {shown(record.words[0])}", record.place),
    )


def _fields(parts: Sections, far: bool, unit: float, report: Draft) -> tuple[str, list[float]]:
    """Points on the y axis, at FRACTIONS of the largest field, the only one in the file."""
    records = parts.system.all("ANG", "OBH")
    if not records:
        report.note("neither ANG nor OBH: the field is the axis")
        return "angle", [0.0]
    record = records[-1]
    if len(records) > 1:
        names = " and ".join(f"{other.keyword} in line {other.place.line}" for other in records)
        report.warn(f"several fields ({names}); the last is used", record.place)
    most = record.number(0, "field")
    if record.keyword == "ANG" and not far:
        raise UnsupportedSurface("ANG (a field angle) of a near object is not modelled", record.place)
    if most:
        fractions = ", ".join(f"{fraction:g}" for fraction in FRACTIONS)
        report.note(f"fields: {fractions} of the largest one, which {record.keyword} gives")
    if not far:
        return "object_height", [fraction * most * unit for fraction in FRACTIONS] if most else [0.0]
    if record.keyword == "ANG":
        if abs(most) >= 90:
            raise LensFileError(f"ANG is {shown(record.words[0])}, expected less than 90 degrees", record.place)
        tangent = math.tan(math.radians(most))
    else:
        tangent = -most / parts.surfaces[0].last("TH").number(0, "thickness")
    angles = [math.degrees(math.atan(fraction * tangent)) for fraction in FRACTIONS]
    angles[-1] = most if record.keyword == "ANG" else angles[-1]
    return "angle", angles if tangent else [0.0]


def _stop(parts: Sections, report: Draft) -> Place:
    marks = [record for surface in parts.surfaces if (record := surface.last("AST"))]
    if not marks:
        report.note("no AST: surface 1 is the stop")
        return parts.surfaces[1].place
    if len(marks) > 1:
        message = f"a second AST; surface {marks[0].place.surface} is the stop already"
        raise LensFileError(message, marks[1].place)
    return marks[0].place


def _solved(
    parts: Sections, built: Sequence[Built], primary: float, beam: float | None, unit: float, report: Draft
) -> list[Surface]:
    """The surfaces with the results of solves, and a note where the focal length differs from that of the file.

    beam: mm, diameter of the axial beam on surface 1 where the file gives it.
    """
    steps: list[Step] = []
    for part in built:
        steps.append(step_of(part, primary, steps[-1] if steps else None))
    solves = [record for part in built for record in part.commands.all("PU", "PY")]
    if solves and any(is_posed(part.surface) for part in built):
        message = f"{solves[0].keyword} (a solve) in a lens with tilted or decentred surfaces is not modelled"
        raise UnsupportedSurface(message, solves[0].place)
    solve(steps, None if beam is None else 0.5 * beam, unit)
    for step in steps:
        for record in filter(None, (step.slope, step.height)):
            value = f"curvature {step.curvature:.9g}" if record is step.slope else f"thickness {step.thickness:.9g}"
            words = f"{record.keyword} {record.words[0]}"
            report.note(f"surface {record.place.surface}: {words} solved again, {value} in mm")
    stated, focal = _stated(parts)[:1], focal_length(steps)
    if stated and focal is not None:
        length = number(stated[0], "focal length", parts.head.place) * unit
        if abs(abs(length) - abs(focal)) > 1e-4 * abs(focal):
            message = f"LEN NEW states a focal length of {length:.6g} mm, the lens as read has {focal:.6g}"
            report.note(f"{message}: by glasses of another edition, or the number was typed in")
    return [solved(part.surface, step) for part, step in zip(built, steps, strict=True)]
