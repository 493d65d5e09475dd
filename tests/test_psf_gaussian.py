"""Gaussian over pixels, and the Gaussian PSF of a lens."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from problems import MICROMETRE, double_gauss, scalar, vector

import raytrace as rt
from raytrace.io import read_lens
from raytrace.maths.sampling import Grid, gauss_rings, grid, sobol
from raytrace.psf_models import gaussian
from raytrace.psf_models import gaussian as rules
from raytrace.psf_models.drt import trace_clearances
from raytrace.psf_models.gaussian import gaussian_pixels
from raytrace.system.lens import Lens, with_sensor_distance
from raytrace.system.surface import Aperture
from raytrace.tracing.scene import beam_share, scene, trace_scene

LENSES = Path(__file__).parents[1] / "lenses"
ROUNDING = 2.0**-53


def pixels(mean, covariance, pitch=0.005, size=7):
    return gaussian_pixels(grid(scalar(pitch), size), vector(*mean), vector(*covariance))


def lens_at(sensor_distance=57.662, **others) -> Lens:
    return with_sensor_distance(double_gauss(**others), scalar(sensor_distance))


def scene_of(lens, field=(0.0, 0.0), distances=(25_000.0,)):
    return scene(lens, vector(*field)[:, None], vector(*distances), vector(0.530))


def clipped(lens: Lens, number: int, radius: float) -> Lens:
    """The lens with a clear aperture on one surface."""
    return lens.replace(number, apertures=(Aperture("circular", (0.0, radius)),))


def obscured(lens: Lens, number: int, radius: float, centre: tuple[float, float]) -> Lens:
    return lens.replace(number, apertures=(Aperture("circular", (0.0, radius), True, centre),))


#: pixel (row, column) of 8 × 8 of 2.5 µm, mean, covariance, energy, allowed error in roundings. Exact: integrals in
#: 30-digit arithmetic, graded Gauss rules of 8,000 nodes.
EXACT = [
    ((3, 5), (0.0005, 0.00025), (1.40625e-05, 1.123875e-05, 9e-06), 1.85143186483561421e-46, 2000),
    ((4, 4), (0.00075, -0.0005), (4e-06, 0.0, 7.562500000000002e-06), 0.132154945270294204, 50),
    ((0, 0), (0.00075, -0.0005), (4e-06, 0.0, 7.562500000000002e-06), 9.584355777676869e-8, 50),
    ((4, 4), (0.00025, 0.0), (6.25e12, 0.0, 6.25e12), 1.591549430918953423e-19, 50),
    ((4, 4), (0.0005, 0.00025), (1.40625e-05, 7.874999999999998e-06, 9e-06), 0.107418066610374982, 50),
]


@pytest.mark.parametrize(("place", "mean", "covariance", "energy", "allowed"), EXACT)
def test_energy_of_a_pixel_is_exact(place, mean, covariance, energy, allowed):
    computed = pixels(mean, covariance, pitch=0.0025, size=8)[place].item()
    assert abs(computed - energy) <= allowed * ROUNDING * energy


def test_little_memory_gives_the_same_energy(monkeypatch):
    """Gaussians are integrated one after the other where both rules together do not fit."""
    sigma = torch.tensor([1e-4, 3e-3, 1e-3, 8e-3], dtype=torch.float64)
    centroid, covariance = torch.zeros(2, 4).double(), torch.stack([sigma**2, 0.3 * sigma**2, 2 * sigma**2])
    window = grid(scalar(0.005), 7)
    together = gaussian_pixels(window, centroid, covariance)
    monkeypatch.setattr(rules, "_AT_ONCE", 1)
    torch.testing.assert_close(gaussian_pixels(window, centroid, covariance), together, rtol=1e-13, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 1e-12, -0.3, 0.9, -0.9999, 1.0])
@pytest.mark.parametrize("sigma", [1e-7, 0.002, 0.03])
def test_a_large_grid_holds_all_the_energy(rho, sigma):
    covariance = (sigma**2, rho * sigma * 3 * sigma, 9 * sigma**2)
    assert pixels((0.0011, -0.0007), covariance, pitch=0.02, size=81).sum().item() == pytest.approx(1, abs=1e-13)


#: σ_x, σ_y in pixels and ρ: blurs of many pixels, of one, thin ones along a diagonal; the last is for both rules.
ROTATED = [(8.0, 5.0, 0.3), (1.0, 1.5, -0.6), (0.7, 0.6, 0.7), (3.0, 2.0, 0.98), (0.9, 25.0, -0.9), (1.5, 2.0, -0.966)]


@pytest.mark.parametrize(("sigma_x", "sigma_y", "rho"), ROTATED)
def test_a_rotated_gaussian_is_that_of_a_dense_rule(sigma_x, sigma_y, rho):
    """60 × 60 Gauss nodes in each pixel: 1e-14 of it and the rounding of xy, 2⁻⁵³/(1 - ρ²) for each unit of E < 10; in
    tails E < 575, and exp(-t²/2) itself is known to 2e-13.
    """
    covariance = vector(sigma_x**2, rho * sigma_x * sigma_y, sigma_y**2)
    mean, node, weight = vector(0.3, -1.4), *(torch.as_tensor(t.astype("float64")) for t in rules._gauss(60))
    centre = torch.arange(11.0, dtype=torch.float64)[:, None] - 5 + 0.5 * node
    u = (centre - mean[0]) / sigma_x
    v = ((centre - mean[1])[:, None, :, None] / sigma_y - rho * u[:, None, :]) / math.sqrt(1 - rho**2)
    density = torch.exp(-0.5 * (u[:, None, :] ** 2 + v**2)) / (2 * math.pi * sigma_x * sigma_y * math.sqrt(1 - rho**2))
    expected = torch.einsum("yxnm,n,m->yx", density, weight, weight) / 4
    computed = gaussian_pixels(grid(scalar(1.0), 11), mean, covariance)
    error = (computed - expected).abs() / expected.clamp_min(1e-290)
    assert float(error[expected > 1e-6].max()) < 1e-14 + 10 * ROUNDING / (1 - rho**2)
    assert float(error[expected > 1e-250].max()) < 2e-13 + 575 * ROUNDING / (1 - rho**2)


def test_narrow_pixels_of_a_batch_take_the_cheap_rule_and_the_others_stay_exact(monkeypatch):
    widths = [(9e-6, 3e-6, 9e-6), (1e-8, 5e-9, 1e-8), (0.0, 0.0, 0.0), (2.5e-5, 2.5e-5, 2.5e-5), (4e-6, -3e-6, 9e-6)]
    alone = [pixels((0.001, 0.002), covariance) for covariance in widths]
    mean, counted, rule = vector(0.001, 0.002)[:, None].expand(2, 5), [], rules._rule
    monkeypatch.setattr(rules, "_rule", lambda *given: counted.append(len(given[2])) or rule(*given))
    batch = gaussian_pixels(grid(scalar(0.005), 7), mean, vector(*map(list, widths)).T)
    torch.testing.assert_close(batch, torch.stack(alone), rtol=2e-14, atol=1e-300)
    assert counted == [3]


def test_pixels_of_a_rotated_gaussian_mirror_with_it():
    one, other = pixels((0.001, 0.002), (4e-6, 3e-6, 9e-6)), pixels((0.001, -0.002), (4e-6, -3e-6, 9e-6))
    torch.testing.assert_close(one, other.flip(0), rtol=1e-13, atol=1e-300)
    turned = pixels((0.002, 0.001), (9e-6, 3e-6, 4e-6))
    torch.testing.assert_close(one, turned.T, rtol=1e-12, atol=1e-300)


def test_a_vanishing_xy_is_the_product():
    product = pixels((0.001, 0.002), (4e-6, 9e-6))
    for xy in (0.0, 1e-20, -1e-30):
        torch.testing.assert_close(pixels((0.001, 0.002), (4e-6, xy, 9e-6)), product, rtol=1e-12, atol=1e-300)


def test_a_point_falls_in_one_pixel_or_halves_on_an_edge():
    inside, edge = pixels((0.001, -0.001), (0.0, 0.0, 0.0)), pixels((0.0025, 0.0), (0.0, 0.0, 0.0))
    assert inside[3, 3] == 1 == inside.sum()
    assert edge[3, 3] == edge[3, 4] == 0.5


def test_a_line_lies_where_it_is():
    """Σ of rank 1 along the diagonal: pixels on it hold Φ differences of the line, the others nothing."""
    computed = pixels((0.0, 0.0), (2.5e-5, 2.5e-5, 2.5e-5))
    edge = (torch.arange(8, dtype=torch.float64) - 3.5) / math.sqrt(2)
    expected = torch.diff(0.5 * torch.erf(edge))
    torch.testing.assert_close(computed.diagonal(), expected, rtol=1e-13, atol=0)
    assert (computed - torch.diag(computed.diagonal())).abs().max() <= 1e-16


@pytest.mark.slow
@pytest.mark.parametrize("covariance", [(4e-6, 9e-6), (4e-6, 0.0, 9e-6), (4e-6, 4e-6, 9e-6), (4e-4, -5.9e-4, 9e-4)])
def test_derivatives_of_pixels(covariance):
    """Derivatives in pixel units, the covariance scaled so that all numbers are about 1."""

    def energy(pitch, centre, mean, covariance):
        return 1e2 * gaussian_pixels(Grid(pitch, 3, 4, centre), mean, covariance)

    unit = 1 / 0.005
    numbers = [scalar(1.0), vector(0.1, -0.2), vector(0.3, 0.4), vector(*covariance) * unit**2]
    numbers = [number.requires_grad_() for number in numbers]
    assert torch.autograd.gradcheck(energy, numbers, atol=1e-6)
    assert torch.autograd.gradgradcheck(energy, numbers, atol=1e-5)


@pytest.mark.parametrize("covariance", [(0.0, 0.0), (0.0, 0.0, 0.0), (1e-300, 0.0, 1e-300), (1e-6, 1e-6, 1e-6)])
def test_derivatives_of_a_degenerate_gaussian_are_finite(covariance):
    numbers = [vector(0.001, 0.0005).requires_grad_(), vector(*covariance).requires_grad_()]
    total = (gaussian_pixels(grid(scalar(0.005), 5), *numbers) * torch.arange(25.0).reshape(5, 5)).sum()
    first = torch.autograd.grad(total, numbers, create_graph=True)
    assert all(torch.isfinite(g).all() for g in first)
    if first[0].requires_grad:
        second = torch.autograd.grad(sum(g.sum() for g in first), numbers, allow_unused=True)
        assert all(g is None or torch.isfinite(g).all() for g in second)


def test_pixels_under_vmap_equal_those_of_a_batch():
    g, mean, covariance = (
        grid(scalar(0.005), 5),
        vector(0.001, 0.0),
        torch.stack([vector(4e-6, c, 9e-6) for c in (1e-6, -4e-6)]),
    )
    mapped = torch.func.vmap(lambda c: gaussian_pixels(g, mean, c))(covariance)
    batch = gaussian_pixels(g, mean[:, None].expand(2, 2), covariance.T)
    torch.testing.assert_close(mapped, batch, rtol=1e-14, atol=0)
    jacobian = torch.func.jacfwd(lambda c: gaussian_pixels(g, mean, c))(covariance[0])
    torch.testing.assert_close(jacobian, torch.func.jacrev(lambda c: gaussian_pixels(g, mean, c))(covariance[0]))


def test_double_gauss_at_25_m():
    """The published starting point: 7.075 µm RMS radius at 57.662 mm, σ of one axis is that over √2."""
    result = gaussian.kernels(scene_of(lens_at()), grid(0.005, 21), order=4)
    assert result.rays == 4
    assert result.covariance[0].sqrt().item() == pytest.approx(7.075 / math.sqrt(2) * MICROMETRE, abs=5e-4 * MICROMETRE)
    assert result.kernel.sum().item() == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize(("order", "allowed"), [(4, 2e-6), (5, 1e-9), (6, 1e-11)])
def test_few_rays_on_the_axis(order, allowed):
    few, many = (gaussian.kernels(scene_of(lens_at()), grid(0.005, 5), order=n) for n in (order, 10))
    torch.testing.assert_close(few.covariance.sqrt(), many.covariance.sqrt(), rtol=allowed, atol=0)


def test_forty_rays_at_full_field():
    computed = scene_of(lens_at(), (0.0, 14.0))
    few, many = (gaussian.kernels(computed, grid(0.005, 5), order=n) for n in (5, 10))
    assert few.rays == 40
    torch.testing.assert_close(few.covariance.sqrt(), many.covariance.sqrt(), rtol=1e-6, atol=0)


def test_symmetry_changes_nothing():
    """Off the plane of symmetry the whole pupil is traced: a field turned about the axis turns the moments."""
    half = gaussian.kernels(scene_of(lens_at(), (0.0, 10.0)), grid(0.005, 5), order=8)
    slope = math.tan(math.radians(10)) / math.sqrt(2)
    angle = math.degrees(math.atan(slope))
    full = gaussian.kernels(scene_of(lens_at(), (angle, angle)), grid(0.005, 5), order=8)
    xx, xy, yy = full.covariance.flatten().tolist()
    assert half.covariance[2].item() == pytest.approx(0.5 * (xx + yy) + xy, rel=1e-9)
    assert half.covariance[0].item() == pytest.approx(0.5 * (xx + yy) - xy, rel=1e-9)
    on_axis = gaussian.kernels(scene_of(lens_at()), grid(0.005, 5), order=6).covariance
    nearly = gaussian.kernels(scene_of(lens_at(), (0.0, 1e-9)), grid(0.005, 5), order=6).covariance
    torch.testing.assert_close(on_axis[::2], nearly[::2], rtol=1e-7, atol=0)


def test_a_positive_field_lands_at_positive_y():
    lens = lens_at()
    centroid = gaussian.kernels(scene_of(lens, (0.0, 14.0)), grid(0.005, 5), order=4).centroid
    assert centroid[1].item() == pytest.approx(24.63, abs=0.05)
    assert centroid[0].item() == 0


@pytest.mark.parametrize("field", [(0.0, 0.0), (0.0, 10.0)])
def test_centroid_follows_the_field_in_x_and_y(field):
    """Symmetry must not hide the derivative by the field that would break it: 1.7 mm a degree, on the axis and off."""
    lens, pixel = lens_at(), grid(scalar(0.005), 3)

    def centroid(fields):
        return gaussian.kernels(scene(lens, fields, vector(25_000.0), vector(0.530)), pixel, order=5).centroid.flatten()

    start, step = vector(*field)[:, None], 1e-4
    computed = torch.autograd.functional.jacobian(centroid, start)[:, :, 0]
    for axis in (0, 1):
        moved = torch.zeros_like(start)
        moved[axis] = step
        expected = (centroid(start + moved) - centroid(start - moved)) / (2 * step)
        assert abs(float(expected[axis])) > 1.0
        assert (
            computed[:, axis] - expected
        ).abs().max() <= 1e-6  # mm a degree; the difference errs by step² and rounding


def test_energy_is_the_transmitted_fraction_of_the_whole_pupil():
    lens = clipped(lens_at(), 6, 5.0)
    computed = gaussian.kernels(scene_of(lens), grid(0.2, 41), order=2).kernel.sum()
    # The ray at the edge of that share of the pupil's area grazes the aperture.
    assert 0.05 < float(computed) < 0.5
    _, (clearance, *_) = trace_clearances(scene_of(lens), torch.stack([0 * computed, computed.sqrt()])[:, None])
    assert float(clearance.abs().max()) < 1e-9
    factors = torch.zeros(5, 3, dtype=torch.float64)
    factors[2, 2], factors[3, 2] = 0.1, 0.4
    vignetted = dataclasses.replace(lens_at(), fields=dataclasses.replace(lens_at().fields, vignetting=factors))
    fields = torch.stack([vignetted.fields.x, vignetted.fields.y])
    share = beam_share(scene(vignetted, fields, vector(25_000.0), vector(0.530)))
    torch.testing.assert_close(share.flatten(), vector(1.0, 1.0, 0.9 * 0.6))


def dense(computed):
    """Energy, centroid and covariance (6,) of a quarter of a million rays, blocked one by one."""
    points, weights = gauss_rings(1024, 256)
    rays = trace_scene(computed, points)
    weights = weights * rays.valid.flatten()
    x, y = rays.position[:2].reshape(2, -1)
    share = weights / weights.sum()
    mx, my = (share * x).sum(), (share * y).sum()
    moments = [(share * a * b).sum() for a, b in ((x - mx, x - mx), (x - mx, y - my), (y - my, y - my))]
    return torch.stack([weights.sum(), mx, my, *moments])


CLIPPED = {
    "obscured": (read_lens(LENSES / "hubble.zmx"), (0.0, 0.05), math.inf),
    "stopped": (clipped(lens_at(57.88), 6, 9.0), (0.0, 2.0), 1e4),
    "with_corners": (clipped(lens_at(57.88), 5, 11.5), (0.0, 14.0), 1e4),
    "turned": (clipped(lens_at(57.88), 5, 11.5), (9.0, 9.0), 1e4),
    "spotted": (obscured(lens_at(57.88), 6, 2.0, (1.0, 5.0)), (0.0, 5.0), 1e4),
}


@pytest.mark.parametrize("name", CLIPPED)
def test_light_of_a_clipped_pupil_is_that_of_a_dense_one(name):
    """At order 4, of rings that follow the clear pupil; energy of 1, the rest in units of σ and σ².

    Counting blocked rays one by one leaves 1/1024 of the radius at every edge, averaged over 256 arms; corners of the
    pupil and arms tangent to an obscuration leave 1e-3 at 96 arms.
    """
    lens, field, distance = CLIPPED[name]
    computed = scene_of(lens, field, (distance,))
    result = gaussian.kernels(computed, Grid(scalar(1000.0), 1, 1, vector(0.0, 0.0)), order=4)
    energy, mx, my, xx, xy, yy = dense(computed)
    sigma = float((xx + yy).sqrt())
    assert 0.5 < float(energy) < 0.99
    assert float(result.kernel.sum()) == pytest.approx(float(energy), abs=1e-3)
    assert float(torch.linalg.vector_norm(result.centroid.flatten() - torch.stack([mx, my]))) < 1.5e-3 * sigma
    assert float(torch.linalg.vector_norm(result.covariance.flatten() - torch.stack([xx, xy, yy]))) < 1.5e-3 * sigma**2


def test_energy_of_an_obscured_mirror_is_its_area():
    """A flat obscuration of 396 mm before a mirror of 1,200 mm, in parallel light: exact, whatever the field."""
    computed = scene_of(CLIPPED["obscured"][0], (0.0, 0.05), (math.inf,))
    energy = gaussian.kernels(computed, Grid(scalar(1000.0), 1, 1, vector(0.0, 0.0)), order=2).kernel.sum()
    assert float(energy) == pytest.approx(1 - (396 / 1200) ** 2, abs=1e-9)


def test_an_aperture_that_clips_only_the_rim_is_noticed():
    """It takes a few per cent of the light, outside every ring of order 3: the rays at the rim find it."""
    lens = clipped(lens_at(), 1, 33.33 / 2 * math.sqrt(0.97))
    rays = trace_scene(scene_of(lens, (0.0, 0.0)), gaussian.fold_pupil(3, "round", lens.wavelengths)[0])
    assert bool(rays.valid.all())
    energy = gaussian.kernels(scene_of(lens), grid(0.2, 41), order=3).kernel.sum()
    assert 0.96 < float(energy) < 0.98


def test_a_lens_that_clips_nothing_costs_no_search():
    """With apertures, the rim is looked at: one more ray on the axis, 17 of half a pupil at order 5; never a search."""
    wide = clipped(lens_at(), 6, 30.0)
    for field, plain, probed in (((0.0, 0.0), 5, 6), ((0.0, 10.0), 40, 57)):
        for lens, rays in ((lens_at(), plain), (wide, probed)):
            assert gaussian.kernels(scene_of(lens, field), grid(0.005, 3), order=5).rays == rays
        with_rim, without = (gaussian.kernels(scene_of(t, field), grid(0.005, 3), order=5) for t in (wide, lens_at()))
        torch.testing.assert_close(with_rim.kernel, without.kernel, rtol=1e-13, atol=0)


@pytest.mark.parametrize("lens", [lens_at(), clipped(lens_at(), 6, 7.0)])
def test_a_batch_is_its_single_kernels_at_every_order(lens):
    where = Grid(scalar(0.03), 3, 3, vector(0.0, 10.0))
    fields, distances = vector(0.0, 0.0, 5.9, 14.0).reshape(2, 2), vector(10_000.0, 25_000.0)
    whole = gaussian.kernels(scene(lens, fields, distances, vector(0.53)), where, order=4)
    for d, f in ((0, 0), (1, 1)):
        one = gaussian.kernels(scene(lens, fields[:, f : f + 1], distances[d : d + 1], vector(0.53)), where, order=4)
        torch.testing.assert_close(whole.kernel[d, f], one.kernel[0, 0], rtol=1e-9, atol=1e-14)
        torch.testing.assert_close(whole.covariance[:, d, f], one.covariance[:, 0, 0], rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("kind", ["rims", "obscuration"])
def test_clipped_beams_of_a_batch_are_searched_at_once_and_leave_the_others(kind, monkeypatch):
    """Two rims whose images cross in the pupil, or a stop in part of the beam: values and derivatives of each kernel
    are those of a call for it alone, whose rays are as many."""
    lens, searched = clipped(clipped(lens_at(), 1, 19.0), 10, 13.0), []
    if kind == "obscuration":
        lens = obscured(lens_at(), 1, 4.0, (0.0, -12.0))
    curvature, radius = lens.surfaces[3].curvature.clone().requires_grad_(), scalar(19.0).requires_grad_()
    lens = lens.replace(3, curvature=curvature)
    if kind == "rims":
        lens = lens.replace(1, apertures=(Aperture("circular", (0.0, radius)),))
    arms_of = gaussian.arms_of
    monkeypatch.setattr(
        gaussian, "arms_of", lambda scene, *rest: (searched.append(scene.shape), arms_of(scene, *rest))[1]
    )
    fields, distances, colours = (
        vector(0.0, 1.0, 0.5, 1.0, 6.0, 14.0).reshape(2, 3),
        vector(5e3, 25e3),
        vector(0.48, 0.6),
    )
    where = Grid(scalar(0.05), 3, 3, vector(0.0, 8.0))
    whole = gaussian.kernels(scene(lens, fields, distances, colours), where, order=4)
    assert len(searched) == 1
    if kind == "rims":
        assert searched[0] == (4, 1, 2)  # the beam of the axis is not clipped
    by = [curvature, *([radius] if kind == "rims" else [])]
    for d in range(2):
        for f in range(3):
            one = gaussian.kernels(scene(lens, fields[:, f : f + 1], distances[d : d + 1], colours), where, order=4)
            torch.testing.assert_close(whole.kernel[d, f], one.kernel[0, 0], rtol=0, atol=1e-13)
            torch.testing.assert_close(whole.residual[d, f], one.residual[0, 0], rtol=1e-9, atol=1e-12)
            found, wanted = (
                torch.autograd.grad(k.square().sum(), by, retain_graph=True, materialize_grads=True)
                for k in (whole.kernel[d, f], one.kernel[0, 0])
            )
            for slope, alone in zip(found, wanted, strict=True):
                torch.testing.assert_close(slope, alone, rtol=1e-10, atol=1e-14)


def test_a_dark_kernel_of_a_batch_is_zero_and_leaves_the_others():
    lens = clipped(lens_at(), 6, 7.0)
    curvature = lens.surfaces[3].curvature.clone().requires_grad_()
    lens = clipped(lens, 1, 6.0).replace(3, curvature=curvature)
    fields, where = vector(0.0, 0.0, 0.0, 40.0).reshape(2, 2), grid(0.02, 5)
    both = gaussian.kernels(scene(lens, fields, vector(1e4), vector(0.53)), where, order=3)
    one = gaussian.kernels(scene(lens, fields[:, :1], vector(1e4), vector(0.53)), where, order=3)
    assert float(both.kernel[0, 1].detach().abs().sum()) == 0
    assert float(both.covariance[:, 0, 1].detach().abs().sum()) == 0
    torch.testing.assert_close(both.kernel[0, 0], one.kernel[0, 0], rtol=1e-9, atol=1e-12)
    (dark,) = torch.autograd.grad(both.kernel[0, 1].sum() + both.centroid[:, 0, 1].sum(), curvature, retain_graph=True)
    assert float(dark) == 0
    (lit,) = torch.autograd.grad(both.kernel.square().sum(), curvature)
    (alone,) = torch.autograd.grad(one.kernel.square().sum(), curvature)
    assert float(lit) == pytest.approx(float(alone), rel=1e-6)


def test_no_ray_is_no_energy_and_no_gradient():
    lens = clipped(lens_at(), 6, 1e-9)
    distance = scalar(57.662).requires_grad_()
    result = gaussian.kernels(scene_of(with_sensor_distance(lens, distance), (0.0, 14.0)), grid(0.005, 5), order=4)
    assert (result.kernel == 0).all()
    assert torch.isfinite(result.residual).all()
    (slope,) = torch.autograd.grad(result.kernel.sum() + result.covariance.sum(), distance)
    assert slope == 0


@pytest.mark.parametrize(
    "field", [*(pytest.param(f, marks=pytest.mark.slow) for f in ((0.0, 0.0), (0.0, 14.0))), (8.0, 8.0)]
)
def test_derivatives_with_vignetted_rays(field):
    base = clipped(lens_at(), 6, 7.0)
    place = gaussian.kernels(scene_of(base, field), grid(0.005, 3), order=3).centroid.flatten()

    def kernel(curvature, thickness, sensor_distance, pitch, shift):
        lens = with_sensor_distance(
            base.replace(3, curvature=curvature / 10).replace(5, thickness=thickness), sensor_distance
        )
        pixel = Grid(pitch / 100, 2, 3, place + shift / 100)
        return 10 * gaussian.kernels(scene_of(lens, field, (10_000.0,)), pixel, order=3).kernel

    numbers = [scalar(0.27815929), scalar(14.253), scalar(57.662), scalar(2.0), vector(0.3, -0.2)]
    numbers = [number.requires_grad_() for number in numbers]
    rays = trace_scene(scene_of(base, field, (10_000.0,)), gaussian.fold_pupil(3, "none", base.wavelengths)[0])
    assert 0 < rays.valid.sum() < rays.valid.numel()
    assert torch.autograd.gradcheck(kernel, numbers, eps=1e-6, atol=1e-5, rtol=1e-4)
    if field[1] == 14.0:
        # Differences of 1e-6 err by up to 3e-3 here, of 1e-7 by 3e-5: they fall with the square of the step.
        assert torch.autograd.gradgradcheck(kernel, numbers, eps=1e-7, atol=1e-4, rtol=1e-3, fast_mode=True)


@pytest.mark.parametrize(
    ("field", "distance", "stop"),
    [
        (0.0, 25_000.0, 99.0),
        (0.0, 50_000.0, 99.0),
        (14.0, 25_000.0, 99.0),
        (14.0, 25_000.0, 11.0),
        (0.0, 50_000.0, 9.0),
    ],
)
def test_residual_is_the_distance_from_many_rays(field, distance, stop):
    """L¹ between the Gaussian and a histogram of 65,536 traced rays, which carries about 1 % noise itself."""
    computed = scene_of(clipped(lens_at(), 6, stop), (0.0, field), (distance,))
    place = gaussian.kernels(computed, grid(0.005, 3), order=5).centroid.flatten()
    pixel = Grid(scalar(0.005), 21, 21, place)
    result = gaussian.kernels(computed, pixel, order=6)
    rays = trace_scene(computed, sobol(65_536)[0])
    hits = rays.position[:2].reshape(2, -1)[:, rays.valid.flatten()]
    x, y = ((hits - place[:, None]) / 0.005 + 10.5).floor().to(torch.int64)
    kept = (x >= 0) & (x < 21) & (y >= 0) & (y < 21)
    h = torch.bincount((y * 21 + x)[kept], minlength=441).to(torch.float64) / hits.shape[1]
    shape = result.kernel.flatten() * 65_536 / hits.shape[1]
    true = (h - shape).abs().sum() / h.sum()
    assert result.residual.item() == pytest.approx(true.item(), abs=0.02)


def test_a_kernel_loads_no_computer_algebra(monkeypatch):
    monkeypatch.setattr(torch, "broadcast_shapes", None)  # its first call imports sympy
    assert rt.psf(rt.read_lens("singlet"), "gaussian", size=9).kernel.shape[-2:] == (9, 9)
