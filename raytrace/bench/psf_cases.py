"""Lenses with field, distance and pixels, and methods that compute their kernels, of the PSF benchmark."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.maths.sampling import Grid, grid
from raytrace.psf_models import MODELS, Psf, drt, paraxial, psf
from raytrace.psf_models.gaussian import kernels as gaussian_kernels
from raytrace.psf_models.result import Kernels
from raytrace.system.lens import Lens, with_object_distance
from raytrace.tracing.paraxial import first_order, largest_field
from raytrace.tracing.scene import Scene, scene

PIXELS = 21  # across every window
#: Field angles in degrees, object distance in mm (None: that of the lens) and pixel pitch in mm of the default cases.
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
    """A lens, field, object distance (mm) and pixel pitch (mm): a panel of the figure."""

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
    """A way to compute a kernel. run: (scene, grid) -> kernel, centroid, covariance and rays.

    against: the limit of its error: "rays", "wave", or its own: "gaussian", "paraxial", "fourier".
    """

    model: str
    sampling: str
    run: Callable[[Scene, Grid], Kernels | Psf]
    against: str
    has_gradient: bool = True


def cases(lenses: Sequence[tuple[str, Lens]]) -> list[Case]:
    """The default conditions of the lenses of USUAL; others at their own distance, on the axis and at the largest
    field, with a window of at least 7 σ and 8 λN."""
    chosen = []
    for name, lens in lenses:
        fields, distance, pitch = USUAL.get(name, (dict.fromkeys((0.0, float(largest_field(lens)[1]))), None, None))
        distance = float(lens.surfaces[0].thickness) if distance is None else distance
        chosen += [Case(lens, name, field, distance, pitch or _pitch(lens, field, distance)) for field in fields]
    return chosen


def methods() -> list[Method]:
    """Every model at several orders, Sobol rays, and `psf(…, tol=…)` with the estimate of its error."""
    limits = {model: "rays" if model == "drt" else model for model in _ORDERS}
    chosen = [Method("paraxial", "closed form", paraxial.kernels, "paraxial")]
    for model, orders in _ORDERS.items():
        for order in orders:
            sampling = f"{order} rings" if model == "gaussian" else f"order {order}"
            run = functools.partial(MODELS[model].kernels, order=order)
            chosen.append(Method(model, sampling, run, limits[model]))
    for rays in _SOBOL:
        run = functools.partial(drt.kernels_of_rays, rays=rays)
        chosen.append(Method("Sobol rays", f"{rays} rays", run, "rays"))
    for model, tolerances in _TOLERANCES.items():
        for tol in tolerances:
            run = functools.partial(_to_tolerance, model, tol)
            chosen.append(Method(model, f"tol {tol:.0e}".replace("e-0", "e-"), run, limits[model]))
    return chosen


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
    """A round pixel pitch whose window of PIXELS holds 7 σ of the rays and 8 λN."""
    with torch.no_grad():
        light = gaussian_kernels(Case(lens, "", field, distance, 1.0).scene, grid(1.0, 1), order=8)
        width = 7 * float(light.covariance[::2].max().sqrt())
        number = float(first_order(with_object_distance(lens, distance)).paraxial_working_f_number)
        airy = 8e-3 * float(lens.primary) * number
    pitch = max(width, airy if math.isfinite(airy) else 0.0, 1e-6) / PIXELS
    decade = 10.0 ** math.floor(math.log10(pitch))
    return next(step for step in (decade, 2 * decade, 5 * decade, 10 * decade) if step >= pitch * (1 - 1e-9))
