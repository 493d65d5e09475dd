"""Angles of incidence against those of `incidence` and the law of refraction; rays at the object."""

import math

import numpy as np
import pytest
from merit_cases import LENSES, check_derivatives, values_of

import raytrace as rt
from raytrace.files import shipped
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.variables import DesignVariables
from raytrace.system.optimization_data import Row, Vary

pytestmark = pytest.mark.usefixtures("compiler")

ROUND = ["near", "colours", "telescope", "aspheres", "Mangin", "immersed image"]


def rows_of(lens, operand):
    """Of the lower, chief and upper ray of every field along y at every surface, at the primary wavelength."""
    largest = float(lens.fields.y.abs().max())
    found = []
    for y in lens.fields.y.tolist():
        for p in (-1.0, 0.0, 1.0):
            for k in range(1, len(lens.surfaces)):
                if not lens.surfaces[k].is_break:
                    found.append(Row(operand, (k, 0), (0.0, y / largest if largest else 0.0, 0.0, p)))
    return found


@pytest.mark.parametrize("name", ROUND)
def test_incidence_is_that_of_the_verb(name):
    lens = LENSES[name] if name != "colours" else rt.read_lens("cooke_triplet").at(wavelengths=[0.5876])
    model = DesignVariables(lens)
    found = rt.incidence(lens, fields=lens.fields.y)
    angles, valid = found.angle[:, 0].abs().reshape(-1), found.valid[:, 0].reshape(-1)
    computed = Evaluation(model, rows_of(lens, "RAID"))(model.start).values
    keep = valid.numpy() & np.isfinite(computed)
    assert keep.mean() > 0.8
    assert computed[keep] == pytest.approx(angles.numpy()[keep], rel=1e-9, abs=1e-6)


def test_incidence_on_tilted_surfaces():
    """Of mirrors, and of the image, the angle in front, computed from the surface before, is the one behind."""
    lens = rt.read_lens(shipped("lenses") / "examples" / "folded_relay.zmx")
    image = len(lens.surfaces) - 1
    keeps = [k for k, surface in enumerate(lens.surfaces) if surface.is_mirror] + [image]
    ray = (0.0, 0.6, 0.3, 0.5)
    evaluation = Evaluation(DesignVariables(lens), [Row(o, (k, 0), ray) for o in ("RAID", "RAED") for k in keeps])
    in_front, behind = evaluation(np.zeros(0)).values.reshape(2, -1)
    assert len(keeps) > 1
    assert in_front.max() > 40
    assert in_front == pytest.approx(behind, rel=1e-11)


def test_the_law_of_refraction():
    """n sin i = n' sin i', by RAID and RAED; RAIN and RAEN are their cosines."""
    lens = LENSES["near"]
    ray = (0.0, 0.8, 0.3, 0.6)
    n = DesignVariables(lens).views[0].indices[lens.primary_wavelength - 1]
    for k in (1, 3, 5, 8):
        i, e, ci, ce = values_of("near", [Row(o, (k, 0), ray) for o in ("RAID", "RAED", "RAIN", "RAEN")])
        assert n[k - 1] * math.sin(math.radians(i)) == pytest.approx(n[k] * math.sin(math.radians(e)), rel=1e-12)
        assert [ci, ce] == pytest.approx([math.cos(math.radians(i)), math.cos(math.radians(e))], rel=1e-12)


def test_rays_at_the_object():
    """They set out from the field's point; their direction is that in front of surface 1."""
    lens = LENSES["near"]
    rows = [Row(operand, (0, 0), (0.0, 0.8, 0.3, 0.6)) for operand in ("REAX", "REAY", "REAZ", "REAA", "REAB", "REAC")]
    x, y, z, *direction = values_of("near", rows)
    slope = math.tan(math.radians(0.8 * float(lens.fields.y.abs().max())))
    assert [x, z] == [pytest.approx(0, abs=1e-10), 0.0]
    assert y == pytest.approx(-(300.0 + values_of("near", [Row("ENPP")])[0]) * slope, rel=1e-12)
    assert np.hypot(*direction[:2]) ** 2 + direction[2] ** 2 == pytest.approx(1, rel=1e-14)


@pytest.mark.parametrize("name", [*ROUND, "asphere behind a stop"])
def test_derivatives_of_incidence(name):
    image = len(LENSES[name].surfaces) - 1
    rows = [Row(o, (k, 0), (0.0, 0.7, 0.2, 0.5)) for o in ("RAID", "RAEN") for k in (1, 2, image)]
    at_object = [Row(o, (0, 0), (0.0, 0.7, 0.2, 0.5)) for o in ("REAY", "REAB")] if name == "near" else []
    check_derivatives(name, rows + at_object)


@pytest.mark.slow
def test_derivatives_of_incidence_on_tilted_surfaces():
    lens = rt.read_lens(shipped("lenses") / "examples" / "folded_relay.zmx")
    breaks = [k for k, surface in enumerate(lens.surfaces) if surface.is_break]
    model = DesignVariables(lens, (Vary(breaks[0], "tilt_x"), Vary(breaks[0] + 1, "thickness")))
    rows = [Row("RAID", (len(lens.surfaces) - 1, 0), (0.0, 0.5, 0.1, 0.4), weight=1.0)]
    evaluation, x = Evaluation(model, rows), model.start
    found = evaluation(x, derivatives=True)
    for i in range(len(x)):
        step = np.eye(len(x))[i] * 1e-5
        slope = (evaluation(x + step).residuals - evaluation(x - step).residuals) / 2e-5
        assert found.jacobian[:, i] == pytest.approx(slope, rel=1e-6, abs=1e-7)
