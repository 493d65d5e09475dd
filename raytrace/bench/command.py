"""`raytrace bench`."""

import argparse
import dataclasses
import importlib
import importlib.util
from pathlib import Path
from types import ModuleType

import torch

from raytrace.bench import codesign_accuracy, codesign_report, psf, psf_report
from raytrace.bench import command_speed as speed_bench
from raytrace.bench import command_wave as wave_bench
from raytrace.bench.measure import Row, calls, field_rays, measure, surfaces_of
from raytrace.bench.psf_cases import USUAL, cases
from raytrace.bench.report import markdown
from raytrace.cli.door import CommandError, open_lens, print_json, say
from raytrace.cli.progress import progress
from raytrace.files import write_atomically
from raytrace.pages import machine
from raytrace.system.lens import Lens


def bench(arguments: argparse.Namespace) -> None:
    """Speed beside error, and beside a peer's if there is one: of the trace, or of the PSFs of lenses or waves."""
    other = {
        "trace": ("lenses", "csv", "docs", "quick"),
        "psf": ("lens", "rays", "docs", "quick"),
        "codesign": ("lenses", "lens", "rays", "output", "csv", "plot", "threads", "quick"),
        "wave": ("lenses", "lens", "rays", "output", "csv", "plot", "threads", "quick"),
        "speed": ("lenses", "lens", "rays", "output", "csv", "plot"),
    }[arguments.what]
    for name in other:
        if getattr(arguments, name):
            word = "LENS" if name == "lenses" else f"--{name}"
            raise CommandError(f"bench {arguments.what} takes no {word}")
    if arguments.what == "codesign":
        _bench_codesign(arguments)
        return
    if arguments.what == "wave":
        wave_bench.bench_wave(arguments)
        return
    peer = None if arguments.no_peers else _peer()
    if arguments.what == "speed":
        speed_bench.bench_speed(arguments, with_peers=peer is not None)
        return
    before = torch.get_num_threads()
    threads = arguments.threads or before
    try:
        torch.set_num_threads(threads)
        if peer:
            peer.set_threads(threads)
        (_bench_trace if arguments.what == "trace" else _bench_psf)(arguments, peer, threads)
    finally:
        torch.set_num_threads(before)


def _bench_trace(arguments: argparse.Namespace, peer: ModuleType | None, threads: int) -> None:
    name, counts = arguments.lens or "double_gauss", arguments.rays or [10**3, 10**4, 10**5, 10**6]
    lens = _open(name)
    if not bool(field_rays(lens, 1000).valid.all()):
        raise CommandError(f"{name}: not every ray of the middle field starts; choose another lens")
    peers = peer.peers(lens) if peer else []
    total = calls(counts, repeats=arguments.repeats, peers=peers)
    with progress(total, "call", what="measuring") as bar:
        rows = measure(lens, counts, repeats=arguments.repeats, peers=peers, threads=threads, progress=bar.update)
    _write_trace(arguments, name, rows, surfaces_of(lens), _about(peer))


def _bench_psf(arguments: argparse.Namespace, peer: ModuleType | None, threads: int) -> None:
    lenses = {Path(name).stem: name for name in arguments.lenses or USUAL}
    found = cases([(stem, _open(name)) for stem, name in lenses.items()])
    others = {"peer_methods": importlib.import_module("raytrace.bench.psf_peer").peer_methods} if peer else {}
    with progress(psf.steps(found), what="measuring") as bar:
        rows = psf.measure(
            found, repeats=arguments.repeats, threads=threads, progress=bar.update, say=bar.write, **others
        )
    about, titles = _about(peer), {(case.name, case.field): case.title for case in found}
    report = psf_report.markdown(rows, titles=titles, about=about, repeats=arguments.repeats)
    if arguments.output:
        write_atomically(arguments.output, lambda file: file.write(report.encode()))
    if arguments.csv:
        write_atomically(arguments.csv, lambda file: file.write(psf_report.table(rows).encode()))
    mappings = [dataclasses.asdict(row) for row in rows]
    if arguments.plot:
        plot = importlib.import_module("raytrace.bench.figure_psf")
        importlib.import_module("raytrace.plot.style").save(plot.pareto_figure(mappings, titles), arguments.plot)
    if arguments.json:
        goals = [dataclasses.asdict(target) for target in psf_report.targets(rows)]
        print_json({"repeats": arguments.repeats, "machine": about, "targets": goals, "rows": mappings})
    else:
        print(report, end="")


def _bench_codesign(arguments: argparse.Namespace) -> None:
    chosen, fields, sensors = codesign_accuracy.entrants(), codesign_accuracy.FIELDS, codesign_accuracy.SENSORS
    scenes = {"fields": fields, "sensors": sensors, "samples": codesign_accuracy.SAMPLES}
    total = codesign_accuracy.steps(chosen, fields=len(fields), sensors=len(sensors), repeats=arguments.repeats)
    with progress(total, what="measuring") as bar:
        rows, gaps = codesign_accuracy.measure(
            _open("double_gauss"), chosen=chosen, repeats=arguments.repeats, progress=bar.update, **scenes
        )
    about = machine() | {"torch threads": 1}
    mappings = [[dataclasses.asdict(row) for row in found] for found in (rows, gaps)]
    page = Path(arguments.docs) / "codesign_accuracy.md" if arguments.docs else None
    kept = page.read_text(encoding="utf-8").partition(codesign_report.KEPT)[2].strip() if page and page.exists() else ""
    report = codesign_report.markdown(rows, gaps, about=about, repeats=arguments.repeats, kept=kept)
    if page:
        folder = page.parent / "codesign"
        folder.mkdir(parents=True, exist_ok=True)
        for name, found in (("accuracy.csv", rows), ("model_error.csv", gaps)):
            write_atomically(folder / name, lambda file, found=found: file.write(codesign_report.table(found).encode()))
        plot = importlib.import_module("raytrace.bench.figure_codesign")
        figure = plot.accuracy_figure(*mappings, sensors[-1])
        importlib.import_module("raytrace.plot.style").save(figure, folder / "accuracy.png")
        write_atomically(page, lambda file: file.write(report.encode()))
    if arguments.json:
        print_json({"repeats": arguments.repeats, "machine": about, "rows": mappings[0], "models": mappings[1]})
    else:
        print(report, end="")


def _open(name: str) -> Lens:
    return open_lens(argparse.Namespace(lens=name, catalog=[]))


def _about(peer: ModuleType | None) -> dict[str, str | int]:
    return machine() | ({"Optiland": peer.VERSION, "numba": peer.NUMBA_VERSION} if peer else {})


def _peer() -> ModuleType | None:
    """The module that drives Optiland, or None with a word about it if Optiland is not installed."""
    if importlib.util.find_spec("optiland") is None:
        say("Optiland is not installed: measuring this package alone (pip install 'raytrace[bench]' adds it)")
        return None
    return importlib.import_module("raytrace.bench.peer")


def _write_trace(
    arguments: argparse.Namespace, name: str, rows: list[Row], surfaces: int, about: dict[str, str | int]
) -> None:
    report = markdown(rows, lens=name, surfaces=surfaces, about=about, repeats=arguments.repeats)
    if arguments.output:
        write_atomically(arguments.output, lambda file: file.write(report.encode()))
    if arguments.plot:
        plot = importlib.import_module("raytrace.bench.figure_trace")
        save = importlib.import_module("raytrace.plot.style").save
        save(plot.bench_figure([dataclasses.asdict(row) for row in rows]), arguments.plot)
    if arguments.json:
        print_json(
            {
                "lens": name,
                "surfaces": surfaces,
                "repeats": arguments.repeats,
                "machine": about,
                "rows": [dataclasses.asdict(row) for row in rows],
            }
        )
    else:
        print(report, end="")
