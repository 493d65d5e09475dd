"""Cameras as built: PSFs of perturbed lenses, derivatives, errors drawn by sample, runs that resume, bad input."""

import dataclasses

import pytest
import torch

import raytrace as rt
from raytrace.imaging.codesign import (
    TEST_EPOCH,
    Batches,
    absolute_error,
    errors_as_built,
    initial_camera,
    make_batch,
    optimise,
)
from raytrace.imaging.pictures import dead_leaves
from raytrace.imaging.training import Run
from raytrace.settings import GRADES, CodesignSettings
from raytrace.shards import Share
from raytrace.system.tolerance_data import Compensator
from raytrace.tolerancing import grades
from raytrace.tracing import launch as launching

SMALL = CodesignSettings(optimizer="adam", depth=2, width=2, patch=8, size=7, epochs=2, batch=4, crops=2, cameras=2)
BUILT = dataclasses.replace(SMALL, as_built=True, grade="commercial", vary="sensor curvature:1,10")
DISTANCES = torch.tensor([12e3, 20e3, 45e3], dtype=torch.float64)


@pytest.fixture(scope="module")
def pictures():
    return dead_leaves(6, size=24)


def sensors(lens):
    return lens.surfaces[-2].thickness.reshape(-1)


def mean_square_radius(lens, fields):
    """(L,) mm², about the centroid of each field."""
    return rt.spot(lens, fields=fields).mean_square_radius.mean((-2, -1))


@pytest.mark.parametrize(
    ("model", "center"),
    [
        ("gaussian", "chief"),
        ("drt", "centroid"),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("gaussian", "centroid"), ("drt", "chief"))),
    ],
)
def test_a_perturbed_camera_has_the_psf_of_the_perturbed_lens(lens, model, center):
    settings = dataclasses.replace(BUILT, model=model, refocus="none", fields=(0.0, 7.0), center=center)
    built = initial_camera(lens, settings)
    built._order = 2
    errors, distances = rt.tolerancing.draw_errors(built.tolerances, 2, seed=5), DISTANCES[:2]
    parameters = rt.psf_models.Gaussian(order=2) if model == "gaussian" else rt.psf_models.DRT(order=2)
    conditions = {"fields": built.fields[:, [1]], "size": 7, "normalise": "window", "center": center}

    def expected(errors, distances):
        """Of each lens alone: a camera's kernel does not depend on the others of its call."""
        each = zip(errors.reshape(len(distances), -1).split(1), distances.split(1), strict=True)
        lenses = [
            (rt.tolerancing.perturbed(built.variables(), built.tolerances, error), distance) for error, distance in each
        ]
        kernels = [rt.psf(one, parameters, object_distances=z, **conditions).kernel for one, z in lenses]
        return torch.cat(kernels).flip(-1)  # columns of pictures grow towards -x

    with torch.no_grad():
        kernels = built.kernels(distances, 1, errors)
        assert float((kernels - expected(errors, distances)).abs().max()) < 1e-12
        for number, distance in enumerate(distances):
            alone = built.kernels(distance[None], 1, errors[number])
            assert float((alone - expected(errors[number], distance[None])).abs().max()) < 1e-12
            assert float((kernels[number] - alone[0]).abs().max()) < 1e-12


def test_without_errors_the_camera_as_built_is_the_nominal_one(lens):
    built = initial_camera(lens, dataclasses.replace(BUILT, center="chief", fields=(0.0, 7.0)))
    nominal = initial_camera(lens, dataclasses.replace(SMALL, vary=BUILT.vary, fields=(0.0, 7.0)))
    nominal._order = built._order = 3
    none = torch.zeros(len(built.tolerances), dtype=torch.float64)
    with torch.no_grad():
        for field in range(2):
            expected = nominal.kernels(DISTANCES, field)
            assert torch.equal(built.kernels(DISTANCES, field), expected)
            assert float((built.kernels(DISTANCES, field, none) - expected).abs().max()) < 1e-9


@pytest.mark.slow
def test_the_sensor_follows_the_best_focus(lens):
    """The sensor stays as far from the least spot of the perturbed lens as it is from that of the nominal one."""
    settings = dataclasses.replace(BUILT, start="rms", fields=(0.0, 7.0))
    built = initial_camera(lens, settings)
    with torch.no_grad():
        errors = rt.tolerancing.draw_errors(built.tolerances, 2, seed=3)
        nominal = built.variables()
        least = rt.tolerancing.perturbed(nominal, built.tolerances, errors)
        moved = built.as_built(errors)
        shift = sensors(moved) - sensors(least)
        assert float(shift.abs().min()) > 0.01  # mm
        at = {}
        for step in (-1e-3, 0.0, 1e-3):  # the vertices of both parabolas
            for name, one in (("nominal", rt.system.batch([nominal])), ("built", moved)):
                shifted = one.replace(11, thickness=sensors(one) + step)
                at[name, step] = mean_square_radius(shifted, built.fields)
        vertex = {
            name: 0.5e-3 * (at[name, -1e-3] - at[name, 1e-3]) / (at[name, -1e-3] + at[name, 1e-3] - 2 * at[name, 0.0])
            for name in ("nominal", "built")
        }
    assert torch.allclose(vertex["built"], vertex["nominal"].expand(2), atol=2e-5)  # mm


@pytest.mark.slow
def test_the_sensor_stays_where_nothing_is_adjusted_and_within_its_limits(lens):
    built = initial_camera(lens, BUILT)
    errors = rt.tolerancing.draw_errors(built.tolerances, 4)
    with torch.no_grad():
        still = sensors(
            rt.tolerancing.perturbed(built.variables(), built.tolerances, errors)
        )  # its gap has errors as well
        free = sensors(built.as_built(errors)) - still
        assert float(free.abs().max()) > 0.1  # so that the limit below acts
        for limit in (0.0, 0.05):
            limited = Compensator(11, minimum=-limit, maximum=limit)
            built.tolerances = dataclasses.replace(built.tolerances, compensators=(limited,))
            assert torch.allclose(sensors(built.as_built(errors)) - still, free.clamp(-limit, limit), atol=1e-12)
        fixed = initial_camera(lens, dataclasses.replace(BUILT, refocus="none"))
        assert torch.equal(sensors(fixed.as_built(errors)), still)


@pytest.mark.parametrize("refocus", ["sensor", pytest.param("none", marks=pytest.mark.slow)])
def test_gradients_through_the_perturbed_lens_are_those_of_differences(lens, refocus):
    built = initial_camera(lens, dataclasses.replace(BUILT, refocus=refocus, size=21, fields=(7.0,)))
    built._order = 2
    errors = rt.tolerancing.draw_errors(built.tolerances, 3, seed=2)
    weights = torch.linspace(0, 1, 21, dtype=torch.float64)

    def merit():
        return (built.kernels(DISTANCES, 0, errors) * weights * weights[:, None]).sum()

    found = torch.autograd.grad(merit(), [built.variables.get_parameter(name) for name in built.variables.names])
    for name, slope in zip(built.variables.names, found, strict=True):
        parameter, step = built.variables.get_parameter(name), 1e-5
        with torch.no_grad():
            values = []
            for sign in (1, -1):
                parameter.fill_(sign * step)
                values.append(float(merit()))
            parameter.fill_(0.0)
        assert float(slope) == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-5, abs=1e-6), name


def test_errors_are_drawn_by_the_number_of_the_sample(lens, pictures):
    built = initial_camera(lens, BUILT)
    every = [make_batch(pictures, BUILT, list(range(12)), epoch, built.tolerances).errors for epoch in range(2)]
    trials = rt.tolerancing.draw_errors(built.tolerances, 24, BUILT.seed)
    assert torch.equal(torch.cat(every), trials)
    some = make_batch(pictures, BUILT, [7, 3], 1, built.tolerances)
    assert torch.equal(some.errors, trials[[19, 15]])
    batches = Batches(pictures, BUILT, built.tolerances)
    whole = batches(1, Share()).errors
    halves = [batches(1, Share(rank, 2)).errors for rank in range(2)]
    assert torch.equal(torch.stack(halves, 1).flatten(0, 1), whole)
    assert torch.equal(whole, trials[4:8])
    other = make_batch(pictures, dataclasses.replace(BUILT, seed=1), [0], 0, built.tolerances)
    assert not torch.equal(other.errors[0], trials[0])
    assert make_batch(pictures, SMALL, [0], 0).errors is None


@pytest.mark.slow
def test_a_loss_is_the_sum_over_the_lenses_of_its_samples(lens, pictures):
    settings = dataclasses.replace(BUILT, fields=(0.0, 7.0))
    built = initial_camera(lens, settings)
    built._order = 2
    with torch.no_grad():
        samples = make_batch(pictures, settings, list(range(4)), 0, built.tolerances)
        together = absolute_error(built, samples)
        each = torch.cat(
            [
                absolute_error(
                    built,
                    dataclasses.replace(
                        samples,
                        picture=samples.picture[[k]],
                        distance=samples.distance[[k]],
                        index=samples.index[[k]],
                        field=[samples.field[k]],
                        errors=samples.errors[[k]],
                    ),
                )
                for k in range(4)
            ]
        )
    torch.testing.assert_close(together, each, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_an_interrupted_training_as_built_resumes_bit_by_bit(lens, pictures, tmp_path):
    def trained(folder, stop=None):
        own = initial_camera(lens, BUILT)
        own._order = 2
        run = Run(tmp_path / folder, dataclasses.asdict(BUILT))
        for step, _ in optimise(own, pictures, BUILT, run, every=2):
            if step == stop:
                return None
        return own

    whole = trained("whole")
    assert trained("parts", stop=2) is None  # one step after a checkpoint
    parts = trained("parts")
    for name, value in whole.state_dict().items():
        assert torch.equal(value, parts.state_dict()[name]), name
    assert (tmp_path / "whole/log.csv").read_bytes() == (tmp_path / "parts/log.csv").read_bytes()
    assert any(float(parts.variables.get_parameter(name).detach()) for name in parts.variables.names)


@pytest.mark.slow
def test_perturbed_cameras_of_the_test_are_the_same_for_all_trainings(lens, pictures):
    settings = dataclasses.replace(BUILT, crops=1)
    built, count = initial_camera(lens, settings), 2
    built._order = 2
    found = errors_as_built(built, pictures, settings)
    assert [len(part) for part in found] == [count, count]
    samples = make_batch(pictures, settings, list(range(4)), TEST_EPOCH)
    drawn = rt.tolerancing.draw_errors(built.tolerances, count, first=2**62)
    assert len({tuple(row) for row in drawn.tolist()}) == count
    with torch.no_grad():
        for number in range(count):
            restored = built(
                samples.picture, samples.distance, errors=drawn[number], index=samples.index, seed=samples.seed
            )
            difference = restored - built.target(samples.picture)
            assert float(difference.abs().mean()) == pytest.approx(float(found[0][number]), rel=1e-5)
            psnr = -10 * torch.log10(difference.square().mean())
            assert float(psnr) == pytest.approx(float(found[1][number]), abs=1e-4)
    nominal = dataclasses.replace(settings, as_built=False)
    other = initial_camera(lens, nominal)
    other._order = 2
    again = errors_as_built(other, pictures, nominal)
    assert torch.equal(torch.stack(again), torch.stack(found))  # of the same, untrained camera
    assert float(found[0].std()) > 0
    others = errors_as_built(built, pictures, settings, set_number=1)
    assert not set(others[0].tolist()) & set(found[0].tolist())


def test_grades_of_the_settings_are_those_of_tolerancing():
    assert set(GRADES) == set(grades.GRADES)


def test_wrong_cameras_as_built_are_refused(lens):
    variables, tolerances = rt.Variables(lens, "sensor"), rt.tolerances(lens, grade="precision")
    gap = dataclasses.replace(tolerances, compensators=(Compensator(5),))
    absent = dataclasses.replace(tolerances, rows=(rt.system.Tolerance("thickness", (40,), -1, 1),))
    for change, error, words in (
        ({"center": "middle"}, ValueError, "center 'middle': expected chief or centroid"),
        ({"tolerances": gap}, rt.BadTolerance, "adjusted by its sensor distance alone, the thickness of surface 11"),
        ({"tolerances": absent}, rt.BadTolerance, "thickness of surface 40: this lens has surfaces 0 to 11"),
        ({"tolerances": tolerances, "model": "paraxial"}, ValueError, "'paraxial' traces no rays of a lens as built"),
        (
            {"center": "centroid", "model": rt.psf_models.Gaussian(rays=torch.zeros(2, 3))},
            ValueError,
            "give center chief",
        ),
    ):
        with pytest.raises(error, match=words):
            rt.Camera(variables, rt.imaging.RedNet(), **change)
    errors = torch.zeros(3, len(tolerances), dtype=torch.float64)
    with pytest.raises(ValueError, match="errors, but no tolerances: give Camera"):
        rt.Camera(variables, rt.imaging.RedNet()).kernels(DISTANCES, 0, errors)
    built = rt.Camera(variables, rt.imaging.RedNet(), tolerances=tolerances)
    with pytest.raises(rt.BadTolerance, match=r"expected \(79,\), an error for each row"):
        built.kernels(DISTANCES, 0, errors[:, :5])
    with pytest.raises(ValueError, match="errors of 3 lenses at 2 object distances"):
        built.kernels(DISTANCES[:2], 0, errors)
    with pytest.raises(ValueError, match="refocus 'gap': expected sensor or none"):
        initial_camera(lens, dataclasses.replace(BUILT, refocus="gap"))


def test_a_sensor_in_colour_takes_lenses_as_built(lens):
    """A channel has at each place the kernel of the perturbed lens at the field point that the nominal one images
    there, about its own chief ray."""
    lens = lens.at(wavelengths=(0.48, 0.53, 0.62), ray_aiming="real")
    sensor = rt.Sensor((24, 16), (2400, 1600), response="rgb")
    tolerances = rt.tolerances(lens, grade="precision", compensators=())
    built = rt.Camera(
        rt.Variables(lens, "sensor"), torch.nn.Identity(), sensor=sensor, tolerances=tolerances, pixels=7,
        model=rt.psf_models.Gaussian(order=4),
    )  # fmt: skip
    points = torch.tensor([[0.0, 6.0], [3.0, -4.0]], dtype=torch.float64)
    errors = rt.tolerancing.draw_errors(tolerances, 2, seed=1)
    with torch.no_grad():
        kernels = built.kernels(DISTANCES[:2], errors=errors, points=points)
        fields, weights = sensor.fields(lens, points), sensor.weights(lens.wavelengths)
        for k in range(2):
            perturbed = rt.tolerancing.perturbed(lens, tolerances, errors[k])
            about = {"fields": fields[:, [k]], "object_distances": DISTANCES[k : k + 1], "per_wavelength": True}
            colours = rt.psf(perturbed, rt.psf_models.Gaussian(order=4), **about, pixel=0.01, size=7).kernel[0, 0]
            wanted = torch.einsum("cw,wij->cij", weights, colours).flip(-1)
            wanted = wanted / wanted.sum((1, 2), keepdim=True)
            assert float((kernels[k] - wanted).abs().sum((1, 2)).max()) < 1e-9


def test_lenses_as_built_at_places_of_their_own_are_aimed_together(monkeypatch):
    """Entrance pupils are found once in each trace, however many lenses there are, and a kernel is that of its lens
    alone."""
    lens = rt.read_lens("cemented_achromat").at(ray_aiming="real", wavelengths=(0.55,))
    tolerances = rt.tolerances(lens, grade="precision", compensators=())
    camera = rt.Camera(
        rt.Variables(lens, "sensor"), torch.nn.Identity(), sensor=rt.Sensor((3, 2), (300, 200)), pixels=7,
        tolerances=tolerances, model=rt.psf_models.Gaussian(order=2),
    )  # fmt: skip
    errors, aimed = rt.tolerancing.draw_errors(tolerances, 2, seed=2), []
    points = torch.tensor([[0.0, 1.0], [0.6, -0.8]], dtype=torch.float64)
    entrance_of = launching.entrance_of
    monkeypatch.setattr(launching, "entrance_of", lambda lens: (aimed.append(lens.count), entrance_of(lens))[1])
    with torch.no_grad():
        together = camera.kernels(DISTANCES[:2], errors=errors, points=points)
        assert len(aimed) == 2  # of the chief rays, and of the rays of the kernels
        alone = camera.kernels(DISTANCES[1:2], errors=errors[1], points=points[:, 1:])
    assert float((together[1] - alone[0]).abs().max()) < 1e-12
