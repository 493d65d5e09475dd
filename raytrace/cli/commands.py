"""The commands of `raytrace`: a row each, with summary, description, examples and options. Imports no torch.

A command calls the function of the public API that has its name. An option's destination is the name of that function's
parameter. A new command is a new row. Commands that do more than call the function once have a function `run`.
"""

import argparse
import importlib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import ModuleType

from raytrace import PUBLIC
from raytrace.cli import codesign, wave_design, wave_restore
from raytrace.cli.options import (
    AS_BUILT,
    FREEDOM,
    LENS_SUFFIXES,
    MERIT,
    PUPIL,
    Adder,
    aperture,
    catalog,
    conditions,
    exclusive,
    group,
    json,
    lens,
    log,
    max_bytes,
    object_distance,
    option,
    output,
    output_folder,
    parameters,
    plot,
    row,
)
from raytrace.cli.types import (
    Names,
    count,
    count_or_none,
    data_file,
    extent,
    file_name,
    file_of,
    finite,
    folder_name,
    many,
    not_negative,
    picture_file,
    picture_or_folder,
    positive_finite,
)
from raytrace.cli.wave_options import camera, element, engine, light, pixels

#: -o of an analysis: `Result.save`.
table = output("table to write (.csv), or the document of --json (.json)", (".csv", ".json"))


@dataclass(frozen=True)
class Command:
    """One command.

    examples: the last part of its help page; options: functions that add options to a parser; rows: settings of
    `add_argument` of the remaining options, the parameters of the public function `verb`; run: returns the result,
    where it is more than a call of that function with a lens.
    """

    name: str
    summary: str
    description: str
    examples: str
    options: tuple[Adder, ...]
    run: Callable[[argparse.Namespace], object] | None = None
    rows: Mapping[str, Mapping] = field(default_factory=dict)

    @property
    def verb(self) -> str:
        """Name of the public function."""
        return self.name.replace("-", "_")

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        for add in self.options:
            add(parser)
        if self.verb in PUBLIC:
            parameters(self.verb, **self.rows)(parser)

    def add_to(self, commands, name: str = "", *, with_options: bool = True) -> None:
        """Add the parser of this command to a group of parsers, under its own name or another."""
        parser = commands.add_parser(
            name or self.name,
            help=self.summary,
            description=self.description,
            epilog=self.examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if not with_options:
            return
        self.add_arguments(parser)
        max_bytes(parser)
        spelled = {action.dest: action.option_strings[-1] for action in parser._actions if action.option_strings}
        parser.set_defaults(run=self, spelled=spelled)


def _command(name: str, summary: str, description: str, examples: str, /, *options: Adder, run=None, **rows) -> Command:
    """A row; examples: one a line, without `raytrace NAME`; rows: as for `Command`, or the help text alone."""
    start = f"  raytrace {name.replace('wave-', 'wave ')} "
    text = "\n".join(["examples:", *(start + line.strip() for line in examples.strip().splitlines())])
    rows = {name: {"help": row} if isinstance(row, str) else row for name, row in rows.items()}
    return Command(name, summary, description, text, options, run, rows)


def _of_module(name: str, module: ModuleType, run: Callable) -> Command:
    return Command(name, module.SUMMARY, module.DESCRIPTION, module.EXAMPLES, (module.options,), run)


# -- commands that do more than call their function once


def _with_catalogs(arguments: argparse.Namespace, **paths: Path):
    """The result of a function that takes catalogs, and no lens."""
    import raytrace
    from raytrace.cli.run import catalogs, options_of

    options = options_of(arguments) | paths | {"catalogs": catalogs(arguments)}
    return getattr(raytrace, arguments.run.verb)(**options)


def _check(arguments: argparse.Namespace):
    from raytrace.cli.run import find_lens

    return _with_catalogs(arguments, path=find_lens(arguments.lens))


def _convert(arguments: argparse.Namespace):
    from raytrace.cli.run import find_lens

    return _with_catalogs(arguments, source=find_lens(arguments.source))


def _tolerance(arguments: argparse.Namespace):
    from raytrace.cli.run import CommandError, catalogs, printed_on_failure, result_of_lens, say
    from raytrace.shards import share

    folder = arguments.save_trials
    if folder and arguments.trials == 0:
        raise CommandError(f"--save-trials {folder}: there are no trials; leave --trials 0 out")
    result = result_of_lens(arguments)
    if folder and not share().rank:
        folder = f"{folder}{getattr(arguments, 'suffix', '')}"
        with printed_on_failure(result, arguments):
            result.save_trials(folder, catalogs=catalogs(arguments))
        say(f"written: typical.zmx, worst.zmx and best.zmx in {folder}")
    return result


def _bench(arguments: argparse.Namespace):
    # Benchmarks are a layer above the commands, so the import is dynamic.
    return importlib.import_module("raytrace.bench.command").run(arguments)


def _layout(arguments: argparse.Namespace):
    from raytrace.cli.run import result_of_lens

    arguments.plot = arguments.plot or f"{Path(arguments.lens).stem}_layout{arguments.suffix}.png"
    return result_of_lens(arguments)


def _spot(arguments: argparse.Namespace):
    from raytrace.cli.run import CommandError, result_of_lens

    for flag, path in (("--plot", arguments.plot), ("-o", arguments.output)):
        if path and arguments.rays:
            raise CommandError(f"{flag} needs the rays, and --rays keeps none: leave one out")
    return result_of_lens(arguments)


def _focus(arguments: argparse.Namespace):
    """The focus; -o writes the lens of the file with the new sensor distance, without the conditions of the options."""
    from raytrace.cli.run import catalogs, find_lens, printed_on_failure, result_of_lens, say
    from raytrace.io import read_lens, write_lens
    from raytrace.system.lens import with_sensor_distance

    focus = result_of_lens(arguments)
    if arguments.output:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # shown when the file was first read
            original = read_lens(
                find_lens(arguments.lens),
                catalogs=catalogs(arguments),
                substitute=arguments.substitute,
                configuration=arguments.configuration,
            )
        with printed_on_failure(focus, arguments):
            write_lens(with_sensor_distance(original, focus.sensor_distance), arguments.output)
        say(f"written: {arguments.output}")
        arguments.output = None
    return focus


def _trace(arguments: argparse.Namespace) -> None:
    """The table of rays, written as it is computed and not kept in memory."""
    import sys

    from raytrace.cli.progress import Lines, progress
    from raytrace.cli.run import print_json, result_of_lens, say

    listing = result_of_lens(arguments)
    if arguments.output:
        with progress(listing.count, "ray", what="trace") as bar:
            listing.save(arguments.output, bar.update)
        if arguments.json:
            print_json({"rays": listing.count, "output": arguments.output, "lost": listing.lost()})
        else:
            say(f"{listing.count} rays written to {arguments.output}")
    elif arguments.json:
        listing.write_json(sys.stdout.write)
    else:
        with Lines(listing.count, "ray", what="trace") as lines:  # no bar: the terminal may show the rays
            listing.write(sys.stdout.write, lines.update)
    for line in listing.failures():
        say(line)


_WAVE_FIGURES = {
    "heights": "the height of the element, as a disc and as a profile,",
    "caustic": "the light behind the element, over distance and radius,",
    "encircled": "the fraction of the light within a radius",
}


def _view(arguments: argparse.Namespace) -> None:
    """The viewer until Ctrl-C."""
    from raytrace.cli.progress import silence
    from raytrace.cli.run import CommandError, find_lens, open_lens
    from raytrace.viewer.server import MissingExtra, serve

    path = find_lens(arguments.lens)
    silence()
    file = path if Path(arguments.lens).exists() else Path(path.name)
    try:
        serve(open_lens(arguments), file=file, port=arguments.port, browser=arguments.browser, as_json=arguments.json)
    except MissingExtra as error:
        raise CommandError(str(error)) from error


def _wave_psf(arguments: argparse.Namespace):
    import raytrace
    from raytrace.cli.run import catalogs, options_of, printed_on_failure, say

    options = options_of(arguments) | {"catalog": catalogs(arguments)}
    psf = raytrace.wave_psf(**options)
    for name in _WAVE_FIGURES:
        if path := vars(arguments).pop(f"plot_{name}"):
            with printed_on_failure(psf, arguments):
                psf.plot(path, what=name, progress=options["progress"])
            say(f"written: {path}")
    return psf


def _codesign(arguments: argparse.Namespace):
    from raytrace.cli.codesign_run import run

    return run(arguments)


def _render(arguments: argparse.Namespace):
    from raytrace.cli.render_run import render_files

    return render_files(arguments)


def _wave_design(arguments: argparse.Namespace):
    from raytrace.cli.wave_run import design

    return design(arguments)


def _wave_restore(arguments: argparse.Namespace):
    from raytrace.cli.wave_run import restore_files

    return restore_files(arguments)


def _mosaics():
    from raytrace.imaging.sensor import PATTERNS

    return ("none", *PATTERNS)


def _psf_models():
    from raytrace.psf_models import MODELS

    return MODELS


# -- the table

_FILE = {"metavar": "FILE", "type": data_file}

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
        element, camera(), light(), pixels(), engine, json,
        output(
            "arrays to write (.npz): psf[depth, wavelength, y, x], pixel_pitch, energy, depths, wavelengths, engine, "
            "error", (".npz",),
        ),
        plot("the kernels"),
        group("more figures", *(
            plot(what, flag=f"--{name}", dest=f"plot_{name}") for name, what in _WAVE_FIGURES.items()
        )),
        run=_wave_psf,
    ),
    _of_module("wave-design", wave_design, _wave_design),
    _of_module("wave-restore", wave_restore, _wave_restore),
)  # fmt: skip


def _subcommands(parser: argparse.ArgumentParser) -> None:
    children = parser.add_subparsers(dest="subcommand", metavar="SUB", required=True)
    for command in WAVE_COMMANDS:
        command.add_to(children, command.name.removeprefix("wave-"))


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
        lens, conditions, table,
    ),
    _command(
        "check",
        "import report of a lens file",
        "Print the import report: every keyword read, ignored (with the reason) or unknown, and the catalog of each "
        "glass. Fails if the file cannot be read; with --strict also if anything was assumed.",
        """
        lens.zmx
        lens.zmx --strict --json""",
        lens, run=_check,
    ),
    _command(
        "convert",
        "write a lens in another format",
        "Read a lens file and write it in the format of the suffix of OUT. Numbers are kept bit for bit.",
        """
        lenses/double_gauss.zmx double_gauss.csv
        table.txt lens.zmx
        lens.zmx lens.seq""",
        catalog, json, run=_convert,
        source={
            "flags": ("source",), "metavar": "IN", "type": file_name,
            "help": "lens file, or the name of a shipped lens",
        },
        target={
            "flags": ("target",), "metavar": "OUT", "type": file_of(LENS_SUFFIXES),
            "help": "lens file to write: .zmx, .seq, .csv, .tsv, .txt",
        },
        strict="fail on anything unknown or assumed in IN",
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
        partial(lens, all_configurations="in one figure, superimposed"), conditions,
        plot("the cross section (default LENS_layout.png in this folder)"), run=_layout,
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
        lens, conditions, plot("the spot diagram"),
        output("table of the rays to write (.csv): field, wavelength, pupil point, x, y, weight, status", (".csv", "")),
        run=_spot, rays={"type": many},
        max_bytes="memory limit, as 200MB (default with --rays 256MB, else half of the free memory)",
        **PUPIL,
    ),
    _command(
        "focus",
        "find the best sensor distance",
        "Find the sensor distance of minimum RMS spot radius in closed form, without retracing; by default on the axis "
        "at the primary wavelength.",
        """
        lenses/double_gauss.zmx --object-distance 25000 --plot focus.png
        lens.zmx --object-distance 10000 25000 50000 --field 0 10 14 -o focused.zmx""",
        lens, partial(conditions, several="several are focused together"),
        plot("the through-focus curve, the spots before and after, and the layout"),
        option(
            "--by", dest="plot_by", choices=("field", "wavelength"),
            help="draw only the through-focus curves, one for each field, or for each wavelength of the first field",
        ),
        output("lens file to write with the new sensor distance"), run=_focus, **PUPIL,
    ),
    _command(
        "optimize",
        "minimise the merit function of a lens",
        "Optimise a lens by damped least squares on exact derivatives of its merit function: the file's, or the one of "
        "--merit. Solves and pickups hold at every step. --as-built adds the expected spot of the manufactured lens, "
        "which makes the lens less sensitive to its tolerances. -o writes the lens with its variables and merit "
        "function. "
        "Ctrl-C stops and writes the best lens so far.",
        """
        lens.zmx -o better.zmx --plot better.png
        double_gauss --merit spot --vary curvature thickness --seconds 10 -o better.zmx
        tessar --merit spot --vary curvature sensor thickness:2,4 --bounds thickness:1.. --hold efl=100
        tessar --merit spot --vary curvature sensor glass --hold efl=100 --catalog SCHOTT -o better.zmx
        double_gauss --merit spot --vary curvature thickness --hold efl=99.5 --as-built --grade precision -o robust.zmx
        lens.zmx --cycles 50 --checkpoint best.json --log cycles.csv
        lens.zmx --cycles 100 --resume best.json --checkpoint best.json -o better.zmx""",
        lens, row("ray_aiming"), *MERIT, FREEDOM, AS_BUILT,
        group("stopping", parameters(
            "optimize", "cycles", "seconds", "paths",
            cycles={"help": "maximum, including those before --resume (default 500)"},
            paths={"help": "damping strategies to try"},
        )),
        group("files", parameters(
            "optimize", "log", "checkpoint", "resume",
            log={**_FILE, "help": "write a line for every cycle (.csv)"},
            checkpoint={**_FILE, "help": "store the state of the search there (.json)"},
            resume={
                "metavar": "FILE", "type": file_name,
                "help": "resume from a checkpoint of the same lens, variables and merit function",
            },
        )),
        plot("the lens, its spots and its merit function, before and after"), output("lens file to write"),
    ),
    _command(
        "search",
        "find the minima of a merit function globally, within bounds",
        "Find the distinct minima of a merit function, the file's or the one of --merit, within the bounds of the "
        "variables. Evenly distributed starts (plane plates suffice) are scaled to the focal length, focused and "
        "optimised; the best are converged, and the search hops on from the best minima. --insert instead adds an "
        "element: a thin meniscus at a surface is a saddle point that leads to new minima. --as-built orders the "
        "minima by the merit with the expected spot of the manufactured lens, and lists both. -o stores every minimum "
        "as a lens file, a table, figures and the state of the search: the same command resumes there bit-identically. "
        "Ctrl-C stops and keeps the minima found. Processes share the work: "
        "torchrun --nproc-per-node 2 -m raytrace search …",
        """
        lens.zmx --starts 200 --seconds 60 -o minima
        cooke_triplet --merit spot --vary curvature thickness --hold efl=100 --edge 1 --seconds 20 -o minima
        cooke_triplet --merit spot --vary curvature sensor --hold efl=100 --starts 32 --as-built --grade precision
        triplet.zmx --insert 2 4 -o four_elements
        singlet --merit spot --vary curvature sensor --starts 8 --plot minima.png""",
        lens, row("ray_aiming"), *MERIT, FREEDOM, AS_BUILT,
        group("extent", parameters(
            "search", "starts", "insert", "seconds", "seed",
            starts={"help": "initial designs (default 64)"},
            insert={
                "metavar": "SURFACE", "type": count, "nargs": "*", "action": None,
                "help": "instead of starts: insert a thin meniscus at every surface, or at these",
            },
            seed={"help": "of starts and hops"},
        )),
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
        lens, conditions, *MERIT, plot("the contributions to the merit, by operand and field"), table,
        each="list every row, also the rays of one field",
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
        lens,
        conditions,
        option("--vary", metavar="WHAT", nargs="+", help="variables, pickups and solves (default: the file's)"),
        option(
            "--of",
            metavar="QUANTITY",
            choices=("landing points", "directions", "paths", "merit"),
            help="'landing points' (default), directions, paths or merit",
        ),
        option("--merit", metavar="KIND", help="of --of merit: spot, wavefront or angular (default: the file's)"),
        table,
        grade={"help": "errors of manufacture by the tolerances of a published grade, as of `tolerance`"},
        limits={"metavar": "NAME=LIMIT", "help": "errors by kind and limit, as of `tolerance`"},
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
        lens,
        conditions,
        option("--port", metavar="N", type=count, default=0, help="port of the server (default: a free one)"),
        option("--no-browser", dest="browser", action="store_false", help="print the address, open no browser"),
        run=_view,
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
        lens, output("table to write (.csv); default: standard output", (".csv", ".txt", "")),
        partial(conditions, several="rays from each"), run=_trace,
        rays={
            "metavar": "CSV", "type": file_name,
            "help": "rays to trace: columns x,y,z,l,m,n in the frame of surface 1, optional wavelength; by default the "
            "chief and marginal rays of every field",
        },
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
        double_gauss --model drt --rays 1e8 --max-bytes 200MB -o psf.npz""",
        lens, partial(conditions, several="one row of kernels each"),
        option(
            "--rho", metavar="R", type=positive_finite,
            help="of the paraxial model: σ over the radius of the blur (default 0.5, the second moment of a uniform "
            "disc)",
        ),
        exclusive(
            parameters("psf", "tol", tol={"help": "bound on the estimated error (default 0.01)"}),
            option(
                "--rays", metavar="N", type=many,
                help="rays per kernel instead of a tolerance; with --model drt and --max-bytes any number of them",
            ),
        ),
        output(
            "arrays to write (.npz): psf[distance, field, y, x], or [distance, field, wavelength, y, x], pixel_pitch, "
            "energy, error, wavelengths, model", (".npz",),
        ),
        plot("the kernels, finely in windows that they fill (with --pixel or --size: the pixels),"), log,
        pixel="pixel pitch (default 0.005)",
        size="pixels across the window of the PSF (default 21)",
        center="centre of the window: the chief ray (default), the optical axis or the centroid of the rays",
        per_wavelength="a kernel for each wavelength instead of their weighted sum",
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
        lens,
        option("picture", metavar="PICTURE", type=file_name, nargs="+", help="pictures to render, sRGB levels"),
        partial(conditions, several="one result after the other, in files named by the distance"),
        option("-o", "--output", metavar="OUT", type=picture_or_folder,
            help="picture to write: .png, sRGB; .tif or .npy, light; of several pictures a folder of .png files"),
        option("--png-bits", metavar="N", type=int, choices=(8, 16), default=8, help="of a .png file (default 8)"),
        option("--raw", action="store_true", help="write the mosaic that the sensor records (.tif, .npy)"),
        option("--compare", "--plot", dest="plot", metavar="FILE", type=picture_file,
            help="save the pictures of an ideal lens and of this one, whole and in detail, as .png, .pdf or .svg"),
        group(
            "the sensor",
            option("--sensor", metavar="WxH", type=extent,
                help="width and height in mm, as 24x16 (default: the largest field of the lens in the corners)"),
            option("--offset", metavar=("X", "Y"), type=finite, nargs=2,
                help="of its centre from the optical axis, mm (default 0 0)"),
            option("--response", metavar="NAME",
                help="rgb, grey, a table wavelength_nm,r,g,b (.csv), or a measured camera: 'Nikon 5100 (NPL)', 'Sigma "
                "SDMerill (NPL)' (default rgb of coloured pictures, grey of grey ones)"),
            option("--mosaic", choices=Names(_mosaics), metavar="PATTERN",
                help="Bayer pattern: RGGB, BGGR, GRBG or GBRG (default none)"),
            option("--full-well", metavar="E", type=positive_finite, help="electrons of white: adds shot noise"),
            option("--read-noise", metavar="E", type=not_negative,
                help="standard deviation in electrons; without --full-well a fraction of white"),
            option("--bits", metavar="N", type=count, help="bits of the quantisation, before those of the file"),
            option("--black-level", metavar="E", type=not_negative,
                help="offset of the quantisation, unit of --read-noise (default five times that)"),
            row("seed", default=0, help="of the noise, which differs from picture to picture"),
        ),
        group(
            "depth",
            option("--depth", metavar="MAP", type=file_name,
                help="distance of every pixel from surface 1: an array of mm (.npy), or a grey picture, dark is near"),
            option("--depth-range", metavar=("NEAR", "FAR"), type=positive_finite, nargs=2,
                help="mm of black and of white of the picture MAP, linear between them"),
            option("--background", metavar="PICTURE", type=file_name,
                help="the scene behind the objects, without them (default: it continues as around them)"),
            parameters("render", "planes", planes={
                "help": "layers, at equally spaced reciprocal distances; near ones cover far ones",
            }),
        ),
        group("left out", parameters(
            "render", "distortion", "lateral_colour", "illumination",
            distortion={"help": "no distortion: the image of an ideal lens, blurred"},
            lateral_colour={"help": "no lateral colour: the kernels of all wavelengths are centred on one chief ray"},
            illumination={"help": "no relative illumination: as bright in the corners as on the axis"},
        )),
        run=_render,
        model={"choices": Names(_psf_models),
            "help": "of the PSF: paraxial, fourier, gaussian, drt or wave, in order of fidelity (default: the first of "
            "the last three that differs from the next by less than --tol)"},
        tol="bound on the estimated error of the kernels, of the light of a point",
        boundary={"choices": ("reflect", "zero"),
            "help": "the scene beyond the edge of the picture: reflect, its mirror image, or zero, black"},
    ),
    _command(
        "compare",
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
        lens,
        group(
            "conditions other than the file's",
            object_distance("the columns (default 10000 20000 30000 40000 50000)"),
            aperture, row("wavelengths"), row("ray_aiming"),
        ),
        plot("the grid of kernels"), log,
        focus_distance="object in focus", pixel="pixel pitch (default 0.005)",
        size="pixels across the windows (default 21)",
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
        catalog, json, run=_with_catalogs,
        name={
            "flags": ("name",), "metavar": "NAME",
            "help": "name of a glass, as in a lens file, or a six-digit MIL code",
        },
        wavelengths="wavelengths in µm (default: F d C)",
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
        option("what", choices=("trace", "psf", "camera"), help="subject of the measurement"),
        option(
            "lenses",
            metavar="LENS",
            type=file_name,
            nargs="*",
            help="one lens, of psf any number (default: trace double_gauss, psf double_gauss phone, camera "
            "cooke_triplet)",
        ),
        json,
        option(
            "--rays",
            metavar="N",
            type=count,
            nargs="+",
            help="trace: numbers of rays (default 1000 10000 100000 1000000)",
        ),
        option("--device", metavar="NAME", help="trace: device to trace on as well, such as cuda"),
        option("--sensor", metavar="WxH", type=extent,
            help="camera: width and height in mm, as 24x16 (default: the largest field of the lens in the corners)"),
        option("--repeats", metavar="N", type=count, default=5, help="runs, whose median is reported"),
        option("--threads", metavar="N", type=count, help="threads of torch"),
        table,
        plot("speed over number of rays (trace), or time over error (psf),"),
        run=_bench,
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
        lens, conditions, plot("the curves"), table,
    ),
    _command(
        "ray-fan",
        "ray fans",
        "Transverse ray aberration over the pupil, relative to the chief ray of the primary wavelength.",
        """
        tessar --plot fan.png
        double_gauss --field 0 14 -10,5 --points 21 --json""",
        lens, conditions, plot("the fans"), table,
    ),
    _command(
        "opd-fan",
        "OPD fans",
        "Optical path difference in waves over the pupil relative to each wavelength's chief ray, on the reference "
        "sphere of the primary wavelength.",
        """
        tessar --plot opd.png
        double_gauss --object-distance 25000 --reference own --json""",
        lens, conditions, plot("the fans"), table,
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
        lens, conditions, plot("the maps"), table,
    ),
    _command(
        "distortion",
        "distortion over the field",
        "Height of the chief ray on the sensor relative to f tan θ and f θ (1 = 100 % in JSON, % in text).",
        """
        phone --plot distortion.png
        double_gauss --field 5 10 14 --json""",
        lens, conditions, plot("the curves"), table,
    ),
    _command(
        "field-curvature",
        "field curvature",
        "Tangential and sagittal foci of close rays about the chief ray, mm from the sensor.",
        """
        tessar --plot curvature.png
        double_gauss --field 0 10 14 --json""",
        lens, conditions, plot("the curves"), table,
    ),
    _command(
        "lateral-colour",
        "lateral colour",
        "Height of each wavelength's chief ray on the sensor minus the primary wavelength's.",
        """
        tessar --plot lateral.png
        double_gauss --wavelength 0.5876 0.4861 0.6563 --json""",
        lens, conditions, plot("the curves"), table,
    ),
    _command(
        "relative-illumination",
        "relative illumination",
        "Illuminance of the sensor relative to the axis, from the solid angle filled by the rays of a uniform object.",
        """
        phone --plot illumination.png
        double_gauss --field 0 10 14 --json""",
        lens, conditions, plot("the curves"), table,
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
        lens, conditions, plot("a bar for each surface"), table,
    ),
    _command(
        "longitudinal-aberration",
        "longitudinal aberration",
        "Axial crossing of rays from the axial object point, mm from the sensor, over their height in the pupil.",
        """
        tessar --plot longitudinal.png
        cooke_triplet --wavelength 0.55 --json""",
        lens, conditions, plot("the curves"), table,
    ),
    _command(
        "chromatic-focal-shift",
        "chromatic focal shift",
        "Paraxial focus of each wavelength, mm from that of the primary wavelength.",
        """
        cemented_achromat --plot shift.png
        singlet --wavelength 0.45 0.65 --json""",
        lens, conditions, plot("the curve"), table, samples="wavelengths of the curve",
    ),
    _command(
        "distortion-grid",
        "grid distortion",
        "Image of a square grid of object points up to the largest field, compared with its ideal image.",
        """
        phone --plot grid.png --exaggerate 10
        retrofocus --points 5 --json""",
        lens, conditions, plot("the ideal and the real grid"), table,
        option(
            "--exaggerate", dest="plot_exaggerate", metavar="N", type=positive_finite, default=1.0,
            help="draw the distortion N times as large",
        ),
        points="points across the grid",
    ),
    _command(
        "incidence",
        "angles of incidence",
        "Angles of incidence of the chief and marginal rays of each field on the sensor, or on every surface, degrees.",
        """
        phone --plot incidence.png
        double_gauss --field 0 14 --surfaces --json""",
        lens, conditions, plot("the curves"), table,
    ),
    _command(
        "rms-over-field",
        "RMS wavefront or spot over the field",
        "RMS wavefront error in waves over the field, of each wavelength and of all together by their weights, with "
        "the Strehl ratio exp(-(2π σ)²); or the RMS spot radius.",
        """
        tessar --plot rms.png
        double_gauss --spot --field 0 10 14 --json""",
        lens, conditions, plot("the curves"), table,
    ),
    _command(
        "encircled-energy",
        "encircled energy",
        "Fraction of the light within a radius about the centroid of the rays, by diffraction or geometrically.",
        """
        tessar --plot encircled.png
        double_gauss --geometric --radius 0.005 0.01 0.02 --json""",
        lens, conditions, plot("the curves"), table,
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
        tessar --limits "radius=0.1% thickness=0.02 element_tilt=0.05" --criterion wavefront --trials 0
        cooke_triplet --grade high --criterion mtf@10 --trials 200""",
        lens, conditions, plot("histogram, yield and the tolerances that count most"), table,
        option(
            "--save-trials", metavar="FOLDER", type=folder_name,
            help="write the lenses of the typical, the worst and the best trial there, as .zmx files",
        ),
        run=_tolerance,
        rings={"help": "rings of the pupil (default 4)"}, checkpoint=_FILE, trials={"type": count_or_none},
        model={"choices": ("gaussian", "drt"), "help": "PSFs of psf: gaussian (default), smooth in the errors, or drt"},
        pixel="pixel pitch of psf (default 0.005)", size="pixels across the windows of psf (default 21)",
        limits={"metavar": "NAME=LIMIT"},
    ),
    _of_module("codesign", codesign, _codesign),
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
        (_subcommands,),
    ),
)  # fmt: skip
