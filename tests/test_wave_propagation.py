"""Diffraction behind a thin element against exact answers, and the engines against each other."""

import dataclasses
import math

import numpy as np
import pytest
import rayleigh
import torch
from problems import scalar, vector
from problems_waves import PLASTIC, R, Z, lens, relative, scene

from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import constant, index
from raytrace.maths.sampling import grid
from raytrace.psf_models.dft import bessel_j1, integrate
from raytrace.wave_optics import propagation, pupil
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.element import Element, EvenPowers, Pixels, Rings, Zernike
from raytrace.wave_optics.scene import WaveScene, excess

WAVELENGTHS = (0.46, 0.55, 0.64)


def density(s, x, y, samples=256):
    """Light per mm² (D, W, K) at points, by the pupil engine."""
    result = []
    for a, b in zip(x, y, strict=True):
        point = dataclasses.replace(s, grid=grid(scalar(1e-9), 1, torch.stack([a, b])))
        result.append(pupil.intensity(point, pupil.prepare(point, samples, 1))[..., 0, 0])
    return torch.stack(result, -1)


def along_x(s, x, samples=256):
    """The same (D, W, X) on the x axis: one row of pixels, taken at their middles."""
    sums = pupil.prepare(dataclasses.replace(s, grid=grid(scalar(1e-9), (1, 1))), samples, 1)
    wavelength = 1e-3 * s.wavelengths
    r2 = sums.x[0] ** 2 + sums.y[0] ** 2
    t = sums.x[0] / torch.sqrt(r2 * s.exact + s.sensor_distance**2)
    across = pupil.waves_at(torch.zeros(1, dtype=x.dtype), t, wavelength)
    unfolded = pupil.ToPixels(pupil.waves_at(x, t, wavelength), across, sums.to_pixels.pixel)
    return pupil.intensity(s, dataclasses.replace(sums, to_pixels=unfolded))[..., 0, :]


@pytest.mark.parametrize("exact", [False, True])
def test_airy_pattern_of_every_wavelength(exact):
    """Profile to 5e-5 of the peak, first dark ring to 0.1 %, peak (πR²/λz)²/(πR²) to 1e-4 (paraxially)."""
    s = scene(wavelengths=WAVELENGTHS, exact=exact)
    sine = R / math.sqrt(R * R + Z * Z) if exact else R / Z
    for k, wavelength in enumerate(WAVELENGTHS):
        v = torch.linspace(0.05, 12, 60, dtype=torch.float64)
        x = torch.cat([vector(0.0), v * 1e-3 * wavelength / (2 * math.pi * sine)])
        light = along_x(s, x)[0, k]
        if not exact:
            assert abs(light[0] / (math.pi * R**2 / (1e-3 * wavelength * Z) ** 2) - 1) < 1e-4
            assert (light[1:] / light[0] - (2 * bessel_j1(v) / v) ** 2).abs().max() < 5e-5
        else:  # a few per mille of apodisation
            assert (light[1:] / light[0] - (2 * bessel_j1(v) / v) ** 2).abs().max() < 1e-3
        zero = 0.6098350 * 1e-3 * wavelength / sine
        steps = torch.linspace(0.997, 1.003, 61, dtype=torch.float64)
        assert abs(steps[along_x(s, zero * steps)[0, k].argmin()] - 1) < 1.1e-3 + 0.001 * exact


def test_axis_of_a_defocused_lens():
    """sinc²(W) for W waves at the rim, of either sign, through its zeros at 1, 2, 3, however many cells."""
    waves = torch.tensor([0.0, 0.3, -0.3, 1.0, -1.0, 1.7, 2.0, 2.6, 3.0], dtype=torch.float64)
    for k, w in enumerate(waves):
        s = scene(lens(extra=w * 0.55e-3))
        expected = torch.sinc(w) ** 2 * math.pi * R**2 / (0.55e-3 * Z) ** 2
        for samples in (128, 200):
            result = density(s, vector(0.0), vector(0.0), samples)[0, 0, 0]
            assert abs(result - expected) < 2e-4 * math.pi * R**2 / (0.55e-3 * Z) ** 2, (k, samples)


def test_encircled_energy():
    """1 - J₀² - J₁² in a radius (Rayleigh 1881), of the light per mm² along the radius."""
    s = scene()
    edge = 2 * math.pi * R / (0.55e-3 * Z)
    place, share = (torch.as_tensor(a) for a in np.polynomial.legendre.leggauss(60))
    for v in (1.0, 3.8317, 7.0, 20.0):
        rho = 0.5 * v / edge * (1 + place)
        light = along_x(s, rho)[0, 0]
        result = (light * 2 * math.pi * rho * share).sum() * 0.5 * v / edge
        j0, j1 = torch.special.bessel_j0(scalar(v)), torch.special.bessel_j1(scalar(v))
        assert abs(result - (1 - j0**2 - j1**2)) < 1e-3


def test_transfer_functions_keep_energy():
    """Parseval, to rounding."""
    generator = torch.Generator().manual_seed(0)
    field = torch.complex(*torch.randn(2, 64, 64, generator=generator, dtype=torch.float64))
    for spectrum in (False, True):
        sent = propagation.propagate(
            field, scalar(2e-3), scalar(20.0), scalar(0.55e-3), size=96, band_limit=False, spectrum=spectrum
        )
        assert abs((sent.abs() ** 2).sum() / (field.abs() ** 2).sum() - 1) < 1e-12


def test_focus_lies_where_the_lens_equation_puts_it():
    """f(λ) = f₀ (n₀ - 1)/(n - 1): the source that is brightest on the axis obeys 1/z' + 1/z = 1/f for each colour."""
    glass = find_glass("PMMA")
    n = index(glass, vector(*WAVELENGTHS))
    power = 1 / 800.0 + 1 / Z
    element = Element(EvenPowers(vector(-0.5 * power) / (n[1] - 1)), scalar(R), glass)
    for k, wavelength in enumerate(WAVELENGTHS):
        vergence = power * (n[k] - 1) / (n[1] - 1) - 1 / Z
        # 2e-5/mm is 0.11 waves at the rim: steps of 3e-7/mm in vergence find the top to 2e-6/mm.
        offsets = torch.linspace(-3e-5, 3e-5, 201, dtype=torch.float64)
        usable = vergence + offsets > 0
        s = scene(element, depths=(1 / (vergence + offsets[usable])).tolist(), wavelengths=(wavelength,))
        light = density(s, vector(0.0), vector(0.0), 64)[:, 0, 0]
        best = offsets[usable][light.argmax()]
        if vergence > 3e-5:
            assert abs(best) < 2e-6


def test_kinoform_focuses_as_the_wavelength():
    """A lens wrapped at λ₀ has at λ the focal length f₀ λ₀/λ, and sinc²(λ₀/λ - 1) of the light for n constant."""
    element = dataclasses.replace(lens(math.inf), period=scalar(0.55e-3))
    for wavelength in (0.5, 0.6):
        distance = Z * 0.55 / wavelength
        s = dataclasses.replace(
            scene(element, depths=(math.inf,), wavelengths=(wavelength,)), sensor_distance=scalar(distance)
        )
        result = propagation.radial_field(s, vector(0.0), 4).abs().square()[0, 0, 0]
        full = math.pi * R**2 / (1e-3 * wavelength * distance) ** 2
        assert abs(result / full - torch.sinc(scalar(0.55 / wavelength - 1)) ** 2) < 2e-3


@pytest.mark.parametrize(("depth", "tolerance"), [(1000.0, 5e-5), (500.0, 1e-3), (math.inf, 1e-3)])
def test_three_engines_agree_on_a_round_lens(depth, tolerance):
    """5e-5 in focus, 1e-3 blurred; the transfer function on an eighth of the aperture's area, to be quick."""
    s = dataclasses.replace(scene(lens(radius=0.9), depths=(depth,), size=32), sensor_distance=scalar(Z))
    expected = psf(s, tol=1e-6).kernel
    assert relative(psf(s, engine="pupil", samples=300, nodes=5).kernel, expected) < tolerance
    assert relative(psf(s, engine="fresnel", samples=720, nodes=5).kernel, expected) < tolerance
    exact = dataclasses.replace(s, elements=(lens(radius=0.9, exact=True),), exact=True)
    expected = psf(exact, tol=1e-6).kernel
    assert relative(psf(exact, engine="pupil", samples=300, nodes=5).kernel, expected) < tolerance
    assert relative(psf(exact, engine="angular_spectrum", samples=720, nodes=5).kernel, expected) < 2 * tolerance


@pytest.mark.parametrize("exact", [False, True])
def test_engines_agree_on_any_element(exact):
    """Coma, astigmatism and trefoil of both signs, through which every quadrant differs; off-centre windows too."""
    coefficients = vector(0, 0, 0, 0, 2e-4, -1.5e-4, 2e-4, 1e-4, -1e-4, 5e-5, 5e-5)
    aberrated = (lens(exact=exact, radius=0.9), Element(Zernike(coefficients), scalar(0.9), PLASTIC))
    s = scene(*aberrated, size=(28, 32), exact=exact)
    result = psf(s, engine="pupil", samples=200, nodes=5).kernel
    engine = "angular_spectrum" if exact else "fresnel"
    assert relative(result, psf(s, engine=engine, samples=720, nodes=5).kernel) < 2e-4
    assert relative(result.flip(-1), result) > 0.1
    assert relative(result.flip(-2), result) > 0.1
    part = scene(*aberrated, size=(10, 12), centre=(0.00369 * 6, -0.00369 * 4), exact=exact)
    assert relative(psf(part, engine="pupil", samples=200, nodes=5).kernel, result[..., 5:15, 16:28]) < 1e-6


@pytest.mark.parametrize("depth", [1000.0, 700.0])
def test_rayleigh_and_sommerfeld_at_fifty_points(depth):
    """The direct sum, true spheres: 1e-3 of the peak."""
    coefficients = vector(0, 0, 0, 0, 1e-4, 1e-4, 1e-4, -5e-5)
    s = scene(lens(exact=True), Element(Zernike(coefficients), scalar(R), PLASTIC), depths=(depth,), exact=True)
    x, y = (torch.rand(2, 50, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5) * 0.06
    expected = rayleigh.field(s, x, y, rings=60, arms=160).abs().square()
    assert ((density(s, x, y, 160) - expected).abs().max() / expected.max()) < 1e-3


@pytest.mark.parametrize("j", range(4, 12))
def test_strehl_ratio_of_each_aberration(j):
    """Maréchal: exp(-(2πσ)²) to 1e-3 for σ = 0.02 and 0.05 waves (the next term, of fourth order, is smaller)."""
    for sigma in (0.02, 0.05):
        coefficients = torch.zeros(j, dtype=torch.float64)
        coefficients[j - 1] = sigma * 0.55e-3
        light = [
            density(scene(lens(), *extra), vector(0.0), vector(0.0), 128)
            for extra in ((), (Element(Zernike(coefficients), scalar(R), PLASTIC),))
        ]
        expected = math.exp(-((2 * math.pi * sigma) ** 2))
        tolerance = 1e-3 + (2 * math.pi * sigma) ** 3 * (0.08 if j in (4, 11) else 0.02)
        assert abs(light[1] / light[0] - expected) < tolerance


@pytest.mark.parametrize("levels", [2, 4, 8, 16])
def test_efficiency_of_a_stepped_kinoform(levels):
    """sinc²(1/L) of the light reaches the focus of 160 whole zones (Goodman and Silvestri 1970)."""
    radius = math.sqrt(2 * 160 * 0.55e-3 / (1 / 1000 + 1 / Z))
    element = dataclasses.replace(lens(radius=radius), period=scalar(0.55e-3), levels=levels)
    result = propagation.radial_field(scene(element), vector(0.0), 8).abs().square()[0, 0, 0]
    assert abs(result / (math.pi * radius**2 / (0.55e-3 * Z) ** 2) - torch.sinc(scalar(1 / levels)) ** 2) < 1e-9


def test_flat_pixels_are_summed_exactly():
    """A map of pixels as coarse as the wave at the rim is steep, against the same map cut into 16 × 16 cells each."""
    generator = torch.Generator().manual_seed(2)
    heights = 1e-3 * torch.rand(24, 24, generator=generator, dtype=torch.float64)
    plate = Element(Pixels(heights, scalar(0.05)), scalar(0.6), PLASTIC)
    flat = Element(EvenPowers(vector(0.0)), scalar(0.6), PLASTIC)
    for centre in ((0.0, 0.0), (0.02, -0.01)):
        s = scene(plate, depths=(500.0, math.inf), centre=centre)
        fine = psf(dataclasses.replace(s, elements=(plate, flat)), samples=24 * 24, nodes=4)
        assert fine.plan.cells == "sampled"
        result = psf(s, samples=24 * 24, nodes=4)
        assert result.plan.cells == "flat"
        assert relative(result.kernel, fine.kernel) < 4e-3
        # Fewer parts err by the edge of the aperture alone.
        coarse = psf(s, samples=24 * 10, nodes=4)
        assert relative(coarse.kernel, result.kernel) < 2 * coarse.error


def test_rings_and_pixels_of_one_shape():
    """A ring element by the radial engine, and as the pixels that it covers: alike as the staircase of its rings."""
    rings = Element(Rings(vector(0.0, 2.75e-4, 1e-4, 3e-4), scalar(0.125)), scalar(0.5), PLASTIC)
    centres = (torch.arange(400, dtype=torch.float64) - 199.5) * 0.0025
    r = torch.hypot(centres, centres[:, None])
    heights = rings.profile.heights[(r / 0.125).long().clamp(max=3)]
    pixels = Element(Pixels(heights, scalar(0.0025)), scalar(0.5), PLASTIC)
    ring, pixel = (psf(scene(e), samples=n) for e, n in ((rings, 60), (pixels, 400)))
    assert (ring.engine, pixel.engine) == ("radial", "pupil")
    assert relative(pixel.kernel, ring.kernel) < 4e-3


def test_excess_keeps_its_digits():
    """√(r² + z²) - z against the series, for near, far and infinite points."""
    r2 = vector(0.0, 1.0, 6.25)
    assert (excess(r2, scalar(0.0)) == 0).all()
    for z in (10.0, 1e4, 1e6):
        series = r2 / (2 * z) * (1 - r2 / (4 * z * z) * (1 - r2 / (2 * z * z)))
        assert torch.allclose(excess(r2, scalar(1 / z)), series, rtol=1e-4 if z < 100 else 1e-13, atol=0)


def test_interpolation_of_the_transfer_functions_field():
    """A wave of 60 % of the sampling limit between its samples, to 1e-6."""
    place = (torch.arange(200, dtype=torch.float64) - 99.5) * 0.002
    wave = torch.polar(torch.ones_like(place), 2 * math.pi * 150.0 * place)
    u = torch.linspace(-0.05, 0.05, 37, dtype=torch.float64)
    result = propagation.at_nodes(wave * wave[:, None], scalar(0.002), u, u)
    expected = torch.polar(torch.ones_like(u), 2 * math.pi * 150.0 * u)
    assert (result - expected * expected[:, None]).abs().max() < 1e-6


def test_integrals_over_pixels_add_up():
    """The pixels of a window hold the light of one pixel as large."""
    fine, coarse = scene(size=24, pitch=0.002), scene(size=1, pitch=0.048)
    total = psf(fine, tol=1e-6).energy
    sums = pupil.prepare(coarse, 256, 48)
    assert torch.allclose(
        total,
        integrate(pupil.intensity(coarse, sums), sums.to_pixels.pixel, coarse.grid.pitch).sum((-2, -1)),
        atol=1e-4,
    )


@pytest.mark.parametrize(("waves", "share"), [(0.5, [0.0, 4 / math.pi**2, 0.0, 4 / (9 * math.pi**2)]), (0.25, None)])
def test_orders_of_a_grating_of_two_levels(waves, share):
    """Ten periods of two levels, a lens behind: order m gets sinc²(m/2) sin²(π w) times what the lens alone has there.

    The orders lie λz/p = 0.1375 mm apart, eight times the Airy radius; light of one in the box of another is below 1 %.
    """
    radius, z, wavelength, period = 0.5, 25.0, 0.55, 0.1
    steps = torch.arange(20) % 2
    heights = (1e-3 * wavelength * waves) * steps.double().expand(20, 20)
    glass = constant(2.0)
    lens = Element(EvenPowers(vector(-0.5 / z)), scalar(radius), glass)
    grating = Element(Pixels(heights, scalar(0.5 * period)), scalar(radius), glass)
    apart = 1e-3 * wavelength * z / period

    def energy(elements, order):
        pixels = grid(scalar(apart / 5), 5, vector(order * apart, 0.0))
        own = WaveScene(elements, scalar(z), vector(math.inf), vector(wavelength), pixels)
        return float(psf(own, engine="pupil", samples=400).energy)

    alone = energy((lens,), 0)
    for order in range(4):
        law = np.sinc(order / 2) ** 2 * math.sin(math.pi * waves) ** 2 if order else math.cos(math.pi * waves) ** 2
        if share is not None:
            assert law == pytest.approx(share[order], abs=1e-12)
        assert energy((lens, grating), order) / alone == pytest.approx(law, abs=0.01)
