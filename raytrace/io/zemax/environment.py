"""Temperature and pressure of a .zmx file: of the lens by ENVD, of some surfaces by its operands.

    ENVD 1.0E+2 1 1      °C, atm, and whether indices follow them: by 0 they are those of the catalogs

TEMP and PRES of the multi-configuration table hold for the surfaces that operands behind them name (CRVT, THIC, GLSS),
up to the next one of the same name; the last is the lens's own, which ENVD repeats. So OpticStudio's sample of a cell
without air is in_words, and with that its stored image distance is met to 4e-12 mm.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import torch

from raytrace.io.report import Draft
from raytrace.io.source import LensFileError, Place
from raytrace.io.spelling import double, exact
from raytrace.io.zemax.keywords import Block, Sections
from raytrace.io.zemax.operands import UNTOLD, Cell
from raytrace.materials.environment import REFERENCE, Environment, in_words, objection
from raytrace.system import configurations
from raytrace.system.configurations import Operand
from raytrace.system.lens import Lens, unknown_changes
from raytrace.system.surface import Surface

#: The operands of an environment, each with the field of `Environment` that it sets.
OPERANDS = {"TEMP": "temperature", "PRES": "pressure"}
#: The operands that name a surface to be in it.
_NAMING = ("CRVT", "THIC", "GLSS")


# -- reading ----------------------------------------------------------------------------------------------------------


def environment(system: Block) -> Environment | None:
    """The environment of ENVD; None where indices do not follow it. Raises LensFileError for what no air has."""
    record = system.last("ENVD")
    if record is None or not record.integer(2, "whether indices follow the environment", 0):
        return None
    return _checked(record.number(0, "temperature"), record.number(1, "pressure"), record.place)


def _checked(temperature: float, pressure: float, place: Place) -> Environment:
    found = Environment(double(temperature), double(pressure))
    if wrong := objection(found):
        raise LensFileError(wrong.replace("`", ""), place)
    return found


def placed(surfaces: Sequence[Surface], blocks: Sequence[Block], around: Environment | None) -> tuple[Surface, ...]:
    """The surfaces, those in an environment of their own with it (`zemax_operands.applied` writes it into a block)."""
    if around is None:
        return tuple(surfaces)
    found = list(surfaces)
    for k, block in enumerate(blocks):
        if record := block.last("ENVD"):
            pairs = zip(record.words, (around.temperature, around.pressure), OPERANDS.values(), strict=True)
            numbers = [float(own) if w == UNTOLD else record.number(k, what) for k, (w, own, what) in enumerate(pairs)]
            found[k] = dataclasses.replace(found[k], environment=_checked(*numbers, record.place))
    return tuple(found)


def with_covered(groups: Sequence[tuple[Cell, ...]]) -> list[tuple[Cell, ...]]:
    """The operands, those of an environment that is not the lens's with the surfaces that are in it."""
    found = list(groups)
    for name in OPERANDS:
        starts = [k for k, group in enumerate(groups) if group[0].name == name]
        for start, end in itertools.pairwise(starts):
            between = (group[0] for group in groups[start + 1 : end])
            covered = tuple(dict.fromkeys(one.number for one in between if one.name in _NAMING))
            found[start] = tuple(one._replace(covered=covered) for one in groups[start])
    return found


def tell(found: Sections, lens: Lens, report: Draft) -> None:
    """Say what the lens makes of its environment, and of which glasses not enough is known."""
    record = found.system.last("ENVD")
    if lens.environment is not None:
        report.note(f"indices are those at {in_words(lens.environment)} (ENVD); radii and thicknesses stay as stored")
    elif record and record.words:
        place = record.number(0, "temperature"), record.number(1, "pressure", REFERENCE[1])
        if place != REFERENCE:
            message = f"environment of {place[0]:g} °C and {place[1]:g} atm, which indices do not follow (ENVD, third"
            report.warn(f"{message} number 0): they are the catalogs'", record.place)
    for number, message in unknown_changes(lens).items():
        glass = found.surfaces[number].last("GLAS")
        report.warn(message, glass.place if glass else found.surfaces[number].place)


# -- writing ----------------------------------------------------------------------------------------------------------


def line(lens: Lens, place: Place) -> str:
    """The line of ENVD."""
    if lens.environment is None:
        return "ENVD 20 1 0"
    return " ".join(["ENVD", *(exact(getattr(lens.environment, name), name, place) for name in OPERANDS.values()), "1"])


def is_of_surfaces(operand: Operand) -> bool:
    """Whether an operand sets the environment of some surfaces, and not that of the lens."""
    return operand.name in OPERANDS and bool(operand.paths) and operand.paths[0].path[0] == "surfaces"


def with_operands(lens: Lens, place: Place) -> Lens:
    """The lens with operands that tell the environments of its surfaces to a reader: see the head of this file.

    Raises LensFileError where the lens has none itself, for indices then follow none in such a file.
    """
    untold = [k for k, surface in enumerate(lens.surfaces) if surface.environment is not None and not _is_told(lens, k)]
    if lens.environment is None and untold:
        message = "a surface in an environment of its own, of a lens without one; give it one, as lens.at(pressure=1)"
        raise LensFileError(message, place._replace(surface=untold[0]))
    listed = [one for k in untold for one in (*_operands(lens, "surfaces", k), _naming(lens, k))]
    listed = _named([*listed, *lens.operands], lens)
    for name, last in zip(OPERANDS, _operands(lens) if lens.environment else (), strict=False):
        of_name = [one for one in listed if one.name == name]
        listed += [last] if of_name and is_of_surfaces(of_name[-1]) else []
    return dataclasses.replace(lens, operands=tuple(listed))


def _is_told(lens: Lens, k: int) -> bool:
    """Whether operands of the lens set the environment of a surface; what they do not set of it is the lens's."""
    if lens.environment is None:
        return False
    held = {path for operand in lens.operands for path, *_ in operand.paths}
    own = {name: ("surfaces", k, "environment", name) in held for name in OPERANDS.values()}
    as_around = [configurations.same(*(getattr(h.environment, n) for h in (lens.surfaces[k], lens))) for n in own]
    return any(own.values()) and all(map(max, own.values(), as_around))


def _named(listed: list[Operand], lens: Lens) -> list[Operand]:
    """The operands, each that is of surfaces followed by some that name them."""
    found = []
    for position, one in enumerate(listed):
        found.append(one)
        if is_of_surfaces(one):
            behind = itertools.takewhile(lambda other, name=one.name: other.name != name, listed[position + 1 :])
            named = {other.number for other in behind if other.name in _NAMING}
            found += [_naming(lens, path[1]) for path, *_ in one.paths if path[1] not in named]
    return found


def _naming(lens: Lens, k: int) -> Operand:
    """An operand that changes nothing and names a surface."""
    media = (lens.surfaces[k].glass,) * configurations.count(lens.operands)
    return Operand("GLSS", k, paths=(configurations.ScaledPath(("surfaces", k, "glass")),), media=media)


def _operands(lens: Lens, *path: str | int) -> list[Operand]:
    """Temperature and pressure of the lens, or of one of its surfaces, alike in all configurations."""
    found, count = configurations.part(lens, (*path, "environment")), configurations.count(lens.operands)
    return [
        Operand(
            name,
            paths=(configurations.ScaledPath((*path, "environment", field)),),
            numbers=torch.stack([getattr(found, field)] * count),
        )
        for name, field in OPERANDS.items()
    ]
