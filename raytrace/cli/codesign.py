"""`raytrace codesign`: its options. Imports no torch before it runs."""

import argparse

from raytrace.cli.options import OPTIONS, catalog, json, output_folder, plot, substitute
from raytrace.cli.settings import SEED, add_options, defaults_of, listed, option, picture_options, settings_options
from raytrace.cli.types import (
    count,
    extent,
    field_point,
    file_name,
    folder_or_lens,
    not_negative,
    positive,
    positive_finite,
)
from raytrace.settings import GRADES, MODELS, CodesignSettings

SUMMARY = "optimise a lens together with a restoration network"
DESCRIPTION = """\
Optimise the sensor distance (or any variables) of a lens for a network that restores its images. Step 1 brings the lens
to the optimum of the closed form by steps of second order, and trains the network behind it, with the PSFs of one model
(--optimizer adam trains both together); step 2 continues to train the network on PSFs of traced rays, for as many
epochs.

Models: paraxial (a Gaussian as wide as the paraxial blur), fourier (diffraction of the paraxial wavefront), gaussian
(Gaussian DRT: centroid and covariance of traced rays), drt (differentiable ray tracing: the rays themselves). Closed
form: the expected mean square error of images behind the best linear filter, from their power spectrum.

A run may be interrupted at any time: the same command resumes it bit-identically. Several processes share every batch:
torchrun --nproc-per-node 2 -m raytrace codesign …"""
EXAMPLES = """examples:
  raytrace codesign double_gauss --loss spectral -o learned.zmx
  raytrace codesign double_gauss --model gaussian --data pictures -o run --plot loss.png
  raytrace codesign double_gauss --start spectral --bounds sensor:57..58 --data pictures -o from_closed_form
  raytrace codesign cooke_triplet --vary curvature sensor --hold efl --field 0 8 12 --data pictures -o lm
  raytrace codesign lens.zmx --vary sensor thickness:5,6 curvature:1-4 --f-number 4 -o run4
  raytrace codesign double_gauss --wavelength 0.53 0.48 0.62 --vary thickness:2,9 --air-thickness 0.5:50 -o colours
  raytrace codesign double_gauss --field 0 10 14 --normalise energy --epochs 10 -o fields --json
  raytrace codesign cooke_triplet --sensor 24x16 --vary thickness curvature --hold efl buildable --preset unet -o colour
  raytrace codesign double_gauss --as-built --grade commercial --vary curvature:1,11 sensor --optimizer adam -o built
  raytrace codesign double_gauss --grade commercial --vary curvature:1,11 sensor --optimizer adam -o nominal
  raytrace codesign cooke_triplet --settings run/settings.json --set rate_optics=5e-4 decay=cosine -o again"""

#: The options by the field of `CodesignSettings`.
ROWS = {
    "model": option("PSF model of step 1", "MODEL", choices=MODELS, type=str.lower),
    "vary": option(
        "variables: sensor (default), thickness:5,6 curvature:1-4; pickups curvature:6=-curvature:1", "WHAT", nargs="+"
    ),
    "bounds": option("of variables: sensor:57.5..58 curvature_3:-0.04..0 (mm, 1/mm)", "NAME:LOW..HIGH", nargs="+"),
    "hold": option(
        "efl (the file's focal length) or efl=100: the last variable with power is solved for it; further conditions "
        "of optimize, as total_track<=120, and buildable, thicknesses within their limits: exact after every step; in "
        "addition to the conditions of the lens unless --no-hold is given",
        "NAME=VALUE",
        nargs="+",
    ),
    "no_hold": option("without the conditions of the lens (default: with them); with --hold: those alone"),
    "step": option(
        "unit of the variables, of which --rate-optics is a part in mm: sag at the edge (default), or blur, the RMS "
        "spread of the rays of all fields: the same for every number of any lens",
        choices=("sag", "blur"),
    ),
    "optimizer": option(
        "of the lens: lm (default), steps of second order to the optimum of the closed form, from the best spots and "
        "from the file's lens, behind which the network is trained; or adam, together with the network",
        choices=("adam", "lm"),
    ),
    "turns": option(
        "after the network is trained, so many times in turns: steps of second order of the lens, for the loss of a "
        "network that adapts to it, then the network again for --epochs",
        type=count,
    ),
    "relearn": option(
        "epochs of step 1 again, with the nearest catalog glasses in place of varied ones (index:1 abbe_number:1)",
        type=count,
    ),
    "glasses": option(OPTIONS["glasses"].help, "WORD", nargs="+"),
    "filters": option(
        "of the closed form and of the comparison: a Wiener filter of each colour (separate, default), or one of all "
        "colours (joint)",
        choices=("separate", "joint"),
    ),
    "filter_each_field": option(
        "closed form with filters for each field (default: one for all, as a network that does not know the field)"
    ),
    "glass_thickness": option(
        "centre thickness of elements: minimum, or minimum and maximum (default 1/50 of the largest diameter)",
        "MIN[:MAX]",
    ),
    "air_thickness": option(
        "of air between elements (default 1/2000 of the largest diameter); edges may touch", "MIN[:MAX]"
    ),
    "edge": option(
        "minimum edge thickness of elements (default 1/100); a violation is a penalty in mm²",
        "MIN",
        type=positive_finite,
    ),
    "start": option(
        "initial sensor distance: paraxial (default; the image of --focus-distance), rms (its least RMS spot), "
        "spectral (the optimum of the closed form), gaussian (that of Gaussian DRT), or a distance",
        "PLACE",
    ),
    "focus_distance": option("object distance of --start (default 25000); inf allowed", "MM", type=positive),
    "f_number": option("other than the file's", "N", type=positive_finite),
    "wavelengths": option("the first is primary (default 0.53)", "UM", name="wavelength"),
    "wavelength_weights": option("of --wavelength (default 1 each)", "W"),
    "near": option("nearest object", "MM"),
    "far": option("furthest object", "MM"),
    "spread": option(
        "distribution of object distances z: uniform in z (uniform, default) or in 1/z (reciprocal)",
        name="distances",
        choices=("uniform", "reciprocal"),
    ),
    "fields": option("field points Y, in the file's kind of field (default 0)", "F", name="field", type=field_point),
    "pixel": option("pixel pitch", "MM"),
    "size": option("pixels across the window of the PSF"),
    "normalise": option(
        "PSFs sum to 1 over the entrance pupil (energy), or in each window (window, default)",
        choices=("energy", "window"),
    ),
    "rho": option("of the paraxial model: σ over the radius of the blur", "R"),
    "noise": option("standard deviation, for images from 0 to 1", "S"),
    "tol": option("error bound of a PSF", "T"),
    "rays": option("fixed rays of a traced PSF in step 1, instead of as many as --tol needs", type=count),
    "drt_rays": option(
        "fixed rays of every DRT PSF, in step 1, step 2 and its tests, instead of as many as --tol needs", type=count
    ),
    "sampling": option("pupil sampling of --rays and --drt-rays (default sobol)", choices=("sobol", "hexapolar")),
    "vignetting": option(
        "rays beyond the semi-diameters of the file: traced (none, default), or vignetted (semi-diameters)",
        choices=("none", "semi-diameters"),
    ),
    "ray_aiming": option(OPTIONS["ray_aiming"].help, choices=OPTIONS["ray_aiming"].choices),
    "sensor": option(
        "width and height in mm, as 24x16: pictures in colour at random places of the sensor, with the PSFs, the "
        "lateral colour and the noise there (default: grey pictures of --field)",
        "WxH",
        type=extent,
        nargs=None,
        between="x",
    ),
    "response": option(
        "rgb (default), grey, a table wavelength_nm,r,g,b (.csv), or a measured camera: 'Nikon 5100 (NPL)'", "NAME"
    ),
    "mosaic": option(
        "Bayer pattern, RGGB, BGGR, GRBG or GBRG; missing colours are interpolated (default none)", "PATTERN"
    ),
    "full_well": option(
        "electrons of white: adds shot noise, and --read-noise instead of --noise", "E", type=positive_finite
    ),
    "read_noise": option("standard deviation in electrons, with --full-well", "E", type=not_negative),
    "bits": option("of the quantisation (default: none)", "N", type=count),
    "depth": option("layers, an even number, or poolings of the U-Net, instead of the preset's"),
    "width": option("maps of a layer, instead of the preset's"),
    "epochs": option("of each step"),
    "batch": option("patches of a training step"),
    "seed": SEED,
    "rate_network": option("Adam's, of weights", "R"),
    "rate_optics": option("Adam's, of variables, in mm", "R"),
    "decay": option(
        "Adam's rates over a step: constant (none, default), or falling to 0 along half a cosine",
        choices=("none", "cosine"),
    ),
    "precision": option(
        "of the network; auto (default) uses the faster one on this machine and stores the choice in the run",
        choices=("auto", "float32", "bfloat16"),
    ),
    "as_built": option(
        "train on perturbed lenses, another one for each patch: the network, and with --optimizer adam the lens, learn "
        "to bear the errors of manufacture; the tolerances are those of --grade and --limits, or of the file"
    ),
    "grade": option(
        "tolerances of a published grade (default: those of the file); without --as-built the training is nominal, and "
        "the test alone takes perturbed cameras",
        choices=GRADES,
    ),
    "limits": option(
        "limits ± that replace those of the grade or the file, radius=0.1%% thickness=0.02 element_tilt=0.05; index=0 "
        "leaves one out",
        "NAME=LIMIT",
        nargs="+",
    ),
    "refocus": option(
        "sensor (default): the sensor of every perturbed lens moves by as much as its errors move the best focus; "
        "none: it stays",
        choices=("sensor", "none"),
    ),
    "cameras": option("perturbed cameras of the test, in no training, the same for every seed and training"),
    "center": option(
        "origin of the PSF window: chief (the chief ray; default of a nominal lens) or centroid (of the light; default "
        "with tolerances)",
        choices=("chief", "centroid"),
    ),
    "patch": option("pixels across a restored patch"),
    "crops": option("patches of a picture in an epoch"),
}
_OF_ONE_RUN = ("model", "seed")
#: Options that the help page shows; settings of a file, or of --set, are all of them.
_SHOWN = (
    *("vary", "bounds", "hold", "no_hold", "start", "f_number", "wavelengths", "near", "far", "fields", "sensor"),
    *("as_built", "grade", "optimizer", "turns", "epochs", "batch", "noise"),
)


EXAMPLES += "\n\n" + listed(CodesignSettings, ROWS)


def options(parser: argparse.ArgumentParser) -> None:
    experiment_options(parser)
    add_options(parser, defaults_of(CodesignSettings), ROWS, *_OF_ONE_RUN)
    parser.add_argument(
        "--loss",
        choices=("image", "spectral"),
        default="image",
        help="image: L1 of restored images, by training (default); spectral: the closed form, without a network, "
        "in seconds",
    )
    plot("the loss over the steps of training, or over the evaluations of the closed form")(parser)


def experiment_options(parser: argparse.ArgumentParser) -> None:
    """All options but those of a single run: the experiment that several models and seeds can share."""
    parser.add_argument("lens", metavar="LENS", type=file_name, help="lens file, or the name of a shipped lens")
    catalog(parser)
    substitute(parser)
    json(parser)
    output_folder(
        "folder of the run; the optimised lens is lens.zmx there. A lens file (.zmx, .csv) is written in addition to a "
        "folder of the same name without suffix",
        reader=folder_or_lens,
    )(parser)
    parser.add_argument("--device", metavar="NAME", default="cpu", help="of the training, cpu or cuda (default cpu)")
    parser.add_argument("--resume", action="store_true", help="only resume a run in FOLDER, start none")
    defaults = defaults_of(CodesignSettings)
    settings_options(parser.add_argument_group("settings"), CodesignSettings)
    picture_options(parser, "folder of pictures, in any subfolders; four fifths train, the others test")
    experiment = parser.add_argument_group(
        "experiment",
        "With --sensor the camera is a product: colour, the whole field, its noise, and the\n"
        "wavelengths of the file unless --wavelength names others. Errors of manufacture are drawn by\n"
        "the number of the sample.",
    )
    add_options(experiment, defaults, ROWS, *_SHOWN)
    experiment.add_argument(
        "--file-wavelengths", action="store_true", help="the file's wavelengths with their weights (default 0.53 µm)"
    )
    experiment.add_argument(
        "--preset",
        choices=("cpu", "paper", "unet"),
        default="cpu",
        help="RED-Net of 10 layers of 32 maps (cpu, default), of 30 layers of 64 maps (paper), or a small U-Net (unet)",
    )
    others = [name for name in ROWS if name not in (*_SHOWN, *_OF_ONE_RUN)]
    add_options(parser, defaults, ROWS, *others, hidden=True)
