"""`Camera` of a sensor: colours, places, noise by number, states that describe themselves, trainings that resume."""

import dataclasses
import inspect
import io
import json
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
import torch
from PIL import Image

import raytrace as rt
import raytrace.imaging.camera
from raytrace.imaging.closed_form import camera_error, even_distances, field_filters, patch_spectrum
from raytrace.imaging.codesign import (
    Batches,
    absolute_error,
    held_out_error,
    initial_camera,
    lens_at_start,
    light_of,
    make_batch,
    optimise,
    outcome,
    run_model,
    spectrum_of,
    steps_per_epoch,
    with_catalog_glasses,
)
from raytrace.imaging.field_kernels import DarkPlaces, order_of
from raytrace.imaging.image import blur, decoded, linearised, transfer_functions
from raytrace.imaging.pictures import dead_leaves, split
from raytrace.imaging.render import render_patches
from raytrace.imaging.restoration import depth_invariant_error, depth_invariant_wiener
from raytrace.imaging.training import Run
from raytrace.imaging.variables import OtherLens
from raytrace.optimization.variables import VariedGlass
from raytrace.settings import CodesignSettings
from raytrace.shards import Share
from raytrace.system.identity import digest
from raytrace.tracing.scene import scene, symmetry

SENSOR = rt.Sensor(size=(24.0, 16.0), pixels=(1200, 800), response="rgb", full_well=2e4, read_noise=5.0)
RANGE = (8e3, 4e4)
SETTINGS = CodesignSettings(
    optimizer="adam",
    vary="thickness sensor curvature", hold="efl", wavelengths=(0.5876, 0.4861, 0.6563), wavelength_weights=(1.0,) * 3,
    network="u-net", depth=1, width=4, size=11, patch=16, batch=4, crops=2, epochs=2, start="rms", noise=0.02,
    sensor=(24.0, 16.0), pixel=0.02, near=8e3, far=4e4, focus_distance=13e3, spread="reciprocal",
)  # fmt: skip


class Same(torch.nn.Module):
    def forward(self, image):
        return image


@pytest.fixture(scope="module")
def triplet():
    return rt.read_lens("cooke_triplet").at(ray_aiming="real")


@pytest.fixture(scope="module")
def pictures():
    return split(dead_leaves(10, size=32, colour=True))


@pytest.fixture(scope="module", autouse=True)
def _plans_once():
    """Cameras of the same numbers have the order that the first of them found: a plan takes as long as ten images."""
    plan, orders = rt.Camera.plan, {}

    def known(one):
        key = digest(one.lens(), one.sensor, one.model, one.size, one.range, one.tol, str(one.fields.dtype))
        one._order = orders[key] if key in orders else orders.setdefault(key, plan(one))
        return one._order

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rt.Camera, "plan", known)
        yield


def made(lens, vary="sensor curvature:1,6", sensor=SENSOR, **options):
    options = {"pixels": 11, "object_distances": RANGE} | options
    return rt.Camera(rt.Variables(lens, vary), Same(), sensor=sensor, **options)


def samples(count, size=26, seed=0):
    """Light (B, 3, size, size), distances (B,) mm, points (2, B) mm and numbers (B,)."""
    generator = torch.Generator().manual_seed(seed)
    picture = torch.rand(count, 3, size, size, generator=generator, dtype=torch.float64)
    distances = RANGE[0] + (RANGE[1] - RANGE[0]) * torch.rand(count, generator=generator, dtype=torch.float64)
    index = torch.arange(100, 100 + count)
    return picture, distances, SENSOR.patch_points(SENSOR.random_patches(index, size - 10), size - 10), index


# -- image formation


def test_images_are_those_of_patches_at_their_places_and_distances(triplet):
    one = made(triplet)
    picture, distances, points, _ = samples(3)
    image = one.image(picture, distances, points=points)
    wanted = render_patches(
        one.variables(), picture, points, sensor=SENSOR, size=11, order=one.plan(), object_distances=distances
    )
    assert image.shape == (3, 3, 16, 16)
    torch.testing.assert_close(image, wanted, rtol=0, atol=1e-12)
    together = one.kernels_over_field(distances, points[:, :2])
    torch.testing.assert_close(together[2, 1], one.kernels(distances[2:], points=points[:, 1:2])[0], rtol=0, atol=1e-12)


def test_the_relative_illumination_darkens_the_corner(triplet):
    picture, distances, _, _ = samples(2)
    points = torch.stack([torch.zeros(2, dtype=torch.float64), SENSOR.corners[:, 0]], 1)
    bright, shaded = (made(triplet, illumination=on).image(picture, distances, points=points) for on in (False, True))
    share = (shaded / bright).mean((1, 2, 3))
    share = share.detach()
    expected = float(rt.relative_illumination(triplet, fields=SENSOR.fields(triplet, points[:, 1:])).illumination)
    assert float(share[0]) == pytest.approx(1.0, abs=1e-9)
    assert float(share[1]) == pytest.approx(expected, abs=1e-9)
    assert expected < 0.95


def test_levels_are_decoded_and_light_is_kept(triplet):
    one = made(triplet)
    levels = torch.randint(0, 256, (1, 3, 26, 26), dtype=torch.uint8)
    _, distances, points, _ = samples(1)
    of_levels, of_light = (one.image(p, distances, points=points) for p in (levels, linearised(levels)))
    torch.testing.assert_close(of_levels, of_light)
    torch.testing.assert_close(one.target(levels), linearised(levels)[..., 5:-5, 5:-5])
    hwc = levels[0].movedim(0, -1).float() / 255
    torch.testing.assert_close(light_of(hwc), decoded(hwc).movedim(-1, 0))


def test_noise_is_that_of_the_number_in_any_batch(triplet):
    one = made(triplet)
    picture, distances, points, index = samples(4)
    with torch.no_grad():
        whole = one(picture, distances, points=points, index=index, seed=3)
        part = one(picture[2:], distances[2:], points=points[:, 2:], index=index[2:], seed=3)
        other = one(picture[2:], distances[2:], points=points[:, 2:], index=index[2:], seed=4)
        clean = one.image(picture, distances, points=points)
    torch.testing.assert_close(whole[2:], part, rtol=0, atol=1e-12)
    assert not torch.equal(part, other)
    deviation = (whole - clean).std()
    assert float(deviation) == pytest.approx(float((clean / 2e4 + (5 / 2e4) ** 2).mean().sqrt()), rel=0.05)


def test_a_mosaic_is_that_of_the_place(triplet):
    """Patches at odd and even columns record the colours that the whole sensor records there."""
    sensor = dataclasses.replace(SENSOR, mosaic="RGGB", full_well=None, read_noise=0.0)
    one = made(triplet, sensor=sensor)
    image = torch.rand(4, 3, 6, 6, dtype=torch.float64)
    origins = torch.tensor([[100, 200], [101, 200], [100, 201], [101, 201]])
    recorded = one.demosaiced(image, sensor.patch_points(origins, 6))
    wanted = sensor.demosaic(sensor.sample(image, origins), origins)
    torch.testing.assert_close(recorded, wanted)
    assert not torch.equal(recorded[0], sensor.demosaic(sensor.sample(image[0])[None], (1, 0))[0])


@pytest.mark.slow
@pytest.mark.parametrize("model", ["gaussian", pytest.param("drt", marks=pytest.mark.slow)])
def test_gradients_of_the_whole_camera_are_those_of_differences(triplet, model):
    """Curvatures, spaces and sensor through PSFs, noise and a network, float64."""
    one = made(triplet, "sensor thickness:2 curvature:1,6", model=model, tol=1e-4)
    torch.manual_seed(0)
    one.network = torch.nn.Conv2d(3, 3, 3, padding=1).double()
    picture, distances, points, index = samples(3)
    one.plan()

    def loss():
        return (one(picture, distances, points=points, index=index) - one.target(picture)).square().mean()

    slopes, differences = torch.autograd.grad(loss(), [*one.variables.parameters()]), []
    for parameter in one.variables.parameters():
        step, values = 1e-5, []
        for shift in (step, -step):
            with torch.no_grad():
                parameter += shift
            values.append(float(loss().detach()))
            with torch.no_grad():
                parameter -= shift
        differences.append((values[0] - values[1]) / (2 * step))
    slopes = torch.stack(slopes)
    assert slopes.tolist() == pytest.approx(differences, rel=1e-3, abs=2e-4 * float(slopes.abs().max()))


@pytest.mark.slow
def test_vignetting_factors_move_with_the_field_of_the_middle():
    """Tilting a surface of a Tessar at 2 m moves the field at the middle of the sensor from the listed one, 0."""
    one = made(rt.read_lens("tessar").at(object_distance=2000.0), "tilt_x:3", object_distances=(1.9e3, 2.1e3), tol=1e-3)
    where = {"points": torch.zeros(2, 1, dtype=torch.float64)}
    pattern = torch.cos(torch.arange(363.0, dtype=torch.float64)).reshape(3, 11, 11)
    tilt = one.variables.get_parameter("tilt_x_3")
    (slope,) = torch.autograd.grad((one.kernels(pattern.new_tensor([2e3]), **where) * pattern).sum(), tilt)
    ends = []
    with torch.no_grad():
        for change in (1e-4, -1e-4):
            tilt.fill_(change)
            ends.append((one.kernels(pattern.new_tensor([2e3]), **where) * pattern).sum())
    assert float(slope) == pytest.approx(float(ends[0] - ends[1]) / 2e-4, rel=1e-4)


@pytest.mark.parametrize("model", ["gaussian", "drt"])
def test_a_place_without_a_chief_ray_has_a_kernel_of_0(triplet, model):
    """It was a point, as of a perfect lens, and the place nan was the axis."""
    one, points = made(triplet, model=model), torch.tensor([[0.0, 0.0], [5.0, 300.0]], dtype=torch.float64)
    one.sensor = dataclasses.replace(one.sensor, size=(24.0, 640.0), pixels=(120, 3200))
    with pytest.warns(DarkPlaces, match=r"1 of 2 places .* \(0, 300\) mm"):
        kernels = one.kernels(points.new_tensor([1e4, 2e4]), points=points)
    torch.testing.assert_close(kernels.sum((-2, -1)).detach(), points.new_tensor([[1.0] * 3, [0.0] * 3]))
    slopes = torch.autograd.grad((kernels * kernels).sum(), [*one.variables.parameters()])
    assert all(slope.isfinite() and slope != 0 for slope in slopes)
    with pytest.raises(ValueError, match="1 of 2 points are nan or infinite"):
        one.kernels(points.new_tensor([1e4, 2e4]), points=torch.where(points == 300.0, torch.nan, points))


@pytest.mark.slow
def test_a_kernel_is_the_same_in_any_batch_with_and_without_derivatives(triplet):
    """DRT: the sampling followed the widest kernel of a batch, and on the axis the symmetry that derivatives break."""
    one, points = made(triplet, model="drt"), torch.tensor([[0.0, 0.0, 3.0], [0.0, 5.0, 4.0]], dtype=torch.float64)
    distances = points.new_full((3,), 1e4)
    with torch.no_grad():
        kernels = one.kernels(distances, points=points)
        other = one.kernels(points.new_tensor([-1e4, 1e4, 1e4]), points=points)
    torch.testing.assert_close(other[1:], kernels[1:], rtol=0, atol=1e-12)
    for k in range(3):
        alone = one.kernels(distances[:1], points=points[:, k : k + 1])
        torch.testing.assert_close(alone[0].detach(), kernels[k], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_first_example_runs():
    block = inspect.getdoc(raytrace.imaging.camera).split("\n\n")[2]
    names = {"rt": rt, "torch": torch}
    exec(inspect.cleandoc(block), names)
    assert names["loss"].isfinite()


def test_pictures_of_half_precision_are_blurred_in_float32(triplet):
    one = made(triplet)
    picture, distances, points, _ = samples(2)
    image = one.image(picture.half(), distances, points=points)
    assert image.dtype == torch.float32
    torch.testing.assert_close(image, one.image(picture.half().float(), distances, points=points))
    for convert in (torch.nn.Module.half, torch.nn.Module.bfloat16):
        with pytest.raises(ValueError, match=r"torch\.b?float16: expected torch\.float32"):
            convert(one)


def test_distances_are_numbers_of_any_kind_and_one_at_least(triplet):
    one, points = made(triplet), torch.zeros(2, 1)
    torch.testing.assert_close(one.kernels(1e4, points=points), one.kernels(torch.tensor([1e4]), points=points))
    for distances in ([], torch.zeros(0), torch.full((2, 2), 1e4)):
        with pytest.raises(ValueError, match=r"object_distances .*expected \(B,\) mm"):
            one.kernels(distances, points=torch.zeros(2, 0))


@pytest.mark.slow
def test_a_camera_is_copied_after_a_projection(triplet):
    one = made(triplet, "sensor curvature:1 thickness:2", pixels=5)
    one.variables.project()
    copy = torch.load(saved(one), weights_only=False)
    copy.variables.project()
    where = {"points": torch.zeros(2, 1)}
    assert torch.equal(copy.kernels(1e4, **where), one.kernels(1e4, **where))


def saved(module):
    file = io.BytesIO()
    torch.save(module, file)
    file.seek(0)
    return file


def test_the_default_device_is_not_that_of_a_camera(triplet):
    """Numbers made without a device would be on "meta", where they have no values."""
    variables = rt.Variables(triplet, "thickness:2", hold="buildable")
    light = scene(triplet, triplet.wavelengths.new_zeros(2, 1), triplet.wavelengths.new_ones(1), triplet.wavelengths)
    with torch.no_grad():
        variables.thickness_2.fill_(-20.0)
    with torch.device("meta"):
        assert symmetry(light) == "round"
        variables.project()
    assert variables.numbers()["thickness_2"] > 0


@pytest.mark.slow
def test_the_order_of_a_clipped_lens_is_that_of_its_whole_beams_too(triplet):
    """On the axis no ray is clipped, and of order 3, enough for the rays of clipped beams, the error was 9 %."""
    green = dataclasses.replace(SETTINGS, wavelengths=(0.5876,), wavelength_weights=(1.0,), vignetting="semi-diameters")
    lens, sensor = lens_at_start(triplet, green), dataclasses.replace(SENSOR, response=None)
    points = torch.tensor([[0.0, 9.0], [0.0, 6.0]], dtype=torch.float64)
    orders = [
        order_of(lens, sensor, "gaussian", sensor.fields(lens, at), points.new_tensor([1e4]), 11, 1e-2)
        for at in (points, points[:, :1], points[:, 1:])
    ]
    assert orders[0] == orders[1] > orders[2]


def test_what_does_not_fit_is_refused(triplet):
    picture, distances, points, _ = samples(2)
    one = made(triplet)
    with pytest.raises(ValueError, match=r"points of shape \(2, 1\): expected \(2, 2\) mm"):
        one.image(picture, distances, points=points[:, :1])
    with pytest.raises(
        ValueError, match=r"shape \(2, 1, 26, 26\) at 2 object distances: expected \(2, 3, H, W\).* r, g, b"
    ):
        one.image(picture[:, :1], distances, points=points)
    with pytest.raises(ValueError, match=r"values up to 255: expected 0 to 1"):
        one.image(255 * torch.ones_like(picture), distances, points=points)
    with pytest.raises(ValueError, match="pixels 10: expected an odd integer"):
        made(triplet, pixels=10)


# -- states


def test_a_state_describes_its_camera_and_loads_into_no_other(triplet):
    one = made(triplet)
    state = one.state_dict()
    described = json.loads(bytes(state["_extra_state"].tolist()).decode())
    assert described["lens"].startswith("Cooke triplet")
    assert described["sensor"]["pixels"] == [1200, 800]
    assert (described["window"][0], described["model"], described["network"]) == (11, "gaussian", "Same")
    assert set(described["versions"]) == {"raytrace", "torch"}
    assert set(described["variables"]) == {"sensor", "curvature_1", "curvature_6"}
    made(triplet).load_state_dict(state)
    with pytest.raises(OtherLens, match=r"sensor\.full_well = 20000\.0, this one has 30000\.0"):
        made(triplet, sensor=dataclasses.replace(SENSOR, full_well=3e4)).load_state_dict(state)
    with pytest.raises(OtherLens, match=r"of a camera with window = \[11, 11"):
        made(triplet, pixels=13).load_state_dict(state)
    with pytest.raises(OtherLens, match="the state is of"):
        made(rt.read_lens("tessar"), "sensor curvature:1,6").load_state_dict(state)
    with pytest.raises(OtherLens, match="sensor, curvature_1, curvature_6, not sensor"):
        made(triplet, "sensor").load_state_dict(state)


def test_a_state_of_an_older_version_loads(triplet):
    state = made(triplet).state_dict()
    del state["_extra_state"]
    made(triplet).load_state_dict(state)
    with pytest.raises(OtherLens, match="its identity is damaged"):
        made(triplet).load_state_dict(state | {"_extra_state": torch.tensor([1, 2, 3], dtype=torch.uint8)})


def test_optics_and_network_have_rates_of_their_own(triplet):
    one = made(triplet)
    one.network = rt.imaging.UNet(channels=3, levels=1, width=4)
    optimizer = torch.optim.SGD(one.rates(optics=1e-3, network=1e-1))
    assert [group["lr"] for group in optimizer.param_groups] == [1e-3, 1e-1]
    assert sum(len(group["params"]) for group in optimizer.param_groups) == len([*one.parameters()])


# -- closed form


def test_the_closed_form_is_over_fields_colours_and_distances(triplet, pictures):
    """The mean over channels of errors behind one filter for all fields, or for each field, with its derivative."""
    one = initial_camera(triplet, SETTINGS)
    spectrum = patch_spectrum(pictures[0], 26, crops=1)
    assert spectrum.shape == (3, 26, 26)
    distances = even_distances(one, 2, spread="reciprocal")
    error = camera_error(one, spectrum, distances)
    slope = torch.autograd.grad(error, one.variables.sensor)[0]
    values = []
    for shift in (1e-3, -1e-3):
        with torch.no_grad():
            one.variables.sensor += shift
        values.append(float(camera_error(one, spectrum, distances).detach()))
        with torch.no_grad():
            one.variables.sensor -= shift
    assert float(slope) == pytest.approx((values[0] - values[1]) / 2e-3, rel=1e-3)
    kernels, sigma = one.kernels_over_field(distances).detach(), one.sensor.noise_deviation(spectrum)
    assert sigma.flatten().tolist() == pytest.approx([0.02] * 3)
    single = [
        float(depth_invariant_error(transfer_functions(kernels[:, n, c], 26), spectrum[c], 0.02))
        for n in range(kernels.shape[1])
        for c in range(3)
    ]
    with torch.no_grad():
        of_each_field = float(camera_error(one, spectrum, distances, filter_each_field=True))
    assert of_each_field == pytest.approx(sum(single) / len(single), rel=1e-9)
    of_all = [
        float(depth_invariant_error(transfer_functions(kernels[:, :, c].flatten(0, 1), 26), spectrum[c], 0.02))
        for c in range(3)
    ]
    assert float(error.detach()) == pytest.approx(sum(of_all) / 3, rel=1e-9)
    assert of_each_field < 0.99 * float(error.detach())


@pytest.mark.slow
def test_joint_filters_leave_less_error_of_correlated_colours(triplet, pictures):
    """Dead leaves of a correlation of 0.9: the joint filter is better, and equal where the spectra are diagonal."""
    one = initial_camera(triplet, SETTINGS)
    separate = spectrum_of(pictures[0], SETTINGS)
    joint = spectrum_of(pictures[0], dataclasses.replace(SETTINGS, filters="joint"))
    assert joint.shape == (3, 3, 26, 26)
    distances = even_distances(one, 3)
    errors = [float(camera_error(one, spectrum, distances).detach()) for spectrum in (separate, joint)]
    assert errors[1] < 0.97 * errors[0]
    diagonal = torch.diag_embed(joint.diagonal(dim1=0, dim2=1)).movedim((-2, -1), (0, 1))
    assert float(camera_error(one, diagonal, distances).detach()) == pytest.approx(errors[0], rel=1e-9)
    slope = torch.autograd.grad(camera_error(one, joint, distances), one.variables.sensor)[0]
    values = []
    for shift in (1e-3, -1e-3):
        with torch.no_grad():
            one.variables.sensor += shift
        values.append(float(camera_error(one, joint, distances).detach()))
        with torch.no_grad():
            one.variables.sensor -= shift
    assert float(slope) == pytest.approx((values[0] - values[1]) / 2e-3, rel=1e-3)
    filters = field_filters(one, joint, (0.0, 1.0), distances)
    assert filters.shape == (2, 3, 3, 26, 26)
    assert 0 < held_out_error(one, pictures[1], SETTINGS, place=1.0, filters=filters[1]) < 0.3
    with pytest.raises(ValueError, match="require a sensor with colours"):
        spectrum_of(pictures[0], dataclasses.replace(SETTINGS, filters="joint", sensor=()))
    with pytest.raises(ValueError, match="'both': expected separate or joint"):
        spectrum_of(pictures[0], dataclasses.replace(SETTINGS, filters="both"))


def test_glasses_that_vary_snap_to_the_catalog_and_the_rest_is_learned_again(triplet, pictures):
    """The camera of step 1 with catalog glasses: its other variables go on, its network goes with it."""
    settings = dataclasses.replace(
        SETTINGS, vary="index:1,3 abbe_number:1,3 sensor curvature:1,6", hold="efl catalog", relearn=1
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VariedGlass)
        one = initial_camera(triplet, settings)
    with torch.no_grad():
        one.variables.index_1.add_(1.0)
        one.variables.curvature_1.add_(0.01)
        [*one.network.parameters()][-1].fill_(0.5)
    other, again = with_catalog_glasses(one, settings)
    assert (again.vary, again.hold, again.epochs) == ("sensor curvature:1,6", "efl", 1)
    glasses = [other.variables().surfaces[k].glass for k in (1, 3)]
    assert all(glass.catalog for glass in glasses)
    assert glasses[0].name != triplet.surfaces[1].glass.name
    assert other.variables.numbers()["sensor"] == pytest.approx(one.variables.numbers()["sensor"], abs=1e-12)
    assert torch.equal([*other.network.parameters()][-1], [*one.network.parameters()][-1])


def test_glasses_of_an_experiment_are_of_the_catalogs_it_is_given(triplet):
    settings = dataclasses.replace(SETTINGS, vary="index:1,3 abbe_number:1,3 sensor", hold="catalog", relearn=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VariedGlass)
        one = initial_camera(triplet, settings, catalogs=("OHARA",))
    other, _ = with_catalog_glasses(one, settings)
    assert {other.variables().surfaces[k].glass.catalog for k in (1, 3)} == {"OHARA"}
    assert other.variables.catalog == ("OHARA",)


def test_glasses_that_vary_snap_to_selected_glasses(triplet):
    words = "preferred price<=1.5"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VariedGlass)
        variables = rt.Variables(triplet, "index:1,3 abbe_number:1,3 sensor", hold="catalog", glasses=words)
        free = rt.Variables(triplet, "index:1,3 abbe_number:1,3 sensor", hold="catalog")
    prices = [variables.snapped().surfaces[k].glass.relative_price for k in (1, 3)]
    assert all(price <= 1.5 for price in prices)
    dear = [free.snapped().surfaces[k].glass.relative_price for k in (1, 3)]
    assert any(price is None or price > 1.5 for price in dear)  # None: not listed


def test_filters_of_places_are_wiener_filters_of_their_kernels(triplet, pictures):
    one = initial_camera(triplet, SETTINGS)
    spectrum, distances = patch_spectrum(pictures[0], 26, crops=1), even_distances(one, 3)
    filters = field_filters(one, spectrum, (0.0, 1.0), distances)
    assert filters.shape == (2, 3, 26, 26)
    corner = SETTINGS.sensor[0] / 2, -SETTINGS.sensor[1] / 2
    at_corner = torch.stack(
        [one.kernels(z[None], points=torch.tensor(corner, dtype=torch.float64)[:, None])[0] for z in distances]
    ).detach()
    wanted = depth_invariant_wiener(transfer_functions(at_corner, 26), spectrum, 0.02)
    torch.testing.assert_close(filters[1], wanted, rtol=1e-9, atol=1e-12)


# -- training


def test_losses_of_shares_add_up_and_samples_have_places(triplet, pictures):
    settings = dataclasses.replace(SETTINGS, batch=8)
    one = initial_camera(triplet, settings)
    batches = Batches(pictures[0], settings)
    whole = batches(0, Share())
    assert (whole.picture.shape, whole.points.shape) == ((8, 3, 26, 26), (2, 8))
    assert len(whole.points.T.unique(dim=0)) == 8
    with torch.no_grad():
        parts = [absolute_error(one, batches(0, Share(rank, 2))).sum() for rank in range(2)]
        assert float(sum(parts)) == pytest.approx(float(absolute_error(one, whole).sum()), rel=1e-5)
    again = make_batch(pictures[0], settings, [3], 0)
    torch.testing.assert_close(again.points, whole.points[:, 3:4])
    assert steps_per_epoch(pictures[0], settings) == 2


@pytest.mark.slow  # of one colour by default: test_camera.py
def test_step_1_in_colour_resumes_bit_identically(triplet, pictures, tmp_path):
    """Stopped after three steps and resumed: variables, network and log of a run that was never stopped."""

    def run(folder, stop=None):
        one = initial_camera(triplet, SETTINGS)
        one.plan()
        for count, _ in enumerate(optimise(one, pictures[0], SETTINGS, Run(tmp_path / folder, {}), every=1), 1):
            if count == stop:
                return None
        return one.state_dict()

    run("parts", 3)
    parts, whole = run("parts"), run("whole")
    assert all(torch.equal(value, parts[name]) for name, value in whole.items())
    logs = [(tmp_path / folder / "log.csv").read_bytes() for folder in ("whole", "parts")]
    assert logs[0] == logs[1]


@pytest.mark.slow
def test_a_run_in_colour_resumes_bit_identically_and_reports_places(triplet, pictures, tmp_path):
    def run(folder, stop=None):
        data = triplet, *pictures, SETTINGS, tmp_path / folder
        for count, _ in enumerate(run_model(*data, about={}, distances=(1e4,)), 1):
            if count == stop:
                return None
        return outcome(tmp_path / folder)

    whole = run("whole")
    run("parts", 3)
    run("parts", 2)
    parts = run("parts")
    assert parts == whole
    assert set(whole.l1_by_place) == set(whole.wiener_by_place) == {"0", "0.7", "1"}
    assert all(0 < error < 0.5 for error in (*whole.l1_by_place.values(), *whole.wiener_by_place.values()))
    logs = [(tmp_path / folder / "joint" / "log.csv").read_bytes() for folder in ("whole", "parts")]
    assert logs[0] == logs[1]
    one = initial_camera(triplet, SETTINGS)
    assert held_out_error(one, pictures[1], SETTINGS, place=0.0) != held_out_error(
        one, pictures[1], SETTINGS, place=1.0
    )
    with pytest.raises(ValueError, match="sensor"):
        Run(tmp_path / "whole" / "joint", {**dataclasses.asdict(SETTINGS), "sensor": (12.0, 8.0), "step": "joint"})


def command(folder, pictures, *more):
    words = (
        f"codesign cooke_triplet --sensor 24x16 --pixel 0.02 --size 11 --vary thickness sensor curvature --hold efl "
        f"buildable --optimizer adam --preset unet --depth 1 --width 4 --patch 16 --batch 4 --crops 4 --epochs 3 "
        f"--noise 0.02 --near 8000 --far 40000 --focus-distance 13000 --precision float32 --data {pictures} "
        f"-o {folder} --json"
    ).split()
    return [*more, "-m", "raytrace", *words]


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs")
    for number, sample in enumerate(dead_leaves(10, size=48, colour=True).samples):
        Image.fromarray(sample).save(folder / f"{number}.png")
    return folder


def environment():
    return {**os.environ, "PYTHONPATH": str(Path(rt.__file__).parents[1]), "OMP_NUM_THREADS": "1"}


@pytest.mark.slow
def test_a_killed_command_in_colour_resumes_to_the_same_end(tmp_path, photographs):
    """kill -9 in the middle of step 1: losses, lens and outcome of a run that was never killed."""
    words = [sys.executable, *command(tmp_path / "killed", photographs)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment())
    log = tmp_path / "killed" / "joint" / "checkpoint.pt"
    until = time.monotonic() + 120
    while not log.exists() and time.monotonic() < until:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    outputs = []
    for folder in ("killed", "whole"):
        words = [sys.executable, *command(tmp_path / folder, photographs)]
        done = subprocess.run(words, capture_output=True, text=True, timeout=300, env=environment())
        assert done.returncode == 0, done.stderr
        outputs.append(json.loads(done.stdout))
    assert outputs[0] == outputs[1]
    for name in ("joint/log.csv", "refine/log.csv", "lens.zmx"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.slow
def test_two_processes_in_colour_equal_one(tmp_path, photographs):
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    outputs = []
    for folder, start in (("one", [sys.executable]), ("two", torchrun)):
        words = [*start, *command(tmp_path / folder, photographs)]
        done = subprocess.run(words, capture_output=True, text=True, timeout=300, env=environment())
        assert done.returncode == 0, done.stderr
        outputs.append(json.loads(done.stdout))
    for key in ("l1_joint", "l1_before", "l1_drt", "sensor_mm"):
        assert outputs[1][key] == pytest.approx(outputs[0][key], rel=1e-4)


def test_blur_of_patches_is_that_of_their_kernels(triplet):
    one = made(triplet)
    picture, distances, points, _ = samples(2)
    wanted = blur(picture, one.kernels(distances, points=points))
    torch.testing.assert_close(one.image(picture, distances, points=points), wanted)


@pytest.mark.slow
def test_a_camera_in_single_precision_has_the_same_kernels(triplet):
    _, distances, points, _ = samples(3)
    double = made(triplet).kernels(distances, points=points).detach()
    single = made(triplet).float()
    kernels = single.kernels(distances.float(), points=points.float())
    assert kernels.dtype == torch.float32
    assert float((kernels - double).abs().sum((-2, -1)).max()) < 1e-3
    kernels.square().sum().backward()
    assert all(bool(torch.isfinite(p.grad)) for p in single.variables.parameters())


def test_a_field_number_and_all_fields_have_the_same_kernels_after_the_lens_has_changed(triplet):
    """The fields of a sensor are points of it: their kernels stay there, by number as well as over the field."""
    own = made(triplet)
    with torch.no_grad():
        own.variables.get_parameter(own.variables.names[0]).add_(0.05)
        distances = torch.tensor([12e3, 40e3], dtype=torch.float64)
        whole = own.kernels_over_field(distances)
        for field in range(own.fields.shape[1]):
            torch.testing.assert_close(own.kernels(distances, field), whole[:, field], rtol=0, atol=1e-12)
