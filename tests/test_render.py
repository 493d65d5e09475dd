"""Pictures of a lens over its sensor: varying blur, distortion, illumination, colour and depth."""

import dataclasses
import math
import re
import sys
import warnings

import numpy as np
import pytest
import torch
from problems import random

import raytrace as rt
from raytrace.budget import OverBudget, within
from raytrace.imaging import field_kernels
from raytrace.imaging.field_kernels import FieldKernels, WindowTooLarge, channel_moments
from raytrace.imaging.image import blur, blur_layers, depth_masks, encoded, linearised
from raytrace.imaging.render import (
    BeyondFields,
    ImageFormation,
    Rendering,
    _over_response,
    default_sensor,
    optics,
    render_patches,
)
from raytrace.imaging.spectral_response import band
from raytrace.imaging.varying_blur import bilinear, varying_blur
from raytrace.imaging.warp import resampled
from raytrace.psf_models.gaussian import gaussian_pixels, wide_gaussian_pixels
from raytrace.system.lens import with_field_kind

render_module = sys.modules["raytrace.imaging.render"]
COLUMNS, ROWS = 48, 32
SENSOR = rt.Sensor(size=(2.4, 1.6), pixels=(COLUMNS, ROWS), response="rgb")  # 50 µm
FIELD = rt.Sensor(size=(18.0, 12.0), pixels=(COLUMNS, ROWS), response="rgb")


@pytest.fixture(scope="module", autouse=True)
def compiled():
    rt.tracing.prepare()


@pytest.fixture(scope="module")
def triplet():
    """A defocused Cooke triplet, whose blur is some of the pixels of FIELD, 0.375 mm, wide."""
    lens = rt.read_lens("cooke_triplet")
    return lens.at(sensor_distance=lens.surfaces[-2].thickness + 3.0)


def ready(lens, sensor=FIELD, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        how = {"model": "gaussian", "wavelengths": lens.wavelengths, "nodes": (3, 4), "order": 4, "tol": 1e-9}
        return optics(lens, sensor, **{**how, **options})  # no low rank


def direct(picture, kernels, *, boundary="zero"):
    """The sum over all points of the picture, each with the kernel that is interpolated at its place."""
    m, n, C, h, w = kernels.shape
    rows, columns = picture.shape[-2:]
    down, right = (bilinear(count, 0, nodes, like=kernels) for count, nodes in ((rows, m), (columns, n)))
    total = picture.new_zeros(C, rows + h - 1, columns + w - 1)
    for i in range(rows):
        for j in range(columns):
            kernel = torch.einsum("m,n,mncij->cij", down[:, i], right[:, j], kernels)
            total[:, i : i + h, j : j + w] += picture[:, i, j, None, None] * kernel
    return total[:, h // 2 : h // 2 + rows, w // 2 : w // 2 + columns]


# -- varying blur


@pytest.mark.parametrize("nodes", [(1, 1), (2, 3), (4, 2), (1, 5)])
@pytest.mark.parametrize("shape", [(16, 23), (9, 4), (3, 3)])
def test_patches_are_the_direct_sum(nodes, shape):
    kernels, picture = random(*nodes, 2, 5, 7), random(2, *shape, seed=1)
    found = varying_blur(picture, kernels, boundary="zero")
    torch.testing.assert_close(found, direct(picture, kernels), rtol=0, atol=1e-12)


def test_low_rank_is_the_direct_sum_to_its_tolerance(monkeypatch):
    monkeypatch.setattr("raytrace.imaging.varying_blur._operations_of_rank", lambda *_: 0.0)
    x = torch.linspace(-1, 1, 9, dtype=torch.float64)
    sigma = torch.linspace(0.3, 0.5, 6, dtype=torch.float64).reshape(2, 3, 1, 1, 1)
    kernels = torch.exp(-0.5 * (x[:, None] ** 2 + x**2) / sigma**2)
    kernels = kernels / kernels.sum((-2, -1), keepdim=True)
    picture = random(1, 21, 30)
    exact = direct(picture, kernels)
    for tol in (1e-2, 1e-4):
        close = varying_blur(picture, kernels, boundary="zero", tol=tol)
        assert 1e-14 < float((close - exact).abs().max()) < tol * float(picture.max())


def test_a_single_kernel_is_an_ordinary_blur():
    kernels, picture = random(1, 1, 3, 5, 5), random(4, 3, 17, 20, seed=2)
    found = varying_blur(picture, kernels, boundary="reflect")
    torch.testing.assert_close(found, blur(picture, kernels[0, 0], boundary="reflect"), rtol=0, atol=1e-12)


@pytest.mark.parametrize("boundary", ["zero", "reflect"])
def test_the_transpose_is_the_adjoint(boundary):
    kernels = random(3, 3, 1, 5, 5)
    x, y = random(1, 14, 19, seed=3).requires_grad_(), random(1, 14, 19, seed=4)
    image = varying_blur(x, kernels, boundary=boundary)
    (transposed,) = torch.autograd.grad(image, x, y)
    assert float((image.detach() * y).sum()) == pytest.approx(float((x.detach() * transposed).sum()), rel=1e-10)


@pytest.mark.parametrize(
    ("picture", "kernels", "message"),
    [
        ((1, 8, 8), (2, 2, 1, 4, 5), "odd h and w"),
        ((2, 8, 8), (2, 2, 3, 5, 5), "3 channels"),
        ((8, 8), (2, 2, 1, 5, 5), "C, H, W"),
    ],
)
def test_wrong_shapes_are_refused(picture, kernels, message):
    with pytest.raises(ValueError, match=message):
        varying_blur(random(*picture), random(*kernels))


# -- kernels over the sensor


@pytest.mark.parametrize("model", ["gaussian", "drt"])
def test_kernels_are_those_of_psf_at_their_places(triplet, model):
    """On an octant, its mirror images and off the grid, in the orientation of an upright picture."""
    points = torch.tensor([[0.0, 3.0, -3.0, 5.0, -2.0], [4.0, 1.0, -1.0, 5.0, -6.0]], dtype=torch.float64)
    lens = triplet.at(fields=[11.9])  # without vignetting factors, which move the chief ray of a PSF
    weights = FIELD.weights(lens.wavelengths)
    kernels = FieldKernels(lens, FIELD, model, 6, 9, lens.surfaces[0].thickness.reshape(1), weights, nodes=257)
    found = kernels.at(points)
    assert found.shape == (5, 1, 3, 9, 9)
    fields = FIELD.fields(lens, points)
    parameters = {"gaussian": rt.psf_models.Gaussian, "drt": rt.psf_models.DRT}[model](order=6)
    for k in range(5):
        alone = rt.psf(
            lens, parameters, fields=fields[:, k : k + 1], center="chief", per_wavelength=True, normalise="window",
            grid=rt.maths.grid(FIELD.pitch, 9),
        ).kernel[0, 0]  # fmt: skip
        wanted = torch.einsum("cw,wij->cij", weights, alone).flip(-1)
        # The Gaussians are interpolated between radii; turned rays fall in other pixels of the same histogram.
        assert float((found[k, 0] - wanted).abs().sum((-2, -1)).max()) < {"gaussian": 1e-5, "drt": 0.02}[model]


def test_kernels_lie_where_the_light_does(triplet):
    """About the chief ray through the centre of the pupil, whose landing the distortion is of."""
    point = torch.tensor([[0.0], [8.0]], dtype=torch.float64)
    fields = FIELD.fields(triplet, point)
    centroid = rt.psf(triplet, rt.psf_models.Gaussian(order=4), fields=fields, wavelengths=[triplet.primary]).centroid[
        1, 0, 0
    ]
    grey = dataclasses.replace(FIELD, response=None)
    lens = triplet.at(wavelengths=[float(triplet.primary)])
    for model in ("gaussian", "drt"):
        kernels = FieldKernels(lens, grey, model, 4, 21, lens.surfaces[0].thickness.reshape(1), torch.ones(1, 1))
        kernel = kernels.at(point)[0, 0, 0]
        rows = (torch.arange(21, dtype=torch.float64) - 10) * FIELD.pitch
        assert float((kernel.sum(-1) * rows).sum()) == pytest.approx(float(centroid - 8.0), abs=3e-3)


def test_a_kernel_off_the_meridian_is_the_turned_one(triplet):
    kernels = ready(triplet, nodes=(5, 5), distortion=False, illumination=False).kernels[:, :, 0]
    torch.testing.assert_close(kernels, kernels.flip(0).flip(-2), rtol=0, atol=1e-13)
    torch.testing.assert_close(kernels, kernels.flip(1).flip(-1), rtol=0, atol=1e-13)
    assert float((kernels - kernels.flip(-1)).abs().max()) > 1e-3  # coma


def test_narrow_gaussians_in_large_windows_are_those_of_every_pixel(triplet, monkeypatch):
    """Places with little blur are integrated on the pixels that it reaches, 6 σ: 2e-9 of the light is beyond."""
    weights = FIELD.weights(triplet.wavelengths)
    like = FieldKernels(triplet, FIELD, "gaussian", 4, 51, torch.tensor([torch.inf]).double(), weights)
    points = FIELD.on_diagonal((0.0, 0.3, 1.0)).double()
    kernels, count = like.at(points), []

    def counted(window, *moments):
        count.append(window.rows)
        return gaussian_pixels(window, *moments)

    monkeypatch.setattr(field_kernels, "_ALL_LIGHT", 1e3)
    monkeypatch.setattr(field_kernels, "gaussian_pixels", counted)
    assert float((like.at(points) - kernels).abs().sum((-2, -1)).max()) < 1e-8
    assert set(count) == {51}


def test_window_that_would_be_too_large_is_refused(triplet):
    fine = rt.Sensor(size=(18.0, 12.0), pixels=(18000, 12000))
    with pytest.raises(WindowTooLarge, match=r"focus the lens.*larger pixels.*--sensor"):
        optics(triplet, fine, model="gaussian")


# -- rendering


def test_light_is_kept(triplet):
    picture = torch.zeros(3, ROWS, COLUMNS, dtype=torch.float64)
    picture[:, 12:20, 16:30] = random(3, 8, 14)
    system = ready(triplet, distortion=False, illumination=False)
    image = system(picture, boundary="zero")
    assert float(image.sum()) == pytest.approx(float((system.flux[0] * picture).sum()), rel=1e-6)
    assert float((system.flux - 1).abs().max()) < 0.02


@pytest.mark.parametrize("place", [(16, 24), (5, 7), (30, 46)])
def test_a_point_gives_the_kernel_at_its_place(triplet, place):
    triplet = triplet.at(fields=[11.9])  # vignetting factors are linear in the field, with a kink on the axis
    system = ready(triplet, nodes=(25, 37), distortion=False, illumination=False)
    picture = torch.zeros(3, ROWS, COLUMNS, dtype=torch.float64)
    picture[:, place[0], place[1]] = 1
    image = system(picture, boundary="zero")
    size = system.kernels.shape[-1]
    half = size // 2
    image = torch.nn.functional.pad(image, (half,) * 4)[:, place[0] : place[0] + size, place[1] : place[1] + size]
    point = FIELD.points(torch.tensor([place[1]]), torch.tensor([place[0]]))
    weights = FIELD.weights(triplet.wavelengths)
    distance = triplet.surfaces[0].thickness.reshape(1)
    exact = FieldKernels(triplet, FIELD, "gaussian", system.order, size, distance, weights).at(point)[0, 0]
    exact = system.flux[0, :, place[0], place[1], None, None] * exact
    top, left = max(0, half - place[0]), max(0, half - place[1])
    bottom, right = min(size, ROWS - place[0] + half), min(size, COLUMNS - place[1] + half)
    part = (slice(None), slice(top, bottom), slice(left, right))
    assert float((image - exact)[part].abs().sum((-2, -1)).max()) < 1e-3


def test_a_turned_scene_renders_turned(triplet):
    system = ready(triplet, nodes=(5, 7))
    picture = random(3, ROWS, COLUMNS)
    image = system(picture)
    torch.testing.assert_close(system(picture.flip(-1, -2)), image.flip(-1, -2), rtol=0, atol=1e-10)
    torch.testing.assert_close(system(picture.flip(-1)), image.flip(-1), rtol=0, atol=1e-10)


def test_a_constant_stays_constant_but_for_the_illumination(triplet):
    system = ready(triplet)
    white = torch.ones(3, ROWS, COLUMNS, dtype=torch.float64)
    torch.testing.assert_close(ready(triplet, illumination=False)(white), white, rtol=0, atol=3e-4)
    shade = system.illumination
    assert float(shade.min()) < 0.9
    assert float(shade.max()) <= 1 + 1e-9
    torch.testing.assert_close(system(white), shade.expand_as(white), rtol=0, atol=3e-4)


def test_the_flux_is_computed_on_larger_pixels(triplet, monkeypatch):
    fine = rt.Sensor(size=(18.0, 12.0), pixels=(144, 96))
    white = torch.ones(1, 96, 144, dtype=torch.float64)
    monkeypatch.setattr("raytrace.imaging.render._COARSE", 30)
    system = ready(triplet, fine)
    assert system.flux.shape == (1, 1, 20, 29)
    plain = dataclasses.replace(system, flux=system.illumination.expand_as(white)[None])
    inside = (slice(None), slice(5, -5), slice(5, -5))  # at the border the larger pixels are not whole
    off = [(one(white) - system.illumination)[inside].square().mean().sqrt() for one in (system, plain)]
    assert float(off[0]) < 1e-3
    assert float(off[1]) > 2e-3


def test_the_illumination_is_the_analysis(triplet):
    shade = ready(triplet).illumination
    points = torch.tensor([[10, 40], [3, 30]])
    fields = FIELD.fields(triplet, FIELD.points(points[0], points[1]))
    wanted = rt.relative_illumination(triplet, fields=fields).illumination
    torch.testing.assert_close(shade[points[1], points[0]], wanted, rtol=0, atol=2e-3)


def whole_field(lens):
    """A sensor of 60 × 40 pixels with the largest field in its corners."""
    return default_sensor(lens, torch.zeros(1, 40, 60))


@pytest.mark.parametrize("name", ["cooke_triplet", "phone", "double_gauss_28deg"])
def test_the_distortion_is_that_of_chief_rays(name):
    lens = rt.read_lens(name)
    sensor = whole_field(lens)
    places = ready(lens, sensor, illumination=False, size=3, order=4, nodes=(1, 1)).ideal
    at = torch.tensor([[3, 50, 59], [38, 10, 0]])
    points = sensor.points(at[0], at[1])
    slope = torch.tan(torch.deg2rad(sensor.fields(lens, points)))
    near = torch.tan(torch.deg2rad(sensor.fields(lens, 1e-4 * points)))
    wanted = sensor.pixel_of(slope / near * 1e-4 * points)
    torch.testing.assert_close(places[:, at[1], at[0]], wanted, rtol=0, atol=2e-3)  # of a pixel


def test_a_picture_of_lines_is_bent_as_the_distortion_says():
    """A ramp of columns is the column itself, to the change of width of a pixel: squares are of constant light."""
    lens = rt.read_lens("phone")
    system = ready(lens, whole_field(lens), illumination=False, nodes=(1, 1), size=3)
    ramp = torch.arange(60.0, dtype=torch.float64).expand(1, 40, 60)
    inside = (slice(8, -8), slice(8, -8))
    bent = resampled(ramp, system.ideal, "reflect")[0]
    assert float((bent - ramp[0])[inside].abs().max()) > 0.02
    wider = float((system.ideal[0].diff(dim=1) - 1).abs().max())
    assert wider < 0.05
    torch.testing.assert_close(bent[inside], system.ideal[0][inside], rtol=0, atol=0.5 * wider)


def barrel(rows=24, columns=30, strength=2e-4):
    row, column = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (rows, columns)), indexing="ij")
    middle = torch.tensor([0.5 * (columns - 1), 0.5 * (rows - 1)], dtype=torch.float64)[:, None, None]
    away = torch.stack([column, row]) - middle
    return middle + away * (1 + strength * away.square().sum(0)), away.square().sum(0)


def test_a_distorted_picture_has_no_negative_light_and_keeps_it():
    """Squares of 0 and 0.8, and a point, whose light is that times the area of its image."""
    places, square = barrel()
    row, column = torch.meshgrid(torch.arange(24), torch.arange(30), indexing="ij")
    squares = 0.8 * ((row // 3 + column // 3) % 2).double()[None]
    seen = resampled(squares, places, "reflect")
    assert float(seen.min()) == 0.0
    assert float(seen.max()) <= 0.8 + 1e-12
    picture = random(1, 24, 30)
    picture[:, :4] = picture[:, -4:] = picture[:, :, :4] = picture[:, :, -4:] = 0
    light = resampled(picture, places, "zero")
    jacobian = (1 + 2e-4 * square) * (1 + 6e-4 * square)  # of the picture by the image
    assert float((light * jacobian).sum()) == pytest.approx(float(picture.sum()), rel=2e-3)
    assert float(jacobian.max()) > 1.15


def test_derivatives_of_a_distorted_picture():
    places, _ = barrel(5, 6, 1e-2)
    picture = random(2, 5, 6)
    assert torch.autograd.gradcheck(
        lambda picture, places: resampled(picture, places, "reflect"),
        [x.requires_grad_() for x in (picture, places + 0.013)], eps=1e-7, atol=1e-6,
    )  # fmt: skip


def test_without_lateral_colour_every_wavelength_lies_about_its_own_chief_ray(triplet):
    """Then its kernel is that of `psf` there; else it is shifted as the chief ray is."""
    point, distance = torch.tensor([[0.0], [6.0]], dtype=torch.float64), triplet.surfaces[0].thickness.reshape(1)
    each = torch.eye(3, dtype=torch.float64)
    about = {
        lateral: FieldKernels(triplet, FIELD, "gaussian", 4, 15, distance, each, lateral) for lateral in (True, False)
    }
    kernels = {lateral: one.at(point)[0, 0] for lateral, one in about.items()}
    fields = FIELD.fields(triplet, point)
    for w in range(3):
        wavelengths = triplet.wavelengths[w : w + 1]
        there = FIELD.landing(triplet, fields, wavelengths)[..., 0]
        window = rt.maths.grid(torch.tensor(FIELD.pitch, dtype=torch.float64), 15, there[:, None])
        how = {"wavelengths": wavelengths, "grid": window, "center": "axis", "normalise": "window"}
        wanted = rt.psf(triplet, rt.psf_models.Gaussian(order=4), fields=fields, **how).kernel[0, 0].flip(-1)
        torch.testing.assert_close(kernels[False][w], wanted, rtol=0, atol=1e-5)
        lines = torch.arange(15, dtype=torch.float64)
        rows = [float((kernels[lateral][w].sum(-1) * lines).sum()) for lateral in (True, False)]
        shift = float((there - point)[1]) / FIELD.pitch
        assert rows[0] - rows[1] == pytest.approx(shift, abs=2e-4)


@pytest.mark.parametrize("name", ["curvature", "thickness"])
def test_gradients_of_the_whole_rendering_are_those_of_differences(triplet, name):
    picture, weight = random(3, ROWS, COLUMNS), random(3, ROWS, COLUMNS, seed=5)
    number = getattr(triplet.surfaces[3], name).clone()
    fixed = ready(triplet)

    def value(number):
        lens = triplet.replace(3, **{name: number})
        return (ready(lens, size=fixed.kernels.shape[-1])(picture) * weight).sum()

    number.requires_grad_()
    (gradient,) = torch.autograd.grad(value(number), number)
    step = 1e-5 * max(abs(float(number)), 1e-2)
    with torch.no_grad():
        difference = (value(number + step) - value(number - step)) / (2 * step)
    assert float(gradient) == pytest.approx(float(difference), rel=2e-5)


def test_single_precision_is_close(triplet):
    system, picture = ready(triplet), random(3, ROWS, COLUMNS)
    image = system(picture.float())
    assert image.dtype == torch.float32
    torch.testing.assert_close(image.double(), system(picture), rtol=0, atol=2e-6)


# -- depth


def test_layers_are_those_of_blur_layers(triplet):
    distances = torch.tensor([2e3, 4e3, math.inf], dtype=torch.float64)
    near = triplet.at(object_distance=4e3)
    system = ready(near, object_distances=distances, nodes=(1, 1), distortion=False, illumination=False)
    picture = random(3, ROWS, COLUMNS)
    depth = torch.tensor([2e3, 4e3, math.inf], dtype=torch.float64).repeat(ROWS, COLUMNS // 3)
    masks = depth_masks(1 / depth, 1 / distances.flip(0))
    wanted = blur_layers(picture, masks, system.kernels[0, 0], boundary="reflect")
    torch.testing.assert_close(system(picture, depth), wanted, rtol=0, atol=1e-10)
    assert len(system.planes) == 3
    assert torch.equal(system.planes, (1 / distances).sort().values)


def test_a_blurred_near_object_has_a_soft_silhouette(triplet):
    """A near half plane a in front of a far one b, 0.9 and 0.2: α a + (1 - α) b, on either side of its edge."""
    distances = torch.tensor([1e3, math.inf], dtype=torch.float64)
    grey = dataclasses.replace(FIELD, response=None)
    system = ready(triplet, grey, object_distances=distances, nodes=(1, 1), distortion=False, illumination=False)
    near = torch.zeros(ROWS, COLUMNS, dtype=torch.float64)
    near[:, : COLUMNS // 2] = 1
    depth = torch.where(near > 0, 1e3, math.inf)
    alpha = blur(near[None], system.kernels[0, 0, 1], boundary="reflect")
    image = system((0.2 + 0.7 * near)[None], depth)
    torch.testing.assert_close(image, 0.9 * alpha + 0.2 * (1 - alpha), rtol=0, atol=1e-9)
    assert float(image[0, ROWS // 2].diff().abs().max()) < 0.3
    shown = system((0.2 + 0.7 * near)[None], depth, background=torch.full((1, ROWS, COLUMNS), 0.5).double())
    behind = 0.5 * blur(near[None], system.kernels[0, 0, 0], boundary="reflect")
    behind = behind + 0.2 * blur(1 - near[None], system.kernels[0, 0, 0], boundary="reflect")
    torch.testing.assert_close(shown, 0.9 * alpha + (1 - alpha) * behind, rtol=0, atol=1e-9)


def test_rendering_maps_over_pictures(triplet):
    system, pictures = ready(triplet), random(2, 3, ROWS, COLUMNS)
    mapped = torch.func.vmap(lambda picture: varying_blur(picture, system.kernels[:, :, 0]))(pictures)
    torch.testing.assert_close(mapped, varying_blur(pictures, system.kernels[:, :, 0]), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_flat_depth_map_is_that_distance(triplet):
    picture = random(3, ROWS, COLUMNS)
    flat = torch.full((ROWS, COLUMNS), 3e3, dtype=torch.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        how = {"model": "gaussian", "distortion": False, "illumination": False}
        deep = rt.render(triplet, picture, sensor=FIELD, depth=flat, **how)
        alone = optics(
            triplet, FIELD, object_distances=torch.tensor([3e3]), distortion=False, illumination=False,
            model=deep.optics.model, order=deep.optics.order, nodes=deep.optics.kernels.shape[:2],
        )(picture)  # fmt: skip
    torch.testing.assert_close(deep.image, alone, rtol=0, atol=1e-9)


# -- the verb


def test_render_chooses_sensor_grid_and_window(triplet):
    picture = (random(3, 24, 36) * 255).to(torch.uint8)
    result = rt.render(triplet, picture, model="gaussian", tol=0.05)
    assert result.image.shape == (3, 24, 36)
    corner = torch.hypot(*result.optics.sensor.corners[:, 0])
    largest = result.optics.sensor.landing(triplet, torch.tensor([[0.0], [11.9]], dtype=torch.float64))[1]
    assert float(corner) == pytest.approx(float(largest.abs()), rel=1e-9)
    assert result.optics.error <= 0.025
    assert "kernels of" in str(result)
    torch.testing.assert_close(encoded(linearised(picture)) * 255, picture.float(), rtol=0, atol=1e-3)


@pytest.mark.slow
def test_a_grey_picture_and_one_smaller_than_a_kernel(triplet):
    fine = rt.Sensor(size=(0.09, 0.07), pixels=(9, 7))
    image = rt.render(triplet, random(7, 9), sensor=fine, model="gaussian", tol=0.1).image
    assert image.shape == (1, 7, 9)
    assert bool(torch.isfinite(image).all())


@pytest.mark.parametrize(
    ("picture", "options", "message"),
    [
        (torch.zeros(3, 30, 48), {}, "picture 48 × 30 pixels, sensor 48 × 32 pixels: .*resize the picture"),
        (torch.zeros(2, ROWS, COLUMNS), {}, "2 channels on a sensor of 3"),
        (torch.full((3, ROWS, COLUMNS), math.nan), {}, "numbers of the picture are not finite"),
        (torch.zeros(3, ROWS, COLUMNS, dtype=torch.int64), {}, "its white is unknown"),
        (torch.zeros(3, ROWS, COLUMNS), {"depth": torch.ones(5, 5)}, "the distance of every pixel"),
        (torch.zeros(3, ROWS, COLUMNS), {"depth": torch.full((ROWS, COLUMNS), -1.0)}, "distances above 0"),
        (torch.zeros(3, ROWS, COLUMNS), {"model": "airy"}, "model 'airy'"),
    ],
)
def test_bad_input_is_one_clear_error(triplet, picture, options, message):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(ValueError, match=message):
            rt.render(triplet, picture, sensor=FIELD, **{"model": "gaussian", "tol": 0.3, **options})


@pytest.mark.slow
def test_the_grid_is_refined_to_the_tolerance(triplet):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        how = {"model": "gaussian", "illumination": False, "distortion": False}
        errors = [optics(triplet, FIELD, tol=tol, **how).error for tol in (0.2, 0.02)]
    assert errors[0] <= 0.1
    assert errors[1] <= 0.01


@pytest.mark.slow
def test_the_error_of_a_few_cells_is_about_that_of_all(triplet, monkeypatch):
    how = {"model": "gaussian", "illumination": False, "distortion": False, "tol": 0.05}
    few = optics(triplet, FIELD, **how)
    monkeypatch.setattr(render_module, "_CELLS", 10**6)
    every = optics(triplet, FIELD, **how)
    assert few.kernels.shape == every.kernels.shape
    assert few.error == pytest.approx(every.error, rel=0.3)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_kernels_are_computed_once_unless_they_are_differentiated(triplet, monkeypatch):
    places = []
    at = FieldKernels.at
    monkeypatch.setattr(FieldKernels, "at", lambda self, points: places.append(points.shape[1]) or at(self, points))
    how = {"model": "gaussian", "illumination": False, "distortion": False, "tol": 0.3}
    kernels = optics(triplet, FIELD, **how).kernels
    assert places.count(kernels.shape[0] * kernels.shape[1]) == 1
    distance = torch.tensor(1e4, dtype=torch.float64, requires_grad=True)
    assert optics(triplet, FIELD, object_distances=distance, **how).kernels.requires_grad


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_wavelengths_over_the_response_are_no_more_than_the_tolerance_needs(triplet):
    counts = [
        len(optics(triplet, FIELD, model="gaussian", nodes=(2, 2), tol=tol, distortion=False).wavelengths)
        for tol in (0.3, 0.01)
    ]
    assert counts[0] < counts[1] <= 13


@pytest.fixture
def computed(monkeypatch):
    def kernels(*_, **__):
        raise AssertionError("kernels are computed")

    for name in ("_over_response", "_model_of"):
        monkeypatch.setattr(render_module, name, kernels)
    return pytest.raises(AssertionError, match="kernels are computed")


def test_a_sensor_far_beyond_the_fields_is_reported_before_the_kernels(triplet, computed):
    reported = pytest.warns(BeyondFields, match=r"43.3 mm .* 2 times .*smaller sensor")
    with reported, computed:
        optics(triplet, rt.Sensor(size=(72, 48), pixels=(240, 160), response="rgb"))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("name", "size", "columns"),
    [
        ("tessar", (90, 60), 240),
        pytest.param("cooke_triplet", (90, 60), 240, marks=pytest.mark.slow),
        pytest.param("cooke_triplet", (90, 60), 1200, marks=pytest.mark.slow),
        pytest.param("cooke_triplet", (150, 100), 240, marks=pytest.mark.slow),
    ],
)
def test_a_sensor_beyond_what_can_be_computed_is_refused_before_the_kernels(computed, name, size, columns):
    """The message has the largest sensor of the same pixels, which is computed."""
    lens = rt.read_lens(name)
    large = rt.Sensor(size=size, pixels=(columns, columns * 2 // 3), response="rgb")
    with pytest.raises((OverBudget, WindowTooLarge), match=r"at most about .* mm \(--sensor\) for") as refused:
        optics(lens, large)
    width, height = map(float, re.search(r"about ([\d.]+) × ([\d.]+) mm", str(refused.value)).groups())
    assert 50 < width < size[0]
    assert height == pytest.approx(width * 2 / 3, rel=1e-2)
    with computed:
        optics(lens, dataclasses.replace(large, size=(0.99 * width, 0.99 * width * 2 / 3)))


def test_no_error_is_estimated_of_requested_nodes(triplet):
    system = ready(triplet, nodes=(2, 2))
    assert isinstance(system, ImageFormation)
    assert np.isnan(system.error)


@pytest.mark.slow
def test_the_model_is_the_first_that_the_next_confirms(triplet):
    """Coarse pixels: a Gaussian; the blur of a defocused lens: rays, a disc; with what is left out."""
    coarse = rt.Sensor(size=(18.0, 12.0), pixels=(6, 4))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert optics(triplet, coarse, tol=0.5, illumination=False, distortion=False).model == "gaussian"
        small = rt.Sensor(size=(1.2, 0.8), pixels=(48, 32))
        result = rt.render(triplet.at(fields=[1.0]), torch.ones(32, 48).double(), sensor=small, tol=0.05)
    assert result.optics.model == "drt"
    assert "PSF model drt, 3 wavelengths; neglected: diffraction" in str(result)
    kernel = result.optics.kernels[0, 0, 0, 0]
    lines = torch.arange(len(kernel), dtype=torch.float64)
    row, column = ((kernel.sum(axis) * lines).sum() for axis in (1, 0))
    square = (lines[:, None] - row) ** 2 + (lines - column) ** 2
    rim = 2 * float((kernel * square).sum())  # squared radius of a disc of this mean square
    assert float(kernel[square < 1.3 * rim].sum()) > 0.99  # of a Gaussian 1 - exp(-2.6) = 0.93


def test_the_response_is_sampled_to_the_tolerance():
    """Lateral colour of the channels of the corner: that of 61 wavelengths, which three of the file miss by a third."""
    lens = rt.read_lens("cooke_triplet")
    sensor = rt.Sensor((36, 24), (1200, 800), response="rgb")
    point = sensor.corners[:, :1]
    fine = torch.linspace(0.347, 0.702, 61, dtype=torch.float64)

    def apart(lens):
        mean = channel_moments(lens, sensor, point, lens.surfaces[0].thickness.reshape(1), lateral_colour=True)[0]
        return float(torch.hypot(*(mean[:, 0, 0, 1] - mean[:, 0, 0, 2]))) / sensor.pitch

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exact = apart(lens.at(wavelengths=[float(lens.primary), *fine.tolist()]))
        sampled = _over_response(lens, sensor, band("rgb"), point, lens.surfaces[0].thickness.reshape(1), True, 1e-3)
        assert apart(sampled) == pytest.approx(exact, rel=0.03)
        assert abs(apart(lens) / exact - 1) > 0.2
    assert len(sampled.wavelengths) < 30
    assert float(sampled.primary) == float(lens.primary)


@pytest.mark.slow
def test_outside_the_image_circle_it_is_black():
    """A hole of radius 4 mm, 30 mm before a stop of radius 1 mm, lets light of tan θ < 5/30 pass."""
    hole = {"radius": math.inf, "thickness": 30.0, "apertures": [rt.system.Aperture("circular", (0.0, 4.0))]}
    glass = {"radius": 60.0, "thickness": 1.0, "glass": "N-BK7"}
    lens = rt.lens(
        [hole, glass, {"radius": -60.0, "thickness": 57.5}], stop=2, entrance_pupil_diameter=2, fields=[0, 5]
    )
    wide = rt.Sensor(size=(48.0, 32.0), pixels=(COLUMNS, ROWS))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        system = optics(lens, wide, model="drt", order=2, nodes=(3, 3), size=5)
        edge = float(wide.landing(lens, torch.tensor([[0.0], [math.degrees(math.atan(5 / 30))]]).double())[1].abs())
    white = torch.ones(ROWS, COLUMNS).double()
    image, lit = system(white)[0], system.lit
    row, column = torch.meshgrid(torch.arange(ROWS), torch.arange(COLUMNS), indexing="ij")
    radius = torch.hypot(*wide.points(column.double(), row.double()))
    assert not bool(lit[radius > edge].any())
    assert bool(lit[radius < 0.996 * edge].all())  # where 0.1 % of the beam of the axis is left
    assert float(image.max()) < 1.02
    outside = torch.nn.functional.max_pool2d(lit[None].double(), 7, 1, 3)[0] == 0
    assert float(image[outside].abs().max()) < 1e-12
    assert float(image[lit].min()) > 0
    words = str(Rendering(image[None], white[None], lens, system))
    assert "% of the sensor is outside the image circle, black" in words
    assert "distortion of the diagonal inside the image circle" in words


def test_a_lens_of_one_wavelength_has_no_colours(triplet):
    single = triplet.at(wavelengths=[0.55])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        text = str(rt.render(single, random(3, ROWS, COLUMNS), sensor=FIELD, model="gaussian", tol=0.5))
    assert "all channels at the single wavelength of the lens, 0.55 µm" in text


def test_rays_that_memory_does_not_hold_are_refused_where_no_gaussian_fits(triplet, monkeypatch):
    """Without the kernels of a model before it, the error is that of the rays."""

    def window(lens, sensor, model, *_, **__):
        if model == "gaussian":
            raise WindowTooLarge("the tails of a Gaussian")
        raise OverBudget("the rays")

    monkeypatch.setattr(render_module, "window_size", window)
    sensor = rt.Sensor((36, 24), (1200, 800))
    with pytest.raises(OverBudget, match="the rays"):
        optics(triplet, sensor)


def test_kernels_that_memory_does_not_hold_are_refused_first(triplet):
    with within(1e8), pytest.raises(OverBudget, match=r"399 × 399 pixels .*3 × 3.*`tol`.*`size`"):
        optics(triplet, FIELD, model="gaussian", order=4, size=399, tol=0.3)


@pytest.mark.slow
def test_a_scene_is_sampled_more_finely_than_the_sensor(triplet):
    """2 × 2 pixels of the scene in one of the sensor: the mean of the image on the finer pixels."""
    fine = dataclasses.replace(FIELD, pixels=(2 * COLUMNS, 2 * ROWS))
    picture, how = (
        random(3, 2 * ROWS, 2 * COLUMNS),
        {"model": "gaussian", "tol": 0.3, "wavelengths": triplet.wavelengths},
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        whole, small = (rt.render(triplet, picture, sensor=one, **how) for one in (fine, FIELD))
    wanted = torch.nn.functional.avg_pool2d(whole.image, 2)
    torch.testing.assert_close(small.image, wanted, rtol=0, atol=1e-12)
    assert small.picture.shape == small.image.shape
    assert small.optics.sensor.pixels == (COLUMNS, ROWS)


# -- a camera


def test_a_rendering_of_a_camera_prints_without_a_warning_of_torch(triplet):
    camera = rt.Camera(rt.Variables(triplet, "curvature:1"), torch.nn.Identity(), sensor=FIELD)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rendering = camera.render(random(3, ROWS, COLUMNS), tol=0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "illumination" in str(rendering)
        rendering.document()


def test_former_names_of_a_recorded_rendering_warn(triplet):
    sensor = dataclasses.replace(FIELD, mosaic="RGGB")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rendering = rt.render(triplet, random(3, ROWS, COLUMNS), sensor=sensor, model="gaussian", tol=0.5)
    for before, now in {"recorded": "raw", "captured": "demosaiced"}.items():
        with pytest.warns(DeprecationWarning, match=f"Rendering.{before} is Rendering.{now}"):
            image = getattr(rendering, before)(0).image
        assert torch.equal(image, getattr(rendering, now)(0).image)
    assert rendering.raw(0).image.shape[0] == 1


@pytest.mark.slow
def test_a_camera_renders_with_its_current_lens(triplet):
    """Its sensor, PSF model and variables: the image follows the sensor distance, with its derivative."""
    variables = rt.Variables(triplet, "sensor")
    camera = rt.Camera(variables, torch.nn.Identity(), sensor=FIELD)
    picture, options = random(3, ROWS, COLUMNS), {"tol": 0.2, "illumination": False}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with torch.no_grad():
            before = camera.render(picture, **options)
            wanted = rt.render(triplet, picture, sensor=FIELD, model="gaussian", **options)
        torch.testing.assert_close(before.image, wanted.image, rtol=0, atol=1e-12)
        (parameter,) = variables.parameters()
        camera.render(picture, **options).image.square().mean().backward()
        assert float(parameter.grad.abs()) > 0
        with torch.no_grad():
            parameter += 0.5
            assert float((camera.render(picture, **options).image - before.image).abs().max()) > 1e-3


# -- patches


def test_patches_have_the_kernels_of_their_places(triplet):
    patches, points = random(2, 3, 20, 20), torch.tensor([[0.0, -3.0], [2.0, 4.0]], dtype=torch.float64)
    weights = FIELD.weights(triplet.wavelengths)
    kernels = FieldKernels(triplet, FIELD, "gaussian", 4, 7, triplet.surfaces[0].thickness.reshape(1), weights)
    how = {"sensor": FIELD, "size": 7, "order": 4}
    found = render_patches(triplet, patches, points, **how)
    torch.testing.assert_close(found, blur(patches, kernels.at(points)[:, 0]), rtol=0, atol=1e-12)
    shaded = render_patches(triplet, patches, points, **how, illumination=True)
    wanted = rt.relative_illumination(triplet, fields=FIELD.fields(triplet, points)).illumination
    torch.testing.assert_close(shaded, wanted[:, None, None, None] * found, rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", ["gaussian", "paraxial", "drt"])
def test_patches_have_the_kernels_of_their_object_distances(triplet, model, monkeypatch):
    """Equal and different distances, infinite ones, more of them than one call computes."""
    monkeypatch.setattr("raytrace.imaging.field_kernels._DISTANCES", 3)
    distances = torch.tensor([800.0, 3000.0, math.inf, 800.0, 5000.0, 2000.0], dtype=torch.float64)
    angle = torch.arange(6, dtype=torch.float64)
    points, patches = 5 * torch.stack([torch.sin(angle), torch.cos(angle)]), random(6, 3, 20, 20)
    how = {"sensor": FIELD, "size": 9, "order": rt.psf_models.MODELS[model].orders[:3][-1], "model": model}
    found = render_patches(triplet, patches, points, object_distances=distances, **how)
    for k, distance in enumerate(distances):
        lens = triplet.at(object_distance=distance)
        # The place of a field on the sensor moves a little with the distance: the field is that of the nominal one.
        alone = render_patches(triplet, patches[[k]], points[:, [k]], object_distances=distance, **how)
        # Gaussians of one batch share the rule for their pixels, quadrature or wide (1e-4 of the energy).
        torch.testing.assert_close(found[[k]], alone, rtol=0, atol=1e-5 if model == "gaussian" else 1e-11)
        other = render_patches(lens, patches[[k]], points[:, [k]], **how)
        assert float((found[[k]] - other).abs().max()) < 2e-3


def test_object_heights_are_scaled_with_the_object_distance(triplet):
    """The image of a place stays there: of a height of 1 m it moves to twice the image height at 0.5 m."""
    near = triplet.at(object_distance=1000.0, fields=[10.0])
    points, patches = torch.tensor([[0.0], [4.0]], dtype=torch.float64), random(1, 3, 20, 20)
    same = with_field_kind(near, "object_height")
    how = {"sensor": FIELD, "size": 9, "order": 4, "object_distances": torch.tensor([500.0])}
    wanted = render_patches(near, patches, points, **how)
    torch.testing.assert_close(render_patches(same, patches, points, **how), wanted, rtol=0, atol=1e-10)


def test_patches_have_derivatives_by_their_distances_and_the_lens(triplet):
    variables = rt.Variables(triplet, "curvature:1-3 thickness:2")
    points = torch.tensor([[0.0, -3.0, 3.0], [2.0, 4.0, 1.0]], dtype=torch.float64)
    patches, weights = random(3, 3, 14, 14), random(3, 3, 8, 8, seed=1)
    distances = torch.tensor([900.0, 2000.0, 2000.0], dtype=torch.float64, requires_grad=True)
    how = {"sensor": FIELD, "size": 7, "order": 4}

    def light(lens, distances):
        return (weights * render_patches(lens, patches, points, object_distances=distances, **how)).sum()

    light(variables(), distances).backward()
    for k, step in enumerate((1.0, 5.0, 5.0)):
        moved = step * torch.eye(3, dtype=torch.float64)[k]
        with torch.no_grad():
            two = [light(triplet, distances + sign * moved) for sign in (1, -1)]
        assert float(distances.grad[k]) == pytest.approx(float(two[0] - two[1]) / (2 * step), rel=1e-4)
    together = [parameter.grad.clone() for parameter in variables.parameters()]
    variables.zero_grad()
    for k in range(3):
        some = weights[[k]] * render_patches(
            variables(), patches[[k]], points[:, [k]], object_distances=distances[k].detach(), **how
        )
        some.sum().backward()
    for parameter, wanted in zip(variables.parameters(), together, strict=True):
        torch.testing.assert_close(parameter.grad, wanted, rtol=1e-4, atol=0)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"points": torch.zeros(2, 3)}, r"points of shape \(2, 3\).*expected \(B, C, H, W\) and \(2, B\)"),
        ({"object_distances": [1e3, 1e3, 1e3]}, r"object_distances of shape \(3,\) of 2 patches"),
        ({"object_distances": [1e3, math.nan]}, "nan or 0: expected distances in mm from surface 1"),
    ],
)
def test_patches_that_do_not_fit_are_one_clear_error(triplet, changed, message):
    how = {"points": torch.zeros(2, 2), "sensor": FIELD, "size": 7, "order": 4, **changed}
    with pytest.raises(ValueError, match=message):
        render_patches(triplet, random(2, 3, 20, 20), **how)


@pytest.mark.parametrize("deviation", [1.0, 1.3, 2.5])
def test_wide_gaussians_are_those_of_the_quadrature(deviation):
    pixels = rt.maths.grid(1.0, 31)
    for angle in (0.0, 0.4, math.pi / 4):
        c, s, wide = math.cos(angle), math.sin(angle), 1.7 * deviation
        rows = [c * c * deviation**2 + s * s * wide**2, c * s * (deviation**2 - wide**2)]
        covariance = torch.tensor([*rows, s * s * deviation**2 + c * c * wide**2], dtype=torch.float64)
        centroid = torch.tensor([0.3, -0.2], dtype=torch.float64)
        close = wide_gaussian_pixels(pixels, centroid, covariance)
        assert float((close - gaussian_pixels(pixels, centroid, covariance)).abs().sum()) < 1e-4 / deviation**5


@pytest.mark.parametrize("depth", [False, True])
def test_progress_counts_up_to_the_total(triplet, depth):
    """Of one picture, and of layers, each of which is blurred with its coverage."""
    picture, counted = random(3, ROWS, COLUMNS), []
    distances = torch.where(torch.arange(COLUMNS) < COLUMNS // 2, 2e3, 9e3).expand(ROWS, COLUMNS) if depth else None
    planes = None if distances is None else (1 / distances.unique()).sort().values
    system = ready(triplet, object_distances=None if planes is None else 1 / planes)
    system(picture, distances, progress=lambda done, total: counted.append((done, total)))
    so_far = np.cumsum([done for done, _ in counted])
    assert so_far[-1] == counted[-1][1]  # of layers also low rank, whose numbers differ
    assert all(done <= total for done, (_, total) in zip(so_far, counted, strict=True))
    assert depth or {total for _, total in counted} == {3 * 4}
