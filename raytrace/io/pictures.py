"""Image files, decoded within limits of size."""

import io
import struct
import sys
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps, TiffImagePlugin, UnidentifiedImageError
from PIL.ImageFile import ImageFile

from raytrace.files import read_bytes, write_atomically
from raytrace.words import RaytraceError, RaytraceWarning, calling_level, option

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")
_FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "TIFF")
#: Tags of TIFF and their defaults: bits and format of the samples, number of samples, compression, planes.
_FLOAT_COLOURS = (258, ()), (339, ()), (277, 1), (259, 1), (284, 1)
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601
_ORIENTATION = 0x0112  # EXIF tag; 1: upright

#: Limits of bytes, of pixels, and of pixels per byte, which is that of deflate.
_MOST_BYTES, _MOST_PIXELS, _PIXELS_PER_BYTE = 2**28, 10**8, 1032
#: Pixels that are decoded at any ratio.
_FEW_PIXELS = 2**22
_MOST_ARRAY = 2**30  # bytes
#: Orders of the bytes of 16 bits, whose first byte PIL keeps of colours: exchanged, it keeps the second.
_EXCHANGED = {"16B": "16L", "16L": "16B", "16N": "16B" if sys.byteorder == "little" else "16L"}


class PictureError(RaytraceError, ValueError):
    """A file that is not an image, damaged, or too large; one line."""


class PictureChanged(RaytraceWarning):
    """A picture that is not shown as its pixels are stored: turned upright, or with transparent parts."""


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
    elif picture.mode == "F":  # which PIL would round to 0 and 1
        light = np.asarray(picture)
        if not (light.min() >= 0 and light.max() <= 1):
            raise PictureError(
                f"{path}: floating-point numbers from {light.min():g} to {light.max():g}; expected 0 to 1"
            )
        picture = Image.fromarray(np.round(255 * light).astype(np.uint8))
    return np.asarray(_on_black(picture).convert(mode))


def _on_black(picture: Image.Image) -> Image.Image:
    """The picture on a black ground, where it has transparent parts."""
    if not picture.has_transparency_data:
        return picture
    return Image.alpha_composite(Image.new("RGBA", picture.size, (0, 0, 0, 255)), picture.convert("RGBA"))


def _picture(path: str | Path, *, low_bytes: bool = False) -> Image.Image:
    try:
        picture = decoded(read_bytes(path, _MOST_BYTES), low_bytes=low_bytes)
    except (OSError, ValueError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or " ".join(str(error).split())
        message = f"{path}: cannot be read as a picture ({reason}); remove it or convert it"
        raise PictureError(message) from error
    changes = []
    if (orientation := picture.info["orientation"]) != 1:
        changes.append(f"turned upright, by its EXIF orientation {orientation}")
    if picture.has_transparency_data and np.asarray(picture.convert("RGBA"))[..., 3].min() < 255:
        changes.append("its transparent parts are shown on black")
    if changes and not low_bytes:
        warnings.warn(f"{path}: {'; '.join(changes)}", PictureChanged, stacklevel=calling_level())
    return picture


def decoded(content: bytes, *, low_bytes: bool = False) -> Image.Image:
    """The image in the bytes of a file of `SUFFIXES`; its size is checked before it is decoded. Raises PictureError.

    Colours of 16 bits have their high bytes, or their low ones; `info["raw_mode"]` is the layout of the file's pixels,
    `info["orientation"]` that of EXIF, by which the image is turned upright.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            file = Image.open(io.BytesIO(content), formats=_FORMATS)
            width, height = file.size
            count = width * height
            if count > _MOST_PIXELS or count > max(_FEW_PIXELS, _PIXELS_PER_BYTE * len(content)) or count < 1:
                size = f"{width} × {height} pixels in {len(content)} bytes"
                raise PictureError(f"{size}: damaged, or more than the {_MOST_PIXELS:.0e} that are read")
            layout = _raw_mode(file)
            if low_bytes:
                file.tile = [_exchanged(tile) for tile in file.tile]
            file.load()
            orientation = file.getexif().get(_ORIENTATION, 1)
            picture = file if orientation == 1 else ImageOps.exif_transpose(file)  # the turned copy has no tags
            picture.info |= {"raw_mode": layout, "orientation": orientation}
    except PictureError:
        raise
    except UnidentifiedImageError as error:
        raise PictureError(f"no picture of a layout that is read: expected {', '.join(_FORMATS)}") from error
    except Exception as error:  # decoders raise whatever their parsing meets, struct.error and KeyError too
        raise PictureError(" ".join(str(error).split())[:200] or type(error).__name__) from error
    return picture


def _raw_mode(picture: ImageFile) -> str:
    """PIL's name of the layout of a file's pixels, as "RGB;16B"; "" if it has none."""
    arguments: Any = picture.tile[0][3] if picture.tile else ""
    first = arguments[0] if isinstance(arguments, tuple) and arguments else arguments
    return first if isinstance(first, str) else ""


def _exchanged(tile: Any) -> Any:
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

    channels: 1 or 3, by default 1 of a grey file and 3 of a coloured one. A TIFF file of floating-point numbers is read
    as these, light.
    """
    if Path(path).suffix.lower() in (".tif", ".tiff") and (light := _float_colours(path)) is not None:
        return light if channels in (None, 3) else np.tensordot(_LUMA, light, 1)[None]
    picture = _picture(path)
    grey = picture.mode in ("1", "L", "LA", "I", "I;16", "I;16B", "I;16L", "F")
    channels = (1 if grey else 3) if channels is None else channels
    if channels not in (1, 3):
        raise PictureError(f"{path}: a picture has 1 or 3 channels, not {channels}")
    if picture.mode.startswith("I"):
        return np.repeat(_sixteen_bits(picture, path)[None], channels, 0)
    if picture.mode == "F":
        return np.repeat(np.asarray(picture)[None], channels, 0)
    if ";16" in picture.info["raw_mode"]:
        colours = _deep_colours(picture, path)
        return colours if channels == 3 else _luma(colours)[None]
    return np.atleast_3d(np.asarray(_on_black(picture).convert("L" if channels == 1 else "RGB"))).transpose(2, 0, 1)


def _float_colours(path: str | Path) -> np.ndarray | None:
    """Colours (3, H, W) of an uncompressed TIFF file of 32-bit floating-point numbers, which PIL does not decode."""
    try:
        content = read_bytes(path, _MOST_BYTES)
        directory = TiffImagePlugin.ImageFileDirectory_v2(content[:8])
        file = io.BytesIO(content)
        file.seek(directory.next)
        directory.load(file)
        layout = [directory.get(tag, default) for tag, default in _FLOAT_COLOURS]
        if layout != [(32,) * 3, (3,) * 3, 3, 1, 1]:
            return None
        columns, rows, starts, counts = (directory[tag] for tag in (256, 257, 273, 279))
        strips = b"".join(content[start : start + count] for start, count in zip(starts, counts, strict=True))
        order = "<" if content.startswith(b"II") else ">"
        return np.frombuffer(strips, order + "f4").reshape(rows, columns, 3).transpose(2, 0, 1).astype(np.float32)
    except (OSError, SyntaxError, ValueError, KeyError, TypeError, struct.error):
        return None  # `_picture` has the reason


def _deep_colours(picture: Image.Image, path: str | Path) -> np.ndarray:
    """Colours (3, H, W) of 16 bits, of which PIL decodes one byte at a time."""
    colours, _, order = picture.info["raw_mode"].partition(";")
    if colours not in ("RGB", "RGBA", "RGBX") or order not in _EXCHANGED:
        raise PictureError(
            f"{path}: pixels of the layout {colours} with 16 bits; expected grey or RGB ones: convert it"
        )
    high, low = (np.asarray(part).astype(np.uint16) for part in (picture, _picture(path, low_bytes=True)))
    levels = (256 * high + low).transpose(2, 0, 1)
    if colours != "RGBA":
        return levels[:3]
    return np.round(levels[:3] * (levels[3] / 65535.0)).astype(np.uint16)  # on black


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

    A TIFF file of floating-point numbers holds distances in mm.

    depth_range: (near, far) mm of the picture, linear in its levels. Raises PictureError naming the file.
    """
    if Path(path).suffix.lower() == ".npy":
        if depth_range is not None:
            raise PictureError(f"{path}: an array of distances in mm needs no {option('depth_range')}: leave it out")
        try:
            depth = np.load(io.BytesIO(read_bytes(path, _MOST_ARRAY)), allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            reason = (isinstance(error, OSError) and error.strerror) or " ".join(str(error).split())
            raise PictureError(f"{path}: cannot be read as an array ({reason}); write it by numpy.save") from error
        if depth.ndim != 2 or depth.dtype.kind not in "fiu":
            kind = f"an array of shape {depth.shape}, {depth.dtype}"
            raise PictureError(f"{path}: {kind}; expected numbers (rows, columns), the distance of every pixel in mm")
        return depth.astype(np.float64)
    tiff = Path(path).suffix.lower() in (".tif", ".tiff")
    levels = read_levels(path, 1)[0] if tiff else None
    if levels is not None and levels.dtype.kind == "f":
        if depth_range is not None:
            raise PictureError(f"{path}: floating-point distances in mm need no {option('depth_range')}: leave it out")
        return levels.astype(np.float64)
    if depth_range is None:
        raise PictureError(
            f"{path}: a picture has levels and no distances; give {option('depth_range')}, mm of black and white"
        )
    near, far = depth_range
    if not 0 < near < far < np.inf:
        raise PictureError(f"{path}: a depth range of {near:g} to {far:g} mm; expected 0 < near < far, both finite")
    levels = read_levels(path, 1)[0] if levels is None else levels
    return near + (far - near) * (levels / np.iinfo(levels.dtype).max)


def write_picture(path: str | Path, channels: np.ndarray, bits: int = 8) -> None:
    """Write channels (1 or 3, H, W) in [0, 1] as a PNG file of 8 or 16 bits."""
    most, kind = 2**bits - 1, np.uint8 if bits == 8 else np.dtype(">u2")
    rows = np.round(most * channels).astype(kind).transpose(1, 2, 0)
    (height, width), colour = rows.shape[:2], 0 if len(channels) == 1 else 2
    lines = np.zeros((height, 1 + rows[0].nbytes), np.uint8)  # each begins with its filter, 0
    lines[:, 1:] = np.ascontiguousarray(rows).view(np.uint8).reshape(height, -1)

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0))
    packed = b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(lines.tobytes(), 6)) + chunk(b"IEND", b"")
    write_atomically(Path(path), lambda file: file.write(packed))


def write_light(path: str | Path, light: np.ndarray) -> None:
    """Write light (C, H, W): .npy, an array of its type; .tif, 32-bit floating-point numbers of C samples a pixel."""
    packed = io.BytesIO()
    if Path(path).suffix.lower() == ".npy":
        np.save(packed, light, allow_pickle=False)
    else:
        packed.write(_tiff(light.astype("<f4").transpose(1, 2, 0)))
    write_atomically(Path(path), lambda file: file.write(packed.getvalue()))


def _tiff(pixels: np.ndarray) -> bytes:
    """An uncompressed TIFF file (revision 6.0) of pixels (H, W, C) of 32-bit floating-point numbers, one strip."""
    rows, columns, samples = pixels.shape
    shorts, start = 8, 8 + 4 * samples  # bits of each sample, then its format, 3: IEEE numbers; then the pixels
    pad = -4 * samples % 4
    numbers = struct.pack(f"<{2 * samples}H", *[32] * samples, *[3] * samples) + bytes(pad)
    content = pixels.tobytes()
    entries = [
        (256, 4, 1, columns), (257, 4, 1, rows), (258, 3, samples, shorts), (259, 3, 1, 1),
        (262, 3, 1, 2 if samples == 3 else 1), (273, 4, 1, start + pad), (277, 3, 1, samples), (278, 4, 1, rows),
        (279, 4, 1, len(content)), (284, 3, 1, 1), (339, 3, samples, shorts + 2 * samples),
    ]  # fmt: skip
    inline = {1: {258: 32, 339: 3}, 2: {258: 32 | 32 << 16, 339: 3 | 3 << 16}}.get(samples, {})  # up to 4 bytes
    entries = [(tag, kind, count, inline.get(tag, number)) for tag, kind, count, number in entries]
    body = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    end = start + pad + len(content)
    return struct.pack("<2sHI", b"II", 42, end) + numbers + content + struct.pack("<H", len(entries)) + body + bytes(4)
