"""`raytrace compare`."""

from raytrace.cli.options import (
    aperture,
    lens,
    log,
    object_distance,
    plot,
    positive,
    positive_finite,
    ray_aiming,
    size,
    wavelength,
)

SUMMARY = "the PSF models side by side"

DESCRIPTION = (
    "Compare DRT (256 rays), Gaussian DRT, paraxial, Fourier and wave PSFs on the axis over object distance, with "
    "one sensor, in windows of 21 pixels of 5 µm, at 0.53 µm unless told otherwise; and show by numbers what each "
    "can represent: change of the kernel when the conic of the most curved surface grows by 0.2; longer over "
    "shorter σ (of waves: of their rays) and asymmetry of the kernel of the largest field; radius of the first "
    "dark ring at F/16 over that of the Airy disc; how many of the lens's numbers move the kernel; rays traced. "
    "For these numbers DRT runs to a tolerance: the noise of 256 rays would pass for aberrations."
)

EXAMPLES = """examples:
  raytrace compare lenses/double_gauss.zmx --plot compare.png
  raytrace compare double_gauss --start rms --json"""


def options(parser) -> None:
    lens(parser)
    group = parser.add_argument_group("conditions other than the file's")
    object_distance(group, "the columns (default 10000 20000 30000 40000 50000)")
    aperture(group)
    wavelength(group)
    ray_aiming(group)
    parser.add_argument(
        "--start",
        choices=("paraxial", "rms"),
        help="where the one sensor stands: the paraxial image (default) or the least RMS spot on the axis",
    )
    parser.add_argument("--focus-distance", metavar="MM", type=positive, help="object in focus (default 25000)")
    parser.add_argument("--pixel", metavar="MM", type=positive_finite, help="pixel pitch (default 0.005)")
    size(parser, "the windows (default 21)")
    plot(parser, "the grid of kernels")
    log(parser)
