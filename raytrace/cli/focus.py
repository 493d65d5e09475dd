"""`raytrace focus`."""

from raytrace.cli import options as words

SUMMARY = "find the best sensor distance"
DESCRIPTION = (
    "Find the sensor distance of the least RMS spot (closed form, nothing is retraced), on axis and at the primary "
    "wavelength unless told otherwise."
)
EXAMPLES = """examples:
  raytrace focus lenses/double_gauss.zmx --object-distance 25000 --plot focus.png
  raytrace focus lens.zmx --object-distance 10000 25000 50000 --field 0 10 14 -o focused.zmx"""


def options(parser):
    words.lens(parser)
    words.conditions(parser, several="several are focused together")
    words.fields(parser)
    parser.add_argument(
        "--criterion",
        choices=("rms", "paraxial", "mean"),
        default="rms",
        help="least RMS spot radius (default), paraxial image, or least mean distance from the centroid",
    )
    for name in ("distance", "field", "wavelength"):
        option = f"--{name}-weights"
        parser.add_argument(option, metavar="W", type=words.positive_finite, nargs="+", help=f"one a {name}")
    words.sampling(parser, rings=12)
    words.plot(parser, "the through-focus curve, the spots before and after, and the layout")
    parser.add_argument(
        "--by",
        dest="plot_by",
        choices=("field", "wavelength"),
        help="draw the through-focus curves alone, one a field, or one a wavelength of the first field",
    )
    words.output_lens(parser, "lens file to write with the new sensor distance")


def run(arguments):
    """The focus; -o is the lens as its file has it, for conditions that are tried are no part of it."""
    import sys
    import warnings

    from raytrace.cli.door import catalogs, find_lens, say
    from raytrace.cli.run import printed_anyway, verb_of_lens
    from raytrace.io import read_lens, write_lens
    from raytrace.system.lens import with_sensor_distance

    found = verb_of_lens(sys.modules[__name__], arguments)
    if arguments.output:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # said when the file was read first
            path, one = find_lens(arguments.lens), arguments.configuration
            how = {"catalogs": catalogs(arguments), "substitute": arguments.substitute}
            original = read_lens(path, **how, configuration=one)
        with printed_anyway(found, arguments):
            write_lens(with_sensor_distance(original, found.sensor_distance), arguments.output)
        say(f"written: {arguments.output}")
        arguments.output = None
    return found
