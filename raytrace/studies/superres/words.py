"""The arguments of `raytrace wave superres` and `raytrace wave quantise`. Imports no torch."""

import argparse

from raytrace.cli.options import count, file_name, json, output_folder, plot, positive_finite, seed_number

_SUPERRES_DESCRIPTION = """\
Pictures finer than the pixels of the sensor, from one exposure: 5 mm PMMA lens, sensor at 35.5 mm, one depth of 1 m,
pixels 2 or 3 times the picture's 3.69 µm.

full frame: an element learned by the closed-form error of the best linear inversion, beside the plain lens behind
bicubic interpolation and behind its own inversion (MMSE), and the least error that any element can reach.
small scene: a plate that images a scene on a dark ground three or four times, each shifted by a part of a pixel, and
the joint inversion of these copies: wedges on sectors of the aperture, the phase of the sum of all tilted waves, and
heights learned from there."""

_SUPERRES_EXAMPLES = """examples:
  raytrace wave superres --json
  raytrace wave superres --factor 3 --places 4 --noise 0.003 --plot superres.png
  raytrace wave superres --wavelength 0.46 0.55 0.64 --data pictures
  raytrace wave superres --factor 2 3 --wavelength 0.55 --wavelength 0.46 0.55 0.64 --docs docs"""

_QUANTISE_DESCRIPTION = """\
What fabrication costs: quantised heights (levels), wrapping to one wave of 0.55 µm, and errors of height. Light at
the focus of a kinoform against sinc²(1/L), and the expected PSNR over 0.5 m to infinity, in three colours, behind
the best filter that knows no depth: of the Fresnel lens, and of a learned element of fused silica rings, wrapped and
quantised after learning, or learned further as a wrapped and quantised element.

An element is fresnel, learned (learned first, in FOLDER, or a temporary one), the folder of a run of
`raytrace wave edof --element rings`, or a file of heights, of rings or pixels, as `raytrace wave psf` reads it."""

_QUANTISE_EXAMPLES = """examples:
  raytrace wave quantise --element fresnel --json
  raytrace wave quantise --levels 2 4 16 --tolerance 20 --no-wrap
  raytrace wave quantise --element rings --steps 0
  raytrace wave quantise --element rings/heights.npy --glass F_SILICA --levels 16 --steps 0
  raytrace wave quantise --docs docs -o learned"""


def _factor(text: str) -> int:
    if text not in ("2", "3"):
        raise argparse.ArgumentTypeError(f"{text!r}: expected 2 or 3")
    return int(text)


def _steps(text: str) -> int:
    return 0 if text == "0" else count(text)


def _level(text: str) -> int:
    found = count(text)
    if found < 2:
        raise argparse.ArgumentTypeError(f"{text!r}: expected 2 levels at least")
    return found


def _pictures(parser: argparse.ArgumentParser, least: int) -> None:
    group = parser.add_argument_group("pictures")
    group.add_argument(
        "--data",
        metavar="DIR",
        type=file_name,
        help=f"folder of pictures of {least} × {least} pixels or more; four fifths make the filters, the others are "
        "restored (default: dead leaves)",
    )
    group.add_argument("--limit", metavar="N", type=count, default=16, help="take N of them, evenly (default 16)")
    group.add_argument("--seed", metavar="N", type=seed_number, default=0, help="of random numbers (default 0)")


def _superres(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--factor",
        metavar="S",
        type=_factor,
        nargs="+",
        default=[2],
        help="sensor pixels, in pixels of the picture: 2 (default) or 3",
    )
    parser.add_argument(
        "--wavelength",
        metavar="UM",
        type=positive_finite,
        nargs="+",
        action="append",
        help="wavelengths of one camera, µm (default 0.55); given again, another camera",
    )
    parser.add_argument(
        "--noise", metavar="S", type=positive_finite, default=0.001, help="of the sensor, white is 1 (default 0.001)"
    )
    parser.add_argument(
        "--places", metavar="V", type=int, choices=(3, 4), nargs="+", default=[3, 4], help="default both: 3 4"
    )
    parser.add_argument("--steps", metavar="N", type=count, default=40, help="of learning (default 40)")
    parser.add_argument(
        "--starts", metavar="N", type=_steps, default=1, help="random starts of the full-frame element (default 1)"
    )
    _pictures(parser, 96)
    parser.add_argument("--docs", metavar="DOCS", type=file_name, help="folder for wave_superres.md and wave/")
    plot(parser, "pictures and elements")
    json(parser)


def _quantise(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--element",
        metavar="NAME|FOLDER|FILE",
        type=file_name,
        nargs="+",
        default=["fresnel", "learned"],
        help="fresnel, learned (default both), folders of `raytrace wave edof`, or height maps: .npy, .csv, .png, "
        ".tif, .dat, .grd; fine maps of pixels take minutes, rings seconds",
    )
    files = parser.add_argument_group("height maps")
    files.add_argument("--glass", metavar="NAME", help="material (default: that of its FILE.json)")
    files.add_argument(
        "--aperture", metavar="MM", type=positive_finite, default=5.0, help="diameter, sensor at 35.5 mm (default 5)"
    )
    files.add_argument("--pitch", metavar="MM", type=positive_finite, help="of a file that does not say it")
    files.add_argument(
        "--span", metavar="MM", type=float, nargs=2, help="heights of black and white of a picture that does not say"
    )
    levels = [2, 4, 8, 16, 32, 64]
    parser.add_argument(
        "--levels", metavar="L", type=_level, nargs="+", default=levels, help="steps of a wave (default 2 4 … 64)"
    )
    parser.add_argument(
        "--tolerance",
        metavar="NM",
        type=positive_finite,
        nargs="+",
        default=[10.0, 20.0, 40.0, 80.0],
        help="largest errors of height, nm (default 10 20 40 80)",
    )
    parser.add_argument(
        "--wrap",
        action=argparse.BooleanOptionalAction,
        help="of learned elements only wrapped ones, or only whole ones (default both)",
    )
    parser.add_argument(
        "--steps",
        metavar="N",
        type=_steps,
        default=20,
        help="of learning on with steps in the loop, 4 times as many for the wraps (default 20; 0: none)",
    )
    parser.add_argument(
        "--learn", metavar="N", type=count, default=60, help="steps of the learned element (default 60)"
    )
    parser.add_argument("--starts", metavar="N", type=count, default=2, help="random starts of it (default 2)")
    _pictures(parser, 128)
    parser.add_argument("--docs", metavar="DOCS", type=file_name, help="folder for wave_quantise.md and wave/")
    output_folder(parser, "folder of the learned element")
    json(parser)


WORDS = (
    (
        "superres",
        "pictures finer than the pixels of the sensor",
        _SUPERRES_DESCRIPTION,
        _SUPERRES_EXAMPLES,
        _superres,
        "studies.superres.command.superres",
    ),
    (
        "quantise",
        "what levels, wrapping and errors of height cost",
        _QUANTISE_DESCRIPTION,
        _QUANTISE_EXAMPLES,
        _quantise,
        "studies.quantise.command.quantise",
    ),
)
