"""What every command does: open the lens, call the verb once, print or save what it gives."""

import argparse
import inspect
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from types import ModuleType

import raytrace
from raytrace.cli.door import CONDITIONS, CommandError, open_lens, print_json, say
from raytrace.cli.outputs import check_outputs
from raytrace.cli.progress import progress
from raytrace.io import LensFileError
from raytrace.maths.result import Result, called
from raytrace.shards import processes, share

#: Options that are for the runner: they set the lens, or say where the result goes. A verb that has one gets it too.
_RUNNERS = (
    *("command", "subcommand", "run", "lens", "catalog", "json", "plot", "output", "suffix", "max_bytes", "spelled"),
    *("substitute", "object_distances", "configuration", *CONDITIONS),
)
_DRAWING = "plot_"  # options of the figure begin with it: --log, dest="plot_log"


def carry_out(command: ModuleType, arguments: argparse.Namespace) -> int:
    """Run a command; its verb gets every option as the keyword of the same name. Returns the exit code: 1 for a result
    that falls short of what was asked for.

    Several object distances go to the verb where it takes `object_distances`, else one result follows the other. Under
    torchrun processes share the work of a verb that takes a `share`, and the first one tells what was found.
    """
    with processes() if takes(command, "share") else nullcontext():
        return _carry_out(command, arguments)


def _carry_out(command: ModuleType, arguments: argparse.Namespace) -> int:
    check_outputs(arguments)
    run = getattr(command, "run", None) or partial(verb_of_lens, command)
    run = called(run) if isinstance(run, str) else run
    distances = getattr(arguments, "object_distances", None)
    if not distances or takes(command, "object_distances"):
        found = run(arguments)
        present(found, arguments)
        return int(found is not None and found.falls_short)
    documents, short, failed = [], False, None
    for distance, one in _each(arguments, distances):
        if len(distances) > 1 and not arguments.json:
            print(f"object at {_words(distance)}", flush=True)
        found = run(one)
        short |= found.falls_short
        try:
            save(found, one)
        except (OSError, LensFileError) as error:  # said when all results are printed
            failed = failed or error
        if arguments.json:
            place = {} if len(distances) == 1 else {"object_distance": distance if math.isfinite(distance) else None}
            documents.append({**place, **found.document()})
        else:
            print(found)
    if arguments.json:
        print_json(documents[0] if len(distances) == 1 else {"results_by_object_distance": documents})
    if failed:
        raise failed
    return int(short)


def takes(command: ModuleType, keyword: str) -> bool:
    """Whether the verb of a command has a keyword; those of codesign, wave and bench are no verbs."""
    return _verb(command) in raytrace.PUBLIC and keyword in inspect.signature(verb_of(command)).parameters


def verb_of(command: ModuleType) -> Callable:
    """The public function that a command calls."""
    return getattr(raytrace, _verb(command))


def _verb(command: ModuleType) -> str:
    return getattr(command, "VERB", command.__name__.rpartition(".")[2])


def options_of(command: ModuleType, arguments: argparse.Namespace) -> dict:
    """The options of a command line as keywords of its verb; what was not given is left to the verb."""
    given = {name: value for name, value in vars(arguments).items() if value is not None and name != "lens"}
    wanted = {
        name: value
        for name, value in given.items()
        if not name.startswith(_DRAWING) and (name not in _RUNNERS or takes(command, name))
    }
    if takes(command, "progress"):
        wanted["progress"] = partial(progress, what=arguments.command)
    if takes(command, "share"):
        wanted["share"] = share()
    return wanted


def verb_of_lens(command: ModuleType, arguments: argparse.Namespace) -> Result:
    """What the verb says of the lens; its errors begin with the name of the lens, as every error does."""
    lens = open_lens(arguments)
    try:
        return verb_of(command)(lens, **options_of(command, arguments))
    except ValueError as error:
        raise CommandError(f"{arguments.lens}: {error}") from error


def present(found: Result | None, arguments: argparse.Namespace) -> None:
    """Save a result where --plot and -o ask for it, then print it, as text or as JSON: also what cannot be saved."""
    if found is None or share().rank:
        return
    with printed_anyway(found, arguments):
        save(found, arguments)
    print_result(found, arguments)


@contextmanager
def printed_anyway(found: Result, arguments: argparse.Namespace) -> Iterator[None]:
    """A result whose files cannot be written is printed before the error."""
    try:
        yield
    except (OSError, LensFileError):
        print_result(found, arguments)
        raise


def print_result(found: Result, arguments: argparse.Namespace) -> None:
    """A result as text or as JSON."""
    if getattr(arguments, "json", False):
        print_json(found.document())
    else:
        print(found, flush=True)


def save(found: Result, arguments: argparse.Namespace) -> None:
    """The figure of --plot and the data of -o."""
    drawing = {
        name.removeprefix(_DRAWING): value for name, value in vars(arguments).items() if name.startswith(_DRAWING)
    }
    for option, write in (("plot", partial(found.plot, **drawing)), ("output", found.save)):
        if path := getattr(arguments, option, None):
            with _named(arguments):
                write(path)
            say(f"written: {path}")


@contextmanager
def _named(arguments: argparse.Namespace) -> Iterator[None]:
    """What there is nothing to draw of is told with the name of the lens; other errors have names of their own."""
    try:
        yield
    except raytrace.NothingToShow as error:
        raise CommandError(f"{arguments.lens}: {error}") from error


def _each(arguments: argparse.Namespace, distances: list[float]) -> Iterator[tuple[float, argparse.Namespace]]:
    """The arguments for each object distance, with files named by it where there are several."""
    for distance in distances:
        suffix = "" if len(distances) == 1 else "_" + _words(distance).replace(" ", "")
        one = {**vars(arguments), "object_distances": distance, "suffix": suffix}
        for name in ("plot", "output"):
            if suffix and one.get(name):
                path = Path(one[name])
                one[name] = str(path.with_name(path.stem + suffix + path.suffix))
        yield distance, argparse.Namespace(**one)


def _words(distance: float) -> str:
    return f"{repr(distance).removesuffix('.0')} mm" if math.isfinite(distance) else "infinity"
