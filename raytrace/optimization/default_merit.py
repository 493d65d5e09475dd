"""Default merit functions, for a lens whose file has none: what rays of all fields and wavelengths are to do.

A ray of the Gaussian rule of n rings and m arms counts by

    w = π g v f / (W F a)

with g the weight of its ring (Σ g = 1), v and f the weights of its wavelength and field, W and F how many there are of
either, and a the arms that are traced: of a lens that is round about its axis one for the field there, half of them for
a field above it, else all. They lie half a step off the y axis. The weights v and f stay as the lens has them.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from raytrace.maths.pupil import gauss_legendre
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row
from raytrace.tracing.aiming import is_round_about_axis
from raytrace.words import did_you_mean

#: More rows than any merit function is worth: each is a ray, with its derivatives by all variables.
MOST_ROWS = 100_000


class BadMerit(ValueError):
    """A merit function that cannot be made; the message says what was found and what was expected."""


@dataclass(frozen=True)
class Boundaries:
    """Least and greatest thickness in mm at the axis, of glass and of air; edge: least of glass at its edge.

    None: no such row. Air is at its edge as thick as at its axis at least. The space before the image has no greatest
    thickness.
    """

    glass: tuple[float, float] | None = None
    air: tuple[float, float] | None = None
    edge: float | None = None

    def rows(self, lens: Lens) -> Iterator[Row]:
        """The rows, each over all surfaces."""
        last = len(lens.surfaces) - 2
        bounds = (
            *(("MNCA", last, self.air and self.air[0]), ("MXCA", last - 1, self.air and self.air[1])),
            *(("MNEA", last, self.air and self.air[0]), ("MNCG", last, self.glass and self.glass[0])),
            *(("MXCG", last, self.glass and self.glass[1]), ("MNEG", last, self.edge)),
        )
        for operand, end, target in bounds:
            if target is not None and np.isfinite(target) and end > 0:
                yield Row(operand, (1, end), target=float(target), weight=1.0)


@dataclass(frozen=True)
class Choice:
    """How a default merit function is made; arguments as for `rows_of`."""

    rings: int
    arms: int
    field_weights: Sequence[float] | None
    wavelength_weights: Sequence[float] | None
    frequencies: Sequence[float]


@dataclass(frozen=True)
class Kind:
    """One kind of default merit function: its operand by what it refers to, how its rows are made, what it is."""

    operands: dict[str, str]
    rows: Callable[[Lens, str, Choice], Iterator[Row]]
    text: str


def rows_of(
    lens: Lens,
    kind: str = "spot",
    *,
    rings: int = 3,
    arms: int = 6,
    reference: str = "centroid",
    frequencies: Sequence[float] = (),
    field_weights: Sequence[float] | None = None,
    wavelength_weights: Sequence[float] | None = None,
    boundaries: Boundaries | None = None,
    configurations: Sequence[int] | None = None,
) -> tuple[Row, ...]:
    """The rows of a default merit function, lengths in mm.

    kind: a key of KINDS; rings, arms: of the pupil, arms even; reference: what rays are told from: "centroid" of each
    field, or the "chief" ray. frequencies: cycles/mm, of kind "mtf". field_weights, wavelength_weights: (F,), (W,)
    instead of the lens's own. configurations: from 1, all of them by default; their rows weigh alike. Raises BadMerit.
    """
    choice = Choice(rings, arms, field_weights, wavelength_weights, tuple(frequencies))
    operand = _operand(kind, reference, choice)
    about = f"{kind}, from the {reference}" if len(KINDS[kind].operands) > 1 else kind
    found = [Row("DMFS"), Row("BLNK", text=f"{about}: {KINDS[kind].text}")]
    for setting, one in _configurations(lens, configurations):
        found += (*setting, *(boundaries or Boundaries()).rows(one), *KINDS[kind].rows(one, operand, choice))
    return tuple(found)


def boundary_rows(lens: Lens, boundaries: Boundaries, configurations: Sequence[int] | None = None) -> tuple[Row, ...]:
    """The rows of boundaries alone, in every configuration."""
    found: list[Row] = []
    for setting, one in _configurations(lens, configurations):
        rows = tuple(boundaries.rows(one))
        found += (*setting, *rows) if rows else ()
    return tuple(found)


def _configurations(lens: Lens, chosen: Sequence[int] | None) -> Iterator[tuple[tuple[Row, ...], Lens]]:
    """The row that says which configuration the rows below are of, if there are several, and the lens in it."""
    for number in range(1, len(lens.configurations) + 1) if chosen is None else chosen:
        yield ((Row("CONF", (number, 0)),), lens.configuration(number)) if lens.operands else ((), lens)


def _operand(kind: str, reference: str, choice: Choice) -> str:
    """The operand of a kind. Raises BadMerit for what does not go together."""
    if kind not in KINDS:
        raise BadMerit(f"`merit={kind}`: expected one of {', '.join(KINDS)}{did_you_mean(kind, KINDS)}")
    operands = KINDS[kind].operands
    if reference not in REFERENCES:
        raise BadMerit(f"`reference={reference}`: expected one of {', '.join(REFERENCES)}")
    if choice.rings < 1 or choice.arms < 2 or choice.arms % 2:
        raise BadMerit(f"`rings={choice.rings}` and `arms={choice.arms}`: expected 1 or more, and an even number")
    if bool(choice.frequencies) != (kind == "mtf"):
        raise BadMerit("`merit=mtf` goes with `frequencies`, cycles/mm, and no other merit does")
    return operands.get(reference) or next(iter(operands.values()))


def _by_rays(lens: Lens, operand: str, choice: Choice) -> Iterator[Row]:
    """A row for every ray, by field, wavelength, arm and ring."""
    fields, colours = _fields(lens, choice), _weights(lens.wavelength_weights, choice.wavelength_weights, "wavelength")
    count = sum(_arm_count(lens, field, choice.arms) for field, _ in fields) * len(colours) * choice.rings
    _refuse_many(count, f"`rings={choice.rings}` and `arms={choice.arms}`")
    nodes, weights = gauss_legendre(choice.rings)
    for field, field_weight in fields:
        angles = _arms(lens, field, choice.arms)
        for wavelength, weight in enumerate(colours, 1):
            share = np.pi * weight * field_weight / (len(colours) * len(fields) * len(angles))
            for angle in angles if share else ():
                for radius, g in zip(np.sqrt(0.5 * (nodes + 1)), 0.5 * weights, strict=True):
                    pupil = _clean(radius * np.cos(angle)), _clean(radius * np.sin(angle))
                    yield Row(operand, (0, wavelength), (*field, *pupil), weight=float(share * g))


def _by_frequencies(lens: Lens, operand: str, choice: Choice) -> Iterator[Row]:
    """A row for every field and frequency, all wavelengths together; the best that there is is 1."""
    fields = _fields(lens, choice)
    _refuse_many(len(fields) * len(choice.frequencies), f"{len(choice.frequencies)} `frequencies`")
    for number, (_, weight) in enumerate(fields, 1):
        for frequency in choice.frequencies if weight else ():
            share = weight / (len(fields) * len(choice.frequencies))
            yield Row(operand, (1, 0), (float(number), float(frequency), 0.0, 0.0), target=1.0, weight=share)


def _fields(lens: Lens, choice: Choice) -> list[tuple[tuple[float, float], float]]:
    """(Hx, Hy) as parts of the largest field, and its weight, of every field."""
    points = np.stack([lens.fields.x.detach().numpy(), lens.fields.y.detach().numpy()], -1)
    largest = np.hypot(*points.T).max()
    points = (points / largest if largest > 0 else points) + 0.0
    weights = _weights(lens.fields.weight, choice.field_weights, "field")
    return [(tuple(point), weight) for point, weight in zip(points.tolist(), weights, strict=True)]


def _weights(own, given: Sequence[float] | None, what: str) -> list[float]:
    """The weights of fields or wavelengths: those of the lens, or those given, one each."""
    if given is None:
        return own.detach().tolist()
    if len(given) != len(own):
        raise BadMerit(f"`{what}_weights`: {len(given)} weights, and the lens has {len(own)} {what}s")
    if min(given) < 0 or not sum(given) > 0:
        raise BadMerit(f"`{what}_weights`: expected 0 or more, not all of them 0")
    return [float(weight) for weight in given]


def _refuse_many(rows: int, what: str) -> None:
    """Raise BadMerit for more rows than MOST_ROWS, before one is made."""
    if rows > MOST_ROWS:
        raise BadMerit(f"{what}: {rows:,} rows of a merit function, expected at most {MOST_ROWS:,}; ask for fewer")


def _arm_count(lens: Lens, field: tuple[float, float], arms: int) -> int:
    """How many arms are traced at a field: of a round lens half of them, and one on the axis."""
    if not is_round_about_axis(lens) or bool(lens.fields.x.any()):
        return arms
    return arms // 2 if field != (0.0, 0.0) else 1


def _arms(lens: Lens, field: tuple[float, float], arms: int) -> np.ndarray:
    """The angles of the arms in radians, clockwise from the first right of the y axis."""
    count = _arm_count(lens, field, arms)
    return np.deg2rad(90 - (np.arange(count) + 0.5) * (360 / arms)) if count > 1 else np.zeros(1)


def _clean(number: float) -> float:
    """Without what rounding leaves of 0."""
    return round(float(number), 15) + 0.0


REFERENCES = ("centroid", "chief")

KINDS = {
    "spot": Kind({"centroid": "TRAC", "chief": "TRAR"}, _by_rays, "where rays land on the image"),
    "wavefront": Kind({"centroid": "OPDX", "chief": "OPDC"}, _by_rays, "optical path differences in waves"),
    "angular": Kind({"centroid": "ANAC", "chief": "ANAR"}, _by_rays, "directions of rays behind the lens, as cosines"),
    "mtf": Kind({"": "MTFA"}, _by_frequencies, "mean of tangential and sagittal MTF"),
}
