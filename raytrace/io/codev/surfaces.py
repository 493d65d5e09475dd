"""A surface of a CODE V sequence: shape, medium, poses and apertures; diffractive surfaces are also written here.

A rotationally symmetric diffractive surface (DIF DOE, HCT R) adds the path

    p = HOR λ/HWL Σ_j C_j r^2j

with C_j of HCO Cj in units of length, HWL the construction wavelength in nm, HOR the order. A `RadialPhase` has
coefficients in radians at a radius of its own, A_j = 2π C_j radius^2j/HWL, which are rounded once, and come back.
"""

import math
from decimal import Decimal, localcontext
from fractions import Fraction

from torch import Tensor

from raytrace.io.codev.glass import GlassLibrary, medium
from raytrace.io.codev.keywords import APERTURES, LEFT_HANDED, LETTERS, OWN, POSE_WORDS, RING, unquoted
from raytrace.io.report import Draft
from raytrace.io.source import (
    Block,
    LensFileError,
    Place,
    Record,
    UnsupportedSurface,
    double,
    exact,
    exact_list,
    is_infinite,
    number,
    shown,
)
from raytrace.materials.glass import AIR, MIRROR, Glass
from raytrace.system.apertures import SHAPES, Aperture
from raytrace.system.phases import RadialPhase
from raytrace.system.poses import Pose, undone
from raytrace.system.surface import Surface

#: More coefficients than any diffractive surface has.
_MOST = 50

#: Digits of a written coefficient, enough that it comes back through two roundings.
_DIGITS = 40

_NANOMETRE = Fraction(1, 10**6)  # mm


def phase(block: Block, radius: float, unit: float) -> RadialPhase | None:
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
    length = _fraction(wave.words[0]) * _NANOMETRE
    terms = _terms(block)
    coefficients = [_radians(terms.get(j), j, length, radius, unit) for j in range(1, max(terms, default=0) + 1)]
    order = block.last("HOR")
    return RadialPhase(double(coefficients), double(radius), double(order.number(0, "order") if order else 1.0))


def _fraction(word: str) -> Fraction:
    return Fraction(word.upper().replace("D", "E"))


def _terms(block: Block) -> dict[int, Record]:
    terms = {}
    for record in block.all("HCO"):
        word = record.words[0].upper() if record.words else ""
        j = int(word[1:]) if word[:1] == "C" and word[1:].isdigit() and len(word) < 6 else 0
        if not 1 <= j <= _MOST:
            raise LensFileError(f"HCO {word[:20]}, expected C1 to C{_MOST} and a number", record.place)
        record.number(1, f"coefficient C{j}")
        terms[j] = record
    return terms


def _radians(record: Record | None, j: int, length: Fraction, radius: float, unit: float) -> float:
    if record is None:
        return 0.0
    written = _fraction(record.words[1]) / Fraction(unit) ** (2 * j - 1)
    radians = Fraction(2 * math.pi) * written * Fraction(radius) ** (2 * j) / length
    try:
        return float(radians) + 0.0
    except OverflowError as error:
        raise LensFileError(f"HCO C{j} is too large", record.place) from error


def phase_lines(phase: RadialPhase, wavelength: float, place: Place) -> list[str]:
    """The commands of a phase; wavelength: µm, that of its construction."""
    length = Fraction(repr(wavelength)) * 1000 * _NANOMETRE
    radius = exact(phase.radius, "radius of the phase", place)
    if not float(radius) > 0:
        raise LensFileError(f"the radius of the phase is {radius}, expected one above 0", place)
    terms = exact_list(phase.coefficients, "coefficients of the phase", place)
    if len(terms) > _MOST:
        raise LensFileError(f"{len(terms)} coefficients of the phase, a .seq file has at most {_MOST}", place)
    return [
        "  DIF DOE",
        f"  HOR {exact(phase.order, 'order', place)}",
        f"  HWL {Decimal(repr(wavelength)).scaleb(3).normalize():f}; HCT R",
        *(f"  HCO C{j} {_length(float(term), j, length, float(radius))}" for j, term in enumerate(terms, 1)),
        f"  {OWN.lower()} radius {radius}" if float(radius) != 1 else "",
    ]


def _length(term: float, j: int, length: Fraction, radius: float) -> str:
    """C_j with up to _DIGITS digits."""
    length_of_term = Fraction(term) * length / (Fraction(2 * math.pi) * Fraction(radius) ** (2 * j))
    with localcontext(prec=_DIGITS):
        return str(Decimal(length_of_term.numerator) / Decimal(length_of_term.denominator))


#: An object at this distance or further away, in the unit of the file, is at infinity.
INFINITY = 1e10

#: Kinds of aperture: clear, obscuration, edge of the part, hole in it.
_KINDS = ("CLR", "OBS", "EDG", "HOL")


def build(
    block: Block, unit: float, before: Glass, *, own: dict[str, Record], library: GlassLibrary, report: Draft
) -> Surface:
    """The surface of a block, its lengths in units of `unit` mm; before: the medium before it.

    own: comments of this package: BREAK makes a coordinate break of a dummy surface, RADIUS is that of its phase.
    library: its glasses. Raises UnknownGlass as `find_glass` does.
    """
    apertures, semi_diameter = _apertures(block, unit, report)
    label, (ahead, behind) = block.last("SLB"), _poses(block, unit)
    glass, is_break = _medium(block, before, library, report), "BREAK" in own
    radius = number((own["RADIUS"].text or "?").strip(), "radius", own["RADIUS"].place) if "RADIUS" in own else 1.0
    if is_break and ahead is None and behind is not None:
        ahead, behind = behind, None
    return Surface(
        thickness=_thickness(block, unit),
        curvature=_curvature(block, unit),
        conic=_conic(block),
        coefficients=_coefficients(block, unit),
        phase=phase(block, radius, unit),
        before=ahead,
        after=behind,
        is_break=is_break,
        glass=AIR if is_break else glass,
        semi_diameter=semi_diameter,
        apertures=apertures,
        comment=unquoted(label.words[0]).strip() if label and label.words else "",
    )


def _thickness(block: Block, unit: float) -> Tensor:
    record = block.last("THI")
    if record is None:
        raise LensFileError("surface without a thickness; S is followed by radius, thickness, glass", block.place)
    word = record.words[0] if record.words else ""
    is_object = block.place.surface == 0
    distance = float("inf") if is_object and is_infinite(word) else number(word, "thickness", record.place)
    if is_object and distance <= -INFINITY:
        raise LensFileError(
            f"thickness is {shown(word)}, expected a distance or {INFINITY:g} for infinity", record.place
        )
    return double(float("inf") if is_object and distance >= INFINITY else distance * unit)


def _curvature(block: Block, unit: float) -> Tensor | None:
    """Of RDY, a radius, or CUY; 0 is a plane in both."""
    record = block.last("CUY")
    value = record.number(0, "radius or curvature") if record else 0.0
    if not value:
        return None
    curvature = value / unit if record.keyword == "CUY" else 1.0 / (value * unit)
    return double(curvature) if curvature else None


def _type(block: Block) -> str:
    record = block.last("TYPE")
    return record.keyword if record else "SPH"


def _conic(block: Block) -> Tensor | None:
    record, flat = block.last("K"), block.last("CUF")
    if flat and flat.number(0, "CUF", 0.0):
        raise UnsupportedSurface(f"CUF {flat.words[0][:40]} (fraction of a curvature) is not modelled", flat.place)
    conic = record.number(0, "conic constant") if record else 0.0
    if conic and _type(block) == "SPH":
        raise LensFileError("K on a sphere; put CON or ASP before it", record.place)
    return double(conic) if conic else None


def _coefficients(block: Block, unit: float) -> Tensor | None:
    """a_j of r^(2j): A is a_2; those up to the last letter that is there."""
    letters = [letter for letter in LETTERS if block.last(letter)]
    records = [block.last(letter) for letter in LETTERS]
    if _type(block) != "ASP":
        for record in filter(None, records):
            if record.number(0, "coefficient"):
                message = f"{record.keyword} on a surface that is no asphere; put ASP before it"
                raise LensFileError(message, record.place)
        return None
    count = LETTERS.index(letters[-1]) + 1 if letters else 0
    terms = [record.number(0, "coefficient") if record else 0.0 for record in records[:count]]
    return double([0.0, *(value / unit ** (2 * j - 1) for j, value in enumerate(terms, 2))])


def _medium(block: Block, before: Glass, library: GlassLibrary, report: Draft) -> Glass:
    mode, glass = block.last("RMD"), block.last("GLA")
    word = unquoted(mode.words[0]).upper() if mode and mode.words else "REFR"
    if word not in ("REFL", "REFR"):
        raise UnsupportedSurface(f"RMD {word[:40]} is not modelled; modelled are REFL and REFR", mode.place)
    place = glass.place if glass else block.place
    name = glass.words[0] if glass and glass.words else ""
    glass_behind = medium(name, library, place=place, report=report)
    if word == "REFR":
        return glass_behind
    if block.place.surface == 0:
        raise LensFileError("the object is a mirror (REFL)", mode.place)
    if name and glass_behind.name != before.name:
        message = f"a mirror followed by {shown(name)}, while light stays in {before.name or 'air'}"
        raise LensFileError(f"{message}; leave out the glass behind REFL", place)
    return MIRROR


# -- poses ----------------------------------------------------------------------------------------------------------


def _poses(block: Block, unit: float) -> tuple[Pose | None, Pose | None]:
    """The pose of a surface and the one behind it, by decentres, tilts and their type: DAR, REV, BEN or none."""
    type_ = block.last("POSE")
    word, pose = type_.keyword if type_ else "", _pose(block, unit)
    if pose is None or not word:
        return pose, None
    if word == "DAR":
        return pose, undone(pose)
    if word == "REV":
        return None, undone(pose)
    tilts = {name: getattr(pose, name) for name in POSE_WORDS if name.startswith("tilt")}
    if sum(tilt is not None for tilt in tilts.values()) > 1:
        message = "BEN with tilts about several axes, to which CODE V adds one of its own, is not modelled"
        raise UnsupportedSurface(f"{message}; put the mirror between two dummy surfaces", type_.place)
    return pose, Pose(**tilts) if any(tilt is not None for tilt in tilts.values()) else None


def _pose(block: Block, unit: float) -> Pose | None:
    numbers = {}
    for name, word in POSE_WORDS.items():
        record = block.last(word)
        value = record.number(0, "decentre or tilt") if record else 0.0
        if value:
            sign = -1.0 if word in LEFT_HANDED else 1.0
            numbers[name] = double(sign * value * (1.0 if name.startswith("tilt") else unit))
    return Pose(**numbers) if numbers else None


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
    shapes = [shape for shape, words in APERTURES.items() if any(word in sizes for word in words)]
    if len(shapes) != 1:
        raise LensFileError(f"an aperture of {len(shapes)} shapes ({', '.join(sizes)}), expected one", place)
    words = APERTURES[shapes[0]]
    if any(word not in sizes for word in words):
        raise LensFileError(f"a {shapes[0]} aperture without {' and '.join(w for w in words if w not in sizes)}", place)
    if "ARO" in sizes and sizes["ARO"].number(0, "rotation"):
        raise LensFileError("a rotated aperture (ARO), which is not modelled", sizes["ARO"].place)
    extent = tuple(sizes[word].number(0, "size of the aperture") * unit for word in words)
    extent = (0.0, *extent) if shapes[0] == "circular" else extent
    if SHAPES[shapes[0]].objection(extent):
        raise LensFileError(f"{words[0]} {SHAPES[shapes[0]].objection(extent)}", place)
    x, y = (sizes[word].number(0, "decentre") * unit if word in sizes else 0.0 for word in ("ADX", "ADY"))
    return Aperture(shapes[0], extent, obscures, (x, y))
