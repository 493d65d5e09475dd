"""The direct Huygens sum: every ray a wavelet on the reference sphere, summed at every point of every pixel.

    U(p) = (n/λ) Σ_j √(E_j Ω_j) exp(2πi n [W_j/n + |q_j - p| - R]/λ),   kernel = ∫ |U|² over the pixel

It is the reference of the wave model, and shares only the traced wavefront W with it. Distances are exact (the model
uses Debye's plane waves), Ω is by differences of neighbouring rays, the rim of the pupil by bisection, no symmetry is
used. One object distance, field and wavelength; no gradients.
"""

import dataclasses
import math
from collections.abc import Callable

import torch
from torch import Tensor

from raytrace.maths.sampling import Grid, gauss_rings, square
from raytrace.psf_models.dft import huygens, nodes_per_pixel, rings_and_arms, sub_pixels
from raytrace.psf_models.wave import phase_along_radius
from raytrace.tracing.scene import Scene, trace_scene
from raytrace.tracing.wavefront import wavefront_of

_TERMS = 2**21  # wavelets × points that are added at once
_STEP = 1e-4  # of the pupil radius, for Ω
_SCAN, _BISECTIONS = 64, 48


@dataclasses.dataclass(frozen=True)
class Sampling:
    """rings, arms: Gauss rings over the clear pupil; arms = 0: a square grid of `rings` points across; nodes: points
    across a pixel, Gauss-Legendre.
    """

    rings: int
    arms: int
    nodes: int

    def scaled(self, part: float, nodes: int = 0) -> "Sampling":
        """A part of the rings and arms, at least 4 and 8, and so many nodes more, at least 2."""
        arms = max(8, 4 * round(part * self.arms / 4))
        return Sampling(max(4, round(part * self.rings)), arms, max(2, self.nodes + nodes))

    def __str__(self) -> str:
        pupil = f"{self.rings} × {self.arms} rings" if self.arms else f"{self.rings}² grid"
        return f"{pupil}, {self.nodes}² a pixel"


@torch.no_grad()
def sampling_of(scene: Scene, grid: Grid) -> Sampling:
    """Rings, arms and nodes of the wave model at order 0, from the phase over the pupil. Raises ValueError."""
    front = wavefront_of(scene, *gauss_rings(8, 32))
    offset = torch.linalg.vector_norm(grid.centre - front.centre[:2, 0, 0, 0])
    reach = float(offset + grid.pitch * math.hypot(grid.rows, grid.columns) / 2)
    L, M = front.direction[:2, 0, 0, 0]
    spread = torch.hypot(L - L.mean(), M - M.mean()).max()
    cutoff = 2e3 * float(spread * front.index[0] / front.wavelength[0])
    rings, arms = rings_and_arms(phase_along_radius(front, reach), 0)
    return Sampling(rings, arms, nodes_per_pixel(float(grid.pitch), cutoff, 0))


def reference(scene: Scene, grid: Grid) -> Tensor:
    """The converged kernel (rows, columns) of a scene of shape (1, 1, 1). Raises ValueError."""
    known = sampling_of(scene, grid)
    return direct_sum(scene, grid, Sampling(known.rings + 4, known.arms + 16, known.nodes).scaled(0.75, 2))[0]


@torch.no_grad()
def direct_sum(scene: Scene, grid: Grid, sampling: Sampling) -> tuple[Tensor, int]:
    """Kernel (rows, columns) of a scene of shape (1, 1, 1), and the number of rays."""
    like = scene.lens.surfaces[-2].thickness
    points, weights = (
        clear_rings(scene, sampling.rings, sampling.arms)
        if sampling.arms
        else square(sampling.rings, dtype=like.dtype, device=like.device)
    )
    front = wavefront_of(scene, points, weights)
    amplitude = torch.sqrt(front.energy * weights * math.pi * solid_angle(scene, points))[0, 0, 0]
    lit = amplitude > 0
    pupil = (-front.radius * front.direction)[:, 0, 0, 0][:, lit]
    about = Grid(grid.pitch, grid.rows, grid.columns, grid.centre - front.centre[:2, 0, 0, 0])
    x, y, share = sub_pixels(about, sampling.nodes)
    v, h = (t.flatten() for t in torch.meshgrid(y, x, indexing="ij"))
    wavelength = 1e-3 * front.wavelength[0] / front.index[0]
    path, radius = front.opd[0, 0, 0][lit] / front.index[0], front.radius[0, 0, 0]
    size = max(1, _TERMS // int(lit.sum()))
    intensity = []
    for a, b in zip(h.split(size), v.split(size), strict=True):
        places = torch.stack([a, b, torch.zeros_like(a)])
        U = huygens(places, pupil, radius, path=path, amplitude=amplitude[lit], wavelength=wavelength)
        intensity.append((U.real**2 + U.imag**2) / wavelength**2)
    fine = torch.cat(intensity).reshape(grid.rows, sampling.nodes, grid.columns, sampling.nodes)
    return torch.einsum("iajb,a,b->ij", fine, share, share) * grid.pitch**2, points.shape[1]


@torch.no_grad()
def clear_rings(scene: Scene, rings: int, arms: int) -> tuple[Tensor, Tensor]:
    """Gauss rings of every arm between the inner and outer radius of its clear pupil: (2, P), (P,)."""
    like = scene.lens.surfaces[-2].thickness
    points, weights = gauss_rings(rings, arms, dtype=like.dtype, device=like.device)
    angle = (torch.arange(arms, dtype=like.dtype, device=like.device) + 0.5) * (2 * math.pi / arms)
    unit = torch.stack([torch.cos(angle), torch.sin(angle)])

    def passes(radius: Tensor) -> Tensor:
        """(K, arms) for radii (K, arms)."""
        disc = (unit[:, None] * radius).flatten(1)
        return trace_scene(scene, disc).valid[0, 0, 0].unflatten(0, radius.shape)

    scan = torch.linspace(0, 1, _SCAN + 1, dtype=like.dtype, device=like.device)
    clear = passes(scan[:, None].expand(-1, arms))
    if bool(clear.all()):
        return points, weights
    first, last = clear.to(torch.int8).argmax(0), _SCAN - clear.flip(0).to(torch.int8).argmax(0)
    inner = _bisect(passes, scan[first], scan[(first - 1).clamp_min(0)])
    outer = _bisect(passes, scan[last], scan[(last + 1).clamp_max(_SCAN)])
    area = torch.where(clear.any(0), outer**2 - inner**2, 0.0)
    u = (points**2).sum(0).reshape(rings, arms)
    radius = torch.sqrt(inner**2 + area * u)
    return (unit[:, None] * radius).flatten(1), (area * weights.reshape(rings, arms)).flatten()


def _bisect(passes: Callable[[Tensor], Tensor], clear: Tensor, dark: Tensor) -> Tensor:
    """The radius (arms) of the edge between clear and dark; both are the same if there is none."""
    for _ in range(_BISECTIONS):
        middle = 0.5 * (clear + dark)
        through = passes(middle[None])[0]
        clear, dark = torch.where(through, middle, clear), torch.where(through, dark, middle)
    return clear


def solid_angle(scene: Scene, points: Tensor) -> Tensor:
    """|∂(L, M)/∂(p_x, p_y)| (P,) at pupil points, by central differences of traced directions."""
    steps = points.new_tensor([[_STEP, 0.0], [-_STEP, 0.0], [0.0, _STEP], [0.0, -_STEP]])
    ends = wavefront_of(scene, torch.cat([points + step[:, None] for step in steps], 1)).direction[:2, 0, 0, 0]
    right, left, up, down = ends.unflatten(1, (4, -1)).unbind(1)
    (a, b), (c, d) = (right - left) / (2 * _STEP), (up - down) / (2 * _STEP)
    return (a * d - b * c).abs()


@torch.no_grad()
def moments(scene: Scene, rings: int = 96, arms: int = 384) -> tuple[Tensor, Tensor, Tensor]:
    """Converged moments of the rays of a scene of shape (1, 1, 1): centroid (2,) mm, variance (2,) mm² along x and y,
    and the share of the entrance pupil's light that arrives."""
    points, weights = clear_rings(scene, rings, arms)
    hits = trace_scene(scene, points)
    passed = torch.where(hits.valid[0, 0, 0], weights, 0.0)
    share = passed / passed.sum()
    x = hits.position[:2, 0, 0, 0]
    centroid = ((x - x[:, :1]) * share).sum(1) + x[:, 0]
    return centroid, (share * (x - centroid[:, None]) ** 2).sum(1), passed.sum()
