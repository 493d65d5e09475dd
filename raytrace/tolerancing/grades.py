"""Grades: tolerances of every surface, element and gap of a lens from a published table, from limits, or its file.

    radius=0.1% thickness=0.02 element_tilt=0.05      a kind, or a word of WORDS, and its limits ±
    power:2-4=3 irregularity:1=-0.2..0.5              of surfaces alone; a minimum and a maximum
    element_decenter_radial=0.02 wedge_radial=0.01    in a direction that is random, x and y linked
    index=0                                           no such tolerance

GRADES has the figures of each grade and where they are printed.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from raytrace.materials.glass import has_abbe_number, is_air
from raytrace.system.elements import cemented_groups, lens_elements
from raytrace.system.lens import Lens
from raytrace.system.parameter_paths import BadVariables, counted, joined
from raytrace.system.tolerance_data import KINDS, TEST_WAVELENGTH, Compensator, Tolerance
from raytrace.tolerancing.files import tolerances_of
from raytrace.tolerancing.perturbation import check_tolerances
from raytrace.tolerancing.table import BadTolerance, ToleranceTable
from raytrace.tracing.geometry import semi_diameters
from raytrace.words import did_you_mean, option

_CHART = "Optimax Systems, Manufacturing Tolerance Chart"
_GLASS = "ISO 12123"
_MOUNT = "assumed of a bored barrel, of no published grade"


class Figure(NamedTuple):
    """A figure of a grade: the limit ± in `unit`, where it is printed, and fringes that a radius may differ by."""

    limit: float
    source: str
    unit: str = ""
    fringes: float = 0.0


#: Figures of the grades by the words of limits. The chart lists radii as "the larger of" a part and fringes.
GRADES = {
    "commercial": {
        "radius": Figure(0.2, _CHART, "%", 5.0),
        "irregularity": Figure(2.0, _CHART),
        "thickness": Figure(0.15, _CHART),
        "wedge": Figure(0.05, _CHART),
        "index": Figure(0.001, f"{_CHART}; {_GLASS} NP010"),
        "abbe": Figure(0.8, f"{_CHART}; {_GLASS} AN8", "%"),
        "air": Figure(0.15, _MOUNT),
        "element_decenter": Figure(0.1, _MOUNT),
        "element_tilt": Figure(0.1, _MOUNT),
    },
    "precision": {
        "radius": Figure(0.1, _CHART, "%", 3.0),
        "irregularity": Figure(0.5, _CHART),
        "thickness": Figure(0.05, _CHART),
        "wedge": Figure(0.01, _CHART),
        "index": Figure(0.0005, f"{_CHART}; {_GLASS} NP005"),
        "abbe": Figure(0.5, f"{_CHART}; {_GLASS} AN5", "%"),
        "air": Figure(0.05, _MOUNT),
        "element_decenter": Figure(0.05, _MOUNT),
        "element_tilt": Figure(0.05, _MOUNT),
    },
    "high": {
        "radius": Figure(0.05, _CHART, "%", 1.0),
        "irregularity": Figure(0.1, _CHART),
        "thickness": Figure(0.025, _CHART),
        "wedge": Figure(0.005, _CHART),
        "index": Figure(0.0002, f"{_GLASS} NP002; the chart has melt data"),
        "abbe": Figure(0.2, f"{_GLASS} AN2; the chart has melt data", "%"),
        "air": Figure(0.02, _MOUNT),
        "element_decenter": Figure(0.02, _MOUNT),
        "element_tilt": Figure(0.02, _MOUNT),
    },
}


class Parts(NamedTuple):
    """Parts of a lens that have errors: faces, glasses (surface in front, last surface of the group), gaps, elements.

    faces: surfaces where the light refracts or reflects; ends: the last face of every element of glass, whose wedge it
    has; gaps: surfaces in front of air between elements; units: cemented groups and single elements, which are mounted.
    """

    faces: tuple[int, ...]
    glasses: tuple[tuple[int, int], ...]
    ends: tuple[int, ...]
    gaps: tuple[int, ...]
    units: tuple[tuple[int, int], ...]


def parts_of(lens: Lens) -> Parts:
    """The parts of a lens, without those that follow others by a pickup of their glass or curvature."""
    followers = _followers(lens)
    elements = [(a, b) for a, b in lens_elements(lens) if not {("glass", a), ("curvature", a)} & followers]
    groups = [(a, b) for a, b in cemented_groups(lens) if any(a <= first < b for first, _ in elements)]
    inside = [group for group in groups if any(group[0] <= a and b <= group[1] for a, b in elements)]
    units = [*inside, *((a, b) for a, b in elements if not any(g[0] <= a and b <= g[1] for g in inside))]
    glasses = [(a, next((g[1] for g in inside if g[0] <= a < g[1]), b)) for a, b in elements if a != b]
    mirrors = [k for a, b in elements for k in range(a, b + 1) if lens.surfaces[k].is_mirror]
    phases = [a for a, b in elements if a == b]
    last = max((b for _, b in units), default=0)
    return Parts(
        tuple(sorted({k for pair in elements for k in pair} | {*mirrors, *phases})),
        tuple(glasses),
        tuple(b for a, b in elements if a != b),
        tuple(sorted(b for _, b in units if b < last and is_air(lens.surfaces[b].glass))),
        tuple(sorted(units)),
    )


def _followers(lens: Lens) -> set[tuple[str, int]]:
    data = lens.optimization_data
    return set() if data is None else {(s.quantity, s.surface) for s in data.solves if s.kind == "pickup"}


class Word(NamedTuple):
    """A word of limits: the kinds of its rows, and of rows that it replaces; where: its places in a lens.

    radial: whether its rows along x and y are a radial error, whose magnitude the limit is.
    """

    kinds: tuple[str, ...]
    where: Callable[[Parts], Sequence[tuple[int, ...]]]
    replaces: tuple[str, ...] = ()
    radial: bool = False


def _faces(parts: Parts) -> list[tuple[int, ...]]:
    return [(k,) for k in parts.faces]


def _both(kind: str) -> tuple[str, ...]:
    return f"{kind}_x", f"{kind}_y"


#: Words of limits that are no kinds, or that apply to particular places.
WORDS = {
    "radius": Word(("radius",), _faces, ("radius", "power", "curvature")),
    "power": Word(("power",), _faces, ("radius", "power", "curvature")),
    "curvature": Word(("curvature",), _faces, ("radius", "power", "curvature")),
    "conic": Word(("conic",), _faces),
    "thickness": Word(("thickness",), lambda parts: [(a,) for a, _ in parts.glasses]),
    "air": Word(("thickness",), lambda parts: [(k,) for k in parts.gaps]),
    "index": Word(("index",), lambda parts: [(a,) for a, _ in parts.glasses]),
    "abbe": Word(("abbe",), lambda parts: [(a,) for a, _ in parts.glasses]),
    "irregularity": Word(("irregularity", "irregularity_angle"), _faces),
    "wedge": Word(_both("surface_runout"), lambda parts: [(k,) for k in parts.ends]),
    "surface_runout": Word(_both("surface_runout"), _faces),
    "surface_tilt": Word(_both("surface_tilt"), _faces),
    "surface_decenter": Word(_both("surface_decenter"), _faces),
    "element_tilt": Word(_both("element_tilt"), lambda parts: parts.units),
    "element_decenter": Word(_both("element_decenter"), lambda parts: parts.units),
    "element_decenter_z": Word(("element_decenter_z",), lambda parts: parts.units),
    "element_roll": Word(("element_roll",), lambda parts: parts.units),
}
WORDS |= {f"{name}_radial": word._replace(radial=True) for name, word in WORDS.items() if word.kinds[0][-2:] == "_x"}
_LIMITS = re.compile(r"([a-z_]+)(?::([\d,-]+))?=(?:([^%]+?)\.\.)?([^%]+?)(%?)")


def tolerances(
    lens: Lens,
    limits: str | Sequence[str] = "",
    *,
    grade: str | None = None,
    distribution: str = "normal",
    sigmas: float = 2.0,
    compensators: Sequence[Compensator] | None = None,
    radial: bool = False,
) -> ToleranceTable:
    """The tolerances of every surface, element and gap of a lens: of a grade, of limits, or of its file.

    limits: "radius=0.1% thickness=0.02 element_tilt=0.05": words and kinds with their limits ± in mm, degrees, fringes
        or %, "irregularity:1,3=-0.2..0.5" for surfaces 1 and 3 alone, "index=0" for no such tolerance. They replace
        those of the grade or the file. "element_decenter_radial=0.02" is the magnitude of an error along x and y, whose
        direction is random.
    grade: "commercial", "precision" or "high": the figures of GRADES, each row with its source. None: the tolerances of
        the lens's own file.
    distribution: "normal", truncated at `sigmas` standard deviations, "uniform", "disc", "parabolic" or "end_points",
        of rows that the file does not have; of a radial error that of its magnitude: "disc" is uniform over the disc,
        "end_points" over its circle.
    compensators: numbers adjusted after manufacture; by default those of the file for its own tolerances, of which
        there may be none, and the distance of the sensor for those of a grade or of limits alone.

    radial: whether decentres, tilts and wedges of the grade and of limits are radial; by default those along x and y
        are separate, each with the whole limit.

    A thickness of glass is taken up by the first gap of air behind it. Raises BadTolerance.
    """
    if grade is not None and grade not in GRADES:
        raise BadTolerance(f"grade {grade!r}{did_you_mean(grade, GRADES)}: expected one of {', '.join(GRADES)}")
    words = parsed_limits(limits)
    if radial and not (grade or words):
        given = f"{option('grade')} or {option('limits')}"
        raise BadTolerance(f"{option('radial')} goes with {given}: tolerances of a file keep their own directions")
    stored = tolerances_of(lens) if grade is None else ToleranceTable(())
    if not (grade or words or stored.rows):
        limits_or_grade = f'{option("limits")}, as "radius=0.1%", or {option("grade")}, as "precision"'
        message = f"the lens has no tolerances of its own: give {limits_or_grade}"
        raise BadTolerance(message)
    parts = parts_of(lens)
    drawn: dict[str, Any] = {"distribution": distribution, "sigmas": sigmas}
    linked = {word: f"{word}_radial" for word in WORDS if radial and f"{word}_radial" in WORDS}
    rows = list(stored.rows)
    for word, figure in GRADES[grade].items() if grade else ():
        word = linked.get(word, word)
        rows += _rows(lens, parts, _Limit(word, (), -figure.limit, figure.limit, figure.unit, figure.source), drawn)
    if grade:
        rows = _at_least_fringes(lens, rows, GRADES[grade]["radius"])
    for limit in (limit._replace(word=linked.get(limit.word, limit.word)) for limit in words):
        gone = [row for row in rows if replaces(limit, row, parts)]
        broken = {row.group for row in gone if row.group}  # a radial error has both its components
        rows = [row for row in rows if not (row in gone or row.group in broken)]
        if limit.minimum or limit.maximum:
            rows += _rows(lens, parts, limit, drawn)
    if compensators is None:
        sensor = Compensator(len(lens.surfaces) - 2, "thickness")
        compensators = stored.compensators if stored.rows else (sensor,)
    check_tolerances(lens, rows)
    changed = len(rows) != len(stored.rows) or any(a is not b for a, b in zip(rows, stored.rows, strict=True))
    saves = () if changed else stored.saves  # which count the rows of the file
    return dataclasses.replace(stored, rows=tuple(rows), compensators=tuple(compensators), saves=saves)


class _Limit(NamedTuple):
    word: str
    surfaces: tuple[int, ...]
    minimum: float
    maximum: float
    unit: str
    source: str


def parsed_limits(limits: str | Sequence[str]) -> list[_Limit]:
    """The words of limits. Raises BadTolerance naming the word."""
    parsed = []
    for piece in joined(limits).split():
        match = _LIMITS.fullmatch(piece)
        if not match:
            raise BadTolerance(f"{piece!r}: expected a kind and its limit, as radius=0.1% or power:2-4=-1..3")
        word, places, low, high, percent = match.groups()
        if word not in WORDS and (word not in KINDS or word in ("operand", "parameter", "zernike", "fringe")):
            meant = did_you_mean(word, [*WORDS, *KINDS])
            raise BadTolerance(f"{piece!r}: no tolerance {word!r}{meant}; expected one of {', '.join(WORDS)}")
        if percent and word not in ("radius", "abbe"):
            raise BadTolerance(f"{piece!r}: only radius and abbe have limits in %")
        try:
            maximum = float(high)
            minimum = -maximum if low is None else float(low)
            surfaces = tuple(counted(piece, places)) if places else ()
        except BadVariables as error:
            raise BadTolerance(str(error)) from error
        except ValueError:
            raise BadTolerance(f"{piece!r}: expected a number, or two as -1..3") from None
        if low is not None and word in WORDS and WORDS[word].radial:
            raise BadTolerance(f"{piece!r}: the limit of a radial error is its magnitude, as {word}=0.02")
        if not minimum <= maximum:
            raise BadTolerance(
                f"{piece!r}: the limits {minimum:g} to {maximum:g}; expected a positive number, or -1..3"
            )
        parsed.append(_Limit(word, surfaces, minimum, maximum, percent, f"limits {piece}"))
    return parsed


def _word(name: str) -> Word:
    """The `Word` of a word of limits or of a kind."""
    if name in WORDS:
        return WORDS[name]
    whole = WORDS.get(name.removesuffix("_x").removesuffix("_y"))
    return Word((name,), _faces if whole is None else whole.where)


def replaces(limit: _Limit, row: Tolerance, parts: Parts) -> bool:
    """Whether a limit takes the place of a row."""
    word = _word(limit.word)
    if row.kind not in (word.replaces or word.kinds):
        return False
    if limit.surfaces:
        return row.surfaces[0] in limit.surfaces
    if limit.word in ("thickness", "air"):
        return (row.surfaces[0] in {a for a, _ in parts.glasses}) == (limit.word == "thickness")
    return True


def _rows(lens: Lens, parts: Parts, limit: _Limit, drawn: dict[str, Any]) -> list[Tolerance]:
    """The rows of a limit at all its places, or at those of its surfaces."""
    word = _word(limit.word)
    places = [place for place in word.where(parts) if not limit.surfaces or place[0] in limit.surfaces]
    missing = [k for k in limit.surfaces if k not in {place[0] for place in places}]
    if missing and limit.word in ("conic", "irregularity", "surface_tilt", "surface_decenter", "surface_runout"):
        places, missing = [*places, *((k,) for k in missing)], []
    if missing:
        known = ", ".join(str(place[0]) for place in word.where(parts)) or "no surface"
        raise BadTolerance(f"{limit.source}: surface {missing[0]} has no {limit.word}; it belongs to {known}")
    ends, rows = dict(parts.glasses), []
    for place in places:
        for kind in word.kinds:
            if kind == "radius" and not _curvature(lens, place[0]):
                continue
            if kind == "abbe" and not has_abbe_number(lens.surfaces[place[0]].glass):
                continue
            part = math.sqrt(0.5) if word.radial else 1.0
            row = Tolerance(kind, tuple(place), part * limit.minimum, part * limit.maximum, source=limit.source)
            if word.radial:
                row = dataclasses.replace(row, group=f"{limit.word} of {row.where}")
            if kind == "irregularity_angle":
                rows.append(dataclasses.replace(row, minimum=-90.0, maximum=90.0, distribution="uniform"))
                continue
            adjust = ends.get(place[0]) if kind == "thickness" else None
            rows.append(dataclasses.replace(row, unit=limit.unit, adjust=adjust, **drawn))
    return rows


def _curvature(lens: Lens, k: int) -> float:
    curvature = lens.surfaces[k].curvature
    return 0.0 if curvature is None else float(curvature)


def _at_least_fringes(lens: Lens, rows: Iterable[Tolerance], figure: Figure) -> list[Tolerance]:
    """The rows, with radii in fringes where the fringes of the grade are the larger limit, and with rows for planes.

    N fringes of λ/2 at the semi-diameter h are a part N λ |R|/h² of a radius R.
    """
    radii, changed = semi_diameters(lens), []
    for row in rows:
        if row.kind == "radius":
            k = row.surfaces[0]
            h, curvature = radii[k], abs(_curvature(lens, k))
            if h > 0 and 100 * figure.fringes * 1e-3 * TEST_WAVELENGTH / (curvature * h * h) > figure.limit:
                n = figure.fringes
                row = dataclasses.replace(row, kind="power", minimum=-n, maximum=n, unit="fringes")
        changed.append(row)
    planes = [k for k in parts_of(lens).faces if not _curvature(lens, k) and radii[k] > 0]
    n, usual = figure.fringes, changed[0] if changed else Tolerance("power", (0,), 0.0, 0.0)
    return changed + [
        Tolerance("power", (k,), -n, n, distribution=usual.distribution, sigmas=usual.sigmas, source=figure.source)
        for k in planes
    ]
