"""Variables: numbers of a lens as parameters of a module, with the scale of one step, and limits on thickness.

    variables = Variables(lens, "sensor thickness:5,6 curvature:1-4")
    changed = variables()                               # the lens with its variables, differentiable
    limits = limits_of(changed, glass=(2, 15), edge=1)  # least and greatest thickness of glass, least edge, mm
    violation(changed, limits)                          # Σ (excess over a limit)², mm²; 0 is buildable

The parameters are offsets from the lens. A state carries the identity of its lens, and loading compares it (`Owned`).

A number that is solved for holds the focal length. The power φ of a lens is linear in the curvature and the thickness
of each of its surfaces (Gauss's brackets), so that a number v follows from φ(0) + v [φ(1) - φ(0)] = |n′|/f, with its
derivatives. A power is finite where the lens is afocal.

`PhaseVariables` are the heights of a thin element as parameters.
"""

import dataclasses
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor, nn

from raytrace.io import as_lens
from raytrace.materials.glass import Glass, is_air
from raytrace.system.identity import digest, identity, other_lens
from raytrace.system.lens import Lens, media
from raytrace.system.parameter_paths import BadLimits as BadLimits
from raytrace.system.parameter_paths import (
    BadVariables,
    ParameterPath,
    counted,
    number_at,
    parameter_path,
    sensor,
    with_number,
)
from raytrace.system.parameter_paths import parse_bounds as parse_bounds
from raytrace.system.parameter_paths import parse_range as parse_range
from raytrace.system.surface import Surface, sag, sag_at
from raytrace.tracing.paraxial import first_order
from raytrace.wave_optics.element import Element

#: Least thickness over the largest diameter of the lens, where none is given: of glass at its centre (a 50 mm lens:
#: 1 mm) and at its edge, and of air. A phone's cover glass is as thin; who knows the workshop gives its numbers.
_GLASS, _EDGE, _AIR = 1 / 50, 1 / 100, 1 / 2000


@dataclasses.dataclass(frozen=True)
class Limits:
    """Least and greatest thickness at the axis in mm, of glass and of air; edge: least of glass at its edge."""

    glass: tuple[float, float]
    air: tuple[float, float]
    edge: float


def limits_of(
    lens: Lens,
    *,
    glass: tuple[float, float] | None = None,
    air: tuple[float, float] | None = None,
    edge: float | None = None,
) -> Limits:
    """Limits, mm; what is None goes with the lens: of its largest diameter glass 1/50 at least, at its edge 1/100, air
    between elements 1/2000, and nothing at most. A lens without semi-diameters gets 0."""
    diameter = 2 * max((surface.semi_diameter or 0.0) for surface in lens.surfaces[1:-1])
    return Limits(
        glass=(_GLASS * diameter, math.inf) if glass is None else glass,
        air=(_AIR * diameter, math.inf) if air is None else air,
        edge=_EDGE * diameter if edge is None else edge,
    )


def violation(lens: Lens, limits: Limits | None = None) -> Tensor:
    """Σ (what a thickness lacks or has too much of)² in mm², over all elements and air spaces; 0 is buildable.

    limits: `limits_of(lens)` by default. An air space reaches from element to element, across a stop and other surfaces
    with air on both sides: elements touch neither at the axis nor at the rim, and a stop stands where its own rim is
    free (it may be inside the bulge of an element). The space before the image has no greatest thickness.
    """
    limits = limits_of(lens) if limits is None else limits
    total = torch.zeros_like(lens.surfaces[-2].thickness)
    for lack in _lacks(lens, limits):
        total = total + lack.clamp_min(0).square()
    return total


def _lacks(lens: Lens, limits: Limits) -> Iterator[Tensor]:
    """What each thickness lacks, at the axis and at the edge; negative where it has more than enough."""
    surfaces, media = lens.surfaces, _media(lens)
    air = [is_air(medium) for medium in media]
    bodies = [k for k in range(1, len(surfaces) - 1) if surfaces[k].is_mirror or not (air[k - 1] and air[k])]
    last, side = len(surfaces) - 1, 1
    start = None  # the element before the air space at hand
    for k in range(1, last):
        side = -side if surfaces[k].is_mirror else side
        before, after = surfaces[k], surfaces[k + 1]
        if k in bodies:
            start = k
        if not air[k]:
            yield from _outside(side * before.thickness, *limits.glass)
            yield from _edge(before, after, side, limits.edge)
            continue
        yield from _edge(before, after, side, 0.0)
        if start is None or k + 1 not in (*bodies, last):
            continue
        gap = torch.stack([surface.thickness for surface in surfaces[start : k + 1]]).sum()
        yield from _outside(side * gap, limits.air[0], limits.air[1] if k + 1 < last else math.inf)
        if start < k:
            yield from _edge(dataclasses.replace(surfaces[start], thickness=gap), after, side, 0.0)


def _media(lens: Lens) -> list[Glass]:
    """The medium behind every surface: behind a mirror, the one before it."""
    found: list[Glass] = []
    for surface in lens.surfaces:
        found.append(found[-1] if surface.is_mirror and found else surface.glass)
    return found


def _outside(thickness: Tensor, least: float, most: float) -> Iterator[Tensor]:
    yield least - thickness
    if math.isfinite(most):
        yield thickness - most


def _edge(before: Surface, after: Surface, side: int, least: float) -> Iterator[Tensor]:
    if before.semi_diameter and after.semi_diameter:
        yield least - side * edge_thickness(before, after)


def edge_thickness(before: Surface, after: Surface) -> Tensor:
    """Thickness in mm between two surfaces at the smaller of their semi-diameters."""
    height = before.thickness.new_tensor(min(before.semi_diameter, after.semi_diameter)) ** 2
    return before.thickness + sag(after, height) - sag(before, height)


KEY = "_extra_state"  # what torch calls a module's state that is no parameter


class OtherLens(ValueError):
    """A state of another lens or element, or one that does not say what it is of; the message names both."""


class Owned(nn.Module):
    """A module whose parameters mean nothing without what they change.

    Its `state_dict` has an entry "_extra_state" more: the text of `identity` in JSON, as bytes (a uint8 tensor), so
    that a state stays a dictionary of tensors. `bytes(state["_extra_state"].tolist()).decode()` shows it.
    `load_state_dict` refuses a state of another identity, or without one, as older versions wrote it, before any of its
    parameters is changed. Raises OtherLens.
    """

    def identity(self) -> dict:
        """What the parameters belong to, as plain values for JSON."""
        raise NotImplementedError

    def difference(self, before: dict) -> str:
        """How an identity differs from this one, "" where it does not."""
        raise NotImplementedError

    def get_extra_state(self) -> Tensor:
        return torch.tensor(list(json.dumps(self.identity()).encode()), dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Nothing is set: what a module is of stays."""

    def _load_from_state_dict(self, state_dict, prefix, local_metadata, strict, *lists) -> None:
        stored = state_dict.get(prefix + KEY)
        if stored is None:
            if any(prefix + name in state_dict for name, _ in self.named_parameters(recurse=False)):
                raise OtherLens(
                    "the state does not say which lens or element it is of; an older version wrote it. Learn anew, or, "
                    f"if it is of this one, set state[{prefix + KEY!r}] = module.get_extra_state(), of this "
                    f"{type(self).__name__}, first"
                )
        elif words := self.difference(_read(stored)):
            raise OtherLens(f"the state is of {words}")
        super()._load_from_state_dict(state_dict, prefix, local_metadata, strict, *lists)


def _read(stored: Tensor) -> dict:
    try:
        found = json.loads(bytes(stored.tolist()).decode())
        if isinstance(found, dict):
            return found
    except (ValueError, TypeError, AttributeError, RecursionError):
        pass
    raise OtherLens("the state does not say which lens or element it is of: its identity is damaged")


_Variable = TypeVar("_Variable")
_NOTHING = 1e-9  # part of the power: what a number changes less does not change


@dataclass(frozen=True)
class Held:
    """A focal length in mm, and the variable that is solved for it."""

    focal_length: float
    by: object


def held(
    hold: str, lens: Lens, variables: tuple[_Variable, ...], with_value: Callable[[Lens, _Variable, Tensor], Lens]
) -> Held | None:
    """What "efl" (as the lens has it) or "efl=100" asks for, by the last variable that changes it; None for nothing.

    with_value: the lens with a variable at another value. Raises BadVariables.
    """
    if not hold:
        return None
    match = re.fullmatch(r"efl(?:=([-+.\deE]+))?", hold)
    try:
        length = _length(match[1]) if match[1] else float(first_order(lens).effective_focal_length)
    except (TypeError, ValueError):
        raise BadVariables(
            f"hold {hold!r}: expected efl, the focal length of the file, or one in mm as efl=100"
        ) from None
    for variable in reversed(variables):
        power, change = (part.abs() for part in _line(lens, lambda v, one=variable: with_value(lens, one, v)))
        if bool(change > _NOTHING * power):
            return Held(length, variable)
    raise BadVariables(
        f"hold {hold!r}: none of the variables changes the focal length; vary a thickness or a curvature"
    )


def _length(text: str) -> float:
    """A focal length in mm, negative for a lens that spreads light. Raises ValueError for 0 and ∞."""
    length = float(text)
    if length == 0 or not math.isfinite(length):
        raise ValueError(text)
    return length


def solved(like: Lens, focal_length: float, with_value: Callable[[Tensor], Lens]) -> Tensor:
    """The number () that gives a lens its focal length in mm. with_value: the lens with that number at a value."""
    at_zero, change = _line(like, with_value)
    wavelength = like.primary
    *_, index, _ = media(like, wavelength)
    return (index.abs() / focal_length - at_zero) / change


def _line(like: Lens, with_value: Callable[[Tensor], Lens]) -> tuple[Tensor, Tensor]:
    """The power at 0, and what it changes by to 1; 1/mm."""
    zero = torch.zeros_like(like.surfaces[-2].thickness)
    at_zero, at_one = (first_order(with_value(zero + k)).power for k in range(2))
    return at_zero, at_one - at_zero


_KINDS = "thickness, curvature, conic, or a number of its kind of shape as a4"


@dataclasses.dataclass(frozen=True)
class Variable:
    """One number of one surface.

    unit: how much of the lens's number one unit of the parameter is. Thicknesses are in mm; numbers of the shape in
    what moves the surface by 1 mm of sag at its semi-diameter, so that one step means the same for all of them.
    place: where the surface holds it.
    """

    kind: str
    surface: int
    start: float
    unit: float
    place: ParameterPath

    @property
    def name(self) -> str:
        return "sensor" if self.kind == "sensor" else f"{self.kind}_{self.surface}"


class Variables(Owned):
    """The variables of a lens as parameters: 0 at the start, in units of `Variable.unit`.

    vary: "sensor", and lists like "thickness:5,6,10 curvature:1-4 a4:3", of the file's surface numbers; beside
        thickness, curvature and conic every number that the surface has by its kind (`parameter_paths`).
    bounds: by name ("sensor", "curvature_3"), smallest and largest number of the lens; `project` keeps them.
    hold: "efl" keeps the focal length of the lens, "efl=100" that one in mm: the last variable of `vary` that changes
        it is then no parameter but solved for (`held`), and its bounds count in `violation`.
    glass_thickness, air_thickness: least and greatest in mm at the axis; edge: least of glass at its edge; by default
    they go with the size of the lens (`limits_of`). `violation` says how far the lens is from them.
    `state_dict` carries the lens that the parameters are offsets from, and loads into that one alone (`Owned`).
    """

    def __init__(
        self,
        lens: Lens | str | os.PathLike,
        vary: str = "sensor",
        *,
        bounds: Mapping[str, tuple[float, float]] | None = None,
        hold: str = "",
        glass_thickness: tuple[float, float] | None = None,
        air_thickness: tuple[float, float] | None = None,
        edge: float | None = None,
    ):
        super().__init__()
        lens = as_lens(lens, "Variables")
        self.lens = lens
        every = parse(lens, vary)
        self.held = held(hold, lens, every, _with_value)
        self.variables = tuple(one for one in every if self.held is None or one is not self.held.by)
        self.names = tuple(variable.name for variable in every)
        self.bounds = dict(bounds or {})
        self.limits = limits_of(lens, glass=glass_thickness, air=air_thickness, edge=edge)
        unknown = set(self.bounds) - set(self.names)
        if unknown:
            raise BadVariables(f"bounds for {', '.join(sorted(unknown))}, not among the variables: {vary}")
        for variable in self.variables:
            start = torch.zeros((), dtype=lens.wavelengths.dtype, device=lens.wavelengths.device)
            self.register_parameter(variable.name, nn.Parameter(start))
        if beyond := self.beyond():
            raise BadVariables(
                f"hold {hold!r}: {beyond}; hold another focal length, or end `vary` with another variable"
            )

    def forward(self) -> Lens:
        """The lens with its variables where they are now."""
        lens = self._free()
        return lens if self.held is None else _with_value(lens, self.held.by, self._solved(lens))

    def identity(self) -> dict:
        """The lens (`identity.identity`), and each variable's number in it and unit."""
        every = (*self.variables, *([] if self.held is None else [self.held.by]))
        starts = {variable.name: [variable.start, variable.unit] for variable in every}
        held = None if self.held is None else ["efl", self.held.focal_length, self.held.by.name]
        return {**identity(self.lens), "variables": starts, "hold": held}

    def difference(self, before: dict) -> str:
        """How a stored identity differs from this one, "" where it does not."""
        now = self.identity()
        try:
            if words := other_lens(before, now):
                return words
            if set(before["variables"]) != set(now["variables"]):
                return f"the variables {', '.join(before['variables'])}, not {', '.join(now['variables'])}"
            if not _alike(before["hold"], now["hold"]):
                return f"variables of which {before['hold'] or 'nothing'} is held, not {now['hold'] or 'nothing'}"
            for name, pair in before["variables"].items():
                if not _alike(pair, now["variables"][name]):
                    return "{} from {:.9g} in units of {:.9g}, not from {:.9g} in units of {:.9g}".format(
                        name, *pair, *now["variables"][name]
                    )
        except (KeyError, TypeError, ValueError, AttributeError):
            return "a lens that its damaged identity does not tell"
        return ""

    def _free(self) -> Lens:
        """The lens with what is not solved for."""
        lens = self.lens
        for variable in self.variables:
            lens = _with_value(lens, variable, self.number(variable))
        return lens

    def _solved(self, lens: Lens) -> Tensor:
        """The number that is solved for, of the lens with all others."""
        return solved(lens, self.held.focal_length, lambda value: _with_value(lens, self.held.by, value))

    def number(self, variable: Variable) -> Tensor:
        """The lens's number, 1/mm or mm."""
        if self.held is not None and variable is self.held.by:
            return self._solved(self._free())
        return variable.start + variable.unit * getattr(self, variable.name)

    @torch.no_grad()
    def numbers(self) -> dict[str, float]:
        """Every variable as the lens has it, by name."""
        every = (*self.variables, *([] if self.held is None else [self.held.by]))
        found = {variable.name: float(self.number(variable)) for variable in every}
        return {name: found[name] for name in self.names}

    @torch.no_grad()
    def beyond(self) -> str:
        """What of the number that is solved for lies beyond its bounds; "" for nothing."""
        if self.held is None:
            return ""
        value, (low, high) = float(self.number(self.held.by)), self._range()
        return "" if low <= value <= high else f"{self.held.by.name} would be {value:.6g}, not from {low:g} to {high:g}"

    def _range(self) -> tuple[float, float]:
        """Bounds of the number that is solved for: a thickness without any is no less than 0."""
        least = 0.0 if self.held.by.kind == "thickness" else -math.inf
        return self.bounds.get(self.held.by.name, (least, math.inf))

    @torch.no_grad()
    def project(self) -> None:
        """Bring variables back within their bounds, after a step of an optimiser."""
        for variable in self.variables:
            if variable.name in self.bounds:
                low, high = ((end - variable.start) / variable.unit for end in self.bounds[variable.name])
                getattr(self, variable.name).clamp_(min(low, high), max(low, high))

    def violation(self) -> Tensor:
        """How far the lens is from its limits, mm² (`violation`), and what is solved for from its bounds."""
        lens = self()
        lacks = violation(lens, self.limits)
        if self.held is None:
            return lacks
        value, unit = number_at(lens.surfaces[self.held.by.surface], self.held.by.place), self.held.by.unit
        low, high = self._range()
        return lacks + ((low - value).clamp_min(0) / unit).square() + ((value - high).clamp_min(0) / unit).square()


def _alike(one: object, other: object) -> bool:
    """Whether plain values are the same, their numbers to what float32 holds."""
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_alike, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-6)
    return one == other


def _with_value(lens: Lens, variable: Variable, value: Tensor) -> Lens:
    """The lens with one of its variables at a value, in units of the lens."""
    surfaces = list(lens.surfaces)
    surfaces[variable.surface] = with_number(surfaces[variable.surface], variable.place, value)
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def parse(lens: Lens, vary: str) -> tuple[Variable, ...]:
    """The variables of a list like "sensor thickness:5,6 curvature:1-4". Raises BadVariables saying what is wrong."""
    found: dict[str, Variable] = {}
    for word in vary.split():
        kind, _, numbers = word.partition(":")
        if bool(numbers) == (kind == "sensor"):
            raise BadVariables(f"{word!r}: expected sensor, or one of {_KINDS} with surfaces: thickness:5,6")
        for number in [sensor(lens)] if kind == "sensor" else counted(word, numbers):
            variable = _variable(lens, kind, number, word)
            found[f"{'thickness' if kind == 'sensor' else kind}_{number}"] = variable
    if not found:
        raise BadVariables("no variables: give sensor, or thickness:…, curvature:…, conic:… with surface numbers")
    return tuple(found.values())


def _variable(lens: Lens, kind: str, number: int, word: str) -> Variable:
    place, surface = parameter_path(lens, kind, number, word), lens.surfaces[number]
    start = number_at(surface, place)
    start = torch.zeros_like(surface.thickness) if start is None else start.detach()
    unit = 1.0 if place.path == ("thickness",) else 1 / _sag_moved(lens, surface, kind, place, start, word)
    return Variable(kind, number, float(start), unit, place)


def _sag_moved(lens: Lens, surface: Surface, kind: str, place: ParameterPath, start: Tensor, word: str) -> float:
    """How far the surface moves at its semi-diameter with one unit of a number, by the first term of the series

    z ≈ c r²/2 + (1 + k) c³ r⁴/8 + …

    A surface without a semi-diameter is taken to be as large as the entrance pupil.
    """
    edge = surface.semi_diameter or float(first_order(lens).entrance_pupil_diameter) / 2
    curvature = 0.0 if surface.curvature is None else float(surface.curvature)
    if kind == "curvature":
        return edge**2 / 2
    if kind == "conic":
        moved = abs(curvature) ** 3 * edge**4 / 8
    else:
        angle = torch.linspace(0, 2 * math.pi, 33, dtype=start.dtype, device=start.device)
        x, y = edge * torch.cos(angle), edge * torch.sin(angle)
        changed = torch.func.jvp(
            lambda v: sag_at(with_number(surface, place, v), x, y), (start,), (torch.ones_like(start),)
        )
        moved = float(changed[1].abs().max())
    if moved == 0:
        why = "is flat, and a conic constant" if kind == "conic" else "has a number that"
        raise BadVariables(f"{word!r}: the surface {why} changes nothing there")
    return moved


class PhaseVariables(Owned):
    """An element whose numbers are learned, alone or with others in contact.

        numbers = start + unit · B c      c = `change`, from zero;   without a basis B = 1

    element: where it starts; unit: mm of a change of 1, a micrometre by default, so that rates of learning read in µm.
    basis: (numbers..., K), what the K changes add to its heights or coefficients: `radial_powers`, say.
    others: elements in contact that stay as they are. tolerance: heights err by up to so many mm, evenly, by `draw`.
    `state_dict` carries the element that the changes are of, and loads into that one alone (`Owned`).
    """

    def __init__(
        self,
        element: Element,
        *,
        unit: float = 1e-3,
        basis: Tensor | None = None,
        others: Sequence[Element] = (),
        tolerance: float = 0.0,
    ):
        super().__init__()
        self.element, self.unit, self.others, self.tolerance = element, unit, tuple(others), tolerance
        self.start = element.numbers
        self.basis = basis
        shape = self.start.shape if basis is None else basis.shape[-1:]
        if basis is not None and basis.shape[:-1] != self.start.shape:
            raise ValueError(
                f"a basis of {tuple(basis.shape)} for numbers of {tuple(self.start.shape)}: expected "
                f"{(*self.start.shape, 'K')}"
            )
        self.change = nn.Parameter(torch.zeros(shape, dtype=self.start.dtype, device=self.start.device))

    def identity(self) -> dict:
        """The element: its profile, shape, glass, aperture in mm, the unit in mm; digests of where its numbers start,
        of the basis, of its glass and of the elements in contact."""
        return {
            "profile": type(self.element.profile).__name__,
            "numbers": list(self.start.shape),
            "glass": self.element.glass.name,
            "aperture": 2 * float(self.element.radius.detach()),
            "unit": self.unit,
            "start": digest(self.start),
            "basis": digest(self.basis),
            "material": digest(self.element.glass),
            "others": digest(self.others),
        }

    def difference(self, before: dict) -> str:
        """How a stored identity differs from this one, "" where it does not."""
        for name, value in self.identity().items():
            stored = before.get(name)
            numbers = isinstance(stored, float) and isinstance(value, float)
            if not (math.isclose(stored, value, rel_tol=1e-6) if numbers else stored == value):
                is_digest = name in ("start", "basis", "material", "others")
                words = f"other {name}" if is_digest else f"{name} {stored}, not {value}"
                return f"an element of {words}"
        return ""

    def numbers(self) -> Tensor:
        """Heights or coefficients as they are now, mm."""
        change = self.change if self.basis is None else self.basis @ self.change
        return self.start + self.unit * change

    def forward(self, *, draw: torch.Generator | None = None) -> tuple[Element, ...]:
        """The element as it is now, and those in contact; draw: errors of fabrication are drawn from it."""
        numbers = self.numbers()
        if draw is not None and self.tolerance:
            error = torch.rand(numbers.shape, generator=draw, dtype=numbers.dtype, device=numbers.device)
            numbers = numbers + self.tolerance * (2 * error - 1)
        return (self.element.with_numbers(numbers), *self.others)
