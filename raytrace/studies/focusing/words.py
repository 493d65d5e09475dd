"""The words of `raytrace wave focus`: arguments and help. No torch."""

import argparse

from raytrace.cli.options import count, file_name, json, plot, seed_number
from raytrace.cli.wave_options import camera, feature, light, pixels

_DESCRIPTION = """\
Learn a lens from pictures: from a flat plate, free heights are optimised only to make images of far random pictures
(dead leaves: discs that hide one another) equal to the pictures. It is --aperture wide, --sensor before the sensor,
for one --wavelength. `peak_ratio` is the peak of its PSF over that of the ideal continuous lens, both over the light
through the aperture; seconds on one core.

--collimator learns the element that turns a point as far before it as --sensor into a plane wave: the peak of its far
field, and the RMS residual phase, in waves."""

_EXAMPLES = """examples:
  raytrace wave focus --json
  raytrace wave focus --method adam --plot focus.png -o lens.npy
  raytrace wave focus --aperture 0.5 --sensor 10 --wavelength 0.64 --samples 64
  raytrace wave focus --collimator --steps 200"""


def _focus(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--collimator", action="store_true", help="the other way round: a point at the front focus, a plane wave out"
    )
    camera(parser, exact=False, across=1.0, sensor=25.0)
    light(parser, depths=(), wavelengths=(0.55,))
    pixels(parser, across=65, pitch=0.004)
    feature(parser, "the aperture over --samples")
    parser.add_argument("--method", choices=("sgd", "adam"), default="sgd", help="SGD with momentum (default), or Adam")
    parser.add_argument("--steps", metavar="N", type=count, default=300, help="at most (default 300)")
    parser.add_argument(
        "--samples", metavar="N", type=count, default=128, help="heights across the aperture (default 128)"
    )
    parser.add_argument("--seed", metavar="N", type=seed_number, default=0, help="of the random pictures (default 0)")
    json(parser)
    parser.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        type=file_name,
        help="height map to write: .npy, .csv, .dat, .grd, or as the grey of a picture: .png, .tif",
    )
    plot(parser, "height map, PSF and image over the steps")


WORDS = (
    (
        "focus",
        "learn a focusing lens, or a collimator, from pictures",
        _DESCRIPTION,
        _EXAMPLES,
        _focus,
        "studies.focusing.command.focus",
    ),
)
