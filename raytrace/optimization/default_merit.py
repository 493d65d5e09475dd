"""Default merit functions: spots, wavefronts, directions or MTF of all fields and wavelengths.

The weight of a ray of the Gaussian rule of n rings and m arms is

    w = π g v f / (W F a)

with g the weight of its ring (Σ g = 1), v and f the weights of its wavelength and field, W and F their numbers, and a
the number of arms that are traced: of a lens of revolution one for the field on the axis, half of them for a field on
y, else all. They lie half a step off the y axis. The weights v and f are those of the lens, not normalised.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from numbers import Integral

import numpy as np

from raytrace.maths.sampling import gauss_legendre
from raytrace.optimization.conventions import Conventions, conventions_of
from raytrace.system.lens import Lens, is_round_about_axis
from raytrace.system.optimization_data import Row
from raytrace.system.parameter_paths import parse_range
from raytrace.words import did_you_mean

#: Most rows of a default merit function: each is a ray, with its derivatives by all variables.
MOST_ROWS = 100_000

REFERENCES = ("centroid", "chief")


class BadMerit(ValueError):
    """A merit function that cannot be made; the message says what was found and what was expected."""


@dataclass(frozen=True)
class Boundaries:
    """Limits of thicknesses, mm: (minimum, maximum) on the axis, of glass and of air; edge: minimum at the edge.

    None: no such row. `edge` is of glass; the minimum of air also holds at its edge. The space before the image has
    no maximum.
    """

    glass: tuple[float, float] | None = None
    air: tuple[float, float] | None = None
    edge: float | None = None

    @classmethod
    def of(
        cls, glass_thickness: str | tuple[float, float] | None, air_thickness: str | tuple[float, float] | None, edge
    ) -> "Boundaries":
        """From ranges, which may be text as "2:15", or "2" without a maximum. Raises ValueError."""
        ranges = (parse_range(ends) if isinstance(ends, str) else ends for ends in (glass_thickness, air_thickness))
        return cls(*ranges, edge)

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
class Kind:
    """A kind of default merit function: its operand for each reference, how its rows are made, and its description."""

    operands: dict[str, str]
    rows: "Callable[[Lens, str, DefaultMerit], Iterator[Row]]"
    text: str


@dataclass(frozen=True)
class DefaultMerit:
    """Settings of a default merit function, as in OpticStudio's wizard of sequential merit functions.

    kind: "spot", "wavefront", "angular" or "mtf"; rings, arms (even): of Gaussian quadrature of the pupil; reference:
    "centroid" or "chief" ray; frequencies: cycles/mm, of "mtf"; field_weights (F,), wavelength_weights (W,): by default
    those of the lens. glass_thickness, air_thickness: (minimum, maximum) on the axis, mm, or text "2:15"; edge: minimum
    thickness of glass at its edge, mm: boundary rows in addition. conventions: of operands, as "opd_tilt=common"
    (`Conventions`). Raises BadMerit, ValueError.
    """

    kind: str = "spot"
    _: KW_ONLY
    rings: int = 3
    arms: int = 6
    reference: str = "centroid"
    frequencies: Sequence[float] = ()
    field_weights: Sequence[float] | None = None
    wavelength_weights: Sequence[float] | None = None
    glass_thickness: str | tuple[float, float] | None = None
    air_thickness: str | tuple[float, float] | None = None
    edge: float | None = None
    conventions: Conventions | str | Sequence[str] | None = None

    def __post_init__(self):
        if self.kind not in KINDS:
            raise BadMerit(f"`merit={self.kind}`: expected one of {', '.join(KINDS)}{did_you_mean(self.kind, KINDS)}")
        if self.reference not in REFERENCES:
            raise BadMerit(f"`reference={self.reference}`: expected one of {', '.join(REFERENCES)}")
        whole = isinstance(self.rings, Integral) and isinstance(self.arms, Integral)
        if not whole or self.rings < 1 or self.arms < 2 or self.arms % 2:
            raise BadMerit(f"`rings={self.rings}` and `arms={self.arms}`: expected 1 or more, and an even number")
        object.__setattr__(self, "frequencies", tuple(np.atleast_1d(self.frequencies).astype(float).tolist()))
        if not all(0 <= frequency < np.inf for frequency in self.frequencies):
            raise BadMerit(f"`frequencies={self.frequencies}`: expected finite numbers, 0 or more, cycles/mm")
        if bool(self.frequencies) != (self.kind == "mtf"):
            raise BadMerit("`merit=mtf` goes with `frequencies`, cycles/mm, and no other merit does")
        object.__setattr__(self, "conventions", conventions_of(self.conventions))

    @property
    def boundaries(self) -> Boundaries:
        return Boundaries.of(self.glass_thickness, self.air_thickness, self.edge)

    def rows(self, lens: Lens, configurations: Sequence[int] | None = None) -> tuple[Row, ...]:
        """The rows for a lens, lengths in mm, in these configurations (from 1; by default all, with equal weight).

        Raises BadMerit.
        """
        kind = KINDS[self.kind]
        operand = kind.operands.get(self.reference) or next(iter(kind.operands.values()))
        about = f"{self.kind}, from the {self.reference}" if len(kind.operands) > 1 else self.kind
        rows = [Row("DMFS"), Row("BLNK", text=f"{about}: {kind.text}")]
        for setting, configured in _configurations(lens, configurations):
            rows += (*setting, *self.boundaries.rows(configured), *kind.rows(configured, operand, self))
        return tuple(rows)


def boundary_rows(lens: Lens, boundaries: Boundaries) -> tuple[Row, ...]:
    """The rows of boundaries alone, in every configuration."""
    rows: list[Row] = []
    for setting, configured in _configurations(lens, None):
        limits = tuple(boundaries.rows(configured))
        rows += (*setting, *limits) if limits else ()
    return tuple(rows)


def _configurations(lens: Lens, chosen: Sequence[int] | None) -> Iterator[tuple[tuple[Row, ...], Lens]]:
    """The row CONF of each configuration, if there are several, and the lens in it."""
    for number in range(1, len(lens.configurations) + 1) if chosen is None else chosen:
        yield ((Row("CONF", (number, 0)),), lens.configuration(number)) if lens.operands else ((), lens)


def _by_rays(lens: Lens, operand: str, settings: DefaultMerit) -> Iterator[Row]:
    """A row for every ray, by field, wavelength, arm and ring."""
    fields, colours = (
        _fields(lens, settings),
        _weights(lens.wavelength_weights, settings.wavelength_weights, "wavelength"),
    )
    count = sum(_arm_count(lens, field, settings.arms) for field, _ in fields) * len(colours) * settings.rings
    _refuse_many(count, f"`rings={settings.rings}` and `arms={settings.arms}`")
    nodes, weights = gauss_legendre(settings.rings)
    for field, field_weight in fields:
        angles = _arms(lens, field, settings.arms)
        for wavelength, weight in enumerate(colours, 1):
            share = np.pi * weight * field_weight / (len(colours) * len(fields) * len(angles))
            for angle in angles if share else ():
                for radius, g in zip(np.sqrt(0.5 * (nodes + 1)), 0.5 * weights, strict=True):
                    pupil = (round(float(radius * part), 15) + 0.0 for part in (np.cos(angle), np.sin(angle)))
                    yield Row(operand, (0, wavelength), (*field, *pupil), weight=float(share * g))


def _by_frequencies(lens: Lens, operand: str, settings: DefaultMerit) -> Iterator[Row]:
    """A row for every field and frequency, all wavelengths together, with a target of 1."""
    fields = _fields(lens, settings)
    _refuse_many(len(fields) * len(settings.frequencies), f"{len(settings.frequencies)} `frequencies`")
    for number, (_, weight) in enumerate(fields, 1):
        for frequency in settings.frequencies if weight else ():
            share = weight / (len(fields) * len(settings.frequencies))
            yield Row(operand, (1, 0), (float(number), float(frequency), 0.0, 0.0), target=1.0, weight=share)


def _fields(lens: Lens, settings: DefaultMerit) -> list[tuple[tuple[float, float], float]]:
    """(Hx, Hy) as parts of the largest field, and its weight, of every field."""
    points = np.stack([lens.fields.x.detach().numpy(), lens.fields.y.detach().numpy()], -1)
    largest = np.hypot(*points.T).max()
    points = (points / largest if largest > 0 else points) + 0.0
    weights = _weights(lens.fields.weight, settings.field_weights, "field")
    return [(tuple(point), weight) for point, weight in zip(points.tolist(), weights, strict=True)]


def _weights(of_lens, weights: Sequence[float] | None, kind: str) -> list[float]:
    """The weights of fields or wavelengths, by default those of the lens. Raises BadMerit."""
    if weights is None:
        return of_lens.detach().tolist()
    weights = np.atleast_1d(weights).astype(float).tolist()
    if len(weights) != len(of_lens):
        raise BadMerit(f"`{kind}_weights`: {len(weights)} weights, and the lens has {len(of_lens)} {kind}s")
    if not (min(weights) >= 0 and sum(weights) > 0):
        raise BadMerit(f"`{kind}_weights`: expected 0 or more, not all of them 0")
    return weights


def _refuse_many(rows: int, what: str) -> None:
    """Raise BadMerit for more rows than MOST_ROWS, before one is made."""
    if rows > MOST_ROWS:
        raise BadMerit(f"{what}: {rows:,} rows of a merit function, expected at most {MOST_ROWS:,}; ask for fewer")


def _arm_count(lens: Lens, field: tuple[float, float], arms: int) -> int:
    """Number of arms traced at a field: of a lens of revolution half of them, and one on the axis."""
    if not is_round_about_axis(lens) or bool(lens.fields.x.any()):
        return arms
    return arms // 2 if field != (0.0, 0.0) else 1


def _arms(lens: Lens, field: tuple[float, float], arms: int) -> np.ndarray:
    """The angles of the arms in radians, clockwise from the first right of the y axis."""
    count = _arm_count(lens, field, arms)
    return np.deg2rad(90 - (np.arange(count) + 0.5) * (360 / arms)) if count > 1 else np.zeros(1)


KINDS = {
    "spot": Kind({"centroid": "TRAC", "chief": "TRAR"}, _by_rays, "where rays land on the image"),
    "wavefront": Kind({"centroid": "OPDX", "chief": "OPDC"}, _by_rays, "optical path differences in waves"),
    "angular": Kind({"centroid": "ANAC", "chief": "ANAR"}, _by_rays, "directions of rays behind the lens, as cosines"),
    "mtf": Kind({"": "MTFA"}, _by_frequencies, "mean of tangential and sagittal MTF"),
}
