"""The window of a PSF follows the chief ray or the centroid, in the derivatives too, unless it is held."""

import dataclasses

import pytest
import torch
from differences import gradcheck
from problems import scalar, sharp_double_gauss, vector
from problems_psf import moved

import raytrace as rt
from raytrace.maths.sampling import grid
from raytrace.psf_models import DRT, Fourier, Gaussian, Paraxial, Wave, psf
from raytrace.system.lens import Lens, SystemAperture
from raytrace.system.surface import Aperture
from raytrace.tracing.scene import chief_landing, scene
from raytrace.wave_optics.hybrid import hybrid_psf

#: Model, what is done, whether of a narrow beam (few waves). All beams are clipped but those of plain rays, whose rim
#: has no derivative: a ray that crosses it within a step would be a jump of the difference.
WORK = {
    "paraxial": (Paraxial(order=0), {}, False),
    "fourier": (Fourier(order=-2), {}, True),
    "gaussian": (Gaussian(order=2), {}, False),
    "drt": (DRT(order=0), {}, False),
    "plain rays": (DRT(rays=64), {}, False),
    "wave": (Wave(order=-2), {}, True),
    "auto": ("auto", {"tol": 2.0}, True),
}
LENGTHS = "thickness", "sensor_distance", "object_distance", "pitch"
KINDS = ("curvature", "conic", "asphere", "index", "field_y", *LENGTHS)
SKEW, UPRIGHT, AXIS = (1.5, 1.0), (0.0, 2.0), (0.0, 0.0)  # degrees


def kernels(name: str, kind: str, unit: torch.Tensor, field: tuple[float, float], **where) -> torch.Tensor:
    """5 × 5 pixels of 30 µm of the clipped double Gauss at 10 m, one number moved by so many of its units."""
    model, work, narrow = WORK[name]
    at, pixels = moved(kind, unit, grid(scalar(0.03), 5))
    lens = at.lens
    if narrow:
        lens = dataclasses.replace(lens, aperture=SystemAperture("entrance_pupil_diameter", scalar(4.0)))
        lens = lens.replace(5, apertures=(Aperture("circular", (0.0, 1.2)),))
    elif name == "plain rays":
        lens = lens.replace(5, apertures=())
    fields = at.fields - vector(*UPRIGHT)[:, None] + vector(*field)[:, None]
    distances = at.lens.surfaces[0].thickness.flatten()
    return psf(
        lens, model, fields=fields, object_distances=distances, wavelengths=at.wavelengths, grid=pixels, **where, **work
    ).kernel


#: Every model off the axis in each run, by few numbers; all numbers and places in the slow ones.
CASES = [
    *((name, "chief", SKEW, ("curvature", "field_y")) for name in WORK if name != "auto"),
    *((name, "centroid", SKEW, ("curvature",)) for name in WORK if name != "auto"),
    *(
        pytest.param(name, center, field, KINDS[::3] if name in ("wave", "auto") else KINDS, marks=pytest.mark.slow)
        for name in WORK
        for center in ("axis", "chief", "centroid")
        for field in ((AXIS,) if center == "axis" else (SKEW, UPRIGHT, AXIS))
    ),
]


@pytest.mark.parametrize(("name", "center", "field", "kinds"), CASES)
def test_derivative_is_that_of_the_kernel_in_its_window(name, center, field, kinds):
    """Off the axis 5 to 100 % of a derivative is that of the window.

    Differences of waves over 1e-4 of a unit err by 1e-9 of the third derivative and by 1e-8/1e-4 of rounding.
    """
    eps, atol = (1e-4, 3e-5) if name in ("wave", "auto") else (1e-6, 1e-7)
    for kind in kinds:
        unit = scalar(0.0).requires_grad_()

        def kernel(unit, kind=kind):
            return kernels(name, kind, unit, field, center=center)

        assert gradcheck(kernel, unit, eps=eps, atol=atol, rtol=1e-5, fast_mode=True), kind


@pytest.mark.parametrize("center", ["chief", "centroid"])
@pytest.mark.parametrize("name", ["gaussian", "drt"])
def test_a_held_window_has_the_derivative_of_a_grid_at_its_place(name, center):
    def slope(**where):
        unit = scalar(0.0).requires_grad_()
        kernel = kernels(name, "curvature", unit, SKEW, **where)
        return kernel.detach(), torch.autograd.grad((kernel * kernel.detach().cumsum(-1)).sum(), unit)[0]

    (follows, moving), (held, fixed) = (slope(center=center, window=window) for window in ("follows", "fixed"))
    torch.testing.assert_close(held, follows, rtol=0, atol=0)
    at = psf_centre(name, center)
    model, work, _ = WORK[name]

    def on_grid(unit):
        lens = moved("curvature", unit, grid(scalar(0.03), 5))[0].lens
        where = {"fields": vector(*SKEW)[:, None], "object_distances": vector(1e4), "wavelengths": vector(0.53)}
        return psf(lens, model, grid=grid(scalar(0.03), 5, at), **where, **work).kernel

    unit = scalar(0.0).requires_grad_()
    kernel = on_grid(unit)
    torch.testing.assert_close(kernel.detach(), held, rtol=1e-9, atol=1e-12)
    (expected,) = torch.autograd.grad((kernel * kernel.detach().cumsum(-1)).sum(), unit)
    assert float(fixed) == pytest.approx(float(expected), rel=1e-8)
    assert abs(float(moving) - float(fixed)) > 0.02 * abs(float(fixed))


def psf_centre(name: str, center: str) -> torch.Tensor:
    model, work, _ = WORK[name]
    lens = moved("curvature", scalar(0.0), grid(scalar(0.03), 5))[0].lens
    where = {"fields": vector(*SKEW)[:, None], "object_distances": vector(1e4), "wavelengths": vector(0.53)}
    return psf(lens, model, grid=grid(scalar(0.03), 5), center=center, **where, **work).grid.centre[:, 0, 0]


@pytest.mark.slow
def test_a_held_window_has_no_forward_derivative_either():
    def centre(unit, window):
        at = moved("curvature", unit, grid(scalar(0.03), 3))[0]
        result = psf(
            at.lens, Gaussian(order=2), fields=at.fields, object_distances=vector(1e4), center="chief", window=window
        )
        return result.grid.centre.sum()

    moving, fixed = (
        torch.func.jvp(lambda unit, w=window: centre(unit, w), (scalar(0.0),), (scalar(1.0),))[1]
        for window in ("follows", "fixed")
    )
    assert abs(float(moving)) > 1e-3
    assert float(fixed) == 0


def test_a_window_on_the_axis_of_a_round_lens_is_a_constant():
    """Models of round light depend on it: a centre that may vary costs them their symmetry."""
    lens: Lens = sharp_double_gauss()
    curvature = lens.surfaces[3].curvature.clone().requires_grad_()
    lens = lens.replace(3, curvature=curvature)
    for center in ("chief", "centroid"):
        centre = rt.psf(lens, rt.psf_models.Gaussian(order=2), fields=[0], center=center).grid.centre
        assert not centre.requires_grad
        assert bool((centre == 0).all())
    view = scene(lens, vector(0.0, 0.0, 0.0, 3.0).reshape(2, 2), vector(1e4), vector(0.53))
    assert chief_landing(view).requires_grad


def test_windows_of_a_lens_with_elements_follow_the_chief_ray():
    """`hybrid_psf` without elements: its kernels are those of the wave model."""
    base = dataclasses.replace(sharp_double_gauss(), aperture=SystemAperture("entrance_pupil_diameter", scalar(4.0)))

    def kernel(curvature):
        lens = base.replace(3, curvature=curvature)
        return hybrid_psf(
            lens, (), fields=[5.0], object_distances=[1e4], wavelengths=[0.53], pixel=0.01, size=5, order=-2
        ).kernel

    curvature = base.surfaces[3].curvature.clone().requires_grad_()
    assert gradcheck(kernel, curvature, eps=1e-7, atol=1e-2, rtol=1e-4, fast_mode=True)


def test_a_window_that_is_not_known_is_refused():
    with pytest.raises(ValueError, match=r"'moving' .*follows, fixed"):
        rt.psf(sharp_double_gauss(), "gaussian", window="moving")
