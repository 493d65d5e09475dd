"""`raytrace wave restore`: its options, and restored images. Imports no torch before it runs."""

import argparse

from raytrace.cli.options import Option, group, json, output_folder, row
from raytrace.cli.types import file_name, positive, positive_finite
from raytrace.cli.wave_design import NOISE
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
    for add in (
        Option("images", file_name, "IMAGE", "captured images, or scenes", flag="images", nargs="+"),
        element,
        camera(),
        light(depths=(500.0, 2000 / 3, 1000.0, 2000.0, float("inf"))),
        pixels(size=255),
        group(
            "restoration",
            Option("noise", positive_finite, "S", NOISE, default=0.01),
            Option("simulate", positive, "MM", "object distance of the scenes in IMAGE; inf allowed"),
            row("seed", "of the simulated noise"),
        ),
        output_folder("folder of the restored images, as .png", required=True),
        json,
    ):
        add(parser)
