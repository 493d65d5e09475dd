"""The table of operands, by name."""

from collections.abc import Callable

from raytrace.merit.aberrations import ABERRATIONS
from raytrace.merit.arithmetic import ARITHMETIC
from raytrace.merit.boundaries import BOUNDARIES
from raytrace.merit.incidence import INCIDENCE
from raytrace.merit.measure import measured
from raytrace.merit.modulation import MODULATION
from raytrace.merit.paraxial import PARAXIAL
from raytrace.merit.path import PATH
from raytrace.merit.plan import Operand
from raytrace.merit.quality import QUALITY
from raytrace.merit.rays import RAYS


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
