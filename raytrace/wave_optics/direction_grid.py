"""Flat pixels at the stop of a lens, summed over a square grid of directions.

    U(x, y) = (n/λ) Σ_kl a_kl q_kl exp(2πi [W_kl + n (L_k x + M_l y)]/λ) h_L h_M

L_k and M_l are equidistant, so that the sum is two products of matrices. Wavefront W, place in the stop, pupil point p
and its light are smooth over the directions: series through a thousand traced rays; a² is the light of a unit of the
pupil times |∂p/∂(L, M)|. q is the phasor of the pixels,
averaged over a cell twice, and the share of the cell in the pupil, with steps and rim straight within a cell. A mean
has the transform sinc(h f): nothing of a step is folded back at f = 1/h, 2/h, …, and the first term of what is lost
below is restored.
"""

import functools
import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.budget import afford
from raytrace.maths import zernike
from raytrace.maths.bivariate import powers, zernike_to_powers
from raytrace.maths.numerics import safe_divide, safe_sqrt, value, varies
from raytrace.maths.sampling import gauss_rings
from raytrace.psf_models import dft
from raytrace.tracing.scene import Scene, trace_scene
from raytrace.tracing.wavefront import Wavefront
from raytrace.wave_optics.element import Element, Pixels, excess_index, fabricated_height, path
from raytrace.words import RaytraceError

_DEGREE = 16  # of the series
_ORDERS = [zernike.noll(j) for j in range(1, (_DEGREE + 1) * (_DEGREE + 2) // 2 + 1)]
_RAYS = 20, 56  # rings and arms, for a series
_MARGIN = 1.025  # of the grid around the pupil: half a cell of the coarsest
_LEAST = 96  # cells across
_CELLS = 4.0  # of a pixel, of order 0; twice as many two orders further, and two of order -2, the fewest
_NYQUIST = 1.3 * 2 / math.pi  # cells for a radian of phase along the radius of the pupil
_MOST = 4096  # cells across
_BYTES = 270, 410, 1060  # of a cell: without derivatives; and of each kernel: by the heights, by the lens
_CLOSE = 2e-3  # waves, and thousandths of the beam, by which series may miss rays
_TURNED = 0.05  # largest slope of the rows of the grid in the stop


class TooCoarse(RaytraceError, ValueError):
    """An element needs more rays or directions than can be summed."""


@value
class Directions:
    """What is smooth over the directions of one field.

    centre, half: (2, D, F, W) of the square of directions; series: (6, D, F, W, degree + 1, degree + 1), coefficients
    of powers of M (rows) and L in units of the half square, of the OPD in mm, x and y in the stop in mm, x and y of the
    pupil point, and the root of the light of a unit of the pupil; extent: largest width of the beam in the stop, mm.
    """

    centre: Tensor
    half: Tensor
    series: Tensor
    extent: float


def directions_of(scene: Scene, front: Wavefront, at_stop: Tensor) -> Directions | None:
    """The series of one field through the rays of a front, those of `rays_of_series`, which meet the stop at `at_stop`
    (2, D, F, W, P) mm.

    None where the pupil is clipped, where its directions do not lie within the ellipse of their square, where a series
    misses a ray, and where the grid is turned against the pixels.
    """
    pupil, weights = front.pupil, front.weights
    with torch.no_grad():
        rim = pupil[:, -_RAYS[1] :]
        rim = rim / torch.linalg.vector_norm(rim, dim=0)
        if not scene.everywhere(front.valid.all() & trace_scene(scene, (1 - 1e-6) * rim).valid.all()):
            return None
    directions = front.direction[:2]
    low, high = directions.amin(-1), directions.amax(-1)
    centre, half = 0.5 * (low + high), 0.5 * _MARGIN * (high - low)
    places = (directions - centre[..., None]) / half[..., None]
    is_within = (places.detach().square().sum(0) < 1).all()
    root = safe_sqrt(front.energy / (math.pi * weights))
    numbers = torch.stack(torch.broadcast_tensors(front.opd, *at_stop, *pupil, root))
    basis = zernike.polynomials(_ORDERS, *places)
    terms = zernike.fit(numbers, basis, weights)
    with torch.no_grad():
        missed = (numbers - torch.einsum("...j,j...p->...p", terms, basis)).abs().amax(-1)
        extent = (at_stop.amax(-1) - at_stop.amin(-1)).amax()
        waves, off = missed[0] / (1e-3 * front.wavelength), missed[1:3] / extent
        tilts = terms[1:3, ..., 1:3].abs()  # of x and y in the stop, by L and M
        turn = (tilts[0, ..., 1] + tilts[1, ..., 0]) / tilts.amax((0, -1))
        is_close = (waves < _CLOSE).all() & (off < 1e-3 * _CLOSE).all() & (turn < _TURNED).all()
        if not scene.everywhere(is_within & is_close):
            return None
    return Directions(centre, half, _in_powers(terms), float(scene.largest(extent)))


def rays_of_series(like: Tensor) -> tuple[Tensor, Tensor]:
    """Pupil points (2, P) and weights (P,) of the rays through which series go."""
    return gauss_rings(*_RAYS, dtype=like.dtype, device=like.device)


def cells_across(directions: Directions, pixels: Sequence[Element], phase: float, order: int) -> int:
    """Cells of the grid along L and M; phase: radians along a pupil radius, of everything smooth.

    Raises TooCoarse for more than 4,096, OverBudget where they exceed the memory budget.
    """
    finest = min(float(_pixels(element).pitch.detach()) for element in pixels)
    of_pixels = _CELLS * 2 ** (order / 2) * _MARGIN * directions.extent / finest
    cells = math.ceil(max(_LEAST * 2 ** (order / 2), of_pixels, _NYQUIST * phase))
    need = f"the pixels of an element need {cells:,} × {cells:,} directions"
    if cells > _MOST:
        raise TooCoarse(
            f"{need}, more than {_MOST:,} × {_MOST:,}: take coarser ones, or the wave camera, which takes any height "
            "but no lens"
        )
    kernels, bytes_of_cell = math.prod(directions.half.shape[1:]), _BYTES[0]
    if torch.is_grad_enabled() and (varies(directions.series) or any(varies(element.numbers) for element in pixels)):
        bytes_of_cell = kernels * _BYTES[2 if varies(directions.series) else 1]
    afford(
        bytes_of_cell * cells**2, f"{need} for {kernels} kernels", helps="take coarser ones, fewer {object_distances}"
    )
    return cells


def amplitude(
    directions: Directions,
    front: Wavefront,
    x: Tensor,
    y: Tensor,
    *,
    pixels: Sequence[Element],
    others: Sequence[Element],
    cells: int,
) -> Tensor:
    """U (D, F, W, Y, X) in 1/mm, as `wave.amplitude`; front: of which the directions are; others: elements in contact
    that have no pixels; cells: of the grid across."""
    phasors = [_phasors(element, front.wavelength) for element in pixels]
    inside = (1e-3 * front.wavelength / front.index).expand(directions.centre.shape[1:])
    x, y = (t.expand(*inside.shape, t.shape[-1]) for t in (x, y))
    steps = (torch.arange(cells, dtype=x.dtype, device=x.device) + 0.5) * (2 / cells) - 1
    is_within = steps**2 + (steps**2)[:, None] < 1  # series have no meaning beyond
    fields = []
    for d, f, w in itertools.product(*map(range, inside.shape)):  # each alone: a grid has many cells
        kernel, one_colour = (d, f, w), front.wavelength[w : w + 1]
        series, half = directions.series[:, d, f, w], directions.half[:, d, f, w]
        smooth = _on_grid(series, steps)
        opd, stop_x, stop_y, *_, root = smooth
        light = root * safe_sqrt(_stretch(series[3:5], steps) / half.prod())
        opd = opd + path(others, stop_x, stop_y, one_colour)[0] if others else opd
        cells_lit = _light_in_cells(smooth, [phasor[w] for phasor in phasors], pixels)
        field = torch.where(is_within, light * dft.phasor(opd / (1e-3 * one_colour)) * cells_lit, 0.0)
        L, M = directions.centre[:, d, f, w, None] + half[:, None] * steps
        along_x = dft.phasor(L[:, None] * (x[kernel] / inside[kernel]))
        along_y = dft.phasor(y[kernel][:, None] * (M / inside[kernel]))
        fields.append(along_y @ field @ along_x * (half.prod() * (2 / cells) ** 2 / inside[kernel]))
    return torch.stack(fields).unflatten(0, inside.shape)


def _pixels(element: Element) -> Pixels:
    assert isinstance(element.profile, Pixels)
    return element.profile


def _phasors(element: Element, wavelengths: Tensor) -> Tensor:
    """Phasors (W, rows, columns) of the pixels of an element as it is fabricated."""
    heights = fabricated_height(_pixels(element).heights, element.period, element.levels)
    waves = excess_index(element, wavelengths, heights) / (1e-3 * wavelengths)
    return dft.phasor(waves[:, None, None] * heights)


def _light_in_cells(smooth: Tensor, phasors: Sequence[Tensor], pixels: Sequence[Element]) -> Tensor:
    """The share of each cell (M, L) in the pupil times the phasor of the pixels there."""
    _, stop_x, stop_y, pupil_x, pupil_y, _ = smooth
    pairs = zip(phasors, pixels, strict=True)
    means = [_restored(_mean_of_pixels(phasor, _pixels(element), stop_x, stop_y), 2) for phasor, element in pairs]
    return _restored(_share_inside(pupil_x, pupil_y), 1) * functools.reduce(torch.mul, means)


def _restored(cells: Tensor, times: int) -> Tensor:
    """Means (M, L) over cells, taken so many times, with the first term of what they lose: each has the transform
    sinc(h f) ≈ 1 - (π h f)²/6, which second differences give back."""
    around = torch.cat([cells[:1], cells, cells[-1:]])
    around = torch.cat([around[:, :1], around, around[:, -1:]], -1)
    neighbours = around[1:-1, 2:] + around[1:-1, :-2] + around[2:, 1:-1] + around[:-2, 1:-1]
    return cells + times / 24 * (4 * cells - neighbours)


def _mean_of_pixels(phasors: Tensor, profile: Pixels, x: Tensor, y: Tensor) -> Tensor:
    """The mean phasor (M, L) around points (M, L) mm, of the four pixels there: the mean over cells, twice."""
    rows, columns = phasors.shape
    (left, right, share_x), (low, high, share_y) = (
        _neighbours(places / profile.pitch + 0.5 * count, _slope(places, axis) / profile.pitch, count)
        for places, axis, count in ((x, -1, columns), (y, -2, rows))
    )
    flat = phasors.flatten()

    def at(row: Tensor, column: Tensor) -> Tensor:
        return flat.index_select(0, (row * columns + column).flatten()).unflatten(0, row.shape)

    below = at(low, left) * (1 - share_x) + at(low, right) * share_x
    above = at(high, left) * (1 - share_x) + at(high, right) * share_x
    return below * (1 - share_y) + above * share_y


def _neighbours(place: Tensor, width: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """The pixels on both sides of the nearest step, and the share of the second around places, all in pixels.

    A step that two means over cells of a width blur: it ends one width from the step, with a continuous slope.
    """
    step = torch.round(place.detach())
    t = safe_divide(place - step, width.abs()).clamp(-1, 1)
    last = step.long()
    return (last - 1).clamp(0, count - 1), last.clamp(0, count - 1), 0.5 + t - 0.5 * t * t.abs()


def _share_inside(x: Tensor, y: Tensor) -> Tensor:
    """The share (M, L) of each cell in the unit disc of pupil points, its rim a straight line within the cell, moved by
    what the cell loses to its bend."""
    r = safe_sqrt(x * x + y * y)
    across, along = (_slope(r, axis).abs() for axis in (-1, -2))
    r = r + safe_divide(across * across + along * along, 24 * r)
    most, least = torch.maximum(across, along), torch.minimum(across, along)
    least = torch.maximum(least, 1e-3 * most)
    # The mean of a step over a rectangle: second integrals of it at the corners.
    total = torch.zeros_like(r)
    for sign, reach in ((1, most + least), (-1, most - least), (-1, least - most), (1, -most - least)):
        total = total + sign * (1 - r + 0.5 * reach).clamp_min(0) ** 2
    share = (0.5 * total / (most * least)).clamp(0, 1)
    return torch.where(r < 1 - 2 * most, 1.0, torch.where(r > 1 + 2 * most, 0.0, share))


def _slope(values: Tensor, axis: int) -> Tensor:
    """The change of values from cell to cell along an axis, of the cell before at the ends."""
    change = values.diff(dim=axis)
    count = change.shape[axis]
    first, last = change.narrow(axis, 0, 1), change.narrow(axis, count - 1, 1)
    return 0.5 * (torch.cat([first, change], axis) + torch.cat([change, last], axis))


def _on_grid(series: Tensor, steps: Tensor, by_M: int = 0, by_L: int = 0) -> Tensor:
    """Values (..., M, L) of series (..., degree + 1, degree + 1) at the same steps of M and L, or slopes by one."""
    order = torch.arange(series.shape[-1], dtype=steps.dtype, device=steps.device)[:, None]
    values, slopes = steps**order, order * steps ** (order - 1).clamp_min(0)
    return (values, slopes)[by_M].mT @ (series @ (values, slopes)[by_L])


def _stretch(pupil: Tensor, steps: Tensor) -> Tensor:
    """|∂(p_x, p_y)/∂(L, M)| (M, L) in units of the half square, by the series (2, degree + 1, degree + 1) of p."""
    (x_L, y_L), (x_M, y_M) = _on_grid(pupil, steps, by_L=1), _on_grid(pupil, steps, by_M=1)
    return (x_L * y_M - x_M * y_L).abs()


@functools.cache
def _conversion() -> tuple[Tensor, Tensor]:
    """Matrix (K, J) from Noll's terms to powers of L and M, the constant first, and the places (K,) in a square."""
    matrix, constants = zernike_to_powers(tuple(_ORDERS))
    norms = torch.tensor([zernike.norm(*order) for order in _ORDERS], dtype=torch.float64)
    of_constant = torch.from_numpy(constants)[None]
    exponents = [(0, 0), *powers(len(matrix))]
    places = torch.tensor([j * (_DEGREE + 1) + i for i, j in exponents])
    return torch.cat([of_constant, torch.from_numpy(matrix)]) * norms, places


def _in_powers(terms: Tensor) -> Tensor:
    """Zernike series (..., J) as coefficients of powers of M and L (..., degree + 1, degree + 1)."""
    matrix, places = (part.to(terms.device) for part in _conversion())
    square = terms.new_zeros(*terms.shape[:-1], (_DEGREE + 1) ** 2)
    return square.index_copy(-1, places, terms @ matrix.T).unflatten(-1, (_DEGREE + 1, _DEGREE + 1))
