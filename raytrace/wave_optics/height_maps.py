"""Height maps as files: the suffix selects the format; heights are in mm.

| suffix        | content                                                          | heights read back     |
|---------------|------------------------------------------------------------------|-----------------------|
| .npy          | the heights, then in a second array the pitch                    | bit for bit           |
| .csv          | x, y, sag or r, sag of every pixel or ring, mm                   | bit for bit           |
| .png, .tif(f) | 16-bit grey, scale and pitch in JSON as description              | to 1/131,070 of range |
| .dat, .grd    | grid sag of Zemax OpticStudio, pixels only, at least 5 × 5       | bit for bit           |

Steps of a quantised element, up to 256, are read back bit for bit from every format. Rows of pictures and of grid sags
run from the largest y down; those of `Pixels` and of the other files from the smallest y up. A sag is the height: that
of the rear face of a plate, light going towards +z. Glass, aperture and period are not in the files.
"""

import io
import json
import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image, PngImagePlugin

from raytrace.files import read_bytes, write_atomically
from raytrace.io.pictures import PictureError, decoded
from raytrace.maths.arrays import LARGEST, ArrayError, read_npy
from raytrace.wave_optics.element import Flat, Pixels, Profile, Rings
from raytrace.words import RaytraceError

#: The largest grey value of 16 bits.
_WHITE = 65535
#: At most so many different heights are listed in a picture's description, to be read back exactly.
_LISTED = 256
#: TIFF tag of the description.
_DESCRIPTION = 270
_NO_PITCH = "has no pitch; give pitch in mm"
#: Length unit of a grid sag, in mm, by its flag.
_UNITS = {0: 1.0, 1: 10.0, 2: 25.4, 3: 1000.0}


class HeightMapError(RaytraceError, ValueError):
    """A height map that cannot be read or written; the message has file, line, defect and remedy."""

    def __init__(self, message: str, file: str, line: int | None = None):
        place = file if line is None else f"{file}:{line}"
        super().__init__(f"{place}: {message}")
        self.file, self.line = file, line


class Known(NamedTuple):
    """Data of a file without description: pitch mm, and the heights mm of black and white."""

    pitch: float | None = None
    span: tuple[float, float] | None = None


class Format(NamedTuple):
    """read(content, file, known) -> profile; write(profile, file) -> content."""

    read: Callable[[bytes, str, Known], Flat]
    write: Callable[[Flat, str], bytes]


def read_heights(
    path: str | os.PathLike, *, pitch: float | None = None, span: tuple[float, float] | None = None
) -> Flat:
    """The height map of a file, float64 (an .npy keeps its own precision): Pixels, or Rings of a round one.

    pitch: mm, for a file without it; span: heights mm of grey 0 and 65535, for a picture without description. Raises
    HeightMapError with file and line.
    """
    file = str(path)
    form = _format(file)
    try:
        content = read_bytes(path, LARGEST)
    except OSError as error:
        raise HeightMapError(f"cannot be read: {error.strerror or error}", file) from error
    if not content:
        raise HeightMapError("is empty", file)
    profile = form.read(content, file, Known(pitch, span))
    _check(profile, file)
    return profile


def write_heights(profile: Profile, path: str | os.PathLike) -> None:
    """Write a height map in the format of the suffix. The file is replaced as a whole or not at all.

    Raises HeightMapError for data that the format cannot hold and where the file cannot be written.
    """
    file = str(path)
    form = _format(file)
    if not isinstance(profile, Pixels | Rings):
        kind = type(profile).__name__
        raise HeightMapError(f"a profile of {kind} is no height map; sample it with as_pixels or as_rings first", file)
    _check(profile, file)
    content = form.write(profile, file)
    try:
        write_atomically(path, lambda stream: stream.write(content))
    except OSError as error:
        raise HeightMapError(error.strerror or str(error), file) from error


def _write_npy(profile: Flat, file: str) -> bytes:
    stream = io.BytesIO()
    np.save(stream, _array(profile), allow_pickle=False)
    np.save(stream, np.array([float(profile.pitch)]), allow_pickle=False)
    return stream.getvalue()


def _read_npy(content: bytes, file: str, known: Known) -> Flat:
    try:
        heights, *rest = read_npy(content)
    except ArrayError as error:
        raise HeightMapError(f"is no .npy file of heights: {error}", file) from error
    if heights.dtype.kind not in "fiu" or heights.dtype.itemsize > 8:
        raise HeightMapError(f"holds numbers of type {heights.dtype}; expected heights in mm", file)
    if rest and (rest[0].shape != (1,) or rest[0].dtype.kind != "f" or len(rest) > 1):
        raise HeightMapError("holds more than heights and one pitch in mm; is it damaged?", file)
    # A file of another program ends with the heights.
    pitch = float(rest[0][0]) if rest else known.pitch
    heights = heights if heights.dtype in (np.float32, np.float64) else heights.astype(np.float64)
    return _profile(heights.astype(heights.dtype.newbyteorder("=")), pitch, file)


def _write_picture(profile: Flat, file: str, kind: str) -> bytes:
    """A picture of a kind, "PNG" or "TIFF": 16-bit grey, the largest y on top, and a description."""
    heights = np.atleast_2d(_array(profile).astype(np.float64))[::-1]
    low, high = float(heights.min()), float(heights.max())
    scale = (high - low) / _WHITE
    grey = np.zeros(heights.shape) if scale == 0 else np.rint((heights - low) / (high - low) * _WHITE)
    description = {"unit": "mm", "offset": low, "scale": scale, "pitch": float(profile.pitch)}
    description["profile"] = "rings" if isinstance(profile, Rings) else "pixels"
    steps = np.unique(heights)
    if len(steps) <= _LISTED and len(np.unique(grey)) == len(steps):
        description["heights"] = steps.tolist()
    stream, info, text = io.BytesIO(), PngImagePlugin.PngInfo(), json.dumps(description)
    info.add_text("Description", text)
    Image.fromarray(grey.astype(np.uint16)).save(stream, kind, pnginfo=info, tiffinfo={_DESCRIPTION: text})
    return stream.getvalue()


def _read_picture(content: bytes, file: str, known: Known) -> Flat:
    try:
        picture = decoded(content)
    except PictureError as error:
        raise HeightMapError(f"cannot be read as a picture ({error})", file) from error
    if not picture.mode.startswith("I"):
        raise HeightMapError(f"is a picture of mode {picture.mode}; expected grey values of 16 bits", file)
    text = picture.info.get("Description") or getattr(picture, "tag_v2", {}).get(_DESCRIPTION) or ""
    meaning = _meaning(text, file, known)
    grey = np.array(picture).astype(np.int64)
    with np.errstate(all="ignore"):  # heights that are not finite are refused below
        heights = meaning["offset"] + meaning["scale"] * grey
    if "heights" in meaning:  # as many as there are different grey values, in the same order
        values, place = np.unique(grey, return_inverse=True)
        if len(values) != len(meaning["heights"]):
            count = len(meaning["heights"])
            raise HeightMapError(f"has {len(values)} grey values, but its description lists {count} heights", file)
        heights = np.array(meaning["heights"], np.float64)[place.reshape(grey.shape)]
    if meaning["profile"] == "rings" and len(heights) != 1:
        raise HeightMapError(f"has a description of rings, but {len(heights)} rows", file)
    heights = heights[0] if meaning["profile"] == "rings" else heights[::-1]
    return _profile(heights, meaning["pitch"], file)


def _meaning(text: str, file: str, known: Known) -> dict:
    """The description of a picture; for one without, the data that the caller gives."""
    try:
        description = json.loads(text)
        numbers = {key: float(description[key]) for key in ("offset", "scale", "pitch")}
        listed = {"heights": [float(h) for h in description["heights"]]} if "heights" in description else {}
        if description["profile"] not in ("rings", "pixels"):
            raise KeyError(description["profile"])
        return {"profile": description["profile"], **numbers, **listed}
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        if known.span is None:
            remedy = "give span (heights in mm of black and white) and pitch"
            raise HeightMapError(f"has no description of its grey values; {remedy}", file) from error
    low, high = known.span
    return {"profile": "pixels", "offset": low, "scale": (high - low) / _WHITE, "pitch": known.pitch}


def _write_csv(profile: Flat, file: str) -> bytes:
    pitch, heights = float(profile.pitch), _array(profile)
    if isinstance(profile, Rings):
        lines = ["r_mm,sag_mm", *(f"{(k + 0.5) * pitch!r},{h!r}" for k, h in enumerate(heights.tolist()))]
    else:
        y, x = ([repr((i - 0.5 * (count - 1)) * pitch) for i in range(count)] for count in heights.shape)
        points = ((b, a, h) for b, row in zip(y, heights.tolist(), strict=True) for a, h in zip(x, row, strict=True))
        lines = ["x_mm,y_mm,sag_mm", *(f"{a},{b},{h!r}" for b, a, h in points)]
    return ("\n".join(lines) + "\n").encode()


def _read_csv(content: bytes, file: str, known: Known) -> Flat:
    lines = _text(content, file).split("\n")
    head = [name.strip().lower().removesuffix("_mm") for name in lines[0].split(",")]
    if head not in (["r", "sag"], ["x", "y", "sag"]):
        header = lines[0][:60]
        raise HeightMapError(f"begins with {header!r}; expected the header x_mm,y_mm,sag_mm or r_mm,sag_mm", file, 1)
    table = _numbers(lines[1:], file, first=2, counts=(len(head),), separator=",")
    if not np.isfinite(table[:, :-1]).all():
        row = int(np.flatnonzero(~np.isfinite(table[:, :-1]).all(1))[0])
        raise HeightMapError(f"reads {lines[row + 1][:60]!r}; expected finite places", file, row + 2)
    if len(head) == 2:
        width = 2 * float(table[0, 0])
        _expect(table[:, 0], (np.arange(len(table)) + 0.5) * width, width, "r", file, np.arange(len(table)) + 2)
        return _profile(table[:, 1], width, file)
    columns = int((table[:, 1] == table[0, 1]).sum())
    rows, rest = divmod(len(table), columns)
    if rest:
        raise HeightMapError(f"has {len(table)} points, no whole number of rows of {columns}", file, len(table) + 1)
    pitch = known.pitch  # a single pixel has none
    if len(table) > 1:
        axis, count = (0, columns) if columns > 1 else (1, rows)
        pitch = float(f"{(table[-1, axis] - table[0, axis]) / (count - 1):.15g}")
        if pitch <= 0:
            ends = f"{table[0, axis]:g} to {table[-1, axis]:g} mm"
            raise HeightMapError(f"has {'xy'[axis]} from {ends}; expected increasing coordinates", file)
    if pitch is None:
        raise HeightMapError(_NO_PITCH, file)
    line = np.arange(len(table)) + 2
    x, y = np.tile(np.arange(columns), rows), np.repeat(np.arange(rows), columns)
    _expect(table[:, 0], (x - 0.5 * (columns - 1)) * pitch, pitch, "x", file, line)
    _expect(table[:, 1], (y - 0.5 * (rows - 1)) * pitch, pitch, "y", file, line)
    return _profile(table[:, 2].reshape(rows, columns), pitch, file)


def _expect(values: np.ndarray, wanted: np.ndarray, pitch: float, name: str, file: str, lines: np.ndarray) -> None:
    wrong = np.flatnonzero(~(np.abs(values - wanted) <= 1e-3 * abs(pitch)))
    if len(wrong):
        k = wrong[0]
        message = f"has {name} = {values[k]:g} mm; expected {wanted[k]:g} on an even grid around the axis, x first"
        raise HeightMapError(message, file, int(lines[k]))


def _write_grid(profile: Flat, file: str) -> bytes:
    """nx ny delx dely unitflag xdec ydec; then a line z dz/dx dz/dy d²z/dxdy nodata a point, from (-x, +y) on, x first.

    (OpticStudio Help, "Grid Sag".) Where all slopes are 0 the program estimates them; nodata 0 is a valid point.
    """
    if isinstance(profile, Rings):
        raise HeightMapError("a grid sag holds no rings; sample the element with as_pixels first", file)
    heights, pitch = _array(profile), float(profile.pitch)
    rows, columns = heights.shape
    if min(rows, columns) < 5:
        raise HeightMapError(f"a grid sag needs 5 × 5 points at least; found {rows} × {columns}", file)
    lines = [f"{columns} {rows} {pitch!r} {pitch!r} 0 0 0"]
    lines += [f"{height!r} 0 0 0 0" for row in heights[::-1].tolist() for height in row]
    return ("\r\n".join(lines) + "\r\n").encode()


def _read_grid(content: bytes, file: str, known: Known) -> Flat:
    lines = [(k, line) for k, line in enumerate(_text(content, file).split("\n"), 1) if not line.startswith("!")]
    if not lines:
        raise HeightMapError("holds comments only; expected a grid sag", file)
    first, head = lines[0]
    nx, ny, delx, dely, unit, *decentre = _numbers([head], file, first=first, counts=(5, 7), separator=None)[0].tolist()
    if unit not in _UNITS:
        raise HeightMapError(f"has the unit flag {unit:g}; expected 0 mm, 1 cm, 2 inch or 3 m", file, first)
    if abs(delx) != abs(dely) or any(decentre):
        steps = f"steps of {delx:g}, {dely:g} and decentres {decentre}"
        raise HeightMapError(f"has {steps}; only square grids around the axis are read", file, first)
    if nx * ny != len(lines) - 1 or min(nx, ny) < 1 or nx % 1 or ny % 1:
        raise HeightMapError(f"announces {nx:g} × {ny:g} points, but holds {len(lines) - 1}", file, first)
    table = _numbers([line for _, line in lines[1:]], file, first=lines[1][0], counts=(1, 4, 5), separator=None)
    missing = table[:, 4] != 0 if table.shape[1] == 5 else np.zeros(len(table), bool)
    # Points without data count as none of the sag, as in the program that wrote them.
    heights = np.where(missing, 0.0, table[:, 0] * _UNITS[unit]).reshape(int(ny), int(nx))
    return _profile(heights[::-1], abs(delx) * _UNITS[unit], file)


_PNG, _TIFF = (Format(_read_picture, partial(_write_picture, kind=kind)) for kind in ("PNG", "TIFF"))
_GRID = Format(_read_grid, _write_grid)
#: The formats by suffix, in lower case.
FORMATS = {".npy": Format(_read_npy, _write_npy), ".png": _PNG, ".tif": _TIFF, ".tiff": _TIFF}
FORMATS |= {".csv": Format(_read_csv, _write_csv), ".dat": _GRID, ".grd": _GRID}


def _format(file: str) -> Format:
    suffix = Path(file).suffix.lower()
    if suffix not in FORMATS:
        defect = f"the suffix {suffix!r} is unknown" if suffix else "has no suffix"
        raise HeightMapError(f"{defect}; expected a height map, one of {', '.join(FORMATS)}", file)
    return FORMATS[suffix]


def _array(profile: Flat) -> np.ndarray:
    return profile.heights.detach().cpu().numpy()


def _profile(heights: np.ndarray, pitch: float | None, file: str) -> Flat:
    if pitch is None:
        raise HeightMapError(_NO_PITCH, file)
    tensor = torch.from_numpy(np.array(heights, order="C"))
    kind = Rings if heights.ndim == 1 else Pixels
    return kind(tensor, torch.tensor(pitch, dtype=tensor.dtype))


def _check(profile: Flat, file: str) -> None:
    """Refuse an invalid height map: wrong number of axes, no points, numbers that are not finite, no pitch."""
    heights, axes = profile.heights, 1 if isinstance(profile, Rings) else 2
    if heights.ndim != axes or not heights.numel():
        kind = "rings (R,)" if axes == 1 else "pixels (rows, columns)"
        raise HeightMapError(f"has heights of the shape {tuple(heights.shape)}; expected {kind}", file)
    wrong = int((~torch.isfinite(heights)).sum())
    if wrong:
        raise HeightMapError(f"has {wrong} heights that are not finite; replace them first", file)
    if not 0 < float(profile.pitch) < math.inf:
        raise HeightMapError(f"has a pitch of {float(profile.pitch):g} mm; expected a positive one", file)


def _text(content: bytes, file: str) -> str:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise HeightMapError(f"is no text at byte {error.start}; save it as UTF-8", file) from error
    return text.replace("\r\n", "\n").replace("\r", "\n").rstrip()


def _numbers(lines: list[str], file: str, *, first: int, counts: tuple[int, ...], separator: str | None) -> np.ndarray:
    """Numbers (lines, count) of lines that all hold the same count, one of `counts`. first: the number of lines[0]."""
    if not lines:
        raise HeightMapError("holds no points", file)
    try:  # at once; where that fails, line by line to find the line
        table = np.loadtxt(lines, delimiter=separator, comments=None, ndmin=2)
        if table.shape[0] == len(lines) and table.shape[1] in counts:
            return table
    except ValueError:
        pass
    rows = []
    for number, line in enumerate(lines, first):
        try:
            rows.append([float(part) for part in line.split(separator)])
        except ValueError as error:
            raise HeightMapError(f"reads {line[:60]!r}; expected numbers", file, number) from error
        if len(rows[-1]) != len(rows[0]) or len(rows[0]) not in counts:
            expected = len(rows[0]) if len(rows[0]) in counts else " or ".join(map(str, counts))
            raise HeightMapError(f"has {len(rows[-1])} numbers; expected {expected}", file, number)
    return np.array(rows)
