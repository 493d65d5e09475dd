"""PSF models side by side: their kernels over object distance, and in numbers what each of them can represent."""

import dataclasses
import math

import torch
from torch import Tensor

from raytrace.kernels import Psf, psf
from raytrace.maths.grid import Grid, grid
from raytrace.maths.numerics import safe_divide, safe_sqrt
from raytrace.maths.result import Result, axis
from raytrace.maths.value import value
from raytrace.optics.focus import focused
from raytrace.optics.paraxial import first_order
from raytrace.optics.trace import media
from raytrace.system.lens import Lens, SystemAperture, with_sensor_distance, with_wavelengths

#: The models by the names of their rows, with what drives them; the last one is the reference of the others.
ROWS = {
    "DRT": {"model": "drt", "rays": 256},
    "Gaussian DRT": {"model": "gaussian", "tol": 1e-3},
    "paraxial": {"model": "paraxial"},
    "Fourier": {"model": "fourier", "tol": 1e-3},
    "wave": {"model": "wave", "tol": 1e-3},
}
STARTS = ("paraxial", "rms")
DISTANCES = (10e3, 20e3, 30e3, 40e3, 50e3)  # mm
PIXEL, SIZE = 0.005, 21  # mm; a window of 105 µm

# The counting noise of 256 rays would pass for aberrations and for rings: abilities are those of many rays.
_CONVERGED = {**ROWS, "DRT": {"model": "drt", "tol": 0.01}}
_IDEAL = ("paraxial", "Fourier")  # these place the light of a field where a lens without distortion would
_CONIC = 0.2  # by how much the conic of the most curved surface grows
_SLOW = 16.0  # F-number, or the lens's own if it is slower, at which the first dark ring is looked for
_AIRY_PIXELS = 24  # pixels in the radius of the ideal ring


@value
class Comparison(Result):
    """Kernels of every model on the axis, over object distance, on one sensor.

    psfs: of each model, kernels (D, 1, rows, columns); models: their names.
    object_distances: (D,) mm; sensor_distance: () mm from the last surface; wavelength: () µm.
    """

    psfs: tuple[Psf, ...]
    object_distances: Tensor
    sensor_distance: Tensor
    wavelength: Tensor
    models: tuple[str, ...]

    @property
    def sigma(self) -> Tensor:
        """σ (M, D) mm of each kernel along x or y, before pixels: √((σ_x² + σ_y²)/2).

        Of "Fourier" and "wave" of the light inside the window, see `Psf.covariance`.
        """
        covariance = torch.stack([one.covariance[..., 0] for one in self.psfs])
        return safe_sqrt(0.5 * (covariance[:, 0] + covariance[:, 2]))

    @property
    def difference(self) -> Tensor:
        """Relative L1 difference (M, D) of each kernel from that of the last model."""
        kernels = torch.stack([one.kernel[:, 0] for one in self.psfs])
        return safe_divide((kernels - kernels[-1]).abs().sum((-2, -1)), kernels[-1].sum((-2, -1)))

    @property
    def error(self) -> Tensor:
        """Estimated error (M, D) of each kernel against its own model's limit, see `Psf.error`."""
        return torch.stack([one.error[:, 0] for one in self.psfs])

    def columns(self) -> dict[str, Tensor]:
        return {
            "model": axis(torch.arange(len(self.models), device=self.object_distances.device), 0, 2),
            "object_distance": axis(self.object_distances, 1, 2),
            "sigma": self.sigma,
            "energy": torch.stack([one.energy[:, 0] for one in self.psfs]),
            "difference": self.difference,
            "error": self.error,
            "rays": axis(self.object_distances.new_tensor([one.rays for one in self.psfs]), 0, 2),
        }

    def words(self) -> dict:
        return {"model": self.models}


@value
class Abilities(Result):
    """What each model can represent: one number (M,) for each model and question, of the object in focus.

    conic: relative L1 change of the kernel when the conic of the most curved surface grows by 0.2 (aberrations).
    anisotropy: longer over shorter σ of the largest field, before pixels and window (of "wave": of its rays);
        asymmetry: relative L1 difference of that field's kernel from itself turned by 180° about the centroid of the
        light (off axis).
    dark_ring: radius of the first minimum at F/16 in radii of the Airy disc, nan where there is none (diffraction).
    parameters: how many curvatures, conics and thicknesses move the kernel: have a derivative other than 0.
    rays: traced for one kernel on the axis.
    """

    conic: Tensor
    anisotropy: Tensor
    asymmetry: Tensor
    dark_ring: Tensor
    parameters: Tensor
    rays: Tensor
    models: tuple[str, ...]

    def columns(self) -> dict[str, Tensor]:
        names = [field.name for field in dataclasses.fields(self) if field.name != "models"]
        model = torch.arange(len(self.models), device=self.conic.device)
        return {"model": model, **{name: getattr(self, name) for name in names}}

    def words(self) -> dict:
        return {"model": self.models}


def common_focus(lens: Lens, focus_distance: float, *, wavelength: float | Tensor, start: str = "paraxial") -> Lens:
    """The lens at one wavelength (µm), focused at an object distance (mm, inf allowed), on the axis.

    start: "paraxial", the paraxial image; "rms", the sensor of the least RMS spot. Raises ValueError for another start
    and where the lens forms no real image of the object.
    """
    if start not in STARTS:
        raise ValueError(f"start {start!r} is not known; expected {' or '.join(STARTS)}")
    return focused(with_wavelengths(lens, [float(wavelength)]), focus_distance, on=start)


def compare(lens: Lens, object_distances: Tensor, *, pixels: Grid | None = None) -> Comparison:
    """Kernels of every model on the axis for objects at distances (D,) mm, sensor as it is.

    pixels: about the axis, by default 21 × 21 of 5 µm.
    """
    given = _given(lens, pixels)
    return Comparison(
        psfs=tuple(_psf(lens, work, object_distances, grid=given) for work in ROWS.values()),
        object_distances=object_distances,
        sensor_distance=lens.surfaces[-2].thickness,
        wavelength=lens.wavelengths[lens.primary_wavelength],
        models=tuple(ROWS),
    )


def abilities(lens: Lens, *, pixels: Grid | None = None) -> Abilities:
    """What each model can represent, measured on a lens of one wavelength at its own object and sensor distance.

    pixels: about the axis, by default 21 × 21 of 5 µm.
    """
    changed, upright, given = _with_conic(lens), _largest_field(lens), _given(lens, pixels)
    rows = []
    for name, work in _CONVERGED.items():
        focused = _psf(lens, work, grid=given)
        about = _about_light(lens, upright, given, ideal=name in _IDEAL)
        away = _psf(lens, work, fields=upright, grid=about)
        rows.append(
            {
                "conic": _relative(_psf(changed, work, grid=given).kernel, focused.kernel),
                "anisotropy": _anisotropy(away.ray_covariance[:, 0, 0]),
                "asymmetry": _relative(away.kernel.flip(-2, -1), away.kernel),
                "dark_ring": _dark_ring(lens, work),
                "parameters": _parameters(lens, work),
                "rays": ROWS[name].get("rays", focused.rays),
            }
        )
    like = lens.wavelengths
    table = {key: like.new_tensor([float(row[key]) for row in rows]) for key in rows[0]}
    return Abilities(**table, models=tuple(ROWS))


def _given(lens: Lens, pixels: Grid | None) -> Grid:
    return grid(lens.wavelengths.new_tensor(PIXEL), SIZE) if pixels is None else pixels


def _psf(lens: Lens, work: dict, object_distances: Tensor | None = None, **others) -> Psf:
    """Kernels as `psf` gives them; on the axis and at the lens's own object distance unless told otherwise."""
    distances = lens.surfaces[0].thickness.reshape(1) if object_distances is None else object_distances
    return psf(lens, object_distances=distances, **work, **{"fields": lens.wavelengths.new_zeros(2, 1), **others})


def _relative(one: Tensor, other: Tensor) -> Tensor:
    return safe_divide((one - other).abs().sum(), other.sum())


def _anisotropy(covariance: Tensor) -> float:
    """√(larger/smaller eigenvalue) of a covariance (3,) mm²; 1 for a point."""
    short, long = torch.linalg.eigvalsh(covariance[[0, 1, 1, 2]].reshape(2, 2)).clamp_min(0).tolist()
    return math.sqrt(long / short) if short > 1e-18 else 1.0


def _largest_field(lens: Lens) -> Tensor:
    """The largest field (2, 1), turned upright."""
    size = torch.hypot(lens.fields.x, lens.fields.y).amax()
    return torch.stack([torch.zeros_like(size), size])[:, None]


def _about_light(lens: Lens, fields: Tensor, pixels: Grid, *, ideal: bool) -> Grid:
    """The pixels about the centroid of the light of a field (2, 1)."""
    found = _psf(lens, ROWS["paraxial" if ideal else "Gaussian DRT"], fields=fields, grid=pixels)
    return dataclasses.replace(found.grid, centre=found.centroid[:, 0, 0].detach())


def _most_curved(lens: Lens) -> int:
    """Number of the most curved surface that bends light: the image may be curved, and so may dummies."""
    indices = media(lens, lens.wavelengths[lens.primary_wavelength])
    strength = {
        k: abs(float(surface.curvature))
        for k, surface in enumerate(lens.surfaces[:-1])
        if k > 0 and surface.curvature is not None and (surface.is_mirror or indices[k] is not indices[k - 1])
    }
    return max(strength, key=strength.get)


def _with_conic(lens: Lens) -> Lens:
    surfaces, k = list(lens.surfaces), _most_curved(lens)
    conic = torch.zeros_like(surfaces[k].thickness) if surfaces[k].conic is None else surfaces[k].conic
    surfaces[k] = dataclasses.replace(surfaces[k], conic=conic + _CONIC)
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def _dark_ring(lens: Lens, work: dict) -> float:
    """First minimum along x of the kernel of the slowed lens, below a twentieth of the peak; nan without one."""
    slow = torch.clamp(first_order(lens).f_number, min=_SLOW)
    slowed = dataclasses.replace(lens, aperture=SystemAperture("image_f_number", slow))
    airy = 1.2197e-3 * lens.wavelengths[0] * first_order(slowed).working_f_number
    line = _psf(slowed, work, grid=grid(airy / _AIRY_PIXELS, (1, 4 * _AIRY_PIXELS + 1)))
    line = line.kernel[0, 0, 0, 2 * _AIRY_PIXELS :].tolist()
    for i in range(1, len(line) - 1):
        a, b, c = line[i - 1 : i + 2]
        # A geometric kernel falls to 0 and stays there; a ring rises again.
        if a > b < c and b < 0.05 * line[0] and max(line[i:]) > 1e-3 * line[0]:
            return (i + 0.5 * (a - c) / (a - 2 * b + c)) / _AIRY_PIXELS
    return math.nan


def _parameters(lens: Lens, work: dict) -> int:
    """How many numbers of the lens move the kernel on a sensor 8 λN² behind its own, where no model has a point."""
    surfaces, numbers = list(lens.surfaces), []
    for k, surface in enumerate(surfaces[:-1]):
        changes = {"thickness": surface.thickness}
        if surface.curvature is not None and float(surface.curvature) != 0:
            conic = torch.zeros_like(surface.thickness) if surface.conic is None else surface.conic
            changes |= {"curvature": surface.curvature, "conic": conic}
        changes = {key: number.detach().clone().requires_grad_() for key, number in changes.items()}
        numbers += changes.values()
        surfaces[k] = dataclasses.replace(surface, **changes)
    lens = dataclasses.replace(lens, surfaces=tuple(surfaces))
    number = first_order(lens).working_f_number.detach()
    blur = 1e-3 * lens.wavelengths[0] * number
    lens = with_sensor_distance(lens, surfaces[-2].thickness + 8 * blur * number)
    work = {**work, "tol": 0.05} if "tol" in work else work
    found = _psf(lens, work, grid=grid(2 * blur, 5))
    gradients = torch.autograd.grad(found.kernel.square().sum(), numbers, allow_unused=True)
    return sum(gradient is not None and math.isfinite(gradient) and float(gradient) != 0 for gradient in gradients)
