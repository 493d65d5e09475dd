"""First-order data about the axial chief ray: what is known of them exactly, and by another tracer."""

import math
import re
from pathlib import Path

import bends
import pytest
import torch
from bends import pose, real
from differences import gradcheck

import raytrace as rt
from raytrace.cli import main
from raytrace.tracing import base_ray as base
from raytrace.tracing.paraxial import largest_field
from raytrace.tracing.trace import Bent, at_stop, is_bent


def near(found, expected, tolerance=1e-9):
    return torch.allclose(found, real(expected), rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("distance", [math.inf, 2000.0])
def test_it_is_first_order_where_the_axis_is_straight(distance):
    lens = rt.read_lens("double_gauss").at(object_distance=distance)
    straight, found = rt.first_order(lens), rt.base_ray(lens)
    pairs = {"focal_length": "effective_focal_length", "image_distance": "paraxial_image_distance"}
    same = (
        "back_focal_distance", "entrance_pupil_position", "entrance_pupil_diameter", "exit_pupil_position",
        "exit_pupil_diameter", "paraxial_working_f_number", "magnification",
    )  # fmt: skip
    for name, theirs in (pairs | {name: name for name in same}).items():
        expected = float(getattr(straight, theirs))
        assert near(getattr(found, name), [expected, expected], 1e-12), name
    assert not is_bent(lens)


@pytest.mark.parametrize("degrees", [0.0, 15.0, 45.0, -60.0])
def test_a_tilted_sphere_has_the_foci_of_coddington(degrees):
    """f_t = (R/2) cos θ, f_s = R/(2 cos θ), from the mirror along the ray, the stop there."""
    lens = bends.tilted_mirror(-200.0, degrees, 80.0)
    found, c = rt.base_ray(lens), math.cos(math.radians(degrees))
    assert near(found.focal_length, [100 * c, 100 / c], 1e-12)
    assert near(found.back_focal_distance, [100 * c, 100 / c], 1e-12)
    assert near(found.exit_pupil_position, [-80.0, -80.0], 1e-12)
    assert near(found.way_to_image, 80.0, 1e-12)
    assert near(found.position, [0.0, 0.0, 0.0])
    assert near(found.direction, [0.0, 0.0, -1.0])


def test_a_tilted_mirror_images_an_object_twice():
    """1/s + 1/s′ = 2/(R cos θ) and 2 cos θ/R; the magnifications are -s′/s."""
    s, c = 300.0, math.cos(math.radians(20.0))
    found = rt.base_ray(bends.tilted_mirror(-200.0, 20.0, 80.0, object_distance=s))
    images = [1 / (1 / (100 * c) - 1 / s), 1 / (c / 100 - 1 / s)]
    assert near(found.image_distance, images, 1e-12)
    assert near(found.magnification, [-image / s for image in images], 1e-12)


def test_a_decentred_parabola_is_a_stigmatic_mirror():
    """From a point h off its vertex the focus is f + h²/4f away, and both foci are one."""
    f, h = 100.0, 60.0
    away = rt.system.Surface(thickness=real(0.0), before=pose(y=-h), is_break=True)
    parabola = {"radius": -2 * f, "conic": -1.0, "glass": "MIRROR", "thickness": -f}
    lens = rt.lens([{"thickness": 0.0}, parabola], stop=1, entrance_pupil_diameter=30.0)
    lens = bends.inserted(lens, 1, [away])
    found = rt.base_ray(lens)
    assert near(found.back_focal_distance, [f + h * h / (4 * f)] * 2, 1e-12)
    assert near(found.focal_length, [f + h * h / (4 * f)] * 2, 1e-12)
    assert float(rt.spot(lens).rms_radius.max()) < 1e-12
    found = rt.wavefront(lens, size=21)
    assert float(found.rms.max()) < 1e-9
    assert abs(float(found.strehl.min()) - 1) < 1e-6


def test_a_tilted_plate_is_astigmatic_and_moves_the_ray():
    """It shifts a ray by t sin(θ - θ′)/cos θ′; behind it foci lie w/n and w cos² θ/(n cos² θ′) nearer, w = t/cos θ′."""
    t, n, theta, f = 10.0, 1.5, math.radians(35.0), 100.0
    inside = math.asin(math.sin(theta) / n)
    lens = rt.lens(
        [
            {"thickness": 40.0, "phase": rt.system.IdealLens(1 / f, 1 / f)},
            {"thickness": t, "glass": n, "before": pose(tilt_x=35.0)},
            {"thickness": 0.0, "after": pose(tilt_x=-35.0)},
            {"thickness": 40.0},
        ],
        stop=1,
        entrance_pupil_diameter=5.0,
    )
    found = rt.base_ray(lens)
    way = t / math.cos(inside)
    foci = [f - 40 - way * math.cos(theta) ** 2 / (n * math.cos(inside) ** 2), f - 40 - way / n]
    # They count from the plane of the rear vertex, which lies t cos θ behind the front one and t sin θ off it.
    ahead = way * math.cos(theta - inside) - t * math.cos(theta)
    assert near(found.back_focal_distance, [focus + ahead for focus in foci], 1e-12)
    assert near(found.position[1], t * math.sin(theta) - way * math.sin(theta - inside), 1e-12)


def test_a_grating_is_anamorphic():
    """Along its dispersion a beam is wider by cos θ′/cos θ behind a grating, and a lens behind it so much longer."""
    f, slope = 100.0, 0.3
    lens = rt.lens(
        [
            {"thickness": 0.0, "phase": rt.system.Grating(slope / 0.5, 1.0)},
            {"thickness": 0.0, "after": pose(tilt_x=-math.degrees(math.asin(slope)))},
            {"thickness": f, "phase": rt.system.IdealLens(1 / f, 1 / f)},
        ],
        stop=1,
        entrance_pupil_diameter=5.0,
        wavelengths=[0.5],
    )
    assert near(rt.base_ray(lens).focal_length, [f / math.sqrt(1 - slope**2), f], 1e-12)
    assert near(rt.base_ray(lens).back_focal_distance, [f, f], 1e-9)


def test_a_cylinder_has_one_focal_length():
    lens = rt.lens(
        [{"thickness": 50.0, "phase": rt.system.IdealLens(0.0, 1 / 50)}], stop=1, entrance_pupil_diameter=5.0
    )
    found = rt.base_ray(lens)
    assert near(found.focal_length, [50.0, math.inf])
    assert near(found.back_focal_distance, [50.0, math.inf])
    assert not is_bent(lens)
    assert near(rt.field_curvature(lens, fields=[0.0]).tangential, [[0.0]])


@pytest.mark.parametrize("ray_aiming", ["paraxial", "real"])
def test_rays_are_aimed_where_the_straightened_pupil_is_at_infinity(ray_aiming):
    """A Czerny-Turner spectrometer: rays of all wavelengths and fields fill a circle on the grating."""
    lens = bends.spectrometer(ray_aiming)
    rays = rt.tracing.rays(lens, pupil=rt.maths.hexapolar(6)[0])
    assert bool(rays.valid.all())
    assert bool(rt.trace(lens, rays).valid.all())
    stop, _ = at_stop(lens, rays, rays.wavelength)
    rim = torch.hypot(*stop).amax(-1)
    assert float((rim - rim[0, 0]).abs().max()) < 1e-9
    upper = torch.zeros(2, 1, dtype=torch.float64)
    upper[1] = 1.0
    cone = rt.tracing.rays(lens, pupil=upper, fields=[0.0]).direction[:, 0, 1, 0]
    base = rt.tracing.rays(lens, pupil=0 * upper, fields=[0.0]).direction[:, 0, 1, 0]
    assert float(torch.linalg.vector_norm(torch.linalg.cross(cone, base))) == pytest.approx(0.05, rel=2e-3)
    with pytest.warns(rt.LostRays):
        rt.spot(lens, ray_aiming="off")


def test_the_stop_may_be_behind_a_fold_and_decentred():
    """Aimed rays fill a decentred, tilted stop about its own middle; those that are not go about the axis."""
    lens = bends.folded(rt.read_lens("double_gauss"), 4, tilt_x=2.0).at(ray_aiming="real")
    aside = lens.replace(lens.stop, before=pose(x=0.4, y=-0.7, tilt_y=5.0), after=pose(x=-0.4, y=0.7))
    rays = rt.tracing.rays(aside, pupil=rt.maths.hexapolar(4)[0], fields=[0.0, 7.0])
    stop, _ = at_stop(aside, rays, rays.wavelength)
    assert bool(rays.valid.all())
    rim = torch.hypot(*stop).amax(-1)
    assert float((rim - rim[0, 0]).abs().max()) < 1e-7
    assert float(stop.mean(-1).abs().max()) < 1e-7
    off, _ = at_stop(aside, rt.tracing.rays(aside, fields=[0.0], ray_aiming="off"), rays.wavelength)
    assert near(off.mean(-1)[:, 0, 0], [-0.4, 0.7], 5e-2)


def test_pupil_points_keep_their_side_behind_a_turned_stop():
    """A stop turned by 90° about z, or by a fold, is filled by rays that keep the names they have in front of it."""
    plain = rt.read_lens("double_gauss").at(ray_aiming="real")
    turned = bends.inserted(
        plain, plain.stop - 1, [rt.system.Surface(real(0.0), before=pose(tilt_z=90.0), is_break=True)]
    )
    points = rt.maths.hexapolar(3)[0]
    for lens in (turned, bends.folded(plain, 4, tilt_x=2.0)):
        expected, found = (rt.tracing.rays(one, pupil=points, fields=[0.0, 10.0]) for one in (plain, lens))
        assert float((found.position[:2] - expected.position[:2]).abs().max()) < 1e-6


def test_a_telecentric_relay_has_the_pupils_and_the_magnification_of_first_order_data(capsys):
    """Two ideal lenses of 50 mm, the stop 1.165 µm from their common focus, a tilted image."""
    lens = rt.read_lens(Path(__file__).parent / "cases" / "telecentric.zmx")
    base, straight = rt.base_ray(lens), rt.first_order(lens)
    assert base.magnification.tolist() == pytest.approx([-1, -1], rel=1e-9)
    assert float(straight.magnification) == pytest.approx(-1, rel=1e-9)
    distance = 50 + 50**2 / 0.001165  # of the image of the stop by the second lens
    slope = 0.1 / math.sqrt(1 - 0.1**2)
    for data in (base, straight):
        assert data.entrance_pupil_diameter.flatten().isinf().all()
        assert data.entrance_pupil_position.flatten().isinf().all()
        assert data.exit_pupil_position.flatten().tolist() == pytest.approx(
            data.exit_pupil_position.numel() * [distance - 50], rel=1e-7
        )
        diameters = data.exit_pupil_diameter.flatten()
        assert diameters.tolist() == pytest.approx(len(diameters) * [2 * slope * (distance - 50)], rel=1e-4)
    assert main(["info", str(Path(__file__).parent / "cases" / "telecentric.zmx")]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"telecentric +in object and image space", printed)
    assert re.search(
        r"exit pupil position +telecentric +mm, from the image; 2.146e\+06 mm by first-order data", printed
    )
    assert re.search(r"effective focal length +afocal +mm", printed)
    assert rt.info(lens).document()["afocal"]
    assert not rt.info("double_gauss").document()["afocal"]
    assert rt.info(lens).document()["telecentric"] == ["object", "image"]
    assert rt.info(rt.read_lens("double_gauss")).document()["telecentric"] == []


def test_it_is_differentiated_exactly():
    def figures(radius, tilt, thickness, decentre):
        stand = pose(tilt_x=tilt, y=decentre)
        lens = rt.lens(
            [
                {"thickness": thickness, "glass": 1.5, "radius": radius, "before": stand, "after": pose(tilt_x=-tilt)},
                {"thickness": 20.0, "radius": -70.0},
                {"thickness": 60.0},
            ],
            stop=3,
            entrance_pupil_diameter=8.0,
            object_distance=400.0,
        )
        found = rt.base_ray(lens)
        mm = "focal_length image_distance entrance_pupil_position exit_pupil_position exit_pupil_diameter position"
        return tuple(getattr(found, name) for name in (*mm.split(), "paraxial_working_f_number", "magnification"))

    at = [real(number).requires_grad_() for number in (50.0, 12.0, 6.0, 0.5)]
    assert gradcheck(figures, at, eps=1e-5, atol=1e-5)


def test_info_shows_both_only_where_they_differ():
    assert "base_ray" not in rt.info(rt.read_lens("double_gauss")).document()
    found = rt.info(bends.tilted_mirror(-200.0, 30.0, 80.0))
    assert found.document()["base_ray"]["focal_length"] == pytest.approx([86.6025403784, 115.470053838])
    assert "about the axial chief ray" in str(found)
    assert found.document()["effective_focal_length"] == pytest.approx(100.0)


def test_analyses_about_an_axis_name_the_surface_that_folds_it():
    lens = bends.folded(rt.read_lens("double_gauss"), 10, tilt_x=45.0)
    for refused in (
        rt.seidel, rt.longitudinal_aberration, lambda one: rt.psf(one, "paraxial"), lambda one: rt.psf(one, "fourier"),
        lambda one: rt.compare_models(one),
    ):  # fmt: skip
        with pytest.raises(Bent, match=r"straight axis, .*surface 11 is tilted or decentred; .+"):
            refused(lens)


def test_the_largest_field_of_a_bent_lens_is_one_of_its_own():
    lens = rt.read_lens("double_gauss").at(fields=[(0.0, 5.0), (-8.0, 0.0)])
    assert largest_field(lens)[:, 0].tolist() == [0.0, 8.0]
    assert largest_field(bends.folded(lens, 10, tilt_x=45.0))[:, 0].tolist() == [-8.0, 0.0]


def test_the_entrance_is_traced_to_the_stop_alone():
    """Its matrices are those of the trace to the image, with their derivatives, of perturbed lenses of a batch."""
    lens = rt.read_lens("double_gauss").at(ray_aiming="real")
    tolerances, curvature = rt.tolerances(lens, grade="commercial"), real(0.0).requires_grad_()
    lens = lens.replace(2, curvature=lens.surfaces[2].curvature + curvature)
    built = rt.tolerancing.perturbed(lens, tolerances, rt.tolerancing.draw_errors(tolerances, 3, seed=4))
    front, whole = base._front(built, built.primary), base._near(built, built.primary).front
    for name, part, other in zip(front._fields, front, whole, strict=True):
        torch.testing.assert_close(part, other, rtol=1e-11, atol=1e-13, msg=name)
        if part.requires_grad:
            slope, wanted = (torch.autograd.grad(t.sum(), curvature, retain_graph=True)[0] for t in (part, other))
            torch.testing.assert_close(slope, wanted, rtol=1e-9, atol=1e-9, msg=name)
