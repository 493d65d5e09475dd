"""Solves: what follows meets its rule, wherever the variables are, with derivatives; and one that waits for another."""

import dataclasses

import numpy as np
import pytest

import raytrace as rt
from raytrace.maths.dual import Dual, slope_of
from raytrace.media.glass import refractive_index
from raytrace.merit.model import Model
from raytrace.merit.solves import SOLVES
from raytrace.system.intent import Solve, Vary

VARY = Vary(1, "curvature"), Vary(3, "thickness"), Vary(5, "curvature")

#: Rules of the double Gauss, whose stop is surface 6, each with what it must come to.
RULES = {
    "pickup": Solve(8, "curvature", "pickup", source=1, scale=-0.7, offset=0.001),
    "marginal_angle": Solve(11, "curvature", "marginal_angle", (-0.2,)),
    "f_number": Solve(11, "curvature", "f_number", (2.5,)),
    "marginal_height": Solve(11, "thickness", "marginal_height", (0.5,)),
    "power": Solve(10, "curvature", "power", (0.012,)),
    "position": Solve(7, "thickness", "position", (30.0,), source=3),
}


def moment_of(solves, x=None, *, duals=False, lens=None):
    model = Model(rt.read_lens("double_gauss") if lens is None else lens, VARY, solves)
    x = model.start * np.array([1.02, 0.97, 1.01]) if x is None else x
    return model, x, model.views[0].moment(Dual(x, np.eye(len(x))) if duals else x)


def marginal_slope(lens, last: int) -> tuple[float, float]:
    """u′ and height behind a surface of the paraxial marginal ray, and at the next vertex, surface by surface."""
    primary = lens.wavelengths[lens.primary_wavelength]
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
def test_what_follows_meets_its_rule(kind):
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
            model.views[0].moment(x + sign * step * np.eye(len(x))[k]).numbers[solve.surface, solve.quantity]
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
            ahead, back = (model.views[0].moment(x + s * step * np.eye(len(x))[k]).numbers[at] for s in (1, -1))
            assert number.slope[k] == pytest.approx((ahead - back) / (2 * step), rel=1e-5, abs=1e-8)


def test_a_solve_in_the_object_space_of_a_finite_object():
    lens = rt.read_lens("double_gauss").at(object_distance=400.0)
    model, x, _ = moment_of((RULES["marginal_height"],), lens=lens)
    image = model.lens_at(x)
    own = dataclasses.replace(RULES["marginal_height"], numbers=(0.0,))
    focused, x, _ = moment_of((own,), lens=lens)
    distance = float(focused.lens_at(x).surfaces[11].thickness)
    assert distance == pytest.approx(float(rt.first_order(image).paraxial_image_distance), rel=1e-12)
