"""Pictures of --data and --limit, read with a progress bar."""

import argparse
from collections.abc import Callable

from raytrace.cli.progress import progress
from raytrace.imaging.pictures import Pictures, files, read


def pictures_of(arguments: argparse.Namespace, least: int, leaves: Callable[[], Pictures]) -> tuple[Pictures, str]:
    """Pictures of at least `least` × `least` pixels and their kind: those of --data, else dead leaves."""
    if not arguments.data:
        return leaves(), "dead leaves"
    return read(files(arguments.data, arguments.limit), least=least, bar=lambda paths: progress(paths, "picture")), (
        "pictures"
    )
