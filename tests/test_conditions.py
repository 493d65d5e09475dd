"""Conditions that a lens stores: their rows and words, files, optimisations, reports."""

import dataclasses
import json
import re

import pytest
from problems import SHARED

import raytrace as rt
from raytrace.cli import main
from raytrace.optimization.attained import NotReached, attained_by
from raytrace.optimization.conditions import BadHold, ReplacedCondition, without_rows
from raytrace.system.optimization_data import OptimizationData, Row, Vary

WORDS = (
    "efl=100 total_track<=200 edge>=1 off:distortion<=2% bfd>=30 image_height=21.5 glass_thickness:1-3<=10 "
    "REAY(8,0,0,1)<=45"
)
SPOT = rt.optimization.DefaultMerit("spot", rings=2, arms=4)
MERITS = sorted(path.name for path in (SHARED / "merit" / "dev").glob("*.[zZ]*"))


@pytest.fixture
def triplet():
    return rt.read_lens("cooke_triplet").at(ray_aiming="paraxial")


def in_words(lens):
    return " ".join(map(str, lens.conditions))


def efl(lens):
    return float(rt.first_order(lens).effective_focal_length)


# -- rows and words ----------------------------------------------------------------------------------------------------


def test_conditions_are_rows_that_opticstudio_reads(triplet):
    lens = triplet.with_conditions(WORDS)
    assert triplet.conditions == ()
    assert in_words(lens) == WORDS
    rows = [(row.name, row.integers, row.target, row.weight, row.text) for row in lens.optimization_data.merit]
    assert rows[:6] == [
        ("EFFL", (0, 0), 100.0, -1.0, ""),
        ("TOTR", (0, 0), 0.0, 0.0, ""),
        ("OPLT", (2, 0), 200.0, -1.0, ""),
        ("MNEG", (1, 7), 1.0, -1.0, ""),
        ("BLNK", (0, 0), 0.0, 0.0, "off:"),
        ("DIMX", (0, 0), 2.0, 0.0, ""),
    ]
    limits = triplet.with_conditions("air_thickness>=0.5 air_thickness<=50 air_edge>=0.4 glass_thickness>=2")
    assert [row.name for row in limits.optimization_data.merit] == ["MNCA", "MXCA", "MNEA", "MNCG"]
    assert [row.integers for row in limits.optimization_data.merit] == [(1, 7), (1, 6), (1, 7), (1, 7)]


def test_a_condition_replaces_those_of_its_quantity_and_side(triplet):
    lens = triplet.with_conditions("thickness:2<=20 efl=100 thickness:2>=5")
    assert in_words(lens.with_conditions("efl=90 thickness:2<=15")) == "thickness:2>=5 efl=90 thickness:2<=15"
    assert in_words(lens.with_conditions("thickness:2=7")) == "efl=100 thickness:2=7"
    assert in_words(lens.with_conditions("efl=100")) == in_words(lens)
    assert lens.with_conditions((), only=True).optimization_data.merit == ()
    off = [dataclasses.replace(condition, on=False) for condition in lens.conditions]
    switched = lens.with_conditions(off, only=True)
    assert in_words(switched) == "off:thickness:2<=20 off:efl=100 off:thickness:2>=5"
    assert [row.name for row in switched.optimization_data.merit] == [
        *("BLNK", "TTHI", "OPLT", "BLNK", "EFFL", "BLNK", "TTHI", "OPGT")
    ]
    assert all(row.weight == 0 for row in switched.optimization_data.merit)
    assert in_words(switched.with_conditions("efl=90")) == "off:thickness:2<=20 off:thickness:2>=5 efl=90"


def test_edits_renumber_and_scale_conditions(triplet):
    lens = triplet.with_conditions("efl=100 total_track<=200 edge>=1 off:thickness:6>=2 distortion<=2%")
    larger = rt.edit.scale(lens, 2.0)
    assert in_words(larger) == "efl=200 total_track<=400 edge>=2 off:thickness:6>=4 distortion<=2%"
    fewer = rt.edit.delete(lens, "1-2")
    assert in_words(fewer) == "efl=100 total_track<=200 edge>=1 off:thickness:4>=2 distortion<=2%"


def test_rows_of_negative_weight_are_conditions_also_of_other_rows(triplet):
    rows = (
        *(Row("EFFL"), Row("TOTR"), Row("DIVI", (2, 1), target=1.2, weight=-1.0)),
        *(Row("OPLT", (2, 0), target=130.0, weight=-1.0), Row("ABGT", (1, 0), target=50.0, weight=-1.0)),
        *(Row("MNCG", (1, 7), target=2.0, weight=-1.0), Row("EFFL", target=100.0, weight=-1.0)),
    )
    lens = dataclasses.replace(triplet, optimization_data=OptimizationData(merit=rows))
    ratio, track, length, *_ = results = attained_by(lens)
    assert [result.name for result in results] == ["row 3", "total_track", "row 5", "glass_thickness", "efl"]
    assert ratio.reached == pytest.approx(track.reached / efl(lens), rel=1e-12)
    assert length.reached == pytest.approx(efl(lens), rel=1e-12)
    assert [result.met for result in results] == [False, True, True, True, False]
    assert lens.with_conditions(lens.conditions).optimization_data.merit == rows
    found = rt.optimize(lens, merit=SPOT, vary="curvature:1-3 sensor", cycles=8)
    assert [result.met for result in found.conditions] == [True] * 5
    assert found.lens.optimization_data.merit == rows


def test_rows_that_others_need_stay_and_all_are_renumbered():
    rows = (Row("EFFL", weight=-1.0), Row("TOTR"), Row("OPLT", (2, 0), weight=-1.0), Row("DIFF", (1, 2), weight=1.0))
    assert without_rows(rows, [3]) == (rows[0], rows[1], Row("DIFF", (1, 2), weight=1.0))
    assert without_rows(rows, [1]) == (Row("EFFL"), *rows[1:])
    assert without_rows((*rows[:3], Row("OPGT", (1, 0), weight=1.0)), [3]) == (rows[0], Row("OPGT", (1, 0), weight=1.0))


def test_conditions_are_of_configurations_and_of_the_unit_of_the_file(triplet):
    zoom = triplet.with_configurations(thickness={2: [12.93, 14.0]})
    lens = zoom.with_conditions("efl@2=101 total_track<=130")
    assert [row.integers[0] for row in lens.optimization_data.merit if row.name == "CONF"] == [2, 1]
    assert in_words(lens) == "efl@2=101 total_track@1<=130"
    second = attained_by(lens)[0]
    assert second.reached == pytest.approx(efl(zoom.configuration(2)), rel=1e-12)
    inches = OptimizationData(merit=(Row("EFFL", weight=1.0),), unit=25.4)
    lens = dataclasses.replace(triplet, optimization_data=inches).with_conditions("efl=101.6 total_track<=127 edge>=1")
    assert [row.target for row in lens.optimization_data.merit] == pytest.approx([0, 4, 0, 5, 1 / 25.4])
    assert [(one.asked, one.reached) for one in attained_by(lens)[:2]] == [
        pytest.approx((101.6, efl(triplet))), pytest.approx((127.0, 116.485))
    ]  # fmt: skip


def test_a_condition_of_a_surface_that_is_gone_is_one_error(triplet):
    lens = triplet.with_conditions("thickness:6-7>=20 efl=100")
    fewer = dataclasses.replace(lens, surfaces=(*lens.surfaces[:5], lens.surfaces[8]), stop=2)
    said = "row 1 of the merit function, the condition TTHI>=20, names surface 6: this lens has surfaces 0 to 5"
    said = said.replace("row 1", "row 2")
    with pytest.raises(BadHold, match=re.escape(said)):
        _ = fewer.conditions
    with pytest.raises(BadHold, match="give the row another surface"):
        rt.optimize(fewer, merit="spot", vary="curvature", cycles=1)
    assert in_words(fewer.with_conditions("efl=100", only=True)) == "efl=100"
    with pytest.raises(BadHold, match="edge is a limit on one side; expected edge>=1 or edge<=1"):
        triplet.with_conditions("edge=1")


def test_edges_are_those_of_the_closed_form(triplet):
    lens = triplet.with_conditions("edge>=1")
    thicknesses = []
    for k in (1, 3, 6):
        h = max(float(lens.surfaces[j].semi_diameter) for j in (k, k + 1))
        front, back = (
            c * h * h / (1 + (1 - c * c * h * h) ** 0.5)
            for c in (float(lens.surfaces[j].curvature) for j in (k, k + 1))
        )
        thicknesses.append(float(lens.surfaces[k].thickness) + back - front)
    assert attained_by(lens)[0].reached == pytest.approx(min(thicknesses), rel=1e-14)


# -- files -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".zmx", ".csv", ".seq"])
def test_files_bring_conditions_back(triplet, tmp_path, suffix):
    lens = triplet.with_conditions(WORDS)
    rt.write_lens(lens, path := tmp_path / f"held{suffix}")
    again = rt.read_lens(path)
    assert again.conditions == lens.conditions
    assert again.optimization_data == lens.optimization_data


@pytest.mark.parametrize("suffix", [".zmx", ".csv", ".seq"])
def test_files_bring_variables_and_their_bounds_back(triplet, tmp_path, suffix):
    variables = (
        *(Vary(1, "curvature", bounds=(-0.01, 0.05)), Vary(2, "thickness", bounds=(1.0, 20.0))),
        *(Vary(4, "curvature"), Vary(6, "conic", bounds=(-float("inf"), 0.0)), Vary(7, "thickness")),
    )
    data = OptimizationData(variables, semi_diameters=(1, 2, 3, 4, 5, 6, 7, 8))
    lens = dataclasses.replace(triplet.replace(6, conic=0.0), optimization_data=data).with_conditions("efl=100")
    rt.write_lens(lens, path := tmp_path / f"varied{suffix}")
    assert {v.name: v.bounds for v in rt.read_lens(path).optimization_data.variables} == {
        v.name: v.bounds for v in variables
    }
    found = rt.optimize(path, merit=SPOT, cycles=3)
    assert efl(found.lens) == pytest.approx(100, rel=1e-6)
    assert [row.name for row in found.lens.optimization_data.merit].count("TRAC") == len(SPOT.rows(lens)) - 2
    assert rt.optimize(found.lens, cycles=1).merit_before == pytest.approx(found.merit_after, rel=1e-6)


@pytest.mark.needs(SHARED / "merit" / "dev")
@pytest.mark.parametrize("name", MERITS)
def test_rows_of_real_merit_functions_stay_as_they_are(name, tmp_path):
    lens = rt.read_lens(SHARED / "merit" / "dev" / name)
    data, path = lens.optimization_data, tmp_path / "held.zmx"
    held = lens.with_conditions("efl=100 total_track<=800 edge>=1 off:bfd>=2")
    assert held.optimization_data.merit[: len(data.merit)] == data.merit
    rt.write_lens(held, path)
    again = rt.read_lens(path)
    assert again.optimization_data.merit == held.optimization_data.merit
    assert again.conditions == held.conditions
    cleared = again.with_conditions((), only=True).optimization_data.merit
    kept = [row for row in cleared if row.name != "CONF"]
    assert kept == [row for row in data.merit if row.name != "CONF"]


def test_a_malformed_line_of_conditions_names_its_place(triplet, tmp_path):
    rt.write_lens(triplet.with_conditions("efl=100"), path := tmp_path / "held.csv")
    path.write_text(path.read_text().replace("efl=100", "elf=100"))
    with pytest.raises(rt.io.LensFileError, match=r"held.csv:\d+: .*'elf' is nothing to hold"):
        rt.read_lens(path)


def test_a_zmx_file_keeps_the_bounds_of_all_variables(triplet, tmp_path):
    variables = (
        Vary(1, "curvature", bounds=(-0.01, 0.05)),
        Vary(2, "thickness", bounds=(1.0, 20.0)),
        Vary(3, "conic", bounds=(-float("inf"), 0.0)),
    )
    data = OptimizationData(variables, merit=(Row("EFFL", target=100.0, weight=1.0),))
    lens = dataclasses.replace(triplet.replace(3, conic=-0.1), optimization_data=data)
    rt.write_lens(lens, path := tmp_path / "bounded.zmx")
    again = rt.read_lens(path).optimization_data
    assert {v.address: v.bounds for v in again.variables} == {v.address: v.bounds for v in variables}
    assert again.merit == data.merit


# -- optimisations -----------------------------------------------------------------------------------------------------


def test_an_optimisation_meets_the_conditions_of_the_lens_and_returns_them(triplet, tmp_path):
    lens = triplet.with_conditions("efl=100 total_track<=115")
    first = rt.optimize(lens, merit=SPOT, vary="curvature:1-4 sensor", hold="bfd>=75", cycles=8)
    assert [str(one.name) for one in first.conditions[:3]] == ["efl", "total_track", "bfd"]
    assert efl(first.lens) == pytest.approx(100, rel=1e-8)
    assert in_words(first.lens) == "efl=100 total_track<=115 bfd>=75"
    assert any(row.weight > 0 for row in first.lens.optimization_data.merit)
    rt.write_lens(first.lens, path := tmp_path / "first.zmx")
    again = rt.optimize(path, cycles=3)
    assert [condition.met for condition in again.conditions] == [True] * 3
    assert efl(again.lens) == pytest.approx(100, rel=1e-8)
    held = rt.optimize(
        triplet, merit=SPOT, vary="curvature:1-4 sensor", hold="efl=100 total_track<=115 bfd>=75", cycles=8
    )
    assert held.merit_after == pytest.approx(first.merit_after, rel=1e-12)
    assert held.lens.conditions == first.lens.conditions
    free = rt.optimize(path, hold=None, cycles=3)
    assert free.conditions == ()
    assert in_words(free.lens) == in_words(first.lens)
    assert free.merit_after < again.merit_after


def test_conditions_of_the_argument_alone(triplet):
    """`stored=False` leaves out the conditions of the lens, in descents, searches and cameras alike."""
    lens = triplet.with_conditions("efl=100 edge>=9")  # elements of 3 to 4 mm
    settings = {"merit": SPOT, "vary": "curvature:1-3 sensor", "hold": "total_track<=115", "stored": False}
    alone = rt.optimize(lens, cycles=4, **settings)
    assert [condition.name for condition in alone.conditions] == ["total_track"]
    assert in_words(alone.lens) == "efl=100 edge>=9 total_track<=115"
    same = rt.optimize(triplet, cycles=4, merit=SPOT, vary="curvature:1-3 sensor", hold="total_track<=115")
    assert alone.merit_after == same.merit_after
    with pytest.warns(ReplacedCondition, match="efl=95 replaces efl=100"):
        replaced = rt.optimize(lens, cycles=4, **settings | {"hold": "efl=95"})
    assert in_words(replaced.lens) == "edge>=9 efl=95"
    found = rt.search(lens, starts=4, **settings)
    assert in_words(found.lens) == in_words(alone.lens)
    assert rt.Variables(lens, "curvature:1-3", hold="total_track<=115", stored=False).conditions == (
        "total_track<=115",
    )


def test_an_argument_replaces_the_condition_of_the_lens_with_a_warning(triplet):
    lens = triplet.with_conditions("efl=100 edge>=1")
    with pytest.warns(ReplacedCondition, match="efl=95 replaces efl=100, a condition of the lens"):
        found = rt.optimize(lens, merit=SPOT, vary="curvature:1-3 sensor", hold="efl=95", cycles=6)
    assert efl(found.lens) == pytest.approx(95, rel=1e-8)
    assert in_words(found.lens) == "edge>=1 efl=95"
    off = rt.optimize(lens, merit=SPOT, vary="sensor", hold="off:efl=100", cycles=1)
    assert in_words(off.lens) == "edge>=1 off:efl=100"
    assert [condition.name for condition in off.conditions] == ["edge"]


def test_commands_honour_and_report_conditions(triplet, tmp_path, capsys):
    path = str(tmp_path / "held.csv")
    rt.write_lens(triplet.with_conditions("efl=100 edge>=1 off:bfd>=80"), path)
    line = ["optimize", path, "--merit", "spot", "--vary", "curvature:1-3", "sensor", "--cycles", "6", "--rings", "2"]
    assert main([*line, "-o", str(tmp_path / "better.zmx")]) == 0
    better = rt.read_lens(tmp_path / "better.zmx")
    assert in_words(better) == "efl=100 edge>=1 off:bfd>=80"
    assert efl(better) == pytest.approx(100, rel=1e-8)
    assert main([*line, "--no-hold", "-o", str(tmp_path / "free.zmx")]) == 0
    assert abs(efl(rt.read_lens(tmp_path / "free.zmx")) - 100) > 1e-3
    assert main([*line, "--no-hold", "--hold", "f_number=5.3", "-o", str(tmp_path / "other.zmx")]) == 0
    other = rt.read_lens(tmp_path / "other.zmx")
    assert abs(efl(other) - 100) > 1
    assert float(rt.first_order(other).f_number) == pytest.approx(5.3, rel=1e-6)
    assert in_words(other) == "efl=100 edge>=1 off:bfd>=80 f_number=5.3"
    capsys.readouterr()
    for command in ("info", "check", "evaluate"):
        assert main([command, path]) == 0
        text = capsys.readouterr().out
        assert re.search(r"efl +=  ?100 +101\.181 +not met", text), command
        assert re.search(r"edge +>= 1 +2\.57\d+", text), command
    assert "off:bfd>=80" in text or command == "evaluate"
    assert main(["info", path, "--json"]) == 0
    assert any("not met" in line for line in json.loads(capsys.readouterr().out)["conditions"])


def test_tolerances_report_a_nominal_lens_that_violates_its_conditions(triplet):
    lens = triplet.with_conditions("efl=90 edge>=1")
    with pytest.warns(NotReached, match="the nominal lens: efl=90 is not reached: 101.181"):
        rt.tolerance(lens, limits="radius=0.1%", trials=0)


def test_a_search_meets_the_conditions_of_the_lens():
    lens = rt.read_lens("singlet").with_conditions("efl=60 edge>=1")
    found = rt.search(lens, merit=SPOT, vary="curvature sensor", starts=1)
    assert efl(found.lens) == pytest.approx(60, rel=1e-6)
    assert in_words(found.lens) == "efl=60 edge>=1"


def test_variables_of_a_camera_have_the_conditions_of_the_lens(triplet):
    lens = triplet.with_conditions("total_track<=120 efl=101 off:edge>=1")
    assert rt.Variables(lens, "curvature sensor").conditions == ("total_track<=120", "efl=101")
    assert rt.Variables(lens, "curvature sensor", hold="efl bfd>=60").conditions == ("total_track<=120", "bfd>=60")


def test_boundaries_and_bounds_of_a_call_are_stored_once(triplet, tmp_path):
    first = rt.optimize(triplet, merit=SPOT, vary="curvature sensor", cycles=1)
    limited = rt.optimize(
        first.lens, merit=rt.Merit.of(first.lens, edge=1.0), bounds="curvature:-0.03..0.03", cycles=1
    ).lens
    count = len(first.lens.optimization_data.merit)
    assert [row.name for row in limited.optimization_data.merit[count:]] == ["MNEG"]
    assert limited.optimization_data.variables[0].bounds == (-0.03, 0.03)
    rt.write_lens(limited, path := tmp_path / "limited.zmx")
    again = rt.read_lens(path)
    assert again.optimization_data == limited.optimization_data
    assert rt.Merit.of(again, edge=1.0).rows == again.optimization_data.merit
    assert len(rt.Merit.of(again, edge=2.0)) == count + 2


def test_a_lens_with_many_boundaries_lists_those_that_are_not_met(triplet):
    rows = tuple(Row("CTGT", (k, 0), target=3.0, weight=1.0) for k in (1, 2, 3, 4, 5, 6, 7) for _ in range(3))
    lens = dataclasses.replace(triplet, optimization_data=OptimizationData(merit=rows))
    text = str(rt.info(lens))
    assert text.count("not met") == 6
    assert "and 9 more boundaries, met" in text
