"""Height maps as files: they come back to the stated resolution, and what is no height map is refused by line."""

import io
import json
import struct
import zlib

import numpy as np
import pytest
import torch
from PIL import Image
from problems import number

from raytrace.materials.catalogs import find_glass
from raytrace.wave_optics.element import Element, EvenPowers, Pixels, Rings, fabricated_height, period
from raytrace.wave_optics.fabrication import as_pixels, fabricated, wrapped
from raytrace.wave_optics.height_maps import FORMATS, HeightMapError, read_heights, write_heights

EXACT = (".npy", ".csv")
PICTURES = (".png", ".tif", ".tiff")
GRIDS = (".dat", ".grd")
#: One wave of 550 nm in fused silica, mm.
WAVE = 1.195888e-3


def drawn(*shape, seed=0):
    return 1e-3 * torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 4e-4


def pixels(rows=7, columns=9, pitch=0.00369):
    return Pixels(drawn(rows, columns), number(pitch))


def rings(count=11, pitch=0.002):
    return Rings(drawn(count), number(pitch))


def there_and_back(profile, path, **known):
    write_heights(profile, path)
    result = read_heights(path, **known)
    assert type(result) is type(profile)
    assert result.heights.shape == profile.heights.shape
    return result


# -- round trips ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [*EXACT, *GRIDS])
@pytest.mark.parametrize("pitch", [0.002, 0.00369, 1 / 3e3])
def test_pixels_round_trip_bit_identically(suffix, pitch, tmp_path):
    written = pixels(pitch=pitch)
    result = there_and_back(written, tmp_path / f"map{suffix}")
    assert torch.equal(result.heights, written.heights)
    assert abs(float(result.pitch) / pitch - 1) < 1e-14  # a table says the pitch by its coordinates


@pytest.mark.parametrize("suffix", EXACT)
def test_rings_round_trip_bit_identically(suffix, tmp_path):
    written = rings()
    result = there_and_back(written, tmp_path / f"map{suffix}")
    assert torch.equal(result.heights, written.heights)
    assert torch.equal(result.pitch, written.pitch)


@pytest.mark.parametrize("suffix", PICTURES)
@pytest.mark.parametrize(
    "make", [lambda: Pixels(drawn(40, 30), number(0.00369)), lambda: Rings(drawn(1250), number(0.002))]
)
def test_pictures_round_trip_to_half_a_grey_value(suffix, make, tmp_path):
    written = make()
    result = there_and_back(written, tmp_path / f"map{suffix}")
    span = written.heights.max() - written.heights.min()
    assert (result.heights - written.heights).abs().max() <= 0.5001 * span / 65535
    assert torch.equal(result.pitch, written.pitch)
    assert len(torch.unique(result.heights)) > 1000  # 8 bits would leave 256


@pytest.mark.parametrize("suffix", [*EXACT, *PICTURES, *GRIDS])
@pytest.mark.parametrize("levels", [[*range(16)], [0, 1, 2, 3, 5, 8, 13], [7]])
def test_steps_round_trip_exactly(suffix, levels, tmp_path):
    """Also where not all sixteen are there, so that a grey value is no whole share of a step."""
    steps = torch.tensor(levels)[torch.arange(64).reshape(8, 8) % len(levels)] * (number(WAVE) / 16)
    result = there_and_back(Pixels(steps, number(0.002)), tmp_path / f"map{suffix}")
    assert torch.equal(result.heights, steps)


@pytest.mark.parametrize("suffix", [*EXACT, *PICTURES, *GRIDS])
def test_a_made_element_is_read_and_stepped_as_it_was(suffix, tmp_path):
    """A lens in 16 levels, read back with the same period and levels: the same steps, none lost to rounding."""
    glass = find_glass("F_SILICA")
    lens = Element(EvenPowers(number([-0.03])), number(0.3), glass)
    made = fabricated(wrapped(as_pixels(lens, 0.01), 0.55, levels=16))
    result = there_and_back(made.profile, tmp_path / f"map{suffix}")
    assert len(torch.unique(result.heights)) == 16
    assert torch.equal(result.heights, made.profile.heights)
    assert (fabricated_height(result.heights, period(glass, 0.55), 16) - made.profile.heights).abs().max() < 1e-18


@pytest.mark.parametrize("suffix", [".npy", ".csv"])
def test_float32_heights_keep_their_value(suffix, tmp_path):
    written = Pixels(drawn(5, 5).float(), torch.tensor(0.002))
    result = there_and_back(written, tmp_path / f"map{suffix}")
    assert torch.equal(result.heights.float(), written.heights)
    assert result.heights.dtype == (torch.float32 if suffix == ".npy" else torch.float64)


def test_large_and_small_heights_and_a_suffix_in_capitals(tmp_path):
    heights = number([[1e-300, -3.5, 0.0], [1 / 3, 1e9, -1e-9]])
    assert torch.equal(there_and_back(Pixels(heights, number(2.0)), tmp_path / "MAP.CSV").heights, heights)


def test_heights_that_require_a_gradient_are_written(tmp_path):
    written = Pixels(drawn(5, 5).requires_grad_(), number(0.002))
    assert torch.equal(there_and_back(written, tmp_path / "map.dat").heights, written.heights)


# -- what other programs see ------------------------------------------------------------------------------------------


def test_npy_is_an_array_of_heights_to_numpy(tmp_path):
    written = pixels()
    write_heights(written, tmp_path / "map.npy")
    assert np.array_equal(np.load(tmp_path / "map.npy"), written.heights.numpy())


def test_png_is_16_bit_grey_with_the_largest_y_on_top(tmp_path):
    """Read by hand, chunk by chunk (PNG specification, 11.2)."""
    heights = torch.arange(6, dtype=torch.float64).reshape(2, 3)
    write_heights(Pixels(heights, number(0.5)), tmp_path / "map.png")
    content, at, chunks = (tmp_path / "map.png").read_bytes(), 8, {}
    while at < len(content):
        (size,) = struct.unpack(">I", content[at : at + 4])
        chunks[content[at + 4 : at + 8]] = content[at + 8 : at + 8 + size]
        at += 12 + size
    assert struct.unpack(">IIBB", chunks[b"IHDR"][:10]) == (3, 2, 16, 0)
    keyword, text = chunks[b"tEXt"].split(b"\0")
    meaning = json.loads(text)
    assert keyword == b"Description"
    assert (meaning["unit"], meaning["pitch"], meaning["offset"]) == ("mm", 0.5, 0.0)
    lines = zlib.decompress(chunks[b"IDAT"])
    assert len(lines) == 2 * (1 + 3 * 2)
    with Image.open(tmp_path / "map.png") as picture:
        grey = np.array(picture)
    assert np.allclose(meaning["offset"] + meaning["scale"] * grey, heights.numpy()[::-1], atol=1e-4)


def test_tiff_is_16_bit_grey(tmp_path):
    heights = torch.arange(6, dtype=torch.float64).reshape(2, 3)
    write_heights(Pixels(heights, number(0.5)), tmp_path / "map.tif")
    with Image.open(tmp_path / "map.tif") as picture:
        assert (picture.tag_v2[258], picture.tag_v2[262]) == ((16,), 1)  # bits, black is zero
        assert np.array_equal(np.array(picture), [[39321, 52428, 65535], [0, 13107, 26214]])


def test_csv_is_a_table_of_places_and_sags(tmp_path):
    write_heights(Pixels(number([[1.0, 2.0], [3.0, 4.0]]), number(0.5)), tmp_path / "map.csv")
    expected = ["x_mm,y_mm,sag_mm", "-0.25,-0.25,1.0", "0.25,-0.25,2.0", "-0.25,0.25,3.0", "0.25,0.25,4.0"]
    assert (tmp_path / "map.csv").read_text().split() == expected
    write_heights(Rings(number([1.0, 2.0]), number(0.5)), tmp_path / "map.csv")
    assert (tmp_path / "map.csv").read_text().split() == ["r_mm,sag_mm", "0.25,1.0", "0.75,2.0"]


def test_grid_sag_begins_at_the_upper_left_and_runs_along_x(tmp_path):
    """OpticStudio's order: (-x, +y) first, left to right, then down."""
    heights = torch.arange(30, dtype=torch.float64).reshape(5, 6)
    write_heights(Pixels(heights, number(0.25)), tmp_path / "map.dat")
    lines = (tmp_path / "map.dat").read_bytes().decode("ascii").split("\r\n")
    assert lines[0].split() == ["6", "5", "0.25", "0.25", "0", "0", "0"]
    assert [float(line.split()[0]) for line in lines[1:7]] == [24, 25, 26, 27, 28, 29]
    assert float(lines[30].split()[0]) == 5
    assert all(line.split()[1:] == ["0"] * 4 for line in lines[1:31])
    assert lines[31:] == [""]


# -- files of other programs ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("flag", "unit"), [(0, 1.0), (1, 10.0), (2, 25.4), (3, 1000.0)])
def test_grid_sag_in_other_units_comes_in_mm(flag, unit, tmp_path):
    points = "\n".join(f"{k} 0 0 0" for k in range(25))
    (tmp_path / "map.dat").write_text(f"! made elsewhere\n5 5 0.1 0.1 {flag} 0 0\n{points}\n")
    result = read_heights(tmp_path / "map.dat")
    assert torch.equal(result.heights, unit * torch.arange(25, dtype=torch.float64).reshape(5, 5).flip(0))
    assert abs(float(result.pitch) - 0.1 * unit) < 1e-12


def test_grid_points_without_data_are_0(tmp_path):
    points = "\n".join(f"3 0 0 0 {int(k == 7)}" for k in range(25))
    (tmp_path / "map.dat").write_text(f"5 5 0.1 0.1 0 0 0\n{points}\n")
    heights = read_heights(tmp_path / "map.dat").heights
    assert heights[3, 2] == 0
    assert heights.sum() == 72


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_a_picture_without_description_needs_span_and_pitch(suffix, tmp_path):
    path = tmp_path / f"map{suffix}"
    Image.fromarray(np.array([[0, 65535], [13107, 0]], np.uint16)).save(path)
    with pytest.raises(HeightMapError, match="give span"):
        read_heights(path)
    with pytest.raises(HeightMapError, match="give pitch"):
        read_heights(path, span=(0.0, 5.0))
    result = read_heights(path, span=(-1.0, 4.0), pitch=0.002)
    assert (result.heights - number([[0.0, -1.0], [-1.0, 4.0]])).abs().max() < 1e-12
    assert float(result.pitch) == 0.002


def test_big_endian_files_are_read(tmp_path):
    np.save(tmp_path / "map.npy", np.arange(6).reshape(2, 3).astype(">f8"))
    assert torch.equal(read_heights(tmp_path / "map.npy", pitch=1.0).heights, torch.arange(6.0).double().reshape(2, 3))
    # header, one directory of 9 entries, the heights: TIFF 6.0 in Motorola order
    entries = [(256, 2), (257, 1), (258, 16), (259, 1), (262, 1), (273, 122), (277, 1), (278, 1), (279, 4)]
    directory = b"".join(struct.pack(">HHIHH", tag, 3, 1, entry, 0) for tag, entry in entries)
    content = b"MM\0*" + struct.pack(">IH", 8, 9) + directory + struct.pack(">I", 0) + struct.pack(">HH", 1, 65535)
    (tmp_path / "map.tif").write_bytes(content)
    assert read_heights(tmp_path / "map.tif", pitch=1.0, span=(0.0, 65535.0)).heights.tolist() == [[1.0, 65535.0]]


def test_npy_of_another_program_needs_a_pitch(tmp_path):
    np.save(tmp_path / "map.npy", np.arange(6).reshape(2, 3))
    with pytest.raises(HeightMapError, match="give pitch"):
        read_heights(tmp_path / "map.npy")
    assert read_heights(tmp_path / "map.npy", pitch=0.5).heights.dtype == torch.float64


def test_metadata_of_the_file_override_arguments(tmp_path):
    for suffix in (".npy", ".png", ".tif"):
        result = there_and_back(pixels(), tmp_path / f"map{suffix}", pitch=9.0, span=(0.0, 9.0))
        assert float(result.pitch) == 0.00369
        assert result.heights.max() < 1e-3


# -- refused ----------------------------------------------------------------------------------------------------------

TEXTS = {
    "no header": (".csv", "1,2,3\n", r":1: begins with '1,2,3'; expected the header"),
    "a word": (".csv", "x,y,sag\n0,0,1\n1,0,two\n", r":3: reads '1,0,two'; expected numbers"),
    "a short line": (".csv", "x,y,sag\n-0.5,0,1\n0.5,0\n", r":3: has 2 numbers; expected 3"),
    "no points": (".csv", "x,y,sag\n", r"holds no points"),
    "an uneven grid": (".csv", "x,y,sag\n-1,0,1\n0.1,0,1\n1,0,2\n", r":3: has x = 0.1 mm; expected 0 "),
    "rows of y": (".csv", "x,y,sag\n-1,-1,1\n-1,1,1\n1,-1,2\n1,1,2\n", r":3: has x = -1 mm"),
    "a missing point": (".csv", "x,y,sag\n-1,-1,1\n1,-1,1\n-1,1,2\n", r"has 3 points, no whole number of rows of 2"),
    "falling x": (".csv", "x,y,sag\n1,0,1\n-1,0,1\n", r"expected increasing coordinates"),
    "rings off": (".csv", "r,sag\n1,1\n2,1\n", r":3: has r = 2 mm; expected 3"),
    "nan": (".csv", "r,sag\n1,nan\n3,1\n", r"has 1 heights that are not finite"),
    "a short grid": (".dat", "5 5 1 1 0 0 0\n" + "0 0 0 0\n" * 24, r":1: announces 5 × 5 points, but holds 24"),
    "an unknown unit": (".dat", "5 5 1 1 7 0 0\n" + "0 0 0 0\n" * 25, r":1: has the unit flag 7"),
    "oblong points": (".dat", "5 5 1 2 0 0 0\n" + "0 0 0 0\n" * 25, r":1: has steps"),
    "off the axis": (".dat", "5 5 1 1 0 1 0\n" + "0 0 0 0\n" * 25, r":1: has steps .* decentres"),
    "a word in a grid": (".dat", "! one\n5 5 1 1 0 0 0\n" + "0 0 0 0\n" * 24 + "z\n", r":27: reads 'z'"),
    "comments": (".dat", "! one\n! two", r"holds comments only"),
    "empty": (".csv", "", r"is empty"),
    "no array": (".npy", "heights", r"is no .npy file"),
    "no picture": (".png", "heights", r"cannot be read as a picture"),
    "another suffix": (".obj", "x", r"the suffix '.obj' is unknown; expected a height map, one of .npy"),
    "no suffix": ("", "x", r"has no suffix"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_files_without_a_height_map_are_refused(name, tmp_path):
    suffix, text, message = TEXTS[name]
    path = tmp_path / f"map{suffix}"
    path.write_text(text)
    with pytest.raises(HeightMapError, match=message) as error:
        read_heights(path)
    assert str(error.value).startswith(str(path))


@pytest.mark.parametrize("suffix", [".npy", ".png", ".tif", ".dat"])
def test_every_cut_file_is_refused_or_whole(suffix, tmp_path):
    """No traceback of another kind, wherever the file ends."""
    path, written = tmp_path / f"map{suffix}", pixels(6, 6)
    write_heights(written, path)
    content = path.read_bytes()
    for size in range(0, len(content), max(1, len(content) // 60)):
        path.write_bytes(content[:size])
        try:
            result = read_heights(path)
        except HeightMapError:
            continue
        # A PNG is whole without its end mark.
        assert suffix == ".png"
        assert size > len(content) - 20
        assert (result.heights - written.heights).abs().max() < 1e-7


def test_pictures_of_8_bits_and_in_colour_are_refused(tmp_path):
    for mode in ("L", "RGB"):
        Image.new(mode, (4, 4)).save(tmp_path / "map.png")
        with pytest.raises(HeightMapError, match=f"mode {mode}; expected .*16 bits"):
            read_heights(tmp_path / "map.png", span=(0.0, 1.0), pitch=1.0)


def test_text_and_objects_in_npy_are_refused(tmp_path):
    for array in (np.array(["a"]), np.array([1j]), np.array([{}], dtype=object)):
        np.save(tmp_path / "map.npy", array, allow_pickle=True)
        with pytest.raises(HeightMapError):
            read_heights(tmp_path / "map.npy", pitch=1.0)
    np.save(tmp_path / "map.npy", np.zeros((2, 2, 2)))
    with pytest.raises(HeightMapError, match="shape"):
        read_heights(tmp_path / "map.npy", pitch=1.0)


@pytest.mark.parametrize("suffix", FORMATS)
def test_unwritable_height_maps_are_refused_and_the_old_file_stays(suffix, tmp_path):
    path = tmp_path / f"map{suffix}"
    write_heights(pixels(), path)
    before = path.read_bytes()
    hole = drawn(7, 9)
    hole[2, 3] = torch.nan
    wrong = {
        "not finite": Pixels(hole, number(0.1)),
        "as_pixels or as_rings": EvenPowers(number([1.0])),
        "a pitch of 0": Pixels(drawn(7, 9), number(0.0)),
        "shape": Pixels(drawn(7), number(0.1)),
    }
    if suffix in GRIDS:
        wrong |= {"holds no rings": rings(), "5 × 5 points at least": pixels(4, 9)}
    for message, profile in wrong.items():
        with pytest.raises(HeightMapError, match=message):
            write_heights(profile, path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_a_file_that_is_not_there_and_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(HeightMapError, match="cannot be read"):
        read_heights(tmp_path / "none.npy")
    with pytest.raises(HeightMapError, match="none"):
        write_heights(pixels(), tmp_path / "none" / "map.npy")


def test_a_changed_picture_does_not_get_another_ones_heights(tmp_path):
    """A description that lists two heights for a picture of three grey values."""
    steps = torch.tensor([[0.0, 1.0], [1.0, 0.0]], dtype=torch.float64)
    write_heights(Pixels(steps, number(0.1)), tmp_path / "map.tif")
    with Image.open(tmp_path / "map.tif") as picture:
        text = picture.tag_v2[270]
    stream = io.BytesIO()
    Image.fromarray(np.array([[0, 7], [9, 0]], np.uint16)).save(stream, "TIFF", tiffinfo={270: text})
    (tmp_path / "map.tif").write_bytes(stream.getvalue())
    with pytest.raises(HeightMapError, match=r"3 grey values, .* lists 2"):
        read_heights(tmp_path / "map.tif")
