"""Unbuildable geometry: surfaces that end within their aperture, negative spaces, crossing surfaces, thin edges."""

import dataclasses
import math

import pytest
from problems import fields, lens, scalar, surface

import raytrace as rt
from raytrace.cli import main
from raytrace.materials.glass import MIRROR, model_glass
from raytrace.system.optimization_data import OptimizationData
from raytrace.system.poses import Pose
from raytrace.system.surface import Surface
from raytrace.tracing.geometry import Unbuildable, defects
from raytrace.tracing.lens_report import Info

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
