"""Analyses: closed forms of perfect lenses, laws of the field, limits, and gradients."""

import dataclasses
import json
import math

import problems
import pytest
import torch
from problems import MICROMETRE, NANOMETRE, scalar, vector

import raytrace as rt
from raytrace.analysis import encircled
from raytrace.analysis.mtf import cutoff, mtf_on_grid
from raytrace.analysis.pupil_autocorrelation import ExitPupil
from raytrace.analysis.setting import scene_of, wavelength_shares
from raytrace.cli import main
from raytrace.files import shipped
from raytrace.io import read_lens
from raytrace.materials.glass import model_glass
from raytrace.maths.numerics import safe_sqrt
from raytrace.maths.sampling import gauss_legendre, gauss_rings
from raytrace.system.lens import Lens, with_sensor_distance
from raytrace.tracing.launch import launch
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.ray_failures import OutOfReach
from raytrace.tracing.scene import Memo
from raytrace.tracing.spot import EmptySpot, image_rays
from raytrace.tracing.trace import trace_lens

WAVELENGTH = 0.55e-3  # mm


def perfect(shift: float = 0.0, diameter: float = 4.0) -> Lens:
    """A plano-hyperbolic lens, F/12: no aberration on the axis but the defocus of a shifted sensor (mm)."""
    return problems.plano_hyperbolic(shift, diameter=diameter)


def numerical_aperture(lens: Lens) -> float:
    edge = image_rays(lens, vector(0.0, 1.0)[:, None])
    return abs(float(edge.direction[1, 0, 0, 0]))


def thin_lens(*angles: float, diameter: float = 0.5) -> Lens:
    """Stop at a thin lens of f = 100 mm: chief rays go straight through."""
    surfaces = [problems.surface(0.01, 1e-9, 1.5), problems.surface(-0.01, 100.0)]
    field = problems.fields("angle", angles)
    return problems.lens(surfaces, field=field, aperture=("entrance_pupil_diameter", diameter))


# the medium of the image


def test_diffraction_at_the_sensor_has_the_index_of_the_last_gap():
    """An ellipsoid in front of glass of index 1.5, NA 0.2574, without aberration, by the light of its pupil d(h²)."""
    lens = rt.lens([dict(curvature=0.1, conic=-4 / 9, thickness=30.0, glass=1.5)], stop=1, entrance_pupil_diameter=10,
                   wavelengths=[0.5])  # fmt: skip
    # Of rings of equal light: sin θ, and the transfer ∫∫ over the shared pupil of √(w(s) w(s - λν/n)), w = d(h²)/d(s²).
    h = torch.linspace(0, 5, 2001, dtype=torch.float64)
    sag = 0.1 * h**2 / (1 + torch.sqrt(1 - 5 / 9 * 0.01 * h**2))
    sine = h / torch.hypot(h, 30 - sag)
    density = torch.gradient(h[1:] ** 2, spacing=(sine[1:] ** 2,))[0].sqrt()
    side = (torch.arange(700, dtype=torch.float64) + 0.5) / 350 - 1

    def amplitude(x, y):
        s = torch.hypot(x, y)
        place = torch.searchsorted(sine[1:-1], s).clamp_max(len(density) - 1)
        return torch.where(s < sine[-1], density[place], 0.0)

    x, y = sine[-1] * side[:, None], sine[-1] * side
    whole = amplitude(x, y)
    expected = [(whole * amplitude(x - f * 0.5e-3 / 1.5, y)).sum() / (whole**2).sum() for f in (500, 1000, 1500)]
    found = rt.mtf(lens, [500, 1000, 1500])
    assert torch.allclose(found.tangential[0], torch.stack(expected), atol=5e-4)  # 0.4085, 0.0055, 0
    assert torch.allclose(found.sagittal, found.tangential, atol=1e-6)
    assert float(rt.encircled_energy(lens, [0.5e-3]).share) == pytest.approx(0.4763, abs=1e-3)


def test_a_glass_on_the_image_surface_changes_no_result(tmp_path):
    rows = [dict(curvature=0.1, conic=-4 / 9, thickness=30.0, glass=1.5)]
    bare = rt.lens(rows, stop=1, entrance_pupil_diameter=5, fields=[0.5], wavelengths=[0.5])
    quantities = (
        lambda lens: rt.spot(lens).rms_radius,
        lambda lens: rt.wavefront(lens).rms,
        lambda lens: rt.mtf(lens, [20, 50]).tangential,
        lambda lens: rt.encircled_energy(lens, [5e-3]).share,
        lambda lens: rt.relative_illumination(lens, fields=[0.5]).illumination,
        lambda lens: rt.trace(lens).direction,
        lambda lens: rt.evaluate(lens, merit="wavefront").merit,
    )
    coated = bare.replace(2, glass=1.9)
    for quantity in quantities:
        assert torch.allclose(
            *(torch.as_tensor(quantity(lens)).double() for lens in (coated, bare)), rtol=1e-12, atol=0
        )
    assert "light does not enter n 1.9" in str(rt.info(coated))
    rt.write_lens(coated, tmp_path / "coated.zmx")
    assert any("surface 2: light does not enter" in note for note in rt.check(tmp_path / "coated.zmx").notes)


def test_a_sensor_in_glass_loses_no_ray_by_total_reflection():
    """Object and image in index 1.5, NA 1.2: the rim leaves at the sine 0.8, and lands 20 tan(asin 0.8) mm high."""
    rows = [dict(radius=math.inf, thickness=10.0, glass=1.5)]
    lens = rt.lens(rows, stop=1, object_distance=10.0, object_na=0.3, wavelengths=[0.55]).replace(0, glass=1.5)
    lens = dataclasses.replace(lens, aperture=dataclasses.replace(lens.aperture, value=vector(1.2)[0]))
    upper = rt.trace(lens).direction[1, ..., 1]
    assert float(upper) == pytest.approx(0.8, abs=1e-12)
    assert not rt.spot(lens).arrivals.status.any()
    assert float(rt.spot(lens).geometric_radius) == pytest.approx(80 / 3, abs=1e-6)


# fans and wavefronts


def test_fans_of_a_perfect_lens_are_flat_and_those_of_defocus_straight():
    flat, tilted = rt.ray_fan(perfect()), rt.ray_fan(perfect(1.0))
    assert max(flat.tangential.abs().max(), flat.sagittal.abs().max()) < 1e-3 * NANOMETRE
    assert rt.opd_fan(perfect()).tangential.abs().max() < 1e-9
    slope = -tilted.pupil * numerical_aperture(
        perfect()
    )  # ε = -NA p per mm of sensor shift: behind the focus rays cross
    assert torch.allclose(tilted.tangential[0, 0], slope, atol=0.5 * MICROMETRE)
    assert torch.allclose(tilted.tangential, tilted.sagittal, atol=1e-12)


def test_ray_fan_counts_lateral_colour_and_lands_where_rays_land():
    lens = problems.double_gauss(wavelengths=(0.53, 0.6))
    found = rt.ray_fan(lens, points=5)
    rays = image_rays(lens, torch.stack([torch.zeros(5).double(), found.pupil]))
    expected = rays.position[1] - rays.position[1, :, :1, 2:3]
    assert torch.allclose(found.tangential, expected, atol=NANOMETRE * 1e-3)


def test_opd_fans_on_the_sphere_of_the_primary_wavelength_hold_lateral_colour():
    """Its centre lies δ from the wavelength's own chief ray's point: the OPD gains the tilt δ·(d - d_chief)."""
    lens = read_lens(shipped("lenses") / "tessar.zmx")
    other = next(k for k in range(len(lens.wavelengths)) if k != lens.primary_wavelength - 1)
    own, primary = (rt.opd_fan(lens, reference=reference) for reference in ("own", "primary"))
    assert torch.equal(
        own.tangential[:, lens.primary_wavelength - 1], primary.tangential[:, lens.primary_wavelength - 1]
    )
    apart = (primary.tangential - own.tangential)[-1, other] * 1e-3 * lens.wavelengths[other]  # mm
    rays = image_rays(lens, torch.stack([torch.zeros(41).double(), own.pupil]))
    chief = rays.position[1, -1, :, 20]
    shift = chief[other] - chief[lens.primary_wavelength - 1]
    M = rays.direction[1, -1, other]
    assert shift.abs() > 1e-4  # mm
    # Aberrated rays pass the centres at e = 0.1 mm and more: the sagitta e²/2R of 40 mm is left out.
    assert (apart + shift * (M - M[20])).abs().max() <= 0.02 * apart.abs().max()
    for fan in (own, primary):
        assert fan.tangential[:, :, 20].abs().max() <= 1e-12  # waves, at the chief ray


def test_fans_of_other_wavelengths_refer_to_the_first_of_them():
    """As with a lens at these wavelengths: its chief ray is 0, and lateral colour that of the others."""
    lens = rt.read_lens("cooke_triplet")
    for fan in (rt.ray_fan, rt.opd_fan):
        found = fan(lens, fields=[11.9], wavelengths=[0.45, 0.6], points=5)
        assert torch.equal(found.tangential, fan(lens.at(wavelengths=[0.45, 0.6]), fields=[11.9], points=5).tangential)
    blue, red = rt.ray_fan(lens, fields=[11.9], wavelengths=[0.45, 0.6], points=5).tangential[0, :, 2].tolist()
    assert abs(blue) < 1e-12
    assert abs(red) > 1e-3


def test_an_unknown_reference_is_refused():
    with pytest.raises(ValueError, match=r"'chief': expected .*primary, own"):
        rt.opd_fan(perfect(), reference="chief")


def test_peak_to_valley_counts_rim_and_centre_whatever_the_map():
    """Of defocus it is the whole step from the centre to the rim, W = 2√3 c₄."""
    for size in (8, 127):
        found = rt.wavefront(perfect(0.1), size=size)
        expected = 2 * math.sqrt(3) * abs(float(found.coefficients[0, 0, 3]))
        assert found.peak_to_valley.item() == pytest.approx(expected, rel=1e-4)


def test_zernike_coefficients_of_defocus():
    """OPD = -Δ (1 - cos θ) = -Δ NA² r²/2 in a slow beam: Noll 4 is that over 2√12 … of r², c₄ = -Δ NA²/(4√3)."""
    shift = 0.1
    found = rt.wavefront(perfect(shift), size=16)
    c4 = -shift * numerical_aperture(perfect()) ** 2 / (4 * math.sqrt(3)) / WAVELENGTH
    assert float(found.coefficients[0, 0, 3]) == pytest.approx(c4, rel=2e-3)
    assert found.coefficients[0, 0, [1, 2, 4, 5, 6, 7, 8, 9]].abs().max() < 1e-9
    assert float(found.rms[0, 0]) == pytest.approx(abs(c4), rel=2e-3)
    y = found.pupil[:, None] ** 2 + found.pupil**2
    expected = torch.where(found.valid[0, 0], c4 * 2 * math.sqrt(3) * y, 0.0)
    assert (found.opd[0, 0] - expected).abs().max() < 5e-3 * abs(c4)


def test_strehl_of_a_defocused_perfect_lens():
    """(sin πW / πW)², W = 2√3 c₄ the waves from the centre to the rim."""
    assert rt.wavefront(perfect(), size=8).strehl.item() == pytest.approx(1.0, abs=1e-6)
    found = rt.wavefront(perfect(0.1), size=8)
    half = math.pi * 2 * math.sqrt(3) * float(found.coefficients[0, 0, 3])
    # Below a wave of defocus the best point is on the axis.
    assert abs(half) < 0.5 * math.pi
    assert found.strehl.item() == pytest.approx((math.sin(half) / half) ** 2, rel=2e-3)


def test_wavefront_command_reports_the_strehl_ratio(capsys):
    words = ["wavefront", "tessar", "--size", "8", "--field", "0"]
    assert main([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {row["noll"] for row in document["results"]} == set(range(1, 38))
    for row in document["summary"]:
        assert set(row) == {"field_x", "field_y", "wavelength", "rms", "peak_to_valley", "strehl"}
        assert 0 < row["strehl"] <= 1
    assert main(words) == 0
    heading, _, first = capsys.readouterr().out.splitlines()[:3]
    assert heading.split()[-1] == "strehl"
    assert float(first.split()[-1]) == pytest.approx(document["summary"][0]["strehl"], rel=1e-5)


# MTF


def test_default_frequencies_end_where_the_sharpest_field_ends():
    """At 2/σ of a defocused disc, and at half the cutoff of a perfect lens."""
    sharp = rt.mtf(perfect()).frequencies
    assert float(sharp[-1]) == pytest.approx(0.5 * float(cutoff(perfect(), vector(0.55)[0])), rel=1e-9)
    edge = float(image_rays(perfect(12.0), vector(0.0, 1.0)[:, None]).position[1].abs())
    blurred = rt.mtf(perfect(12.0), geometric=True).frequencies
    assert float(blurred[-1]) == pytest.approx(2 / (edge / 2), rel=1e-3)  # σ of a uniform disc is half its radius


def test_mtf_of_a_circular_pupil():
    """(2/π)(acos s - s √(1 - s²)); the rim of the grid of 128² cells leaves 2e-3."""
    lens = perfect()
    top = 2 * numerical_aperture(lens) / WAVELENGTH
    s = torch.linspace(0, 1.1, 23, dtype=torch.float64)
    found = rt.mtf(lens, s * top)
    inside = s.clamp(max=1.0)
    expected = (2 / math.pi) * (torch.acos(inside) - inside * safe_sqrt(1 - inside**2))
    for curve in (found.tangential[0], found.sagittal[0]):
        assert (curve - expected).abs().max() < 2e-3
    assert (found.limit - expected).abs().max() < 2e-3
    assert float(found.tangential[0, 0]) == pytest.approx(1.0, abs=1e-9)


def test_geometric_mtf_at_low_frequency_is_that_of_the_variance():
    """1 - 2π²σ²ν² + O(ν⁴), σ² the variance of where rays land along the section."""
    lens = problems.double_gauss()
    found = rt.mtf(lens, vector(0.1), geometric=True)
    rays = image_rays(lens, gauss_rings(12)[0])
    weights = gauss_rings(12)[1]
    for along, curve in ((1, found.tangential), (0, found.sagittal)):
        hits = rays.position[along, :, 0]
        variance = (weights * hits**2).sum(-1) - (weights * hits).sum(-1) ** 2
        drop = 2 * math.pi**2 * variance * 0.1**2
        assert torch.allclose(1 - curve[:, 0], drop, rtol=5e-3)


def test_diffraction_meets_rays_where_the_blur_is_large():
    """A defocus of 9 waves: at frequencies far below the cutoff both see a uniform disc."""
    lens = perfect(12.0)
    frequency = vector(0.2, 0.5, 1.0)
    wave, rays = (rt.mtf(lens, frequency, geometric=geometric) for geometric in (False, True))
    assert (wave.tangential - rays.tangential).abs().max() < 0.02


@pytest.mark.slow
def test_through_focus_is_the_mtf_at_each_sensor():
    """About the sensor of the file, where this lens is in focus."""
    lens = perfect()
    found = rt.mtf(lens, frequencies=[60.0], through_focus=0.5)
    assert found.sensor_distances[[0, 10, 20]].tolist() == pytest.approx([49.5, 50.0, 50.5])
    for place in (3, 20):
        alone = rt.mtf(with_sensor_distance(lens, found.sensor_distances[place]), vector(60.0))
        assert float(found.tangential[place, 0]) == pytest.approx(float(alone.tangential[0, 0]), abs=1e-12)
    assert found.tangential[10, 0] > found.tangential[[0, 20], 0].max()
    for frequencies in (None, [10, 20]):
        with pytest.raises(ValueError, match="needs one spatial frequency"):
            rt.mtf(lens, frequencies, through_focus=0.5)


@pytest.mark.slow
def test_through_focus_has_the_derivative_of_the_mtf_at_each_sensor(monkeypatch):
    monkeypatch.setattr("raytrace.analysis.mtf._DISTANCES", 3)
    lens = rt.read_lens("cooke_triplet").at(ray_aiming="real")
    assert not rt.mtf(lens, [20.0], through_focus=0.1, fields=[8.4]).tangential.requires_grad

    def slope(modulation, k: int | None = None) -> float:
        curvature = lens.surfaces[1].curvature.clone().requires_grad_()
        curves = modulation(lens.replace(1, curvature=curvature)).tangential
        (slope,) = torch.autograd.grad(curves.sum() if k is None else curves[k].sum(), curvature)
        return float(slope)

    def alone(lens: Lens):
        return rt.mtf(with_sensor_distance(lens, lens.surfaces[-2].thickness - 0.1), [20.0], fields=[8.4])

    first = slope(lambda lens: rt.mtf(lens, [20.0], through_focus=0.1, fields=[8.4]), 0)
    assert first == pytest.approx(slope(alone), rel=1e-9)


def test_the_wave_of_a_coarse_grid_may_be_a_polynomial():
    """Within the residual of the fit, 1e-4 waves at most: 2π 1e-4 of modulation, and much less in the mean."""
    lens = rt.read_lens("cooke_triplet").at(ray_aiming="real")
    scene = scene_of(lens, torch.tensor([[0.0], [8.4]], dtype=torch.float64))
    memo = Memo(16)
    shares, frequencies = wavelength_shares(lens), vector(10.0, 30.0)
    traced = torch.cat(mtf_on_grid(scene, frequencies, shares))
    fitted = torch.cat(mtf_on_grid(dataclasses.replace(scene, memo=memo), frequencies, shares, fit=True))
    assert 0 < float((fitted - traced).abs().max()) < 1e-5
    made = memo.made
    mtf_on_grid(dataclasses.replace(scene, memo=memo), frequencies, shares, fit=True)
    assert memo.made == made  # no further ray is aimed


# encircled energy


def test_encircled_energy_of_an_airy_disc():
    lens = perfect()
    found = rt.encircled_energy(lens)
    v = 2 * math.pi * numerical_aperture(lens) * found.radii / WAVELENGTH
    expected = 1 - torch.special.bessel_j0(v) ** 2 - torch.special.bessel_j1(v) ** 2
    assert (found.share[0] - expected).abs().max() < 2e-3


def test_encircled_energy_of_a_uniform_disc():
    """(r/R)²: 4096 rays and the little spherical aberration of the defocused cone leave 2e-3."""
    lens = perfect(0.5)
    edge = float(image_rays(lens, vector(0.0, 1.0)[:, None]).position[1].abs())
    radii = edge * torch.linspace(0, 1.2, 25, dtype=torch.float64)
    found = rt.encircled_energy(lens, radii, geometric=True)
    assert (found.share[0] - (radii / edge).clamp(max=1.0) ** 2).abs().max() < 2e-3


def test_energy_in_squares_and_slits_of_an_airy_disc():
    """Slit: the modulation of a circular pupil in closed form. Square and rectangle: Airy's irradiance integrated."""
    lens, radii = perfect(), vector(0.3, 0.61, 1.5, 4.0) * WAVELENGTH / numerical_aperture(perfect())
    cutoff = 2 * numerical_aperture(lens) / WAVELENGTH
    nodes, weights = (torch.from_numpy(part) for part in gauss_legendre(400))
    s = 0.5 * (nodes + 1)
    modulation = 2 / math.pi * (torch.acos(s) - s * torch.sqrt(1 - s * s))
    slit = ((2 * radii[:, None] * torch.sinc(2 * radii[:, None] * s * cutoff)) * modulation * weights * cutoff).sum(-1)
    for shape in "xy":
        assert (rt.encircled_energy(lens, radii, shape=shape).share[0] - slit).abs().max() < 1e-3

    def inside(a, b):
        x, y = a * 0.5 * (nodes + 1), b * 0.5 * (nodes[:, None] + 1)
        v = math.pi * cutoff * torch.hypot(x, y)
        irradiance = (math.pi * cutoff**2 / 4) * (2 * torch.special.bessel_j1(v) / v) ** 2
        return a * b * (irradiance * weights * weights[:, None]).sum()

    square = torch.stack([inside(a, a) for a in radii])
    assert (rt.encircled_energy(lens, radii, shape="square").share[0] - square).abs().max() < 1e-3
    low = torch.stack([inside(a, 0.25 * a) for a in radii])
    found = rt.encircled_energy(lens, radii, shape="rectangle", aspect=0.25)
    assert (found.share[0] - low).abs().max() < 1e-3
    assert found.document()["aspect"] == 0.25


@pytest.mark.parametrize("offset", [0.0, 0.7])
def test_energy_of_a_gaussian_spot(offset):
    """Squares and rectangles: products of error functions; circles about its centre: 1 - exp(-r²/2σ²)."""
    sigma, size, step = 1.5, 96, 0.01  # mm, cells, 1/mm
    nu = step * (torch.arange(size, dtype=torch.float64) - size / 2)
    amplitude = torch.exp(-((2 * math.pi * sigma) ** 2) * (nu**2 + nu[:, None] ** 2)).to(torch.complex128)
    amplitude, one = amplitude[None, None], torch.ones(1, 1, dtype=torch.float64)
    centre = torch.zeros(2, 1, 1, dtype=torch.float64)
    pupil = ExitPupil(
        amplitude, (amplitude.abs() ** 2).sum((-2, -1)), step * torch.ones_like(centre), centre, centre, one
    )
    radii = vector(0.0, 0.5, 1.5, 3.0, 8.0)

    def share(half, away):
        return 0.5 * (torch.erf((half - away) / sigma / 2**0.5) + torch.erf((half + away) / sigma / 2**0.5))

    for sides in ((1.0, 1.0), (1.0, 0.4), (1.0, math.inf), (math.inf, 1.0)):
        expected = math.prod(
            torch.ones_like(radii) if side == math.inf else share(side * radii, away)
            for side, away in zip(sides, (offset, 0.0), strict=True)
        )
        found = encircled._of_wave(pupil, 0, vector(offset, 0.0), radii, sides)
        assert torch.allclose(found, expected, rtol=0, atol=1e-8)  # the amplitude is cut off at 2e-9
    if not offset:
        found = encircled._of_wave(pupil, 0, vector(0.0, 0.0), radii, None)
        assert torch.allclose(found, 1 - torch.exp(-0.5 * (radii / sigma) ** 2), rtol=0, atol=2e-4)


def test_geometric_energy_of_a_uniform_disc_in_squares_and_slits():
    """4 a²/πR² in a square within the disc; 2/π (asin t + t √(1 - t²)) in a slit."""
    lens = perfect(0.5)
    edge = float(image_rays(lens, vector(0.0, 1.0)[:, None]).position[1].abs())
    t = vector(0.1, 0.4, 0.7)
    square = rt.encircled_energy(lens, edge * t, shape="square", geometric=True).share[0]
    assert (square - 4 * t**2 / math.pi).abs().max() < 3e-3
    slit = rt.encircled_energy(lens, edge * t, shape="x", geometric=True).share[0]
    assert (slit - 2 / math.pi * (torch.asin(t) + t * torch.sqrt(1 - t * t))).abs().max() < 3e-3
    assert float(rt.encircled_energy(lens, [1.01 * edge], shape="y", geometric=True).share) == 1


@pytest.mark.filterwarnings("ignore::raytrace.UnfilledStop")
@pytest.mark.parametrize("shape", ["circle", "square", "x", "y"])
def test_energy_of_diffraction_has_its_derivatives(shape):
    """By the sensor distance and by the aperture, which scales the frequencies of the pupil, against differences."""
    lens = rt.read_lens("cooke_triplet")

    def share(distance, diameter):
        bench = lens.at(sensor_distance=distance, entrance_pupil_diameter=diameter)
        return rt.encircled_energy(bench, [0.004], shape=shape, fields=[8.0], wavelengths=[0.55]).share.sum()

    at = [lens.surfaces[-2].thickness.detach().clone().requires_grad_(), scalar(6.0).requires_grad_()]
    slopes = torch.autograd.grad(share(*at), at)
    for k, (slope, step) in enumerate(zip(slopes, (2e-4, 2e-3), strict=True)):
        ends = [[value.detach() + side * step * (j == k) for j, value in enumerate(at)] for side in (1, -1)]
        more, less = (share(*end) for end in ends)
        assert float(slope) == pytest.approx(float(more - less) / (2 * step), rel=1e-5, abs=1e-7)


def test_wrong_shapes_are_refused():
    for options, said in (
        ({"shape": "hexagon"}, "'hexagon' is not known; expected one of circle, square, rectangle, x, y"),
        ({"shape": "rectangle"}, "height over width of the rectangle, is missing"),
        ({"shape": "rectangle", "aspect": -1}, "is -1; expected a number above 0"),
        ({"shape": "square", "aspect": 2}, "leave it out for square"),
    ):
        with pytest.raises(ValueError, match=said):
            rt.encircled_energy(perfect(), [0.01], **options)


# over the field


def test_a_thin_lens_with_its_stop_does_not_distort():
    found = rt.distortion(thin_lens(0.0, 30.0), samples=7)
    assert found.f_tan.abs().max() < 1e-7
    theta = torch.deg2rad(found.fields[1, 1:])
    assert torch.allclose(found.f_theta[1:, 0], torch.tan(theta) / theta - 1, atol=1e-7)
    assert torch.allclose(found.height[:, 0], 100 * torch.tan(torch.deg2rad(found.fields[1])), atol=MICROMETRE)


def test_distortion_of_a_finite_object_is_against_its_height():
    lens = problems.double_gauss(object_distance=500.0)
    found = rt.distortion(lens, samples=3)
    assert found.f_theta is None
    near = rt.distortion(lens, fields=vector(0.0, 0.01)[:, None])
    assert near.f_tan.abs().max() < 1e-6
    assert 1e-4 < found.f_tan[-1].abs().max() < 0.1


@pytest.mark.parametrize("aiming", ["off", "real"])
@pytest.mark.parametrize("distance", [math.inf, 500.0])
@pytest.mark.parametrize("kind", ["angle", "object_height", "paraxial_image_height", "real_image_height"])
def test_heights_of_chief_rays_have_the_sign_of_the_trace(kind, distance, aiming):
    """Of fields to both sides, with an object at a finite distance too; the distortion has one sign on both sides."""
    if kind == "object_height" and distance == math.inf:
        return
    field = problems.fields(kind, (4.5, -4.5, 0.0, 2.0), x=(0.0, 0.0, -3.0, -1.0))
    lens = problems.double_gauss(object_distance=distance, field=field, wavelengths=(0.5876, 0.45), ray_aiming=aiming)
    points = torch.stack([field.x, field.y])
    found = rt.distortion(lens, fields=points)
    chief = trace_lens(lens, launch(lens, torch.zeros(2, 1, dtype=torch.float64)), lens.wavelengths[:, None])
    x, y = chief.position[:2, :, :, 0]
    meridian = torch.stack([y[0], y[1], x[2], (2 * y[3] - x[3]) / math.sqrt(5)])
    assert (found.height - meridian).abs().max() <= 1e-12  # mm
    assert (found.f_tan[0] - found.f_tan[1]).abs().max() <= 1e-12
    shift = rt.lateral_colour(lens, fields=points).shift[:, 1]
    assert (shift - (meridian[:, 1] - meridian[:, 0])).abs().max() <= 1e-12  # mm


@pytest.mark.parametrize("angle", [0.0, 10.0, 25.0])
def test_foci_of_a_sphere_are_coddingtons(angle):
    """n' cos²I'/t' - cos²I n/t = (n' cos I' - n cos I)/R and n'/s' = the same, along the refracted chief ray."""
    n, radius = 1.5, 30.0
    sphere = [problems.surface(1 / radius, 80.0, n)]
    lens = problems.lens(sphere, field=problems.fields("angle", (angle,)), aperture=("entrance_pupil_diameter", 1.0))
    found = rt.field_curvature(lens, fields=vector(0.0, angle)[:, None])
    sine = math.sin(math.radians(angle))
    cosine, refracted = math.sqrt(1 - sine**2), math.sqrt(1 - (sine / n) ** 2)
    power = (n * refracted - cosine) / radius
    assert float(found.tangential) == pytest.approx(n * refracted**2 / power * refracted - 80.0, abs=0.1 * MICROMETRE)
    assert float(found.sagittal) == pytest.approx(n / power * refracted - 80.0, abs=0.1 * MICROMETRE)


def test_near_the_axis_foci_bend_as_petzval_says():
    """The sagittal focus lies a third of the way from Petzval's surface to the tangential one."""
    lens = problems.double_gauss()
    found = rt.field_curvature(lens, fields=vector(0.0, 1.0).diag()[:, :2])
    bend = [float(curve[1, 0] - curve[0, 0]) for curve in (found.tangential, found.sagittal)]
    height = 99.5 * math.tan(math.radians(1.0))
    petzval = height**2 / 2 / float(first_order(lens).petzval_radius)
    assert (3 * bend[1] - bend[0]) / 2 == pytest.approx(petzval, rel=0.02)


def test_lateral_colour_is_the_difference_of_chief_rays():
    lens = problems.double_gauss(wavelengths=(0.48, 0.53, 0.65), primary_wavelength=2)
    found = rt.lateral_colour(lens, samples=3)
    rays = image_rays(lens, vector(0.0, 0.0)[:, None], fields=found.fields)
    assert torch.allclose(found.shift, rays.position[1, ..., 0] - rays.position[1, :, 1:2, 0], atol=1e-12)
    assert (found.shift[:, 1] == 0).all()


def test_relative_illumination_is_cos_to_the_fourth():
    """A small stop at a thin lens, seen from the sensor at θ; the marginal cone of F/200 leaves 1e-5."""
    found = rt.relative_illumination(thin_lens(0.0, 30.0), samples=4)
    expected = torch.cos(torch.deg2rad(found.fields[1])) ** 4
    assert (found.illumination - expected).abs().max() < 1e-3


def test_relative_illumination_counts_vignetting():
    lens = problems.double_gauss()
    free = rt.relative_illumination(lens, samples=3).illumination
    clipped = lens.replace(1, apertures=problems.vignetting_aperture(18.0))
    found = rt.relative_illumination(clipped, samples=3).illumination
    assert float(found[0]) == pytest.approx(float(free[0]), abs=1e-12)
    assert found[2] < 0.97 * free[2]


# derivatives and doors


@pytest.mark.slow
def test_gradients_are_those_of_differences():
    """Of the sensor distance, at a place where no ray of the double Gauss is lost."""

    def everything(distance: torch.Tensor) -> torch.Tensor:
        lens = with_sensor_distance(problems.double_gauss(field=problems.fields("angle", (10.0,))), distance)
        fields = vector(0.0, 10.0)[:, None]
        return torch.stack(
            [
                rt.ray_fan(lens, points=5).tangential.square().sum(),
                rt.opd_fan(lens, points=5).sagittal.square().sum(),
                rt.mtf(lens, vector(5.0)).tangential.sum(),
                rt.mtf(lens, vector(5.0), geometric=True).sagittal.sum(),
                rt.encircled_energy(lens, vector(0.02)).share.sum(),
                rt.distortion(lens, fields=fields).height.sum(),
                rt.field_curvature(lens, fields=fields).tangential.sum(),
                rt.relative_illumination(lens, fields=fields).projected_solid_angle.sum(),
            ]
        )

    distance = problems.scalar(57.9).requires_grad_()
    here = everything(distance)
    gradient = torch.stack([torch.autograd.grad(entry, distance, retain_graph=True)[0] for entry in here])
    with torch.no_grad():
        step = 1e-4
        slope = (everything(distance + step) - everything(distance - step)) / (2 * step)
    assert torch.isfinite(gradient).all()
    assert torch.allclose(gradient, slope, rtol=1e-2, atol=1e-6)


LIMITS = "tangential_limit", "sagittal_limit"


def test_results_are_tables():
    frame = rt.mtf(perfect(), vector(0.0, 50.0)).to_frame()
    assert list(frame.columns) == ["field_x", "field_y", "frequency", "tangential", "sagittal", *LIMITS]
    assert len(frame) == 2
    assert frame.frequency[1] == 50
    assert len(rt.wavefront(perfect(), size=8).to_frame()) == 37


COMMANDS = {
    "ray-fan": ["--points", "5"],
    "opd-fan": ["--points", "5"],
    "wavefront": ["--size", "16"],
    "distortion": ["--samples", "3"],
    "field-curvature": ["--samples", "3"],
    "lateral-colour": ["--samples", "3", "--wavelength", "0.5876", "0.4861"],
    "relative-illumination": ["--samples", "2"],
    "mtf": ["--geometric", "--frequency", "5", "10"],
    "encircled-energy": ["--geometric", "--radius", "0.05"],
}


@pytest.mark.parametrize(
    "command", [pytest.param(c, marks=pytest.mark.slow if c == "wavefront" else ()) for c in COMMANDS]
)
def test_commands_write_strict_json_and_a_figure(command, capsys, tmp_path):
    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    picture = tmp_path / "figure.png"
    arguments = [command, "double_gauss", *COMMANDS[command], "--plot", str(picture)]
    assert main([*arguments, "--json"]) == 0
    document = json.loads(capsys.readouterr().out, parse_constant=refuse)
    assert document["analysis"] == command
    assert len(document["results"]) >= 2
    assert picture.stat().st_size > 10_000
    assert main(arguments[:-2]) == 0
    assert capsys.readouterr().out.split()[0] == "field_y"


@pytest.mark.slow
def test_through_focus_counts_its_sensor_distances():
    seen = []

    def progress(work, unit):
        for step in work:
            yield step
            seen.append(unit)

    found = rt.mtf("singlet", 20, through_focus=0.1, fields=[0, 5], geometric=True, progress=progress)
    assert seen == ["sensor distance"] * found.tangential.numel()
    alone = rt.mtf("singlet", 20, through_focus=0.1, fields=[5], geometric=True)
    torch.testing.assert_close(found.tangential[:, 1:], alone.tangential, rtol=1e-12, atol=0)


def test_through_focus_needs_one_frequency(capsys):
    assert main(["mtf", "double_gauss", "--through-focus", "0.1"]) == 1
    assert "--frequency" in capsys.readouterr().err


# no light


@pytest.mark.parametrize("geometric", [False, True])
@pytest.mark.parametrize("analyse", [rt.mtf, rt.encircled_energy])
def test_a_field_without_light_is_named_with_where_its_rays_end(analyse, geometric):
    lens = read_lens(shipped("lenses") / "cooke_triplet.zmx")
    lost = r"no ray of field 80 degrees reaches the sensor: all 217 rays lost: missed surface 2; .* reach 11.9 degrees"
    with pytest.raises(OutOfReach, match=lost):
        analyse(lens, [10.0] if analyse is rt.mtf else [0.01], geometric=geometric, fields=[0, 80])


@pytest.mark.parametrize(
    ("analyse", "geometric"),
    [(rt.mtf, False), (rt.mtf, True), (rt.encircled_energy, False)],
    ids=["mtf", "mtf of rays", "encircled energy"],
)
def test_a_wavelength_without_light_is_named_too(analyse, geometric):
    """Out of a glass of n = 1.55 at an angle that is critical for n = 1.556: red light leaves it, blue does not."""
    flat = problems.lens(
        [problems.surface(None, 50.0)], field=problems.fields("angle", (0.0, 40.0)), wavelengths=(0.65, 0.45),
        aperture=("entrance_pupil_diameter", 2.0),
    )  # fmt: skip
    lens = flat.replace(0, glass=model_glass(1.55, 30.0))
    lost = (
        r"field 40 degrees, 0\.45 µm has no .*: all 144 rays lost: totally reflected at surface 1; leave the field out"
    )
    with pytest.raises(EmptySpot, match=lost):
        analyse(lens, [1.0], geometric=geometric)


def test_a_column_in_per_cent_has_the_unit_and_values_of_the_text():
    """Text, frame and document have the same number; units of the columns come with the frame and the document."""
    lens = problems.double_gauss()
    found, grid = rt.distortion(lens, fields=[14.0]), rt.distortion_grid(lens, points=3)
    frame, document = found.to_frame(), found.document()
    percent = 100 * float(found.f_tan[0, 0])
    assert frame["f_tan_percent"][0] == document["results"][0]["f_tan_percent"] == percent
    assert f"{percent:.6g}" in str(found)
    assert "f_tan" not in frame
    assert frame.attrs["units"] == document["units"] == found.units()
    assert {frame.attrs["units"][name] for name in ("f_tan_percent", "f_theta_percent")} == {"%"}
    largest = 100 * float(grid.largest()[0])
    assert grid.document()["summary"][0]["largest_percent"] == largest
    assert f"largest {largest:.6f} %" in str(grid)
    assert grid.to_frame()["distortion_percent"].abs().max() == pytest.approx(abs(largest), rel=1e-12)
    assert rt.rms_over_field(lens, samples=2).units()["polychromatic"] == "waves"
    assert rt.rms_over_field(lens, samples=2, spot=True).to_frame().attrs["units"]["rms_um"] == "µm"
    assert {rt.seidel(lens, kind="waves").units()[name] for name in ("W040", "W131")} == {"waves"}
    assert rt.spot(lens, rings=2).to_frame().attrs["units"]["rms_radius_um"] == "µm"
    assert rt.lateral_colour(lens, wavelengths=[0.5, 0.6]).document()["units"]["shift"] == "mm"
