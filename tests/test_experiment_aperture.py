"""Parts of the study of apertures at equal light."""

import math
from pathlib import Path

import pytest
import torch
from scripts import script

import raytrace as rt

aperture = script("camera_aperture")


def test_semi_diameters_clip_but_that_of_the_stop():
    lens = aperture.clipped("double_gauss")
    clips = [bool(surface.apertures) for surface in lens.surfaces]
    assert clips == [False, *(number != lens.stop for number in range(1, 12)), False]
    shares = [
        float(rt.relative_illumination(lens.at(f_number=n), fields=[0.0]).projected_solid_angle[0]) * 4 * n**2 / math.pi
        for n in (2.0, 8.0)
    ]
    assert shares[0] == pytest.approx(0.866, abs=2e-3)
    assert shares[1] == pytest.approx(0.981, abs=2e-3)


def test_noise_is_that_of_electrons():
    electrons = torch.tensor([100.0, 10_000.0], dtype=torch.float64)
    sigma = aperture.noise_of(electrons, 0.4)
    levels = torch.full((1000, 100), 0.4, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    for n, wanted in zip(electrons, sigma, strict=True):
        noisy = aperture.count_electrons(levels, float(n), generator=generator)
        noisy = aperture.add_noise(noisy, aperture.READ_NOISE / float(n), generator=generator)
        assert float(noisy.std()) == pytest.approx(float(wanted), rel=0.01)


def test_the_expected_error_is_that_of_restored_pictures():
    """Of periodic pictures with the spectrum of the filter, blurred by two kernels, with constant noise."""
    spectrum, generator = rt.imaging.power_law(32), torch.Generator().manual_seed(0)
    kernels = torch.zeros(1, 2, 5, 5, dtype=torch.float64)
    kernels[0, 0, 2, 2] = 1
    kernels[0, 1] = 1 / 25
    sigma = torch.tensor([0.05], dtype=torch.float64)
    expected = float(aperture.error_of(kernels, spectrum, sigma)[0])
    transfer = aperture.transfer_functions(kernels[0], 32)
    filter = rt.imaging.depth_invariant_wiener(transfer, spectrum, sigma[0])
    white = torch.randn(400, 32, 32, dtype=torch.float64, generator=generator)
    pictures = torch.fft.ifft2(torch.fft.fft2(white) * spectrum.sqrt()).real
    found = []
    for one in transfer:
        image = torch.fft.ifft2(torch.fft.fft2(pictures) * one).real
        image = aperture.add_noise(image, float(sigma[0]), generator=generator)
        found.append(float((rt.imaging.restore(image, filter) - pictures).square().mean()))
    assert sum(found) / 2 == pytest.approx(expected, rel=0.03)


def test_the_table_lists_choices_and_losses():
    rows = []
    for model, errors in {"paraxial": (1e-3, 2e-3), "wave": (2e-3, 1e-3)}.items():
        for n, error in zip((4.0, 8.0), errors, strict=True):
            row = {"lens": "L", "depth": "D", "light": "B", "model": model, "f_number": n, "error": error}
            rows.append(row | {f"restored_{seed}": error * (1 + 0.01 * seed) for seed in range(aperture.SEEDS)})
    for model in ("fourier", "gaussian", "drt"):
        rows += [{**row, "model": model} for row in rows[2:4]]
    line = aperture.table(rows).splitlines()[-1]
    assert line.startswith("| L | D | B | F/8 | ")
    assert line.endswith(" | F/4, 3.01 ± 0.00 | F/8 | F/8 | F/8 |")
    assert aperture.counts(rows) == (
        "level with waves to 0.1 dB in paraxial 0, fourier 1, gaussian 1, drt 1 of 1 scenes; waves undecided in 0"
    )


def test_the_counts_of_the_page_are_those_of_its_rows():
    folder = Path(__file__).parents[1] / "docs"
    rows = aperture.stored(folder / "camera_aperture.csv")
    assert aperture.counts(rows) == (
        "level with waves to 0.1 dB in paraxial 4, fourier 4, gaussian 4, drt 5 of 8 scenes; waves undecided in 3"
    )
    page = (folder / "camera_aperture.md").read_text("utf-8")
    for line in aperture.table(rows).splitlines()[2:]:
        assert line.split("|", 4)[-1].replace("-", "−") in page
