"""Pictures to train on: folders of real ones, and dead leaves where there are none.

Every draw is keyed by whole numbers (seed, epoch, sample), never by the order of calls: a sample is the same on one
process or on many, in a first run or in a resumed one.
"""

import dataclasses
import functools
import io
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from raytrace.files import read_bytes

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")
_SPLIT, _ORDER, _CROP, _LEAVES = range(4)  # what a draw is for: the last number of its key


#: A file is decoded up to so many bytes and pixels, and to so many pixels a byte: what deflate can pack, and no more.
_MOST_BYTES, _MOST_PIXELS, _PIXELS_PER_BYTE = 2**28, 10**8, 1032
#: So many pixels cost nothing, however well they are packed.
_FEW_PIXELS = 2**22
#: Bare pixels of dead leaves from which on looking at each pixel is faster than at each leaf.
_FEW_BARE = 1000


class PictureError(ValueError):
    """A file that is no picture, damaged, or larger than any that is meant; one line."""


class NoPictures(PictureError):
    """A folder without pictures, or with pictures that are all too small."""


@dataclasses.dataclass(frozen=True)
class Pictures:
    """Grey pictures, each (H, W) of 8 bits, and the name of each."""

    samples: tuple[np.ndarray, ...]
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.samples)


def draws(*key: int) -> np.random.Generator:
    """Random numbers of a key of whole numbers ≥ 0, independent of those of every other key."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(key)))


def files(folder: str | Path, most: int | None = None) -> list[Path]:
    """All pictures under a folder, sorted by path, or `most` of them, evenly from all.

    Raises NoPictures for one without any.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise NoPictures(f"{folder}: no such folder; expected one with pictures in it, in any subfolders")
    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    if not found:
        raise NoPictures(f"{folder}: no pictures found; expected {', '.join(SUFFIXES)} files in it or below")
    count = min(most or len(found), len(found))
    return [found[i * len(found) // count] for i in range(count)]


def read(paths: Sequence[str | Path], *, least: int, progress: Callable[[Iterable], Iterable] = iter) -> Pictures:
    """Pictures of at least `least` × `least` pixels; smaller ones are left out.

    progress: wraps the paths, for a bar. Raises PictureError naming a file that is none, NoPictures if none is left.
    """
    samples = [(read_grey(path), str(path)) for path in progress(paths)]
    kept = [(sample, name) for sample, name in samples if min(sample.shape) >= least]
    if not kept:
        raise NoPictures(f"none of {len(samples)} pictures has {least} × {least} pixels, a patch and its margin")
    return Pictures(*zip(*kept, strict=True))


def read_grey(path: str | Path) -> np.ndarray:
    """A picture as (H, W) luma of 8 bits (ITU-R BT.601). Raises PictureError naming a file that is none."""
    try:
        return np.asarray(decoded(read_bytes(path, _MOST_BYTES)).convert("L"))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        message = f"{path}: cannot be read as a picture ({reason}); remove it or convert it"
        raise PictureError(message) from error


def decoded(content: bytes) -> Image.Image:
    """The picture in the bytes of a file of `SUFFIXES`; its size is judged before it is decoded.

    Raises PictureError saying why there is none.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            picture = Image.open(io.BytesIO(content), formats=("JPEG", "PNG", "BMP", "TIFF"))
            width, height = picture.size
            count = width * height
            if count > _MOST_PIXELS or count > max(_FEW_PIXELS, _PIXELS_PER_BYTE * len(content)) or count < 1:
                found = f"{width} × {height} pixels in {len(content)} bytes"
                raise PictureError(f"{found}: damaged, or more than the {_MOST_PIXELS:.0e} that are read")
            picture.load()
    except PictureError:
        raise
    except Exception as error:  # decoders raise whatever their parsing meets, struct.error and KeyError too
        raise PictureError(" ".join(str(error).split())[:200] or type(error).__name__) from error
    return picture


def split(pictures: Pictures, *, share: float = 0.8, seed: int = 0) -> tuple[Pictures, Pictures]:
    """Pictures to train on and pictures to test on. Whole ones: crops of one texture never stand on both sides."""
    if len(pictures) < 2:
        raise NoPictures(f"{len(pictures)} picture cannot be split into training and test ones: give two at least")
    order = draws(seed, _SPLIT).permutation(len(pictures))
    count = min(max(1, round(share * len(order))), len(order) - 1)
    return tuple(
        Pictures(tuple(pictures.samples[i] for i in part), tuple(pictures.names[i] for i in part))
        for part in (np.sort(order[:count]), np.sort(order[count:]))
    )


def dead_leaves(count: int, *, size: int = 256, seed: int = 0, smallest: float = 1.0) -> Pictures:
    """Opaque discs of radii ∝ r⁻³ over one another until nothing shows through: natural statistics without a file.

    smallest: radius in pixels; larger ones make smoother pictures. Lee, Mumford and Huang (Int. J. Comput. Vis. 41,
    2001): occlusion alone gives the spectra of natural pictures.
    """
    return Pictures(
        tuple(_leaves(size, draws(seed, number, _LEAVES), smallest) for number in range(count)),
        tuple(f"dead leaves {number}" for number in range(count)),
    )


def _leaves(size: int, random: np.random.Generator, smallest: float) -> np.ndarray:
    picture, bare = np.zeros((size, size), np.uint8), np.ones((size, size), bool)
    while bare.any():
        lay = _leaf_by_leaf if bare.sum() > _FEW_BARE else _pixel_by_pixel
        lay(picture, bare, *_leaf_batch(size, random, smallest))
    return picture


def _leaf_by_leaf(picture: np.ndarray, bare: np.ndarray, *leaves: np.ndarray) -> None:
    """Every leaf, the topmost first, covers what is bare."""
    size, places = len(picture), np.arange(len(picture))
    for radius, x, y, shade in zip(*(each.tolist() for each in leaves), strict=True):
        rows = slice(max(0, int(y - radius)), min(size, int(y + radius) + 2))
        columns = slice(max(0, int(x - radius)), min(size, int(x + radius) + 2))
        open_here = bare[rows, columns]
        if open_here.any():
            covered = (places[columns] - x) ** 2 + ((places[rows] - y) ** 2)[:, None] <= radius * radius
            covered &= open_here
            picture[rows, columns][covered] = shade
            open_here &= ~covered


def _pixel_by_pixel(picture: np.ndarray, bare: np.ndarray, *leaves: np.ndarray) -> None:
    """The same picture: every bare pixel is of the first leaf that covers it."""
    rows, columns = np.nonzero(bare)
    for radius, x, y, shade in zip(*(np.split(each, 16) for each in leaves), strict=True):
        covers = (columns[:, None] - x) ** 2 + (rows[:, None] - y) ** 2 <= radius * radius
        covered = covers.any(1)
        picture[rows[covered], columns[covered]] = shade[covers[covered].argmax(1)]
        bare[rows[covered], columns[covered]] = False
        rows, columns = rows[~covered], columns[~covered]


def _leaf_batch(size: int, random: np.random.Generator, smallest: float) -> tuple[np.ndarray, ...]:
    """Radius, place and shade of the next leaves, the topmost first; of density ∝ r⁻³, so that 1/r² is even."""
    count, largest = 4096, size / 2
    radius = 1 / np.sqrt(random.uniform(largest**-2, smallest**-2, count))
    x, y = random.uniform(-1, 1, (2, count)) * (size / 2 + radius) + size / 2
    return radius, x, y, random.integers(0, 256, count)


def crop(pictures: Pictures, sample: int, *, epoch: int, size: int, crops: int = 4, seed: int = 0) -> np.ndarray:
    """Patch (size, size) in [0, 1] of a sample of an epoch of `crops` patches a picture, turned and mirrored by chance.

    sample: 0 … crops · len(pictures) - 1; the pictures come in an order of the epoch's own.
    """
    number = int(order(len(pictures) * crops, epoch=epoch, seed=seed)[sample]) // crops
    picture, random = pictures.samples[number], draws(seed, epoch, sample, _CROP)
    row, column = (int(random.integers(0, extent - size + 1)) for extent in picture.shape)
    patch = np.rot90(picture[row : row + size, column : column + size], int(random.integers(4)))
    return (patch.T if random.integers(2) else patch).astype(np.float32) / 255


@functools.lru_cache(maxsize=4)
def order(count: int, *, epoch: int, seed: int = 0) -> np.ndarray:
    """The order of `count` samples in an epoch."""
    return draws(seed, epoch, count, _ORDER).permutation(count)
