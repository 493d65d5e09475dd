"""The arguments of `raytrace codesign`. Imports no torch."""

from raytrace.cli.options import (
    catalog,
    count,
    fields,
    file_name,
    json,
    output_folder,
    positive,
    positive_finite,
    seed_number,
    wavelength,
    window,
)

MODELS = ("paraxial", "fourier", "gaussian", "drt")
AFTER_PARAXIAL = "gaussian-after-paraxial"

_DESCRIPTION = """\
Learn the sensor distance (or any variables) of a lens together with a network that restores its pictures. Step 1
learns both with the PSFs of one model; step 2 freezes the lens and goes on with the network on PSFs of traced rays,
as long as step 1. `compare` runs every model and seed and writes tables, figures and a page about them; `sweep` finds
the optima of the closed form at several apertures, noises, normalisations and starts, and widths of the paraxial PSF.

Models: paraxial (a Gaussian as wide as the paraxial blur), fourier (diffraction of the paraxial wavefront), gaussian
(Gaussian DRT: centroid and covariance of traced rays), drt (differentiable ray tracing: the rays themselves). Closed
form: the expected mean square error of pictures behind the best linear filter, from their power spectrum.

A run may be stopped at any moment: the same command goes on where it was, and ends in the same numbers. Several
processes share every batch: torchrun --nproc-per-node 2 -m raytrace codesign …"""

_EXAMPLES = """examples:
  raytrace codesign double_gauss --loss spectral -o learned.zmx
  raytrace codesign double_gauss --model gaussian --data pictures -o run
  raytrace codesign double_gauss --start spectral --bounds sensor:57,58 --data pictures -o begun_in_closed_form
  raytrace codesign lens.zmx --vary sensor thickness:5,6 curvature:1-4 --f-number 4 -o run4
  raytrace codesign double_gauss --wavelength 0.53 0.48 0.62 --vary thickness:2,9 --air-thickness 0.5:50 -o colours
  raytrace codesign double_gauss --field 0 10 14 --normalise energy --epochs 10 -o fields --json
  raytrace codesign compare double_gauss --data pictures --seeds 0 1 2 -o study --docs docs
  raytrace codesign compare double_gauss --data pictures -o study --docs docs --report-only
  raytrace codesign sweep double_gauss --data pictures --docs docs"""


def _add_arguments(parser) -> None:
    parser.usage = "raytrace codesign [compare | sweep] LENS [-o FOLDER] [options]"
    parser.add_argument(
        "words",
        metavar="LENS",
        type=file_name,
        nargs="+",
        help="lens file, or the name of a shipped lens; before it `compare` runs all models and seeds, "
        "`sweep` finds optima of the closed form",
    )
    catalog(parser)
    json(parser)
    output_folder(
        parser,
        "folder of the run, or of all runs of compare, in each of which lens.zmx is the learned lens; or a lens file "
        "(.zmx, .csv) for it, the run then being kept in a folder of the same name without suffix",
    )
    parser.add_argument("--resume", action="store_true", help="only go on with a run that was begun in FOLDER")
    parser.add_argument("--model", choices=MODELS, help="PSF model of step 1 (default gaussian)")
    parser.add_argument(
        "--loss",
        choices=("image", "spectral"),
        default="image",
        help="image: L1 of restored pictures, by training (default); spectral: the closed form, without a network, "
        "in seconds",
    )
    _pictures(parser.add_argument_group("pictures"))
    _scene(parser.add_argument_group("lens and scene"))
    _training(parser.add_argument_group("network and training"))
    _compare(parser.add_argument_group("compare and sweep"))


def _pictures(group) -> None:
    group.add_argument(
        "--data",
        metavar="DIR",
        type=file_name,
        help="folder of pictures, in any subfolders; four fifths of them train, the others test "
        "(default: dead leaves, discs that hide one another)",
    )
    group.add_argument("--limit", metavar="N", type=count, help="take N pictures, evenly from all in DIR")
    group.add_argument("--patch", metavar="N", type=count, help="pixels across what is restored (default 64)")
    group.add_argument("--crops", metavar="N", type=count, help="patches of a picture in an epoch (default 4)")


def _scene(group) -> None:
    group.add_argument(
        "--vary",
        metavar="WHAT",
        nargs="+",
        help="variables: sensor (default), or several as sensor thickness:5,6 curvature:1-4 conic:3, of surfaces",
    )
    group.add_argument(
        "--bounds",
        metavar="NAME:LOW,HIGH",
        nargs="+",
        help="of variables: sensor:57.5,58 thickness_5:8,12 curvature_3:-0.04,0 (mm, 1/mm)",
    )
    thickness(group)
    group.add_argument(
        "--start",
        metavar="PLACE",
        help="where the sensor begins: paraxial (default; the image of --focus-distance), rms (its least RMS spot), "
        "spectral (the optimum of the closed form), or a sensor distance in mm",
    )
    group.add_argument("--focus-distance", metavar="MM", type=positive, help="of --start (default 25000); inf allowed")
    group.add_argument("--f-number", metavar="N", type=positive_finite, help="other than the file's")
    wavelength(group)
    group.add_argument(
        "--wavelength-weights", metavar="W", type=positive_finite, nargs="+", help="of --wavelength (default 1 each)"
    )
    group.add_argument(
        "--file-wavelengths", action="store_true", help="the file's wavelengths with their weights (default 0.53 µm)"
    )
    group.add_argument("--near", metavar="MM", type=positive_finite, help="nearest object (default 10000)")
    group.add_argument("--far", metavar="MM", type=positive_finite, help="furthest object (default 50000)")
    fields(group, default="0; several are taken in turn")
    window(group, normalise="window")
    group.add_argument(
        "--noise", metavar="S", type=positive_finite, help="standard deviation, of pictures from 0 to 1 (default 0.1)"
    )
    group.add_argument("--tol", metavar="T", type=positive_finite, help="what a PSF may err by (default 0.01)")


def thickness(group) -> None:
    """--glass-thickness, --air-thickness, --edge: what can be built."""
    group.add_argument(
        "--glass-thickness",
        metavar="MIN[:MAX]",
        help="of elements at the axis in mm: least, or least and greatest (default 1/50 of the largest diameter)",
    )
    group.add_argument(
        "--air-thickness",
        metavar="MIN[:MAX]",
        help="of air between elements at the axis (default 1/2000 of the largest diameter); its edges may touch",
    )
    group.add_argument(
        "--edge",
        metavar="MIN",
        type=positive_finite,
        help="least thickness of elements at their edge in mm (default 1/100 of the largest diameter); what lacks is a "
        "penalty in mm², beside the loss",
    )


def _training(group) -> None:
    group.add_argument(
        "--preset",
        choices=("cpu", "paper"),
        default="cpu",
        help="RED-Net of 10 layers of 32 maps (default), or of 30 layers of 64 maps",
    )
    group.add_argument("--depth", metavar="N", type=count, help="layers, an even number, instead of the preset's")
    group.add_argument("--width", metavar="N", type=count, help="maps of a layer, instead of the preset's")
    group.add_argument("--epochs", metavar="N", type=count, help="of each step (default 30)")
    group.add_argument("--batch", metavar="N", type=count, help="patches of a training step (default 32)")
    group.add_argument("--seed", metavar="N", type=seed_number, help="of every draw (default 0)")
    group.add_argument("--rate-network", metavar="R", type=positive_finite, help="Adam's, of weights (default 0.001)")
    group.add_argument(
        "--rate-optics", metavar="R", type=positive_finite, help="Adam's, of variables, in mm (default 0.001)"
    )
    group.add_argument(
        "--precision",
        choices=("auto", "float32", "bfloat16"),
        default="auto",
        help="of the network; auto (default) tries which this machine trains faster in, and keeps to it",
    )


def _compare(group) -> None:
    group.add_argument(
        "--models",
        metavar="MODEL",
        choices=(*MODELS, AFTER_PARAXIAL),
        nargs="+",
        help=f"rows of the table: {', '.join(MODELS)} (default: all), and {AFTER_PARAXIAL}: Gaussian DRT that begins "
        "where the paraxial run ended",
    )
    group.add_argument("--seeds", metavar="N", type=seed_number, nargs="+", help="of the runs (default 0 1 2)")
    group.add_argument(
        "--docs",
        metavar="DOCS",
        type=file_name,
        help="folder of the page and of codesign/, for compare and sweep (default: FOLDER)",
    )
    group.add_argument("--report-only", action="store_true", help="train nothing, write what the runs say so far")


WORDS = (
    (
        "codesign",
        "learn a lens and a network together",
        _DESCRIPTION,
        _EXAMPLES,
        _add_arguments,
        "studies.codesign.command.codesign",
    ),
)
