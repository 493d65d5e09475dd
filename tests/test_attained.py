"""Attained values of constraints: contradictions are refused, violations are warned of."""

import dataclasses
import json
import re

import numpy as np
import pytest
from problems import fields, lens, surface

import raytrace as rt
from raytrace.cli import main
from raytrace.materials.glass import model_glass
from raytrace.optimization.attained import NotReached
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.problem import NoProblem
from raytrace.optimization.variables import DesignVariables
from raytrace.system.optimization_data import OptimizationData, Row, Vary

REFUSED = {
    "two numbers for one": ("curvature", "", "efl=100 efl=50", "efl=100 (now 101.181), efl=50", "exclude one another"),
    "an interval of nothing": ("curvature", "", "efl<=40 efl>=50", "efl<=40", "exclude one another"),
    "one follows from the other": ("curvature sensor", "", "efl=100 f_number=4", "f_number=4", "exclude one another"),
    "nothing moves it": ("sensor", "", "efl=50", "efl=50 (now 101.181)", "no variable moves it"),
    "bounds": (
        "thickness", "thickness:5..", "total_track<=30", "total_track<=30 (now", "out of reach within the bounds of ",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_conditions_that_no_lens_meets_are_refused_before_the_work(triplet, case):
    vary, bounds, hold, named, why = REFUSED[case]
    with pytest.raises(NoProblem) as error:
        rt.optimize(triplet, merit="spot", vary=vary, bounds=bounds or None, hold=hold, cycles=2)
    assert named in str(error.value)
    assert why in str(error.value)


@pytest.mark.parametrize(
    ("vary", "hold"),
    [
        ("curvature sensor", "efl=100 f_number=3.5"),
        ("curvature", "efl>=100 efl<=102"),
        ("thickness sensor", "total_track<=90"),  # not at the start
    ],
)
def test_conditions_that_a_lens_can_meet_are_not_refused(triplet, vary, hold):
    lens = triplet.at(entrance_pupil_diameter=100 / 3.5)
    found = rt.optimize(lens, merit="spot", vary=vary, hold=hold, cycles=12)
    assert not found.falls_short
    assert [one.met for one in found.conditions] == [True] * len(hold.split())


def test_a_search_refuses_them_too(triplet):
    with pytest.raises(NoProblem, match="exclude one another"):
        rt.search(triplet, merit="spot", vary="curvature", hold="efl=100 efl=50", starts=1)


def test_violations_are_in_text_document_and_figure(triplet):
    merit = rt.optimization.DefaultMerit("spot", air_thickness="0.1:90", glass_thickness="0.5:1")
    with pytest.warns(NotReached, match="MXCG 1 7 <= 1 .row 7. is not reached"):
        found = rt.optimize(triplet, merit=merit, vary="curvature", hold="efl=100", cycles=3)
    assert found.falls_short
    by_name = {one.name: one for one in found.conditions}
    assert by_name["efl"].met
    assert by_name["MNCG 1 7"].met
    assert by_name["MXCG 1 7"].reached == pytest.approx(
        max(float(found.lens.surfaces[k].thickness) for k in (1, 3, 6)), rel=1e-9
    )
    assert by_name["MXCG 1 7"].surface == 1
    assert "no variable moves it" in by_name["MXCG 1 7"].why
    document = json.loads(json.dumps(found.document()))["conditions"]
    assert [one["met"] for one in document] == [one.met for one in found.conditions]
    table = str(found)[str(found).index("condition ") :]
    assert "= 100" in table
    assert table.count("not met") == 1
    drawn = {text.get_text() for axes in found.plot().axes for text in axes.texts}
    assert any("MXCG 1 7" in text and "not met" in text for text in drawn)


def test_boundaries_are_met_within_a_micrometre_or_a_thousandth(triplet):
    found = rt.optimize(
        triplet, merit=rt.optimization.DefaultMerit("spot", air_thickness="0.5:90", edge=1.0, glass_thickness="2:9"),
        vary="curvature thickness", hold="efl=100", cycles=30,
    )  # fmt: skip
    assert not found.falls_short
    assert {one.name for one in found.conditions} == {
        *("efl", "MNCA 1 7", "MXCA 1 6", "MNEA 1 7", "MNCG 1 7", "MXCG 1 7", "MNEG 1 7")
    }


def test_rows_of_a_merit_function_are_boundaries_of_it(triplet):
    """Rows of arithmetic, by the value of the row that they bound; an exact row that nothing moves is refused."""
    rows = [
        *rt.Merit.default(triplet).rows,
        Row("EFFL", (0, 2), weight=0.0),
        Row("OPGT", (1, 0), target=500.0, weight=1e-9),
        Row("TOTR", target=1000.0, weight=-1.0),
    ]
    number = next(k for k, row in enumerate(rows, 1) if row.operand == "EFFL")
    rows[-2] = dataclasses.replace(rows[-2], integers=(number, 0))
    with pytest.raises(NoProblem, match=r"total_track=1000 \(now 116.485\): no variable moves it"):
        rt.optimize(triplet, merit=rows, vary="curvature", cycles=1)
    with pytest.warns(NotReached):
        found = rt.optimize(triplet, merit=rows[:-1], vary="curvature", cycles=1)
    (bound,) = found.conditions
    assert bound.reached == pytest.approx(float(rt.first_order(found.lens).effective_focal_length), rel=1e-9)
    assert "outweighs it" in bound.why


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("cooke_triplet --vary curvature --hold efl=100 efl=50 --cycles 5", "efl=100 (now 101.181), efl=50"),
        ("cooke_triplet --vary sensor --hold efl=50", "no variable moves it"),
        (
            "double_gauss --vary curvature thickness --hold efl=100 total_track<=40 --glass-thickness 5 --cycles 3",
            "total_track<=40 is not reached: ",
        ),
    ],
)
def test_commands_whose_conditions_are_not_met_exit_with_1(line, said, capsys):
    assert main(["optimize", *line.split(), "--merit", "spot"]) == 1
    assert said in capsys.readouterr().err


def test_a_lens_that_violates_a_constraint_is_still_written(tmp_path, capsys):
    path = tmp_path / "there.zmx"
    line = "optimize cooke_triplet --merit spot --vary sensor --glass-thickness 50 --cycles 1 -o"
    assert main([*line.split(), str(path)]) == 1
    assert rt.read_lens(path)
    captured = capsys.readouterr()
    assert "not met" in captured.out
    assert "warning: MNCG 1 7 >= 50" in captured.err


# -- a surface that does not reach its semi-diameter has no edge -------------------------------------------------------


def concave(curvature, conic=None):
    """A plate whose back is hollow, so that its edge is thick wherever there is one; semi-diameters of 10 mm."""
    glass = model_glass(1.6, 50.0)
    made = lens(
        [surface(0.0, 4.0, glass), surface(curvature, 30.0, conic=conic), surface(0.0, 1.0, glass), surface(0.0, 9.0)],
        aperture=("entrance_pupil_diameter", 2.0), field=fields("angle", (0.0,), (0.0,)),
    )  # fmt: skip
    sized = [dataclasses.replace(one, semi_diameter=10.0) for one in made.surfaces[1:-1]]
    surfaces = (made.surfaces[0], *sized, made.surfaces[-1])
    return dataclasses.replace(made, surfaces=surfaces, optimization_data=OptimizationData(semi_diameters=(1, 2, 3, 4)))


EDGES = {
    "MNEG": Row("MNEG", (1, 4), target=1.0, weight=1.0),
    "MXEG": Row("MXEG", (1, 4), target=80.0, weight=1.0),
    "MNEA": Row("MNEA", (1, 4), target=-30.0, weight=1.0),
    "MXEA": Row("MXEA", (1, 4), target=80.0, weight=1.0),
    "MNET": Row("MNET", (1, 4), target=-30.0, weight=1.0),
    "MXET": Row("MXET", (1, 4), target=80.0, weight=1.0),
    "ETGT": Row("ETGT", (1, 0), target=-30.0, weight=1.0),
    "ETLT": Row("ETLT", (2, 0), target=80.0, weight=1.0),
    "TTGT": Row("TTGT", (1, 0), target=-30.0, weight=1.0),
    "TTLT": Row("TTLT", (2, 0), target=80.0, weight=1.0),
}


@pytest.mark.parametrize("operand", EDGES)
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_surface_that_closes_before_its_edge_is_a_violation_that_points_inside(operand, sign):
    for part, conic in ((1.016, None), (1.3, None), (0.8, 1.0)):
        curvature = sign * part / 10
        model = DesignVariables(concave(curvature, conic), (Vary(2, "curvature"),))
        evaluation = Evaluation(model, [EDGES[operand]])
        found = evaluation(model.start, derivatives=True)
        q = part**2 * (1 if conic is None else 2)
        assert abs(found.residuals[0]) >= 0.5 * 10 * (q - 1) - 1e-9  # mm: what it falls short
        slope = found.residuals[0] * found.jacobian[0, 0] * sign
        assert np.isfinite(slope)
        assert slope > 0  # less curvature, less violation
    model = DesignVariables(concave(0.09), (Vary(2, "curvature"),))
    assert Evaluation(model, [EDGES[operand]])(model.start).merit == 0  # where it reaches it


@pytest.mark.parametrize("operand", ["ETVA", "TTVA", "MNET", "MXET"])
def test_edges_are_smooth_across_where_a_surface_closes(operand):
    """The slope is that of differences, and finite, from 0.99 to 1.5 of the curvature that closes."""
    row = dataclasses.replace(
        EDGES["MNET"], operand=operand, integers=(1, 0) if operand[2] == "V" else (1, 4), target=9.0
    )
    values = []
    for part in (0.99, 0.9999, 0.99995, 0.99997, 0.9999999, 1.00005, 1.01, 1.5):
        model = DesignVariables(concave(part / 10), (Vary(2, "curvature"),))
        evaluation, x, h = Evaluation(model, [row]), model.start, 1e-9
        found = evaluation(x, derivatives=True)
        ahead, back = evaluation(x + h), evaluation(x - h)
        by = (ahead.residuals[0] - back.residuals[0]) / (2 * h)
        assert found.jacobian[0, 0] == pytest.approx(by, rel=1e-3, abs=1e-3)  # second derivatives of 1e7 mm³ times h
        values.append(found.values[0])
    assert np.isfinite(values).all()
    assert np.abs(np.diff(values[1:6])).max() < 0.3  # mm, where a root alone has a slope without end


# -- several configurations --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_zoom_is_printed_and_drawn_in_all_its_configurations(triplet):
    zoom = triplet.with_configurations(thickness={2: [6.0, 9.0], 7: [77.4, 70.0]})
    found = rt.optimize(zoom, merit="spot", vary="thickness:2@1 thickness:2@2", cycles=1)
    text = str(found)
    assert re.search(r"^configuration +EFL before +EFL after +left\n +mm +mm +%$", text, re.M)
    lengths = [float(rt.first_order(one).effective_focal_length) for one in found.lens.configurations]
    assert all(f"{length:.8g}" in text for length in lengths)
    assert {one["configuration"] for one in found.document()["operands"]} == {1, 2}
    assert set(found.columns()["configuration"].tolist()) == {1, 2}
    titles = [axes.get_title() for axes in found.plot().axes]
    assert [
        sum(f"{when}, configuration {k} of 2" in title for title in titles)
        for when in ("Before", "After")
        for k in (1, 2)
    ] == [1] * 4


def test_a_search_reports_how_many_descents_reached_a_minimum(triplet):
    found = rt.search(triplet, merit="spot", vary="sensor", bounds="sensor:50,90", starts=6)
    assert found.descents == 4 + 4  # the best four of six starts, and four hops
    assert int(found.found.sum()) <= found.descents
    assert found.document()["descents"] == found.descents
    assert f"found: by how many of the {found.descents} descents" in str(found)
