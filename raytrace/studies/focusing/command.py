"""`raytrace wave focus`: its words and options, and what it runs. Imports no torch before it runs."""

import argparse

from raytrace.cli.options import count, json, output_file, plot
from raytrace.cli.wave_options import camera, feature, light, pixels
from raytrace.studies.options import Settings, add_options

SUMMARY = "learn a focusing lens, or a collimator, from pictures"
DESCRIPTION = """\
Learn a lens from pictures: from a flat plate, free heights are optimised only to make images of far random pictures
(dead leaves: discs that hide one another) equal to the pictures. It is --aperture wide, --sensor before the sensor,
for one --wavelength. `peak_ratio` is the peak of its PSF over that of the ideal continuous lens, both over the light
through the aperture; seconds on one core.

--collimator learns the element that turns a point as far before it as --sensor into a plane wave: the peak of its far
field, and the RMS residual phase, in waves."""
EXAMPLES = """examples:
  raytrace wave focus --json
  raytrace wave focus --method adam --plot focus.png -o lens.npy
  raytrace wave focus --aperture 0.5 --sensor 10 --wavelength 0.64 --samples 64
  raytrace wave focus --collimator --steps 200"""

_SHOWN = (0, 5, 10, 20, 40, 80, 160)  # steps of learning that the figure shows


def options(parser: argparse.ArgumentParser) -> None:
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
    add_options(parser, Settings, "seed")
    json(parser)
    what = "height map to write: .npy, .csv, .dat, .grd, or as the grey of a picture: .png, .tif"
    parser.add_argument("-o", "--output", metavar="FILE", type=output_file, help=what)
    plot(parser, "height map, PSF and image over the steps")


def run(arguments: argparse.Namespace):
    """A flat plate learns to be a lens."""
    from raytrace.cli.door import CommandError, refuse_suffix
    from raytrace.cli.progress import progress
    from raytrace.shards import torch_threads
    from raytrace.studies.focusing.experiment import Setting, learn_to_focus
    from raytrace.wave_optics.height_maps import FORMATS

    refuse_suffix("-o", arguments.output, tuple(FORMATS))
    if len(arguments.wavelengths) > 1:
        raise CommandError("--wavelength: a lens is learned at one wavelength")
    across, feature = arguments.aperture, arguments.feature or arguments.aperture / arguments.samples
    if arguments.feature and feature > 0.5 * across:
        raise CommandError(f"--feature {feature:g}: wider than half of the aperture of {across:g} mm")
    setting = Setting.of(
        vars(arguments),
        diameter=across,
        distance=arguments.sensor,
        wavelength=arguments.wavelengths[0],
        samples=round(across / feature),
    )
    # Arrays are small: a second thread would only wait.
    with torch_threads(1), progress(arguments.steps, what="learning") as bar:

        def show(step: int, ratio: float) -> None:
            bar.set_postfix_str(f"peak {ratio:.3f} of the ideal lens's")
            bar.update(min(1, step))

        return learn_to_focus(setting, steps=arguments.steps, frames=_SHOWN, progress=show)
