"""`raytrace wave noise`: its words and options. Imports no torch before it runs."""

import argparse
import dataclasses

from raytrace.cli.options import file_name, json, output_folder
from raytrace.studies import options as rows
from raytrace.studies.edof.command import LIMIT, PICTURES
from raytrace.studies.options import add_options, documents, option, pictures

SUMMARY = "elements of extended depth of field over noise"
DESCRIPTION = """\
PSNR of restored pictures over 0.5 m to infinity for baselines and learned elements at several noises: elements are
learned, filters made and strengths chosen anew for each. Learned elements from several random starts, of which the one
of least expected error is kept; gains over the Fresnel lens with their 95 % intervals over pictures drawn with
replacement. What is learned is kept in FOLDER, if one is given: the same command goes on where it was stopped."""
EXAMPLES = """examples:
  raytrace wave noise --noises 0.01 --starts 1 --rows fresnel learned -o noise
  raytrace wave noise --rows fresnel --elements docs/wave/elements/learned-0.01.npy --noises 0.01
  raytrace wave noise --data pictures --limit 400 -o noise-of-pictures --docs docs"""


@dataclasses.dataclass(frozen=True)
class Settings(rows.Settings):
    """seed: of dead leaves, and of the samples of pictures that intervals are made from; starts have their own."""

    noise: tuple[float, ...] = option(
        (0.001, 0.002, 0.005, 0.01, 0.02),
        "standard deviations (default 0.001 0.002 0.005 0.01 0.02)",
        "S",
        name="noises",
    )
    starts: int = option(5, "random starts of every learned element")
    steps: int = option(300, "of learning")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rows", metavar="ROW", nargs="+", help="only these of `wave table` (default: all but --also)")
    parser.add_argument(
        "--elements",
        metavar="FILE",
        nargs="+",
        type=file_name,
        default=(),
        help="elements in files, heights of rings or smooth, judged beside the rows, as those of docs/wave/elements",
    )
    add_options(parser, Settings)
    pictures(parser, PICTURES, "seed", settings=Settings, limit=LIMIT)
    output_folder(parser, "folder of learned elements, and of what is judged")
    documents(parser, "wave_noise.md and wave/")
    json(parser)


run = "studies.edof.noise_report.noise"
