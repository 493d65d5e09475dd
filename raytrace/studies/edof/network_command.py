"""`raytrace wave network`: its words and options. Imports no torch before it runs."""

import argparse
import dataclasses

from raytrace.cli.options import file_name, json, output_folder
from raytrace.studies import options as rows
from raytrace.studies.edof.command import LIMIT, PICTURES
from raytrace.studies.options import add_options, documents, option, pictures

SUMMARY = "what a small network brings behind the filter of an element"
DESCRIPTION = """\
A network of 10,000 weights (RED-Net, 6 layers of 16 maps) behind the best depth-invariant filter, told neither depth
nor colour: what it brings to baselines and to elements in files, which stay as they are. Learned from some pictures,
judged on others; gains with their 95 % intervals over pictures drawn with replacement. FOLDER keeps the networks: the
same command goes on where it was stopped."""
EXAMPLES = """examples:
  raytrace wave network --rows fresnel --steps 50 -o trial
  raytrace wave network --elements docs/wave/elements/learned-0.01.npy --data pictures -o networks --docs docs"""

USUAL = ("fresnel", "hybrid")  # rows


@dataclasses.dataclass(frozen=True)
class Settings(rows.Settings):
    """seed: of dead leaves, patches and noise."""

    noise: float = option(0.01, "standard deviation, of pictures from 0 to 1", "S")
    steps: int = option(400, "of learning")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rows", metavar="ROW", nargs="+", default=USUAL, help=f"baselines (default {' '.join(USUAL)})"
    )
    parser.add_argument(
        "--elements",
        metavar="FILE",
        nargs="+",
        type=file_name,
        default=(),
        help="elements in files, heights of rings or smooth",
    )
    add_options(parser, Settings)
    pictures(parser, PICTURES, "seed", settings=Settings, limit=LIMIT)
    output_folder(parser, "folder of networks", required=True)
    documents(parser, "wave_network.md and wave/")
    json(parser)


run = "studies.edof.network_report.networks"
