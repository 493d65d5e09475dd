"""What a sweep answers: as text, as a document, as a page of Markdown.

The question: in which reading of the experiment, and by which definition of focus, is the lens of Gaussian DRT focused
nearer than that of paraxial optics, as the paper found?
"""

import argparse
import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path

from raytrace.camera.training import Run, share
from raytrace.cli.door import CommandError, say
from raytrace.cli.progress import progress
from raytrace.cli.run import present
from raytrace.files import table
from raytrace.maths.result import Result, plain
from raytrace.pages import grid, picture, shown
from raytrace.studies.codesign.claims import SIMPLE, is_of_paper, percent
from raytrace.studies.codesign.closed_form import SPECTRUM_COLUMNS, spectrum_rows
from raytrace.studies.codesign.settings import MODELS, NAMES
from raytrace.studies.codesign.setup import Experiment, experiment, settings_of
from raytrace.studies.codesign.study import PAPER
from raytrace.studies.codesign.sweep import COLUMNS, COMBINED, TOGETHER, Kept, Reading, Row, distinct, readings
from raytrace.studies.codesign.sweep import sweep as sweep_all
from raytrace.studies.publish import publish

_NEAR = 2.0  # m: so close to the paper's number is its number

#: What a focus distance may be, and how it reads.
DEFINITIONS: dict[str, Callable[[Row], float]] = {
    "the paraxial conjugate": lambda row: row.focus_paraxial_m,
    "the least RMS spot": lambda row: row.focus_rms_m,
    "each model's own": lambda row: row.focus_paraxial_m if row.model in SIMPLE else row.focus_rms_m,
}


@dataclasses.dataclass(frozen=True)
class Answer:
    """Over all readings, by one definition of focus: is Gaussian DRT nearer than paraxial optics, as in the paper?

    least, greatest: focus of Gaussian DRT minus that of paraxial optics, m. closest: the reading nearest to the paper's
    three numbers, with its own, of paraxial and Fourier optics and of Gaussian DRT; appears: whether all of them are
    within 2 m of the paper's, and appear_in: in how many readings.
    """

    definition: str
    readings: int
    nearer: int
    least: float
    greatest: float
    closest: str
    focus: tuple[float, ...]
    appears: bool
    appear_in: int


def answers(found: Sequence[Reading]) -> list[Answer]:
    """An answer for each definition of focus."""
    found = distinct(found)
    return [_answer(definition, focus, found) for definition, focus in DEFINITIONS.items()]


def _answer(definition: str, focus: Callable[[Row], float], found: Sequence[Reading]) -> Answer:
    pairs = [(focus(one.of["paraxial"]), focus(one.of["gaussian"])) for one in found]
    shifts = [0.0 if ours == simple else ours - simple for simple, ours in pairs]  # ∞ - ∞ too
    closest = min(found, key=lambda one: one.departure(focus))
    appear_in = sum(one.departure(focus) <= _NEAR for one in found)
    return Answer(
        definition,
        readings=len(found),
        nearer=sum(shift < 0 for shift in shifts),
        least=min(shifts),
        greatest=max(shifts),
        closest=closest.text,
        focus=closest.focus(focus),
        appears=appear_in > 0,
        appear_in=appear_in,
    )


@dataclasses.dataclass(frozen=True)
class Sweep(Result):
    """The optima of all cases.

    of_paper: whether the lens is the paper's, so that the found numbers stand beside its and answer its claims.
    """

    rows: list[Row]
    given: Experiment
    of_paper: bool

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
            closest = f"; closest to the paper {_metres(one.focus)} m ({one.closest})"
            yield f"{nearer} readings{closest if self.of_paper else ''}"

    def parts(self) -> list[str]:
        """The page."""
        found, lens = self.readings, self.given.name
        alone = [one for one in found if one.factor != COMBINED]
        together = [one for one in distinct(found) if one.factor == COMBINED]
        verdict = ["## Do the three focus distances of the paper appear together?", _verdict(found)]
        lines = "; thin lines: the numbers of the paper" if self.of_paper else ""
        consequences = [
            "## What follows for the paper's claims",
            _claims(distinct(found)),
            "A loss here is of the mean square error with DRT PSFs, beside the least of the four lenses, behind linear "
            "filters; the paper's are of the mean absolute error behind networks.",
        ]
        return [
            "# Co-design: the optimum of the best linear filter, by all that the paper leaves open",
            " ".join([f"    raytrace codesign sweep {lens} --data DIR --docs docs", *self.given.settings.words()]),
            f"The optimum of the closed form for {lens} and the spectrum of {len(self.given.train)} {self.given.kind}: "
            "the sensor at which the best linear filter that does not know the object distance errs least, the best "
            "of several descents. Each factor is varied alone (ρ, the σ of the paraxial model over the radius of its "
            "blur, is of that model only; a few plain rays instead of all light are of the traced models only), then "
            f"{' and '.join(_words(names) for names in TOGETHER)} together. All rows: "
            "[sweep.csv](codesign/sweep.csv); the spectrum: [spectrum.csv](codesign/spectrum.csv). The experiment is "
            "that of [codesign.md](codesign.md).",
            *(verdict if self.of_paper else []),
            picture("codesign/sweep.png", f"Focus distance of the optimum by factor, model and definition{lines}."),
            *(consequences if self.of_paper else []),
            "## Focus of the optimum",
            _focus_table(alone),
            _FOCUS_TABLE,
            "## What each lens costs with DRT PSFs",
            _penalty_table(alone),
            *([_FURTHER, _descents(found)] if any(map(_further, found)) else []),
            *(["## Varied together", *_combinations(together, self.of_paper)] if together else []),
        ]


def sweep(arguments: argparse.Namespace) -> None:
    """Find all optima, then write table, figure and page; with -o they are kept, and not sought again."""
    if not (arguments.docs or arguments.folder):
        raise CommandError("no folder to write to: give --docs DOCS or -o FOLDER")
    given = experiment(arguments, settings_of(arguments))
    spectrum = given.spectrum()
    kept = _kept(given, arguments.folder) if arguments.folder and not share().rank else None
    rows = sweep_all(given.lens, given.settings, spectrum, progress=lambda cases: progress(cases, "case"), kept=kept)
    if share().rank:
        return  # the first process writes
    found, docs = Sweep(rows, given, is_of_paper(given.lens)), Path(arguments.docs or arguments.folder)
    tables = {"sweep.csv": table(rows, COLUMNS), "spectrum.csv": table(spectrum_rows(spectrum), SPECTRUM_COLUMNS)}
    publish(docs / "codesign_sweep.md", "codesign", found.parts(), tables=tables, figures={"sweep.png": found.plot()})
    present(found, arguments)
    for row in rows:
        if row.no_optimum:
            say(f"warning: {row.factor} {row.value}, {row.model}: {row.no_optimum}")
    if all(row.no_optimum for row in rows):
        raise CommandError("no case has an optimum; see the warnings, and choose other --near, --far, --bounds")


def _kept(given: Experiment, folder: str) -> Kept:
    """Optima of this lens and these pictures in a folder. Raises OtherSettings for one of others."""
    return Kept(Run(folder, given.about).folder / "optima.jsonl")


# ---------------------------------------------------------------- parts of the page


def _verdict(found: Sequence[Reading]) -> str:
    given = answers(found)
    header = (
        "focus is", "readings", "Gaussian DRT nearer than paraxial in", "by how much (m)",
        "closest to the paper: paraxial, Fourier, Gaussian DRT (m)", f"all within {_NEAR:g} m in",
    )  # fmt: skip
    lines = [
        (
            one.definition,
            one.readings,
            one.nearer,
            f"{_signed(one.least)} to {_signed(one.greatest)}",
            f"{_metres(one.focus)} ({one.closest})",
            f"**{one.appear_in}**",
        )
        for one in given
    ]
    papers = _metres([focus for *_, focus in PAPER.values()])
    fitting = [f"{one.definition} (in {one.appear_in} of {one.readings} readings)" for one in given if one.appears]
    nearer = [f"{one.definition} (in {one.nearer} of {one.readings} readings)" for one in given if one.nearer]
    summary = f"**{'Yes' if fitting else 'No'}.** " + (
        f"The paper's {papers} m appear, to {_NEAR:g} m, when focus is {' or '.join(fitting)}."
        if fitting
        else f"In no reading do the paper's {papers} m appear, each to {_NEAR:g} m, by no definition of focus."
    )
    if nearer:
        summary += f" Gaussian DRT is the nearer one when focus is {' or '.join(nearer)}."
    else:
        summary += " Gaussian DRT is the nearer one in none."
    return (
        f"{summary}\n\n{grid(header, lines)}\n\nEach model's own: the paraxial conjugate for paraxial and Fourier "
        "optics, which know no other, and the least RMS spot for traced rays. Readings that only repeat another count "
        "once."
    )


_FOCUS_TABLE = (
    "Object distances in m: paraxial conjugate / least RMS spot of the sensor. Shift: of Gaussian DRT's sensor "
    "from that of paraxial optics; negative is nearer to the lens, for objects further away."
)
_FURTHER = "## Where the descent from the start ends at another optimum"
_SHOWN = 12  # readings of those varied together


def _further(one: Reading) -> list[Row]:
    """Rows whose optimum is not the one downhill from the start: by more than a micrometre."""
    return [row for row in one.of.values() if abs(row.sensor_mm - row.downhill_mm) > 1e-3]


def _descents(found: Sequence[Reading]) -> str:
    own = {(one.text, row.model): row for one in found if one.is_alone for row in _further(one)}
    rows = [
        (text, NAMES[model], f"{row.sensor_mm:.4f}", f"{row.downhill_mm:.4f}", shown(row.focus_paraxial_m, 1))
        for (text, model), row in own.items()
    ]
    header = ("reading", "model", "sensor (mm)", "downhill from the start (mm)", "focus of the first, paraxial (m)")
    return f"{grid(header, rows)}\n\nTraining goes downhill: what it can reach is the second, not the first."


def _combinations(found: Sequence[Reading], of_paper: bool) -> list[str]:
    """The readings nearest to the paper's numbers, or the first ones."""
    conjugate = DEFINITIONS["the paraxial conjugate"]
    nearest = sorted(found, key=lambda one: one.departure(conjugate)) if of_paper else found
    chosen = nearest[:_SHOWN]
    what = "whose paraxial conjugates are nearest to the paper's" if of_paper else "first ones"
    return [
        f"Of {len(found)} readings the {len(chosen)} {what}; the others are in the table of all rows.",
        _focus_table(chosen),
        _penalty_table(chosen),
    ]


#: Claims of the paper: (text, whether it holds in a reading, figures over all of them).
_CLAIMS: tuple[tuple[str, Callable[[Reading], bool], Callable[[Sequence[Reading]], str]], ...] = (
    (
        "paraxial and Fourier optics agree to 2 m",
        lambda one: _apart(one) <= 2,
        lambda found: f"apart by {_range(map(_apart, found), lambda metres: f'{shown(metres, 1)} m')}",
    ),
    (
        "Gaussian DRT puts the sensor nearer to the lens than paraxial optics",
        lambda one: _shift(one) < 0,
        lambda found: f"shift {_range(map(_shift, found), '{:+.0f}'.format)} µm",
    ),
    (
        "the simple models lose 10 % or more to DRT",
        lambda one: _simple(one) >= 0.1,
        lambda found: f"the better one {_range(map(_simple, found), percent)}",
    ),
    (
        "Gaussian DRT loses 2 % or less",
        lambda one: one.penalty("gaussian") <= 0.02,
        lambda found: _range((one.penalty("gaussian") for one in found), percent),
    ),
    (
        "Gaussian DRT loses less than both simple models",
        lambda one: one.penalty("gaussian") < _simple(one),
        lambda found: _least_ahead(min(found, key=lambda one: _simple(one) - one.penalty("gaussian"))),
    ),
)


def _claims(found: Sequence[Reading]) -> str:
    """What of the paper's claims holds in how many readings."""
    conjugate = DEFINITIONS["the paraxial conjugate"]
    fitting = [one for one in found if one.departure(conjugate) <= _NEAR]
    rows = [
        (
            text,
            f"{sum(map(holds, found))} of {len(found)}",
            figures(found),
            f"{sum(map(holds, fitting))} of {len(fitting)}",
            figures(fitting) if fitting else "–",
        )
        for text, holds, figures in _CLAIMS
    ]
    where = f"where the three conjugates are the paper's to {_NEAR:g} m"
    return grid(("claim", "holds in", "figures", where, "figures there"), rows)


def _apart(one: Reading) -> float:
    """Focus of the simple models, m."""
    return abs(one.of["fourier"].focus_paraxial_m - one.of["paraxial"].focus_paraxial_m)


def _shift(one: Reading) -> float:
    """The sensor of Gaussian DRT from that of paraxial optics, µm."""
    return 1e3 * (one.of["gaussian"].sensor_mm - one.of["paraxial"].sensor_mm)


def _simple(one: Reading) -> float:
    return min(map(one.penalty, SIMPLE))


def _least_ahead(one: Reading) -> str:
    return f"least ahead: {percent(one.penalty('gaussian'))} beside {percent(_simple(one))} ({one.text})"


def _range(values: Iterable[float], written: Callable[[float], str]) -> str:
    values = list(values)
    return f"{written(min(values))} to {written(max(values))}"


def _focus_table(found: Sequence[Reading]) -> str:
    header = ("reading", *(NAMES[model] for model in MODELS), "shift (µm)")
    return grid(
        header, [(one.text, *(_pair(one.of[model]) for model in MODELS), f"{_shift(one):+.0f}") for one in found]
    )


def _penalty_table(found: Sequence[Reading]) -> str:
    header = ("reading", *(NAMES[model] for model in MODELS))
    return grid(header, [(one.text, *(percent(one.penalty(model)) for model in MODELS)) for one in found])


def _pair(row: Row) -> str:
    return f"{shown(row.focus_paraxial_m, 1)} / {shown(row.focus_rms_m, 1)}"


def _metres(distances: Sequence[float]) -> str:
    return ", ".join(shown(one, 1) for one in distances)


def _signed(value: float) -> str:
    return f"{value:+.1f}" if math.isfinite(value) else "∞"


def _words(names: Sequence[str]) -> str:
    known = {"f_number": "aperture", "normalise": "normalisation", "spread": "distances", "hexapolar": "hexapolar rays"}
    said = [known.get(name, name) for name in names]
    return f"{', '.join(said[:-1])} and {said[-1]}"
