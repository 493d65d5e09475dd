"""Modulation of diffraction from a few rings of rays: against the analysis of the lens, a perfect lens, differences."""

import dataclasses

import numpy as np
import pytest
import torch
from differences import slopes_by_differences
from problems import values

import raytrace as rt
from raytrace.analysis.pupil_autocorrelation import Fit, layout_of, otf
from raytrace.optimization.lens_state import LensState
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.variables import DesignVariables
from raytrace.system.optimization_data import Row, Vary


def rows(lens: rt.Lens, *frequencies: float, sections: str = "TS", sampling: int = 1, fields=None) -> list[Row]:
    chosen = range(1, len(lens.fields.x) + 1) if fields is None else fields
    return [
        Row(f"MTF{s}", (sampling, 0), (float(field), nu, 0.0, 0.0), weight=1.0)
        for s in sections
        for field in chosen
        for nu in frequencies
    ]


def of_analysis(lens: rt.Lens, *frequencies: float) -> np.ndarray:
    found = rt.mtf(lens, list(frequencies))
    return np.concatenate([part.numpy().ravel() for part in (found.tangential, found.sagittal)])


@pytest.fixture
def few(monkeypatch):
    """Fails where a lens goes through torch."""

    def refuse(*_, **__):
        raise AssertionError("a wave by torch")

    monkeypatch.setattr(LensState, "through_torch", refuse)


def vignetted() -> rt.Lens:
    """A telephoto lens whose beams off the axis are cut and shifted by vignetting factors."""
    lens = rt.read_lens("telephoto")
    factors = torch.zeros(5, len(lens.fields.x), dtype=torch.float64)
    factors[1, 1:], factors[2, 1:], factors[3, 1:] = 0.1, 0.05, 0.3
    return dataclasses.replace(lens, fields=dataclasses.replace(lens.fields, vignetting=factors))


@pytest.mark.parametrize(("name", "sampling"), [("cooke_triplet", 1), ("telephoto", 1), ("phone", 2)])
def test_modulation_of_a_few_rings_is_that_of_the_analysis(name, sampling, few):
    """To 1.2e-3: what a grid of 128 points leaves, the analysis's least."""
    lens = rt.read_lens(name)
    found = values(lens, rows(lens, 10.0, 30.0, 60.0, sampling=sampling))
    assert np.abs(found - of_analysis(lens, 10.0, 30.0, 60.0)).max() < 1.2e-3


def test_modulation_of_vignetted_beams(few):
    lens = vignetted()
    assert np.abs(values(lens, rows(lens, 20.0, 60.0)) - of_analysis(lens, 20.0, 60.0)).max() < 1.2e-3


def test_more_rings_come_to_the_same_modulation(few):
    """The analysis's grids err by 1e-3; polynomials of degree 12 and 16 by less than a tenth of that."""
    for name in ("cooke_triplet", "telephoto"):
        lens = rt.read_lens(name)
        one, other = (values(lens, rows(lens, 10.0, 40.0, sampling=n)) for n in (1, 3))
        assert np.abs(one - other).max() < 1e-4


def test_a_perfect_lens_has_the_modulation_of_a_clear_circle(few):
    """A parabola of F/20: (2/π)(acos s - s √(1 - s²)) of s = ν λ F, and 0 beyond 1."""
    mirror = {"radius": -400.0, "conic": -1.0, "thickness": -200.0, "glass": "MIRROR"}
    lens = rt.lens([mirror], stop=1, entrance_pupil_diameter=10.0, wavelengths=[0.5])
    s = np.array([0.1, 0.5, 0.9, 1.2])
    found = values(lens, rows(lens, *(1e3 * s / (0.5 * 20.0)), sections="T"))
    expected = 2 / np.pi * (np.arccos(np.minimum(s, 1)) - np.minimum(s, 1) * np.sqrt(np.maximum(1 - s * s, 0)))
    assert np.abs(found - expected).max() < 2e-4  # sines and tangents of 1.4 degrees differ by 3e-4


def test_a_field_on_the_x_axis_has_sections_exchanged(few):
    """All of the pupil there, where on the y axis the right half tells the rest."""
    lens = rt.read_lens("telephoto")
    y = float(lens.fields.y[-1])
    up, aside = (values(lens.at(fields=[at]), rows(lens, 20.0, 60.0, fields=[1])) for at in ((0.0, y), (y, 0.0)))
    assert np.abs(up.reshape(2, -1) - aside.reshape(2, -1)[::-1]).max() < 1e-6


@pytest.mark.parametrize("name", ["cooke_triplet", "vignetted", "skew"])
def test_derivatives_of_modulation_of_a_few_rings(name, few):
    lens = vignetted() if name == "vignetted" else rt.read_lens("cooke_triplet")
    lens = lens.at(fields=[(3.0, 10.0)]) if name == "skew" else lens
    last = len(lens.surfaces) - 2
    model = DesignVariables(lens, (Vary(1, "curvature"), Vary(last, "thickness")))
    evaluation = Evaluation(model, rows(lens, 10.0, 25.0, sections="TA"))
    found = evaluation(model.start, derivatives=True)
    expected = slopes_by_differences(evaluation, model.start, 1e-5)
    difference = np.abs(found.jacobian / evaluation.factors[:, None] - expected)
    assert (difference < 2e-6 * np.abs(expected).max(0)).all()


def test_polynomials_carry_derivatives_back_to_their_rays():
    """Of a sum of OTFs, by finite differences of the waves and the directions."""
    layout, random = layout_of(6, half=False), np.random.default_rng(0)
    x, y = layout.points
    wave = np.stack([0.3 * x**3 + 0.2 * y**8, 0.4 * (x * x + y * y) - 0.3 * y**3])
    directions = np.stack([[x + 0.02 * y * y, x], [y + 0.03 * x * y, 1.1 * y - 0.02 * y**7]])

    def modulated(wave: np.ndarray, directions: np.ndarray) -> tuple[float, Fit, torch.Tensor]:
        fit = Fit(layout, wave, directions)
        polynomials = torch.from_numpy(fit.polynomials)[:, None].requires_grad_()
        parts = otf(polynomials, torch.from_numpy(0.6 / fit.scale[1])[None], 16)
        return (parts.real + 2 * parts.imag).sum(), fit, polynomials

    number, fit, polynomials = modulated(wave, directions)
    by_wave, by_directions = fit.by_rays(torch.autograd.grad(number, polynomials)[0].numpy())
    for of, by in ((0, by_wave[0]), (1, by_directions[:, 0])):
        change = random.normal(size=by.shape)
        moved = [[wave, directions], [wave, directions]]
        for sign, both in zip((1, -1), moved, strict=True):
            both[of] = both[of] + sign * 1e-5 * change
        difference = (modulated(*moved[0])[0] - modulated(*moved[1])[0]) / 2e-5
        assert float(difference.detach()) == pytest.approx(float((by * change).sum()), rel=1e-6)


def test_beams_that_apertures_clip_go_by_a_grid():
    """The secondary mirror of a telescope obscures the beam."""
    lens = rt.read_lens("hubble")
    assert np.abs(values(lens, rows(lens, 20.0, sampling=3)) - of_analysis(lens, 20.0)).max() < 1.2e-3
