"""The models side by side: one sensor, kernels as `psf` gives them, and numbers that show what each can represent."""

import json
import math
import warnings
from pathlib import Path

import pytest
import torch
from problems import MICROMETRE, NANOMETRE

from raytrace import read_lens
from raytrace.analysis import compare_models as compare
from raytrace.cli import main
from raytrace.maths.sampling import gauss_rings, grid
from raytrace.psf_models import NotConverged, psf
from raytrace.system.lens import with_object_distance
from raytrace.tracing.spot import image_rays

LENSES = Path(__file__).parents[1] / "lenses"
ROWS = ("DRT", "Gaussian DRT", "paraxial", "Fourier", "wave")
SENSOR, RMS_SENSOR = 57.8817685, 57.662  # mm, of the double Gauss for an object at 25 m


def opened(name: str, focus_distance: float = 25_000.0, **options):
    return compare.common_focus(read_lens(LENSES / f"{name}.zmx"), focus_distance, wavelength=0.53, **options)


def compared(lens, *distances: float):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConverged)
        return compare.side_by_side(lens, lens.wavelengths.new_tensor(distances))


@pytest.fixture(scope="module")
def measured():
    """What the models can represent, of a lens that is quick to trace."""
    return compare.abilities(opened("singlet"))


@pytest.fixture
def able(measured):
    """The same by model and question."""
    frame = measured.to_frame()
    assert tuple(frame.model) == ROWS
    return frame.set_index("model")


def test_the_common_sensor_is_the_paraxial_image_or_the_least_rms_spot():
    lens = opened("double_gauss")
    assert float(lens.surfaces[-2].thickness) == pytest.approx(SENSOR, abs=0.1 * NANOMETRE)
    assert lens.wavelengths.tolist() == [0.53]
    assert float(lens.surfaces[0].thickness) == 25_000
    least = opened("double_gauss", start="rms")
    assert float(least.surfaces[-2].thickness) == pytest.approx(RMS_SENSOR, abs=0.1 * MICROMETRE)


def test_sensors_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="paraxial or rms"):
        opened("double_gauss", start="best")
    with pytest.raises(ValueError, match="within the focal length"):
        opened("double_gauss", 10.0)


def test_widths_are_those_of_rays_on_the_common_sensor():
    """σ of rays traced here by Gauss rings; ideal models instead have the uniform disc of the paraxial defocus. Waves
    follow these rays, but their kernels have a width of their own."""
    lens = opened("double_gauss")
    found = compared(lens, 20_000.0, 50_000.0)
    frame = found.to_frame()
    points, weights = gauss_rings(16)
    for d, distance in enumerate((20_000.0, 50_000.0)):
        x = image_rays(with_object_distance(lens, distance), points, fields=lens.wavelengths.new_zeros(2, 1)).position[
            0
        ]
        sigma = float((weights * x[0, 0] ** 2).sum().sqrt())
        # 256 Sobol points hold the mean square of a spot to 1e-3 of itself.
        for model, tolerance in (("DRT", 1e-3), ("Gaussian DRT", 1e-3)):
            assert float(found.sigma[ROWS.index(model), d]) == pytest.approx(sigma, rel=tolerance), model
        rays = found.psfs[-1].ray_covariance[:, d, 0]
        assert float((0.5 * (rays[0] + rays[2])).sqrt()) == pytest.approx(sigma, rel=1e-6)
        ideal = psf(lens, "paraxial", fields=lens.wavelengths.new_zeros(2, 1), object_distances=found.object_distances)
        assert torch.allclose(found.psfs[2].covariance, found.psfs[3].ray_covariance, rtol=1e-12, atol=0)
        for m in (3, 4):
            kernel = found.psfs[m].kernel[d, 0]
            x = 0.005 * (torch.arange(21, dtype=kernel.dtype) - 10)
            pixel = 0.005**2 / 12  # second moment of a pixel: the kernel's own less this is the width before pixels
            width = float(((kernel.sum(0) * x**2).sum() / kernel.sum() - pixel).sqrt())
            assert float(found.sigma[m, d]) == pytest.approx(width, rel=2e-3)
        assert float(found.sigma[2, d]) == pytest.approx(float(ideal.covariance[0, d, 0]) ** 0.5, rel=1e-12)
        row = frame[(frame.model == "wave") & (frame.object_distance == distance)]
        assert row.sigma_um.item() == 1e3 * float(found.sigma[4, d])
    assert len(frame) == 10


def test_differences_are_those_of_kernels_in_a_window_of_105_micrometres():
    lens = opened("singlet")
    found = compared(lens, 20_000.0)
    assert found.models == ROWS
    assert [tuple(one.kernel.shape) for one in found.psfs] == [(1, 1, 21, 21)] * 5
    assert [21 * float(one.grid.pitch) for one in found.psfs] == pytest.approx([0.105] * 5)
    pixels, axis = grid(lens.wavelengths.new_tensor(0.005), 21), lens.wavelengths.new_zeros(2, 1)
    gauss, wave = (
        psf(lens, name, fields=axis, object_distances=found.object_distances, grid=pixels, tol=1e-3).kernel
        for name in ("gaussian", "wave")
    )
    assert float(found.difference[1, 0]) == pytest.approx(float((gauss - wave).abs().sum() / wave.sum()), rel=1e-9)
    assert float(found.difference[-1, 0]) == 0
    assert found.psfs[0].rays == 256


def test_only_traced_models_see_aberrations(able):
    assert (able.conic[["paraxial", "Fourier"]] == 0).all()
    assert (able.conic[["DRT", "Gaussian DRT", "wave"]] > 0.01).all()


def test_only_traced_models_see_the_field_and_a_gaussian_no_coma(able):
    assert (able.anisotropy[["paraxial", "Fourier"]] == 1).all()
    assert (able.anisotropy[["DRT", "Gaussian DRT", "wave"]] > 1 + 1e-5).all()
    assert (able.asymmetry[["Gaussian DRT", "paraxial", "Fourier"]] < 1e-12).all()
    assert (able.asymmetry[["DRT", "wave"]] > 0.02).all()
    # Far above the wavelength rays and waves show the same coma.
    assert able.asymmetry["DRT"] == pytest.approx(able.asymmetry["wave"], rel=0.2)


def test_only_models_of_waves_have_the_dark_ring_of_airy(able):
    assert able.dark_ring[["DRT", "Gaussian DRT", "paraxial"]].isna().all()
    # A pixel of 1/24 of the radius and a parabola through three of them leave 0.5 %; aberrations at F/16 a few percent.
    assert able.dark_ring["Fourier"] == pytest.approx(1, abs=0.006)
    assert able.dark_ring["wave"] == pytest.approx(1, abs=0.04)


def test_parameters_are_those_with_a_derivative(able):
    """A singlet: object and sensor distance, thickness and curvatures; rays also see the conics."""
    surfaces = opened("singlet").surfaces[:-1]
    curved = sum(s.curvature is not None and float(s.curvature) != 0 for s in surfaces)
    assert (able.parameters[["paraxial", "Fourier"]] == len(surfaces) + curved).all()
    assert (able.parameters[["DRT", "Gaussian DRT", "wave"]] == len(surfaces) + 2 * curved).all()


def test_rays_are_counted(able):
    assert able.rays["DRT"] == 256
    assert (able.rays[["paraxial", "Fourier"]] == 0).all()
    assert 0 < able.rays["Gaussian DRT"] < able.rays["wave"]


def strict(text: str) -> dict:
    return json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))


def test_json_and_figure(capsys, tmp_path, monkeypatch, measured):
    monkeypatch.setattr(compare, "abilities", lambda lens, pixels: measured)  # seconds of work done above
    picture = tmp_path / "compare.png"
    words = ["compare-models", "singlet", "--object-distance", "20000", "inf", "--start", "rms", "--plot", str(picture)]
    assert main([*words, "--json"]) == 0
    said = capsys.readouterr()
    document = strict(said.out)
    assert set(document) == {"sensor_distance", "wavelength", "models"}
    expected = float(opened("singlet", start="rms").surfaces[-2].thickness)
    assert document["sensor_distance"] == pytest.approx(expected, rel=1e-12)
    assert document["wavelength"] == 0.53
    assert tuple(document["models"]) == ROWS
    for row in document["models"].values():
        assert {"conic", "anisotropy", "asymmetry", "dark_ring", "parameters", "rays", "difference"} < set(row)
        assert isinstance(row["rays"], int)
        assert len(row["difference"]) == 2
        assert [entry["object_distance"] for entry in row["results"]] == [20_000.0, None]
    assert document["models"]["DRT"]["dark_ring"] is None
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert str(picture) in said.err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "focus_distance"),
    [("double_gauss", 25_000.0), ("cooke_triplet", 25_000.0), ("phone", 25_000.0), ("hubble", math.inf)],
)
def test_every_number_means_something_on_other_lenses(name, focus_distance):
    """Also of a lens whose blur is far below a pixel, and of two mirrors around a hole."""
    lens = opened(name, focus_distance)
    frame = compare.abilities(lens).to_frame().set_index("model")
    traced, ideal = ["DRT", "Gaussian DRT", "wave"], ["paraxial", "Fourier"]
    assert (frame.conic[ideal] == 0).all()
    assert (frame.conic[traced] > 1e-3).all()
    assert (frame.anisotropy[ideal] == 1).all()
    assert (frame.anisotropy[traced] > 1.01).all()
    assert (frame.asymmetry[["DRT", "wave"]] > 0.01).all()
    assert frame.dark_ring[["DRT", "Gaussian DRT", "paraxial"]].isna().all()
    assert frame.dark_ring["Fourier"] == pytest.approx(1, abs=0.006)
    # A central obstruction of a third of the diameter pulls the first dark ring in by a tenth.
    assert frame.dark_ring["wave"] == pytest.approx(0.9 if name == "hubble" else 1, abs=0.02)
    assert frame.parameters[ideal].nunique() == frame.parameters[traced].nunique() == 1
    assert frame.parameters["wave"] > frame.parameters["Fourier"] > 0


@pytest.mark.slow
def test_rms_start_of_the_double_gauss(capsys):
    assert main(["compare-models", "double_gauss", "--start", "rms", "--object-distance", "25000", "--json"]) == 0
    assert strict(capsys.readouterr().out)["sensor_distance"] == pytest.approx(RMS_SENSOR, abs=0.1 * MICROMETRE)
