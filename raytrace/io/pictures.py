"""Image files, decoded within limits of size."""

import io
import sys
import warnings
from pathlib import Path

import numpy as np
from PIL import Image

from raytrace.files import read_bytes, write_atomically

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")

#: Limits of bytes, of pixels, and of pixels per byte, which is that of deflate.
_MOST_BYTES, _MOST_PIXELS, _PIXELS_PER_BYTE = 2**28, 10**8, 1032
#: Pixels that are decoded at any ratio.
_FEW_PIXELS = 2**22
_MOST_ARRAY = 2**30  # bytes
#: Orders of the bytes of 16 bits, whose first byte PIL keeps of colours: exchanged, it keeps the second.
_EXCHANGED = {"16B": "16L", "16L": "16B", "16N": "16B" if sys.byteorder == "little" else "16L"}


class PictureError(ValueError):
    """A file that is not an image, damaged, or too large; one line."""


def read_grey(path: str | Path) -> np.ndarray:
    """An image as (H, W) luma of 8 bits (ITU-R BT.601). Raises PictureError naming the file."""
    return _pixels(path, "L")


def read_colour(path: str | Path) -> np.ndarray:
    """An image as (H, W, 3) of 8 bits, red, green and blue; equal of a grey file. Raises PictureError naming it."""
    levels = read_levels(path, 3)
    levels = levels if levels.dtype == np.uint8 else np.round(levels / 257).astype(np.uint8)
    return np.ascontiguousarray(levels.transpose(1, 2, 0))


def _pixels(path: str | Path, mode: str) -> np.ndarray:
    picture = _picture(path)
    if picture.mode.startswith("I"):  # which PIL would clip at 255
        picture = Image.fromarray(np.round(_sixteen_bits(picture, path) / 257).astype(np.uint8))
    return np.asarray(picture.convert(mode))


def _picture(path: str | Path, *, low_bytes: bool = False) -> Image.Image:
    try:
        return decoded(read_bytes(path, _MOST_BYTES), low_bytes=low_bytes)
    except (OSError, ValueError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or " ".join(str(error).split())
        message = f"{path}: cannot be read as a picture ({reason}); remove it or convert it"
        raise PictureError(message) from error


def decoded(content: bytes, *, low_bytes: bool = False) -> Image.Image:
    """The image in the bytes of a file of `SUFFIXES`; its size is checked before it is decoded. Raises PictureError.

    Colours of 16 bits have their high bytes, or their low ones; `info["raw_mode"]` is the layout of the file's pixels.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            picture = Image.open(io.BytesIO(content), formats=("JPEG", "PNG", "BMP", "TIFF"))
            width, height = picture.size
            count = width * height
            if count > _MOST_PIXELS or count > max(_FEW_PIXELS, _PIXELS_PER_BYTE * len(content)) or count < 1:
                size = f"{width} × {height} pixels in {len(content)} bytes"
                raise PictureError(f"{size}: damaged, or more than the {_MOST_PIXELS:.0e} that are read")
            layout = _raw_mode(picture)
            if low_bytes:
                picture.tile = [_exchanged(tile) for tile in picture.tile]
            picture.load()
            picture.info["raw_mode"] = layout
    except PictureError:
        raise
    except Exception as error:  # decoders raise whatever their parsing meets, struct.error and KeyError too
        raise PictureError(" ".join(str(error).split())[:200] or type(error).__name__) from error
    return picture


def _raw_mode(picture: Image.Image) -> str:
    """PIL's name of the layout of a file's pixels, as "RGB;16B"; "" if it has none."""
    arguments = picture.tile[0][3] if picture.tile else ""
    first = arguments[0] if isinstance(arguments, tuple) and arguments else arguments
    return first if isinstance(first, str) else ""


def _exchanged(tile: tuple) -> tuple:
    """The tile with the order of its bytes of 16 bits exchanged."""
    arguments = tile[3]
    raw, rest = (arguments[0], arguments[1:]) if isinstance(arguments, tuple) else (arguments, None)
    colours, _, order = raw.partition(";")
    raw = f"{colours};{_EXCHANGED[order]}"
    exchanged = (*tile[:3], raw if rest is None else (raw, *rest))
    return tile._make(exchanged) if hasattr(tile, "_make") else exchanged  # named since Pillow 11.1


def read_channels(path: str | Path, channels: int) -> np.ndarray:
    """A picture as (channels, H, W) in [0, 1], float64: luma for one channel, red, green and blue for three.

    Raises PictureError for a file that is no picture, and for another number of channels.
    """
    if channels not in (1, 3):
        raise PictureError(f"{path}: a picture has 1 or 3 channels, not one for each of {channels} wavelengths")
    picture = _pixels(path, "L" if channels == 1 else "RGB")
    return np.atleast_3d(picture).transpose(2, 0, 1) / 255.0


def read_levels(path: str | Path, channels: int | None = None) -> np.ndarray:
    """A picture as levels (channels, H, W) of 8 bits, or of 16 where the file has them; else as `read_channels`.

    channels: 1 or 3, by default 1 of a grey file and 3 of a coloured one.
    """
    picture = _picture(path)
    grey = picture.mode in ("1", "L", "LA", "I", "I;16", "I;16B", "I;16L")
    channels = (1 if grey else 3) if channels is None else channels
    if channels not in (1, 3):
        raise PictureError(f"{path}: a picture has 1 or 3 channels, not {channels}")
    if picture.mode.startswith("I"):
        return np.repeat(_sixteen_bits(picture, path)[None], channels, 0)
    if ";16" in picture.info["raw_mode"]:
        colours = _deep_colours(picture, path)
        return colours if channels == 3 else _luma(colours)[None]
    return np.atleast_3d(np.asarray(picture.convert("L" if channels == 1 else "RGB"))).transpose(2, 0, 1)


def _deep_colours(picture: Image.Image, path: str | Path) -> np.ndarray:
    """Colours (3, H, W) of 16 bits, of which PIL decodes one byte at a time."""
    colours, _, order = picture.info["raw_mode"].partition(";")
    if colours not in ("RGB", "RGBA", "RGBX") or order not in _EXCHANGED:
        raise PictureError(
            f"{path}: pixels of the layout {colours} with 16 bits; expected grey or RGB ones: convert it"
        )
    high, low = (np.asarray(part)[..., :3].astype(np.uint16) for part in (picture, _picture(path, low_bytes=True)))
    return (256 * high + low).transpose(2, 0, 1)


def _luma(colours: np.ndarray) -> np.ndarray:
    """(H, W) of colours (3, H, W) of 16 bits, with PIL's weights of 8 bits (ITU-R BT.601)."""
    return ((np.tensordot([19595, 38470, 7471], colours.astype(np.int64), 1) + 2**15) >> 16).astype(np.uint16)


def _sixteen_bits(picture: Image.Image, path: str | Path) -> np.ndarray:
    values = np.asarray(picture)
    if values.min() < 0 or values.max() >= 2**16:
        raise PictureError(f"{path}: levels from {values.min()} to {values.max()}; expected 8 or 16 bits: convert it")
    return values.astype(np.uint16)


def read_depth(path: str | Path, depth_range: tuple[float, float] | None = None) -> np.ndarray:
    """A depth map (H, W) mm: an array of a .npy file, or a grey picture whose black is near and whose white is far.

    depth_range: (near, far) mm of the picture, linear in its levels. Raises PictureError naming the file.
    """
    if Path(path).suffix.lower() == ".npy":
        if depth_range is not None:
            raise PictureError(f"{path}: an array of distances in mm needs no `depth_range`: leave it out")
        try:
            depth = np.load(io.BytesIO(read_bytes(path, _MOST_ARRAY)), allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            reason = (isinstance(error, OSError) and error.strerror) or " ".join(str(error).split())
            raise PictureError(f"{path}: cannot be read as an array ({reason}); write it by numpy.save") from error
        if depth.ndim != 2 or depth.dtype.kind not in "fiu":
            kind = f"an array of shape {depth.shape}, {depth.dtype}"
            raise PictureError(f"{path}: {kind}; expected numbers (rows, columns), the distance of every pixel in mm")
        return depth.astype(np.float64)
    if depth_range is None:
        raise PictureError(f"{path}: a picture has levels and no distances; give `depth_range`, mm of black and white")
    near, far = depth_range
    if not 0 < near < far < np.inf:
        raise PictureError(f"{path}: a depth range of {near:g} to {far:g} mm; expected 0 < near < far, both finite")
    levels = read_levels(path, 1)[0]
    return near + (far - near) * (levels / np.iinfo(levels.dtype).max)


def write_picture(path: str | Path, channels: np.ndarray) -> None:
    """Write channels (1 or 3, H, W) in [0, 1] as a PNG file of 8 bits."""
    values = np.round(255 * channels).astype(np.uint8)
    picture = Image.fromarray(values[0] if len(values) == 1 else values.transpose(1, 2, 0))
    packed = io.BytesIO()
    picture.save(packed, format="PNG")
    write_atomically(Path(path), lambda file: file.write(packed.getvalue()))
