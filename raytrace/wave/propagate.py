"""Transfer-function engines: the sampled field behind the element carried to the sensor by FFT, as references.

    U_z = F⁻¹ H F U_0
    Fresnel            H = exp(-iπλz f²)
    angular spectrum   H = exp(ikz [√(1 - λ²f²) - 1]) = exp(-2πi λz f²/(1 + √(1 - λ²f²)))

The constant exp(ikz) is left out. Both wrap light round that leaves the padded width L; the band limit of Matsushima
and Shimobaba (Opt. Express 17, 19662 (2009)) removes the frequencies whose light would, |f| < L/(2λz) in Fresnel's
case. The converging field itself is sampled here: a pitch beyond λz/D aliases its rim. The angular spectrum is exact
from the element on: it is to be compared with scenes of true spheres.
"""

import math

import numpy as np
import torch
from torch import Tensor

from raytrace.kernels.dft import phasor, sub_pixels
from raytrace.maths.numerics import safe_sqrt
from raytrace.wave.element import path
from raytrace.wave.pupil import disc_cells
from raytrace.wave.scene import WaveScene, aperture, excess, millimetres

_LOBES = 24  # samples on either side in the interpolation from the field's grid to the nodes of the pixels


def intensity(
    scene: WaveScene, *, samples: int, nodes: int, pad: float, band_limit: bool, spectrum: bool
) -> tuple[Tensor, Tensor]:
    """Light per mm² (D, W, Y, X) at the nodes of the pixels, and the weights of the nodes.

    samples: across the diameter; pad: width of the transform over the diameter. spectrum: the angular spectrum's
    transfer function instead of Fresnel's.
    """
    pitch = 2 * aperture(scene) / samples
    u, v, weight = sub_pixels(scene.grid, nodes)
    rows = []
    for k in range(len(scene.wavelengths)):
        field = behind(scene, k, samples)
        wavelength = millimetres(scene)[k]
        size = padded(samples, pad)
        field = propagate(
            field, pitch, scene.sensor_distance, wavelength, size=size, band_limit=band_limit, spectrum=spectrum
        )
        rows.append(at_nodes(field, pitch, u, v))
    U = torch.stack(rows, 1)
    return U.real**2 + U.imag**2, weight


def padded(samples: int, pad: float) -> int:
    """Samples of the padded transform: pad·samples or the next number of small factors, as odd or even as `samples`."""
    size = math.ceil(pad * samples - 1e-9)
    while (size - samples) % 2 or not _smooth(size):
        size += 1
    return size


def behind(scene: WaveScene, k: int, samples: int) -> Tensor:
    """Field (D, N, N) at wavelength k just behind the elements, 1/mm: |U|² dx² sums to 1."""
    R, wavelength = aperture(scene), millimetres(scene)[k]
    axis = R * R.new_tensor((2 * np.arange(samples) + 1 - samples) / samples)
    x, y = torch.broadcast_tensors(axis, axis[:, None])
    cells = R.new_tensor(disc_cells(samples, 1.0) * (samples / 2) ** 2)
    r2, near = x * x + y * y, (1 / scene.depths)[:, None, None]
    source = excess(r2, near) if scene.exact else 0.5 * r2 * near
    waves = (source + path(scene.elements, x, y, scene.wavelengths[k : k + 1])) / wavelength
    return cells / (math.sqrt(math.pi) * R) * phasor(waves)


def propagate(
    field: Tensor,
    pitch: Tensor,
    distance: Tensor,
    wavelength: Tensor,
    *,
    size: int | None = None,
    band_limit: bool = True,
    spectrum: bool = False,
) -> Tensor:
    """Field (..., M, M) a distance (mm) behind one of (..., N, N) samples a pitch apart; wavelength: mm.

    size: M of the zero-padded transform, N by default. Without the band limit energy is kept to rounding (Parseval).
    """
    N = field.shape[-1]
    size = N if size is None else size
    f = torch.fft.fftfreq(size, dtype=pitch.dtype, device=pitch.device) / pitch
    H = transfer(f, distance, wavelength, size * pitch, band_limit=band_limit, spectrum=spectrum)
    before = (size - N) // 2
    padded = torch.nn.functional.pad(field, (before, size - N - before, before, size - N - before))
    # Both grids are centred on the axis: the same shift on either side of H cancels.
    return torch.fft.ifft2(torch.fft.fft2(padded) * H)


def transfer(
    f: Tensor, distance: Tensor, wavelength: Tensor, width: Tensor, *, band_limit: bool, spectrum: bool
) -> Tensor:
    """H (M, M) at frequencies f (M,) 1/mm along both axes; width: of the padded field, mm."""
    f2 = f * f + (f * f)[:, None]
    if spectrum:
        rest = 1 - wavelength**2 * f2
        H = phasor(-wavelength * distance * f2 / (1 + safe_sqrt(rest))) * (rest > 0)
        limit = 1 / (wavelength * torch.sqrt((2 * distance / width) ** 2 + 1))
    else:
        # Separable: 2 M phasors in place of M².
        along = phasor(-0.5 * wavelength * distance * f * f)
        H = along * along[:, None]
        limit = width / (2 * wavelength * distance)
    if not band_limit:
        return H
    kept = (f.abs() <= limit).to(f.dtype).detach()
    return H * (kept * kept[:, None])


def at_nodes(field: Tensor, pitch: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Field (..., Y, X) at points v (Y), u (X) mm from samples (..., M, M) around the axis, by a windowed sinc."""
    along, first, last = zip(*(_interpolation(s, pitch, field.shape[-1]) for s in (v, u)), strict=True)
    part = field[..., first[0] : last[0], first[1] : last[1]]
    return along[0].to(field.dtype) @ part @ along[1].to(field.dtype).T


def _interpolation(s: Tensor, pitch: Tensor, size: int) -> tuple[Tensor, int, int]:
    """Matrix (S, last - first) from samples of one axis to points s (S); outside the samples the field is 0."""
    place = s / pitch + 0.5 * (size - 1)
    low, high = (int(torch.floor(extreme.detach())) for extreme in (place.min(), place.max()))
    first, last = max(0, low - _LOBES), min(size, high + _LOBES + 2)
    apart = place[:, None] - torch.arange(first, last, dtype=s.dtype, device=s.device)
    # Kaiser's window, β for a field of three quarters of the band.
    inside = (1 - (apart / (_LOBES + 1)) ** 2).clamp(min=0.0)
    beta = 0.25 * math.pi * (_LOBES + 1)
    window = torch.special.i0(beta * safe_sqrt(inside)) / float(np.i0(beta)) * (inside > 0)
    return torch.sinc(apart) * window, first, last


def _smooth(number: int) -> bool:
    for factor in (2, 3, 5, 7):
        while number % factor == 0:
            number //= factor
    return number == 1
