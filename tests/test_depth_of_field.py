"""Depth of field: a thin lens by its formulas, slow lenses by rays, and derivatives by differences."""

import json
import math

import pytest
import torch
from problems import scalar

import raytrace as rt
from raytrace.analysis.depth_of_field import QUARTER_WAVE
from raytrace.analysis.setting import NothingToShow
from raytrace.cli import main
from raytrace.system.lens import Lens

FOCAL, N, BLUR = 100.0, 200.0, 0.02
WAVE = 0.55


def thin(distance: float = math.inf, f_number: float = N, curvature=None) -> Lens:
    """A thin lens of FOCAL, its sensor in the paraxial focus of the object."""
    curvature = scalar(1 / FOCAL) if curvature is None else curvature
    rows = [dict(curvature=curvature, thickness=0.0, glass=1.5), dict(curvature=-curvature, thickness=FOCAL)]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=FOCAL / f_number, object_distance=distance, wavelengths=[WAVE])
    return lens.at(sensor_distance=1 / (1 / FOCAL - 1 / distance))


def limits(distance: float) -> tuple[float, float, float]:
    """Near and far limit and hyperfocal distance of a thin lens, from the lens: Greenleaf's formulas."""
    hyperfocal = FOCAL**2 / (N * BLUR) + FOCAL
    near = distance * (hyperfocal - FOCAL) / (hyperfocal + distance - 2 * FOCAL)
    far = distance * (hyperfocal - FOCAL) / (hyperfocal - distance)
    return near, far if far > 0 else math.inf, hyperfocal


@pytest.mark.parametrize("distance", [300.0, 1500.0, 5000.0])
def test_limits_of_a_thin_lens(distance):
    found = rt.depth_of_field(thin(distance), blur=BLUR)
    near, far, hyperfocal = limits(distance)
    assert float(found.paraxial_near) == pytest.approx(near, rel=1e-12)
    assert float(found.paraxial_far) == pytest.approx(far, rel=1e-12)
    assert float(found.paraxial_hyperfocal) == pytest.approx(hyperfocal, rel=1e-12)
    assert float(found.depth_of_focus) == pytest.approx(BLUR * N / (1 - FOCAL / distance), rel=1e-12)
    # Spherical aberration of F/200: 1 µm along the axis, of ± 4 mm.
    assert float(found.near) == pytest.approx(near, rel=3e-4)
    assert float(found.far) == pytest.approx(far, rel=3e-4)
    assert float(found.hyperfocal) == pytest.approx(hyperfocal, rel=1e-3)


def test_an_object_at_infinity_and_the_hyperfocal_distance():
    """Focused on infinity the near limit is the hyperfocal distance less f; focused there it is half of it."""
    found = rt.depth_of_field(thin(), blur=BLUR)
    hyperfocal = limits(1e9)[2]
    assert float(found.paraxial_near) == pytest.approx(hyperfocal - FOCAL, rel=1e-12)
    assert math.isinf(float(found.far))
    assert math.isinf(float(found.paraxial_far))
    assert float(found.near) == pytest.approx(hyperfocal - FOCAL, rel=1e-3)
    assert float(found.hyperfocal_near) == pytest.approx(hyperfocal / 2, rel=1e-3)
    there = rt.depth_of_field(thin(hyperfocal), blur=BLUR)
    assert float(there.paraxial_far) > 1e12
    assert float(there.paraxial_near) == pytest.approx(hyperfocal / 2, rel=1e-12)


def test_a_quarter_wave():
    """1/d = 1/s ± 2 λ/D²; the traced wavefront has the RMS of a parabola of λ/4."""
    distance, pupil = 3000.0, FOCAL / 40
    found = rt.depth_of_field(thin(distance, f_number=40))
    step = 2e-3 * WAVE / pupil**2
    assert (found.criterion, found.limit) == ("wavefront", QUARTER_WAVE)
    assert float(found.paraxial_near) == pytest.approx(1 / (1 / distance + step), rel=1e-12)
    assert float(found.near) == pytest.approx(float(found.paraxial_near), rel=1e-2)
    assert float(found.paraxial_hyperfocal) == pytest.approx(1 / step, rel=1e-12)
    assert float(found.hyperfocal) == pytest.approx(1 / step, rel=2e-2)


def test_modulation_falls_below_its_limit_at_both_ends():
    lens = thin(3000.0, f_number=10)
    found = rt.depth_of_field(lens, modulation=0.4, modulation_frequency=20)
    for end in (found.near, found.far):
        curves = rt.mtf(lens.at(object_distance=end[0]), [20], fields=[0])
        assert float(torch.minimum(curves.tangential, curves.sagittal)) == pytest.approx(0.4, abs=1e-8)
    assert float(found.near) < 3000 < float(found.far)


def test_distances_have_derivatives():
    """By the curvature of the lens, its sensor fixed, against central differences."""
    names = [
        *("near", "far", "hyperfocal", "hyperfocal_near"),
        *("paraxial_near", "paraxial_far", "paraxial_hyperfocal"),
    ]

    def values(curvature):
        lens = thin(3000.0, f_number=20, curvature=curvature).at(sensor_distance=103.3)
        found = rt.depth_of_field(lens, blur=0.05)
        return torch.stack([getattr(found, name).sum() for name in names])

    c = scalar(0.01).requires_grad_()
    slopes = [float(torch.autograd.grad(value, c, retain_graph=True)[0]) for value in values(c)]
    step = 1e-7
    with torch.no_grad():
        differences = (values(scalar(0.01 + step)) - values(scalar(0.01 - step))) / (2 * step)
    assert slopes == pytest.approx(differences.tolist(), rel=1e-5)


@pytest.mark.filterwarnings("ignore")
def test_the_blur_at_the_limits_of_a_real_lens_is_the_limit():
    lens = rt.read_lens("double_gauss").at(wavelengths=[0.5876], object_distance=3000.0)
    lens = rt.focus(lens).lens
    found = rt.depth_of_field(lens, blur=0.04, fields=[0, 8])
    for f, angle in enumerate(found.fields[1].tolist()):
        for end in (found.near[f], found.far[f]):
            spots = rt.spot(found.lens.at(object_distance=end, fields=[angle])).whole
            assert 2 * math.sqrt(2) * float(spots.rms_radius) == pytest.approx(0.04, rel=1e-8)


def test_what_cannot_be_is_refused():
    lens = thin(3000.0, f_number=40)
    with pytest.raises(ValueError, match="`blur` and `wavefront` exclude each other"):
        rt.depth_of_field(lens, blur=0.1, wavefront=0.1)
    with pytest.raises(ValueError, match="go together"):
        rt.depth_of_field(lens, modulation=0.3)
    with pytest.raises(ValueError, match="above 0 and below 1"):
        rt.depth_of_field(lens, modulation=1.3, modulation_frequency=20)
    with pytest.raises(NothingToShow, match="no field is sharp at any distance; the blur"):
        rt.depth_of_field(lens.at(entrance_pupil_diameter=40), blur=1e-3)


@pytest.mark.filterwarnings("ignore")
def test_the_command_prints_and_draws(capsys, tmp_path):
    arguments = ["depth-of-field", "cooke_triplet", "--blur", "0.1", "--plot", str(tmp_path / "depth.png"), "--json"]
    assert main(arguments) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["far_is_infinite"] == [True]
    assert document["results"][0]["far"] is None
    assert 0 < document["results"][0]["near"] < 1e6


def test_a_lens_out_of_focus_is_reported_with_the_way_to_focus_it():
    text = str(rt.depth_of_field(thin(3000.0).at(object_distance=1000.0), blur=0.02))
    assert "object distance      1000 mm" in text
    assert "object in focus" not in text
    assert "not sharp with the sensor where it is" in text
    assert "not sharp" not in str(rt.depth_of_field(thin(3000.0), blur=0.02))
