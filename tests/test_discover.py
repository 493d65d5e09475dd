"""Discovered places: the exact error of a scene on a dark ground, and plates that come to show it more than once."""

import json

import pytest
import torch

from raytrace.cli import main
from raytrace.imaging.restoration import psnr
from raytrace.imaging.training import OtherSettings
from raytrace.studies.edof.world import periodic, spectrum
from raytrace.studies.pictures import dead_leaves, split
from raytrace.studies.superres import discover_report
from raytrace.studies.superres.discover import (
    WINDOW,
    Error,
    discover,
    errors_of_scenes,
    exact_error,
    matrix,
    moments,
    places_in,
    random_path,
    starts,
)
from raytrace.studies.superres.discover_command import Settings
from raytrace.studies.superres.experiment import world_of

PICTURES = periodic(dead_leaves(6, size=64), 96)
S = spectrum(PICTURES)
WORLD = world_of([0.55], noise=0.001)


def peaks(*places, size=WINDOW, share=None):
    kernel = torch.zeros(1, size, size, dtype=torch.float64)
    for row, column in places:
        kernel[0, size // 2 + row, size // 2 + column] = share or 1 / len(places)
    return kernel


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_the_matrix_is_blur_and_large_pixels(factor):
    random = torch.Generator().manual_seed(0)
    kernel = torch.rand(2, 5, 5, generator=random, dtype=torch.float64)
    scene = torch.rand(6, 6, generator=random, dtype=torch.float64)
    A = matrix(kernel, factor, 6)
    across = round(A.shape[-2] ** 0.5)
    dark = torch.nn.functional.pad(scene, (4,) * 4)[None, None]
    blurred = torch.nn.functional.conv2d(dark, kernel.flip(-1, -2)[:, None])[0]
    wide = torch.nn.functional.pad(blurred, (0, factor * across - 10) * 2)
    expected = torch.nn.functional.avg_pool2d(wide, factor) if factor > 1 else wide
    torch.testing.assert_close(A @ scene.flatten(), expected.flatten(1), atol=1e-14, rtol=0)


def test_exact_error_is_what_scenes_of_these_moments_leave():
    """Gauss's scenes of moments C, restored: their mean error is the closed form, and that of lstsq with a prior."""
    C, kernel = moments(S, 6), peaks((0, 0), (3, 1), size=9)
    root = torch.linalg.cholesky(C)
    scenes = (root @ torch.randn(36, 4000, generator=torch.Generator().manual_seed(1), dtype=torch.float64)).T
    expected = exact_error(kernel, C, 0.05, 2)
    found = errors_of_scenes(kernel, C, 0.05, 2, scenes)
    torch.testing.assert_close(found.mean(), expected, rtol=0.02, atol=0)
    A = matrix(kernel, 2, 6)[0]
    posterior = torch.linalg.inv(torch.linalg.inv(C) + A.T @ A / 0.05**2)
    torch.testing.assert_close(expected, posterior.trace() / 36, rtol=1e-6, atol=0)


def test_places_at_other_parts_of_a_pixel_tell_more():
    """Of four points, half a large pixel apart each way they hold all; at the same part no more than one does."""
    C = moments(S)
    one, same, other = (
        float(psnr(exact_error(kernel, C, 0.001, 2)))
        for kernel in (
            peaks((0, 0)),
            peaks((-8, -8), (-8, 8), (8, -8), (8, 8)),
            peaks((-8, -8), (-8, 9), (9, -8), (9, 9)),
        )
    )
    assert same == pytest.approx(one, abs=0.1)
    assert other > one + 10


def test_places_are_peaks_that_hold_light():
    kernel = peaks((-8, -8), (9, 4), share=0.4)[0] + 1e-5
    kernel[3, 40] = 0.01
    found = places_in(kernel)
    assert [(round(p.row), round(p.column)) for p in found] in ([(-8, -8), (9, 4)], [(9, 4), (-8, -8)])
    assert found[0].light == pytest.approx(0.48, abs=0.03)


def test_a_plate_comes_to_show_the_scene_more_than_once():
    """From a tenth of a wave, 8 steps: dB gained, and several places where the lens has one."""
    error = Error(WORLD, moments(S), 2)
    paths = {name: path for name, path, _ in starts(WORLD, spreads=(0.1,), seeds=1, factor=2)}
    plain = discover("plain", paths["plain lens"], error, steps=0)
    found = discover("random", paths["from 0.1 waves RMS, start 0"], error, steps=8)
    assert len(plain.places) == 1
    assert plain.before == plain.after
    assert len(found.places) >= 3
    assert found.after > plain.after + 1.5
    path = random_path(WORLD, 0.1, seed=0)
    inside = path != 0
    assert float(path[inside].square().mean().sqrt()) == pytest.approx(0.055e-3, rel=0.02)


def test_plates_are_kept_for_their_pictures(monkeypatch, tmp_path):
    """As many others are refused."""
    monkeypatch.setattr(
        discover_report, "starts", lambda *given, **how: starts(WORLD, spreads=(), seeds=0, factor=2)[:1]
    )
    own, others = (split(dead_leaves(4, size=96, seed=seed)) for seed in (0, 1))
    for _ in range(2):
        discover_report._camera(Settings(), "550 nm", (0.55,), *own, tmp_path)
    with pytest.raises(OtherSettings, match="pictures was"):
        discover_report._camera(Settings(), "550 nm", (0.55,), *others, tmp_path)


@pytest.mark.slow
def test_the_command_keeps_its_plates(capsys, tmp_path):
    words = ["wave", "discover", "--starts", "1", "--spread", "0.1", "--steps", "2", "--limit", "10"]
    words += ["-o", str(tmp_path / "run"), "--docs", str(tmp_path / "docs"), "--json"]
    assert main(words) == 0
    first = json.loads(capsys.readouterr().out)
    rows = {row["start"]: row for row in first["plates"]}
    assert rows["plain lens"]["gain"] == 0
    assert rows["4 prescribed places"]["places"] == 4
    assert rows["4 prescribed places"]["gain_low"] > 3
    assert (tmp_path / "docs/wave/discover.png").stat().st_size > 5_000
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out) == first
