"""Operands of aberrations: colours, Seidel sums, field curvature and distortion.

Seidel sums are those of `analysis.seidel` (Welford 1986), with the derivatives of a state; the others follow rays, as
in `analysis.chief`.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.chief import (
    NEAR_AXIS,
    NEAR_CHIEF,
    distortion_of,
    focus_of_close_rays,
    lateral_colour_of,
    relative_error,
)
from raytrace.analysis.seidel import OF_WAVEFRONT, departure_from_sphere, third_order
from raytrace.maths.numerics import Number, dot_2, value_of
from raytrace.optimization.lens_state import LensState, listed
from raytrace.optimization.operands.operand import (
    BadRow,
    Evaluate,
    EvaluationContext,
    Line,
    Operand,
    Planner,
    RowValue,
    RowValues,
    known,
    per_row,
)
from raytrace.optimization.operands.paraxial import (
    along,
    chief_ray_of,
    field_of,
    paraxial_image_distance,
)
from raytrace.system.lens import Lens
from raytrace.system.surface import is_even, ynu
from raytrace.tracing.launch import vignette
from raytrace.tracing.trace import is_bent

_FIELDS = 30  # of the fit of f θ

# -- rays of the whole pupil, without vignetting -----------------------------------------------------------------------


def unvignetted(lens: Lens, field: tuple[float, float], pupil: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
    """The pupil point that vignetting factors take to a point of the whole pupil, by default its centre."""
    if lens.fields.vignetting is None:
        return pupil
    angles = float(lens.fields.extent) * torch.tensor(field, dtype=torch.float64)[:, None]
    corners = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    shift, *ends = vignette(lens, angles, corners).numpy().T
    matrix = np.stack([end - shift for end in ends], -1)
    x, y = np.linalg.solve(matrix, np.array(pupil) - shift).tolist()
    return x, y


def _chief(line: Line, planner: Planner, field: tuple[float, float], wavelength: int) -> int:
    return planner.ray(line, field=field, pupil=unvignetted(planner.lens, field), wavelength=wavelength)


# -- colours -----------------------------------------------------------------------------------------------------------


def _axial_colour(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """The axial crossing of one wavelength less that of another, along the light."""
    side = _side(planner) * float(np.sign(planner.view.indices[0][-2]))

    def row(line: Line) -> RowValue:
        zone, (first, second) = line.row.numbers[0], _two_wavelengths(line, planner)
        if not zone:
            return lambda context: (
                side * (paraxial_image_distance(context.state, first) - paraxial_image_distance(context.state, second))
            )
        waves = (first, second)
        rays = np.array([planner.ray(line, field=(0.0, 0.0), pupil=(0.0, zone), wavelength=w) for w in waves])

        def number(context: EvaluationContext) -> Number:
            hits = context.hits(rays)
            crossing = known(hits.valid, hits.position[2] - hits.position[1] * hits.direction[2] / hits.direction[1])
            return side * (crossing[0] - crossing[1])

        return number

    return per_row(map(row, lines))


def _lateral_colour(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """Height of the chief ray of the largest field of one wavelength, less that of another."""
    side, field = _side(planner), field_of(planner, 0)
    waves = [_two_wavelengths(line, planner) for line in lines]
    if is_bent(planner.lens):
        fields, (first, second) = _points(planner, [field]), np.array(waves).T

        def shifts(lens: Lens) -> list[Tensor]:
            colour = lateral_colour_of(lens, fields)
            shift = torch.where(colour.valid, colour.shift, torch.nan)[0]
            return [*(side * (shift[first] - shift[second]))]

        return _by_analysis(shifts)
    first, second = (
        np.array([_chief(line, planner, field, pair[k]) for line, pair in zip(lines, waves, strict=True)])
        for k in range(2)
    )
    x, y = along(field)

    def evaluate(context: EvaluationContext) -> RowValues:
        a, b = context.hits(first), context.hits(second)
        apart = x * (a.position[0] - b.position[0]) + y * (a.position[1] - b.position[1])
        return RowValues(known(a.valid & b.valid, side * apart))

    return evaluate


def _by_analysis(numbers: Callable[[Lens], Sequence[Tensor]]) -> Evaluate:
    """Rows of numbers () that an analysis computes from the lens."""
    return lambda context: RowValues(listed(context.state.through_torch(numbers), context.state.count))


def _points(planner: Planner, fields: Sequence[tuple[float, float]]) -> Tensor:
    """Fields (2, F) in the lens's own kind of field, of parts of the largest radius."""
    return float(planner.lens.fields.extent) * torch.tensor(fields, dtype=torch.float64).T


def _side(planner: Planner) -> float:
    return 1.0 if planner.conventions.colour == "first" else -1.0


def _two_wavelengths(line: Line, planner: Planner) -> tuple[int, int]:
    """The wavelengths of a row, from 0; its integers 0 are the shortest and the longest."""
    wavelengths = planner.view.wavelengths
    first, second = line.row.integers
    return first - 1 if first else int(np.argmin(wavelengths)), second - 1 if second else int(np.argmax(wavelengths))


# -- Seidel ------------------------------------------------------------------------------------------------------------


def _seidel(state: LensState, wavelength: int) -> tuple[Number, ...]:
    """S1 to S5 in mm, (K,) each, of surfaces 1 to the last before the image."""
    n, c = state.index(wavelength), state.vertex_curvature
    surfaces = range(1, len(c) - 1)
    powers = [c[k] * (n[k] - n[k - 1]) for k in surfaces]
    gaps = [state.thickness[k] / n[k] for k in surfaces[:-1]]
    y, (y_bar, slope) = state.marginal_height, chief_ray_of(state)
    omega, omega_bar = n[0] * y / state.object_distance, n[0] * slope
    rays = [ynu(*ray, powers, gaps)[:-1] for ray in ((y, omega), (y_bar, omega_bar))]
    columns = (zip(*ray, strict=True) for ray in rays)
    marginal, chief = ((listed(heights, state.count), listed(slopes, state.count)) for heights, slopes in columns)
    vertex = listed(c[1:-1], state.count)
    indices = listed([n[k - 1] for k in surfaces], state.count), listed([n[k] for k in surfaces], state.count)
    invariant = omega_bar * y - omega * y_bar
    curvature, conic, a4 = (state.of_surfaces(name)[1:-1] for name in ("curvature", "conic", "a4"))
    departure = departure_from_sphere(curvature, 1 + conic, a4, vertex)
    return third_order(marginal, chief, vertex, indices, departure, invariant)


def _seidel_sum(lines: Sequence[Line], planner: Planner, *, which: int) -> Evaluate:
    """A sum in waves of the row's wavelength, of a surface or of all."""
    if is_bent(planner.lens):
        raise BadRow(lines[0], "is of a straight axis: tilts and decentres bend this one")
    for k, surface in enumerate(planner.lens.surfaces):
        if not is_even(surface):
            raise BadRow(lines[0], f"is of even powers of r: surface {k} has other terms, added sag or a phase")
    share = OF_WAVEFRONT[which] if planner.conventions.seidel == "wavefront" else 1

    def number(context: EvaluationContext, line: Line) -> Number:
        sums, surface = context.state.kept(_seidel, line.wavelength)[which], line.row.integers[0]
        total = sums[surface - 1] if surface else sums.sum()
        return total / (share * 1e-3 * planner.view.wavelengths[line.wavelength])

    return lambda context: RowValues(listed([number(context, line) for line in lines], context.state.count))


def _distortion_sum(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """S5 in waves of the surfaces of the rows; of surface 0 the real distortion of the largest field."""
    of_lens = [line for line in lines if line.row.integers[0] == 0]
    of_surface = [line for line in lines if line.row.integers[0] != 0]
    plans = ((of_lens, _distortion), (of_surface, partial(_seidel_sum, which=4)))
    planned = [(rows, plan(rows, planner)) for rows, plan in plans if rows]

    def evaluate(context: EvaluationContext) -> RowValues:
        numbers: dict[int, Number] = {}
        for rows, values_of in planned:
            values = values_of(context).values
            numbers |= {line.number: values[k] for k, line in enumerate(rows)}
        return RowValues(listed([numbers[line.number] for line in lines], context.state.count))

    return evaluate


# -- distortion and field curvature by rays ----------------------------------------------------------------------------


def _distortion(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """100 (h/h₀ - 1) in %, or h - h₀ where the number in the column of Hx is not 0; h₀ by a ray near the axis."""
    return _distortion_of(lines, planner, [field_of(planner, line.row.integers[0]) for line in lines])


def _distortion_of(lines: Sequence[Line], planner: Planner, fields: Sequence[tuple[float, float]]) -> Evaluate:
    """The distortion of a field of each row, by rays; of bent axes and fields that are images by the analysis."""
    for line, field in zip(lines, fields, strict=True):
        if not any(field) or not float(planner.lens.fields.extent):
            raise BadRow(line, f"names field {line.row.integers[0]}, on the axis, where nothing is distorted")
    absolute = np.array([bool(line.row.numbers[0]) for line in lines])
    if is_bent(planner.lens) or planner.lens.fields.kind == "real_image_height":
        points, waves = _points(planner, fields), [line.wavelength for line in lines]

        def errors(lens: Lens) -> list[Tensor]:
            curve = distortion_of(lens, points)
            relative, ideal = (part[range(len(waves)), waves] for part in (curve.f_tan, curve.ideal))
            error = torch.where(torch.from_numpy(absolute), ideal * relative / planner.unit, 100 * relative)
            return [*torch.where(curve.valid[range(len(waves)), waves], error, torch.nan)]

        return _by_analysis(errors)
    close = [(NEAR_AXIS * x, NEAR_AXIS * y) for x, y in fields]
    far, near = (
        np.array([_chief(line, planner, field, line.wavelength) for line, field in zip(lines, places, strict=True)])
        for places in (fields, close)
    )
    meridian = np.array([along(field) for field in fields]).T
    extent, close_extent = (np.array([_extent(planner, field) for field in places]) for places in (fields, close))

    def evaluate(context: EvaluationContext) -> RowValues:
        hits, close_hits = context.hits(far), context.hits(near)
        h, ideal = (dot_2(part.position, meridian) for part in (hits, close_hits))
        ideal = ideal * (extent / close_extent)
        error = np.where(absolute, (h - ideal) / planner.unit, 100 * relative_error(h, ideal))
        return RowValues(known(hits.valid & close_hits.valid, error))

    return evaluate


def _extent(planner: Planner, field: tuple[float, float]) -> float:
    """tan θ of a field, or its height: the ideal image height is proportional to it."""
    size = float(planner.lens.fields.extent) * float(np.hypot(*field))
    return float(np.tan(np.deg2rad(size))) if planner.lens.fields.kind == "angle" else size


def _largest_distortion(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """The largest |distortion| of the fields of each row, or the target where that is met."""
    each = [(row, field) for row, line in enumerate(lines) for field in _fields_of(line, planner)]
    rows, targets = np.array([row for row, _ in each]), np.array([line.row.target for line in lines])
    distortion = _distortion_of([lines[row] for row in rows], planner, [field for _, field in each])
    no_surface = np.zeros(len(rows), dtype=int)

    def evaluate(context: EvaluationContext) -> RowValues:
        sizes = np.abs(distortion(context).values)
        values = value_of(sizes)
        largest = [int(np.flatnonzero(rows == row)[np.argmax(values[rows == row])]) for row in range(len(lines))]
        return RowValues(np.maximum(sizes[largest], targets), sides=(rows, sizes - targets[rows], no_surface))

    return evaluate


def _fields_of(line: Line, planner: Planner) -> list[tuple[float, float]]:
    """The field of a row; with a number in the column of Hy so many fields from the axis to it, the axis left out."""
    x, y = field_of(planner, line.row.integers[0])
    last = max(round(line.row.numbers[1]) - 1, 1)
    return [(k / last * x, k / last * y) for k in range(1, last + 1)]


def _calibrated_distortion(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """The largest |y - f θ|, in % of f θ or in lengths, of fields along y; f by least squares over all of them."""
    largest = float(planner.lens.fields.extent)
    if planner.lens.fields.kind != "angle" or not largest:
        kind = planner.lens.fields.kind.replace("_", " ")
        raise BadRow(lines[0], f"is of angles of the field; this lens has a field of {kind}")
    steps = _FIELDS if planner.conventions.f_theta == "axis left out" else _FIELDS - 1
    parts = [(k + 1) / steps for k in range(steps)]
    theta = np.deg2rad(largest) * np.array(parts)

    def row(line: Line) -> RowValue:
        rays = np.array([_chief(line, planner, (0.0, part), line.wavelength) for part in parts])

        def number(context: EvaluationContext) -> Number:
            hits = context.hits(rays)
            if not hits.valid.all():
                return np.nan
            y = hits.position[1]
            ideal = ((y * theta).sum() / (theta @ theta)) * theta
            absolute = line.row.numbers[0]
            error = np.abs((y - ideal) / planner.unit if absolute else 100 * relative_error(y, ideal))
            return error[int(np.argmax(value_of(error)))]

        return number

    return per_row(map(row, lines))


def _field_curvature(lines: Sequence[Line], planner: Planner, *, across: bool) -> Evaluate:
    """mm from the image along z to the focus of close rays about the chief ray, in the plane of the field or across."""
    meridians = [along(line.field) for line in lines]
    sections = [(y, -x) if across else (x, y) for x, y in meridians]

    def rays(side: float) -> np.ndarray:
        points = [
            unvignetted(planner.lens, line.field, (side * x, side * y))
            for line, (x, y) in zip(lines, sections, strict=True)
        ]
        return np.array([planner.ray(line, pupil=point) for line, point in zip(lines, points, strict=True)])

    first, second, section = rays(NEAR_CHIEF), rays(-NEAR_CHIEF), np.array(sections).T

    def evaluate(context: EvaluationContext) -> RowValues:
        a, b = context.hits(first), context.hits(second)
        apart = [a.position[k] - b.position[k] for k in range(2)]
        opening = [a.direction[k] / a.direction[2] - b.direction[k] / b.direction[2] for k in range(2)]
        focus = focus_of_close_rays(dot_2(apart, section), dot_2(opening, section))
        return RowValues(known(a.valid & b.valid, focus))

    return evaluate


def _sum_row(which: int, word: str, share: int) -> Operand:
    return Operand(
        partial(_seidel_sum, which=which - 1),
        f"{word} S{which} in waves: of a surface (0: all of them), at a wavelength",
        convention=f"Seidel's coefficient S{which} itself over the wavelength; `seidel` wavefront: S{which}/{share}",
        takes=_CONTRIBUTION,
    )


_CONTRIBUTION = "contribution", "wavelength"
_CLOSE = "without vignetting factors, by rays at a thousandth of the pupil"
_SIGN = "the first wavelength's less the second's; `colour` second: the other way round"
_OR_LENGTHS = "in lengths where the number in the column of Hx is not 0"

ABERRATIONS = {
    "AXCL": Operand(
        _axial_colour,
        "axial colour: where one wavelength meets the axis less where another does; paraxial, or of the real ray at "
        "the height of the pupil in the column of Hx",
        length=1,
        convention=_SIGN,
        takes=("shortest", "longest"),
    ),
    "LACL": Operand(
        _lateral_colour,
        "lateral colour: y of the chief ray of one wavelength less that of another, of the largest field",
        length=1,
        convention=f"real chief rays; {_SIGN}",
        takes=("shortest", "longest"),
    ),
    "SPHA": _sum_row(1, "spherical aberration", 8),
    "COMA": _sum_row(2, "coma", 2),
    "ASTI": _sum_row(3, "astigmatism", 2),
    "FCUR": _sum_row(4, "field curvature", 4),
    "DIST": Operand(
        _distortion_sum,
        f"distortion S5 in waves of a surface at a wavelength; of surface 0 that of the largest field in %, or "
        f"{_OR_LENGTHS}",
        convention="S5 itself over the wavelength, `seidel` wavefront: S5/2; of surface 0 by the real chief ray, "
        "against one near the axis",
        takes=_CONTRIBUTION,
    ),
    "DIMX": Operand(
        _largest_distortion,
        "|distortion| of a field (0: the largest) at a wavelength is meant to be below the target: its value in %, or "
        f"{_OR_LENGTHS}, or the target itself where that is met",
        convention="of that field alone; where the number in the column of Hy is above 1, the largest of so many "
        "fields from the axis to it; the ideal height by a chief ray near the axis",
        takes=("field", "wavelength"),
        bounds="<=",
    ),
    "DISC": Operand(
        _calibrated_distortion,
        f"largest distortion from y = f θ at a wavelength, in %, or {_OR_LENGTHS}",
        convention=f"{_FIELDS} fields along y at even steps, the axis left out, f by least squares over them; "
        f"`f_theta` axis included: {_FIELDS - 1} steps and the axis",
        takes=("", "wavelength"),
    ),
    **{
        name: Operand(
            partial(_field_curvature, across=across),
            f"{word} field curvature of a field Hx Hy: from the image to the focus of close rays",
            length=1,
            convention=_CLOSE,
            takes=("", "wavelength"),
        )
        for name, across, word in (("FCGS", True, "sagittal"), ("FCGT", False, "tangential"))
    },
}
