"""DRT PSF model (differentiable ray tracing): the energy of all traced rays, integrated over pixels.

    E_ij = (1/π) ∬ [x(p) in pixel ij] [p is not vignetted] d²p,   p on the unit disc of the entrance pupil

The pupil is divided into cells between radial lines of ray points. The image of a cell is a parallelogram whose energy
in every pixel, and whose vignetted share, are integrated in closed form (`splat_cells`). A moving pixel or aperture
edge therefore changes the PSF smoothly: derivatives need no blur.

The ray map x(p) is a polynomial fitted to a few dozen traced rays,

    x(ρ, θ) = Σ_mj c_mj ρ^m T_j(2ρ² - 1) {cos mθ, sin mθ},   m + 2j <= degree

with as many rays as coefficients, on concentric rings where interpolation is well-conditioned (Ramos-López, Sánchez-
Granero, Fernández-Martínez and Martínez-Finkelshtein, Appl. Math. Comput. 274, 2016), so that the fit is one constant
matrix. Further rays check it. The crossing points in every aperture are mapped in the same way. Where no polynomial
fits, the cells are traced (`trace_fans`).
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.budget import afford
from raytrace.maths.numerics import broadcast_shape, safe_divide, value, varies
from raytrace.maths.sampling import Grid, sobol
from raytrace.psf_models.radial import energy_of_rings, is_centred, lit_part, unfold
from raytrace.psf_models.result import Kernels, moments_of_rays
from raytrace.system.apertures import Aperture, clearance
from raytrace.system.lens import with_object_distance
from raytrace.tracing import streaming
from raytrace.tracing.scene import Scene, beam_share, symmetry, trace_apertures, trace_scene

_RAY_WIDTH = 0.25  # half width in pixels of an independent ray, for a derivative


def splat(grid: Grid, points: Tensor, weights: Tensor) -> Tensor:
    """Bilinear deposition: each point shares its weight between the four nearest pixel centres.

    The point is a box one pixel wide, which adds pitch²/12 to the variance per axis. A point on a pixel centre has the
    derivative of the side towards larger coordinates.
    points: (2, ..., P) mm; weights: (P,) or (..., P); returns (..., rows, columns), without points outside the window.
    """

    def between_centres(u: Tensor, count: int) -> tuple[Tensor, Tensor]:
        u = torch.where((u > -1) & (u < count), u, -1.0)  # a NaN is outside
        below = torch.floor(u).detach()
        return below.long(), u - below

    return _shared(grid, weights, *(between_centres(u - 0.5, n) for u, n in _in_pixels(grid, points)))


def splat_smooth(grid: Grid, points: Tensor, weights: Tensor, *, width: float) -> Tensor:
    """Energy in each pixel of points blurred by a kernel smaller than a pixel; twice differentiable.

        k(t) = 15/16 (1 - t²)²,  t = x/(width·pitch),   ∫_{-1}^{t} k = s³(10 - 15 s + 6 s²),  s = (t + 1)/2

    width: half width of the kernel in pixels, 0 < width <= 1/2; it adds (width·pitch)²/7 to the variance per axis.
    points, weights and result as for `splat`.
    """

    def about_edges(u: Tensor, count: int) -> tuple[Tensor, Tensor]:
        u = torch.where((u > -0.5) & (u < count + 0.5), u, -0.5)
        edge = torch.floor(u + 0.5).detach()
        s = (0.5 + (u - edge) / (2 * width)).clamp(0, 1)
        return edge.long() - 1, s * s * s * (10 - s * (15 - 6 * s))

    return _shared(grid, weights, *(about_edges(u, n) for u, n in _in_pixels(grid, points)))


def histogram(grid: Grid, points: Tensor, weights: Tensor) -> Tensor:
    """Energy of the points in each pixel, without derivative in their positions; arguments as for `splat`."""
    pixels = ((torch.floor(u), count) for u, count in _in_pixels(grid, points))
    # -1 or `count`, outside the window, for all points further out and for NaN.
    column, row = (torch.where(torch.isfinite(u), u.clamp(-1, count), -1.0).long() for u, count in pixels)
    return _deposit(grid, column, row, [weights])


def splat_cells(
    grid: Grid, points: Tensor, radius: Tensor, clearances: Sequence[Tensor] = (), *, closed: bool = True
) -> Tensor:
    """Energy in each pixel of the images of small pupil cells, each between two lines and two radii.

    To first order the image of a cell is a parallelogram c ± a ± b; on a caustic it folds to a segment or a point.
    Along x it has the density of the sum of two uniform variables of half widths |a_x| and |b_x|, so its share on
    either side of a pixel edge is exact. At a pixel corner the joint share F_x F_y + cov f_x f_y is used, whose mean
    over all positions of the corner is exact (Hoeffding), clamped to the range that the marginal shares allow.

    points: (2, ..., A, N) mm, N nodes on each of A lines at equal angles; radius: (N,) of the nodes.
    clearances: each (..., A, N), positive where light passes; the share of a cell below 0 is cut away.
    closed: whether the last line is followed by the first; otherwise it is the first line one turn later.
    A cell may be at most one pixel wide (`cell_widths`).
    """
    lines = points.shape[-2] - (0 if closed else 1)
    energy = cell_energy(radius, lines) * clear_share(clearances, radius, closed=closed)
    pixels = ((cells(u, radius, closed=closed), count) for u, count in _in_pixels(grid, points))
    (column, right, dense_x, ax, bx), (row, up, dense_y, ay, by) = (_shares(*cell, count) for cell, count in pixels)
    both = right * up + (ax * ay + bx * by) / 3 * dense_x * dense_y
    both = torch.maximum(torch.minimum(both, torch.minimum(right, up)), (right + up - 1).clamp_min(0))
    shares = (1 - right - up + both, right - both, up - both, both)
    return _deposit(grid, column, row, [energy * share for share in shares], axes=2)


def cell_widths(grid: Grid, points: Tensor, largest: Callable[[Tensor], Tensor]) -> tuple[float, float, float]:
    """Width in pixels of the widest cell of points (2, ..., A, N), across and along the lines; and their joint factor.

    The factor, 1 … 2, is the largest sum of both widths of one cell, each relative to its maximum: if the number of
    parts that each width requires is multiplied by it, no cell is wider than a pixel. largest: see `Scene`.
    """
    w = points.detach() / grid.pitch.detach()
    across, along = (torch.roll(w, -1, -2) - w).abs(), w.diff().abs()
    sides = torch.maximum(across[..., 1:], across[..., :-1]), torch.maximum(along, torch.roll(along, -1, -2))
    widest = largest(torch.stack([side.amax() for side in sides])).unbind()
    first, second = (safe_divide(side, most.expand_as(side)) for side, most in zip(sides, widest, strict=True))
    return float(widest[0]), float(widest[1]), max(1.0, float(largest((first + second).amax())))


def cells(w: Tensor, radius: Tensor, *, closed: bool = True) -> tuple[Tensor, Tensor, Tensor]:
    """Energy centroid and half vectors along and across (..., A, N - 1) of the cells of a map w (..., A, N)."""
    after, before = (torch.roll(w, -1, -2), w) if closed else (w[..., 1:, :], w[..., :-1, :])
    both, difference = after + before, after - before
    across, along = 0.25 * (difference[..., 1:] + difference[..., :-1]), 0.25 * both.diff()
    # Energy grows with the pupil radius: the centroid lies outside the middle of a cell.
    outward = radius.diff() / (3 * (radius[1:] + radius[:-1]))
    return 0.25 * (both[..., 1:] + both[..., :-1]) + outward * along, along, across


def cell_energy(radius: Tensor, lines: int) -> Tensor:
    """Share (N - 1) of the pupil in each cell between radii (N,) and two of `lines` lines."""
    return radius.diff() * (radius[1:] + radius[:-1]) / lines


def clear_share(clearances: Sequence[Tensor], radius: Tensor, *, closed: bool = True) -> Tensor | float:
    """Unvignetted share (..., A, N - 1) of each cell; clearances (..., A, N)."""
    parts = (cells(values, radius, closed=closed) for values in clearances)
    shares = [1 - below_edge(-centre, along, across)[0] for centre, along, across in parts]
    return functools.reduce(torch.minimum, shares) if shares else 1.0


def below_edge(z: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """P(a s + b t < z) for s, t uniform in [-1, 1], and its derivative in z, the density there.

        p = max(|a|, |b|), q = min(|a|, |b|):  1/2 + z/2p for |z| < p - q;  a tail of (p + q - |z|)²/8pq beyond

    Finite for a = b = 0, where the density is 0.
    """
    p, q = torch.maximum(a.abs(), b.abs()), torch.minimum(a.abs(), b.abs())
    distance = z.abs()
    middle = distance <= p - q
    on_end = ~middle & (distance < p + q)
    wide = middle & (p > 0)
    straight = 0.5 - 0.5 * torch.where(wide, distance, 0.0) / torch.where(wide, p, 1.0)
    reach = torch.where(on_end, p + q - distance, 0.0)
    tail = torch.where(middle, straight, reach * reach / torch.where(on_end, 8 * p * q, 1.0))
    end = reach / torch.where(on_end, 4 * p * q, 1.0)
    density = torch.where(wide, 0.5 / torch.where(p > 0, p, 1.0), end)
    return torch.where(z > 0, 1 - tail, tail), density


def _shares(centre: Tensor, along: Tensor, across: Tensor, count: int) -> tuple[Tensor, ...]:
    """The pixel below the edge nearest to each cell, the cell's share beyond it, the density there, and the cell."""
    reached = (centre > -1) & (centre < count + 1)
    centre = torch.where(reached, centre, -1.0)
    edge = torch.round(centre).detach()
    below, density = below_edge(edge - centre, along, across)
    return edge.long() - 1, 1 - below, density, along, across


def _in_pixels(grid: Grid, points: Tensor) -> Iterator[tuple[Tensor, int]]:
    """x, then y, in pixels (pixel i covers i to i + 1), with the count; batch axes of the grid precede the points'."""
    for like, centre, count in zip(points, grid.centre, grid.shape[::-1], strict=True):
        pair = (t.reshape(*t.shape, *(1,) * (like.dim() - t.dim())) if t.dim() else t for t in (centre, grid.pitch))
        centre, pitch = pair
        yield (like - centre) / pitch + 0.5 * count, count


def _shared(grid: Grid, weights: Tensor, along_x: tuple[Tensor, Tensor], along_y: tuple[Tensor, Tensor]) -> Tensor:
    """Pixels of weights whose shares of the next pixel along x and y, (pixel, share), are independent."""
    (column, right), (row, up) = along_x, along_y
    right, left = weights * right, weights * (1 - right)
    return _deposit(grid, column, row, [left * (1 - up), right * (1 - up), left * up, right * up])


def _deposit(grid: Grid, column: Tensor, row: Tensor, energies: list[Tensor], *, axes: int = 1) -> Tensor:
    """Pixels (..., rows, columns) of energies (..., P) in (column, row) and its neighbours right, above and both."""
    batch, dropped = broadcast_shape(column.shape, row.shape)[:-axes], grid.rows * grid.columns
    image = energies[0].new_zeros(*batch, dropped + 1)
    for (right, up), energy in zip(((0, 0), (1, 0), (0, 1), (1, 1)), energies, strict=False):
        i, j = column + right, row + up
        inside = (i >= 0) & (i < grid.columns) & (j >= 0) & (j < grid.rows)
        place = torch.where(inside, j * grid.columns + i, dropped).flatten(-axes)
        energy = energy.expand(inside.shape).flatten(-axes)
        image = image.scatter_add(-1, place, energy)
    return image[..., :-1].unflatten(-1, grid.shape)


_LINES = (16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)  # by order; half as many nodes on each
_CHUNK = 2**17  # cells deposited at once: 50 MB of temporaries
_FINEST = 4096  # cells across the pupil at most


@value
class Fans:
    """Image points of rays on A radial lines of the pupil, N nodes each, from the centre to the rim.

    points: (2, D, F, W, A, N) mm; radius: (N,) of the nodes, in pupil radii.
    clearances: one (D, F, W, A, N) for each aperture, positive where light passes, dimensionless.
    rays: number traced for each kernel.
    is_half: the light is symmetric in x, and the lines are those of x > 0 and one more beyond either end: the cells
    between the outer two lines on either side are their own mirror images; all other cells have one.
    """

    points: Tensor
    radius: Tensor
    clearances: tuple[Tensor, ...]
    rays: int
    is_half: bool = False


def kernels_of_rays(
    scene: Scene,
    grid: Grid,
    *,
    order: int = 4,
    rays: int | None = None,
    sampling: Callable[..., tuple[Tensor, Tensor]] = sobol,
    width: float = _RAY_WIDTH,
) -> Kernels:
    """PSFs of traced rays, without the polynomial map; differentiable in the lens, the sensor distance and the grid.

    order: 0 … 10; each has twice the rays of the one before, and half its error. rays: instead, that many independent
    rays of `sampling` (`sobol`, `random`), each blurred by `splat_smooth` of half width `width` pixels; 0
    is the histogram, without derivative. A kernel that no ray reaches has energy 0 and gradient 0.
    """
    if rays is None:
        return kernels_of_fans(scene, grid, trace_fans(scene, order), width=cell_width(order))
    like = scene.lens.surfaces[-2].thickness
    points, _ = sampling(rays, dtype=like.dtype, device=like.device)
    return kernels_of_points(scene, grid, points, width=width, rays=rays)


def trace_fans(scene: Scene, order: int) -> Fans:
    """Trace the rays of an order: half the pupil of a scene symmetric in x, a single line of a rotational one."""
    like = scene.lens.surfaces[-2].thickness
    angle, radius = (like.new_tensor(t) for t in pupil_lines(_LINES[order], _LINES[order] // 2))
    fold = symmetry(scene)
    traced = {"round": like.new_tensor([torch.pi / 2]), "mirror": angle[: len(angle) // 2], "none": angle}[fold]
    disc = radius * torch.stack([torch.cos(traced), torch.sin(traced)])[..., None]
    hits, clearances = trace_clearances(scene, disc.flatten(1))
    hits, clearances = hits.unflatten(-1, disc.shape[1:]), [c.unflatten(-1, disc.shape[1:]) for c in clearances]
    if fold == "round":
        hits = rotated(hits[1], angle)
        clearances = [c.expand(hits.shape[1:]) for c in clearances]
    elif fold == "mirror":
        hits = torch.cat([hits, torch.stack([-hits[0], hits[1]]).flip(-2)], -2)
        clearances = [torch.cat([c, c.flip(-2)], -2) for c in clearances]
    return Fans(hits, radius, tuple(clearances), disc[0].numel())


def pupil_lines(count: int, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles (A,) of lines round the pupil, those of x > 0 first; and radii (N + 1,), denser towards the rim."""
    angle = (np.arange(count) + 0.5) * (2 * np.pi / count) - np.pi / 2
    return angle, np.linspace(0, 1, nodes + 1) ** 0.75


def rotated(height: Tensor, angle: Tensor) -> Tensor:
    """Points (2, ..., A, N) of a meridional line of image heights (..., 1, N), rotated to pupil angles (A,)."""
    return torch.stack([height * torch.cos(angle)[:, None], height * torch.sin(angle)[:, None]])


def trace_clearances(scene: Scene, disc: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Image points (2, D, F, W, P) on the sensor of pupil points (2, P), and their clearances, each (D, F, W, P).

    If any ray misses a surface or is totally reflected, a last clearance is -1 for such rays and 1 for the others.
    """
    hits, crossed, met = trace_apertures(scene, disc)
    clearances = [clearance(aperture, hit) for aperture, hit in crossed]
    if not bool(met.all()):
        clearances.append(torch.where(met, 1.0, -1.0).to(hits.dtype))
        hits = torch.where(met, hits, 0.0)
    return hits, clearances


def cell_width(order: int) -> float:
    """Smallest cell width in pixels at an order: the number of rays limits the error, not the cells."""
    return min(1.0, 2.0 ** (1 - order / 2))


def kernels_of_fans(scene: Scene, grid: Grid, fans: Fans, *, width: float = 1.0) -> Kernels:
    """Energy, centroid and covariance of fans; all light through the pupil is 1.

    Cells wider than `width` pixels (at most 1) are divided by linear interpolation of the image points.
    """
    *widths, both = cell_widths(grid, fans.points, scene.largest)
    fine = refined(fans, [math.ceil(cell * max(1 / width, both)) for cell in widths])
    kernel, light = energy_of_fans(grid, fine), beam_share(scene)
    centroid, covariance, arrived = moments_of_fans(fans)
    return Kernels(kernel * light[..., None, None], grid, centroid, covariance, fans.rays, arrived * light)


def energy_of_fans(grid: Grid, fans: Fans) -> Tensor:
    """Energy (D, F, W, rows, columns) of fans whose cells are no wider than a pixel, processed in chunks of lines.

    The window of a half fan must be symmetric in x too.
    """
    count = fans.points.shape[-2]
    height = max(1, _CHUNK // fans.points[0, ..., 0, :].numel())

    def between(first: int, last: int, cells_round: int) -> Tensor:
        kernel = torch.zeros_like(fans.radius[0])
        for start in range(first, last, height):
            rows = torch.arange(start, min(start + height, last) + 1, device=fans.points.device) % count
            points, *clearances = (t.index_select(-2, rows) for t in (fans.points, *fans.clearances))
            part = splat_cells(grid, points, fans.radius, clearances, closed=False)
            kernel = kernel + part * ((len(rows) - 1) / cells_round)
        return kernel

    if not fans.is_half:
        if height >= count:
            return splat_cells(grid, fans.points, fans.radius, fans.clearances)
        return between(0, count, count)
    whole = 2 * (count - 2)
    half = between(1, count - 2, whole)
    return half + half.flip(-1) + (between(0, 1, whole) + between(count - 2, count - 1, whole))


def refined(fans: Fans, parts: Sequence[int]) -> Fans:
    """The fans with every cell divided into `parts` across and along the lines, by linear interpolation."""
    limits = _FINEST // fans.points.shape[-2], _FINEST // fans.points.shape[-1]
    across, along = (max(1, min(part, limit)) for part, limit in zip(parts, limits, strict=True))
    *kernels, count, nodes = fans.points.shape[1:]
    # Points, clearances and temporaries of the last division: 33 bytes per cell measured, with one clearance.
    afford_cells(kernels, count * across, nodes * along, each=16.0 * (2 + len(fans.clearances)))

    def cut(t: Tensor) -> Tensor:
        if across > 1:
            share = torch.arange(across, dtype=t.dtype, device=t.device)[:, None] / across
            t = (t[..., None, :] + share * (torch.roll(t, -1, -2) - t)[..., None, :]).flatten(-3, -2)
        return cut_line(t, along)

    points, *clearances = (cut(t) for t in (fans.points, *fans.clearances))
    return Fans(points, cut_line(fans.radius, along), tuple(clearances), fans.rays)


def afford_cells(kernels: Sequence[int], across: int, along: int, *, each: float) -> None:
    """Raise OverBudget if (D, F, W) kernels of across × along pupil cells, `each` bytes, exceed the memory budget."""
    count = math.prod(kernels)
    need = f"the ray-traced PSF needs {across:,} × {along:,} pupil cells for each of {count} kernels"
    helps = "give a larger {pixel}, fewer fields or wavelengths at once, {rays}, {model=gaussian}"
    afford(each * count * across * along, f"{need}: the blur spans many pixels", helps=helps)


def cut_line(t: Tensor, parts: int) -> Tensor:
    """Values (..., N) at nodes and at parts - 1 points between neighbours."""
    share = torch.arange(parts, dtype=t.dtype, device=t.device) / parts
    inner = (t[..., :-1, None] + share * t.diff()[..., None]).flatten(-2)
    return torch.cat([inner, t[..., -1:]], -1) if parts > 1 else t


def moments_of_fans(fans: Fans) -> tuple[Tensor, Tensor, Tensor]:
    """Centroid (2, D, F, W) mm and covariance (3, D, F, W) mm² of the energy of fans, before pixel integration, and
    that energy (D, F, W); all light through the pupil is 1."""
    reference = fans.points[..., :1, :1].detach()
    if fans.is_half:
        reference = torch.stack([torch.zeros_like(reference[0]), reference[1]])
    closed = not fans.is_half
    (x, ax, bx), (y, ay, by) = (cells(t, fans.radius, closed=closed) for t in fans.points - reference)
    lines = x.shape[-2] - 1 if fans.is_half else x.shape[-2]
    weights = cell_energy(fans.radius, lines) * clear_share(fans.clearances, fans.radius, closed=closed)
    weights = weights.expand(x.shape)
    if fans.is_half:
        # All but the outer cells count twice.
        weights = torch.cat([0.5 * weights[..., :1, :], weights[..., 1:-1, :], 0.5 * weights[..., -1:, :]], -2)
    arrived = weights.sum((-2, -1))
    share = safe_divide(weights, arrived[..., None, None])
    mean_x, mean_y = ((share * t).sum((-2, -1), keepdim=True) for t in (x, y))
    mean_x = torch.zeros_like(mean_x) if fans.is_half else mean_x
    x, y = x - mean_x, y - mean_y
    pairs = (x * x + (ax * ax + bx * bx) / 3, x * y + (ax * ay + bx * by) / 3, y * y + (ay * ay + by * by) / 3)
    covariance = torch.stack([(share * pair).sum((-2, -1)) for pair in pairs])
    if fans.is_half:
        covariance = torch.stack([covariance[0], torch.zeros_like(covariance[1]), covariance[2]])
    centroid = torch.stack([mean_x, mean_y])[..., 0, 0] + reference[..., 0, 0]
    return torch.where(arrived > 0, centroid, 0.0), covariance, arrived


def kernels_of_points(
    scene: Scene, grid: Grid, disc: Tensor, *, width: float = _RAY_WIDTH, rays: int | None = None
) -> Kernels:
    """Kernels of independent rays through pupil points (2, P), all of one weight, 1/rays; rays: P by default."""
    traced, rays = trace_scene(scene, disc), disc.shape[1] if rays is None else rays
    energy = (traced.valid.to(traced.position) / rays).expand(*scene.shape, -1)
    points = torch.where(traced.valid, traced.position[:2], 0.0).expand(2, *scene.shape, -1)
    light = beam_share(scene)
    kernel = deposit(grid, points, energy, width) * light[..., None, None]
    centroid, covariance = moments_of_rays(points, energy)
    return Kernels(kernel, grid, centroid, covariance, rays, energy.sum(-1) * light)


@torch.no_grad()
def stream_kernels(
    scene: Scene,
    grid: Grid,
    rays: int,
    *,
    width: float = 0.25,
    max_bytes: float = streaming.MAX_BYTES,
    progress: streaming.Progress | None = None,
) -> tuple[Kernels, Kernels]:
    """Kernels of `rays` Sobol rays, as `kernels_of_rays`, and of the first half of them; without derivatives.

    width: half width in pixels of the blur of each ray, 0 for none; max_bytes: additional memory; progress: called with
    the number of rays traced since the last call. Sums are float64.
    """
    shape, lens = scene.shape, scene.lens
    like = lens.surfaces[-2].thickness
    shots = []
    fields = scene.fields.expand(shape[0], 2, -1) if scene.fields.dim() == 2 else scene.fields.unbind(1)
    for distance, some in zip(lens.surfaces[0].thickness.flatten().unbind(0), fields, strict=True):
        view = with_object_distance(lens, distance)
        shots += streaming.shots_of(view, rays, some, scene.wavelengths, None, None)[0]
    centre = grid.centre.reshape(2, *(grid.centre.shape[1:] or (1, 1, 1))).expand(2, *shape)
    grids = [dataclasses.replace(grid, centre=c) for c in centre.flatten(1).unbind(1)]
    size = streaming.chunk_size(shots[0], max_bytes, kept=3 * 8 * len(shots) * grid.rows * grid.columns)
    references: list[Tensor] = []
    sums, images = [streaming.nothing(like)] * len(shots), like.new_zeros(len(shots), *grid.shape, dtype=torch.float64)
    done, half = 0, max(1, rays // 2)
    for points in streaming.pupil_chunks(rays, size, sampling="sobol", seed=0, like=like, cut=half):
        for k, s in enumerate(shots):
            landing, valid = streaming.hits(s, points)
            if not done:
                references.append(streaming.moments(landing, valid, like.new_zeros(2)).mean.to(like.dtype))
            sums[k] = streaming.merge(sums[k], streaming.moments(landing, valid, references[k]))
            images[k] += deposit(grids[k], landing, valid.double(), width)
            if progress is not None:
                progress(points.shape[1])
        done += points.shape[1]
        if done == half:
            before = images.clone()
    pairs = zip(references, sums, strict=True)
    m = streaming.stacked([streaming.Moments(m.count, r + m.mean, m.scatter) for r, m in pairs], shape)
    light = beam_share(scene).double()
    covariance, arrived = safe_divide(m.scatter, m.count), light * m.count / rays
    whole, first = (
        k.unflatten(0, shape) * (light / count)[..., None, None] for k, count in ((images, rays), (before, half))
    )
    return (
        Kernels(whole, grid, m.mean, covariance, rays, arrived),
        Kernels(first, grid, m.mean, covariance, half, arrived),
    )


def deposit(grid: Grid, points: Tensor, energy: Tensor, width: float) -> Tensor:
    """Energy in pixels of points blurred by a kernel of half width `width` pixels; 0: no blur, no derivative."""
    return splat_smooth(grid, points, energy, width=width) if width else histogram(grid, points, energy)


_MAP_LINES = 32  # round the pupil at least, with half as many cells on each
_MOST_LINES = 8192
_PIECES = 32  # of the meridian of rotationally symmetric light at order 0
_DEGREES = (6, 8, 10, 12, 14, 16, 20)
_CHECKS = 8  # rays traced to check the fit
_PIXELS = 0.1  # error of a ray in pixels allowed at order 0; each order halves it
_CLOSE = 0.01  # pixels: such a map is more accurate than any affordable number of traced rays
_HIGHER_DEGREES = (14, 20)  # tried where the degree of the order fails


@value
class RayMap:
    """Coefficients of the ray map of a scene: on the sensor and in the apertures.

    hits: (2, D, F, W, T) mm; crossings: (2, D, F, W, T) mm for each of `apertures`; of an axial scene only y is used.
    residual: (D, F, W) mm, largest error of the check rays; inf if a ray misses a surface.
    edge_residual: (D, F, W) the same for the clearances in the apertures.
    is_mirrored: whether the light is symmetric in x.
    """

    degree: int
    axial: bool
    hits: Tensor
    crossings: tuple[Tensor, ...]
    apertures: tuple[Aperture, ...]
    residual: Tensor
    edge_residual: Tensor
    rays: int
    is_mirrored: bool = False


def kernels(scene: Scene, grid: Grid, *, order: int = 3) -> Kernels:
    """PSFs through the ray map; of traced rays where no polynomial fits, or a ray misses a surface or is totally
    reflected.

    order: 0 … 10; each has twice the cells of the one before, half its error, and a map of higher degree.
    `Kernels.residual` bounds the effect of the map's error on the kernel (relative L1); it is 0 for traced rays.
    """
    limit, pitch = max(_PIXELS * 0.5**order, _CLOSE), grid.pitch.detach()
    first = _DEGREES[min(order, len(_DEGREES) - 1)]
    for degree in [first, *(degree for degree in _HIGHER_DEGREES if degree > first)]:
        ray_map = fit(scene, degree)
        error = float(scene.largest((ray_map.residual / pitch).amax()))
        edge_error = float(scene.largest(ray_map.edge_residual.amax()))
        if error <= limit and edge_error <= limit:
            return _kernels_of_map(scene, grid, ray_map, order)
        if math.isinf(error):
            break
    finer = min(order + 2, 10)
    traced = kernels_of_fans(scene, grid, trace_fans(scene, finer), width=cell_width(finer))
    return _with_residual(traced, torch.zeros_like(traced.centroid[0]))


def fit(scene: Scene, degree: int) -> RayMap:
    """Trace the rays of a degree and the check rays; linear in the traced points, so gradients flow through."""
    like = scene.lens.surfaces[-2].thickness
    fold = symmetry(scene)
    axial, mirrored = fold == "round", fold == "mirror"
    constant = like.new_tensor
    if axial:
        nodes = degree // 2 + 1  # positive Chebyshev nodes: heights on the y axis
        height = np.cos((2 * np.arange(nodes) + 1) * np.pi / (4 * nodes))
        checked = np.sqrt((np.arange(4) + 1) / 4)
        disc = np.stack([np.zeros(len(height) + 4), np.concatenate([height, checked])])
        solve, check = np.linalg.inv(_axial_basis(degree, height)), _axial_basis(degree, checked)
        mirror = None
    else:
        fitted, checked, mirror = _disc_nodes(degree, mirrored)
        disc = np.concatenate([fitted, checked], 1)
        solve, check = _solution(degree), _basis(degree, checked)
    hits, crossed, met = trace_apertures(scene, constant(disc))
    count = disc.shape[1] - check.shape[0]
    to_terms, to_checks = constant(solve).T, constant(check).T

    def coefficients(points: Tensor) -> Tensor:
        points = points[..., :count]
        if mirror is not None:
            source, sign = mirror
            points = points[..., torch.as_tensor(source, device=points.device)]
            points = torch.stack([points[0] * constant(sign), points[1]])
        return points @ to_terms

    def largest(error: Tensor) -> Tensor:
        return torch.where(met.all(-1), error.detach().abs().amax(-1), float("inf"))

    mapped = coefficients(hits)
    crossings = tuple(coefficients(hit) for _, hit in crossed)
    edge = torch.zeros_like(hits[0, ..., 0])
    for (aperture, hit), terms in zip(crossed, crossings, strict=True):
        error = clearance(aperture, terms @ to_checks) - clearance(aperture, hit[..., count:])
        edge = torch.maximum(edge, largest(error))
    residual = largest((mapped @ to_checks - hits[..., count:]).abs().amax(0))
    apertures = tuple(aperture for aperture, _ in crossed)
    return RayMap(degree, axial, mapped, crossings, apertures, residual, edge, disc.shape[1], mirrored)


def fans_of_map(ray_map: RayMap, across: int, along: int, *, is_half: bool = False) -> Fans:
    """The map on `across` lines of `along` cells; is_half: as for `Fans`, of a mirrored map."""
    like = ray_map.hits
    at_angle, at_radius = pupil_lines(across, along)
    if is_half:
        at_angle = at_angle[np.arange(-1, across // 2 + 1)]
    angle, radius = (like.new_tensor(t) for t in (at_angle, at_radius))
    if ray_map.axial:
        radial = like.new_tensor(_axial_basis(ray_map.degree, at_radius))
    else:
        radial, around = (like.new_tensor(t) for t in _factors(ray_map.degree, at_radius, at_angle))

    def on_fans(terms: Tensor) -> Tensor:
        if ray_map.axial:
            return rotated((terms[1] @ radial.T)[..., None, :], angle)
        return around @ (terms[..., None] * radial.T)

    pairs = zip(ray_map.apertures, ray_map.crossings, strict=True)
    clearances = tuple(clearance(aperture, on_fans(terms)) for aperture, terms in pairs)
    return Fans(on_fans(ray_map.hits), radius, clearances, ray_map.rays, is_half)


def reference(scene: Scene, grid: Grid, *, lines: int = 2048) -> Tensor:
    """Converged energy (D, F, W, rows, columns), for tests; error below 1e-4, as that of 10⁸ random rays.

    2 million cells of the map of degree 20, or 0.26 million traced rays where that fails.
    """
    with torch.no_grad():
        ray_map = fit(scene, _DEGREES[-1])
        if float((ray_map.residual / grid.pitch).amax()) <= 1e-4 and float(ray_map.edge_residual.amax()) <= 1e-4:
            fans = fans_of_map(ray_map, lines, lines // 2)
            return energy_of_fans(grid, fans) * beam_share(scene)[..., None, None]
        return kernels_of_fans(scene, grid, trace_fans(scene, 10), width=cell_width(4)).kernel


def _kernels_of_map(scene: Scene, grid: Grid, ray_map: RayMap, order: int) -> Kernels:
    if ray_map.axial and is_centred(grid, scene):
        return _kernels_of_meridian(scene, grid, ray_map, order)
    # Cells of order 0 are one pixel wide, measured on a coarse map; each order makes them √2 narrower.
    coarse = fans_of_map(ray_map, 2 * _MAP_LINES, _MAP_LINES)
    ray_map = _bounded(ray_map, coarse, scene.largest)
    *widths, both = cell_widths(grid, coarse.points, scene.largest)
    across, along = (
        2 * math.ceil(min(_MOST_LINES, max(least, width * 2 * least) * both * 2 ** (order / 2)) / 2)
        for width, least in zip(widths, (_MAP_LINES, _MAP_LINES // 2), strict=True)
    )
    # The window is symmetric in x too, and stays so under differentiation.
    is_half = ray_map.is_mirrored and not varies(grid.centre) and not bool((grid.centre[0] != 0).any())
    # With their moments: 129 bytes per cell measured, 175 with a clearance.
    each = 48.0 * (3 + len(ray_map.apertures))
    afford_cells(scene.shape, across // 2 if is_half else across, along, each=each)
    fans = fans_of_map(ray_map, across, along, is_half=is_half)
    kernel, light = energy_of_fans(grid, fans), beam_share(scene)
    centroid, covariance, arrived = moments_of_fans(fans)
    kernels = Kernels(kernel * light[..., None, None], grid, centroid, covariance, ray_map.rays, arrived * light)
    return _with_residual(kernels, ray_map.residual)


def _bounded(ray_map: RayMap, coarse: Fans, largest: Callable[[Tensor], Tensor]) -> RayMap:
    """The map without the apertures that stop no light of the whole scene: no cell comes near their edges.

    Between the nodes of a coarse fan a clearance falls by less than it changes from node to node, in either direction.
    """
    kept = []
    for number, clear in enumerate(coarse.clearances):
        c = clear.detach()
        change = c.diff().abs().amax() + (torch.roll(c, -1, -2) - c).abs().amax()
        if not float(largest(change - c.amin())) < 0:
            kept.append(number)
    crossings, apertures = tuple(ray_map.crossings[k] for k in kept), tuple(ray_map.apertures[k] for k in kept)
    return dataclasses.replace(ray_map, crossings=crossings, apertures=apertures)


def _kernels_of_meridian(scene: Scene, grid: Grid, ray_map: RayMap, order: int) -> Kernels:
    """Kernels of light symmetric about the window's centre: segments of one line, rotated about the axis."""
    like = ray_map.hits
    nodes = np.linspace(0, 1, math.ceil(_PIECES * 2 ** (order / 2)) + 1)
    basis = like.new_tensor(_axial_basis(ray_map.degree, nodes))
    height, *crossed = (terms[1] @ basis.mT for terms in (ray_map.hits, *ray_map.crossings))
    pairs = zip(ray_map.apertures, crossed, strict=True)
    clearances = [clearance(aperture, torch.stack([torch.zeros_like(hit), hit])) for aperture, hit in pairs]
    first, last, share = lit_part(height[..., :-1], height[..., 1:], clearances)
    energy = (share * like.new_tensor(np.diff(nodes**2))).expand(first.shape)
    kernel, light = unfold(grid, energy_of_rings(grid, first, last, energy)), beam_share(scene)
    weights = safe_divide(energy, energy.sum(-1, keepdim=True).expand_as(energy))
    # A ring of radius h has the variance h²/2 per axis; h² is averaged over every segment.
    variance = (weights * (first * first + first * last + last * last)).sum(-1) / 6
    zero = torch.zeros_like(variance)
    moments = torch.stack([zero, zero]), torch.stack([variance, zero, variance])
    kernels = Kernels(kernel * light[..., None, None], grid, *moments, ray_map.rays, energy.sum(-1) * light)
    return _with_residual(kernels, ray_map.residual)


def _with_residual(kernels: Kernels, residual: Tensor) -> Kernels:
    """Kernels with a residual: light moved by δ changes a kernel by at most δ times its total variation."""
    kernel = kernels.kernel.detach()
    variation = kernel.diff(dim=-1).abs().sum((-2, -1)) + kernel.diff(dim=-2).abs().sum((-2, -1))
    total = kernel.sum((-2, -1))
    change = residual / kernels.grid.pitch.detach() * variation / torch.where(total > 0, total, 1.0)
    return dataclasses.replace(kernels, residual=change)


def _axial_basis(degree: int, radius: np.ndarray) -> np.ndarray:
    """ρ T_j(2ρ² - 1), (points, terms): an on-axis height is odd in ρ."""
    return radius[:, None] * np.polynomial.chebyshev.chebvander(2 * radius**2 - 1, degree // 2)


@functools.lru_cache(maxsize=32)
def _disc_nodes(degree: int, mirrored: bool) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray] | None]:
    """Points (2, ...) traced to fit and to check; of mirrored light, the traced point and its sign in x for each ring
    point."""
    rings = _rings(degree)
    step = np.arange(_CHECKS)
    radius, angle = np.sqrt((step + 1) / _CHECKS), np.pi * (3 - 5**0.5) * step + 0.3
    checked = radius * np.stack([np.cos(angle), np.sin(angle)])
    if not mirrored:
        return rings, checked, None
    kept = np.flatnonzero(rings[0] > -1e-12)
    apart = np.abs(rings[0, kept])[None] - np.abs(rings[0])[:, None], rings[1, kept][None] - rings[1][:, None]
    mirror = np.argmin(apart[0] ** 2 + apart[1] ** 2, 1), np.where(rings[0] < -1e-12, -1.0, 1.0)
    return rings[:, kept], np.stack([np.abs(checked[0]), checked[1]]), mirror


@functools.lru_cache(maxsize=32)
def _solution(degree: int) -> np.ndarray:
    return np.linalg.inv(_basis(degree, _rings(degree)))


@functools.lru_cache(maxsize=32)
def _rings(degree: int) -> np.ndarray:
    """Points (2, T) on rings of 2n + 5 - 4j points, j = 1, 2, …, symmetric in x; as many as the basis has terms."""
    points = []
    for ring in range(1, degree // 2 + 2):
        zeta = np.cos((2 * ring - 1) * np.pi / (2 * (degree + 1)))
        radius = 1.1565 * zeta - 0.76535 * zeta**2 + 0.60517 * zeta**3
        count = 2 * degree + 5 - 4 * ring
        angle = np.pi / 2 + np.arange(count) * (2 * np.pi / count)
        points.append(radius * np.stack([np.cos(angle), np.sin(angle)]))
    return np.concatenate(points, 1)


def _basis(degree: int, points: np.ndarray) -> np.ndarray:
    radial, azimuthal = _factors(degree, np.hypot(*points), np.arctan2(points[1], points[0]))
    return radial * azimuthal


def _factors(degree: int, radius: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """ρ^m T_j(2ρ² - 1), (radii, terms), and cos mθ or sin mθ, (angles, terms)."""
    chebyshev = np.polynomial.chebyshev.chebvander(2 * radius**2 - 1, degree // 2)
    radial, around = [], []
    for m in range(degree + 1):
        for j in range((degree - m) // 2 + 1):
            for turn in (np.cos, np.sin)[: 2 if m else 1]:
                radial.append(radius**m * chebyshev[:, j])
                around.append(turn(m * angle))
    return np.stack(radial, -1), np.stack(around, -1)
