"""Kept: optima in a file, each under the settings that it is the optimum for, so that none is sought twice."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from raytrace.imaging.training import DamagedRun
from raytrace.maths.result import plain
from raytrace.stores import Lines, Unfit, anything, either, exactly, listed, mapped, number, record, text
from raytrace.studies.codesign.settings import Settings
from raytrace.studies.options import read

_NUMBER = either(exactly(None), number())
_ENTRY = either(exactly(None, True, False), text, listed(either(text, _NUMBER)), mapped(_NUMBER), number())
_ADVICE = "delete the file, and its optima are sought anew"


@dataclasses.dataclass(frozen=True)
class Kept:
    """Optima in a file of lines of JSON, [settings, optimum]; truncated records are ignored.

    names: what every optimum has.
    """

    path: Path
    names: tuple[str, ...] = ()

    @functools.cached_property
    def _lines(self) -> Lines:
        return Lines(self.path, self._pair)

    def _pair(self, value: object) -> tuple[Settings, dict]:
        """Settings and their optimum as they were written; a focus at infinity is null there. Raises Unfit."""
        settings, optimum = listed(mapped(anything), 2, 2)(value)
        optimum = record(dict.fromkeys(self.names, anything))(mapped(_ENTRY)(optimum))
        try:
            found = read(Settings, settings)
            hash(found)
        except TypeError as error:
            raise Unfit(f"holds no settings ({error})") from error
        return found, {name: math.inf if value is None else value for name, value in optimum.items()}

    def read(self) -> dict[Settings, dict]:
        """All optima that are whole. Warns DamagedLine of lines that hold none. Raises DamagedRun."""
        return dict(pair for _, pair in self._lines.read(DamagedRun, _ADVICE)[1])

    def add(self, settings: Settings, optimum: dict) -> None:
        """Write one more, behind what is whole."""
        self._lines.append([dataclasses.asdict(settings), plain(optimum)])


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
