"""Arguments that commands share: one name means the same everywhere. No torch: the help must not wait for it."""

import argparse
import importlib
from collections.abc import Callable, Iterable, Iterator

from raytrace.cli.paths import data_file as data_file
from raytrace.cli.paths import file_name, file_of, folder_name, picture_file
from raytrace.cli.paths import folder_or_lens as folder_or_lens
from raytrace.cli.paths import output_file as output_file

SAMPLINGS = ("gauss", "hexapolar", "square", "sobol", "random")


class Names:
    """The names of a table of the library, as `choices` of an option; it is imported when one is given."""

    def __init__(self, module: str, table: str, *others: str):
        self._place, self._others = (module, table), others

    def __iter__(self) -> Iterator[str]:
        module, table = self._place
        return iter((*self._others, *getattr(importlib.import_module(f"raytrace.{module}"), table)))

    def __contains__(self, name: str) -> bool:
        return name in tuple(self)


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
            help="memory that may be taken, as 4GB: what is predicted to need more is refused before it begins "
            "(default half of what is free)",
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
    output(parser, what, Names("io", "WRITTEN"))


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
        help="what is 1: all light through the entrance pupil (energy), or the light in each window (window); "
        f"default {normalise}",
    )
    group.add_argument(
        "--rho",
        metavar="R",
        type=positive_finite,
        help="of the paraxial model: σ over the radius of the blur (default 0.5, the second moment of a uniform disc)",
    )
