"""Operands of rays: derivatives against differences, also on inner surfaces and with failed rays."""

import math

import numpy as np
import pytest
from merit_cases import LENSES, check_derivatives, lens_of, model_of, values_of

import raytrace as rt
from raytrace.optimization.merit import LOST, Evaluation
from raytrace.optimization.operands.rays import RAYS
from raytrace.optimization.variables import DesignVariables
from raytrace.system.optimization_data import Row

pytestmark = pytest.mark.usefixtures("compiler")


GROUPED = ("TR", "AN")  # operands of rays relative to others


def rows_of(name):
    """Of several rays of a field, at the image and on inner surfaces; targets that make a length one number, or two."""
    last = len(LENSES[name].surfaces) - 1
    targets = (0,) if name == "telescope" else (0, 0.1)  # its spot is smaller than what a difference moves it by
    rays = [(0.0, 0.6, 0.3, 0.5), (0.0, 0.6, -0.2, 0.4), (0.0, 0.6, 0.1, -0.7)]
    on_image = [
        Row(o, (0, 1), ray, target, 1.0) for o in RAYS if o[:2] in GROUPED for ray in rays for target in targets
    ]
    inside = [Row(o, (k, 1), rays[0], 0.1) for o in RAYS if o[:2] not in GROUPED for k in (1, 2, last)]
    return on_image + inside


@pytest.mark.parametrize("name", LENSES)
def test_derivatives(name):
    check_derivatives(name, rows_of(name), steps=(1e-4, 1e-5, 1e-6, 1e-7, 1e-8))


@pytest.mark.parametrize("name", ["near", "double Gauss"])
def test_rows_of_failed_rays_do_not_move_and_leave_the_others_alone(name):
    """Each counts as an error of LOST; the others are what they are without them."""
    model = model_of(name)
    kept = [Row("TRAR", (0, 1), (0.0, 0.6, 0.3, 0.5), 0.0, 1.0), Row("REAY", (3, 1), (0.0, 0.6, 0.3, 0.5), 0.0, 1.0)]
    lost = [Row("TRAR", (0, 1), (0.0, 0.6, 0.0, 9.0), 0.0, 1.0), Row("REAB", (3, 1), (0.0, 0.6, 0.0, 9.0), 0.0, 1.0)]
    whole, alone = (Evaluation(model, rows)(model.start, derivatives=True) for rows in (kept + lost, kept))
    assert list(whole.lost) == [False, False, True, True]
    assert np.isnan(whole.values[2:]).all()
    assert whole.merit == pytest.approx(math.sqrt((alone.merit**2 + LOST**2) / 2), rel=1e-12)
    stays, gone = whole.of_row < 2, whole.of_row >= 2
    assert not whole.jacobian[gone].any()
    assert whole.jacobian[stays] * math.sqrt(2) == pytest.approx(alone.jacobian, rel=1e-10, abs=1e-14)


def test_the_angle_to_the_axis_is_that_of_the_cosines():
    lens = lens_of("two aspheric mirrors")
    rows = [Row(o, (k, 1), (0.0, 1.0, 0.2, 0.7)) for k in range(1, len(lens.surfaces)) for o in ("RANG", "REAC")]
    angle, cosine = values_of("two aspheric mirrors", rows).reshape(-1, 2).T
    assert angle == pytest.approx(np.arccos(np.abs(cosine)), rel=1e-9)
    assert (cosine < 0).any()


def test_directions_behind_a_telescope_are_those_of_its_defocus():
    """Two ideal lenses f1 + f2 + δ apart turn a ray at height y by the slope δ y/(f1 f2): the cosine is its sine."""
    first, second, defocus, radius = 100.0, 25.0, 0.4, 5.0
    ideal = [rt.system.IdealLens(1 / f, 1 / f) for f in (first, second)]
    surfaces = [dict(thickness=first + second + defocus, phase=ideal[0]), dict(thickness=20.0, phase=ideal[1])]
    lens = rt.lens(surfaces, stop=1, entrance_pupil_diameter=2 * radius, fields=[0], wavelengths=[0.55])
    rows = [Row(o, (0, 1), (0.0, 0.0, 0.0, py)) for o in ("ANAC", "ANAR", "ANCY", "ANAY") for py in (0.5, 1.0)]
    found = Evaluation(DesignVariables(lens), rows)(np.zeros(0)).values.reshape(4, 2)
    slope = defocus * radius * np.array([0.5, 1.0]) / (first * second)
    assert found[:2] == pytest.approx(np.tile(np.sin(np.arctan(slope)), (2, 1)), rel=1e-10)
    assert found[2:] == pytest.approx(np.tile(np.sin(np.arctan(slope)), (2, 1)), rel=1e-10)
    whole = defocus * radius / (first * second * math.sqrt(2))  # the mean square over the pupil is half that of the rim
    assert float(rt.evaluate(lens, merit="angular").merit) == pytest.approx(whole, rel=1e-6)
