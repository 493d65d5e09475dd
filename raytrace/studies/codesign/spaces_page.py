"""What thicknesses within boxes are worth, the focal length held or free: as text, document, table and page."""

import argparse
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

from raytrace.cli.door import CommandError, say
from raytrace.cli.progress import progress
from raytrace.cli.run import present
from raytrace.files import table
from raytrace.imaging.training import Run, share
from raytrace.imaging.variables import parse_bounds
from raytrace.maths.result import Result, plain
from raytrace.pages import grid, shown
from raytrace.studies.codesign.claims import percent
from raytrace.studies.codesign.experiment import lens_at_start, variables
from raytrace.studies.codesign.kept import Kept
from raytrace.studies.codesign.settings import MODELS, NAMES
from raytrace.studies.codesign.setup import Experiment, experiment, lens_of_file, settings_of
from raytrace.studies.codesign.spaces import ALONE, FOUND, Row, best, columns, gains
from raytrace.studies.codesign.spaces import spaces as spaces_all
from raytrace.studies.publish import publish
from raytrace.tracing.paraxial import first_order

_PAGE = "codesign_air_spaces"
#: Pages of the other forms, which have the tables of these names in codesign/.
_TAKEN = ("codesign", "codesign_sweep", "codesign_off_axis", "codesign_retrain")


@dataclasses.dataclass(frozen=True)
class Spaces(Result):
    """The optima in all boxes, of bounds as words; page: its name, without suffix."""

    rows: Sequence[Row]
    boxes: Sequence[str]
    given: Experiment
    page: str = _PAGE

    def document(self) -> dict:
        settings = dataclasses.asdict(self.given.settings)
        rows = [row.document() for row in self.rows]
        return plain({"settings": settings, **self.given.about, "boxes": list(self.boxes), "rows": rows})

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        for row in self.rows:
            at = f"  at its bound: {row.at_bound}" if row.at_bound else ""
            yield (
                f"{_group(row):<28} {row.model:<9} {row.start:<9} sensor {row.sensor_mm:.4f} mm  "
                f"EFL {row.efl_mm:.4f} mm  error {row.error:.8f}  DRT {row.error_drt:.8f}  "
                f"refocused {row.error_refocused:.8f}{at}"
            )

    @property
    def table(self) -> str:
        """The file of all rows, beside the page."""
        return f"{self.page.removeprefix('codesign_')}.csv"

    @property
    def names(self) -> list[str]:
        """Variables beside the sensor."""
        return [name for name in variables(self.given.lens, self.given.settings).names if name != "sensor"]

    def parts(self) -> list[str]:
        """The page."""
        words = [*self.given.settings.words(), *(f"--box {box}" for box in self.boxes)]
        page = [] if self.page == _PAGE else [f"--page {self.page}"]
        return [
            "# Co-design of all air spaces and the sensor",
            " ".join([f"    raytrace codesign spaces {self.given.name} --data DIR --docs docs", *words, *page]),
            self._about(),
            "## Optima",
            self._optima(),
            "mm; focus: object distance in m, of paraxial rays / of least RMS spot. Errors: mean square of a pixel "
            "behind the best linear filter that does not know the distance; refocused: with DRT PSFs, the sensor moved "
            "to where DRT has it behind these thicknesses. **Bold**: at an end of its bounds, the error falling beyond "
            f"it. Of DRT the better of two starts. All rows: [{self.table}](codesign/{self.table}).",
            "## What the boxes are worth",
            self._gains(),
            "Less error than with the sensor alone: with a model's own PSFs; with DRT PSFs; with DRT PSFs and the "
            "sensor refocused, beside DRT's own optimum of the sensor alone.",
            "## DRT from two starts",
            self._starts(),
        ]

    def _about(self) -> str:
        given, settings = self.given, self.given.settings
        lens = lens_at_start(given.lens, settings)
        held = variables(given.lens, settings).held
        boxes = "; ".join(
            f"box {number}: "
            + ", ".join(f"{_spoken(name)} from {low:g} to {high:g}" for name, (low, high) in parse_bounds(box).items())
            for number, box in enumerate(self.boxes, 1)
        )
        return (
            f"The experiment of [codesign.md](codesign.md) in closed form, {given.name} at "
            f"F/{float(first_order(lens).f_number):.3g}, {settings.near / 1e3:g} to {settings.far / 1e3:g} m, the "
            f"spectrum of {len(given.train)} {given.kind}. Variables: the sensor and {_listed(self.names)}; {boxes} "
            f"(mm). Focal length: held at {held.focal_length:.4f} mm, for which {_spoken(held.by.name)} is solved, or "
            "free. Every search begins at the file's thicknesses and the paraxial image of "
            f"{settings.focus_distance / 1e3:g} m, that of DRT also at the optimum of Gaussian DRT in the same box."
        )

    def _optima(self) -> str:
        header = (
            *("varied", "model", "sensor", *(_spoken(name) for name in self.names), "focal length"),
            *("focus (m)", "error, own PSFs", "DRT PSFs", "refocused"),
        )
        lines = [
            (
                _group(row),
                NAMES[row.model],
                f"{row.sensor_mm:.4f}",
                *(_cell(row, name) for name in self.names),
                f"{row.efl_mm:.4f}",
                f"{shown(row.focus_paraxial_m, 1)} / {shown(row.focus_rms_m, 1)}",
                *(f"{error:.6f}" for error in (row.error, row.error_drt, row.error_refocused)),
            )
            for row in best(self.rows)
        ]
        return grid(header, lines)

    def _gains(self) -> str:
        found = {(row.group, row.model): (row, worth) for row, *worth in gains(best(self.rows))}
        groups = dict.fromkeys(group for group, _ in found)
        lines = [
            (_group(found[group, model][0]), NAMES[model], *map(percent, found[group, model][1]))
            for group in groups
            for model in MODELS
        ]
        return grid(("varied", "model", "own PSFs", "DRT PSFs", "refocused"), lines)

    def _starts(self) -> str:
        lines = [
            (
                _group(row),
                _STARTS.get(row.start, row.start),
                *(_cell(row, name) for name in self.names),
                f"{row.sensor_mm:.4f}",
                f"{row.error:.6f}",
            )
            for row in self.rows
            if row.box and row.model == "drt"
        ]
        return grid(("varied", "begun at", *(_spoken(name) for name in self.names), "sensor", "error"), lines)


_STARTS = {"paraxial": "the file's lens", "gaussian": "Gaussian DRT's optimum"}


def _group(row: Row) -> str:
    if not row.box:
        return ALONE
    return f"box {row.box}, focal length {'held' if row.hold else 'free'}"


def _cell(row: Row, name: str) -> str:
    if name not in row.variables:
        return ""
    value = f"{row.variables[name]:.4f}"
    return f"**{value}**" if name in row.at_bound.split() else value


def _spoken(name: str) -> str:
    return name.replace("_", " ")


def _listed(names: Sequence[str]) -> str:
    spoken = [*map(_spoken, names)]
    return f"{', '.join(spoken[:-1])} and {spoken[-1]}" if len(spoken) > 1 else spoken[0]


def spaces(arguments: argparse.Namespace) -> None:
    """Find all optima, then write table and page; with -o they are kept, and not sought again."""
    if not (arguments.docs or arguments.folder):
        raise CommandError("no folder to write to: give --docs DOCS or -o FOLDER")
    page = arguments.page or _PAGE
    if page in (name for taken in _TAKEN for name in (taken, taken.removeprefix("codesign_"))):
        raise CommandError(f"--page {page}: the page or the table of another form; give a name of its own, as {_PAGE}")
    boxes = [" ".join(words) for words in arguments.box or ()]
    if not boxes:
        raise CommandError("no box to search in: give --box thickness_5:13,15 thickness_6:11,13, once for each")
    settings = settings_of(arguments)
    settings, lens = dataclasses.replace(settings, hold=settings.hold or "efl"), lens_of_file(arguments)
    for box in boxes:  # refused before pictures are read
        variables(lens, dataclasses.replace(settings, bounds=f"{settings.bounds} {box}".strip()))
    given = experiment(arguments, settings)
    folder = arguments.folder
    kept = Kept(Run(folder, given.about).folder / "spaces.jsonl", FOUND) if folder and not share().rank else None
    rows = spaces_all(
        given.lens, settings, boxes, given.spectrum(), progress=lambda cases: progress(cases, "case"), kept=kept
    )
    if share().rank:
        return  # the first process writes
    found = Spaces(rows, boxes, given, page)
    documents = [row.document() for row in rows]
    names = columns(rows)
    lines = [{name: one.get(name) for name in names} for one in documents]
    written = Path(arguments.docs or folder) / f"{page}.md"
    publish(written, "codesign", found.parts(), tables={found.table: table(lines, names)}, figures={})
    present(found, arguments)
    for row in rows:
        if row.no_optimum:
            say(f"warning: {_group(row)}, {row.model}: {row.no_optimum}")
