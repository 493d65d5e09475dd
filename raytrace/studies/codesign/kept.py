"""Kept: optima in a file, each under the settings that it is the optimum for, so that none is sought twice."""

import dataclasses
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from raytrace.camera.training import DamagedRun
from raytrace.maths.result import plain
from raytrace.studies.codesign.settings import Settings
from raytrace.studies.options import read


@dataclasses.dataclass(frozen=True)
class Kept:
    """Optima in a file of lines of JSON, [settings, optimum], of which one that was begun is no more than not there."""

    path: Path

    def read(self) -> dict[Settings, dict]:
        """All optima that are whole. Raises DamagedRun."""
        lines, found = self.path.read_bytes().split(b"\n")[:-1] if self.path.exists() else [], {}
        for number, line in enumerate(lines, 1):
            try:
                settings, optimum = json.loads(line)
                found[read(Settings, settings)] = _numbers(optimum)
            except (ValueError, TypeError, AttributeError, RecursionError) as error:
                words = f"line {number} holds no settings and their optimum ({error})"
                raise DamagedRun(f"{self.path}: {words}; delete it, and that one is sought anew") from error
        return found

    def add(self, settings: Settings, optimum: dict) -> None:
        """Write one more, behind what is whole."""
        if self.path.exists():
            whole = self.path.read_bytes().rpartition(b"\n")
            os.truncate(self.path, len(whole[0]) + len(whole[1]))
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([dataclasses.asdict(settings), plain(optimum)]) + "\n")


def _numbers(optimum: dict) -> dict:
    """An optimum as it was written; a focus at infinity is null there."""
    return {name: math.inf if value is None else value for name, value in optimum.items()}


class Sought(Protocol):
    """A case: what is to be found is by its settings alone."""

    settings: Settings


_Case = TypeVar("_Case", bound=Sought)


def found_once(
    cases: Sequence[_Case],
    find: Callable[[Settings], dict],
    *,
    progress: Callable[[Sequence[_Case]], Iterable[_Case]] = iter,
    kept: Kept | None = None,
) -> Iterator[tuple[_Case, dict]]:
    """Every case with what `find` says of its settings; what was found for another case, or is kept, is not sought.

    progress: wraps the cases, for a bar.
    """
    known = {} if kept is None else kept.read()
    for case in progress(cases):
        if case.settings not in known:
            known[case.settings] = find(case.settings)
            if kept is not None:
                kept.add(case.settings, known[case.settings])
        yield case, known[case.settings]
