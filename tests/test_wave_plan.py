"""The plan: what it chooses, that its predictions hold, and that what it refuses or warns of is indeed wrong."""

import dataclasses
import math
import warnings

import pytest
import torch
from problems import scalar, vector
from problems_waves import PLASTIC, R, lens, relative, scene

from raytrace.psf_models.dft import Aliased, integrate
from raytrace.wave_optics import pupil
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.element import Element, EvenPowers, Pixels, Zernike
from raytrace.wave_optics.plan import ENGINES, AliasedSampling, blur, plan

TILTED = Element(Zernike(vector(0, 0, 0, 0, 0, 0, 1e-4)), scalar(R), PLASTIC)


def original(**others):
    """5 mm, 35.5 mm, a lens for 1 m seen from 0.5 m in the blue, 128 pixels of 3.69 µm."""
    return scene(**{"depths": (500.0,), "wavelengths": (0.46,), "size": 128} | others)


def test_the_scene_chooses_the_engine():
    assert plan(original()).engine == "radial"
    assert plan(original(centre=(0.1, 0.0))).engine == "pupil"
    assert plan(scene(lens(), TILTED)).engine == "pupil"
    plate = Element(Pixels(torch.zeros(8, 8, dtype=torch.float64), scalar(0.1)), scalar(0.4), PLASTIC)
    assert plan(scene(plate)).cells == "flat"
    assert plan(scene(lens(radius=0.4), plate)).cells == "sampled"
    assert plan(scene(plate, exact=True), tol=1e-2).cells == "sampled"
    with pytest.raises(ValueError, match="round elements"):
        plan(scene(lens(), TILTED), engine="radial")
    with pytest.raises(ValueError, match="choose among"):
        plan(scene(), engine="fft")


def test_blur_is_that_of_geometry():
    """R z |1/z' - 1/z_f| of a lens focused elsewhere."""
    result = blur(original(depths=(500.0, 1000.0, math.inf)))[:, 0]
    assert torch.allclose(result, vector(1, 0, 1) * R * 35.5e-3, atol=1e-9)


@pytest.mark.parametrize("samples", [48, 64])
def test_copies_of_the_image_in_the_window_are_refused_and_are_wrong(samples):
    """N = 64 puts copies every 209 µm into a window of ± 236 µm: more than all of the PSF is error."""
    s = original()
    with pytest.raises(AliasedSampling, match="repeat the image every"):
        plan(s, engine="pupil", samples=samples)
    sums = pupil.prepare(s, samples, 4)
    aliased = integrate(pupil.intensity(s, sums), sums.to_pixels.pixel, s.grid.pitch)
    assert relative(aliased, psf(s).kernel) > 1


def test_samples_just_enough_are_taken_and_are_right():
    s = original()
    with pytest.raises(AliasedSampling):
        plan(s, engine="pupil", samples=98)
    assert relative(psf(s, engine="pupil", samples=108).kernel, psf(s).kernel) < 1e-2


@pytest.mark.slow
def test_an_undersampled_converging_field_is_warned_of_and_is_wrong():
    """The 3.69 µm grid of the original at 460 nm: λz/D is 3.27 µm, and the rim is aliased."""
    s = original(size=32)
    samples = round(2 * R / 0.00369)
    with pytest.warns(Aliased, match="undersampled"):
        result = psf(s, engine="fresnel", samples=samples, pad=1.5)
    expected = psf(s).kernel
    assert relative(result.kernel, expected) > 0.1
    assert result.error > 0.1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plan(original(wavelengths=(0.64,)), engine="fresnel", samples=samples)


@pytest.mark.parametrize("tol", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("engine", ["radial", "pupil"])
def test_predicted_errors_hold(engine, tol):
    """Depths in and out of focus, three colours, two windows: an upper bound, not above the tolerance."""
    for size, pitch in ((64, 0.00369), (24, 0.006)):
        s = scene(depths=(500.0, 1000.0, math.inf), wavelengths=(0.46, 0.55, 0.64), size=size, pitch=pitch)
        result = psf(s, engine=engine, tol=tol)
        error = relative(result.kernel, psf(s, tol=1e-6).kernel)
        assert error < result.error <= tol
        assert result.plan.flops > 0
        assert result.plan.memory > 0


@pytest.mark.parametrize("strength", [5e-5, 3e-4])
def test_predicted_errors_hold_for_any_shape(strength):
    """Random Zernike elements: the estimate is an upper bound, and no worse than a factor 100."""
    generator = torch.Generator().manual_seed(5)
    coefficients = strength * torch.randn(11, generator=generator, dtype=torch.float64)
    s = scene(lens(), Element(Zernike(coefficients), scalar(R), PLASTIC), depths=(700.0,), size=48)
    result, fine = psf(s, tol=1e-3), psf(s, tol=3e-5)
    error = relative(result.kernel, fine.kernel)
    assert 0.01 * result.error < error < result.error <= 1e-3


def test_cost_grows_with_the_requested_samples():
    s = scene(lens(), TILTED, size=64)
    cheap, dear = plan(s, tol=1e-2), plan(s, tol=1e-5)
    assert cheap.samples < dear.samples
    assert cheap.flops < dear.flops
    assert cheap.memory < dear.memory
    both = plan(scene(lens(), TILTED, size=64, depths=(1000.0, 1001.0)), tol=1e-2)
    assert both.flops == pytest.approx(2 * cheap.flops, rel=0.02)
    assert plan(s, engine="fresnel").flops > 20 * cheap.flops


def test_hard_samplings():
    """One cell, one pixel across the aperture, a diameter that no pitch divides, odd numbers of cells."""
    tiny = Element(EvenPowers(vector(0.0)), scalar(0.005), PLASTIC)
    pinhole = scene(tiny, size=8)
    assert psf(pinhole, engine="pupil").plan.samples >= 16
    # Light of a pinhole is even over the window: πR²/(λz)² mm⁻² at the axis.
    expected = math.pi * 0.005**2 / (0.55e-3 * 35.5) ** 2 * 0.00369**2
    assert torch.allclose(psf(pinhole, engine="pupil").kernel, scalar(expected), rtol=1e-3)
    one = Element(Pixels(torch.zeros(1, 1, dtype=torch.float64), scalar(0.01)), scalar(0.005), PLASTIC)
    assert torch.allclose(psf(scene(one, size=8)).kernel, scalar(expected), rtol=2e-3)
    odd = scene(lens(radius=0.5), size=(9, 16))
    expected = psf(odd, tol=1e-6).kernel
    assert relative(psf(odd, engine="pupil", samples=101, nodes=3).kernel, expected) < 1e-3
    heights = -0.5 * (torch.arange(37).double() - 18)[:, None] ** 2 * 1e-6 * torch.ones(37, dtype=torch.float64)
    uneven = Element(Pixels(heights, scalar(0.03)), scalar(0.4), PLASTIC)
    result, fine = (psf(scene(uneven), samples=n) for n in (37 * 4, 37 * 12))
    assert relative(result.kernel, fine.kernel) < result.error < 0.1


def test_engines_are_named():
    s = scene(lens(radius=0.3), size=4)
    assert [psf(s, engine=name).engine for name in ENGINES] == list(ENGINES)


def test_unequal_elements_are_refused():
    with pytest.raises(ValueError, match="put it first"):
        plan(scene(lens(), dataclasses.replace(lens(), radius=scalar(1.0))))
