"""Footprint and vignetting: circles that overlap, a beam on a tilted plane, and other functions of the package."""

import json
import math

import pytest
import torch
from problems import scalar

import raytrace as rt
from raytrace.cli import main
from raytrace.system.lens import Lens
from raytrace.tracing.geometry import clear_semi_diameters

RADIUS, DISTANCE = 5.0, 20.0


def circle(radius: float, **how) -> tuple[rt.system.Aperture]:
    return (rt.system.Aperture("circular", (0.0, radius), **how),)


def two_planes(*others: dict, radius=RADIUS, distance=DISTANCE) -> Lens:
    """A stop at surface 1 and a rim of the same radius behind it, in air."""
    rows = [dict(thickness=distance, apertures=circle(radius)), dict(thickness=50, apertures=circle(radius)), *others]
    return rt.lens(rows, stop=1, entrance_pupil_diameter=2 * RADIUS, fields=[0, 10, 20], wavelengths=[0.55])


def overlap(s: torch.Tensor) -> torch.Tensor:
    """Share of a circle of RADIUS that lies in another of the same radius, their centres s apart."""
    area = 2 * RADIUS**2 * torch.acos(s / (2 * RADIUS)) - s / 2 * torch.sqrt(4 * RADIUS**2 - s**2)
    return area / (math.pi * RADIUS**2)


def shifts(degrees: torch.Tensor, distance=DISTANCE) -> torch.Tensor:
    return distance * torch.tan(torch.deg2rad(degrees))


# -- vignetting --------------------------------------------------------------------------------------------------------


def test_two_apertures_pass_the_area_in_which_they_overlap():
    found = rt.vignetting(two_planes(), samples=5)
    assert torch.allclose(found.passed, overlap(shifts(found.fields[1])), rtol=0, atol=1e-11)
    assert (found.surfaces, found.reasons) == ((2,), ("vignetted",))


def test_shares_have_the_derivative_of_the_overlap():
    distance = scalar(DISTANCE).requires_grad_()
    (got,) = torch.autograd.grad(rt.vignetting(two_planes(distance=distance), fields=[10]).passed.sum(), distance)
    again = scalar(DISTANCE).requires_grad_()
    (expected,) = torch.autograd.grad(overlap(shifts(scalar(10.0), again)), again)
    assert float(got) == pytest.approx(float(expected), rel=1e-7)


def test_light_is_counted_at_the_first_surface_that_cuts_it():
    """A third rim as far again cuts what the second one has passed."""
    rows = [dict(thickness=DISTANCE, apertures=circle(RADIUS))] * 3
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=2 * RADIUS, fields=[0, 10], wavelengths=[0.55])
    found = rt.vignetting(lens, fields=[0, 4, 10])
    s = shifts(found.fields[1])
    assert torch.allclose(found.cut[:, 0], 1 - overlap(s), atol=1e-11)
    assert torch.allclose(found.cut[:, 1], overlap(s) - overlap(2 * s), atol=1e-11)  # circles in a row: the outer two
    total = found.passed + found.cut.sum(-1) + found.of_factors + found.unaimed
    assert torch.allclose(total, torch.ones_like(total), atol=1e-14)


def test_an_obscuration_cuts_its_share():
    rows = [dict(thickness=10, apertures=circle(2.0, obscures=True)), dict(thickness=50)]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=2 * RADIUS, fields=[0, 1], wavelengths=[0.55])
    assert rt.vignetting(lens).passed.tolist() == pytest.approx([1 - 4 / 25] * 11, abs=1e-11)


def test_rays_that_miss_a_surface_are_cut_by_it():
    """A hemisphere of radius 4 meets the rays within it alone."""
    rows = [dict(thickness=10), dict(radius=4.0, thickness=20, glass=1.5)]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=2 * RADIUS, fields=[0], wavelengths=[0.55])
    found = rt.vignetting(lens, fields=[0])
    assert (found.surfaces, found.reasons) == ((2,), ("miss",))
    assert float(found.passed) == pytest.approx(16 / 25, abs=1e-5)
    assert "missed" in str(found)


@pytest.mark.filterwarnings("ignore")
def test_vignetting_factors_are_a_share_and_rims_show_what_cuts():
    lens = rt.read_lens("double_gauss_28deg").at(wavelengths=[0.5461])
    factors, rims = (rt.vignetting(lens, fields=[0, 10, 14], rims=rims) for rims in (False, True))
    assert factors.of_factors.tolist() == pytest.approx([0, 0.1, 0.2], abs=1e-9)
    assert not factors.surfaces
    assert "--" not in str(factors)
    assert "rims" in str(factors)
    assert float(rims.passed[-1]) == pytest.approx(0.838, abs=1e-3)
    assert {1, 7} <= {*rims.surfaces}
    assert torch.allclose(rims.passed + rims.cut.sum(-1), torch.ones(3, dtype=torch.float64), atol=1e-12)


@pytest.mark.filterwarnings("ignore")
def test_counted_rays_agree_with_areas():
    """With ray aiming and rims, rays are counted: a lens whose aimed rays are those without aiming."""
    lens = two_planes()
    areas, counted = (rt.vignetting(lens.at(ray_aiming=aim), fields=[5, 10], rims=True) for aim in ("off", "real"))
    assert counted.sampled
    assert not areas.sampled
    assert torch.allclose(areas.passed, counted.passed, atol=1e-2)


# -- footprint ---------------------------------------------------------------------------------------------------------


def test_a_beam_in_air_is_its_stop_moved():
    beams = rt.footprint(two_planes(), 2)
    s = shifts(beams.fields[1, 0])
    low, high = beams.low[:, 0, :, 0], beams.high[:, 0, :, 0]
    assert torch.allclose(low[1], s - RADIUS, atol=1e-7)
    assert torch.allclose(high[1], s + RADIUS, atol=1e-7)
    assert torch.allclose(high[0], torch.full_like(s, RADIUS), atol=1e-7)
    assert torch.allclose(beams.reach[0, :, 0], s + RADIUS, atol=1e-7)
    assert torch.allclose(beams.centroid[1, 0, :, 0], s, atol=1e-10)
    for share in (beams.passed, beams.passed_by_lens):
        assert torch.allclose(share[0, :, 0], overlap(s), atol=1e-11)


def test_clipped_beams_are_those_that_reach_the_sensor():
    """On the stop, the lens that both circles have in common."""
    beams = rt.footprint(two_planes(), 1, fields=[10], clipped=True)
    s = float(shifts(beams.fields[1, 0]))
    assert float(beams.high[1]) == pytest.approx(RADIUS - s, abs=1e-2)
    assert float(beams.high[0]) == pytest.approx(math.sqrt(RADIUS**2 - s**2 / 4), abs=1e-2)
    assert float(beams.centroid[1]) == pytest.approx(-s / 2, abs=1e-10)
    assert float(beams.passed) == pytest.approx(1, abs=1e-12)


def test_extents_have_derivatives():
    distance = scalar(DISTANCE).requires_grad_()
    beams = rt.footprint(two_planes(distance=distance), 2, fields=[10])
    (got,) = torch.autograd.grad(beams.high[1].sum(), distance)
    assert float(got) == pytest.approx(math.tan(math.radians(10)), rel=1e-6)


def test_a_beam_on_a_mirror_at_45_degrees_is_an_ellipse():
    half = rt.system.Pose(tilt_x=scalar(45.0))
    rows = [dict(thickness=30, apertures=()), dict(thickness=-40, glass="MIRROR")]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=2 * RADIUS, wavelengths=[0.55]).replace(
        2, before=half, after=half
    )
    beams = rt.footprint(lens, 2)
    assert float(beams.high[1]) == pytest.approx(RADIUS * math.sqrt(2), abs=1e-6)
    assert float(beams.high[0]) == pytest.approx(RADIUS, abs=1e-6)


@pytest.mark.filterwarnings("ignore")  # of the stop
@pytest.mark.parametrize("name", ["double_gauss", "tessar", "telephoto"])
def test_the_farthest_ray_of_all_beams_is_the_automatic_semi_diameter(name):
    """Which four rays of each beam give: of a beam whose rim is farther from the axis aside, a little less."""
    lens = rt.read_lens(name).with_semi_diameters(fixed=())
    for surface in (1, 4, len(lens.surfaces) - 2):
        beams = rt.footprint(lens, surface)
        expected = clear_semi_diameters(lens, [surface])[surface]
        assert float(beams.reach.max()) == pytest.approx(float(expected), rel=1e-2 if name == "tessar" else 1e-6)
        assert float(beams.reach.max()) > (1 - 1e-9) * float(expected)


def test_configurations_are_listed_one_after_the_other(tmp_path):
    lens = two_planes().with_configurations(thickness={1: [20.0, 40.0]})
    beams = rt.footprint(lens, 2, fields=[10], configuration="all")
    s = shifts(scalar(10.0), torch.tensor([20.0, 40.0], dtype=torch.float64))
    assert torch.allclose(beams.high[1, :, 0, 0], s + RADIUS, atol=1e-7)
    assert beams.to_frame().configuration.tolist() == [1, 2]
    second = rt.footprint(lens, 2, fields=[10], configuration=2)
    assert torch.allclose(second.high[:, 0], beams.high[:, 1], atol=1e-12)
    beams.plot(tmp_path / "beams.png")


def test_where_no_ray_arrives_it_is_refused():
    lens = two_planes()
    with pytest.raises(rt.OutOfReach, match="no ray of field 0 degrees"):
        rt.footprint(lens.replace(1, apertures=circle(RADIUS, centre=(40.0, 0.0))), 2)
    with pytest.raises(ValueError, match="surface 9 does not exist; expected a surface that light meets, from 1 to 3"):
        rt.footprint(lens, 9)


@pytest.mark.filterwarnings("ignore")
def test_commands_print_and_draw(capsys, tmp_path):
    arguments = ["footprint", "double_gauss_28deg", "8", "--rims", "--field", "0", "14", "--wavelength", "0.55"]
    assert main([*arguments, "--json", "--plot", str(tmp_path / "beams.png")]) == 0
    rows = json.loads(capsys.readouterr().out)["results"]
    assert [row["field_y"] for row in rows] == [0, 14]
    assert rows[1]["passed_by_lens_percent"] < 85
    assert main(["vignetting", "hubble", "--samples", "2", "--plot", str(tmp_path / "vignetting.png")]) == 0
    assert "surface 1" in capsys.readouterr().out
