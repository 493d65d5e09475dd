"""Etching: the depths nearest in phase that a process can fabricate."""

import math

import pytest
import torch

from raytrace.materials.catalogs import find_glass
from raytrace.wave_optics.element import Element, EvenPowers, Rings, period
from raytrace.wave_optics.fabrication import Process, matched

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


def test_feasible_depths_are_matched_exactly():
    """Depths within the relief, on its levels, come back as they are, but for a step common to all; agreement 1."""
    process = Process(waves=2, levels=8)
    step = float(process.period(thick())) / 8
    numbers = torch.randint(0, 8, (50,), generator=torch.Generator().manual_seed(1))
    result, near = matched(rings(numbers * step), process, COLOURS)
    shift = torch.round(result.numbers / step).long() - numbers
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


def test_a_smooth_element_is_not_etched():
    smooth = Element(EvenPowers(torch.zeros(1).double()), torch.tensor(0.5).double(), SILICA)
    with pytest.raises(ValueError, match="no features to fabricate"):
        matched(smooth, Process(), COLOURS)
