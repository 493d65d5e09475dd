"""Write a lens as a sequence of CODE V (.seq), every number with the digits that bring it back exactly."""

import dataclasses
import math
from collections.abc import Sequence
from decimal import Decimal, localcontext
from fractions import Fraction
from pathlib import Path

import torch
from torch import Tensor

from raytrace.io.assembly import written_automatic, written_conditions, written_variables
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
    POSE_WORDS,
    RING,
    SYSTEM_APERTURES,
)
from raytrace.io.source import (
    LensFileError,
    Place,
    exact,
    exact_list,
    one_line,
    quoted,
    refuse_sag_terms,
    thickness,
    word,
)
from raytrace.materials.environment import REFERENCE, thermal
from raytrace.materials.glass import Glass
from raytrace.system.apertures import Aperture
from raytrace.system.configurations import same
from raytrace.system.lens import Lens, SystemAperture, index_behind
from raytrace.system.phases import RadialPhase
from raytrace.system.poses import Pose, undone
from raytrace.system.shapes import EVEN, KINDS
from raytrace.system.surface import SIZES, Surface, medium_surfaces
from raytrace.words import option

#: Digits of a written coefficient of a phase, enough to read back the same number through two roundings.
_DIGITS = 40

#: Characters of a line, after which a list continues in the next.
_LINE = 72

#: Difference of two indices by rounding alone.
_SAME_INDEX = 1e-14


def write(lens: Lens, file: str, *, catalogs: Sequence[Path] = ()) -> bytes:
    """The content of a .seq file of the lens, in mm, its surfaces by their curvatures.

    file: its name, for messages. catalogs: the user's glass catalogs that the lens was read with.
    Raises LensFileError for data that a .seq file cannot hold: a batch of lenses, nan, terms of r² and beyond r²⁰,
    apertures other than EPD, FNO and NAO, polygons, names and partial dispersion of model glasses, temperatures and
    pressures that change an index.
    """
    place = Place(file)
    private: dict[str, Glass] = {}
    surfaces = []
    for number, surface in enumerate(lens.surfaces):
        surfaces += _surface(lens, number, surface, private, catalogs, Place(file, None, number))
    lines = [*_system(lens, private, place), *surfaces, "GO"]
    return ("\n".join(line for line in lines if line) + "\n").encode()


def _system(lens: Lens, private: dict[str, Glass], place: Place) -> list[str]:
    fields = lens.fields
    _refuse_environments(lens, place)
    if fields.telecentric:
        raise LensFileError("a telecentric object space, which a .seq file does not hold here", place)
    waves = [codev_glass.nanometres(wave) for wave in exact_list(lens.wavelengths, "wavelength", place)]
    x, y = FIELD_KINDS[fields.kind]
    return [
        "RDM N;LEN",
        *_comments(lens, private, place),
        f"TITLE {_quoted(lens.name, 'the title', place)}" if lens.name else "",
        _aperture(lens.aperture, lens.surfaces[0], place),
        "DIM M",
        "AFI Y" if lens.afocal else "",
        _wrapped(["WL", *waves]),
        f"REF {lens.primary_wavelength}",
        _wrapped(["WTW", *_weights(lens.wavelength_weights, "weight of a wavelength", place)]),
        _wrapped([x, *exact_list(fields.x, "field", place)]),
        _wrapped([y, *exact_list(fields.y, "field", place)]),
        _wrapped(["WTF", *_weights(fields.weight, "weight of a field", place)]),
        *_vignetting(lens, place),
        *(_wrapped(line.split(" ")) for line in codev_glass.private_lines(private, waves, place)),
    ]


def _refuse_environments(lens: Lens, place: Place) -> None:
    """Raises LensFileError for an environment whose indices differ from those without one, which are read back."""
    places = [lens.environment, *(surface.environment for surface in lens.surfaces)]
    for air in filter(None, places):
        if ((air.temperature != REFERENCE[0]) | (air.pressure != REFERENCE[1])).any():
            message = f"a temperature or pressure other than {REFERENCE[0]:g} °C and {REFERENCE[1]:g} atm"
            raise LensFileError(f"{message}, which a .seq file does not hold here; write a table (.csv)", place)
    if not any(places):
        return
    surfaces = tuple(dataclasses.replace(surface, environment=None) for surface in lens.surfaces)
    bare = dataclasses.replace(lens, surfaces=surfaces, environment=None)
    wavelengths = lens.wavelengths.double()
    for number in medium_surfaces(lens.surfaces):
        here, listed = (index_behind(either, number, wavelengths) for either in (lens, bare))
        if ((here - listed).abs() > _SAME_INDEX).any():
            glass = lens.surfaces[number].glass
            raise LensFileError(
                f"{glass.name} at {REFERENCE[0]:g} °C, whose catalog is of {thermal(glass).reference:g} °C: a .seq "
                "file does not hold the temperature here; write a table (.csv)",
                Place(place.file, None, number),
            )


def _weights(numbers: Tensor, quantity: str, place: Place) -> list[str]:
    """Whole numbers without a point."""
    return [weight.removesuffix(".0") for weight in exact_list(numbers, quantity, place)]


def _comments(lens: Lens, private: dict[str, Glass], place: Place) -> list[str]:
    """Data that CODE V has no command for, in comments."""
    start = COMMENT.lower()
    unnamed = [key for key, glass in private.items() if not glass.name]
    return [
        *(f"{start} note {quoted(one_line(note, 'a note', place))}" for note in lens.notes),
        f"{start} catalogs {' '.join(map(word, lens.catalogs))}" if lens.catalogs else f"{start} catalogs",
        f"{start} automatic {automatic}" if (automatic := written_automatic(lens)) else "",
        f"{start} variables {variables}" if (variables := written_variables(lens)) else "",
        f"{start} conditions {conditions}" if (conditions := written_conditions(lens, place)) else "",
        f"{start} aiming {lens.ray_aiming}" if lens.ray_aiming != "real" else "",
        f"{start} unnamed {' '.join(unnamed)}" if unnamed else "",
    ]


def _quoted(text: str, quantity: str, place: Place) -> str:
    """A text in quotes, of the kind that is not in it."""
    line = one_line(text, quantity, place)
    mark = next((mark for mark in "'\"" if mark not in line), None)
    if mark is None:
        raise LensFileError(f"{quantity} holds both kinds of quotes, of which a .seq file needs one around it", place)
    return f"{mark}{line}{mark}"


def _wrapped(words: Sequence[str]) -> str:
    """A command over as many lines as it needs, all but the last ending in &."""
    lines = [""]
    for part in words:
        if lines[-1] and len(lines[-1]) + len(part) > _LINE:
            lines.append("")
        lines[-1] += f" {part}"
    return " &\n".join([lines[0].strip(), *lines[1:]])


def _aperture(aperture: SystemAperture, first: Surface, place: Place) -> str:
    keyword = SYSTEM_APERTURES.get(aperture.kind)
    if keyword is None or (keyword == "FNO" and not bool(torch.isinf(first.thickness).all())):
        where = " of an object at a finite distance" if keyword else ""
        message = f"the aperture {aperture.kind.replace('_', ' ')}{where}, which a .seq file does not hold"
        raise LensFileError(f"{message}; set {option('entrance_pupil_diameter')} instead", place)
    return f"{keyword} {exact(aperture.value, 'system aperture', place)}"


def _vignetting(lens: Lens, place: Place) -> list[str]:
    """VUX = C - D, VLX = C + D: the shortest digits that bring both back, else all of them."""
    if lens.fields.vignetting is None:
        return []
    DX, DY, CX, CY, angle = (exact_list(row, "vignetting factor", place) for row in lens.fields.vignetting)
    if any(map(float, angle)):
        raise LensFileError("vignetting factors with an angle (VAN), which a .seq file does not hold", place)
    lines = []
    for axis, decentres, compressions in (("X", DX, CX), ("Y", DY, CY)):
        pairs = [_cut(float(d), float(c)) for d, c in zip(decentres, compressions, strict=True)]
        lines += [_wrapped([f"V{side}{axis}", *(pair[k] for pair in pairs)]) for k, side in enumerate("UL")]
    return lines


def _cut(decentre: float, compression: float) -> tuple[str, str]:
    """The fractions cut off above and below, whose half sum and half difference are these numbers bit for bit."""
    short = repr(compression - decentre), repr(compression + decentre)
    high, low = map(Fraction, short)
    if float((low - high) / 2) == decentre and float((low + high) / 2) == compression:
        return short
    texts = []
    for number in (Fraction(compression) - Fraction(decentre), Fraction(compression) + Fraction(decentre)):
        power = number.denominator.bit_length() - 1  # of two
        digits = str(abs(number.numerator) * 5**power).rjust(power + 1, "0")
        point = len(digits) - power
        texts.append(f"{'-' if number < 0 else ''}{digits[:point]}.{digits[point:] or 0}")
    return texts[0], texts[1]


# -- surfaces ---------------------------------------------------------------------------------------------------------


def _surface(
    lens: Lens, number: int, surface: Surface, private: dict[str, Glass], user: Sequence[Path], place: Place
) -> list[str]:
    radial = surface.phase if isinstance(surface.phase, RadialPhase) else None
    rest = dataclasses.replace(surface, before=None, after=None, is_break=False)
    refuse_sag_terms(rest if radial is None else dataclasses.replace(rest, phase=None), place)
    last = len(lens.surfaces) - 1
    name = {0: "SO", last: "SI"}.get(number, "S")
    curvature = exact(surface.curvature, "curvature", place)
    glass = codev_glass.word(_medium(lens, number), private, user, place)
    label = _quoted(surface.comment, "the comment", place) if surface.comment.strip() else ""
    return [
        f"{name} {curvature} {_thickness(surface, number == last, place)} {glass}".rstrip(),
        "  STO" if number == lens.stop else "",
        f"  SLB {label}" if label else "",
        f"  {COMMENT.lower()} break" if surface.is_break else "",
        f"  {COMMENT.lower()} expansion {exact(surface.expansion, 'thermal expansion', place)}"
        if surface.expansion is not None
        else "",
        *(
            f"  {COMMENT.lower()} {name} {exact(size, name.replace('_', ' '), place)}"
            for name in SIZES[1:]
            if (size := getattr(surface, name)) is not None
        ),
        *_poses(surface, place),
        *_shape(surface, place),
        *([] if radial is None else _phase(radial, float(lens.primary), place)),
        *_apertures(surface.apertures, place),
        "" if surface.semi_diameter is None else f"  CIR EDG {exact(surface.semi_diameter, 'semi-diameter', place)}",
    ]


def _medium(lens: Lens, number: int) -> Glass:
    """The medium behind a surface, MIRROR for a mirror; behind a coordinate break, the medium before it."""
    while lens.surfaces[number].is_break:
        number -= 1
        while number and lens.surfaces[number].is_mirror:
            number -= 1
    return lens.surfaces[number].glass


def _poses(surface: Surface, place: Place) -> list[str]:
    """Decentres and tilts, and their type."""
    pose, behind = surface.pose, surface.after
    if surface.is_break and behind is None and pose is not None and pose.tilts_first:
        pose, behind = None, pose
    if pose is None:
        if behind is None:
            return []
        if behind.tilts_first:
            return [*_pose(undone(behind), place), "  REV"]
    elif not pose.tilts_first:
        if behind is None:
            return _pose(pose, place)
        if same(behind, undone(pose)):
            return [*_pose(pose, place), "  DAR"]
        tilts = Pose(tilt_x=pose.tilt_x, tilt_y=pose.tilt_y, tilt_z=pose.tilt_z)
        count = sum(tilt is not None for tilt in (tilts.tilt_x, tilts.tilt_y, tilts.tilt_z))
        if surface.is_mirror and count == 1 and same(behind, tilts):
            return [*_pose(pose, place), "  BEN"]
    message = "poses before and behind the surface, which a .seq file has no command for"
    raise LensFileError(f"{message}; put them into coordinate breaks", place)


def _pose(pose: Pose, place: Place) -> list[str]:
    numbers = ((word, getattr(pose, name)) for name, word in POSE_WORDS.items())
    return [
        f"  {word} {exact(-number if word in LEFT_HANDED else number, 'decentre or tilt', place)}"
        for word, number in numbers
        if number is not None
    ]


def _thickness(surface: Surface, is_image: bool, place: Place) -> str:
    text = thickness(surface.thickness, "0.1e14", place)
    if is_image and float(text):
        raise LensFileError(f"the image has thickness {text}, which a .seq file takes for a defocus", place)
    if place.surface == 0 and text != "0.1e14" and abs(float(text)) >= INFINITY:
        raise LensFileError(f"the object is {text} mm away, which CODE V takes for infinity; make it inf", place)
    return text


def _shape(surface: Surface, place: Place) -> list[str]:
    conic = [] if surface.conic is None else [f"  K {exact(surface.conic, 'conic constant', place)}"]
    if surface.coefficients is None:
        return ["  CON", *conic] if conic else []
    if surface.kind != EVEN:
        raise LensFileError(f"a .seq file has no type for an {KINDS[surface.kind].name}; write a table (.csv)", place)
    square, *terms = exact_list(surface.coefficients, "aspheric terms", place)
    if float(square) or len(terms) > len(LETTERS):
        excess = f"a term of r² ({square})" if float(square) else f"terms to r^{2 * len(terms) + 2}"
        raise LensFileError(f"{excess}; an asphere of a .seq file has r⁴ to r²⁰: write a table (.csv)", place)
    return ["  ASP", *conic, *(f"  {letter} {term}" for letter, term in zip(LETTERS, terms, strict=False))]


def _phase(phase: RadialPhase, wavelength: float, place: Place) -> list[str]:
    """The commands of a phase; wavelength: µm, that of its construction."""
    length, turn = Fraction(repr(wavelength)) * 1000 * NANOMETRE, Fraction(2 * math.pi)
    radius = exact(phase.radius, "radius of the phase", place)
    if not float(radius) > 0:
        raise LensFileError(f"the radius of the phase is {radius}, expected one above 0", place)
    terms = exact_list(phase.coefficients, "coefficients of the phase", place)
    if len(terms) > MOST_TERMS:
        raise LensFileError(f"{len(terms)} coefficients of the phase, a .seq file has at most {MOST_TERMS}", place)
    lines = ["  DIF DOE", f"  HOR {exact(phase.order, 'order', place)}"]
    lines.append(f"  HWL {Decimal(repr(wavelength)).scaleb(3).normalize():f}; HCT R")
    for j, term in enumerate(terms, 1):
        fraction = Fraction(float(term)) * length / (turn * Fraction(float(radius)) ** (2 * j))
        with localcontext(prec=_DIGITS):
            lines.append(f"  HCO C{j} {Decimal(fraction.numerator) / Decimal(fraction.denominator)}")
    return lines if float(radius) == 1 else [*lines, f"  {COMMENT.lower()} radius {radius}"]


def _apertures(apertures: tuple[Aperture, ...], place: Place) -> list[str]:
    lines = []
    if sum(not aperture.obscures for aperture in apertures) > 1:
        message = "several clear apertures on one surface, of which a .seq file has one"
        raise LensFileError(f"{message}; put the others on dummy surfaces", place)
    for k, aperture in enumerate(apertures, 1):
        if aperture.shape not in APERTURES:
            raise LensFileError(f"a {aperture.shape} as aperture, which a .seq file does not hold", place)
        if aperture.shape == "circular" and aperture.extent[0] and (aperture.obscures or len(apertures) > 1):
            message = "a ring that obscures, or together with another aperture, which a .seq file does not hold"
            raise LensFileError(message, place)
        label = (" OBS" if aperture.obscures else "") + (f" L'{k}'" if len(apertures) > 1 else "")
        sizes, circle = aperture.extent, aperture.shape == "circular"
        lines += _edge(aperture, sizes[1:] if circle else sizes, label, place)
        lines += _edge(aperture, sizes[:1], f" OBS L'{RING}'", place) if circle and sizes[0] else []
    return lines


def _edge(aperture: Aperture, sizes: Sequence[float | Tensor], label: str, place: Place) -> list[str]:
    """The commands of an aperture of sizes with a label."""
    numbers = [exact(size, "size of the aperture", place) for size in sizes]
    centre = [exact(number, "decentre of the aperture", place) for number in aperture.centre]
    lines = [f"  {word}{label} {size}" for word, size in zip(APERTURES[aperture.shape], numbers, strict=True)]
    return lines + [f"  AD{axis}{label} {number}" for axis, number in zip("XY", centre, strict=True) if float(number)]
