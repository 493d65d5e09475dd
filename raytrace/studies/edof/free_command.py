"""`raytrace wave free`: its words and options. Imports no torch before it runs."""

import argparse
import dataclasses

from raytrace.cli.options import file_name, json, output_folder, plot
from raytrace.studies import options as rows
from raytrace.studies.edof.command import LIMIT, PICTURES
from raytrace.studies.options import add_options, documents, option, pictures

SUMMARY = "learn free heights, symmetry not assumed"
DESCRIPTION = """\
What giving up symmetry brings to an element of extended depth of field: maps of pixels of fused silica, every height
free, learned from rings with a small random change, from a cubic plate on a lens and from random polynomials on a lens;
beside them the same rings learned on for as many steps. Judged on pictures behind two filters; gains with their 95 %
intervals. FOLDER keeps what is learned: the same command goes on where it was stopped."""
EXAMPLES = """examples:
  raytrace wave free --from docs/wave/elements/learned-0.01.npy --start rings --feature 0.01 --steps 20 -o trial
  raytrace wave free --from docs/wave/elements/learned-0.01.npy --data pictures --limit 400 -o free --docs docs"""


@dataclasses.dataclass(frozen=True)
class Settings(rows.Settings):
    """feature: mm; rate: µm a step; seed: of dead leaves and of random changes."""

    starts: tuple[str, ...] = option(
        ("rings", "cubic", "random"),
        "where maps begin (default all)",
        name="start",
        choices=("rings", "cubic", "random"),
        metavar="START",
    )
    feature: float = option(2e-3, "size of a pixel", "MM")
    noise: float = option(0.01, "standard deviation, of pictures from 0 to 1", "S")
    steps: int = option(200, "of learning")
    rate: float = option(0.02, "learning rate, µm a step", "R")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--from",
        dest="rings",
        metavar="FILE",
        type=file_name,
        required=True,
        help="rings that maps and control begin from, as those of docs/wave/elements",
    )
    add_options(parser, Settings)
    pictures(parser, PICTURES, "seed", settings=Settings, limit=LIMIT)
    output_folder(parser, "folder of learned heights, and of what is judged", required=True)
    documents(parser, "wave_free.md and wave/")
    json(parser)
    plot(parser, "heights, and PSFs over depth")


run = "studies.edof.free_report.free"
