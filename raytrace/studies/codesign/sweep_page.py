"""What a sweep answers: as text, as a document, as a page of Markdown.

The question: in which reading of the experiment, and by which definition of focus, is the lens of Gaussian DRT focused
nearer than that of paraxial optics, as the paper found?
"""

import argparse
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

from raytrace.cli.door import CommandError, say
from raytrace.cli.progress import progress
from raytrace.cli.run import present
from raytrace.files import table
from raytrace.imaging.training import Run, share
from raytrace.maths.result import Result, plain
from raytrace.pages import picture
from raytrace.studies.codesign import optima
from raytrace.studies.codesign.claims import is_of_paper
from raytrace.studies.codesign.closed_form import SPECTRUM_COLUMNS, spectrum_rows
from raytrace.studies.codesign.kept import Kept
from raytrace.studies.codesign.setup import Experiment, experiment, settings_of
from raytrace.studies.codesign.sweep import (
    COLUMNS,
    COMBINED,
    SCALE_COLUMNS,
    SCALES,
    TOGETHER,
    Reading,
    Row,
    by_scale,
    distinct,
    readings,
)
from raytrace.studies.codesign.sweep import sweep as sweep_all
from raytrace.studies.codesign.sweep_parts import (
    ELSEWHERE,
    OF_FOCUS,
    answers,
    beam,
    claims_table,
    combinations,
    descents,
    elsewhere,
    focus_table,
    metres,
    penalty_table,
    rays_table,
    scale_table,
    spoken,
    verdict,
)
from raytrace.studies.publish import publish


@dataclasses.dataclass(frozen=True)
class Sweep(Result):
    """The optima of all cases.

    of_paper: whether the lens is the paper's, so that the found numbers stand beside its and answer its claims.
    scales: rows of `by_scale`.
    """

    rows: list[Row]
    given: Experiment
    of_paper: bool
    scales: Sequence[Mapping[str, float | str]] = ()

    FIGURE = "studies.codesign.figures.sweep_figure"

    @cached_property
    def readings(self) -> list[Reading]:
        return readings(self.rows)

    def document(self) -> dict:
        return plain(
            {
                "settings": dataclasses.asdict(self.given.settings),
                **self.given.about,
                "rows": [dataclasses.asdict(row) for row in self.rows],
                "scales": list(self.scales),
                "answers": [dataclasses.asdict(one) for one in answers(self.readings)],
            }
        )

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        sizes = ("sensor mm", "paraxial m", "RMS m", "error DRT")
        yield "{:>12} {:<42} {:<9} {:>10} {:>11} {:>8} {:>11}".format("factor", "value", "model", *sizes)
        for row in self.rows:
            yield (
                f"{row.factor:>12} {row.value:<42} {row.model:<9} {row.sensor_mm:>10.4f} {row.focus_paraxial_m:>11.2f} "
                f"{row.focus_rms_m:>8.2f} {row.error_drt:>11.8f}"
            )
        for one in answers(self.readings):
            nearer = f"{one.definition}: Gaussian DRT focused nearer than paraxial in {one.nearer} of {one.readings}"
            closest = f"; closest to the paper {metres(one.focus)} m ({one.closest})"
            yield f"{nearer} readings{closest if self.of_paper else ''}"

    def parts(self) -> list[str]:
        """The page."""
        found, lens = self.readings, self.given.name
        alone = [one for one in found if one.factor != COMBINED]
        together = [one for one in distinct(found) if one.factor == COMBINED]
        answer = ["## Do the three focus distances of the paper appear together?", verdict(found)]
        lines = "; thin lines: the numbers of the paper" if self.of_paper else ""
        consequences = [
            "## What follows for the paper's claims",
            claims_table(distinct(found)),
            "Errors here are roots of mean squares behind linear filters; the paper's are mean absolute errors behind "
            "networks. More: with DRT PSFs and the filter that is best for them, over that with the model's own PSFs.",
        ]
        return [
            "# Co-design: the optimum of the best linear filter, by all that the paper leaves open",
            " ".join([f"    raytrace codesign sweep {lens} --data DIR --docs docs", *self.given.settings.words()]),
            f"The optimum of the closed form for {lens} and the spectrum of {len(self.given.train)} {self.given.kind}: "
            "the sensor at which the best linear filter that does not know the object distance errs least, the best "
            "of several descents. Each factor is varied alone (ρ, the σ of the paraxial model over the radius of its "
            "blur, is of that model only; a few plain rays instead of all light are of the traced models only), then "
            f"{', '.join(f'{spoken(names)} together' for names in TOGETHER)}. All rows: "
            "[sweep.csv](codesign/sweep.csv); the spectrum: [spectrum.csv](codesign/spectrum.csv). The experiment is "
            "that of [codesign.md](codesign.md).",
            *(answer if self.of_paper else []),
            picture("codesign/sweep.png", f"Focus distance of the optimum by factor, model and definition{lines}."),
            *(consequences if self.of_paper else []),
            "## Focus of the optimum",
            focus_table(alone),
            OF_FOCUS,
            "## What each lens costs with DRT PSFs",
            penalty_table(alone),
            *([ELSEWHERE, descents(found)] if any(map(elsewhere, found)) else []),
            *(["## The size of the pictures", *scale_table(self.scales)] if self.scales else []),
            *rays_table(found),
            *(beam(self.given) if self.given.lens is not None else []),
            *(["## Varied together", *combinations(together, self.of_paper)] if together else []),
        ]


def sweep(arguments: argparse.Namespace) -> None:
    """Find all optima, then write table, figure and page; with -o they are kept, and not sought again."""
    if not (arguments.docs or arguments.folder):
        raise CommandError("no folder to write to: give --docs DOCS or -o FOLDER")
    given = experiment(arguments, settings_of(arguments), smallest=min(SCALES))
    spectrum = given.spectrum()
    kept = _kept(given, arguments.folder) if arguments.folder and not share().rank else {}
    rows = sweep_all(
        given.lens, given.settings, spectrum, progress=lambda cases: progress(cases, "case"), kept=kept.get(1.0)
    )
    if share().rank:
        return  # the first process writes
    scales = by_scale(given.lens, given.settings, given.spectrum, kept=kept)
    found, docs = Sweep(rows, given, is_of_paper(given.lens), scales), Path(arguments.docs or arguments.folder)
    tables = {
        "sweep.csv": table(rows, COLUMNS),
        "scale.csv": table(scales, SCALE_COLUMNS),
        "spectrum.csv": table(spectrum_rows(spectrum), SPECTRUM_COLUMNS),
    }
    publish(docs / "codesign_sweep.md", "codesign", found.parts(), tables=tables, figures={"sweep.png": found.plot()})
    present(found, arguments)
    for row in rows:
        if row.no_optimum:
            say(f"warning: {row.factor} {row.value}, {row.model}: {row.no_optimum}")
    if all(row.no_optimum for row in rows):
        raise CommandError("no case has an optimum; see the warnings, and choose other --near, --far, --bounds")


def _kept(given: Experiment, folder: str) -> dict[float, Kept]:
    """Optima of this lens and these pictures in a folder, by the scale of the pictures. Raises OtherSettings for one of
    others."""
    own = Run(folder, given.about).folder
    files = {scale: own / ("optima.jsonl" if scale == 1 else f"optima_{scale:g}.jsonl") for scale in SCALES}
    return {scale: Kept(file, optima.COLUMNS) for scale, file in files.items()}
