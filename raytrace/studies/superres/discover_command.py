"""`raytrace wave discover`: its words and options. Imports no torch."""

import argparse
import dataclasses

from raytrace.cli.options import json, output_folder, plot
from raytrace.studies import options as rows
from raytrace.studies.options import add_options, documents, option, pictures
from raytrace.studies.superres.command import cameras, sensor_noise

LIMIT = 100  # pictures
SUMMARY = "learn places of a small scene that nobody prescribes"
DESCRIPTION = """\
A plate before the plain lens, learned for a small scene on a dark ground by the exact error of the best linear
restoration from all pixels of a wide sensor: nothing says that the scene should be shown more than once, nor where.
From the plain lens, from random paths around it, and, beside them, from four prescribed places. 5 mm, sensor at
35.5 mm, 1 m, scenes of 16 × 16 pixels of 3.69 µm, sensor pixels twice as large."""
EXAMPLES = """examples:
  raytrace wave discover --starts 1 --steps 30 --json
  raytrace wave discover --wavelength 0.46 0.55 0.64 --steps 200 -o discover --plot places.png
  raytrace wave discover --steps 200 -o discover --docs docs"""


@dataclasses.dataclass(frozen=True)
class Settings(rows.Settings):
    """wavelength: of every camera; spread: RMS of the random starts."""

    wavelength: tuple[list[float], ...] = cameras()
    noise: float = sensor_noise()
    spread: tuple[float, ...] = option((0.1, 0.5), "RMS of random starts in waves (default 0.1 0.5)", "RMS")
    starts: int = option(3, "random starts of each")
    steps: int = option(150, "of learning")


def options(parser: argparse.ArgumentParser) -> None:
    add_options(parser, Settings)
    what = "folder of pictures of 96 × 96 pixels or more; four fifths make the restoration, the others are restored"
    pictures(parser, what, "seed", limit=LIMIT)
    output_folder(parser, "folder of learned plates")
    documents(parser, "wave_discover.md and wave/")
    plot(parser, "kernels of the plates")
    json(parser)


run = "studies.superres.discover_report.discover_places"
