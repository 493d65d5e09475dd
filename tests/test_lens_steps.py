"""Steps of second order of the lens of a camera: in a loop of torch, and to the optimum of the closed form."""

import copy
import io
import warnings

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace.imaging.closed_form import camera_error, even_distances, least_of_closed_form, optimise_closed_form
from raytrace.imaging.lens_steps import LensSteps
from raytrace.optimization.problem import NoProblem
from raytrace.tracing.geometry import Unbuildable

TRIPLET = rt.read_lens("cooke_triplet")
FREQUENCY = torch.fft.fftfreq(40, dtype=torch.float64)
SPECTRUM = 1 / (FREQUENCY[:, None] ** 2 + FREQUENCY**2 + 1 / 40**2)
SPECTRUM *= 0.06 / SPECTRUM.mean()


def camera(vary="sensor", hold="", **options):
    sensor = rt.Sensor(size=(1, 1), pixels=(200, 200), read_noise=0.02)
    return rt.Camera(
        rt.Variables(TRIPLET, vary, hold=hold), torch.nn.Identity(), sensor=sensor, fields=[0, 8], pixels=11, **options
    )


@pytest.mark.slow
def test_both_descents_end_at_the_same_sensor():
    """A single number has a single optimum downhill."""
    ends = []
    for optimizer in ("lbfgs", "lm"):
        own = camera()
        course = optimise_closed_form(own, SPECTRUM, distances=even_distances(own, 1), optimizer=optimizer)
        ends.append((course.errors[-1], own.variables.numbers()["sensor"]))
    assert ends[1][0] == pytest.approx(ends[0][0], rel=1e-7)
    assert ends[1][1] == pytest.approx(ends[0][1], abs=2e-3)


@pytest.mark.slow
def test_the_optimum_from_the_best_spots_is_better_than_the_best_spots():
    own = camera("curvature:1-4 sensor", "efl")
    distances = even_distances(own, 2)
    LensSteps(own.variables).minimise_spots()
    sharpest = float(camera_error(own, SPECTRUM, distances).detach())
    own = camera("curvature:1-4 sensor", "efl")
    before = float(rt.first_order(own.variables()).effective_focal_length)
    course, _ = least_of_closed_form(own, SPECTRUM, distances=distances, optimizer="lm")
    assert course.errors[-1] < sharpest
    assert float(camera_error(own, SPECTRUM, distances)) == pytest.approx(course.errors[-1], rel=1e-9)
    assert float(rt.first_order(own.variables()).effective_focal_length) == pytest.approx(before, rel=1e-9)


def test_steps_in_a_loop_lower_a_loss_of_pictures_under_conditions():
    track = float(sum(surface.thickness for surface in TRIPLET.surfaces[1:-1]))
    own = camera("curvature:1-4 sensor", f"total_track<={track}")
    pictures = torch.rand(2, 32, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def loss():
        return (own(pictures, [2e4, 4e4], field=[0, 1], index=[0, 1]) - own.target(pictures)).square().mean()

    values = [own.lens_step(loss) for _ in range(3)]
    assert float(loss()) < values[0]
    assert values == sorted(values, reverse=True)
    assert float(sum(surface.thickness for surface in own.variables().surfaces[1:-1])) <= track + 1e-6


def test_a_step_leaves_bounds_fixed_numbers_and_copies():
    own = camera("curvature:1-3 sensor")
    own.variables.get_parameter("curvature_1").requires_grad_(False)
    own.variables.bounds["curvature_2"] = (-0.003, -0.0028)
    before = own.variables.numbers()
    own.lens_step(lambda: camera_error(own, SPECTRUM, even_distances(own, 2)))
    after = own.variables.numbers()
    assert after["curvature_1"] == before["curvature_1"]
    assert -0.003 - 1e-15 <= after["curvature_2"] <= -0.0028 + 1e-15
    assert after["sensor"] != before["sensor"]
    assert copy.deepcopy(own).variables.numbers() == after
    torch.save(own, io.BytesIO())


def test_steps_of_a_loaded_state_are_those_that_were_not_interrupted():
    """The curvature that the first steps have found is in the state."""
    model = rt.psf_models.Gaussian(order=3)
    own, resumed = camera("curvature:1 sensor", model=model), camera("curvature:1 sensor", model=model)

    def step(of):
        return of.lens_step(lambda: -of.kernels(2e4).square().sum())

    step(own)
    resumed.load_state_dict(own.state_dict())
    assert step(own) == step(resumed)
    assert resumed.variables.numbers() == own.variables.numbers()


def test_a_loss_without_a_number_moves_nothing_and_is_forgotten():
    """One bad batch: the steps before and after it are those of a loop without it."""
    own, other = camera("curvature:1 sensor"), camera("curvature:1 sensor")

    def loss(of):
        return lambda: -of.kernels(2e4).square().sum()

    values = [own.lens_step(loss(own))]
    for scale, words in ((np.nan, "loss is nan at the current lens"), (np.inf, "loss is -inf")):
        before = own.variables.numbers()
        with pytest.raises(NoProblem, match=words):
            own.lens_step(lambda scale=scale: scale * loss(own)())
        assert own.variables.numbers() == before
    values.append(own.lens_step(loss(own)))
    assert values == [other.lens_step(loss(other)) for _ in range(2)]
    for wrong, words in (
        (lambda: loss(own)().detach(), "no derivative by the variables"),
        (lambda: 1.0, "expected a tensor of one number"),
        (lambda: own.kernels(2e4), "expected one number"),
    ):
        with pytest.raises(NoProblem, match=words):
            own.lens_step(wrong)
    with pytest.raises(TypeError, match="expected a function"):
        own.lens_step(loss(own)())


def test_a_step_to_a_lens_that_cannot_be_made_is_said_once():
    """A loss that wants a thinner lens; the same step under the condition that holds the limits is none."""

    def thinner(own):
        return lambda: sum(surface.thickness for surface in own.variables().surfaces[1:-2]) ** 2

    own = camera("thickness:1-5 sensor")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(4):
            own.lens_step(thinner(own))
    (warning,) = [each.message for each in caught if each.category is Unbuildable]
    assert "hold='buildable'" in str(warning)
    with warnings.catch_warnings():
        warnings.simplefilter("error", Unbuildable)
        held = camera("thickness:1-5 sensor", "buildable")
        for _ in range(3):
            held.lens_step(thinner(held))


def test_a_camera_without_a_lens_says_what_to_do():
    element = rt.wave_optics.phase_element([0.0, -1e-3], profile="powers", aperture=1.0, glass=1.5)
    own = rt.Camera(rt.imaging.PhaseVariables(element), torch.nn.Identity(), sensor_distance=35.5, sensor=rt.Sensor())
    with pytest.raises(ValueError, match="phase element"):
        own.lens_step(lambda: torch.zeros(()))


def test_the_gradient_that_steps_take_is_that_of_the_loss():
    own = camera("curvature:1,2 sensor")
    steps = LensSteps(own.variables)
    steps._begin(lambda: camera_error(own, SPECTRUM, even_distances(own, 2)))
    x = steps._numbers()
    gradient = steps._function(x)[1]
    for k, change in enumerate(1e-6 * np.maximum(np.abs(x), 1e-3)):
        unit = change * np.eye(len(x))[k]
        ahead, behind = steps._function(x + unit)[0], steps._function(x - unit)[0]
        assert gradient[k] == pytest.approx((ahead - behind) / (2 * change), rel=1e-4)


def test_an_interrupt_leaves_the_best_lens_and_ends_the_run():
    own = camera("curvature:1,2 sensor")
    values, steps = [], LensSteps(own.variables)

    def interrupted():
        if len(values) == 6:
            values.append(None)
            raise KeyboardInterrupt
        error = camera_error(own, SPECTRUM, even_distances(own, 2))
        values.append(float(error.detach()))
        return error

    before = own.variables.numbers()
    with pytest.raises(KeyboardInterrupt):
        steps.minimise(interrupted)
    assert own.variables.numbers() != before
    assert float(camera_error(own, SPECTRUM, even_distances(own, 2))) == min(values[:6]) < values[0]
