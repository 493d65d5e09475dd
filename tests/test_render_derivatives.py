"""Derivatives of pictures by every kind of number of the lens, through the whole camera, with clipped rays."""

import dataclasses
import warnings

import pytest
import torch
from problems import random

import raytrace as rt
from raytrace.imaging.render import optics, patch_kernels, render_patches
from raytrace.materials.glass import model_glass
from raytrace.system.lens import SystemAperture
from raytrace.system.surface import Aperture

#: Kind of number -> its unit; 1e-4 of that moves light by a tenth of a micrometre.
KINDS = {
    "curvature": 1e-3,  # 1/mm
    "conic": 0.1,
    "asphere": 1e-6,  # mm⁻³
    "thickness": 1.0,  # mm
    "index": 0.01,
    "abbe_number": 10.0,
    "sensor_distance": 1.0,  # mm
    "stop_position": 1.0,  # mm
    "entrance_pupil": 2.0,  # mm
    "stop_radius": 1.0,  # mm
    "semi_diameter": 1.0,  # mm
}
#: On the axis, at an edge and at a corner, mm.
POINTS = torch.tensor([[0.0, 0.0, -9.0], [0.0, 12.0, 11.0]], dtype=torch.float64)
SENSOR = rt.Sensor(size=(1.2, 1.6), pixels=(12, 16), response="rgb", offset=(-5.0, 10.0))
FINE = rt.Sensor(size=(18.0, 24.0), pixels=(900, 1200), response="rgb")
SIZE = 9  # pixels, of FINE: kernels are larger, and lose light at the borders


def base():
    """The double Gauss at F/2 in two colours, 1 mm out of focus; its semi-diameters clip, but that of the stop."""
    lens = rt.read_lens("double_gauss").at(
        f_number=2.0, wavelengths=[0.53, 0.61], object_distance=2e3, sensor_distance=62.0
    )
    for number, surface in enumerate(lens.surfaces[1:-1], 1):
        if number != lens.stop:
            lens = lens.replace(number, apertures=(Aperture("circular", (0.0, surface.semi_diameter)),))
    zero = lens.wavelengths.new_zeros(())
    return lens.replace(3, conic=zero, coefficients=zero.new_zeros(2), glass=model_glass(1.624, 60.0))


def moved(kind, unit):
    """The lens with one number moved by so many of its units."""
    lens, step = base(), unit * KINDS[kind]
    surface = lens.surfaces[3]
    if kind == "curvature":
        return lens.replace(3, curvature=surface.curvature + step)
    if kind == "conic":
        return lens.replace(3, conic=surface.conic + step)
    if kind == "asphere":
        return lens.replace(3, coefficients=torch.stack([torch.zeros_like(step), step]))
    if kind == "thickness":
        return lens.replace(4, thickness=lens.surfaces[4].thickness + step)
    if kind in ("index", "abbe_number"):
        nd, vd, dpgf = surface.glass.coefficients
        numbers = (nd + step, vd, dpgf) if kind == "index" else (nd, vd + step, dpgf)
        return lens.replace(3, glass=dataclasses.replace(surface.glass, coefficients=torch.stack(numbers)))
    if kind == "sensor_distance":
        return lens.at(sensor_distance=lens.surfaces[-2].thickness + step)
    if kind == "stop_position":
        before, behind = (lens.surfaces[lens.stop - back].thickness for back in (1, 0))
        return lens.replace(lens.stop - 1, thickness=before + step).replace(lens.stop, thickness=behind - step)
    if kind == "entrance_pupil":
        return dataclasses.replace(lens, aperture=SystemAperture("entrance_pupil_diameter", 36.0 + step))
    if kind == "stop_radius":  # clips 1 mm inside the beam
        return lens.replace(lens.stop, apertures=(Aperture("circular", (0.0, 11.5 + step)),))
    return lens.replace(7, apertures=(Aperture("circular", (0.0, lens.surfaces[7].semi_diameter - 1.0 + step)),))


def patches(model, order):
    """Light of weighted images of patches."""
    scene, weights = random(3, 3, SIZE + 4, SIZE + 4), random(3, 3, 5, 5, seed=1)
    how = {"sensor": FINE, "size": SIZE, "order": order, "model": model, "illumination": True}

    def light(lens):
        return (weights * render_patches(lens, scene, POINTS, **how)).sum()

    return light


def picture(model, order):
    """Light of a weighted image of the whole sensor, with distortion, illumination and lateral colour."""
    scene, weights = random(3, 16, 12), random(3, 16, 12, seed=1)

    def light(lens):
        ready = optics(lens, SENSOR, model=model, order=order, size=SIZE, nodes=(3, 3), tol=1e-9)  # no low rank
        return (weights * ready(scene)).sum()

    return light


def check(light, move, *, eps, rel, floor=3e-6):
    """The derivative at 0 of the light of a moved lens against differences; floor: of the illumination's quadrature."""
    unit = torch.zeros((), dtype=torch.float64, requires_grad=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        (slope,) = torch.autograd.grad(light(move(unit)), unit)
        with torch.no_grad():
            ahead, behind = (light(move(torch.tensor(sign * eps, dtype=torch.float64))) for sign in (1, -1))
    difference = float(ahead - behind) / (2 * eps)
    assert abs(difference) > 1e-3
    assert float(slope) == pytest.approx(difference, rel=rel, abs=floor)


#: Order, step and tolerance of a model: pixels of DRT have kinks, where the edges of its light cross theirs.
MODELS = {"gaussian": (4, 1e-4, 1e-5), "drt": (2, 1e-6, 5e-3)}
QUICK = {("gaussian", "curvature"), ("drt", "semi_diameter")}


def test_apertures_clip():
    lens = base()
    fields = FINE.fields(lens, POINTS)
    light = rt.relative_illumination(lens, fields=fields).projected_solid_angle
    open_lens = dataclasses.replace(
        lens, surfaces=tuple(dataclasses.replace(surface, apertures=()) for surface in lens.surfaces)
    )
    whole = rt.relative_illumination(open_lens, fields=fields).projected_solid_angle
    assert all(0.5 < float(share) < 0.95 for share in light / whole)


@pytest.mark.parametrize(
    ("model", "kind"),
    [
        pytest.param(model, kind, marks=() if (model, kind) in QUICK else pytest.mark.slow)
        for model in MODELS
        for kind in KINDS
    ],
)
def test_derivatives_of_patches(model, kind):
    order, eps, rel = MODELS[model]
    check(patches(model, order), lambda unit: moved(kind, unit), eps=eps, rel=rel)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "kind"),
    [(model, kind) for model in MODELS for kind in ("curvature", "asphere", "stop_radius", "semi_diameter")],
)
def test_derivatives_of_whole_pictures(model, kind):
    """Where an aperture begins to clip, the derivative of the illumination errs by up to 2e-4 of it."""
    order, eps, rel = MODELS[model]
    check(picture(model, order), lambda unit: moved(kind, unit), eps=eps, rel=max(rel, 1e-3))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["curvature", "thickness", "stop_radius"])
def test_derivatives_of_waves(kind):
    """Stopped down by a clear stop inside the beam, in focus; the derivative is that of the converged kernel: 1e-3."""
    sensor = rt.Sensor(size=(18.0, 24.0), pixels=(4500, 6000))
    points, weights = torch.tensor([[0.0, 0.0], [0.0, 8.0]], dtype=torch.float64), random(2, 1, 9, 9, seed=1)
    lens = rt.focus(rt.read_lens("double_gauss").at(f_number=6, object_distance=2e3, sensor_distance=62.4)).lens
    how = {"sensor": sensor, "size": 9, "order": 0, "model": "wave"}

    def move(unit):
        radius = 4.6 + (unit if kind == "stop_radius" else 0.0)
        found = lens.replace(lens.stop, apertures=(Aperture("circular", (0.0, radius)),))
        if kind == "curvature":
            return found.replace(3, curvature=lens.surfaces[3].curvature + 1e-4 * unit)
        return found.replace(4, thickness=lens.surfaces[4].thickness + 0.1 * unit) if kind == "thickness" else found

    check(lambda lens: (weights * patch_kernels(lens, points, **how)).sum(), move, eps=1e-4, rel=1e-3)
