"""`rt.jacobian` of rays against complex steps of an independent trace (`complex_steps.py`), to rounding."""

import numpy as np
import pytest
import torch
from complex_steps import Numbers, Tracer

import raytrace as rt
from raytrace.tracing.compiled import trace_engine

ROWS = [
    dict(radius=32.0, thickness=5.0, glass=1.62, conic=-0.3),
    dict(radius=-210.0, thickness=4.0, coefficients=[2e-5, 1e-7, -3e-10]),
    dict(radius=-37.0, thickness=2.0, glass=1.6),
    dict(radius=29.0, thickness=3.0),
    dict(radius=float("inf"), thickness=6.0),
    dict(radius=110.0, thickness=4.0, glass=1.62, conic=0.5, coefficients=[0.0, 2e-6]),
    dict(radius=-41.0, thickness=75.0),
]
FIELDS, PUPIL = np.array([[0.0, 1.5, -2.0], [0.0, 4.0, -6.0]]), rt.maths.gauss_rings(3)[0]


def lens_of(rows=ROWS, **changes) -> rt.Lens:
    options = {"stop": 5, "entrance_pupil_diameter": 9.0, "fields": [0.0, 6.0], "wavelengths": [0.55]}
    return rt.lens(rows, **options, **changes)


def with_row(k: int, **changes) -> list[dict]:
    return [row | changes if number == k else row for number, row in enumerate(ROWS, 1)]


def pickup(tracer: Tracer, numbers: Numbers) -> None:
    """thickness:3=2*thickness:1 and curvature:4=-curvature:3+0.001."""
    numbers[3, "thickness"] = 2 * numbers[1, "thickness"]
    numbers[4, "curvature"] = 0.001 - numbers[3, "curvature"]


def f_number(tracer: Tracer, numbers: Numbers) -> None:
    """curvature:7=f_number(8): the curvature behind which the marginal ray has n u = -n/16."""
    numbers[7, "curvature"] = 0j
    y, omega = tracer.marginal_before(numbers, 7)
    change = numbers[7, "index"] - numbers[6, "index"]
    numbers[7, "curvature"] = (omega + numbers[7, "index"] / 16) / (y * change)


CLIPPED = with_row(1, semi_diameter=3.6, apertures=(rt.system.Aperture("circular", (0.0, 3.6)),))
TILTED = with_row(3, tilt_x=1.5, tilt_y=-0.7, y=0.2)

#: Lens, variables, and the solve by which others follow. Clipped rays keep their coordinates and derivatives.
CASES = {
    "curvatures and thicknesses": (lens_of(), "curvature thickness", None),
    "conics and terms": (lens_of(), "conic:1,3,6 a2:2 a4:2,6 a6:2", None),
    "indices": (lens_of(), "index:1,3,6", None),
    "aperture": (lens_of(), "aperture", None),
    "tilts and decentres": (lens_of(TILTED, ray_aiming="off"), "tilt_x:2,3 tilt_y:6 x:4 y:7 curvature:3 sensor", None),
    "pickups": (
        lens_of(),
        "curvature:1,3 thickness:1 thickness:3=2*thickness:1 curvature:4=-curvature:3+0.001",
        pickup,
    ),
    "solve": (lens_of(), "curvature:1,2 thickness:2,6 curvature:7=f_number(8)", f_number),
    "real aiming": (lens_of(ray_aiming="real"), "curvature:1,4 thickness:2,5 a4:6 index:3 aperture", None),
    "clipped rays": (lens_of(CLIPPED), "curvature:1,4 thickness:2 sensor", None),
}


def address_of(name: str) -> tuple[int, str]:
    quantity, _, surface = name.rpartition("_")
    return (int(surface), quantity) if quantity else (0, name)


@pytest.mark.parametrize("engine", ["compiled", pytest.param("eager", marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", CASES)
def test_derivatives_of_rays_are_complex_steps(case, engine):
    lens, vary, solve = CASES[case]
    tracer = Tracer(lens, solve)
    with trace_engine(engine):
        each = {
            of: rt.jacobian(lens, vary, of=of, fields=torch.tensor(FIELDS), pupil=PUPIL)
            for of in ("landing points", "directions", "paths")
        }
    landing, directions, paths = each.values()
    values = tracer.image(dict(tracer.numbers), FIELDS, PUPIL.numpy()).real
    found = np.concatenate([landing.value[:, :, 0], directions.value[:, :, 0], paths.value[None, :, 0]])
    assert np.abs(found - values).max() < 1e-11
    for number, name in enumerate(landing.variables):
        expected = tracer.derivative(address_of(name), FIELDS, PUPIL.numpy())
        slopes = np.concatenate(
            [
                landing.derivatives[number, :, :, 0],
                directions.derivatives[number, :, :, 0],
                paths.derivatives[number, None, :, 0],
            ]
        )
        scale = np.abs(expected).max(axis=(1, 2), keepdims=True) + 1e-9 * np.abs(expected).max()
        assert (np.abs(slopes - expected) / scale).max() < 1e-10, name
