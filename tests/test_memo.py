"""A memo changes no result: it only traces less."""

import dataclasses
from pathlib import Path

import pytest
import torch
from problems import number

from raytrace.io import read_lens
from raytrace.maths.sampling import gauss_rings
from raytrace.psf_models import Execution, Gaussian, psf
from raytrace.system.lens import Lens, SystemAperture, with_object_distance, with_sensor_distance
from raytrace.system.surface import Aperture
from raytrace.tracing.launch import rays_of_field
from raytrace.tracing.scene import Memo, points_of_bundle, trace_bundle
from raytrace.tracing.trace import lens_steps, without_apertures

LENSES = Path(__file__).parents[1] / "lenses"
PUPIL = gauss_rings(3, 8)[0]


def bundle(lens: Lens, angle: float = 7.0):
    return lens, number([[0.0], [angle]]), lens.wavelengths[:1], PUPIL


def double_gauss() -> Lens:
    return with_object_distance(read_lens(LENSES / "double_gauss.zmx"), 1e4)


def with_curvature(lens: Lens, k: int, curvature: torch.Tensor) -> Lens:
    return lens.replace(k, curvature=curvature)


def spread(rays) -> torch.Tensor:
    return rays.position[:2].square().sum() + 1e-3 * rays.opl.sum()


def crossed_by(memo: Memo, call) -> int:
    before = memo.crossed
    call()
    return memo.crossed - before


def test_a_sensor_that_moves_retraces_nothing():
    """One plane is crossed, the sensor; of eleven surfaces none."""
    lens, memo = double_gauss(), Memo()
    sensor = number(57.9).requires_grad_()
    for step in range(3):
        moved = with_sensor_distance(lens, sensor + 0.01 * step)
        found = trace_bundle(bundle(moved), memo)
        torch.testing.assert_close(found.position, trace_bundle(bundle(moved)).position, atol=0, rtol=0)
        torch.testing.assert_close(found.opl, trace_bundle(bundle(moved)).opl, atol=0, rtol=0)
    assert crossed_by(memo, lambda: trace_bundle(bundle(with_sensor_distance(lens, sensor)), memo)) == 1


@pytest.mark.parametrize("k", [2, 7, 11])
def test_surfaces_before_a_variable_one_are_not_retraced(k):
    lens, memo = double_gauss(), Memo()
    curvature = lens.surfaces[k].curvature.clone().requires_grad_()
    changed = with_curvature(lens, k, curvature)
    trace_bundle(bundle(changed), memo)
    behind = len(lens.surfaces) - k
    # The stop is surface 6: what lies before it also moves the entrance pupil, and so where all rays start.
    expected = behind if k > lens.stop else len(lens.surfaces) - 1
    assert crossed_by(memo, lambda: trace_bundle(bundle(changed), memo)) == expected


@pytest.mark.parametrize("k", [0, 2, 5, 7, 10, 11])
def test_values_and_derivatives_are_those_of_a_full_trace(k):
    lens, memo = double_gauss(), Memo()
    thickness = (lens.surfaces[k].thickness + 0.01).requires_grad_()

    def value(scale: float, memo: Memo | None) -> torch.Tensor:
        return spread(trace_bundle(bundle(lens.replace(k, thickness=scale * thickness)), memo))

    for scale in (1.0, 1.001):
        with_memo, plain = value(scale, memo), value(scale, None)
        assert float(with_memo.detach()) == float(plain.detach())
        gradients = [torch.autograd.grad(found, thickness)[0] for found in (with_memo, plain)]
        assert float(gradients[0]) == pytest.approx(float(gradients[1]), rel=1e-13)
        assert float(gradients[1]) != 0


@pytest.mark.parametrize("angle", [0.0, 3.0])
def test_changed_surfaces_are_retraced(angle):
    """A curvature without gradient, changed in place, and back again; a mirror as well."""
    lens, memo = double_gauss(), Memo()
    for factor in (1.0, 1.01, 1.0):
        changed = with_curvature(lens, 3, lens.surfaces[3].curvature * factor)
        expected = trace_bundle(bundle(changed, angle)).position
        torch.testing.assert_close(trace_bundle(bundle(changed, angle), memo).position, expected, atol=0, rtol=0)
    curvature = lens.surfaces[3].curvature.clone()
    changed = with_curvature(lens, 3, curvature)
    trace_bundle(bundle(changed, angle), memo)
    curvature *= 1.02
    expected = trace_bundle(bundle(changed, angle)).position
    torch.testing.assert_close(trace_bundle(bundle(changed, angle), memo).position, expected, atol=0, rtol=0)


def test_a_number_that_becomes_a_variable_has_its_derivative():
    lens, memo = double_gauss(), Memo()
    trace_bundle(bundle(lens), memo)
    curvature = lens.surfaces[9].curvature.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(spread(trace_bundle(bundle(with_curvature(lens, 9, curvature)), memo)), curvature)
    (expected,) = torch.autograd.grad(spread(trace_bundle(bundle(with_curvature(lens, 9, curvature)))), curvature)
    assert float(gradient) == pytest.approx(float(expected), rel=1e-13)


def test_points_behind_mirrors_are_those_of_a_full_trace():
    lens, memo = read_lens(LENSES / "hubble.zmx"), Memo()
    sensor = lens.surfaces[-2].thickness.clone().requires_grad_()
    lens = with_sensor_distance(lens, sensor)
    numbers = tuple(range(1, len(lens.surfaces)))
    fields = lens, number([[0.0], [0.02]]), lens.wavelengths[:1], PUPIL
    lens, field, pupil, wavelength = without_apertures(lens), *fields[1::2], fields[2]
    every = list(lens_steps(lens, rays_of_field(lens, field, pupil, wavelength=wavelength), wavelength))
    for _ in range(2):
        (found, met), (plain, arrive) = (points_of_bundle(fields, numbers, m) for m in (memo, None))
        assert len(found) == len(plain) == len(every)
        assert torch.equal(met, arrive)
        for one, other, crossing in zip(found, plain, every, strict=True):
            torch.testing.assert_close(one, other, atol=0, rtol=0)
            torch.testing.assert_close(one, crossing.rays.position[:2], atol=1e-11, rtol=0)


def test_a_beam_that_follows_the_focal_length_is_launched_anew():
    """At a fixed F-number a curvature behind the stop widens the beam in front of it."""
    lens = dataclasses.replace(double_gauss(), aperture=SystemAperture("image_f_number", number(4.0)))
    memo, curvature = Memo(), lens.surfaces[10].curvature.clone().requires_grad_()
    for _ in range(2):
        gradients = [
            torch.autograd.grad(spread(trace_bundle(bundle(with_curvature(lens, 10, curvature)), m)), curvature)[0]
            for m in (memo, None)
        ]
        assert float(gradients[0]) == pytest.approx(float(gradients[1]), rel=1e-13)


def test_transforms_pass_the_memo_by():
    lens, memo = double_gauss(), Memo()
    trace_bundle(bundle(lens), memo)

    def of(curvature, memo):
        return spread(trace_bundle(bundle(with_curvature(lens, 9, curvature)), memo))

    for transform in (torch.func.grad, torch.func.jacfwd):
        one, other = (transform(of)(lens.surfaces[9].curvature, m) for m in (memo, None))
        assert float(one) == float(other) != 0


def test_the_oldest_bundle_is_forgotten_first():
    lens, memo = double_gauss(), Memo(most=2)
    for angle in (1.0, 2.0, 3.0):
        trace_bundle(bundle(lens, angle), memo)
    assert crossed_by(memo, lambda: trace_bundle(bundle(lens, 3.0), memo)) == 0
    assert crossed_by(memo, lambda: trace_bundle(bundle(lens, 1.0), memo)) > 0


def axial_bundle(lens: Lens, distances: torch.Tensor):
    lens = with_object_distance(lens, distances.reshape(-1, 1, 1, 1))
    field = number([[0.0, 0.0], [0.0, 5.0]]).reshape(2, 2, 1, 1)
    return lens, field, lens.wavelengths[:1, None], PUPIL


def test_drawn_object_distances_are_interpolated_to_a_nanometre():
    lens, sensor = double_gauss(), number(57.9).requires_grad_()
    memo, numbers = Memo(object_distances=(1e4, 5e4)), (3, lens.stop, len(lens.surfaces) - 1)
    generator = torch.Generator().manual_seed(4)
    for _ in range(3):
        distances = 1e4 + 4e4 * torch.rand(7, generator=generator, dtype=torch.float64)
        moved = axial_bundle(with_sensor_distance(lens, sensor), distances)
        found, plain = (trace_bundle(moved, m) for m in (memo, None))
        torch.testing.assert_close(found.position, plain.position, atol=1e-9, rtol=0)
        torch.testing.assert_close(found.direction, plain.direction, atol=1e-10, rtol=0)
        torch.testing.assert_close(found.opl, plain.opl, atol=1e-9, rtol=0)
        assert torch.equal(found.valid, plain.valid.expand_as(found.valid))
        points, expected = (points_of_bundle(moved, numbers, m)[0] for m in (memo, None))
        for one, other in zip(points, expected, strict=True):
            torch.testing.assert_close(one, other, atol=1e-9, rtol=0)
        gradients = [torch.autograd.grad(spread(rays), sensor)[0] for rays in (found, plain)]
        assert float(gradients[0]) == pytest.approx(float(gradients[1]), rel=1e-9)
        (gradient,), (other,) = (torch.autograd.grad(at[-1].square().sum(), sensor) for at in (points, expected))
        assert float(gradient) == pytest.approx(float(other), rel=1e-9)
    assert crossed_by(memo, lambda: trace_bundle(moved, memo)) == 1
    assert crossed_by(memo, lambda: points_of_bundle(moved, numbers, memo)) == 1


def test_derivative_in_an_interpolated_object_distance():
    lens, memo = double_gauss(), Memo(object_distances=(1e4, 5e4))
    distances = number([12e3, 31e3]).requires_grad_()
    gradients = [
        torch.autograd.grad(spread(trace_bundle(axial_bundle(lens, distances), m)), distances)[0] for m in (memo, None)
    ]
    torch.testing.assert_close(*gradients, rtol=1e-7, atol=0)


def test_distances_beyond_the_range_or_with_rays_lost_on_the_way_are_traced():
    lens, memo = double_gauss(), Memo(object_distances=(1e4, 5e4))
    near = axial_bundle(lens, number([3e3, 2e4]))
    torch.testing.assert_close(trace_bundle(near, memo).position, trace_bundle(near).position, atol=0, rtol=0)
    clipped = lens.replace(1, apertures=(Aperture("circular", (0.0, 15.65)),))
    bundles = axial_bundle(clipped, number([1.1e4, 2e4, 4.9e4]))
    expected = trace_bundle(bundles)
    rows = expected.valid[:, 0, 0]
    assert not torch.equal(rows[0], rows[2]), "the aperture should stop a ray at one distance and not at the other"
    found = trace_bundle(bundles, memo)
    assert torch.equal(found.valid, expected.valid)
    torch.testing.assert_close(found.position, expected.position, atol=0, rtol=0)


def test_over_a_range_of_distances_failed_rays_change_nothing():
    """Where the stop clips, every object distance has pupil points of its own."""
    lens, distances = double_gauss(), number([1.2e4, 2e4, 4e4])
    clipped = lens.replace(lens.stop, apertures=(Aperture("circular", (0.0, 6.0)),))

    def kernels(memo):
        axis = lens.wavelengths.new_zeros(2, 1)
        return psf(
            clipped, Gaussian(order=4), fields=axis, object_distances=distances, execution=Execution(memo=memo)
        ).kernel

    torch.testing.assert_close(kernels(Memo(object_distances=(1e4, 5e4))), kernels(None))
