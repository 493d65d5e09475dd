"""Pictures to train on: read, split by picture, cropped by keys."""

import numpy as np
import pytest
from PIL import Image

from raytrace.imaging import pictures
from raytrace.imaging.pictures import NoPictures, Pictures, crop, dead_leaves, digest, draws, files, order, read, split


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
    with pytest.raises(ValueError, match=r"broken\.png: cannot be read as a picture"):
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


def test_dead_leaves_laid_by_leaf_and_by_pixel_are_the_same(monkeypatch):
    found = []
    for few in (-1, 1000, 10**9):
        monkeypatch.setattr(pictures, "_FEW_BARE", few)
        found.append(dead_leaves(2, size=48, seed=3, smallest=1.5).samples)
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
