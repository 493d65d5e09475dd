"""Peers, as the benchmarks call them: Optiland, its trace and its PSFs, and ray-optics, on the same lens and rays.

How they trace stands in `peers_trace`. Optiland's PSFs are those of its numpy back end with compiled loops, float64,
forward only, launching rays included, as in this package's: `IncoherentIrradiance`, the histogram of random rays on the
pixels of the window; `HuygensPSF`, its direct sum at the midpoints of the parts of every pixel, whose mean a pixel is;
`FFTPSF`, on its own grid about the chief ray, brought to the same midpoints by bilinear interpolation. Its waves are
normalised to the peak of a perfect lens, so each kernel is given the energy of the reference in the window: shapes are
compared.

Importing this file imports Optiland: it needs the extra [bench].
"""

import functools
import importlib
import importlib.util
import math
from collections.abc import Callable
from importlib.metadata import version

import numba
import numpy as np
import optiland.backend as be
import torch
from optiland.analysis import IncoherentIrradiance
from optiland.optic import Optic
from optiland.physical_apertures import RadialAperture, RectangularAperture
from optiland.psf import FFTPSF
from optiland.psf.huygens_fresnel import ScalarHuygensPSF

from raytrace.bench.measure import DTYPES
from raytrace.bench.peers_trace import Optiland, PosedOptiland, RayOptics
from raytrace.bench.psf import Truth
from raytrace.bench.psf_cases import Case, Method
from raytrace.maths.grid import Grid
from raytrace.psf_models.result import Kernels
from raytrace.system.lens import Lens, with_object_distance
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import Scene

_RANDOM = (10_000, 100_000, 1_000_000)
_HUYGENS = ((64, 3), (96, 5))  # rays across the pupil, points across a pixel
_FFT = ((128, 512), (256, 2048))  # rays across the pupil, points of the transform
_OPEN = 1e9  # mm: an aperture without an outer edge
_PARTS = 6  # of a pixel, where the FFT is integrated


def set_threads(threads: int) -> None:
    """Threads of Optiland's compiled loops. They may set those of torch too, which are set at every timed call."""
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))


def peers(lens: Lens, kind: type[Optiland] = Optiland) -> list[Optiland]:
    """For `bench trace`: Optiland in float32 and float64 on torch, and on numpy."""
    found = [kind(lens, dtype, backend="torch") for dtype in DTYPES]
    return [*found, kind(lens, torch.float64, backend="numpy")]


def posed_peers(lens: Lens) -> list[Optiland]:
    """The same for a lens of toroids, gratings and tilts."""
    return peers(lens, PosedOptiland)


def rivals(lens: Lens, dtype: torch.dtype) -> list[Optiland | RayOptics]:
    """For `bench speed`: Optiland on torch in this dtype and on numpy, always float64, gradients by indices, too; and
    ray-optics, beside float64, of spheres and where it is installed."""
    found = [Optiland(lens, dtype, backend="torch", by_indices=True), Optiland(lens, torch.float64, backend="numpy")]
    simple = all(one.coefficients is None and one.conic is None for one in lens.surfaces)
    others = dtype == torch.float64 and simple and importlib.util.find_spec("rayoptics") is not None
    return [*found, RayOptics(lens)] if others else found


def versions() -> dict[str, str]:
    """Versions of the peers, for people."""
    names = {"Optiland": "optiland", "numba": "numba", "ray-optics": "rayoptics"}
    return {word: version(name) for word, name in names.items() if importlib.util.find_spec(name) is not None}


# -- PSFs --------------------------------------------------------------------------------------------------------------


def psf_methods(truth: Truth) -> list[Method]:
    """Optiland on one case; none where the lens has what is not handed over (an aperture that is not an annulus)."""
    optic = optic_of(truth.case)
    if optic is None:
        return []
    energy = {name: float(kernel.sum()) for name, kernel in truth.kernels.items()}
    field = (0.0, 1.0 if truth.case.field else 0.0)
    wavelength = float(truth.case.lens.primary)

    def method(model: str, sampling: str, against: str, compute: Callable, *sizes: int) -> Method:
        run = functools.partial(_run, compute, optic, field, wavelength, sizes, energy.get(against, 1.0))
        return Method(f"Optiland {model}", sampling, run, against, has_gradient=False)

    found = [method("histogram", f"{n:,} rays", "rays", _histogram, n) for n in _RANDOM]
    found += [method("Huygens", f"{n}² grid, {m}² a pixel", "wave", _huygens, n, m) for n, m in _HUYGENS]
    return found + [method("FFT", f"{n}² grid, {m}² points", "wave", _fft, n, m) for n, m in _FFT]


def optic_of(case: Case) -> Optic | None:
    """The lens of a case with its aperture, field and object distance."""
    lens = with_object_distance(case.lens, case.distance)
    optic = Optiland(lens, torch.float64, backend="numpy").optic
    optic.set_aperture("EPD", float(first_order(lens).entrance_pupil_diameter))
    if case.field:
        optic.fields.add(y=case.field)
    for number, surface in enumerate(lens.surfaces):
        for aperture in surface.apertures:
            inner, outer = aperture.extent
            central = aperture.shape == "circular" and aperture.centre == (0.0, 0.0)
            if not central or (aperture.obscures and inner > 0):
                return None
            inner, outer = (outer, math.inf) if aperture.obscures else (inner, outer)
            optic.surfaces[number].aperture = RadialAperture(r_max=min(outer, _OPEN), r_min=inner)
    return optic


def _run(compute, optic, field, wavelength, sizes, energy: float, scene: Scene, grid: Grid) -> Kernels:
    be.set_backend("numpy")
    kernel, count = compute(optic, field, wavelength, grid, *sizes)
    kernel = torch.as_tensor(np.ascontiguousarray(kernel) * (energy / kernel.sum()))
    return Kernels(kernel, grid, None, None, count)


def _histogram(optic: Optic, field, wavelength: float, grid: Grid, count: int) -> tuple[np.ndarray, int]:
    (x0, y0), half = grid.centre.tolist(), 0.5 * grid.columns * float(grid.pitch)
    image = optic.surfaces[-1]
    image.aperture = RectangularAperture(x0 - half, x0 + half, y0 - half, y0 + half)
    try:
        found = IncoherentIrradiance(optic, count, (grid.columns, grid.rows), fields=[field], wavelengths=[wavelength])
        irradiance = found.data[0][0]
        irradiance = irradiance[0] if isinstance(irradiance, (tuple, list)) else irradiance
    finally:
        image.aperture = None
    return np.asarray(irradiance).T, count


class _AtPoints(ScalarHuygensPSF):
    """Optiland's direct sum at the midpoints of the parts of the pixels of a given window."""

    def __init__(self, *arguments, corner: tuple[float, float], **others):
        self.corner = corner
        super().__init__(*arguments, normalization=1.0, **others)

    def _get_image_extent(self) -> tuple[float, float, float, float]:
        length = (self.image_size - 1) * self.pixel_pitch
        (x, y), half = self.corner, 0.5 * self.pixel_pitch
        return x + half, x + half + length, y + half, y + half + length


def _huygens(optic: Optic, field, wavelength: float, grid: Grid, across: int, parts: int) -> tuple[np.ndarray, int]:
    corner = tuple(c - 0.5 * grid.columns * float(grid.pitch) for c in grid.centre.tolist())
    pitch = float(grid.pitch) / parts
    found = _AtPoints(optic, field, wavelength, across, grid.columns * parts, pixel_pitch=pitch, corner=corner)
    return _pixels(np.asarray(found.psf), parts), len(found.get_data(field, wavelength).opd)


def _fft(optic: Optic, field, wavelength: float, grid: Grid, across: int, points: int) -> tuple[np.ndarray, int]:
    found = FFTPSF(optic, field, wavelength, across, points)
    step = 1e-3 * wavelength * found._get_working_FNO() * (across - 1) / points
    chief = optic.trace_generic(*field, 0.0, 0.0, wavelength)
    line = (np.arange(grid.columns * _PARTS) + 0.5) / _PARTS - 0.5 * grid.columns
    places = []
    for centre, start in zip(grid.centre.tolist(), (chief.x, chief.y), strict=True):
        offset = centre - float(np.asarray(start).item()) + line * float(grid.pitch)
        places.append(offset / step + points // 2)
    return _pixels(_bilinear(np.asarray(found.psf), *places), _PARTS), len(found.get_data(field, wavelength).opd)


def _bilinear(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The image (rows, columns) at fractional columns x (X,) and rows y (Y,); 0 outside."""
    image = np.pad(image, 1)

    def split(place: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        place = np.clip(place + 1, 0, count - 1.000001)
        return place.astype(int), place % 1

    (j, u), (i, v) = split(x, image.shape[1]), split(y, image.shape[0])
    rows = image[i] * (1 - v)[:, None] + image[i + 1] * v[:, None]
    return rows[:, j] * (1 - u) + rows[:, j + 1] * u


def _pixels(fine: np.ndarray, parts: int) -> np.ndarray:
    """Sums over parts × parts."""
    return fine.reshape(fine.shape[0] // parts, parts, fine.shape[1] // parts, parts).sum((1, 3))
