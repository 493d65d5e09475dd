"""The MTF of rays against dense sums over the pupil."""

import math

import pytest
import torch

import raytrace as rt
from raytrace.analysis.setting import NothingToShow
from raytrace.maths.sampling import gauss_rings
from raytrace.tracing.spot import image_rays


@pytest.mark.parametrize("name", ["cooke_triplet", "tessar", "retrofocus"])
def test_the_geometric_mtf_of_steep_aberrations_is_a_sum_over_many_rays(name):
    """Aberrations of high order: the slope of the landing points by the pupil is 0.5 mm for a blur of 0.2 mm in the
    Tessar, and rings for the blur alone left an error of 0.04. Tolerance: of modulation, twice the error measured."""
    lens = rt.focus(rt.read_lens(name)).lens
    lens = lens.at(wavelengths=(float(lens.primary),))
    frequencies = torch.linspace(0, 83, 6, dtype=torch.float64)
    curves = rt.mtf(lens, frequencies, fields=[0, lens.fields.y.abs().max().item()], geometric=True)
    points, weights = gauss_rings(200, 600)
    for field in range(2):
        y = image_rays(lens, points, fields=curves.fields[:, [field]]).position[1][0, 0]
        wanted = torch.stack(
            [(torch.exp(2j * math.pi * f * (y - y.mean())) * weights).sum().abs() for f in frequencies]
        )
        torch.testing.assert_close(curves.tangential[field], wanted, rtol=0, atol=2e-5)


def test_a_lens_without_a_focus_has_no_frequencies():
    with pytest.raises(NothingToShow, match="the lens has no focus"):
        rt.mtf("phone_plates")
    assert float(rt.mtf("phone_plates", [10.0], geometric=True).tangential.max()) < 0.1
