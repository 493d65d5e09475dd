"""The subcommands of `raytrace wave`: words, arguments, and what runs them; and the arguments they share. No torch.

SUBCOMMANDS holds (name, summary, description, examples, add_arguments, "module.function"), as COMMANDS does.
"""

import argparse

from raytrace.cli.options import count, file_name, json, max_bytes, output, picture_file, plot, seed_number
from raytrace.cli.studies import words
from raytrace.cli.wave_options import ELEMENTS as ELEMENTS
from raytrace.cli.wave_options import ENGINES as ENGINES
from raytrace.cli.wave_options import camera, element, engine, feature, light, pixels

_DESCRIPTION = """\
Wave optics of a thin phase element before a sensor: point spread functions (PSFs) over depth and wavelength, and
elements learned from pictures or their statistics. `raytrace wave SUB --help` teaches each by example."""

_EXAMPLES = """examples:
  raytrace wave psf --element singlet --focus 1000 --depth 500 1000 inf -o psf.npz --plot psf.png
  raytrace wave psf --element fresnel --wavelength 0.46 0.55 0.64 --json
  raytrace wave focus --json"""


# -- the subcommands ---------------------------------------------------------------------------------------------------


_FIGURES = {
    "heights": "the height of the element, as a disc and as a profile,",
    "caustic": "the light behind the element, over distance and radius,",
    "encircled": "the share of the light within a radius",
}


def _psf(parser: argparse.ArgumentParser) -> None:
    element(parser)
    camera(parser)
    light(parser)
    pixels(parser)
    engine(parser)
    json(parser)
    output(
        parser,
        "arrays to write (.npz): psf[depth, wavelength, y, x], pixel_pitch, energy, depths, wavelengths, engine, error",
    )
    plot(parser, "the kernels")
    figures = parser.add_argument_group("more figures")
    for name, what in _FIGURES.items():
        figures.add_argument(f"--{name}", metavar="FILE", type=picture_file, help=f"save {what} as .png, .pdf or .svg")


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


_PSF_DESCRIPTION = """\
Kernels of a phase element for points on the axis, over depth and wavelength, integrated over pixels. 1 is all light
through the aperture: `energy` is the share inside the window, `peak` that in the brightest pixel. Named elements are
those of `raytrace wave table`: smooth ones (ideal, singlet, …-refractive) of PMMA, wrapped ones of fused silica, all
for one focus.

The engine is chosen by the scene, its sampling by --tol; a sampling that would repeat the image inside the window is
refused. --samples sets it by hand."""

_PSF_EXAMPLES = """examples:
  raytrace wave psf --element singlet --focus 1000 --depth 500 1000 inf -o psf.npz --plot psf.png
  raytrace wave psf --element fresnel --levels 16 --depth 1000 --wavelength 0.46 0.55 0.64 --json
  raytrace wave psf --element cubic --focus 1000 --pixel 0.00369 --size 128 --exact -o cubic.npz
  raytrace wave psf --element heights.npy --glass F_SILICA --design-wavelength 0.55 --levels 16 --plot made.png
  raytrace wave psf --element ideal --depth 500 --engine fresnel --samples 2500 --json"""

_FOCUS_DESCRIPTION = """\
Learn a lens from pictures: from a flat plate, free heights are optimised only to make images of far random pictures
(dead leaves: discs that hide one another) equal to the pictures. It is --aperture wide, --sensor before the sensor,
for one --wavelength. `peak_ratio` is the peak of its PSF over that of the ideal continuous lens, both over the light
through the aperture; seconds on one core.

--collimator learns the element that turns a point as far before it as --sensor into a plane wave: the peak of its far
field, and the RMS residual phase, in waves."""

_FOCUS_EXAMPLES = """examples:
  raytrace wave focus --json
  raytrace wave focus --method adam --plot focus.png -o lens.npy
  raytrace wave focus --aperture 0.5 --sensor 10 --wavelength 0.64 --samples 64
  raytrace wave focus --collimator --steps 200"""

SUBCOMMANDS = (
    (
        "psf",
        "point spread functions over depth and colour",
        _PSF_DESCRIPTION,
        _PSF_EXAMPLES,
        _psf,
        "cli.wave_commands.psf",
    ),
    (
        "focus",
        "learn a focusing lens, or a collimator, from pictures",
        _FOCUS_DESCRIPTION,
        _FOCUS_EXAMPLES,
        _focus,
        "studies.focusing.command.focus",
    ),
    *words("edof"),
    *words("superres"),
)


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    children = parser.add_subparsers(dest="subcommand", metavar="SUB", required=True)
    for name, summary, description, examples, add_arguments, run in SUBCOMMANDS:
        child = children.add_parser(
            name,
            help=summary,
            description=description,
            epilog=examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        add_arguments(child)
        max_bytes(child)
        child.set_defaults(run=run)


WAVE = (
    "wave",
    "phase elements: their PSFs, and learning them",
    _DESCRIPTION,
    _EXAMPLES,
    _add_arguments,
    "cli.wave_commands.psf",
)
