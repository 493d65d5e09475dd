"""`raytrace render`: the written pictures are those of the library, every option once, and what is refused."""

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import raytrace as rt
from raytrace.imaging import render
from raytrace.imaging.image import encoded
from raytrace.imaging.render import default_sensor
from raytrace.io.pictures import PictureError, read_channels, read_depth, read_levels
from raytrace.system.identity import digest
from raytrace.system.lens import field_points

COLUMNS, ROWS = 60, 40
LENS = "cemented_achromat"
#: A coarse grid of kernels on a small sensor.
QUICK = ("--sensor", "6x4", "--tol", "0.3", "--model", "gaussian")


@pytest.fixture(scope="module", autouse=True)
def _optics_once():
    """A lens and the geometry of a sensor are prepared once for all tests, which takes longer than a picture."""
    prepare, known = render.optics, {}

    def prepared(lens, sensor, **how):
        noiseless = dataclasses.replace(
            sensor, mosaic="none", full_well=None, read_noise=0.0, bits=None, black_level=None
        )
        key = digest(lens, noiseless, sorted(how.items()))
        if key not in known:
            known[key] = prepare(lens, noiseless, **how)
        return dataclasses.replace(known[key], sensor=sensor)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render, "optics", prepared)
        yield


def levels(*shape, most=256, seed=0):
    return np.random.default_rng(seed).integers(0, most, shape)


@pytest.fixture
def photo(command):
    """A coloured picture of 8 bits in the working folder: its name and its levels (3, H, W)."""
    values = levels(ROWS, COLUMNS, 3).astype(np.uint8)
    Image.fromarray(values).save("photo.png")
    return "photo.png", torch.as_tensor(values).movedim(-1, 0)


def sensor(lens=LENS, response="rgb", **others):
    picture = torch.zeros(1 if response is None else 3, ROWS, COLUMNS)
    return default_sensor(rt.read_lens(lens), picture, **{"size": (6, 4), "response": response, **others})


def rendered(picture, lens=LENS, *, camera=None, seed=0, index=0, **options):
    with torch.no_grad():
        one = rt.render(lens, picture, sensor=camera or sensor(), **{"tol": 0.3, "model": "gaussian", **options})
    return one.demosaiced(index, seed).image


def written(path="out.png"):
    """Levels (C, H, W) of a written picture."""
    values = np.asarray(Image.open(path))
    assert values.dtype == np.uint8
    return np.atleast_3d(values).transpose(2, 0, 1)


def assert_written(image, path="out.png"):
    assert np.abs(written(path) - 255 * encoded(image).numpy()).max() < 0.501  # ties round either way


# -- the written picture is that of the library


def test_the_written_picture_is_the_rendering_to_8_bits(command, photo):
    code, out, err = command("render", LENS, photo[0], *QUICK, "-o", "out.png")
    assert code == 0, err
    assert "written: out.png" in err
    assert out.startswith("60 × 40 pixels of 100 µm, r, g, b\n")
    assert_written(rendered(photo[1]))


@pytest.mark.slow
def test_without_a_size_the_largest_field_lies_in_the_corners(command, photo):
    code, out, err = command("render", LENS, photo[0], *QUICK[2:], "-o", "out.png", "--json")
    assert code == 0, err
    size = json.loads(out)["pictures"][0]["sensor"]["size"]
    camera, lens = sensor(size=size), rt.read_lens(LENS)
    reach = camera.landing(lens, field_points(None, like=lens)).norm(dim=0).max()
    assert camera.half_diagonal == pytest.approx(float(reach), rel=1e-9)
    assert_written(rendered(photo[1], camera=camera))


@pytest.mark.parametrize(
    ("words", "options"),
    [
        (("--no-distortion", "--model", "drt"), {"distortion": False, "model": "drt"}),
        (("--no-illumination", "--boundary", "zero"), {"illumination": False, "boundary": "zero"}),
        (("--no-lateral-colour",), {"lateral_colour": False}),
    ],
    ids=" ".join,
)
def test_effects_are_left_out(command, photo, words, options):
    code, _, err = command("render", LENS, photo[0], *QUICK, *words, "-o", "out.png")
    assert code == 0, err
    assert_written(rendered(photo[1], **options))


@pytest.mark.slow
def test_conditions_are_those_of_other_commands(command, photo):
    words = ("--f-number", 8, "--wavelength", 0.53, 0.46, 0.61, "--object-distance", 2000)
    code, _, err = command("render", LENS, photo[0], *QUICK, *words, "-o", "out.png")
    assert code == 0, err
    lens = rt.read_lens(LENS).at(f_number=8, wavelengths=[0.53, 0.46, 0.61], object_distance=2000.0)
    assert_written(rendered(photo[1], lens, wavelengths=lens.wavelengths))


@pytest.mark.slow
def test_several_object_distances_are_a_picture_each(command, photo):
    code, out, err = command(
        "render", LENS, photo[0], *QUICK, "--object-distance", 900, "inf", "-o", "out.png", "--json"
    )
    assert code == 0, err
    found = json.loads(out)["results_by_object_distance"]
    assert [one["pictures"][0]["written"] for one in found] == ["out_900mm.png", "out_infinity.png"]
    assert_written(rendered(photo[1], rt.read_lens(LENS).at(object_distance=900.0)), "out_900mm.png")


# -- the sensor


def test_noise_and_mosaic_are_those_of_the_sensor(command, photo):
    words = ("--mosaic", "GRBG", "--full-well", 500, "--read-noise", 4, "--bits", 6, "--seed", 7, "--offset", 0.2, -0.1)
    code, _, err = command("render", LENS, photo[0], *QUICK, *words, "-o", "out.png")
    assert code == 0, err
    camera = sensor(mosaic="GRBG", full_well=500, read_noise=4, bits=6, offset=(0.2, -0.1))
    assert_written(rendered(photo[1], camera=camera, seed=7))
    other = written()
    assert command("render", LENS, photo[0], *QUICK, *words, "--seed", 8, "-o", "out.png")[0] == 0
    assert (written() != other).mean() > 0.3


@pytest.mark.slow
def test_responses(command, photo):
    Path("camera.csv").write_text("wavelength_nm,r,g,b\n400,0,0,1\n500,0,1,1\n600,1,1,0\n700,1,0,0\n")
    assert command("render", LENS, photo[0], *QUICK, "--response", "camera.csv", "-o", "out.png")[0] == 0
    assert_written(rendered(photo[1], camera=sensor(response="camera.csv")))
    assert command("render", LENS, photo[0], *QUICK, "--response", "grey", "-o", "grey.png")[0] == 0
    luma = torch.as_tensor(read_levels(photo[0], 1))
    assert_written(rendered(luma, camera=sensor(response=None)), "grey.png")


@pytest.mark.parametrize("kind", ["png", "tif"])
def test_grey_pictures_of_16_bits_keep_them(command, kind):
    values = levels(ROWS, COLUMNS, most=2**16).astype(np.uint16)
    Image.fromarray(values).save(f"deep.{kind}")
    np.testing.assert_array_equal(read_levels(f"deep.{kind}"), values[None])
    np.testing.assert_allclose(read_channels(f"deep.{kind}", 1), values[None] / 65535, atol=0.51 / 255)
    code, _, err = command("render", LENS, f"deep.{kind}", *QUICK, "-o", "out.png")
    assert code == 0, err
    assert_written(rendered(torch.as_tensor(values), camera=sensor(response=None)))


# -- depth


@pytest.mark.parametrize(
    "words",
    [pytest.param(("map.npy",), marks=pytest.mark.slow), ("map.png", "--depth-range", 800, 5000)],
    ids=["array", "picture"],
)
def test_a_depth_map_is_an_array_or_a_grey_picture(command, photo, words):
    map_ = np.where(np.arange(COLUMNS) < 30, 0, 255).astype(np.uint8) * np.ones((ROWS, 1), np.uint8)
    Image.fromarray(map_).save("map.png")
    distances = np.where(map_ == 0, 800.0, 5000.0)  # dark is near
    np.testing.assert_array_equal(read_depth("map.png", (800, 5000)), distances)
    np.save("map.npy", distances)
    code, _, err = command("render", LENS, photo[0], *QUICK, "--planes", 2, "-o", "out.png", "--depth", *words)
    assert code == 0, err
    assert_written(rendered(photo[1], depth=torch.as_tensor(distances), planes=2))


# -- several pictures, figures


@pytest.mark.slow
def test_several_pictures_go_to_a_folder_and_share_the_kernels(command, photo, monkeypatch):
    small = levels(20, 30, 3, seed=1).astype(np.uint8)
    Image.fromarray(small).save("small.png")
    Image.fromarray(photo[1].movedim(0, -1).numpy()[::-1].copy()).save("other.png")
    calls = []
    verb = rt.render

    @functools.wraps(verb)
    def counted(*given, **options):
        calls.append(options["sensor"].pixels)
        return verb(*given, **options)

    monkeypatch.setattr(rt, "render", counted)
    words = ("--full-well", 1000, "-o", "folder", "--json", "--plot", "fig.png")
    code, out, err = command("render", LENS, photo[0], "other.png", "small.png", *QUICK, *words)
    assert code == 0, err
    assert calls == [(60, 40), (30, 20)]
    records = json.loads(out)["pictures"]
    assert [one["file"] for one in records] == ["photo.png", "other.png", "small.png"]
    assert [one["written"] for one in records] == [f"folder/{name}.png" for name in ("photo", "other", "small")]
    camera = sensor(full_well=1000)
    assert_written(rendered(photo[1], camera=camera), "folder/photo.png")
    assert_written(rendered(photo[1].flip(-2), camera=camera, index=1), "folder/other.png")
    assert sorted(path.name for path in Path().glob("fig*")) == ["fig_other.png", "fig_photo.png", "fig_small.png"]


@pytest.mark.slow
def test_the_figure_is_saved_as_a_comparison_too(command, photo):
    assert command("render", LENS, photo[0], *QUICK, "--compare", "fig.pdf")[0] == 0
    assert Path("fig.pdf").read_bytes().startswith(b"%PDF")


def test_the_figure_shows_details_at_their_places_and_the_kernels_there():
    picture = torch.as_tensor(levels(ROWS, COLUMNS, 3).astype(np.uint8)).movedim(-1, 0)
    with torch.no_grad():
        rendering = rt.render(rt.read_lens(LENS), picture, sensor=sensor(), tol=0.3)
    shown = [panel.images[0].get_array() for panel in rendering.plot().axes]
    image, ideal = (np.moveaxis(encoded(one).numpy(), 0, -1) for one in (rendering.image, rendering.picture))
    centre, corner = (slice(13, 27), slice(23, 37)), (slice(0, 14), slice(0, 14))
    expected = [ideal, image, ideal[centre], image[centre], None, ideal[corner], image[corner], None]
    assert len(shown) == len(expected)
    for found, one in zip(shown, expected, strict=True):
        if one is None:
            assert found.shape[0] == rendering.optics.kernels.shape[-2]
            assert float(found.max()) == pytest.approx(1.0)
        else:
            np.testing.assert_allclose(found, one, atol=1e-6)


@pytest.mark.slow
def test_the_window_of_the_kernels(command, photo):
    assert command("render", LENS, photo[0], *QUICK, "--size", 31, "-o", "out.png")[0] == 0
    assert_written(rendered(photo[1], size=31))


def test_light_and_raw_pictures(command, photo):
    """16 bits, floating-point numbers, and the mosaic before its colours are interpolated."""
    assert command("render", LENS, photo[0], *QUICK, "-o", "out.png", "--png-bits", 16)[0] == 0
    image = rendered(photo[1])
    assert np.abs(read_levels("out.png") - 65535 * encoded(image).numpy()).max() < 0.51
    for name in ("out.tif", "out.npy"):
        assert command("render", LENS, photo[0], *QUICK, "-o", name)[0] == 0
    np.testing.assert_allclose(read_levels("out.tif"), image.numpy(), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(np.load("out.npy"), image.numpy())
    words = ("--mosaic", "RGGB", "--full-well", 500, "--raw")
    assert command("render", LENS, photo[0], *QUICK, *words, "-o", "raw.npy")[0] == 0
    camera = sensor(mosaic="RGGB", full_well=500)
    with torch.no_grad():
        raw = rt.render(rt.read_lens(LENS), photo[1], sensor=camera, tol=0.3, model="gaussian").raw(0).image
    np.testing.assert_array_equal(np.load("raw.npy"), raw.numpy())
    code, _, err = command("render", LENS, photo[0], *QUICK, *words, "-o", "raw.png")
    assert code == 1
    assert "--raw writes light" in err


def test_a_picture_of_one_pixel(command):
    Image.new("L", (1, 1), 255).save("white.png")
    code, out, err = command("render", LENS, "white.png", "--sensor", "0.05x0.05", *QUICK[2:], "-o", "out.png")
    assert code == 0, err
    assert "distortion" not in out
    assert written().tolist() == [[[255]]]


# -- what is refused


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("none.png", "-o", "out.png"), "none.png: cannot be read as a picture (No such file or directory)"),
        (("text.png", "-o", "out.png"), "text.png: cannot be read as a picture"),
        (("photo.png", "text.png", "-o", "folder"), "text.png: cannot be read as a picture"),
        (("photo.png", "photo.png", "-o", "out.png"), "-o out.png: 2 pictures; expected the name of a folder"),
        (("photo.png", "photo.png", "-o", "folder"), "several pictures would be photo.png there"),
        (("photo.png", "-o", "photo.png"), "is the file of PICTURE too"),
        (("photo.png", "-o", "."), "photo.png is a picture to render"),
        (("photo.png", "-o", "no/out.png"), "cannot be written: the folder"),
        (("photo.png", "--sensor", "6x5"), "photo.png: pixels of 100 × 125 µm: expected square ones"),
        (("photo.png", "--response", "red"), "response 'red'"),
        (("photo.png", "--response", "grey", "--mosaic", "RGGB"), "expected three, red, green and blue"),
        (("photo.png", "--read-noise", "2"), "fraction of level 1"),
        (("photo.png", "--depth", "text.png"), "text.png: a picture has levels and no distances; give --depth-range"),
        (("photo.png", "--depth", "text.npy"), "text.npy: cannot be read as an array"),
        (("photo.png", "--depth", "small.npy"), "small.npy: a depth map of 3 × 2 pixels; expected 60 × 40, those of"),
        (("photo.png", "--depth", "zero.npy"), "zero.npy: a depth map with nan, zero or negative numbers"),
        (("photo.png", "--depth", "zero.npy", "--depth-range", "1", "2"), "needs no --depth-range"),
        (("photo.png", "--depth", "photo.png", "--depth-range", "5", "2"), "expected 0 < near < far"),
        (("photo.png", "--depth-range", "1", "2"), "give the map"),
        (("photo.png", "--wavelength", "0.9"), "no response at the wavelengths 0.9"),
        (("photo.png", "--sensor", "600x400", "-o", "out.png"), "cemented_achromat: "),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_bad_input_is_one_line(command, photo, words, message):
    Path("text.png").write_text("no picture")
    Path("text.npy").write_text("no array")
    np.save("small.npy", np.ones((2, 3)))
    np.save("zero.npy", np.zeros((ROWS, COLUMNS)))
    before = sorted(Path().rglob("*"))
    code, out, err = command("render", LENS, *words)
    assert (code, out) == (1, "")
    assert err.splitlines()[-1].startswith("raytrace: error: ")
    assert message in err.splitlines()[-1]
    assert sorted(Path().rglob("*")) == before


@pytest.mark.parametrize(
    "words",
    [
        ("--sensor", "6"), ("--sensor", "0x4"), ("--distortion",), ("--bits", "0"), ("--model", "auto"),
        ("--black-level", "-1"), ("--png-bits", "12"),
        ("-o", "out.jpg"), ("--mosaic", "RGB"), ("--boundary", "taper"), ("--depth-range", "1"),
    ],
    ids=" ".join,
)  # fmt: skip
def test_bad_usage_is_one_line(command, photo, words):
    code, out, err = command("render", LENS, photo[0], *words)
    assert (code, out, err.count("\n")) == (2, "", 1)


def test_colours_of_16_bits_and_wrong_channels(tmp_path):
    Image.new("L", (2, 2)).save(tmp_path / "a.png")
    with pytest.raises(PictureError, match="1 or 3 channels, not 2"):
        read_levels(tmp_path / "a.png", 2)
    Image.fromarray(np.full((2, 2), 70000, np.int32)).save(tmp_path / "b.tif")
    with pytest.raises(PictureError, match="70000; expected 8 or 16 bits"):
        read_levels(tmp_path / "b.tif")
