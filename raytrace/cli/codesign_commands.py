"""`raytrace codesign`: one model; `codesign compare` and `codesign sweep` are in files of their own."""

import argparse
import dataclasses
import importlib
import json
import math
from pathlib import Path

from raytrace.cli.codesign_setup import (
    Experiment,
    experiment,
    plain,
    refuse_too_few,
    settings_of,
    settings_without_network,
    train_run,
)
from raytrace.cli.door import CommandError, print_json, say
from raytrace.design.codesign import STEPS, Outcome
from raytrace.design.optima import Optimum, closed_form
from raytrace.design.optima import document as optimum_document
from raytrace.design.spectral import power_spectrum
from raytrace.files import write_atomically
from raytrace.shards import processes

#: The forms of the command by their word, and the options that only some of them know.
_FORMS = {
    "": "codesign LENS",
    "compare": "codesign compare LENS",
    "sweep": "codesign sweep LENS",
}
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
        raise CommandError(f"{' '.join(arguments.words)}: expected LENS, compare LENS or sweep LENS")
    for name, forms in _BELONG.items():
        if form not in forms and getattr(arguments, name) not in (None, False):
            raise CommandError(
                f"--{name.replace('_', '-')} belongs to {' and '.join(_FORMS[known] for known in forms)}"
            )
    if form and arguments.loss == "spectral":
        raise CommandError("--loss spectral belongs to codesign LENS; compare and sweep use the closed form anyway")
    work = _spectral if arguments.loss == "spectral" else _train
    if form:
        work = getattr(importlib.import_module(f"raytrace.cli.codesign_{form}"), form)
    with processes():
        work(arguments)


def _train(arguments: argparse.Namespace) -> None:
    if not arguments.output:
        raise CommandError("no folder to keep the run in: give -o FOLDER")
    folder = Path(arguments.output)
    begun = folder / STEPS[0] / "settings.json"
    if arguments.resume and not begun.exists():
        raise CommandError(f"{folder}: no run was begun here; leave out --resume to begin one")
    settings = settings_of(arguments, begun)
    given = experiment(arguments, settings)
    refuse_too_few(given)
    found = train_run(given, settings, folder, f"{settings.model}, seed {settings.seed}")
    if arguments.json:
        document = {"settings": dataclasses.asdict(settings), **given.about, **dataclasses.asdict(found)}
        print_json(plain(document))
    else:
        _print_outcome(found)
    say(f"written: {folder / 'outcome.json'}")


def _print_outcome(found: Outcome) -> None:
    print(f"{found.model} PSFs, seed {found.seed}")
    _print_lens(found)
    print("L1 loss of test pictures:")
    print(f"  after step 1, with its own PSFs  {found.l1_joint:.5f}")
    print(f"  the same network with DRT PSFs   {found.l1_before:.5f}")
    print(f"  after step 2, with DRT PSFs      {found.l1_drt:.5f}")
    print(f"{'object at':>12} {'L1 with DRT PSFs':>18}")
    for distance, loss in found.by_distance.items():
        print(f"{float(distance) / 1e3:>10g} m {loss:>18.5f}")


def _print_lens(found: Outcome | Optimum) -> None:
    print(f"sensor at {found.sensor_mm:.4f} mm")
    for name, value in found.variables.items():
        if name != "sensor":
            print(f"{name} = {value:.7g} {'1/mm' if name.startswith('curvature') else ''}".rstrip())
    print(f"in focus: {_metres(found.focus_paraxial_m)} (paraxial), {_metres(found.focus_rms_m)} (least RMS spot)")


def _metres(distance: float) -> str:
    return f"{distance:.2f} m" if math.isfinite(distance) else "infinity"


def _spectral(arguments: argparse.Namespace) -> None:
    settings = settings_without_network(arguments)
    given = experiment(arguments, settings)
    found = closed_form(given.lens, settings, spectrum_of(given))
    document = plain({"settings": dataclasses.asdict(settings), **given.about, **optimum_document(found)})
    if arguments.output:
        path = Path(arguments.output) / "spectral.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, lambda file: file.write(json.dumps(document, indent=1).encode()))
    if arguments.json:
        print_json(document)
    else:
        print(f"{found.model} PSFs, mean square error of a pixel behind the best linear filter")
        print(f"{'evaluation':>12} {'error':>12}")
        for evaluation, error in enumerate(found.course, 1):
            print(f"{evaluation:>12} {error:>12.8f}")
        _print_lens(found)
        print(f"error of this lens: {found.error:.8f} with its own PSFs, {found.error_drt:.8f} with DRT PSFs")
    if arguments.output:
        say(f"written: {path}")


def spectrum_of(given: Experiment):
    """Power spectrum of the training pictures, at the size of a patch with its margin."""
    settings = given.settings
    return power_spectrum(given.train, settings.patch + settings.size - 1, crops=settings.crops, seed=settings.seed)
