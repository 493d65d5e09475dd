"""Focus: the closed form is the minimum found by moving the sensor and retracing, and its derivatives are exact."""

import dataclasses
import math

import pytest
import torch
from problems import double_gauss, lens, scalar, surface, vector

from raytrace.materials.glass import MIRROR
from raytrace.maths.sampling import gauss_rings
from raytrace.system.lens import with_object_distance, with_sensor_distance
from raytrace.system.surface import Aperture
from raytrace.tracing.focus import (
    focus_moments,
    focus_of_mean_radius,
    focus_of_rms,
    mean_rms_radius,
    spot_parabola,
    through_focus,
)
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.spot import EmptySpot, image_rays, spot_of

POINTS, WEIGHTS = gauss_rings(6)
AXIS = torch.zeros(2, 1, dtype=torch.float64)


def rms(system, **options):
    """Mean square radius over fields and wavelengths of the unchanged lens, retraced."""
    return spot_of(image_rays(system, POINTS, **options), WEIGHTS).mean_square_radius


def test_double_gauss_at_25_metres_as_published():
    system = double_gauss(object_distance=25000.0)
    found = focus_of_rms(system, POINTS, WEIGHTS, fields=AXIS)
    assert found.item() == pytest.approx(57.66201, abs=6e-6)  # mm: half of the last digit printed
    best = rms(with_sensor_distance(system, found), fields=AXIS).sqrt()
    paraxial = rms(with_sensor_distance(system, 57.8817685209), fields=AXIS).sqrt()
    assert best.item() == pytest.approx(7.075e-3, abs=0.6e-6)  # mm
    assert paraxial.item() == pytest.approx(27.16e-3, abs=6e-6)  # mm


@pytest.mark.parametrize("distance", [math.inf, 25000.0, 500.0])
def test_closed_form_is_the_minimum_of_the_retraced_radius(distance):
    system = double_gauss(object_distance=distance)
    found = focus_of_rms(system, POINTS, WEIGHTS)
    mean = [rms(with_sensor_distance(system, found + step)).sum().item() for step in (-0.01, 0.0, 0.01)]
    vertex = 0.01 * 0.5 * (mean[0] - mean[2]) / (mean[0] - 2 * mean[1] + mean[2])
    # The parabola is exact; the vertex of three points has the rounding of the mean squares over their differences.
    assert abs(vertex) <= 1e-9  # mm


@pytest.mark.parametrize("glass", [1.0, 1.5])
@pytest.mark.parametrize("curvature", [None, 0.0])
def test_sensor_in_glass_is_focused_by_the_rays_in_the_glass(glass, curvature):
    """A sensor cemented to its cover glass: the file's image surface is followed by air, which must not matter."""
    system = lens(
        [surface(0.02, 5.0, 1.6), surface(-0.02, 30.0), surface(curvature, 12.0, glass)],
        aperture=("entrance_pupil_diameter", 15.0),
    )
    found = focus_of_rms(system, POINTS, WEIGHTS)
    mean = [rms(with_sensor_distance(system, found + step)).sum().item() for step in (-0.01, 0.0, 0.01)]
    assert abs(0.01 * 0.5 * (mean[0] - mean[2]) / (mean[0] - 2 * mean[1] + mean[2])) <= 1e-9  # mm


def test_behind_an_odd_number_of_mirrors():
    """Sensor distances are negative there, and so is the one found."""
    mirror = lens([surface(-0.01, -49.0, MIRROR)], aperture=("entrance_pupil_diameter", 5.0))
    found = focus_of_rms(mirror, POINTS, WEIGHTS, fields=AXIS)
    assert found.item() == pytest.approx(-50.0, abs=0.02)
    mean = [rms(with_sensor_distance(mirror, found + step), fields=AXIS).sum().item() for step in (-0.01, 0.0, 0.01)]
    assert abs(0.01 * 0.5 * (mean[0] - mean[2]) / (mean[0] - 2 * mean[1] + mean[2])) <= 1e-9  # mm


def test_several_distances_fields_and_weights():
    system = double_gauss()
    weights = {"distance_weights": [1.0, 3.0], "field_weights": vector(2.0, 0.0, 1.0)}
    found = focus_of_rms(system, POINTS, WEIGHTS, object_distances=[math.inf, 25000.0], **weights)

    def merit(s):
        total = 0.0
        for distance, w in ((math.inf, 1.0), (25000.0, 3.0)):
            mean_square = rms(with_sensor_distance(with_object_distance(system, distance), s))
            total = total + w * (mean_square * weights["field_weights"][:, None]).sum()
        return total.item()

    mean = [merit(found + step) for step in (-0.01, 0.0, 0.01)]
    assert abs(0.01 * 0.5 * (mean[0] - mean[2]) / (mean[0] - 2 * mean[1] + mean[2])) <= 1e-9  # mm


def test_result_does_not_depend_on_where_the_sensor_stood():
    system = double_gauss()
    found = [focus_of_rms(with_sensor_distance(system, s), POINTS, WEIGHTS).item() for s in (1.0, 58.5, 90.0)]
    assert max(found) - min(found) <= 1e-11  # mm


def test_through_focus_is_the_parabola_of_the_moments():
    rays = image_rays(double_gauss(), POINTS)
    cov, var = focus_moments(rays, WEIGHTS)
    shifts = torch.linspace(-1, 1, 9, dtype=torch.float64)
    spots = through_focus(rays, shifts, WEIGHTS)
    here = spot_of(rays, WEIGHTS).mean_square_radius
    expected = here + 2 * shifts[:, None, None] * cov + shifts[:, None, None] ** 2 * var
    assert torch.allclose(spots.mean_square_radius, expected, rtol=1e-10, atol=1e-16)


def test_perfect_lens_focuses_in_its_focus():
    hyperbolic = lens(
        [surface(None, 10.0, 1.5), surface(-1 / 25, 47.0, conic=-2.25)], aperture=("entrance_pupil_diameter", 30.0)
    )
    found = focus_of_rms(hyperbolic, POINTS, WEIGHTS)
    assert found.item() == pytest.approx(50.0, abs=1e-12)


@pytest.mark.parametrize("number", [1, 3, 11])
def test_derivative_by_curvature_is_that_of_differences(number):
    system = double_gauss(object_distance=25000.0)

    def sensor(c):
        changed = dataclasses.replace(system.surfaces[number], curvature=c)
        surfaces = (*system.surfaces[:number], changed, *system.surfaces[number + 1 :])
        return focus_of_rms(dataclasses.replace(system, surfaces=surfaces), POINTS, WEIGHTS)

    c = system.surfaces[number].curvature.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(sensor(c), c)
    step = 1e-6
    difference = (8 * (sensor(c + step) - sensor(c - step)) - (sensor(c + 2 * step) - sensor(c - 2 * step))) / (
        12 * step
    )
    assert gradient.item() == pytest.approx(difference.item(), rel=1e-7)


def test_derivative_by_object_distance_tends_to_newtons():
    """ds/dD = -(f/x)² for a small pupil."""
    system = double_gauss(aperture=("entrance_pupil_diameter", 0.1))
    D = scalar(5000.0).requires_grad_()
    found = focus_of_rms(with_object_distance(system, D), POINTS, WEIGHTS, fields=AXIS)
    data = first_order(with_object_distance(system, 5000.0))
    assert torch.autograd.grad(found, D)[0].item() == pytest.approx(-(data.magnification**2).item(), rel=1e-5)


def test_all_rays_lost_is_no_focus_and_no_derivative_by_the_lens():
    blind = lens([surface(0.1, 5.0, 1.5), surface(-0.01, 40.0)], aperture=("entrance_pupil_diameter", 1000.0))
    points = torch.tensor([[0.9, -0.9], [0.0, 0.0]], dtype=torch.float64)
    c = blind.surfaces[1].curvature.clone().requires_grad_()
    surfaces = (blind.surfaces[0], dataclasses.replace(blind.surfaces[1], curvature=c), *blind.surfaces[2:])
    found = focus_of_rms(dataclasses.replace(blind, surfaces=surfaces), points, torch.ones(2, dtype=torch.float64))
    assert found.isnan()
    assert torch.autograd.grad(found, c)[0].item() == 0.0


def test_the_parabola_of_a_spot_is_its_mean_square_radius_through_focus():
    """On sensors moved by s, traced anew: Q0 + 2 s Q1 + s² Q2."""
    system = double_gauss()
    constant, linear, square = spot_parabola(image_rays(system, POINTS), WEIGHTS)
    for shift in (-0.3, 0.0, 0.5):
        traced = rms(with_sensor_distance(system, system.surfaces[-2].thickness + shift))
        torch.testing.assert_close(constant + 2 * shift * linear + shift**2 * square, traced, rtol=1e-11, atol=0)


LOST = vector(0.0, 85.0).reshape(2, 1)  # degrees: no ray of the double Gauss arrives


def test_focus_leaves_a_field_without_rays_out_or_refuses_it():
    system = double_gauss(object_distance=25000.0)
    both = torch.cat([AXIS, LOST], 1)
    found = focus_of_rms(system, POINTS, WEIGHTS, fields=both)
    assert found.item() == focus_of_rms(system, POINTS, WEIGHTS, fields=AXIS).item()
    with pytest.raises(EmptySpot, match="no ray reaches 1 of 2 spots"):
        focus_of_rms(system, POINTS, WEIGHTS, fields=both, empty="error")


def test_no_ray_or_one_ray_has_no_focus_and_no_derivative():
    system = double_gauss()
    system = with_sensor_distance(system, system.surfaces[-2].thickness.clone().requires_grad_())
    for points, fields in ((POINTS, LOST), (POINTS[:, :1], AXIS)):
        weights = torch.ones_like(points[0])
        found = focus_of_rms(system, points, weights, fields=fields)
        assert found.isnan()
        assert torch.autograd.grad(found, system.surfaces[-2].thickness)[0] == 0
        with pytest.raises(EmptySpot):
            focus_of_rms(system, points, weights, fields=fields, empty="error")
        with pytest.raises(EmptySpot):
            focus_of_mean_radius(system, points, weights, fields=fields)


def test_moments_and_parabola_of_a_lost_spot_are_nan():
    rays = image_rays(double_gauss(), POINTS, fields=LOST)
    assert all(t.isnan().all() for t in (*focus_moments(rays, WEIGHTS), *spot_parabola(rays, WEIGHTS)))
    assert mean_rms_radius(double_gauss(), POINTS, WEIGHTS, fields=LOST).isnan()


def test_focus_minimises_the_mean_rms_radius():
    system, distances = double_gauss(), [10000.0, 50000.0]
    best = focus_of_rms(system, POINTS, WEIGHTS, fields=AXIS, object_distances=distances)
    radii = [
        mean_rms_radius(moved, POINTS, WEIGHTS, fields=AXIS, object_distances=distances)
        for moved in (with_sensor_distance(system, best + step) for step in (-0.01, 0.0, 0.01))
    ]
    assert radii[1] < min(radii[0], radii[2])
    single = [rms(with_sensor_distance(with_object_distance(system, d), best), fields=AXIS).item() for d in distances]
    assert radii[1].item() == pytest.approx(math.sqrt(sum(single) / 2), rel=1e-12)


@pytest.mark.parametrize("half", [math.inf, 0.05])
def test_focus_of_mean_radius_is_the_least_mean_distance_retraced(half):
    """Also where the rim of the sensor clips the blur: rays that reached it stay, wherever the sensor goes."""
    system = double_gauss(object_distance=25000.0)
    found = focus_of_mean_radius(system, POINTS, WEIGHTS, fields=AXIS)
    clip = () if math.isinf(half) else (Aperture("rectangular", (half, half)),)
    surfaces = (*system.surfaces[:-1], dataclasses.replace(system.surfaces[-1], apertures=clip))
    clipped = with_sensor_distance(dataclasses.replace(system, surfaces=surfaces), found + 1e-3)
    assert focus_of_mean_radius(clipped, POINTS, WEIGHTS, fields=AXIS).item() == pytest.approx(found.item(), abs=1e-8)

    def mean(sensor):
        rays = image_rays(with_sensor_distance(system, sensor), POINTS, fields=AXIS)
        return (WEIGHTS * torch.hypot(*rays.position[:2])).sum().item()

    here = mean(found)
    assert here < min(mean(found - 1e-3), mean(found + 1e-3))
