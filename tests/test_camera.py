"""Camera and co-design: image formation, what learns and what does not, and runs from start to end."""

import copy
import dataclasses
import itertools
import json
import math
import re
import warnings
from pathlib import Path

import pytest
import torch
from problems import number

from raytrace.files import shipped
from raytrace.imaging import field_kernels
from raytrace.imaging.camera import Camera
from raytrace.imaging.closed_form import (
    camera_error,
    distance_in_focus,
    even_distances,
    optimise_closed_form,
    out_of_focus,
    patch_spectrum,
    sensor_range,
)
from raytrace.imaging.codesign import (
    Batches,
    Outcome,
    absolute_error,
    initial_camera,
    lens_at_start,
    make_batch,
    optimise,
    outcome,
    run_model,
    write_outcome,
)
from raytrace.imaging.field_kernels import EnergyOutside
from raytrace.imaging.image import blur, pixel_means
from raytrace.imaging.network import RedNet, RedNetShape
from raytrace.imaging.pictures import dead_leaves, split
from raytrace.imaging.sensor import Sensor
from raytrace.imaging.training import Run, Share
from raytrace.imaging.variables import OtherLens, PhaseVariables, Variables
from raytrace.io import read_lens
from raytrace.maths.sampling import gauss_rings
from raytrace.psf_models import DRT, Gaussian, Paraxial, psf
from raytrace.settings import CodesignSettings
from raytrace.system.lens import with_object_distance
from raytrace.system.parameter_paths import BadVariables
from raytrace.tracing.focus import NoImage, best_focus, focused
from raytrace.tracing.geometry import Unbuildable
from raytrace.tracing.paraxial import first_order, paraxial_image_distance
from raytrace.wave_optics.compute import phase_elements
from raytrace.wave_optics.element import phase_element

LENS = Path(__file__).parents[1] / "lenses" / "double_gauss.zmx"
SMALL = CodesignSettings(optimizer="adam", depth=4, width=4, patch=16, size=7, epochs=1, crops=2, batch=4)
MICROMETRE = 1e-3
COLOUR = Sensor(size=(24, 16), pixels=(240, 160), response="rgb", mosaic="RGGB", full_well=1e3, read_noise=2, bits=8)
NOISY = Sensor(size=(1, 1), pixels=(200, 200), read_noise=0.1, saturation=math.inf)


class Same(torch.nn.Module):
    """A network that restores nothing."""

    def forward(self, image):
        return image


@pytest.mark.parametrize("model", ["paraxial", "fourier", "gaussian", "drt"])
def test_kernels_are_those_of_the_psf_call(model):
    """A camera plans an order and reuses rays; its kernels stay within the tolerance it was given."""
    own = initial_camera(read_lens(LENS), dataclasses.replace(SMALL, model=model, size=21))
    distances = number([10e3, 17e3, 42e3, 50e3])
    found = own.kernels(distances)
    expected = psf(
        own.variables(), model, object_distances=distances, fields=own.fields, size=own.size, tol=1e-4,
        normalise="window",
    ).kernel  # fmt: skip
    assert float(((found - expected).abs().sum((2, 3))).max()) < own.tol
    torch.testing.assert_close(found.sum((2, 3)), torch.ones(4, 1, dtype=torch.float64))


@pytest.mark.parametrize("model", ["paraxial", "fourier", "gaussian", "drt"])
def test_derivative_in_the_sensor_through_picture_and_loss(model):
    own = initial_camera(read_lens(LENS), dataclasses.replace(SMALL, model=model, tol=1e-3, noise=0.0))
    own.network = Same()
    picture = torch.rand(2, 22, 22, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    distances = number([12e3, 33e3])

    def loss(shift: float) -> torch.Tensor:
        with torch.no_grad():
            own.variables.sensor.fill_(shift)
        return (own(picture, distances) - own.target(picture)).square().mean()

    (slope,) = torch.autograd.grad(loss(0.0), own.variables.sensor)
    step = 1e-5
    difference = float((loss(step) - loss(-step)).detach()) / (2 * step)
    # Kernels of `drt` are smooth in pieces, in each of which pieces of the meridian stay in their pixels.
    assert float(slope) == pytest.approx(difference, rel=2e-2 if model == "drt" else 1e-4)
    assert float(slope) != 0


def test_image_is_the_picture_blurred_and_the_target_its_middle():
    own = initial_camera(read_lens(LENS), SMALL)
    picture, distances = torch.rand(3, 22, 22), number([10e3, 20e3, 50e3])
    blurred = blur(picture[:, None], own.kernels(distances).float())
    torch.testing.assert_close(own.image(picture, distances), blurred)
    torch.testing.assert_close(own.image(picture[:, None], distances), blurred)
    assert own.target(picture).shape == (3, 1, 16, 16)
    assert torch.equal(own.target(picture)[:, 0], picture[:, 3:19, 3:19])
    flat = own.image(torch.full((22, 22), 0.4), distances)  # one picture for all distances
    torch.testing.assert_close(flat, torch.full((3, 1, 16, 16), 0.4), atol=1e-6, rtol=0)


@pytest.mark.parametrize("boundary", ["valid", "reflect"])
def test_pixels_of_the_sensor_are_means_of_those_of_an_oversampled_picture(boundary):
    """Kernels in the pixels of the picture; their sums over pixels of the sensor are kernels without oversampling."""
    variables = Variables(read_lens("cooke_triplet"), "sensor")
    how = {"sensor": NOISY, "fields": [0, 7], "boundary": boundary, "model": Gaussian(order=4)}
    coarse = Camera(variables, Same(), pixels=5, **how)
    fine = Camera(variables, Same(), pixels=15, oversampling=3, **how)
    large = coarse.kernels([20e3, 30e3], [0, 1])
    small = fine.kernels([20e3, 30e3], [0, 1])
    torch.testing.assert_close(pixel_means(small, 3) * 9, large, atol=2e-5, rtol=0)
    picture = torch.rand(2, 1, 30 + fine.margin, 30 + fine.margin, dtype=torch.float64)
    image = fine.image(picture, [20e3, 30e3], [0, 1])
    assert image.shape == (2, 1, 10, 10)
    assert fine.target(picture).shape == (2, 1, 30, 30)
    torch.testing.assert_close(image, pixel_means(blur(picture, small, boundary=boundary), 3))
    assert fine.demosaiced(image, index=[0, 1]).shape == image.shape
    with pytest.raises(OtherLens, match="window"):
        coarse.load_state_dict(fine.state_dict())


def test_the_transfer_function_of_an_oversampled_camera_has_the_mean_over_its_pixels():
    """A picture of one frequency gives the sum of its aliases; haze stays at frequency 0."""
    elements = phase_elements("singlet")
    how = {"sensor_distance": 35.5, "sensor": NOISY, "pixels": 9, "boundary": "circular", "normalise": "haze"}
    camera = Camera(PhaseVariables(elements[0]), Same(), object_distances=(1e3, 2e3), oversampling=2, **how)
    picture = torch.rand(1, 1, 24, 18, dtype=torch.float64)
    H = camera.transfer(camera.kernels([1e3]), (24, 18))
    aliases = (torch.fft.fft2(picture) * H).unflatten(-1, (2, 9)).unflatten(-3, (2, 12)).mean((-4, -2))
    torch.testing.assert_close(torch.fft.fft2(camera.image(picture, [1e3])), aliases)
    assert H[..., 0, 0] == 1
    with pytest.raises(ValueError, match="24 × 17 pixels: expected multiples of 2"):
        camera.image(picture[..., :17], [1e3])
    with pytest.raises(ValueError, match="oversampling 2"):
        camera_error(camera, torch.ones(24, 24), [1e3])
    with pytest.raises(ValueError, match="oversampling 0"):
        Camera(camera.variables, Same(), oversampling=0, **how)


def test_noise_is_that_of_the_sensor_and_of_the_number_of_the_picture():
    """By default with random numbers, which torch's seed repeats; a sensor of no saturation clips no light."""
    own = Camera(Variables(read_lens(LENS), "sensor"), Same(), sensor=NOISY, fields=[0], pixels=7)
    picture, distances = torch.full((2, 70, 70), 0.9), number([2e4, 3e4])
    numbered = own(picture, distances, index=[3, 7])
    assert float((numbered - 0.9).std()) == pytest.approx(0.1, rel=0.03)
    assert float(numbered.mean()) == pytest.approx(0.9, abs=3e-3)
    assert torch.equal(own(picture[:1], distances[:1], index=[7]), numbered[1:].expand(1, -1, -1, -1))
    torch.manual_seed(0)
    first, second = own(picture, distances), own(picture, distances)
    torch.manual_seed(0)
    assert torch.equal(own(picture, distances), first)
    assert float((first - second).abs().mean()) > 0.05
    clipped = Camera(own.variables, Same(), sensor=dataclasses.replace(NOISY, saturation=1.0), fields=[0], pixels=7)
    assert float(clipped(picture, distances, index=[3, 7]).max()) == 1.0


def test_a_lens_user_learns_lens_and_network_in_a_few_lines():
    """Ten steps move the sensor by about 1 µm each, and the loss falls."""
    torch.manual_seed(0)
    own = Camera(Variables(read_lens(LENS), "sensor"), RedNet(RedNetShape(4, 4)), sensor=NOISY, pixels=7)
    optimizer = torch.optim.Adam(own.parameters(), 1e-3)
    pictures = torch.rand(8, 22, 22)
    start, losses = own.variables.numbers()["sensor"], []
    for _ in range(10):
        restored = own(pictures, number([3e4] * 8), field=0, index=range(8))
        loss = (restored - own.target(pictures)).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0]
    assert MICROMETRE < abs(own.variables.numbers()["sensor"] - start) < 11 * MICROMETRE


def test_experiment_starts_where_it_is_asked():
    lens, wavelength = read_lens(LENS), number(0.53)
    by_start = {s: lens_at_start(lens, CodesignSettings(start=s)) for s in ("paraxial", "rms", "58.1")}
    places = {s: float(one.surfaces[-2].thickness) for s, one in by_start.items()}
    assert places["paraxial"] == pytest.approx(57.8817685, abs=1e-7)
    assert places["rms"] == pytest.approx(57.662, abs=5e-4)
    assert places["58.1"] == 58.1
    assert by_start["rms"].wavelengths.tolist() == [float(wavelength)]
    slow = lens_at_start(lens, CodesignSettings(f_number=5.0))
    assert slow.aperture.kind == "image_f_number"
    with pytest.raises(ValueError, match="'middle': expected paraxial, rms, spectral, gaussian"):
        lens_at_start(lens, CodesignSettings(start="middle"))


def test_distance_in_focus_is_the_inverse_of_focusing():
    """25 m in paraxial focus; by least RMS spot that sensor is focused elsewhere: 17 to 21 m at F/3."""
    lens = lens_at_start(read_lens(LENS), CodesignSettings())
    paraxial = distance_in_focus(lens, lambda one: paraxial_image_distance(one, one.surfaces[0].thickness))
    assert paraxial == pytest.approx(25e3, rel=1e-6)
    rms = distance_in_focus(lens, best_focus)
    sharp = float(best_focus(with_object_distance(lens, rms)))
    assert sharp == pytest.approx(float(lens.surfaces[-2].thickness), abs=1e-8)
    assert 10e3 < rms < 25e3
    assert distance_in_focus(lens_at_start(read_lens(LENS), CodesignSettings(start="57.0")), best_focus) == math.inf
    with pytest.raises(ValueError, match="in focus nearer than 500 mm"):
        distance_in_focus(lens_at_start(read_lens(LENS), CodesignSettings(start="150")), best_focus)


def test_samples_are_keyed_by_their_number():
    pictures = dead_leaves(2, size=48)
    whole = make_batch(pictures, SMALL, [0, 1, 2, 3], epoch=1)
    odd = make_batch(pictures, SMALL, [1, 3], epoch=1)
    assert torch.equal(whole.picture[1::2], odd.picture)
    assert torch.equal(whole.distance[1::2], odd.distance)
    assert torch.equal(whole.index[1::2], odd.index)
    assert 10e3 <= float(whole.distance.min()) <= float(whole.distance.max()) <= 50e3
    batches = Batches(pictures, SMALL)
    assert torch.equal(batches(1, Share()).distance, make_batch(pictures, SMALL, [0, 1, 2, 3], epoch=1).distance)
    with pytest.raises(ValueError, match="do not fill one batch of 64"):
        Batches(pictures, dataclasses.replace(SMALL, batch=64))


def test_losses_of_shares_add_up_to_that_of_the_batch():
    """What two processes sum is what one computes: to 1e-12 in double precision, gradients too."""
    own = initial_camera(read_lens(LENS), SMALL).double()
    whole = make_batch(dead_leaves(2, size=48), SMALL, [0, 1, 2, 3], epoch=0)
    parts = [
        dataclasses.replace(
            whole,
            picture=whole.picture[i::2].double(),
            distance=whole.distance[i::2],
            index=whole.index[i::2],
            field=whole.field[i::2],
        )
        for i in range(2)
    ]
    whole = dataclasses.replace(whole, picture=whole.picture.double())
    (together,) = torch.autograd.grad(absolute_error(own, whole).sum(), own.variables.sensor)
    apart = [torch.autograd.grad(absolute_error(own, part).sum(), own.variables.sensor)[0] for part in parts]
    assert float(sum(apart)) == pytest.approx(float(together), rel=1e-12)


@pytest.mark.slow
def test_fields_take_turns():
    settings = dataclasses.replace(SMALL, fields=(0.0, 14.0), model="gaussian")
    own = initial_camera(read_lens(LENS), settings)
    own.network = Same()
    four = make_batch(dead_leaves(2, size=48), settings, [0, 1, 2, 3], epoch=0)
    assert four.field == [0, 1, 0, 1]
    errors = absolute_error(own, four)
    for i in range(4):
        one = make_batch(dead_leaves(2, size=48), settings, [i], epoch=0)
        torch.testing.assert_close(absolute_error(own, one)[0], errors[i], atol=2e-3, rtol=1e-4)
    assert float((own.kernels(number([2e4]), 0) - own.kernels(number([2e4]), 1)).abs().sum()) > 0.1


def test_a_run_of_both_steps_and_its_outcome(tmp_path):
    train_pictures, test_pictures = split(dead_leaves(10, size=32))
    arguments = read_lens(LENS), train_pictures, test_pictures, SMALL, tmp_path
    steps = list(run_model(*arguments, about={"lens": "double_gauss"}, distances=(1e4, 3e4)))
    assert [name for name, *_ in steps] == ["joint"] * 4 + ["refine"] * 4
    joint = [record["sensor"] for name, _, record in steps if name == "joint"]
    assert joint[0] == pytest.approx(57.8817685, abs=1e-6)
    assert joint[-1] != joint[0]
    assert len({record["sensor"] for name, _, record in steps if name == "refine"}) == 1, "the optics are frozen"
    found = outcome(tmp_path)
    assert found.sensor_mm == steps[-1][2]["sensor"]
    assert 0 < found.l1_drt < 1
    assert set(found.by_distance) == {"10000", "30000"}
    assert list(run_model(*arguments, about={"lens": "double_gauss"}, distances=(1e4, 3e4))) == []


@pytest.mark.slow
def test_a_run_stopped_in_either_step_ends_as_if_it_had_not_been(tmp_path):
    train_pictures, test_pictures = split(dead_leaves(10, size=32))

    def run(folder, stop_after=None):
        steps = run_model(read_lens(LENS), train_pictures, test_pictures, SMALL, folder, about={}, distances=(3e4,))
        for taken, _ in enumerate(steps, 1):
            if taken == stop_after:
                return

    run(tmp_path / "whole")
    run(tmp_path / "parts", stop_after=2)
    run(tmp_path / "parts", stop_after=6)
    run(tmp_path / "parts")
    assert outcome(tmp_path / "whole") == outcome(tmp_path / "parts")


def test_focus_at_infinity_is_null_in_the_file_of_an_outcome(tmp_path):
    """JSON knows no infinity; read back it is one again."""
    found = Outcome("gaussian", 0, 0.1, 0.2, 0.3, math.inf, 31.5, 57.1, {"sensor": 57.1}, {"10000": 0.4})
    write_outcome(found, tmp_path)
    document = json.loads((tmp_path / "outcome.json").read_text(), parse_constant=pytest.fail)
    assert (document["focus_paraxial_m"], document["focus_rms_m"]) == (None, 31.5)
    assert outcome(tmp_path) == found


@pytest.mark.parametrize(
    ("vary", "bounds"),
    [("sensor", ""), ("sensor curvature:3", "sensor:57.4,58 curvature_3:0.0278,0.02785")],
)
def test_a_run_begins_at_the_optimum_of_the_closed_form(tmp_path, vary, bounds):
    """The first row of the log is the lens before its first step."""
    settings = dataclasses.replace(SMALL, start="spectral", vary=vary, bounds=bounds, model="paraxial")
    pictures = split(dead_leaves(10, size=32))
    own = initial_camera(read_lens(LENS), settings)
    begun = own.variables.numbers()
    course = optimise_closed_form(own, patch_spectrum(pictures[0], 22, crops=settings.crops))
    assert course.errors[-1] < 0.999 * course.errors[0]
    assert all(value != begun[name] for name, value in own.variables.numbers().items())
    _, step, record = next(run_model(read_lens(LENS), *pictures, settings, tmp_path, about={}, distances=()))
    assert step == 0
    assert {name: record[name] for name in begun} == own.variables.numbers()


@pytest.mark.slow
def test_a_run_started_from_the_closed_form_resumes_to_the_same_end(tmp_path):
    """Stopped before its first checkpoint it begins there again; behind one it goes on from that."""
    settings = dataclasses.replace(SMALL, start="spectral", model="paraxial")
    pictures = split(dead_leaves(10, size=32))

    def run(folder, stop_after=99):
        steps = run_model(read_lens(LENS), *pictures, settings, folder, about={}, distances=())
        return [record for _, (*_, record) in zip(range(stop_after), steps, strict=False)]

    run(tmp_path / "whole")
    for stop_after in (2, 6, 99):
        run(tmp_path / "parts", stop_after)
    assert outcome(tmp_path / "whole") == outcome(tmp_path / "parts")
    for name in ("joint/log.csv", "refine/log.csv"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes()


@pytest.mark.slow
def test_a_resumed_run_keeps_the_order_of_its_psfs(tmp_path, monkeypatch):
    """The order is planned for the lens as it begins, not for the one of the checkpoint."""
    planned, plan = [], Camera.plan

    def recording(own):
        order = plan(own)
        planned.append((own.model, own.variables.numbers()["sensor"]))
        return order

    monkeypatch.setattr(Camera, "plan", recording)
    train_pictures, test_pictures = split(dead_leaves(10, size=32))
    for _ in range(2):
        arguments = read_lens(LENS), train_pictures, test_pictures, SMALL, tmp_path
        next(s for s in run_model(*arguments, about={}, distances=()) if s[0] == "refine")  # stopped behind step 1
    assert planned[0] == planned[2] == ("gaussian", pytest.approx(57.8817685, abs=1e-6))
    assert planned[1] == planned[3] != ("drt", planned[0][1])


@pytest.mark.slow
def test_bounds_hold_in_training_and_in_the_closed_form(tmp_path):
    """From the paraxial start both go towards the lens: to the bound, and no further."""
    settings = dataclasses.replace(SMALL, bounds="sensor:57.88,58", epochs=2)
    pictures = split(dead_leaves(10, size=32))[0]
    steps = list(optimise(initial_camera(read_lens(LENS), settings), pictures, settings, Run(tmp_path, {})))
    free = dataclasses.replace(settings, bounds="")
    beyond = list(optimise(initial_camera(read_lens(LENS), free), pictures, free, Run(tmp_path / "free", {})))
    assert beyond[-1][1]["sensor"] < 57.8793
    assert steps[-1][1]["sensor"] == pytest.approx(57.88, abs=1e-9)
    own = initial_camera(read_lens(LENS), settings)
    optimise_closed_form(own, patch_spectrum(pictures, 22))
    assert own.variables.numbers()["sensor"] == pytest.approx(57.88, abs=1e-9)
    with pytest.raises(BadVariables, match="`bounds` for thickness_5, not among"):
        initial_camera(read_lens(LENS), dataclasses.replace(SMALL, bounds="thickness_5:1,2"))


def test_an_unbuildable_lens_has_a_penalty_and_is_pushed_back(tmp_path):
    """An air space of -0.2 mm lacks 0.25 mm of 0.05: a penalty of 0.0625 mm², and a slope that opens it."""
    lens = read_lens(LENS)
    squeezed = lens.replace(2, thickness=number(-0.2))
    settings = dataclasses.replace(SMALL, vary="thickness:2", air_thickness="0.05:60")
    own = initial_camera(squeezed, settings)
    pictures = split(dead_leaves(10, size=32))[0]
    with torch.no_grad():
        image = float(absolute_error(own, make_batch(pictures, settings, [0, 1, 2, 3], 0)).sum()) / (4 * 16**2)
    lacking = float(own.variables.violation().detach())
    assert lacking == pytest.approx(0.25**2, rel=1e-12)
    steps = list(optimise(own, pictures, settings, Run(tmp_path, {})))
    assert steps[0][1]["loss"] == pytest.approx(image, rel=1e-6)
    assert steps[0][1]["penalty"] == lacking
    assert Run(tmp_path, {}).rows()[0]["penalty"] == lacking
    places = [record["thickness_2"] for _, record in steps]
    assert all(after > before for before, after in itertools.pairwise(places))
    # In the closed form too: buildable again, but for what a gain of image is worth against the square.
    own = initial_camera(squeezed, settings)
    course = optimise_closed_form(own, patch_spectrum(pictures, 22))
    assert course.penalties[0] == lacking
    assert course.penalties[-1] == float(own.variables.violation().detach()) < 1e-3
    assert max(course.errors) < 0.1  # without the penalty


def test_an_optimum_at_the_end_of_its_range_is_none():
    """The least error lies near 57.79 mm: bounds that leave it out, on either side, hold no optimum."""
    S = patch_spectrum(dead_leaves(4, size=64), 22)
    for bounds, end in (("sensor:57.85,58", 57.85), ("sensor:57.6,57.7", 57.7)):
        own = initial_camera(
            read_lens(LENS), dataclasses.replace(SMALL, model="paraxial", bounds=bounds, start="57.86")
        )
        own.variables.project()
        course = optimise_closed_form(own, S, distances=even_distances(own, 5))
        assert own.variables.numbers()["sensor"] == pytest.approx(end, abs=1e-9)
        assert course.at_end == ("sensor",)
        low, high = bounds.removeprefix("sensor:").split(",")
        assert course.no_optimum == (f"no optimum inside sensor from {low} to {high}: the loss still falls at its end")


@pytest.mark.slow
def test_a_sensor_that_is_in_focus_for_nothing_is_no_optimum():
    """20 mm behind all images windows hold but the middle of any blur, and the slope leads nowhere."""
    S = patch_spectrum(dead_leaves(4, size=64), 22)
    own = initial_camera(read_lens(LENS), dataclasses.replace(SMALL, model="paraxial", start="80"))
    assert re.match(r"no optimum inside 57\.3\d* to 58\.5\d* mm of sensor distance", out_of_focus(own))
    course = optimise_closed_form(own, S, distances=even_distances(own, 5))
    assert course.no_optimum.endswith(f"went to {own.variables.numbers()['sensor']:.7g} mm")
    low, high = sensor_range(own.variables(), own.range, fields=own.fields, width=7 * 0.005)
    images = [float(paraxial_image_distance(read_lens(LENS), number(d))) for d in (10e3, 50e3)]
    assert low < min(images) < max(images) < high
    # By similar triangles: at F/N a blur as wide as the window is N windows away.
    number_of_the_lens = float(first_order(own.variables()).paraxial_working_f_number)
    assert high - max(images) == pytest.approx(7 * 0.005 * number_of_the_lens, rel=0.1)


def test_a_telescope_too_near_its_object_has_no_image_to_be_learned():
    """10 to 50 m lie within a focal length of 57.6 m."""
    lens = read_lens(shipped("lenses") / "hubble.zmx")
    with pytest.raises(NoImage, match=r"no real image .*10000 mm"):
        lens_at_start(lens, CodesignSettings())
    far = dataclasses.replace(CodesignSettings(), near=1e8, far=1e9, focus_distance=2e8)
    assert float(lens_at_start(lens, far).surfaces[-2].thickness) > 6406


def test_kernels_of_several_wavelengths_are_their_weighted_sum():
    """At one place of the sensor; PSFs to the tolerance of one order."""
    distances, found = number([20e3]), {}
    for colours, weights in (((0.48,), (1.0,)), ((0.62,), (1.0,)), ((0.48, 0.62), (1.0, 3.0))):
        settings = dataclasses.replace(
            SMALL, model="paraxial", start="57.8", wavelengths=colours, wavelength_weights=weights, normalise="energy"
        )
        found[colours] = initial_camera(read_lens(LENS), settings).kernels(distances)
    blue, red, both = found.values()
    torch.testing.assert_close(both, 0.25 * blue + 0.75 * red, rtol=0, atol=1e-6)
    assert float((blue - red).detach().abs().max()) > 1e-3
    with pytest.raises(ValueError, match="1 wavelength_weights for 2 wavelengths"):
        initial_camera(read_lens(LENS), dataclasses.replace(SMALL, wavelengths=(0.48, 0.62)))


@pytest.mark.slow
def test_a_run_writes_the_lens_that_it_learned(tmp_path):
    """Read back it is the lens of the outcome to the last bit, and traces to the same spot."""
    settings = dataclasses.replace(
        SMALL, vary="sensor thickness:5 curvature:3", wavelengths=(0.53, 0.62), wavelength_weights=(1.0, 0.5)
    )
    pictures = split(dead_leaves(10, size=32))
    for _ in run_model(read_lens(LENS), *pictures, settings, tmp_path, about={}, distances=()):
        pass
    found, learned = outcome(tmp_path), read_lens(tmp_path / "lens.zmx")
    assert float(learned.surfaces[-2].thickness) == found.sensor_mm
    assert float(learned.surfaces[5].thickness) == found.variables["thickness_5"]
    assert float(learned.surfaces[3].curvature) == found.variables["curvature_3"]
    assert learned.wavelengths.tolist() == [0.53, 0.62]
    assert 1e-3 * distance_in_focus(learned, best_focus) == pytest.approx(found.focus_rms_m, rel=1e-9)


@pytest.mark.parametrize(
    "model", ["paraxial", "fourier", *(pytest.param(model, marks=pytest.mark.slow) for model in ("gaussian", "drt"))]
)
def test_rho_is_of_the_paraxial_model_alone(model):
    """σ = ρε: the second moment of a kernel grows with ρ², less that of the pixel; other models do not know it."""
    distances = number([20e3])
    narrow, wide = (
        initial_camera(read_lens(LENS), dataclasses.replace(SMALL, size=21, model=model, rho=rho)).kernels(distances)
        for rho in (0.3, 0.6)
    )
    assert torch.equal(narrow, wide) == (model != "paraxial")
    if model == "paraxial":
        x = torch.arange(-10, 11, dtype=torch.float64)
        blurs = [float((kernel[0, 0].sum(0) * x**2).sum().detach()) - 1 / 12 for kernel in (narrow, wide)]
        assert blurs[1] / blurs[0] == pytest.approx(4, rel=1e-3)  # the window holds all but the tails


@pytest.mark.slow
def test_training_moves_the_sensor_towards_less_loss(tmp_path):
    """From a sensor 0.3 mm too close, Adam moves away from the lens at 1 µm a step."""
    settings = dataclasses.replace(SMALL, start="57.3", epochs=5)
    own = initial_camera(read_lens(LENS), settings)
    steps = list(optimise(own, split(dead_leaves(10, size=32))[0], settings, Run(tmp_path, {})))
    assert steps[-1][1]["sensor"] > 57.3 + 5 * MICROMETRE


@pytest.mark.slow
def test_closed_form_finds_the_least_error_and_paraxial_and_fourier_agree():
    """Optima over 10 to 50 m with a 1/f² spectrum: both near 34 m paraxial, Gaussian DRT closer to the lens."""
    S = patch_spectrum(dead_leaves(8, size=64), 48)
    places = {}
    for model in ("paraxial", "fourier", "gaussian"):
        own = initial_camera(read_lens(LENS), dataclasses.replace(SMALL, model=model, size=21))
        course = optimise_closed_form(own, S, distances=even_distances(own, 9))
        assert min(course.errors) == pytest.approx(course.errors[-1], rel=1e-6)
        assert (course.no_optimum, course.at_end) == ("", ())
        places[model] = own.variables.numbers()["sensor"]
        with torch.no_grad():
            here = float(camera_error(own, S, even_distances(own, 9)))
            for shift in (-0.01, 0.01):
                own.variables.sensor += shift
                assert float(camera_error(own, S, even_distances(own, 9))) > here
                own.variables.sensor -= shift
    assert places["paraxial"] == pytest.approx(places["fourier"], abs=0.02)
    assert places["gaussian"] < places["paraxial"] - 0.05


def test_off_the_axis_the_window_follows_the_chief_ray_with_its_derivative():
    """A kernel at 14° against central differences: the chief ray moves by 0.25 mm per mm of the sensor."""
    own = initial_camera(read_lens(LENS), CodesignSettings(model="gaussian", fields=(0.0, 14.0), start="57.66"))
    distances = number([1.2e4, 2e4, 4e4])
    sensor, pattern = own.variables.get_parameter("sensor"), torch.cos(torch.arange(441.0, dtype=torch.float64))

    def value():
        return (own.kernels(distances, 1).flatten(1) @ pattern).sum()

    (slope,) = torch.autograd.grad(value(), sensor)
    ends = []
    with torch.no_grad():
        for place in (1e-4, -1e-4):
            sensor.fill_(place)
            ends.append(value())
    torch.testing.assert_close(slope, (ends[0] - ends[1]) / 2e-4, rtol=1e-4, atol=0)


def test_models_without_distortion_are_centred_on_their_image():
    own = initial_camera(read_lens(LENS), CodesignSettings(model="paraxial", fields=(0.0, 14.0)))
    distances = number([1.2e4, 2e4, 4e4])
    torch.testing.assert_close(own.kernels(distances, 1), own.kernels(distances, 0))


@pytest.mark.parametrize("points", [None, gauss_rings(3, 6)[0]], ids=["rays of the tolerance", "pupil points"])
def test_the_window_follows_the_chief_ray_of_a_tilted_lens(points):
    """The tilt moves the image on the axis by 0.27 mm, out of a window of 0.1 mm about the axis."""
    lens = read_lens(LENS).replace(4, tilt_x=0.13)
    model = Gaussian() if points is None else Gaussian(rays=points)
    own = Camera(Variables(lens, "sensor tilt_x:4"), Same(), tol=1e-4, model=model)
    distances = number([17e3])
    kernels = own.kernels(distances)
    wanted = psf(lens, "gaussian", object_distances=distances, fields=own.fields, tol=1e-4, normalise="window")
    assert float((kernels - wanted.kernel).abs().sum()) < (2e-4 if points is None else 2e-2)
    tilt = own.variables.get_parameter("tilt_x_4")
    (slope,) = torch.autograd.grad(kernels[0, 0, 10, 8], tilt)
    with torch.no_grad():
        ends = [(tilt.fill_(change), own.kernels(distances)[0, 0, 10, 8])[1] for change in (1e-4, -1e-4)]
    assert float(slope) == pytest.approx(float(ends[0] - ends[1]) / 2e-4, rel=1e-5)


@pytest.mark.parametrize("model", ["gaussian", "drt"])
def test_a_kernel_does_not_depend_on_its_batch(model):
    own = initial_camera(read_lens(LENS), CodesignSettings(model=model, fields=(0.0, 7.0)))
    distances = number([1.2e4, 4e4])
    with torch.no_grad():
        kernels, other = own.kernels(distances, 1), own.kernels(number([-1.2e4, 4e4]), 1)
        alone = own.kernels(distances[1:], 1)
    torch.testing.assert_close(other[1], kernels[1], rtol=0, atol=1e-11)
    torch.testing.assert_close(alone[0], kernels[1], rtol=0, atol=1e-11)
    torch.testing.assert_close(own.kernels(distances, 1).detach(), kernels, rtol=0, atol=1e-11)


@pytest.mark.parametrize(("model", "normalise"), [("gaussian", "window"), ("gaussian", "energy"), ("drt", "window")])
def test_kernels_of_a_clipped_lens_are_computed_together(model, normalise, monkeypatch):
    """At places and distances of their own, some clipped and some not: those of each pair alone, to rounding, with
    their derivatives; one call of the Gaussian model, and one search of field points."""
    settings = dataclasses.replace(
        SMALL, vignetting="semi-diameters", wavelengths=(0.48, 0.6), wavelength_weights=(1, 1)
    )
    lens = lens_at_start(read_lens("cooke_triplet"), dataclasses.replace(settings, f_number=4.0))
    parameters = Gaussian(order=3) if model == "gaussian" else DRT(order=0)
    own = Camera(
        Variables(lens, "curvature:1,4 sensor"), Same(), sensor=Sensor((28, 20), (1400, 1000)), model=parameters,
        pixels=9, normalise=normalise,
    )  # fmt: skip
    points, distances = (
        number([[0.0, 6.0, 13.0, 0.0, 4.0], [0.0, 2.0, 8.0, 9.0, 2.0]]),
        number([8e3, 2e4, 1e4, 2e4, 2e4]),
    )
    calls, aimed, fields_of = [], [], Sensor.fields
    monkeypatch.setattr(field_kernels, "psf", lambda *a, **o: (calls.append(a), psf(*a, **o))[1])
    monkeypatch.setattr(Sensor, "fields", lambda *a: (aimed.append(a), fields_of(*a))[1])

    def slopes(kernels):
        each = torch.autograd.grad(kernels.square().sum(), [*own.variables.parameters()], retain_graph=True)
        return torch.stack(each)

    together = own.kernels(distances, points=points)
    assert len(aimed) == 1
    assert len(calls) == (1 if model == "gaussian" else 5)
    for k in range(5):
        alone = own.kernels(distances[[k]], points=points[:, [k]])
        torch.testing.assert_close(together[k], alone[0], rtol=0, atol=1e-12)
        torch.testing.assert_close(slopes(together[k]), slopes(alone), rtol=1e-8, atol=1e-11)
    with torch.no_grad():
        together = own.kernels(distances, points=points)
        alone = torch.cat([own.kernels(distances[[k]], points=points[:, [k]]) for k in range(5)])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-12)


def test_distances_in_metres_and_points_beyond_the_sensor_are_refused():
    own = Camera(
        Variables(read_lens("cooke_triplet"), "sensor"),
        torch.nn.Identity(),
        sensor=Sensor((24, 16), (240, 160)),
    )
    with pytest.raises(ValueError, match="give mm"):
        own(torch.rand(1, 1, 32, 32), 25.0)
    with pytest.raises(ValueError, match="beyond the edges of the sensor of 24 x 16 mm"):
        own(torch.rand(1, 1, 32, 32), 25e3, points=torch.tensor([[12.1], [0.0]]))
    for distance in (math.nan, 0.0):
        with pytest.raises(ValueError, match="expected distances in mm, not 0 or nan"):
            own.kernels([distance, 2e4], [0, 0])
    with pytest.raises(NoImage, match=r"object_distances 10 to 50 mm: no real image .* give the range of the scene in"):
        Camera(own.variables, Same(), object_distances=(10, 50))
    with pytest.raises(ValueError, match="expected distances in mm, not 0"):
        Camera(own.variables, Same(), object_distances=(0, 5e4))


def test_a_thickness_that_training_has_turned_negative_is_said_once():
    """In a plain loop of torch, which has neither `project` nor `violation`."""
    own = Camera(Variables(read_lens("cooke_triplet"), "thickness:2,4"), Same(), pixels=7, model=Gaussian(order=3))
    with warnings.catch_warnings():
        warnings.simplefilter("error", Unbuildable)
        own.kernels(2e4)
    with torch.no_grad():
        own.variables.get_parameter("thickness_2").sub_(20.0 / own.variables.variables[0].unit)
    with pytest.warns(Unbuildable, match="no limit of thicknesses is met: give Variables"):
        own.kernels(2e4)
    with warnings.catch_warnings():
        warnings.simplefilter("error", Unbuildable)
        own.kernels(2e4)


def test_places_given_in_another_order_are_refused():
    variables = Variables(read_lens("cooke_triplet").at(wavelengths=[0.55]))
    own = Camera(variables, Same(), sensor=Sensor((24, 16), (240, 160)), pixels=7, model=Gaussian(order=3))
    pictures, points = torch.rand(2, 1, 16, 16), torch.tensor([[0.0, 1.0], [10.0, 7.0]])
    with pytest.raises(ValueError, match=r"\(0, 10\) mm is beyond .*; expected points \(2, B\), all x"):
        own(pictures, 2e4, points=points)
    assert own(pictures, 2e4, points=points.T).shape == (2, 1, 10, 10)
    with pytest.raises(ValueError, match=r"points of shape \(3, 2\): expected \(2, 3\) mm, .* points.T"):
        own.kernels([2e4] * 3, points=torch.zeros(3, 2))
    with pytest.raises(TypeError, match="points: a list"):
        own(pictures, 2e4, points=[[0, 0], [0, 0]])
    with pytest.raises(ValueError, match=r"fields of shape \(3, 2\)"):
        Camera(own.variables, Same(), fields=torch.zeros(3, 2))
    with pytest.raises(ValueError, match="field 3: expected the number of a field, 0 to 2"):
        own(pictures, 2e4, field=3)


def test_one_distance_is_that_of_all_places():
    variables = Variables(read_lens("cooke_triplet").at(wavelengths=[0.55]))
    own = Camera(variables, Same(), sensor=Sensor((24, 16), (240, 160)), pixels=7, model=Gaussian(order=3))
    pictures, points = torch.rand(2, 1, 16, 16), torch.tensor([[0.0, 1.0], [0.0, 7.0]])
    for places in ({"points": points}, {"field": [0, 2]}):
        assert torch.equal(own(pictures, 2e4, **places), own(pictures, [2e4] * 2, **places))


@pytest.mark.slow
def test_a_compiled_camera_has_the_same_images_and_derivatives():
    """The compiler sees blur and network; kernels, checks and noise run outside its graphs."""
    lens, graphs = read_lens("cooke_triplet").at(wavelengths=[0.55]), []
    network = RedNet(RedNetShape(2, 2))
    own = Camera(Variables(lens, "sensor"), network, sensor=NOISY, fields=[0], pixels=7, model=Gaussian(order=3))

    def counted(graph, inputs):
        graphs.append([str(node.target) for node in graph.graph.nodes])
        return graph.forward

    def slope(camera):
        image = camera(torch.ones(2, 1, 16, 16), [2e4, 3e4], index=[0, 1])
        return image.detach(), torch.autograd.grad(image.square().sum(), own.variables.sensor)[0]

    compiled = torch.compile(own, backend=counted)
    assert all(map(torch.equal, slope(compiled), slope(own)))
    count = len(graphs)
    assert all(map(torch.equal, slope(compiled), slope(own)))
    assert len(graphs) == count <= 5
    assert any("conv2d" in target for graph in graphs for target in graph)


@pytest.mark.parametrize("model", [Gaussian(order=3), DRT(order=1)])
def test_pictures_on_the_processor_stay_there_under_another_default_device(model):
    lens = read_lens("cooke_triplet").at(wavelengths=[0.48, 0.55, 0.65])
    own, other = (Camera(Variables(lens, "sensor"), Same(), sensor=COLOUR, pixels=7, model=model) for _ in range(2))
    levels = torch.randint(0, 255, (2, 3, 16, 16), dtype=torch.uint8)
    points, index = torch.tensor([[0.0, 1.0], [0.0, 7.0]]), torch.arange(2)

    def pictures(camera):
        yield camera(levels, 2e4, points=points, index=[0, 1])
        yield camera.target(levels)
        yield camera.sensor.patch_points(camera.sensor.random_patches(index, 10), 10)

    expected = [*pictures(other)]
    with torch.device("meta"):
        again = [*pictures(own)]
        again[0].sum().backward()
        own.variables.project()
        assert own(levels[:1], 2e4).device.type == "cpu"  # of noise without numbers
    assert all(map(torch.equal, again, expected))


@pytest.mark.parametrize(("model", "field"), [(Paraxial(), 0), (Gaussian(order=4), 11), (DRT(order=2), 11)])
def test_light_outside_the_windows_is_a_number_and_a_warning(model, field):
    """Kernels of sum 1 hide it: of a sensor 3 mm out of focus, of a field whose beam is vignetted."""
    lens = focused(read_lens("cooke_triplet").at(f_number=16, wavelengths=[0.55]), 2e4)
    own = Camera(Variables(lens, "sensor"), Same(), sensor=NOISY, fields=[field], pixels=11, model=model)
    with warnings.catch_warnings():
        warnings.simplefilter("error", EnergyOutside)
        own.kernels(2e4)
    with torch.no_grad():
        own.variables.sensor.fill_(3.0)
    expected = psf(
        own.variables(), model, fields=own.fields, object_distances=[2e4], center="chief", pixel=0.005, size=11
    )
    outside = own.energy_outside([2e4])
    assert float(outside) == pytest.approx(float(expected.energy_outside), rel=1e-2)  # chief rays differ
    assert 0.5 < float(outside) < 1
    slope = torch.autograd.grad(outside.sum(), own.variables.sensor)[0]
    assert float(slope) > 0
    with pytest.warns(EnergyOutside, match=rf"{100 * float(outside):.0f} % of the light .* 11 pixels"):
        kernels = own.kernels(2e4)
    assert float(kernels.sum()) == pytest.approx(1, abs=1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("error", EnergyOutside)
        own.kernels(2e4)


def test_a_lens_that_follows_parameters_is_copied_with_its_graph():
    variables = Variables(read_lens("cooke_triplet"), "sensor")
    lens = copy.deepcopy(variables())
    (gradient,) = torch.autograd.grad(lens.surfaces[-2].thickness, list(variables.parameters()))
    assert float(gradient) == 1.0
    fixed = copy.deepcopy(variables.lens)
    assert fixed.surfaces[1].curvature is not variables.lens.surfaces[1].curvature


def test_a_training_resumes_bit_identically_with_the_order_of_its_first_call(tmp_path):
    """Adam moves the sensor by -1 mm: a plan for this lens has another order."""
    pictures = torch.rand(2, 22, 22, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    lens = read_lens("cooke_triplet").at(wavelengths=[0.55])

    def started():
        torch.manual_seed(0)
        network = RedNet(RedNetShape(2, 2))
        own = Camera(Variables(lens, "sensor"), network, sensor=NOISY, fields=[0], pixels=7, model="drt")
        return own, torch.optim.Adam(own.rates(optics=1.0, network=1e-3))

    def train(own, optimizer, steps):
        for step in steps:
            loss = (own(pictures, [2e4, 3e4], index=[2 * step, 2 * step + 1]) - own.target(pictures)).abs().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

    own, optimizer = started()
    train(own, optimizer, range(1))
    torch.save({"camera": own.state_dict(), "optimizer": optimizer.state_dict()}, tmp_path / "state.pt")
    resumed, again = started()
    stored = torch.load(tmp_path / "state.pt", weights_only=True)
    resumed.load_state_dict(stored["camera"])
    again.load_state_dict(stored["optimizer"])
    assert torch.equal(resumed.kernels([2e4, 3e4]), own.kernels([2e4, 3e4]))
    for each in ((own, optimizer), (resumed, again)):
        train(*each, range(1, 3))
    ends = [[*each.parameters()] for each in (own, resumed)]
    assert all(map(torch.equal, *ends))
    assert own.plan() != started()[0].plan()


def test_a_state_keeps_an_order_that_is_given_and_the_sampling_of_an_element():
    lens = read_lens("cooke_triplet")
    own = Camera(Variables(lens, "sensor"), Same(), sensor=NOISY, fields=[0], model=Gaussian(order=2))
    other = Camera(Variables(lens, "sensor"), Same(), sensor=NOISY, fields=[0], model=Gaussian(order=3))
    other.load_state_dict(own.state_dict())
    assert (own._order, other._order) == (2, 3)
    element = phase_element([0.0, -1e-3], profile="powers", aperture=1.0, glass=1.5)
    alone = [
        Camera(PhaseVariables(element), Same(), sensor=NOISY, sensor_distance=35.5, object_distances=(1e3, 2e3))
        for _ in range(2)
    ]
    alone[0].plan()
    alone[1].load_state_dict(alone[0].state_dict())
    assert alone[1]._sampling == alone[0]._sampling


def test_a_camera_without_a_network_names_the_photograph():
    with pytest.raises(TypeError, match=r"`network` is missing: .*rt.render\(lens, picture\)"):
        Camera(Variables(read_lens(LENS), "sensor"), sensor=Sensor())
