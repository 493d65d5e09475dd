"""Extended depth of field over noise: the octant against full kernels, errors of each picture, their intervals."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scripts import script

from raytrace.cli import wave_run
from raytrace.cli.runner import CommandError
from raytrace.imaging.closed_form import camera_error
from raytrace.imaging.octant import Octant, fits
from raytrace.imaging.pictures import Pictures, dead_leaves
from raytrace.imaging.restoration import (
    depth_invariant_density,
    depth_invariant_error,
    depth_invariant_wiener,
    power_spectrum,
    psnr,
    restore,
)
from raytrace.imaging.training import OtherSettings
from raytrace.imaging.variables import PhaseVariables
from raytrace.imaging.wave_camera import FILTERS, WaveCameraConfig, periodic, quality, transfer
from raytrace.maths.sampling import grid
from raytrace.wave_optics.designs import aim, baseline
from raytrace.wave_optics.element import Element, Rings, Zernike
from raytrace.wave_optics.element_files import write_element
from raytrace.wave_optics.fabrication import as_rings
from raytrace.wave_optics.plan import plan

edof, noise = script("wave_edof"), script("wave_noise")
Content = edof.Content
Bank, Gains, Interval, Unit, Settings = noise.Bank, noise.Gains, noise.Interval, noise.Unit, noise.Settings
best_strengths, baselines, drawn, errors_of, gain = (
    *(noise.best_strengths, noise.baselines, noise.drawn, noise.errors_of, noise.gain),
)
mean_psnr, pooled_psnr, units, scores = noise.mean_psnr, noise.pooled_psnr, noise.units, noise.scores
Kept, OverNoise, Score, judge_files = noise.Kept, noise.OverNoise, noise.Score, noise.judge_files
SMALL = WaveCameraConfig(depths=(500.0, 1000.0, math.inf), wavelengths=(0.5, 0.6), size=63, pixel=0.00738)
PICTURES = periodic(dead_leaves(8, size=64, seed=5, smallest=2.5), 128)
S = power_spectrum(PICTURES, window="none")
LEARNED = str(Path(__file__).parents[1] / "docs/wave/elements/learned-0.01.npy")


@pytest.mark.parametrize("name", ["singlet", "fresnel", "hybrid"])
def test_an_octant_is_the_closed_form_of_the_kernels(name):
    """Error and its gradient to 1e-7, wraps and smooth lenses; of rings in single precision to 1e-5."""
    first, *others = baseline(name, aim())
    variables = PhaseVariables(first, others=others)
    camera = SMALL.camera(variables)
    expected = camera_error(camera, S, SMALL.depths)
    H = transfer(camera, 128, SMALL.depths)
    torch.testing.assert_close(expected, depth_invariant_error(H, S, SMALL.noise).mean(), rtol=1e-12, atol=0)
    slope = torch.autograd.grad(expected, variables.change)[0]
    camera.plan(SMALL.depths)
    result = camera_error(camera, S, SMALL.depths)
    tolerance = 1e-5 if isinstance(first.profile, Rings) else 1e-7
    torch.testing.assert_close(result, expected, rtol=tolerance, atol=0)
    own = torch.autograd.grad(result, variables.change)[0]
    assert float((own - slope).norm()) < 100 * tolerance * float(slope.norm())
    for dtype, tolerance in ((torch.float64, 1e-7), (torch.float32, 1e-5)):
        kernels = camera.element_kernels(SMALL.depths)
        part = Octant(kernels.scene, kernels.plan, S, dtype=dtype)
        error = part.error(part.transfer(kernels.scene), SMALL.noise)
        torch.testing.assert_close(error, expected, rtol=tolerance, atol=0)


def test_frequencies_of_the_octant_are_those_of_the_kernels():
    camera = SMALL.camera(baseline("fresnel", aim()))
    own = camera.element_kernels(SMALL.depths).scene
    result = Octant(own, plan(own), S).transfer(own)
    H = transfer(camera, 128, SMALL.depths).real
    a, b = torch.triu_indices(65, 65)
    torch.testing.assert_close(result, H[..., a, b], rtol=0, atol=1e-7)


def test_pictures_that_are_not_their_mirror_images_have_no_octant():
    own = SMALL.camera(baseline("fresnel", aim())).element_kernels(SMALL.depths).scene
    how = plan(own)
    assert fits(own, how, S)
    lopsided = S.clone()
    lopsided[3, 5] *= 2
    assert not fits(own, how, lopsided)
    even = dataclasses.replace(own, grid=grid(own.grid.pitch, 64))
    assert not fits(even, plan(even), S)


def test_density_adds_up_to_the_error():
    H = transfer(SMALL.camera(baseline("singlet", aim())), 128, SMALL.depths)
    torch.testing.assert_close(depth_invariant_density(H, S, 0.01).mean((-2, -1)), depth_invariant_error(H, S, 0.01))


def test_errors_of_pictures_are_those_of_pictures_restored():
    """Each picture with noise drawn, within what that noise leaves open; their mean is what the table says."""
    bank = Bank.of("leaves", PICTURES[:5], PICTURES[5:])
    camera = SMALL.camera(baseline("singlet", aim()))
    H = transfer(camera, 128, SMALL.depths)
    result = errors_of(H, SMALL, bank)
    generator = torch.Generator().manual_seed(0)
    noise = SMALL.noise * torch.randn(3, 2, 128, 128, generator=generator, dtype=torch.float64)
    G = depth_invariant_wiener(H, bank.spectrum, SMALL.noise)
    pictures = PICTURES[5:, None].expand(3, 2, 128, 128)
    images = [camera.image(pictures, [depth]) + noise for depth in SMALL.depths]
    left = [(restore(image, G) - pictures).square().mean((-2, -1)) for image in images]
    torch.testing.assert_close(result["blind"], torch.stack(left, 1), rtol=0.02, atol=0)
    table = quality(camera, SMALL.depths, design=1000.0, train=PICTURES[:5], test=PICTURES[5:])
    for name in ("wiener", "blind"):
        assert float(pooled_psnr(result[name])) == pytest.approx(table.mean[name], abs=1e-9)
        assert float(mean_psnr(result[name])) == pytest.approx(table.of_pictures[name], abs=1e-9)
        single = [float(pooled_psnr(own[None])) for own in result[name]]
        assert float(mean_psnr(result[name])) == pytest.approx(sum(single) / len(single), abs=1e-9)
        assert float(mean_psnr(result[name])) > float(pooled_psnr(result[name]))  # -log is convex


def test_intervals_hold_the_mean_of_many_pictures():
    """Errors of known law: the interval of 95 % is that of Gauss for a mean of 100 logarithms, to a tenth."""
    generator = torch.Generator().manual_seed(0)
    base = torch.ones(100, 1, 1, dtype=torch.float64)
    own = base * (1 + 0.05 * torch.randn(100, 1, 1, generator=generator, dtype=torch.float64))
    result = gain(own, base, drawn(range(100)))
    half = 1.96 * 10 / math.log(10) * float(own.std()) / 10 / float(own.mean())
    assert (result.high - result.low) / 2 == pytest.approx(half, rel=0.1)
    assert result.low < result.value < result.high
    assert result.value == pytest.approx(float(-psnr(base.mean()) + psnr(own.mean())))
    same = gain(base, base, drawn(range(100)))
    assert (same.value, same.low, same.high) == (0, 0, 0)


def test_classes_are_drawn_whole():
    """Ten classes of ten pictures, equal in each: √10 times the interval of a hundred draws."""
    classes = [f"class {number // 10}" for number in range(100)]
    weights = drawn(classes)
    assert weights.shape == (2000, 100)
    assert all(len(set(row.reshape(10, 10)[0].tolist())) == 1 for row in weights[:20])
    assert torch.equal(weights.sum(1), torch.full((2000,), 100.0, dtype=torch.float64))
    generator = torch.Generator().manual_seed(0)
    base = torch.ones(100, 1, 1, dtype=torch.float64)
    of_class = 1 + 0.05 * torch.randn(10, 1, 1, generator=generator, dtype=torch.float64)
    own = base * of_class.repeat_interleave(10, 0)
    wide, narrow = (gain(own, base, of) for of in (weights, drawn(range(100))))
    assert (wide.high - wide.low) / (narrow.high - narrow.low) == pytest.approx(10**0.5, rel=0.1)


def test_a_class_is_a_folder():
    """Of pictures in several folders; where there is one folder, or none, each picture is its own class."""
    grey = (np.zeros((4, 4), np.uint8),) * 3
    assert Pictures(grey, ("t/banded/a.png", "t/banded/b.png", "t/bumpy/a.png")).classes == (
        "t/banded", "t/banded", "t/bumpy",
    )  # fmt: skip
    assert Pictures(grey, ("t/a.png", "t/b.png", "t/c.png")).classes == ("t/a.png", "t/b.png", "t/c.png")
    assert len(set(dead_leaves(2, size=32).classes)) == 2
    bank = Bank.of("pictures", PICTURES[:5], PICTURES[5:7], ["banded", "banded"])
    assert bank.drawn().tolist() == [[1, 1]] * 2000


def test_every_noise_and_row_once_before_any_a_second_time():
    result = list(units(["fresnel", "learned", "learned-16"], [0.01, 0.02], 2))
    assert len(result) == 8
    assert {unit.start for unit in result[:4]} == {0}
    settings = Unit("learned", 0.02, 3).settings(17)
    assert (settings.seed, settings.starts, settings.steps, settings.noise) == (3, 1, 17, (0.02, 0.02))
    assert Unit("learned-smooth", 0.02, 3).settings(300).steps == 60


def test_cubic_plates_have_the_strength_of_their_noise():
    strengths = {0.001: 20.0, 0.01: 10.0, 0.02: 10.0}
    result = [
        (row, noises) for row, _, noises in baselines(["fresnel", "cubic-refractive"], list(strengths), strengths)
    ]
    assert result == [
        ("fresnel", [0.001, 0.01, 0.02]),
        ("cubic-refractive", [0.01, 0.02]),
        ("cubic-refractive", [0.001]),
    ]


@pytest.mark.slow
def test_the_start_of_least_expected_error_is_kept(tmp_path):
    """Whatever the restored pictures say; errors are computed once for these pictures, and refused for others."""
    bank = Bank.of("leaves", PICTURES[:5], PICTURES[5:])
    kept, made = Kept(tmp_path, [bank]), []
    names = {"fresnel": 0.0, "singlet": 0.2, "cubic-refractive": 0.1}

    def errors_by(name):
        def H():
            made.append(name)
            return transfer(SMALL.camera(baseline(name, aim())), 128, SMALL.depths)

        return kept.find(name, SMALL, H)

    result = [{name: errors_by(name) for name in names} for _ in range(2)][-1]
    assert made == list(names)
    learned = {
        Unit("learned", 0.01, i): (names[name], result[name]) for i, name in enumerate(("singlet", "cubic-refractive"))
    }
    rows = {
        (one.filter, one.row): one
        for one in scores({("fresnel", 0.01): result["fresnel"]}, learned, [bank], Settings(noise=(0.01,)))
    }
    for filter in ("wiener", "blind"):
        own, base = rows[filter, "learned"], rows[filter, "fresnel"]
        errors = result["cubic-refractive"]["leaves"][filter]
        assert own.gains.pooled_psnr == pytest.approx(float(pooled_psnr(errors)))
        assert own.gains.mean_psnr == pytest.approx(float(mean_psnr(errors)))
        assert own.gains.pooled.value == own.starts[0]
        assert own.gains.pooled.value == pytest.approx(own.gains.pooled_psnr - base.gains.pooled_psnr)
        assert own.gains.mean.value == pytest.approx(own.gains.mean_psnr - base.gains.mean_psnr)
        for one in (own.gains.pooled, own.gains.mean):
            assert one.low < one.value < one.high
        assert len(own.starts) == 2
    for train, test in ((PICTURES[:4], PICTURES[4:]), (PICTURES[:4], PICTURES[5:])):
        with pytest.raises(OtherSettings):
            Kept(tmp_path, [Bank.of("leaves", train, test)])


def test_other_pictures_are_refused_before_anything_is_learned(monkeypatch, tmp_path):
    """The folder stores errors of some pictures: with others nothing is designed, nothing written."""
    contents = [Content("leaves", PICTURES[:4], PICTURES[4:])], dead_leaves(4, size=256)
    monkeypatch.setattr(noise, "contents_of", lambda arguments: contents)
    monkeypatch.setattr(noise, "learn_unit", lambda *given, **how: pytest.fail("learned"))
    Kept(tmp_path / "judged", [Bank.of("leaves", PICTURES[:5], PICTURES[5:])])
    with pytest.raises(OtherSettings, match="judged holds another run: pictures was"):
        noise.main(["--rows", "learned", "-o", str(tmp_path)])
    assert [path.name for path in tmp_path.iterdir()] == ["judged"]


def test_files_are_judged_by_all_that_bends_light(monkeypatch, tmp_path):
    """Kept errors are those of the glass, pitch, radius and kind; of an element met before nothing is made anew."""
    kept, made = Kept(tmp_path, [Bank.of("leaves", PICTURES[:5], PICTURES[5:])]), []
    flat = torch.ones(1, 1, 128, 128, dtype=torch.complex128)
    monkeypatch.setattr(
        noise, "WaveCameraConfig", lambda: dataclasses.replace(SMALL, depths=(1000.0,), wavelengths=(0.5,))
    )
    monkeypatch.setattr(kept, "transfer", lambda elements: made.append(elements) or flat)
    (one,) = baseline("singlet", aim())
    rings = as_rings(one, 0.01)
    coarser = dataclasses.replace(rings.profile, pitch=2 * rings.profile.pitch)
    others = [
        one,
        rings,
        dataclasses.replace(one, glass=rings_of_silica().glass),
        dataclasses.replace(rings, profile=coarser),
    ]
    others += [
        dataclasses.replace(one, radius=0.5 * one.radius),
        dataclasses.replace(one, profile=Zernike(one.numbers)),
    ]
    for element in (*others, *others):
        result = judge_files({"one": element}, Settings(noise=(0.01, 0.02)), kept)
        assert list(result) == [("one", 0.01), ("one", 0.02)]
    assert len(made) == len(others)


def rings_of_silica() -> Element:
    (element,) = baseline("fresnel", aim())
    return element


def test_files_of_one_name_are_refused(tmp_path):
    """Two of one stem, and one with the name of a row: a table could not distinguish them."""
    write_element(rings_of_silica(), tmp_path / "fresnel.npy", design_wavelength=0.55)
    words = ["-o", str(tmp_path / "run"), "--elements"]
    with pytest.raises(CommandError, match=r"both would be learned-0\.01"):
        noise.main([*words, LEARNED, f"{tmp_path}/learned-0.01.json"])
    with pytest.raises(CommandError, match="'Fresnel lens'; give the file another name"):
        noise.main([*words, str(tmp_path / "fresnel.npy")])


def test_the_figure_over_noise_draws_files_by_their_names():
    own = Interval(1.0, 0.9, 1.1)
    gains = Gains(20.0, own, 20.5, own)
    rows = [Score("sharp leaves", filter, 0.01, row, gains) for filter in FILTERS for row in ("fresnel", "own-0.01")]
    figure = noise.noise_figure(OverNoise(rows, {"sharp leaves": 8}))
    assert "own-0.01" in [text.get_text() for legend in figure.legends for text in legend.get_texts()]


@pytest.mark.slow
def test_strengths_fall_with_the_noise():
    result = best_strengths(
        [0.001, 0.02], power_spectrum(periodic(dead_leaves(4, size=128, smallest=2.5), 256), window="none")
    )
    assert result[0.001] >= result[0.02]


@pytest.mark.slow
def test_the_command_learns_evaluates_and_resumes(capsys, monkeypatch, tmp_path):
    """One row, one noise, two starts; the second time everything is kept, and the figures are the same."""
    monkeypatch.setattr(wave_run, "LEAF_COUNT", 4)
    words = ["--rows", "learned-smooth", "--noises", "0.01", "--starts", "2", "--steps", "1"]
    words += ["-o", str(tmp_path / "run"), "--docs", str(tmp_path / "docs"), "--json"]
    assert not noise.main(words)
    first = json.loads(capsys.readouterr().out)
    rows = {(row["content"], row["filter"], row["row"]): row for row in first["rows"]}
    base, own = (rows["sharp leaves", "blind", name] for name in ("fresnel", "learned-smooth"))
    assert base["gain"] == base["gain_low"] == base["gain_high"] == 0
    assert own["starts"] == 2
    assert own["gain_low"] <= own["gain"] <= own["gain_high"]
    assert own["gain"] > 4
    page = (tmp_path / "docs/wave_noise.md").read_text()
    wiener = rows["sharp leaves", "wiener", "learned-smooth"]
    assert f"{wiener['gain']:+.2f} ({wiener['gain_low']:+.2f} … {wiener['gain_high']:+.2f})" in page
    assert (tmp_path / "docs/wave/noise.png").stat().st_size > 10_000
    assert not noise.main(words)
    assert json.loads(capsys.readouterr().out) == first


@pytest.mark.slow
def test_a_file_of_heights_is_judged_as_the_element_it_was_written_from(capsys, monkeypatch, tmp_path):
    """Few leaves, two steps: the same figures by the file and by the run, behind both filters."""
    monkeypatch.setattr(wave_run, "LEAF_COUNT", 4)
    words = ["--noises", "0.01", "--starts", "1", "--steps", "2", "--json", "--rows"]
    assert not noise.main([*words, "learned", "-o", str(tmp_path / "run"), "--docs", str(tmp_path)])
    run = json.loads(capsys.readouterr().out)["rows"]
    file = tmp_path / "wave/elements/learned-0.01.npy"
    assert not noise.main([*words, "fresnel", "--elements", str(file)])
    again = json.loads(capsys.readouterr().out)["rows"]
    own, other = ([row for row in rows if row["row"].startswith("learned")] for rows in (run, again))
    assert [row["row"] for row in other] == ["learned-0.01"] * 4
    for a, b in zip(own, other, strict=True):
        assert (a["psnr"], a["gain"], a["gain_low"]) == pytest.approx((b["psnr"], b["gain"], b["gain_low"]), abs=1e-6)
