"""The table of operands, by name."""

from collections.abc import Callable

from raytrace.optimization.context import Operand
from raytrace.optimization.operands.aberrations import ABERRATIONS
from raytrace.optimization.operands.arithmetic import ARITHMETIC
from raytrace.optimization.operands.boundaries import BOUNDARIES
from raytrace.optimization.operands.custom import measured
from raytrace.optimization.operands.mtf import MODULATION
from raytrace.optimization.operands.paraxial import PARAXIAL
from raytrace.optimization.operands.rays import INCIDENCE, RAYS
from raytrace.optimization.operands.wavefront import PATH, QUALITY


class Operands(dict[str | Callable, Operand]):
    """Operands by name; a function of a lens stands for itself."""

    def __contains__(self, operand) -> bool:
        return callable(operand) or super().__contains__(operand)

    def __missing__(self, operand) -> Operand:
        if not callable(operand):
            raise KeyError(operand)
        return measured(operand)


OPERANDS = Operands(
    {
        **RAYS,
        **PARAXIAL,
        **ABERRATIONS,
        **INCIDENCE,
        **PATH,
        **QUALITY,
        **MODULATION,
        **BOUNDARIES,
        **ARITHMETIC,
    }
)
