"""Ray map: converges to the traced PSF, knows its own error, falls back where no polynomial fits."""

import dataclasses
from pathlib import Path

import pytest
import torch
from problems import number, relative_l1, sharp_double_gauss

from raytrace.io import read_lens
from raytrace.maths.sampling import Grid, grid
from raytrace.psf_models import drt
from raytrace.psf_models.drt import fit, kernels, reference
from raytrace.system.lens import Lens
from raytrace.system.surface import Aperture
from raytrace.tracing.scene import scene

LENSES = Path(__file__).parents[1] / "lenses"
NANOMETRE = 1e-6


def scene_of(lens: Lens, *fields: float, distance: float = 1e4):
    wavelength = lens.primary[None]
    return scene(lens, number([[0.0] * len(fields), fields]), number([distance]), wavelength)


def window(of, pitch: float = 0.005, size: int = 21) -> Grid:
    centre = drt.kernels_of_rays(of, grid(pitch, 3), order=2).centroid.detach()
    return Grid(number(pitch), size, size, centre)


@pytest.mark.parametrize("field", [0.0, 10.0, 14.0])
def test_dozens_of_rays_place_every_ray_to_a_nanometre(field):
    of = scene_of(sharp_double_gauss(), field)
    result = fit(of, 12)
    assert result.rays <= 60
    assert float(result.residual.max()) < 1 * NANOMETRE
    assert float(fit(of, 8).residual.max()) < 100 * NANOMETRE


@pytest.mark.parametrize("field", [0.0, 10.0, 14.0])
def test_error_halves_with_each_order(field):
    of = scene_of(sharp_double_gauss(), field)
    where = window(of)
    best = reference(of, where, lines=1024)
    with torch.no_grad():
        errors = [relative_l1(kernels(of, where, order=order).kernel, best) for order in (1, 3, 5)]
    assert errors[0] < 0.01
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.6 * errors[1]


@pytest.mark.slow
def test_agrees_with_a_histogram_of_a_million_rays():
    of = scene_of(sharp_double_gauss(), 14.0)
    where = window(of)
    with torch.no_grad():
        counted = drt.kernels_of_rays(of, where, rays=2**20, width=0).kernel
    assert relative_l1(kernels(of, where, order=4).kernel, counted) < 0.003


@pytest.mark.slow
def test_smooth_vignetting_edges_are_mapped():
    of = scene_of(sharp_double_gauss(stop=11.5), 10.0)
    where = window(of)
    with torch.no_grad():
        counted = drt.kernels_of_rays(of, where, rays=2**19, width=0).kernel
        result = kernels(of, where, order=4)
    assert float(result.residual.min()) > 0, "of a map"
    assert float(counted.sum()) < 0.97
    assert float(result.kernel.sum()) == pytest.approx(float(counted.sum()), abs=1e-3)
    assert relative_l1(result.kernel, counted) < 0.005


def test_central_obscuration_is_mapped():
    of = scene_of(read_lens(LENSES / "hubble.zmx"), 0.05, distance=float("inf"))
    result = kernels(of, window(of, pitch=0.02), order=4)
    assert float(result.residual.min()) > 0, "of a map"
    assert float(result.kernel.sum()) == pytest.approx(1 - (396 / 1200) ** 2, abs=1e-3)


@pytest.mark.slow
def test_traces_all_rays_where_no_map_fits():
    """Wild aspheric terms: no map of degree 20 follows them. And a surface too small for the beam: rays are lost."""
    lens = sharp_double_gauss()
    wild = torch.zeros(16, dtype=torch.float64)
    wild[15] = 2e-39
    result = kernels(scene_of(lens.replace(3, coefficients=wild), 0.0), grid(0.005, 5), order=2)
    assert float(result.residual.max()) == 0
    assert torch.isfinite(result.kernel).all()
    lost = scene_of(lens.replace(3, curvature=1 / 12.0), 0.0)
    assert float(kernels(lost, grid(0.005, 5), order=0).residual.max()) == 0


def test_a_batch_of_fields_is_its_members():
    lens = sharp_double_gauss()
    of = scene_of(lens, 0.0, 10.0)
    where = window(of)
    both = kernels(of, where, order=4).kernel
    for i, field in enumerate((0.0, 10.0)):
        alone = kernels(scene_of(lens, field), Grid(where.pitch, 21, 21, where.centre[:, :, i : i + 1]), order=4).kernel
        assert relative_l1(both[:, i : i + 1], alone) < 0.005


@pytest.mark.parametrize("field", [0.0, 10.0])
@pytest.mark.parametrize("name", ["curvature", "sensor"])
def test_derivatives_are_those_of_the_kernel_with_vignetted_rays(field, name):
    lens = sharp_double_gauss(stop=11.5)
    where = window(scene_of(lens, field))
    weight = torch.randn(21, 21, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def merit(shift):
        if name == "curvature":
            changed = lens.replace(3, curvature=lens.surfaces[3].curvature + 1e-4 * shift)
        else:
            changed = lens.at(sensor_distance=lens.surfaces[-2].thickness + shift)
        return (kernels(scene_of(changed, field), where, order=2).kernel * weight).sum()

    at = number(0.0).requires_grad_()
    (slope,) = torch.autograd.grad(merit(at), at)
    step = 1e-7  # mm: cells cross no edge of a pixel on the way
    with torch.no_grad():
        difference = (merit(number(step)) - merit(number(-step))) / (2 * step)
    assert float(slope) == pytest.approx(float(difference), rel=2e-3, abs=1e-6)


def test_half_of_a_symmetric_fan_represents_all_of_it(monkeypatch):
    """Kernels, moments and gradients of a field along y from the lines of x > 0, and from all lines."""
    system = sharp_double_gauss()
    bend = system.surfaces[2].curvature.clone().requires_grad_()
    of = scene_of(system.replace(2, curvature=bend), 9.0)
    pixels = window(of, 0.02, 9)
    pixels = dataclasses.replace(pixels, centre=torch.stack([torch.zeros_like(pixels.centre[0]), pixels.centre[1]]))
    weights = torch.linspace(0.5, 2.0, 81, dtype=torch.float64).reshape(9, 9)

    def outcome():
        result = kernels(of, pixels, order=2)
        (gradient,) = torch.autograd.grad((result.kernel * weights).sum() + result.covariance.sum(), bend)
        return result.kernel.detach(), result.centroid.detach(), result.covariance.detach(), gradient

    half = outcome()
    monkeypatch.setattr(drt, "varies", lambda tensor: True)
    whole = outcome()
    assert float(half[0].sum()) > 0.5
    assert not torch.equal(half[0], whole[0])
    for one, all_of_it in zip(half, whole, strict=True):
        torch.testing.assert_close(one, all_of_it, rtol=1e-8, atol=1e-9)


def test_apertures_beyond_the_beam_are_left_out_of_the_cells(monkeypatch):
    """A rim of which the beam stays clear costs no shares of cells; one that clips it is counted."""
    where, seen = window(scene_of(sharp_double_gauss(), 11.0)), []
    clear_share = drt.clear_share
    monkeypatch.setattr(
        drt, "clear_share", lambda clear, *a, **o: (seen.append(len(clear)), clear_share(clear, *a, **o))[1]
    )

    def kernel(**rims: float) -> tuple[torch.Tensor, torch.Tensor, set[int]]:
        lens, curvature = sharp_double_gauss(), number(0.0).requires_grad_()
        lens = lens.replace(3, curvature=lens.surfaces[3].curvature + curvature)
        for name, radius in rims.items():
            lens = lens.replace(int(name[1:]), apertures=(Aperture("circular", (0.0, radius)),))
        seen.clear()
        energy = kernels(scene_of(lens, 11.0), where, order=0).kernel
        (slope,) = torch.autograd.grad(energy.square().sum(), curvature)
        return energy.detach(), slope, set(seen)

    (bare, _, none), (wide, _, left) = kernel(), kernel(s1=40.0, s10=60.0)
    assert none == left == {0}
    assert torch.equal(bare, wide)
    (clips, slope, one), (both, by_both, still) = kernel(s1=18.0), kernel(s1=18.0, s10=60.0)
    assert one == still == {1}
    assert torch.equal(clips, both)
    assert torch.equal(slope, by_both)
    assert float(clips.sum()) < 0.98 * float(bare.sum())
    monkeypatch.setattr(drt, "_bounded", lambda ray_map, *rest: ray_map)
    every, by_every, all_of_them = kernel(s1=18.0, s10=60.0)
    assert all_of_them == {2}
    torch.testing.assert_close(both, every, rtol=0, atol=1e-15)
    torch.testing.assert_close(by_both, by_every, rtol=1e-12, atol=0)
