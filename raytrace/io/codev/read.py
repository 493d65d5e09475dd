"""Read a lens of CODE V (.seq): a sequence of commands.

Three stages: text -> commands with line numbers -> the table of commands -> Lens. Conventions, each settled by figures
that CODE V stored in public files, or by what the makers of two other programs take from such files:

- RDM: the numbers of surfaces are radii; RDM N: curvatures. One of them has to be said. 0 is a plane in both.
- An object at 1e10 or further away is at infinity. The thickness of SI is the defocus: it adds to the one before.
- What solves and pick-ups (PIK) find is stored, and read; PIM, the paraxial image, is solved again where it disagrees.
- WL is in nm, REF counts from 1. A to J are the coefficients of r⁴ to r²⁰, K the conic constant.
- VUY, VLY: the fractions of the pupil's radius that are cut off above and below: compression (VUY + VLY)/2, decentre
  (VLY - VUY)/2 of it; VUX, VLX likewise.
- CIR, REX and REY, ELX and ELY are radii and half-widths, and clip; with OBS they obscure, EDG tells the part.
- XDE YDE ZDE decentre, then ADE BDE CDE tilt about x, y, z, the first two left-handed, all the axes that follow; with
  DAR those of this surface alone, with REV those behind it, back. BEN tilts again behind a mirror.
- DIF DOE with HCT R adds the path HOR λ/HWL Σ C_j r^2j.
- Rays are aimed at the stop, along paraxial lines.
- Of zoom positions (ZOO) the first is read.
"""

import dataclasses
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import torch
from torch import Tensor

from raytrace.io.codev import glass as seq_glass
from raytrace.io.codev import surfaces as seq_surface
from raytrace.io.codev.keywords import FIELD_KINDS, OWN, Sections, sections, unquoted
from raytrace.io.report import Draft, ImportReport
from raytrace.io.source import LensFileError, Place, shown
from raytrace.io.spelling import double, number, plain_text, refuse_overflow
from raytrace.io.spelling import words as split
from raytrace.io.substitutes import NONE, Substitutes
from raytrace.io.zemax.keywords import Block, Record
from raytrace.materials.glass import AIR, refractive_index
from raytrace.system.lens import RAY_AIMING, Fields, Lens, SystemAperture
from raytrace.system.phases import power_of
from raytrace.system.surface import Surface, vertex_curvature

#: Millimetres in a unit of DIM.
UNITS = {"M": 1.0, "MM": 1.0, "C": 10.0, "CM": 10.0, "I": 25.4, "IN": 25.4, "INCH": 25.4}

#: More field points or wavelengths than any file has.
_MOST = 1000

#: How far the stored distance of a paraxial image may be from where it is, by the indices of another catalog.
_SOLVED = 1e-6


def read(
    text: str,
    file: str,
    *,
    catalogs: Sequence[Path] = (),
    strict: bool = False,
    substitutes: Substitutes = NONE,
) -> tuple[Lens, ImportReport]:
    """The lens of a .seq text and the report of its import.

    file: its name, for messages. catalogs: further glass catalogs (.agf). strict: every warning is an error.
    substitutes: of glasses.
    Raises LensFileError, UnsupportedSurface (what is not modelled) and UnknownGlass.
    """
    report = Draft(file, "seq", substitutes)
    found = sections(text, file, report)
    system, count = found.system, len(found.surfaces)
    if count < 3:
        raise LensFileError(
            f"{count} surfaces, expected at least object, one surface and image", found.surfaces[-1].place
        )
    unit = _unit(system, report)
    wavelengths, weights, primary = _wavelengths(system)
    private = seq_glass.private_glasses(found.private, wavelengths.tolist(), _own_words(found, "UNNAMED"), report)
    words = [record.words[0] for block in found.surfaces for record in block.all("GLA") if record.words]
    shelf = seq_glass.Shelf(private, seq_glass.came_with(file, words, catalogs, report), catalogs, wavelengths.tolist())
    surfaces = _surfaces(found, unit, shelf, report)
    solve = system.last("PIM")
    if solve and not (solve.words and solve.words[0][:1] in "Nn"):
        surfaces = _at_paraxial_image(surfaces, wavelengths[primary - 1], solve.place, report)
    title = system.last("TIT")
    lens = Lens(
        surfaces=_focused(surfaces),
        stop=_stop(found.surfaces, report),
        aperture=_aperture(system, surfaces[0], unit),
        fields=_fields(system, unit, report),
        wavelengths=wavelengths,
        wavelength_weights=weights,
        primary_wavelength=primary,
        name=_text(title).strip() if title else "",
        notes=tuple(plain_text(record.text) for record in found.own if record.keyword == "NOTE"),
        catalogs=_catalogs(found, surfaces),
        ray_aiming=_aiming(found, report),
    )
    refuse_overflow(lens, file)
    _remarks(system, report)
    return lens, report.finished(strict=strict)


def _text(record: Record) -> str:
    return unquoted(record.words[0]) if len(record.words) == 1 else " ".join(record.words)


def _unit(system: Block, report: Draft) -> float:
    record = system.last("DIM")
    if record is None:
        report.warn("no DIM: lengths are taken for mm", system.place)
        return 1.0
    word = unquoted(record.words[0]).upper() if record.words else ""
    if word not in UNITS:
        raise LensFileError(f"DIM is {shown(word)}, expected M (mm), C (cm) or I (inches)", record.place)
    if UNITS[word] != 1:
        report.note(f"lengths of the file are in {'cm' if word[0] == 'C' else 'inches'}; converted to mm")
    return UNITS[word]


def _surfaces(found: Sections, unit: float, shelf: seq_glass.Shelf, report: Draft) -> tuple[Surface, ...]:
    surfaces, before = [], AIR
    for k, block in enumerate(found.surfaces):
        own = {record.keyword: record for record in found.own if record.place.surface == k}
        surface = seq_surface.build(block, unit, before, own=own, shelf=shelf, report=report)
        before = before if surface.is_mirror or surface.is_break else surface.glass
        surfaces.append(surface)
    return tuple(surfaces)


def _focused(surfaces: Sequence[Surface]) -> tuple[Surface, ...]:
    """The defocus, which is the thickness of the image, added to the distance before it."""
    *lens, last, image = surfaces
    last = dataclasses.replace(last, thickness=last.thickness + image.thickness)
    return (*lens, last, dataclasses.replace(image, thickness=torch.zeros_like(image.thickness)))


def _at_paraxial_image(
    surfaces: tuple[Surface, ...], wavelength: Tensor, place: Place, report: Draft
) -> tuple[Surface, ...]:
    """The image at its paraxial distance (PIM): as it is stored, or else where a ray along the axis puts it.

    y-nu of a ray from the axial object point: n' u' = n u - y c (n' - n), the index changes its sign at mirrors.
    """
    first, *others, image = surfaces
    index, y = refractive_index(first.glass, wavelength), torch.ones_like(wavelength)
    slope = index / first.thickness
    for surface in others:
        if surface.is_break:
            behind = index
        elif surface.is_mirror:
            behind = -index
        else:
            behind = index.sign() * refractive_index(surface.glass, wavelength)
        power = 0.0 if surface.phase is None else power_of(surface.phase, wavelength)[1]
        slope, index = slope - y * (vertex_curvature(surface) * (behind - index) + power), behind
        before, y = y, y + surface.thickness * slope / index
    solved, stored = -before * index / slope, others[-1].thickness
    if bool((solved - stored).abs() <= _SOLVED * stored.abs()):
        return surfaces
    found = f"PIM puts the image to {float(solved):.9g} mm, where {float(stored):.9g} mm is stored"
    if not bool(torch.isfinite(solved)):
        raise LensFileError(f"{found}; write the distance and leave out PIM", place)
    report.warn(f"{found}; the former is taken", place)
    return (first, *others[:-1], dataclasses.replace(others[-1], thickness=solved), image)


def _stop(surfaces: Sequence[Block], report: Draft) -> int:
    stops = [block for block in surfaces if block.last("STO")]
    if not stops:
        report.warn("no STO: surface 1 is taken for the stop, as CODE V does", surfaces[1].place)
        return 1
    stop = max((block.last("STO") for block in stops), key=lambda record: record.place.line)
    if not 0 < stop.place.surface < len(surfaces) - 1:
        raise LensFileError("STO on the object or the image; expected a surface between them", stop.place)
    if len(stops) > 1:
        report.warn(f"several stops (STO); the last, surface {stop.place.surface}, is used", stop.place)
    return stop.place.surface


def _aperture(system: Block, first: Surface, unit: float) -> SystemAperture:
    """The system aperture: EPD, FNO (of an object at infinity) or NAO."""
    found = system.all("EPD", "FNO", "NAO")
    if not found:
        raise LensFileError("no system aperture; expected one of EPD, FNO, NAO", system.place)
    record = found[-1]
    if len({other.keyword for other in found}) > 1:
        names = " and ".join(f"{other.keyword} in line {other.place.line}" for other in found)
        raise LensFileError(f"several system apertures ({names}), expected one", record.place)
    size = record.number(0, "size of the aperture")
    if size <= 0:
        raise LensFileError(f"{record.keyword} is {shown(record.words[0])}, expected a positive number", record.place)
    if record.keyword == "EPD":
        return SystemAperture("entrance_pupil_diameter", double(size * unit))
    if record.keyword == "NAO":
        return SystemAperture("object_na", double(size))
    if not bool(torch.isinf(first.thickness)):
        message = "FNO of an object at a finite distance: which distance it is meant for is not settled"
        raise LensFileError(f"{message}; give EPD or NAO", record.place)
    return SystemAperture("image_f_number", double(size))


# -- lists over fields and wavelengths --------------------------------------------------------------------------------


def _list(system: Block, keyword: str) -> tuple[list[str], Record] | None:
    """The words of a list, those that are set one by one (F2, W1) in their places; None if it is absent."""
    words: list[str] = []
    for record in system.all(keyword):
        first = record.words[0].upper() if record.words else ""
        if first[:1] in "FW" and first[1:].isdigit():
            position = int(first[1:]) - 1
            if not 0 <= position < _MOST or len(record.words) != 2:
                raise LensFileError(f"{keyword} {first[:20]}, expected a number from 1 and its value", record.place)
            words += ["0"] * (position + 1 - len(words))
            words[position] = record.words[1]
        else:
            words = [unquoted(word) for word in record.words]
        if not words or len(words) > _MOST:
            raise LensFileError(f"{keyword} has {len(words)} values, expected 1 to {_MOST}", record.place)
    return (words, record) if words else None


def _numbers(system: Block, keyword: str, what: str) -> tuple[list[float], Record] | None:
    found = _list(system, keyword)
    return found and ([number(word, f"{keyword}: {what}", found[1].place) for word in found[0]], found[1])


def _wavelengths(system: Block) -> tuple[Tensor, Tensor, int]:
    """Wavelengths in µm, their weights, and the 0-based position of the reference."""
    found = _list(system, "WL")
    if found is None:
        raise LensFileError("no wavelengths (WL)", system.place)
    words, record = found
    waves = [seq_glass.micrometres(word, record.place) for word in words]
    for word, wave in zip(words, waves, strict=True):
        if not wave > 0:
            raise LensFileError(f"WL is {shown(word)}, expected a wavelength in nm", record.place)
    weights, _ = _numbers(system, "WTW", "weight") or ([1.0] * len(waves), record)
    if len(weights) != len(waves) or min(weights) < 0:
        place = system.last("WTW").place
        raise LensFileError(
            f"{len(weights)} weights (WTW) for {len(waves)} wavelengths, expected as many, 0 or more", place
        )
    reference = system.last("REF")
    if reference is None and len(waves) > 1:
        message = (
            f"no REF: which of the {len(waves)} wavelengths is the reference is not said; add REF 1 to {len(waves)}"
        )
        raise LensFileError(message, record.place)
    primary = reference.integer(0, "number of the reference wavelength") if reference else 1
    if not 1 <= primary <= len(waves):
        raise LensFileError(f"REF is {primary}, expected 1 to {len(waves)}, the number of wavelengths", reference.place)
    return double(waves), double(weights), primary


def _fields(system: Block, unit: float, report: Draft) -> Fields:
    """The field points of one kind, their weights and vignetting factors."""
    kinds = [kind for kind, pair in FIELD_KINDS.items() if system.all(*pair)]
    if len(kinds) > 1:
        names = " and ".join("/".join(FIELD_KINDS[kind]) for kind in kinds)
        raise LensFileError(
            f"fields of several kinds ({names}), expected one", system.all(*FIELD_KINDS[kinds[1]])[0].place
        )
    if not kinds:
        report.warn("no fields (YAN, YOB, YIM, YRI): on axis only", system.place)
    kind = kinds[0] if kinds else "angle"
    lists = [_numbers(system, keyword, "field") for keyword in FIELD_KINDS[kind]]
    count = max([len(found[0]) for found in lists if found], default=1)
    for found in filter(None, lists):
        if len(found[0]) != count:
            message = f"{found[1].keyword} has {len(found[0])} values for {count} fields"
            raise LensFileError(message, found[1].place)
    x, y = (found[0] if found else [0.0] * count for found in lists)
    length = 1.0 if kind == "angle" else unit
    return Fields(
        kind=kind,
        x=double([length * value for value in x]),
        y=double([length * value for value in y]),
        weight=double(_per_field(system, "WTF", count, 1.0, report)),
        vignetting=_vignetting(system, count, report),
    )


def _per_field(system: Block, keyword: str, count: int, default: float, report: Draft) -> list[float]:
    found = _numbers(system, keyword, "value of a field")
    if found is None:
        return [default] * count
    values, record = found
    if len(values) < count:
        message = f"{keyword} has {len(values)} values for {count} fields; the others are taken as {default:g}"
        report.warn(message, record.place)
    return (values + [default] * count)[:count]


def _vignetting(system: Block, count: int, report: Draft) -> Tensor | None:
    """Decentre and compression of the pupil from what is cut off on either side, each rounded once."""
    rows = {}
    for axis in "XY":
        cut = []
        for side in "UL":
            _per_field(system, f"V{side}{axis}", count, 0.0, report)
            words = (_list(system, f"V{side}{axis}") or ([],))[0]
            words = (words + ["0"] * count)[:count]
            cut.append([Fraction(word.upper().replace("D", "E")) for word in words])
        rows[f"D{axis}"] = [float((low - high) / 2) for high, low in zip(*cut, strict=True)]
        rows[f"C{axis}"] = [float((low + high) / 2) for high, low in zip(*cut, strict=True)]
        given = [side for side in "UL" if system.last(f"V{side}{axis}")]
        if axis == "X" and len(given) == 1 and any(rows["CX"]):
            record = system.last(f"V{given[0]}X")
            raise LensFileError(f"{record.keyword} without its other side; give VUX and VLX", record.place)
    factors = double([rows["DX"], rows["DY"], rows["CX"], rows["CY"], [0.0] * count])
    return factors if bool(factors.any()) else None


# -- what CODE V has no command for, and what the lens has no place for -----------------------------------------------


def _own_words(found: Sections, keyword: str) -> list[str]:
    return [word for record in found.own if record.keyword == keyword for word in split(" ".join(record.words[1:]))]


def _catalogs(found: Sections, surfaces: Sequence[Surface]) -> tuple[str, ...]:
    """The catalogs that are told, else those of the glasses in their order."""
    if any(record.keyword == "CATALOGS" for record in found.own):
        return tuple(_own_words(found, "CATALOGS"))
    return tuple(dict.fromkeys(surface.glass.catalog for surface in surfaces if surface.glass.catalog))


def _aiming(found: Sections, report: Draft) -> str:
    """CODE V aims reference rays at the stop; EPD is the diameter of the real beam on the axis."""
    told = [record for record in found.own if record.keyword == "AIMING"]
    if not told:
        report.note(
            "ray aiming is not specified: real, as CODE V aims at the stop, which is as wide as the real marginal ray "
            "of the axial beam: EPD holds on the axis"
        )
        return "real"
    word = told[-1].text.strip().lower()
    if word not in RAY_AIMING:
        message = f"{OWN.lower()} aiming is {shown(word)}, expected one of {', '.join(RAY_AIMING)}"
        raise LensFileError(message, told[-1].place)
    return word


def _remarks(system: Block, report: Draft) -> None:
    """Say what the file asks for and the lens does not carry: environment, zoom positions, unused apertures."""
    for keyword, normal, unit in (("TEM", (20.0, 22.0), "°C"), ("PRE", (760.0, 1.0), "mm Hg")):
        record = system.last(keyword)
        if record and record.number(0, "environment", normal[0]) not in normal:
            message = f"{keyword} {record.words[0][:20]} {unit}: indices are those of 20 °C and 1 atm"
            report.warn(message, record.place)
    beam = system.last("PUI", "PUX", "PUY")
    if beam:
        report.warn(f"the beam is apodised ({beam.keyword}); taken as uniform", beam.place)
    zoom = system.last("ZOO")
    if zoom and zoom.words and zoom.integer(0, "number of zoom positions") > 1:
        report.warn(f"{zoom.words[0][:20]} zoom positions (ZOO): the first is read", zoom.place)
    used = system.last("CA")
    if used and used.words and used.words[0].upper()[:2] == "NO":
        report.warn("apertures are not to be used (CA NO); here they clip", used.place)
