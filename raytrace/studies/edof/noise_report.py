"""What `raytrace wave noise` finds: as text, as a document, as a page."""

import argparse
from pathlib import Path

from raytrace.cli.door import CommandError
from raytrace.studies.edof.noise import (
    Unit,
    units,
)
from raytrace.studies.edof.noise_command import Settings
from raytrace.studies.edof.report import contents_of, learn
from raytrace.studies.edof.table import ROWS
from raytrace.studies.edof.training import EdofCamera
from raytrace.studies.pictures import Pictures
from raytrace.words import did_you_mean


def noise(arguments: argparse.Namespace):
    settings = Settings.of(vars(arguments))
    unknown = sorted(set(arguments.rows or ()) - set(ROWS))
    if unknown:
        meant = did_you_mean(unknown[0], ROWS)
        raise CommandError(f"--rows {' '.join(unknown)}: expected {', '.join(ROWS)}{meant}")
    rows = [name for name in ROWS if (name in arguments.rows if arguments.rows else not ROWS[name].is_extra)]
    root = Path(arguments.folder)
    contents, train = contents_of(arguments)
    for unit in units(rows, settings.noise, settings.starts):
        learned_camera(unit, settings, train, root)


def learned_camera(unit: Unit, settings: Settings, train: Pictures, root: Path) -> EdofCamera:
    label = f"{ROWS[unit.row].title}, noise {unit.noise:g}, start {unit.start}"
    return learn(unit.settings(settings.steps), unit.world(), train, unit.folder(root), label)
