"""Several object distances for a command that takes one: told apart in text, JSON and files. Imports no torch."""

import argparse
import contextlib
import io
import json
import math
from collections.abc import Callable
from pathlib import Path


def each_distance(run: Callable[[argparse.Namespace], None], arguments: argparse.Namespace) -> None:
    """Run a command at every object distance of --object-distance (MM, several).

    Text has a heading a distance; JSON is one document {"results_by_object_distance": [{"object_distance", …}, …]},
    null for infinity; a file NAME.png becomes NAME_25000mm.png. One distance alone changes nothing of this.
    """
    distances = arguments.object_distances
    if len(distances) == 1:
        return run(argparse.Namespace(**{**vars(arguments), "object_distances": distances[0]}))
    documents = []
    for distance in distances:
        one = _at(arguments, distance)
        if arguments.json:
            with contextlib.redirect_stdout(io.StringIO()) as written:
                run(one)
            place = distance if math.isfinite(distance) else None
            documents.append({"object_distance": place, **json.loads(written.getvalue())})
        else:
            print(f"object at {_words(distance)}", flush=True)
            run(one)
    if arguments.json:
        print(json.dumps({"results_by_object_distance": documents}, indent=2, allow_nan=False))


def _at(arguments: argparse.Namespace, distance: float) -> argparse.Namespace:
    """The arguments for one distance, with files named by it."""
    suffix = "_" + _words(distance).replace(" ", "")
    one = argparse.Namespace(**{**vars(arguments), "object_distances": distance, "suffix": suffix})
    for name in ("plot", "output"):
        if getattr(one, name, None):
            path = Path(getattr(one, name))
            setattr(one, name, str(path.with_name(path.stem + suffix + path.suffix)))
    return one


def _words(distance: float) -> str:
    return f"{repr(distance).removesuffix('.0')} mm" if math.isfinite(distance) else "infinity"
