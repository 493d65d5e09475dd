"""Operands of image quality: against the analyses of the same lens, and finite differences with lost rays."""

import numpy as np
import pytest
import torch
from differences import slopes_by_differences
from problems import vector, vignetting_aperture

import raytrace as rt
from raytrace.maths.pupil import gauss_rings, square
from raytrace.merit.merit import Evaluation
from raytrace.merit.model import Model
from raytrace.merit.plan import BadRow
from raytrace.optics.focus import image_rays
from raytrace.optics.scene import scene
from raytrace.optics.spot import spot_of, spot_of_points
from raytrace.optics.wavefront import rms, wavefront_of, without
from raytrace.system.intent import Row, Vary

FIELD = (0.0, 0.7)


def values(lens: rt.Lens, asked: list[Row], **how) -> np.ndarray:
    return Evaluation(Model(lens), asked, **how)(np.zeros(0)).values


def bare(lens: rt.Lens) -> rt.Lens:
    """The lens without apertures."""
    for number in range(1, len(lens.surfaces)):
        lens = lens.replace(number, apertures=())
    return lens


def at(lens: rt.Lens, field=FIELD) -> torch.Tensor:
    return torch.hypot(lens.fields.x, lens.fields.y).max() * vector(*field)[:, None]


# -- RMS over a beam ---------------------------------------------------------------------------------------------------


def test_rms_spots_are_those_of_the_same_rays():
    lens = bare(rt.read_lens("double_gauss_28deg"))
    points, weights = gauss_rings(3, 12)
    rays = image_rays(lens, points, fields=at(lens))
    share = lens.wavelength_weights / lens.wavelength_weights.sum()
    hits, joint = rays.position[:2, 0].flatten(1), (share[:, None] * weights).flatten()
    chief = image_rays(lens, torch.zeros(2, 1).double(), fields=at(lens)).position[:2, 0, lens.primary_wavelength, 0]
    there = torch.ones_like(hits[0], dtype=torch.bool)
    found = values(lens, [Row(name, (3, w), (*FIELD, 0, 0)) for name in ("RSCE", "RSCH") for w in (0, 3)])
    expected = [
        spot_of_points(hits, there, joint).rms_radius,
        spot_of(rays, weights).rms_radius[0, 2],
        spot_of_points(hits, there, joint, about=chief).rms_radius,
        spot_of(rays, weights, about=chief[:, None, None]).rms_radius[0, 2],
    ]
    assert np.abs(found / np.array(expected) - 1).max() < 1e-9


def test_rms_wavefronts_are_those_of_the_same_rays():
    """The analyses' sphere passes through the plane of the pupil, this one through its axial point: 1e-6 apart here."""
    lens = bare(rt.read_lens("double_gauss_28deg"))
    points, weights = gauss_rings(4, 16)
    front = wavefront_of(scene(lens, at(lens), lens.surfaces[0].thickness[None], lens.wavelengths), points, weights)
    waves, share = 1e-3 * lens.wavelengths, lens.wavelength_weights / lens.wavelength_weights.sum()
    about_chief = rms(front)[0, 0] / waves
    about_centroid = (weights * without(front, 3) ** 2).sum(-1).sqrt()[0, 0] / waves
    expected = [
        number for each in (about_centroid, about_chief) for number in ((share * each * each).sum().sqrt(), each[0])
    ]
    found = values(lens, [Row(name, (4, w), (*FIELD, 0, 0)) for name in ("RWCE", "RWCH") for w in (0, 1)])
    assert np.abs(found / np.array(expected) - 1).max() < 1e-4
    axis = values(lens, [Row("RWCH", (4, 2))])
    front = wavefront_of(scene(lens, 0 * at(lens), lens.surfaces[0].thickness[None], lens.wavelengths), points, weights)
    assert axis[0] == pytest.approx(float(rms(front)[0, 0, 1] / waves[1]), rel=1e-9)


def clipped(part: float) -> rt.Lens:
    """A triplet whose stop is closed to that part of its radius, while the beam fills all of it."""
    lens = rt.read_lens("cooke_triplet")
    return lens.replace(lens.stop, apertures=vignetting_aperture(part * abs(float(rt.first_order(lens).stop_height))))


def test_a_rectangular_grid_counts_what_apertures_let_through():
    lens, (points, weights) = clipped(0.6), square(12)
    rays = image_rays(lens, points, fields=at(lens))
    assert 10 < int(rays.valid[0, 1].sum()) < 0.6 * len(weights)
    found = values(lens, [Row("RSRE", (6, 2), (*FIELD, 0, 0)), Row("RSCE", (6, 2), (*FIELD, 0, 0))])
    assert found[0] == pytest.approx(float(spot_of(rays, weights).rms_radius[0, 1]), rel=1e-9)
    assert found[1] > 1.2 * found[0]
    front = wavefront_of(scene(lens, 0 * at(lens), lens.surfaces[0].thickness[None], lens.wavelengths), points)
    axis = values(lens, [Row("RWRH", (6, 2))])
    assert axis[0] == pytest.approx(float(rms(front)[0, 0, 1] / (1e-3 * lens.wavelengths[1])), rel=1e-9)


def test_more_rings_come_to_the_same_number():
    lens = rt.read_lens("double_gauss_28deg")
    found = values(lens, [Row(name, (n, 0), (*FIELD, 0, 0)) for name in ("RSCE", "RWCE") for n in (6, 12)])
    assert found[0] == pytest.approx(found[1], rel=1e-4)
    assert found[2] == pytest.approx(found[3], rel=1e-4)


def test_spots_are_in_the_unit_of_the_rows_and_waves_are_waves():
    lens = rt.read_lens("cooke_triplet")
    asked = [Row("RSCE", (3, 0), (*FIELD, 0, 0)), Row("RWCE", (3, 0), (*FIELD, 0, 0))]
    assert np.abs(values(lens, asked, unit=25.4) / values(lens, asked) - [1 / 25.4, 1]).max() < 1e-14


def test_no_rings_are_an_error():
    with pytest.raises(BadRow, match=r"row 1 .*RSCE asks for no rays: give 1 ring or more"):
        values(rt.read_lens("singlet"), [Row("RSCE", (0, 1))])


VARIABLES = (Vary(1, "curvature"), Vary(4, "thickness"), Vary(6, "curvature"), Vary(6, "thickness"))


@pytest.mark.parametrize("target", [0.0, 0.5])
@pytest.mark.parametrize("operand", ["RSCE", "RSCH", "RWCE", "RWCH", "RSRE", "RSRH", "RWRE", "RWRH"])
def test_derivatives_of_rms(operand, target):
    """With a target of 0 the row stands as a vector: JᵀJ is not compared, but Jᵀr, the slope of the row's square."""
    model = Model(clipped(0.7), VARIABLES)
    asked = [Row(operand, (4, 0), (*FIELD, 0, 0), target, 1.0), Row(operand, (3, 1), (0.3, 0.2, 0, 0), target, 2.0)]
    evaluation = Evaluation(model, asked)
    found = evaluation(model.start, derivatives=True)
    assert not found.lost.any()
    expected = slopes_by_differences(evaluation, model.start, 1e-5)
    for row in range(2):
        of = found.of_row == row
        missed = found.values[row] - target
        assert found.residuals[of] @ found.residuals[of] == pytest.approx(evaluation.factors[row] ** 2 * missed**2)
        slope = found.jacobian[of].T @ found.residuals[of]
        by = evaluation.factors[row] ** 2 * missed * expected[row]
        assert np.abs(slope - by).max() < 1e-7 * np.abs(by).max()


def test_a_beam_that_loses_a_ray_is_lost_and_on_a_grid_those_that_arrive_count():
    """A sphere of 20 mm radius in a beam of 44 mm."""
    front = {"radius": 20.0, "thickness": 3.0, "glass": 1.5}
    lens = rt.lens([front, {"radius": np.inf, "thickness": 36.0}], stop=1, entrance_pupil_diameter=44.0)
    asked = [Row(name, (6, 1), weight=1.0) for name in ("RSCE", "RWCE", "RSRE", "RWRE")]
    model = Model(lens, (Vary(1, "curvature"), Vary(2, "thickness")))
    found = Evaluation(model, asked)(model.start, derivatives=True)
    assert found.lost.tolist() == [True, True, False, False]
    assert np.isfinite(found.jacobian).all()
    assert np.isfinite(found.residuals).all()
    assert found.jacobian[found.of_row > 1].any()
    assert not found.jacobian[found.of_row < 2].any()
