"""`raytrace spot`."""

from raytrace.cli import options as words

SUMMARY = "spot sizes and the spot diagram"
DESCRIPTION = (
    "Trace each field and wavelength to the sensor: centroid, RMS and geometric radius about it. -o writes the "
    "rays: field_x,field_y,wavelength,pupil_x,pupil_y,x,y,weight,status; x and y are empty for a ray that "
    "does not reach the sensor. status: ok, vignetted, miss, tir, unaimed."
)
EXAMPLES = """examples:
  raytrace spot double_gauss --plot spot.png
  raytrace spot lens.zmx --object-distance 25000 --field 0 10 14 --json
  raytrace spot double_gauss --field 0,10 7,7 --sampling hexapolar --rings 6 -o rays.csv
  raytrace spot double_gauss --field 14 --rays 1e9 --max-bytes 200MB"""


def options(parser):
    words.lens(parser)
    words.conditions(parser)
    words.fields(parser)
    words.sampling(parser, rings=12)
    parser.add_argument(
        "--rays",
        metavar="N",
        type=words.many,
        help="instead of --points, any number of sobol or random rays for each field and wavelength, as 1e9: "
        "traced in chunks, none kept",
    )
    parser.add_argument(
        "--max-bytes",
        metavar="BYTES",
        type=words.memory,
        help="memory that may be taken, as 200MB (default with --rays 256MB, else half of what is free)",
    )
    parser.add_argument(
        "--reference",
        choices=("centroid", "chief"),
        default="centroid",
        help="radii about the centroid (default), or about the chief ray of the primary wavelength",
    )
    parser.add_argument(
        "--weights",
        choices=("area", "equal"),
        default="area",
        help="rays count by their share of the pupil's area (default) or all alike; OpticStudio's spots are "
        "--sampling hexapolar --rings 6 --weights equal --reference chief",
    )
    what = "table of the rays to write (.csv): field, wavelength, pupil point, x, y, weight, status"
    words.output(parser, what, (".csv", ""))
    words.plot(parser, "the spot diagram")


def run(arguments):
    """The spots; what cannot be saved is refused before the rays are traced."""
    import sys

    from raytrace.cli.door import CommandError
    from raytrace.cli.run import verb_of_lens

    for option, given in (("--plot", arguments.plot), ("-o", arguments.output)):
        if given and arguments.rays:
            raise CommandError(f"{option} needs the rays, and --rays keeps none: leave one out")
    return verb_of_lens(sys.modules[__name__], arguments)
