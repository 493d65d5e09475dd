"""Paths among the arguments: which are read and which are written. No torch."""

import argparse
from collections.abc import Callable, Iterable
from pathlib import PurePath

PICTURES = (".png", ".pdf", ".svg")


class InputFile(str):
    """The name of a file that is read, or of something that a file may be given for."""

    __slots__ = ()


class OutputFile(str):
    """The name of a file that is written; suffixes: those that it may have, any if there are none."""

    suffixes: Iterable[str] = ()


class OutputFolder(str):
    """The name of a folder that is written in; may_be_file: or of a file, next to a folder without its suffix."""

    may_be_file: bool = False


def file_name(text: str) -> InputFile:
    """The name of a file to read; an empty one is refused."""
    if not text:
        raise argparse.ArgumentTypeError("the name of the file is empty")
    return InputFile(text)


def output_file(text: str) -> OutputFile:
    """The name of a file to write; an empty one is refused."""
    return OutputFile(file_name(text))


def folder_name(text: str) -> OutputFolder:
    """The name of a folder to write in; that of a picture is refused."""
    return OutputFolder(data_file(text))


def folder_or_lens(text: str) -> OutputFolder:
    """The name of a folder to write in, or of a lens file next to it."""
    folder = folder_name(text)
    folder.may_be_file = bool(PurePath(text).suffix)
    return folder


def data_file(text: str) -> OutputFile:
    """The name of a file of data to write; that of a picture is refused."""
    if PurePath(file_name(text)).suffix.lower() in PICTURES:
        raise argparse.ArgumentTypeError(f"{text!r} is a picture: figures are saved by --plot, data by -o")
    return OutputFile(text)


def file_of(suffixes: Iterable[str]) -> Callable[[str], OutputFile]:
    """What reads the name of a file of data to write, with one of these suffixes."""

    def reader(text: str) -> OutputFile:
        found = data_file(text)
        found.suffixes = suffixes
        return found

    return reader


def picture_file(text: str) -> OutputFile:
    """The name of a figure: .png, .pdf or .svg."""
    if PurePath(file_name(text)).suffix.lower() not in PICTURES:
        listed = ", ".join(PICTURES)
        raise argparse.ArgumentTypeError(
            f"{text!r} is no picture ({listed}); data are written by -o, where there is one"
        )
    return OutputFile(text)
