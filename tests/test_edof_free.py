"""Free heights: the window's light by coarse cells, its slopes, learning that resumes, the page and its table."""

import csv
import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch

from raytrace.cli import main
from raytrace.maths.grid import grid
from raytrace.studies.edof import free, report
from raytrace.studies.edof.free import STARTS, Case, PixelForm, departure, learn_free
from raytrace.studies.edof.free_report import title_of
from raytrace.studies.edof.world import World, periodic, scene, spectrum
from raytrace.studies.pictures import dead_leaves
from raytrace.wave_optics.coarse import Coarse
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.designs import aim, baseline
from raytrace.wave_optics.element import Element, as_pixels, as_rings, wrapped

DOCS = Path(__file__).parents[1] / "docs"
SMALL = World(radius=0.5, depths=(500.0, 1000.0, math.inf), wavelengths=(0.46, 0.64), size=31)
S = spectrum(periodic(dead_leaves(2, size=64, seed=5, smallest=2.5), 64))


def rough(pitch=0.004, radius=0.5) -> Element:
    """A lens of silica as pixels, each off by ±0.2 µm."""
    (lens,) = baseline("fresnel", aim(radius=radius))
    pixels = as_pixels(dataclasses.replace(lens, period=None, levels=0), pitch)
    random = torch.rand(pixels.numbers.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return pixels.with_numbers(pixels.numbers + 4e-4 * (random - 0.5))


def test_the_window_sees_what_the_pupil_engine_shows():
    """Every kernel to a thousandth, in single precision to two; far fewer cells than pixels."""
    seen = scene((rough(),), SMALL)
    wanted = psf(seen, samples=250, nodes=4).kernel
    for dtype, most in ((torch.float64, 1e-3), (torch.float32, 2e-3)):
        coarse = Coarse(seen, 4, dtype=dtype)
        found = coarse.psf(seen)
        apart = (found.kernel - wanted).flatten(2).norm(dim=-1) / wanted.flatten(2).norm(dim=-1)
        assert float(apart.max()) < most
        assert found.kernel.dtype == torch.float64
        assert coarse.colours[0].band_x.cells < 0.6 * 250


def test_slopes_of_the_error_are_its_differences():
    element = rough()
    form = PixelForm((element,), SMALL, S)
    heights = element.numbers.clone().requires_grad_()
    form((element.with_numbers(heights),)).backward()
    along = torch.randn(heights.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    step = 1e-7  # mm
    ends = [form((element.with_numbers(element.numbers + sign * step * along),)) for sign in (1, -1)]
    difference = float(ends[0] - ends[1]) / (2 * step)
    assert float((heights.grad * along).sum()) == pytest.approx(difference, rel=1e-4)
    single = element.numbers.clone().requires_grad_()
    PixelForm((element,), SMALL, S, dtype=torch.float32)((element.with_numbers(single),)).backward()
    assert float((single.grad - heights.grad).norm() / heights.grad.norm()) < 0.02


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda own: {"exact": True}, "need paraboloids"),
        (lambda own: {"grid": grid(own.grid.pitch, 31, torch.tensor([0.1, 0.0]))}, "a window on the axis"),
        (lambda own: {"elements": (wrapped(own.elements[0], 0.55),)}, "not wrapped"),
        (lambda own: {"elements": baseline("singlet", aim(radius=0.5))}, "one map of pixels"),
        (lambda own: {"elements": (rough(0.1),)}, "too coarse"),
        (
            lambda own: {"elements": (dataclasses.replace(own.elements[0], radius=2 * own.elements[0].radius),)},
            "across",
        ),
    ],
    ids=["exact", "aside", "wrapped", "smooth", "coarse", "small"],
)
def test_what_it_cannot_hold_is_refused(change, words):
    own = scene((rough(0.02),), SMALL)
    with pytest.raises(ValueError, match=words):
        Coarse(dataclasses.replace(own, **change(own)), 3)


def test_departure_is_what_no_ring_has():
    (lens,) = baseline("fresnel", aim(radius=0.5))
    rings = as_rings(dataclasses.replace(lens, period=None, levels=0), 0.004)
    assert departure(rings) == 0
    assert departure(as_pixels(rings, 0.004)) == pytest.approx(0, abs=1e-6)
    assert departure(rough()) > 100  # ±0.2 µm evenly: 115 nm, and the slope within a ring


@pytest.fixture
def rings(monkeypatch) -> Element:
    monkeypatch.setattr(free, "World", lambda: SMALL)
    (lens,) = baseline("fresnel", aim(radius=0.5))
    return as_rings(dataclasses.replace(lens, period=None, levels=0), 0.004)


def test_a_run_that_is_broken_off_ends_as_one_that_was_not(rings, tmp_path):
    """Six steps from a random start; the error falls, and the control stays round."""
    case = Case("random", 0.01, 0.008, 6, 0.02)

    def broken(steps, first):
        for number, step in enumerate(steps):
            yield step
            if number == 3:
                return

    whole = learn_free(case, rings, S, tmp_path / "whole")
    learn_free(case, rings, S, tmp_path / "broken", bar=broken, every=2)
    resumed = learn_free(case, rings, S, tmp_path / "broken", every=2)
    finished = learn_free(case, rings, S, tmp_path / "whole", bar=lambda *_: pytest.fail("learned anew"))
    for other in (resumed, finished):
        assert torch.equal(other.numbers, whole.numbers)
    with (case.folder(tmp_path / "whole") / "log.csv").open(newline="") as file:
        losses = [float(row["loss"]) for row in csv.DictReader(file)]
    assert losses[-1] < losses[0]
    control = learn_free(dataclasses.replace(case, start="control", steps=2), rings, S, tmp_path)
    assert control.numbers.shape == rings.numbers.shape


def test_starts_have_the_path_of_what_they_are_made_from(rings, monkeypatch):
    """A cubic plate in silica as in PMMA, at the design wavelength: the kernels are those of the plate."""
    monkeypatch.setattr(free, "best_strengths", lambda noises, S: {noises[0]: 15.0})
    made_for = aim(radius=0.5)
    world = dataclasses.replace(SMALL, wavelengths=(0.55,))
    for start in STARTS:
        found = STARTS[start][1](rings, 0.004, made_for, 0.01, 0, S)
        assert found.glass.name == "F_SILICA"
        assert found.numbers.shape == (250, 250)
    parts = baseline("cubic-refractive", made_for)
    found = free.as_map(parts, rings, 0.004, made_for.wavelength)
    own, wanted = psf(scene((found,), world)).kernel, psf(scene(parts, world)).kernel
    assert float((own - wanted).norm() / wanted.norm()) < 0.03


def test_the_page_has_the_figures_of_its_table():
    page = (DOCS / "wave_free.md").read_text()
    with (DOCS / "wave/free.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["row"] for row in rows} == {"given", "cut", "control", *STARTS}
    for row in rows:
        gains = (
            "–" if base == row["row"] else
            f"{float(row[f'over_{base}']):+.2f} ({float(row[f'over_{base}_low']):+.2f} … "
            f"{float(row[f'over_{base}_high']):+.2f})"
            for base in ("control", "fresnel")
        )  # fmt: skip
        numbers = f"{float(row['expected']):.2f} | {float(row['psnr']):.2f}"
        assert f"| {title_of(row['row'])} | {numbers} | {' | '.join(gains)} | {float(row['unround']):.0f} |" in page


@pytest.mark.slow
def test_the_command_learns_judges_and_goes_on(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(report, "_LEAVES", 4)
    words = ["wave", "free", "--from", str(DOCS / "wave/elements/learned-0.01.npy"), "--start", "rings"]
    words += ["--feature", "0.01", "--steps", "2", "-o", str(tmp_path / "run"), "--docs", str(tmp_path), "--json"]
    assert main(words) == 0
    first = json.loads(capsys.readouterr().out)
    rows = {row["row"]: row for row in first["rows"] if (row["content"], row["filter"]) == ("sharp leaves", "blind")}
    assert rows["control"]["over_control"] == 0
    assert rows["given"]["unround"] == 0
    assert rows["rings"]["unround"] > 15
    assert "| rings learned on |" in (tmp_path / "wave_free.md").read_text()
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out) == first
