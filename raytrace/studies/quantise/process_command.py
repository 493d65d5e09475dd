"""`raytrace wave etch`: its words and options. Imports no torch before it runs."""

import argparse
import dataclasses

from raytrace.cli.options import json, output_folder
from raytrace.studies import options as rows
from raytrace.studies.edof.command import LIMIT, PICTURES
from raytrace.studies.edof.settings import NANOMETRE, nanometres
from raytrace.studies.options import add_options, documents, option, pictures, whole

SUMMARY = "learn elements that a process of etching can make"
DESCRIPTION = """\
Elements of extended depth of field that can be etched: rings of 2 µm, a relief of one or two waves of 0.55 µm in so
many levels, heights that err by so many nm. Each is learned under its process from several starts, modelled on rings
learned in whole heights (those of `raytrace wave noise` in the same FOLDER, learned where they are not there), and
judged on pictures beside the Fresnel lens, the hybrid achromat and its model. The same command goes on where it was
stopped."""
EXAMPLES = """examples:
  raytrace wave etch --waves 1 --levels 16 --starts 1 -o noise
  raytrace wave etch --data pictures --limit 400 -o noise-of-pictures --docs docs"""


@dataclasses.dataclass(frozen=True)
class Settings(rows.Settings):
    """waves, levels, tolerance (mm): of the processes; noise, learn: as of `wave noise`; seed: of dead leaves, and of
    the samples of pictures that intervals are made from."""

    waves: tuple[int, ...] = option((1, 2), "relief in waves of 0.55 µm: 1 (1.2 µm) or more (default 1 2)", "M")
    levels: tuple[int, ...] = option((4, 8, 16), "of the relief (default 4 8 16)", "L", type=whole(2))
    tolerance: float = option(2e-5, "heights err by up to NM nm (default 20)", "NM", type=nanometres, unit=NANOMETRE)
    noise: tuple[float, ...] = option((0.01,), "standard deviations (default 0.01)", "S", name="noises")
    starts: int = option(5, "of each")
    steps: int = option(300, "of learning its depths")
    moves: int = option(300, "trials between levels")
    learn: int = option(300, "steps of its model")


def options(parser: argparse.ArgumentParser) -> None:
    add_options(parser, Settings)
    pictures(parser, PICTURES, "seed", settings=Settings, limit=LIMIT)
    output_folder(parser, "folder of learned elements", required=True)
    documents(parser, "wave_etch.md and wave/")
    json(parser)


run = "studies.quantise.process_report.etch"
