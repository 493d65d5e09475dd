"""Pupil engine: the field at the sensor as one matrix Fourier transform of the residual path behind the element.

    U(u) = 1/(λz) Σ_cells A exp(ik W_residual) exp(-ik x·u/z) dA

The sphere that converges to the sensor and its chirp cancel, so that only the residual path is sampled, and the sum is
taken at the points of the pixels: no padding, any window (Soummer et al., Opt. Express 15, 15935 (2007)). With true
spheres x/z becomes the direction sine t = x/√(r² + z²), on which the grid is then regular (Debye's integral).
Flat pixels are integrated exactly: their plane and the paraboloid, which separates in x and y, are summed at Gauss
nodes inside each of them, whatever the angle of the light.
"""

import functools
import math

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import Number, safe_sqrt, value
from raytrace.psf_models.dft import phasor, sub_pixels
from raytrace.psf_models.radial import is_centred
from raytrace.wave_optics.element import Pixels, is_smooth, path
from raytrace.wave_optics.scene import WaveScene, aperture, millimetres, residual, spheres

_MARGIN = 3  # cells beyond the aperture: half the points of the interpolation at its edge


@value
class ToPixels:
    """Matrices of the transform from cells to the nodes of the pixels.

    along_x: (W, X, N) or (D, W, X, N), along_y likewise, or if `folded` cosine and sine of one half of the points of
    both axes, (2, W, X/2, N/2); pixel: (n,) weights of the nodes in a pixel of the sensor.
    """

    along_x: Tensor
    along_y: Tensor
    pixel: Tensor
    folded: bool = False


@value
class PupilSums:
    """Sums that do not depend on the heights: the matrices of the transform and the cells of the aperture.

    x, y: (N, N) mm, centres of the cells; weight: (W, N, N), light through a cell; sphere: (D, N, N) mm.
    """

    x: Tensor
    y: Tensor
    weight: Tensor
    sphere: Tensor
    to_pixels: ToPixels


def prepare(scene: WaveScene, samples: int, nodes: int, *, extent: float = 1.0) -> PupilSums:
    """Constants of samples × samples cells over `extent` times the diameter, nodes per sensor pixel and axis.

    Cells that the edge of the aperture cuts count by their area inside, which is exact for flat ones; smooth elements
    have weights of higher order, for which the grid is wider by three cells on either side.
    """
    R, z, wavelength = aperture(scene), scene.sensor_distance, millimetres(scene)
    if all(is_smooth(element) for element in scene.elements):
        cells, extent = smooth_cells(samples), extent * (samples + 2 * _MARGIN) / samples
    else:
        cells = disc_cells(samples, extent)
    edge = R / torch.sqrt(R * R + z * z) if scene.exact else R / z
    t = edge * R.new_tensor((2 * np.arange(len(cells)) + 1) / len(cells) - 1) * extent
    x, y, stretch = cells_at(scene, t)
    # dA cos θ/|x - u| = z dt² paraxially, z dt²/(1 - t²) for a true sphere.
    light = R.new_tensor(cells) * edge**2 * stretch**2 * z / (math.sqrt(math.pi) * R)
    light = light / wavelength[:, None, None]
    return PupilSums(x, y, light, spheres(scene, x * x + y * y), to_pixels(scene, t, nodes))


def cells_at(scene: WaveScene, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x, y (N, N) mm of cells at t (N,) on both axes, and √(r² + z²)/z there; paraxially x = z t and 1."""
    t2, z = t * t + (t * t)[:, None], scene.sensor_distance
    stretch = 1 / torch.sqrt(1 - torch.clamp(t2, max=0.99)) if scene.exact else torch.ones_like(t2)
    return z * t * stretch, z * t[:, None] * stretch, stretch


def to_pixels(scene: WaveScene, t: Tensor, nodes: int) -> ToPixels:
    """The matrices from cells at t (N,) on both axes to the nodes of the pixels."""
    u, v, pixel = sub_pixels(scene.grid, nodes)
    folded = is_centred(scene.grid)

    def along(s: Tensor) -> Tensor:
        if not folded:
            return waves_at(s, t, millimetres(scene))
        wave = waves_at(s[len(s) // 2 :], t[len(t) // 2 :], millimetres(scene))
        cosine = wave.real
        if len(t) % 2:  # the point in the middle is its own image
            cosine = torch.cat([0.5 * cosine[..., :1], cosine[..., 1:]], -1)
        return torch.stack([cosine, -wave.imag])

    return ToPixels(along(u), along(v), pixel, folded)


@value
class PixelSums:
    """The same of one map of flat pixels, n × n of which cover the aperture; its edge cuts M of them.

    x, y: (n, n) mm, centres of the pixels, or None with `waves` (W, n, n), of `behind_pixels`; whole: (W, n, n) light
    through each cell of the pixels that lie inside the aperture, 0 of others; rows, columns: (M,) of the cut ones, cut:
    (W, M, parts, parts) light through their cells. The matrices of `to_pixels` have the cells of all pixels in turn.
    """

    x: Tensor | None
    y: Tensor | None
    waves: Tensor | None
    whole: Tensor
    rows: Tensor
    columns: Tensor
    cut: Tensor
    to_pixels: ToPixels


def prepare_pixels(
    scene: WaveScene, nodes: int, inner: int, *, parts: int = 1, behind: Tensor | None = None
) -> PixelSums:
    """The same for one map of flat pixels, each of parts × parts cells for the edge of the aperture.

    inner: Gauss nodes for the paraboloid and the plane wave across a cell; behind: of `behind_pixels`, if it is known.
    """
    fine_x, fine_y, cell = _lattice(scene, parts)
    u, v, pixel = sub_pixels(scene.grid, nodes)
    along_x, along_y = (_across_pixels(scene, centre, s, cell, inner) for centre, s in ((fine_x, u), (fine_y, v)))
    x, y, pitch = _lattice(scene, 1)
    R = aperture(scene)
    # Light per area, of each wavelength.
    light = 1 / (scene.sensor_distance * math.sqrt(math.pi) * R) / millimetres(scene)
    far, near = (
        torch.hypot(
            *torch.broadcast_tensors(
                *((c.detach().abs() + side * pitch.detach()).clamp_min(0) for c in (x, y[:, None]))
            )
        )
        for side in (0.5, -0.5)
    )
    is_whole = far < R.detach()
    rows, columns = torch.nonzero(~is_whole & (near < R.detach())).unbind(1)
    steps = pitch * (torch.arange(parts + 1, dtype=pitch.dtype, device=pitch.device) / parts - 0.5)
    edges_x, edges_y = ((centre[:, None] + steps).double() / R for centre in (x[columns], y[rows]))
    cut = _areas_between(edges_x[:, None], edges_y[..., None]).to(light) * R**2
    whole = light[:, None, None] * torch.where(is_whole, cell * cell, 0.0)
    x, y = torch.broadcast_tensors(x, y[:, None])
    places: tuple[Tensor | None, Tensor | None] = (x, y) if behind is None else (None, None)
    matrices = ToPixels(along_x, along_y, pixel)
    return PixelSums(*places, behind, whole, rows, columns, light[:, None, None, None] * cut, matrices)


def behind_pixels(scene: WaveScene) -> Tensor:
    """Phasors (W, n, n) of the pixels of `prepare_pixels`, for all depths and windows."""
    x, y, _ = _lattice(scene, 1)
    return _phasor_of(scene, *torch.broadcast_tensors(x, y[:, None]))


def _light_of_pixels(scene: WaveScene, sums: PixelSums) -> Tensor:
    """`light_of` pixels: the cells of one pixel have one height, so that those of whole pixels are summed beforehand,

        U = Σ_whole w_p Σ_j b_j Σ_i a_i + Σ_j b_j Σ_cut w_p Σ_i c_ij a_i

    with a, b the matrices along x and y. Cells of cut pixels alone are summed with their areas c, row by row.
    """
    if sums.waves is None:
        assert sums.x is not None
        assert sums.y is not None
        waves = _phasor_of(scene, sums.x, sums.y)
    else:
        waves = sums.waves
    (n_y, n_x), parts = sums.whole.shape[-2:], sums.cut.shape[-1]
    along_x, along_y = sums.to_pixels.along_x, sums.to_pixels.along_y
    cells_x, cells_y = along_x.unflatten(-1, (n_x, parts)), along_y.unflatten(-1, (n_y, parts))
    U = cells_y.sum(-1) @ (sums.whole * waves) @ cells_x.sum(-1).mT
    cut = sums.cut * waves[:, sums.rows, sums.columns, None, None]
    each = cut @ cells_x.movedim(2, -1)[:, :, sums.columns]  # (D, W, M, parts, X)
    lines = each.new_zeros(*each.shape[:2], n_y, *each.shape[3:]).index_add(2, sums.rows, each)
    U = U + along_y @ lines.flatten(2, 3)
    return U.real**2 + U.imag**2


def _lattice(scene: WaveScene, parts: int) -> tuple[Tensor, Tensor, Tensor]:
    """Centres x (X,), y (Y,) mm of the cells of one map of pixels, and their pitch."""
    profile, R = scene.elements[0].profile, aperture(scene)
    assert isinstance(profile, Pixels)  # as the plan has found
    pitch = profile.pitch / parts
    counts = (parts * cells_across(profile.pitch, n, R) for n in profile.heights.shape[::-1])
    x, y = (pitch * (torch.arange(n, dtype=R.dtype, device=R.device) - 0.5 * (n - 1)) for n in counts)
    return x, y, pitch


def _phasor_of(scene: WaveScene, x: Tensor, y: Tensor) -> Tensor:
    """Phasors (W, ...) of the path of the elements at x, y (...) mm."""
    return phasor(path(scene.elements, x, y, scene.wavelengths) / millimetres(scene)[:, None, None])


def intensity(scene: WaveScene, sums: "PupilSums | PixelSums") -> Tensor:
    """Light per mm² (D, W, Y, X) at the nodes of the pixels, 1 = all through the aperture."""
    if isinstance(sums, PixelSums):
        return _light_of_pixels(scene, sums)
    waves = residual(scene, sums.x, sums.y, sums.sphere)
    return light_of(scene, sums.to_pixels, sums.weight * phasor(waves / millimetres(scene)[:, None, None]))


def light_of(scene: WaveScene, matrices: ToPixels, U: Tensor) -> Tensor:
    """|U|² (..., W, Y, X) at the nodes of the pixels, of light through cells (..., W, N, N).

    If the matrices are `folded`, the real and the imaginary part are summed by real products of a quarter of the size,

        exp(-i(a + b)) = cos a cos b - sin a sin b - i (sin a cos b + cos a sin b)

    Cosines see the even part, sines the odd one, and the signs of a and b give the four quadrants.
    """
    if not matrices.folded:
        U = matrices.along_y @ U @ matrices.along_x.mT
        return U.real**2 + U.imag**2
    (cos_y, sin_y), (cos_x, sin_x) = matrices.along_y, matrices.along_x
    even, odd = _fold(torch.stack([U.real, U.imag]), -2)
    rows = [(_fold(along @ part, -1)) for along, part in ((cos_y, even), (sin_y, odd))]
    (cc, cs), (sc, ss) = ((e @ cos_x.mT, o @ sin_x.mT) for e, o in rows)
    quadrants = []
    for a, b in ((cc - ss, sc + cs), (cc + ss, sc - cs)):
        both, cross = (a * a + b * b).sum(0), 2 * (a[0] * b[1] - a[1] * b[0])
        quadrants += [both + cross, both - cross]
    (pp, mm), (pm, mp) = quadrants[:2], quadrants[2:]  # signs of y, x
    counts = (n * len(matrices.pixel) for n in scene.grid.shape)  # of nodes along y and x
    axes = matrices.along_y, matrices.along_x
    skip_y, skip_x = (2 * along.shape[-2] - n for along, n in zip(axes, counts, strict=True))
    above, below = (torch.cat([m[..., skip_x:].flip(-1), p], -1) for m, p in ((pm, pp), (mm, mp)))
    return torch.cat([below[..., skip_y:, :].flip(-2), above], -2)


def disc_cells(samples: int, extent: float = 1.0) -> np.ndarray:
    """Area (N, N) of the unit disc in each cell of a square grid over [-extent, extent]²."""
    edges = torch.as_tensor((2 * np.arange(samples + 1) / samples - 1) * extent, dtype=torch.float64)
    return _cell_areas(edges, edges).numpy()


@functools.lru_cache(maxsize=16)
def smooth_cells(samples: int) -> np.ndarray:
    """Weights (N + 2·margin, …) of smooth values at the centres of cells, N across the unit disc, in its integral.

    w_j = ∬_disc φ(x - x_j) φ(y - y_j) dx dy, φ the cardinal function of six-point Lagrange interpolation. Areas alone
    err by the square of the cell (measured on a blurred spot, N = 160: 3e-4 instead of 2.5e-3).
    """
    size = samples + 2 * _MARGIN
    sub = 2 * max(2, min(8, 1024 // size))
    half = size * sub // 2
    edges = torch.linspace(0, size / samples, half + 1, dtype=torch.float64)
    fine = _cell_areas(edges, edges).numpy()  # a quadrant, by symmetry
    apart = np.abs((np.arange(size * sub) + 0.5) / sub - (np.arange(size)[:, None] + 0.5))
    share = np.zeros_like(apart)
    for k in range(_MARGIN):
        within = (apart >= k) & (apart < k + 1)
        nodes = [n for n in range(k - _MARGIN + 1, k + _MARGIN + 1) if n != 0]
        share[within] = np.prod([(apart[within] - n) / -n for n in nodes], 0)
    share = share[:, half:] + share[:, :half][:, ::-1]
    return share @ fine @ share.T


def _cell_areas(x: Tensor, y: Tensor) -> Tensor:
    """Area of the unit disc between edges x (X + 1) and y (Y + 1)."""
    return _areas_between(x, y[:, None])


def _areas_between(x: Tensor, y: Tensor) -> Tensor:
    """Areas (..., Y, X) of the unit disc between edges x (..., 1, X + 1), y (..., Y + 1, 1), by those up to corners."""
    # Short of 1 by less than counts, where the two terms of the cap have infinite slopes that cancel.
    a, b = torch.abs(x).clamp(max=1 - 1e-12), torch.abs(y).clamp(max=1 - 1e-12)
    cap = [safe_sqrt(1 - c * c) * c + torch.asin(c) for c in (a, b)]
    outside = 0.5 * (cap[0] + cap[1] - 0.5 * math.pi)
    quadrant = torch.where(a * a + b * b <= 1, a * b, outside) * torch.sign(x) * torch.sign(y)
    return quadrant.diff(dim=-2).diff(dim=-1).clamp(min=0.0)


def waves_at(u: Tensor, t: Tensor, wavelength: Tensor) -> Tensor:
    """exp(-2πi u t/λ): (W, U, N)."""
    return phasor(-u[:, None] * t / wavelength[:, None, None])


def _fold(values: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Sum and difference of the upper half of an axis and the mirrored lower half; a middle counts in both."""
    size = values.shape[dim]
    half = (size + 1) // 2
    upper, lower = values.narrow(dim, size - half, half), values.narrow(dim, 0, half).flip(dim)
    return upper + lower, upper - lower


def cells_across(pitch: Tensor, count: int, radius: Tensor) -> int:
    """How many cells of a lattice that is symmetric about the axis, with `count` or two more or fewer, cover a disc."""
    odd = count % 2
    return max(1, 2 * math.ceil(float((radius / pitch).detach()) - 0.5 * odd - 1e-6) + odd)


def _across_pixels(scene: WaveScene, centre: Tensor, u: Tensor, pitch: Tensor, inner: int) -> Tensor:
    """∫ exp(ik [x²(1/z' + 1/z)/2 - x u/z]) dx/pitch over each pixel: (D, W, U, N)."""
    z, wavelength = scene.sensor_distance, millimetres(scene)[:, None, None]
    place, share = (pitch.new_tensor(a) / 2 for a in np.polynomial.legendre.leggauss(inner))
    curve = (0.5 * (1 / scene.depths + 1 / z)).reshape(-1, 1, 1, 1)
    total: Number = 0.0
    for p, s in zip(place, share, strict=True):
        x = centre + p * pitch
        total = total + s * phasor(curve * x**2 / wavelength) * phasor(-u[:, None] * x / z / wavelength)
    return total
