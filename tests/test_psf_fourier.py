"""The Fourier model against closed forms: Airy, sinc², encircled energy, Maréchal, the thin lens."""

import math

import problems
import pytest
import torch
from differences import gradcheck
from problems import vector

from raytrace.maths.sampling import grid
from raytrace.psf_models import fourier
from raytrace.system.lens import with_sensor_distance
from raytrace.tracing.paraxial import first_order, paraxial_image_distance
from raytrace.tracing.scene import scene
from raytrace.tracing.wavefront import wavefront_of

WAVE = 0.53e-3  # mm


def scene_of(sensor, y=0.0, distance=25e3, **others):
    lens = with_sensor_distance(problems.double_gauss(**others), torch.as_tensor(sensor, dtype=torch.float64))
    return scene(lens, vector(0.0, y)[:, None], vector(distance), lens.wavelengths)


def in_focus(distance=25e3, **others):
    sensor = paraxial_image_distance(problems.double_gauss(), vector(distance))[0]
    return scene_of(sensor, distance=distance, **others)


def point(s, x=0.0, y=0.0, **others):
    """Intensity per mm² at a point: a pixel of 1 nm."""
    window = grid(problems.NANOMETRE, 1, vector(x, y))
    return fourier.kernels(s, window, order=1, **others).kernel[0, 0, 0, 0, 0] / problems.NANOMETRE**2


def frequency(s):
    return fourier.paraxial(s).frequency[0, 0, 0]


def zernike(j, rms):
    return torch.nn.functional.one_hot(torch.tensor(j - 1), max(j, 4)).double() * rms * WAVE


@pytest.mark.parametrize("with_zernike", [False, True])
def test_airy_disc(with_zernike):
    """Peak π a², profile within 5e-5 of it, first dark ring within 0.1 % of 1.2197 λ z/D, by rings or matrix DFT."""
    s = in_focus()
    options = {"zernike": zernike(1, 0.3)} if with_zernike else {}
    a = frequency(s)
    peak = point(s, **options)
    assert abs(peak / (math.pi * a**2) - 1) < 1e-6
    for v in (0.3, 1.0, 2.0, 3.0, 4.5, 7.0, 12.0):
        r = v / (2 * math.pi * a)
        expected = (2 * torch.special.bessel_j1(vector(v)) / v) ** 2
        assert abs(point(s, 0.6 * r, 0.8 * r, **options) / peak - expected[0]) < 5e-5
    z = s.lens.surfaces[-2].thickness - first_order(s.lens).rear_principal_plane
    zero = 1.2196699 * WAVE * z / 33.33
    around = [point(s, float(zero) * t, **options) for t in (0.999, 1.0, 1.001)]
    assert around[1] < around[0]
    assert around[1] < around[2]


def test_defocus_on_axis_is_sinc_squared():
    """|∫₀¹ exp(iψu) du|² = sinc²(ψ/2), zeros at whole waves; ψ from the thin lens formula."""
    for waves in (0.0, 0.25, 0.5, 1.0, 1.7, 2.0, 3.0):
        sensor = in_focus().lens.surfaces[-2].thickness
        z = sensor - first_order(problems.double_gauss()).rear_principal_plane
        s = scene_of(sensor + (1 / (1 / z - 2 * waves * WAVE / (33.33 / 2) ** 2) - z))
        assert abs(fourier.paraxial(s).defocus[0, 0, 0].abs() / (2 * math.pi) - waves) < 1e-6
        expected = torch.sinc(vector(waves))[0] ** 2
        assert abs(point(s) / (math.pi * frequency(s) ** 2) - expected) < 2e-4


def test_defocus_of_the_double_gauss_at_10_metres():
    """R²/2λ (1/10 m - 1/35 m) = 18.7 waves at F/3 on a sensor at the paraxial focus of 35 m, and less."""
    defocus = fourier.paraxial(scene_of(in_focus(35e3).lens.surfaces[-2].thickness, distance=1e4)).defocus
    assert abs(defocus / (2 * math.pi) - 18.6).max() < 0.2


def test_encircled_energy():
    """1 - J₀² - J₁² inside radius v, by pixels of 1/20 of it: 1e-3 of the light lies in the pixels of the edge."""
    s = in_focus()
    a = frequency(s)
    for v in (3.8317, 7.0156, 10.0):
        radius = v / (2 * math.pi * float(a))
        pitch, size = radius / 40, 85
        kernel = fourier.kernels(s, grid(pitch, size)).kernel[0, 0, 0]
        line = (torch.arange(size, dtype=torch.float64) - 42) * pitch
        fine = (line[:, None] + torch.linspace(-0.45, 0.45, 10, dtype=torch.float64) * pitch).flatten()
        inside = (fine[:, None] ** 2 + fine**2 < radius**2).double()
        share = inside.unflatten(0, (size, 10)).unflatten(2, (size, 10)).mean((1, 3))
        J0, J1 = torch.special.bessel_j0(vector(v)), torch.special.bessel_j1(vector(v))
        assert abs((kernel * share).sum() - (1 - J0**2 - J1**2)[0]) < 1e-3


@pytest.mark.parametrize("waves", [None, 5.0])
def test_parseval(waves):
    """All the light of the pupil falls on the sensor: a window of radius v misses about 2/(π v) of it."""
    s = in_focus() if waves is None else scene_of(in_focus().lens.surfaces[-2].thickness + 0.15)
    reach = 0.06
    energy = fourier.kernels(s, grid(2 * reach / 15, 15)).kernel.sum()
    v = 2 * math.pi * frequency(s) * reach
    assert 1 - 2 * 2 / (math.pi * v) < energy < 1


@pytest.mark.parametrize("j", range(4, 16))
@pytest.mark.parametrize("sigma", [0.02, 0.05])
def test_strehl_is_marechals(j, sigma):
    s = in_focus()
    computed = point(s, zernike=zernike(j, sigma)) / (math.pi * frequency(s) ** 2)
    assert abs(computed - math.exp(-((2 * math.pi * sigma) ** 2))) < 1e-3


def test_zero_aberrations_change_nothing():
    s = scene_of(57.95, 0.0)
    window = grid(0.005, 7, vector(0.002, -0.001))
    rings = fourier.kernels(s, window, order=2)
    sums = fourier.kernels(s, window, order=2, zernike=zernike(1, 0.0))
    assert (rings.kernel - sums.kernel).abs().max() < 1e-6 * rings.kernel.max()
    assert (rings.ray_covariance - sums.ray_covariance).abs().max() < 1e-12
    assert (rings.covariance - sums.covariance).abs().max() < 1e-6 * rings.covariance.max()


def test_positive_tilt_moves_the_light_up():
    """W = c Z₃ = 2 c y lands at 2 c/(λ a)."""
    s = in_focus()
    coefficients = zernike(3, 3.0)
    result = fourier.kernels(s, grid(0.002, 21), zernike=coefficients)
    row = result.kernel[0, 0, 0].sum(1).argmax()
    expected = 2 * 3.0 / float(frequency(s))
    assert (float(row) - 10) * 0.002 == pytest.approx(expected, abs=0.001)
    assert float(result.ray_centroid[1]) == pytest.approx(expected, rel=1e-9)


def test_geometric_limit():
    """Ten waves out of focus, half the light is inside ε/√2 within 1 %, ε = R |1 - z_i (1/f - 1/z_o)|."""
    s = scene_of(in_focus().lens.surfaces[-2].thickness + 0.35)
    data = first_order(s.lens)
    z_i = s.lens.surfaces[-2].thickness - data.rear_principal_plane
    z_o = 25e3 + data.front_principal_plane
    blur = (33.33 / 2 * (1 - z_i * (data.power - 1 / z_o)).abs()).flatten()[0]
    result = fourier.kernels(s, grid(float(blur) / 30, 71))
    line = (torch.arange(71, dtype=torch.float64) - 35) / 30
    distance = torch.hypot(line[:, None], line)
    kernel = result.kernel[0, 0, 0]
    radii = torch.linspace(0.65, 0.76, 45, dtype=torch.float64)
    half = radii[torch.stack([(kernel[distance < r].sum() - 0.5).abs() for r in radii]).argmin()]
    assert abs(half - math.sqrt(0.5)) < 0.01
    assert result.ray_covariance[0, 0, 0, 0] == pytest.approx(float(blur) ** 2 / 4, rel=1e-9)


@pytest.mark.parametrize("distance", [25e3, math.inf])
def test_chief_ray_is_that_of_a_narrow_real_field(distance):
    s = scene_of(57.88, 0.01, distance)
    real = wavefront_of(s, torch.zeros(2, 1, dtype=torch.float64)).centre[:2]
    assert (fourier.paraxial(s).chief - real).abs().max() < 1 * problems.NANOMETRE


def test_mirror():
    """A concave mirror of focal length 50 mm focuses plane waves at -50 mm: sharp there."""
    surfaces = [problems.surface(-0.01, -50.0, problems.MIRROR)]
    lens = problems.lens(surfaces, aperture=("entrance_pupil_diameter", 5.0))
    data = fourier.paraxial(scene(lens, vector(0.0, 0.0)[:, None], vector(math.inf), lens.wavelengths))
    assert data.defocus.abs().max() < 1e-9
    assert data.frequency[0, 0, 0] == pytest.approx(2.5 / (0.55e-3 * 50), rel=1e-12)


def test_a_window_far_from_the_light_is_refused():
    with pytest.raises(ValueError, match="Centre the window"):
        fourier.kernels(scene_of(57.88, 10.0), grid(0.005, 3), zernike=zernike(4, 0.1))


@pytest.mark.parametrize("with_zernike", [False, True])
def test_gradients(with_zernike):
    """Curvature, sensor distance, pixel and aberrations, at focus, about the chief ray."""

    def kernel(curvature, sensor, pitch, coefficients):
        surfaces = [problems.surface(curvature, 3.0, 1.5), problems.surface(-0.01, sensor)]
        lens = problems.lens(surfaces, aperture=("entrance_pupil_diameter", 4.0))
        s = scene(lens, vector(0.0, 0.0)[:, None], vector(math.inf), lens.wavelengths)
        return fourier.kernels(s, grid(pitch, 3), zernike=coefficients if with_zernike else None).kernel

    aberrations = torch.tensor([0.0, 1e-5, -2e-5, 3e-5, 1e-5], dtype=torch.float64)
    start = [torch.tensor(t, dtype=torch.float64) for t in (0.02, 66.0, 0.01)]
    start = [t.requires_grad_() for t in (*start, aberrations)]
    assert gradcheck(kernel, start, eps=1e-7, atol=1e-3, rtol=1e-3, fast_mode=True)
