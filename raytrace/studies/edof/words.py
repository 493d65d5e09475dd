"""The arguments of `raytrace wave edof` and `raytrace wave table`. Imports no torch."""

import argparse

from raytrace.cli.options import count, file_name, json, output_folder, plot, positive, positive_finite, seed_number
from raytrace.cli.wave_options import camera, feature, light, pixels

KINDS = ("rings", "smooth", "zernike")
STEPS, STARTS = 120, 4
_DEPTHS = (500.0, 2000 / 3, 1000.0, 2000.0, float("inf"))

_EDOF_DESCRIPTION = """\
Learn a phase element that shows scenes at all depths and in all colours behind one linear filter; by default from 0.5 m
to infinity, with a 5 mm aperture and the sensor at 35.5 mm. rings: free heights of rings of fused silica, 2 µm wide or
as --feature says; smooth: seven polynomials of the radius in PMMA; zernike: Noll's polynomials on a PMMA lens, without
symmetry.

--loss spectral is the expected error, in closed form, of the best depth-invariant filter (the linear filter that
knows neither depth nor picture): deterministic, no pictures drawn. --loss images draws pictures, depths and noise
and restores them at every step, as Sitzmann et al. (SIGGRAPH 2018) did. Both begin from the best of several random
starts of the smooth element. A run may be stopped at any moment; the same command goes on."""

_EDOF_EXAMPLES = """examples:
  raytrace wave edof -o rings --plot rings.png
  raytrace wave edof --element smooth --starts 8 -o smooth --json
  raytrace wave edof --element rings --levels 16 --tolerance 20 -o etched
  raytrace wave edof --element zernike --loss images --filter towards --optimizer adadelta --rate 1 -o images
  raytrace wave edof --data pictures --steps 300 -o run"""

_TABLE_DESCRIPTION = """\
PSNR of restored pictures over 0.5 m to infinity for every baseline and for learned elements, behind two filters: the
Wiener filter of the PSF at 1 m with the best constant, and the best depth-invariant one (the linear filter with the
least error over all depths). On dead leaves (discs that hide one another) of two sizes, and on pictures with --data.
What is learned is kept in FOLDER, if one is given, and read again."""

_TABLE_EXAMPLES = """examples:
  raytrace wave table --json
  raytrace wave table --rows fresnel singlet achromat
  raytrace wave table --rows fresnel learned --also learned-images learned-adadelta -o learned
  raytrace wave table --data pictures -o learned --docs docs"""


def _pictures(group) -> None:
    group.add_argument(
        "--data",
        metavar="DIR",
        type=file_name,
        help="folder of pictures of 256 × 256 pixels or more; four fifths make the filters, the others are restored "
        "(default: dead leaves, discs that hide one another)",
    )
    group.add_argument("--limit", metavar="N", type=count, default=80, help="take N of them, evenly (default 80)")
    group.add_argument("--seed", metavar="N", type=seed_number, default=0, help="of random numbers (default 0)")


def _edof(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--element", choices=KINDS, default="rings", help="what is learned (default rings)")
    parser.add_argument("--glass", metavar="NAME", help="default F_SILICA for rings, else PMMA")
    parser.add_argument(
        "--terms", metavar="N", type=count, help="polynomials of the smooth element (default 7), or Noll's last (36)"
    )
    parser.add_argument(
        "--levels", metavar="N", type=count, help="learned as if etched in N equal steps of the height of one wave"
    )
    parser.add_argument(
        "--tolerance",
        metavar="NM",
        type=positive_finite,
        help="heights of rings err by up to NM nm, drawn anew at every step (default 0)",
    )
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
    group = parser.add_argument_group("learning")
    group.add_argument(
        "--loss", choices=("spectral", "images"), default="spectral", help="what is made least (default spectral)"
    )
    group.add_argument(
        "--filter",
        choices=("blind", "towards", "network"),
        default="blind",
        help="of --loss images. blind: the best depth-invariant one (default); towards: least squares with a penalty "
        "on the distance to the measured picture (Sitzmann et al. 2018); network: the first and a RED-Net behind it",
    )
    group.add_argument("--optimizer", choices=("adam", "sgd", "adadelta"), default="adam", help="default adam")
    group.add_argument("--schedule", choices=("cosine", "linear", "constant"), default="cosine", help="default cosine")
    group.add_argument(
        "--rate", metavar="R", type=positive_finite, default=0.02, help="learning rate, µm a step (default 0.02)"
    )
    group.add_argument("--steps", metavar="N", type=count, default=STEPS, help=f"of learning (default {STEPS})")
    group.add_argument("--starts", metavar="N", type=count, default=STARTS, help=f"random starts (default {STARTS})")
    _pictures(parser.add_argument_group("pictures"))
    output_folder(parser, "folder of the run", required=True)
    json(parser)
    plot(parser, "height map, PSFs over depth and colour, PSNR over depth")


def _table(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rows", metavar="ROW", nargs="+", help="only these (default: all but those of --also)")
    parser.add_argument(
        "--also",
        metavar="ROW",
        nargs="+",
        help="rows of other ways of learning beside the others: learned-images (--loss images --filter towards), "
        "learned-adadelta (the same by Adadelta), learned-zernike (22 polynomials, no symmetry, by Adadelta)",
    )
    parser.add_argument("--steps", metavar="N", type=count, default=STEPS, help=f"of learning (default {STEPS})")
    parser.add_argument("--starts", metavar="N", type=count, default=STARTS, help=f"random starts (default {STARTS})")
    _pictures(parser.add_argument_group("pictures"))
    output_folder(parser, "folder of learned elements")
    parser.add_argument("--docs", metavar="DOCS", type=file_name, help="folder for wave_edof.md and wave/")
    json(parser)


WORDS = (
    (
        "edof",
        "learn an element of extended depth of field",
        _EDOF_DESCRIPTION,
        _EDOF_EXAMPLES,
        _edof,
        "studies.edof.command.edof",
    ),
    (
        "table",
        "compare elements of extended depth of field",
        _TABLE_DESCRIPTION,
        _TABLE_EXAMPLES,
        _table,
        "studies.edof.command.table",
    ),
)
