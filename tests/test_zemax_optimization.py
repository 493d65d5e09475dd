"""Optimisation data of .zmx files (variables, merit function, solves): read, kept and written."""

import dataclasses
import json
import warnings
from collections import Counter
from pathlib import Path

import pytest
import torch
from problems import SHARED
from problems_files import assert_same, sized
from problems_zemax import file, lens
from problems_zemax import read as read_text
from problems_zemax_optimization import CONFIGURED, MERIT_LINES, RULES, STOP_RULES

import raytrace as rt
from raytrace.io import read_lens_with_report, write_lens
from raytrace.io.source import LensFileError, LensFileWarning
from raytrace.io.zemax.optimization import read_merit
from raytrace.io.zemax.write import in_file
from raytrace.materials.catalogs import UnknownGlass
from raytrace.system.dimensions import DIMENSION
from raytrace.system.lens import index_behind
from raytrace.system.optimization_data import OptimizationData, Row, Solve, Vary
from raytrace.system.parameter_paths import number_at, parameter_paths
from raytrace.system.surface import sag

MERIT = SHARED / "merit" / "dev"
FOLDERS = (SHARED / "corpus" / "zmx", SHARED / "tier2" / "dev", MERIT, Path(__file__).parents[1] / "lenses")
FILES = sorted(path for folder in FOLDERS for path in folder.glob("*") if path.suffix.lower() == ".zmx")
UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1e3}


def again(found: rt.Lens, folder: Path) -> rt.Lens:
    """A lens written and read."""
    write_lens(found, folder / "again.zmx")
    return read_lens_with_report(folder / "again.zmx")[0]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_optimisation_data_of_every_real_file_round_trip(path, tmp_path):
    try:
        original = read_lens_with_report(path)[0]
    except (LensFileError, UnknownGlass):  # refused by name
        return
    found, written = again(original, tmp_path), sized(original).optimization_data
    assert found.optimization_data == written
    assert again(found, tmp_path).optimization_data == written


def of_oracle(name: str, number: str, surface: rt.system.Surface) -> tuple[int, str]:
    """Surface and name of a variable of the oracle, which writes p:2/4 for parameter 4 of surface 2."""
    if name != "p":
        return int(number), name
    surface_number, j = number.split("/")
    row = {"EVENASPH": f"a{2 * int(j)}", "PARAXIAL": "power_x"}
    return int(surface_number), row["PARAXIAL" if surface.phase is not None else "EVENASPH"]


@pytest.mark.needs(MERIT)
def test_variables_and_rows_are_those_of_an_independent_reader():
    met = 0
    for case in json.loads((MERIT / "oracle.json").read_text())["files"]:
        path = next((folder / case["file"] for folder in FOLDERS if (folder / case["file"]).exists()), None)
        if path is None:
            continue
        original, report = read_lens_with_report(path)
        variables = [one.split(":") for one in case["variables"]]
        surfaces = [original.surfaces[int(number.split("/")[0])] for _, number in variables]
        expected = [of_oracle(*one, surface) for one, surface in zip(variables, surfaces, strict=True)]
        assert [(one.surface, one.quantity) for one in original.optimization_data.variables] == expected
        in_mm = not any("converted to mm" in note for note in report.notes)
        for value, (surface, quantity) in zip(case.get("x_stored", ()) if in_mm else (), expected, strict=False):
            held = original.surfaces[surface]
            number = held.thickness if quantity == "thickness" else number_at(held, parameter_paths(held)[quantity])
            assert float(number) == pytest.approx(value, rel=1e-15, abs=0)
        counts = Counter(row.operand for row in original.optimization_data.merit)
        assert all(counts[name] == count for name, count in case.get("operand_counts", {}).items())
        for one in case.get("values", ()):
            row = original.optimization_data.merit[one["row"] - 1]
            assert row.operand == one["op"]
            assert row.weight == pytest.approx(one["weight"], rel=1e-15)
        met += 1
    assert met >= 17


@pytest.mark.parametrize("unit", UNITS)
def test_lengths_of_solves_are_in_mm_and_rows_round_trip_as_written(unit, tmp_path):
    mm = UNITS[unit]
    rules = {"surface": RULES, "stop": "MAZH 0.125 0.7\nPZUP 1 -1 0.5 0\nDIAM 5.5 0 0 0 1", "tail": MERIT_LINES}
    original = lens(UNIT=f"UNIT {unit} X W X CM MR CPMM\nSDMA 5 1 0.25", **rules)
    optimization_data = original.optimization_data
    names = ["curvature", "thickness", "conic", "a4", "a6"]
    assert [(one.surface, one.quantity) for one in optimization_data.variables] == [(1, name) for name in names]
    assert optimization_data.solves == (
        Solve(2, "thickness", "marginal_height", (0.125 * mm, 0.7)),
        Solve(2, "thickness", "pickup", source=1, scale=-1.0, offset=0.5 * mm),
    )
    assert optimization_data.kept == ()
    assert optimization_data.semi_diameter_margin == (5, 0.25 * mm)
    assert optimization_data.semi_diameters == ()
    assert optimization_data.unit == mm
    assert [row.target for row in optimization_data.merit[3:]] == [
        2.5,
        0.05,
        1.5,
        1,
        1,
        0.4,
        0.125,
        1e-5,
        7,
    ]  # as they stand
    assert optimization_data.merit[1].text == "A text,  with blanks."
    assert optimization_data.merit[2] == Row("TRAC", (0, 1), (0, 0.7, 0.335, 0), 0, 0.727e-1, further=(0, 0))
    assert optimization_data.merit[11] == Row("QQQQ", (1, 2), (3, 4, 5, 6), 7, 8, "AUTO", (9, 10))
    assert optimization_data.tolerances[1:] == ("TOL TTHI   1   2 -0.25 0.5   0 0 0", "TCMM A comment.")
    found = again(original, tmp_path)
    assert f"UNIT {unit} " in (tmp_path / "again.zmx").read_text()
    assert found.optimization_data == optimization_data
    assert_same(found, sized(original))


@pytest.mark.parametrize("unit", [10.0, 25.4, 1e3])
@pytest.mark.parametrize("power", [1, -1, -3, -15])
def test_a_number_of_a_file_round_trips_in_its_unit(unit, power):
    random = torch.Generator().manual_seed(3)
    for one in torch.randn(500, dtype=torch.float64, generator=random).tolist():
        in_mm = one * unit**power if power >= 0 else one / unit**-power
        stored = float(in_file(repr(in_mm), power, unit))
        assert (stored * unit**power if power >= 0 else stored / unit**-power) == in_mm
        other = float(in_file(repr(one), power, unit))
        assert (other * unit**power if power >= 0 else other / unit**-power) == pytest.approx(one, rel=5e-16, abs=0)


def test_a_focal_length_round_trips_in_every_unit(tmp_path):
    ideal = "TYPE PARAXIAL\nCURV 0\nPARM 1 37.723137702602429\nVPAR 1\nPARM 2 1\nGLAS AIR"
    for unit in UNITS:
        original = lens(UNIT=f"UNIT {unit} X", surface=ideal, tail="EFFL 0 2 0 0 0 0 50 1 0 0")
        assert_same(again(original, tmp_path), sized(original))


def test_a_unit_that_no_file_has_is_refused_by_name(tmp_path):
    original = lens(tail="EFFL 0 2 0 0 0 0 50 1 0 0")
    other = dataclasses.replace(original, optimization_data=dataclasses.replace(original.optimization_data, unit=3.0))
    with pytest.raises(LensFileError, match=r"3\.0 mm, .* 1, 10, 25\.4 or 1000"):
        write_lens(other, tmp_path / "lens.zmx")


def test_variables_are_modelled_and_a_row_is_not_traced():
    found = lens(surface=RULES)
    first = found.surfaces[1]
    assert float(first.conic) == 0
    assert first.coefficients.tolist() == [0, 1e-5, 0]
    plain = dataclasses.replace(found, optimization_data=None)
    assert len(torch.utils._pytree.tree_leaves(found)) == len(torch.utils._pytree.tree_leaves(plain))


def test_a_lens_without_optimisation_data_is_written_as_before(tmp_path):
    given = lens(object_="DIAM 9 1 0 0 1").replace(1, thickness=4.5)
    given = dataclasses.replace(given, optimization_data=None)
    write_lens(given, tmp_path / "lens.zmx")
    text = (tmp_path / "lens.zmx").read_text()
    assert "SDMA 0 1 0\n" in text
    assert "DIAM 6.0 1 0 0 1" in text
    assert not [word for word in ("VDSZ", "VCON", "BLNK", "MAZH") if word in text]
    assert again(given, tmp_path).optimization_data == OptimizationData(semi_diameters=(0, 1, 2))


@pytest.mark.parametrize(
    "changes",
    [
        {"surface": "VPAR x"},
        {"surface": "PPAR 1 0 nan"},
        {"surface": "MAZH 0 1e999"},
        {"surface": "TOLE 1.5 2"},
        {"surface": "CURV 0.02 1.5"},
        {"surface": "DIAM 6 x"},
        {"surface": "GLAS N-BK7 2 x"},
        {"tail": "TRAC 0 1 0 0 x 0 0 1"},
        {"tail": "TRAC 0.5 1"},
        {"tail": "EFFL 0 2 0 0 0 0 1,5 1"},
        {"UNIT": "UNIT METER", "surface": "MAZH 1e308 0"},
    ],
    ids=lambda changes: list(changes.values())[-1],
)
def test_a_wrong_word_in_a_rule_or_a_row_is_one_error_with_file_and_line(changes):
    with pytest.raises(LensFileError, match=r"^lens\.zmx:\d+") as caught:
        lens(**changes)
    assert "\n" not in str(caught.value)
    assert caught.value.surface == (1 if "surface" in changes else None)


def test_unsupported_solves_are_kept_reported_and_round_trip(tmp_path):
    rules = {
        "surface": 'CURV 0.02 8 0.01 0 0 ""\nTOLE 3 51.5\nGLAS N-BK7 3 0 1.5 40\nPPAR 2 -1 1 0\nDIAM 6 3 0 0 1',
        "stop": "EDGE 0.5 3\nDIAM 5.5 2 1 0 1\nCURV -0.02 99 1 2 3",
    }
    original, report = read_text(file(**rules))
    assert [one.kind for one in original.optimization_data.solves] == ["power", "position", "edge_thickness"]
    assert original.optimization_data.solves[2].numbers == (0.5, 3)
    kinds = [(one.surface, one.quantity, one.kind, one.numbers, one.source) for one in original.optimization_data.kept]
    assert kinds == [
        (1, "PARM 2", "PPAR", (-1, 1, 0), 0),
        (1, "glass", "substitute", (), 0),
        (1, "semi_diameter", "maximum", (), 0),
        (2, "curvature", "code 99", (1, 2, 3), 0),
        (2, "semi_diameter", "pickup", (), 1),
    ]
    for one in original.optimization_data.kept:
        is_noted = any(note.endswith(f"not followed when the lens is optimised: {one}") for note in report.notes)
        assert is_noted != one.is_largest_size
    assert again(original, tmp_path).optimization_data == original.optimization_data


def test_numbers_of_configurations_vary_one_by_one_and_void_the_variable_of_the_surface(tmp_path):
    original = lens(surface=RULES, tail=CONFIGURED)
    assert original.optimization_data.variables == (
        *(Vary(1, name) for name in ("curvature", "conic", "a6")),
        Vary(1, "thickness", 1, 0),
        Vary(1, "thickness", 2, 0),
        Vary(1, "a4", 1, 2),
    )
    (rule,) = (one for one in original.optimization_data.solves if one.operand is not None)
    assert rule == Solve(2, "curvature", "pickup", (1.0,), 1, 2.0, configuration=2, operand=1)
    found = again(original, tmp_path)
    assert found.optimization_data == sized(original).optimization_data
    assert [one.values() for one in found.operands] == [one.values() for one in original.operands]


def test_optimisation_data_stay_with_the_lens_under_other_conditions():
    original = lens(surface=RULES, tail=f"{MERIT_LINES.rpartition('MNUM')[0]}{CONFIGURED}")
    for other in (original.at(f_number=8), original.replace(1, thickness=3), original.configuration(2)):
        assert other.optimization_data is original.optimization_data
    assert rt.to(original, dtype=torch.float32).optimization_data is original.optimization_data


def test_one_number_of_the_file_that_is_two_of_the_lens_varies_both(tmp_path):
    original = lens(surface="TYPE PARAXIAL\nCURV 0\nPARM 1 50\nVPAR 1\nPARM 2 1").replace(1, glass=rt.materials.AIR)
    assert original.optimization_data.variables == (Vary(1, "power_x"),)
    assert original.optimization_data.solves == (Solve(1, "power_y", "pickup", source=1, quantity_of_source="power_x"),)
    assert again(original, tmp_path).optimization_data == original.optimization_data


def test_bounds_of_a_thickness_are_kept_and_those_of_the_program_are_none(tmp_path):
    original = lens(surface="VDSZ 1 2.5", stop="VDSZ -1.E+10 1.0E+10", UNIT="UNIT CM")
    assert original.optimization_data.variables == (Vary(1, "thickness", bounds=(10.0, 25.0)), Vary(2, "thickness"))
    assert again(original, tmp_path).optimization_data == original.optimization_data


@pytest.mark.parametrize("unit", UNITS)
def test_bounds_of_thicknesses_and_of_other_variables_are_kept(unit, tmp_path):
    original = lens(surface=RULES, stop="VDSZ 0 0", UNIT=f"UNIT {unit} X", tail="EFFL 0 2 0 0 0 0 50 1 0 0")
    curvature, thickness, *others, last = original.optimization_data.variables
    inf = float("inf")
    bound = (dataclasses.replace(thickness, bounds=(1.5, inf)), *others, dataclasses.replace(last, bounds=(-inf, 30.0)))
    data = dataclasses.replace(original.optimization_data, variables=(curvature, *bound))
    assert again(dataclasses.replace(original, optimization_data=data), tmp_path).optimization_data == data
    steep = dataclasses.replace(data, variables=(dataclasses.replace(curvature, bounds=(0.0, 0.1)), *bound))
    assert again(dataclasses.replace(original, optimization_data=steep), tmp_path).optimization_data == steep


def test_a_merit_function_file_has_two_numbers_more_before_the_target(tmp_path):
    path = tmp_path / "spot.MF"
    path.write_text("VERS 120229\nBLNK spot\nTRAC 0 1 0 0.7 0.5 0 0 0 0.25 0.125\nEFFL 0 2 0 0 0 0 0 0 2 1\n", "utf-16")
    text, ray, length = read_merit(path)
    assert text.text == "spot"
    assert (ray.numbers, ray.target, ray.weight) == ((0, 0.7, 0.5, 0), 0.25, 0.125)
    assert (length.target, length.weight, length.further) == (2, 1, ())
    (tmp_path / "other.MF").write_text("nothing of a merit\n")
    with pytest.raises(LensFileError, match=r"other\.MF: no operand .* 1 lines"):
        read_merit(tmp_path / "other.MF")


def test_optimisation_data_describe_themselves():
    shown = str(lens(surface=RULES, stop="PZUP 1 -1 0.5 0", tail=MERIT_LINES).optimization_data)
    assert "varies: a4 of surface 1" in shown
    assert "follows: thickness of surface 2 = -1 × thickness of surface 1 + 0.5" in shown
    assert "merit function of 12 lines: DMFS x1, BLNK x1, TRAC x1" in shown
    assert str(OptimizationData()) == "nothing varies, nothing follows, no merit function"
    assert {"TRAC", "MTFT", "CONF"} <= DIMENSION.keys()


def test_check_lists_variables_and_evaluated_operands(tmp_path):
    path = tmp_path / "lens.zmx"
    path.write_text(file(surface=RULES, stop=STOP_RULES, tail=MERIT_LINES))
    found = rt.check(path)
    status = {one.name: (one.count, one.weighted, one.status) for one in found.operands}
    assert status["TRAC"] == (1, 1, "evaluated")
    assert status["BLNK"] == (1, 0, "evaluated")
    assert status["QQQQ"] == (1, 1, "unknown")
    assert {
        one.status for one in read_lens_with_report(path, evaluated=["TRAC"])[1].operands if one.name == "EFFL"
    } == {"known, not evaluated"}
    document = found.document()
    assert document["variables"][0] == "curvature of surface 1"
    assert document["tolerances"] == 3
    assert "curvature of surface 2 = -1 × curvature of surface 1" in document["solves"]
    assert any("position" in one for one in (*document.get("kept", ()), *document.get("solves", ())))
    shown = str(found)
    assert "5 variables:\n    curvature of surface 1, thickness of surface 1" in shown
    assert "unknown:\n    QQQQ x1" in shown
    plain = read_lens_with_report("singlet")[1].document()
    assert not {"variables", "solves", "kept", "operands", "tolerances"} & plain.keys()


def test_a_table_reports_that_it_holds_no_optimisation_data(tmp_path):
    with pytest.warns(LensFileWarning, match=r"'12 rows of a merit function'"):
        write_lens(lens(surface=RULES, tail=MERIT_LINES), tmp_path / "lens.csv")


def test_variables_in_any_order_are_written_without_a_warning(tmp_path):
    data = lens(surface=RULES, tail=MERIT_LINES).optimization_data
    reversed_order = dataclasses.replace(data, variables=data.variables[::-1], solves=data.solves[::-1])
    with warnings.catch_warnings(action="error"):
        write_lens(
            dataclasses.replace(lens(surface=RULES, tail=MERIT_LINES), optimization_data=reversed_order),
            tmp_path / "lens.zmx",
        )
    assert rt.read_lens(tmp_path / "lens.zmx").optimization_data.variables == data.variables


def edge(surfaces, k: int, height: float) -> float:
    """Thickness behind surface k at a height, of spheres and conics."""
    sags = [float(sag(surfaces[j], torch.tensor(height**2, dtype=torch.float64))) for j in (k, k + 1)]
    return float(surfaces[k].thickness) + sags[1] - sags[0]


def test_solves_reproduce_the_stored_numbers():
    met = Counter()
    for path in FILES:
        try:
            found = read_lens_with_report(path)[0]
        except (LensFileError, UnknownGlass):
            continue
        for one in (*found.optimization_data.solves, *found.optimization_data.kept) if found.optimization_data else ():
            surfaces, k = found.surfaces, one.surface
            if one.kind == "position":
                run = range(one.source, k + 1) if one.source <= k else range(k, one.source)
                value = sum(float(surfaces[j].thickness) for j in run)
            elif one.kind == "edge_thickness":
                value = edge(surfaces, k, one.numbers[1])
            elif one.kind == "power":
                primary = found.primary
                before, behind = (float(index_behind(found, j, primary)) for j in (k - 1, k))
                value = (behind - before) * float(surfaces[k].curvature)
            else:
                continue
            assert value == pytest.approx(one.numbers[0], rel=2e-8, abs=1e-9)
            met[one.kind] += 1
    if MERIT.is_dir():
        assert met["position"] >= 8
        assert met["power"]
        assert met["edge_thickness"]


def test_offsets_of_kept_solves_round_trip_in_every_unit(tmp_path):
    for unit in UNITS:
        original = lens(
            UNIT=f"UNIT {unit} X", surface=f"{RULES}\nPPAR 2 -1 1 0.3", stop="PZUP 2 1 0.7 0", tail="EFFL 0 2"
        )
        assert {one.kind for one in original.optimization_data.kept} == {"PPAR", "PZUP"}
        assert again(original, tmp_path).optimization_data == original.optimization_data
