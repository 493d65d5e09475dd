"""The pictures of a study: those of a folder, or dead leaves where none is given."""

import argparse
from collections.abc import Callable

from raytrace.cli.progress import progress
from raytrace.formats.pictures import Pictures, files, read


def pictures(arguments: argparse.Namespace, least: int, leaves: Callable[[], Pictures]) -> tuple[Pictures, str]:
    """Pictures of --data, --limit of them, of `least` × `least` pixels or more, else leaves; and what they are."""
    if not arguments.data:
        return leaves(), "dead leaves"
    paths = files(arguments.data, arguments.limit)
    return read(paths, least=least, progress=lambda given: progress(given, "picture")), "pictures"
