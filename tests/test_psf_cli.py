"""`raytrace psf`: its fixed form, its JSON and its arrays."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from raytrace import read_lens
from raytrace.cli import main
from raytrace.psf_models import psf

LENS = str(Path(__file__).parents[1] / "lenses" / "double_gauss.zmx")
FORM = ["psf", LENS, "--model", "gaussian", "--object-distance", "10000", "30000", "--field", "0", "2"]
FORM += ["--pixel", "0.005", "--size", "21", "--sensor-distance", "57.88", "--f-number", "4", "--tol", "1e-3"]
KEYS = {"object_distance", "field", "centroid", "covariance", "energy", "error", "rays"}


def test_json_is_one_document_distance_major_without_other_output(capsys):
    assert main([*FORM, "--json"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    results = json.loads(said.out)["results"]
    assert [entry["object_distance"] for entry in results] == [1e4, 1e4, 3e4, 3e4]
    assert [entry["field"] for entry in results] == [[0.0, 0.0], [0.0, 2.0]] * 2
    for entry in results:
        assert set(entry) >= KEYS
        (xx, xy), (yx, yy) = entry["covariance"]
        assert xy == yx
        assert xx > 0 < yy
        assert 0 < entry["error"] <= 1e-3
    # The blur of an ideal disc of the same defocus, 2σ = ε, to the aberrations at F/4.
    assert 0.8 < results[0]["energy"] < 1
    assert results[0]["covariance"][0][0] ** 0.5 == pytest.approx(0.6 / 8 / 2, rel=0.25)
    assert results[1]["centroid"][1] == pytest.approx(99.5145 * math.tan(math.radians(2.0)), rel=0.01)


def test_arrays_are_those_of_the_json(tmp_path, capsys):
    out, picture = tmp_path / "psf.npz", tmp_path / "psf.png"
    assert main([*FORM, "--center", "chief", "--json", "-o", str(out), "--plot", str(picture)]) == 0
    said = capsys.readouterr()
    results = json.loads(said.out)["results"]
    assert str(out) in said.err
    assert picture.read_bytes()[:4] == b"\x89PNG"
    with np.load(out) as arrays:
        assert arrays["psf"].shape == (2, 2, 21, 21)
        assert float(arrays["pixel_pitch"]) == 0.005
        assert arrays["energy"].flatten().tolist() == [entry["energy"] for entry in results]
        assert arrays["error"].flatten().tolist() == [entry["error"] for entry in results]
        assert str(arrays["model"]) == "gaussian"
        np.testing.assert_allclose(arrays["psf"].sum((-2, -1)), arrays["energy"], atol=1e-12)


def test_default_window_is_centred_on_the_axis_with_a_pixel_at_its_centre(tmp_path):
    out = tmp_path / "psf.npz"
    assert main(["psf", LENS, "--model", "gaussian", "--object-distance", "10000", "--field", "0", "-o", str(out)]) == 0
    with np.load(out) as arrays:
        kernel = arrays["psf"][0, 0]
        assert kernel.shape == (21, 21)
        assert arrays["centre"].tolist() == [0.0, 0.0]
        assert np.unravel_index(kernel.argmax(), kernel.shape) == (10, 10)
        np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-12)


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--tol", "0.1", "--rays", "5"], 2, "not allowed with"),
        (["--model", "geometric"], 2, "invalid choice"),
        (["--model", "auto", "--rays", "5"], 1, "auto chooses by a tolerance"),
        (["--model", "paraxial", "--rays", "5"], 1, "traces no rays"),
        (["--size", "0"], 2, "not above 0"),
        (["--size", "-3"], 2, "not above 0"),
        (["--size", "2.5"], 2, "--size"),
        (["--pixel", "-0.005"], 2, "--pixel"),
        (["--pixel", "nan"], 2, "--pixel"),
        (["--tol", "0"], 2, "--tol"),
        (["--rays", "0", "--model", "drt"], 2, "--rays"),
        (["--field", "one"], 2, "--field"),
        (["--field", "90"], 1, "below 90 degrees"),
        (["--object-distance", "0", "--model", "paraxial"], 2, "--object-distance"),
        (["--model", "paraxial", "--field", "0", "-o", "no/such/folder/psf.npz"], 1, "no/such/folder"),
        (["--model", "paraxial", "--field", "0", "--plot", "no/such/folder/psf.png"], 1, "no/such/folder"),
        (["--model", "paraxial", "--plot", "psf.bmp"], 2, ".png, .pdf, .svg"),
    ],
)
def test_invalid_options_are_refused_in_one_line(capsys, words, code, message):
    assert main(["psf", LENS, *words]) == code
    said = capsys.readouterr()
    assert said.out == ""
    assert message in said.err
    assert len(said.err.splitlines()) == 1


def test_an_even_window_has_the_axis_between_its_pixels(tmp_path):
    out = tmp_path / "psf.npz"
    words = ["--model", "gaussian", "--object-distance", "10000", "--size", "20", "-o", str(out)]
    assert main(["psf", LENS, *words]) == 0
    with np.load(out) as arrays:
        kernel = arrays["psf"][0, 0]
        assert kernel.shape == (20, 20)
        np.testing.assert_allclose(kernel, kernel[::-1, ::-1], atol=1e-12)
        assert kernel[9, 9] == pytest.approx(kernel.max(), rel=1e-12)
        assert kernel[10, 10] == pytest.approx(kernel.max(), rel=1e-12)


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--focus-distance", "10"], 1, "within the focal length"),
        (["--focus-distance", "-1"], 2, "--focus-distance"),
        (["--object-distance", "0"], 2, "--object-distance"),
        (["--start", "best"], 2, "invalid choice"),
    ],
)
def test_comparisons_that_make_no_sense_are_refused_in_one_line(capsys, words, code, message):
    assert main(["compare-models", LENS, *words]) == code
    said = capsys.readouterr()
    assert said.out == ""
    assert message in said.err
    assert len(said.err.splitlines()) == 1


def test_rho_scales_the_paraxial_blur(capsys):
    sigmas = []
    for rho in ("0.5", "0.3"):
        assert main(["psf", str(LENS), "--model", "paraxial", "--object-distance", "1e4", "--rho", rho, "--json"]) == 0
        result, *_ = json.loads(capsys.readouterr().out)["results"]
        sigmas.append(result["covariance"][0][0] ** 0.5)
    assert sigmas[1] / sigmas[0] == pytest.approx(0.6, rel=1e-12)


def test_without_fields_the_command_and_the_library_take_those_of_the_lens(tmp_path, capsys):
    out = tmp_path / "psf.npz"
    assert main(["psf", LENS, "--model", "gaussian", "--tol", "0.01", "-o", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    result = psf(read_lens(LENS), "gaussian", tol=0.01)
    assert [entry["field"] for entry in document["results"]] == [[0.0, 0.0], [0.0, 10.0], [0.0, 14.0]]
    with np.load(out) as arrays:
        np.testing.assert_array_equal(arrays["psf"], result.kernel.numpy())
        np.testing.assert_array_equal(arrays["centre"], result.grid.centre.numpy())


def test_the_printed_width_is_that_of_the_written_kernel(tmp_path, capsys):
    """The telescope's: diffraction a thousand times wider than its rays, which are named as such."""
    out = tmp_path / "psf.npz"
    words = ["psf", "hubble", "--field", "0", "-o", str(out)]
    assert main([*words, "--json"]) == 0
    (entry,) = json.loads(capsys.readouterr().out)["results"]
    with np.load(out) as arrays:
        kernel, pitch = arrays["psf"][0, 0], float(arrays["pixel_pitch"])
        np.testing.assert_allclose(arrays["covariance"][0, 0, 0], entry["covariance"][0][0])
        np.testing.assert_allclose(arrays["ray_covariance"][0, 0, 0], entry["ray_covariance"][0][0])
    x = pitch * (np.arange(21) - 10)
    variance = (kernel.sum(0) * x**2).sum() / kernel.sum() - pitch**2 / 12
    assert entry["covariance"][0][0] == pytest.approx(variance, rel=3e-3)
    assert entry["ray_covariance"][0][0] < 1e-6 * variance
    assert main(words) == 0
    text = capsys.readouterr().out
    assert f"{1000 * entry['covariance'][0][0] ** 0.5:.4f}" in text
    assert "rays' σ x" in text


def test_wavelengths_are_summed_or_keep_an_axis(tmp_path, capsys):
    out, words = tmp_path / "psf.npz", ["psf", "telephoto", "--model", "gaussian", "--tol", "1e-5"]
    words += ["--object-distance", "1e5", "inf"]
    assert main([*words, "--json", "-o", str(out)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["wavelengths"] == pytest.approx([0.4861327, 0.5875618, 0.6562725])
    assert document["wavelength_weights"] == pytest.approx([1 / 3] * 3)
    assert document["wavelengths_summed"] is True
    assert len(document["results"]) == 6
    with np.load(out) as arrays:
        summed, shares = arrays["psf"], arrays["wavelength_weights"]
        assert bool(arrays["wavelengths_summed"])
    assert main([*words, "--per-wavelength", "--json", "-o", str(out)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["wavelengths_summed"] is False
    assert [entry["wavelength"] for entry in document["results"]] == document["wavelengths"] * 6
    assert [entry["object_distance"] for entry in document["results"]] == [1e5] * 9 + [None] * 9
    with np.load(out) as arrays:
        assert arrays["psf"].shape == (2, 3, 3, 21, 21)
        assert not bool(arrays["wavelengths_summed"])
        np.testing.assert_allclose((shares[:, None, None] * arrays["psf"]).sum(2), summed, atol=1e-4)
        np.testing.assert_array_equal(arrays["energy"].ravel(), [entry["energy"] for entry in document["results"]])
    for more, said in (([], "summed over 0.486133, 0.587562, 0.656273 µm"), (["--per-wavelength"], "each of 0.486133")):
        assert main([*words, *more]) == 0
        assert said in capsys.readouterr().out


def test_kernels_that_miss_the_light_are_reported(capsys):
    assert main(["psf", LENS, "--model", "gaussian", "--field", "14", "--center", "axis"]) == 0
    assert "--center chief" in capsys.readouterr().out
    assert main(["psf", LENS, "--model", "gaussian", "--field", "14"]) == 0
    assert "--center chief" not in capsys.readouterr().out
