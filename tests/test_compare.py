"""Two lenses compared: numbers are those of the functions in one scene, figures have one scale, errors are one line."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace import settings
from raytrace.analysis.compare import COLOURS, COMPARED, Incomparable


@pytest.fixture(scope="module")
def lenses():
    lens = rt.read_lens("cooke_triplet")
    return lens, lens.at(f_number=5.0)


QUICK = ("ray_fan", "opd_fan", "distortion", "field_curvature", "lateral_colour", "longitudinal_aberration")


def test_the_command_offers_every_analysis():
    assert [name.replace("-", "_") for name in settings.COMPARED] == [*COMPARED]


@pytest.mark.parametrize("name", [*QUICK, "spot", "chromatic_focal_shift", "rms_over_field"])
def test_columns_are_those_of_both_lenses_and_their_difference(name, lenses):
    comparison = rt.compare(*lenses, name)
    frame = comparison.to_frame()
    function = getattr(rt, name)
    for end, lens in zip(("_1", "_2"), lenses, strict=True):
        expected = function(lens).to_frame()
        shared = [column for column in expected if f"{column}{end}" in frame]
        assert shared
        for column in shared:
            np.testing.assert_array_equal(frame[f"{column}{end}"], expected[column])
    for column in (c.removesuffix("_change") for c in frame if c.endswith("_change")):
        np.testing.assert_array_equal(frame[f"{column}_change"], frame[f"{column}_2"] - frame[f"{column}_1"])


def test_angles_of_incidence_are_those_on_the_sensor(lenses):
    frame = rt.compare(*lenses, "incidence").to_frame()
    for end, lens in zip(("_1", "_2"), lenses, strict=True):
        summary = rt.incidence(lens).summary()
        for name in ("chief", "upper", "lower", "height"):
            np.testing.assert_array_equal(frame[f"{name}{end}"], summary[name].flatten().numpy())
    figure = rt.compare(*lenses, "incidence").plot()
    assert {line.get_color() for line in figure.axes[0].lines} >= {*COLOURS}


def test_grids_are_of_the_objects_of_the_first_lens(lenses):
    """Of a lens with larger fields too; on one scale, and exaggerated alike."""
    other = dataclasses.replace(lenses[1], fields=rt.read_lens("double_gauss").fields)
    comparison = rt.compare(lenses[0], other, "distortion_grid")
    assert torch.equal(comparison.first.fields, comparison.second.fields)
    expected = rt.distortion_grid(lenses[1])
    assert torch.allclose(comparison.second.actual, expected.actual, rtol=1e-12)
    assert len(comparison.to_frame()) == 121
    first, second = (100 * float(grid.largest()) for grid in (comparison.first, expected))
    row = str(comparison).splitlines()[-1].split()
    assert [float(word) for word in row[1:]] == pytest.approx([first, second, second - first], rel=1e-5)
    figure = comparison.plot()
    assert len({(panel.get_xlim(), panel.get_ylim()) for panel in figure.axes}) == 1
    times = float(figure.get_suptitle().split("×")[1])
    actual = comparison.first.ideal + times * (comparison.first.actual - comparison.first.ideal)
    drawn = [line for line in figure.axes[0].lines if line.get_color() == COLOURS[0]]
    assert max(np.nanmax(line.get_ydata(), initial=0.0) for line in drawn) == pytest.approx(float(actual[1].max()))


@pytest.mark.slow
def test_psfs_have_one_model_one_window_and_one_scale_a_row(lenses):
    comparison = rt.compare(*lenses, "psf", fields=[0, 8])
    assert comparison.first.model == comparison.second.model
    expected = rt.psf(lenses[1], comparison.first.model, fields=[0, 8])
    np.testing.assert_array_equal(comparison.to_frame()["sigma_y_um_2"], expected.to_frame()["sigma_y_um"])
    images = [image for panel in comparison.plot().axes for image in panel.images]
    assert len(images) == 4
    assert len({tuple(image.get_extent()) for image in images}) == 1
    for one, two in (images[:2], images[2:]):
        assert one.get_clim() == two.get_clim()
        assert one.get_clim()[1] == max(float(image.get_array().max()) for image in (one, two))


def test_first_order_data_stand_beside_the_layouts(lenses):
    comparison = rt.compare(*lenses)
    table = comparison.to_frame().set_index("quantity")
    for end, lens in zip(("_1", "_2"), lenses, strict=True):
        data = rt.first_order(lens)
        assert table.loc["F/#", f"value{end}"] == float(data.f_number)
        assert table.loc["effective focal length", f"value{end}"] == float(data.effective_focal_length)
    assert "B − A" in str(comparison)
    assert json.dumps(comparison.document())


def test_the_mtf_of_both_has_one_range_of_frequencies(lenses):
    comparison = rt.compare(*lenses, "mtf", fields=[0.0])
    one, other = comparison.first, comparison.second
    alone = [rt.mtf(lens, fields=[0.0]) for lens in lenses]
    assert torch.equal(one.frequencies, other.frequencies)
    assert float(one.frequencies[-1]) == max(float(curves.frequencies[-1]) for curves in alone)
    asked = rt.compare(*lenses, "mtf", fields=[0.0], frequencies=[10.0, 20.0])
    expected = rt.mtf(lenses[1], [10.0, 20.0], fields=[0.0]).tangential
    assert torch.allclose(asked.second.tangential, expected, rtol=1e-12)


def test_the_scene_is_that_of_the_first_lens(lenses):
    other = rt.read_lens("tessar")
    comparison = rt.compare(lenses[0], other, "spot", fields=[0, 5])
    names = ("wavelengths", "wavelength_weights", "primary_wavelength")
    alike = dataclasses.replace(other, **{name: getattr(lenses[0], name) for name in names})
    expected = rt.spot(alike, fields=[0, 5])
    assert torch.allclose(comparison.second.rms_radius, expected.rms_radius, rtol=1e-12)
    green = rt.compare(lenses[0].at(wavelengths=[0.55]), other, "spot", fields=[0, 5])
    assert "wavelengths of both: those of A" in str(green)
    assert torch.allclose(
        green.second.rms_radius, rt.spot(other, fields=[0, 5], wavelengths=[0.55]).rms_radius, rtol=1e-12
    )


@pytest.mark.parametrize("name", QUICK)
def test_every_panel_has_both_lenses_on_one_scale(name, lenses):
    figure = rt.compare(*lenses, name, names=("before", "after")).plot()
    panels = [panel for panel in figure.axes if panel.lines]
    upright = getattr(COMPARED[name].draws, "upright", False)
    scales = {tuple(np.round((panel.get_xlim() if upright else panel.get_ylim()), 9)) for panel in panels}
    if COMPARED[name].draws.is_shared:
        assert len(scales) == 1
    for panel in panels:
        drawn = [line for line in panel.lines if line.get_color() in COLOURS]
        assert {line.get_color() for line in drawn} == {*COLOURS}
        low, high = panel.get_xlim() if upright else panel.get_ylim()
        for line in drawn:
            values = line.get_xdata() if upright else line.get_ydata()
            assert low <= np.nanmin(values)
            assert np.nanmax(values) <= high
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words[:2] == ["A: before", "B: after"]


def test_spots_maps_and_layouts_have_one_scale(lenses):
    spots = rt.compare(*lenses, "spot").plot()
    assert len({panel.get_xlim() for panel in spots.axes if panel.lines}) == 1
    maps = rt.compare(*lenses, "wavefront", fields=[0, 5]).plot()
    images = [image for panel in maps.axes for image in panel.images]
    assert len({image.get_clim() for image in images}) == 1
    assert len(images) == 4
    layouts = rt.compare(lenses[0], rt.edit.scale(lenses[0], 0.5), "layout").plot()
    extents = {round(panel.get_xlim()[1] - panel.get_xlim()[0], 9) for panel in layouts.axes}
    assert len(extents) == 1


def test_sums_of_seidel_aberrations_are_compared(lenses):
    comparison = rt.compare(*lenses, "seidel")
    frame = comparison.to_frame()
    assert frame["S1_2"].item() == pytest.approx(float(rt.seidel(lenses[1]).contributions[0].sum()), rel=1e-14)
    assert len(comparison.plot().axes[0].patches) == 2 * 7


def test_over_temperature_the_mount_and_the_frequency_of_the_mtf_are_stated(lenses):
    comparison = rt.compare(*lenses, "thermal", fields=[0.0])
    cycles = f"{float(comparison.first.frequency):.4g} cycles/mm"
    assert f"mount: aluminium, 23.6e-6/K, of spaces that state no expansion; MTF at {cycles}" in str(comparison)
    figure = comparison.plot()
    assert [panel.get_ylabel() for panel in figure.axes][-1] == f"lowest modulation at\n{cycles}, sensor fixed"
    assert figure.get_suptitle() == "over temperature, mount: aluminium, 23.6e-6/K"


def test_lenses_that_cannot_be_compared_are_refused(lenses):
    with pytest.raises(Incomparable, match=r"`analysis=mtff`: no such analysis; did you mean mtf\?"):
        rt.compare(*lenses, "mtff")
    with pytest.raises(Incomparable, match="of different kinds, angle and object height"):
        rt.compare(lenses[0], "folded_relay", "spot")
    with pytest.raises(Incomparable, match="goes with `analysis=mtf`"):
        rt.compare(*lenses, "spot", frequencies=[10])
    with pytest.raises(Incomparable, match="1 names; expected 2"):
        rt.compare(*lenses, "spot", names=["before"])


def test_the_command_prints_both_and_their_difference(command):
    code, out, err = command("compare", "singlet", "cemented_achromat", "--plot", "layouts.png")
    assert code == 0, err
    assert out.startswith("layout: A singlet, B cemented_achromat")
    assert Path("layouts.png").stat().st_size > 10_000
    code, out, err = command("compare", "singlet", "nothing.zmx")
    assert code == 1
    assert "nothing.zmx: no such lens file" in err
    code, _, err = command("compare", "singlet", "folded_relay", "--analysis", "spot")
    assert code == 1
    assert "singlet, folded_relay: the fields of the lenses are of different kinds" in err
