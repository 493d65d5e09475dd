"""What `raytrace bench` runs: who takes part, on how many threads, and where the result goes."""

import argparse
import importlib
import importlib.util
import os
from types import ModuleType

import torch

from raytrace.bench.report import Asked, Measured
from raytrace.cli.run import CommandError, open_lens, printed_on_failure, say
from raytrace.pages import machine
from raytrace.shards import torch_threads
from raytrace.system.lens import Lens

#: What every subject takes beside --json, --repeats and --no-peers.
_TAKES = {
    "trace": ("lens", "rays", "output", "plot", "threads"),
    "psf": ("lenses", "output", "csv", "plot", "threads"),
    "wave": ("docs",),
    "speed": ("docs", "threads", "quick"),
    "optimise": ("lenses", "docs", "threads"),
}


def run(arguments: argparse.Namespace) -> Measured:
    """Speed beside error, and beside a peer's if there is one."""
    for name in sorted(set().union(*_TAKES.values()) - {*_TAKES[arguments.what]}):
        if getattr(arguments, name):
            raise CommandError(f"bench {arguments.what} takes no {'LENS' if name == 'lenses' else f'--{name}'}")
    subject = importlib.import_module(f"raytrace.bench.{arguments.what}")
    peers = None if arguments.no_peers or arguments.what == "wave" else _peers()
    threads = arguments.threads or {"wave": 1, "optimise": 1, "speed": _cores()}.get(
        arguments.what, torch.get_num_threads()
    )
    with torch_threads(threads):
        if peers:
            peers.set_threads(threads)

        def about() -> dict[str, str | int]:
            torch.set_num_threads(threads)  # peers may have changed them
            return machine() | (peers.versions() if peers else {})

        found = subject.bench(Asked(arguments, _open, peers, about, threads))
    with printed_on_failure(found, arguments):
        if arguments.csv:
            found.save_table(arguments.csv)
        if arguments.docs:
            found.save_page(arguments.docs)
    return found


def _open(name: str) -> Lens:
    return open_lens(argparse.Namespace(lens=name, catalog=[]))


def _peers() -> ModuleType | None:
    """The module that drives the peers, or None with a word about it if they are not installed."""
    if importlib.util.find_spec("optiland") is None:
        say("Optiland is not installed: measuring this package alone (pip install 'raytrace[bench]' adds it)")
        return None
    return importlib.import_module("raytrace.bench.peers")


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
