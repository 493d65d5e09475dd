"""`raytrace codesign`: its words and options. Imports no torch before it runs."""

import argparse
import importlib

from raytrace.cli.options import catalog, file_name, folder_or_lens, json, output_folder, seed_number, substitute
from raytrace.studies.codesign.settings import AFTER_PARAXIAL, MODELS, Settings
from raytrace.studies.options import add_options, documents, pictures
from raytrace.words import did_you_mean

SUMMARY = "learn a lens and a network together"
DESCRIPTION = """\
Learn the sensor distance (or any variables) of a lens together with a network that restores its pictures. Step 1
learns both with the PSFs of one model; step 2 freezes the lens and goes on with the network on PSFs of traced rays,
as long as step 1. `compare` runs every model and seed and writes tables, figures and a page about them; `sweep` finds
the optima of the closed form at several apertures, noises, normalisations, starts and numbers of rays; `spaces` those
of several variables in boxes of bounds, the focal length held and free; `fields` those over several fields; `retrain`
trains fresh networks on the lenses that compare found, each alike, and tells their losses apart seed by seed.

Models: paraxial (a Gaussian as wide as the paraxial blur), fourier (diffraction of the paraxial wavefront), gaussian
(Gaussian DRT: centroid and covariance of traced rays), drt (differentiable ray tracing: the rays themselves). Closed
form: the expected mean square error of pictures behind the best linear filter, from their power spectrum.

A run may be stopped at any moment: the same command goes on where it was, and ends in the same numbers. Several
processes share every batch: torchrun --nproc-per-node 2 -m raytrace codesign …"""
EXAMPLES = """examples:
  raytrace codesign double_gauss --loss spectral -o learned.zmx
  raytrace codesign double_gauss --model gaussian --data pictures -o run
  raytrace codesign double_gauss --start spectral --bounds sensor:57,58 --data pictures -o begun_in_closed_form
  raytrace codesign lens.zmx --vary sensor thickness:5,6 curvature:1-4 --f-number 4 -o run4
  raytrace codesign double_gauss --wavelength 0.53 0.48 0.62 --vary thickness:2,9 --air-thickness 0.5:50 -o colours
  raytrace codesign double_gauss --field 0 10 14 --normalise energy --epochs 10 -o fields --json
  raytrace codesign compare double_gauss --data pictures --seeds 0 1 2 -o study --docs docs
  raytrace codesign compare double_gauss --data pictures -o study --docs docs --report-only
  raytrace codesign sweep double_gauss --data pictures --docs docs
  raytrace codesign spaces double_gauss --vary sensor thickness:2,9 --box thickness_2:0.1,1 thickness_9:0.1,1 -o out
  raytrace codesign fields double_gauss --field 0 9.8 14 --size 51 --data pictures --docs docs
  raytrace codesign retrain double_gauss --sensors docs/codesign/table2.csv --data pictures -o fresh --docs docs"""

_SCENE = (
    *("vary", "bounds", "hold", "glass_thickness", "air_thickness", "edge", "start", "focus_distance", "f_number"),
    *("wavelengths", "wavelength_weights", "near", "far", "spread", "fields", "pixel", "size"),
    *("normalise", "rho", "noise", "tol", "rays", "drt_rays", "sampling", "vignetting"),
)
_TRAINING = ("depth", "width", "epochs", "batch", "seed", "rate_network", "rate_optics", "decay", "precision")

#: The forms of the command by their word, where they are carried out, and the options that only some of them know.
_FORMS = {
    "": ("single", "single"),
    "compare": ("compare", "compare"),
    "sweep": ("sweep_page", "sweep"),
    "spaces": ("spaces_page", "spaces"),
    "fields": ("fields_page", "fields"),
    "retrain": ("retrain_page", "retrain_all"),
}
_BELONG = {
    "models": ("compare", "retrain"),
    "seeds": ("compare", "retrain"),
    "report_only": ("compare", "retrain"),
    "docs": ("compare", "sweep", "spaces", "fields", "retrain"),
    "page": ("compare", "spaces", "retrain"),
    "box": ("spaces",),
    "sensors": ("retrain",),
    "model": ("",),
    "seed": ("",),
    "resume": ("", "compare"),
}


def options(parser: argparse.ArgumentParser) -> None:
    parser.usage = "raytrace codesign [compare | sweep | spaces | fields | retrain] LENS [-o FOLDER] [options]"
    parser.add_argument(
        "words",
        metavar="LENS",
        type=file_name,
        nargs="+",
        help="lens file, or the name of a shipped lens; before it `compare` runs all models and seeds, "
        "`sweep`, `spaces` and `fields` find optima of the closed form, `retrain` compares known lenses",
    )
    catalog(parser)
    substitute(parser)
    json(parser)
    output_folder(
        parser,
        "folder of the run, or of all runs of compare, in each of which lens.zmx is the learned lens; or a lens file "
        "(.zmx, .csv) for it, the run then being kept in a folder of the same name without suffix",
        type=folder_or_lens,
    )
    parser.add_argument("--resume", action="store_true", help="only go on with a run that was begun in FOLDER")
    add_options(parser, Settings, "model")
    parser.add_argument(
        "--loss",
        choices=("image", "spectral"),
        default="image",
        help="image: L1 of restored pictures, by training (default); spectral: the closed form, without a network, "
        "in seconds",
    )
    what = "folder of pictures, in any subfolders; four fifths of them train, the others test"
    pictures(parser, what, "patch", "crops", settings=Settings)
    scene = parser.add_argument_group("lens and scene")
    add_options(scene, Settings, *_SCENE)
    scene.add_argument(
        "--file-wavelengths", action="store_true", help="the file's wavelengths with their weights (default 0.53 µm)"
    )
    training = parser.add_argument_group("network and training")
    training.add_argument(
        "--preset",
        choices=("cpu", "paper"),
        default="cpu",
        help="RED-Net of 10 layers of 32 maps (default), or of 30 layers of 64 maps",
    )
    add_options(training, Settings, *_TRAINING)
    _compare(parser.add_argument_group("compare, sweep, spaces, fields and retrain"))


def _compare(group) -> None:
    group.add_argument(
        "--models",
        metavar="MODEL",
        choices=(*MODELS, AFTER_PARAXIAL),
        nargs="+",
        help=f"rows of the table: {', '.join(MODELS)} (default: all), and {AFTER_PARAXIAL}: Gaussian DRT that begins "
        "where the paraxial run ended",
    )
    group.add_argument(
        "--seeds", metavar="N", type=seed_number, nargs="+", help="of the runs (default 0 1 2; of retrain 0 to 4)"
    )
    group.add_argument("--sensors", metavar="TABLE", type=file_name, help="table2.csv of the lenses to retrain on")
    group.add_argument(
        "--box",
        metavar="NAME:LOW,HIGH",
        nargs="+",
        action="append",
        help="of spaces: bounds to search in; several boxes",
    )
    documents(group, "the page and of codesign/ (default: FOLDER)")
    group.add_argument(
        "--page",
        metavar="NAME",
        type=file_name,
        help="of a second study there: NAME.md (of retrain NAME_retrain.md) and NAME/ (default codesign); of spaces "
        "NAME.md, its table in codesign/ (default codesign_air_spaces)",
    )
    group.add_argument("--report-only", action="store_true", help="train nothing, write what the runs say so far")


def run(arguments: argparse.Namespace) -> None:
    """One model; with the word `compare` all of them; with `sweep` the closed form by what the paper leaves open, with
    `spaces` by boxes of bounds, with `fields` over fields; with `retrain` fresh networks for lenses of a comparison."""
    from raytrace.cli.door import CommandError
    from raytrace.shards import processes

    *before, arguments.lens = arguments.words
    form = before[0] if before else ""
    if len(before) > 1 or form not in _FORMS:
        raise CommandError(
            f"{' '.join(arguments.words)}: expected LENS, or {', '.join(filter(None, _FORMS))} LENS"
            f"{did_you_mean(form, _FORMS)}"
        )
    for name, forms in _BELONG.items():
        if form not in forms and getattr(arguments, name) not in (None, False):
            raise CommandError(f"--{name.replace('_', '-')} belongs to {' and '.join(map(_spelled, forms))}")
    if form and arguments.loss == "spectral":
        raise CommandError(
            "--loss spectral belongs to codesign LENS; compare, sweep, spaces and fields use the closed form anyway"
        )
    if arguments.resume and arguments.loss == "spectral":
        raise CommandError("--resume belongs to training: --loss spectral is done at once, leave one of both out")
    module, name = _FORMS[form]
    if arguments.loss == "spectral":
        name = "spectral"
    with processes():
        importlib.import_module(f"raytrace.studies.codesign.{module}").__dict__[name](arguments)


def _spelled(form: str) -> str:
    return " ".join(filter(None, ("codesign", form, "LENS")))
