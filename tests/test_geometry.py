"""Unbuildable geometry: surfaces that end within their aperture, negative spaces, crossing surfaces, thin edges."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from problems import fields, lens, scalar, surface

import raytrace as rt
from raytrace.cli import main
from raytrace.imaging.variables import limits_of, violation
from raytrace.materials.glass import MIRROR, model_glass
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.operands.boundaries import AT_RIM
from raytrace.optimization.variables import DesignVariables
from raytrace.system.apertures import Aperture
from raytrace.system.optimization_data import OptimizationData, Row
from raytrace.system.poses import Pose
from raytrace.system.surface import Surface
from raytrace.tracing.geometry import (
    Unbuildable,
    clear_semi_diameters,
    defects,
    fixed_semi_diameters,
    rims,
    semi_diameters,
)
from raytrace.tracing.launch import launch
from raytrace.tracing.lens_report import Info
from raytrace.tracing.trace import lens_steps, without_apertures

GLASS = model_glass(1.6, 50.0)


def system(*surfaces, sizes=10.0, **options):
    """An f/many lens of surfaces whose semi-diameters are given."""
    made = lens(
        [*surfaces], aperture=("entrance_pupil_diameter", 4.0), field=fields("angle", (0.0,), (0.0,)), **options
    )
    inside = [dataclasses.replace(one, semi_diameter=sizes) for one in made.surfaces[1:-1]]
    return dataclasses.replace(made, surfaces=(made.surfaces[0], *inside, made.surfaces[-1]))


def plate(thickness):
    return surface(0.0, thickness, GLASS)


CASES = {
    "reach": (
        lambda: system(plate(5.0), surface(-0.1016, 20.0)),
        (2, "reach", 10 - 1 / 0.1016),
        "surface 2 does not reach its semi-diameter of 10 mm: it closes at 9.84252 mm",
    ),
    "reach of a conic": (
        lambda: system(plate(5.0), surface(-0.06, 20.0, conic=3.0)),
        (2, "reach", 10 - 1 / 0.12),
        "it closes at 8.33333 mm",
    ),
    "reach along x": (
        lambda: system(plate(5.0), surface(-0.01, 20.0, coefficients=[-0.125, 0.0], kind="biconic")),
        (2, "reach", 2.0),
        "surface 2 does not reach",
    ),
    "gap": (lambda: system(plate(5.0), surface(-0.01, -0.5), plate(2.0), surface(0, 9)), (2, "gap", -0.5), "negative"),
    "gap over the stop": (
        lambda: system(plate(5.0), surface(0.0, 1.0), surface(0.0, -3.0), plate(2.0), surface(0.0, 9.0)),
        (2, "gap", -2.0),
        "the air between surfaces 2 and 4 is -2 mm thick",
    ),
    "crossing": (
        lambda: system(surface(0.05, 4.0, GLASS), surface(-0.05, 20.0)),
        (1, "crossing", 4.0 - 2 * (20 - math.sqrt(300))),
        "surfaces 1 and 2 cross 8.75",
    ),
    "crossing behind a mirror": (
        lambda: system(surface(-0.005, -40.0, MIRROR), surface(-0.05, -4.0, GLASS), surface(0.05, -20.0)),
        (2, "crossing", 4.0 - 2 * (20 - math.sqrt(300))),
        "surfaces 2 and 3 cross 8.75",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_unbuildable_geometry_is_reported_with_figures(case):
    made, (number, kind, amount), words = CASES[case]
    found = defects(made())[0]
    assert (found.surface, found.kind) == (number, kind)
    assert found.amount == pytest.approx(amount, rel=1e-9)
    assert words in str(found)


GOOD = {
    "a plate": lambda: system(plate(5.0), surface(-0.03, 20.0)),
    "a paraboloid reaches any height": lambda: system(surface(-0.2, -30.0, MIRROR, conic=-1.0)),
    "a stop in front of a surface that it follows": lambda: system(
        surface(0.0, 3.0), surface(0.0, -3.0), plate(5.0), surface(-0.01, 20.0)
    ),
    "light that goes back": lambda: system(surface(-0.005, -40.0, MIRROR), surface(0.005, 60.0, MIRROR)),
    "beyond a break": lambda: system(
        plate(5.0),
        surface(0.0, 3.0),
        Surface(scalar(-9.0), before=Pose(tilt_x=scalar(90.0)), is_break=True),
        plate(2.0),
    ),
}


@pytest.mark.parametrize("case", GOOD)
def test_buildable_geometry_is_not_warned_of(case):
    assert defects(GOOD[case]()) == ()


def sphere(c, h):
    return c * h * h / (1 + math.sqrt(1 - c * c * h * h))


def test_edges_are_at_the_common_rim_for_checks_boundaries_and_training():
    """Two elements of clear heights 10 and 8, 6 and 7 mm: glass is edged at 10 and 7 mm, the air between at 7 mm."""
    made = lens(
        [surface(0.02, 3.0, GLASS), surface(-0.03, 1.5), surface(0.04, 2.0, GLASS), surface(-0.01, 40.0)],
        aperture=("entrance_pupil_diameter", 4.0),
        field=fields("angle", (0.0,), (0.0,)),
    )
    sizes = (None, 10.0, 8.0, 6.0, 7.0, None)
    pairs = zip(made.surfaces, sizes, strict=True)
    parts = tuple(dataclasses.replace(one, semi_diameter=size) for one, size in pairs)
    made = dataclasses.replace(made, surfaces=parts)
    first = 3.0 + sphere(-0.03, 10.0) - sphere(0.02, 10.0)
    air = 1.5 + sphere(0.04, 7.0) - sphere(-0.03, 7.0)
    second = 2.0 + sphere(-0.01, 7.0) - sphere(0.04, 7.0)
    heights = np.array([0.0 if size is None else size for size in sizes])
    ends = np.array([1, 2, 3, 4, 5, 5])
    assert rims(heights, ends, np.array([False, True, False, True, False, False]))[1:4].tolist() == [10.0, 7.0, 7.0]
    # Boundaries of a default merit function, of one surface each.
    rows = [Row(name, (k, k), AT_RIM, target=1.0, weight=1.0) for name, k in (("MNEG", 1), ("MNEA", 2), ("MNEG", 3))]
    values = Evaluation(DesignVariables(made), rows)(np.zeros(0)).values
    assert values == pytest.approx([min(1.0, edge) for edge in (first, air, second)], rel=1e-12)
    own = Evaluation(DesignVariables(made), [Row("ETVA", (1, 0)), Row("ETVA", (1, 0), AT_RIM)])(np.zeros(0)).values
    assert own == pytest.approx([3.0 + sphere(-0.03, 8.0) - sphere(0.02, 10.0), first], rel=1e-12)
    # The check: glass that is thick where light passes, and crosses at its rim.
    assert 3.0 + sphere(-0.03, 8.0) - sphere(0.02, 10.0) > 1 > 0.5 > first
    thin = made.replace(1, thickness=3.0 - first - 0.01)
    (defect,) = defects(thin)
    assert (defect.surface, defect.kind) == (1, "edge")
    assert defect.amount == pytest.approx(-0.01, abs=1e-9)
    # Training: the square of the shortfall, and its derivatives.
    limits = limits_of(made, glass=(0.0, math.inf), air=(0.0, math.inf), edge=first + 0.1)
    short = [max(first + 0.1 - edge, 0.0) for edge in (first, second)]
    assert float(violation(made, limits)) == pytest.approx(sum(one**2 for one in short) + min(air, 0.0) ** 2, rel=1e-9)


def test_training_has_the_derivatives_of_an_edge():
    def shortfall(curvature, thickness):
        made = lens(
            [surface(0.02, 3.0, GLASS), surface(-0.03, 40.0)],
            aperture=("entrance_pupil_diameter", 4.0),
            field=fields("angle", (0.0,), (0.0,)),
        )
        front = dataclasses.replace(made.surfaces[1], curvature=curvature, thickness=thickness, semi_diameter=10.0)
        back = dataclasses.replace(made.surfaces[2], semi_diameter=8.0)
        made = dataclasses.replace(made, surfaces=(made.surfaces[0], front, back, made.surfaces[3]))
        return violation(made, limits_of(made, glass=(0.0, 9.0), edge=2.0))

    numbers = tuple(scalar(n).requires_grad_() for n in (0.02, 3.0))
    assert torch.autograd.gradcheck(shortfall, numbers)
    assert torch.autograd.gradgradcheck(shortfall, numbers)


def test_an_edge_that_is_asked_for_is_that_of_the_rim():
    """The edge of the result is measured on the lens, at the larger height of both faces that its light reaches."""
    triplet = rt.read_lens("cooke_triplet")
    merit = rt.optimization.DefaultMerit("spot", edge=1.0)
    found = rt.optimize(triplet, merit=merit, vary="curvature thickness:1,3,6 sensor", hold="efl=100", cycles=25)
    (edge,) = (one for one in found.conditions if one.name.startswith("MNEG"))
    sizes = semi_diameters(found.lens)
    edges = []
    for k in (1, 3, 6):
        c, d = (float(found.lens.surfaces[j].curvature) for j in (k, k + 1))
        height = max(sizes[k], sizes[k + 1])
        edges.append(float(found.lens.surfaces[k].thickness) + sphere(d, height) - sphere(c, height))
    assert edge.reached == pytest.approx(min(edges), rel=1e-6)
    assert min(edges) >= 0.999


def test_semi_diameters_that_follow_the_light_are_those_of_the_light():
    """A stored one of 10 mm is out of date where it is automatic and the beam is 4 mm wide."""
    steep = CASES["reach"][0]()
    assert defects(dataclasses.replace(steep, optimization_data=OptimizationData(semi_diameters=(1, 2))))
    assert not defects(dataclasses.replace(steep, optimization_data=OptimizationData()))


def test_shipped_lenses_can_be_made():
    flawed = {one: [str(d) for d in defects(rt.read_lens(one))] for one in ("double_gauss", "cooke_triplet", "phone")}
    assert flawed == {"double_gauss": [], "cooke_triplet": [], "phone": []}


@pytest.mark.parametrize("command", ["info", "layout", "check", "optimize"])
def test_commands_warn_with_one_wording(command, tmp_path, capsys):
    path = tmp_path / "steep.zmx"
    rt.write_lens(CASES["reach"][0](), path)
    more = {
        "layout": ["--plot", str(tmp_path / "steep.png")],
        "optimize": ["--merit", "spot", "--vary", "sensor", "--cycles", "1"],
    }
    assert main([command, str(path), *more.get(command, [])]) == 0
    output = capsys.readouterr()
    words = "warning: surface 2 does not reach its semi-diameter of 10 mm: it closes at 9.84252 mm"
    assert words in (output.out if command == "check" else output.err)


def test_python_warns_too():
    with pytest.warns(Unbuildable, match="negative"):
        rt.info(CASES["gap"][0]())
    assert Info(CASES["reach"][0]()).document()["geometry"][0]["kind"] == "reach"


# -- semi-diameters ----------------------------------------------------------------------------------------------------


def tilted_beams(thickness=5.0, **options):
    """A plate of index 1.5 behind the stop on its front face, 5 mm high, and the image 20 mm behind it."""
    rows = [{"thickness": thickness, "glass": 1.5}, {"thickness": 20.0}]
    return rt.lens(rows, stop=1, fields=[0, 10], entrance_pupil_diameter=10.0, **options)


def heights_behind(thickness):
    """5 + t tan θ′ on the back of the plate, and 20 tan θ more on the image."""
    slope = math.tan(math.asin(math.sin(math.radians(10)) / 1.5))
    return [5.0, 5 + thickness * slope, 5 + thickness * slope + 20 * math.tan(math.radians(10))]


def test_automatic_semi_diameters_are_those_of_a_closed_form_with_their_derivative():
    assert semi_diameters(tilted_beams())[1:] == pytest.approx(heights_behind(5.0), rel=1e-13)
    thickness = torch.tensor(5.0, dtype=torch.float64, requires_grad=True)
    sizes = clear_semi_diameters(tilted_beams().replace(1, thickness=thickness), [1, 2, 3])
    (slope,) = torch.autograd.grad(sizes[2], thickness)
    above, below = (clear_semi_diameters(tilted_beams(t), [2])[2] for t in (5 + 1e-4, 5 - 1e-4))
    assert float(slope) == pytest.approx(float(above - below) / 2e-4, rel=1e-8)
    assert float(slope) == pytest.approx(math.tan(math.asin(math.sin(math.radians(10)) / 1.5)), rel=1e-13)


@pytest.mark.parametrize("name", ["tessar", "cooke_triplet", "retrofocus", "petzval", "hubble"])
def test_automatic_semi_diameters_hold_the_rays_of_the_whole_rim(name):
    """To 1e-4, of 720 rays for each field and wavelength; those of the four ends are up to 5 % smaller."""
    lens = dataclasses.replace(rt.read_lens(name), optimization_data=OptimizationData())
    angles = torch.arange(720, dtype=torch.float64) * (math.pi / 360)
    whole = without_apertures(lens)
    rays = launch(whole, torch.stack([angles.sin(), angles.cos()]), wavelengths=lens.wavelengths)
    crossings = lens_steps(whole, rays, lens.wavelengths[:, None])
    for size, crossing in zip(semi_diameters(lens)[1:], crossings, strict=True):
        x, y, _ = crossing.rays.position
        highest = float(torch.where(crossing.rays.valid, torch.hypot(x, y), 0.0).max())
        assert size == pytest.approx(highest, rel=1e-4)


def test_an_automatic_semi_diameter_is_the_largest_of_all_configurations():
    zoom = tilted_beams().with_configurations(thickness={1: [5.0, 8.0]})
    assert semi_diameters(zoom)[1:] == pytest.approx(heights_behind(8.0), rel=1e-13)
    stored = dataclasses.replace(
        zoom.replace(2, semi_diameter=6.0), optimization_data=OptimizationData()
    )  # a file's automatic one is of its configuration
    assert semi_diameters(stored)[2] == pytest.approx(heights_behind(5.0)[1], rel=1e-13)


def test_no_aperture_limits_an_automatic_semi_diameter():
    clipped = tilted_beams().replace(1, apertures=(Aperture("circular", (0.0, 2.0)),))
    assert semi_diameters(clipped)[1:] == pytest.approx(heights_behind(5.0), rel=1e-13)


def test_margins_and_fixed_semi_diameters():
    lens = tilted_beams().with_semi_diameters(margin=(10.0, 0.5))
    stop, back, image = heights_behind(5.0)
    assert semi_diameters(lens)[1:] == pytest.approx([stop, 1.1 * back + 0.5, image], rel=1e-13)
    assert [s.semi_diameter for s in lens.surfaces[1:]] == semi_diameters(lens)[1:]
    thick = lens.replace(1, thickness=8.0)
    assert semi_diameters(thick)[2] == pytest.approx(1.1 * heights_behind(8.0)[1] + 0.5, rel=1e-13)
    assert semi_diameters(lens.with_semi_diameters(fixed=[2]).replace(1, thickness=8.0))[2] == semi_diameters(lens)[2]
    assert semi_diameters(lens.with_semi_diameters(fixed=[2]).with_semi_diameters(fixed=())) == pytest.approx(
        semi_diameters(lens), nan_ok=True
    )
    with pytest.raises(ValueError, match="fixed semi-diameters of surfaces"):
        lens.with_semi_diameters(fixed=[9])
    with pytest.raises(ValueError, match="per cent and mm"):
        lens.with_semi_diameters(margin=(-1.0, 0.0))


@pytest.mark.parametrize("name", ["plate.zmx", "plate.csv", "plate.seq"])
def test_files_hold_automatic_and_fixed_semi_diameters(name, tmp_path):
    lens = tilted_beams().replace(2, semi_diameter=7.0)
    for design in (lens, lens.with_semi_diameters(margin=(10.0, 0.5)), lens.with_semi_diameters(fixed=[])):
        rt.write_lens(design, tmp_path / name)
        again = rt.read_lens(tmp_path / name)
        assert semi_diameters(again) == pytest.approx(semi_diameters(design), rel=1e-14, nan_ok=True)
        assert fixed_semi_diameters(again) == fixed_semi_diameters(design)
        thick = [semi_diameters(each.replace(1, thickness=8.0)) for each in (again, design)]
        assert thick[0] == pytest.approx(thick[1], rel=1e-14, nan_ok=True)


def test_a_lens_without_semi_diameters_writes_and_prints_those_of_its_rays(tmp_path):
    rt.write_lens(tilted_beams(), tmp_path / "plate.zmx")
    lines = [line.split() for line in (tmp_path / "plate.zmx").read_text().splitlines() if "DIAM" in line]
    assert [float(words[1]) for words in lines[1:]] == pytest.approx(heights_behind(5.0), rel=1e-13)
    assert [words[2] for words in lines] == ["0"] * 4
    document = Info(tilted_beams()).document()["surfaces"]
    assert [row["semi_diameter"] for row in document[1:]] == pytest.approx(heights_behind(5.0), rel=1e-13)
    assert f"{heights_behind(5.0)[1]:.5g}" in str(tilted_beams())


def test_a_zoom_lens_writes_the_largest_of_all_configurations(tmp_path):
    zoom = tilted_beams().with_configurations(thickness={1: [5.0, 8.0]})
    rt.write_lens(zoom, tmp_path / "zoom.zmx")
    again = rt.read_lens(tmp_path / "zoom.zmx")
    assert (tmp_path / "zoom.zmx").read_text().count(" 3 0 0 1 ") == 3  # the code of the largest of all
    assert semi_diameters(again)[1:] == pytest.approx(heights_behind(8.0), rel=1e-13)
    assert semi_diameters(again.configuration(2)) == pytest.approx(semi_diameters(again), nan_ok=True)
