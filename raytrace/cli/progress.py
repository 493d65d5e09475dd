"""Progress of long commands, on standard error: a bar on a terminal, else one line every ten seconds.

    with progress(total, "ray", what="tracing") as bar:
        bar.update(many)
    for plane in progress(planes, "plane"):
        ...

`heartbeat` encloses every command: its thread writes the lines, so that they appear while a single step takes minutes
and in commands without progress.
"""

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from typing import Any, TypeAlias

from tqdm import tqdm

EVERY = 10.0  # s between two lines
_THOUSANDS = ("ray",)  # units that are counted by the million

_open: list["Bar | Lines"] = []  # running computations, the innermost last

#: Receives the progress of the innermost running computation.
Report: TypeAlias = Callable[["Lines"], object]


def progress(work: int | Iterable | None, unit: str = "step", *, what: str = "", initial: int = 0) -> "Bar | Lines":
    """Progress with the methods of tqdm: `update(n)`, `set_postfix_str(words)`, `close()`; a context manager.

    work: the number of steps, None if it is unknown, or an iterable, over whose items the progress then iterates. what:
    the name of the computation; unit: of the steps; initial: number of steps that were done before.
    """
    items, total = _parts(work)
    if total is None or not _is_terminal():
        return Lines(work, unit, what=what, initial=initial)
    many = unit in _THOUSANDS
    return Bar(items, total=total, desc=what or None, unit=unit, initial=initial, unit_scale=many, leave=False)


@contextlib.contextmanager
def heartbeat(what: str, report: Report | None = None) -> Iterator[None]:
    """Within the block, a line every ten seconds about the running computation; none while a terminal shows a bar.

    report: called instead of the line, every second.
    """
    done, before = threading.Event(), [*_open]

    def beat() -> None:
        while not done.wait(EVERY if report is None else 1.0):
            shown = _open[-1:]
            if shown and isinstance(shown[0], Lines) and os.environ.get("RANK", "0") == "0":  # of processes, one speaks
                (report or _print_line)(shown[0])

    Lines(None, what=what)
    threading.Thread(target=beat, daemon=True).start()
    try:
        yield
    finally:
        done.set()
        _open[:] = before  # also those that a failure left open


def _print_line(lines: "Lines") -> None:
    print(f"raytrace: {lines}", file=sys.stderr, flush=True)


def silence() -> None:
    """Let `heartbeat` write no lines, for a command that computes on request alone."""
    _open.clear()


class Bar(tqdm):
    """A bar, while which no lines are written."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        _open.append(self)

    def write(self, words: str) -> None:
        super().write(words, file=sys.stderr)

    def close(self) -> None:
        _leave(self)
        super().close()


class Lines:
    """Progress in words: `tracing: 3/10 planes, 0:20 elapsed, about 0:47 left`."""

    def __init__(self, work: int | Iterable | None, unit: str = "step", *, what: str = "", initial: int = 0):
        items, self.total = _parts(work)
        self.items = () if items is None else items
        self.what, self.unit = what, unit
        self.n = self.initial = initial
        self.start_time, self.words = time.monotonic(), ""
        _open.append(self)

    def update(self, n: int = 1) -> None:
        self.n += n

    def set_postfix_str(self, words: str = "", refresh: bool = True) -> None:
        self.words = words

    def write(self, words: str) -> None:
        print(words, file=sys.stderr)

    def close(self) -> None:
        _leave(self)

    def __enter__(self) -> "Lines":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __iter__(self) -> Iterator:
        with self:
            for item in self.items:
                yield item
                self.update()

    @property
    def left(self) -> float | None:
        """Estimate of the remaining time in s; None where the number of steps, or the time of one, is unknown."""
        gone = self.n - self.initial
        if not self.total or gone <= 0 or self.n > self.total:
            return None
        return (time.monotonic() - self.start_time) * (self.total - self.n) / gone

    def __str__(self) -> str:
        said = [f"{self.n:,}{f'/{self.total:,}' if self.total else ''} {self.unit}s"] if self.n else []
        said.append(f"{clock(time.monotonic() - self.start_time)} elapsed")
        if (left := self.left) is not None:
            said.append(f"about {clock(left)} left")
        return ": ".join(filter(None, [self.what, ", ".join(filter(None, [*said, self.words]))]))


def clock(seconds: float) -> str:
    """Minutes and seconds for people, as 1:07; with hours where there are any."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _parts(work: int | Iterable | None) -> tuple[Iterable | None, int | None]:
    """The iterable and the number of steps, each None if unknown."""
    if not isinstance(work, Iterable):
        return None, work
    return work, len(work) if isinstance(work, Sized) else None


def _leave(entry: "Bar | Lines") -> None:
    if _open:  # None where a bar outlives this module
        _open[:] = [other for other in _open if other is not entry]


def _is_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()
