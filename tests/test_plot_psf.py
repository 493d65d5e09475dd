"""Figures of kernels: what is drawn is the light of the model, in windows it fills, and every word is on the page."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from page import outside
from problems import number, own_fields

from raytrace import read_lens
from raytrace.analysis import compare_models as compare
from raytrace.cli import main
from raytrace.maths.sampling import grid
from raytrace.plotting import style
from raytrace.plotting.style import fill
from raytrace.psf_models import close_up_of, psf
from raytrace.psf_models.figures import DECADES, psf_grid

LENSES = Path(__file__).parents[1] / "lenses"


def seen(name: str, model: str, **options):
    """A lens's kernels at infinity with their light, and the fields."""
    lens = read_lens(LENSES / f"{name}.zmx")
    fields, distances = options.pop("fields", own_fields(lens)), options.pop("object_distances", number([math.inf]))
    result = psf(lens, model, fields=fields, object_distances=distances, center="chief", **options)
    return result, close_up_of(result), fields


@pytest.mark.parametrize(
    ("name", "model"),
    [pytest.param("phone", "wave", marks=pytest.mark.slow), ("hubble", "wave"), ("telephoto", "gaussian")],
)
def test_the_light_fills_its_window_and_is_that_of_the_kernels(name, model):
    """The phone's kernel is one pixel of 5 µm: seen closely it is 50 samples wide, of the same energy and centroid."""
    result, light, _ = seen(name, model, fields=number([[0.0], [0.05]]))
    samples, half = light.light[0, 0], float(light.half[0, 0])
    place = (torch.arange(len(samples), dtype=torch.float64) - 0.5 * (len(samples) - 1)) * (2 * half / len(samples))
    energy = float(samples.sum())
    assert energy > 0.6
    sigma = float(((samples.sum(0) * place**2).sum() / energy).sqrt())
    assert half / 8 < sigma < half / 1.5
    at = float((samples.sum(1) * place).sum() / energy + light.centre[1, 0, 0])
    assert at == pytest.approx(float(result.ray_centroid[1, 0, 0]), abs=0.02 * sigma)
    assert energy == pytest.approx(float(result.energy[0, 0]), abs=0.05)


@pytest.mark.slow
def test_ray_traced_light_fills_its_disc_evenly():
    """Far out of focus a uniform disc of 2 σ: no pattern of rays, no window that cuts it."""
    result, light, _ = seen("singlet", "drt", fields=number([[0.0], [0.0]]), object_distances=number([2000.0]))
    samples = light.light[0, 0]
    assert float(samples.sum()) == pytest.approx(1, abs=1e-3)
    assert (
        2 * float(result.covariance[0, 0, 0].sqrt()) < float(light.half) < 4 * float(result.covariance[0, 0, 0].sqrt())
    )


@pytest.mark.slow
def test_windows_are_alike_unless_the_light_is_not():
    *_, (result, light, _) = [seen("telephoto", "gaussian")]
    assert len(set(light.half.flatten().tolist())) == 1
    distances = number([math.inf, 2000.0])
    _, light, _ = seen("telephoto", "gaussian", object_distances=distances)
    assert float(light.half[1, 0]) > 4 * float(light.half[0, 0])
    axes = psf_grid(dataclasses.replace(result, framed=True)).axes
    assert {tuple(np.round(panel.get_xlim(), 9)) for panel in axes if panel.images} == {(-0.0525, 0.0525)}


def test_fields_are_rows_and_wavelengths_are_columns():
    result = psf(
        read_lens("cooke_triplet"),
        "gaussian",
        fields=number([[0.0, 0.0], [0.0, 8.4]]),
        per_wavelength=True,
        pixel=0.004,
        size=9,
    )
    titles = [panel.get_title() for panel in psf_grid(result).axes if panel.images]
    assert [title.split(", ")[0] for title in titles] == ["0°"] * 3 + ["8.4°"] * 3
    places = [panel.get_subplotspec().colspan.start for panel in psf_grid(result).axes if panel.images]
    assert places == [0, 1, 2, 0, 1, 2]


@pytest.fixture(scope="module")
def phone():
    return seen("phone", "wave", fields=number([[0.0, 0.0], [0.0, 26.0]]), tol=0.1)


@pytest.mark.parametrize("log", [False, True])
def test_panels_show_the_light_with_the_edges_of_the_pixels(phone, log):
    result, light, _ = phone
    figure = psf_grid(result, close_up=light, log=log)
    panels = [panel for panel in figure.axes if panel.images]
    assert len(panels) == 2
    for f, panel in enumerate(panels):
        (picture,) = panel.images
        np.testing.assert_allclose(picture.get_array(), light.light[0, f].numpy())
        assert panel.get_xlim() == pytest.approx((-float(light.half[0, f]), float(light.half[0, f])))
        assert picture.norm.vmax == pytest.approx(float(light.light[0, f].max()))
        assert picture.norm.vmin == pytest.approx(picture.norm.vmax / 10**DECADES if log else 0.0)
        (edges,) = [c for c in panel.collections if c.get_gid() == "pixels"]
        upright = sorted(line[0, 0] for line in edges.get_segments() if line[0, 0] == line[1, 0])
        assert np.diff(upright) == pytest.approx(0.005)
        # The chief ray is the centre of a pixel, half a pixel from its edges.
        chief = float((result.grid.centre - light.centre)[0, 0, f])
        assert min(abs(np.array(upright) - chief)) == pytest.approx(0.0025)
    assert outside(figure) == []


def test_kernels_of_each_wavelength_are_rows_fields_outermost():
    result, light, _ = seen("telephoto", "gaussian", per_wavelength=True, object_distances=number([math.inf, 1e5]))
    figure = psf_grid(result, close_up=light)
    panels = [panel for panel in figure.axes if panel.images]
    assert len(panels) == 18
    for row in range(9):
        for d in range(2):
            drawn = panels[2 * row + d].images[0].get_array()
            np.testing.assert_allclose(drawn, light.light[d, row // 3, row % 3].numpy())


@pytest.mark.parametrize("count", [1, 3, 12])
@pytest.mark.parametrize("distances", [(math.inf,), (1e5, math.inf)])
def test_every_word_is_on_the_page(count, distances):
    lens = read_lens(LENSES / "telephoto.zmx")
    fields = torch.stack([torch.zeros(count, dtype=torch.float64), torch.linspace(0, 3, count, dtype=torch.float64)])
    result = psf(lens, "gaussian", fields=fields, object_distances=number(distances), center="chief")
    name = "A lens with a name that is much longer than its figure is wide, f = 99.9 mm, F/4"
    figure = psf_grid(dataclasses.replace(result, lens=dataclasses.replace(lens, name=name), framed=True))
    assert outside(figure) == []
    assert "".join(figure.get_suptitle().split()) == "".join(f"{name}: gaussian PSF".split())


def test_lines_are_as_wide_as_the_page():
    text = "Hubble Space Telescope as designed, f = 57.6 m, F/24: wave PSF " * 3
    lines = fill(text, 4.0, 10).split("\n")
    assert len(lines) > 2
    assert " ".join(lines).split() == text.split()
    assert fill("short", 4.0, 10) == "short"
    assert len(fill(text, 8.0, 10).split("\n")) < len(lines)


@pytest.mark.slow
def test_the_pixels_of_a_comparison_are_those_asked_for(tmp_path, capsys):
    lens = compare.common_focus(read_lens(LENSES / "singlet.zmx"), 25e3, wavelength=0.53)
    result = compare.side_by_side(lens, number([2e4]), pixels=grid(number(0.002), 11))
    assert all(one.kernel.shape[-2:] == (11, 11) for one in result.psfs)
    assert all(float(one.grid.pitch) == 0.002 for one in result.psfs)
    figure = result.plot(log=True)
    panels = [panel for panel in figure.axes if panel.images]
    assert panels[0].get_xlim() == pytest.approx((-0.011, 0.011))
    assert "11 × 11 pixels of 2 µm" in figure.get_supxlabel()
    assert outside(figure) == []


@pytest.mark.slow
def test_the_command_draws_the_light_or_the_pixels_asked_for(tmp_path, monkeypatch, capsys):
    drawn = []
    monkeypatch.setattr(style, "save", lambda figure, path, **how: drawn.append(figure))
    words = ["psf", "phone", "--model", "gaussian", "--field", "0", "10", "--plot", str(tmp_path / "a.png")]
    for more in ([], ["--pixel", "0.001"], ["--size", "31"], ["--per-wavelength"]):
        assert main([*words, *more]) == 0
    shapes = [[panel.images[0].get_array().shape for panel in figure.axes if panel.images] for figure in drawn]
    assert shapes == [[(129, 129)] * 2, [(21, 21)] * 2, [(31, 31)] * 2, [(129, 129)] * 6]
    assert all(outside(figure) == [] for figure in drawn)
