"""The wavefront of a scene: perfect lenses, known aberrations, objects at any distance."""

import math

import problems
import pytest
import torch
from differences import gradcheck
from problems import vector

import raytrace as rt
from raytrace.maths.numerics import dot
from raytrace.maths.sampling import gauss_rings
from raytrace.system.lens import with_sensor_distance
from raytrace.system.phases import IdealLens
from raytrace.system.surface import Aperture
from raytrace.tracing.scene import scene, trace_scene
from raytrace.tracing.spot import EmptySpot
from raytrace.tracing.wavefront import (
    clear_wavefront,
    peak_to_valley,
    rms,
    wavefront_of,
    without,
    zernike_coefficients,
)

WAVE = 0.53e-3  # mm
POINTS, WEIGHTS = gauss_rings(8, 32)


def gauss(distances, y=(0.0,), sensor=57.8817685, **others):
    lens = with_sensor_distance(problems.double_gauss(**others), torch.as_tensor(sensor, dtype=torch.float64))
    return scene(lens, torch.stack([torch.zeros(len(y)).double(), vector(*y)]), vector(*distances), lens.wavelengths)


def perfect(sensor, **others):
    return problems.scene_of(problems.plano_hyperbolic(sensor - 50.0, **others))


def test_a_perfect_lens_has_no_opd():
    front = wavefront_of(perfect(50.0), POINTS, WEIGHTS)
    assert front.opd.abs().max() < 1e-11 * WAVE
    assert front.radius[0, 0, 0] > 0
    assert abs(front.energy.sum() - 1) < 1e-14


@pytest.mark.parametrize("angle", [0.0, 10.0])
def test_the_sphere_reaches_from_the_pupil_s_plane_along_the_chief_ray(angle):
    """The exit pupil is the stop itself, 50 mm before the sensor: R = 50 mm / cos of the chief ray."""
    lens = problems.lens([problems.surface(0.01, 5.0, 1.5), problems.surface(None, 50.0)], stop=2)
    s = scene(lens, vector(0.0, angle)[:, None], vector(math.inf), lens.wavelengths)
    front = wavefront_of(s, POINTS, WEIGHTS)
    centre_ray = trace_scene(s, torch.zeros(2, 1, dtype=torch.float64))
    assert front.radius.item() == pytest.approx(50.0 / centre_ray.direction[2].item(), rel=1e-12)


def plate(*apertures: Aperture) -> rt.Lens:
    """A plate that adds a r⁴, about two waves at the rim, in front of an ideal lens of 1 m; pupil of radius 10 mm."""
    rows = [
        dict(radius=math.inf, coefficients=[0.0, 2e-7], thickness=0.0, glass=1.5, apertures=apertures),
        dict(radius=math.inf, thickness=0.0),
        dict(radius=math.inf, thickness=1000.0, phase=IdealLens(0.001, 0.001)),
    ]
    return rt.lens(rows, stop=1, entrance_pupil_diameter=20, wavelengths=[0.5])


@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.33, 0.5])
def test_the_rms_of_an_obscured_pupil_is_that_of_the_annulus(ratio):
    """ρ⁴ over ε < ρ < 1 by the moments of u = ρ²: <u²> and <u⁴>."""
    lens = plate(Aperture("circular", (0.0, 10 * ratio), True)) if ratio else plate()
    mean, square = ((1 - ratio ** (2 * k)) / k / (1 - ratio**2) for k in (3, 5))
    expected = 2 * math.sqrt(square - mean**2)
    assert rt.wavefront(lens, size=9).rms.item() == pytest.approx(expected, rel=3e-4)
    assert rt.rms_over_field(lens, fields=[0.0]).rms.item() == pytest.approx(expected, rel=3e-4)


def test_the_rms_of_a_rectangular_pupil_moves_with_its_edges():
    """2 ρ⁴ over |x| < 0.7, |y| < b of the pupil, against midpoints of a dense grid and differences."""

    def rms_of(height):
        system = problems.scene_of(plate(Aperture("rectangular", (7.0, height))))
        return rms(clear_wavefront(system, 8, 32)).sum() / 0.5e-3

    x, y = (torch.arange(400, dtype=torch.float64) + 0.5) / 400 * torch.tensor([[0.7], [0.4]])
    expected = 2 * ((x[:, None] ** 2 + y**2) ** 2).std(correction=0)
    height, step = torch.tensor(4.0, dtype=torch.float64, requires_grad=True), 1e-3
    found = rms_of(height)
    first = torch.autograd.grad(found, height, create_graph=True)[0]
    second = torch.autograd.grad(first, height)[0]
    low, high = rms_of(4.0 - step).item(), rms_of(4.0 + step).item()
    assert found.item() == pytest.approx(expected.item(), rel=5e-4)
    assert first.item() == pytest.approx((high - low) / (2 * step), rel=1e-6)
    assert second.item() == pytest.approx((high - 2 * found.item() + low) / step**2, rel=1e-3)


def test_defocus_of_a_perfect_lens():
    """A sphere about the focus seen from one about a point Δ behind it: OPD = -Δ (1 - cos θ) to first order in Δ.

    Light of the upper half has crossed the axis and lands below: its path shortens towards the top.
    """
    shift = 1e-3
    front = wavefront_of(perfect(50.0 + shift), POINTS, WEIGHTS)
    _, _, N = front.direction[:, 0, 0, 0]
    assert (front.opd[0, 0, 0] + shift * (1 - N)).abs().max() < 1e-4 * shift * (1 - N).max()
    c = zernike_coefficients(front, 11)[0, 0, 0]
    assert c[3] == pytest.approx(-shift * float(1 - N.min()) / (2 * math.sqrt(3)), rel=0.03)
    assert c[[1, 2, 4, 5, 6, 7, 8, 9]].abs().max() < 1e-9 * WAVE


@pytest.mark.parametrize("angle", [0.0, 10.0])
def test_any_object_distance_keeps_its_digits(angle):
    """From 10¹² mm the wave is the plane one but for its curvature r²/2D over the pupil, 3e-7 waves; 1e-10 of noise."""
    far, infinite = (wavefront_of(gauss([d], (angle,)), POINTS, WEIGHTS) for d in (1e12, math.inf))
    difference = far.opd - infinite.opd
    assert difference.abs().max() < 3e-7 * WAVE
    if angle == 0:
        expected = ((POINTS * 33.33 / 2) ** 2).sum(0) / 2e12
        assert (difference[0, 0, 0].abs() - expected).abs().max() < 1e-10 * WAVE


def test_opd_does_not_change_with_the_batch():
    distances, angles = (1e4, 25e3), (0.0, 10.0)
    together = wavefront_of(gauss(distances, angles), POINTS, WEIGHTS)
    assert together.opd.shape == (2, 2, 1, 256)
    for d, distance in enumerate(distances):
        for f, angle in enumerate(angles):
            alone = wavefront_of(gauss([distance], (angle,)), POINTS, WEIGHTS)
            assert (together.opd[d, f] - alone.opd[0, 0]).abs().max() < 1e-11 * WAVE


def test_removing_terms_and_statistics():
    front = wavefront_of(gauss([25e3], (0.0, 10.0)), POINTS, WEIGHTS)
    c = zernike_coefficients(front, 37)
    assert (without(front, 1) - (front.opd - (WEIGHTS * front.opd).sum(-1, keepdim=True))).abs().max() < 1e-12
    fewer = [torch.sqrt((WEIGHTS * without(front, n) ** 2).sum(-1)) for n in (1, 3, 4)]
    assert (fewer[0] - rms(front)).abs().max() < 1e-12
    assert (fewer[1] ** 2 - (fewer[0] ** 2 - c[..., 1] ** 2 - c[..., 2] ** 2)).abs().max() < 1e-12
    assert (fewer[2] ** 2 - (fewer[1] ** 2 - c[..., 3] ** 2)).abs().max() < 1e-12
    assert (peak_to_valley(front) == front.opd.amax(-1) - front.opd.amin(-1)).all()
    # 37 terms leave the orders above 7: far below a hundredth of a wave on this lens.
    assert torch.sqrt((WEIGHTS * without(front, 37) ** 2).sum(-1)).max() < 0.01 * WAVE


def test_rays_land_where_the_slope_of_the_opd_says():
    """∂W/∂p = -(x_ray - x)·∂(L, M)/∂p: a longer path at the top sends the light up."""
    step = 1e-4
    base = torch.tensor([[0.0, 0.3, -0.5], [0.6, -0.4, 0.2]], dtype=torch.float64)
    shifted = torch.cat([base + torch.tensor([[0.0], [s]]) for s in (-step, step)], 1)
    middle, ends = (wavefront_of(gauss([25e3], (7.0,), 57.7), p) for p in (base, shifted))
    low, high = slice(0, 3), slice(3, 6)
    slope = (ends.opd[..., high] - ends.opd[..., low]) / (2 * step)
    turn = (ends.direction[:2, ..., high] - ends.direction[:2, ..., low]) / (2 * step)
    expected = -(middle.landing * turn).sum(0)
    assert (slope - expected).abs().max() < 2e-3 * slope.abs().max()


def test_vignetting_and_a_blocked_chief_ray():
    """An obscuration takes the light, not the reference: the same OPD where light passes, none elsewhere."""
    lens = problems.double_gauss()
    surfaces = list(lens.surfaces)
    clip = (Aperture("circular", (0.0, 4.0), obscures=True), Aperture("circular", (0.0, 8.0)))
    surfaces[6] = problems.surface(None, 12.4281, apertures=clip)
    blocked = type(lens)(**{**{f: getattr(lens, f) for f in lens.__slots__}, "surfaces": tuple(surfaces)})
    for angle in (0.0, 5.0):
        field = vector(0.0, angle)[:, None]
        free, front = (
            wavefront_of(scene(x, field, vector(25e3), x.wavelengths), POINTS, WEIGHTS) for x in (lens, blocked)
        )
        assert 0.2 < front.energy.sum() < 0.7
        assert (torch.where(front.valid, front.opd - free.opd, 0.0) == 0).all()
        assert (front.opd[~front.valid] == 0).all()
        assert (front.centre == free.centre).all()
        assert torch.isfinite(rms(front)).all()


def test_a_field_without_light_has_no_wavefront_and_leaves_the_others_their_derivatives():
    """0 waves with derivative 0 would be what a merit likes best."""
    lens = problems.double_gauss()
    bent = lens.replace(1, curvature=lens.surfaces[1].curvature.clone().requires_grad_())
    fields = torch.tensor([[0.0, 0.0], [0.0, 85.0]], dtype=torch.float64)
    both, one = (
        wavefront_of(scene(bent, f, vector(25e3), bent.wavelengths), POINTS, WEIGHTS) for f in (fields, fields[:, :1])
    )
    for measure in (rms, peak_to_valley):
        assert measure(both)[0, :, 0].isnan().tolist() == [False, True]
        slopes = [
            torch.autograd.grad(measure(front).nansum(), bent.surfaces[1].curvature, retain_graph=True)[0]
            for front in (both, one)
        ]
        assert slopes[0].item() == pytest.approx(slopes[1].item(), rel=1e-9)
        with pytest.raises(EmptySpot):
            measure(both, empty="error")


def test_vignetting_factors_shrink_the_beam_and_its_light():
    factors = torch.tensor([[0.0], [0.1], [0.2], [0.3], [0.0]], dtype=torch.float64)
    s = gauss([25e3], (10.0,), field=problems.fields("angle", (10.0,), vignetting=factors))
    assert abs(wavefront_of(s, POINTS, WEIGHTS).energy.sum() - 0.8 * 0.7) < 1e-12


def test_a_plane_reference_for_a_telecentric_lens():
    """The stop in the front focal plane: the exit pupil lies at infinity, and every number stays finite."""
    front_focus = 50.0
    surfaces = [problems.surface(None, front_focus), problems.surface(0.04, 0.0, 1.5), problems.surface(0.0, 48.0)]
    lens = problems.lens(surfaces, aperture=("entrance_pupil_diameter", 4.0))
    s = scene(lens, vector(0.0, 3.0)[:, None], vector(math.inf), lens.wavelengths)
    front = wavefront_of(s, POINTS, WEIGHTS)
    assert front.radius.abs().min() > 1e12
    assert torch.isfinite(front.opd).all()
    assert (dot(front.direction, front.direction) - 1).abs().max() < 1e-14
    assert rms(front).max() < 20 * WAVE


def test_gradients_with_a_vignetted_ray():
    def statistics(curvature, sensor):
        surfaces = [
            problems.surface(curvature, 3.0, 1.5, apertures=problems.vignetting_aperture(2.3)),
            problems.surface(-0.01, sensor),
        ]
        lens = problems.lens(surfaces, aperture=("entrance_pupil_diameter", 5.0))
        s = scene(lens, vector(0.0, 5.0)[:, None], vector(1e12), lens.wavelengths)
        front = wavefront_of(s, *gauss_rings(4))
        return rms(front), zernike_coefficients(front, 6), front.opd, front.direction[:2]

    start = [torch.tensor(t, dtype=torch.float64, requires_grad=True) for t in (0.02, 66.0)]
    assert gradcheck(statistics, start, eps=1e-6, atol=1e-7)


def test_a_small_part_of_the_pupil_gives_no_coefficients():
    """Not numbers of 1e14 waves; the RMS, which needs no polynomials, stays."""
    lens = problems.double_gauss(aperture=("image_f_number", 0.5))
    fast, slow = (
        wavefront_of(scene(x, vector(0.0, 0.0)[:, None], vector(25e3), x.wavelengths), *gauss_rings(14, 56))
        for x in (lens, problems.double_gauss())
    )
    assert fast.valid.sum() > 37
    assert zernike_coefficients(fast).isnan().all()
    assert rms(fast).isfinite()
    assert zernike_coefficients(slow).isfinite().all()
    with pytest.raises(EmptySpot):
        zernike_coefficients(fast, empty="error")


def test_coefficients_of_a_beam_that_fills_too_little_of_the_pupil_are_nan_with_a_warning():
    lens = rt.read_lens("cooke_triplet")
    lens = lens.replace(lens.stop, apertures=(rt.system.Aperture("circular", (0.0, 1.5)),))
    with pytest.warns(rt.Incomplete, match=r"field 0 degrees: .*too little .*pupil"):
        found = rt.wavefront(lens, fields=[0], wavelengths=[0.55])
    assert bool(found.coefficients.isnan().all())
    assert bool(found.rms.isfinite().all())
