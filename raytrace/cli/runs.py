"""Runs of commands that do more than call their function once."""

import argparse
import sys
import warnings
from pathlib import Path

import raytrace
from raytrace.cli.progress import Lines, progress, silence
from raytrace.cli.runner import (
    CommandError,
    catalogs,
    find_lens,
    open_lens,
    options_of,
    print_json,
    printed_on_failure,
    refuse_suffix,
    result_of_lens,
    say,
)
from raytrace.io import read_lens, write_lens
from raytrace.io.listing import list_lenses
from raytrace.maths.result import Result
from raytrace.shards import share
from raytrace.system.lens import with_sensor_distance


def glass(arguments: argparse.Namespace) -> Result:
    """The data of a glass."""
    return raytrace.glass(**options_of(arguments), catalogs=catalogs(arguments))


def glasses(arguments: argparse.Namespace) -> Result:
    """The glasses of the catalogs that pass a selection."""
    return raytrace.glasses(**options_of(arguments), catalogs=catalogs(arguments))


def stock_index(arguments: argparse.Namespace) -> Result:
    """An index of the parts of a folder; -o is the index."""
    options = options_of(arguments) | {"output": arguments.output, "catalogs": catalogs(arguments)}
    result = raytrace.stock_index(**options)
    say(f"written: {arguments.output}")
    arguments.output = None
    return result


def stock_find(arguments: argparse.Namespace) -> Result:
    """The parts of an index that pass a search."""
    return raytrace.stock_find(**options_of(arguments))


def lenses(arguments: argparse.Namespace) -> Result:
    """The shipped lenses and the files of a folder."""
    return list_lenses(arguments.folder)


def check(arguments: argparse.Namespace) -> Result:
    """The import report of a file."""
    return raytrace.check(find_lens(arguments.lens), **options_of(arguments), catalogs=catalogs(arguments))


def convert(arguments: argparse.Namespace) -> Result:
    """Write the file in another format."""
    options = options_of(arguments) | {"source": find_lens(arguments.source)}
    return raytrace.convert(**options, catalogs=catalogs(arguments))


def edit(arguments: argparse.Namespace) -> Result:
    """The edits of a lens in their order; the lens is written."""
    from raytrace.edit.steps import edited  # loads the package of edits

    steps = getattr(arguments, "steps", [])
    if not steps and arguments.mount is None:
        raise CommandError("no edit is given, such as --scale 2, --reverse, --delete 3-4")
    try:
        result = edited(open_lens(arguments), steps, arguments.mount)
    except ValueError as error:
        raise CommandError(f"{arguments.lens}: {error}") from error
    with printed_on_failure(result, arguments):
        write_lens(result.lens, arguments.output, catalogs=catalogs(arguments))
    say(f"written: {arguments.output}")
    arguments.output = None
    return result


def layout(arguments: argparse.Namespace) -> Result:
    """The layout, drawn in a file of this folder by default."""
    arguments.plot = arguments.plot or f"{Path(arguments.lens).stem}_layout{arguments.suffix}.png"
    return result_of_lens(arguments, raytrace.layout)


def spot(arguments: argparse.Namespace) -> Result:
    """The spots; --rays keeps no rays to plot or to write."""
    for flag, path in (("--plot", arguments.plot), ("-o", arguments.output)):
        if path and arguments.rays:
            raise CommandError(f"{flag} needs the rays, and --rays keeps none: leave one out")
    return result_of_lens(arguments, raytrace.spot)


def compare(arguments: argparse.Namespace) -> Result:
    """An analysis of two lenses, named by their files."""
    names = (arguments.lens, arguments.other)
    first, second = (open_lens(argparse.Namespace(**{**vars(arguments), "lens": name})) for name in names)
    options = options_of(arguments) | {"other": second, "names": names}
    try:
        return raytrace.compare(first, **options)
    except ValueError as error:
        raise CommandError(f"{names[0]}, {names[1]}: {error}") from error


def focus(arguments: argparse.Namespace) -> Result:
    """The focus; -o writes the lens of the file with the new sensor distance, without the conditions of the options."""
    result = result_of_lens(arguments, raytrace.focus)
    if arguments.output:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # shown when the file was first read
            original = read_lens(
                find_lens(arguments.lens),
                catalogs=catalogs(arguments),
                substitute=arguments.substitute,
                configuration=arguments.configuration,
            )
        with printed_on_failure(result, arguments):
            write_lens(with_sensor_distance(original, result.sensor_distance), arguments.output)
        say(f"written: {arguments.output}")
        arguments.output = None
    return result


def trace(arguments: argparse.Namespace) -> None:
    """The table of rays, written as it is computed and not kept in memory."""
    listing = result_of_lens(arguments, raytrace.trace)
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


def psf(arguments: argparse.Namespace) -> Result:
    """The kernels, or with --cross-section their profiles, which are a table and have no brightness scale."""
    through = vars(arguments).pop("cross_section")
    refuse_suffix("-o", arguments.output, (".csv", ".json") if through else (".npz",))
    if not through:
        return result_of_lens(arguments, raytrace.psf)
    if vars(arguments).pop("plot_log"):
        raise CommandError("--log is the brightness of kernels; leave it out with --cross-section")
    return result_of_lens(arguments, raytrace.psf).cross_section(through)


def tolerance(arguments: argparse.Namespace) -> Result:
    """The study; --save-trials writes lenses of its trials, --save-lens the lens with its tolerances."""
    folder, file = arguments.save_trials, arguments.save_lens
    if folder and arguments.trials == 0:
        raise CommandError(f"--save-trials {folder}: there are no trials; leave --trials 0 out")
    result = result_of_lens(arguments, raytrace.tolerance)
    if folder and not share().rank:
        folder = f"{folder}{arguments.suffix}"
        with printed_on_failure(result, arguments):
            result.save_trials(folder, catalogs=catalogs(arguments))
        say(f"written: typical.zmx, worst.zmx and best.zmx in {folder}")
    if file and not share().rank:
        with printed_on_failure(result, arguments):
            result.save_lens(file, catalogs=catalogs(arguments))
        say(f"written: {file}")
    return result


def view(arguments: argparse.Namespace) -> None:
    """The viewer until Ctrl-C."""
    from raytrace.viewer.server import serve  # loads the viewer

    path = find_lens(arguments.lens)
    silence()
    file = path if Path(arguments.lens).exists() else Path(path.name)
    port = arguments.port or 0
    serve(open_lens(arguments), file=file, port=port, browser=arguments.browser, as_json=arguments.json)


def wave_psf(arguments: argparse.Namespace) -> Result:
    """PSFs of an element, and figures of the element."""
    options = options_of(arguments) | {"catalog": catalogs(arguments)}
    psf = raytrace.wave_optics.wave_psf(**options)
    for content in ("heights", "caustic", "encircled"):
        if path := vars(arguments).pop(f"plot_{content}"):
            with printed_on_failure(psf, arguments):
                psf.plot(path, what=content, progress=options["progress"])
            say(f"written: {path}")
    return psf
