"""`raytrace wave design`: its options. Imports no torch before it runs."""

import argparse

from raytrace.cli.options import Option, group, json, output_folder, plot
from raytrace.cli.settings import SEED, add_options, defaults_of, listed, option, picture_options, settings_options
from raytrace.cli.types import positive, positive_finite
from raytrace.cli.wave_options import camera, feature, light, pixels
from raytrace.settings import DesignSettings

SUMMARY = "design an element of extended depth of field"
DESCRIPTION = """\
Design a phase element for a camera whose images are restored, at every depth and wavelength, by one linear filter; by
default from 0.5 m to infinity, with a 5 mm aperture and the sensor at 35.5 mm. rings: free heights of rings of fused
silica, 2 µm wide or --feature; smooth: seven polynomials of the radius in PMMA; zernike: Noll's polynomials on a PMMA
lens, without symmetry.

--loss spectral is the expected error, in closed form, of the best depth-invariant filter (a linear filter that uses
neither depth nor picture): deterministic, without drawn pictures. --loss images draws pictures, depths and noise
and restores the images at every step, as Sitzmann et al. (SIGGRAPH 2018). Both start from the best of several random
starts of the smooth element. A run may be interrupted at any time; the same command resumes it. `raytrace wave restore`
restores images with the element."""
EXAMPLES = """examples:
  raytrace wave design -o rings --plot rings.png
  raytrace wave design --element smooth --starts 8 -o smooth --json
  raytrace wave design --element rings --levels 16 --tolerance 20 -o etched
  raytrace wave design --element zernike --loss images --filter towards --optimizer adadelta --rate 1 -o images
  raytrace wave design --data pictures --steps 300 -o run
  raytrace wave design --settings run/settings.json --set rate=0.01 -o again"""

NANOMETRE = 1e-6  # mm
PICTURES = "folder of pictures of 256 × 256 pixels or more; four fifths make the filters, the others are restored"
LIMIT = 80  # of them
NOISE = "standard deviation, for images from 0 to 1"
_DEPTHS = (500.0, 2000 / 3, 1000.0, 2000.0, float("inf"))


def _nanometres(text: str) -> float:
    return NANOMETRE * positive_finite(text)


#: The options by the field of `DesignSettings`.
ROWS = {
    "kind": option("the designed element", name="element", choices=("rings", "smooth", "zernike")),
    "glass": option("default F_SILICA for rings, else PMMA", "NAME"),
    "terms": option("polynomials of the smooth element (default 7), or Noll's last (36)"),
    "levels": option("as if etched in N equal steps of the height of one wave (default any height)"),
    "tolerance": option(
        "uniform random height error of rings, ± NM nm, resampled at every step (default 0)",
        "NM",
        type=_nanometres,
        unit=NANOMETRE,
    ),
    "loss": option("the minimised error", choices=("spectral", "images")),
    "restoration": option(
        "of --loss images. blind: the best depth-invariant one (default); towards: least squares with a penalty on the "
        "distance to the captured image (Sitzmann et al. 2018); network: the first, followed by a RED-Net",
        name="filter",
        choices=("blind", "towards", "network"),
    ),
    "optimizer": option("default adam", choices=("adam", "sgd", "adadelta")),
    "schedule": option("default cosine", choices=("cosine", "linear", "constant")),
    "rate": option("learning rate, µm a step", "R"),
    "steps": option("of the optimiser"),
    "starts": option("random starts, of which the best is used"),
    "seed": SEED,
}


EXAMPLES += "\n\n" + listed(DesignSettings, ROWS)


def options(parser: argparse.ArgumentParser) -> None:
    settings_options(parser, DesignSettings)
    defaults = defaults_of(DesignSettings)
    add_options(parser, defaults, ROWS, "kind", "glass", "terms", "levels", "tolerance")
    for add in (camera(), light(depths=_DEPTHS), pixels(size=255)):
        add(parser)
    group(
        "element and noise",
        feature("0.002 for rings"),
        Option("focus", positive, "MM", "object distance whose PSF the Wiener filter is made for", default=1000.0),
        Option("noise", positive_finite, "S", f"{NOISE} (default 0.01)"),
    )(parser)
    learning = ("loss", "restoration", "optimizer", "schedule", "rate", "steps", "starts")
    add_options(parser.add_argument_group("optimisation"), defaults, ROWS, *learning)
    add_options(picture_options(parser, PICTURES, limit=LIMIT), defaults, ROWS, "seed")
    figure = plot("height map, PSFs over depth and wavelength, PSNR over depth")
    for add in (output_folder("folder of the run", required=True), json, figure):
        add(parser)
