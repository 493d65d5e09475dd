"""Figures of analyses: smooth curves, full panels, every word on the page, and no axes that measure nothing."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.collections import PathCollection
from matplotlib.colors import to_hex
from page import outside
from problems import number

import raytrace as rt
from raytrace import read_lens
from raytrace.analysis.setting import NothingToShow
from raytrace.analysis.spot_diagram import even_hexapolar, field_spots
from raytrace.cli import main
from raytrace.plotting import style
from raytrace.plotting.style import field_colours
from raytrace.tracing.spot import image_rays

LENSES = Path(__file__).parents[1] / "lenses"
LONG = "A lens whose name is so long that no figure of one panel is as wide as it, f = 57.6 m, F/24, of two mirrors"


@pytest.fixture
def drawn(monkeypatch):
    """The figure that a command would have written."""

    def run(*words: str):
        figures = []
        monkeypatch.setattr(style, "save", lambda figure, path, **how: figures.append(figure))
        assert main([*words, "--plot", "figure.png"]) == 0
        return figures[-1]

    return run


def curves(panel) -> list:
    """Lines of data: neither rulers nor legend entries nor marks."""
    return [line for line in panel.lines if len(line.get_xdata()) > 2 and line.get_marker() in ("None", "")]


COMMANDS = (
    *("layout", "spot", "mtf", "ray-fan", "opd-fan", "wavefront", "distortion", "field-curvature", "lateral-colour"),
    *("relative-illumination", "encircled-energy", "psf"),
)


TWELVE = ("double_gauss", "--field", *map(str, range(12)))
DEAR = (
    "mtf",
    "encircled-energy",
    "wavefront",
    "opd-fan",
    "ray-fan",
    "field-curvature",
    "spot",
    "relative-illumination",
)  # seconds of twelve fields


@pytest.mark.parametrize(
    ("command", "lens"),
    [
        pytest.param(command, lens, marks=[pytest.mark.slow] if lens is TWELVE and command in DEAR else [])
        for command in COMMANDS
        for lens in (("hubble",), ("telephoto",), TWELVE, ("singlet", "--field", "5"))
        if command != "lateral-colour" or lens[0] in ("telephoto", "singlet")  # the others have one wavelength
    ],
)
def test_every_word_is_on_the_page_and_none_over_another(drawn, command, lens):
    model = ("--model", "gaussian") if command == "psf" else ()
    figure = drawn(command, *lens, *model)
    assert outside(figure) == []


FIGURES = {
    "field curvature": lambda lens: rt.field_curvature(lens).plot(),
    "wavefront": lambda lens: rt.wavefront(lens, wavelengths=[0.55], size=16).plot(),
    "spot": lambda lens: rt.spot(lens).plot(),
    "layout": lambda lens: rt.layout(lens).plot(),
    "focus": lambda lens: rt.focus(lens).plot(by="field"),
}


@pytest.mark.parametrize("name", FIGURES)
def test_titles_longer_than_the_page_are_broken(name):
    assert outside(FIGURES[name](dataclasses.replace(read_lens(LENSES / "singlet.zmx"), name=LONG))) == []


@pytest.mark.parametrize("command", ["mtf", "encircled-energy"])
def test_curves_are_finer_than_tables_and_requested_points_are_marked(drawn, command):
    option, asked = ("--frequency", ["5", "20"]) if command == "mtf" else ("--radius", ["0.01", "0.05"])
    for words in ([], [option, *asked]):
        (panel,) = drawn(command, "double_gauss", "--field", "0", "14", *words).axes
        lines = curves(panel)
        assert len(lines) >= 2
        for line in lines:
            assert len(line.get_xdata()) > 300
            assert line.get_xdata()[0] == 0
            steps = np.abs(np.diff(line.get_ydata()))
            assert steps.max() < 0.05  # of 1: no corners to be seen
        marks = [line for line in panel.lines if line.get_marker() == "o"]
        scale = 1 if command == "mtf" else 1e3
        assert len(marks) == (0 if not words else 4 if command == "mtf" else 2)
        for mark in marks:
            assert mark.get_xdata() == pytest.approx([scale * float(x) for x in asked])
            near = [np.interp(mark.get_xdata(), line.get_xdata(), line.get_ydata()) for line in lines]
            assert min(np.abs(y - mark.get_ydata()).max() for y in near) < 0.01


def test_mtf_through_focus_is_smooth_and_passes_through_the_value_reported():
    found = rt.mtf(read_lens(LENSES / "cooke_triplet.zmx"), [20], through_focus=0.3, geometric=True, fields=[0, 10])
    (panel,) = found.plot().axes
    lines = curves(panel)
    assert len(lines) == 4
    for line, values in zip(lines, torch.stack([found.tangential, found.sagittal], -1).flatten(1).T, strict=True):
        x, y = line.get_data()
        np.testing.assert_allclose(np.interp(found.sensor_distances, x, y), values, atol=1e-3)
        assert np.abs(np.diff(y, 2)).max() < 0.01  # no corners


@pytest.mark.parametrize("lens", [pytest.param("phone", marks=pytest.mark.slow), "cooke_triplet", "singlet"])
def test_illumination_is_a_line(drawn, lens):
    (panel,) = drawn("relative-illumination", lens).axes
    line = max(panel.lines, key=lambda line: line.get_linewidth())
    assert len(line.get_xdata()) > 50
    assert line.get_linestyle() == "-"
    assert not [c for c in panel.collections if isinstance(c, PathCollection)]
    (panel,) = drawn("relative-illumination", lens, "--field", "3", "9").axes
    (marks,) = [line for line in panel.lines if line.get_marker() == "o"]
    line = max((line for line in panel.lines if line is not marks), key=lambda line: line.get_linewidth())
    assert marks.get_xdata().tolist() == [3, 9]
    np.testing.assert_allclose(np.interp([3, 9], line.get_xdata(), line.get_ydata()), marks.get_ydata(), atol=2e-3)
    assert line.get_xdata()[[0, -1]].tolist() == [0, 9]


def test_a_lens_of_one_wavelength_has_no_lateral_colour_to_draw():
    with pytest.raises(NothingToShow, match=r"there is one, 0\.53 µm"):
        rt.lateral_colour(read_lens(LENSES / "double_gauss.zmx"))


@pytest.mark.parametrize("analyse", [rt.field_curvature, rt.relative_illumination])
def test_the_axis_alone_has_no_curve_over_the_field(analyse):
    found = analyse(read_lens(LENSES / "cooke_triplet.zmx"), fields=[0])
    with pytest.raises(NothingToShow, match="all fields are on the axis"):
        found.plot()


@pytest.mark.parametrize(
    ("fields", "wavelengths"), [(1, 1), pytest.param(3, 1, marks=pytest.mark.slow), (12, 1), (3, 3)]
)
def test_maps_fill_their_page_and_their_scale(fields, wavelengths):
    lens = read_lens(LENSES / "singlet.zmx")
    y = torch.linspace(0, 5, fields, dtype=torch.float64)
    found = rt.wavefront(
        lens, fields=torch.stack([0 * y, y]), wavelengths=number([0.5, 0.55, 0.6])[:wavelengths], size=24
    )
    figure = found.plot()
    assert outside(figure) == []
    panels = [panel for panel in figure.axes if panel.images]
    assert len(panels) == fields * wavelengths
    renderer = figure.canvas.get_renderer()
    boxes = [panel.images[0].get_window_extent(renderer) for panel in panels]
    assert min(box.x0 for box in boxes) < 0.12 * figure.bbox.width  # no blank half on either side
    assert max(box.x1 for box in boxes) > 0.72 * figure.bbox.width
    values = found.opd[found.valid]
    for panel in panels:
        low, high = panel.images[0].norm.vmin, panel.images[0].norm.vmax
        assert (low, high) == pytest.approx((min(float(values.min()), 0), max(float(values.max()), 0)))
        assert to_hex(panel.images[0].cmap(panel.images[0].norm(0.0)))[1:3] > "f0"  # 0 is white
    drawn = np.ma.filled(panels[-1].images[0].get_array(), np.nan)
    valid = found.valid[-1, -1].numpy()
    np.testing.assert_allclose(drawn[valid], found.opd[-1, -1].numpy()[valid])


def test_colours_of_fields_are_never_given_twice():
    for count in (1, 3, 8, 9, 12, 40):
        assert len(set(field_colours(count))) == count
    bright = [np.array([int(c[k : k + 2], 16) for k in (1, 3, 5)]) @ [0.299, 0.587, 0.114] for c in field_colours(12)]
    assert (np.diff(bright) > 0).all()  # in their order, for readers who tell no colours apart
    assert max(bright) < 220  # and seen on white


def test_dots_of_a_spot_represent_equal_areas_of_the_pupil():
    """So many dots as area inside every ring, and those dots are what is drawn, whatever rule makes the numbers."""
    dots = even_hexapolar(12)
    radius = torch.hypot(*dots)
    count = dots.shape[1]
    assert count == 1 + 3 * 12 * 13
    for ring in range(1, 12):
        edge = ((1 + 3 * ring * (ring + 1)) / count) ** 0.5
        assert int((radius < edge).sum()) == round(count * edge**2)
    lens = read_lens(LENSES / "cooke_triplet.zmx")
    _, drawn = field_spots(lens)
    torch.testing.assert_close(drawn.points, image_rays(lens, dots).position[:2])
    uniform = float((dots**2).sum(0).mean())
    assert uniform == pytest.approx(0.5, abs=0.003)  # the mean square radius of a uniform disc
