"""What a sweep answers, as a page of Markdown.

The question: in which reading of the experiment, and by which definition of focus, is the lens of Gaussian DRT focused
nearer than that of paraxial optics, as the paper found?
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

from raytrace.studies.codesign.claims import SIMPLE
from raytrace.studies.codesign.experiment import Settings
from raytrace.studies.codesign.page import KEPT, options, shown, table
from raytrace.studies.codesign.study import NAMES, PAPER
from raytrace.studies.codesign.sweep import COMBINED, MODELS, TOGETHER, Reading, Row, distinct, readings

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
    pair of numbers, with its own pair; appears: whether both are within 2 m of the paper's.
    """

    definition: str
    readings: int
    nearer: int
    least: float
    greatest: float
    closest: str
    pair: tuple[float, float]
    appears: bool


def answers(found: Sequence[Reading]) -> list[Answer]:
    """An answer for each definition of focus."""
    found = distinct(found)
    return [_answer(definition, focus, found) for definition, focus in DEFINITIONS.items()]


def _answer(definition: str, focus: Callable[[Row], float], found: Sequence[Reading]) -> Answer:
    pairs = [(focus(one.of["paraxial"]), focus(one.of["gaussian"])) for one in found]
    shifts = [0.0 if ours == simple else ours - simple for simple, ours in pairs]  # ∞ - ∞ too
    papers = PAPER["paraxial"][2], PAPER["gaussian"][2]
    far = [max(abs(one - paper) for one, paper in zip(pair, papers, strict=True)) for pair in pairs]
    closest = min(range(len(far)), key=far.__getitem__)
    return Answer(
        definition,
        readings=len(found),
        nearer=sum(shift < 0 for shift in shifts),
        least=min(shifts),
        greatest=max(shifts),
        closest=found[closest].text,
        pair=pairs[closest],
        appears=far[closest] <= _NEAR,
    )


def page(
    rows: Sequence[Row],
    settings: Settings,
    *,
    lens: str,
    pictures: str,
    folder: str = "codesign",
    kept: str = "",
    of_paper: bool = True,
) -> str:
    """The sweep as a page of Markdown. folder: of table and figure, as the page calls it; kept: text below `KEPT`.

    of_paper: whether the lens is the paper's, so that the found numbers stand beside its and answer its claims.
    """
    found = readings(rows)
    alone = [one for one in found if one.factor != COMBINED]
    together = [one for one in found if one.factor == COMBINED]
    command = " ".join([f"raytrace codesign sweep {lens} --data DIR --docs docs", *options(settings)])
    verdict = ["## Is the lens of Gaussian DRT focused nearer, at 27.3 m beside 33.9 m?", _verdict(found)]
    lines = "; thin lines: the numbers of the paper" if of_paper else ""
    consequences = [
        "## What follows for the paper's claims",
        _claims(distinct(found)),
        "A loss here is of the mean square error with DRT PSFs, beside the least of the four lenses, behind linear "
        "filters; the paper's are of the mean absolute error behind networks.",
    ]
    parts = [
        "# Co-design: the optimum of the best linear filter, by aperture, noise, normalisation and start",
        f"    {command}",
        f"The optimum of the closed form for {lens} and {pictures}: the sensor at which the best linear filter that "
        "does not know the object distance errs least. Each factor is varied alone (ρ, the σ of the "
        "paraxial model over the radius of its blur, is of that model only), "
        f"then {_words(TOGETHER)} together. All rows: [sweep.csv]({folder}/sweep.csv). The experiment is that of "
        "[codesign.md](codesign.md).",
        *(verdict if of_paper else []),
        f"![Focus distance by factor, model and definition.]({folder}/sweep.png)",
        f"*Focus distance of the optimum by factor, model and definition{lines}.*",
        *(consequences if of_paper else []),
        "## Focus of the optimum",
        _focus_table(alone),
        "Object distances in m: paraxial conjugate / least RMS spot of the sensor. Shift: of Gaussian DRT's sensor "
        "from that of paraxial optics; negative is nearer to the lens, for objects further away.",
        "## What each lens costs with DRT PSFs",
        _penalty_table(alone),
        "## Aperture, noise and normalisation together",
        _focus_table(together),
        _penalty_table(together),
        f"{KEPT}\n{kept.strip()}".strip(),
    ]
    return "\n\n".join(parts) + "\n"


def _verdict(found: Sequence[Reading]) -> str:
    given = answers(found)
    header = (
        "focus is", "readings", "Gaussian DRT nearer than paraxial in", "by how much (m)",
        "closest to the paper: paraxial, Gaussian DRT (m)", "within 2 m of both",
    )  # fmt: skip
    lines = [
        (
            one.definition,
            one.readings,
            one.nearer,
            f"{_signed(one.least)} to {_signed(one.greatest)}",
            f"{shown(one.pair[0], 1)}, {shown(one.pair[1], 1)} ({one.closest})",
            f"**{'yes' if one.appears else 'no'}**",
        )
        for one in given
    ]
    fitting = [one.definition for one in given if one.appears]
    nearer = [f"{one.definition} (in {one.nearer} of {one.readings} readings)" for one in given if one.nearer]
    summary = f"**{'Yes' if fitting else 'No'}.** " + (
        f"Both numbers appear when focus is {' or '.join(fitting)}."
        if fitting
        else f"In no reading do both numbers appear within {_NEAR:g} m of the paper's, by no definition of focus."
    )
    if nearer:
        summary += f" Gaussian DRT is the nearer one only when focus is {' or '.join(nearer)}."
    else:
        summary += " Gaussian DRT is the nearer one in none."
    return (
        f"{summary}\n\n{table(header, lines)}\n\nEach model's own: the paraxial conjugate for paraxial and Fourier "
        "optics, which know no other, and the least RMS spot for traced rays."
    )


def _claims(found: Sequence[Reading]) -> str:
    """What of the paper's claims holds in how many readings."""
    apart = [abs(one.of["fourier"].focus_paraxial_m - one.of["paraxial"].focus_paraxial_m) for one in found]
    shifts = [1e3 * (one.of["gaussian"].sensor_mm - one.of["paraxial"].sensor_mm) for one in found]
    simple = [min(one.penalty(model) for model in SIMPLE) for one in found]
    ours = [one.penalty("gaussian") for one in found]
    least = min(range(len(found)), key=lambda i: simple[i] - ours[i])
    lines = [
        ("paraxial and Fourier optics agree to 2 m", [one <= 2 for one in apart], f"apart by {_range(apart, _metres)}"),
        (
            "Gaussian DRT puts the sensor nearer to the lens than paraxial optics",
            [one < 0 for one in shifts],
            f"shift {_range(shifts, '{:+.0f}'.format)} µm",
        ),
        (
            "the simple models lose 10 % or more to DRT",
            [one >= 0.1 for one in simple],
            f"the better one {_range(simple, _percent)}",
        ),
        ("Gaussian DRT loses 2 % or less", [one <= 0.02 for one in ours], _range(ours, _percent)),
        (
            "Gaussian DRT loses less than both simple models",
            [own < other for own, other in zip(ours, simple, strict=True)],
            f"least ahead: {_percent(ours[least])} beside {_percent(simple[least])} ({found[least].text})",
        ),
    ]
    rows = [(text, f"{sum(holds)} of {len(found)}", figures) for text, holds, figures in lines]
    return table(("claim", "holds in", "figures"), rows)


def _range(values: Sequence[float], written: Callable[[float], str]) -> str:
    return f"{written(min(values))} to {written(max(values))}"


def _metres(value: float) -> str:
    return f"{shown(value, 1)} m"


def _percent(part: float) -> str:
    return f"{100 * part:+.1f} %"


def _focus_table(found: Sequence[Reading]) -> str:
    header = ("reading", *(NAMES[model] for model in MODELS), "shift (µm)")
    return table(header, [(one.text, *(_pair(one.of[model]) for model in MODELS), _shift(one)) for one in found])


def _penalty_table(found: Sequence[Reading]) -> str:
    header = ("reading", *(NAMES[model] for model in MODELS))
    return table(header, [(one.text, *(_percent(one.penalty(model)) for model in MODELS)) for one in found])


def _pair(row: Row) -> str:
    return f"{shown(row.focus_paraxial_m, 1)} / {shown(row.focus_rms_m, 1)}"


def _shift(one: Reading) -> str:
    return f"{1e3 * (one.of['gaussian'].sensor_mm - one.of['paraxial'].sensor_mm):+.0f}"


def _signed(value: float) -> str:
    return f"{value:+.1f}" if math.isfinite(value) else "∞"


def _words(names: Sequence[str]) -> str:
    said = [{"f_number": "aperture", "normalise": "normalisation"}.get(name, name) for name in names]
    return f"{', '.join(said[:-1])} and {said[-1]}"
