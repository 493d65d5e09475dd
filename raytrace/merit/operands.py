"""The table of operands, by name."""

from raytrace.merit.arithmetic import ARITHMETIC
from raytrace.merit.boundaries import BOUNDARIES
from raytrace.merit.incidence import INCIDENCE
from raytrace.merit.paraxial import PARAXIAL
from raytrace.merit.path import PATH
from raytrace.merit.plan import Operand
from raytrace.merit.quality import QUALITY
from raytrace.merit.rays import RAYS

OPERANDS: dict[str, Operand] = {
    **RAYS,
    **PARAXIAL,
    **INCIDENCE,
    **PATH,
    **QUALITY,
    **BOUNDARIES,
    **ARITHMETIC,
}
