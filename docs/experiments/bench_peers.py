"""Peers of the scripts bench_*.py: Optiland, its trace and PSFs, and the trace of ray-optics, on equal lenses and rays.

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
from collections.abc import Callable, Sequence
from importlib.metadata import version

import numba
import numpy as np
import optiland.backend as be
import torch
from bench_reference import shape_of
from optiland.analysis import IncoherentIrradiance
from optiland.materials import IdealMaterial
from optiland.optic import Optic
from optiland.physical_apertures import RadialAperture, RectangularAperture
from optiland.psf import FFTPSF
from optiland.psf.huygens_fresnel import ScalarHuygensPSF
from optiland.rays import RealRays
from optiland.samples.objectives import CookeTriplet
from optiland.tolerancing import Tolerancing
from optiland.tolerancing.monte_carlo import MonteCarlo
from scipy.ndimage import map_coordinates
from torch import Tensor

from raytrace.bench.measure import DTYPES, Tracer, clock, name_of, squared_radius, variables
from raytrace.bench.psf import Case, Method, Truth
from raytrace.maths.numerics import to
from raytrace.maths.sampling import Grid
from raytrace.psf_models.result import Kernels
from raytrace.system.lens import Lens, media, with_object_distance
from raytrace.system.rays import Rays
from raytrace.system.tolerance_data import Tolerance
from raytrace.tolerancing.table import ToleranceTable
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import Scene

_RAY_OPTICS_MOST = 1024  # rays: it traces one at a time in Python
_OPEN = 1e9  # mm: an aperture without an outer edge
_PARTS = 6  # of a pixel, where the FFT is integrated


class Optiland(Tracer):
    """A lens in Optiland. backend: "torch" or "numpy" (float64, forward only).

    by_indices: gradients also with respect to the index of every medium.
    """

    def __init__(self, lens: Lens, dtype: torch.dtype, *, backend: str, by_indices: bool = False):
        self.name = f"Optiland, {backend}"
        self.dtype, self.backend, self.by_indices = dtype, backend, by_indices
        self.has_gradient, self.with_path, self.device = backend == "torch", True, "cpu"
        self.lens, self.wavelength = to(lens, dtype=dtype), float(lens.primary)
        self.indices = media(self.lens, self.lens.primary)
        self.prepare()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Optiland and numba
            self.optic = self._build()
            self.optic.set_aperture("EPD", 1.0)
            self.optic.fields.set_type("angle")
            self.optic.fields.add(y=0.0)
            self.optic.wavelengths.add(self.wavelength, is_primary=True)
            axis = torch.zeros(3, 2, dtype=dtype)
            axis[2] = 1.0
            self.forward(Rays(torch.zeros_like(axis), axis, torch.ones(2, dtype=torch.bool)))  # compiles

    def prepare(self) -> None:
        """Set Optiland's back end, precision and grad mode, which are global."""
        be.set_backend(self.backend)
        if self.backend == "torch":
            be.set_precision(name_of(self.dtype))
            be.grad_mode.disable()

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]:
        self.prepare()
        with torch.no_grad():
            end = self._trace(rays)
        return torch.stack([torch.as_tensor(end.x), torch.as_tensor(end.y)]), torch.as_tensor(end.opd)

    def gradient(self, rays: Rays, centroid: Tensor) -> list[Tensor]:
        """By Optiland's variables radius, thickness and index; d/dc = -R² d/dR."""
        self.prepare()
        optic, leaves, thicknesses = self._with_leaves
        z = torch.zeros((), dtype=self.dtype)
        for number in range(1, len(self.lens.surfaces)):
            optic.surfaces[number].geometry.cs.z = z
            z = z + thicknesses.get(number, 0.0)
        end = self._trace(rays, optic)
        slopes = list(torch.autograd.grad(squared_radius(end.x, end.y, centroid), leaves))
        for k, (_, name) in enumerate(variables(self.lens)):
            if name == "curvature":
                slopes[k] = -(leaves[k].detach() ** 2) * slopes[k]
        return slopes

    @functools.cached_property
    def _with_leaves(self) -> tuple[Optic, list[Tensor], dict[int, Tensor]]:
        """The lens whose variables are leaves, the leaves, and those that are thicknesses by surface."""
        optic, leaves, thicknesses = self._build(), [], {}
        for number, name in variables(self.lens):
            if name == "curvature":
                geometry = optic.surfaces[number].geometry
                geometry.radius = torch.as_tensor(geometry.radius).detach().clone().requires_grad_()
                leaves.append(geometry.radius)
            else:
                thicknesses[number] = self.lens.surfaces[number].thickness.detach().clone().requires_grad_()
                leaves.append(thicknesses[number])
        for number, index in enumerate(self.indices if self.by_indices else ()):
            if number == 0 or index is not self.indices[number - 1]:
                leaves.append(index.detach().reshape(1).clone().requires_grad_())
            optic.surfaces[number].material_post.index = leaves[-1]
        return optic, leaves, thicknesses

    def _trace(self, rays: Rays, optic: Optic | None = None) -> RealRays:
        x = rays.position[0]
        columns = [*rays.position, *rays.direction, torch.ones_like(x), x.new_full((1,), self.wavelength)]
        if self.backend == "numpy":
            columns = [column.numpy() for column in columns]
        return (optic or self.optic).surfaces.trace(RealRays(*columns), skip=1, record=False)

    def _build(self) -> Optic:
        optic, last = Optic(), len(self.lens.surfaces) - 1
        for number, surface in enumerate(self.lens.surfaces):
            curvature, conic, coefficients = shape_of(surface, number)
            numbers = {"radius": 1 / curvature, "conic": conic} if curvature else {}
            optic.surfaces.add(
                index=number,
                surface_type="even_asphere" if coefficients else "standard",
                is_stop=number == self.lens.stop,
                material="mirror" if surface.is_mirror else IdealMaterial(float(self.indices[number])),
                thickness=float(surface.thickness) if number < last else 0.0,
                **numbers | ({"coefficients": coefficients} if coefficients else {}),
            )
        return optic


class RayOptics(Tracer):
    """ray-optics: one ray at a time, float64, forward. Raises ModuleNotFoundError if it is not installed.

    most: rays that it traces in bearable time.
    """

    name, most, dtype, has_gradient = "ray-optics", _RAY_OPTICS_MOST, torch.float64, False
    with_path, device = True, "cpu"

    def __init__(self, lens: Lens):
        self.trace = importlib.import_module("rayoptics.raytr.raytrace").trace_raw
        surface = importlib.import_module("rayoptics.elem.surface").Surface
        sphere = importlib.import_module("rayoptics.elem.profiles").Spherical
        self.wavelength = 1e3 * float(lens.primary)
        first, *indices = (float(index) for index in media(lens, lens.primary))
        self.path = [[surface(), None, (np.eye(3), np.zeros(3)), first, 1]]
        for number, (element, index) in enumerate(zip(lens.surfaces[1:], indices, strict=True), 1):
            if element.conic is not None or element.coefficients is not None or element.is_mirror:
                raise ValueError("ray-optics: expected spheres and planes that refract")
            shift = np.eye(3), np.array([0.0, 0.0, float(element.thickness)])
            profile = sphere(c=shape_of(element, number)[0])
            self.path.append([surface(profile=profile, interact_mode="transmit"), None, shift, index, 1])

    def forward(self, rays: Rays) -> tuple[Tensor, None]:
        starts = zip(rays.position.T.numpy(), rays.direction.T.numpy(), strict=True)
        ends = [self.trace(iter(self.path), *start, self.wavelength, intersect_obj=False)[0][-1][0] for start in starts]
        return torch.as_tensor(np.array(ends).T[:2]), None


def set_threads(threads: int) -> None:
    """Threads of Optiland's compiled loops. They may set those of torch too, which are set at every timed call."""
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))


def peers(lens: Lens) -> list[Tracer]:
    """For `bench_trace.py`: Optiland in float32 and float64 on torch, and on numpy."""
    by_torch = [Optiland(lens, dtype, backend="torch") for dtype in DTYPES]
    return [*by_torch, Optiland(lens, torch.float64, backend="numpy")]


def rivals(lens: Lens, dtype: torch.dtype) -> list[Tracer]:
    """For `bench_speed.py`: Optiland on torch in this dtype, with gradients by indices, and on numpy in float64; and in
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
    field, wavelength = (0.0, 1.0 if truth.case.field else 0.0), float(truth.case.lens.primary)

    def run(compute, sizes: tuple, energy: float, scene: Scene, grid: Grid) -> Kernels:
        be.set_backend("numpy")
        kernel, count = compute(optic, field, wavelength, grid, *sizes)
        kernel = torch.as_tensor(np.ascontiguousarray(kernel) * (energy / kernel.sum()))
        unknown = kernel.new_full((3,), torch.nan)
        return Kernels(kernel, grid, unknown[:2], unknown, count, unknown[0])

    methods = []
    for model, against, compute, sampling, choices in _PSFS:
        energy = float(truth.kernels[against].sum()) if against in truth.kernels else 1.0
        for sizes in choices:
            call = functools.partial(run, compute, sizes, energy)
            methods.append(Method(f"Optiland {model}", sampling.format(*sizes), call, against, has_gradient=False))
    return methods


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


def _histogram(optic: Optic, field, wavelength: float, grid: Grid, count: int) -> tuple[np.ndarray, int]:
    (x0, y0), half = grid.centre.tolist(), 0.5 * grid.columns * float(grid.pitch)
    image, pixels = optic.surfaces[-1], (grid.columns, grid.rows)
    image.aperture = RectangularAperture(x0 - half, x0 + half, y0 - half, y0 + half)
    try:
        data = IncoherentIrradiance(optic, count, pixels, fields=[field], wavelengths=[wavelength]).data[0][0]
    finally:
        image.aperture = None
    return np.asarray(data[0] if isinstance(data, (tuple, list)) else data).T, count


class _AtPoints(ScalarHuygensPSF):
    """Optiland's direct sum at the midpoints of the parts of the pixels of a window, from its corner (x, y) mm."""

    def __init__(self, *arguments, corner: tuple[float, float], **others):
        self.corner = corner
        super().__init__(*arguments, normalization=1.0, **others)

    def _get_image_extent(self) -> tuple[float, float, float, float]:
        length, half = (self.image_size - 1) * self.pixel_pitch, 0.5 * self.pixel_pitch
        return tuple(start + half + end for start in self.corner for end in (0.0, length))


def _huygens(optic: Optic, field, wavelength: float, grid: Grid, across: int, parts: int) -> tuple[np.ndarray, int]:
    corner = tuple(c - 0.5 * grid.columns * float(grid.pitch) for c in grid.centre.tolist())
    pitch = float(grid.pitch) / parts
    psf = _AtPoints(optic, field, wavelength, across, grid.columns * parts, pixel_pitch=pitch, corner=corner)
    return _pixels(np.asarray(psf.psf), parts), len(psf.get_data(field, wavelength).opd)


def _fft(optic: Optic, field, wavelength: float, grid: Grid, across: int, points: int) -> tuple[np.ndarray, int]:
    psf = FFTPSF(optic, field, wavelength, across, points)
    step = 1e-3 * wavelength * psf._get_working_FNO() * (across - 1) / points
    chief = optic.trace_generic(*field, 0.0, 0.0, wavelength)
    line = ((np.arange(grid.columns * _PARTS) + 0.5) / _PARTS - 0.5 * grid.columns) * float(grid.pitch)
    x, y = (
        (centre - float(np.asarray(start).item()) + line) / step + points // 2
        for centre, start in zip(grid.centre.tolist(), (chief.x, chief.y), strict=True)
    )
    fine = map_coordinates(np.asarray(psf.psf), np.meshgrid(y, x, indexing="ij"), order=1, mode="grid-constant")
    return _pixels(fine, _PARTS), len(psf.get_data(field, wavelength).opd)


def _pixels(fine: np.ndarray, parts: int) -> np.ndarray:
    """Sums over parts × parts."""
    return fine.reshape(fine.shape[0] // parts, parts, fine.shape[1] // parts, parts).sum((1, 3))


class _Given:
    """A sampler of numbers that are given, in their order."""

    def __init__(self, numbers: Sequence[float]):
        self.numbers = iter(numbers)

    def sample(self) -> float:
        return next(self.numbers)


def tolerancing(
    tolerances: ToleranceTable, errors: Tensor, rings: int, done: Callable[[], object], threads: int
) -> tuple[list[float], list[float]]:
    """Optiland's tolerancing of its Cooke triplet with errors (L, N): the root of the mean square, mm, and s, of each.

    The sensor is adjusted by its own optimiser. Of hexapolar rings, of all fields and wavelengths, each spot about its
    own centroid.
    """
    be.set_backend("numpy")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        optic = CookeTriplet()
        study = Tolerancing(optic, tol=1e-9)
        for field in optic.fields.get_field_coords():
            for wavelength in optic.wavelengths.get_wavelengths():
                about = {"optic": optic, "surface_number": -1, "Hx": field[0], "Hy": field[1], "num_rays": rings}
                study.add_operand("rms_spot_size", about | {"wavelength": wavelength}, target=0.0)
        for row, numbers in zip(tolerances, errors.T.tolist(), strict=True):
            kind, nominal, settings = _variable(optic, row)
            scale = nominal / 100 if row.unit == "%" else math.radians(1.0) if row.unit == "degrees" else 1.0
            given = _Given([nominal + scale * number for number in (0.0, *numbers)])  # the first trial compiles
            study.add_perturbation(kind, given, surface_number=row.surfaces[0], **settings)
        study.add_compensator("thickness", surface_number=tolerances.compensators[0].surface)
        trials, found, seconds, now = MonteCarlo(study), [], [], clock(threads)
        for _ in range(len(errors) + 1):
            start = now()
            trials.run(1)
            seconds.append(now() - start)
            spots = trials.get_results().iloc[0][trials.operand_names].to_numpy(dtype=float)
            found.append(float(np.sqrt((spots**2).mean())))
            done()
    return found[1:], seconds[1:]


def _variable(optic: Optic, row: Tolerance) -> tuple[str, float, dict[str, str]]:
    """Optiland's name of a variable, its nominal value and its axis."""
    k = row.surfaces[0]
    if row.kind == "radius":
        return "radius", float(optic.surfaces[k].geometry.radius), {}
    if row.kind == "thickness":
        return "thickness", float(np.asarray(optic.surfaces.get_thickness(k)).item()), {}
    return ("decenter" if "decenter" in row.kind else "tilt"), 0.0, {"axis": row.kind[-1]}


#: Model, limit of its error, its computation, its sampling in words, and samplings: numbers of rays; rays across the
#: pupil and points across a pixel, or of the transform.
_PSFS = (
    ("histogram", "rays", _histogram, "{:,} rays", ((10_000,), (100_000,), (1_000_000,))),
    ("Huygens", "wave", _huygens, "{}² grid, {}² a pixel", ((64, 3), (96, 5))),
    ("FFT", "wave", _fft, "{}² grid, {}² points", ((128, 512), (256, 2048))),
)
