"""Plan of the rows of a merit function, made once, and `EvaluationContext`, the lens at given variables.

An operand is a row of a table (`table.OPERANDS`); all rows of one operand in one configuration are evaluated
together.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from raytrace.optimization.conventions import Conventions
from raytrace.optimization.lens_model import View
from raytrace.optimization.lens_state import LensState
from raytrace.optimization.ray_bundle import Bundle, Hits
from raytrace.system.optimization_data import Row

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


class BadRow(ValueError):
    """A row with an argument that the lens does not have."""

    def __init__(self, line: Line, words: str):
        super().__init__(f"row {line.number} of the merit function: {line.row.name} {words}")


class RowValues(NamedTuple):
    """Values of rows (R,), plain or dual, nan where a ray is lost.

    parts: several (R,) or (K, R), whose squares sum up to the square of the value, and which are smooth where it is 0.
    sides: of rows that are off their target by Σ max(0, e): the row of each e (K,), e (K,), also below 0, and its
    surface (K,).
    """

    values: object
    parts: tuple = ()
    sides: tuple = ()


#: Values of rows at a state; rows of arithmetic take those of earlier rows, by their number.
Evaluate = Callable[["EvaluationContext"], RowValues]


@dataclasses.dataclass(frozen=True)
class Operand:
    """One operand of merit functions.

    plan: from its rows in one configuration and a `Planner` to their `Evaluate`. text: description, with its arguments.
    length: power of length of its unit, as -1 of a curvature; values are in mm, given in `OptimizationData.unit`.
    convention: the convention chosen where the field's own program leaves the meaning open.
    takes: the two integers of its rows, keys of `arguments.ARGUMENTS`; "" for one that is not read.
    refers: of an operand of arithmetic, the numbers of the rows that a row takes values of, among all rows.
    bounds: of an operand that is its target where a boundary is kept, the relation to it: ">=" or "<=".
    """

    plan: Callable[[Sequence[Line], "Planner"], Evaluate]
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
        self._shared: dict = {}

    @property
    def image(self) -> int:
        return len(self.lens.surfaces) - 1

    def ray(
        self, line: Line, *, surface: int | None = None, field=None, pupil=None, wavelength: int | None = None
    ) -> int:
        """The number of the ray of a row behind a surface, the image by default. Raises BadRow."""
        number = line.wavelength if wavelength is None else wavelength
        if not 0 <= number < len(self.view.wavelengths):
            have = len(self.view.wavelengths)
            raise BadRow(line, f"names wavelength {number + 1}: this lens has wavelengths 1 to {have}")
        last = self.image if surface is None else self.checked(line, surface)
        of, at = line.field if field is None else field, line.pupil if pupil is None else pupil
        return self.ask(number, of, at, surface=last)

    def ask(self, wavelength: int, field, pupil, *, surface: int | None = None, clips: bool = False) -> int:
        """The number of any ray behind a surface, the image by default; clips: of those that apertures may stop."""
        last = self.image if surface is None else surface
        if (last, clips) not in self.bundles:
            self.bundles[last, clips] = Bundle(self.view.clipping if clips else self.view, last)
        return self.bundles[last, clips].ask(wavelength, field, pupil)

    def checked(self, line: Line, surface: int) -> int:
        """The number of a surface, if the lens has it. Raises BadRow."""
        if not 0 <= surface <= self.image:
            raise BadRow(line, f"names surface {surface}: this lens has surfaces 0 to {self.image}")
        return surface

    def rays(self, lines: Sequence[Line], **options) -> np.ndarray:
        return np.array([self.ray(line, **options) for line in lines])

    def shared(self, kind: type):
        """The instance of a class that rows of several operands share, made of the planner."""
        if kind not in self._shared:
            self._shared[kind] = kind(self)
        return self._shared[kind]


class EvaluationContext:
    """The lens in one configuration at given variables: its state and its rays, traced when they are first needed."""

    def __init__(self, planner: Planner, state: LensState, values: dict[int, object]):
        self.planner, self.state, self.values = planner, state, values
        self._hits: dict[tuple[int, bool], Hits] = {}
        self._once: dict = {}

    def once(self, function: Callable, *arguments):
        """function(context, *arguments), computed once."""
        key = function, *arguments
        if key not in self._once:
            self._once[key] = function(self, *arguments)
        return self._once[key]

    def hits(self, rays: np.ndarray, *, surface: int | None = None, clips: bool = False) -> Hits:
        """Rays by their numbers behind a surface, the image by default; surface, clips: those of `Planner.ask`."""
        at = self.planner.image if surface is None else surface, clips
        if at not in self._hits:
            self._hits[at] = self.planner.bundles[at].hits(self.state)
        return self._hits[at].at(rays)

    def starts(self, rays: np.ndarray, surface: int) -> Hits:
        """Rays behind a surface at their launch, before surface 1 and in its axes."""
        return self.planner.bundles[surface, False].starts(self.state).at(rays)
