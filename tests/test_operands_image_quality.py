"""Operands of image quality: against the analyses of the same lens, and finite differences with lost rays."""

import itertools
import json

import numpy as np
import pytest
import torch
from differences import slopes_by_differences
from problems import values, vector, vignetting_aperture

import raytrace as rt
from raytrace.io import LensFileWarning
from raytrace.maths.sampling import gauss_rings, square
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.operands.operand import BadRow, Measure
from raytrace.optimization.variables import DesignVariables
from raytrace.system.optimization_data import Row, Solve, Vary
from raytrace.tracing.scene import scene
from raytrace.tracing.spot import image_rays, spot_of, spot_of_points
from raytrace.tracing.wavefront import rms, wavefront_of, without

FIELD = (0.0, 0.7)


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
    chief = image_rays(lens, torch.zeros(2, 1).double(), fields=at(lens)).position[
        :2, 0, lens.primary_wavelength - 1, 0
    ]
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


def test_a_rectangular_grid_counts_unvignetted_rays():
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
    with pytest.raises(BadRow, match=r"row 1 .*RSCE .*1 ring or more"):
        values(rt.read_lens("singlet"), [Row("RSCE", (0, 1))])


VARIABLES = (Vary(1, "curvature"), Vary(4, "thickness"), Vary(6, "curvature"), Vary(6, "thickness"))


@pytest.mark.parametrize("target", [0.0, 0.5])
@pytest.mark.parametrize("operand", ["RSCE", "RSCH", "RWCE", "RWCH", "RSRE", "RSRH", "RWRE", "RWRH"])
def test_derivatives_of_rms(operand, target):
    """With a target of 0 the row is a vector: JᵀJ is not compared, but Jᵀr, the slope of the row's square."""
    model = DesignVariables(clipped(0.7), VARIABLES)
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
    model = DesignVariables(lens, (Vary(1, "curvature"), Vary(2, "thickness")))
    found = Evaluation(model, asked)(model.start, derivatives=True)
    assert found.lost.tolist() == [True, True, False, False]
    assert np.isfinite(found.jacobian).all()
    assert np.isfinite(found.residuals).all()
    assert found.jacobian[found.of_row > 1].any()
    assert not found.jacobian[found.of_row < 2].any()


# -- modulation --------------------------------------------------------------------------------------------------------

SECTIONS = {"T": (1.0, 0.0), "S": (0.0, 1.0), "A": (0.5, 0.5)}
SHARP = "telephoto"


def in_columns(operand: str, *, wavelength=0, field=1, frequency=20.0, sampling=2, plain=0.0, weight=1.0) -> Row:
    return Row(operand, (sampling, wavelength), (field, frequency, plain, 0.0), weight=weight)


@pytest.mark.parametrize("name", ["cooke_triplet", pytest.param("double_gauss_28deg", marks=pytest.mark.slow)])
def test_modulation_is_that_of_the_analysis(name):
    """To what a grid of 128 points leaves, the least that the analysis takes; rays to what rings leave."""
    lens = rt.read_lens(name)
    last, frequencies = len(lens.fields.x), [15.0, 30.0]
    for prefix, geometric in (("MTF", False), ("GMT", True)):
        expected = rt.mtf(lens, frequencies, geometric=geometric)
        cases = list(itertools.product(SECTIONS, (1, last), range(len(frequencies))))
        asked = [
            in_columns(prefix + section, field=field, frequency=frequencies[k], plain=1.0, sampling=3)
            for section, field, k in cases
        ]
        for found, (section, field, k) in zip(values(lens, asked), cases, strict=True):
            both = expected.tangential[field - 1, k], expected.sagittal[field - 1, k]
            wanted = sum(share * float(one) for share, one in zip(SECTIONS[section], both, strict=True))
            assert found == pytest.approx(wanted, abs=1e-3)


def test_one_wavelength_is_that_one_alone():
    """The analysis makes it the primary one, whose entrance pupil the rays are then aimed at: 1e-5 of its place."""
    lens = rt.read_lens("cooke_triplet")
    asked = [in_columns(name, wavelength=3, field=2, plain=1.0, sampling=3) for name in ("MTFT", "GMTT")]
    how = {"fields": [float(lens.fields.y[1])], "wavelengths": [float(lens.wavelengths[2])]}
    expected = [float(rt.mtf(lens, [20.0], geometric=g, **how).tangential[0, 0]) for g in (False, True)]
    assert np.abs(values(lens, asked) - expected).max() < 1e-3
    assert np.abs(values(lens, [in_columns("MTFT", field=2), in_columns("GMTT", field=2)]) - expected).min() > 1e-2


def test_rays_are_scaled_by_a_perfect_lens_by_default():
    lens = rt.read_lens("cooke_triplet")
    scaled, plain = values(lens, [in_columns("GMTS", plain=p) for p in (0.0, 1.0)])
    # Of a clear circle on the axis, as OpticStudio scales; `limit` is of the real pupil, by another sum.
    assert scaled / plain == pytest.approx(float(rt.mtf(lens, [20.0]).limit[0, 0, 0]), rel=1e-3)


def test_strehl_is_that_of_the_wavefront_map():
    lens = rt.read_lens(SHARP)
    expected = rt.wavefront(lens, size=9).strehl
    share = lens.wavelength_weights / lens.wavelength_weights.sum()
    found = values(lens, [Row("STRH", (1, w), (1, 0, 0, 0)) for w in (0, 1)])
    assert found[0] == pytest.approx(float((share * expected[0]).sum()), rel=1e-9)
    assert found[1] == pytest.approx(float(expected[0, 0]), rel=1e-9)


@pytest.mark.parametrize("operand", ["MTFT", "MTFS", "MTFA", "GMTT", "GMTS", "GMTA", "STRH"])
def test_derivatives_of_modulation(operand):
    """Those of the Strehl ratio hold the best point of the image where it was, which no first derivative feels."""
    lens = clipped(0.9) if operand != "STRH" else rt.read_lens(SHARP)
    model = DesignVariables(lens, (Vary(1, "curvature"), Vary(len(lens.surfaces) - 2, "thickness")))
    asked = [
        in_columns(operand, field=f, wavelength=w)
        for f, w in ((1, 2 if operand != "STRH" else 1), (len(lens.fields.x), 1))
    ]
    evaluation = Evaluation(model, asked)
    found = evaluation(model.start, derivatives=True)
    expected = slopes_by_differences(evaluation, model.start, 1e-6)
    difference = np.abs(found.jacobian / evaluation.factors[:, None] - expected)
    assert (difference < 1e-5 * np.abs(expected).max(1, keepdims=True)).all()


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (in_columns("MTFT", field=7), "names field 7: this lens has fields 1 to 3"),
        (in_columns("MTFT", frequency=0.0), "has the frequency 0"),
        (in_columns("GMTA", sampling=0), "has the sampling 0: expected 1 to 6"),
        (in_columns("STRH", field=1.5), "names field 1.5"),
        (in_columns("MTFS", wavelength=4), r"names wavelength 4: .* wavelengths 0 to 3 \(0: all by their weights\)"),
        (in_columns("RSCE", wavelength=4), "names wavelength 4"),
    ],
)
def test_arguments_that_name_nothing(row, words):
    with pytest.raises(BadRow, match=f"row 1 .*{row.operand} {words}"):
        values(rt.read_lens("cooke_triplet"), [row])


# -- any function of a lens --------------------------------------------------------------------------------------------


def spot_sizes(lens: rt.Lens) -> torch.Tensor:
    """RMS radii (F,) mm at the first wavelength."""
    return rt.spot(lens, rings=4).rms_radius[:, 0]


def sharpness(lens: rt.Lens) -> torch.Tensor:
    """Σ h² of the kernel of waves: of every pixel the light that falls together."""
    kernel = rt.psf(lens, model="wave", fields=[0.0], pixel=0.002, size=15).kernel
    return (kernel * kernel).sum()


def seen(lens: rt.Lens) -> torch.Tensor:
    """RMS contrast of a blurred edge against the sharp one."""
    edge = torch.zeros(1, 32, 32, dtype=torch.float64)
    edge[..., 16:] = 1.0
    kernel = rt.psf(lens, model="gaussian", fields=[0.0], pixel=0.01, size=11).kernel
    blurred = torch.nn.functional.conv2d(edge[None], kernel[:1, :1], padding=5)
    return (blurred - edge).square().mean().sqrt()


FUNCTIONS = {"spots": spot_sizes, "psf": sharpness, "image": seen}


@pytest.mark.parametrize("name", ["spots", pytest.param("psf", marks=pytest.mark.slow), "image"])
def test_any_function_of_a_lens_is_a_row(name):
    """A spot, a kernel of waves, a blurred picture: value and derivatives, solves and pickups among the numbers."""
    lens, function = rt.read_lens("cooke_triplet"), FUNCTIONS[name]
    last = len(lens.surfaces) - 2
    solves = (Solve(3, "curvature", "pickup", source=1, scale=-1.0),)
    model = DesignVariables(lens, (Vary(1, "curvature"), Vary(last, "thickness")), solves)
    asked = [Row(Measure(name, function), target=0.1, weight=2.0), Row(function, weight=1.0), Row("EFFL", weight=1.0)]
    evaluation = Evaluation(model, asked)
    found = evaluation(model.start, derivatives=True)
    number = float(torch.linalg.vector_norm(function(model.lens_at(model.start))))
    assert found.values[:2] == pytest.approx([number, number], rel=1e-12)
    expected = slopes_by_differences(evaluation, model.start, 1e-6)
    row = found.of_row == 0
    by = expected[0] * evaluation.factors[0]
    assert np.abs(found.jacobian[row] - by).max() < 1e-5 * np.abs(by).max()
    row = found.of_row == 1
    slope = found.jacobian[row].T @ found.residuals[row]
    by = expected[1] * evaluation.factors[1] ** 2 * number
    assert row.sum() == (3 if name == "spots" else 1)
    assert np.abs(slope - by).max() < 1e-5 * np.abs(by).max()


def test_a_function_sees_the_apertures_and_its_configuration():
    lens, seen = clipped(0.5), []

    def rays(lens: rt.Lens) -> torch.Tensor:
        seen.append(sum(len(surface.apertures) for surface in lens.surfaces))
        return image_rays(lens, square(9)[0], fields=at(lens)).valid.sum().double()

    found = values(lens, [Row(rays, weight=1.0)])
    assert seen[0] == 1
    assert found[0] == float(image_rays(lens, square(9)[0], fields=at(lens)).valid.sum())


def test_lengths_of_a_measure_are_in_the_unit_of_the_rows():
    lens = rt.read_lens("cooke_triplet")
    first = Measure("first spot", lambda lens: spot_sizes(lens)[0], length=1)
    row = Row(first, weight=1.0)
    assert str(first) == "first spot"
    assert values(lens, [row], unit=25.4)[0] == pytest.approx(values(lens, [row])[0] / 25.4, rel=1e-14)


def test_a_function_that_has_no_number_at_first_is_an_error_and_later_a_lost_row():
    lens = rt.read_lens("cooke_triplet")
    model = DesignVariables(lens, (Vary(len(lens.surfaces) - 2, "thickness"),))

    def near(lens: rt.Lens) -> torch.Tensor:
        if float(lens.surfaces[-2].thickness.detach()) > 60.0:
            raise ValueError("too far away")
        return lens.surfaces[-2].thickness

    evaluation = Evaluation(model, [Row(near, weight=1.0)])
    with pytest.raises(BadRow, match=r"row 1 .*near.* too far away"):
        evaluation(np.array([61.0]))
    assert evaluation(np.array([50.0]), derivatives=True).jacobian.tolist() == [[1.0]]
    found = evaluation(np.array([61.0]), derivatives=True)
    assert found.lost.all()
    assert not found.jacobian.any()


def test_a_function_that_gives_no_numbers_is_refused():
    with pytest.raises(TypeError, match=r"row 1 .*\[2, 2\], expected .*\(k,\)"):
        values(rt.read_lens("cooke_triplet"), [Row(lambda lens: torch.ones(2, 2), weight=1.0)])


@pytest.mark.slow
def test_an_optimisation_follows_a_function_of_the_lens(tmp_path):
    """Its row has a name in every result; in a lens file a text replaces it, with a warning."""
    lens = rt.read_lens("cooke_triplet")
    found = rt.optimize(
        lens, merit=[rt.system.Row(sharpness, target=1.0, weight=1.0)], vary=[rt.system.Vary(6, "thickness")], cycles=2
    )
    assert found.merit_after < 0.999 * found.merit_before
    document = json.loads(json.dumps(found.document()))["operands"][0]
    assert document["operand"] == "sharpness"
    assert document["after"] == pytest.approx(float(sharpness(found.lens)), rel=1e-9)
    assert "sharpness" in str(found)
    with pytest.warns(LensFileWarning, match="the optimisation data"):
        rt.write_lens(found.lens, tmp_path / "found.zmx")
    row = rt.read_lens(tmp_path / "found.zmx").optimization_data.merit[0]
    assert (row.operand, row.text) == ("BLNK", "sharpness: a function of the lens, target 1, weight 1")


def test_a_lens_too_blurred_for_the_mtf_is_nan_where_an_earlier_one_has_it():
    lens = rt.read_lens("double_gauss")
    row = Row("MTFA", (1, 0), (1.0, 40.0, 0.0, 0.0), weight=1.0)
    evaluation = Evaluation(DesignVariables(lens, (Vary(11, "thickness"),)), [row])
    assert 0 < evaluation(np.array([57.3])).values[0] < 1
    assert np.isnan(evaluation(np.array([90.0])).values[0])
