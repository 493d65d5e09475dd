"""Lost rays: how far each misses the surface that it is lost at, with derivatives, so that a descent brings it back.

A ray that meets no point of a conic misses it by the negative discriminant of its crossing; one that is totally
reflected has the sine of its refraction beyond 1:

    A t² + 2 B t + C = 0,  missed by A C - B²;    (n/n')² sin² I - 1

Both are without a unit and 0 where the ray just passes. At any other surface it is how far the ray stands outside the
vertex sphere, c² r².
"""

from collections.abc import Sequence

import numpy as np

from raytrace.maths.dual import Dual, slope_of, value_of
from raytrace.merit.bundle import Bundle, Ray
from raytrace.merit.merit import Evaluation
from raytrace.merit.moment import Moment
from raytrace.system.surface import is_posed

#: How much a miss of 1 weighs beside the loss itself, and how far inside a ray is brought back.
STEEP, MARGIN = 5.0, 0.1


class Recovery:
    """What is charged for the lost rays of the rows of a merit function."""

    def __init__(self, evaluation: Evaluation):
        self.evaluation = evaluation
        self.planners = {line.number - 1: (planner, line) for planner, lines, _ in evaluation.groups for line in lines}
        self._bundles: dict = {}

    def excess(self, x: np.ndarray, rows: Sequence[int], *, derivatives: bool) -> tuple[np.ndarray, ...]:
        """How far the rays of rows (K,), from 0, miss: (K,), by variables (K, n), and how many surfaces are left.

        0 of a ray that runs along the surface, as behind a break of 90°: there is no way back that derivatives know.
        """
        variables = Dual(np.asarray(x, float), np.eye(len(x))) if derivatives else np.asarray(x, float)
        missed, slopes, behind = np.zeros(len(rows)), np.zeros((len(rows), len(x))), np.zeros(len(rows))
        for view, wanted in self._by_view(rows).items():
            moment = view.moment(variables)
            with np.errstate(all="ignore"):
                found = [*self._missed(view, moment, wanted)]
            for place, number, left in found:
                behind[place], slope = left, slope_of(number, len(x))
                if np.isfinite(value_of(number)) and np.isfinite(slope).all():  # else the ray runs along the surface
                    missed[place], slopes[place] = float(value_of(number)), slope
        return missed, slopes, behind

    def _by_view(self, rows: Sequence[int]) -> dict:
        """For every configuration: the places in `rows` and their rays."""
        found: dict = {}
        for place, row in enumerate(rows):
            planner, line = self.planners[row]
            ray = Ray(line.wavelength, line.field, line.pupil)
            if any(ray in bundle.rays for bundle in planner.bundles.values()):  # else a row of no ray
                found.setdefault(planner.view, []).append((place, ray))
        return found

    def _missed(self, view, moment: Moment, wanted: list[tuple[int, Ray]]):
        """(place, how far it misses, surfaces left) of every ray that is lost on its way to the image."""
        rays = tuple(dict.fromkeys(ray for _, ray in wanted))
        ended, traced = self._ends(view, moment, rays), {}
        for place, ray in wanted:
            surface = ended.get(ray)
            if surface is None or is_posed(view.lens.surfaces[surface]):
                continue
            before = self._before(view, moment, rays, ray, surface, traced)
            yield place, _miss(moment, surface, ray.wavelength, *before), len(view.lens.surfaces) - 1 - surface

    def _ends(self, view, moment: Moment, rays: tuple[Ray, ...]) -> dict[Ray, int]:
        """The surface at which each ray is lost."""
        ended: dict[Ray, int] = {}
        plain = view.moment(value_of(moment.variables))
        for k in range(1, len(view.lens.surfaces)):
            bundle, numbers = self._bundle(view, k, rays)
            valid = bundle.hits(plain).at(numbers).valid
            ended |= {ray: k for ray, there in zip(rays, valid, strict=True) if not there and ray not in ended}
            if len(ended) == len(rays):
                break
        return ended

    def _bundle(self, view, last: int, rays: tuple[Ray, ...]) -> tuple[Bundle, np.ndarray]:
        key = id(view), last, rays
        if key not in self._bundles:
            bundle = Bundle(view, last)
            self._bundles[key] = bundle, np.array([bundle.ask(*ray) for ray in rays])
        return self._bundles[key]

    def _before(self, view, moment: Moment, rays: tuple[Ray, ...], ray: Ray, surface: int, traced: dict):
        """Position and direction of a ray before a surface, in the axes of its vertex; traced: all rays by surface."""
        number = rays.index(ray)
        if surface == 1:
            bundle, numbers = self._bundle(view, 1, rays)
            position, direction, *_ = bundle.launched(moment)
            at = int(bundle._places[0][numbers[number]])
            flat = [part.reshape(-1)[at] for part in (*position, *direction)]
            return flat[:3], flat[3:]
        bundle, numbers = self._bundle(view, surface - 1, rays)
        if surface not in traced:
            traced[surface] = bundle.hits(moment)
        hit = traced[surface].at(numbers[number : number + 1])
        x, y, z = (hit.position[k][0] for k in range(3))
        return (x, y, z - moment.thickness[surface - 1]), tuple(hit.direction[k][0] for k in range(3))


def _miss(moment: Moment, surface: int, wavelength: int, position, direction):
    """How far a ray misses a surface, or passes its critical angle."""
    (x, y, z), (L, M, N) = position, direction
    c, k = moment.curvature[surface], moment.number(surface, "conic") if _has_conic(moment, surface) else 0.0
    A = c * (1 + k * N * N)
    B = c * (x * L + y * M + (1 + k) * z * N) - N
    C = c * (x * x + y * y + (1 + k) * z * z) - 2 * z
    inside = B * B - A * C
    if value_of(inside) < 0:
        return -inside
    root = np.sqrt(inside)
    t = C / (-B + np.where(value_of(B) < 0, 1.0, -1.0) * root)
    x, y, z = x + t * L, y + t * M, z + t * N
    steep = (c * x) ** 2 + (c * y) ** 2 + (c * (1 + k) * z - 1) ** 2
    n = np.abs(moment.index(wavelength))
    beyond = (value_of(n[surface - 1]) / value_of(n[surface])) ** 2 * (1 - inside / steep) - 1
    return beyond if value_of(beyond) > 0 else c * c * (x * x + y * y)


def _has_conic(moment: Moment, surface: int) -> bool:
    return (surface, "conic") in moment.numbers or moment.lens.surfaces[surface].conic is not None
