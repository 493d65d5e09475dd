"""`raytrace optimize`."""

from raytrace.cli import options as words

SUMMARY = "move the variables of a lens to the least of its merit function"
DESCRIPTION = (
    "Optimise a lens: damped least squares on the exact derivatives of every row of its merit function, that of the "
    "file unless told otherwise. Solves and pickups hold at every step. -o writes the lens, with its variables and its "
    "merit function; ctrl-C ends with the best lens so far, which is written too."
)
EXAMPLES = """examples:
  raytrace optimize lens.zmx -o better.zmx --plot better.png
  raytrace optimize double_gauss --merit spot --vary curvature thickness --seconds 10 -o better.zmx
  raytrace optimize lens.zmx --cycles 50 --checkpoint best.json --log cycles.csv
  raytrace optimize lens.zmx --resume best.json -o better.zmx"""


def options(parser):
    words.lens(parser)
    aims = parser.add_argument_group("what is optimised, where it is not the file's")
    aims.add_argument(
        "--merit", choices=words.Names("merit.default", "KINDS"), help="a default merit function instead of the file's"
    )
    aims.add_argument(
        "--vary", metavar="WHAT", nargs="+", help="what varies, as curvature thickness:5,6 conic:3 a4:3 tilt:5; with "
        "pickups: curvature:1-3 curvature:4=-curvature:3"
    )  # fmt: skip
    aims.add_argument(
        "--bounds", metavar="NAME:LOW,HIGH", nargs="+", help="of variables, as thickness:2,15 curvature_3:-0.1,0.1"
    )
    aims.add_argument(
        "--skip-unknown", action="store_true", default=None, help="leave rows of unknown operands out of the merit"
    )
    own = parser.add_argument_group("of a default merit function")
    own.add_argument("--rings", metavar="N", type=words.count, help="rings of rays in the pupil (default 3)")
    own.add_argument("--arms", metavar="N", type=words.count, help="arms of rays in the pupil, even (default 6)")
    own.add_argument("--reference", choices=("centroid", "chief"), help="what rays are told from (default centroid)")
    own.add_argument(
        "--frequency", dest="frequencies", metavar="F", type=words.positive_finite, nargs="+", help="of mtf, cycles/mm"
    )
    for name in ("field", "wavelength"):
        option = f"--{name}-weights"
        own.add_argument(option, metavar="W", type=words.positive_finite, nargs="+", help=f"one a {name}")
    for name in ("glass", "air"):
        own.add_argument(f"--{name}-thickness", metavar="MIN[:MAX]", help=f"of {name} on the axis, mm, as 2:15")
    own.add_argument("--edge", metavar="MIN", type=words.positive_finite, help="least of glass at its edge, mm")
    ends = parser.add_argument_group("how long")
    ends.add_argument("--cycles", metavar="N", type=words.count, help="end after so many cycles")
    ends.add_argument("--seconds", metavar="S", type=words.positive_finite, help="end after so much time")
    ends.add_argument("--paths", metavar="N", type=words.count, help="ways of damping that are tried (default 1)")
    files = parser.add_argument_group("files")
    files.add_argument("--log", metavar="FILE", type=words.data_file, help="a line for every cycle (.csv)")
    files.add_argument("--checkpoint", metavar="FILE", type=words.data_file, help="keep the best variables there")
    files.add_argument("--resume", metavar="FILE", type=words.file_name, help="start from a checkpoint")
    words.plot(parser, "the lens, its spots and its merit function, before and after")
    words.output(parser, "lens file to write")


def run(arguments):
    """The verb; a lens that could not be written is refused before the work."""
    import sys

    from raytrace.cli.door import refuse_suffix
    from raytrace.cli.run import verb_of_lens
    from raytrace.formats import WRITTEN

    refuse_suffix("-o", arguments.output, WRITTEN)
    return verb_of_lens(sys.modules[__name__], arguments)
