"""A flat plate that learns to be a lens from pictures alone; its ideal, its bound, and what it refuses."""

import json
import math

import numpy as np
import pytest
import torch
from scripts import script

from raytrace.cli.runner import CommandError
from raytrace.imaging.pictures import dead_leaves
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.element_files import read_label

focusing = script("focusing")
Setting, _behind, best_kernel, draw = focusing.Setting, focusing._behind, focusing.best_kernel, focusing.draw
ideal_heights, learn_to_focus, plate = focusing.ideal_heights, focusing.learn_to_focus, focusing.plate
residual_phase, sampled, scene_of = focusing.residual_phase, focusing.sampled, focusing.scene_of
AIRY = 1.2197 * 0.55e-3 * 25


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_peak_of_the_ideal_lens_is_airys():
    """πR²/(λz)² per mm², times a pixel of a quarter of the Airy radius: 1 - v²/4 on the mean of v², 3 %."""
    setting = Setting()
    airy = math.pi * 0.5**2 / (0.55e-3 * 25) ** 2 * setting.pixel**2
    kernel = best_kernel(setting)
    mean_v2 = (math.pi / (0.55e-3 * 25)) ** 2 * 2 * setting.pixel**2 / 12
    assert float(kernel.max()) == pytest.approx(airy * (1 - mean_v2 / 4), rel=2e-3)
    assert kernel.argmax() == kernel.numel() // 2


@pytest.mark.parametrize("collimator", [False, True])
def test_ideal_heights_are_the_ideal_lens(collimator):
    """Heights of the continuous lens at the middles of the pixels: the same kernel, and no phase left."""
    setting = Setting(collimator=collimator)
    elements = (plate(setting, ideal_heights(setting)), *_behind(setting))
    kernel = psf(scene_of(setting, elements), plan=sampled(setting, elements)).kernel[0, 0]
    assert float(kernel.max() / best_kernel(setting).max()) == pytest.approx(1, abs=2e-3)
    assert residual_phase(setting, elements) < 1e-6


@pytest.mark.parametrize("collimator", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_learns_a_lens_from_a_flat_plate(collimator):
    """The law of the issue: at least 0.98 of the ideal peak within 300 steps, from next to nothing."""
    found = learn_to_focus(Setting(collimator=collimator), steps=300, enough=0.99, frames=(0,))
    assert found.peak_ratios[0] < 0.01
    assert found.peak_ratios[-1] >= 0.98
    assert found.steps < 300
    assert len(found.peak_ratios) == found.steps + 1
    assert found.losses[-1] < 0.2 * found.losses[0]
    # Marechal: exp(-(2πσ)²) of the peak is left.
    assert found.peak_ratios[-1] == pytest.approx(math.exp(-((2 * math.pi * found.residual) ** 2)), abs=0.01)
    assert [frame.step for frame in found.frames] == [0, found.steps, -1]


@pytest.mark.slow
def test_flat_pixels_lose_what_they_bend():
    """sinc² of the waves across a pixel, a/λz · r: mean over the disc ∫ sinc², 0.878 of the peak, field by field."""
    setting = Setting()
    pitch = setting.diameter / setting.samples
    r = (torch.arange(2000, dtype=torch.float64) + 0.5) / 2000 * 0.5
    angle = (torch.arange(256, dtype=torch.float64) + 0.5) / 256 * 2 * math.pi
    across = [r[:, None] * t * pitch / (0.55e-3 * 25) for t in (torch.cos(angle), torch.sin(angle))]
    amplitude = (torch.sinc(across[0]) * torch.sinc(across[1])).mean(1)
    expected = float((amplitude * r).sum() / r.sum()) ** 2
    found = learn_to_focus(setting, steps=0)
    assert found.flat_bound == pytest.approx(expected, abs=4e-3)
    assert found.steps == 0


def test_the_same_seed_is_the_same_course():
    small = Setting(samples=32, size=17, patch=16, batch=1)
    courses = [learn_to_focus(small, steps=3).losses for _ in range(2)]
    assert courses[0] == courses[1]
    leaves = dead_leaves(2, size=80)
    assert not torch.equal(draw(leaves, small, 0), draw(leaves, small, 1))


def test_an_even_window_is_refused():
    with pytest.raises(ValueError, match="expected an odd size"):
        learn_to_focus(Setting(size=64))


def test_the_script_writes_heights_and_a_figure(capsys, tmp_path):
    words = ["--samples", "32", "--size", "17", "--steps", "2", "--json"]
    assert not focusing.main([*words, "-o", str(tmp_path / "lens.npy"), "--plot", str(tmp_path / "lens.png")])
    assert '"steps": 2' in capsys.readouterr().out
    assert (tmp_path / "lens.npy").exists()
    assert (tmp_path / "lens.png").stat().st_size > 10_000


def test_a_focusing_lens_of_other_measures(tmp_path):
    """Half as wide, at another distance and wavelength, its features given."""
    words = ["--aperture", "0.5", "--sensor", "12", "--wavelength", "0.64", "--feature", "0.01", "--size", "33"]
    focusing.main(["--steps", "2", "--json", "-o", str(tmp_path / "lens.npy"), *words])
    assert np.load(tmp_path / "lens.npy").shape == (50, 50)
    label = read_label(tmp_path / "lens.npy")
    assert (label.design_wavelength, label.pitch, label.aperture) == (0.64, 0.01, 0.5)
    with pytest.raises(CommandError, match="a lens is learned at one wavelength"):
        focusing.main(["--wavelength", "0.5", "0.6"])


@pytest.mark.slow
def test_the_script_prints_the_peak_of_the_plate(capsys, tmp_path):
    focusing.main(["--steps", "4", "--json", "-o", str(tmp_path / "lens.npy")])
    document = json.loads(capsys.readouterr().out)
    assert document["initial_peak_ratio"] < 0.01 < document["peak_ratio"] < 0.5
    assert document["steps"] == 4
    assert document["seconds"] > 0
    assert 0.85 < document["flat_pixels_best"] < 0.9
    assert np.load(tmp_path / "lens.npy").shape == (128, 128)
    assert json.loads((tmp_path / "lens.npy.json").read_text())["material"] == "F_SILICA"
