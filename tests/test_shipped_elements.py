"""Learned heights that ship: few, small, and worth what their pages say."""

import csv
from pathlib import Path

import numpy as np
import pytest
from scripts import script

from raytrace.cli.wave_run import LEAVES
from raytrace.imaging.pictures import dead_leaves, split
from raytrace.imaging.wave_camera import WaveCameraConfig, periodic
from raytrace.wave_optics.element_files import read_element, read_label

noise = script("wave_noise")
Bank, Kept, errors_of = noise.Bank, noise.Kept, noise.errors_of
mean_psnr, pooled_psnr = noise.mean_psnr, noise.pooled_psnr
DOCS = Path(__file__).parents[1] / "docs/wave"
FILES = sorted((DOCS / "elements").glob("*.npy"))
SMOOTH = sorted(file for file in (DOCS / "elements").glob("*.json") if not file.stem.endswith(".npy"))


def test_elements_are_two_hundred_kilobytes_at_most_and_labelled():
    assert FILES
    assert SMOOTH
    assert sum(file.stat().st_size for file in (DOCS / "elements").iterdir()) <= 200_000
    for file in FILES:
        label = read_label(file)
        assert label.glass.name == "F_SILICA"
        assert (label.design_wavelength, label.pitch, label.aperture) == (0.55, 0.002, 5.0)
    for file in SMOOTH:
        label = read_label(file)
        assert (label.glass.name, label.aperture) == ("PMMA", 5.0)
        assert len(read_element(file, aperture=5.0).numbers) == 7


@pytest.mark.parametrize("file", [file for file in FILES if file.stem.startswith("etched")], ids=lambda file: file.stem)
def test_etched_ones_have_their_levels_and_relief(file):
    waves, levels = (int(n) for n in file.stem.split("-")[1:3])
    heights = read_element(file, aperture=5.0).numbers.numpy()
    step = waves * 1.19609e-3 / levels
    assert heights.min() >= 0
    assert heights.max() <= (levels - 1) * step * 1.001
    np.testing.assert_allclose(heights / step, np.round(heights / step), atol=2e-3 * levels)


@pytest.fixture(scope="module")
def sharp_leaves():
    leaves = dead_leaves(40, size=256, smallest=LEAVES["sharp leaves"])
    return Bank.of("sharp leaves", *(periodic(part, 512) for part in split(leaves)))


@pytest.mark.parametrize("name", [pytest.param("learned-0.01.npy", marks=pytest.mark.slow), "learned-smooth-0.01.json"])
def test_learned_elements_are_judged_as_the_page_has_them(sharp_leaves, name, tmp_path):
    """Sharp leaves, both filters, noise 0.01: to a hundredth of a dB, from the file alone."""
    element = read_element(DOCS / "elements" / name, aperture=5.0)
    result = errors_of(Kept(tmp_path, [sharp_leaves]).transfer((element,)), WaveCameraConfig(), sharp_leaves)
    with (DOCS / "noise.csv").open(newline="") as file:
        wanted = {
            row["filter"]: (float(row["psnr"]), float(row["mean_psnr"]))
            for row in csv.DictReader(file)
            if (row["content"], row["row"], row["noise"]) == ("sharp leaves", name.split("-0.01")[0], "0.01")
        }
    assert set(wanted) == set(result)
    for name, errors in result.items():
        assert (float(pooled_psnr(errors)), float(mean_psnr(errors))) == pytest.approx(wanted[name], abs=0.01)
