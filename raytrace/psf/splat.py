"""Splat: the energy of weighted points and line segments in the pixels of a Grid, differentiable in all of them.

Positions are counted in pixels before anything else. Whatever lies outside the window is dropped, never moved to its
edge, so the sum of an image is the energy inside the window.
"""

import torch
from torch import Tensor

from raytrace.grid import Grid


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


def splat_segments(
    grid: Grid, points: Tensor, radius: Tensor, weights: Tensor, clearances: list[Tensor] | None = None, pieces: int = 1
) -> Tensor:
    """Exact energy in each pixel of polylines: the images of lines of the pupil from its centre to its rim.

    Along segment k position and pupil radius ρ run linearly, so the energy up to the fraction t is
    weight·(ρ(t)² - ρ_k²), and each pixel gets what lies between the fractions where the segment enters and leaves it.
    A pixel edge moves those fractions smoothly, hence a derivative without any blur.

    points: (2, ..., A, N) mm, N nodes of A lines; radius: (N,) their pupil radii; weights: (A,) of the lines.
    clearances: each (..., A, N), linear along a segment, above 0 where light passes; the rest is cut away.
    pieces: in how many parts to cut each segment, so that none is longer than a pixel in x or y: see `pieces_needed`.
    """
    first, last = clipped(clearances, points[0, ..., 1:])
    u, v = _in_pixels(grid, points, 0), _in_pixels(grid, points, 1)
    deposits = []
    for piece in range(pieces):
        begin, end = piece / pieces, (piece + 1) / pieces
        (column, column_end, cross_x), (row, row_end, cross_y) = (
            _edge_crossing(w[..., :-1] + begin * w.diff(), w[..., :-1] + end * w.diff(), count, begin, end)
            for w, count in ((u, grid.columns), (v, grid.rows))
        )
        turns = torch.minimum(cross_x, cross_y), torch.maximum(cross_x, cross_y)
        stops = [first.clamp(begin, end), *(turn.clamp(first, last) for turn in turns), last.clamp(begin, end)]
        # Between its two crossings a segment is in one of the two pixels beside the diagonal.
        x_first = cross_x < cross_y
        places = (
            (column, row),
            (torch.where(x_first, column_end, column), torch.where(x_first, row, row_end)),
            (column_end, row_end),
        )
        for (i, j), a, b in zip(places, stops[:-1], stops[1:], strict=True):
            deposits.append((i, j, weights[:, None] * _between(radius, a, b)))
    return _deposit(grid, deposits, axes=2)


def pieces_needed(grid: Grid, points: Tensor) -> int:
    """In how many parts segments (2, ..., A, N) must be cut for `splat_segments`."""
    longest = (points.detach().diff().abs().amax() / grid.pitch.detach()).amax()
    return max(1, int(torch.ceil(longest)))


def clipped(clearances: list[Tensor] | None, like: Tensor) -> tuple[Tensor, Tensor]:
    """Fractions first <= last (..., A, N - 1) between which every clearance (..., A, N) is above 0."""
    first, last = torch.zeros_like(like), torch.ones_like(like)
    for clearance in clearances or []:
        a, b = clearance[..., :-1], clearance[..., 1:]
        opens, closes = (a < 0) & (b >= 0), (a >= 0) & (b < 0)
        zero = a / torch.where(opens | closes, a - b, 1.0)
        first = torch.maximum(first, torch.where(opens, zero, 0.0))
        last = torch.minimum(last, torch.where(closes, zero, torch.where((a < 0) & (b < 0), 0.0, 1.0)))
    return first, torch.maximum(first, last)


def _between(radius: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """ρ(b)² - ρ(a)² of segments (N - 1) of nodes at pupil radii (N,), without cancellation."""
    length = radius.diff()
    return (b - a) * length * (2 * radius[:-1] + (a + b) * length)


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


def _edge_crossing(start: Tensor, end: Tensor, count: int, begin: float, stop: float) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels at both ends of a piece no longer than a pixel, and the fraction of the segment where it changes pixel."""
    i, j = torch.floor(start).detach(), torch.floor(end).detach()
    crosses = i != j
    edge = torch.maximum(i, j)
    fraction = (edge - start) / torch.where(crosses, end - start, 1.0)
    fraction = torch.where(crosses, begin + (stop - begin) * fraction, stop)
    return _clamped(i, count), _clamped(j, count), fraction


def _clamped(pixel: Tensor, count: int) -> Tensor:
    """Pixel numbers as integers; -1 or `count`, outside the window, for all that lies further out, or is NaN."""
    return torch.where(torch.isfinite(pixel), pixel.clamp(-1, count), -1.0).long()


def _four(grid: Grid, column: Tensor, row: Tensor, right: Tensor, up: Tensor, weights: Tensor) -> Tensor:
    return _deposit(
        grid,
        [
            (column, row, weights * (1 - right) * (1 - up)),
            (column + 1, row, weights * right * (1 - up)),
            (column, row + 1, weights * (1 - right) * up),
            (column + 1, row + 1, weights * right * up),
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
