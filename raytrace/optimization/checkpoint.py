"""Checkpoints and the log of an optimisation: files that tell how far it has come.

Paths: several descents from one start, each damped in its own manner, of which the best counts.

A merit function has many minima, and which one a descent ends in depends on how it is damped. The first path is the
fastest; every further one starts anew, and a path ends early where another has been before it.
"""

import dataclasses
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import NamedTuple

import numpy as np

from raytrace.files import NotWritten, append_text, write_json, write_text
from raytrace.maths.result import plain
from raytrace.optimization.least_squares import Cycle, Evaluate, Manner, Standing, State, least_squares
from raytrace.stores import Unfit, anything, either, exactly, listed, mapped, number, read_document, record, text, whole
from raytrace.system.identity import unlike
from raytrace.words import calling_level

#: In the order in which they are tried.
MANNERS = (
    Manner(),
    Manner(damping=1.0, lowered=0.5),
    Manner(damping=1e-2, bends=False, keeps=True),
)

#: Cycles of a path where neither these nor the time are limited: along a narrow valley a merit may fall for ever.
LIMIT = 500


@dataclass(frozen=True)
class Found:
    """The best state, every cycle of all paths, and why the path of the best one ended."""

    state: State
    history: tuple[Cycle, ...]
    stopped: str
    cycles: int
    evaluations: int


@dataclass(frozen=True)
class Course:
    """How far several paths have come: the number of the path, from 0, and where it began; where it stands; cycles and
    evaluations before it; and the best end (x, why) of those before it, None for the first."""

    path: int
    start: np.ndarray
    standing: Standing | None
    before: tuple[Cycle, ...] = ()
    evaluations: int = 0
    best: tuple[np.ndarray, str] | None = None

    @property
    def history(self) -> tuple[Cycle, ...]:
        """Every cycle of all paths."""
        return (*self.before, *_behind(self.standing.cycles, len(self.before), self.evaluations))


def best_of_paths(
    evaluate: Evaluate,
    x: np.ndarray,
    *,
    lower: np.ndarray,
    upper: np.ndarray,
    typical: np.ndarray | None = None,
    paths: int = 1,
    cycles: int | None = None,
    seconds: float | None = None,
    watch: Callable[[Cycle, Course], None] | None = None,
    course: Course | None = None,
) -> Found:
    """Descend from x within the bounds in so many manners; cycles and seconds: of all of them together, without either
    LIMIT each.

    watch: invoked after each cycle; course: how far earlier descents came, which are resumed there: cycles count from
    their beginning.
    """
    until = time.monotonic() + (np.inf if seconds is None else seconds)
    most = cycles if cycles is not None else LIMIT * max(1, paths) if seconds is None else 1_000_000
    begun = Course(0, x, None) if course is None else course
    x, best, stopped = begun.start, None, ""
    if begun.best is not None:
        best, stopped = evaluate(begun.best[0], False), begun.best[1]
    history, evaluations = begun.before, begun.evaluations
    for path in range(begun.path, min(len(MANNERS), max(1, paths))):
        now = Course(path, x, begun.standing, history, evaluations, None if best is None else (best.x, stopped))
        one = least_squares(
            evaluate, x, lower=lower, upper=upper, typical=typical, manner=MANNERS[path], cycles=most - len(history),
            until=until, watch=_counted(watch, now), standing=begun.standing if path == begun.path else None,
        )  # fmt: skip
        history = (*history, *_behind(one.cycles, len(history), evaluations))
        evaluations += one.evaluations
        if best is None or is_better(one.state, best):
            best, stopped = one.state, one.stopped
        if one.stopped in ("interrupted", "seconds") or len(history) >= most or time.monotonic() > until:
            stopped = one.stopped if one.stopped in ("interrupted", "cycles", "seconds") else stopped
            break
    return Found(best, history, stopped, len(history), evaluations)


def is_better(one: State, other: State) -> bool:
    """Fewer rays lost, then conditions met, then less merit."""
    return _rank(one) < _rank(other)


def _rank(state: State) -> tuple:
    missed = float(state.missed.max(initial=0.0))
    return state.lost, missed if missed > 1e-8 else 0.0, state.cost


def _behind(cycles: Sequence[Cycle], before: int, evaluations: int) -> list[Cycle]:
    """Cycles of a path by their number in all paths."""
    return [
        dataclasses.replace(one, number=one.number + before, evaluations=one.evaluations + evaluations)
        for one in cycles
    ]


def _counted(watch, now: Course):
    """The same, invoked with cycles by their number in all paths, and with how far these have come."""
    if watch is None:
        return None

    def each(cycle: Cycle, standing: Standing) -> None:
        (counted,) = _behind([cycle], len(now.before), now.evaluations)
        watch(counted, dataclasses.replace(now, standing=standing))

    return each


EVERY = 2.0  # s between two checkpoints
_COLUMNS = ("cycle", "merit", "missed", "step", "damping", "evaluations", "seconds", "limits")
_ADVICE = "expected what `checkpoint` wrote; start anew without `resume`"


class BadCheckpoint(ValueError):
    """A checkpoint that is none, or of another optimisation; the message says what was found and what was expected."""


class Kept(NamedTuple):
    """What a checkpoint keeps.

    x: the variables (n,); glasses: of surfaces where they vary, (catalog, name); tested: surfaces at which no exchange
    has helped since the last one; course: how far the descent came, None before it began; evaluated: of a merit that is
    no sum of squares, every evaluation so far (E, n + 1 + n): variables, value, gradient.
    """

    x: np.ndarray
    glasses: dict[int, tuple[str, str]]
    tested: tuple[int, ...] = ()
    course: Course | None = None
    evaluated: np.ndarray = np.zeros((0, 0))


class Checkpoint:
    """Keeps how far an optimisation has come in a file, replaced as a whole.

    {"of": what it depends on, "merit": …, "cycles": …, "variables": {name: number} of the last cycle, at the end of the
    best lens, "descent": all that decides the next cycle}; with "glasses": {surface: [catalog, name]} and "tested"
    where glasses vary, and with "evaluated" in the place of "descent" for a merit that is not a sum of squares.
    """

    def __init__(self, path: str | PathLike | None, of: Mapping, names: Sequence[str]):
        self.path, self.of, self.names, self.last, self.more = path, of, names, -np.inf, {}

    def keep_glasses(self, kept: Kept, merit: float) -> None:
        """Keep a state of the choice of glasses, and these glasses with all variables that follow."""
        self.more = {"glasses": {str(k): list(one) for k, one in kept.glasses.items()}, "tested": list(kept.tested)}
        self.keep(kept.x, merit, 0, now=True)

    def keep(
        self,
        x: np.ndarray,
        merit: float,
        cycles: int,
        *,
        course: Course | None = None,
        evaluated: Sequence[np.ndarray] = (),
        now: bool = False,
    ) -> None:
        """Keep the best variables and how far the descent has come, at most every few seconds unless it must be now.

        Warns NotWritten where the file cannot be written; the optimisation goes on.
        """
        if self.path is None or (not now and time.monotonic() < self.last + EVERY):
            return
        document = {
            "of": self.of,
            "merit": merit,
            "cycles": cycles,
            "variables": dict(zip(self.names, x.tolist(), strict=True)),
            **self.more,
        }
        if course is not None:
            document["descent"] = _written(course)
        if evaluated:
            document["evaluated"] = [plain(one.tolist()) for one in evaluated]
        try:
            write_json(self.path, document)
        except OSError as error:
            words = f"{self.path}: {error.strerror}; the optimisation goes on, but cannot resume from here"
            warnings.warn(words, NotWritten, stacklevel=calling_level())
            self.path = None
        self.last = time.monotonic()


def _written(course: Course) -> dict:
    """A course as JSON holds it."""
    now = course.standing
    return {
        "path": course.path,
        "start": course.start.tolist(),
        "before": [len(course.before), course.evaluations],
        "best": None if course.best is None else [course.best[0].tolist(), course.best[1]],
        "x": now.x.tolist(),
        **{name: float(getattr(now, name)) for name in _NUMBERS},
        "scale": None if now.scale is None else now.scale.tolist(),
        "evaluations": now.evaluations,
        "history": [list(dataclasses.astuple(cycle)) for cycle in course.history],
    }


_ENDS = ("gradient", "step", "merit", "cycles", "seconds", "interrupted")  # of a path: `report.STOPPED`
_NUMBERS = ("damping", "factor", "share", "price")
_VECTOR = listed(number())
_POSITIVE = number(0)
_SIZE = number(0)


def _cycle(value: object) -> Cycle:
    """A cycle of a history. Raises Unfit."""
    first, *numbers, evaluations, seconds, words = listed(anything, len(_COLUMNS), len(_COLUMNS))(value)
    return Cycle(whole()(first), *map(_SIZE, numbers), whole()(evaluations), number()(seconds), text(words))


_DESCENT = record(
    {
        "path": whole(0, len(MANNERS) - 1),
        "start": _VECTOR,
        "before": listed(whole(), 2, 2),
        "best": either(exactly(None), listed(anything, 2, 2)),
        "x": _VECTOR,
        **dict.fromkeys(_NUMBERS, _POSITIVE),
        "scale": either(exactly(None), _VECTOR),
        "evaluations": whole(),
        "history": listed(_cycle),
    }
)
_DOCUMENT = record(
    {"of": mapped(anything), "variables": mapped(number()), "cycles": whole()},
    {
        "glasses": mapped(listed(text, 2, 2)),
        "tested": listed(whole()),
        "descent": _DESCENT,
        "evaluated": listed(listed(either(exactly(None), number(infinite=True)), 1)),
    },
)


def resumed(path: str | PathLike, of: Mapping, names: Sequence[str]) -> Kept:
    """What a checkpoint of this optimisation keeps. Raises BadCheckpoint and OSError."""

    def kept(value: object) -> tuple[Mapping, Kept]:
        if isinstance(value, dict) and "of" not in value and "variables" in value:
            raise Unfit("does not say which lens it is of; an older version wrote it")
        found = _DOCUMENT(value)
        if words := unlike(found["of"], of):
            raise BadCheckpoint(f"{path}: a checkpoint of {words}; resume with the options that it was made with")
        if set(found["variables"]) != set(names):
            raise Unfit(f"variables: found {', '.join(found['variables'])}, expected {', '.join(names)}")
        glasses = {int(k): (catalog, name) for k, (catalog, name) in found.get("glasses", {}).items() if _is_number(k)}
        course = _course(found["descent"], len(names)) if "descent" in found else None
        if any(len(one) != 1 + 2 * len(names) for one in found.get("evaluated", [])):
            raise Unfit(f"evaluated: expected lists of {1 + 2 * len(names)}")
        evaluated = np.array(found.get("evaluated", []), dtype=float)
        x = np.array([found["variables"][name] for name in names])
        return Kept(x, glasses, tuple(found.get("tested", ())), course, evaluated)

    return read_document(path, kept, BadCheckpoint, _ADVICE)


def _is_number(name: str) -> bool:
    if not name.isascii() or not name.isdecimal() or len(name) > 6:
        raise Unfit(f"glasses: found {name[:20]!r}, expected the number of a surface")
    return True


def _course(found: Mapping, count: int) -> Course:
    """A course as it was written, of so many variables. Raises Unfit."""
    vectors = [found["start"], found["x"], *([] if found["scale"] is None else [found["scale"]])]
    best = found["best"]
    if best is not None:
        best = np.array(_VECTOR(best[0])), exactly(*_ENDS)(best[1])
        vectors.append(best[0])
    if any(len(one) != count for one in vectors):
        raise Unfit(f"descent: expected lists of {count} variables")
    history = found["history"]
    before, evaluations = found["before"]
    if before > len(history):
        raise Unfit("descent: history: expected the cycles of every path")
    own = [
        dataclasses.replace(one, number=one.number - before, evaluations=one.evaluations - evaluations)
        for one in history[before:]
    ]
    standing = Standing(
        np.array(found["x"]),
        *(found[name] for name in _NUMBERS),
        None if found["scale"] is None else np.array(found["scale"]),
        found["evaluations"],
        tuple(own),
    )
    return Course(found["path"], np.array(found["start"]), standing, tuple(history[:before]), evaluations, best)


class Log:
    """A line of comma-separated values for every cycle; the file is begun anew, with the cycles so far."""

    def __init__(self, path: str | PathLike | None, cycles: Sequence[Cycle] = ()):
        self.path = path
        if path is not None:
            write_text(path, "".join(map(_line, [_COLUMNS, *map(_words, cycles)])))

    def tell(self, cycle: Cycle) -> None:
        """Add a cycle. Warns NotWritten where the file cannot be written; the optimisation goes on."""
        if self.path is None:
            return
        try:
            append_text(self.path, _line(_words(cycle)), sync=False)
        except OSError as error:
            warnings.warn(f"{self.path}: {error.strerror}; the log ends here", NotWritten, stacklevel=calling_level())
            self.path = None


def _line(words: Sequence[str]) -> str:
    return ",".join(words) + "\n"


def _words(cycle: Cycle) -> list[str]:
    numbers = map(float, (cycle.merit, cycle.missed, cycle.step, cycle.damping))
    return [
        str(cycle.number),
        *map(repr, numbers),
        str(cycle.evaluations),
        f"{cycle.seconds:.3f}",
        cycle.limits.replace(",", ";"),
    ]
