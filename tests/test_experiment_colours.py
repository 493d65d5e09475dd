"""The study of colours restored together: its spectra, its lenses with axial colour, its table."""

import numpy as np
import pytest
import torch
from scripts import script

import raytrace as rt
from raytrace.imaging.pictures import dead_leaves

colours = script("codesign_colours")


def test_synthetic_spectra_have_their_correlation_in_every_band():
    pictures = dead_leaves(8, size=64, colour=True, correlation=0.8)
    patches = colours.patches(pictures, 64, 2)
    assert patches.shape == (16, 3, 64, 64)
    measured = rt.imaging.cross_spectrum(patches)
    of_synthetic = colours.synthetic(measured, 0.97)
    assert np.allclose(colours.correlations(of_synthetic), 0.97, rtol=1e-12)
    mean = measured.real.mean((-2, -1)).diagonal().mean()
    assert float(of_synthetic.mean((-2, -1))[1, 1]) == pytest.approx(float(mean), rel=1e-12)
    by_band = np.array(colours.correlations(measured))
    assert by_band.shape == (5, 3)
    assert ((by_band > 0.6) & (by_band < 0.95)).all()  # of the light of levels of correlation 0.8


def test_images_of_the_range_are_spread_over_the_axial_colour():
    """±0.2 mm for 100 mm of focal length, evenly in 1/z; a single distance is itself."""
    at = colours.distances("16 to 48 m", 5)
    steps = (1e4 / at).diff()
    torch.testing.assert_close(steps, steps[:1].expand_as(steps))
    near, far = colours.SCENES["16 to 48 m"]
    assert 1e4 / near - 1e4 / far == pytest.approx(0.4, rel=0.05)
    assert colours.distances("24 m", 5).tolist() == [24e3]


@pytest.mark.parametrize("name", colours.VARY)
def test_the_second_start_has_axial_colour_and_the_focal_length(name):
    lens = colours.lens_of(name)
    variables = colours.variables_of(name, lens)
    assert abs(colours.axial_colour(variables())) < 0.2
    colours.with_colour(name, variables)
    assert colours.axial_colour(variables()) == pytest.approx(0.4, abs=0.02)
    lengths = [float(rt.first_order(one).effective_focal_length) for one in (lens, variables().at())]
    assert lengths[1] == pytest.approx(lengths[0], rel=1e-9)
    again = colours.rebuilt(name, variables.numbers())
    assert colours.axial_colour(again) == pytest.approx(colours.axial_colour(variables()), abs=1e-12)


@pytest.mark.slow
def test_descents_of_both_filters_lower_the_error():
    """A few cycles, on the axis and at one distance, behind filters apart and joint, from both starts."""
    spectrum = colours.synthetic(rt.imaging.power_law(colours._PERIOD).expand(3, 3, -1, -1), 0.97)
    ends = []
    for filters in ("apart", "joint"):
        end = colours.optimised(
            "cooke_triplet", "axis", "24 m", lambda k, f=filters: colours.closed_form(k, spectrum, f).mean(), 4
        )
        lens = colours.lens_of("cooke_triplet")
        kernel = colours.kernels(lens, colours.field_points(lens, "axis"), "24 m")
        torch.testing.assert_close(kernel.sum((-2, -1)), torch.ones(1, 1, 3, dtype=torch.float64))
        before = 1e3 * float(colours.closed_form(kernel, spectrum, filters).mean())
        assert end["value"] == min(value for value, _ in end["starts"].values()) < 0.9 * before
        assert colours.axial_colour(colours.rebuilt("cooke_triplet", end["numbers"])) == end["axial_colour"]
        ends.append(end)
    assert ends[1]["value"] < ends[0]["value"]


def test_the_table_pairs_seeds():
    """Differences relative to the lens for filters apart behind the joint filter, and their interval."""

    def document(apart: float, joint: float, colour: float) -> dict:
        return {"errors": {"apart": [[[apart]]], "joint": [[[joint]]]}, "axial_colour": colour}

    found = {}
    for seed, ratio in enumerate((0.8, 0.9)):
        key = ("double_gauss", "axis", "16 to 48 m")
        found[*key, "apart", seed] = document(3e-4, 2e-4, 0.1)
        found[*key, "joint", seed] = document(5e-4, ratio * 2e-4, 0.4)
    found["double_gauss", "axis", "16 to 48 m", "joint", 2] = document(1, 1, 1)  # without its pair
    (row,) = colours.comparisons(found, ["double_gauss"])
    assert row["seeds"] == 2
    assert row["difference"] == pytest.approx([-20, -10])
    line = colours.table([row]).splitlines()[-1]
    assert "| pictures | 2.000 | 1.700 | -15.0 ± 63.5 | 0.10 | 0.40 |" in line  # 12.706 · 7.07/√2
