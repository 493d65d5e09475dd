"""Operands of aberrations: colours, Seidel's sums, field curvature and distortion.

Seidel's by the sums of `analysis.seidel` (Welford 1986), here with the derivatives of a state; the others by rays.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch

from raytrace.analysis.seidel import OF_WAVEFRONT, departure_from_sphere, third_order
from raytrace.maths.dual import value_of
from raytrace.optimization.context import BadRow, Evaluate, EvaluationContext, Found, Line, Operand, Planner
from raytrace.optimization.lens_state import LensState
from raytrace.optimization.operands.paraxial import along, chief_ray_of, field_of, listed, paraxial_image_distance
from raytrace.optimization.operands.rays import known
from raytrace.system.surface import is_even
from raytrace.tracing.aiming import is_bent
from raytrace.tracing.launch import vignette
from raytrace.tracing.paraxial import ynu

_NEAR_AXIS = 1e-4  # of the field: its chief ray tells the scale of the image
_NEAR_CHIEF = 1e-3  # of the pupil: close rays tell where they meet
_FIELDS = 30  # by which f θ is fitted

# -- rays of an axis and of a pupil without vignetting -----------------------------------------------------------------


def bare(planner: Planner, field: tuple[float, float], pupil: tuple[float, float]) -> tuple[float, float]:
    """The pupil point that vignetting factors take to a point of the whole pupil."""
    lens = planner.lens
    if lens.fields.vignetting is None:
        return pupil
    largest = float(torch.hypot(lens.fields.x, lens.fields.y).max())
    at = largest * torch.tensor(field, dtype=torch.float64)[:, None]
    corners = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    shift, *ends = vignette(lens, at, corners).numpy().T
    matrix = np.stack([end - shift for end in ends], -1)
    return tuple(np.linalg.solve(matrix, np.array(pupil) - shift).tolist())


def _chief(line: Line, planner: Planner, field: tuple[float, float], wavelength: int) -> int:
    return planner.ray(line, field=field, pupil=bare(planner, field, (0.0, 0.0)), wavelength=wavelength)


# -- colours -----------------------------------------------------------------------------------------------------------


def _axial_colour(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """Where light of one wavelength meets the axis, less where that of another does."""
    side = _side(planner)
    waves = [_two_wavelengths(line, planner) for line in lines]
    zones = [line.row.numbers[0] for line in lines]
    rays = [
        [planner.ray(line, field=(0.0, 0.0), pupil=(0.0, zone), wavelength=wave) for wave in pair] if zone else None
        for line, zone, pair in zip(lines, zones, waves, strict=True)
    ]

    def number(context: EvaluationContext, pair, asked):
        if asked is None:
            return paraxial_image_distance(context.state, pair[0]) - paraxial_image_distance(context.state, pair[1])
        hits = context.hits(np.array(asked))
        crossing = known(hits.valid, hits.position[2] - hits.position[1] * hits.direction[2] / hits.direction[1])
        return crossing[0] - crossing[1]

    def evaluate(context: EvaluationContext) -> Found:
        told = [side * number(context, pair, asked) for pair, asked in zip(waves, rays, strict=True)]
        return Found(listed(told, context.state.count))

    return evaluate


def _lateral_colour(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """y of the chief ray of the largest field of one wavelength, less that of another."""
    side = _side(planner)
    waves = [_two_wavelengths(line, planner) for line in lines]
    field = field_of(planner, 0)
    first, second = (
        np.array([_chief(line, planner, field, pair[k]) for line, pair in zip(lines, waves, strict=True)])
        for k in range(2)
    )

    def evaluate(context: EvaluationContext) -> Found:
        one, other = context.hits(first), context.hits(second)
        return Found(known(one.valid & other.valid, side * (one.position[1] - other.position[1])))

    return evaluate


def _side(planner: Planner) -> float:
    return 1.0 if planner.conventions.colour == "first" else -1.0


def _two_wavelengths(line: Line, planner: Planner) -> tuple[int, int]:
    """The wavelengths of a row, from 0; where it says 0 the shortest and the longest."""
    wavelengths = planner.view.wavelengths
    extremes = int(np.argmin(wavelengths)), int(np.argmax(wavelengths))
    return tuple(n - 1 if n else extreme for n, extreme in zip(line.row.integers, extremes, strict=True))


# -- Seidel ------------------------------------------------------------------------------------------------------------


def _seidel(state: LensState, wavelength: int, shapes: "_Shapes"):
    """S1 to S5 in mm, (K,) each, of surfaces 1 to the last before the image."""
    n, c = state.index(wavelength), state.vertex_curvature
    surfaces = range(1, len(c) - 1)
    powers = [c[k] * (n[k] - n[k - 1]) for k in surfaces]
    gaps = [state.thickness[k] / n[k] for k in surfaces[:-1]]
    y, (y_bar, slope) = state.marginal_height, chief_ray_of(state)
    omega, omega_bar = n[0] * y / state.object_distance, n[0] * slope
    rays = [ynu(*ray, powers, gaps)[:-1] for ray in ((y, omega), (y_bar, omega_bar))]
    marginal, chief = ([listed(column, state.count) for column in zip(*ray, strict=True)] for ray in rays)
    vertex = listed(c[1:-1], state.count)
    indices = [listed([n[k + side] for k in surfaces], state.count) for side in (-1, 0)]
    return third_order(
        marginal, chief, vertex, indices, shapes.departures(state, vertex), omega_bar * y - omega * y_bar
    )


class _Shapes:
    """By how much surfaces depart from the spheres of their vertex curvatures, in r⁴."""

    def __init__(self, planner: Planner):
        surfaces = planner.lens.surfaces[1:-1]
        self.conics = [
            (k, planner.view.number((k, "conic"))) for k, surface in enumerate(surfaces, 1) if surface.conic is not None
        ]
        self.terms = [
            (k, planner.view.number((k, "a4")))
            for k, surface in enumerate(surfaces, 1)
            if surface.coefficients is not None and len(surface.coefficients) > 1
        ]

    def departures(self, state: LensState, vertex):
        """G (K,) in 1/mm³."""
        c, count = listed(state.curvature[1:-1], state.count), state.count
        shape, terms = [1.0] * len(value_of(c)), [0.0] * len(value_of(c))
        for k, stored in self.conics:
            shape[k - 1] = 1 + state.numbers.get((k, "conic"), stored)
        for k, stored in self.terms:
            terms[k - 1] = state.numbers.get((k, "a4"), stored)
        return departure_from_sphere(c, listed(shape, count), listed(terms, count), vertex)


def _of_seidel(which: int) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """A sum in waves of the row's wavelength, of a surface or of all."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        _need_seidel(lines[0], planner)
        shapes = planner.shared(_Shapes)
        share = OF_WAVEFRONT[which] if planner.conventions.seidel == "wavefront" else 1

        def number(context: EvaluationContext, line: Line):
            sums = context.state.kept(_seidel, line.wavelength, shapes)[which]
            surface = line.row.integers[0]
            told = sums[surface - 1] if surface else sums.sum()
            return told / (share * 1e-3 * planner.view.wavelengths[line.wavelength])

        return lambda context: Found(listed([number(context, line) for line in lines], context.state.count))

    return plan


def _need_seidel(line: Line, planner: Planner) -> None:
    """Raises BadRow for a lens that Seidel's theory does not know."""
    if is_bent(planner.lens):
        raise BadRow(line, "is of a straight axis: tilts and decentres bend this one")
    for k, surface in enumerate(planner.lens.surfaces):
        if not is_even(surface):
            raise BadRow(line, f"is of even powers of r: surface {k} has other terms, added sag or a phase")


def _distortion_sum(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """S5 in waves of the surfaces that rows name; where they name none, the real distortion of the largest field."""
    of_lens = [line for line in lines if line.row.integers[0] == 0]
    of_surface = [line for line in lines if line.row.integers[0] != 0]
    parts = [(of_lens, _distortion), (of_surface, _of_seidel(4))]
    planned = [(rows, plan(rows, planner)) for rows, plan in parts if rows]

    def evaluate(context: EvaluationContext) -> Found:
        told = {}
        for rows, found in planned:
            values = found(context).values
            told |= {line.number: values[k] for k, line in enumerate(rows)}
        return Found(listed([told[line.number] for line in lines], context.state.count))

    return evaluate


# -- distortion and field curvature by rays ----------------------------------------------------------------------------


def _distortion(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """100 (h/h₀ - 1) in %, or h - h₀ where the number in the column of Hx is not 0; h₀ by a ray near the axis."""
    fields = [field_of(planner, line.row.integers[0]) for line in lines]
    for line, field in zip(lines, fields, strict=True):
        if not any(field) or not _largest(planner):
            raise BadRow(line, f"names field {line.row.integers[0]}, on the axis, where nothing is distorted")
    close = [tuple(_NEAR_AXIS * part for part in field) for field in fields]
    far, near = (
        np.array([_chief(line, planner, field, line.wavelength) for line, field in zip(lines, at, strict=True)])
        for at in (fields, close)
    )
    x, y = np.array([along(field) for field in fields]).T
    scale = np.array([_length(planner, field) / _length(planner, at) for field, at in zip(fields, close, strict=True)])
    absolute = np.array([bool(line.row.numbers[0]) for line in lines])

    def evaluate(context: EvaluationContext) -> Found:
        hits, ideal = context.hits(far), context.hits(near)
        h, h0 = (part.position[0] * x + part.position[1] * y for part in (hits, ideal))
        h0 = h0 * scale
        return Found(known(hits.valid & ideal.valid, np.where(absolute, (h - h0) / planner.unit, 100 * (h / h0 - 1))))

    return evaluate


def _largest(planner: Planner) -> float:
    fields = planner.lens.fields
    return float(torch.hypot(fields.x, fields.y).max())


def _length(planner: Planner, field: tuple[float, float]) -> float:
    """What the ideal height of a field is proportional to: tan θ, or the height itself."""
    size = _largest(planner) * float(np.hypot(*field))
    return float(np.tan(np.deg2rad(size))) if planner.lens.fields.kind == "angle" else size


def _largest_distortion(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """|distortion|, or the target where that is met."""
    found = _distortion(lines, planner)
    targets = np.array([line.row.target for line in lines])
    return lambda context: Found(np.maximum(np.abs(found(context).values), targets))


def _calibrated_distortion(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """The largest |y - f θ|, in % of f θ or as it is, of fields along y, f by least squares over all of them."""
    if planner.lens.fields.kind != "angle" or not _largest(planner):
        kind = planner.lens.fields.kind.replace("_", " ")
        raise BadRow(lines[0], f"is of angles of the field; this lens has a field of {kind}")
    steps = _FIELDS if planner.conventions.f_theta == "axis left out" else _FIELDS - 1
    parts = [(k + 1) / steps for k in range(steps)]
    theta = np.deg2rad(_largest(planner)) * np.array(parts)
    rays = [np.array([_chief(line, planner, (0.0, part), line.wavelength) for part in parts]) for line in lines]

    def number(context: EvaluationContext, line: Line, asked: np.ndarray):
        hits = context.hits(asked)
        if not hits.valid.all():
            return np.nan
        y = hits.position[1]
        ideal = ((y * theta).sum() / (theta @ theta)) * theta
        off = np.abs((y - ideal) / planner.unit if line.row.numbers[0] else 100 * (y / ideal - 1))
        return off[int(np.argmax(value_of(off)))]

    def evaluate(context: EvaluationContext) -> Found:
        told = [number(context, line, asked) for line, asked in zip(lines, rays, strict=True)]
        return Found(listed(told, context.state.count))

    return evaluate


def _field_curvature(across: bool) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """mm from the image along z to where close rays about the chief ray meet: -Δx/Δ(L/N), in the plane of the field."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        sections = []
        for line in lines:
            x, y = along(line.field)
            sections.append((y, -x) if across else (x, y))
        first, second = (
            np.array(
                [
                    planner.ray(line, pupil=bare(planner, line.field, (side * x, side * y)))
                    for line, (x, y) in zip(lines, sections, strict=True)
                ]
            )
            for side in (_NEAR_CHIEF, -_NEAR_CHIEF)
        )
        x, y = np.array(sections).T

        def evaluate(context: EvaluationContext) -> Found:
            one, other = context.hits(first), context.hits(second)
            apart = (one.position[0] - other.position[0]) * x + (one.position[1] - other.position[1]) * y
            opening = sum(
                (one.direction[k] / one.direction[2] - other.direction[k] / other.direction[2]) * part
                for k, part in enumerate((x, y))
            )
            return Found(known(one.valid & other.valid, -apart / opening))

        return evaluate

    return plan


_SEIDEL = "S{} in waves: of a surface (0: all of them), at a wavelength"
_SEIDEL_CONVENTION = "Seidel's coefficient S{} itself over the wavelength; `seidel` wavefront: S{}/{}"
_CONTRIBUTION = "contribution", "wavelength"
_CLOSE = "without vignetting factors, by rays at a thousandth of the pupil"


def _sum_row(which: int, word: str, share: int) -> Operand:
    return Operand(
        _of_seidel(which - 1),
        f"{word} " + _SEIDEL.format(which),
        convention=_SEIDEL_CONVENTION.format(which, which, share),
        takes=_CONTRIBUTION,
    )


ABERRATIONS = {
    "AXCL": Operand(
        _axial_colour,
        "axial colour: where one wavelength meets the axis less where another does; paraxial, or of the real ray at "
        "the height of the pupil in the column of Hx",
        length=1,
        convention="the first wavelength's less the second's; `colour` second: the other way round",
        takes=("shortest", "longest"),
    ),
    "LACL": Operand(
        _lateral_colour,
        "lateral colour: y of the chief ray of one wavelength less that of another, of the largest field",
        length=1,
        convention="real chief rays; the first wavelength's less the second's; `colour` second: the other way round",
        takes=("shortest", "longest"),
    ),
    "SPHA": _sum_row(1, "spherical aberration", 8),
    "COMA": _sum_row(2, "coma", 2),
    "ASTI": _sum_row(3, "astigmatism", 2),
    "FCUR": _sum_row(4, "field curvature", 4),
    "DIST": Operand(
        _distortion_sum,
        "distortion S5 in waves of a surface at a wavelength; of surface 0 that of the largest field in %, or in "
        "lengths where the number in the column of Hx is not 0",
        convention="S5 itself over the wavelength, `seidel` wavefront: S5/2; of surface 0 by the real chief ray, "
        "against one near the axis",
        takes=_CONTRIBUTION,
    ),
    "DIMX": Operand(
        _largest_distortion,
        "|distortion| of a field (0: the largest) at a wavelength is meant to be below the target: its value in %, or "
        "in lengths where the number in the column of Hx is not 0, or the target itself where that is met",
        convention="of the largest field alone where the field is 0; the ideal height by a chief ray near the axis",
        takes=("field", "wavelength"),
    ),
    "DISC": Operand(
        _calibrated_distortion,
        "largest distortion from y = f θ at a wavelength, in %, or in lengths where the number in the column of Hx is "
        "not 0",
        convention=f"{_FIELDS} fields along y at even steps, the axis left out, f by least squares over them; "
        f"`f_theta` axis included: {_FIELDS - 1} steps and the axis",
        takes=("", "wavelength"),
    ),
    "FCGS": Operand(
        _field_curvature(True),
        "sagittal field curvature of a field Hx Hy: from the image to the focus of close rays",
        length=1,
        convention=_CLOSE,
        takes=("", "wavelength"),
    ),
    "FCGT": Operand(
        _field_curvature(False),
        "tangential field curvature of a field Hx Hy: from the image to the focus of close rays",
        length=1,
        convention=_CLOSE,
        takes=("", "wavelength"),
    ),
}
