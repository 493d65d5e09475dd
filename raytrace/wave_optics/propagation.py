"""Propagation from a phase element to the sensor: a radial engine, and engines of transfer functions.

Radial engine: elements that depend on the distance from the axis alone, along one radius.

    U(ρ) = 2π/λ ∫_0^R A exp(ik W_residual(r)) J₀(k ρ t(r)) z/(r² + z²) r dr,   t = r/z; true spheres t = r/√(r² + z²)

The integral is a Gauss rule in r² between the radii where a height steps or jumps (ring edges, zones of a wrapped
lens), so that only smooth phases are ever sampled. |U|² is band-limited: its values at a few radii give the light of
every pixel (`psf_models.radial`). J₀ depends on neither heights nor depths: while those alone vary, a step costs one
real product.

Transfer-function engines: the sampled field behind the element carried to the sensor by FFT, as references.

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

from raytrace.maths.numerics import safe_sqrt, value
from raytrace.psf_models.dft import bessel_j0, phasor
from raytrace.psf_models.radial import radii_of_waves, unfold
from raytrace.wave_optics.element import Rings, designed_height, path
from raytrace.wave_optics.pupil import disc_cells
from raytrace.wave_optics.scene import WaveScene, aperture, excess, millimetres, spheres

_LOBES = 24  # samples on either side in the interpolation from the field's grid to the nodes of the pixels


def padded(samples: int, pad: float) -> int:
    """Samples of the padded transform: pad·samples or the next number of small factors, as odd or even as `samples`."""
    size = math.ceil(pad * samples - 1e-9)
    while (size - samples) % 2 or pow(2 * 3 * 5 * 7, 64, size):
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
    f, width = torch.fft.fftfreq(size, dtype=pitch.dtype, device=pitch.device) / pitch, size * pitch
    if spectrum:
        f2 = f * f + (f * f)[:, None]
        rest = 1 - wavelength**2 * f2
        H = phasor(-wavelength * distance * f2 / (1 + safe_sqrt(rest))) * (rest > 0)
        limit = 1 / (wavelength * torch.sqrt((2 * distance / width) ** 2 + 1))
    else:
        # Separable: 2 M phasors in place of M².
        along = phasor(-0.5 * wavelength * distance * f * f)
        H = along * along[:, None]
        limit = width / (2 * wavelength * distance)
    if band_limit:
        passed = (f.abs() <= limit).to(f.dtype).detach()
        H = H * (passed * passed[:, None])
    before = (size - N) // 2
    padded = torch.nn.functional.pad(field, (before, size - N - before, before, size - N - before))
    # Both grids are centred on the axis: the same shift on either side of H cancels.
    return torch.fft.ifft2(torch.fft.fft2(padded) * H)


def at_nodes(field: Tensor, pitch: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Field (..., Y, X) at points v (Y), u (X) mm from samples (..., M, M) around the axis, by a windowed sinc; 0
    outside the samples."""
    size, along = field.shape[-1], []
    for axis, s in ((-2, v), (-1, u)):
        place = s / pitch + 0.5 * (size - 1)
        low, high = (int(torch.floor(extreme.detach())) for extreme in (place.min(), place.max()))
        first, last = max(0, low - _LOBES), min(size, high + _LOBES + 2)
        apart = place[:, None] - torch.arange(first, last, dtype=s.dtype, device=s.device)
        # Kaiser's window, β for a field of three quarters of the band.
        inside = (1 - (apart / (_LOBES + 1)) ** 2).clamp(min=0.0)
        beta = 0.25 * math.pi * (_LOBES + 1)
        window = torch.special.i0(beta * safe_sqrt(inside)) / float(np.i0(beta)) * (inside > 0)
        along.append((torch.sinc(apart) * window).to(field.dtype))
        field = field.narrow(axis, first, last - first)
    return along[0] @ field @ along[1].T


_PROBES = 20_000  # radii where the jumps of a wrapped height are looked for


@value
class RadialSums:
    """Sums that do not depend on the heights.

    r: (J,) mm, radii of the element; sphere: (D, J) mm; bessel: (W, K, J), from amplitudes at r to fields at the K
    radii of the sensor, with the weights of the integral; to_pixels: (U, K) mm² to the distinct pixels.
    """

    r: Tensor
    sphere: Tensor
    bessel: Tensor
    to_pixels: Tensor


def prepare_radial(scene: WaveScene, nodes: int, order: int) -> RadialSums:
    """Constants for `nodes` Gauss radii between steps, and an order of the radii on the sensor (`radii_of_waves`)."""
    rho, to_pixels = radii_of_waves(scene.grid, cutoff(scene), order)
    r, bessel = to_radii(scene, rho, nodes)
    return RadialSums(r, spheres(scene, r * r), bessel, to_pixels)


def to_radii(scene: WaveScene, rho: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
    """Radii r (J,) mm of the element, `nodes` between steps, and the matrix (W, K, J) from the phasors there to U, |U|²
    per mm², at radii rho (K,) mm of the sensor."""
    wavelength = millimetres(scene)[:, None, None]
    r, weight = rule(edges(scene), nodes)
    t, light = slope(scene, r)
    scale = 2 * math.sqrt(math.pi) / (aperture(scene) * wavelength)
    return r, scale * weight * light * bessel_j0(2 * math.pi * rho[:, None] * t / wavelength)


def radial_kernels(scene: WaveScene, sums: RadialSums) -> Tensor:
    """Energy in the pixels (D, W, rows, columns), 1 = all through the aperture."""
    # A real matrix on the columns Re U, Im U of all depths.
    parts = torch.view_as_real(phasors(scene, sums.r, sums.sphere)).permute(1, 2, 0, 3).flatten(2)
    parts = (sums.bessel @ parts).unflatten(-1, (-1, 2))
    intensity = (parts**2).sum(-1).permute(2, 0, 1)
    return unfold(scene.grid, intensity @ sums.to_pixels.T)


def radial_field(scene: WaveScene, rho: Tensor, nodes: int) -> Tensor:
    """U (D, W, K) at radii rho (K,) mm on the sensor, |U|² per mm² as `intensity`."""
    r, bessel = to_radii(scene, rho, nodes)
    U = phasors(scene, r, spheres(scene, r * r))
    return (bessel.to(U.dtype) @ U[..., None])[..., 0]


def phasors(scene: WaveScene, r: Tensor, sphere: Tensor) -> Tensor:
    """exp(ik W_residual) (D, W, J) at radii r (J,) of the element; sphere: of `spheres`."""
    waves = path(scene.elements, r, torch.zeros_like(r), scene.wavelengths) + sphere[:, None]
    return phasor(waves / millimetres(scene)[:, None])


def slope(scene: WaveScene, r: Tensor) -> tuple[Tensor, Tensor]:
    """t(r), and cos θ/|x - u| = z/(r² + z²) in 1/mm; paraxially r/z and 1/z."""
    z = scene.sensor_distance
    if not scene.exact:
        return r / z, (1 / z).expand(r.shape)
    return r / torch.sqrt(r * r + z * z), z / (r * r + z * z)


def cutoff(scene: WaveScene) -> float:
    """Highest spatial frequency of the intensity, 1/mm, at the shortest wavelength: λN/2 is its sampling."""
    t, _ = slope(scene, aperture(scene).detach())
    return float(2 * t.detach() / millimetres(scene).detach().min())


def order_of(scene: WaveScene, nodes: int) -> int:
    """Order of `radii_of_waves` that takes so many nodes per pixel."""
    return nodes - 4 - math.ceil(0.5 * math.pi * cutoff(scene) * float(scene.grid.pitch.detach()))


def edges(scene: WaveScene) -> Tensor:
    """Radii (E,) mm from 0 to R between which no height steps or jumps."""
    R = aperture(scene)
    inner = [R.detach().new_zeros(0)]
    for element in scene.elements:
        if isinstance(element.profile, Rings):
            pitch, count = element.profile.pitch, len(element.profile.heights)
            inner.append(pitch * torch.arange(1, count, dtype=pitch.dtype, device=pitch.device))
        elif element.period is not None:
            # Radii where a wrapped or stepped smooth height jumps: between two probes h runs straight.
            r = R.detach() * torch.sqrt(torch.linspace(0, 1, _PROBES, dtype=R.dtype, device=R.device))
            h = designed_height(element, r, torch.zeros_like(r)).detach()
            step = h / (element.period.detach() / max(1, element.levels))
            k = step.floor().diff().nonzero()[:, 0]
            # The integer between the two, the higher one's floor.
            level = torch.maximum(step[k], step[k + 1]).floor()
            share = (level - step[k]) / (step[k + 1] - step[k])
            inner.append(torch.sqrt(r[k] ** 2 + share * (r[k + 1] ** 2 - r[k] ** 2)))
    # Steps of different elements at the same radius, to rounding, count once.
    radii = torch.cat(inner).sort().values
    share = radii.detach() / R.detach()
    apart = (torch.cat([share.new_zeros(1), share]).diff() > 1e-9) & (share < 1 - 1e-9)
    return torch.cat([R.new_zeros(1), radii[apart], R.reshape(1)])


def rule(edges: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
    """Radii (J,) mm and weights (J,) mm² of ∫ f r dr: Gauss nodes in r² between each pair of edges."""
    place, share = (edges.new_tensor(a) / 2 for a in np.polynomial.legendre.leggauss(nodes))
    s = edges * edges
    width = s.diff()[:, None]
    middle = (0.5 * (s[1:] + s[:-1]))[:, None]
    return torch.sqrt(middle + place * width).flatten(), 0.5 * (share * width).flatten()
