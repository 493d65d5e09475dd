"""`raytrace optimize`."""

from raytrace.cli import options as words
from raytrace.cli.merit_options import freedom, merit

SUMMARY = "move the variables of a lens to the least of its merit function"
DESCRIPTION = (
    "Optimise a lens: damped least squares on the exact derivatives of every row of its merit function, that of the "
    "file unless told otherwise. Solves and pickups hold at every step. -o writes the lens, with its variables and its "
    "merit function; ctrl-C ends with the best lens so far, which is written too."
)
EXAMPLES = """examples:
  raytrace optimize lens.zmx -o better.zmx --plot better.png
  raytrace optimize double_gauss --merit spot --vary curvature thickness --seconds 10 -o better.zmx
  raytrace optimize tessar --merit spot --vary curvature sensor thickness:2,4 --bounds thickness:1.. --hold efl=100
  raytrace optimize tessar --merit spot --vary curvature sensor glass --hold efl=100 --catalog SCHOTT -o better.zmx
  raytrace optimize lens.zmx --cycles 50 --checkpoint best.json --log cycles.csv
  raytrace optimize lens.zmx --cycles 100 --resume best.json --checkpoint best.json -o better.zmx"""


def options(parser):
    words.lens(parser)
    words.ray_aiming(parser)
    merit(parser)
    freedom(parser)
    ends = parser.add_argument_group("how long")
    ends.add_argument(
        "--cycles", metavar="N", type=words.count, help="end after so many, those before --resume too (default 500)"
    )
    ends.add_argument("--seconds", metavar="S", type=words.positive_finite, help="end after so much time")
    ends.add_argument("--paths", metavar="N", type=words.count, help="ways of damping that are tried (default 1)")
    files = parser.add_argument_group("files")
    files.add_argument("--log", metavar="FILE", type=words.data_file, help="write a line for every cycle (.csv)")
    files.add_argument(
        "--checkpoint",
        metavar="FILE",
        type=words.data_file,
        help="keep all that decides the next cycle there (.json)",
    )
    what = "resume from a checkpoint of the same lens, variables and merit function"
    files.add_argument("--resume", metavar="FILE", type=words.file_name, help=what)
    words.plot(parser, "the lens, its spots and its merit function, before and after")
    words.output_lens(parser, "lens file to write")


def run(arguments):
    """The verb; a lens without variables or a merit function is told how to choose them."""
    import sys

    from raytrace.cli.run import verb_of_lens

    return verb_of_lens(sys.modules[__name__], arguments)
