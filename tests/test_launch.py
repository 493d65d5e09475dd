"""Launch: rays of every kind of field and object distance, aimed or not, meet the pupil they were given."""

import dataclasses
import math

import pytest
import torch
from problems import PICOMETRE, double_gauss, fields, fisheye, lens, scalar, surface, vector

import raytrace as rt
from raytrace.maths.numerics import to
from raytrace.maths.sampling import hexapolar
from raytrace.system.lens import media, with_object_distance
from raytrace.system.phases import IdealLens
from raytrace.tracing.launch import (
    MarginalRayLost,
    launch,
    rays_from_infinity,
    rays_from_point,
    rays_of_field,
    stop_radius,
)
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.trace import trace_lens, trace_surfaces

POINTS, _ = hexapolar(2)
CENTRE = torch.zeros(2, 1, dtype=torch.float64)
INF = math.inf


def at_stop(system, rays):
    indices = media(system, system.wavelengths[:, None])[: system.stop + 1]
    return trace_surfaces(system.surfaces[1 : system.stop + 1], rays, indices=indices)


def aiming_error(system, rays, points=POINTS):
    """Largest distance at the stop to where the ray was aimed, in stop radii; rays not found left out."""
    found = at_stop(system, rays).position[:2] / stop_radius(system) - points[:, None, None]
    return torch.where(rays.valid, found, 0.0).abs().max().item()


def relay(back: float, distance: float, **others):
    """A stop `back` behind a lens of f = 10 mm: beyond the focus, its image lies before the object."""
    elements = [surface(0.05, 5.0, 1.5), surface(-0.05, back), surface(None, 80.0)]
    options = {"stop": 3, "object_distance": distance, "aperture": ("float_by_stop", 0.2)}
    return lens(elements, **{**options, "field": fields("object_height", (0.0, 0.1)), **others})


@pytest.mark.parametrize("distance", [INF, 1e12, 1e4, 200.0])
def test_chief_ray_passes_the_centre_of_the_entrance_pupil_and_others_its_parts(distance):
    system = double_gauss(object_distance=distance)
    data = first_order(system)
    rays = launch(system, POINTS)
    x, y, z = rays.position
    t = (data.entrance_pupil_position - z) / rays.direction[2]
    hit = torch.stack([x, y]) + t * rays.direction[:2]
    assert (hit - 0.5 * data.entrance_pupil_diameter * POINTS[:, None, None]).abs().max() <= 1e-11  # mm
    assert (torch.linalg.vector_norm(rays.direction, dim=0) - 1).abs().max() <= 1e-15


@pytest.mark.parametrize("distance", [1e4, 200.0, 30.0])
def test_rays_of_a_finite_object_meet_in_their_object_point(distance):
    system = double_gauss(object_distance=distance, field=fields("object_height", (0.0, -3.0, 20.0)))
    rays = launch(system, POINTS)
    t = (-distance - rays.position[2]) / rays.direction[2]
    hit = rays.position[1] + t * rays.direction[1]
    assert (hit - system.fields.y[:, None, None]).abs().max() <= 1e-12 * distance


def test_path_counts_from_the_object_point():
    """Reduced path: length from the object to the start, less the distance of the object from the vertex."""
    point, aim = vector(1.0, -2.0, -30.0)[:, None], vector(3.0, 4.0, 2.0)[:, None]
    rays = rays_from_point(point, aim, index=scalar(1.5))
    expected = 1.5 * (torch.linalg.vector_norm(aim - point) - torch.linalg.vector_norm(point))
    assert rays.opl.item() == pytest.approx(expected.item(), rel=1e-14)
    far = rays_from_point(1e15 * vector(0.0, 0.3, -1.0)[:, None], aim, index=scalar(1.5))
    plane = rays_from_infinity(vector(0.0, -0.3, 1.0)[:, None], aim, index=scalar(1.5))
    assert far.opl.item() == pytest.approx(plane.opl.item(), rel=1e-13)


def test_object_at_1e12_mm_is_one_at_infinity():
    near, far = double_gauss(object_distance=1e12), double_gauss()
    one, other = (trace_lens(s, launch(s, POINTS), s.wavelengths[:, None]) for s in (near, far))
    assert (one.position - other.position).abs().max() <= 2e-8  # mm: f²/D = 1e-8


@pytest.mark.parametrize("aiming", ["off", "paraxial", "real"])
@pytest.mark.parametrize(
    ("kind", "heights", "distance"),
    [
        ("angle", (0.0, 10.0), INF),
        ("angle", (0.0, 10.0), 300.0),
        ("object_height", (0.0, 20.0), 300.0),
        ("paraxial_image_height", (0.0, 10.0), INF),
        ("paraxial_image_height", (0.0, 10.0), 300.0),
        ("real_image_height", (10.0,), INF),
        ("real_image_height", (0.0, 10.0), 300.0),
    ],
)
def test_every_kind_of_field(kind, heights, distance, aiming):
    system = double_gauss(object_distance=distance, field=fields(kind, heights))
    rays = launch(system, CENTRE, ray_aiming=aiming)
    assert rays.valid.all()
    if kind == "real_image_height":
        hit = trace_lens(system, rays, system.wavelengths[:, None]).position[1].flatten()
        assert hit.tolist() == pytest.approx(list(heights), abs=1e-10)  # mm
    if kind == "angle" and aiming == "off":
        assert torch.atan2(rays.direction[1], rays.direction[2]).rad2deg().flatten().tolist() == pytest.approx(
            list(heights), abs=1e-12
        )
    if kind == "paraxial_image_height" and distance != INF:
        data = first_order(system)
        t = (-distance - rays.position[2]) / rays.direction[2]
        object_height = rays.position[1] + t * rays.direction[1]
        assert (data.magnification * object_height).flatten().tolist() == pytest.approx(list(heights), abs=1e-10)


@pytest.mark.parametrize(("aiming", "angle"), [("off", 20.0), ("paraxial", 20.0), ("real", 75.0)])
def test_real_image_height_finds_the_angle_that_lands_there(aiming, angle):
    """Of a fisheye: chief rays from 75° need to be followed from the axis. Where none comes, rays are lost."""
    system = fisheye(field=fields("angle", (angle,)), ray_aiming=aiming)
    height = trace_lens(system, launch(system, CENTRE), system.wavelengths[:, None]).position[1].item()
    c = system.surfaces[1].curvature.clone().requires_grad_()
    heights = fields("real_image_height", (height, 40 * height), x=(0.0, 0.0))
    system = dataclasses.replace(system.replace(1, curvature=c), fields=heights)
    rays = launch(system, CENTRE)
    assert rays.valid.flatten().tolist() == [True, False]
    assert torch.atan2(rays.direction[1], rays.direction[2])[0].rad2deg().item() == pytest.approx(angle, abs=1e-10)
    assert torch.isfinite(torch.autograd.grad(rays.position.sum() + rays.direction.sum(), c)[0])


@pytest.mark.parametrize("aiming", ["off", "real"])
def test_derivatives_of_real_image_heights(aiming):
    """The angle that lands at a height, by curvature: against differences."""
    base = double_gauss(field=fields("real_image_height", (5.0,), x=(3.0,)), ray_aiming=aiming)

    def direction(x):
        system = base.replace(2, curvature=base.surfaces[2].curvature * x)
        return launch(system, CENTRE).direction[:2].flatten()

    x = scalar(1.0).requires_grad_()
    found = torch.stack([torch.autograd.grad(y, x, retain_graph=True)[0] for y in direction(x)])
    with torch.no_grad():
        near, far = (direction(x + h) - direction(x - h) for h in (1e-3, 2e-3))
    assert (found - (8 * near - far) / 12e-3).abs().max() <= 1e-8 * found.abs().max()


def test_paraxial_image_height_of_infinity_is_that_of_a_small_field():
    system = double_gauss(field=fields("paraxial_image_height", (1e-4,)))
    data = first_order(system)
    focused = system.at(sensor_distance=data.back_focal_distance)
    hit = trace_lens(focused, launch(focused, CENTRE), focused.wavelengths[:, None]).position[1]
    assert hit.item() == pytest.approx(1e-4, rel=1e-8)


@pytest.mark.parametrize("distance", [INF, 300.0])
@pytest.mark.parametrize("aiming", ["paraxial", "real"])
def test_aimed_rays_fill_the_stop_evenly(distance, aiming):
    system = double_gauss(object_distance=distance, ray_aiming=aiming)
    rays = launch(system, POINTS)
    assert rays.valid.all()
    assert aiming_error(system, rays) <= 1e-10  # of the stop radius
    assert aiming_error(system, launch(system, POINTS, ray_aiming="off")) > 1e-3


def test_the_stop_is_as_large_as_the_marginal_ray_that_aims():
    """Paraxially: a real ray through 1e-4 of the pupil, paraxial to 1e-8, tells it."""
    system = double_gauss()
    near, rim = (
        at_stop(system, rays_of_field(system, vector(0.0, 0.0), vector(0.0, p), wavelength=system.wavelengths[0]))
        for p in (1e-4, 1.0)
    )
    paraxial = stop_radius(dataclasses.replace(system, ray_aiming="paraxial"))
    assert paraxial.item() == pytest.approx(1e4 * near.position[1].item(), rel=1e-7)
    for aiming in ("off", "real"):
        real = stop_radius(dataclasses.replace(system, ray_aiming=aiming))
        assert real.item() == pytest.approx(rim.position[1].item(), rel=1e-14)
    assert (real / paraxial - 1).abs() > 1e-3


def test_a_lost_marginal_ray_leaves_the_others_aimed():
    """A ball whose entrance pupil is wider than itself: the rim misses it, what can pass is aimed.

    The stop is behind the ball's focus and so is seen inverted.
    """
    elements = [surface(1 / 5, 10.0, 1.3), surface(-1 / 5, 20.0), surface(None, 5.0)]
    system = lens(elements, stop=3, aperture=("entrance_pupil_diameter", 11.0), field=fields(y=(0.0, 4.0)))
    points = vector(0.0, 0.0, 0.0, 0.0, 0.3, 1.0).reshape(2, 3)
    with pytest.warns(MarginalRayLost, match="paraxial one"):
        rays = launch(system, points, ray_aiming="real")
    same = launch(system, points, ray_aiming="paraxial")
    assert rays.valid[:, 0].tolist() == [[True, True, False], [True, True, False]]
    assert torch.equal(rays.position, same.position)
    reached = at_stop(system, same).position[1] / stop_radius(dataclasses.replace(system, ray_aiming="paraxial"))
    assert torch.where(same.valid, reached + points[1], 0.0).abs().max() <= 1e-10  # of the stop radius


def test_an_unknown_kind_of_aiming_is_refused():
    with pytest.raises(ValueError, match=r"'on': expected .*auto, off, paraxial, real"):
        launch(double_gauss(), CENTRE, ray_aiming="on")


def test_the_axial_chief_ray_can_be_aimed():
    system = double_gauss(field=fields("angle", (0.0,)))
    assert launch(system, CENTRE, ray_aiming="real").valid.all()


@pytest.mark.parametrize("angle", [0.0, 60.0, 75.0])
def test_wide_angles_are_aimed(angle):
    system = fisheye(field=fields("angle", (angle,)))
    points = hexapolar(1)[0]
    rays = launch(system, points, ray_aiming="real")
    assert rays.valid.all()
    assert aiming_error(system, rays, points) <= 1e-10  # of the stop radius


def test_rays_that_no_aim_brings_to_the_stop_are_lost_and_others_are_not():
    system = fisheye(field=fields("angle", (30.0, 89.0)))
    c = system.surfaces[1].curvature.clone().requires_grad_()
    rays = launch(system.replace(1, curvature=c), CENTRE, ray_aiming="real")
    assert rays.valid.flatten().tolist() == [True, False]
    assert torch.isfinite(rays.position).all()
    assert torch.isfinite(torch.autograd.grad(rays.position.sum() + rays.direction.sum() + rays.opl.sum(), c)[0])


@pytest.mark.parametrize("aiming", ["off", "paraxial", "real"])
@pytest.mark.parametrize(("back", "distance"), [(2.0, 30.0), (30.0, 30.0), (60.0, 10.0)])
def test_light_travels_forward_wherever_the_entrance_pupil_lies(back, distance, aiming):
    """Before the lens, behind it, or on the far side of the object; aimed and paraxial rays agree to first order."""
    system = relay(back, distance)
    data = first_order(system)
    rays = launch(system, POINTS, ray_aiming=aiming)
    assert rays.valid.all()
    assert (rays.direction[2] > 0).all()
    other = launch(system, POINTS, ray_aiming="off")
    assert (rays.direction - other.direction).abs().max() <= 0.02, data.entrance_pupil_position


def test_entrance_pupil_before_the_object_path_is_that_of_the_object():
    """Rays of one object point: the same path at the object, wherever they start."""
    system = relay(60.0, 10.0)
    rays = launch(system, POINTS)
    t = (-10.0 - rays.position[2]) / rays.direction[2]
    at_object = rays.opl + t
    assert (at_object - at_object[..., :1]).abs().max() <= 1e-12  # mm
    assert at_object[0, 0, 0].item() == pytest.approx(-10.0, abs=1e-12)


def test_entrance_pupil_almost_at_infinity():
    """A stop in the rear focus: telecentric by position. Chief rays are parallel to the axis to rounding."""
    focus = first_order(lens([surface(0.05, 5.0, 1.5), surface(-0.05, 10.0)])).back_focal_distance
    system = relay(focus, 20.0)
    rays = launch(system, POINTS)
    assert rays.valid.all()
    assert (rays.direction[:2, :, 0, 0]).abs().max() <= 1e-12
    t = (-20.0 - rays.position[2]) / rays.direction[2]
    assert (rays.position[1] + t * rays.direction[1] - system.fields.y[:, None, None]).abs().max() <= 1e-12
    marginal = at_stop(system, rays).position[:2] + 0.2 * POINTS[:, None, None]
    assert marginal.abs().max() <= 0.02  # mm of 0.2: its aberration


def test_virtual_object():
    """Light converging to a point 60 mm behind surface 1 travels forward, towards the point."""
    system = lens([surface(0.01, 5.0, 1.5), surface(None, 30.0)], object_distance=-60.0)
    rays = launch(system, POINTS)
    assert (rays.direction[2] > 0).all()
    t = (60.0 - rays.position[2]) / rays.direction[2]
    hit = rays.position[:2] + t * rays.direction[:2]
    assert hit.abs().max() <= 1e-12
    out = trace_lens(system, rays, system.wavelengths[:, None])
    crossing = -out.position[1] * out.direction[2] / out.direction[1]
    image = first_order(system).paraxial_image_distance - 30.0
    assert torch.nanmean(crossing[..., 1:]).item() == pytest.approx(image.item(), rel=0.05)


def test_telecentric_object_space():
    field = fields("object_height", (0.0, 1.0), telecentric=True)
    system = relay(10.0, 20.0, aperture=("object_na", 0.05), field=field)
    rays = launch(system, POINTS)
    assert (rays.direction[:2, :, 0, 0] == 0).all()  # chief rays parallel to the axis
    edge = POINTS.norm(dim=0) > 0.99
    sine = torch.linalg.vector_norm(rays.direction[:2], dim=0)[..., edge]
    assert (sine - 0.05).abs().max() <= 2e-5  # equal tangents, not sines, off the axis of the cone's own field point
    assert (sine[0] - 0.05).abs().max() <= 1e-15


def test_batches_broadcast_and_equal_single_rays():
    system = double_gauss(wavelengths=(0.45, 0.53, 0.65))
    whole = launch(system, POINTS)
    assert whole.shape == (3, 3, 19)
    one = rays_of_field(system, vector(0.0, 14.0), POINTS[:, 5], wavelength=system.wavelengths[1])
    assert torch.equal(one.position, whole.position[:, 2, 1, 5])
    assert torch.equal(one.direction, whole.direction[:, 2, 1, 5])


@pytest.mark.parametrize("kind", ["object_height", "real_image_height"])
def test_object_distances_in_a_batch_are_aimed_as_alone(kind):
    """Two distances (D, 1, 1, 1) before fields, wavelengths and pupil points whose own axes are fewer."""
    base = double_gauss(field=fields(kind, (0.0, 9.0)), wavelengths=(0.45, 0.53, 0.65), ray_aiming="real")
    distances = vector(300.0, 500.0)
    field = torch.stack([base.fields.x, base.fields.y])[:, :, None, None]
    both = with_object_distance(base, distances[:, None, None, None])
    rays = rays_of_field(both, field, POINTS, wavelength=base.wavelengths[:, None])
    assert rays.valid.all()
    for k, distance in enumerate(distances):
        alone = launch(with_object_distance(base, distance), POINTS)
        assert (rays.position[:, k] - alone.position).abs().max() <= 1e-12  # mm


def test_aiming_does_not_depend_on_neighbours():
    system = double_gauss()
    whole = launch(system, POINTS, ray_aiming="real")
    alone = launch(system, POINTS[:, 7:8], fields=vector(0.0, 14.0)[:, None], ray_aiming="real")
    assert torch.equal(alone.position[:, 0, 0, 0], whole.position[:, 2, 0, 7])


@pytest.mark.parametrize("name", ["curvature", "thickness", "object distance", "aperture", "field"])
@pytest.mark.parametrize("aiming", ["off", "paraxial", "real"])
def test_derivatives_of_launched_rays(name, aiming):
    """Image points by curvature, thickness, object distance, aperture and field, aiming included: first order."""
    base = double_gauss(object_distance=400.0, aperture=("entrance_pupil_diameter", 15.0))
    points = vector(0.0, 0.0, 0.3, 0.9).reshape(2, 2).T.contiguous()

    def image(x):
        system = base
        if name in ("curvature", "thickness"):
            system = base.replace(2, **{name: getattr(base.surfaces[2], name) * x})
        elif name == "object distance":
            system = with_object_distance(base, 400.0 * x)
        elif name == "aperture":
            system = dataclasses.replace(base, aperture=dataclasses.replace(base.aperture, value=15.0 * x))
        field = torch.stack([scalar(0.0), 8.0 * (x if name == "field" else scalar(1.0))])[:, None]
        rays = launch(system, points, fields=field, ray_aiming=aiming)
        return trace_lens(system, rays, system.wavelengths[:, None]).position[:2].flatten()

    x = scalar(1.0).requires_grad_()
    found = torch.stack([torch.autograd.grad(y, x, retain_graph=True)[0] for y in image(x)])
    step = 1e-3
    with torch.no_grad():
        near, far = image(x + step) - image(x - step), image(x + 2 * step) - image(x - 2 * step)
    difference = (8 * near - far) / (12 * step)
    assert (found - difference).abs().max() <= 1e-6 * difference.abs().max() + 1e-8


def test_float32():
    system = to(double_gauss(), dtype=torch.float32)
    for aiming in ("off", "paraxial", "real"):
        rays = launch(system, POINTS.float(), ray_aiming=aiming)
        assert rays.position.dtype == torch.float32
        assert rays.valid.all()


def test_a_tilted_object_is_that_of_its_points():
    """Ideal lens, f = 50 mm, m = -1/2: a point of the object at height y, tilted by θ, lies at y cos θ and y sin θ.

    Its image is at 1/s' = 1/f - 1/s; a uniform pupil of radius a has the blur a |1 - d/s'|/√2. The images of all points
    lie on a plane that is tilted by atan(m tan θ) (Scheimpflug).
    """
    ideal = IdealLens(scalar(1 / 50), scalar(1 / 50))
    rows = [dict(phase=ideal, thickness=75)]
    system = rt.lens(rows, stop=1, entrance_pupil_diameter=10, object_distance=150, fields=[-10, 0, 10])
    tilted = system.replace(0, tilt_x=30)
    spots = rt.spot(tilted)
    for k, y in enumerate((-10, 0, 10)):
        s = 150 - y * math.sin(math.radians(30))
        image = 1 / (1 / 50 - 1 / s)
        assert spots.rms_radius[k, 0].item() == pytest.approx(
            5 * abs(1 - 75 / image) / math.sqrt(2), rel=1e-12, abs=1e-15
        )
        centroid = -y * math.cos(math.radians(30)) * 75 / s
        assert spots.centroid[1, k, 0].item() == pytest.approx(centroid, rel=1e-12, abs=1e-15)
    beta = math.degrees(math.atan(-0.5 * math.tan(math.radians(30))))
    assert rt.spot(tilted.replace(2, tilt_x=beta)).rms_radius.max() < 1 * PICOMETRE


@pytest.mark.parametrize("ray_aiming", ["off", "real"])
def test_every_field_of_a_tilted_object_is_a_point_of_an_untilted_one(ray_aiming):
    """Also in the optimiser, and of a batch of tilts."""
    rows = [dict(radius=60, thickness=5, glass="N-BK7"), dict(radius=-60, thickness=90)]
    system = rt.lens(rows, stop=1, object_distance=150, fields=[10], ray_aiming=ray_aiming, float_by_stop=5)
    tilted = system.replace(0, tilt_x=30)
    y, z = 10 * math.cos(math.radians(30)), 10 * math.sin(math.radians(30))
    spots, shape = rt.spot(tilted), rt.spot(system.at(object_distance=150 - z, fields=[y]))
    assert spots.rms_radius.item() == pytest.approx(shape.rms_radius.item(), rel=1e-9)
    assert spots.centroid[1].item() == pytest.approx(shape.centroid[1].item(), rel=1e-9)
    merit = rt.Merit([rt.system.Row("RSCE", (8, 1), (0, 1.0), weight=1)])
    assert rt.evaluate(tilted, merit=merit).values.item() == pytest.approx(spots.rms_radius.item(), rel=1e-5)
    batch = rt.spot(system.replace(0, tilt_x=vector(0.0, 30.0))).rms_radius.flatten().tolist()
    assert batch == pytest.approx([rt.spot(lens).rms_radius.item() for lens in (system, tilted)], rel=1e-12)


def test_chief_rays_of_a_tilted_object_in_telecentric_object_space_are_parallel_to_the_axis():
    """Equal cones of every point, also where the object is nearer."""
    system = relay(10.0, 30.0, aperture=("object_na", 0.1), field=fields("object_height", [0.0, 2.0], telecentric=True))
    tilted = system.replace(0, tilt_x=40)
    rays = launch(tilted, torch.tensor([[0.0, 0.0], [0.0, 1.0]], dtype=torch.float64))
    assert torch.equal(rays.direction[:2, ..., 0], torch.zeros_like(rays.direction[:2, ..., 0]))
    assert rays.direction[1, ..., 1].flatten().tolist() == pytest.approx([0.1, 0.1], rel=1e-12)
    assert rays.position[1, 1, 0, 0].item() == pytest.approx(2 * math.cos(math.radians(40)), rel=1e-15)


def test_spots_by_the_tilt_of_the_object_have_both_derivatives():
    rows = [dict(radius=60, thickness=5, glass="N-BK7"), dict(radius=-60, thickness=90)]
    system = rt.lens(rows, stop=1, entrance_pupil_diameter=10, object_distance=150, fields=[-10, 7])

    def size(tilt):
        return rt.spot(system.replace(0, tilt_x=tilt)).rms_radius.sum()

    assert torch.autograd.gradcheck(size, scalar(30.0).requires_grad_())
    assert torch.autograd.gradgradcheck(size, scalar(30.0).requires_grad_())
