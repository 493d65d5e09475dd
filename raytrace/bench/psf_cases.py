"""What the PSF benchmark measures: lenses with field, distance and pixels, and the ways to compute their kernels."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.maths import pupil
from raytrace.maths.grid import Grid, grid
from raytrace.psf_models import MODELS, Psf, drt, paraxial, psf
from raytrace.psf_models.gaussian import kernels as gaussian_kernels
from raytrace.psf_models.result import Kernels
from raytrace.system.lens import Lens, with_object_distance
from raytrace.tracing.paraxial import first_order, largest_field
from raytrace.tracing.scene import Scene, scene

PIXELS = 21  # across every window
RANDOM, DIRECT = "random rays", "direct sum"
#: Field angles in degrees, object distance in mm (None: the lens's own) and pixel pitch in mm of the usual cases.
USUAL = {
    "double_gauss": ((0.0, 14.0), 1e4, 0.005),
    "phone": ((0.0,), None, 0.001),
    "hubble": ((0.0,), None, 0.005),
}
_ORDERS = {
    "gaussian": (2, 3, 4, 5, 6, 8, 12),
    "drt": (0, 1, 2, 3, 4, 6),
    "fourier": tuple(MODELS["fourier"].orders[:3]),
    "wave": tuple(MODELS["wave"].orders[:3]),
}
_TOLERANCES = {"gaussian": (1e-2, 1e-4, 1e-6), "drt": (1e-1, 1e-2, 1e-3), "fourier": (1e-2, 1e-4), "wave": (1e-2, 1e-3)}
_SOBOL = (256, 4096)


@dataclasses.dataclass(frozen=True)
class Case:
    """One lens, field, object distance (mm) and pixel pitch (mm): one panel of the figure."""

    lens: Lens
    name: str
    field: float
    distance: float
    pitch: float

    @property
    def title(self) -> str:
        return f"{self.name}, {self.field:g}{'°' if self.lens.fields.kind == 'angle' else ' mm'}"

    @property
    def scene(self) -> Scene:
        """The primary wavelength alone, float64."""
        wavelength = self.lens.primary[None]
        field = wavelength.new_tensor([[0.0], [self.field]])
        return scene(self.lens, field, wavelength.new_tensor([self.distance]), wavelength)

    def window(self, centre: Tensor) -> Grid:
        return grid(centre.new_tensor(self.pitch), PIXELS, centre)


@dataclasses.dataclass(frozen=True)
class Method:
    """A way to compute a kernel. run: (scene, grid) -> what holds kernel, centroid, covariance and rays.

    against: the limit its error counts from: "rays", "wave", or its own: "gaussian", "paraxial", "fourier".
    """

    model: str
    sampling: str
    run: Callable[[Scene, Grid], Kernels | Psf]
    against: str
    has_gradient: bool = True


def cases(lenses: Sequence[tuple[str, Lens]]) -> list[Case]:
    """The usual conditions of the lenses of USUAL; for others their own distance, on the axis and at the largest field,
    with pixels as wide as 7 σ or 8 λN need."""
    found = []
    for name, lens in lenses:
        own = float(lens.surfaces[0].thickness)
        fields, distance, pitch = USUAL.get(name, (dict.fromkeys((0.0, float(largest_field(lens)[1]))), None, None))
        distance = own if distance is None else distance
        found += [Case(lens, name, field, distance, pitch or _pitch(lens, field, distance)) for field in fields]
    return found


def methods() -> list[Method]:
    """Every model at the orders that are measured."""
    found = [Method("paraxial", "closed form", paraxial.kernels, "paraxial")]
    for model, orders in _ORDERS.items():
        for order in orders:
            sampling = f"{order} rings" if model == "gaussian" else f"order {order}"
            run = functools.partial(MODELS[model].kernels, order=order)
            found.append(Method(model, sampling, run, _limit_of(model)))
    sobol = (Method("Sobol rays", f"{n} rays", functools.partial(drt.kernels_of_rays, rays=n), "rays") for n in _SOBOL)
    return [*found, *sobol]


def doors() -> list[Method]:
    """`psf(…, tol=…)` as it is called, the estimate of its error included."""
    return [
        Method(
            model, f"tol {tol:.0e}".replace("e-0", "e-"), functools.partial(_to_tolerance, model, tol), _limit_of(model)
        )
        for model, tolerances in _TOLERANCES.items()
        for tol in tolerances
    ]


def _limit_of(model: str) -> str:
    return "rays" if model == "drt" else model


def random_histogram(scene: Scene, grid: Grid, count: int, *, piece: int, seed: int = 0) -> Kernels:
    """The plain histogram of independent random rays, some at a time."""
    generator = torch.Generator().manual_seed(seed)
    sampling = functools.partial(pupil.random, generator=generator)
    sizes = [min(piece, count - first) for first in range(0, count, piece)]
    parts = [drt.kernels_of_rays(scene, grid, rays=size, sampling=sampling, width=0) for size in sizes]
    centroid, covariance, kernel = (
        sum(size / count * getattr(part, name) for size, part in zip(sizes, parts, strict=True))
        for name in ("centroid", "covariance", "kernel")
    )
    return Kernels(kernel, grid, centroid, covariance, count)


def _to_tolerance(model: str, tol: float, scene: Scene, grid: Grid) -> Psf:
    return psf(
        scene.lens,
        model,
        fields=scene.fields,
        object_distances=scene.lens.surfaces[0].thickness.flatten(),
        wavelengths=scene.wavelengths,
        grid=grid,
        tol=tol,
    )


def _pitch(lens: Lens, field: float, distance: float) -> float:
    """A round pixel whose window of PIXELS holds 7 σ of the rays and 8 λN."""
    place = Case(lens, "", field, distance, 1.0)
    with torch.no_grad():
        light = gaussian_kernels(place.scene, grid(1.0, 1), order=8)
        width = 7 * float(light.covariance[::2].max().sqrt())
        number = float(first_order(with_object_distance(lens, distance)).paraxial_working_f_number)
        airy = 8e-3 * float(lens.primary) * number
    pitch = max(width, airy if math.isfinite(airy) else 0.0, 1e-6) / PIXELS
    decade = 10.0 ** math.floor(math.log10(pitch))
    return next(step for step in (decade, 2 * decade, 5 * decade, 10 * decade) if step >= pitch * (1 - 1e-9))
