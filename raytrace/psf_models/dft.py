"""Sums of waves: matrix DFT, FFT and direct Huygens sums, and the pixels that integrate their intensity.

A path W (mm or waves) is a phase +2π W/λ. Phases are reduced to a fraction of a wave before the factor 2π, so that a
million waves of piston lose no precision.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from raytrace.budget import afford, piece
from raytrace.maths.numerics import safe_divide, safe_sqrt
from raytrace.maths.sampling import Grid, centres, gauss_rings
from raytrace.maths.tangents import applied
from raytrace.tracing.f_number import axial_f_number
from raytrace.tracing.scene import Scene
from raytrace.words import RaytraceError, RaytraceWarning


class TooManyPoints(RaytraceError, ValueError):
    """A wave whose phase varies too much over the pupil to be summed."""


class Aliased(RaytraceWarning):
    """The wavefront changes by more than half a wave between neighbouring samples."""


def phasor(waves: Tensor) -> Tensor:
    """exp(2πi waves), complex."""
    angle = 2 * math.pi * (waves - torch.round(waves.detach()))
    return torch.complex(torch.cos(angle), torch.sin(angle))


def huygens(
    points: Tensor, pupil: Tensor, radius: Tensor, *, path: Tensor, amplitude: Tensor, wavelength: Tensor
) -> Tensor:
    """Field U (K) at points, of wavelets from a reference sphere: U = Σ_j A_j exp(2πi (W_j + |q_j - p| - R)/λ).

        |q - p| - R = (|p|² - 2 q·p)/(|q - p| + R)       (no cancellation, whatever R)

    points p: (3, K) mm and pupil points q: (3, J) mm, from the centre of the sphere, |q| = |R|; radius R: mm, signed
    as `Wavefront.radius`; path W: (J) mm; amplitude: (J); wavelength: mm in the image space.
    """
    p, q = points[:, :, None], pupil[:, None, :]
    distance = torch.sqrt(sum((a - b) ** 2 for a, b in zip(q, p, strict=True)))
    excess = sum(a * (a - 2 * b) for a, b in zip(p, q, strict=True)) / (distance + torch.abs(radius))
    # Each term is reduced to a fraction of a wave by itself: neither costs precision of the other.
    waves = _fraction(path / wavelength) + _fraction(torch.sign(radius) * excess / wavelength)
    return phasor(waves) @ amplitude.to(phasor(waves[:1, :1]).dtype)


def to_grid(field: Tensor, L: Tensor, M: Tensor, x: Tensor, y: Tensor, wavelength: Tensor) -> Tensor:
    """U(y, x) = Σ_j field_j exp(2πi (L_j x + M_j y)/λ): (..., Y, X) from waves (..., J) of any directions.

    The image is separable even where the pupil is not: J (X + Y) exponentials and one product of matrices.
    L, M: (..., J) direction cosines; x: (..., X), y: (..., Y) mm; wavelength: (...) mm in the image space.
    """

    def some(field: Tensor, L: Tensor, M: Tensor) -> Tensor:
        return _rows(M, y, wavelength) @ (field[..., :, None] * phasor(_columns(L, x, wavelength)))

    return _in_chunks(some, field, L, M, each=64 * (x.shape[-1] + y.shape[-1]) * wavelength.numel())


def to_grid_mirrored(field: Tensor, L: Tensor, M: Tensor, x: Tensor, y: Tensor, wavelength: Tensor) -> Tensor:
    """The sum of `to_grid` over pairs of waves (L, M) and (-L, M) of equal field, given one of each: a real product."""

    def some(field: Tensor, L: Tensor, M: Tensor) -> Tensor:
        cosine = 2 * torch.cos(2 * math.pi * _fraction(_columns(L, x, wavelength)))
        along_y = _rows(M, y, wavelength) * field[..., None, :]
        return torch.complex(along_y.real @ cosine, along_y.imag @ cosine)

    return _in_chunks(some, field, L, M, each=64 * (x.shape[-1] + y.shape[-1]) * wavelength.numel())


def on_lattice(field: Tensor, u: Tensor, v: Tensor, shape: tuple[int, int]) -> Tensor:
    """|Σ_j field_j exp(2πi (u_j k + v_j l))|² (rows l, columns k), the middle at half the shape, to 2 % of the largest.

    u, v: (J) cycles a step. Each wave is spread as a Gaussian over 4 × 4 points of a twice finer grid of frequencies,
    whose FFT is divided by the transform of the Gaussian (Greengard & Lee, SIAM Review 46, 443, 2004).
    """
    sigma, near = 0.67, torch.arange(-1, 3, device=u.device)
    sides, places = [2 * count for count in shape], []
    for position in (v * sides[0], u * sides[1]):
        first = torch.floor(position)
        low = first.min() - 1
        weight = torch.exp((position[:, None] - first[:, None] - near) ** 2 / (-2 * sigma**2))
        places.append(((first - low)[:, None].long() + near, weight))
    (rows, down), (columns, across) = places
    spread = field[:, None, None] * (down[:, :, None] * across[:, None, :])
    grid = field.new_zeros(int(rows.max()) + 1, width := int(columns.max()) + 1)
    grid.view(-1).index_add_(0, (rows[:, :, None] * width + columns[:, None, :]).flatten(), spread.flatten())
    for dim in (1, 0):  # frequencies count from their lowest, which changes phases alone
        count, n = shape[dim], sides[dim]
        k = torch.arange(count, device=u.device) - count // 2
        gauss = sigma * math.sqrt(2 * math.pi) / n * torch.exp(-2 * (math.pi * sigma * k.to(u.dtype) / n) ** 2)
        sums = torch.fft.ifft(grid, n=n, dim=dim).index_select(dim, k % n)
        grid = sums / (gauss if dim else gauss[:, None])
    return grid.real**2 + grid.imag**2


def _columns(L: Tensor, x: Tensor, wavelength: Tensor) -> Tensor:
    """L x/λ (..., J, X)."""
    return L[..., :, None] * (x[..., None, :] / wavelength[..., None, None])


def _rows(M: Tensor, y: Tensor, wavelength: Tensor) -> Tensor:
    """exp(2πi M y/λ) (..., Y, J)."""
    return phasor(y[..., :, None] * (M[..., None, :] / wavelength[..., None, None]))


def rings_to_grid(field: Tensor, sine: Tensor, x: Tensor, y: Tensor, wavelength: Tensor) -> Tensor:
    """U(y, x) = Σ_j field_j J₀(2π s_j ρ/λ), (..., Y, X): cones of waves (..., J) about the axis, s their sine."""
    distance = safe_sqrt(y[..., :, None] ** 2 + x[..., None, :] ** 2)

    def some(field: Tensor, sine: Tensor) -> Tensor:
        argument = distance[..., None] * (2 * math.pi * sine / wavelength[..., None])[..., None, None, :]
        J0 = bessel_j0(argument).flatten(-3, -2)
        return torch.complex(*(J0 @ part[..., None] for part in (field.real, field.imag)))

    U = _in_chunks(some, field, sine, each=32 * distance[..., 0, 0].numel() * x.shape[-1] * y.shape[-1])
    return U[..., 0].unflatten(-1, distance.shape[-2:])


def _in_chunks(sum_of: Callable[..., Tensor], *waves: Tensor, each: float) -> Tensor:
    """sum_of(*waves), a sum over the last axis of the waves (..., J), in chunks; each: bytes of a single wave."""
    parts = zip(*(torch.split(wave, piece(each), -1) for wave in torch.broadcast_tensors(*waves)), strict=True)
    total = sum_of(*next(parts))
    for part in parts:
        total = total + sum_of(*part)
    return total


def bessel_j0(x: Tensor) -> Tensor:
    """J₀ with its derivatives (those of torch.special detach silently)."""
    return applied(_Bessel, x, 0, slopes=lambda x, number: (_bessel_slope(x, number),))


def bessel_j1(x: Tensor) -> Tensor:
    """J₁ with its derivatives (those of torch.special detach silently)."""
    return applied(_Bessel, x, 1, slopes=lambda x, number: (_bessel_slope(x, number),))


def rings_and_arms(phase: float, order: int) -> tuple[int, int]:
    """Gauss rings and arms that integrate waves whose phase varies by `phase` radians along a pupil radius.

    A Gauss rule in r² of n rings integrates it up to J_2n(phase/2), arms up to J_arms(phase): both fall faster than any
    power beyond the argument. Order 0 adds a margin of the width of that fall, ∝ phase^(1/3); three orders add another.
    """
    margin = 1 + order / 3
    rings = math.ceil(phase / 4 + margin * (2 + 0.8 * phase ** (1 / 3)))
    arms = math.ceil(phase + margin * (6 + 1.5 * phase ** (1 / 3)))
    return rings, 4 * math.ceil(arms / 4)


def disc_rule(phase: float, order: int, *, most: int, what: str, like: Tensor) -> tuple[Tensor, Tensor]:
    """Points and weights of `rings_and_arms`. Raises TooManyPoints where more than `most` would be needed."""
    rings, arms = rings_and_arms(phase, order)
    if rings * arms > most:
        raise TooManyPoints(
            f"{what} needs {rings * arms} pupil points, more than {most}: the phase turns {phase / (2 * math.pi):.0f} "
            "times along a pupil radius. Centre the window where the light lands (center='chief'), make it smaller, or "
            "use a ray model"
        )
    return gauss_rings(rings, arms, dtype=like.dtype, device=like.device)


def nodes_per_pixel(pitch: float, cutoff: float, order: int) -> int:
    """Gauss-Legendre nodes across a pixel for an intensity with spatial frequencies up to `cutoff` in 1/mm.

    n nodes integrate exp(iat) over [-1, 1] up to J_2n(a), a = π·cutoff·pitch. Order 0 has a margin of two nodes.
    """
    return max(1, math.ceil(0.5 * math.pi * cutoff * pitch) + 2 + order)


def sub_pixels(grid: Grid, nodes: int) -> tuple[Tensor, Tensor, Tensor]:
    """x (..., columns·nodes), y (..., rows·nodes) mm inside the pixels, and the weights (nodes) of a pixel, sum 1."""
    place, weight = (grid.pitch.new_tensor(a) / 2 for a in np.polynomial.legendre.leggauss(nodes))
    x, y = ((c[..., :, None] + place * grid.pitch).flatten(-2) for c in centres(grid))
    return x, y, weight


def integrate(intensity: Tensor, weight: Tensor, pitch: Tensor) -> Tensor:
    """Energy (..., rows, columns) of pixels from the intensity per mm² (..., rows·nodes, columns·nodes)."""
    nodes = len(weight)
    pixels = intensity.unflatten(-1, (-1, nodes)).unflatten(-3, (-1, nodes))
    return torch.einsum("...iajb,a,b->...ij", pixels, weight, weight) * pitch**2


def window_moments(intensity: Tensor, x: Tensor, y: Tensor, weight: Tensor, pitch: Tensor) -> tuple[Tensor, Tensor]:
    """Centroid (2, ...) mm and covariance (3, ...) mm², xx, xy, yy, of the light inside a window; 0 where there is no
    light.

    intensity: (..., Y, X) per mm² at the nodes x (..., X), y (..., Y) mm of `sub_pixels`; weight: of one pixel.
    """
    intensity = intensity * pitch**2
    along_x, along_y = (weight.repeat(t.shape[-1] // len(weight)) for t in (x, y))
    by_x, by_y = (intensity.mT @ along_y[:, None])[..., 0] * along_x, (intensity @ along_x[:, None])[..., 0] * along_y
    energy = by_x.sum(-1)
    x_mean, y_mean = safe_divide((by_x * x).sum(-1), energy), safe_divide((by_y * y).sum(-1), energy)
    x, y = x - x_mean[..., None], y - y_mean[..., None]
    cross = ((intensity @ (along_x * x)[..., None])[..., 0] * along_y * y).sum(-1)
    moments = [(by_x * x * x).sum(-1), cross, (by_y * y * y).sum(-1)]
    return torch.stack([x_mean, y_mean]), torch.stack([safe_divide(moment, energy) for moment in moments])


def _fraction(waves: Tensor) -> Tensor:
    return waves - torch.round(waves.detach())


class _Bessel(torch.autograd.Function):
    """J_0 or J_1: J₀' = -J₁; J₁' = J₀ - J₁/x, 1/2 at 0."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, number: int) -> Tensor:
        return (torch.special.bessel_j0, torch.special.bessel_j1)[number](x)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int], output: Tensor) -> None:
        x, ctx.number = inputs
        ctx.save_for_backward(x)
        ctx.save_for_forward(x)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return gradient * _bessel_slope(ctx.saved_tensors[0], ctx.number), None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: None) -> Tensor:
        return tangent * _bessel_slope(ctx.saved_tensors[0], ctx.number)


def _bessel_slope(x: Tensor, number: int) -> Tensor:
    if number == 0:
        return -bessel_j1(x)
    return bessel_j0(x) - torch.where(x == 0, 0.5, safe_divide(bessel_j1(x), x))


_HELPS = "give a larger {tol}, a smaller {size} or {pixel}, a slower aperture ({f_number}), {model=drt}"


def _speed(scene: Scene) -> str:
    return f"F/{float(axial_f_number(scene.lens).detach().abs().min()):.3g}"


def afford_rings(what: str, scene: Scene, rings: int, phase: float) -> None:
    """Raise OverBudget where so many Gauss rings exceed the memory budget; phase: radians along a pupil radius."""
    turns = phase / (2 * math.pi)
    need = f"{what} at {_speed(scene)} needs {rings:,} rings of the pupil: the phase turns {turns:,.0f} times"
    # A matrix n × n: the points that the rings serve grow alike.
    afford(24.0 * rings**2 + 128.0 * rings * math.prod(scene.shape), need, helps=_HELPS)


def afford_sensor(what: str, scene: Scene, grid: Grid, nodes: int) -> None:
    """Raise OverBudget where the light at `nodes`² points of each pixel exceeds the memory budget, field by field."""
    D, _, W = scene.shape
    rows, columns = grid.rows * nodes, grid.columns * nodes
    need = f"{what} at {_speed(scene)} needs {columns:,} × {rows:,} points of the sensor for {D * W} kernels"
    afford(64.0 * D * W * rows * columns, need, helps=_HELPS)
