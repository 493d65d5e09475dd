"""Pictures to train on: read, split by picture, cropped by keys."""

import struct
import warnings
import zlib

import numpy as np
import pytest
from PIL import Image

from raytrace.imaging import pictures
from raytrace.imaging.pictures import NoPictures, Pictures, crop, dead_leaves, digest, draws, files, order, read, split
from raytrace.io.pictures import PictureChanged, read_colour, read_depth, read_grey, read_levels, write_light

LEAVES = "2, blake2 25e579926550d3b2"  # of two grey pictures, before there were colours


@pytest.fixture
def folder(tmp_path):
    """Two kinds of textures in folders of their own, one colour picture, one too small."""
    for kind in ("banded", "dotted"):
        (tmp_path / kind).mkdir()
        for number in range(5):
            values = draws(number).integers(0, 256, (90, 100), dtype=np.uint8)
            Image.fromarray(values).save(tmp_path / kind / f"{kind}_{number}.png")
    Image.fromarray(np.full((95, 95, 3), (255, 0, 0), np.uint8)).save(tmp_path / "red.png")
    Image.fromarray(np.zeros((20, 20), np.uint8)).save(tmp_path / "small.png")
    (tmp_path / "labels.txt").write_text("banded")
    return tmp_path


def test_a_folder_is_read_in_the_order_of_its_paths(folder):
    paths = files(folder)
    assert [path.name for path in paths[:2]] == ["banded_0.png", "banded_1.png"]
    assert len(paths) == 12
    pictures = read(paths, least=84)
    assert len(pictures) == 11
    assert pictures.samples[0].shape == (90, 100)
    np.testing.assert_array_equal(pictures.samples[3], draws(3).integers(0, 256, (90, 100), dtype=np.uint8))


def test_colours_become_luma(folder):
    (red,) = read([folder / "red.png"], least=84).samples
    assert int(red[0, 0]) == round(0.299 * 255)


def test_folders_without_pictures_are_reported(folder, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(NoPictures, match="no such folder"):
        files(tmp_path / "nowhere")
    with pytest.raises(NoPictures, match=r"no pictures found; expected \.jpg"):
        files(tmp_path / "empty")
    with pytest.raises(NoPictures, match="none of 1 pictures has 84 × 84"):
        read([folder / "small.png"], least=84)
    (folder / "broken.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"broken\.png: cannot be read"):
        read([folder / "broken.png"], least=84)


def test_split_keeps_pictures_whole_and_repeats():
    pictures = dead_leaves(10, size=16)
    train, test = split(pictures, seed=3)
    assert (len(train), len(test)) == (8, 2)
    assert not set(train.names) & set(test.names)
    assert set(train.names) | set(test.names) == set(pictures.names)
    assert split(pictures, seed=3)[1].names == test.names
    assert any(split(pictures, seed=other)[1].names != test.names for other in range(5))
    with pytest.raises(NoPictures, match="cannot be split"):
        split(dead_leaves(1, size=16))


def test_crops_are_keyed_by_number_not_by_the_order_of_calls():
    pictures = dead_leaves(3, size=40)
    there, back = ([crop(pictures, i, epoch=2, size=24) for i in order] for order in (range(12), range(11, -1, -1)))
    for one, other in zip(there, reversed(back), strict=True):
        np.testing.assert_array_equal(one, other)
    assert there[0].shape == (24, 24)
    assert 0 <= min(p.min() for p in there) < max(p.max() for p in there) <= 1
    assert not np.array_equal(there[0], crop(pictures, 0, epoch=3, size=24))
    assert not np.array_equal(there[0], crop(pictures, 0, epoch=2, size=24, seed=1))


def test_an_epoch_takes_as_many_crops_of_every_picture():
    pictures = Pictures(tuple(np.full((9, 9), 50 * n, np.uint8) for n in range(3)), ("a", "b", "c"))
    shades = [round(255 * float(crop(pictures, i, epoch=0, size=8)[0, 0])) for i in range(12)]
    assert sorted(shades) == [0] * 4 + [50] * 4 + [100] * 4
    assert sorted(order(12, epoch=0)) == list(range(12))


def test_a_digest_distinguishes_pictures():
    """Every pixel, shape and place counts; copies and views are the same."""
    one = np.arange(6, dtype=np.uint8).reshape(2, 3)
    assert digest([one, one + 1]) == digest((one.copy(), np.flip(np.flip(one + 1))))
    assert digest([one, one]).startswith("2, blake2 ")
    others = [one + (one == 5), one.reshape(3, 2), one.astype(float), one.T, one[::-1]]
    assert len({digest([one]), *(digest([other]) for other in others)}) == 6
    assert digest([one, one + 1]) != digest([one + 1, one])


@pytest.mark.parametrize("colour", [False, True])
def test_dead_leaves_laid_by_leaf_and_by_pixel_are_the_same(monkeypatch, colour):
    found = []
    for few in (-1, 1000, 10**9):
        monkeypatch.setattr(pictures, "_FEW_BARE", few)
        found.append(dead_leaves(2, size=48, seed=3, smallest=1.5, colour=colour).samples)
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])


def test_dead_leaves_look_alike_at_every_scale():
    """Natural pictures: the power spectrum falls as 1/f^(2 - η) with frequency; here between f^-1 and f^-2.5."""
    samples = np.stack(dead_leaves(6, size=96, seed=1).samples).astype(float)
    power = (np.abs(np.fft.fft2(samples - samples.mean((1, 2), keepdims=True))) ** 2).mean(0)
    f = np.hypot(*np.meshgrid(*[np.fft.fftfreq(96)] * 2))
    low, high = (power[(f > a) & (f < 1.4 * a)].mean() for a in (0.03, 0.24))
    assert 1.0 < np.log(low / high) / np.log(8) < 2.5
    np.testing.assert_array_equal(
        dead_leaves(1, size=32, seed=7).samples[0], dead_leaves(2, size=32, seed=7).samples[0]
    )


# -- colours


def test_a_folder_is_read_in_colour(folder):
    """Samples (H, W, 3), red first; of a grey file three equal channels, whose grey sample is unchanged."""
    paths = [folder / "red.png", folder / "banded" / "banded_3.png", folder / "small.png"]
    coloured, grey = read(paths, least=84, colour=True), read(paths, least=84)
    assert coloured.names == grey.names
    assert [sample.dtype for sample in coloured.samples] == [np.uint8] * 2
    np.testing.assert_array_equal(coloured.samples[0], np.full((95, 95, 3), (255, 0, 0)))
    np.testing.assert_array_equal(coloured.samples[1], np.repeat(grey.samples[1][..., None], 3, 2))
    assert digest(coloured.samples) != digest(grey.samples)


def test_crops_of_colours_are_those_of_every_channel():
    """(size, size, 3): the same place and orientation of every channel, as of a grey picture of the same size."""
    coloured = dead_leaves(3, size=40, seed=5, colour=True)
    for channel in range(3):
        one = Pictures(tuple(sample[..., channel] for sample in coloured.samples), coloured.names)
        for sample in range(12):
            patch = crop(coloured, sample, epoch=1, size=24, seed=2)
            assert patch.shape == (24, 24, 3)
            assert patch.dtype == np.float32
            np.testing.assert_array_equal(patch[..., channel], crop(one, sample, epoch=1, size=24, seed=2))
    train, test = split(coloured)
    assert (len(train), len(test)) == (2, 1)


@pytest.mark.parametrize("correlation", [0.0, 0.6, 1.0])
def test_colours_of_dead_leaves_are_correlated(correlation):
    """Levels of every channel are uniform, and have the correlation that is asked for."""
    levels = pictures._colours(draws(0), 40_000, correlation)
    assert levels.min() == 0
    assert levels.max() == 255
    for channel in levels.T:  # 256 equal bins: χ² of 255 ± √510
        counts = np.bincount(channel, minlength=256)
        assert abs(((counts - counts.mean()) ** 2 / counts.mean()).sum() - 255) < 4 * 510**0.5
    found = np.corrcoef(levels.T)[np.triu_indices(3, 1)]
    np.testing.assert_allclose(found, correlation, atol=4 * (1 - correlation**2) / 200 + 1e-12)
    sample = dead_leaves(1, size=32, colour=True, correlation=correlation).samples[0]
    assert sample.shape == (32, 32, 3)
    edges = [np.diff(sample[..., channel].astype(int)) != 0 for channel in range(3)]  # of the same discs
    assert (edges[0] == edges[1]).mean() > 0.98


def test_grey_dead_leaves_are_those_of_earlier_versions():
    assert digest(dead_leaves(2, size=48, seed=3).samples) == LEAVES


def test_other_correlations_are_refused():
    with pytest.raises(ValueError, match=r"1\.5 .*expected 0 to 1"):
        dead_leaves(1, size=8, colour=True, correlation=1.5)


# -- 16 bits


def png(values: np.ndarray) -> bytes:
    """A PNG file of levels (H, W, C) of 16 bits, written by the specification (ISO/IEC 15948)."""
    height, width, channels = values.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    header = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def tiff(values: np.ndarray, order: str, deflate: str = "") -> bytes:
    """A TIFF file of levels (H, W, C ≥ 3) of 16 bits, of byte order "<" or ">" (TIFF 6.0), compressed or not."""
    height, width, channels = values.shape
    pixels = values.astype(f"{order}u2").tobytes()
    pixels = zlib.compress(pixels) if deflate else pixels
    after = 8 + len(pixels)
    bits = struct.pack(f"{order}{channels}H", *[16] * channels)
    entries = [
        (256, 3, 1, width), (257, 3, 1, height), (258, 3, channels, after), (259, 3, 1, 8 if deflate else 1),
        (262, 3, 1, 2), (273, 4, 1, 8), (277, 3, 1, channels), (278, 3, 1, height), (279, 4, 1, len(pixels)),
    ]  # fmt: skip
    if channels == 4:
        entries.append((338, 3, 1, 2))  # alpha that is not premultiplied
    listed = b""
    for tag, kind, count, value in entries:
        of_value = "H2x" if kind == 3 and count == 1 else "I"
        listed += struct.pack(f"{order}HHI{of_value}", tag, kind, count, value)
    directory = struct.pack(f"{order}H", len(entries)) + listed + struct.pack(f"{order}I", 0)
    start = struct.pack(f"{order}HI", 42, after + len(bits))
    return (b"II" if order == "<" else b"MM") + start + pixels + bits + directory


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("kind", ["png", "<", ">", "<deflate", ">deflate"])
def test_colours_of_16_bits_keep_them(tmp_path, channels, kind):
    """All 16 bits of the colours, on black where they have alpha; rounded to 8 for training; luma of 16 bits."""
    values = draws(1).integers(0, 2**16, (90, 85, channels)).astype(np.uint16)
    path = tmp_path / ("a.png" if kind == "png" else "a.tif")
    path.write_bytes(png(values) if kind == "png" else tiff(values, kind[0], kind[1:]))
    colours = values[..., :3]
    if channels == 4:
        colours = np.round(colours * (values[..., 3:] / 65535)).astype(np.uint16)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PictureChanged)
        levels = read_levels(path)
    assert levels.dtype == np.uint16
    np.testing.assert_array_equal(levels, colours.transpose(2, 0, 1))
    luma = read_levels(path, 1)
    assert luma.shape == (1, 90, 85)
    np.testing.assert_allclose(luma[0], colours @ [0.299, 0.587, 0.114], atol=1.0)
    (sample,) = read([path], least=84, colour=True).samples
    assert sample.dtype == np.uint8
    np.testing.assert_allclose(sample, colours / 257, atol=0.5)


def test_layouts_of_16_bits_that_would_lose_bits_are_refused(tmp_path):
    """Grey with alpha, of which PIL keeps 8 bits; as grey of 8 bits, which training takes, it is read."""
    (tmp_path / "a.png").write_bytes(png(draws(3).integers(0, 2**16, (6, 7, 2)).astype(np.uint16)))
    with pytest.raises(ValueError, match=r"a\.png: .*LA with 16 bits; expected grey or RGB"):
        read_levels(tmp_path / "a.png")
    assert read([tmp_path / "a.png"], least=4).samples[0].shape == (6, 7)


def test_exif_orientation_is_applied_and_alpha_shown_on_black(tmp_path):
    values = draws(4).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    picture = Image.fromarray(values)
    exif = picture.getexif()
    exif[0x0112] = 6  # turned by 90°
    picture.save(tmp_path / "a.png", exif=exif)
    with pytest.warns(PictureChanged, match=r"a\.png: .*EXIF orientation 6"):
        np.testing.assert_array_equal(read_colour(tmp_path / "a.png"), np.rot90(values, -1))
    alpha = np.dstack([values, np.full((4, 6), 255, np.uint8)])
    alpha[0, 0, 3] = 0
    Image.fromarray(alpha).save(tmp_path / "b.png")
    with pytest.warns(PictureChanged, match="its transparent parts are shown on black"):
        levels = read_levels(tmp_path / "b.png")
    assert not levels[:, 0, 0].any()
    np.testing.assert_array_equal(levels[:, 1:], values[1:].transpose(2, 0, 1))


def test_webp_and_floating_point_tiff(tmp_path):
    values = draws(5).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    Image.fromarray(values).save(tmp_path / "a.webp", lossless=True)
    np.testing.assert_array_equal(read_levels(tmp_path / "a.webp"), values.transpose(2, 0, 1))
    light = draws(6).random((3, 4, 6)).astype(np.float32)
    write_light(tmp_path / "colour.tif", light)
    np.testing.assert_array_equal(read_levels(tmp_path / "colour.tif"), light)
    write_light(tmp_path / "grey.tif", light[:1])
    np.testing.assert_array_equal(read_levels(tmp_path / "grey.tif"), light[:1])
    np.testing.assert_allclose(read_grey(tmp_path / "grey.tif"), 255 * light[0], atol=0.51)
    distances = np.float32(800 + 4000 * light[:1])
    write_light(tmp_path / "depth.tif", distances)
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.tif"), distances[0])
    with pytest.raises(ValueError, match=r"distances in mm .*`depth_range`"):
        read_depth(tmp_path / "depth.tif", (1.0, 2.0))
    (tmp_path / "b.png").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="expected JPEG, PNG, WEBP, BMP, TIFF"):
        read_levels(tmp_path / "b.png")
