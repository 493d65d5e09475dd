"""Merit functions of real files: every row and the merit itself, against an independent evaluation of the lines."""

import functools
import json

import numpy as np
import pytest
from problems import SHARED

import raytrace as rt
from raytrace.io import read_lens
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.variables import DesignVariables

FOLDER = SHARED / "merit" / "dev"

pytestmark = pytest.mark.needs(FOLDER)

CLOSE = 1e-8  # relative
NEAR_ZERO = {"OPDC": 1e-7, "OPDX": 1e-7, "OPDM": 1e-7}  # waves; lengths: 1e-9

#: What the oracle does not settle.
OPEN = ("DISC",)


@functools.cache
def cases():
    path = FOLDER / "oracle.json"
    found = json.loads(path.read_text())["files"] if path.exists() else []
    return {case["file"]: case for case in found if case["copied"] and case["status"] == "usable"}


@functools.cache
def evaluation(name: str) -> Evaluation:
    lens = read_lens(FOLDER / name)
    model = DesignVariables(lens, lens.optimization_data.variables, lens.optimization_data.solves)
    return Evaluation(model, lens.optimization_data.merit, unit=lens.optimization_data.unit)


def test_all_files_are_there():
    assert len(cases()) == 17


@pytest.mark.parametrize("name", cases())
def test_the_merit_and_every_row(name):
    case, evaluate = cases()[name], evaluation(name)
    found = evaluate(evaluate.model.start)
    for stored in case["values"]:
        row, value = evaluate.rows[stored["row"] - 1], found.values[stored["row"] - 1]
        assert row.operand == stored["op"]
        if row.operand in OPEN:
            continue
        expected, value = (
            (abs(stored["value"]), abs(value)) if row.operand.startswith("OPD") else (stored["value"], value)
        )
        close = max(CLOSE * abs(expected), NEAR_ZERO.get(row.operand, 1e-9))
        assert value == pytest.approx(expected, abs=close), stored
    assert found.merit == pytest.approx(case["mf_stored"], rel=CLOSE, abs=1e-13)
    assert not found.lost.any()


@pytest.mark.parametrize("name", cases())
def test_the_jacobian_is_that_of_finite_differences(name):
    evaluate = evaluation(name)
    x = evaluate.model.start
    found = evaluate(x, derivatives=True)
    spread = np.random.default_rng(0).normal(size=(len(x), 2)) * np.maximum(np.abs(x), 1e-9)[:, None]
    for along in spread.T:
        step = 1e-6
        ahead, back = (evaluate(x + sign * step * along).residuals for sign in (1, -1))
        difference = (ahead - back) / (2 * step)
        size = np.abs(difference).max()
        kinks = np.abs(found.jacobian @ along - difference) > 1e-4 * size + 1e-9
        assert kinks.mean() < 0.01


def test_a_file_holds_an_equality_as_a_row_of_negative_weight(tmp_path):
    """The constraint of `hold` in a file: met exactly in the optimisation that stores it and in that of its file."""
    lens, path = rt.read_lens("cooke_triplet").at(ray_aiming="paraxial"), tmp_path / "held.zmx"
    spot = rt.Merit.default(lens, "spot", rings=2)
    merit = rt.Merit([*spot.rows, rt.system.Row("EFFL", target=100.0, weight=-1.0)])
    first = rt.optimize(lens, merit=merit, vary="curvature sensor", cycles=6)
    first.save(path)
    again = rt.optimize(path, vary="thickness:2,6 curvature:1-4 sensor", cycles=6)
    by_words = rt.optimize(lens, merit=spot, vary="curvature sensor", hold="efl=100", cycles=6)
    assert first.merit_after == pytest.approx(by_words.merit_after, rel=1e-9)
    for found in (first, again, by_words):
        assert float(rt.first_order(found.lens).effective_focal_length) == pytest.approx(100, rel=1e-7)
