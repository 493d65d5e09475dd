"""`raytrace psf`."""

from raytrace.cli.options import Names, conditions, fields, lens, log, many, output, plot, positive_finite, window

SUMMARY = "point spread functions by five models"

DESCRIPTION = (
    "Compute point spread functions over object distance and field, integrated over pixels, to a tolerance. "
    "Models: paraxial, fourier, gaussian, drt (ray-traced), wave (diffraction of the traced wavefront). Several "
    "processes, or machines, share the kernels, or with --model drt --rays the rays, and give the result of one to "
    "rounding, written once: torchrun --nproc-per-node 2 -m raytrace psf …"
)

EXAMPLES = """examples:
  raytrace psf double_gauss --model gaussian --object-distance 10000 30000 --plot psf.png
  raytrace psf double_gauss --model wave --field 14 --center chief --tol 1e-3 -o psf.npz
  raytrace psf double_gauss --model drt --rays 256 --json
  raytrace psf double_gauss --model drt --rays 1e8 --max-bytes 200MB -o psf.npz
"""


def options(parser) -> None:
    lens(parser)
    parser.add_argument(
        "--model",
        metavar="MODEL",
        choices=Names("psf_models.models", "MODELS", "auto"),
        help="how much of the lens the PSF knows: paraxial, fourier, gaussian, drt or wave; auto (default) climbs "
        "until the next model changes nothing",
    )
    conditions(parser, several="one row of kernels each")
    fields(parser)
    window(parser, normalise="energy")
    parser.add_argument(
        "--center",
        choices=("axis", "chief", "centroid"),
        help="what the window is centred on: the optical axis (default with --field), the chief ray (default of the "
        "lens's own fields) or the centroid of the rays",
    )
    parser.add_argument(
        "--per-wavelength", action="store_true", help="a kernel for each wavelength instead of their weighted sum"
    )
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument("--tol", metavar="T", type=positive_finite, help="bound on the estimated error (default 0.01)")
    choice.add_argument(
        "--rays",
        metavar="N",
        type=many,
        help="rays per kernel instead of a tolerance; with --model drt and --max-bytes any number of them",
    )
    output(
        parser,
        "arrays to write (.npz): psf[distance, field, y, x], or [distance, field, wavelength, y, x], pixel_pitch, "
        "energy, error, wavelengths, model",
        (".npz",),
    )
    plot(parser, "the kernels, finely in windows that they fill (with --pixel or --size: the pixels),")
    log(parser)
