"""Variables of a lens: which numbers they move, by how much, within what bounds."""

import dataclasses
from pathlib import Path

import pytest
import torch

from raytrace.design.variables import BadVariables, Variables, edge_thickness, parse_bounds, violation
from raytrace.formats import read_lens
from raytrace.lens import with_sensor_distance
from raytrace.surface import sag

LENSES = Path(__file__).parents[1] / "lenses"
NANOMETRE = 1e-6


def double_gauss():
    return read_lens(LENSES / "double_gauss.zmx")


def test_at_the_start_the_lens_is_as_it_was():
    lens = double_gauss()
    changed = Variables(lens, "sensor thickness:5,6 curvature:1-4 conic:1")()
    for before, after in zip(lens.surfaces, changed.surfaces, strict=True):
        assert float(before.thickness) == float(after.thickness)
        assert float(before.curvature or 0) == float((after.curvature if after.curvature is not None else 0) or 0)
    assert float(changed.surfaces[1].conic) == 0


def test_sensor_and_thicknesses_are_in_millimetres():
    variables = Variables(double_gauss(), "sensor thickness:5")
    start = variables.numbers()
    with torch.no_grad():
        variables.sensor += 0.1
        variables.thickness_5 -= 0.2
    after = variables.numbers()
    assert after["sensor"] - start["sensor"] == pytest.approx(0.1, abs=NANOMETRE)
    assert after["thickness_5"] - start["thickness_5"] == pytest.approx(-0.2, abs=NANOMETRE)


@pytest.mark.parametrize("kind", ["curvature", "conic"])
def test_shapes_are_counted_in_sag_at_the_edge(kind):
    """The units hold the first term of the series of the sag: within 4 % on a surface as flat as r/R = 0.2."""
    lens = double_gauss()
    variables = Variables(lens, f"{kind}:10")
    edge = torch.tensor(lens.surfaces[10].semi_diameter ** 2, dtype=torch.float64)
    before = sag(variables().surfaces[10], edge)
    with torch.no_grad():
        getattr(variables, f"{kind}_10").add_(1e-3)
    assert float((sag(variables().surfaces[10], edge) - before).detach()) == pytest.approx(1e-3, rel=0.04)


def test_derivatives_reach_every_variable():
    variables = Variables(double_gauss(), "sensor thickness:2 curvature:1,8 conic:3")
    lens = variables()
    total = lens.surfaces[-2].thickness + lens.surfaces[2].thickness + lens.surfaces[1].curvature
    (total + lens.surfaces[8].curvature + lens.surfaces[3].conic).backward()
    gradients = {variable.name: float(getattr(variables, variable.name).grad) for variable in variables.variables}
    assert gradients == {variable.name: variable.unit for variable in variables.variables}


def test_a_state_is_restored_by_name():
    one, other = (Variables(double_gauss(), "sensor curvature:3") for _ in range(2))
    with torch.no_grad():
        one.sensor += 0.3
        one.curvature_3 -= 0.01
    other.load_state_dict(one.state_dict())
    assert one.numbers() == other.numbers()
    with pytest.raises(RuntimeError, match="curvature_3"):
        Variables(double_gauss(), "sensor").load_state_dict(one.state_dict())


def test_bounds_hold_after_a_step():
    variables = Variables(
        double_gauss(), "sensor curvature:3", bounds={"sensor": (57.0, 58.0), "curvature_3": (0.0, 0.03)}
    )
    with torch.no_grad():
        variables.sensor += 5.0
        variables.curvature_3 -= 100.0
    variables.project()
    numbers = variables.numbers()
    assert numbers["sensor"] == pytest.approx(58.0, abs=NANOMETRE)
    assert numbers["curvature_3"] == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(BadVariables, match="bounds for thickness_2, not among the variables"):
        Variables(double_gauss(), "sensor", bounds={"thickness_2": (0, 1)})


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ("", "no variables"),
        ("focus", "'focus': expected sensor, or one of thickness"),
        ("thickness", "'thickness': expected sensor, or one of"),
        ("sensor:3", "'sensor:3': expected sensor"),
        ("curvature:1,x", "'x' is no surface number"),
        ("thickness:12", "surface 12; this lens has surfaces 1 to 11"),
        ("thickness:0", "surface 0"),
    ],
)
def test_what_cannot_be_varied_is_refused(vary, message):
    with pytest.raises(BadVariables, match=message):
        Variables(double_gauss(), vary)


def test_bounds_are_read_by_name():
    assert parse_bounds("sensor:57.5,58 curvature_3:-0.1,0") == {"sensor": (57.5, 58.0), "curvature_3": (-0.1, 0.0)}
    assert parse_bounds("") == {}
    assert parse_bounds("sensor:57.5,inf")["sensor"][1] == float("inf")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sensor", "'sensor': expected a variable and its bounds, like thickness_5:8,12"),
        ("sensor:57", "'sensor:57': expected a variable and its bounds"),
        ("sensor:57,58,59", "'sensor:57,58,59': expected a variable and its bounds"),
        ("conic_1:-1,0 sensor:57,x", "'sensor:57,x': expected a variable and its bounds"),
        ("sensor:58,57.5", "'sensor:58,57.5': 58 is not less than 57.5"),
        ("sensor:58,58", "'sensor:58,58': 58 is not less than 58"),
        ("sensor:nan,58", "'sensor:nan,58': nan is not less than 58"),
    ],
)
def test_bounds_that_cannot_be_read_are_refused(text, message):
    with pytest.raises(BadVariables, match=message):
        parse_bounds(text)


def test_a_real_lens_can_be_built_and_a_squeezed_one_cannot():
    lens = with_sensor_distance(double_gauss(), 57.9)
    assert float(violation(lens)) == 0
    surfaces = list(lens.surfaces)
    surfaces[1] = dataclasses.replace(surfaces[1], thickness=torch.tensor(0.4, dtype=torch.float64))
    squeezed = dataclasses.replace(lens, surfaces=tuple(surfaces))
    edge = float(edge_thickness(squeezed.surfaces[1], squeezed.surfaces[2]))
    expected = (1.0 - 0.4) ** 2 + max(0.0, 0.5 - edge) ** 2
    assert float(violation(squeezed)) == pytest.approx(expected, rel=1e-12)
    assert edge < 0.4
    # Air spaces: the two lenses would touch at the centre.
    surfaces = list(lens.surfaces)
    surfaces[2] = dataclasses.replace(surfaces[2], thickness=torch.tensor(-0.1, dtype=torch.float64))
    assert float(violation(dataclasses.replace(lens, surfaces=tuple(surfaces)))) > 0.15**2 - 1e-12


def test_a_telescope_of_mirrors_can_be_built():
    assert float(violation(read_lens(LENSES / "hubble.zmx"))) == 0


def test_elements_either_side_of_a_stop_may_not_touch():
    """Each air space beside the stop is buildable, the two elements would overlap by 3 mm beyond its rim."""
    variables = Variables(double_gauss(), "thickness:5,6")
    with torch.no_grad():
        variables.get_parameter("thickness_5").fill_(2.4882 - 14.253)
        variables.get_parameter("thickness_6").fill_(2.1247 - 12.4281)
    assert float(variables.violation().detach()) > 1
    assert float(violation(double_gauss())) == 0
