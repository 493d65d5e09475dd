"""Coarse: what a fine map of pixels sends into a window, by cells as coarse as the window allows.

    g(X) = ∬ w(X - x) A exp(ik [(n - 1) h + r² V/2]) dA          V: vergence in the middle of all depths
    U_z(u) = 1/(λz) ∬ g(X) exp(ik [R² (V_z - V)/2 - X·u/z]) dX

Light that lands within v turns by less than v/(λz) per mm once the sphere is gone: w, a windowed sinc, keeps that band
and nothing that cells λz/(2v) apart would take for it. Depths differ by little: one g serves all of them. Pixels are
flat, the sphere is not: it is integrated over each of them. Sums run over the few pixels that w reaches, in single
precision if asked for; phases are in double precision.
"""

import dataclasses
import math

import numpy as np
import torch
from torch import Tensor

from raytrace.psf_models.dft import integrate, phasor
from raytrace.psf_models.radial import is_centred
from raytrace.wave_optics.compute import ElementPsf
from raytrace.wave_optics.element import Pixels, excess_index
from raytrace.wave_optics.plan import Plan
from raytrace.wave_optics.pupil import covered, light_of, to_pixels
from raytrace.wave_optics.scene import WaveScene, aperture, millimetres

_SHARE = 0.73  # of the band of the cells that is kept
_AIRY = 10.0  # λz/D around the window: what is bent there by diffraction
_STOPPED = 70.0  # dB: what the band lets through of light beyond it
_ERRORS = {1: 0.3, 2: 0.08, 3: 5e-3}  # of the worst kernel, by nodes, measured on 255 × 255 pixels behind 5 mm
_INNER = 4  # Gauss nodes across a pixel
_GROUP = 20  # cells that are summed together
_ROWS = 100  # of pixels whose phases are held at once


@dataclasses.dataclass(frozen=True)
class Band:
    """A matrix (pixels, cells) next to its diagonal: pieces of (cells, pixels, matrix)."""

    pieces: tuple[tuple[slice, slice, Tensor], ...]
    cells: int


@dataclasses.dataclass(frozen=True)
class Colour:
    """One colour: rate: waves per mm of height; band_x, band_y: from pixels to cells; bent: (D, n, n) of depths;
    along_x, along_y, pixel, folded: from there to the nodes of the pixels of the sensor, as for `PupilSums`."""

    rate: float
    band_x: Band
    band_y: Band
    bent: Tensor
    along_x: Tensor
    along_y: Tensor
    pixel: Tensor
    folded: bool


class Coarse:
    """What the heights of a map of pixels do not change: kernels of other heights come at a thirtieth of the price.

    scene: of one map of pixels, which fills the aperture, and a window centred on the axis, paraboloids; nodes: per
    pixel of the sensor and axis; dtype: of the sums. Raises ValueError for a scene of another kind.
    """

    def __init__(self, scene: WaveScene, nodes: int, *, dtype: torch.dtype = torch.float64):
        _check(scene)
        rows, columns = scene.elements[0].profile.heights.shape
        pitch, radius = scene.elements[0].profile.pitch, aperture(scene)
        y, x = (_axis(n, pitch) for n in (rows, columns))
        self.error = _ERRORS.get(nodes, 1e-3)
        self.weight = (covered(x, y, pitch, radius) / pitch**2).to(dtype)
        self.colours = tuple(
            _colour(dataclasses.replace(scene, wavelengths=scene.wavelengths[k : k + 1]), x, y, nodes, dtype)
            for k in range(len(scene.wavelengths))
        )

    def psf(self, scene: WaveScene) -> ElementPsf:
        """As `wave_psf` of a scene that differs in its heights alone; differentiable in them."""
        cells, nodes = self.colours[0].band_x.cells, len(self.colours[0].pixel)
        return ElementPsf(self.kernels(scene), scene, Plan("coarse", cells, nodes, self.error, 0.0, 0.0))

    def kernels(self, scene: WaveScene) -> Tensor:
        """Light in the pixels (D, W, rows, columns) of a scene that differs in its heights alone; differentiable."""
        heights = scene.elements[0].profile.heights
        light = []
        for colour in self.colours:
            field = _Gathered.apply(heights, self.weight, colour)
            light.append(light_of(scene, colour, (colour.bent * field)[:, None]))
        found = integrate(torch.cat(light, 1), self.colours[0].pixel, scene.grid.pitch.to(light[0]))
        return found.to(heights.dtype)


def _check(scene: WaveScene) -> None:
    if len(scene.elements) != 1 or not isinstance(scene.elements[0].profile, Pixels):
        raise ValueError("coarse cells stand for one map of pixels alone; use the pupil engine")
    if scene.exact or not is_centred(scene.grid) or scene.elements[0].period is not None:
        raise ValueError("coarse cells need paraboloids, a window on the axis, heights that are not wrapped")
    profile, radius = scene.elements[0].profile, float(aperture(scene))
    across = float(profile.pitch) * min(profile.heights.shape)
    if across < 2 * radius * (1 - 1e-9):
        raise ValueError(f"the pixels are {across:g} mm across, less than the aperture of {2 * radius:g} mm")


def _axis(count: int, pitch: Tensor) -> Tensor:
    """Centres (N,) mm around the axis."""
    return (torch.arange(count, dtype=pitch.dtype) - 0.5 * (count - 1)) * pitch


def _colour(scene: WaveScene, x: Tensor, y: Tensor, nodes: int, dtype: torch.dtype) -> Colour:
    z, wavelength, radius = scene.sensor_distance, millimetres(scene)[0], aperture(scene)
    pitch = scene.elements[0].profile.pitch
    near = 1 / scene.depths
    middle = 0.5 * (near.min() + near.max())
    width = wavelength * z  # mm²: a wave per mm of the pupil
    half_window = 0.5 * scene.grid.pitch * max(scene.grid.shape)
    kept = half_window + radius * z * (near - middle).abs().max() + _AIRY * width / (2 * radius)
    step = _SHARE * width / (2 * kept)
    if pitch > step:
        finest = 1e3 * float(step)
        raise ValueError(f"pixels of {1e3 * float(pitch):g} µm are too coarse for these cells: {finest:.3g} µm at most")
    step = torch.floor(step / pitch) * pitch
    half = (_STOPPED - 8) / (2 * 2.285 * 2 * math.pi) / (1 - 2 * float(kept * step / width))  # of w, in cells
    count = 2 * math.ceil(float(radius / step) + half)
    cells = _axis(count, step)
    curve = 0.5 * (middle + 1 / z) / wavelength
    bands = [_band(axis, cells, pitch, curve, half, dtype) for axis in (x, y)]
    # Light per mm² of all through the aperture as 1: √ of its area, and cells instead of an integral.
    scale = step**2 / (width * math.sqrt(math.pi) * radius)
    turned = phasor(0.5 * (near - middle)[:, None, None] / wavelength * (cells**2 + (cells**2)[:, None]))
    along_x, along_y, pixel, folded = to_pixels(scene, cells / z, nodes)
    rate = float(excess_index(scene.elements[0], scene.wavelengths, z)[0] / wavelength)
    bent = (scale * turned).to(torch.complex64 if dtype == torch.float32 else torch.complex128)
    return Colour(rate, *bands, bent, along_x.to(dtype), along_y.to(dtype), pixel.to(dtype), folded)


def _band(x: Tensor, cells: Tensor, pitch: Tensor, curve: Tensor, half: float, dtype: torch.dtype) -> Band:
    """∫ w(X - x) exp(2πi curve x²) dx over each pixel, for cells X of which w reaches `half` to either side."""
    step, kind = cells[1] - cells[0], torch.complex64 if dtype == torch.float32 else torch.complex128
    pieces = []
    for first in range(0, len(cells), _GROUP):
        own = slice(first, min(first + _GROUP, len(cells)))
        ends = cells[own][0] - half * step, cells[own][-1] + half * step
        low, high = (int(n) for n in torch.searchsorted(x, torch.stack(ends)))
        if low < high:
            pieces.append((own, slice(low, high), _reached(x[low:high], cells[own], pitch, curve, half).to(kind)))
    return Band(tuple(pieces), len(cells))


def _reached(x: Tensor, cells: Tensor, pitch: Tensor, curve: Tensor, half: float) -> Tensor:
    """(pixels, cells), Kaiser's window on a sinc."""
    step = cells[1] - cells[0]
    beta = 0.1102 * (_STOPPED - 8.7)
    total = 0.0
    for place, share in zip(*(a / 2 for a in np.polynomial.legendre.leggauss(_INNER)), strict=True):
        at = x + place * pitch
        apart = (at[:, None] - cells) / step
        inside = (1 - (apart / half) ** 2).clamp(min=0.0)
        window = torch.special.i0(beta * torch.sqrt(inside)) / float(np.i0(beta)) * (inside > 0)
        total = total + share * torch.sinc(apart) * window * phasor(curve * at * at)[:, None]
    return total * (pitch / step)


def _turned(heights: Tensor, weight: Tensor, rate: float) -> Tensor:
    """A exp(2πi rate h) of some rows; whole waves are taken out before precision is."""
    waves = heights.double() * rate
    angle = (2 * math.pi * (waves - torch.round(waves))).to(weight.dtype)
    return torch.complex(torch.cos(angle) * weight, torch.sin(angle) * weight)


class _Gathered(torch.autograd.Function):
    """g (n, n) from heights (N, M): phases are made row by row, twice, rather than kept."""

    @staticmethod
    def forward(ctx, heights: Tensor, weight: Tensor, colour: Colour) -> Tensor:
        ctx.save_for_backward(heights, weight)
        ctx.colour = colour
        x, y = colour.band_x, colour.band_y
        kind = x.pieces[0][2].dtype
        along = torch.zeros(len(heights), x.cells, dtype=kind)
        for rows in _parts(len(heights)):
            light = _turned(heights[rows], weight[rows], colour.rate)
            for cells, pixels, matrix in x.pieces:
                along[rows, cells] = light[:, pixels] @ matrix
        field = torch.zeros(y.cells, x.cells, dtype=kind)
        for cells, pixels, matrix in y.pieces:
            field[cells] = matrix.T @ along[pixels]
        return field

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor):
        (heights, weight), colour = ctx.saved_tensors, ctx.colour
        x, y = colour.band_x, colour.band_y
        along = torch.zeros(len(heights), x.cells, dtype=gradient.dtype)
        for cells, pixels, matrix in y.pieces:
            along[pixels] += matrix.conj() @ gradient[cells]
        found = torch.empty_like(heights)
        for rows in _parts(len(heights)):
            light = _turned(heights[rows], weight[rows], colour.rate)
            slope = torch.zeros_like(light)
            for cells, pixels, matrix in x.pieces:
                slope[:, pixels] += along[rows, cells] @ matrix.mH
            found[rows] = 2 * math.pi * colour.rate * (slope.imag * light.real - slope.real * light.imag)
        return found, None, None


def _parts(count: int):
    return (slice(first, min(first + _ROWS, count)) for first in range(0, count, _ROWS))
