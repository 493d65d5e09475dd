"""Cross-sections of PSFs against closed forms: the Airy pattern and its line spread, Gaussians, derivatives."""

import csv
import json
import math

import problems
import pytest
import torch
from problems import scalar, vector
from scipy.special import struve

import raytrace as rt
from raytrace.cli import main
from raytrace.psf_models.cross_section import fwhm
from raytrace.tracing.spot import image_rays

WAVELENGTH = 0.55e-3  # mm


def test_widths_of_curves():
    """Of a triangle and of two peaks, whose outermost sides count; nan without a side."""
    x = torch.arange(9, dtype=torch.float64)
    curves = vector(
        *(0, 0, 1, 2, 1, 0, 0, 0, 0), *(0, 2, 0, 0, 0, 4, 4, 0, math.nan), *(3, 4, 1, 0, 0, 0, 0, 0, 0)
    ).reshape(3, 9)
    assert fwhm(x.expand(3, 9), curves).tolist() == pytest.approx([2, 5.5, math.nan], nan_ok=True)


def test_the_airy_pattern_and_its_line_spread():
    """Profile (2 J₁(v)/v)², FWHM 1.029 λ/2NA; line spread (3π/8) H₁(2v)/v², Struve's function (Goodman, §6): to NA²."""
    lens = problems.plano_hyperbolic(0.0, diameter=4.0)
    aperture = abs(float(image_rays(lens, vector(0.0, 1.0)[:, None]).direction[1, 0, 0, 0]))
    # Off by a few pixels, and not square: the peak and the sides of a window are not confused.
    grid = rt.maths.grid(0.4e-3, (151, 111), vector(1.2e-3, -2.0e-3))
    cut = rt.psf(lens, "wave", grid=grid, center="axis", tol=1e-3).cross_section()
    width = 1.02899 * WAVELENGTH / (2 * aperture)
    assert cut.profile_fwhm.flatten().tolist() == pytest.approx([width] * 2, rel=5e-3)
    for a, size in enumerate((111, 151)):
        x, profile, spread = (t[a, 0, 0, :size] for t in (cut.position, cut.profile, cut.line_spread))
        assert torch.isnan(cut.position[a, 0, 0, size:]).all()
        assert float(x[profile.argmax()]) == 0
        v = (2 * math.pi * aperture / WAVELENGTH * x).abs().clamp_min(1e-6)
        assert (profile / profile.max() - (2 * torch.special.bessel_j1(v) / v) ** 2).abs().max() < 4e-3
        expected = 3 * math.pi / 8 * torch.from_numpy(struve(1, 2 * v.numpy())) / v**2
        assert (spread / spread.max() - expected).abs().max() < 1e-2  # the light outside the window is left out
    assert float(cut.profile.nan_to_num(0.0).max()) == pytest.approx(math.pi * (aperture / WAVELENGTH) ** 2, rel=1e-2)


@pytest.mark.parametrize("at", ["peak", "centroid"])
def test_a_gaussian_has_its_width(at):
    """√(8 ln 2) σ, of the light and of its line spread alike, from the light finely sampled."""
    lens = rt.read_lens("cooke_triplet")
    found = rt.psf(lens, "gaussian", fields=[0, 14], object_distances=[1e3, 1e4], wavelengths=[0.55])
    cut = found.cross_section(at)
    expected = math.sqrt(8 * math.log(2)) * torch.sqrt(found.covariance[::2])
    assert torch.allclose(cut.line_spread_fwhm, expected, rtol=2e-3)
    assert torch.allclose(cut.profile_fwhm[:, :, 0], expected[:, :, 0], rtol=2e-3)
    assert cut.profile.shape == (2, 2, 2, 129)
    half = 0.5 * 129 * cut.pitch  # the window holds three of the larger σ
    inside = torch.erf(half / torch.sqrt(2 * found.covariance[::2])).prod(0) * found.arrived
    assert torch.allclose((cut.line_spread * cut.pitch[..., None]).sum(-1), inside.expand(2, 2, 2), rtol=1e-3)


def test_widths_through_the_centroid_have_their_derivatives():
    lens = rt.read_lens("cooke_triplet")

    def widths(distance):
        bench = lens.at(object_distance=1e4, sensor_distance=distance)
        model = rt.psf_models.Gaussian(order=6)
        cut = rt.psf(bench, model, fields=[14], pixel=0.01, size=41, center="chief").cross_section("centroid")
        return torch.stack([cut.profile_fwhm.sum(), cut.line_spread_fwhm[1].sum(), cut.profile[0, 0, 0, 20]])

    here = lens.surfaces[-2].thickness.detach().clone().requires_grad_()
    slopes = torch.stack([torch.autograd.grad(width, here, retain_graph=True)[0] for width in widths(here)])
    step = 1e-4
    more, less = (widths(scalar(float(here) + side * step)).detach() for side in (1, -1))
    assert torch.allclose(slopes.flatten(), (more - less) / (2 * step), rtol=1e-5)


def test_kernels_without_light_and_centroids_outside_are_nan():
    lens = rt.read_lens("cooke_triplet")
    cut = rt.psf(lens, "gaussian", fields=[0, 14], grid=rt.maths.grid(0.01, 21), center="axis").cross_section(
        "centroid"
    )
    assert not torch.isnan(cut.profile[:, 0, 0]).any()
    assert torch.isnan(cut.profile[:, 0, 1]).all()
    with pytest.raises(ValueError, match="'edge' is not known; expected peak or centroid"):
        rt.psf(lens, "gaussian", fields=[0]).cross_section("edge")


def test_the_command(tmp_path, capsys):
    words = ["psf", "cooke_triplet", "--model", "gaussian", "--field", "0", "14", "--per-wavelength", "--cross-section"]
    figure, table = tmp_path / "sections.png", tmp_path / "sections.csv"
    assert main([*words, "centroid", "--plot", str(figure), "-o", str(table)]) == 0
    assert "through the centroid" in capsys.readouterr().out
    assert figure.stat().st_size > 10_000
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * 3 * 129
    assert {row["axis"] for row in rows} == {"x", "y"}
    assert main([*words, "--json", "--pixel", "0.01"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["through"] == "peak"
    assert len(document["summary"]) == 6
    assert document["units"]["profile"] == "1/µm²"
    for wrong, said in (
        ([*words, "-o", str(tmp_path / "a.npz")], "expected a name that ends in .csv, .json"),
        ([*words[:-1], "-o", str(tmp_path / "a.csv")], "expected a name that ends in .npz"),
        ([*words, "--log"], "leave it out with --cross-section"),
    ):
        assert main(wrong) == 1
        assert said in capsys.readouterr().err
    assert not list(tmp_path.glob("a.*"))
