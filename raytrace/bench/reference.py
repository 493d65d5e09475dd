"""A textbook ray tracer in mpmath with 50 digits, one ray at a time: the reference of all others.

It shares only the numbers of the lens with them: conics by the quadratic formula, aspheres by Newton's method,
refraction by unit normals and cosines.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mpmath import mp, mpf, sqrt

_DIGITS = 50
_STEP = "1e-25"  # of the differences that give gradients: good to about 25 digits


@dataclass(frozen=True)
class ReferenceSurface:
    """A surface of exact numbers, mm. coefficients: of r², r⁴, …; index: of the medium behind it."""

    curvature: mpf | float = 0.0
    conic: mpf | float = 0.0
    coefficients: Sequence[float] = ()
    thickness: mpf | float = 0.0
    index: mpf | float = 1.0
    is_mirror: bool = False

    def sag(self, u: mpf) -> tuple[mpf, mpf]:
        """Sag and its derivative by u = r²."""
        c = mpf(self.curvature)
        w = sqrt(1 - (1 + mpf(self.conic)) * c * c * u)
        sag, slope = c * u / (1 + w), c / (2 * w)
        for power, a in enumerate(map(mpf, self.coefficients), 1):
            sag += a * u**power
            slope += power * a * u ** (power - 1)
        return sag, slope

    def distance(self, p: Sequence[mpf], d: Sequence[mpf]) -> mpf:
        """Path along the ray to the surface."""
        c, shape = mpf(self.curvature), 1 + mpf(self.conic)
        t = to_plane = -p[2] / d[2]
        if c != 0:
            A = c * (d[0] ** 2 + d[1] ** 2 + shape * d[2] ** 2)
            B = c * (p[0] * d[0] + p[1] * d[1] + shape * p[2] * d[2]) - d[2]
            C = c * (p[0] ** 2 + p[1] ** 2 + shape * p[2] ** 2) - 2 * p[2]
            root = sqrt(B * B - A * C)
            roots = [-C / (2 * B)] if A == 0 else [] if root.imag else [(root - B) / A, (-root - B) / A]
            # On the sheet of the vertex, and there the crossing next to the vertex plane.
            on_sheet = [t for t in roots if A == 0 or 1 - shape * c * (p[2] + t * d[2]) > 0]
            if not on_sheet:
                raise ValueError("the reference ray misses a surface")
            t = min(on_sheet, key=lambda t: abs(t - to_plane))
        for _ in range(100 if self.coefficients else 0):
            x, y, z = (a + t * b for a, b in zip(p, d, strict=True))
            sag, slope = self.sag(x * x + y * y)
            step = (z - sag) / (d[2] - 2 * slope * (x * d[0] + y * d[1]))
            t -= step
            if abs(step) < mpf(10) ** (5 - _DIGITS):
                return t
        if self.coefficients:
            raise ValueError("the reference found no crossing with an asphere")
        return t


@dataclass(frozen=True)
class ReferenceRay:
    """(x, y, z) mm and (L, M, N) in the frame of the last surface, and the optical path in mm."""

    position: tuple[mpf, mpf, mpf]
    direction: tuple[mpf, mpf, mpf]
    path: mpf


def trace_reference(
    surfaces: Sequence[ReferenceSurface], index: float, position: Sequence[float], direction: Sequence[float]
) -> ReferenceRay:
    """Trace one ray from the frame of the first surface to the last. Raises ValueError if it fails.

    index: of the medium in front; position: (x, y, z) mm; direction: (L, M, N) of any length.
    """
    with mp.workdps(_DIGITS):
        p, d, n, path = [mpf(x) for x in position], _unit([mpf(x) for x in direction]), mpf(index), mpf(0)
        for number, surface in enumerate(surfaces):
            t = surface.distance(p, d)
            p = [a + t * b for a, b in zip(p, d, strict=True)]
            path += n * t
            slope = surface.sag(p[0] ** 2 + p[1] ** 2)[1]
            normal = _unit([-2 * slope * p[0], -2 * slope * p[1], mpf(1)])
            cosine = sum(a * b for a, b in zip(normal, d, strict=True))
            ratio = mpf(1) if surface.is_mirror else n / mpf(surface.index)
            along = -cosine
            if not surface.is_mirror:
                n, sine_squared = mpf(surface.index), ratio**2 * (1 - cosine**2)
                if sine_squared > 1:
                    raise ValueError("the reference ray is totally reflected")
                along = sqrt(1 - sine_squared) * (1 if cosine > 0 else -1)
            d = [ratio * a + (along - ratio * cosine) * b for a, b in zip(d, normal, strict=True)]
            if number < len(surfaces) - 1:
                p[2] -= mpf(surface.thickness)
        return ReferenceRay(tuple(p), tuple(d), path)


def _unit(vector: Sequence[mpf]) -> list[mpf]:
    length = sqrt(sum(a * a for a in vector))
    return [a / length for a in vector]


def spot_gradient(
    surfaces: Sequence[ReferenceSurface], index: float, rays: Sequence[tuple], variables: Sequence[tuple[int, str]]
) -> list[mpf]:
    """Derivatives of the mean squared distance from the centroid, mm², by (surface, "curvature" or "thickness").

    rays: pairs of position and direction, as for `trace_reference`.
    """

    def merit(surfaces: Sequence[ReferenceSurface]) -> mpf:
        x, y, _ = zip(*(trace_reference(surfaces, index, *ray).position for ray in rays), strict=True)
        means = ((values, sum(values) / len(rays)) for values in (x, y))
        return sum((value - mean) ** 2 for values, mean in means for value in values) / len(rays)

    with mp.workdps(_DIGITS):
        step, gradient = mpf(_STEP), []
        here = merit(surfaces)
        for number, name in variables:
            moved = list(surfaces)
            moved[number] = replace(moved[number], **{name: mpf(getattr(moved[number], name)) + step})
            gradient.append((merit(moved) - here) / step)
        return gradient
