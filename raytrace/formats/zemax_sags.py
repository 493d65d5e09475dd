"""The types of surface of a .zmx file that are a sag and no more, a row each."""

import torch
from torch import Tensor

from raytrace.formats.spelling import double
from raytrace.formats.zemax_numbers import INVERSE, Numbers, SurfaceType, numbers_of, pose_of
from raytrace.system.departure import FringeSag
from raytrace.system.polynomials import IrregularSag, PolynomialSag, TiltSag
from raytrace.system.pose import undone
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
    return {"departure": TiltSag(*map(double, slopes))} if any(slopes) else {}


def _polynomial(numbers: Numbers) -> dict:
    return {"departure": PolynomialSag(numbers.terms, double(numbers.radius))} if len(numbers.terms) else {}


def _fringe(numbers: Numbers) -> dict:
    found = beside(numbers)
    if len(numbers.terms):
        centre = double(numbers.at(9)), double(numbers.at(10))
        found["departure"] = FringeSag(numbers.terms, double(numbers.radius), *centre)
    return found


def _fringe_numbers(surface: Surface) -> Numbers:
    sag = surface.departure
    return Numbers({**even_numbers(surface), 9: sag.centre_x, 10: sag.centre_y}, sag.coefficients, sag.radius)


def _irregular(numbers: Numbers) -> dict:
    """Terms normalised by the semi-diameter, in axes of their own that end with the surface."""
    found, (spherical, astigmatism, coma, angle) = {}, (numbers.at(j) for j in range(5, 9))
    if spherical or astigmatism or coma:
        if numbers.size is None:
            raise ValueError("no semi-diameter (DIAM), by which the terms of an irregular surface are normalised")
        found["departure"] = IrregularSag(*map(double, (spherical, astigmatism, coma, angle, numbers.size)))
    own = pose_of([*(numbers.at(j) for j in range(1, 5)), 0.0], 0)
    return found if own is None else found | {"before": own, "after": undone(own)}


def _irregular_numbers(surface: Surface) -> Numbers:
    sag = surface.departure
    if surface.semi_diameter is None or float(sag.radius) != surface.semi_diameter:
        found = f"a radius of {float(sag.radius)!r} mm and a semi-diameter of {surface.semi_diameter!r}"
        raise ValueError(f"an irregular surface with {found}: the file has one number for both")
    own = numbers_of(surface.before)[:4] if stands_in_parameters(surface) else [0.0] * 4
    return Numbers(dict(enumerate([*own, sag.spherical, sag.astigmatism, sag.coma, sag.angle], 1)))


def stands_in_parameters(surface: Surface) -> bool:
    """Whether the poses of a surface are one that it makes and undoes itself: decentres, then tilts about x and y."""
    before, after = surface.before, surface.after
    if not isinstance(surface.departure, IrregularSag) or before is None or after is None:
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
        ("departure",),
        {1: 0, 2: 0},
        fields=_tilted,
        numbers=lambda surface: Numbers({1: surface.departure.tan_x, 2: surface.departure.tan_y}),
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
        ("curvature", "conic", "departure"),
        terms=1,
        most=230,
        fields=_polynomial,
        numbers=lambda surface: Numbers({}, surface.departure.coefficients, surface.departure.radius),
    ),
    "FZERNSAG": SurfaceType(
        "Zernike fringe sag",
        (*_ROUND, "departure"),
        {**EVEN_POWERS, 9: 1, 10: 1},
        unused={0: "whether the sag ends with its terms' disc; it goes on"},
        terms=1,
        most=37,
        fields=_fringe,
        numbers=_fringe_numbers,
    ),
    "IRREGULA": SurfaceType(
        "irregular",
        ("curvature", "conic", "departure"),
        {1: 1, 2: 1, 3: 0, 4: 0, 5: 1, 6: 1, 7: 1, 8: 0},
        fields=_irregular,
        numbers=_irregular_numbers,
    ),
}

#: TYPE by the departure of a surface; a kind of sag has its own in its row of KINDS.
OF_DEPARTURES = {
    "TiltSag": "TILTSURF",
    "PolynomialSag": "XPOLYNOM",
    "FringeSag": "FZERNSAG",
    "IrregularSag": "IRREGULA",
}
