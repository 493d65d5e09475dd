"""Laws: what a surface does to the direction of light. Snell's law, reflection, diffraction by a phase, an ideal lens.

Directions and normals come by components, the normal n not normalised, of squared length norm_squared; cosine is n·d.
"""

import torch
from torch import Tensor

from raytrace.maths.numerics import dot
from raytrace.system.phases import Added


def refract(direction, normal, cosine, norm_squared, n1: Tensor, n2: Tensor, b_squared: Tensor | None = None):
    """Snell's law n1 sin θ1 = n2 sin θ2 as a vector, and whether light passes (False: total internal reflection).

        d' = (n1/n2) d + sign(n·d) D/(a + b)/n2 n,   D = (n2 - n1)(n2 + n1),   a = n1 |n·d|,   b = √(a² + D |n|²)

    direction: unit, by components; normal: by components, of squared length norm_squared; cosine: n·d.
    b_squared: b² in float64 where it is known better than by these numbers; it then decides.
    No 1 - cos² anywhere: equal indices return d exactly, and grazing rays keep their digits. The squared length of
    d' is then brought to 1 within rounding, by a factor that is 1 identically and so is not differentiated.
    """
    a = n1 * cosine
    D = (n2 - n1) * (n2 + n1)
    passes, b_squared = _decided(torch.addcmul(D * norm_squared, a, a), b_squared)
    b = torch.sqrt(torch.where(passes, b_squared, 1.0))
    # An index of 0 is a medium without a real index: nothing passes into it.
    n2 = torch.where(n2 > 0, n2, 1.0)
    along_normal = (D / n2) / (a + torch.copysign(b, a))
    ratio = n1 / n2
    refracted = [torch.addcmul(ratio * d, along_normal, n) for d, n in zip(direction, normal, strict=True)]
    return _renormalise(refracted), passes


def reflect(direction, normal, cosine, norm_squared):
    """Law of reflection d' = d - 2 (n·d) n / |n|²; arguments as for `refract`."""
    twice = 2 * cosine / norm_squared
    return _renormalise([torch.addcmul(d, twice, n, value=-1) for d, n in zip(direction, normal, strict=True)])


def diffract(
    direction, normal, cosine, norm_squared, n1: Tensor, n2: Tensor, added: Added, *, mirror: bool, b_squared=None
):
    """Snell's law or reflection with the gradient g = ∇p of a path added to q = n1 d; and whether light passes.

        n2 d' = q + α n,  q = n1 d + g,  α = (s b - a)/|n|² = D/(a + s b),  a = q·n,  b = √(a² + D |n|²)
        D = (n2 - n1)(n2 + n1) - g·(2 n1 d + g)

    s is the sign of n·d, or the other one for a mirror: light keeps its side, or changes it. Where the root vanishes
    the order is evanescent, and no light passes. Welford, Opt. Commun. 14, 322 (1975).
    b_squared: b² in float64 where it is known better than by these numbers, as for `refract`.
    """
    L, M, N = direction
    q = n1 * L + added.x, n1 * M + added.y, n1 * N
    a, D = _across(direction, normal, cosine, n1, n2, added)
    passes, b_squared = _decided(torch.addcmul(D * norm_squared, a, a), b_squared)
    passes = passes & (n2 > 0)
    b = torch.sqrt(torch.where(passes, b_squared, 1.0))
    b = torch.where((cosine < 0) ^ mirror, -b, b)
    alike = a * b > 0
    along = torch.where(alike, D / torch.where(alike, a + b, 1.0), (b - a) / norm_squared)
    n2 = torch.where(n2 > 0, n2, 1.0)
    return _renormalise([torch.addcmul(at, along, n) / n2 for at, n in zip(q, normal, strict=True)]), passes


def diffracted_root(direction, normal, cosine, norm_squared, n1: Tensor, n2: Tensor, added: Added) -> Tensor:
    """b² of `diffract`."""
    a, D = _across(direction, normal, cosine, n1, n2, added)
    return torch.addcmul(D * norm_squared, a, a)


def _across(direction, normal, cosine, n1: Tensor, n2: Tensor, added: Added) -> tuple[Tensor, Tensor]:
    """a and D of `diffract`."""
    L, M, _ = direction
    a = torch.addcmul(n1 * cosine + added.x * normal[0], added.y, normal[1])
    return a, (n2 - n1) * (n2 + n1) - (added.x * (2 * n1 * L + added.x) + added.y * (2 * n1 * M + added.y))


def bend_slopes(direction, height, power, n1: Tensor, n2: Tensor):
    """The ideal lens n2 tan θ2 = n1 tan θ1 - power · height in x and y, with -n for n where light travels backward.

        d' ∝ (n1 L - φx x |N|, n1 M - φy y |N|, n2 N)

    Slopes may be of any size: a ray along the plane goes on along it.
    """
    L, M, N = direction
    (power_x, power_y), (x, y, _) = power, height
    bent = [n1 * L - power_x * x * N.abs(), n1 * M - power_y * y * N.abs(), n2 * N]
    factor = torch.rsqrt(dot(bent, bent))
    return [component * factor for component in bent]


def _decided(b_squared: Tensor, exact: Tensor | None) -> tuple[Tensor, Tensor]:
    """Whether light passes, and b² with the value of the exact one and its own derivatives."""
    if exact is None:
        return b_squared > 0, b_squared
    smallest = torch.finfo(b_squared.dtype).tiny
    return exact > 0, exact.to(b_squared.dtype).clamp_min(smallest) + (b_squared - b_squared.detach())


def _renormalise(direction):
    detached = [d.detach() for d in direction]
    factor = torch.rsub(dot(detached, detached), 1.5, alpha=0.5)
    return [d * factor for d in direction]
