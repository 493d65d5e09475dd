"""`raytrace bench`: the subject, its peers, its threads, and the destination of the result."""

import argparse
import importlib
import importlib.util
import os
from types import ModuleType

import torch

from raytrace.bench import camera, psf, speed, tolerance, trace
from raytrace.bench.report import Measured, Request
from raytrace.cli.run import CommandError, printed_on_failure, say
from raytrace.shards import torch_threads

#: Of every subject: the function, and its options in addition to --json, --repeats, --threads and --no-peers.
_SUBJECTS = {
    "trace": (trace.bench, ("lens", "rays", "device", "output", "plot")),
    "psf": (psf.bench, ("lenses", "output", "csv", "plot")),
    "speed": (speed.bench, ("docs", "quick")),
    "tolerance": (tolerance.bench, ("output", "plot")),
    "camera": (camera.bench, ("output", "plot")),
}


def run(arguments: argparse.Namespace) -> Measured:
    """Speed against error, and compared with peers if they are installed."""
    measure, options = _SUBJECTS[arguments.what]
    for name in sorted({name for _, names in _SUBJECTS.values() for name in names} - {*options}):
        if getattr(arguments, name):
            raise CommandError(f"bench {arguments.what} takes no {'LENS' if name == 'lenses' else f'--{name}'}")
    all_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = arguments.threads or (all_cores if arguments.what == "speed" else torch.get_num_threads())
    result = measured(measure, arguments, threads, None if arguments.no_peers else installed())
    with printed_on_failure(result, arguments):
        if arguments.csv:
            result.save_table(arguments.csv)
        if arguments.docs:
            result.save_page(arguments.docs)
    return result


def measured(measure, arguments: argparse.Namespace, threads: int, peers: ModuleType | None) -> Measured:
    """`measure` of a `Request` with so many threads of torch."""
    with torch_threads(threads):
        if peers:
            peers.set_threads(threads)
        return measure(Request(arguments, peers, threads))


def installed() -> ModuleType | None:
    """The module `bench.peers`, or None with a message if Optiland is not installed."""
    if importlib.util.find_spec("optiland") is None:
        say("Optiland is not installed: measuring this package alone (pip install 'raytrace[bench]' adds it)")
        return None
    return importlib.import_module("raytrace.bench.peers")
