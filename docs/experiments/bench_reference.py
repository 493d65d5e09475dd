"""A textbook ray tracer in mpmath with 50 digits, one ray at a time, and the errors of other tracers against it.

It shares only the numbers of the lens with them: conics by the quadratic formula, aspheres by Newton's method,
refraction by unit normals and cosines.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mpmath import mp, mpf, sqrt
from pages import digits, significant, yes

from raytrace.bench.measure import Tracer, some, variables
from raytrace.maths.numerics import to
from raytrace.system.lens import Lens, media
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface, is_even

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


# -- errors ------------------------------------------------------------------------------------------------------------


def shape_of(surface: Surface, number: int) -> tuple[float, float, list[float]]:
    """Curvature, conic and coefficients of r², r⁴, …. Raises ValueError for other shapes."""
    if not is_even(surface):
        raise ValueError(f"surface {number} is no conic with even terms: peers and references cannot trace it")
    c, k = (0.0 if value is None else float(value) for value in (surface.curvature, surface.conic))
    return c, k, [] if surface.coefficients is None else surface.coefficients.tolist()


def reference_of(lens: Lens) -> tuple[list[ReferenceSurface], float]:
    """The surfaces behind the object and the first index, for `trace_reference`."""
    indices = [float(index) for index in media(lens, lens.primary)]
    surfaces = [
        ReferenceSurface(*shape_of(surface, number), float(surface.thickness), index, surface.is_mirror)
        for number, (surface, index) in enumerate(zip(lens.surfaces[1:], indices[1:], strict=True), 1)
    ]
    return surfaces, indices[0]


def errors_of(
    tracer: Tracer, lens: Lens, rays: Rays, *, copies: int = 1, gradient: bool = True
) -> dict[str, float | None]:
    """Errors of a tracer on a few rays (3, P) as in `raytrace.bench.measure.Row`; tracer and reference have the numbers
    as rounded to the dtype.

    copies: of the rays in the batch, so that the engine of large batches traces it; gradient: whether to compare that,
    too.
    """
    lens, rays = to(lens, dtype=tracer.dtype), to(rays, dtype=tracer.dtype)
    surfaces, index = reference_of(lens)
    starts = list(zip(rays.position.T.tolist(), rays.direction.T.tolist(), strict=True))
    exact, count = [trace_reference(surfaces, index, *start) for start in starts], len(starts)
    batch = to(some(rays, lambda x: x.repeat(*(1,) * (x.dim() - 1), copies)), device=tracer.device)
    points, path = tracer.forward(batch)
    points = points[:, :count]
    position = 1e6 * max(_worst(points[axis].tolist(), [ray.position[axis] for ray in exact]) for axis in (0, 1))
    path_error = gradient_error = None
    if path is not None:
        relative = (path[:count].double() - path[0].double()).tolist()
        path_error = 1e3 / float(lens.primary) * _worst(relative, [ray.path - exact[0].path for ray in exact])
    if gradient and tracer.has_gradient:
        names = variables(lens)
        expected = spot_gradient(surfaces, index, starts, [(number - 1, name) for number, name in names])
        slopes = [float(slope) for slope in tracer.gradient(batch, points.mean(1))]
        gradient_error = 0.0
        for kind in {name for _, name in names}:
            pairs = [(a, b) for a, b, (_, name) in zip(slopes, expected, names, strict=False) if name == kind]
            error = _worst(*zip(*pairs, strict=True)) / float(max(abs(b) for _, b in pairs))
            gradient_error = max(gradient_error, error)
    return {"position": position, "path_error": path_error, "gradient": gradient_error}


def _worst(values: Sequence[float], expected: Sequence) -> float:
    return max(float(abs(a - b)) for a, b in zip(values, expected, strict=True))


#: Columns of the tables of rows.
COLUMNS = {
    "rays": lambda row: f"{row.rays:,}",
    "what": lambda row: row.what,
    "dtype": lambda row: row.dtype,
    "tracer": lambda row: row.tracer,
    "path": lambda row: yes(row.path),
    "at a time": lambda row: f"{row.piece:,}",
    "M/s": lambda row: significant(row.speed / 1e6),
    "position error, nm": lambda row: digits(row.position, ".2g"),
    "path error, waves": lambda row: digits(row.path_error, ".2g"),
    "gradient error": lambda row: digits(row.gradient, ".2g") if row.what != "forward" else "",
}
