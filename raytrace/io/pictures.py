"""Image files, decoded within limits of size."""

import io
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


class PictureError(ValueError):
    """A file that is not an image, damaged, or too large; one line."""


def read_grey(path: str | Path) -> np.ndarray:
    """An image as (H, W) luma of 8 bits (ITU-R BT.601). Raises PictureError naming the file."""
    return _pixels(path, "L")


def _pixels(path: str | Path, mode: str) -> np.ndarray:
    try:
        return np.asarray(decoded(read_bytes(path, _MOST_BYTES)).convert(mode))
    except (OSError, ValueError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or " ".join(str(error).split())
        message = f"{path}: cannot be read as a picture ({reason}); remove it or convert it"
        raise PictureError(message) from error


def decoded(content: bytes) -> Image.Image:
    """The image in the bytes of a file of `SUFFIXES`; its size is checked before it is decoded. Raises PictureError."""
    try:
        with warnings.catch_warnings(action="ignore"):
            picture = Image.open(io.BytesIO(content), formats=("JPEG", "PNG", "BMP", "TIFF"))
            width, height = picture.size
            count = width * height
            if count > _MOST_PIXELS or count > max(_FEW_PIXELS, _PIXELS_PER_BYTE * len(content)) or count < 1:
                size = f"{width} × {height} pixels in {len(content)} bytes"
                raise PictureError(f"{size}: damaged, or more than the {_MOST_PIXELS:.0e} that are read")
            picture.load()
    except PictureError:
        raise
    except Exception as error:  # decoders raise whatever their parsing meets, struct.error and KeyError too
        raise PictureError(" ".join(str(error).split())[:200] or type(error).__name__) from error
    return picture


def read_channels(path: str | Path, channels: int) -> np.ndarray:
    """A picture as (channels, H, W) in [0, 1], float64: luma for one channel, red, green and blue for three.

    Raises PictureError for a file that is no picture, and for another number of channels.
    """
    if channels not in (1, 3):
        raise PictureError(f"{path}: a picture has 1 or 3 channels, not one for each of {channels} wavelengths")
    picture = _pixels(path, "L" if channels == 1 else "RGB")
    return np.atleast_3d(picture).transpose(2, 0, 1) / 255.0


def write_picture(path: str | Path, channels: np.ndarray) -> None:
    """Write channels (1 or 3, H, W) in [0, 1] as a PNG file of 8 bits."""
    values = np.round(255 * channels).astype(np.uint8)
    picture = Image.fromarray(values[0] if len(values) == 1 else values.transpose(1, 2, 0))
    packed = io.BytesIO()
    picture.save(packed, format="PNG")
    write_atomically(Path(path), lambda file: file.write(packed.getvalue()))
