"""`raytrace layout`."""

from raytrace.cli import options as words

SUMMARY = "draw the lens with rays"
DESCRIPTION = "Draw the cross section of a lens with the rays of its fields; folded systems as they stand."
EXAMPLES = """examples:
  raytrace layout double_gauss --plot layout.png
  raytrace layout lens.zmx --field 0 14 -14,0 --plot layout.pdf
  raytrace layout folded_relay --view 3d --plot relay.png
  raytrace layout spectrometer --wavelength 0.45 0.55 0.65
  raytrace layout scanner.zmx --configuration all --plot scan.png"""


def options(parser):
    words.lens(parser, all_configurations="in one figure, superimposed")
    words.conditions(parser)
    words.fields(parser)
    parser.add_argument(
        "--view", default="yz", choices=("yz", "xz", "3d"), help="from the side (default), from above, or in space"
    )
    parser.add_argument("--rays", metavar="N", type=words.count, default=7, help="rays of each fan (default 7)")
    words.plot(parser, "the cross section (default LENS_layout.png in this folder)")


def run(arguments):
    """The cross section, which has a name of its own if it is given none."""
    import sys
    from pathlib import Path

    from raytrace.cli.run import verb_of_lens

    arguments.plot = arguments.plot or f"{Path(arguments.lens).stem}_layout{arguments.suffix}.png"
    return verb_of_lens(sys.modules[__name__], arguments)
