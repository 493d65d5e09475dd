"""The folder of the server: names of files lead nowhere else, and files are replaced only by request."""

import argparse
import os
from pathlib import Path

from raytrace.cli.runner import paths
from raytrace.cli.types import InputFile, OutputFile, OutputFolder
from raytrace.words import RaytraceError


class RefusedFile(RaytraceError, ValueError):
    """A file outside the folder of the server, or one that exists and would be replaced."""


def check_files(arguments: argparse.Namespace, folder: Path, *, overwrite: bool) -> None:
    """Check every file of a command line before the work; folder: the present one. Raises RefusedFile."""
    for name, path in paths(arguments, InputFile):
        _below(folder, name, path)
    for name, written in paths(arguments, OutputFile):
        if _below(folder, name, written).exists() and not overwrite:
            raise RefusedFile(f"`{name}`: {written} exists; give another name, or `overwrite`")
    for name, filled in paths(arguments, OutputFolder):
        target = _below(folder, name, filled)
        inside = [Path(root, entry) for root, *entries in os.walk(target) for part in entries for entry in part]
        if inside and not overwrite:
            raise RefusedFile(f"`{name}`: the folder {filled} is not empty; give another name, or `overwrite`")
        for entry in inside:
            _below(folder, name, str(entry))


def _below(folder: Path, name: str, path: str) -> Path:
    """The file that a name and its links lead to."""
    try:
        target = (folder / path).resolve()
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, a zero byte
        raise RefusedFile(f"`{name}`: {path!r} is no name of a file") from error
    if ".." in Path(path).parts or not target.is_relative_to(folder.resolve()):
        raise RefusedFile(
            f"`{name}`: {path} is outside the folder of this server; expected a path below it, without .."
        )
    if target.exists() and not target.is_file() and not target.is_dir():
        raise RefusedFile(f"`{name}`: {path} is no regular file")
    return target
