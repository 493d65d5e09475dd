"""`raytrace wave quantise`: its words and options. Imports no torch."""

import argparse
import dataclasses

from raytrace.cli.options import file_name, json, output_folder, positive_finite
from raytrace.studies import options as rows
from raytrace.studies.options import add_options, documents, option, pictures, whole

LIMIT = 16  # pictures
SUMMARY = "what levels, wrapping and errors of height cost"
DESCRIPTION = """\
What fabrication costs: quantised heights (levels), wrapping to one wave of 0.55 µm, and errors of height. Light at
the focus of a kinoform against sinc²(1/L), and the expected PSNR over 0.5 m to infinity, in three colours, behind
the best filter that knows no depth: of the Fresnel lens, and of a learned element of fused silica rings, wrapped and
quantised after learning, or learned further as a wrapped and quantised element.

An element is fresnel, learned (learned first, in FOLDER, or a temporary one), the folder of a run of
`raytrace wave edof --element rings`, or a file of heights, of rings or pixels, as `raytrace wave psf` reads it."""
EXAMPLES = """examples:
  raytrace wave quantise --element fresnel --json
  raytrace wave quantise --levels 2 4 16 --tolerance 20 --no-wrap
  raytrace wave quantise --element rings --steps 0
  raytrace wave quantise --element rings/heights.npy --glass F_SILICA --levels 16 --steps 0
  raytrace wave quantise --docs docs -o learned"""


@dataclasses.dataclass(frozen=True)
class Settings(rows.Settings):
    """levels, tolerance: of every element; glass to span: of those that are files of heights; learn, starts: of the
    element "learned", and steps: of learning on."""

    element: tuple[str, ...] = option(
        ("fresnel", "learned"),
        "fresnel, learned (default both), folders of `raytrace wave edof`, or height maps: .npy, .csv, .png, .tif, "
        ".dat, .grd; fine maps of pixels take minutes, rings seconds",
        "NAME|FOLDER|FILE",
        type=file_name,
    )
    glass: str | None = option(None, "material (default: that of its FILE.json)", "NAME")
    aperture: float = option(5.0, "diameter, sensor at 35.5 mm", "MM")
    pitch: float | None = option(None, "of a file that does not say it", "MM", type=positive_finite)
    span: tuple[float, float] | None = option(
        None, "heights of black and white of a picture that does not say", "MM", type=float, nargs=2
    )
    levels: tuple[int, ...] = option((2, 4, 8, 16, 32, 64), "steps of a wave (default 2 4 … 64)", "L", type=whole(2))
    tolerance: tuple[float, ...] = option((10.0, 20.0, 40.0, 80.0), "errors of height, nm (default 10 20 40 80)", "NM")
    wrap: bool | None = option(
        None, "of learned elements wrapped ones, or whole ones (default both)", action=argparse.BooleanOptionalAction
    )
    steps: int = option(
        20, "of learning on as made, after 4 times as many with wraps alone (default 20; 0: none)", type=whole(0)
    )
    learn: int = option(60, "steps of the learned element")
    starts: int = option(2, "random starts of it")


def options(parser: argparse.ArgumentParser) -> None:
    of_files = ("glass", "aperture", "pitch", "span")
    add_options(parser, Settings, "element")
    add_options(parser.add_argument_group("height maps"), Settings, *of_files)
    add_options(parser, Settings, "levels", "tolerance", "wrap", "steps", "learn", "starts")
    what = "folder of pictures of 128 × 128 pixels or more; four fifths make the filters, the others are restored"
    pictures(parser, what, "seed", limit=LIMIT)
    documents(parser, "wave_quantise.md and wave/")
    output_folder(parser, "folder of the learned element")
    json(parser)


run = "studies.quantise.report.quantise"
