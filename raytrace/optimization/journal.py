"""Journal: what the tasks of a search found, kept line by line, so that a search goes on where it ended.

A search is a fixed sequence of tasks, each told by its key alone. What a task found is looked up before it is done, so
one that goes on takes the same way as one that was never interrupted. Processes share the tasks of a batch.
"""

import time
import warnings
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from raytrace.files import NotWritten
from raytrace.shards import agreeing, share, total
from raytrace.stores import DamagedLine, Lines, anything, listed, mapped, number, record, text
from raytrace.system.identity import unlike
from raytrace.words import calling_level

FILE = "search.jsonl"
_ADVICE = "it keeps no search: name a new folder"
_TASK = record(
    {"task": text, "x": listed(number()), "seconds": number(0)}
    | dict.fromkeys(("lost", "missed", "merit"), number(0, infinite=True))
)


class BadSearch(ValueError):
    """A folder that keeps another search, or none; the message says what was found and what was expected."""


class Stopped(Exception):
    """The time is up, or somebody interrupted: the tasks that are left are not done."""


class Ended(NamedTuple):
    """Where a task ended: rays that are lost, how far conditions are missed, the merit, processor seconds, x (n,)."""

    lost: float
    missed: float
    merit: float
    seconds: float
    x: np.ndarray

    @property
    def rank(self) -> tuple[float, float, float]:
        """What of two is better: fewer rays lost, then conditions met, then less merit."""
        return self.lost, self.missed if self.missed > 1e-7 else 0.0, self.merit

    @property
    def is_whole(self) -> bool:
        return self.lost == 0 and self.missed <= 1e-6 and bool(np.isfinite(self.merit))


class Journal:
    """What tasks found, in a file of a folder or, without one, in memory alone."""

    def __init__(self, folder: str | PathLike | None, about: dict, until: float):
        """about: what the tasks depend on, for a folder serves one search; until: a time of `time.monotonic`."""
        self.path = None if folder is None else Path(folder) / FILE
        self.until, self.known, self.lines, self.begun = until, {}, {}, time.monotonic()
        self.store = None
        if self.path is not None:
            self.store = Lines(self.path, _TASK, head=mapped(anything))
            self._read(about)
        self.resumed = len(self.known)

    def _read(self, about: dict) -> None:
        """What is known; the file is begun where there is none. Raises BadSearch."""
        before, records = self.store.read(BadSearch, _ADVICE)
        if before is None:
            if not share().rank:
                self.store.begin(about)
            return
        if words := unlike(before, about):
            raise BadSearch(f"`folder`: {self.path} keeps a search of {words}; name a new folder")
        for line, one in records:
            self.lines[one["task"]] = line
            self.known[one["task"]] = Ended(*(one[name] for name in Ended._fields[:4]), np.array(one["x"]))

    def each(self, tasks: Sequence[tuple[str, Callable[[], Ended]]], count: int) -> list[Ended]:
        """What each of the tasks, of a key and a function, found at (count,) variables. Raises Stopped."""
        for key, _ in tasks:
            self._forget_misfit(key, count)
        left = [(key, task) for key, task in tasks if key not in self.known]
        mine = share()
        table = torch.zeros(len(left), 5 + count, dtype=torch.float64)
        stopped = False
        with agreeing():
            for k in mine.of(range(len(left))):
                key, task = left[k]
                try:
                    stopped = time.monotonic() > self.until
                    if stopped:
                        break
                    ended = task()
                except (KeyboardInterrupt, Stopped):
                    stopped = True
                    break
                table[k] = torch.tensor([1.0, *ended[:4], *ended.x], dtype=torch.float64)
                if mine.processes == 1:
                    self._keep(key, ended)
        if mine.processes > 1:
            for (key, _), row in zip(left, total(table), strict=True):
                if row[0]:
                    self._keep(key, Ended(*row[1:5].tolist(), row[5:].numpy()))
        if stopped or any(key not in self.known for key, _ in tasks):
            raise Stopped
        return [self.known[key] for key, _ in tasks]

    def _forget_misfit(self, key: str, count: int) -> None:
        """A record of another number of variables is no record of this task."""
        if key in self.known and len(self.known[key].x) != count:
            found = f"x: found a list of {len(self.known.pop(key).x)}, expected {count} of them"
            place = f"{self.path}, line {self.lines[key]}"
            warnings.warn(f"{place}: {found}; the line is ignored", DamagedLine, stacklevel=calling_level())

    def _keep(self, key: str, ended: Ended) -> None:
        self.known[key] = ended
        if self.store is None or share().rank:
            return
        numbers = dict(zip(Ended._fields[:4], map(float, ended[:4]), strict=True))
        try:
            self.store.append({"task": key, **numbers, "x": ended.x.tolist()})
        except OSError as error:
            self.store = None
            words = f"{self.path}: {error.strerror}; the search goes on, but cannot resume from here"
            warnings.warn(words, NotWritten, stacklevel=calling_level())
