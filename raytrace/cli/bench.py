"""`raytrace bench`: its words and options; `bench.command` runs it."""

from raytrace.cli.options import count, file_name, folder_name, json, output, output_file, plot

SUMMARY = "measure speed against error"
DESCRIPTION = (
    "Measure, forward and backward, in float32 and float64: the trace against a high-precision reference, or every "
    "PSF model at every sampling against converged ones (minutes), or every engine of wave PSFs beside the transfer "
    "function it replaces (a minute), or the targets of speed: the trace beside limits of the machine (C++, built here "
    "if there is a compiler), its memory and whole processes (minutes), or how far and how fast lens files come by "
    "their own merit functions. With the extra [bench] Optiland runs beside trace, psf, speed and optimise."
)
EXAMPLES = """examples:
  raytrace bench trace
  raytrace bench psf -o speed_vs_error.md --csv speed_vs_error.csv --plot speed_vs_error.png
  raytrace bench trace --rays 1000 100000 -o bench.md --plot bench.png
  raytrace bench wave --docs docs
  raytrace bench optimise designs/*.zmx --docs docs
  raytrace bench speed --quick --repeats 1"""


def options(parser):
    parser.add_argument("what", choices=("trace", "psf", "wave", "speed", "optimise"), help="what to measure")
    parser.add_argument(
        "lenses",
        metavar="LENS",
        type=file_name,
        nargs="*",
        help="psf: lenses to measure, on the axis and at the largest field "
        "(default double_gauss phone hubble, in conditions of their own); optimise: files with a merit function",
    )
    json(parser)
    parser.add_argument("--lens", metavar="LENS", help="trace: lens to trace (default double_gauss)")
    parser.add_argument(
        "--rays", metavar="N", type=count, nargs="+", help="trace: numbers of rays (default 1000 10000 100000 1000000)"
    )
    parser.add_argument("--repeats", metavar="N", type=count, default=5, help="runs of which the median is kept")
    parser.add_argument("--threads", metavar="N", type=count, help="threads of torch")
    parser.add_argument("--no-peers", action="store_true", help="leave out Optiland even if it is installed")
    output(parser, "report to write (.md)", (".md",))
    parser.add_argument("--csv", metavar="FILE", type=output_file, help="psf: table to write, one line a figure")
    parser.add_argument(
        "--docs", metavar="DOCS", type=folder_name,
        help="wave, speed, optimise: folder for wave_bench.md and wave/, or speed.md or optimise.md, .csv and .png",
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="speed: few rays, to try it; its ratios mean little")
    plot(parser, "speed over number of rays, or time over error,")


run = "bench.command.run"
