"""Tolerances: errors of manufacture as rows, each of a kind of KINDS, and their effect on a lens.

A row is a number that differs from its nominal value within limits: a radius, a thickness, the tilt of an element. Its
value, the error, is in the row's own unit. Rows hold plain numbers, so that two sets compare by their parts.

    tilt, decentre   old = d + Rx Ry Rz new: decentre first, then tilts about x, y and z, as a coordinate break
    runout           the tilt with tan θ = e/(2h): the plane across the vertex rises by e from rim to rim
    power            z(h) of the conic grows by N λ/2 at the semi-diameter h: N fringes in double pass
    irregularity     Δz = N λ/4 (ρ⁴ + v²),  ρ = r/h,  v = (y cos θ - x sin θ)/h

A surface or an element is tilted rigidly about its vertex: a tilted sphere is the sphere about a centre that has moved.

KINDS has a row for each kind: a new kind is a new row.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.materials.glass import with_index_errors
from raytrace.maths.bivariate import zernike_to_powers
from raytrace.maths.zernike import fringe, noll, norm
from raytrace.system.optimization_data import Vary
from raytrace.system.parameter_paths import ParameterPath, number_at, with_number
from raytrace.system.sag_terms import IrregularSag, as_polynomial
from raytrace.system.shapes import curvature_through
from raytrace.system.surface import Surface

#: Distributions of an error between its limits, and OpticStudio's number of each.
DISTRIBUTIONS = {
    "normal": "truncated at the limits, which lie `sigmas` standard deviations from their middle",
    "uniform": "all values between the limits are equally likely",
    "parabolic": "density rising with the square of the distance from the middle of the limits",
    "disc": "density rising with the distance from the middle of the limits: a radial error is uniform over its disc",
    "end_points": "one of the two limits, each with probability 1/2",
    "table": "linear between the points of `density`",
}

#: The highest term of a kind: of Noll's and of the fringe terms.
MOST_TERM = {"zernike": 231, "fringe": 37}

#: The test wavelength of fringes unless a file has another, in µm: a helium-neon laser.
TEST_WAVELENGTH = 0.6328


@dataclass(frozen=True, slots=True)
class Tolerance:
    """A number that differs from its nominal value: its kind, its surfaces and its limits.

    kind: a key of `KINDS`, as "radius", "thickness", "element_tilt_x".
    surfaces: its surface (k,); the first and last surface (k, l) of an element or a group, which may be the same; ()
        of an operand of configurations.
    minimum, maximum: limits of the error in `unit`, that of the kind by default; a radius or an Abbe number may be in
        "%" of its value.
    distribution: a key of `DISTRIBUTIONS`; sigmas: of "normal", how many standard deviations the limits are away.
    adjust: of a thickness, the surface whose thickness changes by the opposite, which keeps the surfaces behind it in
        place; None: no surface.
    pivot: of the tilt of an element, the distance of its axis behind the vertex of its first surface, mm.
    parameter: of "parameter", a name of `parameter_paths`, as "a4", "tilt_x".
    term: of "zernike", Noll's number of the term; of "fringe", that of the fringe terms.
    group: the n rows of a group, such as the components of a radial decentre, are drawn together: a random direction in
        n dimensions, times √n, times a number from the distribution of a row. All reach their limits at once. Two rows
        along x and y of the same surfaces, each with limits of R/√2, are a radial error of the magnitude R.
    density: of the distribution "table": fractions of the way from `minimum` to `maximum`, rising, and the density.
    configuration, operand: of "operand", the configuration (from 1) and its place in `lens.operands` (from 0).
    source: file and line, or the grade that the limits come from.
    """

    kind: str
    surfaces: tuple[int, ...]
    minimum: float
    maximum: float
    unit: str = ""
    distribution: str = "normal"
    sigmas: float = 2.0
    adjust: int | None = None
    pivot: float = 0.0
    parameter: str = ""
    term: int = 0
    group: str = ""
    density: tuple[tuple[float, float], ...] = ()
    configuration: int = 0
    operand: int | None = None
    source: str = ""

    def __post_init__(self) -> None:
        if not self.unit and self.kind in KINDS:
            object.__setattr__(self, "unit", KINDS[self.kind].unit)

    @property
    def where(self) -> str:
        """The place in words: "surface 3", "surfaces 1-2", "operand 1 in configuration 2"."""
        if self.kind == "operand":
            return f"operand {(self.operand or 0) + 1} in configuration {self.configuration}"
        if len(self.surfaces) == 2 and self.surfaces[0] != self.surfaces[1]:
            return f"surfaces {self.surfaces[0]}-{self.surfaces[1]}"
        return f"surface {self.surfaces[0]}" if self.surfaces else "the lens"

    @property
    def name(self) -> str:
        """The quantity in words: the kind, with the parameter or the term."""
        number = str(self.term) if self.term else self.parameter
        return f"{self.kind} {number}".rstrip()

    def __str__(self) -> str:
        return f"{self.name} of {self.where}: {self.minimum:g} to {self.maximum:g} {self.unit}".rstrip()


@dataclass(frozen=True, slots=True)
class Compensator:
    """A number that is adjusted after manufacture, which compensates part of the errors.

    surface, parameter: as of `Vary`: "thickness", "curvature", "conic", or another name of `parameter_paths`.
    minimum, maximum: limits of its change, mm, 1/mm or degrees.
    configuration, operand: of an operand of configurations, as of `Tolerance`. source: file and line.
    """

    surface: int
    parameter: str = "thickness"
    minimum: float = -float("inf")
    maximum: float = float("inf")
    configuration: int = 0
    operand: int | None = None
    source: str = ""

    @property
    def variable(self) -> Vary:
        """The variable of an optimisation that it is."""
        return Vary(self.surface, self.parameter, self.configuration, self.operand)

    def __str__(self) -> str:
        open_ended = self.minimum == -float("inf") and self.maximum == float("inf")
        return str(self.variable) + ("" if open_ended else f", from {self.minimum:g} to {self.maximum:g}")


class Gauge(NamedTuple):
    """The reference of an error of a surface.

    semi_diameter: h mm, None where it is unknown; wavelength: λ of the test in mm; angle: θ of irregularity in degrees,
    (...) as the errors; path: where the surface holds the number of a "parameter".
    """

    semi_diameter: float | None
    wavelength: float
    angle: Tensor | None = None
    path: ParameterPath | None = None

    @property
    def radius(self) -> float:
        """The radius in mm that powers of sag terms are divided by."""
        return self.semi_diameter or 1.0


#: Surface, error (...) in the row's unit, row, `Gauge` -> the surface with that error.
Change = Callable[[Surface, Tensor, Tolerance, Gauge], Surface]

#: Error (...), row, `Gauge` -> coefficients (...) mm of x/r, y/r, x²/r², …, r the `Gauge.radius`, added to the sag.
AddedSag = Callable[[Tensor, Tolerance, Gauge], Sequence[Tensor]]


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of error: its definition, and one of `change`, `sag` and `motion`.

    operand: OpticStudio's; unit; words: its definition. change: makes the surface with an error; sag: the powers that
    it adds to the sag; motion: the field of a `Pose` by which the surface, or all surfaces of an element, are moved;
    step: error (...), `Gauge` -> the number (...) of that field, by default the error.
    length: power of length in the unit, by which limits of a file in inches are converted.
    needs_semi_diameter: whether the error is measured at the semi-diameter. elements: whether it has two surfaces.
    parameter: its parameter of an Irregular surface, which other surfaces may pick up.
    """

    operand: str
    unit: str
    words: str
    change: Change | None = None
    sag: AddedSag | None = None
    motion: str = ""
    step: Callable[[Tensor, Gauge], Tensor] = lambda error, gauge: error
    length: int = 0
    needs_semi_diameter: bool = False
    elements: bool = False
    parameter: int = 0


def _curvature_of(surface: Surface) -> Tensor:
    return torch.zeros_like(surface.thickness) if surface.curvature is None else surface.curvature


def _radius(surface: Surface, error: Tensor, row: Tolerance, gauge: Gauge) -> Surface:
    """1/c′ = 1/c + e, or (1/c)(1 + e) of a part e of it."""
    c = _curvature_of(surface)
    stretched = 1 + error / 100 if row.unit == "%" else 1 + c * error
    return dataclasses.replace(surface, curvature=c / stretched)


def _power(surface: Surface, error: Tensor, row: Tolerance, gauge: Gauge) -> Surface:
    """The conic through z′(h) = z(h) + N λ/2."""
    c, h = _curvature_of(surface), gauge.radius
    shape = 1.0 if surface.conic is None else 1 + surface.conic
    z = c * h**2 / (1 + torch.sqrt(1 - shape * (c * h) ** 2)) + error * (0.5 * gauge.wavelength)
    return dataclasses.replace(surface, curvature=curvature_through(z, h, shape))


def _curvature(surface: Surface, error: Tensor, row: Tolerance, gauge: Gauge) -> Surface:
    return dataclasses.replace(surface, curvature=_curvature_of(surface) + error)


def _conic(surface: Surface, error: Tensor, row: Tolerance, gauge: Gauge) -> Surface:
    return dataclasses.replace(surface, conic=error if surface.conic is None else surface.conic + error)


def _thickness(surface: Surface, error: Tensor, row: Tolerance, gauge: Gauge) -> Surface:
    return dataclasses.replace(surface, thickness=surface.thickness + error)


def _index(surface: Surface, error: Tensor, row: Tolerance, gauge: Gauge) -> Surface:
    return dataclasses.replace(surface, glass=with_index_errors(surface.glass, index=error))


def _abbe(surface: Surface, error: Tensor, row: Tolerance, gauge: Gauge) -> Surface:
    return dataclasses.replace(surface, glass=with_index_errors(surface.glass, abbe=error, percent=row.unit == "%"))


def _parameter(surface: Surface, error: Tensor, row: Tolerance, gauge: Gauge) -> Surface:
    assert gauge.path is not None
    return with_number(surface, gauge.path, number_at(surface, gauge.path) + error)


def _tilt_of_runout(error: Tensor, gauge: Gauge) -> Tensor:
    """θ in degrees, tan θ = e/(2h)."""
    return torch.rad2deg(torch.atan(error / (2 * gauge.radius)))


def _irregularity(error: Tensor, row: Tolerance, gauge: Gauge) -> Sequence[Tensor]:
    """Δz = N λ/4 (ρ⁴ + v²) = N λ/4 (Z_9/6 + 3 Z_4/4 - (Z_5 cos 2θ + Z_6 sin 2θ)/2 + 7/12), Z the fringe terms."""
    angle = torch.zeros_like(error) if gauge.angle is None else gauge.angle
    height, angle = torch.broadcast_tensors(0.25 * gauge.wavelength * error, angle)
    return as_polynomial(IrregularSag(height, height, 0 * height, angle, height)).coefficients.unbind(0)


def _zernike(error: Tensor, row: Tolerance, gauge: Gauge) -> Sequence[Tensor]:
    order = noll(row.term)
    return _term(order, norm(*order) * error)


def _fringe_term(error: Tensor, row: Tolerance, gauge: Gauge) -> Sequence[Tensor]:
    return _term(fringe(row.term), error * (0.5 * gauge.wavelength))


def _term(order: tuple[int, int], height: Tensor) -> list[Tensor]:
    """The powers of a term of a height (...) at the rim."""
    return [float(entry) * height for entry in zernike_to_powers((order,))[0][:, 0]]


_DECENTRE = "decentre of the surface along {}, in its own axes"
_TILT = "tilt of the surface about {} through its vertex"
_RUNOUT = "total indicator runout along {} over the diameter 2h: a tilt of the surface by arctan(e/2h)"
_ELEMENT = "of all surfaces from the first to the last"

#: Every kind of error by its name.
KINDS = {
    "radius": Kind("TRAD", "mm", "radius of curvature, or in % of it", _radius, length=1),
    "power": Kind(
        "TFRN",
        "fringes",
        "power: the sag of the conic at the semi-diameter grows by λ/2 a fringe",
        _power,
        needs_semi_diameter=True,
    ),
    "curvature": Kind("TCUR", "1/mm", "curvature", _curvature, length=-1),
    "conic": Kind("TCON", "", "conic constant", _conic),
    "thickness": Kind("TTHI", "mm", "thickness behind the surface", _thickness, length=1),
    "index": Kind("TIND", "", "index of the medium behind the surface, at all wavelengths", _index),
    "abbe": Kind("TABB", "", "Abbe number of that medium, or in % of it; its index at d stays", _abbe),
    "parameter": Kind("TPAR TUDX TUDY TUTX TUTY TUTZ", "", "a number of `parameter_paths`", _parameter),
    "surface_decenter_x": Kind("TSDX", "mm", _DECENTRE.format("x"), motion="x", length=1, parameter=1),
    "surface_decenter_y": Kind("TSDY", "mm", _DECENTRE.format("y"), motion="y", length=1, parameter=2),
    "surface_tilt_x": Kind("TSTX", "degrees", _TILT.format("x"), motion="tilt_x", parameter=3),
    "surface_tilt_y": Kind("TSTY", "degrees", _TILT.format("y"), motion="tilt_y", parameter=4),
    "surface_runout_x": Kind(
        "TIRX",
        "mm",
        _RUNOUT.format("x"),
        motion="tilt_y",
        step=lambda error, gauge: -_tilt_of_runout(error, gauge),
        length=1,
        needs_semi_diameter=True,
        parameter=4,
    ),
    "surface_runout_y": Kind(
        "TIRY",
        "mm",
        _RUNOUT.format("y"),
        motion="tilt_x",
        step=_tilt_of_runout,
        length=1,
        needs_semi_diameter=True,
        parameter=3,
    ),
    "irregularity": Kind(
        "TIRR",
        "fringes",
        "half spherical, half astigmatism; N fringes of λ/2 at the semi-diameter",
        sag=_irregularity,
        needs_semi_diameter=True,
        parameter=5,
    ),
    "irregularity_angle": Kind("TIRR", "degrees", "angle of the astigmatism of `irregularity`, from y"),
    "zernike": Kind(
        "TEZI",
        "mm",
        "RMS of one of Noll's terms of the sag over the semi-diameter",
        sag=_zernike,
        length=1,
        needs_semi_diameter=True,
    ),
    "fringe": Kind(
        "TEXI",
        "fringes",
        "one of the fringe terms of the sag, λ/2 a fringe at the semi-diameter",
        sag=_fringe_term,
        needs_semi_diameter=True,
    ),
    "element_decenter_x": Kind("TEDX", "mm", f"decentre along x {_ELEMENT}", motion="x", length=1, elements=True),
    "element_decenter_y": Kind("TEDY", "mm", f"decentre along y {_ELEMENT}", motion="y", length=1, elements=True),
    "element_decenter_z": Kind("", "mm", f"shift along z {_ELEMENT}", motion="z", length=1, elements=True),
    "element_tilt_x": Kind("TETX", "degrees", f"tilt about x {_ELEMENT}", motion="tilt_x", elements=True),
    "element_tilt_y": Kind("TETY", "degrees", f"tilt about y {_ELEMENT}", motion="tilt_y", elements=True),
    "element_roll": Kind("TETZ", "degrees", f"rotation about z {_ELEMENT}", motion="tilt_z", elements=True),
    "operand": Kind("TMCO", "", "a number that differs between configurations, in one of them"),
}
