"""The runner of every command: open the lens, call the public function once, print or save the result."""

import argparse
import dataclasses
import inspect
import json
import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TypeAlias, TypeVar

import raytrace
from raytrace.cli.commands import function
from raytrace.cli.progress import progress
from raytrace.cli.types import InputFile, OutputFile, OutputFolder
from raytrace.files import check_output, check_output_folder, shipped
from raytrace.io import FORMATS, LensFileError, read_lens, shipped_lens
from raytrace.materials.catalogs import CatalogError, catalog_file
from raytrace.maths.result import Result
from raytrace.psf_models import Execution, model_of
from raytrace.shards import processes, share
from raytrace.system.lens import Lens, check_media
from raytrace.words import RaytraceError, did_you_mean, option

#: Options that set the lens, by the keywords of `Lens.at`.
CONDITIONS = (
    *("magnification", "sensor_distance", "f_number", "entrance_pupil_diameter", "wavelengths", "ray_aiming"),
    *("temperature", "pressure", "mount"),
)
#: Options of the runner: lens, conditions and destination of the result. A function with such a parameter gets it too.
RUNNER_OPTIONS = (
    *("command", "subcommand", "run", "lens", "catalog", "json", "plot", "output", "suffix", "max_bytes", "flags"),
    *("save_trials", "save_lens"),
    *("substitute", "object_distances", "configuration", *CONDITIONS),
)
#: Options that are fields of the parameter `execution`.
_EXECUTION = tuple(field.name for field in dataclasses.fields(Execution))
Returned = TypeVar("Returned")
Name = TypeVar("Name", bound=str)
#: Carries out a command; None where it has printed or saved its result.
Run: TypeAlias = Callable[[argparse.Namespace], Result | None]
_FIGURE = "plot_"  # prefix of the names of options of the figure, as plot_log
#: Outputs that may be an input: a checkpoint replaces the one that is resumed.
_REPLACES = {("checkpoint", "resume")}


class CommandError(RaytraceError, ValueError):
    """Well-formed arguments that cannot be carried out together."""


def carry_out(arguments: argparse.Namespace) -> int:
    """Run the command of the arguments. Returns the exit code: 1 for a result that misses its goal.

    Several object distances are passed on if the function takes `object_distances`, else it is called once for each.
    Under torchrun processes share the work of a function that takes a `share`, and the first one prints.
    """
    with processes() if _takes(arguments, "share") else nullcontext():
        check_outputs(arguments)
        run = _run_of(arguments)
        distances = getattr(arguments, "object_distances", None)
        if distances and not _takes(arguments, "object_distances"):
            return _run_each(run, arguments, distances)
        result = run(arguments)
        present(result, arguments)
        return int(result is not None and result.falls_short)


def _run_of(arguments: argparse.Namespace) -> Run:
    """The function that a command runs: the one its row names, else its public function with a lens."""
    command = arguments.run
    if command.run:
        return function(command.run)
    return partial(result_of_lens, verb=raytrace.public_name(command.verb))


def _run_each(run: Run, arguments: argparse.Namespace, distances: list[float]) -> int:
    """One result for each object distance; with several, files are named by the distance."""
    documents, falls_short, failure = [], False, None
    several = len(distances) > 1
    for distance in distances:
        text = f"{repr(distance).removesuffix('.0')} mm" if math.isfinite(distance) else "infinity"
        suffix = "_" + text.replace(" ", "") if several else ""
        values = {**vars(arguments), "object_distances": distance, "suffix": suffix}
        for name in ("plot", "output", "save_lens"):
            if suffix and values.get(name):
                path = Path(values[name])
                values[name] = str(path.with_name(path.stem + suffix + path.suffix))
        single = argparse.Namespace(**values)
        if several and not arguments.json:
            print(f"object at {text}", flush=True)
        result = run(single)
        if result is None:
            continue
        falls_short |= result.falls_short
        try:
            save(result, single)
        except (OSError, LensFileError) as error:  # raised when all results are printed
            failure = failure or error
        if arguments.json:
            place = {"object_distance": distance if math.isfinite(distance) else None} if several else {}
            documents.append({**place, **result.document()})
        else:
            print(result)
    if documents:
        print_json({"results_by_object_distance": documents} if several else documents[0])
    if failure:
        raise failure
    return int(falls_short)


def _takes(arguments: argparse.Namespace, keyword: str) -> bool:
    """Whether the command calls a public function with this parameter; codesign and bench call none."""
    verb = arguments.run.verb
    parameters = inspect.signature(raytrace.public_name(verb)).parameters if verb in raytrace.PUBLIC else ()
    return keyword in parameters or ("execution" in parameters and keyword in _EXECUTION)


def options_of(arguments: argparse.Namespace) -> dict:
    """The options of a command line as keywords of its public function, without those that are missing."""
    options = {
        name: value
        for name, value in vars(arguments).items()
        if value is not None
        and name != "lens"
        and not name.startswith(_FIGURE)
        and (name not in RUNNER_OPTIONS or _takes(arguments, name))
    }
    if _takes(arguments, "progress"):
        options["progress"] = partial(progress, what=arguments.command)
    if _takes(arguments, "share"):
        options["share"] = share()
    if _takes(arguments, "execution"):
        options["execution"] = Execution(**{name: options.pop(name) for name in _EXECUTION if name in options})
    numbers = {key: options.pop(key) for key in ("rays", "rho") if arguments.run.verb == "psf" and key in options}
    if numbers:
        options["model"] = model_of(options.get("model", "auto"), **numbers)
    return options


def result_of_lens(arguments: argparse.Namespace, verb: Callable[..., Returned]) -> Returned:
    """Call a public function with the lens and the options. Its errors begin with the name of the lens.

    If the function takes a merit function, options that are not its parameters define the merit function.
    """
    lens, options = open_lens(arguments), options_of(arguments)
    try:
        if _takes(arguments, "as_built"):
            options |= _as_built(options)
        if _takes(arguments, "merit"):
            names = [name for name in options if name == "merit" or not _takes(arguments, name)]
            if of_merit := {name: options.pop(name) for name in names}:
                from raytrace.optimization.merit import merit_of_options  # loads the package of merit functions

                options["merit"] = merit_of_options(lens, **of_merit)
        return verb(lens, **options)
    except ValueError as error:
        raise CommandError(f"{arguments.lens}: {error}") from error


def _as_built(options: dict) -> dict:
    """The keyword `as_built`, made of --as-built and its options, which are removed; empty without --as-built."""
    settings = {name: options.pop(name) for name in ("grade", "limits", "weight") if name in options}
    if not options.pop("as_built", False):
        if settings:
            raise CommandError(f"{option(min(settings))} goes with {option('as_built')}")
        return {}
    from raytrace.tolerancing.as_built import AsBuilt  # loads the package of tolerances

    return {"as_built": AsBuilt(**settings)}


# -- the lens


def find_lens(name: str) -> Path:
    """The file of that name, else the shipped lens of that name (with or without lenses/ and .zmx)."""
    path = Path(name)
    if path.is_dir():
        raise CommandError(f"{name}: is a directory; expected a lens file")
    if path.exists():
        return path
    if shipped_path := shipped_lens(path):
        return shipped_path
    names = sorted({lens.stem for lens in shipped("lenses").rglob("*.zmx")})
    neighbours = [str(file) for file in path.parent.glob("*") if file.suffix.lower() in FORMATS]
    meant = did_you_mean(name, [*names, *neighbours])
    raise CommandError(f"{name}: no such lens file{meant or ';'} the shipped lenses are {', '.join(names)}")


def open_lens(arguments: argparse.Namespace) -> Lens:
    """Read the lens and set the conditions of the options; the object distance if it is a single one."""
    path = find_lens(arguments.lens)
    number = getattr(arguments, "configuration", None)
    lens = read_lens(
        path,
        catalogs=catalogs(arguments),
        substitute=getattr(arguments, "substitute", None),
        configuration=number if isinstance(number, int) else None,
    )
    conditions = {name: getattr(arguments, name, None) for name in CONDITIONS}
    distance = getattr(arguments, "object_distances", None)
    try:
        lens = lens.at(**conditions, object_distance=distance if isinstance(distance, float) else None)
        check_media(lens, lens.wavelengths)
    except ValueError as error:
        raise CommandError(f"{path}: {error}") from error
    return lens


def catalogs(arguments: argparse.Namespace) -> tuple[Path, ...]:
    """The glass catalogs of --catalog, files or names of shipped ones. Raises CommandError for a missing one."""
    try:
        paths = tuple(map(catalog_file, arguments.catalog))
    except CatalogError as error:
        raise CommandError(f"--catalog {error}") from error
    for path in paths:
        if not path.is_file():
            raise CommandError(f"{path}: no such glass catalog; expected an .agf file after --catalog")
    return paths


# -- outputs


def check_outputs(arguments: argparse.Namespace) -> None:
    """Check every output of a command line before the work. Raises CommandError and OSError.

    The folder exists and can be written in, the suffix is known, and no two options name one file.
    """
    seen = {_real(path): name for name, path in paths(arguments, InputFile)}
    for name, path in paths(arguments, OutputFile):
        other = seen.get(_real(path))
        flag = _flag(arguments, name)
        if other is not None and (name, other) not in _REPLACES:
            raise CommandError(f"{flag} {path}: is the file of {_flag(arguments, other)} too; give another name")
        seen[_real(path)] = name
        try:
            check_output(path, path.suffixes)
        except ValueError as error:
            raise CommandError(f"{flag} {error}") from error
    for name, folder in paths(arguments, OutputFolder):
        if folder.may_be_file and _real(folder) in seen:
            other = _flag(arguments, seen[_real(folder)])
            raise CommandError(f"{_flag(arguments, name)} {folder}: is the file of {other} too; give another name")
        check_output_folder(Path(folder).parent if folder.may_be_file else folder)


def paths(arguments: argparse.Namespace, kind: type[Name]) -> Iterator[tuple[str, Name]]:
    """Names and values of the arguments that are paths of a kind, single or in lists."""
    for name, value in vars(arguments).items():
        for entry in value if isinstance(value, list | tuple) else [value]:
            if isinstance(entry, kind):
                yield name, entry


def _real(path: str) -> str:
    """The file of a name: the shipped lens of that name if there is none in the folder."""
    return os.path.realpath(path if Path(path).exists() else shipped_lens(Path(path)) or path)


def _flag(arguments: argparse.Namespace, name: str) -> str:
    return arguments.flags.get(name, name.upper())


def refuse_suffix(flag: str, path: str | None, known: tuple[str, ...]) -> None:
    """Raise CommandError for a file name with another suffix than the known ones; None passes."""
    if path and Path(path).suffix.lower() not in known:
        raise CommandError(f"{flag} {path}: expected a name that ends in {', '.join(filter(None, known))}")


# -- the result


def present(result: Result | None, arguments: argparse.Namespace) -> None:
    """Save a result by --plot and -o, then print it as text or JSON, even if it cannot be saved."""
    if result is None or share().rank:
        return
    with printed_on_failure(result, arguments):
        save(result, arguments)
    print_result(result, arguments)


@contextmanager
def printed_on_failure(result: Result, arguments: argparse.Namespace) -> Iterator[None]:
    """Print a result whose files cannot be written before the error is raised."""
    try:
        yield
    except (OSError, LensFileError):
        print_result(result, arguments)
        raise


def print_result(result: Result, arguments: argparse.Namespace) -> None:
    """Print a result as text or JSON."""
    if getattr(arguments, "json", False):
        print_json(result.document())
    else:
        print(result, flush=True)


def save(result: Result, arguments: argparse.Namespace) -> None:
    """Write the figure of --plot and the data of -o."""
    drawing = {name.removeprefix(_FIGURE): value for name, value in vars(arguments).items() if name.startswith(_FIGURE)}
    for name in ("plot", "output"):
        if path := getattr(arguments, name, None):
            try:
                result.plot(path, **drawing) if name == "plot" else result.save(path)
            except raytrace.NothingToShow as error:
                raise CommandError(f"{arguments.lens}: {error}") from error
            for file in [path] if name == "plot" else result.files(path):
                say(f"written: {file}")


def print_json(document: dict) -> None:
    """Write one JSON document to standard output."""
    print(json.dumps(document, indent=2, allow_nan=False))


def say(message: str) -> None:
    """Write one line to standard error."""
    print(f"raytrace: {message}", file=sys.stderr)
