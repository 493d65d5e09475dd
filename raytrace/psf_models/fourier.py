"""Fourier model: the diffraction PSF of an ideal lens out of focus, optionally with Zernike aberrations.

    PSF(x) = |F{A exp(iψ r²/R²)}|²,   ψ = (πR²/λ) (n/z_o + n'/z_i - φ)

from the first-order data of the lens: power φ and principal planes at every wavelength, R the entrance pupil's radius
(Goodman, Introduction to Fourier Optics, §6.4). The field of light through a pupil of unit energy is

    U(x) = √π a ∫ exp(iΨ(p)) exp(-2πi a p·x) dp/π,   a = n' R/(λ z_i) cycles per mm,

so that the integral of |U|² over the sensor is 1 (Parseval).
"""

import dataclasses
import itertools
import math

import torch
from torch import Tensor

from raytrace.budget import piece
from raytrace.maths import zernike as polynomials
from raytrace.maths.numerics import to, value
from raytrace.maths.sampling import Grid, gauss_rings, with_rim
from raytrace.psf_models import dft
from raytrace.psf_models.paraxial import chief_ray_height, need_one_focus
from raytrace.psf_models.radial import is_centred, light_of_radii, radii_of_waves, reach
from raytrace.psf_models.result import Kernels, centroid_and_covariance
from raytrace.system.lens import media
from raytrace.tracing.paraxial import first_order, signed
from raytrace.tracing.scene import Scene, symmetry

_MOST_POINTS = 400_000  # pupil points of one kernel; beyond, the phase is refused


@value
class DefocusedPupil:
    """First-order data of a lens; every entry (D, F, W).

    defocus: ψ at the edge of the pupil, radians; frequency: a, cycles per mm at the edge of the pupil;
    chief: (2, D, F, W) mm, where the paraxial chief ray meets the sensor.
    """

    defocus: Tensor
    frequency: Tensor
    chief: Tensor


def kernels(scene: Scene, grid: Grid, *, order: int = 0, zernike: Tensor | None = None) -> Kernels:
    """Kernels of the Fourier model about the paraxial chief ray.

    zernike: Noll coefficients from 1 on, (J,) or (J, D, F, W) with axes of length 1 to broadcast, mm RMS of path.
    order: from -2 on; each one adds pupil points and pixel nodes. centroid and covariance are those of the light inside
    the window: the second moment of a hard-edged diffraction pattern does not exist; ray_centroid and ray_covariance
    those of the geometric limit. Raises ValueError where the window or the blur would need too many pupil points, Bent
    as the paraxial model.
    """
    need_one_focus(scene.lens, "the Fourier PSF model", "take model=wave, which traces the wavefront")
    # In single precision a phase of hundreds of radians has three digits.
    single = grid.pitch.dtype != torch.float64 or scene.wavelengths.dtype != torch.float64
    scene, window = (to(scene, dtype=torch.float64), to(grid, dtype=torch.float64)) if single else (scene, grid)
    lens, waves = paraxial(scene), None
    numbers = torch.stack([lens.defocus.detach(), lens.frequency.detach()])
    if not bool(torch.isfinite(numbers).all()) or not bool((numbers[1] != 0).all()):
        raise ValueError(
            "the Fourier model has no pupil here: the lens is afocal, or the sensor or the object lies in a principal "
            "plane; move them, or use a ray model"
        )
    if zernike is not None:  # in waves, (J, D, F, W)
        zernike = zernike.to(torch.float64).reshape(len(zernike), *(zernike.shape[1:] or (1, 1, 1)))
        waves = (1e3 * zernike / scene.wavelengths).expand(-1, *scene.shape)
    shift, blur = _moments(lens, waves)
    if waves is None and symmetry(scene) == "round" and is_centred(window, scene):
        kernel, centroid, covariance = _round_kernels(scene, lens, window, order)
    else:
        kernel, centroid, covariance = _kernels(scene, lens, window, waves, order)
    shifted = Kernels(
        kernel, grid, lens.chief + centroid, covariance, rays=0, arrived=torch.ones_like(lens.defocus),
        ray_centroid=lens.chief + shift, ray_covariance=blur,
    )  # fmt: skip
    return dataclasses.replace(to(shifted, dtype=grid.pitch.dtype), grid=grid) if single else shifted


def _kernels(
    scene: Scene, lens: DefocusedPupil, window: Grid, waves: Tensor | None, order: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Kernels (D, F, W, rows, columns), one by one, for each has its phases; centroid and covariance."""
    shape = lens.defocus.shape
    centre = window.centre.reshape(2, *(window.centre.shape[1:] or (1, 1, 1))) - lens.chief
    steepest = float(scene.largest(lens.frequency.detach().abs().max()))
    nodes = dft.nodes_per_pixel(float(window.pitch.detach()), 2 * steepest, order)
    dft.afford_sensor("the Fourier PSF", scene, window, nodes)
    x, y, weight = dft.sub_pixels(Grid(window.pitch, window.rows, window.columns, centre), nodes)
    if waves is None:
        corner = torch.hypot(x.detach().abs().amax(-1), y.detach().abs().amax(-1)).max()
        phase = 2 * math.pi * steepest * float(corner) + 2 * float(lens.defocus.detach().abs().max())
        dft.afford_rings("the Fourier PSF", scene, dft.rings_and_arms(phase, order)[0], phase)
    pixels, moments = [], []
    for place in itertools.product(*map(range, shape)):
        noll = None if waves is None else waves.movedim(0, -1)[place]
        intensity = _intensity(x[place], y[place], lens.defocus[place], lens.frequency[place], noll, order=order)
        pixels.append(dft.integrate(intensity, weight, window.pitch))
        moments.append(dft.window_moments(intensity, x[place], y[place], weight, window.pitch))
    centroid, covariance = (torch.stack(parts, -1).unflatten(-1, shape) for parts in zip(*moments, strict=True))
    return torch.stack(pixels).unflatten(0, shape), centroid, covariance


def _round_kernels(scene: Scene, lens: DefocusedPupil, window: Grid, order: int) -> tuple[Tensor, Tensor, Tensor]:
    """The same on the axis, along one radius."""
    # Sensor and pupil decide the frequency, an object distance only the defocus: all share their Bessel functions.
    shared = bool((lens.frequency == lens.frequency[:1]).all())
    frequency = (lens.frequency[:1] if shared else lens.frequency)[..., None]
    steepest = float(scene.largest(lens.frequency.detach().abs().max()))
    radii, _ = radii_of_waves(window, 2 * steepest, order)
    corner = float(window.pitch.detach()) * reach(window)
    phase = 2 * math.pi * steepest * corner + 2 * float(scene.largest(lens.defocus.detach().abs().max()))
    rings = dft.rings_and_arms(phase, order)[0]
    dft.afford_rings("the Fourier PSF", scene, rings, phase)
    points, weights = gauss_rings(rings, 1, dtype=radii.dtype, device=radii.device)
    radius = torch.hypot(*points)
    spectrum = weights * dft.phasor(lens.defocus[..., None] * radius * radius / (2 * math.pi))
    intensities = []
    for some in radii.split(piece(32 * rings * frequency.numel())):
        J0 = dft.bessel_j0(2 * math.pi * (frequency * some)[..., None] * radius)
        real, imag = (torch.einsum("dfwkj,dfwj->dfwk", J0, part) for part in (spectrum.real, spectrum.imag))
        intensities.append(math.pi * lens.frequency[..., None] ** 2 * (real * real + imag * imag))
    intensity = torch.cat(intensities, -1)
    return light_of_radii(window, 2 * steepest, order, intensity)


def paraxial(scene: Scene) -> DefocusedPupil:
    """Defocus, edge frequency and chief ray of the paraxial lens, with the index of every wavelength."""
    lens, wavelengths, shape = scene.lens, scene.wavelengths, scene.shape
    data = first_order(lens, wavelengths)
    n = signed(lens.surfaces[1:-1], media(lens, wavelengths)[:-1])
    z_o = lens.surfaces[0].thickness + data.front_principal_plane
    z_i = lens.surfaces[-2].thickness - data.rear_principal_plane
    radius = 0.5 * first_order(lens).entrance_pupil_diameter
    waves = 1e3 * radius / wavelengths  # R/λ
    defocus = math.pi * waves * radius * (n[0] / z_o + n[-1] / z_i - data.power)
    chief = chief_ray_height(scene)
    return DefocusedPupil(defocus.expand(shape), (waves * n[-1] / z_i).expand(shape), chief.expand(2, *shape))


def _intensity(x: Tensor, y: Tensor, defocus: Tensor, frequency: Tensor, waves: Tensor | None, *, order: int) -> Tensor:
    """|U|² (Y, X) per mm² at x (X,), y (Y,) mm from the chief ray, with Noll coefficients in waves (J,) or None.

    Without them the pupil is symmetric and its rings are integrals in closed form: Σ_r w_r e^{iψ r²} J₀(2π a r ρ).
    """
    reach = math.hypot(float(x.detach().abs().max()), float(y.detach().abs().max()))
    phase = 2 * math.pi * abs(float(frequency.detach())) * reach + 2 * abs(float(defocus.detach()))
    if waves is None:
        points, weights = gauss_rings(dft.rings_and_arms(phase, order)[0], 1, dtype=x.dtype, device=x.device)
        radius = torch.hypot(*points)
        spectrum = weights * dft.phasor(defocus * radius * radius / (2 * math.pi))
        U = dft.rings_to_grid(spectrum, radius, x, y, 1 / frequency)
        return math.pi * frequency**2 * (U.real**2 + U.imag**2)
    # The largest slope of the aberrations in radians per pupil radius, on the rim and inside.
    probe, _ = with_rim(*gauss_rings(8, dtype=waves.dtype, device=waves.device))
    by_x, by_y = (waves.detach() @ g for g in polynomials.gradients(_orders(len(waves)), *probe))
    phase += 2 * math.pi * float(torch.hypot(by_x, by_y).max())
    points, weights = dft.disc_rule(phase, order, most=_MOST_POINTS, what="the Fourier model", like=x)
    path = waves @ polynomials.polynomials(_orders(len(waves)), *points)
    path = path + defocus * (points**2).sum(0) / (2 * math.pi)
    U = dft.to_grid(weights * dft.phasor(path), -points[0], -points[1], x, y, 1 / frequency)
    return math.pi * frequency**2 * (U.real**2 + U.imag**2)


def _moments(lens: DefocusedPupil, waves: Tensor | None) -> tuple[Tensor, Tensor]:
    """Centroid (2, D, F, W) from the chief ray and covariance (3, D, F, W), mm and mm², of the geometric limit."""
    # Light of path W(p) waves lands at x = ∇W/a: a disc of radius |ψ|/(π a), variance radius²/4 on each axis.
    if waves is None:
        variance = 0.25 * (lens.defocus / (math.pi * lens.frequency)) ** 2
        return torch.zeros_like(lens.chief), torch.stack([variance, torch.zeros_like(variance), variance])
    points, weights = gauss_rings(16, dtype=waves.dtype, device=waves.device)
    slopes = polynomials.gradients(_orders(len(waves)), *points)
    x, y = (
        (torch.einsum("j...,jp->...p", waves, g) + (lens.defocus / math.pi)[..., None] * p) / lens.frequency[..., None]
        for g, p in zip(slopes, points, strict=True)
    )
    return centroid_and_covariance(x, y, weights)


def _orders(count: int) -> list[tuple[int, int]]:
    return [polynomials.noll(j) for j in range(1, count + 1)]
