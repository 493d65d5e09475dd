"""Operands of incidence: the angle of a ray, in front of a surface or behind it, to the normal where they meet.

Operands of rays: where they land, and in which direction they go.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.dual import Dual, value_of
from raytrace.maths.numerics import dot, safe_sqrt
from raytrace.optimization.context import Evaluate, EvaluationContext, Found, Line, Operand, Planner
from raytrace.optimization.ray_bundle import Hits
from raytrace.system.intersection import normal
from raytrace.system.lens import Lens
from raytrace.system.poses import Gap, direction_in
from raytrace.system.surface import gap_behind


def from_centroid(component: int | None, part: str = "position") -> Callable[[Sequence[Line], Planner], Evaluate]:
    """The distance on the image, or its x or y, from the centroid of the rows' rays of one field, all wavelengths.

    part: "position", or "direction": cosines instead of places.

    The centroid is weighted as the rows are. In a lens that is symmetric about its axis it is that of the rays and
    their mirror images, of which rows leave out half.
    """

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        rays, (mean, of_field) = planner.rays(lines), _means(lines)
        on_y = np.array([planner.view.is_symmetric and line.field[0] == 0 for line in lines])
        on_axis = on_y & np.array([line.field[1] == 0 for line in lines])

        def evaluate(context: EvaluationContext) -> Found:
            hits = context.hits(rays)
            weights = mean * hits.valid
            weights = weights / np.maximum(weights.sum(-1, keepdims=True), 1e-300)
            x, y = (getattr(hits, part)[k] for k in range(2))
            if not on_y.all():
                x = x - np.where(on_y, 0.0, 1.0) * (weights @ x)[of_field]
            if not on_axis.all():
                y = y - np.where(on_axis, 0.0, 1.0) * (weights @ y)[of_field]
            return _told(hits.valid, x, y, component)

        return evaluate

    return plan


def from_chief(component: int | None, part: str = "position") -> Callable[[Sequence[Line], Planner], Evaluate]:
    """The distance on the image, or its x or y, from the chief ray of the primary wavelength; part: as above."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        rays = planner.rays(lines)
        chief = planner.rays(lines, pupil=(0.0, 0.0), wavelength=planner.primary)

        def evaluate(context: EvaluationContext) -> Found:
            hits, centre = context.hits(rays), context.hits(chief)
            x, y = (getattr(hits, part)[k] - getattr(centre, part)[k] for k in range(2))
            return _told(hits.valid & centre.valid, x, y, component)

        return evaluate

    return plan


def _means(lines: Sequence[Line]) -> tuple[np.ndarray, np.ndarray]:
    """(F, R): the weights of the rows of every field; and the field (R,) of each row."""
    fields, of_field = np.unique([line.field for line in lines], axis=0, return_inverse=True)
    weights = np.array([max(line.row.weight, 0.0) for line in lines])
    return (of_field.reshape(-1) == np.arange(len(fields))[:, None]) * weights, of_field.reshape(-1)


def _told(valid: np.ndarray, x, y, component: int | None) -> Found:
    x, y = known(valid, x), known(valid, y)
    if component is not None:
        return Found((x, y)[component])
    return Found(np.sqrt(x * x + y * y), (x, y))


def known(valid: np.ndarray, number):
    """nan where a ray is lost."""
    if isinstance(number, Dual):
        return Dual(np.where(valid, value_of(number), np.nan), number.slope)
    return np.where(valid, number, np.nan)


def at_surface(tell: Callable[[Hits], object]) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """A number of the ray on the surface that the row names, in the axes of its vertex, behind it."""

    def number(context: EvaluationContext, rays: dict[int, np.ndarray], surface: int):
        hits = context.hits(rays[surface], surface=surface)
        return known(hits.valid, tell(hits))

    return by_surface(number, lambda surface: (surface,))


def by_surface(
    tell: Callable[[EvaluationContext, dict[int, np.ndarray], int], object], needs: Callable[[int], Sequence[int]]
) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """A number of the ray on the surface that the row names; needs: the surfaces on which it is looked at for that.

    tell: of the state, the rays of all rows on one surface, by where they are looked at, and the surface.
    """

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        surfaces, rays = np.array([line.row.integers[0] for line in lines]), {}
        for surface in set(surfaces.tolist()):
            here = [line for line in lines if line.row.integers[0] == surface]
            rays[surface] = {at: planner.rays(here, surface=at) for at in needs(surface)}

        def evaluate(context: EvaluationContext) -> Found:
            found = np.full(len(lines), np.nan)
            slopes = np.zeros((context.state.count, len(lines)))
            for surface, asked in rays.items():
                number = tell(context, asked, surface)
                found[surfaces == surface] = value_of(number)
                if isinstance(number, Dual):
                    slopes[:, surfaces == surface] = number.full()
            return Found(Dual(found, slopes) if context.state.count else found)

        return evaluate

    return plan


def _axial_angle(hits):
    """Radians between the ray and z."""
    L, M, N = hits.direction
    return np.arctan(np.sqrt(L * L + M * M) / np.abs(N))


def _radius(hits):
    x, y, _ = hits.position
    return np.sqrt(x * x + y * y)


_WAVE = "", "wavelength"

RAYS = {
    "TRAC": Operand(
        from_centroid(None), "distance on the image from the centroid of its field, Hx Hy Px Py", length=1, takes=_WAVE
    ),
    "TRCX": Operand(from_centroid(0), "its x", length=1, takes=_WAVE),
    "TRCY": Operand(from_centroid(1), "its y", length=1, takes=_WAVE),
    "TRAR": Operand(
        from_chief(None), "distance on the image from the chief ray of the primary wavelength", length=1, takes=_WAVE
    ),
    "ANAC": Operand(
        from_centroid(None, "direction"),
        "change of the cosines to x and y behind the lens from the centroid of its field, Hx Hy Px Py",
        takes=_WAVE,
    ),
    "ANCX": Operand(from_centroid(0, "direction"), "its x", takes=_WAVE),
    "ANCY": Operand(from_centroid(1, "direction"), "its y", takes=_WAVE),
    "ANAR": Operand(
        from_chief(None, "direction"),
        "change of the cosines to x and y behind the lens from the chief ray of the primary wavelength",
        takes=_WAVE,
    ),
    "ANAX": Operand(from_chief(0, "direction"), "its x", takes=_WAVE),
    "ANAY": Operand(from_chief(1, "direction"), "its y", takes=_WAVE),
    "TRAX": Operand(from_chief(0), "its x", length=1, takes=_WAVE),
    "TRAY": Operand(from_chief(1), "its y", length=1, takes=_WAVE),
    "REAX": Operand(
        at_surface(lambda hits: hits.position[0]), "x of a ray on a surface", length=1, takes=("place", "wavelength")
    ),
    "REAY": Operand(
        at_surface(lambda hits: hits.position[1]), "y of a ray on a surface", length=1, takes=("place", "wavelength")
    ),
    "REAZ": Operand(
        at_surface(lambda hits: hits.position[2]), "z of a ray on a surface", length=1, takes=("place", "wavelength")
    ),
    "REAR": Operand(
        at_surface(_radius), "distance of a ray on a surface from its axis", length=1, takes=("place", "wavelength")
    ),
    "REAA": Operand(
        at_surface(lambda hits: hits.direction[0]),
        "cosine of a ray behind a surface to x",
        takes=("surface", "wavelength"),
    ),
    "REAB": Operand(
        at_surface(lambda hits: hits.direction[1]),
        "cosine of a ray behind a surface to y",
        takes=("surface", "wavelength"),
    ),
    "REAC": Operand(
        at_surface(lambda hits: hits.direction[2]),
        "cosine of a ray behind a surface to z",
        takes=("surface", "wavelength"),
    ),
    "RANG": Operand(
        at_surface(_axial_angle),
        "angle of a ray behind a surface to z, radians",
        convention="to the axis of the surface, from 0 to π/2: also where the ray runs towards -z",
        takes=("surface", "wavelength"),
    ),
}


def _to_normal(tell: Callable[[Tensor, Tensor], Tensor], *, behind: bool) -> Callable:
    """A number of |cosine| and sine of the angle to the normal, of the ray in front of the surface or behind it."""

    def number(context: EvaluationContext, rays: dict[int, np.ndarray], surface: int):
        here = context.hits(rays[surface], surface=surface)
        ray = here if behind else context.hits(rays[surface - 1], surface=surface - 1)

        def of(lens: Lens, *numbers: Tensor) -> Tensor:
            position, direction = numbers[:3], list(numbers[3:])
            if not behind:
                direction = _told_at(lens, surface, direction)
            n, _ = normal(lens.surfaces[surface], position)
            across = [n[i - 2] * direction[i - 1] - n[i - 1] * direction[i - 2] for i in range(3)]
            length = torch.sqrt(dot(n, n))
            return tell(dot(n, direction).abs() / length, safe_sqrt(dot(across, across)) / length)

        found = context.state.each_through_torch(of, (*here.position, *ray.direction))
        return known(here.valid & ray.valid, found)

    return by_surface(number, lambda surface: (surface,) if behind else (surface - 1, surface))


def _told_at(lens: Lens, surface: int, direction: list[Tensor]) -> list[Tensor]:
    """A direction behind the surface before, or of a launched ray, in the axes of a surface."""
    gap = gap_behind(lens.surfaces[surface - 1]) if surface > 1 else None
    for pose in (gap.pose if isinstance(gap, Gap) else None, lens.surfaces[surface].before):
        if pose is not None:
            direction = direction_in(pose, direction)
    return direction


def _degrees(cosine: Tensor, sine: Tensor) -> Tensor:
    return torch.rad2deg(torch.atan2(sine, cosine))


def _cosine(cosine: Tensor, sine: Tensor) -> Tensor:
    return cosine


_TAKES = "met surface", "wavelength"

INCIDENCE = {
    "RAID": Operand(
        _to_normal(_degrees, behind=False), "angle of incidence on a surface, degrees, never negative", takes=_TAKES
    ),
    "RAIN": Operand(_to_normal(_cosine, behind=False), "cosine of the angle of incidence on a surface", takes=_TAKES),
    "RAED": Operand(
        _to_normal(_degrees, behind=True),
        "angle behind a surface to its normal, degrees, never negative",
        takes=_TAKES,
    ),
    "RAEN": Operand(
        _to_normal(_cosine, behind=True), "cosine of the angle behind a surface to its normal", takes=_TAKES
    ),
}
