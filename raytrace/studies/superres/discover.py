"""Places that nobody prescribes: a plate learned for a small scene on a dark ground, by the exact error.

    y = A x + n,     e = tr (C⁻¹ + Aᵀ A/σ²)⁻¹ / n²

x are the n × n pixels of a scene and nothing around it, C = E[x xᵀ] their second moments, A all that the kernel and the
large pixels do to them: every pixel of a sensor as wide as the kernel reaches. No place, no number of places and no
view is part of it: an image shown several times, at other parts of a pixel, lowers e or does not.
"""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.imaging.restoration import psnr
from raytrace.imaging.variables import PhaseVariables
from raytrace.maths.value import detached
from raytrace.maths.zernike import noll, polynomials
from raytrace.studies.descent import minimise
from raytrace.studies.edof.world import WAVELENGTH, World, scene
from raytrace.studies.pictures import draws
from raytrace.studies.superres.experiment import Elements, plated, summed, wedges
from raytrace.tracing.scene import Memo
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.plan import plan

SIDE, WINDOW = 16, 49  # pixels of the picture along the scene, and along the kernel
_CELLS = 128  # of a plate, across the aperture
_TERMS = 45  # Noll's polynomials of a random start
_START = 28  # last number of the key of a random start
_NEAR = 2  # pixels about a peak that belong to its place
_LEAST = 0.04  # of the light: what a place holds


def moments(S: Tensor, side: int = SIDE) -> Tensor:
    """C (n², n²) of the pixels of a scene out of pictures of spectrum S (N, N)."""
    correlation = torch.fft.ifft2(S).real
    y, x = (axis.flatten() for axis in torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij"))
    return correlation[(y[:, None] - y) % S.shape[-2], (x[:, None] - x) % S.shape[-1]]


def matrix(kernel: Tensor, factor: int, side: int = SIDE) -> Tensor:
    """A (..., M², n²) of kernels (..., K, K), K odd, and pixels `factor` times as large: all that a scene reaches."""
    K = kernel.shape[-1]
    across = -(-(side + K - 1) // factor)
    # h averaged over a large pixel, whose first pixel lies d behind the point: a = -(s - 1) … K - 1.
    padded = torch.nn.functional.pad(kernel, (2 * factor,) * 4)
    averaged = torch.nn.functional.avg_pool2d(padded.flatten(0, -3)[:, None], factor, stride=1)[:, 0]
    row = factor * torch.arange(across)[:, None] - torch.arange(side) + 2 * factor
    row = row.clamp(0, averaged.shape[-1] - 1)  # beyond the kernel all is dark
    found = averaged[:, row][..., row]  # (B, M, n, M, n)
    return found.transpose(-3, -2).flatten(-4, -3).flatten(-2).unflatten(0, kernel.shape[:-2])


def exact_error(kernel: Tensor, C: Tensor, noise: float, factor: int) -> Tensor:
    """Mean square error of a pixel behind the best linear restoration from all pixels; mean over kernels (W, K, K)."""
    root = torch.linalg.cholesky(C)
    inner, _ = _inner(kernel, root, noise, factor)
    half = torch.linalg.solve_triangular(inner, root.T.expand_as(inner), upper=False)
    return half.square().sum((-2, -1)).mean() / len(C)


@torch.no_grad()
def errors_of_scenes(kernel: Tensor, C: Tensor, noise: float, factor: int, scenes: Tensor) -> Tensor:
    """Mean square error (B, W) of scenes (B, n²) behind that restoration, expected over noise:

    x̂ - x = -M⁻¹ C⁻¹ x + M⁻¹ Aᵀ n/σ²,     M = C⁻¹ + Aᵀ A/σ²
    """
    root = torch.linalg.cholesky(C)
    inner, seen = _inner(kernel, root, noise, factor)
    white = torch.linalg.solve_triangular(root, scenes.T, upper=False)
    left = root @ torch.cholesky_solve(white.expand(len(inner), -1, -1), inner)  # (W, n², B)
    added = root @ torch.cholesky_solve(seen.mT, inner) / noise
    return (left.square().sum(-2).T + added.square().sum((-2, -1))) / len(C)


def _inner(kernel: Tensor, root: Tensor, noise: float, factor: int) -> tuple[Tensor, Tensor]:
    """Cholesky factors (W, n², n²) of Lᵀ M L, C = L Lᵀ, and A L (W, M², n²)."""
    seen = matrix(kernel, factor, math.isqrt(len(root))) @ root
    return torch.linalg.cholesky(torch.eye(len(root), dtype=root.dtype) + seen.mT @ seen / noise**2), seen


def random_path(world: World, waves: float, *, seed: int) -> Tensor:
    """Noll's polynomials from tilt on, drawn, of so many waves RMS in all: (cells, cells) mm."""
    line = (torch.arange(_CELLS, dtype=torch.float64) - 0.5 * (_CELLS - 1)) * (2 / _CELLS)
    shapes = polynomials(
        [noll(j) for j in range(2, _TERMS + 1)], line.expand(_CELLS, -1), line[:, None].expand(-1, _CELLS)
    )
    drawn = torch.as_tensor(draws(seed, _START).standard_normal(_TERMS - 1))
    path = torch.tensordot(drawn / drawn.norm(), shapes, 1)
    inside = line**2 + (line**2)[:, None] <= 1
    return 1e-3 * WAVELENGTH * waves * torch.where(inside, path, 0.0)


class Error:
    """The exact error of plates in one world, and their kernels; what heights do not change is kept."""

    def __init__(self, world: World, C: Tensor, factor: int):
        self.world, self.C, self.factor, self._memo = dataclasses.replace(world, size=WINDOW), C, factor, Memo()
        self._plan = plan(self._scene(plated(world, torch.zeros(_CELLS, _CELLS).double())), engine="pupil",
                          samples=_CELLS, nodes=4)  # fmt: skip

    def _scene(self, elements: Elements):
        return scene(elements, self.world)

    def kernels(self, elements: Elements) -> Tensor:
        """(W, K, K)."""
        return psf(self._scene(elements), plan=self._plan, memo=self._memo).kernel[0]

    def __call__(self, elements: Elements) -> Tensor:
        return exact_error(self.kernels(elements), self.C, self.world.noise, self.factor)


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a kernel shows the scene: pixels of the picture from the axis, and the light it holds there."""

    row: float
    column: float
    light: float


def places_in(kernel: Tensor) -> list[Place]:
    """Peaks of a kernel (K, K) that hold enough of its light, the brightest first, none within another's pixels."""
    left, found, total = kernel.clone(), [], float(kernel.sum())
    near, line = 2 * _NEAR + 1, torch.arange(kernel.shape[-1]) - kernel.shape[-1] // 2
    while True:
        sums = torch.nn.functional.avg_pool2d(left[None], near, 1, _NEAR, divisor_override=1)[0]
        y, x = divmod(int(sums.argmax()), left.shape[-1])
        if float(sums[y, x]) < _LEAST * total:
            return found
        rows, columns = (slice(max(0, n - _NEAR), n + _NEAR + 1) for n in (y, x))
        part = left[rows, columns]
        light = float(part.sum())
        place = [float((part.sum(axis) * line[cut]).sum()) / light for axis, cut in ((1, rows), (0, columns))]
        found.append(Place(*place, light / total))
        left[rows, columns] = 0


@dataclasses.dataclass(frozen=True)
class Found:
    """A plate: how it began, dB of its expected error at the start and as learned; its places in the middle colour, and
    its kernels (W, K, K)."""

    start: str
    before: float
    after: float
    places: tuple[Place, ...]
    kernel: Tensor = dataclasses.field(repr=False, compare=False)

    def record(self) -> dict:
        row = {"start": self.start, "before": self.before, "after": self.after, "places": len(self.places)}
        return row | {"light_in_places": sum(place.light for place in self.places)}


def discover(name: str, path: Tensor, error: Error, *, steps: int) -> Found:
    """Heights of all cells from a plate's own to the least exact error; steps 0: the plate as it is."""
    elements = plated(error.world, path)
    before = float(error(elements).detach())
    variables = PhaseVariables(elements[0], unit=0.1, others=elements[1:])
    if steps:
        minimise([variables.change], lambda: error(variables()), steps=steps)
    with torch.no_grad():
        own = detached(variables())
        kernel, after = error.kernels(own), float(error(own))
    middle = kernel[len(kernel) // 2]
    return Found(name, *(float(psnr(torch.tensor(e))) for e in (before, after)), tuple(places_in(middle)), kernel)


def starts(world: World, *, spreads: Sequence[float], seeds: int, factor: int) -> list[tuple[str, Tensor, bool]]:
    """Name, path and whether it is learned: the plain lens, prescribed places, random paths."""
    flat = torch.zeros(_CELLS, _CELLS, dtype=torch.float64)
    half = 0.5 * SIDE
    four = half * torch.tensor([[-1.0, -1], [-1, 1], [1, -1], [1, 1]]).double()
    four = four + 0.5 * factor * torch.tensor([[0.0, 0], [0, 1], [1, 0], [1, 1]]).double()
    prescribed = summed(wedges(world, four, _CELLS), 0, len(four), _START)
    return [
        ("plain lens", flat, False),
        ("4 prescribed places", prescribed, False),
        ("4 prescribed places, learned", prescribed, True),
        ("from the plain lens", flat, True),
        *(
            (f"from {waves:g} waves RMS, start {seed}", random_path(world, waves, seed=seed), True)
            for waves in spreads
            for seed in range(seeds)
        ),
    ]
