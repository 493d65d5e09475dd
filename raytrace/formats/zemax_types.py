"""The types of surface of a .zmx file that are modelled: a row each, and the type that a surface is written as."""

from raytrace.formats.zemax_numbers import SurfaceType
from raytrace.formats.zemax_phases import OF_PHASES, PHASES_AND_BREAKS
from raytrace.formats.zemax_sags import OF_DEPARTURES, SAGS, round_types
from raytrace.system.phases import IdealLens
from raytrace.system.shapes import EVEN, KINDS
from raytrace.system.surface import Surface


def types() -> dict[str, SurfaceType]:
    """Every type that is modelled, STANDARD first."""
    return {"STANDARD": SAGS["STANDARD"]} | round_types() | SAGS | PHASES_AND_BREAKS


def type_of(surface: Surface) -> str | None:
    """The TYPE that a surface is written as; None where a .zmx file has none."""
    if surface.is_break:
        return "COORDBRK"
    if surface.phase is not None:
        return _type_of_phase(surface)
    if surface.departure is not None:
        return OF_DEPARTURES.get(type(surface.departure).__name__)
    if surface.coefficients is None:
        return "STANDARD"
    kind = KINDS[surface.kind]
    longer = surface.kind == EVEN and len(surface.coefficients) > kind.parameters
    return "XASPHERE" if longer else kind.zemax


def _type_of_phase(surface: Surface) -> str | None:
    phase = surface.phase
    if isinstance(phase, IdealLens) and phase.power_x.dim() == 0 and float(phase.power_x) == float(phase.power_y) != 0:
        return "PARAXIAL"
    return OF_PHASES.get(type(phase).__name__)
