"""The types of surface of a .zmx file, a row each: what PARM and XDAT are, their units, and the fields they become.

PARM j is a number; XDAT 1 counts further terms, XDAT 2 is the radius they are normalised by, and XDAT 3 is the first of
them. Every length is a power of the file's unit, which the row knows. What a row does not know is refused or reported.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from decimal import Context, Decimal
from fractions import Fraction
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.formats.spelling import double
from raytrace.system.phases import Facets, FringePhase, Grating, Hologram, IdealLens, PolynomialPhase, RadialPhase
from raytrace.system.pose import Pose
from raytrace.system.shapes import EVEN, KINDS
from raytrace.system.surface import Surface


class Numbers(NamedTuple):
    """PARM by number, and the terms of XDAT with the radius they are normalised by; lengths in mm.

    size: the surface's semi-diameter.
    """

    parameters: Mapping[int, float | Tensor]
    terms: Tensor | None = None
    radius: float | Tensor = 1.0
    size: float | None = None

    def at(self, j: int) -> float:
        """PARM j, 0 if it is not told."""
        return self.parameters.get(j, 0.0)


#: In place of a power of the unit: a length that the lens knows by its reciprocal, 0 for a length of 0.
INVERSE = None


@dataclasses.dataclass(frozen=True)
class SurfaceType:
    """A TYPE.

    name: what OpticStudio calls it; holds: fields of a surface's shape that it has.
    parameters: power of the file's unit of every PARM that is used; unused: PARM that are known and bend no ray.
    terms: power of the unit of the terms in XDAT, None if it has none; most: how many.
    fields: numbers -> fields of `Surface`, None for one whose shape is all; ValueError for numbers out of range.
    numbers: surface -> numbers, `fields` undone.
    beyond: numbers -> what is not modelled of them, "" if all is; flat: whether a curvature is not.
    powers: what the parameters stand for, in words.
    """

    name: str
    holds: tuple[str, ...] = ("curvature", "conic")
    parameters: Mapping[int, int | None] = dataclasses.field(default_factory=dict)
    unused: Mapping[int, str] = dataclasses.field(default_factory=dict)
    terms: int | None = None
    most: int = 0
    fields: Callable[[Numbers], dict] = lambda numbers: {}
    numbers: Callable[[Surface], Numbers] = lambda surface: Numbers({})
    beyond: Callable[[Numbers], str] = lambda numbers: ""
    flat: bool = False
    powers: str = ""


# -- poses ------------------------------------------------------------------------------------------------------------

_POSE = ("x", "y", "tilt_x", "tilt_y", "tilt_z")


def pose_of(numbers: list[float], order: int) -> Pose | None:
    """The pose of decentres x, y in mm and tilts about x, y, z in degrees; what is 0 is not modelled."""
    told = {name: double(number) for name, number in zip(_POSE, numbers, strict=True) if number}
    return Pose(**told, tilts_first=order != 0) if told else None


def numbers_of(pose: Pose | None) -> list[Tensor | float]:
    """`pose_of` undone: decentres and tilts. Raises ValueError for a decentre along z."""
    if pose is not None and pose.z is not None:
        raise ValueError("a decentre along z; add it to the thickness before")
    return [0.0 if (number := getattr(pose, name, None)) is None else number for name in _POSE]


def order_is_known(number: float) -> bool:
    """Whether decentre and tilts come in one of the two orders."""
    return number in (0, 1)


def _break(numbers: Numbers) -> dict:
    return {"is_break": True, "before": pose_of([numbers.at(j) for j in range(1, 6)], int(numbers.at(6)))}


def _break_numbers(surface: Surface) -> Numbers:
    pose = surface.before
    order = float(pose is not None and pose.tilts_first)
    return Numbers(dict(enumerate([*numbers_of(pose), order], 1)))


def _break_beyond(numbers: Numbers) -> str:
    order = numbers.at(6)
    return "" if order_is_known(order) else f"of order {order:g} (PARM 6; 0 and 1 are known)"


# -- terms ------------------------------------------------------------------------------------------------------------


def _round(name: str) -> SurfaceType:
    """The type of a kind of rotationally symmetric terms: PARM j is a_j; without any it has as many zeros."""
    kind = KINDS[name]

    def fields(numbers: Numbers) -> dict:
        count = max(numbers.parameters, default=kind.parameters)
        return {"kind": name, "coefficients": double([numbers.at(j) for j in range(1, count + 1)])}

    return SurfaceType(
        name,
        ("curvature", "conic", "coefficients"),
        {j: 1 - kind.step * j for j in range(1, kind.parameters + 1)},
        fields=fields,
        numbers=lambda surface: Numbers(dict(enumerate(surface.coefficients[: kind.parameters].unbind(0), 1))),
        powers=kind.powers,
    )


def _extended(numbers: Numbers) -> dict:
    """An even asphere: a_i = α_i / R^2i."""
    terms = [α / numbers.radius ** (2 * i) for i, α in enumerate(numbers.terms.tolist(), 1)]
    return {"kind": EVEN, "coefficients": double(terms)} if terms else {}


# -- phases -----------------------------------------------------------------------------------------------------------


def _grating(numbers: Numbers) -> dict:
    return {"phase": Grating(double(numbers.at(1)), double(numbers.at(2)))}


def _mode(number: float) -> int:
    if number not in (0, 1, 2, 3):
        raise ValueError(f"an OPD mode of {number:g}, expected 0, 1, 2 or 3")
    return int(number)


def _ideal(numbers: Numbers) -> dict:
    power = numbers.at(1)
    if not power:
        raise ValueError("a focal length of 0 (PARM 1), expected one in the file's unit of length")
    return {"phase": IdealLens(double(power), double(power), opd_mode=_mode(numbers.at(2)))}


def _ideal_xy(numbers: Numbers) -> dict:
    mode = _mode(numbers.at(3))
    return {"phase": IdealLens(double(numbers.at(1)), double(numbers.at(2)), opd_mode=mode)}


def _ideal_numbers(surface: Surface) -> Numbers:
    return Numbers({1: surface.phase.power_x, 2: float(surface.phase.opd_mode)})


def _ideal_xy_numbers(surface: Surface) -> Numbers:
    phase = surface.phase
    return Numbers({1: phase.power_x, 2: phase.power_y, 3: float(phase.opd_mode)})


def _diffractive(phase: type) -> Callable[[Numbers], dict]:
    """The fields of a surface with a phase of coefficients, radius and order (PARM 0), and even terms beside."""

    def fields(numbers: Numbers) -> dict:
        terms = numbers.terms if len(numbers.terms) else double([0.0])
        if 0 not in numbers.parameters and bool(terms.any()):
            raise ValueError("no order of diffraction (PARM 0); lines lost?")
        return {"phase": phase(terms, double(numbers.radius), double(numbers.at(0))), **_beside(numbers)}

    return fields


def _diffractive_numbers(surface: Surface) -> Numbers:
    phase = surface.phase
    return Numbers({0: phase.order, **_even_numbers(surface)}, phase.coefficients, phase.radius)


def _beside(numbers: Numbers) -> dict:
    """The even terms of a surface that mostly has none: up to the last that is not 0."""
    terms = [numbers.at(j) for j in range(1, 9)]
    while terms and not terms[-1]:
        terms.pop()
    return {"kind": EVEN, "coefficients": double(terms)} if terms else {}


def _even_numbers(surface: Surface) -> dict[int, Tensor]:
    terms = surface.coefficients
    return {} if terms is None else dict(enumerate(terms[: KINDS[EVEN].parameters].unbind(0), 1))


def _hologram(numbers: Numbers) -> dict:
    first, second = ([numbers.at(j + k) for k in range(3)] for j in (1, 4))
    if not any(first) or not any(second):
        raise ValueError("a construction point at the vertex (PARM 1 to 3, or 4 to 6), expected one away from it")
    if numbers.at(7) <= 0:
        raise ValueError(f"a construction wavelength of {numbers.at(7):g} µm (PARM 7), expected a positive one")
    return {"phase": Hologram(double(first), double(second), double(numbers.at(7)), double(numbers.at(8)))}


def _hologram_numbers(surface: Surface) -> Numbers:
    phase = surface.phase
    points = itertools.chain(*(torch.unbind(point) for point in (phase.first, phase.second)))
    return Numbers(dict(enumerate([*points, phase.wavelength, phase.order], 1)))


_WITH_EVEN = ("curvature", "conic", "coefficients", "phase")
_EVEN_POWERS = {j: 1 - 2 * j for j in range(1, 9)}


def _diffractive_type(name: str, phase: type, most: int) -> SurfaceType:
    return SurfaceType(
        name,
        _WITH_EVEN,
        {0: 0, **_EVEN_POWERS},
        terms=0,
        most=most,
        fields=_diffractive(phase),
        numbers=_diffractive_numbers,
    )


_POLARISATION = dict.fromkeys(range(1, 9), "polarisation; its plane refracts as any other")

TYPES = {
    "STANDARD": SurfaceType("standard"),
    "EVENASPH": _round(EVEN),
    "ODDASPHE": _round("odd asphere"),
    "XASPHERE": SurfaceType(
        "extended asphere",
        ("curvature", "conic", "coefficients"),
        terms=1,
        most=240,
        fields=_extended,
        numbers=lambda surface: Numbers({}, surface.coefficients),
    ),
    "COORDBRK": SurfaceType(
        "coordinate break",
        (),
        {1: 1, 2: 1, 3: 0, 4: 0, 5: 0, 6: 0},
        fields=_break,
        numbers=_break_numbers,
        beyond=_break_beyond,
    ),
    "DGRATING": SurfaceType(
        "diffraction grating",
        ("curvature", "conic", "phase"),
        {1: 0, 2: 0},
        fields=_grating,
        numbers=lambda surface: Numbers({1: surface.phase.frequency, 2: surface.phase.order}),
    ),
    "PARAXIAL": SurfaceType("paraxial lens", ("phase",), {1: INVERSE, 2: 0}, fields=_ideal, numbers=_ideal_numbers),
    "PARAX_XY": SurfaceType(
        "paraxial XY", ("phase",), {1: -1, 2: -1, 3: 0}, fields=_ideal_xy, numbers=_ideal_xy_numbers
    ),
    "BINARY_1": _diffractive_type("binary 1", PolynomialPhase, 230),
    "BINARY_2": _diffractive_type("binary 2", RadialPhase, 240),
    "FZERNPHA": _diffractive_type("Zernike fringe phase", FringePhase, 37),
    "HOLOGRM2": SurfaceType(
        "hologram 2",
        ("phase",),
        {**dict.fromkeys(range(1, 7), 1), 7: 0, 8: 0},
        fields=_hologram,
        numbers=_hologram_numbers,
        flat=True,
    ),
    "FRESNELS": SurfaceType(
        "Fresnel",
        _WITH_EVEN,
        _EVEN_POWERS,
        fields=lambda numbers: {"phase": Facets(), **_beside(numbers)},
        numbers=lambda surface: Numbers(_even_numbers(surface)),
    ),
    "JONESMAT": SurfaceType("Jones matrix", (), unused=_POLARISATION),
}

#: TYPE by the phase of a surface.
_OF_PHASES = {
    "Grating": "DGRATING",
    "IdealLens": "PARAX_XY",
    "PolynomialPhase": "BINARY_1",
    "RadialPhase": "BINARY_2",
    "FringePhase": "FZERNPHA",
    "Hologram": "HOLOGRM2",
    "Facets": "FRESNELS",
}


def type_of(surface: Surface) -> str | None:
    """The TYPE that a surface is written as; None where a .zmx file has none."""
    if surface.is_break:
        return "COORDBRK"
    if surface.phase is not None:
        return _type_of_phase(surface)
    if surface.departure is not None:
        return None
    if surface.coefficients is None:
        return "STANDARD"
    kind = KINDS[surface.kind]
    return "XASPHERE" if surface.kind == EVEN and len(surface.coefficients) > kind.parameters else kind.zemax


def _type_of_phase(surface: Surface) -> str | None:
    phase = surface.phase
    if isinstance(phase, IdealLens) and phase.power_x.dim() == 0 and float(phase.power_x) == float(phase.power_y) != 0:
        return "PARAXIAL"
    return _OF_PHASES.get(type(phase).__name__)


# -- reciprocals, to the last bit -------------------------------------------------------------------------------------


def inverse(text: str, millimetres: float) -> float:
    """1/length in 1/mm of the text of a length, rounded once; 0 of a length of 0. OverflowError where it is too large.

    The text is taken as it stands, with all its digits: of two neighbouring numbers not both are the reciprocal of one
    of 53 bits.
    """
    length = Fraction(text.replace("D", "e").replace("d", "e")) * Fraction(repr(millimetres))
    return float(1 / length) if length else 0.0


def spelled_inverse(number: float) -> str:
    """A length whose `inverse` in mm is the number: the shortest that a 64-bit number has, or one of more digits."""
    if not number:
        return "0.0"
    text = repr(float(1 / Fraction(number)))
    return text if inverse(text, 1.0) == number else str(Context(prec=40).divide(Decimal(1), Decimal(number)))
