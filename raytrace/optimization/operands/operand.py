"""The operand of a merit function: its rows and their arguments, conventions, and the context in which it is evaluated.

An operand is a row of `operands.table.OPERANDS`, or a function of a lens (`Measure`). All rows of one operand in one
configuration are planned together by a `Planner` and evaluated together in an `EvaluationContext`, the lens at given
variables.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
import torch

from raytrace.maths.numerics import Dual, Number, value_of
from raytrace.optimization.lens_state import Bundle, Hits, LensState, View, listed
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Row
from raytrace.system.parameter_paths import joined
from raytrace.system.surface import is_flat
from raytrace.tracing.launch import is_at_infinity
from raytrace.words import RaytraceError, did_you_mean, option


@dataclasses.dataclass(frozen=True)
class Conventions:
    """Conventions of operands. The first choice of each is the default. Raises ValueError for others.

    opd_tilt: of OPDX, a tilt is fitted for every wavelength of a field, or one that all have in common.
    opd_chief: the reference sphere is about the chief ray of the row's own wavelength or of the primary one.
    opd_sign: a longer or a shorter path than the chief ray's is a positive OPD.
    boundary: a row over several surfaces is off by the sum of their violations or by the largest.
    behind_mirrors: thicknesses behind an odd number of mirrors are compared reversed, along the light, or signed, as
        the lens has them.
    focal_length: of EFFL, in image space, n'/power, or in air, 1/power.
    total_track: of TOTR, from the leftmost vertex to the rightmost, or the sum of the thicknesses.
    colour: of AXCL and LACL, which of the two wavelengths counts positive.
    seidel: of SPHA to DIST, waves of Seidel's coefficients, or of the wavefront: S1/8, S2/2, S3/2, S4/4, S5/2.
    f_theta: of DISC, 30 fields at steps from the axis, which is left out, or 29 and the axis.
    """

    opd_tilt: str = "per wavelength"
    opd_chief: str = "own"
    opd_sign: str = "longer"
    boundary: str = "sum"
    behind_mirrors: str = "reversed"
    focal_length: str = "in image space"
    total_track: str = "extent"
    colour: str = "first"
    seidel: str = "coefficients"
    f_theta: str = "axis left out"

    def __post_init__(self) -> None:
        for name, known in CHOICES.items():
            if getattr(self, name) not in known:
                raise ValueError(f"convention `{name}` {getattr(self, name)!r}: expected one of {', '.join(known)}")


#: The choices of each convention, the default first.
CHOICES = {
    "opd_tilt": ("per wavelength", "common"),
    "opd_chief": ("own", "primary"),
    "opd_sign": ("longer", "shorter"),
    "boundary": ("sum", "largest"),
    "behind_mirrors": ("reversed", "signed"),
    "focal_length": ("in image space", "in air"),
    "total_track": ("extent", "sum"),
    "colour": ("first", "second"),
    "seidel": ("coefficients", "wavefront"),
    "f_theta": ("axis left out", "axis included"),
}


def conventions_of(words: "Conventions | str | Sequence[str] | None") -> Conventions:
    """Conventions from text, "opd_tilt=common focal_length=in-air"; None gives the defaults."""
    if isinstance(words, Conventions):
        return words
    choices = {}
    for word in joined(words or "").split():
        name, sign, choice = word.partition("=")
        if name not in CHOICES or not sign:
            known = ", ".join(CHOICES)
            raise ValueError(
                f"{option('conventions')}: {word!r}: expected one of {known}, = and a "
                f"choice{did_you_mean(name, CHOICES)}"
            )
        choices[name] = choice.replace("-", " ")
    return Conventions(**choices)


# -- rows and their evaluation -----------------------------------------------------------------------------------------

#: Rows without a value: settings of the rows below them, and text.
SETTINGS = {
    "CONF": "the configuration of the rows below",
    "PRIM": "the primary wavelength of the rows below",
    "BLNK": "text",
    "DMFS": "where the default merit function starts",
    "USYM": "the lens is taken for symmetric",
}


class Line(NamedTuple):
    """A row of a merit function, its number, from 1, and its wavelength, from 0: the primary one by default."""

    number: int
    row: Row
    wavelength: int

    @property
    def field(self) -> tuple[float, float]:
        return self.row.numbers[0], self.row.numbers[1]

    @property
    def pupil(self) -> tuple[float, float]:
        return self.row.numbers[2], self.row.numbers[3]


class BadRow(RaytraceError, ValueError):
    """A row with an argument that the lens does not have."""

    def __init__(self, line: Line, words: str):
        super().__init__(f"row {line.number} of the merit function: {line.row.name} {words}")


class RowValues(NamedTuple):
    """Values of rows (R,), plain or dual, nan where a ray is lost.

    parts: several (R,) or (K, R), whose squares sum up to the square of the value, and which are smooth where it is 0.
    sides: of rows that are off their target by Σ max(0, e): the row of each e (K,), e (K,), also below 0, and its
    surface (K,).
    """

    values: Number
    parts: tuple[Number, ...] = ()
    sides: tuple[()] | tuple[np.ndarray, Number, np.ndarray] = ()


#: Values of rows at a state; rows of arithmetic take those of earlier rows, by their number.
Evaluate: TypeAlias = Callable[["EvaluationContext"], RowValues]

#: The evaluation of rows of one operand in one configuration.
Plan: TypeAlias = Callable[[Sequence[Line], "Planner"], Evaluate]

#: The value of a row at a state.
RowValue: TypeAlias = Callable[["EvaluationContext"], Number]

Point: TypeAlias = tuple[float, float]
Shared = TypeVar("Shared")


@dataclasses.dataclass(frozen=True)
class Operand:
    """One operand of merit functions.

    plan: from its rows in one configuration and a `Planner` to their `Evaluate`. text: description, with its arguments.
    length: power of length of its unit, as -1 of a curvature; values are in mm, given in `OptimizationData.unit`.
    convention: the convention chosen where OpticStudio leaves the meaning open.
    takes: the two integers of its rows, keys of `ARGUMENTS`; "" for one that is not read.
    refers: of an operand of arithmetic, the numbers of the rows whose values a row takes, among all rows.
    bounds: of an operand that is its target where a boundary is kept, the relation to it: ">=" or "<=".
    """

    plan: Plan
    text: str
    length: int = 0
    convention: str = ""
    takes: tuple[str, str] = ("", "")
    refers: Callable[[Line, Sequence[Row]], Sequence[int]] | None = None
    bounds: str = ""


class Planner:
    """The rays and shared data that operands need of a lens in one configuration."""

    def __init__(self, view: View, primary: int, conventions: Conventions, unit: float = 1.0, rows: Sequence[Row] = ()):
        """unit: mm in the unit of length of the rows; rows: of the whole merit function."""
        self.view, self.lens, self.primary, self.conventions = view, view.lens, primary, conventions
        self.unit, self.rows = unit, rows
        self.bundles: dict[tuple[int, bool], Bundle] = {}
        self._shared: dict[Callable, Any] = {}

    @property
    def image(self) -> int:
        return len(self.lens.surfaces) - 1

    def ray(
        self,
        line: Line,
        *,
        surface: int | None = None,
        field: Point | None = None,
        pupil: Point | None = None,
        wavelength: int | None = None,
    ) -> int:
        """The number of the ray of a row behind a surface, the image by default. Raises BadRow."""
        number = line.wavelength if wavelength is None else wavelength
        if not 0 <= number < len(self.view.wavelengths):
            have = len(self.view.wavelengths)
            raise BadRow(line, f"names wavelength {number + 1}: this lens has wavelengths 1 to {have}")
        last = self.image if surface is None else self.checked(line, surface)
        if last == 0 and not is_flat(self.lens.surfaces[0]):
            raise BadRow(line, "names surface 0, a curved or tilted object, on which rays are not evaluated")
        of_field, of_pupil = line.field if field is None else field, line.pupil if pupil is None else pupil
        return self.ask(number, of_field, of_pupil, surface=last)

    def ask(
        self,
        wavelength: int,
        field: Point,
        pupil: Point,
        *,
        surface: int | None = None,
        clips: bool = False,
    ) -> int:
        """The number of a ray behind a surface, the image by default; clips: whether apertures may stop it."""
        last = self.image if surface is None else surface
        if (last, clips) not in self.bundles:
            self.bundles[last, clips] = Bundle(self.view.clipping if clips else self.view, last)
        return self.bundles[last, clips].ask(wavelength, field, pupil)

    def checked(self, line: Line, surface: int) -> int:
        """The number of a surface, if the lens has it. Raises BadRow."""
        if not 0 <= surface <= self.image:
            raise BadRow(line, f"names surface {surface}: this lens has surfaces 0 to {self.image}")
        return surface

    def rays(self, lines: Sequence[Line], **options: Any) -> np.ndarray:
        return np.array([self.ray(line, **options) for line in lines])

    def shared(self, kind: Callable[["Planner"], Shared]) -> Shared:
        """The instance of a class that rows of several operands share, made of the planner."""
        if kind not in self._shared:
            self._shared[kind] = kind(self)
        return self._shared[kind]


class EvaluationContext:
    """The lens in one configuration at given variables: its state and its rays, traced when they are first needed."""

    def __init__(self, planner: Planner, state: LensState, values: dict[int, Number]) -> None:
        self.planner, self.state, self.values = planner, state, values
        self._hits: dict[tuple[int, bool], Hits] = {}
        self._once: dict[tuple, Any] = {}

    def once(self, function: Callable[..., Shared], *arguments: Any) -> Shared:
        """function(context, *arguments), computed once."""
        key = function, *arguments
        if key not in self._once:
            self._once[key] = function(self, *arguments)
        return self._once[key]

    def hits(self, rays: np.ndarray, *, surface: int | None = None, clips: bool = False) -> Hits:
        """Rays by their numbers behind a surface, the image by default; surface, clips: those of `Planner.ask`."""
        of_surface = self.planner.image if surface is None else surface, clips
        if of_surface not in self._hits:
            self._hits[of_surface] = self.planner.bundles[of_surface].hits(self.state)
        return self._hits[of_surface].at(rays)

    def starts(self, rays: np.ndarray, surface: int) -> Hits:
        """Rays behind a surface at their launch, before surface 1 and in its axes."""
        return self.planner.bundles[surface, False].starts(self.state).at(rays)


def once_a_context(method: Callable[..., Shared]) -> Callable[..., Shared]:
    """A method of a context and further arguments, computed once in each context."""

    def call(context: EvaluationContext, instance: Any, *arguments: Any) -> Shared:
        return method(instance, context, *arguments)

    @functools.wraps(method)
    def cached(instance: Any, context: EvaluationContext, *arguments: Any) -> Shared:
        return context.once(call, instance, *arguments)

    return cached


def known(valid: np.ndarray, number: Number) -> Number:
    """A number (R,) of rays, nan where a ray is lost."""
    if isinstance(number, Dual):
        return Dual(np.where(valid, value_of(number), np.nan), number.slope)
    return np.where(valid, number, np.nan)


def per_row(numbers: Iterable[RowValue]) -> Evaluate:
    """The values of rows that are computed one by one, each by its function of the context."""
    numbers = [*numbers]
    return lambda context: RowValues(listed([number(context) for number in numbers], context.state.count))


# -- arguments ---------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Argument:
    """An integer of a row: the thing that it numbers, its smallest and largest value, and the meaning of 0."""

    word: str
    first: Callable[[Lens], int]
    last: Callable[[Lens], int]
    nought: str = ""


def _image(lens: Lens) -> int:
    return len(lens.surfaces) - 1


#: Kinds of integers, by the names of `Operand.takes`.
ARGUMENTS = {
    "surface": Argument("surface", lambda lens: 0, _image, "the object"),
    "place": Argument("surface", lambda lens: int(is_at_infinity(lens)), _image, "the object, at a finite distance"),
    "met surface": Argument("surface", lambda lens: 1, _image),
    "contribution": Argument("surface", lambda lens: 0, lambda lens: _image(lens) - 1, "all of them"),
    "wavelength": Argument("wavelength", lambda lens: 0, lambda lens: len(lens.wavelengths), "the primary one"),
    "colour": Argument("wavelength", lambda lens: 0, lambda lens: len(lens.wavelengths), "all by their weights"),
    "shortest": Argument("wavelength", lambda lens: 0, lambda lens: len(lens.wavelengths), "the shortest"),
    "longest": Argument("wavelength", lambda lens: 0, lambda lens: len(lens.wavelengths), "the longest"),
    "field": Argument("field", lambda lens: 0, lambda lens: len(lens.fields.x), "the largest"),
    "configuration": Argument("configuration", lambda lens: 1, lambda lens: len(lens.configurations)),
    "primary": Argument("wavelength", lambda lens: 1, lambda lens: len(lens.wavelengths)),
}


def need(line: Line, kind: str, number: int, lens: Lens) -> int:
    """The number, if the lens has the surface or term that it names. Raises BadRow."""
    argument = ARGUMENTS[kind]
    first, last = argument.first(lens), argument.last(lens)
    if not first <= number <= last:
        meant = f" (0: {argument.nought})" if argument.nought and first == 0 else ""
        here = f"{argument.word}s {first} to {last}" if last > first else f"{argument.word} {last} alone"
        raise BadRow(line, f"names {argument.word} {number}: this lens has {here}{meant}")
    return number


def need_all(line: Line, operand: Operand, lens: Lens) -> None:
    """Check the integers of a row. Raises BadRow."""
    for kind, number in zip(operand.takes, line.row.integers, strict=True):
        if kind:
            need(line, kind, number, lens)


# -- functions of the lens ---------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Measure:
    """A user-defined operand: its name, and a function from a lens to a tensor () or (k,).

    The lens is in the configuration of the row, with its apertures. Several numbers count by their length √Σ v²; with
    a target of 0 the solver uses each. length: the power of mm in them, which become the unit of the rows.
    """

    name: str
    function: Callable[[Lens], torch.Tensor]
    length: int = 0

    def __call__(self, lens: Lens) -> torch.Tensor:
        return self.function(lens)

    def __str__(self) -> str:
        return self.name


def measured(function: Callable[[Lens], torch.Tensor]) -> Operand:
    """The operand of rows of a `Measure`, or of a plain function."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        is_scalar: list[bool] = []

        def numbers(lens: Lens) -> Sequence[torch.Tensor]:
            result = function(lens)
            if not isinstance(result, torch.Tensor) or result.dim() > 1 or not result.numel():
                shape = list(result.shape) if isinstance(result, torch.Tensor) else type(result).__name__
                raise TypeError(f"row {lines[0].number} of the merit function: {shape}, expected a tensor () or (k,)")
            is_scalar[:] = [result.dim() == 0]
            return list(result.reshape(-1))

        numbers_or_none = OrLost(lines[0], lambda context: context.state.through_torch(numbers, clips=True))

        def evaluate(context: EvaluationContext) -> RowValues:
            def alike(number: Number) -> Number:
                return listed([number] * len(lines), context.state.count)

            parts = numbers_or_none(context)
            if parts is None or is_scalar[0]:
                return RowValues(alike(np.nan if parts is None else parts[0]))
            return RowValues(alike(np.sqrt(sum(number * number for number in parts))), tuple(map(alike, parts)))

        return evaluate

    text = f"{Row(function).name}, a function of the lens"
    return Operand(plan, text, length=getattr(function, "length", 0))


class OrLost:
    """Numbers of a state, or None where the lens of a later state does not have them. Raises BadRow for the first."""

    def __init__(self, line: Line, numbers: Callable[[EvaluationContext], Sequence]):
        self.line, self.numbers, self.succeeded = line, numbers, False

    def __call__(self, context: EvaluationContext) -> Sequence | None:
        try:
            numbers = self.numbers(context)
        except ValueError as error:
            if not self.succeeded:
                raise BadRow(self.line, f"has no value: {error}") from error
            return None
        self.succeeded = True
        return numbers


class Operands(dict[str | Callable, Operand]):
    """Operands by name; the operand of a function of a lens is made from it."""

    def __contains__(self, operand: object) -> bool:
        return callable(operand) or super().__contains__(operand)

    def __missing__(self, operand: object) -> Operand:
        if not callable(operand):
            raise KeyError(operand)
        return measured(operand)
