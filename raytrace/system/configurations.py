"""Configurations: one lens in several states, as a zoom lens at its ends, by the numbers that differ.

An operand is a number of the lens with a value for every configuration; all other numbers are shared. Configurations
are counted from 1.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from raytrace.materials.glass import Glass, label
from raytrace.maths.numerics import Dataclass, value
from raytrace.system.optimization_data import OptimizationData, Solve
from raytrace.system.shapes import EVEN

#: From a lens down to one of its parts: names of fields, positions in tuples, and a position (i, …) in a tensor.
Path = tuple[str | int | tuple[int, ...], ...]


class ScaledPath(NamedTuple):
    """The path of the number of an operand in a lens, which holds factor · number + offset, as for a pickup."""

    path: Path
    factor: float = 1.0
    offset: float = 0.0


@value
class Operand:
    """A number, glass or word of a lens that differs between configurations.

    name, number, parameter: of OpticStudio, "THIC" of surface `number`, "PRAM" of a surface and a parameter, "YFIE" of
        a field point; 0 where the operand has none.
    paths: of it in the lens; empty if it does not affect rays, as the weight of a configuration.
    numbers: (C,) as the lens holds them, mm or degrees, one per configuration; or media: a glass each; or words: for
        each configuration the contents of every path.
    refusal: why the operand is not supported; configurations in which it differs are refused.
    """

    name: str
    number: int = 0
    parameter: int = 0
    paths: tuple[ScaledPath, ...] = ()
    numbers: Tensor | None = None
    media: tuple[Glass, ...] = ()
    words: tuple[tuple, ...] = ()
    refusal: str = ""

    def __len__(self) -> int:
        return max(len(self.media), len(self.words)) if self.numbers is None else len(self.numbers)

    def __str__(self) -> str:
        numbered = " ".join(str(number) for number in (self.number, self.parameter) if number)
        return f"{self.name} {numbered}".strip()

    def values(self) -> list:
        """Its numbers, names of glasses or words in every configuration, for display."""
        if self.numbers is not None:
            return self.numbers.detach().tolist()
        return [label(glass) for glass in self.media] or [words[0] if words else "" for words in self.words]


class Configured(Dataclass, Protocol):
    """A lens with configurations."""

    @property
    def surfaces(self) -> tuple[Any, ...]: ...
    @property
    def wavelengths(self) -> Tensor: ...
    @property
    def operands(self) -> tuple[Operand, ...]: ...
    @property
    def current_configuration(self) -> int: ...
    @property
    def optimization_data(self) -> OptimizationData | None: ...


Whole = TypeVar("Whole", bound=Configured)


def count(operands: Sequence[Operand]) -> int:
    """Number of configurations."""
    return max((len(operand) for operand in operands), default=1)


def weights(operands: Sequence[Operand]) -> list[float]:
    """Weights of the configurations, 1 together: those of the operand CWGT, alike without one or where all are 0."""
    listed = next((operand.values() for operand in operands if operand.name == "CWGT"), [])
    total = sum(listed)
    return [weight / total for weight in listed] if total > 0 else [1 / count(operands)] * count(operands)


def chosen(lens: Whole, number: int) -> Whole:
    """The lens in one of its configurations, 1 to `len(lens.configurations)`.

    Raises ValueError for a number out of range, and where an operand that is not supported differs.
    """
    last = count(lens.operands)
    if not 1 <= number <= last:
        available = f"configurations 1 to {last}" if last > 1 else "one configuration"
        raise ValueError(f"configuration {number}: this lens has {available}")
    for operand in lens.operands:
        shown = operand.values()
        if operand.refusal and shown[number - 1] != shown[lens.current_configuration - 1]:
            raise ValueError(f"configuration {number}: {operand} = {shown[number - 1]}: {operand.refusal}")
    return with_operands(lens, number)


def with_operands(lens: Whole, number: int) -> Whole:
    """The lens with every supported operand at its value in a configuration."""
    k = number - 1
    for operand in lens.operands:
        for position, (path, factor, offset) in enumerate(operand.paths):
            if operand.numbers is not None:
                plain = (factor, offset) == (1.0, 0.0)
                new: Any = operand.numbers[k] if plain else factor * operand.numbers[k] + offset
            else:
                new = operand.media[k] if operand.media else operand.words[k][position]
            lens = with_part(lens, path, new)
    return dataclasses.replace(lens, current_configuration=number)


def every(lens: Whole) -> tuple[Whole, ...]:
    """The lens in all its configurations; itself if it has one."""
    if not lens.operands:
        return (lens,)
    return tuple(chosen(lens, number) for number in range(1, count(lens.operands) + 1))


#: Operands of OpticStudio by the field of a surface.
_NAMES = {"thickness": "THIC", "curvature": "CRVT", "conic": "CONN"}


def made(lens: Whole, **varied: dict[int, Sequence[float]]) -> Whole:
    """The lens with configurations, in the first of them: `thickness={6: [12.4, 16.0]}` differs behind surface 6.

    varied: by name (thickness, curvature, conic) and surface the values in mm, 1/mm, one per configuration. Raises
    ValueError for unknown names and surfaces, and for lists of different lengths.
    """
    operands = []
    for name, by_surface in varied.items():
        if name not in _NAMES:
            heights = "; fields as image heights, by `field_kind` of `rt.lens`, suit every focal length of a zoom lens"
            raise ValueError(
                f"{name!r} does not differ between configurations; expected one of {', '.join(_NAMES)}"
                f"{heights if name == 'fields' else ''}"
            )
        for surface, values in by_surface.items():
            if not 0 <= surface < len(lens.surfaces):
                raise ValueError(f"surface {surface}: this lens has surfaces 0 to {len(lens.surfaces) - 1}")
            numbers = torch.as_tensor(values, dtype=lens.wavelengths.dtype, device=lens.wavelengths.device)
            path = ScaledPath(("surfaces", surface, name))
            operands.append(Operand(_NAMES[name], surface, paths=(path,), numbers=numbers))
    shapes = {operand.numbers.shape for operand in operands if operand.numbers is not None}
    if len(shapes) > 1 or any(len(shape) != 1 for shape in shapes):
        raise ValueError("expected lists of values of one length, a value per configuration")
    return with_operands(dataclasses.replace(lens, operands=tuple(operands)), 1)


def at_temperatures(lens: Whole, warm: Sequence[Whole]) -> Whole:
    """The lens, and the lens expanded at other temperatures, as configurations: see `Lens.with_temperatures`."""
    if lens.operands:
        raise ValueError(
            f"the lens has {count(lens.operands)} configurations; temperatures become those of a lens that has one"
        )
    data = lens.optimization_data or OptimizationData()
    solved = {solve.address for solve in data.solves}
    numbers: list[tuple[str, int, int, str, Path]] = []
    for k, surface in enumerate(lens.surfaces[:-1]):
        if surface.sag_terms or surface.phase or surface.before or surface.after or surface.kind != EVEN:
            message = "temperatures as configurations hold for centred conics and even aspheres"
            raise ValueError(f"surface {k} is none: {message}; `lens.at(temperature=…)` takes all surfaces")
        if surface.curvature is not None:
            numbers.append(("CRVT", k, 0, "curvature", ("curvature",)))
        if k:
            numbers.append(("THIC", k, 0, "thickness", ("thickness",)))
        terms = 0 if surface.coefficients is None else len(surface.coefficients)
        numbers += [("PRAM", k, j + 1, f"a{2 * j + 2}", ("coefficients", (j,))) for j in range(terms)]
    numbers = [row for row in numbers if (row[1], row[3]) not in solved]
    states = (lens, *warm)
    air: Path = ("environment", "temperature")
    operands = [Operand("TEMP", paths=(ScaledPath(air),), numbers=_stacked(states, air))]
    rules: list[Solve] = []
    moved: dict[tuple[int, str], int] = {}
    for name, k, parameter, quantity, inner in numbers:
        path, index = ("surfaces", k, *inner), len(operands)
        moved[k, quantity] = index
        operands.append(Operand(name, k, parameter, (ScaledPath(path),), _stacked(states, path)))
        rules += [
            Solve(k, quantity, "thermal", (float(index),), 1, configuration=c, operand=index)
            for c in range(2, len(states) + 1)
        ]
    sized = [k for k, surface in enumerate(lens.surfaces[:-1]) if surface.semi_diameter]
    for k in sized:
        words = tuple((state.surfaces[k].semi_diameter,) for state in states)
        operands.append(Operand("SDIA", k, paths=(ScaledPath(("surfaces", k, "semi_diameter")),), words=words))
    variables = tuple(
        dataclasses.replace(vary, configuration=1, operand=moved[vary.address]) if vary.address in moved else vary
        for vary in data.variables
    )
    stated = {*data.semi_diameters, *(rule.surface for rule in data.kept if rule.quantity == "semi_diameter")}
    automatic = [Solve(k, "semi_diameter", "maximum") for k in sized if k not in stated]
    data = dataclasses.replace(data, variables=variables, solves=(*data.solves, *rules), kept=(*data.kept, *automatic))
    return with_operands(dataclasses.replace(lens, operands=tuple(operands), optimization_data=data), 1)


def _stacked(states: Sequence[Any], path: Path) -> Tensor:
    return torch.stack([part(state, path).reshape(()) for state in states])


def kept(lens: Whole) -> Whole:
    """The lens whose operands have its current numbers as those of its current configuration."""
    operands = tuple(taken(operand, lens, lens.current_configuration - 1) for operand in lens.operands)
    return dataclasses.replace(lens, operands=operands)


def freed(lens: Whole, **conditions: object) -> Whole:
    """The lens without operands of the numbers that conditions of `Lens.at` set, which hold in every configuration."""
    paths: dict[str, tuple[Path, ...]] = {
        "object_distance": (("surfaces", 0, "thickness"),),
        "magnification": (("surfaces", 0, "thickness"), ("surfaces", len(lens.surfaces) - 2, "thickness")),
        "sensor_distance": (("surfaces", len(lens.surfaces) - 2, "thickness"),),
        "f_number": (("aperture",),),
        "entrance_pupil_diameter": (("aperture",),),
        **{name: (("environment", name),) for name in ("temperature", "pressure")},
        "field_weights": (("fields", "weight"),),
        "wavelengths": (("wavelengths",), ("wavelength_weights",), ("primary_wavelength",)),
    }
    names = [name for name, condition in conditions.items() if condition is not None]
    starts: list[Path] = [path for name in names for path in paths.get(name, ((name,),))]

    def is_set(operand: Operand) -> bool:
        return any(scaled.path[: len(start)] == start for scaled in operand.paths for start in starts)

    unused = (Operand("MOFF", words=(("",),) * len(row)) if is_set(row) else row for row in lens.operands)
    return dataclasses.replace(lens, operands=tuple(unused))


def taken(operand: Operand, lens: Whole, k: int) -> Operand:
    """The operand with, for configuration k from 0, the values that the lens holds at its paths."""
    if not operand.paths or operand.refusal:
        return operand
    parts = tuple(part(lens, scaled.path) for scaled in operand.paths)
    if operand.numbers is not None:
        number = torch.zeros_like(operand.numbers[k]) if parts[0] is None else parts[0]
        return dataclasses.replace(operand, numbers=with_entry(operand.numbers, (k,), number))
    if operand.media:
        return dataclasses.replace(operand, media=(*operand.media[:k], parts[0], *operand.media[k + 1 :]))
    return dataclasses.replace(operand, words=(*operand.words[:k], parts, *operand.words[k + 1 :]))


# -- parts of a value by their paths ----------------------------------------------------------------------------------


def part(whole: Any, path: Path) -> Any:
    """The part of a value at the end of a path; None where a part on the path is not modelled."""
    for step in path:
        if not _leads_on(whole, step):
            return None
        whole = getattr(whole, step) if isinstance(step, str) else whole[step]
    return whole


def with_part(whole: Any, path: Path, new: Any, *, like: Any = None) -> Any:
    """The value with another part at the end of a path; parts on the path that are not modelled are those of `like`."""
    if not path:
        return new
    step: Any = path[0]
    if not _leads_on(whole, step):
        is_short = isinstance(whole, Tensor)
        whole = torch.cat([whole, whole.new_zeros(len(like) - len(whole))]) if is_short else like
    if isinstance(whole, Tensor):
        return with_entry(whole, step, new)
    inner = with_part(part(whole, (step,)), path[1:], new, like=part(like, (step,)))
    if isinstance(step, str):
        return dataclasses.replace(whole, **{step: inner})
    return (*whole[:step], inner, *whole[step + 1 :])


def _leads_on(whole: Any, step: Any) -> bool:
    if isinstance(whole, Tensor):
        return len(step) == whole.ndim and all(k < size for k, size in zip(step, whole.shape, strict=True))
    return step < len(whole) if isinstance(whole, tuple) else whole is not None


def differences(a: Any, b: Any, path: Path = ()) -> Iterator[Path]:
    """The paths at which two values differ, as deep as both have parts; a glass is compared as a whole."""
    if a is b:
        return
    if type(a) is not type(b) or isinstance(a, Glass):
        if type(a) is not type(b) or not same(a, b):
            yield path
    elif type(a) is tuple and len(a) == len(b):
        for position, pair in enumerate(zip(a, b, strict=True)):
            yield from differences(*pair, (*path, position))
    elif dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            yield from differences(getattr(a, field.name), getattr(b, field.name), (*path, field.name))
    elif isinstance(a, Tensor) and a.shape == b.shape and a.ndim:
        yield from ((*path, tuple(index)) for index in torch.nonzero(a != b).tolist())
    elif not same(a, b):
        yield path


def same(a: Any, b: Any) -> bool:
    """Whether two parts of a value are equal, number by number."""
    if isinstance(a, Tensor) or isinstance(b, Tensor):
        return isinstance(a, Tensor) and isinstance(b, Tensor) and torch.equal(a, b)
    if dataclasses.is_dataclass(a) and type(a) is type(b):
        return all(same(getattr(a, field.name), getattr(b, field.name)) for field in dataclasses.fields(a))
    return bool(a == b)


def with_entry(numbers: Tensor, entry: tuple[int, ...], number: Tensor) -> Tensor:
    """A copy of a tensor with another number at one entry; numbers of L lenses (L, ...) have their axes behind it."""
    spread = spread_for(numbers, number, len(entry))
    is_entry = torch.zeros(spread.shape, dtype=torch.bool, device=numbers.device)
    is_entry[entry] = True
    return torch.where(is_entry, number, spread)


def spread_for(numbers: Tensor, number: Tensor, axes: int = 1) -> Tensor:
    """Numbers with `axes` axes, and trailing axes of length 1 behind these for a number of L lenses."""
    return numbers.reshape(*numbers.shape, *(1,) * (number.dim() + axes - numbers.dim()))
