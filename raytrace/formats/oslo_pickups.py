"""Pickups of an OSLO lens file: numbers of a surface that are those of one before it.

PK GLA -k is the medium of the surface k before. CV and TH are its curvature and its thickness, to which a number may be
added, CVM and THM those with their signs changed; with a curvature go conic and terms.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch

from raytrace.formats.oslo_keywords import Surface as Commands
from raytrace.formats.report import Draft
from raytrace.formats.source import LensFileError, UnsupportedSurface, shown
from raytrace.formats.spelling import double
from raytrace.formats.zemax_keywords import Record
from raytrace.media.glass import Glass
from raytrace.system.surface import Surface


class Built(NamedTuple):
    """A surface, and the commands that it was made of."""

    surface: Surface
    commands: Commands


def curved(number: float) -> torch.Tensor | None:
    """A number of a shape, None where it is 0 and the surface has none of it."""
    return double(number) if number else None


def what(record: Record) -> str:
    """What a pickup picks up."""
    return record.words[0].upper() if record.words else ""


def picked_up(commands: Commands, before: Sequence[Built], unit: float, report: Draft) -> dict:
    """The fields of a surface that are those of one before it. Raises LensFileError and UnsupportedSurface."""
    fields = {}
    for record in commands.all("PK"):
        kind = what(record)
        pickup = _PICKUPS.get(kind)
        if pickup is None or len(record.words) not in (2, 2 + pickup.adds):
            message = f"PK {shown(' '.join(record.words))} (a pickup) is not modelled, but of {', '.join(_PICKUPS)}"
            raise UnsupportedSurface(message, record.place)
        back = -record.integer(1, "surface to pick up from")
        if not 0 < back <= len(before):
            message = f"PK {kind} {record.words[1]}: expected how many surfaces before this one, as -2"
            raise UnsupportedSurface(message, record.place)
        _refuse_other_sources(record, pickup.instead, commands, before[-back].commands)
        added = record.number(2, "number to add", 0.0)
        fields |= pickup.fields(before[-back].surface, added, unit)
        if kind == "GLA":
            _report_medium(record, fields["glass"], len(before) - back, report)
    return fields


def _refuse_other_sources(record: Record, instead: Sequence[str], commands: Commands, source: Commands) -> None:
    """Raise where a picked-up number is told beside the pickup, or is itself solved for."""
    pickup = " ".join(record.words[:2])
    for word in instead:
        if other := commands.last(word):
            message = (
                f"{word} in line {other.place.line} and PK {pickup} tell the same number twice; delete one of them"
            )
            raise LensFileError(message, record.place)
        if word in _SOLVES and source.last(_SOLVES[word]):
            raise UnsupportedSurface(f"PK {pickup} of what is solved for there is not modelled", record.place)


#: The solve for the number of a command.
_SOLVES = {"RD": "PU", "TH": "PY"}


def _report_medium(record: Record, glass: Glass, surface: int, report: Draft) -> None:
    if glass.formula == "mirror":
        raise UnsupportedSurface(f"PK GLA {record.words[1]} picks up a mirror, which is not modelled", record.place)
    report.glass(record.place.surface, glass.name, f"that of surface {surface}")


def _profile(surface: Surface, added: float, unit: float, sign: float) -> dict:
    """The curvature, to which a number is added, with the conic and the terms that belong to it."""
    curvature = sign * (float(surface.curvature) if surface.curvature is not None else 0.0) + added / unit
    terms = None if surface.coefficients is None else sign * surface.coefficients
    return {"curvature": curved(curvature), "conic": surface.conic, "coefficients": terms}


def _length(surface: Surface, added: float, unit: float, sign: float) -> dict:
    return {"thickness": double(sign * float(surface.thickness) + added * unit)}


class Pickup(NamedTuple):
    """Fields of a surface from one before it, whether a number may be added, and the commands that tell the same."""

    fields: Callable[[Surface, float, float], dict]
    adds: bool
    instead: tuple[str, ...]


_PICKUPS = {
    "GLA": Pickup(lambda surface, _, __: {"glass": surface.glass}, False, ("AIR", "GLA", "RFL", "RFH")),
    "CV": Pickup(partial(_profile, sign=1.0), True, ("RD", "CV", "CC", "AD", "AE", "AF", "AG")),
    "CVM": Pickup(partial(_profile, sign=-1.0), True, ("RD", "CV", "CC", "AD", "AE", "AF", "AG")),
    "TH": Pickup(partial(_length, sign=1.0), True, ("TH",)),
    "THM": Pickup(partial(_length, sign=-1.0), True, ("TH",)),
}
