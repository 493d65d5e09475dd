"""Solves: what follows meets its rule, wherever the variables are, with derivatives; and one that waits for another."""

import dataclasses

import numpy as np
import pytest
import torch
from test_corpus import CORPUS
from test_operands_boundaries import semi_diameters

import raytrace as rt
from raytrace.materials.glass import model_glass, refractive_index
from raytrace.maths.numerics import Dual, slope_of, value_of
from raytrace.optimization.lens_state import SOLVES
from raytrace.optimization.variables import DesignVariables, design_variables
from raytrace.system import configurations
from raytrace.system.configurations import ScaledPath
from raytrace.system.optimization_data import OptimizationData, Solve, Vary
from raytrace.system.surface import sag
from raytrace.tracing.launch import rays_of_field
from raytrace.tracing.trace import trace_lens

VARY = Vary(1, "curvature"), Vary(3, "thickness"), Vary(5, "curvature")

#: Rules of the double Gauss, whose stop is surface 6, each with what it must come to.
RULES = {
    "pickup": Solve(8, "curvature", "pickup", source=1, scale=-0.7, offset=0.001),
    "marginal_angle": Solve(11, "curvature", "marginal_angle", (-0.2,)),
    "f_number": Solve(11, "curvature", "f_number", (2.5,)),
    "marginal_height": Solve(11, "thickness", "marginal_height", (0.5,)),
    "edge_thickness": Solve(3, "thickness", "edge_thickness", (2.5, 10.0)),
    "power": Solve(10, "curvature", "power", (0.012,)),
    "position": Solve(7, "thickness", "position", (30.0,), source=3),
}


def moment_of(solves, x=None, *, duals=False, lens=None):
    model = DesignVariables(rt.read_lens("double_gauss") if lens is None else lens, VARY, solves)
    x = model.start * np.array([1.02, 0.97, 1.01]) if x is None else x
    return model, x, model.views[0].state(Dual(x, np.eye(len(x))) if duals else x)


def marginal_slope(lens, last: int) -> tuple[float, float]:
    """u′ and height behind a surface of the paraxial marginal ray, and at the next vertex, surface by surface."""
    primary = lens.primary
    y, u, n = float(rt.first_order(lens).entrance_pupil_diameter) / 2, 0.0, 1.0
    for surface in lens.surfaces[1 : last + 1]:
        behind = float(refractive_index(surface.glass, primary))
        curvature = 0.0 if surface.curvature is None else float(surface.curvature)
        u = (n * u - y * curvature * (behind - n)) / behind
        n, y = behind, y + float(surface.thickness) * u
    return u, y


def test_every_kind_is_tried():
    assert RULES.keys() == SOLVES.keys()


@pytest.mark.parametrize("kind", RULES)
def test_solved_numbers_meet_their_rule(kind):
    solve = RULES[kind]
    model, x, _ = moment_of((solve,))
    lens = model.lens_at(x)
    surface = lens.surfaces[solve.surface]
    if kind == "pickup":
        assert float(surface.curvature) == pytest.approx(-0.7 * x[0] + 0.001, rel=1e-14)
    elif kind == "marginal_angle":
        assert marginal_slope(lens, 11)[0] == pytest.approx(-0.2, rel=1e-12)
    elif kind == "f_number":
        assert marginal_slope(lens, 11)[0] == pytest.approx(-1 / 5, rel=1e-12)
    elif kind == "marginal_height":
        assert marginal_slope(lens, 11)[1] == pytest.approx(0.5, rel=1e-11)
    elif kind == "power":
        before, behind = (refractive_index(lens.surfaces[k].glass, lens.wavelengths[0]) for k in (9, 10))
        assert float(surface.curvature * (behind - before)) == pytest.approx(0.012, rel=1e-13)
    elif kind == "edge_thickness":
        near, far = (float(sag(lens.surfaces[k], torch.tensor(100.0, dtype=torch.float64))) for k in (3, 4))
        assert float(surface.thickness) + far - near == pytest.approx(2.5, rel=1e-13)
    else:
        assert sum(float(lens.surfaces[k].thickness) for k in range(3, 8)) == pytest.approx(30, rel=1e-14)


@pytest.mark.parametrize("kind", RULES)
def test_derivatives_go_through(kind):
    solve = RULES[kind]
    model, x, found = moment_of((solve,), duals=True)
    slope = slope_of(found.numbers[solve.surface, solve.quantity], len(x))
    for k in range(len(x)):
        step = 1e-6 * abs(x[k])
        ahead, back = (
            model.views[0].state(x + sign * step * np.eye(len(x))[k]).numbers[solve.surface, solve.quantity]
            for sign in (1, -1)
        )
        assert slope[k] == pytest.approx((ahead - back) / (2 * step), rel=1e-6, abs=1e-9)


def test_solves_that_wait_for_one_another_settle():
    lens = rt.read_lens("double_gauss").at(f_number=3)
    solves = (
        Solve(2, "curvature", "marginal_angle", (0.01,)),  # in front of the stop: moves the entrance pupil
        Solve(3, "curvature", "pickup", source=8, scale=0.5),
        Solve(8, "curvature", "pickup", source=1, scale=-0.7),
        Solve(11, "thickness", "marginal_height", (0.0,)),
    )
    model, x, found = moment_of(solves, lens=lens, duals=True)
    here = model.lens_at(x)
    assert marginal_slope(here, 2)[0] == pytest.approx(0.01, rel=1e-9)
    assert float(here.surfaces[3].curvature) == pytest.approx(-0.35 * x[0], rel=1e-12)
    assert marginal_slope(here, 11)[1] == pytest.approx(0.0, abs=1e-10)
    for k in range(len(x)):
        step = 1e-6 * abs(x[k])
        for at, number in found.numbers.items():
            ahead, back = (model.views[0].state(x + s * step * np.eye(len(x))[k]).numbers[at] for s in (1, -1))
            assert number.slope[k] == pytest.approx((ahead - back) / (2 * step), rel=1e-5, abs=1e-8)


def test_a_solve_in_the_object_space_of_a_finite_object():
    lens = rt.read_lens("double_gauss").at(object_distance=400.0)
    model, x, _ = moment_of((RULES["marginal_height"],), lens=lens)
    image = model.lens_at(x)
    own = dataclasses.replace(RULES["marginal_height"], numbers=(0.0,))
    focused, x, _ = moment_of((own,), lens=lens)
    distance = float(focused.lens_at(x).surfaces[11].thickness)
    assert distance == pytest.approx(float(rt.first_order(image).paraxial_image_distance), rel=1e-12)


# -- by real rays, edges, glasses, configurations ----------------------------------------------------------------------


def differenced(model, x, at, configuration=1):
    """Derivatives of a number, exact and by differences."""
    view = model.views[configuration - 1]
    exact = slope_of(view.state(Dual(x, np.eye(len(x)))).numbers[at], len(x))
    steps = 1e-5 * np.abs(x)
    moved = [x + sign * h * one for h, one in zip(steps, np.eye(len(x)), strict=True) for sign in (1, -1)]
    ends = np.array([value_of(view.state(one).numbers[at]) for one in moved]).reshape(-1, 2)
    return exact, (ends[:, 0] - ends[:, 1]) / (2 * steps)


@pytest.mark.parametrize("part", [0.7, 1.0])
def test_a_real_ray_meets_the_image_at_the_height_of_its_solve(part):
    solve = Solve(11, "thickness", "marginal_height", (0.25, part))
    model, x, _ = moment_of((solve,))
    lens = model.lens_at(x)
    wavelength = lens.primary
    origin, point = torch.zeros(2, dtype=torch.float64), torch.tensor([0.0, part], dtype=torch.float64)
    rays = rays_of_field(lens, origin, point, wavelength=wavelength)
    assert float(trace_lens(lens, rays, wavelength).position[1]) == pytest.approx(0.25, rel=1e-10)
    exact, differences = differenced(model, x, (11, "thickness"))
    assert exact == pytest.approx(differences, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("height", [12.0, pytest.param(0.0, marks=pytest.mark.slow)])
def test_an_edge_is_as_thick_as_its_solve_at_a_height_or_where_the_light_ends(height):
    lens = rt.read_lens("double_gauss")
    lens = dataclasses.replace(lens, optimization_data=OptimizationData(semi_diameter_margin=(5.0, 0.1)))
    model = DesignVariables(lens, (VARY[0], VARY[2]), (Solve(3, "thickness", "edge_thickness", (2.0, height)),))
    x = model.start * np.array([1.02, 1.01])
    here = model.lens_at(x)
    at = height or semi_diameters(here)[3]
    near, far = (float(sag(here.surfaces[k], torch.tensor(at * at, dtype=torch.float64))) for k in (3, 4))
    assert float(here.surfaces[3].thickness) + far - near == pytest.approx(2.0, rel=1e-9)
    exact, differences = differenced(model, x, (3, "thickness"))
    assert exact == pytest.approx(differences, rel=1e-5, abs=1e-7)


def test_a_real_ray_that_is_lost_has_no_thickness():
    lens = rt.read_lens("double_gauss").at(f_number=0.5)
    model = DesignVariables(lens, VARY, (Solve(11, "thickness", "marginal_height", (0.0, 1.0)),))
    found = model.views[0].state(Dual(model.start, np.eye(3))).numbers[11, "thickness"]
    assert np.isnan(found.value)


def test_a_glass_that_is_picked_up_follows_every_number_of_it():
    lens = rt.read_lens("double_gauss")
    glass = model_glass(*(torch.tensor(n, dtype=torch.float64) for n in (1.62, 56.0)))
    lens = lens.replace(1, glass=glass).at(wavelengths=[0.5876, 0.4861])
    variables = Vary(1, "index"), Vary(1, "abbe_number")
    model = DesignVariables(
        lens, variables, (Solve(3, "glass", "pickup", source=1), Solve(9, "glass", "pickup", source=3))
    )
    x = np.array([1.65, 50.0])
    here, view = model.lens_at(x), model.views[0]
    for k in (3, 9):
        expected = refractive_index(here.surfaces[k].glass, here.wavelengths)
        assert torch.equal(expected, refractive_index(here.surfaces[1].glass, here.wavelengths))
        assert float(expected[1]) != float(refractive_index(lens.surfaces[k].glass, lens.wavelengths)[1])
    state = view.state(Dual(x, np.eye(2)))
    focal = state.gaussian(1).effective_focal_length
    for k, h in enumerate((1e-6, 1e-4)):
        ends = [view.state(x + s * h * np.eye(2)[k]).gaussian(1).effective_focal_length for s in (1, -1)]
        assert slope_of(focal, 2)[k] == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=1e-6)
    assert float(rt.first_order(here, wavelength=here.wavelengths[1]).effective_focal_length) == pytest.approx(
        value_of(focal), rel=1e-12
    )


def zoom():
    """Two configurations, in which the thickness of surface 3, and -½ of it and 9 mm of surface 8, differ."""
    lens = configurations.made(rt.read_lens("double_gauss"), thickness={3: [4.0, 6.0]}, curvature={1: [0.02, 0.01]})
    gap, bend = lens.operands
    gap = dataclasses.replace(gap, paths=(*gap.paths, ScaledPath(("surfaces", 8, "thickness"), -0.5, 9.0)))
    return dataclasses.replace(lens, operands=(gap, bend), optimization_data=OptimizationData(unit=25.4)).configuration(
        1
    )


def test_derivatives_reach_through_pickups_of_other_surfaces_and_configurations():
    lens = zoom()
    follows = Solve(3, "thickness", "pickup", (0.0,), 1, 2.0, 0.1, configuration=2, operand=0)
    model = DesignVariables(lens, (Vary(3, "thickness", 1, 0), Vary(1, "curvature", 2, 1)), (follows,))
    x = np.array([5.0, 0.012])
    first, second = (view.state(Dual(x, np.eye(2))).numbers for view in model.views)
    assert (value_of(first[3, "thickness"]), value_of(first[8, "thickness"])) == (5.0, 6.5)
    assert value_of(second[3, "thickness"]) == pytest.approx(12.54)  # 2 · 5 + 0.1 inches
    assert value_of(second[8, "thickness"]) == pytest.approx(9 - 6.27)
    for at in ((3, "thickness"), (8, "thickness")):
        for configuration in (1, 2):
            exact, differences = differenced(model, x, at, configuration)
            assert exact == pytest.approx(differences, rel=1e-8, abs=1e-12)
    moved = model.lens_at(x)
    assert moved.operands[0].numbers.tolist() == pytest.approx([5.0, 12.54])
    assert moved.operands[1].numbers.tolist() == [0.02, 0.012]
    for number, numbers in ((1, first), (2, second)):
        here = moved.configuration(number)
        assert float(here.surfaces[8].thickness) == pytest.approx(value_of(numbers[8, "thickness"]), rel=1e-14)


def test_numbers_changed_by_an_operand_are_named_once():
    lens = zoom()
    found = design_variables(lens, "thickness:3,8")
    assert found.variables == (Vary(3, "thickness", 1, 0), Vary(3, "thickness", 2, 0))
    follows = Solve(3, "thickness", "pickup", (0.0,), 1, configuration=2, operand=0)
    lens = dataclasses.replace(lens, optimization_data=OptimizationData(solves=(follows,)))
    assert [one for one in design_variables(lens, "thickness").variables if one.surface == 3] == [
        Vary(3, "thickness", 1, 0)
    ]
    assert design_variables(lens, "thickness:3").solves == ()


@pytest.mark.parametrize(
    ("path", "kind", "near"),
    [
        ("Project_X__Houghton.zmx", "edge_thickness", 1e-11),
        ("ray-optics__US00583336-2-scaled.zmx", "marginal_height", 1e-11),
    ],
)
def test_thicknesses_that_opticstudio_solved_come_out_again(path, kind, near):
    """5.0376… mm at an edge in inches, 42.3517… mm by the real ray through 0.7 of the pupil; paraxially 41.6005."""
    if not (CORPUS / "zmx" / path).exists():
        pytest.skip("the files are in ../shared")
    lens = rt.read_lens(CORPUS / "zmx" / path)
    (solve,) = (one for one in lens.optimization_data.solves if one.kind == kind)
    found = DesignVariables(lens, (), (solve,)).views[0].state(np.zeros(0)).numbers[solve.surface, "thickness"]
    assert value_of(found) == pytest.approx(float(lens.surfaces[solve.surface].thickness), rel=near)
