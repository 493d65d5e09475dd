"""The peer's side of `raytrace bench optimise`: both programs are given one problem, and find one merit. No timings."""

import math

import pytest
import torch

from raytrace.optimization.lens_model import Model
from raytrace.optimization.merit_rows import Evaluation
from raytrace.tracing.paraxial import first_order

peers = pytest.importorskip("raytrace.bench.peers_optimise", reason="needs the extra [bench]", exc_type=ImportError)

pytestmark = pytest.mark.usefixtures("same_threads")


@pytest.mark.parametrize("name", peers.PROBLEMS)
@pytest.mark.parametrize("moved", [0.0, 0.03])
def test_both_programs_find_the_same_merit(name, moved):
    """By three wavelengths, three fields, the focal length and an aperture told by diameter or F-number."""
    problem = peers.problem(name, moved=moved)
    here = float(peers.merit_of(problem.lens, problem.rows))
    assert problem.merit_in_optiland == pytest.approx(here, rel=1e-9)
    for how in ("rays", "spots"):
        posed = peers.posed(problem.optic(), problem.rows, problem.variables, how)
        assert float(posed.sum_squared()) == pytest.approx(here, rel=1e-9)
    rows = Evaluation(Model(problem.lens, problem.variables), problem.rows)
    assert rows(rows.model.start).merit ** 2 == pytest.approx(here, rel=1e-9)
    assert problem.lens.optimization_data.merit == problem.rows
    assert problem.lens.optimization_data.variables == problem.variables
    assert sum(row.weight for row in problem.rows) == pytest.approx(1 + math.pi)


def test_what_varies_is_what_the_table_says():
    plain, moved = (peers.problem("double Gauss", moved=part) for part in (0.0, 0.02))
    assert [(v.surface, v.quantity) for v in plain.variables] == [
        *((number, "curvature") for number in (1, 2, 3, 5, 7, 9, 10, 11)),
        *((number, "thickness") for number in (5, 6, 11)),
    ]
    changed = []
    for number, (a, b) in enumerate(zip(plain.lens.surfaces, moved.lens.surfaces, strict=True)):
        for quantity in ("curvature", "thickness"):
            one, other = getattr(a, quantity), getattr(b, quantity)
            if one is not None and not torch.allclose(one, other, rtol=1e-6, atol=0):
                changed.append((number, quantity))
    assert sorted(changed) == sorted((v.surface, v.quantity) for v in plain.variables)


@pytest.mark.parametrize("how", ["rays", "spots"])
def test_least_squares_ends_at_a_lens_of_this_package(how):
    run = peers.least_squares(peers.problem("cooke triplet", moved=0.01), how, most=12)
    assert run.end < run.start
    assert run.end_here == pytest.approx(run.end, rel=1e-8)
    seconds = [at for at, _ in run.history]
    assert seconds == sorted(seconds)
    assert run.seconds_to(run.start) <= run.seconds_to(1.0001 * run.end) < math.inf == run.seconds_to(0.0)
    assert float(first_order(run.lens).effective_focal_length) == pytest.approx(50.0, rel=0.05)
    assert peers.report([run])[2].startswith("| cooke triplet | 7 | sample ± 1% |")


def test_adam_differentiates_the_same_merit():
    """A step of Adam moves every variable by the rate, against its slope as this package finds it."""
    problem = peers.problem("cooke triplet", moved=0.01)
    run = peers.adam(problem, 1, rate=1e-6)
    assert run.history[0][1] == pytest.approx(problem.merit_in_optiland, rel=1e-9)
    assert run.end < run.start
    assert run.end_here == pytest.approx(run.end, rel=1e-8)
    for vary in problem.variables:
        number = getattr(problem.lens.surfaces[vary.surface], vary.quantity).clone().requires_grad_()
        lens = problem.lens.replace(vary.surface, **{vary.quantity: number})
        slope = torch.autograd.grad(peers.merit_of(lens, problem.rows), number)[0]
        step = getattr(run.lens.surfaces[vary.surface], vary.quantity) - number.detach()
        assert float(slope * step) < 0, vary
