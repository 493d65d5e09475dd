"""A focal-length constraint met by a solved number: exact in the lens, its derivatives and its bounds."""

import dataclasses

import pytest
import torch
from differences import gradcheck
from problems import focal_length

import raytrace as rt
from raytrace.imaging.closed_form import camera_error, even_distances, optimise_closed_form, patch_spectrum
from raytrace.imaging.codesign import closed_form, initial_camera, optimise
from raytrace.imaging.pictures import dead_leaves
from raytrace.imaging.training import Run
from raytrace.imaging.variables import OtherLens, Variables
from raytrace.io import read_lens
from raytrace.materials.glass import abbe_number, nd
from raytrace.maths.sampling import gauss_rings
from raytrace.optimization.attained import NotReached
from raytrace.optimization.variables import VariedGlass, design_variables
from raytrace.settings import CodesignSettings
from raytrace.system import configurations
from raytrace.system.lens import media, with_environment
from raytrace.system.optimization_data import OptimizationData
from raytrace.system.parameter_paths import BadVariables, parse_bounds
from raytrace.tracing.compiled import prepare
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.spot import image_rays

MICROMETRE = 1e-3
SPACES = "sensor thickness:2,9,5,6"
SMALL = CodesignSettings(
    optimizer="adam", depth=2, width=2, patch=16, size=7, epochs=1, batch=4, crops=2, vary=SPACES, hold="efl"
)


def moved(variables, **by):
    with torch.no_grad():
        for name, change in by.items():
            variables.get_parameter(name).add_(change)
    return variables


@pytest.mark.parametrize(
    ("vary", "solved"),
    [
        (SPACES, "thickness_6"),
        ("thickness:2,9 sensor", "thickness_9"),
        ("curvature:1,10 conic:3 sensor", "curvature_10"),  # a conic has no power
        ("thickness:5 curvature:4", "curvature_4"),
    ],
)
def test_the_last_variable_with_power_holds_the_focal_length(lens, vary, solved):
    variables = Variables(lens, vary, hold="efl")
    assert variables.held.by.name == solved
    assert solved not in dict(variables.named_parameters())
    assert list(variables.numbers()) == list(Variables(lens, vary).numbers())
    for name, one in list(variables.named_parameters()):
        moved(variables, **{name: 0.2 if name.startswith(("thickness", "sensor")) else 0.02})
        assert one.grad is None
    assert focal_length(variables()) == pytest.approx(focal_length(lens), rel=1e-12)
    assert variables.numbers()[solved] != pytest.approx(Variables(lens, vary).numbers()[solved], rel=1e-6)


def test_another_focal_length_in_mm(lens):
    assert focal_length(Variables(lens, SPACES, hold="efl=100")()) == pytest.approx(100, rel=1e-12)


def test_derivatives_through_the_solved_number(lens):
    """Of the lens alone, and of the error of its pictures, to central differences."""
    variables = Variables(lens, "thickness:2,9,5,6 curvature:1", hold="efl")
    free = {name: one for name, one in variables.named_parameters()}

    def numbers(*values):
        surfaces = torch.func.functional_call(variables, dict(zip(free, values, strict=True)), ()).surfaces
        return surfaces[6].thickness + surfaces[1].curvature

    given = [torch.full_like(one, 0.05).requires_grad_() for one in free.values()]
    assert gradcheck(numbers, given, eps=1e-5, rtol=1e-6)
    own = initial_camera(lens, dataclasses.replace(SMALL, model="gaussian"))
    spectrum, distances = patch_spectrum(dead_leaves(4, size=48), 22), even_distances(own, 5)
    own.plan()
    slope = torch.autograd.grad(camera_error(own, spectrum, distances), own.variables.thickness_2)[0]
    either_side = []
    for change in (1e-3, -2e-3):
        moved(own.variables, thickness_2=change)
        either_side.append(float(camera_error(own, spectrum, distances).detach()))
    assert float(slope) == pytest.approx((either_side[0] - either_side[1]) / 2e-3, rel=1e-4)


def test_a_lens_that_is_afocal_without_the_number_has_finite_derivatives():
    """A plano-convex singlet: with thin glass 1/f = (n - 1)(c₂ - c₃), so that c₃ follows c₂ one to one."""
    lens = read_lens("singlet")
    variables = Variables(lens, "thickness:2 curvature:2,3", hold="efl")
    assert variables.held.by.name == "curvature_3"
    assert variables.numbers()["curvature_3"] == pytest.approx(float(lens.surfaces[3].curvature), rel=1e-12)
    found = variables().surfaces[3].curvature
    thicker, bent = torch.autograd.grad(found, [variables.thickness_2, variables.curvature_2])
    assert float(thicker) == 0  # the power of the first surface is none
    number = next(one for one in variables.variables if one.name == "curvature_2")
    gap = 5.0 / float(media(lens, lens.primary)[2])
    power = 1 / focal_length(lens)
    assert float(bent) / number.unit == pytest.approx(1 - gap * power, rel=1e-9)  # φ₂ + φ₃ - (t/n) φ₂ φ₃ = φ


def test_a_diverging_lens_is_held(lens):
    variables = Variables(lens, "curvature:10", hold="efl=-200")
    assert focal_length(variables()) == pytest.approx(-200, rel=1e-12)


@pytest.mark.parametrize(
    ("vary", "hold", "bounds", "message"),
    [
        ("sensor", "efl", {}, "none of the variables changes the focal length; vary a thickness or a curvature"),
        (SPACES, "focus=3", {}, "'focus=3': 'focus' is nothing to hold; expected one of efl"),
        (SPACES, "efl total_track=x", {}, "'total_track=x': 'x' is no number"),
        (SPACES, "efl=x", {}, "hold 'efl=x': expected efl"),
        (SPACES, "efl=0", {}, "hold 'efl=0': expected efl, the focal length of the file, or one in mm"),
        (SPACES, "efl=1e400", {}, "hold 'efl=1e400': expected efl"),
        (SPACES, "efl=80", {}, "hold 'efl=80': thickness_6 would be -"),
        (
            SPACES,
            "efl=99",
            {"thickness_6": (12.0, 13.0)},
            "thickness_6 would be 11.*, not from 12 to 13; hold another",
        ),
    ],
)
def test_impossible_constraints_are_refused(lens, vary, hold, bounds, message):
    with pytest.raises(BadVariables, match=message):
        Variables(lens, vary, hold=hold, bounds=bounds)


def test_bounds_of_the_solved_number_are_a_penalty(lens):
    """The square of what it lacks, mm²; no step of an optimiser clamps it, for it is no parameter."""
    variables = Variables(lens, SPACES, hold="efl", bounds={"thickness_6": (12.4, 12.5)})
    assert (float(variables.violation().detach()), variables.beyond()) == (0.0, "")
    moved(variables, thickness_5=0.3)  # on the axis only the sum of both spaces about the stop counts
    assert variables.numbers()["thickness_6"] == pytest.approx(12.4281 - 0.3, abs=1e-6)
    assert float(variables.violation().detach()) == pytest.approx((12.4 - 12.1281) ** 2, rel=1e-3)
    assert variables.beyond().startswith("thickness_6 would be 12.128")
    variables.project()
    assert focal_length(variables()) == pytest.approx(focal_length(lens), rel=1e-12)


@pytest.mark.slow
def test_the_closed_form_holds_it_to_a_micrometre_within_all_bounds(lens):
    """With so little room for the spaces about the stop that the solved space is at an end of its bounds."""
    bounds = "thickness_2:0.1,1.5 thickness_9:0.1,1.5 thickness_5:14.2,14.3 thickness_6:12.4,12.5"
    settings = dataclasses.replace(SMALL, model="gaussian", size=21, bounds=bounds)
    found = closed_form(lens, settings, patch_spectrum(dead_leaves(4, size=64), 36))
    assert focal_length(found.lens) == pytest.approx(focal_length(lens), abs=MICROMETRE)
    for name, (low, high) in parse_bounds(bounds).items():
        assert low - MICROMETRE <= found.variables[name] <= high + MICROMETRE
    assert {"thickness_5", "thickness_6"} <= set(found.at_end)
    assert found.no_optimum == ""


def test_a_held_space_below_nothing_is_reported_with_the_end_of_the_sensor(lens):
    """It has no bounds of its own, while the sensor is at an end of its bounds."""
    bounds = "sensor:57,57.1 thickness_5:26.8,27"  # 26.68 mm is all the space about the stop
    own = initial_camera(lens, dataclasses.replace(SMALL, vary="sensor thickness:5,6", bounds=bounds, start="57.1"))
    spectrum, distances = patch_spectrum(dead_leaves(4, size=48), 22), even_distances(own, 5)
    found = optimise_closed_form(own, spectrum, distances=distances)
    assert {"sensor", "thickness_6"} <= set(found.at_end)
    assert "no optimum inside sensor from 57 to 57.1, " in found.no_optimum
    assert "thickness_6 from 0 to inf: the loss still falls at its end" in found.no_optimum


def test_training_holds_it(lens, tmp_path):
    """Every step of Adam, and a run that goes on knows its variables."""
    settings = dataclasses.replace(SMALL, model="gaussian", rate_optics=0.01)
    own = initial_camera(lens, settings)
    records = [record for _, record in optimise(own, dead_leaves(8, size=48), settings, Run(tmp_path / "run", {}))]
    assert len(records) == 4
    assert records[-1]["thickness_6"] != records[0]["thickness_6"]
    assert focal_length(own.variables()) == pytest.approx(focal_length(lens), abs=MICROMETRE)
    assert "variables.thickness_6" not in own.state_dict()


def test_conditions_are_met_after_every_step_and_thicknesses_are_within_their_limits(lens):
    """EFL, length and buildable thicknesses, exact to 1e-8 mm after random steps that violate all of them."""
    prepare()
    variables = Variables(
        lens, "curvature thickness sensor", hold="efl total_track<=160 buildable", glass_thickness=(2.0, 15.0), edge=1.0
    )
    length = float(first_order(lens).effective_focal_length)
    generator, violated = torch.Generator().manual_seed(0), 0.0
    for _ in range(4):
        with torch.no_grad():
            for parameter in variables.parameters():
                parameter.add_(0.3 * torch.randn((), generator=generator, dtype=parameter.dtype))
        violated = max(violated, float(variables.violation().detach()))
        variables.project()
        changed = variables()
        assert float(first_order(changed).effective_focal_length.detach()) == pytest.approx(length, abs=1e-8)
        track = sum(float(surface.thickness.detach()) for surface in changed.surfaces[1:-1])
        assert track <= 160 + 1e-7
        assert float(variables.violation().detach()) < 1e-14
    assert violated > 0.01


def test_the_projection_is_the_nearest_lens(lens):
    """Two thicknesses that are 1 mm too long together are shortened by half of that each."""
    total = sum(float(surface.thickness) for surface in lens.surfaces[2:5])
    variables = Variables(lens, "thickness:2,4", hold=f"thickness:2-4<={total!r} buildable")
    with torch.no_grad():
        variables.thickness_2.add_(1.0)
    before = variables.numbers()
    variables.project()
    after = variables.numbers()
    assert [before[name] - after[name] for name in before] == pytest.approx([0.5, 0.5], abs=1e-7)


@pytest.mark.slow
def test_lost_rays_are_brought_back(lens):
    """A curvature at which marginal rays miss the surface: after the projection the rays of all fields arrive."""
    prepare()
    variables = Variables(lens, "curvature:1-4")
    with torch.no_grad():
        variables.curvature_1.fill_((0.06 - variables.variables[0].start) / variables.variables[0].unit)
    lost = variables._constraints.problem.state(variables._values(), False).lost
    assert lost > 0
    variables.project()
    assert variables._constraints.problem.state(variables._values(), False).lost == 0


def test_a_condition_that_cannot_be_met_is_said(lens):
    variables = Variables(lens, "thickness:2", hold="total_track<=20 buildable")
    with pytest.warns(NotReached, match="total_track<=20"):
        variables.project()


def test_model_glasses_stay_within_the_catalog_and_snap_to_its_glasses():
    """Index and Abbe number beyond every glass come back to the hull; the nearest catalog glasses replace them."""
    prepare()
    lens = read_lens("cooke_triplet")
    with pytest.warns(VariedGlass):
        variables = Variables(
            lens, "index:1,3 abbe_number:1,3 curvature:1-7", hold="buildable catalog", catalog=["SCHOTT"]
        )
    with torch.no_grad():
        variables.index_1.add_(40.0)  # + 0.4
        variables.abbe_number_3.add_(-15.0)
    assert variables._glasses(variables._values(), False)[0].max() > 0.05
    variables.project()
    excess, slope = variables._glasses(variables._values(), True)
    assert -1e-9 < excess.max() < 1e-8
    numbers = variables._values()
    for column in range(4):
        moved = numbers.copy()
        moved[column] += 1e-3
        change = (variables._glasses(moved, False)[0] - excess) / 1e-3
        assert change.tolist() == pytest.approx(slope[:, column].tolist(), abs=1e-8)
    snapped = variables.snapped()
    assert {snapped.surfaces[k].glass.catalog for k in (1, 3)} == {"SCHOTT"}
    assert snapped.surfaces[6].glass.name == lens.surfaces[6].glass.name
    with pytest.raises(BadVariables, match="no glass varies"):
        Variables(lens, "curvature:1", hold="catalog")
    with pytest.raises(BadVariables, match="no glass varies"):
        Variables(lens, "curvature:1").snapped()


def test_glasses_of_the_file_snap_to_the_nearest_of_the_catalog():
    """SK4 and SF2 of the file are no longer made: current glasses have nearly the same numbers."""
    lens = read_lens("cooke_triplet")
    with pytest.warns(VariedGlass):
        variables = Variables(lens, "index:1,3 abbe_number:1,3", hold="catalog", catalog=["SCHOTT"])
    for k in (1, 3):
        one, other = (found.surfaces[k].glass for found in (variables.snapped(), lens))
        assert one.catalog == "SCHOTT"
        assert float(nd(one)) == pytest.approx(float(nd(other)), abs=3e-3)
        assert float(abbe_number(one)) == pytest.approx(float(abbe_number(other)), abs=1.0)


@pytest.mark.parametrize("name", ["double_gauss", "phone"])
def test_a_step_means_the_same_blur_for_every_variable(name):
    """A parameter of 1e-4 spreads the rays of all fields by 0.1 µm RMS, whether it is a space, a curvature or a4."""
    lens = read_lens(name)
    vary = {"double_gauss": "sensor thickness:2,5 curvature:1,7,11", "phone": "sensor thickness:3 curvature:4,11 a4:4"}
    variables = Variables(lens, vary[name], step="blur")
    pupil, weights = gauss_rings(6, 16)

    def hits():
        with torch.no_grad():
            found = image_rays(variables(), pupil)
        return found.position[:2], found.valid

    start, arrives = hits()
    for variable in variables.variables:
        with torch.no_grad():
            variables.get_parameter(variable.name).fill_(1e-4)
        moved, also = hits()
        weight = weights * (arrives & also)
        change = moved - start
        about = change - (weight * change).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True)
        blur = ((weight * about.square().sum(0)).sum() / weight.sum()).sqrt()
        assert float(blur) == pytest.approx(1e-4, rel=0.05), variable.name
        with torch.no_grad():
            variables.get_parameter(variable.name).zero_()
    ratio = [
        abs(one.unit / other.unit)
        for one, other in zip(variables.variables, Variables(lens, vary[name]).variables, strict=True)
    ]
    assert max(ratio) > 3 * min(ratio)
    with pytest.raises(BadVariables, match="step 'mm': expected sag or blur"):
        Variables(lens, "sensor", step="mm")


def test_a_frozen_lens_is_not_moved_and_a_frozen_number_neither(lens):
    prepare()
    variables = Variables(lens, "thickness:2,4 sensor", hold="thickness:2-4<=18.1 buildable")
    variables.requires_grad_(False)
    start = variables.numbers()
    variables.project()
    assert variables.numbers() == start
    variables.requires_grad_(True)
    variables.thickness_4.requires_grad_(False)
    variables.project()
    assert variables.numbers()["thickness_4"] == start["thickness_4"]
    assert sum(float(surface.thickness.detach()) for surface in variables().surfaces[2:5]) <= 18.1 + 1e-7


# -- solves, pickups, temperature and configurations -------------------------------------------------------------------

FOLLOWED = "curvature:1,3,10 curvature:8=-curvature:3 thickness:5 sensor=marginal_height(0)"


def test_solves_and_pickups_are_followed_with_derivatives(lens):
    """The paraxial image stays on the sensor, which is a number of the lens and no parameter."""
    variables = Variables(lens, FOLLOWED)
    assert tuple(dict(variables.named_parameters())) == variables.names
    assert variables.names == ("curvature_1", "curvature_3", "curvature_10", "thickness_5")
    moved(variables, curvature_3=0.05, thickness_5=0.3)
    changed = variables()
    assert float(changed.surfaces[8].curvature) == -float(changed.surfaces[3].curvature)
    distance = float(first_order(changed).paraxial_image_distance.detach())
    assert float(changed.surfaces[11].thickness) == pytest.approx(distance, rel=1e-12)

    def radius(*offsets):
        given = dict(zip(variables.names, offsets, strict=True))
        made = torch.func.functional_call(variables, given, ())
        return rt.spot(made, fields=[5.0]).whole.rms_radius.sum()

    assert gradcheck(radius, [one.detach().clone().requires_grad_() for one in variables.parameters()], rtol=1e-5)


def test_a_focal_length_is_held_with_pickups_by_a_number_that_they_leave_linear(lens):
    """The power of the lens is no linear function of curvature_3, which surface 8 picks up, but of curvature_10."""
    variables = Variables(lens, "curvature:1,10,3 curvature:8=-curvature:3 sensor=marginal_height(0)", hold="efl")
    assert variables.held.by.name == "curvature_10"
    moved(variables, curvature_1=0.1, curvature_3=-0.05)
    changed = variables()
    assert focal_length(changed) == pytest.approx(focal_length(lens), rel=1e-12)
    assert float(changed.surfaces[8].curvature) == -float(changed.surfaces[3].curvature)
    assert float(changed.surfaces[11].thickness) == pytest.approx(
        float(first_order(changed).paraxial_image_distance.detach()), rel=1e-12
    )
    assert variables.numbers()["curvature_10"] == float(changed.surfaces[10].curvature)
    with pytest.raises(BadVariables, match=r"none .*changes the focal length.*pickups"):
        Variables(lens, "curvature:3 curvature:8=-curvature:3", hold="efl")


def test_a_focal_length_is_held_before_a_pickup_with_power(lens):
    """Surface 8, behind the number that is solved, picks up curvature_1: the solve has the power that comes of it."""
    variables = moved(Variables(lens, "curvature:1,3 curvature:8=-0.1*curvature:1", hold="efl"), curvature_1=0.3)
    assert variables.held.by.name == "curvature_3"
    assert focal_length(variables()) == pytest.approx(focal_length(lens), rel=1e-12)

    def solved(offset):
        return torch.func.functional_call(variables, {"curvature_1": offset}, ()).surfaces[3].curvature

    assert gradcheck(solved, [variables.curvature_1.detach().clone().requires_grad_()], rtol=1e-6)


def test_the_projection_follows_solves(lens):
    prepare()
    length = sum(float(surface.thickness) for surface in lens.surfaces[1:-1])
    variables = Variables(lens, FOLLOWED, hold=f"total_track<={length - 1!r} buildable")
    variables.project()
    changed = variables()
    assert sum(float(surface.thickness.detach()) for surface in changed.surfaces[1:-1]) <= length - 1 + 1e-7
    assert float(changed.surfaces[11].thickness) == pytest.approx(
        float(first_order(changed).paraxial_image_distance.detach()), rel=1e-9
    )


def test_a_state_says_what_follows(lens):
    state = Variables(lens, FOLLOWED).state_dict()
    other = Variables(lens, FOLLOWED.replace("=-curvature:3", "=-curvature:1"))
    with pytest.raises(OtherLens, match=r"surface 8 = -1 × curvature of surface 3"):
        other.load_state_dict(state)


def test_solves_of_the_file_are_not_followed(lens):
    """The sensor stays where it is put, and the numbers of a word are those of a file without solves."""
    free = design_variables(lens, "curvature:1 sensor=marginal_height(0) curvature:3=curvature:1")
    data = OptimizationData(solves=free.solves)
    solved = dataclasses.replace(lens.at(sensor_distance=60.0), optimization_data=data)
    variables = moved(Variables(solved, "curvature"), curvature_1=0.05)
    assert variables.names == Variables(lens, "curvature").names
    assert float(variables().surfaces[11].thickness) == 60.0
    assert variables().optimization_data is data
    followed = moved(Variables(solved, "curvature:1 sensor=marginal_height(0)"), curvature_1=0.05)()
    distance = float(first_order(followed).paraxial_image_distance.detach())
    assert float(followed.surfaces[11].thickness) == pytest.approx(distance, rel=1e-12)


def test_temperature_and_pressure_are_parameters(lens):
    """The unit is 10 °C and 0.1 atm; the lens is in air of 20 °C and 1 atm where nothing else is given."""
    variables = Variables(lens, "temperature pressure sensor", bounds="temperature:-40..80")
    start = rt.spot(lens.at(temperature=20.0, pressure=1.0), fields=[5.0]).whole.rms_radius
    changed = variables()
    assert float(rt.spot(changed, fields=[5.0]).whole.rms_radius.detach()) == pytest.approx(float(start), rel=1e-12)
    rt.spot(changed, fields=[5.0]).whole.rms_radius.sum().backward()
    ends = [
        float(rt.spot(with_environment(lens, 20.0 + step, 1.0), fields=[5.0]).whole.rms_radius) for step in (0.1, -0.1)
    ]
    assert float(variables.temperature.grad) == pytest.approx(10 * (ends[0] - ends[1]) / 0.2, rel=1e-5)
    moved(variables, temperature=100.0)
    variables.project()
    assert variables.numbers()["temperature"] == pytest.approx(80.0, rel=1e-15)
    assert Variables(lens, "curvature:10 temperature pressure", hold="efl").held.by.name == "curvature_10"


def test_a_number_of_one_configuration_is_a_parameter(lens):
    zoom = configurations.made(lens, thickness={5: [14.0, 15.0]})
    variables = moved(Variables(zoom, "thickness:5 sensor"), **{"thickness_5@2": 0.5, "thickness_5@1": -0.25})
    changed = variables()
    thicknesses = [float(one.surfaces[5].thickness.detach()) for one in (changed, *changed.configurations)]
    assert thicknesses == [13.75, 13.75, 15.5]


def test_solves_are_followed_in_single_precision(lens):
    variables = moved(Variables(lens, FOLLOWED, hold="efl").float(), curvature_1=0.02)
    changed = variables()
    assert changed.surfaces[11].thickness.dtype == torch.float32
    exact = moved(Variables(lens, FOLLOWED, hold="efl"), curvature_1=0.02)()
    assert float(changed.surfaces[11].thickness) == pytest.approx(float(exact.surfaces[11].thickness), rel=1e-5)


@pytest.mark.slow
def test_a_camera_is_trained_with_what_follows(lens):
    camera = rt.Camera(Variables(lens, FOLLOWED, step="blur"), torch.nn.Conv2d(1, 1, 1), model="paraxial", pixels=9)
    optimizer = torch.optim.SGD(camera.variables.parameters(), 1e-4)
    before = camera.variables.numbers()
    camera(torch.rand(1, 16, 16), torch.tensor([2e4])).mean().backward()
    assert all(bool(one.grad.isfinite()) and float(one.grad) for one in camera.variables.parameters())
    optimizer.step()
    assert camera.variables.numbers() != before
    changed = camera.variables()
    distance = float(first_order(changed).paraxial_image_distance.detach())
    assert float(changed.surfaces[11].thickness) == pytest.approx(distance, rel=1e-12)
