"""Parameter paths: the numbers of a lens by name, and the syntax of their bounds and ranges.

thickness:5,6 curvature:1-4 a4:3 sensor     numbers of surfaces, which are counted as in the file
sensor:57.5,58 curvature_3:-0.1..0          bounds by name, an open end left out
2:15                                        smallest and largest

`parameter_paths` lists the numbers of a surface of any kind: of its shape, its phase and its poses.
`with_numbers_of` is the lens with other numbers, by surface and name.
"""

import dataclasses
import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from raytrace.materials.glass import is_air
from raytrace.maths.numerics import Value
from raytrace.system.configurations import Path
from raytrace.system.lens import Lens
from raytrace.system.poses import Pose
from raytrace.system.shapes import EVEN, KINDS, Kind
from raytrace.system.surface import SHAPE, Surface
from raytrace.words import RaytraceError

#: A number of a lens: its surface and its name.
Address = tuple[int, str]

#: Numbers of the lens that no surface has: of the system aperture, and of the air (°C, atm).
APERTURE: Address = (0, "aperture")
TEMPERATURE: Address = (0, "temperature")
PRESSURE: Address = (0, "pressure")

#: Numbers of the medium behind a surface, where it is a model glass or a constant index.
GLASS = {"index": 0, "abbe_number": 1, "partial_dispersion": 2}

#: Name of a coefficient of the dispersion formula of any other medium, counted from 1; of no variable syntax.
GLASS_NUMBER = "glass_coefficient_"

_PLAIN = 2  # axes of a tensor of one lens at most: heights; more vary from lens to lens, behind that of the entries
_POSED = ("x", "y", "z", "tilt_x", "tilt_y", "tilt_z")

#: Fields of a surface that are one number, and those that hold several, in the order of the surface.
_NUMERIC = [field for field in dataclasses.fields(Surface) if field.name in (*SHAPE, "phase", "before", "after")]
_SINGLE = [field.name for field in _NUMERIC if field.type == Tensor | None and field.name != "coefficients"]
_OF_SEVERAL = [field.name for field in _NUMERIC if field.name not in (*_SINGLE, "kind")]


class ParameterPath(NamedTuple):
    """The path of a number in a surface: the fields down to it, and the entry of a tensor of several."""

    path: tuple[str, ...]
    entry: int | None = None

    @property
    def steps(self) -> Path:
        """The path as that of `configurations.part`."""
        return self.path if self.entry is None else (*self.path, (self.entry,))


#: The paths of the numbers of a lens that no surface has.
OF_LENS = {
    APERTURE: ParameterPath(("aperture", "value")),
    TEMPERATURE: ParameterPath(("environment", "temperature")),
    PRESSURE: ParameterPath(("environment", "pressure")),
}


def parameter_paths(surface: Surface) -> dict[str, ParameterPath]:
    """Every number by its name: curvature, conic, a4 (of r⁴) …, and the fields of sag terms, a phase and the poses.

    Entries of a tensor are counted from 1, coefficients by the power of r, or of y, that they belong to. The pose
    behind the surface has its names with "_after", as tilt_x_after.
    """
    paths: dict[str, ParameterPath] = {}
    for name in _SINGLE:
        paths[name] = ParameterPath((name,))
    for name in _OF_SEVERAL:
        part = getattr(surface, name)
        if name == "coefficients":
            paths |= _coefficients(part, KINDS[surface.kind])
        elif part is not None and dataclasses.is_dataclass(part):
            behind = "_after" if name == "after" else ""
            for inner in dataclasses.fields(part):
                paths |= _entries((name, inner.name), getattr(part, inner.name), inner.name + behind)
    return paths


def _coefficients(part: Tensor | None, kind: Kind) -> dict[str, ParameterPath]:
    if part is None:
        return {}
    return {kind.name_of(entry): ParameterPath(("coefficients",), entry) for entry in range(part.numel())}


def _entries(path: tuple[str, ...], part: Tensor | None, name: str) -> dict[str, ParameterPath]:
    if not isinstance(part, Tensor):
        return {}
    if part.dim() == 0:
        return {name: ParameterPath(path)}
    return {f"{name}{entry + 1}": ParameterPath(path, entry) for entry in range(part.numel())}


def number_at(part: Any, place: ParameterPath) -> Any:
    """The number at a path, a tensor; None where it is not modelled."""
    for name in place.path:
        part = getattr(part, name)
    if place.entry is None:
        return part
    return part[place.entry] if part.dim() > _PLAIN else part.reshape(-1)[place.entry]


def with_number(part: Value, place: ParameterPath, number: Any) -> Value:
    """The surface with another number at a path."""
    name, *rest = place.path
    old = getattr(part, name)
    if rest:
        number = with_number(old, ParameterPath(tuple(rest), place.entry), number)
    elif place.entry is not None and max(number.dim(), old.dim()) > _PLAIN:
        entries = list(old.unbind(0))
        entries[place.entry] = number
        number = torch.stack(torch.broadcast_tensors(*entries))
    elif place.entry is not None:
        flat = old.reshape(-1)
        number = torch.cat([flat[: place.entry], number[None], flat[place.entry + 1 :]]).reshape(old.shape)
    return cast(Value, dataclasses.replace(cast(Any, part), **{name: number}))


class UnknownNumber(RaytraceError, ValueError):
    """A variable, solve or pickup of a number that the lens does not have."""


def path_of(surface: Surface, quantity: str, where: str = "") -> ParameterPath:
    """The path of a number in a surface, by its name. Raises UnknownNumber."""
    if quantity.startswith(GLASS_NUMBER):
        return ParameterPath(("glass", "coefficients"), int(quantity.removeprefix(GLASS_NUMBER)) - 1)
    known = {"thickness": ParameterPath(("thickness",)), **parameter_paths(surface)}
    if quantity not in known and surface.glass.formula in ("model", "constant") and not is_air(surface.glass):
        entries = list(GLASS.items())[: surface.glass.coefficients.numel()]
        known |= {name: ParameterPath(("glass", "coefficients"), entry) for name, entry in entries}
    if quantity not in known:
        raise UnknownNumber(f"{where}no {quantity!r}; it has {', '.join(known)}")
    return known[quantity]


def with_numbers_of(
    lens: Lens, numbers: dict[Address, Tensor], known: dict[Address, ParameterPath] | None = None
) -> Lens:
    """The lens with other numbers, by address; known: their paths, where these have been looked up before."""
    surfaces = list(lens.surfaces)
    for (surface, quantity), number in numbers.items():
        if (surface, quantity) in OF_LENS:
            lens = with_number(lens, OF_LENS[surface, quantity], number)
            continue
        place = known[surface, quantity] if known else path_of(surfaces[surface], quantity, f"surface {surface}: ")
        surfaces[surface] = with_number(surfaces[surface], place, number)
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def stored_number(lens: Lens, address: Address) -> Tensor | None:
    """The number at an address; None where a surface does not model it. Raises UnknownNumber."""
    if address in OF_LENS:
        return number_at(lens, OF_LENS[address])
    surface = lens.surfaces[address[0]]
    return number_at(surface, path_of(surface, address[1], f"surface {address[0]}: "))


def names_at(surface: Surface, path: Path) -> list[str]:
    """The names by which a surface's number at a path of `configurations` is known."""
    known = {"thickness": ParameterPath(("thickness",)), **parameter_paths(surface)}
    entry = path[-1] if isinstance(path[-1], tuple) else None
    fields = path[:-1] if entry is not None else path
    flat = None if entry is None else entry[0] if len(entry) == 1 else None
    return [name for name, place in known.items() if place.path == fields and place.entry == flat]


def modelled(surface: Surface, name: str) -> Surface:
    """The surface with a number modelled, at 0 where it was not; the surface itself where it cannot have that number.

    Curvature and conic, the terms a2, a4, … of an even asphere, and the fields of the pose before the surface or, with
    "_after", behind it.
    """
    zero = torch.zeros_like(surface.thickness)
    changes: dict[str, Any] = {name: zero}
    if name in ("curvature", "conic"):
        return surface if getattr(surface, name) is not None else dataclasses.replace(surface, **changes)
    if name in parameter_paths(surface):
        return surface
    term = re.fullmatch(r"a(\d+)", name)
    if term and surface.kind == EVEN and 2 <= int(term[1]) <= 2 * KINDS[EVEN].parameters and not int(term[1]) % 2:
        terms = zero.new_zeros(0) if surface.coefficients is None else surface.coefficients
        further = zero.new_zeros((int(term[1]) // 2 - len(terms), *terms.shape[1:]))
        return dataclasses.replace(surface, coefficients=torch.cat([terms, further]))
    field, side = name.removesuffix("_after"), "after" if name.endswith("_after") else "before"
    pose = getattr(surface, side) or Pose()
    if field in _POSED and isinstance(pose, Pose):
        changes = {field: zero}
        changes = {side: dataclasses.replace(pose, **changes)}
        return dataclasses.replace(surface, **changes)
    return surface


#: Largest number of a surface or configuration, and of their count in a list.
MOST = 10_000


class BadVariables(RaytraceError, ValueError):
    """Malformed variables, or variables that the lens does not have."""


class BadLimits(RaytraceError, ValueError):
    """Malformed or contradictory limits."""


def joined(words: str | Sequence[str]) -> str:
    """A text, or several words joined by blanks."""
    return words if isinstance(words, str) else " ".join(words)


def counted(word: str, numbers: str, noun: str = "surface") -> list[int]:
    """The numbers of a list like "1,3-5". Raises BadVariables with the word."""
    listed: list[int] = []
    for part in numbers.split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part)
        if not match:
            raise BadVariables(f"{word!r}: {part!r} is no {noun} number; expected numbers and ranges like 1,3-5")
        first, last = (int(digits) if len(digits) < 10 else MOST + 1 for digits in (match[1], match[2] or match[1]))
        if last > MOST or len(listed) + last - first > MOST:
            raise BadVariables(f"{word[:60]!r}: {part[:60]!r} reaches beyond {noun} {MOST}, which no lens has")
        listed += range(first, last + 1)
    return listed


def sensor(lens: Lens) -> int:
    """The number of the last surface before the sensor."""
    return len(lens.surfaces) - 2


def parse_bounds(text: str) -> dict[str, tuple[float, float]]:
    """Bounds by name of a list like "sensor:57.5..58", or "sensor:57.5,58". Raises BadVariables."""
    bounds = {}
    for word in text.split():
        name, _, ends = word.rpartition(":")
        try:
            first, last = ends.split(".." if ".." in ends else ",")
            low, high = float(first or -math.inf), float(last or math.inf)
        except ValueError as error:
            raise BadVariables(f"{word!r}: expected a variable and its bounds, like thickness_5:8..12") from error
        if not low < high:
            raise BadVariables(f"{word!r}: {low:g} is not less than {high:g}")
        bounds[name] = (low, high)
    return bounds


def parse_range(text: str) -> tuple[float, float]:
    """The smallest and largest number of "2:15", or of "2" (no upper limit). Raises BadLimits."""
    least, colon, most = text.partition(":")
    try:
        low, high = float(least), float(most) if colon else math.inf
    except ValueError:
        raise BadLimits(f"{text!r}: expected the least thickness in mm, or least and greatest like 2:15") from None
    if not 0 <= low < high:
        raise BadLimits(f"{text!r}: expected 0 ≤ least < greatest, found {low:g} and {high:g} mm")
    return low, high
