"""Journal: what the tasks of a search found, kept line by line, so that a search goes on where it ended.

A search is a fixed sequence of tasks, each told by its key alone. What a task found is looked up before it is done, so
one that goes on takes the same way as one that was never interrupted. Processes share the tasks of a batch.
"""

import json
import time
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from raytrace.shards import agreeing, share, total

FILE = "search.jsonl"


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
        self.until, self.known, self.resumed, self.begun = until, {}, 0, time.monotonic()
        lines = self._lines()
        if lines and lines[0] != about:
            other = [name for name in about if lines[0].get(name) != about[name]]
            raise BadSearch(f"`folder`: {self.path} keeps a search of other {', '.join(other)}; name a new folder")
        for line in lines[1:]:
            self.known[line["task"]] = Ended(
                line["lost"], line["missed"], line["merit"], line["seconds"], np.array(line["x"])
            )
        self.resumed = len(self.known)
        if self.path is not None and not share().rank:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            text = [json.dumps(line) + "\n" for line in (lines or [about])]
            self.path.write_text("".join(text), encoding="utf-8")  # without a last line that was not finished

    def _lines(self) -> list[dict]:
        if self.path is None or not self.path.exists():
            return []
        found = []
        for line in self.path.read_text(encoding="utf-8").splitlines():
            try:
                found.append(json.loads(line))
            except ValueError:
                break
        return found

    def each(self, tasks: Sequence[tuple[str, Callable[[], Ended]]], count: int) -> list[Ended]:
        """What each of the tasks, of a key and a function, found at (count,) variables. Raises Stopped."""
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

    def _keep(self, key: str, ended: Ended) -> None:
        self.known[key] = ended
        if self.path is not None and not share().rank:
            numbers = dict(zip(Ended._fields[:4], map(float, ended[:4]), strict=True))
            with open(self.path, "a", encoding="utf-8") as file:
                file.write(json.dumps({"task": key, **numbers, "x": ended.x.tolist()}) + "\n")
