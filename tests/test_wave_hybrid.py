"""The tracer bridge: height maps traced as lenses, elements at the stop of a lens, and the waves and rays of both."""

import dataclasses
import math

import pytest
import torch
from differences import gradcheck
from problems import double_gauss, lens, scalar, surface, vector

from raytrace.materials.glass import constant
from raytrace.maths.sampling import centres, gauss_rings, grid
from raytrace.psf_models import DRT, psf, wave
from raytrace.system import sag_terms as sag_terms
from raytrace.system.apertures import Aperture
from raytrace.system.lens import Lens, aligned, media, with_sensor_distance
from raytrace.system.surface import sag_at
from raytrace.tracing.launch import launch
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import scene
from raytrace.tracing.trace import rays_at, trace_surfaces
from raytrace.tracing.wavefront import wavefront_of
from raytrace.wave_optics import hybrid as bridge
from raytrace.wave_optics.compute import psf as wave_psf
from raytrace.wave_optics.element import Element, EvenPowers, Pixels, Rings, Zernike, height, period
from raytrace.wave_optics.scene import WaveScene, excess, residual

PMMA, WAVE = 1.493, 0.55e-3  # index and wavelength in mm
INDEX = 1.5
RADIUS, SENSOR, FOCUS = scalar(2.5), scalar(35.5), scalar(1000.0)
AXIS = torch.zeros(2, 1, dtype=torch.float64)
FAR = vector(math.inf)


def even_powers(coefficients, radius=RADIUS, index=PMMA) -> Element:
    return Element(EvenPowers(coefficients), radius, constant(index))


def noll(*coefficients: float, radius: float = 2.5, index=INDEX, **others) -> Element:
    return Element(Zernike(vector(*coefficients)), scalar(radius), constant(index), **others)


# -- a height map as a lens --------------------------------------------------------------------------------------------

HEIGHT_MAP = 0.02 * torch.rand(12, 10, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
PROFILES = {
    "powers": EvenPowers(vector(-0.01, 2e-5)),
    "zernike": Zernike(vector(0.05, 1e-3, -2e-3, -0.03, 2e-3)),
    "pixels": Pixels(0.5 + HEIGHT_MAP, scalar(0.6)),
}


@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)
def test_the_back_surface_is_the_height_and_its_vertex_lies_on_it(profile):
    element = Element(profile, RADIUS, constant(PMMA))
    front, back = bridge.surfaces_of(element, substrate=0.3)
    zero = scalar(0.0)
    assert float(sag_at(back, zero, zero).abs()) < 1e-16
    if isinstance(profile, Pixels):
        x, y = torch.meshgrid(
            *(0.6 * (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) for n in (10, 12)), indexing="xy"
        )
    else:
        x, y = 2.5 * gauss_rings(4)[0]
    z = front.thickness + sag_at(back, x, y)
    assert (z - 0.3 - height(element, x, y)).abs().max() < 1e-15


@pytest.mark.parametrize(
    ("element", "message"),
    [
        (noll(0.0, 0.0, 0.0, 0.1, period=scalar(1e-3)), "wrapped height"),
        (Element(Rings(torch.ones(4, dtype=torch.float64), scalar(0.7)), RADIUS, constant(1.5)), "rings"),
        (noll(0.0, 0.1), "substrate"),
    ],
)
def test_elements_without_a_ray_model_are_refused(element, message):
    with pytest.raises(ValueError, match=message):
        bridge.surfaces_of(element)


def sag_of_powers(coefficients, r2):
    return sum(c * r2**k for k, c in enumerate(coefficients, 1))


def left_out(coefficients, r2):
    """What a thin element leaves out: s (cos θ - 1), from the height s below the vertex straight to the sensor."""
    s = -sag_of_powers(coefficients, r2)
    return torch.sqrt(r2 + (SENSOR + s) ** 2) - torch.sqrt(r2 + SENSOR**2) - s


def fitted(heights, r2):
    """Coefficients of even powers to r⁸."""
    powers = torch.stack([(r2 / RADIUS**2) ** k for k in range(1, 5)], -1)
    scaled = torch.linalg.lstsq(powers, heights[:, None]).solution[:, 0]
    return scaled / RADIUS ** (2 * torch.arange(1, 5))


def singlet() -> torch.Tensor:
    """Coefficients of the PMMA element whose traced rays meet at the sensor: 5 mm, 35.5 mm, focused at 1 m."""
    r2 = torch.linspace(0, 2.5, 60, dtype=torch.float64) ** 2
    spheres = excess(r2, 1 / FOCUS) + excess(r2, 1 / SENSOR)
    coefficients = fitted(-spheres / (PMMA - 1), r2)
    for _ in range(4):
        coefficients = fitted(-(spheres + left_out(coefficients, r2)) / (PMMA - 1), r2)
    return coefficients


def thin(coefficients) -> torch.Tensor:
    """Coefficients of the thin element with the path of the traced one."""
    r2 = torch.linspace(0, 2.5, 60, dtype=torch.float64) ** 2
    return fitted(sag_of_powers(coefficients, r2) + left_out(coefficients, r2) / (PMMA - 1), r2)


def traced(coefficients, distance: float) -> Lens:
    substrate = 0.02 - float(sag_of_powers(coefficients, RADIUS**2))
    return bridge.element_lens(
        even_powers(coefficients),
        sensor_distance=SENSOR,
        object_distance=scalar(distance),
        wavelengths=vector(0.55),
        substrate=substrate,
    )


def test_traced_wavefront_is_the_path_of_the_thin_element_and_the_term_it_leaves_out():
    """In focus, where ray and straight line to the sensor agree: to 1e-3 waves; alone the thin path is 0.8 off."""
    coefficients = singlet()
    pupil = torch.stack([torch.linspace(0.02, 1, 20, dtype=torch.float64), torch.zeros(20, dtype=torch.float64)])
    view = scene(traced(coefficients, 1000.0), AXIS, vector(1000.0), vector(0.55))
    opd = wavefront_of(view, pupil).opd[0, 0, 0] / WAVE
    assert opd.abs().max() < 1e-3
    paths = []
    for shape in (coefficients, thin(coefficients)):
        camera = WaveScene((even_powers(shape),), SENSOR, vector(1000.0), vector(0.55), grid(0.005, 3), exact=True)
        paths.append(residual(camera, 2.5 * pupil[0], 0 * pupil[0])[0, 0] / WAVE)
    assert 0.7 < paths[0].abs().max() < 0.9  # s θ²/2 = 0.185 mm · 0.07²/2
    assert (paths[1] - opd).abs().max() < 1e-3


def encircled(kernel, pixels, radii):
    x, y = centres(pixels)
    distance = torch.hypot(x[None, :], y[:, None])
    return torch.stack([kernel[distance <= r].sum() for r in radii])


def half_energy_radius(kernel, pixels) -> float:
    """From the area of the pixels that hold it, innermost first."""
    x, y = centres(pixels)
    order = torch.hypot(x[None, :], y[:, None]).flatten().argsort()
    count = torch.searchsorted(kernel.flatten()[order].cumsum(0) / kernel.sum(), 0.5)
    return float(torch.sqrt((count + 0.5) * pixels.pitch**2 / math.pi))


def ray_and_wave(coefficients, distance: float, size: int = 81):
    """Kernels of rays and of waves, the pixels, and the blur radius by first order."""
    blur = float(RADIUS * SENSOR * (1 / distance - 1 / FOCUS))
    pixels = grid(scalar(2.7 * blur / size), size)
    rays = psf(traced(coefficients, distance), DRT(order=5), grid=pixels).kernel[0, 0]
    camera = WaveScene((even_powers(thin(coefficients)),), SENSOR, vector(distance), vector(0.55), pixels, exact=True)
    return rays, wave_psf(camera).kernel[0, 0], pixels, blur


@pytest.mark.parametrize("distance", [500.0, 200.0], ids=["5.7 waves", "23 waves"])
@pytest.mark.slow
def test_rays_and_waves_of_a_defocused_element_have_the_same_half_energy_radius(distance):
    """a/√2 of a uniform disc to 2 %; inside 0.6 a the curves agree to 2 %, at the rim diffraction moves 8 % and 5 %."""
    rays, waves, pixels, blur = ray_and_wave(singlet(), distance)
    assert half_energy_radius(rays, pixels) == pytest.approx(blur / math.sqrt(2), rel=0.02)
    assert half_energy_radius(waves, pixels) == pytest.approx(half_energy_radius(rays, pixels), rel=0.02)
    radii = blur * torch.linspace(0.1, 1.3, 25, dtype=torch.float64)
    gap = (encircled(rays, pixels, radii) - encircled(waves, pixels, radii)).abs()
    assert gap[radii < 0.6 * blur].max() < 0.02
    assert gap.max() < (0.1 if distance == 500 else 0.06)


@pytest.mark.slow
def test_rays_and_waves_of_an_element_of_extended_depth_have_the_same_encircled_energy():
    """30 waves of r⁴ on 23 waves of defocus: no sharp rim, and the curves agree to 2 % from 0.1 a on."""
    extended = singlet() + vector(0.0, -30 * WAVE / (PMMA - 1) / 2.5**4, 0.0, 0.0)
    rays, waves, pixels, blur = ray_and_wave(extended, 200.0, 121)
    radii = blur * torch.linspace(0.1, 1.3, 25, dtype=torch.float64)
    assert (encircled(rays, pixels, radii) - encircled(waves, pixels, radii)).abs().max() < 0.02


def test_a_height_map_of_pixels_is_traced_as_the_powers_it_samples():
    """The error of the spline, h⁴: spots to 10 nm, and one of a tilted map is where a prism of its slope puts it."""
    coefficients = singlet()
    pitch, size = 0.1, 56
    line = pitch * (torch.arange(size, dtype=torch.float64) - (size - 1) / 2)
    r2 = line**2 + line[:, None] ** 2
    maps = [0.5 + sag_of_powers(coefficients, r2)]
    maps.append(maps[0] + 1e-3 * line[:, None])
    pupil, _ = gauss_rings(5)
    landed = []
    for element in (
        even_powers(coefficients),
        *(Element(Pixels(h, scalar(pitch)), RADIUS, constant(PMMA)) for h in maps),
    ):
        lens_ = bridge.element_lens(
            element,
            sensor_distance=SENSOR,
            object_distance=FOCUS,
            wavelengths=vector(0.55),
            substrate=0.5 if isinstance(element.profile, EvenPowers) else 0.0,
        )
        view = scene(lens_, AXIS, vector(1000.0), vector(0.55))
        landed.append(wavefront_of(view, pupil))
    assert (landed[1].landing - landed[0].landing).abs().max() < 1e-5
    prism = (PMMA - 1) * 1e-3 * 35.5
    assert float(landed[2].centre[1]) == pytest.approx(prism, rel=2e-3)


@pytest.mark.slow
def test_a_height_map_is_filtered_once_however_often_it_is_traced(monkeypatch):
    """Gradients to the heights are those of differences of 10 nm."""
    filtered = []
    real = sag_terms._spline_coefficients
    monkeypatch.setattr(sag_terms, "_spline_coefficients", lambda heights: filtered.append(0) or real(heights))
    line = 0.25 * (torch.arange(22, dtype=torch.float64) - 10.5)
    heights = 0.5 + sag_of_powers(singlet(), line**2 + line[:, None] ** 2)
    pupil, _ = gauss_rings(4)

    def landed(map_):
        lens_ = bridge.element_lens(
            Element(Pixels(map_, scalar(0.25)), RADIUS, constant(PMMA)),
            sensor_distance=SENSOR,
            object_distance=FOCUS,
            wavelengths=vector(0.55),
        )
        view = scene(lens_, AXIS, vector(700.0), vector(0.55))
        return sum((wavefront_of(view, pupil).landing ** 2).sum() for _ in range(2))

    free = heights.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(landed(free), free)
    assert len(filtered) == 2  # along y and along x
    bump = torch.zeros_like(heights)
    bump[8, 13] = 1e-5
    slope = float((landed(heights + bump) - landed(heights - bump)) / 2e-5)
    assert float(gradient[8, 13]) == pytest.approx(slope, rel=1e-5)


# -- elements at the stop ----------------------------------------------------------------------------------------------


def slow_gauss(sensor: float = 57.475, diameter: float = 6.0, **others) -> Lens:
    """The double Gauss at f/16.6, near its best focus: aberrations of a tenth of a wave."""
    system = double_gauss(aperture=("entrance_pupil_diameter", diameter), **others)
    return with_sensor_distance(system, scalar(sensor))


def view_of(system: Lens, y: float = 0.0):
    return scene(system, vector(0.0, y)[:, None], FAR, system.wavelengths)


def rays_behind(view, k: int, pupil):
    """Rays of pupil points (2, P) behind surface k."""
    lens = aligned(view.lens, 3)
    rays = launch(lens, pupil, fields=view.fields, wavelengths=view.wavelengths)
    return rays_at(lens, view.wavelengths[:, None], (k,))(rays)[0]


def window(view, pitch=0.002, size=15):
    """About the chief ray, off the axis."""
    centre = wavefront_of(view, AXIS).centre[:2, 0, 0, 0].detach()
    return grid(scalar(pitch), size, centre)


FLAT = {
    "none": (),
    "powers": (even_powers(vector(0.0, 0.0)),),
    "rings": (Element(Rings(torch.zeros(9, dtype=torch.float64), scalar(0.3)), RADIUS, constant(1.5)),),
    "zernike": (noll(0.0, 0.0, 0.0, 0.0),),
    "pixels": (Element(Pixels(torch.zeros(8, 8, dtype=torch.float64), scalar(0.6)), RADIUS, constant(1.5)),),
    "two": (noll(0.0, 0.0), even_powers(vector(0.0))),
}


@pytest.mark.parametrize("elements", FLAT.values(), ids=FLAT)
@pytest.mark.parametrize("y", [0.0, 10.0])
def test_without_height_the_kernel_is_that_of_the_wave_model(elements, y):
    """Bit for bit where the element keeps the symmetry of the lens; on the axis else to the digits of torch's J₀.
    Pixels are summed over a grid, on which the rim of the pupil is exact to 5e-6."""
    view = view_of(slow_gauss(), y)
    pixels = window(view)
    expected = wave.kernels(view, pixels, order=1).kernel
    result = bridge.kernels(view, elements, pixels, order=1)
    has_pixels = any(isinstance(element.profile, Pixels) for element in elements)
    bound = 5e-6 if has_pixels else 2e-7 if y == 0 else 1e-14
    assert (result.kernel - expected).abs().max() <= bound * expected.max()
    if all(isinstance(element.profile, EvenPowers | Rings) for element in elements):
        assert torch.equal(result.kernel, expected)


def test_defocus_moves_the_best_focus_as_a_thin_lens_at_the_stop_does():
    """δz = -φ (y_stop/u')², φ = -2 (n - 1) c₁; odd part of ± a quarter wave, where the next order cancels."""
    system = slow_gauss()
    slope = 0.5 / float(first_order(system).paraxial_working_f_number)
    edge = float(rays_behind(view_of(system), 6, vector(0, 1)[:, None]).position[1])
    step = 0.25 * 0.53e-3
    power = 2 * step / edge**2
    shift = -power * (edge / slope) ** 2

    def best_focus(sign: int) -> float:
        element = even_powers(vector(-sign * step / edge**2 / (INDEX - 1)), index=INDEX)
        z = [57.475 + sign * shift + 0.3 * k for k in (-1, 0, 1)]
        a, b, c = (
            float(bridge.kernels(view_of(slow_gauss(s)), (element,), grid(0.001, 1), order=1).kernel.log()) for s in z
        )
        return z[1] + 0.5 * 0.3 * (a - c) / (a - 2 * b + c)

    assert best_focus(1) - best_focus(-1) == pytest.approx(2 * shift, rel=3e-3)


@pytest.mark.parametrize(("y", "waves"), [(0.0, 3.0), (10.0, 3.0), (0.0, 40.0)])
def test_tilt_shifts_the_kernel_as_the_chief_ray(y, waves):
    """A path that grows towards +y turns the chief ray at the stop towards +y: M' = M + slope of the path."""
    system, slope = slow_gauss(), waves * 0.53e-3 / 2.0
    view = view_of(system, y)
    tilt = noll(0.0, 0.0, slope * 2.5 / 2 / (INDEX - 1))
    at_stop = rays_behind(view, system.stop, AXIS)
    L, M, _ = at_stop.direction
    bent = torch.stack([L, M + slope, torch.sqrt(1 - L**2 - (M + slope) ** 2)])
    indices = media(system, system.wavelengths[0])
    landed = [
        trace_surfaces(
            system.surfaces[system.stop + 1 :],
            dataclasses.replace(at_stop, direction=direction),
            indices=indices[system.stop :],
            gap=system.surfaces[system.stop].thickness,
        ).position[:2, 0, 0, 0, 0]
        for direction in (at_stop.direction, bent)
    ]
    assert landed[1][1] > landed[0][1]
    here, there = (grid(scalar(0.002), 21, centre) for centre in landed)
    straight = wave.kernels(view, here, order=1).kernel
    shifted = bridge.kernels(view, (tilt,), there, order=1).kernel
    assert (shifted - straight).abs().sum() / straight.sum() < 0.003 * waves
    x, y_ = centres(here)
    for line, axis in ((x, -2), (y_, -1)):
        moved, kept = (float((k.sum(axis) * (line - line.mean())).sum() / k.sum()) for k in (shifted, straight))
        assert moved == pytest.approx(kept, abs=2e-4 * waves / 3)


def test_the_phase_of_the_element_counts_in_the_sampling():
    """20 waves over a window of two pixels, that alone would be content with a tenth of the rays."""
    view = view_of(slow_gauss())
    pixels = grid(scalar(0.004), 2)
    strong = (even_powers(vector(20 * 0.53e-3 / 1.796**2 / 0.5), index=INDEX),)
    skewed = (noll(0.0, 0.0, 0.0, 0.0, 20 * 0.53e-3 / math.sqrt(6) / 0.5 * (2.5 / 1.8) ** 2),)
    for elements in (strong, skewed):
        coarse, fine = (bridge.kernels(view, elements, pixels, order=order) for order in (1, 4))
        assert coarse.rays > 3 * bridge.kernels(view, (), pixels, order=1).rays
        assert (coarse.kernel - fine.kernel).abs().max() < 1e-3 * fine.kernel.max()


def test_a_wrapped_height_is_the_whole_one_at_its_design_wavelength():
    view = view_of(slow_gauss())
    glass = constant(INDEX)
    whole = Element(EvenPowers(vector(-6 * 0.53e-3 / 1.796**2 / 0.5)), RADIUS, glass)
    wrapped = dataclasses.replace(whole, period=period(glass, 0.53))
    pixels = grid(scalar(0.02), 9)
    expected = bridge.kernels(view, (whole,), pixels, order=1).kernel
    result = bridge.kernels(view, (wrapped,), pixels, order=1)
    assert (result.kernel - expected).abs().max() < 1e-6 * expected.max()
    assert result.rays > bridge.kernels(view, (whole,), pixels, order=1).rays


def test_flat_pixels_are_as_the_smooth_height_they_sample():
    """A tenth of a wave of astigmatism in pixels of a twentieth of the beam: kernels to 1 %."""
    view = view_of(slow_gauss(), 10.0)
    smooth = noll(0.0, 0.0, 0.0, 0.0, 0.0, 0.3 * 0.53e-3)
    line = 0.1 * (torch.arange(50, dtype=torch.float64) - 24.5)
    pixels = Pixels(height(smooth, line[None, :].expand(50, 50), line[:, None].expand(50, 50)), scalar(0.1))
    there = window(view)
    expected = bridge.kernels(view, (smooth,), there, order=1).kernel
    plain = bridge.kernels(view, (), there, order=1).kernel
    result = bridge.kernels(view, (dataclasses.replace(smooth, profile=pixels),), there, order=1).kernel
    assert (result - expected).abs().sum() < 0.01 * expected.sum()
    assert (plain - expected).abs().sum() > 0.05 * expected.sum()


def test_wavelengths_fields_and_distances_are_those_of_single_calls():
    system = slow_gauss(wavelengths=(0.46, 0.64))
    element = (noll(0.0, 0.0, 0.0, 3e-4, 0.0, 2e-4),)
    pixels = grid(scalar(0.004), 5)
    fields = vector(0.0, 0.0, 0.0, 0.01).reshape(2, 2)
    distances = vector(25e3, 50e3)
    result = bridge.kernels(scene(system, fields, distances, system.wavelengths), element, pixels, order=2).kernel
    assert result.shape == (2, 2, 2, 5, 5)
    for d, f, w in ((0, 0, 1), (1, 1, 0)):
        single = scene(system, fields[:, f : f + 1], distances[d : d + 1], system.wavelengths[w : w + 1])
        alone = bridge.kernels(single, element, pixels, order=2).kernel[0, 0, 0]
        assert (result[d, f, w] - alone).abs().max() < 1e-6 * alone.max()


def test_light_in_a_wide_window_is_all_the_light():
    """Parseval: an element moves light and loses none; 1 % lies in the tails beyond 0.3 mm."""
    view = view_of(slow_gauss())
    result = bridge.kernels(view, (noll(0.0, 0.0, 0.0, 5e-4, 0.0, 5e-4, 0.0, 4e-4),), grid(scalar(0.01), 61))
    assert 0.98 < float(result.energy) < 1.0


@pytest.mark.slow
def test_derivatives_by_heights_and_by_the_lens():
    coefficients = singlet()

    def computed(terms, heights, powers, curvature, sensor):
        front, back = bridge.surfaces_of(even_powers(powers), substrate=0.3)
        front = dataclasses.replace(front, curvature=curvature)
        stop = surface(None, sensor)
        system = lens([front, back, stop], stop=3, aperture=("float_by_stop", 0.4), wavelengths=(0.55,))
        elements = (
            Element(Zernike(terms), scalar(0.42), constant(INDEX)),
            Element(Pixels(heights, scalar(0.42)), scalar(0.42), constant(INDEX)),
        )
        there = grid(scalar(0.01), (2, 3), vector(0.0, 0.31))
        return bridge.kernels(view_of(system, 0.5), elements, there, order=-1).kernel

    inputs = [
        vector(0.0, 1e-4, 2e-4, 1e-4).requires_grad_(),
        vector(0.0, 2e-4, 3e-4, 1e-4).reshape(2, 2).requires_grad_(),
        coefficients[:2].clone().requires_grad_(),
        scalar(1e-3).requires_grad_(),
        scalar(36.8).requires_grad_(),
    ]
    assert float(computed(*inputs).detach().sum()) > 0.03
    assert gradcheck(computed, inputs, eps=1e-8, atol=1e-3, rtol=1e-4)


def plate(count: int, depth: float = 4e-4, *, seed: int = 0) -> Element:
    """Random heights of up to `depth` mm in pixels, `count` of them across 4 mm."""
    heights = depth * torch.rand(count, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return Element(Pixels(heights, scalar(4.0 / count)), scalar(2.0), constant(INDEX))


@pytest.mark.parametrize("y", [0.0, 10.0])
def test_pixels_agree_with_a_sum_over_many_rays(monkeypatch, y):
    """Random heights of a third of a wave on the grid of directions, against ten times as many rays as usual."""
    view, element = view_of(slow_gauss(), y), plate(12)
    pixels = window(view)
    result = bridge.kernels(view, (element,), pixels)
    monkeypatch.setattr(bridge, "_directions", lambda *_: None)
    monkeypatch.setattr(bridge, "_PER_PIXEL", 100.0)
    of_rays = bridge.kernels(view, (element,), pixels)
    assert of_rays.rays > 50_000
    assert float((result.kernel - of_rays.kernel).abs().sum() / of_rays.energy) < 1e-3
    assert float(abs(result.energy / of_rays.energy - 1)) < 4e-4


def test_pixels_converge_with_the_order():
    """Of two plates in contact with a smooth element four cells to a pixel leave 1e-3 of the light."""
    view, elements = view_of(slow_gauss(), 10.0), (plate(60), plate(45, seed=1), noll(0.0, 0.0, 0.0, 2e-4))
    pixels = window(view)
    fine = bridge.kernels(view, elements, pixels, order=5).kernel
    for order, bound in ((-2, 3e-2), (0, 2e-3), (2, 1e-3)):
        coarse = bridge.kernels(view, elements, pixels, order=order).kernel
        assert float((coarse - fine).abs().sum() / fine.sum()) < bound, order


def test_derivatives_by_flat_heights_know_every_pixel():
    """Heights of 0, where a design begins, have no steps that a choice of rays could see."""
    view, heights = view_of(slow_gauss()), torch.zeros(60, 60, dtype=torch.float64)
    pixels, gradients = window(view), []
    for order in (0, 2):
        numbers = heights.clone().requires_grad_()
        element = Element(Pixels(numbers, scalar(4.0 / 60)), scalar(2.0), constant(INDEX))
        kernel = bridge.kernels(view, (element,), pixels, order=order).kernel
        (slope,) = torch.autograd.grad(kernel.square().sum() / kernel.detach().square().sum(), numbers)
        gradients.append(slope)
    inside = torch.hypot(*torch.meshgrid(*[torch.arange(60) - 29.5] * 2, indexing="ij")) < 25
    assert bool((gradients[0][inside] != 0).all())
    assert float((gradients[0] - gradients[1]).abs().max() / gradients[1].abs().max()) < 5e-3


def test_derivatives_of_pixels_by_the_lens():
    """By a curvature and a factor of all heights, first and second, of kernels at two distances off the axis."""
    lens_of, heights = slow_gauss(), plate(40).profile.heights.clone()

    def computed(change: torch.Tensor) -> torch.Tensor:
        surfaces = list(lens_of.surfaces)
        surfaces[2] = dataclasses.replace(surfaces[2], curvature=surfaces[2].curvature * (1 + change[0]))
        system = dataclasses.replace(lens_of, surfaces=tuple(surfaces))
        profile = Pixels(heights * (1 + change[1]), scalar(0.1))
        view = scene(system, vector(0.0, 8.0)[:, None], vector(25e3, 60e3), system.wavelengths)
        element = Element(profile, scalar(2.0), constant(INDEX))
        return (1e3 * bridge.kernels(view, (element,), grid(scalar(0.004), 5, chief), order=-2).kernel).square().sum()

    chief = vector(0.0, 8.0)
    chief[1] = float(window(view_of(lens_of, 8.0)).centre.flatten()[1])
    at, step = vector(0.0, 0.0).requires_grad_(), 1e-6
    (slope,) = torch.autograd.grad(computed(at), at, create_graph=True)
    second = [torch.autograd.grad(part, at, retain_graph=True)[0] for part in slope]
    for number in range(2):
        moved = [at.detach().clone() for _ in range(2)]
        moved[0][number] += step
        moved[1][number] -= step
        slopes, values = [], []
        for place in moved:
            place.requires_grad_()
            values.append(computed(place))
            slopes.append(torch.autograd.grad(values[-1], place)[0])
        difference = float((values[0] - values[1]).detach()) / (2 * step)
        assert float(slope[number].detach()) == pytest.approx(difference, rel=1e-5)
        assert second[number].tolist() == pytest.approx(((slopes[0] - slopes[1]) / (2 * step)).tolist(), rel=1e-3)


def test_pixels_in_a_clipped_beam_are_summed_over_rays():
    system = slow_gauss()
    surfaces = list(system.surfaces)
    surfaces[1] = dataclasses.replace(surfaces[1], apertures=(Aperture("circular", (0.0, 1.5)),))
    view = view_of(dataclasses.replace(system, surfaces=tuple(surfaces)))
    assert bridge._directions(view) is None
    assert bridge._directions(view_of(system)) is not None
    result = bridge.kernels(view, (plate(12, 0.0),), window(view), order=1)
    expected = wave.kernels(view, window(view), order=1).kernel
    assert float((result.kernel - expected).abs().max()) < 2e-7 * float(expected.max())


def test_elements_too_fine_are_refused():
    fine = Element(Pixels(torch.rand(1356, 1356, dtype=torch.float64), scalar(0.00369)), RADIUS, constant(1.5))
    rings = Element(Rings(torch.rand(4000, dtype=torch.float64), scalar(0.00063)), RADIUS, constant(1.5))
    for element, order, counted in ((fine, 2, "directions, more than 4,096"), (rings, 0, "rays, more than 400000")):
        with pytest.raises(bridge.TooCoarse, match=rf"{counted}.* wave camera"):
            bridge.kernels(view_of(slow_gauss()), (element,), grid(scalar(0.005), 3), order=order)


def test_elements_smaller_than_the_beam_and_stops_in_glass_are_refused():
    with pytest.raises(ValueError, match=r"beam at the stop has a radius of 1\.7"):
        bridge.kernels(view_of(slow_gauss()), (noll(0.0, radius=1.0),), grid(scalar(0.005), 3))
    in_glass = lens([surface(0.02, 2.0, 1.5), surface(None, 2.0, 1.5), surface(-0.02, 40.0)], stop=2)
    with pytest.raises(ValueError, match="surface 2, borders on another medium"):
        bridge.kernels(view_of(in_glass), (noll(0.0, radius=9.0),), grid(scalar(0.005), 3))


def test_an_element_at_the_stop_of_a_singlet_is_as_its_powers_on_the_singlet_itself():
    """Three waves of r⁴ as a thin element behind the traced PMMA lens, or ground into its surface: kernels to 5 %."""
    coefficients, added = singlet(), vector(0.0, 3 * WAVE / 2.5**4, 0.0, 0.0)
    kernels = []
    pixels = grid(scalar(0.004), 25)
    for powers in (coefficients, coefficients + added / (PMMA - 1)):
        front, back = bridge.surfaces_of(even_powers(powers), substrate=0.3)
        stop = surface(None, 35.5)
        system = lens([front, back, stop], stop=3, object_distance=1000.0, aperture=("float_by_stop", 2.45))
        view = scene(system, AXIS, vector(1000.0), vector(0.55))
        kernels.append([bridge.kernels(view, e, pixels).kernel for e in ((), (even_powers(added, index=2.0),))])
    (plain, hybrid), (ground, _) = kernels
    assert (hybrid - ground).abs().sum() < 0.05 * ground.sum()
    assert (plain - ground).abs().sum() > 0.5 * ground.sum()
