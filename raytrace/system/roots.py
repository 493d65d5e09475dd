"""Roots: where a ray meets a conic, in closed form, found outside the graph and in float64."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.maths.numerics import dot


def foot_of(position, direction) -> tuple[list[Tensor], Tensor]:
    """Foot of the perpendicular from the vertex to the ray, and the path to it.

    From there a far origin costs no digits (Feder 1951, Spencer & Murty 1962); the slide stays in the graph.
    """
    slide = -dot(position, direction)
    return [torch.addcmul(p, slide, d) for p, d in zip(position, direction, strict=True)], slide


class Way(NamedTuple):
    """Where a root is looked for, detached and in float64 also for float32 rays.

    foot, direction: triples; lag: of float32 rays how much longer the exact slide is than theirs, else None; dtype:
    theirs.
    """

    foot: Sequence[Tensor]
    direction: Sequence[Tensor]
    lag: Tensor | None
    dtype: torch.dtype

    def back(self, root: Tensor, met: Tensor) -> tuple[Tensor, tuple | None]:
        """The path from the rays' own foot, in their dtype; and of float32 rays `Meeting.exact`."""
        if self.lag is None:
            return root, None
        hit = [torch.addcmul(p, root, d) for p, d in zip(self.foot, self.direction, strict=True)]
        return torch.where(met, root + self.lag, 0.0).to(self.dtype), (hit, self.direction)


def way_of(position, direction, foot, slide) -> Way:
    """The way of rays whose foot and slide are known already, as `foot_of` gives them."""
    if slide.dtype == torch.float64:
        return Way([p.detach() for p in foot], [d.detach() for d in direction], None, slide.dtype)
    position, direction = doubles(position), doubles(direction)
    foot, exact = foot_of(position, direction)
    return Way(foot, direction, exact - slide.detach(), slide.dtype)


def doubles(vector: Sequence[Tensor]) -> list[Tensor]:
    """Components in float64, outside the graph."""
    return [double(component) for component in vector]


def double(x: Tensor | None) -> Tensor | None:
    """A number in float64, outside the graph; None stays None."""
    return None if x is None else x.detach().double()


def conic_root(foot, direction, c: Tensor, shape: Tensor | None) -> tuple[Tensor, Tensor]:
    """Path t (...) from the foot of the perpendicular to the conic of shape 1+k, 0 if there is none; and whether met.

        A t² - 2 G t + F = 0,  A = c (L² + M² + (1+k) N²),  G = N - c k p_z N - c (p·d),
        F = c (p_x² + p_y² + (1+k) p_z²) - 2 p_z

    in the algebraic form that does not cancel (Kahan 2004), regular at c = 0 and at k = -1. For a sphere (shape None)
    A = c and G = N, and G never cancels against the root. Asked for in float64 also of float32 rays: within 1e-7 of the
    edge of a surface rounding would decide between a hit and a miss.
    """
    L, M, N = direction
    x, y, z = foot
    if shape is None:
        F = torch.sub(c * torch.addcmul(x * x + y * y, z, z), z, alpha=2)
        discriminant = torch.addcmul(N * N, c, F, value=-1)
        t = F / (N + torch.copysign(torch.sqrt(discriminant.clamp_min(0.0)), N))
        met = (discriminant > 0) & ((c * torch.addcmul(z, t, N)).abs() < 1)
        return torch.where(met, t, 0.0), met
    shaped = shape * N
    A = c * torch.addcmul(L * L + M * M, shaped, N)
    G = torch.addcmul(N, c, torch.addcmul(x * L + y * M, shaped, z), value=-1)
    F = torch.sub(c * torch.addcmul(x * x + y * y, shape * z, z), z, alpha=2)
    discriminant = torch.addcmul(G * G, A, F, value=-1)
    root = torch.copysign(torch.sqrt(discriminant.clamp_min(0.0)), N)
    same_sign = torch.where(N < 0, -G, G) >= 0
    t = torch.where(same_sign, F, G - root) / torch.where(same_sign, G + root, A)
    met = (discriminant > 0) & ((shape * c) * torch.addcmul(z, t, N) < 1) & (t.abs() < float("inf"))
    return torch.where(met, t, 0.0), met
