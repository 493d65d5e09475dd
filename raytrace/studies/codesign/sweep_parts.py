"""What the page of a sweep says: whether the paper's focus distances appear, its claims, and tables."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence

from raytrace.pages import grid, shown
from raytrace.studies.codesign.claims import SIMPLE, percent
from raytrace.studies.codesign.conjugates import vignetted
from raytrace.studies.codesign.experiment import lens_at_start
from raytrace.studies.codesign.plain_rays import points
from raytrace.studies.codesign.settings import MODELS, NAMES
from raytrace.studies.codesign.setup import Experiment
from raytrace.studies.codesign.study import PAPER
from raytrace.studies.codesign.sweep import FACTORS, Reading, Row, distinct

_NEAR = 2.0  # m: so close to the paper's number is its number
_GAIN = 0.01  # of the root of the error: a smaller one is none
_POINTS = 5  # per cent, of a rise of the error

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


def verdict(found: Sequence[Reading]) -> str:
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
            f"{metres(one.focus)} ({one.closest})",
            f"**{one.appear_in}**",
        )
        for one in given
    ]
    papers = metres([focus for *_, focus in PAPER.values()])
    fitting = [f"{one.definition} (in {one.appear_in} of {one.readings} readings)" for one in given if one.appears]
    nearer = [f"{one.definition} (in {one.nearer} of {one.readings} readings)" for one in given if one.nearer]
    summary = (
        f"{_chances(distinct(found))} The paper's {papers} m appear, to {_NEAR:g} m, when focus is "
        f"{' or '.join(fitting)}."
        if fitting
        else f"**No.** In no reading do the paper's {papers} m appear, each to {_NEAR:g} m, by no definition of focus."
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


def _chances(found: Sequence[Reading]) -> str:
    """In how many distinct readings the paper's focus distances appear, of how many tried, and in which with a gain."""
    fitting = [one for one in found if any(one.departure(focus) <= _NEAR for focus in DEFINITIONS.values())]
    gains = {one.text: ahead for one in fitting if (ahead := _ahead(one)) >= _GAIN}
    listed = f" ({', '.join(f'{text}: {percent(ahead)}' for text, ahead in gains.items())})" if gains else ""
    papers = " and ".join(percent(PAPER[model][1] / PAPER["gaussian"][1] - 1) for model in SIMPLE)
    return (
        f"**Yes, in {len(fitting)} of {len(found)} readings, in {len(gains)} of them with a gain.** Each reading is "
        f"tried with {len(DEFINITIONS)} definitions of focus. A gain: with DRT PSFs both other lenses err "
        f"{100 * _GAIN:g} % or more above that of Gaussian DRT, in the root of the error{listed}; the paper's losses: "
        f"{papers}."
    )


def _ahead(one: Reading) -> float:
    """Gain of Gaussian DRT's lens over the better one of the simple models, traced, in the root of the error."""
    return math.sqrt((1 + _simple(one)) / (1 + one.penalty("gaussian"))) - 1


OF_FOCUS = (
    "Object distances in m: paraxial conjugate / least RMS spot of the sensor. Shift: of Gaussian DRT's sensor "
    "from that of paraxial optics; negative is nearer to the lens, for objects further away."
)


def scale_table(rows: Sequence[Mapping[str, float | str]]) -> list[str]:
    """Errors and focus for resized pictures, and errors relative to those as they are."""
    of = {(float(one["scale"]), str(one["model"])): one for one in rows}
    scales = sorted({scale for scale, _ in of})
    lines = [
        (
            f"{scale:g}",
            f"{float(of[scale, MODELS[0]]['deviation']):.3f}",
            *(
                f"{float(of[scale, m]['rms_error']):.4f} ({_over(of, scale, m)}), "
                f"{shown(float(of[scale, m]['focus_paraxial_m']), 1)} m"
                for m in MODELS
            ),
        )
        for scale in scales
    ]
    told = (
        "Pictures resized by a factor before patches are cut: their standard deviation in a patch; and by model the "
        "root of the mean square error with its own PSFs, over that of the pictures as they are, and the paraxial "
        "focus. All rows: [scale.csv](codesign/scale.csv)."
    )
    return [grid(("scale", "deviation", *(NAMES[m] for m in MODELS)), lines), told]


def _over(of: Mapping, scale: float, model: str) -> str:
    return percent(float(of[scale, model]["rms_error"]) / float(of[1.0, model]["rms_error"]) - 1)


def beam(given: Experiment) -> list[str]:
    """What the file's semi-diameters leave of the beam on the axis, at the fastest apertures."""
    rows = []
    for aperture in {one.name: one for one in FACTORS}["f_number"].values:
        cut = vignetted(lens_at_start(given.lens, dataclasses.replace(given.settings, f_number=aperture)))
        if cut:
            worst = max(cut, key=lambda one: one.height / one.semi_diameter)
            names = ", ".join(str(one.surface) for one in cut)
            rows.append((f"F/{aperture:g}", names, worst.surface, f"{worst.height:.2f}", f"{worst.semi_diameter:.2f}"))
    if not rows:
        return []
    header = ("aperture", "surfaces that are too small", "the most", "beam's height there (mm)", "semi-diameter (mm)")
    return [
        "## What vignettes",
        grid(header, rows),
        f"Of the beam on the axis from {_distance(given.settings.focus_distance)}, by the semi-diameters of the file. "
        "They are not applied here: all light of the aperture passes.",
    ]


def _distance(millimetres: float) -> str:
    return f"{millimetres / 1e3:g} m" if math.isfinite(millimetres) else "infinity"


ELSEWHERE = "## Where the descent from the start ends at another optimum"
_SHOWN = 12  # readings of those varied together


def elsewhere(one: Reading) -> list[Row]:
    """Rows whose optimum is not the one downhill from the start: by more than a micrometre."""
    return [row for row in one.of.values() if abs(row.sensor_mm - row.downhill_mm) > 1e-3]


def descents(found: Sequence[Reading]) -> str:
    own = {(one.text, row.model): row for one in found if one.is_alone for row in elsewhere(one)}
    rows = [
        (text, NAMES[model], f"{row.sensor_mm:.4f}", f"{row.downhill_mm:.4f}", shown(row.focus_paraxial_m, 1))
        for (text, model), row in own.items()
    ]
    header = ("reading", "model", "sensor (mm)", "downhill from the start (mm)", "focus of the first, paraxial (m)")
    return f"{grid(header, rows)}\n\nTraining goes downhill: what it can reach is the second, not the first."


def combinations(found: Sequence[Reading], of_paper: bool) -> list[str]:
    """The readings nearest to the paper's numbers, or the first ones."""
    conjugate = DEFINITIONS["the paraxial conjugate"]
    nearest = sorted(found, key=lambda one: one.departure(conjugate)) if of_paper else found
    chosen = nearest[:_SHOWN]
    what = "whose paraxial conjugates are nearest to the paper's" if of_paper else "first ones"
    return [
        f"Of {len(found)} readings the {len(chosen)} {what}; the others are in the table of all rows.",
        focus_table(chosen),
        penalty_table(chosen),
    ]


RAYS = "## A few plain rays, by aperture"


def rays_table(found: Sequence[Reading]) -> list[str]:
    """Focus of the traced models by aperture and by how many rays there are, where both were varied together."""
    by_text = {one.text: one for one in found}
    kinds = [(one, value) for one in FACTORS if one.field == "rays" or one.name == "rays" for value in one.values]
    apertures = dict.fromkeys(
        one.text.split(", ")[0] for one in found if one.text.endswith(" rays") and ", " in one.text
    )
    if not apertures:
        return []
    parts = [RAYS]
    for model in ("gaussian", "drt"):
        lines = [
            (
                aperture,
                *(
                    _pair(by_text[text].of[model]) if text in by_text else "–"
                    for text in (aperture, *(f"{aperture}, {factor.text.format(n)}" for factor, n in kinds))
                ),
            )
            for aperture in apertures
        ]
        header = (NAMES[model], "all light", *(factor.text.format(n) for factor, n in kinds))
        parts.append(grid(header, lines))
    *most, last = (points("hexapolar", int(n)).shape[1] for factor, n in kinds if factor.name == "hexapolar")
    told = (
        "Focus of the optimum in m: paraxial conjugate / least RMS spot. Hexapolar: the least whole rings with as many "
        f"rays, {', '.join(map(str, most))} and {last}."
    )
    return [*parts, told]


def _rise(one: Reading, model: str) -> float:
    """Relative rise of the root mean square error from a model's own PSFs to DRT PSFs."""
    row = one.of[model]
    return math.sqrt(row.error_drt / row.error) - 1


def _paper_rise(model: str) -> float:
    before, after, _ = PAPER[model]
    return after / before - 1


def _papers(models: Sequence[str]) -> str:
    return " and ".join(percent(_paper_rise(model)) for model in models)


#: Claims of the paper: (text, whether it holds in a reading, figures over all of them).
_CLAIMS: tuple[tuple[str, Callable[[Reading], bool], Callable[[Sequence[Reading]], str]], ...] = (
    (
        "paraxial and Fourier optics agree to 2 m",
        lambda one: _apart(one) <= _NEAR,
        lambda found: f"apart by {_range(map(_apart, found), lambda metres: f'{shown(metres, 1)} m')}",
    ),
    (
        "Gaussian DRT focuses nearer than both, by paraxial conjugates",
        lambda one: _nearer_by(one) > 0,
        lambda found: f"nearer by {_range(map(_nearer_by, found), lambda metres: f'{_signed(metres)} m')}",
    ),
    (
        f"traced, the simple models err {_papers(SIMPLE)} more, to {_POINTS} points",
        lambda one: all(abs(_rise(one, model) - _paper_rise(model)) <= _POINTS / 100 for model in SIMPLE),
        lambda found: " and ".join(_range((_rise(one, model) for one in found), percent) for model in SIMPLE),
    ),
    (
        f"traced, Gaussian DRT errs {_papers(('gaussian',))} more, to 1 point",
        lambda one: abs(_rise(one, "gaussian") - _paper_rise("gaussian")) <= 0.01,
        lambda found: _range((_rise(one, "gaussian") for one in found), percent),
    ),
    (
        "with DRT PSFs the lens of Gaussian DRT errs less than both others",
        lambda one: one.penalty("gaussian") < _simple(one),
        lambda found: _least_ahead(min(found, key=lambda one: _simple(one) - one.penalty("gaussian"))),
    ),
)


def claims_table(found: Sequence[Reading]) -> str:
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


def _nearer_by(one: Reading) -> float:
    """By how much the lens of Gaussian DRT is focused nearer than the nearer simple one, paraxial conjugates in m."""
    return min(one.of[model].focus_paraxial_m for model in SIMPLE) - one.of["gaussian"].focus_paraxial_m


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


def focus_table(found: Sequence[Reading]) -> str:
    header = ("reading", *(NAMES[model] for model in MODELS), "shift (µm)")
    return grid(
        header, [(one.text, *(_pair(one.of[model]) for model in MODELS), f"{_shift(one):+.0f}") for one in found]
    )


def penalty_table(found: Sequence[Reading]) -> str:
    header = ("reading", *(NAMES[model] for model in MODELS))
    return grid(header, [(one.text, *(percent(one.penalty(model)) for model in MODELS)) for one in found])


def _pair(row: Row) -> str:
    return f"{shown(row.focus_paraxial_m, 1)} / {shown(row.focus_rms_m, 1)}"


def metres(distances: Sequence[float]) -> str:
    return ", ".join(shown(one, 1) for one in distances)


def _signed(value: float) -> str:
    return f"{value:+.1f}" if math.isfinite(value) else "∞" if value > 0 else "-∞"


def spoken(names: Sequence[str]) -> str:
    known = {
        **{"f_number": "aperture", "normalise": "normalisation", "spread": "distances"},
        **{"rays": "Sobol rays", "hexapolar": "hexapolar rays"},
    }
    said = [known.get(name, name) for name in names]
    return f"{', '.join(said[:-1])} and {said[-1]}"
