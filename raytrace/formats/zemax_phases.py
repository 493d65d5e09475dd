"""The types of surface of a .zmx file that bend light by a phase, turn its axes, or are a plane; a row each."""

import itertools
from collections.abc import Callable

import torch

from raytrace.formats.spelling import double
from raytrace.formats.zemax_numbers import INVERSE, Numbers, SurfaceType, numbers_of, order_is_known, pose_of
from raytrace.formats.zemax_sags import EVEN_POWERS, beside, even_numbers
from raytrace.system.phases import Facets, FringePhase, Grating, Hologram, IdealLens, PolynomialPhase, RadialPhase
from raytrace.system.surface import Surface


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
