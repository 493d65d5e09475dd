"""`raytrace codesign`: one model; `codesign compare` and `codesign sweep` are in files of their own."""

import argparse
import dataclasses
import importlib
import json
import math
from pathlib import Path

from raytrace.camera.limits import Limits
from raytrace.cli.door import CommandError, print_json, say
from raytrace.cli.options import did_you_mean
from raytrace.files import write_atomically
from raytrace.formats import FORMATS, read_lens, write_lens
from raytrace.shards import processes, share
from raytrace.studies.codesign.closed_form import power_spectrum
from raytrace.studies.codesign.experiment import LENS, STEPS, Outcome, variables
from raytrace.studies.codesign.optima import Optimum, closed_form
from raytrace.studies.codesign.optima import document as optimum_document
from raytrace.studies.codesign.setup import (
    Experiment,
    experiment,
    plain,
    refuse_too_few,
    settings_of,
    settings_without_network,
    train_run,
)

#: The forms of the command by their word, and the options that only some of them know.
_FORMS = {
    "": "codesign LENS",
    "compare": "codesign compare LENS",
    "sweep": "codesign sweep LENS",
}
_MODULES = {"compare": "compare", "sweep": "sweep_command"}
_BELONG = {
    "models": ("compare",),
    "seeds": ("compare",),
    "report_only": ("compare",),
    "docs": ("compare", "sweep"),
    "model": ("",),
    "seed": ("",),
    "resume": ("", "compare"),
}


def codesign(arguments: argparse.Namespace) -> None:
    """One model; with the word `compare` all of them; with `sweep` the closed form by what the paper leaves open."""
    *before, arguments.lens = arguments.words
    form = before[0] if before else ""
    if len(before) > 1 or form not in _FORMS:
        raise CommandError(
            f"{' '.join(arguments.words)}: expected LENS, compare LENS or sweep LENS{did_you_mean(form, _FORMS)}"
        )
    for name, forms in _BELONG.items():
        if form not in forms and getattr(arguments, name) not in (None, False):
            raise CommandError(
                f"--{name.replace('_', '-')} belongs to {' and '.join(_FORMS[known] for known in forms)}"
            )
    if form and arguments.loss == "spectral":
        raise CommandError("--loss spectral belongs to codesign LENS; compare and sweep use the closed form anyway")
    work = _spectral if arguments.loss == "spectral" else _train
    if form:
        work = getattr(importlib.import_module(f"raytrace.studies.codesign.{_MODULES[form]}"), form)
    with processes():
        work(arguments)


def _train(arguments: argparse.Namespace) -> None:
    if not arguments.output:
        raise CommandError("no folder to keep the run in: give -o FOLDER")
    folder, lens_file = _outputs(arguments)
    begun = folder / STEPS[0] / "settings.json"
    if arguments.resume and not begun.exists():
        raise CommandError(f"{folder}: no run was begun here; leave out --resume to begin one")
    settings = settings_of(arguments, begun)
    given = experiment(arguments, settings)
    refuse_too_few(given)
    found = train_run(given, settings, folder, f"{settings.model}, seed {settings.seed}")
    if arguments.json:
        document = {
            "settings": dataclasses.asdict(settings),
            **given.about,
            "limits": dataclasses.asdict(limits(given)),
            **dataclasses.asdict(found),
        }
        print_json(plain(document))
    else:
        _print_outcome(found, limits(given))
    if lens_file and not share().rank:
        write_lens(read_lens(folder / LENS, catalogs=given.catalogs), lens_file, catalogs=given.catalogs)
    say(f"written: {folder / 'outcome.json'}, {lens_file or folder / LENS}")
    refuse_none(found)


def _outputs(arguments: argparse.Namespace) -> tuple[Path, Path | None]:
    """The folder of -o, and the lens file where it names one."""
    path = Path(arguments.output)
    return (path.with_suffix(""), path) if path.suffix.lower() in FORMATS else (path, None)


def limits(given: Experiment) -> Limits:
    """What thicknesses are held to."""
    return variables(given.lens, given.settings).limits


def refuse_none(found: Outcome | Optimum) -> None:
    """Raise where no optimum was found, after all that was found is said."""
    if found.no_optimum:
        raise CommandError(found.no_optimum)


def _print_outcome(found: Outcome, held: Limits) -> None:
    print(f"{found.model} PSFs, seed {found.seed}")
    _print_lens(found, held)
    print("L1 loss of test pictures:")
    print(f"  after step 1, with its own PSFs  {found.l1_joint:.5f}")
    print(f"  the same network with DRT PSFs   {found.l1_before:.5f}")
    print(f"  after step 2, with DRT PSFs      {found.l1_drt:.5f}")
    print(f"{'object at':>12} {'L1 with DRT PSFs':>18}")
    for distance, loss in found.by_distance.items():
        print(f"{float(distance) / 1e3:>10g} m {loss:>18.5f}")


def _print_lens(found: Outcome | Optimum, held: Limits) -> None:
    print(f"sensor at {found.sensor_mm:.4f} mm")
    for name, value in found.variables.items():
        if name != "sensor":
            print(f"{name} = {value:.7g} {'1/mm' if name.startswith('curvature') else ''}".rstrip())
    print(f"in focus: {_metres(found.focus_paraxial_m)} (paraxial), {_metres(found.focus_rms_m)} (least RMS spot)")
    print(f"penalty {found.penalty:.6g} mm² beside the loss; thicknesses: {_spelled(held)}")


def _spelled(held: Limits) -> str:
    """Limits in words."""
    ranges = (held.glass, held.air)
    glass, air = (f"{low:.4g}" + (f" to {high:.4g}" if math.isfinite(high) else " at least") for low, high in ranges)
    return f"glass {glass}, its edge {held.edge:.4g} at least, air {air} (mm)"


def _metres(distance: float) -> str:
    return f"{distance:.2f} m" if math.isfinite(distance) else "infinity"


def _spectral(arguments: argparse.Namespace) -> None:
    settings = settings_without_network(arguments)
    given = experiment(arguments, settings)
    found = closed_form(given.lens, settings, spectrum_of(given))
    for name in found.at_end:
        say(f"warning: {name} stands at an end of its bounds, and the loss still falls beyond it")
    document = plain(
        {
            "settings": dataclasses.asdict(settings),
            **given.about,
            "limits": dataclasses.asdict(limits(given)),
            **optimum_document(found),
        }
    )
    written = _write_optimum(found, document, given, arguments) if arguments.output else ()
    if arguments.json:
        print_json(document)
    else:
        print(f"{found.model} PSFs, mean square error of a pixel behind the best linear filter")
        print(f"{'evaluation':>12} {'error':>12} {'penalty, mm²':>13}")
        for evaluation, (error, penalty) in enumerate(zip(found.course, found.penalties, strict=True), 1):
            print(f"{evaluation:>12} {error:>12.8f} {penalty:>13.6g}")
        _print_lens(found, limits(given))
        print(f"error of this lens: {found.error:.8f} with its own PSFs, {found.error_drt:.8f} with DRT PSFs")
    for path in written:
        say(f"written: {path}")
    refuse_none(found)


def _write_optimum(found: Optimum, document: dict, given: Experiment, arguments: argparse.Namespace) -> list[Path]:
    """The lens of -o LENS.zmx, or folder with the lens and the document; what was written."""
    folder, lens_file = _outputs(arguments)
    if lens_file:
        write_lens(found.lens, lens_file, catalogs=given.catalogs)
        return [lens_file]
    folder.mkdir(parents=True, exist_ok=True)
    write_lens(found.lens, folder / LENS, catalogs=given.catalogs)
    path = folder / "spectral.json"
    write_atomically(path, lambda file: file.write(json.dumps(document, indent=1).encode()))
    return [path, folder / LENS]


def spectrum_of(given: Experiment):
    """Power spectrum of the training pictures, at the size of a patch with its margin."""
    settings = given.settings
    return power_spectrum(given.train, settings.patch + settings.size - 1, crops=settings.crops, seed=settings.seed)
