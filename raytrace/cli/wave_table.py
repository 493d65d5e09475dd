"""The subcommands of `raytrace wave`: words, arguments, and what runs them; and the arguments they share. No torch.

SUBCOMMANDS holds (name, summary, description, examples, add_arguments, "module.function"), as COMMANDS does.
"""

import argparse

from raytrace.cli.options import (
    catalog,
    count,
    file_name,
    json,
    output,
    picture_file,
    plot,
    positive,
    positive_finite,
    seed_number,
    size,
)
from raytrace.cli.wave_edof_table import EDOF
from raytrace.cli.wave_superres_table import SUPERRES

#: The names that `--element` takes beside files: those of wave.baselines.
ELEMENTS = (
    "ideal",
    "singlet",
    "fresnel",
    "multifocal",
    "multifocal-refractive",
    "cubic",
    "cubic-refractive",
    "achromat",
    "hybrid",
)
ENGINES = ("auto", "pupil", "radial", "fresnel", "angular_spectrum")

_DESCRIPTION = """\
Waves behind a thin phase element: point spread functions over depth and colour, and elements that are learned from
what a camera makes of pictures. `raytrace wave SUB --help` teaches each by example."""

_EXAMPLES = """examples:
  raytrace wave psf --element singlet --focus 1000 --depth 500 1000 inf -o psf.npz --plot psf.png
  raytrace wave psf --element fresnel --wavelength 0.46 0.55 0.64 --json
  raytrace wave focus --json"""


# -- arguments that subcommands share ----------------------------------------------------------------------------------


def camera(parser: argparse.ArgumentParser, *, exact: bool = True) -> None:
    """--aperture, --sensor, --exact: what every wave camera has."""
    group = parser.add_argument_group("camera")
    group.add_argument(
        "--aperture", metavar="MM", type=positive_finite, default=5.0, help="diameter of the aperture (default 5)"
    )
    group.add_argument(
        "--sensor", metavar="MM", type=positive_finite, default=35.5, help="from element to sensor (default 35.5)"
    )
    if exact:
        group.add_argument(
            "--exact", action="store_true", help="true spheres instead of Fresnel's paraboloids, in design and PSF"
        )


def element(parser: argparse.ArgumentParser) -> None:
    """--element and what makes one: focus, design wavelength, levels; glass, pitch and span of a file."""
    group = parser.add_argument_group("element")
    group.add_argument(
        "--element",
        metavar="NAME|FILE",
        type=file_name,
        default="singlet",
        help=f"{', '.join(ELEMENTS)} (default singlet), or a height map: .npy, .csv, .png, .tif, .dat, .grd",
    )
    group.add_argument(
        "--focus",
        metavar="MM",
        type=positive,
        default=1000.0,
        help="object distance that a named element is made for; inf allowed (default 1000)",
    )
    group.add_argument(
        "--design-wavelength",
        metavar="UM",
        type=positive_finite,
        help="that it is made for, and wrapped at (default 0.55); a file's heights are wrapped only if this is given",
    )
    group.add_argument(
        "--levels", metavar="N", type=count, help="steps of a wave's height, of wrapped elements (default any height)"
    )
    group.add_argument("--glass", metavar="NAME", help="material of a file's element (default: that of its FILE.json)")
    group.add_argument(
        "--index",
        metavar="N",
        type=positive_finite,
        nargs="+",
        help="refractive index of a file's element at each --wavelength, instead of --glass",
    )
    group.add_argument("--pitch", metavar="MM", type=positive_finite, help="of a file that does not say it")
    group.add_argument(
        "--span", metavar="MM", type=float, nargs=2, help="heights of black and white of a picture that does not say"
    )
    catalog(group)


def light(parser: argparse.ArgumentParser, *, depths: tuple[float, ...] = (500.0, 1000.0, float("inf"))) -> None:
    """--depth, --wavelength: the point sources."""
    group = parser.add_argument_group("light")
    listed = " ".join(f"{depth:g}" for depth in depths)
    group.add_argument(
        "--depth",
        metavar="MM",
        type=positive,
        nargs="+",
        default=list(depths),
        help=f"distances of points on the axis; inf allowed (default {listed})",
    )
    group.add_argument(
        "--wavelength",
        metavar="UM",
        type=positive_finite,
        nargs="+",
        default=[0.46, 0.55, 0.64],
        help="in µm (default 0.46 0.55 0.64)",
    )


def pixels(parser: argparse.ArgumentParser, *, across: int = 128) -> None:
    """--pixel, --size: the window of the PSF."""
    group = parser.add_argument_group("window")
    group.add_argument(
        "--pixel", metavar="MM", type=positive_finite, default=0.00369, help="pixel pitch (default 0.00369)"
    )
    size(group, f"the window, centred on the axis (default {across})", default=across)


def engine(parser: argparse.ArgumentParser) -> None:
    """--engine, --samples, --tol: how PSFs are computed."""
    group = parser.add_argument_group("sampling")
    group.add_argument(
        "--engine",
        choices=ENGINES,
        default="auto",
        help="auto (default): radial for round elements, else pupil; fresnel and angular_spectrum are references",
    )
    group.add_argument(
        "--samples",
        metavar="N",
        type=count,
        help="across the aperture (radial: between steps of the element) instead of as many as --tol needs",
    )
    group.add_argument(
        "--tol", metavar="T", type=positive_finite, default=1e-3, help="predicted relative L2 error (default 1e-3)"
    )


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
    parser.add_argument("--method", choices=("sgd", "adam"), default="sgd", help="SGD with momentum (default), or Adam")
    parser.add_argument("--steps", metavar="N", type=count, default=300, help="at most (default 300)")
    parser.add_argument(
        "--samples", metavar="N", type=count, default=128, help="heights across the aperture (default 128)"
    )
    parser.add_argument("--seed", metavar="N", type=seed_number, default=0, help="of the pictures (default 0)")
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
through the aperture: `energy` is the share inside the window. Named elements are those of the comparison of extended
depth of field: smooth ones (ideal, singlet, …-refractive) of PMMA, wrapped ones of fused silica, all for one focus.

The engine is chosen by the scene, its sampling by --tol; a sampling that would repeat the image inside the window is
refused. --samples sets it by hand."""

_PSF_EXAMPLES = """examples:
  raytrace wave psf --element singlet --focus 1000 --depth 500 1000 inf -o psf.npz --plot psf.png
  raytrace wave psf --element fresnel --levels 16 --depth 1000 --wavelength 0.46 0.55 0.64 --json
  raytrace wave psf --element cubic --focus 1000 --pixel 0.00369 --size 128 --exact -o cubic.npz
  raytrace wave psf --element heights.npy --glass F_SILICA --design-wavelength 0.55 --levels 16 --plot made.png
  raytrace wave psf --element ideal --depth 500 --engine fresnel --samples 2500 --json"""

_FOCUS_DESCRIPTION = """\
Learn a lens from pictures: a flat plate of free heights, 1 mm wide, 25 mm before a sensor, at 0.55 µm, is told nothing
but to make the images of dead leaves equal to the leaves. `peak_ratio` is the peak of its PSF over that of the ideal
continuous lens, both over the light through the aperture; seconds on one core.

--collimator learns the element that turns a point 25 mm before it into a plane wave: the peak of its far field, and the
RMS phase that is left, in waves."""

_FOCUS_EXAMPLES = """examples:
  raytrace wave focus --json
  raytrace wave focus --method adam --plot focus.png -o lens.npy
  raytrace wave focus --collimator --steps 200"""

SUBCOMMANDS = (
    (
        "psf",
        "point spread functions over depth and colour",
        _PSF_DESCRIPTION,
        _PSF_EXAMPLES,
        _psf,
        "wave_commands.psf",
    ),
    (
        "focus",
        "learn a focusing lens, or a collimator, from pictures",
        _FOCUS_DESCRIPTION,
        _FOCUS_EXAMPLES,
        _focus,
        "wave_commands.focus",
    ),
    *EDOF,
    *SUPERRES,
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
        child.set_defaults(run=run)


WAVE = (
    "wave",
    "phase elements: their PSFs, and learning them",
    _DESCRIPTION,
    _EXAMPLES,
    _add_arguments,
    "wave_commands.psf",
)
