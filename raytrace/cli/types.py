"""Readers of the values of options: each reads a text, or raises ArgumentTypeError. Imports no torch."""

import argparse
from collections.abc import Callable
from pathlib import Path, PurePath
from typing import TypeAlias

from raytrace.settings import DRAWINGS, REPORTS

Reader: TypeAlias = Callable[[str], object]

PICTURES = (".png", ".pdf", ".svg")


# -- files


class InputFile(str):
    """Name of a file that is read, or of a library item that a file may replace."""

    __slots__ = ()


class OutputFile(str):
    """Name of a file that is written; suffixes: those allowed, any if empty."""

    suffixes: tuple[str, ...] = ()


class OutputFolder(str):
    """Name of a folder that is written; may_be_file: or of a file, next to a folder of that name without suffix."""

    may_be_file: bool = False


def file_name(text: str) -> InputFile:
    """A file to read."""
    if not text:
        raise argparse.ArgumentTypeError("the name of the file is empty")
    return InputFile(text)


def output_file(text: str) -> OutputFile:
    """A file to write."""
    return OutputFile(file_name(text))


def data_file(text: str) -> OutputFile:
    """A data file to write; the suffix of a picture is refused."""
    if PurePath(file_name(text)).suffix.lower() in PICTURES:
        raise argparse.ArgumentTypeError(f"{text!r} is a picture: figures are saved by --plot, data by -o")
    return OutputFile(text)


def file_of(*suffixes: str) -> Callable[[str], OutputFile]:
    """The reader of a data file to write with one of these suffixes."""

    def reader(text: str) -> OutputFile:
        file = data_file(text)
        file.suffixes = suffixes
        return file

    return reader


def _file_named(text: str, suffixes: tuple[str, ...], kind: str) -> OutputFile:
    """A file to write whose name ends in one of the suffixes; kind: of its content, for the message."""
    file = output_file(text)
    file.suffixes = suffixes
    if PurePath(text).suffix.lower() not in suffixes:
        raise argparse.ArgumentTypeError(f"{text!r} is no {kind}: expected a name that ends in {', '.join(suffixes)}")
    return file


def drawing_file(text: str) -> OutputFile:
    """A drawing, or solids, to write."""
    return _file_named(text, DRAWINGS, "drawing")


def report_file(text: str) -> OutputFile:
    """A report to write."""
    return _file_named(text, REPORTS, "report")


def lens_file(text: str) -> OutputFile:
    """A lens file to write."""
    from raytrace.io import WRITTEN  # loads torch

    return file_of(*WRITTEN)(text)


def picture_file(text: str) -> OutputFile:
    """A figure to write: .png, .pdf or .svg."""
    if PurePath(file_name(text)).suffix.lower() not in PICTURES:
        listed = ", ".join(PICTURES)
        raise argparse.ArgumentTypeError(
            f"{text!r} is no picture ({listed}); data are written by -o, where there is one"
        )
    return OutputFile(text)


def folder_name(text: str) -> OutputFolder:
    """A folder to write in."""
    return OutputFolder(data_file(text))


def folder_or_lens(text: str) -> OutputFolder:
    """A folder to write in, or a lens file next to it."""
    folder = folder_name(text)
    folder.may_be_file = bool(PurePath(text).suffix)
    return folder


def picture_or_folder(text: str) -> OutputFile | OutputFolder:
    """A picture to write (.png, .tif, .npy), or a folder of pictures."""
    suffix = PurePath(file_name(text)).suffix.lower()
    if suffix not in ("", ".png", ".tif", ".npy"):
        raise argparse.ArgumentTypeError(f"{text!r}: expected a picture that ends in .png, .tif or .npy, or a folder")
    if not suffix or Path(text).is_dir():
        return OutputFolder(text)
    file = OutputFile(text)
    file.suffixes = (".png", ".tif", ".npy")
    return file


# -- numbers


def positive(text: str) -> float:
    """A number above 0; `inf` allowed."""
    number = _number(text)
    if not number > 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not above 0")
    return number


def finite(text: str) -> float:
    """A finite number."""
    number = _number(text)
    if number in (float("inf"), float("-inf")):
        raise argparse.ArgumentTypeError(f"{text!r} is not finite")
    return number


def positive_finite(text: str) -> float:
    """A finite number above 0."""
    finite(text)
    return positive(text)


def criterion_value(text: str) -> float:
    """A finite value above 0 of a criterion; a percentage is refused."""
    if text.endswith("%"):
        raise argparse.ArgumentTypeError(f"{text!r} is no value of the criterion; a share of the lenses is --yield 0.9")
    return positive_finite(text)


def not_negative(text: str) -> float:
    """A finite number, 0 or more."""
    number = finite(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"{text!r} is below 0")
    return number


def count(text: str) -> int:
    """A whole number above 0."""
    number = _whole(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not above 0")
    return number


def count_or_none(text: str) -> int:
    """A whole number, or 0 for none."""
    number = _whole(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"{text!r} is below 0")
    return number


def count_or_all(text: str) -> int | str:
    """A whole number above 0, or `all`."""
    return text if text == "all" else count(text)


def many(text: str) -> int:
    """A whole number above 0, also written as 1e9."""
    number = finite(text)
    if number < 1 or number != int(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text) if text.isdigit() else int(number)


def memory(text: str) -> int:
    """A number of bytes, with kB, MB or GB behind it (10³, 10⁶, 10⁹) or without."""
    units = {"kb": 10**3, "mb": 10**6, "gb": 10**9, "b": 1}
    unit = next((u for u in units if text.lower().endswith(u)), "")
    try:
        number = float(text[: len(text) - len(unit)])
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of bytes, as 200MB") from None
    if not 1 <= number * units.get(unit, 1) < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of bytes above 0")
    return int(number * units.get(unit, 1))


def seed_number(text: str) -> int:
    """A whole number that seeds a generator: 0 to 2⁶³ - 1."""
    number = _whole(text)
    if not 0 <= number < 2**63:
        raise argparse.ArgumentTypeError(f"{text!r} is not from 0 to 2**63 - 1")
    return number


def field_point(text: str) -> tuple[float, float]:
    """A field point (x, y): `Y` alone, or `X,Y`."""
    parts = text.split(",")
    if len(parts) > 2:
        raise argparse.ArgumentTypeError(f"{text!r} is not a field point, Y or X,Y; several have spaces between them")
    x, y = (0.0, finite(text)) if len(parts) == 1 else map(finite, parts)
    return x, y


def extent(text: str) -> tuple[float, float]:
    """Width and height, as 24x16."""
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f"{text!r} is no width and height in mm, as 24x16")
    width, height = map(positive_finite, parts)
    return width, height


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None


def _number(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        hint = "; a share is written as 0.9" if text.endswith("%") else ""
        raise argparse.ArgumentTypeError(f"{text!r} is not a number{hint}") from None
    if number != number:
        raise argparse.ArgumentTypeError("nan is not a number to work with")
    return number
