"""DRT: the energy of traced rays integrated over pixels.

    E_ij = (1/π) ∬ [x(p) in pixel ij] [light passes at p] d²p,   p on the unit disc of the entrance pupil

Rays are traced on lines from the centre of the pupil to its rim. Between four neighbours lies a cell of the pupil; the
image of the cell is spread over the pixels, and cut by the apertures, in closed form (`splat_cells`). Pixel edges and
vignetting edges are thus crossed smoothly: no blur is needed for a derivative, and none is there.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.budget import afford
from raytrace.maths import pupil
from raytrace.maths.grid import Grid
from raytrace.maths.numerics import safe_divide
from raytrace.maths.value import value
from raytrace.psf_models.result import Kernels, moments
from raytrace.psf_models.splat import cell_energy, cell_widths, cells, clear_share, histogram, splat_cells, splat_smooth
from raytrace.system.apertures import Aperture, clearance
from raytrace.tracing.scene import Scene, beam_share, cross_scene, symmetry, trace_scene

_LINES = (16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)  # round the pupil, by order; half as many nodes on each
_CHUNK = 2**17  # cells that are deposited at once: 50 MB of temporaries
_FINEST = 4096  # cells across the pupil at most, when cells are wider than a pixel


@value
class Fans:
    """Image points of rays on A lines through the pupil, N nodes each, from its centre to its rim.

    points: (2, D, F, W, A, N) mm; radius: (N,) of the nodes, of the pupil.
    clearances: one (D, F, W, A, N) for each aperture, above 0 where light passes it; no unit.
    rays: how many were traced for each kernel.
    is_half: whether the lines are those of x > 0 and one more beyond either end, of light symmetric in x: cells between
        the outer two on either side are their own images, all others have one.
    """

    points: Tensor
    radius: Tensor
    clearances: tuple[Tensor, ...]
    rays: int
    is_half: bool = False


def kernels(
    scene: Scene,
    grid: Grid,
    *,
    order: int = 4,
    rays: int | None = None,
    sampling: Callable[..., tuple[Tensor, Tensor]] = pupil.sobol,
    width: float = 0.25,
) -> Kernels:
    """Ray-traced PSFs, differentiable in every number of the lens, the sensor distance and the grid.

    order: 0 … 10; each has twice the rays of the one before, and half its error.
    rays: instead, that many plain rays of `sampling` (`pupil.sobol`, `pupil.random`), each blurred by the kernel of
    `splat_smooth` of half width `width` pixels; a width of 0 is the histogram, which has no derivative.
    A kernel that no ray reaches has energy 0 and gradient 0. Vignetting factors of a field shrink the beam, and its
    energy with it.
    """
    if rays is None:
        return kernels_of_fans(scene, grid, trace_fans(scene, order), width=cell_width(order))
    like = scene.lens.surfaces[-2].thickness
    points, weights = sampling(rays, dtype=like.dtype, device=like.device)
    return dataclasses.replace(kernels_of_points(scene, grid, points, weights, width=width), rays=rays)


def trace_fans(scene: Scene, order: int) -> Fans:
    """Trace the rays of an order; of a scene symmetric in x half the pupil, of a rotational one a single line."""
    like = scene.lens.surfaces[-2].thickness
    angle, radius = lines(_LINES[order], _LINES[order] // 2, like)
    fold = symmetry(scene)
    seen = (
        like.new_tensor([torch.pi / 2]) if fold == "round" else angle[: len(angle) // 2] if fold == "mirror" else angle
    )
    disc = radius * torch.stack([torch.cos(seen), torch.sin(seen)])[..., None]
    hits, clearances = trace_clearances(scene, disc.flatten(1))
    hits, clearances = hits.unflatten(-1, disc.shape[1:]), [c.unflatten(-1, disc.shape[1:]) for c in clearances]
    if fold == "round":
        hits = turned(hits[1], angle)
        clearances = [c.expand(hits.shape[1:]) for c in clearances]
    elif fold == "mirror":
        hits = torch.cat([hits, torch.stack([-hits[0], hits[1]]).flip(-2)], -2)
        clearances = [torch.cat([c, c.flip(-2)], -2) for c in clearances]
    return Fans(hits, radius, tuple(clearances), disc[0].numel())


def lines(count: int, nodes: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Angles (A,) of lines round the pupil, those of x > 0 first; and radii (N + 1,), closer towards the rim."""
    return tuple(torch.as_tensor(t, dtype=like.dtype, device=like.device) for t in places(count, nodes))


def places(count: int, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """The same, as plain numbers."""
    angle = (np.arange(count) + 0.5) * (2 * np.pi / count) - np.pi / 2
    return angle, np.linspace(0, 1, nodes + 1) ** 0.75


def turned(height: Tensor, angle: Tensor) -> Tensor:
    """Points (2, ..., A, N) of one meridional line of image heights (..., 1, N), turned to pupil angles (A,)."""
    return torch.stack([height * torch.cos(angle)[:, None], height * torch.sin(angle)[:, None]])


def trace_clearances(scene: Scene, disc: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Hits (2, D, F, W, P) on the sensor of pupil points (2, P), and their clearances, each (D, F, W, P).

    A ray that misses a surface has the clearance -1 in the last one; that one is there only if some ray does.
    """
    hits, crossed, met = trace_apertures(scene, disc)
    clearances = [clearance(aperture, hit) for aperture, hit in crossed]
    if not bool(met.all()):
        clearances.append(torch.where(met, 1.0, -1.0).to(hits.dtype))
        hits = torch.where(met, hits, 0.0)
    return hits, clearances


def trace_apertures(scene: Scene, disc: Tensor) -> tuple[Tensor, list[tuple[Aperture, Tensor]], Tensor]:
    """Hits (2, D, F, W, P) on the sensor, on every aperture, and which rays met every surface; none is clipped.

    disc: pupil points (2, P), or (2, D, F, W, P) with axes of 1 where kernels have the same ones.
    """
    if not any(surface.apertures for surface in scene.lens.surfaces):
        rays = trace_scene(scene, disc)  # nothing to record on the way
        return rays.position[:2], [], rays.valid
    shape = (*scene.shape, disc.shape[-1])
    crossings = cross_scene(scene, disc)
    # Rays that do not start are lost before the first surface.
    met = crossings[0].rays.valid | crossings[0].clipped
    crossed = []
    for surface, crossing in zip(scene.lens.surfaces[1:], crossings, strict=True):
        met = met & ~crossing.missed & ~crossing.totally_reflected
        hit = crossing.rays.position[:2]
        crossed += [(aperture, hit.expand(2, *shape)) for aperture in surface.apertures]
    return hit.expand(2, *shape), crossed, met.expand(shape)


def cell_width(order: int) -> float:
    """Width in pixels of the cells that traced ones are cut into, at least: rays decide the error, not cells."""
    return min(1.0, 2.0 ** (1 - order / 2))


def kernels_of_fans(scene: Scene, grid: Grid, fans: Fans, *, width: float = 1.0) -> Kernels:
    """Energy, centroid and covariance of fans; all light through the pupil is 1.

    Cells wider than `width` pixels (at most 1) are cut, the image point running linearly between rays.
    """
    *widths, both = cell_widths(grid, fans.points, scene.largest)
    fine = refined(fans, [math.ceil(found * max(1 / width, both)) for found in widths])
    centroid, covariance = moments_of_fans(fans)
    kernel = energy_of_fans(grid, fine) * beam_share(scene)[..., None, None]
    return Kernels(kernel, grid, centroid, covariance, fans.rays)


def energy_of_fans(grid: Grid, fans: Fans) -> Tensor:
    """Energy (D, F, W, rows, columns) of fans whose cells are no wider than a pixel, some lines at a time.

    The window of half a fan is symmetric in x as well.
    """
    count = fans.points.shape[-2]
    if not fans.is_half:
        return _energy_of_lines(grid, fans, range(count + 1), count)
    whole = 2 * (count - 2)
    half = _energy_of_lines(grid, fans, range(1, count - 1), whole)
    own = [_energy_of_lines(grid, fans, range(first, first + 2), whole) for first in (0, count - 2)]
    return half + half.flip(-1) + sum(own)


def _energy_of_lines(grid: Grid, fans: Fans, lines: range, cells_round: int) -> Tensor:
    """Energy of the cells between these lines, of so many round the pupil."""
    count = fans.points.shape[-2]
    height = max(1, _CHUNK // fans.points[0, ..., 0, :].numel())
    if len(lines) > count and height >= count:
        return splat_cells(grid, fans.points, fans.radius, fans.clearances)
    kernel = 0.0
    for first in range(lines.start, lines.stop - 1, height):
        rows = torch.arange(first, min(first + height + 1, lines.stop), device=fans.points.device) % count
        points, *clearances = (t.index_select(-2, rows) for t in (fans.points, *fans.clearances))
        part = splat_cells(grid, points, fans.radius, clearances, closed=False)
        kernel = kernel + part * ((len(rows) - 1) / cells_round)
    return kernel


def refined(fans: Fans, parts: Sequence[int]) -> Fans:
    """The fans with every cell cut into so many parts across and along the lines, by linear interpolation."""
    limits = _FINEST // fans.points.shape[-2], _FINEST // fans.points.shape[-1]
    across, along = (max(1, min(part, limit)) for part, limit in zip(parts, limits, strict=True))
    *kernels, count, nodes = fans.points.shape[1:]
    # Points, clearances and what the last cut needs beside them: 33 bytes of a cell measured, with one clearance.
    afford_cells(kernels, count * across, nodes * along, each=16.0 * (2 + len(fans.clearances)))

    def cut(t: Tensor) -> Tensor:
        if across > 1:
            share = torch.arange(across, dtype=t.dtype, device=t.device)[:, None] / across
            t = (t[..., None, :] + share * (torch.roll(t, -1, -2) - t)[..., None, :]).flatten(-3, -2)
        return cut_line(t, along)

    points, *clearances = (cut(t) for t in (fans.points, *fans.clearances))
    return Fans(points, cut_line(fans.radius, along), tuple(clearances), fans.rays)


def afford_cells(kernels: Sequence[int], across: int, along: int, *, each: float) -> None:
    """Raise OverBudget where cells of the pupil narrow enough for the pixels, `each` so many bytes, are too much.

    kernels: (D, F, W); across, along: cells round the pupil and from its centre to its rim.
    """
    count = math.prod(kernels)
    afford(
        each * count * across * along,
        f"the ray-traced PSF needs {across:,} × {along:,} cells of the pupil for each of {count} kernels: the blur is "
        "wide beside a pixel",
        helps="give a larger `pixel`, fewer fields or wavelengths at once, `rays`, `model=gaussian`",
    )


def cut_line(t: Tensor, parts: int) -> Tensor:
    """Values (..., N) at nodes and at parts - 1 places between each two."""
    share = torch.arange(parts, dtype=t.dtype, device=t.device) / parts
    inner = (t[..., :-1, None] + share * t.diff()[..., None]).flatten(-2)
    return torch.cat([inner, t[..., -1:]], -1) if parts > 1 else t


def moments_of_fans(fans: Fans) -> tuple[Tensor, Tensor]:
    """Centroid (2, D, F, W) mm and covariance (3, D, F, W) mm² of the light of fans, no pixels and no window."""
    reference = fans.points[..., :1, :1].detach()
    if fans.is_half:
        reference = torch.stack([torch.zeros_like(reference[0]), reference[1]])
    closed = not fans.is_half
    (x, ax, bx), (y, ay, by) = (cells(t, fans.radius, closed=closed) for t in fans.points - reference)
    weights = cell_energy(fans.radius, x.shape[-2]) * clear_share(fans.clearances, fans.radius, closed=closed)
    weights = torch.as_tensor(weights).expand(x.shape)
    if fans.is_half:
        # All but the outer cells stand for two.
        weights = torch.cat([0.5 * weights[..., :1, :], weights[..., 1:-1, :], 0.5 * weights[..., -1:, :]], -2)
    share = safe_divide(weights, weights.sum((-2, -1), keepdim=True))
    mean_x, mean_y = ((share * t).sum((-2, -1), keepdim=True) for t in (x, y))
    mean_x = torch.zeros_like(mean_x) if fans.is_half else mean_x
    x, y = x - mean_x, y - mean_y
    pairs = (x * x + (ax * ax + bx * bx) / 3, x * y + (ax * ay + bx * by) / 3, y * y + (ay * ay + by * by) / 3)
    covariance = torch.stack([(share * pair).sum((-2, -1)) for pair in pairs])
    if fans.is_half:
        covariance = torch.stack([covariance[0], torch.zeros_like(covariance[1]), covariance[2]])
    lit = weights.sum((-2, -1)) > 0
    centroid = torch.stack([mean_x, mean_y])[..., 0, 0] + reference[..., 0, 0]
    return torch.where(lit, centroid, 0.0), covariance


def kernels_of_points(scene: Scene, grid: Grid, disc: Tensor, weights: Tensor, *, width: float) -> Kernels:
    """Kernels of plain rays through pupil points (2, P), by their weights (P,), shares of the light."""
    traced = trace_scene(scene, disc)
    energy = torch.where(traced.valid, weights, 0.0).expand(*scene.shape, -1)
    points = torch.where(traced.valid, traced.position[:2], 0.0).expand(2, *scene.shape, -1)
    light = beam_share(scene)
    kernel = deposit(grid, points, energy, width) * light[..., None, None]
    arrived = energy.sum(-1)
    share = safe_divide(energy, arrived[..., None].expand(energy.shape))
    # Counted from the first ray that arrives, a small spot far off the axis keeps its digits.
    first = (energy > 0) & ((energy > 0).to(torch.int64).cumsum(-1) == 1)
    reference = torch.where(first, points, 0.0).sum(-1, keepdim=True)
    centroid, covariance = moments(*torch.where(energy > 0, points - reference, 0.0), share)
    centroid = centroid + reference[..., 0]
    return Kernels(kernel, grid, centroid, covariance, disc.shape[-1], arrived=arrived * light)


def deposit(grid: Grid, points: Tensor, energy: Tensor, width: float) -> Tensor:
    """Energy in pixels of points blurred by a kernel of half width `width` pixels; 0: not blurred, no derivative."""
    return splat_smooth(grid, points, energy, width=width) if width else histogram(grid, points, energy)
