"""The merit functions of Optiland's samples are the same in Optiland and in this package."""

import math

import pytest
import torch
from scripts import script

from raytrace.optimization.merit import Evaluation
from raytrace.optimization.variables import DesignVariables

pytest.importorskip("optiland", reason="needs the extra [bench]")
peers = script("bench_optiland")

pytestmark = pytest.mark.usefixtures("same_threads")


@pytest.mark.parametrize("name", peers.PROBLEMS)
@pytest.mark.parametrize("moved", [0.0, 0.03])
def test_both_programs_find_the_same_merit(name, moved):
    """By three wavelengths, three fields, the focal length and an aperture by diameter or F-number."""
    problem = peers.problem(name, moved=moved)
    here = float(peers.merit_of(problem.lens, problem.rows))
    assert problem.merit_in_optiland == pytest.approx(here, rel=1e-9)
    for how in ("rays", "spots"):
        posed = peers.posed(problem.optic(), problem.rows, problem.variables, how)
        assert float(posed.sum_squared()) == pytest.approx(here, rel=1e-9)
    rows = Evaluation(DesignVariables(problem.lens, problem.variables), problem.rows)
    assert rows(rows.model.start).merit ** 2 == pytest.approx(here, rel=1e-9)
    assert problem.lens.optimization_data.merit == problem.rows
    assert problem.lens.optimization_data.variables == problem.variables
    assert sum(row.weight for row in problem.rows) == pytest.approx(1 + math.pi)


def test_variables_are_those_of_the_table():
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


def test_the_script_compares_the_solvers(capsys):
    peers.main(["--lens", "cooke triplet", "--steps", "2"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + 2 * 3  # a heading, and three solvers from two starts
    assert "least squares, rays" in lines[3]
