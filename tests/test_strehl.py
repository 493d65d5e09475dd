"""Strehl ratio: the largest intensity on the whole sensor, its azimuth, its derivatives."""

import dataclasses
import math

import pytest
import torch
from problems import vector

import raytrace as rt
from raytrace.analysis.setting import scene_of
from raytrace.files import shipped
from raytrace.io import read_lens
from raytrace.psf_models import strehl as strehl_module
from raytrace.psf_models.dft import on_lattice
from raytrace.psf_models.strehl import strehl
from raytrace.psf_models.wave import amplitude, one_field, probe_of, waves
from raytrace.system.lens import Lens

COOKE = read_lens(shipped("lenses") / "cooke_triplet.zmx")
OPEN = dataclasses.replace(COOKE, fields=dataclasses.replace(COOKE.fields, vignetting=None))


def ratio(lens: Lens, x: float, y: float, wavelength: float) -> float:
    return strehl(scene_of(lens.at(wavelengths=[wavelength]), vector(x, y)[:, None])).item()


def test_waves_on_a_lattice_are_those_of_the_sum():
    generator = torch.Generator().manual_seed(0)
    u, v, real, imaginary = torch.rand(4, 300, generator=generator, dtype=torch.float64)
    field, u, v = torch.complex(real, imaginary), 0.3 * u, 0.2 * v - 0.1
    k, m = torch.arange(40) - 20, torch.arange(30) - 15
    phases = [torch.exp(2j * math.pi * at[:, None] * n) for at, n in ((v, m), (u, k))]
    expected = (phases[0].T @ (field[:, None] * phases[1])).abs()
    found = on_lattice(field, u, v, (30, 40)).sqrt()
    assert (found - expected).abs().max() < 0.02 * expected.max()


@pytest.mark.parametrize(("wavelength", "expected"), [(0.5875618, 0.00424), (0.6562725, 0.00816)])
def test_the_largest_intensity_is_found_wherever_it_is(wavelength, expected):
    """At 11.9° it lies 20 λ/NA from the centroid of the rays, where a window about them missed it."""
    view = one_field(scene_of(COOKE.at(wavelengths=[wavelength]), vector(0.0, 11.9)[:, None]), 0)
    probe = probe_of(view)
    light = waves(view, 1.5 * probe.landing.abs().max(), order=1, probe=probe)
    low, high = probe.landing.amin(-1).flatten(), probe.landing.amax(-1).flatten()
    x, y = (torch.linspace(float(a), float(b), 300, dtype=torch.float64) for a, b in zip(low, high, strict=True))
    U = amplitude(light, x[None, None, None], y[None, None, None])
    peak = light.amplitude.sum() * float(probe.index) / (1e-3 * wavelength)
    dense = float((U.real**2 + U.imag**2).max() / peak**2)
    found = strehl(view).item()
    assert found == pytest.approx(expected, abs=2e-5)
    assert dense <= found * (1 + 1e-6)
    assert found == pytest.approx(dense, rel=0.03)  # points of a grid beside the maximum


def test_the_azimuth_of_a_field_does_not_matter():
    size = math.degrees(math.atan(math.hypot(math.tan(math.radians(6)), math.tan(math.radians(8)))))
    assert ratio(OPEN, 6.0, 8.0, 0.6) == pytest.approx(ratio(OPEN, 0.0, size, 0.6), rel=1e-4)


def test_series_of_few_rays_are_those_of_all(monkeypatch):
    few = ratio(COOKE, 0.0, 11.9, 0.6)
    monkeypatch.setattr(strehl_module, "_WORTH", math.inf)
    assert few == pytest.approx(ratio(COOKE, 0.0, 11.9, 0.6), rel=1e-5)


def test_derivatives_are_those_of_the_maximum_which_moves():
    """By a curvature of a singlet with coma: second derivatives count the motion of the maximum."""
    rows = [dict(curvature=0.04, thickness=3.0, glass=1.5), dict(curvature=0.0, thickness=48.0)]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=4.0, fields=[3.0], wavelengths=[0.55])

    def of(curvature):
        return strehl(scene_of(lens.replace(2, curvature=curvature), vector(0.0, 3.0)[:, None])).sum()

    c, step = torch.tensor(3e-4, dtype=torch.float64, requires_grad=True), 1e-6
    first = torch.autograd.grad(of(c), c, create_graph=True)[0]
    second = torch.autograd.grad(first, c)[0]
    low, here, high = (of(3e-4 + k * step).item() for k in (-1, 0, 1))
    assert first.item() == pytest.approx((high - low) / (2 * step), rel=3e-5)
    assert second.item() == pytest.approx((high - 2 * here + low) / step**2, rel=3e-5)


def test_the_second_derivative_of_a_vignetted_field_is_that_of_the_gradient():
    """Cooke triplet at F/4, 10°: the maximum is far from the point of the grid from which it is climbed to."""
    lens = COOKE.at(f_number=4, wavelengths=[0.4861327])

    def gradient(curvature):
        c = torch.tensor(curvature, dtype=torch.float64, requires_grad=True)
        ratio = rt.wavefront(lens.replace(1, curvature=c), fields=[10.0], size=9).strehl.sum()
        return torch.autograd.grad(ratio, c, create_graph=True)[0], c

    here = COOKE.surfaces[1].curvature.item()
    second = torch.autograd.grad(*gradient(here))[0].item()
    narrow, wide = ((gradient(here + k)[0] - gradient(here - k)[0]).item() / (2 * k) for k in (2e-8, 4e-8))
    assert second == pytest.approx((4 * narrow - wide) / 3, rel=1e-6)
