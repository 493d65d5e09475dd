"""Surface: sag, normal and intersection of a rotationally symmetric refracting or reflecting surface.

    z(r) = c r² / (1 + √(1 - (1+k) c² r²)) + Σ_j a_j r^(2j),  j = 1, 2, …

Every function works in the frame of the surface's vertex, components first, for any batch shape.
"""

import torch
from torch import Tensor

from raytrace.asphere import asphere_root, sag_and_derivatives
from raytrace.glass import AIR, Glass
from raytrace.numerics import dot, with_batch_axes
from raytrace.value import value


@value
class Aperture:
    """The part of a surface that passes light; one surface may carry several, and a ray must pass all of them.

    shape: "circular" (extent: inner and outer radius), "rectangular" or "elliptic" (half-widths in x and y).
    extent: the two numbers of the shape, mm.
    obscures: True if the shape blocks what lies inside it (an obscuration) instead of passing it.
    centre: (x, y) mm of the shape in the surface's frame.
    """

    shape: str
    extent: tuple[float, float]
    obscures: bool = False
    centre: tuple[float, float] = (0.0, 0.0)


@value
class Surface:
    """One surface of a lens and the gap behind it. What is None is not modelled, and costs nothing.

    thickness: mm from this vertex to the next; the object's may be inf.
    curvature: c, 1/mm; None is a plane for good (put a tensor of 0 to differentiate a plane's curvature).
    conic: k; None is a sphere.
    coefficients: (m, ...) a_1, a_2, … of r², r⁴, … in mm^(1-2j); None if not aspheric.
    glass: the medium behind the surface; MIRROR reflects and keeps the medium before it.
    semi_diameter: mm, as stored in the file; it never clips a ray (only `apertures` do), but bounds the search for
        the first crossing with an asphere that a ray may cross more than once.
    apertures: what the surface lets through.
    comment: free text of the file.
    """

    thickness: Tensor
    curvature: Tensor | None = None
    conic: Tensor | None = None
    coefficients: Tensor | None = None
    glass: Glass = AIR
    semi_diameter: float | None = None
    apertures: tuple[Aperture, ...] = ()
    comment: str = ""

    @property
    def is_mirror(self) -> bool:
        return self.glass.formula == "mirror"

    @property
    def is_plane(self) -> bool:
        """True if the surface has neither curvature nor aspheric terms to model."""
        return self.curvature is None and self.coefficients is None

    @property
    def batch_axes(self) -> int:
        """How many batch axes the numbers of the shape have."""
        scalars = [x.dim() for x in (self.curvature, self.conic) if x is not None]
        return max([0, *scalars, 0 if self.coefficients is None else self.coefficients.dim() - 1])


def sag(surface: Surface, radius_squared: Tensor) -> Tensor:
    """Sag z in mm at r² (...) in mm²; the radicand is clamped at 0 beyond the edge of a closed conic."""
    if surface.is_plane:
        return torch.zeros_like(radius_squared)
    return sag_and_derivatives(radius_squared, surface.curvature, surface.conic, surface.coefficients)[0]


def intersect(surface: Surface, position: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays cross the surface in their own direction of propagation; the path to it may be negative.

    position: (3, ...) mm, anywhere on the ray, in the frame of this surface's vertex; direction: (3, ...) unit.
    Returns the hit point (3, ...) mm and whether there is one (...). Of two crossings it is the one on the vertex
    sheet whose normal looks along the ray's own z direction. A ray that misses comes back at the vertex.
    First and second derivatives are exact: see `_attach`.
    """
    if surface.is_plane:
        return _intersect_plane(position, direction)
    axes = max(surface.batch_axes, position.dim() - 1, direction.dim() - 1)
    position, direction = with_batch_axes(position, axes), with_batch_axes(direction, axes)
    # Slide to the foot of the perpendicular from the vertex, so that a far origin costs no digits (Feder 1951,
    # Spencer & Murty 1962); the slide stays in the graph.
    foot = position - dot(position, direction) * direction
    if surface.coefficients is not None:
        return _intersect_asphere(surface, foot, direction)
    return _intersect_conic(surface, foot, direction)


def normal(surface: Surface, hit: Tensor) -> tuple[Tensor, Tensor]:
    """A normal (3, ...) at a point on the surface, not normalised, z > 0 at the vertex; and its squared length (...).

    Conic: (-c x, -c y, 1 - (1+k) c z), squared length 1 - k c² r² on the surface (1 for a sphere): no square root.
    """
    x, y, z = hit
    if surface.is_plane:
        one = torch.ones_like(x)
        return torch.stack([torch.zeros_like(x), torch.zeros_like(x), one]), one
    radius_squared = x * x + y * y
    if surface.coefficients is not None:
        slope = 2 * sag_and_derivatives(radius_squared, surface.curvature, surface.conic, surface.coefficients)[1]
        return torch.stack([-slope * x, -slope * y, torch.ones_like(x)]), 1 + slope * slope * radius_squared
    c = surface.curvature
    if surface.conic is None:
        return torch.stack([-c * x, -c * y, 1 - c * z]), torch.ones_like(x)
    k = surface.conic
    return torch.stack([-c * x, -c * y, 1 - (1 + k) * c * z]), 1 - k * c * c * radius_squared


def inside(surface: Surface, hit: Tensor) -> Tensor | None:
    """Which points (...) pass all apertures of the surface; None if it has none. An edge belongs to the clear side."""
    passed = None
    for aperture in surface.apertures:
        x, y = hit[0] - aperture.centre[0], hit[1] - aperture.centre[1]
        a, b = aperture.extent
        if aperture.shape == "circular":
            radius_squared = x * x + y * y
            within = (radius_squared >= a * a) & (radius_squared <= b * b)
            blocked = (radius_squared > a * a if a > 0 else radius_squared >= 0) & (radius_squared < b * b)
        elif aperture.shape == "rectangular":
            within, blocked = (x.abs() <= a) & (y.abs() <= b), (x.abs() < a) & (y.abs() < b)
        else:
            level = (x / a) ** 2 + (y / b) ** 2
            within, blocked = level <= 1, level < 1
        clear = ~blocked if aperture.obscures else within
        passed = clear if passed is None else passed & clear
    return passed


def _intersect_plane(position: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    # A ray along the plane misses it, and so does one that meets it further away than numbers go.
    slope = direction[2].detach()
    reach = position[2].detach() / torch.where(slope != 0, slope, 1.0)
    met = (slope != 0) & torch.isfinite(reach) & torch.isfinite(reach * reach)
    position, direction = _axial_where_lost(position, direction, met)
    x, y, z = position
    L, M, N = direction
    t = -z / N
    return torch.stack([x + t * L, y + t * M, torch.zeros_like(t)]), met


def _intersect_conic(surface: Surface, foot: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """F(t) = c/2 (x² + y² + (1+k) z²) - z = 0 along the ray: F' and F'' are as simple as F."""
    c = surface.curvature
    shape = 1.0 if surface.conic is None else 1 + surface.conic
    t, met = conic_root(foot.detach(), direction.detach(), c.detach(), _detach(shape))
    foot, direction = _axial_where_lost(foot, direction, met)
    L, M, N = direction
    x, y, z = foot + t * direction
    F = 0.5 * c * (x * x + y * y + shape * z * z) - z
    dF = c * (x * L + y * M + shape * z * N) - N
    d2F = c * (L * L + M * M + shape * N * N)
    return foot + _attach(t, F, dF, d2F) * direction, met


def _intersect_asphere(surface: Surface, foot: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """F(t) = z - sag(x² + y²) = 0 along the ray; the root itself is found outside the graph."""
    c, k, a = surface.curvature, surface.conic, surface.coefficients
    zero = a.new_zeros(())
    rim = float("inf") if surface.semi_diameter is None else surface.semi_diameter
    t, met = asphere_root(
        foot.detach(),
        direction.detach(),
        zero if c is None else c.detach(),
        zero if k is None else k.detach(),
        a.detach(),
        rim,
    )
    foot, direction = _axial_where_lost(foot, direction, met)
    L, M, N = direction
    x, y, z = foot + t * direction
    S, dS, d2S = sag_and_derivatives(x * x + y * y, c, k, a)
    radial = x * L + y * M
    dF = N - 2 * dS * radial
    d2F = -(4 * d2S * radial * radial + 2 * dS * (L * L + M * M))
    return foot + _attach(t, z - S, dF, d2F) * direction, met


def _attach(t: Tensor, F: Tensor, dF: Tensor, d2F: Tensor) -> Tensor:
    """One step of Chebyshev's method from a root t found outside the graph: it carries its derivatives and polishes t.

    With F(t, p) = 0 and δ = F/F', the step t - δ - (F''/2F') δ² has, at δ = 0, the first derivative -F_p/F_t of the
    implicit function and, because δ² has no first but a second derivative, also its second derivative: the last term
    supplies -(F_tt/F_t) t_p t_q, which one Newton step lacks. F'' itself need not be differentiated. In float32 the
    root comes from float64 and a step would only add rounding, so its value (not its derivative) is taken out.
    """
    step = F / dF
    if step.dtype != torch.float64:
        step = step - step.detach()
    return t - step * (1 + 0.5 * (d2F / dF).detach() * step)


def conic_root(foot: Tensor, direction: Tensor, c: Tensor, shape: Tensor | float) -> tuple[Tensor, Tensor]:
    """Path t (...) from the foot of the perpendicular to the conic of shape 1+k, and whether it is met (...).

        A t² - 2 G t + F = 0,  A = c (L² + M² + (1+k) N²),  G = N - c k p_z N - c (p·d),
        F = c (p_x² + p_y² + (1+k) p_z²) - 2 p_z

    in the algebraic form that does not cancel (Kahan 2004), regular at c = 0 and at k = -1. Worked in float64 also
    for float32 rays: within 1e-7 of the edge of a surface rounding would decide between a hit and a miss.
    """
    dtype = foot.dtype
    foot, direction, c = foot.double(), direction.double(), c.double()
    shape = shape.double() if isinstance(shape, Tensor) else shape
    L, M, N = direction
    x, y, z = foot
    A = c * (L * L + M * M + shape * N * N)
    G = N - c * (x * L + y * M + shape * z * N)
    F = c * (x * x + y * y + shape * z * z) - 2 * z
    discriminant = G * G - A * F
    real = discriminant > 0
    root = torch.sqrt(torch.where(real, discriminant, 1.0))
    s = torch.where(N < 0, -1.0, 1.0).to(N.dtype)
    same_sign = s * G >= 0
    numerator = torch.where(same_sign, F, G - s * root)
    denominator = torch.where(same_sign, G + s * root, A)
    finite = denominator != 0
    t = numerator / torch.where(finite, denominator, 1.0)
    on_vertex_sheet = 1 - shape * c * (z + t * N) > 0
    met = real & finite & on_vertex_sheet & torch.isfinite(t)
    return torch.where(met, t, 0.0).to(dtype), met


def _axial_where_lost(foot: Tensor, direction: Tensor, met: Tensor) -> tuple[Tensor, Tensor]:
    """Replace rays that miss by the axial ray, on which all arithmetic that follows is finite."""
    axis = torch.zeros_like(direction)
    axis[2] = 1.0
    return torch.where(met, foot, 0.0), torch.where(met, direction, axis)


def _detach(x: Tensor | float) -> Tensor | float:
    return x.detach() if isinstance(x, Tensor) else x
