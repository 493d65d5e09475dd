"""Operands of first order, and the F-numbers of real cones of light.

All are at the primary wavelength, except for those whose rows name one. Signs as in `tracing.paraxial`.
"""

from collections.abc import Callable, Sequence

import numpy as np

from raytrace.maths.dual import Dual, quotient, slope_of, value_of
from raytrace.optimization.context import Evaluate, EvaluationContext, Found, Line, Operand, Planner
from raytrace.optimization.lens_state import LensState
from raytrace.optimization.operands.arguments import need
from raytrace.optimization.operands.rays import known
from raytrace.optimization.ray_bundle import Hits
from raytrace.tracing.paraxial import chief_ray, petzval_sum

_RIM = 32  # rays by which the outline of a cone is known


def one_by_one(tell: Callable[[EvaluationContext, Line], object]) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """Rows that share nothing: a number for each, of the state and the row."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        return lambda context: Found(listed([tell(context, line) for line in lines], context.state.count))

    return plan


def of_state(tell: Callable[[LensState], object]) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """A number of the lens, whatever the row says."""
    return one_by_one(lambda context, line: tell(context.state))


def at_wavelength(tell: Callable[[LensState, int], object]) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """A number of the lens at the wavelength of the row."""
    return one_by_one(lambda context, line: tell(context.state, line.wavelength))


def listed(numbers: Sequence, count: int):
    """Numbers () as one array (R,), with derivatives if there are any."""
    values = np.array([float(value_of(number)) for number in numbers])
    return Dual(values, np.stack([slope_of(n, count) for n in numbers], -1)) if count else values


# -- focal length, pupils and conjugates -------------------------------------------------------------------------------


def _focal_length(context: EvaluationContext, line: Line):
    data = context.state.gaussian(line.wavelength)
    return (
        quotient(-1.0, data.C) if context.planner.conventions.focal_length == "in air" else data.effective_focal_length
    )


def _exit_pupil_position(state: LensState):
    return state.gaussian(state.primary).exit_pupil_distance - state.thickness[-2]


def _exit_pupil_diameter(state: LensState):
    return state.entrance_pupil_diameter * state.gaussian(state.primary).pupil_magnification


def _magnification(state: LensState, wavelength: int):
    return state.gaussian(wavelength).magnification(state.vergence_at(wavelength))


def _angular_magnification(state: LensState, wavelength: int):
    return state.gaussian(wavelength).angular_magnification


def image_slope(state: LensState):
    """u′ of the paraxial marginal ray behind the lens."""
    data = state.gaussian(state.primary)
    return state.marginal_height * data.omega_behind(state.vergence) / data.n_image


def _image_na(state: LensState):
    return np.abs(state.gaussian(state.primary).n_image * np.sin(np.arctan(image_slope(state))))


def _f_number(state: LensState):
    return np.abs(state.gaussian(state.primary).effective_focal_length) / state.entrance_pupil_diameter


def paraxial_image_distance(state: LensState, wavelength: int):
    """mm from the last surface before the image."""
    return state.gaussian(wavelength).image_distance(state.vergence_at(wavelength))


# -- the chief ray of the largest field --------------------------------------------------------------------------------


def extent_of_field(state: LensState):
    """Slope of the largest field at infinity, or mm of the object; real image heights as if they were paraxial ones."""
    fields = state.lens.fields
    largest = float(np.hypot(fields.x.numpy(), fields.y.numpy()).max())
    return state.field_scale * (np.tan(np.deg2rad(largest)) if fields.kind == "angle" else largest)


def chief_ray_of(state: LensState) -> tuple:
    """(ȳ, ū) in front of surface 1 of the chief ray of the largest field, upwards, at every wavelength."""
    pupil, distance = state.gaussian(state.primary).entrance_pupil_position, state.thickness[0]
    return chief_ray(
        extent_of_field(state),
        at_infinity=state.is_at_infinity,
        distance=distance,
        entrance_pupil=pupil,
        parallel=state.lens.fields.telecentric or not np.isfinite(value_of(pupil)),
    )


def _image_height(state: LensState, wavelength: int):
    """Of the largest field, in the paraxial image: m h, or -n u/C of an object at infinity."""
    extent, data = extent_of_field(state), state.gaussian(wavelength)
    if state.is_at_infinity:
        return quotient(-data.n_object * extent, data.C)
    return _magnification(state, wavelength) * extent


# -- lengths -----------------------------------------------------------------------------------------------------------


def _total_thickness(context: EvaluationContext, line: Line):
    first, last = sorted(line.row.integers)
    return sum(context.state.thickness[first : last + 1])


def _total_track(context: EvaluationContext, line: Line):
    """Between the leftmost and the rightmost vertex of surface 1 to the image, on a straight axis."""
    if context.planner.conventions.total_track == "sum":
        return sum(context.state.thickness[1:-1])
    places = [0.0]
    for thickness in context.state.thickness[1:-1]:
        places.append(places[-1] + thickness)
    values = [value_of(place) for place in places]
    return places[int(np.argmax(values))] - places[int(np.argmin(values))]


def petzval_curvature(state: LensState, wavelength: int):
    """1/mm of the surface on which an image without astigmatism lies: -n′ Σ c (n′ - n)/(n n′)."""
    n, c = state.index(wavelength), state.vertex_curvature
    last = len(c) - 1
    return -n[last - 1] * petzval_sum(c[1:last], n[:last])


def _petzval_radius(state: LensState, wavelength: int):
    return quotient(1.0, petzval_curvature(state, wavelength))


# -- cones of real rays ------------------------------------------------------------------------------------------------


def index_before_image(state: LensState, wavelength: int):
    return np.abs(state.index(wavelength)[-2])


def field_of(planner: Planner, number: int) -> tuple[float, float]:
    """A field of the lens by its number, as a part of the largest radius; 0: the largest, along y."""
    fields = planner.lens.fields
    x, y = fields.x.numpy(), fields.y.numpy()
    largest = float(np.hypot(x, y).max())
    if number == 0 or largest == 0:
        return 0.0, float(number == 0)
    return float(x[number - 1]) / largest, float(y[number - 1]) / largest


def along(field: tuple[float, float]) -> tuple[float, float]:
    """The unit vector across the axis towards a field; +y for the axis."""
    length = float(np.hypot(*field))
    return (field[0] / length, field[1] / length) if length else (0.0, 1.0)


def across_rims(which: str) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """1/(n′ |d₊ - d₋|) of the directions d of two rays through opposite rims of the pupil, 1/(2 n′ sin θ′) on the axis.

    which: "axial", at the primary wavelength; or "tangential", "sagittal" of the field and wavelength of the row.
    """

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        waves = [planner.primary if which == "axial" else line.wavelength for line in lines]
        rays = [_rims(line, wave, planner, which) for line, wave in zip(lines, waves, strict=True)]
        ahead, back = np.array(rays).T

        def evaluate(context: EvaluationContext) -> Found:
            one, other = context.hits(ahead), context.hits(back)
            squares = sum((a - b) ** 2 for a, b in zip(one.direction, other.direction, strict=True))
            index = listed([index_before_image(context.state, wave) for wave in waves], context.state.count)
            return Found(known(one.valid & other.valid, 1 / (index * np.sqrt(squares))))

        return evaluate

    return plan


def _rims(line: Line, wavelength: int, planner: Planner, which: str) -> list[int]:
    field = (0.0, 0.0) if which == "axial" else field_of(planner, line.row.integers[0])
    x, y = along(field)
    rim = (y, -x) if which == "sagittal" else (x, y)
    return [
        planner.ray(line, field=field, pupil=(side * rim[0], side * rim[1]), wavelength=wavelength) for side in (1, -1)
    ]


def _effective_f_number(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """√(π/Ω)/(2 n′), Ω the area in (L, M) inside the outline of the field's cone: ∮ L dM, by Fourier's series."""
    angles = 2 * np.pi * np.arange(_RIM) / _RIM
    rim = list(zip(np.cos(angles).tolist(), np.sin(angles).tolist(), strict=True))
    fields = [field_of(planner, need(line, "field", round(line.row.numbers[0]), planner.lens)) for line in lines]
    rays = [
        np.array([planner.ray(line, field=field, pupil=point) for point in rim])
        for line, field in zip(lines, fields, strict=True)
    ]
    around = _derivative(_RIM) * (2 * np.pi / _RIM)

    def number(context: EvaluationContext, hits: Hits, wavelength: int):
        if not hits.valid.all():
            return np.nan
        L, M, _ = hits.direction
        return np.sqrt(np.pi / np.abs((L * (around @ M)).sum())) / (2 * index_before_image(context.state, wavelength))

    def evaluate(context: EvaluationContext) -> Found:
        told = [number(context, context.hits(rim), line.wavelength) for rim, line in zip(rays, lines, strict=True)]
        return Found(listed(told, context.state.count))

    return evaluate


def _derivative(count: int) -> np.ndarray:
    """The matrix (N, N) that takes a function at N even points of a circle to its derivative by the angle."""
    steps = np.arange(1, count)
    column = np.concatenate([[0.0], 0.5 * (-1.0) ** steps / np.tan(np.pi * steps / count)])
    places = np.arange(count)
    return column[(places[:, None] - places) % count]


PARAXIAL = {
    "EFFL": Operand(
        one_by_one(_focal_length),
        "effective focal length at a wavelength",
        length=1,
        convention="n′/power, as of the slope behind the lens, where that is not air; `focal_length` in air: 1/power",
        takes=("", "wavelength"),
    ),
    "PMAG": Operand(at_wavelength(_magnification), "paraxial magnification at a wavelength", takes=("", "wavelength")),
    "AMAG": Operand(
        at_wavelength(_angular_magnification),
        "angular magnification ū′/ū of the paraxial chief ray at a wavelength",
        takes=("", "wavelength"),
    ),
    "PIMH": Operand(
        at_wavelength(_image_height),
        "height of the largest field in the paraxial image at a wavelength",
        length=1,
        takes=("", "wavelength"),
    ),
    "ISNA": Operand(of_state(_image_na), "numerical aperture n′ sin u′ behind the lens, by the paraxial marginal ray"),
    "OBSN": Operand(
        of_state(
            lambda state: np.abs(
                state.gaussian(state.primary).n_object
                * np.sin(np.arctan(state.marginal_height / state.object_distance))
            )
        ),
        "numerical aperture n sin u in front of the lens, by the paraxial marginal ray",
    ),
    "ISFN": Operand(of_state(_f_number), "F-number: focal length / entrance pupil diameter"),
    "WFNO": Operand(
        across_rims("axial"),
        "working F-number 1/(2 n′ sin θ′) of the axis by the real marginal rays",
        convention="of the rays that the vignetting factors of the axis leave",
    ),
    "TFNO": Operand(
        across_rims("tangential"),
        "tangential working F-number, of a field (0: the largest) and wavelength",
        convention="1/(n′ |d₊ - d₋|) of the directions of the rays through the upper and the lower rim",
        takes=("field", "wavelength"),
    ),
    "SFNO": Operand(
        across_rims("sagittal"),
        "sagittal working F-number, of a field (0: the largest) and wavelength",
        convention="1/(n′ |d₊ - d₋|) of the directions of the rays through the left and the right rim",
        takes=("field", "wavelength"),
    ),
    "EFNO": Operand(
        _effective_f_number,
        "effective F-number √(π/Ω)/(2 n′) by the projected solid angle Ω of a cone: wavelength, in the column of Hx a "
        "field (0: the largest)",
        convention="Ω inside the outline of 32 rays through the rim as vignetting factors leave; the first integer, "
        "a sampling, is not looked at",
        takes=("", "wavelength"),
    ),
    "ENPP": Operand(
        of_state(lambda state: state.gaussian(state.primary).entrance_pupil_position),
        "entrance pupil, from surface 1",
        length=1,
    ),
    "EPDI": Operand(of_state(lambda state: state.entrance_pupil_diameter), "entrance pupil diameter", length=1),
    "EXPP": Operand(of_state(_exit_pupil_position), "exit pupil, from the image", length=1),
    "EXPD": Operand(of_state(_exit_pupil_diameter), "exit pupil diameter", length=1),
    "TOTR": Operand(
        one_by_one(_total_track),
        "total track, surface 1 to image",
        length=1,
        convention="from the leftmost to the rightmost vertex on a straight axis; `total_track` sum: of the "
        "thicknesses, which differs where some are negative",
    ),
    "TTHI": Operand(
        one_by_one(_total_thickness),
        "sum of the thicknesses of surfaces a to b, both counted",
        length=1,
        takes=("surface", "surface"),
    ),
    "PETZ": Operand(
        at_wavelength(_petzval_radius),
        "radius of the Petzval surface at a wavelength",
        length=1,
        takes=("", "wavelength"),
    ),
    "PETC": Operand(
        at_wavelength(petzval_curvature),
        "curvature of the Petzval surface at a wavelength",
        length=-1,
        takes=("", "wavelength"),
    ),
}
