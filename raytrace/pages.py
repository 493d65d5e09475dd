"""What the pages of benchmarks share: rows as CSV, the line about the measurement, and what stands below the mark."""

import csv
import dataclasses
import io
import os
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path

import torch

#: What stands below this line is written by hand: a page that is made again keeps it.
KEPT = "<!-- kept when this page is made again -->"


def table(rows: Iterable) -> str:
    """Rows of one kind as CSV, a column for each of their fields; empty where a quantity does not exist."""
    mappings = [dataclasses.asdict(row) for row in rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(mappings[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _cell(value) for key, value in mapping.items()} for mapping in mappings)
    return text.getvalue()


def measured(what: str, about: Mapping[str, str | int]) -> str:
    """The median of what it is, in one thread, and the machine."""
    return f"Median processor time of {what}, one thread; " + ", ".join(f"{name} {one}" for name, one in about.items())


def page(lines: Iterable[str], kept: str) -> str:
    """Lines, the mark, and `kept` below it."""
    return "\n".join([*lines, "", KEPT, kept]).rstrip() + "\n"


def _cell(value):
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else value


def machine() -> dict[str, str | int]:
    """What the figures depend on beside the code."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "vector instructions": torch.backends.cpu.get_cpu_capability(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "torch threads": torch.get_num_threads(),
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
