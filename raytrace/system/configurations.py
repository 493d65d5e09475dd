"""Configurations: one lens in several states, as a zoom lens at its ends, by the numbers that differ.

An operand is a number of the lens with a value for every configuration; all other numbers are shared. Configurations
are counted from 1.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from raytrace.materials.glass import Glass, label
from raytrace.maths.value import value

Whole = TypeVar("Whole")

#: From a lens down to one of its parts: names of fields, positions in tuples, and a position (i, …) in a tensor.
Path = tuple[str | int | tuple[int, ...], ...]


class ScaledPath(NamedTuple):
    """Where a lens holds the number of an operand: factor · number + offset, as a pickup has it."""

    path: Path
    factor: float = 1.0
    offset: float = 0.0


@value
class Operand:
    """A number, glass or word of a lens that differs from one configuration to the next.

    name, number, parameter: as OpticStudio has it, "THIC" of surface `number`, "PRAM" of a surface and a parameter,
        "YFIE" of a field point; 0 where the operand has none.
    paths: where the lens holds it; none of an operand that says nothing about rays, as the weight of a configuration.
    numbers: (C,) as the lens holds them, mm or degrees, a value a configuration; or
    media: a glass each; or words: for each configuration what stands in every place.
    refusal: why it is not followed; a configuration in which it differs is refused.
    """

    name: str
    number: int = 0
    parameter: int = 0
    paths: tuple = ()
    numbers: Tensor | None = None
    media: tuple[Glass, ...] = ()
    words: tuple = ()
    refusal: str = ""

    def __len__(self) -> int:
        return max(len(self.media), len(self.words)) if self.numbers is None else len(self.numbers)

    def __str__(self) -> str:
        numbered = " ".join(str(number) for number in (self.number, self.parameter) if number)
        return f"{self.name} {numbered}".strip()

    def values(self) -> list:
        """What it is in every configuration, to be shown: numbers, names of glasses or words."""
        if self.numbers is not None:
            return self.numbers.detach().tolist()
        return [label(glass) for glass in self.media] or [words[0] if words else "" for words in self.words]


def count(operands: Sequence[Operand]) -> int:
    """How many configurations there are."""
    return max((len(operand) for operand in operands), default=1)


def chosen(lens: Whole, number: int) -> Whole:
    """The lens in one of its configurations, 1 to `len(lens.configurations)`, each operand at its value there.

    Raises ValueError for a configuration that there is not, or that differs in what is not followed.
    """
    last = count(lens.operands)
    if not 1 <= number <= last:
        there = f"has configurations 1 to {last}" if last > 1 else "has one configuration"
        raise ValueError(f"configuration {number}: this lens {there}")
    for operand in lens.operands:
        shown = operand.values()
        if operand.refusal and shown[number - 1] != shown[lens.current_configuration - 1]:
            raise ValueError(f"configuration {number}: {operand} = {shown[number - 1]}: {operand.refusal}")
    return with_operands(lens, number)


def with_operands(lens: Whole, number: int) -> Whole:
    """The lens with every operand at its value in a configuration that there is, those aside that are not followed."""
    for operand in lens.operands:
        lens = _with_operand(lens, operand, number - 1)
    return dataclasses.replace(lens, current_configuration=number)


def every(lens: Whole) -> tuple[Whole, ...]:
    """The lens in all its configurations, one after the other; itself alone where it has one."""
    if not lens.operands:
        return (lens,)
    return tuple(chosen(lens, number) for number in range(1, count(lens.operands) + 1))


#: Operands of OpticStudio by the number of a surface that they name.
_NAMES = {"thickness": "THIC", "curvature": "CRVT", "conic": "CONN"}


def made(lens: Whole, **varied: dict[int, Sequence[float]]) -> Whole:
    """The lens with configurations, in the first of them: `thickness={6: [12.4, 16.0]}` differs behind surface 6.

    varied: by name (thickness, curvature, conic) and surface the values in mm, 1/mm, one a configuration. Raises
    ValueError for what a lens does not have, and for numbers of values that differ.
    """
    operands = []
    for name, by_surface in varied.items():
        if name not in _NAMES:
            raise ValueError(f"{name!r} does not differ between configurations; expected one of {', '.join(_NAMES)}")
        for surface, values in by_surface.items():
            if not 0 <= surface < len(lens.surfaces):
                raise ValueError(f"surface {surface}: this lens has surfaces 0 to {len(lens.surfaces) - 1}")
            numbers = torch.as_tensor(values, dtype=lens.wavelengths.dtype, device=lens.wavelengths.device)
            place = ScaledPath(("surfaces", surface, name))
            operands.append(Operand(_NAMES[name], surface, paths=(place,), numbers=numbers))
    if len({operand.numbers.shape for operand in operands}) > 1 or any(one.numbers.ndim != 1 for one in operands):
        raise ValueError("expected lists of values of one length, a value a configuration")
    return with_operands(dataclasses.replace(lens, operands=tuple(operands)), 1)


def kept(lens: Whole) -> Whole:
    """The lens whose operands say of its current configuration what it now holds."""
    operands = tuple(taken(operand, lens, lens.current_configuration - 1) for operand in lens.operands)
    return dataclasses.replace(lens, operands=operands)


def freed(lens: Whole, **conditions) -> Whole:
    """The lens without operands for what conditions of `Lens.at` set: a condition holds in every configuration."""
    if not lens.operands:
        return lens
    starts = [path for name, given in conditions.items() if given is not None for path in _set_by(name, lens)]

    def is_set(operand: Operand) -> bool:
        return any(place.path[: len(start)] == start for place in operand.paths for start in starts)

    operands = (_unused(len(operand)) if is_set(operand) else operand for operand in lens.operands)
    return dataclasses.replace(lens, operands=tuple(operands))


def _set_by(condition: str, lens) -> tuple[Path, ...]:
    """The paths to what a condition of `Lens.at` sets."""
    paths = {
        "object_distance": (("surfaces", 0, "thickness"),),
        "sensor_distance": (("surfaces", len(lens.surfaces) - 2, "thickness"),),
        "f_number": (("aperture",),),
        "entrance_pupil_diameter": (("aperture",),),
        **{name: (("environment", name),) for name in ("temperature", "pressure")},
        "wavelengths": (("wavelengths",), ("wavelength_weights",), ("primary_wavelength",)),
    }
    return paths.get(condition, ((condition,),))


def _unused(configurations: int) -> Operand:
    return Operand("MOFF", words=(("",),) * configurations)


def _with_operand(lens: Whole, operand: Operand, k: int) -> Whole:
    """The lens with an operand at its value of configuration k, from 0."""
    for position, (path, factor, offset) in enumerate(operand.paths):
        if operand.numbers is not None:
            plain = (factor, offset) == (1.0, 0.0)
            part = operand.numbers[k] if plain else factor * operand.numbers[k] + offset
        else:
            part = operand.media[k] if operand.media else operand.words[k][position]
        lens = with_part(lens, path, part)
    return lens


def taken(operand: Operand, lens: Whole, k: int) -> Operand:
    """The operand that has for configuration k what the lens holds in its paths."""
    if not operand.paths or operand.refusal:
        return operand
    held = [part(lens, place.path) for place in operand.paths]
    if operand.numbers is not None:
        number = torch.zeros_like(operand.numbers[k]) if held[0] is None else held[0]
        return dataclasses.replace(operand, numbers=_with_entry(operand.numbers, (k,), number))
    if operand.media:
        return dataclasses.replace(operand, media=(*operand.media[:k], held[0], *operand.media[k + 1 :]))
    return dataclasses.replace(operand, words=(*operand.words[:k], tuple(held), *operand.words[k + 1 :]))


# -- parts of a value by their paths ----------------------------------------------------------------------------------


def part(whole, path: Path):
    """What a value holds at the end of a path; None where the way there is not modelled."""
    for step in path:
        if not _leads_on(whole, step):
            return None
        whole = getattr(whole, step) if isinstance(step, str) else whole[step]
    return whole


def with_part(whole: Whole, path: Path, new, *, like=None) -> Whole:
    """The value with something else at the end of a path; where the way there is not modelled it is that of `like`."""
    if not path:
        return new
    step, *rest = path
    if not _leads_on(whole, step):
        whole = _padded(whole, like) if isinstance(whole, Tensor) else like
    if isinstance(whole, Tensor):
        return _with_entry(whole, step, new)
    inner = with_part(part(whole, (step,)), tuple(rest), new, like=part(like, (step,)))
    if isinstance(step, str):
        return dataclasses.replace(whole, **{step: inner})
    return (*whole[:step], inner, *whole[step + 1 :])


def _leads_on(whole, step: str | int | tuple[int, ...]) -> bool:
    if isinstance(whole, Tensor):
        return len(step) == whole.ndim and all(k < size for k, size in zip(step, whole.shape, strict=True))
    return step < len(whole) if isinstance(whole, tuple) else whole is not None


def _padded(numbers: Tensor, like: Tensor) -> Tensor:
    """(n,) numbers with zeros up to as many as others have."""
    return torch.cat([numbers, numbers.new_zeros(len(like) - len(numbers))])


def differences(one, other, path: Path = ()) -> Iterator[Path]:
    """The paths to where two values differ, as far down as both go; a glass is not gone into."""
    if one is other:
        return
    if type(one) is not type(other) or isinstance(one, Glass):
        if type(one) is not type(other) or not same(one, other):
            yield path
    elif isinstance(one, tuple) and len(one) == len(other) and type(one) is tuple:
        for position, pair in enumerate(zip(one, other, strict=True)):
            yield from differences(*pair, (*path, position))
    elif dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            yield from differences(getattr(one, field.name), getattr(other, field.name), (*path, field.name))
    elif isinstance(one, Tensor) and one.shape == other.shape and one.ndim:
        yield from ((*path, tuple(index)) for index in torch.nonzero(one != other).tolist())
    elif not same(one, other):
        yield path


def same(one, other) -> bool:
    """Whether two parts of a value are alike, number for number."""
    if isinstance(one, Tensor):
        return isinstance(other, Tensor) and torch.equal(one, other)
    if dataclasses.is_dataclass(one) and type(one) is type(other):
        names = [field.name for field in dataclasses.fields(one)]
        return all(same(getattr(one, name), getattr(other, name)) for name in names)
    return one == other


def _with_entry(numbers: Tensor, entry: tuple[int, ...], number: Tensor) -> Tensor:
    """A tensor with another number in one place, without writing into it."""
    is_there = torch.zeros(numbers.shape, dtype=torch.bool, device=numbers.device)
    is_there[entry] = True
    return torch.where(is_there, number, numbers)
