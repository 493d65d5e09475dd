"""`raytrace wave superres`: its words and options. Imports no torch."""

import argparse
import dataclasses

from raytrace.cli.options import json, plot, positive_finite
from raytrace.studies import options as rows
from raytrace.studies.options import add_options, documents, option, pictures, whole

LIMIT = 16  # pictures
SUMMARY = "pictures finer than the pixels of the sensor"
DESCRIPTION = """\
Pictures finer than the pixels of the sensor, from one exposure: 5 mm PMMA lens, sensor at 35.5 mm, one depth of 1 m,
pixels 2 or 3 times the picture's 3.69 µm.

full frame: an element learned by the closed-form error of the best linear inversion, beside the plain lens behind
bicubic interpolation and behind its own inversion (MMSE), and the least error that any element can reach.
small scene: a plate that images a scene on a dark ground three or four times, each shifted by a part of a pixel, and
the joint inversion of these copies: wedges on sectors of the aperture, the phase of the sum of all tilted waves, and
heights learned from there."""
EXAMPLES = """examples:
  raytrace wave superres --json
  raytrace wave superres --factor 3 --places 4 --noise 0.003 --plot superres.png
  raytrace wave superres --wavelength 0.46 0.55 0.64 --data pictures
  raytrace wave superres --factor 2 3 --wavelength 0.55 --wavelength 0.46 0.55 0.64 --docs docs"""


def _factor(text: str) -> int:
    if text not in ("2", "3"):
        raise argparse.ArgumentTypeError(f"{text!r}: expected 2 or 3")
    return int(text)


def cameras():
    """--wavelength, a field of settings."""
    help = "wavelengths of one camera, µm (default 0.55); given again, another camera"
    return option(([0.55],), help, "UM", type=positive_finite, action="append")


def sensor_noise():
    """--noise, a field of settings."""
    return option(0.001, "of the sensor, white is 1", "S")


@dataclasses.dataclass(frozen=True)
class Settings(rows.Settings):
    """wavelength: of every camera; places: of the small scene's copies, each number of them a plate of its own."""

    factor: tuple[int, ...] = option(
        (2,), "sensor pixels, in pixels of the picture: 2 (default) or 3", "S", type=_factor
    )
    wavelength: tuple[list[float], ...] = cameras()
    noise: float = sensor_noise()
    places: tuple[int, ...] = option((3, 4), "default both: 3 4", "V", type=int, choices=(3, 4))
    steps: int = option(40, "of learning")
    starts: int = option(1, "random starts of the full-frame element", type=whole(0))


def options(parser: argparse.ArgumentParser) -> None:
    add_options(parser, Settings)
    what = "folder of pictures of 96 × 96 pixels or more; four fifths make the filters, the others are restored"
    pictures(parser, what, "seed", limit=LIMIT)
    documents(parser, "wave_superres.md and wave/")
    plot(parser, "pictures and elements")
    json(parser)


run = "studies.superres.report.superres"
