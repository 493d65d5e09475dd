"""A lens scaled by a factor: all of its lengths, and every number that depends on a length, by its power.

Rays of the scaled lens are the rays of the lens, scaled: wavelengths, indices, angles, F-number and magnification stay.
Its wavefront errors are the factor times as many waves.
"""

import dataclasses
import math
from typing import Any

import torch
from torch import Tensor

from raytrace.edit.choice import BadEdit, LeftAsItWas, warn_of
from raytrace.io.zemax.optimization import CURVATURE_SOLVES, THICKNESS_SOLVES
from raytrace.io.zemax.tolerances import ToleranceLine, rewritten
from raytrace.maths.numerics import varies
from raytrace.system.configurations import Operand, ScaledPath, part, with_part
from raytrace.system.dimensions import power_at, power_of_row, scaled, scaled_numbers
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData, Row, Solve, Vary
from raytrace.system.parameter_paths import OF_LENS, UnknownNumber, modelled, path_of
from raytrace.tracing.paraxial import first_order
from raytrace.words import option

#: Powers of length of the numbers of a solve, by its kind.
_SOLVES = {row.kind: row.powers for row in (*CURVATURE_SOLVES.values(), *THICKNESS_SOLVES.values())} | {
    "focal_length": (1,)
}


def scale(lens: Lens, factor: Tensor | float | None = None, *, efl: Tensor | float | None = None) -> Lens:
    """The lens scaled by a factor, or to an effective focal length `efl` in mm; both with derivatives.

    Radii, thicknesses, terms of aspheres, phases, semi-diameters, apertures, decentres, the object distance, heights of
    fields and the size of the beam are scaled by their power of length, as are the numbers of configurations, bounds of
    variables, solves, offsets of pickups, the margin of semi-diameters, limits of tolerances, and targets and
    frequencies of merit rows. Limits in fringes, degrees and %, targets in waves, grooves per µm and coatings stay.
    Warns `LeftAsItWas` of targets and limits of an unknown unit. A title gets the factor.

    Raises BadEdit for a factor that is not above 0, and for an `efl` where the lens is afocal or has the other sign.
    """
    if (factor is None) == (efl is None):
        raise BadEdit(f"scale: give {option('factor')} or {option('efl')}, one of the two")
    if efl is not None:
        now = first_order(lens).effective_focal_length
        factor = efl / now
        if not 0 < _plain(factor) < math.inf:
            raise BadEdit(f"{option('efl', f'{_plain(efl):g}')}: the lens has an EFL of {_plain(now):g} mm")
    size = _plain(factor)
    if not 0 < size < math.inf:
        raise BadEdit(f"scale by {size:g}: expected a factor above 0; to turn the lens around: reverse")
    by: Any = factor if varies(factor) else size
    unscaled: list[str] = []
    operands = tuple(_operand(operand, lens, by) for operand in lens.operands)
    data = lens.optimization_data
    new = dataclasses.replace(
        scaled(lens, by),
        operands=operands,
        optimization_data=None if data is None else _data(data, lens, size, unscaled),
        name=lens.name and f"{lens.name}, scaled by {size:.6g}",
    )
    warn_of(LeftAsItWas, "scale: of an unknown unit, and left as they were", unscaled)
    return new


def _plain(number: Tensor | float | None) -> float:
    """A number without its derivatives; nan of None."""
    return math.nan if number is None else float(number.detach() if isinstance(number, Tensor) else number)


def _operand(operand: Operand, lens: Lens, factor: Tensor | float) -> Operand:
    if not operand.paths:
        return operand
    if operand.numbers is None:
        words = tuple(
            tuple(
                part(scaled(with_part(lens, path, word), factor), path)
                for (path, *_), word in zip(operand.paths, each, strict=True)
            )
            for each in operand.words
        )
        return dataclasses.replace(operand, words=words)
    powers = [power_at(lens, scaled_path.path) for scaled_path in operand.paths]
    # the first path holds factor · number + offset
    first = powers[0]
    paths = tuple(
        ScaledPath(path, scale * _plain(factor) ** (power - first), offset * _plain(factor) ** power)
        for (path, scale, offset), power in zip(operand.paths, powers, strict=True)
    )
    finite = torch.isfinite(operand.numbers)
    numbers = torch.where(finite, scaled(torch.where(finite, operand.numbers, 1.0), factor, first), operand.numbers)
    return dataclasses.replace(operand, numbers=numbers, paths=paths)


def _data(data: OptimizationData, lens: Lens, factor: float, unscaled: list[str]) -> OptimizationData:
    percent, length = data.semi_diameter_margin

    def of_operand(number: int) -> int | None:
        held = lens.operands[number - 1] if 1 <= number <= len(lens.operands) else None
        return power_at(lens, held.paths[0].path) if held is not None and held.paths else None

    def of_row(number: int, row: Row) -> Row:
        power = power_of_row(data.merit, number, of_operand) if row.target else 0
        if power is None:
            unscaled.append(f"target {row.target:g} of row {number} {row.name}")
        return dataclasses.replace(row, target=row.target * factor ** (power or 0), numbers=scaled_numbers(row, factor))

    def of_line(line: ToleranceLine) -> list[ToleranceLine]:
        power = line.power(lens)
        if power is None:
            unscaled.append(f"tolerance {line}")
        return [line.scaled(factor**power) if power else line]

    return dataclasses.replace(
        data,
        variables=tuple(_variable(rule, lens, factor) for rule in data.variables),
        solves=tuple(_solve(rule, lens, factor, unscaled) for rule in data.solves),
        kept=tuple(_solve(rule, lens, factor, unscaled) for rule in data.kept),
        merit=tuple(of_row(number, row) for number, row in enumerate(data.merit, 1)),
        tolerances=rewritten(data.tolerances, of_line),
        semi_diameter_margin=(percent, length * factor),
    )


def _power_of(lens: Lens, surface: int, quantity: str, operand: int | None = None) -> int | None:
    """The power of length in the number of a rule; None where it is not known."""
    if operand is not None:
        return power_at(lens, lens.operands[operand].paths[0].path) if lens.operands[operand].paths else None
    if (surface, quantity) in OF_LENS:
        return power_at(lens, OF_LENS[surface, quantity].path)
    try:
        steps = path_of(modelled(lens.surfaces[surface], quantity), quantity).steps
    except UnknownNumber:
        return 0 if quantity in ("glass", "semi_diameter") else None
    return power_at(modelled(lens.surfaces[surface], quantity), steps)


def _variable(rule: Vary, lens: Lens, factor: float) -> Vary:
    power = _power_of(lens, rule.surface, rule.quantity, rule.operand) or 0
    return dataclasses.replace(rule, bounds=tuple(end * factor**power for end in rule.bounds))


def _solve(rule: Solve, lens: Lens, factor: float, unscaled: list[str]) -> Solve:
    """A solve whose numbers are scaled: those of its kind, or the offset and, between unlike numbers, the factor."""
    if rule.kind in ("pickup", "thermal"):
        power = _power_of(lens, rule.surface, rule.quantity, rule.operand)
        source = power if rule.operand is not None else _power_of(lens, *rule.address_of_source)
        if power is None or source is None:
            unscaled += [f"pickup {rule}"] if rule.offset else []
            return rule
        return dataclasses.replace(
            rule, scale=rule.scale * factor ** (power - source), offset=rule.offset * factor**power
        )
    if rule.kind == "PZUP" and len(rule.numbers) > 2:
        source_of, times, offset, *rest = rule.numbers
        return dataclasses.replace(rule, numbers=(source_of, times, offset * factor, *rest))
    if rule.kind not in _SOLVES and any(rule.numbers):
        unscaled.append(f"solve {rule}")
        return rule
    powers = _SOLVES.get(rule.kind, ())
    numbers = [number * factor**power for number, power in zip(rule.numbers, powers, strict=False)]
    return dataclasses.replace(rule, numbers=(*numbers, *rule.numbers[len(numbers) :]))
