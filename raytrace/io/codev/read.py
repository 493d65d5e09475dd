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
- DIF DOE with HCT R adds the path HOR λ/HWL Σ_j C_j r^2j, with C_j of HCO Cj in units of length and HWL in nm. A
  `RadialPhase` has A_j = 2π C_j radius^2j/HWL in radians at a radius of its own, rounded once; they come back.
- Rays are aimed at the stop, whose radius is that of the real marginal ray.
- Of zoom positions (ZOO) the first is read.
"""

import dataclasses
import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import torch
from torch import Tensor

from raytrace.io.assembly import (
    BENT,
    MOST_POINTS,
    ONWARD,
    LensDraft,
    assemble,
    clear_aperture,
    poses_of,
    with_written_automatic,
    with_written_conditions,
    with_written_variables,
)
from raytrace.io.codev import glass as codev_glass
from raytrace.io.codev.keywords import (
    APERTURES,
    COMMENT,
    FIELD_KINDS,
    INFINITY,
    LEFT_HANDED,
    LETTERS,
    MOST_TERMS,
    NANOMETRE,
    POSE_TYPES,
    POSE_WORDS,
    RING,
    SYSTEM_APERTURES,
    Stream,
    sections,
    unquoted,
)
from raytrace.io.source import (
    Block,
    Draft,
    LensFileError,
    Place,
    Record,
    UnsupportedSurface,
    double,
    in_lines,
    is_infinite,
    nonzero,
    number,
    plain_text,
    refuse_few,
    shown,
    unit_of,
    words,
)
from raytrace.materials.glass import AIR, MIRROR, Glass, refractive_index
from raytrace.system.apertures import Aperture
from raytrace.system.lens import RAY_AIMING, Lens
from raytrace.system.phases import RadialPhase
from raytrace.system.poses import Pose
from raytrace.system.surface import SIZES, Surface, medium_surfaces, power, signed, ynu

#: Millimetres in a unit of DIM.
_UNITS = {"M": 1.0, "MM": 1.0, "C": 10.0, "CM": 10.0, "I": 25.4, "IN": 25.4, "INCH": 25.4}

#: Tolerated relative error of the stored distance of a paraxial image, due to indices of another catalog.
_SOLVED = 1e-6

#: Kinds of aperture: clear, obscuration, edge of the part, hole in it.
_KINDS = ("CLR", "OBS", "EDG", "HOL")


def read(text: str, file: str, report: Draft, catalogs: Sequence[Path] = ()) -> Lens:
    """The lens of a .seq text; report: filled. Raises LensFileError, UnsupportedSurface and UnknownGlass."""
    parts = sections(text, file, report)
    system = parts.system
    refuse_few(parts.surfaces)
    unit = _unit(system, report)
    listed, place = _list(system, "WL"), system.place_of("WL")
    if listed is None:
        raise LensFileError("no wavelengths (WL)", place)
    waves = [codev_glass.micrometres(word, place) for word in listed[0]]
    reference = system.last("REF")
    if reference is None and len(waves) > 1:
        message = f"no REF: the reference of the {len(waves)} wavelengths is not specified; add REF 1 to {len(waves)}"
        raise LensFileError(message, place)
    private = {name: codev_glass.private_glass(row, waves, report) for name, row in parts.private.items()}
    for name in {word.upper() for word in _comment_words(parts, "UNNAMED")} & private.keys():
        private[name] = dataclasses.replace(private[name], name="")
    glasses = [record.words[0] for block in parts.surfaces for record in block.all("GLA") if record.words]
    came = codev_glass.came_with(file, glasses, catalogs, report)
    library = codev_glass.GlassLibrary(private, came, catalogs, waves)
    surfaces, before = [], AIR
    for k, block in enumerate(parts.surfaces):
        comments = {record.keyword: record for record in parts.comments if record.place.surface == k}
        surface = _surface(block, unit, before, comments, library, report)
        before = before if surface.is_mirror or surface.is_break else surface.glass
        surfaces.append(surface)
    solve, primary = system.last("PIM"), system.integer("REF", "number of the reference wavelength", 1)
    if solve and not (solve.words and solve.words[0][:1] in "Nn") and 1 <= primary <= len(waves):
        surfaces = _at_paraxial_image(surfaces, double(waves[primary - 1]), solve.place, report)
    *front, last, image = surfaces  # the thickness of the image is the defocus
    last = dataclasses.replace(last, thickness=last.thickness + image.thickness)
    focused = [*front, last, dataclasses.replace(image, thickness=torch.zeros_like(image.thickness))]
    weights, title = _numbers(system, "WTW", "weight"), system.last("TIT")
    stop, aperture = _stop(parts.surfaces, report), _system_aperture(system, surfaces[0], unit)
    catalog_names = _comment_words(parts, "CATALOGS")
    if not any(record.keyword == "CATALOGS" for record in parts.comments):
        catalog_names = [*dict.fromkeys(surface.glass.catalog for surface in surfaces if surface.glass.catalog)]
    title_words = title.words if title else ()
    draft = LensDraft(
        surfaces=focused,
        stop=stop.surface or 0,
        aperture_kind=aperture[0],
        aperture=aperture[1],
        **_fields(system, unit, report),
        wavelengths=waves,
        wavelength_weights=weights and weights[0],
        primary_wavelength=primary,
        name=(unquoted(title_words[0]) if len(title_words) == 1 else " ".join(title_words)).strip(),
        notes=tuple(plain_text(record.text) for record in parts.comments if record.keyword == "NOTE"),
        catalogs=tuple(catalog_names),
        ray_aiming=_aiming(parts, report),
        afocal=_afocal(system),
        sources={"stop": ("STO", stop), "aperture": aperture[2], "wavelengths": ("WL", place)},
    )
    for quantity, keyword in (("wavelength_weights", "WTW"), ("primary_wavelength", "REF")):
        if record := system.last(keyword):
            draft.sources[quantity] = (keyword, record.place)
    lens = assemble(draft, file)
    _report_left_out(system, report)
    for keyword, read_into in (
        ("AUTOMATIC", with_written_automatic),
        ("VARIABLES", with_written_variables),
        ("CONDITIONS", with_written_conditions),
    ):
        for record in parts.comments:
            if record.keyword == keyword:
                lens = read_into(lens, record.text, record.place)
    return lens


def _afocal(system: Block) -> bool:
    """AFI: whether image space is afocal; without a word, or with Y, it is."""
    record = system.last("AFI")
    answer = unquoted(record.words[0]).upper() if record and record.words else "Y"
    if answer not in ("Y", "YES", "N", "NO"):
        raise LensFileError(f"AFI {answer}: expected Y or N, whether image space is afocal", system.place_of("AFI"))
    return record is not None and answer.startswith("Y")


def _unit(system: Block, report: Draft) -> float:
    record = system.last("DIM")
    if record is None:
        report.warn("no DIM: lengths are taken for mm", system.place)
        return 1.0
    word = unquoted(record.words[0]).upper() if record.words else ""
    return unit_of(word, _UNITS, "DIM", "M (mm), C (cm) or I (inches)", record.place, report)


def _at_paraxial_image(surfaces: list[Surface], wavelength: Tensor, place: Place, report: Draft) -> list[Surface]:
    """The image at its paraxial distance (PIM): the stored distance, or that of an axial ray where they differ."""
    first, *others, image = surfaces
    n = signed(others, [refractive_index(surfaces[k].glass, wavelength) for k in medium_surfaces(surfaces)[:-1]])
    powers = [power(s, before, behind, wavelength) for s, before, behind in zip(others, n[:-1], n[1:], strict=True)]
    gaps = [surface.thickness / index for surface, index in zip(others[:-1], n[1:-1], strict=True)]
    y, omega = ynu(torch.ones_like(wavelength), n[0] / first.thickness, powers, gaps)[-1]
    solved, stored = -y * n[-1] / omega, others[-1].thickness
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
    stop = max(stops, key=lambda record: record.place.line or 0)
    if len(stops) > 1:
        report.warn(f"several stops (STO); the last, surface {stop.place.surface}, is used", stop.place)
    return stop.place


def _system_aperture(system: Block, first: Surface, unit: float) -> tuple[str, float, tuple[str, Place]]:
    """The system aperture: EPD, FNO (of an object at infinity) or NAO."""
    records = system.all(*SYSTEM_APERTURES.values())
    if not records:
        raise LensFileError("no system aperture; expected one of EPD, FNO, NAO", system.place)
    record = records[-1]
    if len({other.keyword for other in records}) > 1:
        raise LensFileError(f"several system apertures ({in_lines(records)}), expected one", record.place)
    size = record.number(0, "size of the aperture")
    if record.keyword == "FNO" and not bool(torch.isinf(first.thickness)):
        message = "FNO of an object at a finite distance: the distance that it refers to is not documented"
        raise LensFileError(f"{message}; give EPD or NAO", record.place)
    kind = next(kind for kind, keyword in SYSTEM_APERTURES.items() if keyword == record.keyword)
    source = (f"{record.keyword} is {shown(record.words[0])}", record.place)
    return kind, size * unit if record.keyword == "EPD" else size, source


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
    values = [default] * count if listed is None else listed[0]
    if len(values) < count:
        message = f"{keyword} has {len(values)} values for {count} fields; the others are taken as {default:g}"
        report.warn(message, system.place_of(keyword))
    return (values + [default] * count)[:count]


def _vignetting(system: Block, count: int, report: Draft) -> list[list[float]]:
    """Decentre and compression of the pupil from the fractions that are cut off on either side, each rounded once."""
    decentres, compressions = [], []
    for axis in "XY":
        cut = []
        for side in "UL":
            _per_field(system, f"V{side}{axis}", count, 0.0, report)
            listed = (_list(system, f"V{side}{axis}") or ([],))[0]
            cut.append([_fraction(word) for word in (listed + ["0"] * count)[:count]])
        decentres.append([float((low - high) / 2) for high, low in zip(*cut, strict=True)])
        compressions.append([float((low + high) / 2) for high, low in zip(*cut, strict=True)])
        sides = [record for side in "UL" if (record := system.last(f"V{side}{axis}"))]
        if axis == "X" and len(sides) == 1 and any(compressions[0]):
            message = f"{sides[0].keyword} without its other side; give VUX and VLX"
            raise LensFileError(message, sides[0].place)
    return [*decentres, *compressions, [0.0] * count]


# -- comments of this package, and commands that are left out ---------------------------------------------------------


def _comment_words(parts: Stream, keyword: str) -> list[str]:
    texts = (" ".join(record.words[1:]) for record in parts.comments if record.keyword == keyword)
    return [word for text in texts for word in words(text)]


def _aiming(parts: Stream, report: Draft) -> str:
    """CODE V aims reference rays at the stop; EPD is the diameter of the real beam on the axis."""
    comments = [record for record in parts.comments if record.keyword == "AIMING"]
    if not comments:
        report.note(
            "ray aiming is not specified: real, as CODE V aims at the stop, which is as wide as the real marginal ray "
            "of the axial beam: EPD holds on the axis"
        )
        return "real"
    word = comments[-1].text.strip().lower()
    if word not in RAY_AIMING:
        message = f"{COMMENT.lower()} aiming is {shown(word)}, expected one of {', '.join(RAY_AIMING)}"
        raise LensFileError(message, comments[-1].place)
    return word


def _report_left_out(system: Block, report: Draft) -> None:
    """Warn of environment, apodisation, zoom positions and unused apertures, which the lens does not carry."""
    for keyword, normal, unit in (("TEM", (20.0, 22.0), "°C"), ("PRE", (760.0, 1.0), "mm Hg")):
        record = system.last(keyword)
        if record and record.number(0, "environment", normal[0]) not in normal:
            message = f"{keyword} {record.words[0][:20]} {unit}: indices are those of 20 °C and 1 atm"
            report.warn(message, record.place)
    if beam := system.last("PUI", "PUX", "PUY"):
        report.warn(f"the beam is apodised ({beam.keyword}); taken as uniform", beam.place)
    zoom, used = system.last("ZOO"), system.last("CA")
    if zoom and zoom.words and zoom.integer(0, "number of zoom positions") > 1:
        report.warn(f"{zoom.words[0][:20]} zoom positions (ZOO): the first is read", zoom.place)
    if used and used.words and used.words[0].upper()[:2] == "NO":
        report.warn("apertures are not to be used (CA NO); here they clip", used.place)


# -- a surface --------------------------------------------------------------------------------------------------------


def _surface(
    block: Block,
    unit: float,
    before: Glass,
    comments: dict[str, Record],
    library: codev_glass.GlassLibrary,
    report: Draft,
) -> Surface:
    """The surface of a block, its lengths in units of `unit` mm; before: the medium before it.

    comments: of this package: BREAK makes a coordinate break of a dummy surface, RADIUS is that of its phase, EXPANSION
    that of its spacer, CHIP_ZONE and MECHANICAL_SEMI_DIAMETER are sizes of the part.
    """
    apertures, semi_diameter = _apertures(block, unit, report)
    label, (ahead, behind) = block.last("SLB"), _poses(block, unit)
    glass, is_break = _medium(block, before, library, report), "BREAK" in comments
    radius, expansion, chip_zone, width = (
        number((stated.text or "?").strip(), word.lower(), stated.place) if (stated := comments.get(word)) else None
        for word in ("RADIUS", "EXPANSION", *(name.upper() for name in SIZES[1:]))
    )
    if is_break and ahead is None and behind is not None:
        ahead, behind = behind, None
    slope = block.number("CUY", "radius or curvature")  # 0 is a plane in both
    is_radius = slope and any(record.keyword == "RDY" for record in block.all("CUY")[-1:])
    return Surface(
        thickness=_thickness(block, unit),
        curvature=nonzero(1.0 / (slope * unit) if is_radius else slope / unit),
        **_conic_and_terms(block, unit),
        phase=_phase(block, 1.0 if radius is None else radius, unit),
        before=ahead,
        after=behind,
        is_break=is_break,
        glass=AIR if is_break else glass,
        semi_diameter=semi_diameter,
        apertures=apertures,
        comment=unquoted(label.words[0]).strip() if label and label.words else "",
        expansion=None if expansion is None else double(expansion),
        chip_zone=None if chip_zone is None else chip_zone * unit,
        mechanical_semi_diameter=None if width is None else width * unit,
    )


def _thickness(block: Block, unit: float) -> Tensor:
    record = block.last("THI")
    if record is None:
        raise LensFileError("surface without a thickness; S is followed by radius, thickness, glass", block.place)
    word = record.words[0] if record.words else ""
    is_object = block.place.surface == 0
    distance = math.inf if is_object and is_infinite(word) else number(word, "thickness", record.place)
    if is_object and distance <= -INFINITY:
        message = f"thickness is {shown(word)}, expected a distance or {INFINITY:g} for infinity"
        raise LensFileError(message, record.place)
    return double(math.inf if is_object and distance >= INFINITY else distance * unit)


def _conic_and_terms(block: Block, unit: float) -> dict:
    """The conic constant and the terms a_j of r^2j: A is a_2; those up to the last letter that is there."""
    flat, type_ = block.last("CUF"), block.last("TYPE")
    kind = type_.keyword if type_ else "SPH"
    if flat and flat.number(0, "CUF", 0.0):
        raise UnsupportedSurface(f"CUF {flat.words[0][:40]} (fraction of a curvature) is not modelled", flat.place)
    conic = block.number("K", "conic constant")
    if conic and kind == "SPH":
        raise LensFileError("K on a sphere; put CON or ASP before it", block.place_of("K"))
    records = {j: record for j, letter in enumerate(LETTERS, 2) if (record := block.last(letter))}
    terms = {j: record.number(0, "coefficient") for j, record in records.items()}
    if kind == "ASP":
        powers = range(2, max(records, default=1) + 1)
        coefficients = double([0.0, *(terms.get(j, 0.0) / unit ** (2 * j - 1) for j in powers)])
        return {"conic": nonzero(conic), "coefficients": coefficients}
    for j, term in terms.items():
        if term:
            message = f"{records[j].keyword} on a surface that is no asphere; put ASP before it"
            raise LensFileError(message, records[j].place)
    return {"conic": nonzero(conic)}


def _medium(block: Block, before: Glass, library: codev_glass.GlassLibrary, report: Draft) -> Glass:
    mode, glass = block.last("RMD"), block.last("GLA")
    word = unquoted(mode.words[0]).upper() if mode and mode.words else "REFR"
    if word not in ("REFL", "REFR"):
        raise UnsupportedSurface(f"RMD {word[:40]} is not modelled; modelled are REFL and REFR", block.place_of("RMD"))
    place = block.place_of("GLA")
    name = glass.words[0] if glass and glass.words else ""
    glass_behind = codev_glass.medium(name, library, place=place, report=report)
    if word == "REFR":
        return glass_behind
    if block.place.surface == 0:
        raise LensFileError("the object is a mirror (REFL)", block.place_of("RMD"))
    if name and glass_behind.name != before.name:
        message = f"a mirror followed by {shown(name)}, while light stays in {before.name or 'air'}"
        raise LensFileError(f"{message}; leave out the glass behind REFL", place)
    return MIRROR


def _fraction(word: str) -> Fraction:
    return Fraction(word.upper().replace("D", "E"))


def _phase(block: Block, radius: float, unit: float) -> RadialPhase | None:
    """The phase of a surface, None if it is not diffractive; radius: mm, of its coefficients."""
    record = block.last("DIF")
    if record is None:
        return None
    kind, type_, wave = record.words[:1], block.last("HCT"), block.last("HWL")
    if [word.upper() for word in kind] != ["DOE"]:
        raise UnsupportedSurface(f"DIF {' '.join(kind)[:40]} (diffractive surface) is not modelled", record.place)
    if not type_ or [word.upper() for word in type_.words] != ["R"]:
        stated = f"HCT {' '.join(type_.words)[:40]}" if type_ else "DIF DOE without HCT"
        raise UnsupportedSurface(f"{stated} is not modelled; modelled is HCT R, powers of r²", record.place)
    if wave is None or wave.number(0, "wavelength") <= 0:
        raise LensFileError("DIF DOE without the wavelength of its construction (HWL)", record.place)
    length, radians = _fraction(wave.words[0]) * NANOMETRE, {}
    for record in block.all("HCO"):
        word = record.words[0].upper() if record.words else ""
        j = int(word[1:]) if word[:1] == "C" and word[1:].isdigit() and len(word) < 6 else 0
        if not 1 <= j <= MOST_TERMS:
            raise LensFileError(f"HCO {word[:20]}, expected C1 to C{MOST_TERMS} and a number", record.place)
        record.number(1, f"coefficient C{j}")
        coefficient = _fraction(record.words[1]) / Fraction(unit) ** (2 * j - 1)
        try:
            radians[j] = float(Fraction(2 * math.pi) * coefficient * Fraction(radius) ** (2 * j) / length) + 0.0
        except OverflowError as error:
            raise LensFileError(f"HCO C{j} is too large", record.place) from error
    coefficients = double([radians.get(j, 0.0) for j in range(1, max(radians, default=0) + 1)])
    return RadialPhase(coefficients, double(radius), double(block.number("HOR", "order", 1.0)))


def _poses(block: Block, unit: float) -> tuple[Pose | None, Pose | None]:
    """The pose of a surface and the pose behind it, by decentres, tilts and their type: DAR, REV, BEN or none."""
    numbers = {}
    for name, word in POSE_WORDS.items():
        factor = -1.0 if word in LEFT_HANDED else 1.0 if name.startswith("tilt") else unit
        numbers[name] = factor * block.number(word, "decentre or tilt")
    type_ = block.last("POSE")
    axes = POSE_TYPES[type_.keyword] if type_ else ONWARD
    if axes == BENT and sum(bool(value) for name, value in numbers.items() if name.startswith("tilt")) > 1:
        message = "BEN with tilts about several axes, to which CODE V adds one of its own, is not modelled"
        raise UnsupportedSurface(f"{message}; put the mirror between two dummy surfaces", block.place_of("POSE"))
    return poses_of(numbers, axes)


# -- apertures --------------------------------------------------------------------------------------------------------


def _apertures(block: Block, unit: float, report: Draft) -> tuple[tuple[Aperture, ...], float | None]:
    """The apertures, and the semi-diameter of the part, from CIR EDG."""
    groups: dict[tuple[str, str], dict[str, Record]] = {}
    for record in block.all("APERTURE"):
        words, kind, label = list(record.words), "CLR", ""
        while words and (words[0].upper() in _KINDS or words[0][:2] in ("L'", 'L"', "l'", 'l"')):
            word = words.pop(0)
            kind, label = (word.upper(), label) if word.upper() in _KINDS else (kind, word[1:].upper())
        groups.setdefault((kind, label), {})[record.keyword] = record._replace(words=tuple(words))
    apertures, semi_diameter = [], None
    for (kind, label), sizes in groups.items():
        if kind == "EDG":
            semi_diameter = sizes["CIR"].number(0, "edge of the part") * unit if "CIR" in sizes else semi_diameter
        elif kind == "HOL":
            first = next(iter(sizes.values()))
            report.warn("a hole in the part (HOL) is left out: no ray is clipped by it", first.place)
        else:
            apertures.append(_aperture(sizes, kind == "OBS", unit))
            if label.strip("'\"") == RING and len(apertures) > 1:
                apertures[-2:] = _ring(*apertures[-2:])
    clear = [aperture for aperture in apertures if not aperture.obscures]
    if len(clear) > 1:
        message = f"{len(clear)} clear apertures on one surface; whether light passes any or all of them is ambiguous"
        raise LensFileError(message, block.all("APERTURE")[0].place)
    if semi_diameter is not None and semi_diameter < 0:
        raise LensFileError("CIR EDG is negative, expected a semi-diameter of 0 or more", block.place)
    return tuple(apertures), semi_diameter


def _ring(outer: Aperture, inner: Aperture) -> list[Aperture]:
    """A clear circle and the obscuration within it as one aperture, if they have the same centre."""
    if outer.shape != inner.shape or outer.shape != "circular" or outer.obscures or outer.centre != inner.centre:
        return [outer, inner]
    return [Aperture("circular", (inner.extent[1], outer.extent[1]), False, outer.centre)]


def _aperture(sizes: dict[str, Record], obscures: bool, unit: float) -> Aperture:
    place = next(iter(sizes.values())).place
    shapes = [shape for shape, keywords in APERTURES.items() if any(keyword in sizes for keyword in keywords)]
    if len(shapes) != 1:
        raise LensFileError(f"an aperture of {len(shapes)} shapes ({', '.join(sizes)}), expected one", place)
    shape, keywords = shapes[0], APERTURES[shapes[0]]
    if missing := [keyword for keyword in keywords if keyword not in sizes]:
        raise LensFileError(f"a {shape} aperture without {' and '.join(missing)}", place)
    if "ARO" in sizes and sizes["ARO"].number(0, "rotation"):
        raise LensFileError("a rotated aperture (ARO), which is not modelled", sizes["ARO"].place)
    extent = tuple(sizes[keyword].number(0, "size of the aperture") * unit for keyword in keywords)
    extent = (0.0, *extent) if shape == "circular" else extent
    centre = (sizes[word].number(0, "decentre") * unit if word in sizes else 0.0 for word in ("ADX", "ADY"))
    return clear_aperture(shape, extent, obscures, tuple(centre), keywords[0], place)
