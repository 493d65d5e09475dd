"""Lenses that take test plates and parts of stock: exact cases, brute force, and what is respected."""

import itertools
import json
import math
import warnings

import numpy as np
import pytest

import raytrace as rt
from raytrace.cli import main
from raytrace.optimization.conditions import conditions_in_unit, specified
from raytrace.optimization.fitting import Design
from raytrace.optimization.plate_fit import PlateFit
from raytrace.optimization.problem import Problem
from raytrace.optimization.stock_fit import StockFit
from raytrace.optimization.variables import bounds_of, design_variables
from raytrace.stock.plates import TestPlate, read_plates

COLOURS = [0.5875618, 0.4861, 0.6563]
MERIT = rt.optimization.DefaultMerit("spot", rings=2, arms=4)
DOUBLET = {"merit": MERIT, "vary": "curvature sensor", "bounds": "sensor:95..97"}


def doublet() -> rt.Lens:
    rows = [
        dict(radius=61, thickness=6, glass="N-BK7"),
        dict(radius=-45, thickness=2.5, glass="N-SF5"),
        dict(radius=-130, thickness=96),
    ]
    return rt.lens(rows, stop=1, entrance_pupil_diameter=20, fields=[0, 1], wavelengths=COLOURS)


def two_singlets() -> rt.Lens:
    """A relay 1 : 1."""
    rows = [
        dict(radius=200, thickness=4, glass="N-BK7"),
        dict(radius=-35, thickness=10),
        dict(radius=35, thickness=4, glass="N-BK7"),
        dict(radius=-200, thickness=60),
    ]
    return rt.lens(rows, stop=2, object_distance=60, object_na=0.08, fields=[0, 3])


SINGLETS = {
    "merit": MERIT, "vary": "curvature thickness:2 sensor", "hold": "magnification=-1", "bounds": "thickness_2:2..60",
}  # fmt: skip


@pytest.fixture(scope="module")
def designed():
    """The doublet at a minimum."""
    return rt.optimize(doublet(), **DOUBLET).lens


@pytest.fixture(scope="module")
def designed_singlets():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rt.RaytraceWarning)
        return rt.optimize(two_singlets(), **SINGLETS).lens


def design_of(lens: rt.Lens, *, merit, vary, bounds, hold=()) -> Design:
    """The lens as the start of a fit."""
    model = design_variables(lens, vary)
    rows, held = specified(lens, merit, hold)
    problem = Problem(model, rows.rows, conditions_in_unit(lens, held, rows.unit), **rows.options)
    lower, upper = bounds_of(lens, model.variables, bounds)
    return Design(problem, lower, upper, problem.state(model.start, True))


def best_of_all(fit, items) -> float:
    """The lowest merit of all combinations of candidates, each optimised."""
    merits = []
    for chosen in itertools.product(*(fit.candidates(fit.design, item) for item in items)):
        design = fit.design
        for item, (_, candidate) in zip(items, chosen, strict=True):
            design = fit.placed(design, item, candidate)
        end = fit.descend(design, 25)
        merits.append(end.merit if end.missed < 1e-5 and not end.state.lost else math.inf)
    return min(merits)


# -- test plates -------------------------------------------------------------------------------------------------------


def test_plates_of_the_designed_radii_cost_nothing(designed):
    radii = [abs(float(designed.surfaces[k].radius)) for k in (1, 2, 3)]
    others = [TestPlate(radius * factor) for radius in radii for factor in (0.7, 0.95, 1.04, 1.5)]
    fitted = rt.optimize(designed, **DOUBLET, test_plates=[*others, *map(TestPlate, radii)])
    start, end = fitted.fitted.merits
    assert end == pytest.approx(start, rel=1e-7)
    assert fitted.merit_after == pytest.approx(end, rel=1e-12)
    for k, radius in enumerate(radii, 1):
        assert abs(float(fitted.lens.surfaces[k].radius)) == pytest.approx(radius, rel=1e-14)


def test_every_radius_is_of_the_list_and_greedy_is_as_good_as_brute_force(designed):
    plates = [TestPlate(float(radius)) for radius in np.geomspace(30, 300, 14).round(1)]
    fitted = rt.optimize(designed, **DOUBLET, test_plates=plates)
    for k in (1, 2, 3):
        off = [abs(abs(float(fitted.lens.surfaces[k].radius)) / plate.radius - 1) for plate in plates]
        assert min(off) < 1e-14
    assert not any(variable.quantity == "curvature" for variable in fitted.lens.optimization_data.variables)
    fit = PlateFit(design_of(designed, **DOUBLET), plates)
    items = fit.items()
    every = fit.candidates
    fit.candidates = lambda design, item: every(design, item)[:6]
    best = best_of_all(fit, items)
    assert best < 20 * fit.design.merit
    assert fitted.fitted.merits[1] <= best * 1.001


def test_the_shape_of_the_glass_and_the_diameter_are_respected(designed):
    """R1 is convex, the cemented R2 needs both shapes, R3 is convex: the flint is thinner at its rim."""
    sign = [1 if float(designed.surfaces[k].radius) > 0 else -1 for k in (1, 2, 3)]
    assert sign == [1, -1, -1]
    plates = [
        TestPlate(60.0, ("concave",)),
        TestPlate(61.5, ("convex",), diameter=10),
        TestPlate(66.0, ("convex",), diameter=25, name="A", tolerance="0.1 %"),
        *(TestPlate(45.0, (shape,)) for shape in ("convex", "concave")),
        TestPlate(43.0, ("convex",)),
        TestPlate(140.0, ("convex",)),
        TestPlate(139.0, ("concave",)),
    ]
    fitted = rt.optimize(designed, **DOUBLET, test_plates=plates)
    radii = [abs(float(fitted.lens.surfaces[k].radius)) for k in (1, 2, 3)]
    assert radii[1] == pytest.approx(45)
    assert {round(radii[0]), round(radii[2])} <= {66, 140}
    entries = {column.name: cells for column, cells in fitted.fitted.entries.items()}
    assert entries["plate"] == ["A" if round(radius) == 66 else "-" for radius in radii]
    assert entries["tolerance"] == ["0.1 %" if round(radius) == 66 else "-" for radius in radii]
    assert entries["shape"] == ["convex", "concave convex", "convex"]
    with pytest.warns(rt.NotFitted, match="no plate for a concave and convex"):
        rest = rt.optimize(designed, **DOUBLET, test_plates=[TestPlate(61.5, ("convex",)), TestPlate(140, ("convex",))])
    assert [surfaces for surfaces, _ in rest.fitted.notes] == ["2"]


def test_pickups_follow_to_the_same_plate_and_fixed_radii_and_solves_stay():
    rows = [
        dict(radius=50, thickness=4, glass="N-BK7"),
        dict(radius=-50, thickness=10),
        dict(radius=-80, thickness=3, glass="N-BK7"),
        dict(radius=300, thickness=90),
    ]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=10, fields=[0, 1])
    how = {"vary": "curvature:1 curvature:2=-curvature:1 curvature:4=f_number(8) thickness:2", "merit": "spot"}
    how["bounds"] = "curvature_1:0.01..0.05 thickness_2:2..20"
    plates = [TestPlate(float(radius)) for radius in range(20, 100, 7)]
    with pytest.warns(rt.NotFitted, match=r"surfaces 4: its radius follows from a solve \(f_number\)"):
        fitted = rt.optimize(lens, **how, test_plates=plates).lens
    first, second = (float(fitted.surfaces[k].radius) for k in (1, 2))
    assert second == -first
    assert min(abs(first - plate.radius) for plate in plates) < 1e-12
    assert float(fitted.surfaces[3].radius) == -80
    assert float(rt.first_order(fitted).f_number) == pytest.approx(8, rel=1e-9)


def test_a_list_of_plates_is_read_and_errors_have_their_place(tmp_path):
    file = tmp_path / "plates.csv"
    file.write_text(
        "# of our shop\nRadius, Shape, Diameter, Tolerance, Name\n61.5,CX,30,0.1 %,A 1\n45 mm,,,,\ninf,,80,,flat\n"
    )
    assert read_plates(file) == (
        TestPlate(61.5, ("convex",), 30, "0.1 %", "A 1"),
        TestPlate(45.0),
        TestPlate(math.inf, diameter=80, name="flat"),
    )
    for text, message in (
        ("radius,shape\n50,round\n", r"plates\.csv:2, shape: 'round'; expected convex \(CX\), concave"),
        ("radius\n-50\n", r"plates\.csv:2, radius: '-50'; expected a length in mm, of a radius without its sign"),
        ("radios\n50\n", r"plates\.csv:1: no column 'radios'; .*did you mean radius\?"),
        ("shape\nCX\n", r"plates\.csv:1: no column radius"),
        ("radius\n", "no plates below the heading"),
    ):
        file.write_text(text)
        with pytest.raises(rt.BadPlates, match=message):
            read_plates(file)
    with pytest.raises(rt.BadPlates, match="no such file; expected a table of test plates"):
        rt.optimize(doublet(), **DOUBLET, test_plates=tmp_path / "none.csv")


# -- parts of stock ----------------------------------------------------------------------------------------------------


def part_file(folder, name: str, rows, diameter: float = 20.0) -> None:
    rows = [row | {"semi_diameter": diameter / 2} for row in rows]
    rt.write_lens(rt.lens(rows, stop=1, entrance_pupil_diameter=5), folder / f"{name}.zmx")


def element(lens: rt.Lens, first: int, last: int) -> list[dict]:
    """Rows of an element."""
    rows = []
    for surface in lens.surfaces[first : last + 1]:
        rows.append(dict(radius=float(surface.radius), thickness=float(surface.thickness), glass=surface.glass))
    return [*rows[:-1], {"radius": rows[-1]["radius"], "thickness": 40.0}]


@pytest.fixture(scope="module")
def decoys(tmp_path_factory):
    """Parts that are not those of the designs."""
    folder = tmp_path_factory.mktemp("parts")
    for f in (50, 70):
        flat = [dict(radius=0.5168 * f, thickness=4, glass="N-BK7"), dict(thickness=40)]
        part_file(folder, f"PX-{f}", flat)
    part_file(folder, "BX-60", [dict(radius=61, thickness=4, glass="N-BK7"), dict(radius=-61, thickness=40)])
    return folder


@pytest.mark.slow
def test_the_elements_of_the_lens_are_found_in_their_orientation_and_cost_nothing(designed_singlets, decoys, tmp_path):
    lens = designed_singlets
    part_file(tmp_path, "own-first", element(lens, 1, 2))
    (turned,) = [rt.edit.reverse(rt.lens(element(lens, 3, 4), stop=1, entrance_pupil_diameter=5), "1-2")]
    part_file(tmp_path, "own-second", element(turned, 1, 2))
    for file in decoys.glob("*.zmx"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    rt.stock_index(tmp_path, tmp_path / "stock.sqlite")
    fitted = rt.optimize(lens, **SINGLETS, stock=tmp_path / "stock.sqlite")
    entries = {column.name: cells for column, cells in fitted.fitted.entries.items()}
    assert entries["part"] == ["own-first", "own-second"]
    assert entries["orientation"] == ["as listed", "reversed"]
    start, end = fitted.fitted.merits
    assert end == pytest.approx(start, rel=1e-6)
    for k in (1, 2, 3, 4):
        assert float(fitted.lens.surfaces[k].radius) == pytest.approx(float(lens.surfaces[k].radius), rel=1e-9)
    assert [fitted.lens.surfaces[k].comment for k in (1, 3)] == ["own-first", "own-second"]
    assert fitted.names == ("thickness_2", "thickness_4")


def test_greedy_is_as_good_as_brute_force(designed_singlets, decoys, tmp_path):
    index = tmp_path / "stock.sqlite"
    rt.stock_index(decoys, index)
    fitted = rt.optimize(designed_singlets, **SINGLETS, stock=index)
    fit = StockFit(design_of(designed_singlets, **SINGLETS), index)
    items = fit.items()
    assert len(items) == 2
    best = best_of_all(fit, items)
    assert fit.design.merit < best < math.inf
    assert fitted.fitted.merits[1] <= best * 1.001
    assert float(rt.first_order(fitted.lens).magnification) == pytest.approx(-1, rel=1e-6)


def test_what_has_no_part_or_no_space_is_said(designed_singlets, designed, decoys, tmp_path):
    index = tmp_path / "stock.sqlite"
    rt.stock_index(decoys, index)
    with pytest.warns(rt.NotFitted, match=r"surfaces 1-3: no cemented group of 2 elements with EFL 101\.1 mm"):
        rest = rt.optimize(designed, **DOUBLET, stock=index)
    assert len(rest.fitted.steps) == 1
    assert float(rest.lens.surfaces[1].radius) == pytest.approx(float(designed.surfaces[1].radius), rel=1e-3)
    options = SINGLETS | {"vary": "curvature", "bounds": None}
    with pytest.raises(rt.NoProblem, match="no air space varies, by which parts are placed; add thickness"):
        rt.optimize(designed_singlets, **options, stock=index)
    with pytest.raises(rt.NoProblem, match="`test_plates` does not go with `stock`"):
        rt.optimize(designed_singlets, **SINGLETS, stock=index, test_plates=[TestPlate(50.0)])
    with pytest.raises(rt.BadStock, match="no such index"):
        rt.optimize(designed_singlets, **SINGLETS, stock=tmp_path / "none.sqlite")


@pytest.mark.slow
def test_pickups_between_replaced_elements_are_named(designed_singlets, decoys, tmp_path):
    """Those of an element that stays still hold."""
    index = tmp_path / "stock.sqlite"
    rt.stock_index(decoys, index)
    words = SINGLETS["vary"].replace("curvature", "curvature:1-3 curvature:4=-curvature:1", 1)
    options = SINGLETS | {"vary": words}
    with pytest.warns(rt.NotFitted, match=r"surfaces 1-2: left out with the element: solve curvature of surface 4 ="):
        fitted = rt.optimize(designed_singlets, **options, stock=index, cycles=2)
    assert [surfaces for surfaces, text in fitted.fitted.notes if "left out" in text] == ["1-2", "3-4"]
    assert "left out with the element" in str(fitted)


def test_fixed_elements_stay(designed_singlets, decoys, tmp_path):
    rt.stock_index(decoys, tmp_path / "stock.sqlite")
    how = SINGLETS | {"vary": "curvature:3,4 thickness:2,4"}
    fitted = rt.optimize(designed_singlets, **how, stock=tmp_path / "stock.sqlite")
    assert [cells for column, cells in fitted.fitted.entries.items() if column.name == "surfaces"] == [["3-4"]]
    assert float(fitted.lens.surfaces[1].radius) == float(designed_singlets.surfaces[1].radius)


def test_a_time_limit_ends_with_a_lens_of_parts(designed_singlets, decoys, tmp_path):
    rt.stock_index(decoys, tmp_path / "stock.sqlite")
    fitted = rt.optimize(designed_singlets, **SINGLETS, stock=tmp_path / "stock.sqlite", seconds=0.2)
    assert len(next(iter(fitted.fitted.entries.values()))) == 2


def test_the_command_writes_the_lens_and_reports_the_parts(designed_singlets, decoys, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rt.write_lens(designed_singlets, "design.zmx")
    assert main(["stock", "index", str(decoys)]) == 0
    capsys.readouterr()
    assert main(["optimize", "design.zmx", "--stock", "stock.sqlite", "-o", "built.zmx", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)["fitted"]
    built = rt.read_lens("built.zmx")
    parts = [item["part"] for item in document["items"]]
    assert parts == [built.surfaces[k].comment for k in (1, 3)]
    (tmp_path / "plates.csv").write_text("radius\n" + "\n".join(map(str, range(20, 400, 20))))
    assert main(["optimize", "design.zmx", "--test-plates", "plates.csv", "-o", "plated.zmx"]) == 0
    assert "19 test plates: merit of the design" in capsys.readouterr().out
    radii = [abs(float(rt.read_lens("plated.zmx").surfaces[k].radius)) for k in (1, 2, 3, 4)]
    assert [radius / 20 for radius in radii] == pytest.approx([round(radius / 20) for radius in radii], abs=1e-9)
