"""Operands of rays: landing points, directions, and angles to surface normals."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import Dual, Number, dot, safe_sqrt, slope_of, value_of
from raytrace.optimization.lens_state import Hits
from raytrace.optimization.operands.operand import (
    Evaluate,
    EvaluationContext,
    Line,
    Operand,
    Plan,
    Planner,
    RowValues,
    known,
)
from raytrace.system.intersection import normal
from raytrace.system.lens import Lens
from raytrace.system.poses import Gap, direction_in
from raytrace.system.surface import gap_behind


def _from_centroid(lines: Sequence[Line], planner: Planner, *, component: int | None, part: str) -> Evaluate:
    """The distance on the image, or its x or y, from the centroid of the rows' rays of one field, all wavelengths.

    part: "position", or "direction" for cosines. The centroid is weighted like the rows. In a lens that is symmetric
    about its axis it is that of the rays and their mirror images, of which rows leave out half.
    """
    rays = planner.rays(lines)
    fields, of_field = np.unique([line.field for line in lines], axis=0, return_inverse=True)
    of_field = of_field.reshape(-1)
    by_field = (of_field == np.arange(len(fields))[:, None]) * np.array([max(line.row.weight, 0.0) for line in lines])
    on_y = np.array([planner.view.is_symmetric and line.field[0] == 0 for line in lines])
    on_axis = on_y & np.array([line.field[1] == 0 for line in lines])

    def evaluate(context: EvaluationContext) -> RowValues:
        hits = context.hits(rays)
        weights = by_field * hits.valid
        weights = weights / np.maximum(weights.sum(-1, keepdims=True), 1e-300)
        x, y = _transverse(hits, part)
        if not on_y.all():
            x = x - np.where(on_y, 0.0, 1.0) * (weights @ x)[of_field]
        if not on_axis.all():
            y = y - np.where(on_axis, 0.0, 1.0) * (weights @ y)[of_field]
        return _distance(hits.valid, x, y, component)

    return evaluate


def _from_chief(lines: Sequence[Line], planner: Planner, *, component: int | None, part: str) -> Evaluate:
    """The distance on the image, or its x or y, from the chief ray of the primary wavelength; part: as above."""
    rays = planner.rays(lines)
    chief = planner.rays(lines, pupil=(0.0, 0.0), wavelength=planner.primary)

    def evaluate(context: EvaluationContext) -> RowValues:
        hits, centre = context.hits(rays), context.hits(chief)
        (x, y), (x_chief, y_chief) = _transverse(hits, part), _transverse(centre, part)
        return _distance(hits.valid & centre.valid, x - x_chief, y - y_chief, component)

    return evaluate


def _transverse(hits: Hits, part: str) -> tuple[Number, Number]:
    """x and y of the hits, or of the directions."""
    vector = hits.direction if part == "direction" else hits.position
    return vector[0], vector[1]


def _distance(valid: np.ndarray, x: Number, y: Number, component: int | None) -> RowValues:
    x, y = known(valid, x), known(valid, y)
    return RowValues(np.sqrt(x * x + y * y), (x, y)) if component is None else RowValues((x, y)[component])


# -- on the surface of the row -----------------------------------------------------------------------------------------


def _by_surface(
    lines: Sequence[Line],
    planner: Planner,
    *,
    number: Callable[..., tuple[np.ndarray, Number]],
    also_before: bool = False,
) -> Evaluate:
    """A number of the ray on the surface of the row, in the axes of its vertex.

    number: validity and values of the context, the hits and number of one surface, and the rays behind the surface
    before it (also_before) by their numbers.
    """
    surfaces = np.array([line.row.integers[0] for line in lines])
    rays: dict[int, list[np.ndarray]] = {}
    for surface in set(surfaces.tolist()):
        here = [line for line in lines if line.row.integers[0] == surface]
        rays[surface] = [planner.rays(here, surface=k) for k in range(surface - also_before, surface + 1)]

    def evaluate(context: EvaluationContext) -> RowValues:
        count = context.state.count
        values, slopes = np.full(len(lines), np.nan), np.zeros((count, len(lines)))
        for surface, (*before, ray) in rays.items():
            numbers = known(*number(context, context.hits(ray, surface=surface), surface, *before))
            values[surfaces == surface] = value_of(numbers)
            slopes[:, surfaces == surface] = slope_of(numbers, count)
        return RowValues(Dual(values, slopes) if count else values)

    return evaluate


def _at_surface(number: Callable[[Hits], Number]) -> Plan:
    """A number of the ray behind the surface of the row."""

    def valid_number(context: EvaluationContext, hits: Hits, surface: int) -> tuple[np.ndarray, Number]:
        return hits.valid, number(hits)

    return partial(_by_surface, number=valid_number)


def _radius(hits: Hits) -> Number:
    x, y, _ = hits.position
    return np.sqrt(x * x + y * y)


def _axial_angle(hits: Hits) -> Number:
    """Radians between the ray and z."""
    L, M, N = hits.direction
    return np.arctan(np.sqrt(L * L + M * M) / np.abs(N))


def _to_normal(angle: Callable[[Tensor, Tensor], Tensor], *, behind: bool) -> Plan:
    """A function of |cosine| and sine of the angle between normal and ray, in front of the surface or behind it."""

    def number(context: EvaluationContext, here: Hits, surface: int, *before: np.ndarray) -> tuple[np.ndarray, Number]:
        ray = here if behind else context.hits(*before, surface=surface - 1)

        def of(lens: Lens, *numbers: Tensor) -> Tensor:
            position: Sequence[Tensor] = numbers[:3]
            direction: Sequence[Tensor] = numbers[3:]
            if not behind:  # from the axes of the surface before, or of a launched ray
                gap = gap_behind(lens.surfaces[surface - 1]) if surface > 1 else None
                for pose in (gap.pose if isinstance(gap, Gap) else None, lens.surfaces[surface].before):
                    direction = direction if pose is None else direction_in(pose, direction)
            n, _ = normal(lens.surfaces[surface], position)
            across = [n[i - 2] * direction[i - 1] - n[i - 1] * direction[i - 2] for i in range(3)]
            length = torch.sqrt(dot(n, n))
            return angle(dot(n, direction).abs() / length, safe_sqrt(dot(across, across)) / length)

        return here.valid & ray.valid, context.state.each_through_torch(of, (*here.position, *ray.direction))

    return partial(_by_surface, number=number, also_before=not behind)


def _degrees(cosine: Tensor, sine: Tensor) -> Tensor:
    return torch.rad2deg(torch.atan2(sine, cosine))


def _cosine(cosine: Tensor, sine: Tensor) -> Tensor:
    return cosine


_COSINES = "change of the cosines to x and y behind the lens from the"
_CENTROID, _CHIEF = "centroid of its field, Hx Hy Px Py", "chief ray of the primary wavelength"
_TO_AXIS = "to the axis of the surface, from 0 to π/2: also where the ray runs towards -z"

RAYS = {
    **{
        name: Operand(partial(plan, component=component, part=part), words, length, takes=("", "wavelength"))
        for names, plan, part, text, length in (
            ("TRAC TRCX TRCY", _from_centroid, "position", f"distance on the image from the {_CENTROID}", 1),
            ("TRAR TRAX TRAY", _from_chief, "position", f"distance on the image from the {_CHIEF}", 1),
            ("ANAC ANCX ANCY", _from_centroid, "direction", f"{_COSINES} {_CENTROID}", 0),
            ("ANAR ANAX ANAY", _from_chief, "direction", f"{_COSINES} {_CHIEF}", 0),
        )
        for name, component, words in zip(names.split(), (None, 0, 1), (text, "its x", "its y"), strict=True)
    },
    **{
        name: Operand(_at_surface(number), text, 1, takes=("place", "wavelength"))
        for name, number, text in (
            ("REAX", lambda hits: hits.position[0], "x of a ray on a surface"),
            ("REAY", lambda hits: hits.position[1], "y of a ray on a surface"),
            ("REAZ", lambda hits: hits.position[2], "z of a ray on a surface"),
            ("REAR", _radius, "distance of a ray on a surface from its axis"),
        )
    },
    **{
        name: Operand(_at_surface(number), text, convention=convention, takes=("surface", "wavelength"))
        for name, number, text, convention in (
            ("REAA", lambda hits: hits.direction[0], "cosine of a ray behind a surface to x", ""),
            ("REAB", lambda hits: hits.direction[1], "cosine of a ray behind a surface to y", ""),
            ("REAC", lambda hits: hits.direction[2], "cosine of a ray behind a surface to z", ""),
            ("RANG", _axial_angle, "angle of a ray behind a surface to z, radians", _TO_AXIS),
        )
    },
}

INCIDENCE = {
    name: Operand(_to_normal(angle, behind=behind), text, takes=("met surface", "wavelength"))
    for name, angle, behind, text in (
        ("RAID", _degrees, False, "angle of incidence on a surface, degrees, never negative"),
        ("RAIN", _cosine, False, "cosine of the angle of incidence on a surface"),
        ("RAED", _degrees, True, "angle behind a surface to its normal, degrees, never negative"),
        ("RAEN", _cosine, True, "cosine of the angle behind a surface to its normal"),
    )
}
