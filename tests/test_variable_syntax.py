"""Syntax of variables, solves and pickups."""

import math
import re

import numpy as np
import pytest

import raytrace as rt
from raytrace.materials.glass import abbe_number, nd
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.variables import DesignVariables, VariedGlass, bounds_of, design_variables
from raytrace.system.optimization_data import OptimizationData, Solve, Vary
from raytrace.system.parameter_paths import BadVariables


@pytest.fixture(scope="module")
def zoom(lens):
    return lens.with_configurations(thickness={6: [12.4281, 16.0], 11: [57.9, 52.0]})


def names(lens, vary):
    return [one.name for one in design_variables(lens, vary).variables]


def test_a_kind_alone_means_every_surface_where_it_makes_sense(lens):
    assert names(lens, "curvature") == [f"curvature_{k}" for k in (1, 2, 3, 4, 5, 7, 8, 9, 10, 11)]  # not the stop
    assert names(lens, "thickness") == [f"thickness_{k}" for k in range(1, 12)]
    assert names(lens, "glass") == [f"glass_{k}" for k in (1, 3, 4, 7, 8, 10)]
    assert names(lens.replace(4, conic=-0.5), "conic") == ["conic_4"]
    assert names(lens, "sensor") == ["thickness_11"]
    assert names(rt.read_lens("hubble"), "curvature conic") == ["curvature_1", "curvature_2", "conic_1", "conic_2"] or (
        {one.split("_")[0] for one in names(rt.read_lens("hubble"), "curvature conic")} == {"curvature", "conic"}
    )


def test_surfaces_and_groups(lens):
    assert names(lens, "curvature:1-3,7 thickness:5, 6") == [
        *("curvature_1", "curvature_2", "curvature_3", "curvature_7", "thickness_5", "thickness_6")
    ]
    assert names(lens, "tilt:5 decentre:4") == ["tilt_x_5", "tilt_y_5", "x_4", "y_4"]
    assert names(lens, "sensor thickness:11 thickness") == ["thickness_11", *(f"thickness_{k}" for k in range(1, 11))]


def test_absent_terms_vary_from_zero(lens):
    """Terms of an asphere, a conic and a pose are 0 at the start, and the lens is what it was."""
    found = design_variables(lens, "a4:3 a8:3 conic:3 tilt:5 curvature:6")
    model = found
    np.testing.assert_array_equal(model.start, np.zeros(6))
    assert found.lens.surfaces[3].coefficients.tolist() == [0, 0, 0, 0]
    moved = model.start + np.array([1e-6, 1e-12, -0.1, 0.01, 0.02, 1e-4])
    at = model.lens_at(moved)
    assert float(at.surfaces[3].coefficients[1]) == 1e-6
    assert float(at.surfaces[5].before.tilt_y) == 0.02
    same, other = (rt.spot(one, fields=[7]).rms_radius for one in (lens, model.lens_at(model.start)))
    assert float((same - other).abs().max()) < 1e-12


@pytest.mark.slow
def test_pose_and_shape_of_the_image_vary(lens):
    """With the derivatives of differences, of rays on the image, their path and their wavefront."""
    words = "tilt:12 decentre:12 tilt_z:12 z:12 curvature:12 conic:12"
    lens = lens.replace(12, tilt_x=1.0, x=0.1, curvature=1e-3)
    found = design_variables(lens, words)
    assert [one.name for one in found.variables][:4] == ["tilt_x_12", "tilt_y_12", "x_12", "y_12"]
    model = DesignVariables(found.lens, found.variables)
    rays = [rt.system.Row(name, (12, 1), (0.3, 1.0, 0.2, 0.5), weight=1.0) for name in ("REAX", "REAY", "REAZ", "RAID")]
    evaluation = Evaluation(model, [*rays, rt.system.Row("OPDC", (0, 1), (0.0, 1.0, 0.2, 0.5), weight=1.0)])
    step = 1e-5
    for k, by in enumerate(evaluation(model.start, derivatives=True).jacobian.T):
        ends = [evaluation(model.start + side * step * np.eye(len(model.start))[k]).residuals for side in (1, -1)]
        assert by == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6, abs=1e-6), found.variables[k]


@pytest.mark.slow
def test_the_image_of_a_tilted_lens_follows_scheimpflug():
    """An object at d, a lens tilted by θ: u = d/cos θ along its axis, and tan θ′ = (v/u) tan θ of the image."""
    distance, focal, tilt = 150.0, 50.0, math.radians(10.0)
    row = dict(
        curvature=0.0, thickness=70.0, tilt_x=math.degrees(tilt), phase=rt.system.IdealLens(1 / focal, 1 / focal)
    )
    lens = rt.lens([row], stop=1, entrance_pupil_diameter=10.0, object_distance=distance, fields=[-5.0, 5.0])
    found = rt.optimize(lens, merit=rt.optimization.DefaultMerit("spot", rings=1), vary="tilt_x:2 sensor").lens
    u = distance / math.cos(tilt)
    v = 1 / (1 / focal - 1 / u)
    assert float(found.surfaces[1].thickness) == pytest.approx(v, rel=1e-6)
    assert abs(float(found.surfaces[2].before.tilt_x)) == pytest.approx(
        math.degrees(math.atan(v / u * math.tan(tilt))), rel=1e-6
    )
    assert float(rt.spot(found).rms_radius.max()) < 1e-6


def test_a_glass_of_a_catalog_varies_as_a_model_glass(lens):
    """It has the same index, dispersion and partial dispersion, and one warning for each surface says so."""
    with pytest.warns(VariedGlass, match=r"model glass, .* off by") as said:
        found = design_variables(lens, "index abbe_number:3")
    assert len(said) == len(found.variables) - 1 == 6
    model = DesignVariables(found.lens, found.variables)
    for number, k in zip(model.start, (1, 3, 4, 7, 8, 10), strict=False):
        assert number == pytest.approx(float(nd(lens.surfaces[k].glass)), rel=1e-12)
    assert model.start[-1] == pytest.approx(float(abbe_number(lens.surfaces[3].glass)), rel=1e-12)
    before, after = (float(rt.first_order(one).effective_focal_length) for one in (lens, model.lens_at(model.start)))
    assert after == pytest.approx(before, rel=1e-4)


def test_numbers_that_differ_between_configurations_vary_in_each(zoom):
    assert names(zoom, "thickness")[5:7] == ["thickness_6@1", "thickness_6@2"]
    assert names(zoom, "thickness:6@2") == ["thickness_6@2"]
    assert names(zoom, "thickness@2") == ["thickness_6@2", "thickness_11@2"]
    assert names(zoom, "sensor") == ["thickness_11@1", "thickness_11@2"]
    model = DesignVariables(zoom, design_variables(zoom, "thickness:5,6").variables)
    assert model.start == pytest.approx([float(zoom.surfaces[5].thickness), 12.4281, 16.0])


def test_solves_and_pickups(lens):
    (pickup,) = design_variables(lens, "thickness curvature:4 = - 2 * curvature:3 + 0.001").solves
    assert (pickup.surface, pickup.quantity, pickup.kind) == (4, "curvature", "pickup")
    assert (pickup.source, pickup.scale, pickup.offset) == (3, -2.0, 0.001)
    (solve,) = design_variables(lens, "thickness curvature:11=f_number(4)").solves
    assert (solve.kind, solve.numbers) == ("f_number", (4.0,))
    (solve,) = design_variables(lens, "curvature sensor=marginal_height(0)").solves
    assert (solve.surface, solve.quantity, solve.numbers) == (11, "thickness", (0.0, 0.0))
    found = design_variables(lens, "curvature curvature:4=-curvature:3")
    assert "curvature_4" not in [one.name for one in found.variables]
    both = design_variables(lens, "curvature thickness:5,7=thickness:2").solves
    assert [(one.surface, one.source) for one in both] == [(5, 2), (7, 2)]


def test_a_lens_keeps_its_solves(lens):
    found = design_variables(lens, "curvature:1,3 curvature:5=-curvature:3 curvature:11=f_number(2.5)")
    model = found
    at = model.lens_at(model.start * [1.01, 0.99])
    assert float(at.surfaces[5].curvature) == -float(at.surfaces[3].curvature)
    at = at.at(object_distance=float("inf"))
    assert float(rt.first_order(at).effective_focal_length / rt.first_order(at).entrance_pupil_diameter) == (
        pytest.approx(2.5, rel=1e-12)
    )


def test_variables_of_the_file_apply_unless_specified_otherwise(lens):
    import dataclasses

    solve = Solve(11, "thickness", "marginal_height", (0.0, 0.0))
    lens = dataclasses.replace(lens, optimization_data=OptimizationData((Vary(1, "curvature"),), (solve,)))
    own = design_variables(lens)
    assert (names(lens, None), own.solves) == (["curvature_1"], (solve,))
    assert design_variables(lens, "curvature").solves == (solve,)
    assert "thickness_11" not in names(lens, "thickness")
    assert design_variables(lens, "sensor").solves == ()
    (other,) = design_variables(lens, "curvature sensor=thickness:1").solves
    assert other.kind == "pickup"


@pytest.mark.parametrize(
    ("vary", "said"),
    [
        ("", "leaves nothing to vary"),
        ("curvatur", "did you mean curvature?"),
        ("radius:3", "did you mean curvature?"),
        ("focus", "did you mean sensor?"),
        ("conic", "name surfaces, as conic:3"),
        ("curvature:13", "this lens has surfaces 1 to 12 to vary"),
        ("thickness:12", "this lens has surfaces 1 to 11 to vary"),
        ("thickness:0", "surface 0"),
        ("a3:3", "no 'a3'"),
        ("index:2", "behind surface 2 there is no glass"),
        ("curvature:1,x", "'x' is no surface number"),
        ("thickness:5@2", "no such number differs in configuration 2"),
        ("curvature:3 curvature:3=curvature:4", "is to vary and to follow"),
        ("thickness curvature:3=curvature:3", "cannot follow itself"),
        ("thickness curvature:4=curvature:5 curvature:5=curvature:4", "follows itself, by way of other numbers"),
        ("thickness curvature:11=fnumber(4)", "did you mean f_number?"),
        ("thickness curvature:11=f_number(x)", "'x' are no numbers"),
        ("curvature thickness:11=f_number(4)", "f_number solves for a curvature, by 1 number(s)"),
        ("curvature thickness:11=3", "expected a number that it follows"),
    ],
)
def test_impossible_variables_are_refused(lens, vary, said):
    with pytest.raises(BadVariables, match=re.escape(said)):
        design_variables(lens, vary)


def test_without_variables_in_the_file_words_are_asked_for(lens):
    with pytest.raises(BadVariables, match="`vary` names them"):
        design_variables(rt.lens([dict(radius=50, thickness=5, glass="N-BK7"), dict(thickness=95)], stop=1, f_number=5))


def test_bounds_by_kind_surface_and_configuration(zoom):
    found = design_variables(zoom, "thickness:5,6 sensor curvature:3 tilt:4")
    low, high = bounds_of(found.lens, found.variables, "thickness:2..15 thickness_6@2:14..20 sensor:50,60 tilt:-1..1")
    ranges = dict(zip((v.name for v in found.variables), zip(low, high, strict=True), strict=True))
    inf = np.inf
    assert ranges == {
        "thickness_5": (2, 15),
        "thickness_6@1": (2, 15),
        "thickness_6@2": (14, 20),
        "thickness_11@1": (50, 60),
        "thickness_11@2": (50, 60),
        "curvature_3": (-inf, inf),
        "tilt_x_4": (-1, 1),
        "tilt_y_4": (-1, 1),
    }
    low, high = bounds_of(found.lens, found.variables, "thickness:5-6:3.. curvature_3:..0")
    assert low.tolist() == [3, 3, 3, -inf, -inf, -inf, -inf, -inf]
    assert high[5] == 0
    with pytest.raises(BadVariables, match="did you mean curvature_3"):
        bounds_of(found.lens, found.variables, "curvatur_3:0,1")
    free = design_variables(zoom, [*["curvature:3", "thickness:5"]])
    own = [Vary(3, "curvature", bounds=(0.01, 0.05)), free.variables[1]]
    low, high = bounds_of(zoom, own, "thickness:1..")
    assert (low.tolist(), high.tolist()) == ([0.01, 1.0], [0.05, inf])
    with pytest.raises(BadVariables, match="15 is not less than 2"):
        bounds_of(found.lens, found.variables, "thickness:15..2")
