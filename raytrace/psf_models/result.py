"""PSFs of a model, `Kernels`, and the result of `psf`, a `Psf`; centroids and covariances of sums of distributions."""

import dataclasses
from collections.abc import Callable, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from raytrace.files import write_atomically
from raytrace.maths.numerics import safe_divide, value
from raytrace.maths.result import Column, Result, Table, axis, number, numbers
from raytrace.maths.sampling import Grid
from raytrace.plotting.style import Figure
from raytrace.system.lens import Lens
from raytrace.tracing.scene import Scene
from raytrace.words import RaytraceError

if TYPE_CHECKING:
    from raytrace.psf_models.cross_section import CrossSection

#: Number of axes before those of the batch, (D, F) or (D, F, W), in the tensors of Kernels and of a Psf.
_BEFORE = {"kernel": 0, "energy": 0, "error": 0, "residual": 0, "arrived": 0}
_BEFORE |= {"centroid": 1, "covariance": 1, "ray_centroid": 1, "ray_covariance": 1}


class EmptyPsf(RaytraceError, ValueError):
    """No ray of a field reaches the sensor: there is no PSF to compute."""


@value
class Paraxial:
    """First-order data: a Gaussian of the defocus blur. rho: its σ over the blur radius; order: 0, for loops."""

    rho: Tensor | float = 0.5
    order: int | None = None


@value
class Fourier:
    """First-order data with diffraction: a circular pupil, defocused and aberrated.

    zernike: Noll coefficients from 1 on, mm RMS of path, (J,) or (J, D, F, W); order: -2 … 5, for loops.
    """

    zernike: Tensor | None = None
    order: int | None = None


@value
class Gaussian:
    """A Gaussian of the centroid and covariance of traced rays.

    rays: at most so many per kernel, or their pupil points (2, P), all of one weight: a Gaussian of twelve rays has
    their centroid and covariance, not those of all light; order: instead, Gauss rings, 2, 3, 4, 5, 6, 8, 10, 12, 16 or
    24, for loops.
    """

    rays: int | Tensor | None = None
    order: int | None = None


@value
class DRT:
    """All traced rays: geometric optics.

    rays: independent Sobol rays per kernel, or their pupil points (2, P), all of one weight; order: instead, 0 … 10,
    for loops.
    """

    rays: int | Tensor | None = None
    order: int | None = None


@value
class Wave:
    """Diffraction of the traced wavefront. rays: at most so many per kernel; order: instead, -2 … 5, for loops."""

    rays: int | None = None
    order: int | None = None


#: A model with its numbers.
Parameters = Paraxial | Fourier | Gaussian | DRT | Wave


@value
class Kernels:
    """PSFs of one model, one for each object distance, field and wavelength.

    kernel: (D, F, W, rows, columns), energy in each pixel; 1 = all light through the entrance pupil.
    grid: its centre is (2,) or (2, D, F, W).
    centroid: (2, D, F, W) mm; covariance: (3, D, F, W) mm², xx, xy, yy, of the model's distribution before it is
        integrated over pixels; of waves, of the light inside the window: behind a hard edge the second moment diverges.
    ray_centroid, ray_covariance: of waves, the same of their rays, whatever the window; else None.
    rays: number of rays traced for each kernel; 0 if none.
    arrived: (D, F, W) energy on the whole sensor plane.
    residual: (D, F, W) error of the model itself (relative L1), or None where it has no estimate.
    """

    kernel: Tensor
    grid: Grid
    centroid: Tensor
    covariance: Tensor
    rays: int
    arrived: Tensor
    residual: Tensor | None = None
    ray_centroid: Tensor | None = None
    ray_covariance: Tensor | None = None

    @property
    def energy(self) -> Tensor:
        """(D, F, W): light inside the window."""
        return self.kernel.sum((-2, -1))

    @property
    def ray_moments(self) -> tuple[Tensor, Tensor]:
        """Centroid and covariance of geometric optics: of the rays of waves, else those of the model."""
        if self.ray_centroid is None or self.ray_covariance is None:
            return self.centroid, self.covariance
        return self.ray_centroid, self.ray_covariance

    @property
    def dark(self) -> Tensor:
        """Which kernels no traced ray reaches, (D, F, W): their moments are 0, without meaning."""
        return _is_dark(self, *self.ray_moments, of_waves=self.ray_centroid is not None)


@value
class Psf(Result):
    """PSFs over object distance × field, or object distance × field × wavelength: (D, F, W) for each (D, F) below.

    kernel: (D, F, rows, columns), integrated over pixels; summed over the wavelengths by their weights, or with an axis
    of them, (D, F, W, rows, columns). grid: the pixels on the sensor, centre (2,) or (2, D, F) mm. energy: (D, F)
    inside the window, of the light through the entrance pupil. error: (D, F) estimated relative L1 error of the kernel
    against the limit of its model (a Gaussian's: relative error of σ); nan where it was not estimated.
    docs/psf_error.md measures its reliability. centroid: (2, D, F) mm; covariance: (3, D, F) xx, xy, yy in mm², of the
    distribution before pixel integration: of all its light; of waves of the light inside the window, because behind a
    hard edge the second moment grows with the window without limit. nan with gradient 0 where no ray reaches the
    sensor. ray_centroid, ray_covariance: the same of geometric optics, whatever the window: of the rays of waves, or of
    their geometric limit, else again centroid and covariance. arrived: (D, F) energy on the whole sensor plane; the
    rest of 1 is vignetted or fails in the lens. residual: (D, F) error of the model itself, or None where it has no
    estimate. model: its name;
    waves: whether its light is diffracted; order: as for `DRT(order=…)`, None for independent rays; rays: traced for
    each kernel; reason: why `auto` chose the model, or a remark on convergence. normalised: "energy" (1 = all light
    through the entrance pupil) or "window" (each kernel sums to 1). wavelengths, wavelength_weights: (W,) µm and shares
    of 1, that the kernels are summed over or have an axis of. lens, fields, object_distances: (2, F), or
    (2, D, F), and (D,) mm;
    parameters: of the model. framed: whether the pixels were specified; otherwise a figure shows the light itself,
    finely sampled.
    """

    kernel: Tensor
    grid: Grid
    energy: Tensor
    error: Tensor
    centroid: Tensor
    covariance: Tensor
    ray_centroid: Tensor
    ray_covariance: Tensor
    arrived: Tensor
    lens: Lens
    fields: Tensor
    object_distances: Tensor
    wavelengths: Tensor
    wavelength_weights: Tensor
    residual: Tensor | None = None
    model: str = ""
    waves: bool = False
    order: int | None = None
    rays: int = 0
    reason: str = ""
    normalised: str = "energy"
    parameters: Parameters | None = None
    framed: bool = True

    @property
    def energy_outside(self) -> Tensor:
        """(D, F): share of the light on the sensor plane that is outside the window, 0 where no light arrives."""
        return (safe_divide(self.arrived - self.energy, self.arrived)).clamp_min(0.0)

    @property
    def wavelengths_summed(self) -> bool:
        """Whether each kernel is a sum over wavelengths; otherwise their axis is behind that of the fields."""
        return self.kernel.dim() == 4

    @property
    def _fields(self) -> Tensor:
        """Field points (2, 1 or D, F), or (2, 1 or D, F, 1), that broadcast to the axes of `energy`."""
        fields = self.fields.reshape(2, -1, self.fields.shape[-1])
        return fields if self.wavelengths_summed else fields[..., None]

    def draw(self, **options: Any) -> Figure:
        """The kernels over object distance and field; options: as for `psf_models.figures.psf_grid`."""
        from raytrace.psf_models.figures import psf_grid

        return psf_grid(self, **options)

    def cross_section(self, through: Literal["peak", "centroid"] = "peak") -> "CrossSection":
        """Profiles through the peak or the centroid along x and y, line spreads and their widths, with a figure.

        See `psf_models.CrossSection`. Of specified pixels, with derivatives; otherwise of the light finely sampled.
        """
        from raytrace.psf_models.cross_section import cross_section

        return cross_section(self, through)

    COLUMNS = (
        Column("object_distance", "mm", "g", "object"), Column("wavelength", "µm", "g", "λ"),
        *(Column(f"centroid_{a}", "mm", ".6f", f"centroid {a}") for a in "xy"),
        *(Column(f"sigma_{a}_um", "µm", ".4f", f"σ {a}") for a in "xy"),
        *(Column(f"ray_sigma_{a}_um", "µm", ".4f", f"rays' σ {a}") for a in "xy"),
        Column("energy", "", ".4f", "energy\nwindow"), Column("error", "", ".1e", "error\nest."),
        Column("rays", "", ".0f"),
    )  # fmt: skip

    def columns(self) -> dict[str, Tensor]:
        """A row for every kernel: widths of the light before pixels, of waves also those of their rays."""
        axes = self.energy.dim()
        colours = {} if self.wavelengths_summed else {"wavelength": axis(self.wavelengths, 2, axes)}
        return {
            "object_distance": axis(self.object_distances, 0, axes),
            **{f"field_{a}": field for a, field in zip("xy", self._fields, strict=True)},
            **colours,
            **{f"centroid_{a}": t for a, t in zip("xy", self.centroid, strict=True)},
            **{f"sigma_{a}_um": t for a, t in zip("xy", _sigmas(self.covariance), strict=True)},
            **{f"ray_sigma_{a}_um": t for a, t in zip("xy", _sigmas(self.ray_covariance), strict=True) if self.waves},
            "energy": self.energy,
            "error": self.error,
            "rays": torch.tensor(self.rays, device=self.energy.device),
        }

    def document(self) -> dict:
        """The kernels for JSON, distance-major, without their pixels."""
        return {
            "model": self.model,
            "reason": self.reason or None,
            "wavelengths": numbers(self.wavelengths),
            "wavelength_weights": numbers(self.wavelength_weights),
            "wavelengths_summed": self.wavelengths_summed,
            "results": [self._entry(place) for place in np.ndindex(self.energy.shape)],
        }

    def _entry(self, place: tuple[int, ...]) -> dict:
        centroid, covariance, ray_centroid, ray_covariance = (
            moment.movedim(0, -1)[place]
            for moment in (self.centroid, self.covariance, self.ray_centroid, self.ray_covariance)
        )
        return {
            "object_distance": number(self.object_distances[place[0]]),
            "field": numbers(self._fields.expand(2, *self.energy.shape).movedim(0, -1)[place]),
            **({} if self.wavelengths_summed else {"wavelength": number(self.wavelengths[place[2]])}),
            "centroid": numbers(centroid),
            "ray_centroid": numbers(ray_centroid),
            "covariance": [numbers(covariance[:2]), numbers(covariance[1:])],
            "ray_covariance": [numbers(ray_covariance[:2]), numbers(ray_covariance[1:])],
            "energy": number(self.energy[place]),
            "error": number(self.error[place]),
            "residual": None if self.residual is None else number(self.residual[place]),
            "rays": self.rays,
        }

    def save(self, path: str | PathLike) -> None:
        """Write the arrays (.npz): psf[distance, field, y, x], or [distance, field, wavelength, y, x], and its axes."""
        names = (
            *("energy", "error", "centroid", "covariance", "ray_centroid", "ray_covariance", "wavelengths"),
            *("wavelength_weights", "wavelengths_summed", "model", "normalised"),
        )
        arrays = {name: getattr(self, name) for name in names}
        arrays |= {"psf": self.kernel, "centre": self.grid.centre, "object_distance": self.object_distances}
        arrays |= {"field": self.fields.movedim(0, -1), "pixel_pitch": self.grid.pitch}
        arrays = {name: t.detach().cpu().numpy() if isinstance(t, Tensor) else t for name, t in arrays.items()}
        write_atomically(path, lambda file: np.savez_compressed(file, **arrays))

    def tables(self) -> list[Table]:
        pitch = 1000 * float(self.grid.pitch)
        lines = [f"{self.model} PSF, {self.grid.columns} × {self.grid.rows} pixels of {pitch:g} µm, {self._colours()}"]
        lines += [self.reason] if self.reason else []
        if self.waves:
            lines.append("centroid and σ: of the light inside the window, before pixels; rays' σ: of geometric optics")
        outside = bool(((self.energy < 1e-6) & (self.ray_covariance > 0).any(0)).any())
        remark = "kernels of energy 0: their light lies outside the window; --center chief moves it there"
        return [Table(self.columns(), lines, [remark] if outside else [])]

    def _colours(self) -> str:
        """The wavelengths in words, and whether they are summed."""
        colours = ", ".join(f"{wavelength:g}" for wavelength in self.wavelengths.tolist())
        if len(self.wavelengths) == 1:
            return f"at {colours} µm"
        shares = (self.wavelength_weights / self.wavelength_weights.max()).tolist()
        weights = ":".join(f"{share:.3g}" for share in shares)
        return f"summed over {colours} µm by weights {weights}" if self.wavelengths_summed else f"each of {colours} µm"


def _sigmas(covariance: Tensor) -> Tensor:
    """σ_x and σ_y (2, ...) in µm; nan where there is no light."""
    return 1e3 * covariance[::2].clamp_min(0.0).sqrt()


Light = TypeVar("Light", Kernels, Psf)


def combined(parts: Sequence[Light], join: Callable[[list[Tensor], int], Tensor]) -> Light:
    """One Kernels or Psf of several of a kind: `join(tensors, axes before those of the batch)` of all their tensors."""
    names = [field.name for field in dataclasses.fields(parts[0]) if field.name in _BEFORE]
    names = [name for name in names if getattr(parts[0], name) is not None]
    tensors: dict[str, Any] = {name: join([getattr(part, name) for part in parts], _BEFORE[name]) for name in names}
    return dataclasses.replace(parts[0], rays=max(part.rays for part in parts), **tensors)


def centroid_and_covariance(x: Tensor, y: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
    """Centroid (2, ...) and covariance (3, ...) of points (..., P), by shares that sum to 1 or are 0."""
    mean_x, mean_y = (share * x).sum(-1), (share * y).sum(-1)
    x, y = x - mean_x[..., None], y - mean_y[..., None]
    covariance = [(share * pair).sum(-1) for pair in (x * x, x * y, y * y)]
    return torch.stack([mean_x, mean_y]), torch.stack(covariance)


def moments_of_rays(points: Tensor, energy: Tensor, fold: str = "none") -> tuple[Tensor, Tensor]:
    """Centroid (2, ...) and covariance (3, ...) of rays (2, ..., P) by their energies (..., P); 0 where none arrives.

    fold: the symmetry of the light, see `scene.symmetry`. A ray is subtracted before the mean is formed and the mean
    before squares are, so that a small spot far off the axis loses no precision and no variance is negative.
    """
    lit = energy > 0
    share = safe_divide(energy, energy.sum(-1, keepdim=True).expand(energy.shape))
    x, y = torch.where(lit, points, 0.0)
    zero = share.new_zeros(share.shape[:-1])  # also of no rays, the share of a process without work
    if fold == "round":
        # Turned about the axis, a ray at height r is a ring of second moment r²/2 per axis.
        variance = 0.5 * (share * (x * x + y * y)).sum(-1)
        return torch.stack([zero, zero]), torch.stack([variance, zero, variance])
    first = lit & (lit.to(torch.int64).cumsum(-1) == 1)

    def centred(x: Tensor) -> tuple[Tensor, Tensor]:
        reference = torch.where(first, x, 0.0).sum(-1, keepdim=True)
        offset = torch.where(lit, x - reference, 0.0)
        mean = (share * offset).sum(-1, keepdim=True)
        return (reference + mean)[..., 0], torch.where(lit, offset - mean, 0.0)

    (x_mean, x), (y_mean, y) = centred(x) if fold == "none" else (zero, x), centred(y)
    xy = (share * x * y).sum(-1) if fold == "none" else zero
    return torch.stack([x_mean, y_mean]), torch.stack([(share * x * x).sum(-1), xy, (share * y * y).sum(-1)])


def mixture(energy: Tensor, centroid: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Centroid (2, ...) and covariance (3, ...) of the light of K distributions, (2, ..., K) and (3, ..., K).

        m = Σ_k s_k m_k,   C = Σ_k s_k (C_k + (m_k - m)(m_k - m)ᵀ),   s_k = E_k / Σ E

    Nothing large is subtracted (Chan, Golub and LeVeque, Stanford STAN-CS-79-773, 1979, eq. 2.1).
    """
    share = safe_divide(energy, energy.sum(-1, keepdim=True).expand(energy.shape))
    mean, apart = centroid_and_covariance(centroid[0], centroid[1], share)
    return mean, apart + (share * covariance).sum(-1)


def polychromatic(kernels: Kernels, scene: Scene, weights: Tensor | None, model: str) -> Psf:
    """Kernels of a scene summed over its wavelengths by their weights, with the moments of the sum of distributions.

    Without weights every wavelength keeps its kernel.
    """
    moments, rays = (kernels.centroid, kernels.covariance), kernels.ray_moments
    waves = kernels.ray_centroid is not None
    kernel, energy, residual, arrived = kernels.kernel, kernels.energy, kernels.residual, kernels.arrived
    share = torch.ones_like(scene.wavelengths) if weights is None else weights
    share = share / share.sum()
    if weights is not None:
        kernel = (share[:, None, None] * kernel).sum(-3)
        arrived = (share * arrived).sum(-1)
        residual = None if residual is None else (share * residual).sum(-1)
        rays = mixture(torch.where(kernels.dark, 0.0, share), *rays)
        # The light inside a window counts by its energy there.
        moments = mixture(share * energy, *moments) if waves else rays
        energy = kernel.sum((-2, -1))
    centre = kernels.grid.centre if kernels.grid.centre.dim() == 1 else kernels.grid.centre[..., 0]
    grid, error = dataclasses.replace(kernels.grid, centre=centre), torch.full_like(energy.detach(), torch.nan)
    return Psf(
        kernel=kernel,
        grid=grid,
        energy=energy,
        error=error,
        centroid=moments[0],
        covariance=moments[1],
        ray_centroid=rays[0],
        ray_covariance=rays[1],
        arrived=arrived,
        lens=scene.lens,
        fields=scene.fields,
        object_distances=scene.lens.surfaces[0].thickness.flatten(),
        wavelengths=scene.wavelengths,
        wavelength_weights=share,
        residual=residual,
        model=model,
        waves=waves,
        rays=kernels.rays,
    )


def without_dark(psfs: Psf, empty: str = "nan") -> Psf:
    """The PSFs with moments that are nan where no ray reaches the sensor; empty: as for `psf`."""
    dark = _is_dark(psfs, psfs.ray_centroid, psfs.ray_covariance, of_waves=psfs.waves)
    if empty == "error" and bool(dark.any()):
        places = ", ".join(str(tuple(place)) for place in torch.nonzero(dark)[:3].tolist())
        dark_of_all = f"{int(dark.sum())} of {dark.numel()}"
        raise EmptyPsf(f"no ray reaches the sensor in {dark_of_all} PSFs, those of index {places}")
    moments = psfs.centroid, psfs.covariance, psfs.ray_centroid, psfs.ray_covariance
    centroid, covariance, ray_centroid, ray_covariance = (torch.where(dark, torch.nan, moment) for moment in moments)
    return dataclasses.replace(
        psfs, centroid=centroid, covariance=covariance, ray_centroid=ray_centroid, ray_covariance=ray_covariance
    )


def _is_dark(light: Kernels | Psf, centroid: Tensor, covariance: Tensor, *, of_waves: bool) -> Tensor:
    """Which kernels no ray reaches: light and moments of rays are exactly 0, but the reference of waves, a centroid."""
    empty = (light.kernel == 0).all(-1).all(-1) & (covariance == 0).all(0)
    return empty & (of_waves | (centroid == 0).all(0)) & (light.rays > 0)
