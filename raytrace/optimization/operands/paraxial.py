"""Operands of first order, and the F-numbers of real cones of light.

At the primary wavelength, or that of the row. Signs and formulas are those of `tracing.paraxial`.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np

from raytrace.maths.numerics import Dual, Number, quotient, value_of
from raytrace.optimization.lens_state import LensState, listed
from raytrace.optimization.operands.operand import (
    Evaluate,
    EvaluationContext,
    Line,
    Operand,
    Plan,
    Planner,
    RowValue,
    RowValues,
    known,
    need,
    per_row,
)
from raytrace.tracing.paraxial import chief_ray, petzval_sum
from raytrace.tracing.paraxial import largest_field as outermost_field

_RIM = 32  # rays of the outline of a cone


def _one_by_one(number: Callable[[EvaluationContext, Line], Number]) -> Plan:
    """The plan of rows whose values are a function of the context and the row."""
    return lambda lines, planner: per_row(partial(_of_line, number, line) for line in lines)


def _of_line(number: Callable[[EvaluationContext, Line], Number], line: Line, context: EvaluationContext) -> Number:
    return number(context, line)


def _focal_length(context: EvaluationContext, line: Line) -> Number:
    data = context.state.gaussian(line.wavelength)
    in_air = context.planner.conventions.focal_length == "in air"
    return data.focal_length_in_air if in_air else data.effective_focal_length


def _magnification(state: LensState, wavelength: int) -> Number:
    return state.gaussian(wavelength).magnification(state.vergence_at(wavelength))


def _image_na(state: LensState) -> Number:
    """n′ sin u′ of the paraxial marginal ray behind the lens."""
    data = state.gaussian(state.primary)
    slope = state.marginal_height * data.omega_behind(state.vergence) / data.n_image
    return np.abs(data.n_image * np.sin(np.arctan(slope)))


def _object_na(state: LensState) -> Number:
    n = state.gaussian(state.primary).n_object
    return np.abs(n * np.sin(np.arctan(state.marginal_height / state.object_distance)))


def paraxial_image_distance(state: LensState, wavelength: int) -> Number:
    """mm from the last surface before the image."""
    return state.gaussian(wavelength).image_distance(state.vergence_at(wavelength))


def _largest_extent(state: LensState) -> Number:
    """Slope of the largest field at infinity, or mm of the object; real image heights are taken as paraxial."""
    largest = float(state.lens.fields.extent)
    return state.field_scale * (np.tan(np.deg2rad(largest)) if state.lens.fields.kind == "angle" else largest)


def chief_ray_of(state: LensState) -> tuple[Number, Number]:
    """(ȳ, ū) in front of surface 1 of the chief ray of the largest field, upwards, at every wavelength."""
    pupil = state.gaussian(state.primary).entrance_pupil_position
    return chief_ray(
        _largest_extent(state), at_infinity=state.is_at_infinity, distance=state.thickness[0], entrance_pupil=pupil,
        parallel=state.lens.fields.telecentric or not np.isfinite(value_of(pupil)),
    )  # fmt: skip


def _image_height(state: LensState, wavelength: int) -> Number:
    """Of the largest field, in the paraxial image: m h, or -n u/C of an object at infinity."""
    extent, data = _largest_extent(state), state.gaussian(wavelength)
    if state.is_at_infinity:
        return quotient(-data.n_object * extent, data.C)
    return _magnification(state, wavelength) * extent


def _total_thickness(context: EvaluationContext, line: Line) -> Number:
    first, last = sorted(line.row.integers)
    return sum(context.state.thickness[first : last + 1])


def _total_track(context: EvaluationContext, line: Line) -> Number:
    """Between the leftmost and the rightmost vertex of surface 1 to the image, on a straight axis."""
    if context.planner.conventions.total_track == "sum":
        return sum(context.state.thickness[1:-1])
    positions = [0.0]
    for thickness in context.state.thickness[1:-1]:
        positions.append(positions[-1] + thickness)
    values = [value_of(position) for position in positions]
    return positions[int(np.argmax(values))] - positions[int(np.argmin(values))]


def _petzval_curvature(state: LensState, wavelength: int) -> Number:
    """1/mm of the surface on which an image without astigmatism lies: -n′ Σ c (n′ - n)/(n n′)."""
    n, c = state.index(wavelength), state.vertex_curvature
    last = len(c) - 1
    return -n[last - 1] * petzval_sum(c[1:last], n[:last])


# -- cones of real rays ------------------------------------------------------------------------------------------------


def image_index(context: EvaluationContext, wavelengths: Iterable[int]) -> Number:
    """Index (R,) in front of the image at wavelengths, counted from 0."""
    indices = [np.abs(context.state.index(w)[-2]) for w in wavelengths]
    return listed(indices, context.state.count if any(isinstance(n, Dual) for n in indices) else 0)


def field_of(planner: Planner, number: int) -> tuple[float, float]:
    """A field of the lens by its number, as a part of the largest radius; 0: the largest, `paraxial.largest_field`."""
    fields, largest = planner.lens.fields, float(planner.lens.fields.extent)
    if largest == 0:
        return 0.0, float(number == 0)
    x, y = outermost_field(planner.lens)[:, 0] if number == 0 else (fields.x[number - 1], fields.y[number - 1])
    return float(x) / largest, float(y) / largest


def along(field: tuple[float, float]) -> tuple[float, float]:
    """The unit vector across the axis towards a field; +y for the axis."""
    length = float(np.hypot(*field))
    return (field[0] / length, field[1] / length) if length else (0.0, 1.0)


def _across_rims(lines: Sequence[Line], planner: Planner, *, section: str) -> Evaluate:
    """1/(n′ |d₊ - d₋|) of the directions d of two rays through opposite rims of the pupil, 1/(2 n′ sin θ′) on the axis.

    section: "axial", at the primary wavelength; or "tangential", "sagittal" of the field and wavelength of the row.
    """
    axial = section == "axial"
    waves = [planner.primary if axial else line.wavelength for line in lines]
    fields = [(0.0, 0.0) if axial else field_of(planner, line.row.integers[0]) for line in lines]
    rims = [(y, -x) if section == "sagittal" else (x, y) for x, y in map(along, fields)]

    def through(side: int) -> np.ndarray:
        each = zip(lines, fields, rims, waves, strict=True)
        return np.array(
            [planner.ray(surface, field=h, pupil=(side * x, side * y), wavelength=w) for surface, h, (x, y), w in each]
        )

    ahead, back = through(1), through(-1)

    def evaluate(context: EvaluationContext) -> RowValues:
        a, b = context.hits(ahead), context.hits(back)
        squares = sum((p - q) ** 2 for p, q in zip(a.direction, b.direction, strict=True))
        return RowValues(known(a.valid & b.valid, 1 / (image_index(context, waves) * np.sqrt(squares))))

    return evaluate


def _effective_f_number(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """√(π/Ω)/(2 n′), Ω the area in (L, M) inside the outline of the field's cone: ∮ L dM, by Fourier's series."""
    angles = 2 * np.pi * np.arange(_RIM) / _RIM
    rim = list(zip(np.cos(angles).tolist(), np.sin(angles).tolist(), strict=True))
    steps = np.arange(1, _RIM)
    column = np.concatenate([[0.0], 0.5 * (-1.0) ** steps / np.tan(np.pi * steps / _RIM)])
    by_angle = column[(np.arange(_RIM)[:, None] - np.arange(_RIM)) % _RIM]  # of a function at even points of a circle
    around = by_angle * (2 * np.pi / _RIM)

    def row(line: Line) -> RowValue:
        field = field_of(planner, need(line, "field", round(line.row.numbers[0]), planner.lens))
        rays = np.array([planner.ray(line, field=field, pupil=point) for point in rim])

        def number(context: EvaluationContext) -> Number:
            hits = context.hits(rays)
            if not hits.valid.all():
                return np.nan
            L, M, _ = hits.direction
            return np.sqrt(np.pi / np.abs((L * (around @ M)).sum())) / (2 * image_index(context, [line.wavelength])[0])

        return number

    return per_row(map(row, lines))


def _of_state(number: Callable[[LensState], Number], context: EvaluationContext, line: Line) -> Number:
    return number(context.state)


def _at_wavelength(number: Callable[[LensState, int], Number], context: EvaluationContext, line: Line) -> Number:
    return number(context.state, line.wavelength)


_NA = "numerical aperture {}, by the paraxial marginal ray"
_WORKING = "1/(n′ |d₊ - d₋|) of the directions of the rays through the {} rim"
_OF_A_FIELD = "working F-number, of a field (0: the largest) and wavelength"

#: Numbers of the lens: name, function of the state, text, power of length.
_OF_STATE: tuple[tuple[str, Callable[[LensState], Number], str, int], ...] = (
    ("ISNA", _image_na, _NA.format("n′ sin u′ behind the lens"), 0),
    ("OBSN", _object_na, _NA.format("n sin u in front of the lens"), 0),
    (
        "ISFN",
        lambda state: np.abs(state.gaussian(state.primary).focal_length_in_air) / state.entrance_pupil_diameter,
        "F-number: focal length in air / entrance pupil diameter",
        0,
    ),
    ("ENPP", lambda state: state.gaussian(state.primary).entrance_pupil_position, "entrance pupil, from surface 1", 1),
    ("EPDI", lambda state: state.entrance_pupil_diameter, "entrance pupil diameter", 1),
    (
        "EXPP",
        lambda state: state.gaussian(state.primary).exit_pupil_distance - state.thickness[-2],
        "exit pupil, from the image",
        1,
    ),
    (
        "EXPD",
        lambda state: state.entrance_pupil_diameter * state.gaussian(state.primary).pupil_magnification,
        "exit pupil diameter",
        1,
    ),
)

#: Numbers of the lens at the wavelength of the row, which ends each text.
_AT_WAVELENGTH: tuple[tuple[str, Callable[[LensState, int], Number], str, int], ...] = (
    ("PMAG", _magnification, "paraxial magnification", 0),
    (
        "AMAG",
        lambda state, wavelength: state.gaussian(wavelength).angular_magnification,
        "angular magnification ū′/ū of the paraxial chief ray",
        0,
    ),
    ("PIMH", _image_height, "height of the largest field in the paraxial image", 1),
    ("PETZ", lambda *ray: quotient(1.0, _petzval_curvature(*ray)), "radius of the Petzval surface", 1),
    ("PETC", _petzval_curvature, "curvature of the Petzval surface", -1),
)

PARAXIAL = {
    "EFFL": Operand(
        _one_by_one(_focal_length),
        "effective focal length at a wavelength",
        length=1,
        convention="n′/power, as of the slope behind the lens, where that is not air; `focal_length` in air: 1/power",
        takes=("", "wavelength"),
    ),
    **{
        name: Operand(_one_by_one(partial(_of_state, number)), text, length) for name, number, text, length in _OF_STATE
    },
    **{
        name: Operand(
            _one_by_one(partial(_at_wavelength, number)),
            f"{text} at a wavelength",
            length,
            takes=("", "wavelength"),
        )
        for name, number, text, length in _AT_WAVELENGTH
    },
    "WFNO": Operand(
        partial(_across_rims, section="axial"),
        "working F-number 1/(2 n′ sin θ′) of the axis by the real marginal rays",
        convention="of the rays that the vignetting factors of the axis leave",
    ),
    **{
        name: Operand(
            partial(_across_rims, section=section),
            f"{section} {_OF_A_FIELD}",
            convention=_WORKING.format(rims),
            takes=("field", "wavelength"),
        )
        for name, section, rims in (
            ("TFNO", "tangential", "upper and the lower"),
            ("SFNO", "sagittal", "left and the right"),
        )
    },
    "EFNO": Operand(
        _effective_f_number,
        "effective F-number √(π/Ω)/(2 n′) by the projected solid angle Ω of a cone: wavelength, in the column of Hx a "
        "field (0: the largest)",
        convention="Ω inside the outline of 32 rays through the rim as vignetting factors leave; the first integer, "
        "a sampling, is not looked at",
        takes=("", "wavelength"),
    ),
    "TOTR": Operand(
        _one_by_one(_total_track),
        "total track, surface 1 to image",
        length=1,
        convention="from the leftmost to the rightmost vertex on a straight axis; `total_track` sum: of the "
        "thicknesses, which differs where some are negative",
    ),
    "TTHI": Operand(
        _one_by_one(_total_thickness),
        "sum of the thicknesses of surfaces a to b, both counted",
        length=1,
        takes=("surface", "surface"),
    ),
}
