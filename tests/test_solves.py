"""Solves: what follows meets its rule, wherever the variables are, with derivatives; and one that waits for another."""

import dataclasses

import numpy as np
import pytest
import torch
from differences import gradcheck, gradgradcheck
from problems import SHARED, focal_length, semi_diameters

import raytrace as rt
from raytrace.materials.glass import model_glass, refractive_index
from raytrace.maths.numerics import Dual, slope_of, value_of
from raytrace.maths.tangents import tangents_of, with_tangents
from raytrace.optimization.lens_state import SOLVES
from raytrace.optimization.variables import DesignVariables, design_variables
from raytrace.system import configurations
from raytrace.system.configurations import ScaledPath
from raytrace.system.lens import SystemAperture
from raytrace.system.optimization_data import OptimizationData, Solve, Vary
from raytrace.system.parameter_paths import stored_number
from raytrace.system.surface import sag
from raytrace.tracing.launch import rays_of_field
from raytrace.tracing.trace import trace_lens

CORPUS = SHARED / "corpus"
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
    "focal_length": Solve(11, "curvature", "focal_length", (90.0,)),
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
    assert {*RULES, "thermal"} == SOLVES.keys()  # between configurations: `test_thermal.py`


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
    elif kind == "focal_length":
        assert focal_length(lens) == pytest.approx(90, rel=1e-12)
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


#: Rules that wait for one another.
CHAIN = (
    Solve(2, "curvature", "marginal_angle", (0.01,)),  # in front of the stop: moves the entrance pupil
    Solve(3, "curvature", "pickup", source=8, scale=0.5),
    Solve(8, "curvature", "pickup", source=1, scale=-0.7),
    Solve(11, "thickness", "marginal_height", (0.0,)),
)


@pytest.mark.parametrize("is_solved", [False, True], ids=["moved", "where the lens is solved already"])
def test_solves_that_wait_for_one_another_settle(is_solved):
    lens = rt.read_lens("double_gauss").at(f_number=3)
    model, x, found = moment_of(CHAIN, lens=lens, duals=True)
    if is_solved:
        model, x, found = moment_of(CHAIN, x, lens=model.lens_at(x), duals=True)
    here = model.lens_at(x)
    assert marginal_slope(here, 2)[0] == pytest.approx(0.01, rel=1e-9)
    assert float(here.surfaces[3].curvature) == pytest.approx(-0.35 * x[0], rel=1e-12)
    assert marginal_slope(here, 11)[1] == pytest.approx(0.0, abs=1e-10)
    for k in range(len(x)):
        step = 1e-6 * abs(x[k])
        for at, number in found.numbers.items():
            ahead, back = (model.views[0].state(x + s * step * np.eye(len(x))[k]).numbers[at] for s in (1, -1))
            assert number.slope[k] == pytest.approx((ahead - back) / (2 * step), rel=1e-5, abs=1e-8)


def test_the_last_gap_waits_for_nothing():
    """It changes neither the focal length nor the pupils, also where the aperture is an F-number of the image."""
    lens = rt.read_lens("double_gauss").at(f_number=3)
    model, x, _ = moment_of((RULES["marginal_height"],), lens=lens)
    assert not model.views[0].waits
    assert marginal_slope(model.lens_at(x), 11)[1] == pytest.approx(0.5, rel=1e-11)
    assert moment_of((RULES["f_number"],), lens=lens)[0].views[0].waits


def test_a_solve_counts_the_power_of_terms_that_vary():
    """a r² adds 2 a to the curvature at the vertex: the marginal ray comes to the last surface with another slope."""
    lens = rt.read_lens("double_gauss").replace(3, coefficients=[1e-4, 0.0])
    model = DesignVariables(lens, (Vary(3, "a2"),), (RULES["f_number"],))
    here = model.lens_at(np.array([4e-4]))
    bent = here.replace(3, curvature=here.surfaces[3].curvature + 2 * 4e-4)
    assert marginal_slope(bent, 11)[0] == pytest.approx(-1 / 5, rel=1e-12)
    exact, differences = differenced(model, np.array([4e-4]), (11, "curvature"))
    assert exact == pytest.approx(differences, rel=1e-7)


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


@pytest.mark.needs(CORPUS)
@pytest.mark.parametrize(
    ("path", "kind", "near"),
    [
        ("Project_X__Houghton.zmx", "edge_thickness", 1e-11),
        ("ray-optics__US00583336-2-scaled.zmx", "marginal_height", 1e-11),
    ],
)
def test_thicknesses_that_opticstudio_solved_come_out_again(path, kind, near):
    """5.0376… mm at an edge in inches, 42.3517… mm by the real ray through 0.7 of the pupil; paraxially 41.6005."""
    lens = rt.read_lens(CORPUS / "zmx" / path)
    (solve,) = (one for one in lens.optimization_data.solves if one.kind == kind)
    found = DesignVariables(lens, (), (solve,)).views[0].state(np.zeros(0)).numbers[solve.surface, "thickness"]
    assert value_of(found) == pytest.approx(float(lens.surfaces[solve.surface].thickness), rel=near)


# -- the lens as a function of tensors ---------------------------------------------------------------------------------


def models() -> dict[str, DesignVariables]:
    """Every rule, rules that wait for one another, and variables that are not numbers of a surface."""
    lens = rt.read_lens("double_gauss")
    cone = SystemAperture("object_na", torch.tensor(0.05, dtype=torch.float64))
    near = dataclasses.replace(lens.at(object_distance=400.0), aperture=cone)
    beam = (Vary(0, "aperture"), Vary(0, "thickness"), Vary(1, "curvature"))
    follows = Solve(3, "thickness", "pickup", (0.0,), 1, 2.0, 0.1, configuration=2, operand=0)
    term = lens.replace(3, coefficients=[1e-4, 0.0])
    lit = dataclasses.replace(lens, optimization_data=OptimizationData(semi_diameter_margin=(5.0, 0.1)))
    edge = Solve(3, "thickness", "edge_thickness", (2.0, 0.0))
    return {
        **{kind: DesignVariables(lens, VARY, (solve,)) for kind, solve in RULES.items()},
        "real ray": DesignVariables(lens, VARY, (Solve(11, "thickness", "marginal_height", (0.25, 0.7)),)),
        "edge where the light ends": DesignVariables(lit, VARY[:2], (edge,)),
        "pupil": DesignVariables(lens.at(f_number=3), VARY[:1], CHAIN[:1]),
        "chain": DesignVariables(lens.at(f_number=3), VARY[:1], CHAIN),
        "term of r²": DesignVariables(term, (Vary(3, "a2"), VARY[0]), (RULES["f_number"], RULES["marginal_height"])),
        "object NA": DesignVariables(near, beam, (RULES["f_number"], RULES["marginal_height"])),
        "fixed object NA": DesignVariables(near, VARY[:1], (RULES["marginal_height"],)),
        "temperature": design_variables(lens.at(temperature=30.0), "temperature pressure curvature:11=f_number(4)"),
        "configurations": DesignVariables(zoom(), (Vary(3, "thickness", 1, 0), Vary(1, "curvature", 2, 1)), (follows,)),
    }


def numbers_of(model: DesignVariables, x: torch.Tensor) -> torch.Tensor:
    """All numbers that move (n,), or (L, n) of L lenses, and those of operands of configurations."""
    lens, view = model.lens_at(x), model.views[model.lens.current_configuration - 1]
    numbers = [stored_number(lens, at) for at in view.moved] + [n for one in lens.operands for n in one.numbers]
    return torch.stack([n.reshape(-1).expand(x.shape[:-1]) if x.dim() > 1 else n for n in numbers], -1)


SLOW = ("chain", "edge where the light ends", "object NA", "real ray", "temperature")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in models()]
)
def test_the_lens_of_tensors_is_that_of_numbers_and_has_its_derivatives(name):
    """First and second order by the graph, and by tensors that carry derivatives; of a batch as of each lens."""
    model = models()[name]
    x = torch.tensor(model.start) * (1 + 0.01 * torch.arange(1, len(model.start) + 1))
    numbers, view = numbers_of(model, x), model.views[0]
    plain = [value_of(n) for n in view.state(x.numpy()).numbers.values()]
    assert sorted(numbers[: len(plain)].tolist()) == pytest.approx(sorted(plain), rel=1e-14)
    unit = torch.tensor([max(abs(n), 1e-3) for n in x.tolist()])

    def scaled(y):
        return numbers_of(model, unit * y)

    y = (x / unit).requires_grad_()
    assert gradcheck(scaled, (y,), eps=1e-6, rtol=1e-6, atol=1e-8)
    assert gradgradcheck(scaled, (y,), eps=1e-6, rtol=1e-5, atol=1e-7)
    by_graph = torch.autograd.functional.jacobian(scaled, y)
    moving = numbers_of(model, with_tangents(x, torch.eye(len(x), dtype=x.dtype)))
    torch.testing.assert_close(unit * tangents_of(moving, len(x)).T, by_graph, rtol=1e-12, atol=1e-14)
    several = torch.stack([x, 1.002 * x])
    torch.testing.assert_close(numbers_of(model, several), torch.stack([numbers_of(model, one) for one in several]))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
        for name in ("f_number", "pupil", "chain", "edge where the light ends", "configurations")
    ],
)
def test_transforms_of_torch_take_the_lens_of_tensors(name):
    model = models()[name]
    x = torch.tensor(model.start) * 1.01
    several, of = torch.stack([x, 1.002 * x]), lambda x: numbers_of(model, x)
    torch.testing.assert_close(torch.func.vmap(of)(several), of(several))
    expected = torch.autograd.functional.jacobian(of, x)
    for derivative in (torch.func.jacfwd, torch.func.jacrev):
        torch.testing.assert_close(derivative(of)(x), expected, rtol=1e-12, atol=1e-14)
