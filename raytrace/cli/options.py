"""The table of options, and what groups them. Imports no torch, so that --help answers at once.

A row is an `Option`. OPTIONS has the rows that several commands share: a command names them by their parameter, and
`row(name, …)` is one of them with another text, default or reader. A command's further rows are in its row of
`commands.COMMANDS`. Docstrings and annotations of the functions are not read; `tests/test_cli_options.py` compares the
rows with the signatures.
"""

import argparse
import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from raytrace.cli.types import (
    Reader,
    count,
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
from raytrace.settings import GRADES

#: Adds options to a parser or to a group of its options.
Adder: TypeAlias = Callable[[argparse._ActionsContainer], object]


@dataclass(frozen=True)
class Option:
    """An option, which gives a parameter of the public function its value.

    name: the parameter; reader: of the text of a value; flag: by default --name, two with a space between them, or
    the name itself for a positional argument; default: the parameter's, which completes the help text, or None
    where the function has its own; nargs, const, choices, action, required: as for `argparse`.
    """

    name: str
    reader: Reader | None = None
    metavar: str | tuple[str, ...] | None = None
    help: str = ""
    flag: str = ""
    nargs: str | int | None = None
    const: Any = None
    choices: Sequence[object] | None = None
    action: str | type[argparse.Action] | None = None
    default: object = None
    required: bool | None = None

    def __call__(self, parser: argparse._ActionsContainer) -> None:
        """Add the option to a parser."""
        flags = self.flag.split() or [f"--{self.name.replace('_', '-')}"]
        dest = self.name if flags[0].startswith("-") else None
        text = self.help if self.action else with_default(self.help, self.default)
        settings = {
            name: getattr(self, name) for name in ("metavar", "nargs", "const", "choices", "action", "required")
        }
        settings |= {"dest": dest, "type": self.reader, "help": text.replace("%", "%%")}
        given = {name: value for name, value in settings.items() if value is not None}
        parser.add_argument(*flags, default=self.default, **given)


def with_default(text: str, default: object) -> str:
    """A help text, completed by the default where it does not mention it."""
    values = default if isinstance(default, tuple) else () if default in (None, "") else (default,)
    if not values or "default" in text:
        return text
    shown = " ".join(f"{value:g}" if isinstance(value, float) else str(value) for value in values)
    return f"{text} (default {shown})"


def switch(name: str, help: str, *, flag: str = "", default: bool | None = False) -> Option:
    """An option without a value, which changes the default."""
    return Option(name, help=help, flag=flag, action="store_false" if default else "store_true", default=default)


#: PSF models in order of fidelity.
MODELS = ("paraxial", "fourier", "gaussian", "drt", "wave")

#: Options that several commands have.
OPTIONS: dict[str, Option] = {row.name: row for row in (
    # of every lens
    Option("lens", file_name, "LENS", "lens file, or the name of a shipped lens", flag="lens"),
    Option("configuration", count, "N", "which one of a multi-configuration file, from 1 (default: the one that was "
           "active when it was saved)"),
    Option("catalog", file_name, "FILE", "glass catalog to search first, an .agf file or the name of a shipped one; "
           "may be repeated; also the environment variable RAYTRACE_CATALOGS", action="append", default=[]),
    Option("substitute", None, "GLASS=OTHER", "take another glass for one of the file, as SSK4=SSK4A; SSK4=nearest, "
           "or nearest for every unknown glass: the nearest one by the nd and Vd that the file has for it; "
           "NAME=formula, or formula: accept indices that are estimated to no better than 1e-4, of CODE V's glasses "
           "by few figures; each is reported in a warning", nargs="+"),
    switch("json", "write one JSON document instead of text"),
    switch("strict", "fail on anything unknown or assumed"),
    Option("max_bytes", memory, "BYTES", "memory limit, as 4GB: a computation that would need more is refused before "
           "it starts (default half of the free memory)"),
    # conditions
    Option("magnification", finite, "M", "of the paraxial image, as -0.1: the object distance that gives it, and the "
           "sensor there unless --sensor-distance is given"),
    Option("sensor_distance", finite, "MM", "from the last vertex before the image to the image"),
    Option("f_number", positive_finite, "N", "image-space F/#: focal length in air / entrance pupil diameter"),
    Option("entrance_pupil_diameter", positive_finite, "MM", "diameter of the entrance pupil",
           flag="--entrance-pupil-diameter --epd"),
    Option("wavelengths", positive_finite, "UM", "wavelengths in µm; the first is primary", flag="--wavelength",
           nargs="+"),
    Option("ray_aiming", help="aim rays at the stop: not at all, over a stop as wide as the paraxial or the real "
           "marginal ray makes it, or auto: real where the axis bends in front of the stop, else off (default: as the "
           "file specifies, else auto)", choices=("auto", "off", "paraxial", "real")),
    Option("temperature", finite, "C", "of the lens and the air, °C: indices change, glasses and spacers expand; with "
           "one of the two the other is the file's, or 20 °C, 1 atm"),
    Option("pressure", not_negative, "ATM", "of the air, atm; 0 in vacuum"),
    Option("mount", None, "MATERIAL", "of all spaces without a stated expansion: aluminium, titanium, invar, "
           "stainless-304 …, or its expansion in 1e-6/K (default: spacers keep their length)"),
    # field and pupil
    Option("fields", field_point, "F", "field points, Y or X,Y, in the file's own kind of field (degrees or mm), "
           "never an index; vignetting factors are interpolated between the file's own fields", flag="--field",
           nargs="+"),
    Option("samples", count, "N", "fields from the axis to the largest, without --field", default=11),
    Option("distance_weights", positive_finite, "W", "one for each distance", nargs="+"),
    Option("field_weights", positive_finite, "W", "one for each field", nargs="+"),
    Option("wavelength_weights", positive_finite, "W", "one for each wavelength", nargs="+"),
    Option("sampling", help="rule of the pupil points: Gaussian quadrature (gauss, default), or another",
           choices=("gauss", "hexapolar", "square", "sobol", "random"), default="gauss"),
    Option("rings", count, "N", "rings of the pupil, of gauss and hexapolar (default 12)"),
    Option("points", count, "N", "points of the pupil: across it of square (default 32), in all of sobol and random "
           "(default 1024)"),
    Option("seed", seed_number, "N", "seed of sobol and random", default=0),
    # kernels and maps
    Option("pixel", positive_finite, "MM", "pixel pitch (default 0.005)"),
    Option("size", count, "N", "pixels across the windows (default 21)"),
    Option("tol", positive_finite, "T", "bound on the estimated error (default 0.01)"),
    Option("model", str.lower, "MODEL", "paraxial, fourier, gaussian, drt or wave, in order of fidelity; auto "
           "(default) takes the first that agrees with the next", choices=("auto", *MODELS)),
    switch("plot_log", "draw brightness on a logarithmic scale of four decades", flag="--log"),
    # optimisation
    Option("seconds", positive_finite, "S", "time limit"),
    Option("vary", None, "WHAT", "variables, pickups and solves", nargs="+"),
    Option("glasses", None, "WORD", "catalog glasses to choose from: statuses (preferred standard unlisted special "
           "obsolete melt; default the first three), radiation_hard, any, and limits as 'price<=3' "
           "'transmittance:0.4>=0.98' 'acid<=2' ('raytrace glasses' lists them)", nargs="+"),
    Option("grade", help="tolerances of a published grade (default: those of the file)", choices=GRADES),
    Option("limits", None, "NAME=LIMIT", "other limits, as radius=0.1% thickness=0.02 element_tilt=0.05; index=0 "
           "leaves one out", nargs="+"),
    switch("radial", "decentres, tilts and wedges of the grade and of --limits are magnitudes in a random direction, "
           "x and y linked; wedge_radial=0.01 is one of these alone"),
)}  # fmt: skip


def row(name: str, help: str = "", **columns: Any) -> Option:
    """A row of OPTIONS with another help text, or other columns."""
    return dataclasses.replace(OPTIONS[name], help=help or OPTIONS[name].help, **columns)


def add(parser: argparse._ActionsContainer, options: Iterable[str | Adder]) -> None:
    """Add options, those of OPTIONS by their name, to a parser."""
    for option in options:
        (OPTIONS[option] if isinstance(option, str) else option)(parser)


def group(title: str, *options: str | Adder, about: str | None = None) -> Adder:
    """Options under a title of their own."""
    return lambda parser: add(parser.add_argument_group(title, about), options)


def exclusive(*options: str | Adder) -> Adder:
    """Options that exclude one another."""
    return lambda parser: add(parser.add_mutually_exclusive_group(), options)


# -- lens and conditions

LENS = ("lens", "configuration", "catalog", "substitute", "json", "max_bytes")

#: Options without types, of scripts that add them to their own parser.
catalog, json, substitute = (OPTIONS[name] for name in ("catalog", "json", "substitute"))

APERTURE = exclusive("f_number", "entrance_pupil_diameter")


def object_distance(several: str) -> Option:
    """--object-distance; several: what a command does with several."""
    text = f"from the object to the vertex of surface 1; inf allowed; {several}"
    return Option("object_distances", positive, "MM", text, flag="--object-distance", nargs="+")


def conditions(several: str = "several: one result after the other") -> Adder:
    """Conditions other than those of the file."""
    surroundings = ("wavelengths", "ray_aiming", "temperature", "pressure", "mount")
    distances = (exclusive(object_distance(several), "magnification"), "sensor_distance")
    return group("conditions other than the file's", *distances, APERTURE, *surroundings)


CONDITIONS = conditions()
#: Points of the pupil.
PUPIL = ("sampling", "rings", "points", "seed")


# -- outputs


def plot(content: str, name: str = "plot", *, flag: str = "") -> Option:
    """--plot FILE, a figure."""
    return Option(name, picture_file, "FILE", f"save {content} as .png, .pdf or .svg", flag)


def output(content: str, reader: Reader) -> Option:
    """-o FILE."""
    return Option("output", reader, "FILE", content, "-o --output")


#: -o of an analysis: `Result.save`.
TABLE = output("table to write (.csv), or the document of --json (.json)", file_of(".csv", ".json"))


def output_folder(content: str, *, required: bool | None = None, reader: Reader = folder_name) -> Option:
    """-o FOLDER."""
    return Option("folder", reader, "FOLDER", content, "-o --output", required=required)


# -- merit functions, variables, constraints

#: --merit and its options: `optimization.merit.merit_of_options`.
MERIT: tuple[Adder, ...] = (
    Option("merit", None, "KIND", "a default merit function instead of the file's: spot (where rays land), wavefront "
           "(path differences), angular (directions behind an afocal lens) or mtf; further rows of operands come with "
           "the file, as rt.write_lens stores them", choices=("spot", "wavefront", "angular", "mtf")),
    switch("skip_unknown", "leave rows of operands that are not known out", default=None),
    Option("conventions", None, "NAME=CHOICE", "where the meaning of an operand is open, another convention than the "
           "default: opd_tilt=common, opd_chief=primary, opd_sign=shorter, boundary=largest, behind_mirrors=signed, "
           "focal_length=in-air, total_track=sum, colour=second, seidel=wavefront, f_theta=axis-included",
           flag="--reading", nargs="+"),
    group(
        "of a default merit function",
        row("rings", "rings of rays in the pupil (default 3)"),
        Option("arms", count, "N", "arms of rays in the pupil, even (default 6)"),
        Option("reference", help="centre of the spot (default centroid)", choices=("centroid", "chief")),
        Option("frequencies", positive_finite, "F", "of mtf, cycles/mm", flag="--frequency", nargs="+"),
        row("field_weights", "one a field, not the lens's own"),
        row("wavelength_weights", "one a wavelength, not the lens's own"),
    ),
    group(
        "boundaries, of any merit function",
        Option("glass_thickness", None, "MIN[:MAX]", "of glass on the axis, mm, as 2:15, or 2"),
        Option("air_thickness", None, "MIN[:MAX]", "of air on the axis, mm, as 2:15, or 2"),
        Option("edge", positive_finite, "MIN", "least thickness of glass at its edge, mm"),
    ),
)  # fmt: skip

#: --vary, --bounds and --hold: `optimization.variables.design_variables` and `bounds_of`, `optimization.conditions`.
FREEDOM = group(
    "variables, instead of the file's, and conditions",
    "vary",
    Option("bounds", None, "NAME:LOW..HIGH", "of variables: of a kind (thickness:2..15), of one (curvature_3:-0.1..0), "
           "open on one side (sensor:30..)", nargs="+"),
    Option("hold", None, "NAME=VALUE", "conditions, in addition to the lens's own (default) unless --no-hold is "
           "given: efl=50 f_number=4 'total_track<=80' 'distortion<=2%' 'bfd>=30' "
           "image_height=21.6 magnification=-0.5 'thickness:3-5>=20' 'edge>=1' efl@2=100, or an operand as "
           "REAY(8,0,0,1,0,0)=2; off:efl=50 switches one off", nargs="+"),
    switch("stored", "without the conditions of the lens (default: with them), which keeps them; with --hold: those "
           "alone", flag="--no-hold", default=True),
    about="Variables, in quotes: 'curvature thickness' (all powered surfaces, all gaps), curvature:1-4,7 conic:3 a4:3 "
    "tilt:5 decentre:5 sensor index glass:2, thickness:6@2 (in configuration 2); pickups and solves: "
    "'curvature:4=-curvature:3' 'thickness:8=2*thickness:2+1' 'curvature:7=f_number(4)' "
    "'thickness:8=marginal_height(0)' 'curvature:7=marginal_angle(-0.1)'. In optimize, of a lens with temperatures: "
    "spacer (materials of all spacers), spacer:4, barrel (one material).",
)  # fmt: skip

#: --as-built and its options: `tolerancing.as_built.AsBuilt`.
AS_BUILT = group(
    "the lens as built",
    switch("as_built", "with the expected mean square spot radius of the manufactured lens, its sensor refocused: the "
           "mean over perturbed lenses that give the second order in all tolerances exactly", default=None),
    "grade",
    "limits",
    Option("weight", positive_finite, "W", "weight relative to all rows of the merit function that are no boundaries "
           "(default 1: of --merit spot the lens without errors and the lens as built count alike)",
           flag="--as-built-weight"),
)  # fmt: skip
