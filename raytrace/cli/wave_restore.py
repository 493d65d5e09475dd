"""`raytrace wave restore`: its options, and restored images. Imports no torch before it runs."""

import argparse

from raytrace.cli.options import file_name, json, output_folder, positive, positive_finite, seed_number
from raytrace.cli.wave_options import camera, element, light, pixels

SUMMARY = "restore images of a camera with a phase element"
DESCRIPTION = """\
Restore captured images by the best depth-invariant linear filter of a camera with a phase element: a designed one in a
file, or a named one. Files are pictures of one channel for each wavelength, red, green and blue from the longest to the
shortest, or grey ones for one wavelength. With --simulate they are scenes: the image of each at that object distance,
with noise, is computed first, and the PSNR of the image and of its restoration are reported.

The filter assumes the power spectrum of natural images, with the variance of the image; light outside the window of
the PSF is treated as even haze."""
EXAMPLES = """examples:
  raytrace wave restore captured.png --element rings/heights.npy --depth 500 1000 2000 inf -o restored
  raytrace wave restore scene.png --element rings/heights.npy --simulate 500 -o simulated --json
  raytrace wave restore grey.tif --element fresnel --wavelength 0.55 --size 255 -o restored"""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("images", metavar="IMAGE", type=file_name, nargs="+", help="captured images, or scenes")
    element(parser)
    camera(parser)
    light(parser, depths=(500.0, 2000 / 3, 1000.0, 2000.0, float("inf")))
    pixels(parser, across=255)
    group = parser.add_argument_group("restoration")
    group.add_argument(
        "--noise", metavar="S", type=positive_finite, default=0.01, help="standard deviation, for images from 0 to 1 "
        "(default 0.01)"
    )  # fmt: skip
    group.add_argument(
        "--simulate", metavar="MM", type=positive, help="object distance of the scenes in IMAGE; inf allowed"
    )
    group.add_argument("--seed", metavar="N", type=seed_number, default=0, help="of the simulated noise (default 0)")
    output_folder(parser, "folder of the restored images, as .png", required=True)
    json(parser)
