"""Read a lens of CODE V (.seq): a sequence of commands.

Three stages: text -> commands with line numbers -> the table of commands -> Lens. Conventions, each verified against
numbers that CODE V stored in public files, or against two other programs' readers of such files:

- RDM: the numbers of surfaces are radii; RDM N: curvatures. One of them is required. 0 is a plane in both.
- An object at 1e10 or further away is at infinity. The thickness of SI is the defocus: it adds to the one before.
- Solves and pick-ups (PIK) are stored with their results; PIM, the paraxial image, is solved again where it disagrees.
- WL is in nm, REF counts from 1. A to J are the coefficients of r⁴ to r²⁰, K the conic constant.
- VUY, VLY: the fractions of the pupil's radius that are cut off above and below: compression (VUY + VLY)/2, decentre
  (VLY - VUY)/2 of it; VUX, VLX likewise.
- CIR, REX and REY, ELX and ELY are radii and half-widths, and clip; with OBS they obscure, EDG is the edge of the part.
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

from raytrace.io.assembly import MOST_POINTS, LensDraft, assemble
from raytrace.io.codev import glass as codev_glass
from raytrace.io.codev.keywords import FIELD_KINDS, OWN, Sections, sections, unquoted
from raytrace.io.codev.surfaces import build
from raytrace.io.report import Draft
from raytrace.io.source import Block, LensFileError, Place, Record, double, number, plain_text, shown, words
from raytrace.materials.glass import AIR, refractive_index
from raytrace.system.lens import RAY_AIMING, Lens
from raytrace.system.phases import power_of
from raytrace.system.surface import Surface, vertex_curvature

#: Millimetres in a unit of DIM.
_UNITS = {"M": 1.0, "MM": 1.0, "C": 10.0, "CM": 10.0, "I": 25.4, "IN": 25.4, "INCH": 25.4}

#: Tolerated relative error of the stored distance of a paraxial image, due to indices of another catalog.
_SOLVED = 1e-6


def read(text: str, file: str, report: Draft, catalogs: Sequence[Path] = ()) -> Lens:
    """The lens of a .seq text; report: filled. Raises LensFileError, UnsupportedSurface and UnknownGlass."""
    parts = sections(text, file, report)
    system, count = parts.system, len(parts.surfaces)
    if count < 3:
        message = f"{count} surfaces, expected at least object, one surface and image"
        raise LensFileError(message, parts.surfaces[-1].place)
    unit = _unit(system, report)
    wave_words, source = _list(system, "WL") or (None, None)
    if wave_words is None:
        raise LensFileError("no wavelengths (WL)", system.place)
    waves = [codev_glass.micrometres(word, source.place) for word in wave_words]
    reference = system.last("REF")
    if reference is None and len(waves) > 1:
        message = f"no REF: the reference of the {len(waves)} wavelengths is not specified; add REF 1 to {len(waves)}"
        raise LensFileError(message, source.place)
    private = codev_glass.private_glasses(parts.private, waves, _own_words(parts, "UNNAMED"), report)
    glasses = [record.words[0] for block in parts.surfaces for record in block.all("GLA") if record.words]
    came = codev_glass.came_with(file, glasses, catalogs, report)
    library = codev_glass.GlassLibrary(private, came, catalogs, waves)
    surfaces, before = [], AIR
    for k, block in enumerate(parts.surfaces):
        own = {record.keyword: record for record in parts.own if record.place.surface == k}
        surface = build(block, unit, before, own=own, library=library, report=report)
        before = before if surface.is_mirror or surface.is_break else surface.glass
        surfaces.append(surface)
    solve, primary = system.last("PIM"), reference.integer(0, "number of the reference wavelength") if reference else 1
    if solve and not (solve.words and solve.words[0][:1] in "Nn") and 1 <= primary <= len(waves):
        surfaces = _at_paraxial_image(surfaces, double(waves[primary - 1]), solve.place, report)
    *front, last, image = surfaces  # the thickness of the image is the defocus
    last = dataclasses.replace(last, thickness=last.thickness + image.thickness)
    focused = [*front, last, dataclasses.replace(image, thickness=torch.zeros_like(image.thickness))]
    weights, title = _numbers(system, "WTW", "weight"), system.last("TIT")
    stop, aperture = _stop(parts.surfaces, report), _aperture(system, surfaces[0], unit)
    catalog_names = _own_words(parts, "CATALOGS")
    if not any(record.keyword == "CATALOGS" for record in parts.own):
        catalog_names = dict.fromkeys(surface.glass.catalog for surface in surfaces if surface.glass.catalog)
    draft = LensDraft(
        surfaces=focused,
        stop=stop.surface,
        aperture_kind=aperture[0],
        aperture=aperture[1],
        **_fields(system, unit, report),
        wavelengths=waves,
        wavelength_weights=weights and weights[0],
        primary_wavelength=primary,
        name=_title(title) if title else "",
        notes=tuple(plain_text(record.text) for record in parts.own if record.keyword == "NOTE"),
        catalogs=tuple(catalog_names),
        ray_aiming=_aiming(parts, report),
        sources={"stop": ("STO", stop), "aperture": aperture[2], "wavelengths": ("WL", source.place)},
    )
    for quantity, keyword in (("wavelength_weights", "WTW"), ("primary_wavelength", "REF")):
        if record := system.last(keyword):
            draft.sources[quantity] = (keyword, record.place)
    lens = assemble(draft, file)
    _report_left_out(system, report)
    return lens


def _title(record: Record) -> str:
    return (unquoted(record.words[0]) if len(record.words) == 1 else " ".join(record.words)).strip()


def _unit(system: Block, report: Draft) -> float:
    record = system.last("DIM")
    if record is None:
        report.warn("no DIM: lengths are taken for mm", system.place)
        return 1.0
    word = unquoted(record.words[0]).upper() if record.words else ""
    if word not in _UNITS:
        raise LensFileError(f"DIM is {shown(word)}, expected M (mm), C (cm) or I (inches)", record.place)
    if _UNITS[word] != 1:
        report.note(f"lengths of the file are in {'cm' if word[0] == 'C' else 'inches'}; converted to mm")
    return _UNITS[word]


def _at_paraxial_image(surfaces: list[Surface], wavelength: Tensor, place: Place, report: Draft) -> list[Surface]:
    """The image at its paraxial distance (PIM): the stored one, or the one of an axial ray where they differ.

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
    message = f"PIM puts the image at {float(solved):.9g} mm, where {float(stored):.9g} mm is stored"
    if not bool(torch.isfinite(solved)):
        raise LensFileError(f"{message}; write the distance and leave out PIM", place)
    report.warn(f"{message}; the former is taken", place)
    return [first, *others[:-1], dataclasses.replace(others[-1], thickness=solved), image]


def _stop(surfaces: Sequence[Block], report: Draft) -> Place:
    stops = [record for block in surfaces if (record := block.last("STO"))]
    if not stops:
        report.warn("no STO: surface 1 is taken for the stop, as CODE V does", surfaces[1].place)
        return surfaces[1].place
    stop = max(stops, key=lambda record: record.place.line)
    if len(stops) > 1:
        report.warn(f"several stops (STO); the last, surface {stop.place.surface}, is used", stop.place)
    return stop.place


def _aperture(system: Block, first: Surface, unit: float) -> tuple[str, float, tuple[str, Place]]:
    """The system aperture: EPD, FNO (of an object at infinity) or NAO."""
    records = system.all("EPD", "FNO", "NAO")
    if not records:
        raise LensFileError("no system aperture; expected one of EPD, FNO, NAO", system.place)
    record = records[-1]
    if len({other.keyword for other in records}) > 1:
        names = " and ".join(f"{other.keyword} in line {other.place.line}" for other in records)
        raise LensFileError(f"several system apertures ({names}), expected one", record.place)
    size = record.number(0, "size of the aperture")
    source = (f"{record.keyword} is {shown(record.words[0])}", record.place)
    if record.keyword == "EPD":
        return "entrance_pupil_diameter", size * unit, source
    if record.keyword == "NAO":
        return "object_na", size, source
    if not bool(torch.isinf(first.thickness)):
        message = "FNO of an object at a finite distance: the distance that it refers to is not documented"
        raise LensFileError(f"{message}; give EPD or NAO", record.place)
    return "image_f_number", size, source


# -- lists over fields and wavelengths --------------------------------------------------------------------------------


def _list(system: Block, keyword: str) -> tuple[list[str], Record] | None:
    """The words of a list, with those that are set one by one (F2, W1); None if it is absent."""
    listed: list[str] = []
    for record in system.all(keyword):
        first = record.words[0].upper() if record.words else ""
        if first[:1] in "FW" and first[1:].isdigit():
            position = int(first[1:]) - 1
            if not 0 <= position < MOST_POINTS or len(record.words) != 2:
                raise LensFileError(f"{keyword} {first[:20]}, expected a number from 1 and its value", record.place)
            listed += ["0"] * (position + 1 - len(listed))
            listed[position] = record.words[1]
        else:
            listed = [unquoted(word) for word in record.words]
        if not listed or len(listed) > MOST_POINTS:
            message = f"{keyword} has {len(listed)} values, expected 1 to {MOST_POINTS}"
            raise LensFileError(message, record.place)
    return (listed, record) if listed else None


def _numbers(system: Block, keyword: str, quantity: str) -> tuple[list[float], Record] | None:
    listed = _list(system, keyword)
    return listed and ([number(word, f"{keyword}: {quantity}", listed[1].place) for word in listed[0]], listed[1])


def _fields(system: Block, unit: float, report: Draft) -> dict:
    """The field points of one kind, their weights and vignetting factors."""
    kinds = [kind for kind, pair in FIELD_KINDS.items() if system.all(*pair)]
    if len(kinds) > 1:
        names = " and ".join("/".join(FIELD_KINDS[kind]) for kind in kinds)
        place = system.all(*FIELD_KINDS[kinds[1]])[0].place
        raise LensFileError(f"fields of several kinds ({names}), expected one", place)
    if not kinds:
        report.warn("no fields (YAN, YOB, YIM, YRI): on axis only", system.place)
    kind = kinds[0] if kinds else "angle"
    lists = [_numbers(system, keyword, "field") for keyword in FIELD_KINDS[kind]]
    count = max([len(values) for values, _ in filter(None, lists)], default=1)
    for values, record in filter(None, lists):
        if len(values) != count:
            raise LensFileError(f"{record.keyword} has {len(values)} values for {count} fields", record.place)
    length = 1.0 if kind == "angle" else unit
    x, y = ([length * value for value in listed[0]] if listed else [0.0] * count for listed in lists)
    return {
        "field_kind": kind,
        "x": x,
        "y": y,
        "field_weights": _per_field(system, "WTF", count, 1.0, report),
        "vignetting": _vignetting(system, count, report),
    }


def _per_field(system: Block, keyword: str, count: int, default: float, report: Draft) -> list[float]:
    listed = _numbers(system, keyword, "value of a field")
    if listed is None:
        return [default] * count
    values, record = listed
    if len(values) < count:
        message = f"{keyword} has {len(values)} values for {count} fields; the others are taken as {default:g}"
        report.warn(message, record.place)
    return (values + [default] * count)[:count]


def _vignetting(system: Block, count: int, report: Draft) -> list[list[float]]:
    """Decentre and compression of the pupil from the fractions that are cut off on either side, each rounded once."""
    rows = {}
    for axis in "XY":
        cut = []
        for side in "UL":
            _per_field(system, f"V{side}{axis}", count, 0.0, report)
            listed = (_list(system, f"V{side}{axis}") or ([],))[0]
            cut.append([Fraction(word.upper().replace("D", "E")) for word in (listed + ["0"] * count)[:count]])
        rows[f"D{axis}"] = [float((low - high) / 2) for high, low in zip(*cut, strict=True)]
        rows[f"C{axis}"] = [float((low + high) / 2) for high, low in zip(*cut, strict=True)]
        sides = [side for side in "UL" if system.last(f"V{side}{axis}")]
        if axis == "X" and len(sides) == 1 and any(rows["CX"]):
            record = system.last(f"V{sides[0]}X")
            raise LensFileError(f"{record.keyword} without its other side; give VUX and VLX", record.place)
    return [rows["DX"], rows["DY"], rows["CX"], rows["CY"], [0.0] * count]


# -- comments of this package, and commands that are left out ---------------------------------------------------------


def _own_words(parts: Sections, keyword: str) -> list[str]:
    return [word for record in parts.own if record.keyword == keyword for word in words(" ".join(record.words[1:]))]


def _aiming(parts: Sections, report: Draft) -> str:
    """CODE V aims reference rays at the stop; EPD is the diameter of the real beam on the axis."""
    comments = [record for record in parts.own if record.keyword == "AIMING"]
    if not comments:
        report.note(
            "ray aiming is not specified: real, as CODE V aims at the stop, which is as wide as the real marginal ray "
            "of the axial beam: EPD holds on the axis"
        )
        return "real"
    word = comments[-1].text.strip().lower()
    if word not in RAY_AIMING:
        message = f"{OWN.lower()} aiming is {shown(word)}, expected one of {', '.join(RAY_AIMING)}"
        raise LensFileError(message, comments[-1].place)
    return word


def _report_left_out(system: Block, report: Draft) -> None:
    """Warn of environment, apodisation, zoom positions and unused apertures, which the lens does not carry."""
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
