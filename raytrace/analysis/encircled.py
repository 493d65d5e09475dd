"""Encircled energy: the share of a field's light within a radius of its centroid."""

import math

import torch
from torch import Tensor

from raytrace.analysis.panels import by_field, chart, finished, mark_fields
from raytrace.analysis.pupil_autocorrelation import ExitPupil, exit_pupil
from raytrace.analysis.result import Analysis, fine
from raytrace.analysis.setting import (
    Numbers,
    Points,
    primary_wavelength,
    refuse_dark,
    scene_of,
    setting,
    wavelength_shares,
)
from raytrace.budget import RAY_BYTES, afford, piece
from raytrace.maths.numerics import safe_divide, safe_sqrt, value
from raytrace.plotting.style import GREY, Figure, array, styled
from raytrace.psf_models.dft import phasor
from raytrace.system.lens import Lens, vector
from raytrace.tracing.f_number import axial_f_number
from raytrace.tracing.scene import Scene
from raytrace.tracing.spot import image_rays
from raytrace.words import option

_RAYS = 4096
_RINGS_PER_STEP = 16


@value
class EncircledEnergy(Analysis):
    """Share (F, K) of the light that reaches the sensor within radii (K,) mm of the centroid (2, F) mm of the rays.

    fields: (2, F); geometric: of rays, without diffraction; marked: whether the radii were specified, and are marked on
    the curves.
    """

    lens: Lens
    fields: Tensor
    radii: Tensor
    share: Tensor
    centroid: Tensor
    geometric: bool
    marked: bool = False

    COMMAND = "encircled-energy"
    EVERY = 5

    def columns(self) -> dict[str, Tensor]:
        return {**self.heads(radius=self.radii), "share": self.share}

    def drawn(self) -> "EncircledEnergy":
        return _encircled(self.lens, self.fields, fine(self.radii), self.geometric)

    @styled
    def draw(self) -> Figure:
        """Share of the light over the radius about the centroid. Specified radii are marked."""
        curves = self.drawn()
        panel = chart(6.0, 3.8, "radius from the centroid (µm)", "encircled energy")
        radii = 1e3 * array(curves.radii)
        by_field(panel, curves, radii, share=array(curves.share))
        if self.marked:
            mark_fields(panel, 1e3 * array(self.radii), array(self.share))
        panel.axhline(0.8, color=GREY, linewidth=0.7, linestyle=":")
        panel.set(xlim=(0, radii.max()), ylim=(0, 1.02))
        light = "geometric" if curves.geometric else "diffraction"
        return finished(panel, curves, f"{light} encircled energy", 6)


def encircled_energy(
    lens: Lens,
    radii: Numbers = None,
    *,
    geometric: bool = False,
    fields: Points = None,
    wavelengths: Numbers = None,
) -> EncircledEnergy:
    """Encircled energy at radii (K,) mm, by default 41 up to the larger of the blur and six wavelengths times the F/#.

        E(r) = ∬ OTF(ν) r J₁(2πrν)/ν d²ν        of diffraction
        E(r) = Σ_j w_j [|x_j - x̄| < r]           geometric, linear between one ray and the next

    radii: about the centroid of the rays, mm, by default from 0 to almost all of the light; geometric: of rays alone,
    without diffraction; fields: y or (x, y); wavelengths: µm. Differentiable in the lens. Raises ValueError where too
    few rays arrive.
    """
    lens, fields = setting(lens, fields, wavelengths, every=True)
    return _encircled(lens, fields, None if radii is None else vector(radii, like=lens), geometric)


def _encircled(lens: Lens, fields: Tensor, radii: Tensor | None, geometric: bool) -> EncircledEnergy:
    distance, energy, centroid = _rays(lens, fields)
    marked = radii is not None
    if radii is None:
        airy = 6e-3 * primary_wavelength(lens) * axial_f_number(lens)
        blur = torch.where(energy > 0, distance, 0.0).max()
        airy = torch.where(airy.isfinite(), airy, 0.0)  # of a parallel beam there is none
        top = torch.maximum(blur * 1.02, airy * (not geometric)).detach()
        radii = top * torch.linspace(0, 1, 41, dtype=top.dtype, device=top.device)
    share = _of_rays(distance, energy, radii) if geometric else _of_waves(lens, fields, centroid, radii)
    return EncircledEnergy(lens, fields, radii, share, centroid, geometric, marked)


def _rays(lens: Lens, fields: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distances (F, W·P) from the centroid (2, F) of all wavelengths, and shares (F, W·P) of the light."""
    F, W = fields.shape[1], len(lens.wavelengths)
    afford(
        64 * F * W * _RAYS,
        f"{F * W * _RAYS:,} rays ({F} fields × {W} wavelengths)",
        helps="ask for fewer {fields}",
    )
    parts = [_rays_of(lens, some) for some in fields.split(piece(RAY_BYTES * W * _RAYS), 1)]
    distance, energy, centroid = zip(*parts, strict=True)
    return torch.cat(distance), torch.cat(energy), torch.cat(centroid, 1)


def _rays_of(lens: Lens, fields: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    rays = image_rays(lens, _spiral(_RAYS, lens.wavelengths), fields=fields)
    energy = torch.where(rays.valid, wavelength_shares(lens)[:, None] / _RAYS, 0.0).flatten(1)
    hits = torch.where(rays.valid, rays.position[:2], 0.0).flatten(2)
    total = energy.sum(-1)
    refuse_dark(lens, fields, (total > 0)[:, None], "encircled energy")
    energy = energy / total[:, None]
    centroid = (energy * hits).sum(-1)
    x, y = torch.where(energy > 0, hits - centroid[..., None], 0.0)
    return safe_sqrt(x * x + y * y), energy, centroid


def _of_rays(distance: Tensor, energy: Tensor, radii: Tensor) -> Tensor:
    """Half of the light of a ray counts at its distance; the curve is linear in between, and starts at 0."""
    distance, order = torch.where(energy > 0, distance, distance.max()).sort(-1)
    energy = torch.gather(energy, -1, order)
    half = energy.cumsum(-1) - 0.5 * energy
    zero = torch.zeros_like(distance[:, :1])
    place = torch.cat([zero, distance, distance[:, -1:]], -1)
    height = torch.cat([zero, half, torch.ones_like(zero)], -1)
    inside = torch.searchsorted(place.detach(), radii.expand(len(place), -1).contiguous(), right=True)
    after = inside.clamp(1, place.shape[-1] - 1)
    low, high = (torch.gather(place, -1, k) for k in (after - 1, after))
    below, above = (torch.gather(height, -1, k) for k in (after - 1, after))
    share = below + (above - below) * safe_divide(radii - low, high - low)
    return torch.where(radii >= place[:, -1:], 1.0, share)


def _of_waves(lens: Lens, fields: Tensor, centroid: Tensor, radii: Tensor) -> Tensor:
    whole, rows = scene_of(lens, fields), []
    for f, field in enumerate(fields.split(1, 1)):
        pupil = exit_pupil(Scene(whole.lens, field, whole.wavelengths))
        weights = wavelength_shares(lens) * pupil.light[0]
        parts = torch.stack([_of_wave(pupil, w, centroid[:, f], radii) for w in range(len(weights))])
        rows.append((weights[:, None] * parts).sum(0) / weights.sum())
    return torch.stack(rows)


def _of_wave(pupil: ExitPupil, w: int, centroid: Tensor, radii: Tensor) -> Tensor:
    """E (K,) of one wavelength of a field about the centroid (2,); the sum over ν is gathered in rings first."""
    size = pupil.amplitude.shape[-1]
    spectrum = torch.fft.fft2(pupil.amplitude[0, w], s=(2 * size, 2 * size))
    overlap = torch.fft.ifft2(spectrum.real**2 + spectrum.imag**2) / pupil.energy[0, w]
    first = torch.zeros_like(overlap, dtype=torch.bool)
    first[0, 0] = True
    overlap = torch.where(first, 1.0 + 0j, overlap)  # the rim's cells count by their share, not by its square
    lag = torch.fft.fftfreq(2 * size, 1 / (2 * size), dtype=radii.dtype, device=radii.device)
    step = pupil.step[:, 0, w]
    x, y = lag * step[0], lag[:, None] * step[1]
    offset_x, offset_y = centroid - pupil.centre[:, 0, w]
    offset, period = torch.hypot(offset_x, offset_y).detach(), 1 / step.detach()  # the transform repeats the light
    _refuse_far(offset, 0.5 * period.min())
    otf = (overlap * phasor(x * offset_x + y * offset_y)).real.flatten() * step.prod()
    width = step.min().detach() / _RINGS_PER_STEP
    place = torch.hypot(x, y).detach().flatten() / width
    ring = place.floor().to(torch.int64)
    rings = otf.new_zeros(int(ring.max()) + 2)
    rings = rings.index_add(0, ring, otf * (ring + 1 - place)).index_add(0, ring + 1, otf * (place - ring))
    frequency = (torch.arange(len(rings), dtype=radii.dtype, device=radii.device) * width).clamp_min(1e-6 * width)
    r = radii.detach().clamp_max(0.5 * period.min())[:, None]
    share = (r * torch.special.bessel_j1(2 * math.pi * r * frequency) / frequency) @ rings
    return torch.where(radii < 0.5 * torch.hypot(*period) + offset, share, 1.0)


def _refuse_far(offset: Tensor, reach: Tensor) -> None:
    """Raise ValueError for light so far (mm) from the centroid that the transform would count its repetitions."""
    if bool(offset > reach):
        raise ValueError(
            f"light of one wavelength lands {float(offset):.3g} mm from the centroid of all, beyond the "
            f"{float(reach):.3g} mm that waves are followed: ask for {option('geometric')}, or for one of the "
            f"{option('wavelengths')}"
        )


def _spiral(count: int, like: Tensor) -> Tensor:
    """Points (2, P) of a sunflower: equal areas, no two at one radius, so that a share grows evenly with the radius."""
    j = torch.arange(count, dtype=like.dtype, device=like.device)
    radius, angle = torch.sqrt((j + 0.5) / count), j * (math.pi * (3 - math.sqrt(5)))
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)])
