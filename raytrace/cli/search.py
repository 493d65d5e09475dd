"""`raytrace search`."""

from raytrace.cli import options as words
from raytrace.cli.merit_options import freedom, merit

SUMMARY = "search all that bounds allow for the minima of a merit function"
DESCRIPTION = (
    "Search for the distinct minima of a merit function, that of the file or one by --merit, between the bounds of the "
    "variables: starts spread evenly, plane plates do, are brought to the focal length and the focus and descend; the "
    "best are followed to their minima, and from the best of these the search hops on. --insert: from the lens, over "
    "the saddles that a thin meniscus makes, to lenses with one element more. -o keeps every minimum as a "
    "lens file, a table and figures, and how far the search has come: the same command goes on there, to the same end. "
    "Ctrl-C ends with what was found. Processes share the work: torchrun --nproc-per-node 2 -m raytrace search …"
)
EXAMPLES = """examples:
  raytrace search lens.zmx --starts 200 --seconds 60 -o minima
  raytrace search cooke_triplet --merit spot --vary curvature thickness --hold efl=100 --edge 1 --seconds 20 -o minima
  raytrace search triplet.zmx --insert 2 4 -o four_elements
  raytrace search singlet --merit spot --vary curvature sensor --starts 8 --plot minima.png"""


def options(parser):
    words.lens(parser)
    words.ray_aiming(parser)
    merit(parser)
    freedom(parser)
    how = parser.add_argument_group("how far")
    how.add_argument("--starts", metavar="N", type=words.count, help="points that it starts from (default 64)")
    how.add_argument(
        "--insert",
        metavar="SURFACE",
        type=words.count,
        nargs="*",
        help="instead of starts: a thin meniscus at every surface, or at these, makes lenses of one element more",
    )
    how.add_argument("--seconds", metavar="S", type=words.positive_finite, help="end after so much time")
    how.add_argument("--seed", metavar="N", type=words.seed_number, default=0, help="of starts and hops (default 0)")
    words.plot(parser, "the best lenses side by side")
    words.output_folder(parser, "folder for lens files and their table; the search goes on from what is there")


def run(arguments):
    """The verb; a lens without variables or a merit function is told how to choose them."""
    import sys

    from raytrace.cli.run import verb_of_lens

    return verb_of_lens(sys.modules[__name__], arguments)
