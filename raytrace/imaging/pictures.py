"""Pictures for training: folders of photographs, and dead-leaves images.

Random numbers are keyed by whole numbers (seed, epoch, sample), never by the order of calls: a sample is the same with
one process or many, in a first run or in a resumed one.
"""

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy.special import ndtr

from raytrace.io.pictures import SUFFIXES, PictureError, read_colour, read_grey

_SPLIT, _ORDER, _CROP, _LEAVES = range(4)  # last numbers of keys
#: Number of uncovered pixels of dead leaves above which a loop over leaves is faster than one over pixels.
_FEW_BARE = 1000


class NoPictures(PictureError):
    """A folder without pictures, or with pictures that are all too small."""


@dataclasses.dataclass(frozen=True)
class Pictures:
    """Pictures of 8 bits, each grey (H, W) or red, green and blue (H, W, 3), and the name of each."""

    samples: tuple[np.ndarray, ...]
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.samples)

    @property
    def classes(self) -> tuple[str, ...]:
        """The folder of each picture, whose pictures are alike; the name of each if there is a single folder."""
        folders = tuple(str(Path(name).parent) for name in self.names)
        return folders if len(set(folders)) > 1 else self.names


def digest(samples: Sequence[np.ndarray]) -> str:
    """The number of pictures and a hash of their pixels, which identify the training set of a run."""
    pixels = hashlib.blake2b(digest_size=8)
    for sample in samples:
        pixels.update(repr(sample.shape).encode())
        pixels.update(np.ascontiguousarray(sample).data)
    return f"{len(samples)}, blake2 {pixels.hexdigest()}"


def draws(*key: int) -> np.random.Generator:
    """Random numbers of a key of whole numbers ≥ 0, independent of those of every other key."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(key)))


def files(folder: str | Path, most: int | None = None) -> list[Path]:
    """All pictures under a folder, sorted by path, or `most` of them, evenly spaced. Raises NoPictures."""
    folder = Path(folder)
    if not folder.is_dir():
        raise NoPictures(f"{folder}: no such folder; expected one with pictures in it, in any subfolders")
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise NoPictures(f"{folder}: no pictures found; expected {', '.join(SUFFIXES)} files in it or below")
    count = min(most or len(paths), len(paths))
    return [paths[i * len(paths) // count] for i in range(count)]


def read(
    paths: Sequence[str | Path], *, least: int, bar: Callable[[Iterable], Iterable] = iter, colour: bool = False
) -> Pictures:
    """Pictures of at least `least` × `least` pixels; smaller ones are left out.

    bar: wraps the paths. colour: samples (H, W, 3), red, green and blue, instead of luma (H, W); 16 bits are rounded to
    8. Raises PictureError with the name of a damaged file, NoPictures if none is left.
    """
    samples = [((read_colour if colour else read_grey)(path), str(path)) for path in bar(paths)]
    large = [(sample, name) for sample, name in samples if min(sample.shape[:2]) >= least]
    if not large:
        raise NoPictures(f"none of {len(samples)} pictures has {least} × {least} pixels, a patch and its margin")
    return Pictures(*zip(*large, strict=True))


def split(pictures: Pictures, *, share: float = 0.8, seed: int = 0) -> tuple[Pictures, Pictures]:
    """Training and test pictures; all crops of a picture are on one side."""
    if len(pictures) < 2:
        raise NoPictures(f"{len(pictures)} picture cannot be split into training and test ones: give two at least")
    order = draws(seed, _SPLIT).permutation(len(pictures))
    count = min(max(1, round(share * len(order))), len(order) - 1)
    train, test = (
        Pictures(tuple(pictures.samples[i] for i in part), tuple(pictures.names[i] for i in part))
        for part in (np.sort(order[:count]), np.sort(order[count:]))
    )
    return train, test


def dead_leaves(
    count: int,
    *,
    size: int = 256,
    seed: int = 0,
    smallest: float = 1.0,
    colour: bool = False,
    correlation: float = 0.9,
) -> Pictures:
    """Opaque discs of density ∝ r⁻³ that cover the picture: natural statistics without a file.

    smallest: radius in pixels; larger ones make smoother pictures. colour: pictures (size, size, 3) of the same discs,
    whose red, green and blue levels have this correlation, 0 to 1; every channel is uniformly distributed, as grey
    levels are. Lee, Mumford and Huang (Int. J. Comput. Vis. 41, 2001): occlusion alone gives the spectra of natural
    pictures. Raises ValueError for another correlation.
    """
    if not 0 <= correlation <= 1:
        raise ValueError(f"correlation {correlation:g} of colours: expected 0 to 1")
    return Pictures(
        tuple(
            _leaves(size, draws(seed, number, _LEAVES), smallest, correlation if colour else None)
            for number in range(count)
        ),
        tuple(f"dead leaves {number}" for number in range(count)),
    )


def _colours(random: np.random.Generator, count: int, correlation: float) -> np.ndarray:
    """Levels (count, 3), each uniform in 0 … 255, of Gaussian numbers through their distribution function."""
    # Ranks of two Gaussian numbers of correlation r are correlated by (6/π) asin(r/2) (Pearson, 1907).
    of_gaussians = 2 * np.sin(np.pi * correlation / 6)
    common, single = random.standard_normal((count, 1)), random.standard_normal((count, 3))
    share = ndtr(np.sqrt(of_gaussians) * common + np.sqrt(1 - of_gaussians) * single)
    return np.minimum(255, (256 * share).astype(int))


def _leaves(size: int, random: np.random.Generator, smallest: float, correlation: float | None) -> np.ndarray:
    """Grey for a correlation of None."""
    picture = np.zeros((size, size) if correlation is None else (size, size, 3), np.uint8)
    bare, largest = np.ones((size, size), bool), size / 2
    while bare.any():
        # The next discs, the topmost first; of density ∝ r⁻³, so that 1/r² is uniform.
        radius = 1 / np.sqrt(random.uniform(largest**-2, smallest**-2, 4096))
        x, y = random.uniform(-1, 1, (2, 4096)) * (size / 2 + radius) + size / 2
        levels = random.integers(0, 256, 4096) if correlation is None else _colours(random, 4096, correlation)
        cover = _cover_by_disc if bare.sum() > _FEW_BARE else _cover_by_pixel
        cover(picture, bare, radius, x, y, levels)
    return picture


def _cover_by_disc(picture: np.ndarray, bare: np.ndarray, *discs: np.ndarray) -> None:
    """Every disc, the topmost first, covers the bare pixels inside it; the pixels of 128 discs are computed at once."""
    size, picture, bare = len(picture), picture.reshape(-1, *picture.shape[2:]), bare.reshape(-1)
    for radius, x, y, shade in zip(*(np.split(values, 32) for values in discs), strict=True):
        left, top = (np.maximum(0, (centre - radius).astype(int)) for centre in (x, y))
        right, bottom = (np.minimum(size, (centre + radius).astype(int) + 2) for centre in (x, y))
        width = right - left
        count = width * (bottom - top)
        disc = np.repeat(np.arange(len(radius)), count)
        row, column = np.divmod(np.arange(len(disc)) - np.repeat(np.cumsum(count) - count, count), width[disc])
        row, column = row + top[disc], column + left[disc]
        pixel = row * size + column
        covered = ((column - x[disc]) ** 2 + (row - y[disc]) ** 2 <= (radius * radius)[disc]) & bare[pixel]
        pixel = pixel[covered][::-1]
        picture[pixel] = shade[disc[covered][::-1]]  # of several shades of a pixel the last, the topmost disc's, stays
        bare[pixel] = False
        if not bare.any():
            break


def _cover_by_pixel(picture: np.ndarray, bare: np.ndarray, *discs: np.ndarray) -> None:
    """The same picture: every bare pixel has the shade of the first disc that covers it."""
    rows, columns = np.nonzero(bare)
    for radius, x, y, shade in zip(*(np.split(values, 16) for values in discs), strict=True):
        covers = (columns[:, None] - x) ** 2 + (rows[:, None] - y) ** 2 <= radius * radius
        covered = covers.any(1)
        picture[rows[covered], columns[covered]] = shade[covers[covered].argmax(1)]
        bare[rows[covered], columns[covered]] = False
        rows, columns = rows[~covered], columns[~covered]


def crop(pictures: Pictures, sample: int, *, epoch: int, size: int, crops: int = 4, seed: int = 0) -> np.ndarray:
    """Patch (size, size), or (size, size, 3) of a colour picture, of a sample of an epoch of `crops` patches a picture.

    Its numbers in [0, 1] are the levels of the file, not linear in light (`imaging.render.linearised`); rows, columns
    and colours are its axes, in this order. It has one of eight orientations. sample: 0 … crops · len(pictures) - 1;
    every epoch has another order of the pictures.
    """
    number = int(order(len(pictures) * crops, epoch=epoch, seed=seed)[sample]) // crops
    picture, random = pictures.samples[number], draws(seed, epoch, sample, _CROP)
    row, column = (int(random.integers(0, extent - size + 1)) for extent in picture.shape[:2])
    patch = np.rot90(picture[row : row + size, column : column + size], int(random.integers(4)))
    return (patch.swapaxes(0, 1) if random.integers(2) else patch).astype(np.float32) / 255


@functools.lru_cache(maxsize=4)
def order(count: int, *, epoch: int, seed: int = 0) -> np.ndarray:
    """The order of `count` samples in an epoch."""
    return draws(seed, epoch, count, _ORDER).permutation(count)
