"""Modulation of diffraction from few rays: a pupil over itself, sheared, by quadrature.

    OTF(ν) = ∬ √(J₊ J₋) exp 2πi (W₊ - W₋) ds / ∬ J ds,    ± at s ± ν/2

Over directions s = n (L, M)/λ in 1/mm, with W the wave in waves and J = |∂p/∂s| the light of an entrance pupil |p| ≤ 1
that is lit evenly. W and p are polynomials of s that fit the rays of a few rings by least squares. The part that both
pupils cover is cut into lines along the shear from rim to rim, with Gaussian rules along and across: their error falls
exponentially with their points, where cells of a grid err by their share at the rim.

Derivatives are exact of what is computed: backward from the OTFs to the polynomials, by torch, and by the normal
equations from these to the rays, whose derivatives by the variables come from the trace.

Source: Hopkins, Proc. Phys. Soc. B 70, 1957 (the sheared pupil); Golub & Pereyra 1973 (derivative of a fit).
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import safe_sqrt
from raytrace.maths.pupil import gauss_legendre, gauss_rings

_RIM = 1 - 1e-9  # rays of the rim, which rounding must not put outside
_NEWTON = 12  # steps at the most
_CLOSE = 1e-7  # of the pupil, from where one more step ends at rounding
_WHOLE = 1.98  # of pupil radii: a shear that leaves nothing in common


class Layout(NamedTuple):
    """Rays of a beam: pupil points (2, R), their weights (R,), and powers (i, j) of s_x and s_y of the fit.

    half: of a beam that is mirrored in the y axis its right half, by what is even in x, and p_x by what is odd.
    """

    points: np.ndarray
    weights: np.ndarray
    degree: int
    half: bool

    @property
    def powers(self) -> tuple[np.ndarray, np.ndarray]:
        """Those of W and p_y, and of p_x: (K, 2) each."""
        every = np.array([(i, n - i) for n in range(self.degree + 1) for i in range(n + 1)])
        return tuple(every[every[:, 0] % 2 == odd] if self.half else every for odd in (0, 1))


def layout_of(degree: int, *, half: bool) -> Layout:
    """Rings of a Gaussian rule that a polynomial of a degree is orthogonal on, and one ring at the rim."""
    rings, arms = degree // 2 + 1, 4 * (degree // 2 + 1)
    points, weights = (part.numpy() for part in gauss_rings(rings, arms))
    rim = points[:, -arms:] / np.hypot(*points[:, -arms:])
    points, weights = np.concatenate([points, _RIM * rim], 1), np.append(weights, np.full(arms, 0.5 * weights.min()))
    chosen = points[0] > 0 if half else slice(None)
    return Layout(points[:, chosen], weights[chosen], degree, half)


# -- polynomials of the rays -------------------------------------------------------------------------------------------


class Fit:
    """Polynomials (B, N, N) of W, p_x and p_y in directions, and how they follow what they fit.

    s = middle + scale * (u, v), which puts the beam into a square; `middle` and `scale` (2, B) are choices, which
    nothing depends on.
    """

    def __init__(self, layout: Layout, wave: np.ndarray, directions: np.ndarray):
        """wave: (B, R) waves; directions: s (2, B, R) 1/mm."""
        self.layout, self.wave = layout, wave
        low, high = directions.min(-1), directions.max(-1)
        self.middle, self.scale = 0.5 * (low + high), 0.5 * (high - low)
        if layout.half:
            self.middle[0], self.scale[0] = 0.0, np.abs(directions[0]).max(-1)
        self.at = (directions - self.middle[..., None]) / self.scale[..., None]
        even, odd = layout.powers
        px, py = (np.broadcast_to(p, wave.shape) for p in layout.points)
        root = np.sqrt(layout.weights)
        self.parts = [_Part(powers, root, self.at, data) for powers, data in ((odd, px), (even, py), (even, wave))]

    @property
    def polynomials(self) -> np.ndarray:
        """(3, B, N, N) coefficients of u^i v^j: p_x, p_y, W."""
        return np.stack([part.table(self.layout.degree + 1) for part in self.parts])

    @property
    def missed(self) -> np.ndarray:
        """RMS (B,) in waves of what the polynomials of W leave."""
        return np.sqrt((self.layout.weights * self.parts[2].left ** 2).sum(-1) / self.layout.weights.sum())

    def by_rays(self, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By waves (Q, B, R) and directions (2, Q, B, R), from derivatives (3, Q, B, N, N) by the polynomials."""
        told = [part.back(slope) for part, slope in zip(self.parts, slopes, strict=True)]
        return told[2][0], sum(at for _, at in told) / self.scale[:, None, :, None]


class _Part:
    """One polynomial: c = V⁺ d, over powers (K, 2), of data (B, R) at places (2, B, R) with roots of weights (R,)."""

    def __init__(self, powers: np.ndarray, root: np.ndarray, at: np.ndarray, data: np.ndarray):
        self.powers, self.root = powers, root
        (self.basis, self.by_u), (along, by_along) = (_raised(at[k], powers[:, k]) for k in range(2))
        self.by_v, self.by_u, self.basis = self.basis * by_along, self.by_u * along, self.basis * along
        q, r = np.linalg.qr(root[:, None] * self.basis)
        self.turn = np.linalg.inv(r)
        self.inverse = self.turn @ (q.swapaxes(-1, -2) * root)
        self.found = (self.inverse @ data[..., None])[..., 0]
        self.left = data - (self.basis @ self.found[..., None])[..., 0]

    def table(self, size: int) -> np.ndarray:
        found = np.zeros((len(self.found), size, size))
        found[:, self.powers[:, 0], self.powers[:, 1]] = self.found
        return found

    def back(self, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """By the data (Q, B, R) and by the places (2, Q, B, R).

        dc = V⁺ (dd - dV c) + (VᵀV)⁻¹ dVᵀ r, r = d - V c what is left
        """
        told = slope[..., self.powers[:, 0], self.powers[:, 1]][..., None, :]  # (Q, B, 1, K)
        by_data = (told @ self.inverse)[..., 0, :]
        inner = (told @ self.turn @ self.turn.swapaxes(-1, -2))[..., 0, :]
        left = self.root**2 * self.left
        by_places = []
        for by in (self.by_u, self.by_v):
            along, back = (by @ self.found[..., None])[..., 0], (by @ inner[..., None])[..., 0]
            by_places.append(left * back - by_data * along)
        return by_data, np.stack(by_places)


def _raised(x: np.ndarray, powers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x^k and its slope k x^(k-1), (..., K)."""
    every = np.ones((*x.shape, powers.max() + 1))
    for k in range(1, every.shape[-1]):
        every[..., k] = every[..., k - 1] * x
    return every[..., powers], powers * every[..., np.maximum(powers - 1, 0)]


# -- the sheared pupil -------------------------------------------------------------------------------------------------


def otf(polynomials: Tensor, shear: Tensor, points: int) -> Tensor:
    """OTF (Q, B) complex of polynomials (3, Q, B, N, N), p_x, p_y and W, sheared along their last axis.

    shear: (Q, B), in the units of their places; points: of the rules along and across.
    """
    with torch.no_grad():
        corner, slope, found = _corners(polynomials[:2], shear)
    dead = ~found
    shear = torch.where(dead, 0.5, shear)
    pupil = polynomials[:2]
    ends = [_within(pupil, corner[0], corner[1] + side * shear) - 1 for side in (0.5, -0.5)]
    (a, b), (c, d) = slope
    across = corner[0] - torch.where(dead, 0.0, (d * ends[0] - b * ends[1]) / (a * d - b * c))
    nodes, weights = (torch.from_numpy(part) for part in gauss_legendre(points))
    angle = 0.5 * math.pi * nodes
    low, high = across
    half = 0.5 * (high - low)[..., None]
    place = 0.5 * (high + low)[..., None] + half * torch.sin(angle)
    width = half * 0.5 * math.pi * weights * torch.cos(angle)
    line = _lines(polynomials, place)
    bottom, top = (_rim(line[..., :2], place.detach(), side) for side in (-1.0, 1.0))
    reach = 0.5 * (top - bottom - shear[..., None])
    along = 0.5 * (top + bottom)[..., None] + reach[..., None] * nodes
    area = width[..., None] * reach[..., None] * weights
    (W1, J1), (W2, J2) = (_wave(line, along + side * shear[..., None, None]) for side in (0.5, -0.5))
    light = area * safe_sqrt(J1 * J2) / math.pi
    phase = 2 * math.pi * (W1 - W2)
    told = torch.complex((light * torch.cos(phase)).sum((-1, -2)), (light * torch.sin(phase)).sum((-1, -2)))
    return torch.where(dead, 0.0, told)


def _wave(line: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """W and J at places (..., P) of lines (..., N, 5): p_x, p_y, W, and the slopes of p_x and p_y across."""
    values, slopes = _along(line, at)
    (x, y), (x_u, y_u) = slopes[..., :2].unbind(-1), values[..., 3:].unbind(-1)
    return values[..., 2], (x_u * y - y_u * x).abs()


def _lines(polynomials: Tensor, place: Tensor) -> Tensor:
    """Polynomials (..., P, N, 5) along the lines at places (..., P) across, of p_x, p_y and W, and of p_x and p_y their
    slopes across."""
    at, count = place.detach(), polynomials.shape[-1]
    powers = _powers(at, count)
    first, second = _slope_of(powers), _slope_of(_slope_of(powers))
    moved, fixed = (place - at)[..., None], polynomials.detach()
    line = powers @ polynomials + moved * (first @ fixed)
    steep = first @ polynomials[:2] + moved * (second @ fixed[:2])
    return torch.cat([line, steep]).movedim(0, -1)


def _powers(at: Tensor, count: int) -> Tensor:
    """at^k (..., N)."""
    found = at.new_ones(*at.shape, count)
    for k in range(1, count):
        torch.mul(found[..., k - 1], at, out=found[..., k])
    return found


def _slope_of(powers: Tensor) -> Tensor:
    """k at^(k-1), of at^k; again, what follows from that."""
    k = torch.arange(powers.shape[-1], dtype=powers.dtype)
    return k * torch.roll(powers, 1, -1)


def _along(line: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Values and slopes (..., P, C) of polynomials (..., N, C) at places (..., P), with derivatives by both."""
    count, fixed = line.shape[-2], line.detach()
    powers = _powers(at.detach(), count)
    k = torch.arange(1, count, dtype=line.dtype)[:, None]
    steep = k * line[..., 1:, :2]
    values, slopes = powers @ line, powers[..., :-1] @ steep
    if not at.requires_grad:
        return values, slopes
    moved = (at - at.detach())[..., None]
    bend = powers[..., :-2] @ (k[:-1] * steep.detach()[..., 1:, :])
    return values + moved * (powers[..., :-1] @ (k * fixed[..., 1:, :])), slopes + moved * bend


def _rim(line: Tensor, place: Tensor, side: float) -> Tensor:
    """Where lines (..., P, N, 2) at places (..., P) across reach |p|² = 1, on one side."""
    fixed, at = line.detach(), side * (safe_sqrt((1 - place * place).clamp_min(0.0)) + 0.05)
    for _ in range(_NEWTON):
        powers = _powers(at, line.shape[-2])[..., None, :]
        p, by = powers @ fixed, _slope_of(powers) @ fixed
        slope = 2 * (p * by).sum((-1, -2))
        slope = torch.where(slope == 0, 1.0, slope)
        step = ((p * p).sum((-1, -2)) - 1) / slope
        at = at - step
        if float(step.abs().max()) < _CLOSE:
            break
    p = _powers(at, line.shape[-2])[..., None, :] @ line
    return at - ((p * p).sum((-1, -2)) - 1) / slope


def _corners(pupil: Tensor, shear: Tensor) -> tuple[Tensor, tuple, Tensor]:
    """Where both rims meet: middles (2, 2, Q, B), across and along, of both corners; slopes of |p|² there by these, of
    the pupil ahead and behind; and for which there are any."""
    far = 0.5 * torch.clamp(shear, max=_WHOLE)
    across = safe_sqrt(1 - far * far)
    at = torch.stack([torch.stack([-across, across]), torch.zeros(2, *shear.shape, dtype=shear.dtype)])
    for _ in range(_NEWTON):
        told = [_slopes(pupil, at[0], at[1] + side * shear) for side in (0.5, -0.5)]
        (F, a, b), (G, c, d) = told
        det = a * d - b * c
        det = torch.where(det == 0, 1.0, det)
        step = torch.stack([d * (F - 1) - b * (G - 1), a * (G - 1) - c * (F - 1)]) / det
        at = at - step.clamp(-0.2, 0.2)
        if float(step.abs().max()) < _CLOSE:
            break
    found = (step.abs().amax((0, 1)) < _CLOSE) & (at[0, 1] > at[0, 0]) & (shear < _WHOLE)
    at = torch.where(
        found, at, torch.stack([torch.tensor([-0.5, 0.5]).double(), torch.zeros(2).double()])[..., None, None]
    )
    return at, ((a, b), (c, d)), found


def _slopes(pupil: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """|p|² and its derivatives at places (C, Q, B)."""
    (x, y), (xu, yu), (xv, yv) = (_at(pupil, *powers) for powers in _raised_at(u, v, pupil.shape[-1]))
    return x * x + y * y, 2 * (x * xu + y * yu), 2 * (x * xv + y * yv)


def _raised_at(u: Tensor, v: Tensor, count: int) -> list[tuple[Tensor, Tensor]]:
    """Powers of both, and the slopes of those of either."""
    U, V = _powers(u, count), _powers(v, count)
    return [(U, V), (_slope_of(U), V), (U, _slope_of(V))]


def _at(pupil: Tensor, U: Tensor, V: Tensor) -> Tensor:
    """p (2, C, Q, B) at places by their powers (C, Q, B, N)."""
    return ((U[..., None, :] @ pupil[:, None])[..., 0, :] * V).sum(-1)


def _within(pupil: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """|p|² at fixed places (C, Q, B)."""
    x, y = _at(pupil, _powers(u, pupil.shape[-1]), _powers(v, pupil.shape[-1]))
    return x * x + y * y
