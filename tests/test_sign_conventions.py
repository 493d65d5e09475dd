"""Conventions of sign, order and unit, each by the simplest scene that would show it wrong."""

import math

import pytest
import torch
from problems import double_gauss, fields, lens, scalar, surface, vector, vignetting_aperture

import raytrace as rt
from raytrace.materials.glass import MIRROR, refractive_index, sellmeier
from raytrace.system.lens import check, media
from raytrace.system.poses import Pose, direction_out, point_out
from raytrace.system.rays import start
from raytrace.tracing.launch import launch
from raytrace.tracing.paraxial import first_order, paraxial_image_distance
from raytrace.tracing.trace import steps, trace_lens, trace_surfaces

CENTRE = torch.zeros(2, 1, dtype=torch.float64)


def chief(system, **options):
    return trace_lens(system, launch(system, CENTRE, **options), system.wavelengths[:, None]).position[:, :, 0, 0]


def test_positive_field_angle_goes_up_and_images_up_for_infinity():
    """A field of +10° is light that travels towards +y; a lens of positive focal length puts it at +y f tan θ."""
    system = double_gauss()
    rays = launch(system, CENTRE)
    assert (rays.direction[1, 1:] > 0).all()
    height = chief(system)[1]
    assert height[1].item() == pytest.approx(99.51 * math.tan(math.radians(10)), rel=0.03)


def test_positive_object_height_images_inverted():
    system = double_gauss(object_distance=400.0, field=fields("object_height", (0.0, 10.0)))
    assert first_order(system).magnification < 0
    assert chief(system)[1, 1] < 0


def test_field_angles_of_a_finite_object_look_the_same_way():
    """θ is the direction of the chief ray: the object point lies on the other side."""
    system = double_gauss(object_distance=4000.0)
    rays = launch(system, CENTRE)
    assert torch.atan2(rays.direction[1], rays.direction[2]).rad2deg().flatten().tolist() == pytest.approx(
        [0.0, 10.0, 14.0], abs=1e-12
    )


def test_x_fields_are_x():
    system = double_gauss(field=fields("angle", (0.0,), x=(10.0,)))
    hit = chief(system)
    other = chief(double_gauss(field=fields("angle", (10.0,))))
    assert hit[0, 0].item() == pytest.approx(other[1, 0].item(), rel=1e-14)
    assert hit[1, 0] == 0


def test_positive_curvature_has_its_centre_behind_the_surface_and_positive_power_in_glass():
    out = trace_lens(
        lens([surface(0.02, 100.0, 1.5)]),
        start(vector(0.0, 5.0, 0.0)[:, None], vector(0.0, 0.0, 1.0)[:, None]),
        vector(0.55),
    )
    assert out.direction[1] < 0


def test_wavelengths_are_micrometres_and_short_ones_bend_more():
    crown = sellmeier([1.03961212, 0.231792344, 1.01046945], [0.00600069867, 0.0200179144, 103.560653], name="N-BK7")
    blue, red = refractive_index(crown, vector(0.4861327, 0.6562725))
    assert blue.item() == pytest.approx(1.52238, abs=5e-6)
    assert red.item() == pytest.approx(1.51432, abs=5e-6)


def test_stop_and_surface_numbers_are_those_of_the_file():
    system = double_gauss()
    assert system.stop == 6
    assert system.surfaces[system.stop].is_plane
    assert len(system.surfaces) == 13


def test_semi_diameter_alone_never_clips():
    narrow = lens([surface(0.02, 5.0, 1.5, semi_diameter=1.0), surface(None, 50.0, semi_diameter=1.0)])
    assert trace_lens(narrow, launch(narrow, vector(0.0, 1.0).reshape(2, 1)), narrow.wavelengths[0]).valid.all()


def test_vignetted_ray_keeps_its_coordinates_and_a_missed_one_ends():
    system = lens([surface(0.05, 5.0, 1.5, apertures=vignetting_aperture(3.0)), surface(None, 50.0)])
    free = lens([surface(0.05, 5.0, 1.5), surface(None, 50.0)])
    rays = start(
        torch.stack([vector(0, 0), vector(5, 30), vector(0, 0)]),
        torch.stack([vector(0, 0), vector(0, 0), vector(1, 1)]),
    )
    crossings = list(steps(system.surfaces[1:], rays, indices=media(system, system.wavelengths[0])))
    assert crossings[0].clipped.tolist() == [True, False]
    assert crossings[0].missed.tolist() == [False, True]
    last = crossings[-1].rays
    assert not last.valid.any()
    assert torch.equal(last.position[:, 0], trace_lens(free, rays, free.wavelengths[0]).position[:, 0])
    assert last.position[:, 1].tolist() == [0.0, 0.0, 0.0]


def test_thickness_behind_a_mirror_is_negative_and_light_returns():
    system = lens([surface(None, 10.0), surface(-0.01, -50.0, MIRROR)], stop=2)
    out = trace_lens(system, launch(system, vector(0.0, 0.1).reshape(2, 1)), system.wavelengths[0])
    assert out.direction[2] < 0
    assert out.position[2] == 0


@pytest.mark.parametrize(("tilt", "point", "sign"), [("tilt_x", (0.0, 5.0), 1), ("tilt_y", (5.0, 0.0), -1)])
def test_tilts_are_right_handed(tilt, point, sign):
    """About x from y to z, about y from z to x: the side of +x or +y of a plane turns towards +z, or away from it."""
    pose = Pose(**{tilt: scalar(10.0)})
    rays = start(vector(*point, 0.0)[:, None], vector(0.0, 0.0, 1.0)[:, None], vector(0.0))
    out = trace_surfaces([surface(None, 1.0, before=pose)], rays, indices=vector(1.0, 1.0).unbind(), gap=None)
    assert float(out.opl) == pytest.approx(sign * 5 * math.tan(math.radians(10)), rel=1e-14)


def test_a_pose_decentres_and_then_tilts_unless_tilts_are_first():
    """Behind a tilt by 90° about x, y lies along z; axes turn about x, then about the new y and z, or about z, y, x."""
    vertex = [scalar(0.0)] * 3
    for tilts_first, expected in ((False, (0.0, 1.0, 0.0)), (True, (0.0, 0.0, 1.0))):
        pose = Pose(y=scalar(1.0), tilt_x=scalar(90.0), tilts_first=tilts_first)
        assert [float(x) for x in point_out(pose, vertex)] == pytest.approx(expected, abs=1e-15)
    y_axis = [scalar(0.0), scalar(1.0), scalar(0.0)]
    for tilts_first, expected in ((False, (-1.0, 0.0, 0.0)), (True, (0.0, 0.0, 1.0))):
        pose = Pose(tilt_x=scalar(90.0), tilt_z=scalar(90.0), tilts_first=tilts_first)
        found = [float(x) for x in direction_out(pose, y_axis)]
        assert found == pytest.approx(expected, abs=1e-15), tilts_first


def test_a_virtual_object_has_a_negative_distance():
    """1/s′ = 1/f - 1/s of a thin lens, f = 100 mm and s = -100 mm."""
    thin = lens([surface(0.01, 1e-12, 1.5), surface(-0.01, 50.0)])
    assert float(paraxial_image_distance(thin, scalar(-100.0))) == pytest.approx(50.0, rel=1e-12)


def test_axial_colour_of_a_single_positive_lens_is_negative():
    colours = rt.seidel(rt.read_lens("singlet"))
    assert float(colours.contributions[colours.names.index("C1")].sum()) < 0


def test_check_refuses_untraceable_lenses():
    check(double_gauss())
    for broken in (
        double_gauss(stop=0),
        double_gauss(stop=12),
        double_gauss(field=fields("angle", (90.0,))),
        double_gauss(field=fields("object_height", (1.0,))),
        double_gauss(aperture=("object_na", 0.1)),
        double_gauss(wavelengths=(-0.5,)),
    ):
        with pytest.raises(ValueError, match=r"\w"):
            check(broken)
