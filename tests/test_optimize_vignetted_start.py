"""Vignetted starts of an optimisation are opened step by step; no step vignettes more rays than the start."""

import dataclasses

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.opening import opened
from raytrace.optimization.problem import Problem
from raytrace.optimization.variables import DesignVariables, bounds_of, design_variables

#: Factors of the curvatures of the double Gauss, with which most of its rays are lost.
BENT = (1.15, 0.58, 0.67, -0.95, 2.44, 1.0, 1.12, 1.41, 0.0, 0.16, 1.51)


def bent():
    lens = rt.read_lens("double_gauss")
    lens = lens.at(entrance_pupil_diameter=float(rt.first_order(lens).entrance_pupil_diameter))
    lens = dataclasses.replace(lens, optimization_data=None)
    for k, factor in enumerate(BENT, 1):
        if lens.surfaces[k].curvature is not None:
            curvature = torch.tensor(factor * float(lens.surfaces[k].curvature), dtype=torch.float64)
            lens = lens.replace(k, curvature=curvature)
    return lens


def problem_of(lens, bounds="thickness:0.5..90"):
    free = design_variables(lens, "curvature thickness")
    model = free
    lower, upper = bounds_of(free.lens, free.variables, bounds)
    return Problem(model, rt.Merit.default(lens, "spot").rows), {"lower": lower, "upper": upper}


def test_an_opening_scales_pupil_and_field_of_every_ray():
    lens = rt.read_lens("double_gauss")
    rows = rt.Merit.default(lens, "spot").rows
    narrowed = [dataclasses.replace(row, numbers=tuple(0.4 * n for n in row.numbers)) for row in rows]
    narrow = Evaluation(DesignVariables(lens, opening=0.4), rows)(np.zeros(0)).values
    assert narrow == pytest.approx(
        Evaluation(DesignVariables(lens), narrowed)(np.zeros(0)).values, rel=1e-12, nan_ok=True
    )


def test_a_start_that_loses_most_rays_is_opened_until_all_pass():
    lens = bent()
    found = rt.optimize(lens, merit="spot", vary="curvature thickness", bounds="thickness:0.5..90", cycles=1)
    problem, bounds = problem_of(lens)
    assert problem.state(found.variables_before.numpy(), False).lost > 0.5 * len(problem.rows)
    x = found.variables_after.numpy()
    assert problem.state(x, False).lost == 0
    assert (bounds["lower"] <= x).all()
    assert (x <= bounds["upper"]).all()


def test_never_more_light_is_lost_and_a_lens_that_loses_none_stays():
    lens = rt.read_lens("double_gauss")
    problem, bounds = problem_of(lens)
    assert opened(problem, problem.model.start, **bounds).x is problem.model.start
    problem, bounds = problem_of(lens.at(f_number=0.6), "thickness:5..5.1")
    x = np.clip(problem.model.start, bounds["lower"], bounds["upper"])
    found = opened(problem, x, **bounds).x
    assert problem.state(found, False).lost <= problem.state(x, False).lost


@pytest.mark.slow
def test_an_opening_is_watched_and_stopped_with_the_best_lens_so_far():
    lens, seen = bent(), []

    def watch(cycle, shown):
        seen.append((cycle, shown))
        if len(seen) == 15:  # in the second part of pupil and field, at the latest
            raise KeyboardInterrupt

    how = {"merit": "spot", "vary": "curvature thickness", "bounds": "thickness:0.5..90"}
    found = rt.optimize(lens, **how, watch=watch)
    assert found.stopped == "interrupted"
    assert found.cycles == len(seen) == 15
    assert [cycle.number for cycle, _ in seen] == [*range(1, 16)]
    problem, _ = problem_of(lens)
    x = found.variables_after.numpy()
    assert problem.state(x, False).lost < problem.state(found.variables_before.numpy(), False).lost
    for k, surface in enumerate(seen[-1][1].surfaces):
        assert surface.curvature is None or surface.curvature == found.lens.surfaces[k].curvature
    assert seen[-1][0].merit == pytest.approx(np.sqrt(problem.state(x, False).cost), rel=1e-9)
