"""Optimisation data of a lens: variables, solves, pickups and the merit function.

A lens file stores solved values and their rules. The numbers of a `Lens` are those values; the rules are here, and hold
while the lens is optimised. Nothing here is a tensor, so that two sets compare by their parts.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real


@dataclass(frozen=True, slots=True)
class Vary:
    """A number that an optimisation may change.

    surface: of the file; quantity: "thickness", "curvature", or another name of `parameter_paths`, as "conic", "a4",
    "tilt_x"; "index", "abbe_number", "partial_dispersion" of a model glass; of surface 0 "aperture", the number of the
    system aperture.
    configuration, operand: of a number that differs between configurations, the configuration (from 1) and its place in
    `lens.operands` (from 0); surface and quantity are those of the operand. 0 and None: of the lens itself.
    bounds: smallest and largest value, in mm; () if there are none.
    """

    surface: int
    quantity: str
    configuration: int = 0
    operand: int | None = None
    bounds: tuple[float, ...] = ()

    @property
    def address(self) -> tuple[int, str]:
        return self.surface, self.quantity

    @property
    def name(self) -> str:
        """In bounds and tables: thickness_6, in configuration 2 thickness_6@2; aperture, temperature, pressure."""
        if not self.surface and self.quantity != "thickness":
            return self.quantity
        return f"{self.quantity}_{self.surface}" + (f"@{self.configuration}" if self.configuration else "")

    def __str__(self) -> str:
        within = f" from {self.bounds[0]:g} to {self.bounds[1]:g}" if self.bounds else ""
        return f"{_where(self)}{within}"


@dataclass(frozen=True, slots=True)
class Solve:
    """A number that follows from others, at every step of an optimisation.

    surface, quantity: as for `Vary`. kind, a key of `optimization.lens_state.SOLVES`, and its numbers:

    "pickup": `scale` times a number of surface `source`, plus `offset`; quantity_of_source: which number, by default
        the one of the same name.
    "marginal_angle": the curvature behind which the paraxial marginal ray has the slope numbers[0].
    "f_number": the curvature behind which the paraxial marginal ray has the slope of the F-number numbers[0].
    "marginal_height": the thickness behind which the paraxial marginal ray has the height numbers[0] mm, or the real
        axial ray through the part numbers[1] of the pupil, where that is not 0.
    "edge_thickness": the thickness by which the space behind is numbers[0] mm thick at the height numbers[1] mm, or at
        0 at the semi-diameter of the surface before it.
    "position": the thickness by which those from surface `source` to this one have the sum numbers[0] mm; of a `source`
        behind this surface, those from this one up to it.
    "power": the curvature by which the surface has the power numbers[0], in 1/mm.
    "focal_length": the curvature, or thickness, with which the lens has the effective focal length numbers[0] mm.

    "thermal", between configurations: it follows its number in configuration `source` by expansion.
    "pickup" of a "glass": it is that of surface `source`, whatever varies of it.

    All at the primary wavelength, in the order of surfaces. numbers: in mm. Kinds only stored (`kept`):

    "substitute" of a "glass": it may be exchanged; "pickup" of a "semi_diameter"; others, named as in the file.
    "maximum" of a "semi_diameter": the largest of all configurations, which `tracing.geometry` follows.

    configuration, operand: as for `Vary`. A "pickup" of those follows configuration `source`, there operand numbers[0];
        its offset is in `OptimizationData.unit`.
    """

    surface: int
    quantity: str
    kind: str
    numbers: tuple[float, ...] = ()
    source: int = 0
    scale: float = 1.0
    offset: float = 0.0
    quantity_of_source: str = ""
    configuration: int = 0
    operand: int | None = None

    @property
    def address(self) -> tuple[int, str]:
        return self.surface, self.quantity

    @property
    def address_of_source(self) -> tuple[int, str]:
        """Of the number that a pickup follows."""
        return self.source, self.quantity_of_source or self.quantity

    @property
    def is_largest_size(self) -> bool:
        """Of a semi-diameter that is the largest of all configurations."""
        return self.quantity == "semi_diameter" and self.kind == "maximum"

    def __str__(self) -> str:
        if self.kind == "pickup" and self.operand is None:
            quantity = self.quantity_of_source or self.quantity
            scale = "" if self.scale == 1 else f"{self.scale:g} × "
            offset = "" if self.offset == 0 else f" {'-' if self.offset < 0 else '+'} {abs(self.offset):g}"
            return f"{_where(self)} = {scale}{quantity} of surface {self.source}{offset}"
        numbers = " ".join(f"{number:g}" for number in self.numbers)
        return f"{_where(self)}: {self.kind} {numbers}".rstrip()


def _where(rule: Vary | Solve) -> str:
    configuration = f" in configuration {rule.configuration}" if rule.configuration else ""
    return f"{rule.quantity} of surface {rule.surface}{configuration}"


@dataclass(frozen=True, slots=True)
class Row:
    """One row of a merit function: an operand, its arguments, target and weight.

    operand: its name, as "TRAC", a key of `optimization.operands.table.OPERANDS` if it is known, or a function from a
        lens to a tensor () or (k,), which may be a `optimization.operands.operand.Measure`; `name` names either.
    integers, numbers: its arguments in the order of OpticStudio: surfaces, a wavelength (from 1, 0 the primary one) or
        rows; Hx, Hy, Px, Py or data. One number is the first, and those left out are 0.
    target, weight: the merit is the weighted mean square of value - target; a weight of 0 shows the value alone.
    text: of a row of text, and words after the numbers; further: numbers after those.
    Lengths in `OptimizationData.unit`, unconverted: a merit of lengths and pure numbers depends on the unit.
    Raises ValueError for more arguments.
    """

    operand: str | Callable
    integers: tuple[int, int] = (0, 0)
    numbers: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    target: float = 0.0
    weight: float = 0.0
    text: str = ""
    further: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name, size, zero in (("integers", 2, 0), ("numbers", 4, 0.0)):
            given = getattr(self, name)
            if isinstance(given, tuple) and len(given) == size:
                continue
            given = (given,) if isinstance(given, Real) else tuple(given)
            if len(given) > size:
                raise ValueError(f"row {self.name}: `{name}` {given}: expected at most {size}")
            object.__setattr__(self, name, (*given, *(zero,) * (size - len(given))))

    @property
    def name(self) -> str:
        """Name of the operand, or of its function."""
        if isinstance(self.operand, str):
            return self.operand
        return str(
            getattr(self.operand, "name", None) or getattr(self.operand, "__name__", type(self.operand).__name__)
        )


@dataclass(frozen=True, slots=True)
class OptimizationData:
    """The optimisation data of a lens file.

    variables, solves: of the numbers of the lens, in the order of surfaces; kept: rules that are stored and not
    followed: their numbers stay fixed. merit: the rows of its merit function, in order, text included: row i of the
    function is merit[i - 1]; tolerances: lines of the file; distributions: tables of errors that they name, (file,
    density) as of `Tolerance`; unit: mm in the unit of length of both, in which a file of
    the lens is written.
    semi_diameters: surfaces of fixed semi-diameter; all others follow the rays; semi_diameter_margin: per cent, and mm.
    shares_mechanical: whether the surfaces of an element and of a cemented group have one mechanical semi-diameter,
        where it is not fixed; else each has that of its own clear one.
    """

    variables: tuple[Vary, ...] = ()
    solves: tuple[Solve, ...] = ()
    merit: tuple[Row, ...] = ()
    unit: float = 1.0
    tolerances: tuple[str, ...] = ()
    semi_diameters: tuple[int, ...] = ()
    semi_diameter_margin: tuple[float, float] = (0.0, 0.0)
    kept: tuple[Solve, ...] = ()
    distributions: tuple[tuple[str, tuple[tuple[float, float], ...]], ...] = ()
    shares_mechanical: bool = True

    @property
    def rules(self) -> tuple[Vary | Solve, ...]:
        """Variables, solves and kept rules."""
        return (*self.variables, *self.solves, *self.kept)

    def __str__(self) -> str:
        counts = Counter(row.name for row in self.merit)
        operands = ", ".join(f"{name} x{count}" for name, count in counts.items())
        lines = [
            *(f"varies: {rule}" for rule in self.variables),
            *(f"follows: {rule}" for rule in self.solves),
            *(f"{'follows' if rule.is_largest_size else 'kept'}: {rule}" for rule in self.kept),
            *([f"merit function of {len(self.merit)} lines: {operands}"] if self.merit else []),
            *([f"tolerances: {len(self.tolerances)} lines"] if self.tolerances else []),
        ]
        return "\n".join(lines) or "nothing varies, nothing follows, no merit function"
