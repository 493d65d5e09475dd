"""A lens over temperature: the analysis, temperatures as configurations, and optimisation over them."""

import dataclasses
import json
import re
import warnings

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace.maths.numerics import Dual
from raytrace.optimization.variables import design_variables
from raytrace.tracing.geometry import semi_diameters


def air_spaced(**last):
    """An air-spaced achromat with an aspheric front."""
    rows = [
        dict(radius=60.0, thickness=6.0, glass="N-BK7", coefficients=[0.0, -1e-7]),
        dict(radius=-50.0, thickness=4.0),
        dict(radius=-45.0, thickness=2.0, glass="F2"),
        dict(radius=-150.0, thickness=94.0, **last),
    ]
    colours = dict(wavelengths=[0.5876, 0.4861, 0.6563], catalogs=["SCHOTT"])
    return rt.lens(rows, stop=1, entrance_pupil_diameter=12.0, fields=[0, 2], **colours)


def simple():
    """It on its axis, in one colour."""
    return air_spaced().at(fields=[0], wavelengths=[0.5876])


@pytest.fixture(scope="module")
def shown():
    return rt.thermal(simple(), [-20, 60], samples=3, modulation_frequency=20)


def test_the_analysis_has_the_numbers_of_the_lens_at_each_temperature(shown):
    for k, celsius in enumerate((-20.0, 20.0, 60.0)):
        lens = simple().at(temperature=celsius, mount="aluminium")
        focused = rt.focus(lens)
        assert shown.effective_focal_length[k] == rt.first_order(lens).effective_focal_length
        assert shown.sensor_distance[k] == lens.surfaces[-2].thickness
        assert shown.rms[1, k].item() == pytest.approx(focused.rms_radius().item(), rel=1e-9)
        assert shown.rms[0, k].item() == pytest.approx(focused.rms_radius(lens.surfaces[-2].thickness).item(), rel=1e-9)
    curve = rt.mtf(lens, [20])
    lowest = torch.minimum(curve.tangential, curve.sagittal).min().item()
    assert shown.modulation[0, 2].item() == pytest.approx(lowest, abs=1e-12)
    assert shown.focus_shift[1].item() == pytest.approx(0.0, abs=1e-12)
    assert bool((shown.rms[0] >= shown.rms[1]).all())
    assert shown.depth_of_focus.item() == pytest.approx(0.5e-3 * 0.5876 / 0.06**2, rel=0.02)


def test_the_analysis_is_a_table_a_figure_and_a_document(shown, tmp_path):
    document = shown.document()
    assert document["mount_expansion"] == 23.6
    assert [row["temperature"] for row in document["results"]] == [-20.0, 20.0, 60.0]
    assert "focus shift" in str(shown)
    shown.plot(tmp_path / "thermal.png")
    shown.save(tmp_path / "thermal.csv")
    assert (tmp_path / "thermal.csv").read_text().startswith("temperature,effective_focal_length")


def test_the_default_frequency_is_that_of_half_contrast_in_focus():
    lens = rt.lens([dict(radius=60.0, thickness=5.0, glass="N-BK7"), dict(radius=-60.0, thickness=57.0)], stop=1,
                   entrance_pupil_diameter=12.0, fields=[0], wavelengths=[0.5876])  # fmt: skip
    shown = rt.thermal(lens, [15, 25], samples=3)
    assert float(shown.modulation[1, 1]) == pytest.approx(0.5, abs=0.02)  # of a frequency of two digits
    curves = rt.mtf(rt.focus(lens).lens, float(shown.frequency))
    lowest = min(float(curves.tangential.min()), float(curves.sagittal.min()))
    assert lowest == pytest.approx(0.5, abs=0.02)


def test_the_command_prints_the_analysis(command):
    code, out, err = command(
        *("thermal", "cemented_achromat", "--range", -10, 40, "--mount", "titanium", "--samples", 2, "--json"),
        *("--modulation-frequency", 20, "--field", 0, "--wavelength", 0.5876),
    )
    assert code == 0, err
    document = json.loads(out)
    assert (document["mount_expansion"], document["frequency"]) == (8.6, 20.0)


def test_a_range_and_a_mount_that_are_none_are_refused():
    with pytest.raises(ValueError, match=r"`temperatures` \[60, -20\]: expected the lowest and the highest"):
        rt.thermal(simple(), [60, -20])
    with pytest.raises(ValueError, match="mount 'wood'"):
        rt.thermal(simple(), mount="wood")


# -- temperatures as configurations -----------------------------------------------------------------------------------


def warm():
    return air_spaced().with_temperatures([-20, 60], mount="aluminium")


def numbers(lens):
    return [(s.thickness.item(), 0.0 if s.curvature is None else s.curvature.item()) for s in lens.surfaces[1:]]


def in_one_configuration(lens):
    """Configuration 1 alone, with contact of the spacers at the semi-diameters that it stores."""
    data = dataclasses.replace(lens.optimization_data, semi_diameters=tuple(range(1, len(lens.surfaces) - 1)))
    return dataclasses.replace(lens.configuration(1), operands=(), optimization_data=data)


def test_configurations_are_the_lens_at_each_temperature():
    lens = warm()
    assert [each.environment.temperature.item() for each in lens.configurations] == [20.0, -20.0, 60.0]
    start = in_one_configuration(lens)
    for number, celsius in ((2, -20), (3, 60)):
        assert numbers(lens.configuration(number)) == numbers(start.at(temperature=celsius))
    with pytest.raises(ValueError, match="the lens has 3 configurations; temperatures"):
        lens.with_temperatures([0])
    with pytest.raises(ValueError, match=r"surface 1 is none: .* conics and even aspheres"):
        air_spaced().replace(1, tilt_x=1.0).with_temperatures([0])


def test_variables_of_the_lens_move_all_temperatures():
    """By the optimiser's numbers, by tensors and by `Lens.at`; their derivatives against differences."""
    model = design_variables(warm(), "curvature thickness sensor a4:1")
    assert {variable.configuration for variable in model.variables} == {1}
    x = model.start + np.array([1e-4 if v.quantity == "curvature" else 0.3 for v in model.variables])
    x[[v.quantity == "a4" for v in model.variables]] = 2e-7
    moved = model.lens_at(x)
    start = in_one_configuration(moved)
    for number, celsius in ((2, -20), (3, 60)):
        state, hot = model.views[number - 1].state(Dual(x, np.eye(len(x)))), moved.configuration(number)
        expected = numbers(start.at(temperature=celsius))
        assert numbers(hot) == pytest.approx(np.array(expected), rel=1e-14)
        for k in range(1, 5):
            assert float(state.thickness[k].value) == pytest.approx(expected[k - 1][0], rel=1e-14)
        gap = state.thickness[2]
        for j, variable in enumerate(model.variables):
            step = 1e-4 if variable.quantity != "curvature" else 1e-6
            ends = [model.views[number - 1].state(x + side * step * np.eye(len(x))[j]) for side in (1, -1)]
            slope = (float(ends[0].thickness[2]) - float(ends[1].thickness[2])) / (2 * step)
            assert gap.slope[j] == pytest.approx(slope, rel=1e-5, abs=1e-7)


def test_a_file_of_thermal_pickups_is_followed(tmp_path):
    rt.write_lens(warm(), tmp_path / "warm.zmx")
    again = rt.read_lens(tmp_path / "warm.zmx")
    assert "kept" not in str(again.optimization_data)
    assert {solve.kind for solve in again.optimization_data.solves} == {"thermal"}
    for one, other in zip(again.configurations, warm().configurations, strict=True):
        assert numbers(one) == pytest.approx(np.array(numbers(other)), rel=1e-12)
    assert len(design_variables(again, "curvature").variables) == 4


def test_another_glass_expands_by_its_own_coefficients():
    lens = warm()
    lens = dataclasses.replace(lens.replace(1, glass="N-LAK34"))
    model = design_variables(lens, "thickness:2")
    hot = model.lens.configuration(3)
    assert hot.surfaces[1].thickness.item() == pytest.approx(6.0 * (1 + 40e-6 * 5.81), rel=1e-12)


def test_optimisation_over_temperatures_lowers_the_spots_of_all():
    lens = warm()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = rt.optimize(lens, vary="curvature:1 sensor", merit="spot", cycles=4)
    before, after = (
        [rt.spot(each, fields=[0]).whole.rms_radius.item() for each in each_of.configurations]
        for each_of in (lens, found.lens)
    )
    assert max(after) < 0.8 * max(before)
    start = dataclasses.replace(found.lens.configuration(1), operands=())
    assert numbers(found.lens.configuration(3)) == pytest.approx(np.array(numbers(start.at(temperature=60))), rel=1e-12)


def test_only_what_is_asked_is_computed(shown, tmp_path):
    """The numbers that are asked are those of the whole analysis."""
    for measure in ("focus", ["rms"]):
        some = rt.thermal(simple(), [-20, 60], samples=3, measure=measure)
        assert some.modulation is None
        torch.testing.assert_close(some.focus_shift, shown.focus_shift, rtol=0, atol=1e-12)
        assert (some.rms is None) == (measure == "focus")
        assert list(some.columns()) == list(shown.columns())[: 7 if some.rms is not None else 5]
        some.plot(tmp_path / "some.png")
    torch.testing.assert_close(some.rms, shown.rms, rtol=0, atol=1e-12)
    assert "frequency" not in some.document()
    contrast = rt.thermal(simple(), [-20, 60], samples=3, measure="mtf", modulation_frequency=20)
    assert contrast.rms is None
    torch.testing.assert_close(contrast.modulation, shown.modulation, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match=r"`measure` 'spots': expected focus, rms, mtf"):
        rt.thermal(simple(), measure="spots")


def test_the_semi_diameters_at_temperatures_are_those_of_the_rays_and_not_of_an_earlier_design():
    lens = air_spaced()
    lens = lens.with_semi_diameters(fixed=())
    earlier = dataclasses.replace(
        lens,
        surfaces=tuple(
            s if s.semi_diameter is None else dataclasses.replace(s, semi_diameter=2 * s.semi_diameter)
            for s in lens.surfaces
        ),
    )
    warm = earlier.with_temperatures([-20, 60], mount="aluminium")
    for surface, expected in zip(warm.surfaces[1:-1], lens.surfaces[1:-1], strict=True):
        assert float(surface.semi_diameter) == pytest.approx(float(expected.semi_diameter), rel=1e-9)


def test_automatic_semi_diameters_follow_the_rays_of_an_athermal_lens(tmp_path):
    """After an optimisation they are those of the rays, the spacers have contact there, and the merit is that of it."""
    lens = air_spaced().with_semi_diameters(fixed=[4], margin=(0, 0.5))
    start = lens.with_temperatures([-20, 60], mount="aluminium")
    better = rt.optimize(start, vary="curvature sensor thickness:2", bounds="thickness:2..10", merit="spot", cycles=30)
    after = better.lens
    free = dataclasses.replace(after, operands=())  # without the operands that hold them still
    sizes = semi_diameters(free)
    assert abs(after.surfaces[2].semi_diameter / start.surfaces[2].semi_diameter - 1) > 1e-4
    for k in (1, 2, 3):
        assert after.surfaces[k].semi_diameter == pytest.approx(sizes[k], rel=2e-6)
    assert after.surfaces[4].semi_diameter == lens.surfaces[4].semi_diameter  # fixed
    for number, celsius in ((2, -20), (3, 60)):
        there = in_one_configuration(after).at(temperature=celsius)
        here = after.configuration(number)
        assert numbers(here) == pytest.approx(np.array(numbers(there)), rel=1e-13)
        for k in (1, 2, 3, 4):
            assert here.surfaces[k].semi_diameter == pytest.approx(float(there.surfaces[k].semi_diameter), rel=1e-13)
    assert float(rt.evaluate(after).merit) == pytest.approx(better.merit_after, rel=1e-9)
    rt.write_lens(after, tmp_path / "athermal.zmx")
    again = rt.read_lens(tmp_path / "athermal.zmx")
    assert again.with_semi_diameters() is again
    assert [s.semi_diameter for s in again.surfaces[1:5]] == [s.semi_diameter for s in after.surfaces[1:5]]
    stale = again.replace(1, curvature=1.05 * again.surfaces[1].curvature)
    assert stale.with_semi_diameters().surfaces[3].semi_diameter != stale.surfaces[3].semi_diameter


def test_contacts_that_still_move_are_a_warning(monkeypatch):
    """With the surfaces and the last change: the difference between the contacts of the descent and of the result."""
    monkeypatch.setattr("raytrace.optimization.optimize._CONTACTS", 1)
    lens = air_spaced().with_semi_diameters(fixed=[4], margin=(0, 0.5))
    start = lens.with_temperatures([-20, 60], mount="aluminium")
    settings = {"vary": "curvature sensor thickness:2", "bounds": "thickness:2..10", "merit": "spot", "cycles": 3}
    with pytest.warns(rt.NoOptimum, match="still change after 1 more descents") as caught:
        after = rt.optimize(start, **settings).lens
    (words,) = (str(warning.message) for warning in caught if warning.category is rt.NoOptimum)
    changes = dict(re.findall(r"surface (\d) by ([+-][\de.-]+) mm", words))
    assert {*changes} <= {"1", "2", "3"}
    assert all(abs(float(change)) > 1e-6 * after.surfaces[int(k)].semi_diameter for k, change in changes.items())
