"""The commands of `raytrace`: their words, their arguments, and what runs them. Imports no torch."""

from raytrace.cli import wave
from raytrace.cli.analysis_table import ANALYSES
from raytrace.cli.command import Command
from raytrace.cli.options import (
    aperture,
    conditions,
    count,
    fields,
    file_name,
    json,
    lens,
    object_distance,
    output,
    plot,
    positive,
    positive_finite,
    sampling,
    size,
    wavelength,
    window,
)
from raytrace.cli.studies import words


def _info(parser):
    lens(parser)
    conditions(parser)


def _layout(parser):
    lens(parser)
    conditions(parser)
    fields(parser)
    plot(parser, "the cross section (default LENS_layout.png in this folder)")


def _focus(parser):
    lens(parser)
    conditions(parser, several="several are focused together")
    fields(parser)
    parser.add_argument(
        "--criterion",
        choices=("rms", "paraxial", "mean"),
        default="rms",
        help="least RMS spot radius (default), paraxial image, or least mean distance from the centroid",
    )
    parser.add_argument("--distance-weights", metavar="W", type=positive_finite, nargs="+", help="one a distance")
    parser.add_argument("--field-weights", metavar="W", type=positive_finite, nargs="+", help="one a field")
    parser.add_argument("--wavelength-weights", metavar="W", type=positive_finite, nargs="+", help="one a wavelength")
    sampling(parser, rings=12)
    plot(parser, "the through-focus curve, the spots before and after, and the layout")
    output(parser, "lens file to write with the new sensor distance")


def _psf(parser):
    lens(parser)
    parser.add_argument(
        "--model",
        choices=("auto", "paraxial", "fourier", "gaussian", "drt", "wave"),
        default="auto",
        help="how much of the lens the PSF knows; auto (default) climbs until the next model changes nothing",
    )
    conditions(parser, several="one row of kernels each")
    fields(parser)
    window(parser, normalise="energy")
    parser.set_defaults(normalise="energy", rho=0.5)
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
    choice.add_argument("--rays", metavar="N", type=count, help="rays per kernel instead of a tolerance")
    output(
        parser,
        "arrays to write (.npz): psf[distance, field, y, x], or [distance, field, wavelength, y, x], pixel_pitch, "
        "energy, error, wavelengths, model",
    )
    plot(parser, "the kernels, finely in windows that they fill (with --pixel or --size: the pixels),")
    _log(parser)


def _log(parser):
    parser.add_argument("--log", action="store_true", help="draw brightness on a logarithmic scale of four decades")


def _bench(parser):
    parser.add_argument("what", choices=("trace", "psf", "codesign", "wave", "speed"), help="what to measure")
    parser.add_argument(
        "lenses",
        metavar="LENS",
        type=file_name,
        nargs="*",
        help="psf: lenses to measure, on the axis and at the largest field "
        "(default double_gauss phone hubble, in conditions of their own)",
    )
    json(parser)
    parser.add_argument("--lens", metavar="LENS", help="trace: lens to trace (default double_gauss)")
    parser.add_argument(
        "--rays", metavar="N", type=count, nargs="+", help="trace: numbers of rays (default 1000 10000 100000 1000000)"
    )
    parser.add_argument("--repeats", metavar="N", type=count, default=5, help="runs of which the median is kept")
    parser.add_argument("--threads", metavar="N", type=count, help="threads of torch")
    parser.add_argument("--no-peers", action="store_true", help="leave out Optiland even if it is installed")
    output(parser, "report to write (.md)")
    parser.add_argument("--csv", metavar="FILE", type=file_name, help="psf: table to write, one line a figure")
    parser.add_argument(
        "--docs",
        metavar="DOCS",
        type=file_name,
        help="codesign, wave, speed: folder for codesign_accuracy.md and codesign/, wave_bench.md and wave/, or "
        "speed.md, .csv and .png",
    )
    parser.add_argument("--quick", action="store_true", help="speed: few rays, to try it; its ratios mean little")
    plot(parser, "speed over number of rays, or time over error,")


def _compare(parser):
    lens(parser)
    group = parser.add_argument_group("conditions other than the file's")
    distances = [10000.0, 20000.0, 30000.0, 40000.0, 50000.0]
    object_distance(group, "the columns (default 10000 20000 30000 40000 50000)", default=distances)
    parser.set_defaults(distances_together=True)
    aperture(group)
    wavelength(group)
    parser.add_argument(
        "--start",
        choices=("paraxial", "rms"),
        default="paraxial",
        help="where the one sensor stands: the paraxial image (default) or the least RMS spot on the axis",
    )
    parser.add_argument(
        "--focus-distance", metavar="MM", type=positive, default=25000.0, help="object in focus (default 25000)"
    )
    parser.add_argument("--pixel", metavar="MM", type=positive_finite, help="pixel pitch (default 0.005)")
    size(parser, "the windows (default 21)")
    plot(parser, "the grid of kernels")
    _log(parser)


COMMANDS = (
    Command(
        "info",
        "first-order data and the surfaces of a lens",
        "Print focal lengths, pupils, magnification and the prescription of a lens.",
        """examples:
  raytrace info double_gauss
  raytrace info lenses/double_gauss.zmx --object-distance 25000 --f-number 4
  raytrace info lens.zmx --json | python3 -m json.tool""",
        _info,
        "cli.lens_commands.info",
    ),
    Command.of("cli.check"),
    Command.of("cli.convert"),
    Command(
        "layout",
        "draw the lens with rays",
        "Draw the cross section of a lens with the rays of its fields.",
        """examples:
  raytrace layout double_gauss --plot layout.png
  raytrace layout lens.zmx --field 0 14 -14,0 --plot layout.pdf""",
        _layout,
        "cli.lens_commands.layout",
    ),
    Command.of("cli.spot"),
    Command(
        "focus",
        "find the best sensor distance",
        "Find the sensor distance of the least RMS spot (closed form, nothing is retraced), on axis and at the primary "
        "wavelength unless told otherwise.",
        """examples:
  raytrace focus lenses/double_gauss.zmx --object-distance 25000 --plot focus.png
  raytrace focus lens.zmx --object-distance 10000 25000 50000 --field 0 10 14 -o focused.zmx""",
        _focus,
        "cli.focus_commands.focus",
    ),
    Command.of("cli.trace"),
    Command(
        "psf",
        "point spread functions by five models",
        "Compute point spread functions over object distance and field, integrated over pixels, to a tolerance. "
        "Models: paraxial, fourier, gaussian, drt (ray-traced), wave (diffraction of the traced wavefront). Several "
        "processes, or machines, share the kernels, or with --model drt --rays and for a single kernel of --model "
        "gaussian the rays, and give the result of one to rounding, written once: torchrun --nproc-per-node 2 -m "
        "raytrace psf …",
        """examples:
  raytrace psf double_gauss --model gaussian --object-distance 10000 30000 --plot psf.png
  raytrace psf double_gauss --model wave --field 14 --center chief --tol 1e-3 -o psf.npz
  raytrace psf double_gauss --model drt --rays 256 --json
""",
        _psf,
        "cli.psf_commands.psf",
    ),
    Command(
        "compare",
        "the PSF models side by side",
        "Compare DRT (256 rays), Gaussian DRT, paraxial, Fourier and wave PSFs on the axis over object distance, with "
        "one sensor, in windows of 21 pixels of 5 µm, at 0.53 µm unless told otherwise; and show by numbers what each "
        "can represent: change of the kernel when the conic of the most curved surface grows by 0.2; longer over "
        "shorter σ (of waves: of their rays) and asymmetry of the kernel of the largest field; radius of the first "
        "dark ring at F/16 over that of the Airy disc; how many of the lens's numbers move the kernel; rays traced. "
        "For these numbers DRT runs to a tolerance: the noise of 256 rays would pass for aberrations.",
        """examples:
  raytrace compare lenses/double_gauss.zmx --plot compare.png
  raytrace compare double_gauss --start rms --json""",
        _compare,
        "cli.psf_commands.compare",
    ),
    Command.of("cli.glass"),
    Command(
        "bench",
        "measure speed against error",
        "Measure, forward and backward, in float32 and float64: the trace against a high-precision reference, or every "
        "PSF model at every sampling against converged ones (minutes), or what learns lenses in co-design: few rays "
        "beside many, and the models beside DRT (minutes), or every engine of wave PSFs beside the transfer function "
        "it replaces (a minute), or the targets of speed: the trace beside limits of the machine (C++, built here if "
        "there is a compiler), its memory and whole processes (minutes). With the extra [bench] Optiland runs beside "
        "trace, psf and speed.",
        """examples:
  raytrace bench trace
  raytrace bench psf -o speed_vs_error.md --csv speed_vs_error.csv --plot speed_vs_error.png
  raytrace bench trace --rays 1000 100000 -o bench.md --plot bench.png
  raytrace bench codesign --docs docs
  raytrace bench wave --docs docs
  raytrace bench speed --quick --repeats 1""",
        _bench,
        "bench.command.bench",
    ),
    *(Command(*entry) for entry in ANALYSES),
    *(Command(*entry) for entry in words("codesign")),
    Command("wave", wave.SUMMARY, wave.DESCRIPTION, wave.EXAMPLES, wave.options, "cli.wave.options"),
)
