"""`raytrace trace`."""

from raytrace.cli import options as words

SUMMARY = "trace rays of a table, surface by surface"
DESCRIPTION = (
    "Trace rays and write one row per ray and surface: ray,surface,x,y,z,l,m,n,opl,status in each surface's own "
    "frame, direction after the surface, opl the optical path from the given start. At a coordinate break a ray has "
    "met nothing: its row is the point and the path that it had before, told in the new axes. status: ok, miss, tir, "
    "vignetted. A vignetted ray keeps its coordinates; a missed or totally reflected one ends with an empty row. "
    "Chief and marginal rays, at the primary wavelength or those of --wavelength, are named in further columns: "
    "object_distance,field_x,field_y,wavelength,pupil_x,pupil_y."
)
EXAMPLES = """examples:
  raytrace trace double_gauss --field 0 14 0,-7
  raytrace trace lens.zmx --rays rays.csv -o traced.csv"""


def options(parser):
    words.lens(parser)
    parser.add_argument(
        "--rays",
        metavar="CSV",
        type=words.file_name,
        help="rays to trace: columns x,y,z,l,m,n in the frame of surface 1, optional wavelength; "
        "by default the chief and marginal rays of every field",
    )
    words.output(parser, "table to write (.csv); default: standard output", (".csv", ".txt", ""))
    words.conditions(parser, several="rays from each")
    words.fields(parser)


def run(arguments):
    """The table of the rays, written as it is made: none of it is kept."""
    import sys

    from raytrace.cli.door import print_json, say
    from raytrace.cli.progress import Lines, progress
    from raytrace.cli.run import verb_of_lens

    found = verb_of_lens(sys.modules[__name__], arguments)
    count = found.count
    if arguments.output:
        with progress(count, "ray", what="trace") as bar:
            found.save(arguments.output, bar.update)
        if arguments.json:
            print_json({"rays": count, "output": arguments.output, "lost": found.lost()})
        else:
            say(f"{count} rays written to {arguments.output}")
    elif arguments.json:
        found.write_json(sys.stdout.write)
    else:
        with Lines(count, "ray", what="trace") as lines:  # no bar: the terminal may be where the rays are written
            found.write(sys.stdout.write, lines.update)
    for line in found.failures():
        say(line)
