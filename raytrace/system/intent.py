"""Intent: what a designer means a lens to become: numbers that vary, numbers that follow, and the merit function.

A lens file stores solved values beside the rule that made them. The numbers of a `Lens` are always those values; the
rules stand here, and hold while the lens is optimised.
"""

from raytrace.maths.value import value


@value
class Vary:
    """A number that an optimisation may change.

    surface: of the file; quantity: "thickness", "curvature", or another name of `places.places`, as "conic", "a4",
    "tilt_x"; "index", "abbe_number" of a model glass.
    configuration, operand: of a number that differs from one configuration to the next, which (from 1), and which of
    `lens.operands` (from 0) it belongs to; surface and quantity are those of the operand. 0 and None: the lens's own.
    """

    surface: int
    quantity: str
    configuration: int = 0
    operand: int | None = None


@value
class Solve:
    """A number that follows from others, at every moment.

    surface, quantity: as for `Vary`. kind, a key of `merit.solves.SOLVES`, and its numbers:

    "pickup": `scale` times a number of surface `source`, plus `offset`; quantity_of_source: which number, by default
        the one of the same name.
    "marginal_angle": the curvature behind which the paraxial marginal ray has the slope numbers[0].
    "f_number": the curvature behind which the paraxial marginal ray has the slope of the F-number numbers[0].
    "marginal_height": the thickness behind which the marginal ray has the height numbers[0] mm: the paraxial ray, or at
        numbers[1] > 0 the real one through that part of the pupil.

    All at the primary wavelength, in the order of surfaces. numbers: in mm.
    """

    surface: int
    quantity: str
    kind: str
    numbers: tuple[float, ...] = ()
    source: int = 0
    scale: float = 1.0
    offset: float = 0.0
    quantity_of_source: str = ""


@value
class Row:
    """One line of a merit function: an operand, its arguments, and what it is meant to be.

    operand: its name, as "TRAC", a key of `merit.OPERANDS` where it is known; integers, numbers: its arguments as the
        field's programs write them: surfaces, a wavelength (from 1, 0 the primary one) or rows; Hx, Hy, Px, Py or data.
    target, weight: the merit is the weighted mean square of value - target; a weight of 0 shows the value alone.
    text: what a line of text says; further: what else stands in the line.
    Lengths in `Intent.unit`: a merit of lengths and pure numbers depends on the unit, so rows stay as written.
    """

    operand: str
    integers: tuple[int, int] = (0, 0)
    numbers: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    target: float = 0.0
    weight: float = 0.0
    text: str = ""
    further: tuple[float, ...] = ()


@value
class Intent:
    """Everything that a lens file says about how the lens is to be optimised.

    variables, solves: of the numbers of the lens; merit: the lines of its merit function, in order, text included: row
    i of the function is merit[i - 1]; tolerances: lines that are kept as they stand.
    semi_diameters: surfaces whose semi-diameter is given; it follows the rays at all others, larger by
    semi_diameter_margin: per cent, and mm.
    """

    variables: tuple[Vary, ...] = ()
    solves: tuple[Solve, ...] = ()
    merit: tuple[Row, ...] = ()
    unit: float = 1.0
    tolerances: tuple[str, ...] = ()
    semi_diameters: tuple[int, ...] = ()
    semi_diameter_margin: tuple[float, float] = (0.0, 0.0)
