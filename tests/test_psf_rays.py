"""Splats and ray-traced PSFs: energy, brute force, bias of the blur, derivatives with vignetted rays."""

import dataclasses
from functools import partial
from pathlib import Path

import pytest
import torch
from differences import gradcheck, gradgradcheck
from problems import number, relative_l1, sharp_double_gauss

from raytrace.io import read_lens
from raytrace.maths.sampling import Grid, grid, sobol
from raytrace.psf_models import DRT, Gaussian, Wave, psf
from raytrace.psf_models.drt import below_edge, histogram, kernels_of_rays, splat, splat_cells, splat_smooth, trace_fans
from raytrace.system.lens import Lens, with_sensor_distance
from raytrace.system.surface import Aperture
from raytrace.tracing.scene import beam_share, scene
from raytrace.tracing.spot import image_rays

LENSES = Path(__file__).parents[1] / "lenses"


def scene_of(lens: Lens, field: float, distance: float = 1e4):
    wavelength = lens.primary[None]
    return scene(lens, number([[0.0], [field]]), number([distance]), wavelength)


def window(of, pitch: float = 0.005, size: int = 21) -> Grid:
    """A grid at the centroid of a scene, off it by a part of a pixel."""
    centre = kernels_of_rays(of, grid(pitch, 3), order=2).centroid.detach()
    return Grid(number(pitch), size, size, centre + 0.0003)


def test_splats_keep_the_energy_inside_and_drop_the_rest():
    points = number([[0.0, 0.011, 1e30, float("nan"), -0.2], [0.003, -0.004, 0.0, 0.0, 0.0]])
    weights = number([1.0, 2.0, 4.0, 8.0, 16.0])
    for image in (
        splat(grid(0.005, 9), points, weights),
        splat_smooth(grid(0.005, 9), points, weights, width=0.5),
        histogram(grid(0.005, 9), points, weights),
    ):
        assert float(image.sum()) == pytest.approx(3.0, abs=1e-14)
        assert (image >= 0).all()


def test_smooth_splat_is_the_histogram_far_from_edges_and_twice_differentiable():
    points = number([[0.0, 0.0051], [0.0001, -0.0049]])
    exact = histogram(grid(0.005, 5), points, number([1.0, 1.0]))
    assert (splat_smooth(grid(0.005, 5), points, number([1.0, 1.0]), width=0.25) - exact).abs().max() < 1e-15
    near = number([[0.0024, -0.0026, 0.0068], [0.0022, 0.0001, -0.0077]]).requires_grad_()

    def image(points):
        return splat_smooth(grid(0.005, 5), points, number([1.0, 0.5, 0.7]), width=0.5)

    assert gradcheck(image, near, eps=1e-9)
    assert gradgradcheck(image, near, eps=1e-9, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("width", [0.1, 0.25, 0.5])
def test_bias_of_the_smooth_kernel_is_its_second_moment(width):
    """Mean over all places in a pixel of the variance of the image: pitch²/12 of the pixel + x² + (width·pitch)²/7."""
    places = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000 - 0.5
    image = splat_smooth(grid(1.0, 5), torch.stack([places, 0 * places])[..., None], number([1.0]), width=width)
    x = torch.arange(5, dtype=torch.float64) - 2
    variance = (image.sum(-2) * (x - places[:, None]) ** 2).sum(-1).mean()
    assert float(variance) == pytest.approx(1 / 12 + width**2 / 7, abs=1e-6)


def test_edge_share_of_a_cell_is_its_integral_and_finite_without_width():
    s = (torch.arange(2000, dtype=torch.float64) + 0.5) / 1000 - 1
    for a, b, z in ((0.3, 0.1, 0.05), (0.1, -0.3, -0.25), (0.2, 0.2, 0.35), (0.3, 0.0, 0.1)):
        counted = (a * s[:, None] + b * s < z).double().mean()
        assert float(below_edge(number(z), number(a), number(b))[0]) == pytest.approx(float(counted), abs=2e-3)
    leaves = [number(x).requires_grad_() for x in (0.1, 0.0, 0.0)]
    below_edge(*leaves)[0].backward()
    assert all(torch.isfinite(leaf.grad) for leaf in leaves)


FEW, MANY = 1, 8  # times half a million rays


@pytest.mark.parametrize("field", [0.0, 10.0])
@pytest.mark.parametrize("times", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_equals_brute_force_within_its_noise(field, times):
    """√(pixels/rays) would be 1 % for 4 million random rays; Sobol points do better."""
    of = scene_of(sharp_double_gauss(stop=11.5 if field else 9.5), field)
    where = window(of)
    with torch.no_grad():
        counted = sum(kernels_of_rays(of, where, rays=2**19, sampling=s, width=0).kernel for s in seeds(times)) / times
        result = kernels_of_rays(of, where, order=6)
    assert relative_l1(result.kernel, counted) < 0.01
    assert float(result.kernel.sum()) == pytest.approx(float(counted.sum()), abs=2e-3)
    assert float(counted.sum()) < 0.97  # some are vignetted


def seeds(count: int):
    return [lambda n, s=s, **like: sobol(n, seed=s, **like) for s in range(count)]


@pytest.mark.parametrize("field", [0.0, 14.0])
def test_error_falls_with_the_order_and_all_light_is_inside(field):
    of = scene_of(sharp_double_gauss(), field)
    where = window(of, size=61)
    with torch.no_grad():
        best = kernels_of_rays(of, where, order=8)
        errors = [relative_l1(kernels_of_rays(of, where, order=order).kernel, best.kernel) for order in (1, 3, 5)]
    assert errors[2] < errors[1] < errors[0]
    assert errors[2] < 0.02
    assert float(best.kernel.sum()) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("name", ["curvature", "thickness", "sensor", "pitch", "centre"])
def test_derivatives_are_those_of_the_kernel_with_vignetted_rays(name):
    lens, field = sharp_double_gauss(stop=11.5), 10.0
    where = window(scene_of(lens, field))
    weight = torch.randn(21, 21, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def merit(shift):
        changed, pixels = lens, where
        if name == "curvature":
            changed = lens.replace(3, curvature=lens.surfaces[3].curvature + 1e-4 * shift)
        elif name == "thickness":
            changed = lens.replace(2, thickness=lens.surfaces[2].thickness + shift)
        elif name == "sensor":
            changed = lens.at(sensor_distance=lens.surfaces[-2].thickness + shift)
        elif name == "pitch":
            pixels = Grid(where.pitch + 1e-3 * shift, 21, 21, where.centre)
        else:
            pixels = Grid(where.pitch, 21, 21, where.centre + 1e-2 * shift)
        return (kernels_of_rays(scene_of(changed, field), pixels, order=3).kernel * weight).sum()

    at = number(0.0).requires_grad_()
    (slope,) = torch.autograd.grad(merit(at), at)
    step = 1e-6
    with torch.no_grad():
        difference = (merit(number(step)) - merit(number(-step))) / (2 * step)
    assert float(slope) == pytest.approx(float(difference), rel=1e-3, abs=1e-3)
    assert float(slope) != 0


def test_vignetting_edge_has_a_derivative():
    """d(energy)/d(thickness before a stop that clips): a histogram of rays has none."""
    lens = sharp_double_gauss(stop=11.0)
    gap = lens.surfaces[4].thickness.clone().requires_grad_()
    of = scene_of(lens.replace(4, thickness=gap), 10.0)
    energy = kernels_of_rays(of, Grid(number(0.1), 61, 61, window(of).centre), order=4).kernel.sum()
    (slope,) = torch.autograd.grad(energy, gap)
    assert 0.1 < float(energy.detach()) < 0.95
    assert abs(float(slope)) > 1e-4


def test_no_light_is_zero_energy_and_zero_gradient():
    lens = sharp_double_gauss().replace(5, apertures=(Aperture("circular", (0.0, 1.0), False, (500.0, 0.0)),))
    sensor = number(57.0).requires_grad_()
    of = scene_of(with_sensor_distance(lens, sensor), 10.0)
    for options in ({"order": 1}, {"rays": 64}):
        result = kernels_of_rays(of, grid(0.005, 5), **options)
        total = result.kernel.sum() + result.centroid.sum() + result.covariance.sum()
        (slope,) = torch.autograd.grad(total, sensor)
        assert float(result.kernel.detach().abs().sum()) == 0
        assert float(slope) == 0


def test_a_positive_field_moves_the_light_to_positive_y():
    result = kernels_of_rays(scene_of(sharp_double_gauss(), 10.0), grid(0.005, 3), order=2)
    assert float(result.centroid[1]) > 10
    assert abs(float(result.centroid[0])) < 1e-9


def test_central_obscuration_takes_its_area():
    lens = read_lens(LENSES / "hubble.zmx")
    of = scene_of(lens, 0.05, float("inf"))
    result = kernels_of_rays(
        of, Grid(number(0.05), 21, 21, kernels_of_rays(of, grid(0.05, 3), order=2).centroid), order=5
    )
    assert float(result.kernel.sum()) == pytest.approx(1 - (396 / 1200) ** 2, abs=2e-3)


def test_vignetting_factors_take_their_area():
    lens = read_lens(LENSES / "double_gauss_28deg.zmx")
    of = scene_of(lens, float(lens.fields.y[2]), float("inf"))
    factors = lens.fields.vignetting[:, 2]
    share = float((1 - factors[2]) * (1 - factors[3]))
    assert share < 1
    assert float(beam_share(of).squeeze()) == pytest.approx(share, rel=1e-12)


def test_symmetric_scenes_trace_a_line_or_half_a_pupil_and_find_the_same():
    lens = sharp_double_gauss(stop=11.5)
    general = dataclasses.replace(scene_of(lens, 10.0), fields=number([[0.0], [10.0]]).requires_grad_())
    half, full = trace_fans(scene_of(lens, 10.0), 1), trace_fans(general, 1)
    assert 2 * half.rays == full.rays
    assert (half.points - full.points).abs().max() < 1e-12
    axial = dataclasses.replace(scene_of(lens, 0.0), fields=number([[0.0], [0.0]]).requires_grad_())
    line, full = trace_fans(scene_of(lens, 0.0), 1), trace_fans(axial, 1)
    assert line.rays * 24 == full.rays
    assert (line.points - full.points).abs().max() < 1e-12


def test_cells_of_a_focus_smaller_than_a_pixel_are_finite():
    points = torch.zeros(2, 8, 4, dtype=torch.float64, requires_grad=True)
    image = splat_cells(grid(0.005, 3), points, torch.linspace(0, 1, 4, dtype=torch.float64))
    assert float(image.detach()[1, 1]) == pytest.approx(1.0, abs=1e-14)
    (slope,) = torch.autograd.grad(image.square().sum(), points)
    assert torch.isfinite(slope).all()


def test_pupil_points_are_the_rays_of_a_kernel():
    """As many Sobol rays give the kernel of their number; a Gaussian has their centroid and covariance."""
    lens = read_lens("double_gauss").at(ray_aiming="real", wavelengths=(0.48, 0.53, 0.62))
    about = {"fields": [0, 10], "object_distances": [2e4, 3e4]}
    points = sobol(64)[0]
    of_points, of_number = (psf(lens, DRT(rays=rays), **about) for rays in (points, 64))
    assert torch.equal(of_points.kernel, of_number.kernel)
    gaussian = psf(lens, Gaussian(rays=points), **about)
    for k, distance in enumerate(about["object_distances"]):
        rays = image_rays(lens.at(object_distance=distance), points, fields=number([[0.0, 0.0], [0.0, 10.0]]))
        places = rays.position[:2].expand(2, 2, 3, -1).flatten(2, 3)  # all wavelengths have as many rays
        weights = lens.wavelength_weights.repeat_interleave(64) / (64 * lens.wavelength_weights.sum())
        mean = (places * weights).sum(-1)
        assert torch.allclose(gaussian.centroid[:, k], mean, rtol=0, atol=1e-12)
        square = ((places - mean[..., None]) ** 2 * weights).sum(-1)
        assert torch.allclose(gaussian.covariance[::2, k], square, rtol=1e-9, atol=1e-15)
    with pytest.raises(ValueError, match="not pupil points"):
        psf(lens, Wave(rays=points), **about)
    with pytest.raises(ValueError, match=r"pupil points \(2, P\)"):
        psf(lens, DRT(rays=points[0]), **about)


def test_rays_of_two_shares_have_the_light_of_all():
    """Each of two processes traces half of the points: their kernels add up to the kernel of all."""
    of = scene_of(sharp_double_gauss(), 5.0)
    pixels = window(of, pitch=0.02)
    whole = kernels_of_rays(of, pixels, rays=60)

    def half(count, part, **like):
        points, weights = sobol(count, **like)
        return points[:, part::2], weights[part::2]

    parts = [kernels_of_rays(of, pixels, rays=60, sampling=partial(half, part=part)) for part in (0, 1)]
    torch.testing.assert_close(sum(part.kernel for part in parts), whole.kernel, rtol=0, atol=1e-14)
    torch.testing.assert_close(sum(part.arrived for part in parts), whole.arrived, rtol=0, atol=1e-14)
    assert {part.rays for part in parts} == {60}
