"""The commands of `raytrace`: their words, their arguments, and what runs them. Imports no torch."""

from raytrace.cli import wave
from raytrace.cli.analysis_table import ANALYSES
from raytrace.cli.command import Command
from raytrace.cli.options import (
    conditions,
    count,
    fields,
    file_name,
    json,
    lens,
    output,
    plot,
    positive_finite,
    sampling,
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
    Command.of("cli.psf"),
    Command.of("cli.compare"),
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
