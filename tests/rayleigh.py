"""Rayleigh and Sommerfeld's first integral as a plain sum over the aperture: the reference, at a few points.

    U(u) = 1/λ Σ_j A_j exp(ik [W_j + S(|x_j|², z') + S(|x_j - u|², z)]) z/d² (1 + i/(kd)) dA_j,   d = |(x_j - u, z)|

With Fresnel's paraboloids (`scene.exact` False) S = r²/(2z), and the factor is 1/z. The constant -i exp(ikz) is left
out.
"""

import math

import torch
from torch import Tensor

from raytrace.maths.sampling import gauss_rings
from raytrace.psf_models.dft import phasor
from raytrace.wave_optics.element import path
from raytrace.wave_optics.scene import WaveScene, aperture, excess, millimetres


def field(
    scene: WaveScene, u: Tensor, v: Tensor, *, rings: int = 200, arms: int | None = None, chunk: int = 2_000_000
) -> Tensor:
    """U (D, W, K) at points u, v (K,) mm of the sensor, |U|² per mm² with 1 = all light through the aperture.

    rings, arms: of a Gauss rule over the disc, exact for smooth elements once the phase is resolved. chunk: so many
    terms are held at a time.
    """
    R, wavelength = aperture(scene), millimetres(scene)[:, None, None]
    points, weights = gauss_rings(rings, arms, dtype=R.dtype, device=R.device)
    x, y = R * points
    r2, near = x * x + y * y, (1 / scene.depths)[:, None]
    source = excess(r2, near) if scene.exact else 0.5 * r2 * near
    arrived = source[:, None] + path(scene.elements, x, y, scene.wavelengths)  # D, W, J
    fields = []
    size = max(1, chunk // (arrived.numel()))
    for a, b in zip(u.split(size), v.split(size), strict=True):
        d2 = (x - a[:, None]) ** 2 + (y - b[:, None]) ** 2  # K, J
        left, spread = _last_step(scene, d2, wavelength)
        terms = phasor((arrived[:, :, None] + left) / wavelength) * spread
        fields.append((terms * weights).sum(-1) * (math.sqrt(math.pi) * R / wavelength[:, 0]))
    return torch.cat(fields, -1)


def _last_step(scene: WaveScene, d2: Tensor, wavelength: Tensor) -> tuple[Tensor, Tensor]:
    """Path (K, J) mm beyond z, and the factor (W, K, J) 1/mm of the wavelets."""
    z = scene.sensor_distance
    if not scene.exact:
        return d2 / (2 * z), torch.ones_like(d2) / z
    distance = torch.sqrt(d2 + z * z)
    near_field = torch.complex(torch.ones_like(wavelength * distance), wavelength / (2 * math.pi * distance))
    return excess(d2, 1 / z), z / distance**2 * near_field
