"""The element: heights become paths, wrapping and steps, and where pixels and rings lie."""

import math
import re

import numpy as np
import pytest
import torch
from differences import gradcheck
from problems import number

import raytrace as rt
from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import constant, index
from raytrace.maths.numerics import to
from raytrace.maths.zernike import noll, polynomials
from raytrace.wave_optics.element import (
    Element,
    EvenPowers,
    Pixels,
    Rings,
    Zernike,
    designed_height,
    fabricated_height,
    height,
    is_radial,
    path,
    period,
)

#: Rounding of a few operations on numbers of the order of 1.
ROUNDING = 1e-14
COLOURS = torch.tensor([0.46, 0.55, 0.64], dtype=torch.float64)
PMMA, SILICA = find_glass("PMMA"), find_glass("F_SILICA")


def element(profile, glass=PMMA, **known):
    return Element(profile, number(2.5), glass, **known)


def points(count=40, radius=2.5):
    draw = torch.rand(2, count, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    r, angle = radius * torch.sqrt(draw[0]), 2 * math.pi * draw[1]
    return r * torch.cos(angle), r * torch.sin(angle)


LENS = EvenPowers(number([-0.03, 1e-5]))


# -- the path ---------------------------------------------------------------------------------------------------------


def test_path_is_index_excess_times_height():
    x, y = points()
    lens = element(LENS)
    expected = (index(PMMA, COLOURS) - 1)[:, None] * (-0.03 * (x**2 + y**2) + 1e-5 * (x**2 + y**2) ** 2)
    assert (path((lens,), x, y, COLOURS) - expected).abs().max() < ROUNDING


def test_path_keeps_the_shape_of_the_points():
    x, y = (part.reshape(2, 4, 5) for part in points())
    assert path((element(LENS),), x, y, COLOURS).shape == (3, 2, 4, 5)


def test_index_2_makes_a_path_of_the_height_at_every_wavelength():
    x, y = points()
    ideal = element(LENS, constant(2.0))
    assert torch.equal(path((ideal,), x, y, COLOURS), height(ideal, x, y).expand(3, -1))


def test_a_converging_lens_is_thickest_on_its_axis():
    """f = 50 mm: h falls by r²/2f(n - 1), so that the ray along the axis is late by the r²/2f its sphere wants."""
    n = index(PMMA, COLOURS[1])
    lens = element(EvenPowers((-1 / (2 * 50 * (n - 1)))[None]))
    r = number([0.0, 1.0, 2.0])
    assert (path((lens,), r, 0 * r, COLOURS)[1] + r**2 / 100).abs().max() < ROUNDING
    assert (height(lens, r, 0 * r).diff() < 0).all()


def test_elements_in_contact_add_their_paths():
    x, y = points()
    first = element(LENS)
    second = element(Zernike(number([1e-3, 0, 2e-3, 5e-4])), SILICA, period=period(SILICA, 0.55), levels=16)
    together = path((first, second), x, y, COLOURS)
    assert (together - path((first,), x, y, COLOURS) - path((second,), x, y, COLOURS)).abs().max() < ROUNDING


def test_no_elements_make_no_path():
    x, y = points()
    assert torch.equal(path((), x, y, COLOURS), torch.zeros(3, 40, dtype=torch.float64))


# -- the period -------------------------------------------------------------------------------------------------------


def test_period_of_fused_silica_is_one_wave():
    """Malitson's n(0.55 µm) = 1.45991 makes it 0.55/0.45991 = 1.1959 µm."""
    assert abs(float(period(SILICA, 0.55)) - 1.1959e-3) < 1e-7
    assert abs(float(period(constant(2.0), 0.5)) - 0.5e-3) < 1e-18


def test_wrapping_changes_nothing_at_the_design_wavelength_and_something_elsewhere():
    x, y = points()
    whole, wrapped = element(LENS, SILICA), element(LENS, SILICA, period=period(SILICA, 0.55))
    waves = (path((whole,), x, y, COLOURS) - path((wrapped,), x, y, COLOURS)) / (1e-3 * COLOURS[:, None])
    off = (waves - waves.round()).abs().amax(-1)
    assert off[1] < 1e-10  # 150 waves to 1e-15 each
    assert off[0] > 0.1
    assert off[2] > 0.1


def test_wrapped_heights_lie_within_one_period():
    x, y = points(400)
    top = period(SILICA, 0.55)
    h = height(element(LENS, SILICA, period=top), x, y)
    assert (h >= 0).all()
    assert (h < top).all()


def test_sixteen_levels_are_exactly_sixteen_heights():
    x, y = points(4000)
    top = period(SILICA, 0.55)
    h = height(element(LENS, SILICA, period=top, levels=16), x, y)
    steps = torch.unique(h)
    assert len(steps) == 16
    assert (steps - torch.arange(16) * top / 16).abs().max() < 1e-18
    assert steps[0] == 0
    assert steps[-1] < top


def test_steps_lie_below_the_height_by_less_than_one():
    top = number(1.2e-3)
    h = torch.linspace(-2e-3, 2e-3, 1000, dtype=torch.float64)
    lost = fabricated_height(h, top) - fabricated_height(h, top, 16)
    assert (lost > -1e-4 * top / 16).all()  # a height at a step to rounding is that step
    assert (lost < top / 16).all()


@pytest.mark.parametrize("levels", [2, 3, 16, 255])
def test_steps_stay_as_they_are(levels):
    top = period(SILICA, 0.55)
    steps = torch.arange(levels) * (top / levels)
    assert torch.equal(fabricated_height(steps, top, levels), steps)
    # as read from a file that keeps 10 digits
    rounded = number([float(f"{h:.10g}") for h in steps.tolist()])
    assert (fabricated_height(rounded, top, levels) - steps).abs().max() < 1e-9 * top


def test_gradients_pass_the_steps_as_if_they_were_not_there():
    x, y = points()
    gradients = []
    for top, levels in ((None, 0), (period(SILICA, 0.55), 0), (period(SILICA, 0.55), 16)):
        c = LENS.coefficients.clone().requires_grad_()
        h = height(element(EvenPowers(c), SILICA, period=top, levels=levels), x, y)
        gradients.append(torch.autograd.grad((h * torch.arange(40)).sum(), c)[0])
    assert torch.equal(gradients[0], gradients[1])
    assert torch.equal(gradients[0], gradients[2])


# -- the profiles -----------------------------------------------------------------------------------------------------


def test_zernike_piston_is_a_plate_and_focus_a_parabola():
    x, y = points()
    r2 = (x**2 + y**2) / 2.5**2
    h = height(element(Zernike(number([3e-3, 0, 0, -5e-2]))), x, y)
    assert (h - 3e-3 + 5e-2 * math.sqrt(3) * (2 * r2 - 1)).abs().max() < ROUNDING
    # the power of that focus term, 4 √3 c (n - 1)/R², is what EvenPowers gives with -4 √3 c/2R²
    same = height(element(EvenPowers(number([-5e-2 * 2 * math.sqrt(3) / 2.5**2]))), x, y)
    assert ((h - same) - (h - same)[0]).abs().max() < ROUNDING


def test_zernike_coefficients_are_heights_rms():
    """A ring of points in r² and angle is exact for these orders: the mean of h² is Σ c_j²."""
    c = number([0.0, 1e-3, -2e-3, 3e-3, 1e-3, 0.5e-3, 0.2e-3])
    nodes = (torch.arange(64, dtype=torch.float64) + 0.5) / 64
    r, angle = 2.5 * torch.sqrt(nodes)[:, None], 2 * math.pi * torch.arange(16) / 16
    h = height(element(Zernike(c)), r * torch.cos(angle), r * torch.sin(angle))
    assert abs(float((h**2).mean() / (c**2).sum()) - 1) < 1e-3  # the midpoint rule in r²


def test_zernike_is_that_of_the_unit_disc():
    x, y = points()
    c = torch.arange(1, 16, dtype=torch.float64) * 1e-4
    basis = polynomials([noll(j) for j in range(1, 16)], x / 2.5, y / 2.5)
    assert (height(element(Zernike(c)), x, y) - (c[:, None] * basis).sum(0)).abs().max() < ROUNDING


def test_pixels_lie_around_the_axis_with_row_0_at_the_smallest_y():
    h = torch.arange(6, dtype=torch.float64).reshape(2, 3)
    x, y = number([-1.0, 0.0, 1.0, -1.0, 0.0, 1.0]), number([-0.5, -0.5, -0.5, 0.5, 0.5, 0.5])
    result = height(element(Pixels(h, number(1.0))), x, y)
    assert torch.equal(result, h.flatten())


def test_a_pixel_is_constant_between_its_edges_and_the_last_one_extends():
    h = torch.arange(4, dtype=torch.float64).expand(4, 4)
    x = number([-99.0, -2.0, -1.001, -0.999, -0.001, 0.0, 0.999, 1.0, 99.0])
    result = height(element(Pixels(h, number(1.0))), x, 0 * x)
    assert result.tolist() == [0, 0, 0, 1, 1, 2, 2, 3, 3]


def test_rings_start_on_the_axis_and_the_last_one_extends():
    rings = element(Rings(number([5.0, 6.0, 7.0]), number(0.5)))
    r = number([0.0, 0.499, 0.5, 0.999, 1.0, 1.4, 99.0])
    assert height(rings, r, 0 * r).tolist() == [5, 5, 6, 6, 7, 7, 7]
    angle = number([0.1, 2.0, 4.0])
    assert height(rings, 0.7 * torch.cos(angle), 0.7 * torch.sin(angle)).tolist() == [6, 6, 6]


def test_only_rings_and_even_powers_are_radial():
    kinds = (Rings(number([1.0]), number(1.0)), LENS, Zernike(number([1.0])), Pixels(number([[1.0]]), number(1.0)))
    assert [is_radial(element(profile)) for profile in kinds] == [True, True, False, False]


# -- numbers and gradients --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "profile",
    [
        LENS,
        Zernike(number([1e-3, 2e-3, 0.0, -1e-2])),
        Rings(torch.linspace(0, 1e-3, 9, dtype=torch.float64), number(0.3)),
        Pixels(torch.linspace(0, 1e-3, 12, dtype=torch.float64).reshape(3, 4), number(1.5)),
    ],
)
@pytest.mark.parametrize("levels", [0, 16])
def test_float32_stays_float32_and_is_the_same_path(profile, levels):
    x, y = points()
    exact = element(profile, SILICA, period=None if levels == 0 else period(SILICA, 0.55), levels=levels)
    result = path((to(exact, dtype=torch.float32),), x.float(), y.float(), COLOURS.float())
    assert result.dtype == torch.float32
    if levels == 0:  # a height near a step may fall on its other side
        assert (result - path((exact,), x, y, COLOURS)).abs().max() < 1e-6 * 0.1  # mm: float32 of a sag below 0.1 mm


PROFILES = {
    "zernike": (Zernike, (torch.arange(1, 11, dtype=torch.float64) * 1e-3,)),
    "even powers": (EvenPowers, (number([-0.03, 1e-4, 1e-5]),)),
    "rings": (lambda h: Rings(h, number(0.4)), (torch.linspace(0, 1e-2, 7, dtype=torch.float64),)),
    "pixels": (
        lambda h: Pixels(h, number(1.0)),
        (torch.linspace(0, 1e-2, 30, dtype=torch.float64).reshape(5, 6),),
    ),
}


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("wrap", [False, True])
def test_gradcheck_of_learned_heights(name, wrap):
    build, numbers = PROFILES[name]
    x, y = points(11, radius=2.3)
    # 7 µm is no wave of anything: heights of these profiles stay away from its jumps by more than the step.
    top = number(7.1e-3) if wrap else None

    def waves(h):
        return path((element(build(h), SILICA, period=top),), x, y, COLOURS)

    assert gradcheck(waves, [h.clone().requires_grad_() for h in numbers], eps=1e-7)


def test_gradcheck_of_the_radius_and_of_the_glass():
    x, y = points(7, radius=2.0)
    c = number([1e-3, 2e-3, 3e-3, -4e-3])

    def waves(radius, n):
        return path((Element(Zernike(c), radius, constant(n)),), x, y, COLOURS)

    assert gradcheck(waves, [number(2.5).requires_grad_(), number(1.5).requires_grad_()])


def test_second_derivatives_in_the_points_are_those_of_the_lens():
    x = number([0.0, 0.5, 1.0]).requires_grad_()
    h = designed_height(element(EvenPowers(number([-0.03])), PMMA), x, torch.zeros(3, dtype=torch.float64))
    slope = torch.autograd.grad(h.sum(), x, create_graph=True)[0]
    assert (torch.autograd.grad(slope.sum(), x)[0] + 0.06).abs().max() < ROUNDING


# An element of an array.


def test_an_element_of_an_array_is_that_of_its_file(tmp_path):
    x = 0.02 * (np.arange(60) - 29.5)
    heights = 1e-3 * (x[:, None] ** 3 + 0.5 * x)
    np.save(tmp_path / "map.npy", heights)
    options = {"aperture": 1.0, "pitch": 0.02, "glass": "F_SILICA", "design_wavelength": 0.55, "levels": 8}
    one, other = (
        rt.wave_optics.phase_element(heights, **options),
        rt.wave_optics.read_element(tmp_path / "map.npy", **options),
    )
    assert torch.equal(one.numbers, other.numbers)
    assert torch.equal(one.period, other.period)
    assert one.levels == other.levels == 8
    assert repr(one) == repr(other)
    assert "60 × 60 pixels of 20 µm, wrapped at 1.196 µm in 8 steps, of F_SILICA" in repr(one)


def test_a_wedge_moves_the_light_towards_its_thick_side():
    x = 0.01 * (np.arange(100) - 49.5)
    rows, slope = np.repeat(x[:, None], 100, 1), 0.004
    (focusing,) = rt.wave_optics.phase_elements("ideal", aperture=1.0)
    for heights, axis in ((slope * rows, 0), (slope * rows.T, 1)):
        wedge = rt.wave_optics.phase_element(heights, aperture=1.0, pitch=0.01, glass=1.5)
        kernel = rt.wave_optics.wave_psf(
            [focusing, wedge], depths=[1000], wavelengths=[0.55], pixel=0.01, size=41
        ).kernel[0, 0]
        brightest = np.unravel_index(int(kernel.argmax()), kernel.shape)
        expected = 20 + round(0.5 * slope * 35.5 / 0.01)  # (n - 1) slope z, in pixels
        assert brightest[axis] == expected
        assert brightest[1 - axis] == 20


def test_derivatives_by_zernike_coefficients_of_an_array():
    (focusing,) = rt.wave_optics.phase_elements("ideal", aperture=1.0)

    def peak(coefficients):
        plate = rt.wave_optics.phase_element(coefficients, profile="zernike", aperture=1.0, glass="F_SILICA")
        return rt.wave_optics.wave_psf(
            [focusing, plate], depths=[1000], wavelengths=[0.55], size=15, samples=64
        ).kernel.max()

    start = torch.tensor([0, 0, 0, 1e-4, 0, 0, 1e-4], dtype=torch.float64)
    step = torch.tensor([0, 0, 0, 1e-7, 0, 0, -2e-7], dtype=torch.float64)
    (slope,) = torch.autograd.grad(peak(coefficients := start.clone().requires_grad_()), coefficients)
    assert float(slope @ step) == pytest.approx(float(peak(start + step) - peak(start - step)) / 2, rel=1e-5)


@pytest.mark.parametrize(
    ("numbers", "options", "message"),
    [
        (np.zeros((9, 9)), {}, "needs `pitch`"),
        (np.zeros(9), {"pitch": 0.1}, "expected (rows, columns)"),
        (np.zeros(9), {"profile": "zernike", "pitch": 0.1}, "has no `pitch`"),
        (np.full((30, 30), np.nan), {"pitch": 0.1}, "900 of 900 numbers of the element are not finite"),
        (np.zeros((9, 9)), {"pitch": 0.05}, "give `aperture=0.45`"),
        (np.zeros((30, 30)), {"pitch": 0.1, "levels": 8}, "give `design_wavelength`"),
        (np.zeros(9), {"profile": "zernikes"}, "expected one of pixels, rings, zernike, powers"),
    ],
)
def test_wrong_arrays_are_refused(numbers, options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        rt.wave_optics.phase_element(numbers, aperture=1.0, glass="PMMA", **options)


def test_an_array_alone_is_no_element():
    with pytest.raises(TypeError, match=r"ndarray .*expected .*rt\.wave_optics\.phase_element\(heights"):
        rt.wave_optics.wave_psf(np.zeros((9, 9)))
    with pytest.raises(TypeError, match=r"`elements` is 'cubic'; expected .*phase_elements"):
        rt.wave_optics.hybrid_psf("double_gauss", "cubic")


@pytest.mark.parametrize("function", [rt.wave_optics.phase_elements, rt.wave_optics.read_element])
def test_an_array_in_place_of_a_file_is_refused_with_the_function_that_takes_it(function):
    with pytest.raises(TypeError, match=r"ndarray; expected a path .*phase_element\("):
        function(np.zeros((4, 4)), aperture=1.0)


@pytest.mark.parametrize("option", [{"levels": 8}, {"aperture": 3.0}, {"glass": "PMMA"}, {"design_wavelength": 0.5}])
def test_options_of_a_name_are_refused_for_an_element(option):
    (element,) = rt.wave_optics.phase_elements("singlet", aperture=2.0)
    with pytest.raises(ValueError, match=f"`{next(iter(option))}` .*by name or from a file"):
        rt.wave_optics.wave_psf(element, **option)
