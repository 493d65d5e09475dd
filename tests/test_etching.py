"""Etching: the nearest depths in phase, learning under a process, levels that move where the error falls."""

import json
import math

import pytest
import torch

from raytrace.cli import main
from raytrace.imaging.training import OtherSettings
from raytrace.materials.catalogs import find_glass
from raytrace.studies.edof import report
from raytrace.studies.edof.world import ClosedForm, World, periodic, spectrum
from raytrace.studies.pictures import dead_leaves
from raytrace.studies.quantise import process_report
from raytrace.studies.quantise.process import Case, cases, etch_rings, move_levels, under_errors
from raytrace.studies.quantise.process_command import Settings
from raytrace.wave_optics.element import Element, EvenPowers, Rings, period
from raytrace.wave_optics.etching import Process, matched, relief

#: Small, and quick: 1 mm, f/20, two colours, three depths.
WORLD = World(radius=0.5, sensor_distance=20.0, depths=(200.0, 400.0, math.inf), design=400.0, wavelengths=(0.5, 0.6),
              size=47)  # fmt: skip
S = spectrum(periodic(dead_leaves(6, size=64), 96))
COLOURS = torch.tensor([0.46, 0.55, 0.64], dtype=torch.float64)
SILICA = find_glass("F_SILICA")


def rings(heights, pitch=0.01) -> Element:
    heights = torch.as_tensor(heights, dtype=torch.float64)
    radius = torch.tensor(0.5, dtype=torch.float64)
    return Element(Rings(heights, torch.tensor(pitch, dtype=torch.float64)), radius, SILICA)


def thick() -> Element:
    """A lens of fused silica in whole heights, 50 rings, several waves thick."""
    r = (torch.arange(50, dtype=torch.float64) + 0.5) * 0.01
    return rings(-(r**2) / 2 / 19.0 / 0.46)


def expected() -> ClosedForm:
    return ClosedForm((thick(),), WORLD, S)


def test_what_a_process_can_make_is_matched_exactly():
    """Depths within the relief, on its levels, come back as they are, but for a step common to all; agreement 1."""
    process = Process(waves=2, levels=8)
    step = float(process.period(thick())) / 8
    numbers = torch.randint(0, 8, (50,), generator=torch.Generator().manual_seed(1))
    found, near = matched(rings(numbers * step), process, COLOURS)
    shift = torch.round(found.numbers / step).long() - numbers
    assert near == pytest.approx(1, abs=1e-6)
    assert len(shift.unique()) == 1


def test_one_wave_is_no_difference_at_one_colour():
    """Whole heights modulo a wave of 0.55 µm agree to half a candidate's step, and in three colours less."""
    one, near = matched(thick(), Process(), COLOURS[1:2])
    assert near > math.cos(math.pi / 256) - 1e-9
    wave = float(period(SILICA, 0.55))
    assert float(one.numbers.min()) >= 0
    assert float(one.numbers.max()) < wave
    three = [matched(thick(), Process(waves=m), COLOURS)[1] for m in (1, 2, 4)]
    assert three[0] < three[1] < three[2] < near


def test_matched_is_nearer_than_wrapped():
    """In Σ cos over colours with the pistons free, the measure itself."""
    process = Process(waves=1, levels=16)
    own, near = matched(thick(), process, COLOURS)
    assert own.levels == 16
    assert len(torch.round(own.numbers / float(own.period) * 16).unique()) <= 16
    rate = 2 * math.pi / (1e-3 * COLOURS) * torch.tensor([1.46483, 1.45991, 1.45681]).double().sub(1)
    area = torch.arange(50).double() + 0.5
    wrapped = thick().numbers.remainder(float(process.period(thick())))
    apart = rate[:, None] * (wrapped - thick().numbers)
    total = torch.polar(area.expand(3, -1).contiguous(), apart).sum(1).abs().sum() / (3 * area.sum())
    assert near > float(total) + 0.02


def test_relief_is_that_of_the_levels():
    assert float(relief(thick(), Process(waves=1, levels=16))) == pytest.approx(1.196e-3 * 15 / 16, rel=1e-3)
    assert float(relief(thick(), Process(waves=2))) == pytest.approx(2 * 1.196e-3, rel=1e-3)
    smooth = Element(EvenPowers(torch.zeros(1).double()), torch.tensor(0.5).double(), SILICA)
    with pytest.raises(ValueError, match="no features to be etched"):
        matched(smooth, Process(), COLOURS)


@pytest.mark.parametrize("levels", [0, 4])
def test_learning_under_the_process_lowers_the_error(levels):
    """Below its start, on its levels, within its relief; the same seed the same rings."""
    process = Process(waves=1, levels=levels, tolerance=2e-5)
    form = expected()
    start, _ = matched(thick(), process, torch.tensor(WORLD.wavelengths).double())
    found = etch_rings(thick(), process, form, steps=25, moves=25, seed=3)
    assert float(form((found,))) < float(form((start,)))
    assert found.period is None
    assert float(found.numbers.min()) >= 0
    assert float(found.numbers.max()) <= float(process.period(found)) * (1 - 1 / levels if levels else 1) + 1e-12
    if levels:
        steps = found.numbers / float(process.period(found)) * levels
        torch.testing.assert_close(steps, torch.round(steps), rtol=0, atol=1e-9)
    again = etch_rings(thick(), process, form, steps=25, moves=25, seed=3)
    assert torch.equal(found.numbers, again.numbers)


def test_levels_move_only_where_the_error_falls():
    process, form = Process(waves=1, levels=4), expected()
    numbers = torch.randint(0, 4, (50,), generator=torch.Generator().manual_seed(2))
    step = float(process.period(thick())) / 4
    errors = [
        float(form((thick().with_numbers(step * move_levels(thick(), numbers, process, form, moves=n)),)))
        for n in (0, 5, 20)
    ]
    assert errors[0] > errors[1] > errors[2]


def test_errors_of_height_cost_something():
    element = etch_rings(thick(), Process(tolerance=0.0), expected(), steps=15)
    drawn = under_errors(element, expected(), 1e-4)
    assert len(set(drawn)) == 10
    assert sum(drawn) / 10 > float(expected()((element,)))


def test_every_process_once_before_any_a_second_time():
    found = list(cases((1, 2), (4, 16), (0.01,), 2))
    assert [one.start for one in found] == [0] * 4 + [1] * 4
    assert found[1] == Case(1, 16, 0.01, 0)
    assert (found[1].row, found[1].model.row) == ("etched-1-16", "learned")


def test_what_is_etched_is_that_of_its_pictures(monkeypatch, tmp_path):
    """A folder of other leaves is refused, finished or not."""
    case, settings = Case(1, 4, 0.01, 0), Settings()
    monkeypatch.setattr(process_report, "learn_unit", lambda *given: pytest.fail("learned"))
    for _ in range(2):
        with pytest.raises(pytest.fail.Exception):
            process_report.etched(case, settings, dead_leaves(2, size=16), tmp_path)
    with pytest.raises(OtherSettings, match="pictures was '2, blake2"):
        process_report.etched(case, settings, dead_leaves(2, size=16, seed=1), tmp_path)


@pytest.mark.slow
def test_the_command_learns_judges_and_goes_on(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(report, "_LEAVES", 4)
    words = ["wave", "etch", "--waves", "1", "--levels", "16", "--starts", "1", "--steps", "2", "--moves", "2"]
    words += ["--learn", "2", "-o", str(tmp_path / "run"), "--docs", str(tmp_path / "docs"), "--json"]
    assert main(words) == 0
    first = json.loads(capsys.readouterr().out)
    rows = {(row["content"], row["filter"], row["waves"]): row for row in first["rows"]}
    model, own = (rows["sharp leaves", "blind", waves] for waves in (0, 1))
    assert own["over_fresnel"] < model["over_fresnel"]
    assert own["over_fresnel_low"] <= own["over_fresnel"] <= own["over_fresnel_high"]
    assert "1.12 µm, 16 levels" in (tmp_path / "docs/wave_etch.md").read_text()
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out) == first
