"""Outputs: files that a command would write, refused before the work where they cannot be, or are its input."""

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

from raytrace.cli.door import CommandError
from raytrace.cli.paths import InputFile, OutputFile, OutputFolder
from raytrace.files import check_output, check_output_folder
from raytrace.io import shipped_lens

#: An output that may be an input: a checkpoint replaces the one that is resumed.
_REPLACES = {("checkpoint", "resume")}


def check_outputs(arguments: argparse.Namespace) -> None:
    """Check every output of a command line. Raises CommandError and OSError.

    The folder exists and can be written in, the suffix is known, and no two options name one file.
    """
    seen = {_real(path): name for name, path in _paths(arguments, InputFile)}
    for name, path in _paths(arguments, OutputFile):
        other = seen.get(_real(path))
        if other is not None and (name, other) not in _REPLACES:
            options = (_option(arguments, one) for one in (name, other))
            raise CommandError("{} {}: is the file of {} too; give another name".format(next(options), path, *options))
        seen[_real(path)] = name
        try:
            check_output(path, tuple(path.suffixes))
        except ValueError as error:
            raise CommandError(f"{_option(arguments, name)} {error}") from error
    for name, path in _paths(arguments, OutputFolder):
        if path.may_be_file and _real(path) in seen:
            other = _option(arguments, seen[_real(path)])
            raise CommandError(f"{_option(arguments, name)} {path}: is the file of {other} too; give another name")
        check_output_folder(Path(path).parent if path.may_be_file else path)


def _paths(arguments: argparse.Namespace, kind: type[str]) -> Iterator[tuple[str, str]]:
    """Names and values of the arguments that are paths of a kind, single or in lists."""
    for name, value in vars(arguments).items():
        for one in value if isinstance(value, list | tuple) else [value]:
            if isinstance(one, kind):
                yield name, one


def _real(path: str) -> str:
    """The file that a name leads to: that of a shipped lens, where there is none in the folder."""
    return os.path.realpath(path if Path(path).exists() else shipped_lens(Path(path)) or path)


def _option(arguments: argparse.Namespace, name: str) -> str:
    return getattr(arguments, "spelled", {}).get(name, name.upper())
