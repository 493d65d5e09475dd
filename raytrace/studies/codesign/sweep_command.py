"""`raytrace codesign sweep`: the closed form's optima by what the paper leaves open, and the page about them."""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

from raytrace.camera.training import share
from raytrace.cli.door import CommandError, print_json, say
from raytrace.files import write_atomically
from raytrace.plot.style import save
from raytrace.studies.codesign.claims import is_of_paper
from raytrace.studies.codesign.command import spectrum_of
from raytrace.studies.codesign.figures import sweep_figure
from raytrace.studies.codesign.page import below_the_mark
from raytrace.studies.codesign.setup import Experiment, bar, experiment, plain, settings_without_network
from raytrace.studies.codesign.sweep import Row, readings, write_sweep
from raytrace.studies.codesign.sweep import sweep as sweep_all
from raytrace.studies.codesign.sweep_page import answers, page


def sweep(arguments: argparse.Namespace) -> None:
    """Find all optima, then write table, figure and page."""
    if not (arguments.docs or arguments.output):
        raise CommandError("no folder to write to: give --docs DOCS or -o FOLDER")
    given = experiment(arguments, settings_without_network(arguments))
    rows = sweep_all(given.lens, given.settings, spectrum_of(given), progress=lambda cases: bar(cases, "optima"))
    if share().rank:
        return  # the first process writes
    docs = Path(arguments.docs or arguments.output)
    _write(given, rows, docs)
    if arguments.json:
        print_json(_document(given, rows))
    else:
        _print(rows, of_paper=is_of_paper(given.lens))
    say(f"written: {docs / 'codesign_sweep.md'}")
    for row in rows:
        if row.no_optimum:
            say(f"warning: {row.factor} {row.value}, {row.model}: {row.no_optimum}")
    if all(row.no_optimum for row in rows):
        raise CommandError("no case has an optimum; see the warnings, and choose other --near, --far, --bounds")


def _write(given: Experiment, rows: Sequence[Row], docs: Path) -> None:
    folder, path = docs / "codesign", docs / "codesign_sweep.md"
    folder.mkdir(parents=True, exist_ok=True)
    write_sweep(rows, folder / "sweep.csv")
    of_paper = is_of_paper(given.lens)
    save(sweep_figure(readings(rows), of_paper=of_paper), folder / "sweep.png")
    kept = below_the_mark(path.read_text(encoding="utf-8")) if path.exists() else ""
    pictures = f"the spectrum of {len(given.train)} {given.kind}"
    text = page(rows, given.settings, lens=given.name, pictures=pictures, kept=kept, of_paper=of_paper)
    write_atomically(path, lambda file: file.write(text.encode()))


def _document(given: Experiment, rows: Sequence[Row]) -> dict:
    """What `raytrace codesign sweep --json` writes."""
    return plain(
        {
            "settings": dataclasses.asdict(given.settings),
            **given.about,
            "rows": [dataclasses.asdict(row) for row in rows],
            "answers": [dataclasses.asdict(one) for one in answers(readings(rows))],
        }
    )


def _print(rows: Sequence[Row], *, of_paper: bool) -> None:
    print(
        f"{'factor':>12} {'value':<42} {'model':<9} {'sensor mm':>10} {'paraxial m':>11} {'RMS m':>8} {'error DRT':>11}"
    )
    for row in rows:
        print(
            f"{row.factor:>12} {row.value:<42} {row.model:<9} {row.sensor_mm:>10.4f} {row.focus_paraxial_m:>11.2f} "
            f"{row.focus_rms_m:>8.2f} {row.error_drt:>11.8f}"
        )
    for one in answers(readings(rows)):
        closest = (
            f"; closest to the paper {one.pair[0]:.1f} and {one.pair[1]:.1f} m ({one.closest})" if of_paper else ""
        )
        print(
            f"{one.definition}: Gaussian DRT focused nearer than paraxial in {one.nearer} of {one.readings} readings"
            f"{closest}"
        )
