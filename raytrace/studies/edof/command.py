"""`raytrace wave edof`: its words and options. Imports no torch before it runs."""

import argparse

from raytrace.cli.options import json, output_folder, plot, positive, positive_finite
from raytrace.cli.wave_options import camera, feature, light, pixels
from raytrace.studies.edof.settings import Settings
from raytrace.studies.options import add_options, pictures

SUMMARY = "learn an element of extended depth of field"
DESCRIPTION = """\
Learn a phase element that shows scenes at all depths and in all colours behind one linear filter; by default from 0.5 m
to infinity, with a 5 mm aperture and the sensor at 35.5 mm. rings: free heights of rings of fused silica, 2 µm wide or
as --feature says; smooth: seven polynomials of the radius in PMMA; zernike: Noll's polynomials on a PMMA lens, without
symmetry.

--loss spectral is the expected error, in closed form, of the best depth-invariant filter (the linear filter that
knows neither depth nor picture): deterministic, no pictures drawn. --loss images draws pictures, depths and noise
and restores them at every step, as Sitzmann et al. (SIGGRAPH 2018) did. Both begin from the best of several random
starts of the smooth element. A run may be stopped at any moment; the same command goes on."""
EXAMPLES = """examples:
  raytrace wave edof -o rings --plot rings.png
  raytrace wave edof --element smooth --starts 8 -o smooth --json
  raytrace wave edof --element rings --levels 16 --tolerance 20 -o etched
  raytrace wave edof --element zernike --loss images --filter towards --optimizer adadelta --rate 1 -o images
  raytrace wave edof --data pictures --steps 300 -o run"""

PICTURES = "folder of pictures of 256 × 256 pixels or more; four fifths make the filters, the others are restored"
LIMIT = 80  # of them
_DEPTHS = (500.0, 2000 / 3, 1000.0, 2000.0, float("inf"))


def options(parser: argparse.ArgumentParser) -> None:
    add_options(parser, Settings, "kind", "glass", "terms", "levels", "tolerance")
    camera(parser)
    light(parser, depths=_DEPTHS)
    pixels(parser, across=255)
    world = parser.add_argument_group("element and noise")
    feature(world, "0.002 for rings")
    world.add_argument(
        "--focus",
        metavar="MM",
        type=positive,
        default=1000.0,
        help="depth whose PSF the Wiener filter is made for (default 1000)",
    )
    world.add_argument(
        "--noise", metavar="S", type=positive_finite, help="standard deviation, of pictures from 0 to 1 (default 0.01)"
    )
    learning = ("loss", "restoration", "optimizer", "schedule", "rate", "steps", "starts")
    add_options(parser.add_argument_group("learning"), Settings, *learning)
    pictures(parser, PICTURES, "seed", limit=LIMIT)
    output_folder(parser, "folder of the run", required=True)
    json(parser)
    plot(parser, "height map, PSFs over depth and colour, PSNR over depth")


run = "studies.edof.report.edof"
