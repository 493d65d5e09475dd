"""Lenses with variables for tests of merit functions, and derivatives of rows against differences."""

import dataclasses
import math

import numpy as np
from problems import aspheric_singlet, double_gauss, fields, lens, surface

import raytrace as rt
from raytrace.materials.glass import MIRROR
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Solve, Vary

FIELD = fields("angle", (8.0,))


def cassegrain() -> Lens:
    primary = surface(-1 / 200, -70.0, MIRROR, conic=-1.0)
    secondary = surface(-0.0267, 150.0, MIRROR, conic=-2.25)
    return lens([surface(None, 30.0), primary, secondary], aperture=("entrance_pupil_diameter", 20.0), field=FIELD)


def behind_a_stop(*surfaces, **others) -> Lens:
    return lens([surface(None, 7.0), *surfaces], field=FIELD, **others)


SYSTEMS = {
    "thick lens": behind_a_stop(surface(0.02, 5.0, 1.5), surface(-0.01, 95.0)),
    "double Gauss": double_gauss(field=FIELD),
    "asphere with an r² term": dataclasses.replace(aspheric_singlet(field=FIELD), stop=2),
    "asphere behind a stop": behind_a_stop(
        surface(0.02, 5.0, 1.5, conic=-2.0, coefficients=[1e-3, 2e-5]), surface(None, 95.0, coefficients=[0.0, 1e-5])
    ),
    "concave mirror": behind_a_stop(surface(-0.01, -50.0, MIRROR)),
    "two aspheric mirrors": cassegrain(),
    "Mangin": behind_a_stop(surface(-0.01, 5.0, 1.5), surface(-0.012, -5.0, MIRROR), surface(-0.01, -40.0)),
    "immersed image": behind_a_stop(surface(0.05, 60.0, 1.5)),
    "immersed object": behind_a_stop(surface(-0.03, 80.0)),
}


def immersed(system: Lens) -> Lens:
    """The object and the stop in water."""
    water = surface(None, 0.0, 1.33).glass
    return system.replace(0, glass=water).replace(1, glass=water)


SYSTEMS["immersed object"] = immersed(SYSTEMS["immersed object"])

LENSES = {
    **SYSTEMS,
    "near": rt.read_lens("double_gauss").at(object_distance=300.0, wavelengths=[0.48, 0.6]),
    "colours": rt.read_lens("cooke_triplet").at(wavelengths=[0.4861, 0.5876, 0.6563]),
    "telescope": rt.read_lens("hubble"),
    "aspheres": rt.read_lens("phone"),
}
VARY = {
    "aspheres": (Vary(3, "a4"), Vary(4, "curvature"), Vary(4, "conic"), Vary(5, "thickness")),
    "asphere with an r² term": (Vary(1, "a2"), Vary(1, "a4"), Vary(1, "thickness"), Vary(2, "conic")),
    "asphere behind a stop": (Vary(2, "a2"), Vary(2, "a4"), Vary(2, "conic"), Vary(3, "a4"), Vary(1, "thickness")),
}
SOLVES = {"colours": (Solve(7, "thickness", "marginal_height", (0.0, 0.0)),)}


def is_near(name):
    return math.isfinite(float(LENSES[name].surfaces[0].thickness))


def model_of(name):
    """The lens with all its curvatures and thicknesses variable, or what VARY says."""
    lens, solves = LENSES[name], SOLVES.get(name, ())
    solved = {(one.surface, one.quantity) for one in solves}
    inside = range(1, len(lens.surfaces) - 1)
    usual = [Vary(k, "curvature") for k in inside if lens.surfaces[k].curvature is not None]
    usual += [Vary(k, "thickness") for k in (inside, range(0, len(lens.surfaces) - 1))[is_near(name)]]
    return DesignVariables(
        lens, VARY.get(name) or tuple(v for v in usual if (v.surface, v.quantity) not in solved), solves
    )


def lens_of(name):
    """The lens with its solves kept."""
    model = model_of(name)
    return model.lens_at(model.start)


def values_of(name, rows, **options):
    model = model_of(name)
    return Evaluation(model, rows, **options)(model.start).values


def check_derivatives(name, rows, steps=(1e-3, 1e-4, 1e-5), bar=2e-6):
    """Of every row, against central differences of its residuals, the best of several steps."""
    model = model_of(name)
    evaluation = Evaluation(model, [dataclasses.replace(row, weight=1.0) for row in rows])
    x = model.start
    found = evaluation(x, derivatives=True)
    assert np.allclose(found.values, evaluation(x).values, rtol=1e-13, atol=1e-13, equal_nan=True)
    assert not found.lost.any(), [rows[k] for k in np.flatnonzero(found.lost)]
    largest = np.maximum(np.abs(found.jacobian).max(1), 1e-9)
    for i, along in enumerate(np.diag(np.maximum(np.abs(x), 1e-4))):
        worst = np.full(len(found.residuals), np.inf)
        for step in steps:
            ahead, back = (evaluation(x + side * step * along).residuals for side in (1, -1))
            reach = step * along[i]
            noise = 1e-13 * np.maximum(np.abs(found.residuals), 1e-3) / reach
            far = np.abs((ahead - back) / (2 * reach) - found.jacobian[:, i]) - noise
            worst = np.minimum(worst, far / largest)
        bad = [(rows[k].operand, rows[k].integers) for k in found.of_row[worst > bar]]
        assert not bad, (name, model.variables[i], bad, worst.max())
