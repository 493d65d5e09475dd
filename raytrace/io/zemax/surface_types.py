"""The types of surface of a .zmx file that are modelled: a row each, and the type that a surface is written as.

The types of surface of a .zmx file that are a sag and no more, a row each.

The types of surface of a .zmx file that bend light by a phase, turn its axes, or are a plane; a row each.
"""

import itertools
from collections.abc import Callable

import torch
from torch import Tensor

from raytrace.io.spelling import double
from raytrace.io.zemax.numbers import INVERSE, Numbers, SurfaceType, numbers_of, order_is_known, pose_of
from raytrace.system.phases import Facets, FringePhase, Grating, Hologram, IdealLens, PolynomialPhase, RadialPhase
from raytrace.system.polynomials import IrregularSag, PolynomialSag, TiltSag
from raytrace.system.poses import undone
from raytrace.system.sag_terms import FringeSag
from raytrace.system.shapes import EVEN, KINDS
from raytrace.system.surface import Surface

_ROUND = ("curvature", "conic", "coefficients")


def _round(name: str) -> SurfaceType:
    """The type of a kind of rotationally symmetric terms: PARM j is a_j; without any it has as many zeros."""
    kind = KINDS[name]

    def fields(numbers: Numbers) -> dict:
        count = max(numbers.parameters, default=kind.parameters)
        return {"kind": name, "coefficients": double([numbers.at(j) for j in range(1, count + 1)])}

    return SurfaceType(
        name,
        _ROUND,
        {j: 1 - kind.step * j for j in range(1, kind.parameters + 1)},
        fields=fields,
        numbers=lambda surface: Numbers(even_numbers(surface)),
        powers=kind.powers,
    )


def round_types() -> dict[str, SurfaceType]:
    """Types of the rotationally symmetric kinds, as their rows of KINDS tell them."""
    return {kind.zemax: _round(kind.name) for kind in KINDS.values() if kind.zemax and kind.form is None}


def _extended(numbers: Numbers) -> dict:
    """An even asphere: a_i = α_i / R^2i."""
    terms = [α / numbers.radius ** (2 * i) for i, α in enumerate(numbers.terms.tolist(), 1)]
    return {"kind": EVEN, "coefficients": double(terms)} if terms else {}


#: Power of the unit of PARM 1 to 8 that are even terms.
EVEN_POWERS = {j: 1 - 2 * j for j in range(1, 9)}


def beside(numbers: Numbers) -> dict:
    """The even terms of a surface that mostly has none: up to the last that is not 0."""
    terms = _trimmed([numbers.at(j) for j in range(1, 9)])
    return {"kind": EVEN, "coefficients": double(terms)} if terms else {}


def even_numbers(surface: Surface) -> dict[int, Tensor]:
    terms = surface.coefficients
    return {} if terms is None else dict(enumerate(terms[: KINDS[surface.kind].parameters].unbind(0), 1))


def _trimmed(terms: list[float]) -> list[float]:
    """Without the zeros at the end."""
    return terms[: max((j for j, term in enumerate(terms, 1) if term), default=0)]


def _toroid(numbers: Numbers) -> dict:
    terms = [numbers.at(1), *_trimmed([numbers.at(j) for j in range(2, 9)])]
    return {"kind": "toroidal", "coefficients": double(terms)}


def _biconic(numbers: Numbers) -> dict:
    return {"kind": "biconic", "coefficients": double([numbers.at(1), numbers.at(2)])}


def _coefficients(surface: Surface) -> Numbers:
    return Numbers(dict(enumerate(surface.coefficients.unbind(0), 1)))


def _tilted(numbers: Numbers) -> dict:
    slopes = numbers.at(1), numbers.at(2)
    return {"sag_terms": TiltSag(*map(double, slopes))} if any(slopes) else {}


def _polynomial(numbers: Numbers) -> dict:
    return {"sag_terms": PolynomialSag(numbers.terms, double(numbers.radius))} if len(numbers.terms) else {}


def _fringe(numbers: Numbers) -> dict:
    found = beside(numbers)
    if len(numbers.terms):
        centre = double(numbers.at(9)), double(numbers.at(10))
        found["sag_terms"] = FringeSag(numbers.terms, double(numbers.radius), *centre)
    return found


def _fringe_numbers(surface: Surface) -> Numbers:
    sag = surface.sag_terms
    return Numbers({**even_numbers(surface), 9: sag.centre_x, 10: sag.centre_y}, sag.coefficients, sag.radius)


def _irregular(numbers: Numbers) -> dict:
    """Terms normalised by the semi-diameter, in axes of their own that end with the surface."""
    found, (spherical, astigmatism, coma, angle) = {}, (numbers.at(j) for j in range(5, 9))
    if spherical or astigmatism or coma:
        if numbers.size is None:
            raise ValueError("no semi-diameter (DIAM), by which the terms of an irregular surface are normalised")
        found["sag_terms"] = IrregularSag(*map(double, (spherical, astigmatism, coma, angle, numbers.size)))
    own = pose_of([*(numbers.at(j) for j in range(1, 5)), 0.0], 0)
    return found if own is None else found | {"before": own, "after": undone(own)}


def _irregular_numbers(surface: Surface) -> Numbers:
    sag = surface.sag_terms
    if surface.semi_diameter is None or float(sag.radius) != surface.semi_diameter:
        found = f"a radius of {float(sag.radius)!r} mm and a semi-diameter of {surface.semi_diameter!r}"
        raise ValueError(f"an irregular surface with {found}: the file has one number for both")
    own = numbers_of(surface.before)[:4] if stands_in_parameters(surface) else [0.0] * 4
    return Numbers(dict(enumerate([*own, sag.spherical, sag.astigmatism, sag.coma, sag.angle], 1)))


def stands_in_parameters(surface: Surface) -> bool:
    """Whether the poses of a surface are one that it makes and undoes itself: decentres, then tilts about x and y."""
    before, after = surface.before, surface.after
    if not isinstance(surface.sag_terms, IrregularSag) or before is None or after is None:
        return False
    if before.tilts_first or before.z is not None or before.tilt_z is not None:
        return False
    back = undone(before)
    numbers = ("x", "y", "z", "tilt_x", "tilt_y", "tilt_z")
    return after.tilts_first and all(_same(getattr(back, name), getattr(after, name)) for name in numbers)


def _same(a: Tensor | None, b: Tensor | None) -> bool:
    return a is b if a is None or b is None else torch.equal(a, b)


SAGS = {
    "STANDARD": SurfaceType("standard"),
    "XASPHERE": SurfaceType(
        "extended asphere",
        _ROUND,
        terms=1,
        most=240,
        fields=_extended,
        numbers=lambda surface: Numbers({}, surface.coefficients),
    ),
    "TILTSURF": SurfaceType(
        "tilted",
        ("sag_terms",),
        {1: 0, 2: 0},
        fields=_tilted,
        numbers=lambda surface: Numbers({1: surface.sag_terms.tan_x, 2: surface.sag_terms.tan_y}),
    ),
    "TOROIDAL": SurfaceType(
        "toroidal",
        _ROUND,
        {1: INVERSE, **{j: 3 - 2 * j for j in range(2, 9)}},
        terms=1,
        most=240,
        fields=_toroid,
        numbers=_coefficients,
        beyond=lambda numbers: "with Zernike terms (XDAT 1)" if bool(numbers.terms.any()) else "",
    ),
    "BICONICX": SurfaceType("biconic", _ROUND, {1: INVERSE, 2: 0}, fields=_biconic, numbers=_coefficients),
    "XPOLYNOM": SurfaceType(
        "extended polynomial",
        ("curvature", "conic", "sag_terms"),
        terms=1,
        most=230,
        fields=_polynomial,
        numbers=lambda surface: Numbers({}, surface.sag_terms.coefficients, surface.sag_terms.radius),
    ),
    "FZERNSAG": SurfaceType(
        "Zernike fringe sag",
        (*_ROUND, "sag_terms"),
        {**EVEN_POWERS, 9: 1, 10: 1},
        unused={0: "whether the sag ends with its terms' disc; it goes on"},
        terms=1,
        most=37,
        fields=_fringe,
        numbers=_fringe_numbers,
    ),
    "IRREGULA": SurfaceType(
        "irregular",
        ("curvature", "conic", "sag_terms"),
        {1: 1, 2: 1, 3: 0, 4: 0, 5: 1, 6: 1, 7: 1, 8: 0},
        fields=_irregular,
        numbers=_irregular_numbers,
    ),
}

#: TYPE by the added sag terms of a surface; a kind of sag has its own in its row of KINDS.
OF_SAG_TERMS = {
    "TiltSag": "TILTSURF",
    "PolynomialSag": "XPOLYNOM",
    "FringeSag": "FZERNSAG",
    "IrregularSag": "IRREGULA",
}


def _break(numbers: Numbers) -> dict:
    return {"is_break": True, "before": pose_of([numbers.at(j) for j in range(1, 6)], int(numbers.at(6)))}


def _break_numbers(surface: Surface) -> Numbers:
    pose = surface.before
    order = float(pose is not None and pose.tilts_first)
    return Numbers(dict(enumerate([*numbers_of(pose), order], 1)))


def _break_beyond(numbers: Numbers) -> str:
    order = numbers.at(6)
    return "" if order_is_known(order) else f"of order {order:g} (PARM 6; 0 and 1 are known)"


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
        return {"phase": phase(terms, double(numbers.radius), double(numbers.at(0))), **beside(numbers)}

    return fields


def _diffractive_numbers(surface: Surface) -> Numbers:
    phase = surface.phase
    return Numbers({0: phase.order, **even_numbers(surface)}, phase.coefficients, phase.radius)


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


def _diffractive_type(name: str, phase: type, most: int) -> SurfaceType:
    return SurfaceType(
        name,
        _WITH_EVEN,
        {0: 0, **EVEN_POWERS},
        terms=0,
        most=most,
        fields=_diffractive(phase),
        numbers=_diffractive_numbers,
    )


_POLARISATION = dict.fromkeys(range(1, 9), "polarisation; its plane refracts as any other")

PHASES_AND_BREAKS = {
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
        EVEN_POWERS,
        fields=lambda numbers: {"phase": Facets(), **beside(numbers)},
        numbers=lambda surface: Numbers(even_numbers(surface)),
    ),
    "JONESMAT": SurfaceType("Jones matrix", (), unused=_POLARISATION),
}

#: TYPE by the phase of a surface.
OF_PHASES = {
    "Grating": "DGRATING",
    "IdealLens": "PARAX_XY",
    "PolynomialPhase": "BINARY_1",
    "RadialPhase": "BINARY_2",
    "FringePhase": "FZERNPHA",
    "Hologram": "HOLOGRM2",
    "Facets": "FRESNELS",
}


def types() -> dict[str, SurfaceType]:
    """Every type that is modelled, STANDARD first."""
    return {"STANDARD": SAGS["STANDARD"]} | round_types() | SAGS | PHASES_AND_BREAKS


def type_of(surface: Surface) -> str | None:
    """The TYPE that a surface is written as; None where a .zmx file has none."""
    if surface.is_break:
        return "COORDBRK"
    if surface.phase is not None:
        return _type_of_phase(surface)
    if surface.sag_terms is not None:
        return OF_SAG_TERMS.get(type(surface.sag_terms).__name__)
    if surface.coefficients is None:
        return "STANDARD"
    kind = KINDS[surface.kind]
    longer = surface.kind == EVEN and len(surface.coefficients) > kind.parameters
    return "XASPHERE" if longer else kind.zemax


def _type_of_phase(surface: Surface) -> str | None:
    phase = surface.phase
    if isinstance(phase, IdealLens) and phase.power_x.dim() == 0 and float(phase.power_x) == float(phase.power_y) != 0:
        return "PARAXIAL"
    return OF_PHASES.get(type(phase).__name__)
