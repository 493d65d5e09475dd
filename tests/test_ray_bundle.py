"""Bundles: the rays of `tracing.launch`, traced with the derivatives that finite differences have."""

import dataclasses

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace.files import shipped
from raytrace.materials.glass import model_glass
from raytrace.maths.numerics import Dual
from raytrace.optimization.lens_state import Bundle, rays_by_torch
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import with_field_kind
from raytrace.system.optimization_data import Solve, Vary
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import trace_lens

pytestmark = pytest.mark.usefixtures("compiler")

PUPIL = [(0.0, 0.0), (0.3, 0.7), (-0.5, 0.4), (0.0, -0.9), (0.9, 0.1)]
FIELDS = [(0.0, 0.0), (0.0, 0.7), (0.4, -0.6)]


def with_model_glasses(lens):
    return lens.replace(1, glass=model_glass(1.62, 60.0, 0.01)).replace(3, glass=model_glass(1.64, 35.0))


def behind_focus(gauss, fields):
    """A lens that images its stop in front of a near object, and whose light therefore leaves the pupil first."""
    lens = dataclasses.replace(gauss, stop=len(gauss.surfaces) - 2, fields=fields).replace(9, thickness=400.0)
    lens = lens.at(object_distance=1.0, entrance_pupil_diameter=20.0)
    assert float(rt.first_order(lens).entrance_pupil_position) < -1
    return lens


def lenses():
    gauss = rt.read_lens("double_gauss")
    near = gauss.at(object_distance=300.0, wavelengths=[0.48, 0.6])
    height = dataclasses.replace(near.fields, kind="object_height", y=near.fields.y * 2)
    image = dataclasses.replace(gauss.fields, kind="paraxial_image_height", y=gauss.fields.y * 1.5)
    return {
        "at infinity": gauss.at(wavelengths=[0.48, 0.53, 0.6]),
        "f-number": gauss.at(f_number=4),
        "near": near,
        "object heights": dataclasses.replace(near, fields=height),
        "image heights": dataclasses.replace(gauss, fields=image),
        "image heights, near": dataclasses.replace(near, fields=image),
        "real image heights": with_field_kind(dataclasses.replace(gauss, fields=image), "real_image_height"),
        "aimed": gauss.at(ray_aiming="real"),
        "aimed by the paraxial ray": near.at(ray_aiming="paraxial"),
        "virtual": dataclasses.replace(gauss.at(object_distance=-300.0), fields=height),
        "virtual, before the pupil": dataclasses.replace(
            gauss.at(object_distance=-30.0, entrance_pupil_diameter=5.0),
            fields=dataclasses.replace(height, y=0.2 * height.y),
        ),
        "pupil before the object": behind_focus(gauss, height),
        "cooke": rt.read_lens("cooke_triplet"),
        "mirrors": rt.read_lens("hubble"),
        "aspheres": rt.read_lens("phone"),
        "glasses": with_model_glasses(gauss.at(wavelengths=[0.48, 0.53, 0.6])),
        "tilted": rt.read_lens(shipped("lenses") / "examples" / "folded_relay.zmx"),
    }


VARY = {
    "mirrors": (Vary(2, "curvature"), Vary(2, "conic"), Vary(2, "thickness"), Vary(3, "curvature")),
    "aspheres": (Vary(3, "a4"), Vary(3, "a6"), Vary(4, "curvature"), Vary(5, "thickness")),
    "glasses": (Vary(1, "index"), Vary(1, "abbe_number"), Vary(1, "partial_dispersion"), Vary(3, "index")),
    "tilted": (Vary(3, "thickness"),),
}
#: Launched by torch, variable by variable or ray by ray.
SLOW = "tilted", "real image heights"
USUAL = Vary(1, "curvature"), Vary(3, "thickness"), Vary(4, "conic"), Vary(6, "curvature")
SOLVES = (Solve(8, "curvature", "pickup", source=1, scale=-0.7, offset=0.001),)


@pytest.fixture(scope="module")
def cases():
    return lenses()


def bundle_of(lens, name):
    solves = SOLVES if name not in VARY and len(lens.surfaces) > 9 else ()
    model = DesignVariables(lens, VARY.get(name, USUAL), solves)
    bundle = Bundle(model.views[0], len(lens.surfaces) - 1)
    for field in FIELDS:
        for wavelength in range(len(lens.wavelengths)):
            for pupil in PUPIL:
                bundle.ask(wavelength, field, pupil)
    return model, bundle


def table_of(hits):
    return np.stack([*hits.position, *hits.direction, hits.opl])


@pytest.mark.parametrize("name", lenses())
def test_rays_are_those_of_launch(cases, name):
    lens = cases[name]
    model, bundle = bundle_of(lens, name)
    here = model.lens_at(model.start)
    largest = torch.hypot(lens.fields.x, lens.fields.y).max()
    rays = launch(
        here, torch.tensor(PUPIL, dtype=torch.float64).T, fields=largest * torch.tensor(FIELDS, dtype=torch.float64).T
    )
    end = trace_lens(here, rays, here.wavelengths[:, None])
    hits = bundle.hits(model.views[0].state(model.start))
    expected = torch.cat([end.position, end.direction, end.opl[None]]).reshape(7, -1).numpy()
    valid = hits.valid & end.valid.reshape(-1).numpy()
    assert valid.mean() >= 0.75
    assert np.allclose(table_of(hits)[:, valid], expected[:, valid], rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "engine"),
    [
        *(pytest.param(name, "compiled", marks=pytest.mark.slow if name in SLOW else ()) for name in lenses()),
        ("near", "eager"),
        ("aspheres", "eager"),
    ],
)
def test_derivatives_are_those_of_finite_differences(cases, name, engine):
    model, bundle = bundle_of(cases[name], name)
    x, count = model.start, len(model.start)
    with rt.tracing.trace_engine(engine):
        hits = bundle.hits(model.views[0].state(Dual(x, np.eye(count))))
        for k in range(count):
            step = 1e-6 * max(abs(x[k]), 1e-3)
            ahead, back = (
                table_of(bundle.hits(model.views[0].state(x + sign * step * np.eye(count)[k]))) for sign in (1, -1)
            )
            slopes = np.stack([p.full()[k] for p in (*hits.position, *hits.direction, hits.opl)])
            difference = ((ahead - back) / (2 * step))[:, hits.valid]
            size = np.abs(difference).max(1, keepdims=True)
            rounding = 2e-14 * np.maximum(np.abs(ahead).max(), 1) / step
            assert (np.abs(slopes[:, hits.valid] - difference) <= 2e-5 * size + rounding).all()


@pytest.mark.parametrize(
    "name",
    [
        "at infinity",
        "near",
        "image heights, near",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("aimed", "aimed by the paraxial ray")),
    ],
)
def test_the_launch_in_numpy_is_that_of_torch(cases, name):
    model, bundle = bundle_of(cases[name], name)
    state = model.views[0].state(Dual(model.start, np.eye(len(model.start))))
    in_numpy = bundle.launched(state)
    by_torch, _ = rays_by_torch(state, bundle._start_by_torch, bundle.field.shape[1:])
    for one, other in zip((*in_numpy[0], *in_numpy[1], in_numpy[2]), by_torch, strict=True):
        one = one if isinstance(one, Dual) else Dual(one, np.zeros_like(other.slope))
        assert np.allclose(one.value, other.value, rtol=1e-9, atol=1e-9)
        assert np.allclose(one.full(), other.full(), rtol=1e-6, atol=1e-7 * (1 + np.abs(other.slope).max()))
