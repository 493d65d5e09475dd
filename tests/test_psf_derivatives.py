"""Derivatives of PSF kernels in every kind of parameter, with rays vignetted: exact for the kernel that is computed,
and towards those of the converged kernel as rays are added."""

import pytest
import torch
from differences import gradcheck
from problems import scalar, vector
from problems_psf import ANGLE, KINDS, base, moved

from raytrace.maths.sampling import Grid
from raytrace.psf_models import drt, gaussian
from raytrace.psf_models.drt import energy_of_fans
from raytrace.psf_models.models import MODELS
from raytrace.tracing.scene import scene, trace_scene

#: Of the Gaussian model in the slow suite: seconds, and kinds alike are tested.
DEAR = ("conic", "thickness", "abbe_number", "sensor_distance", "pitch", "field_x")
BLIND = {("paraxial", "conic"), ("paraxial", "asphere")}  # and to what stops the beam


def pixels_at(model: str, pitch: float = 0.03, size: int = 3) -> Grid:
    """A window off the centroid: nothing in it is symmetric."""
    whole = Grid(scalar(1.0), 1, 1, vector(0.0, 0.0))
    order = 3 if model == "gaussian" else 0
    centroid = MODELS[model].kernels(moved("index", scalar(0.0), whole)[0], whole, order=order).centroid.flatten()
    return Grid(scalar(pitch), size, size, centroid + vector(0.0031, -0.0057))


def slope(function, start: torch.Tensor) -> torch.Tensor:
    """df/dx by one forward derivative."""
    return torch.func.jvp(function, (start,), (torch.ones_like(start),))[1]


def test_rays_are_vignetted():
    at_rest = moved("index", scalar(0.0), pixels_at("gaussian"))[0]
    valid = trace_scene(at_rest, gaussian.fold_pupil(4, "none", scalar(0.0))[0]).valid
    assert 0 < int(valid.sum()) < valid.numel()


@pytest.mark.parametrize(
    ("model", "order", "kind"),
    [
        pytest.param(model, order, kind, marks=pytest.mark.slow if model == "gaussian" and kind in DEAR else ())
        for model, order in (("paraxial", 0), ("gaussian", 2), ("drt", 1))
        for kind in KINDS
    ],
)
def test_derivative_is_that_of_the_kernel(model, order, kind):
    """Differences over a millionth of a unit err by 1e-12 of the third derivative and by rounding, 1e-7."""
    where = pixels_at(model)

    def kernel(unit):
        return MODELS[model].kernels(*moved(kind, unit, where), order=order).kernel

    unit = scalar(0.0).requires_grad_()
    result = kernel(unit)
    if (model, kind) in BLIND:
        assert not result.requires_grad or float(torch.autograd.grad(result.square().sum(), unit)[0]) == 0
        return
    (whole,) = torch.autograd.grad(result.square().sum(), unit)
    assert abs(float(whole)) > 1e-5
    assert gradcheck(kernel, unit, eps=1e-6, atol=1e-7, rtol=1e-5, fast_mode=True)


@pytest.mark.parametrize(
    "kind", ["curvature", *(pytest.param(k, marks=pytest.mark.slow) for k in ("thickness", "field_x"))]
)
def test_derivative_of_drt_comes_near_that_of_the_converged_kernel(kind):
    """Relative L1 against differences of 131,072 cells of a map of degree 16: 6 % at order 0, under 1.5 % at 6."""
    where = pixels_at("drt", size=15)

    def converged(unit):
        of, _ = moved(kind, scalar(unit), where)
        return energy_of_fans(where, drt.fans_of_map(drt.fit(of, 16), 512, 256))

    with torch.no_grad():
        expected = (converged(1e-3) - converged(-1e-3)) / 2e-3
    errors = []
    for order in (0, 6):
        result = slope(
            lambda unit, n=order: MODELS["drt"].kernels(*moved(kind, unit, where), order=n).kernel, scalar(0.0)
        )
        errors.append(float((result - expected).abs().sum() / expected.abs().sum()))
    assert errors[1] < 0.015
    assert errors[1] < 0.4 * errors[0]


@pytest.mark.slow
def test_derivative_of_the_transmitted_light_follows_the_edge_of_the_pupil():
    """Energy and σ² of `gaussian` at order 4 against differences at order 12: their own accuracy is 1e-6 here."""

    def light(unit, order):
        result = gaussian.kernels(*moved("curvature", unit, Grid(scalar(10.0), 1, 1, vector(0.0, 0.0))), order=order)
        return torch.stack([result.kernel.sum(), result.covariance[0].sum(), result.covariance[2].sum()])

    result = slope(lambda unit: light(unit, 4), scalar(0.0))
    with torch.no_grad():
        expected = (light(scalar(1e-3), 12) - light(scalar(-1e-3), 12)) / 2e-3
    assert abs(float(result[0])) > 0.01
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(
    ("transform", "angle"),
    [
        pytest.param(transform, angle, marks=pytest.mark.slow if transform != "reverse" else ())
        for transform in ("reverse", "forward", "second")
        for angle in (0.0, ANGLE)
    ],
)
def test_symmetry_hides_no_derivative_by_the_field(transform, angle):
    """dx of the centroid is about 1.7 mm a degree, to the digit of differences; d²x is that of a third-order lens."""
    lens, pixel = base(), Grid(scalar(1.0), 1, 1, vector(0.0, 0.0))

    def height(field):
        fields = torch.stack([0.5 * field, angle + 0 * field])[:, None]
        return gaussian.kernels(scene(lens, fields, vector(1e4), vector(0.53)), pixel, order=3).centroid[0].sum()

    start, step = (scalar(0.5), 1e-3) if transform == "second" else (scalar(0.0), 1e-5)
    ahead, here, behind = (height(start + sign * step) for sign in (1, 0, -1))
    first, second = (ahead - behind) / (2 * step), (ahead - 2 * here + behind) / step**2
    if transform == "second":
        assert abs(float(second)) > 1e-5
        result = slope(torch.func.grad(height), start)
        assert float(result) == pytest.approx(float(second), rel=1e-2)
    else:
        assert abs(float(first)) > 0.5
        result = torch.func.grad(height)(start) if transform == "reverse" else slope(height, start)
        assert float(result) == pytest.approx(float(first), rel=1e-7)


@pytest.mark.parametrize("model", [pytest.param("gaussian", marks=pytest.mark.slow), "drt"])
def test_derivative_by_a_field_on_the_axis_under_transforms(model):
    """Windows off the axis: light moves out of them in x and in y alike."""
    lens, pixels = base(), Grid(scalar(0.03), 2, 2, vector(0.01, 0.01))

    def energy(fields):
        return MODELS[model].kernels(scene(lens, fields, vector(1e4), vector(0.53)), pixels, order=2).kernel.sum()

    axis = vector(0.0, 0.0)[:, None]
    step = 1e-6 * torch.eye(2, dtype=torch.float64)[:, :, None]
    expected = torch.stack([(energy(axis + s) - energy(axis - s)) / 2e-6 for s in step]).flatten()
    assert bool((expected.abs() > 0.1).all())
    torch.testing.assert_close(torch.func.grad(energy)(axis).flatten(), expected, rtol=1e-5, atol=1e-7)
    forward = [torch.func.jvp(energy, (axis,), (1e6 * s,))[1] for s in step]
    torch.testing.assert_close(torch.stack(forward), expected, rtol=1e-5, atol=1e-7)
