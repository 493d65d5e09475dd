"""Budget: memory is predicted where a sampling is chosen, and computations that need too much are refused.

The limit is set for a block by `within`, by default half of the free memory of the machine or of the control group of
the process.
"""

import contextlib
import contextvars
import ctypes
import math
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

from raytrace.words import RaytraceError, RaytraceWarning, calling_level, with_options

_SMALL = 2**24  # bytes that are always allowed
_LONG = 30.0  # s
_PIECE = 2**27  # bytes of a chunk
_KEPT = 2**30  # bytes: blocks up to this size, and freed memory up to twice as much, are not returned
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h

#: Peak of a trace without a graph, without its result: measured, with OPD and moments (tests/test_budget.py).
RAY_BYTES = 400

_limit: contextvars.ContextVar[float | None] = contextvars.ContextVar("limit", default=None)


class OverBudget(RaytraceError, ValueError):
    """More memory is needed than available; the message has the cause and a remedy."""


class TakesLong(RaytraceWarning):
    """A computation is predicted to take more than half a minute; the message has its time and a remedy."""


@contextlib.contextmanager
def within(max_bytes: float | None) -> Iterator[None]:
    """Within the block, refuse computations that need more memory; None: more than half of the free memory."""
    token = _limit.set(max_bytes)
    try:
        yield
    finally:
        _limit.reset(token)


def afford(needed: float, cause: str, *, helps: str) -> None:
    """Raise OverBudget if `needed` bytes exceed the limit.

    cause: with its size, as "the wave PSF at F/0.1 needs 60000 pupil rings"; helps: the remedy, its options in braces
    (`words.with_options`).
    """
    if needed <= _SMALL:
        return
    limit = allowed_bytes()
    if needed > limit:
        raise OverBudget(
            f"{cause} ({in_words(needed)}; {in_words(limit)} may be taken): {with_options(helps)}, or allow more by "
            "--max-bytes (raytrace.budget.within)"
        )


def afford_rays(pupil_points: int, **counts: int) -> None:
    """Raise OverBudget for more rays than memory holds; counts: of fields, wavelengths, …, by name."""
    rays = math.prod((pupil_points, *counts.values()))
    factors = " × ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items())
    cause = f"{rays:,} rays ({factors} × {pupil_points:,} of the pupil)"
    afford(RAY_BYTES * rays, cause, helps="ask for fewer {fields}, {wavelengths} or points of the pupil")


def forewarn(seconds: float, cause: str, *, helps: str) -> None:
    """Warn TakesLong of a long predicted time, accurate to a factor of three; arguments as for `afford`."""
    if seconds > _LONG:
        length = f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:,.0f} minutes"
        warnings.warn(
            f"{cause}: about {length}; for less, {with_options(helps)}", TakesLong, stacklevel=calling_level()
        )


def allowed_bytes() -> float:
    """The limit: that of `within`, else half of the free memory."""
    limit = _limit.get()
    return 0.5 * free_bytes() if limit is None else limit


def piece(each: float) -> int:
    """Number of entries of `each` bytes in a chunk, at least one."""
    limit = _limit.get()
    return max(1, int((_PIECE if limit is None else min(_PIECE, 0.25 * limit)) // max(each, 1.0)))


def free_bytes() -> float:
    """Free memory of the machine, or of the control groups of the process where that is less."""
    return min([_available(), *map(_left, _groups())])


def keep_freed_memory() -> bool:
    """Keep large freed blocks in the process; returns whether the C library can.

    glibc returns every block above 32 MB to the system, which provides it again page by page, each cleared: 10 to 17 %
    of the processor time of large traces and of training. It affects the whole process: the command does it, the
    library does not.
    """
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return bool(set_option(_MMAP_THRESHOLD, _KEPT) and set_option(_TRIM_THRESHOLD, 2 * _KEPT - 1))


def in_words(size: float) -> str:
    """A number of bytes as text, as 1.5 GB."""
    if not math.isfinite(size):
        return "more bytes than there are"
    for unit, worth in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if size >= worth:
            return f"{size / worth:,.3g} {unit}" if size < 1e15 else f"{size / 1e12:.1e} TB"
    return f"{size / 1e3:.3g} kB"


def _available() -> float:
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024.0 * int(line.split()[1])
    except OSError:
        pass
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return math.inf


def _groups() -> list[Path]:
    """Folders of the control groups of this process's memory, of either version, up to the root."""
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return []
    groups = []
    for _, controllers, path in (line.split(":", 2) for line in lines):
        if controllers in ("", "memory"):
            base = Path("/sys/fs/cgroup", controllers)
            inner = base / path.strip("/")
            groups += [inner, *(above for above in inner.parents if above.is_relative_to(base))]
    return groups


def _left(group: Path) -> float:
    """Free memory of a control group, with pages of files that can be dropped; inf without a limit."""
    for most, used, dropped in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        try:
            limit, taken = (group / most).read_text().strip(), float((group / used).read_text())
            lines = (line.split() for line in (group / "memory.stat").read_text().splitlines())
            spare = sum(float(size) for name, size in lines if name == dropped)
        except (OSError, ValueError):
            continue
        return math.inf if limit == "max" else max(0.0, float(limit) - taken + spare)
    return math.inf
