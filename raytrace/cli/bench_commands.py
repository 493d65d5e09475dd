"""`raytrace bench`."""

import argparse
import dataclasses
import importlib
import importlib.util
from types import ModuleType

import torch
from tqdm import tqdm

from raytrace.bench.measure import Row, calls, field_rays, measure, surfaces_of
from raytrace.bench.report import machine, markdown
from raytrace.cli.door import CommandError, open_lens, print_json, say
from raytrace.files import write_atomically


def bench(arguments: argparse.Namespace) -> None:
    """Speed of the trace beside its error, and beside a peer's if there is one."""
    lens = open_lens(argparse.Namespace(lens=arguments.lens, catalog=[]))
    if not bool(field_rays(lens, 1000).valid.all()):
        raise CommandError(f"{arguments.lens}: not every ray of the middle field starts; choose another lens")
    peer = None if arguments.no_peers else _peer()
    before = torch.get_num_threads()
    threads = arguments.threads or before
    try:
        torch.set_num_threads(threads)
        if peer:
            peer.set_threads(threads)
        peers = peer.peers(lens) if peer else []
        total = calls(arguments.rays, repeats=arguments.repeats, peers=peers)
        with tqdm(total=total, desc="measuring", unit="call", disable=None) as bar:
            rows = measure(
                lens,
                arguments.rays,
                repeats=arguments.repeats,
                peers=peers,
                threads=threads,
                progress=bar.update,
            )
        about = machine()
    finally:
        torch.set_num_threads(before)
    if peer:
        about |= {"Optiland": peer.VERSION, "numba": peer.NUMBA_VERSION}
    _write(arguments, rows, surfaces_of(lens), about)


def _peer() -> ModuleType | None:
    """The module that drives Optiland, or None with a word about it if Optiland is not installed."""
    if importlib.util.find_spec("optiland") is None:
        say("Optiland is not installed: measuring this package alone (pip install 'raytrace[bench]' adds it)")
        return None
    return importlib.import_module("raytrace.bench.peer")


def _write(arguments: argparse.Namespace, rows: list[Row], surfaces: int, about: dict[str, str | int]) -> None:
    report = markdown(rows, lens=arguments.lens, surfaces=surfaces, about=about, repeats=arguments.repeats)
    if arguments.output:
        write_atomically(arguments.output, lambda file: file.write(report.encode()))
    if arguments.plot:
        plot = importlib.import_module("raytrace.plot.bench")
        save = importlib.import_module("raytrace.plot.style").save
        save(plot.bench_figure([dataclasses.asdict(row) for row in rows]), arguments.plot)
    if arguments.json:
        print_json(
            {
                "lens": arguments.lens,
                "surfaces": surfaces,
                "repeats": arguments.repeats,
                "machine": about,
                "rows": [dataclasses.asdict(row) for row in rows],
            }
        )
    else:
        print(report, end="")
