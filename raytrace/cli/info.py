"""`raytrace info`."""

from raytrace.cli import options as words

SUMMARY = "first-order data and the surfaces of a lens"
DESCRIPTION = "Print focal lengths, pupils, magnification and the prescription of a lens."
EXAMPLES = """examples:
  raytrace info double_gauss
  raytrace info lenses/double_gauss.zmx --object-distance 25000 --f-number 4
  raytrace info lens.zmx --json | python3 -m json.tool"""


def options(parser):
    words.lens(parser)
    words.conditions(parser)
