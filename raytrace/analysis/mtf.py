"""Modulation transfer: of diffraction, by autocorrelation of the traced wave; of rays, by quadrature."""

import math

import torch
from torch import Tensor

from raytrace.analysis.aperture import MARGIN, exit_pupil
from raytrace.analysis.setting import primary_number, refuse_dark, scene_of, wavelength_weights, wavelengths_of
from raytrace.budget import RAY_BYTES, piece
from raytrace.kernels.dft import phasor, rings_and_arms
from raytrace.maths.numerics import safe_divide, safe_sqrt
from raytrace.maths.pupil import gauss_rings
from raytrace.maths.result import Result, axis
from raytrace.maths.value import value
from raytrace.optics.focus import image_rays
from raytrace.optics.paraxial import first_order
from raytrace.optics.scene import Scene
from raytrace.optics.spot import spot_of
from raytrace.system.lens import Lens, with_sensor_distance

_LEAST_RINGS, _MOST_RAYS = 24, 100_000


@value
class Mtf(Result):
    """Modulation of all wavelengths together, by field and spatial frequency.

    tangential, sagittal: (F, K), of patterns that vary along y and along x.
    limit: (K,) of a perfect lens of the paraxial working F/# on the axis, or None for rays alone.
    frequencies: (K,) cycles/mm on the sensor; fields: (2, F); kind: "diffraction" or "geometric".
    """

    tangential: Tensor
    sagittal: Tensor
    limit: Tensor | None
    frequencies: Tensor
    fields: Tensor
    kind: str

    def columns(self) -> dict[str, Tensor]:
        table = {
            "field_x": axis(self.fields[0], 0, 2),
            "field_y": axis(self.fields[1], 0, 2),
            "frequency": axis(self.frequencies, 1, 2),
            "tangential": self.tangential,
            "sagittal": self.sagittal,
        }
        return table if self.limit is None else {**table, "diffraction_limit": axis(self.limit, 1, 2)}


@value
class ThroughFocusMtf(Result):
    """Modulation at one frequency over sensor distances: tangential, sagittal (S, F); sensor_distances: (S,) mm.

    frequency: cycles/mm; fields: (2, F); kind: "diffraction" or "geometric".
    """

    tangential: Tensor
    sagittal: Tensor
    sensor_distances: Tensor
    frequency: Tensor
    fields: Tensor
    kind: str

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
    frequencies: Tensor | None = None,
    *,
    kind: str = "diffraction",
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
) -> Mtf:
    """MTF at frequencies (K,) cycles/mm, by default 41 of `frequency_range`; fields: (2, F).

        OTF(ν) = ∬ A(L, M + λν) A*(L, M) dL dM / ∬ |A|²              "diffraction"
        OTF(ν) = Σ_j w_j exp(-2πi ν y_j),  y_j where ray j lands      "geometric"

    The wavelengths' OTFs add by weight and transmitted light, each at its own place on the sensor: lateral colour
    counts. Raises ValueError for another kind, and where too few rays arrive or the blur is too large.
    """
    functions = {"diffraction": _diffraction, "geometric": _geometric}
    if kind not in functions:
        raise ValueError(f"unknown kind of MTF {kind!r}; expected one of {', '.join(functions)}")
    wavelengths_of(lens, wavelengths)
    if frequencies is None:
        frequencies = frequency_range(lens, 41, fields=fields)
    tangential, sagittal = functions[kind](lens, frequencies, fields, wavelengths)
    return Mtf(
        tangential=tangential,
        sagittal=sagittal,
        limit=diffraction_limit(lens, frequencies, wavelengths) if kind == "diffraction" else None,
        frequencies=frequencies,
        fields=torch.stack([lens.fields.x, lens.fields.y]) if fields is None else fields,
        kind=kind,
    )


def mtf_through_focus(
    lens: Lens,
    frequency: Tensor | float,
    sensor_distances: Tensor,
    *,
    kind: str = "diffraction",
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
) -> ThroughFocusMtf:
    """MTF at one frequency (cycles/mm) with the sensor at each of the distances (S,) mm; the rest as for `mtf`."""
    frequency = torch.as_tensor(frequency, dtype=sensor_distances.dtype, device=sensor_distances.device).reshape(1)
    found = [
        mtf(with_sensor_distance(lens, distance), frequency, kind=kind, fields=fields, wavelengths=wavelengths)
        for distance in sensor_distances
    ]
    tangential, sagittal = (torch.stack([getattr(m, name)[:, 0] for m in found]) for name in ("tangential", "sagittal"))
    return ThroughFocusMtf(tangential, sagittal, sensor_distances, frequency, found[0].fields, kind)


def frequency_range(lens: Lens, size: int, *, fields: Tensor | None = None) -> Tensor:
    """Frequencies (size,) cycles/mm from 0 to 2/σ, σ along a section of the spot of the sharpest field (2, F), and to
    half the cutoff of diffraction at the most; not differentiated."""
    with torch.no_grad():
        rays = image_rays(lens, gauss_rings(6)[0], fields=fields)
        radius = spot_of(rays, gauss_rings(6)[1]).rms_radius
        sharpest = torch.where(rays.valid.any(-1), radius, torch.inf).amin() * 0.5**0.5
        top = torch.minimum(0.5 * cutoff(lens, lens.wavelengths[lens.primary_wavelength]), 2 / sharpest)
    return top * torch.linspace(0, 1, size, dtype=top.dtype, device=top.device)


def cutoff(lens: Lens, wavelength: Tensor) -> Tensor:
    """Highest frequency 1/(λ N) in cycles/mm that passes on the axis, N the paraxial working F/#."""
    return 1e3 / (wavelength * first_order(lens).working_f_number)


def diffraction_limit(lens: Lens, frequencies: Tensor, wavelengths: Tensor | None = None) -> Tensor:
    """MTF (K,) of a circular pupil without aberrations, (2/π)(acos s - s √(1 - s²)), s = ν/cutoff, by weights."""
    shares = wavelength_weights(lens, wavelengths)
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    return (_circle(frequencies[:, None] / cutoff(lens, wavelengths)) * shares).sum(-1)


def _diffraction(lens: Lens, frequencies: Tensor, fields, wavelengths) -> tuple[Tensor, Tensor]:
    whole = scene_of(lens, fields, wavelengths)
    primary, shares = primary_number(lens, wavelengths), wavelength_weights(lens, wavelengths)
    rows = []
    for field in whole.fields.split(1, 1):  # each on a grid as fine as its own blur asks for
        pupil = exit_pupil(Scene(whole.lens, field, whole.wavelengths))
        shift, weights = _from_primary(pupil.centre, primary), shares * pupil.light
        otfs = (_along(lines, pupil.energy, frequencies, pupil.step[axis]) for axis, lines in _lines(pupil.amplitude))
        rows.append([_modulation(otf, frequencies, s, weights) for otf, s in zip(otfs, shift.flip(0), strict=True)])
    tangential, sagittal = (torch.cat(parts) for parts in zip(*rows, strict=True))
    return tangential, sagittal


def _lines(amplitude: Tensor) -> tuple[tuple[int, Tensor], tuple[int, Tensor]]:
    """Lines of the pupil along y, and along x."""
    return (1, amplitude.transpose(-1, -2)), (0, amplitude)


def _along(lines: Tensor, energy: Tensor, frequencies: Tensor, step: Tensor) -> Tensor:
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
    smooth = overlap - _circle(lag.abs() * MARGIN / size)
    between = torch.sinc(steps[..., None] - lag)
    return (between.to(overlap.dtype) @ smooth[..., None])[..., 0] + _circle(steps * MARGIN / size)


def _circle(s: Tensor) -> Tensor:
    """OTF (2/π)(acos s - s √(1 - s²)) of a clear circle, s the frequency over its cutoff; 0 beyond."""
    passes = s < 1
    s = torch.where(passes, s, 0.5)
    return torch.where(passes, (2 / math.pi) * (torch.acos(s) - s * safe_sqrt(1 - s * s)), 0.0)


def _geometric(lens: Lens, frequencies: Tensor, fields, wavelengths) -> tuple[Tensor, Tensor]:
    like = {"dtype": lens.wavelengths.dtype, "device": lens.wavelengths.device}
    with torch.no_grad():
        probe = image_rays(lens, gauss_rings(6, **like)[0], fields=fields, wavelengths=wavelengths)
        reach = torch.where(probe.valid, probe.position[:2], torch.nan)
        blur = (reach - reach.nanmean(-1, keepdim=True)).abs().nan_to_num(0.0).max()
        rings, arms = rings_and_arms(2 * math.pi * float(blur * frequencies.max()), 0)
    rings, arms = max(rings, _LEAST_RINGS), max(arms, 4 * _LEAST_RINGS)
    if rings * arms > _MOST_RAYS:
        raise ValueError(
            f"the blur needs {rings * arms} rays at {float(frequencies.max()):g} cycles/mm: focus the lens"
        )
    pupil = gauss_rings(rings, arms, **like)
    whole = scene_of(lens, fields, wavelengths)
    together = piece(2 * RAY_BYTES * len(whole.wavelengths) * rings * arms)
    parts = [_of_spots(lens, frequencies, some, wavelengths, *pupil) for some in whole.fields.split(together, 1)]
    tangential, sagittal = (torch.cat(part) for part in zip(*parts, strict=True))
    return tangential, sagittal


def _of_spots(lens: Lens, frequencies: Tensor, fields: Tensor, wavelengths, points: Tensor, rule: Tensor) -> tuple:
    """Tangential and sagittal MTF (F, K) of rays."""
    rays = image_rays(lens, points, fields=fields, wavelengths=wavelengths)
    energy = torch.where(rays.valid, rule, 0.0)
    light = energy.sum(-1)
    given = scene_of(lens, fields, wavelengths)
    refuse_dark(lens, given.fields, given.wavelengths, light > 0, "MTF")
    hits = torch.where(rays.valid, rays.position[:2], 0.0)
    mean = (energy * hits).sum(-1) / light
    weights = wavelength_weights(lens, wavelengths) * light
    shift = _from_primary(mean, primary_number(lens, wavelengths))
    result = []
    for along in (1, 0):
        offset = torch.where(rays.valid, hits[along] - mean[along][..., None], 0.0)
        otf = [(phasor(-frequency * offset) * energy).sum(-1) / light for frequency in frequencies]
        result.append(_modulation(torch.stack(otf, -1), frequencies, shift[along], weights))
    return tuple(result)


def _from_primary(place: Tensor, primary: int) -> Tensor:
    return place - place[..., primary : primary + 1]


def _modulation(otf: Tensor, frequencies: Tensor, shift: Tensor, weights: Tensor) -> Tensor:
    """|OTF| (F, K) of OTFs (F, W, K) at places `shift` (F, W) mm, added by weights (F, W)."""
    weights = safe_divide(weights, weights.sum(-1, keepdim=True))[..., None]
    total = (weights * otf * phasor(-frequencies * shift[..., None])).sum(-2)
    return safe_sqrt(total.real**2 + total.imag**2)
