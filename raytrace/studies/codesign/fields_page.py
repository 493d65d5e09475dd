"""What the field does to the choice of a lens: optima over fields, as text, document, tables and page."""

import argparse
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from raytrace.cli.door import CommandError, say
from raytrace.cli.progress import progress
from raytrace.cli.run import present
from raytrace.files import table
from raytrace.imaging.training import Run, share
from raytrace.maths.result import Result, plain
from raytrace.pages import grid, machine, measured, shown
from raytrace.shards import torch_threads
from raytrace.studies.codesign.claims import percent
from raytrace.studies.codesign.fields import (
    COLUMNS,
    ENERGY_COLUMNS,
    FOUND,
    TIME_COLUMNS,
    Row,
    camera_at,
    energies,
    times,
)
from raytrace.studies.codesign.fields import fields as fields_all
from raytrace.studies.codesign.kept import Kept
from raytrace.studies.codesign.settings import MODELS, NAMES
from raytrace.studies.codesign.setup import Experiment, experiment, settings_of
from raytrace.studies.publish import publish

_UNITS = {"angle": "degrees"}


@dataclasses.dataclass(frozen=True)
class Fields(Result):
    """The optima, the energies in windows at DRT's, and the times of PSFs on a machine."""

    rows: Sequence[Row]
    energies: Sequence[Mapping[str, float]]
    times: Sequence[Mapping[str, float | str]]
    given: Experiment
    machine: Mapping[str, str | int]

    def document(self) -> dict:
        settings, rows = dataclasses.asdict(self.given.settings), [row.document() for row in self.rows]
        more = {"energies": list(self.energies), "times": list(self.times)}
        return plain({"settings": settings, **self.given.about, "rows": rows, **more})

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        for row in self.rows:
            at = " ".join(f"{one:.8f}" for one in row.by_field)
            yield (
                f"{row.window} pixels, {_fields(row.fields):<12} {row.model:<9} sensor {row.sensor_mm:.4f} mm  "
                f"error {row.error:.8f}  DRT {row.error_drt:.8f}  by field {at}"
            )

    def parts(self) -> list[str]:
        """The page."""
        settings, size = self.given.settings, self.given.settings.size
        return [
            "# Co-design over the field",
            " ".join([f"    raytrace codesign fields {self.given.name} --data DIR --docs docs", *settings.words()]),
            "The experiment of [codesign.md](codesign.md) in closed form, with objects at the fields "
            f"{_fields(settings.fields)} ({_UNITS.get(self.given.lens.fields.kind, 'mm')}) and one filter for all "
            "distances and fields; PSFs are about their chief ray. "
            f"{self.given.name}, {settings.near / 1e3:g} to {settings.far / 1e3:g} m, the spectrum of "
            f"{len(self.given.train)} {self.given.kind}.",
            "## Optima",
            self._optima(),
            "Focus: object distance in m, of paraxial rays / of least RMS spot on the axis. Errors: mean square of a "
            "pixel behind the best linear filter; more: with DRT PSFs, over the least of all models. All rows: "
            "[off_axis.csv](codesign/off_axis.csv).",
            f"## Error by field, {size} pixels",
            self._by_field(),
            "With DRT PSFs and the filter that is best for all fields.",
            "## What windows hold",
            self._energies(),
            f"Part of the light through the entrance pupil, at DRT's optimum of {size} pixels: of an object at "
            f"{settings.near / 1e3:g} m (mean over all distances). "
            "[off_axis_energy.csv](codesign/off_axis_energy.csv).",
            "## Time of PSFs",
            self._times(),
            f"ms. {measured('the PSFs of an equal part of a batch of 32 and their derivatives', self.machine)}. "
            "[off_axis_time.csv](codesign/off_axis_time.csv).",
        ]

    def _optima(self) -> str:
        header = ("window", "fields", "model", "sensor (mm)", "focus (m)", "error, own PSFs", "DRT PSFs", "more")
        least = {}
        for row in self.rows:
            least[_place(row)] = min(row.error_drt, least.get(_place(row), row.error_drt))
        lines = [
            (
                *(row.window, _fields(row.fields), NAMES[row.model], f"{row.sensor_mm:.4f}"),
                f"{shown(row.focus_paraxial_m, 1)} / {shown(row.focus_rms_m, 1)}",
                *(f"{row.error:.6f}", f"{row.error_drt:.6f}", _fine(row.error_drt / least[_place(row)] - 1)),
            )
            for row in self.rows
        ]
        return grid(header, lines)

    def _by_field(self) -> str:
        own = [row for row in self.rows if _place(row) == (self.given.settings.size, self.given.settings.fields)]
        lines = [
            (NAMES[row.model], *(f"{one:.6f}" for one in row.by_field), f"{sum(row.by_field) / len(row.by_field):.6f}")
            for row in own
        ]
        return grid(("lens of", *map(_degrees, self.given.settings.fields), "mean"), lines)

    def _energies(self) -> str:
        of = {(float(one["field"]), int(one["pixels"])): one for one in self.energies}
        sizes = sorted({size for _, size in of})
        lines = [
            (
                _degrees(field),
                *(
                    f"{float(of[field, n]['energy_nearest']):.2f} ({float(of[field, n]['energy_mean']):.2f})"
                    for n in sizes
                ),
            )
            for field in dict.fromkeys(field for field, _ in of)
        ]
        return grid(("field", *(f"{size} pixels" for size in sizes)), lines)

    def _times(self) -> str:
        of = {(one["model"], float(one["field"])): float(one["milliseconds"]) for one in self.times}
        places = list(dict.fromkeys(field for _, field in of))
        lines = [
            (NAMES[m], *(f"{of[m, y]:.1f}" for y in places), f"{sum(of[m, y] for y in places):.1f}") for m in MODELS
        ]
        return grid(("model", *map(_degrees, places), "all"), lines)


def _place(row: Row) -> tuple[int, tuple[float, ...]]:
    return row.window, row.fields


def _degrees(field: float) -> str:
    return f"{field:g}"


def _fields(given: Sequence[float]) -> str:
    return ", ".join(map(_degrees, given))


def _fine(part: float) -> str:
    return percent(part) if part >= 1e-2 else f"{100 * part:+.2f} %"


def fields(arguments: argparse.Namespace) -> None:
    """Find all optima, then write tables and page; with -o optima are kept, and not sought again."""
    if not (arguments.docs or arguments.folder):
        raise CommandError("no folder to write to: give --docs DOCS or -o FOLDER")
    settings = settings_of(arguments)
    if not any(settings.fields) or settings.vary != "sensor":
        raise CommandError("no field beside the axis: give --field 0 9.8 14, and leave out --vary")
    given, folder = experiment(arguments, settings), arguments.folder
    kept = Kept(Run(folder, given.about).folder / "fields.jsonl", FOUND) if folder and not share().rank else None
    rows = fields_all(
        given.lens,
        settings,
        lambda own: dataclasses.replace(given, settings=own).spectrum(),
        progress=lambda cases: progress(cases, "case"),
        kept=kept,
    )
    if share().rank:
        return  # the first process writes
    with torch_threads(1):  # processor time is the sum over threads
        taken, about = times(given.lens, settings), machine()
    found = Fields(rows, _energies(given, rows), taken, given, about)
    documents = [row.document() for row in rows]
    names = (*COLUMNS, *(name for name in documents[0] if name.startswith("error_drt_at_")))
    tables = {
        "off_axis.csv": table([{name: one.get(name) for name in names} for one in documents], names),
        "off_axis_energy.csv": table(found.energies, ENERGY_COLUMNS),
        "off_axis_time.csv": table(found.times, TIME_COLUMNS),
    }
    page = Path(arguments.docs or folder) / "codesign_off_axis.md"
    publish(page, "codesign", found.parts(), tables=tables, figures={})
    present(found, arguments)
    for row in rows:
        if row.no_optimum:
            say(f"warning: {row.window} pixels, {_fields(row.fields)}, {row.model}: {row.no_optimum}")


def _energies(given: Experiment, rows: Sequence[Row]) -> list[dict[str, float]]:
    """In windows from the usual size to that of the settings, at DRT's optimum."""
    settings = dataclasses.replace(given.settings, model="drt", rays=None, drt_rays=None, normalise="energy")
    (drt,) = (row for row in rows if row.model == "drt" and _place(row) == (settings.size, settings.fields))
    sizes = [*range(min(21, settings.size), settings.size, 10), settings.size]
    return energies(camera_at(given.lens, drt.sensor_mm, settings), sizes, spread=settings.spread)
