"""`raytrace evaluate`."""

from raytrace.cli import options as words
from raytrace.cli.merit_options import merit

SUMMARY = "merit function of a lens, row by row"
DESCRIPTION = (
    "Evaluate a merit function: the file's, or a default one by --merit. Each row has its operand, arguments, target, "
    "weight, value and the part that it has in the square of the merit; in long tables the rays of a field share a "
    "line, --each lists them all. Rows of operands that are not known are an error if they have a weight."
)
EXAMPLES = """examples:
  raytrace evaluate lens.zmx
  raytrace evaluate double_gauss --merit spot --rings 6 --arms 8 --plot merit.png
  raytrace evaluate tessar --merit wavefront --glass-thickness 2:15 --air-thickness 0.5:50 --edge 1 --json
  raytrace evaluate zoom.zmx --configuration 2 --skip-unknown"""


def options(parser):
    words.lens(parser)
    words.conditions(parser)
    merit(parser)
    parser.add_argument("--each", action="store_true", help="list every row, also the rays of one field")
    words.plot(parser, "which rows the merit is made of, by operand and field")


def run(arguments):
    """The verb; a lens without a merit function is told how to choose one."""
    import sys

    from raytrace.cli.run import verb_of_lens

    return verb_of_lens(sys.modules[__name__], arguments)
