"""Variables of a lens: which numbers they move, by how much, within what bounds."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from differences import slopes_by_differences
from problems import scalar
from torch.utils import _pytree as pytree

import raytrace as rt
from raytrace.imaging.camera import Camera
from raytrace.imaging.variables import (
    Limits,
    OtherLens,
    PhaseVariables,
    Variables,
    limits_of,
    violation,
)
from raytrace.io import read_lens
from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import AIR, MIRROR, constant, is_air, model_glass, nd
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.variables import DesignVariables, design_variables
from raytrace.system.lens import SystemAperture, with_sensor_distance
from raytrace.system.optimization_data import Row, Vary
from raytrace.system.parameter_paths import BadLimits, BadVariables, parameter_paths, parse_bounds, parse_range
from raytrace.system.sag_terms import ZernikeSag
from raytrace.system.surface import Surface, sag
from raytrace.wave_optics.element import Element, Rings

LENSES = Path(__file__).parents[1] / "lenses"
NANOMETRE = 1e-6


def test_at_the_start_the_lens_is_as_it_was():
    lens = read_lens("double_gauss")
    changed = Variables(lens, "sensor thickness:5,6 curvature:1-4 conic:1")()
    for before, after in zip(lens.surfaces, changed.surfaces, strict=True):
        assert float(before.thickness) == float(after.thickness)
        assert float(before.curvature or 0) == float((after.curvature if after.curvature is not None else 0) or 0)
    assert float(changed.surfaces[1].conic) == 0


def test_sensor_and_thicknesses_are_in_millimetres():
    variables = Variables(read_lens("double_gauss"), "sensor thickness:5")
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
    lens = read_lens("double_gauss")
    variables = Variables(lens, f"{kind}:10")
    edge = torch.tensor(lens.surfaces[10].semi_diameter ** 2, dtype=torch.float64)
    before = sag(variables().surfaces[10], edge)
    with torch.no_grad():
        getattr(variables, f"{kind}_10").add_(1e-3)
    assert float((sag(variables().surfaces[10], edge) - before).detach()) == pytest.approx(1e-3, rel=0.04)


def test_derivatives_reach_every_variable():
    variables = Variables(read_lens("double_gauss"), "sensor thickness:2 curvature:1,8 conic:3")
    lens = variables()
    total = lens.surfaces[-2].thickness + lens.surfaces[2].thickness + lens.surfaces[1].curvature
    (total + lens.surfaces[8].curvature + lens.surfaces[3].conic).backward()
    gradients = {variable.name: float(getattr(variables, variable.name).grad) for variable in variables.variables}
    assert gradients == {variable.name: variable.unit for variable in variables.variables}


def test_a_state_is_restored_by_name():
    one, other = (Variables(read_lens("double_gauss"), "sensor curvature:3") for _ in range(2))
    with torch.no_grad():
        one.sensor += 0.3
        one.curvature_3 -= 0.01
    other.load_state_dict(one.state_dict())
    assert one.numbers() == other.numbers()


LENS = read_lens("cooke_triplet")
ELEMENT = Element(
    Rings(torch.zeros(8, dtype=torch.float64), torch.tensor(0.1, dtype=torch.float64)),
    torch.tensor(0.8, dtype=torch.float64),
    find_glass("PMMA"),
)
OTHERS = {  # a module whose state is loaded into another -> the two, and words of the error
    "lens": (LENS, "sensor", {}, read_lens("tessar"), "sensor", {}, "Cooke triplet.* of 8 surfaces, not 'Tessar"),
    "thickness": (
        LENS,
        "sensor",
        {},
        LENS.replace(2, thickness=7.0),
        "sensor",
        {},
        "thickness 12.93 of surface 2, not 7",
    ),
    "glass": (
        LENS,
        "sensor",
        {},
        LENS.replace(1, glass=find_glass("N-BK7")),
        "sensor",
        {},
        "SK4' of surface 1, not 'N-BK7",
    ),
    "sensor": (
        LENS,
        "curvature:1",
        {},
        LENS.at(sensor_distance=77.0),
        "curvature:1",
        {},
        "thickness 77.405 of surface 7",
    ),
    "variables": (LENS, "sensor curvature:3", {}, LENS, "sensor", {}, "the variables sensor, curvature_3, not sensor"),
    "held": (LENS, "curvature:1-3", {"hold": "efl"}, LENS, "curvature:1-3", {}, "efl.* is held, not nothing"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_state_of_another_lens_is_refused_by_name_and_nothing_is_loaded(name):
    lens, vary, how, other, others, more, words = OTHERS[name]
    state = Variables(lens, vary, **how).state_dict()
    for entry in state.values():
        if entry.dtype != torch.uint8:
            entry.add_(0.25)
    variables = Variables(other, others, **more)
    camera = Camera(variables, torch.nn.Conv2d(1, 1, 1))
    with pytest.raises(OtherLens, match=words):
        variables.load_state_dict(state)
    with pytest.raises(OtherLens, match=words):
        camera.load_state_dict({f"variables.{key}": entry for key, entry in state.items()}, strict=False)
    assert not any(bool(p.any()) for p in variables.parameters())


def test_a_state_is_of_the_prescription_under_any_conditions_and_in_any_precision(tmp_path):
    """Wavelengths, aperture and precision change no meaning of an offset; what is loaded comes from a file."""
    one = Variables(LENS, "sensor curvature:3")
    with torch.no_grad():
        one.sensor += 0.25
    torch.save(one.state_dict(), tmp_path / "state.pt")
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    single = pytree.tree_map(lambda t: t.float() if isinstance(t, torch.Tensor) and t.is_floating_point() else t, LENS)
    for lens in (LENS.at(wavelengths=[0.5], f_number=8.0), LENS.at(object_distance=1e4), single):
        variables = Variables(lens, "sensor curvature:3")
        variables.load_state_dict(state)
        assert float(variables.sensor) == 0.25
    document = json.loads(bytes(state["_extra_state"].tolist()).decode())
    assert document["lens"] == LENS.name
    assert document["variables"]["sensor"] == [77.405, 1.0]


def test_a_state_of_an_older_version_is_refused_with_the_way_to_load_it():
    variables = Variables(LENS, "sensor")
    state = {"sensor": torch.tensor(0.25, dtype=torch.float64)}
    with pytest.raises(OtherLens, match=r"older version.* set state\['_extra_state'\]"):
        variables.load_state_dict(state)
    variables.load_state_dict(state | {"_extra_state": variables.get_extra_state()})
    assert float(variables.sensor) == 0.25
    with pytest.raises(OtherLens, match="its identity is damaged"):
        variables.load_state_dict(state | {"_extra_state": torch.tensor([91, 49, 93], dtype=torch.uint8)})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"unit": 1e-4}, "unit 0.001, not 0.0001"),
        ({"others": (ELEMENT,)}, "other others"),
        ({"basis": torch.ones(8, 8, dtype=torch.float64)}, "other basis"),
        ({"element": dataclasses.replace(ELEMENT, glass=find_glass("N-BK7"))}, "glass PMMA, not N-BK7"),
        ({"element": ELEMENT.with_numbers(ELEMENT.numbers + 1e-3)}, "other start"),
        ({"element": dataclasses.replace(ELEMENT, radius=ELEMENT.radius / 2)}, "aperture 1.6, not 0.8"),
    ],
)
def test_a_state_of_another_element_is_refused(change, words):
    state = PhaseVariables(ELEMENT).state_dict()
    PhaseVariables(ELEMENT).load_state_dict(state)
    with pytest.raises(OtherLens, match=f"the state is of an element of {words}"):
        PhaseVariables(**{"element": ELEMENT} | change).load_state_dict(state)


def test_bounds_hold_after_a_step():
    variables = Variables(
        read_lens("double_gauss"), "sensor curvature:3", bounds={"sensor": (57.0, 58.0), "curvature_3": (0.0, 0.03)}
    )
    with torch.no_grad():
        variables.sensor += 5.0
        variables.curvature_3 -= 100.0
    variables.project()
    numbers = variables.numbers()
    assert numbers["sensor"] == pytest.approx(58.0, abs=NANOMETRE)
    assert numbers["curvature_3"] == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(BadVariables, match="`bounds` for thickness_2, not among"):
        Variables(read_lens("double_gauss"), "sensor", bounds={"thickness_2": (0, 1)})


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ("", "no variables"),
        ("focus", "'focus': expected a number of a lens; did you mean sensor"),
        ("air", "'air': no 'air'; .*; did you mean thickness:"),
        ("focal", "'focal': no 'focal'; this lens has thickness, sensor"),
        ("sensor:3", "'sensor:3': expected sensor without surfaces"),
        ("glass:1", "glass_1 is a variable of optimize and jacobian alone"),
        ("curvature:4=-curvature:3", "leaves nothing to vary"),
        ("curvature:1,x", "'x' is no surface number"),
        ("thickness:12", "surface 12; this lens has surfaces 1 to 11"),
        ("thickness:0", "surface 0"),
    ],
)
def test_impossible_variables_are_refused(vary, message):
    with pytest.raises(BadVariables, match=message):
        Variables(read_lens("double_gauss"), vary)


def test_bounds_are_read_by_name():
    assert parse_bounds("sensor:57.5,58 curvature_3:-0.1,0") == {"sensor": (57.5, 58.0), "curvature_3": (-0.1, 0.0)}
    assert parse_bounds("") == {}
    assert parse_bounds("sensor:57.5,inf")["sensor"][1] == float("inf")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sensor", "'sensor': expected a variable and its bounds, like thickness_5:8..12"),
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
    lens, limits = with_sensor_distance(read_lens("double_gauss"), 57.9), Limits((1.0, math.inf), (0.05, math.inf), 0.5)
    assert float(violation(lens, limits)) == 0
    squeezed = with_thickness(lens, 1, 0.4)
    front, back = squeezed.surfaces[1:3]
    rim = max(front.semi_diameter, back.semi_diameter)  # of the element, at which both faces are taken
    curvatures = map(float, (front.curvature, back.curvature))
    near, far = (c * rim**2 / (1 + math.sqrt(1 - (c * rim) ** 2)) for c in curvatures)
    edge = 0.4 + far - near
    expected = (1.0 - 0.4) ** 2 + max(0.0, 0.5 - edge) ** 2
    assert float(violation(squeezed, limits)) == pytest.approx(expected, rel=1e-12)
    assert edge < 0.4
    # Air spaces: the two lenses would touch at the centre.
    assert float(violation(with_thickness(lens, 2, -0.1), limits)) > 0.15**2 - 1e-12


def with_thickness(lens, number, thickness):
    return lens.replace(number, thickness=torch.tensor(thickness, dtype=torch.float64))


@pytest.mark.parametrize("name", ["phone", "double_gauss"])
def test_an_element_lacks_thickness_whatever_its_glass_is_called(name):
    """By the medium's index: a glass of a table has none, air may have one. Each element in turn, 0.01 mm thick."""
    lens = read_lens(LENSES / f"{name}.zmx")
    limits = Limits((0.1, math.inf), (0.0, math.inf), 0.0)
    before = float(violation(lens, limits))
    elements = [k for k, surface in enumerate(lens.surfaces[1:-1], 1) if float(nd(surface.glass)) > 1.1]
    assert len(elements) == {"phone": 7, "double_gauss": 6}[name]
    for k in elements:
        thin = with_thickness(lens, k, 0.01)
        assert float(violation(thin, limits)) - before >= 0.09**2 - 1e-12
        unnamed = [
            dataclasses.replace(s, glass=dataclasses.replace(s.glass, name="" if k % 2 else "AIR"))
            for s in thin.surfaces
        ]
        assert float(violation(dataclasses.replace(thin, surfaces=tuple(unnamed)), limits)) == float(
            violation(thin, limits)
        )


def test_air_is_a_fact_of_the_medium():
    assert is_air(AIR)
    assert is_air(constant(1.0003, "NITROGEN"))
    assert is_air(model_glass(1.0, 0.0))
    assert not is_air(constant(1.5))
    assert not is_air(constant(1.31, "AIR"))
    assert not is_air(model_glass(1.5168, 64.2))
    assert not is_air(MIRROR)


def test_glass_behind_a_mirror_is_glass():
    """A Mangin mirror: the light runs back through 2 mm of glass, a space of the same medium."""
    glass = constant(1.5)
    surfaces = [
        Surface(thickness=torch.tensor(math.inf, dtype=torch.float64)),
        *(
            Surface(thickness=torch.tensor(t, dtype=torch.float64), glass=medium)
            for t, medium in ((2.0, glass), (-2.0, MIRROR), (-50.0, AIR), (0.0, AIR))
        ),
    ]
    lens = dataclasses.replace(read_lens("double_gauss"), surfaces=tuple(surfaces), stop=1)
    assert float(violation(lens, Limits((2.0, 5.0), (1.0, 10.0), 0.0))) == 0
    # Both ways through the glass lack 1 mm.
    assert float(violation(lens, Limits((3.0, 5.0), (1.0, 10.0), 0.0))) == pytest.approx(2.0, rel=1e-12)
    assert float(violation(lens, Limits((0.5, 1.5), (1.0, 10.0), 0.0))) == pytest.approx(0.5, rel=1e-12)


@pytest.mark.parametrize("name", sorted(path.stem for path in LENSES.glob("*.zmx")))
def test_shipped_lenses_keep_to_the_limits_of_their_size(name):
    """Real designs from 4 mm to 2.4 m: the smallest cover glass and the largest mirror."""
    assert float(violation(read_lens(LENSES / f"{name}.zmx"))) == 0


def test_limits_scale_with_the_lens():
    lens = read_lens("double_gauss")
    small = scaled(lens, 0.1)
    one, other = limits_of(lens), limits_of(small)
    assert one.glass[0] == pytest.approx(10 * other.glass[0], rel=1e-12)
    assert one.glass[0] == pytest.approx(58.45 / 50, rel=1e-3)
    assert (limits_of(lens, edge=0.3).edge, limits_of(lens, glass=(2.0, 15.0)).glass) == (0.3, (2.0, 15.0))
    thin = with_thickness(small, 1, 0.01)
    assert float(violation(thin)) == pytest.approx(1e-2 * float(violation(with_thickness(lens, 1, 0.1))), rel=1e-9)


def scaled(lens, factor):
    surfaces = [
        dataclasses.replace(
            s,
            curvature=None if s.curvature is None else s.curvature / factor,
            thickness=factor * s.thickness,
            semi_diameter=factor * s.semi_diameter if s.semi_diameter else s.semi_diameter,
        )
        for s in lens.surfaces
    ]
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def test_greatest_thicknesses_count_too():
    lens = read_lens("double_gauss")
    limits = limits_of(lens, glass=(1.0, 12.0), air=(0.1, 20.0))
    # 14 mm of glass behind surface 3; 26.68 mm from element to element across the stop; 58.5 mm to the sensor is free.
    whole = float(lens.surfaces[5].thickness + lens.surfaces[6].thickness)
    assert float(violation(lens, limits)) == pytest.approx(2.0**2 + (whole - 20) ** 2, rel=1e-9)
    own = Variables(lens, "thickness:3", glass_thickness=(1.0, 12.0))
    own.violation().backward()
    assert float(own.get_parameter("thickness_3").grad) == pytest.approx(2 * 2.0, rel=1e-9)


def test_ranges_are_read():
    assert parse_range("2:15") == (2.0, 15.0)
    assert parse_range("0.5") == (0.5, math.inf)
    for text, message in (("x", "'x': expected the least"), ("15:2", "found 15 and 2"), ("-1:2", "0 ≤ least")):
        with pytest.raises(BadLimits, match=message):
            parse_range(text)


def test_a_telescope_of_mirrors_can_be_built():
    assert float(violation(read_lens(LENSES / "hubble.zmx"))) == 0


def test_elements_either_side_of_a_stop_may_not_touch():
    """Each air space about the stop is buildable, the two elements would overlap by 3 mm beyond its rim."""
    variables = Variables(read_lens("double_gauss"), "thickness:5,6")
    with torch.no_grad():
        variables.get_parameter("thickness_5").fill_(2.4882 - 14.253)
        variables.get_parameter("thickness_6").fill_(2.1247 - 12.4281)
    assert float(variables.violation().detach()) > 1
    assert float(violation(read_lens("double_gauss"))) == 0


def test_every_number_of_a_shape_can_be_varied_by_its_name():
    """Coefficients by their power of r, those of sag terms by its fields; one unit is 1 mm of sag at the edge."""
    lens = read_lens("double_gauss").replace(3, coefficients=[1e-4, 2e-7, 0.0])
    bumps = ZernikeSag(torch.tensor([0.0, 1e-3, 0.0], dtype=torch.float64), torch.tensor(20.0, dtype=torch.float64))
    lens = lens.replace(5, sag_terms=bumps)
    names = ["curvature", "conic", *(f"coefficients{j}" for j in (1, 2, 3)), "radius"]
    assert list(parameter_paths(lens.surfaces[5])) == names
    variables = Variables(lens, "a4:3 coefficients2:5 radius:5")
    assert variables.numbers() == {"a4_3": 2e-7, "coefficients2_5": 1e-3, "radius_5": 20.0}
    edge = lens.surfaces[3].semi_diameter
    with torch.no_grad():
        variables.a4_3 += 1e-3
        variables.coefficients2_5 += 1e-3
    changed = variables()
    moved = sag(changed.surfaces[3], scalar(edge**2)) - sag(lens.surfaces[3], scalar(edge**2))
    assert float(moved) == pytest.approx(1e-3, rel=1e-9)
    assert changed.surfaces[5].sag_terms.coefficients[1] > 1e-3
    assert torch.equal(changed.surfaces[3].coefficients[[0, 2]], lens.surfaces[3].coefficients[[0, 2]])
    total = changed.surfaces[3].coefficients.sum() + changed.surfaces[5].sag_terms.radius
    total.backward()
    assert float(variables.a4_3.grad) == variables.variables[0].unit
    assert float(variables.radius_5.grad) == variables.variables[2].unit
    for wrong, words in (("coefficients2:3", "surface 3 has no coefficients2; it has"), ("a3:3", "no 'a3'")):
        with pytest.raises(BadVariables, match=words):
            Variables(lens, wrong)


def test_variable_syntax_is_that_of_optimize():
    """Kinds without surfaces, numbers that are 0 in the lens, and tilts, whose unit is 1 mm at the edge."""
    lens = read_lens("cooke_triplet")
    free = design_variables(lens, "curvature thickness a4:3 tilt:2 index:1")
    variables = Variables(lens, "curvature thickness a4:3 tilt:2 index:1")
    assert set(variables.names) == {one.name for one in free.variables}
    with torch.no_grad():
        variables.get_parameter("tilt_x_2").add_(1.0)
        variables.get_parameter("a4_3").add_(1e-3)
    changed, edge = variables(), lens.surfaces[2].semi_diameter
    assert float(changed.surfaces[2].before.tilt_x) == pytest.approx(math.degrees(1 / edge), rel=1e-12)
    edge = torch.tensor(lens.surfaces[3].semi_diameter ** 2, dtype=torch.float64)
    assert float(sag(changed.surfaces[3], edge) - sag(lens.surfaces[3], edge)) == pytest.approx(1e-3, rel=1e-9)
    bounded = Variables(lens, "curvature sensor", bounds="curvature:-0.1..0.1 sensor:70..")
    assert bounded.bounds["curvature_1"] == (-0.1, 0.1)
    assert bounded.bounds["sensor"] == (70.0, math.inf)


def test_variables_and_words_may_be_given_together():
    lens = rt.read_lens("cooke_triplet")
    free = design_variables(lens, [rt.system.Vary(1, "curvature", bounds=(0.01, 0.05)), "conic:3 thickness:2"])
    assert [(one.surface, one.quantity) for one in free.variables] == [(1, "curvature"), (3, "conic"), (2, "thickness")]
    assert free.variables[0].bounds == (0.01, 0.05)
    assert float(free.lens.surfaces[3].conic) == 0


BEAMS = [
    ("entrance_pupil_diameter", 30.0, math.inf, "off"),
    ("image_f_number", 3.2, math.inf, "real"),
    ("paraxial_working_f_number", 4.0, 1500.0, "off"),
    ("float_by_stop", 9.0, math.inf, "paraxial"),
    ("float_by_stop", 9.0, math.inf, "real"),
    ("object_na", 0.01, 1500.0, "off"),
    ("object_cone_angle", 0.6, 1500.0, "off"),
]


def beam(kind, size, distance, aiming):
    found = read_lens("double_gauss").at(ray_aiming=aiming, object_distance=distance)
    return dataclasses.replace(found, aperture=SystemAperture(kind, scalar(size)))


@pytest.mark.parametrize("case", BEAMS)
def test_rays_and_pupils_have_derivatives_by_the_system_aperture(case):
    """Also by the place of the stop: the thicknesses before and behind it."""
    lens = beam(*case)
    rows = [Row("REAY", (surface, 1), (0.0, *point), weight=1.0) for surface in (5, 11) for point in POINTS]
    rows += [Row("EPDI", weight=1.0), Row("WFNO", weight=1.0)]
    model = DesignVariables(lens, tuple(Vary(*at) for at in ((0, "aperture"), (4, "thickness"), (5, "thickness"))))
    assert [one.name for one in model.variables] == ["aperture", "thickness_4", "thickness_5"]
    evaluation = Evaluation(model, rows)
    found = evaluation(model.start, derivatives=True)
    assert not found.lost.any()
    assert (found.jacobian[:, 0] != 0).all()
    expected = slopes_by_differences(evaluation, model.start, 1e-4)
    factors = np.array([evaluation.factors[k] for k in found.of_row])[:, None]
    np.testing.assert_allclose(found.jacobian, factors * expected[found.of_row], rtol=1e-7, atol=1e-9)


POINTS = [(0.0, 0.0, 0.9), (0.7, 0.0, 0.8), (1.0, 0.5, -0.6)]


def test_the_radius_of_the_stop_is_a_variable_of_optimize():
    """F/4 is held: of EFL 99.5 mm the pupil is 24.875 mm wide, and the paraxial image of the stop's radius is half."""
    lens = beam("float_by_stop", 9.0, math.inf, "real")
    done = rt.optimize(
        lens, merit="spot", vary="thickness:4,5 sensor aperture", hold="efl=99.5 f_number=4", cycles=4
    ).lens
    pupil = rt.first_order(done).entrance_pupil_diameter
    assert float(pupil) == pytest.approx(99.5 / 4, rel=1e-9)
    assert float(done.aperture.value) != 9.0
    assert all(one.quantity != "aperture" for one in done.optimization_data.variables)


def test_the_system_aperture_is_a_parameter():
    lens = beam("float_by_stop", 9.0, math.inf, "real")
    variables = Variables(lens, "sensor aperture", bounds="aperture:5..9.5")
    assert variables.names == ("sensor", "aperture")
    rt.spot(variables(), fields=[0.0]).mean_square_radius.sum().backward()

    def square(radius):
        moved = dataclasses.replace(lens, aperture=SystemAperture("float_by_stop", scalar(radius)))
        return float(rt.spot(moved, fields=[0.0]).mean_square_radius.sum())

    by_radius = (square(9.0 + 1e-4) - square(9.0 - 1e-4)) / 2e-4
    assert float(variables.aperture.grad) == pytest.approx(0.9 * by_radius, rel=1e-6)
    with torch.no_grad():
        variables.aperture.add_(1.0)
    variables.project()
    assert variables.numbers()["aperture"] == pytest.approx(9.5, rel=1e-15)
    other = Variables(lens, "sensor aperture")
    other.load_state_dict(variables.state_dict())
    assert float(other().aperture.value.detach()) == pytest.approx(9.5, rel=1e-15)


@pytest.mark.parametrize("word", ["aperture:3", "aperture@2"])
def test_the_system_aperture_has_no_surface_and_no_configuration(word):
    with pytest.raises(BadVariables, match="aperture"):
        design_variables(read_lens("double_gauss"), word)
