"""The table of operands, by name."""

from raytrace.optimization.operands.aberrations import ABERRATIONS
from raytrace.optimization.operands.arithmetic import ARITHMETIC
from raytrace.optimization.operands.boundaries import BOUNDARIES
from raytrace.optimization.operands.mtf import MODULATION
from raytrace.optimization.operands.operand import Operands
from raytrace.optimization.operands.paraxial import PARAXIAL
from raytrace.optimization.operands.rays import INCIDENCE, RAYS
from raytrace.optimization.operands.wavefront import PATH, QUALITY

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
