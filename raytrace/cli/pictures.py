"""Pictures of --data and --limit, read with a progress bar."""

import argparse
from collections.abc import Callable

from raytrace.cli.progress import progress
from raytrace.imaging.pictures import Pictures, files, read


def pictures_of(
    arguments: argparse.Namespace, least: int, leaves: Callable[[], Pictures], *, colour: bool = False
) -> tuple[Pictures, str]:
    """Pictures of at least `least` × `least` pixels and their kind: those of --data, else dead leaves."""
    if not arguments.data:
        return leaves(), "dead leaves"
    paths = files(arguments.data, arguments.limit)
    return read(paths, least=least, bar=lambda paths: progress(paths, "picture"), colour=colour), "pictures"
