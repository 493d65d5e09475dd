"""Peers: Optiland, its trace and its PSFs, and the trace of ray-optics, on the same lens and rays.

Of Optiland's trace `optic.surfaces.trace(rays, skip=1, record=False)` is timed, the loop over surfaces alone: no
paraxial launch, no ray aiming, no snapshots, media of constant index. Its grad mode is off, so that only the variables
are leaves of the graph. It always computes the optical path.

Optiland's PSFs are those of its numpy back end, float64, forward only, with the launch of rays as in this package:
`IncoherentIrradiance`, the histogram of random rays on the pixels of the window; `HuygensPSF`, its direct sum at the
midpoints of the parts of every pixel; `FFTPSF`, on its own grid about the chief ray, interpolated to these midpoints.
Kernels are scaled to the energy of the reference in the window: shapes are compared.

Importing this file imports Optiland: it needs the extra [bench].
"""

import functools
import importlib
import importlib.util
import math
import warnings
from collections.abc import Callable
from importlib.metadata import version

import numba
import numpy as np
import optiland.backend as be
import torch
from optiland.analysis import IncoherentIrradiance
from optiland.materials import IdealMaterial
from optiland.optic import Optic
from optiland.physical_apertures import RadialAperture, RectangularAperture
from optiland.psf import FFTPSF
from optiland.psf.huygens_fresnel import ScalarHuygensPSF
from optiland.rays import RealRays
from torch import Tensor

from raytrace.bench.measure import DTYPES, name_of, nothing, shape_of, squared_radius, variables
from raytrace.bench.psf import Truth
from raytrace.bench.psf_cases import Case, Method
from raytrace.maths.numerics import to
from raytrace.maths.sampling import Grid
from raytrace.psf_models.result import Kernels
from raytrace.system.lens import Lens, media, with_object_distance
from raytrace.system.rays import Rays
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import Scene

_RAY_OPTICS_MOST = 1024  # rays: it traces one at a time in Python
_RANDOM = (10_000, 100_000, 1_000_000)
_HUYGENS = ((64, 3), (96, 5))  # rays across the pupil, points across a pixel
_FFT = ((128, 512), (256, 2048))  # rays across the pupil, points of the transform
_OPEN = 1e9  # mm: an aperture without an outer edge
_PARTS = 6  # of a pixel, where the FFT is integrated


class Optiland:
    """A lens in Optiland. backend: "torch" or "numpy" (float64, forward only).

    by_indices: gradients also with respect to the index of every medium.
    """

    with_path, most = True, None

    def __init__(self, lens: Lens, dtype: torch.dtype, *, backend: str, by_indices: bool = False):
        self.name = f"Optiland, {backend}"
        self.dtype, self.backend, self.by_indices = dtype, backend, by_indices
        self.has_gradient = backend == "torch"
        self.lens = to(lens, dtype=dtype)
        self.wavelength = float(lens.primary)
        self.indices = media(self.lens, self.lens.primary)
        self._leaves: tuple[list[Tensor], dict[int, Tensor]] | None = None
        self.prepare()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Optiland and numba
            self.optic = self._build()
            self._set_conditions()
            axis = torch.zeros(3, 2, dtype=dtype)
            axis[2] = 1.0
            self.forward(Rays(torch.zeros_like(axis), axis, torch.ones(2, dtype=torch.bool)))  # compiles

    def prepare(self) -> None:
        """Optiland's back end, precision and grad mode are global."""
        be.set_backend(self.backend)
        if self.backend == "torch":
            be.set_precision(name_of(self.dtype))
            be.grad_mode.disable()

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]:
        if self._leaves is not None:
            self._without_leaves()
        with torch.no_grad():
            end = self._trace(rays)
        return torch.stack([torch.as_tensor(end.x), torch.as_tensor(end.y)]), torch.as_tensor(end.opd)

    def gradient(self, rays: Rays, centroid: Tensor) -> list[Tensor]:
        """By Optiland's variables radius, thickness and index; d/dc = -R² d/dR."""
        if self._leaves is None:
            self._leaves = self._with_leaves()
        leaves, thicknesses = self._leaves
        z = torch.zeros((), dtype=self.dtype)
        for number in range(1, len(self.lens.surfaces)):
            self.optic.surfaces[number].geometry.cs.z = z
            z = z + thicknesses.get(number, 0.0)
        end = self._trace(rays)
        slopes = list(torch.autograd.grad(squared_radius(end.x, end.y, centroid), leaves))
        for place, (_, name) in enumerate(variables(self.lens)):
            if name == "curvature":
                slopes[place] = -(leaves[place].detach() ** 2) * slopes[place]
        return slopes

    def _with_leaves(self) -> tuple[list[Tensor], dict[int, Tensor]]:
        """The variables as leaves, and those that are thicknesses by surface."""
        surfaces, leaves, thicknesses = self.optic.surfaces, [], {}
        for number, name in variables(self.lens):
            if name == "curvature":
                leaf = surfaces[number].geometry.radius.detach().clone().requires_grad_()
                surfaces[number].geometry.radius = leaf
            else:
                leaf = self.lens.surfaces[number].thickness.detach().clone().requires_grad_()
                thicknesses[number] = leaf
            leaves.append(leaf)
        leaf = None
        for number, index in enumerate(self.indices if self.by_indices else ()):
            if number == 0 or index is not self.indices[number - 1]:
                leaf = index.detach().reshape(1).clone().requires_grad_()
                leaves.append(leaf)
            surfaces[number].material_post.index = leaf
        return leaves, thicknesses

    def _without_leaves(self) -> None:
        """Leave no graph behind for the forward runs."""
        for number in range(1, len(self.lens.surfaces)):
            surface = self.optic.surfaces[number]
            surface.geometry.radius = torch.as_tensor(surface.geometry.radius).detach()
            surface.geometry.cs.z = surface.geometry.cs.z.detach()
        if self.by_indices:
            for number in range(len(self.indices)):
                material = self.optic.surfaces[number].material_post
                material.index = material.index.detach()
        self._leaves = None

    def _trace(self, rays: Rays) -> RealRays:
        x, y, z = rays.position
        L, M, N = rays.direction
        columns = [x, y, z, L, M, N, torch.ones_like(x), x.new_full((1,), self.wavelength)]
        if self.backend == "numpy":
            columns = [column.numpy() for column in columns]
        return self.optic.surfaces.trace(RealRays(*columns), skip=1, record=False)

    def _build(self) -> Optic:
        optic, last = Optic(), len(self.lens.surfaces) - 1
        for number, surface in enumerate(self.lens.surfaces):
            curvature, conic, coefficients = shape_of(surface, number)
            numbers = {"thickness": float(surface.thickness) if number < last else 0.0}
            if curvature:
                numbers |= {"radius": 1 / curvature, "conic": conic}
            if coefficients:
                numbers["coefficients"] = coefficients
            optic.surfaces.add(
                index=number,
                surface_type="even_asphere" if coefficients else "standard",
                is_stop=number == self.lens.stop,
                material="mirror" if surface.is_mirror else IdealMaterial(float(self.indices[number])),
                **numbers,
            )
        return optic

    def _set_conditions(self) -> None:
        self.optic.set_aperture("EPD", 1.0)
        self.optic.fields.set_type("angle")
        self.optic.fields.add(y=0.0)
        self.optic.wavelengths.add(self.wavelength, is_primary=True)


class RayOptics:
    """ray-optics: one ray at a time, float64, forward. Raises ModuleNotFoundError if it is not installed."""

    name, most = "ray-optics", _RAY_OPTICS_MOST
    dtype, with_path, has_gradient = torch.float64, True, False

    def __init__(self, lens: Lens):
        self.trace = importlib.import_module("rayoptics.raytr.raytrace").trace_raw
        surface = importlib.import_module("rayoptics.elem.surface").Surface
        sphere = importlib.import_module("rayoptics.elem.profiles").Spherical
        self.wavelength = 1e3 * float(lens.primary)
        indices = [float(index) for index in media(lens, lens.primary)]
        unturned = np.eye(3)
        self.path = [[surface(), None, (unturned, np.zeros(3)), indices[0], 1]]
        for number, (element, index) in enumerate(zip(lens.surfaces[1:], indices[1:], strict=True), 1):
            if element.conic is not None or element.coefficients is not None or element.is_mirror:
                raise ValueError("ray-optics: expected spheres and planes that refract")
            shift = unturned, np.array([0.0, 0.0, float(element.thickness)])
            profile = sphere(c=shape_of(element, number)[0])
            self.path.append([surface(profile=profile, interact_mode="transmit"), None, shift, index, 1])

    prepare = nothing

    def forward(self, rays: Rays) -> tuple[Tensor, None]:
        starts = zip(rays.position.T.numpy(), rays.direction.T.numpy(), strict=True)
        ends = [
            self.trace(iter(self.path), position, direction, self.wavelength, intersect_obj=False)[0][-1][0]
            for position, direction in starts
        ]
        return torch.as_tensor(np.array(ends).T[:2]), None


def set_threads(threads: int) -> None:
    """Threads of Optiland's compiled loops. They may set those of torch too, which are set at every timed call."""
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))


def peers(lens: Lens) -> list[Optiland]:
    """For `bench trace`: Optiland in float32 and float64 on torch, and on numpy."""
    return [
        *(Optiland(lens, dtype, backend="torch") for dtype in DTYPES),
        Optiland(lens, torch.float64, backend="numpy"),
    ]


def rivals(lens: Lens, dtype: torch.dtype) -> list[Optiland | RayOptics]:
    """For `bench speed`: Optiland on torch in this dtype, with gradients by indices, and on numpy in float64; and in
    float64 ray-optics, for spheres if it is installed."""
    chosen = [Optiland(lens, dtype, backend="torch", by_indices=True), Optiland(lens, torch.float64, backend="numpy")]
    simple = all(surface.coefficients is None and surface.conic is None for surface in lens.surfaces)
    others = dtype == torch.float64 and simple and importlib.util.find_spec("rayoptics") is not None
    return [*chosen, RayOptics(lens)] if others else chosen


def versions() -> dict[str, str]:
    """Versions of the peers, for people."""
    names = {"Optiland": "optiland", "numba": "numba", "ray-optics": "rayoptics"}
    return {title: version(name) for title, name in names.items() if importlib.util.find_spec(name) is not None}


# -- PSFs --------------------------------------------------------------------------------------------------------------


def psf_methods(truth: Truth) -> list[Method]:
    """Optiland on one case; none for a lens with apertures that are not annuli."""
    optic = optic_of(truth.case)
    if optic is None:
        return []
    energy = {name: float(kernel.sum()) for name, kernel in truth.kernels.items()}
    field = (0.0, 1.0 if truth.case.field else 0.0)
    wavelength = float(truth.case.lens.primary)

    def method(model: str, sampling: str, against: str, compute: Callable, *sizes: int) -> Method:
        run = functools.partial(_run, compute, optic, field, wavelength, sizes, energy.get(against, 1.0))
        return Method(f"Optiland {model}", sampling, run, against, has_gradient=False)

    methods = [method("histogram", f"{n:,} rays", "rays", _histogram, n) for n in _RANDOM]
    methods += [method("Huygens", f"{n}² grid, {m}² a pixel", "wave", _huygens, n, m) for n, m in _HUYGENS]
    return methods + [method("FFT", f"{n}² grid, {m}² points", "wave", _fft, n, m) for n, m in _FFT]


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
        analysis = IncoherentIrradiance(
            optic, count, (grid.columns, grid.rows), fields=[field], wavelengths=[wavelength]
        )
        irradiance = analysis.data[0][0]
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
    psf = _AtPoints(optic, field, wavelength, across, grid.columns * parts, pixel_pitch=pitch, corner=corner)
    return _pixels(np.asarray(psf.psf), parts), len(psf.get_data(field, wavelength).opd)


def _fft(optic: Optic, field, wavelength: float, grid: Grid, across: int, points: int) -> tuple[np.ndarray, int]:
    psf = FFTPSF(optic, field, wavelength, across, points)
    step = 1e-3 * wavelength * psf._get_working_FNO() * (across - 1) / points
    chief = optic.trace_generic(*field, 0.0, 0.0, wavelength)
    line = (np.arange(grid.columns * _PARTS) + 0.5) / _PARTS - 0.5 * grid.columns
    places = []
    for centre, start in zip(grid.centre.tolist(), (chief.x, chief.y), strict=True):
        offset = centre - float(np.asarray(start).item()) + line * float(grid.pitch)
        places.append(offset / step + points // 2)
    return _pixels(_bilinear(np.asarray(psf.psf), *places), _PARTS), len(psf.get_data(field, wavelength).opd)


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
