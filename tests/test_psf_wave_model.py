"""The wave model against exact diffraction, the three ways to sum waves, and the rays it comes from."""

import math

import problems
import pytest
import torch
from differences import gradcheck
from problems import scene_of, vector

from raytrace.maths.sampling import gauss_rings, grid
from raytrace.psf_models import wave
from raytrace.psf_models.dft import huygens, phasor, to_grid, to_grid_mirrored
from raytrace.psf_models.strehl import strehl
from raytrace.system.lens import with_sensor_distance
from raytrace.system.surface import Aperture
from raytrace.tracing.wavefront import rms, wavefront_of, without


def stigmatic(diameter=0.5, focus=50.0, **others):
    """Its Airy pattern holds to NA² = (diameter/2 focus)²."""
    return problems.plano_hyperbolic(diameter=diameter, focus=focus, **others)


def gauss(sensor=57.8817685, **others):
    return with_sensor_distance(problems.double_gauss(**others), torch.as_tensor(sensor, dtype=torch.float64))


def chief(s):
    return wavefront_of(s, torch.zeros(2, 1, dtype=torch.float64)).centre[:2].detach()


def test_airy_disc():
    """Profile within 5e-5 of the peak, first dark ring within 0.1 % of 0.6098 λ/NA."""
    lens = stigmatic()
    scale = 0.55e-3 * 50.0 / 0.5
    light = wave.waves(scene_of(lens), 3 * scale, order=1)

    def intensity(x, y):
        U = wave.amplitude(light, x, y)[0, 0, 0]
        return U.real**2 + U.imag**2

    peak = intensity(vector(0.0), vector(0.0))[0, 0]
    assert abs(peak / (math.pi * 0.25**2 / (0.55e-3 * 50) ** 2) - 1) < 1e-4
    v = torch.linspace(0.1, 9.0, 30, dtype=torch.float64)
    expected = (2 * torch.special.bessel_j1(v) / v) ** 2
    assert (intensity(v / math.pi * scale, vector(0.0))[0] / peak - expected).abs().max() < 5e-5
    zero = 1.2196699 * scale
    steps = torch.linspace(0.998, 1.002, 41, dtype=torch.float64)
    darkest = steps[intensity(zero * steps, vector(0.0))[0].argmin()]
    assert abs(darkest - 1) < 1e-3


def test_three_ways_to_sum_waves_agree():
    """FFT, matrix DFT and direct Huygens sum on a far sphere, of one square-sampled pupil with 0.3 waves of coma."""
    N, pad, wavelength, radius = (
        24,
        2,
        torch.tensor(0.55e-3, dtype=torch.float64),
        torch.tensor(1e9, dtype=torch.float64),
    )
    line = (torch.arange(N, dtype=torch.float64) - (N - 1) / 2) * (2 / N)
    y, x = (a.flatten() for a in torch.meshgrid(line, line, indexing="ij"))
    A = (x * x + y * y <= 1).double()
    W = 0.3 * (3 * (x * x + y * y) - 2) * y + 1e6
    transform = torch.fft.fft2((A * phasor(W)).reshape(N, N), s=(pad * N, pad * N))
    psf = (transform.real**2 + transform.imag**2) / A.sum() ** 2
    NA = 0.05
    pitch = wavelength * N / (pad * N * 2 * NA)  # image step of one frequency of the FFT
    u = torch.arange(5, dtype=torch.float64)
    # A wave from pupil point p travels towards -p: the FFT's kernel exp(-2πi) has L = -NA x.
    L, M = -NA * x, -NA * y
    U = to_grid(A * phasor(W), L, M, u * pitch, u * pitch, wavelength)
    intensity = (U.real**2 + U.imag**2) / A.sum() ** 2
    assert (intensity - psf[:5, :5]).abs().max() < 1e-12
    q = radius * torch.stack([NA * x, NA * y, -torch.sqrt(1 - NA**2 * (x * x + y * y))])
    v, h = (a.flatten() * pitch for a in torch.meshgrid(u, u, indexing="ij"))
    direct = huygens(torch.stack([h, v, 0 * h]), q, radius, path=W * wavelength, amplitude=A, wavelength=wavelength)
    assert ((direct.real**2 + direct.imag**2) / A.sum() ** 2 - intensity.flatten()).abs().max() < 1e-9


def test_traced_wave_agrees_with_the_huygens_sum_from_the_exit_pupil():
    """10° off axis, every ray a wavelet on the reference sphere: the difference is what `residual` announces."""
    s = scene_of(gauss(), 10.0, 25e3)
    light = wave.waves(s, 0.04)
    front = light.wavefront
    x, y = torch.linspace(-0.02, 0.02, 5, dtype=torch.float64), torch.linspace(-0.03, 0.03, 5, dtype=torch.float64)
    U = wave.amplitude(light, x, y)[0, 0, 0].flatten()
    both = [torch.cat([t, t * sign]) for t, sign in zip(front.direction[:, 0, 0, 0], (-1, 1, 1), strict=True)]
    q = -front.radius[0, 0, 0] * torch.stack(both)
    v, h = (a.flatten() for a in torch.meshgrid(y, x, indexing="ij"))
    path, amplitude = front.opd[0, 0, 0].repeat(2), 0.5 * light.amplitude[0, 0, 0].repeat(2)
    wavelength = 1e-3 * front.wavelength[0]
    points = torch.stack([h, v, 0 * h])
    direct = (
        huygens(points, q, front.radius[0, 0, 0], path=path, amplitude=amplitude, wavelength=wavelength) / wavelength
    )
    ours, reference = (a.real**2 + a.imag**2 for a in (U, direct))
    residual = wave.kernels(s, grid(0.005, 11, chief(s))).residual[0, 0, 0]
    assert (ours - reference).abs().sum() / reference.sum() < residual < 0.01


def test_mirrored_waves_are_the_full_sum():
    s = scene_of(gauss(), 7.0, 25e3)
    light = wave.waves(s, 0.01)
    front, field = light.wavefront, light.amplitude[0, 0, 0].to(torch.complex128)
    L, M, _ = front.direction[:, 0, 0, 0]
    x, y, wavelength = vector(0.0, 0.004), vector(-0.003, 0.002, 0.0), 1e-3 * front.wavelength[0]
    full = to_grid(torch.cat([field, field]), torch.cat([L, -L]), torch.cat([M, M]), x, y, wavelength)
    assert (to_grid_mirrored(field, L, M, x, y, wavelength) - full).abs().max() < 1e-12 * field.real.sum()


@pytest.mark.parametrize("angle", [0.0, 10.0])
def test_symmetry_changes_nothing(angle):
    """A field that asks for gradients is summed over the whole pupil, one that does not over a part of it."""
    s = scene_of(gauss(), angle, 25e3)
    window = grid(0.005, 3, chief(s))
    part = wave.kernels(s, window)
    s.fields.requires_grad_()
    whole = wave.kernels(s, window)
    assert part.rays < whole.rays
    assert (part.kernel - whole.kernel.detach()).abs().max() < 1e-4 * part.kernel.max()
    assert (part.covariance - whole.covariance.detach()).abs().max() < 1e-10


def test_orders_converge():
    s = scene_of(gauss(), 10.0, 1e4)
    window = grid(0.005, 9, chief(s))
    computed = [wave.kernels(s, window, order=order).kernel for order in range(4)]
    errors = [((k - computed[3]).abs().sum() / computed[3].sum()).item() for k in computed[:3]]
    assert errors[0] < 1e-3
    assert errors[1] < 0.3 * errors[0]
    assert errors[2] < 0.3 * errors[1]


@pytest.mark.parametrize("angle", [0.0, 10.0])
def test_energy_is_the_transmitted_fraction(angle):
    """A window far wider than the blur holds all that is not blocked but the rings' tail, 2/(π v) = 0.8 %."""
    s = scene_of(gauss(57.9, aperture=("entrance_pupil_diameter", 12.0)), angle, 25e3)
    result = wave.kernels(s, grid(0.02, 11, chief(s)))
    assert 0 < 1 - result.kernel.sum() < 9e-3
    lens = gauss(57.9, aperture=("entrance_pupil_diameter", 12.0))
    surfaces = list(lens.surfaces)
    clip = Aperture("circular", (0.0, 2.9), centre=(0.0, 0.7))
    surfaces[6] = problems.surface(None, 12.4281, apertures=(clip,))
    s = scene_of(
        type(lens)(**{**{f: getattr(lens, f) for f in lens.__slots__}, "surfaces": tuple(surfaces)}), angle, 25e3
    )
    result = wave.kernels(s, grid(0.02, 11, chief(s)))
    points, weights = gauss_rings(60, 240)
    passed = wavefront_of(s, points, weights).energy.sum()
    assert 0.3 < passed < 0.8
    assert abs(result.kernel.sum() - passed) < 0.015


@pytest.mark.parametrize("diameter", [6.0, 10.0])
def test_strehl_is_marechals_for_small_aberrations(diameter):
    """exp(-(2πσ)²) with σ the RMS OPD without tilt, off axis; 1 % of the loss and more at larger loss."""
    s = scene_of(gauss(57.6, aperture=("entrance_pupil_diameter", diameter)), 5.0, 25e3)
    points, weights = gauss_rings(12)
    front = wavefront_of(s, points, weights)
    opd = without(front, 3)
    sigma = torch.sqrt((weights * opd**2).sum(-1)) / 0.53e-3
    expected = torch.exp(-((2 * math.pi * sigma) ** 2))
    computed = strehl(s)
    assert 0.1 < expected < 0.99
    assert abs(computed - expected) < 0.1 * (1 - expected) ** 1.5
    assert rms(front) > 0


def test_geometric_limit():
    """16 waves out of focus the wave's encircled energy is the rays' within 2 %; its rays have their covariance."""
    s = scene_of(gauss(59.5, aperture=("entrance_pupil_diameter", 20.0)), 0.0, 25e3)
    front = wavefront_of(s, *gauss_rings(200, 4))
    rays = torch.linalg.vector_norm(front.landing[:, 0, 0, 0], dim=0)
    pitch = float(rays.max()) / 35
    result = wave.kernels(s, grid(pitch, 81))
    line = (torch.arange(81, dtype=torch.float64) - 40) * pitch
    distance = torch.hypot(line[:, None], line)
    for radius in (0.3, 0.5, 0.7, 0.8):
        encircled = result.kernel[0, 0, 0][distance < radius * rays.max()].sum()
        assert abs(encircled - front.energy[0, 0, 0][rays < radius * rays.max()].sum()) < 0.02
    assert abs(result.ray_covariance[0, 0, 0, 0] - 0.5 * (front.energy[0, 0, 0] * rays**2).sum()) < 1e-9


def test_longer_paths_at_the_top_move_the_light_up():
    s = scene_of(gauss(57.6, aperture=("entrance_pupil_diameter", 5.0)), 5.0, 25e3)
    window = grid(0.003, 21, chief(s))
    light = wave.waves(s, 0.05)
    y = torch.linspace(-0.03, 0.03, 61, dtype=torch.float64)

    def top(opd):
        front = light.wavefront
        tilted = type(front)(**{**{f: getattr(front, f) for f in front.__slots__}, "opd": opd})
        U = wave.amplitude(wave.Waves(light.amplitude, tilted, light.symmetry), vector(0.0), y)
        return y[(U.real**2 + U.imag**2)[0, 0, 0, :, 0].argmax()]

    front = light.wavefront
    assert top(front.opd + 1e-3 * front.pupil[1]) > top(front.opd) + 0.015
    kernel = wave.kernels(s, window).kernel[0, 0, 0]
    assert kernel.sum() > 0.9


def test_scaling_law():
    """Twice the lens, the wavelength and the pixel: the same kernel."""
    one = wave.kernels(scene_of(stigmatic(4.0), 1.0), grid(2e-3, 5, vector(0.0, 0.87)))
    twice = stigmatic(8.0, 100.0, wavelengths=(1.1,))
    twice = twice.replace(1, thickness=20.0)
    two = wave.kernels(scene_of(twice, 1.0), grid(4e-3, 5, vector(0.0, 1.74)))
    assert one.kernel.sum() > 0.01
    assert (one.kernel - two.kernel).abs().max() < 1e-9 * one.kernel.max()


@pytest.mark.slow
def test_a_blocked_pupil_gives_zero_energy_and_no_nan():
    lens = gauss(aperture=("entrance_pupil_diameter", 10.0))
    surfaces = list(lens.surfaces)
    thickness = torch.tensor(12.4281, dtype=torch.float64, requires_grad=True)
    surfaces[6] = problems.surface(None, thickness, apertures=(Aperture("circular", (90.0, 99.0)),))
    lens = type(lens)(**{**{f: getattr(lens, f) for f in lens.__slots__}, "surfaces": tuple(surfaces)})
    for angle in (0.0, 5.0):
        s = scene_of(lens, angle, 25e3)
        result = wave.kernels(s, grid(0.005, 3, chief(s)))
        total = result.kernel.sum() + result.centroid.sum() + result.covariance.sum()
        assert result.kernel.abs().max() == 0
        (gradient,) = torch.autograd.grad(total, thickness)
        assert torch.isfinite(gradient)
    assert strehl(scene_of(lens, 5.0, 25e3)).abs().max() == 0


def test_a_window_far_from_the_light_is_refused():
    with pytest.raises(ValueError, match="Centre the window"):
        wave.kernels(scene_of(gauss(), 10.0, 25e3), grid(0.005, 5))


@pytest.mark.slow
@pytest.mark.parametrize(("angle", "rim"), [(0.0, None), (0.0, 0.9), (4.0, 0.9)])
def test_gradients(angle, rim):
    """Curvature, sensor distance and pixel, with and without vignetted rays; a rim moves with the lens."""
    apertures = () if rim is None else (Aperture("circular", (0.0, rim)),)

    def kernel(curvature, sensor, pitch):
        surfaces = [
            problems.surface(curvature, 3.0, 1.5),
            problems.surface(-0.01, 4.0),
            problems.surface(None, sensor, apertures=apertures),
        ]
        lens = problems.lens(surfaces, stop=1, aperture=("entrance_pupil_diameter", 2.0))
        return wave.kernels(scene_of(lens, angle), grid(pitch, 3, vector(0.0, centre))).kernel

    start = [torch.tensor(t, dtype=torch.float64, requires_grad=True) for t in (0.02, 56.0, 0.01)]
    lens = problems.lens(
        [problems.surface(0.02, 3.0, 1.5), problems.surface(-0.01, 4.0), problems.surface(None, 56.0)],
        aperture=("entrance_pupil_diameter", 2.0),
    )
    centre = float(chief(scene_of(lens, angle))[1])
    assert gradcheck(kernel, start, eps=1e-6, atol=2e-4, rtol=2e-3, fast_mode=True)
