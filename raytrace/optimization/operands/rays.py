"""Operands of rays: where they land, in which direction they go, and their angles to surface normals."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import Dual, dot, safe_sqrt, slope_of, value_of
from raytrace.optimization.lens_state import Hits
from raytrace.optimization.operands.operand import Evaluate, EvaluationContext, Line, Operand, Planner, RowValues
from raytrace.system.intersection import normal
from raytrace.system.lens import Lens
from raytrace.system.poses import Gap, direction_in
from raytrace.system.surface import gap_behind


def _transverse(hits: Hits, part: str) -> tuple:
    """x and y of the hits, or of the directions."""
    vector = hits.direction if part == "direction" else hits.position
    return vector[0], vector[1]


def _from_centroid(component: int | None, part: str = "position") -> Callable[[Sequence[Line], Planner], Evaluate]:
    """The distance on the image, or its x or y, from the centroid of the rows' rays of one field, all wavelengths.

    part: "position", or "direction" for cosines. The centroid is weighted like the rows. In a lens that is symmetric
    about its axis it is that of the rays and their mirror images, of which rows leave out half.
    """

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        rays = planner.rays(lines)
        fields, of_field = np.unique([line.field for line in lines], axis=0, return_inverse=True)
        of_field = of_field.reshape(-1)
        weights_of_rows = np.array([max(line.row.weight, 0.0) for line in lines])
        by_field = (of_field == np.arange(len(fields))[:, None]) * weights_of_rows
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

    return plan


def _from_chief(component: int | None, part: str = "position") -> Callable[[Sequence[Line], Planner], Evaluate]:
    """The distance on the image, or its x or y, from the chief ray of the primary wavelength; part: as above."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        rays = planner.rays(lines)
        chief = planner.rays(lines, pupil=(0.0, 0.0), wavelength=planner.primary)

        def evaluate(context: EvaluationContext) -> RowValues:
            hits, centre = context.hits(rays), context.hits(chief)
            pairs = zip(_transverse(hits, part), _transverse(centre, part), strict=True)
            return _distance(hits.valid & centre.valid, *(a - b for a, b in pairs), component)

        return evaluate

    return plan


def _distance(valid: np.ndarray, x, y, component: int | None) -> RowValues:
    x, y = known(valid, x), known(valid, y)
    if component is not None:
        return RowValues((x, y)[component])
    return RowValues(np.sqrt(x * x + y * y), (x, y))


def known(valid: np.ndarray, number):
    """nan where a ray is lost."""
    if isinstance(number, Dual):
        return Dual(np.where(valid, value_of(number), np.nan), number.slope)
    return np.where(valid, number, np.nan)


def _at_surface(number: Callable[[Hits], object]) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """A number of the ray on the surface of the row, in the axes of its vertex, behind it."""

    def on(context: EvaluationContext, rays: dict[int, np.ndarray], surface: int):
        hits = context.hits(rays[surface], surface=surface)
        return known(hits.valid, number(hits))

    return _by_surface(on, lambda surface: (surface,))


def _by_surface(
    number: Callable[[EvaluationContext, dict[int, np.ndarray], int], object], needs: Callable[[int], Sequence[int]]
) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """A number of the ray on the surface of the row; needs: the surfaces behind which the ray is traced for it.

    number: of the context, the rays of all rows of one surface, by the surfaces of `needs`, and the surface.
    """

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        surfaces, rays = np.array([line.row.integers[0] for line in lines]), {}
        for surface in set(surfaces.tolist()):
            here = [line for line in lines if line.row.integers[0] == surface]
            rays[surface] = {at: planner.rays(here, surface=at) for at in needs(surface)}

        def evaluate(context: EvaluationContext) -> RowValues:
            count = context.state.count
            values, slopes = np.full(len(lines), np.nan), np.zeros((count, len(lines)))
            for surface, asked in rays.items():
                numbers = number(context, asked, surface)
                values[surfaces == surface] = value_of(numbers)
                slopes[:, surfaces == surface] = slope_of(numbers, count)
            return RowValues(Dual(values, slopes) if count else values)

        return evaluate

    return plan


def _axial_angle(hits: Hits):
    """Radians between the ray and z."""
    L, M, N = hits.direction
    return np.arctan(np.sqrt(L * L + M * M) / np.abs(N))


def _radius(hits: Hits):
    x, y, _ = hits.position
    return np.sqrt(x * x + y * y)


_WAVE = "", "wavelength"


def _family(names: str, plan: Callable, part: str, text: str, length: int) -> dict[str, Operand]:
    """Operands of a distance, its x and its y."""
    texts = text, "its x", "its y"
    return {
        name: Operand(plan(component, part), words, length, takes=_WAVE)
        for name, component, words in zip(names.split(), (None, 0, 1), texts, strict=True)
    }


def _on_surface(name: str, number: Callable[[Hits], object], text: str, convention: str = "") -> dict[str, Operand]:
    length = int(name.startswith("RE") and name[-1] in "XYZR")
    takes = "place" if length else "surface", "wavelength"
    return {name: Operand(_at_surface(number), text, length, convention, takes)}


_COSINES = "change of the cosines to x and y behind the lens from the"

RAYS = {
    **_family(
        "TRAC TRCX TRCY",
        _from_centroid,
        "position",
        "distance on the image from the centroid of its field, Hx Hy Px Py",
        1,
    ),
    **_family(
        "TRAR TRAX TRAY",
        _from_chief,
        "position",
        "distance on the image from the chief ray of the primary wavelength",
        1,
    ),
    **_family("ANAC ANCX ANCY", _from_centroid, "direction", f"{_COSINES} centroid of its field, Hx Hy Px Py", 0),
    **_family("ANAR ANAX ANAY", _from_chief, "direction", f"{_COSINES} chief ray of the primary wavelength", 0),
    **_on_surface("REAX", lambda hits: hits.position[0], "x of a ray on a surface"),
    **_on_surface("REAY", lambda hits: hits.position[1], "y of a ray on a surface"),
    **_on_surface("REAZ", lambda hits: hits.position[2], "z of a ray on a surface"),
    **_on_surface("REAR", _radius, "distance of a ray on a surface from its axis"),
    **_on_surface("REAA", lambda hits: hits.direction[0], "cosine of a ray behind a surface to x"),
    **_on_surface("REAB", lambda hits: hits.direction[1], "cosine of a ray behind a surface to y"),
    **_on_surface("REAC", lambda hits: hits.direction[2], "cosine of a ray behind a surface to z"),
    **_on_surface(
        "RANG",
        _axial_angle,
        "angle of a ray behind a surface to z, radians",
        "to the axis of the surface, from 0 to π/2: also where the ray runs towards -z",
    ),
}


def _to_normal(angle: Callable[[Tensor, Tensor], Tensor], *, behind: bool) -> Callable:
    """A function of |cosine| and sine of the angle between normal and ray, in front of the surface or behind it."""

    def number(context: EvaluationContext, rays: dict[int, np.ndarray], surface: int):
        here = context.hits(rays[surface], surface=surface)
        ray = here if behind else context.hits(rays[surface - 1], surface=surface - 1)

        def of(lens: Lens, *numbers: Tensor) -> Tensor:
            position, direction = numbers[:3], list(numbers[3:])
            if not behind:  # from the axes of the surface before, or of a launched ray
                gap = gap_behind(lens.surfaces[surface - 1]) if surface > 1 else None
                for pose in (gap.pose if isinstance(gap, Gap) else None, lens.surfaces[surface].before):
                    direction = direction if pose is None else direction_in(pose, direction)
            n, _ = normal(lens.surfaces[surface], position)
            across = [n[i - 2] * direction[i - 1] - n[i - 1] * direction[i - 2] for i in range(3)]
            length = torch.sqrt(dot(n, n))
            return angle(dot(n, direction).abs() / length, safe_sqrt(dot(across, across)) / length)

        return known(here.valid & ray.valid, context.state.each_through_torch(of, (*here.position, *ray.direction)))

    return _by_surface(number, lambda surface: (surface,) if behind else (surface - 1, surface))


def _degrees(cosine: Tensor, sine: Tensor) -> Tensor:
    return torch.rad2deg(torch.atan2(sine, cosine))


def _cosine(cosine: Tensor, sine: Tensor) -> Tensor:
    return cosine


_INCIDENCE = {
    "RAID": (_degrees, False, "angle of incidence on a surface, degrees, never negative"),
    "RAIN": (_cosine, False, "cosine of the angle of incidence on a surface"),
    "RAED": (_degrees, True, "angle behind a surface to its normal, degrees, never negative"),
    "RAEN": (_cosine, True, "cosine of the angle behind a surface to its normal"),
}
INCIDENCE = {
    name: Operand(_to_normal(angle, behind=behind), text, takes=("met surface", "wavelength"))
    for name, (angle, behind, text) in _INCIDENCE.items()
}
