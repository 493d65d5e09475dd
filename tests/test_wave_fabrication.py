"""Fabrication: sampling at the size of features, wrapping and tolerance."""

import dataclasses
import json
import math

import pytest
import torch
from problems import generator, number

import raytrace as rt
from raytrace.materials.catalogs import find_glass
from raytrace.wave_optics.element import Element, EvenPowers, Pixels, Rings, Zernike, height, period
from raytrace.wave_optics.fabrication import as_pixels, as_rings, fabricated, height_range, with_tolerance, wrapped

SILICA = find_glass("F_SILICA")


def lens(radius=0.5):
    return Element(EvenPowers(number([-0.03, 2e-3])), number(radius), SILICA)


def test_rings_hold_the_height_at_their_middle():
    rings = as_rings(lens(), 0.02)
    assert len(rings.profile.heights) == 25
    r = (torch.arange(25).double() + 0.5) * 0.02
    assert (rings.profile.heights - height(lens(), r, 0 * r)).abs().max() < 1e-15
    assert (height(rings, r, 0 * r) - height(lens(), r, 0 * r)).abs().max() < 1e-15


@pytest.mark.parametrize("pitch", [0.02, 0.021, 0.25, 3.0])
def test_features_cover_the_aperture_and_no_more(pitch):
    count = len(as_rings(lens(), pitch).profile.heights)
    assert (count - 1) * pitch < 0.5 <= count * pitch * (1 + 1e-6)
    rows, columns = as_pixels(lens(), pitch).profile.heights.shape
    assert rows == columns
    assert (rows - 1) * pitch < 1.0 <= rows * pitch * (1 + 1e-6)


def test_pixels_hold_the_height_at_their_middle_also_without_symmetry():
    comatic = Element(Zernike(number([0, 1e-3, 2e-3, 0, 0, 3e-3, 1e-3, -1e-3])), number(0.5), SILICA)
    for pitch in (0.05, 0.048):  # an even and an odd number across
        pixels = as_pixels(comatic, pitch)
        count = len(pixels.profile.heights)
        x = (torch.arange(count).double() - 0.5 * (count - 1)) * pitch
        y, x = torch.meshgrid(x, x, indexing="ij")
        assert (height(pixels, x, y) - height(comatic, x, y)).abs().max() < 1e-15


def test_pixels_cannot_become_rings():
    with pytest.raises(ValueError, match="a profile of Pixels is not radial"):
        as_rings(as_pixels(lens(), 0.1), 0.1)


def test_sampling_and_wrapping_commute():
    x = torch.linspace(-0.35, 0.35, 101, dtype=torch.float64)
    first = as_rings(wrapped(lens(), 0.55, levels=16), 0.02)
    second = wrapped(as_rings(lens(), 0.02), 0.55, levels=16)
    assert torch.equal(height(first, x, 0.9 * x), height(second, x, 0.9 * x))
    assert torch.equal(first.period, period(SILICA, 0.55))


def test_sixteen_steps_keep_sinc2_of_the_light():
    """The phase error of L even steps is uniform over 2π/L: |mean e^(iδ)|² = sinc²(1/L), 0.98720 for 16."""
    ramp = Element(EvenPowers(number([-0.1])), number(0.5), SILICA)
    r = 0.5 * torch.sqrt((torch.arange(200_000, dtype=torch.float64) + 0.5) / 200_000)
    top = period(SILICA, 0.55)
    for levels in (2, 4, 8, 16):
        lost = height(wrapped(ramp, 0.55, levels=levels), r, 0 * r) - height(ramp, r, 0 * r)
        phase = 2 * math.pi * lost / top
        kept = phase.cos().mean() ** 2 + phase.sin().mean() ** 2
        expected = (math.sin(math.pi / levels) * levels / math.pi) ** 2
        assert abs(float(kept) - expected) < 3e-3  # 21 zones, the last one not whole


def test_tolerance_is_uniform_keyed_and_leaves_the_element():
    made = wrapped(as_rings(lens(2.5), 0.0005), 0.55, levels=16)
    off = with_tolerance(made, 20e-6, generator=generator(3))
    x = made.profile.heights
    r = (torch.arange(len(x)).double() + 0.5) * made.profile.pitch
    error = height(off, r, 0 * r) - height(made, r, 0 * r)
    assert error.abs().max() <= 20e-6
    assert error.abs().max() > 19.9e-6
    assert abs(float(error.std()) / 20e-6 * math.sqrt(3) - 1) < 0.03  # 5000 draws: 1 % standard error
    assert abs(float(error.mean())) < 1e-6
    again = with_tolerance(made, 20e-6, generator=generator(3))
    assert torch.equal(again.profile.heights, off.profile.heights)
    other = with_tolerance(made, 20e-6, generator=generator(4))
    assert not torch.equal(other.profile.heights, off.profile.heights)
    assert (off.period, off.levels) == (None, 0)  # what is off a step is not put back on it


def test_no_tolerance_is_the_element_as_fabricated():
    made = wrapped(as_pixels(lens(), 0.02), 0.55, levels=16)
    off = with_tolerance(made, 0.0, generator=generator(0))
    x = torch.linspace(-0.4, 0.4, 57, dtype=torch.float64)
    assert torch.equal(height(off, x, -x), height(made, x, -x))


def test_a_smooth_profile_has_no_features_to_be_off():
    for function in (fabricated, lambda element: with_tolerance(element, 20e-6)):
        with pytest.raises(ValueError, match="use as_rings or as_pixels first"):
            function(lens())


def test_fabricated_is_the_same_element_with_its_heights_written_out():
    element = wrapped(as_rings(lens(), 0.02), 0.55, levels=16)
    made = fabricated(element)
    x = torch.linspace(-0.4, 0.4, 57, dtype=torch.float64)
    assert torch.equal(height(made, x, -x), height(element, x, -x))
    assert len(torch.unique(made.profile.heights)) > 8
    assert (made.profile.heights >= 0).all()
    assert (made.profile.heights < element.period).all()
    assert (made.period, made.levels) == (None, 0)


@pytest.mark.parametrize("levels", [0, 16])
@pytest.mark.parametrize("suffix", [".npy", ".csv", ".tif"])
def test_files_hold_the_simulated_kernels(tmp_path, suffix, levels):
    """Heights wrapped and in steps, of rings and of pixels made of them: the file alone is the element, no period."""
    rings = rt.wave_optics.as_rings(lens(), 0.02)
    rt.wave_optics.write_element(rings, tmp_path / f"whole{suffix}", design_wavelength=0.55)
    read = rt.wave_optics.read_element(tmp_path / f"whole{suffix}", aperture=1.0, design_wavelength=0.55, levels=levels)
    assert float(read.numbers.abs().max()) > 4 * float(read.period)  # whole heights, wrapped when they are used
    for name, element in (("rings", read), ("pixels", rt.wave_optics.as_pixels(read, 0.02))):
        file = tmp_path / f"{name}{suffix}"
        rt.wave_optics.write_element(element, file, design_wavelength=0.55)
        again = rt.wave_optics.read_element(file, aperture=1.0)
        x = torch.linspace(-0.35, 0.35, 57, dtype=torch.float64)
        # A picture of 16 bits has its range in 65,535 steps, rounded to the nearest; steps come back bit for bit.
        most = 0.0 if levels or suffix != ".tif" else float(read.period) / 131_070 * 1.001
        assert (height(again, x, -x) - height(element, x, -x)).abs().max() <= most
        assert float(again.numbers.min()) >= 0
        assert float(again.numbers.max()) < float(read.period)
        assert again.period is None
        if levels:
            assert len(torch.unique(again.numbers)) <= levels
        # A map of pixels goes on beyond the aperture, to the corners of its square.
        low, high = json.loads((tmp_path / f"{name}{suffix}.json").read_text())["height_range"]
        assert float(again.numbers.min()) - most <= low <= high <= float(again.numbers.max()) + most


def test_the_range_of_heights_is_that_inside_the_aperture():
    """h = c r² over a radius of 0.5 mm: 0 to c/4 mm; of rings that of their middles; of a tilt both ways; wrapped."""
    whole, c = lens(), -0.1
    parabola = dataclasses.replace(whole, profile=EvenPowers(number([c])))
    assert height_range(parabola) == pytest.approx((c / 4, 0.0), abs=1e-12)
    last = 0.5 - 0.0005
    assert height_range(as_rings(parabola, 0.001)) == pytest.approx((c * last**2, c * 0.0005**2), abs=1e-12)
    low, high = height_range(as_pixels(parabola, 0.001))
    assert (low, high) == pytest.approx((c / 4, 0.0), abs=2e-3 * abs(c))
    tilt = dataclasses.replace(whole, profile=Zernike(number([0.0, 0.01])))
    assert height_range(tilt) == pytest.approx((-0.02, 0.02), abs=1e-9)
    low, high = height_range(wrapped(parabola, 0.55, levels=4))
    assert (low, high) == pytest.approx((0, 0.75 * float(period(SILICA, 0.55))), abs=1e-12)


def test_gradients_pass_sampling_steps_and_tolerance():
    c = number([-0.03, 2e-3]).requires_grad_()
    smooth = Element(EvenPowers(c), number(0.5), SILICA)
    made = with_tolerance(wrapped(as_rings(smooth, 0.02), 0.55, levels=16), 2e-5, generator=generator(1))
    weights = torch.arange(25, dtype=torch.float64)
    result = torch.autograd.grad((made.profile.heights * weights).sum(), c)[0]
    r2 = ((torch.arange(25).double() + 0.5) * 0.02).double() ** 2
    assert (result - torch.stack([(weights * r2).sum(), (weights * r2**2).sum()])).abs().max() < 1e-6


def test_float32_stays_float32():
    single = Element(EvenPowers(torch.tensor([-0.03])), torch.tensor(0.5), SILICA)
    for made in (as_rings(single, 0.02), as_pixels(single, 0.02)):
        off = with_tolerance(wrapped(made, 0.55, levels=16), 2e-5, generator=generator(0))
        assert off.profile.heights.dtype == off.profile.pitch.dtype == torch.float32


def test_rings_of_one_are_a_plate():
    plate = as_rings(lens(), 5.0)
    assert isinstance(plate.profile, Rings)
    assert len(plate.profile.heights) == 1
    assert isinstance(as_pixels(lens(), 5.0).profile, Pixels)
