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
    """A surface of exact numbers, mm.

    coefficients: of r², r⁴, …; index: of the medium behind it.
    """

    curvature: mpf | float = 0.0
    conic: mpf | float = 0.0
    coefficients: Sequence[float] = ()
    thickness: mpf | float = 0.0
    index: mpf | float = 1.0
    is_mirror: bool = False


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
        p = [mpf(component) for component in position]
        d = [mpf(component) for component in direction]
        length = sqrt(_dot(d, d))
        d = [component / length for component in d]
        n, path = mpf(index), mpf(0)
        for number, surface in enumerate(surfaces):
            t = _distance(surface, p, d)
            p = [a + t * b for a, b in zip(p, d, strict=True)]
            path += n * t
            d = _bend(surface, p, d, n)
            n = n if surface.is_mirror else mpf(surface.index)
            if number < len(surfaces) - 1:
                p[2] -= mpf(surface.thickness)
        return ReferenceRay(tuple(p), tuple(d), path)


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


def _dot(a: Sequence[mpf], b: Sequence[mpf]) -> mpf:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _distance(surface: ReferenceSurface, p: list[mpf], d: list[mpf]) -> mpf:
    """Path along the ray to the surface."""
    t = _distance_to_conic(surface, p, d)
    if not surface.coefficients:
        return t
    for _ in range(100):
        x, y, z = (a + t * b for a, b in zip(p, d, strict=True))
        sag, slope = _sag(surface, x * x + y * y)
        step = (z - sag) / (d[2] - 2 * slope * (x * d[0] + y * d[1]))
        t -= step
        if abs(step) < mpf(10) ** (5 - _DIGITS):
            return t
    raise ValueError("the reference found no crossing with an asphere")


def _distance_to_conic(surface: ReferenceSurface, p: list[mpf], d: list[mpf]) -> mpf:
    c, shape = mpf(surface.curvature), 1 + mpf(surface.conic)
    to_plane = -p[2] / d[2]
    if c == 0:
        return to_plane
    A = c * (d[0] ** 2 + d[1] ** 2 + shape * d[2] ** 2)
    B = c * (p[0] * d[0] + p[1] * d[1] + shape * p[2] * d[2]) - d[2]
    C = c * (p[0] ** 2 + p[1] ** 2 + shape * p[2] ** 2) - 2 * p[2]
    if A == 0:
        return -C / (2 * B)
    discriminant = B * B - A * C
    if discriminant < 0:
        raise ValueError("the reference ray misses a surface")
    roots = [(-B + sign * sqrt(discriminant)) / A for sign in (1, -1)]
    # On the sheet of the vertex, and there the crossing next to the vertex plane.
    on_sheet = [t for t in roots if 1 - shape * c * (p[2] + t * d[2]) > 0]
    if not on_sheet:
        raise ValueError("the reference ray misses a surface")
    return min(on_sheet, key=lambda t: abs(t - to_plane))


def _sag(surface: ReferenceSurface, u: mpf) -> tuple[mpf, mpf]:
    """Sag and its derivative by u = r²."""
    c = mpf(surface.curvature)
    w = sqrt(1 - (1 + mpf(surface.conic)) * c * c * u)
    sag, slope = c * u / (1 + w), c / (2 * w)
    for power, a in enumerate(map(mpf, surface.coefficients), 1):
        sag += a * u**power
        slope += power * a * u ** (power - 1)
    return sag, slope


def _bend(surface: ReferenceSurface, p: list[mpf], d: list[mpf], n: mpf) -> list[mpf]:
    slope = _sag(surface, p[0] ** 2 + p[1] ** 2)[1]
    normal = [-2 * slope * p[0], -2 * slope * p[1], mpf(1)]
    length = sqrt(_dot(normal, normal))
    normal = [component / length for component in normal]
    cosine = _dot(normal, d)
    if cosine < 0:
        normal, cosine = [-component for component in normal], -cosine
    if surface.is_mirror:
        return [a - 2 * cosine * b for a, b in zip(d, normal, strict=True)]
    ratio = n / mpf(surface.index)
    sine_squared = ratio**2 * (1 - cosine**2)
    if sine_squared > 1:
        raise ValueError("the reference ray is totally reflected")
    along = sqrt(1 - sine_squared) - ratio * cosine
    return [ratio * a + along * b for a, b in zip(d, normal, strict=True)]
