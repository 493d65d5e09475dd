"""`wave` and `fourier` as models of `psf`: the contract of every kernel, derivatives, single precision, mirrors."""

import math
import warnings

import problems
import pytest
import torch
from problems import field, number, scene_of, vector

from raytrace.materials.glass import constant
from raytrace.maths.numerics import to
from raytrace.maths.sampling import Grid, gauss_rings, grid
from raytrace.psf_models import NotConverged, fourier, psf, wave
from raytrace.psf_models.dft import huygens
from raytrace.psf_models.strehl import strehl
from raytrace.system.lens import Lens
from raytrace.system.surface import Aperture
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import Scene, scene
from raytrace.tracing.wavefront import wavefront_of

WAVES = ("fourier", "wave")
DEAR = ("conic", "thickness", "sensor", "pitch")  # numbers of the wave model in the slow suite; others alike are tested
MODULES = {"fourier": fourier, "wave": wave}


def slow(stop: float | None = None, sensor: float = 57.8817685, beam: float = 8.0) -> Lens:
    """The double Gauss with a narrow beam, sharp at 25 m; `stop`: semi-diameter in mm of an aperture that clips it."""
    lens = problems.double_gauss(aperture=("entrance_pupil_diameter", beam)).at(sensor_distance=sensor)
    return lens if stop is None else lens.replace(6, apertures=problems.vignetting_aperture(stop))


def light_at(model: str, s: Scene) -> torch.Tensor:
    """(2,) mm, where the chief ray of a scene of one kernel lands."""
    if model == "fourier":
        return fourier.paraxial(s).chief.reshape(2).detach()
    return wavefront_of(s, torch.zeros(2, 1, dtype=torch.float64)).centre[:2].reshape(2).detach()


# Contract -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", WAVES)
def test_a_batch_is_its_single_kernels_in_the_order_asked_for(model):
    lens, distances, angles = slow(beam=3.0), (25e3, math.inf), (0.0, 2.0)
    options = {"model": model, "grid": grid(0.01, 5), "tol": 1e-2, "center": "chief"}
    whole = psf(lens, object_distances=number(distances), fields=field(*angles), **options)
    for d, distance in enumerate(distances):
        for f, angle in enumerate(angles):
            one = psf(lens, object_distances=number([distance]), fields=field(angle), **options)
            # Each meets the tolerance by itself, the batch by its worst entry.
            assert (whole.kernel[d, f] - one.kernel[0, 0]).abs().sum() < 1e-2 * one.energy
            torch.testing.assert_close(whole.centroid[:, d, f], one.centroid[:, 0, 0], atol=1e-9, rtol=0)


@pytest.mark.parametrize("model", WAVES)
def test_centre_of_the_window_is_an_absolute_place_on_the_sensor(model):
    """Moved by a pixel, the window shows the same light a pixel further on."""
    s, pitch = scene_of(slow(), 3.0, 1e4), number(0.006)
    there = light_at(model, s)
    one, other = (MODULES[model].kernels(s, Grid(pitch, 7, 7, there + k * pitch)).kernel[0, 0, 0] for k in (0, 1))
    assert float(one.sum()) > 0.5
    assert (one[1:, 1:] - other[:-1, :-1]).abs().max() < 1e-4 * one.max()


@pytest.mark.parametrize("model", WAVES)
def test_polychromatic_kernel_is_the_weighted_sum(model):
    options = {"fields": field(2.0), "object_distances": number([1e4]), "grid": grid(0.01, 5), "tol": 1e-4}
    options |= {"center": "chief"}
    lens = slow(beam=3.0)
    blue, red = (psf(lens, model, wavelengths=number([w]), **options) for w in (0.48, 0.65))
    both = psf(lens, model, wavelengths=number([0.48, 0.65]), wavelength_weights=number([3.0, 1.0]), **options)
    torch.testing.assert_close(both.kernel, 0.75 * blue.kernel + 0.25 * red.kernel, atol=1e-4, rtol=0)
    assert (blue.kernel - red.kernel).abs().sum() > 0.01


def test_energy_is_the_transmitted_share():
    """Of an aperture that clips the beam, by 10,000 rays; the window misses the tail of the rings, 2/(π v) = 1 %."""
    s = scene_of(slow(stop=2.0), 3.0, 25e3)
    share = float(wavefront_of(s, *gauss_rings(50, 200)).energy.sum())
    assert 0.2 < share < 0.8
    result = psf(slow(stop=2.0), "wave", fields=field(3.0), grid=grid(0.025, 11), center="chief",
                object_distances=number([25e3]), tol=1e-2)  # fmt: skip
    assert -3e-3 < share - float(result.energy) < 0.015


def test_one_empty_kernel_of_a_batch_is_zero_with_derivative_zero():
    curvature = slow().surfaces[3].curvature.clone().requires_grad_()
    # A hole in front passes the beam of the axis, not that of 40°.
    lens = slow().replace(1, apertures=problems.vignetting_aperture(5.0)).replace(3, curvature=curvature)
    result = psf(lens, "wave", fields=field(0.0, 40.0), object_distances=number([1e4]), grid=grid(0.01, 5), tol=0.1,
                center="chief")  # fmt: skip
    assert float(result.energy[0, 0].detach()) > 0.5
    assert float(result.energy[0, 1].detach()) == 0
    moments = (t[..., 0] for t in (result.centroid, result.covariance, result.ray_centroid, result.ray_covariance))
    for tensor in (result.kernel, result.energy, result.error, result.residual, *moments):
        assert bool(torch.isfinite(tensor).all())
    (empty,) = torch.autograd.grad(result.kernel[0, 1].square().sum(), curvature, retain_graph=True)
    assert float(empty) == 0
    (whole,) = torch.autograd.grad(result.kernel.square().sum(), curvature)
    assert math.isfinite(float(whole))
    assert float(whole) != 0


@pytest.mark.parametrize("model", WAVES)
def test_a_positive_field_lands_at_positive_y_at_f_tan_theta(model):
    """To the distortion of the design at 1°, 2e-5, and a fiftieth of a pixel."""
    lens = slow(sensor=57.4851290372)
    height = float(first_order(lens).effective_focal_length) * math.tan(math.radians(1.0))
    window = grid(number(0.01), 7, vector(0.0, height))
    result = psf(lens, model, fields=field(1.0), object_distances=number([math.inf]), grid=window, tol=0.01)
    assert float(result.centroid[1, 0, 0]) == pytest.approx(height, abs=1.5e-3)
    assert float(result.centroid[0, 0, 0]) == pytest.approx(0.0, abs=1e-12)
    assert float(result.kernel[0, 0, 2:5, 2:5].sum()) > 0.7


@pytest.mark.parametrize("model", WAVES)
def test_a_window_off_the_light_has_almost_no_energy(model):
    """Of the rings at v = 100 Airy units, 2/(π v) lies outside, and of that a window of one part in a thousand."""
    s = scene_of(slow(beam=4.0), 0.0, 25e3)
    result = psf(slow(beam=4.0), model, fields=field(0.0), object_distances=number([25e3]), tol=0.1,
                grid=Grid(number(0.01), 3, 3, light_at(model, s) + vector(0.4, 0.0)))  # fmt: skip
    assert 0 <= float(result.energy) < 1e-4
    assert bool(torch.isfinite(result.kernel).all())


def test_a_tolerance_below_rounding_is_reported():
    with pytest.warns(NotConverged, match=r"wave: the estimated error .* 1e-09"):
        result = psf(slow(beam=3.0), "wave", fields=field(0.0), object_distances=number([25e3]), grid=grid(0.01, 3),
                    tol=1e-9)  # fmt: skip
    assert 1e-9 < float(result.error) < 1e-6


def test_a_looser_tolerance_takes_fewer_rays():
    options = {"fields": field(5.0), "object_distances": number([25e3]), "grid": grid(0.005, 9), "center": "chief"}
    loose, tight = (psf(slow(), "wave", tol=tol, **options) for tol in (0.1, 1e-6))
    assert loose.rays < 0.8 * tight.rays
    assert tight.error <= 1e-6 < loose.error <= 0.1
    assert (loose.kernel - tight.kernel).abs().sum() / tight.energy <= loose.error


# Single precision -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", WAVES)
@pytest.mark.parametrize("distance", [25e3, 1e12, math.inf])
def test_single_precision_keeps_the_kernel(model, distance):
    """Within 1e-6 in L1 of the same rounded numbers in double precision, at any distance: no path is subtracted."""
    narrow = to(slow(), dtype=torch.float32)
    s = scene(narrow, field(3.0).float(), number([distance]).float(), narrow.wavelengths)
    wide = to(s, dtype=torch.float64)
    window = to(Grid(number(0.005), 9, 9, light_at(model, wide)), dtype=torch.float32)
    one = MODULES[model].kernels(s, window)
    other = MODULES[model].kernels(wide, to(window, dtype=torch.float64))
    assert one.kernel.dtype == one.centroid.dtype == one.covariance.dtype == torch.float32
    assert bool(torch.isfinite(one.kernel).all())
    assert (one.kernel - other.kernel).abs().sum() < 1e-6 * other.kernel.sum()


def test_single_precision_keeps_the_strehl_ratio():
    s = scene_of(slow(sensor=57.6), 5.0, 25e3)
    rounded = to(s, dtype=torch.float32)
    narrow, wide = strehl(rounded), strehl(to(rounded, dtype=torch.float64))
    assert narrow.dtype == torch.float32
    assert 0.1 < float(narrow) < 0.9
    assert abs(float(narrow) - float(wide)) < 1e-6


# Exact problems -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("obstruction", [0.0, 0.4])
def test_a_parabolic_mirror_is_perfect(obstruction):
    """The medium behind a mirror is that before it. Airy's peak π a² (1 - ε²)², a = R/(λ f), of an annulus of light
    (1 - ε²); NA² = 1e-4 limits the formula."""
    focus, radius = 100.0, 1.0
    hole = (Aperture("circular", (obstruction * radius, 5.0)),) if obstruction else ()
    mirror = problems.surface(-0.5 / focus, -focus, problems.MIRROR, conic=-1.0, apertures=hole)
    s = scene_of(problems.lens([mirror], aperture=("entrance_pupil_diameter", 2 * radius)), 0.0, math.inf)
    assert float(strehl(s)) == pytest.approx(1.0, abs=1e-6)
    pixel = 1e-4
    peak = float(wave.kernels(s, grid(pixel, 1)).kernel.sum()) / pixel**2
    a = radius / (0.55e-3 * focus)
    assert peak == pytest.approx(math.pi * a**2 * (1 - obstruction**2) ** 2, rel=3e-4)


@pytest.mark.parametrize("defocus", [0.15, 0.5, 1.5])
def test_the_residual_is_the_error_of_debyes_integral(defocus):
    """Defocused 11 mm behind the exit pupil, by a phase of up to 0.16 rad: against wavelets of exact distances."""
    focus, diameter = 12.0, 2.4
    surfaces = [problems.surface(None, 1.0, 1.5), problems.surface(-2 / focus, focus - defocus, conic=-2.25)]
    lens = problems.lens(surfaces, stop=2, aperture=("entrance_pupil_diameter", diameter))
    s = scene_of(lens, 0.0, math.inf)
    s = Scene(s.lens, s.fields + vector(0.01, 0.0)[:, None], s.wavelengths)  # no symmetry: every ray is there
    reach = 0.1 * defocus + 0.011
    light = wave.waves(s, 1.1 * reach)
    offset = torch.linspace(-reach, reach, 41, dtype=torch.float64)
    U = wave.amplitude(light, offset, vector(0.0))[0, 0, 0, 0]
    front, points = light.wavefront, torch.stack([offset, 0 * offset, 0 * offset])
    radius, wavelength = front.radius[0, 0, 0], 1e-3 * front.wavelength[0]
    q = -radius * front.direction[:, 0, 0, 0]
    path, amplitude = front.opd[0, 0, 0], light.amplitude[0, 0, 0]
    direct = huygens(points, q, radius, path=path, amplitude=amplitude, wavelength=wavelength) / wavelength
    ours, exact = (a.real**2 + a.imag**2 for a in (U, direct))
    wrong = float((ours - exact).abs().sum() / exact.sum())
    window = Grid(number(2 * reach / 45), 45, 45, light_at("wave", s))
    residual = float(wave.kernels(s, window, order=-2).residual)
    assert wrong < residual < 10 * wrong


# Derivatives ----------------------------------------------------------------------------------------------------------

#: The numbers of a small lens with a clipping aperture, and the step of a difference for each.
NUMBERS = {
    "curvature": (0.02, 1e-7),
    "conic": (-0.3, 1e-4),
    "coefficient": (1e-6, 1e-8),
    "thickness": (3.0, 1e-5),
    "index": (1.5, 1e-6),
    "sensor": (56.0, 1e-5),
    "pitch": (0.02, 1e-7),
    "centre": (4.32, 1e-6),
    "distance": (3e3, 1e-2),
    "field": (4.0, 1e-5),
    "diameter": (2.0, 1e-5),
}


def small_kernel(model: str, rim: float | None = 0.9, **changed) -> torch.Tensor:
    """Nine pixels off the axis, with a third of the beam clipped behind the lens."""
    value = {name: changed.get(name, number(start)) for name, (start, _) in NUMBERS.items()}
    clip = () if rim is None else problems.vignetting_aperture(rim)
    front = problems.surface(
        value["curvature"],
        value["thickness"],
        constant(value["index"]),
        conic=value["conic"],
        coefficients=torch.stack([number(0.0), value["coefficient"]]),
    )
    rear = problems.surface(-0.01, 4.0)
    stop = problems.surface(None, value["sensor"], apertures=clip)
    lens = problems.lens([front, rear, stop], aperture=("entrance_pupil_diameter", value["diameter"]))
    angle = torch.stack([number(0.0), value["field"]])[:, None]
    s = scene(lens, angle, value["distance"][None], lens.wavelengths)
    window = Grid(value["pitch"], 3, 3, torch.stack([number(0.002), value["centre"]]))
    return MODULES[model].kernels(s, window).kernel


@pytest.mark.parametrize(
    ("model", "name"),
    [
        pytest.param(model, name, marks=pytest.mark.slow if model == "wave" and name in DEAR else ())
        for model in WAVES
        for name in NUMBERS
    ],
)
def test_gradients_with_rays_vignetted(model, name):
    """Central differences agree to 1e-5 of the largest derivative of a pixel; a paraxial lens has no aspheres."""
    start, step = NUMBERS[name]
    at = number(start)
    derivative = torch.func.jacrev(lambda t: small_kernel(model, **{name: t}))(at)
    above, below = (small_kernel(model, **{name: number(start + sign * step)}) for sign in (1, -1))
    difference = (above - below) / (2 * step)
    assert float(above.sum()) > 0.05
    assert (float(derivative.abs().max()) > 0) == (model == "wave" or name not in ("conic", "coefficient"))
    assert (derivative - difference).abs().max() <= 1e-5 * difference.abs().max()


@pytest.mark.parametrize("model", ["fourier", pytest.param("wave", marks=pytest.mark.slow)])
def test_transforms_of_torch_func_give_the_same_derivative(model):
    def total(curvature):
        return small_kernel(model, curvature=curvature).square().sum()

    at = number(NUMBERS["curvature"][0])
    (expected,) = torch.autograd.grad(total(leaf := at.clone().requires_grad_()), leaf)
    assert float(expected) != 0
    result = {
        "grad": torch.func.grad(total)(at),
        "jvp": torch.func.jvp(total, (at,), (torch.ones_like(at),))[1],
        "jacrev": torch.func.jacrev(total)(at),
        "jacfwd": torch.func.jacfwd(total)(at),
    }
    for name, derivative in result.items():
        assert float(derivative) == pytest.approx(float(expected), rel=1e-7), name


def test_a_rim_that_clips_moves_with_the_lens():
    """The derivative with the rim held still, as by blocked rays alone, would be another one."""
    at = number(NUMBERS["thickness"][0])
    clipped, whole = (
        torch.func.grad(lambda t, rim=rim: small_kernel("wave", rim, thickness=t).sum())(at) for rim in (0.9, None)
    )
    assert float((clipped - whole).abs()) > 1e-3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert math.isfinite(float(clipped))
