"""The table of operands, by name."""

from raytrace.merit.boundaries import BOUNDARIES
from raytrace.merit.paraxial import PARAXIAL
from raytrace.merit.path import PATH
from raytrace.merit.plan import Operand
from raytrace.merit.quality import QUALITY
from raytrace.merit.rays import RAYS

OPERANDS: dict[str, Operand] = {**RAYS, **PARAXIAL, **PATH, **QUALITY, **BOUNDARIES}

#: Rows that say something about the rows below them, or to the reader.
SETTINGS = {
    "CONF": "the configuration of the rows below",
    "PRIM": "the primary wavelength of the rows below",
    "BLNK": "text",
    "DMFS": "where the default merit function starts",
    "USYM": "the lens is taken for symmetric",
}
