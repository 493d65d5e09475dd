"""Splat: the energy of weighted points and of small cells in the pixels of a Grid, differentiable in all of them.

Positions are counted in pixels before anything else. Whatever lies outside the window is dropped, never moved to its
edge, so the sum of an image is the energy inside the window.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.maths.grid import Grid
from raytrace.maths.numerics import safe_divide


def splat(grid: Grid, points: Tensor, weights: Tensor) -> Tensor:
    """Bilinear deposition: each point shares its weight between the four nearest pixel centres.

    It is the energy of a box one pixel wide about every point, so it widens a kernel by pitch²/12 per axis (the
    exact kernel, at double the resolution of a pixel, is `splat_smooth`'s with width -> 0).
    points: (2, ..., P) mm; weights: (P,) or (..., P); returns (..., rows, columns). A point on a pixel centre gives it
    all its weight and has the derivative of the side towards larger coordinates.
    """
    column, right = _between_centres(_in_pixels(grid, points, 0) - 0.5, grid.columns)
    row, up = _between_centres(_in_pixels(grid, points, 1) - 0.5, grid.rows)
    return _four(grid, column, row, right, up, weights)


def splat_smooth(grid: Grid, points: Tensor, weights: Tensor, *, width: float) -> Tensor:
    """Energy in each pixel of points blurred by a smooth kernel smaller than a pixel; twice differentiable.

        k(t) = 15/16 (1 - t²)²,  t = x/(width·pitch),   ∫_{-1}^{t} k = s³(10 - 15 s + 6 s²),  s = (t + 1)/2

    width: half width of the kernel in pixels, above 0 and up to 1/2. The bias is known: the blur adds
    (width·pitch)²/7 to the variance per axis; it vanishes with the square of the width where the kernel is smooth.
    points, weights and result as for `splat`.
    """
    column, right = _about_edges(_in_pixels(grid, points, 0), grid.columns, width)
    row, up = _about_edges(_in_pixels(grid, points, 1), grid.rows, width)
    return _four(grid, column, row, right, up, weights)


def histogram(grid: Grid, points: Tensor, weights: Tensor) -> Tensor:
    """Energy of the points in each pixel; no derivative in their positions. Arguments and result as for `splat`."""
    column = _clamped(torch.floor(_in_pixels(grid, points, 0)), grid.columns)
    row = _clamped(torch.floor(_in_pixels(grid, points, 1)), grid.rows)
    return _deposit(grid, [(column, row, weights)])


def splat_cells(
    grid: Grid, points: Tensor, radius: Tensor, clearances: Sequence[Tensor] = (), *, closed: bool = True
) -> Tensor:
    """Energy in each pixel of the images of small cells of the pupil: between two lines and two radii each.

    To first order a cell's image is a parallelogram c ± a ± b, also where it folds to a segment or a point, on a
    caustic. The share of its energy on either side of a pixel edge is exact: along x it has the density of the sum of
    two uniform variables of half widths |a_x| and |b_x|. A cell on the corner of a pixel needs the share below both
    edges; it is F_x F_y + cov f_x f_y, whose mean over all places of the corner is exact (Hoeffding), held within what
    the shares allow. The derivative needs no blur, and no bias is left as the cells shrink.

    points: (2, ..., A, N) mm, N nodes on each of A lines at equal angles round the pupil; radius: (N,) of the nodes.
    clearances: each (..., A, N), above 0 where light passes; the share of a cell below 0 is cut away.
    closed: whether the last line is followed by the first; otherwise it is the first line itself, a turn later.
    A cell may be as wide as a pixel, not wider: see `cell_widths`.
    """
    lines = points.shape[-2] - (0 if closed else 1)
    u, v = _in_pixels(grid, points, 0), _in_pixels(grid, points, 1)
    energy = cell_energy(radius, lines) * clear_share(clearances, radius, closed=closed)
    (x, ax, bx), (y, ay, by) = (cells(w, radius, closed=closed) for w in (u, v))
    (column, right, dense_x), (row, up, dense_y) = _shares(x, ax, bx, grid.columns), _shares(y, ay, by, grid.rows)
    both = right * up + (ax * ay + bx * by) / 3 * dense_x * dense_y
    both = torch.maximum(torch.minimum(both, torch.minimum(right, up)), (right + up - 1).clamp_min(0))
    deposits = (
        (column, row, 1 - right - up + both),
        (column + 1, row, right - both),
        (column, row + 1, up - both),
        (column + 1, row + 1, both),
    )
    return _deposit(grid, [(i, j, energy * share) for i, j, share in deposits], axes=2)


def cell_widths(grid: Grid, points: Tensor, largest: Callable[[Tensor], Tensor]) -> tuple[float, float, float]:
    """Width in pixels of the widest cell of points (2, ..., A, N), across the lines and along them; and their sum.

    The sum, 1 … 2, is that of both parts of one cell along x or y, each in units of its largest: cut into that many
    times as many parts as its widths alone ask for, no cell is wider than a pixel. largest: as `Scene` has it.
    """
    w = points.detach() / grid.pitch.detach()
    across, along = (torch.roll(w, -1, -2) - w).abs(), w.diff().abs()
    sides = torch.maximum(across[..., 1:], across[..., :-1]), torch.maximum(along, torch.roll(along, -1, -2))
    widest = largest(torch.stack([side.amax() for side in sides])).unbind()
    both = sum(safe_divide(side, most.expand_as(side)) for side, most in zip(sides, widest, strict=True))
    return *(float(most) for most in widest), max(1.0, float(largest(both.amax())))


def half_widths(w: Tensor, *, closed: bool = True) -> tuple[Tensor, Tensor]:
    """Half vectors of the cells of a map w (..., A, N): b across the lines and a along them, (..., A, N - 1) each."""
    after = torch.roll(w, -1, -2) if closed else w[..., 1:, :]
    before = w if closed else w[..., :-1, :]
    across, along = after - before, (after + before).diff()
    return 0.25 * (across[..., 1:] + across[..., :-1]), 0.25 * along


def cells(w: Tensor, radius: Tensor, *, closed: bool = True) -> tuple[Tensor, Tensor, Tensor]:
    """Centre of energy and half vectors along and across (..., A, N - 1) of the cells of a map w (..., A, N)."""
    across, along = half_widths(w, closed=closed)
    after, before = (torch.roll(w, -1, -2), w) if closed else (w[..., 1:, :], w[..., :-1, :])
    both = after + before
    # Energy grows with the pupil radius: its mean lies a little outside the middle of a cell.
    outward = radius.diff() / (3 * (radius[1:] + radius[:-1]))
    return 0.25 * (both[..., 1:] + both[..., :-1]) + outward * along, along, across


def cell_energy(radius: Tensor, lines: int) -> Tensor:
    """Share (N - 1) of the pupil of the cells between radii (N,) and two of so many lines."""
    return radius.diff() * (radius[1:] + radius[:-1]) / lines


def clear_share(clearances: Sequence[Tensor], radius: Tensor, *, closed: bool = True) -> Tensor | float:
    """The share (..., A, N - 1) of each cell that passes every aperture; clearances (..., A, N)."""
    share = None
    for clearance in clearances:
        centre, along, across = cells(clearance, radius, closed=closed)
        passed = 1 - below_edge(-centre, along, across)[0]
        share = passed if share is None else torch.minimum(share, passed)
    return 1.0 if share is None else share


def below_edge(z: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """P(a s + b t < z) for s, t uniform in [-1, 1]: a straight middle and two parabolic ends; finite if a = b = 0.

    p = max(|a|, |b|), q = min(|a|, |b|):  1/2 + z/2p for |z| < p - q;  a tail of (p + q - |z|)²/8pq beyond

    And its derivative in z, the density there; 0 for a cell without width.
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


def _shares(centre: Tensor, along: Tensor, across: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """The pixel below the edge nearest to each cell, the share of the next pixel, and the density at the edge."""
    reached = (centre > -1) & (centre < count + 1)
    centre = torch.where(reached, centre, -1.0)
    edge = torch.round(centre).detach()
    below, density = below_edge(edge - centre, along, across)
    return edge.long() - 1, 1 - below, density


def _in_pixels(grid: Grid, points: Tensor, axis: int) -> Tensor:
    """Coordinate counted in pixels: pixel i covers i to i + 1. The grid's batch axes stand before those of points."""
    count = grid.columns if axis == 0 else grid.rows
    centre, pitch = (_aligned(t, points[axis]) for t in (grid.centre[axis], grid.pitch))
    return (points[axis] - centre) / pitch + 0.5 * count


def _aligned(number: Tensor, like: Tensor) -> Tensor:
    """A grid's number (...) with axes of length 1 for the points of each kernel."""
    return number.reshape(*number.shape, *(1,) * (like.dim() - number.dim())) if number.dim() else number


def _between_centres(u: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The pixel centre i below u, -1 … count - 1, and the share u - i of its neighbour i + 1."""
    reached = (u > -1) & (u < count)  # a NaN is not
    u = torch.where(reached, u, -1.0)
    below = torch.floor(u).detach()
    return below.long(), u - below


def _about_edges(u: Tensor, count: int, width: float) -> tuple[Tensor, Tensor]:
    """The pixel i below the edge nearest to u, and the share of pixel i + 1 behind that edge."""
    reached = (u > -0.5) & (u < count + 0.5)
    u = torch.where(reached, u, -0.5)
    edge = torch.floor(u + 0.5).detach()
    s = (0.5 + (u - edge) / (2 * width)).clamp(0, 1)
    return edge.long() - 1, s * s * s * (10 - s * (15 - 6 * s))


def _clamped(pixel: Tensor, count: int) -> Tensor:
    """Pixel numbers as integers; -1 or `count`, outside the window, for all that lies further out, or is NaN."""
    return torch.where(torch.isfinite(pixel), pixel.clamp(-1, count), -1.0).long()


def _four(grid: Grid, column: Tensor, row: Tensor, right: Tensor, up: Tensor, weights: Tensor) -> Tensor:
    right_weight, left_weight = weights * right, weights * (1 - right)
    return _deposit(
        grid,
        [
            (column, row, left_weight * (1 - up)),
            (column + 1, row, right_weight * (1 - up)),
            (column, row + 1, left_weight * up),
            (column + 1, row + 1, right_weight * up),
        ],
    )


def _deposit(grid: Grid, deposits: list[tuple[Tensor, Tensor, Tensor]], *, axes: int = 1) -> Tensor:
    """Sum (column, row, energy), each (..., P) over its last `axes` axes, into (..., rows, columns)."""
    image = None
    dropped = grid.rows * grid.columns
    for column, row, energy in deposits:
        inside = (column >= 0) & (column < grid.columns) & (row >= 0) & (row < grid.rows)
        place = torch.where(inside, row * grid.columns + column, dropped).flatten(-axes)
        energy = energy.expand(inside.shape).flatten(-axes)
        image = energy.new_zeros(*place.shape[:-1], dropped + 1) if image is None else image
        image = image.scatter_add(-1, place, energy)
    return image[..., :-1].unflatten(-1, grid.shape)
