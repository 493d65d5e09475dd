"""Poses, coordinate breaks and phases: the laws they keep, and what is known exactly of them."""

import pytest
import torch
from bends import pose, real
from differences import gradcheck, gradgradcheck
from problems import rotation

import raytrace as rt
from raytrace.system.phases import Added
from raytrace.system.poses import Pose, direction_in, direction_out, point_in, point_out
from raytrace.system.rays import start
from raytrace.system.surface import Surface
from raytrace.tracing.refraction import bend_slopes, diffract, reflect, refract
from raytrace.tracing.trace import axial_path, trace_surfaces

SOME = {"x": 1.5, "y": -2.0, "z": 0.25, "tilt_x": 20.0, "tilt_y": -33.0, "tilt_z": 71.0}


@pytest.mark.parametrize("tilts_first", [False, True])
def test_a_pose_is_the_matrices_of_its_definition(tilts_first):
    new = torch.tensor([0.3, -1.2, 2.7], dtype=torch.float64)
    x, y, z = (rotation(axis, SOME[f"tilt_{axis}"]) for axis in "xyz")
    d = torch.tensor([SOME["x"], SOME["y"], SOME["z"]], dtype=torch.float64)
    old = z @ y @ x @ (new + d) if tilts_first else d + x @ y @ z @ new
    inside = torch.stack(list(point_in(pose(**SOME, tilts_first=tilts_first), old.unbind(0))))
    assert (inside - new).abs().max() < 1e-14
    there = pose(**SOME, tilts_first=tilts_first)
    assert (torch.stack(list(point_out(there, inside.unbind(0)))) - old).abs().max() < 1e-14
    way = direction_out(there, direction_in(there, old.unbind(0)))
    assert (torch.stack(list(way)) - old).abs().max() < 1e-14


def test_right_angles_are_exact():
    z_axis = [real(0.0), real(0.0), real(1.0)]
    assert [float(c) for c in direction_in(pose(tilt_x=90.0), z_axis)] == [0.0, 1.0, 0.0]
    assert [float(c) for c in direction_in(pose(tilt_y=180.0), z_axis)] == [0.0, 0.0, -1.0]


def bundle() -> rt.system.Rays:
    generator = torch.Generator().manual_seed(1)
    position = torch.cat([torch.rand(2, 50, generator=generator, dtype=torch.float64) * 4 - 2, torch.zeros(1, 50)])
    slope = torch.rand(2, 50, generator=generator, dtype=torch.float64) * 0.2 - 0.1
    return start(position, torch.cat([slope, torch.ones(1, 50, dtype=torch.float64)]), real(0.0))


def test_breaks_that_undo_each_other_change_nothing():
    ball = Surface(thickness=real(3.0), curvature=real(1 / 30), glass=rt.materials.find_glass("N-BK7"))
    image = Surface(thickness=real(0.0))
    back = {name: -number for name, number in SOME.items()}
    there = Surface(thickness=real(0.0), before=pose(**SOME), is_break=True)
    again = Surface(thickness=real(0.0), before=pose(**back, tilts_first=True), is_break=True)
    n = [real(1.0), real(1.5), real(1.5)]
    plain = trace_surfaces([ball, image], bundle(), indices=n)
    posed = trace_surfaces([ball, there, again, image], bundle(), indices=[n[0], n[1], n[1], n[1], n[1]])
    assert (plain.position - posed.position).abs().max() < 1e-14
    assert (plain.direction - posed.direction).abs().max() < 1e-14
    assert (plain.opl - posed.opl).abs().max() < 1e-14


def test_a_fold_by_breaks_is_a_fold_by_the_surface_tilts():
    mirror = {"glass": rt.materials.MIRROR, "thickness": real(0.0)}
    tilt, image = pose(tilt_x=45.0), Surface(thickness=real(0.0), curvature=real(0.01))
    by_breaks = [
        Surface(thickness=real(10.0)),
        Surface(thickness=real(0.0), before=tilt, is_break=True),
        Surface(**mirror),
        Surface(thickness=real(-20.0), before=tilt, is_break=True),
        image,
    ]
    by_surface = [
        Surface(thickness=real(10.0)),
        Surface(glass=rt.materials.MIRROR, thickness=real(-20.0), before=tilt, after=tilt),
        image,
    ]
    n = real(1.0)
    ends = [trace_surfaces(s, bundle(), indices=[n] * (len(s) + 1)) for s in (by_breaks, by_surface)]
    paths = [end.opl + axial_path(s, [n] * (len(s) + 1)) for end, s in zip(ends, (by_breaks, by_surface), strict=True)]
    assert ends[0].valid.all()
    assert (ends[0].position - ends[1].position).abs().max() < 1e-13
    assert (paths[0] - paths[1]).abs().max() < 1e-13
    plain = trace_surfaces([Surface(thickness=real(30.0)), image], bundle(), indices=[n] * 3)
    assert abs(float(paths[0][0]) - 30) < 0.5
    assert plain.valid.all()


@pytest.mark.parametrize("mirror", [False, True])
def test_a_phase_without_gradient_is_snells_law(mirror):
    d = torch.nn.functional.normalize(torch.tensor([0.2, -0.3, 0.9], dtype=torch.float64), dim=0).unbind(0)
    n = torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64).unbind(0)
    cosine, squared = sum(a * b for a, b in zip(n, d, strict=True)), sum(a * a for a in n)
    zero, n1, n2 = real(0.0), real(1.5), real(1.5 if mirror else 1.0)
    found, passes = diffract(d, n, cosine, squared, n1, n2, Added(zero, zero, zero), mirror=mirror)
    expected = reflect(d, n, cosine, squared) if mirror else refract(d, n, cosine, squared, n1, n2)[0]
    assert bool(passes)
    assert max(abs(float(a - b)) for a, b in zip(found, expected, strict=True)) < 1e-15


def test_the_grating_equation_and_an_evanescent_order():
    axis, normal = (real(0.0), real(0.0), real(1.0)), (real(0.0), real(0.0), real(1.0))
    one = real(1.0)
    found, passes = diffract(axis, normal, one, one, one, one, Added(one, real(0.0), real(0.6)), mirror=False)
    assert bool(passes)
    assert max(abs(float(a) - b) for a, b in zip(found, (0.0, 0.6, 0.8), strict=True)) < 1e-15
    found, passes = diffract(axis, normal, one, one, one, one, Added(one, real(0.0), real(-0.6)), mirror=True)
    assert bool(passes)
    assert max(abs(float(a) - b) for a, b in zip(found, (0.0, -0.6, -0.8), strict=True)) < 1e-15
    _, passes = diffract(axis, normal, one, one, one, one, Added(one, real(0.0), real(1.01)), mirror=False)
    assert not bool(passes)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_ideal_lens_images_points_to_points(sign):
    """1/s′ = 1/s + power on both sides of the plane, whatever the slope, for light either way."""
    power, s, h = real(1 / 50), 80.0, 7.0
    for y in (-30.0, 0.0, 200.0):
        d = torch.nn.functional.normalize(torch.tensor([0.0, y - h, s * sign], dtype=torch.float64), dim=0).unbind(0)
        bent = bend_slopes(d, (real(0.0), real(y), real(0.0)), (power, power), real(1.0), real(1.0))
        image = 1 / (1 / 50 - 1 / s)
        assert abs(y + image * float(bent[1] / bent[2]) * sign + h * image / s) < 1e-11
        assert float(bent[2]) * sign > 0


def test_a_surface_with_a_phase_needs_a_wavelength():
    grating = Surface(thickness=real(0.0), phase=rt.system.Grating(real(0.5), real(1.0)))
    with pytest.raises(ValueError, match="wavelength"):
        trace_surfaces([grating], bundle(), indices=[real(1.0)] * 2)


@pytest.mark.slow
def test_derivatives_by_every_number_of_a_pose_and_a_grating():
    names = list(SOME)
    spot = bundle()

    def trace(frequency, *numbers):
        tilted = Surface(
            thickness=real(5.0),
            curvature=real(1 / 40),
            before=Pose(**dict(zip(names, numbers, strict=True))),
            after=Pose(**dict(zip(names, reversed(numbers), strict=True)), tilts_first=True),
            phase=rt.system.Grating(frequency, real(1.0)),
        )
        end = trace_surfaces(
            [tilted, Surface(thickness=real(0.0))],
            spot,
            indices=[real(1.0), real(1.5), real(1.5)],
            wavelength=real(0.5),
        )
        return end.position[:2], end.direction, end.opl

    start_at = [real(0.02), *(real(0.05 * number).requires_grad_() for number in SOME.values())]
    start_at[0].requires_grad_()
    assert gradcheck(trace, start_at)
    assert gradgradcheck(lambda *n: trace(*n)[0][:, :3], start_at)
