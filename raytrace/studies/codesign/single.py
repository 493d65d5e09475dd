"""`raytrace codesign LENS`: one model, trained, or brought to the optimum of the closed form."""

import argparse
import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

from raytrace.cli.door import CommandError, say
from raytrace.cli.run import present
from raytrace.files import write_json
from raytrace.imaging.variables import Limits
from raytrace.io import FORMATS, read_lens, write_lens
from raytrace.maths.result import Result, plain
from raytrace.shards import share
from raytrace.studies.codesign.experiment import LENS, STEPS, Outcome
from raytrace.studies.codesign.optima import Optimum, closed_form
from raytrace.studies.codesign.setup import Experiment, experiment, refuse_too_few, settings_of, train_run


@dataclasses.dataclass(frozen=True)
class Learned(Result):
    """What an experiment found."""

    given: Experiment
    found: Outcome | Optimum

    def document(self) -> dict:
        settings, limits = (dataclasses.asdict(one) for one in (self.given.settings, self.given.limits))
        return plain({"settings": settings, **self.given.about, "limits": limits, **self.found.document()})

    def __str__(self) -> str:
        told = _outcome if isinstance(self.found, Outcome) else _optimum
        return "\n".join(told(self.found, _lens(self.found, self.given.limits)))


def _outcome(found: Outcome, lens: Iterator[str]) -> Iterator[str]:
    yield f"{found.model} PSFs, seed {found.seed}"
    yield from lens
    yield "L1 loss of test pictures:"
    yield f"  after step 1, with its own PSFs  {found.l1_joint:.5f}"
    yield f"  the same network with DRT PSFs   {found.l1_before:.5f}"
    yield f"  after step 2, with DRT PSFs      {found.l1_drt:.5f}"
    yield f"{'object at':>12} {'L1 with DRT PSFs':>18}"
    for distance, loss in found.by_distance.items():
        yield f"{float(distance) / 1e3:>10g} m {loss:>18.5f}"


def _optimum(found: Optimum, lens: Iterator[str]) -> Iterator[str]:
    yield f"{found.model} PSFs, mean square error of a pixel behind the best linear filter"
    yield f"{'evaluation':>12} {'error':>12} {'penalty, mm²':>13}"
    for evaluation, (error, penalty) in enumerate(zip(found.course, found.penalties, strict=True), 1):
        yield f"{evaluation:>12} {error:>12.8f} {penalty:>13.6g}"
    yield from lens
    yield f"error of this lens: {found.error:.8f} with its own PSFs, {found.error_drt:.8f} with DRT PSFs"


def _lens(found: Outcome | Optimum, held: Limits) -> Iterator[str]:
    yield f"sensor at {found.sensor_mm:.4f} mm"
    for name, value in found.variables.items():
        if name != "sensor":
            yield f"{name} = {value:.7g} {'1/mm' if name.startswith('curvature') else ''}".rstrip()
    yield f"in focus: {_metres(found.focus_paraxial_m)} (paraxial), {_metres(found.focus_rms_m)} (least RMS spot)"
    ranges = (held.glass, held.air)
    glass, air = (f"{low:.4g}" + (f" to {high:.4g}" if math.isfinite(high) else " at least") for low, high in ranges)
    limits = f"glass {glass}, its edge {held.edge:.4g} at least, air {air} (mm)"
    yield f"penalty {found.penalty:.6g} mm² beside the loss; thicknesses: {limits}"


def _metres(distance: float) -> str:
    return f"{distance:.2f} m" if math.isfinite(distance) else "infinity"


def single(arguments: argparse.Namespace) -> None:
    """Train what is left of a run."""
    if not arguments.folder:
        raise CommandError("no folder to keep the run in: give -o FOLDER")
    folder, lens_file = _outputs(arguments)
    begun = folder / STEPS[0] / "settings.json"
    if arguments.resume and not begun.exists():
        raise CommandError(f"{folder}: no run was begun here; leave out --resume to begin one")
    given = experiment(arguments, settings_of(arguments, begun))
    refuse_too_few(given)
    found = train_run(given, given.settings, folder, f"{given.settings.model}, seed {given.settings.seed}")
    if lens_file and not share().rank:
        write_lens(read_lens(folder / LENS, catalogs=given.catalogs), lens_file, catalogs=given.catalogs)
    _tell(Learned(given, found), arguments, f"{folder / 'outcome.json'}, {lens_file or folder / LENS}")


def spectral(arguments: argparse.Namespace) -> None:
    """Find the optimum of the closed form."""
    given = experiment(arguments, settings_of(arguments))
    found = closed_form(given.lens, given.settings, given.spectrum())
    for name in found.at_end:
        say(f"warning: {name} stands at an end of its bounds, and the loss still falls beyond it")
    folder, lens_file = _outputs(arguments) if arguments.folder else (None, None)
    if lens_file:
        write_lens(found.lens, lens_file, catalogs=given.catalogs)
    elif folder:
        folder.mkdir(parents=True, exist_ok=True)
        write_lens(found.lens, folder / LENS, catalogs=given.catalogs)
        write_json(folder / "spectral.json", Learned(given, found).document())
    written = lens_file or (folder and f"{folder / 'spectral.json'}, {folder / LENS}")
    _tell(Learned(given, found), arguments, written)


def _outputs(arguments: argparse.Namespace) -> tuple[Path, Path | None]:
    """The folder of -o, and the lens file where it names one."""
    path = Path(arguments.folder)
    return (path.with_suffix(""), path) if path.suffix.lower() in FORMATS else (path, None)


def _tell(learned: Learned, arguments: argparse.Namespace, written: object) -> None:
    """Print what was found; raise where it is no optimum, after all is said."""
    present(learned, arguments)
    if written:
        say(f"written: {written}")
    if learned.found.no_optimum:
        raise CommandError(learned.found.no_optimum)
