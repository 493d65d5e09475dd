"""Modulation transfer: of diffraction, by autocorrelation of the traced wave; of rays, by quadrature."""

import math

import torch
from torch import Tensor

from raytrace.analysis.aperture import MARGIN, exit_pupil
from raytrace.analysis.result import Analysis, fine
from raytrace.analysis.setting import (
    Numbers,
    Points,
    like,
    primary_wavelength,
    refuse_dark,
    scene_of,
    setting,
    wavelength_shares,
)
from raytrace.budget import RAY_BYTES, piece
from raytrace.kernels.dft import phasor, rings_and_arms
from raytrace.maths.numerics import safe_divide, safe_sqrt
from raytrace.maths.pupil import gauss_rings
from raytrace.maths.result import axis
from raytrace.maths.value import value
from raytrace.optics.f_number import axial_f_number
from raytrace.optics.focus import image_rays
from raytrace.optics.scene import Scene
from raytrace.optics.spot import spot_of
from raytrace.system.lens import Lens, vector, with_sensor_distance

_LEAST_RINGS, _MOST_RAYS = 24, 100_000
_FREQUENCIES, _DISTANCES = 41, 21  # that are told where none are asked for


@value
class Mtf(Analysis):
    """Modulation of all wavelengths together, by field and spatial frequency.

    tangential, sagittal: (F, K), of patterns that vary along y and along x.
    limit: (K,) of a perfect lens of the paraxial working F/# on the axis, or None for rays alone.
    frequencies: (K,) cycles/mm on the sensor; fields: (2, F); geometric: of rays, without diffraction.
    marked: whether the frequencies were asked for, and are marked on the curves.
    """

    lens: Lens
    fields: Tensor
    frequencies: Tensor
    tangential: Tensor
    sagittal: Tensor
    limit: Tensor | None
    geometric: bool
    marked: bool = False

    COMMAND = "mtf"
    FIGURE = "plot.analysis.mtf_curves"
    EVERY = 5

    def columns(self) -> dict[str, Tensor]:
        heads = self.heads(frequency=self.frequencies)
        table = {**heads, "tangential": self.tangential, "sagittal": self.sagittal}
        return table if self.limit is None else {**table, "diffraction_limit": axis(self.limit, 1, 2)}

    def drawn(self) -> "Mtf":
        return _mtf(self.lens, self.fields, fine(self.frequencies), self.geometric)


@value
class ThroughFocusMtf(Analysis):
    """Modulation at one frequency over sensor distances: tangential, sagittal (S, F); sensor_distances: (S,) mm.

    frequency: (1,) cycles/mm; fields: (2, F); geometric: of rays, without diffraction.
    """

    lens: Lens
    fields: Tensor
    frequency: Tensor
    sensor_distances: Tensor
    tangential: Tensor
    sagittal: Tensor
    geometric: bool

    COMMAND = "mtf"
    FIGURE = "plot.analysis.mtf_through_focus_curves"

    def columns(self) -> dict[str, Tensor]:
        return {
            "field_x": axis(self.fields[0], 1, 2),
            "field_y": axis(self.fields[1], 1, 2),
            "sensor_distance": axis(self.sensor_distances, 0, 2),
            "frequency": axis(self.frequency, 0, 2),
            "tangential": self.tangential,
            "sagittal": self.sagittal,
        }


def mtf(
    lens: Lens,
    frequencies: Numbers = None,
    *,
    geometric: bool = False,
    through_focus: float | None = None,
    fields: Points = None,
    wavelengths: Numbers = None,
) -> Mtf | ThroughFocusMtf:
    """MTF at frequencies (K,) cycles/mm, by default 41 of `frequency_range`; of diffraction, or geometric:

        OTF(ν) = ∬ A(L, M + λν) A*(L, M) dL dM / ∬ |A|²              diffraction
        OTF(ν) = Σ_j w_j exp(-2πi ν y_j),  y_j where ray j lands      geometric

    The wavelengths' OTFs add by weight and transmitted light, each at its own place on the sensor: lateral colour
    counts. through_focus: mm by which the sensor moves to either side, of one frequency. fields: y or (x, y);
    wavelengths: µm. Raises ValueError where too few rays arrive or the blur is too large.
    """
    lens, fields = setting(lens, fields, wavelengths, every=True)
    asked = None if frequencies is None else vector(frequencies, like=lens)
    if through_focus is not None:
        if asked is None or len(asked) != 1:
            raise ValueError("`through_focus` needs one spatial frequency: give `frequencies`")
        distances = lens.surfaces[-2].thickness + through_focus * torch.linspace(-1, 1, _DISTANCES, **like(lens))
        return _through_focus(lens, fields, asked, distances, geometric)
    given = frequency_range(lens, fields, _FREQUENCIES) if asked is None else asked
    return _mtf(lens, fields, given, geometric, marked=asked is not None)


def _mtf(lens: Lens, fields: Tensor, frequencies: Tensor, geometric: bool, *, marked: bool = False) -> Mtf:
    tangential, sagittal = (_geometric if geometric else _diffraction)(lens, fields, frequencies)
    perfect = clear_circle(frequencies[:, None] / cutoff(lens, lens.wavelengths)) @ wavelength_shares(lens)
    return Mtf(lens, fields, frequencies, tangential, sagittal, None if geometric else perfect, geometric, marked)


def _through_focus(
    lens: Lens, fields: Tensor, frequency: Tensor, distances: Tensor, geometric: bool
) -> ThroughFocusMtf:
    found = [_mtf(with_sensor_distance(lens, distance), fields, frequency, geometric) for distance in distances]
    tangential, sagittal = (torch.stack([getattr(m, name)[:, 0] for m in found]) for name in ("tangential", "sagittal"))
    return ThroughFocusMtf(lens, fields, frequency, distances, tangential, sagittal, geometric)


def frequency_range(lens: Lens, fields: Tensor, size: int) -> Tensor:
    """Frequencies (size,) cycles/mm from 0 to 2/σ, σ along a section of the spot of the sharpest field (2, F), and to
    half the cutoff of diffraction at the most; not differentiated."""
    with torch.no_grad():
        points, weights = gauss_rings(6, **like(lens))
        rays = image_rays(lens, points, fields=fields)
        radius = spot_of(rays, weights).rms_radius
        sharpest = torch.where(rays.valid.any(-1), radius, torch.inf).amin() * 0.5**0.5
        top = torch.minimum(0.5 * cutoff(lens, primary_wavelength(lens)), 2 / sharpest)
    return top * torch.linspace(0, 1, size, dtype=top.dtype, device=top.device)


def cutoff(lens: Lens, wavelength: Tensor) -> Tensor:
    """Highest frequency 1/(λ N) in cycles/mm that passes on the axis, N the paraxial working F/#, see
    `axial_f_number`."""
    return 1e3 / (wavelength * axial_f_number(lens))


def _diffraction(lens: Lens, fields: Tensor, frequencies: Tensor) -> tuple[Tensor, Tensor]:
    whole, rows = scene_of(lens, fields), []
    for field in fields.split(1, 1):  # each on a grid as fine as its own blur asks for
        pupil = exit_pupil(Scene(whole.lens, field, whole.wavelengths))
        shift, weights = _from_primary(lens, pupil.centre), wavelength_shares(lens) * pupil.light
        sections = zip((pupil.amplitude.mT, pupil.amplitude), pupil.step.flip(0), shift.flip(0), strict=True)
        otfs = ((otf_along(lines, pupil.energy, frequencies, step), place) for lines, step, place in sections)
        rows.append([modulation(otf, frequencies, place, weights) for otf, place in otfs])
    tangential, sagittal = (torch.cat(parts) for parts in zip(*rows, strict=True))
    return tangential, sagittal


def otf_along(lines: Tensor, energy: Tensor, frequencies: Tensor, step: Tensor) -> Tensor:
    """OTF (F, W, K) of waves (F, W, N, N) shifted along their last axis.

    Between whole steps by sin(πt)/(πt), of what is left when a clear circle's OTF, which has the same kink at zero
    frequency, is taken off.
    """
    size = lines.shape[-1]
    spectrum = torch.fft.fft(lines, n=2 * size)
    overlap = torch.fft.ifft((spectrum.real**2 + spectrum.imag**2).sum(-2))
    # Without a shift the rim's cells count by their share itself, not by its square.
    overlap = torch.cat([(energy + 0j)[..., None], overlap[..., 1:]], -1) / energy[..., None]
    lag = torch.fft.fftfreq(2 * size, 1 / (2 * size), dtype=step.dtype, device=step.device)
    steps = frequencies / step[..., None]
    smooth = overlap - clear_circle(lag.abs() * MARGIN / size)
    between = torch.sinc(steps[..., None] - lag)
    return (between.to(overlap.dtype) @ smooth[..., None])[..., 0] + clear_circle(steps * MARGIN / size)


def clear_circle(s: Tensor) -> Tensor:
    """OTF (2/π)(acos s - s √(1 - s²)) of a clear circle, s the frequency over its cutoff; 0 beyond."""
    passes = s < 1
    s = torch.where(passes, s, 0.5)
    return torch.where(passes, (2 / math.pi) * (torch.acos(s) - s * safe_sqrt(1 - s * s)), 0.0)


def _geometric(lens: Lens, fields: Tensor, frequencies: Tensor) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        probe = image_rays(lens, gauss_rings(6, **like(lens))[0], fields=fields)
        reach = torch.where(probe.valid, probe.position[:2], torch.nan)
        blur = (reach - reach.nanmean(-1, keepdim=True)).abs().nan_to_num(0.0).max()
        rings, arms = rings_and_arms(2 * math.pi * float(blur * frequencies.max()), 0)
    rings, arms = max(rings, _LEAST_RINGS), max(arms, 4 * _LEAST_RINGS)
    if rings * arms > _MOST_RAYS:
        raise ValueError(
            f"the blur needs {rings * arms} rays at {float(frequencies.max()):g} cycles/mm: focus the lens"
        )
    pupil = gauss_rings(rings, arms, **like(lens))
    together = piece(2 * RAY_BYTES * len(lens.wavelengths) * rings * arms)
    parts = [_of_spots(lens, some, frequencies, *pupil) for some in fields.split(together, 1)]
    tangential, sagittal = (torch.cat(part) for part in zip(*parts, strict=True))
    return tangential, sagittal


def _of_spots(lens: Lens, fields: Tensor, frequencies: Tensor, points: Tensor, rule: Tensor) -> tuple:
    """Tangential and sagittal MTF (F, K) of rays."""
    rays = image_rays(lens, points, fields=fields)
    energy = torch.where(rays.valid, rule, 0.0)
    light = energy.sum(-1)
    refuse_dark(lens, fields, light > 0, "MTF")
    hits = torch.where(rays.valid, rays.position[:2], 0.0)
    mean = (energy * hits).sum(-1) / light
    shift, weights = _from_primary(lens, mean), wavelength_shares(lens) * light
    result = []
    for along in (1, 0):
        offset = torch.where(rays.valid, hits[along] - mean[along][..., None], 0.0)
        otf = [(phasor(-frequency * offset) * energy).sum(-1) / light for frequency in frequencies]
        result.append(modulation(torch.stack(otf, -1), frequencies, shift[along], weights))
    return tuple(result)


def _from_primary(lens: Lens, place: Tensor) -> Tensor:
    """Places (..., W) of the wavelengths, from that of the primary one."""
    return place - place[..., lens.primary_wavelength - 1, None]


def modulation(otf: Tensor, frequencies: Tensor, shift: Tensor, weights: Tensor) -> Tensor:
    """|OTF| (F, K) of OTFs (F, W, K) at places `shift` (F, W) mm, added by weights (F, W)."""
    weights = safe_divide(weights, weights.sum(-1, keepdim=True))[..., None]
    total = (weights * otf * phasor(-frequencies * shift[..., None])).sum(-2)
    return safe_sqrt(total.real**2 + total.imag**2)
