"""Options that commands share: one name means the same everywhere. Imports no torch, so that --help answers at once.

A function of this module adds options to a parser; `option(...)` and `group(...)` return such a function.
"""

import argparse
from collections.abc import Callable, Iterable, Iterator
from pathlib import PurePath

PICTURES = (".png", ".pdf", ".svg")
SAMPLINGS = ("gauss", "hexapolar", "square", "sobol", "random")

Adder = Callable[[argparse.ArgumentParser], object]


def option(*flags: str, **settings) -> Adder:
    """One option, as `add_argument` takes it."""
    return lambda parser: parser.add_argument(*flags, **settings)


def group(title: str, *options: Adder) -> Adder:
    """Options under a title of their own."""

    def add(parser: argparse.ArgumentParser) -> None:
        section = parser.add_argument_group(title)
        for add_option in options:
            add_option(section)

    return add


class Names:
    """`choices` of an option from a table of the library, which is imported when the option is used."""

    def __init__(self, table: Callable[[], Iterable[str]]):
        self._table = table

    def __iter__(self) -> Iterator[str]:
        return iter(self._table())

    def __contains__(self, name: str) -> bool:
        return name in tuple(self)


def _models() -> Iterable[str]:
    from raytrace.psf_models.models import MODELS

    return ("auto", *MODELS)


def _default_merits() -> Iterable[str]:
    from raytrace.optimization.merit import KINDS

    return KINDS


def _written_formats() -> Iterable[str]:
    from raytrace.io import WRITTEN

    return WRITTEN


MODELS = Names(_models)
DEFAULT_MERITS = Names(_default_merits)
LENS_SUFFIXES = Names(_written_formats)

# -- files


class InputFile(str):
    """Name of a file that is read, or of a library item that a file may replace."""

    __slots__ = ()


class OutputFile(str):
    """Name of a file that is written; suffixes: those allowed, any if empty."""

    suffixes: Iterable[str] = ()


class OutputFolder(str):
    """Name of a folder that is written; may_be_file: or of a file, next to a folder of that name without suffix."""

    may_be_file: bool = False


def file_name(text: str) -> InputFile:
    """A file to read."""
    if not text:
        raise argparse.ArgumentTypeError("the name of the file is empty")
    return InputFile(text)


def output_file(text: str) -> OutputFile:
    """A file to write."""
    return OutputFile(file_name(text))


def data_file(text: str) -> OutputFile:
    """A data file to write; the suffix of a picture is refused."""
    if PurePath(file_name(text)).suffix.lower() in PICTURES:
        raise argparse.ArgumentTypeError(f"{text!r} is a picture: figures are saved by --plot, data by -o")
    return OutputFile(text)


def file_of(suffixes: Iterable[str]) -> Callable[[str], OutputFile]:
    """The type of a data file to write with one of these suffixes."""

    def reader(text: str) -> OutputFile:
        file = data_file(text)
        file.suffixes = suffixes
        return file

    return reader


def picture_file(text: str) -> OutputFile:
    """A figure to write: .png, .pdf or .svg."""
    if PurePath(file_name(text)).suffix.lower() not in PICTURES:
        listed = ", ".join(PICTURES)
        raise argparse.ArgumentTypeError(
            f"{text!r} is no picture ({listed}); data are written by -o, where there is one"
        )
    return OutputFile(text)


def folder_name(text: str) -> OutputFolder:
    """A folder to write in."""
    return OutputFolder(data_file(text))


def folder_or_lens(text: str) -> OutputFolder:
    """A folder to write in, or a lens file next to it."""
    folder = folder_name(text)
    folder.may_be_file = bool(PurePath(text).suffix)
    return folder


# -- numbers


def positive(text: str) -> float:
    """A number above 0; `inf` allowed."""
    number = _number(text)
    if not number > 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not above 0")
    return number


def finite(text: str) -> float:
    """A finite number."""
    number = _number(text)
    if number in (float("inf"), float("-inf")):
        raise argparse.ArgumentTypeError(f"{text!r} is not finite")
    return number


def positive_finite(text: str) -> float:
    """A finite number above 0."""
    finite(text)
    return positive(text)


def not_negative(text: str) -> float:
    """A finite number, 0 or more."""
    number = finite(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"{text!r} is below 0")
    return number


def count(text: str) -> int:
    """A whole number above 0."""
    number = _whole(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not above 0")
    return number


def count_or_all(text: str) -> int | str:
    """A whole number above 0, or `all`."""
    return text if text == "all" else count(text)


def many(text: str) -> int:
    """A whole number above 0, also written as 1e9."""
    number = finite(text)
    if number < 1 or number != int(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text) if text.isdigit() else int(number)


def memory(text: str) -> int:
    """A number of bytes, with kB, MB or GB behind it (10³, 10⁶, 10⁹) or without."""
    units = {"kb": 10**3, "mb": 10**6, "gb": 10**9, "b": 1}
    unit = next((u for u in units if text.lower().endswith(u)), "")
    try:
        number = float(text[: len(text) - len(unit)])
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of bytes, as 200MB") from None
    if not 1 <= number * units.get(unit, 1) < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of bytes above 0")
    return int(number * units.get(unit, 1))


def seed_number(text: str) -> int:
    """A whole number that seeds a generator: 0 to 2⁶³ - 1."""
    number = _whole(text)
    if not 0 <= number < 2**63:
        raise argparse.ArgumentTypeError(f"{text!r} is not from 0 to 2**63 - 1")
    return number


def field_point(text: str) -> tuple[float, float]:
    """A field point (x, y): `Y` alone, or `X,Y`."""
    parts = text.split(",")
    if len(parts) > 2:
        raise argparse.ArgumentTypeError(f"{text!r} is not a field point, Y or X,Y; several have spaces between them")
    x, y = (0.0, finite(text)) if len(parts) == 1 else map(finite, parts)
    return x, y


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None


def _number(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number (LENS goes before the options)") from None
    if number != number:
        raise argparse.ArgumentTypeError("nan is not a number to work with")
    return number


# -- lens and conditions


def lens(parser: argparse.ArgumentParser, *, all_configurations: str = "") -> None:
    """LENS, --configuration, --catalog, --substitute, --json."""
    parser.add_argument("lens", metavar="LENS", type=file_name, help="lens file, or the name of a shipped lens")
    configuration(parser, several=all_configurations)
    catalog(parser)
    substitute(parser)
    json(parser)


def configuration(parser: argparse.ArgumentParser, *, several: str = "") -> None:
    """several: what a command does with all of them."""
    parser.add_argument(
        "--configuration",
        metavar="N",
        type=count_or_all if several else count,
        help="which one of a multi-configuration file, from 1 (default: the one that was active when it was saved)"
        + (f"; all: {several}" if several else ""),
    )


def catalog(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--catalog",
        metavar="FILE",
        type=file_name,
        action="append",
        default=[],
        help="glass catalog to search first, an .agf file or the name of a shipped one; may be repeated; also the "
        "environment variable RAYTRACE_CATALOGS",
    )


def substitute(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--substitute",
        metavar="GLASS=OTHER",
        nargs="+",
        help="take another glass for one of the file, as SSK4=SSK4A; SSK4=nearest, or nearest for every unknown glass: "
        "the nearest one by the nd and Vd that the file has for it; NAME=formula, or formula: accept indices that are "
        "estimated to no better than 1e-4, of CODE V's glasses by few figures; each is reported in a warning",
    )


def json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="write one JSON document instead of text")


def conditions(parser: argparse.ArgumentParser, *, several: str = "") -> None:
    """What may be set other than in the file: distances, aperture, wavelength, temperature and pressure.

    several: what a command does with several object distances together; it is run for one after the other if empty.
    """
    group = parser.add_argument_group("conditions other than the file's")
    object_distance(group, several or "several: one result after the other")
    parser.set_defaults(suffix="")
    group.add_argument(
        "--sensor-distance", metavar="MM", type=finite, help="from the last vertex before the image to the image"
    )
    aperture(group)
    wavelength(group)
    ray_aiming(group)
    environment(group)


def max_bytes(parser: argparse.ArgumentParser) -> None:
    """--max-bytes, for commands that neither have it yet nor hand over to another parser."""
    if parser._subparsers is None and not any(action.dest == "max_bytes" for action in parser._actions):
        parser.add_argument(
            "--max-bytes",
            metavar="BYTES",
            type=memory,
            help="memory limit, as 4GB: a computation that would need more is refused before it starts "
            "(default half of the free memory)",
        )


def object_distance(group, several: str, *, default: list[float] | None = None) -> None:
    group.add_argument(
        "--object-distance",
        dest="object_distances",
        metavar="MM",
        type=positive,
        nargs="+",
        default=default,
        help=f"from the object to the vertex of surface 1; inf allowed; {several}",
    )


def aperture(group) -> None:
    choice = group.add_mutually_exclusive_group()
    choice.add_argument(
        "--f-number", metavar="N", type=positive_finite, help="image-space F/#: focal length / entrance pupil diameter"
    )
    choice.add_argument(
        "--entrance-pupil-diameter", "--epd", metavar="MM", type=positive_finite, help="diameter of the entrance pupil"
    )


def wavelength(group) -> None:
    group.add_argument(
        "--wavelength",
        dest="wavelengths",
        metavar="UM",
        type=positive_finite,
        nargs="+",
        help="wavelengths in µm; the first is primary",
    )


def environment(group) -> None:
    group.add_argument(
        "--temperature",
        metavar="C",
        type=finite,
        help="of the glasses and the air, °C; with one of the two the other is the file's, or 20 °C, 1 atm",
    )
    group.add_argument("--pressure", metavar="ATM", type=not_negative, help="of the air, atm; 0 in vacuum")


def fields(parser: argparse.ArgumentParser, *, default: str = "") -> None:
    parser.add_argument(
        "--field",
        dest="fields",
        metavar="F",
        type=field_point,
        nargs="+",
        help="field points, Y or X,Y, in the file's own kind of field (degrees or mm), never an index; vignetting "
        "factors are interpolated between the file's own fields" + (f" (default {default})" if default else ""),
    )


def sampling(parser: argparse.ArgumentParser, *, rings: int) -> None:
    parser.add_argument(
        "--sampling",
        choices=SAMPLINGS,
        default="gauss",
        help="rule of the pupil points: Gaussian quadrature (default), or another",
    )
    parser.add_argument(
        "--rings", metavar="N", type=count, help=f"rings of the pupil, of gauss and hexapolar (default {rings})"
    )
    points(parser, "points of the pupil: across it of square (default 32), in all of sobol and random (default 1024)")
    parser.add_argument("--seed", metavar="N", type=seed_number, default=0, help="seed of sobol and random (default 0)")


def points(parser: argparse.ArgumentParser, what: str, *, default: int | None = None) -> None:
    parser.add_argument("--points", metavar="N", type=count, default=default, help=what)


def size(group, what: str, *, default: int | None = None) -> None:
    group.add_argument("--size", metavar="N", type=count, default=default, help=f"pixels across {what}")


def analysis(parser: argparse.ArgumentParser, figure: str) -> None:
    """LENS, --json, the conditions, --field and --plot."""
    lens(parser)
    conditions(parser)
    fields(parser)
    plot(parser, figure)


def samples(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--samples",
        metavar="N",
        type=count,
        help="fields from the axis to the largest, without --field (default 11)",
    )


def geometric(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--geometric", action="store_true", help="of rays alone, without diffraction")


def reference(parser: argparse.ArgumentParser, what: str) -> None:
    parser.add_argument("--reference", choices=("primary", "own"), help=what)


#: Choices and help of --ray-aiming.
RAY_AIMING = {
    "choices": ("auto", "off", "paraxial", "real"),
    "help": "aim rays at the stop: not at all, over a stop as wide as the paraxial or the real marginal ray makes it, "
    "or auto: real where the axis bends in front of the stop, else off (default: as the file specifies, else auto)",
}


def ray_aiming(parser) -> None:
    parser.add_argument("--ray-aiming", **RAY_AIMING)


def plot(parser: argparse.ArgumentParser, what: str) -> None:
    parser.add_argument("--plot", metavar="FILE", type=picture_file, help=f"save {what} as .png, .pdf or .svg")


def log(parser: argparse.ArgumentParser) -> None:
    """--log of the figure."""
    parser.add_argument(
        "--log", dest="plot_log", action="store_true", help="draw brightness on a logarithmic scale of four decades"
    )


def output(parser: argparse.ArgumentParser, what: str, suffixes: Iterable[str]) -> None:
    """-o FILE; suffixes: those that the file may have."""
    parser.add_argument("-o", "--output", metavar="FILE", type=file_of(suffixes), help=what)


def output_lens(parser: argparse.ArgumentParser, what: str) -> None:
    """-o FILE, a lens file."""
    output(parser, what, LENS_SUFFIXES)


def output_folder(
    parser: argparse.ArgumentParser, what: str, *, required: bool = False, type: Callable = folder_name
) -> None:
    parser.add_argument("-o", "--output", dest="folder", metavar="FOLDER", type=type, help=what, required=required)


def window(group, *, normalise: str) -> None:
    """--pixel, --size, --normalise, --rho of a PSF: None where not given, for the command to fill in.

    normalise: what the command takes then, for the help.
    """
    group.add_argument("--pixel", metavar="MM", type=positive_finite, help="pixel pitch (default 0.005)")
    size(group, "the window of the PSF (default 21)")
    group.add_argument(
        "--normalise",
        choices=("energy", "window"),
        help="unit of kernels: all light through the entrance pupil (energy), or that in each window (window); "
        f"default {normalise}",
    )
    group.add_argument(
        "--rho",
        metavar="R",
        type=positive_finite,
        help="of the paraxial model: σ over the radius of the blur (default 0.5, the second moment of a uniform disc)",
    )


# -- merit functions, variables, constraints


def merit(parser: argparse.ArgumentParser) -> None:
    """--merit and its options: `optimization.merit.merit_of_options`."""
    parser.add_argument(
        "--merit",
        metavar="KIND",
        choices=DEFAULT_MERITS,
        help="a default merit function instead of the file's: spot (where rays land), wavefront (path differences), "
        "angular (directions behind an afocal lens) or mtf",
    )
    parser.add_argument(
        "--skip-unknown", action="store_true", default=None, help="leave rows of operands that are not known out"
    )
    parser.add_argument(
        "--reading",
        dest="conventions",
        metavar="NAME=CHOICE",
        nargs="+",
        help="where the meaning of an operand is open, another convention than the default: opd_tilt=common, "
        "opd_chief=primary, opd_sign=shorter, boundary=largest, behind_mirrors=signed, focal_length=in-air, "
        "total_track=sum, colour=second, seidel=wavefront, f_theta=axis-included",
    )
    own = parser.add_argument_group("of a default merit function")
    own.add_argument("--rings", metavar="N", type=count, help="rings of rays in the pupil (default 3)")
    own.add_argument("--arms", metavar="N", type=count, help="arms of rays in the pupil, even (default 6)")
    own.add_argument("--reference", choices=("centroid", "chief"), help="centre of the spot (default centroid)")
    own.add_argument(
        "--frequency", dest="frequencies", metavar="F", type=positive_finite, nargs="+", help="of mtf, cycles/mm"
    )
    for name in ("field", "wavelength"):
        option = f"--{name}-weights"
        own.add_argument(option, metavar="W", type=positive_finite, nargs="+", help=f"one a {name}, not the lens's own")
    bounds = parser.add_argument_group("boundaries, of any merit function")
    for name in ("glass", "air"):
        option = f"--{name}-thickness"
        bounds.add_argument(option, metavar="MIN[:MAX]", help=f"of {name} on the axis, mm, as 2:15, or 2")
    bounds.add_argument("--edge", metavar="MIN", type=positive_finite, help="least thickness of glass at its edge, mm")


def freedom(parser: argparse.ArgumentParser) -> None:
    """--vary, --bounds and --hold: `optimization.variables.freedom`, `optimization.variables.bounds_of`,
    `optimization.problem.conditions_of`."""
    group = parser.add_argument_group(
        "variables and constraints, instead of the file's",
        "Variables, in quotes: 'curvature thickness' (all powered surfaces, all gaps), curvature:1-4,7 conic:3 a4:3 "
        "tilt:5 decentre:5 sensor index glass:2, thickness:6@2 (in configuration 2); pickups and solves: "
        "'curvature:4=-curvature:3' 'thickness:8=2*thickness:2+1' 'curvature:7=f_number(4)' "
        "'thickness:8=marginal_height(0)' 'curvature:7=marginal_angle(-0.1)'.",
    )
    group.add_argument("--vary", metavar="WHAT", nargs="+", help="variables, pickups and solves")
    group.add_argument(
        "--bounds",
        metavar="NAME:LOW,HIGH",
        nargs="+",
        help="of variables: of a kind (thickness:2..15), of one (curvature_3:-0.1,0), open on one side (sensor:30..)",
    )
    group.add_argument(
        "--hold",
        metavar="NAME=VALUE",
        nargs="+",
        help="constraints: efl=50 f_number=4 'total_track<=80' 'distortion<=2%%' 'bfd>=30' "
        "image_height=21.6 magnification=-0.5 'thickness:3-5>=20' efl@2=100, or an operand as REAY(8,0,0,1,0,0)=2",
    )
