"""The commands of `raytrace`: a row each, with summary, description, examples and options. Imports no torch.

A command calls the function of the public API that has its name. An option's destination is the name of that function's
parameter. A new command is a new row. A command that does more than call the function once names its own in `run`.
"""

import argparse
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

from raytrace.cli import codesign, wave_design, wave_restore
from raytrace.cli.options import (
    APERTURE,
    AS_BUILT,
    CONDITIONS,
    FREEDOM,
    LENS,
    MERIT,
    MODELS,
    OPTIONS,
    PUPIL,
    TABLE,
    Adder,
    Option,
    add,
    conditions,
    exclusive,
    group,
    object_distance,
    output,
    output_folder,
    plot,
    row,
    switch,
)
from raytrace.cli.types import (
    Reader,
    count,
    count_or_all,
    count_or_none,
    criterion_value,
    data_file,
    drawing_file,
    extent,
    file_name,
    file_of,
    finite,
    folder_name,
    lens_file,
    many,
    not_negative,
    picture_or_folder,
    positive,
    positive_finite,
    report_file,
)
from raytrace.cli.wave_options import ENGINE, camera, element, light, pixels
from raytrace.settings import COMPARED, ON_REQUEST, SECTIONS


@dataclass(frozen=True)
class Command:
    """One command.

    examples: the last part of its help page; options: names of rows of OPTIONS, further rows, and groups of both; run:
    module and function that return the result, where it is more than a call of the public function `verb` with a lens;
    carried_out_by: module and function that open the lens, run the command, and print and save its result.
    """

    name: str
    summary: str
    description: str
    examples: str
    options: tuple[str | Adder, ...]
    run: str | None = None
    subcommands: tuple["Command", ...] = ()
    carried_out_by: str = "cli.runner:carry_out"

    @property
    def verb(self) -> str:
        """Name of the public function."""
        return self.name.replace("-", "_")

    def add_to(self, commands: argparse._SubParsersAction, name: str = "", *, with_options: bool = True) -> None:
        """Add the parser of this command to a group of parsers, under its own name or another."""
        parser = commands.add_parser(
            name or self.name,
            help=self.summary,
            description=self.description,
            epilog=self.examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if with_options and self.subcommands:
            children = parser.add_subparsers(dest="subcommand", metavar="SUB", required=True)
            for command in self.subcommands:
                command.add_to(children, command.name.removeprefix(f"{self.name}-"))
        elif with_options:
            add(parser, self.options)
            flags = {
                action.dest: action.option_strings[0 if isinstance(action, argparse.BooleanOptionalAction) else -1]
                for action in parser._actions
                if action.option_strings
            }
            parser.set_defaults(run=self, flags=flags, suffix="")


def function(place: str) -> Callable:
    """The function that a row names as module:name."""
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(f"raytrace.{module}"), name)


def _command(
    name: str,
    summary: str,
    description: str,
    examples: str,
    /,
    *options: str | Adder,
    run: str | None = None,
    carried_out_by: str = Command.carried_out_by,
) -> Command:
    """A row; examples: one a line, without `raytrace NAME`."""
    start = f"  raytrace {name.replace('wave-', 'wave ').replace('stock-', 'stock ')} "
    text = "\n".join(["examples:", *(start + line.strip() for line in examples.strip().splitlines())])
    return Command(name, summary, description, text, options, run, carried_out_by=carried_out_by)


def _of_module(name: str, module: ModuleType, run: str) -> Command:
    return Command(name, module.SUMMARY, module.DESCRIPTION, module.EXAMPLES, (module.options, "max_bytes"), run)


_WAVE_FIGURES = {
    "heights": "the height of the element, as a disc and as a profile,",
    "caustic": "the light behind the element, over distance and radius,",
    "encircled": "the fraction of the light within a radius",
}


RIMS = switch("rims", "the semi-diameters as apertures instead of the vignetting factors")


class Step(argparse.Action):
    """An edit: its name and its words are appended to `steps`, in the order of the command line."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: object, word: str | None = None
    ) -> None:
        namespace.steps = [*getattr(namespace, "steps", ()), (self.dest, values)]


#: The edits of `raytrace edit`: name, reader, metavar, count of words, help.
EDITS: tuple[tuple[str, Reader | None, str | tuple[str, ...], str | int | None, str], ...] = (
    ("at", None, "SURFACES", None, "the surfaces of the edits behind it that name none"),
    ("scale", positive_finite, "FACTOR", None, "all lengths, and all that depends on them, by a factor"),
    ("efl", finite, "MM", None, "scale to an effective focal length"),
    ("reverse", None, "SURFACES", "*", "turn the lens around, or a group of surfaces; object and image stay"),
    ("swap_conjugates", None, "", 0, "turn the lens around with object and image: rays are traced backwards"),
    ("insert", None, "BEFORE ROW", "+", "surfaces before one, a row each, as radius=50,thickness=4,glass=N-BK7; "
     "without a row a plane"),
    ("insert_part", None, "BEFORE PART", "+", "a part of stock before a surface, by its number in the index, or by a "
     "vendor's file; reversed: turned around; index=stock.sqlite; gap=0 mm behind it"),
    ("replace_part", None, "SURFACES PART", "+", "a part of stock in the place of an element or a cemented group; "
     "reversed, index=stock.sqlite"),
    ("delete", None, "SURFACES", "*", "take surfaces out; all others stay in their places"),
    ("join", None, "SURFACES", "*", "take out surfaces that do nothing, and add the thicknesses"),
    ("split", None, "SURFACES", "*", "cut an element into two of the same power together: share=0.5 of the thickness, "
     "gap=0 mm, curvature=0 of the first face; of one surface: a meniscus without thickness before it"),
    ("cement", None, "SURFACES", "*", "make one surface of the two of an air space, as 2-3, of their mean curvature, "
     "or of curvature=0.02"),
    ("bend", None, "SURFACES X", "+", "the element of the shape factor X and the same power; keep=thin: its power "
     "without thickness"),
    ("semi_diameters", None, "SURFACES", "*", "semi-diameters by the rays of all fields, wavelengths and "
     "configurations: margin=2,0.5 per cent and mm beyond the rays; clear=12 mm, fixed, or auto; chip_zone=0.5 mm "
     "beyond the clear ones; mechanical=12.7 mm of the part, fixed, or auto; of some surfaces, or of all"),
    ("temperatures", None, "C", "+", "the lens at other temperatures as configurations, °C as -20 60, that of the lens "
     "first: radii, thicknesses and aspheres by thermal pickups, so that `optimize` makes it athermal; --mount is the "
     "material of its spaces, 4=invar that of the space behind surface 4"),
    ("system", None, "NAME=VALUE", "+", "other conditions: f_number=4 or entrance_pupil_diameter=10, fields=0,7,10 (or "
     "0:0,3:4 of x:y) in the kind of the lens, wavelengths=0.4861,0.5876,0.6563 primary_wavelength=2, field_weights, "
     "wavelength_weights, ray_aiming=real, object_distance=1000, magnification=-0.1, sensor_distance, temperature, "
     "pressure"),
    ("conditions", None, "NAME=VALUE", "+", "conditions that optimisations meet, stored in the lens, as of --hold of "
     "optimize: efl=100 'edge>=1'; none removes all"),
    ("rename", None, "TITLE", None, "the title"),
    ("comment", None, "SURFACES TEXT", "+", "the comment of a surface"),
)  # fmt: skip

_INDEX = "index of parts"

#: Subcommands of `raytrace stock`.
STOCK_COMMANDS = (
    _command(
        "stock-index",
        "read a folder of vendors' lens files into an index",
        "Read the parts of vendors' lens files (.zmx, .zar, .seq, .len, .roa) of a folder and its subfolders, or of a "
        "table of parts (.csv: part, radius_1, thickness_1, glass_1, radius_2, …, diameter, vendor, coating), into one "
        "file, which suffices without the folder: focal lengths, diameters, shape, glasses, coating, and the content "
        "of each file. Files without a part are listed with the reason. No data of vendors come with raytrace.",
        """
        vendors/thorlabs
        vendors -o all.sqlite --catalog vendors/special.agf
        parts.csv -o own.sqlite --json""",
        Option("folder", file_name, "FOLDER", "folder of lens files, or a table of parts (.csv)", flag="folder"),
        Option("output", file_of(".sqlite", ".db"), "INDEX", f"{_INDEX} to write: .sqlite, .db", "-o --output",
               default="stock.sqlite"),
        "catalog", "json", run="cli.runs:stock_index",
    ),
    _command(
        "stock-find",
        "parts of an index by their figures",
        "List the parts of an index by focal length, diameter, shape and glass, the nearest to what is asked for "
        "first: the distance is the sum of the relative deviations. Lengths are a number, which is met to "
        "--tolerance, or a range as 45..55 or 25..",
        """
        --efl 50 --diameter 25.4 --achromat
        all.sqlite --efl -60..-40 --shape plano-concave --glass N-SF11
        --vendor thorlabs --part AC254 --limit 100 -o achromats.csv""",
        Option("index", file_name, "INDEX", _INDEX, flag="index", nargs="?", default="stock.sqlite"), TABLE, "json",
        Option("efl", None, "MM", "effective focal length, at the primary wavelength of the file"),
        Option("bfl", None, "MM", "back focal length, in the orientation of the file"),
        Option("diameter", None, "MM", "diameter"),
        Option("tolerance", positive_finite, "PERCENT", "within which a single number is met", default=10.0),
        Option("elements", count, "N", "number of elements"),
        switch("achromat", "cemented groups whose power changes by less than 1/200 from F to C"),
        Option("shape", None, "TEXT", "plano-convex, biconvex, meniscus, plano-concave, biconcave, doublet, …"),
        Option("glass", None, "GLASS", "glasses that the part has", nargs="+"),
        Option("part", None, "TEXT", "part of the number"),
        Option("vendor", None, "TEXT", "part of the vendor's name"),
        Option("coating", None, "TEXT", "part of the name of the coating"),
        Option("limit", count, "N", "parts that are listed", default=20), run="cli.runs:stock_find",
    ),
)  # fmt: skip

#: Subcommands of `raytrace wave`.
WAVE_COMMANDS = (
    _command(
        "wave-psf",
        "point spread functions over depth and colour",
        """\
Kernels of a phase element for points on the axis, over depth and wavelength, integrated over pixels. All light through
the aperture is 1: `energy` is the fraction inside the window, `peak` that in the brightest pixel, or in a pixel centred
on the axis if the window has an even number of pixels. Named elements are listed under --element: smooth ones (ideal,
singlet, …-refractive) of PMMA, wrapped ones of fused silica, all for one focus.

The engine depends on the scene, its sampling on --tol; a sampling that would alias into the window is refused.
--samples sets the sampling.""",
        """
        --element singlet --focus 1000 --depth 500 1000 inf -o psf.npz --plot psf.png
        --element fresnel --levels 16 --depth 1000 --wavelength 0.46 0.55 0.64 --json
        --element cubic --focus 1000 --pixel 0.00369 --size 128 --exact -o cubic.npz
        --element heights.npy --glass F_SILICA --design-wavelength 0.55 --levels 16 --plot made.png
        --element ideal --depth 500 --engine fresnel --samples 2500 --json""",
        element, camera(), light(), pixels(), ENGINE, "json",
        output(
            "arrays to write (.npz): psf[depth, wavelength, y, x], pixel_pitch, energy, depths, wavelengths, engine, "
            "error", file_of(".npz"),
        ),
        plot("the kernels"),
        group("more figures", *(
            plot(content, f"plot_{name}", flag=f"--{name}") for name, content in _WAVE_FIGURES.items()
        )),
        "max_bytes", run="cli.runs:wave_psf",
    ),
    _of_module("wave-design", wave_design, "cli.wave_run:design"),
    _of_module("wave-restore", wave_restore, "cli.wave_run:restore_files"),
)  # fmt: skip


#: All commands, in the order of the help page.
COMMANDS = (
    _command(
        "info",
        "first-order data and the surfaces of a lens",
        "Print focal lengths, pupils, magnification and the prescription of a lens.",
        """
        double_gauss
        lenses/double_gauss.zmx --object-distance 25000 --f-number 4
        lens.zmx --json | python3 -m json.tool
        lens.zmx -o prescription.csv""",
        *LENS, CONDITIONS, TABLE,
    ),
    _command(
        "lenses",
        "list the shipped lenses and the files of a folder",
        "List the names and titles of the shipped lenses, and of a folder the files that commands read (lens files, "
        "glass catalogs, checkpoints) and its folders.",
        """
        lenses
        --json""",
        Option("folder", file_name, "FOLDER", "folder to list", flag="folder", nargs="?", default="."),
        "json", run="cli.runs:lenses",
    ),
    _command(
        "check",
        "import report of a lens file",
        "Print the import report: every keyword read, ignored (with the reason) or unknown, and the catalog of each "
        "glass. Fails if the file cannot be read; with --strict also if anything was assumed.",
        """
        lens.zmx
        lens.zmx --strict --json""",
        *LENS, "strict", run="cli.runs:check",
    ),
    _command(
        "convert",
        "write a lens in another format",
        "Read a lens file and write it in the format of the suffix of OUT. Numbers are kept bit for bit.",
        """
        lenses/double_gauss.zmx double_gauss.csv
        table.txt lens.zmx
        lens.zmx lens.seq""",
        Option("source", file_name, "IN", "lens file, or the name of a shipped lens", flag="source"),
        Option("target", lens_file, "OUT", "lens file to write: .zmx, .seq, .csv, .tsv, .txt", flag="target"),
        "catalog", "json", row("strict", "fail on anything unknown or assumed in IN"), "configuration", "substitute",
        "max_bytes", run="cli.runs:convert",
    ),
    _command(
        "edit",
        "scale, reverse, split, cement, bend, insert, delete, semi-diameters, temperatures",
        """\
Edit a lens and write it: edits are carried out in the order given, and each numbers the surfaces as the edits before
have left them. SURFACES are a number, the first and the last one as 3-6, or the comment of a surface: "front doublet"
is the element, or the cemented group, that begins there.

Stop, solves, pickups, configurations, merit rows and tolerances follow with their numbers; what refers to a surface
that is gone is left out and named in a warning. Focal length, track and F-number before and after are printed.""",
        """
        double_gauss --scale 2 -o large.zmx
        cooke_triplet --efl 50 --rename "Cooke triplet 50 mm" -o triplet50.zmx
        cooke_triplet --reverse -o reversed.zmx
        double_gauss --reverse 3-5 -o flipped.zmx
        relay.zmx --swap-conjugates -o backwards.zmx
        cooke_triplet --split 1-2 gap=0.1 --bend 1-2 1 -o four.zmx
        lens.zmx --cement 2-3 -o doublet.zmx
        lens.zmx --at "front doublet" --reverse --comment "front doublet, turned" -o turned.zmx
        lens.zmx --semi-diameters margin=2,0.5 chip_zone=0.5 --semi-diameters 1-2 mechanical=12.7 -o sized.zmx
        lens.zmx --system f_number=4 fields=0,7,10 ray_aiming=real --conditions efl=100 'edge>=1' -o specified.zmx
        lens.zmx --insert 3 radius=50,thickness=4,glass=N-BK7 radius=-80,thickness=1 --delete 9-10 -o changed.zmx
        lens.zmx --join 4 --comment 1 "front element" -o tidy.zmx
        cooke_triplet --temperatures -20 60 --mount aluminium -o warm.zmx
        lens.zmx --insert-part 3 AC254-050-A reversed gap=2 -o with_part.zmx
        lens.zmx --replace-part 1-2 vendor/LA1131-A.zmx reversed -o replaced.zmx""",
        *LENS,
        group(
            "edits, in the order given",
            *(Option(name, reader, metavar, help, nargs=nargs, action=Step)
              for name, reader, metavar, nargs, help in EDITS),
        ),
        row("mount", "of all spaces without a stated expansion, stored in the lens: aluminium, titanium, invar, "
            "stainless-304 …, or its expansion in 1e-6/K"),
        Option("output", lens_file, "OUT", "lens file to write: .zmx, .seq, .csv, .tsv, .txt", "-o --output",
               required=True), run="cli.runs:edit",
    ),
    _command(
        "layout",
        "draw the lens with rays",
        "Draw the cross section of a lens with the rays of its fields; folded systems are drawn in space.",
        """
        double_gauss --plot layout.png
        lens.zmx --field 0 14 -14,0 --plot layout.pdf
        folded_relay --view 3d --plot relay.png
        spectrometer --wavelength 0.45 0.55 0.65
        scanner.zmx --configuration all --plot scan.png""",
        "lens",
        row("configuration", f"{OPTIONS['configuration'].help}; all: in one figure, superimposed", reader=count_or_all),
        *LENS[2:], CONDITIONS, plot("the cross section (default LENS_layout.png in this folder)"), "fields",
        Option("rays", count, "N", "of each fan, in the plane that is shown", default=7),
        Option("view", help="yz (from the side), xz (from above) or 3d (in space)", choices=("yz", "xz", "3d"),
            default="yz"),
        run="cli.runs:layout",
    ),
    _command(
        "draw",
        "drawings to ISO 10110, and solids, for the workshop",
        "Draw the whole lens with its parts, vertex distances and tolerances, and with --elements a sheet to ISO 10110 "
        "for each element and each cemented group: profile to scale, diameters, radii, thickness, chamfers, the "
        "indications 0/ to 6/, equation and sag table of aspheres. .pdf has a page a sheet, .svg and .png a file a "
        "sheet. .dxf has the profiles and .step the solids of the same parts at 1:1; both need the extra: pip install "
        "'raytrace[cad]'. The text lists the parts.",
        """
        double_gauss --elements --grade precision -o drawings.pdf
        cooke_triplet --elements 2 --margin 1 --chamfer 0.3 --indications 5/5x0.25 0/20 -o element.svg
        lens.zmx -o lens.step
        hubble --substrate 300 -o mirrors.step
        phone --elements 1 -o element.dxf""",
        *LENS, CONDITIONS,
        output("drawings (.pdf, .svg, .png), profiles (.dxf), solids (.step), or the table of parts (.csv, .json)",
            drawing_file),
        Option("elements", count, "N", "a sheet for each element and cemented group, or for these alone, from 1 in the "
            "order of the light; files of CAD have these parts", nargs="*"),
        group(
            "requirements",
            row("grade", "tolerances of a published grade instead of the file's"),
            row("limits", "words and kinds with their limits ±, as of `tolerance`", default=""),
            "radial",
            Option("indications", None, "N/VALUE", "further indications of ISO 10110 of all parts: 0/20 1/3x0.16 2/1;1 "
                "5/5x0.25 6/-; others are dashes", nargs="+", default=""),
            Option("coating", None, "TEXT", "of all surfaces in air", default=""),
        ),
        group(
            "mechanical sizes",
            Option("margin", not_negative, "MM", "added to mechanical semi-diameters that are not fixed", default=0.0),
            Option("chamfer", not_negative, "MM", "legs of the chamfers at edges in air, at 45°", default=0.0),
            Option("substrate", positive_finite, "MM", "thickness of mirrors (default: a sixth of their diameter)"),
        ),
        Option("date", None, "TEXT", "of the title block; of STEP files as 2026-11-29", default=""),
    ),
    _command(
        "report",
        "one document of a lens: figures, tables, conditions, tolerances",
        f"""\
Write a report of a lens as .pdf, or as one .html file without references to others. Its numbers and figures are those
of the commands of its sections; a section that does not apply to the lens gives the reason in a line. Zoom lenses are
shown in all configurations. .json has the results of all sections.

Sections: {", ".join(name for name in SECTIONS if name not in ON_REQUEST)}
on request: {", ".join(ON_REQUEST)}""",
        """
        double_gauss -o report.pdf
        cooke_triplet --grade precision --tolerance --trials 500 -o report.html
        tessar --only layout spots mtf -o figures.pdf
        lens.zmx --without fans conditions --also seidel drawings -o report.pdf
        zoom.zmx --configuration 2 --field 0 5 10 -o tele.pdf
        double_gauss --range -20 60 --mount aluminium -o report.pdf""",
        "lens", row("configuration", "which one of a multi-configuration file, from 1 (default: all)"), *LENS[2:],
        CONDITIONS, output("report to write (.pdf, .html, .json); without it the sections are listed",
                                       report_file),
        "fields",
        group(
            "sections",
            Option("only", None, "SECTION", "these sections alone", nargs="+", choices=SECTIONS, default=()),
            Option("without", None, "SECTION", "sections to leave out", nargs="+", choices=SECTIONS, default=()),
            Option("also", None, "SECTION", "sections in addition", nargs="+", choices=SECTIONS, default=()),
            Option("date", None, "TEXT", "of the title (default: today)"),
        ),
        group(
            "tolerances",
            row("grade", "tolerances of a published grade instead of the file's"),
            row("limits", "words and kinds with their limits ±, as of `tolerance`", default=""),
            "radial",
            switch("tolerance", "with the section as-built: sensitivities, expectation and Monte Carlo, as of "
                "`tolerance`"),
            Option("criterion", help="of the lens as built, as of `tolerance`", default="rms"),
            Option("trials", count_or_none, "N", "perturbed lenses", default=1000),
            row("seed", "seed of random numbers"),
        ),
        Option("temperatures", finite, ("LOW", "HIGH"), "with the section temperature, from the lowest to the highest, "
            "°C (default: -20 60, if the file has temperatures or expansions)", flag="--range", nargs=2),
    ),
    _command(
        "spot",
        "spot sizes and the spot diagram",
        "Trace each field and wavelength to the sensor: centroid, RMS and geometric radius about it. -o writes the "
        "rays: field_x,field_y,wavelength,pupil_x,pupil_y,x,y,weight,status; x and y are empty for a ray that "
        "does not reach the sensor. status: ok, vignetted, miss, tir, unaimed.",
        """
        double_gauss --plot spot.png
        lens.zmx --object-distance 25000 --field 0 10 14 --json
        double_gauss --field 0,10 7,7 --sampling hexapolar --rings 6 -o rays.csv
        double_gauss --field 14 --rays 1e9 --max-bytes 200MB""",
        *LENS, CONDITIONS, plot("the spot diagram"),
        output("table of the rays to write (.csv): field, wavelength, pupil point, x, y, weight, status",
            file_of(".csv", "")),
        "fields", *PUPIL,
        Option("rays", many, "N", "instead of --points, any number of sobol or random rays for each field and "
            "wavelength, traced in chunks of at most --max-bytes (default 256MB), none kept and nothing "
            "differentiated"),
        Option("reference", help="radii about the centroid or the chief ray of the primary wavelength",
            choices=("centroid", "chief"), default="centroid"),
        Option("weights", help="of rays, by their share of the pupil's area, or all equal; OpticStudio's spots are "
            "--sampling hexapolar, --rings 6, --weights equal, --reference chief", choices=("area", "equal"),
            default="area"),
        run="cli.runs:spot",
    ),
    _command(
        "focus",
        "find the best sensor distance",
        "Find the sensor distance of minimum RMS spot radius in closed form, without retracing; by default on the axis "
        "at the primary wavelength.",
        """
        lenses/double_gauss.zmx --object-distance 25000 --plot focus.png
        lens.zmx --object-distance 10000 25000 50000 --field 0 10 14 -o focused.zmx""",
        *LENS, conditions("several are focused together"),
        plot("the through-focus curve, the spots before and after, and the layout"),
        Option("plot_by", help="draw only the through-focus curves, one for each field, or for each wavelength of the "
            "first field", flag="--by", choices=("field", "wavelength")),
        output("lens file to write with the new sensor distance", lens_file),
        "distance_weights", "fields", "field_weights", "wavelength_weights",
        Option("criterion", help="rms (minimum RMS spot radius, in closed form and differentiable), paraxial (image, "
            "or the weighted mean of those of several objects) or mean (minimum mean distance from the centroid)",
            choices=("rms", "paraxial", "mean"), default="rms"),
        *PUPIL, run="cli.runs:focus",
    ),
    _command(
        "optimize",
        "minimise the merit function of a lens",
        "Optimise a lens by damped least squares on exact derivatives of its merit function: the file's, or the one of "
        "--merit. Solves and pickups hold at every step. --as-built adds the expected spot of the manufactured lens, "
        "which makes the lens less sensitive to its tolerances. With --stock the elements whose curvatures vary are "
        "replaced by parts of an index, one after the other, each by the best one in its best orientation, and the "
        "rest is optimised after each; --test-plates likewise sets variable radii to those of a list. The text reports "
        "what each costs. -o writes the lens with its variables and merit function. "
        "Ctrl-C stops and writes the best lens so far.",
        """
        lens.zmx -o better.zmx --plot better.png
        double_gauss --merit spot --vary curvature thickness --seconds 10 -o better.zmx
        tessar --merit spot --vary curvature sensor thickness:2,4 --bounds thickness:1.. --hold efl=100
        tessar --merit spot --vary curvature sensor glass --hold efl=100 --catalog SCHOTT -o better.zmx
        tessar --merit spot --vary curvature sensor glass --hold efl=100 --glasses preferred 'price<=2' -o cheap.zmx
        double_gauss --merit spot --vary curvature thickness --hold efl=99.5 --as-built --grade precision -o robust.zmx
        lens.zmx --stock stock.sqlite --vary curvature thickness --hold efl=50 -o of_stock.zmx
        lens.zmx --test-plates plates.csv -o with_plates.zmx
        warm.zmx --merit spot --vary curvature sensor spacer --mounts aluminium titanium invar peek -o athermal.zmx
        lens.zmx --cycles 50 --checkpoint best.json --log cycles.csv
        lens.zmx --cycles 100 --resume best.json --checkpoint best.json -o better.zmx""",
        *LENS, "ray_aiming", *MERIT, FREEDOM, "glasses",
        Option("mounts", None, "MATERIAL", "materials for spacer and barrel in --vary, as aluminium stainless-304, or "
            "1e-6/K (default: all listed materials)", nargs="+"), AS_BUILT,
        group(
            "parts of stock and test plates",
            Option("stock", file_name, "INDEX", "replace elements and cemented groups by parts of this index, which "
                "`raytrace stock index` makes"),
            Option("test_plates", file_name, "LIST", "set radii to those of a table of test plates (.csv): radius (mm) "
                "and shape (CX, CC of the glass), diameter (mm), tolerance, name, where they are known"),
        ),
        group(
            "stopping",
            Option("cycles", count, "N", "maximum, including those before --resume (default 500); of a choice of "
                "glasses, spacers, parts or test plates that of each of its descents"),
            "seconds",
            Option("paths", count, "N", "damping strategies to try", default=1),
        ),
        group(
            "files",
            Option("log", data_file, "FILE", "write a line for every cycle (.csv)"),
            Option("checkpoint", data_file, "FILE", "store the state of the search there (.json)"),
            Option("resume", file_name, "FILE", "resume from a checkpoint of the same lens, variables and merit "
                "function"),
        ),
        plot("the lens, its spots and its merit function, before and after"), output("lens file to write", lens_file),
    ),
    _command(
        "search",
        "find the minima of a merit function globally, within bounds",
        "Find the distinct minima of a merit function, the file's or the one of --merit, within the bounds of the "
        "variables. Evenly distributed starts (plane plates suffice) are scaled to the focal length, focused and "
        "optimised; the best are converged, and the search hops on from the best minima. --moves insert, split, "
        "cement or delete elements of the lens, or with --starts of the best minima, and --elements asks for the best "
        "lens of every number of elements. --as-built orders the minima by the merit with the expected spot of the "
        "manufactured lens, and lists both. -o stores every minimum as a lens file, a table, figures and the state of "
        "the search: the same command resumes there bit-identically. "
        "Ctrl-C stops and keeps the minima found. Processes share the work: "
        "torchrun --nproc-per-node 2 -m raytrace search …",
        """
        lens.zmx --starts 200 --seconds 60 -o minima
        cooke_triplet --merit spot --vary curvature thickness --hold efl=100 --edge 1 --seconds 20 -o minima
        cooke_triplet --merit spot --vary curvature sensor --hold efl=100 --starts 32 --as-built --grade precision
        triplet.zmx --moves insert:2,4 split -o four_elements
        double_gauss --merit spot --vary curvature thickness --hold efl=100 --edge 1 --moves delete -o fewer
        triplet.zmx --moves insert delete --elements 2:5 -o two_to_five
        phone_plates --kind phone --hold efl=6 -o phone
        singlet --merit spot --vary curvature sensor --starts 8 --plot minima.png""",
        *LENS, "ray_aiming", *MERIT, FREEDOM, AS_BUILT,
        group(
            "extent",
            Option("starts", count, "N", "initial designs (default 64; with --moves none: the lens itself)"),
            Option("moves", None, "MOVE", "from the lens, or with --starts from the best minima: insert a thin "
                "meniscus at every surface, split or delete every element, cement facing surfaces of nearly equal "
                "curvature; of some surfaces, as insert:2,4", nargs="+"),
            Option("elements", None, "N[:M]", "numbers of elements, as 5 or 2:5: moves from the best lenses of each "
                "number to the next, up and then down (default: each move once)"),
            Option("keep", count, "N", "of --elements: best lenses of each number, from which moves begin (default 2)"),
            "seconds",
            Option("kind", None, None, "phone: from plates of plastic to a wide and fast lens of aspheres, in steps",
                choices=("phone",)),
            row("seed", "of starts and hops"),
        ),
        plot("the best lenses side by side"),
        output_folder("folder for lens files and their table; a search stored there resumes"),
    ),
    _command(
        "evaluate",
        "merit function of a lens, row by row",
        "Evaluate a merit function: the file's, or a default one by --merit. Each row has its operand, arguments, "
        "target, weight, value and contribution to the square of the merit. In long tables the rays of a field share a "
        "line; --each lists them all. Rows of unknown operands are an error if they have a weight.",
        """
        lens.zmx
        double_gauss --merit spot --rings 6 --arms 8 --plot merit.png
        tessar --merit wavefront --glass-thickness 2:15 --air-thickness 0.5:50 --edge 1 --json
        zoom.zmx --configuration 2 --skip-unknown""",
        *LENS, CONDITIONS, *MERIT, plot("the contributions to the merit, by operand and field"), TABLE,
        switch("each", "list every row, also the rays of one field"),
    ),
    _command(
        "jacobian",
        "derivatives of rays or of a merit function by variables and errors of manufacture",
        "Derivatives of the points where rays land, of their directions or paths, or of the residuals of a merit "
        "function, by all design variables and errors of manufacture in one pass, with the launch and aiming of the "
        "rays. The text has the mean and the largest derivative by each number; -o and --json have all of them.",
        """
        cooke_triplet --vary curvature thickness temperature
        cooke_triplet --grade precision --of paths
        lens.zmx --of paths --field 0 10 -o derivatives.json
        double_gauss --vary curvature --of merit --merit spot""",
        *LENS, CONDITIONS, row("vary", "variables, pickups and solves (default: the file's)"),
        Option("of", None, "QUANTITY", "points, where rays land on the image (default), directions, paths or merit",
            choices=("points", "directions", "paths", "merit")),
        Option("merit", None, "KIND", "of --of merit: spot, wavefront or angular (default: the file's)"), TABLE,
        row("grade", "errors of manufacture by the tolerances of a published grade, as of `tolerance`"),
        row("limits", "errors by kind and limit, as of `tolerance`", default=""), "fields",
    ),
    _command(
        "view",
        "turn the numbers of a lens in a browser",
        "Serve the viewer of a lens on 127.0.0.1: its prescription as a table with a slider on every number, layout, "
        "spots, ray fans, MTF and field curves, redrawn while a slider is dragged; undo, optimise, compare, save. The "
        "address has a random token; nothing is written except by save. Ctrl-C ends it. Needs the extra: pip install "
        "'raytrace[view]'.",
        """
        cooke_triplet
        lens.zmx --port 8765 --no-browser""",
        *LENS, CONDITIONS, Option("port", count, "N", "port of the server (default: a free one)"),
        switch("browser", "print the address, open no browser", flag="--no-browser", default=True),
        run="cli.runs:view",
    ),
    _command(
        "mcp",
        "let agents use the tracer",
        "Serve agents (language models) by the Model Context Protocol over standard input and output: tools that "
        "read, analyse, draw, optimise, search, tolerance and convert lenses. Files are read and written below one "
        "folder only, and replaced only by request. A client starts this command. Needs the extra: pip install "
        "'raytrace[mcp]'.",
        """
        --folder lenses
        --folder . --json""",
        Option("folder", file_name, "DIR", "folder below which files are read and written", required=True),
        row("json", "print the tools with the schemas of their parameters as one JSON document, and serve none"),
        carried_out_by="agents.server:carry_out",
    ),
    _command(
        "trace",
        "trace rays of a table, surface by surface",
        "Trace rays and write one row per ray and surface: ray,surface,x,y,z,l,m,n,opl,status in each surface's own "
        "frame, direction after the surface, opl the optical path from the given start. At a coordinate break the row "
        "is the previous point and path in the new axes. status: ok, miss, tir, vignetted. A vignetted ray keeps its "
        "coordinates; a missed or totally reflected one ends with an empty row. "
        "Chief and marginal rays, at the primary wavelength or those of --wavelength, have further columns: "
        "object_distance,field_x,field_y,wavelength,pupil_x,pupil_y.",
        """
        double_gauss --field 0 14 0,-7
        lens.zmx --rays rays.csv -o traced.csv""",
        *LENS, output("table to write (.csv); default: standard output", file_of(".csv", ".txt", "")),
        conditions("rays from each"),
        Option("rays", file_name, "CSV", "rays to trace: columns x,y,z,l,m,n in the frame of surface 1, optional "
            "wavelength; by default the chief and marginal rays of every field"),
        "fields", run="cli.runs:trace",
    ),
    _command(
        "psf",
        "point spread functions by five models",
        "Compute point spread functions over object distance and field, integrated over pixels, to a tolerance. "
        "Models: paraxial, fourier, gaussian, drt (ray-traced), wave (diffraction of the traced wavefront). Several "
        "processes, or machines, share the kernels, or with --model drt --rays the rays; the result equals that of one "
        "process to rounding and is written once: torchrun --nproc-per-node 2 -m raytrace psf …",
        """
        double_gauss --model gaussian --object-distance 10000 30000 --plot psf.png
        double_gauss --model wave --field 14 --center chief --tol 1e-3 -o psf.npz
        double_gauss --model drt --rays 256 --json
        cooke_triplet --model wave --cross-section --plot sections.png -o sections.csv
        double_gauss --model drt --rays 1e8 --max-bytes 200MB -o psf.npz""",
        *LENS, conditions("one row of kernels each"),
        Option("rho", positive_finite, "R", "of the paraxial model: σ over the radius of the blur (default 0.5, the "
            "second moment of a uniform disc)"),
        exclusive(
            "tol",
            Option("rays", many, "N", "rays per kernel instead of a tolerance; with --model drt and --max-bytes any "
                "number of them"),
        ),
        output("arrays to write (.npz): psf[distance, field, y, x], or [distance, field, wavelength, y, x], "
            "pixel_pitch, energy, error, wavelengths, model; with --cross-section its table (.csv) or document (.json)",
            file_of(".npz", ".csv", ".json")),
        plot("the kernels, finely in windows that they fill (with --pixel or --size: the pixels),"), "plot_log",
        Option("cross_section", help="profiles through the peak (without a word) or the centroid along x and y, line "
            "spreads (integrated across), and their full widths at half maximum, instead of the kernels",
            nargs="?", const="peak", choices=("peak", "centroid")),
        "model", "fields", "wavelength_weights", "pixel",
        row("size", "pixels across the window of the PSF (default 21)"),
        Option("center", help="centre of the window: the chief ray (default), the optical axis or the centroid of the "
            "rays", choices=("axis", "chief", "centroid")),
        Option("normalise", help="energy (1 = all light through the entrance pupil) or window (each kernel sums to 1)",
            choices=("energy", "window"), default="energy"),
        switch("per_wavelength", "a kernel for each wavelength instead of their weighted sum"),
        run="cli.runs:psf",
    ),
    _command(
        "render",
        "photograph pictures through a lens",
        """\
Compute the image that a lens projects onto its sensor. Every picture is the upright view of a scene; its image has the
blur, distortion, lateral colour and relative illumination of each place, and with --depth the blur of each distance.

Pictures (.png, .jpg, .webp, .tif, .bmp) hold sRGB levels of 8 or 16 bits, which are decoded to light, or light (.tif of
floating-point numbers); 1 is white on the axis. The image is encoded as sRGB (.png) or is light (.tif, .npy). With
--mosaic, --full-well, --read-noise or --bits the sensor records it first, and colours that the mosaic lacks are
interpolated. -o names a file, or a folder for several pictures, which share the kernels if they have one size.""",
        """
        cooke_triplet photo.jpg -o rendered.png --plot comparison.png
        double_gauss photo.png --sensor 36x24 --f-number 2.8 --mosaic RGGB --full-well 3e4 --bits 12 -o raw.png
        tessar near_far.png --depth map.png --depth-range 800 5000 --planes 6 -o rendered.png
        phone a.jpg b.jpg --no-distortion --no-illumination -o folder --json""",
        *LENS, Option("picture", file_name, "PICTURE", "pictures to render, sRGB levels", flag="picture", nargs="+"),
        conditions("one result after the other, in files named by the distance"),
        Option("output", picture_or_folder, "OUT", "picture to write: .png, sRGB; .tif or .npy, light; of several "
            "pictures a folder of .png files", flag="-o --output"),
        Option("png_bits", int, "N", "of a .png file", choices=(8, 16), default=8),
        switch("raw", "write the mosaic that the sensor records (.tif, .npy)"),
        plot("the pictures of an ideal lens and of this one, whole and in detail,", flag="--compare --plot"),
        group(
            "the sensor",
            Option("sensor", extent, "WxH", "width and height in mm, as 24x16 (default: the largest field of the lens "
                "in the corners)"),
            Option("offset", finite, ("X", "Y"), "of its centre from the optical axis, mm (default 0 0)", nargs=2),
            Option("response", None, "NAME", "rgb, grey, a table wavelength_nm,r,g,b (.csv), or a measured camera: "
                "'Nikon 5100 (NPL)', 'Sigma SDMerill (NPL)' (default rgb of coloured pictures, grey of grey ones)"),
            Option("mosaic", None, "PATTERN", "Bayer pattern: RGGB, BGGR, GRBG or GBRG (default none)",
                choices=("none", "RGGB", "BGGR", "GRBG", "GBRG")),
            Option("full_well", positive_finite, "E", "electrons of white: adds shot noise"),
            Option("read_noise", not_negative, "E", "standard deviation in electrons; without --full-well a fraction "
                "of white"),
            Option("bits", count, "N", "bits of the quantisation, before those of the file"),
            Option("black_level", not_negative, "E", "offset of the quantisation, unit of --read-noise (default five "
                "times that)"),
            row("seed", "of the noise, which differs from picture to picture"),
        ),
        group(
            "depth",
            Option("depth", file_name, "MAP", "distance of every pixel from surface 1: an array of mm (.npy), or a "
                "grey picture, dark is near"),
            Option("depth_range", positive_finite, ("NEAR", "FAR"), "mm of black and of white of the picture MAP, "
                "linear between them", nargs=2),
            Option("background", file_name, "PICTURE", "the scene behind the objects, without them (default: it "
                "continues as around them)"),
            Option("planes", count, "N", "layers, at equally spaced reciprocal distances; near ones cover far ones",
                default=8),
            Option("softness", not_negative, "SHARE", "of the transition between layers, a logistic function of so "
                "large a share of the difference of their reciprocal distances", default=0.0),
        ),
        group(
            "left out",
            switch("distortion", "no distortion: the image of an ideal lens, blurred", flag="--no-distortion",
                default=True),
            switch("lateral_colour", "no lateral colour: the kernels of all wavelengths are centred on one chief ray",
                flag="--no-lateral-colour", default=True),
            switch("illumination", "no relative illumination: as bright in the corners as on the axis",
                flag="--no-illumination", default=True),
        ),
        group(
            "kernels",
            row("model", "of the PSF: paraxial, fourier, gaussian, drt or wave, in order of fidelity (default: the "
                "first of the last three that differs from the next by less than --tol)", choices=MODELS),
            row("tol", "bound on the estimated error of the kernels, of the light of a point", default=0.01),
            row("size", "pixels across their window, an odd number, by default as many as hold the light"),
            Option("boundary", help="the scene beyond the edge of the picture: reflect, its mirror image, or zero, "
                "black", choices=("reflect", "zero"), default="reflect"),
        ),
        run="cli.render_run:render_files",
    ),
    _command(
        "compare",
        "compare two lenses by any analysis, in one table and one figure",
        f"""\
Compare two lenses, such as one before (LENS) and after (OTHER) an optimisation: a table of both and of their
differences, and with --plot one figure of one scale. Fields and wavelengths of both are those of LENS. (PSF models of
one lens: compare-models.)

Analyses: {", ".join(COMPARED)}; layout has first-order data.""",
        """
        before.zmx after.zmx
        before.zmx after.zmx --analysis mtf --plot mtf.png
        cooke_triplet tessar --analysis spot --field 0 10 --plot spots.pdf
        before.zmx after.zmx --analysis ray-fan --wavelength 0.55 -o fans.csv""",
        "lens", Option("other", file_name, "OTHER", "the second lens, a file or the name of a shipped lens",
                       flag="other"), *LENS[1:], CONDITIONS, plot("both lenses in one figure"), TABLE,
        Option("analysis", None, None, "what is compared", choices=COMPARED, default="layout"), "fields",
        Option("frequencies", positive_finite, "F", "of mtf, cycles/mm (default: to the higher resolution of both)",
               flag="--frequency", nargs="+"),
        run="cli.runs:compare",
    ),
    _command(
        "compare-models",
        "compare the PSF models",
        "Compare DRT (256 rays), Gaussian DRT, paraxial, Fourier and wave PSFs on the axis over object distance, with "
        "one sensor, in windows of 21 pixels of 5 µm, by default at 0.53 µm. The table lists for each model: change of "
        "the kernel when the conic of the most curved surface grows by 0.2; longer over shorter σ (of waves: of their "
        "rays) and asymmetry of the kernel of the largest field; radius of the first dark ring at F/16 over that of "
        "the Airy disc; number of lens parameters that change the kernel; rays traced. "
        "These numbers use DRT to a tolerance, since the noise of 256 rays would pass for aberrations.",
        """
        lenses/double_gauss.zmx --plot compare.png
        double_gauss --start rms --json""",
        *LENS,
        group(
            "conditions other than the file's",
            object_distance("the columns (default 10000 20000 30000 40000 50000)"), APERTURE, "wavelengths",
            "ray_aiming",
        ),
        plot("the grid of kernels"), "plot_log",
        Option("focus_distance", positive, "MM", "object in focus", default=25e3),
        Option("start", help="sensor position, the paraxial image or the minimum RMS spot radius on the axis",
            choices=("paraxial", "rms"), default="paraxial"),
        row("pixel", default=0.005), row("size", default=21),
    ),
    _command(
        "glass",
        "look up a glass",
        "Print index, nd, Vd, formula, range, expansion, density, price, internal transmittance and catalog of a "
        "glass; similar names are suggested for an unknown one. "
        "With a temperature or a pressure also its indices there, relative to air at that temperature and pressure, "
        "and their change with temperature.",
        """
        N-BK7
        SK16 --wavelength 0.53 --json
        N-BK7 --temperature 40 --pressure 0
        MYGLASS --catalog my_glasses.agf""",
        Option("name", None, "NAME", "name of a glass, as in a lens file, or a six-digit MIL code", flag="name"),
        "catalog", "json", row("wavelengths", "wavelengths in µm (default: F d C)"), "temperature", "pressure",
        "max_bytes", run="cli.runs:glass",
    ),
    _command(
        "glasses",
        "list glasses by status, price, transmittance and resistance",
        "List the glasses of the catalogs that pass a selection: the glasses that 'optimize --vary glass' and codesign "
        "choose from by the same words in --glasses. Without words these are preferred and standard glasses and those "
        "of catalogs without statuses. Obsolete, special, melt and radiation-hard glasses are left out and counted. "
        "Limits, in quotes: price<=3 (relative to the maker's BK7), density<=4 (g/cm³), expansion<=9 (1e-6/K), "
        "nd>=1.7, vd<=40, transmittance:0.4>=0.98 (internal, of 10 mm at 0.4 µm), and classes of resistance climate "
        "stain acid alkali phosphate, as acid<=2. A glass whose catalog does not list a figure does not meet its "
        "limit: the shipped catalogs list no resistance, the catalogs of glass makers (.agf) do.",
        """
        --catalog SCHOTT
        preferred 'price<=2' 'transmittance:0.4>=0.98' --catalog SCHOTT --catalog OHARA
        'nd>=1.8' 'vd>=40' --wavelength 0.4 1.0
        any 'climate<=2' 'acid<=2' --catalog my_glasses.agf --json""",
        Option("words", None, "WORD", "statuses and limits (default: preferred standard unlisted)", flag="words",
               nargs="*", default=""),
        row("catalog", "catalog to list, an .agf file or the name of a shipped one; may be repeated (default: those of "
            "RAYTRACE_CATALOGS and all shipped ones)"),
        "json", row("wavelengths", "wavelengths in µm that the range of each glass covers"), TABLE,
        "max_bytes", run="cli.runs:glasses",
    ),
    _command(
        "bench",
        "measure speed against error",
        "Measure on this machine, for lenses of your own: the trace, forward and with gradient, in float32 and float64 "
        "(trace); every PSF model at every sampling against converged kernels, on the axis and at the largest field "
        "(psf, minutes); or a training step of a camera and pictures of 12 megapixels against direct superposition "
        "(camera, minutes).",
        """
        trace
        trace tessar --rays 1000 100000 -o trace.csv --plot trace.png
        psf double_gauss phone -o psf.csv --plot psf.png
        camera double_gauss --sensor 36x24 --json""",
        Option("what", help="subject of the measurement", flag="what", choices=("trace", "psf", "camera")),
        Option("lenses", file_name, "LENS", "one lens, of psf any number (default: trace double_gauss, psf "
            "double_gauss phone, camera cooke_triplet)", flag="lenses", nargs="*"),
        "json",
        Option("rays", count, "N", "trace: numbers of rays (default 1000 10000 100000 1000000)", nargs="+"),
        Option("device", None, "NAME", "trace: device to trace on as well, such as cuda"),
        Option("sensor", extent, "WxH", "camera: width and height in mm, as 24x16 (default: the largest field of the "
            "lens in the corners)"),
        Option("repeats", count, "N", "runs, whose median is reported", default=5),
        Option("threads", count, "N", "threads of torch"),
        TABLE,
        plot("speed over number of rays (trace), or time over error (psf),"),
        "max_bytes", run="bench.command:run",
    ),
    _command(
        "mtf",
        "modulation transfer function",
        "Tangential (of patterns that vary along y) and sagittal (along x) MTF of each field, all wavelengths by their "
        "weights, through frequency or focus.",
        """
        double_gauss --object-distance 25000 --plot mtf.png
        tessar --frequency 10 20 40 --geometric --json
        tessar --frequency 20 --through-focus 0.3 --plot focus.png""",
        *LENS, CONDITIONS, plot("the curves"), TABLE,
        Option("frequencies", positive_finite, "F", "cycles/mm, by default 41 from 0 to the resolution of the sharpest "
            "field, at most half of the diffraction cutoff", flag="--frequency", nargs="+"),
        Option("geometric", help="of rays alone, or always of diffraction; by default of diffraction, except for a "
            "field that would need more than 1280 points across the pupil or a trace of more than 1.5 s, and whose "
            "modulation diffraction is predicted to change by at most 1e-3 at every frequency: that field is "
            "geometric, as by_rays reports", action=argparse.BooleanOptionalAction),
        Option("through_focus", positive_finite, "MM", "move the sensor by ± this, mm, at one frequency"), "fields",
    ),
    _command(
        "ray-fan",
        "ray fans",
        "Transverse ray aberration over the pupil, relative to the chief ray of the primary wavelength.",
        """
        tessar --plot fan.png
        double_gauss --field 0 14 -10,5 --points 21 --json""",
        *LENS, CONDITIONS, plot("the fans"), TABLE,
        "fields", row("points", "rays across the pupil, odd to have the chief ray among them", default=41),
    ),
    _command(
        "opd-fan",
        "OPD fans",
        "Optical path difference in waves over the pupil relative to each wavelength's chief ray, on the reference "
        "sphere of the primary wavelength.",
        """
        tessar --plot opd.png
        double_gauss --object-distance 25000 --reference own --json""",
        *LENS, CONDITIONS, plot("the fans"), TABLE,
        "fields", row("points", "rays across the pupil", default=41),
        Option("reference", help="the sphere, primary: about the point of the primary wavelength for all, so that "
            "lateral colour shows as tilt and axial colour as defocus; own: about each wavelength's own point, which "
            "takes lateral colour out", choices=("primary", "own"), default="primary"),
    ),
    _command(
        "wavefront",
        "wavefront maps, Zernike coefficients, Strehl ratio",
        "RMS and peak-to-valley OPD in waves (peak to valley over 127 points across the pupil) and the Strehl ratio; "
        "with --numbering, --terms or --json also the Zernike coefficients, Noll's in waves RMS or fringe in waves at "
        "the rim.",
        """
        tessar --plot wavefront.png
        double_gauss --field 0 14 --numbering fringe --terms 16
        double_gauss --field 0 --json""",
        *LENS, CONDITIONS, plot("the maps"), TABLE,
        "fields", row("size", "pixels across a map", default=127),
        Option("terms", count, "N", "number of Zernike terms, 37 by default"),
        Option("numbering", help="noll (default) or fringe; the text lists the coefficients where one of them is given",
            choices=("noll", "fringe")),
    ),
    _command(
        "distortion",
        "distortion over the field",
        "Height of the chief ray on the sensor relative to f tan θ and f θ (1 = 100 % in JSON, % in text).",
        """
        phone --plot distortion.png
        double_gauss --field 5 10 14 --json""",
        *LENS, CONDITIONS, plot("the curves"), TABLE,
        "fields", "samples",
    ),
    _command(
        "field-curvature",
        "field curvature",
        "Tangential and sagittal foci of close rays about the chief ray, mm from the sensor.",
        """
        tessar --plot curvature.png
        double_gauss --field 0 10 14 --json""",
        *LENS, CONDITIONS, plot("the curves"), TABLE,
        "fields", "samples",
    ),
    _command(
        "lateral-colour",
        "lateral colour",
        "Height of each wavelength's chief ray on the sensor minus the primary wavelength's.",
        """
        tessar --plot lateral.png
        double_gauss --wavelength 0.5876 0.4861 0.6563 --json""",
        *LENS, CONDITIONS, plot("the curves"), TABLE,
        "fields", "samples",
    ),
    _command(
        "relative-illumination",
        "relative illumination",
        "Illuminance of the sensor relative to the axis, from the solid angle filled by the rays of a uniform object.",
        """
        phone --plot illumination.png
        double_gauss --field 0 10 14 --json""",
        *LENS, CONDITIONS, plot("the curves"), TABLE,
        "fields", "samples",
    ),
    _command(
        "vignetting",
        "vignetting over the field: what cuts the light where",
        "Share of the entrance pupil whose light reaches the sensor over the field, and the share that each surface, "
        "and the vignetting factors of the lens, cut. Semi-diameters clip no ray, only apertures do; --rims takes the "
        "semi-diameters, as `info` prints them, as apertures instead of the vignetting factors.",
        """
        double_gauss_28deg --rims --plot vignetting.png
        hubble --field 0 0.08 --json
        retrofocus --ray-aiming off --rims --samples 6 -o vignetting.csv""",
        *LENS, CONDITIONS, plot("the shares over the field"), TABLE,
        "fields", "samples", RIMS,
    ),
    _command(
        "footprint",
        "beams on a surface with its aperture",
        "Where the beams of all fields and wavelengths meet a surface, in its own axes: extent, centroid, largest "
        "distance from the vertex, the share that the apertures of the surface pass, and the share of the entrance "
        "pupil that reaches the sensor. The figure shows the rims of the beams, and the apertures.",
        """
        double_gauss_28deg 8 --rims --plot footprint.png
        folded_relay 3 --clipped -o footprint.csv
        scan_lens 7 --configuration all --plot footprint.png
        hubble 2 --field 0.08 --wavelength 0.55 --json""",
        "lens", Option("surface", count, "SURFACE", "number of the surface", flag="surface"),
        row("configuration", f"{OPTIONS['configuration'].help}; all: one after the other", reader=count_or_all),
        *LENS[2:], CONDITIONS, plot("the beams and apertures"), TABLE, "fields",
        switch("clipped", "only rays that reach the sensor, not all that reach the surface"), RIMS,
    ),
    _command(
        "seidel",
        "Seidel aberrations by surface",
        "Third-order aberrations S1 to S5 (spherical, coma, astigmatism, Petzval, distortion), C1, C2 (axial, lateral "
        "colour) of every surface and their sums, with y n i of the marginal and chief ray, at the largest field or "
        "those of --field.",
        """
        tessar --plot seidel.png -o seidel.csv
        double_gauss --kind waves --field 10 14 --json""",
        *LENS, CONDITIONS, plot("a bar for each surface"), TABLE,
        "fields",
        Option("kind", help="coefficients: S1 … S5, C1, C2 in mm. waves: W040 = S1/8, W131 = S2/2, W222 = S3/2, W220P "
            "= S4/4, W311 = S5/2, W020 = C1/2, W111 = C2. transverse: mm by which rays of the rim miss the paraxial "
            "image point, the upper one where there is a choice. longitudinal: mm along z from the paraxial focus to "
            "theirs", choices=("coefficients", "waves", "transverse", "longitudinal"), default="coefficients"),
    ),
    _command(
        "longitudinal-aberration",
        "longitudinal aberration",
        "Axial crossing of rays from the axial object point, mm from the sensor, over their height in the pupil.",
        """
        tessar --plot longitudinal.png
        cooke_triplet --wavelength 0.55 --json""",
        *LENS, CONDITIONS, plot("the curves"), TABLE,
        row("points", "rays from the axis to the rim of the pupil", default=41),
    ),
    _command(
        "chromatic-focal-shift",
        "chromatic focal shift",
        "Paraxial focus of each wavelength, mm from that of the primary wavelength.",
        """
        cemented_achromat --plot shift.png
        singlet --wavelength 0.45 0.65 --json""",
        *LENS, CONDITIONS, plot("the curve"), TABLE,
        row("samples", "wavelengths of the curve", default=101),
    ),
    _command(
        "thermal",
        "focus, focal length, spot and MTF over temperature",
        "Focal length, back focal distance, focus shift, RMS spot radius and the lowest MTF of all fields over "
        "temperature, with the sensor fixed in the mount, by default aluminium, and refocused.",
        """
        double_gauss --range -20 60 --mount aluminium --plot thermal.png
        cemented_achromat --mount invar --modulation-frequency 40 --json
        lens.zmx --range -40 85 --samples 6 --mount 12.5 --measure focus rms -o thermal.csv""",
        *LENS, CONDITIONS, plot("focus shift, spot and MTF"), TABLE, "fields",
        Option("temperatures", finite, ("LOW", "HIGH"), "lowest and highest temperature, °C (default -20 60)",
            flag="--range", nargs=2),
        row("samples", "temperatures", default=9),
        Option("measure", str.lower, "WORD", "what is computed besides the focal length: focus, rms, mtf (default: "
            "all; the MTF takes most of the time)", nargs="+", choices=("focus", "rms", "mtf")),
        Option("modulation_frequency", positive_finite, "F", "of the MTF, cycles/mm (default: that of a lowest "
            "modulation of 0.5 in focus at its own temperature)"),
    ),
    _command(
        "depth-of-field",
        "near and far limits of sharpness, hyperfocal distance",
        "Object distances that are sharp with the sensor where it is, the hyperfocal distance and the depth of focus, "
        "by traced rays and by the paraxial formulas. Sharp is a blur (circle of confusion) up to --blur, a modulation "
        "from --modulation at --modulation-frequency, or an RMS wavefront up to --wavefront, by default that of a "
        "quarter wave of defocus. Distances are measured to surface 1; inf: infinity is sharp.",
        """
        double_gauss --blur 0.03 --plot depth.png
        lens.zmx --object-distance 3000 --sensor-distance 52.1 --modulation 0.3 --modulation-frequency 40
        double_gauss --field 0 10 --blur 0.05 --json""",
        *LENS, CONDITIONS, plot("the criterion over the object distance"), TABLE,
        Option("blur", positive_finite, "MM", "largest diameter of the blur"),
        Option("modulation", positive_finite, "M", "least modulation, tangential and sagittal"),
        Option("modulation_frequency", positive_finite, "F", "of the modulation, cycles/mm"),
        Option("wavefront", positive_finite, "WAVES", "largest RMS wavefront (default 0.0722)"),
        row("fields", f"{OPTIONS['fields'].help} (default: the axis)"),
    ),
    _command(
        "distortion-grid",
        "grid distortion",
        "Image of a square grid of object points up to the largest field, compared with its ideal image.",
        """
        phone --plot grid.png --exaggerate 10
        retrofocus --points 5 --json""",
        *LENS, CONDITIONS, plot("the ideal and the real grid"), TABLE,
        Option("plot_exaggerate", positive_finite, "N", "draw the distortion N times as large", flag="--exaggerate",
            default=1.0),
        row("points", "points across the grid", default=11),
    ),
    _command(
        "incidence",
        "angles of incidence",
        "Angles of incidence of the chief and marginal rays of each field on the sensor, or on every surface, degrees.",
        """
        phone --plot incidence.png
        double_gauss --field 0 14 --surfaces --json""",
        *LENS, CONDITIONS, plot("the curves"), TABLE,
        "fields", "samples", switch("surfaces", "list every surface in the text, not only the sensor"),
    ),
    _command(
        "intercepts",
        "named rays at every surface, and their largest heights and angles",
        "Where the chief ray and the rays on the rim of the beam of each field meet every surface: the largest height "
        "and angles of incidence and refraction at each surface over all fields and rays, at the primary wavelength or "
        "those of --wavelength, with the field and the ray; --each, --json and -o also list every ray: point, "
        "direction cosines behind the surface and angles, in the axes of each surface.",
        """
        double_gauss --plot angles.png
        phone --field 0 20 37 --wavelength 0.4861 0.6563 -o rays.csv
        spectrometer --rays chief --each""",
        *LENS, CONDITIONS, plot("the largest angles by surface"), TABLE, "fields",
        Option("rays", None, "NAME", "chief, upper and lower (on the rim of the beam along the direction of the "
            "field), right and left (across it); default all", nargs="+", default=""),
        switch("each", "list every ray in the text"),
    ),
    _command(
        "sag",
        "sag table of a surface, best-fit sphere, aspheric departure",
        "Sag and slope of a surface over the radius, and its departure from the vertex sphere and from the best-fit "
        "sphere, with the radius of that sphere and the largest and RMS departure over the aperture.",
        """
        phone 3 --step 0.1
        double_gauss 1 --best-fit rim --plot sag.png -o sag.csv
        cylinder_pair 1 --azimuth 0 --json""",
        "lens", Option("surface", count, "SURFACE", "number of the surface", flag="surface"),
        *LENS[1:], CONDITIONS, plot("sag, slope and departures"), TABLE,
        Option("step", positive_finite, "MM", "of the radius (default: a round tenth of the semi-diameter)"),
        Option("semi_diameter", positive_finite, "MM", "of the aperture (default: the surface's own, or that of the "
            "rays of all fields)"),
        Option("best_fit", help="sphere through the vertex by least squares of the sag over the aperture (rms), also "
            "shifted along z (offset), or through vertex and rim (rim)", choices=("rms", "offset", "rim"),
            default="rms"),
        Option("azimuth", finite, "DEGREES", "of the direction, from x, of surfaces that are not round", default=90.0),
    ),
    _command(
        "rms-over-field",
        "RMS wavefront or spot over the field",
        "RMS wavefront error in waves over the field, of each wavelength and of all together by their weights, with "
        "the Strehl ratio exp(-(2π σ)²); or the RMS spot radius.",
        """
        tessar --plot rms.png
        double_gauss --spot --field 0 10 14 --json""",
        *LENS, CONDITIONS, plot("the curves"), TABLE,
        "fields", "samples", switch("spot", "RMS spot radius about the centroid instead"),
        Option("reference", help="centres of the reference spheres of the wavelengths together, the primary one's "
            "chief ray, so that lateral colour counts, or each one's own", choices=("primary", "own"),
            default="primary"),
    ),
    _command(
        "encircled-energy",
        "encircled energy",
        "Fraction of the light within a radius about the centroid of the rays, by diffraction or geometrically; or "
        "within a square (ensquared energy), a rectangle or a slit.",
        """
        tessar --plot encircled.png
        double_gauss --geometric --radius 0.005 0.01 0.02 --json
        double_gauss --shape square --half-width 0.0025 0.005
        double_gauss --shape x --plot slit.png""",
        *LENS, CONDITIONS, plot("the curves"), TABLE,
        Option("radii", positive_finite, "MM", "about the centroid of the rays, mm, by default from 0 to almost all of "
            "the light; of other shapes than the circle, half-widths", flag="--radius --half-width", nargs="+"),
        Option("shape", help="circle (default), square, rectangle, or a slit: x or y, within the half-width along that "
            "axis, unlimited along the other", choices=("circle", "square", "rectangle", "x", "y"), default="circle"),
        Option("aspect", positive_finite, "A", "height over width of the rectangle: half-widths a along x and A·a "
            "along y"),
        switch("geometric", "of rays alone, without diffraction"), "fields",
    ),
    _command(
        "tolerance",
        "the lens as built: sensitivities, expectation and Monte Carlo",
        "Change of a criterion (RMS spot radius or wavefront, MTF, merit, …) by every tolerance at its limits, "
        "its mean of the lens as built by second derivatives, and its distribution over perturbed and compensated "
        "lenses. The tolerances are those of the file (TRAD, TTHI, TETX …), of a grade, or of --limits; the "
        "compensators are those of the file (COMP, CPAR), or the sensor distance if its tolerances are not used. All "
        "configurations are judged together. TSTX, TIRX and a wedge tilt a surface rigidly "
        "about its vertex; TEZI, TEXI and TSDR move all their terms at once.",
        """
        cooke_triplet --grade precision --plot as_built.png
        lens.zmx --trials 10000 --checkpoint trials.jsonl -o sensitivities.csv
        double_gauss --grade commercial --save-trials built
        cooke_triplet --grade precision --radial --goal 23.5 --yield 0.9 --save-lens toleranced.zmx
        tessar --limits "radius=0.1% thickness=0.02 element_tilt=0.05" --criterion wavefront --trials 0
        cooke_triplet --grade high --criterion mtf@10 --trials 200""",
        *LENS, CONDITIONS, plot("histogram, yield and the tolerances that count most"), TABLE,
        Option("save_trials", folder_name, "FOLDER", "write the lenses of the typical, the worst and the best trial "
            "there, as .zmx files"),
        Option("save_lens", file_of(".zmx"), "FILE", "lens file (.zmx) to write with these tolerances, tightened ones "
            "as they are proposed, and with the compensators: of draw, report and further studies"),
        row("grade", "tolerances of a published grade instead of the file's"),
        row("limits", "words and kinds with their limits ±, radius=0.1% thickness=0.02 element_tilt=0.05; they replace "
            "those of the file or the grade, and index=0 leaves one out; element_decenter_radial=0.02 is the magnitude "
            "of a decentre in a random direction", default=""),
        "radial",
        Option("criterion", help="rms, the RMS spot radius in µm over fields and wavelengths by their "
            "weights, each field about the centroid of its light, of an afocal lens that of angle, the RMS angle in "
            "mrad of the rays; wavefront, the RMS wavefront in waves less mean and tilt; mtf@30, the MTF of "
            "diffraction at 30 cycles/mm, mean of tangential and sagittal over the fields; psf, the change of the "
            "PSFs, √(Σ(h - h₀)²/Σh₀²) with h₀ of the nominal lens, mean square over the fields, in windows about the "
            "chief ray; boresight, the distance in µm by which the chief ray of the axial field misses its nominal "
            "place on the sensor; merit, a merit function", default="rms"),
        Option("trials", count_or_none, "N", "number of perturbed and compensated lenses, 0 for none", default=1000),
        row("seed", "seed of random numbers"),
        Option("increment", positive_finite, "CHANGE", "inverse sensitivity: limits are tightened until no error "
            "alone, at a limit, makes the criterion worse by more than this, in its unit"),
        Option("goal", criterion_value, "VALUE", "value of the criterion that a good lens reaches, in its unit; alone "
            "it reports the share of good lenses (yield), with --yield it tightens the limits"),
        Option("yield_", positive_finite, "SHARE", "a share of the lenses, 0.9 by default, whose criterion is "
            "reported; with --goal, limits are tightened at least cost until this share reaches the goal, by second "
            "order corrected by traced lenses", flag="--yield"),
        Option("workshop", str.lower, "GRADE", "commercial, precision, high (default) or any: the grade whose figures "
            "are the finest limits that --increment and --yield propose, in steps and alike along x and y; any: exact "
            "limits of any size", choices=("commercial", "precision", "high", "any"), default="high"),
        Option("costs", None, "KIND=WEIGHT", "weights of the costs of tolerances, which are inverse to their limits "
            "and 1 at the finest of the workshop: element_decenter=3 index=0.5", nargs="+", default=""),
        switch("hold", "compensators ignore the conditions of the lens; by default they stay within those on the "
            "thickness, or edge, that they adjust, as air_thickness>=1 (MNCA) and bfd>=30", flag="--no-hold",
            default=True),
        "fields", row("rings", "rings of the pupil (default 4)"),
        Option("arms", count, "N", "of the pupil, 4·rings by default"),
        Option("light_loss", positive_finite, "SHARE", "share of the light of the nominal lens that a lens may lose; "
            "a lens that loses more has failed", default=0.05),
        Option("model", str.lower, "MODEL", "PSFs of psf: gaussian (default), smooth in the errors, or drt",
            choices=("gaussian", "drt"), default="gaussian"),
        row("pixel", "pixel pitch of psf (default 0.005)"),
        row("size", "pixels across the windows of psf (default 21)"),
        Option("checkpoint", data_file, "FILE", "a file (.jsonl) of finished trials, from which an interrupted study "
            "resumes"),
        run="cli.runs:tolerance",
    ),
    _of_module("codesign", codesign, "cli.codesign_run:run"),
    Command(
        "stock",
        "lenses of vendors: an index, and parts by their figures",
        "An index of the lenses that vendors stock, of their lens files, and its parts by focal length, diameter,\n"
        "shape and glass. `raytrace edit --insert-part` puts a part into a lens, `raytrace optimize --stock` builds a\n"
        "lens of parts. "
        "`raytrace stock SUB --help` shows examples.",
        """examples:
  raytrace stock index vendors/thorlabs
  raytrace stock find --efl 50 --diameter 25.4 --achromat
  raytrace stock find stock.sqlite --efl 95..105 --json""",
        (),
        subcommands=STOCK_COMMANDS,
    ),
    Command(
        "wave",
        "phase elements: PSFs, design, restoration",
        "Wave optics of a thin phase element in front of a sensor: point spread functions (PSFs) over depth and\n"
        "wavelength, design of the element together with a restoration filter, and restored images.\n"
        "`raytrace wave SUB --help` shows examples.",
        """examples:
  raytrace wave psf --element singlet --focus 1000 --depth 500 1000 inf -o psf.npz --plot psf.png
  raytrace wave psf --element fresnel --wavelength 0.46 0.55 0.64 --json
  raytrace wave design --element smooth --starts 2 -o run --plot element.png
  raytrace wave restore scene.png --element run/heights.npy --simulate 500 -o simulated""",
        (),
        subcommands=WAVE_COMMANDS,
    ),
)  # fmt: skip
