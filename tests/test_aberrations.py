"""Longitudinal aberration, grid distortion and angles of incidence: exact problems, laws, and limits."""

import json
import math

import pytest
import torch
from differences import gradcheck
from problems import MICROMETRE, NANOMETRE, double_gauss, fields, lens, scalar, surface, vector

import raytrace as rt
from raytrace import chromatic_focal_shift, distortion, distortion_grid, incidence, longitudinal_aberration
from raytrace.cli import main
from raytrace.materials.glass import MIRROR
from raytrace.system.lens import with_object_distance
from raytrace.system.surface import Aperture
from raytrace.tracing.paraxial import first_order, paraxial_image_distance

INF = math.inf
SPHERE = lens([surface(None, 300.0), surface(-0.01, -50.0, MIRROR)], aperture=("entrance_pupil_diameter", 80.0))


def test_rays_of_a_spherical_mirror_cross_the_axis_at_half_the_secant():
    """A ray at height h of a mirror of radius R crosses R - R/(2 cos i) behind its vertex, sin i = h/R."""
    found = longitudinal_aberration(SPHERE, points=9)
    height = 40.0 * found.pupil
    exact = -(100.0 - 50.0 / torch.sqrt(1 - (height / 100.0) ** 2)) + 50.0
    torch.testing.assert_close(found.crossing[0], exact, rtol=0, atol=2 * NANOMETRE)
    assert bool(found.valid.all())


@pytest.mark.parametrize("distance", [INF, 1000.0])
def test_the_first_crossing_is_the_paraxial_focus_of_each_wavelength(distance):
    system = with_object_distance(double_gauss(wavelengths=(0.53, 0.48)), distance)
    found = longitudinal_aberration(system, points=3)
    focus = paraxial_image_distance(system, scalar(distance), system.wavelengths) - system.surfaces[-2].thickness
    torch.testing.assert_close(found.crossing[:, 0], focus, rtol=0, atol=2 * NANOMETRE)


def test_rays_that_do_not_cross_the_axis_are_reported():
    """Lost on the way, or parallel to the axis."""
    stopped = SPHERE.replace(2, apertures=(Aperture("circular", (0.0, 20.0)),))
    assert longitudinal_aberration(stopped, points=5).valid[0].tolist() == [True, True, True, False, False]
    assert math.isnan(longitudinal_aberration(stopped, points=5).to_frame()["crossing"].iloc[-1])
    assert not bool(longitudinal_aberration(lens([surface(None, 10.0)]), points=3).valid.any())


def test_a_pinhole_distorts_nothing_and_a_sphere_about_it_does_as_the_sine():
    """Without a lens the image is the object's; the chief rays of a concentric sphere image h = R sin θ on its rim."""
    pinhole = lens([surface(None, 50.0)], field=fields("angle", (30.0,)))
    found = distortion_grid(pinhole, points=5)
    assert found.distortion.abs().max().item() < 1e-12
    corner = 50.0 * math.tan(math.radians(30.0)) / math.sqrt(2)
    torch.testing.assert_close(found.ideal[:, 0, -1, -1], vector(corner, corner), rtol=1e-12, atol=0)
    torch.testing.assert_close(found.actual, found.ideal, rtol=0, atol=NANOMETRE)


@pytest.mark.parametrize("distance", [INF, 500.0])
def test_the_corner_of_the_grid_is_the_end_of_the_distortion_curve(distance):
    """Of a round lens, distortion depends on the distance from the axis alone."""
    field = fields("angle", (0.0, 14.0)) if distance == INF else fields("object_height", (0.0, 60.0))
    system = with_object_distance(double_gauss(field=field), distance)
    end = distortion(system, samples=2).f_tan[-1, 0]
    found = distortion_grid(system, points=7)
    for corner in (found.distortion[0, 0, 0], found.distortion[0, -1, 0], found.distortion[0, -1, -1]):
        assert corner.item() == pytest.approx(end.item(), abs=2e-8)
    assert found.distortion[0, 3, 3].item() == 0.0
    assert abs(found.largest().item()) >= abs(end.item()) * (1 - 1e-6)


def test_angles_of_a_plane_and_of_a_sphere_about_the_stop():
    """On a plane the chief ray has the field's angle, behind it Snell's; a concentric sphere it meets at 0."""
    plane = surface(None, 5.0, 1.5)
    ball = surface(-1 / 5.0, 20.0)  # its centre is the stop, on the plane
    system = lens([plane, ball], field=fields("angle", (20.0,)), aperture=("entrance_pupil_diameter", 1e-3))
    found = incidence(system, fields=vector(0.0, 20.0)[:, None])
    chief = found.angle[0, 0, 1]
    behind = math.degrees(math.asin(math.sin(math.radians(20.0)) / 1.5))
    assert chief.tolist() == pytest.approx([20.0, 0.0, behind], abs=1e-9)
    mirrored = incidence(system, fields=vector(0.0, -20.0)[:, None]).angle
    torch.testing.assert_close(mirrored[0, 0, 1], chief, rtol=0, atol=1e-9)  # outwards is outwards


def test_marginal_angles_of_small_beams_are_the_paraxial_ones_and_skew_fields_turn_with_the_lens():
    system = double_gauss(aperture=("entrance_pupil_diameter", 1e-3), field=fields("angle", (10.0,)))
    found = incidence(system, fields=vector(0.0, 0.0)[:, None]).angle[0, 0, 2, -1]
    slope = -0.5 / float(first_order(system).paraxial_working_f_number)
    assert found.item() == pytest.approx(math.degrees(math.atan(slope)), rel=1e-6)
    slope = math.tan(math.radians(10.0))
    turned = torch.rad2deg(torch.atan(vector(0.6 * slope, 0.8 * slope)))[:, None]
    straight = incidence(system, fields=vector(0.0, 10.0)[:, None])
    skew = incidence(system, fields=turned)
    torch.testing.assert_close(skew.angle, straight.angle, rtol=0, atol=1e-9)
    torch.testing.assert_close(skew.height, straight.height, rtol=0, atol=NANOMETRE)


def test_curvatures_carry_derivatives():
    def angles(curvature):
        system = lens(
            [surface(None, 4.0), surface(curvature, 5.0, 1.5), surface(-0.01, 90.0)], field=fields("angle", (9.0,))
        )
        crossing = longitudinal_aberration(system, points=3).crossing
        return crossing, incidence(system, samples=2).angle[1], distortion_grid(system, points=3).distortion

    assert gradcheck(angles, (scalar(0.02).requires_grad_(),), atol=1e-6)


def test_a_micrometre_of_the_sensor_moves_every_crossing_by_one():
    system = double_gauss()
    moved = system.at(sensor_distance=system.surfaces[-2].thickness + MICROMETRE)
    here, there = (longitudinal_aberration(s, points=5).crossing for s in (system, moved))
    torch.testing.assert_close(there, here - MICROMETRE, rtol=0, atol=NANOMETRE * 1e-3)


def test_a_diffractive_lens_shifts_its_focus_against_the_wavelength():
    """f = f0 λ0/λ of a flat diffractive lens, and the same lens in air has no other colour."""
    plane = dict(thickness=100.0, phase=rt.system.RadialPhase([-math.pi * 25 / (0.55e-3 * 100)], 5.0, 1.0))
    system = rt.lens([plane], stop=1, entrance_pupil_diameter=10, wavelengths=[0.55, 0.5, 0.6])
    found = chromatic_focal_shift(system, samples=11)
    expected = 100 * (0.55 / found.wavelength - 1)
    torch.testing.assert_close(found.shift, expected, rtol=0, atol=1e-9)
    assert float(found.depth_of_focus) == pytest.approx(0.55e-3 / 2 / math.sin(math.atan(0.05)) ** 2)


def test_the_focal_shift_is_that_of_the_paraxial_image():
    system = double_gauss()
    found = chromatic_focal_shift(system, wavelengths=[0.45, 0.65], samples=3)
    foci = rt.first_order(system, found.wavelength).paraxial_image_distance
    torch.testing.assert_close(found.shift, foci - foci[0], rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="single one"):
        chromatic_focal_shift(system, wavelengths=[0.5])


COMMANDS = {
    "seidel": (["--kind", "waves", "--field", "10", "14"], "W040"),
    "longitudinal-aberration": (["--points", "5"], "crossing"),
    "chromatic-focal-shift": (["--samples", "21"], "shift"),
    "distortion-grid": (["--points", "3", "--exaggerate", "5"], "largest"),
    "incidence": (["--samples", "3", "--surfaces"], "chief"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_print_a_table_strict_json_and_a_figure(command, capsys, tmp_path):
    options, word = COMMANDS[command]
    arguments = [command, "cooke_triplet", *options]
    assert main([*arguments, "--plot", str(tmp_path / "figure.png"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out, parse_constant=lambda text: pytest.fail(text))
    assert document["analysis"] == command
    assert len(document["results"]) >= 9
    assert (tmp_path / "figure.png").stat().st_size > 10_000
    assert main(arguments) == 0
    assert word in capsys.readouterr().out
