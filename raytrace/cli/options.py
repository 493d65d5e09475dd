"""Options that commands share: one name means the same everywhere. Imports no torch, so that --help answers at once.

A function of this module adds options to a parser; `option(...)`, `group(...)` and `parameters(...)` return such a
function. ROWS has what signatures and docstrings do not say of a parameter.
"""

import argparse
from collections.abc import Callable, Iterable, Mapping

from raytrace.cli.parameters import Parameter, add_parameter, parameters_of
from raytrace.cli.types import (
    Names,
    count,
    count_or_all,
    field_point,
    file_name,
    file_of,
    finite,
    folder_name,
    memory,
    not_negative,
    picture_file,
    positive,
    positive_finite,
    seed_number,
)

Adder = Callable[[argparse.ArgumentParser], object]


def option(*flags: str, **settings) -> Adder:
    """One option, as `add_argument` takes it."""
    return lambda parser: parser.add_argument(*flags, **settings)


def group(title: str, *options: Adder, about: str | None = None) -> Adder:
    """Options under a title of their own."""

    def add(parser: argparse.ArgumentParser) -> None:
        section = parser.add_argument_group(title, about)
        for add_option in options:
            add_option(section)

    return add


def exclusive(*options: Adder) -> Adder:
    """Options that exclude one another."""

    def add(parser: argparse.ArgumentParser) -> None:
        section = parser.add_mutually_exclusive_group()
        for add_option in options:
            add_option(section)

    return add


def _models() -> Iterable[str]:
    from raytrace.psf_models.models import MODELS

    return ("auto", *MODELS)


def _default_merits() -> Iterable[str]:
    from raytrace.optimization.merit import KINDS

    return KINDS


def _grades() -> Iterable[str]:
    from raytrace.tolerancing.grades import GRADES

    return GRADES


def _written_formats() -> Iterable[str]:
    from raytrace.io import WRITTEN

    return WRITTEN


LENS_SUFFIXES = Names(_written_formats)

#: Parameters that are no options: arguments of the runner, and objects.
NO_OPTIONS = (
    *("lens", "path", "catalogs", "progress", "watch", "share", "execution", "grid", "window", "pupil", "folder"),
    *("merit", "tolerances", "as_built"),
)

_MM, _UM = {"metavar": "MM"}, {"metavar": "UM", "type": positive_finite, "nargs": "+"}

#: What `add_argument` takes of parameters beyond their signature; texts of a parameter that several functions share.
ROWS: dict[str, dict] = {
    "fields": {
        "metavar": "F", "type": field_point, "nargs": "+", "default": None,
        "help": "field points, Y or X,Y, in the file's own kind of field (degrees or mm), never an index; vignetting "
        "factors are interpolated between the file's own fields",
    },
    "wavelengths": {**_UM, "help": "wavelengths in µm; the first is primary"},
    **{
        f"{name}_weights": {"metavar": "W", "help": f"one for each {name}"}
        for name in ("distance", "field", "wavelength")
    },
    "sampling": {"help": "rule of the pupil points: Gaussian quadrature (gauss, default), or another"},
    "rings": {"help": "rings of the pupil, of gauss and hexapolar (default 12)"},
    "seed": {"type": seed_number, "metavar": "N", "help": "seed of random numbers"},
    "samples": {"help": "fields from the axis to the largest, without --field"},
    "frequencies": {"metavar": "F"},
    "radii": _MM, "through_focus": _MM, "pixel": _MM, "focus_distance": {**_MM, "type": positive},
    "tol": {"metavar": "T"},
    "seconds": {"metavar": "S", "help": "time limit"},
    "model": {
        "metavar": "MODEL", "choices": Names(_models), "default": None,
        "help": "paraxial, fourier, gaussian, drt or wave, in order of fidelity; auto (default) takes the first that "
        "agrees with the next",
    },
    "size": {"nargs": None},
    "ray_aiming": {
        "choices": ("auto", "off", "paraxial", "real"),
        "help": "aim rays at the stop: not at all, over a stop as wide as the paraxial or the real marginal ray makes "
        "it, or auto: real where the axis bends in front of the stop, else off (default: as the file specifies, else "
        "auto)",
    },
    "max_bytes": {
        "metavar": "BYTES", "type": memory,
        "help": "memory limit, as 4GB: a computation that would need more is refused before it starts "
        "(default half of the free memory)",
    },
    "configuration": {
        "metavar": "N", "type": count,
        "help": "which one of a multi-configuration file, from 1 (default: the one that was active when it was saved)",
    },
    "substitute": {
        "metavar": "GLASS=OTHER", "nargs": "+",
        "help": "take another glass for one of the file, as SSK4=SSK4A; SSK4=nearest, or nearest for every unknown "
        "glass: the nearest one by the nd and Vd that the file has for it; NAME=formula, or formula: accept indices "
        "that are estimated to no better than 1e-4, of CODE V's glasses by few figures; each is reported in a warning",
    },
    "strict": {"help": "fail on anything unknown or assumed"},
    "temperature": {
        "metavar": "C", "type": finite, "nargs": None,
        "help": "of the glasses and the air, °C; with one of the two the other is the file's, or 20 °C, 1 atm",
    },
    "pressure": {"metavar": "ATM", "type": not_negative, "nargs": None, "help": "of the air, atm; 0 in vacuum"},
}  # fmt: skip


def parameters(verb: str, /, *names: str, **rows: Mapping) -> Adder:
    """Options of parameters of a public function, by default of all that the parser does not have yet.

    rows: settings of `add_argument` by the name of a parameter, in addition to those of ROWS.
    """

    def add(parser: argparse.ArgumentParser) -> None:
        present = {action.dest for action in parser._actions}
        for name, parameter in parameters_of(verb).items():
            if name in names or not (names or name in NO_OPTIONS or name in present):
                add_parameter(parser, name, parameter, {**ROWS.get(name, {}), **rows.get(name, {})})

    return add


def row(name: str, **settings) -> Adder:
    """An option of ROWS that is no parameter of a public function."""
    return lambda parser: add_parameter(parser, name, Parameter("str", None), {**ROWS[name], **settings})


# -- lens and conditions


def lens(parser: argparse.ArgumentParser, *, all_configurations: str = "") -> None:
    """LENS, --configuration, --catalog, --substitute, --json."""
    parser.add_argument("lens", metavar="LENS", type=file_name, help="lens file, or the name of a shipped lens")
    several = {"help": f"{ROWS['configuration']['help']}; all: {all_configurations}", "type": count_or_all}
    for add in (row("configuration", **several if all_configurations else {}), catalog, substitute, json):
        add(parser)


catalog = option(
    "--catalog",
    metavar="FILE",
    type=file_name,
    action="append",
    default=[],
    help="glass catalog to search first, an .agf file or the name of a shipped one; may be repeated; also the "
    "environment variable RAYTRACE_CATALOGS",
)
substitute = row("substitute")
json = option("--json", action="store_true", help="write one JSON document instead of text")


def conditions(parser: argparse.ArgumentParser, *, several: str = "several: one result after the other") -> None:
    """What may be set other than in the file: distances, aperture, wavelength, temperature and pressure.

    several: what a command does with several object distances.
    """
    parser.set_defaults(suffix="")
    sensor = option(
        "--sensor-distance", metavar="MM", type=finite, help="from the last vertex before the image to the image"
    )
    environment = (row("ray_aiming"), row("temperature"), row("pressure"))
    group(
        "conditions other than the file's", object_distance(several), sensor, aperture, row("wavelengths"), *environment
    )(parser)


def max_bytes(parser: argparse.ArgumentParser) -> None:
    """--max-bytes, for commands that neither have it yet nor hand over to another parser."""
    if parser._subparsers is None and not any(action.dest == "max_bytes" for action in parser._actions):
        row("max_bytes")(parser)


def object_distance(several: str) -> Adder:
    return option(
        "--object-distance",
        dest="object_distances",
        metavar="MM",
        type=positive,
        nargs="+",
        help=f"from the object to the vertex of surface 1; inf allowed; {several}",
    )


aperture = exclusive(
    option(
        "--f-number", metavar="N", type=positive_finite, help="image-space F/#: focal length / entrance pupil diameter"
    ),
    option(
        "--entrance-pupil-diameter", "--epd", metavar="MM", type=positive_finite, help="diameter of the entrance pupil"
    ),
)
#: Rows of the pupil points of `spot` and `focus`.
PUPIL = {
    "points": {
        "help": "points of the pupil: across it of square (default 32), in all of sobol and random (default 1024)",
    },
    "seed": {"help": "seed of sobol and random"},
}


# -- outputs


def plot(what: str, *, flag: str = "--plot", **settings) -> Adder:
    return option(flag, metavar="FILE", type=picture_file, help=f"save {what} as .png, .pdf or .svg", **settings)


#: --log of the figure.
log = option(
    "--log", dest="plot_log", action="store_true", help="draw brightness on a logarithmic scale of four decades"
)


def output(what: str, suffixes: Iterable[str] = LENS_SUFFIXES) -> Adder:
    """-o FILE; suffixes: those that the file may have, by default those of lens files."""
    return option("-o", "--output", metavar="FILE", type=file_of(suffixes), help=what)


def output_folder(what: str, *, required: bool = False, type: Callable = folder_name) -> Adder:
    return option("-o", "--output", dest="folder", metavar="FOLDER", type=type, help=what, required=required)


# -- merit functions, variables, constraints

_THICKNESS = {name: f"of {name} on the axis, mm, as 2:15, or 2" for name in ("glass", "air")}

#: --merit and its options: `optimization.merit.merit_of_options`.
MERIT = (
    option(
        "--merit", metavar="KIND", choices=Names(_default_merits),
        help="a default merit function instead of the file's: spot (where rays land), wavefront (path differences), "
        "angular (directions behind an afocal lens) or mtf; further rows of operands come with the file, as "
        "rt.write_lens stores them",
    ),
    option("--skip-unknown", action="store_true", default=None, help="leave rows of operands that are not known out"),
    option(
        "--reading", dest="conventions", metavar="NAME=CHOICE", nargs="+",
        help="where the meaning of an operand is open, another convention than the default: opd_tilt=common, "
        "opd_chief=primary, opd_sign=shorter, boundary=largest, behind_mirrors=signed, focal_length=in-air, "
        "total_track=sum, colour=second, seidel=wavefront, f_theta=axis-included",
    ),
    group(
        "of a default merit function",
        option("--rings", metavar="N", type=count, help="rings of rays in the pupil (default 3)"),
        option("--arms", metavar="N", type=count, help="arms of rays in the pupil, even (default 6)"),
        option("--reference", choices=("centroid", "chief"), help="centre of the spot (default centroid)"),
        row("frequencies", type=positive_finite, nargs="+", help="of mtf, cycles/mm"),
        *(
            row(f"{name}_weights", type=positive_finite, nargs="+", help=f"one a {name}, not the lens's own")
            for name in ("field", "wavelength")
        ),
    ),
    group(
        "boundaries, of any merit function",
        *(option(f"--{name}-thickness", metavar="MIN[:MAX]", help=help) for name, help in _THICKNESS.items()),
        option("--edge", metavar="MIN", type=positive_finite, help="least thickness of glass at its edge, mm"),
    ),
)  # fmt: skip

#: --vary, --bounds and --hold: `optimization.variables.freedom` and `bounds_of`, `optimization.problem.conditions_of`.
FREEDOM = group(
    "variables and constraints, instead of the file's",
    option("--vary", metavar="WHAT", nargs="+", help="variables, pickups and solves"),
    option(
        "--bounds",
        metavar="NAME:LOW,HIGH",
        nargs="+",
        help="of variables: of a kind (thickness:2..15), of one (curvature_3:-0.1,0), open on one side (sensor:30..)",
    ),
    option(
        "--hold",
        metavar="NAME=VALUE",
        nargs="+",
        help="constraints: efl=50 f_number=4 'total_track<=80' 'distortion<=2%%' 'bfd>=30' "
        "image_height=21.6 magnification=-0.5 'thickness:3-5>=20' efl@2=100, or an operand as REAY(8,0,0,1,0,0)=2",
    ),
    about="Variables, in quotes: 'curvature thickness' (all powered surfaces, all gaps), curvature:1-4,7 conic:3 a4:3 "
    "tilt:5 decentre:5 sensor index glass:2, thickness:6@2 (in configuration 2); pickups and solves: "
    "'curvature:4=-curvature:3' 'thickness:8=2*thickness:2+1' 'curvature:7=f_number(4)' "
    "'thickness:8=marginal_height(0)' 'curvature:7=marginal_angle(-0.1)'.",
)

#: --as-built and its options: `tolerancing.as_built.AsBuilt`.
AS_BUILT = group(
    "the lens as built",
    option(
        "--as-built", action="store_true", default=None,
        help="with the expected mean square spot radius of the manufactured lens, its sensor refocused: the mean over "
        "perturbed lenses that give the second order in all tolerances exactly",
    ),
    option(
        "--grade", choices=Names(_grades), help="tolerances of a published grade (default: those of the file)"
    ),
    option(
        "--limits", metavar="NAME=LIMIT", nargs="+",
        help="other limits, as radius=0.1%% thickness=0.02 element_tilt=0.05; index=0 leaves one out",
    ),
    option(
        "--as-built-weight", dest="weight", metavar="W", type=positive_finite,
        help="weight relative to all rows of the merit function that are no boundaries (default 1: of --merit spot the "
        "lens without errors and the lens as built count alike)",
    ),
)  # fmt: skip
